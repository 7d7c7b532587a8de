"""Photographs of an exactly known target through an exactly known lens."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.imaging.distortion.lens import Distortion, PolynomialDistortion
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

FloatArray = NDArray[np.float64]


def random_lens(
    shape: tuple[int, int], degree: int, size_px: float, seed: int = 0, affine: float = 0.0
) -> PolynomialDistortion:
    """Make a lens without (``affine`` = 0) or with an affine part, of this largest S [px]."""
    rng = np.random.default_rng(seed)
    i, j = np.array(PolynomialDistortion.orders(degree)).T
    c = rng.uniform(-1, 1, (2, i.size)) / (1 + i**2 + j**2)
    c[:, 0] = 0.0
    c[:, 1:3] *= affine
    row, col = np.linspace(0, shape[0] - 1, 40)[:, None], np.linspace(0, shape[1] - 1, 40)[None]
    largest = np.hypot(*PolynomialDistortion(shape, c).shift(row, col)).max()
    return PolynomialDistortion(shape, c * size_px / largest)


def photographs(
    lens: Distortion,
    shape: tuple[int, int],
    shifts: ArrayLike,
    angles: ArrayLike | None = None,
    noise: float = 0.0,
    seed: int = 0,
) -> list[FloatArray]:
    """Photograph a speckled target moved by shifts (m, 2) [px] and turned by angles (m,) [rad].

    The pixel p of photograph i shows the target's point T_i^-1(phi_S^-1(p)), exactly.
    """
    shifts = np.asarray(shifts, dtype=np.float64)
    margin = int(np.ceil(abs(shifts).max())) + 40
    target = Speckle(SpeckleSpec(seed=seed), (shape[0] + 2 * margin, shape[1] + 2 * margin))
    ideal = lens.ideal(*np.indices(shape, dtype=np.float64))
    centre = 0.5 * (np.array(shape) - 1)
    rng = np.random.default_rng(seed + 1)
    images = []
    turns = np.zeros(len(shifts)) if angles is None else np.asarray(angles)
    for shift, angle in zip(shifts, turns, strict=True):
        row, col = (a - c - s for a, c, s in zip(ideal, centre, shift, strict=True))
        cos, sin = np.cos(angle), np.sin(angle)
        back = cos * row + sin * col + centre[0], cos * col - sin * row + centre[1]
        exact = target(back[0] + margin, back[1] + margin)
        images.append(exact + noise * rng.normal(size=shape))
    return images
