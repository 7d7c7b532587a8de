"""Curves: load path, eigenvalues, spectral densities, convergence, onset of the pattern."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from modeharvest.idic.result import Result
from modeharvest.idic.spectra.pattern import WavePattern
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.idic.uncertainty.identifiability import OBSERVABLE
from modeharvest.report.figures import style
from modeharvest.report.figures.maps import WIDTH, ColourScale, colour_bar
from modeharvest.report.figures.style import BLUE, GOLD, GREEN, INK, MUTED, RED
from modeharvest.report.model.text import ten_to
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.onset import Buckling, ImageAmplitude

CURVE, SMALL, WIDE = (5.2, 3.3), (4.6, 2.7), (9.6, 3.0)
"""Width and height of figures with curves [in]."""
DASHES = (0, (3, 2))
EIGENVALUES = 4  # number of curves
_LOAD, _LOWEST = "reaction_N_per_mm", "lowest_eigenvalues_N_per_mm4"
_LEVELS = (GOLD, GREEN, RED, BLUE)


def draw_load(path: Mapping[str, Any], critical: float | None) -> Figure:
    """Draw compressive force over nominal strain, unstable states dashed.

    ``path``: ``Solution.info["path"]``, for each branch lists over its states. ``critical``:
    critical strain [-], None if there is none.
    """
    drawn, axes = curve("nominal strain [%]", "force per thickness [N/mm]")
    primary = path.get("primary", {})
    strain, load = _path_column(primary, "nominal_strain"), _path_column(primary, _LOAD)
    branching = np.nan
    if strain.size:
        pivots = _path_column(primary, "negative_pivots")
        stable = float(np.max(strain[pivots == 0], initial=0.0)) if critical is None else critical
        if critical is not None:
            branching = float(np.interp(critical, strain, load))
            at = int(np.searchsorted(strain, critical))
            strain, load = np.insert(strain, at, critical), np.insert(load, at, branching)
        below, above = strain <= stable, strain >= stable
        axes.plot(100 * strain[below], load[below], color=BLUE, marker="o", ms=3)
        if above.sum() > 1:
            axes.plot(100 * strain[above], load[above], color=BLUE, ls=DASHES, marker="o", ms=3,
                      mfc="none")  # fmt: skip
            annotate(axes, 100 * strain[-1], load[-1], "primary, unstable", BLUE, (-4, 6), "right")
    buckled = {name: branch for name, branch in path.items() if name != "primary"}
    for n, (name, branch) in enumerate(buckled.items()):
        _draw_branch(axes, name, branch, critical, branching, below=32 + 11 * n)
    if critical is not None and np.isfinite(branching):
        _draw_critical(axes, 100 * critical, branching, (-9, 3))
    axes.set(xlim=(0, None), ylim=(0, None))
    return drawn


def _draw_branch(
    axes: Axes,
    name: str,
    branch: Mapping[str, Any],
    critical: float | None,
    branching: float,
    below: float,
) -> None:
    """Draw a buckled branch from the critical point on, its label ``below`` its end [pt]."""
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


def draw_eigenvalues(path: Mapping[str, Any], critical: Mapping[str, Any] | None) -> Figure:
    """Draw the lowest eigenvalues of the tangent stiffness over nominal strain.

    ``path``: ``Solution.info["path"]``. ``critical``: ``Solution.info["critical"]``, with the
    lowest eigenvalue at the states visited while the critical strain was located.
    """
    drawn, axes = curve("nominal strain [%]", "lowest eigenvalues [10⁻³ N/mm⁴]")
    primary = path.get("primary", {})
    strain, ladder = _path_column(primary, "nominal_strain"), _ladder(primary)
    axes.axhline(0.0, color=MUTED, lw=0.7)
    for k in range(1, EIGENVALUES):
        axes.plot(100 * strain, 1e3 * ladder[:, k], color=BLUE, lw=1, alpha=0.75 - 0.15 * k)
    extra = np.array((critical or {}).get("eigenvalues_N_per_mm4", [])).reshape(-1, 2)
    first = np.concatenate([np.stack([strain, ladder[:, 0]], 1), extra])
    first = np.unique(first[np.isfinite(first).all(axis=1)].round(12), axis=0)
    axes.plot(100 * first[:, 0], 1e3 * first[:, 1], color=BLUE, lw=2, marker="o", ms=3)
    if critical is not None:
        _draw_critical(axes, 100 * critical["strain"], 0.0, (-8, -13))
    for name, branch in path.items():
        if name != "primary":
            axes.plot(100 * _path_column(branch, "nominal_strain"), 1e3 * _ladder(branch)[:, 0],
                      "s-", color=RED, ms=4.5)  # fmt: skip
    if first.size:
        axes.set(xlim=(0, None))
    return drawn


def _draw_critical(axes: Axes, at: float, height: float, shift: tuple[float, float]) -> None:
    """Draw a ring at the critical strain ``at`` [%], and its value beside it."""
    ring(axes, at, height)
    annotate(axes, at, height, f"critical, {at:.3f} %", INK, shift, "right")


def _path_column(branch: Mapping[str, Any], name: str) -> FloatArray:
    return np.array(branch.get(name, []), dtype=np.float64)


def _ladder(branch: Mapping[str, Any]) -> FloatArray:
    """(states, EIGENVALUES) lowest eigenvalues [N/mm⁴], NaN where fewer were computed."""
    lists = branch.get(_LOWEST, [])
    ladder = np.full((len(lists), EIGENVALUES), np.nan)
    for row, values in zip(ladder, lists, strict=True):
        row[: len(values)] = values[:EIGENVALUES]
    return ladder


def pattern_density(spectrum: Spectrum, pattern: WavePattern) -> float:
    """Largest of S_xx and S_yy at the pattern's wave vectors [mm⁶]; 0 without a pattern."""
    peaks = [np.abs(spectrum.at(wave.xi)) ** 2 for wave in pattern.waves]
    return float(np.max(peaks, initial=0.0))


