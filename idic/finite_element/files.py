"""Files of a measured nodal displacement: HDF5 that can be read back, VTU, CSV, pixel maps.

The HDF5 file can be read with h5py alone::

    nodes (n, 2)    cells (m, 6)    @element @format @unit @info (JSON: all that is not an array)
    displacement, start, standard_deviation, noise_deviation (n, 2)    each with @unit
    gradient_covariance (n, 4, 4)    roots (n, 2, k) float16, over @largest, of u's covariance
    fields/NAME (n, ...) float32, with @unit: fields derived from these, see ``fields.FIELDS``

Lengths are in mm, or in px where the size of a pixel isn't known; ``Given.unit`` says which.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

import numpy as np

from modeharvest.fem.field import COMPRESSED, in_space, read_mesh, write_mesh
from modeharvest.fem.materials import Material
from modeharvest.idic.finite_element.fields import FIELDS
from modeharvest.idic.finite_element.result import NodalResult, Where
from modeharvest.idic.result import Result
from modeharvest.imaging.photographs.files import write_image
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, atomic_hdf5, open_hdf5
from modeharvest.util.typed import made, to_plain

FORMAT = "modeharvest-nodal-displacement-7"
_TYPES = get_type_hints(NodalResult)
_ARRAYS = [name for name, kind in _TYPES.items() if kind == FloatArray]
_PLAIN = [name for name in _TYPES if name not in (*_ARRAYS, "mesh", "roots")]
_VECTORS = {
    "displacement": ("u", "v up"),
    "standard_deviation": ("sd_u", "sd_v"),
    "microfluctuation": ("w_x", "w_y up"),
}
"""Names in tables of the components of vectors that are lengths."""


class Given(NamedTuple):
    """What is known besides the measurement."""

    unit: str = "mm"
    """Unit of lengths: "mm" or "px"."""
    material: Material | None = None
    """Material law in plane strain, needed for stresses."""
    correlation: Result | None = None
    """Correlation with the ansatz that the microfluctuation field w is relative to."""


NO_MORE = Given()
"""Nothing but images whose pixel size is known in mm."""


def write_result(path: Path | str, result: NodalResult, given: Given = NO_MORE) -> None:
    """Write all of a result as HDF5, losslessly and atomically.

    All derived fields are written too, for readers without modeharvest.
    """
    with atomic_hdf5(path) as file:
        plain = {name: to_plain(getattr(result, name)) for name in _PLAIN}
        file.attrs.update(format=FORMAT, unit=given.unit, info=json.dumps(plain))
        write_mesh(file, result.mesh)
        for name in _ARRAYS:
            file.create_dataset(name, data=getattr(result, name), **COMPRESSED)
        if (roots := result.roots) is not None:
            largest = float(np.abs(roots).max()) or 1.0
            data = file.create_dataset(
                "roots", data=(roots / largest).astype(np.float16), **COMPRESSED
            )
            data.attrs["largest"] = largest
        for name in field_names(given):
            if name in _ARRAYS:
                continue
            values = field_at(result, name, None, given).astype(np.float32)
            data = file.create_dataset(f"fields/{name}", data=values, **COMPRESSED)
            known = FIELDS.get(name.removeprefix("sd_"))
            data.attrs["unit"] = known.unit if known else given.unit
        for name in ("nodes", *_ARRAYS):
            file[name].attrs["unit"] = "" if name == "gradient_covariance" else given.unit


def read_result(path: Path | str, with_roots: bool = False) -> NodalResult:
    """Read what :func:`write_result` wrote; InputError for a missing, cut or foreign file."""
    with open_hdf5(path, "a measured displacement (HDF5)", "measure again", FORMAT) as file:
        mesh, info = read_mesh(file), json.loads(file.attrs["info"])
        if not isinstance(info, dict) or info.keys() != set(_PLAIN):
            raise InputError(f"expected {', '.join(_PLAIN)} in its attribute info, got others")
        arrays = {name: np.asarray(file[name], dtype=np.float64) for name in _ARRAYS}
        for name, values in arrays.items():
            shape = (len(mesh.nodes), *((4, 4) if name == "gradient_covariance" else (2,)))
            if values.shape != shape or not np.isfinite(values).all():
                raise InputError(
                    f"expected finite numbers of shape {shape} as {name}, got shape "
                    f"{values.shape} with {int((~np.isfinite(values)).sum())} that are not"
                )
        plain: dict[str, Any] = {name: made(_TYPES[name], info[name]) for name in _PLAIN}
        if with_roots and (data := file.get("roots")) is not None:
            plain["roots"] = float(data.attrs["largest"]) * data[()].astype(np.float64)
        return NodalResult(mesh=mesh, **plain | arrays)


def field_names(given: Given = NO_MORE) -> list[str]:
    """Names of all fields written: lengths, ``fields.FIELDS``, and their deviations "sd_...".

    w requires a correlation, stresses require a material.
    """
    lengths = [name for name in _VECTORS if given.correlation or name != "microfluctuation"]
    names = [name for name, field in FIELDS.items() if given.material or not field.needs_material]
    return [*lengths, *names, *(f"sd_{name}" for name in names)]


def field_at(
    result: NodalResult, name: str, where: Where = None, given: Given = NO_MORE
) -> FloatArray:
    """Evaluate one field at nodes (n, ...), at pixels (rows, cols, ...) or at points (k, ...).

    ``name``: one of :func:`field_names`. Raises InputError if the field needs what isn't given.
    """
    if name == "displacement":
        return result.values_at(result.displacement, where)
    if name == "standard_deviation":
        return result.deviation_at(result.standard_deviation, where)
    if name == "microfluctuation":
        if given.correlation is None:
            raise InputError("expected a correlation for the field 'microfluctuation', got none")
        return result.microfluctuation(given.correlation, where)
    if name.startswith("sd_"):
        return result.field_deviation(name.removeprefix("sd_"), where, given.material)
    return result.field(name, where, given.material)


def write_vtu(path: Path | str, result: NodalResult, given: Given = NO_MORE) -> None:
    """Write mesh and fields for ParaView, atomically; fields in single precision, uncompressed."""
    fields = {
        f"{name}_{given.unit}" if name in _VECTORS else name:
        field_at(result, name, None, given).astype(np.float32) for name in field_names(given)
    }  # fmt: skip
    with atomic(path) as temporary:
        in_space(result.mesh, fields).write(temporary, file_format="vtu", compression=None)


def components(name: str, values: FloatArray, unit: str) -> dict[str, FloatArray]:
    """The components (...) of a field, by their names in tables."""
    if name in _VECTORS:
        labels = [f"{label} [{unit}]" for label in _VECTORS[name]]
        return dict(zip(labels, np.moveaxis(values, -1, 0), strict=True))
    field = FIELDS[name.removeprefix("sd_")]
    end = f" [{field.unit}]" if field.unit else ""
    found = field.components(values)
    return {"_".join(filter(None, (name, part))) + end: found[part] for part in found}


def write_csv(
    path: Path | str, result: NodalResult, points: FloatArray | None = None, given: Given = NO_MORE
) -> None:
    """Write all fields at points (k, 2) [mm], or at the nodes, as CSV, atomically.

    Values outside the mesh are NaN.
    """
    x, y = (result.mesh.nodes if points is None else np.asarray(points, dtype=np.float64)).T
    row, col = result.grid.to_px(x, y)
    columns = {f"x [{given.unit}]": x, f"y up [{given.unit}]": y, "row": row, "column": col}
    for name in field_names(given):
        columns |= components(name, field_at(result, name, points, given), given.unit)
    table = np.column_stack(list(columns.values()))
    with atomic(path) as temporary:
        np.savetxt(temporary, table, "%.9g", ",", header=",".join(columns), comments="")


def write_maps(
    stem: Path,
    result: NodalResult,
    names: Sequence[str] = ("displacement", "standard_deviation", "logarithmic"),
    given: Given = NO_MORE,
) -> tuple[Path, ...]:
    """Write fields at the pixels as float32 TIFF, NaN outside the material.

    ``names``: some of :func:`field_names`. A file's name is ``stem`` and the field in it:
    "stem_u_mm.tif", "stem_logarithmic_xy.tif", "stem_cauchy_xx_MPa.tif".
    """
    paths = []
    for name in names:
        values = field_at(result, name, result.grid, given)
        for label, component in components(name, values, given.unit).items():
            plain = label.replace(" up", "").replace(" [", "_").replace("]", "")
            paths.append(stem.with_name(f"{stem.name}_{plain}.tif"))
            write_image(paths[-1], component)
    return tuple(paths)
