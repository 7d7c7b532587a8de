"""Options of imaging a specimen: resolution, framing, grey levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modeharvest.fem.field import Solution
from modeharvest.imaging.distortion.files import AnyDistortion, read_distortion
from modeharvest.imaging.distortion.lens import CameraDistortion, without_affine
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.machine import require_memory

_FEWEST_PX = 8
_BYTES_PER_PIXEL = 250.0
"""Memory for making images with their truth [bytes/px]; measured: 215 for 1 to 3.6 Mpx."""


@dataclass(frozen=True)
class ImagingSpec:
    """How a specimen is imaged; InputError if a value is out of range."""

    pixel_size: float = 0.01
    """Edge of a pixel [mm/px]."""
    margin_px: int = 40
    """Width of background around the specimen in all states [px]; determines the image size."""
    shape: tuple[int, int] | None = None
    """(rows, cols) of the images [px], instead of the size that follows from the margin."""
    background: float = 0.0
    """Intensity where there is no material [fraction of full scale]."""
    bits: int = 8
    """Bit depth of the camera images, 1 to 16."""
    speckle: SpeckleSpec = field(default_factory=SpeckleSpec)
    """The speckle pattern."""
    sensor: Sensor = field(default_factory=Sensor)
    """Aperture and noise of the pixels; by default pixels sample points without noise."""
    distortion: CameraDistortion | str | None = None
    """Distortion of the lens: a camera model, or the name of a file; None: perfect lens. With a
    distortion, pixels must sample points. Images and masks are then distorted; the truth is on the
    ideal grid, which is the grid of the undistorted images."""
    affine_distortion: bool = True
    """False removes the affine part of the distortion
    (``distortion.lens.without_affine``): it is equivalent to another pixel
    size, unobservable in images of a target whose shifts are unknown."""

    def __post_init__(self) -> None:
        require_within("imaging: expected a pixel size [mm]", self.pixel_size, 0.0, above=True)
        require_within("imaging: expected a margin [px]", self.margin_px, 0)
        require_within("imaging: expected a background", self.background, 0.0, 1.0)
        require_within("imaging: expected bits", self.bits, 1, 16)
        if self.shape is not None:
            if min(self.shape) < _FEWEST_PX:
                raise InputError(f"imaging: expected a shape of 8 x 8 px or more, got {self.shape}")
            object.__setattr__(self, "shape", (int(self.shape[0]), int(self.shape[1])))
        is_plain = self.speckle.ink is None and self.distortion is None
        if not is_plain and not self.sensor.aperture.is_point:
            raise InputError(
                "imaging: expected pixels that show points (fill_factor = 0, psf_px = 0) with a "
                "distortion or a second layer of speckle, got pixels that average"
            )

    def lens(self, shape: tuple[int, int]) -> AnyDistortion | None:
        """The distortion of images of (rows, cols) px; InputError if its file can't be read."""
        given = self.distortion
        lens: AnyDistortion | None = read_distortion(given) if isinstance(given, str) else given
        return lens if lens is None or self.affine_distortion else without_affine(lens, shape)


def choose_grid(solution: Solution, strains: Sequence[float], spec: ImagingSpec) -> PixelGrid:
    """The grid, centred on the undeformed specimen, that contains the specimen in all states.

    InputError if the specimen doesn't fit into the image size of ``spec.shape``.
    """
    nodes = solution.mesh.nodes
    centre = 0.5 * (nodes.min(axis=0) + nodes.max(axis=0))
    states = [nodes, *(nodes + solution.at(s).displacement for s in strains)]
    reach = np.max([np.abs(state - centre).max(axis=0) for state in states], axis=0)
    if 2.0 * reach.min() < _FEWEST_PX * spec.pixel_size:
        raise InputError(
            f"imaging: expected at least {_FEWEST_PX} px across the specimen, got pixels of "
            f"{spec.pixel_size} mm on {2.0 * reach[0]:.4g} x {2.0 * reach[1]:.4g} mm; make "
            "pixel_size smaller"
        )
    with np.errstate(over="ignore"):
        wide = np.ceil(reach / spec.pixel_size - 1e-9) + spec.margin_px
        size = 2.0 * wide + 1.0 if spec.shape is None else np.array(spec.shape, np.float64)
        count = float(np.prod(size))
    what = f"images of {1e-6 * count:.3g} Mpx"
    require_memory(_BYTES_PER_PIXEL * count, what, "enlarge pixel_size")
    cols, rows = (2 * int(n) + 1 for n in wide)
    if spec.shape is not None:
        least, (rows, cols) = (rows - 2 * spec.margin_px, cols - 2 * spec.margin_px), spec.shape
        if rows < least[0] or cols < least[1]:
            raise InputError(
                f"imaging: expected an image of at least {least[0]} x {least[1]} px to hold the "
                f"specimen in all its states, got {rows} x {cols}; enlarge shape or pixel_size"
            )
    middle = PixelGrid.centred(rows, cols, spec.pixel_size)
    return replace(middle, x0=float(centre[0]) + middle.x0, y0=float(centre[1]) + middle.y0)
