"""Lenses as found: S with its covariance, the choice of its degree, the photographs' noise.

The noise of a photograph follows from the residual by what becomes of white noise where a blurred
image is sampled between its pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from modeharvest.imaging.distortion.calibration.fit import Fit
from modeharvest.imaging.distortion.calibration.model import DistortionModel, PolynomialModel
from modeharvest.imaging.distortion.lens import Distortion, PolynomialDistortion
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import FloatArray

_FINE = 16
"""Samples per px of the response to a single noisy pixel."""


def sampled_noise(blur_px: float, order: int, stride_px: float) -> tuple[float, float]:
    """Variance of a sample, and of the mean of many samples, of white noise of variance 1.

    The former is the mean over all positions between pixels; the latter that times how much
    neighbouring samples have in common: the variance that a field sees that varies slowly from
    sample to sample. It is 1 for a stride of 1 px: no information is lost there.

    blur_px, order : standard deviation of the blur before the spline [px]; its order, 3 or 5.
    stride_px : distance between samples along rows and columns [px].
    """
    lags, correlations = sampled_correlations(blur_px, order, stride_px)
    return float(correlations[lags == 0.0].sum()) ** 2, float(correlations.sum()) ** 2


def sampled_correlations(
    blur_px: float, order: int, stride_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lags [px] along an axis, and covariances at them of white noise blurred and sampled."""
    reach = int(np.ceil(16 + 6 * blur_px))
    impulse = np.zeros((24, 2 * reach + 1))
    impulse[:, reach] = 1.0  # a line, so that the other axis has no say
    if blur_px > 0.0:
        impulse = ndimage.gaussian_filter1d(impulse, blur_px, axis=1)
    along = np.arange(2 * reach * _FINE) / _FINE
    response, _, _ = SplineImage.of(impulse, order, np.float64).sample(12.0, along)
    count = int(reach / stride_px)
    lags = stride_px * np.arange(-count, count + 1, dtype=np.float64)
    shifted = np.interp(along + lags[:, None], along, response, left=0.0, right=0.0)
    correlations: NDArray[np.float64] = shifted @ response / _FINE
    return lags, correlations


@dataclass(frozen=True, eq=False)
class LensEstimate:
    """A lens as a fit found it."""

    distortion: Distortion
    """What the model made of it."""
    coefficients: FloatArray
    covariance: FloatArray
    """(k,) and (k, k) of the model's unknowns."""
    model: DistortionModel
    """Which these are."""
    noise_sd: float
    """Noise of an image, estimated from the residual [grey levels]."""
    matches: FloatArray
    """(m,) correlation of each image with the mean of the others, without distortion [-]."""
    bic: float = math.nan
    """Bayesian information criterion, the lower the better, of one set; NaN if not kept."""

    @classmethod
    def of(cls, model: DistortionModel, fit: Fit, noise: tuple[float, float]) -> LensEstimate:
        """The lens of a fit, ``noise`` being what :func:`sampled_noise` gives."""
        one, many = noise
        k = len(fit.coefficients)
        return cls(
            distortion=model.distortion(fit.coefficients),
            coefficients=fit.coefficients,
            covariance=fit.inverse[:k, :k] * (fit.variance * many / one),
            model=model,
            noise_sd=float(np.sqrt(fit.variance / one)),
            matches=fit.matches,
            bic=fit.bic,
        )

    def sd(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Standard deviation of S [px] at ideal positions [px], by the images' noise alone."""
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        columns = self.model.sensitivities(self.coefficients, row.ravel(), col.ravel())
        products = np.einsum("ckn,kl->cln", columns, self.covariance, optimize=True)
        variance = np.maximum((products * columns).sum(axis=1), 0.0)
        along_row, along_col = np.sqrt(variance).reshape(2, *row.shape)
        return along_row, along_col


@dataclass(frozen=True)
class DegreeTrial:
    """What a degree of S gave."""

    degree: int
    """Total degree."""
    unknowns: int
    """Number of all unknowns."""
    residual_rms: float
    """Scatter of the photographs about their mean [grey levels]."""
    bic: float
    """Bayesian information criterion less its lowest value: N log(residual^2) + unknowns log N for
    N values; the degree with 0 is taken [-]."""
    change_px: float
    """Rms per component over the image by which S differs from the degree before [px]."""
    sd_px: float
    """Rms per component over the image of S's standard deviation [px]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration(LensEstimate):
    """The lens of a set of photographs, without the part of S that can't be observed."""

    distortion: PolynomialDistortion
    model: PolynomialModel
    """S; the model's ``fixed`` terms could not be observed and are zero."""
    shifts: FloatArray
    shifts_sd: FloatArray
    """(m, 2) motion of the target since the first photograph, along rows and columns [px], and its
    standard deviation; 0 where given."""
    angles: FloatArray
    angles_sd: FloatArray
    """(m,) likewise its rotation, from the columns' to the rows' axis [rad]."""
    trials: tuple[DegreeTrial, ...]
    """One for each degree."""


def calibration_of(
    trials: Sequence[tuple[PolynomialModel, Fit]], noise: tuple[float, float]
) -> Calibration:
    """Choose the degree with the lowest BIC; ``noise`` is what :func:`sampled_noise` gives."""
    model, fit = min(trials, key=lambda trial: trial[1].bic)
    one, many = noise
    own, covariance = np.zeros(fit.free.shape), fit.inverse * (fit.variance * many / one)
    own[fit.free] = np.sqrt(np.diag(covariance)[len(fit.coefficients) :])
    return Calibration(
        **vars(LensEstimate.of(model, fit, noise)),
        shifts=np.array([pose.shift for pose in fit.poses]),
        shifts_sd=own[:, :2],
        angles=np.array([pose.angle for pose in fit.poses]),
        angles_sd=own[:, 2],
        trials=_trials(trials, noise),
    )


def _trials(
    fitted: Sequence[tuple[PolynomialModel, Fit]], noise: tuple[float, float]
) -> tuple[DegreeTrial, ...]:
    row, col = (np.linspace(0.0, n - 1.0, 25) for n in fitted[0][0].shape)
    at = row[:, None], col[None, :]
    lowest = min(fit.bic for _, fit in fitted)
    trials: list[DegreeTrial] = []
    before: FloatArray = np.zeros((2, 25, 25))
    for model, fit in fitted:
        lens = LensEstimate.of(model, fit, noise)
        now = np.stack(lens.distortion.shift(*at))
        trial = DegreeTrial(
            degree=model.degree,
            unknowns=len(fit.inverse),
            residual_rms=float(np.sqrt(fit.variance)),
            bic=fit.bic - lowest,
            change_px=float(np.sqrt(np.mean((now - before) ** 2))),
            sd_px=float(np.sqrt(np.mean(np.square(lens.sd(*at))))),
        )
        trials.append(trial)
        before = now
    return tuple(trials)
