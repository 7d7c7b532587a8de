"""Normal equations of an ansatz from moments; residuals and warped images of the same pixels.

The unknowns of the ansatz are a linear combination of *primitives*: a base field times a
product of Chebyshev polynomials (see :mod:`modeharvest.idic.solver.passes`). From
T_a T_b = (T_(a+b) + T_|a-b|)/2 the matrix of the primitives follows from the moments, and the
mode families then make from it the matrix of the unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations_with_replacement, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import orders
from modeharvest.idic.modes import PER_WAVE
from modeharvest.idic.solver.passes import (
    Runs,
    Warped,
    accumulate,
    push_forward_rows,
    runs_of,
    tables_of,
)
from modeharvest.idic.solver.pixel_blocks import IMAGES, Target
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.compiled import in_parallel, readable
from modeharvest.util.errors import InputError

BANDS = 64
"""Bands of rows; fixed, so that sums don't depend on the number of threads."""


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The quadratic model of the cost 1/2 sum r^2 around some unknowns."""

    matrix: FloatArray
    """(n, n): J'J, where J is minus the derivative of the residual; zero if not requested."""
    gradient: FloatArray
    """(n,): -J'r, the derivative of the cost."""
    cost: float
    """1/2 sum r^2 over the pixels used."""
    pixels: int
    """Number of pixels used; a displacement fit counts its two components as two."""
    outside_image: int
    """Number of pixels whose deformed position is outside the image."""

    @property
    def mean_square(self) -> float:
        """Mean of r^2 over the pixels used; infinite if there is none."""
        return 2.0 * self.cost / self.pixels if self.pixels else float("inf")

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(
            self.matrix + other.matrix, self.gradient + other.gradient, self.cost + other.cost,
            self.pixels + other.pixels, self.outside_image + other.outside_image,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Assembly:
    """What is constant during the iteration: ansatz, pixels and tables."""

    ansatz: Ansatz
    grid: PixelGrid
    mask: BoolArray
    """(rows, cols) True where there is material."""
    outside: int = 0
    """Number of further pixels that were mapped outside the deformed image when the pixels were
    chosen: they take no part, but count as having left."""

    def __post_init__(self) -> None:
        if self.mask.shape != self.grid.shape:
            raise InputError(
                f"expected a mask of {self.grid.shape} px like the grid, got {self.mask.shape}"
            )

    @cached_property
    def runs(self) -> Runs:
        """The runs of the pixels that count."""
        return runs_of(self.mask)

    @cached_property
    def _degrees(self) -> list[int]:
        """Total degree of the products that multiply each base field."""
        ansatz = self.ansatz
        d = [ansatz.v0_degree] * 2
        d += [ansatz.v_degree] * len(ansatz.modes)
        for mode in ansatz.modes:
            d += [0, 0, 1] * mode.family.wave_count
        return [*d, *ansatz.brightness.degrees, 0]

    def _pairs(self, with_matrix: bool, component: int) -> NDArray[np.int64]:
        """Pairs of base fields that aren't zero; without the matrix only those of the residual."""
        d = self._degrees
        last, first_wave = len(d) - 1, 2 + len(self.ansatz.modes)
        # What is made of the other component's gradient is zero where a displacement is fitted.
        zero = {1 - component, *range(first_wave + 1 - component, last, 3)}
        own = [e for e in range(len(d)) if component == IMAGES or e not in zero]
        pairs = combinations_with_replacement(own, 2)
        return np.array([(e, k, d[e] + d[k]) for e, k in pairs if with_matrix or k == last])

    @cached_property
    def _primitive_slices(self) -> list[slice]:
        ends = np.cumsum([0] + [(d + 1) * (d + 2) // 2 for d in self._degrees])
        return [slice(a, b) for a, b in pairwise(ends.tolist())]

    @cached_property
    def _to_unknowns(self) -> FloatArray:
        """(primitives, unknowns): combination of primitives that is each unknown's sensitivity."""
        ansatz, parts = self.ansatz, self._primitive_slices
        result = np.zeros((parts[-1].start, ansatz.size))
        slow = ansatz.phi_offset(0)
        result[:slow, :slow] = np.eye(slow)
        (xc, yc), (hx, hy) = ansatz.domain.centre, ansatz.domain.half
        k = 2 + len(ansatz.modes)
        for i, mode in enumerate(ansatz.modes):
            for w in range(mode.family.wave_count):
                wave = np.zeros((5, PER_WAVE))  # rows: sin gx, sin gy, then T00, T10, T01 of cos
                wave[0, 0] = wave[1, 1] = 1.0
                wave[2:, 2] = xc, hx, 0.0
                wave[2:, 3] = yc, 0.0, hy
                wave[2, 4] = 1.0
                rows = slice(parts[k].start, parts[k + 2].stop)
                family = mode.family.matrix[PER_WAVE * w : PER_WAVE * (w + 1)]
                result[rows, ansatz.phi_slice(i)] = wave @ family
                k += 3
        kinematic = ansatz.phi_offset(len(ansatz.modes))
        result[parts[k].start :, kinematic:] = np.eye(ansatz.size - kinematic)
        return result

    def images(
        self, a: FloatArray, reference: NDArray[Any], deformed: SplineImage,
        with_matrix: bool = True, instrument: NDArray[Any] | None = None, share: float = 1.0,
        runs: Runs | None = None,
    ) -> NormalEquations:  # fmt: skip
        """Assemble the normal equations of r = f(x) - g(x + u(x, a)), the paper's Eq. (2).

        With brightness among the unknowns r = f - (1 + b) g(x + u) - c.

        a, reference, deformed : (size,) unknowns, f (rows, cols) in float32 or float64, and g.
        with_matrix : Without the matrix the pass costs about half as much.
        instrument : (3, rows, cols) in place of (1 + b) times the gradient of g at x + u, along x
            and y [grey levels/mm], and of g there. Matrix and gradient are h'h and -h'r then, with
            h its products with the derivatives of the displacement and of the gain.
        share : Share of the instrument in h; the rest is g's own [-].
        runs : The pixels that count; by default all those of the mask.
        """
        target = Target.images(reference, deformed, self.grid, instrument, share)
        return self._assemble(a, target, with_matrix, runs or self.runs)

    def displacement(
        self, a: FloatArray, target: NDArray[Any], with_matrix: bool = True
    ) -> NormalEquations:
        """Assemble the normal equations of r = target - u(a), both components.

        The target is a displacement (rows, cols, 2) [mm].
        """
        known = np.asarray(target, dtype=np.float64)
        along = (Target.along(c, known[..., c], self.grid) for c in (0, 1))
        x, y = (self._assemble(a, field, with_matrix, self.runs) for field in along)
        return x + y

    def _assemble(
        self, a: FloatArray, target: Target, with_matrix: bool, runs: Runs
    ) -> NormalEquations:
        pairs, degrees = self._pairs(with_matrix, target.component), self._degrees
        top = max(int(pairs[:, 2].max()), *degrees) + 1
        moments = np.zeros((BANDS, len(pairs), top, top))
        off = self.pass_over(a, target, runs, pairs, len(degrees), moments, Warped())
        return self._from_moments(pairs, moments.sum(axis=0), runs.pixels - off, off)

    def pass_over(
        self, a: FloatArray, target: Target, runs: Runs, pairs: NDArray[np.int64], fields: int,
        moments: FloatArray, warped: Warped,
    ) -> int:  # fmt: skip
        """Fill moments or ``warped`` by :func:`accumulate`; returns how many pixels are outside."""
        warped, outside = warped._replace(valid=readable(warped.valid)), np.zeros(BANDS, np.int64)
        tables = tables_of(self.ansatz, self.grid, self.ansatz.checked(a))
        in_parallel(accumulate, target, runs, tables, pairs, fields, moments, outside, warped)
        return int(outside.sum())

    def _from_moments(
        self, pairs: NDArray[np.int64], moments: FloatArray, used: int, off: int
    ) -> NormalEquations:
        parts, degrees = self._primitive_slices, self._degrees
        matrix = np.zeros((parts[-1].stop, parts[-1].stop))
        for (e, k, _), moment in zip(pairs, moments, strict=True):
            matrix[parts[e], parts[k]] = _products(moment, degrees[e], degrees[k])
            matrix[parts[k], parts[e]] = matrix[parts[e], parts[k]].T
        to, left = self._to_unknowns, self.outside + off
        return NormalEquations(
            to.T @ matrix[:-1, :-1] @ to, -to.T @ matrix[:-1, -1], 0.5 * matrix[-1, -1], used, left
        )


def _products(moment: FloatArray, degree: int, other: int) -> FloatArray:
    """Sum e e' (T_i T_j)(T_k T_l) for all (i, j) and (k, l), from the moments of e e'."""
    a, b, c, d = _sums_and_differences(degree, other)
    return np.asarray(0.25 * (moment[a, c] + moment[a, d] + moment[b, c] + moment[b, d]))


@cache
def _sums_and_differences(degree: int, other: int) -> tuple[NDArray[np.int64], ...]:
    """Give i + k, |i - k|, j + l and |j - l| for all (i, j) and (k, l)."""
    i, j = np.array(orders(degree)).T[:, :, None]
    k, m = np.array(orders(other)).T[:, None, :]
    return i + k, abs(i - k), j + m, abs(j - m)


def valid_pixels(
    assembly: Assembly,
    a: FloatArray,
    reference: NDArray[Any],
    deformed: SplineImage,
    valid: BoolArray,
) -> tuple[BoolArray, int]:
    """Keep the pixels that the unknowns map onto material of the deformed image.

    Returns (rows, cols) True on those that are kept, and the number of the others that are mapped
    outside the deformed image. ``valid``: where g may be sampled.
    """
    warped = Warped(valid=valid, kept=assembly.mask.copy())
    return warped.kept, _warp(assembly, a, reference, deformed, warped)


def residual(
    assembly: Assembly, a: FloatArray, reference: NDArray[Any], deformed: SplineImage
) -> NDArray[np.float32]:
    """(rows, cols) f - (1 + b) g(x + u) - c; NaN where no pixel counts or g doesn't reach."""
    left = np.full((1, *assembly.grid.shape), np.nan, dtype=np.float32)
    _warp(assembly, a, reference, deformed, Warped(fields=left))
    return np.asarray(left[0])


def warped_back(
    assembly: Assembly, a: FloatArray, reference: NDArray[Any], deformed: SplineImage
) -> NDArray[np.float32]:
    """(3, rows, cols) (1 + b) times the gradient of g at x + u, along x and y, and (1 + b) g + c.

    The gradient in [grey levels/mm]; 0, and f, where no pixel counts or g doesn't reach.
    """
    found = np.zeros((3, *assembly.grid.shape), dtype=np.float32)
    _warp(assembly, a, reference, deformed, Warped(fields=found))
    np.subtract(reference, found[2], out=found[2])
    return found


def push_forward(assembly: Assembly, a: FloatArray, slopes: NDArray[np.float32]) -> None:
    """Push slopes at X forward to x = X + u: multiply them by F^-T, in place.

    F by central differences of u between neighbouring pixels; pixels that don't count are
    transformed, too. The slopes are (2 or more, rows, cols), along x and y first.
    """
    everywhere = Assembly(assembly.ansatz, assembly.grid, np.ones(assembly.grid.shape, np.bool_))
    u = np.zeros((2, *assembly.grid.shape), dtype=np.float32)
    _warp(everywhere, a, slopes[0], SplineImage.of(np.zeros((2, 2))), Warped(fields=u))
    in_parallel(push_forward_rows, u, slopes, assembly.grid.pixel_size)


def _warp(
    assembly: Assembly, a: FloatArray, reference: NDArray[Any], deformed: SplineImage,
    warped: Warped,
) -> int:  # fmt: skip
    """Fill ``warped``; returns how many pixels are mapped outside the image."""
    ansatz, no_pairs = assembly.ansatz, np.zeros((0, 3), dtype=np.int64)
    target = Target.images(reference, deformed, assembly.grid)
    top = 1 + max(ansatz.v0_degree, ansatz.v_degree, *ansatz.brightness.degrees, 1)
    moments = np.zeros((BANDS, 0, top, top))
    return assembly.pass_over(a, target, assembly.runs, no_pairs, 3, moments, warped)
