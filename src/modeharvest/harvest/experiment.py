"""A test of which there are photographs: everything a harvest needs, read from a TOML file.

::

    title = "..."
    [images]          # files of the reference, of the deformed states, of repeated exposures
    [scale]           # pixel size, or a line drawn in the reference and its length
    [specimen]        # cell size; region and material, if they are not to be found
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

from modeharvest.case_file import CaseModel, checked, nearest, plain, read_tables
from modeharvest.errors import InputError
from modeharvest.idic.brightness import Brightness
from modeharvest.idic.correlate import CorrelationOptions

Corners = tuple[tuple[float, float], ...]


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
        The same of each deformed image, in their order.
    """

    cell_size: float = math.nan
    polygon: Corners = ()
    cells: str = ""
    material: str = ""
    deformed_material: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.cell_size > 0:
            raise InputError(
                f"specimen: expected a cell_size above 0 mm, got {self.cell_size}; it is the "
                "distance of neighbouring holes"
            )
        if self.polygon and (self.cells or len(self.polygon) < 3):
            raise InputError(
                "specimen: expected a polygon of at least three corners or a mask image 'cells', "
                f"got {len(self.polygon)} corners and cells = {self.cells!r}"
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

    @property
    def is_given(self) -> bool:
        """Whether there is any."""
        return bool(self.file or self.calibration)


LOCAL = ("none", "pyvale", "file")


@dataclass(frozen=True)
class LocalTable:
    """The local DIC that spectra and w are taken from.

    Parameters
    ----------
    code
        "none", "pyvale" (an optional package), or "file" for fields of any other code.
    files
        A field for each deformed image (CSV, NPZ, HDF5, MAT), with code = "file".
    unit
        "px" or "mm", of the files.
    y_axis
        "down" or "up", of the files.
    subset, step
        Edge of the subsets, odd, and their distance [px], with code = "pyvale".
    """

    code: str = "none"
    files: tuple[str, ...] = ()
    unit: str = "px"
    y_axis: str = "down"
    subset: int = 21
    step: int = 5

    def __post_init__(self) -> None:
        if self.code not in LOCAL:
            raise InputError(f"local: unknown code {self.code!r}{nearest(self.code, list(LOCAL))}")
        if (self.code == "file") != bool(self.files):
            raise InputError(
                "local: expected files with code = 'file' and only then, got code = "
                f"{self.code!r} and {len(self.files)} files"
            )
        if self.unit not in ("px", "mm") or self.y_axis not in ("down", "up"):
            raise InputError(
                f"local: expected unit 'px' or 'mm' and y_axis 'down' or 'up', got {self.unit!r} "
                f"and {self.y_axis!r}"
            )
        if self.subset < 5 or self.subset % 2 == 0 or self.step < 1:
            raise InputError(
                "local: expected an odd subset >= 5 px and step >= 1 px, got "
                f"{self.subset} and {self.step}"
            )


FORMULATIONS = ("total", "updated")


@dataclass(frozen=True)
class Measurement:
    """The ansatz and how to correlate; the paper's by default.

    Parameters
    ----------
    v0_degree, v_degree
        Total degrees of the polynomials.
    family
        "auto" reads the modes off the spectrum; "square" is the paper's Eq. (mode).
    hold_mode
        Hold phi1 where it starts; "auto" holds it where the pattern can't be seen.
    gain_degree, offset_degree
        Of gain and offset between the images' grey levels; "none" is written by leaving out.
    edge_px, order
        As in a correlation.
    formulation
        "total": every image against the reference. "updated": against the one before, brought
        back to the reference's frame; for speckles that change on the way.
    """

    v0_degree: int = 5
    v_degree: int = 6
    family: str = "auto"
    hold_mode: bool | str = "auto"
    gain_degree: int | None = None
    offset_degree: int | None = None
    edge_px: int = 3
    order: int = 5
    formulation: str = "total"

    def __post_init__(self) -> None:
        if self.v0_degree < 1 or self.v_degree < 0:
            raise InputError(
                "correlation: expected v0_degree >= 1 and v_degree >= 0, got "
                f"{self.v0_degree} and {self.v_degree}"
            )
        if self.family not in ("auto", "square"):
            raise InputError(
                f"correlation: expected family 'auto' or 'square', got {self.family!r}"
            )
        if self.formulation not in FORMULATIONS:
            raise InputError(
                f"correlation: unknown formulation {self.formulation!r}"
                f"{nearest(self.formulation, list(FORMULATIONS))}"
            )
        if isinstance(self.hold_mode, str) and self.hold_mode != "auto":
            raise InputError(
                f"correlation: expected hold_mode true, false or 'auto', got {self.hold_mode!r}"
            )
        self.options()
        self.brightness()

    def options(self) -> CorrelationOptions:
        """The options of :func:`modeharvest.idic.correlate.correlate`."""
        return CorrelationOptions(edge_px=self.edge_px, order=self.order)

    def brightness(self) -> Brightness:
        """Which of gain and offset are unknowns."""
        return Brightness(self.gain_degree, self.offset_degree)


@dataclass(frozen=True)
class NoiseTable:
    """The camera's noise.

    Parameters
    ----------
    sd
        Standard deviation [grey levels of the files]; measured from the repeated exposures
        otherwise, or estimated from the reference image.
    """

    sd: float | None = None

    def __post_init__(self) -> None:
        if self.sd is not None and not self.sd > 0:
            raise InputError(f"noise: expected sd above 0 grey levels, got {self.sd}")


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
