"""The same field in the files of many codes: read, it is the same in the project's frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from modeharvest.idic.local.field import LocalField, read_field, write_field
from modeharvest.idic.local.tables import column
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.errors import InputError

GRID = PixelGrid.centred(60, 80, 0.05)
COL, ROW = (a.astype(float) for a in np.meshgrid(np.arange(5, 75, 10), np.arange(5, 55, 10)))
X, Y = GRID.to_mm(ROW, COL)
U = np.stack([0.03 + 0.01 * X, 0.02 * X - 0.04 * Y], axis=-1)
"""(5, 7, 2) displacements, y up [mm]."""
U_PX = U / GRID.pixel_size * (1, -1)
"""The same along columns and rows [px]."""
TRUTH = np.column_stack([X.ravel(), Y.ravel(), U.reshape(-1, 2)])


def same(field: LocalField, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(np.column_stack([field.x, field.y, field.u]), TRUTH, atol=atol)


def text(
    path: Path, header: str, values: list[Any], separator: str = ",", decimal: str = "."
) -> Path:
    rows = np.column_stack([np.ravel(v) for v in values])
    lines = [separator.join(f"{v:.10g}".replace(".", decimal) for v in row) for row in rows]
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
@pytest.mark.parametrize("sd", [None, 0.001])
def test_a_field_written_comes_back(tmp_path: Path, suffix: str, sd: float | None) -> None:
    u = U.reshape(-1, 2).copy()
    u[4] = np.nan
    given = None if sd is None else np.full(u.shape, sd)
    written = LocalField(TRUTH[:, 0], TRUTH[:, 1], u, sd=given)
    write_field(tmp_path / f"field{suffix}", written)
    field = read_field(tmp_path / f"field{suffix}")
    np.testing.assert_allclose(field.u, u, atol=1e-9)  # nine digits are written
    np.testing.assert_array_equal(field.good, written.good)
    assert field.lost == 1
    assert (field.sd is None) == (sd is None)


CODES: list[tuple[str, str, list[Any], str, str, dict[str, Any]]] = [
    ("pyvale", '"subset_x","subset_y","disp_u","disp_v","disp_mag","converged",',
     [COL, ROW, U_PX[..., 0], U_PX[..., 1], COL, COL], ",", ".", {"grid": GRID}),
    ("DICe", "SUBSET_ID,COORDINATE_X,COORDINATE_Y,DISPLACEMENT_X,DISPLACEMENT_Y,SIGMA,STATUS_FLAG",
     [COL, COL, ROW, U_PX[..., 0], U_PX[..., 1], 0 * COL + 0.01, 0 * COL + 4], ",", ".",
     {"grid": GRID}),
    ("VIC, millimetres", '"X","Y","Z","U","V","W","sigma","x","y","u","v"',
     [X, Y, 0 * X, U[..., 0], U[..., 1], 0 * X, 0 * X, COL, ROW, U_PX[..., 0], U_PX[..., 1]],
     ",", ".", {"units": "mm", "y_axis": "up"}),
    ("VIC, pixels", '"X","Y","Z","U","V","W","sigma","x","y","u","v"',
     [X, Y, 0 * X, U[..., 0], U[..., 1], 0 * X, 0 * X, COL, ROW, U_PX[..., 0], U_PX[..., 1]],
     ",", ".", {"units": "px", "y_axis": "down", "grid": GRID}),
    ("VIC with units", "X [mm], Y [mm], Z [mm], U [mm], V [mm], W [mm]",
     [X, Y, 0 * X, U[..., 0], U[..., 1], 0 * X], ",", ".", {"y_axis": "up"}),
    ("GOM, decimal commas", "id;x;y;z;dx;dy;dz",
     [COL, X, Y, 0 * X, U[..., 0], U[..., 1], 0 * X], ";", ",", {"units": "mm", "y_axis": "up"}),
    ("blanks, y down in mm", "# x [mm] y [mm] u [mm] v [mm]",
     [X, -Y, U[..., 0], -U[..., 1]], " ", ".", {"y_axis": "down"}),
    ("MATLAB's pixels", "x\ty\tu\tv", [COL + 1, ROW + 1, U_PX[..., 0], U_PX[..., 1]], "\t", ".",
     {"grid": GRID, "units": "px", "y_axis": "down", "first_pixel": 1}),
    ("pixels from below, motion in mm", "posX,posY,ux,uy",
     [COL, 59 - ROW, U[..., 0], U[..., 1]], ",", ".",
     {"grid": GRID, "units": "px", "displacement_units": "mm", "y_axis": "up"}),
    ("no names", "", [COL, X, U[..., 1], Y, U[..., 0]], ",", ".",
     {"units": "mm", "y_axis": "up", "columns": {"x": 2, "y": 4, "u": 5, "v": 3}}),
]  # fmt: skip


@pytest.mark.parametrize(("code", "header", "values", "separator", "decimal", "options"), CODES)
def test_text_files_of_many_codes_are_one_field(
    tmp_path: Path, code: str, header: str, values: list[Any], separator: str, decimal: str,
    options: dict[str, Any],
) -> None:  # fmt: skip
    path = text(tmp_path / "field.csv", header, values, separator, decimal)
    same(read_field(path, **options), atol=1e-8)


def test_binary_files_hold_points_grids_or_axes(tmp_path: Path) -> None:
    options = {"units": "mm", "y_axis": "up"}
    u, v = U[..., 0], U[..., 1]
    np.savez(tmp_path / "grids.npz", x=X, y=Y, u=u, v=v)
    np.savez(tmp_path / "axes.npz", x=X[0], y=Y[:, 0], u=u[None], v=v[None])
    savemat(tmp_path / "grids.mat", {"x": X, "y": Y, "u": u, "v": v})
    savemat(tmp_path / "structure.mat", {"data": {"x": X[0], "y": Y[:, 0], "u": u, "v": v}})
    with h5py.File(tmp_path / "group.h5", "w") as file:
        for name, value in {"x": X, "y": Y, "u": u, "v": v}.items():
            file[f"results/frame1/{name}"] = value
    with h5py.File(tmp_path / "newer.mat", "w", userblock_size=512) as file:
        for name, value in {"x": X[:1], "y": Y[:, :1], "u": u, "v": v}.items():
            file[name] = value.T  # MATLAB 7.3 stores columns first
    for path in sorted(tmp_path.iterdir()):
        same(read_field(path, **options))


def test_failures_of_the_code_are_kept_as_such(tmp_path: Path) -> None:
    sigma = np.full(COL.shape, 0.02)
    sigma[1, 2] = -1.0
    u = U_PX[..., 0].copy()
    u[0, 0] = np.nan
    values = [COL, ROW, u, U_PX[..., 1], sigma]
    path = text(tmp_path / "field.csv", "x,y,u,v,sigma", values)
    field = read_field(path, GRID, units="px", y_axis="down")
    assert field.lost == 2
    assert field.sd_rms == pytest.approx(0.02 * GRID.pixel_size)


@pytest.mark.parametrize(
    ("content", "options", "words"),
    [
        ("x,y,u\n1,2,3\n", {"units": "mm", "y_axis": "up"}, "expected columns for v, got 'x', 'y'"),
        ("x,y,u,v\n1,2,3,4\n", {"y_axis": "up"}, "give units='px' or 'mm'"),
        ("x,y,u,v\n1,2,3,4\n", {"units": "mm"}, "give y_axis"),
        ("x,y,u,v\n1,2,3,4\n", {"units": "px", "y_axis": "down"}, "give --image, or a grid"),
        ("x,y,u,v\n1,2,3,4\n1,2,3\n", {"units": "mm", "y_axis": "up"}, "line 3: expected 4 values"),
        ("x,y,u,v\n1,2,3,4\n1,2,3,q\n", {"units": "mm", "y_axis": "up"}, "a number, got 'q'"),
        ("x,y,u,v\n1,2,,4\n", {"units": "mm", "y_axis": "up"}, "at least one valid point"),
        ("hello\n", {}, "lines of numbers, found none"),
        ("x [mm],y [mm],u,v\n1,2,3,4\n", {"units": "px", "y_axis": "up"}, "named as mm"),
        ("x,X,y,u,v\n1,1,2,3,4\n", {"y_axis": "up"}, "one column for x, got 'x', 'X'"),
        ("x,y,u,v\n1,2,3,4\n", {"columns": {"u": "disp"}}, "a column 'disp' for u"),
        ("x,y,u,v\n1,2,3,4\n", {"units": "inch"}, "'px' or 'mm', got 'inch'"),
    ],
)
def test_what_is_missing_is_named_in_one_line(
    tmp_path: Path, content: str, options: dict[str, Any], words: str
) -> None:
    path = tmp_path / "field.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=words) as caught:
        read_field(path, **options)
    assert "\n" not in str(caught.value)


def test_bad_files_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "shapes.npz", x=X, y=Y, u=U[..., 0], v=U[:2, :, 1])
    with pytest.raises(InputError, match=r"of one shape, got .* v \(2, 7\)"):
        read_field(tmp_path / "shapes.npz", units="mm", y_axis="up")
    (tmp_path / "broken.mat").write_bytes(b"not a file of MATLAB")
    (tmp_path / "broken.h5").write_bytes(b"nor of HDF5")
    (tmp_path / "broken.npz").write_bytes(b"nor of numpy")
    for name in ("broken.mat", "broken.h5", "broken.npz"):
        with pytest.raises(InputError, match=r"expected .*broken\.\w+"):
            read_field(tmp_path / name)
    with pytest.raises(InputError, match="found no such file"):
        read_field(tmp_path / "absent.csv")
    with pytest.raises(InputError, match="save the field as CSV"):
        read_field(Path(__file__))
    with pytest.raises(InputError, match="expected a field to be written as"):
        write_field(tmp_path / "field.xlsx", LocalField(*TRUTH[:, :2].T, TRUTH[:, 2:]))


@pytest.mark.parametrize(
    ("name", "role", "unit"),
    [("x", "x", None), ("Y [mm]", "y", "mm"), ("disp_v", "v", None), ("u_px", "u", "px"),
     ("displacement.y", "v", None), ("exx", None, None), ("subset_y", "y", "px"), ("dY", "v", None),
     ("sd_v [mm]", "sd_v", "mm"), ("z", None, None), ("velocity", None, None)],
)  # fmt: skip
def test_names_say_what_a_column_is(name: str, role: str | None, unit: str | None) -> None:
    found = column(name)
    assert (found.role, found.unit) == (role, unit)
