"""How a specimen's images are correlated: degrees, start, options; from a specimen to an ansatz."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz, require_degrees
from modeharvest.idic.brightness import Brightness
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import CorrelationOptions
from modeharvest.idic.fourier import FourierMode, square_family
from modeharvest.idic.support import Taper

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Identification:
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
