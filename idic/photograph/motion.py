"""Motion before any correlation: from hole centres, outlines or optical flow, by robust fits.

Optical flow: the deformed image is pulled back by what is known already (a slow field through
hole centres, say), and the optical flow that is left is found on binned and blurred images by
iterated Lucas–Kanade windows (scikit-image; Le Besnerais & Champagnat, 2005, doi
10.1109/ICIP.2005.1529706). On the paper's specimen after buckling half of its points are within
0.6 px of the truth, a tenth are more than 2 px off, mostly at holes' edges; a subset DIC does
better, but needs to be installed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.registration import optical_flow_ilk

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.pair import CheckedImages
from modeharvest.idic.slow_fields import Box
from modeharvest.idic.solver.pyramid import Level, LevelPair, level_pair
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError

HUBER = 1.345
"""Residual beyond which a point counts less [standard deviations]; 95 % efficient for normal
errors (Huber, 1964, doi 10.1214/aoms/1177703732)."""
SET_ASIDE = 5.0
"""Residual beyond which a point is called an outlier [standard deviations]."""
MOST_POINTS = 6000
"""Points of a field that are used; more would not make a start better."""
_ROUNDS = 30


@dataclass(frozen=True, eq=False)
class RobustFit:
    """Coefficients, and how well they fit.

    Parameters
    ----------
    coefficients
        (c,) or as the unknowns of the ansatz.
    sd
        Robust standard deviation of a component that is left (1.4826 times the median) [mm].
    outliers
        Number of points more than 5 of these off.
    """

    coefficients: FloatArray
    sd: float
    outliers: int


def robust_fit(matrix: FloatArray, values: FloatArray) -> RobustFit:
    """Fit linear unknowns so that stray points hardly count (Huber's weights, iterated).

    Parameters
    ----------
    matrix
        (n, c) with n > c.
    values
        (n,) what matrix times coefficients should be [mm].
    """
    weights = np.ones(len(values))
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)
        fit = np.linalg.lstsq(matrix * root[:, None], values * root, rcond=1e-10)[0]
        off = np.abs(values - matrix @ fit)
        sd = 1.4826 * float(np.median(off))
        if sd <= 1e-12 * float(np.abs(values).max(initial=1e-300)):
            break
        before, weights = weights, np.minimum(1.0, HUBER * sd / np.maximum(off, 1e-300))
        if np.abs(weights - before).max() < 1e-3:
            break
    return RobustFit(fit, sd, int((off > SET_ASIDE * sd).sum()) if sd > 0 else 0)


def degree_for(count: int, most: int) -> int:
    """Total degree of a slow field that so many points can bear: three points a coefficient."""
    fitting = [d for d in range(1, most + 1) if 3 * (d + 1) * (d + 2) // 2 <= count]
    return max(fitting, default=0)


def fit_unknowns(
    ansatz: Ansatz, a: ArrayLike, points: FloatArray, u: FloatArray, v0_degree: int, v_degree: int
) -> RobustFit:
    """Fit v0, and every v_i, to displacements at points; the modes stay as they are.

    Parameters
    ----------
    ansatz
        The kinematics.
    a
        (size,) unknowns, of which the modes' parameters are taken.
    points, u
        (n, 2) positions and displacements [mm].
    v0_degree, v_degree
        Total degrees that are fitted, at most those of the ansatz; the rest is zero. A negative
        ``v_degree`` leaves every v_i as it is in ``a``.
    """
    a = ansatz.checked(a).copy()
    stride = max(1, -(-len(points) // MOST_POINTS))
    points, u = points[::stride], u[::stride]
    free = _low_orders(ansatz, v0_degree, v_degree)
    if 2 * len(points) < free.size:
        raise InputError(
            f"automatic start: expected at least {-(-free.size // 2)} points, got {len(points)}"
        )
    columns = ansatz.sensitivities(a, points[:, None, 0], points[:, None, 1])[..., free]
    held = a.copy()
    held[free] = 0.0
    rest = u - ansatz.displacement_at(held, points)
    fit = robust_fit(columns.reshape(-1, free.size), rest.ravel())
    held[free] = fit.coefficients
    return RobustFit(held, fit.sd, fit.outliers)


def _low_orders(ansatz: Ansatz, v0_degree: int, v_degree: int) -> NDArray[np.intp]:
    """Where v0 and v_i up to these degrees are among the unknowns."""
    low0 = [k for k, (i, j) in enumerate(ansatz.v0_space.orders) if i + j <= v0_degree]
    low = [k for k, (i, j) in enumerate(ansatz.v_space.orders) if i + j <= v_degree]
    places = [ansatz.v0_slice(c).start + k for c in (0, 1) for k in low0]
    places += [ansatz.v_slice(m).start + k for m in range(len(ansatz.modes)) for k in low]
    return np.array(places, dtype=np.intp)


SLOW_DEGREE = 3
"""Total degree of v0 at the start, at most: what bends and barrels, but doesn't follow cells."""
WRONG_CELL = 0.07
"""Relative difference of a cell size given from one found, beyond which they contradict each
other: over the paper's six cells the phase of its mode drifts by 1.3 rad, and a correlation may
settle in a local minimum. A measured field's peaks are known to a few hundredths."""
_FEWEST_HOLES = 4
_SMALLEST_HOLE = 0.01
"""Area of a hole [cells] below which it is a speck in the mask."""


def first_motion(
    domain: Box,
    grid: PixelGrid,
    mask: BoolArray | None,
    deformed_mask: BoolArray | None,
    holes: tuple[ArrayLike, ArrayLike] | None,
) -> tuple[Slow, str]:
    """Find the slow motion from what the images' geometry shows.

    Parameters
    ----------
    domain
        Of the polynomial [mm].
    grid
        The pixels.
    mask, deformed_mask
        (rows, cols) True on material.
    holes
        (n, 2) hole centres in the reference and (n, 2) their displacements [mm]; NaN where lost.

    Returns
    -------
    From (..., 2) points to (..., 2) displacements [mm], and a sentence.
    """
    if holes is not None:
        found = _through_holes(domain, *holes)
        if found is not None:
            return found
    affine = None
    if mask is not None and deformed_mask is not None:
        affine = outline_motion(mask, deformed_mask, grid)
    if affine is None:
        return (
            np.zeros_like,
            "v0 starts from no motion: neither holes nor whole outlines are known.",
        )
    plane = affine
    return lambda points: plane[:, 0] + points @ plane[:, 1:].T, (
        f"v0 starts from the outlines: {100 * affine[0, 1]:+.1f} % along x and "
        f"{100 * affine[1, 2]:+.1f} % along y."
    )


def _through_holes(domain: Box, centres: ArrayLike, motion: ArrayLike) -> tuple[Slow, str] | None:
    """A polynomial through the holes' displacements; None if there are too few for a plane."""
    points, u = (np.asarray(h, dtype=np.float64) for h in (centres, motion))
    if points.ndim != 2 or points.shape[1:] != (2,) or u.shape != points.shape:
        raise InputError(
            "automatic start: expected hole centres (n, 2) and their displacements (n, 2), got "
            f"{points.shape} and {u.shape}"
        )
    good = np.isfinite(np.hstack([points, u])).all(axis=1)
    degree = degree_for(int(good.sum()), SLOW_DEGREE)
    if degree == 0:
        return None
    slow = Ansatz(domain, (), degree, 0)
    fit = fit_unknowns(slow, np.zeros(slow.size), points[good], u[good], degree, -1)
    return partial(slow.displacement_at, fit.coefficients), (
        f"v0 starts from the motion of {good.sum()} hole centres: a polynomial of degree {degree} "
        f"leaves {1e3 * fit.sd:.0f} µm, {fit.outliers} of {2 * good.sum()} components set aside."
    )


def outline_motion(mask: BoolArray, deformed_mask: BoolArray, grid: PixelGrid) -> FloatArray | None:
    """Affine motion that takes one outline to the other, by centre and second moments.

    The holes are filled, so that it doesn't matter how they close. A rotation or a shear can't be
    seen in these moments and is taken to be none.

    Returns
    -------
    (2, 3) u_i = affine[i] · (1, x, y) [mm], [-], [-]; None if material reaches the image's border,
    where an outline says nothing.
    """
    moments = []
    for inside in (mask, deformed_mask):
        if inside[[0, -1]].any() or inside[:, [0, -1]].any():
            return None
        row, col = np.nonzero(ndimage.binary_fill_holes(inside))
        points = np.column_stack(grid.to_mm(row, col))
        moments.append((points.mean(axis=0), points.std(axis=0)))
    (centre, size), (centre_now, size_now) = moments
    stretch = size_now / size
    affine = np.zeros((2, 3))
    affine[:, 0] = centre_now - stretch * centre
    affine[0, 1], affine[1, 2] = stretch - 1.0
    return affine


def hole_centres(mask: BoolArray, grid: PixelGrid, cellular: Box, cell_size: float) -> FloatArray:
    """(n, 2) centres of the holes that lie in the cellular part [mm]; specks are left out."""
    labels, count = ndimage.label(~mask)
    numbers = np.arange(1, count + 1)
    centres = np.array(ndimage.center_of_mass(labels > 0, labels, numbers)).reshape(-1, 2)
    area = ndimage.sum_labels(labels > 0, labels, numbers) * (grid.pixel_size / cell_size) ** 2
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    x, y = grid.to_mm(*centres.T)
    keep = (area > _SMALLEST_HOLE) & ~np.isin(numbers, border)
    keep &= (x > cellular.x_min) & (x < cellular.x_max)
    keep &= (y > cellular.y_min) & (y < cellular.y_max)
    return np.asarray(np.column_stack([x, y])[keep])


def require_hole_distance(centres: FloatArray, cell_size: float) -> None:
    """Raise InputError if neighbouring holes are not a cell size apart; few holes say nothing."""
    if len(centres) < _FEWEST_HOLES:
        return
    apart = float(np.median(cKDTree(centres).query(centres, k=2)[0][:, 1]))
    if abs(apart - cell_size) > WRONG_CELL * cell_size:
        raise InputError(
            f"automatic start: expected holes {cell_size:g} mm apart, the cell size given, got "
            f"{apart:.3g} mm between neighbours of {len(centres)} holes; give cell size "
            f"{apart:.3g} mm, or check the pixel size"
        )


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
    pair = level_pair(
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


def _pulled_back(pair: LevelPair, slow: FloatArray) -> tuple[NDArray[Any], BoolArray]:
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
