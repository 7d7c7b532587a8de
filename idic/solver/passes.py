"""Compiled passes over all pixels: moments for the normal equations, residuals, warped positions.

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

The deformed image is taken at x + u. About 250 multiply-adds per pixel are needed for 77 unknowns,
3 000 for the Jacobian's product, 60 for J'r alone. The rows are divided into a fixed number of
bands whose sums are added in order, so the result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.solver.pixel_blocks import (
    AT_COL,
    AT_ROW,
    BLOCK,
    COLUMN,
    U_X,
    WEIGHT,
    G,
    copy_block,
    displace_block,
    map_block,
    new_block,
    sample_block,
    start_row,
    take_block,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.compiled import compiled


@compiled(relaxed=True)
def push_forward_rows(u: Any, slopes: Any, pixel_size: float, first: int, every: int) -> None:
    """Multiply slopes (2, rows, cols) by F^-T, F by central differences of u, on some rows."""
    rows, cols = u.shape[1:]
    for i in range(first, rows, every):
        up, down = max(0, i - 1), min(rows - 1, i + 1)
        per_y = 1.0 / (pixel_size * max(1, down - up))
        for j in range(cols):
            left, right = max(0, j - 1), min(cols - 1, j + 1)
            per_x = 1.0 / (pixel_size * max(1, right - left))
            xx = 1.0 + (u[0, i, right] - u[0, i, left]) * per_x
            yx = (u[1, i, right] - u[1, i, left]) * per_x
            xy = (u[0, up, j] - u[0, down, j]) * per_y
            yy = 1.0 + (u[1, up, j] - u[1, down, j]) * per_y
            det = xx * yy - xy * yx
            if det > 0.0:
                s_x, s_y = slopes[0, i, j], slopes[1, i, j]
                slopes[0, i, j] = (yy * s_x - yx * s_y) / det
                slopes[1, i, j] = (xx * s_y - xy * s_x) / det


class Runs(NamedTuple):
    """The pixels that count, as runs of neighbours along the rows."""

    first: NDArray[Any]
    stop: NDArray[Any]
    """(runs,) column of the first pixel of each and of the one after its last, row after row."""
    row_start: NDArray[Any]
    """(rows + 1,) number of the first run of each row."""

    @property
    def pixels(self) -> int:
        """Number of pixels that count."""
        return int((self.stop - self.first).sum())

    def within(self, top: int, left: int, side: int) -> Runs:
        """The pixels that lie in a square block; some runs become empty."""
        begin, end = self.row_start[[top, min(top + side, len(self.row_start) - 1)]]
        first, stop = (np.clip(k[begin:end], left, left + side) for k in (self.first, self.stop))
        return Runs(first, stop, np.clip(self.row_start, begin, end) - begin)


class Tables(NamedTuple):
    """The ansatz at some unknowns, as one-dimensional tables along the rows and columns."""

    eta: NDArray[Any]
    """(rows,): normalised coordinate."""
    along_x: NDArray[Any]
    """(1 + 2 w + n, cols): xi, for each wave sin and cos of pi/l kx x, for each mode s tau_x."""
    v0: NDArray[Any]
    v: NDArray[Any]
    """(2, D0 + 1, D0 + 1) and (n, D + 1, D + 1): Chebyshev coefficients [i, j] [mm]."""
    brightness: NDArray[Any]
    """(2, D + 1, D + 1): coefficients of the gain b [-] and of the offset c [grey levels]."""
    gain_field: int
    offset_field: int
    """Numbers of the base fields of gain and offset; 0 where they are not unknowns."""
    waves: NDArray[Any]
    mode_of_wave: NDArray[Any]
    """(w, 6): A, B, kx, ky, c, pi/l; (w,): the mode each belongs to."""
    sin_y: NDArray[Any]
    cos_y: NDArray[Any]
    """(w, rows) sine and cosine of pi/l (ky y + c)."""
    taper_y: NDArray[Any]
    """(n, rows) tau_y."""


def runs_of(mask: BoolArray) -> Runs:
    """Find the runs of True along the rows of a mask (rows, cols)."""
    edges = np.zeros((mask.shape[0], mask.shape[1] + 1), dtype=np.bool_)
    edges[:, 1:-1] = mask[:, 1:] != mask[:, :-1]
    edges[:, 0], edges[:, -1] = mask[:, 0], mask[:, -1]
    # Where runs begin and end, in turns; of a flat array numpy tells several times faster.
    row, column = np.divmod(np.flatnonzero(edges), edges.shape[1])
    per_row = np.bincount(row[::2], minlength=len(mask))
    # Contiguous, as no or one run would be without: kernels are compiled for either.
    first, stop = (np.ascontiguousarray(column[k::2], np.int32) for k in (0, 1))
    return Runs(first, stop, np.concatenate([[0], np.cumsum(per_row)]))


def tables_of(ansatz: Ansatz, grid: PixelGrid, a: FloatArray) -> Tables:
    """Make the tables of an ansatz at the unknowns ``a`` (size,)."""
    v0 = np.stack([ansatz.v0_space.square(a[ansatz.v0_slice(c)]) for c in (0, 1)])
    n, d = len(ansatz.modes), ansatz.v_degree + 1
    v, waves, mode_of_wave = np.zeros((n, d, d)), np.zeros((0, 6)), []
    taper_x, taper_y = np.zeros((n, grid.cols)), np.zeros((n, grid.rows))
    for i, mode in enumerate(ansatz.modes):
        v[i] = ansatz.v_space.square(a[ansatz.v_slice(i)])
        own = mode.family.waves(a[ansatz.phi_slice(i)])
        per_mm = np.full((len(own), 1), np.pi / mode.half_wavelength)
        waves = np.vstack([waves, np.hstack([own, per_mm])])
        mode_of_wave += [i] * len(own)
        taper_x[i] = mode.scale * mode.taper.along_x(grid.x)
        taper_y[i] = mode.taper.along_y(grid.y)
    tx = waves[:, 5:] * waves[:, 2:3] * grid.x
    ty = waves[:, 5:] * (waves[:, 3:4] * grid.y + waves[:, 4:5])
    xi, eta = ansatz.domain.normalised(grid.x, grid.y)
    trig_x = np.stack([np.sin(tx), np.cos(tx)], axis=1).reshape(-1, grid.cols)
    first = 2 + n + 3 * len(waves)
    return Tables(
        eta, np.vstack([xi, trig_x, taper_x]), v0, v,
        ansatz.brightness.squares(a[ansatz.phi_offset(n) :]), *ansatz.brightness.fields(first),
        waves, np.array(mode_of_wave, dtype=np.int64), np.sin(ty), np.cos(ty), taper_y,
    )  # fmt: skip


@compiled(inner=True, relaxed=True)
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


@compiled(inner=True, relaxed=True)
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


@compiled(inner=True, relaxed=True)
def _add_row(pairs: Any, row_moments: Any, eta_T: Any, moments: Any) -> None:
    """Multiply the moments of a row by T_b(eta) of that row, and add them."""
    for p in range(pairs.shape[0]):
        degree = pairs[p, 2]
        for a in range(degree + 1):
            value = row_moments[p, a]
            row_moments[p, a] = 0.0
            for b in range(degree - a + 1):
                moments[p, a, b] += value * eta_T[b]


_NOWHERE = np.zeros((0, 0), dtype=np.bool_)


class Warped(NamedTuple):
    """Output of a pass for each pixel, in place of moments; arrays that aren't wanted are empty.

    ``valid`` (rows, cols) is where g may be sampled. ``kept`` (rows, cols) is filled with whether a
    pixel is mapped there, and ``fields`` (k, rows, cols) with the residual if k is 1, u if it is 2,
    slopes and residual if it is 3.
    """

    valid: NDArray[Any] = _NOWHERE
    kept: NDArray[Any] = _NOWHERE
    fields: NDArray[Any] = np.zeros((0, 0, 0), dtype=np.float32)


@compiled(inner=True, relaxed=True)
def _mark_valid(n: int, own: Any, valid: Any, kept: Any) -> int:
    last_row, last_col, outside = valid.shape[0] - 1, valid.shape[1] - 1, 0
    for m in range(n):
        row, col = own[AT_ROW, m], own[AT_COL, m]
        inside = 0 <= row <= last_row and 0 <= col <= last_col
        outside += not inside
        kept[int(own[COLUMN, m])] = inside and valid[int(np.rint(row)), int(np.rint(col))]
    return outside


@compiled(inner=True, relaxed=True)
def _leave_block(row: int, n: int, own: Any, E: Any, fields: Any) -> None:
    """Fill rows of the output fields: the components of u if these are two, else the last of E."""
    for k in range(fields.shape[0]):
        values = own[U_X + k] if fields.shape[0] == 2 else E[k + 3 - fields.shape[0]]
        for m in range(n):
            if fields.shape[0] == 2 or own[WEIGHT, m] > 0.0:
                fields[k, row, int(own[COLUMN, m])] = values[m]


@compiled(relaxed=True)
def accumulate(
    target: Any, runs: Any, tables: Any, pairs: Any, fields: int, moments: Any, outside: Any,
    warped: Any, first: int, every: int,
) -> None:  # fmt: skip
    """Sum the moments of pairs of base fields over the pixels of some bands of rows.

    target, runs, tables : :class:`Target`, :class:`Runs` and :class:`Tables`.
    pairs : (pairs, 3): numbers of two base fields and the sum of their degrees.
    fields : Number of base fields.
    moments, outside : (bands, pairs, K + 1, K + 1) sums of each band of rows, and (bands,) how
        many pixels are mapped outside the image; both zero on entry.
    warped : :class:`Warped`, to be filled instead if it isn't empty, by the same compiled pass.
    first, every : The bands to sum: each ``every``-th from ``first`` on.
    """
    rows, bands = runs.row_start.size - 1, moments.shape[0]
    for band in range(first, bands, every):
        block = new_block(tables, max(1, moments.shape[2] - 1), fields)
        own, E, product = block.own, block.E, np.empty(BLOCK)
        row_moments = np.zeros((pairs.shape[0], moments.shape[2]))
        for row in range(band * rows // bands, (band + 1) * rows // bands):
            if runs.row_start[row] == runs.row_start[row + 1]:
                continue
            run, begin = start_row(runs, tables, row, block)
            while run < runs.row_start[row + 1]:
                n, run, begin = take_block(target, runs, tables, row, run, begin, block)
                displace_block(row, n, tables, block)
                if warped.kept.size:
                    map_block(row, n, 1.0 / target.pixel_size, own)
                    outside[band] += _mark_valid(n, own, warped.valid, warped.kept[row])
                elif warped.fields.shape[0] == 2:
                    _leave_block(row, n, own, E, warped.fields)
                else:
                    outside[band] += sample_block(target, row, n, block)
                    if warped.fields.size:
                        _leave_block(row, n, own, E, warped.fields)
                    else:
                        _base_fields_block(n, tables, block)
                        _moments_block(n, pairs, block.T, E, product, row_moments)
            _add_row(pairs, row_moments, block.eta_T, moments[band])
