"""Sensitivities of an equilibrium to a test's parameters: of material, loaded edges and holes.

At an equilibrium R(u, p) = 0, so du/dp = -K^-1 dR/dp: with the existing factor this is one
back-substitution per parameter, for all at once. dR/dp is computed by finite differences in p,
exact to rounding for moduli, on which R depends linearly; for holes on a mesh with moved nodes.
Near a bifurcation K is nearly singular. If the pattern's amplitude is prescribed instead of the
nominal strain, both u and the strain depend regularly on p: this bordered system is solved by block
elimination (Keller, in: Applications of Bifurcation Theory, Academic Press 1977, pp. 359-384). At
the bifurcation, the strain follows from the mode's curvature; forces on the mode are left out.
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

_STEP = 1e-4  # relative step of a constant, for finite differences
_STEP_MM = 3e-5  # step as the largest motion of a node [mm]
_AHEAD = 1e-3  # factor on these steps for one-sided differences: errors are still below 1e-6
_ALONG = 1e-5  # step of strain along a path
OMITTED = ("omitted[0]", "omitted[1]", "omitted[2]")


@dataclass(frozen=True, eq=False)
class Variation:
    """Change of a structure per unit of a parameter."""

    nodes: FloatArray
    """(n, 2) motion of nodes [mm]."""
    edges: FloatArray
    """(n, 2) additional displacement of the loaded edges per nominal strain [mm]."""
    constant: str = ""
    """Name of the material's constant that changes, as in ``Structure.constants``."""


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives by one parameter."""

    displacement: PETSc.Vec
    """Derivative of u at moving nodes, including constrained components [mm per unit]."""
    force: float
    """Derivative of the reaction per unit thickness [N/mm per unit]."""
    strain: float
    """Derivative of the nominal strain [1 per unit]."""


def sensitivities(
    structure: Structure, state: State, variations: Sequence[Variation | None], length: float,
    weights: PETSc.Vec | None = None, travel: float = 1.0, factor: BodyFactor | None = None,
    mode: Mode | None = None, forces: PETSc.Vec | None = None,
) -> list[Sensitivity]:  # fmt: skip
    """Derivatives of an equilibrium by parameters; one factorisation, one block of solutions.

    structure, state : parametric structure, with constants, edges and nodes of the equilibrium.
    variations : one for each parameter; None for a factor on all nominal strains (travel).
    length : length for the reaction, see :meth:`Structure.reaction` [mm].
    weights : of the prescribed amplitude, weights . u; by default the strain is prescribed.
    travel : the factor ``travel`` included in the state's strain.
    factor : factor of the tangent stiffness at the state, if available.
    mode : critical mode of a bifurcation: the strain keeps its curvature zero; see above.
    forces : internal forces at the state, if available.
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
        if variation is None:  # no effect if the amplitude determines the strain
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
    """d(mode . K mode) by a parameter, or by the strain; ``rate``: du by the same [N]."""
    step = _ALONG if variation is None else _step(structure, state, variation)
    return float(_difference(structure, variation, step, lambda by: structure.curvature(
        state.u + by * rate, mode.vector)))  # fmt: skip


def amplitude_sensitivity(
    structure: Structure, state: State, length: float, weights: PETSc.Vec
) -> Sensitivity:
    """Derivatives of an equilibrium by the prescribed amplitude ``weights . u`` [1/mm]."""
    strain = 1.0 / float(weights.dot(state.tangent))
    du = strain * state.tangent
    forces = structure.forces_along(state.u, du)
    return Sensitivity(du, structure.reaction_of(forces, length), strain)


def _solutions(
    structure: Structure, factor: BodyFactor, forces: Sequence[PETSc.Vec], mode: Mode | None
) -> list[PETSc.Vec]:
    """-K^-1 times each force [mm], zero at constrained components, M-orthogonal to ``mode``."""
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
    """Step of a parameter for finite differences."""
    if constant := structure.constants.get(variation.constant):
        return _STEP * (abs(float(constant.value)) or 1.0)
    moved = variation.nodes, state.strain * variation.edges
    return _STEP_MM / float(np.abs(moved).max())


def _difference(
    structure: Structure, variation: Variation | None, step: float,
    function: Callable[[float], Any], here: Any = None,
) -> Any:  # fmt: skip
    """Difference quotient of a function of the parameter's change; one-sided with ``here``."""
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
    """The law with additional constants OMITTED, 0, for terms that its energy may lack [MPa].

    The terms are E^2, E (J - 1) and (J - 1)^3 with E = I1 - 3 - 2 ln J: the lowest isotropic terms
    with neither stress nor stiffness at rest.
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
