"""Curves: load path, eigenvalues, spectral densities, convergence, onset of the pattern."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from modeharvest.idic.result import Result
from modeharvest.idic.spectra.pattern import WavePattern
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.idic.uncertainty.identifiability import OBSERVABLE
from modeharvest.report.figures.maps import WIDTH, ColourScale, colour_bar
from modeharvest.report.figures.style import (
    BLUE,
    COLOURS,
    DENSITY,
    GOLD,
    GREEN,
    INK,
    MUTED,
    RED,
    figure,
)
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.onset import Buckling, ImageAmplitude

CURVE, SMALL, WIDE = (5.2, 3.3), (4.6, 2.7), (9.6, 3.0)
"""Sizes of pictures of curves [in]."""
DASHES = (0, (3, 2))
EIGENVALUES = 4  # curves of them
_LOAD, _LOWEST = "reaction_N_per_mm", "lowest_eigenvalues_N_per_mm4"
_LEVELS = (GOLD, GREEN, RED, BLUE)


def draw_load(path: Mapping[str, Any], critical: float | None) -> Figure:
    """Draw compressive force over nominal strain, unstable states dashed.

    Parameters
    ----------
    path
        ``Solution.info["path"]``: for each branch, lists over its states.
    critical
        Critical strain [-], None if there is none.
    """
    drawn, axes = curve("nominal strain [%]", "force per thickness [N/mm]")
    primary = path.get("primary", {})
    strain, load = _path_column(primary, "nominal_strain"), _path_column(primary, _LOAD)
    branching = np.nan
    if strain.size:
        stable = _stable_end(primary, critical)
        if critical is not None:
            branching = float(np.interp(critical, strain, load))
            at = int(np.searchsorted(strain, critical))
            strain, load = np.insert(strain, at, critical), np.insert(load, at, branching)
        below, above = strain <= stable, strain >= stable
        axes.plot(100 * strain[below], load[below], color=BLUE, marker="o", ms=3)
        if above.sum() > 1:
            axes.plot(100 * strain[above], load[above], color=BLUE, ls=DASHES, marker="o",
                      ms=3, mfc="none")  # fmt: skip
            annotate(axes, 100 * strain[-1], load[-1], "primary, unstable", BLUE, (-4, 6), "right")
    buckled = [name for name in path if name != "primary"]
    for n, name in enumerate(buckled):
        _draw_branch(axes, name, path[name], critical, branching, below=32 + 11 * n)
    if critical is not None and np.isfinite(branching):
        axes.plot([100 * critical], [branching], "o", ms=8, mfc="none", mec=INK, mew=1.2)
        annotate(axes, 100 * critical, branching, f"critical, {100 * critical:.3f} %", INK,
             (-9, 3), "right")  # fmt: skip
    axes.set(xlim=(0, None), ylim=(0, None))
    return drawn


def draw_eigenvalues(path: Mapping[str, Any], critical: Mapping[str, Any] | None) -> Figure:
    """Draw the lowest eigenvalues of the tangent stiffness over nominal strain.

    Parameters
    ----------
    path
        ``Solution.info["path"]``.
    critical
        ``Solution.info["critical"]``, with the lowest eigenvalue at the states visited while
        the critical strain was located.
    """
    drawn, axes = curve("nominal strain [%]", "lowest eigenvalues [10⁻³ N/mm⁴]")
    primary = path.get("primary", {})
    strain = _path_column(primary, "nominal_strain")
    ladder = _ladder(primary.get(_LOWEST, []))
    axes.axhline(0.0, color=MUTED, lw=0.7)
    for k in range(1, ladder.shape[1]):
        axes.plot(100 * strain, 1e3 * ladder[:, k], color=BLUE, lw=1, alpha=0.75 - 0.15 * k)
    extra = np.array((critical or {}).get("eigenvalues_N_per_mm4", [])).reshape(-1, 2)
    first = np.concatenate([np.stack([strain, ladder[:, 0]], 1), extra])
    first = np.unique(first[np.isfinite(first).all(axis=1)].round(12), axis=0)
    axes.plot(100 * first[:, 0], 1e3 * first[:, 1], color=BLUE, lw=2, marker="o", ms=3)
    if critical is not None:
        at = 100 * critical["strain"]
        axes.plot([at], [0], "o", ms=8, mfc="none", mec=INK, mew=1.2)
        annotate(axes, at, 0.0, f"critical, {at:.3f} %", INK, (-8, -13), "right")
    for name, branch in path.items():
        if name == "primary":
            continue
        lowest = _ladder(branch.get(_LOWEST, []))[:, 0]
        at_strain = _path_column(branch, "nominal_strain")
        axes.plot(100 * at_strain, 1e3 * lowest, "s-", color=RED, ms=4.5)
    if first.size:
        axes.set(xlim=(0, None))
    return drawn


def pattern_density(spectrum: Spectrum, pattern: WavePattern) -> float:
    """The larger of S_xx and S_yy at the pattern's wave vectors [mm⁶]; 0 without a pattern."""
    peaks = [np.abs(spectrum.at(wave.xi)) ** 2 for wave in pattern.waves]
    return float(np.max(peaks, initial=0.0))


