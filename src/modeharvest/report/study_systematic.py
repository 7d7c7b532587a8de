"""Report of systematic errors: which factor matters, and how much."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from modeharvest.report.figures.style import BLUE, GOLD, GREEN, MUTED, figure, style
from modeharvest.report.model import Findings, KeyNumber, Plot, short
from modeharvest.validation.studies.study import VirtualImagePair
from modeharvest.validation.studies.systematic import (
    ERRORS,
    FACTORS,
    MOVED,
    StudySetting,
    SystematicStudy,
    by_factor,
    by_level,
    not_all_converged,
)

"""The errors by their names in the table; the first is what the measurement adds."""

_CURVES: dict[str, dict[str, Any]] = {
    ERRORS["lost_px"]: {"color": BLUE, "marker": "o"},
    ERRORS["best_px"]: {"color": GREEN, "marker": "s"},
    MOVED: {"color": GOLD, "marker": "^"},
}
_COLUMNS = 3


def report_systematic(study: SystematicStudy, table: pd.DataFrame, folder: Path) -> Findings:
    """Errors against each factor, as curves and tables."""
    scene = VirtualImagePair.open(folder, table["subject"].iloc[0])
    base = StudySetting(scene.images.spec, scene.how, scene.taper)
    bases = {name: FACTORS[name].base(base) for name in study.factors}
    return systematic_findings(table, bases, base.imaging.pixel_size, study.seeds)


def systematic_findings(
    table: pd.DataFrame, bases: Mapping[str, float | None], px: float, seeds: str
) -> Findings:
    """Read the table of all levels.

    Parameters
    ----------
    table
        A row for each case of :func:`modeharvest.validation.studies.systematic.one_level`.
    bases
        The level of each factor that the base has; None where it has none.
    px
        The base's pixel [mm].
    seeds
        In words.
    """
    levels = by_level(table, bases, px)
    spans = by_factor(levels)
    base = table[(table["factor"] == "base") & (table["error"] == "")]
    return Findings(
        numbers={
            "base": {name: float(base[name].mean()) for name in ERRORS},
            "factors": spans.to_dict("records"),
        },
        sentences=_sentences(levels, spans, base),
        keys=_keys(spans, base),
        plots=(_curves(levels, bases, seeds),),
        tables={"Which factor matters": spans, "Every level": levels.drop(columns="number")},
    )


def _keys(spans: pd.DataFrame, base: pd.DataFrame) -> tuple[KeyNumber, ...]:
    first = spans.iloc[0]
    return (
        KeyNumber("IDIC − best fit", short(float(base["lost_px"].mean())), "px",
                  "at the base, rms per component: what the measurement adds"),
        KeyNumber("truth − best fit", short(float(base["best_px"].mean())), "px",
                  "at the base: what the ansatz can’t describe"),
        KeyNumber("matters most", str(first["factor"]).split(" [")[0], "",
                  f"moves the measurement by up to {first[f'largest, {MOVED}']:.2g} px"),
    )  # fmt: skip


_FAR, _NEAR = 0.1, 0.01
"""Factors that move the measurement by more, or by less, are told apart [px]."""


def _sentences(levels: pd.DataFrame, spans: pd.DataFrame, base: pd.DataFrame) -> tuple[str, ...]:
    said = [
        f"At the base the measurement is {short(float(base['lost_px'].mean()))} px rms per "
        f"component from the best fit of its ansatz, which is "
        f"{short(float(base['best_px'].mean()))} px from the truth; v₁ is "
        f"{short(float(base['v1_percent'].mean()))} % off the best fit's."
    ]
    far = spans[f"largest, {MOVED}"]
    for words, part in (
        (f"These move the measurement by more than {_FAR:g} px", spans[far > _FAR]),
        (f"These by {_NEAR:g} to {_FAR:g} px", spans[(far >= _NEAR) & (far <= _FAR)]),
        (f"These by less than {_NEAR:g} px", spans[far < _NEAR]),
    ):
        if len(part):
            told = ", ".join(
                f"{row['factor'].split(' [')[0]} ({short(float(f'{moved:.2g}'))} px)"
                for moved, (_, row) in zip(far[part.index], part.iterrows(), strict=True)
            )
            said.append(f"{words}: {told}.")
    lost_ones = levels[levels["converged"].map(not_all_converged)]
    if len(lost_ones):
        told = ", ".join(f"{r['name']} = {short(r['level'])}" for _, r in lost_ones.iterrows())
        said.append(f"Not every correlation converged at {told}: left out above.")
    said.append(
        "What the ansatz can't describe makes most of the error here, and hides smaller ones: how "
        "far a factor moves the measurement is told beside, rms per component at the junctions "
        "between holes. All are in pixels of the base."
    )
    return tuple(said)


def _curves(levels: pd.DataFrame, bases: Mapping[str, float | None], seeds: str) -> Plot:
    """Draw small curves, one for each factor, on a common scale."""
    rows = -(-len(bases) // _COLUMNS)
    with style():
        drawn = figure(9.6, 2.3 * rows)
        grid = drawn.subplots(rows, _COLUMNS, squeeze=False, sharey=True).ravel()
        for axes in grid[len(bases) :]:
            axes.set_visible(False)
        for axes, (name, at_base) in zip(grid, bases.items(), strict=False):
            part = levels[levels["name"] == name]
            for column, look in _CURVES.items():
                seen = part[part[column] > 0.0]  # the base is not moved from itself
                axes.plot(seen["number"], seen[column], linewidth=1, markersize=4, label=column,
                          **look)  # fmt: skip
            _finish_axes(axes, part, at_base)
        for axes in grid[::_COLUMNS]:
            axes.set_ylabel("rms [px of the base]")
        drawn.legend(*grid[0].get_legend_handles_labels(), frameon=False, ncols=3, loc="upper left")
        drawn.tight_layout(rect=(0.0, 0.0, 1.0, 1.0 - 0.3 / drawn.get_figheight()))
    caption = (
        f"Rms per component, in pixels of the base; means over {seeds}. Blue dots: what the "
        "measurement adds to the best fit of its ansatz; green squares: what the ansatz can’t "
        "describe; golden triangles: how far the measurement is from the base’s. Dotted: the base."
    )
    return Plot("factors", "Error against each factor", drawn, caption, wide=True)


def _finish_axes(axes: Axes, part: pd.DataFrame, at_base: float | None) -> None:
    factor, name = FACTORS[part["name"].iloc[0]], part["name"].iloc[0]
    levels = part["number"].to_numpy(dtype=np.float64)
    is_geometric = levels.min() > 0 and levels.max() / levels.min() >= 4 and not factor.whole
    axes.set(xlabel=factor.label, yscale="log", xscale="log" if is_geometric else "linear")
    if at_base is not None:
        axes.axvline(at_base, color=MUTED, linestyle=":", linewidth=1)
    ticks = [factor.told(level) for level in levels]
    if name == "pixel_size":
        axes.set_xlabel("pixel [mm], below: pixels per ligament")
        ticks = [f"{t}\n{p:.3g}" for t, p in zip(ticks, part["pixels per ligament"], strict=True)]
    axes.set_xticks(levels, ticks)
    axes.xaxis.set_minor_locator(NullLocator())
