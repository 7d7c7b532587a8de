"""A periodic cell under macroscopic loading: equilibrium, effective stiffness, path.

The displacement is u = (F̄ - I) X + w with a periodic fluctuation w. Unknowns are the masters'
fluctuations and the components of F̄ whose mean stress is prescribed; one master is fixed to
exclude translations. The fluctuation is condensed with one factor of its stiffness. This leaves the
free components of F̄ and, if an amplitude is prescribed, the load: a small dense system, which also
gives the lattice's effective tangent moduli. With a prescribed amplitude it is regular on a branch
even close to the point where the branch leaves the primary path.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csr_array

from modeharvest.fem.hyperelastic import FreeBody
from modeharvest.fem.lattice.bloch_map import Reduction
from modeharvest.fem.lattice.cells import UnitCell
from modeharvest.fem.lattice.options import CENTRE, MacroLoading
from modeharvest.fem.materials import Material
from modeharvest.fem.sparse_factor import Factor, factorise
from modeharvest.util.arrays import FloatArray

# Unbalanced forces must be smaller than those of a change of the load by this.
_LOAD_TOLERANCE = 1e-11
_AMPLITUDE_TOLERANCE = 1e-11  # relative
_ITERATIONS = 12
_SMALLEST_STEP = 1e-6  # of the load
_BACK = 1e-4  # of the load: backward step for the rate of an eigenvalue
_NOT_CONVERGED = "Newton's method did not converge"
_REVERSED = "an element would be turned inside out (det F <= 0)"


@dataclass(frozen=True, eq=False)
class CellState:
    """An equilibrium of a cell."""

    load: float
    """Load e; for compressions the nominal strain [-]."""
    gradient: FloatArray
    """(2, 2) F̄ [-]."""
    fluctuation: FloatArray
    """(2 count,) w of the masters, in the order of ``Reduction`` [mm]."""
    rate: FloatArray
    """(4 + 2 count,) derivatives of F̄ and w by the load."""
    stress: FloatArray
    """(2, 2) P̄, mean first Piola-Kirchhoff stress over the cell including holes [MPa]."""
    stiffness: csr_array
    """(2 n, 2 n) tangent stiffness of the mesh's nodes without constraints [N/mm^2]."""
    moduli: FloatArray
    """(2, 2, 2, 2) effective tangent dP̄_ij/dF̄_kl with w at equilibrium [MPa]."""

    @property
    def value(self) -> FloatArray:
        """(4 + 2 count,) F̄, then w."""
        return np.concatenate([self.gradient.ravel(), self.fluctuation])


@dataclass(frozen=True, eq=False)
class Amplitude:
    """A prescribed amplitude, ``weights . w = value``, instead of a prescribed load."""

    weights: FloatArray
    """(2 count,) in the order of ``Reduction``; not sensitive to translations."""
    value: float
    """The amplitude [mm]."""


