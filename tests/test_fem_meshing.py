"""The specimen's mesh: symmetric, conforming, curved where it should be, and sound."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.field import Mesh
from modeharvest.fem.meshing import mesh_specimen, perturb
from modeharvest.fem.specimen import Imperfection, Specimen
from modeharvest.util.errors import InputError

SMALL = Specimen(holes_x=3, holes_y=2)
CASES = [
    (SMALL, 0.25),
    (Specimen(2, 2, bulk_x=0.0, bulk_y=0.0), 0.2),
    (Specimen(1, 3, diameter=0.5, pitch=2.0, bulk_x=0.7, bulk_y=0.0), 0.15),
    (Specimen(5, 4, diameter=1.1, pitch=1.386, bulk_x=0.31), 0.2),
    (Specimen(2, 3, stacking="rectangular", pitch_y=2.3, bulk_x=0.4), 0.25),
    (Specimen(3, 2, diameter=1.6, diameter_y=1.0), 0.2),
    (Specimen(3, 3, diameter=1.28, pitch=1.386, stacking="triangular", bulk_x=0.5), 0.2),
    (Specimen(2, 5, stacking="triangular", bulk_x=0.0, bulk_y=0.0), 0.25),
    (Specimen(4, 1, diameter=1.3, diameter_y=1.8, stacking="triangular"), 0.25),
]
cases = pytest.mark.parametrize(("specimen", "size"), CASES)
GRADED = Specimen(4, 3, diameter=1.4, grading_x=0.08, bulk_x=0.5)

few = settings(max_examples=8, deadline=None, derandomize=True)


def shape_gradients(xi: float, eta: float) -> NDArray[np.float64]:
    """(6, 2) derivatives of the T6 shape functions, corners then mid-sides 01, 12, 20."""
    z = 1.0 - xi - eta
    return np.array(
        [
            [1 - 4 * z, 1 - 4 * z],
            [4 * xi - 1, 0.0],
            [0.0, 4 * eta - 1],
            [4 * (z - xi), -4 * xi],
            [4 * eta, 4 * xi],
            [-4 * eta, 4 * (z - eta)],
        ]
    )


def jacobians(mesh: Mesh) -> NDArray[np.float64]:
    """(m, 6) Jacobian determinants at the nodes of every cell.

    The determinant is quadratic over the cell, so it is given by these values.
    """
    points = [(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)]
    gradients = np.array([shape_gradients(*p) for p in points])
    matrices = np.einsum("pna,mnb->mpab", gradients, mesh.nodes[mesh.cells])
    return np.asarray(np.linalg.det(matrices))


def smallest_bernstein(mesh: Mesh) -> float:
    """The smallest Bernstein coefficient of the determinants: a lower bound everywhere."""
    at = jacobians(mesh)
    sides = [2 * at[:, 3 + k] - 0.5 * (at[:, k] + at[:, (k + 1) % 3]) for k in range(3)]
    return float(min(at[:, :3].min(), *(side.min() for side in sides)))


def area(mesh: Mesh) -> float:
    """The isoparametric area; the mean of the mid-side values integrates a quadratic exactly."""
    return float(jacobians(mesh)[:, 3:].mean(axis=1).sum() / 2)


def rows(array: NDArray[Any]) -> list[Any]:
    """The rows as tuples, which can be compared and looked up."""
    return [tuple(row.tolist()) for row in array]


def edges(mesh: Mesh) -> dict[tuple[int, int, int], int]:
    """(corner, corner, mid-side) of every edge and how many cells share it."""
    count: Counter[tuple[int, int, int]] = Counter()
    for k in range(3):
        ends = np.sort(mesh.cells[:, [k, (k + 1) % 3]], axis=1)
        count.update(rows(np.column_stack([ends, mesh.cells[:, 3 + k]])))
    return dict(count)


def on_outer_edge(points: NDArray[np.float64], specimen: Specimen) -> NDArray[np.bool_]:
    return np.asarray(np.any(np.abs(np.abs(points) - specimen.half_size) < 1e-12, axis=-1))


def on_hole(points: NDArray[np.float64], specimen: Specimen) -> NDArray[np.bool_]:
    arms = (points[:, None] - specimen.hole_centres) / [1.0, specimen.aspect]
    off = np.abs(np.linalg.norm(arms, axis=-1) - 0.5 * specimen.diameters)
    return np.asarray(np.min(off, axis=1) < 1e-12)


@cases
def test_both_mirror_symmetries_hold_to_the_last_bit(specimen: Specimen, size: float) -> None:
    mesh = mesh_specimen(specimen, size)
    number = {point: k for k, point in enumerate(rows(mesh.nodes))}
    cells = {frozenset(cell) for cell in rows(mesh.cells)}
    for sign in ((-1.0, 1.0), (1.0, -1.0)):
        # "+ 0.0" turns -0.0 into 0.0, which is the same number but another key.
        image = np.array([number[point] for point in rows(mesh.nodes * sign + 0.0)])
        assert {frozenset(cell) for cell in rows(image[mesh.cells])} == cells


@cases
def test_mesh_is_conforming_without_doubled_nodes(specimen: Specimen, size: float) -> None:
    mesh = mesh_specimen(specimen, size)
    assert not cKDTree(mesh.nodes).query_pairs(1e-6)
    assert np.array_equal(np.unique(mesh.cells), np.arange(len(mesh.nodes)))
    shared = edges(mesh)
    # The mid-side is part of the key: two cells that disagree on it would count one each.
    assert set(shared.values()) == {1, 2}
    boundary = np.array([edge for edge, count in shared.items() if count == 1])
    outer = on_outer_edge(mesh.nodes[boundary.ravel()], specimen).reshape(-1, 3).all(axis=1)
    hole = on_hole(mesh.nodes[boundary.ravel()], specimen).reshape(-1, 3).all(axis=1)
    assert np.all(outer ^ hole)
    # Euler: corners - edges + cells = 1 - holes, in one piece.
    corners = len(np.unique(mesh.cells[:, :3]))
    assert corners - len(shared) + len(mesh.cells) == 1 - len(specimen.hole_centres)


@cases
def test_material_is_the_rectangle_without_the_holes(specimen: Specimen, size: float) -> None:
    a, b = specimen.half_size
    exact = 4 * a * b - 0.25 * np.pi * specimen.aspect * np.sum(specimen.diameters**2)
    # Parabolas through three points of a circle: h^4 / 720 r^3 a length, with h up to 0.25.
    assert area(mesh_specimen(specimen, size)) == pytest.approx(exact, rel=1e-4)


def test_an_even_number_of_triangular_rows_is_symmetric_about_the_y_axis_only() -> None:
    specimen = Specimen(3, 4, stacking="triangular")
    assert specimen.row_counts.tolist() == [3, 2, 3, 2]
    places = set(rows(mesh_specimen(specimen, 0.25).nodes))
    assert {(-x + 0.0, y) for x, y in places} == places
    assert {(x, -y + 0.0) for x, y in places} != places


@pytest.mark.parametrize("specimen", [case[0] for case in CASES])
def test_every_point_of_a_cell_is_nearest_to_its_hole(specimen: Specimen) -> None:
    a, b = specimen.cellular_half_size
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (2000, 2)) * (a, b)
    arms = (points[:, None] - specimen.hole_centres) / [1.0, specimen.aspect]
    distance = np.linalg.norm(arms, axis=-1)
    found = distance[np.arange(len(points)), specimen.nearest_hole(points)]
    np.testing.assert_allclose(found, distance.min(axis=1), rtol=1e-12)


@cases
def test_jacobians_are_positive_everywhere(specimen: Specimen, size: float) -> None:
    assert smallest_bernstein(mesh_specimen(specimen, size)) > 0.0


def test_interior_edges_are_straight() -> None:
    mesh = mesh_specimen(SMALL, 0.25)
    a, b, middle = np.array([e for e, count in edges(mesh).items() if count == 2]).T
    np.testing.assert_allclose(
        mesh.nodes[middle], 0.5 * (mesh.nodes[a] + mesh.nodes[b]), rtol=0, atol=1e-10
    )


def test_area_converges_with_order_four() -> None:
    """A parabola through three points of a circle misses h^4; straight edges would give h^2."""
    a, b = SMALL.half_size
    exact = 4 * a * b - SMALL.holes_x * SMALL.holes_y * np.pi * (0.5 * SMALL.diameter) ** 2
    # Divisions of the quarter circle: 2, 4, 8.
    quarter = 0.25 * np.pi * SMALL.diameter
    errors = [abs(area(mesh_specimen(SMALL, quarter / n)) - exact) for n in (2, 4, 8)]
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(rates, 4.0, atol=0.1)


@few
@given(
    holes_x=st.integers(1, 3),
    holes_y=st.integers(1, 3),
    diameter=st.floats(0.3, 1.7),
    bulk_x=st.sampled_from([0.0, 0.3, 1.9]),
    bulk_y=st.sampled_from([0.0, 0.9]),
)
def test_any_specimen_is_meshed_soundly(
    holes_x: int, holes_y: int, diameter: float, bulk_x: float, bulk_y: float
) -> None:
    specimen = Specimen(holes_x, holes_y, diameter, 1.9, bulk_x, bulk_y)
    mesh = mesh_specimen(specimen, min(0.3, 0.19 * diameter))
    assert smallest_bernstein(mesh) > 0.0
    assert not cKDTree(mesh.nodes).query_pairs(1e-6)
    boundary = np.array([edge for edge, count in edges(mesh).items() if count == 1]).ravel()
    points = mesh.nodes[boundary]
    assert np.all(on_outer_edge(points, specimen) | on_hole(points, specimen))


def test_element_sizes_follow_the_size_asked_for() -> None:
    for size in (0.25, 0.1):
        mesh = mesh_specimen(SMALL, size)
        a, b, _ = np.array(list(edges(mesh))).T
        lengths = np.linalg.norm(mesh.nodes[a] - mesh.nodes[b], axis=1)
        assert 0.4 * size < np.median(lengths) <= size


def test_pattern_is_that_of_the_paper_about_a_junction() -> None:
    specimen = Specimen()
    # With even numbers of holes the origin is a junction between four holes.
    x, y = np.random.default_rng(0).uniform(-3, 3, (2, 20))
    expected = np.column_stack(
        [
            -np.cos(np.pi * x / specimen.pitch) * np.sin(np.pi * y / specimen.pitch),
            np.sin(np.pi * x / specimen.pitch) * np.cos(np.pi * y / specimen.pitch),
        ]
    )
    got = specimen.pattern(np.column_stack([x, y]))
    sign = np.sign(np.sum(got * expected))
    np.testing.assert_allclose(got, sign * expected, atol=1e-12)


def test_grading_gives_every_hole_its_diameter() -> None:
    specimen = Specimen(3, 2, diameter=1.0, pitch=2.0, grading_x=0.1, grading_y=-0.2)
    expected = {(x, y): 1.0 + 0.1 * x - 0.2 * y for x in (-2.0, 0.0, 2.0) for y in (-1.0, 1.0)}
    assert dict(zip(rows(specimen.hole_centres), specimen.diameters, strict=True)) == pytest.approx(
        expected
    )
    mesh = mesh_specimen(specimen, 0.2)
    for centre, diameter in expected.items():
        distance = np.linalg.norm(mesh.nodes - centre, axis=1)
        assert distance.min() == pytest.approx(0.5 * diameter, rel=1e-12)
        # Twice as many nodes as elements of at most 0.2 mm on each quarter of the edge.
        on_edge = np.sum(np.abs(distance - 0.5 * diameter) < 1e-12)
        assert on_edge == 8 * np.ceil(0.25 * np.pi * diameter / 0.2)


def test_a_graded_mesh_is_sound_and_has_the_mirror_symmetry_that_is_left() -> None:
    mesh = mesh_specimen(GRADED, 0.25)
    assert smallest_bernstein(mesh) > 0.0
    assert not cKDTree(mesh.nodes).query_pairs(1e-6)
    shared = edges(mesh)
    boundary = np.array([edge for edge, count in shared.items() if count == 1]).ravel()
    points = mesh.nodes[boundary]
    assert np.all(on_outer_edge(points, GRADED) | on_hole(points, GRADED))
    places = set(rows(mesh.nodes))
    assert set(rows(mesh.nodes * [1.0, -1.0] + 0.0)) == places
    assert set(rows(mesh.nodes * [-1.0, 1.0] + 0.0)) != places
    a, b = GRADED.half_size
    exact = 4 * a * b - 0.25 * np.pi * np.sum(GRADED.diameters**2)
    # Parabolas through three points of a circle: h^4 / 720 r^3 a length, with h up to 0.25.
    assert area(mesh) == pytest.approx(exact, rel=1e-4)


def test_scatter_of_a_graded_specimen_leaves_its_edges_and_topology() -> None:
    mesh = mesh_specimen(GRADED, 0.25)
    scattered = perturb(mesh, GRADED, Imperfection(0.005, 0.005, seed=3))
    outer = on_outer_edge(mesh.nodes, GRADED)
    assert np.array_equal(scattered.nodes[outer], mesh.nodes[outer])
    assert smallest_bernstein(scattered) > 0.0
    for centre, diameter in zip(GRADED.hole_centres, GRADED.diameters, strict=True):
        hole_edge = np.abs(np.linalg.norm(mesh.nodes - centre, axis=1) - 0.5 * diameter) < 1e-12
        points = scattered.nodes[hole_edge] - centre
        system = np.column_stack([2 * points, np.ones(len(points))])
        square = np.sum(points**2, axis=1)
        solution, *_ = np.linalg.lstsq(system, square)
        np.testing.assert_allclose(system @ solution, square, rtol=0, atol=1e-12)


def test_scatter_moves_holes_but_neither_edges_nor_topology() -> None:
    mesh = mesh_specimen(SMALL, 0.2)
    scattered = perturb(mesh, SMALL, Imperfection(0.01, 0.02, seed=3))
    assert np.array_equal(scattered.cells, mesh.cells)
    outer = on_outer_edge(mesh.nodes, SMALL)
    assert np.array_equal(scattered.nodes[outer], mesh.nodes[outer])
    assert smallest_bernstein(scattered) > 0.0
    for centre in SMALL.hole_centres:
        hole_edge = np.abs(np.linalg.norm(mesh.nodes - centre, axis=1) - 0.75) < 1e-12
        # Least squares circle: |p|^2 = 2 p . c + (r^2 - |c|^2) is exact for a circle.
        points = scattered.nodes[hole_edge] - centre
        system = np.column_stack([2 * points, np.ones(len(points))])
        square = np.sum(points**2, axis=1)
        solution, *_ = np.linalg.lstsq(system, square)
        np.testing.assert_allclose(system @ solution, square, rtol=0, atol=1e-12)
        assert 1e-5 < np.linalg.norm(solution[:2]) < 0.05


def test_holes_that_are_not_round_are_ellipses() -> None:
    mesh, scatter = mesh_specimen(SMALL, 0.2), Imperfection(0.005, 0.01, seed=3, ovality_sd=0.03)
    scattered = perturb(mesh, SMALL, scatter)
    assert smallest_bernstein(scattered) > 0.0
    for centre, off in zip(SMALL.hole_centres, scatter.drawn(len(SMALL.hole_centres)), strict=True):
        hole_edge = np.abs(np.linalg.norm(mesh.nodes - centre, axis=1) - 0.75) < 1e-12
        x, y, growth, along_x, along_diagonal = off
        axes = np.array([[along_x, along_diagonal], [along_diagonal, -along_x]])
        axes += (1.5 + growth) * np.eye(2)
        arms = (scattered.nodes[hole_edge] - centre - (x, y)) @ np.linalg.inv(0.5 * axes)
        np.testing.assert_allclose(np.linalg.norm(arms, axis=1), 1.0, rtol=0, atol=1e-12)
        values, vectors = np.linalg.eigh(axes)
        longest = np.arctan2(vectors[1, 1], vectors[0, 1])
        assert np.cos(2.0 * longest - np.arctan2(along_diagonal, along_x)) == pytest.approx(1.0)
        assert np.ptp(values) == pytest.approx(2.0 * np.hypot(along_x, along_diagonal))
    without = replace(scatter, ovality_sd=0.0).drawn(len(SMALL.hole_centres))
    np.testing.assert_array_equal(scatter.drawn(len(without))[:, :3], without[:, :3])


def test_no_scatter_leaves_the_mesh_as_it_is() -> None:
    mesh = mesh_specimen(SMALL, 0.29)
    assert perturb(mesh, SMALL, Imperfection(seed=3)) is mesh


def test_scatter_has_the_stated_deviation_and_seed() -> None:
    specimen = Specimen(12, 10)
    mesh = mesh_specimen(specimen, 0.29)
    deviation = 0.01
    scattered = perturb(mesh, specimen, Imperfection(position_sd=deviation, seed=1))
    hole_edge = on_hole(mesh.nodes, specimen)
    moved = (scattered.nodes - mesh.nodes)[hole_edge]
    # 240 coordinates: their standard deviation is known to 1/sqrt(480) = 4.6 %; three of these.
    assert np.std(moved) == pytest.approx(deviation, rel=0.14)
    again = perturb(mesh, specimen, Imperfection(position_sd=deviation, seed=1))
    other = perturb(mesh, specimen, Imperfection(position_sd=deviation, seed=2))
    assert np.array_equal(again.nodes, scattered.nodes)
    assert not np.array_equal(other.nodes, scattered.nodes)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Specimen(diameter=2.0), r"0 < diameter < pitch.*got diameter = 2.0 mm"),
        (lambda: Specimen(diameter=1.9), "0 < diameter < pitch"),
        (lambda: Specimen(diameter=-1.0), "0 < diameter < pitch"),
        (lambda: Specimen(holes_x=0), "1 x 1 to 1000 x 1000 holes, got 0 x 10"),
        (lambda: Specimen(bulk_x=-0.1), "bulk edges of 0 mm or more"),
        (lambda: Specimen(diameter=float("nan")), "0 < diameter < pitch"),
        (lambda: Specimen(bulk_y=float("nan")), "bulk edges of 0 mm or more"),
        (lambda: Specimen(pitch=float("inf")), "finite"),
        (lambda: Specimen(grading_x=0.1), r"0 < d < 1.9 mm.*got d from 1.025 to 1.975 mm"),
        (lambda: Specimen(grading_y=-0.2), "0 < d < 1.9 mm"),
        (lambda: Specimen(stacking="rectangular"), "a pitch_y for rectangular stacking, got None"),
        (lambda: Specimen(pitch_y=2.0), "no pitch_y for square stacking, got 2.0"),
        (lambda: Specimen(stacking="hexagonal"), "a stacking among .*'triangular'.*'hexagonal'"),
        (lambda: Specimen(stacking="rectangular", pitch_y=1.4), "0 < d < 1.4 mm, of every hole"),
        (lambda: Specimen(diameter_y=2.0), "0 < d < 1.425 mm, of every hole"),
        (lambda: Specimen(diameter_y=-1.0), "positive pitch_y and diameter_y"),
        (lambda: Specimen(1, 2, stacking="triangular"), "2 or more holes_x"),
        (
            lambda: Specimen(diameter=1.0, diameter_y=1.8, stacking="triangular"),
            "diameter_y < 1.732 diameter in triangular stacking",
        ),
        (lambda: Specimen(grading_x=float("nan")), "got d from nan"),
        (
            lambda: perturb(mesh_specimen(GRADED, 0.25), GRADED, Imperfection(0.05)),
            "<= 0.136 mm, half a ligament, got 0.2 mm",
        ),
        (lambda: mesh_specimen(SMALL, 0.0), "positive length in mm, got 0"),
        (lambda: mesh_specimen(SMALL, float("nan")), "positive length in mm, got nan"),
        (lambda: mesh_specimen(SMALL, 0.7), "at most 0.589 mm .*got 0.7 mm"),
        (lambda: Imperfection(position_sd=-1.0), "standard deviations >= 0"),
        (lambda: Imperfection(position_sd=float("nan")), "standard deviations >= 0"),
        (
            lambda: perturb(mesh_specimen(SMALL, 0.29), SMALL, Imperfection(0.1)),
            "half a ligament, got 0.4 mm",
        ),
    ],
)
def test_impossible_geometry_is_refused_in_one_line(make: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
