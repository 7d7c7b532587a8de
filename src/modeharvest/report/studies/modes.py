"""Report of the study of measured modes: parameters, overlaps, patterns of all specimens."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from modeharvest.report.figures import style
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.maps import ColourScale, colour_bar, shaded
from modeharvest.report.model.content import Findings, KeyNumber, ReportTable
from modeharvest.report.model.text import text_of
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.studies.modes import (
    IDEAL,
    PARAMETERS,
    WAVE_VECTORS,
    ModesAnalysis,
    SpecimenPatterns,
    deviations,
    standardised_errors,
)


def parameters_summary(measured: pd.DataFrame) -> pd.DataFrame:
    """A row for each specimen: a₁; deviations of wave vectors and phases from Eq. (6)."""
    off, best = 100.0 * deviations(measured), 100.0 * deviations(measured, "best_")
    sds = [f"{name}_sd_model_error" for name in PARAMETERS]
    sd = 100.0 * measured[sds].set_axis(PARAMETERS, axis=1)
    phases = list(PARAMETERS[5:])
    return pd.DataFrame({
        "varied": measured["varied"], "level": measured["level"], "a₁": measured["a1"],
        "± 2 sd": 0.02 * sd["a1"], "a₁ of the best fit": measured["best_a1"],
        "a₁ of the infinite lattice": measured["lattice_a1"],
        "wave vectors off by up to [%]": off[WAVE_VECTORS].abs().max(axis=1),
        "± 2 sd [%]": 2.0 * sd[WAVE_VECTORS].max(axis=1),
        "those of the best fit [%]": best[WAVE_VECTORS].abs().max(axis=1),
        "phases off by up to [% of l]": off[phases].abs().max(axis=1),
        "± 2 sd [% of l]": 2.0 * sd[phases].max(axis=1),
        "those of the best fit [% of l]": best[phases].abs().max(axis=1).round(6),
    })  # fmt: skip


def parameters_table(measured: pd.DataFrame) -> pd.DataFrame:
    """A row for each parameter of each specimen; phases are divided by l."""
    rows = [
        {"varied": row["varied"], "level": row["level"], "d/l": row["ratio"], "parameter": name,
         "Eq. (6)": ideal, "measured": row[name],
         "± 2 sd by model error": 2.0 * row[f"{name}_sd_model_error"],
         "± 2 sd by 1 % of noise": 2.0 * row[f"{name}_sd_noise"],
         "best fit": row[f"best_{name}"],
         "infinite lattice": row["lattice_a1"] if name == "a1" else ideal}
        for _, row in measured.iterrows() for name, ideal in zip(PARAMETERS, IDEAL, strict=True)
    ]  # fmt: skip
    return pd.DataFrame(rows)


_WAVE_COLOURS = {"a2": style.BLUE, "a3": style.GREEN, "a4": style.GOLD, "a5": style.RED}
_PHASES = {"a6": style.BLUE, "a7": style.RED}
_IDEAL = dict(zip(PARAMETERS, IDEAL, strict=True))
"""Parameters of Eq. (6) with a solid junction at the origin; phases divided by l."""
_PATTERN_END, _ERROR_END = 0.15, 0.03  # ends of the colour scales [l]
_PAGE, _WIDEST = 8.9, 1.7  # width of all specimens together, largest width of one [in]
_ROWS = ("truth − v₀", "measured v₁φ₁", "truth − IDIC")


def draw_parameters(done: pd.DataFrame, at: FloatArray, ticks: Sequence[str], label: str) -> Figure:
    """Draw the modes' parameters: measured with error bars, best fit, infinite lattice.

    ``done``: a row for each specimen. ``at``: (n,) their positions on the horizontal axis.
    ``ticks``: their names, empty for a numerical axis. ``label``: label of the axis.
    """
    drawn = style.figure(9.6, 3.1 if not len(ticks) else 3.9)
    aspect, waves, phases = drawn.subplots(1, 3)
    apart = 0.012 * np.ptp(at) if len(at) > 1 else 0.1
    for axes, names in ((aspect, {"a1": style.BLUE}), (waves, _WAVE_COLOURS), (phases, _PHASES)):
        axes.axhline(0.0, color=style.MUTED, linestyle=":", linewidth=1)
        for n, (name, colour) in enumerate(names.items()):
            _parameter(axes, done, at + apart * (n - 0.5 * (len(names) - 1)), name, colour)
        _limit(axes, done, names)
        axes.set_xlabel(label)
        if len(ticks):
            axes.set_xticks(at, ticks, rotation=40, ha="right", fontsize=7)
    lattice = 100.0 * (done["lattice_a1"] - 1.0)
    aspect.plot(at, lattice, "x", color=style.INK, markersize=5, label="infinite lattice")
    aspect.set_ylabel("a₁ − 1 [%]")
    waves.set_ylabel("wave vectors − ideal [%]")
    phases.set_ylabel("phases [% of l]")
    for axes in (aspect, waves, phases):
        axes.legend(fontsize=7, ncols=4, loc="lower left", handlelength=1.2,
                    columnspacing=1.0, bbox_to_anchor=(-0.05, 1.0))  # fmt: skip
    drawn.tight_layout()
    return drawn


def _limit(axes: Axes, done: pd.DataFrame, names: Iterable[str]) -> None:
    """Limit an axis [%] so that all values are visible; much longer error bars are cut off."""
    off = [done[prefix + name] - _IDEAL[name] for name in names for prefix in ("", "best_")]
    bars = 2.0 * done[[f"{name}_sd_model_error" for name in names]]
    end = 100.0 * max(1.2 * float(np.abs(off).max()), 2.5 * float(bars.median().max()))
    axes.set_ylim(-end, end)


def _parameter(axes: Axes, done: pd.DataFrame, at: FloatArray, name: str, colour: str) -> None:
    """Draw a parameter's deviations from the ideal [%]: dots measured, ± 2 sd; rings best fit."""
    measured, best = (100.0 * (done[key] - _IDEAL[name]) for key in (name, f"best_{name}"))
    error = 200.0 * done[f"{name}_sd_model_error"]
    label = "measured" if name == "a1" else f"a{'₀₁₂₃₄₅₆₇'[int(name[1])]}"
    axes.errorbar(at, measured, error, color=colour, marker="o", markersize=3, linestyle="none",
                  capsize=1.5, elinewidth=0.8, label=label)  # fmt: skip
    axes.plot(at, best, "o", markersize=5.5, markerfacecolor="none", markeredgecolor=colour,
              markeredgewidth=0.8, label="best fit" if name == "a1" else None)  # fmt: skip


