"""Fourier coefficients of periodic fields on a mesh with holes.

Guards: known transforms, Parseval, translations, quarter turns and mirrors, oblique cells, that the
quadrature is converged, and that fields which are not periodic are refused.
"""

from __future__ import annotations

from math import factorial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from perforated import OBLIQUE, PITCH, SQUARE, holed_cell
from scipy.spatial import cKDTree
from scipy.special import j1

from modeharvest.fem.field import Mesh
from modeharvest.idic.spectra.lattice_spectrum import (
    LatticeSpectrum,
    MeshQuadrature,
    gauss_rule,
    lattice_spectrum,
    points_for,
    reciprocal_vectors,
    upward,
)
from modeharvest.util.errors import InputError

SETTINGS = settings(deadline=None, derandomize=True, max_examples=8)
TWO = np.array([[2], [2]])
QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


def field_on(mesh: Mesh, lattice: np.ndarray, seed: int = 0) -> np.ndarray:
    """Draw a smooth periodic field: all waves up to |ξ| = 1.2, random amplitudes and phases."""
    xi = reciprocal_vectors(lattice, PITCH, 1.2)
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(len(xi), 2)) + 1j * rng.normal(size=(len(xi), 2))
    return np.imag(np.exp(2j * np.pi / PITCH * mesh.nodes @ xi.T) @ z)


def by_wave(spectrum: LatticeSpectrum, xi: np.ndarray) -> np.ndarray:
    """Look up the coefficients (n, 2) at given wave vectors (n, 2); 0 where there is none."""
    distance, nearest = cKDTree(spectrum.xi).query(xi)
    return np.asarray(spectrum.coefficients[nearest] * (distance < 1e-6)[:, None])


@pytest.mark.parametrize("triangular", [True, False])
def test_gauss_rule_is_exact_up_to_its_degree(triangular: bool) -> None:
    """Of monomials: i! j! / (i + j + 2)! on the triangle (Dirichlet's integral)."""
    points, weights = gauss_rule(triangular, 4)
    for i in range(8):
        for j in range(8 - i):
            exact = (1 - (-1) ** (i + 1)) * (1 - (-1) ** (j + 1)) / ((i + 1) * (j + 1))
            if triangular:
                exact = factorial(i) * factorial(j) / factorial(i + j + 2)
            computed = weights @ (points[:, 0] ** i * points[:, 1] ** j)
            assert computed == pytest.approx(exact, abs=1e-14)


@pytest.mark.parametrize("lattice", [SQUARE, OBLIQUE])
@pytest.mark.parametrize("element", ["T6", "Q9"])
def test_quadrature_is_converged(lattice: np.ndarray, element: str) -> None:
    """Twice as many points change nothing beyond 1e-10, even on elements of a quarter pitch."""
    mesh = holed_cell(lattice, 4, element=element)
    u = field_on(mesh, lattice)
    spectrum = lattice_spectrum(mesh, lattice, u, PITCH)
    rule = MeshQuadrature(mesh, 2 * points_for(mesh, 6 * np.pi / PITCH))
    field = rule.without_mean(rule.values(u))
    kernel = np.exp(-2j * np.pi / PITCH * spectrum.xi @ rule.positions.T)
    reference = kernel @ (rule.weights[:, None] * field)
    scale = np.abs(reference).max()
    np.testing.assert_allclose(spectrum.coefficients, reference, atol=1e-10 * scale)
    assert spectrum.energy == pytest.approx(rule.product(field, field), rel=1e-10)


def test_transform_of_a_wave_between_round_holes() -> None:
    """û(ξ) of sin(2π κ·x/l) is that of the material at ξ − κ and ξ + κ; a disc's is a J1.

    The circle is of 64 parabolic arcs; their error is of order (π/64)^4, the nodal wave's
    interpolation of the order of h³ = 1e-3 with small constants.
    """
    radius, kappa = 0.35 * PITCH, np.array([0.5, 0.5])
    mesh, lattice = holed_cell(SQUARE, 16, (2, 2)), SQUARE * TWO
    wave = np.sin(2 * np.pi / PITCH * mesh.nodes @ kappa)
    spectrum = lattice_spectrum(mesh, lattice, np.stack([wave, 0 * wave], axis=1), PITCH)

    def material(xi: np.ndarray) -> float:
        if np.linalg.norm(xi) < 1e-9:
            return float(4 * PITCH**2 - 4 * np.pi * radius**2)
        if np.abs(xi - np.round(xi)).max() > 1e-9:  # of one hole, but four times in turn
            return 0.0
        q = 2 * np.pi * np.linalg.norm(xi) / PITCH
        return float(-4 * 2 * np.pi * radius * j1(q * radius) / q)

    for xi in ([0.5, 0.5], [-0.5, 0.5], [0.5, 1.5], [1.5, -1.5]):
        exact = (material(np.array(xi) - kappa) - material(np.array(xi) + kappa)) / 2j
        found = by_wave(spectrum, np.array([xi]))[0]
        assert found[0] == pytest.approx(exact, abs=2e-4 * 4 * PITCH**2)
        assert abs(found[1]) < 1e-12


