"""What a right run of the paper's virtual experiment gives, and where each value comes from.

"Independent calculation" stands for a throw-away implementation made before this project (other
code, another mesh, 0.07 to 0.12 mm): the paper prints pictures, not these numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

PAPER = "Maraghechi et al. 2024, doi 10.1016/j.ijsolstr.2024.112916"
INDEPENDENT = "independent calculation"


@dataclass(frozen=True)
class Expectation:
    """An expected value against the one obtained.

    Parameters
    ----------
    quantity, unit
        What, and in what.
    expected
        In words, with its range.
    obtained
        The value of this run.
    ok
        Whether it lies in the range.
    source
        Where the expectation comes from.
    """

    quantity: str
    unit: str
    expected: str
    obtained: float
    ok: bool
    source: str


def expectations(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Compare a summary of the paper's specimen with what is expected of it.

    Parameters
    ----------
    summary
        The content of ``summary.json``.

    Returns
    -------
    list of dict
        The fields of :class:`Expectation`, a row each; snapshots that are not there, and a
        critical strain that was not found, are left out.
    """
    rows = [
        Expectation(
            "largest residual of the inverse mapping", "px", "at most 1e-10",
            summary["inverse_map_max_residual_px"],
            summary["inverse_map_max_residual_px"] <= 1e-10, "this project's promise",
        )
    ]  # fmt: skip
    critical = summary.get("critical_strain")
    if critical is not None:
        ok = abs(100 * critical - 9.6) <= 0.3
        rows.insert(0, Expectation("critical strain", "%", "9.6 ± 0.3", 100 * critical, ok,
                                   INDEPENDENT))  # fmt: skip
    for snapshot in summary["snapshots"]:
        is_buckled = critical is not None and snapshot["nominal_strain"] > critical
        rows += _after(snapshot) if is_buckled else _before(snapshot)
    return [asdict(row) for row in rows]


def _before(snapshot: Mapping[str, Any]) -> list[Expectation]:
    at = f" at {100 * snapshot['nominal_strain']:.1f} %"
    inner, corners = snapshot["pattern_inner_px"], snapshot["pattern_corners_px"]
    return [
        Expectation("negative pivots" + at, "-", "0", snapshot["negative_pivots"],
                    snapshot["negative_pivots"] == 0, "stability"),
        Expectation("pattern inside over pattern in the corners" + at, "-",
                    "below 1: v₁ near zero except at the corners", inner / corners,
                    inner < corners, PAPER + ", Fig. (virt)"),
    ]  # fmt: skip


def _after(snapshot: Mapping[str, Any]) -> list[Expectation]:
    at = f" at {100 * snapshot['nominal_strain']:.1f} %"
    worst = max((abs(v) for v in snapshot.get("mode_deviation_percent", ())), default=0.0)
    pattern, best = snapshot["pattern_amplitude_px"], snapshot["rms_best_fit_px"]
    loss = snapshot["rms_idic_to_best_fit_px"]
    length = snapshot["details_px"]["idic_to_best_fit"]["rms_length"]
    return [
        Expectation("negative pivots" + at, "-", "0", snapshot["negative_pivots"],
                    snapshot["negative_pivots"] == 0, "stability"),
        Expectation("pattern amplitude" + at, "px", "about 28 (25 to 31)", pattern,
                    25 <= pattern <= 31, INDEPENDENT),
        Expectation("mode's largest deviation from [1, 1, 1, −1, 1, 0, 0]" + at, "%", "at most 2",
                    worst, worst <= 2, INDEPENDENT),
        Expectation("best possible fit, rms per component" + at, "px", "about 1.9 (1.7 to 2.1)",
                    best, 1.7 <= best <= 2.1, INDEPENDENT),
        Expectation("IDIC − best fit, rms per component" + at, "px", "at most 0.35", loss,
                    loss <= 0.35, INDEPENDENT),
        Expectation("IDIC − best fit, rms of the vector's length" + at, "px", "at most 0.35",
                    length, length <= 0.35, "the same, read strictly"),
    ]  # fmt: skip
