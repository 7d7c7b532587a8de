"""Images and pixels on a mesh: continued beyond edges, sorted by element, normal equations.

Near an edge the spline through the deformed image reads pixels beyond it. There the material is
continued by local quadratic polynomials, which cause the errors at edges: they predict little of
fine speckle. Therefore a residual is weighted by the inverse of its variance, including that of
continued pixels. The latter is the variance that the outermost pixels of the material have when
they are continued from the others.

For every pixel x of the reference that counts, with r = f(x) - g(x + u) and the gradient h that
weighs it, an element sums N_a N_b h_i h_j and N_a h_i r over its pixels. The elements are divided
among the threads and summed in order, so that the result doesn't depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_array

from modeharvest.fem.field import Mesh
from modeharvest.idic.solver.pyramid import FELT, FULL, Level, LevelPair, eroded, level_pair
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage, border_reach, sample_points
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.compiled import compiled, in_parallel, readable
from modeharvest.util.errors import InputError
from modeharvest.util.masks import grown

_BLOCK = 64
"""Pixels of an element that are processed together."""
_REACH_PX = 4
"""Distance beyond the material up to which pixels are continued by polynomials [px]."""
_SIGMA_PX = 1.5
"""Standard deviation of the Gaussian weights of the material's pixels for that."""
_WINDOW_PX = 6
_RIDGE = 1e-3
"""Regularisation of polynomials that too few pixels determine, over the sum of weights."""
_LEAST_SIGNAL = 0.5
"""Least share of signal in an element's slopes; with less they may be nothing but noise."""
_TINY = float(np.finfo(np.float64).tiny)
_BEYOND_PX = 2
"""Largest distance of a mask's edge from the mesh, along rows and columns."""


def images_on(pair: ImagePair, level: Level, edge_px: int, order: int) -> LevelPair:
    """Make one level of an image pair; on the finest, g is continued by quadratic polynomials.

    pair, level : as for :func:`modeharvest.idic.solver.pyramid.level_pair`.
    edge_px : pixels closer than this to the mask's edge are left out on the finest level [px].
    order : of the spline that samples g.
    """
    if level != FULL:
        return level_pair(pair, level, edge_px, order)
    inside, mask = pair.masks
    valid = ndimage.binary_dilation(eroded(mask, max(0, edge_px - 1)))
    g, inside = continued_spline(pair.deformed, mask, order), eroded(inside, edge_px)
    return LevelPair(pair.grid, pair.reference, g, inside, None if valid.all() else valid)


def continued_spline(image: FloatImage, mask: BoolArray, order: int) -> SplineImage:
    """The spline through an image (rows, cols), continued beyond its material and its border."""
    width = border_reach(order, FELT)
    framed = continued(np.pad(image, width), np.pad(mask, width))
    inner = SplineImage.of(framed, order).coefficients[width:-width, width:-width]
    return SplineImage(np.ascontiguousarray(inner), order)


class ContinuedPixels(NamedTuple):
    """Which pixels of the deformed image are continued, and their error's variance."""

    outside: NDArray[Any]
    """(rows, cols) float32, 1 where a pixel is continued and 0 on material; (0, 0) if none is."""
    variance: float
    """Variance of a continued pixel's error, over that of the residual's noise [-]."""
    summed: NDArray[Any]
    """(rows + 1, cols + 1) int32 summed-area table of continued and of invalid pixels."""


NONE_CONTINUED = ContinuedPixels(np.zeros((0, 0), np.float32), 0.0, np.zeros((0, 0), np.int32))
_LARGEST_VARIANCE = 1e6
"""Largest variance of continued pixels, which they have where there is no noise [-]."""


def continued_pixels(
    pair: ImagePair, noise_f: float, noise_g: float, valid: BoolArray | None = None
) -> ContinuedPixels:
    """Estimate the continued pixels' variance from the outermost pixels of the material.

    ``noise_f``, ``noise_g``: variances of the images' noise [grey levels^2]; ``valid``: valid
    pixels of the deformed image (rows, cols), None for all.
    """
    g, mask = pair.deformed, pair.deformed_mask
    if mask is None or mask.all():
        return NONE_CONTINUED
    inside = ndimage.binary_erosion(mask, border_value=1)
    outermost = mask & ~inside
    ratio = _LARGEST_VARIANCE
    if inside.any():
        found, (rows, cols) = np.empty(g.shape, np.float32), np.nonzero(outermost)
        in_parallel(_continue, *map(readable, (g, inside, rows, cols)), found)
        error = float(np.mean((found[outermost] - g[outermost]) ** 2))
        # The pixel tried has noise itself, and so would the missing pixel that it stands for.
        excess, noise = max(0.0, error - 2.0 * noise_g), noise_f + noise_g
        ratio = min(ratio, excess / noise) if noise > 0.0 else ratio
    lost = ~mask if valid is None else ~(mask & valid)
    summed = np.pad(lost, ((1, 0), (1, 0))).cumsum(0, np.int32).cumsum(1, np.int32)
    return ContinuedPixels((~mask).astype(np.float32), ratio, summed)


