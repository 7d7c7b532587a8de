"""Report of a noise study: errors over the Cramér–Rao bound, bias, coverage, maps."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from numpy.typing import NDArray

from modeharvest.report.figures import style
from modeharvest.report.figures.curves import SMALL, WIDE, curve
from modeharvest.report.figures.maps import ColourScale, colour_bar
from modeharvest.report.model.content import Findings, KeyNumber, ReportTable
from modeharvest.report.model.text import text_of
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.studies.noise_statistics import (
    CAUSES,
    HESSIAN_CORRECTED,
    PARTS,
    Estimate,
    FieldPoints,
    Levels,
    NoiseAnalysis,
    PairedErrors,
)
from modeharvest.validation.studies.study import VirtualImagePair

CAUSE_LABELS = {
    "bound": "bound: 2 s²M⁻¹",
    "det F": "and det F",
    "curvature": "and the cost’s curvature",
    "least": "and the noise’s gradient in w",
}
"""Labels of the causes in tables and figures; each includes all before it."""


def summary_table(
    levels: Levels, ours: Levels, soft: Levels, pair: VirtualImagePair
) -> pd.DataFrame:
    """A row for each noise level and quantity, with coverage by three different covariances."""
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
    """The table of :func:`summary_table` with each value and its standard error in one cell."""
    read, last = pd.DataFrame(), ""
    for name in summary:
        if name.startswith("±"):
            pairs = zip(summary[last], summary[name], strict=True)
            read[last] = [str(Estimate(*pair)) for pair in pairs]
        else:
            is_share, last = name.startswith("by "), name
            read[name] = summary[name].map("{:.3f}".format) if is_share else summary[name]
    return read


def causes_table(found: NoiseAnalysis) -> pd.DataFrame:
    """Rms errors of the fields over their bound: predicted, cause by cause, and measured [-]."""
    levels = found.against["bound"]
    first = levels[min(levels)]
    rows: list[dict[str, Any]] = []
    bound: dict[str, float] = {}
    for cause in CAUSES:
        predicted = found.predicted[cause]
        squares = {name: predicted[name][first[name].counted] ** 2 for name in PARTS}
        rms = {name: float(np.sqrt(part.mean())) for name, part in squares.items()}
        bound = bound or rms
        over = {name: value / bound[name] for name, value in rms.items()}
        rows.append({"what": CAUSE_LABELS[cause], **over})
    for level, parts in sorted(levels.items()):
        measured = {name: parts[name].ratio.value for name in PARTS}
        rows.append({"what": f"measured at {100 * level:g}\u00a0%", **measured})
    return pd.DataFrame(rows)


def unknowns_table(levels: Levels, ours: Levels, pair: VirtualImagePair) -> pd.DataFrame:
    """A row for each noise level and unknown."""
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
    """A row for each noise level, field and point, with a vector's components combined."""
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
    """(n,) masks of the unknowns that belong to v0, v1 and phi1, by these names."""
    names = np.array(pair.ansatz.names)
    heads = {"v0": "v0", "v1": "v1[", "phi1": "phi1."}
    families = {k: np.char.startswith(names, head) for k, head in heads.items()}
    return {name: part for name, part in families.items() if part.any()}


LABELS = {"u": "u", "v0": "v₀", "v1": "v₁", "v1 phi1": "v₁φ₁"}
SERIES: dict[str, dict[str, Any]] = {
    "u": {"color": style.BLUE, "marker": "o"},
    "v0": {"color": style.GREEN, "marker": "s"},
    "v1": {"color": style.GOLD, "marker": "^"},
    "v1 phi1": {"color": style.RED, "marker": "D"},
}
_FAMILIES = {"v0x": "v₀ along x", "v0y": "v₀ along y", "v1": "v₁", "phi1": "φ₁"}
_MAPPED = ("rms error", "rms error / predicted", "coverage")
_NOTHING = to_rgba(style.EDGE, 0.25)
_COVERAGE = "share in 95 % intervals [-]"
_LEVELS = {
    "ratio": ("rms error / predicted [-]", 1.0),
    "bias": ("bias / Cramér–Rao bound [-]", 0.0),
    "coverage": (_COVERAGE, 0.95),
}


