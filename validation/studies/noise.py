"""Noise study: Monte Carlo of bias, scatter against its bounds, and coverage of error bars.

Why noise scatters a measurement by more than the Cramér–Rao bound, one cause after another: a
measurement ends where the gradient of the cost vanishes. Noise perturbs that gradient, with a
covariance V, and the unknowns follow by the inverse of the cost's Hessian H: their covariance
is H⁻¹VH⁻¹. With noise s in both images, to first order in s:

===============  ================  ==========================================================
name             covariance / s²   what it takes into account
===============  ================  ==========================================================
bound            2 M⁻¹             M = JᵀJ: the ansatz describes everything, and nothing shrinks
det F            M⁻¹ V₀ M⁻¹        and where the material has shrunk, pixels share the noise of g
curvature        H⁻¹ V₀ H⁻¹        and the model error lowers the cost's curvature
least            H⁻¹ V H⁻¹         and the gradient of g's noise acts there, too
===============  ================  ==========================================================

The last is the least that least squares can do. Further up, noise is not weak any more: the
gradient of g's own noise is no longer small against the speckle's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.uncertainty.covariance import MatchedImages, field_errors
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.studies.study import (
    MOST,
    ImagePairSpec,
    Images,
    VirtualImagePair,
    error_parts,
    require_different,
)
from modeharvest.validation.workers import Case

PARTS = {"u": slice(0, 2), "v0": slice(2, 4), "v1": slice(4, 5), "v1 phi1": slice(5, 7)}
"""The fields by their names, and which of the seven components are theirs."""
PER_CELL = 3
"""Points along the edge of a unit cell: the errors are as smooth as the ansatz."""


@dataclass(frozen=True, eq=False)
class FieldPoints:
    """Where fields are compared.

    Parameters
    ----------
    scene
        Whose fields.
    rows, cols
        Axes of the coarse grid, in pixels of the images.
    inside
        (rows, cols) True on material; the points are those, row by row.
    """

    scene: VirtualImagePair
    rows: NDArray[np.intp]
    cols: NDArray[np.intp]
    inside: NDArray[np.bool_]

    @classmethod
    def of(cls, scene: VirtualImagePair) -> FieldPoints:
        """The points of a pair, the same in every worker."""
        grid, mask = scene.images.grid, scene.mask()
        step = max(1, round(scene.specimen.pitch / PER_CELL / grid.pixel_size))
        rows, cols = (np.arange((n % step) // 2, n, step) for n in grid.shape)
        return cls(scene, rows, cols, mask[np.ix_(rows, cols)])

    @property
    def x(self) -> FloatArray:
        """(points,) [mm]."""
        return np.asarray(self.scene.images.grid.x[self.cols[np.nonzero(self.inside)[1]]])

    @property
    def y(self) -> FloatArray:
        """(points,) [mm]."""
        return np.asarray(self.scene.images.grid.y[self.rows[np.nonzero(self.inside)[0]]])

    @property
    def cellular(self) -> NDArray[np.bool_]:
        """(points,) True in the part with holes: elsewhere v1 says little or nothing."""
        a, b = self.scene.specimen.cellular_half_size
        return np.asarray((np.abs(self.x) <= a) & (np.abs(self.y) <= b))

    def fields(self, unknowns: FloatArray) -> FloatArray:
        """(points, 7): u, v0 (2 each), v1, v1 phi1 (2) [mm], in the order of ``PARTS``."""
        ansatz, x, y = self.scene.ansatz, self.x[:, None], self.y[:, None]
        parts = (
            ansatz.displacement(unknowns, x, y),
            ansatz.v0(unknowns, x, y),
            ansatz.v(0, unknowns, x, y)[..., None],
            ansatz.fluctuation(0, unknowns, x, y),
        )
        return np.concatenate([part[:, 0] for part in parts], axis=-1)

    def map(self, values: FloatArray) -> FloatArray:
        """(rows, cols) of values at the points; NaN where there is no material."""
        drawn = np.full(self.inside.shape, np.nan)
        drawn[self.inside] = values
        return drawn


CAUSES = ("bound", "det F", "curvature", "least")
"""Each with all that stand before it."""
HESSIAN_CORRECTED = "softened"
"""2 H⁻¹MH⁻¹, the curvature only: the Hessian-corrected covariance of the error analysis."""
COVARIANCES = (*CAUSES, HESSIAN_CORRECTED)
EXAMPLES = 24
"""Of the noise, for V; each counts as many times as there are unit cells."""
_WEAK_NOISE = 0.01
"""Noise of the examples [fraction of full scale]; only its linear effect is taken."""


def matched_images(scene: VirtualImagePair, result: Result, images: Images) -> MatchedImages:
    """What a correlation of images of this scene compared at its end."""
    pair = ImagePair(*images, scene.images.grid, *scene.masks())
    return MatchedImages.of(result, pair, scene.how.edge_px)


def zero_residual(seen: MatchedImages) -> MatchedImages:
    """The same without a residual: f is what g says that it is."""
    pair = ImagePair(seen.reference, seen.deformed, seen.result.grid)
    left = seen.result.residual(pair, seen.result.order)
    f = np.where(seen.used, seen.reference - left, seen.reference).astype(np.float32)
    return replace(seen, reference=f)


def covariances_by_cause(
    scene: VirtualImagePair, result: Result, seed: int
) -> dict[str, FloatArray]:
    """The (n, n) covariances of the unknowns for noise of 1 in both images, by their causes.

    Parameters
    ----------
    scene, result
        A pair of exact images, and what was found of it.
    seed
        Of the examples of noise.

    Returns
    -------
    dict
        For each of ``CAUSES`` and ``SOFTENED``; infinite on the diagonal where the images say
        nothing.
    """
    seen, cell = matched_images(scene, result, scene.pair()), scene.specimen.pitch
    lost = np.isinf(np.diag(result.inverse))
    at = np.ix_(~lost, ~lost)
    inverse, corrected = result.inverse[at], seen.inverse_hessian[at]
    M = np.linalg.inv(inverse)
    # Noise in f pushes by s²M, noise in g by what its examples do.
    V0, V = (
        M + M @ _by_noise_of_g(images, cell, seed)[at] @ M for images in (zero_residual(seen), seen)
    )
    known = {
        "bound": 2.0 * inverse,
        "det F": inverse @ V0 @ inverse,
        "curvature": corrected @ V0 @ corrected,
        "least": corrected @ V @ corrected,
        HESSIAN_CORRECTED: 2.0 * corrected @ M @ corrected,
    }
    found = {}
    for name, covariance in known.items():
        found[name] = np.diag(np.where(lost, np.inf, 0.0))
        found[name][at] = covariance
    return found


def _by_noise_of_g(seen: MatchedImages, cell: float, seed: int) -> FloatArray:
    """(n, n) M⁻¹V_gM⁻¹ / s²: V_g by noise s in g alone, pushing every cell independently."""
    examples = _noise_examples(seen.reference, seed)
    found = seen.noise_covariance(examples, cell, seen.result.inverse)
    return np.asarray(found / _WEAK_NOISE**2, dtype=np.float64)


def _noise_examples(like: NDArray[np.float32], seed: int) -> Iterator[Images]:
    rng = np.random.default_rng([seed, EXAMPLES])
    none = np.zeros_like(like)
    for _ in range(EXAMPLES):
        noise = rng.standard_normal(none.shape, dtype=np.float32)
        yield none, np.float32(_WEAK_NOISE) * noise


@dataclass(frozen=True)
class NoiseStudy:
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

    def require(self, correlation: SquareLatticeOptions) -> None:
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
        self, subject: ImagePairSpec, folder: Path, progress: Progress = silent
    ) -> tuple[Case, ...]:
        """Make the images; the cases are level, number and sign of the noise, the first without."""
        name = subject.describe(folder, self.strain)
        VirtualImagePair.open(folder, name, progress)
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
        :class:`~modeharvest.validation.studies.noise.FieldPoints`. Without noise a list of
        them for each of the ``LADDER``, for noise of 1, and what the truth says. ``give_mm``, how
        far the displacement gives way by the cost's own curvature, without noise and in the first
        realisation of each level.
    """
    scene, level = VirtualImagePair.open(folder, case["subject"]), float(case["level"])
    images = _noisy(scene, case) if level else scene.pair()
    result = scene.correlate(pair=images)
    found = {
        "outcome": result.outcome.value,
        "iterations": result.iterations,
        "residual": result.residual_rms,
        "unknowns": result.unknowns.tolist(),
    }
    if not level:
        return found | error_parts(scene, result) | _without_noise(scene, result, case["seed"])
    if case["pair"] == 0 and case["sign"] == 1:
        found["give_mm"] = _curvature_sd(scene, result, images)
    return found | {"told": _predicted(scene, result, result.covariance(level))}


