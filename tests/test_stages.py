"""Stages are believed by what they left, and a folder belongs to one process."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import synthetic_benchmark

import modeharvest
from modeharvest.cli.root import main
from modeharvest.util import stages
from modeharvest.util.errors import InputError, MissingDependencyError, WriteError
from modeharvest.util.stages import (
    StagedRun,
    Stages,
    command_line,
    exclusive,
    source_digest,
    stage_key,
)


class Work:
    """Leaves two files; counts how often."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.done = folder, 0

    def __call__(self) -> list[Path]:
        self.done += 1
        paths = [self.folder / "a.txt", self.folder / "sub" / "b.txt"]
        paths[1].parent.mkdir(exist_ok=True)
        for path in paths:
            path.write_text("content")
        return paths


@pytest.mark.parametrize("damage", ["same size", "longer", "gone"])
@pytest.mark.parametrize("victim", ["a.txt", "sub/b.txt"])
def test_a_stage_is_finished_while_its_files_are_what_it_wrote(
    tmp_path: Path, victim: str, damage: str
) -> None:
    folder = Stages(tmp_path)
    work = Work(tmp_path)
    for _ in range(2):
        folder.do("one", "key", work)
    assert work.done == 1
    path = tmp_path / victim
    stamp = path.stat()
    path.unlink()
    if damage == "same size":  # and as old as before: a date proves nothing
        path.write_text("CONTENT")
        os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    elif damage == "longer":
        path.write_text("content, and more")
    assert not folder.is_finished("one", "key")
    with pytest.raises(InputError, match=f"{victim} as stages.json has its SHA-256.*; do it"):
        folder.require_whole(path, "do it again")
    folder.do("one", "key", work)
    assert work.done == 2
    assert path.read_text() == "content"
    folder.require_whole(path, "do it again")


@pytest.mark.parametrize("text", ["", "[]", '{"one": 3}', '{"one": {"key": "key"}}',
                                  '{"one": {"key": "key", "files": {"a.txt": 3}}}'])  # fmt: skip
def test_a_record_that_says_nothing_is_none(tmp_path: Path, text: str) -> None:
    work = Work(tmp_path)
    (tmp_path / "stages.json").write_text(text)
    Stages(tmp_path).require_whole(tmp_path / "other.txt", "")
    Stages(tmp_path).do("one", "key", work)
    assert work.done == 1
    assert Stages(tmp_path).is_finished("one", "key")


