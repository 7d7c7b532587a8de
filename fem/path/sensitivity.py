"""Sensitivities of an equilibrium to a test's parameters: of material, loaded edges and holes.

At an equilibrium R(u, p) = 0, so du/dp = -K^-1 dR/dp: with the factor that is there anyway, one
back-substitution a parameter, all at once. dR/dp is taken by differences in p, exact to
rounding in moduli, on which R depends linearly; where holes move, on a mesh whose nodes have moved.
Near a bifurcation K is nearly singular; where the amplitude of the pattern is prescribed instead,
the nominal strain follows from it, and both answer regularly to p: the bordered system, solved by
block elimination (Keller, in: Applications of Bifurcation Theory, Academic Press 1977, pp.
359-384). At it the strain follows from the mode's curvature; what drives the mode is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from petsc4py import PETSc

from modeharvest.fem.materials import Material, functions_of
from modeharvest.fem.path.continuation import State
from modeharvest.fem.path.equilibrium import Structure
from modeharvest.fem.path.factor import BodyFactor
from modeharvest.fem.path.stability import Mode
from modeharvest.util.arrays import FloatArray

_STEP = 1e-4  # of a constant, for differences
_STEP_MM = 3e-5  # of the largest motion of a node
_AHEAD = 1e-3  # of these, where differences are of one side: errors below 1e-6 still
_ALONG = 1e-5  # of strain, along a path
OMITTED = ("omitted[0]", "omitted[1]", "omitted[2]")


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
    structure: Structure, state: State, variations: Sequence[Variation | None], length: float,
    weights: PETSc.Vec | None = None, travel: float = 1.0, factor: BodyFactor | None = None,
    mode: Mode | None = None, forces: PETSc.Vec | None = None,
) -> list[Sensitivity]:  # fmt: skip
    """Derivatives of an equilibrium by parameters; one factorisation, one block of solutions.

    structure, state : parametric; its equilibrium, whose constants, edges and nodes it has.
    variations : of each parameter; None for a factor of all nominal strains.
    length : of the reaction, see :meth:`Structure.reaction` [mm].
    weights : of the amplitude that is prescribed, weights . u; by default the strain is.
    travel : the factor that the state's strain has in it.
    factor : of the tangent stiffness at the state, if it is at hand.
    mode : the critical one of a bifurcation: the strain keeps its curvature zero; see above.
    forces : internal ones at the state, if they are at hand.
    """
    factor, tangent = factor or structure.factor(state.u), state.tangent
    along = structure.forces_along(state.u, structure.shortening)  # and K is symmetric
    here = forces or structure.forces(state.u)
    changes = [_change_of_forces(structure, state, v, here) for v in variations if v is not None]
    solved = _solutions(structure, factor, [f for f, _ in changes], mode)
    solutions = zip(changes, solved, strict=True)
    found = list[Sensitivity]()
    softening = 1.0 if mode is None else _curvature_rate(structure, state, mode, tangent, None)
    for variation in variations:
        if variation is None:  # of no account where the amplitude says what the strain is
            strain = state.strain / travel if weights is None and mode is None else 0.0
            du, force = strain * tangent, strain * float(along.dot(tangent)) / length
        else:
            (change, prescribed), du = next(solutions)
            strain = 0.0
            if weights is not None:
                strain = -float(weights.dot(du)) / float(weights.dot(tangent))
            if mode is not None:
                rate = du + prescribed
                strain = -_curvature_rate(structure, state, mode, rate, variation) / softening
            du.axpy(strain, tangent)
            force = structure.reaction_of(change, length) + float(along.dot(du)) / length
            du.axpy(1.0, prescribed)
        found.append(Sensitivity(du, force, strain))
    return found


def _curvature_rate(
    structure: Structure, state: State, mode: Mode, rate: PETSc.Vec, variation: Variation | None
) -> float:
    """d(mode . K mode) by a parameter, or by the strain, with which u changes at a rate [N]."""
    step = _ALONG if variation is None else _step(structure, state, variation)
    return float(_difference(structure, variation, step, lambda by: structure.curvature(
        state.u + by * rate, mode.vector)))  # fmt: skip


def amplitude_sensitivity(
    structure: Structure, state: State, length: float, weights: PETSc.Vec
) -> Sensitivity:
    """Derivatives of an equilibrium by the amplitude ``weights . u`` that is prescribed [1/mm]."""
    strain = 1.0 / float(weights.dot(state.tangent))
    du = strain * state.tangent
    forces = structure.forces_along(state.u, du)
    return Sensitivity(du, structure.reaction_of(forces, length), strain)


def _solutions(
    structure: Structure, factor: BodyFactor, forces: Sequence[PETSc.Vec], mode: Mode | None
) -> list[PETSc.Vec]:
    """-K^-1 times each of some forces [mm], zero at the constrained components; without a mode."""
    if not forces:
        return []
    rows = np.array([structure.free(vector.copy()).array for vector in forces])
    if mode is not None:
        rows -= np.outer(rows @ mode.vector.array, mode.weighted.array)
    size, comm = (forces[0].sizes, (None, len(forces))), forces[0].comm
    matrix = PETSc.Mat().createDense(size, array=np.asfortranarray(rows.T), comm=comm)
    found = factor.solve_block(matrix)  # named, because its array doesn't keep it alive
    solutions = [vector.duplicate() for vector in forces]
    for vector, column in zip(solutions, found.getDenseArray().T, strict=True):
        vector.array[:] = -column
        if mode is not None:
            vector.axpy(-mode.overlap(vector), mode.vector)
    return solutions


def _change_of_forces(
    structure: Structure, state: State, variation: Variation, here: PETSc.Vec
) -> tuple[PETSc.Vec, PETSc.Vec]:
    """d(internal forces)/d(parameter) at fixed free components, with d(constrained components)."""
    prescribed = state.strain * structure.constrained(variation.edges)
    step, base = _step(structure, state, variation), None if variation.nodes.any() else here
    return _difference(structure, variation, step, lambda by: structure.forces(
        state.u + by * prescribed), base), prescribed  # fmt: skip


def _step(structure: Structure, state: State, variation: Variation) -> float:
    """Of a parameter, for differences."""
    if constant := structure.constants.get(variation.constant):
        return _STEP * (abs(float(constant.value)) or 1.0)
    moved = variation.nodes, state.strain * variation.edges
    return _STEP_MM / float(np.abs(moved).max())


def _difference(
    structure: Structure, variation: Variation | None, step: float,
    function: Callable[[float], Any], here: Any = None,
) -> Any:  # fmt: skip
    """Difference by a parameter of a function of its change: central, or from ``here`` without."""
    constant = None if variation is None else structure.constants.get(variation.constant)
    nodes, found = structure.nodes, []
    value = 0.0 if constant is None else float(constant.value)
    for by in (step, -step, 0.0) if here is None else (_AHEAD * step, 0.0):
        if constant is not None:
            constant.value = value + by
        elif variation is not None:
            structure.place(nodes + by * variation.nodes)
        if by:
            found.append(function(by))
    end, base = (0.5, found[-1]) if here is None else (1.0 / _AHEAD, here)
    return (end / step) * (found[0] - base)


def with_omitted_terms(material: Material) -> Material:
    """The same law with OMITTED constants of 0, factors of terms that its energy may lack [MPa].

    E^2, E (J - 1) and (J - 1)^3 with E = I1 - 3 - 2 ln J: the lowest isotropic ones that have
    neither stress nor stiffness at rest.
    """
    kind = type(material)

    def energy(law: Any, F: Any) -> Any:
        functions, (a, b, c) = functions_of(F), law.omitted
        J = functions.det(F)
        E, v = functions.inner(F, F) - 2.0 - 2.0 * functions.ln(J), J - 1.0
        return kind.energy(law, F) + a * E**2 + b * E * v + c * v**3

    law = copy(material)
    object.__setattr__(law, "__class__", type(kind.__name__, (kind,), {"energy": energy}))
    object.__setattr__(law, "omitted", (0.0,) * len(OMITTED))
    return law
