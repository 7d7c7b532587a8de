"""A hyperelastic body tied to contours by springs, with plates along its straight edges.

The displacement u that is sought minimises

    int W(I + grad u) dA + k/2 int d(X + u)^2 dS,

W is the energy density of the material law, and d the signed distance to the contour of the
deformed image, less that of the mesh's own edge to the contour of the reference. The springs k are
stiff, so that the contours decide. A straight edge that stays straight is taken to be held by a
plate without sliding. Tractions at cuts are chosen such that the springs carry least.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np
from scipy.sparse import csr_array, diags_array

from modeharvest.fem.field import Mesh, boundary_sides
from modeharvest.fem.materials import JetMatrix, Material, stress_and_tangent
from modeharvest.fem.sparse_factor import Factor, factorise
from modeharvest.idic.finite_element.contours.tied_edge import TiedEdge
from modeharvest.idic.finite_element.equations.system import Body, Imbalance
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.contour import SeenContours
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.errors import InputError

_PLATE = 1e6
"""Stiffness along edges that don't slide [shear modulus times px]."""
_RIDGE = 3.0
"""Weight of tractions, over stress, in variances of the contours' noise [-]; found by trial."""
_ROUNDS, _LONGEST_PX = 3, 8.0
"""Iterations for the tractions at cut sides, and how far one may move a node at most."""
_CORNER = np.deg2rad(35.0)
_LEAST_SIDE, _STRAIGHT, _STAYS_STRAIGHT = 0.2, 2e-3, 5e-3
"""Least length of a straight edge over that of the body; largest rms deviation from a straight
line, over the edge's length, in the reference and in the deformed image."""
_LOADED = 0.3
"""Least mean traction of an edge held by a plate, over the largest of all straight edges."""
ROUGH_PX, _STEPS = 1.0, 60
"""Step below which a minimisation has roughly converged [px]; most steps of one."""
_LEAST_DET = 0.02


def straight_sides(mesh: Mesh) -> tuple[IntArray, ...]:
    """Straight edges of a mesh between its corners: the nodes (k,) of each, in order along it."""
    sides = boundary_sides(mesh)
    after, found = dict(zip(sides[:, 0], sides, strict=True)), []
    size = float(np.ptp(mesh.nodes, axis=0).max())
    while after:
        begin, loop = next(iter(after)), []
        while begin in after:
            side = after.pop(begin)
            loop.append(side)
            begin = side[2]
        ring = np.array(loop)
        along = mesh.nodes[ring[:, 2]] - mesh.nodes[ring[:, 0]]
        before = np.roll(along, 1, axis=0)
        cross = before[:, 0] * along[:, 1] - before[:, 1] * along[:, 0]
        turn = np.abs(np.arctan2(cross, (before * along).sum(axis=1)))
        corners = np.flatnonzero(turn > _CORNER)
        for k, end in zip(corners, np.roll(corners, -1), strict=True):
            count = int((end - k) % len(ring)) or len(ring)
            part = ring[(k + np.arange(count)) % len(ring)]
            nodes = np.append(part[:, :2].ravel(), part[-1, 2])
            x = mesh.nodes[nodes]
            if np.linalg.norm(x[-1] - x[0]) > _LEAST_SIDE * size and _bend(x) < _STRAIGHT:
                found.append(nodes)
    return tuple(found)


def _bend(x: FloatArray) -> float:
    """Rms distance of points (k, 2) from a straight line, over their length."""
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    return float(spread[1] / np.sqrt(len(x)) / np.linalg.norm(x[-1] - x[0]))


