"""
From photographs to modes with error bars
=========================================

``harvest`` needs only photographs, the pixel size and the cell size. It finds holes, lattice,
noise, mode family and initial guess. The photographs here are rendered, with 1 % of noise.
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
spec = mh.ImagingSpec(pixel_size=0.05)
spec = replace(spec, sensor=replace(spec.sensor, read_noise=0.01))
images = mh.make_images(solution, spec, folder / "images")
for path in (folder / "images").glob("*_8bit.tif"):
    shutil.copy(path, folder / path.name.replace("_8bit", "").replace("deformed", "frame"))
print(sorted(path.name for path in folder.glob("*.tif")))

# %%
# A file of a few lines describes the experiment.

experiment = """
[images]
reference = "reference.tif"
deformed = ["frame_*.tif"]
[scale]
pixel_size = 0.05              # mm/px
[specimen]
cell_size = 1.9                # mm
"""
(folder / "experiment.toml").write_text(experiment)
summary = mh.harvest(folder / "experiment.toml", folder / "out")

# %%
# Standard deviations due to the camera's noise, and due to model error with noise. a1 to a5 are
# dimensionless, a6 and a7 are lengths.

mode = summary["frames"][-1]["modes"][0]
print(summary["frames"][-1]["outcome"], "in", summary["frames"][-1]["iterations"], "iterations")
names = [p["name"] for p in mode["parameters"]]
off = np.array([p["value"] for p in mode["parameters"]]) - [1, 1, 1, -1, 1, 0, 0]
fig, axes = plt.subplots(1, 2, figsize=(7.5, 4), width_ratios=(5, 2), layout="constrained")
for ax, some, unit in zip(axes, (range(5), range(5, 7)), ("-", "mm"), strict=True):
    for shift, key, label in ((-0.1, "sd_noise", "noise"), (0.1, "sd_model_error", "model error")):
        deviation = [2 * mode["parameters"][k][key] for k in some]
        place = np.array(some) + shift
        ax.errorbar(place, off[some], deviation, fmt="o", capsize=3, label=f"two sd by {label}")
    ax.axhline(0.0, color="k", lw=0.8)
    ax.set_xticks(some, [names[k] for k in some])
    ax.set(xlim=(some[0] - 0.6, some[-1] + 0.6), ylabel=f"parameter of φ₁ − ideal value [{unit}]")
axes[0].legend()
