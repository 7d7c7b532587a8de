"""A field of points: what is lost is counted, what a model leaves is compared with its noise."""

from __future__ import annotations

import numpy as np
import pytest

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.local.field import LocalField
from modeharvest.util.errors import InputError

X, Y = (a.ravel() for a in np.meshgrid(np.arange(5.0), np.arange(4.0)))
U = np.column_stack([0.1 * X, -0.2 * Y])


def test_lost_points_are_counted_and_left_out() -> None:
    u = U.copy()
    u[3] = np.nan
    given = np.ones(20, dtype=bool)
    given[7] = False
    field = LocalField(X, Y, u, given)
    assert field.lost == 2
    assert field.valid_share == pytest.approx(0.9)
    assert len(field.valid_points()[0]) == 18
    assert field.spacing == 1.0
    assert np.isfinite(field.rms)


def test_regions_are_cut_out_by_box() -> None:
    field = LocalField(X, Y, U, sd=np.full((20, 2), 0.01))
    part = field.within(Box(0.5, 2.5, -0.5, 1.5))
    assert sorted(zip(part.x, part.y, strict=True)) == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert part.sd is not None
    assert part.sd.shape == (4, 2)
    with pytest.raises(InputError, match="got none"):
        field.within(Box(10, 11, 0, 1))


def test_what_a_model_leaves_is_set_against_the_fields_own_errors() -> None:
    """w = signal + noise: its rms beyond the noise is the signal's, within statistics."""
    rng = np.random.default_rng(1)
    n, signal, noise = 4000, 0.03, 0.04
    points = rng.uniform(-5, 5, (n, 2))
    slow = points @ np.array([[0.1, 0.0], [0.02, -0.05]])
    w = signal * np.sqrt(2) * np.sin(points[:, ::-1] * 3 + rng.uniform(0, 2 * np.pi, (n, 2)))
    sd = np.full((n, 2), noise)
    field = LocalField(*points.T, slow + w + rng.normal(0, noise, (n, 2)), sd=sd)
    left = field.less(lambda p: p @ np.array([[0.1, 0.0], [0.02, -0.05]]))
    # 8000 values: rms² is known within 2 %, so its square root less the noise within 3 %.
    assert left.rms == pytest.approx(np.hypot(signal, noise), rel=0.03)
    assert left.rms_beyond_noise == pytest.approx(signal, rel=0.06)
    quiet = field.less(lambda p: field.u)
    assert quiet.rms_beyond_noise == 0.0
    assert np.isnan(LocalField(X, Y, U).rms_beyond_noise)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"u": U[:3]}, r"got \(20,\), \(20,\) and \(3, 2\)"),
        ({"sd": U[:, 0]}, "expected sd"),
        ({"valid": np.ones(3, bool)}, "expected valid"),
        ({"u": np.full((20, 2), np.nan)}, "at least one valid point"),
    ],
)
def test_bad_fields_are_named(values: dict[str, np.ndarray], words: str) -> None:
    with pytest.raises(InputError, match=words):
        LocalField(**({"x": X, "y": Y, "u": U} | values))
