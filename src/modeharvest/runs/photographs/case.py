"""Photographs of a test as a case: everything a harvest needs, read from a TOML file.

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
``EXAMPLE`` is such a file with every table and key, commented.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from modeharvest.idic.photograph.geometry import Corners, SpecimenTable
from modeharvest.idic.setup import PhotographOptions
from modeharvest.runs.case import CaseModel, checked, read_tables
from modeharvest.util.errors import InputError
from modeharvest.util.typed import nearest, plain

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
        "px" or "mm", of the files; "auto" as their columns' names say.
    y_axis
        "down" or "up", of the files; "auto" as their columns' names say.
    first_pixel
        What the files call the first pixel, 0 or 1.
    columns
        Names, or numbers from 1, of the files' columns for "x", "y", "u" and "v", where they
        can't be known by themselves.
    subset, step
        Edge of the subsets, odd, and their distance [px], with code = "pyvale".
    """

    code: str = "none"
    files: tuple[str, ...] = ()
    unit: str = "auto"
    y_axis: str = "auto"
    first_pixel: int = 0
    columns: dict[str, str | int] = field(default_factory=dict)
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
        if self.unit not in ("auto", "px", "mm") or self.y_axis not in ("auto", "down", "up"):
            raise InputError(
                "local: expected unit 'auto', 'px' or 'mm' and y_axis 'auto', 'down' or 'up', got "
                f"{self.unit!r} and {self.y_axis!r}"
            )
        if self.first_pixel not in (0, 1):
            raise InputError(f"local: expected first_pixel 0 or 1, got {self.first_pixel}")
        if self.subset < 5 or self.subset % 2 == 0 or self.step < 1:
            raise InputError(
                "local: expected an odd subset >= 5 px and step >= 1 px, got "
                f"{self.subset} and {self.step}"
            )


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
class ImageScale:
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


class PhotographCase(CaseModel):
    """Photographs of a test, and what is known of it."""

    images: Images
    scale: ImageScale
    specimen: SpecimenTable
    distortion: DistortionTable = DistortionTable()
    local: LocalTable = LocalTable()
    noise: NoiseTable = NoiseTable()
    correlation: PhotographOptions = PhotographOptions()

    def plain(self) -> dict[str, Any]:
        """The experiment as plain JSON values."""
        return {name: plain(getattr(self, name)) for name in type(self).model_fields}


def read_photograph_case(path: Path | str) -> PhotographCase:
    """Read an experiment's TOML file; its files are found beside it.

    Raises
    ------
    InputError
        If there is no such file, a key is unknown or missing, a value is out of its range, or
        a file it names is not there.
    """
    return checked(PhotographCase, read_tables(path), path)


EXAMPLE = """\
# Photographs of a test, for: modeharvest harvest experiment.toml --out DIR
# What stands here must be given. Lines behind "#" are options with their defaults or, marked by
# "e.g.", examples. Names of files are relative to this file, and may hold wildcards.
# Positions are [column, row] in px from the middle of the photograph's upper left pixel.

title = "Compression test"

[images]
reference = "reference.tif"          # the undeformed state: TIFF, PNG or JPEG
deformed = ["deformed_*.tif"]        # in the order of the test
# repeats = []                       # more exposures of the reference: they measure the noise

[scale]                              # one of the two:
pixel_size = 0.0125                  # mm/px
# line = [[100, 80], [900, 80]]      # e.g. the ends of a line in the reference ...
# length = 10.0                      # e.g. and its length in mm

[specimen]
cell_size = 1.9                      # mm, the distance of neighbouring holes
# polygon = []                       # corners of the cellular part; found from the holes
# cells = ""                         # or a mask image of it, white inside
# material = ""                      # mask image of the reference's material; found from the image
# deformed_material = []             # and of each deformed image's

# [[specimen.regions]]               # only for parts with patterns of their own, each its table:
# name = "upper half"                # e.g.
# polygon = [[200, 100], [1800, 100], [1800, 900], [200, 900]]   # e.g.

[distortion]                         # of the lens; none, a file, or images to calibrate from
# file = ""                          # JSON of modeharvest, OpenCV's YAML or XML, DICe's XML
# calibration = []                   # images of a speckle target, shifted in its plane
# shifts = []                        # their shifts [along columns, along rows] in px, if known

[local]                              # a local DIC, for spectra and for what the modes leave over
# code = "none"                      # "none", "pyvale", or "file" for fields of any other code
# files = []                         # one for each deformed image: CSV, NPZ, HDF5, MAT
# unit = "auto"                      # of the files: "px", "mm", "auto" as their columns' names say
# y_axis = "auto"                    # of the files: "down", "up", "auto"
# first_pixel = 0                    # what the files call the first pixel, 0 or 1
# columns = {}                       # where names don't tell: { x = 1, y = 2, u = "dX", v = "dY" }
# subset = 21                        # px, odd; with "pyvale"
# step = 5                           # px; with "pyvale"

[noise]
# sd = 2.0                           # e.g. grey levels; else from the repeats, or estimated

[correlation]
# v0_degree = 5                      # total degree of the smooth field v0
# v_degree = 6                       # of every mode's amplitude
# family = "auto"                    # "auto" from the spectrum, or "square": the paper's Eq. (mode)
# fixed_mode = "auto"                # "auto" where no pattern is seen, true or false
# gain_degree = 0                    # e.g. the light changes between the photographs: by a factor
# offset_degree = 0                  # e.g. and by a summand; higher degrees for uneven changes
# edge_px = 3                        # rim of the material that is not compared
# order = 5                          # e.g. of the spline: 3, 5 or 11; else as the speckle asks for
# formulation = "total"              # "total", or "updated" for speckles that change on the way
"""