def draw_causes(causes: pd.DataFrame) -> Figure:
    """Draw rms errors over the bound: predicted with more and more causes, and measured."""
    place = np.arange(len(causes))
    predicted = causes["what"].str.startswith("measured").argmax()
    drawn, axes = curve("", "rms / bound [-]", WIDE, below=0.55)
    axes.axvspan(predicted - 0.5, place[-1] + 0.5, color=style.MUTED, alpha=0.08, linewidth=0)
    for n, name in enumerate(PARTS):
        axes.plot(place + 0.09 * (n - 1.5), causes[name], linestyle="none", markersize=5,
                  label=LABELS[name], **SERIES[name])  # fmt: skip
    axes.axhline(1.0, color=style.MUTED, linestyle=":", linewidth=1)
    axes.axhline(causes["u"][predicted - 1], color=style.BLUE, linestyle=":", linewidth=1)
    axes.set_xticks(place, [textwrap.fill(what, 15) for what in causes["what"]])
    axes.set_xlim(-0.5, place[-1] + 0.5)
    axes.legend(ncols=4, loc="upper left")
    return drawn


def draw_levels(levels: Mapping[float, Mapping[str, PairedErrors]], what: str) -> Figure:
    """Draw the fields' "ratio", "bias" or "coverage", given as ``what``, over the noise level."""
    at = np.array(sorted(levels))
    label, target = _LEVELS[what]
    drawn, axes = _over_noise(at, label, target)
    for n, name in enumerate(PARTS):
        shares: list[Estimate] = [getattr(levels[level][name], what) for level in at]
        _estimates(axes, at * (1.0 + 0.02 * (n - 1.5)), shares, LABELS[name], SERIES[name])
    axes.legend()
    return drawn


def draw_bars(kinds: Mapping[str, Mapping[float, Mapping[str, PairedErrors]]]) -> Figure:
    """Draw coverage of the unknowns' 95 % intervals over the noise level, by covariance."""
    at = np.array(sorted(next(iter(kinds.values()))))
    drawn, axes = _over_noise(at, _COVERAGE, 0.95)
    for (label, levels), look in zip(kinds.items(), SERIES.values(), strict=False):
        shares = [levels[level]["unknowns"].standardised.coverage for level in at]
        _estimates(axes, at, shares, label, look)
    axes.legend()
    return drawn


def _over_noise(at: FloatArray, label: str, target: float) -> tuple[Figure, Axes]:
    """Empty axes over the noise levels ``at`` [-], with a line at the value ``target``."""
    drawn, axes = curve("noise [% of full scale]", label, SMALL)
    axes.axhline(target, color=style.MUTED, linestyle=":", linewidth=1)
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
    """Draw each unknown's rms error over the predicted one, and its coverage."""
    count = pairs.errors.shape[0] * 2
    scatter, spread = 2.0 / np.sqrt(2.0 * count), 2.0 * np.sqrt(0.95 * 0.05 / count)
    drawn = style.figure(9.6, 3.4)
    above, below = drawn.subplots(2, 1, sharex=True)
    above.axhspan(1 - scatter, 1 + scatter, color=style.BLUE, alpha=0.12, linewidth=0)
    above.plot(pairs.ratios, ".", color=style.BLUE)
    above.set_ylabel("error / predicted [-]")
    top = min(1.0, 0.95 + spread)
    below.axhspan(0.95 - spread, top, color=style.GREEN, alpha=0.15, linewidth=0)
    below.plot(pairs.covered, ".", color=style.GREEN)
    below.set_ylabel("coverage [-]")
    firsts: dict[str, int] = {}  # index of the first unknown of v0x, v0y, v1, phi1
    for k, name in enumerate(names):
        firsts.setdefault(name.split("[")[0].split(".")[0], k)
    below.set_xticks(list(firsts.values()), [_FAMILIES.get(name, name) for name in firsts])
    below.set_xlim(-1, len(names))
    drawn.tight_layout()
    return drawn


def draw_maps(parts: Mapping[str, PairedErrors], points: FieldPoints) -> Figure:
    """Draw maps of the fields' rms error, of its ratio to the predicted one, and of coverage."""
    grid = points.pair.images.grid
    x, y = grid.x[points.cols], grid.y[points.rows]
    extent = (float(x[0]), float(x[-1]), float(y[-1]), float(y[0]))
    drawn = style.figure(9.6, 8.6)
    boxes = drawn.subplots(3, len(PARTS))
    drawn.subplots_adjust(left=0.01, right=0.91, top=0.93, bottom=0.01, hspace=0.22, wspace=0.3)
    for column, name in zip(boxes.T, PARTS, strict=True):
        is_last = column[0] is boxes[0, -1]
        pairs = parts[name]
        size, unit = (1e3, "µm") if name == "v1" else (1e3 / grid.pixel_size, "10⁻³ px")
        sd = size * np.sqrt((pairs.errors**2).mean(axis=(0, 1)).sum(axis=-1))
        sd[~pairs.counted.any(axis=-1)] = np.nan
        rows = (
            (sd, ColourScale(style.SIZE, 0.0, float(np.nanquantile(sd, 0.98)), unit, "max")),
            (np.sqrt((pairs.ratios**2).mean(axis=-1)),
             ColourScale(style.SIGNED, 0.6, 1.4, "", "both")),
            (pairs.covered.mean(axis=-1), ColourScale(style.SIGNED, 0.88, 1.02, "", "both")),
        )  # fmt: skip
        for axes, (values, scale), what in zip(column, rows, _MAPPED, strict=True):
            colours = scale.of(points.map(values))
            colours[colours[..., 3] == 0.0] = _NOTHING
            axes.imshow(colours, extent=extent, interpolation="nearest", rasterized=True)
            axes.set_axis_off()
            axes.set_title(f"{what} of {LABELS[name]}", fontsize=8.5)
            axes.apply_aspect()
            if axes is column[0] or is_last:
                colour_bar(axes, scale)
    return drawn


