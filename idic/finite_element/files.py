"""Files of a displacement measured at nodes: HDF5 to read back, VTU, CSV, maps of the pixels.

The HDF5 file can be read with h5py alone::

    nodes (n, 2)    cells (m, 6)    @element @format @unit @info (JSON: all that is not an array)
    displacement, start, standard_deviation, noise_deviation (n, 2)    each with @unit

Lengths are in mm, or in px where the size of a pixel isn't known; ``unit`` says which.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_type_hints

import meshio
import numpy as np

from modeharvest.fem.field import COMPRESSED, read_mesh, write_mesh
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.imaging.photographs.files import write_image
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, atomic_hdf5, open_hdf5
from modeharvest.util.typed import made, to_plain

FORMAT = "modeharvest-nodal-displacement-1"
_TYPES = get_type_hints(NodalResult)
_ARRAYS = [name for name, kind in _TYPES.items() if kind == FloatArray]
_PLAIN = [name for name in _TYPES if name not in (*_ARRAYS, "mesh", "timings_s")]
"""Two measurements leave the same bytes, so their seconds are kept elsewhere."""
_TENSORS = {"F": "xx xy yx yy", "green_lagrange": "xx yy xy", "logarithmic": "xx yy xy"}
_VECTORS = {"displacement": ("u", "v up"), "standard_deviation": ("sd_u", "sd_v")}
"""What components of fields are called in tables."""


def write_result(path: Path | str, result: NodalResult, unit: str = "mm") -> None:
    """Write all of a result but its seconds as HDF5, losslessly and atomically.

    ``unit`` of its lengths: "mm" or "px".
    """
    with atomic_hdf5(path) as file:
        plain = {name: to_plain(getattr(result, name)) for name in _PLAIN}
        file.attrs.update(format=FORMAT, unit=unit, info=json.dumps(plain))
        write_mesh(file, result.mesh)
        for name in _ARRAYS:
            file.create_dataset(name, data=getattr(result, name), **COMPRESSED)
        for name in ("nodes", *_ARRAYS):
            file[name].attrs["unit"] = unit


def read_result(path: Path | str) -> NodalResult:
    """Read what :func:`write_result` wrote; InputError if the file is missing, cut or foreign."""
    with open_hdf5(path, "a measured displacement (HDF5)", "measure again", FORMAT) as file:
        mesh, info = read_mesh(file), json.loads(file.attrs["info"])
        if not isinstance(info, dict) or info.keys() != set(_PLAIN):
            raise InputError(f"expected {', '.join(_PLAIN)} in its attribute info, got others")
        arrays = {name: np.asarray(file[name], dtype=np.float64) for name in _ARRAYS}
        for name, values in arrays.items():
            if values.shape != mesh.nodes.shape or not np.isfinite(values).all():
                raise InputError(
                    f"expected finite numbers of shape {mesh.nodes.shape} as {name}, got shape "
                    f"{values.shape} with {int((~np.isfinite(values)).sum())} that are not"
                )
        plain: dict[str, Any] = {name: made(_TYPES[name], info[name]) for name in _PLAIN}
        return NodalResult(mesh=mesh, **plain | arrays)


def nodal_fields(result: NodalResult) -> dict[str, FloatArray]:
    """Everything that is written at nodes, by its name: (n,), (n, 2) or (n, 2, 2).

    Displacement and its standard deviation [mm]; deformation gradient F, Green-Lagrange and
    logarithmic strain, J = det F, principal stretches and the direction of the larger one [-].
    """
    F = result.deformation_gradient
    square, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", F, F))
    stretches = np.sqrt(np.maximum(square, 0.0))
    return {
        "displacement": result.displacement,
        "standard_deviation": result.standard_deviation,
        "F": F,
        "green_lagrange": result.green_lagrange,
        "logarithmic": result.logarithmic_strain,
        "J": np.linalg.det(F),
        "stretch_1": stretches[:, 1],
        "stretch_2": stretches[:, 0],
        "direction_1": directions[:, :, 1],
    }


def write_vtu(path: Path | str, result: NodalResult, unit: str = "mm") -> None:
    """Write mesh and fields for ParaView, atomically; vectors and tensors in three dimensions."""
    fields = {}
    for name, values in nodal_fields(result).items():
        padded = np.zeros((len(values), *(3,) * (values.ndim - 1)))
        padded[tuple(slice(size) for size in values.shape)] = values
        label = f"{name}_{unit}" if name in _VECTORS else name
        fields[label] = padded.reshape(len(values), *(padded[0].size,) * (values.ndim > 1))
    nodes = np.pad(result.mesh.nodes, ((0, 0), (0, 1)))
    mesh = meshio.Mesh(nodes, [("triangle6", result.mesh.cells)], point_data=fields)
    with atomic(path) as temporary:
        mesh.write(temporary, file_format="vtu")


def columns_at(
    result: NodalResult, points: FloatArray | None = None, unit: str = "mm"
) -> dict[str, FloatArray]:
    """Columns (k,) of a table at points (k, 2) [mm], or at the nodes; NaN beside the mesh."""
    columns: dict[str, FloatArray] = {}
    for name, values in nodal_fields(result).items():
        for label, nodal in _components(name, values, unit).items():
            if points is None:
                columns[label] = nodal
            elif name == "standard_deviation":  # which stays positive so
                columns[label] = np.exp(result.at(points, np.log(nodal)[:, None])[:, 0])
            else:
                columns[label] = result.at(points, nodal[:, None])[:, 0]
    x, y = (result.mesh.nodes if points is None else np.asarray(points, dtype=np.float64)).T
    row, col = result.grid.to_px(x, y)
    return {f"x [{unit}]": x, f"y up [{unit}]": y, "row": row, "column": col, **columns}


def _components(name: str, values: FloatArray, unit: str) -> Mapping[str, FloatArray]:
    """The components (n,) of a nodal field, by what they are called in tables."""
    if name in _VECTORS:
        labels = [f"{label} [{unit}]" for label in _VECTORS[name]]
        return dict(zip(labels, values.T, strict=True))
    if name in _TENSORS:
        return {
            f"{name}_{part}": values[:, "xy".index(part[0]), "xy".index(part[1])]
            for part in _TENSORS[name].split()
        }
    if values.ndim == 2:
        return {f"{name}_{axis}": values[:, k] for k, axis in enumerate("xy")}
    return {name: values}


def write_csv(
    path: Path | str, result: NodalResult, points: FloatArray | None = None, unit: str = "mm"
) -> None:
    """Write all fields at points (k, 2) [mm], or at the nodes, as CSV, atomically."""
    columns = columns_at(result, points, unit)
    table = np.column_stack(list(columns.values()))
    with atomic(path) as temporary:
        np.savetxt(temporary, table, "%.9g", ",", header=",".join(columns), comments="")


def write_maps(stem: Path, result: NodalResult, unit: str = "mm") -> tuple[Path, ...]:
    """Write u, v and their standard deviations at the pixels as float32 TIFF, NaN off the material.

    Files are called ``stem`` and what they hold: "stem_u_mm.tif".
    """
    u, sd = result.displacement_on(), result.standard_deviation_on()
    maps = {"u": u[..., 0], "v": u[..., 1], "sd_u": sd[..., 0], "sd_v": sd[..., 1]}
    paths = tuple(stem.with_name(f"{stem.name}_{name}_{unit}.tif") for name in maps)
    for path, values in zip(paths, maps.values(), strict=True):
        write_image(path, values)
    return paths
