"""Guards the pattern's statistics and that its intensity is exact at any point."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.imaging.speckle.pattern import (
    TOLERANCE,
    Ink,
    Layer,
    Speckle,
    SpeckleSpec,
    gaussian_field,
)
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

# The non-uniform FFT is asked for 1e-12 relative to the image's norm; 10 is for its constant.
EXACT = 1e-11


def binary(speckle: Speckle) -> FloatArray:
    """The base layer's two phases before the blur."""
    return Layer(speckle.spec.binary_field, speckle.shape).binary()


def directly_summed(speckle: Speckle, row: FloatArray, col: FloatArray) -> FloatArray:
    """Sum the trigonometric polynomial and its two derivatives term by term: (3, points)."""
    rows, cols = speckle.period
    f_row, f_col = np.fft.fftfreq(rows), np.fft.fftfreq(cols)
    transfer = np.exp(
        -2.0 * (math.pi * speckle.spec.blur_px) ** 2 * (f_row[:, None] ** 2 + f_col**2)
    )
    c = np.fft.fft2(binary(speckle)) * transfer / (rows * cols)
    along_row = np.exp(2j * math.pi * np.outer(row, f_row))
    along_col = np.exp(2j * math.pi * np.outer(col, f_col))
    d_row, d_col = 2j * math.pi * f_row, 2j * math.pi * f_col
    return np.array(
        [
            np.einsum("pr,rc,pc->p", along_row, c, along_col, optimize=True).real,
            np.einsum("pr,rc,pc->p", along_row * d_row, c, along_col, optimize=True).real,
            np.einsum("pr,rc,pc->p", along_row, c, along_col * d_col, optimize=True).real,
        ]
    )


def blurred_in_space(speckle: Speckle, row: float, col: float) -> float:
    """Sum the binary pixels times Gaussians centred on them in space, out to 12 sd."""
    return space_sum(binary(speckle), speckle.spec.blur_px, row, col)


def space_sum(samples: FloatArray, b: float, row: float, col: float) -> float:
    reach = math.ceil(12 * b)
    r = np.arange(math.floor(row) - reach, math.floor(row) + reach + 1)
    c = np.arange(math.floor(col) - reach, math.floor(col) + reach + 1)
    binary = np.take(np.take(samples, r, axis=0, mode="wrap"), c, axis=1, mode="wrap")
    weight_row = np.exp(-((r - row) ** 2) / (2 * b * b))
    weight_col = np.exp(-((c - col) ** 2) / (2 * b * b))
    return float(weight_row @ binary @ weight_col / (2 * math.pi * b * b))


@pytest.fixture(scope="module")
def points() -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(1)
    return rng.uniform(-5, 130, 40), rng.uniform(-5, 100, 40)


@pytest.mark.parametrize("shape", [(120, 90), (75, 81), (64, 64)])  # even and odd periods
def test_exact_between_pixels(
    shape: tuple[int, int], points: tuple[FloatArray, FloatArray]
) -> None:
    speckle = Speckle(SpeckleSpec(seed=3), shape)
    expected = directly_summed(speckle, *points)
    np.testing.assert_allclose(speckle.exact(*points), expected[0], atol=EXACT)
    # A derivative is bounded by Bernstein's inequality: at most the band limit times the value.
    np.testing.assert_allclose(speckle.gradient(*points), expected[1:], atol=EXACT)
    in_space = [blurred_in_space(speckle, r, c) for r, c in zip(*points, strict=True)]
    np.testing.assert_allclose(speckle.exact(*points), in_space, atol=EXACT)


def test_whole_pixels_by_fft_and_by_non_uniform_fft_agree() -> None:
    speckle = Speckle(SpeckleSpec(), (97, 131))
    row, col = np.mgrid[:97, :131]
    np.testing.assert_allclose(speckle.exact(row, col), speckle.image(), atol=EXACT)


def test_periodic_and_of_the_shape_asked_for() -> None:
    speckle = Speckle(SpeckleSpec(), (50, 70))
    assert speckle.image().shape == (50, 70)
    row, col = np.linspace(0, 49, 12).reshape(3, 4), np.linspace(3, 60, 12).reshape(3, 4)
    shifted = speckle.exact(row + speckle.period[0], col - speckle.period[1])
    assert shifted.shape == (3, 4)
    np.testing.assert_allclose(shifted, speckle.exact(row, col), atol=EXACT)
    assert speckle.exact(np.empty(0), np.empty(0)).shape == (0,)


