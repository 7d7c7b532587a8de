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
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.local.export import export_field
from modeharvest.idic.local.field import LocalField
from modeharvest.imaging.photographs.photograph import read_photograph
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, make_folder, open_hdf5, read_json
from modeharvest.util.typed import nearest


@dataclass(frozen=True)
class FinishedRun:
    """Results of ``measure``, ``harvest`` or ``run`` in a folder."""

    files: dict[str, Path]
    """Files of the displacements (HDF5), by image name, in the order of the test."""
    pictures: dict[str, Path]
    """Photographs by image name, where there is one."""
    unit: str
    """Unit of lengths, "mm" or "px"."""

    @classmethod
    def read(cls, place: Path | str, photographs: Sequence[Path] = ()) -> FinishedRun:
        """Open a run's folder, or a file; ``photographs``: of all images, if not the run's own.

        InputError if nothing was measured there.
        """
        place = Path(place)
        found = [p for name in ("results", "whole_field") for p in (place / name).glob("*.h5")]
        paths = [p for p in [*sorted(found), place] if p.is_file() and _is_nodal(p)]
        if not paths:
            raise InputError(
                "expected a folder of 'measure', or of whole displacements of 'harvest' or 'run', "
                f"or one of their files (HDF5), got {place}; 'harvest --whole-field' leaves them"
            )
        files, images = {path.stem: path for path in paths}, []
        if (record := place / "summary.json").is_file():
            images = [i for i in read_json(record).get("images", ()) if i.get("name") in files]
            files = {i["name"]: files[i["name"]] for i in images} or files
        known = {name: place / "prepared" / f"{name}.tif" for name in files}
        known |= {i["name"]: Path(i["file"]) for i in images if i.get("file")}
        if photographs:
            if (got := len(photographs)) != len(files):
                raise InputError(f"expected a photograph for each of {len(files)}, got {got}")
            known = dict(zip(files, photographs, strict=True))
        with open_hdf5(paths[0], "a measured displacement (HDF5)") as file:
            unit = str(file.attrs["unit"])
        return cls(files, {n: p for n, p in known.items() if photographs or p.is_file()}, unit)

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

    def export(self, form: str, folder: Path, step: int) -> list[Path]:
        """Write all displacements in one of ``local.export.FORMATS``, every ``step``-th pixel.

        The forms with all derived fields are "csv" (at nodes), "hdf5", "vtu", "tiff", "mat" (maps).
        """
        given, written = nodal.Given(self.unit), list[Path]()
        make_folder(folder)
        for name in self.files:
            result, path = self.result(name), folder / name
            if form in _WHOLE:
                suffix, write = _WHOLE[form]
                written.append(path.with_name(name + suffix))
                write(written[-1], result, given=given)
            elif form == "tiff":
                written += nodal.write_maps(path, result, nodal.field_names(given), given)
            elif form == "mat":
                written.append(path.with_name(f"{name}.mat"))
                fields = _components(result, self.unit).items()
                maps = {head: result.on_pixels(one)[::step, ::step] for head, (one, _) in fields}
                with atomic(written[-1]) as part:
                    savemat(part, maps, appendmat=False, do_compression=True)
            else:
                field, grid = at_pixels(result, step), result.grid
                written.append(export_field(f"{path}.x", field, form, grid, self.unit))
        return written


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