def draw_density(spectrum: Spectrum, pattern: WavePattern, component: int, end: float) -> Figure:
    """Draw S_xx (component 0) or S_yy (1) with the pattern's wave vectors ringed.

    The colours end at ``end`` [mm⁶]; meant is the pattern's own density, so that it is seen
    beside the lines that the specimen's edges leave on the axes. If 0, the largest peak's.
    """
    drawn = figure(WIDTH, WIDTH * 0.84)
    axes = drawn.add_axes((0.17, 0.165, 0.59, 0.70))
    xi1, xi2, *both = spectrum.window(1.0)
    if not end > 0 and pattern.largest is not None:
        end = pattern.largest.density
    scale = ColourScale(DENSITY, 0.0, end if end > 0 else 1.0, "mm⁶", "max")
    step = (xi1[1] - xi1[0], xi2[1] - xi2[0])
    extent = (xi1[0] - step[0] / 2, xi1[-1] + step[0] / 2, xi2[0] - step[1] / 2,
              xi2[-1] + step[1] / 2)  # fmt: skip
    axes.imshow(both[component], extent=extent, origin="lower", cmap=scale.colours,
                norm=scale.normalise, interpolation="bilinear", aspect="auto",
                rasterized=True)  # fmt: skip
    for xi, how in _ringed(pattern):
        for sign in (1, -1):
            axes.plot([sign * xi[0]], [sign * xi[1]], "o", ms=11, mfc="none", mec="#7fd4ff",
                      mew=1.1, ls="none", alpha=how)  # fmt: skip
    ticks = [-1.0, -0.5, 0.0, 0.5, 1.0]
    axes.set(xlim=(-1, 1), ylim=(-1, 1), xticks=ticks, yticks=ticks, xlabel="ξ₁ [1/l]")
    axes.tick_params(labelsize=7)
    axes.set_ylabel("ξ₂ [1/l]", labelpad=0)
    colour_bar(drawn, axes, scale)
    return drawn


