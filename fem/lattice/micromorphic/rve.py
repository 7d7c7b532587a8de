"""A representative volume element (RVE) with given modes: generalised stresses and moduli.

    u(X) = (F̄ - I) X + sum_i (v_i + g_i . X) phi_i(X) + w(X),    X from the RVE's centre,

with w periodic, <w> = 0, <w . phi_i> = 0, <(w . phi_i) X> = 0 over the material, so that w is
independent of F̄, v and g. With the energy W(F̄, v, g) per area |Q|, including holes,

    P̄ = dW/dF̄ = <P>,   Pi_i = dW/dv_i = <P : grad phi_i>,
    Lambda_i = dW/dg_i = <P^T phi_i + X (P : grad phi_i)>   (<.> times the material over |Q|).

Rokos, Ameen, Peerlings & Geers, J. Mech. Phys. Solids 123 (2019) 119-137, doi
10.1016/j.jmps.2018.08.019. Without modes this is first-order homogenization. Generalised strains
are q = (F̄_11, F̄_12, F̄_21, F̄_22, v_1 ..., g_1x, g_1y, ...), stresses in the same order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.cell import CondensedCell, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell
from modeharvest.fem.lattice.micromorphic.patterns import ModeField
from modeharvest.fem.materials import Material
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.errors import InputError

NORMALISATIONS = ("rms", "largest", "given")
"""The mean of phi . phi over the material is 1; max |phi| at nodes is 1; phi unchanged."""
_PERIODIC = 1e-6  # largest difference between partner nodes, over max |phi|
_DEPENDENT = 1e-6  # least singular value of normalised modes
_GOLDEN = 0.5 * (3.0 - math.sqrt(5.0))
_ITERATIONS = 12
_SMALL = 1e-10  # tolerance, over the forces of a unit of F̄, before one more step
_SHORTEST = 1e-4  # smallest step, as a fraction of the way to given strains


@dataclass(frozen=True, eq=False)
class RVEState:
    """An RVE in equilibrium at given generalised strains."""

    strains: FloatArray
    stresses: FloatArray
    """(4 + 3 m,) strains F̄, v, g and stresses P̄, Pi, Lambda."""
    moduli: FloatArray
    """(4 + 3 m, 4 + 3 m) derivatives of the stresses by the strains, w in equilibrium."""
    energy: float
    """Stored energy per area of the cell, including holes [MPa]."""
    fluctuation: FloatArray
    """(n, 2) w at the nodes of the cell [mm], <w> = 0."""
    negative_eigenvalues: int
    """Number of negative eigenvalues of the tangent in w at fixed strains; 0: stable."""


class RVE:
    """An RVE, used at all points of a continuum: kinematics, stresses, moduli.

    InputError for modes without the cell's period, linearly dependent or zero modes, and cells
    that don't tile the lattice.

    cell : unit cell with the period of the modes, such as ``square(...).enlarged(2, 2)``.
    modes : fields in the cell's coordinates, or values at its nodes (n, 2). Their means over the
        material, which are translations, are subtracted.
    centre : point of the lattice from which X is measured [mm]. The cell is recut about it (the
        region nearer to it than to its copies); results depend on it: a junction or a hole.
    normalisation : of the modes, among ``NORMALISATIONS``, which sets the unit of v_i [mm].
        ``scales`` (m,): the factors by which the given ``modes`` were multiplied.
    """

    def __init__(
        self, cell: UnitCell, material: Material, modes: Sequence[ModeField] = (),
        centre: ArrayLike = (0.0, 0.0), normalisation: str = "rms",
    ) -> None:  # fmt: skip
        if normalisation not in NORMALISATIONS:
            known = ", ".join(NORMALISATIONS)
            raise InputError(f"RVE: expected a normalisation among {known}, got {normalisation!r}")
        self.centre = np.asarray(centre, dtype=np.float64)
        about, masters = centred_cell(cell, self.centre)
        self.cell, self.material = PeriodicCell(about, material), material
        self.area, self.mode_count, self.modes = about.area, len(modes), tuple(modes)
        self._mass = self.cell.nodal_mass
        given = [_at_nodes(mode, k, cell)[masters] for k, mode in enumerate(modes, start=1)]
        fields = np.array(given, dtype=np.float64).reshape(len(modes), len(masters), 2)
        self.normalisation = normalisation
        self.shapes, self.scales = shapes, _ = self._normalised(fields, normalisation)
        """(m, n, 2) the modes at the nodes of ``cell``."""
        X = about.mesh.nodes
        along = (shapes[:, None] * X.T[None, :, :, None]).reshape(-1, len(X), 2)
        patterns = np.concatenate([shapes, along]).reshape(3 * len(modes), X.size)
        self.carriers = np.column_stack([self.cell.affine, patterns.T])
        """(2 n, 4 + 3 m) nodal displacements due to unit generalised strains [mm]."""
        self._constraints = self._independent()

    @property
    def at_rest(self) -> FloatArray:
        """(4 + 3 m,) generalised strains of the undeformed state."""
        return np.concatenate([np.eye(2).ravel(), np.zeros(3 * self.mode_count)])

    def displacement(self, strains: FloatArray, fluctuation: FloatArray) -> FloatArray:
        """(n, 2) displacement of the nodes of ``cell`` [mm], with <w> = 0."""
        w = self.cell.reduction.displacement(fluctuation)
        return np.asarray(self._carried(strains) + w - self._mean(w))

    def condensed(self, strains: FloatArray, fluctuation: FloatArray) -> CondensedCell:
        """The equations at strains q (4 + 3 m,) and masters' w (2 count,), with w condensed."""
        violation = self._constraints @ fluctuation[self.cell.free_dofs]
        u = self._carried(strains) + self.cell.reduction.displacement(fluctuation)
        return CondensedCell(self.cell, self.carriers, u, self._constraints, violation)

    def equilibrium(self, strains: ArrayLike, fluctuation: FloatArray | None = None) -> RVEState:
        """The state at strains q (4 + 3 m,), from a guess of w (n, 2) at the nodes, or in steps.

        Steps go straight from the undeformed state; if one fails, InputError tells how far it got.
        """
        q, rest = np.asarray(strains, np.float64), self.at_rest
        if q.shape != rest.shape or not np.isfinite(q).all():
            raise InputError(f"RVE: expected {len(rest)} finite strains, got {q.tolist()}")
        none: FloatArray = np.zeros_like(self.cell.cell.mesh.nodes)
        done, step, w = 0.0, 1.0, none if fluctuation is None else fluctuation
        while done < 1.0:
            found = self._near(rest + (done + step) * (q - rest), w)
            if found is not None:
                done, w = done + step, found.fluctuation
                step = min(2.0 * step, 1.0 - done)
                continue
            step, w = 0.5 * step, w if done else none
            if step < _SHORTEST:
                raise InputError(f"RVE: expected strains with an equilibrium, found none farther "
                                 f"than {done:.3g} of the way to {q.tolist()}")  # fmt: skip
        assert found is not None
        return found

    def _near(self, q: FloatArray, guess: FloatArray) -> RVEState | None:
        """The equilibrium that Newton's method finds from a guess of w at the nodes."""
        w: FloatArray = np.zeros(self.cell.reduction.size)
        w[self.cell.reduction.bloch_map.places] = (guess - guess[0]).ravel()  # node 0 is fixed
        for _ in range(_ITERATIONS):
            at = self.condensed(q, w)
            if not at.is_regular:
                return None
            w = w + at.relaxed
            if np.linalg.norm(at.forces) <= _SMALL * np.linalg.norm(at.on_carriers[:, :4]):
                if not self.cell.body.smallest_jacobian(self.displacement(q, w)) > 0:
                    return None
                nodal = self.displacement(q, w) - self._carried(q)
                stresses, moduli = at.relaxed_forces / self.area, at.condensed / self.area
                return RVEState(q, stresses, moduli, self.energy(q, w), nodal, at.negative)
        return None

    @property
    def averages(self) -> FloatArray:
        """(2 + 3 m, n, 2) weights of nodal w whose weighted sums are averages over |Q|.

        <w>, <w . phi_i> and <(w . phi_i) X>; the last two of w - <w>, independent of translations.
        """
        along = np.tile(np.eye(2), len(self.cell.cell.mesh.nodes))
        weights = np.concatenate([(self._mass @ along.T).T, self._weights().T])
        return np.asarray(weights.reshape(len(weights), -1, 2) / self.area)

    def energy(self, strains: FloatArray, fluctuation: FloatArray) -> float:
        """Stored energy per area of the cell, including holes [MPa]."""
        return self.cell.body.energy(self.displacement(strains, fluctuation)) / self.area

    def _carried(self, strains: FloatArray) -> FloatArray:
        return np.asarray((self.carriers @ (strains - self.at_rest)).reshape(-1, 2))

    def _mean(self, fields: FloatArray) -> FloatArray:
        """(..., 1, 2) means over the material of nodal vectors (..., n, 2)."""
        weights = np.asarray(self._mass.sum(axis=0)).reshape(-1, 2)
        return np.asarray((weights * fields).sum(axis=-2, keepdims=True) / weights.sum(axis=0))

    def _normalised(self, fields: FloatArray, how: str) -> tuple[FloatArray, FloatArray]:
        """Normalised modes of mean 0, and their scales (m,)."""
        largest = np.linalg.norm(fields, axis=2).max(axis=1, initial=0.0)
        fields = fields - self._mean(fields)
        flat = fields.reshape(len(fields), self._mass.shape[0])
        gram = flat @ (self._mass @ flat.T) / (0.5 * float(self._mass.sum()))
        rms = np.sqrt(np.diag(gram))
        if not (rms > _DEPENDENT * largest).all():
            where = int(np.argmin(rms > _DEPENDENT * largest)) + 1
            raise InputError(f"mode {where}: expected a field that varies, got a constant one")
        if len(fields) and np.linalg.eigvalsh(gram / np.outer(rms, rms))[0] < _DEPENDENT**2:
            got = f"{len(fields)} of which one is a sum of the others; leave it out"
            raise InputError(f"modes: expected linearly independent ones, got {got}")
        peak = np.linalg.norm(fields, axis=2).max(axis=1, initial=0.0)
        scales = {"rms": 1.0 / rms, "largest": 1.0 / peak, "given": np.ones(len(rms))}[how]
        return scales[:, None, None] * fields, scales

    def _weights(self) -> FloatArray:
        """(2 n, 3 m) weights of nodal w in <w . phi_i> and <(w . phi_i) X>.

        They have mean 0, so that the results don't change with a translation of w.
        """
        fields = self.carriers[:, 4:].T.reshape(-1, *self.cell.cell.mesh.nodes.shape)
        free = (fields - self._mean(fields)).reshape(-1, len(self.carriers))
        return np.asarray(self._mass @ free.T)

    def _independent(self) -> FloatArray:
        """(3 m, free) orthonormal rows C of the constraints C w = 0; <w> = 0 isn't required."""
        reduced = self.cell.reduction.restricted(self._weights())
        rows, size = np.linalg.qr(reduced[self.cell.free_dofs])
        diagonal = np.abs(np.diag(size))
        if not (diagonal > _DEPENDENT * diagonal.max(initial=0.0)).all():
            what = "modes: expected phi_i and phi_i X to be linearly independent on the cell"
            raise InputError(f"{what}, got others; leave modes out or take a larger cell")
        return np.ascontiguousarray(rows.T)


