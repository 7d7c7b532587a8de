"""Accuracy of the material mask and of the holes' motion in images whose truth is known.

The paper's virtual specimen, undeformed and at 12.8 % after buckling, photographed with noise on
four backgrounds: ``python benchmarks/material.py``. Columns: wrong pixels of the mask; distance of
its edge from the true one (bias: positive is too little material; rms); rms error of the holes'
motion, against the mean true motion around each (docs/how-to/photographs.md).
"""

from __future__ import annotations

import tempfile

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, distance_transform_edt

from modeharvest.fem.field import Solution
from modeharvest.idic.photograph.holes import find_hole_lattice
from modeharvest.idic.photograph.matching.holes import HoleMotion, possible_motions
from modeharvest.idic.photograph.material import find_material
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.pair import Truth
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import shipped_solution

BoolArray = NDArray[np.bool_]

STRAIN, RING_PX = 0.128, 5.0
SENSOR = Sensor(full_well=10_000, read_noise=0.01, gain=0.9, offset=0.02)


def edge_distance(found: BoolArray, truth: BoolArray) -> NDArray[np.float64]:
    """Distance of the found mask's edge pixels from the true edge [px], positive inside."""
    depth = np.where(truth, distance_transform_edt(truth), 1.0 - distance_transform_edt(~truth))
    edge = found & ~binary_erosion(found, border_value=1)
    return np.asarray(depth[edge] - 1.0)


def motion_error(motion: HoleMotion, images: ImageSet) -> float:
    """Rms error of the holes' motion, over holes and components [px]."""
    grid, mask = images.grid, images.mask()
    u = Truth.read(images.folder / images.info["snapshots"][0]["truth"]).displacement
    row, col = np.mgrid[: grid.rows, : grid.cols]
    found = motion.in_mm(grid).u
    errors = []
    for (r, c), moved in zip(motion.before, found, strict=True):
        near = np.s_[int(r) - 90 : int(r) + 91, int(c) - 90 : int(c) + 91]
        ring = mask[near] & (np.hypot(row[near] - r, col[near] - c) < 75.0 + RING_PX)
        errors.append(u[near][ring].mean(axis=0) - moved)
    return float(np.sqrt(np.mean(np.square(errors))) / grid.pixel_size)


def main() -> None:
    solution = Solution.read(shipped_solution("paper-virtual"))
    print("background  wrong undeformed  bias    rms  | wrong deformed  bias    rms  | motion")
    for background in (0.0, 0.2, 0.5, 0.95):
        spec = ImagingSpec(pixel_size=0.01, background=background, sensor=SENSOR)
        with tempfile.TemporaryDirectory() as folder:
            images = make_images(solution, spec, folder, [STRAIN])
            truths = images.mask(), images.deformed_mask(STRAIN)
            pictures = images.reference(camera=True), images.deformed(STRAIN, camera=True)
            masks = [find_material(picture).mask for picture in pictures]
            line = f"{background:10.2f}"
            for mask, truth in zip(masks, truths, strict=True):
                off = edge_distance(mask, truth)
                wrong = 100 * (mask != truth).mean()
                line += f"  {wrong:12.3f} % {off.mean():+.2f}  {np.sqrt((off**2).mean()):.2f} px |"
            motion = possible_motions(*map(find_hole_lattice, masks))[0]
            print(
                f"{line} {motion_error(motion, images):.2f} px of {len(motion)} holes", flush=True
            )


if __name__ == "__main__":
    main()
