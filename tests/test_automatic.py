"""Mode families found automatically in fields that were made up, on meshes with holes.

Guards: waves, amplitudes and phases come back as they went in, at the rate of the mesh; the square
pattern becomes the paper's Eq. (6) wherever the origin is; what is equal is tied and what is not
stays free; energies are right; the family is the field when the rest of idic evaluates it.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from known_fields import square_mode
from perforated import OBLIQUE, PITCH, SQUARE, holed_cell

from modeharvest.fem.field import Mesh
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import FourierMode, Taper, free_family, square_family
from modeharvest.idic.spectra.mode_family import FoundFamily, mode_family, overlap
from modeharvest.util.errors import InputError

SETTINGS = settings(deadline=None, derandomize=True, max_examples=10)
TWO = np.array([[2], [2]])
SQUARE_MESH, HEXAGONAL_MESH = holed_cell(SQUARE, 8, (2, 2)), holed_cell(OBLIQUE, 8, (2, 2))
INTERPOLATION = 1e-3
"""Error of a wave of |ξ| <= 1.2 that six nodes an element interpolate, l/8 large: (k h)³ / 400."""

# Waves towards the three M points of the hexagonal lattice, each at right angles to its vector.
M_ANGLES = np.pi / 6 + np.pi / 3 * np.arange(3)
M_WAVES = np.array(
    [[-np.sin(t), np.cos(t), *(2 / np.sqrt(3) * np.array([np.cos(t), np.sin(t)])), 0.0]
     for t in M_ANGLES]
)  # fmt: skip


def moved(mesh: Mesh, shift: tuple[float, float]) -> Mesh:
    return Mesh(mesh.nodes + shift, mesh.cells, mesh.element)


def field(mesh: Mesh, waves: np.ndarray) -> np.ndarray:
    """Sum of (A, B) sin(π/l (k·x + c)) at the nodes."""
    waves = np.atleast_2d(waves)
    phases = np.pi / PITCH * (mesh.nodes @ waves[:, 2:4].T + waves[:, 4])
    return np.sin(phases) @ waves[:, :2]


def evaluated(found: FoundFamily, mesh: Mesh) -> np.ndarray:
    """Evaluate amplitude times the family at its start, the way a correlation does."""
    far = Taper(Box(-1e3, 1e3, -1e3, 1e3), 1.0)
    mode = FourierMode(found.family, found.pitch, 1.0, far)
    x, y = mesh.nodes.T
    return found.amplitude * mode.evaluate(found.family.start, x, y)


def assert_is_field(found: FoundFamily, mesh: Mesh, u: np.ndarray) -> None:
    error = np.abs(evaluated(found, mesh) - u).max()
    assert error < 5 * INTERPOLATION * np.abs(u).max()
    assert found.captured > 1 - 1e-5


@pytest.mark.parametrize(("origin", "shift"), [("hole", 0.0), ("junction", PITCH / 2)])
def test_square_pattern_is_the_papers_mode(origin: str, shift: float) -> None:
    """Matrix and offset are those of Eq. (6), and the start is the paper's (facts: IDIC)."""
    paper = square_family(origin)
    mesh = moved(SQUARE_MESH, (shift, shift))
    u = -0.3 * square_mode(paper.start, PITCH, *mesh.nodes.T)
    found = mode_family(mesh, SQUARE * TWO, u, PITCH)
    assert found.family.name == paper.name
    assert np.array_equal(found.family.matrix, paper.matrix)
    assert np.array_equal(found.family.offset, paper.offset)
    np.testing.assert_allclose(found.family.start, paper.start, atol=INTERPOLATION)
    assert found.amplitude == pytest.approx(-0.3, rel=INTERPOLATION)
    assert_is_field(found, mesh, u)
    assert f"Eq. (6) of the paper ({paper.name})" in found.text[-1]