def test_a_stage_done_anew_takes_its_older_files_away_and_no_others(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    (tmp_path / "outside.txt").write_text("the user's")
    Stages(folder).do("one", "key", Work(folder))
    record = json.loads((folder / "stages.json").read_text())
    record["one"]["files"] |= {"../outside.txt": {}, str(tmp_path / "outside.txt"): {}}
    (folder / "stages.json").write_text(json.dumps(record))

    def fails() -> list[Path]:
        raise InputError("no")

    with pytest.raises(InputError, match="no"):
        Stages(folder).do("one", "another key", fails)
    assert not (folder / "a.txt").exists()
    assert (tmp_path / "outside.txt").exists()
    assert not Stages(folder).is_finished("one", "key")


def test_what_the_disk_refuses_is_no_image_s_failure(tmp_path: Path) -> None:
    """An image that can't be used is done with; one whose files can't be written is done again."""
    errors = [WriteError("could not write a.h5: No space left on device")]

    def work(name: str, _: object) -> tuple[list[Path], dict[str, str]]:
        if errors:
            raise errors.pop()
        if name == "b":
            raise InputError("of another size")
        return [], {}

    def done() -> object:
        run, keys = StagedRun(None, tmp_path), {"a": "key", "b": "key"}
        return run.do_in_turn("measure", keys, tmp_path, work, lambda name, _: name)

    with pytest.raises(WriteError, match="No space left"):
        done()
    assert done() == ({"a": "a"}, {"b": "of another size"})


def test_seconds_are_apart(tmp_path: Path) -> None:
    Stages(tmp_path).do("one", "key", Work(tmp_path))
    assert "seconds" not in (tmp_path / "stages.json").read_text()
    assert Stages(tmp_path).timings["one"] > 0
    (tmp_path / "timings.json").write_text("{")
    assert Stages(tmp_path).timings == {}


# -- which code did it ------------------------------------------------------------------


def copied_package(folder: Path) -> Path:
    """The package as it is installed: real folders, without links."""
    source = Path(modeharvest.__file__).parent
    ignored = shutil.ignore_patterns("__pycache__")
    return Path(shutil.copytree(source, folder / "modeharvest", ignore=ignored))


def digests_in(path: Path, *choices: tuple[str, ...]) -> list[str]:
    """For each choice of folders, the digest of the code that another Python finds at a path."""
    program = (
        f"import sys; sys.path.insert(0, {str(path)!r})\n"
        "from modeharvest.util.stages import source_digest\n"
        f"for folders in {choices}: print(source_digest(*folders))"
    )
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()


def test_the_code_counts_wherever_it_is_installed(tmp_path: Path) -> None:
    package = copied_package(tmp_path)
    assert digests_in(tmp_path, ()) == [source_digest()]
    archive = tmp_path / "package.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for path in package.rglob("*"):
            file.write(path, path.relative_to(tmp_path))
    assert digests_in(archive, ()) == [source_digest()]


@pytest.mark.parametrize(
    ("name", "folders_that_see_it"),
    [
        ("util/stages.py", {(), ("fem",), ("fem", "imaging")}),
        ("imaging/spec.py", {(), ("fem", "imaging")}),
        ("report/new.html", {()}),
        ("idic/new.py", {()}),
    ],
)
def test_changed_code_changes_the_keys_of_what_depends_on_it(
    tmp_path: Path, name: str, folders_that_see_it: set[tuple[str, ...]]
) -> None:
    path = copied_package(tmp_path) / name
    path.write_text(path.read_text() + "\n" if path.exists() else "")
    every: tuple[tuple[str, ...], ...] = ((), ("fem",), ("fem", "imaging"))
    found = zip(every, digests_in(tmp_path, *every), strict=True)
    differ = {folders for folders, digest in found if digest != source_digest(*folders)}
    assert differ == folders_that_see_it


def test_a_key_holds_the_content_and_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    keys = {stage_key(["a"]), stage_key(["b"]), stage_key(["a"], "fem")}
    monkeypatch.setattr(stages, "source_digest", lambda *folders: "of other code")
    assert len(keys | {stage_key(["a"])}) == 4


# -- one process ------------------------------------------------------------------------

HOLDS = """
import sys
from modeharvest.util.stages import exclusive
sys.argv = ["modeharvest", "run", "a case"]
with exclusive(sys.stdin.readline().strip()):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def locked_elsewhere(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the folder."""
    pipe = subprocess.PIPE
    other = subprocess.Popen([sys.executable, "-c", HOLDS], stdin=pipe, stdout=pipe, text=True)
    assert other.stdin is not None
    assert other.stdout is not None
    print(folder, file=other.stdin, flush=True)
    assert other.stdout.readline() == "held\n"
    try:
        yield other
    finally:
        other.communicate()


def test_a_fixed_folder_is_refused_with_its_holder_and_free_afterwards(tmp_path: Path) -> None:
    with locked_elsewhere(tmp_path) as other:
        with pytest.raises(InputError) as error, exclusive(tmp_path):
            pass
        message = f"process {other.pid} on {socket.gethostname()}, since 20"
        assert message in str(error.value)
        assert "modeharvest run 'a case'; wait until that ends" in str(error.value)
        assert "\n" not in str(error.value)
        with exclusive(tmp_path / "sub"):
            pass
    with exclusive(tmp_path):
        assert (tmp_path / ".lock").exists()
    assert not list(tmp_path.iterdir())  # "sub" was made for its lock alone


def test_the_system_gives_the_folder_back_when_its_holder_is_killed(tmp_path: Path) -> None:
    with locked_elsewhere(tmp_path) as other:
        other.send_signal(signal.SIGKILL)
        other.wait()
        assert (tmp_path / ".lock").exists()
        with exclusive(tmp_path):
            pass
    assert not list(tmp_path.iterdir())


def test_the_same_thread_may_ask_again_and_another_may_not(tmp_path: Path) -> None:
    message: list[str] = []

    def ask() -> None:
        try:
            with exclusive(tmp_path):
                message.append("had it")
        except InputError as error:
            message.append(str(error))

    thread = threading.Thread(target=ask)
    with exclusive(tmp_path):
        with exclusive(tmp_path / "sub" / ".."):
            pass
        thread.start()
        thread.join()
    assert f"process {os.getpid()}" in message[0]
    ask()
    assert message[1] == "had it"


@pytest.mark.parametrize(
    ("process", "host", "is_free"),
    [("own", "here", False), ("ended", "here", True), ("ended", "elsewhere", False)],
)
def test_without_locks_in_the_file_system_the_file_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, process: str, host: str, is_free: bool
) -> None:
    def refuse(file: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    is_over = subprocess.Popen([sys.executable, "-S", "-c", ""])
    is_over.wait()
    holder = {
        "process": os.getpid() if process == "own" else is_over.pid,
        "host": socket.gethostname() if host == "here" else "far.example.org",
    }
    (tmp_path / ".lock").write_text(json.dumps(holder))
    if is_free:
        with exclusive(tmp_path):
            pass
        assert not list(tmp_path.iterdir())
    else:
        with (
            pytest.raises(InputError, match=r"if it is gone, remove .*\.lock"),
            exclusive(tmp_path),
        ):
            pass


def test_where_nothing_can_be_written_nothing_is_locked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is finished can be read from a read-only folder."""
    Stages(tmp_path).do("one", "key", Work(tmp_path))

    def refuse(path: Path, flags: int, mode: int = 0) -> int:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "open", refuse)
    with exclusive(tmp_path):
        assert Stages(tmp_path).is_finished("one", "key")
    with pytest.raises(InputError, match="could not write"):
        Stages(tmp_path).do("two", "key", Work(tmp_path))


@pytest.fixture(scope="module")
def occupied(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder that another process has."""
    folder = tmp_path_factory.mktemp("occupied") / "out"
    with locked_elsewhere(folder):
        yield folder


@pytest.mark.parametrize(
    "command",
    [
        "run case.toml --solution solution.h5",
        "run paper-real-twin --solution solution.h5",
        "image case.toml --solution solution.h5",
        "fem case.toml",
        "bloch square-lattice",
        "modes square-lattice",
        "harvest experiment.toml",
        "measure a.tif b.tif",
        "homogenize paper-homogenized",
        "study robustness",
        "benchmark make case.toml",
        "benchmark star --rows 51 --cols 400",
        "score field.csv --truth set-truth --strain 0.05",
        "benchmark resolution field.csv --set star",
    ],
)
def test_every_command_that_writes_a_folder_has_it_alone(
    command: str,
    occupied: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("case.toml").write_text(synthetic_benchmark.CASE, "utf-8")
    synthetic_benchmark.solution().write("solution.h5")
    for name in ("a.tif", "b.tif"):
        Path(name).write_text("not read before the folder is known to be free")
    Path("experiment.toml").write_text(
        '[images]\nreference = "a.tif"\ndeformed = ["b.tif"]\n'
        "[scale]\npixel_size = 0.01\n[specimen]\ncell_size = 1.9\n"
    )
    monkeypatch.setattr(sys, "argv", ["modeharvest", *command.split(), "--out", str(occupied)])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    (line,) = [row for row in capsys.readouterr().err.splitlines() if row.startswith("error:")]
    assert "for this process alone, but it is used by process" in line
    assert [path.name for path in occupied.iterdir()] == [".lock"]


@pytest.mark.dolfinx
def test_under_mpirun_one_rank_holds_for_all_and_all_are_refused(tmp_path: Path) -> None:
    program = (
        "import sys\n"
        "from modeharvest.util.errors import InputError, MissingDependencyError\n"
        "from modeharvest.util.stages import exclusive\n"
        "try:\n"
        f"    with exclusive({str(tmp_path)!r}):\n"
        "        print('had it', flush=True)\n"
        "except InputError:\n"
        "    print('refused', flush=True)\n"
    )
    patient = {**os.environ, "OMPI_MCA_mpi_yield_when_idle": "1"}  # a waiting rank does not spin
    command = ["mpirun", "-n", "2", sys.executable, "-c", program]

    def counted(word: str) -> int:
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=patient)
        assert done.returncode == 0, done.stderr
        return done.stdout.count(word)

    assert counted("had it") == 2
    with locked_elsewhere(tmp_path):
        assert counted("refused") == 2


def test_a_command_can_be_typed_again_whatever_its_files_are_called() -> None:
    line = command_line("harvest", Path("my test.toml"), "--out", "out/a b")
    assert line == "modeharvest harvest 'my test.toml' --out 'out/a b'"


def test_a_stage_that_fails_at_once_leaves_no_folder(tmp_path: Path) -> None:
    def work() -> list[Path]:
        raise MissingDependencyError("no dolfinx")

    stages = Stages(tmp_path / "out" / "run")
    with pytest.raises(MissingDependencyError):
        stages.do("fem", "key", work)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out").mkdir()  # what was there before stays
    with pytest.raises(MissingDependencyError):
        stages.do("fem", "key", work)
    assert list(tmp_path.rglob("*")) == [tmp_path / "out"]