def draw_density(spectrum: Spectrum, pattern: WavePattern, component: int, end: float) -> Figure:
    """Draw S_xx (component 0) or S_yy (1) with the pattern's wave vectors ringed.

    The colours end at ``end`` [mm⁶], usually the pattern's density: larger densities on the axes
    are due to the specimen's edges. If ``end`` is 0, they end at the largest peak off the axes.
    """
    drawn, axes = wave_plane(1.0, 0.5, (0.205, 0.187, 0.565, 0.673), 0.84)
    xi1, xi2, both = spectrum.window(1.0)
    if not end > 0 and pattern.largest is not None:
        end = pattern.largest.density
    scale = ColourScale(style.DENSITY, 0.0, end if end > 0 else 1.0, "mm⁶", "max")
    h1, h2 = 0.5 * (xi1[1] - xi1[0]), 0.5 * (xi2[1] - xi2[0])
    axes.imshow(both[..., component], extent=(xi1[0] - h1, xi1[-1] + h1, xi2[0] - h2, xi2[-1] + h2),
                origin="lower", cmap=scale.colours, norm=scale.normalise, interpolation="bilinear",
                aspect="auto", rasterized=True)  # fmt: skip
    faint = [] if pattern.largest is None else [(pattern.largest.xi, 0.45)]
    for xi, alpha in [(wave.xi, 1.0) for wave in pattern.waves] or faint:
        for sign in (1, -1):
            axes.plot([sign * xi[0]], [sign * xi[1]], "o", ms=11, mfc="none", mec="#7fd4ff",
                      mew=1.1, alpha=alpha)  # fmt: skip
    colour_bar(axes, scale)
    return drawn


def wave_plane(
    half: float, step: float, box: tuple[float, float, float, float], tall: float
) -> tuple[Figure, Axes]:
    """Make empty axes for wave vectors within ± ``half`` [1/l], with a tick at each ``step`` [1/l].

    ``box``: left, bottom, width and height of the axes [-]; ``tall``: the figure's height/width.
    """
    drawn = style.figure(WIDTH, WIDTH * tall)
    axes = drawn.add_axes(box)
    ticks = np.arange(-np.floor(half / step), np.floor(half / step) + 1) * step
    axes.set(xlim=(-half, half), ylim=(-half, half), xticks=ticks, yticks=ticks, xlabel="ξ₁ [1/l]")
    axes.set_ylabel("ξ₂ [1/l]", labelpad=0)
    axes.tick_params(labelsize=7)
    return drawn, axes


