"""Images of a deforming specimen, and the truth behind them.

The reference image shows the speckle itself. A pixel x of a deformed image shows the speckle at
its reference point X, with X + u(X) = x solved by the inverse isoparametric mapping, so neither
image is interpolated from the other. Through a lens a pixel p shows the ideal point phi_S^-1(p):
that is found exactly, then the element and the local coordinates of the material there, then the
speckle at its reference point. No image is resampled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.imaging.distortion.undistort import Positions
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import Located, interpolate, locate
from modeharvest.imaging.mapping.pointwise import locate_points
from modeharvest.imaging.pair import Truth
from modeharvest.imaging.speckle.pattern import Speckle
from modeharvest.util.arrays import BoolArray, FloatArray


def render_observed(
    mesh: Mesh,
    displacement: FloatArray | None,
    grid: PixelGrid,
    points: Positions,
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
    points
        (row, col), each (rows, cols) [px], what the pixels show: from :func:`ideal_points`.
    speckle, background
        Intensity of the material and around it [fraction of full scale].
    where
        What to call the state in an error.

    Returns
    -------
    Rendering
        Image and mask; pixels that lie inside more than one element are not counted.

    Raises
    ------
    InputError
        If the displacement turns an element inside out.
    """
    nodes = mesh.nodes if displacement is None else mesh.nodes + displacement
    located = locate_points(nodes, mesh.cells, mesh.element, grid, *points, where)
    mask = located.mask
    if displacement is None:
        row, col = points[0][mask], points[1][mask]
    else:
        x, y = interpolate(located, mesh.cells, mesh.element, mesh.nodes)[:, mask]
        row, col = grid.to_px(x, y)
    image = np.full(mask.shape, background, dtype=np.float32)
    image[mask] = speckle(row, col)
    return Rendering(image, mask)


@dataclass(frozen=True, eq=False)
class Rendering:
    """An image with material and background told apart.

    Parameters
    ----------
    image
        (rows, cols) float32 intensity [fraction of full scale].
    mask
        (rows, cols) True where there is material.
    doubly_covered
        How many of its pixels lie inside more than one element: the specimen overlaps there,
        and the element of the lowest number is shown.
    """

    image: NDArray[np.float32]
    mask: BoolArray
    doubly_covered: int = 0


def render_reference(located: Located, speckle: Speckle, background: float) -> Rendering:
    """Show the undeformed specimen: speckle at whole pixels, ``background`` around it.

    Parameters
    ----------
    located
        The undeformed mesh on the image's grid.
    speckle
        The pattern that the material carries.
    background
        Intensity beside the material [fraction of full scale].
    """
    mask = located.mask
    image = np.where(mask, speckle.image(), background).astype(np.float32)
    return Rendering(image, mask, located.doubly_covered)


def render_deformed(
    mesh: Mesh,
    displacement: FloatArray,
    located_reference: Located,
    grid: PixelGrid,
    speckle: Speckle,
    background: float,
    where: str = "deformed mesh",
) -> tuple[Rendering, Truth]:
    """Show the deformed specimen, and tell the truth about it.

    Parameters
    ----------
    mesh, displacement
        The undeformed mesh and its nodal displacements (n, 2) [mm].
    located_reference
        The undeformed mesh on the same grid.
    grid
        The pixels of both images; the speckle's whole pixels are the grid's.
    speckle, background
        Intensity of the material and around it [fraction of full scale].
    where
        What to call the state in an error.

    Raises
    ------
    InputError
        If the displacement turns an element inside out.
    """
    located = locate(mesh.nodes + displacement, mesh.cells, mesh.element, grid, where)
    point = interpolate(located, mesh.cells, mesh.element, mesh.nodes)
    moved = interpolate(located, mesh.cells, mesh.element, displacement)
    at_reference = interpolate(located_reference, mesh.cells, mesh.element, displacement)
    truth = Truth.of(
        displacement=np.moveaxis(at_reference, 0, -1),
        reference_point=np.moveaxis(point, 0, -1),
        deformed_displacement=np.moveaxis(moved.astype(np.float32), 0, -1),
        element=located.element,
        residual_px=located.residual_px,
    )
    mask = located.mask
    image = np.full(grid.shape, background, dtype=np.float32)
    image[mask] = speckle(*grid.to_px(point[0][mask], point[1][mask]))
    return Rendering(image, mask, located.doubly_covered), truth
