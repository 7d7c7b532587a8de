"""Figures of the whole displacement: maps for any kind of run, and tables for photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic

import numpy as np
from matplotlib.figure import Figure

from modeharvest.idic.finite_element.result import NodalResult, WholeField
from modeharvest.imaging.grid import PixelGrid
from modeharvest.report.figures import fits
from modeharvest.report.figures.fits import UM, Panel, S
from modeharvest.report.figures.maps import ColourScale, MapFrame, draw_field
from modeharvest.report.model.content import Card, ReportTable
from modeharvest.report.model.text import Cell, indexed, text_of
from modeharvest.util.arrays import FloatArray
from modeharvest.util.typed import headings
from modeharvest.validation.truth import lengths
from modeharvest.validation.whole_field import WholeFieldNumbers, WholeFieldSummary

_SHARE = 0.98
"""Share of pixels with values within the colours' range; a few at edges are much larger."""
Numbers = Mapping[str, Any]
"""Numbers of a whole displacement in ``summary.json``."""


@dataclass(frozen=True)
class WholeMaps(Generic[S]):
    """Maps of the whole displacement of states."""

    whole: Callable[[S], WholeField | None]
    truth: Callable[[S], FloatArray | None]
    """Whole displacement of a state, and its truth (rows, cols, 2) at the images' pixels [mm]; None
    if not known. Calls may wait until they are computed."""
    is_known: Callable[[S], bool] | None = None
    """Whether both are known or being computed; needed if the calls above may wait."""

    def panels(self, figure: str = "-", scale: str = "whole-scale") -> list[Panel[S]]:
        """Make the panels; ``figure``: w's number in the paper; ``scale``: name of w's texts."""

        def shows(state: S) -> bool:
            return self.is_known(state) if self.is_known else self.whole(state) is not None

        def known(state: S) -> bool:
            return shows(state) and (self.is_known is not None or self.truth(state) is not None)

        return [
            Panel("whole", "whole-w", self._w, shows, scale, figure, late=True),
            Panel("whole", "whole-error", self._error, known, late=True),
            Panel("whole", "whole-strain", self._principal_strain, shows, late=True),
            Panel("whole", "whole-deviation", self._deviation, shows, late=True),
        ]

    def _measured(self, state: S) -> NodalResult:
        whole = self.whole(state)
        assert whole is not None
        return whole.measured

    def _w(self, state: S) -> Figure:
        """Draw ‖u - v0 - sum v_i phi_i‖ of the measured u, with colours for the true u if known."""
        frame, result = state.view.map_frame(), state.result
        grid = middle_pixels(frame, state.view.grid)
        by_idic = result.displacement(grid)
        w = UM * lengths(self._measured(state).displacement_on(grid) - by_idic)
        true, shown = self.truth(state), w
        if true is not None:
            shown = UM * lengths(frame.sample(true) - by_idic)
        return draw_field(frame, w, ColourScale.size(shown, "µm", 0.998), state.motion)

    def _error(self, state: S) -> Figure:
        true, measured = self.truth(state), self._measured(state).displacement_on(state.view.grid)
        assert true is not None
        error = lengths(true - measured)
        return fits.draw_length(state, state.view.map_frame().average(error), share=_SHARE)

    def _principal_strain(self, state: S) -> Figure:
        """Draw the principal logarithmic strain of larger magnitude, tension positive."""
        frame, measured = state.view.map_frame(), self._measured(state)
        values = np.linalg.eigvalsh(measured.field("logarithmic"))
        is_first = np.abs(values[:, :1]) > np.abs(values[:, 1:])
        larger = np.where(is_first, values[:, :1], values[:, 1:])
        strain = measured.on_pixels(larger, middle_pixels(frame, state.view.grid))[..., 0]
        return draw_field(frame, strain, ColourScale.signed(strain, "", _SHARE), state.motion)

    def _deviation(self, state: S) -> Figure:
        frame, measured = state.view.map_frame(), self._measured(state)
        sd = measured.standard_deviation_on(middle_pixels(frame, state.view.grid))
        return fits.draw_length(state, lengths(sd), share=_SHARE)


def middle_pixels(frame: MapFrame, grid: PixelGrid) -> PixelGrid:
    """Grid of the images' pixels at the middles of a map's cells."""
    rows, cols = frame.pixels
    x, y = grid.to_mm(rows[0], cols[0])
    return PixelGrid(len(rows), len(cols), frame.factor * grid.pixel_size, float(x), float(y))


def whole_panel_numbers(key: str, numbers: Numbers) -> str:
    """Line of numbers below a panel's figure; empty if there are none."""
    if key == "whole-w" and "w_rms_px" in numbers:
        return text_of(key, **numbers)
    if key == "whole-error":
        edges, share = numbers["rms_edges_px"] or 0.0, 100 * numbers["coverage"]
        return text_of(key, edges=edges, share=share, **numbers)
    if key == "whole-deviation" and "interval_coverage" in numbers:
        return text_of(key, covered=100 * numbers["interval_coverage"])
    return ""


def whole_cards(found: Sequence[tuple[str, Numbers]]) -> list[Card]:
    """Make cards with tables of labelled whole displacements in photographs: numbers, modes."""
    if not found:
        return []
    labels, numbers = zip(*found, strict=True)
    heads = headings(WholeFieldNumbers, WholeFieldSummary)
    table = ReportTable.of_states("whole", found, heads)
    both = ("refitted to the whole displacement", "±", "by IDIC")
    columns = ("", "", *(f"{label}: {way}" for label in labels for way in both))
    modes = ReportTable("Modes of both fits", columns, list(_mode_rows(numbers)), "whole-modes")
    return [*Card.tabular(table, wide=True), *Card.tabular(modes, wide=True)]


def _mode_rows(numbers: Sequence[Numbers]) -> Iterable[tuple[Cell, ...]]:
    """Rows with each mode's largest amplitude and parameters, by both fits in each photograph."""
    for i in range(max(len(n["modes"]) for n in numbers)):
        modes: list[Numbers] = [
            n["modes"][i] if i < len(n["modes"]) else {"parameters": ()} for n in numbers
        ]
        largest = [m.get(key) for m in modes for key in ("v_max_mm", "", "correlated_v_max_mm")]
        yield (indexed(f"largest |v{i + 1}|"), "mm", *largest)
        found = [{p["name"]: p for p in mode["parameters"]} for mode in modes]
        units = {name: p["unit"] for column in found for name, p in column.items()}
        for name, unit in units.items():
            ways = (column.get(name, {}) for column in found)
            values = [p.get(key) for p in ways for key in ("refitted", "deviation", "correlated")]
            yield (indexed(f"{name} of φ{i + 1}"), unit.replace("-", "–"), *values)
