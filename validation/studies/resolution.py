"""Resolution study: waves of v0 and v1 and noise, measured at several polynomial degrees."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd

from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.uncertainty.covariance import field_errors
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.campaign import grid
from modeharvest.validation.resolution.buckled import (
    LARGEST,
    AddedWave,
    AnalyticPair,
    BuckledMotion,
    ResolutionSpec,
)
from modeharvest.validation.resolution.transfer import wave_share
from modeharvest.validation.resolution.waves import AXES, QUANTITIES, WAVED, TransferCurves
from modeharvest.validation.studies.study import MOST, require_different, require_mode
from modeharvest.validation.studies.study import ImagePairSpec as Experiment
from modeharvest.validation.workers import Case


def noise_floors(done: pd.DataFrame, subject: ResolutionSpec) -> pd.DataFrame:
    """Scatter under noise against what each result's covariance tells, and the least there can be.

    The rms over realisations and material [px], by motion, degree and quantity.
    """
    rows = []
    for motion, what in MOTIONS.items():
        noisy = done[(done["task"] == "noise") & (done["motion"] == motion)]
        floors = done[(done["task"] == "floor") & (done["motion"] == motion)]
        for degree in subject.measured:
            least = floors[floors["degree"] == degree]
            if len(noisy) < 2 or not len(least):
                continue
            for name in QUANTITIES:
                squares = noisy[f"{name}_{degree}"].to_numpy(float) ** 2
                told = float(np.sqrt((noisy[f"told_{name}_{degree}"] ** 2).mean()))
                scatter = float(np.sqrt(squares.mean()))
                error = squares.std(ddof=1) / np.sqrt(len(squares)) / (2.0 * scatter)
                rows.append({
                    "images": what, "degree": degree, "quantity": name,
                    "bound [10⁻³ px]": 1e3 * float(least[name].iloc[0]),
                    "told by covariance [10⁻³ px]": 1e3 * told,
                    "Monte Carlo [10⁻³ px]": 1e3 * scatter,
                    "Monte Carlo / told": scatter / told, "±": error / told,
                })  # fmt: skip
    return pd.DataFrame(rows)


def measured_waves(
    done: pd.DataFrame, subject: ResolutionSpec, curves: TransferCurves
) -> pd.DataFrame:
    """Shares of waves found in images and by best fits, over both phases."""
    waves, rows = done[done["task"] == "wave"], []
    pitch = subject.buckled.specimen.pitch
    for (part, axis, period), both in waves.groupby(["part", "axis", "period"]):
        if len(both) < 2:
            continue
        for degree in subject.measured:
            fit = curves.at(part, axis, degree, period)
            found = float(np.average(both[f"own_{degree}"], weights=both["power"]))
            rows.append({
                "wave of": part, "along": AXES[axis], "period [cells]": period / pitch,
                "degree": degree, "best fit": fit, "images": found, "difference": found - fit,
            })  # fmt: skip
    return pd.DataFrame(rows)


Row = dict[str, Any]

MOTIONS = {"buckled": "under the base motion", "still": "without motion, φ1 held"}

"""Of the points at which fields are compared [mm]."""

"""Every so many of them are enough for standard deviations, which are as smooth as the ansatz."""


@lru_cache(maxsize=2)
def _exact_pair(folder: Path, name: str, motion: str) -> AnalyticPair:
    """The images without wave and noise."""
    buckled = ResolutionSpec.read(folder, name).buckled
    return buckled.still() if motion == "still" else buckled.images()


@lru_cache(maxsize=32)
def _noise_free(folder: Path, name: str, motion: str, degree: int) -> Result:
    """What is measured in them."""
    return ResolutionSpec.read(folder, name).correlate(
        _exact_pair(folder, name, motion), degree, motion
    )


def one_case(case: Mapping[str, Any], folder: Path) -> Row:
    """Run a case of :meth:`modeharvest.validation.studies.resolution.ResolutionStudy.prepare`.

    Parameters
    ----------
    case
        Its ``task`` says what: "wave", "noise" or "floor".
    folder
        Of the study.
    """
    tasks: dict[str, Callable[[Mapping[str, Any], Path], Row]] = {
        "wave": _wave,
        "noise": _noise,
        "floor": _floor,
    }
    return tasks[case["task"]](case, folder)


def _wave(case: Mapping[str, Any], folder: Path) -> Row:
    """The shares of a wave that are found in its own part and in the whole, by degree."""
    name = case["subject"]
    subject = ResolutionSpec.read(folder, name)
    buckled = subject.buckled
    amplitude = subject.amplitude_px * buckled.pixel_size
    wave = AddedWave(case["part"], case["axis"], case["period"], case["phase"], amplitude)
    pair = buckled.images(wave)
    points = subject.points
    true = buckled.wave_at(wave, points)[..., None]
    row: Row = {"power": float((true**2).sum())}
    for degree in subject.measured:
        found = subject.correlate(pair, degree, "buckled")
        quiet = _noise_free(folder, name, "buckled", degree)
        change = {
            part: _part_at(found, part, points) - _part_at(quiet, part, points)
            for part in ("v0", "v1")
        }
        row[f"own_{degree}"] = float(wave_share(change[case["part"]][..., None], true)[0])
        row[f"whole_{degree}"] = float(
            wave_share((change["v0"] + change["v1"])[..., None], true)[0]
        )
        row[f"outcome_{degree}"] = found.outcome.value
    return row


def _part_at(result: Result, part: str, points: FloatArray) -> FloatArray:
    """(m, 2) v0 or v1 phi1 at points [mm]."""
    ansatz, a = result.ansatz, result.unknowns
    x, y = points[:, 0, None], points[:, 1, None]
    found = ansatz.v0(a, x, y) if part == "v0" else ansatz.fluctuation(0, a, x, y)
    return np.asarray(found[:, 0])


def _floor(case: Mapping[str, Any], folder: Path) -> Row:
    """Standard deviations by 2 s^2 M^-1 of the exact images, rms over the material [px]."""
    name = case["subject"]
    subject = ResolutionSpec.read(folder, name)
    result = _noise_free(folder, name, case["motion"], case["degree"])
    told = _predicted(subject, result, 2.0 * subject.noise**2 * result.inverse)
    return {"unknowns": result.ansatz.size, "outcome": result.outcome.value, **told}


def _predicted(subject: ResolutionSpec, result: Result, covariance: FloatArray) -> Row:
    """Rms standard deviations of the fields by a covariance of the unknowns [px]."""
    points, cellular = subject.sparse
    errors = field_errors(result, points[:, 0, None], points[:, 1, None], covariance)
    px = subject.buckled.pixel_size
    return {
        "v0": rms(errors.v0) / px,
        "v1": LARGEST * rms(errors.v[0][cellular]) / px,
        "v1phi1": rms(errors.fluctuation[0][cellular]) / px,
        "u": rms(errors.displacement) / px,
    }


def _noise(case: Mapping[str, Any], folder: Path) -> Row:
    """Errors of fields from noisy images, and those their covariance tells, by degree [px]."""
    name, motion = case["subject"], case["motion"]
    subject = ResolutionSpec.read(folder, name)
    rng = np.random.default_rng([case["seed"], case["number"], motion == "still"])
    pair = _exact_pair(folder, name, motion).noisy(subject.noise, rng)
    row: Row = {}
    for degree in subject.measured:
        found = subject.correlate(pair, degree, motion)
        errors = _errors(subject, found, _noise_free(folder, name, motion, degree))
        told = _predicted(subject, found, found.covariance(subject.noise))
        row |= {f"{key}_{degree}": value for key, value in errors.items()}
        row |= {f"told_{key}_{degree}": value for key, value in told.items()}
        row[f"outcome_{degree}"] = found.outcome.value
    return row


def _errors(subject: ResolutionSpec, found: Result, quiet: Result) -> Row:
    """Rms differences of the fields of two results [px]."""
    points, cellular = subject.sparse
    x, y = points[:, 0, None], points[:, 1, None]
    v0, v1phi1 = (
        _part_at(found, part, points) - _part_at(quiet, part, points) for part in ("v0", "v1")
    )
    v1 = found.ansatz.v(0, found.unknowns, x, y) - quiet.ansatz.v(0, quiet.unknowns, x, y)
    px = subject.buckled.pixel_size
    return {
        "v0": rms(v0) / px,
        "v1": LARGEST * rms(v1[cellular]) / px,
        "v1phi1": rms(v1phi1[cellular]) / px,
        "u": rms(v0 + v1phi1) / px,
    }


def rms(values: FloatArray) -> float:
    """Root mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))


