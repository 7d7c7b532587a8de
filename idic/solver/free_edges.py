"""Relation between strains at the free edges of a body, learnt from a measured displacement.

A free edge carries no traction. In an isotropic elastic body of one material its normal N is then a
principal direction, and the stretch along N follows from that along the edge, in the same way
everywhere (R. W. Ogden, Non-Linear Elastic Deformations, 1984). With T along the edge in the
reference, and n normal to F T,

    F N = l^-c n,    l = |F T|,

for small strains, with c = nu/(1 - nu) in plane strain and nu in plane stress; c is learnt from all
edges. The departures of edges from it are learnt, too, including edges that aren't free: they give
the standard deviation of this relation. For an edge whose departure is neither usual nor an error
of the measurement that is larger, a fifth of its departure at least.
"""

from __future__ import annotations

import numpy as np

from modeharvest.fem.field import Mesh
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.elements import (
    nodal_sums,
    reference_element,
    shape_functions,
    shape_gradients,
)

_GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
"""Integration points along a side, from 0 to 1."""
_LEAST_SIDES = 16
"""Fewest sides to learn from."""
_LEAST = 1e-3
"""Least departure, which elements can't avoid, and least stretch [-]."""
_ROUNDS = 20
"""Iterations of the fit."""
_UNUSUAL = 5.0
"""Departure that is unusual [standard deviations]."""
_NORMAL = 1.4826
"""Standard deviation over the median of absolute values."""


