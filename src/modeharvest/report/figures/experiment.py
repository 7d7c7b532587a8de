"""Figures of a virtual experiment: every panel of the paper's figures for every snapshot, and more.

What is drawn is listed once, in :data:`PANELS`, with its caption.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from modeharvest.fem.field import Solution
from modeharvest.idic.result import Result
from modeharvest.idic.spectra.pattern import WavePattern
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.imaging.imageset import ImageSet
from modeharvest.report.figures import maps as fields
from modeharvest.report.figures.curves import draw_density, pattern_density
from modeharvest.report.figures.maps import ColourScale, DisplacementFunction, MapFrame
from modeharvest.report.figures.style import GLOW
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.truth import Comparison, lengths, pattern_field

UM = 1e3  # micrometres in a millimetre
DRAWN_SHAPE = 0.16
"""Largest displacement that the modes are drawn with [l]."""
FINE = 740
"""Cells along a map's longer side where a field is as fine as the speckle."""


@dataclass(frozen=True, eq=False)
class ExperimentReportData:
    """All that the pictures show.

    Parameters
    ----------
    solution, images
        Of the run.
    strains, results
        Of each snapshot its nominal strain [-] and what was found, by ascending strain.
    comparisons
        Of each snapshot with the truth.
    spectra
        For each snapshot, its spectral densities and what is read off them.
    pitch
        Unit cell size l [mm].
    """

    solution: Solution
    images: ImageSet
    strains: Sequence[float]
    results: Sequence[Result]
    comparisons: Sequence[Comparison]
    spectra: Sequence[tuple[Spectrum, WavePattern]]
    pitch: float

    @cached_property
    def sheet(self) -> MapFrame:
        """The frame of smooth fields."""
        return MapFrame.of(self.solution.mesh, self.images.grid)

    @cached_property
    def fine_sheet(self) -> MapFrame:
        """The frame of fields as fine as the speckle."""
        return MapFrame.of(self.solution.mesh, self.images.grid, FINE)

    @cached_property
    def material(self) -> NDArray[np.bool_]:
        """Where there is material, on :attr:`sheet`'s grid."""
        seen = self.sheet.average(np.where(self.images.mask(), 1.0, np.nan))
        return np.asarray(np.isfinite(seen))

    @cached_property
    def density_end(self) -> float:
        """Largest density of any snapshot's pattern [mm⁶]; all densities are drawn up to it."""
        return max((pattern_density(*pair) for pair in self.spectra), default=0.0)

    @property
    def has_mode(self) -> bool:
        """Whether the ansatz has a mode to show."""
        return all(result.ansatz.modes for result in self.results)

    def shape_scale(self, k: int, i: int = 0) -> float:
        """By how much phi of mode i (from 0) of snapshot k is drawn, to displace by SHAPE l [mm]."""
        largest = lengths(self.results[k].phi(i, self.sheet.grid))
        top = float(largest.max())
        return DRAWN_SHAPE * self.pitch / top if top > 0 else 1.0


@dataclass(frozen=True)
class SnapshotPanel:
    """One quantity, drawn for every snapshot.

    Parameters
    ----------
    key
        Its name in the page.
    symbol
        HTML.
    title
        In words.
    paper
        The panel's name in the paper, empty if it has none.
    caption
        What is seen, HTML.
    draw
        Makes the picture of snapshot k.
    needs_mode
        Whether there must be a mode.
    exact
        Whether the picture's pixels are to be kept exactly.
    needs_truth
        Whether it shows a comparison, or the spectra of the truth.
    """

    key: str
    symbol: str
    title: str
    paper: str
    caption: str
    draw: Callable[[ExperimentReportData, int], Figure]
    needs_mode: bool = False
    exact: bool = False
    needs_truth: bool = False


def measured_motion(atlas: ExperimentReportData, k: int) -> DisplacementFunction:
    """The displacement that IDIC found in snapshot k."""
    result = atlas.results[k]
    return lambda x, y: result.ansatz.displacement(result.unknowns, x, y)


def _image(atlas: ExperimentReportData, k: int) -> Figure:
    images, strain = atlas.images, atlas.strains[k]
    return fields.draw_image(
        atlas.sheet, images.deformed(strain), images.deformed_mask(strain), images.grid,
        atlas.solution.at(strain).displacement,
    )  # fmt: skip


def _density(component: int) -> Callable[[ExperimentReportData, int], Figure]:
    return lambda atlas, k: draw_density(*atlas.spectra[k], component, atlas.density_end)


