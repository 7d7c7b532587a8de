"""A homogenized body: finite elements of u and v_i, with RVEs at their quadrature points.

    div P̄ = 0,    div Lambda_i - Pi_i = 0,

in weak form, with the same interpolation of u and all v_i. Every quadrature point of the lattice
has one RVE, or several in different positions that are averaged; solid bulk has its material. Both
scales are linearised together: in each iteration one factorisation per RVE, then one of the body.
RVEs are distributed over the ranks of a communicator; all other data are on every rank.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.micromorphic.body import (
    EDGES,
    PlateLoading,
    Quadrature,
    quadrature,
    specimen_mesh,
)
from modeharvest.fem.lattice.micromorphic.rve import RVE
from modeharvest.fem.materials import JetMatrix, stress_and_tangent
from modeharvest.fem.sparse_factor import factorise
from modeharvest.fem.specimen import Specimen
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.errors import InputError
from modeharvest.util.machine import require_memory

_FIRST_ORDER = 4  # generalised strains without modes: F̄
_STATES = 4  # least number of states of all RVEs in memory at a time


class _Region(NamedTuple):
    """The elements of one kind, lattice or bulk."""

    at: Quadrature
    B: FloatArray
    """(c, p, s, d) generalised strains due to unit unknowns."""
    dofs: IntArray
    """(c, d) numbers of the elements' unknowns among all."""