@SETTINGS
@given(
    st.floats(0.3, 3.0), st.sampled_from([-1, 1]), st.tuples(*[st.floats(-2, 2)] * 2),
    st.booleans(),
)  # fmt: skip
def test_square_pattern_with_any_origin_and_ratio(
    ratio: float, sign: int, shift: tuple[float, float], turned: bool
) -> None:
    """Wherever the origin is, however strong x is against y, also after a quarter turn."""
    mesh = SQUARE_MESH
    u = sign * square_mode([ratio, 1, 1, 1, -1, 0, 0], PITCH, *mesh.nodes.T)
    if turned:
        turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
        mesh, u = Mesh(mesh.nodes @ turn, mesh.cells, mesh.element), u @ turn
    mesh = moved(mesh, shift)
    found = mode_family(mesh, SQUARE * TWO, u, PITCH)
    assert np.array_equal(found.family.matrix, square_family().matrix)
    assert np.array_equal(found.family.offset, square_family().offset)
    assert_is_field(found, mesh, u)


def test_other_patterns_of_the_diagonals_are_not_called_square() -> None:
    """Both signs the same: divergence instead of rotation; or amplitudes that differ."""
    for first, second in (((1, 1), (1, 1)), ((1, 1), (0.8, -0.8)), ((1, 1), (1, 0))):
        u = field(SQUARE_MESH, np.array([[*first, 1, 1, 0.2], [*second, -1, 1, 0.2]]))
        found = mode_family(SQUARE_MESH, SQUARE * TWO, u, PITCH)
        assert found.family.name == "2 waves"
        assert_is_field(found, SQUARE_MESH, u)


@SETTINGS
@given(st.integers(0, 999), st.tuples(*[st.floats(-2, 2)] * 2))
def test_any_waves_are_recovered(seed: int, shift: tuple[float, float]) -> None:
    """Three waves of the 2 x 2 cell with random amplitudes and phases, the origin anywhere."""
    rng = np.random.default_rng(seed)
    k = np.array([[1, 0], [1, 2], [-1, 1]], dtype=np.float64)
    angle = rng.uniform(0, 2 * np.pi, 3)
    strength = np.array([1.0, 0.8, 0.6])[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    waves = np.column_stack([strength, k, rng.uniform(-PITCH / 2, PITCH / 2, 3)])
    mesh = moved(SQUARE_MESH, shift)
    u = field(mesh, waves)
    found = mode_family(mesh, SQUARE * TWO, u + np.array([0.5, 2.0]), PITCH, shared=False)
    assert len(found.waves) == 3
    assert_is_field(found, mesh, u)
    for wave in waves:
        match = found.waves[np.abs(found.waves[:, 2:4] - wave[2:4]).max(axis=1).argmin()]
        got, want = found.amplitude * match[:2], wave[:2]
        turns = (match[4] - wave[4]) / PITCH
        np.testing.assert_allclose(match[2:4], wave[2:4], atol=1e-9)
        assert turns == pytest.approx(round(turns), abs=10 * INTERPOLATION)
        np.testing.assert_allclose(got * (-1) ** round(turns), want, atol=10 * INTERPOLATION)


def test_amplitudes_converge_with_the_mesh() -> None:
    """At least with the third power of the element size, as quadratic shape functions do."""
    waves = np.array([[1.0, 0.2, 1, 0, 0.3], [0.4, -0.7, 1, 2, -0.1]])
    errors = []
    for divisions in (4, 8, 16):
        mesh = holed_cell(SQUARE, divisions, (2, 2))
        found = mode_family(mesh, SQUARE * TWO, field(mesh, waves), PITCH, shared=False)
        recovered = found.waves[np.argsort(found.waves[:, 3])]
        recovered[:, :2] *= found.amplitude
        errors.append(np.abs(recovered - waves).max())
    rates = -np.diff(np.log2(errors))
    assert np.all(rates > 2.7), (errors, rates)


def test_flower_is_three_tied_waves() -> None:
    """All move across their wave vectors and equally far: only wave vectors and phases are free."""
    found = mode_family(HEXAGONAL_MESH, OBLIQUE * TWO, field(HEXAGONAL_MESH, M_WAVES), PITCH)
    assert_is_field(found, HEXAGONAL_MESH, field(HEXAGONAL_MESH, M_WAVES))
    # 15 numbers; the three L are zero, the three T are one, and held.
    assert found.family.size == 15 - 6
    assert all(name[0] in "kc" for name in found.family.names)
    assert found.family.units == ("-",) * 6 + ("mm",) * 3
    assert "transverse" in found.text[0]
    assert "Zero within 2 %: L1,2,3." in found.text


def test_rotations_and_mirrors_tie_both_components() -> None:
    """|L| and |T| are one parameter each, whether three waves are turned or two are mirrored."""
    for angles, mirrored in ((M_ANGLES, False), (M_ANGLES[[0, 2]], True)):
        waves = []
        for number, t in enumerate(angles):
            sign = -1.0 if mirrored and number else 1.0
            turn = np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])
            waves.append([*(np.array([0.4, sign]) @ turn), *(2 / np.sqrt(3) * turn[0]), 0.0])
        u = field(HEXAGONAL_MESH, np.array(waves))
        found = mode_family(HEXAGONAL_MESH, OBLIQUE * TWO, u, PITCH)
        assert_is_field(found, HEXAGONAL_MESH, u)
        count = len(waves)
        assert found.family.size == 1 + 3 * count
        assert found.family.names[0] == "L" + ",".join(str(w + 1) for w in range(count))
        assert found.family.start[0] == pytest.approx(0.4, abs=5 * INTERPOLATION)


