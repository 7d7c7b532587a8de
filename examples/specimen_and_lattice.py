"""Compare the pattern in the middle of a finite specimen with that of the infinite lattice."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from modeharvest.fem.bloch.critical import critical_at
from modeharvest.fem.bloch.postbuckling import follow
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.experiment import Experiment
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import square
from modeharvest.fem.lattice.options import CriticalSearch, MacroLoading
from modeharvest.fem.materials import TwoTermI1
from modeharvest.fem.simulate import simulate

PITCH, DIAMETER, SIZE, STRAIN = 1.9, 1.5, 0.2, 0.128


def main() -> None:
    """Compress 6 x 10 holes; load the lattice with the mean F of the 2 x 2 cells in the middle."""
    material = TwoTermI1()
    solution = simulate(Experiment(material=material, strains=(STRAIN,), mesh_size=SIZE))
    u, tree = solution.at(STRAIN).displacement, cKDTree(solution.mesh.nodes)
    corners = PITCH * np.array([[-1, -1], [1, -1], [-1, 1]])
    at = u[tree.query(corners)[1]]
    mean = np.stack([at[1] - at[0], at[2] - at[0]], axis=1) / (2 * PITCH)

    xx, xy, yx, yy = map(float, mean.flat)
    loading, cell = MacroLoading(((xx, xy), (yx, yy))), square(PITCH, DIAMETER, SIZE)
    primitive = PeriodicCell(cell, material)
    critical = critical_at(CellPath(primitive, loading), (math.pi, math.pi), CriticalSearch(1.0))
    modes = real_modes(primitive, critical.state, critical.waves)
    path = CellPath(PeriodicCell(cell.enlarged(2, 2), material), loading)
    (state,) = follow(path, modes, (1,), [1.0]).states

    places = modes.mesh.nodes - 0.5 * PITCH
    fields = [u[tree.query(places)[1]] - places @ mean.T, state.fluctuation(modes.mesh)]
    specimen, lattice = (field - field.mean(axis=0) for field in fields)
    sizes = np.linalg.norm(specimen), np.linalg.norm(lattice)
    print(f"mean F - I: {np.round(mean, 4).tolist()}")
    print(f"correlation {np.sum(specimen * lattice) / (sizes[0] * sizes[1]):+.4f}")
    print(f"size in the specimen over size in the lattice {sizes[0] / sizes[1]:.4f}")


if __name__ == "__main__":
    main()
