"""Motion before any correlation: from hole centres, boundaries or optical flow, by robust fits.

Optical flow: the deformed image is warped back by what is known already (a slow field through
hole centres, say), and the remaining optical flow is found on binned and blurred images by
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
from scipy.ndimage import binary_fill_holes
from skimage.registration import optical_flow_ilk

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box, orders
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.solver.pyramid import Level, LevelPair, level_pair
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError

HUBER = 1.345
"""Residual beyond which a point counts less [standard deviations]; 95 % efficient for normal
errors (Huber, 1964, doi 10.1214/aoms/1177703732)."""
OUTLIER = 5.0
"""Residual beyond which a point is called an outlier [standard deviations]."""
MOST_POINTS = 6000
"""Points of a field that are used; more would not make an initial guess better."""
_ROUNDS = 30


@dataclass(frozen=True, eq=False)
class RobustFit:
    """Coefficients, and how well they fit."""

    coefficients: FloatArray
    """(c,) or as the unknowns of the ansatz."""
    sd: float
    """Robust standard deviation of a component's residual (1.4826 times the median) [mm]."""
    outliers: int
    """Number of points more than 5 of these off."""


def robust_fit(matrix: FloatArray, values: FloatArray, least: float = 1e-10) -> RobustFit:
    """Fit linear unknowns so that stray points hardly count (Huber's weights, iterated).

    The matrix (n, c), n > c, times the coefficients should be the values (n,) [mm]. ``least``:
    smallest singular value that counts, over the largest.
    """
    weights = np.ones(len(values))
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)
        fit = np.linalg.lstsq(matrix * root[:, None], values * root, rcond=least)[0]
        off = np.abs(values - matrix @ fit)
        sd = 1.4826 * float(np.median(off))
        if sd <= 1e-12 * float(np.abs(values).max(initial=1e-300)):
            break
        before, weights = weights, np.minimum(1.0, HUBER * sd / np.maximum(off, 1e-300))
        if np.abs(weights - before).max() < 1e-3:
            break
    return RobustFit(fit, sd, int((off > OUTLIER * sd).sum()) if sd > 0 else 0)