class CondensedCell:
    """The equations of a cell at a trial state, its fluctuation condensed by one factorisation.

    The displacement u is ``carriers`` (2 n, s) times the generalised strains, F̄ first, plus a
    periodic w with ``constraints`` . w = 0. Forces and moduli are those of the whole cell.

    forces, macro_forces : (free,) forces on w, without those of the constraints [N/mm], and (s,)
        forces on the generalised strains.
    relaxed, response : (2 count,) change of w to balance it, (2 count, s) dw/d(strains).
    condensed : (s, s) moduli with w in equilibrium; ``is_regular``: whether they exist.
    negative : number of negative eigenvalues of the tangent in w at fixed strains.
    """

    def __init__(
        self, cell: PeriodicCell, carriers: FloatArray, u: FloatArray, constraints: FloatArray,
        violation: FloatArray | float = 0.0,
    ) -> None:  # fmt: skip
        self._cell, self._carriers, self._u = cell, carriers, u
        self._constraints, self._violation = constraints, violation
        forces = cell.body.forces(u)
        self.macro_forces = carriers.T @ forces
        self._all_forces = cell.reduction.restricted(forces)[cell.free_dofs]
        self.forces = self._all_forces - constraints.T @ (constraints @ self._all_forces)
        self.is_regular = bool(np.isfinite(forces).all())
        if self.is_regular:
            self._condense()

    def _condense(self) -> None:
        cell, carriers, C = self._cell, self._carriers, self._constraints
        self.stiffness = cell.body.stiffness(self._u)
        self.on_carriers = self.stiffness @ carriers
        coupling = cell.reduction.restricted(self.on_carriers)[cell.free_dofs]
        try:
            factor = cell.factor(self.stiffness)
        except ArithmeticError:  # exactly singular
            self.is_regular = False
            return
        known = np.column_stack([self._all_forces, coupling, C.T])
        solved, by_constraints = np.hsplit(-factor.solve(known), [1 + coupling.shape[1]])
        size = C @ by_constraints  # negative definite if the constrained tangent has K's inertia
        missing = C @ solved
        missing[:, 0] += self._violation
        solved = solved - by_constraints @ np.linalg.solve(size, missing)
        turned = int(np.sum(np.linalg.eigvalsh(0.5 * (size + size.T)) > 0))
        self.negative = factor.negative_pivots - turned
        self.relaxed, self.response = cell.every(solved[:, 0]), cell.every(solved[:, 1:])
        self.condensed = carriers.T @ self.on_carriers + coupling.T @ solved[:, 1:]
        self.relaxed_forces = self.macro_forces + coupling.T @ solved[:, 0]


class LinearisedCell(CondensedCell):
    """The equations at a trial state: load [-], F̄ (4,) along its axes, w (2 count,) [mm]."""

    def __init__(
        self, cell: PeriodicCell, loading: MacroLoading, load: float, gradient: FloatArray,
        fluctuation: FloatArray, amplitude: Amplitude | None = None,
    ) -> None:  # fmt: skip
        self.loading, self.load, self.amplitude = loading, load, amplitude
        self.gradient, self.fluctuation, self.area = gradient, fluctuation, cell.cell.area
        Q = loading.axes  # axes of the components, also of F̄
        none = np.zeros((0, int(cell.free_dofs.sum())))
        super().__init__(cell, cell.affine @ Q, cell.displaced(Q @ gradient, fluctuation), none)
        if self.is_regular:
            free, self.rate = loading.free, loading.rate
            self.rate[free] = np.linalg.solve(
                self.condensed[np.ix_(free, free)],
                (self.area * loading.dead - self.condensed @ self.rate)[free],
            )

    @property
    def _unbalanced(self) -> FloatArray:
        """(4,) (mean stress - prescribed stress) times area [N]; 0 where F̄ is prescribed."""
        excess = self.macro_forces - self.area * self.load * self.loading.dead
        return np.where(self.loading.free, excess, 0.0)

    @property
    def is_solved(self) -> bool:
        """Whether internal and macroscopic forces balance, and the amplitude is met."""
        size, amplitude = np.linalg.norm, self.amplitude
        inner = _LOAD_TOLERANCE * size(self.on_carriers @ self.rate)
        outer = _LOAD_TOLERANCE * size(self.condensed) * size(self.rate)
        is_met = True
        if amplitude is not None:
            is_met = abs(self._excess(amplitude)) <= _AMPLITUDE_TOLERANCE * abs(amplitude.value)
        return bool(size(self.forces) <= inner and size(self._unbalanced) <= outer and is_met)

    def _excess(self, prescribed: Amplitude) -> float:
        """The amplitude minus its prescribed value [mm]."""
        return float(prescribed.weights @ self.fluctuation) - prescribed.value

    def step(self) -> tuple[float, FloatArray, FloatArray]:
        """Newton step: changes of the load, of F̄ (4,) and of the fluctuation."""
        free = np.flatnonzero(self.loading.free)
        # Unknowns: the free components of F̄ and, if an amplitude is prescribed, the load.
        along: FloatArray = np.zeros((4, len(free) + 1))
        along[free, np.arange(len(free))] = 1.0
        along[:, -1] = self.loading.rate
        stiffness: FloatArray = self.condensed[free] @ along
        stiffness[:, -1] -= self.area * self.loading.dead[free]
        rest = (self._unbalanced + self.relaxed_forces - self.macro_forces)[free]
        if self.amplitude is None:
            along, stiffness = along[:, :-1], stiffness[:, :-1]
        else:
            weights = self.amplitude.weights
            stiffness = np.vstack([stiffness, weights @ self.response @ along])
            rest = np.append(rest, self._excess(self.amplitude) + weights @ self.relaxed)
        unknown = np.linalg.solve(stiffness, -rest)
        dF = along @ unknown
        change = 0.0 if self.amplitude is None else float(unknown[-1])
        return change, dF, self.relaxed + self.response @ dF

    def state(self) -> CellState:
        """The state reached, with its rates and moduli."""
        Q = self.loading.axes
        return CellState(
            load=self.load, gradient=(Q @ self.gradient).reshape(2, 2),
            fluctuation=self.fluctuation,
            rate=np.concatenate([Q @ self.rate, self.response @ self.rate]),
            stress=np.asarray((Q @ self.macro_forces).reshape(2, 2) / self.area),
            stiffness=self.stiffness,
            moduli=(Q @ self.condensed @ Q.T).reshape(2, 2, 2, 2) / self.area,
        )  # fmt: skip


