"""Report of a resolution study: transfer by degree, noise over resolution, pass band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.colors import Colormap
from matplotlib.figure import Figure

from modeharvest.report.figures import style
from modeharvest.report.figures.curves import curve, plain_ticks
from modeharvest.report.model.content import Findings, KeyNumber, ReportTable
from modeharvest.report.model.text import number, text_of
from modeharvest.validation.scoring.star import KEPT
from modeharvest.validation.studies.buckled import ResolutionSpec
from modeharvest.validation.studies.resolution import MOTIONS, ResolutionAnalysis
from modeharvest.validation.studies.transfer import (
    AXES,
    QUANTITIES,
    WAVED,
    DegreeResolution,
    Passband,
    TransferCurves,
)

_SIZE = (4.6, 3.3)  # [in]
_DEGREES: Colormap = mpl.colormaps["viridis"]
_KEPT = 0.85
"""Images are compared with best fits separately for waves of which these find more [-]."""


def noise_floors(done: pd.DataFrame, spec: ResolutionSpec) -> pd.DataFrame:
    """Noise floors: the bound, predictions by each result's covariance, Monte Carlo errors.

    A row for each motion, degree and quantity; rms over realisations and material [10⁻³ px].
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
    """Measured shares of waves in images and in best fits [-], averaged over both phases."""
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
    """Draw T over the period for waves of a part along x and y; the colour is the degree."""
    pitch = spec.buckled.specimen.pitch
    degrees = sorted({key[2] for key in curves.own})
    drawn = style.figure(9.4, 3.1)
    both = drawn.subplots(1, 2, sharey=True)
    for axis, axes in enumerate(both):
        axes.axhline(KEPT, color=style.MUTED, linestyle=":", linewidth=1)
        for degree in degrees:
            colour = _colour(degree, degrees)
            axes.plot(curves.periods / pitch, curves.own[part, axis, degree], color=colour,
                      label=str(degree), linewidth=1.3)  # fmt: skip
        if len(waves):
            here = waves[(waves["wave of"] == part) & (waves["along"] == AXES[axis])]
            for degree, points in here.groupby("degree"):
                axes.plot(points["period [cells]"], points["images"], "o", ms=4,
                          color=_colour(int(degree), degrees), mec=style.INK, mew=0.5)  # fmt: skip
        axes.set(xscale="log", xlabel=f"period along {AXES[axis]} [cells]", ylim=(-0.03, 1.04))
        axes.grid(color=style.MUTED, alpha=0.18, lw=0.6)
        plain_ticks(axes.xaxis)
    both[0].set_ylabel("amplitude ratio [–]")
    both[1].legend(title="degree", title_fontsize=7.5,
                   loc="lower right")  # fmt: skip
    drawn.tight_layout()
    return drawn


def draw_indicators(degrees: Sequence[DegreeResolution], local: float) -> Figure:
    """Draw n over l10 for all degrees, and the line n l10 = ``local`` [px²] of affine subsets."""
    drawn, axes = curve("l₁₀ % [px]", "noise floor n [10⁻³ px]", _SIZE)
    ends = []
    for part, floor, colour in (("v0", "v0", style.BLUE), ("v1", "v1phi1", style.RED)):
        x = [np.sqrt(d.finest_px[f"{part} x"] * d.finest_px[f"{part} y"]) for d in degrees]
        y = [1e3 * d.floor_px[floor] for d in degrees]
        ends += x
        label = "v0" if part == "v0" else "v1 φ1"
        axes.plot(x, y, color=colour, marker="o", ms=4, linewidth=1, label=label)
        for d, at, high in zip(degrees, x, y, strict=True):
            axes.annotate(str(d.degree), (at, high), (4, 3), textcoords="offset points",
                          fontsize=6.5, color=colour)  # fmt: skip
    line = np.array([min(ends), max(ends)])
    axes.plot(line, 1e3 * local / line, color=style.GREEN, linestyle="--", linewidth=1,
              label="affine subset of any size (theory)")  # fmt: skip
    axes.set(xscale="log", yscale="log")
    axes.legend()
    plain_ticks(axes.xaxis, axes.yaxis)
    return drawn


def draw_passband(passband: Passband) -> Figure:
    """Draw measured shares of patterns of other wavelengths: added to the mode, or replacing it."""
    drawn, axes = curve("wave numbers over the mode's [–]", "amplitude ratio [–]", _SIZE)
    axes.axhline(KEPT, color=style.MUTED, linestyle=":", linewidth=1)
    axes.plot(passband.stretch, passband.added, color=style.BLUE, label="a small one beside it")
    known = np.isfinite(passband.itself)
    axes.plot(passband.stretch[known], passband.itself[known], "o", ms=3.5, color=style.RED,
              label="the pattern itself")  # fmt: skip
    axes.set_ylim(-0.03, 1.18)
    axes.legend(loc="upper center", ncols=2)
    return drawn


def _colour(degree: int, degrees: Sequence[int]) -> tuple[float, ...]:
    """RGBA colour of a degree, brighter for higher ones."""
    low, high = min(degrees), max(degrees)
    return _DEGREES(0.9 * (degree - low) / max(1, high - low))


