"""The pictures of infinite lattices: the right material in the right place, units on every axis.

Guards: copies of a cell join without seams and fill the window, deformed or not; waves and maps
are where their wave vectors are in the Cartesian plane; branches and studies are drawn for what
they are, stable or not, first or not.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import synthetic_lattice as made_up
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from numpy.typing import NDArray

from modeharvest.idic.spectra.mode_family import wave_sum
from modeharvest.report.figures.boundaries import LatticePatch
from modeharvest.report.figures.lattice import (
    draw_amplitudes,
    draw_captured,
    draw_critical_strains,
    draw_differences,
    draw_dispersion,
    draw_energies,
    draw_growth,
    draw_lattice,
    draw_lattice_spectrum,
    draw_overlaps,
    draw_overlay,
    draw_zone_map,
)
from modeharvest.report.figures.style import INK
from modeharvest.runs.lattice.results import combination_name
from modeharvest.validation.studies.lattice import EQ_MODE

L = made_up.PITCH
HEXAGONAL = L * np.array([[1.0, 0.0], [0.5, 0.75**0.5]])


def rings(drawn: Figure, colour: str = INK) -> set[tuple[float, float]]:
    """Places of the rings of one colour, rounded."""
    return {
        tuple(np.round(np.ravel(line.get_xydata()), 6).tolist())
        for line in drawn.axes[0].lines
        if len(np.asarray(line.get_xdata())) == 1 and line.get_markeredgecolor() == colour
    }


@pytest.mark.parametrize("copies", [1, 2])
@pytest.mark.parametrize("shear", [None, made_up.SHEAR], ids=["square", "sheared"])
def test_copies_join_without_seams_and_fill_the_window(
    copies: int, shear: NDArray[np.float64] | None
) -> None:
    mesh, lattice = made_up.cell(copies, shear)
    patch = LatticePatch.of(mesh, lattice, (3 * L, 2 * L))
    assert len(np.unique(np.round(patch.mesh.nodes, 9), axis=0)) == len(patch.mesh.nodes)
    # One outer edge, and around each hole one loop of 8 edges; a seam would add more.
    holes = [loop for loop in patch.boundary.loops if len(loop) == 8]
    assert len(holes) == len(patch.boundary.loops) - 1
    (outer,) = (loop for loop in patch.boundary.loops if len(loop) != 8)
    left, right, bottom, top = patch.limits
    edge = patch.mesh.nodes[outer[:, 0]]
    assert not np.any((edge[:, 0] > left) & (edge[:, 0] < right)
                      & (edge[:, 1] > bottom) & (edge[:, 1] < top))  # fmt: skip


@given(st.lists(st.floats(-0.2, 0.2), min_size=4, max_size=4))
def test_an_affine_displacement_of_the_cell_is_that_of_the_patch(parts: list[float]) -> None:
    F = np.eye(2) + np.reshape(parts, (2, 2))
    mesh, lattice = made_up.cell(1, made_up.SHEAR)
    patch = LatticePatch.of(mesh, lattice, (2 * L, 2 * L))
    moved = patch.moved(mesh.nodes @ (F - np.eye(2)).T, F)
    expected = (patch.mesh.nodes - patch.centre) @ (F - np.eye(2)).T
    np.testing.assert_allclose(moved, expected, atol=1e-12)


def test_a_periodic_displacement_repeats_in_every_copy() -> None:
    modes = made_up.modes()
    patch = LatticePatch.of(modes.mesh, modes.lattice, (5 * L, 5 * L))
    expected = wave_sum(EQ_MODE.waves(EQ_MODE.start), patch.mesh.nodes, L)
    np.testing.assert_allclose(patch.moved(modes.shapes[0]), expected, atol=1e-12)


def test_the_cell_s_boundary_follows_the_mean_deformation() -> None:
    mesh, lattice = made_up.cell()
    patch = LatticePatch.of(mesh, lattice, (3 * L, 3 * L))
    F = np.array([[0.9, 0.1], [0.0, 1.05]])
    drawn = draw_lattice(patch, L, mesh.nodes @ (F - np.eye(2)).T, F)
    corners = drawn.axes[0].patches[-1].get_xy()[:4]  # type: ignore[attr-defined]  # a polygon
    np.testing.assert_allclose(np.diff(corners, axis=0)[0], F @ lattice[0], atol=1e-12)
    assert drawn.axes[0].get_xlim() == patch.limits[:2]


def test_a_growing_mode_is_nothing_on_the_left_and_all_on_the_right() -> None:
    modes = made_up.modes()
    patch = LatticePatch.of(modes.mesh, modes.lattice, (6 * L, 4 * L))
    drawn = draw_growth(patch, modes.shapes[0], 0.1 * L, L)
    mesh = drawn.axes[0].collections[0]
    length = np.asarray(mesh.get_array())
    x = patch.mesh.nodes[:, 0]
    left, right = patch.limits[:2]
    assert np.all(length[x < left + 0.1 * (right - left)] == 0)
    assert length.max() == pytest.approx(0.1)
    assert drawn.axes[0].texts[-1].get_text() == "l"


def test_two_equal_modes_lie_on_each_other() -> None:
    mode = made_up.study().overlays[0]
    drawn = draw_overlay(mode.mesh, L, mode.analytic, mode.analytic, 0.1 * L)
    grey, black, line = (patch.get_path() for patch in drawn.axes[0].patches)
    np.testing.assert_array_equal(grey.vertices, black.vertices)
    np.testing.assert_array_equal(black.vertices, line.vertices)
    largest = np.linalg.norm(mode.analytic, axis=1).max()
    moved = mode.mesh.nodes + 0.1 * L / largest * mode.analytic
    corner = np.argmax(moved.sum(axis=1))
    assert np.abs(grey.vertices - moved[corner]).sum(axis=1).min() < 1e-12


def test_the_dispersion_has_a_curve_for_every_load_and_a_ring_where_it_is_critical() -> None:
    found = made_up.dispersion()
    drawn = draw_dispersion(found, (made_up.M,))
    axes = drawn.axes[0]
    bold = [line for line in axes.lines if str(line.get_label()).endswith("%")]
    assert [line.get_label() for line in bold] == ["0 %", "5 %", "6 %"]
    assert [t.get_text() for t in axes.get_xticklabels()] == ["Γ", "X", "M", "Γ"]
    assert axes.get_ylabel() == "lowest eigenvalue [N/mm⁴]"
    # X is pi/l from Γ, and M as far from X.
    assert rings(drawn) == {(round(2 * np.pi / L, 6), 0.0)}
    np.testing.assert_allclose(axes.get_xticks()[:3], np.array([0, 1, 2]) * np.pi / L)


@pytest.mark.parametrize("lattice", [L * np.eye(2), HEXAGONAL], ids=["square", "hexagonal"])
def test_the_zone_map_is_drawn_in_cartesian_wave_vectors(lattice: NDArray[np.float64]) -> None:
    found = made_up.zone(0.0, lattice)
    image = draw_zone_map(found, L).axes[0].images[0]
    shown = np.asarray(image.get_array())
    left, right, *_ = image.get_extent()
    t = np.linspace(left, right, len(shown))
    xi = np.stack(np.meshgrid(t, t), axis=-1)
    expected = made_up.eigenvalue(2 * np.pi / L * xi @ lattice.T, 0.0)
    # Cubic splines over a grid of 24 are good to a few thousandths of the range of 4.
    np.testing.assert_allclose(shown, expected, atol=0.02)


def test_the_hexagonal_zone_has_six_corners_and_its_critical_waves_six_images() -> None:
    m_points = ((math.pi, 0.0), (0.0, math.pi), (math.pi, math.pi))
    drawn = draw_zone_map(made_up.zone(0.06, HEXAGONAL), L, m_points)
    edge = drawn.axes[0].patches[0]
    corners = np.unique(np.round(edge.get_xy(), 9), axis=0)  # type: ignore[attr-defined]
    # Corners at 2/3, middles of the edges at 1/sqrt 3 from Γ [1/l].
    np.testing.assert_allclose(np.linalg.norm(corners, axis=1), 2 / 3)
    assert len(corners) == 6
    places = np.array(sorted(rings(drawn, "#16191d")))
    assert len(places) == 6
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 1 / math.sqrt(3), atol=1e-6)


def test_a_map_with_something_unstable_diverges_from_zero() -> None:
    image = draw_zone_map(made_up.zone(0.06), L).axes[0].images[0]
    low, high = image.get_clim()
    assert low == -high < 0
    stable = draw_zone_map(made_up.zone(0.0), L).axes[0].images[0]
    assert stable.get_clim()[0] == 0.0


def test_a_discrete_spectrum_is_dots_at_its_wave_vectors() -> None:
    xi = np.array([[0.5, 0.5], [-0.5, -0.5], [1.5, 0.5], [0.0, 3.0]])
    drawn = draw_lattice_spectrum(xi, np.array([1.0, 1.0, 1e-3, 1.0]), 2.0)
    (dots,) = (c for c in drawn.axes[0].collections if isinstance(c, PathCollection))
    offsets = {tuple(place) for place in np.asarray(dots.get_offsets()).tolist()}
    # Half the largest is -3 dB, a thousandth -33 dB; what is beyond the reach isn't drawn.
    assert offsets == {(0.5, 0.5), (-0.5, -0.5), (1.5, 0.5)}
    faint = draw_lattice_spectrum(xi, np.array([1.0, 1.0, 1e-5, 1.0]), 2.0)
    (dots,) = (c for c in faint.axes[0].collections if isinstance(c, PathCollection))
    assert len(np.asarray(dots.get_offsets())) == 2
    assert drawn.axes[0].texts[-1].get_text() == "dB"


@pytest.mark.parametrize(
    ("combination", "name"),
    [
        ((1.0,), "φ₁"),
        ((0.0, -1.0), "−φ₂"),
        ((0.6, 0.6, -0.6), "φ₁ + φ₂ − φ₃"),
        ((0.8, 0.0, -0.6), "0.8 φ₁ − 0.6 φ₃"),
    ],
)
def test_combinations_have_names(combination: tuple[float, ...], name: str) -> None:
    assert combination_name(combination) == name


def test_unstable_branches_are_dashed_and_lost_ones_left_out() -> None:
    run = made_up.run()
    lost = replace(run.branches[0], states=())
    for draw in (draw_energies, draw_amplitudes):
        axes = draw([*run.branches, lost], made_up.CRITICAL).axes[0]
        named = {str(line.get_label()): line for line in axes.lines
                 if not str(line.get_label()).startswith("_")}  # fmt: skip
        assert {name: line.get_linestyle() for name, line in named.items()} == {
            "φ₁": "-", "φ₁ − φ₂, unstable": "--",
        }  # fmt: skip
        assert axes.get_ylabel().endswith("]")
        for line in named.values():  # they leave the primary path at the critical point
            assert np.asarray(line.get_xydata())[0].tolist() == [100 * made_up.CRITICAL, 0.0]


def test_differences_are_measured_from_the_lowest_branch() -> None:
    axes = draw_differences(made_up.run().branches).axes[0]
    lowest, other = (line for line in axes.lines if not str(line.get_label()).startswith("_"))
    np.testing.assert_array_equal(lowest.get_ydata(), 0.0)
    # -5e-5 against -2e-4 MPa, times the amplitude: 150 Pa
    np.testing.assert_allclose(other.get_ydata(), 150 * np.sqrt([0.005, 0.01, 0.025]), rtol=1e-9)


def test_a_study_s_dots_are_filled_where_the_pattern_comes_first() -> None:
    rows = made_up.study().ratios
    for draw in (draw_overlaps, draw_captured, draw_critical_strains):
        axes = draw(rows).axes[0]
        dots = [line for line in axes.lines if len(np.asarray(line.get_xdata())) == 1]
        filled = [(line.get_xdata()[0], line.get_markerfacecolor() != "none") for line in dots]
        assert sorted(set(filled)) == [(0.3, False), (0.6, False), (0.8, True)]
        assert len(dots) == len(rows)


def test_a_lattice_without_a_critical_point_has_no_dot() -> None:
    rows = [made_up.row(0.3, found=False, kind="none", pattern=math.nan), made_up.row(0.8)]
    axes = draw_critical_strains(rows).axes[0]
    dots = [line.get_ydata()[0] for line in axes.lines if len(np.asarray(line.get_xdata())) == 1]
    assert np.isnan(dots).tolist() == [True, False]


def test_the_drawings_use_the_page_s_ink() -> None:
    mode = made_up.study().overlays[0]
    drawn = draw_overlay(mode.mesh, L, mode.shape, mode.analytic, 0.1 * L)
    assert to_hex(drawn.axes[0].patches[-1].get_edgecolor()) == INK
