"""Chebyshev products: the identities the moment method rests on, and the boxes they live on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import chebyshev as numpy_chebyshev

from modeharvest.idic.chebyshev import Box, ChebyshevField, chebyshev, orders, sum_of_products
from modeharvest.util.errors import InputError

few = settings(max_examples=25, deadline=None, derandomize=True)
inside = st.floats(-1.0, 1.0)


@few
@given(st.floats(0.0, np.pi))
def test_defining_property(theta: float) -> None:
    n = np.arange(13)
    np.testing.assert_allclose(chebyshev(np.cos(theta), 12), np.cos(n * theta), atol=1e-13)


@few
@given(inside, st.integers(0, 6), st.integers(0, 6))
def test_product_is_half_sum_of_two(t: float, a: int, b: int) -> None:
    T = chebyshev(t, 12)
    assert T[a] * T[b] == pytest.approx(0.5 * (T[a + b] + T[abs(a - b)]), abs=1e-14)


@pytest.mark.parametrize(("degree", "terms"), [(0, 1), (1, 3), (5, 21), (6, 28)])
def test_number_of_terms(degree: int, terms: int) -> None:
    assert len(set(orders(degree))) == terms == ChebyshevField(Box(0, 1, 0, 1), degree).size
    assert all(i + j <= degree for i, j in orders(degree))


def test_field_against_numpy() -> None:
    box = Box(-1.0, 3.0, 2.0, 2.5)
    field = ChebyshevField(box, 4)
    rng = np.random.default_rng(1)
    c = rng.normal(size=field.size)
    x, y = rng.uniform(-1, 3, 9), rng.uniform(2, 2.5, 9)
    expected = numpy_chebyshev.chebval2d((x - 1.0) / 2.0, (y - 2.25) / 0.25, field.square(c))
    np.testing.assert_allclose(field.evaluate(c, x, y), expected, atol=1e-13)
    np.testing.assert_allclose(field.basis(x, y) @ c, expected, atol=1e-13)


def test_open_grid_equals_points() -> None:
    field = ChebyshevField(Box.centred(2.0, 4.0), 5)
    c = np.random.default_rng(2).normal(size=field.size)
    x, y = np.linspace(-1, 1, 7)[None, :], np.linspace(2, -2, 5)[:, None]
    full_x, full_y = (np.ascontiguousarray(a) for a in np.broadcast_arrays(x, y))
    np.testing.assert_allclose(
        field.evaluate(c, x, y), field.evaluate(c, full_x, full_y), atol=1e-13
    )


def test_sum_of_products_broadcasts() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(4, 1, 6)), rng.normal(size=(4, 5, 1))
    np.testing.assert_allclose(sum_of_products(x, y), (x * y).sum(axis=0), atol=1e-14)


@pytest.mark.parametrize("limits", [(1, 0, 0, 1), (0, 1, 1, 1), (0, float("nan"), 0, 1)])
def test_impossible_box(limits: tuple[float, float, float, float]) -> None:
    with pytest.raises(InputError, match="expected"):
        Box(*limits)


def test_negative_degree() -> None:
    with pytest.raises(InputError, match="degree"):
        ChebyshevField(Box(0, 1, 0, 1), -1)
