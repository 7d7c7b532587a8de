"""Robustness study: convergence from perturbed initial guesses, and the basin around the solution."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.studies.study import (
    MOST,
    ImagePairSpec,
    VirtualImagePair,
    require_different,
    require_mode,
)
from modeharvest.validation.workers import Case


def success_numbers(asked: pd.DataFrame, radius: float) -> dict[str, Any]:
    """The paper's numbers and the honest ones, of the starts within one radius."""
    good, n = int(asked["same"].sum()), len(asked)
    epsilon, arrived = asked["epsilon_percent"].dropna(), asked["same"]
    outliers = epsilon > OUTLIER_PERCENT
    others = asked[~arrived & (asked["error"] == "")]
    return {
        "starts": n,
        "radius": radius,
        "same_minimum": good,
        "success": good / n,
        "success_interval_95": list(wilson(good, n)),
        "mean_epsilon_percent": float(epsilon.mean()),
        "largest_epsilon_percent": float(epsilon.max()),
        "mean_epsilon_without_outliers_percent": float(epsilon[~outliers].mean()),
        "outliers": int(outliers.sum()),
        "largest_distance_px": float(asked["distance_px"].max()),
        "largest_distance_of_arrived_px": float(asked.loc[arrived, "distance_px"].max()),
        "largest_start_distance_px": float(asked["start_distance_px"].max()),
        "elsewhere_but_called_converged": int((others["outcome"] == "converged").sum()),
        "failed": int((asked["error"] != "").sum()),
        "paper": PUBLISHED,
    }


def wilson(good: int, n: int) -> tuple[float, float]:
    """95 % confidence interval of a share, by Wilson's score.

    References
    ----------
    E. B. Wilson, J. Am. Stat. Assoc. 22 (1927), doi 10.1080/01621459.1927.10502953.
    """
    low, high = binomtest(good, n).proportion_ci(0.95, method="wilson")
    return float(low), float(high)


def by_radius(moved: pd.DataFrame) -> pd.DataFrame:
    """Success against the radius of the perturbations."""
    rows = []
    for radius, part in moved.groupby("radius"):
        good, n = int(part["same"].sum()), len(part)
        low, high = wilson(good, n)
        others = part[~part["same"]]
        told = int((others["outcome"] != "converged").sum())
        rows.append({
            "off by up to [%]": 100.0 * radius,
            "starts": n,
            "same minimum": good,
            "success [%]": 100.0 * good / n,
            "95 % from": 100.0 * low,
            "to [%]": 100.0 * high,
            "others recognised": f"{told} of {n - good}",
            "largest distance among the same [px]": part.loc[part["same"], "distance_px"].max(),
            "mean iterations": part["all_iterations"].mean(),
        })  # fmt: skip
    return pd.DataFrame(rows)


def other_minima(moved: pd.DataFrame) -> pd.DataFrame:
    """Each start that does not arrive; with the seed its number makes it again."""
    others = moved[~moved["same"]].sort_values(["radius", "start"])
    return pd.DataFrame({
        "off by up to [%]": 100.0 * others["radius"],
        "number of the start": others["start"],
        "distance of the start [px rms]": others["start_distance_px"].round(2),
        "distance of the end [px rms]": others["distance_px"].round(3),
        "ε [%]": others["epsilon_percent"].round(3),
        "outcome": others["outcome"].fillna("failed"),
        "iterations": others["all_iterations"],
    })  # fmt: skip


def by_strain(table: pd.DataFrame) -> pd.DataFrame:
    """Where starts with a wrong strain end; empty if there was none."""
    part = table[table["strain_error"] != 0.0]
    return pd.DataFrame({
        "strain of the start, off by [%]": 100.0 * part["strain_error"],
        "distance of the start [px]": part["start_distance_px"],
        "distance of the end [px]": part["distance_px"],
        "outcome": part["outcome"],
        "iterations": part["all_iterations"],
    })  # fmt: skip


SAME_PX = 0.01

OUTLIER_PERCENT = 1.5

PUBLISHED = {
    "success": 0.98,
    "mean_epsilon_percent": 0.86,
    "mean_epsilon_without_outliers_percent": 0.45,
}


EVERY = 4
"""Displacements are compared at every fourth pixel: they are smooth."""


