"""Whole displacement in images of any surface, speckled or plain, in a folder that can be resumed.

::

    mask.tif  mesh.h5                      prepare   material mask, and its mesh
    results/NAME.h5 NAME.vtu NAME.csv      NAME      results of one deformed image, described in
    results/NAME_u_mm.tif ...                        modeharvest.idic.finite_element.files
    results/NAME_holes.csv                           holes, if there is no speckle
    gauges.csv  gauges_along.csv                     readings of the gauges, if any
    report.html  summary.json                        of all images
    stages.json  timings.json                        finished stages, and their durations

Lengths are in mm if the pixel size is given, else in px; every file states the unit. The origin is
the middle of the image, x points right, y up.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from modeharvest.fem.field import Mesh, plane_triangles, read_any_mesh, read_mesh, write_mesh
from modeharvest.idic.chebyshev import Brightness
from modeharvest.idic.finite_element.equations.system import Body
from modeharvest.idic.finite_element.files import (
    Given,
    read_result,
    write_csv,
    write_maps,
    write_result,
    write_vtu,
)
from modeharvest.idic.finite_element.light import LOCAL, brightness, residual
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.mesh import MeshedMaterial, mesh_of_mask, quadratic
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.photograph.axes import require_angle, strains_along, turned_sides
from modeharvest.idic.photograph.displacement import (
    block_motion,
    deformed_mask,
    displacement_from,
    misfit_of,
    speckled,
)
from modeharvest.idic.photograph.gauges import (
    along_axes,
    points_of,
    read_gauges,
    reading_rows,
    write_gauges,
)
from modeharvest.idic.photograph.material import find_material, mixed_edge_px
from modeharvest.idic.photograph.plain.measure import displacement_of_plain, write_shapes
from modeharvest.idic.photograph.plain.surface import MaterialContours, coat_of_paint, plain_surface
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.files import read_mask, require_same_shape, write_image
from modeharvest.imaging.photographs.photograph import (
    Photograph,
    read_frame,
    read_reference,
    require_any_frame,
)
from modeharvest.runs.photographs.machine_log import LogTable
from modeharvest.runs.photographs.prepare import CODE, LIBRARIES
from modeharvest.runs.photographs.sequence import (
    ChosenFrames,
    FrameChoice,
    chosen_frames,
    named_files,
    recorded_with,
)
from modeharvest.runs.whole_field import BYTES_PER_PIXEL
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.files import (
    atomic_hdf5,
    open_hdf5,
    reading,
    require_file,
    require_writable,
    sha256_of,
    write_json,
)
from modeharvest.util.machine import require_memory
from modeharvest.util.progress import Progress, silent
from modeharvest.util.stages import StagedRun, command_line, digest, exclusive, stage_key, versions
from modeharvest.util.typed import picked

_LEAST_PX = 1000
"""Smallest number of pixels that a mesh must cover: about four elements."""
_OVERLAP = 0.01
"""Largest fraction of a mesh's pixels that may lie in two elements."""
_LOCAL_LIGHT = (
    "The light changed along the material otherwise than by polynomials: gain and offset were "
    "taken from around each pixel, which makes errors larger; light the specimen evenly."
)
_MESH_FORMAT = "modeharvest-mesh-1"


@dataclass(frozen=True)
class MeasureCase:
    """Images of a speckled surface.

    ``reference``, ``deformed``: image files; ``deformed`` in the order of the test, wildcards
    allowed. ``mask``: an image that is not black on material of the reference; None to find the
    material by its speckle. ``pixel_size`` [mm]; None for lengths in px. ``mesh``: file of a
    plane mesh of the material that meshio reads; None to mesh the mask. ``brightness``: degree, 0
    to 6, of the polynomials for gain and offset over an image, or "none". ``gauges``: TOML file of
    gauges for the report. ``angle``: from x to the specimen's axis, counter-clockwise [degrees]:
    mean strains, and those of gauges without an angle, are along it. ``sequence``: the files that
    the names stand for, if these are folders or videos; ``choice``: the command's options for
    choosing among them.
    """

    reference: Path
    deformed: tuple[str, ...]
    mask: Path | None = None
    pixel_size: float | None = None
    mesh: Path | None = None
    brightness: int | str = 1
    sequence: ChosenFrames | None = None
    choice: tuple[str, ...] = ()
    gauges: Path | None = None
    angle: float = 0.0

    def __post_init__(self) -> None:
        Brightness.of(self.brightness)  # checks it
        require_angle("--angle", self.angle)
        if self.pixel_size is not None:
            require_within("expected a pixel size [mm]", self.pixel_size, 1e-9, 1e6)
        for path in (self.mask, self.mesh, self.gauges):
            if path is not None:
                require_file(path, "a file", "check its name")

    @property
    def files(self) -> dict[str, Path]:
        """The files of the deformed images, by image name, in the order of the test."""
        paths = self.sequence.deformed if self.sequence else named_files(Path(), self.deformed)
        return {path.stem: path for path in paths}

    @property
    def unit(self) -> str:
        """The unit of lengths, "mm" or "px"."""
        return "px" if self.pixel_size is None else "mm"


