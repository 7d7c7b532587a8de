"""The star pattern: exact images of a known wave, and grades that agree with theory."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from html_page import Page
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from polynomial_fits import polynomial_transfer
from scipy import ndimage

from modeharvest.cli import root
from modeharvest.idic.local.field import LocalField
from modeharvest.imaging.photographs.files import read_image
from modeharvest.report.model.text import number
from modeharvest.runs.benchmark import grade_star
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json
from modeharvest.validation.scoring.benchmark import Declared
from modeharvest.validation.scoring.star import (
    Star,
    StarSet,
    StarSpec,
    exact_images,
    fine_speckle,
    make_star_set,
)
from modeharvest.validation.scoring.star_grades import (
    Attenuation,
    NoiseFloor,
    StarGrade,
    ranked_grades,
)
from modeharvest.validation.studies.transfer import affine_subset_transfer, finest_period

FloatArray = NDArray[np.float64]

STAR = Star()
SMALL = Star(rows=121, cols=300, shortest_px=8.0, longest_px=80.0)


def filtered(star: Star, weights: FloatArray, noise: FloatArray | None = None) -> FloatArray:
    """(rows, cols) v down as a subset with these separable weights sees it."""
    row, col = np.indices((star.rows, star.cols))
    v = star.down(row, col) if noise is None else star.down(row, col) + noise
    for axis in (0, 1):
        v = ndimage.correlate1d(v, weights, axis=axis)
    return np.asarray(v)


def field(star: Star, v_down: FloatArray, half: int, step: int, name: str = "filter") -> LocalField:
    """The centres of subsets, of which none leaves the image."""
    row, col = np.mgrid[half : star.rows - half : step, half : star.cols - half : step]
    v = v_down[row, col].ravel()
    at = star.grid.to_mm(row.ravel(), col.ravel())
    return LocalField(*at, np.column_stack([0.0 * v, -v]), source=name)


# -- theory -------------------------------------------------------------------------------


def test_an_affine_subset_of_17_px_loses_a_tenth_at_67_8_px() -> None:
    """The number of the DIC Challenge 2.0; the closed form against a fit of a plane to the wave."""
    period, offsets = np.geomspace(4.0, 500.0, 40), np.arange(-8.0, 9.0)
    wave = np.cos(2.0 * np.pi * offsets / period[:, None])
    fitted = wave @ np.linalg.pinv(np.vander(offsets, 2))[1]
    assert affine_subset_transfer(17, period) == pytest.approx(fitted, abs=1e-14)
    finest = finest_period(lambda p: affine_subset_transfer(17, p), 10.0, 1000.0)
    assert finest == pytest.approx(67.8, abs=0.05)


@pytest.mark.parametrize(("degree", "waves"), [(1, (0.4, 0.0)), (4, (1.6, 0.0)), (5, (1.2, 0.9))])
def test_polynomials_over_a_rectangle(degree: int, waves: tuple[float, float]) -> None:
    """Bessel's formula against a least-squares fit on Gauss's points, exact to rounding."""
    t, w = np.polynomial.legendre.leggauss(40)
    x, y = (a.ravel() for a in np.meshgrid(t, t))
    root_weight = np.sqrt(np.outer(w, w).ravel())
    wave = np.exp(1j * np.pi * (waves[0] * x + waves[1] * y)) * root_weight
    orders = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    basis = np.stack([x**i * y**j for i, j in orders], axis=-1) * root_weight[:, None]
    fit = basis @ np.linalg.lstsq(basis, wave, rcond=None)[0]
    share = (fit.conj() @ wave).real / (wave.conj() @ wave).real
    assert float(polynomial_transfer(degree, *waves)) == pytest.approx(share, abs=1e-12)


@pytest.mark.parametrize("degree", range(1, 9))
def test_a_rule_for_the_finest_period_of_polynomials(degree: int) -> None:
    """L / (0.17 + 0.327 p), docs/explanation/resolution.md: 0.5 % from Bessel's formula."""
    finest = finest_period(lambda period: polynomial_transfer(degree, 1.0 / period), 0.1, 20.0)
    assert finest == pytest.approx(1.0 / (0.17 + 0.327 * degree), rel=5e-3)


def test_no_transfer_is_extrapolated() -> None:
    with pytest.raises(InputError, match="rises through"):
        finest_period(lambda p: affine_subset_transfer(17, p), 5.0, 60.0)


# -- images -------------------------------------------------------------------------------