def continued(image: FloatImage, mask: BoolArray) -> FloatImage:
    """Continue an image a few pixels beyond its material, by local quadratic fits.

    image : (rows, cols) grey levels.
    mask : (rows, cols) True on material; farther than 4 px from it the nearest pixel's value is
        kept.
    """
    row, col = ndimage.distance_transform_edt(~mask, None, False, True)
    filled = np.ascontiguousarray(image[row, col])
    rows, cols = np.nonzero(grown(mask, _REACH_PX) & ~mask)
    in_parallel(_continue, *map(readable, (image, mask, rows, cols)), filled)
    return filled


@compiled(relaxed=True)
def _continue(
    image: Any, mask: Any, rows: Any, cols: Any, out: NDArray[Any], thread: int, threads: int
) -> None:
    A, b, phi = np.empty((6, 6)), np.empty(6), np.ones(6)  # of A only the upper triangle
    decay = np.exp(-0.5 * (np.arange(_WINDOW_PX + 1) / _SIGMA_PX) ** 2)
    for p in range(thread, rows.size, threads):
        i, j = rows[p], cols[p]
        A[:], b[:] = 0.0, 0.0
        for k in range(max(0, i - _WINDOW_PX), min(image.shape[0], i + _WINDOW_PX + 1)):
            for m in range(max(0, j - _WINDOW_PX), min(image.shape[1], j + _WINDOW_PX + 1)):
                if not mask[k, m]:
                    continue
                y, x = float(k - i), float(m - j)
                phi[1], phi[2], phi[3], phi[4], phi[5] = x, y, x * x, x * y, y * y
                w, grey = decay[abs(k - i)] * decay[abs(m - j)], image[k, m]
                for a in range(6):
                    share = w * phi[a]
                    b[a] += share * grey
                    for c in range(a, 6):
                        A[a, c] += share * phi[c]
        for a in range(1, 6):
            A[a, a] += _RIDGE * A[0, 0]
        # A is positive definite: without its last unknowns, eliminated in turn, the first remains.
        for c in range(5, 0, -1):
            for a in range(c):
                share = A[a, c] / A[c, c]
                b[a] -= share * b[c]
                for d in range(a, c):
                    A[a, d] -= share * A[d, c]
        out[i, j] = b[0] / A[0, 0]


class ElementPixels(NamedTuple):
    """The pixels that count, element by element."""

    start: NDArray[Any]
    """(m + 1,): those of element e are start[e] ... start[e + 1] - 1."""
    row: NDArray[Any]
    col: NDArray[Any]
    """(p,) int32 position [px]."""
    xi: NDArray[Any]
    """(2, p) float32 local coordinates [-]."""
    grey: NDArray[Any]
    """(p,) float32 grey level of f there."""
    slope: NDArray[Any]
    """(2, p) float32 gradient of f there, along x and y [grey levels/mm]; or (2, 0)."""

    def only(self, keep: BoolArray) -> ElementPixels:
        """Select pixels: (p,) True for those that count."""
        start = np.concatenate([[0], np.cumsum(keep)])[self.start]
        return ElementPixels(start, *(p[..., keep] if p.shape[-1] else p for p in self[1:]))


