"""A homogenized body without its RVEs: loads, supports, mesh and Gauss points (no dolfinx)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from modeharvest.fem.experiment import require_edges
from modeharvest.fem.field import MESHIO_NAME, Mesh, plane_mesh, read_any_mesh
from modeharvest.fem.specimen import Specimen
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.elements import reference_element, shape_functions, shape_gradients
from modeharvest.util.errors import InputError

EDGES = ("left", "bottom", "right", "top")
"""Names of the edges: plates are left and right, sides are bottom and top."""
SIDES = ("free", "periodic", "guided", "clamped")
PATTERN = ("zero", "free")

# Gauss points on a triangle for degrees 2 and 4: a in the barycentric coordinates (a, a, 1 - 2 a).
_TRIANGLE_RULES = {
    2: [(1 / 6, 1 / 6)],
    3: [(0.445948490915965, 0.111690794839005), (0.091576213509771, 0.054975871827661)],
}


@dataclass(frozen=True)
class PlateMotion:
    """Two plates at the edges of smallest and largest x, moved in proportion to the load e.

    At x = +-a they have u_x = -+ e L (compression + bending y / b) / 2 and u_y = +- e L shear / 2
    - e lateral y, with b half the height. So e is the nominal strain for ``compression = 1``, the
    mean shear for ``shear = 1``, the nominal strain of the uppermost fibre for ``bending = 1``
    (small rotations), and the lateral nominal strain for ``lateral = 1`` (sides that aren't free).
    """

    compression: float = 1.0
    shear: float = 0.0
    bending: float = 0.0
    lateral: float = 0.0
    plates: str = "clamped"
    """With "sliding", u_y is free on the plates except at one node, which fixes the body."""
    sides: str = "free"
    """The edges of smallest and largest y: "free"; "periodic": equal v on both, and equal u up to
    the lateral strain; "guided": u_y is linear between the plates; "clamped": u_x is, too."""


@dataclass(frozen=True)
class PlateLoading(PlateMotion):
    """A load, the boundary conditions of the pattern, and whether only a quarter is modelled."""

    pattern_at_plates: str = "zero"
    pattern_at_bulk: str = "zero"
    """"zero" for v = 0, "free" for Lambda . n = 0: where the lattice meets a plate, solid next to a
    plate or a clamped side; and where it meets other solid bulk, such as along the sides."""
    quarter: bool = False
    """Whether only the quarter x, y >= 0 of a symmetric body is modelled: u symmetric, v even.
    Compression only. Instabilities of another symmetry, such as bowing, are not found."""

    def __post_init__(self) -> None:
        require_edges(self.plates)
        rates = self.compression, self.shear, self.bending, self.lateral
        if not np.isfinite(rates).all() or not any(rates):
            raise InputError(f"plates: expected finite rates, one of them not 0, got {rates}")
        if self.shear and self.plates != "clamped":
            raise InputError("plates: expected clamped ones to shear a specimen, got 'sliding'")
        if self.quarter and (self.shear or self.bending or self.sides != "free"):
            raise InputError("quarter: expected compression between free sides, got another load")
        if self.sides not in SIDES:
            raise InputError(f"sides: expected one of {SIDES}, got {self.sides!r}")
        if self.bending and self.sides == "periodic":
            raise InputError("sides: expected others in bending, got 'periodic'")
        if self.lateral and self.sides == "free":
            raise InputError("sides: expected others with lateral, got 'free'")
        for name in ("pattern_at_plates", "pattern_at_bulk"):
            if getattr(self, name) not in PATTERN:
                raise InputError(f"{name}: expected one of {PATTERN}, got {getattr(self, name)!r}")


class Quadrature(NamedTuple):
    """Gauss points of c elements with k nodes, p points in each."""

    weights: FloatArray
    """(c, p) weights, as areas [mm^2]."""
    shapes: FloatArray
    """(p, k) shape functions."""
    gradients: FloatArray
    """(c, p, k, 2) gradients of the shape functions [1/mm]."""
    places: FloatArray
    """(c, p, 2) positions of the points [mm]."""


def quadrature(mesh: Mesh, points: int) -> Quadrature:
    """Gauss points of all elements: ``points`` is 2 or 3 per direction (3 or 6 in a triangle).

    InputError for other numbers, and for elements whose Jacobian isn't positive.
    """
    if points not in (2, 3):
        raise InputError(f"quadrature: expected 2 or 3 points a direction, got {points}")
    weights: FloatArray
    if mesh.element[0] == "Q":
        at, weight = np.polynomial.legendre.leggauss(points)
        xi: FloatArray = np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1).reshape(-1, 2)
        weights = np.asarray(np.outer(weight, weight).ravel())
    else:
        rule = _TRIANGLE_RULES[points]
        xi = np.array([p for a, _ in rule for p in ((a, a), (a, 1 - 2 * a), (1 - 2 * a, a))])
        weights = np.repeat([w for _, w in rule], 3)
    shapes, slopes = shape_functions(mesh.element, xi), shape_gradients(mesh.element, xi)
    nodes = mesh.nodes[mesh.cells]
    J = np.einsum("pkb,cka->cpab", slopes, nodes)
    area = np.linalg.det(J)
    if not (area > 0).all():
        worst = int(np.argmin(area.min(axis=1)))
        what = "elements with positive Jacobians (nodes counter-clockwise, corners first)"
        got = f"{area.min():.3g} in element {worst}"
        raise InputError(f"macroscopic mesh: expected {what}, got {got}")
    gradients = np.einsum("pkb,cpba->cpka", slopes, np.linalg.inv(J))
    return Quadrature(weights * area, shapes, gradients, np.einsum("pk,cka->cpa", shapes, nodes))


def rectangle_mesh(x: Sequence[float], y: Sequence[float]) -> Mesh:
    """Mesh of Q8 elements between ascending positions along x and along y [mm]."""
    at = []
    for places in (x, y):
        ends = np.asarray(places, dtype=np.float64)
        if ends.ndim != 1 or len(ends) < 2 or not (np.diff(ends) > 0).all():
            raise InputError(f"macroscopic mesh: expected ascending places [mm], got {places}")
        at.append(np.sort(np.concatenate([ends, 0.5 * (ends[1:] + ends[:-1])])))
    columns, rows = len(at[0]), len(at[1])
    i, j = np.meshgrid(np.arange(0, columns - 1, 2), np.arange(0, rows - 1, 2), indexing="ij")
    local = reference_element("Q8").nodes.astype(int)
    numbers = [((i + a + 1) * rows + j + b + 1).ravel() for a, b in local]
    grid = np.stack(np.meshgrid(*at, indexing="ij"), axis=-1).reshape(-1, 2)
    used, cells = np.unique(np.stack(numbers, axis=1), return_inverse=True)
    return Mesh(grid[used], cells.reshape(-1, 8), "Q8")


def specimen_mesh(
    specimen: Specimen, divisions: tuple[int, int] | None = None, quarter: bool = False,
    edge_shifts: ArrayLike = (0.0, 0.0),
) -> tuple[Mesh, BoolArray]:  # fmt: skip
    """Q8 mesh of a specimen, and (m,) True for elements of the lattice; others are solid bulk.

    divisions : of the cellular part along x and y; by default one per two holes, at least two.
    quarter : mesh only the part x, y >= 0, with half the divisions (rounded up).
    edge_shifts : extension of the lattice at each of its ends along x and y [mm].
    """
    shifts, edges = np.asarray(edge_shifts), np.array([specimen.bulk_x, specimen.bulk_y])
    whole = specimen.half_size + shifts
    # Next to solid edges of staggered rows, the lattice has the area that the holes' cells fill.
    cells = specimen.row_counts.mean(), specimen.holes_y
    filled = 0.5 * np.array(cells) * (specimen.pitch, specimen.row_distance)
    half = np.where(edges > 0.0, filled, specimen.cellular_half_size) + shifts
    counts = divisions or [max(2, round(0.5 * n)) for n in (specimen.holes_x, specimen.holes_y)]
    if min(counts) < 1:
        raise InputError(f"macroscopic mesh: expected divisions of 1 or more, got {divisions}")
    places = []
    for inner, outer, count in zip(half, whole, counts, strict=True):
        low, parts = (0.0, (count + 1) // 2) if quarter else (-1.0, count)
        within = np.linspace(low * inner, inner, parts + 1)
        places.append(np.unique([low * outer, *within, outer]))
    mesh = rectangle_mesh(*places)
    middles = mesh.nodes[mesh.cells[:, :4]].mean(axis=1)
    return mesh, np.all(np.abs(middles) < half, axis=1)


class BodyMesh(NamedTuple):
    """A homogenized body's mesh from a file."""

    mesh: Mesh
    is_lattice: BoolArray
    """(m,) True for elements that aren't solid bulk."""
    edges: Mapping[str, IntArray]
    """Node numbers of the edges among ``EDGES`` that are named in the file."""


def read_body_mesh(path: Path | str) -> BodyMesh:
    """Read a macroscopic mesh [mm] of T3, T6, Q4, Q8 or Q9 from a file in any format of meshio.

    Sets of elements (physical groups of gmsh's format 4.1) named "bulk" are solid; sets named as in
    ``EDGES`` are plates and sides. InputError if it can't be read, or has separate pieces.
    """
    source = read_any_mesh(path)
    whole = plane_mesh(source, path)
    used, cells = np.unique(whole.cells, return_inverse=True)
    cells, n = cells.reshape(whole.cells.shape), len(used)
    pairs = np.repeat(cells[:, 0], cells.shape[1]), cells.ravel()
    pieces = connected_components(csr_array((np.ones(cells.size), pairs), (n, n)), False)[0]
    if pieces != 1:
        raise InputError(
            f"{path}: expected one piece of material, got {pieces}; merge nodes that coincide"
        )
    edges = dict[str, IntArray]()
    is_lattice: BoolArray = np.ones(len(cells), bool)
    for name, parts in source.cell_sets.items():
        chosen = [(b, np.asarray(k, int)) for b, k in zip(source.cells, parts, strict=True)]
        if name in EDGES:
            named = np.concatenate([block.data[k].ravel() for block, k in chosen])
            edges[name] = np.searchsorted(used, np.intersect1d(named, used))
        elif name == "bulk":
            solid = [np.isin(np.arange(len(block.data)), k) for block, k in chosen
                     if block.type == MESHIO_NAME[whole.element]]  # fmt: skip
            is_lattice = ~np.concatenate(solid)
    return BodyMesh(Mesh(whole.nodes[used], cells, whole.element), is_lattice, edges)
