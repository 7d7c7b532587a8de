"""
What makes an infinite lattice buckle first
===========================================

Of all Bloch waves, the first that costs no energy: its critical strain, and its mode. This example
needs dolfinx.
"""

import matplotlib.pyplot as plt
import numpy as np

from modeharvest.fem.bloch.critical import first_critical
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import square
from modeharvest.fem.lattice.options import equibiaxial
from modeharvest.fem.materials import TwoTermI1

cell = PeriodicCell(square(pitch=1.9, diameter=1.65, size=0.2), TwoTermI1())
critical = first_critical(CellPath(cell, equibiaxial()))
print(critical.outcome)
print(f"at {100 * critical.load:.2f} %, waves (phases over π)", np.round(critical.waves, 3) / np.pi)

# %%
# The mode on the smallest cell that repeats it, 2 x 2 holes.

modes = real_modes(cell, critical.state, critical.waves)
fig, axes = plt.subplots(1, 2, figsize=(9, 4.4), layout="constrained")
corners = modes.mesh.cells[:, :3]
for ax, shape, wave in zip(axes, modes.shapes, modes.waves, strict=False):
    moved = modes.mesh.nodes + 0.25 * shape / np.abs(shape).max()
    ax.triplot(*moved.T, corners, lw=0.6, color="0.3")
    ax.tripcolor(*moved.T, corners, np.linalg.norm(shape, axis=1), shading="gouraud", alpha=0.9)
    ax.set(aspect="equal", title=f"phases {np.round(np.divide(wave, np.pi), 2)} π")
    ax.set_axis_off()
for ax in axes[len(modes.waves) :]:
    ax.remove()
