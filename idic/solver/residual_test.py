"""Residual test: is a residual white noise, and which fraction of the image is decorrelated.

Noise is uncorrelated between pixels some pixels apart, except for the correlation that the spline
causes in g between its pixels, which is known. A model error shows the speckle's own gradient,
which is correlated over a speckle. So the residual's autocorrelation separates the two without
knowing the noise; if the noise is known, chi squared does so, too.

Residuals are NaN where no pixel counts. Each row, or row of blocks, is summed on its own, so the
result does not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.util.arrays import FloatArray
from modeharvest.util.compiled import compiled, in_parallel, readable
from modeharvest.util.errors import InputError


@compiled(relaxed=True)
def lagged_products(
    residual: Any, lags: Any, products: Any, counts: Any, thread: int, threads: int
) -> None:
    """Sum products of residuals (rows, cols) that are ``lags`` (k,) apart [px], row by row.

    Fills ``products`` and ``counts`` (rows, 2, k): sums and numbers of pairs, down the columns and
    along the rows.
    """
    rows, cols = residual.shape
    for i in range(thread, rows, threads):
        own = residual[i]
        first, last = 0, cols
        while first < last and np.isnan(own[first]):
            first += 1
        while first < last and np.isnan(own[last - 1]):
            last -= 1
        own = own[first:last]
        for k in range(lags.size):
            lag = lags[k]
            if i + lag < rows:
                below = residual[i + lag, first:last]
                _products(own, below, last - first, products[i, 0], counts[i, 0], k)
            _products(own, own[lag:], last - first - lag, products[i, 1], counts[i, 1], k)


@compiled(inline=True, relaxed=True)
def _products(one: Any, other: Any, n: int, products: Any, counts: Any, k: int) -> None:
    total, count = 0.0, 0.0
    for j in range(n):
        product = float(one[j] * other[j])
        pair = 0.0 if np.isnan(product) else 1.0
        total += product if pair > 0.0 else 0.0
        count += pair
    products[k], counts[k] = total, count


@compiled(relaxed=True)
def block_moments(f: Any, residual: Any, size: int, sums: Any, thread: int, threads: int) -> None:
    """Sum 1, f, g, f g, f f and g g with g = f - residual over blocks of ``size`` pixels.

    Fills ``sums`` (block rows, block columns, 6); the last blocks may be incomplete.
    """
    rows, cols = f.shape
    for block_row in range(thread, sums.shape[0], threads):
        for block_col in range(sums.shape[1]):
            n, s_f, s_g, s_fg, s_ff, s_gg = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            first, last = block_col * size, min(cols, (block_col + 1) * size)
            for i in range(block_row * size, min(rows, (block_row + 1) * size)):
                for j in range(first, last):
                    r = float(residual[i, j])
                    if not np.isnan(r):
                        a = float(f[i, j])
                        b = a - r
                        n += 1.0
                        s_f += a
                        s_g += b
                        s_fg += a * b
                        s_ff += a * a
                        s_gg += b * b
            to = sums[block_row, block_col]
            to[0], to[1], to[2], to[3], to[4], to[5] = n, s_f, s_g, s_fg, s_ff, s_gg


_SPARED_PX = 3
"""Least lag: below it the deformed image's spline correlates its noise most."""
LAGS_PX = (4, 6, 8, 10, 12)
"""What :func:`lags_for` gives for the paper's speckle, 12 px wide."""
BLOCK_PX, CORRELATED = 32, 0.3
"""Blocks of about three speckles, and the correlation below which they are decorrelated."""
MOST_DECORRELATED = 0.1
"""Fraction of decorrelated blocks above which a minimum is called local: 0.01 at the minimum of the
paper's case, 0.18 at a local minimum 5 px off."""
_WHITE = 0.02
"""Rms autocorrelation up to which a residual counts as noise, besides its own scatter."""
_SIGMAS, _MODEL = 4.0, 0.03
"""Chi squared may be off by 4 standard deviations and by 3 %: noise is seldom known better."""


