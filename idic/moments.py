"""The compiled pass over the pixels: weighted Chebyshev moments instead of a Jacobian.

Every column of the Jacobian is a *base field* e(x) times a product T_i(xi) T_j(eta), so that
J'J, J'r and r'r need nothing but the moments sum_x e e' T_a(xi) T_b(eta) of pairs of base
fields. The base fields, D being the total degree of the products that multiply each of them:

    gx, gy                      (1 + b) times the deformed image's gradient     D = degree of v0
    p_i = phi_i . (gx, gy)      one for each mode                               D = degree of v
    S gx sin, S gy sin          for each wave, S = s tau v_i                    D = 0
    S (A gx + B gy) cos pi/l    for each wave; its 1, x, y parts are c, kx, ky  D = 1
    g                           only with a gain 1 + b among the unknowns       D = degree of b
    1                           only with an offset among the unknowns          D = its degree
    r                           the residual                                    D = 0

The deformed image is taken at x + u. About 250 multiply-adds a pixel for 77 unknowns, where the
Jacobian's product needs 3 000; J'r alone needs 60. The pixels of a row that hold material are
gathered in blocks that stay in the first cache; the rows are dealt to a fixed number of bands
whose sums are added in order, so the result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from modeharvest.imaging.compiled import compiled
from modeharvest.imaging.interpolation import sample_points

BLOCK = 256
"""Pixels gathered at a time."""


class Target(NamedTuple):
    """What the ansatz is fitted to: a pair of images, or one component of a displacement.

    Parameters
    ----------
    component
        IMAGES: residual f - (1 + b) g(x + u) - c. 0 or 1: residual ``displacement`` - u_x or
        u_y, and (1, 0) or (0, 1) in place of the gradient.
    reference
        (rows, cols) f; of no account for a displacement.
    coefficients, order
        Spline of g.
    displacement
        (rows, cols) [mm]; of no account for images.
    pixel_size
        [mm/px].
    """

    component: int
    reference: NDArray[Any]
    coefficients: NDArray[Any]
    order: int
    displacement: NDArray[Any]
    pixel_size: float


IMAGES = -1
"""``component`` of a pair of images."""


class Runs(NamedTuple):
    """The pixels that count, as runs of neighbours along the rows.

    Parameters
    ----------
    first, stop
        (runs,) column of the first pixel of each and of the one after its last, row after row.
    row_start
        (rows + 1,) number of the first run of each row.
    """

    first: NDArray[Any]
    stop: NDArray[Any]
    row_start: NDArray[Any]


class Tables(NamedTuple):
    """The ansatz at some unknowns, as one-dimensional tables along the rows and columns.

    Parameters
    ----------
    eta
        (rows,): normalised coordinate.
    along_x
        (1 + 2 w + n, cols): xi, then for each wave sin and cos of pi/l kx x, then for each mode
        s tau_x.
    v0, v
        (2, D0 + 1, D0 + 1) and (n, D + 1, D + 1): Chebyshev coefficients [i, j] [mm].
    brightness
        (2, D + 1, D + 1): those of the gain b [-] and of the offset c [grey levels].
    gain_field, offset_field
        Numbers of their base fields; 0 where they are no unknowns.
    waves, mode_of_wave
        (w, 6): A, B, kx, ky, c, pi/l; (w,): the mode each belongs to.
    sin_y, cos_y
        (w, rows) of pi/l (ky y + c).
    taper_y
        (n, rows) tau_y.
    """

    eta: NDArray[Any]
    along_x: NDArray[Any]
    v0: NDArray[Any]
    v: NDArray[Any]
    brightness: NDArray[Any]
    gain_field: int
    offset_field: int
    waves: NDArray[Any]
    mode_of_wave: NDArray[Any]
    sin_y: NDArray[Any]
    cos_y: NDArray[Any]
    taper_y: NDArray[Any]


@compiled(relaxed=True)
def _gather(
    target: Any, row: int, first: int, n: int, at: int, tables: Any, f: Any, columns: Any, X: Any
) -> None:
    """Append a run to a block, from its place ``at`` on: f, columns, and the tables along x.

    Runs are copied rather than pixels picked one by one: that goes by whole vectors.
    """
    # Through views whose indices begin at 0: others might be negative for all the compiler knows.
    columns, f = columns[at : at + n], f[at : at + n]
    for m in range(n):
        columns[m] = first + m
    if target.component >= 0:
        known = target.displacement[row, first : first + n]
        for m in range(n):
            f[m] = known[m]
    else:
        reference = target.reference[row, first : first + n]
        for m in range(n):
            f[m] = reference[m]
    for k in range(X.shape[0]):
        along, to = tables.along_x[k, first : first + n], X[k, at : at + n]
        for m in range(n):
            to[m] = along[m]


@compiled(relaxed=True)
def _chebyshev_block(xi: Any, n: int, T: Any) -> None:
    """T_0 ... T_K along the block."""
    for m in range(n):
        T[0, m] = 1.0
        T[1, m] = xi[m]
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
    row: int, n: int, tables: Any, X: Any, v: Any, phi: Any, sines: Any, cosines: Any
) -> None:
    """phi_i, S sin theta_w and S cos theta_w pi/l along the block, from one-dimensional tables."""
    waves = tables.waves.shape[0]
    phi[:, :, :n] = 0.0
    for w in range(waves):
        i = tables.mode_of_wave[w]
        A, B, per_mm = tables.waves[w, 0], tables.waves[w, 1], tables.waves[w, 5]
        tau_y = tables.taper_y[i, row]
        sy, cy = tau_y * tables.sin_y[w, row], tau_y * tables.cos_y[w, row]
        sin_x, cos_x, tau_x = X[1 + 2 * w], X[2 + 2 * w], X[1 + 2 * waves + i]
        sine, cosine, phi_x, phi_y, v_i = sines[w], cosines[w], phi[i, 0], phi[i, 1], v[i]
        # Short loops with few arrays each: those the compiler turns into vectors.
        for m in range(n):
            sine[m] = tau_x[m] * (sin_x[m] * cy + cos_x[m] * sy)
        for m in range(n):
            cosine[m] = per_mm * tau_x[m] * (cos_x[m] * cy - sin_x[m] * sy)
        for m in range(n):
            phi_x[m] += A * sine[m]
            phi_y[m] += B * sine[m]
        for m in range(n):
            sine[m] *= v_i[m]
            cosine[m] *= v_i[m]


@compiled(relaxed=True)
def _model_block(
    target: Any, row: int, columns: Any, f: Any, n: int, u: Any, bc: Any, work: Any, E: Any
) -> int:
    """Gradient into E[0], E[1], residual into E[-1], g into work[2]; returns how many left.

    A pixel that leaves the image gets zeros, in work[5], too: it takes no part in any sum.
    """
    last = E.shape[0] - 1
    component = target.component
    if component >= 0:
        for m in range(n):
            E[0, m] = 1.0 - component
            E[1, m] = component
            work[2, m] = work[5, m] = 0.0
            E[last, m] = f[m] - u[component, m]
        return 0
    per_px = 1.0 / target.pixel_size
    at_row, at_col, value, d_row, d_col = work[0], work[1], work[2], work[3], work[4]
    for m in range(n):
        at_row[m] = row - u[1, m] * per_px
        at_col[m] = columns[m] + u[0, m] * per_px
    sample_points(target.coefficients, target.order, at_row, at_col, n, value, d_row, d_col)
    off = 0
    for m in range(n):
        if np.isnan(value[m]):
            off += 1
            E[0, m] = E[1, m] = E[last, m] = value[m] = work[5, m] = 0.0
        else:
            work[5, m] = 1.0
            gain = 1.0 + bc[0, m]
            E[0, m] = gain * d_col[m] * per_px
            E[1, m] = -gain * d_row[m] * per_px
            E[last, m] = f[m] - gain * value[m] - bc[1, m]
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


@compiled(relaxed=True)
def _brightness_block(n: int, tables: Any, work: Any, E: Any) -> None:
    """Fill the base fields of gain and offset, g and 1, where they are unknowns."""
    for k, field in ((2, tables.gain_field), (5, tables.offset_field)):
        if field:
            for m in range(n):
                E[field, m] = work[k, m]


@compiled(parallel=True, relaxed=True)
def accumulate(
    target: Any, runs: Any, tables: Any, pairs: Any, fields: int, moments: Any, left: Any
) -> None:
    """Sum the moments of pairs of base fields over the pixels.

    Parameters
    ----------
    target, runs, tables
        :class:`Target`, :class:`Runs` and :class:`Tables`.
    pairs
        (pairs, 3): numbers of two base fields and the sum of their degrees.
    fields
        Number of base fields.
    moments
        (bands, pairs, K + 1, K + 1), zero on entry: the sums of each band of rows.
    left
        (bands,), zero on entry: how many pixels are mapped outside the image.
    """
    rows, bands = runs.row_start.size - 1, moments.shape[0]
    modes, waves = tables.v.shape[0], tables.waves.shape[0]
    for band in prange(bands):
        T = np.empty((max(2, moments.shape[2]), BLOCK))
        eta_T = np.empty(T.shape[0])
        E = np.empty((fields, BLOCK))
        columns, f, X = np.empty(BLOCK), np.empty(BLOCK), np.empty((tables.along_x.shape[0], BLOCK))
        u, v, bc = np.empty((2, BLOCK)), np.empty((modes, BLOCK)), np.empty((2, BLOCK))
        phi = np.empty((modes, 2, BLOCK))
        sines, cosines = np.empty((waves, BLOCK)), np.empty((waves, BLOCK))
        work, product = np.empty((6, BLOCK)), np.empty(BLOCK)
        row_moments = np.zeros((pairs.shape[0], T.shape[0]))
        for row in range(band * rows // bands, (band + 1) * rows // bands):
            run, last = runs.row_start[row], runs.row_start[row + 1]
            if run == last:
                continue
            eta_T[0], eta_T[1] = 1.0, tables.eta[row]
            for b in range(2, eta_T.size):
                eta_T[b] = 2.0 * eta_T[1] * eta_T[b - 1] - eta_T[b - 2]
            begin = runs.first[run]
            while run < last:
                n = 0
                while n < BLOCK and run < last:
                    length = min(BLOCK - n, runs.stop[run] - begin)
                    _gather(target, row, begin, length, n, tables, f, columns, X)
                    n += length
                    begin += length
                    if begin == runs.stop[run]:
                        run += 1
                        begin = runs.first[run] if run < last else 0
                _chebyshev_block(X[0], n, T)
                for k in range(2):
                    _series_block(tables.v0[k], eta_T, T, n, u[k])
                    _series_block(tables.brightness[k], eta_T, T, n, bc[k])
                for i in range(modes):
                    _series_block(tables.v[i], eta_T, T, n, v[i])
                _modes_block(row, n, tables, X, v, phi, sines, cosines)
                for i in range(modes):
                    for m in range(n):
                        u[0, m] += v[i, m] * phi[i, 0, m]
                        u[1, m] += v[i, m] * phi[i, 1, m]
                left[band] += _model_block(target, row, columns, f, n, u, bc, work, E)
                _base_fields_block(n, tables.waves, phi, sines, cosines, E)
                _brightness_block(n, tables, work, E)
                _moments_block(n, pairs, T, E, product, row_moments)
            _add_row(pairs, row_moments, eta_T, moments[band])
