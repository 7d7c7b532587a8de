"""Displacement of a body from its contours alone: a hyperelastic mesh tied to them by springs.

A surface without speckle shows where its material ends, but nothing inside or along an edge.
Mechanics supplies what is missing there. The displacement u that is sought minimises

    int W(I + grad u) dA + k/2 int d(X + u)^2 dS,

W is the energy density of the material law, and d the signed distance to the contour of the
deformed image, less that of the mesh's own edge to the contour of the reference. The springs k are
stiff, so that the contours decide. With the right law, free edges have no traction and the springs
carry nothing; a wrong law therefore has little effect, which is estimated by how much laws of other
compressibility change u. A straight edge that stays straight is taken to be held by a plate without
sliding. Contours don't show sliding; what it would change counts in the standard deviation. Dots on
the material are tied at their centres, by springs as stiff as those along a contour of half their
circumference: a circle's centre is as well known as that, in each direction.

Where an image's border cuts the body, unknown tractions act. On each cut ligament, or piece of a
ligament cut lengthwise, they have two resultants and a moment, which are chosen such that the
springs carry least. Other tractions there matter nearby only (Saint-Venant), and count in the
standard deviation as if they were as large as the stress in the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import partial

import numpy as np
from scipy.sparse import csr_array, diags_array, vstack
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh, boundary_sides
from modeharvest.fem.materials import JetMatrix, Material, Ogden, stress_and_tangent
from modeharvest.fem.sparse_factor import Factor, factorise
from modeharvest.idic.finite_element.cutoff import Deviations, gradient_covariance
from modeharvest.idic.finite_element.fields import interpolation_error
from modeharvest.idic.finite_element.result import NodalResult, located
from modeharvest.idic.finite_element.system import SAMPLES, SOME, Body, Imbalance
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.contour import Contours, SeenContours
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.elements import shape_functions
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent

ELASTOMER = Ogden(moduli=(2.0,), exponents=(2.0,), kappa=9.0)
"""Neo-Hookean law, Poisson's ratio 0.45, which is assumed where a body's law isn't known."""
_SOFTER, _STIFFER = 7.0 / 3.0, 49.0
"""Volumetric constants, over the shear modulus, for Poisson's ratios 0.35 and 0.49."""
_SPRINGS = (0.5, 5.0)
"""Stiffnesses of the springs, used one after the other [shear modulus/px]."""
_PLATE = 1e6
"""Stiffness along edges that don't slide [shear modulus times px]."""
_FAR_PX = 3.0
"""Points of the mesh's edge farther than this from the reference's contour aren't tied to it."""
_CUT_PX = 5.0
"""Element sides nearer than this to the image's border are cut by it: masks are rounded there."""
_TURNED = 0.3
"""Least cosine of the angle between an edge's normals in both images."""
_MOST_SIDES = 4
"""Most element sides in one piece of a cut, whose tractions have two resultants and a moment."""
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
_GAUSS, _WEIGHTS = 0.5 + np.array([-0.5, 0.0, 0.5]) * np.sqrt(0.6), np.array([5, 8, 5]) / 18.0
_ROUGH_PX, _TOLERANCE_PX, _STEPS = 1.0, 0.01, 60
_LEAST_DET = 0.02
_PROBES, _TINY = 4, 1e-200
_ASTRAY = (
    "The displacement from contours didn't converge: don't use it; give pictures in between, or of "
    "more pixels across notches and slits."
)
_UNEXPLAINED_PX = 0.05
"""Rms distance from contours, beyond their noise, that shows that pictures are thresholded."""
_STEP_PX, STEPS_PX3 = 1.0 / np.sqrt(6.0), 0.6765**2 / np.pi
"""Of two thresholded pictures: standard deviation of a straight edge's position, rectangular in
each, and variance of a hole's edge times its length [px^3], as the hole's area is known to 0.6765
sqrt(radius) in each: M. G. Kendall, Q. J. Math. 19 (1948) 1."""
_STEPPED = (
    "Contours are met within {:.2f} px, of which noise explains {:.2f} px: thresholded pictures, "
    "or a body far from the assumed law. Standard deviations are those of thresholded pictures."
)
_TRIANGULAR, _RECTANGULAR = 6.0, 3.0
"""Half-width squared over variance of a triangular distribution (most likely in the middle), and of
a rectangular one (equally likely everywhere); JCGM 100, 4.3.7 and 4.3.9."""


class _Edge:
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


class _PenalisedBody:
    """A hyperelastic mesh tied to contours: the state of the energy's minimisation."""

    def __init__(
        self, body: Body, seen: SeenContours, grid: PixelGrid, law: Material, start: FloatArray
    ) -> None:
        self.mesh, self.px, self.noise = body.mesh, grid.pixel_size, seen.noise
        self.edge = _Edge(body.mesh, seen, grid)
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
        self._factor: Factor | None = None
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
        if self._factor is None or self._stored != A.nnz:
            self._factor, self._stored = factorise(A, block=2), A.nnz
        else:
            self._factor.update(A)
        return self._factor

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
                return bool(longest * (1.0 + damping) < _ROUGH_PX)
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


