"""Does the start matter? Perturbed mode parameters, as in the paper, and the basin around them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.setup import Identification
from modeharvest.progress import Progress, silent
from modeharvest.validation.campaign import Case
from modeharvest.validation.studies.study import MOST, require_different, require_mode
from modeharvest.validation.studies.subject import Scene, Subject

FloatArray = NDArray[np.float64]

EVERY = 4
"""Displacements are compared at every fourth pixel: they are smooth."""


@dataclass(frozen=True)
class Robustness:
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

    def require(self, correlation: Identification) -> None:
        """A mode that is held has no start."""
        require_mode(correlation)

    def quick(self) -> Self:
        """A fifth of the starts."""
        return replace(self, starts=-(-self.starts // 5), per_radius=-(-self.per_radius // 5))

    def prepare(
        self, subject: Subject, folder: Path, progress: Progress = silent
    ) -> tuple[Case, ...]:
        """Make the images; the cases are radius, number of the start and seed."""
        name = subject.describe(folder, self.strain)
        Scene.open(folder, name, progress)
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
    scene = Scene.open(folder, case["subject"])
    home = _home(folder, case["subject"])
    start = _perturbed(scene, case)
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


def _perturbed(scene: Scene, case: Mapping[str, Any]) -> FloatArray:
    """The start of a case; the same directions for every radius."""
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


def _rms(field: FloatArray) -> float:
    """Rms length of (points, 2) vectors."""
    return float(np.sqrt((field**2).sum(axis=-1).mean()))


@lru_cache(maxsize=1)
def _home(folder: Path, name: str) -> FloatArray:
    """(points, 2) displacement that the standard start ends with [px]; once in each worker."""
    scene = Scene.open(folder, name)
    return _field(scene, scene.correlate().unknowns)