class PeriodicCell:
    """One cell of a lattice with a material: data of its equilibrium equations.

    ``nodal_mass`` and ``mass`` are the mass matrix of unit density [mm^2], unreduced and reduced;
    ``filling`` is the area fraction of material in the cell [-]; ``factorisations`` counts every
    factorisation of an equilibrium. ``affine`` (2 n, 4): displacements due to F̄_11, F̄_12, F̄_21
    and F̄_22 [mm]; ``free_dofs``: True for reduced unknowns that are not fixed.
    """

    def __init__(self, cell: UnitCell, material: Material) -> None:
        self.cell = cell
        self.body = FreeBody(cell.mesh, material)
        self.nodal_mass = self.body.mass()
        self.reduction = Reduction(self.nodal_mass, cell.periodicity)
        self.mass = self.reduction.reduced(self.nodal_mass)
        self.filling = float(self.nodal_mass.sum()) / (2.0 * cell.area)
        self.factorisations = 0
        X, zero = cell.mesh.nodes, np.zeros(len(cell.mesh.nodes))
        modes = [(X[:, 0], zero), (X[:, 1], zero), (zero, X[:, 0]), (zero, X[:, 1])]
        self.affine = np.stack([np.stack(m, axis=1).ravel() for m in modes], axis=1)
        self.free_dofs = self.reduction.order // 2 != 0  # master 0 is fixed
        dofs = np.flatnonzero(self.free_dofs)
        whole = self.mass(CENTRE)
        numbers = self.reduction.assembled(np.arange(1.0, whole.nnz + 1.0))
        self._free_entries = csr_array(numbers[dofs][:, dofs])
        self._factor: Factor | None = None

    def displacement(self, state: CellState) -> FloatArray:
        """(n, 2) displacement of the mesh's nodes, including the affine part [mm]."""
        return self.displaced(state.gradient.ravel(), state.fluctuation)

    def equilibrium(
        self, loading: MacroLoading, load: float, near: CellState | None = None
    ) -> CellState | None:
        """The equilibrium at a load [-], from a state nearby; None if not found or admissible."""
        guess: FloatArray = np.concatenate([np.eye(2).ravel(), np.zeros(self.reduction.size)])
        if near is not None:
            guess = near.value + (load - near.load) * near.rate
        found = self.corrected(loading, load, guess)
        return found if isinstance(found, CellState) else None

    def corrected(
        self, loading: MacroLoading, load: float, guess: FloatArray,
        amplitude: Amplitude | None = None,
    ) -> CellState | str:  # fmt: skip
        """The equilibrium near a guess (4 + 2 count,) of F̄ and w; or the reason if there is none.

        With an amplitude, ``load`` is also a guess.
        """
        F, w = loading.axes.T @ guess[:4], guess[4:]
        for _ in range(_ITERATIONS):
            F = np.where(loading.free, F, np.eye(2).ravel() + load * loading.rate)
            system = LinearisedCell(self, loading, load, F, w, amplitude)
            if not system.is_regular:
                return _NOT_CONVERGED
            if system.is_solved:
                is_sound = self.body.smallest_jacobian(self.displaced(loading.axes @ F, w)) > 0
                return system.state() if is_sound else _REVERSED
            try:
                change, dF, dw = system.step()
            except np.linalg.LinAlgError:  # exactly singular
                return _NOT_CONVERGED
            load, F, w = load + change, F + dF, w + dw
        return _NOT_CONVERGED

    def negative_eigenvalues(self, loading: MacroLoading, state: CellState) -> int:
        """Number of negative eigenvalues of the tangent in w and the free components of F̄.

        The sum of those in w with F̄ fixed, and of the moduli of the free components (Haynsworth,
        Linear Algebra Appl. 1 (1968) 73-81). Zero: stable to perturbations with the cell's period.
        """
        free, Q = loading.free, loading.axes
        moduli = (Q.T @ state.moduli.reshape(4, 4) @ Q)[np.ix_(free, free)]
        outer = np.linalg.eigvalsh(0.5 * (moduli + moduli.T))
        return self.factor(state.stiffness).negative_pivots + int(np.sum(outer < 0))

    def critical_distances(
        self, state: CellState, shapes: FloatArray, eigenvalues: FloatArray
    ) -> FloatArray:
        """(k,) relative distances of modes' critical loads from the load, to first order [-].

        Computed from the rates of their Rayleigh quotients along the path just before ``state``;
        ``shapes`` (k, n, 2), with mean square 1, and ``eigenvalues`` (k,) are those at the load.
        """
        fields = shapes.reshape(len(shapes), -1).T
        back = state.value - _BACK * state.load * state.rate
        before = self.body.stiffness(self.displaced(back[:4], back[4:]))
        change = np.sum(fields * ((before - state.stiffness) @ fields), axis=0)
        return np.asarray(eigenvalues * _BACK * self.filling * self.cell.area / change)

    def factor(self, stiffness: csr_array) -> Factor:
        """Factorise the stiffness (2 n, 2 n), reduced to free fluctuations.

        Every call returns the same object, updated. ArithmeticError if it is singular.
        """
        self.factorisations += 1
        matrix, whole = self._free_entries.copy(), self.reduction.reduced(stiffness)(CENTRE)
        matrix.data = whole.data[self._free_entries.data.astype(np.int64) - 1]
        if self._factor is None:
            self._factor = factorise(matrix, definite=False)
        else:
            self._factor.update(matrix)
        return self._factor

    def every(self, values: FloatArray) -> FloatArray:
        """(2 count, ...) values of all unknowns from the free ones (free, ...), zero at others."""
        every = np.zeros((self.reduction.size, *values.shape[1:]))
        every[self.free_dofs] = values
        return every

    def displaced(self, gradient: FloatArray, fluctuation: FloatArray) -> FloatArray:
        """(n, 2) displacement of the mesh's nodes for F̄ (4,) and w (2 count,) [mm]."""
        affine = (self.affine @ (gradient - np.eye(2).ravel())).reshape(-1, 2)
        return np.asarray(affine + self.reduction.displacement(fluctuation))


@dataclass(eq=False)
class CellPath:
    """The primary path of a cell under one loading; states already found are stored."""

    cell: PeriodicCell
    loading: MacroLoading
    states: list[CellState] = field(default_factory=list)

    def at(self, load: float) -> CellState | None:
        """The equilibrium at a load [-], from the nearest known one; None if steps of 1e-6 fail."""
        if not self.states:
            start = self.cell.equilibrium(self.loading, 0.0)
            if start is None:
                return None
            self.states.append(start)
        here = min(self.states, key=lambda state: abs(state.load - load))
        step = load - here.load
        while here.load != load:
            to = load if abs(load - here.load) <= abs(step) else here.load + step
            found = self.cell.equilibrium(self.loading, to, here)
            if found is None:
                step *= 0.5
                if abs(step) < _SMALLEST_STEP:
                    return None
                continue
            self.states.append(found)
            here = found
        return here
