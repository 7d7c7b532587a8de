"""Bad calls of every command: one line and exit code 2, never a traceback, never a wait."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import synthetic_benchmark as made
from PIL import Image
from test_cli import called, error_line

from modeharvest.cli import messages
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.runs.case import Case, checked
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.util.errors import InputError
from modeharvest.util.machine import available_bytes, require_memory

SPECIMEN = "[experiment]\nstrains = [0.05]\n[experiment.specimen]\nholes_x = 2\nholes_y = 3\n"
HARVEST = """
[images]
reference = "reference.png"
deformed = ["deformed.png"]
[scale]
pixel_size = 0.01
[specimen]
cell_size = 0.2
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a benchmark, photographs, a good field, and what is none of them."""
    folder = tmp_path_factory.mktemp("place")
    made.make(folder)
    random = np.random.default_rng(0)
    for name in ("reference", "deformed"):
        Image.fromarray(random.integers(0, 255, (60, 80), np.uint8)).save(folder / f"{name}.png")
    (folder / "folder.toml").mkdir()
    (folder / "folder.h5").mkdir()
    (folder / "folder.png").mkdir()
    (folder / "file").write_text("x")
    (folder / "two.csv").write_text("x,y,u,v\n0.1,0.95,0.01,0.01\n0.0,0.95,0.01,0.01\n")
    return folder


# --- values -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"title = '\xe9'", "expected UTF-8, as TOML has to be, got a byte 0xe9 in line 1"),
        (b"a = " + b"[" * 20_000, "recursion"),
        (b"", "an empty file"),
        ("[experiment.material]\nkind = ['ogden']", "got ['ogden']"),
        ("[experiment.material]\nmoduli = [nan]", "a finite number, got nan"),
        ("[experiment.specimen]\nholes_x = true", "holes_x: expected a number, got True"),
        ("[experiment.specimen]\nholes_x = 1_000_000_000", "to 1000 x 1000 holes"),
        ("[experiment.specimen]\nholes_x = -3", "to 1000 x 1000 holes"),
        ("[experiment.imperfection]\nseed = -1", "a seed of 0 or more"),
        ("[experiment]\nmesh_size = 2020-01-01", "mesh_size"),
        ("[experiment.path]\nlargest_step = 1e-300", "a largest_step of 1e-05 to 1"),
        ("experiment = 3", "experiment"),
        ("[imaging]\npixel_size = '0.01'", "pixel_size: expected a number, got '0.01'"),
        ("[imaging]\npixel_size = 1e300", "pixel_size: expected a number below"),
        ("[imaging]\npixel_size = inf", "a finite number, got inf"),
        ("[imaging]\naffine_distortion = 1", "affine_distortion: expected true or false, got 1"),
        ("[imaging]\nshape = [0, 0]", "a shape of 8 x 8 px"),
        ("[imaging.speckle]\nblur_px = 1e9", "a blur [px] of 0.75 to 100"),
        ("[imaging.speckle]\nstandard_deviation = 1e-300", "[cycles/px] of 0.0001"),
        ("[correlation]\nv0_degree = 1000", "v0_degree from 1 and v_degree from 0 to 20"),
        ("[correlation]\nedge_px = 1_000_000_000", "edge_px from 0 to 100"),
        ("[correlation]\ngradient_blur_px = 1e9", "of 0 to 100 px"),
        ("[calibration]\nstage_sd_px = 1e9", "stage_sd_px of 0 to 1000"),
    ],
)
def test_a_value_that_means_nothing_is_refused(
    text: str | bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "case.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as caught:
        Case.read(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_mark_of_an_editor_is_no_fault(tmp_path: Path) -> None:
    path = tmp_path / "case.toml"
    path.write_bytes(b"\xef\xbb\xbftitle = 'x'\n")
    assert Case.read(path).title == "x"


def test_whole_numbers_count_as_numbers() -> None:
    assert checked(Case, {"imaging": {"pixel_size": 1}}, "x").imaging.pixel_size == 1.0


def test_a_mesh_without_cells_is_no_solution(tmp_path: Path) -> None:
    nodes = np.zeros((3, 2))
    with pytest.raises(InputError, match="expected cells"):
        Solution(Mesh(nodes, np.empty((0, 3), int), "T3"), (Snapshot(0.1, nodes),))


@pytest.mark.parametrize("strain", [np.nan, np.inf])
def test_a_snapshot_has_a_finite_strain(strain: float) -> None:
    nodes = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    with pytest.raises(InputError, match="finite nominal strain"):
        Solution(Mesh(nodes, np.array([[0, 1, 2]]), "T3"), (Snapshot(strain, nodes),))


# --- sizes --------------------------------------------------------------------------------


def test_memory_is_known_and_asked_before_it_is_taken() -> None:
    there = available_bytes()
    assert 1e7 < there < 1e15
    require_memory(0.01 * there, "a little", "nothing")
    for needed in (2.0 * there, float("inf"), float("nan")):
        with pytest.raises(InputError, match=r"expected much to fit .*; take less$"):
            require_memory(needed, "much", "take less")


def test_a_container_may_have_less_than_its_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = tmp_path / "job"
    group.mkdir()
    (group / "memory.max").write_text("3000000\n")
    (group / "memory.current").write_text("2500000\n")
    (group / "memory.stat").write_text("anon 1\ninactive_file 400000\n")
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("2500000\n")
    (tmp_path / "own").write_text("0::/job\n")
    monkeypatch.setattr("modeharvest.util.machine._CGROUPS", tmp_path)
    monkeypatch.setattr("modeharvest.util.machine._OWN_CGROUP", tmp_path / "own")
    assert available_bytes() == 900_000.0


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("pixel_size = 1e-9", "enlarge pixel_size"),
        ("pixel_size = 1e-300", "enlarge pixel_size"),
        ("pixel_size = 10.0", "8 px across the specimen"),
        ("pixel_size = 1e9", "8 px across the specimen"),
        ("margin_px = 1_000_000_000", "fit into the memory"),
        ("shape = [1_000_000, 1_000_000]", "fit into the memory"),
        ("distortion = 'no.json'", "found no such file"),
        ("distortion = 'folder.toml'", "found a folder"),
    ],
)
def test_images_that_do_not_fit_are_refused_before_they_are_made(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: Path,
    tmp_path: Path, table: str, message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(place)
    (tmp_path / "case.toml").write_text(f"{SPECIMEN}[imaging]\n{table}\n")
    call = ("image", tmp_path / "case.toml", "--solution", "solution.h5", "--out", tmp_path / "out")
    assert called(monkeypatch, *call) == 2
    assert message in error_line(capsys)


@pytest.mark.dolfinx
@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("fem", "[experiment]\nmesh_size = 1e-9"),
        ("fem", "[experiment]\nmesh_size = 1e-300"),
        ("fem", "[experiment]\nmesh_size = 9.0"),
        ("bloch", "[lattice]\nmesh_size = 1e-9"),
        ("modes", "[lattice]\nkind = 'hexagonal'\nmesh_size = 1e-9"),
        ("bloch", "[lattice]\nkind = 'tetrachiral'\nmesh_size = 1e-9"),
        ("bloch", "[lattice]\npitch = -1"),
        ("bloch", "[lattice]\nkind = 'file'\npath = 'folder.toml'\npitch = 1.0"),
        ("bloch", "[search]\ndivisions = 1_000_000_000"),
        ("bloch", "[dispersion]\npoints = 1_000_000_000"),
    ],
)
def test_meshes_that_never_end_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: Path,
    tmp_path: Path, command: str, text: str,
) -> None:  # fmt: skip
    (tmp_path / "case.toml").write_text(text if "[exp" in text or "[latt" in text else
                                        f"[lattice]\nkind = 'square'\n{text}")  # fmt: skip
    call = (command, tmp_path / "case.toml", "--out", tmp_path / "out")
    assert called(monkeypatch, *call) == 2
    error_line(capsys)


# --- files and folders --------------------------------------------------------------------


@pytest.mark.parametrize(
    "call",
    [
        ("run", "folder.toml", "--out", "out"),
        ("bloch", "folder.toml", "--out", "out"),
        ("study", "folder.toml", "--out", "out"),
        ("harvest", "folder.toml", "--out", "out"),
        ("harvest", "case.toml", "--out", "out"),
        ("benchmark", "make", "folder.toml", "--out", "out"),
        ("run", "[/bold]", "--out", "out"),
        ("run", "", "--out", "out"),
        ("run", "x" * 300, "--out", "out"),
        ("cases", "[/bold]"),
        ("image", "paper-virtual", "--solution", "folder.h5", "--out", "out"),
        ("image", "paper-virtual", "--solution", "file", "--out", "out"),
        ("image", "case.toml", "--solution", "solution.h5", "--out", "file"),
        ("image", "case.toml", "--solution", "solution.h5", "--out", "file/below"),
        ("correlate", "case.toml", "--out", "file"),
        ("validate", "case.toml", "--out", "set"),
        ("study", "noise", "--out", "file"),
        ("study", "noise", "--solution", "file", "--out", "out"),
        ("benchmark", "star", "--out", "file"),
        ("benchmark", "star", "--out", "out", "--noise", "nan"),
        ("benchmark", "star", "--out", "out", "--rows", "99999999"),
        ("benchmark", "star", "--out", "out", "--seed", "-1"),
        ("benchmark", "make", "case.toml", "--solution", "solution.h5", "--out", "file"),
        ("benchmark", "resolution", "two.csv", "--set", "set", "--out", "out"),
        ("score", "two.csv", "--truth", "set", "--strain", "0.05", "--out", "out"),
        ("score", "two.csv", "--truth", "file", "--strain", "0.05", "--out", "out"),
        ("score", "folder.h5", "--truth", "set-truth", "--strain", "0.05", "--out", "out"),
    ],
    ids=lambda call: " ".join(call)[:60],
)
def test_a_bad_call_is_reported_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: Path,
    call: tuple[str, ...],
) -> None:  # fmt: skip
    monkeypatch.chdir(place)
    assert called(monkeypatch, *call) == 2
    error_line(capsys)


@pytest.mark.parametrize(
    "call",
    [
        "run case.toml",
        "fem case.toml",
        "image case.toml --solution solution.h5",
        "correlate case.toml",
        "validate case.toml",
        "bloch square-lattice",
        "modes square-lattice",
        "study noise",
        "harvest experiment.toml",
        "score two.csv --truth set-truth --strain 0.05",
        "benchmark make case.toml --solution solution.h5",
        "benchmark make case.toml --solution solution.h5 --out out --truth",
        "benchmark star",
        "benchmark resolution two.csv --set set",
    ],
)
@pytest.mark.parametrize(
    ("folder", "message"),
    [
        ("file", "expected a folder at file, found a file; remove it, or take another folder"),
        ("file/below", "expected a folder at file, found a file; remove it"),
        ("", "expected a folder, got an empty name"),
    ],
)
def test_a_file_or_nothing_is_no_folder_to_write_to(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: Path,
    call: str, folder: str, message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    words = call.split()
    option = () if words[-1].startswith("--") else ("--out",)
    assert called(monkeypatch, *words, *option, folder) == 2
    assert message in error_line(capsys)
    assert sorted(place.rglob("*")) == before


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"deformed.png"', '"/no/such/folder/*.png"'),
        ('"deformed.png"', '"folder*.png"'),
        ('"deformed.png"', '"["'),
        ('"deformed.png"', '"folder.png"'),
        ('"reference.png"', '"folder.png"'),
        ('"reference.png"', '"reference.png\\u0000"'),
        ('"reference.png"', f'"{"x" * 300}"'),
        ('["deformed.png"]', '"deformed.png"'),
        ("0.01", "nan"),
        ("0.01", "1e300"),
        ("cell_size = 0.2", "cell_size = inf"),
        ("cell_size = 0.2", "cell_size = 0.2\npolygon = [[1, 1], [50, 40]]"),
        ("cell_size = 0.2", "cell_size = 0.2\npolygon = [[1, 1], [1, 1], [1, 1]]"),
        ("cell_size = 0.2", "cell_size = 0.2\npolygon = [[1, 1], [50, 40], [50.5, 40.5], [1, 1]]"),
        ("cell_size = 0.2", "cell_size = 0.2\n[[specimen.regions]]\nname = 'a'"),
        (
            "cell_size = 0.2",
            "cell_size = 0.2\n[[specimen.regions]]\nname = 'a'\npolygon = [[1, 5], [9, 5], [7, 5]]",
        ),
        ("cell_size = 0.2", "cell_size = 0.2\n[local]\nfirst_pixel = 7"),
        ("cell_size = 0.2", "cell_size = 0.2\n[distortion]\nfile = 'folder.toml'"),
    ],
)
def test_a_bad_experiment_is_reported_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: Path,
    tmp_path: Path, old: str, new: str,
) -> None:  # fmt: skip
    path = place / "experiment.toml"
    path.write_text(HARVEST.replace(old, new))
    assert HARVEST.count(old) == 1
    assert called(monkeypatch, "harvest", path, "--out", tmp_path / "out") == 2
    error_line(capsys)


@pytest.mark.parametrize(
    ("polygon", "message"),
    [
        ("[[1, 1], [50, 40]]", "at least three corners [column, row], got 2"),
        ("[[1, 1], [1, 1], [1, 1]]", "with an area, got 3 corners on one line"),
        ("[[1, 5], [50, 5], [30, 5.5]]", "from [1.0, 5.0] to [50.0, 5.0]"),
    ],
)
@pytest.mark.parametrize("table", ["polygon", "[[specimen.regions]]\nname = 'a'\npolygon"])
def test_a_polygon_has_an_area(table: str, polygon: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "experiment.toml"
    path.write_text(f"{HARVEST}{table} = {polygon}\n")
    with pytest.raises(InputError, match="polygon") as caught:
        PhotographCase.read(path)
    assert message in str(caught.value)


def test_wildcards_may_be_absolute(place: Path, tmp_path: Path) -> None:
    from modeharvest.runs.photographs.prepare import all_files, require_inputs

    path = tmp_path / "experiment.toml"
    path.write_text(HARVEST.replace('"deformed', f'"{place}/def*').replace('"ref', f'"{place}/ref'))
    case = PhotographCase.read(path)
    require_inputs(case)
    assert all_files(case) == (place / "reference.png", place / "deformed.png")


# --- what is printed ----------------------------------------------------------------------


def test_a_title_may_look_like_markup(capsys: pytest.CaptureFixture[str]) -> None:
    from modeharvest.report.model.content import Card, Report, ReportTable, Section
    from modeharvest.report.model.output import print_report

    table = ReportTable("[/t]", ["[b]"], [["[/b]"]], on_terminal=True)
    section = Section("s", "S", Card.tabular(table))
    report = Report("kind", "[/bold] [red]", sections=[section], warnings=["[/x]"])
    print_report(report, Path("out[/bold]"))
    text = capsys.readouterr().out
    assert "[/x]" in text
    assert "out[/bold]/report.html" in text


def test_warnings_stand_beside_the_findings(tmp_path: Path) -> None:
    from modeharvest.report.model.content import Report
    from modeharvest.report.model.output import write_page

    warnings, page = [f"warning {n}" for n in range(5)], tmp_path / "page.html"
    write_page(Report("kind", "title", findings=["found"], warnings=warnings), page)
    _, rest = page.read_text("utf-8").split('<section id="findings">')
    findings, notes = rest.split('id="notes"')
    assert all(text in findings for text in ("found", *warnings[:3], "2 more in the notes"))
    assert not any(text in findings for text in warnings[3:])
    assert all(text in notes for text in warnings[3:])


def test_no_bar_is_no_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError), messages.bars():
        raise InputError("before the first step")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("call", "words"),
    [
        ("run set --out out", "expected a case file at set, found a folder"),
        ("harvest set --out out", "'modeharvest cases photographs' prints one"),
        ("export none --as csv --out out", "expected a folder of 'measure'"),
    ],
)
def test_what_is_no_case_and_no_field_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: Path,
    call: str, words: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(place)
    assert called(monkeypatch, *call.split()) == 2
    assert words in error_line(capsys)


def test_a_bar_may_name_any_file(capsys: pytest.CaptureFixture[str]) -> None:
    with messages.bars() as progress:  # markup that closes nothing raises where it is drawn
        progress(0.0, 1.0, "score: [/bold].csv")
    assert "score: [/bold].csv" in capsys.readouterr().err


def test_names_that_look_like_markup_or_formulas_are_scored(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: Path,
    tmp_path: Path,
) -> None:  # fmt: skip
    monkeypatch.chdir(place)
    call = (
        "score", "two.csv", "--truth", "set-truth", "--strain", str(made.STRAIN), "--unit", "mm",
        "--y-axis", "up", "--name", r"[/bold] $\no$ <b>", "--out", tmp_path,
    )  # fmt: skip
    assert called(monkeypatch, *call) in (0, 2)  # two points may be too few to be graded
    assert "Traceback" not in capsys.readouterr().err


# --- the net ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (MemoryError(), 2, "error: the memory is full"),
        (OSError(28, "No space left on device", "out/x"), 2, "refuses: out/x: No space left"),
        (UnicodeEncodeError("utf-8", "\udcff", 0, 1, "surrogates"), 2, "error: UnicodeEncodeError"),
        (RecursionError("too deep"), 2, "error: RecursionError: too deep"),
        (InputError("a\nb [/bold]"), 2, "error: a b [/bold]"),
        (ZeroDivisionError("float"), 70, "(ZeroDivisionError: float); please report it with "),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_whatever_ends_a_command_is_reported_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    error: BaseException, code: int, message: str,
) -> None:  # fmt: skip
    def fail(name: str) -> str:
        raise error

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("modeharvest.runs.case.case_text", fail)
    assert called(monkeypatch, "cases", "paper-virtual") == code
    text = capsys.readouterr().err
    assert message in text
    assert text.count("\n") == 1
    logs = list(tmp_path.glob("*.log"))
    assert len(logs) == (code == 70)
    for log in logs:
        assert str(log) in text
        assert "Traceback" in log.read_text()


def run(
    script: str, *arguments: str, tail: str = "", **environment: str | None
) -> subprocess.CompletedProcess[str]:
    """``python -m modeharvest`` under a shell, with other variables; None is unset."""
    variables = {**os.environ, **{k: v for k, v in environment.items() if v is not None}}
    for name in (k for k, v in environment.items() if v is None):
        variables.pop(name, None)
    return subprocess.run(
        ["bash", "-c", f'"$0" "$@" {tail}', sys.executable, *script.split(), *arguments],
        env=variables, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize(
    ("tail", "code", "message"),
    [
        ("cases paper-virtual > /dev/full", 2, "No space left"),
        ("--version > /dev/full", 2, "No space left"),
        ("--version >&-", 0, ""),
        ("--version 2>&- >&-", 0, ""),
        ("--version | true; exit ${PIPESTATUS[0]}", 1, ""),
        ("--version 2> /dev/full > /dev/full", 2, ""),
    ],
)
def test_a_full_or_closed_terminal_is_no_fault(tail: str, code: int, message: str) -> None:
    done = run("-m modeharvest", tail=tail)
    assert done.returncode == code
    assert message in done.stderr
    assert done.stderr.count("\n") == bool(message)


class Swallows:
    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)  # as Ctrl-C during a destructor


def plain() -> None:
    signal.raise_signal(signal.SIGINT)


def taken_for_an_error() -> None:
    try:
        plain()
    except BaseException as error:
        raise RuntimeError from error


def dropped() -> None:
    with suppress(BaseException):
        plain()


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C as a terminal has it: a shell may have it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("interrupted", [Swallows, plain, taken_for_an_error, dropped])
def test_ctrl_c_is_never_swallowed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    interrupted: Callable[[], object],
) -> None:  # fmt: skip
    def work(name: str) -> str:
        with messages.bars() as progress:
            interrupted()
            progress(1, 2, "work")
            return "it went on"

    monkeypatch.setattr("modeharvest.runs.case.case_text", work)
    assert called(monkeypatch, "cases", "paper-virtual") == 130
    printed = capsys.readouterr()
    assert printed.err.count("interrupted;") == 1
    assert "Traceback" not in printed.err
    assert "went on" not in printed.out


AT_THE_END = """
import signal, sys
from modeharvest.cli import root
from modeharvest.runs import case

