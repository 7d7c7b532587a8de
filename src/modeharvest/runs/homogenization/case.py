"""A homogenized specimen as a case: a virtual experiment's, with two tables more.

::

    [homogenization]               # the RVE, the macroscopic elements, what holds the pattern
    [mode]
    kind = "measured"              # in the images of the experiment; or "analytic", "bloch", "file"
    [experiment]                   # and [imaging], [correlation], as of a virtual experiment
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import model_validator

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.materials import MATERIALS
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import Case, CaseModel, of_kind, with_kind
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.typed import to_plain


@dataclass(frozen=True)
class MeasuredMode:
    """The mode that the experiment's own images show."""

    strain: float | None = None
    """Of the image [-]; by default the last one."""


@dataclass(frozen=True)
class AnalyticMode:
    """The paper's Eq. (mode), exactly."""


@dataclass(frozen=True)
class BlochMode:
    """The critical mode of the infinite lattice under uniaxial stress along x."""


@dataclass(frozen=True)
class FileMode:
    """A mode that was measured elsewhere: the result of a correlation or of a harvest."""

    path: str
    """A result as JSON, of a specimen whose middle is the origin; in a case file, relative to that
    file's folder."""


MODES: dict[str, type[Any]] = {
    "measured": MeasuredMode, "analytic": AnalyticMode, "bloch": BlochMode, "file": FileMode,
}  # fmt: skip
Mode = MeasuredMode | AnalyticMode | BlochMode | FileMode


@dataclass(frozen=True)
class HomogenizationOptions:
    """Choices of homogenization that matter; docs/homogenization.md says how much."""

    centre: Literal["junction", "hole"] = "junction"
    """About which the RVE of 2 x 2 cells is cut."""
    positions: int = 1
    """RVEs along x and y at each point, whose mean counts: centred there and a ``positions``-th of
    a cell apart."""
    mesh_size: float = 0.2
    """Edge length of the RVE's elements [mm]."""
    pattern_at_plates: Literal["zero", "free"] = "zero"
    pattern_at_bulk: Literal["zero", "free"] = "zero"
    """The amplitudes v_i where the lattice meets solid strips along loaded and free edges."""
    quarter: bool = True
    """Whether only the quarter of the specimen is followed that its mirror images make whole: a
    homogenized specimen may bow where the real one does not, see docs/homogenization.md."""
    divisions: tuple[int, int] | None = None
    """Macroscopic elements of the lattice along x and y; by default as the cells ask for."""
    first_order: bool = True
    """Whether to find the critical strain without modes, too."""
    error_bars: bool = True
    """Whether to propagate a measured mode's error bars, which takes a run for each parameter."""

    def __post_init__(self) -> None:
        what = "homogenization: expected"
        require_within(f"{what} mesh_size", self.mesh_size, 0.0, above=True)
        require_within(f"{what} positions", self.positions, 1, 10)
        for number in self.divisions or ():
            require_within(f"{what} divisions", number, 1, 1000)


class HomogenizationCase(CaseModel):
    """A virtual experiment, and how its specimen is homogenized."""

    table = "homogenization"

    homogenization: HomogenizationOptions = HomogenizationOptions()
    mode: Annotated[Mode, of_kind(MODES, "mode")] = MeasuredMode()
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
        case = super().read(name)
        if not isinstance(case.mode, FileMode):
            return case
        file = str(Path(name).parent / case.mode.path)
        return case.model_copy(update={"mode": replace(case.mode, path=file)})

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values."""
        own = {"title": self.title, "homogenization": to_plain(self.homogenization)}
        virtual = self.virtual.plain()
        tables = {name: virtual[name] for name in ("experiment", "imaging", "correlation")}
        return {**own, "mode": with_kind(self.mode, MODES), **tables}

    @model_validator(mode="after")
    def _can_be_homogenized(self) -> Self:
        experiment, specimen = self.experiment, self.experiment.specimen
        if specimen.stacking != "square" or specimen.diameter_y is not None:
            raise InputError(
                "homogenization: expected round holes in square stacking, got "
                f"{specimen.stacking} stacking, diameter_y = {specimen.diameter_y}"
            )
        if specimen.grading_x or specimen.grading_y or not experiment.is_perfect:
            raise InputError(
                "homogenization: expected a specimen without grading, scatter and tilt: one RVE "
                "stands for all of it"
            )
        if experiment.guided and not self.homogenization.quarter:
            raise InputError(
                "homogenization: expected quarter = true for a guided specimen, whose middle line "
                "stays straight, got false"
            )
        if isinstance(self.mode, MeasuredMode) and self.correlation.fixed_mode:
            raise InputError("mode: expected a free mode to be measured, got fixed_mode = true")
        strain = getattr(self.mode, "strain", None)
        if strain is not None and strain not in experiment.strains:
            raise InputError(f"mode: expected a strain among {experiment.strains}, got {strain}")
        return self
