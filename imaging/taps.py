"""A spline's value and gradient at a point, from all taps of a row at once.

Compilers turn loops over many points into vectors, but here neighbouring points read from places
that differ; what can go side by side are the taps of a row: the six of a quintic spline, written
out as vectors of eight whose last two weights are zero, which takes half the time; the twelve of
one of order 11, as vectors of sixteen. LLVM splits them where the machine's vectors are shorter.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types as numba_types
from numba.core import cgutils as numba_cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray
from scipy.interpolate import BSpline, PPoly

FloatArray = NDArray[np.float64]
types: Any = numba_types
cgutils: Any = numba_cgutils

_DOUBLE, _WORD, _LANE = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
_RELAXED = ("contract", "reassoc", "nsz", "arcp")


def weights(order: int) -> FloatArray:
    """(order + 1, lanes): a tap's weight at the fraction t is a sum over t^power, power by lane.

    There are eight lanes or sixteen, of which the last are zero. Lane 0 is the tap (order - 1)/2
    pixels to the left of the one that t counts from.
    """
    taps = order + 1
    pieces = PPoly.from_spline(BSpline.basis_element(np.arange(taps + 1.0)))
    first = int(np.searchsorted(pieces.x, 0.0, side="right")) - 1
    found = np.zeros((taps, 8 * -(-taps // 8)))
    # Highest power first, and from the left end of the spline, where the last tap is.
    found[:, :taps] = pieces.c[::-1, first : first + taps][:, ::-1]
    return found


class _Vectors:
    """Arithmetic with vectors of so many lanes, put at the builder's place."""

    def __init__(self, builder: Any, lanes: int) -> None:
        self.builder, self.lanes = builder, lanes
        self.type = ir.VectorType(_DOUBLE, lanes)

    def times_plus(self, a: Any, b: Any, c: Any) -> Any:
        """Give a b + c."""
        product = self.builder.fmul(a, b, flags=_RELAXED)
        return self.builder.fadd(product, c, flags=_RELAXED)

    def everywhere(self, vector: Any, lane: int) -> Any:
        """Copy one lane to all."""
        lanes = ir.Constant(ir.VectorType(_LANE, self.lanes), [lane] * self.lanes)
        return self.builder.shuffle_vector(vector, ir.Constant(self.type, ir.Undefined), lanes)

    def polynomials(self, coefficients: FloatArray, t: Any) -> Any:
        """Evaluate one polynomial a lane, by Horner's rule, at a scalar t."""
        nothing, first = ir.Constant(self.type, ir.Undefined), ir.Constant(_LANE, 0)
        t = self.everywhere(self.builder.insert_element(nothing, t, first), 0)
        *rest, total = (ir.Constant(self.type, row.tolist()) for row in coefficients)
        for row in reversed(rest):
            total = self.times_plus(total, t, row)
        return total

    def dot(self, a: Any, b: Any) -> Any:
        """Sum of the products."""
        signature = ir.FunctionType(_DOUBLE, [_DOUBLE, self.type])
        name = f"llvm.vector.reduce.fadd.v{self.lanes}f64"
        total = cgutils.get_or_insert_function(self.builder.module, signature, name)
        product = self.builder.fmul(a, b, flags=_RELAXED)
        return self.builder.call(total, [ir.Constant(_DOUBLE, -0.0), product], fastmath=_RELAXED)


def _sampler(order: int) -> Any:
    """Make the compiled sampler of a spline."""
    count, powers = order + 1, weights(order)
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


quintic_at = cast(Any, _sampler(5))
"""(value, d_row, d_col) from c[i : i + 6, j : j + 6]; reads two values to the right of them.

The fractions t_row and t_col count from the third of the six. c has to be contiguous, and to have
a row below the six: what is read to the right of the last column is that row's beginning.
"""
eleventh_at = cast(Any, _sampler(11))
"""The same from c[i : i + 12, j : j + 12], four values read to the right of them, with fractions
that count from the sixth."""
