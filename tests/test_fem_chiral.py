"""Ring-and-ligament lattices: their area, symmetry and stiffness against independent routes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from modeharvest.fem.bloch.eigen import BlochWaves
from modeharvest.fem.hyperelastic import FreeBody
from modeharvest.fem.lattice.cell import CellPath, CellState, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, chiral
from modeharvest.fem.lattice.options import uniaxial
from modeharvest.fem.materials import TwoTermI1
from modeharvest.util.errors import InputError

SIZE = 0.05
TETRA, HEXA = chiral(1.0, SIZE, ligaments=4), chiral(1.0, SIZE, ligaments=6)
both = pytest.mark.parametrize(("cell", "ligaments"), [(TETRA, 4), (HEXA, 6)])


def material(cell: UnitCell) -> float:
    """Area of the mesh [mm^2]."""
    return 0.5 * float(FreeBody(cell.mesh, TwoTermI1()).mass().sum())


def at_rest(cell: UnitCell) -> tuple[PeriodicCell, CellState]:
    periodic = PeriodicCell(cell, TwoTermI1())
    state = CellPath(periodic, uniaxial()).at(0.0)
    assert state is not None
    return periodic, state


@both
def test_the_area_is_that_of_rings_and_ligaments(cell: UnitCell, ligaments: int) -> None:
    outer, wall, t = 0.25, 0.1, 0.05
    ring = math.pi * (outer**2 - (outer - wall) ** 2)
    middle = math.sqrt(0.25 - (outer - 0.5 * t) ** 2)
    # Half a ligament without the half segment of the ring's disc that it overlaps.
    y = outer - t
    segment = 0.5 * (outer**2 * math.acos(y / outer) - y * math.sqrt(outer**2 - y**2))
    exact = ring + ligaments * (middle * t - segment)
    # Parabolas through three points of a circle miss h^4 / (720 r^3) a length, here 2e-7.
    assert material(cell) == pytest.approx(exact, rel=1e-5)


@both
def test_a_turn_maps_the_mesh_onto_itself_and_a_mirror_does_not(
    cell: UnitCell, ligaments: int
) -> None:
    angle = 2 * math.pi / ligaments
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    nodes = cell.mesh.nodes
    distance, image = cKDTree(nodes).query(nodes @ turn)
    assert distance.max() < 1e-12
    turned = {frozenset(c) for c in image[cell.mesh.cells].tolist()}
    assert turned == {frozenset(c) for c in cell.mesh.cells.tolist()}
    assert cKDTree(nodes).query(nodes * [1.0, -1.0])[0].max() > 0.5 * SIZE


@both
def test_copies_tile_the_plane(cell: UnitCell, ligaments: int) -> None:
    master, c = cell.periodicity.master, cell.mesh.cells
    corners, sides = np.unique(master[c[:, :3]]), np.unique(master[c[:, 3:]])
    # Of a torus: minus the number of holes. The ring's own, and the openings between rings: one
    # for each face of the net of ligaments, which has as many faces as half its ligaments - 1.
    assert len(corners) - len(sides) + len(c) == -(1 + ligaments // 2 - 1)
    assert cell.enlarged(2, 2).periodicity.count == 4 * cell.periodicity.count


def test_the_other_hand_is_the_mirror_image() -> None:
    left = chiral(1.0, SIZE, handedness="counterclockwise")
    distance = cKDTree(left.mesh.nodes).query(HEXA.mesh.nodes * [1.0, -1.0])[0]
    assert distance.max() < 1e-12
    # Signs of shear change in the mirror, the other moduli don't.
    mirror = np.diag([1.0, -1.0])
    here, there = at_rest(TETRA)[1], at_rest(chiral(1.0, SIZE, 4, handedness="counterclockwise"))[1]
    image = np.einsum("ijkl,ia,jb,kc,ld", here.moduli, *[mirror] * 4)
    assert np.allclose(image, there.moduli, atol=1e-9 * np.abs(here.moduli).max())


@both
def test_nothing_moves_for_free_but_translations(cell: UnitCell, ligaments: int) -> None:
    periodic, state = at_rest(cell)
    waves = BlochWaves(periodic, state)
    # A mechanism would leave rounding, 1e-12 or so. A tetrachiral lattice is soft in one shear.
    scale = np.abs(state.moduli).max()
    assert waves.long_wave()[0] > 1e-3 * scale
    for wave in [(0.0, 0.0), (math.pi, 0.0), (math.pi, math.pi), (2.0, 1.0)]:
        assert waves.lowest(wave).eigenvalues[0] > 0.1 * scale / cell.area


def test_six_ligaments_make_an_isotropic_plane() -> None:
    moduli = at_rest(HEXA)[1].moduli
    c, s = math.cos(0.4), math.sin(0.4)
    turn = np.array([[c, -s], [s, c]])
    turned = np.einsum("ijkl,ai,bj,ck,dl", moduli, *[turn] * 4)
    # Sixfold symmetry makes any tensor of fourth order isotropic; 1e-8 is of the solver.
    assert np.allclose(turned, moduli, atol=1e-8 * np.abs(moduli).max())


@pytest.mark.parametrize("thickness", [0.05, 0.02])
def test_hexachiral_poisson_ratio_is_that_of_beams_between_rigid_rings(thickness: float) -> None:
    """Prall & Lakes (1997), doi 10.1016/S0020-7403(96)00025-2: towards -1 if slender.

    With δ the lengthening of a ligament and θ its rotation against its rings, both are linear
    in the mean strain and in the rings' rotation φ; eliminating φ for equal strain ε both ways
    leaves δ - 2 r θ = R² ε / L. For a shear strain φ = 0, θ = w / L, and w and δ are R times the
    strain's components. With stiffness k_a against δ and k_b against θ the ratio of the plane
    bulk to the shear modulus is q = 2 (R/L)² / ((1 + 4 r² k_a/k_b) (1 + k_b/(k_a L²))), and
    Poisson's ratio (q - 1) / (q + 1).

    A ligament is a beam only where it is free, l of its length L between tangent points; the rest
    moves with the ring: k_b / k_a = t² (L/l)².
    """
    outer = 0.25
    r = outer - 0.5 * thickness
    length = 2 * math.sqrt(0.25 - r**2)
    free = length - 2 * math.sqrt(outer**2 - (outer - thickness) ** 2)
    ratio = (thickness * length / free) ** 2
    q = 2 / length**2 / ((1 + 4 * r**2 / ratio) * (1 + ratio / length**2))
    rate = at_rest(chiral(1.0, SIZE, 6, outer, 0.24, thickness))[1].rate[:4].reshape(2, 2)
    poisson = float(rate[1, 1] / -rate[0, 0])
    # Where a ligament leaves its ring the two are hardly apart over a length of sqrt(r t), so it is
    # not certain where the beam begins.
    tolerance = math.sqrt(r * thickness) / free
    assert 1 + poisson == pytest.approx(1 + (q - 1) / (q + 1), rel=tolerance)


def test_it_grows_wider_when_pulled_also_after_a_finite_compression() -> None:
    periodic = PeriodicCell(HEXA, TwoTermI1())
    state = CellPath(periodic, uniaxial()).at(0.03)
    assert state is not None
    assert state.gradient[0, 0] == pytest.approx(0.97)
    assert state.gradient[1, 1] < 0.985


@settings(max_examples=12)
@given(
    ligaments=st.sampled_from([4, 6]),
    radius=st.floats(0.12, 0.42),
    wall=st.floats(0.2, 0.9),
    thickness=st.floats(0.1, 0.4),
)
def test_whatever_is_accepted_can_be_meshed(
    ligaments: int, radius: float, wall: float, thickness: float
) -> None:
    shape = (2.0, 0.2, ligaments, 2 * radius, 2 * wall * radius, 2 * thickness * radius)
    t = thickness * radius
    if 0.25 - (radius - 0.5 * t) ** 2 <= 2 * radius * t - t**2:  # (L/2)^2, what the feet take of it
        with pytest.raises(InputError, match="free length"):
            chiral(*shape)
        return
    cell = chiral(*shape)
    assert 0 < material(cell) < cell.area


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ring_radius": 0.5}, r"rings must not touch.*ring_radius = 0.5 mm, pitch = 1.0 mm"),
        ({"ring_radius": -0.1}, "rings must not touch"),
        ({"pitch": math.nan}, "rings must not touch"),
        ({"ring_thickness": 0.25}, "ring_thickness < ring_radius"),
        ({"ring_thickness": 0.0}, "ring_thickness < ring_radius"),
        ({"ligament_thickness": 0.13}, r"ligament_thickness < 0.125 mm.*got 0.13 mm"),
        ({"ligament_thickness": -0.01}, "ligaments thinner"),
        ({"ring_radius": 0.48}, "free length, got rings 0.04 mm apart"),
        ({"ligaments": 5}, "4 .tetrachiral. or 6 .hexachiral. ligaments, got 5"),
        ({"handedness": "left"}, "'clockwise' or 'counterclockwise', got 'left'"),
        ({"size": 0.0}, "mesh size"),
    ],
)
def test_impossible_shapes_are_refused_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        chiral(**{"pitch": 1.0, "size": SIZE, **change})
    assert "\n" not in str(caught.value)
