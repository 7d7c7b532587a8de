"""Interpolation of a periodic, band-limited pattern by a B-spline of degree 7, with error bound.

Let B be the centred B-spline of degree 7 (8 = DEGREE + 1 taps), and

    p(x) = sum_k c_k exp(2 pi i f_k x),      f_k in cycles per sample.

By Poisson's summation formula, the spline whose coefficients have the spectrum c_k / B^(f_k), with
B^(f) = (sin(pi f) / (pi f))^8, is

    s(x) = sum_k c_k exp(2 pi i f_k x) (1 + sum_{m != 0} (f_k / (f_k + m))^8 exp(2 pi i m x)),

since sin^8 has the period 1. So the error of a wave is at most e(f) = sum_{m != 0} (f / (f + m))^8
of its amplitude; in the plane, e(f) + e(g) + e(f) e(g). The pattern's error is at most the sum of
this over its waves. Finer samples make every f smaller; as many are used as the bound requires.

Source: M. Unser, IEEE Signal Process. Mag. 16(6) (1999) 22, doi:10.1109/79.799930.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, PPoly

from modeharvest.util.arrays import ComplexArray, FloatArray, IntArray
from modeharvest.util.compiled import compiled, in_parallel

DEGREE = 7
_TAPS = DEGREE + 1
_FINER = (1.0, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0, 4.0)
BLOCK = 256
"""Number of points a thread processes at a time; their weights fit into the fastest cache."""
_NOWHERE = -(2**62)


class SplineTable(NamedTuple):
    """A spline's data for compiled kernels."""

    coefficients: FloatArray
    """(rows + 7, cols + 7), those of :class:`PeriodicSpline`."""
    weights: FloatArray
    """(8, 8) coefficients of t^d in the weight of tap j."""
    finer_row: float
    finer_col: float
    """Samples per pixel."""


class Workspace(NamedTuple):
    """A kernel's work arrays for ``BLOCK`` points: sample indices, tap weights, fractions."""

    i: IntArray
    j: IntArray
    w: FloatArray
    v: FloatArray
    beyond: FloatArray


