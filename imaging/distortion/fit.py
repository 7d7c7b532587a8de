"""A distortion that makes several photographs of one flat target agree, by least squares.

Photograph i shows the ideal position x of the target's pattern at phi_S(T_i(x)), T_i a rigid
motion. The pattern P(x) is not known; the minimum over P of sum_i (c_i I_i(phi_S(T_i x)) + o_i -
P(x))^2 is at the mean of those photographs that show x, so what is minimised is the scatter about
it. No photograph is privileged, noise in different photographs stays independent, and the
covariance of the unknowns is sigma^2 M^-1. sigma, the noise of a photograph, follows from the
residual by what becomes of white noise where a blurred image is sampled between its pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from modeharvest.imaging.distortion.lens import Distortion, PolynomialDistortion
from modeharvest.imaging.photographs.files import require_visible
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.scaled_eigen import ScaledEigen


@dataclass(frozen=True)
class PolynomialModel:
    """Polynomials of a total degree, all of their terms or those above the affine ones."""

    shape: tuple[int, int]
    """(rows, cols) of the image [px]."""
    degree: int
    """Total degree, at least 1."""
    fixed: int = 3
    """How many terms of each component are zero: 3, the affine ones, where shifts are not known; 1,
    the constant, where they are; 0 if all are observable."""

    def __post_init__(self) -> None:
        if self.fixed not in (0, 1, 3) or self.terms < 1:
            raise InputError(
                "expected a degree above that of the fixed terms (0, 1 or 3 of them), got degree "
                f"{self.degree} and {self.fixed} fixed terms"
            )

    @property
    def terms(self) -> int:
        """Count the unknown coefficients of one component."""
        return PolynomialDistortion.size_of(self.degree) - self.fixed

    @property
    def start(self) -> FloatArray:
        """(k,) coefficients to begin with: zeros, no distortion."""
        return np.zeros(2 * self.terms)

    def distortion(self, c: FloatArray) -> PolynomialDistortion:
        """The distortion of these coefficients: first all along rows, then all along columns."""
        full = np.zeros((2, self.terms + self.fixed))
        full[:, self.fixed :] = c.reshape(2, self.terms)
        return PolynomialDistortion(self.shape, full)

    def sensitivities(self, c: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
        """(2, k, n) derivatives of S(row, col) [px] with respect to the coefficients."""
        basis = self.distortion(c).basis(row, col)[:, self.fixed :].T
        zero = np.zeros_like(basis)
        return np.array([np.concatenate([basis, zero]), np.concatenate([zero, basis])])

    def of_degree(self, c: FloatArray, degree: int) -> tuple[PolynomialModel, FloatArray]:
        """The model of another degree; coefficients in it, cut or continued by zeros."""
        other = replace(self, degree=degree)
        full, kept = np.zeros((2, other.terms)), min(self.terms, other.terms)
        full[:, :kept] = c.reshape(2, self.terms)[:, :kept]
        return other, full.ravel()


POSE_UNKNOWNS = 5
"""Of a photograph: shift along rows and columns [px], rotation [rad], contrast, brightness.

