"""What must not change a correlation: frames, units, grey levels, mirrors and turns."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import manufactured
import numpy as np
import pytest
from filling_mode import EVERYWHERE
from hypothesis import given, settings
from hypothesis import strategies as st
from manufactured import PIXEL
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.modes import FourierMode, Taper, square_family
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions, Outcome
from modeharvest.idic.solver.pyramid import Level
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair

FloatArray = NDArray[np.float64]

GRID = PixelGrid.centred(150, 140, PIXEL)
UNIT_CELL, STRAIN, NOISE = 0.6, 0.03, 0.01
MASK = np.pad(np.ones((106, 96), dtype=np.bool_), 22)
TIGHT = CorrelationOptions(
    levels=(Level(2, 3.0), Level(1, 0.0)),
    gauss_newton=GaussNewtonOptions(tolerance_px=1e-7, max_iterations=200),
)
SAME_PX = 1e-5
"""How well two correlations to 1e-7 px agree: float32 images, rounded differently."""

seeds = st.integers(0, 2)
few = settings(max_examples=8)


def square_ansatz(domain: Box, scale: float = 1.0) -> Ansatz:
    """22 unknowns; the mode fills the image."""
    cellular = EVERYWHERE.cellular
    taper = Taper(Box.centred(*(2 * scale * half for half in cellular.half)),
                  scale * EVERYWHERE.width)  # fmt: skip
    mode = FourierMode.scaled(square_family("junction"), scale * UNIT_CELL, taper)
    return Ansatz(domain, (mode,), v0_degree=2, v_degree=1)


ANSATZ = square_ansatz(Box.centred(1.3, 1.4))


@cache
def images(seed: int) -> tuple[FloatArray, FloatArray]:
    """Noisy, so that the minimum is not the truth and the residual does not vanish."""
    rng = np.random.default_rng(seed)
    a = ANSATZ.initial_guess(STRAIN, 1.2)
    a += 0.01 * rng.normal(size=a.size)
    f, g = manufactured.image_pair(manufactured.speckle(seed, GRID), ANSATZ, a, GRID)
    return f + NOISE * rng.normal(size=f.shape), g + NOISE * rng.normal(size=g.shape)


@cache
def expected(seed: int) -> Result:
    found = correlate(
        ImagePair(*images(seed), GRID, MASK),
        ANSATZ,
        guess=ANSATZ.initial_guess(STRAIN, 1.0),
        options=TIGHT,
    )
    assert found.outcome is Outcome.CONVERGED
    return found


def apart_px(u: FloatArray, v: FloatArray) -> float:
    """Rms length of the difference over the mask, for displacements in mm of GRID's pixels."""
    return float(np.sqrt(((u - v)[MASK] ** 2).sum(axis=-1).mean()) / PIXEL)


@few
@given(
    seed=seeds,
    gain=st.floats(-3, 3).map(lambda p: 10.0**p),
    negative=st.booleans(),
    offset=st.floats(-2, 2),
)
def test_grey_levels(seed: int, gain: float, negative: bool, offset: float) -> None:
    """Any unit of grey levels, and the negative: the same displacement, the same error bars."""
    gain = -gain if negative else gain
    f, g = (gain * (image + offset) for image in images(seed))
    found = correlate(
        ImagePair(f, g, GRID, MASK), ANSATZ, guess=ANSATZ.initial_guess(STRAIN, 1.0), options=TIGHT
    )
    assert apart_px(found.displacement(), expected(seed).displacement()) < SAME_PX
    assert found.residual_rms == pytest.approx(abs(gain) * expected(seed).residual_rms, rel=1e-5)
    errors, theirs = found.standard_errors(), expected(seed).standard_errors()
    np.testing.assert_allclose(errors, theirs, rtol=1e-3)
    assert found.residual_correlation == pytest.approx(
        expected(seed).residual_correlation, abs=1e-4
    )


@few
@given(seed=seeds, s=st.floats(-3, 3).map(lambda p: 10.0**p))
def test_pixel_size(seed: int, s: float) -> None:
    """Metres or micrometres: what is a length scales, what is a number stays."""
    ansatz = square_ansatz(Box.centred(1.3 * s, 1.4 * s), s)
    grid = PixelGrid.centred(*GRID.shape, s * PIXEL)
    found = correlate(
        ImagePair(*images(seed), grid, MASK),
        ansatz,
        guess=ansatz.initial_guess(STRAIN, s),
        options=TIGHT,
    )
    assert apart_px(found.displacement() / s, expected(seed).displacement()) < SAME_PX
    assert found.condition_number == pytest.approx(expected(seed).condition_number, rel=1e-2)
    in_mm = np.array([unit == "mm" for unit in ansatz.units])
    np.testing.assert_allclose(
        found.standard_errors(),
        np.where(in_mm, s, 1.0) * expected(seed).standard_errors(),
        rtol=1e-3,
    )


