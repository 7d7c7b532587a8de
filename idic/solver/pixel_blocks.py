"""Compiled evaluation of ansatz and images over blocks of pixels.

The pixels of a row that count are gathered in blocks that stay in the first cache. A pass looks
like this, for each band of rows in parallel::

    block = new_block(tables, degree, fields)
    for row in rows_of_band:
        run, begin = start_row(runs, tables, row, block)
        while run < runs.row_start[row + 1]:
            n, run, begin = take_block(target, runs, tables, row, run, begin, block)
            displace_block(row, n, tables, block)
            sample_block(target, row, n, block)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.spline import SplineImage, sample_points
from modeharvest.util.compiled import compiled, readable

BLOCK = 256
"""Pixels gathered at a time."""


class Target(NamedTuple):
    """What the ansatz is fitted to: a pair of images, or one component of a displacement."""

    component: int
    """IMAGES: residual f - (1 + b) g(x + u) - c. 0 or 1: residual ``displacement`` - u_x or u_y,
    and (1, 0) or (0, 1) in place of the gradient."""
    reference: NDArray[Any]
    """(rows, cols) f; unused for a displacement."""
    coefficients: NDArray[Any]
    order: int
    """Spline of g."""
    displacement: NDArray[Any]
    """(rows, cols) [mm]; unused for images."""
    instrument: NDArray[Any]
    """(3, rows, cols) weights in place of (1 + b) times the gradient of g at x + u, along x and y
    [grey levels/mm], and of g there; (3, 0, 0) for these themselves."""
    share: float
    """Share of the instrument in the weights; the rest is g's own [-]."""
    pixel_size: float
    """[mm/px]."""

    @classmethod
    def images(
        cls,
        reference: NDArray[Any],
        deformed: SplineImage,
        grid: PixelGrid,
        instrument: NDArray[Any] | None = None,
        share: float = 1.0,
    ) -> Target:
        """A pair of images."""
        f, nothing = readable(reference), readable(np.zeros((0, 0)))
        given = readable(NO_INSTRUMENT if instrument is None else instrument)
        spline = deformed.coefficients, deformed.order
        return cls(IMAGES, f, *spline, nothing, given, share, grid.pixel_size)

    @classmethod
    def along(cls, component: int, displacement: NDArray[Any], grid: PixelGrid) -> Target:
        """One component of a displacement (rows, cols) [mm]: 0 for u_x, 1 for u_y."""
        nothing, none = np.zeros((0, 0), dtype=np.float32), readable(NO_INSTRUMENT)
        u = readable(displacement)
        return cls(component, readable(nothing), nothing, 5, u, none, 1.0, grid.pixel_size)


IMAGES = -1
"""``component`` of a pair of images."""
NO_INSTRUMENT = np.zeros((3, 0, 0), dtype=np.float32)
"""``instrument`` where the deformed image itself weighs the residual."""

COLUMN, KNOWN, U_X, U_Y, GAIN, OFFSET, AT_ROW, AT_COL, G, D_ROW, D_COL, WEIGHT = range(12)
INSTRUMENT = 12
"""Rows of :class:`Block`'s ``own``."""


class PixelBlock(NamedTuple):
    """Some pixels of a row, and results of the passes for them; the last axis is the pixels'.

    Few arrays with numbered rows, because the compiler counts references to each of them.
    """

    own: NDArray[Any]
    """(15, BLOCK): column [px]; f, or the known displacement; u_x, u_y [mm]; b [-] and c [grey
    levels]; x + u as row and column [px]; g there and its derivatives; 1, or 0 outside g; the three
    of the instrument."""
    along_x: NDArray[Any]
    """(1 + 2 w + n, BLOCK): the tables' ``along_x``."""
    T: NDArray[Any]
    eta_T: NDArray[Any]
    """(K + 1, BLOCK) T_a(xi); (K + 1,) T_b(eta) of the row."""
    modes: NDArray[Any]
    """(n, 3, BLOCK): phi_x, phi_y [-] and v [mm] of each."""
    waves: NDArray[Any]
    """(w, 2, BLOCK): S sin theta and S cos theta pi/l of each."""
    E: NDArray[Any]
    """(fields, BLOCK) base fields: gx and gy first, the residual last."""


