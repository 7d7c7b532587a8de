"""Standard errors of small motions where the noise has much of a gradient of its own."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from small_motion import GRID, MASK, USED, Motion, Row, measure, moved, speckle

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import FULL, smoothed
from modeharvest.idic.solver.weighting import Gradient
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage

FloatArray = NDArray[np.float64]

ANSATZ = Ansatz(Box.centred(3.0, 2.2), v0_degree=1)
MOTION = Motion(0.25, 0.4, 0.0)


def correlated(f: FloatArray, g: FloatArray, blur_px: float | None = None) -> Result:
    """With the reference's gradient."""
    options = CorrelationOptions((FULL,), gradient="reference", gradient_blur_px=blur_px)
    rest = np.zeros(ANSATZ.size)
    return correlate(ImagePair(f, g, GRID, MASK), ANSATZ, guess=rest, options=options)


@pytest.mark.parametrize("width_px", [4.0, 6.0, 12.0])
@pytest.mark.parametrize(("in_f", "in_g"), [(0.04, 0.04), (0.04, 0.0), (0.0, 0.04)])
def test_noise_in_the_gradient_lengthens_standard_errors_by_what_it_does(
    width_px: float, in_f: float, in_g: float
) -> None:
    """Covariance by A^-1 E[h'n n'h] A^-1, with h0 and J0 of exact images and E[A] = h0'J0.

    What weighs the residual is h = h0 + D n_f. Of E[h'n n'h] the noise of f makes s_f^2 h0'h0 and
    no more, because a slope D is antisymmetric, and that of g, which D n_f knows nothing of,
    s_g^2 E[h'h]. 1 % is three times what a single draw of the noise does to h'J.
    """
    noise, found = ImageNoise(in_f, in_g), []
    for seed in range(3):
        f, g = speckle(width_px, seed).image(), moved(width_px, seed, MOTION)[0]
        n = np.random.default_rng([seed, 2]).normal(size=(2, *GRID.shape))
        noisy = correlated(f + in_f * n[0], g + in_g * n[1])
        blur_px = noisy.weighting.blur_px
        exact = correlated(f, g, blur_px)
        slopes = SplineImage.of(smoothed(n[0], None, blur_px), noisy.order).sample(*USED)[1:]
        share = in_f**2 * np.mean(np.square(slopes)) / exact.weight_square
        expected = (in_f**2 + in_g**2 * (1.0 + share)) * exact.inverse
        found.append(np.trace(np.linalg.solve(expected, noisy.covariance(noise))) / ANSATZ.size)
    assert np.mean(found) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("width_px", [3.0, 4.0, 6.0, 8.0, 12.0])
@pytest.mark.parametrize(("in_f", "in_g"), [(0.01, 0.01), (0.0, 0.01)])
def test_noise_is_recognised_between_pixels_whatever_the_speckle(
    width_px: float, in_f: float, in_g: float
) -> None:
    """In the middle of four pixels a spline correlates noise by 7 % over 3 px.

    Taken for a model error, that left the least-squares minimum as it was, off by a standard error.
    """
    middle = Motion(0.5, 0.5, 0.0)
    f, g = speckle(width_px, 0).image(), moved(width_px, 0, middle)[0]
    n = np.random.default_rng(5).normal(size=(2, *GRID.shape))
    found = correlate(
        ImagePair(f + in_f * n[0], g + in_g * n[1], GRID, MASK),
        ANSATZ, guess=np.zeros(ANSATZ.size), options=CorrelationOptions((FULL,)),
    )  # fmt: skip
    assert found.residual_test().is_white
    assert found.residual_correlation < 0.015
    assert found.weighting.gradient is Gradient.REFERENCE


def test_every_motion_has_noise_of_its_own() -> None:
    """Else 31 motions would tell of the scatter little more than one does."""
    row, motions = Row(0.04, 0.04, 6.0), (MOTION, Motion(0.5, 0.4, 0.0))
    one, other = (measure(row, motion, 2, k).efficient for k, motion in enumerate(motions))
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.9
