"""How a harvest measures: the ansatz, the local DIC beside it, the camera's noise."""

from __future__ import annotations

from dataclasses import dataclass, field

from modeharvest.errors import InputError
from modeharvest.idic.ansatz import require_degrees
from modeharvest.idic.brightness import Brightness
from modeharvest.idic.correlate import CorrelationOptions
from modeharvest.typed import nearest

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
    order: int | None = None
    formulation: str = "total"

    def __post_init__(self) -> None:
        require_degrees(self.v0_degree, self.v_degree)
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