class PenalisedBody:
    """A hyperelastic mesh tied to contours: the state of the energy's minimisation.

    start : (n, 2) initial displacement [mm].
    """

    def __init__(
        self, body: Body, seen: SeenContours, grid: PixelGrid, law: Material, start: FloatArray
    ) -> None:
        self.mesh, self.px, self.noise = body.mesh, grid.pixel_size, seen.noise
        self.edge = TiedEdge(body.mesh, seen, grid)
        if not self.edge.length.any():
            raise InputError("expected contours at the mesh's edge, got none")
        self.u: FloatArray = start.ravel().copy()
        self._none = np.zeros(len(self.mesh.nodes), dtype=np.bool_)
        self._use(law)
        _, self._first = self.law.forces(0.0 * self.u)
        self.stiffness = 0.0
        own, other = self.edge.on_cuts()
        self.loads, self.uneven = self.edge.loads(own), self.edge.loads(other)
        """(2 n, 3 c) nodal forces of unit tractions at cuts [mm]: resultants, and uneven ones."""
        self.tractions: FloatArray = np.zeros(own.shape[2])
        self.plates = csr_array((0, self.u.size))
        self.stretched: FloatArray = np.zeros(0)
        self.pressed: list[BoolArray] = []
        self.last_factor: Factor | None = None
        """What :meth:`factor` has returned last."""
        self._stored = 0

    def _use(self, law: Material) -> None:
        """Set the material law, and the shear modulus mu that energies and forces are over."""
        self.law = Imbalance(self.mesh, law, self._none)
        self.shear = float(stress_and_tangent(law, np.eye(2)[None])[1][0, 0, 1, 0, 1])

    def distances(self) -> tuple[FloatArray, FloatArray]:
        """Distances of edges and dots from where they are seen, at the present u; gradients."""
        return self.edge.distances(self.u.reshape(-1, 2))

    def energy(self, u: FloatArray) -> float:
        """Energy of the body and its springs, over mu [mm^2]; infinite where it is inverted."""
        F = self.law.deformation_gradient(u)
        if np.linalg.det(F).min() < _LEAST_DET:
            return np.inf
        W = self.law.material.energy(JetMatrix(F.reshape(-1, 2, 2), 0)).value
        d, _ = self.edge.distances(u.reshape(-1, 2))
        springs = self.stiffness * float(self.edge.length @ d**2)
        plates = self.plates @ u + self.stretched
        own = float(W @ np.broadcast_to(self.law.weights, F.shape[:2]).ravel())
        work = float(u @ (self.loads @ self.tractions))
        return own / self.shear + 0.5 * (springs + float(plates @ plates)) - work

    def linearised(self) -> tuple[csr_array, csr_array, FloatArray]:
        """(2 n, 2 n) tangent stiffness, the springs' part of it, and (2 n,) forces, all over mu."""
        f, K = self.law.forces(self.u)
        d, normal = self.distances()
        B = self.edge.normal_shapes(normal)
        weighed = diags_array(self.stiffness * self.edge.length) @ B
        D, springs = self.plates, csr_array(B.T @ weighed)
        forces = f / self.shear + weighed.T @ d + D.T @ (D @ self.u + self.stretched)
        forces = forces - self.loads @ self.tractions
        return csr_array(K / self.shear + springs + D.T @ D), springs, forces

    def factor(self, A: csr_array) -> Factor:
        """Factorise A, keeping the order of elimination; ArithmeticError if A is singular."""
        A.sort_indices()
        if self.last_factor is None or self._stored != A.nnz:
            self.last_factor, self._stored = factorise(A, block=2), A.nnz
        else:
            self.last_factor.update(A)
        return self.last_factor

    def relax(self, springs: float, tolerance_px: float) -> bool:
        """Newton's method with Levenberg's damping; springs in mu/px. True if it converged."""
        self.stiffness = springs / self.px
        self.edge.look(self.u.reshape(-1, 2))
        energy, damping, safe = self.energy(self.u), 1e-3, self._first / self.shear
        for _ in range(_STEPS):
            A, _, forces = self.linearised()
            while True:
                try:
                    step = self.factor(csr_array(A + damping * safe)).solve(-forces)
                    there = self.energy(self.u + step) if -step @ forces > 0.0 else np.inf
                except ArithmeticError:
                    there = np.inf
                if there < energy or damping > 1e3:
                    break
                damping *= 5.0
            longest = float(np.linalg.norm(step.reshape(-1, 2), axis=1).max()) / self.px
            if there >= energy:  # converged to rounding, or failed
                return bool(longest * (1.0 + damping) < ROUGH_PX)
            self.u, energy = self.u + step, there
            if longest * (1.0 + damping) < tolerance_px:
                return True
            damping *= 0.2
        return False

    def settle(self, springs: float, tolerance_px: float) -> bool:
        """Relax, and choose the tractions at cuts such that the springs carry least."""
        converged = self.relax(springs, tolerance_px)
        for _ in range(_ROUNDS if self.tractions.size else 0):
            A, _, _ = self.linearised()
            d, normal = self.distances()
            by_tractions, answer, kept = self.answers(self.factor(A), normal)
            more = answer @ d - kept @ self.tractions
            step = by_tractions @ more
            share = min(1.0, _LONGEST_PX * self.px / max(float(np.abs(step).max()), 1e-300))
            while share > 1e-6 and not np.isfinite(self.energy(self.u + share * step)):
                share *= 0.5
            self.tractions, self.u = self.tractions + share * more, self.u + share * step
            converged = self.relax(springs, tolerance_px)
        return converged

    def answers(self, factor: Factor, normal: FloatArray) -> tuple[FloatArray, ...]:
        """(2 n, 3 c) u by unit tractions at cuts; (3 c, q) tractions by distances; (3 c, 3 c).

        The last is the part of the tractions that contours don't show: tractions as large as the
        rms stress are taken to be as likely as distances as large as their noise.
        """
        by_tractions = factor.solve(self.loads)
        D = self.edge.normal_shapes(normal) @ by_tractions
        weighed, ridge = D.T * self.edge.length, _RIDGE * self.noise / self.stress() ** 2
        square = weighed @ D + ridge * np.eye(D.shape[1])
        kept = ridge * np.linalg.inv(square)
        return by_tractions, -np.linalg.solve(square, weighed), kept

    def stress(self) -> float:
        """Rms of a component of the first Piola-Kirchhoff stress over the body, over mu [-]."""
        F = self.law.deformation_gradient(self.u)
        P = stress_and_tangent(self.law.material, F.reshape(-1, 2, 2))[0] / self.shear
        weights = np.broadcast_to(self.law.weights, F.shape[:2]).ravel()
        return float(np.sqrt(np.average((P**2).mean(axis=(1, 2)), weights=weights)))

    def pressed_sides(self) -> tuple[IntArray, ...]:
        """The straight edges on which something presses or pulls: nodes (k,) of each."""
        d, normal = (part[: len(self.edge.points)] for part in self.distances())
        seen = self.edge.points + self.edge.shapes @ self.u.reshape(-1, 2) - d[:, None] * normal
        sides, tractions = [], []
        for nodes in straight_sides(self.mesh):
            on = self.edge.on(nodes)
            own = on & self.edge.is_tied
            if 2 * own.sum() > on.sum() and _bend(seen[own]) < _STAYS_STRAIGHT:
                sides.append(nodes)
                tractions.append(abs(np.average(d[own], weights=self.edge.whole_length[own])))
        most = max(tractions, default=0.0)
        return tuple(s for s, t in zip(sides, tractions, strict=True) if t > _LOADED * most)

    def press(self, sides: Sequence[IntArray], *, slides: bool) -> None:
        """Let plates press on straight edges, which keep their length unless they slide."""
        self.pressed = [self.edge.on(nodes) & self.edge.is_tied for nodes in sides]
        if slides or not sides:
            return
        ends = np.vstack([np.stack([nodes[:-1], nodes[1:]], axis=1) for nodes in sides])
        moved = self.mesh.nodes + self.u.reshape(-1, 2)
        along = np.vstack([np.tile(moved[s[-1]] - moved[s[0]], (len(s) - 1, 1)) for s in sides])
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        gaps = np.diff(self.mesh.nodes[ends], axis=1)[:, 0]
        length = np.linalg.norm(gaps, axis=1)
        root = np.sqrt(_PLATE * self.px / length)
        values = (root[:, None] * along)[:, None, :] * np.array([-1.0, 1.0])[:, None]
        cols = 2 * ends[:, :, None] + np.arange(2)
        rows = np.repeat(np.arange(len(ends)), 4)
        shape = len(ends), self.u.size
        self.plates = csr_array((values.ravel(), (rows, cols.ravel())), shape)
        self.stretched = root * ((along * gaps).sum(axis=1) - length)

    def take_up(self, stiffer: float) -> None:
        """Compensate how much springs yield under plates, once ``stiffer`` times as stiff."""
        d = self.distances()[0][: len(self.edge.points)]
        for own in self.pressed:
            self.edge.off[own] -= np.average(d[own], weights=self.edge.whole_length[own]) / stiffer

    def change_by(self, law: Material | None = None, slides: bool = False) -> FloatArray:
        """(n, 2) estimated change of u by another law, or by edges that slide [mm]."""
        other = copy(self)
        if law is not None:
            other._use(law)
        if slides:
            other.plates, other.stretched = self.plates[:0], self.stretched[:0]
        A, _, forces = other.linearised()
        factor = self.factor(A)
        return self.with_tractions(factor.solve(-forces)[:, None], factor).reshape(-1, 2)

    def with_tractions(
        self, u: FloatArray, factor: Factor, noise: FloatArray | float = 0.0
    ) -> FloatArray:
        """(2 n, k) changes ``u``, with those by the tractions at cuts that follow from them.

        ``noise`` (q, k): of the contours' distances, apart from their change by ``u`` [mm].
        """
        if not self.tractions.size:
            return u
        _, normal = self.distances()
        by_tractions, answer, _ = self.answers(factor, normal)
        off = self.edge.normal_shapes(normal) @ u - noise
        return np.asarray(u + by_tractions @ (answer @ off))

    def by_other_tractions(self, factor: Factor, count: int) -> FloatArray:
        """(n, 2, count) u by random tractions at cuts, uneven or not shown by contours."""
        _, normal = self.distances()
        by_tractions, answer, kept = self.answers(factor, normal)
        shape = 2, self.tractions.size, count
        z = self.stress() * np.random.default_rng(1).standard_normal(shape)
        u = factor.solve(self.uneven @ z[0])
        resultants = answer @ (self.edge.normal_shapes(normal) @ u) + kept @ z[1]
        return np.asarray(u + by_tractions @ resultants).reshape(-1, 2, count)