def on_sides(
    mesh: Mesh, cells: IntArray, sides: IntArray, at: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points on sides of cells (s,), and gradients of the shape functions there.

    ``at`` (g,): positions along a side, from 0 to 1. Returns points (s, g, 2) [mm], slopes (s, g,
    k, 2) [1/mm] and tangents of the sides, derivatives by ``at`` (s, g, 2) [mm].
    """
    corners = reference_element(mesh.element).nodes[:3]
    begin, along = corners[sides], corners[(sides + 1) % 3] - corners[sides]
    xi, x = begin[:, None] + at[:, None] * along[:, None], mesh.nodes[mesh.cells[cells]]
    local = shape_gradients(mesh.element, xi)
    F = np.einsum("ski,sgkj->sgij", x, local)
    points = np.einsum("sgk,ski->sgi", shape_functions(mesh.element, xi), x)
    slopes = np.einsum("sgkj,sgji->sgki", local, np.linalg.inv(F))
    return points, slopes, np.einsum("sgij,sj->sgi", F, along)


class FreeEdges:
    """Edges of a T6 mesh that lie within ``inside``: left, right, bottom and top [mm]."""

    exponent = 0.0
    """The exponent c [-]."""
    deviation: tuple[float, ...] = ()
    """Standard deviations of F N along n and F T from the relation [-]; empty for few edges."""

    def __init__(self, mesh: Mesh, inside: tuple[float, float, float, float]) -> None:
        middle = mesh.cells[:, 3:]
        cell, side = np.nonzero(np.bincount(middle.ravel())[middle] == 1)
        points, slopes, along = on_sides(mesh, cell, side, _GAUSS)
        (x, y), (left, right, bottom, top) = np.moveaxis(points, 2, 0), inside
        there = ((x > left) & (x < right) & (y > bottom) & (y < top)).all(axis=1)
        ends = on_sides(mesh, cell, side, np.array([0.0, 1.0]))[2]
        ends /= np.linalg.norm(ends, axis=-1, keepdims=True)
        begin, end = (mesh.cells[cell, (side + k) % 3].argsort() for k in (0, 1))
        # Where a free edge meets a loaded one strains are singular: elements hold neither.
        corner = (ends[begin, 0] * ends[end, 1]).sum(axis=1) < np.cos(np.pi / 6.0)
        there[begin[corner]] = there[end[corner]] = False
        T = (along / np.linalg.norm(along, axis=-1, keepdims=True))[there]
        self.frame = np.stack([T, T[..., ::-1] * [1.0, -1.0]])
        """(2, s, g, 2) T and N at points of each side."""
        self.slopes = np.einsum("sgki,fsgi->fsgk", slopes[there], self.frame)
        """(2, s, g, k) slopes of the shape functions along T and N [1/mm]."""
        self.nodes, self._count = mesh.cells[cell[there]], len(mesh.nodes)

    def _turned(self, u: FloatArray) -> tuple[FloatArray, ...]:
        """(s, g) l; (s, g, 2) FT/l and n; (s, g) FN along n and along FT."""
        FT, FN = self.frame + np.einsum("fsgk,ski->fsgi", self.slopes, u.reshape(-1, 2)[self.nodes])
        length = np.maximum(np.linalg.norm(FT, axis=-1), _LEAST)
        t = FT / length[..., None]
        n = t[..., ::-1] * [1.0, -1.0]
        return length, t, n, (FN * n).sum(axis=-1), (FN * t).sum(axis=-1)

    def learn(self, u: FloatArray, uncertain: FloatArray) -> None:
        """Learn c, and the departures of u (2 n,) [mm] from the relation.

        ``uncertain`` (2 n, k): vectors whose outer products sum up to the covariance of u [mm^2].
        """
        if len(self.nodes) < _LEAST_SIDES:
            return
        length, _, _, normal, _ = self._turned(u)
        x, y = np.log(length), np.log(np.maximum(normal, _LEAST))
        weight, of_nodes = np.ones_like(x), uncertain.reshape(self._count, 2, -1)
        errors = of_nodes[self.nodes].reshape(len(self.nodes), 12, -1)
        for _ in range(_ROUNDS):
            self.exponent = -float((weight * x * y).sum() / max((weight * x**2).sum(), _LEAST**2))
            slopes, off = self._departures(u)
            variance = (np.einsum("fsgd,sdk->fsgk", slopes, errors, optimize=True) ** 2).sum(axis=3)
            spread = _NORMAL * np.median(np.abs(off).reshape(2, -1), axis=1)[:, None, None]
            usual = np.maximum(spread, _LEAST) ** 2
            square = usual + variance.mean(axis=2, keepdims=True)
            unusual = off**2 / square / _UNUSUAL**2
            weight = (1.0 + unusual[0]) ** -2 / square[0]
        self.deviation = tuple(map(float, np.sqrt(usual.ravel())))
        known = np.median(variance.reshape(2, -1), axis=1)[:, None, None]
        self._beyond = np.sqrt(np.maximum(1.0 - known / usual, 0.0))
        # The two points of a side carry the same information.
        self._root = np.sqrt(0.5 / usual / (1.0 + unusual.mean(axis=2, keepdims=True)))

    def linearised(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sums of dd' and of -dr (2 n,), r departures of u, d their derivatives, over the variance.

        The first in blocks (s, 4, 6, 6) of xx, xy, yx and yy, over the ``nodes`` of each side.
        """
        slopes, off = self._weighed(u)
        blocks = (slopes.swapaxes(1, 2) @ slopes).reshape(-1, 6, 2, 6, 2).transpose(0, 2, 4, 1, 3)
        return blocks.reshape(-1, 4, 6, 6), -self._sums(slopes, off[..., None])[:, 0]

    def samples(self, u: FloatArray, count: int) -> FloatArray:
        """(2 n, count) random vectors by departures beyond those due to errors of the learnt u."""
        slopes, _ = self._weighed(u)
        z = np.random.default_rng(2).standard_normal((len(slopes), 2, 2, count))
        return self._sums(slopes, (self._beyond * z).reshape(-1, 4, count))

    def _weighed(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(s, 4, 12) derivatives of departures by u, (s, 4) departures, over their deviation."""
        slopes, off = self._departures(u)
        slopes, off = self._root[..., None] * slopes, self._root * off
        return np.moveaxis(slopes, 0, 1).reshape(-1, 4, 12), np.moveaxis(off, 0, 1).reshape(-1, 4)

    def _departures(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(2, s, g, 12) derivatives of departures by u [1/mm], and (2, s, g) departures [-]."""
        length, t, n, normal, shear = self._turned(u)
        c, (along, across) = self.exponent, self.slopes[..., None]
        per, t, n = 1.0 / length[..., None, None], t[:, :, None], n[:, :, None]
        turn = along * n * per  # of both, by u
        of_stretch = (c * length ** (-c - 1.0))[..., None, None] * along * t
        d_normal = across * n - shear[..., None, None] * turn + of_stretch
        d_shear = across * t + normal[..., None, None] * turn
        slopes = np.stack([d_normal, d_shear])
        return slopes.reshape(*slopes.shape[:3], -1), np.stack([normal - length**-c, shear])

    def _sums(self, slopes: FloatArray, values: FloatArray) -> FloatArray:
        """(2 n, c) sums over all sides of their derivatives times values (s, 2 g, c)."""
        parts = (slopes.swapaxes(1, 2) @ values).reshape(*self.nodes.shape, -1)
        return nodal_sums(self._count, self.nodes, parts).reshape(2 * self._count, -1)
