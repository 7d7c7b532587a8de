"""The minimum on one level of the pyramid: choice of pixels, and row subsampling to begin with.

The set of pixels is frozen while the cost is minimised: pixels that came and went with every
step would make the cost jump, and the iteration stagnate. It is chosen anew at the minimum.

If there are far more pixels than are needed to find the unknowns, the iteration first runs on one
row of a few, and hands over the curvature of the cost that it found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.solver.assembly import Assembly, NormalEquations, valid_pixels
from modeharvest.idic.solver.gauss_newton import (
    GaussNewtonOptions,
    Iteration,
    Minimum,
    Outcome,
    StepLength,
    minimise,
)
from modeharvest.idic.solver.noise import subsampled
from modeharvest.idic.solver.pyramid import Level, LevelPair
from modeharvest.idic.solver.weighting import Propagation, root
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import BoolArray, FloatArray

_ROUNDS, _SETTLED = 5, 1e-2
"""The pixels used are chosen anew at most 5 times, until less than 1 % of them change."""
_PLENTY, _STRIDE = 1000, 4
"""Pixels per unknown that suffice for a first iteration, and the stride of its rows."""
_EIGENVALUE_CUTOFF = 1e-3
"""On coarse levels, directions with an eigenvalue below this share of the largest one get no step
before the finest level: the blur of the images would lead them to other minima."""


@dataclass(frozen=True, eq=False)
class LevelSearch:
    """One level of a correlation."""

    pair: LevelPair
    ansatz: Ansatz
    level: Level
    finest: bool
    """Whether to solve for all unknowns to the full tolerance, or to lead to the next level."""
    options: GaussNewtonOptions
    on_iteration: Callable[[int], None]
    """Called with the number of each finished iteration."""

    def lower_cost(self, a: FloatArray, before: FloatArray) -> FloatArray:
        """Choose the unknowns of lower cost: the last level's, or those that it began with.

        A speckle that is too fine for a coarse blur leaves no information there, and the level
        leads to a wrong place; this undoes its steps.
        """
        if np.array_equal(a, before):
            return a
        some = self._thinned(self._all_pixels)
        costs = [self.equations(some, x, False).mean_square for x in (a, before)]
        return a if costs[0] <= costs[1] else before

    def minimum(self, start: FloatArray) -> tuple[Minimum, Assembly]:
        """Find the minimum, and the pixels that it was found with."""
        assembly = self.valid_assembly(start)
        history: tuple[Iteration, ...] = ()
        curvature = None
        some = self._thinned(assembly)
        if some is not assembly:
            rough = self._minimise(some, start, leads=True)
            history += rough.history
            if rough.outcome is Outcome.CONVERGED:
                if not self.finest:
                    return rough, some
                start = rough.unknowns
                curvature = rough.curvature * (assembly.runs.pixels / some.runs.pixels)
        for _ in range(_ROUNDS):
            found = self._minimise(assembly, start, curvature, leads=not self.finest)
            history += found.history
            used, start, curvature = assembly, found.unknowns, found.curvature
            if self.pair.valid is None:
                break
            assembly = self.valid_assembly(start)
            if np.count_nonzero(assembly.mask != used.mask) <= _SETTLED * assembly.runs.pixels:
                break
        return replace(found, history=history), used

    def reweighed(
        self, found: Minimum, used: Assembly, instrument: NDArray[Any]
    ) -> tuple[Minimum, Propagation]:
        """Iterate from the minimum to the root of h'r = 0, with weights h by an instrument.

        ``used`` are the minimum's pixels, the instrument is (3, rows, cols) as for
        :meth:`Assembly.images`.
        """
        images = self.pair.reference, self.pair.deformed

        def matrix(share: float) -> FloatArray:
            return used.images(found.unknowns, *images, True, instrument, share).matrix

        def evaluate(a: FloatArray) -> NormalEquations:
            return used.images(a, *images, False, instrument)

        how = Propagation.of(matrix, found.equations.matrix)
        length = step_length(self.ansatz, used.grid, used.mask, self.level.factor)
        there = root(evaluate, how.slope, length, found, self.options, self.on_iteration)
        return there, how

    def valid_assembly(self, a: FloatArray) -> Assembly:
        """All pixels, less those that these unknowns map onto no material, or off the image."""
        pair = self.pair
        if pair.valid is None:
            return self._all_pixels
        kept, outside = valid_pixels(self._all_pixels, a, pair.reference, pair.deformed, pair.valid)
        return replace(self._all_pixels, mask=kept, outside=outside)

    @cached_property
    def _all_pixels(self) -> Assembly:
        return Assembly(self.ansatz, self.pair.grid, self.pair.mask)

    def _thinned(self, assembly: Assembly) -> Assembly:
        """Take one row in four, if that leaves plenty of pixels; otherwise all."""
        if assembly.runs.pixels < _STRIDE * _PLENTY * self.ansatz.size:
            return assembly
        rows = np.zeros_like(assembly.mask)
        rows[_STRIDE // 2 :: _STRIDE] = assembly.mask[_STRIDE // 2 :: _STRIDE]
        return replace(assembly, mask=rows, outside=assembly.outside // _STRIDE)

    def _minimise(
        self,
        assembly: Assembly,
        start: FloatArray,
        curvature: FloatArray | None = None,
        *,
        leads: bool,
    ) -> Minimum:
        """Minimise to the full tolerance, or with ``leads`` to a coarse one.

        The allowed share of pixels outside the image refers to the whole material: pixels left out
        at g's border and at its holes must not count as if they were outside.
        """
        limits, factor = self.options, self.level.factor
        rows = np.diff(assembly.runs.row_start) > 0 if assembly.runs.pixels else slice(None)
        material = max(1, np.count_nonzero(self.pair.mask[rows]))
        kept = (assembly.runs.pixels + assembly.outside) / material
        most = min(1.0, limits.max_outside / kept) if kept > 0 else limits.max_outside
        tolerance = limits.coarse_tolerance_px * factor if leads else limits.tolerance_px
        return minimise(
            partial(self.equations, assembly),
            step_length(self.ansatz, assembly.grid, assembly.mask, factor),
            start,
            replace(limits, max_outside=most, tolerance_px=tolerance),
            factor,
            self.on_iteration,
            curvature,
            0.0 if self.finest else _EIGENVALUE_CUTOFF,
        )

    def equations(self, assembly: Assembly, a: FloatArray, with_matrix: bool) -> NormalEquations:
        """Normal equations of the pair's images at unknowns (n,), with their matrix or without."""
        return assembly.images(a, self.pair.reference, self.pair.deformed, with_matrix)


def step_length(ansatz: Ansatz, grid: PixelGrid, mask: BoolArray, factor: int) -> StepLength:
    """Rms difference of two displacements over some 10^4 of the pixels [px of the full image].

    The mask (rows, cols) says which pixels count; a binned px is ``factor`` px.
    """
    rows, cols, some = subsampled(mask)
    x, y = grid.x[cols], grid.y[rows]
    per_px = factor / grid.pixel_size

    @lru_cache(maxsize=2)
    def displacement(a: bytes) -> FloatArray:
        """Cached: the end of a step is the beginning of the next one."""
        return ansatz.displacement(np.frombuffer(a), x, y)

    def length(a: FloatArray, b: FloatArray) -> float:
        change = displacement(b.tobytes()) - displacement(a.tobytes())
        squares = (change[some] ** 2).sum(axis=-1)
        return float(np.sqrt(squares.mean()) * per_px) if squares.size else 0.0

    return length
