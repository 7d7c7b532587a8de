"""A test from photograph to photograph: when it buckles, and where each correlation starts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from synthetic_photographs import Displacement, Photographed, lattice_points, of

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import free_family, square_family
from modeharvest.idic.photograph.measure import _goes_on
from modeharvest.idic.result import Result
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.imaging.grid import PixelGrid
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun

PITCH, PIXEL = 1.9, 0.035
CRITICAL = 0.042
STRAINS = (0.03, 0.04, 0.05, 0.06, 0.07)
FOREIGN = "frame_500"
CELLULAR = Box.centred(4 * PITCH, 5 * PITCH)
DOMAIN = Box.centred(4 * PITCH + 1.6, 5 * PITCH + 1.6)
HOLES = lattice_points(PITCH * np.eye(2), CELLULAR, (PITCH / 2, 0.0))


def photographed(seed: int = 2) -> Photographed:
    return Photographed(PixelGrid.centred(360, 300, PIXEL), DOMAIN, HOLES, 1.4, seed)


def truth(strain: float) -> Displacement:
    """A pitchfork: beyond a strain, a pattern whose square grows with the strain."""
    ansatz = Ansatz.on(DOMAIN, [(square_family(), CELLULAR)], PITCH)
    return of(ansatz, ansatz.initial_guess(strain, 20.0 * np.sqrt(max(0.0, strain - CRITICAL))))


def experiment(formulation: str) -> str:
    return (
        '[images]\nreference = "reference.tif"\ndeformed = ["frame*.tif"]\n'
        f"[scale]\npixel_size = {PIXEL}\n[specimen]\ncell_size = {PITCH}\n"
        f'[correlation]\nv0_degree = 2\nv_degree = 1\nformulation = "{formulation}"\n'
    )


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five states, and a photograph of another specimen between the third and the fourth."""
    folder = tmp_path_factory.mktemp("photographs")
    photographed().save(folder, {f"frame_{1e4 * e:03.0f}": truth(e) for e in STRAINS})
    tifffile.imwrite(folder / f"{FOREIGN}x.tif", photographed(seed=9).image(truth(0.052)))
    return folder


@pytest.fixture(scope="module", params=["total", "updated"])
def harvesting(
    request: pytest.FixtureRequest, photographs: Path, tmp_path_factory: pytest.TempPathFactory
) -> HarvestRun:
    """In both formulations."""
    path = photographs / f"{request.param}.toml"
    path.write_text(experiment(request.param))
    folder = tmp_path_factory.mktemp(request.param)
    return HarvestRun(PhotographCase.read(path), folder)


def test_buckling_is_bracketed_and_estimated(harvesting: HarvestRun) -> None:
    found = harvesting.harvest()
    strains = [moment.strain for moment in found.timeline]
    # 0.1 px between two edges that are 217 px apart.
    assert strains == pytest.approx(STRAINS, abs=5e-4)
    assert [moment.has_pattern for moment in found.timeline] == [e > CRITICAL for e in STRAINS]
    buckling = found.buckling
    assert buckling is not None
    assert (buckling.before, buckling.after) == pytest.approx((0.04, 0.05), abs=5e-4)
    assert buckling.estimate == pytest.approx(CRITICAL, abs=5e-4)


def test_every_frame_is_measured(harvesting: HarvestRun) -> None:
    results, shown = harvesting.results(), photographed()
    assert [name for name, _ in harvesting.failures()] == [f"{FOREIGN}x"]
    for strain, measured in zip(STRAINS, results.values(), strict=True):
        assert measured.result.outcome is Outcome.CONVERGED
        off = (measured.result.displacement() - truth(strain)(shown.points))[shown.mask]
        # Before buckling the held mode can't be in the way; the updated formulation inherits
        # what earlier frames err by, and interpolates once more.
        assert np.sqrt(np.mean(off**2)) / PIXEL < 0.03


def test_each_goes_on_from_the_one_before(harvesting: HarvestRun) -> None:
    """As long as it shows what the one before has shown."""
    results = list(harvesting.results().values())
    goes_on = ["started from the result of the photograph before" in " ".join(m.text)
               for m in results]  # fmt: skip
    # The second has a held mode as the first; the third shows a pattern that the second has not.
    assert goes_on == [False, True, False, True, True]