def draw_convergence(result: Result) -> Figure:
    """Draw the rms of each Gauss-Newton step [px], with a colour for each level of the pyramid."""
    drawn, axes = curve("iteration", "step, rms [px]")
    history = result.history
    firsts = [k for k, step in enumerate(history) if step.number == 1 or k == 0]
    for n, (first, end) in enumerate(pairwise([*firsts, len(history)])):
        colour = _LEVELS[(n - len(firsts)) % len(_LEVELS)]
        k = np.arange(first + 1, end + 1)
        size = [step.step_px if step.step_px > 0 else np.nan for step in history[first:end]]
        axes.plot(k, size, "o-", color=colour, ms=3.5)
        axes.axvspan(k[0] - 0.5, k[-1] + 0.5, color=colour, alpha=0.08, lw=0)
        at = history[first]
        rows = "every 4th row" if 2 * at.pixels < result.pixels else "full image"
        axes.annotate(rows if at.factor == 1 else f"1/{at.factor}", (k.mean(), 1.0), (0, 3),
                      xycoords=("data", "axes fraction"), textcoords="offset points", ha="center",
                      fontsize=7, color=colour, annotation_clip=False)  # fmt: skip
    if any(step.step_px > 0 for step in history):
        axes.set_yscale("log")
        axes.yaxis.set_minor_locator(NullLocator())  # they take half the drawing time
        plain_ticks(axes.yaxis)
    axes.set_xlim(0.5, max(1, len(history)) + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    return drawn


def curve(
    x: str, y: str, size: tuple[float, float] = CURVE, *, below: float = 0.46, left: float = 0.57
) -> tuple[Figure, Axes]:
    """Make an empty figure of a ``size`` [in] for curves; room ``below`` and ``left`` [in]."""
    width, height = size
    drawn = style.figure(width, height)
    box = (left / width, below / height, 1.0 - (left + 0.1) / width, 1.0 - (below + 0.2) / height)
    axes = drawn.add_axes(box)
    axes.set_xlabel(x)
    axes.set_ylabel(y, labelpad=4)
    axes.grid(color=MUTED, alpha=0.18, lw=0.6)
    axes.set_axisbelow(True)
    return drawn, axes


def legend_above(axes: Axes, columns: int = 4) -> None:
    """Put the legend above the axes, where no curve is."""
    if axes.get_legend_handles_labels()[0]:
        made = axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns,
                           handlelength=1.6, columnspacing=1.2, borderaxespad=0.1)  # fmt: skip
        for text in made.get_texts():
            text.set_parse_math(False)  # names may hold dollars
        further = (len(made.get_texts()) - 1) // columns  # rows of the legend
        (x0, y0), (x1, y1) = axes.get_position().get_points()
        drawn = cast(Figure, axes.figure)
        axes.set_position((x0, y0, x1 - x0, y1 - y0 - 0.13 * further / drawn.get_figheight()))


def plain_ticks(*axes: Axis) -> None:
    """Label logarithmic axes with 20 rather than 2 x 10^1, and powers of ten without mathtext."""
    for axis in axes:
        axis.set_major_formatter(FuncFormatter(_plain))
        axis.set_minor_formatter(FuncFormatter(partial(_plain, axis=axis)))
        axis.set_tick_params(which="minor", labelsize=7, labelcolor=INK)


def _plain(value: float, _: object, axis: Axis | None = None) -> str:
    mantissa, power = f"{value:.0e}".split("e")
    low, high = axis.get_view_interval() if axis else (1.0, 1.0)
    if -3 <= int(power) <= 4:
        return f"{value:g}" if mantissa in ("1235" if high < 500.0 * low else "125") else ""
    return ten_to(int(power)) if mantissa == "1" else ""


def annotate(
    axes: Axes, x: float, y: float, text: str, colour: str, shift: tuple[float, float], side: str
) -> None:
    """Write text beside a point: its ``side`` is at the point shifted by ``shift`` [pt]."""
    axes.annotate(text, (x, y), shift, textcoords="offset points", ha=side, color=colour,
                  fontsize=7.5)  # fmt: skip


def ring(axes: Axes, x: float, y: float) -> None:
    """Mark a critical point by a ring."""
    axes.plot([x], [y], "o", ms=8, mfc="none", mec=INK, mew=1.2, clip_on=False)


def draw_onset(moments: Sequence[ImageAmplitude], buckling: Buckling | None) -> Figure:
    """Draw the pattern's amplitude over strain, and the limits above which it is observable.

    ``moments``: amplitudes in the order of the test, at least one. ``buckling``: onset of the
    pattern, None if unknown.
    """
    drawn, axes = curve("nominal strain [%]", "pattern v₁φ₁, rms [px]")
    strain, size, model, noise = np.array(
        [(100 * m.strain, m.amplitude_px, m.model_error_px, m.noise_px) for m in moments]
    ).T
    order = np.argsort(strain)
    for error, colour, name in ((model, GOLD, "model error"), (noise, GREEN, "noise")):
        label = f"{OBSERVABLE:g} × {name}"
        _band(axes, strain[order], OBSERVABLE * error[order], colour, label)
    top = 1.1 * float(np.nanmax(np.concatenate([size, OBSERVABLE * model, [1e-9]])))
    if buckling is not None:
        _mark_onset(axes, buckling, strain, size, top)
    axes.plot(strain, size, color=BLUE, lw=1.2, alpha=0.7)
    axes.errorbar(strain, size, 2 * noise, fmt="none", ecolor=BLUE, elinewidth=1)
    has = np.array([m.has_pattern for m in moments])
    for filled, name in ((True, "pattern"), (False, "not observable")):
        if (has == filled).any():
            axes.plot(strain[has == filled], size[has == filled], "o", color=BLUE, ms=5,
                      mfc=BLUE if filled else "none", label=name)  # fmt: skip
    low, high = min(0.0, float(strain.min())), max(0.0, float(strain.max()))
    axes.set(xlim=(low, high + 0.04 * max(high - low, 1e-6)), ylim=(0, top))
    axes.legend(loc="upper left")
    return drawn


