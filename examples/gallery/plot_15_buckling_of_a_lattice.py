"""
What makes an infinite lattice buckle first
===========================================

A lattice buckles in the Bloch wave whose energy vanishes first. The critical strain and the mode
are computed here. This example needs dolfinx.
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
print(f"at {100 * critical.load:.2f} %, phases over π:", np.divide(critical.waves, np.pi).round(3))

# %%
# The mode, enlarged, on the smallest cell that has its period, 2 x 2 holes. Colours: its length.

modes = real_modes(cell, critical.state, critical.waves)
count = len(modes.waves)
fig, axes = plt.subplots(1, count, figsize=(5.4 * count, 4.4), squeeze=False, layout="constrained")
corners = modes.mesh.cells[:, :3]
for ax, shape, wave in zip(axes[0], modes.shapes, modes.waves, strict=True):
    moved = modes.mesh.nodes + 0.25 * shape / np.abs(shape).max()
    size = np.linalg.norm(shape, axis=1)
    ax.triplot(*moved.T, corners, lw=0.6, color="0.3")
    shown = ax.tripcolor(*moved.T, corners, size / size.max(), shading="gouraud", alpha=0.9)
    phases = ", ".join(f"{phase / np.pi:.3g} π" for phase in wave)
    ax.set(aspect="equal", title=f"phases (k·a₁, k·a₂) = ({phases})")
    ax.set_axis_off()
    fig.colorbar(shown, label="‖φ‖ over its largest value [-]")
