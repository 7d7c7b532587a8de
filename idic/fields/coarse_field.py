"""A displacement field from two images alone, rough but dense: enough to start a correlation from.

The deformed image is pulled back by what is known already (a slow field through hole centres, say),
and the optical flow that is left is found on binned and blurred images by iterated Lucas–Kanade
windows (scikit-image; Le Besnerais & Champagnat, 2005, doi 10.1109/ICIP.2005.1529706). On the
paper's specimen after buckling half of its points are within 0.6 px of the truth, a tenth are more
than 2 px off, mostly at holes' edges; a subset DIC does better, but needs to be installed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.registration import optical_flow_ilk

from modeharvest.errors import InputError
from modeharvest.idic.fields.local_field import LocalField
from modeharvest.idic.inputs import CheckedImages
from modeharvest.idic.pyramid import Level, Pair, prepare
from modeharvest.imaging.grid import PixelGrid

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Slow = Callable[[FloatArray], FloatArray]
"""From (..., 2) points to (..., 2) displacements [mm]."""

CELL_PX = 48
"""Binned pixels a unit cell: enough to see its pattern, few enough to be quick."""
BLUR = 2.0
"""Of the binned images [binned px]."""
RADIUS = 7
"""Of a window [binned px]."""
WARPS = 8
"""Iterations on each level of the flow's own pyramid."""
STEP = 2
"""Distance of the field's points [binned px]."""
GRAIN = 1e-3
"""Noise added to both images, of their contrast: a window without any texture has no flow at all,
and what it gives instead would spread."""


def coarse_field(
    reference: ArrayLike,
    deformed: ArrayLike,
    grid: PixelGrid,
    cell_size: float,
    known: Slow,
    mask: ArrayLike | None = None,
    deformed_mask: ArrayLike | None = None,
) -> LocalField:
    """Find the displacement between two images roughly, near to what is known of it.

    Parameters
    ----------
    reference, deformed
        (rows, cols) grey levels.
    grid
        Their pixels.
    cell_size
        l [mm]; says what may be blurred away.
    known
        From (..., 2) points to (..., 2) displacements [mm]; what it leaves should be within some
        speckles.
    mask, deformed_mask
        (rows, cols) True on material.

    Returns
    -------
    LocalField
        Points on material alone, without standard deviations.

    Raises
    ------
    InputError
        As :func:`modeharvest.idic.correlate.correlate`, or if the known part leads out of the image
        altogether.
    """
    images = CheckedImages.checked(reference, deformed, grid, mask, deformed_mask)
    factor = max(1, round(cell_size / (CELL_PX * grid.pixel_size)))
    pair = prepare(
        images.f, images.g, grid, images.f_mask, images.g_mask, Level(factor, BLUR), 0, 3,
        levelled=True,
    )  # fmt: skip
    coarse = pair.grid
    points = np.stack(np.broadcast_arrays(coarse.x[None, :], coarse.y[:, None]), axis=-1)
    slow = np.asarray(known(points), dtype=np.float64)
    pulled, seen_in_both = _pulled_back(pair, slow)
    flow = _flow(pair.reference, pulled) * coarse.pixel_size * (1.0, -1.0)
    row, col = (i[::STEP, ::STEP].ravel() for i in np.indices(coarse.shape))
    keep = (pair.mask & seen_in_both)[row, col]
    if not keep.any():
        raise InputError(
            "automatic start: expected the two images to overlap, but what is known of the motion "
            "leads out of the deformed image everywhere; check the hole centres and the masks"
        )
    row, col = row[keep], col[keep]
    x, y = coarse.to_mm(row, col)
    return LocalField(x, y, (slow + flow)[row, col], source="optical flow of the images")


def _pulled_back(pair: Pair, slow: FloatArray) -> tuple[NDArray[Any], BoolArray]:
    """(rows, cols) g at x + slow, the reference where that is outside; and where it is inside."""
    grid = pair.grid
    row, col = np.indices(grid.shape)
    to_row, to_col = row - slow[..., 1] / grid.pixel_size, col + slow[..., 0] / grid.pixel_size
    value, _, _ = pair.deformed.sample(to_row, to_col)
    inside = np.isfinite(value)
    return np.where(inside, value, pair.reference), inside


def _flow(reference: NDArray[Any], deformed: NDArray[Any]) -> FloatArray:
    """(rows, cols, 2) displacement along columns and rows [px]."""
    rng = np.random.default_rng(0)
    grain = GRAIN * float(reference.std())
    f, g = (np.float64(i) + grain * rng.standard_normal(i.shape) for i in (reference, deformed))
    down, right = optical_flow_ilk(  # type: ignore[no-untyped-call]
        f, g, radius=RADIUS, num_warp=WARPS, gaussian=True, prefilter=False, dtype=np.float64
    )
    return np.stack([right, down], axis=-1)
