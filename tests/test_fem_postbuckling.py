"""Buckled branches of periodic cells: pitchforks, energies, degenerate sets, falling loads."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import modeharvest
from modeharvest.fem.bloch import postbuckling
from modeharvest.fem.bloch.critical import critical_at, first_critical
from modeharvest.fem.bloch.modes import Branch, ModeSet, read_modes
from modeharvest.fem.bloch.postbuckling import follow
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.field import Solution
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, hexagonal, square
from modeharvest.fem.lattice.options import CriticalSearch, MacroLoading, equibiaxial, uniaxial
from modeharvest.fem.lattice.periodicity import overlaps
from modeharvest.fem.materials import Material, Ogden, TwoTermI1
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]
PRESSED = MacroLoading(((None, 0.0), (0.0, None)), ((-1.0, 0.0), (0.0, 0.0)))
CASES: dict[str, tuple[UnitCell, MacroLoading]] = {
    "thick": (square(1.0, 0.7895, 1 / 6), uniaxial()),
    "thin": (square(1.0, 0.8696, 1 / 6), uniaxial()),
    "pressed": (square(1.0, 0.7895, 1 / 6), PRESSED),
    "flower": (hexagonal(1.386, 1.28, 1.386 / 6), equibiaxial()),
    "across": (hexagonal(1.386, 1.28, 1.386 / 6), uniaxial(1)),
}


@cache
def start(case: str) -> tuple[CellPath, ModeSet]:
    """The path of the 2 x 2 cell, and the modes at the first critical point."""
    return started(*CASES[case], TwoTermI1())


def started(cell: UnitCell, loading: MacroLoading, material: Material) -> tuple[CellPath, ModeSet]:
    primitive = PeriodicCell(cell, material)
    search = CriticalSearch(divisions=2)
    found = first_critical(CellPath(primitive, loading), search)
    modes = real_modes(primitive, found.state, found.waves)
    m, n = modes.info["copies"]
    return CellPath(PeriodicCell(cell.enlarged(m, n), material), loading), modes


@cache
def branch(case: str, combination: tuple[float, ...], factors: tuple[float, ...]) -> Branch:
    path, modes = start(case)
    return follow(path, modes, combination, [factor * modes.load for factor in factors])


@pytest.mark.parametrize("case", ["thick", "thin", "across"])
def test_beyond_a_pitchfork_the_branch_is_stable_and_costs_less_energy(case: str) -> None:
    path, modes = start(case)
    found = branch(case, (1.0,), (1.05, 1.2))
    assert [state.load / modes.load for state in found.states] == pytest.approx([1.05, 1.2])
    for state in found.states:
        assert state.energy < state.primary_energy
        assert state.negative_eigenvalues == 0
        primary = path.at(state.load)
        assert primary is not None
        assert path.cell.negative_eigenvalues(path.loading, primary) == 1


@pytest.mark.parametrize("case", ["thick", "thin", "across"])
def test_the_amplitude_grows_with_the_root_of_the_excess_load(case: str) -> None:
    _, modes = start(case)
    factors = (1.001, 1.002, 1.004, 1.008)
    found = branch(case, (1.0,), factors)
    amplitudes = [state.amplitudes[0] for state in found.states]
    exponent = np.polyfit(np.log(np.array(factors) - 1.0), np.log(amplitudes), 1)[0]
    # e - e_c = c a^2 (1 + d a^2): corrections of the order of e / e_c - 1.
    assert exponent == pytest.approx(0.5, abs=0.005)
    # On the way, too, from the first point on.
    ratios = (found.curve[1:4, 1] - modes.load) / found.curve[1:4, 0] ** 2
    assert np.ptp(ratios) < 0.05 * ratios.mean()


def test_the_two_halves_of_a_pitchfork_are_the_same_moved_by_a_cell() -> None:
    one, other = (branch("thick", (c,), (1.2,)).states[0] for c in (1.0, -1.0))
    assert other.energy == pytest.approx(one.energy, rel=1e-10)
    assert other.amplitudes == pytest.approx(-one.amplitudes, rel=1e-7)
    assert np.allclose(other.gradient, one.gradient, atol=1e-9)
    mesh, (_, modes) = start("thick")[0].cell.cell.mesh, start("thick")
    tree = cKDTree(mesh.nodes)
    distance, there = tree.query(mesh.nodes + modes.primitive[0])
    inside = distance < 1e-9
    u, v = one.fluctuation(mesh), other.fluctuation(mesh)
    moved = u[there[inside]] - v[inside]
    assert np.ptp(moved, axis=0).max() < 1e-8  # up to a translation


@pytest.mark.parametrize(("case", "axis"), [("thick", 0), ("across", 1)])
def test_the_stress_is_the_slope_of_the_energy(case: str, axis: int) -> None:
    before, here, after = branch(case, (1.0,), (1.199, 1.2, 1.201)).states
    slope = (after.energy - before.energy) / (after.load - before.load)
    assert -here.stress[axis, axis] == pytest.approx(slope, rel=1e-5)
    assert np.abs(here.stress).sum() == pytest.approx(abs(here.stress[axis, axis]), rel=1e-6)


def test_of_the_hexagonal_patterns_that_of_all_three_modes_is_preferred() -> None:
    # The "flower" of Papka & Kyriakides, Int. J. Solids Struct. 36 (1999) 4367-4396, preferred
    # under equibiaxial compression: Ohno, Okumura & Noguchi, J. Mech. Phys. Solids 50 (2002)
    # 1125-1153.
    one, two, three = (
        branch("flower", combination, (1.2,)).states[0]
        for combination in ((1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (1.0, 1.0, 1.0))
    )
    assert three.energy < two.energy < one.energy < one.primary_energy
    assert [s.negative_eigenvalues for s in (one, two, three)] == [2, 1, 0]
    # Newton's method leaves 1e-11 of the forces; what resists turning into another branch is weak.
    assert two.amplitudes[0] == pytest.approx(two.amplitudes[1], rel=1e-5)
    assert abs(two.amplitudes[2]) < 1e-5 * two.amplitudes[0]
    assert np.ptp(three.amplitudes) < 1e-5 * three.amplitudes[0]


@pytest.mark.parametrize("signs", [(-1.0, -1.0, -1.0), (1.0, 1.0, -1.0)])
def test_signs_make_no_difference_to_the_flower(signs: tuple[float, float, float]) -> None:
    reference = branch("flower", (1.0, 1.0, 1.0), (1.2,)).states[0]
    found = branch("flower", signs, (1.2,)).states[0]
    assert found.energy == pytest.approx(reference.energy, rel=1e-9)
    assert np.sign(found.amplitudes).tolist() == list(signs)


@pytest.mark.parametrize(
    ("start_along", "branch_along"),
    [((1.0, 0.1, 0.0), (1, 0, 0)), ((1.0, 0.9, 0.1), (1, 1, 0)), ((1.0, 0.9, 0.8), (1, 1, 1))],
)
def test_the_branch_nearest_to_a_combination_is_followed_and_reported(
    start_along: tuple[float, ...], branch_along: tuple[float, ...]
) -> None:
    found = branch("flower", start_along, (1.2,))
    assert found.combination == pytest.approx(np.array(start_along) / np.linalg.norm(start_along))
    amplitudes = found.states[0].amplitudes
    expected = np.array(branch_along) * np.linalg.norm(amplitudes) / np.linalg.norm(branch_along)
    assert amplitudes == pytest.approx(expected, abs=1e-5 * amplitudes[0])


def test_a_branch_along_which_the_load_falls_is_followed() -> None:
    # The plateau: beyond the critical point less stress does, so that under a prescribed stress
    # it is unstable. These are the equilibria that a prescribed strain has.
    _, modes = start("pressed")
    found = branch("pressed", (1.0,), (0.998, 1.002))
    assert "the load falls" in found.outcome
    assert f"not met: e = {1.002 * modes.load:.6g}" in found.outcome
    (state,) = found.states
    assert state.negative_eigenvalues == 1
    path, driven = start("thick")
    strain = 1.0 - state.gradient[0, 0]
    (same,) = follow(path, driven, (1.0,), [strain]).states
    assert -same.stress[0, 0] == pytest.approx(state.load, rel=1e-7)
    assert same.amplitudes == pytest.approx(state.amplitudes, rel=1e-6)
    assert same.negative_eigenvalues == 0


def test_the_branch_ends_where_material_would_run_into_itself() -> None:
    found = branch("thick", (1.0,), (1.2, 6.0))
    assert "contact is not modelled" in found.outcome
    assert "not met" in found.outcome
    assert len(found.states) == 1
    path, _ = start("thick")
    cell = path.cell.cell
    assert not overlaps(cell.mesh, cell.lattice, np.eye(2), np.zeros_like(cell.mesh.nodes))
    # The pattern, exaggerated: holes close to slits and beyond.
    state = found.states[0]
    pattern = state.fluctuation(cell.mesh)
    closed = [overlaps(cell.mesh, cell.lattice, np.eye(2), f * pattern) for f in (1.0, 2.0, 4.0)]
    assert closed[0] is False
    assert closed[2] is True


@pytest.mark.parametrize("case", ["thick", "flower", "across"])
def test_critical_loads_are_as_far_as_the_modes_eigenvalues_say(case: str) -> None:
    """To first order in the distance; a mode is critical where it is 0."""
    cell, loading = CASES[case]
    path, modes = start(case)
    primitive = PeriodicCell(cell, TwoTermI1())
    waves = first_critical(CellPath(primitive, loading), CriticalSearch(divisions=2)).waves
    for share, order in ((1.0, 1e-7), (0.995, 5e-4), (0.98, 5e-3)):
        state = CellPath(primitive, loading).at(share * modes.load)
        before = path.at((share - 1e-4) * modes.load)
        assert state is not None
        assert before is not None
        there = real_modes(primitive, state, waves)
        found = path.cell.critical_distances(before, there.shapes, there.eigenvalues)
        assert found == pytest.approx(1.0 / share - 1.0, abs=order)


def test_what_cannot_be_followed_is_an_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    path, modes = start("flower")
    noise = np.random.default_rng(1).normal(size=modes.shapes.shape)
    lost = follow(path, replace(modes, shapes=noise), (1, 0, 0), [1.2 * modes.load])
    assert lost.states == ()
    assert "perhaps no branch starts along this combination" in lost.outcome
    stiff = follow(path, replace(modes, eigenvalues=modes.eigenvalues + 1.0), (1, 0, 0), [0.01])
    assert stiff.outcome.startswith("not followed: the modes are not critical")
    assert "one mode's own critical load is " in stiff.outcome
    beyond = follow(path, replace(modes, load=3.0), (1, 0, 0), [4.0])
    assert beyond.outcome.startswith("not followed: no equilibrium of the primary path")
    monkeypatch.setattr(postbuckling, "_FARTHEST", 0.02)
    short = follow(path, modes, (1, 1, 1), [0.1])
    assert "the largest amplitude" in short.outcome


def test_what_does_not_fit_is_refused() -> None:
    path, modes = start("thick")
    with pytest.raises(InputError, match=r"another mesh; make it with cell.enlarged\(2, 2\)"):
        follow(start("flower")[0], modes, (1.0,), [0.1])
    for wrong in ((1.0, 0.0), (0.0,), (math.nan,)):
        with pytest.raises(InputError, match="expected 1 coefficients of modes, not all 0"):
            follow(path, modes, wrong, [0.1])
    with pytest.raises(InputError, match="one finite load or more"):
        follow(path, modes, (1.0,), [])


def test_the_pattern_is_that_of_the_middle_of_a_finite_specimen() -> None:
    # The shipped specimen: 6 x 10 holes, d = 1.5 mm, l = 1.9 mm, clamped, 12.8 % compressed.
    solution = Solution.read(Path(modeharvest.__file__).parent / "cases/paper-virtual.h5")
    nodes, u = solution.mesh.nodes, solution.at(0.128).displacement
    tree, pitch = cKDTree(nodes), 1.9
    corners = np.array([[-pitch, -pitch], [pitch, -pitch], [-pitch, pitch]])
    at = u[tree.query(corners)[1]]
    mean = np.stack([at[1] - at[0], at[2] - at[0]], axis=1) / (2 * pitch)  # over 2 x 2 cells

    # The lattice under that deformation, reached in proportion.
    (xx, xy), (yx, yy) = mean.tolist()
    loading, material = MacroLoading(((xx, xy), (yx, yy))), Ogden((1.2,), (3.0,), 5.4)
    cell = square(pitch, 1.5, 0.2)
    primitive = PeriodicCell(cell, material)
    found = critical_at(CellPath(primitive, loading), (math.pi, math.pi), CriticalSearch(1.0))
    modes = real_modes(primitive, found.state, found.waves)
    path = CellPath(PeriodicCell(cell.enlarged(2, 2), material), loading)
    state = follow(path, modes, (1.0,), [1.0]).states[0]

    # A hole's centre is the lattice's origin; the nodes of the two meshes are the same.
    places = modes.mesh.nodes - 0.5 * pitch
    distance, there = tree.query(places)
    assert distance.max() < 1e-6
    measured, lattice = u[there] - places @ mean.T, state.fluctuation(modes.mesh)
    measured, lattice = measured - measured.mean(axis=0), lattice - lattice.mean(axis=0)
    sizes = np.linalg.norm(measured), np.linalg.norm(lattice)
    # Two rows of holes away from the clamped edges: alike, if not the same.
    assert abs(np.sum(measured * lattice)) > 0.995 * sizes[0] * sizes[1]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.05)


def test_the_recipe_works_as_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parent.parent / "docs/explanation/modes.md").read_text(encoding="utf-8")
    recipe = page.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {}
    exec(compile(recipe, "docs/explanation/modes.md", "exec", dont_inherit=True), namespace)
    assert [state.negative_eigenvalues for state in namespace["flower"].states] == [0, 0]
    modes, (flower,) = read_modes("flower.h5")
    assert modes.info["copies"] == [2, 2]
    assert np.ptp(flower.states[-1].amplitudes) < 1e-5 * flower.states[-1].amplitudes[0]
    assert Path("flower.vtu").exists()
