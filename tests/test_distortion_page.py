"""The examples of docs/how-to/distortion.md work as printed."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import distortion
import numpy as np
import pytest
from affine_aside import affine_aside
from calibration_set import photographs, random_lens

from modeharvest.imaging.distortion.files import read_distortion
from modeharvest.imaging.distortion.lens import CameraDistortion, PolynomialDistortion

PAGE = (Path(__file__).parents[1] / "docs/how-to/distortion.md").read_text("utf-8")
SHAPE = (140, 170)


def test_the_benchmark_says_what_it_takes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["distortion.py", "--help"])
    with pytest.raises(SystemExit) as end:
        distortion.main()
    assert end.value.code == 0
    assert "left_undist.png" in capsys.readouterr().out


def test_the_printed_examples_find_the_lens(tmp_path: Path) -> None:
    calibrate, recover = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    lens = random_lens(SHAPE, 3, 2.0)
    shifts = [[0, 0], [20, 2], [-19, 4], [3, 23], [-6, -21]]
    images = photographs(lens, SHAPE, shifts)
    names: dict[str, Any] = {"photographs": images, "folder": tmp_path}
    exec(compile(calibrate, "docs/how-to/distortion.md", "exec"), names)
    found = read_distortion(tmp_path / "lens.json")
    assert affine_aside(found, lens, SHAPE).rms_px < 1e-3  # without noise: the splines' errors

    camera = CameraDistortion(200, 200, 88.0, 66.0, k1=-0.2)
    nothing = PolynomialDistortion(SHAPE, np.zeros((2, 1)))
    for name, through in (("ideal_image", nothing), ("distorted_image", camera)):
        (names[name],) = photographs(through, SHAPE, [[0, 0]])
    exec(compile(recover, "docs/how-to/distortion.md", "exec"), names)
    at = np.arange(140.0)[:, None], np.arange(170.0)[None, :]
    off = np.stack(names["lens"].distortion.shift(*at)) - np.stack(camera.shift(*at))
    # Splines' errors, and both images are blurred alike although one of them is stretched.
    assert np.sqrt(np.mean(off**2)) < 3e-3
