"""Studies: what their tables tell, what runs them, what is left, and bad input in one line."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pandas as pd
import pytest
from html_page import Page, frame
from scipy import stats
from summary_schemas import faults
from test_cli import called, error_line

from modeharvest.fem.field import Solution
from modeharvest.imaging.pair import ImagePair
from modeharvest.report.studies.noise import report_noise
from modeharvest.report.studies.robustness import report_robustness
from modeharvest.report.studies.systematic import report_systematic
from modeharvest.runs.case import shipped_cases, shipped_solution
from modeharvest.runs.study import StudyAnalysis, StudyCase
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, write_json
from modeharvest.util.stages import source_digest
from modeharvest.validation.campaign import Campaign
from modeharvest.validation.studies import noise as noise_causes
from modeharvest.validation.studies.noise import NoiseStudy, one_realisation
from modeharvest.validation.studies.noise_statistics import PairedErrors
from modeharvest.validation.studies.robustness import (
    SAME_PX,
    RobustnessStudy,
    one_start,
    success_interval,
)
from modeharvest.validation.studies.study import ImagePairSpec, StudySetting, VirtualImagePair
from modeharvest.validation.studies.systematic import FACTORS, SystematicStudy, one_level
from modeharvest.validation.workers import run_case, store

pytestmark = pytest.mark.usefixtures("coarse_pictures")

PAPER = shipped_solution("paper-virtual")
TINY = """
title = "A <tiny> study"
[study]
kind = "robustness"
initial_guesses = 2
radii = [0.5]
per_radius = 1
strain_errors = []
[imaging]
pixel_size = 0.05
"""


@pytest.fixture(scope="module")
def spec() -> ImagePairSpec:
    """The paper's specimen on images of 0.05 mm/px, which take a tenth of a second."""
    case = StudyCase()
    imaging = replace(case.imaging, pixel_size=0.05)
    return ImagePairSpec(case.experiment, imaging, case.correlation, lambda: Solution.read(PAPER))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("studies")


def guesses_table(distances: list[float], outcomes: list[str] | None = None) -> pd.DataFrame:
    """A table as a robustness study of one radius leaves it."""
    n = len(distances)
    return pd.DataFrame({
        "radius": 0.1, "start": range(n), "strain_error": 0.0, "seed": 0, "error": "",
        "distance_px": distances, "start_distance_px": 9.0,
        "epsilon_percent": np.array(distances), "outcome": outcomes or ["converged"] * n,
        "iterations": 5, "all_iterations": 20, "residual": 0.01,
    })  # fmt: skip


# -- robustness ---------------------------------------------------------------------------


@pytest.mark.parametrize(("good", "n"), [(98, 100), (100, 100), (0, 7), (3, 5)])
def test_intervals_are_wilson_s(good: int, n: int) -> None:
    """Against the score test that they invert: its p-value at their ends is 5 %."""
    low, high = success_interval(good, n)
    share = good / n
    for end, is_open in ((low, share > 0.0), (high, share < 1.0)):
        if is_open:
            z = (share - end) / np.sqrt(end * (1.0 - end) / n)
            assert 2.0 * stats.norm.sf(abs(z)) == pytest.approx(0.05, rel=1e-9)
        else:
            assert end == pytest.approx(share, abs=1e-12)


def test_numbers_of_a_robustness_study() -> None:
    table = guesses_table([1e-9] * 97 + [0.5, 2.0, 4.0])
    table.loc[98, "outcome"] = "local_minimum"
    table.loc[99, ["error", "outcome"]] = ["MemoryError: too large", None]
    table.loc[99, ["distance_px", "epsilon_percent"]] = np.nan
    found = report_robustness(RobustnessStudy().analyse(table, Path()), "seed 0")
    numbers = found.numbers
    assert (numbers["initial_guesses"], numbers["same_minimum"], numbers["failed"]) == (100, 97, 1)
    assert numbers["success"] == 0.97
    assert numbers["outliers"] == 1  # 2 % is above the paper's 1.5 %
    assert numbers["mean_epsilon_percent"] == pytest.approx(2.5 / 99)
    assert numbers["mean_epsilon_without_outliers_percent"] == pytest.approx(0.5 / 98)
    assert numbers["largest_distance_px"] == 2.0
    assert numbers["other_minimum_called_converged"] == 1
    assert found.text[0].startswith("97 of 100 initial guesses")
    assert any("failed: 1. They count as not converged" in s for s in found.text)
    # Its epsilon is 0.5 %.
    assert any("does not detect 1 of the 2 results in other" in s for s in found.text)
    assert any("2 in other minima, 1 are called converged" in s for s in found.text)


