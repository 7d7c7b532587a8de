"""Modes and branches of a lattice as plain numpy, and their files (HDF5, VTU, XDMF).

Neither dolfinx nor gmsh is needed to read or use them. The HDF5 file, readable with h5py alone, for
m modes on a cell of n nodes::

    @format "modeharvest-modes-1"   @element "T6"   @normalisation (a sentence)
    @load  load parameter of the state whose tangent the modes belong to [-]
    @info  JSON: material, loading, whether and where it is critical, versions ...
    nodes (n, 2) [mm], undeformed      cells (e, 6), nodes as in VTK, from 0
    lattice (2, 2) [mm], rows a1, a2 of this cell      primitive (2, 2) of the lattice itself
    waves (m, 2) [rad], phases (k . a1, k . a2) from primitive cell to primitive cell
    eigenvalues (m,) [N/mm^4]          shapes (m, n, 2) [-]      gradient (2, 2) F̄ [-]
    origin (n,) numbers of the nodes in the user's own file, -1: not in it; only where there is one
    branches/0000/combination (m,)  curve (p, 2) amplitude [mm], load [-]   @outcome
    branches/0000/states/0000/displacement (n, 2) [mm]  gradient  stress [MPa]
                              amplitudes (m,) [mm]      @load @energy @primary_energy [MPa]
                              @negative_eigenvalues

VTU and XDMF (one file each) have the same fields as point data, named by meaning and unit; all
other values are JSON in a comment at the top.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from modeharvest.fem.field import (
    COMPRESSED,
    Mesh,
    in_space,
    read_mesh,
    read_values,
    write_mesh,
    write_values,
)
from modeharvest.fem.lattice.options import Wave
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, atomic_hdf5, open_hdf5

NORMALISATION = "the mean over the cell's material of phi_i . phi_j is 1 for i = j, otherwise 0"


@dataclass(frozen=True, eq=False)
class ModeSet:
    """Real modes of a lattice on the smallest cell that has their period."""

    mesh: Mesh
    """T6 mesh of the commensurate cell, undeformed [mm]."""
    lattice: FloatArray
    primitive: FloatArray
    """Lattice vectors of the commensurate and of the primitive cell as rows (2, 2) [mm]."""
    waves: tuple[Wave, ...]
    """(m,) phases (k . a1, k . a2) of each mode from primitive cell to primitive cell [rad]."""
    eigenvalues: FloatArray
    """(m,) eigenvalues of K x = lambda M x, M of unit density [N/mm^4]; ~0 at a critical point."""
    shapes: FloatArray
    """(m, n, 2) nodal modes [-], orthonormal: the mean of phi_i . phi_j over the material is
    delta_ij. The sign is such that the first large component is positive. Waves with phases other
    than 0 and pi have pairs of modes, the real and the imaginary part."""
    load: float
    gradient: FloatArray
    """Load parameter and F̄ (2, 2) of the state whose tangent the modes belong to [-]."""
    info: Mapping[str, Any] = field(default_factory=dict)
    """Plain JSON values: lattice, material, loading, where it is critical, versions."""
    origin: IntArray | None = None
    """(n,) ``UnitCell.origin`` of the node that each node is a copy of."""

    def __post_init__(self) -> None:
        count = len(self.waves)
        expected = {"shapes": (count, len(self.mesh.nodes), 2), "eigenvalues": (count,)}
        expected |= dict.fromkeys(("lattice", "primitive", "gradient"), (2, 2))
        for name, shape in expected.items():
            values = getattr(self, name)
            if values.shape != shape or not np.isfinite(values).all():
                what = f"finite {name} of shape {shape}"
                raise InputError(f"modes: expected {what}, got {values.shape}")


@dataclass(frozen=True, eq=False)
class BranchState:
    """An equilibrium of the commensurate cell beyond the critical point."""

    load: float
    gradient: FloatArray
    stress: FloatArray
    """(2, 2) F̄ [-] and P̄ [MPa]."""
    energy: float
    primary_energy: float
    """Stored energy per area of the cell, on the branch and on the primary path at the same load
    [MPa]; NaN if the latter ends before. Under a nonzero stress, the path with the lower energy
    minus P̄ : F̄ is preferred."""
    negative_eigenvalues: int
    """Number for the cell's tangent with F̄'s free components; 0: stable in the cell's period."""
    displacement: FloatArray
    """(n, 2) displacement of the mesh's nodes [mm]."""
    amplitudes: FloatArray
    """(m,) mean of (u - affine part - primary fluctuation) . phi_i over material [mm]."""

    def fluctuation(self, mesh: Mesh) -> FloatArray:
        """(n, 2) displacement without its affine part (F̄ - I) X [mm]."""
        return np.asarray(self.displacement - mesh.nodes @ (self.gradient - np.eye(2)).T)


@dataclass(frozen=True, eq=False)
class Branch:
    """A buckled branch: its initial combination of modes, and its states."""

    combination: tuple[float, ...]
    """(m,) coefficients of the modes at the start, of unit length [-]."""
    states: tuple[BranchState, ...]
    """States by load; empty if it could not be followed. A load met twice appears twice."""
    outcome: str
    """How far it was followed, and why no farther."""
    curve: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    """(p, 2) amplitude of the combination [mm] and load [-] at all points of the branch."""


FORMAT = "modeharvest-modes-1"
_OF_SET = ("lattice", "primitive", "eigenvalues", "gradient")


