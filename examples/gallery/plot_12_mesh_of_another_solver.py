"""
Images of another solver's mesh
===============================

Images can be made of any plane mesh of T3, T6, Q4, Q8 or Q9 elements with nodal displacements, in a
format that meshio reads (Abaqus, VTU, XDMF, ...). This example is a beam of Q4 elements in bending.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import meshio
import numpy as np

import modeharvest as mh
from modeharvest.fem.field import read_meshio

# %%
# The file that a solver would have written: nodes, cells, and a displacement vector at each node.

x, y = np.meshgrid(np.linspace(-10, 10, 61), np.linspace(-2, 2, 13))
nodes = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
k = np.arange(x.size).reshape(x.shape)
cells = np.stack([k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]], axis=-1).reshape(-1, 4)
curvature = 0.03  # [1/mm]
u = np.column_stack([-curvature * nodes[:, 0] * nodes[:, 1], 0.5 * curvature * nodes[:, 0] ** 2])
beam = Path(tempfile.mkdtemp()) / "beam.vtu"
u = np.column_stack([u, 0 * u[:, 0]])
meshio.Mesh(nodes, {"quad": cells}, point_data={"U": u}).write(beam)

# %%
# The file is read, and images with a known true displacement are made.

solution = read_meshio(beam, displacement="U", nominal_strain=0.1)
images = mh.make_images(solution, mh.ImagingSpec(pixel_size=0.03), beam.parent / "images")
fig, axes = plt.subplots(2, 1, figsize=(9, 5), layout="constrained")
for ax, image, name in zip(
    axes, (images.reference(), images.deformed(0.1)), ("reference", "deformed"), strict=True
):
    ax.imshow(image, cmap="gray")
    ax.set_title(name)
    ax.set_axis_off()
print(f"largest residual of the inverse mapping {images.max_residual_px:.0e} px")
