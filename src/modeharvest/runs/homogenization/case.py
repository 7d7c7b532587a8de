"""Case of a homogenized specimen: that of a virtual experiment, with two or three more tables.

::

    [homogenization]               # the RVE, the macroscopic elements, conditions on v_i
    [mode]
    kind = "measured"              # in the experiment's images; or "analytic", "bloch", "file"
    [loading]                      # optional: replaces the experiment's loading
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
    """Selection of modes; square stacking has one mode, triangular stacking three."""

    numbers: tuple[int, ...] = ()
    """Numbers of the modes to use, from 1; by default all."""


@dataclass(frozen=True, kw_only=True)
class _Snapped(_Numbered):
    """Modes whose wave vectors are replaced by those of the lattice ("snapped")."""

    snap_anyway: bool = False
    """Accept wave vectors that deviate by more than error bars allow; else they are refused."""


@dataclass(frozen=True)
class MeasuredMode(_Snapped):
    """The modes measured in the images of the experiment."""

    strain: float | None = None
    """Nominal strain of the image used [-]; by default the last one."""


@dataclass(frozen=True)
class AnalyticMode(_Numbered):
    """The paper's Eq. (6), exactly; in triangular stacking a correlation's initial guess."""


@dataclass(frozen=True)
class BlochMode(_Numbered):
    """The modes of the infinite lattice at its critical point under the same kind of load."""


@dataclass(frozen=True)
class FileMode(_Snapped):
    """Modes from a file: measured, or computed on any cell by ``modeharvest modes``."""

    path: str
    """Result of a correlation or of a harvest (JSON), with the origin at the specimen's centre; or
    modes (HDF5), whose cell becomes the RVE; or mode families ("family_mode_*.json") of a cell
    with a hole at its origin. In a case file, relative to its folder."""

    @property
    def files(self) -> list[Path]:
        """The files that match ``path``, sorted; ``path`` itself if there are none."""
        named = Path(self.path)
        return (sorted(named.parent.glob(named.name)) if named.name else []) or [named]

    @property
    def is_computed(self) -> bool:
        """Whether the file contains modes given at the nodes of a cell (HDF5)."""
        return Path(self.path).suffix == ".h5"


MODES: dict[str, type[Any]] = {
    "measured": MeasuredMode, "analytic": AnalyticMode, "bloch": BlochMode, "file": FileMode,
}  # fmt: skip
Mode = MeasuredMode | AnalyticMode | BlochMode | FileMode


@dataclass(frozen=True)
class HomogenizationOptions:
    """Options of homogenization; for their influence see docs/explanation/homogenization.md."""

    centre: Literal["junction", "hole"] | tuple[float, float] | None = None
    """Centre of the RVE of 2 x 2 cells: a junction, a hole, or a point [mm]. By default a junction
    in square stacking; in triangular stacking a hole, about which its three modes are alike."""
    positions: int = 1
    """RVEs at each point (1 to 100), averaged: about ``centre``, and evenly spread over a cell."""
    mesh_size: float = 0.2
    """Edge length of the RVE's elements [mm]."""
    pattern_at_plates: Literal["zero", "free"] = "zero"
    pattern_at_bulk: Literal["zero", "free"] = "zero"
    """Conditions on v_i where the lattice meets solid strips along loaded and free edges."""
    quarter: bool | None = None
    """Whether only a quarter of the specimen is simulated and mirrored: a whole homogenized
    specimen may bow where the real one does not (docs/explanation/homogenization.md). By default
    where this is possible: in square stacking, compressed between free sides."""
    divisions: tuple[int, int] | None = None
    """Macroscopic elements of the lattice along x and y; by default according to its cells."""
    mesh: str | None = None
    """File of a macroscopic mesh [mm] that replaces the specimen, read by ``read_body_mesh``; in a
    case file, relative to that file's folder."""
    edge_shifts: Literal["find"] | tuple[float, float] = "find"
    """Extension of a specimen's lattice at each plate, and at each side [mm], which compensates for
    the energy of its edges. By default computed by ``micromorphic.edges``; with a mesh from a file
    none."""
    first_order: bool = True
    """Whether to compute also the critical strain of homogenization without modes."""
    error_bars: bool = True
    """Whether to propagate a measured mode's error bars; needs one run per parameter."""

    def __post_init__(self) -> None:
        what = "homogenization: expected"
        require_within(f"{what} mesh_size", self.mesh_size, 0.0, above=True)
        require_within(f"{what} positions", self.positions, 1, 100)
        for number in self.divisions or ():
            require_within(f"{what} divisions", number, 1, 1000)


@dataclass(frozen=True)
class SpecimenLoading(PlateMotion):
    """Loading of a homogenized specimen other than the experiment's compression."""

    loads: tuple[float, ...] = ()
    """Loads e of the states to keep [-], ascending; by default the experiment's strains."""


class HomogenizationCase(CaseModel):
    """A virtual experiment, with the options by which its specimen is homogenized."""

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
        """The case of the virtual experiment, without homogenization."""
        return Case(
            title=self.title, experiment=self.experiment, imaging=self.imaging,
            correlation=self.correlation,
        )  # fmt: skip

    @classmethod
    def read(cls, name: str | Path) -> Self:
        """Read a case as for any kind; paths of mode and mesh are relative to its folder."""
        case, folder, beside = super().read(name), Path(name).parent, dict[str, Any]()
        if isinstance(case.mode, FileMode):
            beside["mode"] = replace(case.mode, path=str(folder / case.mode.path))
        if (mesh := case.homogenization.mesh) is not None:
            beside["homogenization"] = replace(case.homogenization, mesh=str(folder / mesh))
        return case.model_copy(update=beside)

    @property
    def is_experiment(self) -> bool:
        """Whether specimen and load are those of the experiment's direct simulation."""
        return self.loading is None and self.homogenization.mesh is None

    @property
    def quarter(self) -> bool:
        """Whether only a quarter of the specimen is simulated; resolves the default."""
        can = self.experiment.specimen.stacking == "square" and self.is_experiment
        return can if self.homogenization.quarter is None else self.homogenization.quarter

    @property
    def centre(self) -> str | tuple[float, float]:
        """Centre of the RVE: its kind, or a point [mm]; resolves the default."""
        is_square = self.experiment.specimen.stacking == "square"
        return self.homogenization.centre or ("junction" if is_square else "hole")

    @property
    def loads(self) -> tuple[float, ...]:
        """Loads of the states to keep [-]; resolves the default."""
        return (self.loading and self.loading.loads) or self.experiment.strains

    @property
    def plates(self) -> PlateLoading:
        """How the homogenized specimen is supported and loaded."""
        load = self.loading or SpecimenLoading(plates=self.experiment.edges)
        how = picked(self.homogenization, "pattern_at_plates pattern_at_bulk")
        rates = picked(load, "compression shear bending lateral plates sides")
        return PlateLoading(**rates, **how, quarter=self.quarter)

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values, with defaults of options resolved."""
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