_MEASURED: dict[str, Any] = {"color": style.BLUE, "marker": "o", "markersize": 3}
_BEST: dict[str, Any] = {"color": style.GREEN, "marker": "s", "markersize": 3}
_LATTICE: dict[str, Any] = {"color": style.INK, "marker": "x", "markersize": 4}
_OVERLAPS = {
    "with the infinite lattice’s mode": {
        "overlap_lattice": ("measured", _MEASURED), "best_overlap_lattice": ("best fit", _BEST),
        "lattice_overlap_ideal": ("Eq. (6), ideal", _LATTICE),
    },
    "with the specimen’s own pattern": {
        "overlap_truth": ("measured", _MEASURED), "best_overlap_truth": ("best fit", _BEST),
    },
    "": {
        "critical_strain": ("the specimen", _MEASURED),
        "lattice_pattern_strain": ("infinite lattice", _LATTICE),
    },
}  # fmt: skip


def draw_overlaps(done: pd.DataFrame) -> Figure:
    """Draw overlaps with the lattice's mode and the specimen's pattern, and strains, over d/l."""
    drawn = style.figure(9.6, 2.9)
    for axes, (title, columns) in zip(drawn.subplots(1, 3), _OVERLAPS.items(), strict=True):
        for key, (text, look) in columns.items():
            values = done[key] if title else 100 * done[key]
            axes.plot(done["ratio"], values, linewidth=1, label=text, **look)
        label = "overlap [–]" if title else "pattern critical at a strain of [%]"
        axes.set(xlabel="d/l [–]", ylabel=label)
        axes.set_title(title, fontsize=8)
        axes.legend()
    drawn.tight_layout()
    return drawn


