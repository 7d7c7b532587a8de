"""
Grade a DIC code
================

Any code can measure the benchmark images; its displacements are graded against the truth. Here, two
small codes are compared: scikit-image's optical flow with small and with large windows.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from skimage.registration import optical_flow_ilk

import modeharvest as mh
from modeharvest.imaging.photographs.files import read_image
from modeharvest.runs.benchmark import make_benchmark, score
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.validation.scoring.benchmark import Declared

folder = Path(tempfile.mkdtemp())
case = Case.read("paper-virtual").model_copy(update={"imaging": mh.ImagingSpec(pixel_size=0.04)})
make_benchmark(case, folder / "bench", solution=shipped_solution("paper-virtual"))
print(sorted(path.name for path in (folder / "bench").iterdir()))

# %%
# The tested code reads only the public folder. It returns displacements on a grid of points.

reference = read_image(folder / "bench/reference.tif")
deformed = read_image(folder / "bench/deformed_0780.tif")
rows, cols = np.mgrid[4 : reference.shape[0] : 4, 4 : reference.shape[1] : 4]
for radius in (5, 15):
    down, right = optical_flow_ilk(reference, deformed, radius=radius, num_warp=10)
    values = [cols, rows, right[rows, cols], down[rows, cols]]
    header, table = "x [px],y [px],u [px],v [px]", np.column_stack([v.ravel() for v in values])
    np.savetxt(folder / f"flow_{radius}.csv", table, "%.6g", ",", header=header, comments="")

# %%
# ``modeharvest score flow.csv --y-axis down --truth bench-truth --strain 0.078 --out graded`` does
# the same. Axes and first pixel are declared if the file doesn't state them. Only regions with
# points are drawn: ligaments are 10 px wide in these small images, and all material within 10 px of
# an edge counts as edge.

declared = {folder / f"flow_{r}.csv": Declared(y_axis="down") for r in (5, 15)}
grading = score(declared, folder / "bench-truth", 0.078, folder / "graded")
fig, ax = plt.subplots(figsize=(7.5, 4), layout="constrained")
for k, graded in enumerate(grading.scores):
    parts = {name: part for name, part in grading.parts(graded).items() if part.points}
    rms = [part.rms_px for part in parts.values()]
    ax.bar(np.arange(len(rms)) + 0.4 * k, rms, 0.38, label=graded.source)
    print(f"{graded.source}: {graded.everywhere.rms_px:.3f} px rms, {graded.covered:.0%} covered")
ax.set_xticks(np.arange(len(parts)) + 0.2, [name.replace(" ", "\n", 1) for name in parts])
ax.set(ylabel="rms error [px]", title="by region")
ax.legend()
