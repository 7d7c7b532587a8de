"""An analytic motion of a buckled specimen with a small wave added, exactly imaged.

The base motion is a homogeneous strain and one pattern of uniform amplitude, which an ansatz of
any degree describes exactly. The question is how much of the wave an ansatz captures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions, SquareLatticeOptions
from modeharvest.idic.solver.pyramid import Level
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json
from modeharvest.util.typed import made, to_plain
from modeharvest.validation.workers import leave

_SPACING = 0.2
"""Spacing of the points at which fields are compared [mm]."""
_SPARSE = 2
_MARGIN = 0.03
"""Width of background around the specimen, relative to its larger side."""
LARGEST = 0.04
"""max ||phi1|| of the paper's mode [-]."""
_COARSE_STEPS, _NEWTON_STEPS, _STEPS = 20, 3, 50
_AROUND_PX = 4
"""Upper bound of the displacement by a wave [px]."""
_ENOUGH_PX = 1e-6
"""Residual of the inversion [px]: a thousandth of the error of a correlation without noise."""


@dataclass(frozen=True)
class ResolutionSpec:
    """Motions, degrees and noise that a resolution study measures."""

    buckled: BuckledMotion
    measured: tuple[int, ...]
    """Degrees of v0 and v1 with which images are measured."""
    amplitude_px: float
    """Amplitude of a wave [px]."""
    noise: float
    """Standard deviation of the noise in each image [fraction of full scale]."""

    def write(self, folder: Path) -> str:
        """Write the specification for workers; return its name."""
        return leave(to_plain(self), folder, "pairs/{}.json")

    @classmethod
    @lru_cache(maxsize=1)
    def read(cls, folder: Path, name: str) -> ResolutionSpec:
        """Read what :meth:`write` wrote; a worker keeps it, and its images, between cases."""
        return made(ResolutionSpec, read_json(folder / "pairs" / f"{name}.json"))

    @property
    def points(self) -> FloatArray:
        """(m, 2) points of the material at which fields are compared [mm]."""
        x, y = (
            np.arange(-half + 0.5 * _SPACING, half, _SPACING)
            for half in self.buckled.specimen.half_size
        )
        grid = np.stack(np.meshgrid(x, y), axis=-1)
        return np.asarray(grid[self.buckled.material(grid[..., 0], grid[..., 1])])

    @property
    def sparse(self) -> tuple[FloatArray, NDArray[np.bool_]]:
        """(k, 2) a subset of ``points``, and (k,) True for those in the cellular part."""
        some = self.points[::_SPARSE]
        a, b = self.buckled.specimen.cellular_half_size
        return some, (np.abs(some[:, 0]) <= a) & (np.abs(some[:, 1]) <= b)

    def correlate(self, pair: ImagePair, degree: int, motion: str) -> Result:
        """Correlate a pair at full resolution only, from the motion without wave.

        ``motion``: "buckled", or "still" for no motion, with a fixed mode.
        """
        how, is_still = self.buckled.how, motion == "still"
        ansatz = self.buckled.ansatz(degree, degree, fixed_mode=is_still)
        guess = np.zeros(ansatz.size) if is_still else self.buckled.start(degree, degree)
        options = CorrelationOptions((Level(1, 0.0),), how.edge_px, how.order)
        return correlate(pair, ansatz, guess=guess, options=options)


@dataclass(frozen=True)
class AddedWave:
    """A small wave of v0 or of v1."""

    part: str
    """Either "v0", a displacement along ``axis``, or "v1", a change of the pattern's amplitude."""
    axis: int
    """0 if the wave varies along x, 1 if along y."""
    period: float
    """Period of the wave [mm]."""
    phase: float
    """Phase at x = y = 0 [rad]."""
    amplitude: float
    """Amplitude of the displacement; for "v1" where the pattern is largest [mm]."""

    def __post_init__(self) -> None:
        if self.part not in ("v0", "v1") or self.axis not in (0, 1) or not self.period > 0.0:
            wanted = "a wave of 'v0' or 'v1' along axis 0 or 1 with a period above 0"
            raise InputError(f"expected {wanted}, got {self.part!r}, {self.axis} and {self.period}")

    def shape(self, points: FloatArray) -> FloatArray:
        """(...) the wave with amplitude 1 at points (..., 2) [mm] [-]."""
        return np.asarray(np.cos(2.0 * np.pi / self.period * points[..., self.axis] + self.phase))


@dataclass(frozen=True, eq=False)
class InverseMotion:
    """Reference points of the pixels of a deformed image."""

    near: BoolArray
    """(rows, cols) True for the n pixels that show material or are close to it."""
    at: FloatArray
    points: FloatArray
    """(n, 2) positions x of these pixels, and X with X + u(X) = x [mm]."""
    slope: FloatArray
    """(n, 2, 2) approximate dX/dx [-]."""


