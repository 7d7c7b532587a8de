"""
Speckle images whose displacement is known
==========================================

Images of the paper's specimen before loading, before buckling, and after buckling. The true
displacement of every pixel is known; the last panel shows it for the last image.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import modeharvest as mh
from modeharvest.runs.case import shipped_solution

solution = mh.Solution.read(shipped_solution("paper-virtual"))
spec = mh.ImagingSpec(pixel_size=0.03)  # [mm/px]; 0.01 in the paper
images = mh.make_images(solution, spec, tempfile.mkdtemp())

# %%
# Compression is along x. The pattern of alternating ellipses appears above 9.6 % of strain.

fig, axes = plt.subplots(1, 4, figsize=(12, 4.2), layout="constrained")
axes[0].imshow(images.reference(), cmap="gray")
axes[0].set_title("reference")
for ax, strain in zip(axes[1:3], images.strains, strict=True):
    ax.imshow(images.deformed(strain), cmap="gray")
    ax.set_title(f"{100 * strain:.1f} %")
truth = images.truth(images.strains[-1])
length = np.linalg.norm(truth.displacement, axis=-1) / spec.pixel_size
shown = axes[3].imshow(length)
axes[3].set_title("length of the true u")
fig.colorbar(shown, ax=axes[3], label="px", shrink=0.7)
for ax in axes:
    ax.set_axis_off()
print(f"{images.grid.shape} px, residual of the inverse mapping {images.max_residual_px:.0e} px")