@dataclass(frozen=True, eq=False)
class PeriodicSpline:
    """A pattern that can be evaluated fast at any point, with a proved error bound."""

    coefficients: FloatArray
    """(rows + 7, cols + 7) B-spline coefficients over one period of the finer samples, continued
    periodically on both sides."""
    period: tuple[int, int]
    """(rows, cols) of the period [px]."""
    bound: float
    """Bound of the error at any point, in units of the pattern."""

    @classmethod
    def of(
        cls, spectrum: ComplexArray, period: tuple[int, int], tolerance: float
    ) -> PeriodicSpline:
        """Make the spline of a real pattern with waves c_k (rows, cols // 2 + 1), as in a real FFT.

        ``period``: (rows, cols) [px]. ``bound`` <= ``tolerance`` if 4 x 4 samples per px suffice.
        """
        size = np.abs(spectrum)
        for finer in _FINER:
            rows, cols = (math.ceil(finer * n) for n in period)
            fine = (scipy.fft.next_fast_len(rows, True), scipy.fft.next_fast_len(cols, True))
            row, col = (_wave_errors(n, m) for n, m in zip(period, fine, strict=True))
            bound = _bound(size, row, col[: spectrum.shape[1]])
            if bound <= tolerance:
                break
        waves = _prefiltered(spectrum, period, fine)
        samples = scipy.fft.irfft2(waves, s=fine, norm="forward", overwrite_x=True)
        before, after = DEGREE // 2, DEGREE - DEGREE // 2
        return cls(np.pad(samples, (before, after), mode="wrap"), period, bound)

    def __call__(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """Values at positions (row, col) [px], of their shape; NaN at NaN positions."""
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        out = np.empty(row.size)
        in_parallel(_sample, self.table, row.ravel(), col.ravel(), out)
        return out.reshape(row.shape)

    @property
    def table(self) -> SplineTable:
        """The spline's data for compiled kernels."""
        finer = np.subtract(self.coefficients.shape, DEGREE) / self.period
        return SplineTable(self.coefficients, _weights(), float(finer[0]), float(finer[1]))


def _wave_errors(period: int, fine: int) -> FloatArray:
    """(period,) errors e(f) of the waves along one axis, in the layout of an FFT.

    The wave at the Nyquist frequency of whole pixels, which has no sign, is omitted: error 1.
    """
    k = np.rint(np.fft.fftfreq(period, 1.0 / period))
    f = np.abs(k) / fine
    m = np.arange(1, 50)[:, None]
    error = ((f / (m + f)) ** _TAPS + (f / (m - f)) ** _TAPS).sum(axis=0)
    error[2 * np.abs(k) == period] = 1.0
    return np.asarray(error)


def _bound(size: FloatArray, row: FloatArray, col: FloatArray) -> float:
    """Sum of |c_k| e_k; every column except the first represents two waves."""
    multiplicity = np.full(size.shape[1], 2.0)
    multiplicity[0] = 1.0
    weighted = size @ np.column_stack([multiplicity, multiplicity * col])
    return float(((1.0 + row) * weighted[:, 1] + row * weighted[:, 0]).sum())


def _prefiltered(
    spectrum: ComplexArray, period: tuple[int, int], fine: tuple[int, int]
) -> ComplexArray:
    """Divide the waves by B^ and put them into the spectrum of the finer samples."""
    most_rows, most_cols = ((n - 1) // 2 for n in period)
    k_row, k_col = np.arange(-most_rows, most_rows + 1), np.arange(most_cols + 1)
    waves = spectrum[k_row, : most_cols + 1]
    waves /= (np.sinc(k_row / fine[0]) ** _TAPS)[:, None]
    waves /= np.sinc(k_col / fine[1]) ** _TAPS
    padded = np.zeros((fine[0], fine[1] // 2 + 1), dtype=np.complex128)
    padded[k_row, : most_cols + 1] = waves
    return padded


def _weights() -> FloatArray:
    """(8, 8) coefficient of t^d in the weight of tap j, at a fraction 0 <= t < 1."""
    pieces = PPoly.from_spline(BSpline.basis_element(np.arange(_TAPS + 1) - _TAPS / 2))
    whole = np.searchsorted(pieces.x, np.arange(_TAPS) - _TAPS / 2 + 0.5) - 1
    return np.ascontiguousarray(pieces.c[::-1, whole[::-1]])


@compiled()
def _sample(
    table: SplineTable, row: FloatArray, col: FloatArray, out: FloatArray, thread: int, threads: int
) -> None:
    for block in range(thread, (out.size + BLOCK - 1) // BLOCK, threads):
        first = block * BLOCK
        past = min(first + BLOCK, out.size)
        sample(table, row[first:past], col[first:past], out[first:past], workspace())


@compiled(inner=True)
def workspace() -> Workspace:
    """Allocate the arrays that :func:`sample` works in."""
    return Workspace(
        np.empty(BLOCK, dtype=np.int64), np.empty(BLOCK, dtype=np.int64),
        np.empty((_TAPS, BLOCK)), np.empty((_TAPS, BLOCK)), np.empty(BLOCK),
    )  # fmt: skip


@compiled(inner=True, relaxed=True)
def sample(
    table: SplineTable, row: FloatArray, col: FloatArray, out: FloatArray, work: Workspace
) -> None:
    """Evaluate up to ``BLOCK`` points: indices and weights in vector instructions, then sums."""
    c, w, v = table.coefficients, work.w, work.v
    rows, cols = c.shape[0] - DEGREE, c.shape[1] - DEGREE
    _place(row, table.finer_row, work.i, work.beyond)
    _tap_weights(table.weights, work.beyond[: out.size], w)
    _place(col, table.finer_col, work.j, work.beyond)
    _tap_weights(table.weights, work.beyond[: out.size], v)
    for k in range(out.size):
        i, j = work.i[k], work.j[k]
        if i == _NOWHERE or j == _NOWHERE:
            out[k] = np.nan
            continue
        if not 0 <= i < rows:
            i %= rows
        if not 0 <= j < cols:
            j %= cols
        out[k] = _patch(c, i, j, w, v, k)


@compiled(inner=True, relaxed=True)
def _place(position: FloatArray, finer: float, sample: IntArray, beyond: FloatArray) -> None:
    """Split positions [px] into the index of the sample before and the fraction beyond it."""
    for k in range(position.size):
        at = position[k] * finer
        whole = np.floor(at)
        beyond[k] = at - whole
        sample[k] = int(whole) if abs(at) < 2.0**52 else _NOWHERE


@compiled(inner=True, relaxed=True)
def _tap_weights(a: FloatArray, t: FloatArray, w: FloatArray) -> None:
    """(8, points) weights of the taps at the fractions t, by Horner's scheme."""
    for m in range(_TAPS):
        a0, a1, a2, a3, a4, a5, a6, a7 = a[:, m]
        for k in range(t.size):
            high = a4 + t[k] * (a5 + t[k] * (a6 + t[k] * a7))
            w[m, k] = a0 + t[k] * (a1 + t[k] * (a2 + t[k] * (a3 + t[k] * high)))


@compiled(inline=True, relaxed=True)
def _patch(c: FloatArray, i: int, j: int, w: FloatArray, v: FloatArray, k: int) -> float:
    """Sum of the 8 x 8 coefficients from (i, j) on, times the weights of point k."""
    w0, w1, w2, w3 = w[0, k], w[1, k], w[2, k], w[3, k]
    w4, w5, w6, w7 = w[4, k], w[5, k], w[6, k], w[7, k]
    total = 0.0
    for m in range(_TAPS):
        q = j + m
        low = w0 * c[i, q] + w1 * c[i + 1, q] + w2 * c[i + 2, q] + w3 * c[i + 3, q]
        high = w4 * c[i + 4, q] + w5 * c[i + 5, q] + w6 * c[i + 6, q] + w7 * c[i + 7, q]
        total += v[m, k] * (low + high)
    return total