@dataclass(frozen=True)
class BuckledMotion:
    """The base motion of a specimen, its imaging and its correlation."""

    specimen: Specimen
    how: SquareLatticeOptions
    """Options of the correlation; their degrees are varied."""
    speckle: SpeckleSpec
    pixel_size: float
    """Edge of a pixel [mm]."""
    strain: float
    """Nominal compression along x [-]."""
    pattern: float
    """Uniform v1 [mm]."""

    @cached_property
    def grid(self) -> PixelGrid:
        """Pixel grid that contains the specimen in all its states."""
        half = np.array(self.specimen.half_size)
        reach = half + _MARGIN * half.max()
        cols, rows = (2 * int(np.ceil(r / self.pixel_size)) + 1 for r in reach)
        return PixelGrid.centred(rows, cols, self.pixel_size)

    @cached_property
    def truth(self) -> tuple[Ansatz, FloatArray]:
        """The ansatz of least degree that describes the base motion, and its unknowns."""
        return self.ansatz(1, 0), self.start(1, 0)

    def ansatz(self, v0_degree: int, v_degree: int, fixed_mode: bool = False) -> Ansatz:
        """The paper's ansatz with these degrees; ``fixed_mode``: for motion without a pattern."""
        options = replace(self.how, v0_degree=v0_degree, v_degree=v_degree, fixed_mode=fixed_mode)
        return options.ansatz(self.specimen)

    def start(self, v0_degree: int, v_degree: int) -> FloatArray:
        """(n,) unknowns of an ansatz of these degrees that describe the base motion."""
        return self.ansatz(v0_degree, v_degree).initial_guess(self.strain, self.pattern)

    def material(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Whether points of the undeformed specimen are on material; x, y [mm] broadcast."""
        s = self.specimen
        x, y = np.broadcast_arrays(x, y)
        hole = s.nearest_hole(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(x.shape)
        dx, dy = x - s.hole_centres[hole, 0], (y - s.hole_centres[hole, 1]) / s.aspect
        width, height = s.half_size
        inside = (np.abs(x) <= width) & (np.abs(y) <= height)
        return np.asarray(inside & (np.hypot(dx, dy) > 0.5 * s.diameters[hole]))

    def wave_at(self, wave: AddedWave, points: FloatArray) -> FloatArray:
        """(..., 2) displacement of a wave at points (..., 2) [mm]."""
        size = wave.amplitude * wave.shape(points)[..., None]
        if wave.part == "v0":
            return np.asarray(size * np.eye(2)[wave.axis])
        return np.asarray(size / LARGEST * self.pattern_at(points))

    def pattern_at(self, points: FloatArray) -> FloatArray:
        """(..., 2) phi1 at points (..., 2) [-]."""
        ansatz, a = self.truth
        return ansatz.phi(0, a, points[..., None, 0], points[..., None, 1])[..., 0, :]

    def displacement(self, points: FloatArray, wave: AddedWave | None = None) -> FloatArray:
        """(..., 2) displacement of base motion and wave at points (..., 2) [mm]."""
        height = np.full(points.shape[:-1], self.pattern)
        if wave is not None and wave.part == "v1":
            height += wave.amplitude / LARGEST * wave.shape(points)
        u = height[..., None] * self.pattern_at(points)
        u[..., 0] -= self.strain * points[..., 0]
        if wave is not None and wave.part == "v0":
            u[..., wave.axis] += wave.amplitude * wave.shape(points)
        return np.asarray(u)

    def images(self, wave: AddedWave | None = None) -> ImagePair:
        """Exact images of the reference and the deformed state."""
        still, base, grid = self.still(), self._base, self.grid
        point = base.points if wave is None else self._improved(base, wave)
        inside = self.material(point[:, 0], point[:, 1])
        deformed_mask = base.near.copy()
        deformed_mask[base.near] = inside
        g = np.zeros(grid.shape, dtype=np.float32)
        g[deformed_mask] = Speckle(self.speckle, grid.shape)(*grid.to_px(*point[inside].T))
        return ImagePair(still.reference, g, grid, still.masks[0], deformed_mask)

    def still(self) -> ImagePair:
        """A pair without motion: the reference image twice."""
        mask = self.material(self.grid.x[None, :], self.grid.y[:, None])
        image = Speckle(self.speckle, self.grid.shape).image()
        f = np.where(mask, image, 0.0).astype(np.float32)
        return ImagePair(f, f, self.grid, mask, mask)

    @cached_property
    def _base(self) -> InverseMotion:
        """Inverse of the base motion, by fixed-point iteration and Newton's method."""
        at = np.stack(np.meshgrid(self.grid.x, self.grid.y), axis=-1)
        point = at
        for _ in range(_COARSE_STEPS):  # each reduces the error by the factor of the largest strain
            point = at - self.displacement(point)
        material = self.material(point[..., 0], point[..., 1])
        near = ndimage.binary_dilation(material, iterations=_AROUND_PX)
        at, point = at[near], point[near]
        h = 1e-5 * self.pixel_size
        for _ in range(_NEWTON_STEPS):  # dx/dX by forward differences
            u = self.displacement(point)
            ahead = [(self.displacement(point + h * e) - u) / h for e in np.eye(2)]
            gradient = np.eye(2) + np.stack(ahead, axis=-1)
            slope = np.asarray(np.linalg.inv(gradient), dtype=np.float64)
            point = point - (slope @ (point + u - at)[..., None])[..., 0]
        found = InverseMotion(near, at, point, slope)
        return replace(found, points=self._improved(found, None))

    def _improved(self, base: InverseMotion, wave: AddedWave | None) -> FloatArray:
        """(n, 2) X of base motion and wave, by modified Newton steps with ``base.slope`` [mm]."""
        point = base.points
        for _ in range(_STEPS):
            error = point + self.displacement(point, wave) - base.at
            if np.abs(error).max() < _ENOUGH_PX * self.pixel_size:
                return point
            point = point - (base.slope @ error[..., None])[..., 0]
        raise InputError(
            "study: expected a motion that can be inverted, got one that folds the specimen; take "
            "a smaller strain, pattern or wave"
        )
