"""What the table of measured modes tells: how alike they are, and how far to trust that."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from modeharvest.validation.page import short
from modeharvest.validation.studies.modes import plots
from modeharvest.validation.studies.modes.description import folder_of
from modeharvest.validation.studies.modes.study import Modes
from modeharvest.validation.studies.modes.tables import (
    WAVES,
    alike,
    buckling,
    deviations,
    misses,
    parameters,
    summed_up,
)
from modeharvest.validation.studies.study import Findings, KeyNumber, Plot


def report_modes(study: Modes, table: pd.DataFrame, folder: Path) -> Findings:
    """The modes' parameters and overlaps, against d/l and all else, and the patterns."""
    return findings(table, folder, study.seeds)


def findings(table: pd.DataFrame, folder: Path, seeds: str) -> Findings:
    """Read the table of all specimens.

    Parameters
    ----------
    table
        A row for each case of
        :func:`modeharvest.validation.studies.modes.specimen.one_specimen`.
    folder
        Of the study, where the specimens are.
    seeds
        In words.
    """
    ran = table[table["error"] == ""]
    seen = measured(ran)
    sizes = _of_sizes(seen).sort_values("ratio")
    return Findings(
        numbers={"specimens": ran.drop(columns=["error"]).to_dict("records")},
        sentences=tuple(_sentences(ran, seen)),
        keys=_keys(seen, sizes),
        plots=tuple(_plots(seen, sizes, folder, seeds)),
        tables={
            "How they buckle": buckling(ran),
            "Parameters": summed_up(seen),
            "How alike modes and patterns are": alike(seen),
        },
        attachments={"Every parameter": parameters(seen)},
    )


def measured(ran: pd.DataFrame) -> pd.DataFrame:
    """The specimens whose pattern was there to be measured and was: converged on a pattern."""
    if "outcome" not in ran:
        return ran.iloc[:0]
    return ran[(ran["first"] == "pattern") & (ran["outcome"] == "converged")]


def _of_sizes(rows: pd.DataFrame) -> pd.DataFrame:
    """Those that differ from the base in d/l only, and the base."""
    return rows[rows["varied"].isin(["base", "d/l"])]


def _percent(values: Any) -> str:
    """The largest size of some values, no smaller than anyone cares for."""
    return f"{max(0.001, 100.0 * float(np.max(np.abs(values)))):.2g} %"


def _between(values: pd.Series) -> str:
    """From the least to the largest of some overlaps; one that is alone by itself."""
    ends = dict.fromkeys(f"{value:.4f}" for value in (values.min(), values.max()))
    return " to ".join(ends)


def _keys(seen: pd.DataFrame, sizes: pd.DataFrame) -> tuple[KeyNumber, ...]:
    if not len(sizes):
        return ()
    span = f"d/l from {sizes['ratio'].min():.3g} to {sizes['ratio'].max():.3g}"
    return (
        KeyNumber("wave vectors", _percent(deviations(sizes)[WAVES]), "",
                  f"furthest from Eq. (mode) of all measured; {span}"),
        KeyNumber("a₁", _percent(deviations(sizes)["a1"]), "", f"furthest from 1; {span}"),
        KeyNumber("overlap", f"{sizes['overlap_lattice'].min():.4f}", "",
                  f"of the measured with the infinite lattice’s mode, the least; {span}"),
        KeyNumber("IDIC − best fit", short(float(sizes["lost_px"].max())), "px",
                  f"the most: what the measurement adds; {span}"),
    )  # fmt: skip


def _sentences(ran: pd.DataFrame, seen: pd.DataFrame) -> list[str]:
    """What was found, the most important first."""
    said = []
    sizes = _of_sizes(seen)
    if len(sizes):
        said += [*_of_parameters(sizes), _of_overlaps(sizes)]
    said += [*_of_the_others(seen), *_of_graded(seen), *_not_seen(ran, seen), *_of_strains(ran)]
    return said


