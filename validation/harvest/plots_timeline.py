"""Curves of a test: how the pattern and its waves change from photograph to photograph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from modeharvest.idic.identifiability import OBSERVABLE
from modeharvest.validation.harvest.timeline import Buckling, Moment
from modeharvest.validation.plots_path import curve, say
from modeharvest.validation.style import BLUE, GOLD, GREEN, INK, MUTED, RED, style

FloatArray = NDArray[np.float64]

_COLOURS = (BLUE, RED, GREEN, GOLD)
_DASHES = (0, (3, 2))


def draw_timeline(moments: Sequence[Moment], buckling: Buckling | None) -> Figure:
    """Draw the pattern's amplitude over the strain, above what it has to stand out of.

    Parameters
    ----------
    moments
        In the order of the test, with at least one.
    buckling
        When the pattern appeared.
    """
    strain = 100 * np.array([m.strain for m in moments])
    size, left, noise = np.array([(m.amplitude_px, m.leftover_px, m.noise_px) for m in moments]).T
    has = np.array([m.has_pattern for m in moments])
    with style():
        drawn, axes = curve("nominal strain [%]", "pattern v₁φ₁, rms [px]")
        order = np.argsort(strain)
        _band(axes, strain[order], OBSERVABLE * left[order], GOLD, f"{OBSERVABLE:g} × leftover")
        _band(axes, strain[order], OBSERVABLE * noise[order], GREEN, f"{OBSERVABLE:g} × noise")
        top = 1.1 * float(np.nanmax(np.concatenate([size, OBSERVABLE * left, [1e-9]])))
        if buckling is not None:
            _mark(axes, buckling, strain, size, top)
        axes.plot(strain, size, color=BLUE, lw=1.2, alpha=0.7)
        axes.errorbar(strain, size, 2 * noise, fmt="none", ecolor=BLUE, elinewidth=1)
        for filled, name in ((True, "pattern"), (False, "none to be seen")):
            if (has == filled).any():
                axes.plot(strain[has == filled], size[has == filled], "o", color=BLUE, ms=5,
                          mfc=BLUE if filled else "none", label=name)  # fmt: skip
        low, high = min(0.0, float(strain.min())), max(0.0, float(strain.max()))
        axes.set(xlim=(low, high + 0.04 * max(high - low, 1e-6)), ylim=(0, top))
        axes.legend(frameon=False, fontsize=7.5, loc="upper left")
    return drawn


def draw_waves(frames: Sequence[dict[str, Any]]) -> Figure:
    """Draw the lengths of the wave vectors' components over the strain.

    Parameters
    ----------
    frames
        Of ``summary.json``, those that have modes; error bars are two standard deviations by
        the larger of noise and leftover.
    """
    with style():
        drawn, axes = curve("nominal strain [%]", "components of the wave vectors, |ξ| [1/l]")
        for number, (label, points) in enumerate(_components(frames).items()):
            strain, value, sd, free = np.array(points, dtype=np.float64).T
            colour, marker = _COLOURS[number // 2 % len(_COLOURS)], "o^"[number % 2]
            axes.errorbar(strain, value, 2 * np.nan_to_num(sd), fmt="none", ecolor=colour,
                          elinewidth=1)  # fmt: skip
            axes.plot(strain, value, color=colour, lw=1, alpha=0.6)
            for held in (False, True):
                chosen = (free == 0) == held
                axes.plot(
                    strain[chosen],
                    value[chosen],
                    marker,
                    color=colour,
                    ms=4.5,
                    ls="none",
                    mfc="none" if held else colour,
                    label=None if held else label,
                )
        axes.yaxis.set_major_locator(MaxNLocator(6))
        axes.margins(y=0.25)
        axes.legend(frameon=False, fontsize=7.5, loc="best", ncols=2)
    return drawn


def _components(frames: Sequence[dict[str, Any]]) -> dict[str, list[tuple[float, ...]]]:
    """For each component of each wave: strain [%], length, standard deviation, 1 if free."""
    found: dict[str, list[tuple[float, ...]]] = {}
    for frame in frames:
        for i, mode in enumerate(frame["modes"], start=1):
            for w, wave in enumerate(mode["waves"], start=1):
                for c, name in enumerate(("ξ₁", "ξ₂")):
                    label = f"{name} of wave {w}" + (f", φ{i}" if len(frame["modes"]) > 1 else "")
                    found.setdefault(label, []).append((
                        100 * frame["strain"], abs(wave["xi"][c]),
                        max(_number(wave[sd], c) for sd in ("sd_noise", "sd_leftover")),
                        float(not mode["held"] and mode["observable"]),
                    ))  # fmt: skip
    return found


def _number(values: Sequence[float | None] | None, k: int) -> float:
    value = None if values is None else values[k]
    return 0.0 if value is None else value


def _band(axes: Axes, strain: FloatArray, top: FloatArray, colour: str, name: str) -> None:
    """What lies below ``top``, carried on beyond the first and the last photograph."""
    ends = [min(0.0, strain[0]), 2.0 * strain[-1] - min(0.0, strain[0]) + 1.0]
    strain = np.concatenate([ends[:1], strain, ends[1:]])
    top = np.concatenate([top[:1], top, top[-1:]])
    axes.fill_between(strain, 0, top, color=colour, alpha=0.18, lw=0, label=name)
    axes.plot(strain, top, color=colour, lw=0.8)


def _mark(axes: Axes, buckling: Buckling, strain: FloatArray, size: FloatArray, top: float
          ) -> None:  # fmt: skip
    """The strains between which the pattern appears, and where its growth points back to."""
    if np.isfinite(buckling.before) and np.isfinite(buckling.after):
        axes.axvspan(100 * buckling.before, 100 * buckling.after, color=RED, alpha=0.08, lw=0)
        middle = 50 * (buckling.before + buckling.after)
        axes.annotate("buckling", (middle, top), (0, -9), textcoords="offset points", ha="center",
                      fontsize=7.5, color=RED)  # fmt: skip
    if np.isfinite(buckling.estimate):
        at, last = 100 * buckling.estimate, int(np.argmax(strain))
        if strain[last] > at:
            beyond = np.linspace(at, strain[last], 60)
            grown = size[last] * np.sqrt((beyond - at) / (strain[last] - at))
            axes.plot(beyond, grown, color=MUTED, lw=0.9, ls=_DASHES)
        axes.plot([at], [0], "o", ms=8, mfc="none", mec=INK, mew=1.2, clip_on=False)
        say(axes, at, 0.0, f"{at:.2f} %", INK, (9, 5), "left")
