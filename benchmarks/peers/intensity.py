"""Images by modeharvest and by riley-raster's textures, compared with the exact pattern.

The pattern is a trigonometric polynomial, so its grey level at a point can be summed term by term.
That is done at some random pixels of the material, without any of the compared code.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import riley_side
from laps import Work, in_turn, use_threads
from meshes import MeshView, specimen
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.imaging.mapping.isoparametric import interpolate, locate
from modeharvest.imaging.render import ImagedState
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

FloatArray = NDArray[np.float64]

POINTS = 1000
GREY_LEVELS = 255.0
OURS = "modeharvest"
# Name, texels per pixel, riley's sampler, how grey levels are stored.
TEXTURES: tuple[tuple[str, int, str, str], ...] = (
    ("Catmull-Rom, 1×", 1, "cubic_catmull_rom", "float"),
    ("Catmull-Rom, 2×", 2, "cubic_catmull_rom", "float"),
    ("Catmull-Rom, 1×, 8-bit texture", 1, "cubic_catmull_rom", "8-bit"),
    ("quintic B-spline, 1×, prefiltered by SciPy", 1, "quintic_bspline", "coefficients"),
)


def rows(quick: bool) -> dict[str, dict[str, Any]]:
    """Names of the rows, and the options of :func:`measure` for each."""
    size, laps = (700, 2) if quick else (2751, 5)
    return {
        f"intensity-{threads}": {"rows": size, "laps": laps, "threads": threads}
        for threads in (1, 2)
    }


def measure(options: dict[str, Any]) -> dict[str, Any]:
    """Measure all programs on one image."""
    use_threads(options["threads"])
    view = specimen(options["rows"])
    speckle = Speckle(SpeckleSpec(), view.grid.shape)
    contestants: dict[str, Work] = {OURS: lambda: exact(view, speckle)}
    for name, factor, sample, storage in TEXTURES:
        texture = as_stored(sampled(speckle, factor), storage)
        contestants[name] = riley_side.textured(view, texture, sample, options["threads"])
    laps = in_turn(contestants, options["laps"])
    pixels, truth = some_truth(view, speckle)
    images = {
        name: lap.result if name == OURS else lap.result[0] * in_grey_levels(name)
        for name, lap in laps.items()
    }
    errors = {name: image[pixels] - truth for name, image in images.items()}
    return {
        "shape": view.grid.shape,
        "material_px": int((images[OURS] > 0).sum()),
        "threads": options["threads"],
        "points": POINTS,
        "seconds": {name: lap.median_s for name, lap in laps.items()},
        "first_s": {name: lap.first_s for name, lap in laps.items()},
        "rms_grey": {name: float(np.sqrt(np.mean(e**2))) for name, e in errors.items()},
        "max_grey": {name: float(abs(e).max()) for name, e in errors.items()},
    }


def exact(view: MeshView, speckle: Speckle) -> FloatArray:
    """modeharvest's image: inverse mapping, and the pattern at the mapped points [grey levels]."""
    mesh, grid = view.mesh, view.grid
    state = ImagedState(mesh, view.deformed - mesh.nodes, grid, speckle, 0.0)
    grey = state.average(np.zeros((1, 2)), np.ones(1), np.ones(grid.shape, np.bool_))
    shown = grey.reshape(grid.shape).astype(np.float32)
    return np.asarray(GREY_LEVELS * shown, dtype=np.float64)


def sampled(speckle: Speckle, factor: int) -> FloatArray:
    """Exact texture with ``factor`` texels a pixel, from the first to the last pixel centre."""
    if factor == 1:
        return speckle.image()
    row, col = (np.arange((n - 1) * factor + 1) / factor for n in speckle.shape)
    return speckle(row[:, None], col[None, :])


def as_stored(texture: FloatArray, storage: str) -> NDArray[np.generic]:
    """Fractions of full scale as floats, as 8-bit grey levels, or as a spline's coefficients."""
    if storage == "8-bit":
        return np.rint(GREY_LEVELS * texture).astype(np.uint8)
    if storage == "coefficients":
        return np.asarray(ndimage.spline_filter(texture, order=5, mode="mirror"))
    return texture


def in_grey_levels(name: str) -> float:
    """Grey levels of one unit of a texture."""
    storage: dict[str, str] = {t[0]: t[3] for t in TEXTURES}
    return 1.0 if storage[name] == "8-bit" else GREY_LEVELS


def some_truth(view: MeshView, speckle: Speckle) -> tuple[tuple[Any, ...], FloatArray]:
    """Rows and columns of some pixels of the material, and their grey levels, term by term."""
    mesh, grid = view.mesh, view.grid
    located = locate(view.deformed, mesh.cells, mesh.element, grid)
    inside = np.argwhere(located.mask)
    row, col = np.random.default_rng(0).choice(inside, POINTS, replace=False).T
    x, y = interpolate(located, mesh.cells, mesh.element, mesh.nodes)[:, row, col]
    return (row, col), GREY_LEVELS * term_by_term(speckle, *grid.to_px(x, y))


def term_by_term(speckle: Speckle, row: FloatArray, col: FloatArray) -> FloatArray:
    """Fourier sum of the pattern, from its samples at whole pixels alone."""
    period = speckle.period
    whole = Speckle(speckle.spec, period).image()
    coefficients = np.fft.fft2(whole) / whole.size
    along_row, along_col = (
        np.exp(2j * np.pi * at[:, None] * np.fft.fftfreq(n))
        for at, n in zip((row, col), period, strict=True)
    )
    return np.asarray(((along_row @ coefficients) * along_col).sum(axis=1).real)


def table(found: dict[str, dict[str, Any]]) -> list[str]:
    """Lines of Markdown."""
    lines = [
        "| | image, material | threads | Mpx/s of material | ours ÷ this |"
        " error: rms, largest [grey levels of 255] |",
        "|---|---|---|---|---|---|",
    ]
    for row in found.values():
        for name, seconds in row["seconds"].items():
            label = f"**{name}**" if name == OURS else f"riley, {name}"
            lines.append(
                f"| {label} | {row['shape'][0]} × {row['shape'][1]}, "
                f"{row['material_px'] / 1e6:.2f} Mpx | {row['threads']} "
                f"| {row['material_px'] / seconds / 1e6:.1f} "
                f"| {seconds / row['seconds'][OURS]:.2f} "
                f"| {row['rms_grey'][name]:.2g}, {row['max_grey'][name]:.2g} |"
            )
    return lines
