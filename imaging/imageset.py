"""Benchmark images with certified ground truth: a folder on which any DIC code can be scored.

::

    reference.tif  reference_8bit.tif  mask.tif
    deformed_0780.tif  deformed_0780_8bit.tif  deformed_0780_mask.tif  truth_0780.h5
    images.json

The number in a file's name is the nominal strain in hundredths of a percent (0780 is 7.80 %).
The plain images are noise-free averages over the pixels in float32. Images with a bit depth in
their name are single exposures by the sensor: with noise, saturation, rounding. ``images.json``
says how the set was made and is written last: without it, the set isn't finished. Files are checked
against its SHA-256 sums when read. It also holds the options to reproduce the set, and:

``noise``
    Predicted ``variance = constant + slope * (grey - offset)`` [fraction of full scale, squared].
``reference``, ``snapshots``
    An ``ImageRecord``, and a ``SnapshotRecord`` for each deformed image.
``warnings``
    Texts about differences of the images from those a real camera would take.

With lens distortion, images and masks are distorted, and the truth
(:mod:`modeharvest.imaging.pair`) is on the ideal grid, where undistorted images are measured.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.fem.field import Snapshot, Solution
from modeharvest.imaging.camera import Camera, ImageRecord
from modeharvest.imaging.distortion.files import read_distortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import Located, locate
from modeharvest.imaging.pair import KnownPair, Truth
from modeharvest.imaging.photographs.files import read_image, read_mask
from modeharvest.imaging.render import ImagedState, render_deformed, render_reference
from modeharvest.imaging.spec import ImagingSpec, choose_grid
from modeharvest.imaging.speckle.pattern import Speckle
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_record, reading, sha256_of, write_json
from modeharvest.util.progress import Progress, silent
from modeharvest.util.stages import source_digest, versions
from modeharvest.util.typed import made

FORMAT = "modeharvest-images-1"


def image_key(solution: Solution, spec: ImagingSpec, strains: Sequence[float]) -> str:
    """Hexadecimal digest of everything that images at these nominal strains [-] depend on.

    InputError if a snapshot is missing, or a distortion's file can't be read.
    """
    digest = hashlib.sha256()
    parts = {"format": FORMAT, "code": source_digest("fem", "imaging"), "spec": asdict(spec),
             "element": solution.mesh.element, "strains": [float(s) for s in strains]}  # fmt: skip
    digest.update(json.dumps(parts, sort_keys=True).encode())
    if isinstance(spec.distortion, str):
        read_distortion(spec.distortion)  # raises InputError if the file is invalid
        digest.update(sha256_of(spec.distortion).encode())
    for array in (solution.mesh.nodes, solution.mesh.cells):
        digest.update(array.tobytes())
    for strain in strains:
        digest.update(np.ascontiguousarray(solution.at(strain).displacement).tobytes())
    return digest.hexdigest()


SIDECAR = "images.json"
_LIBRARIES = ("numpy", "scipy", "numba", "finufft", "h5py", "tifffile")
"""Libraries whose versions are recorded: the pixels depend on them."""
_OWN_FILES = ("reference*.tif", "mask.tif", "deformed_[0-9]*.tif", "truth_[0-9]*.h5")


@dataclass(frozen=True, kw_only=True)
class SnapshotRecord(ImageRecord):
    """Record of a deformed image in the set's ``images.json``."""

    nominal_strain: float
    branch: str
    """Nominal strain [-] and branch of the snapshot."""
    truth: str
    """Name of the truth file."""
    inverse_map_max_residual_px: float
    """Largest residual of the inverse mapping [px]."""


