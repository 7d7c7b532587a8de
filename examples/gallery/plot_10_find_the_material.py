"""
Find material, holes and lattice in a photograph
================================================

Speckled material is separated from the background, and a lattice is fitted to the hole centres.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import modeharvest as mh
from modeharvest.idic.photograph.holes import find_hole_lattice
from modeharvest.idic.photograph.material import find_material
from modeharvest.runs.case import shipped_solution

solution = mh.Solution.read(shipped_solution("paper-virtual"))
spec = mh.ImagingSpec(pixel_size=0.03, background=0.45)  # neither dark nor bright
images = mh.make_images(solution, spec, tempfile.mkdtemp(), [0.078])
exposed = images.reference(camera=True)
photograph = exposed + 0.01 * np.random.default_rng(0).standard_normal(exposed.shape)

found = find_material(photograph)
wrong = np.mean(found.mask != images.mask())
lattice = find_hole_lattice(found.mask)
print(f"{100 * wrong:.2f} % of the pixels are wrong")
print(f"{len(lattice)} holes, {lattice.kind}, {lattice.pitch_px:.1f} px apart")

# %%
# The material in colour, and the centres of the holes that were found.

fig, ax = plt.subplots(figsize=(5.2, 6), layout="constrained")
ax.imshow(photograph, cmap="gray")
ax.imshow(np.where(found.mask, 1.0, np.nan), cmap="autumn", alpha=0.25)
ax.scatter(lattice.centres[:, 1], lattice.centres[:, 0], s=18, color="tab:blue")
ax.set_axis_off()
