"""Maps of what was fitted to an image, the same for virtual experiments and for photographs.

A quantity is a :class:`Panel`: drawn for every state, its pictures side by side. Those of the
ansatz are listed here; the others where their kind of run is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic, TypeVar

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from modeharvest.idic.result import Result
from modeharvest.idic.spectra.pattern import WavePattern
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.imaging.grid import PixelGrid
from modeharvest.report.figures.curves import draw_density, pattern_density
from modeharvest.report.figures.maps import (
    ColourScale,
    DisplacementFunction,
    MapFrame,
    draw_field,
    draw_shape,
)
from modeharvest.report.figures.outlines import MeshBoundary
from modeharvest.report.model import Card, ReportFigure, Section
from modeharvest.util.arrays import BoolArray, FloatArray

FINE, SMOOTH, COARSE = 740, 360, 160
"""Cells along a map's longer side: as fine as speckles, as patterns, as error bars."""
DRAWN_SHAPE = 0.16
"""Largest displacement that modes are drawn with [l]."""
UM = 1e3  # micrometres in a millimetre


@dataclass(frozen=True, eq=False)
class SpecimenView:
    """The specimen that the maps of all states are drawn on.

    Parameters
    ----------
    outline
        Of the material in the reference.
    grid, mask
        The images' pixels, and (rows, cols) which of the reference's show material.
    pitch
        Unit cell size l [mm].
    """

    outline: MeshBoundary
    grid: PixelGrid
    mask: BoolArray
    pitch: float
    _sheets: dict[int, MapFrame] = field(default_factory=dict, repr=False)

    def map_frame(self, cells: int = SMOOTH) -> MapFrame:
        """The frame of maps with about that many cells along the longer side."""
        if cells not in self._sheets:
            self._sheets[cells] = MapFrame.of(self.outline, self.grid, cells)
        return self._sheets[cells]

    def on_material(self, values: FloatArray, cells: int = SMOOTH) -> FloatArray:
        """Values on a map; NaN off the material, where the ansatz has no meaning."""
        map_frame = self.map_frame(cells)
        (rows, cols), n = map_frame.grid.shape, map_frame.factor
        blocks = self.mask[: rows * n, : cols * n].reshape(rows, n, cols, n)
        return np.where(blocks.any(axis=(1, 3)), values, np.nan)


