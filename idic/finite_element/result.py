"""The displacement that finite-element DIC measured: on the mesh, at pixels, at any point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.fem.field import Mesh
from modeharvest.idic.finite_element.cutoff import Risk
from modeharvest.idic.solver.pyramid import Level
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.elements import shape_functions, shape_gradients
from modeharvest.imaging.mapping.isoparametric import Located, interpolate, locate, locate_points
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

_BEYOND_PX = 2.0
"""How far beyond the mesh's edge its fields are continued: the edge is known to half a pixel."""
_CHUNK = 500_000


@dataclass(frozen=True)
class Step:
    """One Gauss-Newton step."""

    level: Level
    cutoff_px: float
    number: int
    """Of the images, cut-off wavelength [px], number of the step in its stage."""
    residual: float
    """Rms before the step [grey levels of the level]."""
    step_px: float
    longest_px: float
    """Rms over the nodes, and the longest of a node [px]."""


@dataclass(frozen=True, eq=False)
class NodalResult:
    """A displacement measured at the nodes of a T6 mesh; the frame is the reference's, y up."""

    mesh: Mesh
    displacement: FloatArray
    start: FloatArray
    """Nodes and u there (n, 2) [mm], and where the measurement began."""
    standard_deviation: FloatArray
    """(n, 2) of u by noise and smoothing [mm]."""
    noise_deviation: FloatArray
    """(n, 2) of u by noise alone [mm]."""
    grid: PixelGrid
    """The pixels of the images."""
    cutoff_px: float
    tried: tuple[Risk, ...]
    """Cut-off wavelength of the regularisation [px], and those that were tried to find it."""
    residual_rms: float
    residual_noise: float
    pixels: int
    outside: int
    """Root mean square of the residual and what of it is noise [grey levels]; pixels compared, and
    pixels mapped to where the deformed image isn't valid."""
    effective_unknowns: float
    """What the images determine of them [-]."""
    blur_px: float
    """Blur of the reference whose gradient weighs the residual [px]."""
    library: str
    """That factorised the matrices."""
    history: tuple[Step, ...] = ()
    timings_s: Mapping[str, float] = field(default_factory=dict)
    """Every step; seconds by what they were spent on."""
    warnings: tuple[str, ...] = ()
    """Sentences."""

    @property
    def unknowns(self) -> int:
        """How many displacements are sought."""
        return self.displacement.size

    def on_pixels(self, nodal: FloatArray, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, c) values of nodal fields (n, c); NaN farther than 2 px from the mesh."""
        mesh, grid = self.mesh, grid or self.grid
        located = locate(mesh.nodes, mesh.cells, mesh.element, grid)
        values = interpolate(located, mesh.cells, mesh.element, np.ascontiguousarray(nodal))
        _continue(mesh, grid, located, nodal, values)
        return np.moveaxis(values, 0, -1)

    def at(self, points: FloatArray, nodal: FloatArray | None = None) -> FloatArray:
        """(k, c) values at points (k, 2) [mm], u [mm] by default; NaN beside the mesh."""
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2:
            raise InputError(f"expected points of shape (k, 2), got {points.shape}")
        mesh, nodal = self.mesh, self.displacement if nodal is None else nodal
        row, col = self.grid.to_px(points[:, 0], points[:, 1])
        found = locate_points(mesh.nodes, mesh.cells, mesh.element, self.grid, row[None], col[None])
        element, xi = found.element[0], found.xi[0]
        values = np.full((len(points), nodal.shape[1]), np.nan)
        there = element >= 0
        N = shape_functions(mesh.element, xi[there])
        values[there] = np.einsum("ka,kac->kc", N, nodal[mesh.cells[element[there]]])
        return values

    def displacement_on(self, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2) u at pixels [mm]."""
        return self.on_pixels(self.displacement, grid)

    def standard_deviation_on(self, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2) standard deviation of u at pixels [mm]."""
        smallest = 1e-12 * self.grid.pixel_size
        return np.exp(self.on_pixels(np.log(np.maximum(self.standard_deviation, smallest)), grid))

    @property
    def deformation_gradient(self) -> FloatArray:
        """(n, 2, 2) F = I + du/dX at the nodes, the mean of the elements around each [-]."""
        mesh = self.mesh
        local = shape_gradients(mesh.element, _NODES)
        x, u = mesh.nodes[mesh.cells], self.displacement[mesh.cells]
        inverse = np.linalg.inv(np.einsum("eki,qkj->eqij", x, local))
        gradient = np.einsum("eki,qkj,eqjl->eqil", u, local, inverse, optimize=True)
        total, count = np.zeros((len(mesh.nodes), 2, 2)), np.zeros(len(mesh.nodes))
        np.add.at(total, mesh.cells, gradient)
        np.add.at(count, mesh.cells, 1.0)
        return np.asarray(np.eye(2) + total / np.maximum(count, 1.0)[:, None, None])

    @property
    def green_lagrange(self) -> FloatArray:
        """(n, 2, 2) E = (F'F - I)/2 at the nodes [-]."""
        F = self.deformation_gradient
        return np.asarray(0.5 * (np.einsum("nki,nkj->nij", F, F) - np.eye(2)))

    @property
    def logarithmic_strain(self) -> FloatArray:
        """(n, 2, 2) Hencky's strain ln U at the nodes, U^2 = F'F [-]."""
        stretch, direction = np.linalg.eigh(np.eye(2) + 2.0 * self.green_lagrange)
        half_log = 0.5 * np.log(np.maximum(stretch, 1e-12))
        return np.asarray(np.einsum("nik,nk,njk->nij", direction, half_log, direction))


_NODES = np.array([[0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]], dtype=np.float64)


def _continue(
    mesh: Mesh, grid: PixelGrid, located: Located, nodal: FloatArray, values: FloatArray
) -> None:
    """Fill pixels up to 2 px beside the mesh, by the polynomials of the nearest element."""
    there = located.mask
    distance, nearest = ndimage.distance_transform_edt(~there, return_indices=True)
    rows, cols = np.nonzero((distance > 0.0) & (distance <= _BEYOND_PX))
    near = tuple(nearest[:, rows, cols])
    element, xi = located_at(mesh, grid, near, located.element, (rows, cols))
    for begin in range(0, rows.size, _CHUNK):
        part = np.s_[begin : begin + _CHUNK]
        N = shape_functions(mesh.element, xi[part])
        found = np.einsum("ka,kac->ck", N, nodal[mesh.cells[element[part]]])
        values[:, rows[part], cols[part]] = found


def located_at(
    mesh: Mesh,
    grid: PixelGrid,
    near: tuple[NDArray[Any], ...],
    elements: NDArray[Any],
    at: tuple[NDArray[Any], NDArray[Any]],
) -> tuple[NDArray[Any], FloatArray]:
    """Elements and local coordinates, outside their element, of pixels beside the mesh."""
    element = elements[near]
    target = np.stack(grid.to_mm(*at), axis=1)
    x = mesh.nodes[mesh.cells[element]]
    xi = np.full((element.size, 2), 1.0 / 3.0)
    for _ in range(8):
        off = np.einsum("ka,kai->ki", shape_functions(mesh.element, xi), x) - target
        F = np.einsum("kai,kaj->kij", x, shape_gradients(mesh.element, xi))
        xi -= np.linalg.solve(F, off[..., None])[..., 0]
        xi = np.clip(xi, -1.0, 2.0)
    return element, xi
