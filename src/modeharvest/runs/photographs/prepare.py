"""Prepares photographs for correlation: finds files, lens, ideal images, masks, local fields.

Images are float32 grey levels in the camera's units, on the ideal (undistorted) pixel grid; masks
are white on material. A local DIC field comes from a file of another code, or from pyvale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.idic.local.field import LocalField, read_field, without_distortion
from modeharvest.idic.local.formats import frames_of
from modeharvest.idic.local.subsets import SubsetOptions, pyvale_python, subset_field
from modeharvest.idic.photograph.holes import HoleLattice, find_hole_lattice
from modeharvest.idic.photograph.matching.holes import RigidMotion, rigid_motion
from modeharvest.idic.photograph.material import find_material, window_for
from modeharvest.idic.photograph.plain.surface import coat_of_paint, one_specimen, plain_surface
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
    require_any_frame,
)
from modeharvest.report.model.text import text_of
from modeharvest.runs.photographs.case import DistortionTable, PhotographCase
from modeharvest.runs.photographs.sequence import chosen_frames, named_files
from modeharvest.util.arrays import BoolArray, FloatImage
from modeharvest.util.errors import InputError, WriteError
from modeharvest.util.files import read_json, reading, write_json
from modeharvest.util.progress import Progress, counted, silent
from modeharvest.util.typed import made, picked, to_plain

PREPARED_FILE = "prepared.json"
LIBRARIES = ("numpy", "scipy", "numba", "scikit-image")
CODE = ("fem", "imaging", "idic", "runs")
"""Libraries, and folders of the package, on which results from photographs depend."""
_PLAIN = "The material has no speckle: it was found by its grey level."
_ARRAYS = "shifts shifts_sd angles angles_sd matches covariance"


@dataclass(frozen=True, eq=False)
class PreparedPhotographs:
    """Photographs on the ideal grid, in a folder; each is read when it is needed."""

    folder: Path
    """The folder of the image files; the other data are in its ``prepared.json``."""
    names: tuple[str, ...]
    """Names of the deformed images that can be used, in the order of the test."""
    skipped: tuple[tuple[str, str], ...]
    """The name of each file that can't be used, and the reason."""
    noise: CameraNoise
    grid: PixelGrid
    """The ideal pixels; the physical origin is the middle of the image."""
    full_scale: float
    """The camera's largest grey level."""
    notes: tuple[str, ...] = ()
    """What was done to the photographs."""
    warnings: tuple[str, ...] = ()
    """What makes errors larger, and what else the photographs show."""
    is_plain: bool = False
    """Whether the photographs show no speckle; then contours are measured."""
    rigid: Mapping[str, RigidMotion] = field(default_factory=dict)
    """By name: rigid motion of the specimen, where it had turned; removed from the photograph.
    """

    @classmethod
    def read(cls, folder: Path) -> PreparedPhotographs:
        """Open a finished folder; InputError if it isn't one."""
        path = folder / PREPARED_FILE
        with reading(path, "prepared photographs", "remove it, and harvest again"):
            return made(cls, {**dict(read_json(path)), "folder": folder})

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file; ``prepared.json`` is the last."""
        stems = (f"{name}{kind}" for name in ("reference", *self.names) for kind in ("", "_mask"))
        return (*(self.folder / f"{stem}.tif" for stem in stems), self.folder / PREPARED_FILE)

    def image(self, name: str = "reference") -> FloatImage:
        """(rows, cols) image of a photograph [grey levels]."""
        return read_image(self.folder / f"{name}.tif")

    def mask(self, name: str = "reference") -> BoolArray:
        """(rows, cols) mask of a photograph, True on material."""
        return read_mask(self.folder / f"{name}_mask.tif")

    def pair(self, name: str) -> ImagePair:
        """The image pair of the reference and a deformed photograph."""
        return ImagePair(
            self.image(), self.image(name), self.grid, self.mask(), self.mask(name),
            is_plain=self.is_plain,
        )  # fmt: skip


def of_each_photograph(case: PhotographCase, names: Sequence[str], what: str) -> dict[str, Path]:
    """The file that goes with each deformed photograph, by the photograph's name.

    ``names``: file names or patterns; may be empty, or one file with a field for each photograph.
    Raises InputError, whose message begins with ``what``, if their number differs otherwise.
    """
    files = named_files(case.base, names, unique=False)
    photographs = named_files(case.base, case.images.deformed)
    if len(files) == 1 and frames_of(files[0]) == len(photographs):
        files *= len(photographs)
    if files and len(files) != len(photographs):
        raise InputError(
            f"{what}: expected one file for each of {len(photographs)} deformed images, got "
            f"{len(files)}"
        )
    return {path.stem: file for path, file in zip(photographs, files, strict=False)}


def all_files(case: PhotographCase) -> tuple[Path, ...]:
    """Every file that a case names, except the fields of a local DIC."""
    images, table, lens = case.images, case.specimen, case.distortion
    names = [images.reference, *images.deformed, *images.repeats]
    names += [table.material, table.cells, *table.deformed_material]
    names += [lens.file, *lens.calibration]
    return named_files(case.base, [name for name in names if name], unique=False)


def with_chosen_frames(
    case: PhotographCase, folder: Path, progress: Progress = silent
) -> PhotographCase:
    """A case whose photographs are files: folders, videos and choices among them are resolved.

    ``folder``: the run's, to which frames of videos are written. InputError if none is chosen.
    """
    images = case.images
    found = chosen_frames(
        case.base, images.reference, images.deformed, images, case.log, folder, progress
    )
    return case.of_frames(found)


def require_inputs(case: PhotographCase) -> None:
    """Check that all files and libraries that a case needs are available.

    Raises InputError if a file is missing, or there aren't as many masks or fields as photographs;
    MissingDependencyError if pyvale is asked for and not installed.
    """
    local = case.local
    all_files(case)
    of_each_photograph(case, case.specimen.deformed_material, "specimen.deformed_material")
    of_each_photograph(case, local.files, "local.files")
    if local.code == "pyvale":
        pyvale_python()


@dataclass(frozen=True, eq=False)
class Optics:
    """The lens."""

    distortion: Distortion | None = None
    """Distortion S of the paper's Eq. (5); None for a lens without distortion."""
    calibration: Calibration | None = None
    """The calibration that gave the distortion; None if the distortion was given."""


