"""Design of a test whose model's parameters are sought: what its images and forces know of them.

The normal matrix of the parameters p, of which S = du/dp are the model's own sensitivities, is that
of ``design``, summed over the states that are photographed; a load cell of noise s_F adds
(dF/dp)' (dF/dp) / s_F² of each. It is what an identification has at its minimum
(modeharvest.idic.finite_element.identification.identify), without an image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from modeharvest.idic.finite_element.identification.observed import at_fixed_points
from modeharvest.idic.finite_element.result import nodal_values
from modeharvest.util.arrays import FloatArray

if TYPE_CHECKING:  # dolfinx makes them; nothing here needs it
    from modeharvest.fem.path.parametric import ParametricState as ModelState

_STEP = 1e-5
"""For the gradient of a displacement [mm]."""


@dataclass(frozen=True, eq=False)
class ModelStates:
    """States of a model at some nominal strains, with their derivatives by parameters."""

    names: tuple[str, ...]
    values: FloatArray
    """(k,) of the parameters, and what they are called."""
    states: Mapping[float, ModelState]
    """By their nominal strain: those of the test, and others that it may have instead."""
    strains: tuple[float, ...]
    """Of the test, ascending."""
    force_sd: float
    """Of the load cell [N/mm]; 0 without one."""

    def photographed(self, last: float) -> tuple[float, ...]:
        """The strains of a test that ends at another one."""
        return (*(e for e in self.strains[:-1] if e < last), last)

    def by_forces(self, last: float) -> FloatArray:
        """(k, k) normal matrix of the readings of a test that ends at a strain."""
        J = np.array([self.states[e].force_by for e in self.photographed(last)])
        return np.asarray(J.T @ J / self.force_sd**2 if self.force_sd else 0.0 * J.T @ J)

    def mapped(self, strain: float, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        """F (m, 2, 2) and S (m, 2, k), at fixed material points, at points (m, 2) [mm]."""
        state = at_fixed_points(self.states[strain])
        mesh, u, F = state.mesh, state.displacement, np.tile(np.eye(2), (len(at), 1, 1))
        for k, step in enumerate(_STEP * np.eye(2)):
            ahead, behind = (nodal_values(mesh, u, at + s, beside=True) for s in (step, -step))
            F[:, :, k] += (ahead - behind) / (2.0 * _STEP)
        return F, nodal_values(mesh, np.moveaxis(state.displacement_by, 0, 2), at, beside=True)
