"""
How large the errors are, and where they come from
==================================================

With the truth known at every pixel, the error truth − IDIC is split in two parts: the model error,
truth − best fit, which remains in the best possible fit of the ansatz to the truth, and the
measurement error, IDIC − best fit, which the correlation adds.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import modeharvest as mh
from modeharvest.runs.case import shipped_solution

PIXEL = 0.03  # mm
solution = mh.Solution.read(shipped_solution("paper-virtual"))
images = mh.make_images(solution, mh.ImagingSpec(pixel_size=PIXEL), tempfile.mkdtemp(), [0.128])
pair = images.pair(0.128)
result = mh.correlate(pair, mh.Ansatz.square(solution.specimen))
best = mh.best_fit(pair.truth, result)

true, found, possible = pair.truth.displacement, result.displacement(), best.displacement()
parts = {
    "truth − IDIC": true - found,
    "truth − best fit": true - possible,
    "IDIC − best fit": found - possible,
}

# %%
# The numbers are rms values per component.

fig, axes = plt.subplots(1, 3, figsize=(11, 4.6), layout="constrained")
for ax, (name, error) in zip(axes, parts.items(), strict=True):
    rms = np.sqrt(np.mean(error[pair.mask] ** 2)) / PIXEL
    length = np.where(pair.mask, np.linalg.norm(error, axis=-1), np.nan) / PIXEL
    shown = ax.imshow(length, vmin=0, vmax=2, cmap="magma")
    ax.set_title(f"{name}: {rms:.2f} px")
    ax.set_axis_off()
    print(f"{name:22} {rms:.3f} px rms")
fig.colorbar(shown, ax=axes, label="length of the error [px]", shrink=0.8)