def _v0(component: int) -> Callable[[ExperimentReportData, int], Figure]:
    def draw(atlas: ExperimentReportData, k: int) -> Figure:
        v0 = UM * atlas.results[k].v0(atlas.sheet.grid)[..., component]
        return fields.draw_field(atlas.sheet, v0, ColourScale.signed(_on_material(atlas, v0), "µm"))

    return draw


def _v(i: int) -> Callable[[ExperimentReportData, int], Figure]:
    def draw(atlas: ExperimentReportData, k: int) -> Figure:
        result, grid = atlas.results[k], atlas.sheet.grid
        taper = result.ansatz.modes[i].taper
        support = taper.along_y(grid.y)[:, None] * taper.along_x(grid.x)[None, :]
        v = np.where(support > 0.0, UM * result.v(i, grid), np.nan)
        inside = _on_material(atlas, np.where(support == 1.0, v, np.nan))
        return fields.draw_field(
            atlas.sheet, v, replace(ColourScale.signed(inside, "µm"), extend="both")
        )

    return draw


def _phi(i: int) -> Callable[[ExperimentReportData, int], Figure]:
    def draw(atlas: ExperimentReportData, k: int) -> Figure:
        result, scale = atlas.results[k], atlas.shape_scale(k, i)
        return fields.draw_shape(
            atlas.sheet, lambda x, y: scale * result.ansatz.phi(i, result.unknowns, x, y)
        )

    return draw


def _fluctuation(component: int) -> Callable[[ExperimentReportData, int], Figure]:
    def draw(atlas: ExperimentReportData, k: int) -> Figure:
        result = atlas.results[k]
        field = UM * pattern_field(result, atlas.sheet.grid)[..., component]
        modes = range(len(result.ansatz.modes))
        return fields.draw_field(
            atlas.sheet, field, ColourScale.signed(_on_material(atlas, field), "µm"),
            lambda x, y: np.sum(
                [result.ansatz.fluctuation(i, result.unknowns, x, y) for i in modes], axis=0
            ),
        )  # fmt: skip

    return draw


def _residual(atlas: ExperimentReportData, k: int) -> Figure:
    sheet = atlas.fine_sheet
    residual = sheet.sample(atlas.comparisons[k].residual)
    return fields.draw_field(
        sheet, residual, ColourScale.signed(residual, "", 0.99), measured_motion(atlas, k)
    )


def _length_of(name: str) -> Callable[[ExperimentReportData, int], Figure]:
    """The length of one of the comparison's vector fields."""

    def draw(atlas: ExperimentReportData, k: int) -> Figure:
        comparison, sheet = atlas.comparisons[k], atlas.sheet
        length = UM * sheet.average(lengths(getattr(comparison, name)))
        scale = ColourScale.size(length, "µm", 0.998)
        return fields.draw_field(sheet, length, scale, measured_motion(atlas, k))

    return draw


def draw_hero(atlas: ExperimentReportData, k: int) -> Figure:
    """The deformed image of snapshot k turning into the pattern that was measured in it."""
    images, strain, sheet, result = atlas.images, atlas.strains[k], atlas.sheet, atlas.results[k]
    field = pattern_field(result, sheet.grid) if atlas.has_mode else atlas.comparisons[k].w
    length = UM * lengths(field)
    if not atlas.has_mode:
        length = sheet.average(length)
    end = ColourScale.size(_on_material(atlas, length), "µm")
    return fields.draw_blend(
        sheet, images.deformed(strain), images.deformed_mask(strain),
        images.grid, length, ColourScale(GLOW, 0.0, end.high, "µm"), measured_motion(atlas, k),
    )  # fmt: skip


def _on_material(atlas: ExperimentReportData, field: FloatArray) -> FloatArray:
    """The values where there is material: the polynomials mean nothing elsewhere."""
    return np.where(atlas.material, field, np.nan)