@dataclass(frozen=True)
class ResidualTest:
    """The residual against the noise of the images."""

    correlation: float
    """Rms autocorrelation of the residual at ``lags_px`` along rows and columns [-]."""
    pixels: int
    """Number of pixels in the residual."""
    chi_square: float = float("nan")
    """Sum of squares of the residual over what the noise predicts; 1 is agreement [-]. NaN where
    the noise is not known."""
    lags_px: tuple[int, ...] = LAGS_PX
    """Lags at which the autocorrelation was taken [px]."""

    @classmethod
    def of(
        cls, residual_rms: float, correlation: float, pixels: int, unknowns: int,
        noise_sd: float | None = None, lags_px: tuple[int, ...] = LAGS_PX,
    ) -> ResidualTest:  # fmt: skip
        """Test a residual of rms [grey levels], :func:`autocorrelation` and number of pixels.

        unknowns : Number of fitted unknowns.
        noise_sd : Standard deviation of the residual that the images' noise predicts [grey levels],
            if known (:meth:`modeharvest.idic.result.Result.residual_noise`); InputError if not > 0.
        lags_px : Lags at which the autocorrelation was taken [px].
        """
        if noise_sd is None:
            return cls(correlation, pixels, lags_px=lags_px)
        if not noise_sd > 0:
            raise InputError(f"expected a noise of more than 0 grey levels, got {noise_sd}")
        freedom = max(1, pixels - unknowns)
        chi_square = residual_rms**2 * pixels / freedom / noise_sd**2
        return cls(correlation, pixels, chi_square, lags_px)

    @property
    def is_white(self) -> bool:
        """Whether the residual is uncorrelated from pixel to pixel."""
        return bool(self.correlation < _WHITE + _SIGMAS / np.sqrt(max(1, self.pixels)))

    @property
    def is_predicted(self) -> bool:
        """Whether chi squared is 1 within its scatter; True where the noise is not known."""
        reach = _SIGMAS * np.sqrt(2.0 / max(1, self.pixels)) + _MODEL
        return bool(np.isnan(self.chi_square) or abs(self.chi_square - 1.0) < reach)

    @property
    def text(self) -> str:
        """The result of the test, in words."""
        known = "" if np.isnan(self.chi_square) else f"chi squared is {self.chi_square:.3g}, and "
        if self.is_white and self.is_predicted:
            return f"The residual is noise: {known}it is uncorrelated ({self.correlation:.3f})."
        if self.is_white:
            return (
                f"The residual is uncorrelated, but chi squared is {self.chi_square:.3g}: the "
                "noise is not the given one."
            )
        return (
            f"The residual is not noise: {known}its autocorrelation over {self.lags_px[0]} "
            f"to {self.lags_px[-1]} px is {self.correlation:.2f}. The displacement has parts that "
            "the ansatz can't describe; the standard errors don't include them."
        )


def lags_for(speckle_size_px: float) -> tuple[int, ...]:
    """Lags at which a model error is correlated, and noise isn't [px].

    From a third of a speckle (see :func:`modeharvest.idic.solver.final_smoothing.speckle_size`) to
    a whole one, but no closer than what the spline correlates.
    """
    first, last = max(_SPARED_PX, speckle_size_px / 3.0), max(_SPARED_PX + 1, speckle_size_px)
    return tuple(sorted({round(lag) for lag in np.linspace(first, last, 5)}))


def autocorrelation(
    residual: NDArray[Any], lags_px: tuple[int, ...] = LAGS_PX, by_spline: FloatArray | None = None
) -> float:
    """Rms autocorrelation of a residual at some lags along rows and columns [-].

    The residual is f - g(x + u) (rows, cols), NaN where no pixel counts. ``by_spline``, (2, lags)
    by :func:`~modeharvest.idic.solver.noise.spline_autocorrelation`, is the autocorrelation of g's
    noise alone. The share of it, from 0 to 1, that leaves least is subtracted.
    """
    lags = np.array([0, *lags_px])
    sums, counts = (np.zeros((len(residual), 2, len(lags))) for _ in range(2))
    in_parallel(lagged_products, _single(residual), lags, sums, counts)
    products, pairs = sums.sum(axis=0), counts.sum(axis=0)
    variance = products[0, 0] / max(1.0, pairs[0, 0])
    counted = pairs[:, 1:] > 0
    if variance == 0.0 or not counted.any():
        return 0.0
    found = products[:, 1:][counted] / pairs[:, 1:][counted] / variance
    if by_spline is not None and by_spline[counted].any():
        made = by_spline[counted]
        found -= np.clip(found @ made / (made @ made), 0.0, 1.0) * made
    return float(np.sqrt(np.mean(found**2)))


def _single(image: NDArray[Any]) -> NDArray[Any]:
    """Show an image to kernels as float32, which it nearly always is: compiled once."""
    return readable(np.asarray(image, np.float32))


def decorrelated_fraction(reference: NDArray[Any], residual: NDArray[Any]) -> float:
    """Fraction of the image whose two grey levels are decorrelated [-].

    Over blocks of ``BLOCK_PX``: those in which the reference f (rows, cols) and the deformed image
    pulled back to it, f less the residual (NaN where no pixel counts), have a zero-normalised
    cross-correlation below ``CORRELATED``: it is about 0 at a local minimum a speckle or more off.
    """
    blocks = [-(-size // BLOCK_PX) for size in residual.shape]
    sums = np.empty((*blocks, 6))
    in_parallel(block_moments, _single(reference), _single(residual), BLOCK_PX, sums)
    count = sums[..., 0]
    f, g, fg, ff, gg = np.moveaxis(sums[..., 1:] / np.maximum(count, 1.0)[..., None], -1, 0)
    cov, var_f, var_g = fg - f * g, ff - f * f, gg - g * g
    # Blocks with a third of their pixels, and with a speckle in them.
    compared = (count > BLOCK_PX**2 / 3) & (var_f > 1e-6 * var_f.max(initial=0.0))
    if not compared.any():
        return 0.0
    product = np.sqrt(np.maximum(var_f * var_g, 0.0))[compared]
    return float(np.mean(cov[compared] < CORRELATED * product))
