"""What the table of a resolution study tells: transfer, noise floors, indicators by degree."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.validation.page import short
from modeharvest.validation.resolution.curves import AXES, WAVED, Curves, Passband
from modeharvest.validation.resolution.degrees import (
    QUANTITIES,
    Degree,
    degrees_of,
    subset_indicator,
)
from modeharvest.validation.resolution.measure import MOTIONS, Subject
from modeharvest.validation.resolution.plots_study import (
    draw_indicators,
    draw_passband,
    draw_transfer,
)
from modeharvest.validation.resolution.study import Resolution
from modeharvest.validation.resolution.study_words import Answers
from modeharvest.validation.studies.study import Findings, KeyNumber

FloatArray = NDArray[np.float64]


def report_resolution(study: Resolution, table: pd.DataFrame, folder: Path) -> Findings:
    """Transfer, noise floors and indicators by degree."""
    subject = Subject.read(folder, table["subject"].iloc[0])
    return findings(table, subject, Curves.of(subject, study.degrees), study.seeds)


def findings(table: pd.DataFrame, subject: Subject, curves: Curves, seeds: str) -> Findings:
    """Read the table of all cases.

    Parameters
    ----------
    table
        A row for each case of :func:`modeharvest.validation.resolution.measure.one_case`.
    subject
        What was measured.
    curves
        The best fits of waves at all degrees.
    seeds
        In words.
    """
    done = table[table["error"] == ""]
    degrees = degrees_of(done, subject, curves)
    floors, waves = noise_floors(done, subject), measured_waves(done, subject, curves)
    chosen = min(degrees, key=lambda d: abs(d.degree - subject.buckled.how.v0_degree))
    passband = Passband.of(subject, chosen.degree)
    local = subset_indicator(subject)
    answers = Answers(subject, degrees, chosen, curves, passband, waves, floors, local)
    return Findings(
        numbers={
            "degrees": [asdict(d) for d in degrees],
            "affine_subset_indicator_px2": local,
            "images_against_best_fits": waves.to_dict("records"),
            "noise": floors.to_dict("records"),
            "cross_talk": dict(zip(("any_period", "resolved"), curves.cross_talk(), strict=True)),
            "longest_retuned": passband.retuned,
        },
        sentences=answers.sentences,
        keys=_keys(chosen, subject),
        plots=(
            *(draw_transfer(part, curves, waves, subject) for part in WAVED),
            draw_indicators(degrees, local, seeds),
            draw_passband(passband, chosen.degree),
        ),
        tables={
            "By degree": _by_degree(degrees, subject),
            "Images against best fits": waves,
            "Noise floors": floors,
        },
        attachments={
            "Finest periods": _finest(degrees, subject),
            "Transfer": _transfer_table(curves, subject),
        },
    )


def noise_floors(done: pd.DataFrame, subject: Subject) -> pd.DataFrame:
    """Scatter under noise against what each result's covariance tells, and the least there can be.

    The rms over realisations and material [px], by motion, degree and quantity.
    """
    rows = []
    for motion, what in MOTIONS.items():
        noisy = done[(done["task"] == "noise") & (done["motion"] == motion)]
        floors = done[(done["task"] == "floor") & (done["motion"] == motion)]
        for degree in subject.measured:
            least = floors[floors["degree"] == degree]
            if len(noisy) < 2 or not len(least):
                continue
            for name in QUANTITIES:
                squares = noisy[f"{name}_{degree}"].to_numpy(float) ** 2
                told = float(np.sqrt((noisy[f"told_{name}_{degree}"] ** 2).mean()))
                scatter = float(np.sqrt(squares.mean()))
                error = squares.std(ddof=1) / np.sqrt(len(squares)) / (2.0 * scatter)
                rows.append({
                    "images": what, "degree": degree, "quantity": name,
                    "bound [10⁻³ px]": 1e3 * float(least[name].iloc[0]),
                    "told by covariance [10⁻³ px]": 1e3 * told,
                    "Monte Carlo [10⁻³ px]": 1e3 * scatter,
                    "Monte Carlo / told": scatter / told, "±": error / told,
                })  # fmt: skip
    return pd.DataFrame(rows)


def measured_waves(done: pd.DataFrame, subject: Subject, curves: Curves) -> pd.DataFrame:
    """Shares of waves found in images and by best fits, over both phases."""
    waves, rows = done[done["task"] == "wave"], []
    pitch = subject.buckled.specimen.pitch
    for (part, axis, period), both in waves.groupby(["part", "axis", "period"]):
        if len(both) < 2:
            continue
        for degree in subject.measured:
            fit = curves.at(part, axis, degree, period)
            found = float(np.average(both[f"own_{degree}"], weights=both["power"]))
            rows.append({
                "wave of": part, "along": AXES[axis], "period [cells]": period / pitch,
                "degree": degree, "best fit": fit, "images": found, "difference": found - fit,
            })  # fmt: skip
    return pd.DataFrame(rows)


def _by_degree(degrees: list[Degree], subject: Subject) -> pd.DataFrame:
    """A row for each degree."""
    pitch_px = subject.buckled.specimen.pitch / subject.buckled.pixel_size
    rows = []
    for d in degrees:
        row: dict[str, Any] = {"degree": d.degree, "unknowns": d.unknowns}
        row |= {f"l10 of {name} [cells]": at / pitch_px for name, at in d.finest_px.items()}
        row |= {f"n of {name} [10⁻³ px]": 1e3 * d.floor_px[name] for name in QUANTITIES}
        row |= {f"n l10 of {part} [px²]": d.indicator_px2[part] for part in WAVED}
        row["of v1, φ1 held [px²]"] = d.held_px2
        rows.append(row)
    return pd.DataFrame(rows)


def _finest(degrees: list[Degree], subject: Subject) -> pd.DataFrame:
    """A row for each degree and wave: l10 in px, in cells, and over what the wave runs through."""
    b, rows = subject.buckled, []
    lengths = {"v0": b.specimen.half_size, "v1": b.specimen.cellular_half_size}
    for d in degrees:
        for name, at in d.finest_px.items():
            part, axis = name.split()
            length = 2.0 * lengths[part][AXES.index(axis)] / b.pixel_size
            rows.append({
                "degree": d.degree, "wave of": part, "along": axis, "l10 [px]": at,
                "l10 [mm]": at * b.pixel_size, "l10 [cells]": at * b.pixel_size / b.specimen.pitch,
                "l10 [% of the specimen, of its cellular part for v1]": 100.0 * at / length,
            })  # fmt: skip
    return pd.DataFrame(rows)


def _transfer_table(curves: Curves, subject: Subject) -> pd.DataFrame:
    """A row for each curve and period."""
    px = subject.buckled.pixel_size
    parts = [
        pd.DataFrame({
            "wave of": part, "along": AXES[axis], "degree": degree,
            "period [mm]": curves.periods, "period [px]": curves.periods / px,
            "own part": curve, "whole": curves.whole[part, axis, degree],
        })
        for (part, axis, degree), curve in curves.own.items()
    ]  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def _keys(chosen: Degree, subject: Subject) -> tuple[KeyNumber, ...]:
    pitch = subject.buckled.specimen.pitch / subject.buckled.pixel_size
    at = f"degree {chosen.degree}"
    keys = []
    for part in WAVED:
        x, y = (chosen.finest_px[f"{part} {axis}"] / pitch for axis in AXES)
        keys.append(KeyNumber(f"l₁₀ % of {part}", f"{x:.1f} – {y:.1f}", "cells", f"{at}; x – y"))
    noise = f"{at}; {100 * subject.noise:g} % of noise"
    keys += [
        KeyNumber(f"n of {name}", f"{1e3 * chosen.floor_px[floor]:.2f}", "10⁻³ px", noise)
        for name, floor in (("v0", "v0"), ("v1 φ1", "v1phi1"))
    ]
    keys += [
        KeyNumber(f"n l₁₀ % of {part}", short(chosen.indicator_px2[part]), "px²", at)
        for part in WAVED
    ]
    return tuple(keys)
