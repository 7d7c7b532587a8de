"""Displacements of a finished run, with their photographs: read from its folder, and exported."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from scipy.io import savemat

from modeharvest.idic.finite_element import files as nodal
from modeharvest.idic.finite_element.fields import field_of, nodal_gradient
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.local.export import export_field
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.result import FORMAT as RESULT_FORMAT
from modeharvest.idic.result import Result
from modeharvest.idic.uncertainty.covariance import propagated_sd
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet
from modeharvest.imaging.photographs.files import read_mask
from modeharvest.imaging.photographs.photograph import read_photograph
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, open_hdf5, read_json
from modeharvest.util.typed import nearest


@dataclass(frozen=True)
class FinishedRun:
    """Results of ``measure``, ``harvest`` or ``run`` in a folder."""

    files: dict[str, Path]
    """Files of the whole displacements (HDF5), or of correlations alone (JSON), by image name, in
    the order of the test."""
    pictures: dict[str, Path]
    """Photographs by image name, where there is one."""
    unit: str
    """Unit of lengths, "mm" or "px"."""
    angle: float = 0.0
    """Of the specimen's axis to x, along which the run's strains are [degrees]."""

    @classmethod
    def read(
        cls, place: Path | str, photographs: Sequence[Path] = (), correlations: bool = False
    ) -> FinishedRun:
        """Open a run's folder, or a file; ``photographs``: of all images, if not the run's own.

        ``correlations``: whether v0 and v1 phi1 will do where no whole displacement was measured.
        InputError if nothing was measured there.
        """
        place = Path(place)
        found = [p for name in ("results", "whole_field") for p in (place / name).glob("*.h5")]
        paths = [p for p in [*sorted(found), place] if p.is_file() and _is_nodal(p)]
        if correlations and not paths:
            unknowns = "results/*.json", "correlation/result_*.json"
            either = [p for name in unknowns for p in sorted(place.glob(name))]
            paths = [p for p in either if read_json(p).get("format") == RESULT_FORMAT]
        if not paths:
            raise InputError(
                "expected a folder of 'measure', or of whole displacements of 'harvest' or 'run', "
                f"or one of their files (HDF5), got {place}; 'harvest --whole-field' leaves them"
            )
        files, images, angle = {path.stem: path for path in paths}, [], 0.0
        if (record := place / "summary.json").is_file():
            summary = read_json(record)  # of measure, or of harvest
            angle = float(summary.get("angle_deg") or 0.0)
            listed = summary.get("images") or summary.get("frames") or ()
            images = [i for i in listed if i.get("name") in files]
            files = {i["name"]: files[i["name"]] for i in images} or files
        known = {name: place / "prepared" / f"{name}.tif" for name in files}
        known |= {i["name"]: Path(i["file"]) for i in images if i.get("file")}
        if photographs:
            if (got := len(photographs)) != len(files):
                raise InputError(f"expected a photograph for each of {len(files)}, got {got}")
            known = dict(zip(files, photographs, strict=True))
        unit = "mm"
        if paths[0].suffix == ".h5":
            with open_hdf5(paths[0], "a measured displacement (HDF5)") as file:
                unit = str(file.attrs["unit"])
        pictures = {n: p for n, p in known.items() if photographs or p.is_file()}
        return cls(files, pictures, unit, angle)

    def result(self, name: str) -> NodalResult:
        """An image's displacement, with the roots of its covariance."""
        return nodal.read_result(self.files[name], with_roots=True)

    def picture(self, name: str) -> FloatImage | None:
        """The photograph of an image, (rows, cols), 0 black to 1 white; None if there is none."""
        if (path := self.pictures.get(name)) is None:
            return None
        photograph = read_photograph(path)
        return np.asarray(photograph.image / np.float32(photograph.full_scale))

    def component(self, image: str, name: str) -> tuple[FloatArray, str]:
        """A field's component at the nodes (n,), and its unit; InputError for an unknown name.

        Names are u, v, sd_u, rotation, stretch_1, logarithmic_xx, ...
        """
        known = _components(self.result(image), self.unit)
        if name not in known:
            raise InputError(f"expected a field's component, got {name!r}{nearest(name, [*known])}")
        return known[name]

    def export(
        self, form: str, folder: Path, step: int, pixel_size: float | None = None
    ) -> list[Path]:
        """Write all displacements in one of ``local.export.FORMATS``, every ``step``-th pixel.

        The forms with all derived fields are "csv" (at nodes), "hdf5", "vtu", "tiff", "mat" (maps);
        correlations alone have none. ``pixel_size`` [mm]: of a run that was measured in pixels.
        """
        given, written = nodal.Given(self.unit), list[Path]()
        if pixel_size is not None and self.unit == "mm":
            raise InputError("expected --pixel-size for lengths in px, got a run measured in mm")
        for name, file in self.files.items():
            path = folder / name
            if file.suffix == ".json":
                if form in ("hdf5", "vtu", "tiff"):
                    raise InputError(f"expected whole displacements for {form}, {_MODES_ALONE}")
                found = Result.read(file)
                field = at_pixels_of_modes(found, _mask_of(file.parent.parent), step)
                strains = _tensors(_gradient_of_modes(found, field.points))
                written.append(export_field(f"{path}.x", field, form, found.grid, tensors=strains))
                continue
            result = self.result(name)
            if form in _WHOLE and pixel_size is None:
                suffix, write = _WHOLE[form]
                written.append(path.with_name(name + suffix))
                write(written[-1], result, given=given)
            elif form == "tiff":
                written += nodal.write_maps(path, result, nodal.field_names(given), given)
            elif form == "mat" and pixel_size is None:
                written.append(path.with_name(f"{name}.mat"))
                with atomic(written[-1]) as part:
                    maps = self._maps(result, step)
                    savemat(part, maps, appendmat=False, do_compression=True)
            else:
                field, grid, unit = at_pixels(result, step), result.grid, self.unit
                slopes = nodal_gradient(result.mesh, result.displacement)
                strains = _tensors(result.at(field.points, slopes))
                if pixel_size is not None:
                    grid, unit = PixelGrid.centred(*grid.shape, pixel_size), "mm"
                    field = field.scaled(pixel_size)
                written.append(export_field(f"{path}.x", field, form, grid, unit, strains))
        return written

    def _maps(self, result: NodalResult, step: int) -> dict[str, FloatArray]:
        """Maps of every ``step``-th pixel: row, column, and all fields, lengths with their unit."""
        row, col = (step * np.indices([-(-n // step) for n in result.grid.shape])).astype(float)
        maps = {"row": row, "column": col}
        for head, (values, unit) in _components(result, self.unit).items():
            up = "_up" if head == "v" else ""
            name = f"{head}{up}_{unit}" if unit == self.unit else head
            maps[name] = result.on_pixels(values)[::step, ::step]
        return maps


_STEP_PX = 1e-3
_MODES_ALONE = "got v0 and v1 phi1 alone; harvest with --whole-field, or choose another format"
_WHOLE: dict[str, tuple[str, Callable[..., None]]] = {
    "csv": (".csv", nodal.write_csv), "hdf5": (".h5", nodal.write_result),
    "vtu": (".vtu", nodal.write_vtu),
}  # fmt: skip


def at_pixels(result: NodalResult, step: int) -> LocalField:
    """u and its standard deviation at the material's pixels in every ``step``-th row and column."""
    row, col = np.mgrid[0 : result.grid.rows : step, 0 : result.grid.cols : step].reshape(2, -1)
    points = np.column_stack(result.grid.to_mm(row, col))
    u = result.at(points)
    on = np.isfinite(u).all(axis=1)
    sd = result.deviation_at(result.standard_deviation, points[on])
    return LocalField(points[on, 0], points[on, 1], u[on], sd=sd)


def at_pixels_of_modes(result: Result, mask: BoolArray, step: int) -> LocalField:
    """v0 and v1 phi1 of a correlation at the mask's pixels in every ``step``-th row and column.

    Standard deviations are by model error and noise, where the result has them.
    """
    grid, found, errors = result.grid, list[FloatArray](), result.errors
    known = None
    if errors is not None:
        known = errors.by_noise if errors.by_model_error is None else errors.by_model_error
    x, a = grid.x[::step], result.unknowns
    for k in range(0, grid.rows, step):
        on, y = mask[k, ::step], grid.y[[k]]
        if not on.any():
            continue
        u = result.ansatz.displacement(a, x[on], y)[0]
        sd = np.full_like(u, np.nan)
        if known is not None:
            sd = propagated_sd(result.ansatz.sensitivities(a, x[on], y)[0], known)
        found.append(np.column_stack([x[on], np.full(len(u), y[0]), u, sd]))
    if not found:
        raise InputError(
            f"expected material at every {step}th pixel, got none; give a smaller step"
        )
    table = np.vstack(found)
    return LocalField(
        table[:, 0], table[:, 1], table[:, 2:4], sd=None if known is None else table[:, 4:]
    )


def _gradient_of_modes(result: Result, points: FloatArray) -> FloatArray:
    """(n, 2, 2) gradient of v0 and v1 phi1 at points [mm], by central differences."""
    steps = _STEP_PX * result.grid.pixel_size * np.eye(2)
    ahead, behind = (
        np.stack(
            [result.ansatz.displacement_at(result.unknowns, points + s * h) for h in steps], -1
        )
        for s in (1, -1)
    )
    return np.asarray((ahead - behind) / (2.0 * steps[0, 0]))


def _tensors(gradient: FloatArray) -> dict[str, FloatArray]:
    """The tensors that exports may hold, from displacement gradients (n, 2, 2)."""
    F = np.eye(2) + gradient
    return {name: field_of(name, F) for name in ("F", "green_lagrange", "logarithmic")}


def _mask_of(folder: Path) -> BoolArray:
    """The reference's mask of a harvest, or of a virtual experiment."""
    prepared = folder / "prepared" / "reference_mask.tif"
    return read_mask(prepared) if prepared.is_file() else ImageSet.read(folder / "images").mask()


def _components(result: NodalResult, unit: str) -> dict[str, tuple[FloatArray, str]]:
    given, found = nodal.Given(unit), dict[str, tuple[FloatArray, str]]()
    for of in nodal.field_names(given):
        parts = nodal.components(of, nodal.field_at(result, of, None, given), unit)
        for head, values in parts.items():
            name, _, own = head.replace(" up", "").partition(" [")
            found[name] = values, own.rstrip("]") or "-"
    return found


def _is_nodal(path: Path) -> bool:
    with suppress(OSError), h5py.File(path, "r") as file:
        return bool(file.attrs.get("format") == nodal.FORMAT)
    return False
