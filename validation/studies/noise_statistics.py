"""Statistics of a noise study: fields at points, paired realisations, bounds, coverage.

Realisations come in pairs, n and -n. The mean of a pair's two errors is of second order in the
noise, so that a bias is detected even if it is much smaller than the scatter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.idic.result import Result
from modeharvest.idic.uncertainty.covariance import field_errors
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.validation.studies.study import VirtualImagePair

PARTS = {"u": slice(0, 2), "v0": slice(2, 4), "v1": slice(4, 5), "v1 phi1": slice(5, 7)}
"""Names of the fields, and their components among the seven."""
PER_CELL = 3
"""Points along the edge of a unit cell; enough, as the errors are as smooth as the ansatz."""


@dataclass(frozen=True, eq=False)
class FieldPoints:
    """Points of an image pair at which fields are compared."""

    pair: VirtualImagePair
    rows: NDArray[np.intp]
    cols: NDArray[np.intp]
    """Pixel rows and columns of the coarse grid."""
    inside: BoolArray
    """(rows, cols) True on material, in the coarse grid; these are the points, row by row."""
    x: FloatArray
    y: FloatArray
    """(points,) positions [mm]."""

    @classmethod
    def of(cls, pair: VirtualImagePair) -> FieldPoints:
        """The points of a pair; the same in every worker."""
        grid = pair.images.grid
        step = max(1, round(pair.specimen.pitch / PER_CELL / grid.pixel_size))
        rows, cols = (np.arange((n % step) // 2, n, step) for n in grid.shape)
        inside = pair.mask[np.ix_(rows, cols)]
        row, col = np.nonzero(inside)
        return cls(pair, rows, cols, inside, grid.x[cols[col]], grid.y[rows[row]])

    @property
    def cellular(self) -> BoolArray:
        """(points,) True in the cellular part; elsewhere v1 has little or no effect."""
        a, b = self.pair.specimen.cellular_half_size
        return np.asarray((np.abs(self.x) <= a) & (np.abs(self.y) <= b))

    def fields(self, unknowns: FloatArray) -> FloatArray:
        """(points, 7): u, v0 (2 each), v1, v1 phi1 (2) [mm], in the order of ``PARTS``."""
        ansatz, x, y = self.pair.ansatz, self.x[:, None], self.y[:, None]
        u, v0 = ansatz.displacement(unknowns, x, y), ansatz.v0(unknowns, x, y)
        v1, v1phi1 = ansatz.v(0, unknowns, x, y), ansatz.fluctuation(0, unknowns, x, y)
        return np.concatenate([u, v0, v1[..., None], v1phi1], axis=-1)[:, 0]

    def predicted(self, result: Result, covariance: FloatArray) -> FloatArray:
        """(points, 7) standard deviations of :meth:`fields` by a covariance of the unknowns."""
        sd = field_errors(result, self.x[:, None], self.y[:, None], covariance)
        parts = [sd.displacement, sd.v0, sd.v[0][..., None], sd.fluctuation[0]]
        return np.asarray(np.concatenate(parts, axis=-1)[:, 0])

    def map(self, values: FloatArray) -> FloatArray:
        """(rows, cols) map of values (points,) on the coarse grid; NaN without material."""
        drawn = np.full(self.inside.shape, np.nan)
        drawn[self.inside] = values
        return drawn


CAUSES = ("bound", "det F", "curvature", "least")
"""Names of covariances; each includes the effects of all before it, see ``noise``."""
HESSIAN_CORRECTED = "hessian"
"""Name of 2 H⁻¹MH⁻¹, see :func:`~modeharvest.idic.uncertainty.covariance.covariance`."""
COVARIANCES = (*CAUSES, HESSIAN_CORRECTED)
_NORMAL_95 = 1.959964
"""Half the width of a 95 % interval [standard deviations]."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A number and its standard error."""

    value: float
    error: float

    def __str__(self) -> str:
        return f"{self.value:.3f} ± {self.error:.3f}".replace("-", "−")


