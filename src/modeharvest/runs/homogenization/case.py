"""A homogenized specimen as a case: a virtual experiment's, with two tables more.

::

    [homogenization]               # the RVE, the macroscopic elements, what holds the pattern
    [mode]
    kind = "measured"              # in the images of the experiment; or "analytic", "bloch", "file"
    [loading]                      # optional: another one than the experiment's
    [experiment]                   # and [imaging], [correlation], as of a virtual experiment
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import model_validator

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.lattice.micromorphic.body import PlateLoading, PlateMotion
from modeharvest.fem.materials import MATERIALS
from modeharvest.idic.modes import FAMILIES
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import Case, CaseModel, of_kind, with_kind
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.typed import picked, to_plain


@dataclass(frozen=True, kw_only=True)
class _Numbered:
    """Modes that a specimen's stacking has: one if square, three if triangular."""

    numbers: tuple[int, ...] = ()
    """Which of them to use, from 1; by default all."""


@dataclass(frozen=True, kw_only=True)
class _Snapped(_Numbered):
    """Modes whose wave vectors become the lattice's."""

    snap_anyway: bool = False
    """Even those that are off by more than error bars allow, which are refused otherwise."""


@dataclass(frozen=True)
class MeasuredMode(_Snapped):
    """The modes that the experiment's own images show."""

    strain: float | None = None
    """Of the image [-]; by default the last one."""


@dataclass(frozen=True)
class AnalyticMode(_Numbered):
    """The paper's Eq. (mode), exactly; in triangular stacking the start of a correlation."""


@dataclass(frozen=True)
class BlochMode(_Numbered):
    """The infinite lattice's, at its critical point under the same kind of load."""


@dataclass(frozen=True)
class FileMode(_Snapped):
    """Modes found elsewhere: measured, or computed on any cell by ``modeharvest modes``."""

    path: str
    """The result of a correlation or of a harvest as JSON, of a specimen whose middle is the
    origin; modes as HDF5, whose cell is the RVE; or, as "family_mode_*.json", families of modes of
    a cell with a hole at its origin. In a case file, relative to its folder."""

    @property
    def files(self) -> list[Path]:
        """Those that the name stands for, in order; itself if there are none."""
        named = Path(self.path)
        return (sorted(named.parent.glob(named.name)) if named.name else []) or [named]

    @property
    def is_computed(self) -> bool:
        """Whether the file has modes at the nodes of a cell."""
        return Path(self.path).suffix == ".h5"


MODES: dict[str, type[Any]] = {
    "measured": MeasuredMode, "analytic": AnalyticMode, "bloch": BlochMode, "file": FileMode,
}  # fmt: skip
Mode = MeasuredMode | AnalyticMode | BlochMode | FileMode


@dataclass(frozen=True)
class HomogenizationOptions:
    """Choices of homogenization that matter; docs/explanation/homogenization.md says how much."""

    centre: Literal["junction", "hole"] | tuple[float, float] | None = None
    """About which the RVE of 2 x 2 cells is cut, or a point of it [mm]; by default a junction in
    square stacking, in triangular one a hole, about which its three modes are alike."""
    positions: int = 1
    """RVEs at each point, whose mean counts: about there, and evenly spread over a cell."""
    mesh_size: float = 0.2
    """Edge length of the RVE's elements [mm]."""
    pattern_at_plates: Literal["zero", "free"] = "zero"
    pattern_at_bulk: Literal["zero", "free"] = "zero"
    """The amplitudes v_i where the lattice meets solid strips along loaded and free edges."""
    quarter: bool | None = None
    """Whether only the quarter of the specimen is followed that its mirror images make whole: a
    homogenized specimen may bow where the real one does not (docs/explanation/homogenization.md).
    By default where that can be: in square stacking and compression between free sides."""
    divisions: tuple[int, int] | None = None
    """Macroscopic elements of the lattice along x and y; by default as the cells ask for."""
    mesh: str | None = None
    """A macroscopic mesh of one's own [mm] instead of the specimen, as ``read_body_mesh`` takes it;
    in a case file, relative to that file's folder."""
    edge_shifts: Literal["find"] | tuple[float, float] = "find"
    """By how much a specimen's lattice is longer at each plate and higher at each side, which makes
    up for its edges' energy [mm]; by default as ``micromorphic.edges`` finds them, of a mesh of
    one's own none."""
    first_order: bool = True
    """Whether to find the critical strain without modes, too."""
    error_bars: bool = True
    """Whether to propagate a measured mode's error bars, which takes a run for each parameter."""

    def __post_init__(self) -> None:
        what = "homogenization: expected"
        require_within(f"{what} mesh_size", self.mesh_size, 0.0, above=True)
        require_within(f"{what} positions", self.positions, 1, 100)
        for number in self.divisions or ():
            require_within(f"{what} divisions", number, 1, 1000)


@dataclass(frozen=True)
class SpecimenLoading(PlateMotion):
    """What a homogenized specimen is put under where that isn't the experiment's compression."""

    loads: tuple[float, ...] = ()
    """e of the states to keep, ascending [-]; by default the experiment's strains."""