def test_what_differs_stays_free() -> None:
    """Three M waves of different strengths: nothing is tied."""
    waves = M_WAVES * np.array([[1.0], [0.8], [0.6]]) ** [1, 1, 0, 0, 0]
    found = mode_family(HEXAGONAL_MESH, OBLIQUE * TWO, field(HEXAGONAL_MESH, waves), PITCH)
    assert_is_field(found, HEXAGONAL_MESH, field(HEXAGONAL_MESH, waves))
    assert found.family.size == 15 - 4  # three L are zero, the largest T is held
    assert not any("is the same" in message for message in found.text)


def test_components_out_of_phase_become_two_waves() -> None:
    """A rotating wave, as a cell without inversion centre may have: one k, two phases."""
    waves = np.array([[1.0, 0.0, 2, 0, 0.1], [0.0, 0.7, 2, 0, 0.1 + PITCH / 2]])
    u = field(SQUARE_MESH, waves)
    found = mode_family(SQUARE_MESH, SQUARE * TWO, u, PITCH)
    assert_is_field(found, SQUARE_MESH, u - u.mean(axis=0) + found_mean(found, u))
    assert found.family.names == ("T2", "kx1", "ky1", "c1", "c2")
    k = found.family.matrix[:, 1].reshape(-1, 5)
    assert np.array_equal(k, [[0, 0, 1, 0, 0], [0, 0, 1, 0, 0]])
    assert any("out of phase" in message for message in found.text)


def found_mean(found: FoundFamily, u: np.ndarray) -> np.ndarray:
    """Mean of the evaluated family over the nodes: waves with the holes' period have one."""
    return evaluated(found, SQUARE_MESH).mean(axis=0)


def test_number_of_waves_follows_growth() -> None:
    """A star that explains 2 % is left out by default and taken when asked for."""
    waves = np.array([[1.0, 1.0, 1, 1, 0.0], [0.15, -0.15, 1, -3, 0.4]])
    u = field(SQUARE_MESH, waves)
    few = mode_family(SQUARE_MESH, SQUARE * TWO, u, PITCH)
    more = mode_family(SQUARE_MESH, SQUARE * TWO, u, PITCH, growth=0.005)
    assert len(few.waves) == 1
    assert len(more.waves) == 2
    assert few.captured < 0.99 < 0.9999 < more.captured
    assert few.growth == more.growth
    assert few.growth[0] == (1, pytest.approx(few.captured, abs=1e-3))
    counts, shares = zip(*more.growth, strict=True)
    assert np.all(np.diff(counts) > 0)
    assert np.all(np.diff(shares) > 0)
    with pytest.raises(InputError, match="growth"):
        mode_family(SQUARE_MESH, SQUARE * TWO, u, PITCH, growth=1.5)


