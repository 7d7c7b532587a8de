"""Displacements of the ansatz added to a model's, where the model is not trusted.

u = u(p) + v0(X) + v1(X) phi1(X), with v0 and v1 of each state: products of Legendre polynomials
P_i(x/a) P_j(y/b) over the specimen, along x, along y, or along its pattern phi1. The effects of
supports, friction or flaws of the specimen that have no parameter in a state are left to v0 and v1;
material and forces remain the model's.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial.legendre import Legendre

from modeharvest.fem.path.parameters import HIGHEST, require_number
from modeharvest.fem.specimen import Specimen
from modeharvest.util.arrays import FloatArray

if TYPE_CHECKING:  # dolfinx makes the model; nothing here needs it
    from modeharvest.fem.path.parametric import ParametricState as ModelState

_NAME = re.compile(r"(?:v0\[(\d+)\]\.([xy])|v1\[(\d+)\])\[(\d+), ?(\d+)\]")
NAMES = ("v0[k].x[i,j]", "v0[k].y[i,j]", "v1[k][i,j]")
"""Names of terms along x, along y and along the pattern in the state number k, from 0."""


@dataclass(frozen=True)
class Term:
    """A displacement of the ansatz in one state, per unit of its unknown [mm]."""

    state: int
    axis: str
    """"x" or "y" of v0; "" of v1, along the pattern."""
    degrees: tuple[int, int]

    @classmethod
    def named(cls, name: str, states: int) -> Term | None:
        """Make the term of a name as in NAMES; None for another name.

        InputError if there is no such state or too high a degree.
        """
        if not (found := _NAME.fullmatch(name)):
            return None
        state, degrees = int(found[1] or found[3] or 0), (int(found[4]), int(found[5]))
        require_number(name, "a state", state, states)
        require_number(name, "a degree", max(degrees), HIGHEST + 1)
        return cls(state, found[2] or "", degrees)

    def at(self, nodes: FloatArray, specimen: Specimen) -> FloatArray:
        """(n, 2) displacement at points (n, 2) of the undeformed specimen [mm per mm]."""
        x, y = (nodes / specimen.half_size).T
        size = Legendre.basis(self.degrees[0])(x) * Legendre.basis(self.degrees[1])(y)
        along = np.eye(2)["xy".index(self.axis)] if self.axis else specimen.pattern(nodes)
        return np.asarray(size[:, None] * along)


def terms_of(names: Iterable[str], states: int) -> dict[str, Term]:
    """The terms among the names of some unknowns, by name, see :meth:`Term.named`."""
    named = ((name, Term.named(name, states)) for name in names)
    return {name: term for name, term in named if term is not None}


def with_terms(
    states: list[ModelState], terms: Collection[Term], values: FloatArray, nodes: FloatArray,
    specimen: Specimen,
) -> list[ModelState]:  # fmt: skip
    """Add terms to a model's states; derivatives by terms follow the model's own.

    values : (j,) unknowns of the terms [mm].
    nodes : (n, 2) nodes of the mesh, at their places in the specimen [mm]: terms move with nodes
        that parameters move.
    """
    if not terms:
        return states
    fields = np.array([term.at(nodes, specimen) for term in terms])
    none, nothing, found = np.zeros(len(terms)), np.zeros_like(fields), list[Any]()
    for number, state in enumerate(states):
        own = np.array([term.state == number for term in terms], np.float64)
        by = own[:, None, None] * fields
        found.append(replace(
            state, displacement=state.displacement + np.tensordot(values, by, 1),
            displacement_by=np.concatenate([state.displacement_by, by]),
            nodes_by=np.concatenate([state.nodes_by, nothing]),
            force_by=np.append(state.force_by, none), strain_by=np.append(state.strain_by, none),
        ))  # fmt: skip
    return found