def fit_unknowns(
    ansatz: Ansatz, a: ArrayLike, field: LocalField, v0_degree: int, v_degree: int = 0,
    least: float = 1e-10,
) -> RobustFit:  # fmt: skip
    """Fit v0, and every v_i, to displacements at points; the modes are fixed.

    ``a`` (size,) gives the modes' parameters; coefficients above the given degrees are set to zero.
    ``least`` is as for :func:`robust_fit`. InputError if there are fewer components than
    coefficients.
    """
    a = ansatz.checked(a).copy()
    stride = max(1, -(-int(field.good.sum()) // MOST_POINTS))
    points, u = field.points[field.good][::stride], field.u[field.good][::stride]
    free = _low_orders(ansatz, v0_degree, v_degree)
    if 2 * len(points) < free.size:
        raise InputError(
            f"initial guess: expected at least {-(-free.size // 2)} points, got {len(points)}"
        )
    columns = ansatz.sensitivities(a, points[:, None, 0], points[:, None, 1])[..., free]
    a[free] = 0.0
    rest = u - ansatz.displacement_at(a, points)
    fit = robust_fit(columns.reshape(-1, free.size), rest.ravel(), least)
    a[free] = fit.coefficients
    return RobustFit(a, fit.sd, fit.outliers)


def _low_orders(ansatz: Ansatz, v0_degree: int, v_degree: int) -> NDArray[np.intp]:
    """Indices of v0 and v_i up to these degrees among the unknowns."""
    v0, v = (np.arange(len(orders(degree))) for degree in (v0_degree, v_degree))
    places = [ansatz.v0_slice(c).start + v0 for c in (0, 1)]
    return np.concatenate(places + [ansatz.v_slice(m).start + v for m in range(len(ansatz.modes))])


SLOW_DEGREE = 3
"""Highest total degree of v0 in an initial guess: bending and barrelling, nothing cell by cell."""
Slow = Callable[[FloatArray], FloatArray]
"""From points (..., 2) to displacements (..., 2) [mm]."""


def first_motion(
    domain: Box, pair: ImagePair, holes: LocalField | None, least: float = 1e-10
) -> tuple[Slow, str]:
    """Find the slow motion from the images' geometry, and a sentence about it.

    From the displacements of the holes' centres, by polynomials over the domain [mm], or from the
    boundaries in the masks. ``least`` is as for :func:`robust_fit`.
    """
    found = None if holes is None else _through_holes(domain, holes, least)
    if found is not None:
        return found
    plane = None
    if pair.mask is not None and pair.deformed_mask is not None:
        plane = edge_motion(pair.mask, pair.deformed_mask, pair.grid)
    if plane is None:
        return (np.zeros_like, "v0 starts from no motion: neither holes nor boundaries are known.")
    return lambda points: plane[:, 0] + points @ plane[:, 1:].T, (
        f"v0 starts from the boundaries: {100 * plane[0, 1]:+.1f} % along x and "
        f"{100 * plane[1, 2]:+.1f} % along y."
    )


def _through_holes(domain: Box, holes: LocalField, least: float) -> tuple[Slow, str] | None:
    """A polynomial through the holes' displacements; None if there are too few for a plane."""
    count = int(holes.good.sum())
    # At least three points per coefficient.
    fitting = [d for d in range(1, SLOW_DEGREE + 1) if 3 * (d + 1) * (d + 2) // 2 <= count]
    if not fitting:
        return None
    degree = fitting[-1]
    slow = Ansatz(domain, (), degree, 0)
    fit = fit_unknowns(slow, np.zeros(slow.size), holes, degree, least=least)
    return partial(slow.displacement_at, fit.coefficients), (
        f"v0 starts from the motion of {count} hole centres: a polynomial of degree {degree} "
        f"leaves {1e3 * fit.sd:.0f} µm; {fit.outliers} of {2 * count} components are outliers."
    )


def edge_motion(mask: BoolArray, deformed_mask: BoolArray, grid: PixelGrid) -> FloatArray | None:
    """Affine motion that takes one boundary to the other, by centre and second moments.

    (2, 3) u_i = affine[i] · (1, x, y) [mm], [-], [-]; None if material reaches the image's border,
    where a boundary is unknown. The holes are filled, so that it doesn't matter how they close. A
    rotation or a shear isn't observable in these moments and is taken to be none.
    """
    moments = []
    for inside in (mask, deformed_mask):
        if inside[[0, -1]].any() or inside[:, [0, -1]].any():
            return None
        row, col = np.nonzero(binary_fill_holes(inside))
        points = np.column_stack(grid.to_mm(row, col))
        moments.append((points.mean(axis=0), points.std(axis=0)))
    (centre, size), (centre_now, size_now) = moments
    stretch = size_now / size
    affine = np.zeros((2, 3))
    affine[:, 0] = centre_now - stretch * centre
    affine[0, 1], affine[1, 2] = stretch - 1.0
    return affine


CELL_PX = 48
"""Binned pixels per unit cell: enough to see its pattern, few enough to be quick."""
BLUR = 2.0
"""Standard deviation of the blur of the binned images [binned px]."""
RADIUS = 7
"""Radius of a Lucas–Kanade window [binned px]."""
WARPS = 4
"""Iterations on each level of the flow's own pyramid; more mend a few stray points alone."""
STEP = 2
"""Spacing of the field's points [binned px]."""
DITHER = 1e-3
"""Noise added to both images, over their contrast: a window without any texture has no flow at all,
and the value found there instead would spread."""


def coarse_field(pair: ImagePair, cell_size: float, known: Slow) -> LocalField:
    """Find the displacement between two images roughly, near to what is known of it.

    At points on material alone, without standard deviations. The cell size l [mm] limits the blur;
    the motion beyond the known one should be within some speckles. Raises InputError if the known
    part leads out of the image altogether.
    """
    factor = max(1, round(cell_size / (CELL_PX * pair.grid.pixel_size)))
    level = level_pair(pair, Level(factor, BLUR), 0, 3, normalised=True)
    coarse = level.grid
    points = np.stack(np.broadcast_arrays(coarse.x[None, :], coarse.y[:, None]), axis=-1)
    slow = np.asarray(known(points), dtype=np.float64)
    warped, inside = _warped_back(level, slow)
    flow = _flow(level.reference, warped) * coarse.pixel_size * (1.0, -1.0)
    row, col = (i[::STEP, ::STEP].ravel() for i in np.indices(coarse.shape))
    keep = (level.mask & inside)[row, col]
    if not keep.any():
        raise InputError(
            "initial guess: expected the two images to overlap, but the known part of the motion "
            "leads out of the deformed image everywhere; check the hole centres and the masks"
        )
    row, col = row[keep], col[keep]
    x, y = coarse.to_mm(row, col)
    return LocalField(x, y, (slow + flow)[row, col], source="optical flow of the images")


def _warped_back(level: LevelPair, slow: FloatArray) -> tuple[NDArray[Any], BoolArray]:
    """(rows, cols) g at x + slow, or the reference where that is outside; and where it is in g."""
    grid = level.grid
    row, col = np.indices(grid.shape)
    to_row, to_col = row - slow[..., 1] / grid.pixel_size, col + slow[..., 0] / grid.pixel_size
    value, _, _ = level.deformed.sample(to_row, to_col)
    inside = np.isfinite(value)
    return np.where(inside, value, level.reference), inside


def _flow(reference: NDArray[Any], deformed: NDArray[Any]) -> FloatArray:
    """(rows, cols, 2) displacement along columns and rows [px]."""
    rng = np.random.default_rng(0)
    noise = DITHER * float(reference.std())
    f, g = (np.float64(i) + noise * rng.standard_normal(i.shape) for i in (reference, deformed))
    down, right = optical_flow_ilk(  # type: ignore[no-untyped-call]
        f, g, radius=RADIUS, num_warp=WARPS, gaussian=True, prefilter=False, dtype=np.float64
    )
    return np.stack([right, down], axis=-1)
