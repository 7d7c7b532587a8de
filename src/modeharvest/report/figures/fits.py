"""Maps of the ansatz fitted to an image, the same for virtual experiments and for photographs.

A quantity is a :class:`Panel`, drawn for every state, side by side. Panels of the ansatz are
defined here, others in the report of each kind of run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from modeharvest.idic.result import Result
from modeharvest.idic.spectra.pattern import WavePattern
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.imaging.grid import PixelGrid
from modeharvest.report.figures import style
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.curves import draw_convergence, draw_density, pattern_density
from modeharvest.report.figures.maps import (
    ColourScale,
    DisplacementFunction,
    MapFrame,
    draw_blend,
    draw_field,
    draw_shape,
)
from modeharvest.report.model.content import Card, ReportFigure, Section
from modeharvest.report.model.text import caption
from modeharvest.util.arrays import BoolArray, FloatArray

FINE, SMOOTH, COARSE = 740, 360, 160
"""Cells along a map's longer side, for fields that vary like speckle, patterns, error bars."""
DRAWN_SHAPE = 0.16
"""Largest displacement of a drawn mode [l]."""
UM = 1e3  # micrometres in a millimetre


@dataclass(frozen=True, eq=False)
class SpecimenView:
    """The specimen on which the maps of all states are drawn."""

    boundary: MeshBoundary
    """Boundary of the material in the reference."""
    grid: PixelGrid
    mask: BoolArray
    """Pixels of the images, and mask (rows, cols) of the reference, True on material."""
    pitch: float
    """Unit cell size l [mm]."""

    def map_frame(self, cells: int = SMOOTH) -> MapFrame:
        """Frame of maps with about ``cells`` cells along the longer side."""
        return MapFrame.of(self.boundary, self.grid, cells)

    def on_material(self, values: FloatArray, cells: int = SMOOTH) -> FloatArray:
        """Values on a map; NaN in cells without material, where the ansatz has no meaning."""
        map_frame = self.map_frame(cells)
        (rows, cols), n = map_frame.grid.shape, map_frame.factor
        blocks = self.mask[: rows * n, : cols * n].reshape(rows, n, cols, n)
        return np.where(blocks.any(axis=(1, 3)), values, np.nan)


