"""Files of DIC codes, in the layout that each of them writes: recognised, and the same field."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from modeharvest.idic.local.field import LocalField, read_field
from modeharvest.idic.local.formats import frames_of
from modeharvest.imaging.grid import PixelGrid
from modeharvest.runs.photographs.case import LocalTable
from modeharvest.runs.photographs.prepare import local_field
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

GRID = PixelGrid.centred(60, 80, 0.05)
COL, ROW = (a.astype(float) for a in np.meshgrid(np.arange(0, 80, 8), np.arange(0, 60, 8)))
X, Y = GRID.to_mm(ROW, COL)
U, V = 0.031 + 0.01 * X, 0.02 * X - 0.04 * Y
"""(8, 10) displacement, y up [mm]."""
U_PX, V_DOWN = U / GRID.pixel_size, -V / GRID.pixel_size
LOST = (2, 3)
"""Where the point that failed stands in the grid."""


def lines(path: Path, head: str, columns: list[FloatArray], separator: str, comma: bool) -> None:
    rows = np.column_stack([np.ravel(c) for c in columns])
    text = "\n".join(separator.join(f"{v:.12g}" for v in row) for row in rows)
    path.write_text(f"{head}\n{text.replace('.', ',') if comma else text}\n", encoding="utf-8")


def with_lost(values: FloatArray, lost: float) -> FloatArray:
    values = values.copy()
    values[LOST] = lost
    return values


SIGMA = with_lost(np.full(COL.shape, 0.01), -1.0)
NUMBER, FLAT = np.arange(COL.size, dtype=float), np.zeros(COL.shape)
NAN = float("nan")
TEXTS: dict[str, tuple[str, list[FloatArray], str, bool, str]] = {
    "VIC-2D": (
        '"x", "y", "u", "v", "exx", "sigma"',
        [COL, ROW, U_PX, V_DOWN, FLAT, SIGMA], ", ", False,
        "VIC-2D: in px, y down, first pixel 0, failed: sigma < 0"),
    "VIC-3D": (
        '"X [mm]";"Y [mm]";"Z [mm]";"U [mm]";"V [mm]";"W [mm]";"sigma [pixel]"',
        [X, Y, FLAT, U, V, FLAT, SIGMA], ";", True, "VIC: in mm, y up, failed: sigma < 0"),
    "DaVis": (
        f'#DaVis 8.4.0 2D-vector 8 {COL.shape[0]} {COL.shape[1]} '
        '"" "pixel" "" "pixel" "displacement" "pixel"',
        [COL, ROW, with_lost(U_PX, 0.0), with_lost(V_DOWN, 0.0)], "\t", False,
        "DaVis: in px, y down, first pixel 0, failed: u = v = 0"),
    "DaVis scaled": (
        '#DaVis 10.1.2 2D-vector 8 8 10 "x" "mm" "y" "mm" "displacement" "mm"',
        [X, Y, with_lost(U, 0.0), with_lost(V, 0.0)], "\t", True,
        "DaVis: in mm, y up, failed: u = v = 0"),
    "DICe": (
        "*** Digital Image Correlation Engine (DICe)\n*** Copyright 2015\n***\n"
        "SUBSET_ID,COORDINATE_X,COORDINATE_Y,DISPLACEMENT_X,DISPLACEMENT_Y,SIGMA,STATUS_FLAG",
        [NUMBER, COL, ROW, U_PX, V_DOWN, SIGMA, FLAT], ",", False,
        "DICe: in px, y down, first pixel 0, failed: sigma < 0"),
    "pyvale": (
        "subset_x,subset_y,displacement_u,displacement_v,displacement_mag,converged,cost",
        [COL, ROW, U_PX, V_DOWN, FLAT, with_lost(FLAT + 1.0, 0.0), FLAT], ",", False,
        "pyvale: in px, y down, first pixel 0, failed: not converged"),
    "MatchID 2024": (
        "Coordinates.Image X [Pixel],Coordinates.Image Y [Pixel],coor.X [mm],coor.Y [mm],"
        "disp.Horizontal Displacement U [mm],disp.Vertical Displacement V [mm]",
        [COL, ROW, X - X[0, 0], Y[0, 0] - Y, with_lost(U, NAN), -V], ",", False,
        "MatchID: positions in px, displacements in mm, y down, first pixel 0, failed: NaN"),
    "MatchID, y up in mm": (
        "Image X[Pixel];Image Y[Pixel];X[mm];Y[mm];Z[mm];"
        "Horizontal Displacement U[mm];Vertical Displacement V[mm]",
        [COL, ROW, X, Y, FLAT, with_lost(U, NAN), V], ";", False,
        "MatchID: positions in px, displacements in mm, y down, first pixel 0, failed: NaN"),
    "MatchID in pixels": (
        "Image X[Pixel];Image Y[Pixel];Horizontal: u[Pixel];Vertical: v[Pixel]",
        [COL, ROW, with_lost(U_PX, NAN), V_DOWN], ";", False,
        "MatchID: in px, y down, first pixel 0, failed: NaN"),
    "GOM": (
        "id;x;y;z;displacement_x;displacement_y;displacement_z",
        [NUMBER, X, Y, FLAT, with_lost(U, NAN), V, FLAT], ";", True,
        "GOM/ZEISS Correlate: in mm, y up, failed: NaN or blank"),
    "ARAMIS": (
        "# Process data:\n# specimen : Dummy\n#    ID;   x_undef [mm];  y_undef [mm];  "
        "z_undef [mm];    u [mm];    v [mm];     w [mm]",
        [NUMBER, X, Y, FLAT, with_lost(U, NAN), V, FLAT], "; ", False,
        "GOM/ZEISS ARAMIS: in mm, y up, failed: NaN"),
}  # fmt: skip


def same(field: LocalField, atol: float = 1e-9) -> None:
    keep = np.ones(COL.shape, dtype=bool)
    keep[LOST] = False
    np.testing.assert_array_equal(field.good, keep.ravel())
    found = np.column_stack([field.x, field.y, field.u])[field.good]
    true = np.column_stack([a[keep] for a in (X, Y, U, V)])
    np.testing.assert_allclose(found, true, atol=atol)


@pytest.mark.parametrize("code", TEXTS)
def test_text_of_a_code_needs_no_declaration(tmp_path: Path, code: str) -> None:
    head, columns, separator, comma, convention = TEXTS[code]
    path = tmp_path / ("field.csv" if ";" in separator or "," in separator else "field.txt")
    lines(path, head, columns, separator, comma)
    field = read_field(path, GRID)
    same(field)
    assert field.convention == convention


@pytest.mark.parametrize("form", ["quoted", "whole numbers first", "UTF-16"])
def test_decimal_commas_as_programs_in_german_write_them(tmp_path: Path, form: str) -> None:
    """A comma in quotes, no sign in the first line of numbers, the encoding of Windows."""
    rows = np.column_stack([np.ravel(c) for c in (COL, ROW, U_PX, V_DOWN, SIGMA)])
    separator, mark = (",", '"') if form == "quoted" else (";", "")
    text = [[f"{value:.12g}".replace(".", ",") for value in row] for row in rows]
    if form == "whole numbers first":
        text.insert(0, ["0", "0", "0", "0", "-1"])
    table = [["x", "y", "u", "v", "sigma"], *text]
    content = "\n".join(separator.join(f"{mark}{cell}{mark}" for cell in row) for row in table)
    path = tmp_path / "vic.csv"
    path.write_text(content, encoding="utf-16" if form == "UTF-16" else "utf-8")
    field = read_field(path, GRID)
    same(field.selected(np.arange(field.x.size) >= field.x.size - COL.size))
    assert field.convention.startswith("VIC-2D: in px")


def ncorr(scale: float) -> dict[str, FloatArray]:
    return {
        "plot_u_ref_formatted": scale * with_lost(U_PX, 0.0),
        "plot_v_ref_formatted": scale * with_lost(V_DOWN, 0.0),
        "plot_corrcoef_dic": FLAT + 0.01,
    }


@pytest.mark.parametrize("scale", [1.0, 0.05])
def test_ncorr_in_both_versions_of_mat(tmp_path: Path, scale: float) -> None:
    info = {"pixtounits": scale, "spacing": 7.0, "units": "mm"}
    first = {name: 0.5 * a for name, a in ncorr(scale).items()}
    region = {"roi_dic": {"mask": np.ones((3, 4))}}  # a structure, if its object was converted
    one = {"data_dic_save": {"displacements": ncorr(scale) | region, "dispinfo": info}}
    two = {"data_dic_save": {"displacements": [first, ncorr(scale)], "dispinfo": info}}
    kind = [(name, "O") for name in first]
    array = np.array([tuple(first.values()), tuple(ncorr(scale).values())], dtype=kind)
    two["data_dic_save"]["displacements"] = array
    savemat(tmp_path / "one5.mat", one)
    savemat(tmp_path / "two5.mat", two)
    with h5py.File(tmp_path / "one7.mat", "w", userblock_size=512) as file:
        for name, grid in ncorr(scale).items():
            file[f"data_dic_save/displacements/{name}"] = grid.T
        for name in ("pixtounits", "spacing"):
            file[f"data_dic_save/dispinfo/{name}"] = [[info[name]]]
    with h5py.File(tmp_path / "two7.mat", "w", userblock_size=512) as file:
        for name in first:
            file[f"#refs#/{name}_a"], file[f"#refs#/{name}_b"] = first[name].T, ncorr(scale)[name].T
            to = [[file[f"#refs#/{name}_a"].ref], [file[f"#refs#/{name}_b"].ref]]
            made = file.create_dataset(
                f"data_dic_save/displacements/{name}", (2, 1), dtype=h5py.ref_dtype
            )
            made[...] = np.array(to, dtype=h5py.ref_dtype)
        for name in ("pixtounits", "spacing"):
            file[f"data_dic_save/dispinfo/{name}"] = [[info[name]]]
    for version in (5, 7):
        field = read_field(tmp_path / f"one{version}.mat", GRID)
        same(field)
        assert field.convention.startswith("Ncorr: in px, y down, first pixel 0")
        both = tmp_path / f"two{version}.mat"
        assert frames_of(both) == 2
        same(read_field(both, GRID, frame=2))
        with pytest.raises(InputError, match="got Ncorr's 2; say which frame"):
            read_field(both, GRID)
        with pytest.raises(InputError, match="a frame from 1 to 2, got 3"):
            read_field(both, GRID, frame=3)


def test_one_file_of_ncorr_serves_a_harvest_of_several_photographs(tmp_path: Path) -> None:
    info, none = {"pixtounits": 0.05, "spacing": 7.0}, {k: 0.0 * a for k, a in ncorr(0.05).items()}
    array = np.array([tuple(none.values()), tuple(ncorr(0.05).values())], [(k, "O") for k in none])
    savemat(tmp_path / "all.mat", {"data_dic_save": {"displacements": array, "dispinfo": info}})
    for name in ("p1.tif", "p2.tif"):
        (tmp_path / name).touch()
    case: Any = SimpleNamespace(
        base=tmp_path, images=SimpleNamespace(deformed=("p*.tif",)),
        local=LocalTable("file", ("all.mat",)),
    )  # fmt: skip
    prepared: Any = SimpleNamespace(grid=GRID)
    field = local_field(case, prepared, "p2", None)
    assert field is not None
    same(field)
    with pytest.raises(InputError, match="at least one valid point"):
        local_field(case, prepared, "p1", None)


def test_what_is_declared_counts_more(tmp_path: Path) -> None:
    path = tmp_path / "vic.csv"
    lines(path, "x,y,u,v,sigma", [COL + 1, ROW + 1, U_PX, -V_DOWN, SIGMA], ",", False)
    declared = read_field(path, GRID, first_pixel=1)
    keep = declared.good
    np.testing.assert_allclose(declared.x[keep], X.ravel()[keep])
    np.testing.assert_allclose(declared.u[keep, 1], -V.ravel()[keep])
    up = read_field(path, GRID, y_axis="up")
    np.testing.assert_allclose(up.u[up.good, 1], V.ravel()[up.good])


def test_units_choose_among_columns(tmp_path: Path) -> None:
    head, path = '"X","Y","Z","U","V","W","sigma","x","y","u","v"', tmp_path / "both.csv"
    columns = [X, Y, FLAT, U, V, FLAT, SIGMA, COL, ROW, U_PX, V_DOWN]
    lines(path, head, columns, ",", False)
    same(read_field(path, GRID))
    same(read_field(path, units="mm"))


def test_a_frame_of_a_single_field_and_units_of_no_length(tmp_path: Path) -> None:
    path = tmp_path / "piv.txt"
    head = '#DaVis 8.4.0 2D-vector 8 8 10 "" "mm" "" "mm" "velocity" "m/s"'
    lines(path, head, [X, Y, U, V], "\t", False)
    with pytest.raises(InputError, match="export displacements in pixel or mm"):
        read_field(path, GRID)
    lines(path, "x,y,u,v,sigma", [COL, ROW, U_PX, V_DOWN, SIGMA], ",", False)
    with pytest.raises(InputError, match="frame 1 of a file of one, got 2"):
        read_field(path, GRID, frame=2)