@pytest.mark.parametrize("lattice", [SQUARE, OBLIQUE])
def test_parseval(lattice: np.ndarray) -> None:
    """The share within reach grows towards 1; what is missing falls like 1/reach.

    The field jumps to zero at the holes' edges, so S falls like |ξ|^-3 on average, and its sum
    outside a circle like 1/reach.
    """
    mesh = holed_cell(lattice, 6)
    u = field_on(mesh, lattice)
    reaches = (4.0, 8.0, 16.0)
    missing = [1 - lattice_spectrum(mesh, lattice, u, PITCH, r).shares.sum() for r in reaches]
    assert 0 < missing[2] < 0.05
    rates = -np.diff(np.log2(missing))
    np.testing.assert_allclose(rates, 1.0, atol=0.3)


def test_without_holes_nothing_is_missing() -> None:
    """Of a plane wave on full material all energy is in ± ξ, to the nodes' interpolation.

    Its error in the energy is about (k h)^4 / 720 = 8e-4 for elements of an eighth of the pitch.
    """
    s = np.arange(33) / 16.0 * PITCH
    nodes = np.stack(np.meshgrid(s, s, indexing="ij"), axis=-1).reshape(-1, 2)
    i, j = (a.ravel() for a in np.mgrid[0:32:2, 0:32:2])
    corner = 33 * i + j
    steps = [0, 66, 68, 2, 33, 67, 35, 1, 34]
    mesh = Mesh(nodes, corner[:, None] + np.array(steps), "Q9")
    wave = np.sin(2 * np.pi / PITCH * (0.5 * nodes[:, 0] + nodes[:, 1]) + 0.3)
    spectrum = lattice_spectrum(mesh, 2 * SQUARE, np.stack([wave, -2 * wave], axis=1), PITCH)
    (peak,) = (p for p in spectrum.peaks if p.share > 1e-4)
    assert peak.xi == (0.5, 1.0)
    assert peak.share == pytest.approx(1.0, abs=1e-4)
    assert spectrum.energy == pytest.approx(5 * 2 * PITCH**2, rel=1e-3)


@SETTINGS
@given(st.tuples(*[st.floats(-3, 3)] * 2), st.sampled_from([0, 1]), st.integers(0, 99))
def test_translation_turns_phases_only(shift: tuple[float, float], which: int, seed: int) -> None:
    lattice = (SQUARE, OBLIQUE)[which]
    mesh = holed_cell(lattice, 4)
    u = field_on(mesh, lattice, seed)
    moved = Mesh(mesh.nodes + shift, mesh.cells, mesh.element)
    first = lattice_spectrum(mesh, lattice, u + np.array([0.7, -0.2]), PITCH)
    second = lattice_spectrum(moved, lattice, u, PITCH)
    scale = first.density[:, 0].max()
    np.testing.assert_allclose(second.density, first.density, atol=1e-9 * scale)
    turned = first.coefficients * np.exp(-2j * np.pi / PITCH * first.xi @ shift)[:, None]
    np.testing.assert_allclose(second.coefficients, turned, atol=1e-9 * np.sqrt(scale))
    np.testing.assert_allclose(
        np.subtract(first.translation, second.translation), [0.7, -0.2], atol=1e-12
    )


