"""What the table of a noise study tells: bias, scatter against its bounds and why, coverage."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from modeharvest.validation.page import short
from modeharvest.validation.studies.noise.causes import CAUSES, SOFTENED
from modeharvest.validation.studies.noise.fields import Points
from modeharvest.validation.studies.noise.levels import (
    Levels,
    WithoutNoise,
    against,
    read_levels,
)
from modeharvest.validation.studies.noise.plots import (
    draw_bars,
    draw_causes,
    draw_levels,
    draw_maps,
    draw_unknowns,
)
from modeharvest.validation.studies.noise.study import Noise
from modeharvest.validation.studies.noise.tables import (
    WORDS,
    causes_table,
    maps_table,
    summary_table,
    to_read,
    unknowns_table,
)
from modeharvest.validation.studies.study import Findings, KeyNumber
from modeharvest.validation.studies.subject import Scene


def report_noise(study: Noise, table: pd.DataFrame, folder: Path) -> Findings:
    """Bias, scatter and coverage, for each unknown, for the fields, and as maps."""
    return findings(table, Scene.open(folder, table["subject"].iloc[0]), study.seeds)


def findings(table: pd.DataFrame, scene: Scene, seeds: str) -> Findings:
    """Read the table of all realisations.

    Parameters
    ----------
    table
        A row for each case of :func:`modeharvest.validation.studies.noise.study.one_realisation`.
    scene
        The pair of images.
    seeds
        In words.
    """
    points, home = Points.of(scene), WithoutNoise.of(table)
    levels = read_levels(table, home, points)
    ours, soft = against(levels, home, "least"), against(levels, home, SOFTENED)
    shown = sorted(levels)[len(levels) // 2]
    summary = summary_table(levels, ours, soft, scene)
    causes = causes_table(levels, home)
    bars = {"curvature, det F, gradient": ours, "curvature": soft, "JᵀJ only": levels}
    pairs = max(len(parts["u"].errors) for parts in levels.values())
    made = f"{pairs} pairs of realisations; {seeds}"
    return Findings(
        numbers={
            "levels": summary.to_dict("records"),
            "causes": causes.to_dict("records"),
            "noise_free": {k: float(home.row[k]) for k in ("w_px", "best_px", "lost_px")},
            "give_over_that_without_noise": {f"{k:g}": v for k, v in _give(table).items()},
            "not_converged": _not_converged(table),
        },
        sentences=(
            *_level_sentences(levels, ours, scene),
            _cause_sentence(causes),
            *_other_sentences(table, home),
        ),
        keys=_keys(levels, ours, shown),
        plots=(
            draw_causes(causes, made),
            draw_levels(ours, "ratio", made),
            draw_levels(levels, "bias", made),
            draw_levels(ours, "coverage", made),
            draw_bars(bars, made),
            draw_unknowns(ours[shown]["unknowns"], scene.ansatz.names, shown, made),
            draw_maps(ours[shown], points, shown, made),
        ),
        tables={
            "Noise levels": to_read(summary),
            "Rms over the bound, by its causes [-]": causes.round(3),
        },
        attachments={
            "Noise levels": summary,
            "Each unknown": unknowns_table(levels, ours, scene),
            "Maps": maps_table(levels, ours, points),
        },
    )


def _not_converged(table: pd.DataFrame) -> int:
    done = table[table["error"] == ""]
    return int((done["outcome"] != "converged").sum())


def _give(table: pd.DataFrame) -> dict[float, float]:
    """How far u gives way by noisy images' own curvature, over that of exact images, by level."""
    told = table[(table["error"] == "") & table["give_mm"].notna()].set_index("level")["give_mm"]
    return {float(level): float(told[level] / told[0.0]) for level in told.index if level}


def _keys(levels: Levels, ours: Levels, shown: float) -> tuple[KeyNumber, ...]:
    at = f"at {100 * shown:g} % of noise"
    return (
        KeyNumber("rms error of u", str(ours[shown]["u"].ratio), "",
                  f"{at}, over the least that least squares can do"),
        KeyNumber("and over the bound", str(levels[shown]["u"].ratio), "",
                  "Cramér–Rao, of an ansatz that describes everything"),
        KeyNumber("bias of u", str(levels[shown]["u"].bias), "", f"{at}, over the bound"),
        KeyNumber("95 % intervals that hold", str(ours[shown]["unknowns"].standardised.coverage),
                  "", f"{at}; all unknowns"),
    )  # fmt: skip


def _level_sentences(levels: Levels, ours: Levels, scene: Scene) -> tuple[str, ...]:
    px = scene.images.grid.pixel_size
    at = "at " + _listed(f"{100 * level:g}" for level in levels) + " % of noise in both images"
    shares = [
        (
            ours[level]["u"].ratio, parts["u"].ratio, parts["u"].bias,
            ours[level]["unknowns"].standardised.coverage, ours[level]["u"].coverage,
        )
        for level, parts in levels.items()
    ]  # fmt: skip
    ratio, over, bias, held, held_u = (
        _listed(map(str, column)) for column in zip(*shares, strict=True)
    )
    bound = levels[min(levels)]["u"].rms_bound / px / (100.0 * min(levels))
    return (
        f"The displacement's rms error is {ratio} times the least that least squares can do, {at}.",
        f"It is {over} times the Cramér–Rao bound, which is {short(bound)} px rms for each per "
        "cent of noise.",
        f"Of the 95 % intervals {held} hold the unknowns, and {held_u} the displacement.",
        f"The bias of the displacement is {bias} times the bound.",
    )


def _listed(words: Iterable[str]) -> str:
    """With commas, and an "and" before the last."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def _cause_sentence(causes: pd.DataFrame) -> str:
    u = dict(zip(causes["what"], causes["u"], strict=True))
    det, curved, least = (u[WORDS[cause]] for cause in CAUSES[1:])
    return (
        "Why weak noise scatters the displacement by more than the bound: the bound holds for an "
        "ansatz that describes everything. Pixels that share the noise of g where the material "
        f"has shrunk (det F) make it {det:.3f} of it; the cost's own curvature, softer by what "
        f"the ansatz leaves over, {curved:.3f}; the gradient of g's noise, seen with what is left "
        f"over, {least:.3f}: the least that least squares can do. What is above it at strong "
        "noise is of second order: the gradient of the noise against the speckle's, most of which "
        "correlation.gradient_blur_px keeps out."
    )


def _other_sentences(table: pd.DataFrame, home: WithoutNoise) -> tuple[str, ...]:
    noisy = ", ".join(f"{v:.3f} at {100 * k:g} %" for k, v in _give(table).items())
    said = [
        "Each result's error bars are those of its own covariance given the noise, times what "
        "exact images say that curvature, det F and the noise's gradient add, which is computed "
        "once: how far a push moves the displacement by a noisy pair's own curvature is "
        f"{noisy} of noise, over that without.",
        f"Without noise the measurement is {short(float(home.row['lost_px']))} px rms per "
        f"component from the best fit of its ansatz, which is "
        f"{short(float(home.row['best_px']))} px from the truth: of that the noise's error bars "
        "know nothing. All errors above are against the end without noise.",
    ]
    lost = _not_converged(table)
    if lost:
        said.append(f"{lost} correlations did not converge, and count as they ended.")
    return tuple(said)
