"""Images of a deforming specimen, and their exact displacement fields.

The reference image shows the speckle itself. A pixel x of a deformed image shows the speckle at its
reference point X, with X + u(X) = x solved by the inverse isoparametric mapping, so neither image
is interpolated from the other. Through a lens a pixel p shows the ideal point phi_S^-1(p), which is
found exactly; then the material there and its reference point are found. No image is resampled.

Averages over pixels are computed band by band: each thread processes a band of rows at a time,
whose mapping fits into its cache. For the whole image only grey levels are kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modeharvest.fem.field import Mesh
from modeharvest.imaging.distortion.lens import Positions
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.bernstein import bezier_matrix, require_positive_jacobian
from modeharvest.imaging.mapping.element_table import ElementTable, Pixels, bands, tabulate_elements
from modeharvest.imaging.mapping.isoparametric import Located, interpolate, locate, locate_points
from modeharvest.imaging.mapping.rasterise import fill
from modeharvest.imaging.pair import Truth
from modeharvest.imaging.speckle.pattern import Speckle
from modeharvest.imaging.speckle.periodic_spline import BLOCK, SplineTable, sample, workspace
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage, IntArray
from modeharvest.util.compiled import compiled, in_parallel
from modeharvest.util.elements import monomial_gradients, polynomials, reference_element

_BAND = 16  # rows that a thread averages at a time


@dataclass(frozen=True, eq=False)
class ImagedState:
    """A state of the specimen to be imaged."""

    mesh: Mesh
    """The undeformed mesh."""
    displacement: FloatArray | None
    """(n, 2) nodal displacement [mm]; None for the undeformed state."""
    grid: PixelGrid
    """The pixel grid, of the image and of the speckle."""
    speckle: Speckle
    background: float
    """Pattern on the material, and intensity around it [fraction of full scale]."""
    where: str = "mesh"
    """Name of the state in error messages."""

    @property
    def nodes(self) -> FloatArray:
        """(n, 2) node positions in this state [mm]."""
        return self.mesh.nodes if self.displacement is None else self.mesh.nodes + self.displacement

    @property
    def compression(self) -> float:
        """Largest factor by which lengths shrink at an element centre: 1 / least stretch [-]."""
        if self.displacement is None:
            return 1.0
        mesh = self.mesh
        middle = reference_element(mesh.element).middle
        slopes = monomial_gradients((middle, middle))
        before = polynomials(mesh.element, mesh.cells, mesh.nodes) @ slopes
        after = polynomials(mesh.element, mesh.cells, self.nodes) @ slopes
        stretches = np.linalg.svd(after @ np.linalg.inv(before), compute_uv=False)
        return float(1.0 / stretches.min())

    def average(self, offsets: FloatArray, weights: FloatArray, selected: BoolArray) -> FloatArray:
        """(k,) weighted sum over offsets of the intensities at the k selected pixels + offset.

        ``offsets`` (p, 2) are (row, col) [px]. InputError if an element is inverted.
        """
        mesh, nodes, grid, h = self.mesh, self.nodes, self.grid, self.grid.pixel_size
        require_positive_jacobian(nodes, mesh.cells, mesh.element, self.where)
        cells = mesh.cells[self._reaching(nodes, selected, float(np.abs(offsets).max(initial=0.0)))]
        position = np.stack(grid.to_px(mesh.nodes[:, 0], mesh.nodes[:, 1]), axis=1)
        samples = self.speckle.spec.binary_field.finer * position  # coordinates of the spline
        place, pattern = polynomials(mesh.element, cells, samples), self.speckle.spline.table
        selected = np.ascontiguousarray(selected)
        chosen = np.flatnonzero(selected)
        first = np.searchsorted(chosen, np.arange(0, grid.rows + _BAND, _BAND) * grid.cols)
        total = np.zeros(chosen.size)
        for (down, right), weight in zip(offsets, weights, strict=True):
            moved = replace(grid, x0=float(grid.x0 + h * right), y0=float(grid.y0 - h * down))
            elements = tabulate_elements(nodes, cells, mesh.element, moved)
            start, visits = bands(elements, grid.rows, _BAND)
            in_parallel(_add, elements, place, pattern, self.background, start, visits,
                        float(weight), selected, chosen, first, total)  # fmt: skip
        return total

    def _reaching(self, nodes: FloatArray, selected: BoolArray, reach: float) -> BoolArray:
        """(m,) True for elements that may have points within ``reach`` px of a selected pixel."""
        element, shape = reference_element(self.mesh.element), self.grid.shape
        control = bezier_matrix(element.triangular) @ element.coefficients
        position = np.stack(self.grid.to_px(nodes[:, 0], nodes[:, 1]), axis=1)[self.mesh.cells]
        hull = np.einsum("pk,mki->mpi", control, position)
        low = np.clip(np.floor(hull.min(axis=1) - reach), 0, shape).astype(np.int64)
        past = np.clip(np.ceil(hull.max(axis=1) + reach) + 1, 0, shape).astype(np.int64)
        count = np.zeros((shape[0] + 1, shape[1] + 1), dtype=np.int64)
        count[1:, 1:] = selected.cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
        (top, left), (bottom, right) = low.T, past.T
        inside = count[bottom, right] - count[top, right] - count[bottom, left] + count[top, left]
        return np.asarray(inside > 0)


@dataclass(frozen=True, eq=False)
class Rendering:
    """An image and its mask of material."""

    image: FloatImage
    """(rows, cols) float32 intensity [fraction of full scale]."""
    mask: BoolArray
    """(rows, cols) True where there is material."""
    doubly_covered: int = 0
    """Number of pixels inside more than one element: the specimen overlaps itself there, and the
    element with the lowest number is shown."""


def render_reference(state: ImagedState, located: Located) -> Rendering:
    """Render the undeformed specimen; ``located``: its mesh on the state's grid."""
    mask = located.mask
    image = np.where(mask, state.speckle.image(), state.background).astype(np.float32)
    return Rendering(image, mask, located.doubly_covered)