def test_the_basin_ends_where_the_first_start_is_lost() -> None:
    parts = []
    for radius, lost in ((0.05, 0), (0.1, 0), (0.2, 1), (0.3, 0), (0.5, 3)):
        part = guesses_table([9.0] * lost + [1e-9] * (4 - lost), ["local_minimum"] * lost
                            + ["converged"] * (4 - lost))  # fmt: skip
        parts.append(part.assign(radius=radius))
    table = pd.concat(parts, ignore_index=True)
    found = report_robustness(RobustnessStudy().analyse(table, Path()), "seed 0")
    (message,) = [s for s in found.text if "All initial guesses converge" in s]
    assert "up to 10 % off" in message
    assert "50 %: 1 of 4" in message
    basin = frame(found.tables, "Basin of convergence")
    assert list(basin["same minimum"]) == [4, 4, 3, 4, 1]
    assert list(basin["other minima detected"]) == [
        "0 of 0",
        "0 of 0",
        "1 of 1",
        "0 of 0",
        "3 of 3",
    ]


def test_one_start_against_a_calculation_of_its_own(spec: ImagePairSpec, folder: Path) -> None:
    study = RobustnessStudy(initial_guesses=1, radii=(), strain_errors=(-0.5,))
    near, far = study.prepare(spec, folder)
    found = one_start(near, folder)
    pair = VirtualImagePair.open(folder, near["images"])
    nominal = pair.correlate()
    start = pair.initial_guess()
    unit = np.random.default_rng([0, 0]).uniform(-1.0, 1.0, 7)
    start[pair.ansatz.phi_slice(0)] += 0.1 * unit * np.array([1] * 5 + [1.9] * 2)
    end = pair.correlate(start)
    u, other = (r.displacement()[::4, ::4][pair.mask[::4, ::4]] / 0.05 for r in (nominal, end))
    norm, other_norm = np.linalg.norm(u), np.linalg.norm(other)
    epsilon = 100.0 * abs(norm - other_norm) / norm
    assert found["epsilon_percent"] == pytest.approx(epsilon, rel=1e-6, abs=1e-12)
    distance = np.linalg.norm(u - other) / np.sqrt(len(u))
    assert found["distance_px"] == pytest.approx(distance, rel=1e-6, abs=1e-12)
    assert found["distance_px"] < SAME_PX < found["start_distance_px"]
    assert one_start(far, folder)["start_distance_px"] > 1.0


# -- noise --------------------------------------------------------------------------------


def normal_pairs(bias: float = 0.0, predicted_by: float = 1.0, pairs: int = 400) -> PairedErrors:
    """Errors at the bound, with a bias [bounds]; the bound differs from one to the next."""
    bound = np.array([1.0, 2.0, 5.0])
    noise = np.random.default_rng(1).normal(size=(pairs, 1, 3)) * np.array([1.0, -1.0])[:, None]
    errors = (noise + bias) * bound
    return PairedErrors(errors, np.full(errors.shape, predicted_by) * bound, bound)


def test_statistics_of_errors_at_the_bound() -> None:
    pairs = normal_pairs()
    # 400 pairs, whose two errors have the same square: 1/sqrt(2 * 400) = 3.5 % a quantity.
    assert pairs.ratios == pytest.approx(np.ones(3), abs=0.15)
    assert abs(pairs.ratio.value - 1.0) < 4.0 * pairs.ratio.error < 0.2
    assert abs(pairs.coverage.value - 0.95) < 4.0 * pairs.coverage.error < 0.05
    assert pairs.bias.value < 1e-12  # n and -n leave nothing
    assert pairs.biases == pytest.approx(np.zeros(3), abs=1e-12)
    assert pairs.standardised.rms_bound == 1.0