def draw_patterns(specimens: Mapping[str, SpecimenPatterns]) -> Figure:
    """Draw the true pattern, the measured one and the error, the specimens side by side.

    ``specimens``: by the title of their column. The component along y is drawn.
    """
    each = min(_WIDEST, _PAGE / len(specimens))
    window = 2.02 * np.max([np.abs(p.mesh.nodes + p.displacement).max(axis=0)
                            for p in specimens.values()], axis=0)  # fmt: skip
    wide = 0.2 + len(specimens) * each + 0.6
    drawn = style.figure(wide, 3.0 * each * window[1] / window[0] + 0.3)
    grid = drawn.subplots(3, len(specimens), squeeze=False)
    top = 1.0 - 0.25 / drawn.get_figheight()
    drawn.subplots_adjust(0.2 / wide, 0.0, 1.0 - 0.6 / wide, top, 0.02, 0.02)
    ends = ((_PATTERN_END, "l"), (_PATTERN_END, ""), (_ERROR_END, ""))
    scales = [ColourScale(style.SIGNED, -end, end, unit, "both") for end, unit in ends]
    for column, (text, p) in zip(grid.T, specimens.items(), strict=True):
        column[0].set_title(text, fontsize=7.5)
        fields = (p.pattern, p.displacement), (p.found_pattern, p.found), (
            p.displacement - p.found, p.displacement)  # fmt: skip
        for axes, (field, moved), scale in zip(column, fields, scales, strict=True):
            shaded(axes, p.mesh, moved, np.asarray(field[:, 1] / p.pitch), scale)
            style.draw_path(axes, MeshBoundary.of(p.mesh).path(moved), fill=False, ec=style.MUTED,
                            lw=0.3, rasterized=True)  # fmt: skip
            x, y = 0.5 * window
            axes.set(xlim=(-x, x), ylim=(-y, y), aspect="equal")
            axes.set_axis_off()
    for axes, text in zip(grid[:, 0], _ROWS, strict=True):
        axes.text(-0.02, 0.5, text, transform=axes.transAxes, rotation=90, va="center",
                  ha="right", fontsize=7.5)  # fmt: skip
    for axes, scale in zip(grid[:, -1], scales, strict=True):
        axes.apply_aspect()
        colour_bar(axes, scale)
    return drawn


def report_modes(found: ModesAnalysis, seeds: str) -> Findings:
    """The modes' parameters and overlaps, against d/l and other variations, and the patterns."""
    ran, measured, sizes = found.ran, found.measured, found.sizes
    strains = {name: 100.0 * ran[name] for name in ran if name.endswith("strain")}
    values = _of_sizes(sizes) if len(sizes) else {}
    return Findings(
        numbers={"specimens": ran.drop(columns=["error"]).to_dict("records")},
        text=[
            *(text_of(f"modes-{name}", **values) for name in ("measured", "best", "overlap")
              if values),
            *_of_the_others(measured),
            *_of_graded(measured),
            *_not_observable_text(ran),
            *_of_strains(ran),
        ],
        keys=[KeyNumber.of(name, **values) for name in
              ("waves-off", "a1-off", "overlap", "largest-error") if values],
        figures=_figures(measured, sizes, found.folder),
        words={"seeds": seeds.capitalize()},
        tables=[
            ReportTable.of("buckling", ran.assign(**strains).to_dict("records")),
            ReportTable.of_frame("Parameters", parameters_summary(measured)),
            ReportTable.of("overlaps", measured.to_dict("records")),
        ],
        attachments=[ReportTable.of_frame("Every parameter", parameters_table(measured))],
    )  # fmt: skip


def _percent(values: Any) -> str:
    """The largest magnitude of some values [-] as text [%], at least 0.001 %."""
    return f"{max(0.001, 100.0 * float(np.max(np.abs(values)))):.2g} %"


def _between(values: pd.Series) -> str:
    """The range of some overlaps as text; one number if both ends read the same."""
    ends = dict.fromkeys(f"{value:.4f}" for value in (values.min(), values.max()))
    return " to ".join(ends)


def _of_sizes(sizes: pd.DataFrame) -> dict[str, object]:
    """Values of the texts and key numbers on the specimens that differ in d/l only."""
    apart, errors, ratio = standardised_errors(sizes), sizes["measurement_error_px"], sizes["ratio"]
    overlaps = [key for columns in list(_OVERLAPS.values())[:2] for key in columns]

    def off(prefix: str = "") -> dict[str, str]:
        found = deviations(sizes, prefix)
        return {"waves": _percent(found[WAVE_VECTORS]), "a1": _percent(found["a1"]),
                "phases": _percent(found[["a6", "a7"]])}  # fmt: skip

    return {
        "specimens": "1 specimen" if len(sizes) == 1 else f"{len(sizes)} specimens",
        "least": ratio.min(), "most": ratio.max(), "measured": off(), "best": off("best_"),
        "least_error": errors.min(), "most_error": errors.max(),
        "within": (np.abs(apart) <= 2).sum(), "count": apart.size,
        "rms": np.sqrt((apart**2).mean()), "least_overlap": sizes["overlap_lattice"].min(),
        **{key: _between(sizes[key]) for key in overlaps},
    }  # fmt: skip


