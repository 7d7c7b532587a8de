"""A reduced demo from end to end: what it leaves, running it again, and running into trouble."""

from __future__ import annotations

import os
import pickle
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from summary_schemas import faults
from test_cli import called, error_line

from modeharvest.cli.root import main
from modeharvest.fem.field import Mesh, Solution
from modeharvest.fem.materials import Ogden, TwoTermI1
from modeharvest.fem.specimen import Imperfection, Specimen
from modeharvest.idic.correlate import correlate
from modeharvest.idic.finite_element.equations.system import Body
from modeharvest.idic.finite_element.files import read_result
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.mesh import quadratic
from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.runs import run, whole_field
from modeharvest.runs.case import Case
from modeharvest.runs.experiment import Run
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json
from modeharvest.util.progress import Progress

CASE = """
title = "A reduced demo"
[experiment]
strains = [0.08, 0.15]
mesh_size = 0.5
[experiment.specimen]
holes_x = 4
holes_y = 6
[imaging]
pixel_size = 0.08
[imaging.speckle]
seed = 3
[whole_field]
measure = false
element_px = 16.0
edge_element_px = 10.0
"""

pytestmark = [pytest.mark.dolfinx, pytest.mark.usefixtures("coarse_pictures")]


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("case") / "reduced.toml"
    path.write_text(CASE, "utf-8")
    return path


