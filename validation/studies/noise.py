"""Noise study: Monte Carlo of bias, scatter compared with its bounds, and coverage of error bars.

Noise scatters a measurement by more than the Cramér–Rao bound. The causes are added one by one. At
the solution, the gradient of the cost vanishes. Noise perturbs this gradient, with a covariance V,
and the unknowns change by the inverse of the cost's Hessian H: their covariance is H⁻¹VH⁻¹. With
noise s in both images, to first order in s:

===============  ================  ==========================================================
name             covariance / s²   effects included
===============  ================  ==========================================================
bound            2 M⁻¹             M = JᵀJ: no model error, no change of area
det F            M⁻¹ V₀ M⁻¹        also: where material has shrunk, pixels share the noise of g
curvature        H⁻¹ V₀ H⁻¹        also: the model error lowers the cost's curvature
least            H⁻¹ V H⁻¹         also: model error times the gradient of g's noise
===============  ================  ==========================================================

The last is the least covariance of least squares for weak noise. Strong noise is beyond first
order: the gradient of the noise in g is no longer small compared with the speckle's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import pandas as pd

from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.uncertainty.covariance import MatchedImages
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.campaign import grid
from modeharvest.validation.studies.noise_statistics import (
    COVARIANCES,
    HESSIAN_CORRECTED,
    PARTS,
    FieldPoints,
    NoiseAnalysis,
)
from modeharvest.validation.studies.study import (
    ImagePairSpec,
    Study,
    VirtualImagePair,
    noisy,
    outcome_of,
)
from modeharvest.validation.truth import rms
from modeharvest.validation.workers import Case, Cases, Row

EXAMPLES = 24
"""Noise realisations to estimate V; each contributes one sample per unit cell."""
_WEAK_NOISE = 0.01
"""Noise of these realisations [fraction of full scale]; only its linear effect is used."""


def zero_residual(images: MatchedImages) -> MatchedImages:
    """The same images with zero residual: f is replaced by the matched g."""
    pair = ImagePair(images.reference, images.deformed, images.result.grid)
    residual = images.result.residual(pair, images.result.order)
    f = np.where(images.used, images.reference - residual, images.reference).astype(np.float32)
    return replace(images, reference=f)


def covariances_by_cause(
    pair: VirtualImagePair, result: Result, seed: int
) -> dict[str, FloatArray]:
    """The (n, n) covariances of the unknowns for noise of 1 in both images, by ``COVARIANCES``.

    ``result``: of a pair of exact images; ``seed``: of the noise realisations. The diagonal is
    infinite for unknowns that the images don't determine.
    """
    matched, cell = pair.matched(result), pair.specimen.pitch
    lost = np.isinf(np.diag(result.inverse))
    at = np.ix_(~lost, ~lost)
    inverse, hessian = result.inverse[at], matched.inverse_hessian[at]
    M = np.linalg.inv(inverse)

    def perturbed(images: MatchedImages) -> FloatArray:
        """The gradient's covariance: M by noise in f, plus that of realisations of noise in g."""
        examples = _noise_of_g(images.reference, seed)
        by_g = images.noise_covariance(examples, cell, images.result.inverse) / _WEAK_NOISE**2
        return np.asarray(M + M @ by_g[at] @ M)

    V0, V = perturbed(zero_residual(matched)), perturbed(matched)
    known = {
        "bound": 2.0 * inverse,
        "det F": inverse @ V0 @ inverse,
        "curvature": hessian @ V0 @ hessian,
        "least": hessian @ V @ hessian,
        HESSIAN_CORRECTED: 2.0 * hessian @ M @ hessian,
    }
    found = {}
    for name, covariance in known.items():
        found[name] = np.diag(np.where(lost, np.inf, 0.0))
        found[name][at] = covariance
    return found


def _noise_of_g(like: FloatImage, seed: int) -> Iterator[tuple[FloatImage, FloatImage]]:
    """Realisations of noise in g alone, as pairs (noise of f, noise of g)."""
    rng = np.random.default_rng([seed, EXAMPLES])
    none = np.zeros_like(like)
    for _ in range(EXAMPLES):
        noise = rng.standard_normal(none.shape, dtype=np.float32)
        yield none, np.float32(_WEAK_NOISE) * noise


