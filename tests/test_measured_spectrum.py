"""Spectra of measured fields: the peaks and the pattern are those that pixels show."""

from __future__ import annotations

import numpy as np
import pytest
from known_fields import sampled_field, square_mode

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.spectra.pattern import REFERENCE_MODE, read_pattern
from modeharvest.idic.spectra.spectrum import gridded, measured_spectrum, spectral_density
from modeharvest.idic.spectra.waves import find_peaks
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.errors import InputError

PITCH, PIXEL = 1.9, 0.05
GRID = PixelGrid.centred(400, 240, PIXEL)
X, Y = np.meshgrid(GRID.x, GRID.y)
HOLES = np.hypot((X % PITCH) - 0.5 * PITCH, (Y % PITCH) - 0.5 * PITCH) < 0.75
MASK = ~HOLES
ENVELOPE = np.cos(np.pi * X / 14) * np.cos(np.pi * Y / 22)
SLOW = np.stack([-0.1 * X + 0.002 * X * Y, 0.05 * Y - 0.003 * X**2], axis=-1)


def pattern(mode=REFERENCE_MODE, amplitude=0.15):
    return SLOW + amplitude * ENVELOPE[..., None] * square_mode(mode, PITCH, X, Y)


def same_peaks(one, other, count=2):
    a, b = (sorted(p.xi for p in find_peaks(s)[:count]) for s in (one, other))
    # A tenth of the main lobe l/L: half a subset more or less at an edge moves the window.
    np.testing.assert_allclose(a, b, atol=0.1 * PITCH / 12)


@pytest.mark.parametrize("step", [2, 3, 5])
def test_points_of_a_subset_grid_show_the_peaks_of_the_pixels(step):
    u = pattern()
    pixels = spectral_density(u, GRID, MASK, PITCH)
    points = measured_spectrum(sampled_field(u, GRID, MASK, step), PITCH)
    same_peaks(pixels, points)
    a, b = read_pattern(pixels), read_pattern(points)
    assert a.start is not None
    assert b.start is not None
    np.testing.assert_allclose(a.start, b.start, atol=0.02)
    assert a.start_amplitude == pytest.approx(b.start_amplitude, rel=0.05)


def test_noise_and_lost_points_leave_the_peaks_where_they_are():
    rng = np.random.default_rng(0)
    field = sampled_field(pattern(), GRID, MASK, 4)
    u = field.u + rng.normal(0, 0.01, field.u.shape)
    lost = rng.random(len(u)) < 0.2
    u[lost] = np.nan
    noisy = LocalField(field.x, field.y, u)
    assert noisy.lost == lost.sum()
    same_peaks(measured_spectrum(noisy, PITCH), measured_spectrum(field, PITCH))


def test_the_affine_part_is_found_at_the_points():
    field = sampled_field(np.stack([0.1 - 0.2 * X, 0.03 * X + 0.04 * Y], -1), GRID, MASK, 5)
    s = measured_spectrum(field, PITCH)
    np.testing.assert_allclose(s.affine, [[0.1, -0.2, 0], [0, 0.03, 0.04]], atol=1e-12)
    assert np.abs(s.source).max() < 1e-12


def test_scattered_points_are_interpolated():
    """Points a third of a step off their grid, as of a mesh or in calibrated millimetres."""
    rng = np.random.default_rng(2)
    regular = sampled_field(pattern(), GRID, MASK, 4)
    x, y = (c + rng.uniform(-0.06, 0.06, c.size) for c in (regular.x, regular.y))
    envelope = np.cos(np.pi * x / 14) * np.cos(np.pi * y / 22)
    u = 0.15 * envelope[:, None] * square_mode(REFERENCE_MODE, PITCH, x, y)
    scattered = measured_spectrum(LocalField(x, y, u), PITCH)
    same_peaks(scattered, measured_spectrum(regular, PITCH))
    assert read_pattern(scattered).start is not None


def test_points_keep_their_places_and_gaps_are_gaps():
    field = sampled_field(pattern(), GRID, MASK, 5)
    u, grid, mask = gridded(field)
    assert mask.sum() == field.x.size
    x, y = np.meshgrid(grid.x, grid.y)
    order = np.lexsort((field.x, -field.y))
    np.testing.assert_allclose(x[mask], field.x[order], atol=1e-9)
    np.testing.assert_allclose(y[mask], field.y[order], atol=1e-9)
    np.testing.assert_array_equal(u[mask], field.u[order])
    assert np.all(u[~mask] == 0)


def test_two_halves_with_patterns_of_their_own_are_read_apart():
    """Square above; below two waves that are longer along x; the whole is neither."""
    other = np.zeros((*GRID.shape, 2))
    for k, pair in (((0.7, 1.0), (1, 0.3)), ((-0.7, 1.0), (1, -0.3))):
        wave = np.sin(np.pi / PITCH * (k[0] * X + k[1] * Y))
        other += 0.2 * wave[..., None] * np.array(pair)
    u = np.where((Y > 0)[..., None], pattern(), SLOW + other)
    field = sampled_field(u, GRID, MASK, 3)
    upper = measured_spectrum(field, PITCH, Box(-6, 6, 0, 10))
    lower = measured_spectrum(field, PITCH, Box(-6, 6, -10, 0))
    above, below = read_pattern(upper), read_pattern(lower)
    assert above.start is not None, above.text
    assert below.start is None
    np.testing.assert_allclose(np.abs([w.k for w in above.waves]), 1, atol=0.05)
    np.testing.assert_allclose(np.abs([w.k for w in below.waves]), [[0.7, 1]] * 2, atol=0.05)
    assert read_pattern(measured_spectrum(field, PITCH)).start is None


def test_bad_input_is_named():
    field = sampled_field(pattern(), GRID, MASK, 10)
    with pytest.raises(InputError, match="measure with a smaller step"):
        measured_spectrum(field, PITCH)
    with pytest.raises(InputError, match="got none"):
        measured_spectrum(field, PITCH, Box(20, 30, 20, 30))
    with pytest.raises(InputError, match="positive unit cell"):
        measured_spectrum(field, 0.0)
    far = LocalField([0, 1e-3, 100.0], [0, 1e-3, 100.0], np.zeros((3, 2)))
    with pytest.raises(InputError, match="remove stray points"):
        gridded(far)
