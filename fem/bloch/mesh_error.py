"""Quality of a cell's mesh: elements across its ligaments, and the error of a critical load.

The error is estimated from the same critical point on a mesh refined once, with every element
divided into four in its local coordinates. The error of the boundary's geometry is not included.
"""

from __future__ import annotations

import numpy as np

from modeharvest.fem.bloch.critical import LatticeCritical
from modeharvest.fem.bloch.eigen import BlochWaves
from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell
from modeharvest.fem.lattice.foreign import NODES
from modeharvest.fem.lattice.options import CriticalSearch
from modeharvest.fem.lattice.periodicity import PARTS
from modeharvest.fem.lattice.symmetry import HoleEdges
from modeharvest.fem.materials import Material
from modeharvest.fem.meshing import MeshBlock, join
from modeharvest.util.arrays import FloatArray

SMOOTH, NOTCHED = 2.0, 1.0
"""Least orders of convergence of critical loads, for smooth and for notched edges of holes: 2.6 to
3.6 is observed for round holes (docs/explanation/bloch.md); notches make strains singular."""
_NOTCH = 0.35  # rad: a larger kink counts as a notch
ENOUGH = 3
"""Recommended least number of elements across a ligament."""


def load_error(
    found: LatticeCritical, path: CellPath, material: Material, search: CriticalSearch
) -> tuple[float, float] | None:
    """Estimated error of the critical load [-], from one refinement, and the assumed order p.

    None without a critical load, or if the search isn't to ``refine``. By Richardson's
    extrapolation the error is the change of the load times 2^p / (2^p - 1), by which the load is
    too high. As p is assumed at its lowest, this is a bound rather than a correction.
    """
    if not (found.found and search.refine):
        return None
    cell = path.cell.cell
    order = NOTCHED if HoleEdges(cell.mesh, cell.periodicity).sharpest > _NOTCH else SMOOTH
    shortest = float(np.linalg.norm(cell.lattice, axis=1).min())
    finer = UnitCell(refined(cell.mesh, 1e-7 * shortest), cell.lattice)
    nested = CellPath(PeriodicCell(finer, material), path.loading)
    for load in np.arange(0.0, 0.88 * found.load, search.largest_step):  # by short steps
        nested.at(float(load))
    # The critical eigenvalue is almost linear in the load: its zero follows from three values.
    loads, values, like = found.load * np.array([0.88, 0.93, 0.98]), [], found.least_stable
    for load in loads:
        if (state := nested.at(float(load))) is None:
            return None
        waves = BlochWaves(nested.cell, state)
        at_wave = like.angle is None
        value = waves.lowest(like.wave).eigenvalues[0] if at_wave else waves.long_wave()[0]
        values.append(float(value))
    change = found.load - float(np.polyfit(values, loads, 2)[-1])
    return change * 2.0**order / (2.0**order - 1.0), order


def refined(mesh: Mesh, tolerance: float) -> Mesh:
    """The T6 mesh with every element divided into four; merges nodes within tolerance [mm]."""
    blocks = []
    for corners in np.array(NODES)[PARTS]:
        places = np.vstack([corners, 0.5 * (corners + np.roll(corners, -1, axis=0))])
        x, y = places.T
        L = np.stack([1.0 - x - y, x, y], axis=1)
        N = np.hstack([L * (2.0 * L - 1.0), 4.0 * L * np.roll(L, -1, axis=1)])
        nodes = np.einsum("kn,end->ekd", N, mesh.nodes[mesh.cells])
        blocks.append(MeshBlock(nodes.reshape(-1, 2), np.arange(6 * len(nodes)).reshape(-1, 6)))
    return join(blocks, tolerance)


def elements_across(cell: UnitCell) -> tuple[int, FloatArray]:
    """Fewest elements between two holes, including copies, and their position [mm].

    Layers of elements are counted from each hole; two holes meet where a side joins nodes that are
    nearest to different holes. Ligaments between parts of the same hole are not considered.
    """
    p, edges = cell.periodicity, HoleEdges(cell.mesh, cell.periodicity)
    sides = np.concatenate([cell.mesh.cells[:, [k, (k + 1) % 3]] for k in range(3)])
    sides = np.concatenate([sides, sides[:, ::-1]])
    (a, b), step = p.master[sides].T, p.shift[sides[:, 1]] - p.shift[sides[:, 0]]
    hole, copy = np.full(p.count, -1), np.zeros((p.count, 2), dtype=np.int64)
    hole[edges.masters], copy[edges.masters] = edges.hole, edges.copy
    layer = np.where(hole < 0, -1, 0)
    while True:
        reached = np.flatnonzero((layer[a] == layer.max()) & (layer[b] < 0))
        if not len(reached):
            break
        hole[b[reached]], copy[b[reached]] = hole[a[reached]], copy[a[reached]] - step[reached]
        layer[b[reached]] = layer.max() + 1
    meet = np.flatnonzero((hole[a] != hole[b]) | np.any(copy[a] - step != copy[b], axis=1))
    if not (len(edges.areas) and len(meet)):
        return len(cell.mesh.cells), cell.mesh.nodes[0]
    across = layer[a[meet]] + layer[b[meet]] + 1
    least = int(np.argmin(across))
    return int(across[least]), cell.mesh.nodes[sides[meet[least]]].mean(axis=0)


def ligament_notes(cell: UnitCell) -> list[str]:
    """A warning if there are too few elements across a ligament."""
    count, (x, y) = elements_across(cell)
    few = f"only {count} element{'s' * (count > 1)} across the ligament at ({x:.4g}, {y:.4g}) mm"
    return [] if count >= ENOUGH else [f"{few}: take {ENOUGH} or more, bending is too stiff so"]