@dataclass(frozen=True, eq=False)
class ImageSet:
    """A finished image set on disk.

    Images and truth are read on access: InputError if a file's SHA-256 has changed.
    """

    folder: Path
    info: dict[str, Any]
    """Content of ``images.json``."""

    @classmethod
    def read(cls, folder: Path | str) -> ImageSet:
        """Open a set; InputError if it isn't there or isn't finished."""
        what, remedy = "a finished image set", "make it again with 'modeharvest image'"
        path = Path(folder) / SIDECAR
        with reading(path, what, remedy):
            images = cls(Path(folder), read_record(path, FORMAT, what, remedy))
            _ = images.grid, images.spec, images.max_residual_px
            records = (images._reference, *images._snapshots)
            names = [name for record in records for name in _file_names(record)]
            if not set(names) <= set(images.digests):
                raise InputError(f"expected digests of {names}, got {list(images.digests)}")
            return images

    @property
    def grid(self) -> PixelGrid:
        """The pixels of all images of the set."""
        return made(PixelGrid, self.info["grid"])

    @property
    def spec(self) -> ImagingSpec:
        """How the set was imaged."""
        return made(ImagingSpec, self.info["spec"])

    @property
    def strains(self) -> tuple[float, ...]:
        """Nominal strains of the deformed images [-]."""
        return tuple(record.nominal_strain for record in self._snapshots)

    @cached_property
    def _reference(self) -> ImageRecord:
        return made(ImageRecord, self.info["reference"])

    @cached_property
    def _snapshots(self) -> tuple[SnapshotRecord, ...]:
        return tuple(made(SnapshotRecord, record) for record in self.info["snapshots"])

    @property
    def max_residual_px(self) -> float:
        """Largest residual of the inverse mapping in the whole set [px]."""
        return float(self.info["inverse_map_max_residual_px"])

    def reference(self, *, camera: bool = False) -> FloatImage:
        """(rows, cols) reference image [fraction of full scale]; ``camera``: as exposed."""
        return self._image(self._reference, camera)

    def mask(self) -> BoolArray:
        """(rows, cols) True where the reference image shows material."""
        return read_mask(self._whole(self._reference.mask))

    def deformed(self, strain: float, *, camera: bool = False) -> FloatImage:
        """(rows, cols) deformed image [fraction of full scale] at a nominal strain [-]."""
        return self._image(self._snapshot(strain), camera)

    def deformed_mask(self, strain: float) -> BoolArray:
        """(rows, cols) True where the deformed image shows material."""
        return read_mask(self._whole(self._snapshot(strain).mask))

    def pair(self, strain: float, *, camera: bool = False) -> KnownPair:
        """The reference and the deformed image at a nominal strain [-]; ``camera``: as exposed."""
        f, g = self.reference(camera=camera), self.deformed(strain, camera=camera)
        masks = self.mask(), self.deformed_mask(strain)
        return KnownPair(f, g, self.grid, *masks, self.truth(strain), strain)

    def __iter__(self) -> Iterator[KnownPair]:
        """The noise-free image pairs of the set, each read when it is reached."""
        return map(self.pair, self.strains)

    def noise_sd(self, strain: float | None = None) -> FloatArray:
        """(rows, cols) predicted standard deviation of a camera image [fraction of full scale].

        ``strain``: nominal strain of the deformed image; None for the reference image.
        """
        mean = self.reference() if strain is None else self.deformed(strain)
        return np.sqrt(self.spec.sensor.noise_variance(mean, self.spec.bits))

    def truth(self, strain: float) -> Truth:
        """The truth of the deformed image at a nominal strain [-]; read on access."""
        name = self._snapshot(strain).truth
        return Truth(lambda part: Truth.read(self._whole(name)).part(part))

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 of every file except ``images.json``, by file name."""
        return {name: str(entry["sha256"]) for name, entry in self.info["files"].items()}

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file of the set, ``images.json`` last."""
        return (*(self.folder / name for name in self.digests), self.folder / SIDECAR)

    def is_whole(self) -> bool:
        """Whether every file still has the SHA-256 it was written with."""
        return all(sha256_of(self.folder / name) == s for name, s in self.digests.items())

    def _image(self, record: ImageRecord, camera: bool) -> FloatImage:
        image = read_image(self._whole(record.camera_image if camera else record.image))
        if camera:  # white of a 12-bit camera is 4095, not the file's 65535
            full_scale = 255.0 if self.spec.bits <= 8 else 65535.0
            image *= np.float32(full_scale / (2**self.spec.bits - 1))
        return image

    def _whole(self, name: str) -> Path:
        """Path of a file; InputError unless it has the SHA-256 it was written with."""
        path = self.folder / name
        if sha256_of(path) != self.digests[name]:
            raise InputError(
                f"expected {path} as {SIDECAR} has its SHA-256, got another file or none; make it "
                "again with 'modeharvest image'"
            )
        return path

    def _snapshot(self, strain: float) -> SnapshotRecord:
        for record in self._snapshots:
            if abs(record.nominal_strain - strain) < 1e-9:
                return record
        raise InputError(
            f"expected an image at strain {strain} in {self.folder}, have: "
            f"{', '.join(f'{s:.4f}' for s in self.strains)}"
        )


def is_complete(folder: Path | str, key: str) -> bool:
    """Whether ``folder`` holds a complete set with this key (:func:`image_key`)."""
    try:
        found = ImageSet.read(folder)
    except InputError:
        return False
    return found.info.get("key") == key and found.is_whole()


