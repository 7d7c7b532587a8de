"""Resolution study: waves of v0 and v1 and noise, measured at several polynomial degrees."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import pandas as pd

from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.uncertainty.covariance import field_errors
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.campaign import grid
from modeharvest.validation.studies.buckled import LARGEST, AddedWave, BuckledMotion, ResolutionSpec
from modeharvest.validation.studies.study import ImagePairSpec, Study, noisy
from modeharvest.validation.studies.transfer import (
    AXES,
    WAVED,
    DegreeResolution,
    Passband,
    TransferCurves,
    degrees_of,
    subset_indicator,
    wave_share,
)
from modeharvest.validation.truth import rms
from modeharvest.validation.workers import Case, Cases, Row

MOTIONS = {"buckled": "under the base motion", "still": "without motion, φ1 fixed"}


@lru_cache(maxsize=2)
def _exact_pair(spec: ResolutionSpec, motion: str) -> ImagePair:
    """The images without wave and without noise."""
    return spec.buckled.still() if motion == "still" else spec.buckled.images()


@lru_cache(maxsize=32)
def _noise_free(spec: ResolutionSpec, motion: str, degree: int) -> Result:
    """The result of correlating them."""
    return spec.correlate(_exact_pair(spec, motion), degree, motion)


def one_case(case: Case, folder: Path) -> Row:
    """Run a case of :meth:`ResolutionStudy.prepare`; its ``task`` is wave, noise or floor.

    Names of quantities that depend on the degree end with an underscore and the degree.
    """
    tasks = {"wave": _wave, "noise": _noise, "floor": _floor}
    return tasks[case["task"]](case, ResolutionSpec.read(folder, case["images"]))


def _wave(case: Case, spec: ResolutionSpec) -> Row:
    """The shares of a wave measured in its own part and in the whole displacement, by degree."""
    buckled, points = spec.buckled, spec.points
    amplitude = spec.amplitude_px * buckled.pixel_size
    wave = AddedWave(case["part"], case["axis"], case["period"], case["phase"], amplitude)
    pair = buckled.images(wave)
    true = buckled.wave_at(wave, points)[..., None]
    row: Row = {"power": float((true**2).sum())}
    for degree in spec.measured:
        found = spec.correlate(pair, degree, "buckled")
        v0, _, v1phi1 = _changes(_noise_free(spec, "buckled", degree), found, points)
        own, whole = v0 if case["part"] == "v0" else v1phi1, v0 + v1phi1
        row[f"own_{degree}"] = float(wave_share(own[..., None], true)[0])
        row[f"whole_{degree}"] = float(wave_share(whole[..., None], true)[0])
        row[f"outcome_{degree}"] = found.outcome.value
    return row


def _changes(quiet: Result, found: Result, points: FloatArray) -> list[FloatArray]:
    """Differences of v0 (m, 2), v1 (m,) and v1 phi1 (m, 2) of two results at points [mm]."""
    x, y = points[:, 0, None], points[:, 1, None]
    before, after = (
        (ansatz.v0(a, x, y), ansatz.v(0, a, x, y), ansatz.fluctuation(0, a, x, y))
        for ansatz, a in ((fit.ansatz, fit.unknowns) for fit in (quiet, found))
    )
    return [(b - a)[:, 0] for a, b in zip(before, after, strict=True)]


def _floor(case: Case, spec: ResolutionSpec) -> Row:
    """Noise floors of the fields: sd by 2 s^2 M^-1 of the exact images, rms over material [px]."""
    result = _noise_free(spec, case["motion"], case["degree"])
    predicted = _predicted(spec, result, 2.0 * spec.noise**2 * result.inverse)
    return {"unknowns": result.ansatz.size, "outcome": result.outcome.value, **predicted}


def _noise(case: Case, spec: ResolutionSpec) -> Row:
    """Errors of fields in noisy images, and errors predicted by covariances, by degree [px]."""
    motion = case["motion"]
    rng = np.random.default_rng([case["seed"], case["number"], motion == "still"])
    pair = noisy(_exact_pair(spec, motion), spec.noise, rng)
    row: Row = {}
    for degree in spec.measured:
        found = spec.correlate(pair, degree, motion)
        v0, v1, v1phi1 = _changes(_noise_free(spec, motion, degree), found, spec.sparse[0])
        errors = _rms_px(spec, v0, v1, v1phi1, v0 + v1phi1)
        predicted = _predicted(spec, found, found.covariance(spec.noise))
        row |= {f"{key}_{degree}": value for key, value in errors.items()}
        row |= {f"predicted_{key}_{degree}": value for key, value in predicted.items()}
        row[f"outcome_{degree}"] = found.outcome.value
    return row


def _predicted(spec: ResolutionSpec, result: Result, covariance: FloatArray) -> Row:
    """Rms standard deviations of the fields by a covariance of the unknowns [px]."""
    points, _ = spec.sparse
    sd = field_errors(result, points[:, 0, None], points[:, 1, None], covariance)
    return _rms_px(spec, sd.v0, sd.v[0], sd.fluctuation[0], sd.displacement)


def _rms_px(
    spec: ResolutionSpec, v0: FloatArray, v1: FloatArray, v1phi1: FloatArray, u: FloatArray
) -> Row:
    """Rms [px] of fields [mm] at ``spec.sparse``; v1 is scaled by the largest ||phi1||."""
    _, cellular = spec.sparse
    mm = {"v0": rms(v0), "v1": LARGEST * rms(v1[cellular]), "v1phi1": rms(v1phi1[cellular]),
          "u": rms(u)}  # fmt: skip
    return {name: value / spec.buckled.pixel_size for name, value in mm.items()}


@dataclass(frozen=True, eq=False)
class ResolutionAnalysis:
    """Evaluation of the table of a resolution study."""

    spec: ResolutionSpec
    rows: pd.DataFrame
    """The cases that succeeded."""
    degrees: list[DegreeResolution]
    chosen: DegreeResolution
    """The degree nearest to the v0 degree of the specification."""
    curves: TransferCurves
    passband: Passband
    """Best fits of waves, and of patterns of other wavelengths."""
    subset_px2: float
    """The indicator of an affine subset [px^2]."""

    @classmethod
    def of(cls, table: pd.DataFrame, spec: ResolutionSpec, curves: TransferCurves) -> Self:
        """From the table of all cases, and the best fits of waves at all degrees."""
        rows = table[table["error"] == ""]
        degrees = degrees_of(rows, spec, curves)
        chosen = min(degrees, key=lambda d: abs(d.degree - spec.buckled.how.v0_degree))
        passband = Passband.of(spec, chosen.degree)
        return cls(spec, rows, degrees, chosen, curves, passband, subset_indicator(spec))


@dataclass(frozen=True)
class ResolutionStudy(Study[ResolutionAnalysis]):
    """Measure small waves of v0 and v1 on a buckled specimen, and noise, by polynomial degree.

    InputError for values out of range.
    """

    question: ClassVar[str] = (
        "How fine a change of v0 and v1 does an ansatz of polynomials show, and what noise does "
        "each degree cost? Small waves on a buckled specimen are measured; the period at which 10 "
        "% of their amplitude is lost, times the noise floor, is the metrological efficiency "
        "indicator of DIC Challenge 2.0, carried over to parametrised fields."
    )
    function: ClassVar[str] = f"{__name__}:one_case"
    measures_mode: ClassVar[bool] = True

    strain: float = 0.128
    """Nominal compression of the base motion [-]."""
    pattern: float = 7.0
    """Uniform v1 of the base motion [mm]."""
    degrees: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7, 8)
    """Degrees of v0 and of v1, the same for both."""
    measured: tuple[int, ...] = (3, 5, 7)
    """Those degrees with which images are also measured."""
    amplitude_px: float = 0.5
    """Amplitude of a wave [px]."""
    noise: float = 0.01
    """Standard deviation of the noise in each image [fraction of full scale]."""
    realisations: int = 20
    """Number of realisations of the noise, from ``seed``."""
    seed: int = 0

    def __post_init__(self) -> None:
        self.require_different("degrees", self.degrees)
        if not self.degrees or not all(1 <= d <= 12 for d in self.degrees):
            raise InputError(f"study: expected degrees from 1 to 12, got {list(self.degrees)}")
        if not self.measured or not set(self.measured) <= set(self.degrees):
            known, got = list(self.degrees), list(self.measured)
            raise InputError(f"study: expected measured degrees among {known}, got {got}")
        if not (0.0 < self.amplitude_px <= 2.0 and 0.0 < self.noise < 0.1):
            raise InputError(
                "study: expected an amplitude above 0 and up to 2 px and noise above 0 and below "
                f"0.1 of full scale, got {self.amplitude_px} and {self.noise}"
            )
        if self.pattern == 0.0 or not 2 <= self.realisations <= self.most or self.seed < 0:
            raise InputError(
                f"study: expected a pattern that is not 0 mm, 2 to {self.most} realisations and a "
                f"seed of 0 or more, got {self.pattern}, {self.realisations} and {self.seed}"
            )

    def require(self, correlation: SquareLatticeOptions) -> None:
        """Require a free mode, exact images, and no unknown gain or offset."""
        super().require(correlation)
        if correlation.camera or correlation.brightness != "none":
            raise InputError(
                "study: expected correlation.camera = false and neither gain nor offset, got "
                "others: waves are measured in exact images"
            )

    def quick(self) -> Self:
        """Fewer degrees measured, fewer realisations."""
        middle = self.measured[len(self.measured) // 2]
        return replace(self, measured=(middle,), realisations=max(2, self.realisations // 2))

    def prepare(self, spec: ImagePairSpec, folder: Path, progress: Progress = silent) -> Cases:
        """Write the specification; the cases are waves, noise, and noise floors of exact images."""
        specimen, how, imaging = spec.experiment.specimen, spec.correlation, spec.imaging
        buckled = BuckledMotion(
            specimen, how, imaging.speckle, imaging.pixel_size, self.strain, self.pattern
        )
        measured = ResolutionSpec(buckled, self.measured, self.amplitude_px, self.noise)
        base: Case = {
            "images": measured.write(folder), "task": "floor", "motion": "buckled", "part": "",
            "axis": 0, "period": 0.0, "phase": 0.0, "degree": 0, "number": 0, "seed": self.seed,
        }  # fmt: skip
        motions, numbers = tuple(MOTIONS), range(self.realisations)
        floors = grid(base, motion=motions, degree=self.degrees)
        noise = grid({**base, "task": "noise"}, motion=motions, number=numbers)
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

    def analyse(self, table: pd.DataFrame, folder: Path) -> ResolutionAnalysis:
        """Transfer, noise floors and indicators by degree."""
        spec = ResolutionSpec.read(folder, table["images"].iloc[0])
        return ResolutionAnalysis.of(table, spec, TransferCurves.of(spec, self.degrees))
