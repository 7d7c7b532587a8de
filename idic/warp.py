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
) -> BoolArray:
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
    (rows, cols)
        A pixel off the image stays in: the iteration counts those and says so.
    """
    kept = assembly.mask.copy()
    _run(assembly, a, reference, deformed, allowed, kept, np.zeros((0, 0, 0), dtype=np.float32))
    return kept


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
) -> None:
    ansatz = assembly.ansatz
    tables = tables_of(ansatz, assembly.grid, ansatz.checked(a))
    target = Target.images(reference, deformed, assembly.grid)
    degree = max(ansatz.v0_degree, ansatz.v_degree, *ansatz.brightness.degrees, 1)
    side_by_side(_pass, target, assembly.runs, tables, degree, BANDS, readable(allowed), kept, left)


@compiled(relaxed=True)
def _pass(
    target: Any, runs: Any, tables: Any, degree: int, bands: int, allowed: Any, kept: Any,
    left: Any, first: int, every: int,
) -> None:  # fmt: skip
    """Fill ``kept`` from ``allowed``, or else ``left``: one pass, so that it is compiled once."""
    rows, per_px = runs.row_start.size - 1, 1.0 / target.pixel_size
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
                    _land(n, own, allowed, kept[row])
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
def _land(n: int, own: Any, allowed: Any, kept: Any) -> None:
    last_row, last_col = allowed.shape[0] - 1, allowed.shape[1] - 1
    for m in range(n):
        row, col = own[AT_ROW, m], own[AT_COL, m]
        if 0 <= row <= last_row and 0 <= col <= last_col:
            kept[int(own[COLUMN, m])] = allowed[int(np.rint(row)), int(np.rint(col))]