@dataclass(frozen=True)
class NoiseStudy(Study[NoiseAnalysis]):
    """Correlate a pair of images many times, each time with new white noise in both.

    InputError if a value is out of range, or a level occurs twice.
    """

    question: ClassVar[str] = (
        "A camera adds noise. What does it do to what is measured? The same pair of virtual "
        "images is correlated under many realisations of white noise; bias and scatter are set "
        "against the Cramér–Rao bound, and the error bars that each result predicts against its "
        "errors."
    )
    function: ClassVar[str] = f"{__name__}:one_realisation"

    strain: float = 0.128
    levels: tuple[float, ...] = (0.002, 0.005, 0.01, 0.02)
    """Standard deviations of the noise [fraction of full scale]; 0.01 is 2.6 of 255 levels."""
    pairs: int = 25
    """Number of pairs of realisations n and -n at each level."""
    seed: int = 0
    """Seed of the noise."""

    def __post_init__(self) -> None:
        if not self.levels or not all(0.0 < level < 1.0 for level in self.levels):
            wanted, levels = "levels above 0 and below 1 of full scale", list(self.levels)
            raise InputError(f"study: expected {wanted}, got {levels}")
        if not 2 <= self.pairs <= self.most or self.seed < 0:
            wanted, got = f"2 to {self.most} pairs", f"{self.pairs} and {self.seed}"
            raise InputError(f"study: expected {wanted} and a seed of 0 or more, got {got}")
        self.require_different("levels", self.levels)

    def require(self, correlation: SquareLatticeOptions) -> None:
        """Require exact images: noise is not added to rounded ones."""
        if correlation.camera:
            raise InputError(
                "study: expected correlation.camera = false, got true: the noise study adds its "
                "noise to the exact images"
            )

    def quick(self) -> Self:
        """A fifth of the realisations."""
        return replace(self, pairs=max(2, -(-self.pairs // 5)))

    def prepare(self, spec: ImagePairSpec, folder: Path, progress: Progress = silent) -> Cases:
        """Make the images; cases vary level, number, sign of the noise; the first has no noise."""
        name = spec.describe(folder, self.strain)
        VirtualImagePair.open(folder, name, progress)
        base = {"images": name, "level": 0.0, "pair": 0, "sign": 1, "seed": self.seed}
        return base, *grid(base, level=self.levels, pair=range(self.pairs), sign=(1, -1))

    def analyse(self, table: pd.DataFrame, folder: Path) -> NoiseAnalysis:
        """Errors and bounds; InputError without two complete pairs or the noise-free case."""
        return NoiseAnalysis.of(table, VirtualImagePair.open(folder, table["images"].iloc[0]))


def one_realisation(case: Case, folder: Path) -> Row:
    """Correlate with one realisation of the noise, from the standard initial guess.

    ``predicted``: standard deviations of the unknowns by the result's covariance for this noise,
    followed by those of the fields at :class:`FieldPoints`. Without noise, it is a list of them for
    each of ``COVARIANCES``, for noise of 1, and the row has errors as in
    :meth:`~modeharvest.validation.studies.study.VirtualImagePair.errors`. ``curvature_sd_mm``: rms
    over the points of u's standard deviation by the covariance H⁻¹ [mm], for the case without noise
    and the first realisation of each level.
    """
    virtual, level = VirtualImagePair.open(folder, case["images"]), float(case["level"])
    points, pair = FieldPoints.of(virtual), virtual.pair
    if level:
        rng = np.random.default_rng([case["seed"], case["pair"], round(1e9 * level)])
        pair = noisy(pair, level, rng, case["sign"])
    result = virtual.correlate(pair=pair)
    row = {**outcome_of(result), "unknowns": result.unknowns.tolist()}
    if level:
        row["predicted"] = _predicted(points, result, result.covariance(level))
    else:
        by_cause = covariances_by_cause(virtual, result, case["seed"])
        row["predicted"] = [_predicted(points, result, by_cause[name]) for name in COVARIANCES]
    if not level or (case["pair"] == 0 and case["sign"] == 1):
        hessian = virtual.matched(result, pair).inverse_hessian
        row["curvature_sd_mm"] = rms(points.predicted(result, hessian)[:, PARTS["u"]])
    return row if level else row | virtual.errors(result)


def _predicted(points: FieldPoints, result: Result, covariance: FloatArray) -> list[float]:
    """Standard deviations of the unknowns, and of the fields at the points, to five digits."""
    fields = points.predicted(result, covariance)
    both = np.concatenate([np.sqrt(np.diag(covariance)), fields.ravel()])
    return [float(f"{value:.5g}") for value in both]