def report_noise(found: NoiseAnalysis, seeds: str) -> Findings:
    """Rms error, bias and coverage of the unknowns and of the fields, and maps."""
    levels, ours, soft = (found.against[cause] for cause in ("bound", "least", HESSIAN_CORRECTED))
    shown, lowest = sorted(levels)[len(levels) // 2], min(levels)
    summary = summary_table(levels, ours, soft, found.points.pair)
    causes, row = causes_table(found), found.noise_free
    parts = ("w_px", "model_error_px", "measurement_error_px")
    bars = {"curvature, det F, gradient": ours, "curvature": soft, "JᵀJ only": levels}
    names, px = found.points.pair.ansatz.names, found.points.pair.images.grid.pixel_size
    noisy = ", ".join(f"{v:.3f} at {100 * k:g} %" for k, v in found.curvature_sd_ratio.items())
    values = {
        "pairs": max(len(parts["u"].errors) for parts in levels.values()), "seeds": seeds,
        "level": 100 * shown, "of_bound": levels[shown], "of_predicted": ours[shown],
        "at": _listed(f"{100 * level:g}" for level in levels),
        "ratio": _listed(ours[level]["u"].ratio for level in levels),
        "over": _listed(parts["u"].ratio for parts in levels.values()),
        "bias": _listed(parts["u"].bias for parts in levels.values()),
        "covered": _listed(ours[level]["unknowns"].standardised.coverage for level in levels),
        "covered_u": _listed(ours[level]["u"].coverage for level in levels),
        "bound": levels[lowest]["u"].rms_bound / px / (100.0 * lowest),
        "causes": dict(zip(CAUSES, causes["u"][: len(CAUSES)], strict=True)),
        "noisy": noisy, "row": row, "lost": found.not_converged,
    }  # fmt: skip
    texts = ["scatter", "bound", "coverage", "bias", "causes", "bars", "without"]
    texts += ["not-converged"] * (found.not_converged > 0)
    return Findings(
        numbers={
            "levels": summary.to_dict("records"),
            "causes": causes.to_dict("records"),
            "noise_free": {name: float(row[name]) for name in parts},
            "curvature_sd_ratio": {f"{k:g}": v for k, v in found.curvature_sd_ratio.items()},
            "not_converged": found.not_converged,
        },
        text=[text_of(f"noise-{name}", **values) for name in texts],
        keys=[KeyNumber.of(name, **values) for name in
              ("rms-over-predicted", "rms-over-bound", "bias", "coverage")],
        figures={
            "causes": partial(draw_causes, causes),
            "ratio": partial(draw_levels, ours, "ratio"),
            "bias": partial(draw_levels, levels, "bias"),
            "coverage": partial(draw_levels, ours, "coverage"),
            "bars": partial(draw_bars, bars),
            "unknowns": partial(draw_unknowns, ours[shown]["unknowns"], names),
            "maps": partial(draw_maps, ours[shown], found.points),
        },
        words=values,
        tables=[
            ReportTable.of_frame("Noise levels", with_errors(summary)),
            ReportTable.of_frame("Rms over the bound, by its causes [-]", causes.round(3)),
        ],
        attachments=[
            ReportTable.of_frame("Noise levels", summary),
            ReportTable.of_frame("Each unknown", unknowns_table(levels, ours, found.points.pair)),
            ReportTable.of_frame("Maps", maps_table(levels, ours, found.points)),
        ],
    )  # fmt: skip


def _listed(things: Iterable[object]) -> str:
    """The items as text, separated by commas, with "and" before the last one."""
    *first, last = map(str, things)
    return f"{', '.join(first)} and {last}" if first else last
