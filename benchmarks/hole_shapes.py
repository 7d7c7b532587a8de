"""Displacement from contours, for holes of various shapes.

::

    scripts/env python benchmarks/hole_shapes.py [--pixel-size 0.03] [--strain 0.06]

A plate with 3 x 3 holes (Ogden law, exponent 3), clamped left and right and compressed; holes are
round, elliptical (along x and y in turn), dimpled (four dents), notched (two slits) or of three
sizes. Photographs as in contours.py, 1 % noise. Table: docs/explanation/contours.md.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.materials import Ogden
from modeharvest.fem.sparse_factor import factorise
from modeharvest.idic.finite_element.equations.system import Imbalance
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.mesh import mesh_of_mask
from modeharvest.idic.photograph.plain.measure import displacement_of_plain
from modeharvest.idic.photograph.plain.surface import plain_surface
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.photographs.files import read_image
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.util.arrays import BoolArray, FloatArray

PITCH, HALF, FINE = 1.9, 3.4, 0.01
"""Pitch of the holes, half the plate's side, pixel of the mask that is meshed [mm]."""
Hole = Callable[[FloatArray, FloatArray, int], BoolArray]
"""Whether points (x, y) from a hole's centre [mm] are inside; the last argument is its number."""


def dimpled(x: FloatArray, y: FloatArray, _: int) -> BoolArray:
    """A radius of 0.68 mm with four dents: it varies by 0.08 mm both ways."""
    return np.asarray(np.hypot(x, y) < 0.68 + 0.08 * np.cos(4.0 * np.arctan2(y, x)))


def notched(x: FloatArray, y: FloatArray, _: int) -> BoolArray:
    """Two slits, 0.16 mm wide and 0.15 mm deep."""
    return np.asarray((np.hypot(x, y) < 0.6) | ((np.abs(x) < 0.08) & (np.abs(y) < 0.75)))


SHAPES: dict[str, Hole] = {
    "round": lambda x, y, _: np.asarray(np.hypot(x, y) < 0.7),
    "elliptical": lambda x, y, k: np.asarray(
        np.hypot(x / (0.55, 0.75)[k % 2], y / (0.75, 0.55)[k % 2]) < 1.0
    ),
    "dimpled": dimpled,
    "notched": notched,
    "three sizes": lambda x, y, k: np.asarray(np.hypot(x, y) < (0.35, 0.55, 0.75)[k % 3]),
}


def plate(hole: Hole) -> Mesh:
    """Mesh of a plate with 3 x 3 holes."""
    count = round(2.0 * (HALF + 0.3) / FINE)
    grid = PixelGrid.centred(count, count, FINE)
    x, y = np.meshgrid(grid.x, grid.y)
    material = (np.abs(x) < HALF) & (np.abs(y) < HALF)
    for k in range(9):
        material &= ~hole(x - PITCH * (k % 3 - 1), y - PITCH * (k // 3 - 1), k)
    return mesh_of_mask(material, grid, 16.0, 6.0).mesh


def pressed(mesh: Mesh, strain: float, steps: int = 4) -> FloatArray:
    """(n, 2) displacement [mm] of a plate whose left and right edges approach each other."""
    law = Imbalance(mesh, Ogden(), np.zeros(len(mesh.nodes), dtype=np.bool_))
    x = mesh.nodes[:, 0]
    clamped = (x < x.min() + 2.0 * FINE) | (x > x.max() - 2.0 * FINE)
    free = np.repeat(~clamped, 2)
    u = np.column_stack([-strain / steps * x, 0.0 * x])
    for step in range(1, steps + 1):
        new = u * step / max(1, step - 1)  # extrapolated; exact at clamped edges
        for _ in range(12):
            f, K = law.forces(new.ravel())
            if np.abs(f[free]).max() < 1e-9:
                break
            new.ravel()[free] -= factorise(csr_array(K[free][:, free])).solve(f[free])
        u = new
    return u


def row(name: str, pixel_size: float, strain: float) -> str:
    """Measure photographs of a plate; a line of the table."""
    mesh = plate(SHAPES[name])
    solution = Solution(mesh, (Snapshot(strain, pressed(mesh, strain)),))
    spec = ImagingSpec(
        pixel_size, 40, background=0.15, speckle=SpeckleSpec(dark=0.7, bright=0.7),
        sensor=Sensor(fill_factor=1.0, psf_px=0.6, read_noise=0.01), bits=8,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        (pair,) = make_images(solution, spec, folder)
        names = ("reference", f"deformed_{round(1e4 * strain):04d}")
        f, g = (read_image(Path(folder) / f"{n}_8bit.tif") for n in names)
        assert pair.truth
        u = pair.truth.displacement
    surface = plain_surface(f)
    assert surface
    body = FiniteElementOptions().body(surface.mask, pair.grid)
    found, matched = displacement_of_plain(surface, g, pair.grid, body)
    off, sd = found.displacement_on() - u, found.standard_deviation_on()
    there = np.isfinite(off[..., 0])
    px, length = pair.grid.pixel_size, np.linalg.norm(off[there], axis=1)
    line = [
        np.sqrt(np.mean(off[there] ** 2)) / px, length.max() / px,
        100.0 * np.mean(np.abs(off[there]) < 1.96 * sd[there]), found.residual_rms,
    ]  # fmt: skip
    cells = " | ".join(f"{value:.3g}" for value in line)
    return f"| {name} | {cells} | {len(matched.holes)} | {' '.join(found.warnings) or 'none'} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixel-size", type=float, default=0.03, help="[mm]")
    parser.add_argument("--strain", type=float, default=0.06)
    parser.add_argument("--only", nargs="*", default=[*SHAPES], choices=[*SHAPES])
    given = parser.parse_args()
    print("| holes | u off, rms [px] | longest [px] | in 95 % intervals [%] | "
          "off the contours, rms [px] | holes found | warnings |\n" + "|---" * 7 + "|")  # fmt: skip
    for name in given.only:
        print(row(name, given.pixel_size, given.strain), flush=True)


if __name__ == "__main__":
    main()
