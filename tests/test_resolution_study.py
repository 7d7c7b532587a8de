"""Resolution of parametrised fields: waves and noise against the polynomial degree."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from polynomial_fits import polynomial_transfer

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.report.studies.resolution import measured_waves, noise_floors, report_resolution
from modeharvest.runs.study import StudyCase
from modeharvest.util.errors import InputError
from modeharvest.validation.studies.buckled import LARGEST, AddedWave, BuckledMotion, ResolutionSpec
from modeharvest.validation.studies.resolution import ResolutionAnalysis, ResolutionStudy, one_case
from modeharvest.validation.studies.study import ImagePairSpec as Experiment
from modeharvest.validation.studies.transfer import (
    AXES,
    QUANTITIES,
    WAVED,
    Passband,
    TransferCurves,
    tangent_fit,
    wave_share,
)

FloatArray = NDArray[np.float64]

PIXEL = 0.05
SPECIMEN = Specimen(holes_x=4, holes_y=4)


@pytest.fixture(scope="module")
def spec() -> ResolutionSpec:
    """A small specimen on images of 260 x 260 px."""
    buckled = BuckledMotion(
        SPECIMEN, SquareLatticeOptions(), SpeckleSpec(blur_px=2.0), PIXEL, 0.1, 5.0
    )
    return ResolutionSpec(buckled, (3,), 0.5, 0.01)


@pytest.fixture(scope="module")
def curves(spec: ResolutionSpec) -> TransferCurves:
    return TransferCurves.of(spec, (1, 2, 3))


# -- best fits ----------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("degree", [2, 5])
def test_on_a_full_rectangle_the_transfer_is_bessel_s(degree: int, axis: int) -> None:
    """Points stand for the integral: midpoints of 200 x 200 cells, to 1e-3 for such waves."""
    t = (np.arange(200) + 0.5) / 100.0 - 1.0
    half = np.array([3.0, 5.0])
    points = np.stack(np.meshgrid(*(t * h for h in half)), axis=-1).reshape(-1, 2)
    ansatz = Ansatz(Box.centred(*(2.0 * half)), (), degree, 0)
    period = np.array([3.0, 6.0, 12.0, 30.0])
    phases = [0.0, 0.5 * np.pi]
    waves = np.zeros((len(points), 2, len(period) * len(phases)))
    waves[:, 1] = np.stack(
        [AddedWave("v0", axis, p, phase, 1.0).shape(points) for p in period for phase in phases],
        axis=-1,
    )
    v0, _ = tangent_fit(ansatz, ansatz.initial_guess(), points, waves)
    # The power of both phases together: their shares, weighted by their own power.
    power = (waves**2).sum(axis=(0, 1))
    both = (wave_share(v0, waves) * power).reshape(-1, 2).sum(1) / power.reshape(-1, 2).sum(1)
    expected = polynomial_transfer(degree, 2.0 * half[axis] / period)
    assert both == pytest.approx(expected, abs=1e-3)


def test_the_tangent_is_what_fit_displacement_does_to_small_waves(spec: ResolutionSpec) -> None:
    """The fit's own curvature is what 1e-4 mm of wave leave of the difference."""
    buckled, degree = spec.buckled, 2
    grid = PixelGrid.centred(131, 131, 0.1)
    at = np.stack(np.meshgrid(grid.x, grid.y), axis=-1)
    mask = buckled.material(at[..., 0], at[..., 1])
    ansatz, start = buckled.ansatz(degree, degree), buckled.start(degree, degree)
    for part in WAVED:
        wave = buckled.wave_at(AddedWave(part, 0, 6.0, 0.3, 1e-4), at)
        fit = fit_displacement(buckled.displacement(at) + wave, grid, ansatz, start, mask)
        change = (fit.displacement() - buckled.displacement(at))[mask][..., None]
        linear = tangent_fit(ansatz, start, at[mask], wave[mask][..., None])
        expected = wave_share(sum(linear), wave[mask][..., None])
        assert wave_share(change, wave[mask][..., None]) == pytest.approx(expected, abs=1e-3)


def test_waves_that_the_ansatz_describes_are_found_whole(spec: ResolutionSpec) -> None:
    """Degree by degree less is lost, and long waves come back; nothing goes to the other part."""
    curves = TransferCurves.of(spec, (1, 4))
    for part in WAVED:
        for axis in range(len(AXES)):
            assert (curves.own[part, axis, 4] > curves.own[part, axis, 1] - 0.02).all()
            assert curves.own[part, axis, 4][-1] == pytest.approx(1.0, abs=1e-6)
            assert curves.finest(part, axis, 4) < 0.6 * curves.finest(part, axis, 1)
    anywhere, resolved = curves.cross_talk()
    assert resolved < anywhere < 0.2
    assert resolved < 0.05


def test_the_pattern_is_tuned_and_not_filtered(spec: ResolutionSpec) -> None:
    band = Passband.of(spec, 2)
    mode = int(np.argmin(np.abs(band.stretch - 1.0)))
    assert band.added[mode] == pytest.approx(1.0, abs=1e-9)
    near = np.abs(band.stretch - 1.0) < 0.05
    assert band.itself[near] == pytest.approx(1.0, abs=1e-6)
    assert band.wavelength_error[near].max() < 1e-6
    assert band.retuned >= 0.05
    between = (band.stretch > 0.5) & (band.stretch < 0.6)
    assert band.added[between].max() < 0.3


# -- images -------------------------------------------------------------------------------


