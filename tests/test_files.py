"""Files are whole or absent, whatever ends the writing early."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, read_json, require_writable, write_json


def test_a_finished_write_replaces_the_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    for text in ("one", "two"):
        with atomic(path) as temporary:
            temporary.write_text(text)
    assert path.read_text() == "two"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("end", [KeyboardInterrupt, ValueError])
def test_an_interrupted_write_keeps_the_old_file(tmp_path: Path, end: type[BaseException]) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(end), atomic(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise end
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_reported_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with pytest.raises(InputError, match=r"could not write .*a\.txt: No space left"), atomic(path):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_reported_at_once(tmp_path: Path) -> None:
    require_writable(tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match=r"expected a folder at .*/file, found a file"):
            require_writable(folder)


def test_json_round_trip_and_a_cut_file(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    content = {"ξ": [1.5, None], "name": "φ₁"}
    write_json(path, content)
    assert read_json(path) == content
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match="expected a JSON file"):
        read_json(path)
