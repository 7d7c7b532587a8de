"""What free edges have in common: learnt from a displacement, and measured with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plate_with_hole import GRID, RADIUS, plate_pair
from scipy import ndimage

from modeharvest.fem.field import Mesh
from modeharvest.idic.finite_element.equations.system import NodalPattern
from modeharvest.idic.finite_element.measure import FiniteElementOptions, measure_displacement
from modeharvest.idic.finite_element.mesh import mesh_of_mask
from modeharvest.idic.solver.free_edges import FreeEdges
from modeharvest.imaging.pair import ImagePair

pytest.importorskip("gmsh")

COARSE = FiniteElementOptions(element_px=30.0, edge_element_px=12.0)
NU, STRAIN = 0.45, 0.05
EVERYWHERE = -np.inf, np.inf, -np.inf, np.inf


def beside_hole(points: np.ndarray) -> np.ndarray:
    return np.hypot(*np.moveaxis(points, -1, 0)) > RADIUS


def kirsch(points: np.ndarray) -> np.ndarray:
    """(..., 2) displacement of a large plate in plane strain with a free hole, pulled along x."""
    x, y = np.moveaxis(points, -1, 0)
    k, true, angle = 3.0 - 4.0 * NU, np.hypot(x, y), np.arctan2(y, x)
    r = np.maximum(true, 0.9 * RADIUS)
    a, (cos, sin), (cos3, sin3) = RADIUS / r, of(angle), of(3.0 * angle)
    u_x = (k + 1.0) * cos / a + 2.0 * a * ((1.0 + k) * cos + cos3) - 2.0 * a**3 * cos3
    u_y = (k - 3.0) * sin / a + 2.0 * a * ((1.0 - k) * sin + sin3) - 2.0 * a**3 * sin3
    size = STRAIN * RADIUS / (k + 1.0) * np.minimum(true / r, 1.0)  # smaller inside the hole
    return size[..., None] * np.stack([u_x, u_y], axis=-1)


def of(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.cos(angle), np.sin(angle)


def four_parts_missing(points: np.ndarray) -> np.ndarray:
    """A plate that four round parts of are left out of: none of its edges is free."""
    x, y = np.moveaxis(abs(points), -1, 0)
    return (x < 1.1) & (y < 0.9) & (np.hypot(x - 0.5, y - 0.4) > 0.2)


def homogeneous(points: np.ndarray) -> np.ndarray:
    return points * np.array([0.08, -0.03])


def errors_px(pair: ImagePair, depth: float, options: FiniteElementOptions) -> np.ndarray:
    """(k, 2) errors at pixels at most so deep inside [px]."""
    found = measure_displacement(pair, np.zeros_like, options=options)
    assert pair.truth is not None
    error = (found.displacement_on() - pair.truth.displacement) / GRID.pixel_size
    mask = np.pad(pair.masks[0], 1, mode="edge")
    return error[pair.masks[0] & (ndimage.distance_transform_edt(mask)[1:-1, 1:-1] <= depth)]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_edges_of_a_free_hole_are_measured_better() -> None:
    errors = []
    for seed in range(2):
        pair = plate_pair(kirsch, 0.02, seed, beside_hole)
        errors.append(
            [rms(errors_px(pair, 10.0, replace(COARSE, free_edges=on))) for on in (True, False)]
        )
    with_edges, without = rms(np.array(errors).T[0]), rms(np.array(errors).T[1])
    assert with_edges < 0.93 * without


def test_edges_that_are_not_free_are_left_alone() -> None:
    pair = plate_pair(homogeneous, 0.01, 0, four_parts_missing)
    errors = [rms(errors_px(pair, 10.0, replace(COARSE, free_edges=on))) for on in (True, False)]
    assert errors[0] < 1.1 * errors[1]


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return mesh_of_mask(plate_pair(kirsch, material=beside_hole).masks[0], GRID, 20.0, 5.0).mesh


def test_law_of_edges_is_learnt(mesh: Mesh) -> None:
    """Of a field of small strains, at the hole alone: the image's border isn't the body's."""
    left, right, bottom, top = GRID.extent
    edges = FreeEdges(mesh, (left + 0.02, right - 0.02, bottom + 0.02, top - 0.02))
    distance = np.hypot(*np.moveaxis(mesh.nodes[edges.nodes], -1, 0)).min(axis=1)
    assert np.allclose(distance, RADIUS, atol=0.01)
    u = 0.01 * kirsch(mesh.nodes).ravel()
    edges.learn(u, np.zeros((u.size, 1)))
    assert edges.exponent == pytest.approx(NU / (1.0 - NU), rel=0.05)
    assert max(edges.deviation) <= 1e-3


def test_sides_that_end_in_corners_are_left_out() -> None:
    mask = np.ones((GRID.rows, GRID.cols), dtype=bool)
    mesh = mesh_of_mask(mask, GRID, 30.0, 30.0).mesh
    edges = FreeEdges(mesh, EVERYWHERE)
    sides = np.count_nonzero(np.bincount(mesh.cells[:, 3:].ravel()) == 1)
    assert len(edges.nodes) == sides - 8 > 0  # two at each corner


def test_departures_are_linearised(mesh: Mesh) -> None:
    edges, random = FreeEdges(mesh, EVERYWHERE), np.random.default_rng(0)
    u = kirsch(mesh.nodes).ravel()
    edges.learn(u, np.zeros((u.size, 1)))
    step = 1e-6 * random.standard_normal(u.size)
    blocks, e = edges.linearised(u)
    E = NodalPattern.of(len(mesh.nodes), mesh.cells).assembled(edges.nodes, blocks)
    # Gauss and Newton's matrix is that of the departures' squares where these are small.
    squares = [float(np.sum(edges._weighed(u + s * step)[1] ** 2)) for s in (1.0, -1.0)]
    assert e @ step == pytest.approx(-0.25 * (squares[0] - squares[1]), rel=1e-4)
    assert step @ (E @ step) > 0.0
    assert np.abs(E - E.T).max() < 1e-9 * np.abs(E).max()
    sample = edges.samples(u, 400)
    assert np.mean(sample**2) <= 1.2 * E.diagonal().mean()