The target's point x is at T(x) = centre + R (x - centre) + shift, R a small rotation from the
columns' to the rows' axis; contrast * level + brightness is as bright as the first photograph."""


@dataclass(frozen=True, eq=False)
class View:
    """A photograph and what is unknown of it."""

    spline: SplineImage
    """Of the photograph."""
    pose: FloatArray
    """(5,) where the target is in it, and how bright that is: see ``POSE_UNKNOWNS``."""
    free: tuple[bool, ...] = (False,) * POSE_UNKNOWNS
    """(5,) which of these are unknown."""
    distorted: bool = True
    """False if the photograph has no distortion, as one of a known pair."""
    border_px: float = 4.0
    """Width of the margin left out [px]: spline and blur know only its mirror image."""


def checked_images(images: Sequence[ArrayLike], names: Sequence[str]) -> list[FloatImage]:
    """The images; InputError if sizes differ or are small, or one shows no pattern."""
    found = [np.asarray(image, dtype=np.float32) for image in images]
    for image, name in zip(found, names, strict=True):
        if image.ndim != 2 or image.shape != found[0].shape or min(image.shape) < 64:
            raise InputError(
                "expected images of one size, at least 64 x 64 px, got "
                f"{found[0].shape} for the {names[0]} one and {image.shape} for the {name} one"
            )
        require_visible(image, f"in the {name} image")
    return found


def blurred_spline(image: FloatImage, blur_px: float, order: int) -> SplineImage:
    """The spline of an image blurred by a Gaussian of that standard deviation [px]."""
    return SplineImage.of(ndimage.gaussian_filter(image, blur_px) if blur_px else image, order)


def with_poses(views: Sequence[View], poses: FloatArray) -> list[View]:
    """The same views, in other poses (views, 5)."""
    return [replace(view, pose=pose) for view, pose in zip(views, poses, strict=True)]


def normalised_illumination(
    images: Sequence[FloatImage], shifts: FloatArray | None = None
) -> FloatArray:
    """(m, 5) poses with (m, 2) shifts [px] that give all images the first one's mean and spread."""
    mean, spread = (np.array([f(im, dtype=np.float64) for im in images]) for f in (np.mean, np.std))
    poses = np.zeros((len(images), POSE_UNKNOWNS))
    poses[:, :2] = 0.0 if shifts is None else shifts
    poses[:, 3] = spread[0] / spread
    poses[:, 4] = mean[0] - poses[:, 3] * mean
    return poses


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


_CHUNK = 4096
"""Points that are looked at a time."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Where the least squares ended."""

    coefficients: FloatArray
    """(k,) of the model."""
    poses: FloatArray
    """(views, 5) of each view."""
    inverse: FloatArray
    """(K, K) of the normal matrix: of the coefficients, then of each view's unknowns."""
    free: NDArray[np.bool_]
    """(views, 5) which of the views' unknowns are free, in the order of ``inverse``."""
    sum_of_squares: float
    """Scatter about the mean [grey levels squared]."""
    freedom: int
    """Degrees of freedom of that."""
    converged: bool
    """Whether the last step was short enough."""
    matches: FloatArray
    """(views,) correlation of each photograph with the mean of the others [-]."""

    @property
    def variance(self) -> float:
        """Mean square of the scatter, the noise as the spline passes it [grey levels squared]."""
        return self.sum_of_squares / self.freedom

    @property
    def bic(self) -> float:
        """Bayesian information criterion: N log(residual^2) + unknowns log N for N values."""
        unknowns, values = len(self.inverse), self.freedom + len(self.inverse)
        return float(values * np.log(self.sum_of_squares / values) + unknowns * np.log(values))


def fit_views(
    model: PolynomialModel, c: FloatArray, views: Sequence[View],
    points: tuple[FloatArray, FloatArray], tolerance_px: float = 1e-5, max_iterations: int = 30,
) -> Fit:  # fmt: skip
    """Find the model's coefficients and the views' poses by Gauss-Newton.

    model, c, views : the distortions to choose from; (k,) coefficients and poses to begin with.
    points : (n,) rows and columns of ideal positions to look at [px].
    tolerance_px : largest change of S or of a shift [px] at which to stop.
    """
    free = np.array([view.free for view in views])
    half_size = 0.5 * max(views[0].spline.shape)
    px = np.array([1.0, 1.0, half_size, 0.0, 0.0])
    for _ in range(max_iterations):
        matrix, gradient, squares, freedom, matches = _assemble(model, c, views, points)
        eigen = ScaledEigen.of(matrix)
        step = -eigen.solve(gradient)
        own = np.zeros(free.shape)
        own[free] = step[len(c) :]
        c = c + step[: len(c)]
        views = with_poses(views, np.add([view.pose for view in views], own))
        length = max(np.abs(step[: len(c)]).max(), np.abs(own * px).max())
        if length < tolerance_px:
            break
    return Fit(
        coefficients=c, poses=np.array([view.pose for view in views]), inverse=eigen.inverse(),
        free=free, sum_of_squares=squares, freedom=max(1, freedom - len(step)),
        converged=bool(length < tolerance_px), matches=matches,
    )  # fmt: skip


