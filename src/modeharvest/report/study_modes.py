"""Report of measured modes: parameters, overlaps, patterns of all specimens."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch

from modeharvest.report.figures.maps import ColourScale
from modeharvest.report.figures.outlines import MeshBoundary, triangles
from modeharvest.report.figures.style import (
    BLUE,
    GOLD,
    GREEN,
    INK,
    MUTED,
    RED,
    SIGNED,
    figure,
)
from modeharvest.report.model import Card, Findings, KeyNumber, ReportTable, number
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.studies.modes import (
    IDEAL,
    PARAMETERS,
    WAVE_VECTORS,
    MeasuredModesStudy,
    ModesAnalysis,
    SpecimenPatterns,
    deviations,
    standardised_errors,
)

_BUCKLING = {
    "smallest_ratio": "d/l from", "largest_ratio": "to", "first": "buckles first into",
    "pattern_share": "pattern’s share of that mode", "critical_strain": "critical strain [%]",
    "lattice_first": "infinite lattice: first", "lattice_pattern_strain": "pattern critical at [%]",
    "strain": "measured at [%]", "unstable_pivots": "negative pivots there",
    "amplitude": "rms of v₁φ₁ [l]", "simulation": "simulation",
}  # fmt: skip
_LIKENESS = {
    "overlap_lattice": "with the infinite lattice: measured",
    "best_overlap_lattice": "best fit with it",
    "lattice_overlap_ideal": "Eq. (mode) with it", "overlap_truth": "with the specimen: measured",
    "best_overlap_truth": "best fit with that", "w_px": "truth − IDIC [px]",
    "model_error_px": "model error [px]", "measurement_error_px": "measurement error [px]",
    "iterations": "iterations", "outcome": "outcome",
}  # fmt: skip


def buckling_table(ran: pd.DataFrame) -> pd.DataFrame:
    """A row for each specimen: into what it buckles, and when."""
    percent = {name: 100.0 * ran[name] for name in _BUCKLING if name.endswith("strain")}
    return _renamed(ran.assign(**percent), _BUCKLING)


def likeness_table(measured: pd.DataFrame) -> pd.DataFrame:
    """A row for each specimen: overlaps of its mode, and errors of its displacement."""
    return _renamed(measured, _LIKENESS)


def _renamed(rows: pd.DataFrame, columns: Mapping[str, str]) -> pd.DataFrame:
    names = {"varied": "varied", "level": "level", **columns}
    return rows.reindex(columns=list(names)).rename(columns=names)


def parameters_summary(measured: pd.DataFrame) -> pd.DataFrame:
    """A row for each specimen: a₁, and how far its wave vectors and phases are from Eq. (mode)."""
    off, best = 100.0 * deviations(measured), 100.0 * deviations(measured, "best_")
    sd = 100.0 * measured[[f"{name}_sd_model_error" for name in PARAMETERS]].set_axis(
        PARAMETERS, axis=1
    )
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
    """A row for each parameter of each specimen, phases in shares of l."""
    rows = [
        {"varied": row["varied"], "level": row["level"], "d/l": row["ratio"], "parameter": name,
         "Eq. (mode)": ideal, "measured": row[name],
         "± 2 sd by model error": 2.0 * row[f"{name}_sd_model_error"],
         "± 2 sd by 1 % of noise": 2.0 * row[f"{name}_sd_noise"],
         "best fit": row[f"best_{name}"],
         "infinite lattice": row["lattice_a1"] if name == "a1" else ideal}
        for _, row in measured.iterrows() for name, ideal in zip(PARAMETERS, IDEAL, strict=True)
    ]  # fmt: skip
    return pd.DataFrame(rows)


_WAVE_COLOURS = {"a2": BLUE, "a3": GREEN, "a4": GOLD, "a5": RED}
_PHASES = {"a6": BLUE, "a7": RED}
_IDEAL = dict(zip(PARAMETERS, IDEAL, strict=True))
"""Eq. (mode) with a solid junction at the origin; phases in shares of l."""
_PATTERN_END, _ERROR_END = 0.15, 0.03  # of the colours, in l
_PAGE, _WIDEST = 8.9, 1.7  # of all specimens, and of one [in]
_ROWS = ("truth − v₀", "measured v₁φ₁", "truth − IDIC")


def draw_parameters(done: pd.DataFrame, at: FloatArray, ticks: Sequence[str], label: str) -> Figure:
    """Draw the modes' parameters: measured with error bars, best fit, infinite lattice.

    Parameters
    ----------
    done
        The specimens.
    at
        (n,) where each is on the axis.
    ticks
        Its name there; none for an axis of numbers.
    label
        Of the axis.
    """
    drawn = figure(9.6, 3.1 if not len(ticks) else 3.9)
    aspect, waves, phases = drawn.subplots(1, 3)
    apart = 0.012 * np.ptp(at) if len(at) > 1 else 0.1
    for axes, names in ((aspect, {"a1": BLUE}), (waves, _WAVE_COLOURS), (phases, _PHASES)):
        axes.axhline(0.0, color=MUTED, linestyle=":", linewidth=1)
        for n, (name, colour) in enumerate(names.items()):
            _parameter(axes, done, at + apart * (n - 0.5 * (len(names) - 1)), name, colour)
        _limit(axes, done, names)
        axes.set_xlabel(label)
        if len(ticks):
            axes.set_xticks(at, ticks, rotation=40, ha="right", fontsize=7)
    lattice = 100.0 * (done["lattice_a1"] - 1.0)
    aspect.plot(at, lattice, "x", color=INK, markersize=5, label="infinite lattice")
    aspect.set_ylabel("a₁ − 1 [%]")
    waves.set_ylabel("wave vectors − ideal [%]")
    phases.set_ylabel("phases [% of l]")
    for axes in (aspect, waves, phases):
        axes.legend(frameon=False, fontsize=7, ncols=4, loc="lower left", handlelength=1.2,
                    columnspacing=1.0, bbox_to_anchor=(-0.05, 1.0))  # fmt: skip
    drawn.tight_layout()
    return drawn


def _limit(axes: Axes, done: pd.DataFrame, names: Iterable[str]) -> None:
    """Show all values, and error bars as far as they don't hide all else [%]."""
    off = [done[prefix + name] - _IDEAL[name] for name in names for prefix in ("", "best_")]
    bars = 2.0 * done[[f"{name}_sd_model_error" for name in names]]
    end = 100.0 * max(1.2 * float(np.abs(off).max()), 2.5 * float(bars.median().max()))
    axes.set_ylim(-end, end)


