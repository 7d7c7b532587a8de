"""Gauges in measured displacements: at points, along lines (extensometers), over areas.

A gauge's variance is the sum of squares of what each root of the covariance of all nodes
(``NodalResult.roots``) changes in its reading: correlation between neighbours is included.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from skimage.measure import points_in_poly

from modeharvest.fem.field import Mesh
from modeharvest.idic.finite_element.fields import field_of, nodal_gradient
from modeharvest.idic.finite_element.result import NodalResult, located
from modeharvest.idic.photograph.axes import require_angle, turned_axes
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import reading, write_csv
from modeharvest.util.typed import made

_MOST_POINTS = 2000
"""Most points of an area."""
_ALONG_PX = 2.0
"""Distance between points of a line [px]."""
_DEGREES = {"rotation": "deg", "turn": "deg"}
Position = tuple[float, float]


@dataclass(frozen=True)
class Gauge:
    """A gauge: either a ``point``, a ``line`` between two points, or a ``polygon``.

    Positions are in the unit of the result, x right and y up from its origin (of ``measure``: the
    middle of the image); with ``pixels`` they are [column, row] as an image viewer shows, from 0.
    ``angle``: from x to the first axis of a point's or an area's strains, counter-clockwise
    [degrees]; these are then called 11, 22, 12 instead of xx, yy, xy. None: the picture's axes.
    """

    name: str
    point: Position | None = None
    line: tuple[Position, Position] | None = None
    polygon: tuple[Position, ...] | None = None
    pixels: bool = False
    angle: float | None = None

    def __post_init__(self) -> None:
        names, what = ("point", "line", "polygon"), f"gauge {self.name!r}: expected"
        given = [name for name in names if getattr(self, name) is not None]
        if not self.name.strip():
            raise InputError("a gauge: expected a name, got an empty one")
        if len(given) != 1:
            got = " and ".join(given) or "none"
            raise InputError(f"{what} one of {', '.join(names)}, got {got}")
        if self.polygon is not None and len(self.polygon) < 3:
            raise InputError(f"{what} 3 corners or more, got {len(self.polygon)}")
        if self.angle is not None:
            require_angle(f"gauge {self.name!r}: angle", self.angle)
            if self.line is not None:
                raise InputError(f"{what} an angle for a point or a polygon, got a line; omit it")
        if self.line is not None and self.line[0] == self.line[1]:
            raise InputError(f"{what} a line of some length, got none")

    def corners(self, grid: PixelGrid) -> FloatArray:
        """(k, 2) its point, ends or corners in the result's frame and unit."""
        given = np.array(self.line or self.polygon or [self.point], dtype=np.float64)
        return np.stack(grid.to_mm(given[:, 1], given[:, 0]), axis=1) if self.pixels else given


class GaugeReading(NamedTuple):
    """A value with its standard deviation."""

    value: float
    sd: float
    unit: str


Readings = dict[str, GaugeReading]
"""Readings by the name of the quantity."""


def read_gauges(path: Path | str) -> tuple[Gauge, ...]:
    """Read [[gauges]] from a TOML file; InputError if there are none, or one is wrong."""
    with reading(path, "gauges (TOML)", "write [[gauges]] with name and point, line or polygon"):
        tables = tomllib.loads(Path(path).read_text("utf-8-sig")).get("gauges")
    if not tables or isinstance(tables, dict):
        got = "[gauges]; write two brackets" if tables else "none"
        raise InputError(f"{path}: expected [[gauges]], got {got}")
    try:
        return distinct(made(Gauge, table) for table in tables)
    except InputError as error:
        raise InputError(f"{path}: gauges: {error}") from error


def distinct(gauges: Iterable[Gauge]) -> tuple[Gauge, ...]:
    """The gauges; InputError if two have the same name."""
    found = tuple(gauges)
    names = sorted(gauge.name for gauge in found)
    if twice := next((a for a, b in pairwise(names) if a == b), None):
        raise InputError(f"expected gauges of different names, got {twice!r} again")
    return found


