"""Where h'r = 0, for weights h that are not the residual's own derivative.

Their slopes are taken once, at the least-squares minimum, and from there Newton steps lead to the
root, which is a few hundredths of a pixel off. There is no cost that has to fall; h'h stands for
h'J, and learns from the steps. Why one would: :mod:`modeharvest.idic.weighting`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.gauss_newton import (
    GaussNewtonOptions,
    Iteration,
    Minimum,
    Outcome,
    StepLength,
    corrected,
)
from modeharvest.idic.inputs import CheckedImages
from modeharvest.idic.normal_equations import Assembly, NormalEquations
from modeharvest.idic.pyramid import Pair, smoothed
from modeharvest.idic.scaled_eigen import ScaledEigen
from modeharvest.idic.warp import brought_back
from modeharvest.idic.weighting import Gradient, Weighting
from modeharvest.imaging.interpolation import SplineImage

FloatArray = NDArray[np.float64]

_FAR = 10.0
"""Steps longer than that many times the first one: it runs away."""


def instrument(
    weighting: Weighting, images: CheckedImages, pair: Pair, used: Assembly, a: FloatArray
) -> NDArray[np.float32]:
    """Make what weighs the residual: (3, rows, cols), slopes along x and y, and grey levels.

    In the reference's frame, at the pixels that count. The grey levels, for a
    gain among the unknowns, are the mean of both images: so what their noise has in common with
    the residual cancels.

    Parameters
    ----------
    weighting
        Which gradient.
    images, pair
        f and g, whole and prepared for the finest level.
    used, a
        The pixels that count, and the (size,) unknowns of the least-squares minimum.
    """

    def of(image: NDArray[Any], mask: Any, at: FloatArray) -> NDArray[np.float32]:
        spline = SplineImage.of(smoothed(image, mask, weighting.blur_px), pair.deformed.order)
        return brought_back(used, at, pair.reference, spline)

    made = of(images.g, images.g_mask, a)
    if weighting.gradient is Gradient.DEFORMED and used.ansatz.brightness.gain_degree is None:
        return made
    slope = _SHARE_OF_G[weighting.gradient]
    share = np.array([slope, slope, 0.5], dtype=np.float32)[:, None, None]
    other = of(images.f, images.f_mask, np.zeros_like(a))
    made *= share
    other *= 1 - share
    made += other
    return made


_SHARE_OF_G = {Gradient.DEFORMED: 1.0, Gradient.MEAN: 0.5, Gradient.REFERENCE: 0.0}


def root(
    evaluate: Callable[[FloatArray, bool], NormalEquations],
    step_length: StepLength,
    found: Minimum,
    options: GaussNewtonOptions,
    on_iteration: Callable[[int], None] = lambda number: None,
) -> Minimum:
    """Find the root, from a least-squares minimum.

    Parameters
    ----------
    evaluate
        -h'r, and h'h if wanted, at some unknowns.
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
        With the minimum's own matrix J'J, and these steps alone. If they don't settle, the
        minimum itself with the outcome MAX_ITERATIONS.
    """
    a, history = found.unknowns, list[Iteration]()
    here = evaluate(a, True)
    curvature, first = here.matrix, np.inf
    for number in range(1, options.max_iterations + 1):
        step = -ScaledEigen.of(curvature).solve(here.gradient)
        length = step_length(a, a + step)
        there = evaluate(a + step, False)
        curvature = corrected(curvature, step, there.gradient - here.gradient)
        a, here, first = a + step, there, min(first, length)
        history.append(Iteration(1, number, here.mean_square, length, 0.0, here.pixels))
        on_iteration(number)
        if length <= options.tolerance_px:
            equations = replace(here, matrix=found.equations.matrix)
            return replace(found, unknowns=a, equations=equations, history=tuple(history))
        if length > _FAR * first:
            break
    return replace(found, outcome=Outcome.MAX_ITERATIONS, history=tuple(history))
