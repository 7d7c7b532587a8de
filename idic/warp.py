"""Where pixels land in the deformed image, and what is left there of the reference."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from modeharvest.idic.normal_equations import Assembly
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
from modeharvest.imaging.compiled import compiled
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
    target = Target.images(reference, deformed, assembly.grid)
    kernel: Callable[..., None] = _land
    kernel(target, assembly.runs, _tables(assembly, a), _degree(assembly), allowed, kept)
    return kept


def residual(
    assembly: Assembly, a: FloatArray, reference: NDArray[Any], deformed: SplineImage
) -> NDArray[np.float32]:
    """(rows, cols) f - (1 + b) g(x + u) - c; NaN where no pixel counts or g doesn't reach."""
    left = np.full(assembly.grid.shape, np.nan, dtype=np.float32)
    target = Target.images(reference, deformed, assembly.grid)
    kernel: Callable[..., None] = _subtract
    kernel(target, assembly.runs, _tables(assembly, a), _degree(assembly), left)
    return left


def _tables(assembly: Assembly, a: FloatArray) -> Any:
    return tables_of(assembly.ansatz, assembly.grid, assembly.ansatz.checked(a))


def _degree(assembly: Assembly) -> int:
    ansatz = assembly.ansatz
    return max(ansatz.v0_degree, ansatz.v_degree, *ansatz.brightness.degrees, 1)


@compiled(parallel=True, relaxed=True)
def _land(target: Any, runs: Any, tables: Any, degree: int, allowed: Any, kept: Any) -> None:
    rows, cols = kept.shape
    per_px = 1.0 / target.pixel_size
    for row in prange(rows):
        block = new_block(tables, degree, 3)
        own = block.own
        run, begin = start_row(runs, tables, row, block)
        while run < runs.row_start[row + 1]:
            n, run, begin = take_block(target, runs, tables, row, run, begin, block)
            displace_block(row, n, tables, block)
            map_block(row, n, per_px, own)
            for m in range(n):
                i, j = int(np.rint(own[AT_ROW, m])), int(np.rint(own[AT_COL, m]))
                if 0 <= i < rows and 0 <= j < cols:
                    kept[row, int(own[COLUMN, m])] = allowed[i, j]


@compiled(parallel=True, relaxed=True)
def _subtract(target: Any, runs: Any, tables: Any, degree: int, left: Any) -> None:
    for row in prange(left.shape[0]):
        block = new_block(tables, degree, 3)
        run, begin = start_row(runs, tables, row, block)
        while run < runs.row_start[row + 1]:
            n, run, begin = take_block(target, runs, tables, row, run, begin, block)
            displace_block(row, n, tables, block)
            sample_block(target, row, n, block)
            for m in range(n):
                if block.own[WEIGHT, m] > 0.0:
                    left[row, int(block.own[COLUMN, m])] = block.E[2, m]
