"""What a lattice buckles into: its modes and branches, and the mode families found in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import Material
from modeharvest.fem.modes import Branch, ModeSet
from modeharvest.idic.automatic import FoundFamily, mode_family
from modeharvest.idic.family_file import read_family, read_spectrum, write_family
from modeharvest.idic.lattice_spectrum import LatticeSpectrum, lattice_spectrum
from modeharvest.lattice_tables import ModesPlan
from modeharvest.progress import Progress, silent
from modeharvest.validation.lattice_report import CriticalPoint

if TYPE_CHECKING:  # it needs dolfinx
    from modeharvest.fem.cell import CellPath, CellState

FloatArray = NDArray[np.float64]

BEYOND = (1.02, 1.1, 1.25, 1.5)
"""Loads at which states of branches are kept, relative to the critical one."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """A periodic field in which a mode family is looked for.

    Parameters
    ----------
    name
        For its file: "mode_1", "branch_1", "primary".
    text
        What it is.
    mesh, lattice
        One period [mm], with its (2, 2) lattice vectors as rows [mm].
    values
        (n, 2) at the nodes, affine part removed: modes [-], displacements [mm].
    info
        Load and whatever else must be known of it, as plain JSON values.
    """

    name: str
    text: str
    mesh: Mesh
    lattice: FloatArray
    values: FloatArray
    info: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class PatternFamily:
    """What was found in a pattern.

    Parameters
    ----------
    name, text
        As :class:`Pattern` has them.
    family, spectrum
        The mode family, and the Fourier coefficients it comes from.
    """

    name: str
    text: str
    family: FoundFamily
    spectrum: LatticeSpectrum


def why_no_modes(critical: CriticalPoint, plan: ModesPlan) -> str:
    """Why there is no wave whose modes could be computed; empty if there is one."""
    if plan.waves or critical.waves:
        return ""
    what = "long waves are modes of no finite cell" if critical.found else "nothing is critical"
    return f"no modes: {what}; name waves in [modes], such as waves = [[1, 1]]"


def find_modes(
    path: CellPath,
    material: Material,
    critical: CriticalPoint,
    plan: ModesPlan,
    info: Mapping[str, Any],
    progress: Progress = silent,
) -> tuple[ModeSet, tuple[Branch, ...]]:
    """The modes of a plan as real fields, and the branches that start with critical ones.

    Parameters
    ----------
    path
        The primary path of the primitive cell.
    material
        What that is made of.
    critical
        Its first critical point.
    plan
        Which modes and branches.
    info
        Plain JSON values to keep with the modes.
    progress
        Listener.

    Raises
    ------
    InputError
        If a wave doesn't repeat within a dozen cells, the load can't be reached, or combinations
        don't have one coefficient for each mode.
    """
    from modeharvest.fem.lattice_modes import real_modes

    state = _state(path, plan.load or critical.load)
    progress(0, 1, "modes")
    modes = real_modes(path.cell, state, plan.phases or critical.waves, info)
    progress(1, 1, "modes")
    if not critical.found or state.load != critical.load:
        return modes, ()
    return modes, tuple(_branches(path, material, modes, plan, progress))


def _branches(
    path: CellPath, material: Material, modes: ModeSet, plan: ModesPlan, progress: Progress
) -> list[Branch]:
    """A branch for each combination of modes, on their commensurate cell."""
    from modeharvest.fem.cell import CellPath, PeriodicCell
    from modeharvest.fem.postbuckling import follow

    combinations = plan.combinations or default_combinations(len(modes.waves))
    loads = plan.branch_loads or tuple(factor * modes.load for factor in BEYOND)
    cell = PeriodicCell(path.cell.cell.enlarged(*modes.info["copies"]), material)
    found = []
    for k, combination in enumerate(combinations, start=1):
        listener = _named(progress, f"branch {k} of {len(combinations)}")
        enlarged = CellPath(cell, path.loading)
        found.append(follow(enlarged, modes, combination, loads, progress=listener))
    return found


def _named(progress: Progress, name: str) -> Progress:
    """The same listener, told another name of the step."""

    def listener(done: float, total: float, what: str) -> None:
        progress(done, total, name)

    return listener


def default_combinations(count: int) -> tuple[tuple[float, ...], ...]:
    """Each of some modes alone, and the sum of all where there are more."""
    alone = [tuple(float(i == k) for i in range(count)) for k in range(count)]
    return (*alone, (1.0,) * count) if count > 1 else tuple(alone)


def patterns(
    path: CellPath,
    load: float,
    modes: ModeSet | None,
    branches: Sequence[Branch],
    info: Mapping[str, Any],
) -> list[Pattern]:
    """All fields in which families are looked for: modes, ends of branches, the primary path.

    Parameters
    ----------
    path
        The primary path of the primitive cell.
    load
        At which its fluctuation is taken [-].
    modes, branches
        What was found.
    info
        Plain JSON values to keep with each of them.
    """
    found: list[Pattern] = []
    if modes is not None:
        place = (modes.mesh, modes.lattice)
        for k, (wave, shape) in enumerate(zip(modes.waves, modes.shapes, strict=True), start=1):
            known = {**info, "load": modes.load, "wave": list(wave)}
            found.append(Pattern(f"mode_{k}", f"mode {k}", *place, shape, known))
        for k, branch in enumerate(branches, start=1):
            if branch.states:
                last = branch.states[-1]
                text = f"branch {k} at {100 * last.load:.3g} %"
                known = {**info, "load": last.load, "combination": list(branch.combination)}
                values = last.fluctuation(modes.mesh)
                found.append(Pattern(f"branch_{k}", text, *place, values, known))
    state, unit = _state(path, load), path.cell.cell
    affine = unit.mesh.nodes @ (state.gradient - np.eye(2)).T
    text = f"primary path at {100 * load:.3g} %"
    values = path.cell.displacement(state) - affine
    found.append(Pattern("primary", text, unit.mesh, unit.lattice, values, {**info, "load": load}))
    return found


def find_family(pattern: Pattern, pitch: float, path: Path) -> None:
    """Find the family of a pattern and write it, with its Fourier coefficients, as JSON."""
    place = (pattern.mesh, pattern.lattice, pattern.values, pitch)
    found = mode_family(*place, info={**pattern.info, "of": pattern.text, "name": pattern.name})
    write_family(path, found, spectrum=lattice_spectrum(*place))


def read_pattern_family(path: Path) -> PatternFamily:
    """What :func:`find_family` left in a file."""
    family, spectrum = read_family(path), read_spectrum(path)
    if spectrum is None:
        raise InputError(f"expected Fourier coefficients in {path}, found none; make it again")
    return PatternFamily(family.info["name"], family.info["of"], family, spectrum)


def _state(path: CellPath, load: float) -> CellState:
    """The state at a load; a millionth below where that is critical with the cell's own period."""
    state = path.at(load) or path.at((1.0 - 1e-6) * load)
    if state is None:
        raise InputError(f"modes: expected a load that the lattice's path reaches, got {load:.6g}")
    return state
