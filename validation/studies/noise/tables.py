"""The tables of a noise study."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.validation.studies.noise.causes import CAUSES
from modeharvest.validation.studies.noise.fields import PARTS, Points
from modeharvest.validation.studies.noise.levels import Levels, WithoutNoise
from modeharvest.validation.studies.noise.statistics import Share
from modeharvest.validation.studies.subject import Scene

WORDS = {
    "bound": "bound: 2 s²M⁻¹",
    "det F": "and det F",
    "curvature": "and the cost’s curvature",
    "least": "and the noise’s gradient in w",
}
"""What each of the causes is called."""


def summary_table(levels: Levels, ours: Levels, soft: Levels, scene: Scene) -> pd.DataFrame:
    """A row for each level and quantity; error bars by three different covariances."""
    px = scene.images.grid.pixel_size
    everything = np.ones(scene.ansatz.size, dtype=np.bool_)
    families = {"all unknowns": everything} | {
        f"unknowns of {name}": part for name, part in _families(scene).items()
    }
    rows = []
    for level in sorted(levels):
        for name in (*PARTS, *families):
            bound, least, curved = (
                by[level][name] if name in PARTS
                else by[level]["unknowns"].of(families[name]).standardised
                for by in (levels, ours, soft)
            )  # fmt: skip
            rows.append({
                "noise [% of full scale]": 100.0 * level,
                "quantity": name,
                "bound, rms [px]": bound.rms_bound / px if name in PARTS else np.nan,
                "rms error / bound": bound.ratio.value,
                "± (1)": bound.ratio.error,
                "rms error / least of least squares": least.ratio.value,
                "± (2)": least.ratio.error,
                "bias / bound": bound.bias.value,
                "± (3)": bound.bias.error,
                "share in 95 % intervals": least.coverage.value,
                "± (4)": least.coverage.error,
                "by curvature only": curved.coverage.value,
                "by JᵀJ only": bound.coverage.value,
            })  # fmt: skip
    return pd.DataFrame(rows)


def to_read(summary: pd.DataFrame) -> pd.DataFrame:
    """The same with values and their standard errors together."""
    read, last = pd.DataFrame(), ""
    for name in summary:
        if name.startswith("±"):
            read[last] = [
                str(Share(*pair)) for pair in zip(summary[last], summary[name], strict=True)
            ]
        else:
            shares = name.startswith("by ")
            read[name] = summary[name].map("{:.3f}".format) if shares else summary[name]
            last = name
    return read


def causes_table(levels: Levels, home: WithoutNoise) -> pd.DataFrame:
    """Rms standard deviation or error over the bound, by causes and as measured; by fields."""
    first = levels[min(levels)]
    rows = []
    for cause in CAUSES:
        told = home.told(cause).parts()
        row: dict[str, Any] = {"what": WORDS[cause]}
        for name in PARTS:
            counted = first[name].counted
            row[name] = float(np.sqrt((told[name][counted] ** 2).mean()))
        rows.append(row)
    bound = dict(rows[0])
    rows = [{k: v if k == "what" else v / bound[k] for k, v in row.items()} for row in rows]
    for level, parts in sorted(levels.items()):
        measured = {name: parts[name].ratio.value for name in PARTS}
        rows.append({"what": f"measured at {100 * level:g}\u00a0%", **measured})
    return pd.DataFrame(rows)


def unknowns_table(levels: Levels, ours: Levels, scene: Scene) -> pd.DataFrame:
    """A row for each unknown and level."""
    ansatz = scene.ansatz
    parts = []
    for level, found in sorted(levels.items()):
        bound, least = found["unknowns"], ours[level]["unknowns"]
        parts.append(pd.DataFrame({
            "noise": level, "unknown": ansatz.names, "unit": ansatz.units, "bound": bound.bound,
            "rms error / bound": bound.ratios,
            "rms error / least of least squares": least.ratios, "bias / bound": bound.biases,
            "share in 95 % intervals": least.covered,
        }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def maps_table(levels: Levels, ours: Levels, points: Points) -> pd.DataFrame:
    """A row for each level, field and point; vectors' components together."""
    parts = []
    for level, found in sorted(levels.items()):
        for name in PARTS:
            bound, least = found[name], ours[level][name]
            parts.append(pd.DataFrame({
                "noise": level, "field": name, "x [mm]": points.x, "y [mm]": points.y,
                "bound [mm]": np.sqrt((bound.bound**2).sum(axis=-1)),
                "rms error / bound": np.sqrt((bound.ratios**2).mean(axis=-1)),
                "rms error / least of least squares": np.sqrt((least.ratios**2).mean(axis=-1)),
                "bias / bound": np.sqrt((bound.biases**2).mean(axis=-1)),
                "share in 95 % intervals": least.covered.mean(axis=-1),
            }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def _families(scene: Scene) -> dict[str, NDArray[np.bool_]]:
    """Which unknowns are those of v0, of v1 and of phi1."""
    names = np.array(scene.ansatz.names)
    starts = {"v0": "v0", "v1": "v1[", "phi1": "phi1."}
    families = {k: np.char.startswith(names, start) for k, start in starts.items()}
    return {name: part for name, part in families.items() if part.any()}
