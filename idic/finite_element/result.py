"""The displacement measured by finite-element DIC: on the mesh, at pixels, at any point."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import Material
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import ASTRAY, correlate, fit_displacement, refitted_result
from modeharvest.idic.finite_element.cutoff import Risk
from modeharvest.idic.finite_element.fields import deviation_of, field_of, nodal_gradient
from modeharvest.idic.finite_element.light import Light
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.assembly import Assembly
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import Located, interpolate, locate, locate_points
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.elements import shape_functions, shape_gradients
from modeharvest.util.errors import InputError
from modeharvest.util.masks import grown
from modeharvest.util.progress import Progress, silent

_BEYOND_PX = 2.0
"""Extrapolation of fields beyond the mesh's edge: the edge is known to half a pixel."""
_STEP = 1e-5
"""Step of a mode's parameters for derivatives; the mode's waves are a few dozen radians long."""
WHOLE = "the whole displacement"
Where = PixelGrid | FloatArray | None
"""Where to evaluate a field: pixels, points (k, 2) [mm], or None for the nodes."""


@dataclass(frozen=True, eq=False)
class NodalResult:
    """A displacement measured at the nodes of a T6 mesh; the frame is the reference's, y up."""

    mesh: Mesh
    displacement: FloatArray
    start: FloatArray
    """Mesh, displacement u (n, 2) of its nodes [mm], and initial guess of u (n, 2) [mm]."""
    standard_deviation: FloatArray
    """(n, 2) standard deviation of u due to noise and smoothing [mm]."""
    noise_deviation: FloatArray
    """(n, 2) standard deviation of u due to noise alone [mm]."""
    gradient_covariance: FloatArray
    """(n, 4, 4) covariance of xx, xy, yx, yy of F due to noise and smoothing [-]."""
    grid: PixelGrid
    """Pixel grid of the images."""
    cutoff_px: float | None
    tried: tuple[Risk, ...]
    """Cut-off wavelength of the regularisation [px], if any, and those that were tried for it."""
    residual_rms: float
    residual_noise: float
    pixels: int
    outside: int
    """Root mean square of the residual, and of the noise in it [grey levels]; number of pixels
    compared, and of pixels mapped to where the deformed image isn't valid."""
    effective_unknowns: float
    """Effective number of unknowns that the images determine [-]."""
    library: str
    """Name of the library that factorised the matrices."""
    warnings: tuple[str, ...] = ()
    """Warnings, one sentence each."""
    contradicted: float | None = None
    """Share of nodes on free edges where a law changes u significantly [-]; None without a law."""
    not_compared: int = 0
    """Number of pixels of the material that don't count: without speckle in an image, with a
    surface that has changed, or out of the picture."""
    noise_power: float = 1.0
    """Power of the images' noise at long waves, over its variance [-]: 1 for white noise."""
    light: Light = None
    """Variation of gain and offset by which the images were made equally bright."""
    shown: str = "speckle"  # or "contours", for which residuals are distances [px]
    roots: FloatArray | None = None
    """(n, 2, k) vectors whose outer products sum up to the covariance of all nodal displacements
    [mm]; for a result that was read, only if requested."""

    @property
    def unknowns(self) -> int:
        """Number of unknown displacement components."""
        return self.displacement.size

    def on_pixels(self, nodal: FloatArray, grid: PixelGrid | None = None) -> FloatArray:
        """Nodal fields (n, ...) at pixels (rows, cols, ...); NaN over 2 px away from the mesh."""
        mesh, grid = self.mesh, grid or self.grid
        located = locate(mesh.nodes, mesh.cells, mesh.element, grid)
        flat = np.ascontiguousarray(nodal.reshape(len(nodal), -1))
        values = interpolate(located, mesh.cells, mesh.element, flat)
        if grid not in self._beside:
            self._beside[grid] = _beside(mesh, grid, located)
        _continue(self._beside[grid], flat, values)
        return np.moveaxis(values, 0, -1).reshape(*grid.shape, *nodal.shape[1:])

    @cached_property
    def _beside(self) -> dict[PixelGrid, tuple[NDArray[Any], ...]]:
        """Cache of the pixels beside the mesh, by grid."""
        return {}

    def at(self, points: FloatArray, nodal: FloatArray | None = None) -> FloatArray:
        """Nodal fields (n, ...), by default u [mm], at points (k, 2) [mm]; NaN outside the mesh."""
        return nodal_values(self.mesh, self.displacement if nodal is None else nodal, points)

    def displacement_on(self, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2) u at pixels [mm]."""
        return self.on_pixels(self.displacement, grid)

    def coverage(self, known: BoolArray, mask: BoolArray) -> float:
        """Share of a mask's material (rows, cols) that is measured; ``known``: where u is [-]."""
        return max(0, int((mask & known).sum()) - self.not_compared) / max(1, int(mask.sum()))

    def standard_deviation_on(self, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2) standard deviation of u at pixels [mm]."""
        return self.deviation_at(self.standard_deviation, grid or self.grid)

    def at_points(self, spacing: float) -> LocalField:
        """u and its standard deviation as local DIC data, at points about this far apart [mm]."""
        every = max(1, int(spacing / self.grid.pixel_size))
        x, y = np.meshgrid(self.grid.x[every // 2 :: every], self.grid.y[every // 2 :: every])
        points = np.column_stack([x.ravel(), y.ravel()])
        u = self.at(points)
        sd, there = self.deviation_at(self.standard_deviation, points), np.isfinite(u[:, 0])
        x, y = points[there].T
        return LocalField(x, y, u[there], sd=sd[there], source=WHOLE)

    def field(self, name: str, where: Where = None, material: Material | None = None) -> FloatArray:
        """One of ``fields.FIELDS``: strains, and with a material stresses.

        Returns (n, ...) at the nodes, (rows, cols, ...) at the pixels of a grid, (k, ...) at points
        (k, 2) [mm]; NaN outside the mesh.
        """
        F = self.values_at(self.deformation_gradient, where)
        found = field_of(name, F.reshape(-1, 2, 2), material)
        return found.reshape(*F.shape[:-2], *found.shape[1:])

    def field_deviation(
        self, name: str, where: Where = None, material: Material | None = None
    ) -> FloatArray:
        """Standard deviation of :meth:`field` due to noise and smoothing of u; the same shapes."""
        key, known = (name, material), self._deviations
        if key not in known:
            F, covariance = self.deformation_gradient, self.gradient_covariance
            known[key] = deviation_of(name, F, covariance, material)
        return self.deviation_at(known[key], where)

    @cached_property
    def _deviations(self) -> dict[tuple[str, Material | None], FloatArray]:
        """Cache of deviations at the nodes."""
        return {}

    def microfluctuation(self, result: Result, where: Where = None) -> FloatArray:
        """w = u - v0 - sum v_i phi_i [mm] of a correlation's ansatz; shapes as in :meth:`field`."""
        w = self.displacement - result.ansatz.displacement_at(result.unknowns, self.mesh.nodes)
        return self.values_at(w, where)

    def values_at(self, nodal: FloatArray, where: Where) -> FloatArray:
        """Values of nodal fields (n, ...) at the nodes, at pixels or at points."""
        if isinstance(where, PixelGrid):
            return self.on_pixels(nodal, where)
        return nodal if where is None else self.at(where, nodal)

    def deviation_at(self, nodal: FloatArray, where: Where) -> FloatArray:
        """The same for standard deviations, interpolated such that they stay positive."""
        smallest = 1e-12 * max(self.grid.pixel_size, 1e-3)
        return np.exp(self.values_at(np.log(np.maximum(nodal, smallest)), where))

    @cached_property
    def deformation_gradient(self) -> FloatArray:
        """(n, 2, 2) F = I + du/dX at the nodes, the mean of the elements around each [-]."""
        return np.eye(2) + nodal_gradient(self.mesh, self.displacement)


