"""Equivalents of the mode's parameters, and that the ansatz sees the same field in them.

What the equations alone say of them is in test_spectrum.py.
"""

from __future__ import annotations

import manufactured
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known_fields import square_mode

from modeharvest.idic.spectra.pattern import REFERENCE_MODE, mode_deviation, mode_equivalent

PITCH = manufactured.UNIT_CELL
modes = st.tuples(*[st.floats(-1.5, 1.5)] * 7)
X, Y = np.linspace(-1.4, 1.4, 9), np.linspace(-1.6, 1.6, 7)


def test_square_mode_is_the_ansatzs_own() -> None:
    ansatz = manufactured.one_mode()
    a = manufactured.random_unknowns(ansatz, 4, 0.1)
    x, y = np.linspace(-1.0, 1.0, 9), np.linspace(-1.2, 1.2, 7)  # where the taper is 1
    plain = square_mode(a[ansatz.phi_slice(0)], PITCH, *np.meshgrid(x, y))
    np.testing.assert_allclose(ansatz.phi(0, a, x, y), 0.02 * plain, atol=1e-16)


@given(mode=modes, target=modes, seed=st.integers(0, 100))
def test_v1_phi_stays_the_same_field(
    mode: tuple[float, ...], target: tuple[float, ...], seed: int
) -> None:
    ansatz = manufactured.one_mode()
    a = manufactured.random_unknowns(ansatz, seed, 0.1)
    a[ansatz.phi_slice(0)] = mode
    other = a.copy()
    other[ansatz.phi_slice(0)], sign = mode_equivalent(mode, PITCH, target)
    other[ansatz.v_slice(0)] *= sign
    np.testing.assert_allclose(
        ansatz.displacement(other, X, Y), ansatz.displacement(a, X, Y), atol=1e-12
    )


@given(mode=modes, target=modes)
def test_the_nearest_is_no_farther_and_stays(
    mode: tuple[float, ...], target: tuple[float, ...]
) -> None:
    def distance(m: np.ndarray) -> float:
        return float(np.linalg.norm(m - np.array(target)))  # the pitch is 1 mm

    nearest, _ = mode_equivalent(mode, PITCH, target)
    assert distance(nearest) <= distance(np.array(mode)) + 1e-12
    again, _ = mode_equivalent(nearest, PITCH, target)
    assert distance(again) == pytest.approx(distance(nearest), abs=1e-12)


def test_deviation_in_percent() -> None:
    mode = np.add(REFERENCE_MODE, [0.01, -0.02, 0, 0, 0.03, 0.019, -0.038])
    expected = [1, -2, 0, 0, 3, 1, -2]  # phases in per cent of l = 1.9 mm
    np.testing.assert_allclose(mode_deviation(mode, 1.9), expected, atol=1e-12)
    # The same pattern, both waves half a wavelength on: still the same deviation.
    mode[5:] += 1.9
    np.testing.assert_allclose(mode_deviation(mode, 1.9), expected, atol=1e-10)
