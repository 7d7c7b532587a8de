"""Subset DIC by pyvale, an optional library, with predicted standard deviations.

pyvale (https://github.com/Computer-Aided-Validation-Laboratory/pyvale, MIT) matches subsets by
their zero-normalised difference, starts from Fourier correlations of ever smaller windows, and
proceeds from the best matched subset to its neighbours. It is installed separately: with the
graphics and mesh libraries that it requires it takes 2 GB. It runs in a separate process, so that
neither its threads nor a crash affect this one.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.local.field import LocalField, read_field
from modeharvest.idic.local.motion import CELL_PX, coarse_field, first_motion
from modeharvest.idic.local.tables import read_table
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError, MissingDependencyError
from modeharvest.util.masks import room_around


def predicted_sd(
    reference: NDArray[Any],
    mask: BoolArray,
    grid: PixelGrid,
    field: LocalField,
    correlation: FloatArray,
    subset_px: int,
) -> FloatArray:
    """Standard deviations (n, 2) of u that the residual predicts [mm].

    The zero-normalised correlation C (n,) of a subset gives its residual, 2 (1 − C) of the images'
    variance. Were it white noise, the displacement's covariance would be that times (Σ ∇f ∇fᵀ)⁻¹
    over the subset. Much of it is model error, which is correlated over a speckle: it counts as one
    independent value per ``speckle_area`` pixels, the area of f's autocorrelation. C is NaN where a
    subset is lost; the mask (rows, cols) is True on material.
    """
    f = np.where(mask, np.asarray(reference, np.float64) - float(reference[mask].mean()), 0.0)

    def summed(image: FloatArray) -> FloatArray:
        return np.asarray(ndimage.uniform_filter(image, subset_px, mode="constant")) * subset_px**2

    down, right = np.gradient(f)
    down, right = np.where(mask, down, 0.0), np.where(mask, right, 0.0)
    row, col = (np.rint(i).astype(int) for i in grid.to_px(field.x, field.y))
    xx, xy, yy, count, one, two = (
        summed(i)[row, col] for i in (right**2, right * down, down**2, mask.astype(float), f, f**2)
    )
    variance = np.maximum(two / count - (one / count) ** 2, 0.0)
    residual = 2.0 * np.clip(1.0 - correlation, 0.0, None) * variance * speckle_area(f, mask)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = xx * yy - xy**2
        cov = residual[:, None] * np.column_stack([yy, xx]) / determinant[:, None]
        return np.asarray(grid.pixel_size * np.sqrt(cov))


def speckle_area(image: FloatArray, mask: BoolArray) -> float:
    """Area of the autocorrelation of a mean-free image over a mask, to its half height [px]."""
    size = 32
    product = np.zeros(size)
    for k in range(size):
        both = mask[:, k:] & mask[:, : mask.shape[1] - k]
        product[k] = float(np.mean((image[:, k:] * image[:, : image.shape[1] - k])[both]))
    below = np.flatnonzero(product < 0.5 * product[0])
    radius = float(below[0]) if len(below) else float(size)
    return float(max(1.0, np.pi * radius**2))


WHERE = "MODEHARVEST_PYVALE"
"""Environment variable: the Python that has pyvale, if it isn't this one."""
HOW_TO_GET = (
    f"pyvale is not installed; give it an environment of its own and set {WHERE} to the Python "
    "there (see docs/how-to/fields.md), or read the field of another code"
)
_TRIES = 3
"""Number of seeds that are tried."""
_SHARES = (1.0, 0.8, 1.25)
"""Factors on the largest motion, tried with each seed: some sizes of the first window fail."""
_MOST, _MARGIN = 0.998, 1.1
"""Share of a rough field's points that move less than the largest motion; margin on that."""
_COARSE_PX = 400
"""Pixels across that are enough for a rough field."""
_SIDE = Path(__file__).with_name("pyvale_side.py")


@dataclass(frozen=True)
class SubsetOptions:
    """Options of a subset DIC."""

    subset_px: int = 21
    """Edge of a subset, odd [px]: at least three speckles across."""
    step_px: int = 5
    """Distance of the subsets [px]."""
    shape: str = "affine"
    """Shape function: "affine", "quad" or "rigid"."""
    threshold: float = 0.9
    """Least zero-normalised correlation of a subset that counts [-]."""
    filling: float = 1.0
    """Least share of a subset that is material [-]. pyvale takes the pixels of a hole for speckle,
    so at less than 1 there are more subsets at holes, and they are worse."""
    largest_px: int | None = None
    """Largest motion along either axis [px]; None: estimated from the images by ``coarse_field``.
    pyvale's first windows are twice as large, and fail if they are much larger than need be."""
    threads: int | None = None
    """Number of threads of pyvale; None: all cores."""

    def __post_init__(self) -> None:
        if self.subset_px < 5 or self.subset_px % 2 == 0 or not 1 <= self.step_px <= self.subset_px:
            raise InputError(
                "subset DIC: expected an odd subset of at least 5 px and a step of 1 px up to it, "
                f"got {self.subset_px} and {self.step_px} px"
            )
        if self.shape not in ("affine", "quad", "rigid"):
            raise InputError(
                f"subset DIC: expected shape 'affine', 'quad' or 'rigid', got {self.shape!r}"
            )
        if not (0 < self.threshold < 1 and 0 < self.filling <= 1):
            raise InputError(
                "subset DIC: expected a threshold in (0, 1) and a filling in (0, 1], got "
                f"{self.threshold} and {self.filling}"
            )


