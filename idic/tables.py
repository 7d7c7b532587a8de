"""What the compiled passes read: which pixels count, and the ansatz in one-dimensional tables."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.imaging.grid import PixelGrid

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


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


def runs_of(mask: BoolArray) -> Runs:
    """Find the runs of True along the rows of a mask (rows, cols)."""
    edges = np.zeros((mask.shape[0], mask.shape[1] + 1), dtype=np.bool_)
    edges[:, 1:-1] = mask[:, 1:] != mask[:, :-1]
    edges[:, 0], edges[:, -1] = mask[:, 0], mask[:, -1]
    # Where runs begin and end, in turns; of a flat array numpy tells several times faster.
    row, column = np.divmod(np.flatnonzero(edges), edges.shape[1])
    per_row = np.bincount(row[::2], minlength=len(mask))
    limits = column.astype(np.int32)
    return Runs(limits[::2], limits[1::2], np.concatenate([[0], np.cumsum(per_row)]))


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
        eta,
        np.vstack([xi, trig_x, taper_x]),
        v0,
        v,
        ansatz.brightness.squares(a[ansatz.phi_offset(n) :]),
        *ansatz.brightness.fields(first),
        waves,
        np.array(mode_of_wave, dtype=np.int64),
        np.sin(ty),
        np.cos(ty),
        taper_y,
    )