@dataclass(frozen=True, eq=False)
class FittedState:
    """A deformed state and the ansatz fitted to its image."""

    name: str
    label: str
    """Last part of the anchors of the state's figures, and the label above them."""
    view: SpecimenView
    result: Result
    densities: Callable[[], tuple[Spectrum, WavePattern, float]]
    """Returns the spectrum of the displacement, the pattern found in it, and the density at which
    the colours end [mm⁶], which is the same for all states."""

    def motion(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(..., 2) measured displacement [mm] at positions x, y [mm] that broadcast together."""
        return self.result.ansatz.displacement(self.result.unknowns, x, y)

    def support(self, i: int, cells: int = SMOOTH) -> FloatArray:
        """Taper of mode i (from 0) on a map [-]."""
        taper, grid = self.result.ansatz.modes[i].taper, self.view.map_frame(cells).grid
        return np.asarray(taper.along_y(grid.y)[:, None] * taper.along_x(grid.x)[None, :])

    def shape_scale(self, i: int) -> float:
        """Factor [mm] by which phi_i is drawn, for a largest displacement of DRAWN_SHAPE l."""
        phi = self.result.phi(i, self.view.map_frame().grid)
        largest = float(np.linalg.norm(phi, axis=-1).max())
        return DRAWN_SHAPE * self.view.pitch / largest if largest > 0 else 1.0


def convergence_card(state: FittedState, caption: str = "") -> Card:
    """Make a card with the Gauss-Newton steps of a state's correlation."""
    drawn = partial(draw_convergence, state.result)
    figure = ReportFigure(f"convergence-{state.name}", "", drawn, wide=True)
    return Card(state.label, [figure], caption=caption)


def largest_density(spectra: Iterable[tuple[Spectrum, WavePattern]]) -> float:
    """Largest spectral density of any state's pattern [mm⁶]; 0 if there is no pattern."""
    return max((pattern_density(*pair) for pair in spectra), default=0.0)


S = TypeVar("S", bound=FittedState, contravariant=True)


def always(state: FittedState) -> bool:
    """Return True for every state."""
    return True


@dataclass(frozen=True)
class Panel(Generic[S]):
    """A quantity that is drawn for every state."""

    section: str
    key: str
    """Name of the section on the page, and anchor of the panel."""
    draw: Callable[[S], Figure]
    shows: Callable[[S], bool] = always
    """Whether the quantity exists for a state."""
    text: str = ""
    """Name of the panel's texts in ``captions.toml``; by default the key."""
    figure: str = "-"
    """Number of the figure in the paper, if its texts need it; empty if it isn't in the paper."""
    exact: bool = False
    """Whether the figure's pixels are stored without loss."""
    late: bool = False
    """Whether the figures are drawn after the others, because their data may not be ready."""
    values: Mapping[str, object] = field(default_factory=dict)
    """Values filled into the panel's texts."""

    @property
    def words(self) -> dict[str, Any]:
        """Title, symbol, figure in the paper, and caption."""
        words = caption(self.text or self.key, figure=self.figure, **self.values)
        paper = f"paper: Fig. {words['paper']}" if self.figure and "paper" in words else ""
        return {**words, "paper": paper}

    def card(self, states: Sequence[S], numbers: Callable[[str, S], str]) -> Card:
        """Make a card with a figure of each state; ``numbers`` returns the line below it."""
        figures = [
            ReportFigure(f"{self.key}-{state.name}", state.label, partial(self.draw, state),
                         numbers(self.key, state), exact=self.exact, late=self.late)
            for state in states if self.shows(state)
        ]  # fmt: skip
        return Card(figures=figures, name=self.key, **self.words)


def panel_sections(
    names: Sequence[str],
    panels: Sequence[Panel[S]],
    states: Sequence[S],
    numbers: Callable[[str, S], str],
    **values: object,
) -> list[Section]:
    """Make the sections ``names``, each with those of its panels that have a figure.

    ``numbers``: returns the line below a figure from the panel's key and the state; ``values``:
    filled into the sections' texts.
    """
    cards: dict[str, list[Card]] = {name: [] for name in names}
    for panel in panels:
        card = panel.card(states, numbers)
        if card.figures:
            cards[panel.section].append(card)
    return [Section.of(name, cards[name], **values) for name in names]


def draw_length(
    state: FittedState, length: FloatArray, cells: int = SMOOTH, share: float = 0.998
) -> Figure:
    """Draw lengths (rows, cols) [mm], deformed; ``share``: quantile at which the colours end."""
    scale = ColourScale.size(UM * length, "µm", share)
    return draw_field(state.view.map_frame(cells), UM * length, scale, state.motion)


def draw_dissolving(
    state: FittedState, image: NDArray[np.float32], material: BoolArray | None, length: FloatArray
) -> Figure:
    """Draw a state's image that fades, from left to right, into lengths (rows, cols) [µm].

    ``image``, ``material``: as for :func:`~modeharvest.report.figures.maps.draw_image`.
    """
    end = ColourScale.size(state.view.on_material(length), "µm").high
    scale = ColourScale(style.GLOW, 0.0, end, "µm")
    frame, grid = state.view.map_frame(), state.view.grid
    return draw_blend(frame, image, material, grid, length, scale, state.motion)


def _spectrum(state: FittedState, component: int) -> Figure:
    spectrum, pattern, end = state.densities()
    return draw_density(spectrum, pattern, component, end)


def _v0(state: FittedState, component: int) -> Figure:
    v0 = UM * state.result.v0(state.view.map_frame().grid)[..., component]
    scale = ColourScale.signed(state.view.on_material(v0), "µm")
    return draw_field(state.view.map_frame(), v0, scale)


def _amplitude(state: FittedState, i: int) -> Figure:
    """Draw v_i where the taper is above 0; the colours end at its largest size where it is 1."""
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


def spectrum_panels(
    section: str, figure: str, states: str, shows: Callable[[S], bool]
) -> list[Panel[S]]:
    """Make the panels of both spectral densities; ``states``: word for the states in captions.

    ``figure``: number of the figure in the paper; empty for patterns that aren't in the paper.
    """
    texts = {"Sxx": "Sxx", "Syy": "Syy" if figure else "Syy-other"}
    return [
        Panel(section, key, partial(_spectrum, component=component), shows, text, figure,
              late=True, values={"states": states})
        for component, (key, text) in enumerate(texts.items())
    ]  # fmt: skip


def ansatz_panels(section: str, figure: str, modes: int) -> list[Panel[FittedState]]:
    """Make the panels of v0, and of each mode's amplitude, shape and fluctuation."""
    text = "v0y" if figure else "v0y-other"
    panels: list[Panel[FittedState]] = [
        Panel(section, "v0x", partial(_v0, component=0), figure=figure),
        Panel(section, "v0y", partial(_v0, component=1), text=text, figure=figure),
    ]
    for i in range(modes):
        drawn: dict[str, Callable[[FittedState], Figure]] = {
            "v{}": partial(_amplitude, i=i),
            "phi{}": partial(_shape, i=i),
            "fluc{}x": partial(_fluctuation, i=i, component=0),
            "fluc{}y": partial(_fluctuation, i=i, component=1),
        }
        values = {"n": i + 1, "enlarged": DRAWN_SHAPE}
        panels += [
            Panel(section, name.format(i + 1), draw, has_mode(i), name.format(""),
                  "" if i else figure, values=values)
            for name, draw in drawn.items()
        ]  # fmt: skip
    return panels


def shape_numbers(key: str, state: FittedState) -> str:
    """Line below the shape of a mode that states its scale; empty for other panels."""
    if not key.startswith("phi"):
        return ""
    scale = state.shape_scale(int(key.removeprefix("phi")) - 1)
    return f"drawn with v = {scale:.3g} mm everywhere"


def has_mode(i: int) -> Callable[[FittedState], bool]:
    """Return a function that checks whether a state has mode i (from 0)."""
    return lambda state: i < len(state.result.ansatz.modes)
