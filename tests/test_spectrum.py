"""Spectral densities, the pattern read from them, and the mode's equivalents.

Guards: Parseval, known transforms, translation and mirror rules, that a made-up pattern is
read as it was made, that edges and bending are not taken for one, and that equivalent modes
are the same field.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from known_fields import square_mode

from modeharvest.idic.spectra.pattern import (
    REFERENCE_MODE,
    mode_deviation,
    mode_equivalent,
    read_pattern,
)
from modeharvest.idic.spectra.spectrum import spectral_density
from modeharvest.idic.spectra.waves import find_peaks
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.errors import InputError

PITCH = 1.9
PIXEL = 0.08
GRID = PixelGrid.centred(270, 200, PIXEL)
X, Y = np.meshgrid(GRID.x, GRID.y)
SETTINGS = settings(deadline=None, derandomize=True, max_examples=15)


def perforated() -> np.ndarray:
    """Draw the paper's specimen: 6 x 10 holes, bulk edges of 1.9 and 0.9 mm."""
    mask = (np.abs(X) < 7.6) & (np.abs(Y) < 10.4)
    for i in range(6):
        for j in range(10):
            mask &= (X - (i - 2.5) * PITCH) ** 2 + (Y - (j - 4.5) * PITCH) ** 2 > 0.75**2
    return mask


MASK = perforated()
ENVELOPE = np.clip(1 - (X / 6.6) ** 2, 0, 1) * np.clip(1 - (Y / 10) ** 2, 0, 1)


def bending() -> np.ndarray:
    """Bend as slowly and as strongly as the buckled specimen: compression and waisting."""
    u = np.zeros((*GRID.shape, 2))
    u[..., 0] = -0.1 * X + 0.02 * np.sin(np.pi * X / 7) * np.cos(Y / 9)
    u[..., 1] = 0.03 * Y - 0.04 * Y * np.exp(-((X / 4) ** 2))
    return u


def patterned(mode: np.ndarray, amplitude: float = 0.145) -> np.ndarray:
    return bending() + amplitude * ENVELOPE[..., None] * square_mode(mode, PITCH, X, Y)


def spectrum_of(u: np.ndarray, mask: np.ndarray = MASK):
    return spectral_density(u, GRID, mask, PITCH)


mode_strategy = st.tuples(
    *[st.floats(0.9, 1.1)] * 5, *[st.floats(-0.2 * PITCH, 0.2 * PITCH)] * 2
).map(lambda a: np.array(a) * (1, 1, 1, -1, 1, 1, 1))


def test_parseval():
    s = spectrum_of(patterned(REFERENCE_MODE))
    cell = (s.xi1[1] - s.xi1[0]) * (s.xi2[1] - s.xi2[0]) / PITCH**2
    assert np.sum(s.density) * cell == pytest.approx(np.sum(s.source**2) * s.cell, rel=1e-12)


def test_transform_of_a_wave_on_a_rectangle():
    """A sine over a w x h rectangle has the transform w h / 2i (sinc - sinc) along x."""
    w, h, kappa = 150 * PIXEL, 200 * PIXEL, 0.45 / PITCH
    mask = (np.abs(X) < w / 2) & (np.abs(Y) < h / 2)
    u = np.stack([np.zeros_like(X), np.sin(2 * np.pi * (kappa * X + 0.5 * Y / PITCH))], axis=-1)
    s = spectrum_of(np.where(mask[..., None], u, np.nan), mask)
    f = np.array([0.40, 0.47])

    def shape(sign: int) -> float:
        arguments = (f - sign * np.array([kappa * PITCH, 0.5])) / PITCH * (w, h)
        return float(np.prod(np.sinc(arguments)))

    plane = s.affine[1, 0] + s.affine[1, 1] * s.x[None, :] + s.affine[1, 2] * s.y[:, None]
    kernel = np.exp(-2j * np.pi * (f[0] * s.x[None, :] + f[1] * s.y[:, None]) / PITCH)
    removed = np.sum(plane * s.coverage * kernel) * s.cell
    expected = w * h / 2j * (shape(1) - shape(-1))
    # Pixels of 0.08 mm instead of an integral: (pi f h / l)^2 / 6 = 0.1 % per direction.
    assert s.at(f)[1] + removed == pytest.approx(expected, rel=3e-3)
    assert abs(s.at(f)[0]) < 1e-12 * abs(expected)