def test_a_test_along_y_has_the_strain_along_y(photographs: Path, tmp_path: Path) -> None:
    for name in ("reference", "frame_400", "frame_600"):
        tifffile.imwrite(tmp_path / f"{name}.tif", tifffile.imread(photographs / f"{name}.tif").T)
    (tmp_path / "total.toml").write_text(experiment("total"))
    found = HarvestRun(PhotographCase.read(tmp_path / "total.toml"), tmp_path / "out").harvest()
    assert [moment.strain for moment in found.timeline] == pytest.approx([0.04, 0.06], abs=5e-4)
    assert [row["strain"] for row in found.numbers] == [m.strain for m in found.timeline]
    assert found.buckling is not None
    assert (found.buckling.before, found.buckling.after) == pytest.approx((0.04, 0.06), abs=5e-4)


def test_what_has_left_the_image_is_no_part_of_the_pattern(tmp_path: Path) -> None:
    def moved(points: np.ndarray) -> np.ndarray:
        return truth(0.06)(points) + np.array([80.0 * PIXEL, 0.0])

    shown = photographed()
    shown.save(tmp_path, {"frame_1": moved})
    text = experiment("total").replace("v_degree = 1", "v_degree = 4")
    (tmp_path / "moved.toml").write_text(text)
    found = HarvestRun(PhotographCase.read(tmp_path / "moved.toml"), tmp_path / "out").harvest()
    (row,), (moment,) = found.numbers, found.timeline
    assert "of the material has left the image" in row["warnings"][0]
    pattern = truth(0.06)(shown.points) - truth(CRITICAL)(shown.points) * 0.06 / CRITICAL
    rms = np.sqrt(np.mean(pattern[shown.mask] ** 2)) / PIXEL
    assert moment.amplitude_px == pytest.approx(rms, rel=0.01)  # extrapolated, it is 3 % off


def test_light_that_changes_along_the_material_is_reported(tmp_path: Path) -> None:
    shown = photographed()
    shown.save(tmp_path, {"frame_1": truth(0.03)})
    light, frame = np.linspace(0.93, 1.0, shown.grid.cols), tmp_path / "frame_1.tif"
    tifffile.imwrite(frame, np.uint8(light * tifffile.imread(frame)))
    none, even = 'brightness = "none"\n', "brightness = 0\n"
    for name, more, count in (("none", none, 1), ("even", even, 1), ("default", "", 0)):
        (tmp_path / f"{name}.toml").write_text(experiment("total") + more)
        case = PhotographCase.read(tmp_path / f"{name}.toml")
        run = HarvestRun(case, tmp_path / name)
        (row,) = run.harvest().numbers
        unknowns = [a for a in run.results()["frame_1"].result.ansatz.names if "gain" in a]
        assert len(unknowns) == {"none": 0, "even": 1, "default": 3}[name]
        assert sum("light changed" in text for text in row["warnings"]) == count


@pytest.mark.parametrize("fade", [0.975, 0.6])
def test_light_that_slopes_and_fades_is_not_taken_for_displacement(
    tmp_path: Path, fade: float
) -> None:
    """Also below the change of 3 % from which on photographs are given the reference's light."""
    shown = photographed()
    shown.save(tmp_path, {"frame_1": truth(0.06)})
    light, frame = fade * np.linspace(0.8, 1.0, shown.grid.rows), tmp_path / "frame_1.tif"
    tifffile.imwrite(frame, np.uint8(np.rint(light[:, None] * tifffile.imread(frame))))
    (tmp_path / "case.toml").write_text(experiment("total"))
    run = HarvestRun(PhotographCase.read(tmp_path / "case.toml"), tmp_path / "out")
    (measured,) = run.results().values()
    off = (measured.result.displacement() - truth(0.06)(shown.points))[shown.mask]
    assert np.sqrt(np.mean(off**2)) / PIXEL < 0.03


def test_free_waves_that_were_not_observable_start_no_correlation() -> None:
    """Before buckling they had drifted to (0.50, 0.36), where the next photographs stayed."""
    domain = Box.centred(6 * PITCH, 5 * PITCH)
    family = free_family([[1.0, -1.0, 1.0, 0.73, 0.0], [1.0, 1.0, -1.0, 0.73, 0.0]])
    ansatz = Ansatz.on(domain, [(family, domain)], PITCH)
    for size, goes_on in ((0.05, False), (20.0, True)):
        a = ansatz.initial_guess(0.04, size)
        covariance = 1e-8 * np.eye(ansatz.size)
        before = Result(
            ansatz, PixelGrid.centred(300, 300, PIXEL), a, covariance, 4.0, 90_000, 0,
            Outcome.CONVERGED, 10.0, slope_square=100.0,
        )  # fmt: skip
        assert _goes_on(before, ansatz, a) == goes_on
