"""What the table of a noise study tells: bias, scatter against the bound, coverage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.validation.page import short
from modeharvest.validation.studies.noise_fields import PARTS, Points
from modeharvest.validation.studies.noise_plots import draw_levels, draw_maps, draw_unknowns
from modeharvest.validation.studies.noise_statistics import Pairs
from modeharvest.validation.studies.study import Findings, KeyNumber
from modeharvest.validation.studies.subject import Scene

FloatArray = NDArray[np.float64]
Levels = Mapping[float, Mapping[str, Pairs]]
"""For each level of noise the errors of "unknowns", "v0 unknowns" … and of the fields."""


def findings(table: pd.DataFrame, scene: Scene, seeds: str) -> Findings:
    """Read the table of all realisations.

    Parameters
    ----------
    table
        A row for each case of :func:`modeharvest.validation.studies.noise.one_realisation`.
    scene
        The pair of images.
    seeds
        In words.
    """
    points = Points.of(scene)
    levels = read_levels(table, points)
    shown = sorted(levels)[len(levels) // 2]
    home = table[(table["level"] == 0.0) & (table["error"] == "")].iloc[0]
    unknowns = _unknowns(levels, scene)
    summary = _summary(levels, scene)
    pairs = max(len(parts["u"].errors) for parts in levels.values())
    made = f"{pairs} pairs of realisations; {seeds}"
    return Findings(
        numbers={
            "levels": summary.to_dict("records"),
            "noise_free": {k: float(home[k]) for k in ("w_px", "best_px", "lost_px")},
            "not_converged": _not_converged(table),
        },
        sentences=_sentences(levels, scene, table, home),
        keys=_keys(levels, shown),
        plots=(
            draw_levels(levels, "ratio", "rms error / bound", made),
            draw_levels(levels, "bias", "bias / bound", made),
            draw_levels(levels, "coverage", "share in 95 % intervals", made),
            draw_unknowns(levels[shown]["unknowns"], scene.ansatz.names, shown, made),
            draw_maps(levels[shown], points, shown, made),
        ),
        tables={"Noise levels": summary},
        attachments={"Each unknown": unknowns, "Maps": _maps(levels, points)},
    )


def read_levels(table: pd.DataFrame, points: Points) -> Levels:
    """The errors of all realisations, against the end without noise.

    Raises
    ------
    InputError
        If the case without noise failed, or no level has two whole pairs.
    """
    done = table[table["error"] == ""]
    home = done[done["level"] == 0.0]
    if not len(home):
        raise InputError("study: expected the case without noise to succeed, got none that did")
    first = home.iloc[0]
    found = {}
    for level, part in done[done["level"] > 0.0].groupby("level"):
        by_pair = [pair.sort_values("sign") for _, pair in part.groupby("pair") if len(pair) == 2]
        if len(by_pair) >= 2:
            found[float(level)] = _read_level(float(level), by_pair, first, points)
    if not found:
        raise InputError("study: expected two whole pairs of realisations at a level, got fewer")
    return found


def _read_level(
    level: float, by_pair: list[pd.DataFrame], home: pd.Series, points: Points
) -> dict[str, Pairs]:
    def column(name: str) -> FloatArray:
        return np.array([[np.array(v) for v in pair[name]] for pair in by_pair])

    true = np.array(home["unknowns"])
    a = column("unknowns")
    bound = level * np.array(home["told"])
    known = np.isfinite(bound)  # the others are not determined by the images
    unknowns = Pairs(np.where(known, a - true, 0.0), column("told"), np.where(known, bound, 0.0))
    shape = (*a.shape[:2], -1, 7)
    own = column("told_fields").reshape(shape)
    least = level * np.array(home["told_fields"]).reshape(-1, 7)
    least[~points.cellular, PARTS["v1"]] = 0.0  # where phi1 fades out it does not count
    off = np.array([[points.fields(one) for one in pair] for pair in a]) - points.fields(true)
    found = {"unknowns": unknowns}
    for name, part in PARTS.items():
        found[name] = Pairs(off[..., part], own[..., part], least[..., part])
    return found


def _families(scene: Scene) -> dict[str, NDArray[np.bool_]]:
    """Which unknowns are those of v0, of v1 and of phi1."""
    names = np.array(scene.ansatz.names)
    starts = {"v0": "v0", "v1": "v1[", "phi1": "phi1."}
    families = {k: np.char.startswith(names, start) for k, start in starts.items()}
    return {name: part for name, part in families.items() if part.any()}


def _summary(levels: Levels, scene: Scene) -> pd.DataFrame:
    """A row for each level and quantity."""
    px = scene.images.grid.pixel_size
    rows = []
    for level, parts in sorted(levels.items()):
        unknowns = parts["unknowns"]
        pooled = {f"unknowns of {name}": unknowns.of(part).standardised
                  for name, part in _families(scene).items()}  # fmt: skip
        for name, pairs in {**{k: parts[k] for k in PARTS}, "all unknowns": unknowns.standardised,
                            **pooled}.items():  # fmt: skip
            in_px = name in PARTS and name != "v1"
            rows.append({
                "noise [% of full scale]": 100.0 * level,
                "quantity": name,
                "bound, rms [px]": pairs.rms_bound / px if in_px else np.nan,
                "rms error / bound": pairs.ratio.value,
                "± (1)": pairs.ratio.error,
                "bias / bound": pairs.bias.value,
                "± (2)": pairs.bias.error,
                "share in 95 % intervals": pairs.coverage.value,
                "± (3)": pairs.coverage.error,
                "told sd / rms error": pairs.told_over_error,
            })  # fmt: skip
    return pd.DataFrame(rows)


def _unknowns(levels: Levels, scene: Scene) -> pd.DataFrame:
    """A row for each unknown and level."""
    ansatz = scene.ansatz
    parts = []
    for level, found in sorted(levels.items()):
        pairs = found["unknowns"]
        parts.append(pd.DataFrame({
            "noise": level, "unknown": ansatz.names, "unit": ansatz.units, "bound": pairs.bound,
            "rms error / bound": pairs.ratios, "bias / bound": pairs.biases,
            "share in 95 % intervals": pairs.covered,
        }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def _maps(levels: Levels, points: Points) -> pd.DataFrame:
    """A row for each level, field and point; vectors' components together."""
    parts = []
    for level, found in sorted(levels.items()):
        for name in PARTS:
            pairs = found[name]
            parts.append(pd.DataFrame({
                "noise": level, "field": name, "x [mm]": points.x, "y [mm]": points.y,
                "bound [mm]": np.sqrt((pairs.bound**2).sum(axis=-1)),
                "rms error / bound": np.sqrt((pairs.ratios**2).mean(axis=-1)),
                "bias / bound": np.sqrt((pairs.biases**2).mean(axis=-1)),
                "share in 95 % intervals": pairs.covered.mean(axis=-1),
            }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def _not_converged(table: pd.DataFrame) -> int:
    done = table[table["error"] == ""]
    return int((done["outcome"] != "converged").sum())


def _keys(levels: Levels, shown: float) -> tuple[KeyNumber, ...]:
    u = levels[shown]["u"]
    unknowns = levels[shown]["unknowns"].standardised
    at = f"at {100 * shown:g} % of noise"
    return (
        KeyNumber("rms error of u / bound", str(u.ratio), "", f"{at}; 1 is the least there can be"),
        KeyNumber("bias of u / bound", str(u.bias), "", at),
        KeyNumber("95 % intervals that hold", str(unknowns.coverage), "", f"{at}; all unknowns"),
    )


def _sentences(
    levels: Levels, scene: Scene, table: pd.DataFrame, home: Mapping[str, Any]
) -> tuple[str, ...]:
    px = scene.images.grid.pixel_size
    said = []
    for level, parts in sorted(levels.items()):
        u, unknowns = parts["u"], parts["unknowns"].standardised
        said.append(
            f"At {100 * level:g} % of noise in both images the displacement's rms error is "
            f"{u.ratio} times the Cramér–Rao bound of {short(u.rms_bound / px)} px, its bias "
            f"{u.bias} times; 95 % intervals hold {unknowns.coverage} of the unknowns and "
            f"{u.coverage} of the displacement."
        )
    said.append(
        f"Without noise the measurement is {short(home['lost_px'])} px rms per component from the "
        f"best fit of its ansatz, which is {short(home['best_px'])} px from the truth: of that "
        "the noise's error bars know nothing. All errors above are against the end without noise."
    )
    said.append(
        "The bound, 2 s²M⁻¹ of the exact images, takes neither the deformed image's det F into "
        "account (benchmarks/cramer_rao.py does) nor what the ansatz leaves over: a residual adds "
        "second derivatives to the cost, and moves the ratio from 1."
    )
    lost = _not_converged(table)
    if lost:
        said.append(f"{lost} correlations did not converge, and count as they ended.")
    return tuple(said)
