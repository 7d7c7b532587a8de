"""The compiled pass over the pixels: weighted Chebyshev moments instead of a Jacobian.

Every column of the Jacobian is a *base field* e(x) times a product T_i(xi) T_j(eta), so that
J'J, J'r and r'r need nothing but the moments sum_x e e' T_a(xi) T_b(eta) of pairs of base
fields. The base fields, D being the total degree of the products that multiply each of them:

    gx, gy                      gradient of the deformed image at x + u         D = degree of v0
    p_i = phi_i . (gx, gy)      one for each mode                               D = degree of v
    S gx sin, S gy sin          for each wave, S = s tau v_i                    D = 0
    S (A gx + B gy) cos pi/l    for each wave; its 1, x, y parts are c, kx, ky  D = 1
    r                           the residual                                    D = 0

About 250 multiply-adds a pixel for 77 unknowns, where the Jacobian's product needs 3 000. The
pixels of a row that hold material are gathered in blocks that stay in the first cache; the
rows are dealt to a fixed number of bands whose sums are added in order, so the result does not
depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from modeharvest.imaging.compiled import compiled
from modeharvest.imaging.interpolation import sample_points

BLOCK = 256
"""Pixels gathered at a time."""

IMAGE = -1
"""``component`` of :func:`accumulate` for a pair of images; 0 and 1 are displacements."""


@compiled(relaxed=True)
def _chebyshev_block(xi: Any, columns: Any, n: int, T: Any) -> None:
    """T_0 ... T_K at the block's columns."""
    for m in range(n):
        T[0, m] = 1.0
        T[1, m] = xi[columns[m]]
    for a in range(2, T.shape[0]):
        for m in range(n):
            T[a, m] = 2.0 * T[1, m] * T[a - 1, m] - T[a - 2, m]


@compiled(relaxed=True)
def _series_block(C: Any, eta_T: Any, T: Any, n: int, out: Any) -> None:
    """Sum C[a, b] T_a(xi) T_b(eta) along the block; eta_T holds T_b of the row."""
    degree = C.shape[0] - 1
    for m in range(n):
        out[m] = 0.0
    for a in range(degree + 1):
        along = 0.0
        for b in range(degree - a + 1):
            along += C[a, b] * eta_T[b]
        for m in range(n):
            out[m] += along * T[a, m]


@compiled(relaxed=True)
def _modes_block(
    row: int,
    columns: Any,
    n: int,
    waves: Any,
    mode_of_wave: Any,
    sin_x: Any,
    cos_x: Any,
    sin_y: Any,
    cos_y: Any,
    taper_x: Any,
    taper_y: Any,
    v: Any,
    phi: Any,
    sines: Any,
    cosines: Any,
) -> None:
    """phi_i, S sin theta_w and S cos theta_w pi/l along the block, from one-dimensional tables."""
    for i in range(phi.shape[0]):
        for m in range(n):
            phi[i, 0, m] = phi[i, 1, m] = 0.0
    for w in range(waves.shape[0]):
        i = mode_of_wave[w]
        A, B, per_mm = waves[w, 0], waves[w, 1], waves[w, 5]
        sy, cy = sin_y[w, row], cos_y[w, row]
        for m in range(n):
            k = columns[m]
            tau = taper_x[i, k] * taper_y[i, row]
            sine = tau * (sin_x[w, k] * cy + cos_x[w, k] * sy)
            phi[i, 0, m] += A * sine
            phi[i, 1, m] += B * sine
            sines[w, m] = v[i, m] * sine
            cosines[w, m] = per_mm * v[i, m] * tau * (cos_x[w, k] * cy - sin_x[w, k] * sy)


