"""The example of docs/how-to/photographs.md works as printed, on images of known motion."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.sensor import quantise
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

PAGE = (Path(__file__).parents[1] / "docs/how-to/photographs.md").read_text("utf-8")


def test_the_printed_example_finds_the_motion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shape = (300, 340)
    speckle = Speckle(SpeckleSpec(standard_deviation=0.06, blur_px=2.0), shape)
    row, col = np.mgrid[: shape[0], : shape[1]].astype(float)
    stretch, shift = 1.02, np.array([6.0, -4.0])  # (row, col) about the middle
    at = (row - shift[0] - 149.5) / stretch + 149.5, (col - shift[1] - 169.5) / stretch + 169.5
    for name, (r, c) in (("reference", (row, col)), ("deformed", at)):
        material = (abs(r - 149.5) < 110) & (abs(c - 169.5) < 130)
        material &= np.hypot(r - 149.5, c - 169.5) > 35.0
        write_image(tmp_path / f"{name}.tif", quantise(np.where(material, speckle(r, c), 0.0), 8))
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(block, "docs/how-to/photographs.md", "exec"), names)

    grid, mask, u = (names[k] for k in ("grid", "mask", "u"))
    x, y = np.meshgrid(grid.x, grid.y)  # type: ignore[attr-defined]
    truth = np.stack([0.02 * x - 4.0, 0.02 * y - 6.0], axis=-1)[np.asarray(mask)]
    off = np.asarray(u) - truth
    # 40 000 px of 8 bits and 90 unknowns: the quantisation bound is below 1e-3 px.
    assert np.sqrt((off**2).mean()) < 0.01