@dataclass(frozen=True)
class MeasureRun(StagedRun[MeasureCase]):
    """The stages of a measurement."""

    @cached_property
    def reference(self) -> Photograph:
        """The reference image; InputError if it shows no speckle."""
        given, reference = self._given_mask, read_reference(self.case.reference)
        if given is not None:
            names = str(self.case.reference), str(self.case.mask)
            require_same_shape(reference.image, given, *names)
        require_memory(BYTES_PER_PIXEL * reference.image.size,
                       f"an image of {reference.image.size / 1e6:.0f} Mpx", "crop it")  # fmt: skip
        return reference

    @cached_property
    def _given_mask(self) -> BoolArray | None:
        return None if self.case.mask is None else read_mask(self.case.mask)

    @cached_property
    def plain(self) -> MaterialContours | None:
        """The reference's contours if it has no speckle; None if it has, or a mask is given."""
        of_images = self.case.mask is self.case.mesh is None
        return plain_surface(self.reference.image) if of_images else None

    @cached_property
    def grid(self) -> PixelGrid:
        """The pixel grid of the reference [mm or px]."""
        return PixelGrid.centred(*self.reference.shape, self.case.pixel_size or 1.0)

    @cached_property
    def _key(self) -> str:
        inputs = [self.case.reference, self.case.mask, self.case.mesh]
        files = [None if path is None else sha256_of(path) for path in inputs]
        return stage_key([files, self.case.pixel_size, self.case.brightness], *CODE)

    @cached_property
    def material(self) -> MeshedMaterial:
        """The material's mask and mesh; writes ``mask.tif`` and ``mesh.h5``."""
        mask_path, mesh_path = self.folder / "mask.tif", self.folder / "mesh.h5"

        def work() -> tuple[Path, ...]:
            found = self._material() if self.case.mesh is None else self._meshed(self.case.mesh)
            write_image(mask_path, found.mask)
            with atomic_hdf5(mesh_path) as file:
                warnings = json.dumps(found.changes)
                file.attrs.update(format=_MESH_FORMAT, unit=self.case.unit, warnings=warnings)
                write_mesh(file, found.mesh)
            return mask_path, mesh_path

        self.do("prepare", self._key, work)
        with open_hdf5(mesh_path, "a mesh", "measure again", _MESH_FORMAT) as file:
            warnings = tuple(json.loads(file.attrs["warnings"]))
            return MeshedMaterial(read_mesh(file), read_mask(mask_path), warnings)

    @cached_property
    def _body(self) -> Body:
        return Body(self.material.mesh, self.material.mask if self.case.mesh is None else None)

    @cached_property
    def _options(self) -> FiniteElementOptions:
        return FiniteElementOptions(edge_px=mixed_edge_px(self.reference.image, self.material.mask))

    def _material(self) -> MeshedMaterial:
        """Mesh the measurable part of the given mask, or of the material found by speckle."""
        given, options, image = self._given_mask, FiniteElementOptions(), self.reference.image
        blank: tuple[str, ...] = ()
        if self.plain is not None:
            mask, blank = self.plain.mask, self.plain.warnings
        else:
            if given is None:
                given = find_material(image, coat=coat_of_paint(image)).mask
            mask, blank = speckled(image, given)
        found = mesh_of_mask(mask, self.grid, options.element_px, options.edge_element_px)
        return found._replace(changes=(*blank, *found.changes))

    def _meshed(self, path: Path) -> MeshedMaterial:
        """A given mesh without elements beside image or mask; no mask given: the pixels it covers.

        Raises InputError if the mesh isn't on the image or the mask, or its elements overlap.
        """
        unit = self.case.unit
        with reading(path, "a mesh"):
            mesh = quadratic(plane_triangles(read_any_mesh(path), path))
        warnings: tuple[str, ...] = ()
        located = locate(mesh.nodes, mesh.cells, mesh.element, self.grid, str(path))
        covered, here = located.mask, f"in {unit}, from the middle of the image, x right, y up"
        if covered.sum() < _LEAST_PX:
            raise InputError(
                f"expected a mesh on the image in {path}, got one that covers {covered.sum()} of "
                f"its pixels; its lengths are {here}: give --pixel-size if they are in mm, or "
                "move the mesh"
            )
        if located.doubly_covered > _OVERLAP * covered.sum():
            raise InputError(
                f"expected elements that don't overlap in {path}, got {located.doubly_covered} px "
                "in more than one; repair the mesh"
            )
        mask = covered if self._given_mask is None else self._given_mask
        size = np.array(self.grid.shape) - 1
        off = np.abs(np.column_stack(self.grid.to_px(*mesh.nodes.T)) - size / 2) > size / 2
        shown, used = (np.bincount(located.element[where], minlength=len(mesh.cells)) > 0
                       for where in (covered, covered & mask))  # fmt: skip
        beside = np.where(shown, ~used, np.any(off, axis=1)[mesh.cells].all(axis=1))
        if not used.any():
            raise InputError(f"expected a mesh of the mask's material in {path}, got one beside it")
        if beside.any():
            mesh = quadratic(Mesh(mesh.nodes, mesh.cells[~beside], mesh.element))
            warnings = (
                f"{int(beside.sum())} of {beside.size} elements lie beside the image or the mask "
                f"and were left out; lengths of the mesh are {here}.",
            )
        return MeshedMaterial(mesh, mask, warnings)

    def pair(self, name: str) -> ImagePair:
        """The image pair of the reference and a deformed image, with the mask."""
        frame = read_frame(self.case.files[name], self.reference)
        images, is_plain = (self.reference.image, frame.image), self.plain is not None
        return ImagePair(*images, self.grid, self.material.mask, is_plain=is_plain)

    def results(self) -> Mapping[str, NodalResult]:
        """Measure all images, each starting from the last one measured; writes ``results/``.

        Raises InputError if no image can be measured.
        """
        found, failed = self._found
        if not found:
            raise InputError(next(iter(failed.values())))
        return found

    @cached_property
    def _found(self) -> tuple[Mapping[str, NodalResult], dict[str, str]]:
        """Results by image name, and for each failed image the reason."""
        files, key, keys = self.case.files, self._key, {}
        folder, given = self.folder / "results", Given(self.case.unit)
        _ = self.material  # so that errors of the reference aren't reported for an image
        for name, path in files.items():
            keys[name] = key = digest([key, name, sha256_of(path)])

        def tables(name: str) -> list[Path]:
            return [folder / f"{name}.{kind}" for kind in ("h5", "vtu", "csv")]

        def work(
            name: str, last: tuple[str, NodalResult] | None
        ) -> tuple[Sequence[Path], dict[str, Any]]:
            self.progress(list(files).index(name), len(files), "measure images")
            found, *holes = self._measured(name, last and last[1], folder)
            paths = tables(name)
            write_result(paths[0], found, given)
            write_vtu(paths[1], found, given)
            write_csv(paths[2], found, given=given)
            return (*paths, *holes, *write_maps(folder / name, found, given=given)), {}

        def read(name: str, _: dict[str, Any]) -> NodalResult:
            return read_result(tables(name)[0])

        found = self.do_in_turn("image", keys, folder, work, read)
        self.progress(1, 1, "measure images")
        return found

    def _measured(
        self, name: str, before: NodalResult | None, folder: Path
    ) -> tuple[NodalResult, *tuple[Path, ...]]:
        """Measure an image; without speckle, also writes tables of its holes and dots."""
        pair, body = self.pair(name), self._body
        if self.plain is not None:
            path = str(self.case.files[name])
            found, contours = displacement_of_plain(
                self.plain, pair.deformed, self.grid, body, self.progress, path,
                None if before is None else before.displacement,
            )  # fmt: skip
            return found, *write_shapes(folder, name, contours, self.case.unit)
        names = str(self.case.reference), str(self.case.files[name])
        known = 0.0 * body.mesh.nodes if before is None else before.displacement
        start, light = block_motion(pair, body, known, names), Brightness.of(self.case.brightness)
        return (displacement_from(start, pair, body, self._options, self.progress, light.degree),)

    def _with_roots(self) -> Iterator[tuple[str, NodalResult]]:
        """Name and displacement of each image, with the square roots of its covariance."""
        for name in self.results():
            yield name, read_result(self.folder / f"results/{name}.h5", with_roots=True)

    def residual(self, name: str, result: NodalResult) -> FloatArray:
        """(rows, cols) residual of one image [grey levels], NaN outside the material."""
        return residual(self.pair(name), result.displacement_on(), result.light)

    def picture(self, name: str) -> FloatImage:
        """(rows, cols) one deformed image, scaled from 0 (black) to 1 (white)."""
        image = read_frame(self.case.files[name], self.reference).image
        return np.asarray(image / np.float32(self.reference.full_scale))

    def all(self) -> dict[str, Any]:
        """Run every stage that is not finished; returns the content of ``summary.json``."""
        with exclusive(self.folder):
            require_writable(self.folder)
            require_any_frame(tuple(self.case.files.values()), self.reference)
            gauges = read_gauges(self.case.gauges) if self.case.gauges else ()
            gauges = along_axes(gauges, self.case.angle)
            for gauge in gauges:  # InputError before measuring, if one is beside the material
                points_of(gauge, self.grid, self.material.mesh)
            results = self.results()
            summary = self._summary(results)
            from modeharvest.report.measure import measure_report
            from modeharvest.report.model.output import write_page

            summary["gauges"] = [] if not gauges else reading_rows(
                write_gauges(self.folder, gauges, self._with_roots(), self.case.unit)
            )  # fmt: skip
            report = measure_report(summary, results, self.residual, self.picture, gauges)
            write_page(report, self.folder / "report.html", self.progress)
            write_json(self.folder / "summary.json", summary)
        return summary

    def _summary(self, results: Mapping[str, NodalResult]) -> dict[str, Any]:
        case = self.case
        return {
            "title": f"Displacement from {case.reference.name}",
            "command": command_line("measure", case.reference, *case.deformed, *(
                word for option, value in (
                    ("--mask", case.mask), ("--pixel-size", case.pixel_size), ("--mesh", case.mesh),
                    ("--brightness", None if case.brightness == 1 else case.brightness),
                    ("--gauges", case.gauges), ("--angle", case.angle or None),
                ) if value is not None for word in (option, value)
            ), *case.choice, "--out", self.folder),
            "unit": case.unit,
            "angle_deg": case.angle,
            "pixel_size_mm": case.pixel_size,
            "shape_px": list(self.grid.shape),
            "material_px": int(self.material.mask.sum()),
            "mask": "given" if not case.mask is case.mesh is None
            else "the whole image, as no background was found" if self.material.mask.all()
            else "found by its speckle" if self.plain is None
            else "found by its grey level",
            "notes": [*self.reference.notes, *(case.sequence.notes if case.sequence else ()),
                      *(() if case.angle else turned_sides(self.material.mask, "--angle"))],
            "warnings": [*self.reference.warnings, *self.material.changes],
            "skipped": [
                {"name": name, "reason": reason} for name, reason in (
                    *(case.sequence.skipped if case.sequence else ()), *self._found[1].items())
            ],
            "images": [self._image(name, result) for name, result in results.items()],
            "versions": versions(*LIBRARIES),
        }  # fmt: skip

    def _image(self, name: str, result: NodalResult) -> dict[str, Any]:
        px, mask = self.grid.pixel_size, self.material.mask
        u = result.displacement_on()
        known = np.asarray(np.isfinite(u).all(axis=-1))
        inside = u[mask & known] / px
        numbers = {
            "name": name,
            "file": str(self.case.files[name]),
            **recorded_with(self.case.sequence, name),
            **_mean_motion(result, self.case.angle),
            "rms_px": float(np.sqrt(np.mean(inside**2))),
            "max_px": float(np.linalg.norm(inside, axis=-1).max()),
            "median_sd_px": float(np.median(result.standard_deviation)) / px,
            "coverage": result.coverage(known, mask),
            **picked(result, "shown unknowns effective_unknowns pixels"),
            **picked(result, "residual_rms residual_noise noise_power library"),
            "warnings": list(result.warnings),
        }
        if result.shown == "contours":
            return numbers
        pair = self.pair(name)
        f, material = pair.reference, pair.masks[0]
        gain, offset = (part[material].mean() for part in brightness(pair, u, result.light))
        moved = deformed_mask(self.grid, result.mesh, result.displacement, 0.0)
        seen = ImageNoise.estimated(replace(pair, deformed_mask=moved))
        noise = float(np.hypot(seen.reference, gain * seen.deformed))
        return numbers | {
            "cutoff_px": result.cutoff_px,
            "outside_px": result.outside,
            "gain": float(gain),
            "offset": float(offset),
            "image_noise": noise,
            "warnings": [
                *result.warnings,
                *misfit_of(result, noise, f[material]),
                *(_LOCAL_LIGHT,) * (result.light == LOCAL),
            ],
        }


