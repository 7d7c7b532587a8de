"""Displacement fields written as other DIC codes write them, to be read back by ``read_field``.

Numbers are in the convention of the code: see ``formats``. Standard deviations are written where
the code has a place for them, as one number for both components; strains where it has columns for
them, along the axes of the file, in the code's own measure. pyvale has a file of its own for these.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from modeharvest.idic.local.field import LocalField, columns_of, read_field, write_field
from modeharvest.idic.local.formats import layouts
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.files import read_image
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic

_OFF_PX = 1e-3
"""Largest distance from whole pixels, for codes that know no other points."""
Columns = dict[str, FloatArray]
FORMATS = {"ncorr": ".mat", "vic2d": ".csv", "davis": ".txt", "dice": ".txt", "matchid": ".csv",
           "gom": ".csv", "aramis": ".txt", "pyvale": ".csv", "csv": ".csv", "mat": ".mat",
           "npz": ".npz"}  # fmt: skip
"""Suffix of each format, by the format's name in commands."""
_OF_GOM = "gom", "aramis"
"""Formats in mm, y up."""
_OF_EITHER = "csv", "mat", "npz"
"""Formats of this project: in mm, y up, or in px, y down."""


Tensors = Mapping[str, FloatArray]
"""(n, 2, 2) tensors at the points of a field, x right and y up: "F", "green_lagrange" and
"logarithmic" [-]."""


def export_field(
    path: Path | str, field: LocalField, form: str, grid: PixelGrid, unit: str = "mm",
    tensors: Tensors | None = None,
) -> Path:  # fmt: skip
    """Write a field as one of :data:`FORMATS`; returns the file, whose suffix is the format's.

    InputError for an unknown format, for points off whole pixels where the code has grids, and for
    a code that writes millimetres where the size of a pixel isn't known.

    grid : the pixels of the reference image.
    unit : unit of the field's lengths, "mm" or "px".
    tensors : deformation gradient and strains at the points; none by default.
    """
    if form not in FORMATS:
        raise InputError(f"expected a format among {', '.join(FORMATS)}, got {form!r}")
    if unit == "px" and form in _OF_GOM:
        raise InputError(f"expected the size of a pixel for {form}, in mm; give --pixel-size")
    path = Path(path).with_suffix(FORMATS[form])
    texts, in_px = layouts()["written"], f"{form}_px"
    is_down = form not in _OF_GOM and not (form in _OF_EITHER and unit == "mm")
    strains = _components(tensors or {}, field, is_down)
    numbers = _numbers(field, grid, strains)
    if form in texts:
        of_unit = in_px if unit == "px" and in_px in texts else form
        _write_text(path, texts[of_unit], numbers)
        if strains and f"{form}_strain" in texts:
            beside = path.with_name(f"strain_{path.name}")
            _write_text(beside, texts[f"{form}_strain"], numbers)
    elif form == "davis":
        _write_davis(path, *_lattice(path, numbers, ("u", "v")))
    elif form in ("csv", "npz"):
        write_field(path, field, grid if unit == "px" else None, strains)
    else:
        content: Mapping[str, object]
        if form == "ncorr":
            content = _of_ncorr(path, numbers, grid.pixel_size, unit)
        else:
            columns = columns_of(field, grid if unit == "px" else None) | strains
            content = {re.sub(r"\W+", "_", head).strip("_"): of for head, of in columns.items()}
        with atomic(path) as part:
            savemat(part, content, appendmat=False, do_compression=True, oned_as="column")
    return path


def convert(
    source: Path, folder: Path, form: str, image: Path | None, pixel_size: float | None
) -> tuple[Path, LocalField]:
    """Write a field of any code as ``form``; returns the file, and the field as it was read.

    ``image``: the reference, for positions in px; ``pixel_size`` [mm]: to convert px and mm.
    InputError if the formats need either and it isn't given.
    """
    rows, cols = (1, 1) if image is None else read_image(image).shape
    grid = PixelGrid.centred(rows, cols, pixel_size or 1.0)
    field = read_field(source, None if image is None else grid)
    is_convertible = image is not None and pixel_size is not None
    in_px = form in FORMATS.keys() - {*_OF_GOM, *_OF_EITHER} or "px" in field.units
    if "mm" in field.units and in_px and not is_convertible:
        raise InputError(
            f"{source}: expected --image (the reference) and --pixel-size (in mm) to write {form} "
            f"from a field in {' and '.join(sorted(field.units))}; give both"
        )
    unit = "px" if pixel_size is None and "px" in field.units else "mm"
    return export_field(folder / source.stem, field, form, grid, unit), field


def _components(tensors: Tensors, field: LocalField, is_down: bool) -> Columns:
    """Components "F_xx", ... of tensors, NaN at failed points; ``is_down``: along y downwards."""
    sign = np.array([[1.0, -1.0], [-1.0, 1.0]]) if is_down else np.ones((2, 2))
    return {
        f"{name}_{'xy'[i]}{'xy'[j]}": np.where(field.good, sign[i, j] * tensor[:, i, j], np.nan)
        for name, tensor in tensors.items() for i in range(2) for j in range(2)
    }  # fmt: skip


