"""Position and rotation of a specimen in a photograph, by the centres of its holes."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.photograph.holes import find_hole_lattice
from modeharvest.idic.photograph.material import find_material, window_for
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.errors import InputError

_HINT = "; check holes_x, holes_y and the image, or centre it and set data.placement = 'centred'"


def found_place(image: FloatImage, grid: PixelGrid, specimen: Specimen) -> FloatArray:
    """(3,) x and y of the specimen's centre [mm] and its rotation [rad] in an image (rows, cols).

    InputError if the material can't be found, or number or distance of the holes don't match.
    """
    pitch = float(np.linalg.norm(specimen.vectors, axis=1).min()) / grid.pixel_size
    try:
        lattice = find_hole_lattice(find_material(image, window_for(pitch)).mask, pitch)
    except InputError as error:
        raise InputError(f"place of the specimen in the reference: {error}{_HINT}") from None
    spots, centres = np.column_stack(grid.to_mm(*lattice.centres.T)), specimen.hole_centres
    middle, turn = spots.mean(axis=0), np.radians(lattice.rotation_deg)
    c, s = np.cos(turn), np.sin(turn)
    _, number = KDTree(middle + centres @ np.array([[c, s], [-s, c]])).query(spots)
    if len(spots) != len(centres) or len(np.unique(number)) != len(centres):
        raise InputError(
            f"place of the specimen in the reference: expected its {len(centres)} holes, got "
            f"{len(spots)} of a lattice of {' x '.join(map(str, lattice.counts))}{_HINT}"
        )
    (x, y), (u, v) = centres[number].T, (spots - middle).T
    return np.array([*middle, np.arctan2(np.sum(x * v - y * u), np.sum(x * u + y * v))])
