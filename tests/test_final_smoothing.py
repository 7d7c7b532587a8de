"""Fine speckles and a large w: how wide the speckle is, when to blur, and what that is good for."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.final_smoothing import (
    WIDTHS,
    FinalSmoothing,
    contrast_after,
    smoothed_pair,
    speckle_size,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

FloatArray = NDArray[np.float64]
FWHM = np.sqrt(8 * np.log(2))
SHAPE = (512, 480)
EVERYWHERE = np.ones(SHAPE, dtype=np.bool_)
PLAIN = PixelGrid.centred(*SHAPE, 1.0)


def blurred_noise(sd: float, seed: int = 0) -> FloatArray:
    """White noise blurred by a Gaussian: its autocorrelation is one, sqrt(2) wider."""
    noise = np.random.default_rng(seed).normal(size=SHAPE)
    return np.asarray(ndimage.gaussian_filter(noise, sd, mode="wrap"))


def with_holes() -> NDArray[np.bool_]:
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]] % 80
    return np.asarray(np.hypot(rows - 40, cols - 40) > 30)


@pytest.mark.parametrize("sd", [1.5, 3.0, 6.0])
def test_the_width_is_that_of_a_known_autocorrelation(sd: float) -> None:
    # About SHAPE / width^2 independent speckles know it to 2 %; linear between whole lags.
    assert speckle_size(blurred_noise(sd), EVERYWHERE) == pytest.approx(
        FWHM * np.sqrt(2) * sd, rel=0.05
    )


def test_holes_do_not_change_the_width() -> None:
    image, mask = blurred_noise(3.0), with_holes()
    painted = np.where(mask, image, 50.0)
    assert speckle_size(painted, mask) == pytest.approx(speckle_size(image, EVERYWHERE), rel=0.05)


def test_without_contrast_a_speckle_is_as_wide_as_can_be() -> None:
    image, nowhere = blurred_noise(3.0), np.zeros(SHAPE, dtype=np.bool_)
    assert speckle_size(image, nowhere) == speckle_size(0.0 * image, EVERYWHERE) == 128.0


def test_the_paper_s_speckle_is_as_wide_as_its_pixels_differences_say() -> None:
    """Two pixels differ by half as much as any two do, at half the width."""
    image = Speckle(SpeckleSpec(), SHAPE).image()
    lags = np.arange(1, 15)
    apart = [np.mean((image[:, k:] - image[:, :-k]) ** 2) for k in lags]
    apart = 0.5 * (apart + np.array([np.mean((image[k:] - image[:-k]) ** 2) for k in lags]))
    independent = 2.0 * np.interp(image.var(), apart, lags)
    assert independent == pytest.approx(12.4, abs=0.5)
    assert speckle_size(image, EVERYWHERE) == pytest.approx(independent, rel=0.05)


def test_a_small_model_error_needs_no_blur() -> None:
    """10 px speckles and w of 2 px, as in the paper's virtual experiment."""
    image = Speckle(SpeckleSpec(), SHAPE).image()
    final = FinalSmoothing.of(ImagePair(image, image, PLAIN), 2.0)
    assert final.blur_px == 0.0
    assert "on the unfiltered images" in final.text


def test_a_blur_makes_speckles_as_wide_as_the_rule_says() -> None:
    image, model_error = blurred_noise(1.5), 2.0
    final = FinalSmoothing.of(ImagePair(image, image, PLAIN), model_error)
    after = speckle_size(ndimage.gaussian_filter(image, final.blur_px), EVERYWHERE)
    assert after == pytest.approx(WIDTHS * model_error, rel=0.05)
    assert f"blurred by {final.blur_px:.1f} px" in final.text


def test_a_blurred_pair_has_the_contrast_of_the_blurred_reference() -> None:
    image, mask = 40.0 * blurred_noise(1.5) + 100.0, with_holes()
    pair = smoothed_pair(ImagePair(image, 2.0 * image + 30.0, PLAIN, mask, mask), 3.0)
    f, g = pair.reference, pair.deformed
    # Level and contrast of the second image, lit otherwise, are gone: the two are one.
    inside = ndimage.binary_erosion(mask, iterations=6)
    assert np.abs(f - g)[inside].max() < 1e-3 * f[inside].std()
    # Local contrasts of 1 scatter, because few speckles make each.
    assert f[inside].std() == pytest.approx(contrast_after(image, mask, 3.0), rel=0.2)


PIXEL = 0.01
GRID = PixelGrid.centred(400, 400, PIXEL)


@pytest.mark.parametrize(("wavelength", "amplitude"), [(60.0, 3.0), (100.0, 4.0)])
@pytest.mark.parametrize("seed", [1, 2])
def test_final_smoothing_comes_nearer_to_the_best_fit(
    wavelength: float, amplitude: float, seed: int
) -> None:
    """Speckles of 5 px, and waves of 3 or 4 px that the ansatz doesn't have."""
    ansatz = Ansatz(Box.centred(4.4, 4.4), (), v0_degree=3)
    a = ansatz.initial_guess(0.01) + 1e-3 * np.random.default_rng(seed).normal(size=ansatz.size)

    def displacement(points: FloatArray) -> FloatArray:
        x, y = points[..., 0], points[..., 1]
        k, size = 2 * np.pi / (wavelength * PIXEL), amplitude * PIXEL
        w = size * np.stack([np.sin(k * (y - 0.3 * x) + 1), np.sin(k * (x + 0.3 * y))], axis=-1)
        smooth = ansatz.displacement_at(a, points.reshape(-1, 2)).reshape(points.shape)
        return np.asarray(smooth + w)

    at = np.stack(np.meshgrid(GRID.x, GRID.y), axis=-1)
    came_from = at.copy()
    for _ in range(60):
        came_from = at - displacement(came_from)  # contracts by 0.45 or more each time
    speckle = Speckle(SpeckleSpec(standard_deviation=0.1, blur_px=1.0, seed=seed), GRID.shape)
    f, g = speckle.image(), speckle(*GRID.to_px(came_from[..., 0], came_from[..., 1]))
    mask = np.zeros(GRID.shape, dtype=np.bool_)
    mask[30:-30, 30:-30] = True
    pair, guess = ImagePair(f, g, GRID, mask), np.zeros(ansatz.size)
    plain, smooth = (
        correlate(pair, ansatz, guess=guess, options=CorrelationOptions(final_smoothing_px=blur))
        for blur in (0.0, None)
    )
    final = smooth.final_smoothing
    assert final is not None
    assert final.speckle_size_px == pytest.approx(5.0, abs=0.5)
    assert final.blur_px > 2.0
    best = fit_displacement(displacement(at), GRID, ansatz, a, mask)
    unfiltered, smoothed = (
        np.sqrt(np.mean((found.displacement() - best.displacement())[mask] ** 2)) / PIXEL
        for found in (plain, smooth)
    )
    # 0.37 to 2.2 px as they are, 0.23 to 0.44 px blurred.
    assert smoothed < 0.75 * unfiltered
