"""What a lattice buckles into: its critical point, its modes and branches, their mode families."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from modeharvest.fem.bloch.modes import Branch, ModeSet
from modeharvest.idic.spectra.mode_family import read_family, read_spectrum
from modeharvest.runs.lattice import results
from modeharvest.runs.lattice.case import LatticeCase
from modeharvest.runs.lattice.results import CriticalPoint, FoundPattern, PeriodicField
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, requiring_dolfinx
from modeharvest.util.progress import Progress, named, silent

if TYPE_CHECKING:
    from modeharvest.fem.bloch.critical import LatticeCritical
    from modeharvest.fem.lattice.cell import CellPath, CellState, PeriodicCell
    from modeharvest.fem.lattice.cells import UnitCell

BEYOND = (1.02, 1.1, 1.25, 1.5)
"""Loads at which states of branches are kept, relative to the critical one."""


@dataclass(frozen=True)
class LatticeModel:
    """The finite elements of a case: cell and path are made when they are asked for.

    Everything raises InputError if there is no such lattice or its cell isn't periodic, and
    MissingDependencyError if dolfinx or gmsh is not there.
    """

    case: LatticeCase
    progress: Progress = silent

    @cached_property
    def unit(self) -> UnitCell:
        """The primitive cell's mesh and lattice vectors."""
        with requiring_dolfinx("infinite lattices need"):
            return self.case.lattice.cell()

    @cached_property
    def cell(self) -> PeriodicCell:
        """The primitive cell with its material."""
        unit = self.unit
        with requiring_dolfinx("infinite lattices need"):
            from modeharvest.fem.lattice.cell import PeriodicCell
        return PeriodicCell(unit, self.case.material)

    def path(self, load: float = 0.0, cell: PeriodicCell | None = None) -> CellPath:
        """A new primary path, followed up to a load [-] in steps that jump over no state.

        From the beginning, so that no stage depends on another's steps.
        """
        cell = cell or self.cell  # first: without dolfinx it says what is missing
        from modeharvest.fem.lattice.cell import CellPath

        path, step = CellPath(cell, self.case.loading.macro()), self.case.search.largest_step
        for k in range(int(load / step) + 1):
            if path.at(k * step) is None:
                break
        return path

    def critical(self) -> LatticeCritical:
        """The first critical point over all wave vectors; InputError if it is a mechanism."""
        path = self.path()
        from modeharvest.fem.bloch.critical import first_critical
        from modeharvest.fem.lattice.options import CriticalSearch

        search = CriticalSearch(**asdict(self.case.search))
        return first_critical(path, search, named(self.progress, "first critical load"))

    def why_no_modes(self, critical: CriticalPoint) -> str:
        """Why there is no wave whose modes could be computed; empty if there is one."""
        if self.case.modes.waves or critical.waves:
            return ""
        what = "long waves are modes of no finite cell" if critical.found else "nothing is critical"
        return f"no modes: {what}; name waves in [modes], such as waves = [[1, 1]]"

    def modes(
        self, critical: CriticalPoint, info: Mapping[str, Any]
    ) -> tuple[ModeSet, tuple[Branch, ...]]:
        """The modes of the plan as real fields, and the branches that start with critical ones.

        ``info``: plain JSON values to keep with the modes. Raises InputError if a wave doesn't
        repeat within a dozen cells, the load can't be reached, or combinations don't have one
        coefficient for each mode.
        """
        plan = self.case.modes
        path = self.path(max(plan.load, critical.load))
        from modeharvest.fem.bloch.real_modes import real_modes

        state = _state(path, plan.load or critical.load)
        self.progress(0, 1, "modes")
        modes = real_modes(path.cell, state, plan.phases or critical.waves, info)
        self.progress(1, 1, "modes")
        if not critical.found or state.load != critical.load:
            return modes, ()
        return modes, tuple(self._branches(modes))

    def _branches(self, modes: ModeSet) -> list[Branch]:
        """A branch for each combination of modes, on their commensurate cell."""
        from modeharvest.fem.bloch.postbuckling import follow
        from modeharvest.fem.lattice.cell import PeriodicCell

        plan = self.case.modes
        combinations = plan.combinations or default_combinations(len(modes.waves))
        loads = plan.branch_loads or tuple(factor * modes.load for factor in BEYOND)
        cell = PeriodicCell(self.unit.enlarged(*modes.info["copies"]), self.case.material)
        found = []
        for k, combination in enumerate(combinations, start=1):
            listener = named(self.progress, f"branch {k} of {len(combinations)}")
            path = self.path(0.98 * modes.load, cell)
            found.append(follow(path, modes, combination, loads, progress=listener))
        return found

    def fields(
        self,
        critical: CriticalPoint,
        modes: ModeSet | None,
        branches: Sequence[Branch],
        info: Mapping[str, Any],
    ) -> list[PeriodicField]:
        """All fields in which families are looked for: modes, ends of branches, primary path."""
        found = []
        if modes is not None:
            found += [PeriodicField.of_mode(modes, k, info) for k in range(len(modes.waves))]
            found += [
                PeriodicField.of_branch(modes, k, branch, info)
                for k, branch in enumerate(branches, start=1) if branch.states
            ]  # fmt: skip
        return [*found, self._primary(self.case.modes.load or critical.load, modes, info)]

    def _primary(
        self, load: float, modes: ModeSet | None, info: Mapping[str, Any]
    ) -> PeriodicField:
        """The unbuckled lattice at a load, on the modes' cell where there is one."""
        path = self.path(load)
        state, unit = _state(path, load), path.cell.cell
        mesh, lattice = (unit.mesh, unit.lattice) if modes is None else (modes.mesh, modes.lattice)
        w = path.cell.displacement(state) - unit.mesh.nodes @ (state.gradient - np.eye(2)).T
        known, wanted = (_in_cell(nodes, unit.lattice) for nodes in (unit.mesh.nodes, mesh.nodes))
        same = cKDTree(known, boxsize=1.0).query(wanted)[1]
        u = w[same] + mesh.nodes @ (state.gradient - np.eye(2)).T
        return PeriodicField(
            file="family_primary.json",
            name=f"primary path at {100 * load:.4g} %",
            mesh=mesh,
            lattice=lattice,
            displacement=u,
            gradient=state.gradient,
            info={**info, "load": load},
            stable=True,
        )


