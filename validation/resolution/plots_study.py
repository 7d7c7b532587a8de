"""Pictures of a resolution study: transfer by degree, noise against resolution, the pass band."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.ticker import FuncFormatter

from modeharvest.validation.resolution.curves import AXES, Curves, Passband
from modeharvest.validation.resolution.degrees import Degree
from modeharvest.validation.resolution.measure import Subject
from modeharvest.validation.resolution.transfer import KEPT
from modeharvest.validation.studies.study import Plot
from modeharvest.validation.style import BLUE, GREEN, INK, MUTED, RED, figure, style

_DEGREES: Colormap = mpl.colormaps["viridis"]


def draw_transfer(part: str, curves: Curves, waves: pd.DataFrame, subject: Subject) -> Plot:
    """Draw T over the period for waves of a part along both axes, degrees in colours."""
    pitch = subject.buckled.specimen.pitch
    degrees = sorted({key[2] for key in curves.own})
    with style():
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
            _plain(axes)
        both[0].set_ylabel("share that is found [–]")
        both[1].legend(frameon=False, fontsize=7.5, title="degree", title_fontsize=7.5,
                       loc="lower right")  # fmt: skip
        drawn.tight_layout()
    caption = (
        f"Waves of {part}, over both phases. Lines: best fits of the ansatz to the displacement; "
        "dots: correlated images. Dotted: 10 % are lost."
    )
    if part == "v1":
        caption += (
            " At one cell half of the wave is the pattern again: cos(πx/l) cos(2πx/l) holds "
            "cos(πx/l) / 2."
        )
    return Plot(f"transfer-{part}", f"What is found of a wave of {part}", drawn, caption, wide=True)


def draw_indicators(degrees: Sequence[Degree], local: float, made: str) -> Plot:
    """Draw noise floors over l10 for all degrees, and the line of an affine subset."""
    with style():
        drawn = figure(4.6, 3.3)
        axes = drawn.add_subplot()
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
        axes.set(xscale="log", yscale="log", xlabel="l₁₀ % [px]", ylabel="noise floor n [10⁻³ px]")
        axes.grid(color=MUTED, alpha=0.18, lw=0.6)
        axes.legend(frameon=False, fontsize=7.5)
        _plain(axes)
        axes.yaxis.set_major_formatter(_FORMAT)
        axes.yaxis.set_minor_formatter(_FORMAT)
        drawn.tight_layout()
    caption = (
        f"Numbers: the degree. l₁₀ %: mean of both axes; n: by the covariance; {made}. Along the "
        "dashed line, and any parallel to it, the indicator n l₁₀ % is the same."
    )
    return Plot("indicators", "Noise against resolution", drawn, caption)


def draw_passband(passband: Passband, degree: int) -> Plot:
    """Draw what is found of patterns of other wavelengths, beside the mode and instead of it."""
    with style():
        drawn = figure(4.6, 3.3)
        axes = drawn.add_subplot()
        axes.axhline(KEPT, color=MUTED, linestyle=":", linewidth=1)
        axes.plot(passband.stretch, passband.added, color=BLUE, label="a small one beside it")
        known = np.isfinite(passband.itself)
        axes.plot(passband.stretch[known], passband.itself[known], "o", ms=3.5, color=RED,
                  label="the pattern itself")  # fmt: skip
        axes.set(xlabel="wave numbers over the mode's [–]", ylabel="share that is found [–]",
                 ylim=(-0.03, 1.18))  # fmt: skip
        axes.grid(color=MUTED, alpha=0.18, lw=0.6)
        axes.legend(frameon=False, fontsize=7.5, loc="upper center", ncols=2)
        drawn.tight_layout()
    caption = (
        f"Degree {degree}; best fits. Line: a small pattern with other wave numbers than the "
        "mode's, added to it: v0 takes the longest, v1 those next to the mode, between them "
        "nothing passes. Dots: the pattern itself has them, and the fit starts from the mode: "
        "its wave numbers are unknowns and follow, until the fit ends elsewhere."
    )
    return Plot("passband", "Patterns of other wavelengths", drawn, caption)


_FORMAT = FuncFormatter(lambda v, _: f"{v:g}" if f"{v:e}"[0] in "1235" else "")


def _plain(axes: Axes) -> None:
    """Write 20 rather than 2 x 10^1."""
    axes.xaxis.set_major_formatter(_FORMAT)
    axes.xaxis.set_minor_formatter(_FORMAT)
    axes.tick_params(axis="both", which="minor", labelsize=7, labelcolor=INK)


def _colour(degree: int, degrees: Sequence[int]) -> tuple[float, ...]:
    """From dark to bright with the degree."""
    low, high = min(degrees), max(degrees)
    return _DEGREES(0.9 * (degree - low) / max(1, high - low))
