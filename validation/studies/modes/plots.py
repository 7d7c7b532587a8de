"""Pictures of a study of measured modes: parameters, overlaps, strains, and the patterns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh, Solution
from modeharvest.idic.result import Result
from modeharvest.validation.outline import Outline
from modeharvest.validation.plots_fields import Scale
from modeharvest.validation.studies.modes.specimen import PARAMETERS
from modeharvest.validation.studies.modes.tables import IDEAL
from modeharvest.validation.studies.study import Plot
from modeharvest.validation.style import (
    BLUE,
    GOLD,
    GREEN,
    INK,
    MUTED,
    RED,
    SIGNED,
    figure,
    style,
)

FloatArray = NDArray[np.float64]

_WAVE_VECTORS = {"a2": BLUE, "a3": GREEN, "a4": GOLD, "a5": RED}
_PHASES = {"a6": BLUE, "a7": RED}
_IDEAL = dict(zip(PARAMETERS, IDEAL, strict=True))
"""Eq. (mode) with a solid junction at the origin; phases in shares of l."""
_FINER = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))  # triangles of a T6
_PATTERN_END, _LEFT_END = 0.15, 0.03  # of the colours, in l
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
    with style():
        drawn = figure(9.6, 3.1 if not len(ticks) else 3.9)
        aspect, waves, phases = drawn.subplots(1, 3)
        apart = 0.012 * np.ptp(at) if len(at) > 1 else 0.1
        for axes, names in ((aspect, {"a1": BLUE}), (waves, _WAVE_VECTORS), (phases, _PHASES)):
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
    bars = 2.0 * done[[f"{name}_sd_leftover" for name in names]]
    end = 100.0 * max(1.2 * float(np.abs(off).max()), 2.5 * float(bars.median().max()))
    axes.set_ylim(-end, end)


def _parameter(axes: Axes, done: pd.DataFrame, at: FloatArray, name: str, colour: str) -> None:
    """Draw one parameter's deviation from the ideal one [%]: dots measured, rings best fit."""
    measured, best = (100.0 * (done[key] - _IDEAL[name]) for key in (name, f"best_{name}"))
    error = 200.0 * done[f"{name}_sd_leftover"]
    label = "measured" if name == "a1" else f"a{'₀₁₂₃₄₅₆₇'[int(name[1])]}"
    axes.errorbar(at, measured, error, color=colour, marker="o", markersize=3, linestyle="none",
                  capsize=1.5, elinewidth=0.8, label=label)  # fmt: skip
    axes.plot(at, best, "o", markersize=5.5, markerfacecolor="none", markeredgecolor=colour,
              markeredgewidth=0.8, label="best fit" if name == "a1" else None)  # fmt: skip


def draw_overlaps(done: pd.DataFrame, seeds: str) -> Plot:
    """Draw overlaps against d/l: with the infinite lattice's mode, and with the specimen's."""
    with style():
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
    caption = (
        "Overlap |∫ u·φ| / (‖u‖ ‖φ‖) over the material, 1 for fields that differ by a factor. "
        "Left: of modes of constant amplitude over all cells; middle: of v₁φ₁ with the truth less "
        "the best fit’s v₀ over the cellular part. Right: where the pattern becomes critical. "
        f"{seeds.capitalize()}."
    )
    return Plot("overlaps", "Overlaps, and when the pattern comes", drawn, caption, wide=True)


_LATTICE = {
    "overlap_lattice": ("measured", {"color": BLUE, "marker": "o", "markersize": 3}),
    "best_overlap_lattice": ("best fit", {"color": GREEN, "marker": "s", "markersize": 3}),
    "lattice_overlap_ideal": ("Eq. (mode), ideal", {"color": INK, "marker": "x", "markersize": 4}),
}
_SPECIMEN = {
    "overlap_truth": ("measured", {"color": BLUE, "marker": "o", "markersize": 3}),
    "best_overlap_truth": ("best fit", {"color": GREEN, "marker": "s", "markersize": 3}),
}


