"""Where pixels land in the deformed image, and what is left there of the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.normal_equations import BANDS, Assembly
from modeharvest.idic.pixel_blocks import (
    AT_COL,
    AT_ROW,
    COLUMN,
    U_X,
    WEIGHT,
    Target,
    displace_block,
    map_block,
    new_block,
    sample_block,
    start_row,
    take_block,
)
from modeharvest.idic.tables import tables_of
from modeharvest.imaging.compiled import compiled, readable, side_by_side
from modeharvest.imaging.interpolation import SplineImage

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def landed(
    assembly: Assembly,
    a: FloatArray,
    reference: NDArray[Any],
    deformed: SplineImage,
    allowed: BoolArray,
) -> tuple[BoolArray, int]:
    """Keep the pixels that the unknowns map onto material of the deformed image.

    Parameters
    ----------
    assembly
        Ansatz and pixels.
    a
        (size,) unknowns.
    reference, deformed
        f and g.
    allowed
        (rows, cols) where g may be sampled.

    Returns
    -------
    kept
        (rows, cols).
    outside
        Number of the others that are mapped outside the deformed image.
    """
    kept = assembly.mask.copy()
    nothing = np.zeros((0, 0, 0), dtype=np.float32)
    outside = _run(assembly, a, reference, deformed, allowed, kept, nothing)
    return kept, outside


def residual(
    assembly: Assembly, a: FloatArray, reference: NDArray[Any], deformed: SplineImage
) -> NDArray[np.float32]:
    """(rows, cols) f - (1 + b) g(x + u) - c; NaN where no pixel counts or g doesn't reach."""
    left = np.full((1, *assembly.grid.shape), np.nan, dtype=np.float32)
    _fill(left, assembly, a, reference, deformed)
    return np.asarray(left[0])


def brought_back(
    assembly: Assembly, a: FloatArray, reference: NDArray[Any], deformed: SplineImage
) -> NDArray[np.float32]:
    """(3, rows, cols) (1 + b) times the gradient of g at x + u, along x and y, and (1 + b) g + c.

    The gradient in [grey levels/mm]; 0, and f, where no pixel counts or g doesn't reach.
    """
    found = np.zeros((3, *assembly.grid.shape), dtype=np.float32)
    _fill(found, assembly, a, reference, deformed)
    np.subtract(reference, found[2], out=found[2])
    return found


def push_forward(assembly: Assembly, a: FloatArray, slopes: NDArray[np.float32]) -> None:
    """Turn slopes at X into those at x = X + u of what moves along: F^-T times them, in place.

    F by central differences of u between neighbouring pixels.

    Parameters
    ----------
    assembly
        Ansatz and grid; pixels beyond those that count are turned, too.
    a
        (size,) unknowns.
    slopes
        (2 or more, rows, cols) along x and y.
    """
    everywhere = Assembly(assembly.ansatz, assembly.grid, np.ones(assembly.grid.shape, np.bool_))
    u = np.zeros((2, *assembly.grid.shape), dtype=np.float32)
    nothing = np.zeros((0, 0), dtype=np.bool_)
    _run(everywhere, a, slopes[0], SplineImage.of(np.zeros((2, 2))), nothing, nothing, u)
    side_by_side(_turn, u, slopes, assembly.grid.pixel_size)


@compiled(relaxed=True)
def _turn(u: Any, slopes: Any, pixel_size: float, first: int, every: int) -> None:
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


def _fill(
    left: NDArray[np.float32],
    assembly: Assembly,
    a: FloatArray,
    reference: NDArray[Any],
    deformed: SplineImage,
) -> None:
    """Fill (1, rows, cols) with the residual, or (3, rows, cols) with slopes and residual."""
    nothing = np.zeros((0, 0), dtype=np.bool_)
    _run(assembly, a, reference, deformed, nothing, nothing, left)


def _run(
    assembly: Assembly,
    a: FloatArray,
    reference: NDArray[Any],
    deformed: SplineImage,
    allowed: BoolArray,
    kept: BoolArray,
    left: NDArray[np.float32],
) -> int:
    ansatz, outside = assembly.ansatz, np.zeros(BANDS, dtype=np.int64)
    tables = tables_of(ansatz, assembly.grid, ansatz.checked(a))
    target = Target.images(reference, deformed, assembly.grid)
    degree = max(ansatz.v0_degree, ansatz.v_degree, *ansatz.brightness.degrees, 1)
    side_by_side(
        _pass, target, assembly.runs, tables, degree, readable(allowed), kept, left, outside
    )
    return int(outside.sum())


@compiled(relaxed=True)
def _pass(
    target: Any, runs: Any, tables: Any, degree: int, allowed: Any, kept: Any, left: Any,
    outside: Any, first: int, every: int,
) -> None:  # fmt: skip
    """Fill ``kept`` from ``allowed``, or else ``left``: one pass, so that it is compiled once.

    ``left`` takes the residual alone, the displacement of whole rows, or slopes and residual.
    """
    rows, per_px, bands = runs.row_start.size - 1, 1.0 / target.pixel_size, outside.size
    for band in range(first, bands, every):
        block = new_block(tables, degree, 3)
        own, E = block.own, block.E
        for row in range(band * rows // bands, (band + 1) * rows // bands):
            run, begin = start_row(runs, tables, row, block)
            while run < runs.row_start[row + 1]:
                n, run, begin = take_block(target, runs, tables, row, run, begin, block)
                displace_block(row, n, tables, block)
                if kept.size:
                    map_block(row, n, per_px, own)
                    outside[band] += _land(n, own, allowed, kept[row])
                elif left.shape[0] == 2:
                    for k in range(2):
                        _place(n, own, own[U_X + k], left[k, row])
                else:
                    sample_block(target, row, n, block)
                    for k in range(left.shape[0]):
                        _put(n, own, E[k + 3 - left.shape[0]], left[k, row])


@compiled(relaxed=True)
def _put(n: int, own: Any, values: Any, to: Any) -> None:
    for m in range(n):
        if own[WEIGHT, m] > 0.0:
            to[int(own[COLUMN, m])] = values[m]


@compiled(relaxed=True)
def _place(n: int, own: Any, values: Any, to: Any) -> None:
    for m in range(n):
        to[int(own[COLUMN, m])] = values[m]


@compiled(relaxed=True)
def _land(n: int, own: Any, allowed: Any, kept: Any) -> int:
    last_row, last_col, outside = allowed.shape[0] - 1, allowed.shape[1] - 1, 0
    for m in range(n):
        row, col = own[AT_ROW, m], own[AT_COL, m]
        inside = 0 <= row <= last_row and 0 <= col <= last_col
        outside += not inside
        kept[int(own[COLUMN, m])] = inside and allowed[int(np.rint(row)), int(np.rint(col))]
    return outside