@compiled(inner=True, relaxed=True)
def new_block(tables: Any, degree: int, fields: int) -> PixelBlock:
    """Make room for a block, with Chebyshev polynomials up to a degree of at least 1."""
    n, w = tables.v.shape[0], tables.waves.shape[0]
    return PixelBlock(
        np.zeros((15, BLOCK)), np.empty((tables.along_x.shape[0], BLOCK)),
        np.empty((degree + 1, BLOCK)), np.empty(degree + 1),
        np.empty((n, 3, BLOCK)), np.empty((w, 2, BLOCK)), np.empty((fields, BLOCK)),
    )  # fmt: skip


@compiled(inline=True, relaxed=True)
def start_row(runs: Any, tables: Any, row: int, block: Any) -> tuple[int, int]:
    """Fill T_b(eta) of a row; returns its first run's number and the column where that begins."""
    eta_T, run = block.eta_T, runs.row_start[row]
    eta_T[0], eta_T[1] = 1.0, tables.eta[row]
    for b in range(2, eta_T.size):
        eta_T[b] = 2.0 * eta_T[1] * eta_T[b - 1] - eta_T[b - 2]
    return run, (runs.first[run] if run < runs.first.size else 0)


@compiled(inline=True, relaxed=True)
def take_block(
    target: Any, runs: Any, tables: Any, row: int, run: int, begin: int, block: Any
) -> tuple[int, int, int]:
    """Gather the next pixels of a row; returns how many, and where the rest begins."""
    n, last = 0, runs.row_start[row + 1]
    while n < BLOCK and run < last:
        length = min(BLOCK - n, runs.stop[run] - begin)
        _gather(target, row, begin, length, n, tables, block)
        n += length
        begin += length
        if begin == runs.stop[run]:
            run += 1
            begin = runs.first[run] if run < last else 0
    return n, run, begin


@compiled(inline=True, relaxed=True)
def _gather(target: Any, row: int, first: int, n: int, at: int, tables: Any, block: Any) -> None:
    """Append a run to a block, from its place ``at`` on.

    Runs are copied rather than pixels picked one by one, because that is vectorised.
    """
    # Through views whose indices begin at 0: others might be negative for all the compiler knows.
    column, known = block.own[COLUMN, at : at + n], block.own[KNOWN, at : at + n]
    for m in range(n):
        column[m] = first + m
    if target.component >= 0:
        copy_block(target.displacement[row, first : first + n], n, known)
    else:
        copy_block(target.reference[row, first : first + n], n, known)
    if target.instrument.shape[1]:
        for k in range(3):
            given = block.own[INSTRUMENT + k, at : at + n]
            copy_block(target.instrument[k, row, first : first + n], n, given)
    for k in range(block.along_x.shape[0]):
        copy_block(tables.along_x[k, first : first + n], n, block.along_x[k, at : at + n])


@compiled(inline=True, relaxed=True)
def copy_block(values: Any, n: int, to: Any) -> None:
    """Copy the first n values."""
    for m in range(n):
        to[m] = values[m]


@compiled(inline=True, relaxed=True)
def displace_block(row: int, n: int, tables: Any, block: Any) -> None:
    """Fill the displacement, the amplitudes, the modes and the brightness of a block."""
    own, T, eta_T, modes = block.own, block.T, block.eta_T, block.modes
    _chebyshev_block(block.along_x[0], n, T)
    for k in range(2):
        _series_block(tables.v0[k], eta_T, T, n, own[U_X + k])
        if tables.gain_field or tables.offset_field:
            _series_block(tables.brightness[k], eta_T, T, n, own[GAIN + k])
    for i in range(modes.shape[0]):
        _series_block(tables.v[i], eta_T, T, n, modes[i, 2])
    _modes_block(row, n, tables, block.along_x, modes, block.waves)
    for i in range(modes.shape[0]):
        v = modes[i, 2]
        for k in range(2):
            u, phi = own[U_X + k], modes[i, k]
            for m in range(n):
                u[m] += v[m] * phi[m]


@compiled(inner=True, relaxed=True)
def _chebyshev_block(xi: Any, n: int, T: Any) -> None:
    """T_0 ... T_K along the block."""
    for m in range(n):
        T[0, m] = 1.0
        T[1, m] = xi[m]
    for a in range(2, T.shape[0]):
        for m in range(n):
            T[a, m] = 2.0 * T[1, m] * T[a - 1, m] - T[a - 2, m]


