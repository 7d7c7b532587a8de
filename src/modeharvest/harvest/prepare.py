"""Photographs made ready to be correlated: read, judged, freed from distortion, material found.

::

    prepared/reference.tif  reference_mask.tif
    prepared/NAME.tif       NAME_mask.tif        of each deformed image
    prepared/prepared.json                       what was done and what was skipped; written last

The images are grey levels as the camera counts them, float32, on the ideal pixel grid; the masks
are white on material.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.files import read_json, write_json
from modeharvest.harvest.experiment import Experiment
from modeharvest.harvest.inputs import named_files, of_each_photograph
from modeharvest.harvest.noise import GIVEN, Noise, estimated_noise, measured_noise
from modeharvest.idic.specimen.material import MaterialOptions, find_material
from modeharvest.imaging.distortion.mapping import Distortion
from modeharvest.imaging.distortion.undistort import undistorted, undistorted_mask
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.io import read_image, read_mask, require_same_shape, write_image
from modeharvest.imaging.photographs.photograph import Photograph
from modeharvest.imaging.photographs.series import read_frame, read_reference
from modeharvest.progress import Progress, silent
from modeharvest.reading import reading
from modeharvest.typed import made

FloatImage = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

RECORD = "prepared.json"


@dataclass(frozen=True, eq=False)
class Prepared:
    """Photographs on the ideal grid, in a folder; read when asked for.

    Parameters
    ----------
    folder
        Where they are.
    info
        The content of ``prepared.json``.
    """

    folder: Path
    info: dict[str, Any]

    @classmethod
    def read(cls, folder: Path) -> Prepared:
        """Open a finished folder; raises InputError if it isn't one."""
        path = folder / RECORD
        with reading(path, "prepared photographs", "remove it, and harvest again"):
            found = cls(folder, dict(read_json(path)))
            _ = found.names, found.skipped, found.noise, found.grid
            return found

    @property
    def names(self) -> tuple[str, ...]:
        """Of the deformed images that can be used, in the order of the test."""
        return tuple(map(str, self.info["names"]))

    @property
    def skipped(self) -> tuple[tuple[str, str], ...]:
        """Name of each file that can't be used, and why."""
        return tuple((name, reason) for name, reason in self.info["skipped"])

    @property
    def noise(self) -> Noise:
        """The camera's."""
        return made(Noise, self.info["noise"])

    @property
    def grid(self) -> PixelGrid:
        """The ideal pixels; the physical origin is the middle of the image."""
        return made(PixelGrid, self.info["grid"])

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file, the record last."""
        stems = (f"{name}{kind}" for name in ("reference", *self.names) for kind in ("", "_mask"))
        return (*(self.folder / f"{stem}.tif" for stem in stems), self.folder / RECORD)

    def image(self, name: str = "reference") -> FloatImage:
        """(rows, cols) grey levels."""
        return read_image(self.folder / f"{name}.tif")

    def mask(self, name: str = "reference") -> BoolArray:
        """(rows, cols) True on material."""
        return read_mask(self.folder / f"{name}_mask.tif")


def prepare(
    experiment: Experiment,
    base: Path,
    folder: Path,
    distortion: Distortion | None = None,
    progress: Progress = silent,
) -> Prepared:
    """Make an experiment's photographs ready; leaves them in ``folder``.

    Parameters
    ----------
    experiment
        Of which there are photographs.
    base
        Folder that its files' names are relative to.
    folder
        Where to leave them.
    distortion
        Of the optics.
    progress
        Listener.

    Raises
    ------
    InputError
        If the reference can't be used, or none of the deformed images.
    """
    images, table = experiment.images, experiment.specimen
    reference = read_reference(base / images.reference)
    cell_px = table.cell_size / experiment.scale.mm_per_px
    ready = _Maker(folder, distortion, material_options(cell_px))
    mask = ready.save("reference", reference, _given(base, table.material))
    deformed = named_files(base, images.deformed)
    masks = of_each_photograph(
        experiment, base, table.deformed_material, "specimen.deformed_material"
    )
    names, skipped, notes = [], [], list(reference.notes) + ready.sentences
    for k, path in enumerate(deformed):
        progress(k, len(deformed), "prepare photographs")
        try:
            frame = read_frame(path, reference)
            ready.save(path.stem, frame, masks.get(path.stem))
        except InputError as error:
            skipped.append((path.name, str(error)))
            continue
        names.append(path.stem)
        notes += [note for note in frame.notes if note not in notes]
    if not names:
        raise InputError(
            f"expected a deformed image that can be used, got none of {len(deformed)}: "
            f"{skipped[0][1]}"
        )
    rows, cols = reference.shape
    grid = PixelGrid.centred(rows, cols, experiment.scale.mm_per_px)
    info = {
        "names": names,
        "skipped": skipped,
        "noise": vars(_noise(experiment, base, reference, mask)),
        "grid": vars(grid),
        "full_scale": reference.full_scale,
        "notes": notes,
    }
    write_json(folder / RECORD, info)
    return Prepared(folder, info)


def material_options(cell_px: float) -> MaterialOptions:
    """How material is told from background where cells are that large [px].

    Buckled holes are narrow: the window has to fit into them.
    """
    window = int(np.clip(_WINDOW * cell_px, 9, 25)) // 2 * 2 + 1
    return MaterialOptions(window_px=window, reach_px=0.4 * window)


_WINDOW = 0.15
"""Window in which the speckle's contrast is looked at, as a share of the cell."""


class _Maker:
    """Frees photographs from distortion and finds their material."""

    def __init__(
        self, folder: Path, distortion: Distortion | None, options: MaterialOptions
    ) -> None:
        self._folder, self._distortion, self._options = folder, distortion, options
        self.sentences: list[str] = []

    def save(self, name: str, photograph: Photograph, given: Path | None) -> BoolArray:
        """Write image and mask under a name; returns the photograph's own mask."""
        if given is not None:
            mask = read_mask(given)
            require_same_shape(photograph.image, mask, str(photograph.path), str(given))
        else:
            material = find_material(photograph.image, self._options)
            mask = material.mask
            self.sentences += [s for s in material.sentences if s not in self.sentences]
        image, shown = photograph.image, mask
        if self._distortion is not None:
            image, shown = (
                undistorted(image, self._distortion),
                undistorted_mask(mask, self._distortion),
            )
        write_image(self._folder / f"{name}.tif", image)
        write_image(self._folder / f"{name}_mask.tif", shown)
        return mask


def _given(base: Path, name: str) -> Path | None:
    return base / name if name else None


def _noise(experiment: Experiment, base: Path, reference: Photograph, mask: BoolArray) -> Noise:
    """Given, measured or estimated, in this order; before any interpolation smooths it."""
    if experiment.noise.sd is not None:
        return Noise(experiment.noise.sd, GIVEN)
    repeats = experiment.images.repeats
    if not repeats:
        return estimated_noise(reference.image, mask)
    others = [read_frame(path, reference).image for path in named_files(base, repeats, False)]
    return measured_noise([reference.image, *others], mask)