@dataclass(frozen=True, eq=False)
class WholeField:
    """A whole displacement, and the ansatz of a correlation refitted to it."""

    measured: NodalResult
    refit: Result
    start: str = ""
    """What the measurement started from, in words."""


def refitted(measured: NodalResult, ansatz: Ansatz, guess: FloatArray, mask: BoolArray) -> Result:
    """Fit an ansatz to the measured displacement on a mask's pixels; ``guess``: (n,) unknowns.

    Its covariance is propagated from that of the measured displacement by noise, smoothing and
    edges, unless the latter was read from a file.
    """
    u, roots, mesh = measured.displacement_on(), measured.roots, measured.mesh
    inside = mask & np.isfinite(u[..., 0])
    fit = fit_displacement(u, measured.grid, ansatz, guess, inside)
    if roots is None:
        return fit
    # Three points of an element, the middles of its sides, integrate quadratics exactly.
    x, middle = mesh.nodes[mesh.cells], mesh.cells[:, 3:]
    area = np.linalg.det(x[:, 1:3] - x[:, :1]) / 6.0 / measured.grid.pixel_size**2
    weight = np.bincount(middle.ravel(), np.repeat(area, 3), len(mesh.nodes))
    at, inverse = np.flatnonzero(weight), fit.inverse.copy()
    J = fit.ansatz.sensitivities(fit.unknowns, *mesh.nodes[at].T[:, :, None])[:, 0]
    slopes = np.einsum("kcn,k,kcs->ns", J, weight[at], roots[at], optimize=True)
    known = np.flatnonzero(np.isfinite(np.diag(inverse)))
    own = np.ix_(known, known)
    moved = np.linalg.solve(_hessian(fit, u, inside)[own], slopes[known])
    inverse[own] = moved @ moved.T / max(2.0 * fit.noise_sd**2, 1e-300)  # Result multiplies by it
    return replace(fit, inverse=inverse)


