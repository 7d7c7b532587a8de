"""Value and gradient of an image between its pixels, by B-splines of order 3, 5 or 11.

The image is prefiltered once, so that the spline passes through every pixel: a recursive filter
runs over each line, forwards and backwards, for every pole; the mirrored border makes it exact.
A sample uses 16, 36 or 144 coefficients. Speckle below 6 px: docs/explanation/metrology.md.

Compilers vectorise loops over many points, but here neighbouring points read from different
places. The taps of a row are vectorised instead: the four of a cubic spline as a vector, the six of
a quintic spline as a vector of eight whose last two weights are zero, the twelve of a spline of
order 11 as a vector of sixteen. LLVM splits them if the machine's vectors are shorter.

Source: Unser, Aldroubi, Eden 1993, doi 10.1109/78.193220 (poles, initial values).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import comb, factorial
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types as numba_types
from numba.core import cgutils as numba_cgutils
from numba.extending import intrinsic
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from modeharvest.util.arrays import FloatArray
from modeharvest.util.compiled import compiled, in_parallel
from modeharvest.util.errors import InputError

ORDERS = (3, 5, 11)
"""Available spline orders."""


@cache
def poles(order: int) -> FloatArray:
    """Roots inside the unit circle of the z-transform of a B-spline's samples, largest first."""
    if order not in ORDERS:
        raise InputError(f"expected a spline of order 3, 5 or 11, got {order}")
    knots = np.arange(order + 2.0)
    samples = BSpline.basis_element(knots)(knots[1:-1])
    polynomial = np.polynomial.Polynomial(samples)
    roots = polynomial.roots().real
    found: FloatArray = roots[abs(roots) < 1.0]
    for _ in range(3):  # Newton steps: roots from an eigenvalue problem have lost digits
        found = found - polynomial(found) / polynomial.deriv()(found)
    return np.asarray(np.sort(found))


_LINES = 16
"""Lines filtered side by side: two vectors of float64."""
_NEGLIGIBLE = 1e-18


def border_reach(order: int, share: float) -> int:
    """Distance from an image's border at which the effect of its mirroring falls to ``share`` [px].

    The effect decreases with every pixel by the factor of the largest pole, 0.27, 0.43 or 0.66;
    ``share`` is relative to the effect at the border itself [-].
    """
    return int(np.ceil(np.log(share) / np.log(abs(poles(order)).max())))


def spline_coefficients(image: NDArray[Any], order: int, pad: int) -> NDArray[Any]:
    """Coefficients of the spline of order 3, 5 or 11 that passes through every pixel.

    Shape (rows + 2 pad, cols + 2 pad), type of the image; the recursion runs in float64. The
    image (rows, cols), float32 or float64, at least 2 x 2, is mirrored about its outermost
    pixels; so are the coefficients, of which ``pad`` rows and columns are added on each side.
    """
    rows, cols = image.shape
    padded = np.pad(image, pad)
    interior = padded[pad : pad + rows, pad : pad + cols]
    z = poles(order)
    gain = float(np.prod((1.0 - z) * (1.0 - 1.0 / z)))
    in_parallel(_filter_columns, interior, z, _mirrored(z, rows), gain)
    in_parallel(_filter_columns, interior.T, z, _mirrored(z, cols), gain)
    _pad_mirrored(padded, pad)
    return padded


def _mirrored(poles: FloatArray, n: int) -> FloatArray:
    """(poles, taps) weights of a line's first values in the first value of the filtered line.

    The line of n values is mirrored at both ends, so that it has a period of 2 n - 2.
    """
    taps = min(n, int(np.log(_NEGLIGIBLE) / np.log(abs(poles).max())) + 1)
    k, z = np.arange(taps), poles[:, None]
    weights = z**k
    again = (k > 0) & (k < n - 1)
    weights[:, again] += z ** (2 * n - 2 - k[again])
    return np.asarray(weights / (1.0 - z ** (2 * n - 2)))


@compiled(inner=True, relaxed=True)
def _filter(lines: Any, n: int, poles: Any, first: Any, gain: float) -> None:
    """Filter lines[:n, :] along its first axis, all columns together."""
    width = lines.shape[1]
    start = np.empty(width)
    for p in range(poles.size):
        z = poles[p]
        start[:] = 0.0
        for k in range(first.shape[1]):
            for m in range(width):
                start[m] += first[p, k] * lines[k, m]
        # One by one: array assignment includes error messages that take a second to compile.
        for m in range(width):
            lines[0, m] = start[m]
        for i in range(1, n):
            for m in range(width):
                lines[i, m] += z * lines[i - 1, m]
        end = z / (z * z - 1.0)
        for m in range(width):
            lines[n - 1, m] = end * (lines[n - 1, m] + z * lines[n - 2, m])
        for i in range(n - 2, -1, -1):
            for m in range(width):
                lines[i, m] = z * (lines[i + 1, m] - lines[i, m])
    for i in range(n):
        for m in range(width):
            lines[i, m] *= gain


