"""What the table of a resolution study tells: transfer, noise floors, indicators by degree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.imaging.speckle import Speckle
from modeharvest.validation.page import short
from modeharvest.validation.resolution.curves import AXES, WAVED, Curves, Passband
from modeharvest.validation.resolution.measure import Subject
from modeharvest.validation.resolution.plots_study import (
    draw_indicators,
    draw_passband,
    draw_transfer,
)
from modeharvest.validation.resolution.transfer import finest_period, subset_transfer
from modeharvest.validation.studies.study import Findings, KeyNumber

FloatArray = NDArray[np.float64]

QUANTITIES = ("v0", "v1", "v1phi1", "u")
FLOOR_OF = {"v0": "v0", "v1": "v1phi1"}
"""Whose noise counts against the waves of a part."""
MOTIONS = {"buckled": "under the base motion", "still": "without motion, φ1 held"}
_RESOLVED = 0.85
"""Share of a wave that is found, from which on images are set against best fits apart [-]."""
_SUBSET_PX = 33
"""A subset whose indicator stands for all: theory gives nearly the same for every size."""


@dataclass(frozen=True)
class Degree:
    """A degree of v0 and v1, and what it costs.

    Parameters
    ----------
    degree, unknowns
        Of the ansatz.
    finest_px
        l10 of waves by part and axis, as "v0 x" [px].
    floor_px
        n by quantity, :data:`QUANTITIES`, by 2 s^2 M^-1 of the buckled images [px].
    indicator_px2
        n l10 by part; l10 is the geometric mean of both axes' [px^2].
    held_px2
        That of v1 phi1 without motion, its phi1 held [px^2].
    """

    degree: int
    unknowns: int
    finest_px: Mapping[str, float]
    floor_px: Mapping[str, float]
    indicator_px2: Mapping[str, float]
    held_px2: float


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
    degrees = _degrees(done, subject, curves)
    floors, waves = noise_floors(done, subject), measured_waves(done, subject, curves)
    chosen = min(degrees, key=lambda d: abs(d.degree - subject.buckled.how.v0_degree))
    passband = Passband.of(subject, chosen.degree)
    local = subset_indicator(subject)
    return Findings(
        numbers={
            "degrees": [asdict(d) for d in degrees],
            "affine_subset_indicator_px2": local,
            "images_against_best_fits": waves.to_dict("records"),
            "noise": floors.to_dict("records"),
            "cross_talk": dict(zip(("any_period", "resolved"), cross_talk(curves), strict=True)),
            "longest_retuned": _retuned(passband),
        },
        sentences=_sentences(degrees, chosen, subject, curves, waves, floors, passband, local),
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
        attachments={"Transfer": _transfer_table(curves, subject)},
    )


def _degrees(done: pd.DataFrame, subject: Subject, curves: Curves) -> list[Degree]:
    """Every degree whose floor is known."""
    floors = done[done["task"] == "floor"]
    buckled = floors[floors["motion"] == "buckled"].sort_values("degree")
    still = floors[floors["motion"] == "still"].set_index("degree")
    if not len(buckled):
        raise InputError("study: expected the noise floor of a degree at least, got none")
    return [
        _degree(row, still["v1phi1"].get(row["degree"], np.nan), subject, curves)
        for _, row in buckled.iterrows()
    ]


def _degree(row: pd.Series, held: float, subject: Subject, curves: Curves) -> Degree:
    """One of them; ``held`` is the floor of v1 phi1 without motion [px]."""
    degree, px = int(row["degree"]), subject.buckled.pixel_size
    finest = {
        f"{part} {name}": curves.finest(part, axis, degree) / px
        for part in WAVED
        for axis, name in enumerate(AXES)
    }
    mean = {part: float(np.sqrt(finest[f"{part} x"] * finest[f"{part} y"])) for part in WAVED}
    floor = {name: float(row[name]) for name in QUANTITIES}
    indicator = {part: floor[FLOOR_OF[part]] * mean[part] for part in WAVED}
    unknowns = int(row["unknowns"])
    return Degree(degree, unknowns, finest, floor, indicator, float(held) * mean["v1"])


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


def subset_indicator(subject: Subject) -> float:
    """n l10 of an affine subset on the same speckle under the same noise, by theory [px^2]."""
    grid = subject.buckled.grid
    speckle = Speckle(subject.buckled.speckle, grid.shape)
    row, col = np.meshgrid(np.arange(0.0, grid.rows, 7), np.arange(0.0, grid.cols, 7))
    slope = float(np.sqrt(np.mean(speckle.gradient(row, col) ** 2)))
    floor = np.sqrt(2.0) * subject.noise / (_SUBSET_PX * slope)
    finest = finest_period(lambda p: subset_transfer(_SUBSET_PX, 1, p), 10.0, 1000.0)
    return float(floor * finest)


def cross_talk(curves: Curves) -> tuple[float, float]:
    """The largest share of a wave of one part found in the other: at any period, from l10 on."""
    everywhere, resolved = [], []
    for key, own in curves.own.items():
        other = np.abs(curves.whole[key] - own)
        everywhere.append(other.max())
        resolved.append(other[curves.periods >= curves.finest(*key)].max())
    return float(max(everywhere)), float(max(resolved))


def _retuned(passband: Passband) -> float:
    """How far off its wavelength may be for the pattern to be found whole, both ways [-]."""
    whole = passband.itself > 0.999
    off = np.abs(passband.stretch - 1.0)
    lost = off[~whole & np.isfinite(passband.itself)]
    inside = off[whole] if not len(lost) else off[whole & (off < lost.min())]
    return float(inside.max()) if len(inside) else 0.0


def _by_degree(degrees: list[Degree], subject: Subject) -> pd.DataFrame:
    """A row for each degree."""
    px, pitch = subject.buckled.pixel_size, subject.buckled.specimen.pitch
    rows = []
    for d in degrees:
        row: dict[str, Any] = {"degree": d.degree, "unknowns": d.unknowns}
        for part in WAVED:
            for axis in AXES:
                at = d.finest_px[f"{part} {axis}"]
                row[f"l10 of {part} along {axis} [px]"] = at
                row[f"{part} {axis} [cells]"] = at * px / pitch
        row |= {f"n of {name} [10⁻³ px]": 1e3 * d.floor_px[name] for name in QUANTITIES}
        row |= {f"n l10 of {part} [px²]": d.indicator_px2[part] for part in WAVED}
        row["of v1, φ1 held [px²]"] = d.held_px2
        rows.append(row)
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


def _sentences(
    degrees: list[Degree], chosen: Degree, subject: Subject, curves: Curves,
    waves: pd.DataFrame, floors: pd.DataFrame, passband: Passband, local: float,
) -> tuple[str, ...]:  # fmt: skip
    b = subject.buckled
    pitch, width = b.specimen.pitch / b.pixel_size, 2.0 * b.specimen.half_size[0] / b.pixel_size
    x, v1 = chosen.finest_px["v0 x"], chosen.finest_px["v1 x"]
    first, last = degrees[0], degrees[-1]
    said = [
        f"At degree {chosen.degree} a wave along x keeps 90 % of its amplitude from a period of "
        f"{x:.0f} px on if it is of v0 ({x / pitch:.1f} cells, {100 * x / width:.0f} % of the "
        f"specimen's width), and from {v1:.0f} px on ({v1 / pitch:.1f} cells) if it is of v1, "
        "which lives in the cellular part only.",
        f"From degree {first.degree} to {last.degree} that period of v0 falls from "
        f"{first.finest_px['v0 x'] / pitch:.1f} to {last.finest_px['v0 x'] / pitch:.1f} cells, and "
        f"the noise floor of v0 rises from {1e3 * first.floor_px['v0']:.2g} to "
        f"{1e3 * last.floor_px['v0']:.2g} · 10⁻³ px, that of v1 φ1 from "
        f"{1e3 * first.floor_px['v1phi1']:.2g} to {1e3 * last.floor_px['v1phi1']:.2g} · 10⁻³ px.",
        _product_said(degrees, local),
        "What a degree gains in resolution it costs in noise, so the indicator does not choose: "
        "take the smallest degree whose period is below what v0 and v1 are expected to show.",
    ]
    if len(waves):
        said.append(_waves_said(waves, subject, curves))
    if len(floors):
        ratio = floors["Monte Carlo / told"]
        said.append(
            f"Scatter under noise is {ratio.min():.2f} to {ratio.max():.2f} times what the "
            f"results' own covariance tells, each ± {floors['±'].mean():.2f}, with and without "
            "motion."
        )
    said.append(_retuned_said(passband, chosen, b.specimen.pitch / b.pixel_size))
    return tuple(said)


def _waves_said(waves: pd.DataFrame, subject: Subject, curves: Curves) -> str:
    """How near images come to best fits, and what goes into the wrong part."""
    off, kept = waves["difference"].abs(), waves["best fit"] >= _RESOLVED
    elsewhere = "" if kept.all() else f", elsewhere by {100 * off[~kept].max():.1f} %"
    anywhere, resolved = cross_talk(curves)
    return (
        f"Correlated images give what the best fits promise: where these keep "
        f"{100 * _RESOLVED:.0f} % or more of a wave of {subject.amplitude_px:g} px, its share "
        f"differs by {100 * off[kept].max():.1f} % of the amplitude at most{elsewhere}. Of a wave "
        f"of one part up to {100 * resolved:.1f} % is found in the other where it is resolved, up "
        f"to {100 * anywhere:.0f} % where it isn't."
    )


def _product_said(degrees: list[Degree], local: float) -> str:
    """How constant the indicator is."""
    first, last = degrees[0], degrees[-1]
    v0 = [d.indicator_px2["v0"] for d in degrees]
    gain = first.finest_px["v0 x"] / last.finest_px["v0 x"]
    return (
        f"While that period becomes {gain:.1f} times shorter, n l₁₀ % of v0 stays within "
        f"{min(v0):.2f} to {max(v0):.2f} px². That of v1 φ1 goes from "
        f"{first.indicator_px2['v1']:.2f} to {last.indicator_px2['v1']:.2f} px², with φ1 held and "
        f"without motion from {first.held_px2:.2f} to {last.held_px2:.2f} px²: the rest is the "
        "noise of φ1's own parameters. An affine subset on the same speckle "
        f"under the same noise has {local:.2f} px², whatever its size (theory)."
    )


def _retuned_said(passband: Passband, chosen: Degree, pitch_px: float) -> str:
    """Why l10 means nothing for the pattern itself."""
    near = passband.stretch > 0.82
    kept = passband.stretch[near & (passband.added >= 0.9)]
    off = _retuned(passband)
    return (
        f"The pattern itself has a wavelength of 2 cells along x and y, {2 * pitch_px:.0f} px, far "
        f"below those periods, and none of it is lost: it is one of the functions that are fitted. "
        f"A small pattern beside it passes as through a filter, from {kept.min():.2f} to "
        f"{kept.max():.2f} times its wave numbers at degree {chosen.degree}; but if the pattern "
        f"itself is up to {100 * off:.0f} % longer or shorter, its wave numbers follow, and all of "
        "its amplitude is found: l₁₀ % is a filter's number, and φ1 isn't filtered but tuned."
    )