@dataclass(frozen=True, eq=False)
class PairedErrors:
    """Errors of several quantities under pairs of noise realisations."""

    errors: FloatArray
    predicted: FloatArray
    """(pairs, 2, ...) errors for the realisations n and -n, in any unit, and the standard
    deviations that each result predicts."""
    bound: FloatArray
    """(...) lower bound of the standard deviation; quantities unaffected by noise (a mode outside
    its support) have 0 and are ignored in the statistics."""

    @property
    def counted(self) -> BoolArray:
        """(...) True for quantities affected by noise."""
        return np.asarray(self.bound > 0.0)

    @property
    def standardised(self) -> PairedErrors:
        """The counted quantities divided by their bounds, flat, so that all have equal weight."""
        kept = self.of(self.counted)
        scaled = kept.errors / kept.bound, kept.predicted / kept.bound
        return PairedErrors(*scaled, np.ones_like(kept.bound))

    def of(self, part: BoolArray) -> PairedErrors:
        """The quantities for which ``part``, of the bound's shape, is True."""
        return PairedErrors(self.errors[:, :, part], self.predicted[:, :, part], self.bound[part])

    def against(self, factor: FloatArray) -> PairedErrors:
        """The same errors, with bounds and predicted values multiplied by ``factor`` (...)."""
        return PairedErrors(self.errors, factor * self.predicted, factor * self.bound)

    @property
    def ratios(self) -> FloatArray:
        """(...) rms error over bound of each quantity [-]; NaN for ignored quantities."""
        return self._over_bound(np.sqrt((self.errors**2).mean(axis=(0, 1))))

    @property
    def biases(self) -> FloatArray:
        """(...) mean error over bound of each quantity [-]; NaN for ignored quantities."""
        return self._over_bound(self.errors.mean(axis=(0, 1)))

    @property
    def covered(self) -> FloatArray:
        """(...) share of 95 % intervals that contain the truth [-]; NaN for ignored quantities."""
        return np.asarray(np.where(self.counted, self._inside.mean(axis=(0, 1)), np.nan))

    @property
    def rms_bound(self) -> float:
        """Rms of the bound over the counted quantities, as in all the following numbers."""
        return float(np.sqrt((self.bound[self.counted] ** 2).mean()))

    @property
    def ratio(self) -> Estimate:
        """Rms error over rms bound [-]."""
        squares = (self.of(self.counted).errors ** 2).mean(axis=(1, 2))
        value = float(np.sqrt(squares.mean()) / self.rms_bound)
        scatter = float(squares.std(ddof=1) / squares.mean() / np.sqrt(len(squares)))
        return Estimate(value, 0.5 * value * scatter)

    @property
    def bias(self) -> Estimate:
        """Rms of the mean error, corrected for its scatter, over rms bound [-]."""
        even, count = self.of(self.counted).errors.mean(axis=1), len(self.errors)
        mean_square = float((even.mean(axis=0) ** 2).mean())
        scatter = float((even.var(axis=0, ddof=1) / count).mean())
        bias = np.sqrt(max(0.0, mean_square - scatter))
        return Estimate(float(bias / self.rms_bound), float(np.sqrt(scatter) / self.rms_bound))

    @property
    def coverage(self) -> Estimate:
        """Share of the 95 % intervals that contain the truth [-]."""
        shares = self._inside[:, :, self.counted].mean(axis=(1, 2))
        return Estimate(float(shares.mean()), float(shares.std(ddof=1) / np.sqrt(len(shares))))

    def _over_bound(self, values: FloatArray) -> FloatArray:
        return _divided(values, self.bound, self.counted, np.nan)

    @property
    def _inside(self) -> FloatArray:
        return np.asarray(np.abs(self.errors) < _NORMAL_95 * self.predicted, dtype=np.float64)


def _divided(a: FloatArray, by: FloatArray, where: BoolArray, otherwise: float) -> FloatArray:
    """(...) a / by where ``where`` is True, elsewhere ``otherwise``."""
    return np.asarray(np.divide(a, by, out=np.full(a.shape, otherwise), where=where))


Levels = Mapping[float, Mapping[str, PairedErrors]]
"""For each noise level, in order, the errors of the "unknowns" and of the fields."""


def by_field(unknowns: FloatArray, fields: FloatArray) -> dict[str, FloatArray]:
    """Standard deviations, or errors, by name: "unknowns" and the fields.

    ``unknowns``: (..., n), each in its own unit; ``fields``: (..., points, 7) [mm], see ``PARTS``.
    """
    return {"unknowns": unknowns, **{name: fields[..., part] for name, part in PARTS.items()}}


