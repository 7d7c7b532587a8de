"""Specimens with other hole lattices, end to end: simulated, imaged, measured, validated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import three_modes
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from modeharvest.fem import specimen as specimen_module
from modeharvest.fem.bloch.critical import first_critical
from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Snapshot, Solution
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import hexagonal
from modeharvest.fem.lattice.options import uniaxial_strain
from modeharvest.fem.materials import Ogden
from modeharvest.fem.meshing import mesh_specimen
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen
from modeharvest.idic import modes as modes_module
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import correlate
from modeharvest.idic.modes import rotation_family, two_waves_near, zone_boundary_families
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.runs.case import Case
from modeharvest.runs.experiment import Run, require_same_experiment
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun
from modeharvest.runs.whole_field import VirtualWholeFieldOptions
from modeharvest.util.errors import InputError
from modeharvest.validation.studies.study import ImagePairSpec

pytestmark = pytest.mark.usefixtures("coarse_pictures", "unrendered_pictures")

RECTANGULAR = Specimen(4, 6, diameter=1.5, diameter_y=1.7, stacking="rectangular", pitch_y=2.0)
TRIANGULAR = Specimen(3, 5, diameter=1.5, stacking="triangular", bulk_x=1.0, bulk_y=0.5)
IMAGING = ImagingSpec(pixel_size=0.04, speckle=SpeckleSpec(standard_deviation=0.08, blur_px=1.5))
NONE = VirtualWholeFieldOptions(measure=False)
FEW = SquareLatticeOptions(v0_degree=3, v_degree=1)


def summary_of(
    specimen: Specimen, strain: float, folder: Path, v_degree: int, fixed_mode: bool = False
) -> dict[str, Any]:
    experiment = Experiment(specimen, strains=(strain,), mesh_size=0.35)
    how = SquareLatticeOptions(v0_degree=4, v_degree=v_degree, fixed_mode=fixed_mode)
    case = Case(experiment=experiment, imaging=IMAGING, correlation=how, whole_field=NONE)
    return Run(case, folder).all()


def test_ellipses_in_rectangular_stacking_buckle_and_are_measured(tmp_path: Path) -> None:
    summary = summary_of(RECTANGULAR, 0.13, tmp_path, 3)
    (snapshot,) = summary["snapshots"]
    # Rows turn in opposite senses, weaker at the edges: Eq. (6) with an envelope.
    assert summary["critical"]["pattern_overlap_by_cell"] > 0.85
    assert (snapshot["branch"], snapshot["negative_pivots"]) == ("buckled+", 0)
    assert snapshot["outcome"] == "converged"
    assert snapshot["pattern_amplitude_px"] > 3.0
    # The lattice's own wave vectors, (1, 0.95) pi/l, were found, and the best fit's mode.
    np.testing.assert_allclose(snapshot["mode"][1:5], [1.0, 0.95, -1.0, 0.95], atol=0.05)
    np.testing.assert_allclose(snapshot["mode"], snapshot["mode_best_fit"], atol=0.1)
    # 5000 speckles weigh w by chance: about rms w sqrt(unknowns / speckles) = 0.1 of it.
    assert snapshot["rms_idic_to_best_fit_px"] < 0.2 * snapshot["rms_w_px"]


def test_a_triangular_specimen_from_simulation_to_report(tmp_path: Path) -> None:
    specimen = Specimen(3, 7, diameter=1.7, stacking="triangular")
    # Three free modes are not observable on so few cells: most starts end nowhere in particular.
    summary = summary_of(specimen, 0.1, tmp_path, 1, fixed_mode=True)
    (snapshot,), critical = summary["snapshots"], summary["critical"]
    assert (critical["negative_pivots_below"], critical["negative_pivots_above"]) == (0, 1)
    assert "pattern_overlap" not in critical
    # Its edges let it bulge sideways a little: later than the infinite lattice that can't.
    cell = PeriodicCell(hexagonal(1.9, 1.7, 0.35), Ogden())
    lattice = first_critical(CellPath(cell, uniaxial_strain()))
    assert len(lattice.waves) == 2
    assert lattice.load < critical["strain"] < 5.0 * lattice.load
    assert (snapshot["branch"], snapshot["outcome"]) == ("buckled+", "converged")
    assert snapshot["rms_best_fit_px"] <= snapshot["rms_w_px"] < 1.5
    assert snapshot["rms_idic_to_best_fit_px"] < 0.3 * snapshot["rms_w_px"]
    free = SquareLatticeOptions().ansatz(specimen)
    assert [mode.family.name for mode in free.modes] == [
        "zone boundary (1, 0)", "zone boundary (0, 1)", "zone boundary (1, 1)"
    ]  # fmt: skip
    assert not {"mode", "modes", "mode_ideal", "mode_deviation_percent"} & set(snapshot)
    page = (tmp_path / "report.html").read_text("utf-8")
    for i in (1, 2, 3):
        assert f'id="v{i}-1000"' in page
        assert f'id="phi{i}-1000"' in page
    assert "seven parameters" not in page
    assert "four holes" not in page


def test_photographs_of_a_rectangular_stacking_need_the_shorter_distance(tmp_path: Path) -> None:
    specimen = replace(RECTANGULAR, pitch_y=2.5, diameter_y=2.1)
    solution = simulate(Experiment(specimen, strains=(0.14,), mesh_size=0.35))
    make_images(solution, IMAGING, tmp_path)
    (tmp_path / "experiment.toml").write_text(
        '[images]\nreference = "reference_8bit.tif"\ndeformed = ["deformed_1400_8bit.tif"]\n'
        "[scale]\npixel_size = 0.04\n[specimen]\ncell_size = 1.9\n"
        "[correlation]\nv0_degree = 4\nv_degree = 3\n"
    )
    case = PhotographCase.read(tmp_path / "experiment.toml")
    (measured,) = HarvestRun(case, tmp_path / "out").results().values()
    assert measured.result.outcome is Outcome.CONVERGED
    (mode,) = measured.result.ansatz.modes
    waves = mode.family.waves(measured.result.mode_parameters(0))
    # The lattice's own, by the vectors of its holes, as those of the virtual experiment above.
    np.testing.assert_allclose(np.abs(waves[:, 2:4]), [[1.0, 1.9 / 2.5]] * 2, atol=0.05)


@pytest.mark.parametrize("specimen", [RECTANGULAR, TRIANGULAR])
def test_truth_of_the_images_is_the_finite_elements(specimen: Specimen, tmp_path: Path) -> None:
    solution = simulate(Experiment(specimen, strains=(0.03,), mesh_size=0.35))
    state = solution.at(0.03)
    right = solution.mesh.nodes[:, 0] > specimen.half_size[0] - 1e-9
    assert np.all(state.displacement[right] == [-0.015 * specimen.length, 0.0])
    (pair,) = make_images(solution, IMAGING, tmp_path)
    row, col = pair.grid.to_px(*solution.mesh.nodes.T)
    for c in (0, 1):
        u = map_coordinates(pair.truth.displacement[..., c], [row, col], order=1, cval=np.nan)
        known = np.isfinite(u)
        assert known.sum() > 0.3 * len(u)
        # Linear between pixels of a field that is smooth over an element of some ten pixels.
        off = (u - state.displacement[:, c])[known] / pair.grid.pixel_size
        assert np.sqrt(np.mean(off**2)) < 0.005


def test_three_modes_of_a_triangular_specimen_are_measured(tmp_path: Path) -> None:
    """With a motion that the ansatz can describe: what is left is the images' own error."""
    specimen = Specimen(5, 5, diameter=1.5, stacking="triangular")
    ansatz = Ansatz.of_specimen(specimen, options=FEW)
    a = ansatz.initial_guess(0.04)
    for i, (size, ratio) in enumerate(((2.0, -0.42), (-1.5, -0.5), (1.2, -0.45))):
        a[ansatz.v_slice(i)] = size * np.array([1.0, 0.2, -0.1])
        a[ansatz.phi_slice(i)] += [0.1, ratio + 0.45, 0.02, -0.01, 0.05, 0.0]
    mesh = mesh_specimen(specimen, 0.2)
    u = ansatz.displacement_at(a, mesh.nodes)
    solution = Solution(mesh, (Snapshot(0.04, u, 0.0, 0.0, 0, (), "primary"),), {})
    (pair,) = make_images(solution, IMAGING, tmp_path)
    result = correlate(pair, ansatz, options=FEW.options())
    assert result.outcome is Outcome.CONVERGED
    assert pair.rms(result) / pair.grid.pixel_size < 0.02
    for i in range(3):
        part, family = ansatz.phi_slice(i), ansatz.modes[i].family
        found, true = (two_waves_near(b[part], family.start, 1.9) for b in (result.unknowns, a))
        np.testing.assert_allclose(found, true, atol=0.02)


