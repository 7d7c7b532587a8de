"""Tilted loading: what it prescribes, the moment that goes with it, and where it leads."""

from __future__ import annotations

import numpy as np
import pytest
from fem_bodies import plate

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.materials import Ogden
from modeharvest.fem.path.continuation import PathFollower
from modeharvest.fem.path.equilibrium import EdgeCompression, Structure
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen
from modeharvest.runs.case import Case
from modeharvest.util.errors import InputError

WIDTH, HEIGHT = 3.0, 2.0
SMALL = Specimen(4, 2)


def test_edge_turns_counter_clockwise_about_its_middle_in_proportion_to_the_strain() -> None:
    tilt, strains = 0.05, (0.04, 0.08)
    solution = simulate(Experiment(SMALL, strains=strains, mesh_size=0.5, tilt=tilt))
    half_width = SMALL.half_size[0]
    x, y = solution.mesh.nodes.T
    for strain in strains:
        u = solution.at(strain).displacement
        stroke = 0.5 * strain * SMALL.length
        for edge, expected in (
            (x > half_width - 1e-9, -stroke - strain * tilt * y),
            (x < 1e-9 - half_width, stroke + 0.0 * y),
        ):
            np.testing.assert_allclose(u[edge, 0], expected[edge], atol=1e-14)
            np.testing.assert_array_equal(u[edge, 1], 0.0)
    assert solution.info["loading"]["tilt_rad"] == tilt


def test_small_tilt_of_a_plate_is_pure_bending() -> None:
    """Sliding edges, small strain: Bernoulli's stress is exact, and T6 contains its displacement.

    Stored energy beyond that of the plain compression: half the moment times the rotation, with
    the moment E/(1 - nu^2) I theta / W of plane strain.
    """
    material = Ogden()
    shear, lame = 0.5 * sum(material.moduli), material.kappa
    modulus = 4.0 * shear * (lame + shear) / (lame + 2.0 * shear)  # E / (1 - nu^2)
    strain, tilt = 1e-5, 2.0
    mesh = plate(WIDTH, HEIGHT, 5, 4)

    def energy_and_force(angle: float) -> tuple[float, float]:
        structure = Structure(mesh, material, EdgeCompression(0.5 * WIDTH, WIDTH, "sliding", angle))
        follower = PathFollower(structure)
        path = [follower.start()]
        assert follower.follow_primary(path, [strain])
        return structure.energy(path[-1].u), structure.reaction(path[-1].u, WIDTH)

    (bent, bent_force), (plain, plain_force) = energy_and_force(tilt), energy_and_force(0.0)
    inertia, rotation = HEIGHT**3 / 12.0, strain * tilt
    moment = modulus * inertia * rotation / WIDTH
    # Relative differences of the order of the strain are the material's, not the linear theory's.
    assert bent - plain == pytest.approx(0.5 * moment * rotation, rel=1e-3)
    assert bent_force == pytest.approx(plain_force, rel=1e-3)
    assert plain_force == pytest.approx(modulus * strain * HEIGHT, rel=1e-3)


def test_force_and_moment_do_the_work() -> None:
    """d(energy)/d(strain) = force length + moment tilt; with opposite tilts the moments cancel."""
    at, step = 0.06, 1e-4
    moment = {}
    for tilt in (0.3, -0.3):
        strains = (at - step, at, at + step)
        solution = simulate(Experiment(SMALL, strains=strains, mesh_size=0.5, tilt=tilt))
        low, here, high = solution.snapshots
        rate = (high.energy - low.energy) / (2.0 * step)
        moment[tilt] = (rate - here.reaction * SMALL.length) / tilt
    assert moment[0.3] > 0.0  # the edge resists being turned
    # Upside down, a tilt is the opposite one: both energies and forces are the same.
    assert moment[0.3] == pytest.approx(-moment[-0.3], rel=1e-5)


def test_no_tilt_is_what_was_before_and_keeps_its_key() -> None:
    plain = Structure(plate(WIDTH, HEIGHT, 3, 2), Ogden(), EdgeCompression(0.5 * WIDTH, WIDTH))
    zero = Structure(
        plate(WIDTH, HEIGHT, 3, 2), Ogden(), EdgeCompression(0.5 * WIDTH, WIDTH, tilt=0.0)
    )
    for structure in (plain, zero):
        assert structure._shortening.tobytes() == structure._direction.x.array.tobytes()
    assert "tilt" not in Case().plain()["experiment"]
    assert Case(experiment=Experiment(tilt=0.01)).plain()["experiment"]["tilt"] == 0.01


def test_tilt_follows_the_one_natural_path() -> None:
    """It breaks both mirror symmetries, so there is no bifurcation to find."""
    tilted = Experiment(SMALL, strains=(0.1, 0.17), mesh_size=0.5, tilt=0.002)
    assert not tilted.is_perfect
    solution = simulate(tilted)
    perfect = simulate(Experiment(SMALL, strains=(0.17,), mesh_size=0.5)).at(0.17)
    assert solution.info["critical"] is None
    assert not any(solution.info["path"]["primary"]["negative_pivots"])
    assert solution.at(0.17).energy == pytest.approx(perfect.energy, rel=1e-2)


@pytest.mark.parametrize("tilt", [2.0, -1.5, float("nan")])
def test_absurd_tilt_is_refused(tilt: float) -> None:
    with pytest.raises(InputError, match="tilt: expected at most"):
        Experiment(tilt=tilt)


def test_guide_holds_the_junctions_at_mid_height_and_nothing_else() -> None:
    guided = simulate(Experiment(SMALL, strains=(0.1,), mesh_size=0.5, tilt=0.2, guided=True))
    free = simulate(Experiment(SMALL, strains=(0.1,), mesh_size=0.5, tilt=0.2))
    x, y = guided.mesh.nodes.T
    u, without = guided.at(0.1).displacement, free.at(0.1).displacement
    fixed = np.zeros(x.size, dtype=np.bool_)
    for junction in (-SMALL.pitch, 0.0, SMALL.pitch):
        fixed |= np.hypot(x - junction, y) < 1e-9
    assert fixed.sum() == 3
    np.testing.assert_array_equal(u[fixed, 1], 0.0)
    assert np.abs(without[fixed, 1]).min() > 1e-4
    assert np.ptp(u[fixed, 0]) > 0.1  # free to move along the rail
    assert guided.at(0.1).energy > free.at(0.1).energy


def test_guide_leaves_a_symmetric_path_as_it_is() -> None:
    """Before buckling u_y vanishes at mid-height by itself."""
    guided, free = (
        simulate(Experiment(SMALL, strains=(0.08,), mesh_size=0.5, guided=g)).at(0.08)
        for g in (True, False)
    )
    np.testing.assert_allclose(guided.displacement, free.displacement, atol=1e-9)
    assert guided.reaction == pytest.approx(free.reaction, rel=1e-9)


def test_guide_needs_junctions_at_mid_height() -> None:
    with pytest.raises(InputError, match=r"guided: expected .* an even holes_y"):
        Experiment(Specimen(4, 3), guided=True)
