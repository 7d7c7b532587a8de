"""Sideways bowing of compressed specimens, direct and homogenized, and why strains differ.

``scripts/env python benchmarks/homogenized_bowing.py [SECTION ...]`` prints the tables of
docs/explanation/homogenization_bowing.md, as Markdown:

- ``waves``: transverse waves along x, of the infinite lattice (Bloch) and of the homogenized
  continuum. The difference is the stiffness against gradients of shear, which the latter lacks.
- ``small``, ``large``: the 6 x 10 and the 12 x 10 specimen, followed to the point where they bow,
  which is located and proved by inertia, and from there along the stable, bowed branch.

Some rows have a second mode phi_S, the change of w by shear: the mean over the lattice's
translations of its derivative by F21 on the buckled branch at 10 %. Its amplitude v_S can't follow
the local shear freely, because its gradient costs energy. All sections take a quarter of an hour.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from homogenization import (
    JUNCTION,
    MATERIAL,
    PATTERN,
    PITCH,
    SIZE,
    FloatArray,
    analytic,
    head,
    row,
    run_sections,
    spread,
)
from scipy.sparse.linalg import eigsh
from scipy.spatial import cKDTree

from modeharvest.fem.experiment import PathOptions
from modeharvest.fem.lattice.micromorphic.body import PlateLoading
from modeharvest.fem.lattice.micromorphic.branches import follow_branch as follow_homogenized
from modeharvest.fem.lattice.micromorphic.branches import homogenize
from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody
from modeharvest.fem.lattice.micromorphic.path import HomogenizedPath
from modeharvest.fem.lattice.micromorphic.rve import RVE
from modeharvest.fem.meshing import mesh_specimen
from modeharvest.fem.path.bifurcation import follow_branch, locate_critical
from modeharvest.fem.path.continuation import PathFollower
from modeharvest.fem.path.equilibrium import EdgeCompression, Structure
from modeharvest.fem.specimen import Specimen

SHEAR, SHEAR_STRAIN = 2, 0.1
"""Index of F21 in the generalised strains; strain at which phi_S is computed [-]."""


@cache
def lattice_states(strains: tuple[float, ...]) -> list[FloatArray]:
    """Generalised strains of the buckled infinite lattice under uniaxial strain."""
    loading = PlateLoading(sides="periodic", pattern_at_plates="free")
    one = Specimen(2, 2, bulk_x=0, bulk_y=0)
    body = HomogenizedBody.of_specimen(one, analytic(), loading, divisions=(1, 1))
    return [state.strains[0] for state in homogenize(body, strains).states]


@cache
def with_shear() -> RVE:
    """RVE with two modes: the pattern, and phi_S, which is the same for either sign of it."""
    rve, (q,) = analytic(), lattice_states((SHEAR_STRAIN,))
    reduction, nodes = rve.cell.reduction, rve.cell.cell.mesh.nodes
    w = np.zeros(reduction.size)
    nodal = rve.equilibrium(q).fluctuation
    w[reduction.bloch_map.places] = (nodal - nodal[0]).ravel()
    along = reduction.displacement(rve.condensed(q, w).response[:, SHEAR])

    def in_cell(points: FloatArray) -> FloatArray:
        return np.asarray(np.mod(points / (2 * PITCH) + 1e-6, 1.0))

    tree, found = cKDTree(in_cell(nodes), boxsize=1.0), np.zeros_like(nodes)
    for step in ((0, 0), (PITCH, 0), (0, PITCH), (PITCH, PITCH)):
        distance, number = tree.query(in_cell(nodes + step))
        assert distance.max() < 1e-4, "the mesh has the lattice's translations"
        found += 0.25 * along[number]
    pattern = PATTERN.moved((-JUNCTION[0], -JUNCTION[1]))
    return RVE(rve.cell.cell, MATERIAL, [pattern, found])


def waves() -> None:
    """Print squared frequencies of slow transverse waves, half-wavelengths 12, 6 and 4 cells."""
    counts = (12, 6, 4)
    what = "12 cells: lattice, over that; homogenized; with φ_S"
    head("state", "shear modulus over density [N/mm²]", what, "6 cells", "4 cells")
    primary = [np.array([1.0 - e, 0, 0, 1, 0, 0, 0]) for e in (0.0, 0.05)]
    buckled = lattice_states((0.07, 0.1, 0.128))
    for name, q in zip(("0", "5 %", "7 %, buckled", "10 %", "12.8 %"), [*primary, *buckled],
                       strict=True):  # fmt: skip
        exact = [lattice_wave(q, n) for n in (1000, *counts)]
        texts = []
        for n, value in zip(counts, exact[1:], strict=True):
            both = (homogenized_wave(rve, q, n) / value - 1 for rve in (analytic(), with_shear()))
            texts.append(f"{value / exact[0] - 1:+.2%}; " + "; ".join(f"{x:+.2%}" for x in both))
        row(name, f"{exact[0]:.5f}", *texts)


def lattice_wave(q: FloatArray, cells: int) -> float:
    """Eigenvalue over k^2 [N/mm^2] of a Bloch wave with a half-wavelength of ``cells`` cells."""
    rve, k = analytic(), np.pi / (cells * PITCH)
    u = rve.displacement(q, np.zeros(rve.cell.reduction.size)) + rve.equilibrium(q).fluctuation
    wave = (2 * PITCH * k, 0.0)
    K = rve.cell.reduction.reduced(rve.cell.body.stiffness(u))(wave).tocsc()
    M = rve.cell.mass(wave).tocsc()
    values, vectors = eigsh(K, 4, M, sigma=-1e-3)
    across = (rve.cell.reduction.order % 2 == 1) @ (M @ vectors)
    return float(values[np.argmax(np.abs(across))]) / k**2


def homogenized_wave(rve: RVE, q: FloatArray, cells: int) -> float:
    """The same for the homogenized continuum, where v and its gradient are free."""
    k, m = np.pi / (cells * PITCH), rve.mode_count
    D = rve.equilibrium(np.concatenate([q[:5], np.zeros(3 * m - 1)])).moduli
    B = np.zeros((4 + 3 * m, 2 + m), dtype=np.complex128)
    B[0, 0] = B[2, 1] = 1j * k
    for i in range(m):
        B[4 + i, 2 + i], B[4 + m + 2 * i, 2 + i] = 1.0, 1j * k
    H = B.conj().T @ D @ B
    S = H[:2, :2] - H[:2, 2:] @ np.linalg.solve(H[2:, 2:], H[2:, :2])
    return float(np.linalg.eigvalsh(S)[0]) / rve.cell.filling / k**2


State = tuple[float, float, int]
"""Energy [N], force [N/mm], negative eigenvalues."""


def direct(size: tuple[int, int], strains: Sequence[float]) -> tuple[float, float, list[State]]:
    """Critical strain, strain of bowing and stable states of a direct simulation."""
    specimen = Specimen(*size)
    loading = EdgeCompression(specimen.half_size[0], specimen.length)
    structure = Structure(mesh_specimen(specimen, SIZE), MATERIAL, loading)
    follower = PathFollower(structure, PathOptions())
    path = [follower.start()]
    follower.follow_primary(path, strains, until_unstable=True)
    first = locate_critical(follower, path[-2], path[-1])
    assert first is not None
    states = follow_branch(follower, first, strains, 1, PITCH)
    bowed = next(k for k, state in enumerate(states) if state.negative_pivots)
    high = follower.equilibrium(states[bowed].strain, states[bowed].u)  # for its modes
    assert high is not None
    second = locate_critical(follower, states[bowed - 1], high)
    assert second is not None
    assert (second.below, second.above) == (0, 1)
    states = states[:bowed] + follow_branch(follower, second, strains[bowed:], 1, PITCH)
    return first.strain, second.strain, [
        (structure.energy(s.u), structure.reaction(s.u, specimen.length), s.negative_pivots)
        for s in states
    ]  # fmt: skip


def homogenized(
    body: HomogenizedBody, strains: Sequence[float]
) -> tuple[float, float, list[State]]:
    path = HomogenizedPath(body, PathOptions(largest_step=0.01))
    path.follow_primary(strains[-1], "all")
    first = path.critical()
    assert first is not None
    assert first.kind == "pattern"
    states, _ = follow_homogenized(path, first, strains)
    bowed = next((k for k, s in enumerate(states) if s.negative_eigenvalues), len(states))
    at = np.nan
    if bowed < len(states):
        path.states = states[bowed - 1 : bowed + 1]
        second = path.critical()
        assert second is not None
        assert (second.negative_before, second.negative_after) == (0, 1)
        at, states = second.load, states[:bowed]
        states += follow_homogenized(path, second, strains[bowed:])[0]
    return first.load, at, [(s.energy, s.force, s.negative_eigenvalues) for s in states]


Kind = tuple[str, Sequence[RVE], int, str]
"""Name, RVEs at a point, macroscopic elements per two cells, condition of v along the sides."""


def specimen(
    size: tuple[int, int], strains: Sequence[float], shown: Sequence[float], kinds: Sequence[Kind]
) -> None:
    """Print the table of one specimen, followed through ``strains`` and printed at ``shown``."""
    name, at = f"{size[0]} x {size[1]}, stable states", [list(strains).index(e) for e in shown]
    head(name, "RVEs", "ε_c", "bows at", *(f"energy, force at {e:.1%}" for e in shown),
         "negative eigenvalues", "s")  # fmt: skip
    start = time.perf_counter()
    critical, bows, exact = direct(size, strains)
    row("direct", "", f"{critical:.3%}", f"{bows:.2%}", *(
        f"{exact[k][0]:.5f} N, {exact[k][1]:.5f} N/mm" for k in at
    ), ", ".join(str(exact[k][2]) for k in at), f"{time.perf_counter() - start:.0f}")  # fmt: skip
    for kind, rves, finer, sides in kinds:
        start, loading = time.perf_counter(), PlateLoading(pattern_at_bulk=sides)
        parts = finer * size[0] // 2, finer * size[1] // 2
        body = HomogenizedBody.of_specimen(Specimen(*size), rves, loading, divisions=parts)
        e, bent, found = homogenized(body, strains)
        row(kind, body.point_count * len(rves), f"{e:.3%} ({e / critical - 1:+.2%})",
            f"{bent:.2%}" if np.isfinite(bent) else f"not up to {strains[-1]:.1%}", *(
                f"{found[k][0] / exact[k][0] - 1:+.2%}, {found[k][1] / exact[k][1] - 1:+.2%}"
                for k in at
            ), ", ".join(str(found[k][2]) for k in at),
            f"{time.perf_counter() - start:.0f}")  # fmt: skip


def small() -> None:
    strains = (0.1, 0.104, 0.108, 0.112, 0.12, 0.128, 0.135, 0.14, 0.145)
    one = [analytic()]
    specimen((6, 10), strains, (0.1, 0.128, 0.145), [
        ("one position", one, 1, "zero"), ("5 positions", spread(5), 1, "zero"),
        ("finer macroscopic mesh", one, 2, "zero"), ("v free along the sides", one, 1, "free"),
        ("one position, with φ_S", [with_shear()], 1, "zero"),
    ])  # fmt: skip


def large() -> None:
    strains = (0.09, 0.094, 0.098, 0.1, 0.105, 0.11, 0.112, 0.116, 0.12, 0.127)
    specimen((12, 10), strains, (0.09, 0.1, 0.11, 0.127), [
        ("one position", [analytic()], 1, "zero"), ("5 positions", spread(5), 1, "zero"),
    ])  # fmt: skip


SECTIONS: dict[str, Callable[[], None]] = {"waves": waves, "small": small, "large": large}


if __name__ == "__main__":
    run_sections(argparse.ArgumentParser(description=__doc__), SECTIONS)