def along_axes(gauges: Iterable[Gauge], angle: float) -> tuple[Gauge, ...]:
    """Gauges that read along a specimen's axes, where they have no angle; unchanged if it is 0."""
    return tuple(replace(g, angle=angle) if angle and g.angle is None and not g.line else g
                 for g in gauges)  # fmt: skip


def read_at(gauge: Gauge, result: NodalResult, unit: str = "mm") -> Readings:
    """Read a gauge in a displacement, with standard deviations (NaN if that has no roots).

    A point, and the mean over an area's material, give u, v, logarithmic strains, rotation
    (counter-clockwise), principal stretches, J. A line gives its length, the engineering strain l/L
    - 1 and the logarithmic strain of its ends, its turn, and the mean stretch along it less 1.
    InputError if a point or an end is beside the material, or no part of an area is on it.
    """
    points, (u, *du), (F, *dF) = _at(gauge, result)
    names: tuple[str, ...] = _LINE if gauge.line else _MEAN
    of = _of_line if gauge.line else _mean
    if gauge.angle is not None:
        axes = turned_axes(gauge.angle)
        F, *dF = (axes @ part @ axes.T for part in (F, *dF))
        names = tuple(name.translate(_TURNED) if "strain" in name else name for name in names)
    values, units = of(points, u, F), {"u": unit, "v": unit, "length": unit} | _DEGREES
    changes = [of(points, u + v, F + G) - of(points, u - v, F - G)
               for v, G in zip(du, dF, strict=True)]  # fmt: skip
    sd = 0.5 * np.linalg.norm(changes, axis=0) if changes else np.full(len(values), np.nan)
    read = zip(names, values, sd, strict=True)
    return {name: GaugeReading(float(v), float(d), units.get(name, "-")) for name, v, d in read}


def along(gauge: Gauge, result: NodalResult) -> FloatArray:
    """(k, 6) along a line: distance from its first end, x, y, u, v, stretch along it less 1."""
    points, (u, *_), (F, *_) = _at(gauge, result)
    s = np.linalg.norm(points - points[0], axis=1)
    return np.column_stack([s, points, u, _stretch(points, F) - 1.0])


_MEAN = ("u", "v", "strain_xx", "strain_yy", "strain_xy", "rotation", "stretch_1", "stretch_2", "J")
_TURNED = str.maketrans("xy", "12")
_LINE = ("length", "engineering_strain", "true_strain", "strain_along", "turn")


def _mean(points: FloatArray, u: FloatArray, F: FloatArray) -> FloatArray:
    strain = field_of("logarithmic", F).mean(axis=0)
    others = [field_of(name, F).mean() for name in ("rotation", "stretch_1", "stretch_2", "J")]
    return np.array([*u.mean(axis=0), strain[0, 0], strain[1, 1], strain[0, 1], *others])


def _of_line(points: FloatArray, u: FloatArray, F: FloatArray) -> FloatArray:
    before = points[-1] - points[0]
    length, now = np.linalg.norm(before), before + u[-1] - u[0]
    strain = np.linalg.norm(now) / length - 1.0
    turn = np.degrees(np.arctan2(before[0] * now[1] - before[1] * now[0], before @ now))
    mean = np.nanmean(_stretch(points, F)) - 1.0
    return np.array([length * (1.0 + strain), strain, np.log1p(strain), mean, turn])


def _stretch(points: FloatArray, F: FloatArray) -> FloatArray:
    """(p,) stretch along a line at its points [-]."""
    before = points[-1] - points[0]
    return np.asarray(np.linalg.norm(F @ (before / np.linalg.norm(before)), axis=1))