def _numbers(field: LocalField, grid: PixelGrid, strains: Columns) -> Columns:
    """Columns of all points; where a point failed u and v are NaN, and "u0" and the like are 0."""
    (row, col), size = grid.to_px(field.x, field.y), grid.pixel_size
    u, v = np.where(field.good, field.u.T, np.nan) / size
    sd = np.zeros(len(u)) if field.sd is None else np.sqrt(np.mean(field.sd**2, axis=1)) / size
    own = {
        "col": col, "row": row, "u": u, "v": -v, "size": np.hypot(u, v), "zero": 0.0 * col,
        "number": np.arange(1.0, len(u) + 1.0), "good": field.good.astype(np.float64),
        "sigma": np.where(field.good, np.nan_to_num(sd), -1.0), "x": field.x, "y": field.y,
        "status": np.where(field.good, 4.0, 11.0), "v_up_mm": size * v,
    }  # fmt: skip
    both = ("col", "row", "u", "v")
    own |= _technical(strains) | strains | {f"{name}_mm": size * own[name] for name in both}
    return own | {f"{name}0": np.nan_to_num(own[name]) for name in (*both, *strains)}


def _technical(strains: Columns) -> Columns:
    """Technical strains U - 1 of the right stretch tensor U, normal ones in %."""
    if "logarithmic_xx" not in strains:
        return {}
    logarithmic = np.nan_to_num([[strains[f"logarithmic_{i}{j}"] for j in "xy"] for i in "xy"]).T
    principal, axes = np.linalg.eigh(logarithmic)
    stretch = np.einsum("nik,nk,njk->nij", axes, np.exp(principal), axes) - np.eye(2)
    xx, yy, xy = (np.where(np.isnan(strains["F_xx"]), np.nan, stretch[:, i, j])
                  for i, j in ((0, 0), (1, 1), (0, 1)))  # fmt: skip
    return {"technical_xx": 100.0 * xx, "technical_yy": 100.0 * yy, "technical_xy": xy}


def _write_text(path: Path, layout: Mapping[str, Any], numbers: Columns) -> None:
    """Write a table: NaN is left empty; the decimal sign is a comma if it is the layout's."""
    separator, heads = layout["separator"], dict(layout["columns"])
    heads |= {head: of for head, of in layout.get("strains", {}).items() if of in numbers}
    decimal = layout.get("decimal", ".")
    with atomic(path) as part, part.open("w", encoding="utf-8") as file:
        file.write(separator.join(heads) + "\n")
        for row in np.column_stack([numbers[of] for of in heads.values()]):
            line = separator.join("" if np.isnan(v) else f"{v:.12g}" for v in row)
            file.write(line.replace(".", decimal) + "\n")


def _lattice(path: Path, numbers: Columns, names: Sequence[str]) -> tuple[int, FloatArray]:
    """Spacing of the points [px]; maps (k, rows, cols) of columns, 0 where there is no point.

    The grids start at the first pixel, so that all points are whole spacings from it.
    """
    places = np.stack([numbers["row"], numbers["col"]])
    whole = np.rint(places).astype(np.int64)
    off, step = float(np.abs(places - whole).max()), int(np.gcd.reduce(whole.ravel())) or 1
    if off > _OFF_PX or whole.min() < 0:
        raise InputError(
            f"{path}: expected points at whole pixels of the image for a code that writes grids, "
            f"got them up to {off:.2g} px off; write VIC-2D's or DICe's"
        )
    maps = np.zeros((len(names), *(1 + whole.max(axis=1) // step)))
    maps[:, *(whole // step)] = [numbers[f"{name}0"] for name in names]
    return step, maps


def _write_davis(path: Path, step: int, maps: FloatArray) -> None:
    _, rows, cols = maps.shape
    y, x = step * np.mgrid[:rows, :cols]
    table = np.stack([x, y, *maps], axis=-1).reshape(-1, 4)
    head = f'#DaVis 8.4.0 2D-vector {step} {rows} {cols} "" "pixel" "" "pixel" "displacement" '
    with atomic(path) as part:
        np.savetxt(part, table, "%.12g", "\t", header=head + '"pixel"', comments="")


def _of_ncorr(path: Path, numbers: Columns, pixel_size: float, unit: str) -> dict[str, object]:
    strains = [f"green_lagrange_{ij}" for ij in ("xx", "xy", "yy") if "F_xx" in numbers]
    step, (u, v, *maps) = _lattice(path, numbers, ["u", "v", *strains])
    frame = {"plot_u_dic": u, "plot_v_dic": v, "plot_u_ref_formatted": pixel_size * u,
             "plot_v_ref_formatted": pixel_size * v}  # fmt: skip
    info = {"pixtounits": pixel_size, "units": unit, "spacing": step - 1, "type": "regular"}
    own: dict[str, object] = {"displacements": frame, "dispinfo": info}
    if strains:
        own["strains"] = {f"plot_e{name[-2:]}_ref_formatted": values
                          for name, values in zip(strains, maps, strict=True)}  # fmt: skip
    return {"data_dic_save": own}
