"""Normal equations of the nodes' displacements, summed element by element over the pixels.

For every pixel x of the reference that counts, with r = f(x) - g(x + u) and the gradient h that
weighs it, an element sums N_a N_b h_i h_j and N_a h_i r over its pixels. Residuals that continued
pixels affect are weighted by the inverse of their variance. The elements are divided among the
threads and summed in order, so that the result doesn't depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modeharvest.fem.field import Mesh
from modeharvest.idic.finite_element.equations.continued import NONE_CONTINUED, ContinuedPixels
from modeharvest.idic.finite_element.equations.pixels import ElementPixels
from modeharvest.idic.solver.pyramid import LevelPair
from modeharvest.imaging.spline import sample_points
from modeharvest.util.arrays import FloatArray
from modeharvest.util.compiled import compiled, in_parallel

_BLOCK = 64
"""Pixels of an element that are processed together."""
_LEAST_SIGNAL = 0.5
"""Least share of signal in an element's slopes; with less they may be nothing but noise."""
_TINY = float(np.finfo(np.float64).tiny)


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
