"""Fields written as other codes write them, and read back: the same numbers."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.linalg import logm, sqrtm

from modeharvest.idic.local.export import FORMATS, convert, export_field
from modeharvest.idic.local.field import LocalField, read_field
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.files import write_image
from modeharvest.util.errors import InputError

GRID = PixelGrid(60, 80, 0.05, -1.3, 2.1)
ROW, COL = (a.ravel().astype(float) for a in np.mgrid[4:60:4, 8:80:4])
X, Y = GRID.to_mm(ROW, COL)
U = np.column_stack([0.031 + 0.01 * X, 0.02 * X - 0.04 * Y])
GOOD = np.arange(X.size) != 17
FIELD = LocalField(X, Y, U, GOOD, np.full(U.shape, 2e-3))
OF_GRIDS = ("ncorr", "davis")
WITH_SD = ("vic2d", "dice", "csv", "npz", "mat")


@pytest.mark.parametrize("form", FORMATS)
def test_what_is_written_is_read_back_without_options(tmp_path: Path, form: str) -> None:
    path = export_field(tmp_path / "field", FIELD, form, GRID)
    assert path.suffix == FORMATS[form]
    field = read_field(path, GRID)
    found = np.column_stack([field.x, field.y, field.u])[field.good]
    true = np.column_stack([X, Y, U])[GOOD]
    np.testing.assert_allclose(found, true, atol=1e-9)
    assert form in OF_GRIDS or field.lost == 1
    assert (field.sd is not None) == (form in WITH_SD)
    if field.sd is not None:
        np.testing.assert_allclose(field.sd[field.good], 2e-3, rtol=1e-6)


@pytest.mark.parametrize("form", FORMATS)
def test_a_field_without_standard_deviations_has_none_later(tmp_path: Path, form: str) -> None:
    path = export_field(tmp_path / "field", replace(FIELD, sd=None), form, GRID)
    assert read_field(path, GRID).sd is None


@pytest.mark.parametrize("form", OF_GRIDS)
def test_codes_with_grids_want_whole_pixels(tmp_path: Path, form: str) -> None:
    with pytest.raises(InputError, match=r"whole pixels .* write VIC-2D's or DICe's"):
        export_field(tmp_path / "field", replace(FIELD, x=X + 0.01), form, GRID)


def test_other_formats_hold_points_between_pixels(tmp_path: Path) -> None:
    for form in set(FORMATS) - set(OF_GRIDS):
        path = export_field(tmp_path / "field", replace(FIELD, x=X + 0.01), form, GRID)
        np.testing.assert_allclose(read_field(path, GRID).x, X + 0.01, atol=1e-9)


def test_millimetres_need_the_size_of_a_pixel(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected the size of a pixel for gom"):
        export_field(tmp_path / "field", FIELD, "gom", GRID, "px")
    with pytest.raises(InputError, match="expected a format among ncorr"):
        export_field(tmp_path / "field", FIELD, "vic", GRID)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("source", ["gom", "matchid", "vic2d"])
def test_a_converted_file_has_the_same_field_or_asks_for_what_it_lacks(
    tmp_path: Path, source: str, form: str
) -> None:
    """Millimetres were written as pixels where the image or the size of a pixel wasn't given."""
    grid = PixelGrid.centred(60, 80, 0.05)
    x, y = grid.to_mm(ROW, COL)
    path = export_field(tmp_path / source, replace(FIELD, x=x, y=y), source, grid)
    write_image(image := tmp_path / "ref.tif", np.arange(4800.0).reshape(grid.shape))
    found, field = convert(path, tmp_path / "all", form, image, 0.05)
    assert field.units == {"gom": {"mm"}, "matchid": {"px", "mm"}, "vic2d": {"px"}}[source]
    np.testing.assert_allclose(read_field(found, grid).valid_points()[2], U[GOOD], atol=1e-9)
    for what, given in {"none": (None, None), "image": (image, None), "px": (None, 0.05)}.items():
        out = tmp_path / what
        try:
            found, _ = convert(path, out, form, *given)
        except InputError as error:
            assert re.search("give (both|--image|--pixel-size)", str(error))  # noqa: PT017
            assert not out.exists()
        else:
            own = grid if given[1] or source == "gom" else PixelGrid.centred(60, 80, 1.0)
            scale = own.pixel_size / grid.pixel_size
            u = read_field(found, own).valid_points()[2]
            np.testing.assert_allclose(u, scale * U[GOOD], atol=1e-7)


TURN, STRETCH = np.radians(20.0), np.array([[1.25, 0.1], [0.1, 0.8]])
F = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]]) @ STRETCH
GREEN, HENCKY = 0.5 * (STRETCH @ STRETCH - np.eye(2)), logm(STRETCH)
DOWN = np.array([[1.0, -1.0], [-1.0, 1.0]])
"""Signs of a tensor's components where y points down."""


