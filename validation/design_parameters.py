"""Design of a test to identify a model's parameters: information in its images and forces.

The normal matrix of the parameters p is the matrix M of ``design`` with the model's sensitivities
S = du/dp, summed over the photographed states. A load cell of noise s_F adds
(dF/dp)' (dF/dp) / s_F² for each state. It equals the normal matrix of an identification at its
minimum (modeharvest.idic.finite_element.identification.identify), without making images.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from modeharvest.idic.finite_element.identification.observed import at_fixed_points
from modeharvest.idic.finite_element.result import nodal_values
from modeharvest.util.arrays import FloatArray

if TYPE_CHECKING:  # made by dolfinx, which this module doesn't need
    from modeharvest.fem.path.parametric import ParametricState as ModelState

_STEP = 1e-5
"""Step of finite differences for the gradient of a displacement [mm]."""


@dataclass(frozen=True, eq=False)
class ModelStates:
    """States of a model at several nominal strains, with derivatives by its parameters."""

    names: tuple[str, ...]
    values: FloatArray
    """(k,) names and values of the parameters."""
    states: Mapping[float, ModelState]
    """States by nominal strain: those of the test, and alternatives."""
    strains: tuple[float, ...]
    """Nominal strains of the test, ascending [-]."""
    force_sd: float
    """Standard deviation of the load cell [N/mm]; 0 without one."""

    def photographed(self, last: float) -> tuple[float, ...]:
        """The strains of a test that ends at the strain ``last``."""
        return (*(e for e in self.strains[:-1] if e < last), last)

    def by_forces(self, last: float) -> FloatArray:
        """(k, k) normal matrix of the force readings of a test that ends at the strain ``last``."""
        J = np.array([self.states[e].force_by for e in self.photographed(last)])
        return np.asarray(J.T @ J / self.force_sd**2 if self.force_sd else 0.0 * J.T @ J)

    def mapped(self, strain: float, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        """F (m, 2, 2) and S (m, 2, k) at material points (m, 2) [mm]."""
        state = at_fixed_points(self.states[strain])
        mesh, u, F = state.mesh, state.displacement, np.tile(np.eye(2), (len(at), 1, 1))
        for k, step in enumerate(_STEP * np.eye(2)):
            ahead, behind = (nodal_values(mesh, u, at + s, beside=True) for s in (step, -step))
            F[:, :, k] += (ahead - behind) / (2.0 * _STEP)
        return F, nodal_values(mesh, np.moveaxis(state.displacement_by, 0, 2), at, beside=True)