def default_combinations(count: int) -> tuple[tuple[float, ...], ...]:
    """Each of some modes alone, and the sum of all where there are more."""
    alone = [tuple(float(i == k) for i in range(count)) for k in range(count)]
    return (*alone, (1.0,) * count) if count > 1 else tuple(alone)


def _state(path: CellPath, load: float) -> CellState:
    """The state at a load; a millionth below where that is critical with the cell's own period."""
    state = path.at(load) or path.at((1.0 - 1e-6) * load)
    if state is None:
        raise InputError(f"modes: expected a load that the lattice's path reaches, got {load:.6g}")
    return state


def _in_cell(nodes: FloatArray, lattice: FloatArray) -> FloatArray:
    """(n, 2) fractional coordinates in [0, 1)."""
    fractional = np.mod(nodes @ np.linalg.inv(lattice), 1.0)
    return np.asarray(np.mod(fractional, 1.0))  # -1e-17 has become 1


def found_pattern(pattern: PeriodicField, folder: Path) -> FoundPattern:
    """A pattern with the family and spectrum that its file has; InputError if it lacks them."""
    path = folder / pattern.file
    family, spectrum = read_family(path), read_spectrum(path)
    if spectrum is None:
        raise InputError(f"expected Fourier coefficients in {path}, found none; make it again")
    return FoundPattern(**vars(pattern), spectrum=spectrum, family=family)


def to_be_shown(
    every: Sequence[PeriodicField], modes: ModeSet, pitch: float, folder: Path
) -> list[FoundPattern]:
    """Those for the report: branches from the lowest energy up, or modes; and the primary path."""
    branches = sorted((p for p in every[:-1] if p.stable is not None), key=lambda p: p.energy)
    found = [found_pattern(pattern, folder) for pattern in branches]
    if not found:
        drawn = [mode.scaled(results.DRAWN_AMPLITUDE * pitch) for mode in every[: len(modes.waves)]]
        found = [mode.analysed(pitch) for mode in drawn]
    return [*found, found_pattern(every[-1], folder)]
