"""What was found in photographs of a test: result types, and how the stages' outcomes fill them.

Every result with its error bars, by noise and by model error; spectra; the onset of the pattern.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.photograph.geometry import Geometry
from modeharvest.idic.photograph.measure import MeasuredPhotograph, image_noise, residual_test
from modeharvest.idic.result import Result
from modeharvest.idic.solver.noise import CameraNoise
from modeharvest.idic.solver.residual_test import ResidualTest
from modeharvest.idic.spectra.pattern import WavePattern, read_pattern
from modeharvest.idic.spectra.spectrum import Spectrum, measured_spectrum
from modeharvest.idic.uncertainty.covariance import FieldErrors, covariance, field_errors
from modeharvest.idic.uncertainty.identifiability import Identifiability, identifiability
from modeharvest.imaging.distortion.lens import Distortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.prepare import Optics, PreparedPhotographs
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.validation.onset import Buckling, ImageAmplitude, mean_strain
from modeharvest.validation.whole_field import WholeField, WholeFieldSummary


@dataclass(frozen=True, eq=False)
class PartSpectrum:
    """Spectrum of a part of the specimen that has modes of its own, and the pattern read off it."""

    name: str
    spectrum: Spectrum
    """Of the displacement there without its affine part."""
    pattern: WavePattern


@dataclass(frozen=True, eq=False)
class HarvestedFrame:
    """What was found in one deformed photograph."""

    name: str
    """Differs from all others'."""
    strain_x: float
    strain_y: float
    """Mean nominal compression of the cellular part [-]."""
    image: FloatImage
    mask: BoolArray | None
    """(rows, cols) the photograph, free from distortion [grey levels], and True on its material;
    None if not known. May be memory-mapped."""
    result: Result
    identifiability: Identifiability
    residual_test: ResidualTest
    error_x: FloatArray
    error_y: FloatArray
    """(p,) and (q,) axes [mm] of the error bars."""
    by_noise: FieldErrors
    """Error bars on these axes by the images' noise, arrays (q, p, ...)."""
    by_model_error: FieldErrors | None = None
    """Error bars by model error, likewise; None if they can't be had."""
    spectrum: Spectrum | None = None
    """Of the displacement without its affine part."""
    pattern: WavePattern | None = None
    """What is read off the spectrum."""
    parts: tuple[PartSpectrum, ...] = ()
    """Spectrum and pattern of every part that has modes of its own, in one order for all
    photographs."""
    local: LocalField | None = None
    whole: WholeField | None = None
    """The whole displacement, if it was measured."""
    start_text: tuple[str, ...] = ()
    """Where the correlation started from."""
    warnings: tuple[str, ...] = ()

    @property
    def modes(self) -> range:
        """Numbers of the modes, from 0."""
        return range(len(self.result.ansatz.modes))


@dataclass(frozen=True)
class TruthCheck:
    """What was obtained against what is expected, both in ``unit`` or in words."""

    quantity: str
    obtained: float | str
    expected: float | str
    ok: bool
    """Whether the first is as good as the second asks for."""
    unit: str = ""

    @classmethod
    def at_most(cls, quantity: str, obtained: float, limit: float, unit: str) -> TruthCheck:
        """A number that must not be above a limit."""
        return cls(quantity, obtained, f"≤ {limit:g}", obtained <= limit, unit)


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """The truth of one frame, in the reference frame."""

    displacement: NDArray[Any]
    """(rows, cols, 2) [mm], NaN off the material; may be memory-mapped."""
    best: Result
    """The best fit of the frame's ansatz to it."""
    whole: WholeFieldSummary | None = None
    """How far from it the whole displacement is, if that was measured."""


@dataclass(frozen=True, eq=False)
class HarvestTruth:
    """The truth of photographs that were made by a simulation."""

    frames: Mapping[str, FrameTruth]
    """By their names, some may be missing."""
    distortion: Distortion | None = None
    rows: tuple[TruthCheck, ...] = ()
    """What was found against what is true."""


