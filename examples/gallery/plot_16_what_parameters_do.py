"""
What identifies a material
==========================

An identification finds parameters by their effect on displacements and force. This example shows
how a buckled specimen of 4 x 4 holes changes if a material constant is one per cent larger, or if
the loaded edge is tilted by 0.1 mrad. It needs dolfinx.
"""

import matplotlib.pyplot as plt
import numpy as np

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.path.parametric import ParametricTest
from modeharvest.fem.specimen import Specimen

specimen = Specimen(holes_x=4, holes_y=4, diameter=1.6, bulk_x=0.9, bulk_y=0.4)
experiment = Experiment(specimen, strains=(0.06, 0.12), mesh_size=0.4)
names = ["moduli[0]", "exponents[0]", "kappa", "tilt"]
test = ParametricTest.meshed(experiment, names)
values = test.own_values
steps = [*0.01 * values[:3], 1e-4]
before, after = test.at(values)
print(f"the specimen buckles at a nominal strain of {test.critical_strain:.4f}")
for name, step, by in zip(names, steps, after.force_by, strict=True):
    print(f"{name:13s} the force by {100 * step * by / after.force:+.2f} %")

# %%
# If the modulus and the other stiffness, κ, increase by the same factor, forces increase by it and
# displacements don't change: without a load cell, only their ratio can be found. The exponent and
# the tilt change the pattern.

corners = after.mesh.cells[:, :3]
fig, axes = plt.subplots(1, 4, figsize=(11, 3.6), layout="constrained")
for ax, name, step, by in zip(axes, names, steps, after.displacement_by, strict=True):
    moved = after.mesh.nodes + after.displacement
    shift = 1000 * step * np.linalg.norm(by, axis=1)
    drawn = ax.tripcolor(*moved.T, corners, shift, shading="gouraud", cmap="viridis")
    fig.colorbar(drawn, ax=ax, orientation="horizontal", label="µm")
    change = "0.1 mrad" if name == "tilt" else "1 %"
    ax.set(aspect="equal", title=f"{name}: {change} more")
    ax.set_axis_off()
