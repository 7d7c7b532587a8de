"""Modes: the paper's Eq. (6), its two equivalent starts, scale, support and derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import FourierMode, ModeFamily, Taper, free_family, square_family
from modeharvest.util.errors import InputError

L = 1.9
TAPER = Taper(Box.centred(11.4, 19.0), 0.5 * L)
few = settings(max_examples=20, deadline=None, derandomize=True)
parameter = st.floats(-1.5, 1.5)


@few
@given(st.lists(parameter, min_size=7, max_size=7), st.floats(-5, 5), st.floats(-9, 9))
def test_square_family_is_the_papers_equation(a: list[float], x: float, y: float) -> None:
    mode = FourierMode.scaled(square_family(), L, TAPER)
    s1 = np.sin(np.pi / L * (a[1] * x + a[2] * y + a[5]))
    s2 = np.sin(np.pi / L * (a[3] * x + a[4] * y + a[6]))
    expected = 0.02 * np.array([a[0] * (-s1 - s2), s1 - s2])
    found = mode.evaluate(np.array(a), np.array([x]), np.array([y]))[0]
    np.testing.assert_allclose(found, expected, atol=1e-15)


def test_start_at_a_junction_is_cos_sin() -> None:
    # facts: phi_x ~ -cos(pi x/l) sin(pi y/l), phi_y ~ +sin cos, origin at a junction.
    mode = FourierMode.scaled(square_family("junction"), L, TAPER)
    x, y = np.linspace(-5, 5, 11), np.linspace(-9, 9, 11)[::-1]
    t, s = np.pi * x / L, np.pi * y / L
    phi = mode.evaluate(mode.family.start, x, y)
    np.testing.assert_allclose(phi[:, 0], -0.04 * np.cos(t) * np.sin(s), atol=1e-15)
    np.testing.assert_allclose(phi[:, 1], 0.04 * np.sin(t) * np.cos(s), atol=1e-15)


def test_the_two_origins_describe_one_pattern() -> None:
    # A hole's centre lies half a cell along x and y from a junction; the sign of v is free.
    wide = Taper(Box.centred(100, 100), 1.0)
    junction = FourierMode.scaled(square_family("junction"), L, wide)
    hole = FourierMode.scaled(square_family("hole"), L, wide)
    x, y = np.linspace(-5, 5, 21), np.linspace(-4, 6, 21)
    a = junction.evaluate(junction.family.start, x + L / 2, y + L / 2)
    b = hole.evaluate(hole.family.start, x, y)
    assert min(abs(a - b).max(), abs(a + b).max()) < 1e-15


def test_scale_of_the_square_mode() -> None:
    # The unscaled maximum is 2 (facts.md), so 0.04 needs 0.02.
    assert FourierMode.scaled(square_family(), L, TAPER).scale == pytest.approx(0.02, rel=1e-12)


def test_taper_over_half_a_cell() -> None:
    np.testing.assert_allclose(
        TAPER.along_x([0, 5.7, 5.7 + L / 4, 5.7 + L / 2, 9]), [1, 1, 0.5, 0, 0]
    )
    np.testing.assert_allclose(TAPER.along_y([-9.5, -9.5 - L / 4, -12]), [1, 0.5, 0])


@few
@given(st.integers(0, 1000))
def test_sensitivities_against_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    family = free_family(rng.normal(size=(3, 5)))
    mode = FourierMode(family, L, 0.7, TAPER)
    a, x, y = rng.normal(size=family.size), rng.uniform(-7, 7, 6), rng.uniform(-10, 10, 6)
    h = 1e-5
    steps = h * np.eye(family.size)
    differences = np.stack(
        [(mode.evaluate(a + s, x, y) - mode.evaluate(a - s, x, y)) / (2 * h) for s in steps], -1
    )
    # Third derivatives of sin(pi/l k x) with k x up to 3 * 10 mm: (50)^3 h^2/6 = 2e-6.
    np.testing.assert_allclose(mode.sensitivities(a, x, y), differences, atol=5e-6)


def test_free_family_begins_where_reported_and_holds_the_largest_amplitude() -> None:
    waves = np.array([[0.2, -0.9, 1.0, 0.0, 0.1], [0.5, 0.3, 0.0, 1.0, 0.2]])
    family = free_family(waves)
    np.testing.assert_array_equal(family.waves(family.start), waves)
    assert family.size == 9
    assert "B1" not in family.names
    assert family.units[family.names.index("c2")] == "mm"


def test_bad_families() -> None:
    with pytest.raises(InputError, match="origin"):
        square_family("corner")
    with pytest.raises(InputError, match="matrix of shape"):
        ModeFamily("x", np.ones((4, 2)), np.ones(4), np.ones(2))
    with pytest.raises(InputError, match="offset"):
        ModeFamily("x", np.ones((5, 2)), np.ones(4), np.ones(2))
    with pytest.raises(InputError, match="names"):
        ModeFamily("x", np.ones((5, 2)), np.ones(5), np.ones(2), names=("one",))
    with pytest.raises(InputError, match="waves"):
        free_family([[1.0, 2.0]])
    with pytest.raises(InputError, match="zero"):
        FourierMode.scaled(ModeFamily("0", np.eye(5), np.zeros(5), np.zeros(5)), L, TAPER)
    with pytest.raises(InputError, match="half-wavelength"):
        FourierMode(square_family(), 0.0, 1.0, TAPER)
    with pytest.raises(InputError, match="taper"):
        Taper(Box(0, 1, 0, 1), 0.0)


@few
@given(st.tuples(*[st.floats(-3, 3)] * 2), st.sampled_from(["hole", "junction"]))
def test_moved_family_is_the_field_moved(shift: tuple[float, float], origin: str) -> None:
    family, x = square_family(origin), np.linspace(-2, 2, 7)
    y = x[:, None] + 0.3
    far = Taper(Box(-99.0, 99.0, -99.0, 99.0), 1.0)
    there = FourierMode(family.moved(shift), 1.9, 1.0, far)
    here = FourierMode(family, 1.9, 1.0, far)
    moved = there.evaluate(there.family.start, x, y)
    expected = here.evaluate(family.start, x - shift[0], y - shift[1])
    np.testing.assert_allclose(moved, expected, atol=1e-12)


def test_a_family_with_fixed_phases_cannot_be_moved() -> None:
    fixed = ModeFamily("fixed", np.eye(5)[:, :4], np.zeros(5), np.ones(4))
    with pytest.raises(InputError, match="free phases"):
        fixed.moved((0.5, 0.0))
