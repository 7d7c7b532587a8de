"""Options of a measurement: the ansatz, the correlation, and the tables of experiments' files."""

from __future__ import annotations

from dataclasses import dataclass, field

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz, AnsatzOptions
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions
from modeharvest.idic.solver.pyramid import COARSE_TO_FINE, Level
from modeharvest.idic.solver.weighting import Gradient
from modeharvest.imaging.spline import ORDERS
from modeharvest.util.errors import InputError
from modeharvest.util.typed import nearest, picked

_WIDEST_PX = 100
FORMULATIONS = ("total", "updated")


@dataclass(frozen=True)
class CorrelationOptions:
    """Options of a correlation: levels, pixels left out, spline, tolerances, weights, smoothing."""

    levels: tuple[Level, ...] = COARSE_TO_FINE
    """Levels from coarse to fine. Those that would blur a mode away (a blur above a quarter of l)
    or leave fewer than 32 px across are skipped, except the last one."""
    edge_px: int = 2
    """Pixels of f closer than this to a hole's edge are left out on the finest level [px]."""
    order: int | None = None
    """Order of the spline that samples the deformed image: 3, 5 or 11. By default 5, or 11 for
    speckles narrower than 6.5 px, which a quintic spline displaces by up to 2e-3 px."""
    gauss_newton: GaussNewtonOptions = field(default_factory=GaussNewtonOptions)
    """Tolerances and limits of the Gauss-Newton iteration."""
    gradient: str | None = None
    """Gradient that weighs the residual in the end, see :mod:`modeharvest.idic.solver.weighting`:
    that of the "deformed" image at x + u (the least-squares minimum), or that of the "reference" at
    x. By default "reference" if the residual is noise or speckle is below 4 px, else "deformed"."""
    gradient_blur_px: float | None = None
    """Blur of the image before this gradient is taken, on the finest level [px]. By default none,
    or where the residual is noise, the blur that minimises the variance of the unknowns."""
    final_smoothing_px: float | None = 0.0
    """Blur of both images, which are locally normalised too [px]. None chooses it from the model
    error on the last coarse level, as for photographs, and applies it on the finest level alone.
    See :mod:`modeharvest.idic.solver.final_smoothing`."""

    def __post_init__(self) -> None:
        known = [gradient.value for gradient in Gradient]
        blur = self.gradient_blur_px or 0.0
        if self.gradient not in (None, *known) or not 0.0 <= blur <= _WIDEST_PX:
            raise InputError(
                f"expected a gradient among {known} and a blur of it of 0 to {_WIDEST_PX} px, got "
                f"{self.gradient!r} and {self.gradient_blur_px}"
            )
        if not 0.0 <= (self.final_smoothing_px or 0.0) <= _WIDEST_PX:
            raise InputError(
                f"expected a final smoothing of 0 to {_WIDEST_PX} px, got {self.final_smoothing_px}"
            )
        if not self.levels:
            raise InputError("expected at least one level from coarse to fine, got none")
        if not 0 <= self.edge_px <= _WIDEST_PX or self.order not in (None, *ORDERS):
            raise InputError(
                f"expected edge_px from 0 to {_WIDEST_PX} and order 3, 5 or 11, got "
                f"{self.edge_px} and {self.order}"
            )


@dataclass(frozen=True)
class PhotographOptions(AnsatzOptions):
    """Table ``[correlation]`` of an experiment with photographs."""

    brightness: int | str = 1
    """Total degree, 0 to 6, of gain and offset between the images' grey levels; or "none". By
    default they may slope over the image (docs/decisions/0018-sloping-light.md)."""
    family: str = "auto"
    """Mode family: "auto" reads the modes off the spectrum; "square" is the paper's Eq. (6)."""
    fixed_mode: bool | str = "auto"
    """Keep phi1 as initially found; "auto" does so where no pattern is observable."""
    edge_px: int = 3
    order: int | None = None
    """As in :class:`CorrelationOptions`."""
    formulation: str = "total"
    """Each image is correlated with the reference ("total"), or with the previous image, pulled
    back to the reference's frame ("updated"): for speckles that change during the experiment."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.family not in ("auto", "square"):
            raise InputError(
                f"correlation: expected family 'auto' or 'square', got {self.family!r}"
            )
        if self.formulation not in FORMULATIONS:
            raise InputError(
                f"correlation: unknown formulation {self.formulation!r}"
                f"{nearest(self.formulation, list(FORMULATIONS))}"
            )
        if isinstance(self.fixed_mode, str) and self.fixed_mode != "auto":
            raise InputError(
                f"correlation: expected fixed_mode true, false or 'auto', got {self.fixed_mode!r}"
            )
        self.options()  # checks edge_px and order

    def options(self) -> CorrelationOptions:
        """How to correlate."""
        return CorrelationOptions(edge_px=self.edge_px, order=self.order, final_smoothing_px=None)


@dataclass(frozen=True)
class SquareLatticeOptions(AnsatzOptions):
    """Table ``[correlation]`` of a virtual experiment.

    The defaults are the paper's (section "Virtual Experiments"): in square stacking 42 + 28
    unknowns of v0 and v1, and the mode's 7 make 77. Options without a description are as in
    :class:`CorrelationOptions`.
    """

    start_amplitude: float = 1.0
    """Initial constant value of v1 [mm], not 0; with max ||phi|| = 0.04, 1 mm gives 40 um."""
    edge_px: int = 2
    order: int | None = None
    camera: bool = False
    """Correlate the quantised images instead of the float ones."""
    fixed_mode: bool = False
    """Keep phi1 fixed at the ideal pattern; for images that show no pattern to find it from."""
    gradient: str | None = None
    gradient_blur_px: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.start_amplitude == 0.0:
            raise InputError(
                "correlation: expected a start_amplitude that is not 0 mm (the mode would not be "
                "observable), got 0"
            )
        self.options()  # checks edge_px, order and gradient

    def options(self) -> CorrelationOptions:
        """How to correlate."""
        return CorrelationOptions(**picked(self, "edge_px order gradient gradient_blur_px"))

    def ansatz(self, specimen: Specimen) -> Ansatz:
        """The ansatz with the modes of a specimen's hole lattice."""
        return Ansatz.of_specimen(specimen, fixed_mode=self.fixed_mode, options=self)