def _of_the_others(measured: pd.DataFrame) -> list[str]:
    """Sentences on the changes of the mode with l and with the material."""
    base, text = measured[measured["varied"] == "base"], []
    for varied, what in (("l", "size of the cells"), ("material", "material")):
        part = measured[measured["varied"] == varied]
        if len(part) and len(base):
            moved, best = (
                _percent(deviations(part, prefix).to_numpy() - deviations(base, prefix).to_numpy())
                for prefix in ("", "best_")
            )
            levels = ", ".join(map(str, part["level"]))
            text.append(text_of("modes-others", what=what, levels=levels, moved=moved, best=best,
                                 overlap=_between(part["overlap_lattice"])))  # fmt: skip
    return text


def _of_graded(measured: pd.DataFrame) -> list[str]:
    part = measured[measured["varied"].str.startswith("graded")]
    base = measured[measured["varied"] == "base"]
    if not len(part) or not len(base):
        return []
    return [text_of(
        "modes-graded", least=part["smallest_ratio"].min(), most=part["largest_ratio"].max(),
        waves=_percent(deviations(part)[WAVE_VECTORS]), overlap=_between(part["overlap_truth"]),
        worst=part.loc[part["overlap_truth"].idxmin()], base=base.iloc[0],
        error=part["model_error_px"].max(),
    )]  # fmt: skip


def _not_observable_text(ran: pd.DataFrame) -> list[str]:
    """Remarks on specimens without a measured pattern, unstable, or not simulated completely."""
    text = []
    for _, row in ran.iterrows():
        name, remarks = f"{row['varied']} {row['level']}".strip(), []
        if row["first"] == "none":
            text.append(f"{name}: no pattern, {row['simulation']}.")
            continue
        if row["first"] == "other":
            share = 100 * row["pattern_share"] ** 2
            remarks.append(text_of("modes-other-mode", share=share))
        elif row["outcome"] != "converged":
            remarks.append(f"the correlation ended {row['outcome']}, and does not count above")
        if row["simulation"] != "complete":
            remarks.append(row["simulation"])
        if row["unstable_pivots"]:
            remarks.append(text_of("modes-unstable", pivots=row["unstable_pivots"]))
        text += [f"{name}: {remark}." for remark in remarks]
    return text


def _of_strains(ran: pd.DataFrame) -> list[str]:
    """A sentence on critical strains of specimens over those of their infinite lattices."""
    known = ran[(ran["first"] == "pattern") & ~ran["varied"].str.startswith("graded")]
    both = known.dropna(subset=["lattice_pattern_strain"])
    if not len(both):
        return []
    ratio = both["critical_strain"] / both["lattice_pattern_strain"]
    return [text_of("modes-strains", least=ratio.min(), most=ratio.max())]


def _figures(
    measured: pd.DataFrame, sizes: pd.DataFrame, folder: Path
) -> dict[str, Callable[[], Figure]]:
    others = measured[measured["varied"] != "d/l"]
    graded = measured[measured["varied"].str.startswith("graded")]
    drawn: dict[str, Callable[[], Figure]] = {}
    if len(sizes):
        ratios = sizes["ratio"].to_numpy()
        drawn["parameters"] = partial(draw_parameters, sizes, ratios, (), "d/l [–]")
        drawn["overlaps"] = partial(draw_overlaps, sizes)
        drawn["patterns"] = _patterns(sizes, folder)
    if len(others) > 1:
        names = [f"{row['varied']} {row['level']}".strip() for _, row in others.iterrows()]
        at = np.arange(len(others), dtype=np.float64)
        drawn["others"] = partial(draw_parameters, others, at, names, "")
    if len(graded):
        drawn["graded"] = _patterns(graded, folder)
    return drawn


def _patterns(rows: pd.DataFrame, folder: Path) -> Callable[[], Figure]:
    """A function that draws the patterns of these specimens."""
    shown = {}
    for _, row in rows.iterrows():
        is_size = row["varied"] in ("base", "d/l")
        text = f"d/l = {row['ratio']:.3g}" if is_size else f"{row['varied']} {row['level']}"
        shown[text] = SpecimenPatterns.read(folder / "specimens" / row["specimen"])
    return partial(draw_patterns, shown)
