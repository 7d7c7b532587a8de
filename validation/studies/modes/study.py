"""On what does the measured mode depend? Hole size, cell size, material, and graded holes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from modeharvest.errors import InputError
from modeharvest.fem.field import Solution
from modeharvest.idic.setup import Identification
from modeharvest.progress import Progress, silent
from modeharvest.validation.campaign import Case
from modeharvest.validation.lattice.independence import MATERIALS
from modeharvest.validation.studies.modes.description import Description
from modeharvest.validation.studies.modes.specimen import one_specimen
from modeharvest.validation.studies.study import require_different, require_mode
from modeharvest.validation.studies.subject import Subject

__all__ = ["Modes", "one_specimen"]

BASE = "base"


@dataclass(frozen=True)
class Modes:
    """Measure the mode on specimens that differ from a base in one respect each.

    Each is compressed until its pattern is as strong as the base's, in shares of l.

    Parameters
    ----------
    strain
        Of the base's deformed image [-]; it has to be buckled there.
    ratios
        Other d/l than the base's [-].
    pitches
        Other l [mm]; specimen, elements and pixels are scaled with it.
    materials
        Names among :data:`modeharvest.validation.lattice.independence.MATERIALS`.
    gradings_x, gradings_y
        Change of the diameter along and across the load [mm/mm], each by itself; d at the
        specimen's centre stays.
    largest
        Strain up to which to look for where a specimen buckles [-].
    divisions
        Elements along l of the infinite lattice's cell.

    Raises
    ------
    InputError
        If a value is out of its range, or comes twice.
    """

    strain: float = 0.128
    ratios: tuple[float, ...] = (0.6, 0.65, 0.7, 0.75, 0.85, 0.9, 0.95)
    pitches: tuple[float, ...] = (0.95,)
    materials: tuple[str, ...] = ("two-term I1", "Ogden m=3, nu=0.40", "Ogden m=3, nu=0.49")
    gradings_x: tuple[float, ...] = (0.02,)
    gradings_y: tuple[float, ...] = (0.02,)
    largest: float = 0.28
    divisions: int = 13

    def __post_init__(self) -> None:
        if not all(0.0 < r < 1.0 for r in self.ratios):
            raise InputError(f"study: expected ratios d/l between 0 and 1, got {list(self.ratios)}")
        if not all(0.0 < p < float("inf") for p in self.pitches):
            raise InputError(f"study: expected pitches above 0 mm, got {list(self.pitches)}")
        unknown = [name for name in self.materials if name not in MATERIALS]
        if unknown:
            raise InputError(f"study: expected materials among {list(MATERIALS)}, got {unknown}")
        if 0.0 in (*self.gradings_x, *self.gradings_y):
            raise InputError("study: expected gradings other than 0, which the base has, got 0")
        if not (0.0 < self.largest < 0.5 and 4 <= self.divisions <= 200):
            raise InputError(
                "study: expected largest between 0 and 0.5 and 4 to 200 divisions, got "
                f"{self.largest} and {self.divisions}"
            )
        for name in ("ratios", "pitches", "materials", "gradings_x", "gradings_y"):
            require_different(name, getattr(self, name))

    @property
    def question(self) -> str:
        """What is asked, for the report."""
        return (
            "The paper argues that the pattern of a square stacking of holes is one mode, "
            "whatever the size of its cells, nearly whatever that of its holes, and the material. "
            "Here it is measured: specimens are buckled, imaged and correlated with the mode’s "
            "parameters free, and what is found is set against the mode of the infinite lattice, "
            "against Eq. (mode) of the paper, and against the best fit to the specimen’s own "
            "displacement."
        )

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""
        return f"{one_specimen.__module__}:{one_specimen.__name__}"

    @property
    def seeds(self) -> str:
        """The only thing that is random."""
        return "one speckle, of imaging.speckle.seed"

    def require(self, correlation: Identification) -> None:
        """The mode's parameters have to be free."""
        require_mode(correlation)

    def quick(self) -> Self:
        """A third of the d/l beside the base's, and one graded specimen."""
        return replace(
            self,
            ratios=self.ratios[2::3],
            pitches=(),
            materials=(),
            gradings_x=(),
            gradings_y=self.gradings_y[:1],
        )

    def prepare(
        self, subject: Subject, folder: Path, progress: Progress = silent
    ) -> tuple[Case, ...]:
        """Describe the specimens; they are simulated and imaged case by case.

        Raises
        ------
        InputError
            If the base has no critical point below the strain, or a specimen can't be.
        """
        base = Description.of(subject, self.strain, self.largest, self.divisions)
        name = base.leave(folder)
        snapshot = subject.solution.at(self.strain)
        own = Solution(subject.solution.mesh, (snapshot,), subject.solution.info)
        own.write(base.solution_path(folder))
        others = [
            {"varied": varied, "level": level, "specimen": described.leave(folder)}
            for varied, level, described in self._others(base)
        ]
        return ({"varied": BASE, "level": "", "specimen": name}, *others)

    def _others(self, base: Description) -> Iterator[tuple[str, str, Description]]:
        """What is varied, its level in words, and the specimen."""
        pitch = base.specimen.pitch
        for ratio in self.ratios:
            yield "d/l", f"{ratio:g}", base.changed(diameter=ratio * pitch)
        for other in self.pitches:
            yield "l", f"{other:g} mm", base.scaled(other)
        for material in self.materials:
            yield "material", material, base.changed(MATERIALS[material])
        for along in self.gradings_x:
            yield "graded along the load", f"{along:g}", base.changed(grading_x=along)
        for across in self.gradings_y:
            yield "graded across the load", f"{across:g}", base.changed(grading_y=across)
