"""Report of a resolution study: transfer by degree, noise against resolution, pass band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.colors import Colormap
from matplotlib.figure import Figure

from modeharvest.report.figures.curves import curve, plain_ticks
from modeharvest.report.figures.style import BLUE, GREEN, INK, MUTED, RED, figure
from modeharvest.report.model import Card, Findings, KeyNumber, ReportTable, number
from modeharvest.validation.resolution.buckled import ResolutionSpec
from modeharvest.validation.resolution.star import KEPT
from modeharvest.validation.resolution.transfer import (
    AXES,
    QUANTITIES,
    WAVED,
    DegreeResolution,
    Passband,
    TransferCurves,
)
from modeharvest.validation.studies.resolution import (
    MOTIONS,
    ResolutionAnalysis,
    ResolutionStudy,
)

_SIZE = (4.6, 3.3)  # [in]
_DEGREES: Colormap = mpl.colormaps["viridis"]


def noise_floors(done: pd.DataFrame, spec: ResolutionSpec) -> pd.DataFrame:
    """Scatter under noise against what each result's covariance predicts, and the bound.

    The rms over realisations and material [px], by motion, degree and quantity.
    """
    rows = []
    for motion, what in MOTIONS.items():
        noisy = done[(done["task"] == "noise") & (done["motion"] == motion)]
        floors = done[(done["task"] == "floor") & (done["motion"] == motion)]
        for degree in spec.measured:
            least = floors[floors["degree"] == degree]
            if len(noisy) < 2 or not len(least):
                continue
            for name in QUANTITIES:
                squares = noisy[f"{name}_{degree}"].to_numpy(float) ** 2
                predicted = float(np.sqrt((noisy[f"predicted_{name}_{degree}"] ** 2).mean()))
                scatter = float(np.sqrt(squares.mean()))
                error = squares.std(ddof=1) / np.sqrt(len(squares)) / (2.0 * scatter)
                rows.append({
                    "images": what, "degree": degree, "quantity": name,
                    "bound [10⁻³ px]": 1e3 * float(least[name].iloc[0]),
                    "predicted by covariance [10⁻³ px]": 1e3 * predicted,
                    "Monte Carlo [10⁻³ px]": 1e3 * scatter,
                    "Monte Carlo / predicted": scatter / predicted, "±": error / predicted,
                })  # fmt: skip
    return pd.DataFrame(rows)


def measured_waves(
    done: pd.DataFrame, spec: ResolutionSpec, curves: TransferCurves
) -> pd.DataFrame:
    """Shares of waves found in images and by best fits, over both phases."""
    waves, rows = done[done["task"] == "wave"], []
    pitch = spec.buckled.specimen.pitch
    for (part, axis, period), both in waves.groupby(["part", "axis", "period"]):
        if len(both) < 2:
            continue
        for degree in spec.measured:
            fit = curves.at(part, axis, degree, period)
            found = float(np.average(both[f"own_{degree}"], weights=both["power"]))
            rows.append({
                "wave of": part, "along": AXES[axis], "period [cells]": period / pitch,
                "degree": degree, "best fit": fit, "images": found, "difference": found - fit,
            })  # fmt: skip
    return pd.DataFrame(rows)


def draw_transfer(
    part: str, curves: TransferCurves, waves: pd.DataFrame, spec: ResolutionSpec
) -> Figure:
    """Draw T over the period for waves of a part along both axes, degrees in colours."""
    pitch = spec.buckled.specimen.pitch
    degrees = sorted({key[2] for key in curves.own})
    drawn = figure(9.4, 3.1)
    both = drawn.subplots(1, 2, sharey=True)
    for axis, axes in enumerate(both):
        axes.axhline(KEPT, color=MUTED, linestyle=":", linewidth=1)
        for degree in degrees:
            colour = _colour(degree, degrees)
            axes.plot(curves.periods / pitch, curves.own[part, axis, degree], color=colour,
                      label=str(degree), linewidth=1.3)  # fmt: skip
        if len(waves):
            here = waves[(waves["wave of"] == part) & (waves["along"] == AXES[axis])]
            for degree, points in here.groupby("degree"):
                axes.plot(points["period [cells]"], points["images"], "o", ms=4,
                          color=_colour(int(degree), degrees), mec=INK, mew=0.5)  # fmt: skip
        axes.set(xscale="log", xlabel=f"period along {AXES[axis]} [cells]", ylim=(-0.03, 1.04))
        axes.grid(color=MUTED, alpha=0.18, lw=0.6)
        plain_ticks(axes.xaxis)
    both[0].set_ylabel("amplitude ratio [–]")
    both[1].legend(frameon=False, fontsize=7.5, title="degree", title_fontsize=7.5,
                   loc="lower right")  # fmt: skip
    drawn.tight_layout()
    return drawn


def draw_indicators(degrees: Sequence[DegreeResolution], local: float) -> Figure:
    """Draw noise floors over l10 for all degrees, and the line of an affine subset."""
    drawn, axes = curve("l₁₀ % [px]", "noise floor n [10⁻³ px]", _SIZE)
    ends = []
    for part, floor, colour in (("v0", "v0", BLUE), ("v1", "v1phi1", RED)):
        x = [np.sqrt(d.finest_px[f"{part} x"] * d.finest_px[f"{part} y"]) for d in degrees]
        y = [1e3 * d.floor_px[floor] for d in degrees]
        ends += x
        label = "v0" if part == "v0" else "v1 φ1"
        axes.plot(x, y, color=colour, marker="o", ms=4, linewidth=1, label=label)
        for d, at, high in zip(degrees, x, y, strict=True):
            axes.annotate(str(d.degree), (at, high), (4, 3), textcoords="offset points",
                          fontsize=6.5, color=colour)  # fmt: skip
    line = np.array([min(ends), max(ends)])
    axes.plot(line, 1e3 * local / line, color=GREEN, linestyle="--", linewidth=1,
              label="affine subset of any size (theory)")  # fmt: skip
    axes.set(xscale="log", yscale="log")
    axes.legend(frameon=False, fontsize=7.5)
    plain_ticks(axes.xaxis, axes.yaxis)
    return drawn


def draw_passband(passband: Passband) -> Figure:
    """Draw what is found of patterns of other wavelengths, beside the mode and instead of it."""
    drawn, axes = curve("wave numbers over the mode's [–]", "amplitude ratio [–]", _SIZE)
    axes.axhline(KEPT, color=MUTED, linestyle=":", linewidth=1)
    axes.plot(passband.stretch, passband.added, color=BLUE, label="a small one beside it")
    known = np.isfinite(passband.itself)
    axes.plot(passband.stretch[known], passband.itself[known], "o", ms=3.5, color=RED,
              label="the pattern itself")  # fmt: skip
    axes.set_ylim(-0.03, 1.18)
    axes.legend(frameon=False, fontsize=7.5, loc="upper center", ncols=2)
    return drawn


def _colour(degree: int, degrees: Sequence[int]) -> tuple[float, ...]:
    """From dark to bright with the degree."""
    low, high = min(degrees), max(degrees)
    return _DEGREES(0.9 * (degree - low) / max(1, high - low))


_KEPT = 0.85
"""Share of a wave that is found, from which on images are set against best fits apart [-]."""


@dataclass(frozen=True, eq=False)
class Answers:
    """The sentences on a resolution study.

    Parameters
    ----------
    found
        The analysis.
    waves, floors
        Tables: images against best fits, scatter against covariance.
    """

    found: ResolutionAnalysis
    waves: pd.DataFrame
    floors: pd.DataFrame

    @property
    def sentences(self) -> tuple[str, ...]:
        """The findings, the most important first."""
        return (
            self._finest,
            self._trade_off,
            self._product,
            "What a degree gains in resolution it costs in noise, so the indicator does not "
            "choose: take the smallest degree whose period is below what v0 and v1 are expected "
            "to show.",
            *([self._images] if len(self.waves) else []),
            *([self._noise] if len(self.floors) else []),
            self._pattern,
        )

    @property
    def _pitch_px(self) -> float:
        return self.found.spec.buckled.specimen.pitch / self.found.spec.buckled.pixel_size

    @property
    def _finest(self) -> str:
        b, pitch = self.found.spec.buckled, self._pitch_px
        width = 2.0 * b.specimen.half_size[0] / b.pixel_size
        v0, v1 = (self.found.chosen.finest_px[f"{part} x"] for part in ("v0", "v1"))
        return (
            f"At degree {self.found.chosen.degree} a wave along x keeps 90 % of its amplitude from "
            f"a period of {v0:.0f} px on if it is of v0 ({v0 / pitch:.1f} cells, "
            f"{100 * v0 / width:.0f} % of the specimen's width), and from {v1:.0f} px on "
            f"({v1 / pitch:.1f} cells) if it is of v1, which lives in the cellular part only."
        )

    @property
    def _trade_off(self) -> str:
        first, last, pitch = self.found.degrees[0], self.found.degrees[-1], self._pitch_px
        return (
            f"From degree {first.degree} to {last.degree} that period of v0 falls from "
            f"{first.finest_px['v0 x'] / pitch:.1f} to {last.finest_px['v0 x'] / pitch:.1f} cells, "
            f"and the noise floor of v0 rises from {1e3 * first.floor_px['v0']:.2g} to "
            f"{1e3 * last.floor_px['v0']:.2g} · 10⁻³ px, that of v1 φ1 from "
            f"{1e3 * first.floor_px['v1phi1']:.2g} to {1e3 * last.floor_px['v1phi1']:.2g} · 10⁻³ "
            "px."
        )

    @property
    def _product(self) -> str:
        first, last = self.found.degrees[0], self.found.degrees[-1]
        v0 = [d.indicator_px2["v0"] for d in self.found.degrees]
        gain = first.finest_px["v0 x"] / last.finest_px["v0 x"]
        return (
            f"While that period becomes {gain:.1f} times shorter, n l₁₀ % of v0 stays within "
            f"{min(v0):.2f} to {max(v0):.2f} px². That of v1 φ1 goes from "
            f"{first.indicator_px2['v1']:.2f} to {last.indicator_px2['v1']:.2f} px², with φ1 fixed "
            f"and without motion from {first.fixed_px2:.2f} to {last.fixed_px2:.2f} px²: the rest "
            "is mostly the noise of φ1's own parameters. An affine subset on the same speckle "
            "under "
            f"the same noise has {self.found.subset_px2:.2f} px², whatever its size (theory)."
        )

    @property
    def _images(self) -> str:
        off, kept = self.waves["difference"].abs(), self.waves["best fit"] >= _KEPT
        elsewhere = "" if kept.all() else f"; otherwise by {100 * off[~kept].max():.1f} %"
        anywhere, resolved = self.found.curves.cross_talk()
        return (
            f"Correlated images agree with the best fits: where these keep "
            f"{100 * _KEPT:.0f} % or more of a wave of {self.found.spec.amplitude_px:g} px, its "
            f"share differs by {100 * off[kept].max():.1f} % of the amplitude at "
            f"most{elsewhere}. Of a "
            f"wave of one part up to {100 * resolved:.1f} % is found in the other where it is "
            f"resolved, up to {100 * anywhere:.0f} % where it isn't."
        )

    @property
    def _noise(self) -> str:
        ratio = self.floors["Monte Carlo / predicted"]
        return (
            f"Scatter under noise is {ratio.min():.2f} to {ratio.max():.2f} times what the "
            f"results' own covariance predicts, each ± {self.floors['±'].mean():.2f}, with and "
            "without motion."
        )

    @property
    def _pattern(self) -> str:
        """Why l10 means nothing for the pattern itself."""
        band = self.found.passband
        kept = band.stretch[(band.stretch > 0.82) & (band.added >= 0.9)]
        return (
            "The pattern itself has a wavelength of 2 cells along x and y, "
            f"{2 * self._pitch_px:.0f} px, far below those periods, and none of it is lost: it is "
            "one of the functions that are fitted. A small pattern beside it passes as through a "
            f"filter, from {kept.min():.2f} to {kept.max():.2f} times its wave numbers at degree "
            f"{self.found.chosen.degree}; but if the pattern itself is up to "
            f"{100 * band.retuned:.0f} % longer or shorter, its wave numbers follow, and all of "
            f"its amplitude is found: "
            "l₁₀ % is a filter's number, and φ1 isn't filtered but tuned."
        )


def report_resolution(study: ResolutionStudy, table: pd.DataFrame, folder: Path) -> Findings:
    """Transfer, noise floors and indicators by degree."""
    return resolution_findings(study.analyse(table, folder), study.seeds)


def resolution_findings(found: ResolutionAnalysis, seeds: str) -> Findings:
    """The findings of an analysis; ``seeds`` in words."""
    spec, curves, degrees = found.spec, found.curves, found.degrees
    floors = noise_floors(found.rows, spec)
    waves = measured_waves(found.rows, spec, curves)
    return Findings(
        numbers={
            "degrees": [asdict(d) for d in degrees],
            "affine_subset_indicator_px2": found.subset_px2,
            "images_against_best_fits": waves.to_dict("records"),
            "noise": floors.to_dict("records"),
            "cross_talk": dict(zip(("any_period", "resolved"), curves.cross_talk(), strict=True)),
            "longest_retuned": found.passband.retuned,
        },
        sentences=Answers(found, waves, floors).sentences,
        keys=_keys(found.chosen, spec),
        figures=_figures(found, waves, seeds),
        tables=[
            ReportTable.of("By degree", _by_degree(degrees, spec)),
            ReportTable.of("Images against best fits", waves),
            ReportTable.of("Noise floors", floors),
        ],
        attachments=[
            ReportTable.of("Finest periods", _finest(degrees, spec)),
            ReportTable.of("Transfer", _transfer_table(curves, spec)),
        ],
    )


def _figures(found: ResolutionAnalysis, waves: pd.DataFrame, seeds: str) -> list[Card]:
    degree = found.chosen.degree
    again = (
        " At one cell half of the wave is the pattern again: cos(πx/l) cos(2πx/l) holds cos(πx/l) "
        "/ 2."
    )
    return [
        *(
            Card.single(
                f"transfer-{part}", f"Amplitude ratio of a wave of {part}",
                partial(draw_transfer, part, found.curves, waves, found.spec),
                f"Waves of {part}, over both phases. Lines: best fits of the ansatz to the "
                "displacement; dots: correlated images. Dotted: 10 % are lost."
                + (again if part == "v1" else ""), wide=True,
            )
            for part in WAVED
        ),
        Card.single(
            "indicators", "Noise against resolution",
            partial(draw_indicators, found.degrees, found.subset_px2),
            f"Numbers: the degree. l₁₀ %: mean of both axes; n: by the covariance; {seeds}. Along "
            "the dashed line, and any parallel to it, the indicator n l₁₀ % is the same.",
        ),
        Card.single(
            "passband", "Patterns of other wavelengths", partial(draw_passband, found.passband),
            f"Degree {degree}; best fits. Line: a small pattern with other wave numbers than the "
            "mode's, added to it: v0 takes the longest, v1 those next to the mode, between them "
            "nothing passes. Dots: the pattern itself has them, and the initial guess is the mode: "
            "its wave numbers are unknowns and follow, until the fit ends in another minimum.",
        ),
    ]  # fmt: skip


def _by_degree(degrees: list[DegreeResolution], spec: ResolutionSpec) -> pd.DataFrame:
    """A row for each degree."""
    pitch_px = spec.buckled.specimen.pitch / spec.buckled.pixel_size
    rows = []
    for d in degrees:
        row: dict[str, Any] = {"degree": d.degree, "unknowns": d.unknowns}
        row |= {f"l10 of {name} [cells]": at / pitch_px for name, at in d.finest_px.items()}
        row |= {f"n of {name} [10⁻³ px]": 1e3 * d.floor_px[name] for name in QUANTITIES}
        row |= {f"n l10 of {part} [px²]": d.indicator_px2[part] for part in WAVED}
        row["of v1, φ1 fixed [px²]"] = d.fixed_px2
        rows.append(row)
    return pd.DataFrame(rows)


def _finest(degrees: list[DegreeResolution], spec: ResolutionSpec) -> pd.DataFrame:
    """A row for each degree and wave: l10 in px, in cells, and over what the wave runs through."""
    b, rows = spec.buckled, []
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


def _transfer_table(curves: TransferCurves, spec: ResolutionSpec) -> pd.DataFrame:
    """A row for each curve and period."""
    px = spec.buckled.pixel_size
    parts = [
        pd.DataFrame({
            "wave of": part, "along": AXES[axis], "degree": degree,
            "period [mm]": curves.periods, "period [px]": curves.periods / px,
            "own part": curve, "whole": curves.whole[part, axis, degree],
        })
        for (part, axis, degree), curve in curves.own.items()
    ]  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def _keys(chosen: DegreeResolution, spec: ResolutionSpec) -> tuple[KeyNumber, ...]:
    pitch = spec.buckled.specimen.pitch / spec.buckled.pixel_size
    at = f"degree {chosen.degree}"
    keys = []
    for part in WAVED:
        x, y = (chosen.finest_px[f"{part} {axis}"] / pitch for axis in AXES)
        keys.append(KeyNumber(f"l₁₀ % of {part}", f"{x:.1f} – {y:.1f}", "cells", f"{at}; x – y"))
    noise = f"{at}; {100 * spec.noise:g} % of noise"
    keys += [
        KeyNumber(f"n of {name}", f"{1e3 * chosen.floor_px[floor]:.2f}", "10⁻³ px", noise)
        for name, floor in (("v0", "v0"), ("v1 φ1", "v1phi1"))
    ]
    keys += [
        KeyNumber(f"n l₁₀ % of {part}", number(chosen.indicator_px2[part]), "px²", at)
        for part in WAVED
    ]
    return tuple(keys)
