"""A test of which there are photographs: everything a harvest needs, read from a TOML file.

::

    title = "..."
    [images]          # files of the reference, of the deformed states, of repeated exposures
    [scale]           # pixel size, or a line drawn in the reference and its length
    [specimen]        # cell size; region and material, if they are not to be found
    [[specimen.regions]]    # parts with patterns of their own, if there are several
    [distortion]      # of the optics: a file, a camera, or calibration images
    [local]           # a displacement field of a local DIC, for spectra and w
    [noise]           # of the camera, if it is known
    [correlation]     # the ansatz and how to correlate

Only files, scale and cell size must be there. Paths are relative to the TOML file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modeharvest.case_file import CaseModel, checked, read_tables
from modeharvest.errors import InputError
from modeharvest.harvest.options import LocalTable, Measurement, NoiseTable
from modeharvest.typed import plain

Corners = tuple[tuple[float, float], ...]


def _require_area(corners: Corners, where: str) -> None:
    """Raise InputError unless at least three corners [px] are a pixel or more off one line."""
    if len(corners) < 3:
        raise InputError(
            f"{where}: expected a polygon of at least three corners [column, row], got "
            f"{len(corners)}; add the others, or leave it out"
        )
    (x, y), *others = corners
    sides = [(other_x - x, other_y - y) for other_x, other_y in others]
    along_x, along_y = max(sides, key=lambda side: math.hypot(*side))
    length = math.hypot(along_x, along_y)
    width = max(abs(along_x * v - along_y * u) for u, v in sides) / length if length else 0.0
    if not width >= 1.0:  # NaN neither
        raise InputError(
            f"{where}: expected a polygon with an area, got {len(corners)} corners on one line, "
            f"from {list(min(corners))} to {list(max(corners))} [column, row]; correct them"
        )


@dataclass(frozen=True)
class Images:
    """The photographs.

    Parameters
    ----------
    reference
        File of the undeformed state.
    deformed
        Files of the deformed states in the order of the test; a name may hold wildcards, whose
        matches come in the order of their names.
    repeats
        Further exposures of the undeformed state, from which the camera's noise is measured.
    """

    reference: str = ""
    deformed: tuple[str, ...] = ()
    repeats: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.reference or not self.deformed:
            raise InputError(
                "images: expected a reference and at least one deformed image, got "
                f"reference = {self.reference!r} and {len(self.deformed)} deformed"
            )


@dataclass(frozen=True)
class Scale:
    """How large a pixel is.

    Parameters
    ----------
    pixel_size
        [mm/px].
    line
        Instead of it, the two ends ((column, row), (column, row)) of a line in the reference
        image [px] ...
    length
        ... and its length [mm].
    """

    pixel_size: float | None = None
    line: Corners | None = None
    length: float | None = None

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
            raise InputError(f"scale: expected a positive size, got {self.mm_per_px} mm/px")

    @property
    def mm_per_px(self) -> float:
        """Pixel size [mm/px]."""
        if self.line is not None and self.length is not None:
            return self.length / math.dist(*self.line)
        return float(self.pixel_size or 0.0)


@dataclass(frozen=True)
class RegionTable:
    """A part of the specimen with a pattern, and modes, of its own.

    Parameters
    ----------
    name
        In the report.
    polygon
        Corners (column, row) in the reference image [px]; the modes live in the box around them.
    """

    name: str = ""
    polygon: Corners = ()

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError("specimen.regions: expected a name for each, got one without")
        _require_area(self.polygon, f"specimen.regions {self.name!r}")


@dataclass(frozen=True)
class SpecimenTable:
    """What is known of the specimen beforehand.

    Parameters
    ----------
    cell_size
        l [mm], the distance of neighbouring holes.
    polygon
        Corners (column, row) of the cellular part in the reference image [px]; found from the
        holes otherwise.
    cells
        Or a mask image of the cellular part, white inside.
    material
        Mask image of the reference's material, white on it; found from the image otherwise.
    deformed_material
        The same of each deformed image, in their order; names may hold wildcards.
    regions
        Parts of the cellular part whose patterns differ; by default it has one pattern.
    """

    cell_size: float = math.nan
    polygon: Corners = ()
    cells: str = ""
    material: str = ""
    deformed_material: tuple[str, ...] = ()
    regions: tuple[RegionTable, ...] = ()

    def __post_init__(self) -> None:
        if not self.cell_size > 0:
            raise InputError(
                f"specimen: expected a cell_size above 0 mm, got {self.cell_size}; it is the "
                "distance of neighbouring holes"
            )
        if self.polygon:
            _require_area(self.polygon, "specimen.polygon")
        if self.polygon and self.cells:
            raise InputError(
                f"specimen: expected a polygon or a mask image 'cells', got both, cells = "
                f"{self.cells!r}"
            )
        names = [region.name for region in self.regions]
        if len(set(names)) < len(names):
            raise InputError(
                f"specimen.regions: expected names that differ, got {', '.join(names)}"
            )


@dataclass(frozen=True)
class DistortionTable:
    """The optics' distortion S of the paper's Eq. (r2); none by default.

    Parameters
    ----------
    file
        A distortion written by modeharvest (JSON).
    calibration
        Images of a speckle target under rigid shifts of the stage; the first is the one that
        the others are shifted from. Names may hold wildcards.
    shifts
        Their shifts (along columns, along rows) [px], if known, the first (0, 0) included.
    """

    file: str = ""
    calibration: tuple[str, ...] = ()
    shifts: Corners = ()

    def __post_init__(self) -> None:
        if self.file and self.calibration:
            raise InputError("distortion: expected a file or calibration images, got both")
        if self.shifts and not self.calibration:
            raise InputError("distortion: expected calibration images for the shifts, got none")


class Experiment(CaseModel):
    """Photographs of a test, and what is known of it."""

    images: Images
    scale: Scale
    specimen: SpecimenTable
    distortion: DistortionTable = DistortionTable()
    local: LocalTable = LocalTable()
    noise: NoiseTable = NoiseTable()
    correlation: Measurement = Measurement()

    def plain(self) -> dict[str, Any]:
        """The experiment as plain JSON values."""
        return {name: plain(getattr(self, name)) for name in type(self).model_fields}


def read_experiment(path: Path | str) -> Experiment:
    """Read an experiment's TOML file; its files are found beside it.

    Raises
    ------
    InputError
        If there is no such file, a key is unknown or missing, a value is out of its range, or
        a file it names is not there.
    """
    return checked(Experiment, read_tables(path), path)