def _parameter(axes: Axes, done: pd.DataFrame, at: FloatArray, name: str, colour: str) -> None:
    """Draw one parameter's deviation from the ideal one [%]: dots measured, rings best fit."""
    measured, best = (100.0 * (done[key] - _IDEAL[name]) for key in (name, f"best_{name}"))
    error = 200.0 * done[f"{name}_sd_model_error"]
    label = "measured" if name == "a1" else f"a{'₀₁₂₃₄₅₆₇'[int(name[1])]}"
    axes.errorbar(at, measured, error, color=colour, marker="o", markersize=3, linestyle="none",
                  capsize=1.5, elinewidth=0.8, label=label)  # fmt: skip
    axes.plot(at, best, "o", markersize=5.5, markerfacecolor="none", markeredgecolor=colour,
              markeredgewidth=0.8, label="best fit" if name == "a1" else None)  # fmt: skip


def draw_overlaps(done: pd.DataFrame) -> Figure:
    """Draw overlaps against d/l: with the infinite lattice's mode, and with the specimen's."""
    drawn = figure(9.6, 2.9)
    lattice, specimen, strains = drawn.subplots(1, 3)
    for axes, ends in ((lattice, _LATTICE), (specimen, _SPECIMEN)):
        for key, (text, look) in ends.items():
            axes.plot(done["ratio"], done[key], linewidth=1, label=text, **look)
        axes.set(xlabel="d/l [–]", ylabel="overlap [–]")
        axes.legend(frameon=False, fontsize=7)
    lattice.set_title("with the infinite lattice’s mode", fontsize=8)
    specimen.set_title("with the specimen’s own pattern", fontsize=8)
    for key, text, look in (
        ("critical_strain", "the specimen", {"color": BLUE, "marker": "o", "markersize": 3}),
        ("lattice_pattern_strain", "infinite lattice", {"color": INK, "marker": "x",
                                                        "markersize": 4}),
    ):  # fmt: skip
        strains.plot(done["ratio"], 100 * done[key], linewidth=1, label=text, **look)
    strains.set(xlabel="d/l [–]", ylabel="pattern critical at a strain of [%]")
    strains.legend(frameon=False, fontsize=7)
    drawn.tight_layout()
    return drawn