@dataclass(frozen=True)
class ResolutionStudy:
    """Small waves of v0 and v1 on a buckled specimen, and noise, against the polynomial degree.

    Parameters
    ----------
    strain
        Nominal compression of the base motion [-].
    pattern
        Its v1, the same everywhere [mm].
    degrees
        Of v0 and v1 alike.
    measured
        Those of them that images are measured with, too.
    amplitude_px
        Of a wave [px].
    noise
        Standard deviation in each image [fraction of full scale].
    realisations
        Of the noise.
    seed
        Of the noise.

    Raises
    ------
    InputError
        If a value is out of its range.
    """

    strain: float = 0.128
    pattern: float = 7.0
    degrees: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7, 8)
    measured: tuple[int, ...] = (3, 5, 7)
    amplitude_px: float = 0.5
    noise: float = 0.01
    realisations: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        require_different("degrees", self.degrees)
        if not self.degrees or not all(1 <= d <= 12 for d in self.degrees):
            raise InputError(f"study: expected degrees from 1 to 12, got {list(self.degrees)}")
        if not self.measured or not set(self.measured) <= set(self.degrees):
            raise InputError(
                f"study: expected measured degrees among {list(self.degrees)}, got "
                f"{list(self.measured)}"
            )
        if not (0.0 < self.amplitude_px <= 2.0 and 0.0 < self.noise < 0.1):
            raise InputError(
                "study: expected an amplitude above 0 and up to 2 px and noise above 0 and below "
                f"0.1 of full scale, got {self.amplitude_px} and {self.noise}"
            )
        if self.pattern == 0.0 or not 2 <= self.realisations <= MOST or self.seed < 0:
            raise InputError(
                f"study: expected a pattern that is not 0 mm, 2 to {MOST} realisations and a seed "
                f"of 0 or more, got {self.pattern}, {self.realisations} and {self.seed}"
            )

    @property
    def question(self) -> str:
        """What is asked, for the report."""
        return (
            "How fine a change of v0 and v1 does an ansatz of polynomials show, and what noise "
            "does each degree cost? Small waves on a buckled specimen are measured; the period "
            "at which 10 % of their amplitude is lost, times the noise floor, is the "
            "metrological efficiency indicator of DIC Challenge 2.0, carried over to "
            "parametrised fields."
        )

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""
        return f"{one_case.__module__}:{one_case.__name__}"

    @property
    def seeds(self) -> str:
        """Of the noise."""
        return f"seed {self.seed} of the noise"

    def require(self, correlation: SquareLatticeOptions) -> None:
        """The mode is measured, in exact images, and brightness is none of the question."""
        require_mode(correlation)
        if correlation.camera or correlation.brightness.size:
            raise InputError(
                "study: expected correlation.camera = false and neither gain nor offset, got "
                "others: waves are measured in exact images"
            )

    def quick(self) -> Self:
        """Fewer degrees measured, fewer realisations."""
        middle = self.measured[len(self.measured) // 2]
        return replace(self, measured=(middle,), realisations=max(2, self.realisations // 2))

    def prepare(
        self, subject: Experiment, folder: Path, progress: Progress = silent
    ) -> tuple[Case, ...]:
        """Say what is measured; the cases are waves, noise, and the floors of exact images."""
        buckled = BuckledMotion(
            subject.experiment.specimen,
            subject.correlation,
            subject.imaging.speckle,
            subject.imaging.pixel_size,
            self.strain,
            self.pattern,
        )
        measured = ResolutionSpec(buckled, self.measured, self.amplitude_px, self.noise)
        base: Case = {
            "subject": measured.write(folder), "task": "floor", "motion": "buckled", "part": "",
            "axis": 0, "period": 0.0, "phase": 0.0, "degree": 0, "number": 0, "seed": self.seed,
        }  # fmt: skip
        floors = grid(base, motion=tuple(MOTIONS), degree=self.degrees)
        noise = grid(
            {**base, "task": "noise"}, motion=tuple(MOTIONS), number=range(self.realisations)
        )
        curves = TransferCurves.of(measured, self.measured, progress)
        waves = [
            {**base, "task": "wave", "part": part, "axis": axis, "phase": phase,
             "period": round(curves.finest(part, axis, degree), 3)}
            for part in WAVED
            for axis in range(len(AXES))
            for degree in self.measured
            for phase in (0.0, 0.5 * np.pi)
        ]  # fmt: skip
        return (*waves, *noise, *floors)
