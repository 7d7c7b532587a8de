"""Pairs of images to correlate, with their true displacement.

The mode's parameters can be fixed, because pyxel's basis is linear and they are given to it.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from meshes import STRAIN
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh, Solution
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import FourierMode, Taper, square_family
from modeharvest.idic.solver.pyramid import eroded
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.pair import ImagePair as CheckedPair
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.runs.case import Case, shipped_solution

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

PIXEL = 0.01
EDGE_PX = 40
"""Pixels along the image's border that don't count, so that none leaves the deformed image."""


@dataclass(frozen=True, eq=False)
class ImagePair:
    """Two images with masks, ansatz, initial guess and truth.

    Parameters
    ----------
    grid
        The pixels of both.
    reference, deformed
        (rows, cols) grey levels, 0 to 255.
    mask, deformed_mask
        (rows, cols) where there is material; None for everywhere in the deformed image.
    ansatz, start
        Ansatz with free mode parameters, and (size,) the standard start.
    truth
        (rows, cols, 2) displacement at the reference's pixels [mm].
    mesh
        Of the specimen, if there is one.
    """

    grid: PixelGrid
    reference: NDArray[Any]
    deformed: NDArray[Any]
    mask: BoolArray
    deformed_mask: BoolArray | None
    ansatz: Ansatz
    start: FloatArray
    truth: FloatArray
    mesh: Mesh | None = None

    def error_px(self, displacement: FloatArray, other: FloatArray | None = None) -> float:
        """Rms length of a displacement's difference from the truth, or from another [px]."""
        apart = (displacement - (self.truth if other is None else other))[self.mask]
        return float(np.sqrt((apart**2).sum(axis=-1).mean()) / self.grid.pixel_size)

    def pixels(self, displacement: FloatArray, edge_px: int) -> BoolArray:
        """Pixels (rows, cols) off edges by ``edge_px`` in both images, for a displacement [mm].

        modeharvest ends with the same set; it is made beforehand for a program without masks.
        """
        inside = eroded(self.mask, edge_px).copy()
        if self.deformed_mask is None:
            return inside
        allowed = eroded(self.deformed_mask, max(0, edge_px - 1))
        row, col = np.nonzero(inside)
        u = displacement[row, col] / self.grid.pixel_size
        to = np.rint(row - u[:, 1]).astype(int), np.rint(col + u[:, 0]).astype(int)
        inside[row, col] = allowed[to]
        return inside

    @property
    def images(self) -> CheckedPair:
        """The pair in modeharvest's own class."""
        return CheckedPair(self.reference, self.deformed, self.grid, self.mask, self.deformed_mask)

    def fixed(self) -> tuple[Ansatz, FloatArray]:
        """Ansatz and start with the mode's parameters fixed at the start."""
        (mode,), n = self.ansatz.modes, self.ansatz.phi_offset(0)
        family = replace(mode.family, start=self.start[self.ansatz.phi_slice(0)]).fixed()
        return replace(self.ansatz, modes=(replace(mode, family=family),)), self.start[:n]


def inside_the_ansatz(shape: tuple[int, int], seed: int) -> ImagePair:
    """8-bit images of a displacement that the ansatz can describe exactly, pattern everywhere.

    The start has the applied strain of 5 %, as in the paper, and a mode of amplitude 1 mm; the true
    amplitude is about 2.5 mm (10 px), and v0 is changed by about 1 px per unknown.
    """
    grid = PixelGrid.centred(*shape, PIXEL)
    box = Box(grid.x[0], grid.x[-1], grid.y[-1], grid.y[0])
    everywhere = Taper(Box(*(4.0 * np.array([box.x_min, box.x_max, box.y_min, box.y_max]))), 1.0)
    mode = FourierMode.scaled(square_family("junction"), 1.9, everywhere)
    ansatz = Ansatz(box, (mode,))
    start = ansatz.initial_guess(0.05, 1.0)
    rng = np.random.default_rng(seed)
    a = start.copy()
    for c in (0, 1):
        a[ansatz.v0_slice(c)] += 0.01 * rng.normal(size=ansatz.v0_space.size)
    v = a[ansatz.v_slice(0)]  # a view
    v += np.append(1.5, 0.1 * rng.normal(size=v.size - 1))
    speckle = Speckle(SpeckleSpec(seed=seed), grid.shape)
    point = _came_from(ansatz, a, grid)
    images = speckle.image(), speckle(*grid.to_px(point[..., 0], point[..., 1]))
    f, g = (np.clip(np.rint(255.0 * image), 0, 255).astype(np.uint8) for image in images)
    mask = np.zeros(grid.shape, dtype=np.bool_)
    mask[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX] = True
    return ImagePair(grid, f, g, mask, None, ansatz, start, ansatz.displacement(a, grid.x, grid.y))


def _came_from(ansatz: Ansatz, a: FloatArray, grid: PixelGrid) -> FloatArray:
    """(rows, cols, 2): X with X + u(X) = x at the pixels x, by fixed-point iteration [mm]."""
    at = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)
    low, high = at[-1, 0], at[0, -1]
    point = at
    for _ in range(200):
        # Polynomials grow fast outside the box; points there aren't correlated.
        moved = at - ansatz.displacement_at(a, np.clip(point, low, high))
        change = abs(moved - point).max()
        point = moved
        if change < 1e-12:
            return point
    raise AssertionError(f"the inverse of the displacement has not converged: {change} mm")


def paper(shape: tuple[int, int] | None, pixel_size: float) -> ImagePair:
    """Make float images of the paper's virtual experiment after buckling, as in its case."""
    case, path = Case(), shipped_solution("paper-virtual")
    solution = Solution.read(path)
    specimen = case.experiment.specimen
    spec = replace(case.imaging, shape=shape, pixel_size=pixel_size)
    ansatz = case.correlation.ansatz(specimen)
    with tempfile.TemporaryDirectory() as folder:
        images = make_images(solution, spec, folder, (STRAIN,))
        return ImagePair(
            images.grid,
            255.0 * images.reference(),
            255.0 * images.deformed(STRAIN),
            images.mask(),
            images.deformed_mask(STRAIN),
            ansatz,
            ansatz.initial_guess(STRAIN, case.correlation.start_amplitude),
            images.truth(STRAIN).displacement,
            solution.mesh,
        )
