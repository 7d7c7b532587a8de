"""Which gradient weighs the residual (instrumental variables), and the root of h'r = 0.

A correlation ends where h'r = 0: r is the residual f - g(x + u), h are the displacement's
derivatives times a gradient. With the gradient of g at x + u that is the least-squares minimum. But
that gradient includes the gradient of g's noise, and the same noise is in the residual:

* the two are correlated by half the slope of the interpolated noise's variance, which depends on
  where between pixels x + u lies: a bias of the displacement, with a period of one pixel;
* the noise's gradient scatters the unknowns.

These are errors in the variables. The remedy is an *instrument*, an h whose errors are independent
of those of r. Whatever h is, exact images have r = 0 at the truth, so that no choice of h causes a
bias of its own. The gradient of f, pushed forward by F^-T to its place in g, is such an instrument:
at a pixel of f, its noise and the slope of its noise are uncorrelated, because the spline is
symmetric about the pixel. A blur of f reduces the slope's noise by its fourth power, and costs
little as long as it is narrow compared with a speckle.

Sources: J. Neggers, B. Blaysat, J. P. M. Hoefnagels, M. G. D. Geers, Int. J. Numer. Methods Eng.
105 (2016), doi 10.1002/nme.4971 (the choice of the gradient); W. A. Fuller, Measurement Error
Models, Wiley 1987, doi 10.1002/9780470316665 (instruments); H. Schreier, M. Sutton, Exp. Mech. 42
(2002), doi 10.1007/BF02410987, and Y. Wang et al., Strain 45 (2009), doi
10.1111/j.1475-1305.2008.00592.x (bias by interpolated noise).

The instrument's slopes are taken once, at the least-squares minimum. From there Newton steps lead
to the root, which is a few hundredths of a pixel off; no cost has to fall. The derivative of h'r is
A = h'J, J being that of the residual; noise that perturbs h'r with the covariance s^2 h'h moves the
root with the covariance s^2 A^-1 h'h A^-1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.solver.assembly import Assembly, NormalEquations, push_forward, warped_back
from modeharvest.idic.solver.gauss_newton import (
    GaussNewtonOptions,
    Iteration,
    Minimum,
    Outcome,
    StepLength,
    corrected,
    standard_errors,
)
from modeharvest.idic.solver.noise import slope_noise
from modeharvest.idic.solver.pyramid import LevelPair, blurred, smoothed
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.scaled_eigen import ScaledEigen

WORTH_IT = 0.01
"""Least reduction of the unknowns' variance for which a blur is taken [-]."""
ALIASED = 1e-4
"""Power of the aliased part of a wave over its own at which the low-pass filter leaves half [-]:
with it benchmarks/small_motion.py shows neither bias nor much more scatter."""
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


class Gradient(Enum):
    """Image whose gradient weighs the residual."""

    DEFORMED = "deformed"
    """The gradient of g at x + u: h'r is then the derivative of the cost."""
    REFERENCE = "reference"
    """The gradient of f at x, pushed forward by F^-T: the same in exact images."""


