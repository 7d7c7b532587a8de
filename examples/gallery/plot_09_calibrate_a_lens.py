"""
Calibrate a lens with a shifted target
======================================

Five photographs of a speckle target, shifted by a stage by unknown amounts, determine the
distortion of the lens with an error of a hundredth of a pixel or less.
"""

import matplotlib.pyplot as plt
import numpy as np

from modeharvest.imaging.distortion.calibrate import CalibrationOptions, calibrate
from modeharvest.imaging.distortion.lens import CameraDistortion, without_affine
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

shape = (160, 200)
lens = CameraDistortion(fx=250.0, fy=250.0, cx=99.5, cy=79.5, k1=-0.06)
target = Speckle(SpeckleSpec(standard_deviation=0.08, blur_px=1.5), (320, 400))
row, col = np.mgrid[: shape[0], : shape[1]].astype(float)
ideal_row, ideal_col = lens.ideal(row, col)  # positions without distortion
shifts = [(0, 0), (22, 3), (-20, 5), (4, 24), (-5, -23)]
photographs = [target.exact(ideal_row + 80 - r, ideal_col + 100 - c) for r, c in shifts]

found = calibrate(photographs, options=CalibrationOptions(degrees=(2, 3, 4)))
print("degree", found.distortion.degree, "shifts found", np.round(found.shifts, 2).tolist())

# %%
# Barrel distortion moves image points towards the centre. With unknown shifts, scale and skew
# can't be determined; they are removed from both fields. Arrows: the measured distortion.

at = np.mgrid[10:150:14, 10:190:14].astype(float)
true = np.stack(without_affine(lens, shape).shift(*at))
measured = np.stack(without_affine(found.distortion, shape).shift(*at))
off = true - measured
print(
    f"largest distortion {np.abs(true).max():.2f} px, rms error {np.sqrt(np.mean(off**2)):.4f} px"
)
fig, ax = plt.subplots(figsize=(7, 5.2), layout="constrained")
ax.imshow(photographs[0], cmap="gray", alpha=0.5)
ax.quiver(at[1], at[0], measured[1], -measured[0], color="tab:red", scale=6)
ax.set(title="distortion found", xlabel="column", ylabel="row")