def test_tied_and_free_families_start_from_the_same_field() -> None:
    tied = mode_family(HEXAGONAL_MESH, OBLIQUE * TWO, field(HEXAGONAL_MESH, M_WAVES), PITCH)
    free = mode_family(
        HEXAGONAL_MESH, OBLIQUE * TWO, field(HEXAGONAL_MESH, M_WAVES), PITCH, shared=False
    )
    assert free.family.size == 5 * 3 - 1
    difference = evaluated(tied, HEXAGONAL_MESH) - evaluated(free, HEXAGONAL_MESH)
    assert np.abs(difference).max() < 5 * INTERPOLATION
    assert "14 parameters: all wave vectors and phases, and five amplitudes" in free.text[-1]


def test_captured_is_the_square_of_the_overlap() -> None:
    u = field(SQUARE_MESH, [[1.0, 0.5, 1, 1, 0.0], [0.3, 0.1, 1, 3, 0.2]])
    found = mode_family(SQUARE_MESH, SQUARE * TWO, u, PITCH, growth=0.5)
    assert overlap(SQUARE_MESH, u, found.family, PITCH) ** 2 == pytest.approx(found.captured)
    assert found.captured == pytest.approx(found.growth[0][1], abs=1e-4)


@SETTINGS
@given(st.integers(0, 999), st.floats(-5, 5).filter(lambda a: abs(a) > 0.01))
def test_overlap_is_normalised(seed: int, factor: float) -> None:
    """Between 0 and 1; the same whatever the field's scale and translation; 1 for itself."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(2, 5))
    waves[:, 2:4] = [[1, 1], [1, -1]]
    u, family = field(SQUARE_MESH, waves), square_family("hole")
    value = overlap(SQUARE_MESH, u, family, PITCH)
    assert 0 <= value <= 1
    assert overlap(SQUARE_MESH, factor * u + np.array([3.0, -1.0]), family, PITCH) == pytest.approx(
        value
    )
    own = overlap(SQUARE_MESH, u, free_family(waves), PITCH)
    assert own == pytest.approx(1.0, abs=1e-5)


def test_modes_of_different_wave_vectors_are_orthogonal() -> None:
    """Over the material of whole cells, for vectors that differ by no vector of the holes."""
    patterns = [[1.0, -1.0, 1, 1, 0.3], [1.0, 0.0, 1, 0, 0.1], [0.0, 1.0, 0, 1, 0.0]]
    for pattern in patterns:
        for other in patterns:
            value = overlap(SQUARE_MESH, field(SQUARE_MESH, pattern), free_family(other), PITCH)
            assert value == pytest.approx(1.0 if other is pattern else 0.0, abs=1e-5)
    # The pattern at a junction is the one at a hole moved by a cell, which is another one.
    u = square_mode([1, 1, 1, -1, 1, 0, 0], PITCH, *SQUARE_MESH.nodes.T)
    assert overlap(SQUARE_MESH, u, square_family("hole"), PITCH) < 1e-12


def test_bad_fields_are_named() -> None:
    u = field(SQUARE_MESH, M_WAVES)
    for values, words in ((u[1:], "shape"), (0 * u, "zero"), (np.full_like(u, np.inf), "finite")):
        with pytest.raises(InputError, match=words):
            overlap(SQUARE_MESH, values, square_family(), PITCH)
    with pytest.raises(InputError, match="affine"):
        mode_family(SQUARE_MESH, SQUARE * TWO, SQUARE_MESH.nodes, PITCH)
