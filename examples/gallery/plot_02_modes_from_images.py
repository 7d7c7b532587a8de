"""
Measure a pattern by micromorphic IDIC
======================================

The displacement is u = v₀ + v₁φ₁: a smooth field, plus a smooth amplitude times a periodic mode.
All 77 unknowns are found together from the grey levels of two images.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import modeharvest as mh
from modeharvest.runs.case import shipped_solution

solution = mh.Solution.read(shipped_solution("paper-virtual"))
images = mh.make_images(solution, mh.ImagingSpec(pixel_size=0.03), tempfile.mkdtemp(), [0.128])
pair = images.pair(0.128)

result = mh.correlate(pair, mh.Ansatz.square(solution.specimen))
print(result.outcome.name, result.iterations, "iterations")
print("mode parameters", np.round(result.mode_parameters(), 4))

# %%
# The three fields that homogenization needs: v₀, v₁ and φ₁. The last panel is the pattern v₁φ₁.

material = np.where(pair.mask, 1.0, np.nan)
fields = {
    "v₀ along x [mm]": result.v0()[..., 0],
    "v₁ [mm]": result.v(),
    "φ₁ along x [-]": result.phi()[..., 0],
    "v₁φ₁ along x [mm]": result.fluctuation()[..., 0],
}
fig, axes = plt.subplots(1, 4, figsize=(12, 4), layout="constrained")
for ax, (name, values) in zip(axes, fields.items(), strict=True):
    shown = ax.imshow(values * material, cmap="RdBu_r" if "φ" in name else "viridis")
    ax.set_title(name)
    ax.set_axis_off()
    fig.colorbar(shown, ax=ax, orientation="horizontal", shrink=0.8)
