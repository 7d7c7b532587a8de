"""Pictures of a noise study: curves over the level, the unknowns, maps."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from modeharvest.validation.studies.noise.fields import PARTS, Points
from modeharvest.validation.studies.noise.statistics import Pairs, Share
from modeharvest.validation.studies.study import Plot
from modeharvest.validation.style import (
    BLUE,
    EDGE,
    GOLD,
    GREEN,
    MUTED,
    RED,
    SIGNED,
    SIZE,
    figure,
    style,
)

FloatArray = NDArray[np.float64]

LABELS = {"u": "u", "v0": "v₀", "v1": "v₁", "v1 phi1": "v₁φ₁"}
SERIES: dict[str, dict[str, Any]] = {
    "u": {"color": BLUE, "marker": "o"},
    "v0": {"color": GREEN, "marker": "s"},
    "v1": {"color": GOLD, "marker": "^"},
    "v1 phi1": {"color": RED, "marker": "D"},
}
_FAMILIES = {"v0x": "v₀ along x", "v0y": "v₀ along y", "v1": "v₁", "phi1": "φ₁"}
_NOTHING = to_rgba(EDGE, 0.25)
_HOLD = "share in 95 % intervals [-]"
_LEVELS = {
    "ratio": ("Scatter", "rms error / least of least squares [-]", 1.0),
    "bias": ("Bias", "bias / Cramér–Rao bound [-]", 0.0),
    "coverage": ("Error bars", _HOLD, 0.95),
}


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
        "least squares can do for u."
    )
    return Plot("causes", "What each cause adds", drawn, caption, wide=True)


def _wrapped(words: str) -> str:
    """On lines of a few words."""
    return textwrap.fill(words, 15)


def draw_levels(levels: Mapping[float, Mapping[str, Pairs]], what: str, made: str) -> Plot:
    """Draw one of "ratio", "bias" and "coverage" of the fields over the level of noise."""
    at = np.array(sorted(levels))
    title, label, target = _LEVELS[what]
    with style():
        drawn = figure(4.6, 2.7)
        axes = drawn.add_subplot()
        axes.axhline(target, color=MUTED, linestyle=":", linewidth=1)
        for n, name in enumerate(PARTS):
            shares: list[Share] = [getattr(levels[level][name], what) for level in at]
            value, error = np.array([(s.value, s.error) for s in shares]).T
            beside = 1.0 + 0.02 * (n - 1.5)
            axes.errorbar(100.0 * at * beside, value, error, markersize=4, capsize=2,
                          linewidth=1, label=LABELS[name], **SERIES[name])  # fmt: skip
        _over_noise(axes, at, label)
        drawn.tight_layout()
    return Plot(what, title, drawn, f"Fields, over all points; {made}. Bars: one "
                "standard error.")  # fmt: skip


def draw_bars(kinds: Mapping[str, Mapping[float, Mapping[str, Pairs]]], made: str) -> Plot:
    """Draw how many unknowns are in intervals that know of more and less."""
    looks = zip(kinds.items(), SERIES.values(), strict=False)
    with style():
        drawn = figure(4.6, 2.7)
        axes = drawn.add_subplot()
        axes.axhline(0.95, color=MUTED, linestyle=":", linewidth=1)
        for (label, levels), look in looks:
            at = np.array(sorted(levels))
            shares = [levels[level]["unknowns"].standardised.coverage for level in at]
            value, error = np.array([(s.value, s.error) for s in shares]).T
            axes.errorbar(100.0 * at, value, error, markersize=4, capsize=2, linewidth=1,
                          label=label, **look)  # fmt: skip
        _over_noise(axes, at, _HOLD)
        drawn.tight_layout()
    caption = (
        f"All unknowns; {made}. Blue dots: bars that know of curvature, det F and the noise’s "
        "gradient in w; green squares: of the curvature only; golden triangles: of neither. Bars: "
        "one standard error."
    )
    return Plot("bars", "What error bars must know", drawn, caption)


def _over_noise(axes: Axes, at: FloatArray, label: str) -> None:
    """Finish axes of something over the levels of noise."""
    axes.set(xscale="log", xlabel="noise [% of full scale]", ylabel=label)
    axes.set_xticks(100.0 * at, [f"{100 * level:g}" for level in at])
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=7.5)


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
    """Draw maps of the fields' scatter, of its ratio to the least and of their coverage."""
    grid = points.scene.images.grid
    x, y = grid.x[points.cols], grid.y[points.rows]
    extent = (float(x[0]), float(x[-1]), float(y[-1]), float(y[0]))
    with style():
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
                 "rms error / least [-]"),
                (pairs.covered.mean(axis=-1), SIGNED, (0.88, 1.02), "intervals that hold [-]"),
            )  # fmt: skip
            boxes[0, column].set_title(LABELS[name], fontsize=9)
            for row, (values, colours, limits, label) in enumerate(rows):
                axes = boxes[row, column]
                shown = axes.imshow(
                    points.map(values),
                    extent=extent,
                    cmap=colours,
                    vmin=limits[0],
                    vmax=limits[1],
                    interpolation="nearest",
                )
                axes.set_axis_off()
                shown.set_cmap(colours.with_extremes(bad=_NOTHING))
                if row == 0 or column == len(PARTS) - 1:
                    _bar(drawn, shown, axes, label)
        drawn.subplots_adjust(left=0.01, right=0.91, top=0.96, bottom=0.01)
    caption = (
        f"At {100 * level:g} % of noise; {made}. Above: rms length of the error; in the middle: "
        "over the least that least squares can do, 1 is white; below: share of the 95 % "
        "intervals that hold, 0.95 is white. Both components of a vector together. Grey: no "
        "material there, or no φ₁."
    )
    return Plot("maps", "Maps over the material", drawn, caption, wide=True)


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
