"""The star pattern of DIC Challenge 2.0: its motion, its exact images, and the image set.

With the row i down and the column j, in px, from the centre of the upper left pixel,

    v(i, j) = A cos(2 pi (i - c) / p(j)) down,  u = 0,  p(j) = p_1 + (p_2 - p_1) j / (cols - 1),

with c the centre row. There the motion is A at all columns; the displacement measured there, over
A, is the transfer function by period. By default 4000 x 501 px, A = 0.5 px, periods from 10
to 300 px, as in P. L. Reu et al., Exp. Mech. 62 (2022) 639, doi 10.1007/s11340-021-00806-6.

The displacement is a function of *reference* points: a deformed pixel x shows the point X with X +
u(X) = x, found to rounding, where the speckle is evaluated, not interpolated. Files in a folder::

    DIR/reference.tif deformed.tif                          exact, float
        reference_1pct.tif still_1pct.tif deformed_1pct.tif camera images, for each noise level
        star.json README.md

The truth is public: the displacement is a formula. The set's id is a digest of its files.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, read_record, reading, sha256_of, write_json
from modeharvest.util.machine import require_memory
from modeharvest.util.progress import Progress, silent
from modeharvest.util.stages import Stages, stage_key
from modeharvest.util.typed import made
from modeharvest.validation.scoring.benchmark import set_record

KEPT = 0.9
"""Share of the amplitude measured at the finest period: an attenuation of 10 % [-]."""
_BYTES_PER_PIXEL = 300.0
"""Memory for making the images [bytes/px]."""
_STEEPEST = 0.9
"""Largest derivative of the motion, 2 pi A / p [-]: at 1 the image folds."""
_NEAR = 1e-3
"""Distance from the solution within which Newton's method converges [px]."""