def points_of(gauge: Gauge, grid: PixelGrid, mesh: Mesh) -> FloatArray:
    """(p, 2) points where a gauge reads [mm]; a line's ends are the first and the last one.

    Of an area only those on the mesh. InputError if a point or an end is beside the material, or no
    part of an area is on it.
    """
    corners, pixel = gauge.corners(grid), grid.pixel_size
    if gauge.line:
        length = float(np.linalg.norm(corners[1] - corners[0]))
        share = np.linspace(0.0, 1.0, max(3, 1 + round(length / (_ALONG_PX * pixel))))
        points = corners[0] + share[:, None] * (corners[1] - corners[0])
    elif gauge.polygon:
        low, high = corners.min(axis=0), corners.max(axis=0)
        step = max(pixel, float(np.sqrt(np.prod(high - low) / _MOST_POINTS)))
        x, y = (np.arange(a + 0.5 * step, b, step) for a, b in zip(low, high, strict=True))
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        points = points[points_in_poly(points, corners)]  # type: ignore[no-untyped-call]
        if not len(points):
            raise InputError(f"gauge {gauge.name!r}: expected an area of 1 px or more, got less")
    else:
        points = corners
    on: BoolArray = located(mesh, points)[0] >= 0
    if gauge.polygon:
        points, on = points[on], on[on]
    if not (on.any() and on[0] and on[-1]):
        ends, names, more = mesh.nodes, ("x", "y"), ", y up; for [column, row] write pixels = true"
        if gauge.pixels:
            ends, names, more = np.column_stack(grid.to_px(*ends.T)), ("row", "column"), ""
        ranges = zip(names, ends.min(axis=0), ends.max(axis=0), strict=True)
        lies = " and ".join(f"{name} = {low:.4g} to {high:.4g}" for name, low, high in ranges)
        raise InputError(
            f"gauge {gauge.name!r}: expected it on the material, got it beside; the material lies "
            f"in {lies}{more}"
        )
    return np.asarray(points)


def _at(gauge: Gauge, result: NodalResult) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (p, 2); there u (1 + k, p, 2) and F (1 + k, p, 2, 2) of the result and its k roots."""
    points = points_of(gauge, result.grid, result.mesh)
    found = result.at(points, _nodal(result))
    F = np.moveaxis(found[..., 1:, :], -1, 0)
    F = np.concatenate([F[:1] + np.eye(2), F[1:]])
    return points, np.moveaxis(found[..., 0, :], -1, 0), F


@lru_cache(maxsize=1)
def _nodal(result: NodalResult) -> FloatArray:
    """(n, 2, 3, 1 + k) displacement and its roots at the nodes, each followed by its gradient."""
    u = result.displacement[..., None]
    u = u if result.roots is None else np.concatenate([u, result.roots], axis=2)
    slopes = nodal_gradient(result.mesh, u.reshape(len(u), -1)).reshape(*u.shape, 2)
    return np.moveaxis(np.concatenate([u[..., None], slopes], axis=-1), 2, -1)


def reading_rows(readings: Mapping[str, Mapping[str, Readings]]) -> list[dict[str, Any]]:
    """Convert what :func:`write_gauges` returns to rows ``image gauge reads value sd unit``."""
    return [
        {"image": image, "gauge": gauge, "reads": what, **reading._asdict()}
        for image, own in readings.items()
        for gauge, found in own.items() for what, reading in found.items()
    ]  # fmt: skip


def write_gauges(
    folder: Path, gauges: Sequence[Gauge], results: Iterable[tuple[str, NodalResult]], unit: str
) -> dict[str, dict[str, Readings]]:
    """Read gauges in every image's result; writes gauges.csv and, for lines, gauges_along.csv.

    Returns the readings, by the images' names, then by the gauges' names.
    """
    readings, lines = dict[str, dict[str, Readings]](), list[tuple[Any, ...]]()
    for name, result in results:
        readings[name] = {gauge.name: read_at(gauge, result, unit) for gauge in gauges}
        lines += [(name, gauge.name, *values) for gauge in gauges if gauge.line
                  for values in along(gauge, result)]  # fmt: skip
    rows = [
        {"image": image} | {f"{name} {of}{what} [{r.unit}]": number
         for name, found in own.items() for what, r in found.items()
         for of, number in zip(("", "sd "), r[:2], strict=True)}
        for image, own in readings.items()
    ]  # fmt: skip
    write_csv(folder / "gauges.csv", rows[0], (row.values() for row in rows))
    if lines:
        of_lengths = (f"{name} [{unit}]" for name in ("s", "x", "y up", "u", "v up"))
        heads = ("image", "gauge", *of_lengths, "strain_along [-]")
        write_csv(folder / "gauges_along.csv", heads, lines)
    return readings
