"""Exact Fourier coefficients of a periodic field on a lattice, by quadrature over its mesh.

With l the pitch, A the area of the cell (holes included) and u zero in the holes::

    û(ξ) = ∫_cell u(x) exp(−2πi ξ·x/l) dA   [mm³]      S_xx = |û_x|², S_yy = |û_y|²   [mm⁶]

A periodic field has energy at the reciprocal vectors of its cell only, ξ = l (n1 b1 + n2 b2) with
b_i·a_j = δ_ij; a lattice of many cells has none between them. Parseval's theorem reads
Σ (S_xx + S_yy) = A ∫ |u|² dA. For u without a unit (a mode), one "mm" less.

This is :mod:`modeharvest.idic.spectra.spectrum` for fields of which one period is known.

Every element is integrated by a product of Gauss rules. On triangles, one side of the square is
collapsed into a corner, with the Gauss-Jacobi rule whose weight is the Jacobian of that map
(A. H. Stroud, Approximate Calculation of Multiple Integrals, 1971).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.special import roots_jacobi

from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.options import lattice_vectors
from modeharvest.util.arrays import ComplexArray, FloatArray
from modeharvest.util.elements import reference_element, shape_functions, shape_gradients
from modeharvest.util.errors import InputError


class MeshQuadrature:
    """Points and weights over the material of any isoparametric mesh [mm].

    A wave whose phase turns by p rad across the largest element is integrated to 1e-10 by 4 + p
    points per direction and element, see :func:`points_for`. Raises InputError if an element is
    inverted.

    positions : (q, 2) points in the material [mm].
    weights : (q,) area that each represents [mm^2], positive.
    area : area of the material [mm^2].
    """

    def __init__(self, mesh: Mesh, points: int = 8) -> None:
        self.mesh = mesh
        local, weights = gauss_rule(reference_element(mesh.element).triangular, points)
        self._shapes = shape_functions(mesh.element, local)
        gradients = shape_gradients(mesh.element, local)
        J = np.einsum("pki,mkj->mpij", gradients, mesh.nodes[mesh.cells], optimize=True)
        jacobian = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
        if not jacobian.size or jacobian.min() <= 0:
            raise InputError(
                "quadrature: expected elements that are not inside out, got "
                f"{int(np.sum(np.any(jacobian <= 0, axis=1)))} bad ones of {len(mesh.cells)}; "
                "number the corners of each counter-clockwise"
            )
        self.positions = self.values(mesh.nodes)
        self.weights = np.asarray((jacobian * weights).ravel())
        self.area = float(self.weights.sum())

    def values(self, nodal: ArrayLike) -> FloatArray:
        """(q, c) values, at the quadrature points, of a field (n, c) given at the mesh's nodes."""
        field = np.asarray(nodal, dtype=np.float64)
        at_points = np.einsum("pk,mkc->mpc", self._shapes, field[self.mesh.cells], optimize=True)
        return np.ascontiguousarray(at_points.reshape(-1, field.shape[1]))

    def without_mean(self, values: FloatArray) -> FloatArray:
        """Values (q, c) less their mean over the material, which removes rigid translations."""
        return np.asarray(values - self.weights @ values / self.area)

    def product(self, first: FloatArray, second: FloatArray) -> float:
        """Integral of first . second over the material, both (q, c)."""
        return float(np.einsum("q,qc,qc", self.weights, first, second, optimize=True))


def points_for(mesh: Mesh, wave_number: float) -> int:
    """Quadrature points per direction for waves up to a wave number [rad/mm], to about 1e-10."""
    corners = mesh.nodes[mesh.cells[:, : 3 if mesh.element.startswith("T") else 4]]
    size = float(np.ptp(corners, axis=1).max())
    return 4 + int(np.ceil(wave_number * size))


def gauss_rule(triangular: bool, points: int) -> tuple[FloatArray, FloatArray]:
    """Local points (p, 2) and weights (p,) on the reference triangle or square.

    The triangle is xi, eta >= 0, xi + eta <= 1, the square goes from -1 to 1. ``points`` is the
    number per direction: p is its square, and polynomials up to the degree 2 ``points`` - 1 (on the
    square in each coordinate) are integrated exactly.
    """
    s, ws = np.polynomial.legendre.leggauss(points)
    if not triangular:
        first, second = np.meshgrid(s, s, indexing="ij")
        local, weights = np.stack([first.ravel(), second.ravel()], axis=1), np.outer(ws, ws)
        return local, np.asarray(weights.ravel(), dtype=np.float64)
    t, wt = roots_jacobi(points, 1.0, 0.0)
    across, up = np.meshgrid(0.5 * (1.0 + s), 0.5 * (1.0 + t), indexing="ij")
    local = np.stack([(across * (1.0 - up)).ravel(), up.ravel()], axis=1)
    return local, np.asarray(np.outer(ws / 2.0, wt / 4.0).ravel(), dtype=np.float64)


