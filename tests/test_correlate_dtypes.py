"""Images as they come: types, byte orders, views, read-only, few pixels, any number of threads."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import manufactured
import numba
import numpy as np
import pytest
from manufactured import PIXEL
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.idic.solver.passes import accumulate, runs_of
from modeharvest.idic.solver.pyramid import Level
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair

FloatArray = NDArray[np.float64]
Array = NDArray[Any]

GRID = PixelGrid.centred(120, 104, PIXEL)
ANSATZ = Ansatz(Box.centred(1.1, 1.2), v0_degree=2)
STRAIN = 0.02


@cache
def images() -> tuple[FloatArray, FloatArray]:
    """Whole grey levels of 0 to 255, as float64."""
    a = ANSATZ.initial_guess(STRAIN)
    a += 0.003 * np.random.default_rng(1).normal(size=a.size)
    f, g = manufactured.image_pair(manufactured.speckle(4, GRID), ANSATZ, a, GRID)
    return np.rint(255 * f), np.rint(255 * g)


@cache
def mask() -> NDArray[np.bool_]:
    inside = np.zeros(GRID.shape, dtype=np.bool_)
    inside[10:-10, 10:-10] = True
    inside[50:60, 40:70] = False
    return inside


def correlated(f: Array, g: Array, f_mask: Array | None = None) -> Result:
    f_mask = mask() if f_mask is None else f_mask
    return correlate(
        ImagePair(f, g, GRID, f_mask, f_mask), ANSATZ, guess=ANSATZ.initial_guess(STRAIN)
    )


@cache
def expected() -> Result:
    found = correlated(*images())
    assert found.outcome is Outcome.CONVERGED
    return found


@pytest.mark.parametrize(
    "dtype", ["uint8", "uint16", "int16", "int32", "int64", "float16", "float32", "float64",
              ">u2", ">i4", ">f4", ">f8"],
)  # fmt: skip
def test_the_type_of_the_pixels_does_not_matter(dtype: str) -> None:
    f, g = (image.astype(dtype) for image in images())
    np.testing.assert_array_equal(f, images()[0])  # no type rounds whole grey levels up to 255
    np.testing.assert_array_equal(correlated(f, g).unknowns, expected().unknowns)


def test_the_types_of_the_two_images_may_differ() -> None:
    f, g = images()
    found = correlated(f.astype(np.uint8), g.astype(">f4"))
    np.testing.assert_array_equal(found.unknowns, expected().unknowns)


def test_16_bits_hold_what_float64_holds() -> None:
    f, g = (257 * image for image in images())
    found = correlated(f.astype(np.uint16), g.astype(">u2"))
    np.testing.assert_array_equal(found.unknowns, correlated(f, g).unknowns)


def every_other(image: Array) -> Array:
    """A view with gaps in both directions."""
    wide = np.full((2 * image.shape[0], 3 * image.shape[1]), 77, dtype=image.dtype)
    wide[::2, ::3] = image
    return wide[::2, ::3]


def backwards(image: Array) -> Array:
    """A view with negative strides."""
    return np.ascontiguousarray(image[::-1, ::-1])[::-1, ::-1]


def channel(image: Array) -> Array:
    """One colour of three."""
    return np.stack([0 * image, image, 0 * image], axis=-1)[..., 1]


def read_only(image: Array) -> Array:
    image = image.copy()
    image.setflags(write=False)
    return image


def unaligned(image: Array) -> Array:
    """Pixels that begin in the middle of a word, as behind a file's header."""
    raw = np.frombuffer(b"?" + image.tobytes(), dtype=np.uint8)
    return raw[1:].view(image.dtype).reshape(image.shape)


@pytest.mark.parametrize(
    "view", [every_other, backwards, channel, read_only, unaligned, np.asfortranarray]
)
@pytest.mark.parametrize("dtype", ["uint8", "float32", "float64"])
def test_the_layout_in_memory_does_not_matter(view: Callable[[Array], Array], dtype: str) -> None:
    f, g = (view(image.astype(dtype)) for image in images())
    found = correlated(f, g, view(mask()))
    np.testing.assert_array_equal(found.unknowns, expected().unknowns)


@pytest.mark.parametrize("view", [every_other, read_only, unaligned, np.asfortranarray])
def test_however_arrays_are_kept_no_kernel_is_compiled_anew(view: Callable[[Array], Array]) -> None:
    """Kernels are compiled for layout and writability, too; that takes a minute."""
    expected()
    before = signatures()
    f, g = (view(image.astype(np.float32)) for image in images())
    correlated(f, g, view(mask()))
    assert signatures() == before


