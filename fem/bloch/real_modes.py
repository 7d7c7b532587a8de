"""Real buckling modes of a lattice, on the smallest cell that has their period.

A Bloch eigenvector x of the primitive cell continues as u(X + R) = exp(i k . R) u(X). If the
phases of k are 2 pi times fractions, it repeats after m x n cells. If all phases are multiples
of pi, u is real; otherwise its real and imaginary parts are two modes, of the waves k and -k.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.bloch.degenerate import Degeneracy, is_same
from modeharvest.fem.bloch.eigen import BlochModes, BlochWaves
from modeharvest.fem.bloch.modes import ModeSet
from modeharvest.fem.lattice.cell import CellState, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell
from modeharvest.fem.lattice.options import Wave, wave_of
from modeharvest.util import RELEASE
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

Turns = tuple[Fraction, Fraction]
Shifts = Sequence[tuple[int, int]]  # shifts of copies along a1 and a2

_SNAP = 1e-3  # rad: largest distance from a fraction of a wave found by descent
_DEGENERATE = 1e-6  # of the eigenvalues' scale: closer eigenvalues are degenerate
_MULTIPLICITY = 6  # largest number of modes searched for at one wave
_TOLERANCE = 1e-18  # of an eigenvalue; that of a mode is the root of this
_LARGE = 0.9  # of the largest component: the first component above it fixes the phase


def real_modes(
    cell: PeriodicCell,
    state: CellState,
    waves: Sequence[Wave],
    info: Mapping[str, Any] | None = None,
    largest: int = 12,
) -> ModeSet:
    """The lowest modes at given waves as real fields on their smallest common m x n cell.

    A wave with phases 0 or pi gives one mode (or all of a degenerate eigenvalue), any other twice
    as many. Phases within 1e-3 rad of a fraction are rounded to it; a wave given twice, or as k and
    -k, counts once. InputError without waves (long waves are modes of no finite cell), and for a
    wave that doesn't repeat within ``largest`` cells.

    cell, state, waves : primitive cell; equilibrium and phases [rad], such as of a critical point.
    info, largest : plain JSON values to store with the modes; most copies along a1 or a2.
    """
    turns: list[Turns] = []
    for turn in (_commensurate(wave, largest) for wave in waves):
        if not any(is_same(_phases(turn), _phases(other)) for other in turns):
            turns.append(turn)
    if not turns:
        raise InputError(
            "modes: expected at least one wave, got none; waves much longer than the cell (loss of "
            "ellipticity) are modes of no finite cell: name a commensurate wave, such as (π, π)"
        )
    m, n = (math.lcm(*(t[axis].denominator for t in turns)) for axis in (0, 1))
    if max(m, n) > largest:
        raise InputError(
            f"modes: expected a common cell of at most {largest} x {largest} copies, got {m} x {n} "
            "for these waves together; ask for fewer of them or a larger 'largest'"
        )
    enlarged, bloch = cell.cell.enlarged(m, n), BlochWaves(cell, state)
    shifts = list(product(range(m), range(n)))
    places = _copies(cell.cell, enlarged, shifts)
    degeneracy = Degeneracy(bloch)
    found = [_lowest_set(degeneracy, _phases(turn)) for turn in turns]
    shapes = [_real_fields(cell, modes, shifts, places) for modes in found]
    repeats = [len(s) // len(modes.eigenvalues) for s, modes in zip(shapes, found, strict=True)]
    return ModeSet(
        mesh=enlarged.mesh,
        lattice=enlarged.lattice,
        primitive=cell.cell.lattice,
        waves=tuple(modes.wave for s, modes in zip(shapes, found, strict=True) for _ in s),
        eigenvalues=np.concatenate(
            [np.repeat(modes.eigenvalues, r) for modes, r in zip(found, repeats, strict=True)]
        ),
        shapes=np.concatenate(shapes),
        load=state.load,
        gradient=state.gradient,
        info={**(info or {}), "copies": [m, n], "versions": {"modeharvest": RELEASE}},
        origin=_origin(cell.cell, places),
    )


def _commensurate(wave: Wave, largest: int) -> Turns:
    """k . a / 2 pi of both lattice vectors as fractions in [0, 1)."""
    exact = [phase / (2.0 * math.pi) for phase in wave_of(wave)]
    p, q = (Fraction(turn).limit_denominator(largest) for turn in exact)
    if max(abs(p - exact[0]), abs(q - exact[1])) > _SNAP / (2.0 * math.pi):
        raise InputError(
            f"modes: expected a wave that repeats within {largest} cells along a1 and a2, got the "
            f"phases ({wave[0]:.6g}, {wave[1]:.6g}) rad; take a fraction of 2π nearby, or a larger "
            "'largest'"
        )
    return p % 1, q % 1


def _phases(turns: Turns) -> Wave:
    """Phases in (-pi, pi] [rad]."""
    p, q = (2.0 * math.pi * float(t if t <= Fraction(1, 2) else t - 1) for t in turns)
    return (p, q)


def _lowest_set(degeneracy: Degeneracy, wave: Wave) -> BlochModes:
    """The lowest eigenvalues at one wave, with all eigenvectors degenerate by symmetry."""
    bloch, cell = degeneracy.bloch, degeneracy.cell
    found = bloch.lowest(wave, _MULTIPLICITY, tolerance=_TOLERANCE)
    values = found.eigenvalues
    scale = np.linalg.norm(bloch.state.moduli) / (cell.filling * cell.cell.area)
    count = degeneracy.count(found, int(np.sum(values - values[0] < _DEGENERATE * scale)))
    return BlochModes(wave, values[:count], found.vectors[:, :count])


def canonical(vectors: NDArray[Any]) -> NDArray[Any]:
    """A canonical basis of the space of vectors (size, m), which depends only on the space.

    The first vector has the largest possible value, real and positive, at the first component
    that is large; the others are 0 there and are chosen in the same way.
    """
    sizes = np.linalg.norm(vectors, axis=1)
    row = vectors[int(np.argmax(sizes > _LARGE * sizes.max()))]
    Q, _ = np.linalg.qr(np.column_stack([row.conj(), np.eye(len(row))]))
    first = vectors @ (row.conj() / np.linalg.norm(row))
    if len(row) == 1:
        return np.asarray(first[:, None])
    return np.column_stack([first, canonical(vectors @ Q[:, 1 : len(row)])])


def _copies(cell: UnitCell, enlarged: UnitCell, shifts: Shifts) -> NDArray[np.int64]:
    """(m n, nodes) node numbers in the enlarged mesh of each copy of the cell."""
    tree = cKDTree(enlarged.mesh.nodes)
    moved = [cell.mesh.nodes + np.array(shift) @ cell.lattice for shift in shifts]
    return np.stack([tree.query(nodes)[1] for nodes in moved])


def _origin(cell: UnitCell, places: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """``UnitCell.origin`` on the enlarged mesh; for nodes shared by two copies, of the first."""
    if cell.origin is None:
        return None
    origin = np.empty(places.max() + 1, dtype=np.int64)
    for place in places[::-1]:
        origin[place] = cell.origin
    return origin


def _real_fields(
    cell: PeriodicCell, modes: BlochModes, shifts: Shifts, places: NDArray[np.int64]
) -> FloatArray:
    """(c, n, 2) orthonormal real fields of the Bloch vectors on the enlarged cell."""
    material = cell.filling * cell.cell.area
    phases = np.exp(1j * (np.array(shifts) @ np.asarray(modes.wave)))
    displaced = (cell.reduction.displacement(x, modes.wave) for x in modes.vectors.T)
    at_nodes = np.stack([u.ravel() for u in displaced], axis=1)
    fields: list[FloatArray] = []
    for field in math.sqrt(material) * canonical(at_nodes).T:
        whole = np.empty((places.max() + 1, 2), dtype=np.complex128)
        for place, phase in zip(places, phases, strict=True):
            whole[place] = phase * field.reshape(-1, 2)
        if np.isrealobj(modes.vectors):
            fields.append(whole.real)
        else:
            fields += [math.sqrt(2.0) * whole.real, math.sqrt(2.0) * whole.imag]
    return np.stack(fields)