def test_a_bias_and_error_bars_that_are_too_short_are_seen() -> None:
    assert normal_pairs(bias=0.3).bias.value == pytest.approx(0.3, abs=1e-9)
    assert normal_pairs(bias=0.3).biases == pytest.approx(np.full(3, 0.3))
    short = normal_pairs(predicted_by=0.5)
    expected = 1.0 - 2.0 * stats.norm.sf(0.5 * 1.959964)
    assert abs(short.coverage.value - expected) < 4.0 * short.coverage.error


def test_the_same_errors_against_a_larger_bound() -> None:
    """Error bars that are half as long as the errors are right against a bound twice as large."""
    short = normal_pairs(predicted_by=0.5)
    long = short.against(np.full(3, 2.0))
    assert long.ratio.value == pytest.approx(0.5 * short.ratio.value)
    assert long.bias.value == pytest.approx(0.5 * short.bias.value, abs=1e-12)
    assert str(long.coverage) == str(normal_pairs().coverage)


def test_what_no_noise_moves_does_not_count() -> None:
    pairs = normal_pairs()
    zero = np.zeros((400, 2, 2))
    more = PairedErrors(np.concatenate([pairs.errors, zero], axis=2),
                 np.concatenate([pairs.predicted, zero], axis=2),
                 np.concatenate([pairs.bound, [0.0, 0.0]]))  # fmt: skip
    for name in ("ratio", "bias", "coverage"):
        assert str(getattr(more, name)) == str(getattr(pairs, name))
    assert np.isnan(more.ratios[3:]).all()
    assert np.isnan(more.covered[3:]).all()


def test_without_a_residual_the_cost_is_as_stiff_as_gauss_and_newton_say(
    spec: ImagePairSpec, folder: Path
) -> None:
    """And softer with one, if only a little where w is short against a speckle."""
    pair = VirtualImagePair.open(folder, spec.describe(folder, 0.128))
    result = pair.correlate()
    seen = pair.matched(result)
    # Chosen at the end itself, not a step before it.
    assert seen.used.sum() == pytest.approx(result.pixels, rel=0.01)
    without_residual = noise_causes.zero_residual(seen)
    left = result.residual(
        ImagePair(without_residual.reference, without_residual.deformed, result.grid)
    )[seen.used]
    assert np.abs(left).max() < 1e-6  # float32
    without, corrected = (np.sqrt(np.diag(s.inverse_hessian)) for s in (without_residual, seen))
    gauss_newton = np.sqrt(np.diag(result.inverse))
    assert without == pytest.approx(gauss_newton, rel=0.05)  # other pixels, at the edges
    assert (corrected > without).mean() > 0.9