def spread_positions(count: int) -> FloatArray:
    """(count, 2) positions in a cell, relative to its centre, in fractions of its vectors.

    A lattice rule (Sloan & Joe, 1994): positions are evenly spaced along both vectors and symmetric
    about the centre (mean 0), so that the positions don't favour a growth of v.
    """
    turn = min((n for n in range(1, count + 1) if math.gcd(n, count) == 1),
               key=lambda n: abs(n - _GOLDEN * count))  # fmt: skip
    along = (np.arange(count) - 0.5 * (count - 1)) / count
    return np.stack([along, turn * along - np.rint(turn * along)], axis=1)


def centred_cell(cell: UnitCell, centre: FloatArray) -> tuple[UnitCell, IntArray]:
    """The cell of the same lattice around a point, the new origin; and each node's original number.

    Each element belongs to the copy of ``centre`` that is nearest to the element's centre.
    """
    mesh, vectors, old = cell.mesh, cell.lattice, cell.periodicity
    steps = np.array(list(product(range(-3, 4), repeat=2)))
    middles = mesh.nodes[mesh.cells[:, :3]].mean(axis=1) - centre
    copies = middles[:, None] + steps @ vectors
    # Ties are resolved consistently: elements on a side belong to the right and the upper cell.
    tilt = 1e-7 * np.linalg.norm(vectors, axis=1).max() * np.array([1.0, 0.7])
    shift = steps[np.argmin(np.linalg.norm(copies + tilt, axis=2), axis=1)]
    keys = np.dstack([old.master[mesh.cells], old.shift[mesh.cells] + shift[:, None]])
    unique, cells = np.unique(keys.reshape(-1, 3), axis=0, return_inverse=True)
    first = np.full(old.count, -1)
    first[old.master[::-1]] = np.arange(len(mesh.nodes))[::-1]
    originals = first[unique[:, 0]]
    offset = unique[:, 1:] - old.shift[originals]
    nodes = mesh.nodes[originals] + offset @ vectors - centre
    return UnitCell(Mesh(nodes, cells.reshape(mesh.cells.shape), mesh.element), vectors), originals


