"""Convention checks: axes, signs, units and origin of a displacement field against the truth.

A DIC code's output can be misread in many ways, several at once: y up for y down, u and v or rows
and columns exchanged, a wrong sign, deformed for reference positions, another origin, px for mm.
All combinations are compared with the truth. A combination is reported only if it makes the errors
significantly smaller than the declared convention does, and if it removes the whole effect that it
should explain. Other errors (noise, bias, too small a strain) are thus not taken for a convention.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from modeharvest.idic.local.field import LocalField
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

Truth = Callable[[FloatArray, FloatArray], FloatArray]
"""(n, 2) true displacement [mm] at positions x, y (n,) [mm]; NaN outside the material."""

_POINTS = 4000
"""Number of points compared, a quarter of them in the first selection."""
_BLOCKS = 5
"""Blocks along each axis: errors are correlated within, but assumed independent between blocks."""
_FEWEST_BLOCKS = 8
_CHANCE = 1e-7
"""Probability of rejecting a correct field, for each of some 1500 readings [-]."""
_SMALL_PX = 1e-3
"""A smaller reduction of the mean error is ignored [px]."""
_INEXACT = 0.1
"""Deviation, beyond chance, allowed between errors and the effect of a reading [-]: a tenth, since
also displacements that are 10 % too small may be declared wrongly."""
_KEPT = 6
"""Number of readings examined more closely."""

_KEEP = np.eye(2)
_TURN = np.diag([1.0, -1.0])
_EXCHANGE_UP = np.array([[0.0, 1.0], [1.0, 0.0]])
_EXCHANGE_DOWN = -_EXCHANGE_UP
_OTHER_SIGN = "u and v had the other sign"
_COMPONENTS = (
    (_KEEP, 0, ""),
    (-_KEEP, 1, _OTHER_SIGN),
    (_TURN, 1, "v had the other sign"),
    (-_TURN, 1, "u had the other sign"),
    (_EXCHANGE_UP, 1, "u and v (up) were exchanged"),
    (_EXCHANGE_DOWN, 1, "u and v (down) were exchanged"),
    (_TURN @ _EXCHANGE_UP, 2, "u and v were v and -u (y up)"),
    (-_TURN @ _EXCHANGE_UP, 2, "u and v were -v and u (y up)"),
)
"""Possible meanings of u and v in the physical frame: matrix, number of changes, text."""


@dataclass(frozen=True, eq=False)
class Reading:
    """An interpretation of a field's numbers, relative to the declared one."""

    turn: FloatArray
    shift: FloatArray
    """(2, 2) [-] and (2,) [mm]: positions are ``turn @ (x, y) + shift``."""
    origin: FloatArray
    """(2,) further shift of the positions, of the origin [mm]."""
    components: FloatArray
    """(2, 2): displacements are ``scale * components @ (u, v)``."""
    scale: float = 1.0
    """Factor due to a wrong unit [-]."""
    deformed: bool = False
    """Whether the positions are those in the deformed image."""
    changes: int = 0
    """Number of wrong declarations."""
    text: tuple[str, ...] = ()
    """Text on each of them; empty for the field as declared."""

    def with_change(self, count: int, text: str, **values: Any) -> Reading:
        """The same reading with another change, or several connected ones."""
        changed = replace(self, **values)
        known = (*self.text, text) if text else self.text
        return replace(changed, changes=self.changes + count, text=known)

    @property
    def orientation(self) -> tuple[float, ...]:
        """All its numbers except the origin."""
        how = (*self.components.ravel(), self.scale, self.deformed)
        return (*self.turn.ravel(), *self.shift, *how)

    @property
    def place(self) -> tuple[float, ...]:
        """All numbers that its positions depend on."""
        moved = (*self.turn.ravel(), *(self.shift + self.origin))
        return (*moved, *self.components.ravel(), self.scale) if self.deformed else moved

    def applied(
        self, x: FloatArray, y: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Positions x, y (n,) and displacements (n, 2) according to this reading [mm]."""
        u = self.scale * u @ self.components.T
        x, y = self.turn @ np.stack([x, y]) + (self.shift + self.origin)[:, None]
        return (x - u[:, 0], y - u[:, 1], u) if self.deformed else (x, y, u)


DECLARED = Reading(_KEEP, np.zeros(2), np.zeros(2), _KEEP)
"""The reading that changes nothing."""


def check_conventions(
    field: LocalField, truth: Truth, grid: PixelGrid
) -> tuple[Reading, tuple[str, ...]]:
    """Find the reading of a field: as declared, or the fewest changes that explain its errors.

    ``field``: as declared; ``grid``: the reference image's pixels. Returns the reading and a text
    about it (no text for the declared reading, or with too few points). InputError if the
    displacements are in pixels but declared as millimetres, or the reverse.
    """
    every = field.valid_points()
    some = np.linspace(0, len(every[0]) - 1, min(len(every[0]), _POINTS)).astype(int)
    sample = _FieldSample([values[some] for values in every], truth, grid.pixel_size)
    if len(sample.x) < 4 * _FEWEST_BLOCKS or not np.isfinite(sample.cap):
        return DECLARED, ()
    candidates = [DECLARED, *_promising(sample, grid)]
    best = min(candidates, key=sample.cost)
    simplest = sorted(candidates, key=lambda reading: (reading.changes, sample.cost(reading)))
    meant = next(r for r in simplest if r is best or not sample.is_rejected(r, best))
    if meant is DECLARED or not sample.is_rejected(DECLARED, meant):
        return DECLARED, ()
    before, after = (sample.median_px(reading) for reading in (DECLARED, meant))
    text = " and ".join(meant.text)
    gain = f"the median error of {before:.3g} px would be {after:.3g} px if {text}"
    if meant.scale != 1.0:
        raise InputError(
            f"{field.source}: expected displacements in the declared unit, got "
            f"{1 / meant.scale:.4g} times the true ones; {gain} (a pixel is "
            f"{grid.pixel_size} mm); declare what the file holds"
        )
    return meant, (f"{field.source}: {gain}; check what the file holds",)


def _orientations(grid: PixelGrid) -> list[Reading]:
    """All transformations of axes of positions and displacements, those with few changes first."""
    found: dict[tuple[float, ...], Reading] = {}
    turned = [DECLARED, *_turned_positions(grid)]
    for reading, (matrix, changes, text) in itertools.product(turned, _COMPONENTS):
        both = reading.with_change(changes, text, components=matrix @ reading.components)
        key = tuple(np.round(both.orientation, 9))
        if key not in found or both.changes < found[key].changes:
            found[key] = both
    return list(found.values())


def _turned_positions(grid: PixelGrid) -> Iterator[Reading]:
    """Readings with y reversed, or rows and columns exchanged; in px or mm, y up or down."""
    zero, first = np.zeros(2), np.array([grid.x0, grid.y0])
    low = first - [0.0, (grid.rows - 1) * grid.pixel_size]
    middle = 0.5 * (first + low)
    flipped, exchanged = "the y axis pointed the other way", "rows and columns were exchanged"
    both, pairs = f"{exchanged} and {flipped}", ((first, low), (low, first), (zero, zero))
    for matrix, changes, centres, text in (  # centres: (before, after), for each assumed origin
        (_TURN, 1, ((middle, middle), (zero, zero)), flipped),
        (_EXCHANGE_DOWN, 1, ((first, first), (zero, zero)), exchanged),
        (_EXCHANGE_UP, 1, ((low, low), (zero, zero)), "x and y (up) were exchanged"),
        (_TURN @ _EXCHANGE_UP, 2, pairs, both),
        (-_TURN @ _EXCHANGE_UP, 2, pairs, both),
    ):
        for before, after in centres:
            turned = replace(DECLARED, turn=matrix, shift=after - matrix @ before)
            yield turned.with_change(changes, text, components=matrix)
            yield turned.with_change(changes, f"{text}, of positions only")


def _far_origins(grid: PixelGrid) -> Iterator[tuple[FloatArray, str]]:
    """Other possible origins of positions: shift (2,) [mm], and text."""
    first, last = (np.array(grid.to_mm(*at)) for at in ((0, 0), (grid.rows - 1, grid.cols - 1)))
    yield first, "positions were counted from the upper left pixel"
    yield np.array([first[0], last[1]]), "positions were counted from the lower left pixel"
    half = 0.5 * (last - first)
    for shift in (half, half * [1, -1]):
        yield shift, "positions were counted from the image's centre"


def _near_origins(grid: PixelGrid) -> Iterator[tuple[FloatArray, str]]:
    """Other possible coordinates of the first pixel's centre: shift (2,) [mm], and text."""
    for number, y_down in itertools.product((0.5, 1.0, -0.5, -1.0), (1.0, -1.0)):
        shift = -number * grid.pixel_size * np.array([1.0, -y_down])
        called = f"({number:g}, {number:g})" + (" (y up)" if y_down < 0 else "")
        yield shift, f"the first pixel's centre were {called} in the file's count from the declared"


def _promising(sample: _FieldSample, grid: PixelGrid) -> list[Reading]:
    """The readings with the smallest errors, and readings that differ little from them.

    First, readings with large effects are compared at a few points. To the best of them, changes
    with smaller effects are added: deformed positions, then the first pixel.
    """
    few, turned = sample.every(4), _orientations(grid)
    turned += [
        reading.with_change(1, text, origin=shift)
        for reading, (shift, text) in itertools.product(turned, _far_origins(grid))
    ]
    best = few.best(turned)
    for factor, text in (
        (1.0 / grid.pixel_size, "mm had been declared as pixels"),
        (grid.pixel_size, "pixels had been declared as mm"),
    ):
        if abs(np.log(factor)) > 0.1:
            best += few.best([reading.with_change(1, text, scale=factor) for reading in turned])
    best += [_in_deformed_positions(reading) for reading in (DECLARED, *best)]
    return best + [
        reading.with_change(1, text, origin=reading.origin + shift)
        for reading in (DECLARED, *sample.best(best))
        for shift, text in _near_origins(grid)
    ]


def _in_deformed_positions(reading: Reading) -> Reading:
    """The reading with deformed positions; with the sign reversed, it describes the way back."""
    back = "u led from the deformed image back to the reference"
    if _OTHER_SIGN in reading.text:
        rest = tuple(text for text in reading.text if text != _OTHER_SIGN)
        return replace(reading, deformed=True, text=(*rest, back))
    return reading.with_change(1, "the positions were those of the deformed image", deformed=True)


class _FieldSample:
    """A sample of a field's points, to compute the errors of readings.

    ``points``: x, y (n,) and u (n, 2) as declared [mm]; ``unit``: size of a pixel [mm].
    """

    def __init__(self, points: Sequence[FloatArray], truth: Truth, unit: float) -> None:
        self.truth, self.unit = truth, unit
        self.x, self.y, self.u = points
        self.block = _blocks(self.x, self.y)
        self._known: dict[tuple[float, ...], FloatArray] = {}
        length = _length(self.errors(DECLARED))
        self.cap = 3.0 * float(np.nanmedian(length)) if np.isfinite(length).any() else np.inf

    def every(self, step: int) -> _FieldSample:
        """A sample of every ``step``-th point."""
        step = step if len(self.x) > _POINTS // step else 1
        points = [values[::step] for values in (self.x, self.y, self.u)]
        return _FieldSample(points, self.truth, self.unit)

    def look_up(self, readings: Sequence[Reading]) -> None:
        """Compute the truth for many readings at once, which is faster than one by one."""
        by_place = {reading.place: reading for reading in readings}
        new = {place: r for place, r in by_place.items() if place not in self._known}
        if new:
            places = [reading.applied(self.x, self.y, self.u)[:2] for reading in new.values()]
            true = self.truth(*np.concatenate(places, axis=1))
            self._known |= dict(zip(new, np.split(true, len(new)), strict=True))

    def errors(self, reading: Reading) -> FloatArray:
        """(n, 2) numbers in the file minus those the truth would give with the reading [px].

        So the noise in the errors is the same for all readings, also those that scale
        displacements. NaN where the reading puts a point outside the material.
        """
        self.look_up([reading])
        written = self._known[reading.place] @ reading.components / reading.scale
        return np.asarray((self.u - written) / self.unit)

    def cost(self, reading: Reading) -> float:
        """Mean length of the errors, each capped; the cap for points outside the material [px]."""
        length = np.nan_to_num(_length(self.errors(reading)), nan=np.inf)
        return float(np.minimum(length, self.cap).mean())

    def best(self, readings: Sequence[Reading]) -> list[Reading]:
        """The readings with the smallest errors."""
        self.look_up(readings)
        return sorted(readings, key=self.cost)[:_KEPT]

    def median_px(self, reading: Reading) -> float:
        """Median length of the displacement's error on the material [px]."""
        return reading.scale * float(np.nanmedian(_length(self.errors(reading))))

    def is_rejected(self, one: Reading, other: Reading) -> bool:
        """Whether the errors of ``one`` significantly contain its difference from ``other``.

        The errors e of ``one`` are fitted by c d, where d is the difference of the readings: c is 0
        if ``one`` is right, 1 if ``other`` is. c must be 1 also without the affine parts of e and
        d, as a lens or a tilted camera causes affine errors. A mere difference of origin is
        distinguished from a bias by the variation of the motion between points.
        """
        mine, others = self.errors(one), self.errors(other)
        known = np.isfinite(mine - others).all(axis=1)
        if not np.isfinite(others).any() or not self.cost(one) - self.cost(other) > _SMALL_PX:
            return False
        if not known.any():
            return True  # only the other reading puts points on the material
        mine, others, block = mine[known], others[known], self.block[known]
        if one.orientation == other.orientation:
            mine, others = (error - np.median(error, axis=0) for error in (mine, others))
        blocks = len(np.unique(block))
        if blocks < _FEWEST_BLOCKS:
            return False
        size = np.minimum(_length(mine), _length(others))
        bound = 3.0 * float(np.median(size)) + 1e-9
        weight = bound / np.maximum(size, bound)  # low weight for outliers
        share, sd = _share(mine, mine - others, weight, block)
        affine = np.column_stack([np.ones(len(block)), self.x[known], self.y[known]])
        mine, others = (_less(error, affine, weight) for error in (mine, others))
        varying, its_sd = _share(mine, mine - others, weight, block)
        return bool(
            share > sd * stats.t.isf(_CHANCE, blocks - 1)
            and abs(share - 1.0) < _INEXACT + 3.0 * sd
            and abs(varying - 1.0) < _INEXACT + 3.0 * its_sd
        )


def _share(
    error: FloatArray, effect: FloatArray, weight: FloatArray, block: NDArray[np.intp]
) -> tuple[float, float]:
    """Share of an effect in errors (n, 2) [-], and its standard error from the blocks' scatter."""
    along, square = (
        np.bincount(block, weight * (either * effect).sum(axis=1)) for either in (error, effect)
    )
    if not square.sum() > 0.0:
        return 0.0, np.inf
    share = along.sum() / square.sum()
    return share, float(np.sqrt(((along - share * square) ** 2).sum()) / square.sum())


def _less(error: FloatArray, columns: FloatArray, weight: FloatArray) -> FloatArray:
    """(n, 2) residual of a weighted fit of errors by columns (n, m)."""
    root = np.sqrt(weight)[:, None]
    return error - columns @ np.linalg.lstsq(root * columns, root * error, rcond=None)[0]


def _blocks(x: FloatArray, y: FloatArray) -> NDArray[np.intp]:
    """(n,) number of each point's block; blocks have four points or more on average."""
    side = max(1, min(_BLOCKS, int(np.sqrt(len(x) / 4))))
    col, row = (
        np.minimum((side * (at - at.min()) / max(np.ptp(at), 1e-300)).astype(int), side - 1)
        for at in (x, y)
    )
    return np.asarray(row * side + col)


def _length(error: FloatArray) -> FloatArray:
    return np.hypot(error[:, 0], error[:, 1])