@pytest.mark.parametrize("unit", ["cycles/px", "rad/px"])
def test_field_has_the_spectral_density_asked_for(unit: Any) -> None:
    spec = SpeckleSpec(unit=unit, seed=7)
    n = 600
    s = spec.standard_deviation / (1.0 if unit == "cycles/px" else 2 * math.pi)
    field = gaussian_field(spec.cycles_per_px, spec.seed, (n, n))
    power = np.abs(np.fft.fft2(field)) ** 2
    f = np.fft.fftfreq(n)
    # A periodogram ordinate scatters by 100 %; n^2 4 pi s^2 of them matter, half independent.
    # The scatter of a second moment is sqrt(E(f^4)/E(f^2)^2) = sqrt(3) times that of the mean.
    scatter = math.sqrt(2 * 3 / (n**2 * 4 * math.pi * s**2))
    for axis in (0, 1):
        second_moment = (power.sum(axis=1 - axis) * f**2).sum() / power.sum()
        assert abs(second_moment / s**2 - 1) < 4 * scatter
    mixed = (power * f[:, None] * f[None, :]).sum() / power.sum()
    assert abs(mixed) / s**2 < 4 * scatter
    assert abs(field.mean()) < 1e-12
    assert abs(field.var() - 1) < 4 * scatter


