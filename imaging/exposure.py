"""One image of a set: what a lens and a sensor make of it, its files, what is told of it.

The entry of an image in the sidecar of its set, besides the names of its files:

``noise_sd``
    Root mean square over the material of the camera image's predicted noise [fraction of full
    scale].
``saturated_px``, ``doubly_covered_px``
    Material pixels at the highest level, and pixels inside more than one element, where the
    specimen overlaps.
``light``
    If the light flickers: the factor on the irradiance.
``quadrature``
    If the sensor averages: points a pixel and their error's bound.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.imaging.distorted import Positions, render_seen, seen_points
from modeharvest.imaging.integrate import Scene, integrate
from modeharvest.imaging.io import write_image
from modeharvest.imaging.render import Rendering
from modeharvest.imaging.spec import ImagingSpec


@dataclass(frozen=True, eq=False)
class Camera:
    """A lens and a sensor that expose images into a folder.

    Parameters
    ----------
    spec
        The sensor, its bits, the lens.
    points
        What the lens sees at its pixels; None of a perfect one.
    folder
        Where the images go.
    """

    spec: ImagingSpec
    points: Positions | None
    folder: Path

    @classmethod
    def of(cls, spec: ImagingSpec, shape: tuple[int, int], folder: Path) -> Camera:
        """The camera of a specification, for images of (rows, cols) pixels."""
        lens = spec.lens(shape)
        return cls(spec, None if lens is None else seen_points(lens, shape), folder)

    def expose(self, ideal: Rendering, scene: Scene, name: str, mask_name: str) -> dict[str, Any]:
        """Write what the camera makes of an image; return its entry in the sidecar.

        Parameters
        ----------
        ideal
            What a perfect lens shows.
        scene
            What there is to be seen.
        name, mask_name
            Of the image, and of its mask's file. The name also seeds noise and flicker.
        """
        seen = self._through_lens(ideal, scene)
        sensor, bits, mask, irradiance = self.spec.sensor, self.spec.bits, seen.mask, seen.image
        entry: dict[str, Any] = {}
        if not sensor.aperture.is_point:
            averaged, quadrature = integrate(scene, sensor.aperture, mask)
            irradiance = averaged.astype(np.float32)
            entry["quadrature"] = asdict(quadrature)
        if sensor.flicker > 0.0:
            irradiance = np.float32(sensor.light(name)) * irradiance
            entry["light"] = sensor.light(name)
        mean, levels = sensor.mean(irradiance), sensor.expose(irradiance, bits, name)
        camera_name = f"{name}_{bits}bit.tif"
        write_image(self.folder / f"{name}.tif", mean)
        write_image(self.folder / camera_name, levels)
        write_image(self.folder / mask_name, mask)
        variance = sensor.noise_variance(mean[mask], bits)
        return entry | {
            "image": f"{name}.tif",
            "camera_image": camera_name,
            "mask": mask_name,
            "noise_sd": float(np.sqrt(variance.mean())),
            "saturated_px": sensor.saturated(levels[mask], bits),
            "doubly_covered_px": seen.doubly_covered,
        }

    def _through_lens(self, ideal: Rendering, scene: Scene) -> Rendering:
        """What the lens shows."""
        if self.points is None:
            return ideal
        shown = render_seen(
            scene.mesh, scene.displacement, scene.grid, self.points, scene.speckle,
            scene.background, scene.where,
        )  # fmt: skip
        return replace(shown, doubly_covered=ideal.doubly_covered)
