"""What does noise do? Monte Carlo: bias, scatter against the bound, and whether error bars hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.idic.error_bars import field_errors
from modeharvest.idic.result import Result
from modeharvest.idic.setup import Identification
from modeharvest.progress import Progress, silent
from modeharvest.validation.campaign import Case
from modeharvest.validation.studies.against_truth import against_truth
from modeharvest.validation.studies.noise.causes import LADDER, compared, covariances
from modeharvest.validation.studies.noise.fields import PARTS, Points
from modeharvest.validation.studies.study import MOST, require_different
from modeharvest.validation.studies.subject import Images, Scene, Subject

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Noise:
    """Correlate a pair of images under white noise in both, many times.

    Parameters
    ----------
    strain
        Of the deformed image [-].
    levels
        Standard deviations of the noise [fraction of full scale]: 0.01 is 2.6 of 255 levels.
    pairs
        Realisations n at each level; each comes as -n, too.
    seed
        Of the noise.

    Raises
    ------
    InputError
        If a value is out of its range, or a level comes twice.
    """

    strain: float = 0.128
    levels: tuple[float, ...] = (0.002, 0.005, 0.01, 0.02)
    pairs: int = 25
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.levels or not all(0.0 < level < 1.0 for level in self.levels):
            raise InputError(
                f"study: expected levels above 0 and below 1 of full scale, got {list(self.levels)}"
            )
        if not 2 <= self.pairs <= MOST or self.seed < 0:
            raise InputError(
                f"study: expected 2 to {MOST} pairs and a seed of 0 or more, got "
                f"{self.pairs} and {self.seed}"
            )
        require_different("levels", self.levels)

    @property
    def question(self) -> str:
        """What is asked, for the report."""
        return (
            "A camera adds noise. What does it do to what is measured? The same pair of virtual "
            "images is correlated under many realisations of white noise; bias and scatter are "
            "set against the Cramér–Rao bound, and the error bars that each result tells of "
            "itself against its errors."
        )

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""
        return f"{__name__}:one_realisation"

    @property
    def seeds(self) -> str:
        """Of the noise."""
        return f"seed {self.seed} of the noise"

    def require(self, correlation: Identification) -> None:
        """Noise is added to exact images, not to rounded ones."""
        if correlation.camera:
            raise InputError(
                "study: expected correlation.camera = false, got true: the noise study adds its "
                "noise to the exact images"
            )

    def quick(self) -> Self:
        """A fifth of the realisations."""
        return replace(self, pairs=max(2, -(-self.pairs // 5)))

    def prepare(
        self, subject: Subject, folder: Path, progress: Progress = silent
    ) -> tuple[Case, ...]:
        """Make the images; the cases are level, number and sign of the noise, the first without."""
        name = subject.describe(folder, self.strain)
        Scene.open(folder, name, progress)
        base = {"subject": name, "level": 0.0, "pair": 0, "sign": 1, "seed": self.seed}
        noisy = [
            {**base, "level": level, "pair": pair, "sign": sign}
            for level in self.levels
            for pair in range(self.pairs)
            for sign in (1, -1)
        ]
        return (base, *noisy)


def one_realisation(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Correlate under one realisation of the noise, from the standard start.

    Parameters
    ----------
    case
        One of :meth:`Noise.prepare`.
    folder
        Of the study.

    Returns
    -------
    dict
        ``unknowns``; ``told``, their standard deviations by the result's own covariance given
        the noise, followed by those of the fields at
        :class:`~modeharvest.validation.studies.noise.fields.Points`. Without noise a list of
        them for each of the ``LADDER``, for noise of 1, and what the truth says. ``give_mm``, how
        far the displacement gives way by the cost's own curvature, without noise and in the first
        realisation of each level.
    """
    scene, level = Scene.open(folder, case["subject"]), float(case["level"])
    images = _noisy(scene, case) if level else scene.pair()
    result = scene.correlate(pair=images)
    found = {
        "outcome": result.outcome.value,
        "iterations": result.iterations,
        "residual": result.residual_rms,
        "unknowns": result.unknowns.tolist(),
    }
    if not level:
        return found | against_truth(scene, result) | _without_noise(scene, result, case["seed"])
    if case["pair"] == 0 and case["sign"] == 1:
        found["give_mm"] = _give(scene, result, images)
    return found | {"told": _told(scene, result, result.covariance(level))}


def _without_noise(scene: Scene, result: Result, seed: int) -> dict[str, Any]:
    found = covariances(scene, result, seed)
    return {
        "told": [_told(scene, result, found[name]) for name in LADDER],
        "give_mm": _give(scene, result, scene.pair()),
    }


def _give(scene: Scene, result: Result, images: Images) -> float:
    """Rms over the points of u's standard deviation by the covariance H⁻¹ [mm]."""
    soft = compared(scene, result, images).softness(result)
    return float(np.sqrt((_told_fields(scene, result, soft)[:, PARTS["u"]] ** 2).mean()))


def _noisy(scene: Scene, case: Mapping[str, Any]) -> Images:
    f, g = scene.pair()
    rng = np.random.default_rng([case["seed"], case["pair"], round(1e9 * case["level"])])
    n_f, n_g = rng.normal(scale=case["level"], size=(2, *f.shape)).astype(np.float32)
    sign = np.float32(case["sign"])
    return f + sign * n_f, g + sign * n_g


def _told(scene: Scene, result: Result, covariance: FloatArray) -> list[float]:
    """Standard deviations of the unknowns and of the fields, in the order of ``Points``.

    Five digits are enough, and a third of the file.
    """
    fields = _told_fields(scene, result, covariance)
    both = np.concatenate([np.sqrt(np.diag(covariance)), fields.ravel()])
    return [float(f"{value:.5g}") for value in both]


def _told_fields(scene: Scene, result: Result, covariance: FloatArray) -> FloatArray:
    """(points, 7)."""
    points = Points.of(scene)
    errors = field_errors(result, points.x[:, None], points.y[:, None], covariance)
    parts = (errors.displacement, errors.v0, errors.v[0][..., None], errors.fluctuation[0])
    return np.concatenate([part[:, 0] for part in parts], axis=-1)
