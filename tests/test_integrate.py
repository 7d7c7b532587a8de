"""Guards pixels that average over their area: exact where a formula says what they show."""

import math
from functools import cache

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import ndtr

from modeharvest.fem.field import Mesh
from modeharvest.imaging.camera import TOLERANCE, integrate, near_edges, points_a_side
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.render import ImagedState
from modeharvest.imaging.sensor import EDGE_POINTS, Aperture
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

H = 0.125  # mm/px, a binary fraction
GRID = PixelGrid.centred(61, 61, H)
SPECKLE = Speckle(SpeckleSpec(seed=9), GRID.shape)
# One Q4 element, 5 mm or 40 px a side: whatever the affine motion, no element edge is inside.
PLATE = Mesh(
    np.array([[-2.5, -2.5], [2.5, -2.5], [2.5, 2.5], [-2.5, 2.5]]), np.arange(4)[None], "Q4"
)
APERTURES = [
    Aperture(1.0),
    Aperture(0.5),
    Aperture(0.0, 0.5),
    Aperture(0.8, 0.6),
    Aperture(1.0, 1.0),
]


def imaged(displacement: FloatArray | None = None, background: float = 0.1) -> ImagedState:
    return ImagedState(PLATE, displacement, GRID, SPECKLE, background)


def material(state: ImagedState) -> BoolArray:
    u = 0.0 if state.displacement is None else state.displacement
    return locate(PLATE.nodes + u, PLATE.cells, "Q4", GRID).mask


def weight(aperture: Aperture, t: FloatArray) -> FloatArray:
    """h along one axis in closed form: square times Gaussian."""
    a, s = aperture.side_px, aperture.psf_px
    if a == 0.0:
        return np.asarray(np.exp(-0.5 * (t / s) ** 2) / (s * math.sqrt(2 * math.pi)))
    return np.asarray((ndtr((t + 0.5 * a) / s) - ndtr((t - 0.5 * a) / s)) / a)


# The rules ------------------------------------------------------------------------------------


def test_rules_are_the_known_ones_at_both_ends() -> None:
    x, w = np.polynomial.legendre.leggauss(4)
    for got, known in zip(Aperture(1.0).rule(4), (x / 2, w / 2), strict=True):
        np.testing.assert_allclose(got, known, atol=1e-14)
    y, v = np.polynomial.hermite_e.hermegauss(5)
    for got, known in zip(Aperture(0.0, 0.7).rule(5), (0.7 * y, v / v.sum()), strict=True):
        np.testing.assert_allclose(got, known, atol=1e-14)


@given(fill=st.floats(0, 1), psf=st.floats(0, 1.5), points=st.integers(1, 8), f=st.floats(0, 0.5))
def test_a_rule_of_n_points_has_the_first_2n_moments(
    fill: float, psf: float, points: int, f: float
) -> None:
    """Against the moments of a uniform plus a normal number, by the binomial theorem."""
    aperture = Aperture(fill, psf)
    nodes, weights = aperture.rule(points)
    a = aperture.side_px
    uniform = [(a / 2) ** k / (k + 1) if k % 2 == 0 else 0.0 for k in range(2 * points)]
    normal = [psf**k * math.prod(range(k - 1, 0, -2)) if k % 2 == 0 else 0.0
              for k in range(2 * points)]  # fmt: skip
    for k in range(2 * points):
        exact = sum(math.comb(k, j) * uniform[j] * normal[k - j] for j in range(k + 1))
        scale = float(weights @ np.abs(nodes) ** k) + 1e-300
        assert abs(float(weights @ nodes**k) - exact) <= 1e-11 * scale


@pytest.mark.parametrize("aperture", [a for a in APERTURES if a.psf_px > 0])
def test_transfer_is_the_fourier_transform_of_the_weight(aperture: Aperture) -> None:
    t = np.linspace(-12, 12, 24_001)
    f = np.linspace(0, 0.5, 11)
    h = weight(aperture, t)
    transform = np.cos(2 * np.pi * np.outer(f, t)) @ h * (t[1] - t[0])
    np.testing.assert_allclose(aperture.transfer(f), transform, atol=1e-12)
    beyond = np.abs(t) > aperture.reach_px
    assert h[beyond].sum() * (t[1] - t[0]) < 1e-6