@pytest.fixture(scope="module")
def finished(case: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "out"
    run(case, folder)
    return folder


@pytest.fixture
def folder(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run, to damage."""
    return Path(shutil.copytree(finished, tmp_path / "out"))


def stamps(folder: Path) -> dict[str, int]:
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns
        for path in folder.rglob("*")
        if path.is_file()
    }


def changed(before: dict[str, int], after: dict[str, int]) -> set[str]:
    return {name for name in after if after[name] != before.get(name)} - {
        "stages.json",
        "timings.json",
    }


def command(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["modeharvest", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    return int(end.value.code or 0)


def test_the_run_leaves_what_it_promises(finished: Path) -> None:
    names = {str(path.relative_to(finished)) for path in finished.rglob("*") if path.is_file()}
    assert {
        "solution.h5",
        "solution.vtu",
        "images/images.json",
        "images/reference.tif",
        "images/deformed_0800.tif",
        "images/truth_1500.h5",
        "correlation/result_0800.json",
        "correlation/result_1500.json",
        "report.html",
        "summary.json",
    } <= names
    assert not [name for name in names if ".part" in name]


@pytest.mark.usefixtures("unrendered_pictures")
def test_the_whole_displacement_is_measured_up_to_the_edges(
    case: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(whole_field, "get_num_threads", lambda: 2)
    where = case, "--out", folder, "--whole-field"
    assert called(monkeypatch, "validate", *where) == 2
    assert "make them with 'modeharvest correlate --whole-field'" in error_line(capsys)
    assert called(monkeypatch, "correlate", *where) == 0
    assert capsys.readouterr().out.count("whole displacement: ") == 2
    assert called(monkeypatch, "validate", *where) == 0
    summary = read_json(folder / "summary.json")
    for snapshot in summary["snapshots"]:
        found = snapshot["whole_field"]
        assert found["coverage"] == 1.0
        assert found["rms_px"] < 0.3 * snapshot["rms_w_px"]
        assert found["rms_bulk_px"] < found["rms_px"] < found["rms_edges_px"] < found["max_px"]
        assert found["rms_refit_to_best_fit_px"] < 0.5 * snapshot["rms_idic_to_best_fit_px"]
        assert found["interval_coverage"] > 0.85
        assert found["seconds"] > 0.0
        name = f"displacement_{round(1e4 * snapshot['nominal_strain']):04d}.h5"
        assert read_result(folder / "whole_field" / name).unknowns == found["unknowns"]
    assert [path.name for path in folder.rglob("*timings*")] == ["timings.json"]
    page = (folder / "report.html").read_text("utf-8")
    assert "Whole displacement" in page
    given = Case.read(case)
    how = replace(given.whole_field, measure=True)
    whole = given.model_copy(update={"whole_field": how})
    before = stamps(folder)
    run(whole, folder)
    assert not changed(before, stamps(folder))
    monkeypatch.setattr(whole_field, "get_num_threads", lambda: 1)
    measured = sorted((folder / "whole_field").glob("*.h5"))
    content = [path.read_bytes() for path in measured]
    shutil.rmtree(folder / "whole_field")
    Run(whole, folder).measure()
    assert [path.read_bytes() for path in measured] == content


def test_where_the_correlation_is_in_a_local_minimum_the_refitted_unknowns_are_the_result(
    case: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And they are those of the local minimum again where the whole displacement is left out."""

    def local_minimum(*given: Any, **named: Any) -> Result:
        right = correlate(*given, **named)
        off = right.ansatz.initial_guess(0.0, 1.0)
        return replace(right, outcome=Outcome.LOCAL_MINIMUM, unknowns=right.unknowns + 0.2 * off)

    for module in ("runs.experiment", "idic.finite_element.result"):
        monkeypatch.setattr(f"modeharvest.{module}.correlate", local_minimum)
    monkeypatch.setattr(whole_field, "get_num_threads", lambda: 1)
    shutil.rmtree(folder / "correlation")
    where = case, "--out", folder
    assert called(monkeypatch, "correlate", *where) == 0
    assert capsys.readouterr().out.count("local_minimum") == 2 * 2  # name and value
    assert called(monkeypatch, "correlate", *where, "--whole-field") == 0
    assert capsys.readouterr().out.count("refitted") == 2 * 2
    assert called(monkeypatch, "validate", *where, "--whole-field") == 0
    capsys.readouterr()
    for snapshot in read_json(folder / "summary.json")["snapshots"]:
        name = f"displacement_{round(1e4 * snapshot['nominal_strain']):04d}"
        result = Result.read(folder / "whole_field" / f"{name}_result.json")
        assert snapshot["outcome"] == "refitted"
        off = snapshot["whole_field"]["rms_refit_to_best_fit_px"]
        assert snapshot["rms_idic_to_best_fit_px"] == pytest.approx(off, rel=0.05)
        assert off < 0.1
        assert result.outcome is Outcome.REFITTED
    assert "refitted to the measured whole displacement" in (folder / "report.html").read_text()
    assert called(monkeypatch, "correlate", *where) == 0
    assert capsys.readouterr().out.count("local_minimum") == 2 * 2


Share = Callable[[Progress], None]


@pytest.fixture
def share(tmp_path: Path) -> Share:
    """Of images that aren't there."""
    corners = Mesh([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], [[0, 1, 2], [1, 3, 2]], "T3")
    body, options = Body(quadratic(corners)), FiniteElementOptions()
    files = whole_field.WholeFields(tmp_path)
    how = True, SquareLatticeOptions()
    return partial(whole_field._measure, files, tmp_path / "none", body, options, *how, {})


def hand(share: Share, child: subprocess.Popen[bytes]) -> None:
    assert child.stdin
    with child.stdin as to:
        pickle.dump(share, to)


def test_an_input_error_of_another_process_is_one_here(share: Share) -> None:
    with (
        pytest.raises(InputError, match="expected a finished image set"),
        whole_field._children(1) as [child],
    ):
        hand(share, child)


def test_a_killed_process_is_no_fault_of_the_program() -> None:
    with (
        pytest.raises(InputError, match="killed by signal 9, as happens when memory runs out"),
        whole_field._children(1) as [child],
    ):
        child.kill()


def test_summary_holds_the_documented_keys_and_sound_numbers(finished: Path) -> None:
    summary = read_json(finished / "summary.json")
    assert faults(summary, "run") == []
    assert 0.12 < summary["critical_strain"] < 0.14  # between the two snapshots, as simulated
    assert summary["inverse_map_max_residual_px"] <= 1e-10
    assert summary["factorisations"] <= 50
    timings = read_json(finished / "timings.json")
    assert set(timings) == {"fem", "image", "correlate", "validate"}
    assert all(seconds > 0 for seconds in timings.values())
    assert {"modeharvest", "dolfinx", "numpy"} <= set(summary["versions"])
    assert summary["expected"] == []  # known for the paper's own experiment only
    before, after = summary["snapshots"]
    assert (before["branch"], after["branch"]) == ("primary", "buckled+")
    assert after["pattern_amplitude_px"] > 4 * before["pattern_amplitude_px"]
    for s in (before, after):
        assert s["negative_pivots"] == 0
        assert s["outcome"] == "converged"
        assert len(s["mode"]) == 7
        assert s["rms_best_fit_px"] <= s["rms_w_px"]
        # The best fit is a least-squares projection: what is left of w is orthogonal to first
        # order to what a small change of the unknowns does.
        parts = s["rms_best_fit_px"] ** 2 + s["rms_idic_to_best_fit_px"] ** 2
        assert s["rms_w_px"] ** 2 == pytest.approx(parts, rel=0.05)
    assert (
        summary["energy_below_unstable"][0]["branch_N"]
        < (summary["energy_below_unstable"][0]["unstable_N"])
    )


def test_running_again_changes_nothing(case: Path, folder: Path) -> None:
    before = stamps(folder)
    run(case, folder)
    assert stamps(folder) == before


@pytest.mark.usefixtures("undrawn_pictures")
def test_a_changed_option_repeats_only_what_depends_on_it(case: Path, folder: Path) -> None:
    before = stamps(folder)
    other = case.with_name("other.toml")
    other.write_text(case.read_text("utf-8") + "[correlation]\norder = 3\n", "utf-8")
    run(other, folder)
    assert changed(before, stamps(folder)) == {
        "correlation/result_0800.json",
        "correlation/result_1500.json",
        "report.html",
        "summary.json",
    }


@pytest.mark.usefixtures("undrawn_pictures")
@pytest.mark.parametrize(
    ("step", "is_missing"),
    [
        ("images: strain", ("images", "correlation", "summary.json", "report.html")),
        ("correlate", ("correlation", "summary.json", "report.html")),
        ("report", ("summary.json", "report.html")),
    ],
)
def test_an_interrupted_run_continues_to_the_same_end(
    case: Path, finished: Path, tmp_path: Path, step: str, is_missing: tuple[str, ...]
) -> None:
    without = shutil.ignore_patterns(*is_missing)
    folder = Path(shutil.copytree(finished, tmp_path / "out", ignore=without))

    def interrupt(done: float, total: float, what: str) -> None:
        if what.startswith(step) and done > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Run(Case.read(case), folder, interrupt).all()
    assert not (folder / "summary.json").exists()
    assert not list(folder.rglob("*.part*"))
    assert run(case, folder) == read_json(finished / "summary.json")


@pytest.mark.usefixtures("undrawn_pictures")
@pytest.mark.parametrize(
    ("victim", "damage", "stage"),
    [
        ("solution.h5", "one bit", "image"),
        ("images/images.json", "one bit", "correlate"),
        ("images/deformed_1500.tif", "cut", "correlate"),
        ("images/truth_1500.h5", "one bit", "validate"),
        ("correlation/result_1500.json", "cut", "validate"),
        ("stages.json", "cut", "validate"),
    ],
)
def test_a_damaged_file_is_reported_and_what_is_advised_mends_it(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    case: Path,
    finished: Path,
    folder: Path,
    victim: str,
    damage: str,
    stage: str,
) -> None:
    for name in ("summary.json", "correlation/result_0800.json"):  # so that there is work to do
        if stage != "validate" or name == "summary.json":
            (folder / name).unlink()
    path = folder / victim
    content = path.read_bytes()
    half = len(content) // 2
    flipped = content[:half] + bytes([content[half] ^ 1]) + content[half + 1 :]
    path.write_bytes(content[:half] if damage == "cut" else flipped)
    assert command(monkeypatch, stage, case, "--out", folder) == 2
    (line,) = [r for r in capsys.readouterr().err.splitlines() if r.startswith("error:")]
    assert str(folder) in line
    (advised,) = re.findall(r"'modeharvest (\w+)'", line)
    assert command(monkeypatch, advised, case, "--out", folder) == 0
    for name in (victim, *(f"images/deformed_{e}.tif" for e in ("0800", "1500"))):
        if name != "stages.json":
            assert (folder / name).read_bytes() == (finished / name).read_bytes()


def test_results_and_images_of_another_case_are_not_taken(case: Path, folder: Path) -> None:
    other = case.with_name("other_start.toml")
    text = case.read_text("utf-8")
    other.write_text(text + "[correlation]\nstart_amplitude = 2.0\n", "utf-8")
    with pytest.raises(InputError, match="results of this case"):
        Run(Case.read(other), folder).validate()
    other.write_text(text.replace("seed = 3", "seed = 4"), "utf-8")
    with pytest.raises(InputError, match="images made with this case's options"):
        Run(Case.read(other), folder).correlate()


def test_a_stage_that_fails_leaves_no_older_result(case: Path, folder: Path) -> None:
    (folder / "images" / "deformed_1500.tif").write_bytes(b"")
    other = case.with_name("other_order.toml")
    other.write_text(case.read_text("utf-8") + "[correlation]\norder = 3\n", "utf-8")
    with pytest.raises(InputError, match="deformed_1500"):
        Run(Case.read(other), folder).correlate()
    assert not (folder / "correlation" / "result_1500.json").exists()


def changed_experiment(case: Path, **options: Any) -> Case:
    read = Case.read(case)
    return read.model_copy(update={"experiment": replace(read.experiment, **options)})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"strains": (0.05,)}, r"snapshots at strains 0\.05, got 0\.08, 0\.15"),
        ({"strains": (0.08, 0.12)}, r"snapshots at strains 0\.08, 0\.12, got 0\.08, 0\.15"),
        ({"specimen": Specimen(4, 6, diameter=1.4)}, r"specimen, diameter = 1\.4, got 1\.5"),
        ({"material": Ogden(kappa=5.0)}, r"material, kappa = 5\.0, got 5\.4"),
        ({"material": TwoTermI1()}, r"material, kind = TwoTermI1, got Ogden"),
        ({"edges": "sliding"}, "loading, edges = sliding, got clamped"),
        ({"tilt": 0.01}, r"loading, tilt_rad = 0\.01, got 0\.0"),
        ({"imperfection": Imperfection(seed=2)}, "imperfection, seed = 2, got 0"),
        ({"branches": ("buckled-",)}, r"branch buckled- at strain 0\.15, got buckled\+"),
    ],
)
def test_a_solution_of_another_experiment_is_refused(
    case: Path, folder: Path, tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    other, solution = changed_experiment(case, **options), folder / "solution.h5"
    for pipeline in (Run(other, folder), Run(other, tmp_path / "new", solution=solution)):
        with pytest.raises(InputError, match=f"{message}.* in {solution}") as error:
            pipeline.image()
        assert "\n" not in str(error.value)
    if "branches" not in options:  # what was imaged is of the branch that was asked for then
        with pytest.raises(InputError, match=f"{message}.* in images in .*'modeharvest image'"):
            Run(other, folder).correlate()


def test_a_solution_of_the_same_experiment_is_taken(case: Path, folder: Path) -> None:
    """More strains, another mesh, or one by another solver, which says nothing of itself."""
    fewer = changed_experiment(case, strains=(0.15,), mesh_size=0.3)
    assert Run(fewer, folder / "fewer", solution=folder / "solution.h5").image().strains == (0.15,)
    foreign = folder / "foreign.h5"
    replace(Solution.read(folder / "solution.h5"), info={"source": "abaqus.vtu"}).write(foreign)
    other = changed_experiment(case, material=TwoTermI1())
    assert Run(other, folder / "foreign", solution=foreign).image().strains == (0.08, 0.15)


@pytest.mark.usefixtures("unrendered_pictures")
def test_strain_beyond_what_converges_is_reported_and_the_rest_is_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    case = tmp_path / "far.toml"
    text = CASE.replace("[0.08, 0.15]", "[0.02, 0.45]").replace("holes_x = 4", "holes_x = 2")
    case.write_text(text.replace("holes_y = 6", "holes_y = 2"), "utf-8")
    assert command(monkeypatch, "run", case, "--out", tmp_path / "out") == 2
    (line,) = [r for r in capsys.readouterr().err.splitlines() if r.startswith("error:")]
    assert "45 %" in line
    summary = read_json(tmp_path / "out" / "summary.json")
    assert [s["nominal_strain"] for s in summary["snapshots"]] == [0.02]


def test_under_mpirun_one_rank_writes_and_talks(case: Path, finished: Path, tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "modeharvest",
        "fem",
        str(case),
        "--out",
        str(tmp_path / "out"),
    ]
    patient = {**os.environ, "OMPI_MCA_mpi_yield_when_idle": "1"}  # a waiting rank does not spin
    done = subprocess.run(
        ["mpirun", "-n", "2", *command], capture_output=True, text=True, timeout=1800, env=patient
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Critical strain") == 1
    ours = Solution.read(tmp_path / "out" / "solution.h5")
    theirs = Solution.read(finished / "solution.h5")
    assert abs(ours.info["critical"]["strain"] - theirs.info["critical"]["strain"]) < 1e-8


@contextmanager
def no_file_beyond(size: int) -> Iterator[None]:
    """As on a full disk: what writes more than ``size`` bytes into a file is refused."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))  # Python ignores SIGXFSZ
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_leaves_nothing_that_looks_finished(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], case: Path, tmp_path: Path
) -> None:
    """No file may grow beyond 200 kB: the solution fits, an image does not."""
    with no_file_beyond(200_000):
        assert command(monkeypatch, "run", case, "--out", tmp_path / "out") == 2
    message = capsys.readouterr().err
    assert "error: could not write" in message
    assert "Traceback" not in message
    left = {str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("*.*")}
    assert "solution.h5" in left
    assert not {"summary.json", "report.html", "images/images.json"} & left
    assert not [name for name in left if ".part" in name]
    assert "image" not in read_json(tmp_path / "out" / "stages.json")