def draw_waves(frames: Sequence[dict[str, Any]]) -> Figure:
    """Draw the absolute values of the wave vectors' components over the strain.

    ``frames``: those of ``summary.json`` with modes. Error bars: two standard deviations, by noise
    or model error, whichever is larger. Filled markers: free and observable parameters.
    """
    drawn, axes = curve(
        "nominal strain [%]", "components of the wave vectors, |ξ| [1/l]", left=0.78
    )
    for number, (label, points) in enumerate(_components(frames).items()):
        strain, value, sd, free = np.array(points, dtype=np.float64).T
        colour, marker = style.COLOURS[number // 2 % len(style.COLOURS)], "o^"[number % 2]
        axes.errorbar(strain, value, 2 * np.nan_to_num(sd), fmt="none", ecolor=colour,
                      elinewidth=1)  # fmt: skip
        axes.plot(strain, value, color=colour, lw=1, alpha=0.6)
        for is_free in (True, False):
            chosen = (free > 0) == is_free
            axes.plot(strain[chosen], value[chosen], marker, color=colour, ms=4.5, label=label,
                      mfc=colour if is_free else "none")  # fmt: skip
            label = "_"  # once in the legend
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.margins(y=0.25)
    axes.legend(loc="best", ncols=2)
    return drawn


def _components(frames: Sequence[dict[str, Any]]) -> dict[str, list[tuple[float, ...]]]:
    """For each component of each wave: strain [%], |ξ| and sd [1/l], 1 if free and observable."""
    found: dict[str, list[tuple[float, ...]]] = {}
    for frame in frames:
        for i, mode in enumerate(frame["modes"], start=1):
            of = f", φ{i}" if len(frame["modes"]) > 1 else ""
            for w, wave in enumerate(mode["waves"], start=1):
                for c, name in enumerate(("ξ₁", "ξ₂")):
                    sds = [(wave[sd] or [0.0, 0.0])[c] or 0.0
                           for sd in ("sd_noise", "sd_model_error")]  # fmt: skip
                    found.setdefault(f"{name} of wave {w}{of}", []).append((
                        100 * frame["strain"], abs(wave["xi"][c]), max(sds),
                        float(not mode["fixed"] and mode["observable"]),
                    ))  # fmt: skip
    return found


def _band(axes: Axes, strain: FloatArray, top: FloatArray, colour: str, name: str) -> None:
    """Shade the area below ``top``, extended beyond the first and the last photograph."""
    ends = [min(0.0, strain[0]), 2.0 * strain[-1] - min(0.0, strain[0]) + 1.0]
    strain = np.concatenate([ends[:1], strain, ends[1:]])
    top = np.concatenate([top[:1], top, top[-1:]])
    axes.fill_between(strain, 0, top, color=colour, alpha=0.18, lw=0, label=name)
    axes.plot(strain, top, color=colour, lw=0.8)


def _mark_onset(
    axes: Axes, buckling: Buckling, strain: FloatArray, size: FloatArray, top: float
) -> None:
    """Mark the strains between which the pattern appears, and the extrapolated critical strain."""
    if np.isfinite(buckling.before) and np.isfinite(buckling.after):
        axes.axvspan(100 * buckling.before, 100 * buckling.after, color=RED, alpha=0.08, lw=0)
        middle = 50 * (buckling.before + buckling.after)
        annotate(axes, middle, top, "buckling", RED, (0, -9), "center")
    if np.isfinite(buckling.estimate):
        at, last = 100 * buckling.estimate, int(np.argmax(strain))
        if strain[last] > at:
            beyond = np.linspace(at, strain[last], 60)
            grown = size[last] * np.sqrt((beyond - at) / (strain[last] - at))
            axes.plot(beyond, grown, color=MUTED, lw=0.9, ls=DASHES)
        ring(axes, at, 0.0)
        annotate(axes, at, 0.0, f"{at:.2f} %", INK, (9, 5), "left")