@pytest.mark.parametrize("aperture", APERTURES)
def test_the_criterion_bounds_the_error_on_plane_waves(aperture: Aperture) -> None:
    side, bound = points_a_side(aperture, SpeckleSpec())
    assert bound <= TOLERANCE
    assert side > 1
    assert points_a_side(aperture, SpeckleSpec(), 1.5)[0] >= side
    nodes, weights = aperture.rule(side)
    rng = np.random.default_rng(0)
    for f in rng.uniform(0, 0.3, (50, 2)):
        blur = np.exp(-2 * (np.pi * 3.0) ** 2 * (f @ f))
        ruled = (np.exp(2j * np.pi * f[0] * nodes) @ weights) * (
            np.exp(2j * np.pi * f[1] * nodes) @ weights
        )
        exact = aperture.transfer(f).prod()
        assert 0.4 * blur * abs(ruled - exact) <= TOLERANCE


def upto(aperture: Aperture, t: FloatArray) -> FloatArray:
    """Part of h along one axis below t: its integral in closed form."""
    a, s = max(aperture.side_px, 1e-6), max(aperture.psf_px, 1e-6)
    high, low = (t + 0.5 * a) / s, (t - 0.5 * a) / s
    bell = (np.exp(-0.5 * high**2) - np.exp(-0.5 * low**2)) / math.sqrt(2 * math.pi)
    return np.asarray(s / a * (high * ndtr(high) - low * ndtr(low) + bell))


@cache
def quantiles(aperture: Aperture) -> FloatArray:
    """(4000,) points along one axis that share out h evenly."""
    a, s = max(aperture.side_px, 1e-6), max(aperture.psf_px, 1e-6)
    fine = np.linspace(-1, 1, 40_001) * (0.5 * a + 6 * s)
    return np.interp((np.arange(4000) + 0.5) / 4000, upto(aperture, fine), fine)


def share_beyond(aperture: Aperture, normal: FloatArray, offset: float) -> float:
    """Part of h where normal . t < offset: exact along one axis, 4000 points along the other."""
    steep = int(abs(normal[1]) > abs(normal[0]))
    t = (offset - normal[1 - steep] * quantiles(aperture)) / abs(normal[steep])
    return float(upto(aperture, t).mean())


@pytest.mark.parametrize("aperture", APERTURES)
def test_scattered_points_see_a_straight_edge_to_half_a_percent(aperture: Aperture) -> None:
    """Against the exact share, for edges at any angle and offset."""
    points = aperture.scattered()
    assert points.shape == (EDGE_POINTS, 2)
    rng = np.random.default_rng(1)
    spread = math.sqrt(aperture.fill_factor / 12 + aperture.psf_px**2)
    errors = []
    for angle in rng.uniform(0, 2 * np.pi, 200):
        normal, offset = np.array([np.cos(angle), np.sin(angle)]), rng.normal(0, spread)
        share = (points @ normal < offset).mean()
        errors.append(share - share_beyond(aperture, normal, offset))
    assert np.sqrt(np.mean(np.square(errors))) < 0.005  # N^-3/4, as that of any even set: 0.0047
    for axis in (0, 1):  # edges along the pixels: all points lie on different lines
        ordered = np.sort(points[:, axis])
        assert np.diff(ordered).min() > 0


# Images ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("aperture", APERTURES)
def test_reference_and_undeformed_image_agree(aperture: Aperture) -> None:
    """Fourier multiplication on one side, the Gauss rule in every pixel on the other."""
    mask = material(imaged())
    spectral, exactly = integrate(imaged(), aperture, mask)
    ruled, quadrature = integrate(imaged(np.zeros((4, 2))), aperture, mask)
    assert (exactly.points, quadrature.points > 1) == (0, True)
    inside = mask & ~near_edges(mask, aperture.reach_px)
    assert inside.sum() > 800
    error = (ruled - spectral)[inside]
    pattern = imaged().speckle.spline.bound
    assert np.sqrt((error**2).mean()) <= quadrature.rms_bound + pattern
    np.testing.assert_array_equal(ruled[~inside], spectral[~inside])


