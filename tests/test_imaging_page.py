"""The example of docs/explanation/imaging.md works as printed, and its options are a valid case."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from modeharvest.imaging.sensor import Sensor
from modeharvest.runs.case import Case

PAGE = (Path(__file__).parents[1] / "docs/explanation/imaging.md").read_text("utf-8")


def test_the_printed_example_predicts_its_noise(tmp_path: Path) -> None:
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    names = {"folder": tmp_path}
    exec(compile(block, "docs/explanation/imaging.md", "exec"), names)
    off = np.asarray(names["off"])
    assert abs(off.std() - 1.0) < 4 / np.sqrt(2 * off.size)


def test_the_printed_options_are_all_there_are(tmp_path: Path) -> None:
    block, _ = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    path = tmp_path / "case.toml"
    path.write_text(block, "utf-8")
    sensor = Case.read(path).imaging.sensor
    assert sensor == Sensor(0.8, 0.5, 0.9, 0.02, 10_000.0, 0.004, 0.98)
    assert all(f"\n{name} = " in block for name in Sensor.__dataclass_fields__)