@compiled(relaxed=True)
def _model_block(
    component: int,
    f: Any,
    row: int,
    columns: Any,
    n: int,
    ux: Any,
    uy: Any,
    coefficients: Any,
    order: int,
    pixel_size: float,
    work: Any,
    E: Any,
) -> int:
    """Gradient into E[0], E[1] and residual into E[-1]; returns how many left the image.

    A pixel that leaves the image gets zeros: it takes no part in any sum.
    """
    last = E.shape[0] - 1
    if component >= 0:
        for m in range(n):
            E[0, m] = 1.0 - component
            E[1, m] = component
            E[last, m] = f[row, columns[m]] - (uy[m] if component else ux[m])
        return 0
    per_px = 1.0 / pixel_size
    r, c, value, d_row, d_col = work[0], work[1], work[2], work[3], work[4]
    for m in range(n):
        r[m] = row - uy[m] * per_px
        c[m] = columns[m] + ux[m] * per_px
    sample_points(coefficients, order, r, c, n, value, d_row, d_col)
    off = 0
    for m in range(n):
        if np.isnan(value[m]):
            off += 1
            E[0, m] = E[1, m] = E[last, m] = 0.0
        else:
            E[0, m] = d_col[m] * per_px
            E[1, m] = -d_row[m] * per_px
            E[last, m] = f[row, columns[m]] - value[m]
    return off


@compiled(relaxed=True)
def _base_fields_block(n: int, waves: Any, phi: Any, sines: Any, cosines: Any, E: Any) -> None:
    """Fill the base fields between the gradient and the residual."""
    gx, gy = E[0], E[1]
    modes = phi.shape[0]
    for i in range(modes):
        for m in range(n):
            E[2 + i, m] = phi[i, 0, m] * gx[m] + phi[i, 1, m] * gy[m]
    for w in range(waves.shape[0]):
        k = 2 + modes + 3 * w
        A, B = waves[w, 0], waves[w, 1]
        for m in range(n):
            E[k, m] = sines[w, m] * gx[m]
            E[k + 1, m] = sines[w, m] * gy[m]
            E[k + 2, m] = cosines[w, m] * (A * gx[m] + B * gy[m])


@compiled(relaxed=True)
def _moments_block(n: int, pairs: Any, T: Any, E: Any, product: Any, row_moments: Any) -> None:
    """Add sum e e' T_a over the block to row_moments[pair, a] for a up to the pair's degree."""
    for p in range(pairs.shape[0]):
        e, e2, degree = E[pairs[p, 0]], E[pairs[p, 1]], pairs[p, 2]
        total = 0.0
        for m in range(n):
            product[m] = e[m] * e2[m]
            total += product[m]
        row_moments[p, 0] += total
        a = 1
        while a + 3 <= degree:
            T0, T1, T2, T3 = T[a], T[a + 1], T[a + 2], T[a + 3]
            s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
            for m in range(n):
                s0 += product[m] * T0[m]
                s1 += product[m] * T1[m]
                s2 += product[m] * T2[m]
                s3 += product[m] * T3[m]
            row_moments[p, a] += s0
            row_moments[p, a + 1] += s1
            row_moments[p, a + 2] += s2
            row_moments[p, a + 3] += s3
            a += 4
        while a <= degree:
            T0, s0 = T[a], 0.0
            for m in range(n):
                s0 += product[m] * T0[m]
            row_moments[p, a] += s0
            a += 1


@compiled(relaxed=True)
def _add_row(pairs: Any, row_moments: Any, eta_T: Any, moments: Any) -> None:
    """Multiply the moments of a row by T_b(eta) of that row, and add them."""
    for p in range(pairs.shape[0]):
        degree = pairs[p, 2]
        for a in range(degree + 1):
            value = row_moments[p, a]
            row_moments[p, a] = 0.0
            for b in range(degree - a + 1):
                moments[p, a, b] += value * eta_T[b]


