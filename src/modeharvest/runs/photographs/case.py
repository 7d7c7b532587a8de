"""Photographs of a test as a case: everything a harvest needs, read from a TOML file.

Only files, scale and cell size are required. Paths are relative to the TOML file. The shipped
``cases/photographs.toml`` contains every table and key, with comments.
"""

from __future__ import annotations

import glob
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from pydantic import PrivateAttr, field_validator

from modeharvest.idic.local.subsets import SubsetOptions
from modeharvest.idic.photograph.gauges import Gauge, distinct
from modeharvest.idic.photograph.geometry import Corners, SpecimenTable
from modeharvest.idic.setup import PhotographOptions
from modeharvest.runs.case import CaseModel
from modeharvest.runs.photographs.machine_log import LogTable
from modeharvest.runs.photographs.sequence import ChosenFrames, FrameChoice
from modeharvest.runs.whole_field import WholeFieldOptions
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.typed import nearest, to_plain

LOCAL = ("none", "pyvale", "file")


@dataclass(frozen=True)
class LocalTable:
    """The local DIC from whose fields spectra and w are computed."""

    code: str = "none"
    """Either "none", "pyvale" (an optional package), or "file" for fields of any other code."""
    files: tuple[str, ...] = ()
    """With code = "file": one field file for each deformed image, or one Ncorr file with all."""
    unit: str = "auto"
    y_axis: str = "auto"
    """Unit of the files ("px", "mm") and their y axis ("down", "up"); "auto": as they state it."""
    first_pixel: int | None = None
    """Number of the first pixel in the files, 0 or 1; None for the convention of their code."""
    columns: dict[str, str | int] = field(default_factory=dict)
    """Names, or numbers from 1, of the files' columns for "x", "y", "u" and "v", where they can't
    be recognised automatically."""
    subset: int = 21
    step: int = 5
    """Edge length of the subsets (odd) and their spacing [px], with code = "pyvale"."""

    def __post_init__(self) -> None:
        if self.code not in LOCAL:
            raise InputError(f"local: unknown code {self.code!r}{nearest(self.code, list(LOCAL))}")
        if (self.code == "file") != bool(self.files):
            raise InputError(
                "local: expected files with code = 'file' and only then, got code = "
                f"{self.code!r} and {len(self.files)} files"
            )
        if self.unit not in ("auto", "px", "mm") or self.y_axis not in ("auto", "down", "up"):
            raise InputError(
                "local: expected unit 'auto', 'px' or 'mm' and y_axis 'auto', 'down' or 'up', got "
                f"{self.unit!r} and {self.y_axis!r}"
            )
        require_within("local: expected a first_pixel", self.first_pixel or 0, 0, 1)
        SubsetOptions(self.subset, self.step)  # validates both


@dataclass(frozen=True)
class ContourTable:
    """Contours of a speckled specimen, as a second measurement of its modes."""

    measure: bool = False
    """Whether modes are also measured by contours."""


@dataclass(frozen=True)
class NoiseTable:
    """The camera's noise."""

    sd: float | None = None
    """Standard deviation [grey levels of the files]; if not given, it is measured from the repeated
    exposures or, without these, estimated from the reference image."""

    def __post_init__(self) -> None:
        if self.sd is not None:
            require_within("noise: expected sd [grey levels]", self.sd, 0, above=True)