def draw_convergence(result: Result) -> Figure:
    """Draw the size of each Gauss-Newton step; each level of the pyramid in its colour."""
    drawn, axes = curve("iteration", "step, rms [px]")
    levels: list[list[tuple[int, float]]] = []
    factors: list[int] = []
    for k, step in enumerate(result.history, start=1):
        if step.number == 1 or not levels:
            levels.append([])
            factors.append(step.factor)
        levels[-1].append((k, step.step_px if step.step_px > 0 else np.nan))
    for n, (factor, level) in enumerate(zip(factors, levels, strict=True)):
        colour = _LEVELS[(n - len(levels)) % len(_LEVELS)]
        k, size = np.array(level, dtype=float).T
        axes.plot(k, size, "o-", color=colour, ms=3.5)
        name = "full image" if factor == 1 else f"1/{factor}"
        axes.axvspan(k[0] - 0.5, k[-1] + 0.5, color=colour, alpha=0.08, lw=0)
        axes.annotate(name, (k.mean(), 1.0), (0, 3), xycoords=("data", "axes fraction"),
                      textcoords="offset points", ha="center", fontsize=7, color=colour,
                      annotation_clip=False)  # fmt: skip
    if any(np.isfinite([s for level in levels for _, s in level])):
        axes.set_yscale("log")
    axes.set_xlim(0.5, max(1, len(result.history)) + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return drawn


def curve(
    x: str, y: str, size: tuple[float, float] = CURVE, *, below: float = 0.46
) -> tuple[Figure, Axes]:
    """An empty picture of a size [in] for curves, with these labels and room below [in]."""
    width, height = size
    drawn = figure(width, height)
    box = (0.57 / width, below / height, 1.0 - 0.67 / width, 1.0 - (below + 0.2) / height)
    axes = drawn.add_axes(box)
    axes.set(xlabel=x, ylabel=y)
    axes.grid(color=MUTED, alpha=0.18, lw=0.6)
    axes.set_axisbelow(True)
    return drawn, axes


def legend_above(axes: Axes, columns: int = 4) -> None:
    """Names above the picture, where no curve is."""
    if axes.get_legend_handles_labels()[0]:
        made = axes.legend(frameon=False, fontsize=7.5, loc="lower left", bbox_to_anchor=(0.0, 1.0),
                           ncols=columns, handlelength=1.6, columnspacing=1.2,
                           borderaxespad=0.1)  # fmt: skip
        for text in made.get_texts():
            text.set_parse_math(False)  # names may hold dollars


def plain_ticks(*axes: Axis) -> None:
    """Write 20 rather than 2 x 10^1 on logarithmic axes."""
    for axis in axes:
        axis.set_major_formatter(_PLAIN)
        axis.set_minor_formatter(_PLAIN)
        axis.set_tick_params(which="minor", labelsize=7, labelcolor=INK)


_PLAIN = FuncFormatter(lambda v, _: f"{v:g}" if f"{v:e}"[0] in "1235" else "")


def _draw_branch(
    axes: Axes,
    name: str,
    branch: Mapping[str, Any],
    critical: float | None,
    branching: float,
    below: float,
) -> None:
    """A buckled branch, from the critical point on; its name this far below its end [pt]."""
    strain, load = _path_column(branch, "nominal_strain"), _path_column(branch, _LOAD)
    if not strain.size:
        return
    axes.plot(100 * strain, load, "s", color=RED, ms=4.5)
    if critical is not None:
        strain, load = np.insert(strain, 0, critical), np.insert(load, 0, branching)
    axes.plot(100 * strain, load, color=RED, lw=1.8)
    is_stable = not _path_column(branch, "negative_pivots").any()
    sign = name.replace("+", " (+)").replace("-", " (−)")
    words = f"{sign}, {'stable' if is_stable else 'unstable'}"
    annotate(axes, 100 * strain[-1], load[-1], words, RED, (4, -below), "right")


def annotate(axes: Axes, x: float, y: float, text: str, colour: str, shift: tuple[float, float],
        side: str) -> None:  # fmt: skip
    """Write beside a point: shifted [pt], its ``side`` there."""
    axes.annotate(text, (x, y), shift, textcoords="offset points", ha=side, color=colour,
                  fontsize=7.5)  # fmt: skip


def _path_column(branch: Mapping[str, Any], name: str) -> FloatArray:
    return np.array(branch.get(name, []), dtype=np.float64)


def _stable_end(primary: Mapping[str, Any], critical: float | None) -> float:
    """The strain where the solid line ends."""
    if critical is not None:
        return critical
    strain, pivots = (
        _path_column(primary, "nominal_strain"),
        _path_column(primary, "negative_pivots"),
    )
    return float(np.max(strain[pivots == 0], initial=0.0))


def _ladder(lists: Sequence[Sequence[float]]) -> FloatArray:
    """(states, EIGENVALUES) with NaN where fewer were computed."""
    ladder = np.full((len(lists), EIGENVALUES), np.nan)
    for row, values in zip(ladder, lists, strict=True):
        n = min(EIGENVALUES, len(values))
        row[:n] = values[:n]
    return ladder


def _ringed(pattern: WavePattern) -> list[tuple[tuple[float, float], float]]:
    """Wave vectors [1/l] and the opacity of their rings: faint where no pattern was found."""
    if pattern.waves:
        return [(wave.xi, 1.0) for wave in pattern.waves]
    return [] if pattern.largest is None else [(pattern.largest.xi, 0.45)]


def draw_onset(moments: Sequence[ImageAmplitude], buckling: Buckling | None) -> Figure:
    """Draw the pattern's amplitude over the strain, above what it has to stand out of.

    Parameters
    ----------
    moments
        In the order of the test, with at least one.
    buckling
        When the pattern appeared.
    """
    strain = 100 * np.array([m.strain for m in moments])
    size, left, noise = np.array(
        [(m.amplitude_px, m.model_error_px, m.noise_px) for m in moments]
    ).T
    has = np.array([m.has_pattern for m in moments])
    drawn, axes = curve("nominal strain [%]", "pattern v₁φ₁, rms [px]")
    order = np.argsort(strain)
    _band(axes, strain[order], OBSERVABLE * left[order], GOLD, f"{OBSERVABLE:g} × model error")
    _band(axes, strain[order], OBSERVABLE * noise[order], GREEN, f"{OBSERVABLE:g} × noise")
    top = 1.1 * float(np.nanmax(np.concatenate([size, OBSERVABLE * left, [1e-9]])))
    if buckling is not None:
        _mark_onset(axes, buckling, strain, size, top)
    axes.plot(strain, size, color=BLUE, lw=1.2, alpha=0.7)
    axes.errorbar(strain, size, 2 * noise, fmt="none", ecolor=BLUE, elinewidth=1)
    for filled, name in ((True, "pattern"), (False, "not observable")):
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
        the larger of noise and model error.
    """
    drawn, axes = curve("nominal strain [%]", "components of the wave vectors, |ξ| [1/l]")
    for number, (label, points) in enumerate(_components(frames).items()):
        strain, value, sd, free = np.array(points, dtype=np.float64).T
        colour, marker = COLOURS[number // 2 % len(COLOURS)], "o^"[number % 2]
        axes.errorbar(strain, value, 2 * np.nan_to_num(sd), fmt="none", ecolor=colour,
                      elinewidth=1)  # fmt: skip
        axes.plot(strain, value, color=colour, lw=1, alpha=0.6)
        for is_fixed in (False, True):
            chosen = (free == 0) == is_fixed
            axes.plot(
                strain[chosen],
                value[chosen],
                marker,
                color=colour,
                ms=4.5,
                ls="none",
                mfc="none" if is_fixed else colour,
                label=None if is_fixed else label,
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
                        max(_known_or_zero(wave[sd], c) for sd in ("sd_noise", "sd_model_error")),
                        float(not mode["fixed"] and mode["observable"]),
                    ))  # fmt: skip
    return found


def _known_or_zero(values: Sequence[float | None] | None, k: int) -> float:
    value = None if values is None else values[k]
    return 0.0 if value is None else value


def _band(axes: Axes, strain: FloatArray, top: FloatArray, colour: str, name: str) -> None:
    """What lies below ``top``, carried on beyond the first and the last photograph."""
    ends = [min(0.0, strain[0]), 2.0 * strain[-1] - min(0.0, strain[0]) + 1.0]
    strain = np.concatenate([ends[:1], strain, ends[1:]])
    top = np.concatenate([top[:1], top, top[-1:]])
    axes.fill_between(strain, 0, top, color=colour, alpha=0.18, lw=0, label=name)
    axes.plot(strain, top, color=colour, lw=0.8)


def _mark_onset(axes: Axes, buckling: Buckling, strain: FloatArray, size: FloatArray, top: float
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
            axes.plot(beyond, grown, color=MUTED, lw=0.9, ls=DASHES)
        axes.plot([at], [0], "o", ms=8, mfc="none", mec=INK, mew=1.2, clip_on=False)
        annotate(axes, at, 0.0, f"{at:.2f} %", INK, (9, 5), "left")
