"""``modeharvest image``: what it says about the images it made."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from modeharvest.cli.root import main
from modeharvest.fem.field import Mesh, Snapshot, Solution

CASE = """[experiment]
strains = [0.05]
[imaging]
pixel_size = 0.1
"""


def two_squares(gap: float) -> Solution:
    """Two Q4 elements of 5 mm, so far apart when deformed; below 0 they overlap."""
    corners = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 5.0], [0.0, 5.0]])
    nodes = np.vstack([corners, corners + np.array([6.0, 0.0])])
    moved = np.zeros_like(nodes)
    moved[4:, 0] = gap - 1.0
    mesh = Mesh(nodes, np.arange(8).reshape(2, 4), "Q4")
    return Solution(mesh, (Snapshot(0.05, moved),), {})


@pytest.mark.parametrize(("gap", "overlaps"), [(0.55, False), (-0.55, True)])
def test_a_specimen_that_overlaps_itself_is_reported(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    gap: float,
    overlaps: bool,
) -> None:
    case, solution = tmp_path / "case.toml", tmp_path / "solution.h5"
    case.write_text(CASE, "utf-8")
    two_squares(gap).write(solution)
    arguments = ["image", case, "--out", tmp_path / "out", "--solution", solution]
    monkeypatch.setattr(sys, "argv", ["modeharvest", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    message = " ".join(capsys.readouterr().err.split())
    assert ("warning:" in message) == overlaps
    assert ("deformed_0500.tif" in message and "more than one element" in message) == overlaps
