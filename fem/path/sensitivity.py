"""Sensitivities of an equilibrium to a material's constants and to how its edges move.

At an equilibrium R(u, p) = 0, so du/dp = -K^-1 dR/dp: with the factor that is there anyway, one
back-substitution a parameter. dR/dp is taken by central differences of fourth order in p, exact to
rounding in moduli, on which R depends linearly. Near a bifurcation K is nearly singular; where the
amplitude of the pattern is prescribed instead, the nominal strain follows from it, and both answer
regularly to p: the bordered system, solved by block elimination (Keller, in: Applications of
Bifurcation Theory, Academic Press 1977, pp. 359-384).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from petsc4py import PETSc

from modeharvest.fem.path.continuation import State
from modeharvest.fem.path.equilibrium import Structure

TRAVEL, TILT = "travel", "tilt"
"""Unknowns of the loaded edges: a factor of all nominal strains [-], and the tilt of the edge at
x > 0 per nominal strain [rad]."""
_STEP = 1e-3  # of a constant, for differences
_STENCIL = ((1.0, 8.0 / 12.0), (2.0, -1.0 / 12.0))


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives by one parameter."""

    displacement: PETSc.Vec
    """Of u [mm per unit of the parameter], constrained components included."""
    force: float
    """Of the reaction by thickness [N/mm per unit]."""
    strain: float
    """Of the nominal strain [-]."""


def sensitivities(
    structure: Structure,
    state: State,
    names: Sequence[str],
    length: float,
    weights: PETSc.Vec | None = None,
    travel: float = 1.0,
) -> list[Sensitivity]:
    """Derivatives of an equilibrium by parameters; one factorisation, a solution for each.

    structure, state : parametric; its equilibrium, whose constants and tilt it has.
    names : of constants, as in ``structure.constants``, or TRAVEL, TILT.
    length : of the reaction, see :meth:`Structure.reaction` [mm].
    weights : of the amplitude that is prescribed, weights . u; by default the strain is.
    travel : the factor that the state's strain has in it.
    """
    factor, tangent, u = structure.factor(state.u), state.tangent, state.u

    def answer(du: PETSc.Vec, dforces: PETSc.Vec | None, strain: float = 0.0) -> Sensitivity:
        forces = structure.forces_along(u, du)
        if dforces is not None:
            forces.axpy(1.0, dforces)
        return Sensitivity(du, structure.reaction_of(forces, length), strain)

    found = []
    for name in names:
        if name == TRAVEL:  # of no account where the amplitude says what the strain is
            change = 0.0 if weights is not None else state.strain / travel
            found.append(answer(change * tangent, None, change))
            continue
        dforces, prescribed = None, None
        if name == TILT:
            prescribed = structure.turning(state.strain)
            right = structure.free(structure.forces_along(u, prescribed))
        else:
            dforces = _change_of_forces(structure, u, name)
            right = structure.free(dforces.copy())
        du = factor.solve(right)
        du.scale(-1.0)
        if prescribed is not None:
            du = structure.free(du) + prescribed
        strain = 0.0
        if weights is not None:
            strain = -float(weights.dot(du)) / float(weights.dot(tangent))
            du.axpy(strain, tangent)
        found.append(answer(du, dforces, strain))
    return found


def amplitude_sensitivity(
    structure: Structure, state: State, length: float, weights: PETSc.Vec
) -> Sensitivity:
    """Derivatives of an equilibrium by the amplitude ``weights . u`` that is prescribed [1/mm]."""
    strain = 1.0 / float(weights.dot(state.tangent))
    du = strain * state.tangent
    force = structure.reaction_of(structure.forces_along(state.u, du), length)
    return Sensitivity(du, force, strain)


def _change_of_forces(structure: Structure, u: PETSc.Vec, name: str) -> PETSc.Vec:
    """d(internal forces)/d(constant) at fixed u [N/mm per unit of the constant]."""
    constant = structure.constants[name]
    value = float(constant.value)
    step = _STEP * (abs(value) or 1.0)
    total = structure.zero()
    for distance, weight in _STENCIL:
        for sign in (1.0, -1.0):
            constant.value = value + sign * distance * step
            total.axpy(sign * weight / step, structure.forces(u))
    constant.value = value
    return total