@compiled(parallel=True, relaxed=True)
def accumulate(
    component: int,
    f: Any,
    coefficients: Any,
    order: int,
    pixel_size: float,
    columns: Any,
    row_start: Any,
    xi: Any,
    eta: Any,
    v0_series: Any,
    v_series: Any,
    waves: Any,
    mode_of_wave: Any,
    sin_x: Any,
    cos_x: Any,
    sin_y: Any,
    cos_y: Any,
    taper_x: Any,
    taper_y: Any,
    pairs: Any,
    bands: int,
    moments: Any,
    left: Any,
) -> None:
    """Sum the moments of all pairs of base fields over the pixels.

    Parameters
    ----------
    component
        IMAGE: residual f - g(x + u). 0 or 1: residual f - u_x or f - u_y, gradient (1, 0) or
        (0, 1), which fits the ansatz to a displacement.
    f
        (rows, cols): reference image, or the displacement's component [mm].
    coefficients, order
        Spline of the deformed image.
    pixel_size
        [mm/px].
    columns, row_start
        Columns of the pixels that count, row after row, and (rows + 1,) where each row starts.
    xi, eta
        (cols,), (rows,): normalised coordinates.
    v0_series, v_series
        (2, D0 + 1, D0 + 1) and (n, D + 1, D + 1): coefficients [i, j] [mm].
    waves, mode_of_wave
        (w, 6): A, B, kx, ky, c, pi/l; (w,): the mode each belongs to.
    sin_x, cos_x, sin_y, cos_y
        (w, cols) of pi/l kx x, (w, rows) of pi/l (ky y + c).
    taper_x, taper_y
        (n, cols) s tau_x and (n, rows) tau_y.
    pairs
        (pairs, 3): numbers of two base fields and the sum of their degrees.
    bands
        Number of bands that the rows are dealt to.
    moments
        (bands, pairs, K + 1, K + 1), zero on entry: the sums of each band.
    left
        (bands,), zero on entry: how many pixels are mapped outside the image.
    """
    rows = row_start.size - 1
    n_modes, n_waves = v_series.shape[0], waves.shape[0]
    n_fields = 3 + n_modes + 3 * n_waves
    for band in prange(bands):
        T = np.empty((max(2, moments.shape[2]), BLOCK))
        eta_T = np.empty(T.shape[0])
        E = np.empty((n_fields, BLOCK))
        u, v = np.empty((2, BLOCK)), np.empty((n_modes, BLOCK))
        phi = np.empty((n_modes, 2, BLOCK))
        sines, cosines = np.empty((n_waves, BLOCK)), np.empty((n_waves, BLOCK))
        work, product = np.empty((5, BLOCK)), np.empty(BLOCK)
        row_moments = np.zeros((pairs.shape[0], T.shape[0]))
        for row in range(band * rows // bands, (band + 1) * rows // bands):
            first, last = row_start[row], row_start[row + 1]
            if first == last:
                continue
            eta_T[0], eta_T[1] = 1.0, eta[row]
            for b in range(2, eta_T.size):
                eta_T[b] = 2.0 * eta[row] * eta_T[b - 1] - eta_T[b - 2]
            for begin in range(first, last, BLOCK):
                n = min(BLOCK, last - begin)
                block = columns[begin : begin + n]
                _chebyshev_block(xi, block, n, T)
                for c in range(2):
                    _series_block(v0_series[c], eta_T, T, n, u[c])
                for i in range(n_modes):
                    _series_block(v_series[i], eta_T, T, n, v[i])
                _modes_block(
                    row, block, n, waves, mode_of_wave, sin_x, cos_x, sin_y, cos_y,
                    taper_x, taper_y, v, phi, sines, cosines,
                )  # fmt: skip
                for i in range(n_modes):
                    for m in range(n):
                        u[0, m] += v[i, m] * phi[i, 0, m]
                        u[1, m] += v[i, m] * phi[i, 1, m]
                left[band] += _model_block(
                    component, f, row, block, n, u[0], u[1], coefficients, order, pixel_size,
                    work, E,
                )  # fmt: skip
                _base_fields_block(n, waves, phi, sines, cosines, E)
                _moments_block(n, pairs, T, E, product, row_moments)
            _add_row(pairs, row_moments, eta_T, moments[band])