def _text(found: ResolutionAnalysis, waves: pd.DataFrame, floors: pd.DataFrame) -> tuple[str, ...]:
    """The findings in sentences, the most important first.

    ``waves``, ``floors``: tables of :func:`measured_waves` and :func:`noise_floors`.
    """
    buckled, chosen, band = found.spec.buckled, found.chosen, found.passband
    pitch = buckled.specimen.pitch / buckled.pixel_size
    width = 2.0 * buckled.specimen.half_size[0] / buckled.pixel_size
    first, last = found.degrees[0], found.degrees[-1]
    before, after = (d.finest_px["v0 x"] for d in (first, last))
    v0, v1 = (chosen.finest_px[f"{part} x"] for part in ("v0", "v1"))
    products = [d.indicator_px2["v0"] for d in found.degrees]
    kept = band.stretch[(band.stretch > 0.82) & (band.added >= 0.9)]
    rise = {
        part: f"{1e3 * first.floor_px[name]:.2g} to {1e3 * last.floor_px[name]:.2g} · 10⁻³ px"
        for part, name in (("v0", "v0"), ("v1", "v1phi1"))
    }
    return (
        text_of("resolution-finest", degree=chosen.degree, v0=v0, v1=v1, v0_cells=v0 / pitch,
                 v1_cells=v1 / pitch, share=100 * v0 / width),
        text_of("resolution-trade-off", first=first, last=last, before=before / pitch,
                 after=after / pitch, **rise),
        text_of("resolution-product", first=first, last=last, gain=before / after,
                 least=min(products), most=max(products), subset=found.subset_px2),
        text_of("resolution-choice"),
        *_measured_text(found, waves, floors),
        text_of("resolution-pattern", px=2 * pitch, least=kept.min(), most=kept.max(),
                 degree=chosen.degree, retuned=100 * band.retuned),
    )  # fmt: skip


def _measured_text(
    found: ResolutionAnalysis, waves: pd.DataFrame, floors: pd.DataFrame
) -> list[str]:
    """Sentences on correlated images, compared with best fits and covariances; or none."""
    text = []
    if len(waves):
        off, kept = 100 * waves["difference"].abs(), waves["best fit"] >= _KEPT
        elsewhere = "" if kept.all() else f"; otherwise by {off[~kept].max():.1f} %"
        anywhere, resolved = (100 * share for share in found.curves.cross_talk())
        text.append(text_of(
            "resolution-images", kept=100 * _KEPT, amplitude=found.spec.amplitude_px,
            off=off[kept].max(), elsewhere=elsewhere, resolved=resolved, anywhere=anywhere,
        ))  # fmt: skip
    if len(floors):
        ratio = floors["Monte Carlo / predicted"]
        text.append(text_of("resolution-noise", least=ratio.min(), most=ratio.max(),
                             error=floors["±"].mean()))  # fmt: skip
    return text


def report_resolution(found: ResolutionAnalysis, seeds: str) -> Findings:
    """Transfer, noise floors and indicators by polynomial degree."""
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
        text=_text(found, waves, floors),
        keys=_keys(found.chosen, spec),
        figures={
            **{f"transfer-{part}": partial(draw_transfer, part, curves, waves, spec)
               for part in WAVED},
            "indicators": partial(draw_indicators, degrees, found.subset_px2),
            "passband": partial(draw_passband, found.passband),
        },
        words={"seeds": seeds, "degree": found.chosen.degree},
        tables=[
            ReportTable.of_frame("By degree", _by_degree(degrees, spec)),
            ReportTable.of_frame("Images against best fits", waves),
            ReportTable.of_frame("Noise floors", floors),
        ],
        attachments=[
            ReportTable.of_frame("Finest periods", _finest(degrees, spec)),
            ReportTable.of_frame("Transfer", _transfer_table(curves, spec)),
        ],
    )  # fmt: skip


def _by_degree(degrees: list[DegreeResolution], spec: ResolutionSpec) -> pd.DataFrame:
    """A row for each degree: l10, noise floors n, and indicators n l10."""
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
    """A row for each degree and wave: l10 in px, mm, cells, and % of the length of its domain."""
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
    """A row for each transfer curve and period."""
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


def _keys(chosen: DegreeResolution, spec: ResolutionSpec) -> list[KeyNumber]:
    pitch = spec.buckled.specimen.pitch / spec.buckled.pixel_size
    degree, keys = chosen.degree, []
    for part in WAVED:
        x, y = (chosen.finest_px[f"{part} {axis}"] / pitch for axis in AXES)
        keys.append(KeyNumber.of("degree-finest", f"{x:.1f} – {y:.1f}", of=part, degree=degree))
    for name, floor in (("v0", "v0"), ("v1 φ1", "v1phi1")):
        n, noise = f"{1e3 * chosen.floor_px[floor]:.2f}", 100 * spec.noise
        keys.append(KeyNumber.of("degree-noise", n, of=name, degree=degree, noise=noise))
    for part in WAVED:
        product = number(chosen.indicator_px2[part])
        keys.append(KeyNumber.of("degree-product", product, of=part, degree=degree))
    return keys
