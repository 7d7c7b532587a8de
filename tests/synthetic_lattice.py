"""A lattice made up in memory, without gmsh or dolfinx: for the tests of its pictures and report.

Square holes in square stacking, sheared if wanted; modes, branches and eigenvalues are formulas.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.bloch.dispersion import ZONES, Dispersion, ZoneMap
from modeharvest.fem.bloch.modes import Branch, BranchState, ModeSet
from modeharvest.fem.field import Mesh
from modeharvest.idic.spectra.mode_family import wave_sum
from modeharvest.runs.lattice.results import CriticalPoint, LatticeRun, PeriodicField
from modeharvest.validation.studies.lattice import (
    EQ_MODE,
    FirstModeLimit,
    LatticeModeStudy,
    ModeRow,
    PatternMode,
)

FloatArray = NDArray[np.float64]

PITCH = 2.0
CRITICAL = 0.05
M = (np.pi, np.pi)
SHEAR = np.array([[1.0, 0.0], [0.4, 1.0]])
"""Of the rows x, y: x' = x + 0.4 y."""


def cell(copies: int = 1, shear: FloatArray | None = None) -> tuple[Mesh, FloatArray]:
    """T6 mesh of ``copies`` x ``copies`` square holes half as wide as the pitch, and its lattice.

    The first hole's centre is the origin.
    """
    n = 4 * copies
    t = np.arange(2 * n + 1) * PITCH / 8 - PITCH / 2
    X, Y = np.meshgrid(t, t)
    nodes = np.stack([X.ravel(), Y.ravel()], axis=1)
    triangles = []
    for row in range(n):
        for col in range(n):
            if row % 4 in (1, 2) and col % 4 in (1, 2):
                continue
            at = np.array([[2 * (row + i) * (2 * n + 1) + 2 * (col + j) for j in (0, 1)]
                           for i in (0, 1)])  # fmt: skip
            for corners in ((at[0, 0], at[0, 1], at[1, 1]), (at[0, 0], at[1, 1], at[1, 0])):
                a, b, c = (int(k) for k in corners)
                triangles.append([a, b, c, (a + b) // 2, (b + c) // 2, (c + a) // 2])
    used, cells = np.unique(triangles, return_inverse=True)
    turn = np.eye(2) if shear is None else shear
    mesh = Mesh(nodes[used] @ turn, cells.reshape(-1, 6), "T6")
    return mesh, copies * PITCH * turn


def modes(count: int = 1) -> ModeSet:
    """The paper's mode on the 2 x 2 cell, and as many others as wanted turned from it."""
    mesh, lattice = cell(2)
    shape = wave_sum(EQ_MODE.waves(EQ_MODE.start), mesh.nodes, PITCH)
    shapes = np.stack([shape if k % 2 == 0 else shape[:, ::-1] for k in range(count)])
    return ModeSet(
        mesh, lattice, 0.5 * lattice, (M,) * count, np.zeros(count), shapes, CRITICAL,
        np.diag([1 - CRITICAL, 1.0]), {"copies": [2, 2]},
    )  # fmt: skip


def branch(of: ModeSet, combination: tuple[float, ...], energy: float = -1e-4) -> Branch:
    """Amplitudes that rise with the root of the load; only the first combination is stable."""
    mix = np.array(combination) / np.linalg.norm(combination)
    states = []
    for load in (0.055, 0.06, 0.075):
        size = np.sqrt(load - CRITICAL)
        F = np.diag([1.0 - load, 1.0])
        u = of.mesh.nodes @ (F - np.eye(2)).T + size * np.tensordot(mix, of.shapes, 1)
        state = BranchState(load, F, np.zeros((2, 2)), 1e-3 + energy * size, 1e-3,
                            int(energy > -1e-4), u, size * mix)  # fmt: skip
        states.append(state)
    sizes = np.linspace(0.0, 0.17, 9)
    curve = np.stack([sizes, CRITICAL + sizes**2], axis=1)
    return Branch(tuple(mix.tolist()), tuple(states), "the load rises", curve)


def eigenvalue(waves: FloatArray, load: float) -> FloatArray:
    """Zero at Γ, and at M where the load is critical."""
    p, q = waves[..., 0], waves[..., 1]
    away = 2.0 - np.cos(p) - np.cos(q)
    return np.asarray(away * (1.0 - load / CRITICAL * away / 4.0))


def dispersion(loads: tuple[float, ...] = (0.0, CRITICAL, 0.06)) -> Dispersion:
    """Along the path of a square lattice, two bands, and one map beyond the critical load."""
    corners = np.array([wave for _, wave in ZONES["square"]])
    stops = (0, 8, 16, 24)
    waves = np.concatenate([np.linspace(a, b, 8, endpoint=False)
                            for a, b in pairwise(corners)]
                           + [corners[-1:]])  # fmt: skip
    steps = np.linalg.norm(np.diff(waves, axis=0), axis=1) / PITCH
    lowest = np.array([eigenvalue(waves, load) for load in loads])
    return Dispersion(
        tuple(name for name, _ in ZONES["square"]), stops, waves,
        np.concatenate([[0.0], np.cumsum(steps)]), np.array(loads),
        np.stack([lowest, lowest + 3.0], axis=-1), (zone(0.06),),
    )  # fmt: skip


def zone(load: float, lattice: FloatArray | None = None) -> ZoneMap:
    """The same over the zone."""
    phases = np.linspace(-np.pi, np.pi, 25)
    grid = np.stack(np.meshgrid(phases, phases, indexing="ij"), axis=-1)
    return ZoneMap(load, phases, eigenvalue(grid, load), cell()[1] if lattice is None else lattice)


def row(ratio: float = 0.8, loading: str = "uniaxial", **changes: Any) -> ModeRow:
    """A row of a study; the pattern comes first from d/l = 0.68 on."""
    first = ratio > 0.68
    values = {
        "material": "soft <stuff>", "loading": loading, "pitch": PITCH, "ratio": ratio,
        "divisions": 8, "found": True, "first": 0.3 * (1 - ratio),
        "kind": "pattern" if first else "long waves", "pattern": 0.31 * (1 - ratio),
        "state": 0.3 * (1 - ratio), "eigenvalue": 0.0, "overlap": 0.9 + 0.1 * ratio,
        "captured": 0.95, "waves": 2, **changes,
    }  # fmt: skip
    return ModeRow(**values)


def study() -> LatticeModeStudy:
    """Rows of two loadings, a limit, an overlay."""
    mesh, _ = cell()
    analytic = wave_sum(EQ_MODE.waves(EQ_MODE.start), mesh.nodes, PITCH)
    mode = PatternMode(row(), mesh, analytic * [1.0, 1.1], analytic)
    return LatticeModeStudy(
        tuple(row(r, name) for name in ("uniaxial", "equibiaxial") for r in (0.3, 0.6, 0.8)),
        (row(pitch=20.0, likeness=1.0),),
        (row(material="other", likeness=0.999),),
        (FirstModeLimit("uniaxial", 0.67, 0.69, "long waves"),),
        (mode,),
    )


def run(**changes: Any) -> LatticeRun:
    """Everything that the report shows; parts of it changed or taken away."""
    mesh, lattice = cell()
    set_of_modes = modes(2)
    branches = (branch(set_of_modes, (1.0, 0.0), -2e-4), branch(set_of_modes, (1.0, -1.0), -5e-5))
    point = CriticalPoint("uniaxial along x", CRITICAL, True, "critical", (M,), (0,), (1,))
    parts: dict[str, Any] = {
        "title": "Made up <for tests>",
        "case": {
            "lattice": {"kind": "square", "pitch": PITCH},
            "material": {"kind": "two-term-I1", "c1": 0.55, "c2": 0.3, "bulk": 55.0},
        },
        "command": "modeharvest modes made-up --out DIR",
        "mesh": mesh,
        "lattice": lattice,
        "pitch": PITCH,
        "critical": point,
        "dispersion": dispersion(),
        "modes": set_of_modes,
        "branches": branches,
        "patterns": tuple(
            PeriodicField.of_branch(set_of_modes, k, one, {}).analysed(PITCH)
            for k, one in enumerate(branches, start=1)
        ),
        "study": study(),
        "exports": {"modes.h5": "modes and branches"},
        "notes": ("A note <of the caller>.",),
        "versions": {"modeharvest": "0"},
    }
    return LatticeRun(**{**parts, **changes})
