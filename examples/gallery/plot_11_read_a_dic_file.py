"""
Read the field of another DIC code, and its spectrum
====================================================

A table of positions and displacements, as exported by VIC, DICe, DaVis or GOM, is read as a field.
Its spectral density shows the waves of the pattern.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import modeharvest as mh
from modeharvest.idic.local.field import read_field
from modeharvest.idic.spectra.spectrum import measured_spectrum
from modeharvest.runs.case import shipped_solution

folder = Path(tempfile.mkdtemp())
solution = mh.Solution.read(shipped_solution("paper-virtual"))
images = mh.make_images(solution, mh.ImagingSpec(pixel_size=0.03), folder / "images", [0.128])
pair = images.pair(0.128)

# %%
# A file as another code would write it: every fifth pixel along both axes, y down, lengths in px,
# and a negative ``sigma`` where the code has failed.

rows, cols = np.nonzero(pair.mask & (np.indices(pair.mask.shape) % 5 == 0).all(axis=0))
u = pair.truth.displacement[rows, cols] / pair.grid.pixel_size
sigma = np.where(np.random.default_rng(0).random(rows.size) < 0.02, -1.0, 0.01)
table = np.column_stack([cols, rows, u[:, 0], -u[:, 1], sigma])
np.savetxt(folder / "vic.csv", table, "%.6g", ",", header='"x","y","u","v","sigma"', comments="")

field = read_field(folder / "vic.csv", pair.grid, units="px", y_axis="down")
print(f"{field.x.size} points, {field.lost} of them failed, rms {field.rms:.3f} mm")

# %%
# The peaks are at half a wave per cell along both axes: neighbouring holes deform in opposite ways.
# The colours show the four decades below the largest density.

spectrum = measured_spectrum(field, solution.specimen.pitch)
xi1, xi2, density = spectrum.window(1.2)
fig, ax = plt.subplots(figsize=(5.6, 4.6), layout="constrained")
decades = np.log10(density.sum(axis=-1))
shown = ax.pcolormesh(xi1, xi2, decades, vmin=decades.max() - 4)
ax.set(xlabel="ξ₁ [1/l]", ylabel="ξ₂ [1/l]", aspect="equal", title="spectral density of u")
fig.colorbar(shown, label="log₁₀ of mm⁶", extend="min")
