"""Error bars of fields: against samples of the unknowns, and against what the ansatz lacks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from filling_mode import MASK, case
from manufactured import GRID
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.correlate import correlate
from modeharvest.idic.error_bars import field_errors, leftover_covariance, noise_covariance
from modeharvest.idic.result import Result

FloatArray = NDArray[np.float64]
NOISE = 0.01
X, Y = np.linspace(-1.0, 1.0, 7), np.linspace(-1.2, 1.2, 6)


@cache
def noisy(leftover: float = 0.0) -> tuple[Result, FloatArray, FloatArray]:
    """A correlation of noisy images; ``leftover`` [mm] of a displacement is not in the ansatz."""
    ansatz, truth, f, g = case()
    if leftover:
        wavy = leftover * np.sin(2 * np.pi * GRID.x / 0.5)[None, :] * np.ones((GRID.rows, 1))
        slope = np.gradient(g, axis=1) / GRID.pixel_size
        g = g - wavy * slope
    rng = np.random.default_rng(5)
    f, g = (image + NOISE * rng.normal(size=image.shape) for image in (f, g))
    return correlate(f, g, GRID, ansatz, truth, MASK), f, g


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
    fit = correlate(*noisy()[1:], GRID, plain, plain.start(0.03), MASK)
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
    leftover = leftover_covariance(result, f, g, MASK, block=0.25)
    predicted = result.covariance(NOISE)
    # n unknowns have used up n of about 150 blocks' freedom; and the spline smooths g's noise.
    ratio = np.trace(np.linalg.solve(predicted, leftover)) / len(predicted)
    assert 0.3 < ratio < 1.1


def test_what_the_ansatz_leaves_over_shows() -> None:
    plain, f, g = noisy()
    wavy, f2, g2 = noisy(0.01)
    with_w = field_errors(wavy, X, Y, leftover_covariance(wavy, f2, g2, MASK, 0.25))
    without = field_errors(plain, X, Y, leftover_covariance(plain, f, g, MASK, 0.25))
    assert np.median(with_w.displacement[..., 0]) > 1.5 * np.median(without.displacement[..., 0])


def test_too_few_blocks_are_refused() -> None:
    result, f, g = noisy()
    with pytest.raises(InputError, match="expected at least 8 blocks"):
        leftover_covariance(result, f, g, MASK, block=2.0)


def test_examples_of_white_noise_give_the_cramer_rao_bound() -> None:
    result, f, g = noisy()
    rng = np.random.default_rng(8)
    examples = [NOISE * rng.normal(size=(2, *f.shape)) for _ in range(12)]
    covariance = noise_covariance(result, f, g, ((n[0], n[1]) for n in examples), MASK, 0.25)
    predicted = result.covariance(NOISE)
    # A mean over all n directions of chi squared with some thousand degrees of freedom each;
    # the noise of g weighs 1/det F, some 5 %, more, and less where a spline is between pixels.
    ratio = np.trace(np.linalg.solve(predicted, covariance)) / len(predicted)
    assert 0.9 < ratio < 1.12
