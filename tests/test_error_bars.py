"""Error bars of fields: against samples of the unknowns, and against what the ansatz lacks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from filling_mode import MASK, case
from manufactured import GRID
from numpy.typing import NDArray

from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.pyramid import COARSE_TO_FINE, eroded
from modeharvest.idic.uncertainty.covariance import MatchedImages, field_errors
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]
NOISE = 0.01
FINEST = CorrelationOptions(levels=COARSE_TO_FINE[-1:])
USED = eroded(MASK, 2)  # as a correlation does by default
X, Y = np.linspace(-1.0, 1.0, 7), np.linspace(-1.2, 1.2, 6)


@cache
def noisy(
    model_error: float = 0.0, seed: int | None = 5, noise: float = NOISE
) -> tuple[Result, FloatArray, FloatArray]:
    """A correlation of noisy images; ``model_error`` [mm] of the motion is not in the ansatz."""
    ansatz, truth, f, g = case()
    if model_error:
        wavy = model_error * np.sin(2 * np.pi * GRID.x / 0.5)[None, :] * np.ones((GRID.rows, 1))
        slope = np.gradient(g, axis=1) / GRID.pixel_size
        g = g - wavy * slope
    if seed is not None:
        rng = np.random.default_rng(seed)
        f, g = (image + noise * rng.normal(size=image.shape) for image in (f, g))
    return correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=truth), f, g


def matched(
    result: Result, f: FloatArray, g: FloatArray, used: NDArray[np.bool_] = MASK
) -> MatchedImages:
    return MatchedImages(result, f.astype(np.float32), g.astype(np.float32), used)


def test_errors_are_those_of_unknowns_drawn_from_the_covariance() -> None:
    result, _, _ = noisy()
    covariance = result.covariance(NOISE)
    errors = field_errors(result, X, Y, covariance)
    draws = np.random.default_rng(1).multivariate_normal(result.unknowns, covariance, 2000)
    ansatz, axes = result.ansatz, (X, Y)
    for predicted, field in (
        (errors.v0, [ansatz.v0(a, *axes) for a in draws]),
        (errors.v[0], [ansatz.v(0, a, *axes) for a in draws]),
        (errors.fluctuation[0], [ansatz.fluctuation(0, a, *axes) for a in draws]),
        (errors.displacement, [ansatz.displacement(a, *axes) for a in draws]),
    ):
        seen = np.std(field, axis=0)
        # A standard deviation of 2000 draws scatters by 1/sqrt(4000) = 1.6 %; 4.5 times that
        # over some hundred values, and noise is small enough for the fields to be linear.
        assert np.allclose(seen, predicted, rtol=0.075)


def test_no_mode_no_error_of_a_mode() -> None:
    result, _, _ = noisy()
    plain = replace(result.ansatz, modes=())
    fit = correlate(ImagePair(*noisy()[1:], GRID, MASK), plain, guess=plain.initial_guess(0.03))
    errors = field_errors(fit, X, Y, fit.covariance(NOISE))
    assert errors.v.shape == (0, 6, 7)
    assert errors.fluctuation.shape == (0, 6, 7, 2)
    assert np.array_equal(errors.v0, errors.displacement)


def test_unknowns_without_information_make_their_fields_infinite() -> None:
    result, _, _ = noisy()
    covariance = result.covariance(NOISE)
    first = result.ansatz.v_slice(0).start
    covariance[first, first] = np.inf
    errors = field_errors(result, X, Y, covariance)
    assert np.isinf(errors.v).all()
    assert np.isfinite(errors.v0).all()


def test_where_all_is_noise_the_blocks_say_what_the_noise_predicts() -> None:
    result, f, g = noisy()
    found = matched(result, f, g).sandwich_covariance(0.25)
    predicted = result.covariance(NOISE)
    # n unknowns have used up n of about 150 blocks' freedom; and the spline smooths g's noise.
    ratio = np.trace(np.linalg.solve(predicted, found)) / len(predicted)
    assert 0.3 < ratio < 1.1


def test_a_model_error_shows() -> None:
    plain, f, g = noisy()
    wavy, f2, g2 = noisy(0.01)
    with_w = field_errors(wavy, X, Y, matched(wavy, f2, g2).sandwich_covariance(0.25))
    without = field_errors(plain, X, Y, matched(plain, f, g).sandwich_covariance(0.25))
    assert np.median(with_w.displacement[..., 0]) > 1.5 * np.median(without.displacement[..., 0])


def test_too_few_blocks_are_refused() -> None:
    result, f, g = noisy()
    with pytest.raises(InputError, match="expected at least 8 blocks"):
        matched(result, f, g).sandwich_covariance(2.0)


def test_examples_of_white_noise_give_the_cramer_rao_bound() -> None:
    little = 0.2 * NOISE  # more of it bends the cost of so small an image by itself
    result, f, g = noisy(noise=little)
    rng = np.random.default_rng(8)
    examples = [np.float32(little * rng.normal(size=(2, *f.shape))) for _ in range(12)]
    covariance = matched(result, f, g).noise_covariance(((n[0], n[1]) for n in examples), 0.25)
    stated, bound = (
        field_errors(result, X, Y, c).displacement for c in (covariance, result.covariance(little))
    )
    # 12 examples of 150 blocks each: a few per cent; the noise of g weighs 1/det F, 5 %, more.
    assert np.sqrt(np.mean(stated**2) / np.mean(bound**2)) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize(("model_error", "sd"), [(0.0, 0.01), (0.01, 0.02)])
def test_seeds_of_noise_scatter_as_the_curvature_predicts(model_error: float, sd: float) -> None:
    result, f, g = noisy(model_error, noise=sd)
    assert result.weighting.is_least_squares == (model_error > 0.0)
    predicted = matched(result, f, g, USED).hessian_corrected_covariance(sd)
    quiet = noisy(model_error, seed=None)[1:]
    rng = np.random.default_rng(4)
    ends = []
    for _ in range(20):
        noise = sd * rng.normal(size=(2, *f.shape))
        images = quiet[0] + noise[0], quiet[1] + noise[1]
        ends.append(
            correlate(
                ImagePair(*images, GRID, MASK), result.ansatz, guess=result.unknowns, options=FINEST
            ).unknowns
        )
    stated, seen = (
        np.sqrt(np.mean(field_errors(result, X, Y, c).displacement ** 2))
        for c in (predicted, np.cov(np.array(ends).T))
    )
    # 19 degrees of freedom over a dozen independent places: 5 %; noise adds some second
    # order (docs/explanation/metrology.md).
    assert stated == pytest.approx(seen, rel=0.2)


def test_a_model_error_lowers_the_curvature() -> None:
    without, with_w = (
        np.linalg.eigvals(
            matched(result, f, g, USED).inverse_hessian @ np.linalg.inv(result.inverse)
        ).real.max()
        for result, f, g in (noisy(), noisy(0.01))
    )
    assert with_w > 1.2 * without