@pytest.mark.parametrize("v_degree", [1, 3])
def test_three_free_modes_of_a_buckled_lattice_are_measured(v_degree: int, tmp_path: Path) -> None:
    """A specimen cut out of the lattice on the branch of all three modes, as benchmarked."""
    specimen = Specimen(5, 6, 1.7, 1.9, bulk_x=0.0, bulk_y=0.0, stacking="triangular")
    (solution,) = three_modes.flowers([specimen], 0.02)
    (pair,) = make_images(solution, replace(IMAGING, pixel_size=0.03), tmp_path)
    found = three_modes.measured(pair, specimen, v_degree)
    assert found.converged
    assert all(found.is_observable)
    np.testing.assert_allclose(found.modes_px, np.mean(found.modes_px), rtol=0.01)
    # What moves a wave by 3 % of its length from one end of the specimen to the other.
    assert max(found.wave_errors) < 0.01
    assert found.idic_px < 0.7 * found.w_px


def test_modes_at_the_zone_boundary_have_the_lattices_period() -> None:
    """A lattice vector changes each field's sign or leaves it, as its M point says."""
    for specimen in (TRIANGULAR, Specimen(4, 4, stacking="triangular")):
        points = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 2))
        for family, phases in zip(
            zone_boundary_families(specimen), ((1, 0), (0, 1), (1, 1)), strict=True
        ):
            waves = family.waves(family.start)

            def field(at: Any, waves: Any = waves) -> Any:
                theta = np.pi / specimen.pitch * (at @ waves[:, 2:4].T + waves[:, 4])  # noqa: B023
                return np.sin(theta) @ waves[:, :2]

            for vector, sign in zip(specimen.vectors, phases, strict=True):
                np.testing.assert_allclose(
                    field(points + vector), (-1.0) ** sign * field(points), atol=1e-12
                )
            np.testing.assert_allclose(field(specimen.hole_centres), 0.0, atol=1e-12)