def calibrate_lens(
    table: DistortionTable, base: Path, folder: Path, progress: Progress = silent
) -> None:
    """Calibrate from the images of a target; writes ``distortion.json``, ``calibration.json``.

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
    """Text for the report: what the calibration determined, and what it could not."""
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
    """Read the files that :func:`calibrate_lens` wrote."""
    path = folder / "calibration.json"
    with reading(path, "a calibration", "remove it, and harvest again"):
        distortion, content = read_distortion(folder / "distortion.json"), read_json(path)
        if not isinstance(distortion, PolynomialDistortion):  # a calibration gives a polynomial
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
    case: PhotographCase, folder: Path, distortion: Distortion | None = None,
    progress: Progress = silent,
) -> PreparedPhotographs:  # fmt: skip
    """Prepare a case's photographs for correlation; writes them to ``folder``.

    Raises InputError if the reference, or every deformed image, can't be used.
    """
    images, table, base = case.images, case.specimen, case.base
    window = window_for(cell_px := table.cell_size / case.scale.mm_per_px)

    def save(name: str, photograph: Photograph, found: ShownMaterial) -> None:
        """Write a photograph's image and mask, with the lens distortion removed."""
        image, mask = photograph.image, found.mask
        if distortion is not None:
            image, mask = undistorted(image, distortion), undistorted_mask(mask, distortion)
        if name != "reference" and (turned := _turned(lattice, mask)) is not None:
            rigid[name] = turned
            image, mask = turned.undone(image, mask)
        write_image(folder / f"{name}.tif", image)
        write_image(folder / f"{name}_mask.tif", mask)

    rigid: dict[str, RigidMotion] = {}
    reference = read_reference(base / images.reference)
    deformed = named_files(base, images.deformed)
    require_any_frame(deformed, reference)
    own = _material(reference, base / table.material if table.material else None, window)
    own = own if table.material else _one_specimen(own, cell_px)
    save("reference", reference, own)
    lattice = None
    if case.local.code != "file":  # other codes' fields include the rigid motion
        with suppress(InputError):
            lattice = find_hole_lattice(read_mask(folder / "reference_mask.tif"))
    masks = of_each_photograph(case, table.deformed_material, "specimen.deformed_material")
    names, skipped = [], list(case.sequence.skipped if case.sequence else ())
    notes = [*reference.notes, *own.text, *(case.sequence.notes if case.sequence else ())]
    warnings = [*own.warnings, *reference.warnings]
    for path in counted(deformed, progress, "prepare photographs"):
        try:
            frame = read_frame(path, reference)
            shown = _material(frame, masks.get(path.stem), window, own)
            _require_alike(own, shown, path)
            shown = _one_specimen(shown, cell_px, own)
            if not own.is_plain:
                frame = _lit_as(reference, own.mask, frame, shown.mask)
            save(path.stem, frame, shown)
        except WriteError:
            raise
        except InputError as error:
            skipped.append((path.name, str(error)))
            continue
        names.append(path.stem)
        notes += [note for note in frame.notes if note not in notes]
        warnings += [text for text in frame.warnings if text not in warnings]
    if not names:
        raise InputError(
            f"expected a deformed image that can be used, got none of {len(deformed)}: "
            f"{skipped[0][1]}"
        )
    prepared = PreparedPhotographs(
        folder, tuple(names), tuple(skipped), _noise(case, reference, own.mask),
        PixelGrid.centred(*reference.shape, case.scale.mm_per_px), float(reference.full_scale),
        tuple(notes), tuple(warnings), own.is_plain, rigid,
    )  # fmt: skip
    content = to_plain(prepared)
    del content["folder"]
    write_json(folder / PREPARED_FILE, content)
    return prepared


