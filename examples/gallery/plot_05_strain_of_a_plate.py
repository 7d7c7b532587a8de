"""
Strain of a speckled plate with a hole
======================================

``measure`` assumes neither a lattice nor a mode. It needs two images and gives displacement and
strain up to the edge of the hole, with standard deviations. These images are made from a formula
that stretches and bends the plate as if there were no hole: so there is no concentration of strain
at the hole, unlike in a loaded plate.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import meshio
import numpy as np

from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.sensor import quantise
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.runs.measure import measure

shape, folder = (240, 320), Path(tempfile.mkdtemp())
row, col = np.mgrid[: shape[0], : shape[1]].astype(float)
x, y = col - 159.5, row - 119.5
speckle = Speckle(SpeckleSpec(standard_deviation=0.08, blur_px=2.0), shape)


def stretched(values):
    """Reference positions of points of the deformed image: stretch of 4 % along x, and bending."""
    return values / 1.04, y - 0.0004 * values**2 / 1.04


for name, (at_x, at_y) in {"reference": (x, y), "deformed": stretched(x)}.items():
    inside = (abs(at_x) < 130) & (abs(at_y) < 90) & (np.hypot(at_x, at_y) > 30)
    grey = np.where(inside, speckle(at_y + 119.5, at_x + 159.5), 0.0)
    write_image(folder / f"{name}.tif", quantise(grey, 8))

summary = measure(folder / "reference.tif", [folder / "deformed.tif"], folder / "out")
numbers = summary["images"][0]
print({key: numbers[key] for key in ("rms_px", "median_sd_px", "coverage", "cutoff_px")})

# %%
# The file for ParaView has the mesh and all fields at its nodes; matplotlib can draw them, too.
# According to the formula, the strain along x is 4.1 % in the middle and 4.7 % at both ends, where
# the bent plate has the largest slope.

mesh = meshio.read(folder / "out/results/deformed.vtu")
E = np.asarray(mesh.point_data["green_lagrange"]).reshape(len(mesh.points), -1)[:, 0]
finer = mesh.cells[0].data[:, [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]]  # of quadratic ones
fig, ax = plt.subplots(figsize=(7, 4.6), layout="constrained")
x, y, _ = mesh.points.T
shown = ax.tripcolor(x, y, 100 * E, triangles=finer.reshape(-1, 3), shading="gouraud")
ax.set_aspect("equal")
ax.set(xlabel="x [px]", ylabel="y [px]", title="Green–Lagrange strain along x")
fig.colorbar(shown, label="%")