signal.signal(signal.SIGINT, signal.default_int_handler)

class Swallows:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

def work(name):
    Swallows()
    return "it went on"

case.case_text = work
sys.argv = ["modeharvest", "cases", "paper-virtual"]
root.main()
"""


def test_ctrl_c_counts_even_at_the_end() -> None:
    assert run("-c", AT_THE_END).returncode == 130


# --- environments -------------------------------------------------------------------------


@pytest.mark.parametrize(("options", "shown"), [("", 0), ("-W default", 1)])
def test_warnings_of_libraries_are_not_printed_beside_a_line(options: str, shown: int) -> None:
    loud = "root.main = lambda: warnings.warn('loud', RuntimeWarning)"
    code = (
        f"import warnings, modeharvest.cli.root as root; {loud}; from modeharvest import __main__"
    )
    done = run(f"{options} -c", f"{code}; __main__.start()")
    assert done.stderr.count("loud") == shown


def test_help_needs_no_folder_of_the_user() -> None:
    done = run("-m modeharvest cases", HOME=None, XDG_CACHE_HOME=None)
    assert done.returncode == 0
    assert "paper-virtual" in done.stdout


READ_ONLY = """
import io, sys
from numba.core import caching
from rich.console import Console
from modeharvest.cli.messages import compilation_announced

def refused(self):  # as where neither the package's folder nor the home can be written to
    raise PermissionError(self.get_cache_path())

caching._CacheLocator.ensure_cache_path = refused
with compilation_announced(Console(width=500)):
    from modeharvest.util.compiled import compiled
    kernel = compiled()(lambda x: x + 1)
    assert kernel(1) == 2
"""


def test_kernels_work_where_nothing_can_be_written(tmp_path: Path) -> None:
    script = tmp_path / "read_only.py"
    script.write_text(READ_ONLY)
    done = run(str(script), NUMBA_CACHE_DIR=None)
    assert done.returncode == 0, done.stderr
    assert "compiling kernels for this machine: some seconds, every time" in done.stdout
    assert "NUMBA_CACHE_DIR" in done.stdout
