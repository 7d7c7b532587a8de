"""Does the start matter? Perturbed mode parameters, as in the paper, and the basin around them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import binomtest

from modeharvest.errors import InputError
from modeharvest.progress import Progress
from modeharvest.validation.campaign import Case
from modeharvest.validation.studies.study import Findings, Plot
from modeharvest.validation.studies.subject import Scene, Subject
from modeharvest.validation.style import BLUE, GOLD, GREEN, RED, figure, style

FloatArray = NDArray[np.float64]

EVERY = 4
"""Displacements are compared at every fourth pixel: they are smooth."""
SAME_PX = 0.01
"""Ends nearer than this, rms, are the same minimum [px]."""
PAPER = {
    "success": 0.98,
    "mean_epsilon_percent": 0.86,
    "mean_epsilon_without_outliers_percent": 0.45,
}
OUTLIER_PERCENT = 1.5
"""Above this epsilon the paper calls a result erroneous."""


@dataclass(frozen=True)
class Robustness:
    """Correlate from many starts.

    Parameters
    ----------
    strain
        Of the images [-].
    starts, radius
        Number of starts whose mode parameters are perturbed by up to ``radius``: a share of 1 for
        a1 ... a5, of the unit cell for the two phases. The paper: 100 and 0.1.
    radii, per_radius
        For the basin: further radii, and starts for each.
    strain_errors
        And starts whose v0 has the applied strain times 1 plus these, with the mode as it is.
    seed
        Of the perturbations.
    """

    strain: float = 0.128
    starts: int = 100
    radius: float = 0.1
    radii: tuple[float, ...] = (0.05, 0.15, 0.2, 0.3, 0.4, 0.5)
    per_radius: int = 20
    strain_errors: tuple[float, ...] = (-1.0, -0.5, -0.2, 0.2, 0.5)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.starts < 1 or self.per_radius < 0:
            raise InputError(
                f"study: expected starts >= 1 and per_radius >= 0, got {self.starts} and "
                f"{self.per_radius}"
            )
        if not all(0 < r <= 1 for r in (self.radius, *self.radii)):
            raise InputError(f"study: expected radii in (0, 1], got {self.radius}, {self.radii}")

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""
        return f"{__name__}:one_start"

    def prepare(self, subject: Subject, folder: Path, progress: Progress) -> tuple[Case, ...]:
        """Make the images; the cases are radius, number of the start and seed."""
        name = subject.images(self.strain, folder, progress=progress)
        base = {"images": name, "radius": self.radius, "start": 0, "strain_error": 0.0,
                "seed": self.seed}  # fmt: skip
        cases = [{**base, "start": k} for k in range(self.starts)]
        for radius in self.radii:
            cases += [{**base, "radius": radius, "start": k} for k in range(self.per_radius)]
        cases += [{**base, "radius": 0.0, "strain_error": e} for e in self.strain_errors]
        return tuple(cases)

    def findings(self, table: pd.DataFrame) -> Findings:
        """Success, epsilon and the honest distance, with the basin's picture."""
        ran = table[table["error"] == ""]
        asked = ran[(ran["radius"] == self.radius) & (ran["strain_error"] == 0.0)]
        numbers = _numbers(asked, self)
        return Findings(
            numbers=numbers,
            sentences=_sentences(numbers, asked, self),
            plots=(_histogram(asked, self), _basin(ran, self)),
            tables={"Basin of convergence": _by_radius(ran), "Start of v0": _by_strain(ran)},
        )