def test_rotation_family_is_the_specimens_pattern() -> None:
    specimen = Specimen(3, 4, stacking="rectangular", pitch_y=2.3)
    family = rotation_family(specimen)
    waves = family.waves(family.start)
    at = mesh_specimen(specimen, 0.3).nodes
    field = np.sin(np.pi / 1.9 * (at @ waves[:, 2:4].T + waves[:, 4])) @ waves[:, :2]
    pattern = specimen.pattern(at) * [2.3 / 1.9, 1.0]
    sign = np.sign(np.sum(field * pattern))
    np.testing.assert_allclose(field, sign * 2.0 * pattern, atol=1e-12)


def test_a_square_case_refuses_the_solution_of_another_stacking() -> None:
    other = Experiment(Specimen(stacking="triangular")).described()
    with pytest.raises(InputError, match="stacking = square, got triangular"):
        require_same_experiment(other, Experiment(), "solution.h5")
    assert "stacking" not in Experiment().described()["specimen"]


def test_a_case_file_names_the_stacking(tmp_path: Path) -> None:
    path = tmp_path / "case.toml"
    path.write_text(
        '[experiment.specimen]\nstacking = "rectangular"\npitch_y = 2.0\ndiameter_y = 1.7\n'
    )
    specimen = Case.read(path).experiment.specimen
    assert (specimen.row_distance, specimen.aspect) == (2.0, 1.7 / 1.5)
    path.write_text('[experiment.specimen]\nstacking = "triangular"\npitch_y = 2.0\n')
    with pytest.raises(InputError, match="expected no pitch_y for triangular stacking"):
        Case.read(path)


def test_neighbours_are_at_the_pitch_in_triangular_stacking() -> None:
    centres = Specimen(4, 5, stacking="triangular").hole_centres
    distance = cKDTree(centres).query(centres, k=2)[0][:, 1]
    np.testing.assert_allclose(distance, 1.9, rtol=1e-12)


def test_the_recipe_for_a_further_stacking_works(monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[1] / "docs/how-to/extending.md").read_text("utf-8")
    recipe = text.split("## A hole lattice")[1].split("```python\n")[1].split("```")[0]
    monkeypatch.setattr(specimen_module, "STACKINGS", dict(specimen_module.STACKINGS))
    monkeypatch.setattr(modes_module, "FAMILIES", dict(modes_module.FAMILIES))
    names: dict[str, Any] = {}
    exec(recipe, names)
    specimen = names["specimen"]
    a, b = specimen.half_size
    mesh = mesh_specimen(specimen, 0.3)
    assert np.abs(mesh.nodes).max(axis=0) == pytest.approx([a, b])
    families = names["FAMILIES"][specimen.stacking](specimen)
    assert [family.wave_count for family in families] == [2, 2, 2]


def test_studies_of_one_mode_refuse_staggered_rows() -> None:
    experiment = Experiment(TRIANGULAR)
    with pytest.raises(InputError, match=r"square or rectangular stacking.*got triangular"):
        ImagePairSpec(experiment, IMAGING, FEW, lambda: simulate(experiment))
