"""Strains and stresses computed from a deformation gradient: one table of names and units.

Variances are propagated from F as D C D', with the covariance C of the four components of F and the
derivatives D of a field by central differences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import JetMatrix, Material, stress_and_tangent
from modeharvest.util.arrays import FloatArray
from modeharvest.util.elements import reference_element, shape_gradients
from modeharvest.util.errors import InputError
from modeharvest.util.typed import nearest

_STEP = 1e-6
"""Step of the components of F in central differences [-]."""


@dataclass(frozen=True)
class Field:
    """A field computed from F (k, 2, 2), and for stresses a material: (k,), (k, 2), (k, 2, 2)."""

    parts: str
    """Names of its components, in order; of a symmetric tensor each once."""
    of: Callable[[FloatArray, Material | None], FloatArray]
    unit: str = ""
    needs_material: bool = False

    def components(self, values: FloatArray) -> dict[str, FloatArray]:
        """Components (...) of values (..., 2, 2), (..., 2) or (...), by name."""
        names = self.parts.split() or [""]
        places: dict[str, Any] = {name: (..., *map("xy".index, name)) for name in names}
        return {name: values[place] for name, place in places.items()}


def determinant(F: FloatArray) -> FloatArray:
    """(k,) J = det F [-]; NaN, without a warning, where F is NaN."""
    return np.asarray(F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0])


def stretches(F: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(k,) larger and smaller principal stretch [-], direction of the larger one [rad].

    The direction is that in the reference, from x towards y, in (-pi/2, pi/2].
    """
    C = F.swapaxes(-1, -2) @ F
    half, difference = 0.5 * (C[..., 0, 0] + C[..., 1, 1]), 0.5 * (C[..., 0, 0] - C[..., 1, 1])
    larger = np.sqrt(half + np.hypot(difference, C[..., 0, 1]))
    # Not the root of half - hypot, a difference that cancels.
    smaller = np.abs(determinant(F)) / np.maximum(larger, 1e-12)
    return larger, smaller, 0.5 * np.arctan2(C[..., 0, 1], difference)


def _direction(F: FloatArray) -> FloatArray:
    angle = stretches(F)[2]
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _logarithmic(F: FloatArray) -> FloatArray:
    larger, smaller, angle = stretches(F)
    first, second = (np.log(np.maximum(stretch, 1e-12)) for stretch in (larger, smaller))
    cos, sin = np.cos(2.0 * angle), np.sin(2.0 * angle)
    turned = np.stack([np.stack([cos, sin], -1), np.stack([sin, -cos], -1)], -1)
    mean, deviator = 0.5 * (first + second), 0.5 * (first - second)
    return np.asarray(mean[..., None, None] * np.eye(2) + deviator[..., None, None] * turned)


def _of_material(
    of: Callable[[Material, FloatArray], FloatArray],
) -> Callable[[FloatArray, Material | None], FloatArray]:
    """Make a field of a material and F; NaN where F isn't a deformation: det F <= 0 or NaN."""

    def found(F: FloatArray, material: Material | None) -> FloatArray:
        assert material is not None
        there = determinant(F) > 0.0
        values = of(material, np.where(there[:, None, None], F, np.eye(2)))
        return np.where(there.reshape(-1, *(1,) * (values.ndim - 1)), values, np.nan)

    return found


def _first_piola(material: Material, F: FloatArray) -> FloatArray:
    return stress_and_tangent(material, F)[0]


def _cauchy(material: Material, F: FloatArray) -> FloatArray:
    J = determinant(F)[:, None, None]
    return np.asarray(np.einsum("kij,klj->kil", _first_piola(material, F), F) / J)


_ALL, _SYMMETRIC = "xx xy yx yy", "xx yy xy"
FIELDS: dict[str, Field] = {
    "F": Field(_ALL, lambda F, _: F),
    "green_lagrange": Field(_SYMMETRIC, lambda F, _: 0.5 * (F.swapaxes(-1, -2) @ F - np.eye(2))),
    "logarithmic": Field(_SYMMETRIC, lambda F, _: _logarithmic(F)),
    "J": Field("", lambda F, _: determinant(F)),
    "rotation": Field(
        "",
        lambda F, _: np.degrees(
            np.arctan2(F[..., 1, 0] - F[..., 0, 1], F[..., 0, 0] + F[..., 1, 1])
        ),
        "deg",
    ),
    "stretch_1": Field("", lambda F, _: stretches(F)[0]),
    "stretch_2": Field("", lambda F, _: stretches(F)[1]),
    "direction_1": Field("x y", lambda F, _: _direction(F)),
    "P": Field(_ALL, _of_material(_first_piola), "MPa", True),
    "cauchy": Field(_SYMMETRIC, _of_material(_cauchy), "MPa", True),
    "energy_density": Field(
        "", _of_material(lambda law, F: np.asarray(law.energy(JetMatrix(F, 0)).value)), "MPa", True
    ),
}
"""By name: F; J = det F; the angle of R in F = RU, counter-clockwise; the larger and smaller
principal stretch and the direction of the larger one in the reference; E = (F'F - I)/2; Hencky's ln
U, U^2 = F'F; in plane strain the first Piola-Kirchhoff stress P = dW/dF, Cauchy's PF'/J, and the
energy W per volume of the reference.
"""