def test_noise_study_on_tiny_images(
    spec: ImagePairSpec, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(noise_causes, "EXAMPLES", 3)
    study = NoiseStudy(levels=(0.002,), pairs=2)
    cases = study.prepare(spec, folder)
    assert len(cases) == 5
    rows = [{**case, "error": "", **one_realisation(case, folder)} for case in cases]
    found = report_noise(study.analyse(pd.DataFrame(rows), folder), study.seeds)
    summary = frame(found.attachments, "Noise levels").set_index("quantity")
    # Eight of 77 x 4 errors' standard deviations: the bound to within a factor.
    assert 0.6 < summary.loc["all unknowns", "rms error / bound"] < 1.6
    assert 0.6 < summary.loc["u", "rms error / bound"] < 1.6
    assert len(frame(found.attachments, "Each unknown")) == 77
    plots = {"causes", "bars", "ratio", "bias", "coverage", "unknowns", "maps"}
    assert plots == set(found.figures)
    assert all(draw().axes for draw in found.figures.values())
    # n and -n push the other way: what is common to them is of second order.
    plus, minus = (np.array(r["unknowns"]) - rows[0]["unknowns"] for r in rows[1:3])
    assert np.linalg.norm(plus + minus) < 0.5 * np.linalg.norm(plus - minus)
    with pytest.raises(InputError, match="two whole pairs"):
        study.analyse(pd.DataFrame(rows[:4]), folder)


# -- systematic errors --------------------------------------------------------------------


def test_systematic_study_on_tiny_images(spec: ImagePairSpec, folder: Path) -> None:
    study = SystematicStudy(
        factors=("order", "gradient", "bits"),
        levels={"bits": (2, 10), "gradient": ("reference", "deformed")},
        seeds_of_speckle=(0,),
    )
    cases = study.prepare(spec, folder)  # the base leaves order and gradient to the images
    factors = ["base", *["order"] * 3, *["gradient"] * 2, *["bits"] * 2]
    assert [c["factor"] for c in cases] == factors
    rows = [{**case, "error": "", **one_level(case, folder)} for case in cases]
    kept = {
        VirtualImagePair.images_folder(folder, c["images"]).is_dir() for c in cases if c["keep"]
    }
    gone = {
        VirtualImagePair.images_folder(folder, c["images"]).is_dir() for c in cases if not c["keep"]
    }
    assert (kept, gone) == ({True}, {False})
    found = report_systematic(study.analyse(pd.DataFrame(rows), folder), study.seeds)
    levels = frame(found.tables, "Every level").set_index(["name", "level"])
    moved = levels["moved from the base [px]"]
    assert moved["order", 5] == 0.0
    assert 0.0 < moved["bits", 10] < 0.1 * moved["bits", 2]  # rounding errors: 341 times
    w, best, lost = (rows[0][name] for name in ("w_px", "model_error_px", "measurement_error_px"))
    assert best < w < best + lost  # the best fit is the best; the triangle inequality
    assert moved["gradient", "reference"] > 0.0
    assert moved["gradient", "deformed"] == 0.0


def test_every_factor_has_levels_that_can_be_set() -> None:
    case = StudyCase()
    base = StudySetting(case.imaging, case.correlation)
    for name, factor in FACTORS.items():
        changed = [factor.set(base, level) for level in factor.levels]
        assert len({repr(setting) for setting in changed}) == len(changed), name
        own = factor.base(base)
        if own is not None:
            assert factor.set(base, own) == base, name
        else:
            assert factor.base(changed[0]) == pytest.approx(factor.levels[0])


# -- cases --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["robustness", "noise", "systematic"])
def test_shipped_studies_spell_out_the_defaults(name: str) -> None:
    case = StudyCase.read(name)
    assert case.kind == name
    assert case.study == type(case.study)()
    assert case == StudyCase(title=shipped_cases("study")[name], study=case.study)
    assert len(json.dumps(case.plain())) > 100


def test_a_quick_study_is_smaller() -> None:
    for name in shipped_cases("study"):
        case = StudyCase.read(name)
        assert case.quick().imaging.pixel_size == 2.0 * case.imaging.pixel_size
    assert RobustnessStudy().quick().initial_guesses == 20
    assert NoiseStudy().quick().pairs == 5
    assert SystematicStudy().quick().levels["v_degree"] == (2, 5, 8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[study]\nkind = "robustnes"', "kind among"),
        ("[study]\ninitial_guess = 3", "did you mean 'initial_guesses"),
        ("[study]\ninitial_guesses = 0", "expected 1 to 100000 initial guesses"),
        ("[study]\nradius = 1.5", "radii above 0"),
        ("[study]\nradii = [0.1]", "other than radius"),
        ("[study]\nradii = [0.2, 0.2]", "radii that differ"),
        ("[study]\nstrain = 0.1", "among experiment.strains"),
        ("[study]\n[correlation]\nfixed_mode = true", "fixed_mode = false"),
        ('[study]\nkind = "noise"\nlevels = [1.0]', "levels above 0"),
        ('[study]\nkind = "noise"\npairs = 1', "expected 2 to 100000 pairs"),
        ('[study]\nkind = "noise"\n[correlation]\ncamera = true', "camera = false"),
        ('[study]\nkind = "systematic"\nfactors = ["colour"]', "factors among"),
        ('[study]\nkind = "systematic"\nfactors = ["order"]\nlevels.bits = [8]', "only"),
        ('[study]\nkind = "systematic"\nseeds_of_speckle = []', "seed of a speckle"),
        ('[study]\nkind = "systematic"\nlevels.gradient = ["mine"]', "one of ['deformed'"),
        ('[study]\nkind = "systematic"\nlevels.bits = ["8"]', "expected numbers"),
        ("[study]\n[imagin]\nbits = 8", "did you mean 'imaging'?"),
        ('[imaging]\ndistortion = "lens.json"\n[study]', "perfect lens"),
        ("[experiment]", "expected a table [study]"),
    ],
)
def test_a_wrong_study_is_reported_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "study.toml"
    path.write_text(text, "utf-8")
    with pytest.raises(InputError) as caught:
        StudyCase.read(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_levels_out_of_range_are_reported_before_anything_runs(
    spec: ImagePairSpec, folder: Path
) -> None:
    for name, level, message in (
        ("order", 4.5, "whole numbers"),
        ("order", 4, "order 3, 5 or 11"),
        ("gradient", 3, "one of .*'reference'"),
        ("taper", -1.0, "wider than 0"),
        ("speckle_size", 0.0, "above 0 times"),
        ("fill_factor", 2.0, "fill factor of 0"),
    ):
        with pytest.raises(InputError, match=message):
            SystematicStudy(factors=(name,), levels={name: (level,)}).prepare(spec, folder)


def test_a_solution_of_another_experiment_is_not_taken(spec: ImagePairSpec, tmp_path: Path) -> None:
    name = spec.describe(tmp_path, 0.128)
    (tmp_path / "solution.h5").unlink()
    first = spec.solution.snapshots[0]
    other = replace(spec.solution, snapshots=(replace(first, nominal_strain=0.128),))
    other.write(tmp_path / "solution.h5")
    with pytest.raises(InputError, match="found another"):
        VirtualImagePair.open(tmp_path, name)


# -- the command --------------------------------------------------------------------------


def test_a_study_from_the_command_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    case, out = tmp_path / "tiny.toml", tmp_path / "out"
    case.write_text(TINY, "utf-8")
    arguments = ("study", case, "--out", out, "--solution", PAPER, "--workers", "1")
    assert called(monkeypatch, *arguments) == 0
    assert "2 of 2 initial guesses" in (printed := capsys.readouterr().out)
    assert "report.html" in printed
    summary = read_json(out / "summary.json")
    assert faults(summary, "study") == []
    assert summary["numbers"]["initial_guesses"] == 2
    assert summary["failed"] == []
    assert len(pd.read_csv(out / "table.csv")) == 3
    check_page((out / "report.html").read_text("utf-8"), summary)

    # Again: nothing is run twice, it needs no workers at all, and other results are named.
    write_json(out / "cases" / "old.json", {"version": "0.0.0", "error": "", "result": {}})
    before = {path: path.stat().st_mtime_ns for path in (out / "cases").iterdir()}
    monkeypatch.setattr("modeharvest.validation.workers.Workers.client", None)
    assert called(monkeypatch, *arguments) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "cases").iterdir()} == before
    assert "1 stored results of modeharvest 0.0.0" in (out / "report.html").read_text()