def test_the_period_grows_linearly_and_the_centre_row_moves_as_one() -> None:
    assert STAR.period([0, 3999]).tolist() == [10.0, 300.0]
    assert np.ptp(np.diff(STAR.period(np.arange(4000)))) < 1e-12
    assert STAR.column(STAR.period(1234)) == pytest.approx(1234)
    assert (STAR.down(250, np.arange(4000)) == 0.5).all()
    # A period further down the motion is the same again, half a period down the opposite.
    col = np.array([0, 1500, 3000])
    assert STAR.down(250 + STAR.period(col), col) == pytest.approx(0.5)
    assert STAR.down(250 + 0.5 * STAR.period(col), col) == pytest.approx(-0.5)
    # In the project's frame y is up, and so is v.
    at = STAR.grid.to_mm(260, 700)
    assert STAR.displacement(*at).tolist() == [0.0, -STAR.down(260, 700)]


def test_deformed_pixels_show_the_points_that_moved_there() -> None:
    came_from, residual_px = SMALL.came_from()
    row, col = np.indices(came_from.shape)
    assert np.abs(came_from + SMALL.down(came_from, col) - row).max() == residual_px
    assert residual_px < 1e-13
    # A centre row that moves by a whole pixel is seen one row further down, grey level by level.
    star = replace(SMALL, amplitude_px=1.0)
    f, g, _ = exact_images(star, fine_speckle())
    assert g[61] == pytest.approx(f[60], abs=1e-9)
    assert np.abs(g[60] - f[60]).max() > 0.1


@given(shortest=st.floats(4.0, 40.0), ratio=st.floats(1.5, 30.0), steepness=st.floats(0.01, 0.9))
@settings(max_examples=15)
def test_any_star_can_be_inverted(shortest: float, ratio: float, steepness: float) -> None:
    amplitude = steepness * shortest / (2.0 * np.pi)
    star = Star(31, 100, amplitude, shortest, ratio * shortest)
    came_from, residual_px = star.came_from()
    assert residual_px < 1e-12
    assert (np.diff(came_from, axis=0) > 0.0).all()  # nothing folds


def test_a_star_by_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*options: str) -> int:
        command = ["modeharvest", "benchmark", "star", "--out", str(tmp_path / "s"), *options]
        monkeypatch.setattr(sys, "argv", command)
        with pytest.raises(SystemExit) as exited:
            root.main()
        return int(exited.value.code or 0)

    assert run("--rows", "31", "--cols", "100", "--noise", "0.01", "--noise", "0.03") == 0
    message = capsys.readouterr().out
    assert "8 images of 31 x 100 px" in message
    assert StarSet.read(tmp_path / "s").spec.noise == (0.01, 0.03)
    assert run("--rows", "30") == 2
    predicted = capsys.readouterr().err
    assert "odd number of rows" in " ".join(predicted.split())


def test_a_star_set_can_be_made_again_and_tells_all(tmp_path: Path) -> None:
    spec = StarSpec(SMALL, noise=(0.005, 0.02))
    made = make_star_set(spec, tmp_path)
    assert len(made.info["files"]) == 2 + 2 * 3
    for name in made.info["files"]:
        assert name in (tmp_path / "README.md").read_text("utf-8")
    written = (tmp_path / "deformed.tif").stat().st_mtime_ns
    again = make_star_set(spec, tmp_path)
    assert again.id == made.id
    assert (tmp_path / "deformed.tif").stat().st_mtime_ns == written
    assert StarSet.read(tmp_path).spec == spec
    (tmp_path / "deformed.tif").unlink()
    assert make_star_set(spec, tmp_path).id == made.id
    # Noise without motion, and independent in all images.
    f = read_image(tmp_path / "reference.tif")
    a, b = (read_image(tmp_path / f"{role}_2pct.tif") - f for role in ("reference", "still"))
    for n in (a, b):
        assert n.std() == pytest.approx(0.02, rel=5 / np.sqrt(2 * n.size))
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 5 / np.sqrt(a.size)