PERIODIC = 1e-4
"""Largest difference of a field between partner nodes, over its largest value: far above rounding
in single precision, far below the effect of an affine part."""
PARTNERS = 1e-4
"""Distance, in lattice vectors, up to which nodes are partners; elements are far larger."""
LEAST_SHARE = 1e-6
"""Least share of the energy of a wave that is listed as a peak: below it, symmetry forbids the wave
and the number is an error of the mesh."""


@dataclass(frozen=True)
class LatticePeak:
    """A wave vector of a periodic field and its mirror image −ξ."""

    xi: tuple[float, float]
    """(ξ1, ξ2) Cartesian [1/l]: of ξ and −ξ the one with ξ2 > 0, or ξ1 > 0 on the axis."""
    density: float
    """S_xx + S_yy [mm⁶]."""
    share: float
    """Share of the energy ∫ |u|² dA in ξ and −ξ together [-]."""


@dataclass(frozen=True, eq=False)
class LatticeSpectrum:
    """The Fourier coefficients of a periodic field up to some wave number."""

    xi: FloatArray
    """(n, 2) reciprocal vectors of the cell, Cartesian [1/l], by length; ξ and −ξ both."""
    coefficients: ComplexArray
    """(n, 2) û of u_x and u_y [mm³]; the phase origin is x = 0."""
    pitch: float
    """l [mm]."""
    lattice: FloatArray
    """(2, 2) vectors of the cell as rows [mm]."""
    energy: float
    """∫ |u|² dA over the material of the cell, without the translation [mm⁴]."""
    material: float
    """Area of the material of the cell [mm²]."""
    translation: tuple[float, float]
    """(2,) mean of the field over the material, which was subtracted [mm]."""

    @property
    def density(self) -> FloatArray:
        """(n, 2) energy spectral densities S_xx and S_yy [mm⁶]."""
        return np.asarray(self.coefficients.real**2 + self.coefficients.imag**2)

    @property
    def shares(self) -> FloatArray:
        """(n,) share of the energy at each wave vector [-]; over all of them, the sum is 1."""
        area = abs(float(np.linalg.det(self.lattice)))
        return np.asarray(self.density.sum(axis=1) / (area * self.energy))

    @property
    def peaks(self) -> tuple[LatticePeak, ...]:
        """Wave vectors that carry energy, one of each pair ±ξ, by density, the largest first."""
        density, shares = self.density.sum(axis=1), self.shares
        listed = np.flatnonzero(upward(self.xi) & (2.0 * shares >= LEAST_SHARE))
        order = listed[np.argsort(-density[listed], kind="stable")]
        return tuple(
            LatticePeak(_pair(self.xi[k]), float(density[k]), 2.0 * float(shares[k])) for k in order
        )


def lattice_spectrum(
    mesh: Mesh, lattice: ArrayLike, values: ArrayLike, pitch: float, reach: float = 3.0
) -> LatticeSpectrum:
    """Fourier coefficients of a periodic field, exact for its shape functions to about 1e-8.

    InputError if the field has another shape than the nodes, is not finite, not periodic, or
    nothing but a translation; if the mesh is larger than the cell; if pitch or reach aren't
    positive.

    mesh : One cell of the lattice, of any shape that tiles the plane [mm].
    lattice : (2, 2) lattice vectors as rows [mm]; they need not be at right angles.
    values : (n, 2) field at the nodes, periodic: the affine part is already removed [mm].
    pitch : l [mm], which makes the wave vectors dimensionless.
    reach : Largest |ξ| [1/l].
    """
    u, vectors = _checked_field(mesh, lattice, values, pitch)
    if not 0 < reach < np.inf:
        raise InputError(f"lattice spectrum: expected a positive reach in 1/l, got {reach}")
    rule = MeshQuadrature(mesh, points_for(mesh, 2.0 * np.pi * reach / pitch))
    at_points = rule.values(u)
    field = rule.without_mean(at_points)
    energy = rule.product(field, field)
    _check_energy(energy, rule.product(at_points, at_points), rule, vectors)
    translation = np.asarray(rule.weights @ at_points / rule.area, dtype=np.float64)
    xi = reciprocal_vectors(vectors, pitch, reach)
    half = np.flatnonzero(upward(xi) | (np.abs(xi).max(axis=1) == 0))
    weighted, positions = rule.weights[:, None] * field, -2j * np.pi / pitch * rule.positions
    # One wave vector after the other: little memory.
    coefficients = np.array([np.exp(positions @ vector) @ weighted for vector in xi[half]])
    # u is real: û(−ξ) is the conjugate of û(ξ).
    both = np.concatenate([xi[half], -xi[half[1:]]]) + 0.0
    u_hat = np.concatenate([coefficients, coefficients[1:].conj()])
    order = np.lexsort([np.arctan2(both[:, 1], both[:, 0]), np.linalg.norm(both, axis=1).round(9)])
    return LatticeSpectrum(
        both[order], u_hat[order], pitch, vectors, energy, rule.area, _pair(translation)
    )


