"""Displacement fields at points: reading the files of any DIC code, and writing.

A point that failed stays in the field, marked as not valid.

The frame of the project is x right, y up, in mm. A file's frame is stated by its columns' names or
by the caller; a field is never guessed to be in millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.local.formats import recognised
from modeharvest.idic.local.tables import ROLES, Column, Table, choose, read_table
from modeharvest.imaging.distortion.lens import Distortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic


@dataclass(frozen=True, eq=False)
class LocalField:
    """Displacements at points of the reference image."""

    x: FloatArray
    y: FloatArray
    """(n,) positions in the physical frame, y up [mm]."""
    u: FloatArray
    """(n, 2) displacements along x and y [mm]; anything where not ``valid``."""
    valid: BoolArray | None = None
    """(n,) True where the displacement counts; by default wherever it is finite."""
    sd: FloatArray | None = None
    """(n, 2) standard deviations of u [mm]; None if not known."""
    source: str = ""
    convention: str = ""
    """Recognised convention of its file, in one sentence; empty if that was declared."""
    units: frozenset[str] = frozenset()
    """Units of lengths in its file, "px", "mm" or both; empty if it was made without a file."""

    def __post_init__(self) -> None:
        for name in ("x", "y", "u", "sd"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64))
        n = self.x.size
        if self.x.shape != (n,) or self.y.shape != (n,) or self.u.shape != (n, 2) or n == 0:
            raise InputError(
                f"local field{self._named}: expected x (n,), y (n,) and u (n, 2) with n > 0, got "
                f"{self.x.shape}, {self.y.shape} and {self.u.shape}"
            )
        if self.sd is not None and self.sd.shape != (n, 2):
            raise InputError(f"local field{self._named}: expected sd ({n}, 2), got {self.sd.shape}")
        finite = np.isfinite(np.column_stack([self.x, self.y, self.u])).all(axis=1)
        given = finite if self.valid is None else np.asarray(self.valid, dtype=np.bool_)
        if given.shape != (n,):
            raise InputError(f"local field{self._named}: expected valid ({n},), got {given.shape}")
        object.__setattr__(self, "valid", given & finite)
        if not self.good.any():
            raise InputError(
                f"local field{self._named}: expected at least one valid point, got {n} points "
                "without a finite displacement; measure again with a looser threshold"
            )

    @property
    def _named(self) -> str:
        return f" {self.source}" if self.source else ""

    @property
    def read_as(self) -> str:
        """A sentence that says by which convention its file was read."""
        return f"{self.source} was read as {self.convention or 'its columns or options say'}."

    @property
    def points(self) -> FloatArray:
        """(n, 2) positions [mm]."""
        return np.column_stack([self.x, self.y])

    @property
    def good(self) -> BoolArray:
        """(n,) True at valid points."""
        assert self.valid is not None  # set when the field was made
        return self.valid

    @property
    def lost(self) -> int:
        """Number of points that are not valid."""
        return int((~self.good).sum())

    @property
    def valid_share(self) -> float:
        """Share of the points that are valid [-]."""
        return float(self.good.mean())

    @property
    def rms(self) -> float:
        """Root mean square of a component of u over the valid points [mm]."""
        return float(np.sqrt(np.mean(self.u[self.good] ** 2)))

    @property
    def sd_rms(self) -> float:
        """Root mean square of the standard deviations over the valid points [mm]; NaN if none."""
        if self.sd is None:
            return float("nan")
        return float(np.sqrt(np.mean(self.sd[self.good] ** 2)))

    @property
    def spacing(self) -> float:
        """Median distance of a point from its nearest neighbour [mm]; infinite for one point."""
        points = self.points[np.isfinite(self.points).all(axis=1)]
        if len(points) < 2:
            return float("inf")
        return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))

    def valid_points(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(m,) x, (m,) y and (m, 2) u of the valid points [mm]."""
        return self.x[self.good], self.y[self.good], self.u[self.good]

    def within(self, region: Box) -> LocalField:
        """The part of the field inside a box; raises InputError if no valid point is there."""
        return self.selected(region.contains(self.x, self.y), "the box")

    def selected(self, keep: BoolArray, what: str = "the selection") -> LocalField:
        """The points where ``keep`` (n,) is True; raises InputError if none of them is valid."""
        if not (keep & self.good).any():
            x, y, _ = self.valid_points()
            raise InputError(
                f"local field{self._named}: expected valid points in {what}, got none; the field "
                f"covers x = {x.min():.2f} to {x.max():.2f} and y = {y.min():.2f} to {y.max():.2f} "
                "mm"
            )
        sd = None if self.sd is None else self.sd[keep]
        return LocalField(
            self.x[keep], self.y[keep], self.u[keep], self.good[keep], sd, self.source,
            self.convention, self.units,
        )  # fmt: skip

    def scaled(self, factor: float) -> LocalField:
        """The same field with all lengths times a factor, such as mm/px."""
        sd = None if self.sd is None else factor * self.sd
        return replace(self, x=factor * self.x, y=factor * self.y, u=factor * self.u, sd=sd)

    def less(self, displacement: Callable[[FloatArray], FloatArray]) -> LocalField:
        """The microfluctuation field w = u − model, with the field's own standard deviations.

        The model maps (n, 2) points to (n, 2) displacements [mm], as
        ``partial(ansatz.displacement_at, unknowns)`` does.
        """
        where = np.isfinite(self.points).all(axis=1)
        model = np.full(self.u.shape, np.nan)
        model[where] = displacement(self.points[where])
        return replace(self, u=self.u - model)

    @property
    def rms_beyond_noise(self) -> float:
        """√(rms² − sd²) [mm]: rms without the field's own errors, at least 0; NaN without sd."""
        return float(np.sqrt(np.maximum(0.0, self.rms**2 - self.sd_rms**2)))