def one_start(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Correlate from one perturbed start, and compare with the standard one's end."""
    scene = Scene.open(folder, case["images"])
    result = scene.correlate(_perturbed(scene, case))
    home, size = _home(folder, case["images"])
    found = _field(scene, result.unknowns)
    norm = float(np.sqrt((found**2).sum(axis=-1).mean()))
    return {
        "distance_px": float(np.sqrt(((found - home) ** 2).sum(axis=-1).mean())),
        "epsilon_percent": 100.0 * abs(size - norm) / size,
        "outcome": result.outcome.value,
        "iterations": len(result.history),
        "residual": result.residual_rms,
    }


def _perturbed(scene: Scene, case: Mapping[str, Any]) -> FloatArray:
    ansatz = scene.ansatz
    start = scene.how.start(ansatz, scene.strain * (1.0 + case["strain_error"]))
    rng = np.random.default_rng([case["seed"], case["start"]])
    unit = rng.uniform(-1.0, 1.0, 7)
    scale = np.array([1.0] * 5 + [scene.specimen.pitch] * 2)
    start[ansatz.phi_slice(0)] += case["radius"] * unit * scale
    return start


def _field(scene: Scene, unknowns: FloatArray) -> FloatArray:
    """(points, 2) displacement at some pixels of the material [px]."""
    grid = scene.images.grid
    u = scene.ansatz.displacement(unknowns, grid.x[::EVERY], grid.y[::EVERY])
    return np.asarray(u[scene.mask()[::EVERY, ::EVERY]] / grid.pixel_size)


@lru_cache(maxsize=1)
def _home(folder: Path, name: str) -> tuple[FloatArray, float]:
    """Where the standard start ends, and the rms length of that displacement [px]."""
    scene = Scene.open(folder, name)
    field = _field(scene, scene.correlate().unknowns)
    return field, float(np.sqrt((field**2).sum(axis=-1).mean()))


def _same(table: pd.DataFrame) -> pd.Series:
    return table["distance_px"] < SAME_PX


def _numbers(asked: pd.DataFrame, study: Robustness) -> dict[str, Any]:
    good, n = int(_same(asked).sum()), len(asked)
    interval = binomtest(good, n).proportion_ci(0.95, method="wilson") if n else (np.nan, np.nan)
    epsilon = asked["epsilon_percent"]
    outliers = epsilon > OUTLIER_PERCENT
    trapped = asked[~_same(asked)]
    return {
        "starts": n,
        "radius": study.radius,
        "same_minimum": good,
        "success": good / n if n else float("nan"),
        "success_interval_95": [float(v) for v in interval],
        "mean_epsilon_percent": float(epsilon.mean()),
        "mean_epsilon_without_outliers_percent": float(epsilon[~outliers].mean()),
        "outliers": int(outliers.sum()),
        "largest_distance_px": float(asked["distance_px"].max()),
        "not_arrived_but_called_converged": int((trapped["outcome"] == "converged").sum()),
        "paper": PAPER,
    }


def _sentences(
    numbers: Mapping[str, Any], asked: pd.DataFrame, study: Robustness
) -> tuple[str, ...]:
    low, high = numbers["success_interval_95"]
    return (
        f"{numbers['same_minimum']} of {numbers['starts']} starts with mode parameters up to "
        f"{100 * study.radius:g} % off end in the standard start's minimum (within {SAME_PX} px "
        f"rms): {100 * numbers['success']:.1f} %, 95 % interval {100 * low:.1f} to "
        f"{100 * high:.1f} %. The paper: {100 * PAPER['success']:.0f} of 100.",
        f"The paper's epsilon, the relative difference of the displacement's norms, is "
        f"{numbers['mean_epsilon_percent']:.2g} % on average (the paper: "
        f"{PAPER['mean_epsilon_percent']} %); without outliers above {OUTLIER_PERCENT} % "
        f"{numbers['mean_epsilon_without_outliers_percent']:.2g} % "
        f"({PAPER['mean_epsilon_without_outliers_percent']} %).",
        "A difference of norms can vanish for fields that differ; the norm of the difference is "
        f"{numbers['largest_distance_px']:.2g} px rms at most.",
    )


def _by_radius(ran: pd.DataFrame) -> pd.DataFrame:
    moved = ran[ran["radius"] > 0]
    rows = []
    for radius, part in moved.groupby("radius"):
        good, n = int(_same(part).sum()), len(part)
        low, high = binomtest(good, n).proportion_ci(0.95, method="wilson")
        told = part.loc[~_same(part), "outcome"] != "converged"
        rows.append({
            "perturbed by up to [%]": 100 * radius, "starts": n, "same minimum": good,
            "success [%]": 100 * good / n, "95 % from": 100 * low, "to": 100 * high,
            "others recognised": f"{int(told.sum())} of {n - good}",
            "mean iterations": part["iterations"].mean(),
        })  # fmt: skip
    return pd.DataFrame(rows)


def _by_strain(ran: pd.DataFrame) -> pd.DataFrame:
    part = ran[ran["radius"] == 0]
    return pd.DataFrame({
        "strain of the start, off by [%]": 100 * part["strain_error"],
        "distance from the standard end [px rms]": part["distance_px"],
        "outcome": part["outcome"],
        "iterations": part["iterations"],
    })  # fmt: skip


def _histogram(asked: pd.DataFrame, study: Robustness) -> Plot:
    with style():
        drawn = figure(4.6, 2.6)
        axes = drawn.add_subplot()
        values = np.maximum(asked["distance_px"].to_numpy(), 1e-12)
        low, high = np.floor(np.log10(values.min())), np.ceil(np.log10(max(values.max(), 1.0)))
        axes.hist(values, bins=np.logspace(low, high, 40).tolist(), color=BLUE)
        axes.axvline(SAME_PX, color=GOLD, linestyle="--", linewidth=1)
        axes.set_xscale("log")
        axes.set_xlabel("distance from the standard start's displacement [px rms]")
        axes.set_ylabel("starts")
    caption = (
        f"{len(asked)} starts, up to {100 * study.radius:g} % off, seed {study.seed}. Dashed: "
        "nearer ends count as the same minimum."
    )
    return Plot("distances", "Where the starts end", drawn, caption)


def _basin(ran: pd.DataFrame, study: Robustness) -> Plot:
    rows = _by_radius(ran)
    with style():
        drawn = figure(4.6, 2.6)
        axes = drawn.add_subplot()
        x, y = rows["perturbed by up to [%]"], rows["success [%]"]
        spread = np.clip([y - rows["95 % from"], rows["to"] - y], 0.0, None)
        axes.errorbar(x, y, yerr=spread, color=GREEN, marker="o", markersize=3, capsize=2)
        axes.axhline(100 * PAPER["success"], color=RED, linestyle=":", linewidth=1)
        axes.set_ylim(0, 104)
        axes.set_xlabel("mode parameters off by up to [%]")
        axes.set_ylabel("same minimum [%]")
    caption = f"95 % intervals; seed {study.seed}. Dotted: the paper's 98 % at 10 %."
    return Plot("basin", "Basin of convergence", drawn, caption)
