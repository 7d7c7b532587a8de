"""One case of a resolution study: images of a wave, or of noise, measured at several degrees.

In the study's folder ``subjects/NAME.json`` says what is measured; NAME is its digest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from modeharvest.files import read_json, write_json
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import CorrelationOptions, correlate
from modeharvest.idic.error_bars import field_errors
from modeharvest.idic.pyramid import Level
from modeharvest.idic.result import Result
from modeharvest.stages import digest
from modeharvest.validation.resolution.buckled import LARGEST, Buckled, Pair, Wave
from modeharvest.validation.resolution.tangent import share

FloatArray = NDArray[np.float64]
Row = dict[str, Any]

MOTIONS = {"buckled": "under the base motion", "still": "without motion, φ1 held"}
SPACING = 0.2
"""Of the points at which fields are compared [mm]."""
_SPARSE = 2
"""Every so many of them are enough for standard deviations, which are as smooth as the ansatz."""


@dataclass(frozen=True)
class Subject:
    """What a resolution study measures.

    Parameters
    ----------
    buckled
        The base motion and its images.
    measured
        Degrees of v0 and v1 that images are measured with.
    amplitude_px
        Of a wave [px].
    noise
        Standard deviation in each image [fraction of full scale].
    """

    buckled: Buckled
    measured: tuple[int, ...]
    amplitude_px: float
    noise: float

    def write(self, folder: Path) -> str:
        """Leave it for workers; returns its name."""
        content = asdict(self)
        name = digest(content)[:16]
        write_json(folder / "subjects" / f"{name}.json", content)
        return name

    @classmethod
    def read(cls, folder: Path, name: str) -> Subject:
        """What :meth:`write` left; one worker keeps it, and its images, between cases."""
        return _subject(folder, name)

    @property
    def points(self) -> FloatArray:
        """(m, 2) points of the material at which fields are compared [mm]."""
        width, height = self.buckled.specimen.half_size
        x, y = (np.arange(-half + 0.5 * SPACING, half, SPACING) for half in (width, height))
        grid = np.stack(np.meshgrid(x, y), axis=-1)
        return np.asarray(grid[self.buckled.material(grid[..., 0], grid[..., 1])])

    @property
    def sparse(self) -> tuple[FloatArray, NDArray[np.bool_]]:
        """(k, 2) fewer of them, and (k,) which of those lie in the cellular part."""
        some = self.points[::_SPARSE]
        a, b = self.buckled.specimen.cellular_half_size
        return some, (np.abs(some[:, 0]) <= a) & (np.abs(some[:, 1]) <= b)

    def ansatz(self, degree: int, motion: str) -> Ansatz:
        """The paper's at a degree; without a pattern its mode is held."""
        return self.buckled.ansatz(degree, degree, hold_mode=motion == "still")

    def start(self, degree: int, motion: str) -> FloatArray:
        """The base motion, or none."""
        ansatz = self.ansatz(degree, motion)
        if motion == "still":
            return np.zeros(ansatz.size)
        return ansatz.start(self.buckled.strain, self.buckled.pattern)

    def correlate(self, pair: Pair, degree: int, motion: str) -> Result:
        """Measure a pair from what is nearly its motion, on the full images."""
        options = CorrelationOptions(
            (Level(1, 0.0),), self.buckled.how.edge_px, self.buckled.how.order
        )
        return correlate(
            pair.f, pair.g, self.buckled.grid, self.ansatz(degree, motion),
            self.start(degree, motion), pair.mask, pair.deformed_mask, options,
        )  # fmt: skip


_ADAPTER = TypeAdapter(Subject)


@lru_cache(maxsize=1)
def _subject(folder: Path, name: str) -> Subject:
    return _ADAPTER.validate_python(read_json(folder / "subjects" / f"{name}.json"))


@lru_cache(maxsize=2)
def _exact(folder: Path, name: str, motion: str) -> Pair:
    """The images without wave and noise."""
    buckled = Subject.read(folder, name).buckled
    return buckled.still() if motion == "still" else buckled.images()


@lru_cache(maxsize=32)
def _quiet(folder: Path, name: str, motion: str, degree: int) -> Result:
    """What is measured in them."""
    return Subject.read(folder, name).correlate(_exact(folder, name, motion), degree, motion)


def one_case(case: Mapping[str, Any], folder: Path) -> Row:
    """Run a case of :meth:`modeharvest.validation.resolution.study.Resolution.prepare`.

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
    subject = Subject.read(folder, name)
    buckled = subject.buckled
    amplitude = subject.amplitude_px * buckled.pixel_size
    wave = Wave(case["part"], case["axis"], case["period"], case["phase"], amplitude)
    pair = buckled.images(wave)
    points = subject.points
    true = buckled.wave_at(wave, points)[..., None]
    row: Row = {"power": float((true**2).sum())}
    for degree in subject.measured:
        found = subject.correlate(pair, degree, "buckled")
        quiet = _quiet(folder, name, "buckled", degree)
        change = {
            part: _at(found, part, points) - _at(quiet, part, points) for part in ("v0", "v1")
        }
        row[f"own_{degree}"] = float(share(change[case["part"]][..., None], true)[0])
        row[f"whole_{degree}"] = float(share((change["v0"] + change["v1"])[..., None], true)[0])
        row[f"outcome_{degree}"] = found.outcome.value
    return row


def _at(result: Result, part: str, points: FloatArray) -> FloatArray:
    """(m, 2) v0 or v1 phi1 at points [mm]."""
    ansatz, a = result.ansatz, result.unknowns
    x, y = points[:, 0, None], points[:, 1, None]
    found = ansatz.v0(a, x, y) if part == "v0" else ansatz.fluctuation(0, a, x, y)
    return np.asarray(found[:, 0])


def _floor(case: Mapping[str, Any], folder: Path) -> Row:
    """Standard deviations by 2 s^2 M^-1 of the exact images, rms over the material [px]."""
    name = case["subject"]
    subject = Subject.read(folder, name)
    result = _quiet(folder, name, case["motion"], case["degree"])
    told = _told(subject, result, 2.0 * subject.noise**2 * result.inverse)
    return {"unknowns": result.ansatz.size, "outcome": result.outcome.value, **told}


def _told(subject: Subject, result: Result, covariance: FloatArray) -> Row:
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
    subject = Subject.read(folder, name)
    rng = np.random.default_rng([case["seed"], case["number"], motion == "still"])
    pair = _exact(folder, name, motion).noisy(subject.noise, rng)
    row: Row = {}
    for degree in subject.measured:
        found = subject.correlate(pair, degree, motion)
        errors = _errors(subject, found, _quiet(folder, name, motion, degree))
        told = _told(subject, found, found.covariance(subject.noise))
        row |= {f"{key}_{degree}": value for key, value in errors.items()}
        row |= {f"told_{key}_{degree}": value for key, value in told.items()}
        row[f"outcome_{degree}"] = found.outcome.value
    return row


def _errors(subject: Subject, found: Result, quiet: Result) -> Row:
    """Rms differences of the fields of two results [px]."""
    points, cellular = subject.sparse
    x, y = points[:, 0, None], points[:, 1, None]
    v0, v1phi1 = (_at(found, part, points) - _at(quiet, part, points) for part in ("v0", "v1"))
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
