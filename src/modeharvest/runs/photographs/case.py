"""Photographs of a test as a case: everything a harvest needs, read from a TOML file.

Only files, scale and cell size must be there. Paths are relative to the TOML file. The shipped
``cases/photographs.toml`` has every table and key, commented.
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
    """The local DIC that spectra and w are taken from."""

    code: str = "none"
    """Either "none", "pyvale" (an optional package), or "file" for fields of any other code."""
    files: tuple[str, ...] = ()
    """With code = "file": a field for each deformed image, or one file of Ncorr with all."""
    unit: str = "auto"
    y_axis: str = "auto"
    """Of the files, "px" or "mm", and "down" or "up"; "auto" as they themselves say."""
    first_pixel: int | None = None
    """What the files call the first pixel, 0 or 1; None as their code does."""
    columns: dict[str, str | int] = field(default_factory=dict)
    """Names, or numbers from 1, of the files' columns for "x", "y", "u" and "v", where they can't
    be known by themselves."""
    subset: int = 21
    step: int = 5
    """Edge of the subsets, odd, and their distance [px], with code = "pyvale"."""

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
        SubsetOptions(self.subset, self.step)  # checks them


@dataclass(frozen=True)
class ContourTable:
    """Contours of a speckled specimen as a second measurement of its modes."""

    measure: bool = False
    """Whether they are measured, too."""


@dataclass(frozen=True)
class NoiseTable:
    """The camera's noise."""

    sd: float | None = None
    """Standard deviation [grey levels of the files]; measured from the repeated exposures
    otherwise, or estimated from the reference image."""

    def __post_init__(self) -> None:
        if self.sd is not None:
            require_within("noise: expected sd [grey levels]", self.sd, 0, above=True)


@dataclass(frozen=True)
class Images(FrameChoice):
    """The photographs."""

    reference: str = ""
    """A file; or a video's first frame, and with test.mp4#12 that one."""
    deformed: tuple[str, ...] = ()
    """Files of the deformed states in the order of the test, folders or videos; a name may have
    wildcards, whose matches come in the order of the numbers in their names."""
    repeats: tuple[str, ...] = ()
    """Further exposures of the undeformed state, from which the noise is measured."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.reference or not self.deformed:
            raise InputError(
                "images: expected a reference and at least one deformed image, got "
                f"reference = {self.reference!r} and {len(self.deformed)} deformed"
            )


@dataclass(frozen=True)
class ImageScale:
    """How large a pixel is: its size, or a line in the reference and its length."""

    pixel_size: float | None = None
    """[mm/px]."""
    line: Corners | None = None
    """Its two ends ((column, row), (column, row)) [px]."""
    length: float | None = None
    """Of the line [mm]."""

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
    """The optics' distortion S of the paper's Eq. (r2); none by default."""

    file: str = ""
    """A distortion written by modeharvest (JSON)."""
    calibration: tuple[str, ...] = ()
    """Images of a speckle target under rigid shifts of the stage; the first is the one that the
    others are shifted from. Names may have wildcards."""
    shifts: Corners = ()
    """Their shifts (along columns, along rows) [px], if known, the first (0, 0) included."""

    def __post_init__(self) -> None:
        if self.file and self.calibration:
            raise InputError("distortion: expected a file or calibration images, got both")
        if self.shifts and not self.calibration:
            raise InputError("distortion: expected calibration images for the shifts, got none")


class PhotographCase(CaseModel):
    """Photographs of a test, and what is known of it."""

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
        """The folder that files' names are relative to."""
        return self._base

    @property
    def sequence(self) -> ChosenFrames | None:
        """How its photographs were found and chosen; None before that."""
        return self._sequence

    def of_frames(self, sequence: ChosenFrames) -> Self:
        """The same case, its photographs those that were chosen; :meth:`plain` is as it was."""
        reference, *deformed = (str(p.absolute()) for p in (sequence.reference, *sequence.deformed))
        names = tuple(map(glob.escape, deformed))
        images = replace(self.images, reference=reference, deformed=names)
        case = self.model_copy(update={"images": images})
        case._written, case._sequence = self._written or self.images, sequence
        return case

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values, with the photographs' names as they were written."""
        plain = super().plain()
        return plain if self._written is None else plain | {"images": to_plain(self._written)}

    @classmethod
    def read(cls, name: str | Path) -> Self:
        """Read a case as every other; the files it names are found beside its own."""
        case = super().read(name)
        case._base = Path(name).parent
        return case