def make_images(
    solution: Solution,
    spec: ImagingSpec,
    folder: Path | str,
    strains: Sequence[float] | None = None,
    progress: Progress = silent,
) -> ImageSet:
    """Make the images and the truth of some snapshots, or open the set if it already exists.

    InputError if a snapshot is missing, an element is inverted, two strains would have the same
    file name, or a file can't be written.

    solution, spec : what is imaged, and how.
    folder : where to write; made if it doesn't exist. A complete set with the same solution, spec,
        strains and code is kept; any other set there is replaced.
    strains : nominal strains of the snapshots to image [-]; by default all.
    """
    folder = Path(folder)
    if strains is None:
        strains = tuple(dict.fromkeys(s.nominal_strain for s in solution.snapshots))
    labels = {_label(s) for s in strains}
    if not labels or len(labels) < len(strains):
        raise InputError(f"expected strains that differ by 0.01 % or more, got {list(strains)}")
    key = image_key(solution, spec, strains)
    if is_complete(folder, key):
        return ImageSet.read(folder)
    (folder / SIDECAR).unlink(missing_ok=True)  # first: this file marks a set as complete
    for path in (path for pattern in _OWN_FILES for path in folder.glob(pattern)):
        path.unlink(missing_ok=True)
    info, names = _write_set(solution, strains, spec, folder, progress)
    files = {n: {"bytes": (folder / n).stat().st_size, "sha256": sha256_of(folder / n)}
             for n in names}  # fmt: skip
    write_json(folder / SIDECAR, {"format": FORMAT, "key": key, **info, "files": files})
    progress(1, 1, "images")
    return ImageSet.read(folder)


def _write_set(
    solution: Solution, strains: Sequence[float], spec: ImagingSpec, folder: Path, report: Progress
) -> tuple[dict[str, Any], list[str]]:
    """Write all files except ``images.json``; return its content and the files' names."""
    steps, mesh = 1 + len(strains), solution.mesh
    report(0, steps, "images: reference")
    grid = choose_grid(solution, strains, spec)
    located = locate(mesh.nodes, mesh.cells, mesh.element, grid, "undeformed mesh")
    speckle = Speckle(spec.speckle, grid.shape)
    state = ImagedState(mesh, None, grid, speckle, spec.background, "undeformed mesh")
    camera = Camera.of(spec, grid.shape, folder)
    ideal = render_reference(state, located)
    reference = camera.expose(ideal, state, "reference", "mask.tif")
    snapshots = []
    for k, strain in enumerate(strains):
        report(1 + k, steps, f"images: strain {100 * strain:.2f} %")
        where = f"snapshot at strain {strain:.4f}"
        moved = replace(state, displacement=solution.at(strain).displacement, where=where)
        snapshots.append(_write_snapshot(camera, moved, solution.at(strain), strain, located))
    residuals, records = [s.inverse_map_max_residual_px for s in snapshots], [reference, *snapshots]
    plain = [{n: v for n, v in asdict(record).items() if v is not None} for record in records]
    constant, slope = spec.sensor.noise_model(spec.bits)
    info = {
        "grid": asdict(grid),
        "spec": asdict(spec),
        "speckle_period_px": list(speckle.period),
        "inverse_map_max_residual_px": max(located.max_residual_px, *residuals),
        "noise": {"constant": constant, "slope": slope, "offset": spec.sensor.offset},
        "reference": plain[0],
        "snapshots": plain[1:],
        "warnings": [
            f"{record.image}: {record.doubly_covered_px} px lie inside more than one element; the "
            "specimen overlaps there, as a real one in contact doesn't"
            for record in records
            if record.doubly_covered_px
        ],
        "solution": dict(solution.info),
        "versions": versions(*_LIBRARIES),
    }
    return info, [name for record in records for name in _file_names(record)]


def _write_snapshot(
    camera: Camera, state: ImagedState, snapshot: Snapshot, strain: float, located: Located
) -> SnapshotRecord:
    """Write a deformed image, its mask and its truth; ``located``: of the reference image."""
    ideal, truth = render_deformed(state, located)
    name, truth_name = f"deformed_{_label(strain)}", f"truth_{_label(strain)}.h5"
    record = camera.expose(ideal, state, name, f"{name}_mask.tif")
    truth.write(camera.folder / truth_name, strain, state.grid)
    return SnapshotRecord(
        **vars(record),
        nominal_strain=float(strain),
        branch=snapshot.branch,
        truth=truth_name,
        inverse_map_max_residual_px=float(np.nanmax(truth.residual_px)),
    )


def _file_names(record: ImageRecord) -> list[str]:
    more = [record.truth] if isinstance(record, SnapshotRecord) else []
    return [record.image, record.camera_image, record.mask, *more]


def _label(strain: float) -> str:
    return f"{round(1e4 * strain):04d}"