def _hessian(fit: Result, u: FloatArray, inside: BoolArray) -> FloatArray:
    """(n, n) Hessian of a fit's cost: with a residual w it isn't the Gauss-Newton matrix."""
    fits, a = Assembly(fit.ansatz, fit.grid, inside), fit.unknowns
    here = fits.displacement(a, u)
    H = here.matrix
    for k in range(fit.ansatz.phi_offset(0), a.size):  # u is linear in the other unknowns
        there = fits.displacement(a + _STEP * np.eye(a.size)[k], u, with_matrix=False)
        H[k] = H[:, k] = (there.gradient - here.gradient) / _STEP
    return H


def refitted_correlation(
    measured: NodalResult, pair: ImagePair, ansatz: Ansatz, guess: FloatArray, mask: BoolArray,
    options: CorrelationOptions, progress: Progress = silent,
) -> tuple[Result, Result]:  # fmt: skip
    """Correlate from a fit of the ansatz to what was measured (:func:`refitted`); result and fit.

    If the correlation fails (``correlate.ASTRAY``), the result is the fit, outcome REFITTED.
    """
    refit = refitted(measured, ansatz, guess, mask)
    a = np.append(refit.unknowns, guess[refit.unknowns.size :])
    found = correlate(pair, ansatz, guess=a, options=options, progress=progress)
    if found.outcome in ASTRAY:
        found = refitted_result(pair, ansatz, a, options)
    return found, refit


def _beside(mesh: Mesh, grid: PixelGrid, located: Located) -> tuple[NDArray[Any], ...]:
    """Rows, columns (k,) of pixels up to 2 px outside the mesh; nodes and N of nearest elements."""
    rows, cols = np.nonzero(grown(mask := located.mask, _BEYOND_PX) & ~mask)
    edge = np.argwhere(mask & grown(~mask, 1.0))
    element = located.element[*edge[KDTree(edge).query(np.column_stack([rows, cols]))[1]].T]
    xi = _local_coordinates(mesh, element, np.stack(grid.to_mm(rows, cols), axis=1))
    return rows, cols, mesh.cells[element], shape_functions(mesh.element, xi)


def _continue(beside: tuple[NDArray[Any], ...], nodal: FloatArray, values: FloatArray) -> None:
    """Fill pixels outside the mesh by the polynomials of the nearest element."""
    rows, cols, nodes, N = beside
    own = nodal[nodes]
    # Limited, because a polynomial through values that vary strongly in an element runs away.
    found, reach = np.einsum("ka,kac->kc", N, own), 0.5 * np.ptp(own, axis=1)
    values[:, rows, cols] = np.clip(found, own.min(axis=1) - reach, own.max(axis=1) + reach).T


def located(mesh: Mesh, points: FloatArray, beside: bool = False) -> tuple[IntArray, FloatArray]:
    """(k,) elements, -1 or with ``beside`` the nearest off the mesh; (k, 2) local coordinates."""
    if points.ndim != 2 or points.shape[1] != 2:
        raise InputError(f"expected points of shape (k, 2), got {points.shape}")
    x = mesh.nodes[mesh.cells]
    size = np.sqrt(np.prod(np.ptp(mesh.nodes, axis=0)) / len(x))  # about that of an element
    row, col = (grid := PixelGrid.centred(1, 1, size / 16.0)).to_px(*points[None].T)
    found = locate_points(mesh.nodes, mesh.cells, mesh.element, grid, row, col)
    element, xi = found.element[:, 0].astype(np.int64), found.xi[:, 0]
    if (off := np.flatnonzero(element < 0)).size and beside:
        element[off] = KDTree(x.mean(axis=1)).query(points[off])[1]
        xi[off] = _local_coordinates(mesh, element[off], points[off])
    return element, xi


def nodal_values(mesh: Mesh, nodal: FloatArray, at: FloatArray, beside: bool = False) -> FloatArray:
    """Nodal fields (n, ...) at points (k, 2) [mm]; off the mesh NaN, or if ``beside`` continued."""
    element, xi = located(mesh, at, beside)
    N = shape_functions(mesh.element, xi)
    return np.asarray(np.einsum("ka,ka...->k...", N, nodal[mesh.cells[element]]))


def _local_coordinates(mesh: Mesh, element: NDArray[Any], points: FloatArray) -> FloatArray:
    """(k, 2) local coordinates of points (k, 2) [mm] in elements (k,) that they are outside of."""
    xi: FloatArray = np.full((element.size, 2), 1.0 / 3.0)
    left = np.arange(element.size)  # most converge in two steps, a few at curved sides don't
    for _ in range(8):
        x, at = mesh.nodes[mesh.cells[element[left]]], xi[left]
        off = np.einsum("ka,kai->ki", shape_functions(mesh.element, at), x) - points[left]
        F = np.einsum("kai,kaj->kij", x, shape_gradients(mesh.element, at))
        step = np.linalg.solve(F, off[..., None])[..., 0]
        xi[left] = np.clip(at - step, -1.0, 2.0)
        left = left[np.abs(step).max(axis=1) >= 1e-7]  # Newton's next step is of its square
    return xi
