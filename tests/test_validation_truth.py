"""The parts of an error, apart from each other, and the regions of the pattern.

Guards: the conventions of rms; a best fit that nothing of the same ansatz beats; that model and
measurement error add up to w; the largest pattern, by region; the exact boundary of a mesh.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from manufactured import one_mode
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.fem.specimen import Specimen
from modeharvest.idic import correlate as correlation
from modeharvest.idic.correlate import best_fit, fit_displacement
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import Truth
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.validation.truth import Comparison, VectorStatistics, pattern_size

GRID = PixelGrid.centred(150, 130, 0.02)
# The body that `manufactured.one_mode` is made for: a cellular part of 2.0 x 2.4 mm, l = 1 mm.
SPECIMEN = Specimen(holes_x=2, holes_y=2, diameter=0.5, pitch=1.0, bulk_x=0.3, bulk_y=0.5)


def body() -> NDArray[np.bool_]:
    """Cut the specimen's holes out of its rectangle."""
    x, y = np.meshgrid(GRID.x, GRID.y)
    mask = (np.abs(x) < SPECIMEN.half_size[0]) & (np.abs(y) < SPECIMEN.half_size[1])
    for cx, cy in SPECIMEN.hole_centres:
        mask &= np.hypot(x - cx, y - cy) > 0.5 * SPECIMEN.diameter
    return mask


def beyond_the_ansatz() -> NDArray[np.float64]:
    """Fluctuate ten times as fast as the mode does, by 0.01 mm."""
    x, y = np.meshgrid(GRID.x, GRID.y)
    return 0.01 * np.stack([np.sin(10 * np.pi * x), np.cos(10 * np.pi * y)], axis=-1)


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    """A truth of ansatz and fast fluctuation; a "measurement" a known step off its best fit."""
    ansatz, mask = one_mode(), body()
    start = ansatz.initial_guess(0.05, 1.0)
    truth = ansatz.displacement(start, GRID.x, GRID.y) + beyond_the_ansatz()
    truth = np.where(mask[..., None], truth, np.nan)
    best = fit_displacement(truth, GRID, ansatz, start, mask)
    step = np.zeros(ansatz.size)
    step[ansatz.v0_slice(0).start] = 0.003
    step[ansatz.v0_slice(1).start] = -0.004
    measured = replace(best, unknowns=best.unknowns + step)
    return Comparison(0.05, GRID, mask, truth, measured, best, np.zeros(GRID.shape))