def _assemble(
    model: PolynomialModel,
    c: FloatArray,
    views: Sequence[View],
    points: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray, float, int, FloatArray]:
    """Normal equations of the scatter about the mean, chunk by chunk: matrix and gradient.

    And its sum of squares, the degrees of freedom, and each view's correlation with the mean.
    """
    k, own = len(c), [sum(view.free) for view in views]
    ends = k + np.cumsum(own)
    where = [np.r_[:k, end - n : end] for n, end in zip(own, ends, strict=True)]
    size = int(ends[-1])
    matrix, gradient, squares, freedom = np.zeros((size, size)), np.zeros(size), 0.0, 0
    sums = np.zeros((len(views), 6))  # of 1, a, b, a^2, b^2, a b: a view, and the mean of others
    distortion = model.distortion(c)
    for first in range(0, points[0].size, _CHUNK):
        row, col = (a[first : first + _CHUNK] for a in points)
        samples = [_sample(model, c, distortion, view, row, col) for view in views]
        count = np.sum([inside for inside, _, _ in samples], axis=0)
        weight = 1.0 / np.maximum(count, 1)
        mean = weight * np.sum([value for _, value, _ in samples], axis=0)
        shared = count > 1
        total = np.zeros((size, row.size))
        for n, ((inside, value, slopes), at) in enumerate(zip(samples, where, strict=True)):
            used = inside & shared
            deviation, columns = np.where(used, value - mean, 0.0), slopes * used
            matrix[np.ix_(at, at)] += columns @ columns.T
            gradient[at] += columns @ deviation
            total[at] += columns
            squares += float(deviation @ deviation)
            a, b = value[used], (mean * count - value)[used] / (count[used] - 1)
            sums[n] += a.size, a.sum(), b.sum(), a @ a, b @ b, a @ b
        matrix -= (total * weight) @ total.T
        freedom += int((count[shared] - 1).sum())
    return matrix, gradient, squares, freedom, _correlations(sums)


def _sample(
    model: PolynomialModel,
    c: FloatArray,
    distortion: Distortion,
    view: View,
    row: FloatArray,
    col: FloatArray,
) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
    """Where a view shows the points; grey levels and their derivatives, 0 elsewhere."""
    rows, cols = view.spline.shape
    down, right, angle, contrast, brightness = view.pose
    arm_row, arm_col = row - 0.5 * (rows - 1), col - 0.5 * (cols - 1)
    cos, sin = np.cos(angle), np.sin(angle)
    at_row = 0.5 * (rows - 1) + cos * arm_row - sin * arm_col + down
    at_col = 0.5 * (cols - 1) + sin * arm_row + cos * arm_col + right
    p_row, p_col = distortion.observed(at_row, at_col) if view.distorted else (at_row, at_col)
    border = view.border_px
    inside = (p_row >= border) & (p_row <= rows - 1 - border)
    inside &= (p_col >= border) & (p_col <= cols - 1 - border)
    value, d_row, d_col = np.zeros(row.shape), np.zeros(row.shape), np.zeros(row.shape)
    value[inside], d_row[inside], d_col[inside] = view.spline.sample(p_row[inside], p_col[inside])
    slope = contrast * np.stack([d_row, d_col])
    columns = np.zeros((len(c) + POSE_UNKNOWNS, row.size))
    if view.distorted:
        s_row, s_col = model.sensitivities(c, at_row, at_col)
        columns[: len(c)] = slope[0] * s_row + slope[1] * s_col
        slope = slope + np.einsum("i...,ij...->j...", slope, distortion.gradient(at_row, at_col))
    turn_row, turn_col = -sin * arm_row - cos * arm_col, cos * arm_row - sin * arm_col
    columns[len(c) :] = [*slope, slope[0] * turn_row + slope[1] * turn_col, value, inside]
    kept = np.r_[np.ones(len(c), np.bool_), view.free]
    normalised = np.where(inside, contrast * value + brightness, 0.0)
    return inside, normalised, columns[kept]


def _correlations(sums: FloatArray) -> FloatArray:
    """Correlation coefficients from sums over 1, a, b, a^2, b^2, a b; 0 without points."""
    n, a, b, aa, bb, ab = sums.T
    n = np.maximum(n, 1.0)
    spread = np.sqrt(np.maximum((aa / n - (a / n) ** 2) * (bb / n - (b / n) ** 2), 0.0))
    covariance = ab / n - a * b / n**2
    return np.where(spread > 0.0, covariance / np.where(spread > 0.0, spread, 1.0), 0.0)