def render_deformed(state: ImagedState, located_reference: Located) -> tuple[Rendering, Truth]:
    """Render the deformed specimen, and compute the image's exact fields.

    ``located_reference`` is the undeformed mesh on the same grid. InputError if the displacement
    inverts an element.
    """
    mesh, grid, u = state.mesh, state.grid, state.displacement
    assert u is not None
    located = locate(state.nodes, mesh.cells, mesh.element, grid, state.where)
    point = interpolate(located, mesh.cells, mesh.element, mesh.nodes)
    moved = interpolate(located, mesh.cells, mesh.element, u)
    at_reference = interpolate(located_reference, mesh.cells, mesh.element, u)
    truth = Truth.of(
        displacement=np.moveaxis(at_reference, 0, -1),
        reference_point=np.moveaxis(point, 0, -1),
        deformed_displacement=np.moveaxis(moved.astype(np.float32), 0, -1),
        element=located.element,
        residual_px=located.residual_px,
    )
    mask = located.mask
    image = np.full(grid.shape, state.background, dtype=np.float32)
    image[mask] = state.speckle(*grid.to_px(point[0][mask], point[1][mask]))
    return Rendering(image, mask, located.doubly_covered), truth


def render_observed(state: ImagedState, points: Positions) -> Rendering:
    """Render the specimen at given ideal positions instead of at the grid's pixels.

    ``points`` are (row, col), each (rows, cols) [px]. Pixels inside more than one element are not
    counted. InputError if the displacement inverts an element.
    """
    mesh, grid = state.mesh, state.grid
    located = locate_points(state.nodes, mesh.cells, mesh.element, grid, *points, state.where)
    mask = located.mask
    if state.displacement is None:
        row, col = points[0][mask], points[1][mask]
    else:
        x, y = interpolate(located, mesh.cells, mesh.element, mesh.nodes)[:, mask]
        row, col = grid.to_px(x, y)
    image = np.full(mask.shape, state.background, dtype=np.float32)
    image[mask] = state.speckle(row, col)
    return Rendering(image, mask)


@compiled()
def _add(
    elements: ElementTable, place: FloatArray, pattern: SplineTable, background: float,
    start: IntArray, visits: IntArray, weight: float, selected: BoolArray, chosen: IntArray,
    first: IntArray, total: FloatArray, thread: int, threads: int,
) -> None:  # fmt: skip
    """Add ``weight`` times the selected pixels' grey levels to ``total`` (k,).

    ``place`` (m, 2, 9): polynomials of the position in the pattern, (row, col) [samples].
    ``chosen`` (k,): flat indices of the selected pixels, those of band b from ``first[b]`` on.
    """
    rows, cols = selected.shape
    where, row, col = np.empty(BLOCK, dtype=np.int64), np.empty(BLOCK), np.empty(BLOCK)
    shown, work = np.empty(BLOCK), workspace()
    element, at = np.empty(_BAND * cols, dtype=np.int32), np.empty((2, _BAND * cols))
    for band in range(thread, start.size - 1, threads):
        top, bottom = band * _BAND, min((band + 1) * _BAND, rows)
        if first[band] == first[band + 1]:
            continue
        pixels = Pixels(element, at, np.empty(0, dtype=np.float32), top, cols, 0.0, 0.0, 1.0)
        visited = visits[start[band] : start[band + 1]]
        fill(elements, place, pixels, selected.ravel(), visited, top, bottom)
        count = 0
        for n in range(first[band], first[band + 1]):
            k = chosen[n] - top * cols
            if element[k] >= 0:
                where[count], row[count], col[count] = n, at[0, k], at[1, k]
                count += 1
            else:
                total[n] += weight * background
            if count == BLOCK or (n == first[band + 1] - 1 and count > 0):
                sample(pattern, row[:count], col[:count], shown[:count], work)
                for m in range(count):
                    total[where[m]] += weight * shown[m]
                count = 0