def test_field_is_correlated_over_its_length() -> None:
    spec, n = SpeckleSpec(seed=11), 600
    field = gaussian_field(spec.cycles_per_px, spec.seed, (n, n))
    # The inverse transform of the spectral density: exp(-2 pi^2 s^2 r^2), standard deviation
    # 1/(2 pi s) = 3.18 px; independent patches: n^2 / (pi (2 * 3.18)^2) = 2800.
    for r in (2, 4, 8):
        measured = float((field * np.roll(field, r, axis=r % 4 // 2)).mean())
        assert abs(measured - math.exp(-2 * (math.pi * r / 20) ** 2)) < 4 / math.sqrt(2800)


@pytest.mark.parametrize(("unit", "chord"), [("cycles/px", 10.0), ("rad/px", 20 * math.pi)])
def test_phases_have_equal_area_and_the_mean_chord_of_rice(unit: Any, chord: float) -> None:
    """Zero crossings along a line are 1/(2 s) apart (Rice); 10 px is the number in cycles/px."""
    spec, n = SpeckleSpec(unit=unit, seed=5), 1000
    s = 1.0 / (2.0 * chord)
    bright = binary(Speckle(spec, (n, n))) == spec.bright
    # Sampled at whole pixels, neighbours differ with probability acos(rho(1)) / pi.
    expected = math.acos(math.exp(-2 * (math.pi * s) ** 2)) / math.pi
    changes = float((bright != np.roll(bright, 1, axis=1)).mean())
    assert abs(changes / expected - 1) < 4 * chord / n
    assert abs(1 / expected / chord - 1) < 0.02
    # var of the area fraction: sum of asin(rho) / (2 pi) over lags, at most rho / 4 each.
    deviation = math.sqrt(0.25 / (2 * math.pi * s**2)) / n
    assert abs(bright.mean() - 0.5) < 4 * deviation


def test_grey_levels_stay_between_dark_and_bright() -> None:
    image = Speckle(SpeckleSpec(dark=0.3, bright=0.8), (200, 200)).image()
    assert 0.3 - 1e-12 < image.min() < 0.4
    assert 0.7 < image.max() < 0.8 + 1e-12
    assert abs(image.mean() - 0.55) < 0.05


def test_seed_decides() -> None:
    one, same, other = (Speckle(SpeckleSpec(seed=k), (60, 60)).image() for k in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.corrcoef(one.ravel(), other.ravel())[0, 1] < 0.3


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"unit": "1/mm"}, "unit"),
        ({"standard_deviation": 0.0}, "spectral standard deviation"),
        ({"standard_deviation": 0.2}, "spectral standard deviation"),
        ({"blur_px": 0.5}, "blur"),
        ({"blur_px": float("nan")}, "blur"),
        ({"dark": 0.9, "bright": 0.5}, "grey levels"),
        ({"bright": 1.5}, "grey levels"),
        ({"seed": -1}, "seed"),
        ({"standard_deviation": 0.2, "blur_px": 1.0, "seed": -1}, "seed"),
        ({"standard_deviation": 0.3, "blur_px": 1.0}, "to 0.25"),
    ],
)
def test_refuses_what_cannot_be_made(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        SpeckleSpec(**bad)


def test_refuses_an_image_too_small() -> None:
    with pytest.raises(InputError, match="8 x 8"):
        Speckle(SpeckleSpec(), (4, 100))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"standard_deviation": 0.2}, "ink: .* a spectral"),
        ({"blur_px": 0.1}, "ink: expected a blur"),
        ({"coverage": 1.0}, "coverage"),
        ({"darkness": 0.0}, "darkness"),
        ({"seed": -1}, "seed"),
    ],
)
def test_refuses_ink_that_cannot_be(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Ink(**{"blur_px": 2.0} | bad)


POWDER = SpeckleSpec(standard_deviation=0.16, blur_px=1.0, dark=0.35, bright=0.95, seed=2)
PAINTED = replace(POWDER, ink=Ink(blur_px=1.5, coverage=0.35, seed=2))


@pytest.mark.parametrize("spec", [POWDER, PAINTED], ids=["fine", "two layers"])
def test_finer_than_pixels_and_layered_is_exact_between_them(
    spec: SpeckleSpec, points: tuple[FloatArray, FloatArray]
) -> None:
    """Against a sum in space over the samples before the blur, of each layer for itself."""
    shape = (60, 64)
    speckle = Speckle(spec, shape)
    expected = np.array([layers_in_space(spec, shape, r, c) for r, c in zip(*points, strict=True)])
    # Cutting the waves off at the samples' Nyquist leaves out 3e-9 of a wave, of many waves.
    np.testing.assert_allclose(speckle.exact(*points), expected, atol=3e-8)
    np.testing.assert_allclose(speckle(*points), speckle.exact(*points), atol=speckle.bound)
    assert speckle.bound < 3 * TOLERANCE
    row, col = np.mgrid[: shape[0], : shape[1]]
    np.testing.assert_allclose(speckle.exact(row, col), speckle.image(), atol=EXACT)


def layers_in_space(spec: SpeckleSpec, shape: tuple[int, int], row: float, col: float) -> float:
    base = layer_in_space(Layer(spec.binary_field, shape), row, col)
    if spec.ink is None:
        return base
    return base * (
        1.0 - spec.ink.darkness * layer_in_space(Layer(spec.ink.binary_field, shape), row, col)
    )


def layer_in_space(layer: Layer, row: float, col: float) -> float:
    n = layer.field.finer
    return space_sum(layer.binary(), n * layer.field.blur_px, n * row, n * col)


def test_gradient_of_two_layers_is_the_slope(points: tuple[FloatArray, FloatArray]) -> None:
    speckle, h = Speckle(PAINTED, (60, 64)), 1e-4
    row, col = points
    slope = np.array(
        [
            (speckle.exact(row + h, col) - speckle.exact(row - h, col)) / (2 * h),
            (speckle.exact(row, col + h) - speckle.exact(row, col - h)) / (2 * h),
        ]
    )
    # Third derivatives are below (2 pi / 3 px)^3 = 9; rounding is 1e-12 / h.
    np.testing.assert_allclose(speckle.gradient(row, col), slope, atol=1e-7)


def test_ink_darkens_its_share_and_knows_nothing_of_the_powder() -> None:
    n = 600
    bare, painted = Speckle(POWDER, (n, n)).image(), Speckle(PAINTED, (n, n)).image()
    ink = (1.0 - painted / bare) / 0.8
    assert -1e-6 < ink.min() < 0.01
    assert 0.99 < ink.max() < 1.0 + 1e-6
    # Excursions of a field of 3.2 px correlation length: n^2 / (2 pi 3.2^2) patches, binary.
    patches = n**2 / (2 * math.pi * 3.2**2)
    assert abs(ink.mean() - 0.35) < 4 * math.sqrt(0.35 * 0.65 / patches)
    assert abs(np.corrcoef(ink.ravel(), bare.ravel())[0, 1]) < 4 / math.sqrt(patches)
    assert Speckle(replace(PAINTED, ink=None), (n, n)).image().tobytes() == bare.tobytes()


def test_refuses_to_average_two_layers() -> None:
    with pytest.raises(InputError, match="one layer where pixels average"):
        Speckle(PAINTED, (64, 64)).image(np.ones_like)