def reciprocal_vectors(lattice: FloatArray, pitch: float, reach: float) -> FloatArray:
    """(n, 2) all ξ = l (n1 b1 + n2 b2) with |ξ| <= ``reach``, by length; ξ = 0 is the first."""
    reciprocal = pitch * np.linalg.inv(lattice).T
    # n_i = ξ·a_i/l, so |n_i| can't be larger than |ξ| |a_i|/l.
    most = np.floor(np.linalg.norm(lattice, axis=1) * reach / pitch + 1e-9).astype(int)
    numbers = np.mgrid[-most[0] : most[0] + 1, -most[1] : most[1] + 1].reshape(2, -1).T
    xi = np.round(numbers @ reciprocal, 12) + 0.0  # 1/2 and not 0.49999999999999994
    lengths = np.linalg.norm(xi, axis=1)
    order = np.argsort(lengths, kind="stable")
    return np.asarray(xi[order][lengths[order] <= reach * (1.0 + 1e-9)])


def upward(xi: FloatArray) -> NDArray[np.bool_]:
    """(n,) True for one of each ±ξ: the one with ξ2 > 0, or ξ1 > 0 on the axis; False for 0."""
    on_axis = np.abs(xi[:, 1]) < 1e-9
    return np.asarray(np.where(on_axis, xi[:, 0] > 1e-9, xi[:, 1] > 0))


def _checked_field(
    mesh: Mesh, lattice: ArrayLike, values: ArrayLike, pitch: float
) -> tuple[FloatArray, FloatArray]:
    """Return field (n, 2) and lattice (2, 2) as arrays, or raise InputError."""
    u, vectors = np.asarray(values, dtype=np.float64), lattice_vectors(lattice, "periodic field")
    if u.shape != mesh.nodes.shape:
        raise InputError(f"periodic field: expected shape {mesh.nodes.shape}, got {u.shape}")
    if not np.isfinite(u).all():
        raise InputError("periodic field: expected finite values at all nodes, got NaN")
    if not 0 < pitch < np.inf:
        raise InputError(f"pitch: expected a positive length in mm, got {pitch}")
    _check_periodic(mesh, vectors, u)
    return u, vectors


def _check_periodic(mesh: Mesh, lattice: FloatArray, u: FloatArray) -> None:
    """Raise InputError where the field differs at partner nodes, or if there are no partners."""
    fractional = np.mod(np.mod(mesh.nodes @ np.linalg.inv(lattice), 1.0), 1.0)
    pairs = cKDTree(fractional, boxsize=1.0).query_pairs(PARTNERS, output_type="ndarray")
    distance = np.linalg.norm(np.diff(mesh.nodes[pairs], axis=1)[:, 0], axis=1)
    if not np.any(distance > 0.5 * np.linalg.norm(lattice, axis=1).min()):
        raise InputError(
            f"lattice: expected nodes a lattice vector apart, got none for {lattice.tolist()} mm; "
            "give the vectors of the very cell that is meshed"
        )
    jump = np.abs(u[pairs[:, 0]] - u[pairs[:, 1]]).max(axis=1)
    if jump.max() > PERIODIC * np.abs(u).max():
        a, b = pairs[int(np.argmax(jump))]
        raise InputError(
            f"periodic field: expected the same value at nodes {a} and {b}, a lattice vector "
            f"apart, got {u[a].tolist()} and {u[b].tolist()}; remove the affine part"
        )


def _check_energy(energy: float, whole: float, rule: MeshQuadrature, lattice: FloatArray) -> None:
    """Raise InputError for a field that only translates, or a mesh that is larger than a cell."""
    cell = abs(float(np.linalg.det(lattice)))
    if rule.area > cell * (1.0 + 1e-6):
        raise InputError(
            f"lattice: expected a cell of at least the material's {rule.area:.6g} mm², got "
            f"{cell:.6g} mm²; give the lattice vectors of the enlarged cell"
        )
    if not energy > 1e-24 * whole:  # that is rounding
        raise InputError("periodic field: expected more than a translation, got energy 0")


def _pair(vector: FloatArray) -> tuple[float, float]:
    return float(vector[0]), float(vector[1])