@dataclass(frozen=True)
class Weighting:
    """What weighs the residual: a gradient, and the filter of its image."""

    gradient: Gradient = Gradient.DEFORMED
    blur_px: float = 0.0
    """Standard deviation of a blur of the image whose gradient it is [px]; 0 for none."""
    speckle_size_px: float = np.inf
    """Full width at half maximum of the speckle's autocorrelation [px]; infinite if not known."""
    low_pass: bool = False
    """Whether that image's rows and columns are filtered, see :meth:`passed`."""

    def __post_init__(self) -> None:
        is_cut = not self.low_pass or self.speckle_size_px < np.inf  # where depends on the size
        if not (self.blur_px >= 0 and self.speckle_size_px > 0 and is_cut):
            raise InputError(
                "expected a blur of at least 0 px and a speckle wider than 0 px, of known size for "
                f"a low-pass filter, got {self.blur_px} and {self.speckle_size_px}"
            )

    @property
    def is_least_squares(self) -> bool:
        """Whether h'r = 0 is the minimum of the residual's sum of squares."""
        return self.gradient is Gradient.DEFORMED and not (self.blur_px or self.low_pass)

    def excess(self, noise: float, order: int = 5) -> float:
        """Relative excess of the unknowns' variance over the Cramer-Rao bound [-].

        With the same noise in both images, the reference's gradient, and a speckle whose
        autocorrelation is exp(-r^2/(2 L^2)); t = (s/L)^2 for a blur s. The blur's cost,
        (1 + t)^4/(1 + 2 t)^2, arises because the weights are no longer the gradient itself. The
        half: the noise of an image is uncorrelated with its own gradient. ``noise`` is its variance
        over the mean square of the speckle's slope [px^2], ``order`` the spline's.
        """
        noise *= slope_noise(order, self.blur_px)
        if self.blur_px == 0.0:
            return 0.5 * noise
        t = (self.blur_px * _FWHM / self.speckle_size_px) ** 2
        return float((1.0 + t) ** 4 * (1.0 / (1.0 + 2.0 * t) ** 2 + 0.5 * noise) - 1.0)

    def passed(self, k: NDArray[Any]) -> FloatArray:
        """Share that the low-pass filter leaves of a wave of ``k`` = 0 ... 0.5 cycles/px [-].

        Pixels alias the wave 1 - k to k. A speckle whose autocorrelation is exp(-r^2/(2 L^2)) has
        the power S(k) ~ exp(-(2 pi L k)^2/2), so that the share S(1 - k)/S(k) of a wave is aliased;
        half is left where that is :data:`ALIASED`. Aliasing would bias the displacement, because
        residual and weight share it.
        """
        k_L = _FWHM / (2.0 * np.pi * self.speckle_size_px)
        aliased = np.exp((k - 0.5) / k_L**2)
        return np.asarray(1.0 / (1.0 + aliased / ALIASED))

    def slope_noise(self, order: int) -> float:
        """Variance at a pixel of the slope of white noise of variance 1, filtered so [1/px^2].

        ``order`` is the spline's; with a low-pass filter the spline is taken for ideal.
        """
        if not self.low_pass:
            return slope_noise(order, self.blur_px)
        k = np.linspace(0.0, 0.5, 1001)
        power = self.passed(k) ** 2
        return float((np.square(2.0 * np.pi * k) * power).mean() * power.mean())

    @property
    def text(self) -> str:
        """The weighting in words."""
        whose = {
            Gradient.DEFORMED: "the deformed image's gradient",
            Gradient.REFERENCE: "the reference's gradient",
        }[self.gradient]
        if self.low_pass:
            return (
                f"The residual was weighed with {whose} after a low-pass filter, which takes away "
                "what the pixels are too coarse for."
            )
        if self.blur_px == 0.0:
            return f"The residual was weighed with {whose}."
        return (
            f"The residual was weighed with {whose} after a blur of {self.blur_px:.2g} px, which "
            "takes away the gradient of the image's noise."
        )


def best_blur(noise: float, size_px: float, order: int = 5) -> float:
    """Blur of the gradient's image for the least variance of the unknowns [px]; 0 for none.

    ``noise`` and ``order`` as for :meth:`Weighting.excess`, the speckle's autocorrelation having a
    full width at half maximum of ``size_px``; a blur must save :data:`WORTH_IT` of the variance.
    """
    candidates = [Weighting(Gradient.REFERENCE, blur, size_px) for blur in (0.0, *_BLURS_PX)]
    excess = [weighting.excess(noise, order) for weighting in candidates]
    best = int(np.argmin(excess))
    return candidates[best].blur_px if excess[0] - excess[best] > WORTH_IT else 0.0


LEAST_BLUR_PX = 0.6
"""Least blur: a narrower Gaussian isn't one when it is sampled."""
_BLURS_PX = tuple(LEAST_BLUR_PX + 0.05 * k for k in range(69))
"""Blurs that are tried, up to 4 px."""

_FAR = 10.0
"""Length of a step over the shortest one beyond which the iteration diverges."""
_REACH_PX = 48
"""Half the length of the low-pass filter [px]; its weights have fallen to 1 % there."""
_NEIGHBOURS_PX = 1.0
"""Blur that gives a pixel's neighbours in place of it, if a gain is among the unknowns [px]."""


def instrument(
    weighting: Weighting, pair: ImagePair, level: LevelPair, used: Assembly, a: FloatArray
) -> NDArray[np.float32]:
    """Make what weighs the residual: (3, rows, cols), slopes along x and y, and grey levels.

    In the reference's frame, at the pixels ``used``; ``a`` are the unknowns of the least-squares
    minimum, ``level`` is the pair prepared for the finest level. The grey levels, for a gain among
    the unknowns, are means of f around each pixel without the pixel itself, so that their noise is
    independent of the residual's.
    """
    order = level.deformed.order
    # As in the pyramid: what is beyond the material is only left out if both masks are known.
    f_mask = None if pair.deformed_mask is None else pair.mask
    if weighting.gradient is Gradient.DEFORMED:
        g = _filtered(weighting, pair.deformed, pair.deformed_mask)
        made = warped_back(used, a, level.reference, SplineImage.of(g, order))
    else:
        f = _filtered(weighting, pair.reference, f_mask)
        rest = np.zeros_like(a)
        made = warped_back(used, rest, level.reference, SplineImage.of(f, order))
        push_forward(used, a, made)
    if weighting.low_pass:  # a sharp edge would let through what the filter has taken away
        cells = ndimage.binary_erosion(used.mask, np.ones((2, 2))).astype(np.float32)
        made[:2] *= ndimage.uniform_filter(cells, 2, mode="constant", origin=-1)
    if used.ansatz.brightness.gain_degree is not None:
        made[2] = _neighbours(pair.reference, f_mask, max(weighting.blur_px, _NEIGHBOURS_PX))
    return made