def strained(form: str, folder: Path, unit: str = "mm") -> Path:
    """A field of this rotation and stretch with a failed point, as a file of another code."""
    same = np.ones((X.size, 1, 1))
    tensors = {"F": same * F, "green_lagrange": same * GREEN, "logarithmic": same * HENCKY}
    return export_field(folder / "field", FIELD, form, GRID, unit, tensors)


def columns(path: Path, separator: str = ",") -> dict[str, np.ndarray]:
    """Columns of a table as another program would read them; blanks are NaN."""
    head, *rows = path.read_text().splitlines()
    names = [name.strip().strip('"') for name in head.split(separator)]
    table = [
        [float(word.replace(",", ".") or "nan") for word in row.split(separator)] for row in rows
    ]
    return dict(zip(names, np.array(table).T, strict=True))


@pytest.mark.parametrize(
    ("form", "names", "failed"),
    [
        ("vic2d", ("exx", "exy", "eyy"), 0.0),
        ("dice", tuple(f"VSG_STRAIN_{ij}" for ij in ("XX", "XY", "YY")), 0.0),
        ("matchid", tuple(f"strain.Strain-global frame: E{ij} [ ]" for ij in ("xx", "xy", "yy")),
         np.nan),
    ],
)  # fmt: skip
@pytest.mark.parametrize("unit", ["mm", "px"])
def test_green_s_strains_are_along_the_axes_of_the_image(
    tmp_path: Path, form: str, names: tuple[str, ...], failed: float, unit: str
) -> None:
    table = columns(strained(form, tmp_path, unit))
    E = DOWN * GREEN
    for name, true in zip(names, (E[0, 0], E[0, 1], E[1, 1]), strict=True):
        np.testing.assert_allclose(table[name][GOOD], true, rtol=1e-9)
        np.testing.assert_equal(table[name][~GOOD], failed)


def test_ncorr_s_grids_of_strains(tmp_path: Path) -> None:
    saved = loadmat(strained("ncorr", tmp_path), simplify_cells=True)["data_dic_save"]
    shown = saved["displacements"]["plot_u_ref_formatted"] != 0.0
    for name, true in (("exx", GREEN[0, 0]), ("exy", -GREEN[0, 1]), ("eyy", GREEN[1, 1])):
        grid = saved["strains"][f"plot_{name}_ref_formatted"]
        np.testing.assert_allclose(grid[shown], true, rtol=1e-9)
        assert not grid[~shown].any()


def test_pyvale_s_strains_are_in_a_file_of_their_own(tmp_path: Path) -> None:
    table = columns(strained("pyvale", tmp_path).with_name("strain_field.csv"))
    for i in range(2):
        for j in range(2):
            np.testing.assert_allclose(table[f"def_grad_{i}{j}"][GOOD], (DOWN * F)[i, j])
            np.testing.assert_allclose(table[f"eps_{i}{j}"][GOOD], (DOWN * HENCKY)[i, j])
    np.testing.assert_allclose(table["window_x"], COL)


@pytest.mark.parametrize(("form", "unit", "sign"), [
    ("csv", "mm", 1.0), ("csv", "px", -1.0), ("npz", "mm", 1.0), ("mat", "px", -1.0)
])  # fmt: skip
def test_own_formats_hold_gradient_and_strains(
    tmp_path: Path, form: str, unit: str, sign: float
) -> None:
    path = strained(form, tmp_path, unit)
    read = {"csv": columns, "npz": np.load, "mat": loadmat}[form](path)
    for name, true in (("F_yx", F[1, 0]), ("logarithmic_xy", HENCKY[0, 1])):
        np.testing.assert_allclose(read[name].ravel()[GOOD], sign * true, rtol=1e-6)
    field = read_field(path, GRID)
    np.testing.assert_allclose(field.u[field.good], U[GOOD], atol=1e-9)


def test_aramis_strains_are_those_of_the_right_stretch(tmp_path: Path) -> None:
    path = strained("aramis", tmp_path)
    table = columns(path, "; ")
    technical = np.real(sqrtm(F.T @ F)) - np.eye(2)
    for name, true in (("epsx [%]", 100.0 * technical[0, 0]), ("epsy [%]", 100.0 * technical[1, 1]),
                       ("epsxy [1]", technical[0, 1])):  # fmt: skip
        np.testing.assert_allclose(table[name][GOOD], true, rtol=1e-9)
    field = read_field(path, GRID)
    assert field.convention.startswith("GOM/ZEISS ARAMIS: in mm, y up")
    np.testing.assert_array_equal(field.good, GOOD)
    np.testing.assert_allclose(field.u[GOOD], U[GOOD], atol=1e-9)


def test_codes_without_columns_for_strains_get_none(tmp_path: Path) -> None:
    assert [*columns(strained("gom", tmp_path), ";")][-1] == "displacement_z"
    assert "exx" not in columns(export_field(tmp_path / "none", FIELD, "vic2d", GRID))
