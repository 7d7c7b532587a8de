"""The result of a correlation: unknowns, covariance, fields on demand, outcome; written as JSON.

In the file, null stands for infinity or for NaN.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.idic.ansatz import Ansatz, ansatz_from_dict
from modeharvest.idic.solver.final_smoothing import FinalSmoothing
from modeharvest.idic.solver.gauss_newton import Iteration, Outcome
from modeharvest.idic.solver.noise import ImageNoise, NoiseTransfer
from modeharvest.idic.solver.residual_test import LAGS_PX, ResidualTest
from modeharvest.idic.solver.weighting import Gradient, Weighting
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_record, reading, write_json
from modeharvest.util.typed import to_plain

FORMAT = "modeharvest-result-5"

_BAND = 64
"""Rows that are warped back at a time, so that little memory is needed."""
_MOST_NOISE = 0.8
"""Largest share of a mean square slope that is attributed to noise: where noise is all there is,
the estimate of the speckle's own slope would be zero."""


@dataclass(frozen=True, eq=False)
class Covariance:
    """The (n, n) covariances of a result's unknowns, by cause."""

    by_noise: FloatArray
    """Due to the images' noise."""
    by_model_error: FloatArray | None
    """Due to model error, by the residual of each cell; None where there are too few cells."""
    warnings: tuple[str, ...] = ()
    """Why a covariance is missing, one sentence each."""


