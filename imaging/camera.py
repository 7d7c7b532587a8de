"""Camera model: lens, pixels that average over an aperture, exposure, image files.

Where pixels average over an aperture, the reference image is computed exactly in Fourier space,
except near the edge of the material. A deformed image is a Gauss quadrature over each pixel of the
*deformed* frame. It has as many points as keep the error below :data:`TOLERANCE`; each is located
in the mesh and evaluated exactly. Near an edge, both images average evenly scattered points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from modeharvest.imaging.distortion.lens import Positions, ideal_points
from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.render import ImagedState, Rendering, render_observed
from modeharvest.imaging.sensor import EDGE_POINTS, Aperture
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.util.arrays import BoolArray, FloatArray

TOLERANCE = 1e-7  # rms, of full scale: the largest of millions of pixels' errors is below 1e-6
_MOST_POINTS = 16  # along each axis


@dataclass(frozen=True)
class PixelQuadrature:
    """How the pixels of an image were averaged."""

    points: int
    """Quadrature points in each pixel away from the edges; 0 if the average is exact."""
    rms_bound: float
    """Bound of the quadrature's rms error on the pattern [fraction of full scale]."""
    edge_points: int = EDGE_POINTS
    """Points in each pixel near an edge."""


def integrate(
    state: ImagedState, aperture: Aperture, mask: BoolArray
) -> tuple[FloatArray, PixelQuadrature]:
    """(rows, cols) intensity averaged over apertures, and the rule; ``mask``: True on material."""
    near = near_edges(mask, aperture.reach_px)
    inside = mask & ~near
    image = np.full(mask.shape, state.background)
    if state.displacement is None:
        image[inside] = state.speckle.image(aperture.transfer)[inside]
        quadrature = PixelQuadrature(0, 0.0)
    else:
        side, bound = points_a_side(aperture, state.speckle.spec, state.compression)
        nodes, weights = aperture.rule(side)
        offsets = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
        image[inside] = state.average(offsets, (weights[:, None] * weights).ravel(), inside)
        quadrature = PixelQuadrature(side**2, bound)
    scattered = aperture.scattered()
    image[near] = state.average(scattered, np.full(EDGE_POINTS, 1.0 / EDGE_POINTS), near)
    return image, quadrature


def near_edges(mask: BoolArray, reach_px: int) -> BoolArray:
    """(rows, cols) True if material and background both lie within ``reach_px`` of the pixel."""
    size = 2 * reach_px + 1
    dilated = ndimage.maximum_filter(mask, size, mode="nearest")
    eroded = ndimage.minimum_filter(mask, size, mode="nearest")
    return np.asarray(dilated & ~eroded)


def points_a_side(
    aperture: Aperture, pattern: SpeckleSpec, compression: float = 1.0
) -> tuple[int, float]:
    """Number of points of the Gauss rule along each axis, and the bound of its rms error.

    A plane wave of the pattern appears at up to ``compression`` times its frequency f. The rule
    multiplies it by one factor, the exact average by another. By Parseval's theorem the rms
    error is at most max over f of |difference of the factors| times the blur's transfer function
    at f, times the standard deviation of the pattern before its blur. The rule has the fewest
    points for which this bound is below TOLERANCE, but at most 16.
    """
    f = np.linspace(0.0, 0.5, 257)
    blur = np.exp(-2.0 * (np.pi * pattern.blur_px * f) ** 2)
    exact = aperture.transfer(compression * f)
    contrast = 0.5 * (pattern.bright - pattern.dark)
    bound = np.inf
    for side in range(1, _MOST_POINTS + 1):
        nodes, weights = aperture.rule(side)
        ruled = np.cos(2.0 * np.pi * compression * np.outer(f, nodes)) @ weights
        error = np.outer(ruled, ruled) - np.outer(exact, exact)
        bound = contrast * float(np.abs(error * np.outer(blur, blur)).max())
        if bound <= TOLERANCE:
            break
    return side, bound


@dataclass(frozen=True, kw_only=True)
class ImageRecord:
    """Record of an image in the set's ``images.json``."""

    image: str
    camera_image: str
    mask: str
    """File names of the noise-free image, of the exposed one, and of the mask of material."""
    noise_sd: float
    """Rms of the camera image's predicted noise on the material [fraction of full scale]."""
    saturated_px: int
    """Number of material pixels at the highest grey level."""
    doubly_covered_px: int
    """Number of pixels inside more than one element, where the specimen overlaps itself."""
    light: float | None = None
    """Factor on the irradiance [-]; None without flicker."""
    quadrature: PixelQuadrature | None = None
    """How the pixels were averaged; None if each pixel samples a point."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A lens and a sensor."""

    spec: ImagingSpec
    points: Positions | None
    """Ideal positions (row, col) that the pixels show [px]; None without a lens."""
    folder: Path

    @classmethod
    def of(cls, spec: ImagingSpec, shape: tuple[int, int], folder: Path) -> Camera:
        """The camera of a specification; images of (rows, cols) pixels are written to a folder."""
        lens = spec.lens(shape)
        return cls(spec, None if lens is None else ideal_points(lens, shape), folder)

    def expose(
        self, ideal: Rendering, state: ImagedState, name: str, mask_name: str
    ) -> ImageRecord:
        """Image a state and write the files; ``ideal`` is its rendering by a perfect lens.

        The image's ``name`` also seeds noise and flicker.
        """
        observed = ideal
        if self.points is not None:
            shown = render_observed(state, self.points)
            observed = replace(shown, doubly_covered=ideal.doubly_covered)
        sensor, bits, mask = self.spec.sensor, self.spec.bits, observed.mask
        irradiance, quadrature, light = observed.image, None, None
        if not sensor.aperture.is_point:
            averaged, quadrature = integrate(state, sensor.aperture, mask)
            irradiance = averaged.astype(np.float32)
        if sensor.flicker > 0.0:
            light = sensor.illumination(name)
            irradiance = np.float32(light) * irradiance
        mean, levels = sensor.mean(irradiance), sensor.expose(irradiance, bits, name)
        image, camera_image = f"{name}.tif", f"{name}_{bits}bit.tif"
        for file, pixels in ((image, mean), (camera_image, levels), (mask_name, mask)):
            write_image(self.folder / file, pixels)
        return ImageRecord(
            image=image,
            camera_image=camera_image,
            mask=mask_name,
            noise_sd=float(np.sqrt(sensor.noise_variance(mean[mask], bits).mean())),
            saturated_px=sensor.saturated(levels[mask], bits),
            doubly_covered_px=observed.doubly_covered,
            light=light,
            quadrature=quadrature,
        )
