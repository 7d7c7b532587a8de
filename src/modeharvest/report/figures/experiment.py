"""Figures of a virtual experiment: the panels of the paper for every snapshot, and more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

from matplotlib.figure import Figure

from modeharvest.fem.field import Solution
from modeharvest.idic.result import Result
from modeharvest.idic.spectra.pattern import WavePattern
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.imaging.imageset import ImageSet
from modeharvest.report.figures import fits, style
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.maps import ColourScale, draw_blend, draw_field, draw_image
from modeharvest.report.figures.whole_field import WholeMaps
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.truth import Comparison, lengths, pattern_field
from modeharvest.validation.whole_field import WholeField, WholeFieldSummary


@dataclass(frozen=True, eq=False)
class ExperimentData:
    """What the figures of a virtual experiment are drawn from, snapshots by ascending strain."""

    solution: Solution
    images: ImageSet
    strains: Sequence[float]
    """Nominal strain of each snapshot [-]."""
    results: Sequence[Result]
    comparisons: Sequence[Comparison]
    """Of each with the truth; may still be computed."""
    spectra: Sequence[tuple[Spectrum, WavePattern]]
    """Of each its spectral densities and what is read off them; may still be computed."""
    pitch: float
    """Unit cell size l [mm]."""
    wholes: Sequence[tuple[WholeField, WholeFieldSummary]] = ()
    """Of each the whole displacement and its errors, if measured; may still be computed."""

    @cached_property
    def states(self) -> list[SnapshotState]:
        """All snapshots."""
        boundary, images = MeshBoundary.of(self.solution.mesh), self.images
        view = fits.SpecimenView(boundary, images.grid, images.mask(), self.pitch)
        return [
            SnapshotState(f"{round(1e4 * strain):04d}", self._label(strain), view, result,
                          partial(self._densities, k), self, k)
            for k, (strain, result) in enumerate(zip(self.strains, self.results, strict=True))
        ]  # fmt: skip

    @property
    def modes(self) -> int:
        """How many modes every snapshot has."""
        return min(len(result.ansatz.modes) for result in self.results)

    def _label(self, strain: float) -> str:
        critical = self.solution.info.get("critical")
        at = None if critical is None else critical["strain"]
        return snapshot_label(strain, self.solution.at(strain).branch, at)

    @cached_property
    def _density_end(self) -> float:
        return fits.largest_density(self.spectra)

    def _densities(self, k: int) -> tuple[Spectrum, WavePattern, float]:
        return (*self.spectra[k], self._density_end)


@dataclass(frozen=True, eq=False)
class SnapshotState(fits.FittedState):
    """A snapshot: number ``k`` of ``data``."""

    data: ExperimentData
    k: int

    @property
    def comparison(self) -> Comparison:
        """With the truth."""
        return self.data.comparisons[self.k]


def snapshot_label(strain: float, branch: str, critical: float | None) -> str:
    """What a snapshot is called on the page; strains [-], None without a critical one."""
    if branch != "primary":
        state = "After buckling"
    elif critical is None:
        state = "Deformed"
    else:
        state = "Before buckling" if strain < critical else "Unstable path"
    return f"{state} · {100 * strain:.4g} %"


def draw_hero(state: SnapshotState) -> Figure:
    """The deformed image turning into the pattern that was measured in it."""
    images, strain = state.data.images, state.data.strains[state.k]
    map_frame = state.view.map_frame()
    if fits.has_mode(0)(state):
        length = fits.UM * lengths(pattern_field(state.result, map_frame.grid))
    else:
        length = map_frame.average(fits.UM * lengths(state.comparison.w))
    end = ColourScale.size(state.view.on_material(length), "µm")
    return draw_blend(
        map_frame, images.deformed(strain), images.deformed_mask(strain), images.grid, length,
        ColourScale(style.GLOW, 0.0, end.high, "µm"), state.motion,
    )  # fmt: skip


def _image(state: SnapshotState) -> Figure:
    images, strain = state.data.images, state.data.strains[state.k]
    return draw_image(
        state.view.map_frame(), images.deformed(strain), images.deformed_mask(strain), images.grid,
        state.data.solution.at(strain).displacement,
    )  # fmt: skip


def _residual(state: SnapshotState) -> Figure:
    map_frame = state.view.map_frame(fits.FINE)
    residual = map_frame.sample(state.comparison.residual)
    return draw_field(map_frame, residual, ColourScale.signed(residual, "", 0.99), state.motion)


def _length_of(name: str) -> Callable[[SnapshotState], Figure]:
    """The length of one of the comparison's vector fields."""

    def draw(state: SnapshotState) -> Figure:
        field: FloatArray = getattr(state.comparison, name)
        return fits.draw_length(state, state.view.map_frame().average(lengths(field)))

    return draw


_WHOLE_MAPS: WholeMaps[SnapshotState] = WholeMaps(
    lambda state: state.data.wholes[state.k][0], lambda state: state.comparison,
    lambda state: len(state.data.wholes) > 0,
)  # fmt: skip


def snapshot_panels(modes: int) -> list[fits.Panel[SnapshotState]]:
    """Every quantity that is drawn of a snapshot, for an ansatz of so many modes."""
    spectra, fields = ("spect_virt", "virt") if modes <= 1 else ("", "")  # the paper has one
    return [
        fits.Panel.of("images", "image", _image, figure=spectra),
        *fits.spectrum_panels("images", spectra, "snapshots", fits.always),
        *fits.ansatz_panels("found", fields, modes),
        fits.Panel.of("errors", "residual", _residual, figure=fields, exact=True, late=True),
        fits.Panel.of("errors", "w", _length_of("w"), figure=fields, late=True),
        fits.Panel.of("errors", "best", _length_of("best_error"), late=True),
        fits.Panel.of("errors", "loss", _length_of("idic_to_best"), late=True),
        *_WHOLE_MAPS.panels(fields, "whole-w"),
    ]