@dataclass(frozen=True, eq=False)
class Result:
    """The unknowns with their covariance, and an account of the iteration."""

    ansatz: Ansatz
    """The kinematics."""
    grid: PixelGrid
    """Pixel grid of the full-resolution images."""
    unknowns: FloatArray
    """(n,): a, in the order of ``ansatz.names``."""
    inverse: FloatArray
    """(n, n) covariance of the unknowns if the residual is white noise of variance 1. Least
    squares: M^-1 with the Gauss-Newton matrix M = J'J. With other weights h in place of J: (h'J)^-1
    h'h (J'h)^-1. Infinite on the diagonal for unknowns that couldn't be determined."""
    residual_rms: float
    """Root mean square of the residual over the pixels used: grey levels, or mm per component for a
    fit to a displacement."""
    pixels: int
    outside_image: int
    """Pixels used, and pixels mapped outside the deformed image. A fit to a displacement counts
    each pixel twice, once for each component."""
    outcome: Outcome
    """Why the iteration ended, on the finest level."""
    condition_number: float
    """Condition number of the column-scaled Gauss-Newton matrix."""
    history: tuple[Iteration, ...] = ()
    """Every iteration of every level."""
    residual_correlation: float = float("nan")
    """Rms autocorrelation of the residual [-]: near 0 for noise; NaN for a fit to a displacement.
    See :meth:`residual_test`."""
    decorrelated_fraction: float = float("nan")
    """Fraction of the image where f and g(x + u) are decorrelated [-]; above 0.1 the outcome is
    LOCAL_MINIMUM. NaN for a fit to a displacement."""
    residual_lags_px: tuple[int, ...] = LAGS_PX
    """Lags at which the residual's autocorrelation was taken [px]."""
    weighting: Weighting = field(default_factory=Weighting)
    """Which gradient weighed the residual."""
    slope_square: float = 0.0
    weight_square: float = 0.0
    """Mean squares, per axis, of the deformed image's gradient and of the gradient that weighed the
    residual; both include noise [grey levels^2/px^2]."""
    noise_transfer: NoiseTransfer = field(default_factory=NoiseTransfer)
    """How much of the deformed image's noise reaches the residual."""
    order: int = 5
    """Order of the spline that sampled the deformed image."""
    final_smoothing: FinalSmoothing | None = None
    """Smoothing of the images on the finest level; None where none was specified or chosen."""
    errors: Covariance | None = None
    """Covariances by cause, if computed, as by a harvest; :meth:`covariance` is of noise alone."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "unknowns", self.ansatz.checked(self.unknowns))
        inverse, n = np.asarray(self.inverse, dtype=np.float64), self.ansatz.size
        if inverse.shape != (n, n):
            raise InputError(f"expected an inverse of shape ({n}, {n}), got {inverse.shape}")
        object.__setattr__(self, "inverse", inverse)
        for array in (self.unknowns, self.inverse):
            array.setflags(write=False)

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each unknown."""
        return self.ansatz.names

    @property
    def iterations(self) -> int:
        """Iterations on the finest level."""
        finest = min((step.factor for step in self.history), default=1)
        return sum(step.factor == finest for step in self.history)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Names of the unknowns that the images don't determine."""
        lost = np.isinf(np.diag(self.inverse))
        return tuple(name for name, is_lost in zip(self.names, lost, strict=True) if is_lost)

    @property
    def model_error_px(self) -> float:
        """Estimated model error: residual over gradient, rms per component [px of :attr:`grid`]."""
        gradient = np.sqrt(2.0 * self.slope_square)
        return float(self.residual_rms / gradient) if gradient else np.inf

    @property
    def noise_sd(self) -> float:
        """Standard deviation of each image's noise if the residual is only noise [grey levels].

        An upper bound, because the residual also contains what the ansatz can't describe. The
        estimate accounts for the part of g's noise that the spline smooths away.
        """
        freedom = max(1, self.pixels - self.ansatz.size)
        both = 1.0 + self.noise_transfer.value
        return float(self.residual_rms * np.sqrt(max(1, self.pixels) / freedom / both))

    @property
    def noise_to_slope(self) -> float:
        """:attr:`noise_sd` squared over the mean square of the noise-free speckle slope [px^2]."""
        if self.slope_square <= 0.0:
            return 0.0
        variance = self.noise_sd**2
        share = min(variance * self.noise_transfer.slope / self.slope_square, _MOST_NOISE)
        return variance / (self.slope_square * (1.0 - share))

    def covariance(self, noise: ImageNoise | float | None = None) -> FloatArray:
        """(n, n) covariance of the unknowns under white noise: for weak noise the Cramer-Rao bound.

        ``noise``: of the images, or one standard deviation for both [grey levels]; by default
        :attr:`noise_sd` in both, which attributes the whole residual to noise.

        It is :attr:`inverse` times s_f^2 + s_g^2/det F, with the mean of 1/det F over the pixels,
        and with two corrections of higher order for noise in the gradient. First, the noise of an
        image is uncorrelated with its own slope at the same pixel and anticorrelated elsewhere,
        which takes back the scatter that this slope seems to cause. Second, J'J contains the slope
        of g's noise; with least squares, where J'J is the matrix, that part is removed. If no noise
        is given, the corrections are applied only where the residual is noise.
        """
        known = ImageNoise.of(self.noise_sd if noise is None else noise)
        in_f = known.reference**2
        in_g = known.deformed**2 * self.noise_transfer.density
        variance = in_f + in_g
        is_noise = noise is not None or self.residual_test().is_white
        if variance > 0.0 and is_noise and np.isfinite(self.residual_correlation):
            share = self.noise_in_slope(known)
            own = in_f if self.weighting.gradient is Gradient.REFERENCE else in_g
            variance -= share * own
            if self.weighting.is_least_squares:
                variance /= (1.0 - share) ** 2
        return np.asarray(variance * self.inverse)

    def noise_in_slope(self, noise: ImageNoise) -> float:
        """Share of :attr:`weight_square` that is due to noise [-]."""
        if self.weight_square <= 0.0:
            return 0.0
        weighting = self.weighting
        slope = weighting.slope_noise(self.order)
        if weighting.gradient is Gradient.REFERENCE:
            made = noise.reference**2 * slope
        elif not weighting.is_least_squares:
            made = noise.deformed**2 * slope
        else:
            made = noise.deformed**2 * self.noise_transfer.slope
        return min(made / self.weight_square, _MOST_NOISE)

    def residual_noise(self, noise: ImageNoise | float) -> float:
        """Standard deviation of the residual due to noise in the images [grey levels]."""
        known = ImageNoise.of(noise)
        in_g = self.noise_transfer.value * known.deformed**2
        return float(np.sqrt(known.reference**2 + in_g))

    def residual_test(self, noise: ImageNoise | float | None = None) -> ResidualTest:
        """Test whether the residual is noise, as the standard errors assume.

        Given the images' noise, or one standard deviation for both [grey levels], also chi squared.
        """
        return ResidualTest.of(
            self.residual_rms, self.residual_correlation, self.pixels, self.ansatz.size, None if
            noise is None else self.residual_noise(noise), self.residual_lags_px,
        )  # fmt: skip

    def standard_errors(self, noise: ImageNoise | float | None = None) -> FloatArray:
        """(n,): square roots of the diagonal of :meth:`covariance`."""
        return np.sqrt(np.diag(self.covariance(noise)))

    def mode_parameters(self, i: int = 0) -> FloatArray:
        """(m,): the parameters of the mode number i (from 0)."""
        return self.unknowns[self.ansatz.phi_slice(i)]

    def displacement(self, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2): u [mm] at the pixels of ``grid``, by default those of the images."""
        return self.ansatz.displacement(self.unknowns, *_axes(grid or self.grid))

    def v0(self, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2): the slow field [mm]."""
        return self.ansatz.v0(self.unknowns, *_axes(grid or self.grid))

    def v(self, i: int = 0, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols): the amplitude of the mode number i (from 0) [mm]."""
        return self.ansatz.v(i, self.unknowns, *_axes(grid or self.grid))

    def phi(self, i: int = 0, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2): the mode number i (from 0) [-]."""
        return self.ansatz.phi(i, self.unknowns, *_axes(grid or self.grid))

    def fluctuation(self, i: int = 0, grid: PixelGrid | None = None) -> FloatArray:
        """(rows, cols, 2): v_i phi_i of the mode number i (from 0) [mm]."""
        return self.ansatz.fluctuation(i, self.unknowns, *_axes(grid or self.grid))

    def residual(self, pair: ImagePair, order: int = 5) -> FloatArray:
        """(rows, cols): f - g(x + u) [grey levels] in the reference frame; NaN outside the image.

        The pair must be on :attr:`grid`; gain and offset are applied to g if they were unknowns.
        ``order`` is that of the spline.
        """
        if pair.grid.shape != self.grid.shape:
            raise InputError(f"expected images of {self.grid.shape} px, got {pair.grid.shape}")
        bands = self.warped_back(SplineImage.of(pair.deformed, order))
        return np.asarray(pair.reference - np.vstack(list(bands)))

    def warped_back(
        self, deformed: SplineImage, known: FloatArray | None = None
    ) -> Iterator[FloatArray]:
        """(1 + b) g(x + u) + c in the reference frame, a band of rows at a time; NaN outside g.

        ``known``: (rows, cols, 2) u [mm] used instead of the ansatz' own; NaN where unknown.
        """
        grid, row, col = self.grid, np.arange(self.grid.rows)[:, None], np.arange(self.grid.cols)
        for first in range(0, grid.rows, _BAND):
            band = slice(first, first + _BAND)
            if known is None:
                u = self.ansatz.displacement(self.unknowns, grid.x, grid.y[band]) / grid.pixel_size
            else:
                u = np.nan_to_num(known[band] / grid.pixel_size, nan=1e6)  # off any image
            value, _, _ = deformed.sample(row[band] - u[..., 1], col + u[..., 0])
            gain, offset = self.ansatz.gain_and_offset(self.unknowns, grid.x, grid.y[band])
            yield gain * value + offset

    def write(self, path: Path | str) -> None:
        """Write JSON, atomically; reading it gives every number exactly."""
        write_json(path, {"format": FORMAT, **result_to_dict(self)})

    @classmethod
    def read(cls, path: Path | str) -> Result:
        """Read what :meth:`write` wrote; InputError for a missing, truncated or foreign file."""
        what, remedy = f"a complete {FORMAT} file", "correlate again"
        with reading(path, what, remedy):
            return cls(**result_fields(read_record(path, FORMAT, what, remedy)))