@dataclass(frozen=True, eq=False)
class Harvest:
    """All that the report of a harvest shows; what is None or empty is left out."""

    case: PhotographCase
    geometry: Geometry
    """The reference's material, holes and cellular part, on the pixels of the ideal images."""
    reference: FloatImage
    """(rows, cols) the photograph of the undeformed state, free from distortion [grey levels]."""
    frames: tuple[HarvestedFrame, ...]
    """In the order of the test."""
    noise: CameraNoise
    skipped: tuple[tuple[str, str], ...] = ()
    """Names of photographs that were not used, and why."""
    timeline: Sequence[ImageAmplitude] = ()
    """In the order of the test."""
    buckling: Buckling | None = None
    optics: Optics = field(default_factory=Optics)
    full_scale: float | None = None
    """Largest grey level of the camera; None if not known."""
    text: tuple[str, ...] = ()
    """What was done to the photographs and found in them, in words."""
    truth: HarvestTruth | None = None
    command: str = "modeharvest harvest EXPERIMENT.toml"
    toml: str = ""
    """Both make this page again; the case's values are shown if ``toml`` is empty."""
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def grid(self) -> PixelGrid:
        """The pixels of the ideal images."""
        return self.geometry.grid

    @property
    def mask(self) -> BoolArray:
        """(rows, cols) True on material of the reference."""
        return self.geometry.mask

    @property
    def pitch(self) -> float:
        """Unit cell size l [mm]."""
        return self.case.specimen.cell_size


_ALONG = 120
"""Points of the error bars along the longer side: they are as smooth as the ansatz."""


def harvested_frame(
    case: PhotographCase,
    prepared: PreparedPhotographs,
    geometry: Geometry,
    name: str,
    measured: MeasuredPhotograph,
) -> HarvestedFrame:
    """One photograph's measurement, with its error bars and spectra."""
    result, pair, cell = measured.result, prepared.pair(name), case.specimen.cell_size
    box = geometry.region.cellular
    x, y = _axes(geometry.region.domain)
    noise, edge_px = image_noise(pair, prepared.noise), case.correlation.edge_px
    found = covariance(result, pair, noise, cell, edge_px)
    by_model_error = found.by_model_error
    along, across = mean_strain(result, box)
    spectrum = measured_spectrum(measured.local, cell, box)
    pattern = read_pattern(spectrum)
    parts = geometry.parts if len(geometry.parts) > 1 else ()
    own = {part.name: measured_spectrum(measured.local, cell, part.box) for part in parts}
    return HarvestedFrame(
        name=name,
        strain_x=along,
        strain_y=across,
        image=pair.deformed,
        mask=pair.deformed_mask,
        result=result,
        identifiability=identifiability(result, pair.mask),
        residual_test=residual_test(result, pair, noise, edge_px),
        error_x=x,
        error_y=y,
        by_noise=field_errors(result, x, y, found.by_noise),
        by_model_error=None
        if by_model_error is None
        else field_errors(result, x, y, by_model_error),
        spectrum=spectrum,
        pattern=pattern,
        parts=tuple(PartSpectrum(name, s, read_pattern(s)) for name, s in own.items()),
        local=measured.local if case.local.code != "none" else None,
        start_text=tuple(s for s in measured.text if s not in pattern.text),
        warnings=found.warnings,
    )


def amplitude_of(frame: HarvestedFrame, cellular: Box) -> ImageAmplitude:
    """A frame's place on the time line."""
    identified, noise = frame.identifiability, rms_errors(frame, frame.by_noise, cellular)
    return ImageAmplitude(
        name=frame.name,
        strain=frame.strain_x,
        amplitude_px=float(np.linalg.norm(identified.amplitude_px)),
        model_error_px=identified.model_error_px,
        noise_px=noise.get("fluctuation", 0.0),
    )


def rms_errors(frame: HarvestedFrame, errors: FieldErrors, box: Box) -> dict[str, float]:
    """Rms standard deviation per component over a box [px], by field; of the pattern with modes."""
    rows = (box.y_min <= frame.error_y) & (frame.error_y <= box.y_max)
    cols = (box.x_min <= frame.error_x) & (frame.error_x <= box.x_max)
    inside, px = np.ix_(rows, cols), frame.result.grid.pixel_size
    squares = {"v0": errors.v0**2, "displacement": errors.displacement**2}
    if frame.modes:
        squares["fluctuation"] = (errors.fluctuation**2).sum(axis=0)
    return {name: float(np.sqrt(np.mean(part[inside]))) / px for name, part in squares.items()}


def _axes(domain: Box) -> tuple[FloatArray, FloatArray]:
    """Positions over the specimen, about as dense both ways [mm]."""
    across, up = (max(2, round(_ALONG * half / max(domain.half)) + 1) for half in domain.half)
    return (
        np.linspace(domain.x_min, domain.x_max, across, dtype=np.float64),
        np.linspace(domain.y_min, domain.y_max, up, dtype=np.float64),
    )
