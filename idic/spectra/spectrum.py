"""Energy spectral densities of displacement fields, known at pixels or measured at points.

The paper reads the family of the mode off S_xx and S_yy by eye; ``pattern`` does so automatically.
Transform and wave vectors, with l the unit cell size::

    û(ξ) = ∫ u(x) exp(−2πi ξ·x/l) dA   [mm³]      S_xx = |û_x|², S_yy = |û_y|²   [mm⁶]

where u is the displacement without its affine part, and zero where there is no material. A wave of
wavelength λ peaks at |ξ| = l/λ: the square pattern at ξ = (±1/2, ±1/2).

The points of a subset DIC lie on a regular grid with gaps, at holes and where subsets failed. They
are treated like pixels, and gaps like holes. Scattered points are interpolated to such a grid.

Source: M. Grigoriu, Stochastic Calculus (2002), and the paper's Section "Parametrization and
Initial Guess of the Patterning Modes".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import find_objects
from scipy.spatial import cKDTree

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.local.field import LocalField
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import BoolArray, ComplexArray, FloatArray
from modeharvest.util.errors import InputError


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The Fourier transform of a displacement field without its affine part."""

    xi1: FloatArray
    xi2: FloatArray
    """(m,), (n,) wave-vector components [1/l], ascending."""
    u_hat: ComplexArray
    """(n, m, 2) transform [mm³] at (xi2, xi1), of u_x and u_y, for the phase origin x = 0."""
    pitch: float
    """Unit cell size l [mm]."""
    x: FloatArray
    y: FloatArray
    """(p,), (q,) centres of the bins, both ascending [mm]."""
    source: FloatArray
    """(q, p, 2) what was transformed: bin averages of the displacement [mm], 0 without material."""
    coverage: FloatArray
    """(q, p) share of each bin that is material [-]."""
    affine: FloatArray
    """(2, 3) affine part that was removed, u_i = affine[i] · (1, x, y): [mm], [-], [-]."""
    extent: tuple[float, float]
    """(2,) width and height of the material's bounding box [mm]."""

    @property
    def density(self) -> FloatArray:
        """(n, m, 2) energy spectral densities S_xx and S_yy [mm⁶]."""
        return _squared(self.u_hat)

    @property
    def cell(self) -> float:
        """Area of a bin [mm²]."""
        return float((self.x[1] - self.x[0]) * (self.y[1] - self.y[0]))

    def at(self, xi: ArrayLike) -> ComplexArray:
        """(2,) transform of u_x and u_y [mm³] at any wave vector (ξ1, ξ2) [1/l]."""
        return self.cell * self.sum_over(self.source, xi).conj()

    def sum_over(self, values: FloatArray, xi: ArrayLike) -> ComplexArray:
        """(..., n) sum over the bins of values (q, p, n) times exp(2πi ξ·x/l), for ξ (..., 2)."""
        of = np.asarray(xi, dtype=np.float64)
        x, y = 2 * np.pi / self.pitch * of.reshape(-1, 2).T[..., None]
        flat, shape = values.reshape(len(values), -1), values.shape[1:]
        # numpy would convert all values to complex ones.
        up = np.cos(y * self.y) @ flat + 1j * (np.sin(y * self.y) @ flat)
        found = np.einsum("kp,kpn->kn", np.exp(1j * x * self.x), up.reshape(-1, *shape))
        return np.asarray(found.reshape(*of.shape[:-1], -1))

    def window(self, xi_max: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(ξ1, ξ2, density) for both components of ξ within ± ``xi_max`` [1/l]."""
        cols, rows = np.abs(self.xi1) <= xi_max, np.abs(self.xi2) <= xi_max
        return self.xi1[cols], self.xi2[rows], _squared(self.u_hat[np.ix_(rows, cols)])


def spectral_density(
    displacement: FloatArray, grid: PixelGrid, mask: BoolArray, pitch: float, *,
    bins_per_cell: int = 24, padding: int = 4,
) -> Spectrum:  # fmt: skip
    """Transform a displacement field (rows, cols, 2) [mm], along x and y (up), given at pixels.

    InputError if shapes differ, the mask is all black, or the displacement is not finite in it.

    mask : (rows, cols) True where there is material; elsewhere the displacement doesn't matter.
    pitch : Unit cell size l [mm].
    bins_per_cell : Pixels are averaged in blocks of at most l / ``bins_per_cell``. At the pattern's
        wave vectors this lowers û by (π/2/24)²/6 = 0.07 % per direction.
    padding : The bounding box of the material is padded with zeros to this many times its size, for
        the resolution of ξ; no information is added.
    """
    _check(displacement, grid, mask, pitch)
    part = find_objects(mask.astype(np.uint8))[0]
    inside = mask[part]
    size = grid.pixel_size * inside.shape[1], grid.pixel_size * inside.shape[0]
    u = [np.where(inside, displacement[part][..., c], 0.0) for c in range(2)]
    x, y = grid.x[part[1]], grid.y[part[0]]
    if not all(np.isfinite(component).all() for component in u):
        raise InputError("expected finite displacements where the mask is set, got NaN")
    affine = np.stack([_affine(component, inside, x, y) for component in u])
    for component, (constant, along_x, along_y) in zip(u, affine, strict=True):
        plane = (constant + along_x * x)[None, :] + (along_y * y)[:, None]
        np.subtract(component, plane, out=component, where=inside)

    factor = max(1, int(pitch / (bins_per_cell * grid.pixel_size)))
    source = np.stack([_binned(component, factor)[::-1] for component in u], axis=-1)
    coverage = _binned(inside.astype(np.float64), factor)[::-1]  # rows now ascend in y
    h = factor * grid.pixel_size
    half = 0.5 * (factor - 1) * grid.pixel_size
    x = x[0] + half + h * np.arange(source.shape[1])
    y = y[0] - half - h * np.arange(source.shape[0])[::-1]
    xi1, xi2, u_hat = _transform(source, x, y, h, pitch, padding)
    return Spectrum(xi1, xi2, u_hat, pitch, x, y, source, coverage, affine, size)


def _transform(
    source: FloatArray, x: FloatArray, y: FloatArray, h: float, pitch: float, padding: int
) -> tuple[FloatArray, FloatArray, ComplexArray]:
    """FFT with zero padding, frequencies ascending, phases referred to the physical origin."""
    n, m = (fft.next_fast_len(padding * size) for size in source.shape[:2])
    xi2, xi1 = (fft.fftshift(fft.fftfreq(size, h)) * pitch for size in (n, m))
    u_hat = fft.fftshift(fft.fft2(source, (n, m), axes=(0, 1)), axes=(0, 1))
    u_hat *= np.exp(-2j * np.pi * xi1 * x[0] / pitch)[None, :, None] * h
    u_hat *= np.exp(-2j * np.pi * xi2 * y[0] / pitch)[:, None, None] * h
    return xi1, xi2, u_hat


def _affine(u: FloatArray, mask: BoolArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(3,) least-squares fit of 1, x, y to a component that is 0 outside the material."""
    per_col, per_row = mask.sum(axis=0), mask.sum(axis=1)
    xy = float(y @ (mask @ x))
    n, sx, sy = per_col.sum(), per_col @ x, per_row @ y
    normal = np.array([[n, sx, sy], [sx, per_col @ x**2, xy], [sy, xy, per_row @ y**2]])
    if np.linalg.matrix_rank(normal) < 3:
        raise InputError("expected material in more than one row and one column of the mask")
    col_sums, row_sums = u.sum(axis=0), u.sum(axis=1)
    fit: FloatArray = np.linalg.solve(normal, [col_sums.sum(), x @ col_sums, y @ row_sums])
    return fit


def _binned(u: FloatArray, factor: int) -> FloatArray:
    """Averages of (rows, cols) over blocks, incomplete blocks filled with zeros."""
    rows, cols = (-(-size // factor) for size in u.shape)
    padded = np.zeros((rows * factor, cols * factor))
    padded[: u.shape[0], : u.shape[1]] = u
    # Rows first: whole rows are added faster than pieces of them.
    summed = padded.reshape(rows, factor, -1).sum(axis=1).reshape(rows, cols, factor).sum(axis=2)
    return np.asarray(summed / factor**2)


def _squared(value: ComplexArray) -> FloatArray:
    return np.asarray(value.real**2 + value.imag**2)


def _check(displacement: FloatArray, grid: PixelGrid, mask: BoolArray, pitch: float) -> None:
    if displacement.shape != (*grid.shape, 2) or mask.shape != grid.shape:
        raise InputError(
            f"expected a displacement of shape {(*grid.shape, 2)} and a mask of {grid.shape}, "
            f"got {displacement.shape} and {mask.shape}"
        )
    if not mask.any():
        raise InputError("expected material in the mask, got an all-black mask")
    if not pitch > 2 * grid.pixel_size:
        raise InputError(f"expected a unit cell of more than 2 px, got {pitch} mm")


ON_GRID = 0.1
"""Distance [steps] from a regular grid's points up to which points count as lying on them; this
changes a wave of 10 steps by 6 % of its amplitude at most, at random."""
FEWEST_A_CELL = 6
"""Fewest points along a unit cell: fewer can't distinguish waves of its length from longer ones."""
MOST_POINTS = 4e7
"""Most points of the regular grid: with more, a stray point far away is the likelier reason."""


def measured_spectrum(field: LocalField, pitch: float, region: Box | None = None) -> Spectrum:
    """Transform a displacement field measured at points; points that aren't valid count as gaps.

    With a region only points in this box are used, for parts of a specimen with their own patterns,
    and the affine part over it; ``pitch`` is l [mm]. Raises InputError if no valid point is
    in the region, or the points are too sparse for the unit cell.
    """
    if region is not None:
        field = field.within(region)
    if not pitch > 0:
        raise InputError(f"expected a positive unit cell size, got {pitch} mm")
    if not pitch >= FEWEST_A_CELL * field.spacing:
        raise InputError(
            f"local field {field.source}: expected points at most {pitch / FEWEST_A_CELL:.3g} mm "
            f"apart, 1/{FEWEST_A_CELL} of the cell, got {field.spacing:.3g} mm; measure with a "
            "smaller step"
        )
    displacement, grid, mask = gridded(field)
    return spectral_density(displacement, grid, mask, pitch)


def gridded(field: LocalField) -> tuple[FloatArray, PixelGrid, BoolArray]:
    """Put a field on a regular grid of its own spacing.

    Returns (rows, cols, 2) displacements [mm], 0 in gaps; the grid, whose "pixels" are the points;
    and (rows, cols) True where there is a point. Raises InputError if the points spread over far
    more than they fill.
    """
    x, y, u = field.valid_points()
    step = field.spacing
    if not 0 < step < np.inf:
        raise InputError(f"local field {field.source}: expected points at different positions")
    steps = np.rint(np.ptp(np.stack([x, y]), axis=1) / step)
    if np.prod(steps + 1) > MOST_POINTS:
        raise InputError(
            f"local field {field.source}: expected points that fill their box, got {len(x)} points "
            f"{step:.3g} mm apart over {np.ptp(x):.3g} x {np.ptp(y):.3g} mm; remove stray points"
        )
    # The whole field's length gives the step more precisely than two neighbours do.
    step = float((np.ptp(x) + np.ptp(y)) / steps.sum())
    cols, rows = (int(n) + 1 for n in steps)
    grid = PixelGrid(rows, cols, step, float(x.min()), float(y.max()))
    points = np.column_stack(grid.to_px(x, y))
    nearest = np.rint(points).astype(int).clip(0, (rows - 1, cols - 1))
    if np.abs(points - nearest).max() > ON_GRID:
        return _interpolated(points, u, grid)
    row, col = nearest.T
    displacement, mask = np.zeros((rows, cols, 2)), np.zeros((rows, cols), dtype=np.bool_)
    displacement[row, col], mask[row, col] = u, True
    return displacement, grid, mask


def _interpolated(
    points: FloatArray, u: FloatArray, grid: PixelGrid
) -> tuple[FloatArray, PixelGrid, BoolArray]:
    """Interpolate linearly between scattered points (row, col); gap where none is within a step."""
    at = np.indices(grid.shape).reshape(2, -1).T
    value = LinearNDInterpolator(points, u, fill_value=0.0)(at).reshape(*grid.shape, 2)
    mask = (cKDTree(points).query(at)[0] <= 1.0).reshape(grid.shape)
    return np.asarray(value), grid, mask
