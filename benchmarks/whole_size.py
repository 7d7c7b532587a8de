"""How time and memory of the whole displacement grow with the number of pixels.

Images of 1 to 50 Mpx show a plate with a square array of holes (190 px apart, 150 px wide, as the
paper's at 0.01 mm/px), compressed by 2 %, with the paper's pattern of 3 px and waves of 1 px that
the start doesn't have. f is sampled from the spline of g at the true displacement, and noise of
0.5 % is added to both. A larger image shows more holes. Each size is measured in a process of its
own: seconds from the start (mesh included) to the written HDF5 file; the process's peak memory, and
that before the measurement; the rms error per component. Results: docs/explanation/speed.md.

Run: scripts/env python benchmarks/whole_size.py [--mpx 1 3.6 10 25 50]
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.finite_element.files import write_result
from modeharvest.idic.finite_element.measure import measure_displacement
from modeharvest.idic.solver.pyramid import blurred
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage

PIXEL_MM, PITCH_PX, RADIUS_PX, MARGIN_PX = 0.01, 190.0, 75.0, 60
STRAIN, PATTERN_PX, WAVE_PX, SPECKLE_PX, NOISE = 0.02, 3.0, 1.0, 4.0, 0.005
FULL_SCALE = 255.0
Field = NDArray[np.float64]


def without_waves(x: Field, y: Field) -> tuple[Field, Field]:
    """Displacement of the start [px] at points [px]: compression, and the pattern of phi_1."""
    x, y, stretched = x * np.pi / PITCH_PX, y * np.pi / PITCH_PX, -STRAIN * y
    u, v = np.cos(x) * np.sin(y), -np.sin(x) * np.cos(y)
    return PATTERN_PX * u, PATTERN_PX * v + stretched


def true(x: Field, y: Field) -> tuple[Field, Field]:
    """Displacement [px] at points [px]."""
    k, (u, v) = 2.0 * np.pi / PITCH_PX, without_waves(x, y)
    return u + WAVE_PX * np.sin(k * x) * np.cos(k * y), v + WAVE_PX * np.cos(k * x) * np.sin(k * y)


def is_material(x: Field, y: Field, rows: int, cols: int) -> NDArray[np.bool_]:
    """True on the plate, outside of its holes."""
    near = np.hypot(*((p + 0.5 * PITCH_PX) % PITCH_PX - 0.5 * PITCH_PX for p in (x, y)))
    inside = (np.abs(x) < 0.5 * cols - MARGIN_PX) & (np.abs(y) < 0.5 * rows - MARGIN_PX)
    return np.asarray(inside & (near > RADIUS_PX))


def images(mpx: float) -> ImagePair:
    """Reference and deformed image [grey levels], with their masks."""
    rows = round(np.sqrt(1e6 * mpx / 0.8))
    grid = PixelGrid.centred(rows, round(0.8 * rows), PIXEL_MM)
    random = np.random.default_rng(0)
    g = blurred(random.standard_normal(grid.shape, dtype=np.float32), 0.4 * SPECKLE_PX)
    g = 128.0 + 40.0 * g / g.std()
    spline, f = SplineImage.of(g, 5), np.empty_like(g)
    masks = np.zeros((2, *grid.shape), np.bool_)
    x = grid.x / PIXEL_MM
    for row, y in enumerate(grid.y / PIXEL_MM):
        u, v = true(x, np.full_like(x, y))
        masks[0, row] = is_material(x, np.full_like(x, y), *grid.shape)
        f[row] = spline.sample(row - v, np.arange(x.size) + u)[0]
        before = x, np.full_like(x, y)
        for _ in range(8):  # where the deformed image's pixels were in the reference
            u, v = true(*before)
            before = x - u, y - v
        masks[1, row] = is_material(*before, *grid.shape)
    for image, mask in zip((f, g), masks, strict=True):
        image[~mask] = 15.0
        image += FULL_SCALE * NOISE * random.standard_normal(image.shape, dtype=np.float32)
    return ImagePair(f, g, grid, *masks)


def start(points: Field) -> Field:
    """(n, 2) displacement [mm] at points (n, 2) [mm]."""
    return PIXEL_MM * np.stack(without_waves(*(points / PIXEL_MM).T), axis=1)


def peak_gib() -> float:
    """Peak memory of this process so far [GiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def row(mpx: float) -> str:
    """Measure images of one size; a line of the table."""
    pair = images(mpx)
    before, begin = peak_gib(), time.perf_counter()
    found = measure_displacement(pair, start)
    with tempfile.TemporaryDirectory() as folder:
        write_result(Path(folder) / "displacement.h5", found)
    seconds, peak = time.perf_counter() - begin, peak_gib()
    pixels = found.mesh.nodes / PIXEL_MM
    error = found.displacement / PIXEL_MM - np.stack(true(*pixels.T), axis=1)
    area = pair.masks[0].sum() / 1e6
    return (
        f"| {mpx:.1f} | {area:.1f} | {2 * len(pixels) / 1000:.0f} | {seconds:.0f} | "
        f"{seconds / area:.1f} | {peak:.1f} | {before:.1f} | {found.cutoff_px:.0f} | "
        f"{np.sqrt(np.mean(error**2)):.3f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--mpx", type=float, nargs="+", default=[1.0, 3.6, 10.0, 25.0, 50.0])
    parser.add_argument("--here", action="store_true", help="in this process; prints no header")
    given = parser.parse_args()
    if given.here:
        print(row(given.mpx[0]), flush=True)
        return
    print("| image [Mpx] | material [Mpx] | unknowns [1000] | time [s] | per Mpx of material [s] "
          "| peak memory [GiB] | before [GiB] | ℓ [px] | rms error at nodes [px] |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for mpx in given.mpx:
        subprocess.run([sys.executable, __file__, "--here", "--mpx", str(mpx)], check=True)


if __name__ == "__main__":
    main()