@compiled(inner=True, relaxed=True)
def _series_block(C: Any, eta_T: Any, T: Any, n: int, out: Any) -> None:
    """Sum C[a, b] T_a(xi) T_b(eta) along the block; eta_T holds T_b of the row."""
    degree = C.shape[0] - 1
    for m in range(n):
        out[m] = 0.0
    a = 0
    while a + 2 <= degree:  # three terms a time: less to read and write
        T0, T1, T2 = T[a], T[a + 1], T[a + 2]
        c0, c1 = _along(C[a], eta_T, degree - a), _along(C[a + 1], eta_T, degree - a - 1)
        c2 = _along(C[a + 2], eta_T, degree - a - 2)
        for m in range(n):
            out[m] += c0 * T0[m] + c1 * T1[m] + c2 * T2[m]
        a += 3
    while a <= degree:
        T0, c0 = T[a], _along(C[a], eta_T, degree - a)
        for m in range(n):
            out[m] += c0 * T0[m]
        a += 1


@compiled(inline=True, relaxed=True)
def _along(C: Any, eta_T: Any, degree: int) -> float:
    """Sum C[b] T_b(eta) of the row."""
    total = 0.0
    for b in range(degree + 1):
        total += C[b] * eta_T[b]
    return total


@compiled(inner=True, relaxed=True)
def _modes_block(row: int, n: int, tables: Any, X: Any, modes: Any, waves: Any) -> None:
    """phi_i, S sin theta_w and S cos theta_w pi/l along the block, from one-dimensional tables."""
    count = waves.shape[0]
    for i in range(modes.shape[0]):
        phi_x, phi_y = modes[i, 0], modes[i, 1]
        for m in range(n):
            phi_x[m] = phi_y[m] = 0.0
    for w in range(count):
        i = tables.mode_of_wave[w]
        A, B, per_mm = tables.waves[w, 0], tables.waves[w, 1], tables.waves[w, 5]
        tau_y = tables.taper_y[i, row]
        sy, cy = tau_y * tables.sin_y[w, row], tau_y * tables.cos_y[w, row]
        sin_x, cos_x, tau_x = X[1 + 2 * w], X[2 + 2 * w], X[1 + 2 * count + i]
        sine, cosine = waves[w, 0], waves[w, 1]
        phi_x, phi_y, v_i = modes[i, 0], modes[i, 1], modes[i, 2]
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


@compiled(inline=True, relaxed=True)
def map_block(row: int, n: int, per_px: float, own: Any) -> None:
    """Fill x + u [px]."""
    column, u_x, u_y, at_row, at_col = own[COLUMN], own[U_X], own[U_Y], own[AT_ROW], own[AT_COL]
    for m in range(n):
        at_row[m] = row - u_y[m] * per_px
        at_col[m] = column[m] + u_x[m] * per_px


@compiled(inline=True, relaxed=True)
def sample_block(target: Any, row: int, n: int, block: Any) -> int:
    """Fill the gradient and the residual of a block; returns how many pixels left the image.

    A pixel that leaves the image gets zeros, and so takes no part in any sum.
    """
    own, E = block.own, block.E
    g_x, g_y, residual = E[0], E[1], E[E.shape[0] - 1]
    known, g, weight = own[KNOWN], own[G], own[WEIGHT]
    if target.component >= 0:
        u = own[U_X + target.component]
        for m in range(n):
            g_x[m], g_y[m] = 1.0 - target.component, target.component
            g[m] = weight[m] = 0.0
            residual[m] = known[m] - u[m]
        return 0
    per_px = 1.0 / target.pixel_size
    at_row, at_col, d_row, d_col = own[AT_ROW], own[AT_COL], own[D_ROW], own[D_COL]
    map_block(row, n, per_px, own)
    sample_points(target.coefficients, target.order, at_row, at_col, n, g, d_row, d_col)
    b, c = own[GAIN], own[OFFSET]
    # Short loops without branches, with few arrays each: those become vectors.
    inside = 0.0
    for m in range(n):
        weight[m] = 0.0 if np.isnan(g[m]) else 1.0
        inside += weight[m]
    off = n - int(inside)
    if off > 0:
        for m in range(n):
            if weight[m] == 0.0:
                g[m] = d_row[m] = d_col[m] = 0.0
    for m in range(n):
        g_x[m] = (per_px + per_px * b[m]) * d_col[m]
    for m in range(n):
        g_y[m] = -(per_px + per_px * b[m]) * d_row[m]
    for m in range(n):
        residual[m] = (known[m] - c[m]) * weight[m] - (1.0 + b[m]) * g[m]
    if target.instrument.shape[1]:
        for k in range(3):
            given, to, share = own[INSTRUMENT + k], (E[k] if k < 2 else g), target.share
            for m in range(n):
                to[m] = weight[m] * (share * given[m] + (1.0 - share) * to[m])
    return off
