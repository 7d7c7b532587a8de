"""What is drawn of every photograph, with the words that go with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from matplotlib.figure import Figure

from modeharvest.validation.harvest import plots as maps
from modeharvest.validation.harvest.atlas import HarvestAtlas
from modeharvest.validation.harvest.plots_photographs import CLOSE, draw_closeup
from modeharvest.validation.harvest.run import HarvestedFrame

Draw = Callable[[HarvestAtlas, HarvestedFrame], Figure]
Shows = Callable[[HarvestAtlas, HarvestedFrame], bool]


def _always(atlas: HarvestAtlas, frame: HarvestedFrame) -> bool:
    return True


@dataclass(frozen=True)
class HarvestPanel:
    """One quantity, drawn for every photograph that has it; as a panel of a validation.

    Parameters
    ----------
    section
        Anchor of the part of the page where it is.
    key, symbol, title, paper, caption, exact
        As in :class:`modeharvest.validation.plots.Panel`.
    draw
        Makes the picture of a frame.
    shows
        Whether there is something to draw for a frame.
    """

    section: str
    key: str
    symbol: str
    title: str
    paper: str
    caption: str
    draw: Draw
    shows: Shows = _always
    exact: bool = False


SECTIONS = (
    ("photographs", "Photographs and pattern"),
    ("found", "What was measured"),
    ("left", "What is left over"),
    ("sure", "How sure it is"),
    ("truth", "Against the truth"),
)
"""Anchor and heading of each group of panels."""


def panels(atlas: HarvestAtlas) -> list[HarvestPanel]:
    """Every panel of a harvest, those without a picture left out."""
    count = max((len(frame.modes) for frame in atlas.shown), default=0)
    every = [*_PHOTOGRAPHS]
    for k, part in enumerate(atlas.shown[0].parts):
        every += _part(k, part.name)
    every += _SLOW
    for i in range(count):
        every += _mode(i, f"<sub>{i + 1}</sub>")
    every += [*_LEFT, *_errors("v0", "v<sub>0</sub>", "Smooth field", "")]
    for i in range(count):
        n = f"<sub>{i + 1}</sub>"
        every += _errors(f"v{i + 1}", f"v{n}", "Amplitude of the mode", "", i)
        every += _errors(f"fluc{i + 1}", f"v{n}φ{n}", "Correlated fluctuation",
                         " The mode’s own uncertainty is in it.", i)  # fmt: skip
    every += _TRUTH
    return [p for p in every if any(p.shows(atlas, frame) for frame in atlas.shown)]


def _has_spectrum(atlas: HarvestAtlas, frame: HarvestedFrame) -> bool:
    return frame.spectrum is not None


def _has_local(atlas: HarvestAtlas, frame: HarvestedFrame) -> bool:
    return frame.local is not None


def _has_truth(atlas: HarvestAtlas, frame: HarvestedFrame) -> bool:
    truth = atlas.harvest.truth
    return truth is not None and frame.name in truth.frames


def _has_mode(i: int) -> Shows:
    return lambda atlas, frame: i in frame.modes


def _has_leftover(i: int | None) -> Shows:
    return lambda atlas, frame: frame.by_leftover is not None and (i is None or i in frame.modes)


_PHOTOGRAPHS = (
    HarvestPanel(
        "photographs", "image", "", "Deformed photograph", "spect_real (a)",
        "As it was correlated, free from optical distortion. Over it, in yellow, the material’s "
        "outline in the reference, moved by what was measured: it should run along the edges.",
        maps.draw_deformed,
    ),
    HarvestPanel(
        "photographs", "closeup", "", "A closer look", "",
        f"{CLOSE} × {CLOSE} cells in the middle, pixel by pixel, with the outline as above.",
        draw_closeup,
    ),
    HarvestPanel(
        "photographs", "Sxx", "S<sub>xx</sub>", "Spectral density along x", "spect_real (b)",
        "Of the displacement without its affine part. The colours end at the pattern’s own "
        "density, the same for all photographs; what is beyond, on the axes, comes from the "
        "specimen’s edges. Rings: the wave vectors found (faint: the largest peak where there is "
        "no pattern).",
        partial(maps.draw_spectrum, component=0), _has_spectrum,
    ),
    HarvestPanel(
        "photographs", "Syy", "S<sub>yy</sub>", "Spectral density along y", "spect_real (c)",
        "A wave and its mirror image on either diagonal make four peaks at (±½, ±½): a pattern "
        "that repeats after two cells.",
        partial(maps.draw_spectrum, component=1), _has_spectrum,
    ),
)  # fmt: skip

_SLOW = (
    HarvestPanel(
        "found", "v0x", "v<sub>0</sub> · e<sub>x</sub>", "Smooth field along x", "real (a) and (i)",
        "The applied deformation, and the specimen’s rigid motion between the photographs.",
        partial(maps.draw_v0, component=0),
    ),
    HarvestPanel(
        "found", "v0y", "v<sub>0</sub> · e<sub>y</sub>", "Smooth field along y", "real (b) and (j)",
        "Where the pattern draws the specimen in, across the loading, is the auxetic effect.",
        partial(maps.draw_v0, component=1),
    ),
)  # fmt: skip

_LEFT = (
    HarvestPanel(
        "left", "residual", "f − g∘φ", "Residual", "real (g) and (o)",
        "In the deformed configuration; single pixels, not averages. The colours end at the 99th "
        "percentile. Camera noise is in it, and what the ansatz can’t describe. Blank along the "
        "edges: not compared there.",
        maps.draw_residual, exact=True,
    ),
    HarvestPanel(
        "left", "w", "‖w‖", "Microfluctuation field", "real (h) and (p)",
        "Local DIC − IDIC in the deformed configuration, the local DIC’s own errors included; "
        "blank where it has no point. The colours end at the 99.8th percentile.",
        maps.draw_w, _has_local,
    ),
)  # fmt: skip

_TRUTH = (
    HarvestPanel(
        "truth", "true_w", "‖w‖", "Truth − IDIC", "",
        "All that the measurement does not say, in the deformed configuration. The colours end at "
        "the 99.8th percentile, here and beside.",
        partial(maps.draw_error_against_truth, part="true_w"), _has_truth,
    ),
    HarvestPanel(
        "truth", "best", "‖u − u<sub>best</sub>‖", "What the ansatz can’t say", "",
        "Truth − best fit of the same unknowns to the true displacement.",
        partial(maps.draw_error_against_truth, part="best"), _has_truth,
    ),
    HarvestPanel(
        "truth", "loss", "‖u<sub>best</sub> − u<sub>IDIC</sub>‖", "What the measurement loses", "",
        "Best fit − IDIC: what is lost on top, on its own, smaller scale.",
        partial(maps.draw_error_against_truth, part="loss"), _has_truth,
    ),
)  # fmt: skip


def _part(k: int, name: str) -> list[HarvestPanel]:
    """Spectral densities of part k (from 0)."""
    return [
        HarvestPanel(
            "photographs", f"S{axis}{axis}-{k + 1}", f"S<sub>{axis}{axis}</sub>",
            f"Spectral density along {axis}, region “{name}”", "",
            "Of the displacement in this region alone, which has modes of its own.",
            partial(maps.draw_part_spectrum, part=k, component=component),
        )
        for component, axis in enumerate("xy")
    ]  # fmt: skip


def _mode(i: int, n: str) -> list[HarvestPanel]:
    """Amplitude, mode and fluctuation of mode i (from 0), n its number as HTML."""
    shows = _has_mode(i)
    return [
        HarvestPanel(
            "found", f"v{i + 1}", f"v{n}", "Amplitude of the mode", _paper(i, "(c) and (k)"),
            f"Where the pattern lives; blank where φ{n} is zero and v{n} means nothing. The values "
            f"are large because φ{n} is scaled to 0.04.",
            partial(maps.draw_amplitude, i=i), shows,
        ),
        HarvestPanel(
            "found", f"phi{i + 1}", f"φ{n}", "The mode", _paper(i, "(d) and (l)"),
            "The identified mode as a deformed configuration over the undeformed outline, enlarged "
            "to a largest displacement of 0.16 l.",
            partial(maps.draw_mode, i=i), shows,
        ),
        HarvestPanel(
            "found", f"fluc{i + 1}x", f"v{n}φ{n} · e<sub>x</sub>", "Correlated fluctuation along x",
            _paper(i, "(e) and (m)"), "In the deformed configuration of this contribution alone.",
            partial(maps.draw_fluctuation, i=i, component=0), shows,
        ),
        HarvestPanel(
            "found", f"fluc{i + 1}y", f"v{n}φ{n} · e<sub>y</sub>", "Correlated fluctuation along y",
            _paper(i, "(f) and (n)"), "In the deformed configuration of this contribution alone.",
            partial(maps.draw_fluctuation, i=i, component=1), shows,
        ),
    ]  # fmt: skip


def _errors(field: str, symbol: str, title: str, more: str, i: int | None = None
            ) -> list[HarvestPanel]:  # fmt: skip
    """Standard deviations of a field by both causes."""
    of_noise = _always if i is None else _has_mode(i)
    return [
        HarvestPanel(
            "sure", f"{field}-noise", f"sd({symbol})", f"{title}, by noise", "",
            f"One standard deviation by the photographs’ noise.{more}",
            partial(maps.draw_error, field=field, cause="noise"), of_noise,
        ),
        HarvestPanel(
            "sure", f"{field}-leftover", f"sd({symbol})", f"{title}, by what is left over", "",
            "One standard deviation by what the ansatz can’t describe, which pushes its unknowns "
            "about from cell to cell; noise included.",
            partial(maps.draw_error, field=field, cause="leftover"), _has_leftover(i),
        ),
    ]  # fmt: skip


def _paper(i: int, panel: str) -> str:
    return f"real {panel}" if i == 0 else ""