def _predictions(flat: FloatArray, n: int) -> dict[str, FloatArray]:
    """Standard deviations by name, from the cases' flat form (..., n + 7 points)."""
    fields = flat[..., n:]
    return by_field(flat[..., :n], fields.reshape(*fields.shape[:-1], -1, 7))


def _read_level(
    part: pd.DataFrame, true: FloatArray, bound: Mapping[str, FloatArray], points: FieldPoints
) -> dict[str, PairedErrors]:
    """Errors of a level's complete pairs of realisations.

    ``true``: (n,) unknowns without noise; ``bound``: standard deviations; 0 or infinite for ignored
    quantities, which noise does not affect or the images do not determine.
    """
    by_pair = [pair.sort_values("sign") for _, pair in part.groupby("pair") if len(pair) == 2]

    def column(name: str) -> FloatArray:
        return np.array([[np.array(v, dtype=np.float64) for v in pair[name]] for pair in by_pair])

    a = column("unknowns")
    fields = np.array([[points.fields(one) for one in pair] for pair in a]) - points.fields(true)
    predicted, found = _predictions(column("predicted"), len(true)), {}
    for name, off in by_field(a - true, fields).items():
        known = np.isfinite(bound[name])
        found[name] = PairedErrors(
            np.where(known, off, 0.0), predicted[name], np.where(known, bound[name], 0.0)
        )
    return found


def _against(
    levels: Levels, bound: Mapping[str, FloatArray], sd: Mapping[str, FloatArray]
) -> Levels:
    """Compare the errors with other standard deviations than the bound's."""
    factors = {
        name: _divided(sd[name], part, np.isfinite(part) & (part > 0.0), 1.0)
        for name, part in bound.items()
    }
    return {
        level: {name: pairs.against(factors[name]) for name, pairs in parts.items()}
        for level, parts in levels.items()
    }


@dataclass(frozen=True, eq=False)
class NoiseAnalysis:
    """Evaluation of the table of a noise study."""

    points: FieldPoints
    noise_free: pd.Series
    """The row of the case without noise; all errors are relative to its unknowns."""
    predicted: Mapping[str, Mapping[str, FloatArray]]
    """Standard deviations for noise of 1 by each of ``COVARIANCES``, see :func:`by_field`."""
    against: Mapping[str, Levels]
    """The errors compared with each of them, and the corresponding error bars."""
    curvature_sd_ratio: Mapping[float, float]
    """By level, u's standard deviation by the curvature of noisy images over that of exact ones."""
    not_converged: int

    @classmethod
    def of(cls, table: pd.DataFrame, pair: VirtualImagePair) -> NoiseAnalysis:
        """From the table of all realisations of a pair.

        InputError if the case without noise failed, or no level has two complete pairs.
        """
        points, done = FieldPoints.of(pair), table[table["error"] == ""]
        noise_free = done[done["level"] == 0.0]
        if not len(noise_free):
            raise InputError("study: expected the case without noise to succeed, got none that did")
        row = noise_free.iloc[0]
        true = np.array(row["unknowns"])
        predicted = {
            cause: _predictions(np.array(flat, dtype=np.float64), len(true))
            for cause, flat in zip(COVARIANCES, row["predicted"], strict=True)
        }
        least = dict(predicted["bound"])
        least["v1"] = np.where(points.cellular[:, None], least["v1"], 0.0)  # phi1 tapers off there
        levels = {
            float(level): _read_level(part, true, {k: level * v for k, v in least.items()}, points)
            for level, part in done[done["level"] > 0.0].groupby("level")
            if (part["pair"].value_counts() == 2).sum() >= 2
        }
        if not levels:
            wanted = "two whole pairs of realisations at a level"
            raise InputError(f"study: expected {wanted}, got fewer")
        sd = done[done["curvature_sd_mm"].notna()].set_index("level")["curvature_sd_mm"]
        ratios = {float(level): float(sd[level] / sd[0.0]) for level in sd.index if level}
        lost = int((done["outcome"] != "converged").sum())
        against = {c: _against(levels, predicted["bound"], sd) for c, sd in predicted.items()}
        return cls(points, row, predicted, against, ratios, lost)
