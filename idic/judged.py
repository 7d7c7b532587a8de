"""From where an iteration ended to a result, with what the residual tells of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modeharvest.idic.agreement import TRAPPED, autocorrelation, lags_for, unmatched
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.gauss_newton import Minimum, Outcome
from modeharvest.idic.normal_equations import Assembly
from modeharvest.idic.pyramid import Pair
from modeharvest.idic.result import Result
from modeharvest.idic.scaled_eigen import ScaledEigen
from modeharvest.idic.warp import residual
from modeharvest.idic.weighting import LEAST_SQUARES, WORTH_IT, Gradient, Weighting, best_blur
from modeharvest.imaging.grid import PixelGrid

WITHOUT_RESULT = (Outcome.LEFT_IMAGE, Outcome.SINGULAR)
"""Outcomes with nothing to judge."""


def ended(ansatz: Ansatz, grid: PixelGrid, found: Minimum) -> Result:
    """Make a result of a minimum; of the residual it knows its size alone."""
    eigen = ScaledEigen.of(found.equations.matrix)
    return Result(
        ansatz=ansatz,
        grid=grid,
        unknowns=found.unknowns.copy(),
        inverse=eigen.inverse(),
        residual_rms=float(np.sqrt(found.equations.mean_square)),
        pixels=found.equations.pixels,
        left_image=found.equations.left_image,
        outcome=found.outcome,
        condition_number=eigen.condition_number,
    )


def judged(
    ansatz: Ansatz,
    pair: Pair,
    found: Minimum,
    used: Assembly,
    width_px: float,
    weighting: Weighting = LEAST_SQUARES,
) -> Result:
    """Make a result of a minimum of a pair of images, and judge its residual.

    Parameters
    ----------
    ansatz, pair, found, used
        Kinematics and images of a level, where the iteration ended there, and its pixels.
    width_px
        Of the speckle [px].
    weighting
        What weighed the residual, if the iteration converged.
    """
    left = residual(used, found.unknowns, pair.reference, pair.deformed)
    lost, lags_px = unmatched(pair.reference, left), lags_for(width_px)
    if lost > TRAPPED and found.outcome not in WITHOUT_RESULT:
        found = replace(found, outcome=Outcome.TRAPPED)
    return replace(
        ended(ansatz, pair.grid, found),
        residual_correlation=autocorrelation(left, lags_px),
        residual_lags_px=lags_px,
        unmatched=lost,
        weighting=weighting if found.outcome is Outcome.CONVERGED else LEAST_SQUARES,
    )


def weighting_for(
    result: Result, width_px: float, gradient: Gradient, blur_px: float | None
) -> Weighting:
    """Choose what is to weigh the residual.

    Parameters
    ----------
    result
        The least-squares minimum.
    width_px
        Of the speckle [px].
    gradient, blur_px
        As asked for; a blur of None is as the noise asks for, if the residual is noise.
    """
    if blur_px is None:
        blur_px = 0.0
        if result.agreement().is_white:
            # Noise in g makes a gain too small, however little of it there is.
            has_gain = result.ansatz.brightness.gain_degree is not None
            share = result.noise_in_gradient(result.noise_sd**2)
            blur_px = best_blur(share, width_px, 0.0 if has_gain else WORTH_IT)
    return Weighting(gradient, blur_px, width_px)
