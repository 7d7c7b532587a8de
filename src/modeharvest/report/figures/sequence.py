"""Figures of image sequences: force over strain, growth of the pattern, the last photograph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from modeharvest.report.figures.curves import curve
from modeharvest.report.figures.style import BLUE, GREY, MUTED, RED, figure, style, to_svg
from modeharvest.report.model.content import Card
from modeharvest.runs.photographs.watch import WatchedTest
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.files import atomic
from modeharvest.validation.growth import Prediction


def force_cards(frames: Sequence[Mapping[str, Any]], key: str, what: str) -> list[Card]:
    """Make a card of force over strain, if the force is known for at least two photographs.

    ``frames``: photographs in ``summary.json``; ``key``: key of their strain; ``what``: its label.
    """
    known = [frame for frame in frames if frame.get("force_N") is not None]
    if len(known) < 2:
        return []
    strain, force = (np.array([f[k] for f in known], np.float64) for k in (key, "force_N"))
    return [Card.captioned("timeline-force", partial(draw_force, strain, force, what))]


def draw_force(strain: FloatArray, force: FloatArray, what: str) -> Figure:
    """Draw force [N] over strain [-], (n,) in the order of the test; ``what`` names the strain."""
    drawn, axes = curve(f"{what} [%]", "force [N]")
    axes.plot(100 * strain, force, "o-", color=BLUE, lw=1, ms=3.5 if strain.size < 60 else 1.5)
    return drawn


def write_watch_page(
    path: Path, title: str, test: WatchedTest, photograph: FloatImage | None
) -> None:
    """Write the page of a test that is watched; it reloads itself until watching has ended.

    ``photograph``: the last photograph (rows, cols), in any grey scale; None if not available.
    """
    last = next(reversed(test.predictions), None)
    figures = {}
    with style():
        if photograph is not None:
            figures["The last photograph"] = draw_photograph(photograph)
        if test.rows:
            figures["Amplitude of the pattern"] = draw_amplitude(test, last)
        if last is not None:
            figures["Growth: the line ends at the predicted strain of buckling"] = draw_growth(
                test, last
            )
    content = {
        "title": escape(title or "A running test"),
        "refresh": "" if test.conclusion else f'<meta http-equiv="refresh" content="{_RELOAD_S}">',
        "lead": escape(watch_text(test)),
        "figures": "".join(
            f"<figure><figcaption>{name}</figcaption>{to_svg(drawn, f'f{k}', name)}</figure>"
            for k, (name, drawn) in enumerate(figures.items())
        ),
        "skipped": "<h2>Not used</h2>" * bool(test.skipped)
        + "<ul>"
        + "".join(
            f"<li>{escape(row['name'])}: {escape(row['reason'])}</li>" for row in test.skipped[-20:]
        )
        + "</ul>",
    }
    with atomic(path) as temporary:
        temporary.write_text(_PAGE.substitute(content), "utf-8")


def watch_text(test: WatchedTest) -> str:
    """Summary of a watched test, in a few sentences."""
    if not test.rows:
        return f"No photograph has been measured yet. {test.conclusion}"
    last, found, count = test.rows[-1], test.predictions[-1], len(test.rows)
    text = (
        f"{count} photograph{'s' * (count > 1)}, the last at a strain of "
        f"{100 * last['strain']:.2f} %: pattern {last['pattern_px']:.2f} px rms. "
    )
    if (buckled := test.buckled) is not None:
        low, high = (f"{100 * strain:.2f}" for strain in buckled)
        text += f"The specimen has buckled: the pattern grew fastest from {low} to {high} %. "
    if found is not None and found.is_useful:
        is_reached = buckled is None and float(test.columns[0].max()) >= found.critical
        text += (
            f"Buckling {'is' if buckled is None else 'was'} predicted at "
            f"{100 * found.critical:.2f} % (95 % interval: {found.interval}), by extrapolation of "
            f"the growth up to {100 * found.largest:.2f} %."
            + " This strain is reached."
            * is_reached
        )
    elif buckled is None:
        text += "The pattern's growth doesn't show yet at which strain the specimen buckles."
    return f"{text} {test.conclusion}"


def draw_photograph(image: FloatImage) -> Figure:
    """Draw a photograph in low resolution, its contrast stretched between percentiles."""
    step = max(1, max(image.shape) // 500)
    few = image[::step, ::step]
    drawn = figure(4.2, 4.2 * few.shape[0] / few.shape[1])
    axes = drawn.add_axes((0.0, 0.0, 1.0, 1.0), frameon=False, xticks=[], yticks=[])
    low, high = np.percentile(few, (0.5, 99.5))
    axes.imshow(few, cmap=GREY, vmin=low, vmax=max(high, low + 1e-9), rasterized=True)
    return drawn


def _interval(axes: Any, found: Prediction) -> None:
    if found.is_useful:
        axes.axvspan(100 * found.low, 100 * found.high, color=RED, alpha=0.1, lw=0)


def draw_amplitude(test: WatchedTest, found: Prediction | None) -> Figure:
    """Draw the amplitude of v1's half wave over the strain, and the growth fitted to it."""
    strain, amplitude, sd, _ = test.columns
    drawn, axes = curve("nominal strain [%]", "v₁, half wave [µm]")
    axes.errorbar(100 * strain, 1e3 * amplitude, 2e3 * sd, fmt="o", color=BLUE, ms=3.5, lw=1)
    if found is not None and found.is_useful:
        p = np.linspace(0.0, 0.97 * found.critical, 200)
        grown = found.imperfection * p / (found.critical - p) + np.polyval(found.others, p)
        top = 1.3 * float(np.abs(amplitude).max())
        axes.plot(100 * p, 1e3 * np.where(np.abs(grown) < top, grown, np.nan), color=MUTED, lw=1)
        _interval(axes, found)
        axes.axvline(100 * found.critical, color=RED, lw=1)
    axes.set(xlim=(0, None))
    return drawn


def draw_growth(test: WatchedTest, found: Prediction) -> Figure:
    """Draw strain / amplitude of the critical mode over strain: it falls to 0 at buckling."""
    strain, amplitude, sd, _ = test.columns
    own = np.sign(found.imperfection) * (amplitude - np.polyval(found.others, strain))
    good = (strain > 0) & (own > 2 * sd) & (own > 0.1 * own.max(initial=0.0))
    drawn, axes = curve("nominal strain [%]", "strain / critical part of v₁ [1/mm]")
    value = strain[good] / own[good]
    axes.errorbar(100 * strain[good], value, 2 * value * sd[good] / own[good], fmt="o",
                  color=BLUE, ms=3.5, lw=1)  # fmt: skip
    ends = np.array([0.0, found.critical])
    axes.plot(100 * ends, (found.critical - ends) / abs(found.imperfection), color=RED, lw=1)
    _interval(axes, found)
    axes.set(ylim=(0, None), xlim=(0, None))
    return drawn


_RELOAD_S = 3
_PAGE = Template("""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
$refresh<title>$title · modeharvest</title><style>
:root { color-scheme: light dark; --muted: light-dark(#6a7078, #9aa1ab); }
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 75rem; padding: 0 1rem; }
main { columns: 2 360px; column-gap: 24px; } h2 { font-size: 1rem; }
ul { color: var(--muted); font-size: .9rem; }
figure { margin: 0 0 16px; break-inside: avoid; } figcaption { font-weight: 600; }
svg { width: 100%; height: auto; }</style></head>
<body><h1>$title</h1><p>$lead</p><main>$figures</main>$skipped</body></html>
""")