@pytest.mark.parametrize("turn", [QUARTER_TURN, np.diag([-1.0, 1.0])])
@pytest.mark.parametrize("lattice", [SQUARE, OBLIQUE])
def test_turned_and_mirrored_fields(lattice: np.ndarray, turn: np.ndarray) -> None:
    """u'(Qx) = Q u(x) has û'(Qξ) = Q û(ξ), holes that lie off centre included."""
    mesh = holed_cell(lattice, 4, centre=(0.1, 0.2))
    u = field_on(mesh, lattice)
    cells = mesh.cells
    if np.linalg.det(turn) < 0:  # keep the corners counter-clockwise
        cells = cells[:, [0, 2, 1, 5, 4, 3]]
    turned = Mesh(mesh.nodes @ turn.T, cells, mesh.element)
    first = lattice_spectrum(mesh, lattice, u, PITCH)
    second = lattice_spectrum(turned, lattice @ turn.T, u @ turn.T, PITCH)
    expected = first.coefficients @ turn.T
    scale = np.abs(expected).max()
    np.testing.assert_allclose(by_wave(second, first.xi @ turn.T), expected, atol=1e-10 * scale)


def test_enlarged_cell_has_the_same_peaks() -> None:
    """Of four copies û is four times as large at the old wave vectors, and zero between them."""
    one, four = holed_cell(OBLIQUE, 4), holed_cell(OBLIQUE, 4, (2, 2))
    u = field_on(one, OBLIQUE)
    small = lattice_spectrum(one, OBLIQUE, u, PITCH)
    large = lattice_spectrum(four, OBLIQUE * TWO, np.tile(u, (4, 1)), PITCH)
    np.testing.assert_allclose(by_wave(large, small.xi), 4 * small.coefficients, atol=1e-9)
    assert large.shares.sum() == pytest.approx(small.shares.sum(), rel=1e-12)
    assert len(large.peaks) == len(small.peaks)
    for ours, theirs in zip(large.peaks, small.peaks, strict=True):
        assert ours.xi == pytest.approx(theirs.xi)
        assert ours.share == pytest.approx(theirs.share, rel=1e-9)


def test_wave_vectors_fill_the_circle_once() -> None:
    """As many as area times density, A π reach² / l², and one of each ± pair is upward."""
    for lattice in (SQUARE * TWO, OBLIQUE * TWO, np.array([[2.0, 0.3], [-0.7, 1.1]])):
        xi = reciprocal_vectors(lattice, PITCH, 12.0)
        count = abs(np.linalg.det(lattice)) * np.pi * 12.0**2 / PITCH**2
        assert len(xi) == pytest.approx(count, rel=0.02)  # Gauss's circle problem
        assert np.array_equal(xi[0], [0, 0])
        assert 2 * upward(xi).sum() + 1 == len(xi)
        # Each is a whole number of waves along both lattice vectors.
        turns = xi @ lattice.T / PITCH
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)


def test_bad_input_is_named() -> None:
    mesh = holed_cell(SQUARE, 4)
    u = field_on(mesh, SQUARE)
    sheared = u + mesh.nodes @ np.array([[0.0, 0.01], [0.0, 0.0]])
    for arguments, words in (
        ((mesh, SQUARE, u[:-1], PITCH), "expected shape"),
        ((mesh, SQUARE, np.full_like(u, np.nan), PITCH), "NaN"),
        ((mesh, SQUARE, sheared, PITCH), "remove the affine part"),
        ((mesh, SQUARE, np.ones_like(u), PITCH), "more than a translation"),
        ((mesh, np.ones((2, 2)), u, PITCH), "not parallel"),
        ((mesh, 2 * SQUARE, u, PITCH), "very cell that is meshed"),
        ((mesh, SQUARE, u, 0.0), "pitch"),
        ((mesh, SQUARE, u, PITCH, -1.0), "reach"),
        ((holed_cell(SQUARE, 4, (2, 2)), SQUARE, np.tile(u, (4, 1)), PITCH), "enlarged cell"),
        ((Mesh(mesh.nodes, mesh.cells[:, ::-1], "T6"), SQUARE, u, PITCH), "inside out"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            lattice_spectrum(*arguments)
        assert "\n" not in str(caught.value)


def test_opposite_waves_of_a_real_field_are_conjugate() -> None:
    mesh = holed_cell(SQUARE, 4)
    spectrum = lattice_spectrum(mesh, SQUARE, field_on(mesh, SQUARE), PITCH, 2.0)
    assert np.array_equal(by_wave(spectrum, -spectrum.xi), spectrum.coefficients.conj())