def test_a_folder_with_something_else_is_not_taken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for name, content, message in (
        ("study.json", {"kind": "noise"}, "which holds a noise study"),
        ("summary.json", {}, "which holds something that is no study"),
    ):
        out = tmp_path / name
        write_json(out / name, content)
        (tmp_path / "tiny.toml").write_text(TINY, "utf-8")
        assert called(monkeypatch, "study", tmp_path / "tiny.toml", "--out", out) == 2
        rows = capsys.readouterr().err.splitlines()
        (line,) = [row for row in rows if row.startswith("error:")]
        assert message in line
        assert [path.name for path in out.iterdir()] == [name]  # nothing was touched


def threads(case: Mapping[str, Any], folder: Path) -> dict[str, int]:
    """A case that tells how many threads its kernels have."""
    return {"threads": numba.get_num_threads()}


def test_a_case_has_one_thread(tmp_path: Path) -> None:
    before = numba.get_num_threads()
    try:
        run_case("test_studies:threads", {}, str(tmp_path), source_digest())
        (path,) = (tmp_path / "cases").iterdir()
        assert read_json(path)["result"] == {"threads": 1}
    finally:
        numba.set_num_threads(before)


def test_failures_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder in which one of two starts failed, and none is left to be run."""
    case = StudyCase(study=RobustnessStudy(initial_guesses=2, radii=(), strain_errors=()))
    case = StudyCase(study=case.study, imaging=replace(case.imaging, pixel_size=0.05))
    pipeline = StudyAnalysis(case, tmp_path, solution=PAPER)
    cases = case.study.prepare(pipeline.pair_spec(), tmp_path)
    plan = Campaign(case.study.function, cases, tmp_path)
    result = guesses_table([1e-9]).iloc[0].drop(list(cases[0]), errors="ignore").to_dict()
    traceback = "Traceback …\nMemoryError: too large"
    for one, error in zip(cases, ("", traceback), strict=True):
        store(plan.path(one), one, None if error else result, error)
    monkeypatch.setattr(Campaign, "missing", lambda self: ())
    summary = pipeline.all()
    (failure,) = summary["failed"]
    assert failure == {"file": plan.path(cases[1]).name, "error": "MemoryError: too large"}
    assert "1 of 2 cases failed" in (tmp_path / "report.html").read_text()
    monkeypatch.setattr(Campaign, "table", lambda self: guesses_table([1.0]).assign(error="No"))
    with pytest.raises(InputError, match="all 1 cases failed; the first: No"):
        pipeline.all()


def check_page(text: str, summary: dict[str, Any]) -> None:
    """It is whole, loads nothing, and says what made each figure."""
    seen = Page(text)
    assert seen.open == []
    assert all(source.startswith("data:") for source in seen.sources)
    assert [name for name, count in seen.ids.items() if count > 1] == []
    assert {link[1:] for link in seen.links if link.startswith("#")} <= set(seen.ids)
    assert not {"script", "link", "iframe"} & set(seen.tags)
    assert {"distances", "epsilon", "basin"} <= set(seen.ids)
    assert "A &lt;tiny&gt; study" in text
    made = re.findall(r'<p class="numbers">(.*?)</p>', text)
    assert len(made) == 3
    assert all("modeharvest study" in m and "seed 0" in m for m in made)
    assert text.index("2 of 2 initial guesses") < text.index('id="figures"')  # sentences first
    assert summary["command"] in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("robustnes",), "did you mean 'robustness'"),
        (("robustness", "--workers", "2", "--scheduler", "tcp://x:1"), "got both"),
        (("robustness", "--workers", "0"), "at least 1 worker"),
        (("robustness", "--workers", "-3"), "at least 1 worker, got -3"),
        (("robustness", "--workers", "1000000000"), "at most 1000 workers"),
        *(
            (("robustness", "--memory", memory), f"memory like 4GiB or 500MB, got {memory!r}")
            for memory in ("much", "", "0", "-4GiB", "nan", "inf", "1e400", "1e30GiB", "1kB")
        ),
        (("nowhere.toml",), "expected a case file at nowhere.toml"),
    ],
)
def test_a_wrong_command_is_reported_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    arguments: tuple[str, ...],
    message: str,
) -> None:
    out = tmp_path / "out"
    assert called(monkeypatch, "study", *arguments, "--out", out) == 2
    assert message in error_line(capsys)
    assert not out.exists()


@pytest.mark.parametrize("workers", ["nan", "inf", "two", "1.5", ""])
def test_workers_are_counted(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    workers: str,
) -> None:
    out = tmp_path / "out"
    assert called(monkeypatch, "study", "robustness", "--workers", workers, "--out", out) == 2
    assert "Traceback" not in (message := capsys.readouterr().err)
    assert "--workers" in message
    assert not out.exists()