def _mean_motion(result: NodalResult, angle: float = 0.0) -> dict[str, float]:
    """Mean strain along x and y [-], tension positive, and rotation [degrees].

    ``angle``: from the picture's x to this one, counter-clockwise [degrees].
    They are those of the affine motion that fits the nodal displacements; rotation gives no strain.
    Parts of the material that don't hang together may move apart, which gives none either.
    """
    cells, n = result.mesh.cells, len(result.mesh.nodes)
    pairs = np.repeat(cells[:, 0], cells.shape[1]), cells.ravel()
    _, part = connected_components(csr_array((np.ones(cells.size), pairs), (n, n)), directed=False)
    columns, motion = (
        values - (np.array([np.bincount(part, c) for c in values.T]) / np.bincount(part)).T[part]
        for values in (result.mesh.nodes, result.displacement)
    )
    F = np.eye(2) + np.linalg.lstsq(columns, motion, rcond=None)[0].T
    along, up = strains_along(F, angle)
    turned = np.degrees(np.arctan2(F[1, 0] - F[0, 1], F[0, 0] + F[1, 1]))
    return {"strain_x": float(along), "strain_y": float(up), "rotation_deg": float(turned)}


def measure(
    reference: Path | str, deformed: Sequence[Path | str], folder: Path | str, *,
    mask: Path | str | None = None, pixel_size: float | None = None, mesh: Path | str | None = None,
    brightness: int | str = 1, choice: FrameChoice | None = None, log: LogTable | None = None,
    gauges: Path | str | None = None, angle: float = 0.0, progress: Progress = silent,
) -> dict[str, Any]:  # fmt: skip
    """Measure the whole displacement of a speckled surface; see :class:`MeasureCase`.

    ``deformed`` may also be folders and videos; ``choice``: which of their frames are measured;
    ``log``: log of the testing machine; ``gauges``: a TOML file of gauges for the report;
    ``angle``: of the specimen's axis, along which mean strains and gauges read.

    Writes its files to ``folder`` and returns the content of ``summary.json``. Raises InputError if
    an image, the mask or the mesh can't be used.
    """
    names, choice, log = tuple(map(str, deformed)), choice or FrameChoice(), log or LogTable()
    flags = ["--every", str(choice.every)] * (choice.every > 1)
    flags += ["--log", log.file] * bool(log.file)
    case = MeasureCase(
        Path(reference), names, None if mask is None else Path(mask), pixel_size,
        None if mesh is None else Path(mesh), brightness, choice=tuple(flags),
        gauges=None if gauges is None else Path(gauges), angle=angle,
    )  # fmt: skip
    found = chosen_frames(Path(), str(reference), names, choice, log, Path(folder), progress)
    case = replace(case, reference=found.reference, sequence=found)
    return MeasureRun(case, Path(folder), progress).all()