def pyvale_python() -> str:
    """Path of the Python that has pyvale; raises MissingDependencyError if none is known."""
    given = os.environ.get(WHERE)
    if given:
        path = Path(given).expanduser()
        if not path.is_file():
            raise MissingDependencyError(f"expected a Python in {WHERE}, found no file {path}")
        return str(path.absolute())  # not resolved: a venv is known by its link
    if importlib.util.find_spec("pyvale") is None:
        raise MissingDependencyError(HOW_TO_GET)
    return sys.executable


def subset_field(pair: ImagePair, options: SubsetOptions | None = None) -> LocalField:
    """Measure a displacement field by subsets, with standard deviations by :func:`predicted_sd`.

    Subsets below the threshold are kept as not valid; the deformed image's mask only helps to find
    the largest motion. Raises MissingDependencyError if pyvale is not installed, InputError if no
    subset fits into the material, or pyvale fails.
    """
    options = options or SubsetOptions()
    python = pyvale_python()
    grid, inside = pair.grid, pair.masks[0]
    seeds = _seeds(inside, options.subset_px)
    largest = options.largest_px or _largest_motion(pair)
    reason = ""
    with tempfile.TemporaryDirectory(prefix="modeharvest-pyvale-") as name:
        folder = Path(name)
        for seed, share in product(seeds, _SHARES):
            arguments = _arguments(options, grid, seed, round(share * largest))
            reason = _run(python, folder, pair, arguments)
            results = sorted(folder.glob("subsets_*.csv"))
            if results:
                field = read_field(results[0], grid)
                zncc = read_table(results[0])["cost_zncc"]
                sd = predicted_sd(pair.reference, inside, grid, field, zncc, options.subset_px)
                return replace(field, sd=sd, source=f"pyvale, subsets of {options.subset_px} px")
    raise InputError(f"subset DIC: expected a result of pyvale, got none: {reason}")


def _largest_motion(pair: ImagePair) -> int:
    """Largest motion along either axis [px], by a rough field, with a margin."""
    grid = pair.grid
    known, _ = first_motion(Box(*grid.extent), pair, None)
    cell = CELL_PX * max(1, round(min(grid.shape) / _COARSE_PX)) * grid.pixel_size
    rough = coarse_field(pair, cell, known)
    most = float(np.quantile(np.abs(rough.u).max(axis=1), _MOST)) / grid.pixel_size
    return int(np.ceil(_MARGIN * most)) + 4


def _seeds(mask: BoolArray, subset_px: int) -> list[tuple[int, int]]:
    """(col, row) of places with most material around, far from each other; the best first."""
    room, seeds = room_around(mask), list[tuple[int, int]]()
    for _ in range(_TRIES):
        row, col = np.unravel_index(int(np.argmax(room)), room.shape)
        if 2 * room[row, col] - 1 < subset_px:
            break
        seeds.append((int(col), int(row)))
        reach = max(mask.shape) // 6
        room[max(0, row - reach) : row + reach, max(0, col - reach) : col + reach] = 0
    if not seeds:
        raise InputError(
            f"subset DIC: expected material wide enough for a subset of {subset_px} px, got none; "
            "take smaller subsets"
        )
    return seeds


def _arguments(
    options: SubsetOptions, grid: PixelGrid, seed: tuple[int, int], largest: int
) -> dict[str, Any]:
    """Arguments of pyvale's ``calculate_2d``."""
    return {
        "seed": list(seed),
        "subset_size": options.subset_px,
        "subset_step": options.step_px,
        "shape_function": options.shape.upper(),
        "threshold": options.threshold,
        "partial_subset": options.filling,
        "max_displacement": min(max(largest, options.subset_px), (min(grid.shape) - 1) // 2),
        "num_threads": options.threads,
        "image_filter_kernel": 1,  # no blur: the unfiltered images
    }


def _run(python: str, folder: Path, pair: ImagePair, arguments: dict[str, Any]) -> str:
    """Run pyvale once; returns the last line of its error output, for the case that it fails."""
    f, g = pair.reference, pair.deformed
    low, high = min(f.min(), g.min()), max(f.max(), g.max())
    f, g = ((255.0 * (i - low) / (high - low)).astype(np.float32) for i in (f, g))
    mask = pair.masks[0]
    np.savez(folder / "request.npz", f=f, g=g, mask=mask, arguments=json.dumps(arguments))
    quiet = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "OMP_NUM_THREADS")}
    # pyvale leaves a log where it is run.
    done = subprocess.run(
        [python, str(_SIDE), str(folder)], cwd=folder, env=quiet, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    named = [line for line in lines if "Error" in line]
    if done.returncode < 0:
        return f"it was ended by signal {-done.returncode}"
    return (named or lines or [f"exit code {done.returncode}"])[-1].strip()
