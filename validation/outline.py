"""The outline of a mesh: its outer edge and its holes as one exact curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.path import Path
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_CORNERS = {"T3": 3, "T6": 3, "Q4": 4, "Q8": 4, "Q9": 4}


@dataclass(frozen=True, eq=False)
class Outline:
    """The edges that belong to one element only, in closed loops.

    Parameters
    ----------
    nodes
        (n, 2) node positions of the mesh [mm].
    loops
        For each loop (m, 3) node numbers: first corner, mid-side, second corner of each edge,
        material on the left. Without mid-side nodes, the second column repeats the first.
    """

    nodes: FloatArray
    loops: tuple[IntArray, ...]

    @classmethod
    def of(cls, mesh: Mesh) -> Outline:
        """Find the outline of a mesh."""
        edges = _boundary_edges(mesh)
        following = {int(a): k for k, a in enumerate(edges[:, 0])}
        loops, seen = [], np.zeros(len(edges), dtype=bool)
        for first in range(len(edges)):
            loop, k = [], first
            while not seen[k]:
                seen[k] = True
                loop.append(k)
                k = following.get(int(edges[k, 2]), first)
            if loop:
                loops.append(edges[loop])
        return cls(mesh.nodes, tuple(loops))

    def path(self, displacement: FloatArray | None = None) -> Path:
        """The outline, displaced by (n, 2) at the mesh's nodes [mm]; holes stay open when filled.

        A quadratic edge is a parabola, which a Bezier curve of second order draws exactly.
        """
        nodes = self.nodes if displacement is None else self.nodes + displacement
        vertices, codes = [], []
        for loop in self.loops:
            a, middle, b = (nodes[loop[:, k]] for k in range(3))
            curved = loop[:, 1] != loop[:, 0]
            control = np.where(curved[:, None], 2.0 * middle - 0.5 * (a + b), 0.5 * (a + b))
            points = np.stack([control, b], axis=1).reshape(-1, 2)
            vertices.append(np.vstack([a[:1], points, a[:1]]))
            codes += [Path.MOVETO, *[Path.CURVE3] * len(points), Path.CLOSEPOLY]
        return Path(np.vstack(vertices), codes)


def _boundary_edges(mesh: Mesh) -> IntArray:
    """(m, 3) corner, mid-side, corner of the edges that only one cell has."""
    corners = _CORNERS[mesh.element]
    has_middle = mesh.cells.shape[1] > corners
    edges = []
    for k in range(corners):
        a, b = mesh.cells[:, k], mesh.cells[:, (k + 1) % corners]
        edges.append(np.stack([a, mesh.cells[:, corners + k] if has_middle else a, b], axis=1))
    every = np.vstack(edges)
    pairs = np.sort(every[:, [0, 2]], axis=1)
    _, number, count = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(every[count[number.ravel()] == 1])
