"""The inverse isoparametric mapping: which element covers a pixel, and where in it.

For each pixel centre x of an image, find the element e and the local coordinates xi with
sum_a N_a(xi) x_a = x, where x_a are the element's node positions in the state the image shows.
The paper inverts the same mapping to make its virtual images (section "Virtual Experiments").
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.imaging import rasterise
from modeharvest.imaging.elements import (
    bezier_matrix,
    lattice,
    monomial_gradients,
    polynomials,
    reference_element,
    to_bernstein,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.jacobian import require_positive_jacobian, sub_elements

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_BEYOND = (0.25, 0.1, 0.03)
_MIDDLE = {True: 1.0 / 3.0, False: 0.0}


@dataclass(frozen=True, eq=False)
class Located:
    """Every pixel of an image in terms of a mesh.

    Parameters
    ----------
    element
        (rows, cols) int32 number of the element that covers the pixel centre, -1 where none
        does. A pixel on a shared edge or node belongs to the element of the lowest number.
    xi
        (rows, cols, 2) local coordinates (xi, eta) in it [-]; NaN where no element is.
    residual_px
        (rows, cols) float32 distance of the mapped (xi, eta) from the pixel centre [px]; NaN
        where no element is.
    doubly_covered
        How many pixels lie inside more than one element: the mesh overlaps there.
    """

    element: NDArray[np.int32]
    xi: FloatArray
    residual_px: NDArray[np.float32]
    doubly_covered: int = 0

    @property
    def mask(self) -> BoolArray:
        """(rows, cols) True where there is material."""
        return np.asarray(self.element >= 0)

    @property
    def max_residual_px(self) -> float:
        """The largest residual of the inverse mapping [px]; 0 if no pixel is covered."""
        mask = self.mask
        return float(self.residual_px[mask].max()) if mask.any() else 0.0


def locate(
    nodes: FloatArray,
    cells: IntArray,
    element: str,
    grid: PixelGrid,
    where: str = "mesh",
    wanted: BoolArray | None = None,
) -> Located:
    """Find element and local coordinates of every pixel centre of a grid.

    Parameters
    ----------
    nodes
        (n, 2) node positions in the state to look at: undeformed X or deformed X + u [mm].
    cells
        (m, k) node numbers of each element.
    element
        T3, T6, Q4, Q8 or Q9.
    grid
        The pixels.
    where
        What to call the mesh in an error.
    wanted
        (rows, cols) True where to look; by default everywhere. Other pixels count as background.

    Raises
    ------
    InputError
        If a Jacobian isn't positive everywhere in some element.
    """
    require_positive_jacobian(nodes, cells, element, where)
    elements = _elements(nodes, cells, element, grid)
    visit_start, visits = rasterise.bands(elements.row_from, elements.row_to, grid.rows)
    threads = numba.get_num_threads()
    in_turn = [np.arange(k, visit_start.size - 1, threads) for k in range(threads)]
    size = grid.rows * grid.cols
    pixels = rasterise.Pixels(
        np.empty(size, dtype=np.int32), np.empty((size, 2)), np.empty(size, dtype=np.float32),
        grid.cols, float(grid.x0), float(grid.y0), float(grid.pixel_size),
    )  # fmt: skip
    everywhere = np.empty(0, dtype=np.bool_)
    twice = rasterise.rasterise(
        elements, pixels, everywhere if wanted is None else np.ascontiguousarray(wanted).ravel(),
        visit_start, visits, np.concatenate(in_turn),
    )  # fmt: skip
    return Located(
        pixels.element.reshape(grid.shape), pixels.xi.reshape(*grid.shape, 2),
        pixels.residual.reshape(grid.shape), int(twice),
    )  # fmt: skip


def _elements(
    nodes: FloatArray, cells: IntArray, element: str, grid: PixelGrid
) -> rasterise.Elements:
    """Lay the mesh over the pixels."""
    triangular = reference_element(element).triangular
    absolute = polynomials(element, cells, nodes)
    position_px = np.stack(grid.to_px(nodes[:, 0], nodes[:, 1]), axis=1)
    centres = np.rint(position_px[cells].mean(axis=1))
    relative = polynomials(element, np.arange(cells.size).reshape(cells.shape),
                           (position_px[cells] - centres[:, None]).reshape(-1, 2))  # fmt: skip
    bezier = bezier_matrix(triangular)
    hulls = np.ascontiguousarray((relative @ bezier.T).transpose(0, 2, 1))
    row_from, row_to = _row_ranges(hulls, centres, grid.rows)
    return rasterise.Elements(
        relative, absolute, hulls, centres, _reach(relative, triangular), row_from, row_to,
        bezier, sub_elements(triangular), triangular,
    )  # fmt: skip


def interpolate(located: Located, cells: IntArray, element: str, nodal: FloatArray) -> FloatArray:
    """Values of a nodal field at located pixels by the element's own shape functions.

    Parameters
    ----------
    located
        From :func:`locate`, with the same cells.
    nodal
        (n, c) field at the nodes, for example the displacement [mm].

    Returns
    -------
    (c, rows, cols) values, NaN where there is no material.
    """
    if nodal.ndim != 2:
        raise InputError(f"expected a nodal field of shape (n, c), got {nodal.shape}")
    coefficients = polynomials(element, cells, np.asarray(nodal, dtype=np.float64))
    triangular = reference_element(element).triangular
    return _evaluate(coefficients, triangular, located.element, located.xi)


def _evaluate(
    coefficients: FloatArray, triangular: bool, owner: NDArray[np.int32], xi: FloatArray
) -> FloatArray:
    out = np.empty((coefficients.shape[1], *owner.shape))
    rasterise.evaluate(coefficients, not triangular, owner, xi, out)
    return out


def _row_ranges(hulls: FloatArray, centres: FloatArray, rows: int) -> tuple[IntArray, IntArray]:
    """First and one past the last image row of each element, clipped to the image."""
    low = hulls[:, :, 0].min(axis=1) + centres[:, 0]
    high = hulls[:, :, 0].max(axis=1) + centres[:, 0]
    first = np.clip(np.ceil(low - 1e-9), 0, rows).astype(np.int64)
    last = np.clip(np.floor(high + 1e-9) + 1, 0, rows).astype(np.int64)
    return first, last


def _reach(relative: FloatArray, triangular: bool) -> FloatArray:
    """(m,) how far beyond its edges, in (xi, eta), each element's map is one to one, proved.

    Sufficient on a convex domain: ||A^-1 J - 1|| < 1 there, with A the Jacobian in the middle;
    the norm is convex, so the Bernstein coefficients of J bound it. The domain is the reference
    one, enlarged. Where nothing is proved it is 0.
    """
    middle = np.full(2, _MIDDLE[triangular])
    local = np.linalg.inv(relative @ monomial_gradients(middle)) @ relative
    reach = np.zeros(len(relative))
    for beyond in _BEYOND:
        factor = 1.0 + beyond * (3.0 if triangular else 1.0)
        points = middle + factor * (lattice(triangular, 2) - middle)
        slopes = monomial_gradients(points)
        to_control = np.einsum("qp,pmi->miq", to_bernstein(triangular, 2), slopes)
        control = (local.reshape(-1, 9) @ to_control.reshape(9, -1)).reshape(len(local), 2, 2, -1)
        deviation = control - np.eye(2)[..., None]
        proved = np.einsum("eciq,eciq->eq", deviation, deviation).max(axis=1) < 1.0
        reach[proved] = np.maximum(reach[proved], beyond)
        if proved.all():
            break
    return reach