@dataclass(frozen=True, eq=False)
class FittedState:
    """A deformed state and what was fitted to its image.

    Parameters
    ----------
    name, label
        Ending of its pictures' anchors, and what is written above them.
    view
        The specimen.
    result
        Of its correlation.
    densities
        Gives the spectral densities of the displacement, what is read off them, and where their
        colours end [mm⁶], the same for all states.
    """

    name: str
    label: str
    view: SpecimenView
    result: Result
    densities: Callable[[], tuple[Spectrum, WavePattern, float]]

    def motion(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """The measured displacement [mm]."""
        return self.result.ansatz.displacement(self.result.unknowns, x, y)

    def support(self, i: int, cells: int = SMOOTH) -> FloatArray:
        """Taper of mode i (from 0) on a map [-]."""
        taper, grid = self.result.ansatz.modes[i].taper, self.view.map_frame(cells).grid
        return np.asarray(taper.along_y(grid.y)[:, None] * taper.along_x(grid.x)[None, :])

    def shape_scale(self, i: int) -> float:
        """By how much phi_i is drawn [mm], for a largest displacement of DRAWN_SHAPE l."""
        phi = self.result.phi(i, self.view.map_frame().grid)
        largest = float(np.linalg.norm(phi, axis=-1).max())
        return DRAWN_SHAPE * self.view.pitch / largest if largest > 0 else 1.0


def largest_density(spectra: Iterable[tuple[Spectrum, WavePattern]]) -> float:
    """Of any state's pattern [mm⁶]; 0 without."""
    return max((pattern_density(*pair) for pair in spectra), default=0.0)


S = TypeVar("S", bound=FittedState, contravariant=True)


def always(state: FittedState) -> bool:
    """For every state."""
    return True


@dataclass(frozen=True)
class Panel(Generic[S]):
    """A quantity that is drawn for every state.

    Parameters
    ----------
    section, key
        Where on the page it is, and its anchor there.
    symbol, title, paper, caption
        HTML, words, the panel in the paper or "", and what is shown, HTML.
    draw
        Draws it of a state.
    shows
        Whether there is something to draw.
    exact
        Whether the picture's pixels are kept exactly.
    late
        Whether what it shows may still be computed while others are drawn.
    """

    section: str
    key: str
    symbol: str
    title: str
    paper: str
    caption: str
    draw: Callable[[S], Figure]
    shows: Callable[[S], bool] = always
    exact: bool = False
    late: bool = False

    def card(self, states: Sequence[S], numbers: Callable[[str, S], str]) -> Card:
        """Its pictures of these states; ``numbers`` makes the lines below them."""
        figures = [
            ReportFigure(f"{self.key}-{state.name}", state.label, partial(self.draw, state),
                         numbers(self.key, state), exact=self.exact, late=self.late)
            for state in states if self.shows(state)
        ]  # fmt: skip
        paper = f"paper: Fig. {self.paper}" if self.paper else ""
        return Card(self.title, figures, caption=Markup(self.caption), name=self.key,
                    symbol=Markup(self.symbol), paper=paper)  # fmt: skip


def panel_sections(
    panels: Sequence[Panel[S]],
    states: Sequence[S],
    heads: Mapping[str, tuple[str, str]],
    numbers: Callable[[str, S], str],
) -> list[Section]:
    """Panels that have a picture, under the title and lead of their sections.

    ``numbers`` makes the line below the picture of a panel's key and a state.
    """
    cards: dict[str, list[Card]] = {name: [] for name in heads}
    for panel in panels:
        card = panel.card(states, numbers)
        if card.figures:
            cards[panel.section].append(card)
    return [Section(name, title, cards[name], lead) for name, (title, lead) in heads.items()]


def draw_length(
    state: FittedState, length: FloatArray, cells: int = SMOOTH, share: float = 0.998
) -> Figure:
    """Draw a length [mm] on a map in the deformed configuration, colours up to this share."""
    scale = ColourScale.size(UM * length, "µm", share)
    return draw_field(state.view.map_frame(cells), UM * length, scale, state.motion)


def _spectrum(state: FittedState, component: int) -> Figure:
    spectrum, pattern, end = state.densities()
    return draw_density(spectrum, pattern, component, end)


def _v0(state: FittedState, component: int) -> Figure:
    v0 = UM * state.result.v0(state.view.map_frame().grid)[..., component]
    scale = ColourScale.signed(state.view.on_material(v0), "µm")
    return draw_field(state.view.map_frame(), v0, scale)


def _amplitude(state: FittedState, i: int) -> Figure:
    """v_i where phi_i is not zero; the colours end at the largest value where it is whole."""
    support = state.support(i)
    v = UM * state.result.v(i, state.view.map_frame().grid)
    inside = state.view.on_material(np.where(support == 1.0, v, np.nan))
    scale = replace(ColourScale.signed(inside, "µm"), extend="both")
    return draw_field(state.view.map_frame(), np.where(support > 0.0, v, np.nan), scale)


def _shape(state: FittedState, i: int) -> Figure:
    ansatz, unknowns, scale = state.result.ansatz, state.result.unknowns, state.shape_scale(i)
    return draw_shape(state.view.map_frame(), lambda x, y: scale * ansatz.phi(i, unknowns, x, y))


def _fluctuation(state: FittedState, i: int, component: int) -> Figure:
    result, map_frame = state.result, state.view.map_frame()
    values = UM * result.fluctuation(i, map_frame.grid)[..., component]
    motion: DisplacementFunction = partial(result.ansatz.fluctuation, i, result.unknowns)
    scale = ColourScale.signed(state.view.on_material(values), "µm")
    return draw_field(map_frame, values, scale, motion)


def named(paper: str, letters: str) -> str:
    """A panel's name in the paper; empty where it has none."""
    return f"{paper} {letters}" if paper else ""


def spectrum_panels(
    section: str, paper: str, states: str, shows: Callable[[S], bool]
) -> list[Panel[S]]:
    """Both spectral densities; ``states`` is what the states are called.

    ``paper`` names the paper's figure; it is empty for patterns that aren't the paper's.
    """
    return [
        Panel(
            section, "Sxx", "S<sub>xx</sub>", "Spectral density along x", named(paper, "(b)"),
            "Of the displacement without its affine part. The colours end at the pattern’s own "
            f"density, the same for all {states}; what is beyond, on the axes, comes from the "
            "specimen’s edges. Rings: the wave vectors found (faint: the largest peak where there "
            "is no pattern).",
            partial(_spectrum, component=0), shows, late=True,
        ),
        Panel(
            section, "Syy", "S<sub>yy</sub>", "Spectral density along y", named(paper, "(c)"),
            "A wave and its mirror image on either diagonal make four peaks at (±½, ±½): a pattern "
            "that repeats after two cells." if paper else "",
            partial(_spectrum, component=1), shows, late=True,
        ),
    ]  # fmt: skip


def ansatz_panels(section: str, paper: str, modes: int) -> list[Panel[FittedState]]:
    """v0, and of each mode amplitude, shape and fluctuation."""
    slow: list[Panel[FittedState]] = [
        Panel(
            section, "v0x", "v<sub>0</sub> · e<sub>x</sub>", "Smooth field along x",
            named(paper, "(a) and (i)"),
            "The applied deformation, and a rigid motion between the images if there is one.",
            partial(_v0, component=0),
        ),
        Panel(
            section, "v0y", "v<sub>0</sub> · e<sub>y</sub>", "Smooth field along y",
            named(paper, "(b) and (j)"),
            "Lateral expansion before buckling. The pattern, once it is there, undoes it near the "
            "specimen’s centre: the auxetic effect." if paper else "",
            partial(_v0, component=1),
        ),
    ]  # fmt: skip
    return slow + [panel for i in range(modes) for panel in _mode_panels(section, paper, i)]


def shape_numbers(key: str, state: FittedState) -> str:
    """How the shape of a mode is drawn; empty for other panels."""
    if not key.startswith("phi"):
        return ""
    scale = state.shape_scale(int(key.removeprefix("phi")) - 1)
    return f"drawn as with v = {scale:.3g} mm everywhere"


def has_mode(i: int) -> Callable[[FittedState], bool]:
    """Whether a state has mode i (from 0)."""
    return lambda state: i < len(state.result.ansatz.modes)


def _mode_panels(section: str, paper: str, i: int) -> list[Panel[FittedState]]:
    """Of mode i (from 0)."""
    n, shows = f"<sub>{i + 1}</sub>", has_mode(i)
    names = [named(paper, letters) if i == 0 else "" for letters in
             ("(c) and (k)", "(d) and (l)", "(e) and (m)", "(f) and (n)")]  # fmt: skip
    fluctuations: list[Panel[FittedState]] = [
        Panel(
            section, f"fluc{i + 1}{axis}", f"v{n}φ{n} · e<sub>{axis}</sub>",
            f"Correlated fluctuation along {axis}", names[2 + component],
            "In the deformed configuration of this contribution alone.",
            partial(_fluctuation, i=i, component=component), shows,
        )
        for component, axis in enumerate("xy")
    ]  # fmt: skip
    return [
        Panel(
            section, f"v{i + 1}", f"v{n}", "Amplitude of the mode", names[0],
            f"Where the pattern is; blank where φ{n} is zero and v{n} has no meaning. The values "
            f"are large because φ{n} is scaled to 0.04. Near the corners it also takes up part of "
            "the edge effect.",
            partial(_amplitude, i=i), shows,
        ),
        Panel(
            section, f"phi{i + 1}", f"φ{n}", "The mode", names[1],
            "The identified mode as a deformed configuration over the undeformed outline, enlarged "
            f"to a largest displacement of {DRAWN_SHAPE} l.",
            partial(_shape, i=i), shows,
        ),
        *fluctuations,
    ]  # fmt: skip