@dataclass(frozen=True)
class RobustnessStudy:
    """Correlate from many starts.

    Parameters
    ----------
    strain
        Of the deformed image [-].
    starts, radius
        Number of starts whose mode parameters are perturbed by up to ``radius``: a share of 1 for
        a1 ... a5, of the unit cell for the two phases. The paper: 100 and 0.1.
    radii, per_radius
        For the basin: further radii, and starts for each.
    strain_errors
        And starts whose v0 has the applied strain times 1 plus these, with the mode as it is.
    seed
        Of the perturbations.

    Raises
    ------
    InputError
        If a value is out of its range, or one comes twice.
    """

    strain: float = 0.128
    starts: int = 100
    radius: float = 0.1
    radii: tuple[float, ...] = (0.05, 0.15, 0.2, 0.3, 0.4, 0.5)
    per_radius: int = 20
    strain_errors: tuple[float, ...] = (-1.0, -0.5, -0.2, 0.2, 0.5)
    seed: int = 0

    def __post_init__(self) -> None:
        if not (1 <= self.starts <= MOST and 0 <= self.per_radius <= MOST) or self.seed < 0:
            raise InputError(
                f"study: expected 1 to {MOST} starts, per_radius and seed of 0 or more, got "
                f"{self.starts}, {self.per_radius} and {self.seed}"
            )
        if not all(0 < r <= 1 for r in (self.radius, *self.radii)):
            raise InputError(
                f"study: expected radii above 0 and at most 1, got {self.radius} and "
                f"{list(self.radii)}"
            )
        if self.radius in self.radii:
            raise InputError(
                f"study: expected radii other than radius = {self.radius}, which has its own "
                f"starts, got {list(self.radii)}"
            )
        require_different("radii", self.radii)
        require_different("strain_errors", self.strain_errors)

    @property
    def question(self) -> str:
        """What is asked, for the report."""
        return (
            "A correlation searches from a start. Does it matter which? The same pair of virtual "
            "images is correlated from starts whose mode parameters are off, and their ends are "
            "compared with that of the standard start."
        )

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""
        return f"{__name__}:one_start"

    @property
    def seeds(self) -> str:
        """Of the perturbations."""
        return f"seed {self.seed} of the perturbations"

    def require(self, correlation: SquareLatticeOptions) -> None:
        """A mode that is held has no start."""
        require_mode(correlation)

    def quick(self) -> Self:
        """A fifth of the starts."""
        return replace(self, starts=-(-self.starts // 5), per_radius=-(-self.per_radius // 5))

    def prepare(
        self, subject: ImagePairSpec, folder: Path, progress: Progress = silent
    ) -> tuple[Case, ...]:
        """Make the images; the cases are radius, number of the start and seed."""
        name = subject.describe(folder, self.strain)
        VirtualImagePair.open(folder, name, progress)
        base = {"subject": name, "radius": self.radius, "start": 0, "strain_error": 0.0,
                "seed": self.seed}  # fmt: skip
        cases = [{**base, "start": k} for k in range(self.starts)]
        for radius in self.radii:
            cases += [{**base, "radius": radius, "start": k} for k in range(self.per_radius)]
        cases += [{**base, "radius": 0.0, "strain_error": e} for e in self.strain_errors]
        return tuple(cases)


def one_start(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Correlate from one perturbed start, and compare with the standard one's end.

    Parameters
    ----------
    case
        One of :meth:`Robustness.prepare`.
    folder
        Of the study.

    Returns
    -------
    dict
        ``distance_px``: rms length of the difference of the two displacements, the standard
        start's and this one's; ``start_distance_px``: the same of the start itself;
        ``epsilon_percent``: the paper's, the difference of their norms; outcome, iterations and
        residual.
    """
    scene = VirtualImagePair.open(folder, case["subject"])
    home = _reference_solution(folder, case["subject"])
    start = _perturbed_start(scene, case)
    result = scene.correlate(start)
    found = _field(scene, result.unknowns)
    size = _rms(home)
    return {
        "distance_px": _rms(found - home),
        "start_distance_px": _rms(_field(scene, start) - home),
        "epsilon_percent": 100.0 * abs(size - _rms(found)) / size,
        "outcome": result.outcome.value,
        "iterations": result.iterations,
        "all_iterations": len(result.history),
        "residual": result.residual_rms,
    }


def _perturbed_start(scene: VirtualImagePair, case: Mapping[str, Any]) -> FloatArray:
    """The start of a case; the same directions for every radius."""
    ansatz = scene.ansatz
    start = ansatz.initial_guess(
        scene.strain * (1.0 + case["strain_error"]), scene.how.start_amplitude
    )
    rng = np.random.default_rng([case["seed"], case["start"]])
    unit = rng.uniform(-1.0, 1.0, 7)
    scale = np.array([1.0] * 5 + [scene.specimen.pitch] * 2)
    start[ansatz.phi_slice(0)] += case["radius"] * unit * scale
    return start


def _field(scene: VirtualImagePair, unknowns: FloatArray) -> FloatArray:
    """(points, 2) displacement at some pixels of the material [px]."""
    grid = scene.images.grid
    u = scene.ansatz.displacement(unknowns, grid.x[::EVERY], grid.y[::EVERY])
    return np.asarray(u[scene.mask()[::EVERY, ::EVERY]] / grid.pixel_size)


def _rms(field: FloatArray) -> float:
    """Rms length of (points, 2) vectors."""
    return float(np.sqrt((field**2).sum(axis=-1).mean()))


@lru_cache(maxsize=1)
def _reference_solution(folder: Path, name: str) -> FloatArray:
    """(points, 2) displacement that the standard start ends with [px]; once in each worker."""
    scene = VirtualImagePair.open(folder, name)
    return _field(scene, scene.correlate().unknowns)