@pytest.mark.parametrize("aperture", APERTURES)
def test_deformed_pixels_show_the_weighted_integral(aperture: Aperture) -> None:
    """Against a fine rule over h itself, in closed form, at some pixels of an affine motion."""
    F, shift = np.array([[0.9, 0.08], [-0.05, 1.07]]), np.array([0.21, -0.13])
    state = imaged(PLATE.nodes @ (F - np.eye(2)).T + shift)
    mask = material(state)
    image, _ = integrate(state, aperture, mask)
    rows, cols = np.nonzero(mask & ~near_edges(mask, aperture.reach_px))
    a = aperture.side_px
    if aperture.psf_px == 0.0:
        x, w = np.polynomial.legendre.leggauss(20)
        t, h = 0.5 * a * x, 0.5 * w
    else:  # trapezoids on an analytic weight: exponentially convergent
        t = np.linspace(-5.0, 5.0, 101) * (aperture.psf_px + 0.5 * a)
        h = weight(aperture, t) * (t[1] - t[0])
    for k in np.random.default_rng(0).choice(rows.size, 12, replace=False):
        x, y = GRID.to_mm(rows[k] + t[:, None], cols[k] + t[None, :])
        x, y = np.broadcast_arrays(x, y)
        X = (np.stack([x, y], axis=-1) - shift) @ np.linalg.inv(F).T
        shown = SPECKLE(*GRID.to_px(X[..., 0], X[..., 1]))
        assert abs(image[rows[k], cols[k]] - h @ shown @ h) < 1e-6


@pytest.mark.parametrize("aperture", APERTURES)
def test_edge_pixels_mix_material_and_background_in_their_shares(aperture: Aperture) -> None:
    """A plate of one grey level, shifted by odd parts of a pixel: products of 1D shares."""
    speckle = Speckle(SpeckleSpec(dark=0.6, bright=0.6 + 1e-9), GRID.shape)
    shift = np.array([0.3, 0.2]) * H
    state = ImagedState(PLATE, np.tile(shift, (4, 1)), GRID, speckle, 0.1)
    image, _ = integrate(state, aperture, material(state))

    def share(position: FloatArray, low: float, high: float) -> FloatArray:
        t = np.linspace(-8, 8, 64_001)
        if aperture.psf_px == 0.0:
            h = (np.abs(t) < 0.5 * aperture.side_px).astype(np.float64)
        else:
            h = weight(aperture, t)
        upto = np.cumsum(h) / h.sum()
        return np.interp(high - position, t, upto) - np.interp(low - position, t, upto)

    across = share(np.arange(61.0), 10.3, 50.3)  # columns move right, rows up
    down = share(np.arange(61.0), 9.8, 49.8)
    expected = 0.1 + 0.5 * np.outer(down, across)
    # Half the distance of the lines along the pixels; a corner is cut twice.
    assert np.abs(image - expected).max() < 0.5 * 2.5 / EDGE_POINTS
    far = ~near_edges(material(state), aperture.reach_px)
    np.testing.assert_allclose(image[far], expected[far], atol=1e-6)


def test_fine_speckles_are_where_they_are_in_images_of_points() -> None:
    """Blurs below 2 px need more than one sample a pixel."""
    speckle = Speckle(SpeckleSpec(standard_deviation=0.08, blur_px=1.0, seed=9), GRID.shape)
    state = ImagedState(PLATE, None, GRID, speckle, 0.1)
    inside = material(state) & ~near_edges(material(state), 2)
    at_points = state.average(np.zeros((1, 2)), np.ones(1), inside)
    np.testing.assert_allclose(at_points, speckle.image()[inside], atol=1e-6)


def test_background_and_material_far_from_edges_are_distinguished() -> None:
    mask = np.zeros((20, 20), dtype=np.bool_)
    mask[5:15, 5:15] = True
    near = near_edges(mask, 2)
    expected = np.zeros_like(mask)
    expected[3:17, 3:17] = True
    expected[7:13, 7:13] = False
    np.testing.assert_array_equal(near, expected)


def test_compression_is_the_largest_among_elements() -> None:
    F = np.array([[0.8, 0.1], [0.0, 1.2]])
    state = imaged(PLATE.nodes @ (F - np.eye(2)).T)
    assert state.compression == pytest.approx(1 / np.linalg.svd(F, compute_uv=False).min())
    assert imaged().compression == 1.0


def test_threads_do_not_change_a_bit() -> None:
    state = imaged(0.02 * PLATE.nodes[:, ::-1])
    mask, aperture = material(state), Aperture(1.0, 0.4)
    before = numba.get_num_threads()
    many, _ = integrate(state, aperture, mask)
    try:
        numba.set_num_threads(1)
        one, _ = integrate(state, aperture, mask)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(one.astype(np.float32), many.astype(np.float32))