def _of_parameters(sizes: pd.DataFrame) -> list[str]:
    off, best = deviations(sizes), deviations(sizes, "best_")
    apart = misses(sizes)
    specimens = "1 specimen" if len(sizes) == 1 else f"{len(sizes)} specimens"
    return [
        f"On {specimens} with d/l from {sizes['ratio'].min():.3g} to "
        f"{sizes['ratio'].max():.3g} the measured wave vectors are within "
        f"{_percent(off[WAVES])} of Eq. (mode), a₁ within {_percent(off['a1'])} of 1, the "
        f"phases within {_percent(off[['a6', 'a7']])} of l.",
        f"The best fits to the specimens’ own displacements are within {_percent(best[WAVES])}, "
        f"{_percent(best['a1'])} and {_percent(best[['a6', 'a7']])}: that much is the specimens’. "
        f"The measurement adds {short(float(sizes['lost_px'].min()))} to "
        f"{short(float(sizes['lost_px'].max()))} px rms, and {int((np.abs(apart) <= 2).sum())} of "
        f"{apart.size} parameters are within two standard deviations of the best fit’s (rms "
        f"{np.sqrt((apart**2).mean()):.2f} of them, by what the ansatz leaves over).",
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


def _of_the_others(seen: pd.DataFrame) -> list[str]:
    """How far the mode moves with l and with the material."""
    base, said = seen[seen["varied"] == "base"], []
    for varied, what in (("l", "size of the cells"), ("material", "material")):
        part = seen[seen["varied"] == varied]
        if not len(part) or not len(base):
            continue
        moved = deviations(part).to_numpy() - deviations(base).to_numpy()
        best = deviations(part, "best_").to_numpy() - deviations(base, "best_").to_numpy()
        levels = ", ".join(map(str, part["level"]))
        said.append(
            f"With another {what} ({levels}) no parameter moves by more than {_percent(moved)} "
            f"from the base’s (best fits: {_percent(best)}); overlap with the infinite lattice’s "
            f"mode {_between(part['overlap_lattice'])}."
        )
    return said


def _of_graded(seen: pd.DataFrame) -> list[str]:
    part, base = seen[seen["varied"].str.startswith("graded")], seen[seen["varied"] == "base"]
    if not len(part) or not len(base):
        return []
    off = deviations(part)
    worst = part.loc[part["overlap_truth"].idxmin()]
    return [
        f"Graded specimens, d/l from {part['smallest_ratio'].min():.3g} to "
        f"{part['largest_ratio'].max():.3g}: one family with v₁ modulated has "
        f"wave vectors within {_percent(off[WAVES])} and an overlap with the specimen’s own "
        f"pattern of {_between(part['overlap_truth'])}, least where {worst['varied']} by "
        f"{worst['level']} (base: {base['overlap_truth'].iloc[0]:.4f}); truth − best fit is "
        f"up to {short(float(part['best_px'].max()))} px (base: "
        f"{short(float(base['best_px'].iloc[0]))})."
    ]


def _not_seen(ran: pd.DataFrame, seen: pd.DataFrame) -> list[str]:
    """What did not go as meant, specimen by specimen."""
    said = []
    for _, row in ran.iterrows():
        name = f"{row['varied']} {row['level']}".strip()
        if row["first"] == "none":
            said.append(f"{name}: no pattern, {row['simulation']}.")
            continue
        if row["first"] == "other":
            said.append(
                f"{name}: buckles into something else first (the pattern is "
                f"{100 * row['pattern_share'] ** 2:.0f} % of the critical mode’s energy), and does "
                "not count above."
            )
        elif row["outcome"] != "converged":
            said.append(
                f"{name}: the correlation ended {row['outcome']}, and does not count above."
            )
        if row["simulation"] != "complete":
            said.append(f"{name}: {row['simulation']}.")
        if row["unstable_pivots"]:
            said.append(
                f"{name}: measured in a state that is not stable at a held strain "
                f"({row['unstable_pivots']:.0f} negative pivots)."
            )
    return said


def _of_strains(ran: pd.DataFrame) -> list[str]:
    """Critical strains of the specimens against their lattices'."""
    known = ran[(ran["first"] == "pattern") & ~ran["varied"].str.startswith("graded")]
    both = known.dropna(subset=["lattice_pattern_strain"])
    if not len(both):
        return []
    ratio = both["critical_strain"] / both["lattice_pattern_strain"]
    return [
        "Clamped edges hold a specimen back: it buckles at "
        f"{ratio.min():.2f} to {ratio.max():.2f} times the strain at which the pattern is critical "
        "in its infinite lattice."
    ]


def _plots(seen: pd.DataFrame, sizes: pd.DataFrame, folder: Path, seeds: str) -> list[Plot]:
    made = []
    if len(sizes):
        drawn = plots.draw_parameters(sizes, sizes["ratio"].to_numpy(), (), "d/l [–]")
        made.append(
            Plot("parameters", "The mode’s parameters against d/l", drawn, _MARKS, wide=True)
        )
        made.append(plots.draw_overlaps(sizes, seeds))
        made.append(_patterns(sizes, folder, "patterns", "Patterns, measured and true"))
    others = seen[~seen["varied"].isin(["d/l"])]
    if len(others) > 1:
        names = [f"{row['varied']} {row['level']}".strip() for _, row in others.iterrows()]
        drawn = plots.draw_parameters(others, np.arange(len(others), dtype=np.float64), names, "")
        made.append(Plot("others", "The mode’s parameters, all else", drawn, _MARKS, wide=True))
    graded = seen[seen["varied"].str.startswith("graded")]
    if len(graded):
        made.append(_patterns(graded, folder, "graded", "Graded specimens, measured and true"))
    return made


_MARKS = (
    "Dots: measured, with two standard deviations by what the ansatz leaves over; rings: the best "
    "fit to the specimen’s own displacement; dotted: Eq. (mode) of the paper; crosses: the "
    "infinite lattice, whose wave vectors and phases are those of Eq. (mode) by symmetry. Bars "
    "that leave a picture are in the tables."
)


def _patterns(rows: pd.DataFrame, folder: Path, name: str, title: str) -> Plot:
    shown = {}
    for _, row in rows.iterrows():
        is_size = row["varied"] in ("base", "d/l")
        text = f"d/l = {row['ratio']:.3g}" if is_size else f"{row['varied']} {row['level']}"
        shown[text] = plots.Patterns.read(folder_of(folder, row["specimen"]))
    return plots.draw_patterns(shown, name, title)
