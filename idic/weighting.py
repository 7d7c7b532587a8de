"""Which gradient weighs the residual, and why a smoother one is better where there is noise.

A correlation ends where h'r = 0: r is the residual f - g(x + u), h are the displacement's
derivatives times a gradient. With the gradient of g at x + u that is the least-squares minimum.
But g's noise has a gradient of its own, of 2.5 times its variance per px^2, which scatters the
unknowns and, being the noise of the residual too, biases them: errors in the variables, for which
the cure is an *instrument*, an h without those errors. Whatever h is, exact images have r = 0 at
the truth, so a blurred h biases nothing, unlike a blurred image: it costs information, and little
of it as long as the blur is narrow against a speckle, while the noise's gradient falls with its
fourth power.

Sources: J. Neggers, B. Blaysat, J. P. M. Hoefnagels, M. G. D. Geers, Int. J. Numer. Methods Eng.
105 (2016), doi 10.1002/nme.4971 (the choice of the gradient); W. A. Fuller, Measurement Error
Models, Wiley 1987, doi 10.1002/9780470316665 (instruments).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from modeharvest.errors import InputError

SLOPE_NOISE = 2.46
"""Variance of a quintic spline's slope through white noise of variance 1, the mean over all
positions between pixels [1/px^2]. A cubic's is 2.17."""
WORTH_IT = 0.01
"""Share of the unknowns' variance for which a blur is worth the steps [-]."""
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


class Gradient(Enum):
    """Of which image the gradient is that weighs the residual."""

    DEFORMED = "deformed"
    """Of g at x + u: the derivative of the cost."""
    REFERENCE = "reference"
    """Of f at x: the same where nothing rotates or strains."""
    MEAN = "mean"
    """The mean of both."""


@dataclass(frozen=True)
class Weighting:
    """What weighs the residual.

    Parameters
    ----------
    gradient
        Of which image.
    blur_px
        Standard deviation of the blur of the image that the gradient is taken of [px]; 0 for
        none.
    width_px
        Full width at half maximum of the speckle's autocorrelation [px]; of no account without a
        blur.
    """

    gradient: Gradient = Gradient.DEFORMED
    blur_px: float = 0.0
    width_px: float = np.inf

    def __post_init__(self) -> None:
        if not (self.blur_px >= 0 and self.width_px > 0):
            raise InputError(
                "expected a blur of at least 0 px and a speckle wider than 0 px, got "
                f"{self.blur_px} and {self.width_px}"
            )

    @property
    def is_least_squares(self) -> bool:
        """Whether h'r = 0 is the minimum of the residual's sum of squares."""
        return self.gradient is Gradient.DEFORMED and self.blur_px == 0.0

    def excess(self, noise_share: float) -> float:
        """Relative excess of the unknowns' variance over the Cramer-Rao bound [-].

        Of a speckle whose autocorrelation is exp(-r^2/(2 L^2)), and a blur s, so that
        t = (s/L)^2. The blur's cost, (1 + t)^4/(1 + 2 t)^2, is that of weights that are not the
        gradient itself; q s_g^2, what the spline makes of the noise s_g^2, becomes
        s_g^2/(8 pi s^4). The half: g's own noise has nothing in common with its gradient.

        Parameters
        ----------
        noise_share
            Variance of the bare noise's slope over that of the speckle, q s_g^2/G^2 [-].
        """
        if self.blur_px == 0.0:
            return 0.5 * noise_share
        t = (self.blur_px * _FWHM / self.width_px) ** 2
        noise = noise_share / SLOPE_NOISE / (8.0 * np.pi * self.blur_px**4)
        return float((1.0 + t) ** 4 * (1.0 / (1.0 + 2.0 * t) ** 2 + 0.5 * noise) - 1.0)

    @property
    def sentence(self) -> str:
        """That in words."""
        whose = {
            Gradient.DEFORMED: "the deformed image's gradient",
            Gradient.REFERENCE: "the reference's gradient",
            Gradient.MEAN: "the mean of both images' gradients",
        }[self.gradient]
        if self.blur_px == 0.0:
            return f"The residual was weighed with {whose}."
        return (
            f"The residual was weighed with {whose} after a blur of {self.blur_px:.2g} px, which "
            "takes away the gradient of the images' noise."
        )


LEAST_SQUARES = Weighting()
"""With the derivative of the cost itself."""


def best_blur(noise_share: float, width_px: float, worth: float = WORTH_IT) -> float:
    """Blur of the gradient's image for the least variance of the unknowns [px]; 0 for none.

    Parameters
    ----------
    noise_share
        As for :meth:`Weighting.excess`.
    width_px
        Full width at half maximum of the speckle's autocorrelation [px].
    worth
        Share of the variance that a blur has to spare at least [-].
    """
    candidates = [Weighting(blur_px=blur, width_px=width_px) for blur in (0.0, *_BLURS_PX)]
    excess = [weighting.excess(noise_share) for weighting in candidates]
    best = int(np.argmin(excess))
    return candidates[best].blur_px if excess[0] - excess[best] > worth else 0.0


_BLURS_PX = tuple(0.05 * k for k in range(12, 81))
"""From 0.6 px, below which a sampled Gaussian isn't one, to 4 px."""
