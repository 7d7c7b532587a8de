"""
The whole displacement, up to every edge
========================================

The part of the displacement that the ansatz can't describe is measured by finite elements on a mesh
of the material, made from the mask. Every value has a standard deviation.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import modeharvest as mh
from modeharvest.idic.finite_element.measure import measure_displacement
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.runs.case import shipped_solution

PIXEL = 0.04  # mm
solution = mh.Solution.read(shipped_solution("paper-virtual"))
speckle = SpeckleSpec(standard_deviation=0.08, blur_px=2.0)
spec = mh.ImagingSpec(pixel_size=PIXEL, speckle=speckle)
images = mh.make_images(solution, spec, tempfile.mkdtemp(), [0.128])
pair = images.pair(0.128, camera=True)
result = mh.correlate(pair, mh.Ansatz.square(solution.specimen))

whole = measure_displacement(pair, result)
error = (whole.displacement_on() - pair.truth.displacement) / PIXEL
print(f"{whole.unknowns} unknowns; rms error {np.sqrt(np.nanmean(error[pair.mask] ** 2)):.3f} px")

# %%
# The measured microfluctuation field w, the true error, and the predicted standard deviation.

w = np.linalg.norm(whole.displacement_on() - result.displacement(), axis=-1) / PIXEL
panels = {
    "measured − IDIC [px]": (w, 2.0),
    "error [px]": (np.linalg.norm(error, axis=-1), 0.2),
    "predicted sd [px]": (np.linalg.norm(whole.standard_deviation_on(), axis=-1) / PIXEL, 0.2),
}
fig, axes = plt.subplots(1, 3, figsize=(11, 4.8), layout="constrained")
for ax, (name, (values, top)) in zip(axes, panels.items(), strict=True):
    shown = ax.imshow(np.where(pair.mask, values, np.nan), vmin=0, vmax=top, cmap="magma")
    ax.set_title(name)
    ax.set_axis_off()
    fig.colorbar(shown, ax=ax, orientation="horizontal", shrink=0.8)