def test_fft_agrees_with_direct_evaluation():
    s = spectrum_of(patterned(REFERENCE_MODE))
    scale = np.abs(s.u_hat).max()
    for row, col in [(100, 50), (300, 500), (431, 222)]:
        direct = s.at((s.xi1[col], s.xi2[row]))
        assert np.abs(s.u_hat[row, col] - direct).max() < 1e-12 * scale


def test_affine_displacement_has_no_spectrum():
    u = np.stack([0.3 - 0.1 * X + 0.02 * Y, -0.2 + 0.05 * X + 0.07 * Y], axis=-1)
    s = spectrum_of(u)
    assert np.abs(s.source).max() < 1e-12
    np.testing.assert_allclose(s.affine, [[0.3, -0.1, 0.02], [-0.2, 0.05, 0.07]], atol=1e-12)
    assert read_pattern(s).family == "none"


def test_translation_turns_the_phase_only():
    u = patterned(REFERENCE_MODE)
    shift = np.array([1.3, -0.7])
    moved = PixelGrid(GRID.rows, GRID.cols, PIXEL, GRID.x0 + shift[0], GRID.y0 + shift[1])
    s, t = spectrum_of(u), spectral_density(u, moved, MASK, PITCH)
    for xi in [(0.5, 0.5), (-0.48, 0.53), (0.1, -0.3)]:
        turned = s.at(xi) * np.exp(-2j * np.pi * np.dot(xi, shift) / PITCH)
        np.testing.assert_allclose(t.at(xi), turned, atol=1e-9)


def test_mirror_in_x_mirrors_the_spectrum():
    u = patterned(np.array([1.05, 0.95, 1.02, -1.03, 0.98, 0.2, -0.4]))
    mirrored = u[:, ::-1] * (-1, 1)
    s, t = spectrum_of(u), spectrum_of(mirrored, MASK[:, ::-1])
    for xi in [(0.5, 0.5), (-0.48, 0.53)]:
        np.testing.assert_allclose(t.at((-xi[0], xi[1])), s.at(xi) * (-1, 1), atol=1e-9)


@SETTINGS
@given(mode_strategy, st.sampled_from([-1, 1]), st.tuples(*[st.floats(-2, 2)] * 2))
def test_pattern_is_read_as_it_was_made(mode, sign, origin):
    """Wave vectors, phases, ratio and sign of any pattern of the family, bending added.

    The origin of the coordinates may be anywhere: at a junction, a hole or in between.
    """
    moved = PixelGrid(GRID.rows, GRID.cols, PIXEL, GRID.x0 + origin[0], GRID.y0 + origin[1])
    s = spectral_density(patterned(mode, sign * 0.145), moved, MASK, PITCH)
    mode = mode - (0, 0, 0, 0, 0, *(mode[1:5].reshape(2, 2) @ origin))
    pattern = read_pattern(s)
    assert pattern.start is not None, pattern.text
    start, turned = mode_equivalent(pattern.start, PITCH, mode)
    # The phases that count are those in the middle of the specimen.
    for a in (start, mode):
        a[5:] += a[1:5].reshape(2, 2) @ origin
    # The rough start IDIC needs: the envelope's curvature moves a peak by a few hundredths.
    np.testing.assert_allclose(start[1:5], mode[1:5], atol=0.04)
    np.testing.assert_allclose(start[5:], mode[5:], atol=0.12 * PITCH)
    assert start[0] == pytest.approx(mode[0], rel=0.15)
    assert np.sign(pattern.start_amplitude) * turned == sign


def test_ideal_pattern_reads_like_the_paper():
    pattern = read_pattern(spectrum_of(patterned(REFERENCE_MODE)))
    assert len(pattern.waves) == 2
    first, second = np.array([w.amplitude for w in pattern.waves])
    np.testing.assert_allclose([w.k for w in pattern.waves], [[1, 1], [-1, 1]], atol=0.01)
    np.testing.assert_allclose(second / first, [1.0, -1.0], atol=0.02)
    np.testing.assert_allclose(pattern.start, REFERENCE_MODE, atol=0.01)
    # Mean of the envelope under the Hann taper lies between its plain mean, 1/3, and 1.
    assert 0.145 / 3 < pattern.start_amplitude < 0.145


