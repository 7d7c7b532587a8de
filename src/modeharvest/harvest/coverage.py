"""How honest a harvest's error bars are: its twin photographed again and again.

Every seed of the camera's noise gives photographs of the same state, which are freed from
distortion and correlated as the harvest did, from the noise-free photographs' result on. A 95 %
interval of a field, 1.96 standard deviations by noise about what one photograph shows, should
hold the noise-free result in 95 of 100 of them. Material and lens are taken as the harvest
found them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.harvest.experiment import read_experiment
from modeharvest.harvest.pair import Pair
from modeharvest.harvest.pipeline import Harvesting
from modeharvest.harvest.told import covariances, noise_of
from modeharvest.harvest.twin import Twin
from modeharvest.idic.correlate import correlate
from modeharvest.idic.error_bars import FieldErrors, field_errors
from modeharvest.idic.finish import blurred_pair
from modeharvest.idic.result import Result
from modeharvest.imaging.distortion.undistort import undistorted

FloatArray = NDArray[np.float64]
FloatImage = NDArray[np.float32]

INTERVAL = 1.96
"""Standard deviations of a 95 % interval."""
_POINTS = 25
"""Points along each side of the cellular part at which intervals are counted."""


def one_seed(case: Mapping[str, Any], folder: Path) -> dict[str, float]:
    """Photograph and measure once more; the share of intervals that hold the noise-free result.

    Parameters
    ----------
    case
        ``name`` of the deformed photograph and ``seed``.
    folder
        Of a finished twin run (``twin/`` and ``harvest/``).

    Returns
    -------
    dict
        For v0, v1 and v1 phi1 the share of points covered, and the rms of the deviation over its
        standard deviation, which should be 1.
    """
    scene = _scene(folder, case["name"])
    found = scene.measured(scene.photographs(case["seed"]))
    clean, sd = scene.clean, scene.errors
    ansatz, at = found.ansatz, (scene.x, scene.y)
    pairs = {
        "v0": (ansatz.v0(found.unknowns, *at) - ansatz.v0(clean.unknowns, *at), sd.v0),
        "v1": (ansatz.v(0, found.unknowns, *at) - ansatz.v(0, clean.unknowns, *at), sd.v[0]),
        "v1phi1": (
            ansatz.fluctuation(0, found.unknowns, *at) - ansatz.fluctuation(0, clean.unknowns, *at),
            sd.fluctuation[0],
        ),
    }
    told = {}
    for name, (deviation, error) in pairs.items():
        ratio = deviation[error > 0] / error[error > 0]
        told[f"covered {name}"] = float(np.mean(np.abs(ratio) <= INTERVAL))
        told[f"deviation {name}"] = float(np.sqrt(np.mean(ratio**2)))
    return told


@dataclass(frozen=True, eq=False)
class _Scene:
    """All that does not depend on the seed: what a worker keeps."""

    twin: Twin
    harvesting: Harvesting
    pair: Pair
    name: str
    blur_px: float
    start: Result
    clean: Result
    errors: FieldErrors
    x: FloatArray
    y: FloatArray

    def photographs(self, seed: int | None) -> tuple[FloatImage, FloatImage]:
        """Reference and deformed photograph with the noise of a seed, or none; undistorted."""
        spec, images = self.twin.images.spec, self.twin.images
        strain = min(images.strains, key=lambda e: abs(e - int(self.name.rsplit("_", 1)[1]) / 1e4))
        white = 2**spec.bits - 1
        taken = []
        for grey, label in (
            (images.reference(), "reference"),
            (images.deformed(strain), "deformed"),
        ):
            levels: NDArray[Any] = white * grey
            if seed is not None:
                sensor = replace(spec.sensor, shot_seed=1000 + seed, read_seed=2000 + seed)
                irradiance = ((grey - sensor.offset) / sensor.gain).astype(np.float32)
                levels = sensor.expose(irradiance, spec.bits, label)
            distortion = self.harvesting.optics.distortion
            image = levels.astype(np.float32)
            taken.append(image if distortion is None else undistorted(image, distortion))
        return taken[0], taken[1]

    def measured(self, images: tuple[FloatImage, FloatImage]) -> Result:
        """Correlate as the harvest finished, from the harvest's result on."""
        masks = self.pair.mask, self.pair.deformed_mask
        if self.blur_px > 0.0:
            images = blurred_pair(*images, *masks, self.blur_px)
        options = self.harvesting.experiment.correlation.options()
        fine = replace(options, levels=options.levels[-1:])
        start = self.start
        return correlate(*images, start.grid, start.ansatz, start.unknowns, *masks, fine)


@lru_cache(maxsize=1)
def _scene(folder: Path, name: str) -> _Scene:
    twin = Twin(folder / "twin")
    experiment = read_experiment(twin.experiment)
    harvesting = Harvesting(experiment, twin.experiment.parent, folder / "harvest")
    prepared, measured = harvesting.prepared(), harvesting.results()[name]
    pair = Pair(prepared.image(), prepared.image(name), prepared.mask(), prepared.mask(name))
    box = harvesting.geometry.region.cellular
    x = np.linspace(box.x_min, box.x_max, _POINTS, dtype=np.float64)
    y = np.linspace(box.y_min, box.y_max, _POINTS, dtype=np.float64)
    noise, cell = noise_of(prepared, name), experiment.specimen.cell_size
    by_noise, _, _ = covariances(measured, pair, noise, cell)
    errors = field_errors(measured.result, x, y, by_noise)
    blank = measured.result
    scene = _Scene(
        twin, harvesting, pair, name, measured.blur_px, blank, blank, errors, x, y
    )  # fmt: skip
    return replace(scene, clean=scene.measured(scene.photographs(None)))
