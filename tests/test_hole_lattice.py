"""Lattices found from holes against the lattices the holes were put on."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from modeharvest.idic.photograph.holes import (
    HoleLattice,
    Holes,
    find_hole_lattice,
    find_holes,
    lattice_of,
)
from modeharvest.idic.photograph.matching.holes import possible_motions, rigid_motion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def holes_at(centres: FloatArray, diameter: float = 94.0) -> Holes:
    n = len(centres)
    return Holes(centres, np.full(n, diameter), too_small=0, at_border=1)


def lattice_points(vectors: FloatArray, counts: tuple[int, int]) -> FloatArray:
    """(n, 2) (row, col) from lattice vectors in (right, up)."""
    i, j = np.meshgrid(*map(np.arange, counts), indexing="ij")
    right, up = (np.stack([i.ravel(), j.ravel()], axis=-1) @ vectors).T
    return np.column_stack([3000.0 - up, 500.0 + right])


def turned(degrees: float) -> FloatArray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s], [-s, c]])


SQUARE = 190.0 * np.eye(2)
HEXAGONAL = 150.0 * np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])


@given(
    degrees=st.floats(-29.0, 29.0),
    scatter=st.floats(0.0, 5.0),
    hexagonal=st.booleans(),
    seed=st.integers(0, 99),
)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_lattice_is_found_turned_scattered_and_with_holes_missing(
    degrees: float, scatter: float, hexagonal: bool, seed: int
) -> None:
    random = np.random.default_rng(seed)
    vectors = (HEXAGONAL if hexagonal else SQUARE) @ turned(degrees)
    all_points = lattice_points(vectors, (9, 7))
    gone = random.choice(63, size=4, replace=False)
    points = np.delete(all_points, gone, axis=0)
    debris = all_points[gone[0]] + 0.45 * 150.0  # between four holes
    moved = points + random.normal(0.0, scatter, points.shape)
    order = random.permutation(len(points) + 1)
    found = lattice_of(holes_at(np.vstack([moved, debris])[order]))

    assert found.kind == ("hexagonal" if hexagonal else "square")
    assert len(found) == 59
    assert len(found.extra) == 1
    assert len(found.missing) <= 4  # corners may be gone, which none can miss
    # 59 holes on two counts of 7 and more: sd of a vector is scatter / sqrt(59 * 4) at most.
    area = abs(np.linalg.det(found.vectors))
    assert area == pytest.approx(abs(np.linalg.det(vectors)), rel=0.01)
    assert found.misfit_px < 1.6 * scatter + 1e-6
    np.testing.assert_allclose(found.position(found.index), found.centres, atol=5 * scatter + 1e-6)


@given(degrees=st.floats(-40.0, 40.0))
@settings(max_examples=10, deadline=None, derandomize=True)
def test_i_counts_to_the_right_and_j_upwards(degrees: float) -> None:
    found = lattice_of(holes_at(lattice_points(SQUARE @ turned(degrees), (5, 4))))
    (up_i, right_i), (up_j, right_j) = found.vectors * (-1.0, 1.0)
    assert right_i > abs(up_i)
    assert up_j > abs(right_j)
    assert found.counts == (5, 4)
    assert found.rotation_deg == pytest.approx(degrees, abs=1e-6)


def test_more_specks_than_holes_change_nothing() -> None:
    material = np.ones((500, 500), dtype=bool)
    row, col = np.mgrid[:500, :500]
    for i in range(3):
        for j in range(3):
            material &= np.hypot(row - 100.25 - 150 * i, col - 100.0 - 150 * j) > 40.0
    clean = find_hole_lattice(material)
    random = np.random.default_rng(0)
    for r, c in random.integers(4, 496, size=(60, 2)):
        material[r : r + 3, c : c + 3] = False
    specked = find_hole_lattice(material)
    assert len(specked) == len(clean) == 9
    # A speck of 9 px at a hole's edge moves the centre of 5000 px by 9 * 40 / 5000 px.
    np.testing.assert_allclose(specked.centres, clean.centres, atol=0.3)
    assert "smaller openings" in specked.text[-1]


@pytest.mark.parametrize("radius", [20.0, 40.3])
def test_centres_and_diameters_are_found_to_a_fraction_of_a_pixel(radius: float) -> None:
    row, col = np.mgrid[:300, :300]
    truth = np.array([(80.3, 90.7), (80.9, 210.2), (200.5, 88.8), (205.1, 214.6)])
    material = np.ones((300, 300), dtype=bool)
    for r, c in truth:
        material &= np.hypot(row - r, col - c) > radius
    holes = find_holes(material)
    order = np.lexsort([holes.centres[:, 1] > 150, holes.centres[:, 0] > 150])
    # A digitised disk's boundary px err independently: r * sqrt(2 pi r / 12) / (pi r^2).
    sd = np.sqrt(2 * np.pi * radius / 12) / (np.pi * radius)
    np.testing.assert_allclose(holes.centres[order], truth, atol=5 * sd)
    np.testing.assert_allclose(holes.diameters, 2 * radius, atol=10 * sd)


def test_openings_at_the_border_are_no_holes() -> None:
    material = np.ones((60, 60), dtype=bool)
    material[:10, :10] = material[20:30, 20:30] = False
    holes = find_holes(material)
    assert (len(holes), holes.at_border) == (1, 1)
    np.testing.assert_allclose(holes.centres, [[24.5, 24.5]])


def test_masks_without_a_lattice_are_refused() -> None:
    random = np.random.default_rng(1)
    scattered = random.uniform(0, 3000, size=(80, 2))
    row = np.column_stack([np.full(8, 100.0), 190.0 * np.arange(8)])
    strip = np.array([(720.0, 1035.0), (1190.0, 600.0), (1615.0, 1120.0)])  # a real foam strip's
    for centres in (scattered, row, strip):
        with pytest.raises(InputError, match="no lattice in it"):
            lattice_of(holes_at(centres))
    for mask in (np.ones((50, 50)), np.zeros((50, 50))):
        with pytest.raises(InputError, match="nothing in it"):
            find_hole_lattice(mask)


@pytest.mark.parametrize("factor", [2e-4, 0.5, 0.85, 1.0, 1.2, np.sqrt(2.0)])
def test_a_wrong_cell_size_is_contradicted(factor: float) -> None:
    holes = holes_at(lattice_points(SQUARE, (6, 10)))
    if factor == 1.0:
        lattice_of(holes, cell_px=190.0)
        return
    words = re.escape(f"got {190.0 * factor:.3g} px ({100 * factor - 100:+.0f} %)")
    with pytest.raises(InputError, match=words):
        lattice_of(holes, cell_px=190.0 * factor)


def test_the_cell_size_of_a_rectangular_lattice_is_its_shorter_distance() -> None:
    holes = holes_at(lattice_points(np.diag([190.0, 250.0]), (6, 10)))
    found = lattice_of(holes, cell_px=190.0)
    assert found.kind == "rectangular"
    np.testing.assert_allclose(np.sort(np.linalg.norm(found.vectors, axis=1)), [190.0, 250.0])
    for wrong in (220.0, 250.0):  # their mean, too
        with pytest.raises(InputError, match=r"expected a cell size near 190\.0 px"):
            lattice_of(holes, cell_px=wrong)


def bent(points: FloatArray, strain: float, shift: float) -> FloatArray:
    """Compressed along the columns most in the middle, bulging, moved (row, col) [px]."""
    middle = points.mean(axis=0)
    row, col = ((points - middle) / np.ptp(points, axis=0)).T  # -0.5 ... 0.5
    width, height = np.ptp(points, axis=0)[::-1]
    u_col = -strain * width * (col + 0.05 * np.sin(2 * np.pi * col)) + shift
    u_row = 0.3 * strain * height * row * (1.0 - 4.0 * col**2)
    return points + np.column_stack([u_row, u_col])


@given(
    strain=st.floats(0.0, 0.14),
    shift=st.floats(-300.0, 300.0),
    degrees=st.floats(-3.0, 3.0),
    seed=st.integers(0, 99),
)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_the_same_holes_are_found_however_far_they_moved(
    strain: float, shift: float, degrees: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    points = lattice_points(SQUARE @ turned(degrees), (12, 10))
    after = bent(points, strain, shift)
    keep, keep_after = (random.random(120) > 0.03 for _ in range(2))  # some are not seen
    keep[[0, 9, 110, 119]] = keep_after[[0, 9, 110, 119]] = True
    order = random.permutation(int(keep_after.sum()))
    (motion, *_) = possible_motions(
        lattice_of(holes_at(points[keep])), lattice_of(holes_at(after[keep_after][order]))
    )
    assert len(motion) == (keep & keep_after).sum()
    np.testing.assert_allclose(motion.after, bent_of(points, after, motion.before), atol=1e-9)
    assert motion.rivals == 0


def bent_of(points: FloatArray, after: FloatArray, before: FloatArray) -> FloatArray:
    nearest = np.argmin(np.linalg.norm(points[:, None] - before, axis=-1), axis=0)
    return np.asarray(after[nearest])


def test_rivals_are_reported_when_a_column_left_the_image() -> None:
    points = lattice_points(SQUARE, (6, 10))
    reference = lattice_of(holes_at(points))
    cut = lattice_of(holes_at(points[10:] - (0.0, 30.0)))
    motions = possible_motions(reference, cut)
    assert motions[0].rivals == 1
    np.testing.assert_allclose(motions[0].after - motions[0].before, [[0.0, -30.0]] * 50)
    np.testing.assert_allclose(motions[1].after - motions[1].before, [[0.0, 160.0]] * 50)
    assert "2 ways" in motions[0].text[1]


@pytest.mark.parametrize("counts", [(2, 2), (2, 3), (3, 4), (4, 5), (8, 7)])
def test_a_pattern_does_not_turn_the_specimen(counts: tuple[int, int]) -> None:
    points = lattice_points(SQUARE, counts)
    i, j = np.rint((points - points.min(axis=0)) / SQUARE.max()).T
    states = np.array([[0.93, 0.0], [0.0, 1.02]]), np.outer((-1.0) ** (i + j), (3.0, -5.0))
    after = (points @ states[0] + states[1]) @ turned(7.0) + 20.0
    motion = rigid_motion(lattice_of(holes_at(points)), lattice_of(holes_at(after)))
    assert motion.angle_deg == pytest.approx(7.0, abs=1e-9)


def test_motion_in_mm_has_y_upwards() -> None:
    points = lattice_points(SQUARE, (4, 4))
    (motion, *_) = possible_motions(
        lattice_of(holes_at(points)), lattice_of(holes_at(points + np.array([20.0, 10.0])))
    )
    moved = motion.in_mm(PixelGrid.centred(4000, 2000, 0.01))
    np.testing.assert_allclose(moved.u, [[0.1, -0.2]] * 16, atol=1e-12)


def test_another_specimen_is_no_match() -> None:
    square, hexagonal = (
        lattice_of(holes_at(lattice_points(v, (6, 6)))) for v in (SQUARE, 0.5 * HEXAGONAL)
    )
    with pytest.raises(InputError, match="is the reference the reference"):
        possible_motions(square, hexagonal)


def test_a_lattice_repeats_its_positions() -> None:
    found: HoleLattice = lattice_of(holes_at(lattice_points(HEXAGONAL, (6, 6))))
    np.testing.assert_allclose(found.position([(0.0, 0.0)])[0], found.origin)
    assert found.pitch_px == pytest.approx(150.0)