class MeshPixels:
    """Pixels of masks sorted by the elements of a T6 mesh; the sorting of a mask is kept."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._kept: dict[tuple[PixelGrid, int], tuple[BoolArray, ElementPixels]] = {}

    def on(self, grid: PixelGrid, mask: BoolArray, image: NDArray[Any]) -> ElementPixels:
        """Pixels of a mask (rows, cols) that are in the mesh, with f (rows, cols) there.

        InputError if pixels of the mask lie farther than 2 px from those in elements.
        """
        key = grid, int(mask.sum())
        kept = self._kept.get(key)
        if kept is None or not np.array_equal(kept[0], mask):
            kept = self._kept[key] = mask, self._sorted(grid, mask)
        pixels = kept[1]
        return pixels._replace(grey=np.asarray(image, np.float32)[pixels.row, pixels.col])

    def _sorted(self, grid: PixelGrid, mask: BoolArray) -> ElementPixels:
        mesh = self.mesh
        located = locate(mesh.nodes, mesh.cells, mesh.element, grid, "mesh of the material")
        _require_cover(located.mask, mask)
        flat = np.flatnonzero(mask & located.mask)
        where, ones = (located.element.ravel()[flat], flat), np.ones(flat.size, np.int8)
        by_element = csr_array((ones, where), shape=(len(mesh.cells), mask.size))
        row, col = np.divmod(by_element.indices, grid.cols)
        xi = located.values.reshape(2, -1)[:, by_element.indices].astype(np.float32)
        none, start = np.empty((2, 0), np.float32), by_element.indptr.astype(np.int64)
        return ElementPixels(start, row.astype(np.int32), col.astype(np.int32), xi, none[0], none)


def _require_cover(covered: BoolArray, mask: BoolArray) -> None:
    far = mask & eroded(~covered, _BEYOND_PX)
    if far.any():
        row, col = np.argwhere(far)[0]
        raise InputError(
            f"expected a mesh that covers the mask, got one that leaves out {int(far.sum())} of "
            f"{int(mask.sum())} px, the first at row {row}, column {col}; give the mesh of the "
            "whole body, or a mask of what it covers"
        )


@dataclass(frozen=True, eq=False)
class NodalEquations:
    """Normal equations of the nodes' displacements, element by element."""

    blocks: FloatArray
    """(m, 3, 6, 6) sums of N_a N_b h_i h_j for i j = x x, x y, y y [grey levels^2/mm^2], or
    (0, 3, 6, 6)."""
    gradient: FloatArray
    """(m, 6, 2) sums of N_a h_i r [grey levels^2/mm]."""
    squares: FloatArray
    """(m,) sums of r^2 [grey levels^2]."""
    counts: FloatArray
    weights: FloatArray
    """(m,) number of pixels, and sum of their weights."""
    slopes: FloatArray
    """(m, 2) sums of |h|^2 and of h grad g at x + u [grey levels^2/mm^2]; 0 if h is grad g."""
    outside: int
    """Pixels mapped to where g isn't valid."""

    @property
    def square_sum(self) -> float:
        """Sum of r^2 over all elements [grey levels^2]."""
        return float(self.squares.sum())

    @property
    def pixels(self) -> int:
        """Number of pixels in that sum."""
        return int(self.counts.sum())

    @property
    def rms(self) -> float:
        """Root mean square of r [grey levels]."""
        return float(np.sqrt(self.square_sum / self.pixels))

    def signal(self, noise: FloatArray) -> tuple[FloatArray, float]:
        """(m,) share of signal in each element's slopes, 0 to 1; grad g over h, at least 1.

        ``noise`` (m,): mean of |h|^2 by noise [grey levels^2/mm^2], which shows nothing: a residual
        changes by the share of signal in a sum of h h', or by more if a blur has flattened h.
        """
        slopes = self.blocks[:, [0, 2]].sum(axis=(1, 2, 3))  # shape functions sum to 1
        signal = 1.0 - noise * self.weights / np.maximum(slopes, _TINY)
        signal[(signal < _LEAST_SIGNAL) | (slopes <= 0.0)] = 0.0
        square, product = self.slopes.sum(axis=0)
        alone = max(square - noise @ self.counts, _LEAST_SIGNAL * square, _TINY)
        return signal, float(max(1.0, product / alone))


def normal_equations(
    pixels: ElementPixels,
    mesh: Mesh,
    level: LevelPair,
    u: FloatArray,
    continued_in_g: ContinuedPixels = NONE_CONTINUED,
    with_blocks: bool = True,
) -> NodalEquations:
    """Sum the normal equations over all pixels.

    pixels : pixels of the level's reference. The gradient of f there, pushed forward, weighs the
        residual; if they have none, that of the deformed image at x + u does.
    mesh : T6 mesh.
    level : images of which the deformed one is sampled.
    u : (n, 2) displacement of the nodes [mm].
    continued_in_g : continued pixels of the deformed image, which lower the residuals' weights.
    with_blocks : whether the blocks are needed, which take most of the computing time.
    """
    m, g = len(mesh.cells), level.deformed
    blocks = np.zeros((m if with_blocks else 0, 3, 6, 6))
    gradient, sums = np.zeros((m, 6, 2)), np.zeros((m, 6))
    valid = np.ones((0, 0), dtype=np.bool_) if level.valid is None else level.valid
    in_parallel(
        accumulate_elements, pixels, mesh.nodes[mesh.cells], u[mesh.cells], g.coefficients, g.order,
        valid, *continued_in_g, level.grid.pixel_size, blocks, gradient, sums,
    )  # fmt: skip
    squares, counts, outside, weights = sums.T[:4]
    lost, slopes = int(outside.sum()), sums[:, 4:]
    return NodalEquations(blocks, gradient, squares, counts, weights, slopes, lost)


