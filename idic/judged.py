"""From where an iteration ended to a result, with what the residual tells of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modeharvest.idic.agreement import TRAPPED, autocorrelation, lags_for, unmatched
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.estimating_equation import Propagation
from modeharvest.idic.gauss_newton import Minimum, Outcome
from modeharvest.idic.noise_transfer import NoiseTransfer
from modeharvest.idic.normal_equations import Assembly
from modeharvest.idic.pyramid import Pair
from modeharvest.idic.result import Result
from modeharvest.idic.scaled_eigen import ScaledEigen
from modeharvest.idic.warp import residual
from modeharvest.idic.weighting import LEAST_BLUR_PX, Gradient, Weighting, best_blur
from modeharvest.imaging.grid import PixelGrid

WITHOUT_RESULT = (Outcome.LEFT_IMAGE, Outcome.SINGULAR)
"""Outcomes with nothing to judge."""


def ended(
    ansatz: Ansatz, grid: PixelGrid, found: Minimum, how: Propagation | None = None
) -> Result:
    """Make a result of a minimum, or of a root; of the residual it knows its size alone."""
    matrix = found.equations.matrix
    eigen = ScaledEigen.of(matrix if how is None else how.slope)
    inverse, weight = eigen.inverse(), matrix if how is None else how.weight
    if how is not None:
        lost = np.isinf(np.diag(inverse))
        known = np.where(lost[:, None] | lost[None, :], 0.0, inverse)
        inverse = known @ weight @ known
        inverse[lost, lost] = np.inf
    constants = [ansatz.v0_slice(c).start for c in (0, 1)]
    per_px = grid.pixel_size**2 / max(1, found.equations.pixels)
    return Result(
        ansatz=ansatz,
        grid=grid,
        unknowns=found.unknowns.copy(),
        inverse=inverse,
        slope_square=float(np.mean(np.diag(matrix)[constants])) * per_px,
        weight_square=float(np.mean(np.diag(weight)[constants])) * per_px,
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
    weighting: Weighting | None = None,
    how: Propagation | None = None,
) -> Result:
    """Make a result of a minimum of a pair of images, and judge its residual.

    Parameters
    ----------
    ansatz, pair, found, used
        Kinematics and images of a level, where the iteration ended there, and its pixels.
    width_px
        Of the speckle [px].
    weighting, how
        What weighed the residual, and how its noise propagates; least squares by default.
    """
    left = residual(used, found.unknowns, pair.reference, pair.deformed)
    lost, lags_px = unmatched(pair.reference, left), lags_for(width_px)
    if lost > TRAPPED and found.outcome not in WITHOUT_RESULT:
        found = replace(found, outcome=Outcome.TRAPPED)
    order = pair.deformed.order
    return replace(
        ended(ansatz, pair.grid, found, how),
        noise_transfer=NoiseTransfer.of(ansatz, found.unknowns, pair.grid, used.mask, order),
        order=order,
        residual_correlation=autocorrelation(left, lags_px),
        residual_lags_px=lags_px,
        unmatched=lost,
        weighting=weighting or Weighting(width_px=width_px),
    )


def weighting_for(
    result: Result, width_px: float, gradient: Gradient | None, blur_px: float | None
) -> Weighting:
    """Choose what is to weigh the residual.

    Parameters
    ----------
    result
        The least-squares minimum.
    width_px
        Of the speckle [px].
    gradient, blur_px
        As specified; None is as the noise asks for, if the residual is noise, and otherwise the
        deformed image's gradient, and no blur.
    """
    is_noise = result.agreement().is_white
    if gradient is None:
        gradient = Gradient.REFERENCE if is_noise else Gradient.DEFORMED
    if blur_px is None:
        blur_px = best_blur(result.noise_to_slope, width_px, result.order) if is_noise else 0.0
        if is_noise and width_px < _FINEST_PX:
            blur_px = max(blur_px, LEAST_BLUR_PX)
    return Weighting(gradient, blur_px, width_px)


_FINEST_PX = 4.0
"""Pixels that sample finer speckles than this fold some of their waves back; a blur keeps those
out of what weighs the residual."""