def without_distortion(field: LocalField, grid: PixelGrid, distortion: Distortion) -> LocalField:
    """The field that an ideal lens would have shown: both ends of every displacement corrected.

    For fields measured on photographs that are not undistorted; the grid is of their pixels.
    """
    u = np.where(field.good[:, None], field.u, 0.0)
    ideal = field_between(
        np.column_stack(distortion.ideal(*grid.to_px(field.x, field.y))),
        np.column_stack(distortion.ideal(*grid.to_px(field.x + u[:, 0], field.y + u[:, 1]))),
        grid,
    )
    return replace(field, x=ideal.x, y=ideal.y, u=ideal.u)


def field_between(
    before: FloatArray, after: FloatArray, grid: PixelGrid, source: str = ""
) -> LocalField:
    """Make the field of displacements from positions (n, 2) to others, both (row, col) [px]."""
    (x, y), (x2, y2) = grid.to_mm(*before.T), grid.to_mm(*after.T)
    return LocalField(x, y, np.column_stack([x2 - x, y2 - y]), source=source)


_UNITS, _AXES = ("px", "mm"), ("up", "down")
_WRITTEN = "x [{u}]", "y {y} [{u}]", "u [{u}]", "v {y} [{u}]", "sd_u [{u}]", "sd_v [{u}]", "valid"


def read_field(
    path: Path | str,
    grid: PixelGrid | None = None,
    *,
    units: str | None = None,
    displacement_units: str | None = None,
    y_axis: str | None = None,
    first_pixel: int | None = None,
    columns: Mapping[str, str | int] | None = None,
    frame: int | None = None,
) -> LocalField:
    """Read a displacement field of any DIC code.

    Files of Ncorr, VIC, DaVis, DICe, MatchID, GOM/ZEISS, pyvale and modeharvest are recognised and
    need no options; options that are given override the code's convention, see ``formats``.
    The file's points that are NaN, have ``valid`` zero or a negative ``sigma`` (as VIC and DICe
    mark failure) are kept as not valid. ``sigma`` in pixels is taken for the standard deviation of
    both components. InputError if a column, the units or the axis are not known, or if shapes
    don't agree.

    path : CSV, TXT, NPZ, HDF5 or MAT with x, y, u and v: points (n,), grids (rows, cols), or x
        (cols,) and y (rows,) as axes of grids u and v; VTK or VTU with a vector at its points.
    grid : Pixels to millimetres, needed if anything is in pixels.
    units : "px" or "mm", of positions and displacements; None: as the columns' names state.
    displacement_units : Units of u and v, if they are not those of x and y.
    y_axis : "up" or "down": where y grows and v is positive; None: as the columns' names state. In
        pixels, "up" counts from the lowest row.
    first_pixel : Coordinate of the first pixel's centre, 0 (also if None) or, as in MATLAB, 1.
    columns : Names, or numbers from 1, of columns for "x", "y", "u", "v", "sd_u", "sd_v", "sigma"
        and "valid", where they aren't recognised by name.
    frame : Number from 1 of the field in a file that holds several, as Ncorr's.
    """
    found = (read_table(path), None) if columns else recognised(Path(path), units, y_axis, frame)
    table, known = found
    if known is not None:
        units, y_axis = units or known.units, y_axis or known.y_axis
        displacement_units = displacement_units or known.displacement_units
    first_pixel = first_pixel or 0
    chosen = choose(list(table), columns or {}, units, str(path))
    positions, motions = [chosen["x"], chosen["y"]], [chosen["u"], chosen["v"]]
    position = _declared("units", _UNITS, positions, units, str(path))
    motion = _declared("units", _UNITS, motions, displacement_units or units, str(path))
    up_or_down = _declared("y_axis", _AXES, [*positions, chosen["v"]], y_axis, str(path))
    down = up_or_down == "down"
    if "px" in (position, motion) and grid is None:
        raise InputError(f"{path}: expected the image of a field in px; give --image, or a grid")
    x, y, u, v = _same_shape([table[chosen[role].name] for role in ROLES], chosen, str(path))
    sign = -1.0 if down else 1.0
    if position == "px" and grid is not None:
        row = y - first_pixel  # from the lowest one, unless y grows downwards
        x, y = grid.to_mm(row if down else grid.rows - 1 - row, x - first_pixel)
    else:
        y = sign * y
    scale = grid.pixel_size if motion == "px" and grid is not None else 1.0
    sd, ok = _quality(table, chosen, x.size, scale, motion == "px", str(path))
    u = scale * np.column_stack([u, sign * v])
    text = "" if known is None else str(known)
    return LocalField(x, y, u, ok, sd, Path(path).name, text, frozenset((position, motion)))