@dataclass(frozen=True, eq=False)
class Patterns:
    """A specimen's fields at the nodes of its mesh.

    Parameters
    ----------
    mesh
        T6 [mm].
    pitch
        l [mm].
    displacement, found
        (n, 2) the truth and the measurement [mm].
    pattern, found_pattern
        (n, 2) the truth less the best fit's v₀, and v₁φ₁ of the measurement [mm].
    """

    mesh: Mesh
    pitch: float
    displacement: FloatArray
    found: FloatArray
    pattern: FloatArray
    found_pattern: FloatArray

    @classmethod
    def read(cls, folder: Path) -> Patterns:
        """Of what :func:`~modeharvest.validation.studies.modes.specimen.one_specimen` left."""
        solution = Solution.read(folder / "solution.h5")
        result, best = (Result.read(folder / f"{name}.json") for name in ("result", "best"))
        (snapshot,) = solution.snapshots
        x, y = solution.mesh.nodes.T[:, :, None]

        def at_nodes(field: Callable[..., FloatArray], fit: Result) -> FloatArray:
            return np.asarray(field(fit.unknowns, x, y)[:, 0])

        true = snapshot.displacement
        ansatz = result.ansatz
        return cls(
            solution.mesh,
            ansatz.modes[0].half_wavelength,
            true,
            at_nodes(ansatz.displacement, result),
            true - at_nodes(best.ansatz.v0, best),
            at_nodes(lambda a, x, y: ansatz.fluctuation(0, a, x, y), result),
        )


def draw_patterns(specimens: Mapping[str, Patterns], name: str, title: str) -> Plot:
    """Draw patterns side by side: the truth, what was measured of it, and what is left.

    Parameters
    ----------
    specimens
        By what to write above each.
    name, title
        Of the picture.
    """
    with style():
        each = min(_WIDEST, _PAGE / len(specimens))
        window = np.max([_window(p) for p in specimens.values()], axis=0)
        tall = each * window[1] / window[0]
        wide = 0.2 + len(specimens) * each + 0.6
        drawn = figure(wide, 3.0 * tall + 0.3)
        grid = drawn.subplots(3, len(specimens), squeeze=False)
        pattern = Scale(SIGNED, -_PATTERN_END, _PATTERN_END, "l", "both")
        left = Scale(SIGNED, -_LEFT_END, _LEFT_END, "l", "both")
        for column, (text, p) in zip(grid.T, specimens.items(), strict=True):
            column[0].set_title(text, fontsize=7.5)
            _show(column[0], p, p.pattern, p.displacement, pattern, window)
            _show(column[1], p, p.found_pattern, p.found, pattern, window)
            _show(column[2], p, p.displacement - p.found, p.displacement, left, window)
        for axes, text in zip(grid[:, 0], _ROWS, strict=True):
            axes.text(-0.02, 0.5, text, transform=axes.transAxes, rotation=90, va="center",
                      ha="right", fontsize=7.5)  # fmt: skip
        top = 1.0 - 0.25 / drawn.get_figheight()
        drawn.subplots_adjust(0.2 / wide, 0.0, 1.0 - 0.6 / wide, top, 0.02, 0.02)
        for row, scale in ((0, pattern), (1, pattern), (2, left)):
            _bar(grid[row, -1], scale)
    caption = (
        "The component across the load, in shares of l, on the specimens as they are deformed. v₀ "
        "is the best fit’s. The colours of what is left are finer."
    )
    return Plot(name, title, drawn, caption, wide=True)


def _window(p: Patterns) -> FloatArray:
    """(2,) width and height that hold a specimen as it is deformed [mm]."""
    return np.asarray(2.02 * np.abs(p.mesh.nodes + p.displacement).max(axis=0))


def _show(
    axes: Axes, p: Patterns, field: FloatArray, moved: FloatArray, scale: Scale, window: FloatArray
) -> None:
    nodes = p.mesh.nodes + moved
    triangles = p.mesh.cells[:, np.array(_FINER)].reshape(-1, 3)
    net = Triangulation(nodes[:, 0], nodes[:, 1], triangles)
    axes.tripcolor(net, field[:, 1] / p.pitch, shading="gouraud", cmap=scale.colours,
                   norm=scale.normalise, rasterized=True)  # fmt: skip
    axes.add_patch(PathPatch(Outline.of(p.mesh).path(moved), fill=False, ec=MUTED, lw=0.3,
                             rasterized=True))  # fmt: skip
    width, height = window
    axes.set(xlim=(-0.5 * width, 0.5 * width), ylim=(-0.5 * height, 0.5 * height), aspect="equal")
    axes.set_axis_off()


def _bar(axes: Axes, scale: Scale) -> None:
    place = axes.inset_axes((1.06, 0.12, 0.05, 0.76))
    ends = [scale.low, 0.0, scale.high]
    axes.figure.colorbar(ScalarMappable(scale.normalise, scale.colours), cax=place, extend="both",
                         ticks=ends)  # fmt: skip
    place.set_yticks(
        ends, [f"{end:+.2g} l".replace("-", "−") if end else "0" for end in ends], fontsize=6.5
    )