@compiled(relaxed=True)
def accumulate_elements(
    pixels: Any, x: Any, u: Any, coefficients: Any, order: int, valid: Any, outside: Any,
    variance: float, summed: Any, pixel_size: float, blocks: Any, gradient: Any, sums: Any,
    thread: int, threads: int,
) -> None:  # fmt: skip
    """Fill each element's own sums of products over its pixels."""
    for e in range(thread, x.shape[0], threads):
        own = np.empty((7, _BLOCK))
        N = np.empty((6, _BLOCK))
        h = np.empty((2, _BLOCK))
        for begin in range(pixels.start[e], pixels.start[e + 1], _BLOCK):
            n = min(_BLOCK, pixels.start[e + 1] - begin)
            _shapes(pixels.xi, begin, n, N)
            _map(pixels, begin, n, N, u[e], pixel_size, own)
            interior = _is_interior(n, summed, own)
            at = valid[:0] if interior else valid
            _sample(pixels, begin, n, coefficients, order, at, pixel_size, own, sums[e])
            if pixels.slope.size:
                _push_forward(pixels, begin, n, x[e], u[e], own, sums[e])
            if outside.size and not interior:
                _weigh(n, outside, variance, own)
            for m in range(n):
                sums[e, 0] += own[2, m] * own[2, m]
                sums[e, 3] += own[3, m]
            _add(n, N, own, gradient[e])
            if blocks.shape[0]:
                _add_products(n, N, own, h, blocks[e])


@compiled(inner=True, relaxed=True)
def _shapes(xi: Any, begin: int, n: int, N: Any) -> None:
    """Fill the shape functions of a T6 element (6, n)."""
    for m in range(n):
        s, t = float(xi[0, begin + m]), float(xi[1, begin + m])
        r = 1.0 - s - t
        N[0, m], N[1, m], N[2, m] = r * (2.0 * r - 1.0), s * (2.0 * s - 1.0), t * (2.0 * t - 1.0)
        N[3, m], N[4, m], N[5, m] = 4.0 * r * s, 4.0 * s * t, 4.0 * t * r


@compiled(inner=True, relaxed=True)
def _map(pixels: Any, begin: int, n: int, N: Any, u: Any, pixel_size: float, own: Any) -> None:
    """Fill the positions of a block's pixels in the deformed image, row and column."""
    at_row, at_col, per_px = own[4], own[5], 1.0 / pixel_size
    for m in range(n):
        right = up = 0.0
        for a in range(6):
            right += N[a, m] * u[a, 0]
            up += N[a, m] * u[a, 1]
        at_row[m] = pixels.row[begin + m] - up * per_px
        at_col[m] = pixels.col[begin + m] + right * per_px


@compiled(inner=True, relaxed=True)
def _is_interior(n: int, summed: Any, own: Any) -> bool:
    """Whether all pixels around those of a block show material in the deformed image."""
    top, left = own[4, :n].min(), own[5, :n].min()
    bottom, right = own[4, :n].max() + 2.0, own[5, :n].max() + 2.0
    if top < 0.0 or left < 0.0 or bottom >= summed.shape[0] or right >= summed.shape[1]:
        return False
    i, j, k, m = int(top), int(left), int(bottom), int(right)
    return bool(summed[k, m] - summed[i, m] - summed[k, j] + summed[i, j] == 0)


@compiled(inner=True, relaxed=True)
def _sample(
    pixels: Any, begin: int, n: int, coefficients: Any, order: int, valid: Any, pixel_size: float,
    own: Any, sums: Any,
) -> None:  # fmt: skip
    """Fill gradient (2), residual, and weight 1 or 0, of a block; count its pixels."""
    g_x, g_y, residual, at_row, at_col = own[0], own[1], own[2], own[4], own[5]
    g, weight, per_px = own[6], own[3], 1.0 / pixel_size
    sample_points(coefficients, order, at_row, at_col, n, g, g_y, g_x)
    for m in range(n):
        counts = not np.isnan(g[m])
        if counts and valid.size:
            counts = valid[int(np.rint(at_row[m])), int(np.rint(at_col[m]))]
        weight[m] = 1.0 if counts else 0.0
        residual[m] = pixels.grey[begin + m] - g[m] if counts else 0.0
        g_x[m] = g_x[m] * per_px if counts else 0.0
        g_y[m] = -g_y[m] * per_px if counts else 0.0
        sums[1] += weight[m]
        sums[2] += 1.0 - weight[m]