def displacement_from_contours(
    seen: SeenContours, body: Body, grid: PixelGrid, start: FloatArray, law: Material | None = None,
    *, slides: bool = False, progress: Progress = silent,
) -> NodalResult:  # fmt: skip
    """Find the displacement of a body from the contours of its edges.

    InputError if no contour is at the mesh's edge, or the contours don't hold the body.

    seen : contours in the reference and in the deformed image [mm].
    body : T6 mesh of the material in the reference.
    grid : pixels of the images.
    start : (n, 2) initial displacement [mm], with which each contour is nearer than half a hole to
        its counterpart in the deformed image; an affine motion will do.
    law : material law of the body, in plane strain; by default :data:`ELASTOMER`. Scale-free.
    slides : whether edges slide on plates, which contours don't show; by default they don't.
    progress : progress listener.
    """
    state = _PenalisedBody(body, seen, grid, law or ELASTOMER, start)
    soft, stiff = _SPRINGS
    step = partial(progress, total=3, what="displacement from contours")
    try:
        step(0)
        state.settle(soft, _ROUGH_PX)
        sides = state.pressed_sides()
        state.press(sides, slides=slides)
        step(1)
        state.settle(soft, 10.0 * _TOLERANCE_PX)
        before = state.u
        step(2)
        state.take_up(stiff / soft)
        converged = state.settle(stiff, _TOLERANCE_PX)
        step(3)
        u, mesh = state.u.reshape(-1, 2), body.mesh
        left = np.asarray(state.u - before).reshape(-1, 2) * (soft / (stiff - soft))
        d, _ = state.distances()
        rms = float(np.sqrt(np.average(d**2, weights=state.edge.length))) / state.px
        by_noise = float(np.sqrt(seen.noise / seen.correlated)) / state.px
        if is_stepped := rms**2 > by_noise**2 + _UNEXPLAINED_PX**2:
            state.noise = max(seen.noise, STEPS_PX3 * state.px**3)
        sd, known = _deviations(state, law is None, bool(sides) and not slides, is_stepped, left)
    except ArithmeticError as error:
        raise InputError(f"expected contours that hold the body, got others: {_ASTRAY}") from error
    stepped = (_STEPPED.format(rms, by_noise),) if is_stepped else ()
    return NodalResult(
        mesh=mesh,
        displacement=u,
        start=start,
        standard_deviation=np.hypot(sd.by_noise, sd.bias),
        noise_deviation=sd.by_noise,
        gradient_covariance=sd.gradient,
        roots=sd.roots,
        grid=grid,
        cutoff_px=None,
        tried=(),
        residual_rms=rms,
        residual_noise=by_noise,
        pixels=int(state.edge.length.sum() / grid.pixel_size),
        outside=int((state.edge.length == 0.0).sum()),
        effective_unknowns=known,
        library="" if state._factor is None else state._factor.library,
        shown="contours",
        warnings=stepped if converged else (_ASTRAY, *stepped),
    )


def _deviations(
    state: _PenalisedBody, law_is_assumed: bool, may_slide: bool, is_stepped: bool, left: FloatArray
) -> tuple[Deviations, float]:
    """Standard deviations due to noise, law, plates and springs; effective number of unknowns."""
    mesh, edge, rng = state.mesh, state.edge, np.random.default_rng(0)
    A, springs, _ = state.linearised()
    _, normal = state.distances()
    pulls = edge.normal_shapes(normal).T @ diags_array(state.stiffness * edge.length)
    drawn = rng.standard_normal((len(normal), SAMPLES))
    off = np.sqrt(state.noise / np.maximum(edge.length, _TINY))[:, None] * drawn
    for side in straight_sides(mesh) if is_stepped else ():
        steps = _STEP_PX * state.px * rng.choice([-1.0, 1.0], SAMPLES)
        off[: len(edge.points)] += np.outer(edge.on(side), steps)
    z, factor = rng.choice([-1.0, 1.0], (state.u.size, _PROBES)), state.factor(A)
    known = float(np.sum(z * factor.solve(springs @ z))) / _PROBES
    found = state.with_tractions(factor.solve(pulls @ off), factor, off)
    samples = found.reshape(-1, 2, SAMPLES)
    error, none = interpolation_error(mesh, state.u.reshape(-1, 2)), samples[..., :0]
    sd = Deviations(samples, none, none, error, gradient_covariance(mesh, samples))
    sd = sd.with_bias(mesh, left)
    changes = []
    if state.tractions.size:
        others = state.by_other_tractions(factor, SOME)
        changes = list(np.moveaxis(others, 2, 0) / np.sqrt(SOME))
    if law_is_assumed:
        laws = (Ogden(ELASTOMER.moduli, ELASTOMER.exponents, k) for k in (_SOFTER, _STIFFER))
        changes += [state.change_by(other) / np.sqrt(2.0 * _TRIANGULAR) for other in laws]
    if may_slide:
        changes.append(state.change_by(slides=True) / np.sqrt(_RECTANGULAR))
    for change in changes:
        sd = sd.with_bias(mesh, change)
    return sd, known
