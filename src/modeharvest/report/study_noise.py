"""Report of a noise study: scatter against its bounds, bias, coverage, maps."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from modeharvest.report.figures.curves import SMALL, WIDE, curve
from modeharvest.report.figures.style import (
    BLUE,
    EDGE,
    GOLD,
    GREEN,
    MUTED,
    RED,
    SIGNED,
    SIZE,
    figure,
)
from modeharvest.report.model import Card, Findings, KeyNumber, ReportTable, number
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.studies.noise import NoiseStudy
from modeharvest.validation.studies.noise_statistics import (
    CAUSES,
    PARTS,
    Estimate,
    FieldPoints,
    Levels,
    NoiseAnalysis,
    NoiseFreeCase,
    PairedErrors,
)
from modeharvest.validation.studies.study import VirtualImagePair

CAUSE_LABELS = {
    "bound": "bound: 2 s²M⁻¹",
    "det F": "and det F",
    "curvature": "and the cost’s curvature",
    "least": "and the noise’s gradient in w",
}
"""What each of the causes is called."""


def summary_table(
    levels: Levels, ours: Levels, soft: Levels, pair: VirtualImagePair
) -> pd.DataFrame:
    """A row for each level and quantity; error bars by three different covariances."""
    px = pair.images.grid.pixel_size
    everything = np.ones(pair.ansatz.size, dtype=np.bool_)
    families = {"all unknowns": everything} | {
        f"unknowns of {name}": part for name, part in _unknown_families(pair).items()
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
                "rms error / predicted": least.ratio.value,
                "± (2)": least.ratio.error,
                "bias / bound": bound.bias.value,
                "± (3)": bound.bias.error,
                "share in 95 % intervals": least.coverage.value,
                "± (4)": least.coverage.error,
                "by curvature only": curved.coverage.value,
                "by JᵀJ only": bound.coverage.value,
            })  # fmt: skip
    return pd.DataFrame(rows)


def with_errors(summary: pd.DataFrame) -> pd.DataFrame:
    """The same with values and their standard errors together."""
    read, last = pd.DataFrame(), ""
    for name in summary:
        if name.startswith("±"):
            read[last] = [
                str(Estimate(*pair)) for pair in zip(summary[last], summary[name], strict=True)
            ]
        else:
            shares = name.startswith("by ")
            read[name] = summary[name].map("{:.3f}".format) if shares else summary[name]
            last = name
    return read


def causes_table(levels: Levels, noise_free: NoiseFreeCase) -> pd.DataFrame:
    """Rms standard deviation or error over the bound, by causes and as measured; by fields."""
    first = levels[min(levels)]
    rows = []
    for cause in CAUSES:
        predicted = noise_free.predicted(cause)
        row: dict[str, Any] = {"what": CAUSE_LABELS[cause]}
        for name in PARTS:
            counted = first[name].counted
            row[name] = float(np.sqrt((predicted[name][counted] ** 2).mean()))
        rows.append(row)
    bound = dict(rows[0])
    rows = [{k: v if k == "what" else v / bound[k] for k, v in row.items()} for row in rows]
    for level, parts in sorted(levels.items()):
        measured = {name: parts[name].ratio.value for name in PARTS}
        rows.append({"what": f"measured at {100 * level:g}\u00a0%", **measured})
    return pd.DataFrame(rows)


def unknowns_table(levels: Levels, ours: Levels, pair: VirtualImagePair) -> pd.DataFrame:
    """A row for each unknown and level."""
    ansatz = pair.ansatz
    parts = []
    for level, found in sorted(levels.items()):
        bound, least = found["unknowns"], ours[level]["unknowns"]
        parts.append(pd.DataFrame({
            "noise": level, "unknown": ansatz.names, "unit": ansatz.units, "bound": bound.bound,
            "rms error / bound": bound.ratios,
            "rms error / predicted": least.ratios, "bias / bound": bound.biases,
            "share in 95 % intervals": least.covered,
        }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def maps_table(levels: Levels, ours: Levels, points: FieldPoints) -> pd.DataFrame:
    """A row for each level, field and point; vectors' components together."""
    parts = []
    for level, found in sorted(levels.items()):
        for name in PARTS:
            bound, least = found[name], ours[level][name]
            parts.append(pd.DataFrame({
                "noise": level, "field": name, "x [mm]": points.x, "y [mm]": points.y,
                "bound [mm]": np.sqrt((bound.bound**2).sum(axis=-1)),
                "rms error / bound": np.sqrt((bound.ratios**2).mean(axis=-1)),
                "rms error / predicted": np.sqrt((least.ratios**2).mean(axis=-1)),
                "bias / bound": np.sqrt((bound.biases**2).mean(axis=-1)),
                "share in 95 % intervals": least.covered.mean(axis=-1),
            }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def _unknown_families(pair: VirtualImagePair) -> dict[str, NDArray[np.bool_]]:
    """Which unknowns are those of v0, of v1 and of phi1."""
    names = np.array(pair.ansatz.names)
    heads = {"v0": "v0", "v1": "v1[", "phi1": "phi1."}
    families = {k: np.char.startswith(names, head) for k, head in heads.items()}
    return {name: part for name, part in families.items() if part.any()}


LABELS = {"u": "u", "v0": "v₀", "v1": "v₁", "v1 phi1": "v₁φ₁"}
SERIES: dict[str, dict[str, Any]] = {
    "u": {"color": BLUE, "marker": "o"},
    "v0": {"color": GREEN, "marker": "s"},
    "v1": {"color": GOLD, "marker": "^"},
    "v1 phi1": {"color": RED, "marker": "D"},
}
_FAMILIES = {"v0x": "v₀ along x", "v0y": "v₀ along y", "v1": "v₁", "phi1": "φ₁"}
_NOTHING = to_rgba(EDGE, 0.25)
_COVERAGE = "share in 95 % intervals [-]"
_LEVELS = {
    "ratio": ("Scatter", "rms error / predicted [-]", 1.0),
    "bias": ("Bias", "bias / Cramér–Rao bound [-]", 0.0),
    "coverage": ("Error bars", _COVERAGE, 0.95),
}


def draw_causes(causes: pd.DataFrame) -> Figure:
    """Draw rms over bound: what one cause after another predicts, and what is measured."""
    place = np.arange(len(causes))
    predicted = causes["what"].str.startswith("measured").argmax()
    drawn, axes = curve("", "rms / bound [-]", WIDE, below=0.55)
    axes.axvspan(predicted - 0.5, place[-1] + 0.5, color=MUTED, alpha=0.08, linewidth=0)
    for n, name in enumerate(PARTS):
        axes.plot(place + 0.09 * (n - 1.5), causes[name], linestyle="none", markersize=5,
                  label=LABELS[name], **SERIES[name])  # fmt: skip
    axes.axhline(1.0, color=MUTED, linestyle=":", linewidth=1)
    axes.axhline(causes["u"][predicted - 1], color=BLUE, linestyle=":", linewidth=1)
    axes.set_xticks(place, [textwrap.fill(what, 15) for what in causes["what"]])
    axes.set_xlim(-0.5, place[-1] + 0.5)
    axes.legend(frameon=False, fontsize=7.5, ncols=4, loc="upper left")
    return drawn


def draw_levels(levels: Mapping[float, Mapping[str, PairedErrors]], what: str) -> Figure:
    """Draw one of "ratio", "bias" and "coverage" of the fields over the level of noise."""
    at = np.array(sorted(levels))
    _, label, target = _LEVELS[what]
    drawn, axes = _over_noise(at, label, target)
    for n, name in enumerate(PARTS):
        shares: list[Estimate] = [getattr(levels[level][name], what) for level in at]
        _estimates(axes, at * (1.0 + 0.02 * (n - 1.5)), shares, LABELS[name], SERIES[name])
    axes.legend(frameon=False, fontsize=7.5)
    return drawn


def draw_bars(kinds: Mapping[str, Mapping[float, Mapping[str, PairedErrors]]]) -> Figure:
    """Draw how many unknowns are in intervals by one covariance and another."""
    at = np.array(sorted(next(iter(kinds.values()))))
    drawn, axes = _over_noise(at, _COVERAGE, 0.95)
    for (label, levels), look in zip(kinds.items(), SERIES.values(), strict=False):
        shares = [levels[level]["unknowns"].standardised.coverage for level in at]
        _estimates(axes, at, shares, label, look)
    axes.legend(frameon=False, fontsize=7.5)
    return drawn


def _over_noise(at: FloatArray, label: str, target: float) -> tuple[Figure, Axes]:
    """Empty axes of something over the levels of noise, with its expected value."""
    drawn, axes = curve("noise [% of full scale]", label, SMALL)
    axes.axhline(target, color=MUTED, linestyle=":", linewidth=1)
    axes.set_xscale("log")
    axes.set_xticks(100.0 * at, [f"{100 * level:g}" for level in at])
    axes.minorticks_off()
    return drawn, axes


def _estimates(
    axes: Axes, at: FloatArray, shares: Sequence[Estimate], label: str, look: Mapping[str, Any]
) -> None:
    value, error = np.array([(share.value, share.error) for share in shares]).T
    axes.errorbar(100.0 * at, value, error, markersize=4, capsize=2, linewidth=1, label=label,
                  **look)  # fmt: skip


def draw_unknowns(pairs: PairedErrors, names: Sequence[str]) -> Figure:
    """Draw each unknown's rms error and coverage."""
    count = pairs.errors.shape[0] * 2
    place = np.arange(len(names))
    drawn = figure(9.6, 3.4)
    above, below = drawn.subplots(2, 1, sharex=True)
    scatter = 1.0 / np.sqrt(2.0 * count)
    above.axhspan(1 - 2 * scatter, 1 + 2 * scatter, color=BLUE, alpha=0.12, linewidth=0)
    above.plot(place, pairs.ratios, ".", color=BLUE)
    above.set_ylabel("rms error / predicted [-]")
    spread = np.sqrt(0.95 * 0.05 / count)
    below.axhspan(0.95 - 2 * spread, min(1.0, 0.95 + 2 * spread), color=GREEN, alpha=0.15,
                  linewidth=0)  # fmt: skip
    below.plot(place, pairs.covered, ".", color=GREEN)
    below.set_ylabel("coverage of 95 % intervals [-]")
    _name_families(below, names)
    drawn.tight_layout()
    return drawn


def draw_maps(parts: Mapping[str, PairedErrors], points: FieldPoints) -> Figure:
    """Draw maps of the fields' scatter, of its ratio to the least and of their coverage."""
    grid = points.pair.images.grid
    x, y = grid.x[points.cols], grid.y[points.rows]
    extent = (float(x[0]), float(x[-1]), float(y[-1]), float(y[0]))
    drawn = figure(9.6, 8.6)
    boxes = drawn.subplots(3, len(PARTS), gridspec_kw={"hspace": 0.12, "wspace": 0.3})
    for column, name in enumerate(PARTS):
        pairs = parts[name]
        size, unit = (1e3, "µm") if name == "v1" else (1e3 / grid.pixel_size, "10⁻³ px")
        sd = size * np.sqrt((pairs.errors**2).mean(axis=(0, 1)).sum(axis=-1))
        sd[~pairs.counted.any(axis=-1)] = np.nan
        rows = (
            (sd, SIZE, (0.0, float(np.nanquantile(sd, 0.98))), f"rms error [{unit}]"),
            (np.sqrt((pairs.ratios**2).mean(axis=-1)), SIGNED, (0.6, 1.4),
             "rms error / predicted [-]"),
            (pairs.covered.mean(axis=-1), SIGNED, (0.88, 1.02), "coverage of 95 % intervals [-]"),
        )  # fmt: skip
        boxes[0, column].set_title(LABELS[name], fontsize=9)
        for row, (values, colours, limits, label) in enumerate(rows):
            axes = boxes[row, column]
            shown = axes.imshow(points.map(values), extent=extent, vmin=limits[0], vmax=limits[1],
                                cmap=colours.with_extremes(bad=_NOTHING),
                                interpolation="nearest")  # fmt: skip
            axes.set_axis_off()
            if row == 0 or column == len(PARTS) - 1:
                _bar(drawn, shown, axes, label)
    drawn.subplots_adjust(left=0.01, right=0.91, top=0.96, bottom=0.01)
    return drawn


def _bar(drawn: Figure, image: AxesImage, axes: Axes, label: str) -> None:
    place = axes.inset_axes((1.04, 0.0, 0.05, 1.0))
    drawn.colorbar(image, cax=place, label=label, extend="both")


def _name_families(axes: Axes, names: Sequence[str]) -> None:
    """Mark where the unknowns of v0x, v0y, v1 and phi1 begin."""
    firsts: dict[str, int] = {}
    for k, name in enumerate(names):
        firsts.setdefault(name.split("[")[0].split(".")[0], k)
    axes.set_xticks(list(firsts.values()), [_FAMILIES.get(name, name) for name in firsts])
    axes.set_xlim(-1, len(names))


def _figures(found: NoiseAnalysis, causes: pd.DataFrame, shown: float, seeds: str) -> list[Card]:
    levels, ours, points = found.by_bound, found.by_least, found.points
    pairs = max(len(parts["u"].errors) for parts in levels.values())
    made, at = f"{pairs} pairs of realisations; {seeds}", f"At {100 * shown:g} % of noise"
    bars = {"curvature, det F, gradient": ours, "curvature": found.by_hessian, "JᵀJ only": levels}
    names = points.pair.ansatz.names
    return [
        Card.single(
            "causes", "Contribution of each cause", partial(draw_causes, causes),
            "Over the Cramér–Rao bound: to the left what is predicted from exact images, one cause "
            f"after another; shaded, what is measured; {made}. Dotted: the bound, and the "
            "least-squares prediction for u.", wide=True,
        ),
        *(
            Card.single(what, _LEVELS[what][0], partial(draw_levels, by, what),
                        f"Fields, over all points; {made}. Bars: one standard error.")
            for what, by in (("ratio", ours), ("bias", levels), ("coverage", ours))
        ),
        Card.single(
            "bars", "Error bars by different covariances", partial(draw_bars, bars),
            f"All unknowns; {made}. Blue dots: with curvature, det F and the noise’s gradient in "
            "w; green squares: with curvature only; golden triangles: with neither. Bars: one "
            "standard error.",
        ),
        Card.single(
            "unknowns", "Each unknown",
            partial(draw_unknowns, ours[shown]["unknowns"], names),
            f"{at}; {made}. Bands: where 95 % of the points would lie by chance, the pairs taken "
            "for independent realisations.", wide=True,
        ),
        Card.single(
            "maps", "Maps over the material", partial(draw_maps, ours[shown], points),
            f"{at}; {made}. Above: rms length of the error; in the middle: over the least-squares "
            "prediction, 1 is white; below: coverage of the 95 % intervals, 0.95 is white. Both "
            "components of a vector together. Grey: no material there, or no φ₁.", wide=True,
        ),
    ]  # fmt: skip


def report_noise(study: NoiseStudy, table: pd.DataFrame, folder: Path) -> Findings:
    """Bias, scatter and coverage, for each unknown, for the fields, and as maps."""
    return noise_findings(study.analyse(table, folder), study.seeds)


def noise_findings(found: NoiseAnalysis, seeds: str) -> Findings:
    """The findings of an analysis; ``seeds`` in words."""
    levels, ours, row = found.by_bound, found.by_least, found.noise_free.row
    shown = sorted(levels)[len(levels) // 2]
    summary = summary_table(levels, ours, found.by_hessian, found.points.pair)
    causes = causes_table(levels, found.noise_free)
    parts = ("w_px", "model_error_px", "measurement_error_px")
    return Findings(
        numbers={
            "levels": summary.to_dict("records"),
            "causes": causes.to_dict("records"),
            "noise_free": {name: float(row[name]) for name in parts},
            "curvature_sd_ratio": {f"{k:g}": v for k, v in found.curvature_sd_ratio.items()},
            "not_converged": found.not_converged,
        },
        sentences=(
            *_level_sentences(levels, ours, found.points.pair),
            _cause_sentence(causes),
            *_other_sentences(found),
        ),
        keys=_keys(levels, ours, shown),
        figures=_figures(found, causes, shown, seeds),
        tables=[
            ReportTable.of("Noise levels", with_errors(summary)),
            ReportTable.of("Rms over the bound, by its causes [-]", causes.round(3)),
        ],
        attachments=[
            ReportTable.of("Noise levels", summary),
            ReportTable.of("Each unknown", unknowns_table(levels, ours, found.points.pair)),
            ReportTable.of("Maps", maps_table(levels, ours, found.points)),
        ],
    )


def _keys(levels: Levels, ours: Levels, shown: float) -> tuple[KeyNumber, ...]:
    at = f"at {100 * shown:g} % of noise"
    return (
        KeyNumber("rms error of u", str(ours[shown]["u"].ratio), "",
                  f"{at}, over the least-squares prediction"),
        KeyNumber("and over the bound", str(levels[shown]["u"].ratio), "",
                  "Cramér–Rao, of an ansatz that describes everything"),
        KeyNumber("bias of u", str(levels[shown]["u"].bias), "", f"{at}, over the bound"),
        KeyNumber("coverage of 95 % intervals", str(ours[shown]["unknowns"].standardised.coverage),
                  "", f"{at}; all unknowns"),
    )  # fmt: skip


def _level_sentences(levels: Levels, ours: Levels, pair: VirtualImagePair) -> tuple[str, ...]:
    px = pair.images.grid.pixel_size
    at = "at " + _listed(f"{100 * level:g}" for level in levels) + " % of noise in both images"
    shares = [
        (
            ours[level]["u"].ratio, parts["u"].ratio, parts["u"].bias,
            ours[level]["unknowns"].standardised.coverage, ours[level]["u"].coverage,
        )
        for level, parts in levels.items()
    ]  # fmt: skip
    ratio, over, bias, covered, covered_u = (
        _listed(map(str, column)) for column in zip(*shares, strict=True)
    )
    bound = levels[min(levels)]["u"].rms_bound / px / (100.0 * min(levels))
    return (
        f"The displacement's rms error is {ratio} times the least-squares prediction, {at}.",
        f"It is {over} times the Cramér–Rao bound, which is {number(bound)} px rms for each per "
        "cent of noise.",
        f"Coverage of the 95 % intervals: {covered} for the unknowns, {covered_u} for the "
        "displacement.",
        f"The bias of the displacement is {bias} times the bound.",
    )


def _listed(words: Iterable[str]) -> str:
    """With commas, and an "and" before the last."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def _cause_sentence(causes: pd.DataFrame) -> str:
    u = dict(zip(causes["what"], causes["u"], strict=True))
    det, curved, least = (u[CAUSE_LABELS[cause]] for cause in CAUSES[1:])
    return (
        "Why weak noise scatters the displacement by more than the bound: the bound is that of an "
        "ansatz without model error. Pixels that share the noise of g where the material has "
        f"shrunk (det F) make it {det:.3f} of it; the cost's own curvature, reduced by model "
        f"error, {curved:.3f}; the gradient of g's noise, times the model error, {least:.3f}: the "
        "least-squares prediction. What is above it at strong noise is of second order: the "
        "gradient of the noise against the speckle's, most of which correlation.gradient_blur_px "
        "keeps out."
    )


def _other_sentences(found: NoiseAnalysis) -> tuple[str, ...]:
    row, lost = found.noise_free.row, found.not_converged
    noisy = ", ".join(f"{v:.3f} at {100 * k:g} %" for k, v in found.curvature_sd_ratio.items())
    text = [
        "Each result's error bars are those of its own covariance given the noise, times what "
        "exact images predict that curvature, det F and the noise's gradient add, which is "
        "computed once: the curvature standard deviation of the displacement from a noisy pair is "
        f"{noisy} of noise, over that without.",
        "Without noise the measurement error is "
        f"{number(float(row['measurement_error_px']))} px rms per component and the model error "
        f"{number(float(row['model_error_px']))} px: the noise's "
        "error bars include neither. All errors above are against the noise-free solution.",
    ]
    if lost:
        text.append(f"{lost} correlations did not converge, and count as they ended.")
    return tuple(text)
