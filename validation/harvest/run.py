"""All that the report of a harvest shows: photographs, and what was found in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.agreement import Agreement
from modeharvest.idic.calibration.result import Calibration
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.error_bars import FieldErrors
from modeharvest.idic.families.pattern import Pattern
from modeharvest.idic.families.spectrum import Spectrum
from modeharvest.idic.fields.local_field import LocalField
from modeharvest.idic.identifiability import Identifiability
from modeharvest.idic.result import Result
from modeharvest.idic.specimen.hole_lattice import HoleLattice
from modeharvest.imaging.distortion.mapping import Distortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.validation.harvest.timeline import Buckling, Moment

FloatArray = NDArray[np.float64]
FloatImage = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PartSpectrum:
    """What a part of the specimen shows that has modes of its own.

    Parameters
    ----------
    name
        Of the part.
    spectrum, pattern
        Of the displacement there without its affine part, and what is read off it.
    """

    name: str
    spectrum: Spectrum
    pattern: Pattern


@dataclass(frozen=True, eq=False)
class HarvestedFrame:
    """What was found in one deformed photograph.

    Parameters
    ----------
    name
        Of the photograph; differs from all others'.
    strain_x, strain_y
        Mean nominal compression of the cellular part [-].
    image
        (rows, cols) the photograph, free from distortion [grey levels]; may be memory-mapped.
    mask
        (rows, cols) True on its material; None if not known.
    result, identifiability, agreement
        Of its correlation.
    error_x, error_y
        (p,) and (q,) axes [mm] of the error bars.
    by_noise, by_leftover
        Error bars on these axes, arrays (q, p, ...), by the images' noise and by what the ansatz
        leaves over; the latter None if they can't be had.
    noise_covariance, leftover_covariance
        (n, n) of the unknowns by the images' noise and by what the ansatz leaves over: those
        that the error bars are made of.
    spectrum, pattern
        Of the displacement without its affine part, and what is read off it.
    parts
        The same of every part that has modes of its own, in one order for all photographs.
    local
        Of a local DIC.
    start_sentences, warnings
        Where the correlation started from, and what a user should know.
    """

    name: str
    strain_x: float
    strain_y: float
    image: FloatImage
    mask: BoolArray | None
    result: Result
    identifiability: Identifiability
    agreement: Agreement
    error_x: FloatArray
    error_y: FloatArray
    by_noise: FieldErrors
    noise_covariance: FloatArray
    by_leftover: FieldErrors | None = None
    leftover_covariance: FloatArray | None = None
    spectrum: Spectrum | None = None
    pattern: Pattern | None = None
    parts: tuple[PartSpectrum, ...] = ()
    local: LocalField | None = None
    start_sentences: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        expected = (len(self.error_y), len(self.error_x), 2)
        for errors in (self.by_noise, self.by_leftover):
            if errors is not None and errors.v0.shape != expected:
                raise InputError(
                    f"harvest {self.name}: expected error bars of shape {expected} like their "
                    f"axes, got {errors.v0.shape}"
                )

    @property
    def modes(self) -> range:
        """Numbers of the modes, from 0."""
        return range(len(self.result.ansatz.modes))


@dataclass(frozen=True)
class TruthRow:
    """One line of the table that sets what was found against the truth.

    Parameters
    ----------
    quantity
        In words.
    obtained, expected
        Numbers, or words.
    ok
        Whether the first is as good as the second asks for.
    unit
        Of both; "" for none.
    """

    quantity: str
    obtained: float | str
    expected: float | str
    ok: bool
    unit: str = ""


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """The truth of one frame, in the reference frame.

    Parameters
    ----------
    displacement
        (rows, cols, 2) [mm]; NaN off the material. May be memory-mapped.
    best
        The best fit of the frame's ansatz to it.
    """

    displacement: NDArray[Any]
    best: Result


@dataclass(frozen=True, eq=False)
class HarvestTruth:
    """The truth of photographs that were made by a simulation.

    Parameters
    ----------
    frames
        By the frames' names; some may be missing.
    distortion
        The optics' true distortion.
    rows
        What was found against what is true.
    """

    frames: Mapping[str, FrameTruth]
    distortion: Distortion | None = None
    rows: tuple[TruthRow, ...] = ()


@dataclass(frozen=True, eq=False)
class Harvest:
    """All that the report of a harvest shows; what is None or empty is left out.

    Parameters
    ----------
    title
        Of the page.
    experiment
        The experiment, as plain values.
    grid
        The pixels of the ideal images.
    reference, mask
        (rows, cols) the photograph of the undeformed state, free from distortion [grey levels],
        and where it shows material.
    lattice
        The holes that were found and the lattice fitted to them.
    cellular, domain
        The part that has holes, and the box of the material [mm].
    frames
        In the order of the test.
    skipped
        Names of photographs that were not used, and why.
    timeline
        In the order of the test.
    buckling
        When the pattern appeared.
    calibration, distortion
        Of the optics; the distortion alone if it was given.
    noise_sd, noise_source
        Of each photograph [grey levels], and where that is known from.
    full_scale
        Largest grey level of the camera; None if not known.
    sentences
        What was done to the photographs and found in them, in words.
    truth
        Of photographs made by a simulation.
    command, toml
        That make this page again; the experiment's values are shown if ``toml`` is empty.
    versions
        Of software.
    """

    title: str
    experiment: Mapping[str, Any]
    grid: PixelGrid
    reference: FloatImage
    mask: BoolArray
    cellular: Box
    domain: Box
    frames: tuple[HarvestedFrame, ...]
    noise_sd: float
    noise_source: str
    lattice: HoleLattice | None = None
    skipped: tuple[tuple[str, str], ...] = ()
    timeline: Sequence[Moment] = ()
    buckling: Buckling | None = None
    calibration: Calibration | None = None
    distortion: Distortion | None = None
    full_scale: float | None = None
    sentences: tuple[str, ...] = ()
    truth: HarvestTruth | None = None
    command: str = "modeharvest harvest EXPERIMENT.toml"
    toml: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = self.grid.shape
        images = {"reference": self.reference, "mask": self.mask}
        images |= {frame.name: frame.image for frame in self.frames}
        for name, image in images.items():
            if image.shape != shape:
                raise InputError(
                    f"harvest: expected images of {shape} px like the grid, got {image.shape} for "
                    f"{name}"
                )
        if not self.frames:
            raise InputError("harvest: expected at least one deformed photograph, got none")
        names = [frame.name for frame in self.frames]
        if len(set(names)) < len(names):
            raise InputError(f"harvest: expected names that differ, got {', '.join(names)}")
        if not self.pitch > 0:
            raise InputError("harvest: expected specimen.cell_size above 0 mm in the experiment")

    @property
    def pitch(self) -> float:
        """Unit cell size l [mm]."""
        return float(self.experiment.get("specimen", {}).get("cell_size", 0.0))

    @property
    def edge_px(self) -> int:
        """Width of the rim of the material that was not compared [px]."""
        return int(self.experiment.get("correlation", {}).get("edge_px", 0))

    @property
    def lens(self) -> Distortion | None:
        """The optics' distortion, given or calibrated."""
        if self.distortion is None and self.calibration is not None:
            return self.calibration.distortion
        return self.distortion
