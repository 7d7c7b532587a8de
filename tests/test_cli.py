"""The command line: what it teaches, its exit codes, its one-line errors."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.text import Text

from modeharvest import __version__
from modeharvest.cli.root import app, main
from modeharvest.runs.case import Case

COMMANDS = (
    ("run",),
    ("bloch",),
    ("modes",),
    ("harvest",),
    ("measure",),
    ("study",),
    ("fem",),
    ("image",),
    ("correlate",),
    ("validate",),
    ("homogenize",),
    ("benchmark", "make"),
    ("benchmark", "star"),
    ("benchmark", "resolution"),
    ("score",),
    ("cases",),
)


def called(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    """Exit code of the ``modeharvest`` command."""
    monkeypatch.setattr(sys, "argv", ["modeharvest", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    return int(end.value.code or 0)


def error_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on stderr that begins with 'error:'; no traceback around it."""
    text = capsys.readouterr().err
    assert "Traceback" not in text
    (line,) = [row for row in text.splitlines() if row.startswith("error:")]
    return line


def test_help_lists_every_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(monkeypatch, "--help") == 0
    text = capsys.readouterr().out
    listed = [line.split()[1] for line in text.splitlines() if line.startswith("│")]
    assert {command for command, *_ in COMMANDS} <= set(listed)
    assert "paper-virtual" in text


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_has_help(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert called(monkeypatch, *command, "--help") == 0
    shown = capsys.readouterr().out
    assert f" {' '.join(command)} [OPTIONS]" in shown
    lines = [line.strip() for line in shown.partition("╭")[0].splitlines()]
    for line, after in pairwise(lines):  # no line ends where the next word had its place, too
        assert not (line and after) or len(line) + 1 + len(after.split()[0]) > 78


def test_nothing_in_help_is_taken_for_markup() -> None:
    def texts(command: Any) -> Iterator[str]:
        yield from (text or "" for text in (command.help, command.short_help, command.epilog))
        yield from (getattr(option, "help", None) or "" for option in command.params)
        for part in getattr(command, "commands", {}).values():
            yield from texts(part)

    for text in texts(typer.main.get_command(app)):
        plain = re.sub(r"\[/?bold\]", "", text)
        assert Text.from_markup(text).plain == plain


def test_help_does_not_wait_for_what_only_the_work_needs() -> None:
    script = (
        "import sys\n"
        "import modeharvest.cli\n"
        "print(*sys.modules.keys() & {'numpy', 'numba', 'pydantic', 'matplotlib'})\n"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []


def test_version(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(monkeypatch, "--version") == 0
    assert capsys.readouterr().out.strip() == __version__


def test_cases_prints_a_case_that_can_be_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert called(monkeypatch, "cases", "paper-virtual") == 0
    mine = tmp_path / "mine.toml"
    mine.write_text(capsys.readouterr().out, "utf-8")
    assert Case.read(mine) == Case.read("paper-virtual")


def usage_line(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """What is wrong with a call, printed as one line and nothing else; where help is, is said."""
    text, where = capsys.readouterr(), " ".join(("modeharvest", *command))
    (line,) = text.err.splitlines()
    assert text.out == ""
    assert line.startswith(f"error: {where}: ")
    assert line.endswith(f" See {where} --help")
    return line.removeprefix(f"error: {where}: ").removesuffix(f" See {where} --help")


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_an_unknown_option_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    assert called(monkeypatch, *command, "--zzz") == 2
    assert usage_line(capsys, *command) == "no such option: --zzz."
    if command != ("cases",):
        assert called(monkeypatch, *command, "--ot", "x") == 2
        wrong, near = usage_line(capsys, *command).split(". Did you mean ")
        assert wrong == "no such option: --ot"
        assert "--out" in near.rstrip("?").split(" or ")
        assert called(monkeypatch, *command, "--out") == 2
        assert usage_line(capsys, *command) == "option '--out' requires an argument."


@pytest.mark.parametrize(
    ("arguments", "missing"),
    [
        (("run",), "argument CASE: A shipped case ('modeharvest cases' lists them) or a TOML"),
        (("run", "paper-virtual"), "option --out DIR: Folder for the results."),
        (("harvest",), "argument EXPERIMENT.toml: "),
        (("measure", "a.tif", "--out", "x"), "argument DEFORMED...: Images, in the order of"),
        (("study",), "argument STUDY: robustness, noise, systematic, modes or resolution; or"),
        (("score", "a.csv", "--strain", "0.1"), "option --truth DIR: The truth's folder."),
        (("score", "a.csv", "--truth", "x"), "option --strain: Nominal strain of the image."),
        *((command, "argument ") for command in COMMANDS if command[-1] not in ("star", "cases")),
        (("benchmark", "star"), "option --out DIR: Folder for the set."),
    ],
)
def test_what_is_missing_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    missing: str,
) -> None:
    assert called(monkeypatch, *arguments) == 2
    command = arguments[: 2 if arguments[0] == "benchmark" else 1]
    assert usage_line(capsys, *command).startswith(f"missing {missing}")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("study noise --out x --workers two", "--workers: expected a valid integer, got 'two'."),
        ("measure a b --out x --pixel-size ?", "--pixel-size: expected a valid number, got '?'."),
        ("score a --truth x --strain big --out x", "--strain: expected a valid number, got 'big'."),
        ("score a --first-pixel one", "--first-pixel: expected a valid integer, got 'one'."),
        ("resolution a --first-pixel one", "--first-pixel: expected a valid integer, got 'one'."),
        ("star --out x --noise much", "--noise: expected a valid number, got 'much'."),
        ("star --out x --rows 3.5", "--rows: expected a valid integer, got '3.5'."),
        ("run paper-virtual again --out x", "got unexpected extra argument(s) (again)."),
        ("run paper-virtual --out x --whole-field=1", "option '--whole-field' does not take a"),
    ],
)
def test_a_wrong_type_or_number_of_arguments_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: str,
    message: str,
) -> None:
    command, *rest = arguments.split()
    path = ("benchmark", command) if ("benchmark", command) in COMMANDS else (command,)
    assert called(monkeypatch, *path, *rest) == 2
    assert usage_line(capsys, *path).startswith(message)