class HomogenizedBody:
    """A body of a homogenized lattice, possibly with solid bulk, between two plates.

    The free unknowns are y (``free_count``,); all unknowns a follow from y and the load. Nodal
    values are ``fields(a)``. InputError for RVEs with different numbers of modes, supports that
    allow rigid motions, and more ranks than RVEs.

    mesh : T3, T6, Q4, Q8 or Q9 mesh [mm].
    rves : one RVE, or several that are averaged at every point.
    extent : length L and height to which the load refers [mm]; by default those of the mesh.
    is_lattice : (m,) True for lattice elements; the others are solid, of the RVEs' material.
    points : Gauss points per direction; by default 2, for Q9 3, as 2 would be rank-deficient.
    edges : nodes of plates and sides, by names among ``EDGES``; by default those of smallest and
        largest x and y.
    """

    def __init__(
        self, mesh: Mesh, rves: RVE | Sequence[RVE], loading: PlateLoading,
        extent: ArrayLike | None = None, is_lattice: BoolArray | None = None,
        points: int | None = None,
        comm: MPI.Comm = MPI.COMM_WORLD, edges: Mapping[str, IntArray] | None = None,
    ) -> None:  # fmt: skip
        self.mesh, self.loading, self.comm = mesh, loading, comm
        self.rves = (rves,) if isinstance(rves, RVE) else tuple(rves)
        lattice = np.ones(len(mesh.cells), bool) if is_lattice is None else np.asarray(is_lattice)
        counts = {rve.mode_count for rve in self.rves}
        if len(counts) != 1:
            raise InputError(f"RVEs: expected one or more with as many modes, got {counts}")
        if lattice.shape != (len(mesh.cells),) or not lattice.any():
            raise InputError("homogenized body: expected one element or more of lattice, got none")
        self.mode_count, self.is_lattice = counts.pop(), lattice
        low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
        self.copies = 4 if loading.quarter else 1
        """Number of such bodies in the whole body."""
        whole = (high - low) * math.sqrt(self.copies) if extent is None else np.asarray(extent)
        self.length = float(whole[0])
        self._lattice_nodes = np.unique(mesh.cells[lattice])
        points = points or (3 if mesh.element == "Q9" else 2)
        self._require_memory(points)
        self.regions = [self._region(lattice, points, self.mode_count)]
        if not lattice.all():
            self.regions.append(self._region(~lattice, points, 0))
        self._constrain(low, high, 0.5 * float(whole[1]), edges or {})
        self.point_count = self.regions[0].at.weights.size
        count = self.point_count * len(self.rves)
        if comm.size > count:
            raise InputError(f"MPI: expected at most {count} ranks, one an RVE, got {comm.size}")
        self.own = np.arange(comm.rank, count, comm.size)
        """Numbers of this rank's RVEs: point times RVEs per point, plus index at the point."""
        sizes = [self.rve(k).cell.reduction.size for k in self.own]
        self.offsets = self.free_count + np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)

    @classmethod
    def of_specimen(
        cls, specimen: Specimen, rves: RVE | Sequence[RVE], loading: PlateLoading,
        divisions: tuple[int, int] | None = None, edge_shifts: ArrayLike = (0.0, 0.0),
        points: int | None = None,
    ) -> HomogenizedBody:  # fmt: skip
        """The body of a specimen with its bulk edges; arguments as in ``specimen_mesh``."""
        mesh, lattice = specimen_mesh(specimen, divisions, loading.quarter, edge_shifts)
        extent = specimen.length, 2.0 * specimen.half_size[1]
        return cls(mesh, rves, loading, extent, lattice, points)

    def rve(self, number: int | np.int64) -> RVE:
        """The RVE with a given number among those of all points."""
        return self.rves[number % len(self.rves)]

    @property
    def start(self) -> FloatArray:
        """The undeformed state: y, followed by w of each of this rank's RVEs."""
        return np.zeros(self.offsets[-1])

    @property
    def places(self) -> FloatArray:
        """(points, 2) positions of the lattice's quadrature points [mm]."""
        return self.regions[0].at.places.reshape(-1, 2)

    def microstructure(self, value: FloatArray, strains: FloatArray, number: int) -> FloatArray:
        """(n, 2) displacement of the nodes of an RVE's cell in a state [mm]; on every rank.

        ``value`` and ``strains`` are those of the state; ``number``: see ``own``.
        """
        owner, at = number % self.comm.size, number // self.comm.size
        own = self.fluctuations(value)[at] if owner == self.comm.rank else None
        w = self.comm.bcast(own, owner)
        return self.rve(number).displacement(strains[number // len(self.rves)], w)

    def fluctuations(self, value: FloatArray) -> list[FloatArray]:
        """w of this rank's RVEs in a state."""
        return np.split(value, self.offsets[:-1])[1:]

    def unknowns(self, value: FloatArray, load: float) -> FloatArray:
        """All unknowns a of a state at a load."""
        return np.asarray(self.T @ value[: self.free_count] + load * self.direction)

    def fields(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 2) u [mm] and (n, m) v_i of the nodes; v_i is NaN outside the lattice."""
        nodal = unknowns.reshape(-1, 2 + self.mode_count)
        v = np.full((len(nodal), self.mode_count), np.nan)
        v[self._lattice_nodes] = nodal[self._lattice_nodes, 2:]
        return nodal[:, :2], v

    def strains(self, unknowns: FloatArray) -> list[FloatArray]:
        """(points, s) generalised strains of the lattice and, if any, of the bulk."""
        found = [np.einsum("cpsd,cd->cps", r.B, unknowns[r.dofs]) for r in self.regions]
        for q in found:
            q[..., :_FIRST_ORDER] += np.eye(2).ravel()
        return [q.reshape(-1, q.shape[-1]) for q in found]

    def _require_memory(self, points: int) -> None:
        """Raise InputError if the RVEs would need more memory than there is, by an estimate."""
        (elements, nodes), m = self.mesh.cells.shape, self.mode_count
        count, strains = points**2 * elements, (_FIRST_ORDER + 3 * m) * (2 + m) * nodes
        own = sum(rve.cell.reduction.size for rve in self.rves) / self.comm.size
        what = f"a homogenized body of {count:.3g} points"
        require_memory(8.0 * count * (_STATES * own + 2 * strains), what, "take fewer elements")

    def _region(self, chosen: BoolArray, points: int, m: int) -> _Region:
        cells = self.mesh.cells[chosen]
        at = quadrature(Mesh(self.mesh.nodes, cells, self.mesh.element), points)
        c, p, k, _ = at.gradients.shape
        B = np.zeros((c, p, _FIRST_ORDER + 3 * m, k, 2 + m))
        for axis in (0, 1):
            B[:, :, 2 * axis : 2 * axis + 2, :, axis] = at.gradients.swapaxes(2, 3)
        for i in range(m):
            g = _FIRST_ORDER + m + 2 * i
            B[:, :, _FIRST_ORDER + i, :, 2 + i] = at.shapes
            B[:, :, g : g + 2, :, 2 + i] = at.gradients.swapaxes(2, 3)
        dofs = cells[..., None] * (2 + self.mode_count) + np.arange(2 + m)
        return _Region(at, B.reshape(c, p, -1, k * (2 + m)), dofs.reshape(c, -1))

    def _constrain(
        self, low: FloatArray, high: FloatArray, b: float, edges: Mapping[str, IntArray]
    ) -> None:
        """Find the free unknowns, those that follow others, and the motion by the load."""
        nodes, loading, n = self.mesh.nodes, self.loading, len(self.mesh.nodes)
        near, half = 1e-6 * float((high - low).max()), np.array([0.5 * (high - low)[0], b])
        is_at = [near > np.abs(nodes - end)[:, axis] for end in (low, high) for axis in (0, 1)]
        for k, name in enumerate(EDGES):
            is_at[k] = np.isin(np.arange(n), edges[name]) if name in edges else is_at[k]
        left, bottom, right, top = is_at
        plates, sides = left | right, bottom | top
        x, y = ((nodes - 0.5 * (low + high)) / half).T
        x = np.where(plates, 1.0 * right - left, x)
        fixed, direction = np.zeros((2, n, 2 + self.mode_count))
        if loading.quarter:
            fixed[left, 0] = fixed[bottom, 1] = True
            plates, x = right, 0.5 * (x + 1.0)
        elif loading.plates == "sliding" and loading.sides in ("free", "periodic"):
            edge = np.flatnonzero(left)
            fixed[edge[np.argmin(np.abs(y[edge]))], 1] = True
        push = 0.5 * self.length * x
        direction[:, 0] = -push * (loading.compression + loading.bending * y)
        direction[:, 1] = push * loading.shear - loading.lateral * b * y
        fixed[plates, 0] = True
        fixed[plates & (loading.plates == "clamped"), 1] = True
        fixed[sides & (loading.sides in ("guided", "clamped")), 1] = True
        if loading.sides == "clamped":
            fixed[sides, 0], plates = True, plates | sides
        fixed[np.setdiff1d(np.arange(n), self._lattice_nodes), 2:] = True
        # Solid strips beyond the lattice's ends belong to the plates, others are bulk.
        solid, ends = self.mesh.cells[~self.is_lattice], nodes[self._lattice_nodes, 0]
        middle = nodes[solid, 0].mean(axis=1)
        is_strip = (middle < ends.min()) | (middle > ends.max())
        if loading.pattern_at_plates == "zero":
            fixed[plates, 2:] = fixed[solid[is_strip], 2:] = True
        if loading.pattern_at_bulk == "zero":
            fixed[solid[~is_strip], 2:] = True
        self._eliminate(fixed != 0.0, direction, self._followed(bottom, top, near))

    def _followed(self, bottom: BoolArray, top: BoolArray, near: float) -> IntArray:
        """(n,) the node whose fields each node follows: itself, or its periodic partner."""
        followed, x = np.arange(len(self.mesh.nodes)), self.mesh.nodes[:, 0]
        if self.loading.sides == "periodic":
            lower, upper = (np.flatnonzero(s)[np.argsort(x[s])] for s in (bottom, top))
            if len(lower) != len(upper) or not np.allclose(x[lower], x[upper], rtol=0, atol=near):
                raise InputError(
                    "macroscopic mesh: expected nodes alike on both periodic sides, got others"
                )
            followed[upper] = lower
        return followed

    def _eliminate(self, fixed: BoolArray, direction: FloatArray, followed: IntArray) -> None:
        """Number the free unknowns; InputError if they allow a rigid motion."""
        is_free = ~fixed & (followed == np.arange(len(fixed)))[:, None]
        numbers = np.where(is_free, np.cumsum(is_free).reshape(fixed.shape) - 1, -1)
        place = np.where(fixed, -1, numbers[followed]).ravel()
        offset = direction - direction[followed]
        self.direction: FloatArray = np.where(place < 0, direction.ravel(), offset.ravel())
        """(size,) derivatives of all unknowns by the load at fixed y."""
        self.free_count, rows = int(is_free.sum()), np.flatnonzero(place >= 0)
        if not self.free_count:
            raise InputError("homogenized body: expected nodes between the supports, got none")
        shape = fixed.size, self.free_count
        self.T = csr_array((np.ones(len(rows)), (rows, place[rows])), shape)
        """(size, free_count) matrix: all unknowns are T y + load * direction."""
        self.is_pattern: BoolArray = np.broadcast_to(np.arange(fixed.shape[1]) > 1, fixed.shape)[
            is_free
        ]
        """(free_count,) True for entries of y that are amplitudes v."""
        X = self.mesh.nodes - self.mesh.nodes.mean(axis=0)
        rigid = np.zeros((*fixed.shape, 3))
        rigid[:, 0, 0] = rigid[:, 1, 1] = np.ptp(X)
        rigid[:, :2, 2] = np.stack([-X[:, 1], X[:, 0]], axis=1)
        flat = rigid.reshape(-1, 3)
        if np.linalg.matrix_rank(flat - self.T @ self.picked(flat), 1e-6) < 3:
            what = (
                "homogenized body: expected supports that leave no rigid motion, got too few; give"
            )
            raise InputError(f"{what} plates more than one node, clamp them or guide the sides")

    def picked(self, values: FloatArray) -> FloatArray:
        """(free_count, ...) least-squares y for values of all unknowns (size, ...)."""
        return np.asarray(((self.T.T @ values).T / self.T.sum(axis=0)).T)

    def assembled(self, parts: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, Any]:
        """(size,) forces and (size, size) matrix assembled from those of the regions' elements."""
        forces, whole = np.zeros(len(self.direction)), csr_array((len(self.direction),) * 2)
        for region, (f, K) in zip(self.regions, parts, strict=True):
            rows, columns = np.broadcast_arrays(region.dofs[:, :, None], region.dofs[:, None, :])
            whole = whole + csr_array((K.ravel(), (rows.ravel(), columns.ravel())), whole.shape)
            forces += np.bincount(region.dofs.ravel(), f.ravel(), len(forces))
        return forces, whole

    def bulk_response(self, strains: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Energy density (p,), P (p, 4) and moduli (p, 4, 4) [MPa] of the bulk at F̄ (p, 4)."""
        F = strains.reshape(-1, 2, 2)
        P, A = stress_and_tangent(material := self.rves[0].material, F)
        return material.energy(JetMatrix(F)).value, P.reshape(-1, 4), A.reshape(-1, 4, 4)

    def gathered(self, own: FloatArray) -> FloatArray:
        """(points, RVEs a point, ...) on all ranks, from this rank's RVEs (l, ...)."""
        parts = self.comm.allgather(own)
        every = np.empty((sum(len(p) for p in parts), *own.shape[1:]))
        for rank, part in enumerate(parts):
            every[rank :: self.comm.size] = part
        return every.reshape(self.point_count, len(self.rves), *own.shape[1:])


class LinearisedBody:
    """The equations of both scales at a trial state, with the RVEs condensed.

    ``residual`` and ``load_force`` (free_count,): forces on y with relaxed RVEs [N/mm], and their
    derivative by the load; ``relaxed`` and ``along``: the changes of y that balance them.
    ``forces`` and ``along_load`` (size,): the same on all unknowns; ``load_size``: norm of the
    latter. ``stiffness``: derivative by y. ``excess``: largest imbalance of an RVE, relative to
    the forces of a unit of F̄. ``negative``: number of negative eigenvalues; ``rve_negative``:
    those of the RVEs at fixed strains.
    """

    stresses: FloatArray
    moduli: FloatArray
    rve_negative: int
    is_regular: bool

    def __init__(self, body: HomogenizedBody, load: float, value: FloatArray) -> None:
        self.body, self.load, self.value = body, load, value
        self.unknowns = body.unknowns(value, load)
        strains = body.strains(self.unknowns)
        self.strains = strains[0]
        self._condense()
        if not self.is_regular:
            return
        stresses, moduli = [self.stresses], [self.moduli]
        if len(strains) > 1:
            _, P, A = body.bulk_response(strains[1])
            stresses, moduli = [*stresses, P], [*moduli, A]
        parts = []
        for region, s, D in zip(body.regions, stresses, moduli, strict=True):
            c, p, size, _ = region.B.shape
            weights = region.at.weights[..., None]
            f = np.einsum("cpsd,cps->cd", region.B, weights * s.reshape(c, p, size))
            DB = weights[..., None] * (D.reshape(c, p, size, size) @ region.B)
            parts.append((f, (region.B.swapaxes(2, 3) @ DB).sum(axis=1)))
        self.forces, whole = body.assembled(parts)
        self.along_load = whole @ body.direction
        self.residual, self.load_force = body.T.T @ self.forces, body.T.T @ self.along_load
        self.load_size = float(np.linalg.norm(self.along_load))
        self.stiffness = csr_array(body.T.T @ whole @ body.T).sorted_indices()
        try:
            factor = factorise(self.stiffness, definite=False)
        except ArithmeticError:
            self.is_regular = False
            return
        self.relaxed, self.along = -factor.solve(
            np.column_stack([self.residual, self.load_force])
        ).T
        self.negative = factor.negative_pivots + self.rve_negative

    def _condense(self) -> None:
        """Condense this rank's RVEs, and distribute the results to all ranks."""
        body, count = self.body, 4 + 3 * self.body.mode_count
        rows = np.full((len(body.own), count * (count + 1) + 2), np.nan)
        self._rves: list[tuple[FloatArray, FloatArray]] = []
        for row, number, w in zip(rows, body.own, body.fluctuations(self.value), strict=True):
            rve = body.rve(number)
            at = rve.condensed(self.strains[number // len(body.rves)], w)
            if not at.is_regular:
                break
            excess = np.linalg.norm(at.forces) / np.linalg.norm(at.on_carriers[:, :_FIRST_ORDER])
            known = at.relaxed_forces / rve.area, at.condensed.ravel() / rve.area
            row[:] = np.concatenate([*known, [excess, at.negative]])
            self._rves.append((at.relaxed, at.response))
        every = body.gathered(rows)
        self.is_regular = bool(np.isfinite(every).all())
        if not self.is_regular:
            return
        self.excess, self.rve_negative = float(every[..., -2].max()), int(every[..., -1].sum())
        means = every.mean(axis=1)
        self.stresses, moduli = means[:, :count], means[:, count:-2]
        self.moduli = moduli.reshape(-1, count, count)

    def moved(self, dy: FloatArray, change: float, relax: bool = True) -> FloatArray:
        """Change of y and of RVEs' states for one of y and load [-]; ``relax``: to equilibrium."""
        body = self.body
        da = body.T @ dy + change * body.direction
        dq = np.einsum("cpsd,cd->cps", body.regions[0].B, da[body.regions[0].dofs])
        dq = dq.reshape(body.point_count, -1)
        parts = [dy]
        for number, (relaxed, response) in zip(body.own, self._rves, strict=True):
            follows = response @ dq[number // len(body.rves)]
            parts.append(relaxed + follows if relax else follows)
        return np.concatenate(parts)