PANELS = (
    SnapshotPanel(
        "image", "", "Deformed image", "spect_virt (a)",
        "The speckle as the camera would see it. Each pixel is evaluated exactly at its reference "
        "point; nothing is interpolated from the reference image.",
        _image,
    ),
    SnapshotPanel(
        "Sxx", "S<sub>xx</sub>", "Spectral density along x", "spect_virt (b)",
        "Of the true displacement without its affine part. The colours end at the pattern's own "
        "density, the same for all snapshots; what is beyond, on the axes, comes from the "
        "specimen's edges. Rings: the wave vectors found (faint: the largest peak where there is "
        "no pattern).",
        _density(0), needs_truth=True,
    ),
    SnapshotPanel(
        "Syy", "S<sub>yy</sub>", "Spectral density along y", "spect_virt (c)",
        "A wave and its mirror image on either diagonal make four peaks at (±½, ±½): a pattern "
        "that repeats after two cells.",
        _density(1), needs_truth=True,
    ),
    SnapshotPanel(
        "v0x", "v<sub>0</sub> · e<sub>x</sub>", "Smooth field along x", "virt (a) and (i)",
        "The applied compression, a nearly linear profile.",
        _v0(0),
    ),
    SnapshotPanel(
        "v0y", "v<sub>0</sub> · e<sub>y</sub>", "Smooth field along y", "virt (b) and (j)",
        "Lateral expansion before buckling. The pattern, once it is there, undoes it near the "
        "specimen's centre: the auxetic effect. The far edges still expand.",
        _v0(1),
    ),
    SnapshotPanel(
        "v1", "v<sub>1</sub>", "Amplitude of the mode", "virt (c) and (k)",
        "Where the pattern lives; blank where φ<sub>1</sub> is zero and v<sub>1</sub> means "
        "nothing. The values are large because φ<sub>1</sub> is scaled to 0.04. Near the corners "
        "it also takes up part of the edge effect.",
        _v(0), True,
    ),
    SnapshotPanel(
        "phi1", "φ<sub>1</sub>", "The mode", "virt (d) and (l)",
        "The identified mode as a deformed configuration over the undeformed outline, enlarged "
        "to a largest displacement of 0.16 l.",
        _phi(0), True,
    ),
    SnapshotPanel(
        "flucx", "v<sub>1</sub>φ<sub>1</sub> · e<sub>x</sub>", "Correlated fluctuation along x",
        "virt (e) and (m)", "In the deformed configuration of this contribution alone.",
        _fluctuation(0), True,
    ),
    SnapshotPanel(
        "flucy", "v<sub>1</sub>φ<sub>1</sub> · e<sub>y</sub>", "Correlated fluctuation along y",
        "virt (f) and (n)", "In the deformed configuration of this contribution alone.",
        _fluctuation(1), True,
    ),
    SnapshotPanel(
        "residual", "f − g∘φ", "Residual", "virt (g) and (o)",
        "Grey levels as a fraction of full scale, in the deformed configuration; single pixels, "
        "not averages. The colours end at the 99th percentile.",
        _residual, exact=True, needs_truth=True,
    ),
    SnapshotPanel(
        "w", "‖w‖", "Microfluctuation field", "virt (h) and (p)",
        "Truth − IDIC, all that the measurement does not say, in the deformed configuration. "
        "The colours end at the 99.8th percentile.",
        _length_of("w"), needs_truth=True,
    ),
    SnapshotPanel(
        "best", "‖u − u<sub>best</sub>‖", "What the model can't say", "",
        "Truth − best fit of the same unknowns to the true displacement: no measurement with "
        "this ansatz can do better.",
        _length_of("best_error"), needs_truth=True,
    ),
    SnapshotPanel(
        "loss", "‖u<sub>IDIC</sub> − u<sub>best</sub>‖", "What the measurement loses", "",
        "IDIC − best fit: what is lost on top, on its own, smaller scale.",
        _length_of("idic_to_best"), needs_truth=True,
    ),
)  # fmt: skip


def panels_of(modes: int) -> list[SnapshotPanel]:
    """What is drawn with so many modes: two panels for each, none that needs one without."""
    panels = []
    for panel in PANELS:
        if modes or not panel.needs_mode:
            panels.append(panel if modes <= 1 else _not_of_one_mode(panel))
        if panel.key == "phi1":
            panels += [further for i in range(1, modes) for further in _mode_panels(i)]
    return panels


def _not_of_one_mode(panel: SnapshotPanel) -> SnapshotPanel:
    """A panel without what is true of the paper's single mode only."""
    symbol = panel.symbol.replace("v<sub>1</sub>φ<sub>1</sub>", "Σ v<sub>i</sub>φ<sub>i</sub>")
    caption = "" if panel.key in ("Syy", "v0y") else panel.caption
    return replace(panel, symbol=symbol, caption=caption, paper="")


def _mode_panels(i: int) -> tuple[SnapshotPanel, SnapshotPanel]:
    """Amplitude and shape of a further mode, its number from 0."""
    v, phi = f"v<sub>{i + 1}</sub>", f"φ<sub>{i + 1}</sub>"
    return (
        SnapshotPanel(f"v{i + 1}", v, "Amplitude of the mode", "", "", _v(i), True),
        SnapshotPanel(f"phi{i + 1}", phi, "The mode", "", "", _phi(i), True),
    )