def test_images_of_a_formula_are_exact(spec: ResolutionSpec) -> None:
    buckled = spec.buckled
    for wave in (None, AddedWave("v1", 1, 4.0, 0.2, 0.02)):
        base = buckled._base
        points = base.points if wave is None else buckled._improved(base, wave)
        off = points + buckled.displacement(points, wave) - base.at
        assert np.abs(off).max() < 1e-6 * PIXEL
    # phi1 as the ansatz has it, at its largest.
    x, y = np.meshgrid(buckled.grid.x, buckled.grid.y)
    phi = buckled.pattern_at(np.stack([x, y], axis=-1))
    assert np.hypot(phi[..., 0], phi[..., 1]).max() == pytest.approx(LARGEST, rel=0.01)
    ansatz, a = buckled.truth
    at = np.array([[0.3, 0.7], [-1.2, 2.0]])
    assert buckled.displacement(at) == pytest.approx(ansatz.displacement_at(a, at))


def test_material_is_what_the_specimen_is(spec: ResolutionSpec) -> None:
    buckled, s = spec.buckled, SPECIMEN
    area = buckled.material(*np.meshgrid(buckled.grid.x, buckled.grid.y)).sum() * PIXEL**2
    holes = 16 * np.pi * (0.5 * s.diameter) ** 2
    assert area == pytest.approx(4.0 * np.prod(s.half_size) - holes, rel=0.01)
    assert not buckled.material(*s.hole_centres.T).any()
    assert buckled.material(*(s.hole_centres + 0.5 * s.pitch).T).all()


@pytest.fixture(scope="module")
def table(spec: ResolutionSpec, tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    """All cases of a small study, run here."""
    folder = tmp_path_factory.mktemp("resolution")
    experiment = Experiment(
        replace(StudyCase().experiment, specimen=SPECIMEN),
        replace(StudyCase().imaging, pixel_size=PIXEL, speckle=SpeckleSpec(blur_px=2.0)),
        SquareLatticeOptions(),
        None,  # type: ignore[arg-type]  # nothing simulated is measured
    )
    study = ResolutionStudy(
        strain=0.1, pattern=5.0, degrees=(1, 2, 3), measured=(3,), realisations=12
    )
    rows: list[dict[str, Any]] = []
    for case in study.prepare(experiment, folder):
        rows.append({**case, "error": "", **one_case(case, folder)})
    return pd.DataFrame(rows)


def test_images_give_what_best_fits_promise(
    table: pd.DataFrame, spec: ResolutionSpec, curves: TransferCurves
) -> None:
    """The speckle's gradient weighs the fit, by grain: some 700 grains share 10 unknowns.

    So what is lost, a tenth of the power, comes back in part by chance: with a standard deviation
    of sqrt(10 / 700) sqrt(0.1) = 0.04 of the wave.
    """
    waves = measured_waves(table, spec, curves)
    assert len(waves) == len(WAVED) * len(AXES)
    assert waves["difference"].abs().max() < 3.5 * 0.04
    assert abs(waves["difference"].mean()) < 3.5 * 0.04 / np.sqrt(len(waves))
    assert waves["best fit"].to_numpy() == pytest.approx(0.9, abs=1e-3)  # that is what l10 is


def test_scatter_is_what_the_covariance_says(table: pd.DataFrame, spec: ResolutionSpec) -> None:
    floors = noise_floors(table, spec)
    assert len(floors) == 2 * len(QUANTITIES)
    z = (floors["Monte Carlo / predicted"] - 1.0) / floors["±"]
    # Twelve realisations: Student's t, and eight numbers that hang together.
    assert z.abs().max() < 5.0
    assert floors["Monte Carlo / predicted"].mean() == pytest.approx(1.0, abs=0.1)


def test_findings_of_a_resolution_study(
    table: pd.DataFrame, spec: ResolutionSpec, curves: TransferCurves
) -> None:
    found = report_resolution(ResolutionAnalysis.of(table, spec, curves), "seed 0")
    degrees = found.numbers["degrees"]
    finest = [d["finest_px"]["v0 x"] for d in degrees]
    floor = [d["floor_px"]["v0"] for d in degrees]
    assert (np.diff(finest) < 0.0).all()
    assert (np.diff(floor) > 0.0).all()
    for d in degrees:
        mean = np.sqrt(d["finest_px"]["v1 x"] * d["finest_px"]["v1 y"])
        assert d["indicator_px2"]["v1"] == pytest.approx(mean * d["floor_px"]["v1phi1"])
    # Theory: a subset's n l10 is 3.99 sqrt(2) s / G.
    assert 0.3 < found.numbers["affine_subset_indicator_px2"] < 3.0
    assert len(found.figures) == 4
    assert all(draw().axes for draw in found.figures.values())
    assert len(found.text) == 7
    assert not any("nan" in words for words in found.text)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"degrees": (0, 2)}, "degrees from 1 to 12"),
        ({"measured": (9,)}, "measured degrees among"),
        ({"amplitude_px": 5.0}, "amplitude above 0 and up to 2 px"),
        ({"pattern": 0.0}, "a pattern that is not 0 mm"),
        ({"degrees": (3, 3)}, "degrees that differ"),
    ],
)
def test_studies_that_can_t_be_asked(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ResolutionStudy(**options)


def test_the_shipped_study_spells_out_the_defaults() -> None:
    case = StudyCase.read("resolution")
    assert case.study == ResolutionStudy()
    assert case.imaging.pixel_size == 0.02
    quick = case.quick()
    assert quick.study.measured == (5,)
    with pytest.raises(InputError, match="fixed_mode"):
        case.study.require(SquareLatticeOptions(fixed_mode=True))
    with pytest.raises(InputError, match="camera = false"):
        case.study.require(SquareLatticeOptions(camera=True))


def test_a_motion_that_folds_is_refused() -> None:
    folded = BuckledMotion(SPECIMEN, SquareLatticeOptions(), SpeckleSpec(), 0.1, 0.1, 40.0)
    with pytest.raises(InputError, match="folds the specimen"):
        folded.images()
