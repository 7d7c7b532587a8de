"""
From photographs to modes with error bars
=========================================

Photographs, the size of a pixel and of a cell are all that ``harvest`` needs. Holes, lattice,
noise, mode family and initial guess are found. Photographs here are rendered, with 1 % of noise.
"""

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import modeharvest as mh
from modeharvest.runs.case import shipped_solution

folder = Path(tempfile.mkdtemp())
solution = mh.Solution.read(shipped_solution("paper-virtual"))
spec = mh.ImagingSpec(pixel_size=0.04)
spec = replace(spec, sensor=replace(spec.sensor, read_noise=0.01))
images = mh.make_images(solution, spec, folder / "images")
for path in (folder / "images").glob("*_8bit.tif"):
    shutil.copy(path, folder / path.name.replace("_8bit", "").replace("deformed", "frame"))
print(sorted(path.name for path in folder.glob("*.tif")))

# %%
# The whole experiment is a file of a few lines.

experiment = """
[images]
reference = "reference.tif"
deformed = ["frame_*.tif"]
[scale]
pixel_size = 0.04              # mm/px
[specimen]
cell_size = 1.9                # mm
"""
(folder / "experiment.toml").write_text(experiment)
summary = mh.harvest(folder / "experiment.toml", folder / "out")

# %%
# Standard deviations by the camera's noise, and by model error.

mode = summary["frames"][-1]["modes"][0]
print(summary["frames"][-1]["outcome"], "in", summary["frames"][-1]["iterations"], "iterations")
names = [p["name"] for p in mode["parameters"]]
off = np.array([p["value"] for p in mode["parameters"]]) - [1, 1, 1, -1, 1, 0, 0]
fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
for shift, key, label in ((-0.1, "sd_noise", "noise"), (0.1, "sd_model_error", "model error")):
    deviation = np.array([p[key] for p in mode["parameters"]])
    place = np.arange(len(names)) + shift
    ax.errorbar(place, off, 2 * deviation, fmt="o", capsize=3, label=f"two sd by {label}")
ax.axhline(0.0, color="k", lw=0.8)
ax.set_xticks(range(len(names)), names)
ax.set(ylabel="parameter of φ₁ less that of the ideal pattern")
ax.legend()
