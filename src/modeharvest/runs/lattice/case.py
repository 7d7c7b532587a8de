"""An infinite lattice as a case: a TOML file, or a few lines of Python, checked beforehand.

::

    title = "..."
    [lattice]      # kind = "square", "hexagonal", "tetrachiral", "hexachiral" or "file"
    [material]     # kind = "ogden" or "two-term-I1", and its constants
    [loading]      # kind = "uniaxial", "uniaxial-strain", "equibiaxial", "shear", "prescribed"
    [search]       # up to which load, how finely
    [dispersion]   # loads, points, bands
    [modes]        # which modes, which branches
    [study]        # optional: how the pattern depends on d/l, l, material and loading

The tables are the dataclasses of :mod:`modeharvest.runs.lattice.options`. In Python::

    case = LatticeCase(lattice=SquareLattice(1.9, 1.5), loading=Loading("equibiaxial"))

Here is also what each stage of the analysis depends on: with the same key it is not done again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pydantic import field_validator, model_validator

from modeharvest.fem.materials import MATERIALS, Material, Ogden
from modeharvest.runs.case import CaseModel, checked, is_lattice, kind_of, of_kind, read_tables
from modeharvest.runs.lattice.options import (
    LATTICES,
    DispersionPlan,
    FileLattice,
    LatticeSpec,
    Loading,
    ModesPlan,
    Search,
    SquareLattice,
)
from modeharvest.util.errors import InputError
from modeharvest.util.files import sha256_of
from modeharvest.util.progress import Progress, silent
from modeharvest.util.stages import digest, stage_key
from modeharvest.util.typed import nearest, plain
from modeharvest.validation.studies.lattice import SHOWN, LatticeModeStudy, run_lattice_study
from modeharvest.validation.studies.lattice_pattern import LOADINGS, RATIOS, StudiedLattice
from modeharvest.validation.studies.lattice_pattern import STUDIED_MATERIALS as MATERIALS_BY_NAME


@dataclass(frozen=True)
class StudyPlan:
    """A study of a square lattice's pattern: see ``validation.mode_study``.

    Every ratio under every loading, and where the pattern stops being what buckles first; other
    unit cell sizes and materials at the case's own d/l and loading.

    Parameters
    ----------
    ratios
        d/l [-].
    loadings
        "uniaxial", "uniaxial-strain", "equibiaxial".
    pitches
        Other l [mm].
    materials
        Other materials, by their names in ``validation.independence.MATERIALS``.
    overlays
        d/l of the pictures of numerical over analytic mode [-].
    divisions
        Elements along l.
    largest
        Load up to which to look for critical points [-].
    """

    ratios: tuple[float, ...] = RATIOS
    loadings: tuple[str, ...] = tuple(name.replace(" ", "-") for name in LOADINGS)
    pitches: tuple[float, ...] = ()
    materials: tuple[str, ...] = ()
    overlays: tuple[float, ...] = SHOWN
    divisions: int = 13
    largest: float = 0.28

    def __post_init__(self) -> None:
        known = [name.replace(" ", "-") for name in LOADINGS]
        for names, among in ((self.loadings, known), (self.materials, list(MATERIALS_BY_NAME))):
            for name in names:
                if name not in among:
                    raise InputError(f"unknown name {name!r}{nearest(name, among)}")
        if not self.loadings or not self.ratios:
            raise InputError("study: expected a ratio and a loading or more, got none")
        if not (4 <= self.divisions <= 200 and 0 < self.largest < 1):
            raise InputError(
                "study: expected 4 to 200 divisions and 0 < largest < 1, got "
                f"{self.divisions} and {self.largest}"
            )
        if not all(0 < pitch < math.inf for pitch in self.pitches):
            raise InputError(f"study: expected pitches above 0 mm, got {self.pitches}")
        if not all(0 < ratio < 1 for ratio in (*self.ratios, *self.overlays)):
            raise InputError(f"study: expected 0 < d/l < 1, got {self.ratios}, {self.overlays}")


class LatticeCase(CaseModel):
    """An infinite lattice under load, and what is asked about it."""

    lattice: LatticeSpec = SquareLattice()
    material: Material = Ogden()
    loading: Loading = Loading()
    search: Search = Search()
    dispersion: DispersionPlan = DispersionPlan()
    modes: ModesPlan = ModesPlan()
    study: StudyPlan | None = None

    @field_validator("lattice", mode="before")
    @classmethod
    def _of_kind(cls, table: Any) -> Any:
        return of_kind(table, LATTICES, "lattice") if isinstance(table, dict) else table

    @field_validator("material", mode="before")
    @classmethod
    def _of_material(cls, table: Any) -> Any:
        return of_kind(table, MATERIALS, "material") if isinstance(table, dict) else table

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values, lattice and material by their kinds."""
        content = {name: plain(getattr(self, name)) for name in type(self).model_fields}
        content["lattice"] = kind_of(self.lattice, LATTICES)
        content["material"] = kind_of(self.material, MATERIALS)
        return content

    @model_validator(mode="after")
    def _is_square_to_be_studied(self) -> Self:
        if self.study is not None and not isinstance(self.lattice, SquareLattice):
            raise InputError(
                "expected a square lattice for a [study], got another kind; leave [study] out"
            )
        return self

    def run_study(self, table: Path, progress: Progress = silent) -> LatticeModeStudy | None:
        """Do the study, going on from what the table has; None without [study]."""
        plan, lattice = self.study, self.lattice
        if plan is None or not isinstance(lattice, SquareLattice):
            return None
        base = StudiedLattice(
            ratio=lattice.diameter / lattice.pitch,
            loading=self.loading.macro(),
            material=self.material,
            pitch=lattice.pitch,
            divisions=plan.divisions,
            largest=plan.largest,
        )
        return run_lattice_study(
            base,
            table,
            ratios=plan.ratios,
            loadings=[name.replace("-", " ") for name in plan.loadings],
            pitches=plan.pitches,
            materials=plan.materials,
            shown=plan.overlays,
            progress=progress,
        )


def read_lattice_case(name: str | Path) -> LatticeCase:
    """Read a lattice's case by the name of a shipped one or by the path of a TOML file.

    Raises
    ------
    InputError
        If there is no such case, it is a virtual experiment, it is not TOML, a key is unknown
        (the nearest known one is suggested) or a value is out of its range.
    """
    tables = read_tables(name)
    if not is_lattice(tables) and "experiment" in tables:
        raise InputError(
            f"{name}: expected an infinite lattice, got a virtual experiment; run 'modeharvest run "
            f"{name} --out DIR'"
        )
    lattice = tables.get("lattice")
    if isinstance(lattice, dict) and isinstance(lattice.get("path"), str):
        lattice["path"] = str(Path(name).parent / lattice["path"])
    return checked(LatticeCase, tables, name)


def stage_keys(case: LatticeCase) -> dict[str, str]:
    """By stage, the digest of all that its outcome depends on; a cell's own file included."""
    content = case.plain()
    if isinstance(case.lattice, FileLattice):
        content["lattice"]["content"] = sha256_of(case.lattice.path)
    tables = {name: content[name] for name in ("lattice", "material", "loading", "search")}
    critical = stage_key(tables)
    return {
        "critical": critical,
        "dispersion": digest([critical, content["dispersion"]]),
        "modes": digest([critical, content["modes"]]),
        "families": digest([critical, content["modes"], "families"]),
        "study": stage_key([tables, content["study"]]),
    }
