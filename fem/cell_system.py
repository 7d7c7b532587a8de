"""The linearised equations of a periodic cell: one step of Newton's method, one state's moduli.

The fluctuation is condensed with one factor of its stiffness. What remains are the free components
of F̄ and, if an amplitude is prescribed, the load: a small dense system, and the only place
where an amplitude's equation enters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array

from modeharvest.fem.macroscopic import MacroLoading
from modeharvest.fem.reduction import factorise

if TYPE_CHECKING:
    from modeharvest.fem.cell import PeriodicCell

FloatArray = NDArray[np.float64]

# Forces must be smaller than what a change of the load by this would make.
_LOAD_TOLERANCE = 1e-11
_AMPLITUDE_TOLERANCE = 1e-11  # relative
_AT_REST = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class CellState:
    """An equilibrium of a cell on its primary path.

    Parameters
    ----------
    load
        The load parameter e: for compressions the nominal strain [-].
    gradient, gradient_rate
        (2, 2) F̄ and dF̄/de [-].
    fluctuation, fluctuation_rate
        (2 count,) w of the masters in the order of ``Reduction``, and dw/de [mm].
    stress
        (2, 2) P̄, mean first Piola-Kirchhoff stress over the cell with its holes [MPa].
    stiffness
        (2 n, 2 n) of the mesh's nodes without any constraint [N/mm^2].
    moduli
        (2, 2, 2, 2) effective tangent dP̄_ij/dF̄_kl with w at equilibrium [MPa].
    """

    load: float
    gradient: FloatArray
    gradient_rate: FloatArray
    fluctuation: FloatArray
    fluctuation_rate: FloatArray
    stress: FloatArray
    stiffness: csr_array
    moduli: FloatArray


@dataclass(frozen=True, eq=False)
class Amplitude:
    """A linear measure of the fluctuation w that is prescribed, while the load is found.

    Parameters
    ----------
    weights
        (2 count,) in the order of ``Reduction``; not those of a translation.
    value
        What ``weights . w`` must be [mm].
    """

    weights: FloatArray
    value: float


class LinearisedCell:
    """The equations of a cell at a trial state.

    Parameters
    ----------
    cell, loading
        What is loaded, and how.
    load
        Of the trial state [-].
    gradient, fluctuation
        (4,) F̄ and (2 count,) w of the trial state [-, mm].
    amplitude
        If prescribed, the load is an unknown.
    """

    def __init__(
        self,
        cell: PeriodicCell,
        loading: MacroLoading,
        load: float,
        gradient: FloatArray,
        fluctuation: FloatArray,
        amplitude: Amplitude | None = None,
    ) -> None:
        self.cell, self.loading, self.load = cell, loading, load
        self.amplitude = amplitude
        self.gradient, self.fluctuation = gradient, fluctuation
        self.area = cell.cell.area
        u = cell.displaced(gradient, fluctuation)
        forces = cell.body.forces(u)
        self.forces = cell.reduction.gathered(forces)[cell.moving]
        self.macro_forces = cell.affine.T @ forces
        self.is_regular = bool(np.isfinite(forces).all())
        if self.is_regular:
            self._eliminate(cell.body.stiffness(u))

    def _eliminate(self, stiffness: csr_array) -> None:
        """Condense the fluctuation: how it, and the forces, follow F̄ and the load."""
        cell, moving = self.cell, np.flatnonzero(self.cell.moving)
        self.stiffness, self.on_affine = stiffness, stiffness @ cell.affine
        self.coupling = cell.reduction.gathered(self.on_affine)[moving]
        inner = cell.reduction.reduced(stiffness).at(_AT_REST)[moving][:, moving]
        cell.factorisations += 1
        try:
            self._factor: Any = factorise(csc_array(inner))
        except RuntimeError:  # SuperLU: exactly singular
            self.is_regular = False
            return
        self.response = -self._factor.solve(self.coupling)
        self.condensed = cell.affine.T @ self.on_affine + self.coupling.T @ self.response
        free = self.loading.free
        self.rate = self.loading.rate
        self.rate[free] = np.linalg.solve(
            self.condensed[np.ix_(free, free)],
            (self.area * self.loading.dead - self.condensed @ self.rate)[free],
        )

    @property
    def _unbalanced(self) -> FloatArray:
        """(4,) mean stress in excess of what is prescribed, times the area [N]; 0 elsewhere."""
        excess = self.macro_forces - self.area * self.load * self.loading.dead
        return np.where(self.loading.free, excess, 0.0)

    @property
    def is_solved(self) -> bool:
        """Whether no force, inner or macroscopic, is left."""
        inner = _LOAD_TOLERANCE * np.linalg.norm(self.on_affine @ self.rate)
        outer = _LOAD_TOLERANCE * np.linalg.norm(self.condensed) * np.linalg.norm(self.rate)
        return bool(
            np.linalg.norm(self.forces) <= inner
            and np.linalg.norm(self._unbalanced) <= outer
            and abs(self._excess) <= _AMPLITUDE_TOLERANCE * abs(self._wanted)
        )

    @property
    def _wanted(self) -> float:
        return 0.0 if self.amplitude is None else self.amplitude.value

    @property
    def _excess(self) -> float:
        """The amplitude in excess of what is prescribed [mm]."""
        if self.amplitude is None:
            return 0.0
        return float(self.amplitude.weights @ self.fluctuation) - self._wanted

    def step(self) -> tuple[float, FloatArray, FloatArray]:
        """Newton's changes of the load, of F̄ (4,) and of the fluctuation."""
        free, relaxed = np.flatnonzero(self.loading.free), -self._factor.solve(self.forces)
        # Unknown are the free components of F̄ and, if an amplitude is prescribed, the load.
        along: FloatArray = np.zeros((4, len(free) + 1))
        along[free, np.arange(len(free))] = 1.0
        along[:, -1] = self.loading.rate
        stiffness: FloatArray = self.condensed[free] @ along
        stiffness[:, -1] -= self.area * self.loading.dead[free]
        rest = (self._unbalanced + self.coupling.T @ relaxed)[free]
        if self.amplitude is None:
            along, stiffness = along[:, :-1], stiffness[:, :-1]
        else:
            weights = self.amplitude.weights[self.cell.moving]
            stiffness = np.vstack([stiffness, weights @ self.response @ along])
            rest = np.append(rest, self._excess + weights @ relaxed)
        unknown = np.linalg.solve(stiffness, -rest)
        dF = along @ unknown
        change = 0.0 if self.amplitude is None else float(unknown[-1])
        return change, dF, self._full(relaxed + self.response @ dF)

    def state(self) -> CellState:
        """The state reached, with its rates and moduli."""
        return CellState(
            load=self.load,
            gradient=self.gradient.reshape(2, 2),
            gradient_rate=self.rate.reshape(2, 2),
            fluctuation=self.fluctuation,
            fluctuation_rate=self._full(self.response @ self.rate),
            stress=np.asarray(self.macro_forces.reshape(2, 2) / self.area),
            stiffness=self.stiffness,
            moduli=self.condensed.reshape(2, 2, 2, 2) / self.area,
        )

    def _full(self, moving: FloatArray) -> FloatArray:
        every = np.zeros(self.cell.reduction.size)
        every[self.cell.moving] = moving
        return every
