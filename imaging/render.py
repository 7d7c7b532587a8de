"""Images of a deforming specimen, the truth behind them, and its file.

The reference image shows the speckle itself. A pixel x of a deformed image shows the speckle at
its reference point X, with X + u(X) = x solved by the inverse isoparametric mapping, so neither
image is interpolated from the other. Through a lens a pixel p shows the ideal point phi_S^-1(p):
that is found exactly, then the element and the local coordinates of the material there, then the
speckle at its reference point. No image is resampled.

A truth file is one HDF5 per deformed image, readable with h5py alone::

    displacement           (2, rows, cols) float64 [mm]  at the reference image's pixels
    reference_point        (2, rows, cols) float64 [mm]  shown by the deformed image's pixels
    deformed_displacement  (2, rows, cols) float32 [mm]  at the deformed image's pixels
    element                (rows, cols)    int32   [-]   at the deformed image's pixels
    residual_px            (rows, cols)    float32 [px]  of the inverse mapping there

In the file the leading axis holds the components (x, y), so that each is one contiguous image;
in Python they come last. x right, y up; rows run down the image. NaN (in ``element``: -1) marks
background. Attributes: nominal_strain and the pixel grid.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.imaging.distortion.undistort import Positions
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import Located, interpolate, locate, map_back
from modeharvest.imaging.mapping.pointwise import locate_points
from modeharvest.imaging.mapping.render_rows import render_rows
from modeharvest.imaging.speckle.pattern import Speckle
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic_hdf5, open_hdf5


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


@dataclass(frozen=True, eq=False)
class Truth:
    """What a measurement of one deformed image should find.

    The last axis of length 2 holds the components (x, y) along the physical axes; NaN where
    there is no material.

    Parameters
    ----------
    displacement
        (rows, cols, 2) u at the *reference* image's pixels [mm].
    reference_point
        (rows, cols, 2) X of the material that the *deformed* image's pixels show [mm].
    deformed_displacement
        (rows, cols, 2) float32 u at the *deformed* image's pixels [mm].
    element
        (rows, cols) int32 element shown by the deformed image's pixels, -1 for background.
    residual_px
        (rows, cols) float32 residual of the inverse mapping in the deformed image [px].
    """

    displacement: FloatArray
    reference_point: FloatArray
    deformed_displacement: NDArray[np.float32]
    element: NDArray[np.int32]
    residual_px: NDArray[np.float32]


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
    truth = Truth(
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


def render_image(
    mesh: Mesh,
    displacement: FloatArray,
    grid: PixelGrid,
    speckle: Speckle,
    background: float,
    where: str = "deformed mesh",
) -> Rendering:
    """Show the deformed specimen as :func:`render_deformed` does, without the truth.

    Nothing is kept of the mapping, so that it is faster and needs little memory besides the image.

    Parameters
    ----------
    mesh
        The undeformed mesh [mm].
    displacement
        (n, 2) at its nodes [mm].
    grid
        The pixels.
    speckle
        The pattern that the material carries.
    background
        Intensity beside the material [fraction of full scale].
    where
        What the mesh is called in an error.

    Raises
    ------
    InputError
        If an element is turned inside out.
    """
    if speckle.spec.ink is None:
        return Rendering(*render_rows(mesh, displacement, grid, speckle.spline, background, where))
    nodes, home = mesh.nodes + displacement, np.stack(grid.to_px(*mesh.nodes.T), axis=1)
    found = map_back(nodes, mesh.cells, mesh.element, grid, home, where)
    mask = found.element >= 0
    image = np.full(grid.shape, background, dtype=np.float32)
    image[mask] = speckle(*found.values[:, mask])
    return Rendering(image, mask, found.doubly_covered)


TRUTH_FORMAT = "modeharvest-truth-1"

_TYPES = {"element": np.int32, "deformed_displacement": np.float32, "residual_px": np.float32}
"""Of the planes that aren't float64."""
_CONTENT = {
    "displacement": ("mm", "displacement (x, y) at the reference image's pixels"),
    "reference_point": ("mm", "reference point (x, y) shown by the deformed image's pixels"),
    "deformed_displacement": ("mm", "displacement (x, y) at the deformed image's pixels"),
    "element": ("-", "element shown by the deformed image's pixels, -1: background"),
    "residual_px": ("px", "residual of the inverse mapping at the deformed image's pixels"),
}
_CHUNK_ROWS = 64


def write_truth(path: Path | str, truth: Truth, nominal_strain: float, grid: PixelGrid) -> None:
    """Write a truth file, whole or not at all."""
    with atomic_hdf5(path) as file:
        file.attrs["format"] = TRUTH_FORMAT
        file.attrs["nominal_strain"] = nominal_strain
        for name, value in asdict(grid).items():
            file.attrs[name] = value
        for name, (unit, meaning) in _CONTENT.items():
            data = getattr(truth, name)
            data = np.moveaxis(data, -1, 0) if data.ndim == 3 else data
            chunk = (1,) * (data.ndim - 2) + (min(_CHUNK_ROWS, grid.rows), grid.cols)
            dataset = file.create_dataset(
                name, data=data, chunks=chunk, compression="lzf", shuffle=True
            )
            dataset.attrs["unit"] = unit
            dataset.attrs["meaning"] = meaning


def read_truth(path: Path | str) -> Truth:
    """Read what :func:`write_truth` wrote; InputError if missing, cut short or another format."""
    return Truth(**_read_truth_arrays(path, *_CONTENT))


def read_displacement(path: Path | str) -> NDArray[np.float64]:
    """(rows, cols, 2) the displacement [mm] alone, in a third of the time."""
    return np.asarray(_read_truth_arrays(path, "displacement")["displacement"], dtype=np.float64)


def _read_truth_arrays(path: Path | str, *names: str) -> dict[str, NDArray[Any]]:
    """Some of the file's arrays, components last."""
    remedy = "make it again with 'modeharvest image'"
    with open_hdf5(path, "a truth file (HDF5)", remedy, TRUTH_FORMAT) as file:
        planes = {n: np.asarray(file[n], dtype=_TYPES.get(n, np.float64)) for n in names}
        size = file["element"].shape
        for name, plane in planes.items():
            if len(size) != 2 or plane.shape not in (size, (2, *size)):
                raise InputError(f"expected {name} of (2 x) rows x cols, got {plane.shape}")
        return {n: np.moveaxis(p, 0, -1) if p.ndim == 3 else p for n, p in planes.items()}
