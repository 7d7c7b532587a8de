"""Sensitivities of an equilibrium to a test's parameters: of material, loaded edges and holes.

At an equilibrium R(u, p) = 0, so du/dp = -K^-1 dR/dp: with the factor that is there anyway, one
back-substitution a parameter. dR/dp is taken by central differences of fourth order in p, exact to
rounding in moduli, on which R depends linearly; where holes move, on a mesh whose nodes have moved.
Near a bifurcation K is nearly singular; where the amplitude of the pattern is prescribed instead,
the nominal strain follows from it, and both answer regularly to p: the bordered system, solved by
block elimination (Keller, in: Applications of Bifurcation Theory, Academic Press 1977, pp.
359-384).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from modeharvest.fem.path.continuation import State
from modeharvest.fem.path.equilibrium import Structure
from modeharvest.util.arrays import FloatArray

_STEP = 1e-3  # of a constant, for differences
_STEP_MM = 2e-4  # of the largest motion of a node
_STENCIL = ((1.0, 8.0 / 12.0), (2.0, -1.0 / 12.0))


@dataclass(frozen=True, eq=False)
class Variation:
    """How a structure changes with a parameter, per unit of it."""

    nodes: FloatArray
    """(n, 2) where nodes move [mm]."""
    edges: FloatArray
    """(n, 2) what is added to the displacements of the loaded edges per nominal strain [mm]."""
    constant: str = ""
    """Or which of the material's changes, as in ``Structure.constants``."""


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives by one parameter."""

    displacement: PETSc.Vec
    """Of u at nodes that move with it [mm per unit of the parameter], constrained ones included."""
    force: float
    """Of the reaction by thickness [N/mm per unit]."""
    strain: float
    """Of the nominal strain [-]."""


def sensitivities(
    structure: Structure,
    state: State,
    variations: Sequence[Variation | None],
    length: float,
    weights: PETSc.Vec | None = None,
    travel: float = 1.0,
) -> list[Sensitivity]:
    """Derivatives of an equilibrium by parameters; one factorisation, a solution for each.

    structure, state : parametric; its equilibrium, whose constants, edges and nodes it has.
    variations : of each parameter; None for a factor of all nominal strains.
    length : of the reaction, see :meth:`Structure.reaction` [mm].
    weights : of the amplitude that is prescribed, weights . u; by default the strain is.
    travel : the factor that the state's strain has in it.
    """
    factor, tangent, u = structure.factor(state.u), state.tangent, state.u
    found = []
    for variation in variations:
        if variation is None:  # of no account where the amplitude says what the strain is
            change = 0.0 if weights is not None else state.strain / travel
            forces = structure.forces_along(u, change * tangent)
            force = structure.reaction_of(forces, length)
            found.append(Sensitivity(change * tangent, force, change))
            continue
        forces, prescribed = _change_of_forces(structure, state, variation)
        du = factor.solve(structure.free(forces.copy()))
        du.scale(-1.0)
        strain = 0.0
        if weights is not None:
            strain = -float(weights.dot(du)) / float(weights.dot(tangent))
            du.axpy(strain, tangent)
        forces.axpy(1.0, structure.forces_along(u, du))
        du.axpy(1.0, prescribed)
        found.append(Sensitivity(du, structure.reaction_of(forces, length), strain))
    return found


def amplitude_sensitivity(
    structure: Structure, state: State, length: float, weights: PETSc.Vec
) -> Sensitivity:
    """Derivatives of an equilibrium by the amplitude ``weights . u`` that is prescribed [1/mm]."""
    strain = 1.0 / float(weights.dot(state.tangent))
    du = strain * state.tangent
    force = structure.reaction_of(structure.forces_along(state.u, du), length)
    return Sensitivity(du, force, strain)


def _change_of_forces(
    structure: Structure, state: State, variation: Variation
) -> tuple[PETSc.Vec, PETSc.Vec]:
    """d(internal forces)/d(parameter) at fixed free components, with d(constrained components)."""
    constant, nodes = structure.constants.get(variation.constant), structure.nodes
    prescribed = state.strain * structure.constrained(variation.edges)
    if constant is None:
        largest = max(np.abs(variation.nodes).max(), np.abs(prescribed.array).max())
        step = _STEP_MM / float(largest)
    else:
        value = float(constant.value)
        step = _STEP * (abs(value) or 1.0)
    total = structure.zero()
    for distance, weight in _STENCIL:
        for sign in (1.0, -1.0):
            by = sign * distance * step
            if constant is None:
                structure.place(nodes + by * variation.nodes)
            else:
                constant.value = value + by
            total.axpy(sign * weight / step, structure.forces(state.u + by * prescribed))
    if constant is None:
        structure.place(nodes)
    else:
        constant.value = value
    return total, prescribed