def determined_part(matrix: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return a covariance with zeros for undetermined unknowns, and (n,) which ones those are."""
    lost = np.isinf(np.diag(matrix))
    return np.where(lost[:, None] | lost[None, :], 0.0, matrix), lost


def _axes(grid: PixelGrid) -> tuple[FloatArray, FloatArray]:
    return grid.x, grid.y


def result_to_dict(result: Result) -> dict[str, Any]:
    """Convert a result to plain JSON values, with explanations in words."""
    content: dict[str, Any] = {name: to_plain(getattr(result, name)) for name in _STORED}
    weighting = result.weighting
    content["weighting"] |= {"gradient": weighting.gradient.value, "explanation": weighting.text}
    return content | {
        "outcome": result.outcome.value,
        "explanation": result.outcome.explanation,
        "unknowns": dict(zip(result.names, map(float, result.unknowns), strict=True)),
        "units": list(result.ansatz.units),
    }


def result_fields(content: Mapping[str, Any]) -> dict[str, Any]:
    """Make the arguments of :class:`Result` from what :func:`result_to_dict` returned."""
    content = {"errors": None, **content}  # missing in older files
    numbers = {name: _or(np.nan if name in _UNKNOWN else np.inf, content[name]) for name in _STORED}
    how, smoothing, errors = (content[k] for k in ("weighting", "final_smoothing", "errors"))
    size_px, is_low_pass = _or(np.inf, how["speckle_size_px"]), bool(how.get("low_pass"))
    steps = ({k: _or(np.inf, v) for k, v in step.items()} for step in content["history"])
    return numbers | {
        "ansatz": ansatz_from_dict(content["ansatz"]),
        "grid": PixelGrid(**content["grid"]),
        "unknowns": np.array(list(content["unknowns"].values())),
        "inverse": _matrix(content["inverse"]),
        "outcome": Outcome(content["outcome"]),
        "history": tuple(Iteration(**step) for step in steps),
        "residual_lags_px": tuple(content["residual_lags_px"]),
        "noise_transfer": NoiseTransfer(**content["noise_transfer"]),
        "weighting": Weighting(Gradient(how["gradient"]), how["blur_px"], size_px, is_low_pass),
        "final_smoothing": smoothing
        and FinalSmoothing(**{k: _or(np.nan, v) for k, v in smoothing.items()}),
        "errors": errors and Covariance(
            _matrix(errors["by_noise"]), _matrix(errors["by_model_error"]),
            tuple(errors["warnings"]),
        ),
    }  # fmt: skip


def _matrix(rows: list[list[float | None]] | None) -> Any:
    return rows and np.array([[_or(np.inf, v) for v in row] for row in rows])


_STORED = tuple(f.name for f in fields(Result))
_UNKNOWN = ("residual_correlation", "decorrelated_fraction")
"""Fields in which null stands for NaN; elsewhere it stands for infinity."""


def _or(missing: float, value: Any) -> Any:
    return missing if value is None else value
