"""Options of a measurement: degrees and brightness of the ansatz, how to correlate, the start."""

from __future__ import annotations

from dataclasses import dataclass, field

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz, require_degrees
from modeharvest.idic.modes import FourierMode, Taper, square_family
from modeharvest.idic.slow_fields import Box, Brightness
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions
from modeharvest.idic.solver.pyramid import COARSE_TO_FINE, Level
from modeharvest.idic.solver.weighting import Gradient
from modeharvest.imaging.spline import ORDERS
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.typed import nearest

_WIDEST_PX = 100


@dataclass(frozen=True)
class CorrelationOptions:
    """How to correlate.

    Parameters
    ----------
    levels
        From coarse to fine. Levels that would blur a mode away (a blur above a quarter of l)
        or leave fewer than 32 px across are skipped; the last one never is.
    edge_px
        Pixels of the reference closer than this to the edge of a hole are left out on the
        finest level [px].
    order
        Of the spline that samples the deformed image: 3, 5 or 11. By default 5, or 11 where
        speckles are narrower than 6.5 px: those a quintic displaces by up to 2e-3 px.
    gauss_newton
        Tolerances and limits.
    gradient
        What weighs the residual in the end, see :mod:`modeharvest.idic.solver.weighting`: the gradient
        of the "deformed" image at x + u (the least-squares minimum), or that of the "reference"
        at x. By default the reference's where the residual is noise, else the deformed image's.
    gradient_blur_px
        Blur of the image that this gradient is taken of, on the finest level [px]. By default
        none, unless the residual is noise: then the blur that makes the unknowns' variance
        smallest.
    """

    levels: tuple[Level, ...] = COARSE_TO_FINE
    edge_px: int = 2
    order: int | None = None
    gauss_newton: GaussNewtonOptions = field(default_factory=GaussNewtonOptions)
    gradient: str | None = None
    gradient_blur_px: float | None = None

    def __post_init__(self) -> None:
        known = [gradient.value for gradient in Gradient]
        blur = self.gradient_blur_px or 0.0
        if self.gradient not in (None, *known) or not 0.0 <= blur <= _WIDEST_PX:
            raise InputError(
                f"expected a gradient among {known} and a blur of it of 0 to {_WIDEST_PX} px, got "
                f"{self.gradient!r} and {self.gradient_blur_px}"
            )
        if not self.levels:
            raise InputError("expected at least one level from coarse to fine, got none")
        if not 0 <= self.edge_px <= _WIDEST_PX or self.order not in (None, *ORDERS):
            raise InputError(
                f"expected edge_px from 0 to {_WIDEST_PX} and order 3, 5 or 11, got "
                f"{self.edge_px} and {self.order}"
            )


FORMULATIONS = ("total", "updated")


@dataclass(frozen=True)
class PhotographOptions:
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
class SquareLatticeOptions:
    """The paper's choices (section "Virtual Experiments"), for a square stacking of holes.

    Parameters
    ----------
    v0_degree, v_degree
        Total degree of the Chebyshev polynomials of v0 and of v1: 42 + 28 unknowns, and the
        mode's 7 make 77.
    start_amplitude
        The small constant that v1 starts with [mm]; with max ||phi|| = 0.04, 1 mm is a
        pattern of 40 um.
    edge_px
        Pixels of the reference closer than this to the edge of a hole are left out [px].
    order
        Of the spline that samples the deformed image: 3, 5 or 11; None for as the speckle asks for.
    camera
        Correlate the quantised images instead of the float ones.
    hold_mode
        Hold phi1 at the ideal pattern, for images without a pattern to find it from.
    gain_degree, offset_degree
        Total degrees of a gain and of an offset between the images' grey levels; None for none.
    gradient, gradient_blur_px
        What weighs the residual: the gradient of the "deformed" image or of the "reference"; and
        the blur of what it is taken of [px]; None for as the noise asks for. See
        :class:`CorrelationOptions`.
    """

    v0_degree: int = 5
    v_degree: int = 6
    start_amplitude: float = 1.0
    edge_px: int = 2
    order: int | None = None
    camera: bool = False
    hold_mode: bool = False
    gain_degree: int | None = None
    offset_degree: int | None = None
    gradient: str | None = None
    gradient_blur_px: float | None = None

    def __post_init__(self) -> None:
        require_degrees(self.v0_degree, self.v_degree)
        if self.start_amplitude == 0.0:
            raise InputError(
                "correlation: expected a start_amplitude that is not 0 mm (the mode could not be "
                "seen), got 0"
            )
        self.options()  # checks edge_px, order and gradient
        self.brightness()

    def options(self) -> CorrelationOptions:
        """The options of :func:`modeharvest.idic.correlate.correlate`."""
        return CorrelationOptions(
            edge_px=self.edge_px,
            order=self.order,
            gradient=self.gradient,
            gradient_blur_px=self.gradient_blur_px,
        )

    def brightness(self) -> Brightness:
        """Which of gain and offset are unknowns."""
        return Brightness(self.gain_degree, self.offset_degree)

    def ansatz(self, specimen: Specimen) -> Ansatz:
        """The paper's ansatz on a specimen.

        The mode's phases put its origin on a solid junction between four holes, whatever the
        number of holes: [1, 1, 1, -1, 1, 0, 0] where it is even both ways.
        """
        (a, b), (width, height) = specimen.cellular_half_size, specimen.half_size
        x0 = 0.0 if specimen.holes_x % 2 == 0 else a % specimen.pitch
        y0 = 0.0 if specimen.holes_y % 2 == 0 else b % specimen.pitch
        family = square_family("junction").moved((x0, y0))
        taper = Taper(Box(-a, a, -b, b), 0.5 * specimen.pitch)
        mode = FourierMode.scaled(
            family.held() if self.hold_mode else family, specimen.pitch, taper
        )
        domain = Box(-width, width, -height, height)
        return Ansatz(domain, (mode,), self.v0_degree, self.v_degree, self.brightness())

    def start(self, ansatz: Ansatz, strain: float) -> FloatArray:
        """The unknowns to start from: the applied strain, and the mode as it should be."""
        return ansatz.start(strain, self.start_amplitude)
