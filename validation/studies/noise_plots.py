"""Pictures of a noise study: curves over the level, the unknowns, maps."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from modeharvest.validation.studies.noise_fields import PARTS, Points
from modeharvest.validation.studies.noise_statistics import Pairs, Share
from modeharvest.validation.studies.study import Plot
from modeharvest.validation.style import BLUE, GOLD, GREEN, MUTED, RED, SIGNED, figure, style

FloatArray = NDArray[np.float64]

LABELS = {"u": "u", "v0": "v₀", "v1": "v₁", "v1 phi1": "v₁φ₁"}
SERIES: dict[str, dict[str, Any]] = {
    "u": {"color": BLUE, "marker": "o"},
    "v0": {"color": GREEN, "marker": "s"},
    "v1": {"color": GOLD, "marker": "^"},
    "v1 phi1": {"color": RED, "marker": "D"},
}
_TARGETS = {"ratio": 1.0, "bias": 0.0, "coverage": 0.95}


def draw_causes(causes: pd.DataFrame, made: str) -> Plot:
    """Draw rms over bound: what one cause after another predicts, and what is measured."""
    place = np.arange(len(causes))
    predicted = causes["what"].str.startswith("measured").argmax()
    with style():
        drawn = figure(9.6, 3.0)
        axes = drawn.add_subplot()
        axes.axvspan(predicted - 0.5, place[-1] + 0.5, color=MUTED, alpha=0.08, linewidth=0)
        for n, name in enumerate(PARTS):
            axes.plot(place + 0.09 * (n - 1.5), causes[name], linestyle="none", markersize=5,
                      label=LABELS[name], **SERIES[name])  # fmt: skip
        axes.axhline(1.0, color=MUTED, linestyle=":", linewidth=1)
        axes.axhline(causes["u"][predicted - 1], color=BLUE, linestyle=":", linewidth=1)
        axes.set_xticks(place, [_wrapped(what) for what in causes["what"]])
        axes.set(xlim=(-0.5, place[-1] + 0.5), ylabel="rms / bound [-]")
        axes.legend(frameon=False, fontsize=7.5, ncols=4, loc="upper left")
        drawn.tight_layout()
    caption = (
        f"Over the Cramér–Rao bound: to the left what is predicted from exact images, one cause "
        f"after another; shaded, what is measured; {made}. Dotted: the bound, and the least that "
        "this estimator can do for u."
    )
    return Plot("causes", "What each cause adds", drawn, caption, wide=True)


def _wrapped(words: str) -> str:
    """On lines of a few words."""
    return textwrap.fill(words, 15)


def draw_levels(
    levels: Mapping[float, Mapping[str, Pairs]], what: str, label: str, made: str
) -> Plot:
    """Draw one of "ratio", "bias" and "coverage" of the fields over the level of noise."""
    at = np.array(sorted(levels))
    with style():
        drawn = figure(4.6, 2.7)
        axes = drawn.add_subplot()
        axes.axhline(_TARGETS[what], color=MUTED, linestyle=":", linewidth=1)
        for n, name in enumerate(PARTS):
            shares: list[Share] = [getattr(levels[level][name], what) for level in at]
            value, error = np.array([(s.value, s.error) for s in shares]).T
            beside = 1.0 + 0.02 * (n - 1.5)
            axes.errorbar(100.0 * at * beside, value, error, markersize=4, capsize=2,
                          linewidth=1, label=LABELS[name], **SERIES[name])  # fmt: skip
        axes.set(xscale="log", xlabel="noise [% of full scale]", ylabel=label)
        ticks = [f"{100 * level:g}" for level in at]
        axes.set_xticks(100.0 * at, ticks)
        axes.minorticks_off()
        axes.legend(frameon=False, fontsize=7.5)
        drawn.tight_layout()
    return Plot(what, label.capitalize(), drawn, f"Fields, over all points; {made}. Bars: one "
                "standard error.")  # fmt: skip


def draw_unknowns(pairs: Pairs, names: Sequence[str], level: float, made: str) -> Plot:
    """Draw each unknown's rms error and coverage."""
    count = pairs.errors.shape[0] * 2
    place = np.arange(len(names))
    with style():
        drawn = figure(9.6, 3.4)
        above, below = drawn.subplots(2, 1, sharex=True)
        scatter = 1.0 / np.sqrt(2.0 * count)
        above.axhspan(1 - 2 * scatter, 1 + 2 * scatter, color=BLUE, alpha=0.12, linewidth=0)
        above.plot(place, pairs.ratios, ".", color=BLUE)
        above.set_ylabel("rms error / least [-]")
        spread = np.sqrt(0.95 * 0.05 / count)
        below.axhspan(0.95 - 2 * spread, min(1.0, 0.95 + 2 * spread), color=GREEN, alpha=0.15,
                      linewidth=0)  # fmt: skip
        below.plot(place, pairs.covered, ".", color=GREEN)
        below.set_ylabel("intervals that hold [-]")
        _name_families(below, names)
        drawn.tight_layout()
    caption = (
        f"At {100 * level:g} % of noise; {made}. Bands: where 95 % of the points would lie by "
        "chance, the pairs taken for independent realisations."
    )
    return Plot("unknowns", "Each unknown", drawn, caption, wide=True)


def draw_maps(parts: Mapping[str, Pairs], points: Points, level: float, made: str) -> Plot:
    """Draw maps of the fields' ratio to the bound and of their coverage."""
    x, y = points.scene.images.grid.x[points.cols], points.scene.images.grid.y[points.rows]
    extent = (float(x[0]), float(x[-1]), float(y[-1]), float(y[0]))
    with style():
        drawn = figure(9.6, 6.2)
        grid = drawn.subplots(2, len(PARTS))
        for column, name in enumerate(PARTS):
            pairs = parts[name]
            ratio = np.sqrt((pairs.ratios**2).mean(axis=-1))
            hold = pairs.covered.mean(axis=-1)
            rows = ((ratio, (0.6, 1.4), "rms error / least [-]"),
                    (hold, (0.88, 1.02), "intervals that hold [-]"))  # fmt: skip
            for axes, (values, limits, label) in zip(grid[:, column], rows, strict=True):
                image = _map(axes, points.map(values), extent, limits)
                axes.set_title(f"{LABELS[name]}", fontsize=8)
                if column == len(PARTS) - 1:
                    _bar(drawn, image, axes, label)
    caption = (
        f"At {100 * level:g} % of noise; {made}. Above: rms error over the least that this "
        "estimator can do, 1 is white; below: share of the 95 % intervals that hold, "
        "0.95 is white. Both components of a vector together."
    )
    return Plot("maps", "Maps over the material", drawn, caption, wide=True)


def _map(
    axes: Axes, values: FloatArray, extent: tuple[float, float, float, float],
    limits: tuple[float, float],
) -> object:  # fmt: skip
    image = axes.imshow(
        values, extent=extent, cmap=SIGNED, vmin=limits[0], vmax=limits[1], interpolation="nearest"
    )
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    return image


def _bar(drawn: Figure, image: object, axes: Axes, label: str) -> None:
    place = axes.inset_axes((1.06, 0.0, 0.06, 1.0))
    drawn.colorbar(image, cax=place, label=label)  # type: ignore[arg-type]


def _name_families(axes: Axes, names: Sequence[str]) -> None:
    """Mark where the unknowns of v0x, v0y, v1 and phi1 begin."""
    firsts: dict[str, int] = {}
    for k, name in enumerate(names):
        firsts.setdefault(name.split("[")[0].split(".")[0], k)
    axes.set_xticks(list(firsts.values()), list(firsts))
    axes.set_xlim(-1, len(names))