def write_field(
    path: Path | str, field: LocalField, px: PixelGrid | None = None, more: Table | None = None
) -> None:
    """Write a field as CSV or NPZ, which :func:`read_field` reads without any options.

    ``px``: the pixels, for columns in pixels, y down; ``more``: columns (n,) beside it. InputError
    if the name does not end in .csv or .npz.
    """
    columns, suffix = columns_of(field, px) | (more or {}), Path(path).suffix.lower()
    if suffix not in (".csv", ".npz"):
        raise InputError(f"expected a field to be written as .csv or .npz, got {path}")
    with atomic(path) as part:
        if suffix == ".npz":
            with open(part, "wb") as file:
                np.savez(file, **columns)  # type: ignore[arg-type]
        else:
            data = np.column_stack([*columns.values()])
            formats = ["%d" if head == _WRITTEN[-1] else "%.9g" for head in columns]
            np.savetxt(part, data, formats, ",", header=",".join(columns), comments="")


def columns_of(field: LocalField, px: PixelGrid | None = None) -> dict[str, FloatArray]:
    """All columns of a field under names that state units and axis; ``px`` as above."""
    x, y, u = field.x, field.y, field.u
    sd, size, sign = np.full_like(u, np.nan) if field.sd is None else field.sd, 1.0, 1.0
    if px is not None:
        (y, x), size, sign = px.to_px(x, y), px.pixel_size, -1.0
    unit, axis = ("mm", "up") if px is None else ("px", "down")
    data = x, y, u[:, 0] / size, sign * u[:, 1] / size, *(sd.T / size), field.good.astype(float)
    return dict(zip((head.format(u=unit, y=axis) for head in _WRITTEN), data, strict=True))


def _declared(
    option: str, values: tuple[str, str], columns: list[Column], given: str | None, where: str
) -> str:
    """The value of an option, "units" or "y_axis", given or stated by the columns' names."""
    both = " or ".join(map(repr, values))
    if given not in (None, *values):
        raise InputError(f"{where}: expected {option} {both}, got {given!r}")
    stated = {c.unit if option == "units" else c.y_axis for c in columns} - {None}
    names = ", ".join(repr(c.name) for c in columns)
    if len(stated) > 1 or (given and stated and stated != {given}):
        raise InputError(
            f"{where}: expected {option} {given or 'of one kind'!r} for {names}, but they are "
            f"named as {' and '.join(sorted(map(str, stated)))}; leave {option} out, or name other "
            "columns"
        )
    found = given or next(iter(stated), None)
    if found is None:
        like = "'u [px]' or 'u [mm]'" if option == "units" else "'y down' or 'y up'"
        raise InputError(
            f"{where}: expected {option} for {names}, got none; name columns like {like}, or give "
            f"{option}={both}"
        )
    return found


def _same_shape(
    arrays: list[FloatArray], chosen: dict[str, Column], where: str
) -> list[FloatArray]:
    """(n,) each, from points, grids, or axes and grids; an axis of length 1 may come first."""
    x, y, u, v = (np.squeeze(a) for a in arrays)
    if x.ndim == 1 and y.ndim == 1 and u.ndim == 2 and u.shape == (y.size, x.size):
        x, y = np.meshgrid(x, y)
    if not x.shape == y.shape == u.shape == v.shape:
        got = ", ".join(
            f"{chosen[r].name} {a.shape}" for r, a in zip(ROLES, (x, y, u, v), strict=True)
        )
        raise InputError(f"{where}: expected x, y, u and v of one shape, got {got}")
    return [a.ravel() for a in (x, y, u, v)]


def _quality(
    table: Table, chosen: dict[str, Column], n: int, scale: float, in_px: bool, where: str
) -> tuple[FloatArray | None, NDArray[np.bool_]]:
    """(n, 2) standard deviations [mm] or None, and (n,) which points the file marks as valid."""
    values = {role: table[c.name].ravel() for role, c in chosen.items() if role not in ROLES}
    for role, given in values.items():
        if given.size != n:
            raise InputError(
                f"{where}: expected {chosen[role].name} for {n} points, got {given.size}"
            )
    ok = (values.get("valid", np.ones(n)) > 0) & (values.get("sigma", np.zeros(n)) >= 0)
    sd = None
    if "sd_u" in values and "sd_v" in values:
        sd = scale * np.column_stack([values["sd_u"], values["sd_v"]])
    elif "sigma" in values and in_px:
        sd = scale * np.column_stack([values["sigma"]] * 2)
    is_known = sd is not None and bool(np.any(np.nan_to_num(sd[ok])))  # zeros mean unknown
    return (sd if is_known else None), ok