def _at_nodes(mode: ModeField, number: int, cell: UnitCell) -> FloatArray:
    """(n, 2) values of a mode at the cell's nodes, equal at partners."""
    nodes = cell.mesh.nodes
    values = np.asarray(mode(nodes) if callable(mode) else mode, dtype=np.float64)
    if values.shape != nodes.shape or not np.isfinite(values).all():
        what = f"expected finite values {nodes.shape} at the cell's nodes"
        got = f"{values.shape}, {np.isfinite(values).mean():.0%} of them finite"
        raise InputError(f"mode {number}: {what}, got {got}")
    at_masters = np.zeros((cell.periodicity.count, 2))
    at_masters[cell.periodicity.master] = values
    off = np.abs(at_masters[cell.periodicity.master] - values).max()
    largest = float(np.linalg.norm(values, axis=1).max())
    if not largest > 0:
        raise InputError(f"mode {number}: expected a field other than 0")
    if off > _PERIODIC * largest:
        got = f"one that differs by {off / largest:.2g} of its maximum at partner nodes"
        remedy = (
            "snap its wave vectors to the cell (patterns.snapped) or take a larger cell (enlarged)"
        )
        what = f"mode {number}: expected a field with the cell's period"
        raise InputError(f"{what}, got {got}; {remedy}")
    return values
