"""Verdicts against the expected values: each is computed, and each can fail."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from modeharvest.validation.summary import expectations


def snapshot(strain: float, **changes: Any) -> SimpleNamespace:
    sound = {
        "nominal_strain": strain,
        "negative_pivots": 0,
        "pattern_amplitude_px": 28.0,
        "pattern_inner_px": 0.5,
        "pattern_corners_px": 2.0,
        "rms_best_fit_px": 1.9,
        "details_px": {"idic_to_best_fit": SimpleNamespace(rms_length=0.34)},
        "mode_deviation_percent": [0.1, -1.5, 0, 0, 0, 0.3, 0],
    }
    return SimpleNamespace(**sound | changes)


def summary(before: SimpleNamespace, after: SimpleNamespace, **changes: Any) -> Any:
    whole = {
        "critical_strain": 0.0963,
        "inverse_map_max_residual_px": 1e-12,
        "snapshots": [before, after],
    }
    return SimpleNamespace(**whole | changes)


SOUND = summary(snapshot(0.078), snapshot(0.128))


def test_sound_run_meets_everything() -> None:
    rows = expectations(SOUND)
    assert all(row.ok for row in rows)
    assert all(row.source and row.expected for row in rows)
    # Critical strain, residual; two before and five after buckling: each quantity once.
    assert len(rows) == 9


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (summary(snapshot(0.078), snapshot(0.128), critical_strain=0.0995), "critical strain"),
        (summary(snapshot(0.078), snapshot(0.128), inverse_map_max_residual_px=2e-10), "inverse"),
        (summary(snapshot(0.078, negative_pivots=1), snapshot(0.128)), "pivots at 7.8"),
        (summary(snapshot(0.078, pattern_inner_px=3.0), snapshot(0.128)), "corners at 7.8"),
        (summary(snapshot(0.078), snapshot(0.128, pattern_amplitude_px=20.0)), "amplitude at 12.8"),
        (summary(snapshot(0.078), snapshot(0.128, rms_best_fit_px=2.4)), "best possible fit"),
        (
            summary(
                snapshot(0.078),
                snapshot(0.128, details_px={"idic_to_best_fit": SimpleNamespace(rms_length=0.36)}),
            ),
            "length of the vectors",
        ),
        (
            summary(snapshot(0.078), snapshot(0.128, mode_deviation_percent=[0, -2.5, 0])),
            "deviation",
        ),
    ],
)
def test_one_wrong_number_fails_one_verdict(bad: Any, words: str) -> None:
    failed = [row.quantity for row in expectations(bad) if not row.ok]
    assert len(failed) == 1
    assert words in failed[0]


def test_run_without_a_critical_point_claims_nothing_about_it() -> None:
    rows = expectations(summary(*SOUND.snapshots, critical_strain=None))
    assert not any("critical" in row.quantity for row in rows)
