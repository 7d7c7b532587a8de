"""Robustness study: convergence from perturbed initial guesses, and the basin of convergence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.studies.study import ImagePairSpec, Study, VirtualImagePair, outcome_of
from modeharvest.validation.workers import Case, Cases, Row

SAME_PX = 0.01
"""Solutions whose displacements differ by less, rms, are the same minimum [px]."""
OUTLIER_PERCENT = 1.5
"""Epsilon above which the paper calls a result erroneous [%]."""
PUBLISHED = {"success": 0.98, "mean_epsilon_percent": 0.86,
             "mean_epsilon_without_outliers_percent": 0.45}  # fmt: skip
"""Section "Virtual Experiments" of the paper: 100 initial guesses, parameters up to 10 % off."""
EVERY = 4
"""Displacements are compared at every fourth pixel, since they are smooth."""


def success_interval(good: int, count: int) -> tuple[float, float]:
    """95 % confidence interval of a share by Wilson's score, doi 10.1080/01621459.1927.10502953."""
    low, high = binomtest(good, count).proportion_ci(0.95, method="wilson")
    return float(low), float(high)


@dataclass(frozen=True)
class GuessStatistics:
    """The paper's statistics, and others, for the initial guesses within one radius.

    Distances are rms lengths of the difference between a displacement and that of the reference
    solution.
    """

    initial_guesses: int
    radius: float
    same_minimum: int
    success: float
    success_interval_95: tuple[float, float]
    mean_epsilon_percent: float
    largest_epsilon_percent: float
    mean_epsilon_without_outliers_percent: float
    outliers: int
    largest_distance_px: float
    largest_distance_of_arrived_px: float
    largest_start_distance_px: float
    other_minimum_called_converged: int
    failed: int
    paper: Mapping[str, float]

    @classmethod
    def of(cls, guesses: pd.DataFrame, radius: float) -> GuessStatistics:
        """From the rows of these guesses, which have a column ``same``."""
        same = guesses["same"]
        good, count = int(same.sum()), len(guesses)
        epsilon = guesses["epsilon_percent"].dropna()
        outliers = epsilon > OUTLIER_PERCENT
        others = guesses[~same & (guesses["error"] == "")]
        distance = guesses["distance_px"]
        return cls(
            count, radius, good, good / count, success_interval(good, count),
            float(epsilon.mean()), float(epsilon.max()), float(epsilon[~outliers].mean()),
            int(outliers.sum()), float(distance.max()), float(distance[same].max()),
            float(guesses["start_distance_px"].max()),
            int((others["outcome"] == "converged").sum()),
            int((guesses["error"] != "").sum()), PUBLISHED,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RobustnessAnalysis:
    """Evaluation of the table of a robustness study.

    In its rows, ``same`` is True if the result is the reference solution's minimum.
    """

    moved: pd.DataFrame
    at_radius: pd.DataFrame
    """Rows with perturbed mode parameters: all, and those of the study's ``radius``."""
    strains: pd.DataFrame
    """Rows with a wrong initial strain."""
    statistics: GuessStatistics
    """Statistics for the study's ``radius``."""


@dataclass(frozen=True)
class RobustnessStudy(Study[RobustnessAnalysis]):
    """Correlate from many initial guesses.

    InputError if a value is out of range, or occurs twice.
    """

    question: ClassVar[str] = (
        "A correlation begins at an initial guess. Does it matter which? The same pair of virtual "
        "images is correlated from guesses whose mode parameters are off, and their results are "
        "compared with that of the standard guess."
    )
    function: ClassVar[str] = f"{__name__}:one_start"
    measures_mode: ClassVar[bool] = True
    seeded: ClassVar[str] = "perturbations"

    strain: float = 0.128
    initial_guesses: int = 100
    """Number of guesses with mode parameters perturbed by up to ``radius``; 100 in the paper."""
    radius: float = 0.1
    """Largest perturbation [-]: of a1 ... a5; of the two phases over l; 0.1 in the paper."""
    radii: tuple[float, ...] = (0.05, 0.15, 0.2, 0.3, 0.4, 0.5)
    per_radius: int = 20
    """Further radii, for the basin of convergence, and the number of guesses for each."""
    strain_errors: tuple[float, ...] = (-1.0, -0.5, -0.2, 0.2, 0.5)
    """Further guesses: v0 with the applied strain times (1 + these), the mode not perturbed."""
    seed: int = 0
    """Seed of the perturbations."""

    def __post_init__(self) -> None:
        counts_fit = 1 <= self.initial_guesses <= self.most and 0 <= self.per_radius <= self.most
        if not counts_fit or self.seed < 0:
            raise InputError(
                f"study: expected 1 to {self.most} initial guesses, per_radius and seed from 0 on, "
                f"got {self.initial_guesses}, {self.per_radius} and {self.seed}"
            )
        if not all(0 < r <= 1 for r in (self.radius, *self.radii)):
            got = f"{self.radius} and {list(self.radii)}"
            raise InputError(f"study: expected radii above 0 and at most 1, got {got}")
        if self.radius in self.radii:
            own = f"radius = {self.radius}, which has its own initial guesses"
            raise InputError(f"study: expected radii other than {own}, got {list(self.radii)}")
        self.require_different("radii", self.radii)
        self.require_different("strain_errors", self.strain_errors)

    def quick(self) -> Self:
        """A fifth of the initial guesses."""
        return replace(
            self, initial_guesses=-(-self.initial_guesses // 5), per_radius=-(-self.per_radius // 5)
        )

    def prepare(self, spec: ImagePairSpec, folder: Path, progress: Progress = silent) -> Cases:
        """Make the images; a case has a radius or a strain error, a number and a seed."""
        name = spec.describe(folder, self.strain)
        VirtualImagePair.open(folder, name, progress)
        base = {"images": name, "radius": self.radius, "start": 0, "strain_error": 0.0,
                "seed": self.seed}  # fmt: skip
        cases = [{**base, "start": k} for k in range(self.initial_guesses)]
        for radius in self.radii:
            cases += [{**base, "radius": radius, "start": k} for k in range(self.per_radius)]
        cases += [{**base, "radius": 0.0, "strain_error": e} for e in self.strain_errors]
        return tuple(cases)

    def analyse(self, table: pd.DataFrame, folder: Path) -> RobustnessAnalysis:
        """Success, epsilon and distances; failed cases count as not converged."""
        table = table.assign(same=table["distance_px"] < SAME_PX)
        moved = table[table["strain_error"] == 0.0]
        at_radius = moved[moved["radius"] == self.radius]
        strains = table[table["strain_error"] != 0.0]
        statistics = GuessStatistics.of(at_radius, self.radius)
        return RobustnessAnalysis(moved, at_radius, strains, statistics)


def one_start(case: Case, folder: Path) -> Row:
    """Correlate from one perturbed initial guess, and compare with the reference solution.

    ``distance_px``, ``start_distance_px``: rms length of the difference between the displacement of
    the solution, or of the guess, and the reference solution's [px]; ``epsilon_percent``: the
    paper's measure, the relative difference of their norms [%].
    """
    pair = VirtualImagePair.open(folder, case["images"])
    reference = _reference_solution(folder, case["images"])
    guess = _perturbed_guess(pair, case)
    result = pair.correlate(guess)
    found, size = _field(pair, result.unknowns), _rms(reference)
    return {
        "distance_px": _rms(found - reference),
        "start_distance_px": _rms(_field(pair, guess) - reference),
        "epsilon_percent": 100.0 * abs(size - _rms(found)) / size,
        **outcome_of(result),
        "all_iterations": len(result.history),
    }


def _perturbed_guess(pair: VirtualImagePair, case: Case) -> FloatArray:
    """(n,) initial guess of a case; the directions are the same for every radius."""
    ansatz, strain = pair.ansatz, pair.strain * (1.0 + case["strain_error"])
    guess = ansatz.initial_guess(strain, pair.options.start_amplitude)
    unit = np.random.default_rng([case["seed"], case["start"]]).uniform(-1.0, 1.0, 7)
    scale = np.array([1.0] * 5 + [pair.specimen.pitch] * 2)
    guess[ansatz.phi_slice(0)] += case["radius"] * unit * scale
    return guess


def _field(pair: VirtualImagePair, unknowns: FloatArray) -> FloatArray:
    """(points, 2) displacement at every EVERY-th pixel of the material [px]."""
    grid, mask = pair.images.grid, pair.mask
    u = pair.ansatz.displacement(unknowns, grid.x[::EVERY], grid.y[::EVERY])
    return np.asarray(u[mask[::EVERY, ::EVERY]] / grid.pixel_size)


def _rms(field: FloatArray) -> float:
    """Rms length of vectors (points, 2)."""
    return float(np.sqrt((field**2).sum(axis=-1).mean()))


@lru_cache(maxsize=1)
def _reference_solution(folder: Path, name: str) -> FloatArray:
    """(points, 2) displacement of the correlation from the standard guess [px]; cached."""
    pair = VirtualImagePair.open(folder, name)
    return _field(pair, pair.correlate().unknowns)