@dataclass(frozen=True, eq=False)
class ShownMaterial:
    """The material that a photograph shows."""

    mask: BoolArray
    """(rows, cols) True on material."""
    text: tuple[str, ...] = ()
    """How the material was found, as text for the report."""
    is_plain: bool = False
    """Whether the material has no speckle."""
    warnings: tuple[str, ...] = ()
    """Says whether the photograph shows other specimens."""


def _material(
    photograph: Photograph, given: Path | None, window: int, like: ShownMaterial | None = None
) -> ShownMaterial:
    """The material given by a mask, or found; plain material is sought where ``like`` has it."""
    if given is not None:
        mask = read_mask(given)
        require_same_shape(photograph.image, mask, str(photograph.path), str(given))
        return ShownMaterial(mask)
    coat = None if like and like.is_plain else coat_of_paint(photograph.image)
    where = like.mask if like else None
    plain = None if coat is not None else plain_surface(photograph.image, where)
    if plain is not None:
        return ShownMaterial(plain.mask, (_PLAIN,), True, plain.warnings)
    found = find_material(photograph.image, window, coat)
    return ShownMaterial(found.mask, found.text)


def _require_alike(reference: ShownMaterial, deformed: ShownMaterial, path: Path) -> None:
    """InputError if only one of the two photographs shows speckle."""
    if reference.is_plain != deformed.is_plain:
        kinds = "a specimen with speckle", "a specimen without speckle"
        raise InputError(
            f"expected {kinds[reference.is_plain]} in {path}, like the reference's, got "
            f"{kinds[deformed.is_plain]}"
        )


def _one_specimen(
    shown: ShownMaterial, cell_px: float, like: ShownMaterial | None = None
) -> ShownMaterial:
    """The largest of several specimens in a photograph, or the one at the place of ``like``.

    Parts less than half a cell apart belong to one specimen.
    """
    where, of_another = like.mask if like else None, "give a mask of another one as material"
    for apart_px in (0.0, 0.25 * cell_px):  # the first is quick
        mask, text = one_specimen(shown.mask, where, of_another, apart_px)
        if not text:
            return shown
    return replace(shown, mask=mask, warnings=text)


_LIGHT = 0.03
"""Relative change of the material's mean or contrast above which illumination is corrected."""


def _lit_as(
    reference: Photograph, mask: BoolArray, frame: Photograph, shown: BoolArray
) -> Photograph:
    """A photograph with mean and contrast matched to the reference's material if they differ."""
    f, g = reference.image[mask], frame.image[shown]
    mean, contrast = float(f.mean(dtype=np.float64)), float(f.std(dtype=np.float64))
    gain = contrast / max(float(g.std(dtype=np.float64)), 1e-12)
    brighter = float(g.mean(dtype=np.float64)) / max(mean, 1e-12)
    if abs(gain - 1.0) < _LIGHT and abs(brighter - 1.0) < _LIGHT:
        return frame
    level = mean - gain * brighter * mean
    note = (
        f"{frame.path.name}: the light had changed; its levels g became {gain:.3f} g + {level:.3g}."
    )
    image = np.float32(gain) * frame.image + np.float32(level)
    return replace(frame, image=image.astype(np.float32), notes=(*frame.notes, note))


_TURNED_DEG = 0.5
"""Rotation [degrees] above which it is removed from a photograph: the pattern turns with it."""


def _turned(lattice: HoleLattice | None, mask: BoolArray) -> RigidMotion | None:
    """Rigid motion of a specimen if it has turned; None if it has not, or this isn't known."""
    with suppress(InputError):
        motion = None if lattice is None else rigid_motion(lattice, find_hole_lattice(mask))
        return motion if motion and abs(motion.angle_deg) > _TURNED_DEG else None
    return None


def _noise(case: PhotographCase, reference: Photograph, mask: BoolArray) -> CameraNoise:
    """Noise as given, else measured, else estimated; before interpolation smooths the images."""
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

    Files must be of the photographs with lens distortion; it is removed from the fields here.
    Raises InputError if there aren't as many files as photographs, or this one's can't be used.
    """
    table, grid = case.local, prepared.grid
    if table.code == "none":
        return None
    if table.code == "pyvale":
        return subset_field(prepared.pair(name), SubsetOptions(table.subset, table.step))
    files = of_each_photograph(case, table.files, "local.files")
    frame = list(files).index(name) + 1 if len({*files.values()}) < len(files) else None
    units, y_axis = (None if it == "auto" else it for it in (table.unit, table.y_axis))
    how = picked(table, "first_pixel columns")
    found = read_field(files[name], grid, units=units, y_axis=y_axis, frame=frame, **how)
    return found if distortion is None else without_distortion(found, grid, distortion)