@pytest.mark.parametrize(
    "amplitudes", [((1, 1), (1, 1)), ((1, 1), (1, -0.5)), ((1, 1), (0, 0)), ((1, 1j), (1, -1))]
)
def test_other_patterns_are_not_called_square(amplitudes):
    """Both signs the same, unequal amplitudes, a single wave, a circularly polarised one."""
    u = bending()
    for k, pair in zip(((1, 1), (-1, 1)), amplitudes, strict=True):
        wave = np.exp(1j * np.pi / PITCH * (k[0] * X + k[1] * Y))
        u += 0.1 * ENVELOPE[..., None] * np.imag(wave[..., None] * np.array(pair))
    pattern = read_pattern(spectrum_of(u))
    assert pattern.family == "unknown"
    assert pattern.start is None
    assert "not supported" in pattern.text[-1]


def test_no_pattern_is_seen_in_bending():
    pattern = read_pattern(spectrum_of(bending()))
    assert pattern.waves == ()
    assert pattern.family == "none"
    assert pattern.largest is not None
    assert pattern.text[0].startswith("No pattern: the largest peak is at")


def test_edge_lines_are_not_taken_for_peaks():
    """The lines carry the largest densities, so leaving them out is what finds the pattern."""
    s = spectrum_of(patterned(REFERENCE_MODE))
    peaks = find_peaks(s)
    assert s.density.sum(axis=-1).max() > 2 * peaks[0].density
    np.testing.assert_allclose(np.abs([p.xi for p in peaks[:2]]), 0.5, atol=0.03)


@SETTINGS
@given(mode_strategy, st.sampled_from([-1, 1]))
def test_equivalent_modes_are_the_same_field(mode, sign):
    x, y = np.random.default_rng(0).uniform(-5, 5, (2, 50))
    for target in (REFERENCE_MODE, (1, 1, -1, 1, 1, 0, 0), (-1, -1, 1, 1, 1, 3, -3)):
        other, turned = mode_equivalent(mode, PITCH, target)
        np.testing.assert_allclose(
            turned * square_mode(other, PITCH, x, y), square_mode(mode, PITCH, x, y), atol=1e-12
        )


@SETTINGS
@given(st.booleans(), st.booleans(), st.booleans(), st.booleans(), st.integers(-2, 2))
def test_every_equivalent_of_the_reference_is_it(swap, both, turn1, turn2, turns):
    a, k1, k2, c1, c2, sign = 1.0, np.array([1.0, 1]), np.array([-1.0, 1]), 0.0, 0.0, 1
    if swap:
        a, k1, k2, sign = -1.0, k2, k1, -1
    if both:
        c1, c2, sign = c1 - PITCH, c2 + PITCH, -sign
    if turn1:
        k1, c1 = -k1, PITCH - c1
    if turn2:
        k2, c2 = -k2, PITCH - c2
    reference, turned = mode_equivalent([a, *k1, *k2, c1 + 2 * PITCH * turns, c2], PITCH)
    np.testing.assert_allclose(reference, REFERENCE_MODE, atol=1e-12)
    assert turned == sign


def test_pattern_moved_by_a_cell_is_not_equivalent():
    """[1, 1, 1, 1, -1, 0, 0] has its origin at a hole: another field, one phase l away."""
    moved, _ = mode_equivalent([1, 1, 1, 1, -1, 0, 0], PITCH)
    assert abs(moved[5]) + abs(moved[6]) == pytest.approx(PITCH)
    deviation = mode_deviation([1.01, 1, 1, -1, 0.98, 0.019, 0], PITCH)
    np.testing.assert_allclose(deviation, [1, 0, 0, 0, -2, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("u", "mask", "pitch", "words"),
    [
        (np.zeros((3, 3, 2)), MASK, PITCH, "shape"),
        (bending(), np.zeros_like(MASK), PITCH, "all-black mask"),
        (np.full((*GRID.shape, 2), np.nan), MASK, PITCH, "NaN"),
        (bending(), MASK, 0.05, "more than 2 px"),
    ],
)
def test_bad_input_is_named(u, mask, pitch, words):
    with pytest.raises(InputError, match=words):
        spectral_density(u, GRID, mask, pitch)
    with pytest.raises(InputError, match="7 finite"):
        mode_equivalent([1, 2], PITCH)