@dataclass(frozen=True)
class Images(FrameChoice):
    """The photographs."""

    reference: str = ""
    """Undeformed state: an image file, a video (its first frame), or test.mp4#12 (frame 12)."""
    deformed: tuple[str, ...] = ()
    """Files of the deformed states in the order of the test, folders or videos; a name may have
    wildcards, whose matches are sorted by the numbers in their names."""
    repeats: tuple[str, ...] = ()
    """Further exposures of the undeformed state, from which the camera noise is measured."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.reference or not self.deformed:
            raise InputError(
                "images: expected a reference and at least one deformed image, got "
                f"reference = {self.reference!r} and {len(self.deformed)} deformed"
            )


@dataclass(frozen=True)
class ImageScale:
    """Scale of the images: the pixel size, or a line in the reference and its length."""

    pixel_size: float | None = None
    """Size of a pixel [mm/px]."""
    line: Corners | None = None
    """The two ends of the line in the reference, ((column, row), (column, row)) [px]."""
    length: float | None = None
    """Length of the line [mm]."""

    def __post_init__(self) -> None:
        drawn = self.line is not None and self.length is not None
        if (self.pixel_size is None) != drawn:
            raise InputError(
                "scale: expected either pixel_size [mm/px], or line = [[col, row], [col, row]] "
                f"and length [mm], got pixel_size = {self.pixel_size}, line = {self.line}, "
                f"length = {self.length}"
            )
        if self.line is not None and (len(self.line) != 2 or self.line[0] == self.line[1]):
            raise InputError(f"scale: expected a line of two different ends, got {self.line}")
        if not (self.mm_per_px > 0 and math.isfinite(self.mm_per_px)):
            raise InputError(f"scale: expected pixels above 0 mm, got {self.mm_per_px} mm/px")

    @property
    def mm_per_px(self) -> float:
        """Pixel size [mm/px]."""
        if self.line is not None and self.length is not None:
            return self.length / math.dist(*self.line)
        return float(self.pixel_size or 0.0)


@dataclass(frozen=True)
class DistortionTable:
    """The lens distortion S of the paper's Eq. (5); none by default."""

    file: str = ""
    """File of a distortion written by modeharvest (JSON)."""
    calibration: tuple[str, ...] = ()
    """Images of a speckle target under rigid shifts of the stage; the shifts of the others are
    relative to the first. Names may have wildcards."""
    shifts: Corners = ()
    """Shifts of the target images (along columns, along rows) [px], if known; first (0, 0)."""

    def __post_init__(self) -> None:
        if self.file and self.calibration:
            raise InputError("distortion: expected a file or calibration images, got both")
        if self.shifts and not self.calibration:
            raise InputError("distortion: expected calibration images for the shifts, got none")


class PhotographCase(CaseModel):
    """Photographs of a test, and the known data of the test."""

    table = "images"

    images: Images
    log: LogTable = LogTable()
    scale: ImageScale
    specimen: SpecimenTable
    distortion: DistortionTable = DistortionTable()
    local: LocalTable = LocalTable()
    noise: NoiseTable = NoiseTable()
    correlation: PhotographOptions = PhotographOptions()
    whole_field: WholeFieldOptions = WholeFieldOptions()
    contours: ContourTable = ContourTable()
    gauges: tuple[Gauge, ...] = ()

    _base: Path = PrivateAttr(Path())
    _written: Images | None = PrivateAttr(None)
    _sequence: ChosenFrames | None = PrivateAttr(None)

    @field_validator("gauges")
    @classmethod
    def _distinct(cls, gauges: tuple[Gauge, ...]) -> tuple[Gauge, ...]:
        return distinct(gauges)

    @property
    def base(self) -> Path:
        """The folder to which file names are relative."""
        return self._base

    @property
    def sequence(self) -> ChosenFrames | None:
        """The chosen photographs and how they were found; None if not yet chosen."""
        return self._sequence

    def of_frames(self, sequence: ChosenFrames) -> Self:
        """The same case with the chosen photographs; :meth:`plain` returns the same as before."""
        reference, *deformed = (str(p.absolute()) for p in (sequence.reference, *sequence.deformed))
        names = tuple(map(glob.escape, deformed))
        images = replace(self.images, reference=reference, deformed=names)
        case = self.model_copy(update={"images": images})
        case._written, case._sequence = self._written or self.images, sequence
        return case

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values, with the photographs' names as in the TOML file."""
        plain = super().plain()
        return plain if self._written is None else plain | {"images": to_plain(self._written)}

    @classmethod
    def read(cls, name: str | Path) -> Self:
        """Read a case like any other; its file names are relative to the folder of its file."""
        case = super().read(name)
        case._base = Path(name).parent
        return case