def test_no_pixel_and_many_are_of_one_type() -> None:
    """numpy takes a cut of one element or none for contiguous, which is a type of its own."""
    row = np.zeros(GRID.shape, dtype=np.bool_)
    row[50, 40:70] = True
    assert len({numba.typeof(runs_of(pixels)) for pixels in (row & ~row, row, mask())}) == 1


def signatures() -> dict[str, int]:
    """How many types of arguments each kernel of the packages has been compiled for."""
    modules = [m for name, m in sys.modules.items() if name.startswith("modeharvest")]
    kernels = [k for m in modules for k in vars(m).values() if isinstance(k, Dispatcher)]
    assert accumulate in kernels
    return {f"{k.__module__}.{k.__name__}": len(k.signatures) for k in kernels}


@pytest.mark.parametrize("dtype", ["bool", "uint8", "float64"])
def test_the_type_of_a_mask_does_not_matter(dtype: str) -> None:
    found = correlated(*images(), (255 * mask()).astype(dtype))
    np.testing.assert_array_equal(found.unknowns, expected().unknowns)


def test_lists_are_images_too() -> None:
    f, g = images()
    found = correlated(f.tolist(), g.tolist(), mask().tolist())  # type: ignore[arg-type]
    np.testing.assert_array_equal(found.unknowns, expected().unknowns)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_nothing_is_written_into_what_was_given(dtype: str) -> None:
    f, g = (image.astype(dtype) for image in images())
    given = f, g, mask().copy(), ANSATZ.initial_guess(STRAIN)
    before = [array.copy() for array in given]
    correlate(ImagePair(f, g, GRID, given[2], given[2]), ANSATZ, guess=given[3])
    for array, copy in zip(given, before, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_one_thread_and_two_give_the_same_bits() -> None:
    most = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = correlated(*images())
    finally:
        numba.set_num_threads(most)
    np.testing.assert_array_equal(alone.unknowns, expected().unknowns)
    np.testing.assert_array_equal(alone.inverse, expected().inverse)
    assert alone.residual_rms == expected().residual_rms


@pytest.mark.parametrize("rows", [64, 65, 71])
def test_images_of_64_px(rows: int) -> None:
    """Coarse levels that would be smaller than 32 px are left out, and the rest arrives."""
    grid = PixelGrid.centred(rows, 64, PIXEL)
    ansatz = Ansatz(Box.centred(0.64, 0.7), v0_degree=1)
    truth = ansatz.initial_guess(STRAIN)
    truth += 0.004 * np.random.default_rng(rows).normal(size=truth.size)
    f, g = manufactured.image_pair(manufactured.speckle(rows, grid), ansatz, truth, grid)
    inner = np.zeros(grid.shape, dtype=np.bool_)
    inner[12:-12, 12:-12] = True
    found = correlate(ImagePair(f, g, grid, inner), ansatz, guess=ansatz.initial_guess())
    assert found.outcome is Outcome.CONVERGED
    assert {step.factor for step in found.history} == {2, 1}
    u = ansatz.displacement(truth, grid.x, grid.y)
    error = (found.displacement() - u)[inner] / PIXEL
    # The border's mirror image is felt by 0.43 a pixel: 1e-5 of what it spoils after 12 px.
    assert np.sqrt((error**2).sum(axis=-1).mean()) < 2e-5


def test_a_pixel_more_on_the_margin_changes_nothing() -> None:
    """A frame of any grey level outside the masks, whatever its width."""
    f, g = images()
    for width in (1, 8):
        grid = PixelGrid(
            GRID.rows + 2 * width, GRID.cols + 2 * width, PIXEL,
            GRID.x0 - width * PIXEL, GRID.y0 + width * PIXEL,
        )  # fmt: skip
        framed = [np.pad(image, width, constant_values=255) for image in (f, g)]
        wide = np.pad(mask(), width)
        options = CorrelationOptions(levels=(Level(1, 0.0),))
        start = expected().unknowns
        found = correlate(
            ImagePair(*framed, grid, wide, wide), ANSATZ, guess=start, options=options
        )
        alone = correlate(
            ImagePair(f, g, GRID, mask(), mask()), ANSATZ, guess=start, options=options
        )
        # float32 coefficients, rounded differently: 1e-7 of 255 over a slope of 10 per px.
        np.testing.assert_allclose(found.unknowns, alone.unknowns, atol=1e-5 * PIXEL)
