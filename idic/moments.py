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
Jacobian's product needs 3 000; J'r alone needs 60. The rows are dealt to a fixed number of
bands whose sums are added in order, so the result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from modeharvest.idic.pixel_blocks import (
    BLOCK,
    WEIGHT,
    G,
    copy_block,
    displace_block,
    new_block,
    sample_block,
    start_row,
    take_block,
)
from modeharvest.imaging.compiled import compiled


@compiled(relaxed=True)
def _base_fields_block(n: int, tables: Any, block: Any) -> None:
    """Fill the base fields between the gradient and the residual."""
    E, modes, waves = block.E, block.modes, tables.waves
    gx, gy = E[0], E[1]
    for i in range(modes.shape[0]):
        e, phi_x, phi_y = E[2 + i], modes[i, 0], modes[i, 1]
        for m in range(n):
            e[m] = phi_x[m] * gx[m] + phi_y[m] * gy[m]
    for w in range(waves.shape[0]):
        k = 2 + modes.shape[0] + 3 * w
        A, B, sine, cosine = waves[w, 0], waves[w, 1], block.waves[w, 0], block.waves[w, 1]
        e0, e1, e2 = E[k], E[k + 1], E[k + 2]
        for m in range(n):
            e0[m] = sine[m] * gx[m]
            e1[m] = sine[m] * gy[m]
            e2[m] = cosine[m] * (A * gx[m] + B * gy[m])
    if tables.gain_field:
        copy_block(block.own[G], n, E[tables.gain_field])
    if tables.offset_field:
        copy_block(block.own[WEIGHT], n, E[tables.offset_field])


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
def accumulate(
    target: Any, runs: Any, tables: Any, pairs: Any, fields: int, moments: Any, left: Any,
    first: int, every: int,
) -> None:  # fmt: skip
    """Sum the moments of pairs of base fields over the pixels of some bands of rows.

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
    first, every
        The bands to look at: each ``every``-th from ``first`` on.
    """
    rows, bands = runs.row_start.size - 1, moments.shape[0]
    for band in range(first, bands, every):
        block = new_block(tables, max(1, moments.shape[2] - 1), fields)
        product = np.empty(BLOCK)
        row_moments = np.zeros((pairs.shape[0], moments.shape[2]))
        for row in range(band * rows // bands, (band + 1) * rows // bands):
            run, begin = start_row(runs, tables, row, block)
            while run < runs.row_start[row + 1]:
                n, run, begin = take_block(target, runs, tables, row, run, begin, block)
                displace_block(row, n, tables, block)
                left[band] += sample_block(target, row, n, block)
                _base_fields_block(n, tables, block)
                _moments_block(n, pairs, block.T, block.E, product, row_moments)
            _add_row(pairs, row_moments, block.eta_T, moments[band])