class HomogenizationCase(CaseModel):
    """A virtual experiment, and how its specimen is homogenized."""

    table = "homogenization"

    homogenization: HomogenizationOptions = HomogenizationOptions()
    mode: Annotated[Mode, of_kind(MODES, "mode")] = MeasuredMode()
    loading: SpecimenLoading | None = None
    experiment: Annotated[Experiment, of_kind(MATERIALS, "experiment.material", "material")] = (
        Experiment()
    )
    imaging: ImagingSpec = ImagingSpec()
    correlation: SquareLatticeOptions = SquareLatticeOptions()

    @property
    def virtual(self) -> Case:
        """The virtual experiment by itself."""
        return Case(
            title=self.title, experiment=self.experiment, imaging=self.imaging,
            correlation=self.correlation,
        )  # fmt: skip

    @classmethod
    def read(cls, name: str | Path) -> Self:
        """Read a case as every other; a mode's file is found beside the case's."""
        case, folder, beside = super().read(name), Path(name).parent, dict[str, Any]()
        if isinstance(case.mode, FileMode):
            beside["mode"] = replace(case.mode, path=str(folder / case.mode.path))
        if (mesh := case.homogenization.mesh) is not None:
            beside["homogenization"] = replace(case.homogenization, mesh=str(folder / mesh))
        return case.model_copy(update=beside)

    @property
    def is_experiment(self) -> bool:
        """Whether the direct simulation is of the same specimen under the same load."""
        return self.loading is None and self.homogenization.mesh is None

    @property
    def quarter(self) -> bool:
        """Whether a quarter is followed."""
        can = self.experiment.specimen.stacking == "square" and self.is_experiment
        return can if self.homogenization.quarter is None else self.homogenization.quarter

    @property
    def centre(self) -> str | tuple[float, float]:
        """About which the RVE is cut."""
        is_square = self.experiment.specimen.stacking == "square"
        return self.homogenization.centre or ("junction" if is_square else "hole")

    @property
    def loads(self) -> tuple[float, ...]:
        """Of the states to keep [-]."""
        return (self.loading and self.loading.loads) or self.experiment.strains

    @property
    def plates(self) -> PlateLoading:
        """How the homogenized specimen is supported and loaded."""
        load = self.loading or SpecimenLoading(plates=self.experiment.edges)
        how = picked(self.homogenization, "pattern_at_plates pattern_at_bulk")
        rates = picked(load, "compression shear bending lateral plates sides")
        return PlateLoading(**rates, **how, quarter=self.quarter)

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values, with what choices come to."""
        chosen = {"centre": self.centre, "quarter": self.quarter}
        own = {"title": self.title, "homogenization": to_plain(self.homogenization) | chosen,
               "loading": to_plain(self.loading)}  # fmt: skip
        virtual = self.virtual.plain()
        tables = {name: virtual[name] for name in ("experiment", "imaging", "correlation")}
        return {**own, "mode": with_kind(self.mode, MODES), **tables}

    @model_validator(mode="after")
    def _can_be_homogenized(self) -> Self:
        experiment, specimen = self.experiment, self.experiment.specimen
        got, is_perfect = specimen.stacking, experiment.is_perfect
        shifts = self.homogenization.edge_shifts
        for is_wrong, expected in (
            (got == "rectangular" or specimen.diameter_y is not None,
             "round holes in square or triangular stacking, "
             f"got {got} stacking, diameter_y = {specimen.diameter_y}"),
            (self.quarter and not (got == "square" and self.is_experiment),
             "quarter = false except for square stacking with the experiment's load and shape, "
             "got true"),
            (specimen.grading_x or specimen.grading_y or not is_perfect,
             "a specimen without grading, scatter and tilt: one RVE stands for all of it"),
            (experiment.guided and self.is_experiment and not self.quarter,
             "quarter = true for a guided specimen, whose middle line stays straight, got false"),
            (self.homogenization.mesh and shifts not in ("find", (0.0, 0.0)),
             f"edge_shifts for a specimen only, not for a mesh of one's own, got {shifts}"),
        ):  # fmt: skip
            if is_wrong:
                raise InputError(f"homogenization: expected {expected}")
        for what, chosen, cells in (("a centre", self.centre, 2.0), ("edge_shifts", shifts, 0.5)):
            for x in () if isinstance(chosen, str) else chosen:
                most = cells * specimen.pitch
                require_within(f"homogenization: expected {what} [mm]", x, -most, most)
        if isinstance(self.mode, MeasuredMode) and self.correlation.fixed_mode:
            raise InputError("mode: expected a free mode to be measured, got fixed_mode = true")
        strain = getattr(self.mode, "strain", None)
        if strain is not None and strain not in experiment.strains:
            raise InputError(f"mode: expected a strain among {experiment.strains}, got {strain}")
        count, numbers = len(FAMILIES[specimen.stacking](specimen)), self.mode.numbers
        if isinstance(self.mode, FileMode) and self.mode.is_computed:
            count = max(numbers, default=1)  # as many as the file has
        if len(set(numbers)) < len(numbers) or not all(1 <= n <= count for n in numbers):
            what = f"different numbers from 1 to {count} in {specimen.stacking} stacking"
            raise InputError(f"mode: expected {what}, got {numbers}")
        _ = self.plates  # or an InputError
        return self