def _filtered(
    weighting: Weighting, image: NDArray[Any], mask: NDArray[np.bool_] | None
) -> NDArray[Any]:
    """Filter an image over its material, True in the mask, as the weighting specifies."""
    if not weighting.low_pass:
        return smoothed(image, mask, weighting.blur_px)
    passed = np.asarray(image, np.float32)
    if mask is not None:
        passed = np.where(mask, passed, smoothed(image, mask, _NEIGHBOURS_PX))
    response = weighting.passed(np.fft.rfftfreq(2 * _REACH_PX))
    weights = np.fft.fftshift(np.fft.irfft(response))[1:]  # odd: symmetric about its middle
    for axis in (0, 1):
        passed = ndimage.convolve1d(passed, weights, axis, mode="mirror")
    return passed


def _neighbours(
    image: NDArray[Any], mask: NDArray[np.bool_] | None, blur_px: float
) -> NDArray[np.float32]:
    """(rows, cols) Gaussian mean of the pixels around each pixel, without the pixel itself."""
    inside = np.ones(image.shape, np.float32) if mask is None else mask.astype(np.float32)
    alone = np.zeros((int(10 * blur_px) | 1,) * 2, np.float32)
    alone[len(alone) // 2, len(alone) // 2] = 1.0
    own = blurred(alone, blur_px).max()
    grey = np.where(inside > 0.0, np.asarray(image, np.float32), np.float32(0.0))
    around = blurred(grey, blur_px) - own * grey
    around /= np.maximum(blurred(inside, blur_px) - own * inside, own)
    return np.asarray(around)


@dataclass(frozen=True, eq=False)
class Propagation:
    """How a perturbation of h'r moves its root."""

    slope: FloatArray
    """(n, n) A = h'J, made symmetric."""
    weight: FloatArray
    """(n, n) h'h."""

    @classmethod
    def of(cls, matrix: Callable[[float], FloatArray], least_squares: FloatArray) -> Propagation:
        """From matrices of squares alone: for the mean m of h and J, 4 m'm = h'h + J'J + A + A'.

        ``matrix`` makes the (n, n) m'm of mixed weights: a share of h, the rest of J.
        """
        pure, mixed = matrix(1.0), matrix(0.5)
        return cls(2.0 * mixed - 0.5 * (pure + least_squares), pure)


def root(
    evaluate: Callable[[FloatArray], NormalEquations],
    curvature: FloatArray,
    step_length: StepLength,
    found: Minimum,
    options: GaussNewtonOptions,
    on_iteration: Callable[[int], None] = lambda number: None,
) -> Minimum:
    """Find the root of h'r = 0, starting from a least-squares minimum.

    Returns it as converged, with the minimum's own matrix J'J, and these steps alone. If they don't
    converge, returns the minimum itself with the outcome UNWEIGHTED.

    evaluate : -h'r at some unknowns, as the gradient of normal equations.
    curvature : (n, n) A = h'J.
    step_length, options, on_iteration : As for
        :func:`~modeharvest.idic.solver.gauss_newton.minimise`.
    """
    a, history = found.unknowns, list[Iteration]()
    here = evaluate(a)
    first = np.inf
    for number in range(1, options.max_iterations + 1):
        step = -ScaledEigen.of(curvature).solve(here.gradient)
        length, errors = step_length(a, a + step), standard_errors(step, curvature, here)
        there = evaluate(a + step)
        curvature = corrected(curvature, step, there.gradient - here.gradient)
        a, here, first = a + step, there, min(first, length)
        history.append(Iteration(1, number, here.mean_square, length, 0.0, here.pixels))
        on_iteration(number)
        if length <= options.tolerance_px or errors <= options.tolerance_errors:
            equations = replace(here, matrix=found.equations.matrix)
            return replace(
                found, unknowns=a, equations=equations, history=tuple(history),
                outcome=Outcome.CONVERGED,
            )  # fmt: skip
        if length > _FAR * first:
            break
    return replace(found, outcome=Outcome.UNWEIGHTED, history=tuple(history))