# -- grades -------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "step"), [(9, 3), (17, 4), (33, 8)])
def test_grading_finds_the_period_of_a_known_filter(width: int, step: int) -> None:
    """Rows off the centre see waves up to 2 % shorter; 0.1 % is what they may change."""
    weights = np.full(width, 1.0 / width)
    found = Attenuation.of(STAR, field(STAR, filtered(STAR, weights), width // 2, step))
    expected = finest_period(lambda p: affine_subset_transfer(width, p), 5.0, 1000.0)
    assert found.finest_px == pytest.approx(expected, rel=1e-3)
    assert found.safe_px == found.finest_px
    some = (found.period > 1.5 * width) & (found.period < 250.0)
    expected_curve = affine_subset_transfer(width, found.period[some])
    assert found.curve[0][some] == pytest.approx(expected_curve, abs=5e-3)
    # The Challenge's polynomial is a bit off where the curve is steep.
    assert found.challenge_px == pytest.approx(expected, rel=0.05)


def test_errors_of_resolution_and_noise_are_as_large_as_predicted() -> None:
    """Twenty realisations of white noise through a filter: chi squared of both, 99.9 %."""
    star = Star(rows=121, cols=1200, shortest_px=10.0, longest_px=100.0)
    width, noise = 9, 0.05
    weights = np.full(width, 1.0 / width)
    expected = Attenuation.of(star, field(star, filtered(star, weights), width // 2, 3)).finest_px
    rng = np.random.default_rng(0)
    z, floors = [], []
    for _ in range(20):
        images = noise * rng.normal(size=(2, star.rows, star.cols))
        moved = Attenuation.of(star, field(star, filtered(star, weights, images[0]), 4, 3))
        z.append((moved.finest_px - expected) / moved.finest_se_px)
        still = filtered(star, weights, images[1]) - filtered(star, weights)
        floors.append(NoiseFloor.of(star, field(star, still, 4, 3)))
    assert 5.9 < np.sum(np.square(z)) < 45.3
    n = np.array([floor.v_px for floor in floors])
    assert n.mean() == pytest.approx(noise / width, rel=0.02)  # white noise over w^2 px
    predicted = np.mean([floor.v_se_px for floor in floors])
    assert predicted == pytest.approx(n.std(ddof=1), rel=0.6)


def test_the_indicator_hardly_depends_on_the_size_of_the_subset(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    noise = 0.02 * rng.normal(size=(STAR.rows, STAR.cols))
    grades = []
    for width in (9, 17, 33):
        weights = np.full(width, 1.0 / width)
        still = filtered(STAR, weights, noise) - filtered(STAR, weights)
        name = f"{width} px"
        moved = field(STAR, filtered(STAR, weights), width // 2, 5, name)
        grades.append(StarGrade(STAR, moved, field(STAR, still, width // 2, 5)))
    indicators = np.array([grade.indicator_px2 for grade in grades])
    assert np.ptp(indicators) < 0.05 * indicators.mean()
    # 3.99 w at 0.02 / w, Dirichlet's kernel for many pixels.
    assert indicators == pytest.approx(3.99 * 0.02, rel=0.03)
    lone = StarGrade(STAR, grades[0].moved)
    assert ranked_grades([lone, *grades])[-1] is lone
    assert "n is not known" in lone.notes[0]


@pytest.fixture(scope="module")
def star_set(tmp_path_factory: pytest.TempPathFactory) -> StarSet:
    return make_star_set(StarSpec(SMALL), tmp_path_factory.mktemp("star"))


def short_of(code: dict[str, float]) -> str:
    """As the page writes it."""
    return f">{number(code['finest_px'])}<"


def write(path: Path, star_set: StarSet, v: FloatArray, u: FloatArray | None = None) -> Path:
    """A field at every third pixel as a code would return it, y and v down."""
    star = star_set.spec.star
    row, col = np.mgrid[0 : star.rows : 3, 0 : star.cols : 3]
    u = np.zeros_like(v) if u is None else u
    table = np.column_stack([a.ravel() for a in (col, row, u[row, col], v[row, col])])
    head = f"# benchmark: {star_set.id}\nx [px],y down [px],u [px],v down [px]"
    np.savetxt(path, table, "%.6f", ",", header=head, comments="")
    return path


def test_two_codes_from_their_files_to_the_report(
    star_set: StarSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    rng = np.random.default_rng(2)
    noise = 0.02 * rng.normal(size=(SMALL.rows, SMALL.cols))
    fields, stills = [], []
    for width in (5, 11):
        weights = np.full(width, 1.0 / width)
        v = filtered(SMALL, weights)
        quiet = filtered(SMALL, weights, noise) - v
        v[60, 150:180] = np.nan
        fields.append(str(write(tmp_path / f"w{width}.csv", star_set, v)))
        stills += ["--still", str(write(tmp_path / f"s{width}.csv", star_set, quiet))]
    out = tmp_path / "graded"
    command = ["modeharvest", "benchmark", "resolution", *fields, *stills, "--name", "fine",
               "--name", "coarse", "--set", str(star_set.folder), "--out", str(out)]  # fmt: skip
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as exited:
        root.main()
    assert not exited.value.code
    content = read_json(out / "resolution.json")
    codes = {code["name"]: code for code in content["codes"]}
    for name, width in (("fine", 5), ("coarse", 11)):
        expected = finest_period(lambda p, w=width: affine_subset_transfer(w, p), 5.0, 500.0)
        assert codes[name]["finest_px"] == pytest.approx(expected, rel=0.02)
        assert codes[name]["noise_px"] == pytest.approx(0.02 / width, rel=0.1)
        assert codes[name]["returned_percent"] < 100.0
    assert content["benchmark"] == star_set.id
    assert "were not measured" in capsys.readouterr().out
    text = (out / "report.html").read_text("utf-8")
    page = Page(text)
    assert {"ranking", "attenuation", "trade-off", "row-0", "error-1", "findings"} <= set(page.ids)
    assert all(source.startswith("data:") for source in page.sources)
    assert short_of(codes["fine"]) in text
    assert len((out / "resolution.csv").read_text("utf-8").splitlines()) == 3


def test_what_can_t_be_graded_is_reported_in_a_line(star_set: StarSet, tmp_path: Path) -> None:
    row, col = np.indices((SMALL.rows, SMALL.cols))
    v = SMALL.down(row, col)

    def grade(path: Path, still: Path | None = None, **declared: str) -> None:
        stills = {} if still is None else {still: Declared()}
        grade_star({path: Declared(**declared)}, stills, star_set.folder, tmp_path / "out")

    good = write(tmp_path / "good.csv", star_set, v)
    other = tmp_path / "other.csv"
    other.write_text(good.read_text("utf-8").replace(star_set.id, "0123456789ab"), "utf-8")
    with pytest.raises(InputError, match="expected a field of benchmark"):
        grade(other)
    with pytest.raises(InputError, match="without motion, or of other images"):
        grade(write(tmp_path / "still.csv", star_set, 0.01 * v))
    with pytest.raises(InputError, match="v has the other sign"):
        grade(write(tmp_path / "up.csv", star_set, -v))
    with pytest.raises(InputError, match="look exchanged"):
        grade(write(tmp_path / "turned.csv", star_set, 0.0 * v, v))
    with pytest.raises(InputError, match="is it the star's"):
        grade(good, write(tmp_path / "loud.csv", star_set, v))
    with pytest.raises(InputError, match="in px, got mm"):
        grade(good, units="mm")
    short = np.where((col > 40) & (col < 120), v, np.nan)
    with pytest.raises(InputError, match="over periods from 8 to 80 px, got"):
        grade(write(tmp_path / "short.csv", star_set, short))
    narrow = np.where((col > 40) & (col < 60), v, np.nan)
    with pytest.raises(InputError, match="20 columns or more"):
        grade(write(tmp_path / "narrow.csv", star_set, narrow))
    with pytest.raises(InputError, match="expected a star set"):
        StarSet.read(tmp_path)


def test_without_a_crossing_nothing_is_extrapolated() -> None:
    row, col = np.indices((SMALL.rows, SMALL.cols))
    exact = StarGrade(SMALL, field(SMALL, SMALL.down(row, col), 1, 3))
    assert np.isnan(exact.attenuation.finest_px)
    assert "less than 10 % of the amplitude is lost at all periods" in exact.notes[0]
    weights = np.full(25, 1.0 / 25)  # its finest period is 100 px, the star's longest 80 px
    coarse = StarGrade(SMALL, field(SMALL, filtered(SMALL, weights), 12, 3))
    assert np.isnan(coarse.attenuation.finest_px)
    assert "10 % or more of the amplitude is lost" in coarse.notes[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rows": 500}, "odd number of rows"),
        ({"amplitude_px": 2.0}, "2 pi amplitude <= 0.9 shortest"),
        ({"longest_px": 5.0}, "a longer longest one"),
    ],
)
def test_stars_that_can_t_be(options: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Star(**options)  # type: ignore[arg-type]


def test_one_bad_field_does_not_keep_the_good_ones_from_being_graded(
    star_set: StarSet, tmp_path: Path
) -> None:
    row, col = np.indices((SMALL.rows, SMALL.cols))
    good = write(tmp_path / "good.csv", star_set, SMALL.down(row, col))
    bad = tmp_path / "bad.csv"
    bad.write_text("not a field\n", "utf-8")
    done = grade_star({bad: Declared(), good: Declared()}, {}, star_set.folder, tmp_path / "out")
    assert [grade.name for grade in done.grades] == ["good"]
    assert list(done.refused) == [str(bad)]
    assert done.notes[0].startswith("not graded: ")
