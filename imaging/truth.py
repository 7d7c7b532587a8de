"""The truth file: one HDF5 per deformed image, readable with h5py alone.

::

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

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.files import atomic_hdf5
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.render import Truth
from modeharvest.reading import open_hdf5

FORMAT = "modeharvest-truth-1"

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
        file.attrs["format"] = FORMAT
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
    return Truth(**_read(path, *_CONTENT))


def read_displacement(path: Path | str) -> NDArray[np.float64]:
    """(rows, cols, 2) the displacement [mm] alone, in a third of the time."""
    return np.asarray(_read(path, "displacement")["displacement"], dtype=np.float64)


def _read(path: Path | str, *names: str) -> dict[str, NDArray[Any]]:
    """Some of the file's arrays, components last."""
    remedy = "make it again with 'modeharvest image'"
    with open_hdf5(path, "a truth file (HDF5)", remedy, FORMAT) as file:
        planes = {n: np.asarray(file[n], dtype=_TYPES.get(n, np.float64)) for n in names}
        size = file["element"].shape
        for name, plane in planes.items():
            if len(size) != 2 or plane.shape not in (size, (2, *size)):
                raise InputError(f"expected {name} of (2 x) rows x cols, got {plane.shape}")
        return {n: np.moveaxis(p, 0, -1) if p.ndim == 3 else p for n, p in planes.items()}
