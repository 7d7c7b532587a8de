"""
What a camera does to an image
==============================

The sensor's options are applied to the same speckle one by one: sensitive area and point spread,
read noise, shot noise, all with 8 bits. Standard deviations are compared with the predicted ones.
"""

import matplotlib.pyplot as plt
import numpy as np

from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

speckle = Speckle(SpeckleSpec(), (120, 120))
cameras = {
    "exact": Sensor(),
    "fill factor 1, psf 1 px": Sensor(fill_factor=1.0, psf_px=1.0),
    "read noise 3 %": Sensor(read_noise=0.03),
    "2000 electrons": Sensor(full_well=2000.0),
}
fig, axes = plt.subplots(1, 4, figsize=(12, 3.4), layout="constrained")
for ax, (name, sensor) in zip(axes, cameras.items(), strict=True):
    light = speckle.image(sensor.aperture.transfer).astype(np.float32)
    grey = sensor.expose(light, 8, name) / 255.0
    variance = np.mean(sensor.noise_variance(light, 8))
    print(f"{name:24} sd predicted {np.sqrt(variance):.4f}, found {np.std(grey - light):.4f}")
    ax.imshow(grey, cmap="gray", vmin=0, vmax=1)
    ax.set_title(name)
    ax.set_axis_off()
