"""What a lens with a distortion shows: a pixel p sees the ideal point phi_S^-1(p).

No image is resampled. Each pixel's ideal point is found exactly, then the element and the local
coordinates of the material there, then the speckle at its reference point.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.imaging.distortion.mapping import Distortion
from modeharvest.imaging.distortion.undistort import PolynomialDistortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.isoparametric import interpolate
from modeharvest.imaging.pointwise import locate_points
from modeharvest.imaging.render import Rendering
from modeharvest.imaging.speckle import Speckle

FloatArray = NDArray[np.float64]
Positions = tuple[FloatArray, FloatArray]

_DEGREE = 9
_NEGLIGIBLE_PX = 1e-12
_STRIP = 64  # rows that a thread takes at a time


def seen_points(distortion: Distortion, shape: tuple[int, int]) -> Positions:
    """(row, col), each (rows, cols) [px]: the ideal positions that an image's pixels show.

    Raises
    ------
    InputError
        If the distortion folds in the image.
    """
    row, col = np.ogrid[: shape[0], : shape[1]]
    strips = [slice(k, k + _STRIP) for k in range(0, shape[0], _STRIP)]
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        found = list(pool.map(lambda strip: distortion.ideal(row[strip], col), strips))
    return np.concatenate([r for r, _ in found]), np.concatenate([c for _, c in found])


def without_affine(distortion: Distortion, shape: tuple[int, int]) -> PolynomialDistortion:
    """The same distortion without its affine part, as a polynomial.

    The terms 1, xi, eta of its Chebyshev series over the image are left out, and those of the
    highest degrees where they are negligible; exact for lenses that are polynomials of degree 9
    or less (those of k1 ... k3, p1, p2).

    Parameters
    ----------
    distortion
        Of any kind.
    shape
        (rows, cols) of the images [px].
    """
    nodes = chebyshev.chebpts1(_DEGREE + 1)
    row, col = (0.5 * (n - 1) * (1.0 + nodes) for n in shape)
    fields = distortion.shift(row[:, None], col[None, :])
    transform = chebyshev.chebvander(nodes, _DEGREE) * 2.0 / (_DEGREE + 1)
    transform[:, 0] *= 0.5
    series = [transform.T @ np.broadcast_to(f, (nodes.size,) * 2) @ transform for f in fields]
    orders = PolynomialDistortion.orders(_DEGREE)
    coefficients = np.array([[s[j, i] for i, j in orders] for s in series])
    coefficients[:, :3] = 0.0
    degree = max(
        (i + j for (i, j), c in zip(orders, coefficients.T, strict=True)
         if np.abs(c).max() > _NEGLIGIBLE_PX),
        default=0,
    )  # fmt: skip
    return PolynomialDistortion(shape, coefficients[:, : PolynomialDistortion.size_of(degree)])


def render_seen(
    mesh: Mesh,
    displacement: FloatArray | None,
    grid: PixelGrid,
    seen: Positions,
    speckle: Speckle,
    background: float,
    where: str = "mesh",
) -> Rendering:
    """Show the specimen at given ideal positions instead of at the grid's pixels.

    Parameters
    ----------
    mesh, displacement
        The undeformed mesh and its nodal displacements (n, 2) [mm]; None shows the reference.
    grid
        The ideal image's pixels; the speckle's whole pixels are the grid's.
    seen
        (row, col), each (rows, cols) [px], what the pixels see: from :func:`seen_points`.
    speckle, background
        Intensity of the material and around it [fraction of full scale].
    where
        What to call the state in an error.

    Returns
    -------
    Rendering
        Image and mask as seen; pixels that lie inside more than one element are not counted.

    Raises
    ------
    InputError
        If the displacement turns an element inside out.
    """
    nodes = mesh.nodes if displacement is None else mesh.nodes + displacement
    located = locate_points(nodes, mesh.cells, mesh.element, grid, *seen, where)
    mask = located.mask
    if displacement is None:
        row, col = seen[0][mask], seen[1][mask]
    else:
        x, y = interpolate(located, mesh.cells, mesh.element, mesh.nodes)[:, mask]
        row, col = grid.to_px(x, y)
    image = np.full(mask.shape, background, dtype=np.float32)
    image[mask] = speckle(row, col)
    return Rendering(image, mask)
