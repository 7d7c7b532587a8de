"""Where h'r = 0, for weights h that are not the residual's own derivative.

Their slopes are taken once, at the least-squares minimum, and from there Newton steps lead to the
root, which is a few hundredths of a pixel off. There is no cost that has to fall. The derivative
of h'r is A = h'J, J being that of the residual; noise that pushes h'r with the covariance s^2 h'h
moves the root with s^2 A^-1 h'h A^-1. Why one would: :mod:`modeharvest.idic.weighting`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.blur import blurred
from modeharvest.idic.gauss_newton import (
    GaussNewtonOptions,
    Iteration,
    Minimum,
    Outcome,
    StepLength,
    corrected,
    standard_errors,
)
from modeharvest.idic.inputs import CheckedImages
from modeharvest.idic.normal_equations import Assembly, NormalEquations
from modeharvest.idic.pyramid import Pair, smoothed
from modeharvest.idic.scaled_eigen import ScaledEigen
from modeharvest.idic.warp import brought_back, push_forward
from modeharvest.idic.weighting import Gradient, Weighting
from modeharvest.imaging.interpolation import SplineImage

FloatArray = NDArray[np.float64]

_FAR = 10.0
"""Steps longer than that many times the first one: it runs away."""
_NEIGHBOURS_PX = 1.0
"""Blur by which a pixel's neighbours stand for it where a gain is among the unknowns [px]."""


def instrument(
    weighting: Weighting, images: CheckedImages, pair: Pair, used: Assembly, a: FloatArray
) -> NDArray[np.float32]:
    """Make what weighs the residual: (3, rows, cols), slopes along x and y, and grey levels.

    In the reference's frame, at the pixels that count. The grey levels, for a gain among the
    unknowns, are those of f around each pixel without the pixel itself: so their noise has
    nothing in common with the residual's.

    Parameters
    ----------
    weighting
        Which gradient.
    images, pair
        f and g, whole and prepared for the finest level.
    used, a
        The pixels that count, and the (size,) unknowns of the least-squares minimum.
    """
    order = pair.deformed.order
    # As in the pyramid: what is beyond the material is only left out if both masks are known.
    f_mask = None if images.g_mask is None else images.f_mask
    if weighting.gradient is Gradient.DEFORMED:
        g = smoothed(images.g, images.g_mask, weighting.blur_px)
        made = brought_back(used, a, pair.reference, SplineImage.of(g, order))
    else:
        f = smoothed(images.f, f_mask, weighting.blur_px)
        rest = np.zeros_like(a)
        made = brought_back(used, rest, pair.reference, SplineImage.of(f, order))
        push_forward(used, a, made)
    if used.ansatz.brightness.gain_degree is not None:
        made[2] = _neighbours(images.f, f_mask, max(weighting.blur_px, _NEIGHBOURS_PX))
    return made


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
    """How what pushes h'r moves its root.

    Parameters
    ----------
    slope
        (n, n) A = h'J, made symmetric.
    weight
        (n, n) h'h.
    """

    slope: FloatArray
    weight: FloatArray

    @classmethod
    def of(cls, matrix: Callable[[float], FloatArray], least_squares: FloatArray) -> Propagation:
        """From matrices of squares alone: for the mean m of h and J, 4 m'm = h'h + J'J + A + A'.

        Parameters
        ----------
        matrix
            (n, n) m'm of weights that are a mixture: so much of h, the rest of J.
        least_squares
            (n, n) J'J.
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
    """Find the root, from a least-squares minimum.

    Parameters
    ----------
    evaluate
        -h'r at some unknowns, as the gradient of normal equations.
    curvature
        (n, n) A = h'J.
    step_length
        Rms difference of the displacement between two sets of unknowns [px].
    found
        The minimum.
    options
        When to stop.
    on_iteration
        Called with the number of each finished iteration.

    Returns
    -------
    Minimum
        With the minimum's own matrix J'J, and these steps alone; converged. If they don't settle,
        the minimum itself with the outcome UNWEIGHTED.
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
