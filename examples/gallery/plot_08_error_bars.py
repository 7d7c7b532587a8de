"""
Do the error bars hold?
=======================

One pair of images is measured with twelve samples of camera noise. The scatter of the results is
compared with the standard deviations that each result predicts from its own images.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import modeharvest as mh
from modeharvest.runs.case import shipped_solution

SD = 0.02  # [fraction of full scale]
solution = mh.Solution.read(shipped_solution("paper-virtual"))
images = mh.make_images(solution, mh.ImagingSpec(pixel_size=0.05), tempfile.mkdtemp(), [0.128])
pair, ansatz = images.pair(0.128), mh.Ansatz.square(solution.specimen)
start = mh.correlate(pair, ansatz)

# %%
# The initial guess of each sample is the result without noise.

rng = np.random.default_rng(1)
samples, predicted = [], []
for _ in range(12):
    f, g = (
        image + SD * rng.standard_normal(image.shape) for image in (pair.reference, pair.deformed)
    )
    result = mh.correlate(pair.with_images(f, g), ansatz, guess=start.unknowns)
    samples.append(result.unknowns[: ansatz.size])
    predicted.append(result.standard_errors(SD)[: ansatz.size])

scatter = np.std(samples, axis=0, ddof=1)
sd = np.sqrt(np.mean(np.square(predicted), axis=0))
print(
    f"scatter over predicted standard deviation, median of {ansatz.size} unknowns:",
    f"{np.median(scatter / sd):.2f}",
)
fig, ax = plt.subplots(figsize=(5.4, 5), layout="constrained")
ax.loglog(sd, scatter, "o", alpha=0.6)
ends = [0.5 * sd.min(), 2 * sd.max()]
ax.loglog(ends, ends, "k-", lw=1)
ax.set(
    xlabel="predicted standard deviation",
    ylabel="scatter of 12 samples",
    title="each of the 77 unknowns",
)
