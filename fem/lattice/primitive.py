"""The primitive cell of a supercell, as a part of its mesh if the mesh has that period."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.cells import UnitCell
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.errors import InputError

_SAME = 3e-6  # in fractions of lattice vectors


def primitive_cell(cell: UnitCell, wanted: bool = True) -> UnitCell:
    """The primitive cell of a lattice, with a note; the same cell if primitive or not ``wanted``.

    Its elements and nodes are those of the mesh. InputError for a supercell whose mesh differs
    between its primitive cells. Such a mesh can't be used for stability: modes that alternate
    between the cells have the supercell's period, so mesh irregularities act as imperfections,
    there is no bifurcation, and degenerate modes are split.
    """
    count, vectors = len(cell.symmetry.translations), cell.symmetry.primitive
    if count == 1:
        return cell
    text = f"[{', '.join(f'[{x:.9g}, {y:.9g}]' for x, y in vectors)}]"
    if not wanted:
        note = f"the cell holds {count} primitive ones, vectors = {text} mm: modes may mix waves"
        note += "" if _is_uniform(cell) else ", and without bifurcation: each is meshed differently"
        return replace(cell, notes=(*cell.notes, note))
    if not _is_uniform(cell):
        raise InputError(
            f"expected a primitive cell, or copies of one, got a supercell of {count} that are "
            "meshed differently: patterns that alternate between them don't bifurcate on such a "
            f"mesh; mesh one cell, with vectors = {text} mm, or set primitive = false to take it "
            "all the same"
        )
    chosen = _representatives(cell.mesh, vectors)
    used, cells = np.unique(cell.mesh.cells[chosen], return_inverse=True)
    mesh = Mesh(cell.mesh.nodes[used], cells.reshape(-1, 6).astype(np.int64), "T6")
    note = f"the given cell holds {count} primitive ones, of which one is analysed, vectors = "
    note += f"{text} mm: waves are phases along these"
    origin = None if cell.origin is None else cell.origin[used]
    return UnitCell(mesh, vectors, origin, (*cell.notes, note))


def _is_uniform(cell: UnitCell) -> bool:
    """Whether the translations of a cell's geometry map nodes onto nodes."""
    inverse, nodes = np.linalg.inv(cell.lattice), cell.mesh.nodes
    tree = cKDTree(_in_one(nodes @ inverse), boxsize=1.0)
    moved = [_in_one((nodes + move) @ inverse) for move in cell.symmetry.translations]
    return all(tree.query(place)[0].max() < _SAME for place in moved)


def _in_one(shares: FloatArray) -> FloatArray:
    """Fractional coordinates, reduced to [0, 1)."""
    return np.asarray(np.mod(np.mod(shares, 1.0), 1.0))  # twice, as -1e-17 becomes 1


def _representatives(mesh: Mesh, vectors: FloatArray) -> IntArray:
    """From each set of elements related by translations, the one nearest to the mesh's centre."""
    centres = mesh.nodes[mesh.cells[:, :3]].mean(axis=1)
    tree = cKDTree(_in_one(centres @ np.linalg.inv(vectors)), boxsize=1.0)
    pairs = tree.query_pairs(10 * _SAME, output_type="ndarray")
    n = len(centres)
    _, kind = connected_components(coo_array((np.ones(len(pairs)), pairs.T), shape=(n, n)))
    # Slightly off the centre, so that no two are equally near.
    middle = centres.mean(axis=0) + [0.0137, 0.0071] @ vectors
    order = np.argsort(np.linalg.norm(centres - middle, axis=1), kind="stable")
    return np.sort(order[np.unique(kind[order], return_index=True)[1]])