@few
@given(seed=seeds, dx=st.floats(-3, 3), dy=st.floats(-3, 3))
def test_translation_of_the_frame(seed: int, dx: float, dy: float) -> None:
    """The origin may be anywhere: the mode's phases take it up."""
    b, c = ANSATZ.domain, EVERYWHERE.cellular
    taper = Taper(Box(c.x_min + dx, c.x_max + dx, c.y_min + dy, c.y_max + dy), EVERYWHERE.width)
    mode = FourierMode.scaled(square_family("junction").moved((dx, dy)), UNIT_CELL, taper)
    domain = Box(b.x_min + dx, b.x_max + dx, b.y_min + dy, b.y_max + dy)
    moved = replace(ANSATZ, domain=domain, modes=(mode,))
    grid = replace(GRID, x0=GRID.x0 + dx, y0=GRID.y0 + dy)
    found = correlate(
        ImagePair(*images(seed), grid, MASK),
        moved,
        guess=moved.initial_guess(STRAIN, 1.0),
        options=TIGHT,
    )
    assert apart_px(found.displacement(), expected(seed).displacement()) < SAME_PX


@few
@given(seed=seeds, down=st.integers(-4, 4), right=st.integers(-4, 4))
def test_translation_of_both_images(seed: int, down: int, right: int) -> None:
    """The same pixels seen through a window that moved: nothing has to be known of that."""
    window = slice(6 + down, -6 + down), slice(6 + right, -6 + right)
    f, g = (image[window] for image in images(seed))
    grid = PixelGrid(*f.shape, PIXEL, GRID.x[6 + right], GRID.y[6 + down])
    fine = replace(TIGHT, levels=(Level(1, 0.0),))  # bins would hold other pixels
    start = expected(seed).unknowns + 1e-3
    found = correlate(ImagePair(f, g, grid, MASK[window]), ANSATZ, guess=start, options=fine)
    # Pixels land 8 px or more from the window's border, which the spline feels by 0.43 a pixel.
    inner = correlate(ImagePair(*images(seed), GRID, MASK), ANSATZ, guess=start, options=fine)
    assert found.pixels == inner.pixels
    assert apart_px(found.displacement(GRID), inner.displacement()) < 1e-4


@few
@given(seed=seeds, down=st.integers(-4, 4), right=st.integers(-4, 4))
def test_translation_of_the_deformed_image(seed: int, down: int, right: int) -> None:
    """Whole pixels are added to the displacement, and to nothing else."""
    f, g = images(seed)
    moved = np.roll(g, (down, right), axis=(0, 1))
    start = ANSATZ.initial_guess(STRAIN, 1.0)
    for c, by in enumerate((right, -down)):
        start[ANSATZ.v0_slice(c)][0] += by * PIXEL
    found = correlate(ImagePair(f, moved, GRID, MASK), ANSATZ, guess=start, options=TIGHT)
    by_mm = PIXEL * np.array([right, -down])
    # The seam is at least 10 px from where pixels land: 0.43^10 of a grey level.
    assert apart_px(found.displacement() - by_mm, expected(seed).displacement()) < 1e-4


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("seed", range(2))
def test_turns_and_mirrors(seed: int, quarters: int, mirrored: bool) -> None:
    """All eight symmetries of the square; the transpose is one of them."""

    def turned(image: NDArray[np.generic]) -> NDArray[np.generic]:
        image = np.rot90(image, quarters)
        return image[:, ::-1] if mirrored else image

    c, s = round(np.cos(np.pi / 2 * quarters)), round(np.sin(np.pi / 2 * quarters))
    Q = np.array([[c, -s], [s, c]])
    Q = np.diag([-1, 1]) @ Q if mirrored else Q
    b = ANSATZ.domain
    half = abs(Q) @ np.array([b.x_max, b.y_max])
    ansatz = square_ansatz(Box.centred(*(2 * half)))
    grid = PixelGrid.centred(*(GRID.shape if quarters % 2 == 0 else GRID.shape[::-1]), PIXEL)
    # Mirrored, the pattern is its own negative.
    start = ansatz.initial_guess(0.0, -1.0 if mirrored else 1.0)
    along = int(abs(Q[1, 0]))  # now compressed along this axis: T_1 of x is third, of y second
    start[ansatz.v0_slice(along)] = _compression(ansatz, along)
    f, g = (turned(image) for image in images(seed))
    found = correlate(ImagePair(f, g, grid, turned(MASK)), ansatz, guess=start, options=TIGHT)
    assert found.outcome is Outcome.CONVERGED
    u = found.displacement() @ Q  # Q' u, in the old frame's components
    u = u[:, ::-1] if mirrored else u
    back = np.rot90(u, -quarters)
    assert apart_px(back, expected(seed).displacement()) < SAME_PX
    assert found.residual_rms == pytest.approx(expected(seed).residual_rms, rel=1e-6)


def _compression(ansatz: Ansatz, along: int) -> FloatArray:
    """Coefficients of -strain times x or y."""
    x, y = (np.linspace(-h, h, 7) for h in ansatz.domain.half)
    X, Y = np.meshgrid(x, y)
    basis = ansatz.v0_space.basis(X.ravel()[:, None], Y.ravel()[:, None])[:, 0]
    wanted = -STRAIN * (X, Y)[along].ravel()
    return np.linalg.lstsq(basis, wanted, rcond=None)[0]
