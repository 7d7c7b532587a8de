"""The taper: 1 over the cellular region, linear to 0 over its width, nothing beyond."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import Taper
from modeharvest.util.errors import InputError

TAPER = Taper(Box(-5.7, 5.7, -9.5, 9.0), 0.95)


def test_known_values() -> None:
    x = [0.0, -5.7, 5.7, 5.7 + 0.475, -5.7 - 0.475, 5.7 + 0.95, 100.0]
    np.testing.assert_allclose(TAPER.along_x(x), [1, 1, 1, 0.5, 0.5, 0, 0], atol=1e-14)
    y = [9.0, 9.0 + 0.475, -9.5 - 0.475, -9.5 - 0.95]
    np.testing.assert_allclose(TAPER.along_y(y), [1, 0.5, 0.5, 0], atol=1e-14)


@given(t=st.floats(-20, 20), step=st.floats(0, 2))
def test_between_0_and_1_and_as_steep_as_its_width_says(t: float, step: float) -> None:
    here, there = TAPER.along_x([t, t + step])
    assert 0 <= here <= 1
    assert abs(there - here) <= step / 0.95 + 1e-14
    assert here == 1 or abs(t) > 5.7
    assert here == 0 or abs(t) < 5.7 + 0.95


def test_bad_width() -> None:
    for width in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="wider than 0 mm"):
            Taper(Box.centred(1, 1), width)