@dataclass(frozen=True)
class Star:
    """The wave and its image; InputError if the image would nearly fold, or is too small."""

    rows: int = 501
    cols: int = 4000
    """Size of the image [px], with an odd number of rows."""
    amplitude_px: float = 0.5
    """A [px]."""
    shortest_px: float = 10.0
    longest_px: float = 300.0
    """Periods at the first and at the last column [px]."""

    def __post_init__(self) -> None:
        size = f"{self.rows} x {self.cols} px"
        if self.rows < 31 or self.rows % 2 == 0 or self.cols < 100:
            wanted = "an odd number of rows, at least 31, and at least 100 columns"
            raise InputError(f"star: expected {wanted}, got {size}")
        needed = _BYTES_PER_PIXEL * self.rows * self.cols
        require_memory(needed, f"a star of {size}", "take fewer --rows or --cols")
        steepest = 2.0 * np.pi * self.amplitude_px / self.shortest_px
        if not (0.0 < steepest <= _STEEPEST and 0.0 < self.shortest_px < self.longest_px < np.inf):
            raise InputError(
                f"star: expected 0 < 2 pi amplitude <= {_STEEPEST} shortest period, and a longer "
                f"longest one, got an amplitude of {self.amplitude_px} px and periods of "
                f"{self.shortest_px} to {self.longest_px} px"
            )

    @property
    def centre_row(self) -> int:
        """The row where the motion is A at all columns."""
        return self.rows // 2

    @property
    def grid(self) -> PixelGrid:
        """The pixels, with lengths in px: x = column; y points up and is 0 at the centre row."""
        return PixelGrid(self.rows, self.cols, 1.0, 0.0, float(self.centre_row))

    def period(self, col: ArrayLike) -> FloatArray:
        """(...) period of the wave at columns (...) [px]."""
        share = np.asarray(col, dtype=np.float64) / (self.cols - 1)
        return np.asarray(self.shortest_px + (self.longest_px - self.shortest_px) * share)

    def column(self, period: ArrayLike) -> FloatArray:
        """(...) columns at which the wave has these periods (...) [px]."""
        share = np.subtract(period, self.shortest_px) / (self.longest_px - self.shortest_px)
        return np.asarray((self.cols - 1) * share, dtype=np.float64)

    def down(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """v, positive down, at reference points (row, col) that broadcast together [px]."""
        phase = 2.0 * np.pi * np.subtract(row, self.centre_row) / self.period(col)
        return np.asarray(self.amplitude_px * np.cos(phase))

    def displacement(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """(..., 2) displacement along x and y (up) at points (...) of :attr:`grid` [px]."""
        v = self.down(np.subtract(self.centre_row, y), x)
        return np.stack([np.zeros_like(v), -v], axis=-1)

    def came_from(self) -> tuple[FloatArray, float]:
        """(rows, cols) reference row X of each deformed pixel, and max |X + v(X) - x|, both in px.

        Fixed-point iteration of X = x - v(X), in which the error shrinks at least by the factor
        2 pi A / p, then Newton steps down to rounding; columns don't change.
        """
        row = np.arange(self.rows, dtype=np.float64)[:, None]
        wave = 2.0 * np.pi / self.period(np.arange(self.cols))
        point = np.broadcast_to(row, (self.rows, self.cols)).copy()
        before = np.inf
        while True:
            phase = wave * (point - self.centre_row)
            error = point + self.amplitude_px * np.cos(phase) - row
            largest = float(np.abs(error).max())
            if largest >= 0.5 * before:  # Newton's method has reached rounding
                return point, largest
            if largest < _NEAR:
                error /= 1.0 - self.amplitude_px * wave * np.sin(phase)
                before = largest
            point -= error


def fine_speckle(seed: int = 0) -> SpeckleSpec:
    """A speckle of size 5 px (autocorrelation FWHM) that noise of 10 % does not saturate."""
    return SpeckleSpec(standard_deviation=0.1, blur_px=1.0, dark=0.1, bright=0.9, seed=seed)


def exact_images(star: Star, speckle: SpeckleSpec) -> tuple[FloatArray, FloatArray, float]:
    """(rows, cols) f and g [fraction of full scale], and the inversion's residual [px]."""
    pattern = Speckle(speckle, (star.rows, star.cols))
    row, residual_px = star.came_from()
    col = np.broadcast_to(np.arange(star.cols, dtype=np.float64), row.shape)
    return pattern.image(), pattern.exact(row, col), residual_px


FORMAT = "modeharvest-star-1"
SIDECAR, README = "star.json", "README.md"
_README = resources.files(__package__).joinpath("star_readme.txt").read_text("utf-8")
_ROLES = {
    "reference": "before the motion",
    "still": "the same again, with other noise",
    "deformed": "after it",
}
"""Text on each image of a noise level."""


@dataclass(frozen=True)
class StarSpec:
    """Content of a star set; InputError if a noise level occurs twice or is out of range."""

    star: Star = field(default_factory=Star)
    speckle: SpeckleSpec = field(default_factory=fine_speckle)
    noise: tuple[float, ...] = (0.01,)
    """Standard deviations of the white noise in the camera images [fraction of full scale]; 0.01
    is 2.6 of 255 levels."""
    bits: int = 8
    """Bit depth of the camera images."""
    seed: int = 0
    """Seed of the noise."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "noise", tuple(self.noise))
        is_twice = len({image_name("", n) for n in self.noise}) < len(self.noise)
        if is_twice or not all(1e-4 <= n <= 0.1 for n in self.noise):
            got = ", ".join(f"{n:g}" for n in self.noise)
            wanted = "different levels of noise from 0.0001 to 0.1 of full scale"
            raise InputError(f"star: expected {wanted}, got {got}")
        if not 1 <= self.bits <= 16 or self.seed < 0:
            got = f"{self.bits} and {self.seed}"
            raise InputError(f"star: expected 1 to 16 bits and a seed of 0 or more, got {got}")


@dataclass(frozen=True, eq=False)
class StarSet:
    """A star set in its folder."""

    folder: Path
    spec: StarSpec
    id: str
    info: Mapping[str, Any]

    @classmethod
    def read(cls, folder: Path | str) -> StarSet:
        """Open a set; InputError if there is none."""
        path = Path(folder) / SIDECAR
        what, remedy = "a star set", "'modeharvest benchmark star' makes one"
        with reading(path, what, remedy):
            info = read_record(path, FORMAT, what, remedy)
            return cls(Path(folder), made(StarSpec, info["spec"]), str(info["id"]), info)


def make_star_set(spec: StarSpec, folder: Path | str, progress: Progress = silent) -> StarSet:
    """Write a star set; a complete set of the same spec is kept."""
    folder = Path(folder)

    def work() -> list[Path]:
        progress(0, 3, "star: images")
        f, g, residual_px = exact_images(spec.star, spec.speckle)
        progress(1, 3, "star: images")
        files = {}
        for name, image in _images(spec, f.astype(np.float32), g.astype(np.float32)):
            write_image(folder / name, image)
            path = folder / name
            files[name] = {"bytes": path.stat().st_size, "sha256": sha256_of(path)}
        progress(2, 3, "star: images")
        info = _info(spec, files, residual_px)
        with atomic(folder / README) as part:
            part.write_text(star_readme(info), "utf-8")
        write_json(folder / SIDECAR, info)
        progress(3, 3, "star: images")
        return [folder / name for name in (*files, README, SIDECAR)]

    Stages(folder).do("star", stage_key(asdict(spec)), work)
    return StarSet.read(folder)


def image_name(role: str, noise: float | None = None) -> str:
    """File name of an exact image, or of an image with noise, with _1pct or _0p5pct."""
    level = "" if noise is None else f"_{100.0 * noise:g}pct".replace(".", "p")
    return f"{role}{level}.tif"


def _images(spec: StarSpec, f: FloatImage, g: FloatImage) -> Iterator[tuple[str, NDArray[Any]]]:
    """All images with their file names."""
    yield from ((image_name("reference"), f), (image_name("deformed"), g))
    for noise in spec.noise:
        camera = Sensor(read_noise=noise, read_seed=spec.seed)
        for role, exact in zip(_ROLES, (f, f, g), strict=True):
            name = image_name(role, noise)
            yield name, camera.expose(exact, spec.bits, name)


def star_readme(info: Mapping[str, Any]) -> str:
    """The README of a set, Markdown, from the content of its ``star.json``."""
    star, bits, rows = Star(**info["spec"]["star"]), info["spec"]["bits"], []
    for name in info["files"]:
        role, _, level = name.removesuffix(".tif").partition("_")
        percent = level.removesuffix("pct").replace("p", ".")
        kind = f"{bits} bit, noise {percent} % of full scale" if level else "exact, float"
        rows.append(f"| `{name}` | {_ROLES[role]}; {kind} |")
    longer, last = star.longest_px - star.shortest_px, star.cols - 1
    return _README.format(star=star, longer=longer, last=last, table="\n".join(rows), **info)


def _info(spec: StarSpec, files: Mapping[str, Any], residual_px: float) -> dict[str, Any]:
    """The content of ``star.json``."""
    star = spec.star
    longer = star.longest_px - star.shortest_px
    law = {
        "v_down_px": f"{star.amplitude_px:g} cos(2 pi (row - {star.centre_row}) / period)",
        "period_px": f"{star.shortest_px:g} + {longer:g} col / {star.cols - 1}",
        "u_px": 0,
        "of": "points of the reference image; the centre of the upper left pixel is (0, 0)",
        "residual_of_inversion_px": residual_px,
    }
    return set_record(FORMAT, files, law=law, spec=asdict(spec))
