"""Guards the twin of the real experiment: what a user would have in one folder, the truth apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.imaging.distortion.lens import CameraDistortion
from modeharvest.imaging.distortion.target import CalibrationTarget
from modeharvest.imaging.photographs.files import read_image
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec, choose_grid
from modeharvest.imaging.speckle.pattern import Ink, Speckle, SpeckleSpec
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.twin import Twin, TwinRun, make_twin
from modeharvest.runs.whole_field import VirtualWholeFieldOptions
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json

LENS = CameraDistortion(200.0, 200.0, 60.0, 55.0, k1=-0.1, p1=0.005)
STRAINS = (0.082, 0.127)
CASE = Case(
    experiment=Experiment(strains=STRAINS),
    imaging=ImagingSpec(
        pixel_size=0.05,
        shape=(110, 120),
        background=0.05,
        speckle=SpeckleSpec(blur_px=2.0, ink=Ink(blur_px=2.0)),
        sensor=Sensor(read_noise=0.01, flicker=0.02),
        distortion=LENS,
        affine_distortion=False,
    ),
    calibration=CalibrationTarget(((0, 0), (7, 0), (0, 9))),
)


def solution() -> Solution:
    """Four Q4 elements, 4 mm x 4 mm, compressed along x."""
    x, y = (a.ravel() for a in np.meshgrid([-2.0, 0.0, 2.0], [-2.0, 0.0, 2.0]))
    cells = np.array([[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6], [4, 5, 8, 7]])
    u = np.stack([-x, 0.3 * y], axis=1)
    nodes = np.stack([x, y], axis=1)
    return Solution(Mesh(nodes, cells, "Q4"), tuple(Snapshot(s, s * u) for s in STRAINS), {})


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Twin:
    return make_twin(CASE, solution(), tmp_path_factory.mktemp("twin"))


def stage_shifts(twin: Twin) -> NDArray[np.float64]:
    """(m, 2) where the stage was at the calibration, along (rows, columns) [px]."""
    return np.array(read_json(twin.truth / "twin.json")["stage_shifts_row_col_px"])


def test_a_user_has_photographs_and_what_a_user_knows(twin: Twin) -> None:
    folder = twin.experiment.parent
    names = {"experiment.toml", "reference.tif", "reference_2.tif"}
    names |= {"deformed_0820.tif", "deformed_1270.tif"}
    names |= {f"calibration_{k:02d}.tif" for k in range(3)}
    assert {path.name for path in folder.iterdir()} == names
    found = PhotographCase.read(twin.experiment)
    assert found.scale.pixel_size == CASE.imaging.pixel_size
    assert found.specimen.cell_size == CASE.experiment.specimen.pitch
    assert found.images.deformed == ("deformed_0820.tif", "deformed_1270.tif")
    assert not found.distortion.shifts
    for name in found.images.deformed:
        assert read_image(folder / name).shape == (110, 120)


def test_the_truth_is_apart_and_complete(twin: Twin) -> None:
    assert twin.images.strains == STRAINS
    lens = CASE.imaging.lens((110, 120))
    assert lens is not None
    there, here = twin.distortion.shift(10.0, 20.0), lens.shift(10.0, 20.0)
    np.testing.assert_array_equal(there, here)
    shifts = stage_shifts(twin)
    np.testing.assert_array_equal(shifts, CASE.calibration.true_shifts)
    assert np.abs(shifts - np.array(CASE.calibration.shifts_px)[:, ::-1]).max() > 0.05
    kept = Solution.read(twin.truth / "solution.h5")
    np.testing.assert_array_equal(kept.mesh.nodes, solution().mesh.nodes)
    for strain in STRAINS:
        truth = twin.images.truth(strain).displacement
        x, y = np.meshgrid(twin.images.grid.x, twin.images.grid.y)
        exact = strain * np.stack([-x, 0.3 * y], axis=-1)
        inside = ~np.isnan(truth)
        np.testing.assert_allclose(truth[inside], exact[inside], atol=1e-12)


def test_the_second_exposure_differs_by_noise_and_light(twin: Twin) -> None:
    first, second = (
        read_image(twin.experiment.parent / f"{name}.tif") for name in ("reference", "reference_2")
    )
    sensor = CASE.imaging.sensor
    light = sensor.illumination("reference_2") / sensor.illumination("reference")
    difference = second - light * first
    # Two exposures, their rounding; the background's lower end is cut off now and then.
    inner = difference[35:75, 40:80]
    expected = np.sqrt(2 * (sensor.read_noise**2 + 1 / (12 * 255**2)))
    assert abs(inner.mean()) < 4 * expected / np.sqrt(inner.size)
    assert inner.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * inner.size))


def test_again_does_nothing_and_another_calibration_is_made_anew(tmp_path: Path) -> None:
    first = make_twin(CASE, solution(), tmp_path)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    before = [path.stat().st_mtime_ns for path in files]
    make_twin(CASE, solution(), tmp_path)
    assert [path.stat().st_mtime_ns for path in files] == before
    (first.experiment.parent / "calibration_01.tif").unlink()
    make_twin(CASE, solution(), tmp_path)
    assert sorted(path for path in tmp_path.rglob("*") if path.is_file()) == files
    target = CalibrationTarget(((0, 0), (7, 0)))
    make_twin(CASE.model_copy(update={"calibration": target}), solution(), tmp_path)
    assert len(stage_shifts(first)) == 2
    assert len(list(first.experiment.parent.glob("calibration_*"))) == 2


def test_what_no_user_knows_is_refused(tmp_path: Path) -> None:
    case = CASE.model_copy(update={"whole_field": VirtualWholeFieldOptions(material_law=True)})
    with pytest.raises(InputError, match=r"material_law = false of a twin"):
        TwinRun(case, tmp_path).all()


def test_without_a_lens_there_is_nothing_to_calibrate(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected an \[imaging.distortion\]"):
        make_twin(CASE.model_copy(update={"imaging": ImagingSpec()}), solution(), tmp_path)


# The shipped twin ------------------------------------------------------------------------------


def shipped() -> tuple[Case, Solution]:
    case, path = Case.read("paper-real-twin"), shipped_solution("paper-real-twin")
    assert path.stat().st_size < 5e6
    return case, Solution.read(path)


def test_shipped_twin_is_the_papers_specimen_before_and_after_buckling() -> None:
    case, found = shipped()
    experiment = case.experiment
    assert case.calibration is not None
    assert Case.read("paper-virtual").calibration is None
    assert found.info["outcome"] == "complete"
    assert not found.info["warnings"]
    assert [s.negative_pivots for s in found.snapshots] == [0, 0]  # stable, so on the branch
    assert choose_grid(found, experiment.strains, case.imaging).shape == (2207, 2751)
    amplitude = [_pattern(s.displacement, found.mesh, experiment.specimen) for s in found.snapshots]
    assert abs(amplitude[0]) < 0.04  # mm: imperfections show some of it already
    assert abs(amplitude[1]) > 0.3
    x, y = found.mesh.nodes.T
    right = x > experiment.specimen.half_size[0] - 1e-9
    for s in found.snapshots:
        stroke = 0.5 * s.nominal_strain * experiment.specimen.length
        tilted = -stroke - s.nominal_strain * experiment.tilt * y[right]
        np.testing.assert_allclose(s.displacement[right, 0], tilted, atol=1e-12)
    tilt = np.degrees(experiment.tilt * experiment.strains[1])
    assert tilt == pytest.approx(0.1, abs=1e-3)


def _pattern(u: NDArray[np.float64], mesh: Mesh, specimen: Specimen) -> float:
    """Amplitude of the pattern in the middle of the specimen, beside an affine motion [mm]."""
    core = (np.abs(mesh.nodes) < 2.0 * specimen.pitch).all(axis=1)
    at = mesh.nodes[core]
    affine = np.column_stack([np.ones(len(at)), at])
    fields = np.zeros((2, 7, len(at)))
    fields[:, 0] = specimen.pattern(at).T
    fields[0, 1:4] = fields[1, 4:7] = affine.T
    columns = fields.transpose(1, 0, 2).reshape(7, -1).T
    return float(np.linalg.lstsq(columns, u[core].T.ravel(), rcond=None)[0][0])


def test_shipped_lens_shifts_by_up_to_a_tenth_of_the_displacement() -> None:
    case, found = shipped()
    shape = case.imaging.shape
    assert shape is not None
    lens = case.imaging.lens(shape)
    assert lens is not None
    row, col = np.meshgrid(np.linspace(0, shape[0] - 1, 80), np.linspace(0, shape[1] - 1, 90))
    largest = np.hypot(*lens.shift(row, col)).max()
    moved = np.linalg.norm(found.at(0.127).displacement, axis=1).max() / case.imaging.pixel_size
    assert 0.09 < largest / moved < 0.11


def test_shipped_speckles_are_3_to_8_px_wide() -> None:
    """Full width of the autocorrelation at half its maximum; the case quotes 4.0, 7.6 and 5.9."""
    spec, n = shipped()[0].imaging.speckle, 500
    both = Speckle(spec, (n, n)).image()
    powder = Speckle(SpeckleSpec(**{**vars(spec), "ink": None}), (n, n)).image()
    widths = [_width(image) for image in (powder, both / powder, both)]
    np.testing.assert_allclose(widths, [4.0, 7.6, 5.9], atol=0.15)


def _width(image: NDArray[np.float64]) -> float:
    power = np.abs(np.fft.fft2(image - image.mean())) ** 2
    correlation = np.fft.ifft2(power).real[0, :40]
    correlation /= correlation[0]
    after = int(np.argmax(correlation < 0.5))
    high, low = correlation[after - 1], correlation[after]
    return 2.0 * (after - 1 + (high - 0.5) / (high - low))


def test_shipped_noise_is_about_a_hundredth_of_full_scale() -> None:
    imaging = shipped()[0].imaging
    grey = Speckle(imaging.speckle, (300, 300)).image()
    sd = np.sqrt(imaging.sensor.noise_variance(grey, imaging.bits).mean())
    assert 0.007 < sd < 0.012


def test_shipped_holes_are_scattered_as_the_case_says() -> None:
    case, found = shipped()
    specimen, scatter = case.experiment.specimen, case.experiment.imperfection
    nodes = found.mesh.nodes
    tree = cKDTree(nodes)
    offsets, diameters = [], []
    for centre in specimen.hole_centres:
        near = nodes[tree.query_ball_point(centre, 0.5 * specimen.diameter + 0.08)]
        # The hole's edge: a circle through the nodes nearest to its middle in each direction.
        middle = near.mean(axis=0)
        angle = np.floor(np.arctan2(*(near - middle).T) / (np.pi / 12))
        edge = np.array([
            min(near[angle == a], key=lambda p: float(np.hypot(*(p - middle))))
            for a in np.unique(angle)
        ])  # fmt: skip
        fit = np.linalg.lstsq(
            np.column_stack([2 * edge, np.ones(len(edge))]), (edge**2).sum(axis=1), rcond=None
        )[0]
        offsets.append(fit[:2] - centre)
        diameters.append(2.0 * np.sqrt(fit[2] + fit[:2] @ fit[:2]))
    count = len(diameters)
    assert np.std(offsets) == pytest.approx(scatter.position_sd, rel=4 / np.sqrt(4 * count))
    assert np.std(diameters) == pytest.approx(scatter.diameter_sd, rel=4 / np.sqrt(2 * count))
    assert np.mean(diameters) == pytest.approx(specimen.diameter, abs=4 * 0.01 / np.sqrt(count))