_LATTICE = {
    "overlap_lattice": ("measured", {"color": BLUE, "marker": "o", "markersize": 3}),
    "best_overlap_lattice": ("best fit", {"color": GREEN, "marker": "s", "markersize": 3}),
    "lattice_overlap_ideal": ("Eq. (mode), ideal", {"color": INK, "marker": "x", "markersize": 4}),
}
_SPECIMEN = {
    "overlap_truth": ("measured", {"color": BLUE, "marker": "o", "markersize": 3}),
    "best_overlap_truth": ("best fit", {"color": GREEN, "marker": "s", "markersize": 3}),
}


def draw_patterns(specimens: Mapping[str, SpecimenPatterns]) -> Figure:
    """Draw patterns side by side: the truth, what was measured of it, and the error.

    ``specimens`` are by the text above each.
    """
    each = min(_WIDEST, _PAGE / len(specimens))
    window = np.max([_window(p) for p in specimens.values()], axis=0)
    tall = each * window[1] / window[0]
    wide = 0.2 + len(specimens) * each + 0.6
    drawn = figure(wide, 3.0 * tall + 0.3)
    grid = drawn.subplots(3, len(specimens), squeeze=False)
    pattern = ColourScale(SIGNED, -_PATTERN_END, _PATTERN_END, "l", "both")
    error = ColourScale(SIGNED, -_ERROR_END, _ERROR_END, "l", "both")
    for column, (text, p) in zip(grid.T, specimens.items(), strict=True):
        column[0].set_title(text, fontsize=7.5)
        _show(column[0], p, p.pattern, p.displacement, pattern, window)
        _show(column[1], p, p.found_pattern, p.found, pattern, window)
        _show(column[2], p, p.displacement - p.found, p.displacement, error, window)
    for axes, text in zip(grid[:, 0], _ROWS, strict=True):
        axes.text(-0.02, 0.5, text, transform=axes.transAxes, rotation=90, va="center",
                  ha="right", fontsize=7.5)  # fmt: skip
    top = 1.0 - 0.25 / drawn.get_figheight()
    drawn.subplots_adjust(0.2 / wide, 0.0, 1.0 - 0.6 / wide, top, 0.02, 0.02)
    for row, scale in ((0, pattern), (1, pattern), (2, error)):
        _bar(grid[row, -1], scale)
    return drawn


def _window(p: SpecimenPatterns) -> FloatArray:
    """(2,) width and height that hold a specimen as it is deformed [mm]."""
    return np.asarray(2.02 * np.abs(p.mesh.nodes + p.displacement).max(axis=0))