@compiled(inner=True, relaxed=True)
def _push_forward(pixels: Any, begin: int, n: int, x: Any, u: Any, own: Any, sums: Any) -> None:
    """Replace grad g by F^-T grad f in a block; sum its square and the product of both."""
    for m in range(n):
        s, t = float(pixels.xi[0, begin + m]), float(pixels.xi[1, begin + m])
        r = 1.0 - s - t
        d_s = (1.0 - 4.0 * r, 4.0 * s - 1.0, 0.0, 4.0 * (r - s), 4.0 * t, -4.0 * t)
        d_t = (1.0 - 4.0 * r, 0.0, 4.0 * t - 1.0, -4.0 * s, 4.0 * s, 4.0 * (r - t))
        X_s = X_t = Y_s = Y_t = x_s = x_t = y_s = y_t = 0.0
        for a in range(6):
            X_s += d_s[a] * x[a, 0]
            X_t += d_t[a] * x[a, 0]
            Y_s += d_s[a] * x[a, 1]
            Y_t += d_t[a] * x[a, 1]
            x_s += d_s[a] * (x[a, 0] + u[a, 0])
            x_t += d_t[a] * (x[a, 0] + u[a, 0])
            y_s += d_s[a] * (x[a, 1] + u[a, 1])
            y_t += d_t[a] * (x[a, 1] + u[a, 1])
        det = x_s * y_t - x_t * y_s
        if det > 0.0 and own[3, m] > 0.0:
            f_x, f_y = float(pixels.slope[0, begin + m]), float(pixels.slope[1, begin + m])
            f_s, f_t = f_x * X_s + f_y * Y_s, f_x * X_t + f_y * Y_t
            h_x, h_y = (f_s * y_t - f_t * y_s) / det, (f_t * x_s - f_s * x_t) / det
            sums[4] += h_x * h_x + h_y * h_y
            sums[5] += h_x * own[0, m] + h_y * own[1, m]
            own[0, m], own[1, m] = h_x, h_y


@compiled(inner=True, relaxed=True)
def _weigh(n: int, outside: Any, variance: float, own: Any) -> None:
    """Weigh the pixels of a block that continued pixels affect by the inverse of their variance."""
    rows, cols = outside.shape
    for m in range(n):
        if own[3, m] > 0.0:
            row, col = own[4, m], own[5, m]
            i, j = min(max(int(row), 0), rows - 2), min(max(int(col), 0), cols - 2)
            a, b = row - i, col - j
            above = (1.0 - b) * outside[i, j] + b * outside[i, j + 1]
            below = (1.0 - b) * outside[i + 1, j] + b * outside[i + 1, j + 1]
            part = (1.0 - a) * above + a * below
            if part > 0.0:
                own[3, m] = 1.0 / (1.0 + variance * part * part)
                for k in range(3):
                    own[k, m] *= np.sqrt(own[3, m])


@compiled(inner=True, relaxed=True)
def _add(n: int, N: Any, own: Any, gradient: Any) -> None:
    """Add a block's slopes times residuals to an element's sums."""
    g_x, g_y, residual = own[0], own[1], own[2]
    for a in range(6):
        N_a = N[a]
        r_x = r_y = 0.0
        for m in range(n):
            r_x += N_a[m] * g_x[m] * residual[m]
            r_y += N_a[m] * g_y[m] * residual[m]
        gradient[a, 0] += r_x
        gradient[a, 1] += r_y


@compiled(inner=True, relaxed=True)
def _add_products(n: int, N: Any, own: Any, h: Any, blocks: Any) -> None:
    """Add a block's products of slopes to an element's sums."""
    g_x, g_y = own[0], own[1]
    for a in range(6):
        N_a, h_x, h_y = N[a], h[0], h[1]
        for m in range(n):
            h_x[m], h_y[m] = N_a[m] * g_x[m], N_a[m] * g_y[m]
        for b in range(a, 6):
            N_b = N[b]
            xx = xy = yy = 0.0
            for m in range(n):
                xx += h_x[m] * g_x[m] * N_b[m]
                xy += h_x[m] * g_y[m] * N_b[m]
                yy += h_y[m] * g_y[m] * N_b[m]
            blocks[0, a, b] += xx
            blocks[1, a, b] += xy
            blocks[2, a, b] += yy
            if a < b:
                blocks[0, b, a], blocks[1, b, a] = blocks[0, a, b], blocks[1, a, b]
                blocks[2, b, a] = blocks[2, a, b]