@pytest.mark.parametrize("flip", [False, True])
def test_the_best_fit_is_the_lowest_minimum_though_it_is_looked_for_on_few_pixels(
    flip: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(correlation, "_ENOUGH", 800)  # every third pixel or so
    ansatz, mask = one_mode(), body()
    near = ansatz.initial_guess(0.05, 1.0)
    far = near.copy()
    far[ansatz.phi_slice(0)][1:3] *= 2.5  # wave vectors that lead to another minimum
    truth = ansatz.displacement(near, GRID.x, GRID.y) + beyond_the_ansatz()
    truth = np.where(mask[..., None], truth, np.nan)
    on_all = [fit_displacement(truth, GRID, ansatz, a, mask) for a in (near, far)]
    assert on_all[1].residual_rms > 1.1 * on_all[0].residual_rms
    initial = (far, near) if flip else (near, far)
    begun = replace(on_all[0], unknowns=initial[0])
    found = best_fit(Truth.of(displacement=truth), begun, guesses=initial[1:])
    assert found.pixels == on_all[0].pixels
    assert found.residual_rms <= on_all[0].residual_rms
    # as near as the coarser tolerance of the other, 1e-4 px
    apart = found.displacement() - on_all[0].displacement()
    assert np.abs(apart[mask]).max() < 1e-3 * GRID.pixel_size


def test_rms_is_per_component_and_the_length_is_root_two_of_it() -> None:
    field = np.zeros((4, 5, 2))
    field[..., 0], field[..., 1] = 3.0, -4.0
    field[0, 0] = np.nan
    mask = np.ones((4, 5), dtype=bool)
    mask[0, 0] = False
    found = VectorStatistics.of(field, mask, unit=0.5)
    assert found.mean == (6.0, -8.0)
    assert found.rms == (6.0, 8.0)
    assert found.rms_length == found.max_length == found.median_length == 10.0
    assert found.rms_per_component == pytest.approx(10 / math.sqrt(2))


def test_error_of_measurement_is_the_step_that_was_made(comparison: Comparison) -> None:
    loss = comparison.idic_to_best[comparison.mask]
    np.testing.assert_allclose(loss, np.broadcast_to([0.003, -0.004], loss.shape), atol=1e-15)


def test_parts_add_up_to_w(comparison: Comparison) -> None:
    inside = comparison.mask
    sum_of_parts = comparison.best_error - comparison.idic_to_best
    np.testing.assert_allclose(sum_of_parts[inside], comparison.w[inside], atol=1e-15)
    assert np.isnan(comparison.w[~inside]).all()


def test_best_fit_leaves_what_the_ansatz_cannot_say(comparison: Comparison) -> None:
    """Nothing of the same ansatz is nearer to the truth, nor can it follow the fluctuation."""
    mask, best = comparison.mask, comparison.best
    left = VectorStatistics.of(comparison.best_error, mask).rms_per_component
    fluctuation = VectorStatistics.of(beyond_the_ansatz(), mask).rms_per_component
    assert 0.8 * fluctuation < left <= fluctuation
    rng = np.random.default_rng(1)
    for _ in range(5):
        other = best.unknowns + 1e-3 * rng.normal(size=best.unknowns.size)
        error = comparison.displacement - best.ansatz.displacement(other, GRID.x, GRID.y)
        assert VectorStatistics.of(error, mask).rms_per_component > left


def test_pythagoras_of_the_errors(comparison: Comparison) -> None:
    """A uniform step lies in the ansatz, so what the best fit leaves is orthogonal to it."""
    w, model, loss = (
        VectorStatistics.of(part, comparison.mask).rms_per_component
        for part in (comparison.w, comparison.best_error, comparison.idic_to_best)
    )
    # The fit stops at steps of 1e-4 px = 2e-6 mm, 1e-3 of the step made here.
    assert w**2 == pytest.approx(model**2 + loss**2, rel=1e-2)


def test_pattern_is_measured_by_region(comparison: Comparison) -> None:
    """A mode of maximum norm 0.04 times v1 = 1 mm is 0.04 mm = 2 px somewhere on the material."""
    ansatz = comparison.result.ansatz
    plain = replace(comparison.result, unknowns=ansatz.initial_guess(0.0, 1.0))
    anywhere, inner, corners = pattern_size(replace(comparison, result=plain), SPECIMEN)
    assert 0.9 * 2 < anywhere <= 2 * (1 + 1e-9)
    assert corners <= anywhere
    assert inner == 0.0  # 2 x 2 cells have no inner ones
    nothing = replace(comparison.result, unknowns=np.zeros(ansatz.size))
    assert pattern_size(replace(comparison, result=nothing), SPECIMEN)[0] == 0.0


def ring(n: int = 16) -> Mesh:
    """Mesh a ring of radii 1 and 2 by n Q8 cells, mid-sides on the circles."""
    t = 2 * np.pi * np.arange(2 * n) / (2 * n)
    circle = np.stack([np.cos(t), np.sin(t)], axis=1)
    nodes = np.vstack([circle, 2 * circle, 1.5 * circle[::2]])
    cells = []
    for k in range(n):
        a, m, b = 2 * k, 2 * k + 1, (2 * k + 2) % (2 * n)
        radial = 4 * n + k, 4 * n + (k + 1) % n
        cells.append([a, 2 * n + a, 2 * n + b, b, radial[0], 2 * n + m, radial[1], m])
    return Mesh(nodes, np.array(cells), "Q8")


def area_of(boundary: MeshBoundary, displacement: NDArray[np.float64] | None = None) -> float:
    """Sum up the signed area inside the path; holes count negative."""
    zoom = 1e4  # curves are flattened to a fraction of a unit
    total = 0.0
    for loop in boundary.path(displacement).to_polygons(Affine2D().scale(zoom), closed_only=True):
        x, y = loop[:-1].T
        total += 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    return total / zoom**2


def test_boundary_finds_edge_and_hole_and_keeps_them_curved() -> None:
    boundary = MeshBoundary.of(ring())
    assert sorted(len(loop) for loop in boundary.loops) == [16, 16]
    # Parabolas through three points each, pi/16 apart, miss a circle's area by (pi/16)^4 / 30 or
    # so, 5e-5; straight chords would miss 6e-3.
    assert area_of(boundary) == pytest.approx(3 * np.pi, rel=2e-4)


def test_boundary_moves_with_the_nodes() -> None:
    mesh = ring()
    boundary = MeshBoundary.of(mesh)
    moved = boundary.path(np.full_like(mesh.nodes, 5.0)).get_extents()
    np.testing.assert_allclose([moved.x0, moved.x1], [3.0, 7.0], atol=0.01)
    assert area_of(boundary, mesh.nodes) == pytest.approx(
        4 * area_of(boundary), rel=1e-4
    )  # of flattening