def _show(
    axes: Axes,
    p: SpecimenPatterns,
    field: FloatArray,
    moved: FloatArray,
    scale: ColourScale,
    window: FloatArray,
) -> None:
    nodes = p.mesh.nodes + moved
    axes.tripcolor(triangles(nodes, p.mesh.cells), field[:, 1] / p.pitch, shading="gouraud",
                   cmap=scale.colours, norm=scale.normalise, rasterized=True)  # fmt: skip
    axes.add_patch(PathPatch(MeshBoundary.of(p.mesh).path(moved), fill=False, ec=MUTED, lw=0.3,
                             rasterized=True))  # fmt: skip
    width, height = window
    axes.set(xlim=(-0.5 * width, 0.5 * width), ylim=(-0.5 * height, 0.5 * height), aspect="equal")
    axes.set_axis_off()


def _bar(axes: Axes, scale: ColourScale) -> None:
    place = axes.inset_axes((1.06, 0.12, 0.05, 0.76))
    ends = [scale.low, 0.0, scale.high]
    axes.figure.colorbar(ScalarMappable(scale.normalise, scale.colours), cax=place, extend="both",
                         ticks=ends)  # fmt: skip
    place.set_yticks(
        ends, [f"{end:+.2g} l".replace("-", "−") if end else "0" for end in ends], fontsize=6.5
    )


def report_modes(study: MeasuredModesStudy, table: pd.DataFrame, folder: Path) -> Findings:
    """The modes' parameters and overlaps, against d/l and all else, and the patterns."""
    return modes_findings(study.analyse(table, folder), folder, study.seeds)


def modes_findings(found: ModesAnalysis, folder: Path, seeds: str) -> Findings:
    """The findings of an analysis.

    Parameters
    ----------
    found
        The analysis.
    folder
        Of the study, where the specimens are.
    seeds
        In words.
    """
    ran, measured, sizes = found.ran, found.measured, found.sizes
    return Findings(
        numbers={"specimens": ran.drop(columns=["error"]).to_dict("records")},
        sentences=_sentences(found),
        keys=_keys(sizes),
        figures=_figures(measured, sizes, folder, seeds),
        tables=[
            ReportTable.of("Buckling", buckling_table(ran)),
            ReportTable.of("Parameters", parameters_summary(measured)),
            ReportTable.of("Overlaps and errors", likeness_table(measured)),
        ],
        attachments=[ReportTable.of("Every parameter", parameters_table(measured))],
    )


def _percent(values: Any) -> str:
    """The largest size of some values, no smaller than anyone cares for."""
    return f"{max(0.001, 100.0 * float(np.max(np.abs(values)))):.2g} %"


def _between(values: pd.Series) -> str:
    """From the least to the largest of some overlaps; one that is alone by itself."""
    ends = dict.fromkeys(f"{value:.4f}" for value in (values.min(), values.max()))
    return " to ".join(ends)


def _keys(sizes: pd.DataFrame) -> tuple[KeyNumber, ...]:
    if not len(sizes):
        return ()
    span = f"d/l from {sizes['ratio'].min():.3g} to {sizes['ratio'].max():.3g}"
    return (
        KeyNumber("wave vectors", _percent(deviations(sizes)[WAVE_VECTORS]), "",
                  f"furthest from Eq. (mode) of all measured; {span}"),
        KeyNumber("a₁", _percent(deviations(sizes)["a1"]), "", f"furthest from 1; {span}"),
        KeyNumber("overlap", f"{sizes['overlap_lattice'].min():.4f}", "",
                  f"of the measured with the infinite lattice’s mode, the least; {span}"),
        KeyNumber("measurement error", number(float(sizes["measurement_error_px"].max())), "px",
                  f"the largest: rms of IDIC − best fit; {span}"),
    )  # fmt: skip


def _sentences(found: ModesAnalysis) -> list[str]:
    """What was found, the most important first."""
    ran, measured, sizes = found.ran, found.measured, found.sizes
    text = []
    if len(sizes):
        text += [*_of_parameters(sizes), _of_overlaps(sizes)]
    text += [
        *_of_the_others(measured),
        *_of_graded(measured),
        *_not_observable_sentences(ran, measured),
        *_of_strains(ran),
    ]
    return text


