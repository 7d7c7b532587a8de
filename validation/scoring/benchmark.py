"""Benchmark image sets: public images, separate truth, and fields measured on the images.

::

    PUBLIC/reference.tif reference_8bit.tif mask.tif deformed_1280.tif deformed_1280_8bit.tif
           benchmark.json README.md
    TRUTH/ solution.h5 benchmark.json

Nothing in the public folder reveals the displacements: it has neither the solution nor the
material, loading or imperfection to compute it from. The set's id is a digest of its files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.finite_element.result import nodal_values
from modeharvest.idic.local.field import LocalField, read_field
from modeharvest.idic.local.tables import claimed_benchmark
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.util import RELEASE
from modeharvest.util import files as disk
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.stages import digest
from modeharvest.util.typed import made

RETURNED = {
    "what": "the displacement of material points, at their positions in the reference image",
    "columns": ["x [px]", "y down [px]", "u [px]", "v down [px]"],
    "origin": "the centre of the upper left pixel is (0, 0)",
    "lost": "points that were not measured stay in the file, with NaN as u and v",
    "id": "a first line '# benchmark: ID' lets a mistaken file be noticed",
    "formats": ["csv", "npz", "h5", "mat", "vtu"],
}
"""Specification of the displacements to be returned."""

_README = resources.files(__package__).joinpath("readme.txt").read_text("utf-8")


def readme(info: Mapping[str, Any]) -> str:
    """The README of a set, Markdown, from the content of its ``benchmark.json``."""
    reference, camera = info["reference"], f"{info['bits']} bit"
    rows = [
        f"| `{reference['image']}` | undeformed, float, {info['rows']} × {info['cols']} px |",
        f"| `{reference['camera_image']}` | undeformed, {camera} |",
        f"| `{reference['mask']}` | material of the undeformed image |",
    ]
    for entry in info["deformed"]:
        strain = f"nominal strain {100 * entry['nominal_strain']:g} %"
        rows += [f"| `{entry['image']}` | {strain}, float |",
                 f"| `{entry['camera_image']}` | {strain}, {camera} |"]  # fmt: skip
    return _README.format(table="\n".join(rows), last=info["deformed"][-1], **info)


FORMAT, TRUTH_FORMAT = "modeharvest-benchmark-1", "modeharvest-benchmark-truth-1"
SIDECAR, README, SOLUTION = "benchmark.json", "README.md", "solution.h5"
SECRETS = ("solution*", "truth*", "images*", "stages.json", "*.h5", "*.vtu", "*.toml")
"""Files that contain the truth, or from which it can be computed."""


@dataclass(frozen=True, eq=False)
class BenchmarkTruth:
    """The truth behind a set of images."""

    folder: Path
    id: str
    grid: PixelGrid
    specimen: Specimen
    strains: tuple[float, ...]
    """Nominal strains of the deformed images [-]."""

    @classmethod
    def read(cls, folder: Path | str) -> BenchmarkTruth:
        """Open a truth folder; InputError if it isn't one, or its solution isn't the images'."""
        folder, what = Path(folder), "the truth of a benchmark"
        remedy = (
            "'modeharvest benchmark make' leaves it beside the public folder, which has a "
            f"{SIDECAR} without truth"
        )
        with disk.reading(folder / SIDECAR, what, remedy):
            info = disk.read_record(folder / SIDECAR, TRUTH_FORMAT, what, remedy)
            grid, specimen = made(PixelGrid, info["grid"]), made(Specimen, info["specimen"])
            strains = tuple(map(float, info["strains"]))
            if disk.sha256_of(folder / SOLUTION) != info["solution_sha256"]:
                raise InputError(
                    f"expected in {folder / SOLUTION} the solution that benchmark {info['id']} was "
                    "made of, got another one or none; make the benchmark again"
                )
            return cls(folder, str(info["id"]), grid, specimen, strains)

    @cached_property
    def solution(self) -> Solution:
        """Mesh and displacements."""
        return Solution.read(self.folder / SOLUTION)

    @cached_property
    def mask(self) -> BoolArray:
        """(rows, cols) True where the reference image shows material."""
        mesh = self.solution.mesh
        return locate(mesh.nodes, mesh.cells, mesh.element, self.grid).mask

    def displacement(self, strain: float, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """(n, 2) displacement at points of the reference, interpolated in their elements [mm].

        NaN outside the material and at NaN positions. ``strain``: nominal strain of a deformed
        image [-], InputError if there is none; ``x, y``: (n,) [mm].
        """
        if not any(abs(strain - known) < 1e-9 for known in self.strains):
            have = ", ".join(f"{known:g}" for known in self.strains)
            raise InputError(
                f"expected a strain of benchmark {self.id}, got {strain:g}; it has {have}"
            )
        u, points = self.solution.at(strain).displacement, np.column_stack([x, y])
        return nodal_values(self.solution.mesh, u, points)


def set_record(form: str, files: Mapping[str, Any], **content: Any) -> dict[str, Any]:
    """Description of a public set; its id is a digest of its files' sizes and digests."""
    return {
        "format": form,
        "id": digest(files)[:12],
        "licence": "CC-BY-4.0",
        "made_with": f"modeharvest {RELEASE}",
        **content,
        "returned": RETURNED,
        "files": dict(files),
    }


def publish(
    images: ImageSet, specimen: Specimen, public: Path | str, truth: Path | str
) -> dict[str, Any]:
    """Write the public folder, and the record that belongs to it into the truth folder.

    ``images``: a finished set; ``specimen``: the undeformed geometry; ``public``: a finished set of
    the same images there is kept; ``truth``: contains ``solution.h5``, the images' solution.
    Returns the content of the public ``benchmark.json``. InputError if a lens distorts the images,
    image files were changed after rendering, or the truth would be public.
    """
    public, truth = Path(public), Path(truth)
    require_apart(public, truth)
    require_no_lens(images.spec)
    if not _is_whole(public, truth, images):
        for part in (public / SIDECAR, truth / SIDECAR):
            part.unlink(missing_ok=True)
        info = _write_public(images, specimen, public)
        disk.write_json(public / SIDECAR, info)
        hidden = {
            "format": TRUTH_FORMAT,
            "id": info["id"],
            "key": images.info["key"],
            "strains": list(images.strains),
            "grid": asdict(images.grid),
            "specimen": specimen.plain(),
            "solution_sha256": disk.sha256_of(truth / SOLUTION),
            "public_sha256": {name: disk.sha256_of(public / name) for name in (SIDECAR, README)},
        }
        disk.write_json(truth / SIDECAR, hidden)  # last: it marks the set as complete
    content: dict[str, Any] = disk.read_json(public / SIDECAR)
    return content


def require_apart(public: Path, truth: Path) -> None:
    """Raise InputError if the truth is, or would be, in the public folder."""
    inside = truth.resolve()
    if inside == public.resolve() or public.resolve() in inside.parents:
        raise InputError(
            f"expected the truth apart from the public folder {public}, got {truth}; give --truth"
        )
    secrets = [path.name for pattern in SECRETS for path in sorted(public.glob(pattern))]
    if secrets:
        raise InputError(
            f"expected a public folder without truth, got {secrets[0]} in {public}; "
            "give another --out"
        )


def require_no_lens(spec: ImagingSpec) -> None:
    """Raise InputError if images are distorted: their apparent motion isn't the specimen's."""
    if spec.distortion is not None:
        raise InputError(
            "expected images without a lens for a benchmark, got distorted ones, in which a "
            "displacement isn't that of the specimen; leave out [imaging.distortion]"
        )


def _write_public(images: ImageSet, specimen: Specimen, public: Path) -> dict[str, Any]:
    """Copy the images and write the README; returns the content of ``benchmark.json``."""
    reference = {key: images.info["reference"][key] for key in ("image", "camera_image", "mask")}
    deformed = [
        {"nominal_strain": s["nominal_strain"], "image": s["image"],
         "camera_image": s["camera_image"]}
        for s in images.info["snapshots"]
    ]  # fmt: skip
    kept = [*reference.values(), *(d[k] for d in deformed for k in ("image", "camera_image"))]
    files = {name: dict(images.info["files"][name]) for name in kept}
    for name, entry in files.items():
        disk.copy_whole(images.folder / name, public / name)
        if disk.sha256_of(public / name) != entry["sha256"]:
            (public / name).unlink()
            raise InputError(
                f"expected the image that was rendered in {images.folder / name}, got another one; "
                "make the images again with 'modeharvest image'"
            )
    grid = images.grid
    info = set_record(
        FORMAT, files, rows=grid.rows, cols=grid.cols, pixel_size_mm=grid.pixel_size,
        first_pixel_mm={"x": grid.x0, "y_up": grid.y0}, unit_cell_mm=specimen.pitch,
        bits=images.spec.bits, background=images.spec.background, reference=reference,
        deformed=deformed,
    )  # fmt: skip
    with disk.atomic(public / README) as part:
        part.write_text(readme(info), "utf-8")
    return info


def _is_whole(public: Path, truth: Path, images: ImageSet) -> bool:
    """Whether both folders hold these images and their truth, complete and unchanged."""
    try:
        info, hidden = disk.read_json(public / SIDECAR), disk.read_json(truth / SIDECAR)
        digests = {name: entry["sha256"] for name, entry in info["files"].items()}
        digests |= hidden["public_sha256"]
        return bool(
            info["id"] == hidden["id"]
            and hidden["key"] == images.info["key"]
            and hidden["solution_sha256"] == disk.sha256_of(truth / SOLUTION)
            and all(disk.sha256_of(public / name) == known for name, known in digests.items())
        )
    except (InputError, KeyError, TypeError):
        return False


# -- fields measured on a set ----------------------------------------------------------

_OPTIONS = {
    "give units='px' or 'mm'": "give --unit px or mm",
    "give y_axis='up' or 'down'": "give --y-axis up or down",
    "name them in columns": "say which of them by --column, as u=disp_x",
}


@dataclass(frozen=True)
class Declared:
    """Properties of a field's file that it doesn't state itself.

    Fields without a description: see :func:`modeharvest.idic.local.field.read_field`.
    """

    name: str | None = None
    """Name of the code, for tables; by default the file's name."""
    units: str | None = None
    displacement_units: str | None = None
    y_axis: str | None = None
    first_pixel: int | None = None
    columns: Mapping[str, str | int] | None = None


def read_measured(
    path: Path | str, grid: PixelGrid, benchmark: str, declared: Declared | None = None
) -> LocalField:
    """Read a field to be graded.

    ``path``: a file that :func:`~modeharvest.idic.local.field.read_field` can read; ``grid``,
    ``benchmark``: the benchmark's pixels and its id. InputError if the file can't be read, or names
    another benchmark.
    """
    path, how = Path(path), asdict(declared or Declared())
    name = how.pop("name") or path.stem
    disk.require_file(path, "a displacement field", "check its name")
    claimed = claimed_benchmark(path)
    if claimed not in (None, benchmark):
        raise InputError(
            f"{path}: expected a field of benchmark {benchmark}, but it says that it is of "
            f"{claimed}; take the truth of that one"
        )
    try:
        return replace(read_field(path, grid, **how), source=name)
    except InputError as error:
        message = str(error)
        for argument, option in _OPTIONS.items():
            message = message.replace(argument, option)
        raise InputError(message) from error