def field_of(name: str, F: FloatArray, material: Material | None = None) -> FloatArray:
    """(k, ...) a field at F (k, 2, 2); InputError for an unknown one, or without a material."""
    if name not in FIELDS:
        raise InputError(f"expected a field, got {name!r}{nearest(name, [*FIELDS])}")
    if FIELDS[name].needs_material and material is None:
        raise InputError(f"expected a material for the field {name!r}, got none")
    return FIELDS[name].of(F, material)


def deviation_of(
    name: str, F: FloatArray, covariance: FloatArray, material: Material | None = None
) -> FloatArray:
    """(k, ...) standard deviation of a field at F, from the covariance (k, 4, 4) of xx xy yx yy."""
    slopes = []
    for step in _STEP * np.eye(4).reshape(4, 2, 2):
        ahead, behind = (field_of(name, F + s * step, material) for s in (1, -1))
        if name == "direction_1":  # either sign is the same direction
            ahead *= np.sign(np.sum(ahead * behind, axis=1, keepdims=True))
        slopes.append((ahead - behind) / (2.0 * _STEP))
    D = np.stack(slopes, axis=-1)
    carried = np.einsum("k...i,kij->k...j", D, covariance)
    return np.asarray(np.sqrt(np.maximum(np.einsum("k...j,k...j->k...", carried, D), 0.0)))


def nodal_gradient(mesh: Mesh, nodal: FloatArray) -> FloatArray:
    """(n, c, 2) gradient of nodal fields (n, c), the mean of the elements around each node."""
    return np.asarray((_nodal_slopes(mesh) @ nodal).reshape(len(nodal), 2, -1).swapaxes(1, 2))


def interpolation_error(mesh: Mesh, nodal: FloatArray) -> FloatArray:
    """(n, c) estimated error of quadratic elements in nodal fields (n, c), rms around each node.

    The gradients of neighbouring elements differ by that of the error, taken for a wave of length
    h/2, the spacing of nodes in elements of side h: its rms is h/(4 pi) times that of its gradient.
    """
    gradients, areas = element_gradients(mesh, nodal), _slopes(mesh)[1]
    off = gradients - nodal_gradient(mesh, nodal)[mesh.cells]
    square = (off**2).sum(axis=-1).mean(axis=1) * (4.0 / np.sqrt(3.0) * areas)[:, None]
    return np.asarray(np.sqrt(mean_around(mesh, square)) / (4.0 * np.pi))


def element_gradients(mesh: Mesh, nodal: FloatArray) -> FloatArray:
    """(m, k, c, 2) gradients of nodal fields (n, c) at the nodes of elements."""
    found = _slopes(mesh)[0] @ nodal[mesh.cells]
    return found.reshape(*mesh.cells.shape, 2, -1).swapaxes(2, 3)


@lru_cache(maxsize=2)
def _slopes(mesh: Mesh) -> tuple[FloatArray, FloatArray]:
    """(m, 2 k, k) slopes of the shape functions at the nodes, along x and y in turn, (m,) areas."""
    local = shape_gradients(mesh.element, reference_element(mesh.element).nodes)
    F = np.einsum("eki,qkj->eqij", mesh.nodes[mesh.cells], local)
    slopes = np.einsum("qkj,eqjl->eqlk", local, np.linalg.inv(F))
    return slopes.reshape(len(F), -1, len(local)), 0.5 * np.linalg.det(F).mean(axis=1)


@lru_cache(maxsize=2)
def _nodal_slopes(mesh: Mesh) -> csr_array:
    """(2 n, n) matrix from nodal values to their slopes, along x and y in turn, at each node."""
    slopes, n = _slopes(mesh)[0], len(mesh.nodes)
    row = (2 * mesh.cells[:, :, None] + np.arange(2)).reshape(*slopes.shape[:2], 1)
    share = 1.0 / np.bincount(mesh.cells.ravel(), minlength=n)[row // 2]
    where = [np.broadcast_to(k, slopes.shape).ravel() for k in (row, mesh.cells[:, None])]
    return csr_array(((share * slopes).ravel(), where), (2 * n, n))


def mean_around(mesh: Mesh, values: FloatArray) -> FloatArray:
    """(n, ...) means of element values (m, ...) over the elements around each node."""
    (m, k), n = mesh.cells.shape, len(mesh.nodes)
    where = mesh.cells.ravel(), np.repeat(np.arange(m), k)
    around = csr_array((np.ones(m * k), where), (n, m))
    found = (around @ values.reshape(m, -1)) / np.maximum(np.diff(around.indptr), 1)[:, None]
    return np.asarray(found.reshape(n, *values.shape[1:]))