def _of_parameters(sizes: pd.DataFrame) -> list[str]:
    off, best = deviations(sizes), deviations(sizes, "best_")
    apart = standardised_errors(sizes)
    specimens = "1 specimen" if len(sizes) == 1 else f"{len(sizes)} specimens"
    return [
        f"On {specimens} with d/l from {sizes['ratio'].min():.3g} to "
        f"{sizes['ratio'].max():.3g} the measured wave vectors are within "
        f"{_percent(off[WAVE_VECTORS])} of Eq. (mode), a₁ within {_percent(off['a1'])} of 1, the "
        f"phases within {_percent(off[['a6', 'a7']])} of l.",
        "The best fits to the specimens’ own displacements are within "
        f"{_percent(best[WAVE_VECTORS])}, {_percent(best['a1'])} and "
        f"{_percent(best[['a6', 'a7']])}: that much is the specimens’. "
        f"The measurement error is {number(float(sizes['measurement_error_px'].min()))} to "
        f"{number(float(sizes['measurement_error_px'].max()))} px rms, and "
        f"{int((np.abs(apart) <= 2).sum())} of {apart.size} parameters are within two standard "
        f"deviations of the best fit’s (rms "
        f"{np.sqrt((apart**2).mean()):.2f} of them, by model error).",
    ]


def _of_overlaps(sizes: pd.DataFrame) -> str:
    return (
        "Overlap with the infinite lattice’s mode over all cells: measured "
        f"{_between(sizes['overlap_lattice'])}, best fit "
        f"{_between(sizes['best_overlap_lattice'])}, Eq. (mode) "
        f"{_between(sizes['lattice_overlap_ideal'])}. Overlap of v₁φ₁ with the specimen’s own "
        f"pattern: measured {_between(sizes['overlap_truth'])}, best fit "
        f"{_between(sizes['best_overlap_truth'])}."
    )


def _of_the_others(measured: pd.DataFrame) -> list[str]:
    """How far the mode moves with l and with the material."""
    base, text = measured[measured["varied"] == "base"], []
    for varied, what in (("l", "size of the cells"), ("material", "material")):
        part = measured[measured["varied"] == varied]
        if not len(part) or not len(base):
            continue
        moved = deviations(part).to_numpy() - deviations(base).to_numpy()
        best = deviations(part, "best_").to_numpy() - deviations(base, "best_").to_numpy()
        levels = ", ".join(map(str, part["level"]))
        text.append(
            f"With another {what} ({levels}) no parameter moves by more than {_percent(moved)} "
            f"from the base’s (best fits: {_percent(best)}); overlap with the infinite lattice’s "
            f"mode {_between(part['overlap_lattice'])}."
        )
    return text


def _of_graded(measured: pd.DataFrame) -> list[str]:
    part, base = (
        measured[measured["varied"].str.startswith("graded")],
        measured[measured["varied"] == "base"],
    )
    if not len(part) or not len(base):
        return []
    off = deviations(part)
    worst = part.loc[part["overlap_truth"].idxmin()]
    return [
        f"Graded specimens, d/l from {part['smallest_ratio'].min():.3g} to "
        f"{part['largest_ratio'].max():.3g}: one family with v₁ modulated has "
        f"wave vectors within {_percent(off[WAVE_VECTORS])} and an overlap with the specimen’s own "
        f"pattern of {_between(part['overlap_truth'])}, least where {worst['varied']} by "
        f"{worst['level']} (base: {base['overlap_truth'].iloc[0]:.4f}); the model error is "
        f"up to {number(float(part['model_error_px'].max()))} px (base: "
        f"{number(float(base['model_error_px'].iloc[0]))})."
    ]


