"""Which gradient weighs the residual, and why it is the reference's where there is noise.

A correlation ends where h'r = 0: r is the residual f - g(x + u), h are the displacement's
derivatives times a gradient. With the gradient of g at x + u that is the least-squares minimum.
But g's noise has a gradient of its own, the noise of the residual among it:

* the two are correlated by half the slope of the interpolated noise's variance, which depends on
  where between pixels x + u lies: a bias of the displacement, with a period of one pixel;
* the noise's gradient scatters the unknowns.

These are errors in the variables, for which the cure is an *instrument*, an h whose errors have
nothing to do with those of r. Whatever h is, exact images have r = 0 at the truth, so that no
choice of h makes a bias of its own. The gradient of f, pushed forward by F^-T to where it belongs
in g, is such an instrument: at a pixel of f, its noise and the slope of its noise are
uncorrelated, because the spline is symmetric about the pixel. A blur of f takes from the slope's
noise by its fourth power, and costs little as long as it is narrow against a speckle.

Sources: J. Neggers, B. Blaysat, J. P. M. Hoefnagels, M. G. D. Geers, Int. J. Numer. Methods Eng.
105 (2016), doi 10.1002/nme.4971 (the choice of the gradient); W. A. Fuller, Measurement Error
Models, Wiley 1987, doi 10.1002/9780470316665 (instruments); H. Schreier, M. Sutton, Exp. Mech. 42
(2002), doi 10.1007/BF02410987, and Y. Wang et al., Strain 45 (2009), doi
10.1111/j.1475-1305.2008.00592.x (bias by interpolated noise).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from modeharvest.errors import InputError
from modeharvest.idic.noise_transfer import slope_noise

WORTH_IT = 0.01
"""Share of the unknowns' variance for which a blur is worth having [-]."""
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


class Gradient(Enum):
    """Of which image the gradient is that weighs the residual."""

    DEFORMED = "deformed"
    """Of g at x + u: the derivative of the cost."""
    REFERENCE = "reference"
    """Of f at x, pushed forward: F^-T times it, the same in exact images."""


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
        Full width at half maximum of the speckle's autocorrelation [px]; infinite if not known.
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

    def excess(self, noise: float, order: int = 5) -> float:
        """Relative excess of the unknowns' variance over the Cramer-Rao bound [-].

        With the same noise in both images, the reference's gradient, and a speckle whose
        autocorrelation is exp(-r^2/(2 L^2)); t = (s/L)^2 for a blur s. The blur's cost,
        (1 + t)^4/(1 + 2 t)^2, is that of weights that are not the gradient itself. The half: the
        noise of an image has nothing in common with its own gradient.

        Parameters
        ----------
        noise
            Variance of the noise over the mean square of the speckle's slope [px^2].
        order
            Of the spline.
        """
        noise *= slope_noise(order, self.blur_px)
        if self.blur_px == 0.0:
            return 0.5 * noise
        t = (self.blur_px * _FWHM / self.width_px) ** 2
        return float((1.0 + t) ** 4 * (1.0 / (1.0 + 2.0 * t) ** 2 + 0.5 * noise) - 1.0)

    @property
    def sentence(self) -> str:
        """That in words."""
        whose = {
            Gradient.DEFORMED: "the deformed image's gradient",
            Gradient.REFERENCE: "the reference's gradient",
        }[self.gradient]
        if self.blur_px == 0.0:
            return f"The residual was weighed with {whose}."
        return (
            f"The residual was weighed with {whose} after a blur of {self.blur_px:.2g} px, which "
            "takes away the gradient of the image's noise."
        )


def best_blur(noise: float, width_px: float, order: int = 5, worth: float = WORTH_IT) -> float:
    """Blur of the gradient's image for the least variance of the unknowns [px]; 0 for none.

    Parameters
    ----------
    noise, order
        As for :meth:`Weighting.excess`.
    width_px
        Full width at half maximum of the speckle's autocorrelation [px].
    worth
        Share of the variance that a blur has to spare at least [-].
    """
    candidates = [Weighting(Gradient.REFERENCE, blur, width_px) for blur in (0.0, *_BLURS_PX)]
    excess = [weighting.excess(noise, order) for weighting in candidates]
    best = int(np.argmin(excess))
    return candidates[best].blur_px if excess[0] - excess[best] > worth else 0.0


LEAST_BLUR_PX = 0.6
"""Below that a sampled Gaussian isn't one."""
_BLURS_PX = tuple(LEAST_BLUR_PX + 0.05 * k for k in range(69))
"""Up to 4 px."""
