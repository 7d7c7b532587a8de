"""The edge of a mesh, and dots, tied to contours seen in images; ligaments that images cut.

Dots on the material are tied at their centres, by springs as stiff as those along a contour of half
their circumference: a circle's centre is as well known as that, in each direction.

Where an image's border cuts the body, unknown tractions act. On each cut ligament, or piece of a
ligament cut lengthwise, they have two resultants and a moment.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, vstack
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh, boundary_sides
from modeharvest.idic.finite_element.result import located
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.contour import Contours, SeenContours
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.elements import shape_functions

_FAR_PX = 3.0
"""Points of the mesh's edge farther than this from the reference's contour aren't tied to it."""
_CUT_PX = 5.0
"""Element sides nearer than this to the image's border are cut by it: masks are rounded there."""
_TURNED = 0.3
"""Least cosine of the angle between an edge's normals in both images."""
_MOST_SIDES = 4
"""Most element sides in one piece of a cut, whose tractions have two resultants and a moment."""
_GAUSS, _WEIGHTS = 0.5 + np.array([-0.5, 0.0, 0.5]) * np.sqrt(0.6), np.array([5, 8, 5]) / 18.0
_TINY = 1e-200


class TiedEdge:
    """Points of a mesh's edge, tied to contours, and dots, tied in two directions each."""

    def __init__(self, mesh: Mesh, seen: SeenContours, grid: PixelGrid) -> None:
        t, pixel_size = _GAUSS, grid.pixel_size
        N = np.stack([(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)], axis=1)
        dN = np.stack([4 * t - 3, 4 - 8 * t, 4 * t - 1], axis=1)
        sides = boundary_sides(mesh)
        x = mesh.nodes[sides]
        speed = np.linalg.norm(np.einsum("qa,sai->sqi", dN, x), axis=2)
        self.length = (speed * _WEIGHTS).ravel()
        self.points = np.einsum("qa,sai->sqi", N, x).reshape(-1, 2)
        rows = np.repeat(np.arange(len(self.points)), 3)
        cols = np.repeat(sides, t.size, axis=0).ravel()
        values, shape = np.tile(N, (len(sides), 1)).ravel(), (len(self.points), len(mesh.nodes))
        self.shapes = csr_array((values, (rows, cols)), shape)
        every = np.vstack([contour.points for contour in seen.reference])
        number = np.repeat(np.arange(len(seen.reference)), [len(c.points) for c in seen.reference])
        self.number = number[cKDTree(every).query(self.points)[1]]
        self.deformed = Contours(seen.deformed)
        self.off, self.normal, beyond = Contours(seen.reference).distance(self.points, self.number)
        self.off[beyond] = 0.0
        self.cut = np.where(seen.is_part, _cut_ligaments(mesh, sides, grid), -1).repeat(t.size)
        """(q,) number, from 0, of the ligament that the image's border cuts; -1 elsewhere."""
        self.whole_length = self.length.copy()
        self.is_tied = (np.abs(self.off) < _FAR_PX * pixel_size) & (self.cut < 0)
        """(q,) whether a point of the edge is tied to a contour."""
        self.has_left = np.zeros(len(self.points), dtype=np.bool_)
        """(q,) whether a point has left its contour in the deformed image, see :meth:`look`."""
        dots = np.array([[c.moments[1] for c in pair] for pair in seen.dots]).reshape(-1, 2, 2)
        half = np.array([0.5 * contour.length for contour, _ in seen.dots])
        self.length = np.append(np.where(self.is_tied, self.length, 0.0), half.repeat(2))
        """(q + 2 p,) length that a spring represents [mm]: q on the edge, p dots along x and y."""
        self.dots_moved = dots[:, 1] - dots[:, 0]
        element, xi = located(mesh, dots[:, 0], True)
        own, size = mesh.cells[element], (len(dots), len(mesh.nodes))
        of = np.arange(len(dots)).repeat(own.shape[1])
        values = shape_functions(mesh.element, xi).ravel()
        self.at_dots = csr_array((values, (of, own.ravel())), shape=size)
        both = np.arange(len(dots)).repeat(2)
        self._springs = csr_array(vstack([self.shapes, self.at_dots[both]], "csr"))

    def loads(self, tractions: FloatArray) -> FloatArray:
        """(2 n, k) nodal forces of tractions (q, 2, k) [N/mm]."""
        parts = (self.whole_length[:, None, None] * tractions).reshape(len(self.points), -1)
        return np.asarray(self.shapes.T @ parts).reshape(2 * self.shapes.shape[1], -1)

    def on_cuts(self) -> tuple[FloatArray, FloatArray]:
        """Tractions (q, 2, 3 c) on c cut ligaments: their forces and moments, and uneven ones."""
        c = int(self.cut.max()) + 1
        own, other = (np.zeros((len(self.points), 2, 3 * c)) for _ in range(2))
        for k in range(c):
            at, share = self.cut == k, self.whole_length[self.cut == k]
            x = self.points[at] - np.average(self.points[at], axis=0, weights=share)
            s = x @ np.linalg.svd(x, full_matrices=False)[2][0]
            s /= max(float(np.abs(s).max()), 1e-12)
            own[at, 0, 3 * k] = own[at, 1, 3 * k + 1] = 1.0
            turn = x[:, ::-1] * [-1.0, 1.0]
            own[at, :, 3 * k + 2] = turn / max(float(np.abs(turn).max()), 1e-12)
            uneven = s**2 - np.average(s**2, weights=share)
            other[at, 0, 3 * k] = other[at, 1, 3 * k + 1] = uneven
            other[at, :, 3 * k + 2] = own[at, ::-1, 3 * k + 2]  # along the cut
            square = np.average((other[at] ** 2).sum(axis=1), axis=0, weights=share)
            other[at] /= np.sqrt(np.maximum(square, _TINY))  # of size 1, as the forces
        return own, other

    def on(self, side: IntArray) -> BoolArray:
        """(q,) which points are on a side of nodes (k,)."""
        return np.isin(self.shapes.indices.reshape(-1, 3)[:, 1], side)

    def look(self, u: FloatArray) -> None:
        """Find which points have left the image at displacements (n, 2).

        Those are beyond the end of a cut contour, or nearest to a part of it with another normal.
        """
        x, is_cut = self.points + self.shapes @ u, self.deformed.is_cut[self.number]
        _, normal, beyond = self.deformed.distance(x, self.number)
        turned = (normal * self.normal).sum(axis=1) < _TURNED
        self.has_left = beyond | (is_cut & turned)

    def distances(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(q + 2 p,) signed distances [mm] at displacements (n, 2), (q + 2 p, 2) their gradients.

        Both are 0 where :meth:`look` found that a point has left the image; if that changed from
        iteration to iteration, the energy would jump.
        """
        d, normal, _ = self.deformed.distance(self.points + self.shapes @ u, self.number)
        d = np.where(self.has_left, 0.0, d - self.off)
        normal[self.has_left] = 0.0
        off = self.at_dots @ u - self.dots_moved
        along = np.tile(np.eye(2), (len(off), 1))
        return np.append(d, off.ravel()), np.vstack([normal, along])

    def normal_shapes(self, normal: FloatArray) -> csr_array:
        """Matrix (q + 2 p, 2 n) from displacements to components along normals (q + 2 p, 2)."""
        shapes = self._springs
        data = shapes.data[:, None] * normal.repeat(np.diff(shapes.indptr), axis=0)
        cols = 2 * shapes.indices[:, None] + np.arange(2)
        return csr_array(
            (data.ravel(), cols.ravel(), 2 * shapes.indptr), (len(normal), 2 * shapes.shape[1])
        )


def _cut_ligaments(mesh: Mesh, sides: IntArray, grid: PixelGrid) -> IntArray:
    """(s,) number of the cut ligament that a side (s, 3) of the mesh's edge is on; -1 for none."""
    left, right, bottom, top = grid.extent
    x, y = mesh.nodes[sides[:, 1]].T
    from_borders = np.array([x - left, right - x, y - bottom, top - y])
    near = from_borders.min(axis=0) < _CUT_PX * grid.pixel_size
    own, size = sides[near], len(mesh.nodes)
    joined = csr_array((np.ones(len(own)), (own[:, 0], own[:, 2])), shape=(size, size))
    _, of_node = connected_components(joined, directed=False)
    which = 4 * of_node[own[:, 0]] + from_borders[:, near].argmin(axis=0)
    key, number = which * len(sides), np.full(len(sides), -1)
    for k in np.unique(key):  # cut lengthwise, in pieces
        x = mesh.nodes[own[key == k, 1]]
        along = (x - x.mean(axis=0)) @ np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2][0]
        key[key == k] += along.argsort().argsort() // _MOST_SIDES
    number[near] = np.unique(key, return_inverse=True)[1]
    return number