def _without_noise(scene: VirtualImagePair, result: Result, seed: int) -> dict[str, Any]:
    found = covariances_by_cause(scene, result, seed)
    return {
        "told": [_predicted(scene, result, found[name]) for name in COVARIANCES],
        "give_mm": _curvature_sd(scene, result, scene.pair()),
    }


def _curvature_sd(scene: VirtualImagePair, result: Result, images: Images) -> float:
    """Rms over the points of u's standard deviation by the covariance H⁻¹ [mm]."""
    corrected = matched_images(scene, result, images).inverse_hessian
    return float(np.sqrt((_predicted_fields(scene, result, corrected)[:, PARTS["u"]] ** 2).mean()))


def _noisy(scene: VirtualImagePair, case: Mapping[str, Any]) -> Images:
    f, g = scene.pair()
    rng = np.random.default_rng([case["seed"], case["pair"], round(1e9 * case["level"])])
    n_f, n_g = rng.normal(scale=case["level"], size=(2, *f.shape)).astype(np.float32)
    sign = np.float32(case["sign"])
    return f + sign * n_f, g + sign * n_g


def _predicted(scene: VirtualImagePair, result: Result, covariance: FloatArray) -> list[float]:
    """Standard deviations of the unknowns and of the fields, in the order of ``Points``.

    Five digits are enough, and a third of the file.
    """
    fields = _predicted_fields(scene, result, covariance)
    both = np.concatenate([np.sqrt(np.diag(covariance)), fields.ravel()])
    return [float(f"{value:.5g}") for value in both]


def _predicted_fields(
    scene: VirtualImagePair, result: Result, covariance: FloatArray
) -> FloatArray:
    """(points, 7)."""
    points = FieldPoints.of(scene)
    errors = field_errors(result, points.x[:, None], points.y[:, None], covariance)
    parts = (errors.displacement, errors.v0, errors.v[0][..., None], errors.fluctuation[0])
    return np.concatenate([part[:, 0] for part in parts], axis=-1)