def _not_observable_sentences(ran: pd.DataFrame, measured: pd.DataFrame) -> list[str]:
    """Specimens without a measured pattern, or in an unstable state."""
    text = []
    for _, row in ran.iterrows():
        name = f"{row['varied']} {row['level']}".strip()
        if row["first"] == "none":
            text.append(f"{name}: no pattern, {row['simulation']}.")
            continue
        if row["first"] == "other":
            text.append(
                f"{name}: buckles into something else first (the pattern is "
                f"{100 * row['pattern_share'] ** 2:.0f} % of the critical mode’s energy), and does "
                "not count above."
            )
        elif row["outcome"] != "converged":
            text.append(
                f"{name}: the correlation ended {row['outcome']}, and does not count above."
            )
        if row["simulation"] != "complete":
            text.append(f"{name}: {row['simulation']}.")
        if row["unstable_pivots"]:
            text.append(
                f"{name}: measured in a state that is not stable at a prescribed strain "
                f"({row['unstable_pivots']:.0f} negative pivots)."
            )
    return text


def _of_strains(ran: pd.DataFrame) -> list[str]:
    """Critical strains of the specimens against their lattices'."""
    known = ran[(ran["first"] == "pattern") & ~ran["varied"].str.startswith("graded")]
    both = known.dropna(subset=["lattice_pattern_strain"])
    if not len(both):
        return []
    ratio = both["critical_strain"] / both["lattice_pattern_strain"]
    return [
        "Clamped edges stiffen a specimen: it buckles at "
        f"{ratio.min():.2f} to {ratio.max():.2f} times the strain at which the pattern is critical "
        "in its infinite lattice."
    ]


def _figures(measured: pd.DataFrame, sizes: pd.DataFrame, folder: Path, seeds: str) -> list[Card]:
    cards = []
    if len(sizes):
        drawn = partial(draw_parameters, sizes, sizes["ratio"].to_numpy(), (), "d/l [–]")
        title = "Parameters of the mode against d/l"
        cards += [
            Card.single("parameters", title, drawn, _MARKS, wide=True),
            Card.single(
                "overlaps", "Overlaps, and critical strain of the pattern",
                partial(draw_overlaps, sizes),
                "Overlap |∫ u·φ| / (‖u‖ ‖φ‖) over the material, 1 for fields that differ by a "
                "factor. Left: of modes of constant amplitude over all cells; middle: of v₁φ₁ with "
                "the truth less the best fit’s v₀ over the cellular part. Right: where the pattern "
                f"becomes critical. {seeds.capitalize()}.", wide=True,
            ),
            _pattern_card("patterns", "Patterns, measured and true", sizes, folder),
        ]  # fmt: skip
    others = measured[~measured["varied"].isin(["d/l"])]
    if len(others) > 1:
        names = [f"{row['varied']} {row['level']}".strip() for _, row in others.iterrows()]
        drawn = partial(
            draw_parameters, others, np.arange(len(others), dtype=np.float64), names, ""
        )
        title = "Parameters of the mode, all else"
        cards.append(Card.single("others", title, drawn, _MARKS, wide=True))
    graded = measured[measured["varied"].str.startswith("graded")]
    if len(graded):
        title = "Graded specimens, measured and true"
        cards.append(_pattern_card("graded", title, graded, folder))
    return cards


_MARKS = (
    "Dots: measured, with two standard deviations by model error; rings: the best fit to the "
    "specimen’s own displacement; dotted: Eq. (mode) of the paper; crosses: the infinite lattice, "
    "whose wave vectors and phases are those of Eq. (mode) by symmetry. Bars that leave a picture "
    "are in the tables."
)


def _pattern_card(name: str, title: str, rows: pd.DataFrame, folder: Path) -> Card:
    shown = {}
    for _, row in rows.iterrows():
        is_size = row["varied"] in ("base", "d/l")
        text = f"d/l = {row['ratio']:.3g}" if is_size else f"{row['varied']} {row['level']}"
        shown[text] = SpecimenPatterns.read(folder / "specimens" / row["specimen"])
    caption = (
        "The component across the load, in shares of l, on the specimens as they are deformed. v₀ "
        "is the best fit’s. The colours of the error, below, are finer."
    )
    return Card.single(name, title, partial(draw_patterns, shown), caption, wide=True)
