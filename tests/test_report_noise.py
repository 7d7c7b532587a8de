"""Camera images: the residual against the noise they have, and what the report says of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_report as made_up

from modeharvest.imaging.sensor import Sensor
from modeharvest.report import experiment
from modeharvest.report.experiment import key_numbers, notes, number_cards
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.runs.experiment import Run
from modeharvest.util.files import read_json

pytestmark = pytest.mark.usefixtures("coarse_pictures")

CASE = """
[experiment]
strains = [0.128]
[imaging]
pixel_size = 0.06
bits = 10
[imaging.sensor]
read_noise = 0.02
full_well = 5000
[whole_field]
measure = false
"""


def finished(folder: Path, correlation: str) -> Run:
    """A run of the shipped solution, correlated."""
    path = folder / "case.toml"
    path.write_text(f"{CASE}\n[correlation]\n{correlation}\n", "utf-8")
    run = Run(Case.read(path), folder / "out", solution=shipped_solution("paper-virtual"))
    run.image()
    run.correlate()
    return run


@pytest.fixture(scope="module")
def exposed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    options = "camera = true\nbrightness = 0"
    run = finished(tmp_path_factory.mktemp("camera"), options)
    run.validate()
    return run


def test_chi_squared_is_noise_and_what_noise_free_images_leave(
    exposed: Run, tmp_path: Path
) -> None:
    """Independent of each other, their squares add up; the images' own predictions go in."""
    (snapshot,) = read_json(exposed.folder / "summary.json")["snapshots"]
    (clean,) = finished(tmp_path, "camera = false").correlate().values()
    (noisy,) = exposed.correlate().values()
    info = exposed.image().info
    variance = np.mean([info["reference"]["noise_sd"] ** 2, info["snapshots"][0]["noise_sd"] ** 2])
    assert snapshot["noise_sd"] == pytest.approx(np.sqrt(variance), rel=1e-6)
    in_f, in_g = info["reference"]["noise_sd"], info["snapshots"][0]["noise_sd"]
    noise = in_f**2 + noisy.noise_transfer.value * in_g**2
    # 5e4 px: the noise's square scatters by 1 %, and w is not quite the same without noise.
    assert snapshot["chi_square"] == pytest.approx(1 + clean.residual_rms**2 / noise, rel=0.04)
    assert snapshot["chi_square"] > 1.1  # w is seen
    assert "chi squared is" in snapshot["residual_verdict"]
    assert "The residual was weighed with" in snapshot["weighting"]


def test_gain_and_offset_are_reported_where_they_were_unknown(exposed: Run) -> None:
    (snapshot,) = read_json(exposed.folder / "summary.json")["snapshots"]
    assert 0.9 < snapshot["gain_min"] == snapshot["gain_max"] < 1.1
    assert snapshot["offset_min"] == snapshot["offset_max"]  # of degree 0
    assert abs(snapshot["offset_min"]) < 0.05
    page = (exposed.folder / "report.html").read_text("utf-8")
    assert "gain between the images" in page
    assert "χ² of the residual" in page
    assert "single exposures of the virtual camera" in page
    assert "the residual was weighed with" in page


def summary(**snapshot: Any) -> dict[str, Any]:
    made = made_up.summary(made_up.data((0.1,)))
    made["snapshots"][0] |= {"pattern_inner_px": 0.2} | snapshot
    return made


def note(made: dict[str, Any], about: str) -> str:
    (found,) = (message for message in notes(made) if about in message)
    return found


def row_labels(made: dict[str, Any]) -> list[str]:
    return [str(row[0]) for card in number_cards(made) for t in card.tables for row in t.rows]


def test_rows_that_no_snapshot_has_are_left_out() -> None:
    labels = row_labels(summary(noise_sd=None, chi_square=None))
    assert not any("χ²" in label or "gain" in label for label in labels)
    labels = row_labels(summary(noise_sd=0.01, chi_square=1.2))
    assert sum("χ²" in label for label in labels) == 1


def test_what_standard_errors_mean_depends_on_the_images() -> None:
    about = "The first treats the whole residual"
    assert "No noise was added" in note(summary(), about)
    assert "predicted noise of 0.01 of full scale" in note(summary(noise_sd=0.01), about)
    noisy = summary() | {"case": {"imaging": {"sensor": {"read_noise": 0.01, "full_well": 0.0}}}}
    assert "noise-free averages" in note(noisy, about)


def test_a_fixed_mode_has_no_parameters_off_the_ideal() -> None:
    fixed = summary(mode=[], mode_deviation_percent=[])
    assert "Fixed at the ideal pattern" in note(fixed, "no pattern is observable")
    assert not any("nan" in message for message in notes(fixed))
    (key,) = (k for k in key_numbers(fixed) if k.name == "deviation of the mode")
    assert (key.value, key.remark) == (None, "fixed at the ideal pattern")
    assert "% off the ideal" in note(summary(), "no pattern is observable")


@dataclass(frozen=True)
class Warm(Sensor):
    """A sensor with a noise that this project doesn't have, as in docs/how-to/extending.md."""

    dark_variance: float = 0.0

    def noise_model(self, bits: int) -> tuple[float, float]:
        constant, slope = super().noise_model(bits)
        return constant + self.dark_variance, slope


def test_the_report_knows_noise_of_any_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiment, "Sensor", Warm)
    noisy = summary() | {"case": {"imaging": {"sensor": {"dark_variance": 1e-4}}}}
    assert "noise-free averages" in note(noisy, "The first treats the whole residual")
