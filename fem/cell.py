"""A periodic cell under macroscopic loading: equilibrium, effective stiffness, path.

The displacement is u = (F̄ - I) X + w with a periodic fluctuation w. Unknown are the masters'
fluctuations and those components of F̄ whose mean stress is prescribed; one master is held,
because translations cost nothing. The fluctuation's factor serves the few macroscopic unknowns
by block elimination, which gives the lattice's effective tangent moduli as a by-product. With an
amplitude prescribed, the load is one more of them: such systems are regular on a branch however
near to the point where it leaves the primary path.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from modeharvest.fem.body import FreeBody
from modeharvest.fem.cell_system import Amplitude, CellState, LinearisedCell
from modeharvest.fem.lattices import UnitCell
from modeharvest.fem.macroscopic import MacroLoading
from modeharvest.fem.materials import Material
from modeharvest.fem.reduction import Reduction, factorise, negative_pivots

__all__ = ["Amplitude", "CellPath", "CellState", "Failure", "PeriodicCell"]

FloatArray = NDArray[np.float64]

_ITERATIONS = 12
_SMALLEST_STEP = 1e-6  # of the load
_AT_REST = (0.0, 0.0)


class Failure(Enum):
    """Why there is no equilibrium, in words."""

    NOT_CONVERGED = "Newton's method did not converge"
    REVERSED = "an element would be turned inside out (det F <= 0)"


class PeriodicCell:
    """One cell of a lattice with a material: what its equilibrium equations need.

    ``nodal_mass`` and ``mass`` are the mass matrix of unit density [mm^2], unreduced and reduced,
    ``filling`` is the share of the cell that is material [-]; ``factorisations`` counts every
    factorisation of an equilibrium. ``affine`` (2 n, 4) are the displacements of F̄_11, F̄_12,
    F̄_21 and F̄_22 [mm]; ``moving`` says which reduced unknowns are not held.

    Parameters
    ----------
    cell
        Mesh and lattice vectors [mm]; primitive or enlarged.
    material
        Strain energy density [MPa].
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
        self.moving = self.reduction.order // 2 != 0  # master 0 is held

    def displacement(self, state: CellState) -> FloatArray:
        """(n, 2) displacement of the mesh's nodes, affine part included [mm]."""
        return self.displaced(state.gradient.ravel(), state.fluctuation)

    def equilibrium(
        self, loading: MacroLoading, load: float, near: CellState | None = None
    ) -> CellState | None:
        """The equilibrium at a load, by Newton's method along the tangent of a state nearby.

        None where Newton's method does not arrive, or arrives at a reversed element.
        """
        F: FloatArray = np.eye(2)
        w: FloatArray = np.zeros(self.reduction.size)
        if near is not None:
            F = near.gradient + (load - near.load) * near.gradient_rate
            w = near.fluctuation + (load - near.load) * near.fluctuation_rate
        found = self.corrected(loading, load, F, w)
        return found if isinstance(found, CellState) else None

    def corrected(
        self,
        loading: MacroLoading,
        load: float,
        gradient: FloatArray,
        fluctuation: FloatArray,
        amplitude: Amplitude | None = None,
    ) -> CellState | Failure:
        """The equilibrium that Newton's method finds from a guess of F̄ (2, 2) and w.

        With an ``amplitude`` prescribed the load is a guess, too. A reversed element is a
        failure.
        """
        F: FloatArray = gradient.ravel()
        w = fluctuation
        for _ in range(_ITERATIONS):
            F = np.where(loading.free, F, np.eye(2).ravel() + load * loading.rate)
            system = LinearisedCell(self, loading, load, F, w, amplitude)
            if not system.is_regular:
                return Failure.NOT_CONVERGED
            if system.is_solved:
                u = self.displaced(F, w)
                sound = self.body.smallest_jacobian(u) > 0
                return system.state() if sound else Failure.REVERSED
            try:
                change, dF, dw = system.step()
            except np.linalg.LinAlgError:  # exactly singular
                return Failure.NOT_CONVERGED
            load, F, w = load + change, F + dF, w + dw
        return Failure.NOT_CONVERGED

    def negative_eigenvalues(self, loading: MacroLoading, state: CellState) -> int:
        """Number of negative eigenvalues of the tangent in w and the free components of F̄.

        Those of w with F̄ held, and of the moduli of the free components (Haynsworth, Linear
        Algebra Appl. 1 (1968) 73-81). Zero: stable against all that has the cell's period.
        """
        moving = np.flatnonzero(self.moving)
        inner = self.reduction.reduced(state.stiffness).at(_AT_REST)[moving][:, moving]
        self.factorisations += 1
        free = loading.free
        moduli = state.moduli.reshape(4, 4)[np.ix_(free, free)]
        outer = np.linalg.eigvalsh(0.5 * (moduli + moduli.T))
        return negative_pivots(factorise(csc_array(inner))) + int(np.sum(outer < 0))

    def displaced(self, gradient: FloatArray, fluctuation: FloatArray) -> FloatArray:
        """(n, 2) displacement of the mesh's nodes for F̄ (4,) and w (2 count,) [mm]."""
        affine = (self.affine @ (gradient - np.eye(2).ravel())).reshape(-1, 2)
        return np.asarray(affine + self.reduction.displacement(fluctuation, _AT_REST))


@dataclass(eq=False)
class CellPath:
    """The primary path of a cell under one loading; states already found are kept."""

    cell: PeriodicCell
    loading: MacroLoading
    states: list[CellState] = field(default_factory=list)

    def at(self, load: float) -> CellState | None:
        """The equilibrium at a load [-], from the nearest state known by as many steps as needed.

        None where steps down to 1e-6 don't converge.
        """
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
