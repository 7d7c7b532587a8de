"""A quintic spline's value and gradient at a point, from all taps of a row at once.

Compilers turn loops over many points into vectors, but here neighbouring points read from places
that differ; what can go side by side are the six taps of a row. Written out as vectors of eight,
whose last two weights are zero, a sample takes half the time. LLVM splits them where the machine's
vectors are shorter.
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

_LANES, _TAPS = 8, 6
_DOUBLE, _WORD, _LANE = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
_VECTOR = ir.VectorType(_DOUBLE, _LANES)
_RELAXED = ("contract", "reassoc", "nsz", "arcp")


def _weights() -> FloatArray:
    """(power, lane): the weight of tap -2 + lane at the fraction t is a sum over t^power."""
    pieces = PPoly.from_spline(BSpline.basis_element(np.arange(_TAPS + 1.0)))
    first = int(np.searchsorted(pieces.x, 0.0, side="right")) - 1
    found = np.zeros((_TAPS, _LANES))
    # Highest power first, and from the left end of the spline, where the last tap is.
    found[:, :_TAPS] = pieces.c[::-1, first : first + _TAPS][:, ::-1]
    return found


WEIGHTS = _weights()
"""(6, 8): for each power of the fraction, then each lane; lanes 0 ... 5 are the taps -2 ... 3."""
SLOPES = np.arange(1, _TAPS)[:, None] * WEIGHTS[1:]
"""(5, 8): the weights' derivatives."""


class _Vectors:
    """Arithmetic with vectors, put at the builder's place."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    def times_plus(self, a: Any, b: Any, c: Any) -> Any:
        """Give a b + c."""
        product = self.builder.fmul(a, b, flags=_RELAXED)
        return self.builder.fadd(product, c, flags=_RELAXED)

    def everywhere(self, vector: Any, lane: int) -> Any:
        """Copy one lane to all."""
        lanes = ir.Constant(ir.VectorType(_LANE, _LANES), [lane] * _LANES)
        return self.builder.shuffle_vector(vector, ir.Constant(_VECTOR, ir.Undefined), lanes)

    def polynomials(self, coefficients: FloatArray, t: Any) -> Any:
        """Evaluate one polynomial a lane, by Horner's rule, at a scalar t."""
        nothing, first = ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_LANE, 0)
        t = self.everywhere(self.builder.insert_element(nothing, t, first), 0)
        *rest, total = (ir.Constant(_VECTOR, row.tolist()) for row in coefficients)
        for row in reversed(rest):
            total = self.times_plus(total, t, row)
        return total

    def dot(self, a: Any, b: Any) -> Any:
        """Sum of the products."""
        signature = ir.FunctionType(_DOUBLE, [_DOUBLE, _VECTOR])
        name = f"llvm.vector.reduce.fadd.v{_LANES}f64"
        total = cgutils.get_or_insert_function(self.builder.module, signature, name)
        product = self.builder.fmul(a, b, flags=_RELAXED)
        return self.builder.call(total, [ir.Constant(_DOUBLE, -0.0), product], fastmath=_RELAXED)


@intrinsic
def _quintic_at(typing: Any, c: Any, i: Any, j: Any, t_row: Any, t_col: Any) -> Any:
    """(value, d_row, d_col) from c[i : i + 6, j : j + 6]; reads two values to the right of them.

    The fractions t_row and t_col count from the third of the six. c has to be contiguous, and to
    have a row below the six: what is read to the right of the last column is that row's beginning.
    """
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
        vectors = _Vectors(builder)
        down, d_down = (vectors.polynomials(p, t_row) for p in (WEIGHTS, SLOPES))
        right, d_right = (vectors.polynomials(p, t_col) for p in (WEIGHTS, SLOPES))
        total = d_total = ir.Constant(_VECTOR, [0.0] * _LANES)
        taps = ir.VectorType(scalar, _LANES)
        for k in range(_TAPS):
            row = builder.load(builder.inttoptr(at, taps.as_pointer()), align=size)
            row = row if scalar == _DOUBLE else builder.fpext(row, _VECTOR)
            total = vectors.times_plus(vectors.everywhere(down, k), row, total)
            d_total = vectors.times_plus(vectors.everywhere(d_down, k), row, d_total)
            at = builder.add(at, stride)
        value, d_row, d_col = (
            vectors.dot(total, right), vectors.dot(d_total, right), vectors.dot(total, d_right)
        )  # fmt: skip
        return context.make_tuple(builder, signature.return_type, [value, d_row, d_col])

    return signature, generate


quintic_at = cast(Any, _quintic_at)