@compiled(relaxed=True)
def _filter_columns(
    image: Any, poles: Any, first: Any, gain: float, thread: int, threads: int
) -> None:
    """Filter an image along its columns, in place."""
    rows, cols = image.shape
    for block in range(thread, (cols + _LINES - 1) // _LINES, threads):
        lines = np.zeros((rows, _LINES))
        left, width = block * _LINES, min(_LINES, cols - block * _LINES)
        for i in range(rows):
            for m in range(width):
                lines[i, m] = image[i, left + m]
        _filter(lines, rows, poles, first, gain)
        for i in range(rows):
            for m in range(width):
                image[i, left + m] = lines[i, m]


def _pad_mirrored(padded: NDArray[Any], pad: int) -> None:
    """Fill the margin of an array with its interior, mirrored about the outermost values."""
    rows, cols = (size - 2 * pad for size in padded.shape)
    up, left = (np.pad(np.arange(pad, pad + n), pad, mode="reflect") for n in (rows, cols))
    interior = padded[pad : pad + rows]
    interior[:, :pad] = interior[:, left[:pad]]
    interior[:, pad + cols :] = interior[:, left[pad + cols :]]
    padded[:pad], padded[pad + rows :] = padded[up[:pad]], padded[up[pad + rows :]]


types: Any = numba_types
cgutils: Any = numba_cgutils

_DOUBLE, _WORD, _LANE = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
_RELAXED = ("contract", "reassoc", "nsz", "arcp")


def lane_weights(order: int) -> FloatArray:
    """(order + 1, lanes) coefficients of t^power in the weight of a tap, [power, lane].

    There are 4, 8 or 16 lanes, of which the last may be zero. Lane 0 is the tap (order - 1)/2
    pixels to the left of the pixel from which the fraction t is measured.
    """
    taps = order + 1
    found = np.zeros((taps, 1 << (taps - 1).bit_length()))
    # Exact integer arithmetic; the last tap is at the spline's left end.
    for power, tap in np.ndindex(taps, taps):
        left, rest = order - tap, order - power
        terms = ((-1) ** k * comb(taps, k) * (left - k) ** rest for k in range(left + 1))
        found[power, tap] = comb(order, power) * sum(terms) / factorial(order)
    return found


class _Vectors:
    """Emits LLVM arithmetic on vectors with a given number of lanes at the builder's position."""

    def __init__(self, builder: Any, lanes: int) -> None:
        self.builder, self.lanes = builder, lanes
        self.type = ir.VectorType(_DOUBLE, lanes)

    def times_plus(self, a: Any, b: Any, c: Any) -> Any:
        """Return a b + c."""
        product = self.builder.fmul(a, b, flags=_RELAXED)
        return self.builder.fadd(product, c, flags=_RELAXED)

    def everywhere(self, vector: Any, lane: int) -> Any:
        """Copy one lane to all lanes."""
        lanes = ir.Constant(ir.VectorType(_LANE, self.lanes), [lane] * self.lanes)
        return self.builder.shuffle_vector(vector, ir.Constant(self.type, ir.Undefined), lanes)

    def polynomials(self, coefficients: FloatArray, t: Any) -> Any:
        """Evaluate one polynomial per lane at a scalar t, by Horner's rule."""
        nothing, first = ir.Constant(self.type, ir.Undefined), ir.Constant(_LANE, 0)
        t = self.everywhere(self.builder.insert_element(nothing, t, first), 0)
        *rest, total = (ir.Constant(self.type, row.tolist()) for row in coefficients)
        for row in reversed(rest):
            total = self.times_plus(total, t, row)
        return total

    def dot(self, a: Any, b: Any) -> Any:
        """Scalar product of two vectors."""
        signature = ir.FunctionType(_DOUBLE, [_DOUBLE, self.type])
        name = f"llvm.vector.reduce.fadd.v{self.lanes}f64"
        total = cgutils.get_or_insert_function(self.builder.module, signature, name)
        product = self.builder.fmul(a, b, flags=_RELAXED)
        return self.builder.call(total, [ir.Constant(_DOUBLE, -0.0), product], fastmath=_RELAXED)


def _sampler(order: int) -> Any:
    """Make the compiled sampler of a spline of this order."""
    count, powers = order + 1, lane_weights(order)
    lanes = powers.shape[1]
    slopes = np.arange(1, count)[:, None] * powers[1:]

    @intrinsic
    def at(typing: Any, c: Any, i: Any, j: Any, t_row: Any, t_col: Any) -> Any:
        if c.layout != "C":
            return None
        signature = types.UniTuple(types.float64, 3)(c, types.intp, types.intp, t_row, t_col)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            array_type, (array, i, j, t_row, t_col) = signature.args[0], arguments
            array = context.make_array(array_type)(context, builder, array)
            scalar = context.get_data_type(array_type.dtype)
            size = array_type.dtype.bitwidth // 8
            stride = cgutils.unpack_tuple(builder, array.strides)[0]
            along = builder.mul(j, ir.Constant(_WORD, size))
            at = builder.ptrtoint(array.data, _WORD)
            at = builder.add(at, builder.add(builder.mul(i, stride), along))
            vectors = _Vectors(builder, lanes)
            down, d_down = (vectors.polynomials(p, t_row) for p in (powers, slopes))
            right, d_right = (vectors.polynomials(p, t_col) for p in (powers, slopes))
            total = d_total = ir.Constant(vectors.type, [0.0] * lanes)
            taps = ir.VectorType(scalar, lanes)
            for k in range(count):
                row = builder.load(builder.inttoptr(at, taps.as_pointer()), align=size)
                row = row if scalar == _DOUBLE else builder.fpext(row, vectors.type)
                total = vectors.times_plus(vectors.everywhere(down, k), row, total)
                d_total = vectors.times_plus(vectors.everywhere(d_down, k), row, d_total)
                at = builder.add(at, stride)
            value, d_row, d_col = (
                vectors.dot(total, right), vectors.dot(d_total, right), vectors.dot(total, d_right)
            )  # fmt: skip
            return context.make_tuple(builder, signature.return_type, [value, d_row, d_col])

        return signature, generate

    return at


_cubic, _quintic, _eleventh = (cast(Any, _sampler(order)) for order in ORDERS)
"""(value, d_row, d_col) from c[i : i + taps, j : j + taps], with taps = order + 1.

The fractions t_row and t_col are measured from the last tap of the first half. The two or four
values read to the right of the taps have zero weight. c must be contiguous and have one more row
below: to the right of the last column, the beginning of the next row is read.
"""

PAD = 6
"""Rows and columns of mirrored coefficients around the image, so that taps need no bounds test."""


@dataclass(frozen=True, eq=False)
class SplineImage:
    """An image that can be evaluated anywhere, by a spline of order 3, 5 or 11."""

    coefficients: NDArray[Any]
    """(rows + 2 PAD, cols + 2 PAD), float32 or float64."""
    order: int

    def __post_init__(self) -> None:
        poles(self.order)  # or an InputError
        if self.coefficients.ndim != 2 or min(self.coefficients.shape) < 2 * PAD + 2:
            shape, least = self.coefficients.shape, 2 * PAD + 2
            raise InputError(f"expected padded coefficients of {least} x {least}, got {shape}")

    @classmethod
    def of(cls, image: ArrayLike, order: int = 5, dtype: Any = np.float32) -> SplineImage:
        """Prefilter an image (rows, cols), mirrored at its border, and keep the coefficients.

        ``dtype``: type of the coefficients; float32 has an error of 1e-7 of full scale. InputError
        if the image isn't at least 2 x 2 px, or the order is not 3, 5 or 11.
        """
        pixels = np.asarray(image, dtype=np.dtype(dtype))
        if pixels.ndim != 2 or min(pixels.shape) < 2:
            raise InputError(f"expected an image of at least 2 x 2 px, got shape {pixels.shape}")
        return cls(spline_coefficients(pixels, order, PAD), order)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the image [px]."""
        return self.coefficients.shape[0] - 2 * PAD, self.coefficients.shape[1] - 2 * PAD

    def sample(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(value, d_row, d_col) [grey levels, grey levels/px] at positions (row, col) [px].

        Positions broadcast together; NaN outside the image. d_row is along *increasing row*.
        """
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        value, d_row, d_col = (np.empty(row.size) for _ in range(3))
        at = row.ravel(), col.ravel(), row.size
        sample_points(self.coefficients, self.order, *at, value, d_row, d_col)
        return value.reshape(row.shape), d_row.reshape(row.shape), d_col.reshape(row.shape)


@compiled(relaxed=True)
def sample_points(
    c: Any, order: int, row: Any, col: Any, n: int, value: Any, d_row: Any, d_col: Any
) -> None:
    """Fill value, d_row and d_col at the first n positions; NaN outside the image."""
    last_row, last_col = c.shape[0] - 2 * PAD - 1, c.shape[1] - 2 * PAD - 1
    before = PAD - (order - 1) // 2
    for k in range(n):
        r, q = row[k], col[k]
        if not (0.0 <= r <= last_row and 0.0 <= q <= last_col):
            value[k] = d_row[k] = d_col[k] = np.nan
            continue
        i, j = min(int(r), last_row - 1), min(int(q), last_col - 1)
        top, left, t_row, t_col = i + before, j + before, r - i, q - j
        if order == 5:
            value[k], d_row[k], d_col[k] = _quintic(c, top, left, t_row, t_col)
        elif order == 11:
            value[k], d_row[k], d_col[k] = _eleventh(c, top, left, t_row, t_col)
        else:
            value[k], d_row[k], d_col[k] = _cubic(c, top, left, t_row, t_col)
