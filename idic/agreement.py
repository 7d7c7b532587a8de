"""Whether what a correlation leaves over is noise, a displacement that the ansatz lacks, or both.

Noise has no correlation from one pixel to another a few pixels off; a displacement that is left
over shows the speckle's own gradient, which is correlated over a speckle. So the residual's
autocorrelation tells the two apart without knowing how large the noise is; where that is known,
chi squared tells, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.residual_sums import block_moments, lagged_products

_SPARED_PX = 3
"""The deformed image's spline correlates its noise over fewer pixels than that by more than 2 %."""
LAGS_PX = (4, 6, 8, 10, 12)
"""What :func:`lags_for` gives for the paper's speckle, 12 px wide."""
BLOCK_PX, MATCH = 32, 0.3
"""Blocks of about three speckles, and the correlation below which they don't match."""
TRAPPED = 0.1
"""Share of unmatched blocks above which an iteration is called trapped. When looked at it was
0.01 at the minimum of the paper's case, and 0.18 at a local minimum 5 px off."""
_WHITE = 0.02
"""Rms autocorrelation up to which a residual counts as noise, besides its own scatter."""
_SIGMAS, _MODEL = 4.0, 0.03
"""Chi squared may be off by 4 standard deviations and by 3 %: noise is seldom known better."""


@dataclass(frozen=True)
class Agreement:
    """The residual against the noise that the images are said to have.

    Parameters
    ----------
    correlation
        Rms autocorrelation of the residual at ``lags_px`` along rows and columns [-].
    pixels
        In the residual.
    chi_square
        Sum of squares of the residual over what the noise predicts; 1 is agreement [-]. NaN
        where the noise is not known.
    lags_px
        Distances at which the residual was compared with itself [px].
    """

    correlation: float
    pixels: int
    chi_square: float = float("nan")
    lags_px: tuple[int, ...] = LAGS_PX

    @classmethod
    def of(
        cls,
        residual_rms: float,
        correlation: float,
        pixels: int,
        unknowns: int,
        noise_sd: float | None = None,
        lags_px: tuple[int, ...] = LAGS_PX,
    ) -> Agreement:
        """Judge a residual.

        Parameters
        ----------
        residual_rms, correlation, pixels
            Of the residual: rms [grey levels], :func:`autocorrelation`, number of pixels.
        unknowns
            Number of fitted unknowns.
        noise_sd
            Standard deviation of the residual that the images' noise predicts [grey levels], if
            known; see :meth:`modeharvest.idic.result.Result.residual_noise`.
        lags_px
            Where the autocorrelation was taken.

        Raises
        ------
        InputError
            If the noise is not positive.
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
        """Whether neighbouring pixels' residuals have nothing to do with each other."""
        return bool(self.correlation < _WHITE + _SIGMAS / np.sqrt(max(1, self.pixels)))

    @property
    def is_predicted(self) -> bool:
        """Whether chi squared is 1 within its scatter; True where the noise is not known."""
        reach = _SIGMAS * np.sqrt(2.0 / max(1, self.pixels)) + _MODEL
        return bool(np.isnan(self.chi_square) or abs(self.chi_square - 1.0) < reach)

    @property
    def sentence(self) -> str:
        """What that means."""
        known = "" if np.isnan(self.chi_square) else f"chi squared is {self.chi_square:.3g}, and "
        if self.is_white and self.is_predicted:
            return f"The residual is noise: {known}it is uncorrelated ({self.correlation:.3f})."
        if self.is_white:
            return (
                f"The residual is uncorrelated, but chi squared is {self.chi_square:.3g}: the "
                "noise is not what it is said to be."
            )
        return (
            f"The residual is not noise: {known}its autocorrelation over {self.lags_px[0]} "
            f"to {self.lags_px[-1]} px is {self.correlation:.2f}. The displacement has parts that "
            "the ansatz can't describe; the standard errors don't include them."
        )


def lags_for(width_px: float) -> tuple[int, ...]:
    """Distances over which a displacement left over shows, and noise doesn't [px].

    From a third of a speckle to a whole one, but no closer than what the spline correlates.

    Parameters
    ----------
    width_px
        Full width at half maximum of the speckle's autocorrelation [px]; see
        :func:`modeharvest.idic.speckle_width.speckle_width`.
    """
    first, last = max(_SPARED_PX, width_px / 3.0), max(_SPARED_PX + 1, width_px)
    return tuple(sorted({round(lag) for lag in np.linspace(first, last, 5)}))


def autocorrelation(residual: NDArray[Any], lags_px: tuple[int, ...] = LAGS_PX) -> float:
    """Rms autocorrelation of a residual at some lags along rows and columns [-].

    Parameters
    ----------
    residual
        (rows, cols) f - g(x + u), NaN where no pixel counts.
    lags_px
        Which; see :func:`lags_for`.
    """
    lags = np.array([0, *lags_px])
    sums, counts = (np.zeros((len(residual), 2, len(lags))) for _ in range(2))
    kernel: Callable[..., None] = lagged_products
    kernel(np.ascontiguousarray(residual), lags, sums, counts)
    products, pairs = sums.sum(axis=0), counts.sum(axis=0)
    variance = products[0, 0] / max(1.0, pairs[0, 0])
    seen = pairs[:, 1:] > 0
    if variance == 0.0 or not seen.any():
        return 0.0
    found = products[:, 1:][seen] / pairs[:, 1:][seen] / variance
    return float(np.sqrt(np.mean(found**2)))


def unmatched(reference: NDArray[Any], residual: NDArray[Any]) -> float:
    """Share of the image whose two grey levels have little to do with each other [-].

    Over blocks of ``BLOCK_PX``: those in which the reference and the deformed image brought
    back to it have a zero-normalised cross-correlation below ``MATCH``. Where an iteration is
    trapped a speckle or more off, it is about 0.

    Parameters
    ----------
    reference
        (rows, cols) f.
    residual
        (rows, cols) f - g(x + u), NaN where no pixel counts.
    """
    blocks = [-(-size // BLOCK_PX) for size in residual.shape]
    sums = np.empty((*blocks, 6))
    kernel: Callable[..., None] = block_moments
    kernel(np.ascontiguousarray(reference), np.ascontiguousarray(residual), BLOCK_PX, sums)
    count = sums[..., 0]
    f, g, fg, ff, gg = np.moveaxis(sums[..., 1:] / np.maximum(count, 1.0)[..., None], -1, 0)
    cov, var_f, var_g = fg - f * g, ff - f * f, gg - g * g
    # Blocks with a third of their pixels, and with a speckle in them.
    judged = (count > BLOCK_PX**2 / 3) & (var_f > 1e-6 * var_f.max(initial=0.0))
    if not judged.any():
        return 0.0
    product = np.sqrt(np.maximum(var_f * var_g, 0.0))[judged]
    return float(np.mean(cov[judged] < MATCH * product))
