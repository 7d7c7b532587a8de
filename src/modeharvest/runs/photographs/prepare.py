"""Photographs made ready for correlation: files found, lens, ideal images, masks, local fields.

The images are grey levels as the camera counts them, float32, on the ideal pixel grid; the masks
are white on material. A local DIC's field is another code's file, or pyvale's subsets.
"""

from __future__ import annotations

import glob
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.idic.local.field import LocalField, read_field, without_distortion
from modeharvest.idic.local.subsets import SubsetOptions, pyvale_python, subset_field
from modeharvest.idic.photograph.material import find_material, window_for
from modeharvest.idic.photograph.plain import require_speckle
from modeharvest.idic.solver.noise import GIVEN, CameraNoise, estimated_noise, measured_noise
from modeharvest.imaging.distortion.calibrate import Calibration, DegreeTrial, calibrate
from modeharvest.imaging.distortion.files import read_distortion, write_distortion
from modeharvest.imaging.distortion.fit import PolynomialModel
from modeharvest.imaging.distortion.lens import (
    Distortion,
    PolynomialDistortion,
    undistorted,
    undistorted_mask,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.files import (
    read_image,
    read_mask,
    require_same_shape,
    write_image,
)
from modeharvest.imaging.photographs.photograph import (
    Photograph,
    read_frame,
    read_photograph,
    read_reference,
)
from modeharvest.report.model import text_of
from modeharvest.runs.photographs.case import DistortionTable, PhotographCase
from modeharvest.util.arrays import BoolArray, FloatImage
from modeharvest.util.errors import InputError, WriteError
from modeharvest.util.files import read_json, reading, write_json
from modeharvest.util.progress import Progress, counted, silent
from modeharvest.util.typed import made, picked, to_plain

PREPARED_FILE = "prepared.json"
LIBRARIES = ("numpy", "scipy", "numba", "scikit-image")
CODE = ("fem", "imaging", "idic", "runs")
"""What numbers from photographs depend on: libraries, and folders of the package."""
_ARRAYS = "shifts shifts_sd angles angles_sd matches covariance"


@dataclass(frozen=True, eq=False)
class PreparedPhotographs:
    """Photographs on the ideal grid, in a folder; read when asked for."""

    folder: Path
    """Has the files, and the rest in its ``prepared.json``."""
    names: tuple[str, ...]
    """Of the deformed images that can be used, in the order of the test."""
    skipped: tuple[tuple[str, str], ...]
    """The name of each file that can't be used, and why."""
    noise: CameraNoise
    grid: PixelGrid
    """The ideal pixels; the physical origin is the middle of the image."""
    full_scale: float
    """The camera's largest grey level."""
    notes: tuple[str, ...] = ()
    """What was done to the photographs."""

    @classmethod
    def read(cls, folder: Path) -> PreparedPhotographs:
        """Open a finished folder; raises InputError if it isn't one."""
        path = folder / PREPARED_FILE
        with reading(path, "prepared photographs", "remove it, and harvest again"):
            return made(cls, {**dict(read_json(path)), "folder": folder})

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file, the record last."""
        stems = (f"{name}{kind}" for name in ("reference", *self.names) for kind in ("", "_mask"))
        return (*(self.folder / f"{stem}.tif" for stem in stems), self.folder / PREPARED_FILE)

    def image(self, name: str = "reference") -> FloatImage:
        """(rows, cols) grey levels."""
        return read_image(self.folder / f"{name}.tif")

    def mask(self, name: str = "reference") -> BoolArray:
        """(rows, cols) True on material."""
        return read_mask(self.folder / f"{name}_mask.tif")

    def pair(self, name: str) -> ImagePair:
        """The reference and a deformed photograph."""
        return ImagePair(self.image(), self.image(name), self.grid, self.mask(), self.mask(name))


def named_files(base: Path, names: Sequence[str], unique: bool = True) -> tuple[Path, ...]:
    """The files that names, or patterns with wildcards, stand for.

    Raises InputError if a pattern matches no file, or, with ``unique``, two have the same stem:
    results are named by it.
    """
    paths: list[Path] = []
    for name in names:
        if any(sign in name for sign in "*?["):
            found = sorted(p for p in map(Path, glob.glob(str(base / name))) if p.is_file())
            if not found:
                raise InputError(f"expected files that match {base / name}, found none")
            paths += found
        else:
            paths.append(base / name)
    stems = [path.stem for path in paths]
    twice = next((stem for stem in stems if stems.count(stem) > 1 or stem == "reference"), None)
    if unique and twice is not None and len(paths) > 1:
        raise InputError(
            f"expected images whose names differ, and none called 'reference', got {twice!r} "
            "again; rename it, or narrow the pattern"
        )
    return tuple(paths)


def of_each_photograph(case: PhotographCase, names: Sequence[str], what: str) -> dict[str, Path]:
    """The file that goes with each deformed photograph, by the photograph's name.

    ``names`` of the files, or patterns; none at all is all right. Raises InputError if there
    aren't as many as photographs; ``what`` begins the message.
    """
    files = named_files(case.base, names, unique=False)
    photographs = named_files(case.base, case.images.deformed)
    if files and len(files) != len(photographs):
        raise InputError(
            f"{what}: expected one file for each of {len(photographs)} deformed images, got "
            f"{len(files)}"
        )
    return {path.stem: file for path, file in zip(photographs, files, strict=False)}


def all_files(case: PhotographCase) -> tuple[Path, ...]:
    """Every file that a case names, but fields of a local DIC."""
    images, table, lens = case.images, case.specimen, case.distortion
    names = [images.reference, *images.deformed, *images.repeats]
    names += [table.material, table.cells, *table.deformed_material]
    names += [lens.file, *lens.calibration]
    return named_files(case.base, [name for name in names if name], unique=False)


def require_inputs(case: PhotographCase) -> None:
    """Check that all is there that a case names.

    Raises InputError if a file is missing, or there aren't as many masks or fields as photographs;
    MissingDependencyError if pyvale is asked for and not installed.
    """
    local = case.local
    files = (*all_files(case), *named_files(case.base, local.files, unique=False))
    missing = [path for path in files if not path.is_file()]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(
            f"expected the files that the experiment names, found no file {missing[0]}{more}"
        )
    of_each_photograph(case, case.specimen.deformed_material, "specimen.deformed_material")
    of_each_photograph(case, local.files, "local.files")
    if local.code == "pyvale":
        pyvale_python()


@dataclass(frozen=True, eq=False)
class Optics:
    """The lens."""

    distortion: Distortion | None = None
    """S of the paper's Eq. (r2); None for none."""
    calibration: Calibration | None = None
    """How it was found, if it wasn't given."""


def calibrate_lens(
    table: DistortionTable, base: Path, folder: Path, progress: Progress = silent
) -> None:
    """Calibrate from the images of a target; leaves ``distortion.json``, ``calibration.json``.

    Raises InputError if a file can't be used, or the images don't determine the distortion.
    """
    images = [read_photograph(file).image for file in named_files(base, table.calibration)]
    shifts = [(row, col) for col, row in table.shifts] or None
    found = calibrate(images, shifts, progress=progress)
    write_distortion(folder / "distortion.json", found.distortion)
    content = to_plain(picked(found, f"{_ARRAYS} trials noise_sd"))
    content |= {"fixed": found.model.fixed, "text": calibration_text(found)}
    write_json(folder / "calibration.json", content)


def calibration_text(found: Calibration) -> tuple[str, ...]:
    """What was found, and what could not be."""
    chosen = next(t for t in found.trials if t.bic == 0.0)
    row, col = (np.linspace(0.0, n - 1.0, 25) for n in found.distortion.shape)
    size = np.hypot(*found.distortion.shift(row[:, None], col[None, :])).max()
    turned = np.abs(found.angles).max()
    text = [text_of("calibration-degree", chosen=chosen, count=len(found.trials), size=size)]
    if chosen is found.trials[-1] and len(found.trials) > 1:
        text.append(text_of("calibration-highest", chosen=chosen))
    text.append(text_of(f"calibration-shifts-{'given' if found.model.fixed == 1 else 'unknown'}"))
    if turned > 0.0:
        sd = 1e3 * found.angles_sd.max()
        text.append(text_of("calibration-turned", turned=1e3 * turned, sd=sd))
    return (*text, text_of("calibration-target"))


def calibrated_lens(folder: Path) -> Optics:
    """What :func:`calibrate_lens` left."""
    path = folder / "calibration.json"
    with reading(path, "a calibration", "remove it, and harvest again"):
        distortion, content = read_distortion(folder / "distortion.json"), read_json(path)
        if not isinstance(distortion, PolynomialDistortion):  # that is what is calibrated
            raise InputError("expected a polynomial in distortion.json beside it, got another kind")
        fixed = int(content["fixed"])
        arrays: dict[str, Any] = {name: np.array(content[name], float) for name in _ARRAYS.split()}
        calibration = Calibration(
            distortion=distortion,
            coefficients=distortion.coefficients[:, fixed:].ravel(),
            model=PolynomialModel(distortion.shape, distortion.degree, fixed),
            trials=tuple(DegreeTrial(**trial) for trial in content["trials"]),
            noise_sd=float(content["noise_sd"]),
            **arrays,
        )
        return Optics(distortion, calibration)


def prepare(
    case: PhotographCase,
    folder: Path,
    distortion: Distortion | None = None,
    progress: Progress = silent,
) -> PreparedPhotographs:
    """Make a case's photographs ready; leaves them in ``folder``.

    Raises InputError if the reference can't be used, or none of the deformed images.
    """
    images, table, base = case.images, case.specimen, case.base
    window = window_for(table.cell_size / case.scale.mm_per_px)

    def save(
        name: str, photograph: Photograph, given: Path | None
    ) -> tuple[BoolArray, Sequence[str]]:
        """Write image and mask without distortion; returns the photograph's own :func:`_mask`."""
        image, (mask, text) = photograph.image, _mask(photograph, given, window)
        own = mask
        if distortion is not None:
            image, mask = undistorted(image, distortion), undistorted_mask(mask, distortion)
        write_image(folder / f"{name}.tif", image)
        write_image(folder / f"{name}_mask.tif", mask)
        return own, text

    reference = read_reference(base / images.reference)
    mask, text = save("reference", reference, base / table.material if table.material else None)
    deformed = named_files(base, images.deformed)
    masks = of_each_photograph(case, table.deformed_material, "specimen.deformed_material")
    names, skipped, notes = [], [], [*reference.notes, *text]
    for path in counted(deformed, progress, "prepare photographs"):
        try:
            frame = read_frame(path, reference)
            save(path.stem, frame, masks.get(path.stem))
        except WriteError:
            raise
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
    prepared = PreparedPhotographs(
        folder,
        tuple(names),
        tuple(skipped),
        _noise(case, reference, mask),
        PixelGrid.centred(*reference.shape, case.scale.mm_per_px),
        float(reference.full_scale),
        tuple(notes),
    )
    content = to_plain(prepared)
    del content["folder"]
    write_json(folder / PREPARED_FILE, content)
    return prepared


def _mask(
    photograph: Photograph, given: Path | None, window: int
) -> tuple[BoolArray, Sequence[str]]:
    """Where a photograph shows material, as given or as found, and how it was found."""
    if given is None:
        require_speckle(photograph.image, photograph.path)
        found = find_material(photograph.image, window)
        return found.mask, found.text
    mask = read_mask(given)
    require_same_shape(photograph.image, mask, str(photograph.path), str(given))
    return mask, ()


def _noise(case: PhotographCase, reference: Photograph, mask: BoolArray) -> CameraNoise:
    """Given, measured or estimated, in this order; before any interpolation smooths it."""
    if case.noise.sd is not None:
        return CameraNoise(case.noise.sd, GIVEN)
    if not case.images.repeats:
        return estimated_noise(reference.image, mask)
    repeats = named_files(case.base, case.images.repeats, unique=False)
    others = [read_frame(path, reference).image for path in repeats]
    return measured_noise([reference.image, *others], mask)


def local_field(
    case: PhotographCase, prepared: PreparedPhotographs, name: str, distortion: Distortion | None
) -> LocalField | None:
    """The displacement field of one deformed photograph by a local DIC; None if there is none.

    Files are of the photographs before the lens was taken out of them; it is taken out here.
    Raises InputError if there aren't as many files as photographs, or this one's can't be used.
    """
    table, grid = case.local, prepared.grid
    if table.code == "none":
        return None
    if table.code == "pyvale":
        return subset_field(prepared.pair(name), SubsetOptions(table.subset, table.step))
    path = of_each_photograph(case, table.files, "local.files")[name]
    units, y_axis = (None if it == "auto" else it for it in (table.unit, table.y_axis))
    field = read_field(
        path, grid, units=units, y_axis=y_axis, first_pixel=table.first_pixel, columns=table.columns
    )
    return field if distortion is None else without_distortion(field, grid, distortion)
