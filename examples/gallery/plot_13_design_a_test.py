"""
Which camera does a test need?
==============================

The standard deviation of the amplitude v₁ due to noise, over pixel size and read noise, can be
predicted by the Cramér–Rao bound before a specimen is cut or photographed. No image is made.
"""

import matplotlib.pyplot as plt
import tempfile

from modeharvest.runs.design import DesignCase, DesignRun
from pathlib import Path

run = DesignRun(DesignCase.read("paper-virtual"), Path(tempfile.mkdtemp()))
design = run.design()
expected = design.expected(design.setup)
print(f"as in the paper: v1 within {expected.v1_percent:.4f} %, u within {expected.u_px:.4f} px")
for name in ("pixel_size", "noise"):
    print(f"{name} that 0.02 % of v1 needs:", design.needed(name, "v1_percent"))

pixels, noise, errors = design.mapped(17)
fig, ax = plt.subplots(figsize=(6.4, 4.6), layout="constrained")
lines = ax.contour(1000 * pixels, 100 * noise, errors, [0.005, 0.01, 0.02, 0.05, 0.1, 0.2])
ax.clabel(lines, fmt="%g %%")
ax.set(
    xscale="log",
    yscale="log",
    xlabel="pixel size [µm]",
    ylabel="read noise [% of full scale]",
    title="standard deviation of v₁, of its maximum",
)
