"""Tables of measured modes, a row for each specimen or parameter."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.validation.studies.modes.specimen import PARAMETERS

IDEAL = np.array([1.0, 1.0, 1.0, -1.0, 1.0, 0.0, 0.0])
"""Eq. (mode) with a solid junction at the origin, phases in shares of l."""
WAVES = list(PARAMETERS[1:5])
"""The wave vectors' components."""

_BUCKLING = {
    "smallest_ratio": "d/l from", "largest_ratio": "to", "first": "buckles first into",
    "pattern_share": "pattern’s share of that mode", "critical_strain": "critical strain [%]",
    "lattice_first": "infinite lattice: first", "lattice_pattern_strain": "pattern critical at [%]",
    "strain": "measured at [%]", "unstable_pivots": "negative pivots there",
    "amplitude": "rms of v₁φ₁ [l]", "simulation": "simulation",
}  # fmt: skip
_LIKENESS = {
    "overlap_lattice": "with the infinite lattice: measured",
    "best_overlap_lattice": "best fit with it",
    "lattice_overlap_ideal": "Eq. (mode) with it", "overlap_truth": "with the specimen: measured",
    "best_overlap_truth": "best fit with that", "w_px": "truth − IDIC [px]",
    "best_px": "truth − best fit [px]", "lost_px": "IDIC − best fit [px]",
    "iterations": "iterations", "outcome": "outcome",
}  # fmt: skip


def buckling(ran: pd.DataFrame) -> pd.DataFrame:
    """A row for each specimen: into what it buckles, and when."""
    percent = {name: 100.0 * ran[name] for name in _BUCKLING if name.endswith("strain")}
    return _renamed(ran.assign(**percent), _BUCKLING)


def alike(seen: pd.DataFrame) -> pd.DataFrame:
    """A row for each specimen: overlaps of its mode, and errors of its displacement."""
    return _renamed(seen, _LIKENESS)


def _renamed(rows: pd.DataFrame, columns: Mapping[str, str]) -> pd.DataFrame:
    names = {"varied": "varied", "level": "level", **columns}
    return rows.reindex(columns=list(names)).rename(columns=names)


def summed_up(seen: pd.DataFrame) -> pd.DataFrame:
    """A row for each specimen: a₁, and how far its wave vectors and phases are from Eq. (mode)."""
    off, best = 100.0 * deviations(seen), 100.0 * deviations(seen, "best_")
    sd = 100.0 * seen[[f"{name}_sd_leftover" for name in PARAMETERS]].set_axis(PARAMETERS, axis=1)
    phases = list(PARAMETERS[5:])
    return pd.DataFrame({
        "varied": seen["varied"], "level": seen["level"], "a₁": seen["a1"],
        "± 2 sd": 0.02 * sd["a1"], "a₁ of the best fit": seen["best_a1"],
        "a₁ of the infinite lattice": seen["lattice_a1"],
        "wave vectors off by up to [%]": off[WAVES].abs().max(axis=1),
        "± 2 sd [%]": 2.0 * sd[WAVES].max(axis=1),
        "those of the best fit [%]": best[WAVES].abs().max(axis=1),
        "phases off by up to [% of l]": off[phases].abs().max(axis=1),
        "± 2 sd [% of l]": 2.0 * sd[phases].max(axis=1),
        "those of the best fit [% of l]": best[phases].abs().max(axis=1).round(6),
    })  # fmt: skip


def parameters(seen: pd.DataFrame) -> pd.DataFrame:
    """A row for each parameter of each specimen, phases in shares of l."""
    rows = [
        {"varied": row["varied"], "level": row["level"], "d/l": row["ratio"], "parameter": name,
         "Eq. (mode)": ideal, "measured": row[name],
         "± 2 sd by what is left over": 2.0 * row[f"{name}_sd_leftover"],
         "± 2 sd by 1 % of noise": 2.0 * row[f"{name}_sd_noise"],
         "best fit": row[f"best_{name}"],
         "infinite lattice": row["lattice_a1"] if name == "a1" else ideal}
        for _, row in seen.iterrows() for name, ideal in zip(PARAMETERS, IDEAL, strict=True)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def deviations(seen: pd.DataFrame, prefix: str = "") -> pd.DataFrame:
    """Parameters less those of Eq. (mode), phases in shares of l."""
    values = seen[[prefix + name for name in PARAMETERS]].to_numpy(np.float64) - IDEAL
    return pd.DataFrame(values, seen.index, list(PARAMETERS))


def misses(seen: pd.DataFrame) -> NDArray[np.float64]:
    """(specimens, 7) measured less best fit, in standard deviations by what is left over."""
    sd = seen[[f"{name}_sd_leftover" for name in PARAMETERS]].to_numpy(np.float64)
    return np.asarray((deviations(seen) - deviations(seen, "best_")).to_numpy() / sd)