def write_modes(path: Path | str, modes: ModeSet, branches: Sequence[Branch] = ()) -> None:
    """Write HDF5, atomically and losslessly; the module's docstring describes the layout."""
    with atomic_hdf5(path) as file:
        file.attrs["format"] = FORMAT
        file.attrs["normalisation"] = NORMALISATION
        file.attrs["load"] = modes.load
        file.attrs["info"] = json.dumps(dict(modes.info))
        write_mesh(file, modes.mesh)
        file.create_dataset("shapes", data=modes.shapes, **COMPRESSED)
        file["waves"] = np.asarray(modes.waves, dtype=np.float64)
        for name in _OF_SET:
            file[name] = getattr(modes, name)
        if modes.origin is not None:
            file["origin"] = modes.origin
        for k, branch in enumerate(branches):
            group = file.create_group(f"branches/{k:04d}")
            group.attrs["outcome"] = branch.outcome
            group["combination"] = np.asarray(branch.combination, dtype=np.float64)
            group["curve"] = branch.curve
            for n, state in enumerate(branch.states):
                write_values(group.create_group(f"states/{n:04d}"), state)


def read_modes(path: Path | str) -> tuple[ModeSet, tuple[Branch, ...]]:
    """Read a file of :func:`write_modes`; InputError for any other file."""
    with open_hdf5(path, "modes (HDF5)", "make it again with 'modeharvest modes'", FORMAT) as file:
        modes = ModeSet(
            mesh=read_mesh(file),
            waves=tuple((float(p), float(q)) for p, q in file["waves"][:]),
            load=float(file.attrs["load"]),
            info=json.loads(file.attrs["info"]),
            origin=file["origin"][:] if "origin" in file else None,
            **{name: file[name][:] for name in ("shapes", *_OF_SET)},
        )
        groups = file.get("branches", {})
        branches = tuple(_read_branch(groups[name], modes) for name in sorted(groups))
        return modes, branches


def write_vtu(path: Path | str, modes: ModeSet, branches: Sequence[Branch] = ()) -> None:
    """Write modes and branches as VTU for ParaView, atomically."""
    _write_meshio(path, modes, branches, "vtu")


def write_xdmf(path: Path | str, modes: ModeSet, branches: Sequence[Branch] = ()) -> None:
    """Write modes and branches as XDMF, atomically, with all numbers in one file."""
    _write_meshio(path, modes, branches, "xdmf", data_format="XML")


def _read_branch(group: h5py.Group, modes: ModeSet) -> Branch:
    groups = group.get("states", {})
    states = tuple(read_values(groups[name], BranchState) for name in sorted(groups))
    for shape in (state.displacement.shape for state in states):
        if shape != modes.mesh.nodes.shape:
            raise InputError(f"displacements of shape {shape} on {len(modes.mesh.nodes)} nodes")
    combination = tuple(float(c) for c in group["combination"][:])
    return Branch(combination, states, str(group.attrs["outcome"]), group["curve"][:])


def _write_meshio(
    path: Path | str, modes: ModeSet, branches: Sequence[Branch], kind: str, **options: str
) -> None:
    mesh = in_space(modes.mesh, _fields(modes, branches))
    with atomic(path) as temporary:
        mesh.write(temporary, file_format=kind, **options)
        _comment(temporary, _described(modes, branches))


def _fields(modes: ModeSet, branches: Sequence[Branch]) -> dict[str, Any]:
    """Nodal vectors by names that state meaning and unit."""
    named: dict[str, Any] = {} if modes.origin is None else {"node_in_file": modes.origin}
    for k, (wave, shape) in enumerate(zip(modes.waves, modes.shapes, strict=True), start=1):
        phases = "_".join(f"{phase / np.pi:.4g}pi" for phase in wave)
        named[f"mode_{k}_phases_{phases}_unit_mean_square"] = shape
    for k, branch in enumerate(branches, start=1):
        for number, state in enumerate(branch.states, start=1):
            where = f"branch_{k}_state_{number}_load_{state.load:.6g}"
            named[f"{where}_displacement_mm"] = state.displacement
            named[f"{where}_fluctuation_mm"] = state.fluctuation(modes.mesh)
    return named


def _described(modes: ModeSet, branches: Sequence[Branch]) -> dict[str, Any]:
    """Everything except nodal fields, as plain JSON values."""
    outcomes = [{"combination": list(b.combination), "outcome": b.outcome} for b in branches]
    return {
        "format": FORMAT,
        "normalisation": NORMALISATION,
        "load": modes.load,
        "gradient": modes.gradient.tolist(),
        "lattice_mm": modes.lattice.tolist(),
        "primitive_mm": modes.primitive.tolist(),
        "waves_rad": [list(wave) for wave in modes.waves],
        "eigenvalues_N_per_mm4": modes.eigenvalues.tolist(),
        "branches": outcomes,
        "info": dict(modes.info),
    }


def _comment(path: Path, content: dict[str, Any]) -> None:
    """Put JSON into a comment before the first element of an XML file."""
    text = path.read_text("utf-8")
    # Comments must not contain two hyphens; in JSON strings they can be escaped.
    words = json.dumps(content).replace("--", "-\\u002d")
    start = text.index("?>") + 2 if text.startswith("<?xml") else 0
    path.write_text(f"{text[:start]}\n<!-- {words} -->{text[start:]}".lstrip(), "utf-8")