def test_an_unknown_command_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, message in (
        (("bogus",), "no such command 'bogus'."),
        (("rum",), "no such command 'rum'. Did you mean 'run'?"),
        (("--bogus",), "no such option: --bogus."),
        (("benchmark", "mak"), "no such command 'mak'. Did you mean 'make'?"),
    ):
        assert called(monkeypatch, *arguments) == 2
        assert usage_line(capsys, *arguments[:-1]) == message


def test_a_group_without_a_command_shows_help(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(monkeypatch, "benchmark") == 2
    text = capsys.readouterr()
    assert "Usage: modeharvest benchmark" in text.out
    assert text.err.strip() == ""


def test_the_program_has_its_name_however_it_is_started() -> None:
    started = [sys.executable, "-m", "modeharvest", "run", "--help"]
    assert "Usage: modeharvest run" in subprocess.run(
        started, check=True, capture_output=True, text=True
    ).stdout  # fmt: skip


def test_unknown_case(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert called(monkeypatch, "run", "paper-virtul", "--out", out) == 2
    assert "did you mean 'paper-virtual'" in error_line(capsys)
    assert not out.exists()


@pytest.mark.parametrize(
    ("command", "missing"), [("image", "solution"), ("correlate", "image"), ("validate", "image")]
)
def test_a_stage_before_its_time_says_what_comes_first(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    command: str,
    missing: str,
) -> None:
    assert called(monkeypatch, command, "paper-virtual", "--out", tmp_path / "out") == 2
    line = error_line(capsys)
    assert f"expected a {missing}" in line or f"expected a finished {missing}" in line
    assert "modeharvest" in line  # names the command that makes it


def test_without_dolfinx_fem_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "modeharvest.fem.simulate", None)  # makes its import fail
    case = tmp_path / "mine.toml"
    case.write_text("[experiment]\nmesh_size = 0.15", "utf-8")
    assert called(monkeypatch, "fem", case, "--out", tmp_path / "out") == 2
    assert "dolfinx" in (line := error_line(capsys))
    assert "conda" in line
    assert "apt" in line
    assert not (tmp_path / "out" / "solution.h5").exists()


def test_without_dolfinx_the_paper_case_takes_the_shipped_solution(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "modeharvest.fem.simulate", None)
    assert called(monkeypatch, "fem", "paper-virtual", "--out", tmp_path) == 0
    assert "Critical strain 9.6" in capsys.readouterr().out
    assert (tmp_path / "solution.h5").is_file()
