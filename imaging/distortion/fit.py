"""A distortion that makes several photographs of one flat target agree, by least squares.

Photograph i shows the ideal position x of the target's pattern at phi_S(T_i(x)), T_i a rigid
motion. The pattern P(x) is unknown. The minimum over P of sum_i (c_i I_i(phi_S(T_i x)) + o_i -
P(x))^2 is the mean of the photographs that show x, so the fit minimises the scatter about this
mean. No photograph is privileged, noise in different photographs stays independent, and the
covariance of the unknowns is sigma^2 M^-1, M the normal matrix. The noise sigma of a photograph is
the residual corrected for the effect on white noise of blurring and sampling between pixels.
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
    """Polynomials of a given total degree whose terms of lowest degree may be fixed at zero."""

    shape: tuple[int, int]
    """(rows, cols) of the image [px]."""
    degree: int
    """Total degree, at least 1."""
    fixed: int = 3
    """Number of terms of each component fixed at zero: 3 (the affine terms) if shifts are unknown,
    1 (the constant) if shifts are known, 0 if all terms are observable."""

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
        """(k,) initial coefficients: zeros, that is, no distortion."""
        return np.zeros(2 * self.terms)

    def distortion(self, c: FloatArray) -> PolynomialDistortion:
        """The distortion with coefficients c (k,): those along rows, then those along columns."""
        full = np.zeros((2, self.terms + self.fixed))
        full[:, self.fixed :] = c.reshape(2, self.terms)
        return PolynomialDistortion(self.shape, full)

    def sensitivities(self, c: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
        """(2, k, n) derivatives of S(row, col) [px] with respect to the coefficients."""
        basis = self.distortion(c).basis(row, col)[:, self.fixed :].T
        zero = np.zeros_like(basis)
        return np.array([np.concatenate([basis, zero]), np.concatenate([zero, basis])])

    def of_degree(self, c: FloatArray, degree: int) -> tuple[PolynomialModel, FloatArray]:
        """The model of another degree, and ``c`` truncated or padded with zeros for it."""
        other = replace(self, degree=degree)
        full, kept = np.zeros((2, other.terms)), min(self.terms, other.terms)
        full[:, :kept] = c.reshape(2, self.terms)[:, :kept]
        return other, full.ravel()


POSE_UNKNOWNS = 5
"""Number of unknowns of a photograph: shift (row, col) [px], rotation [rad], contrast, brightness.

The target's point x is at T(x) = centre + R (x - centre) + shift, R a small rotation from the
column axis to the row axis; contrast * level + brightness matches the first photograph's levels."""


@dataclass(frozen=True, eq=False)
class View:
    """A photograph, the target's pose in it and the image's contrast and brightness."""

    spline: SplineImage
    """Spline interpolation of the photograph."""
    pose: FloatArray
    """(5,) the target's pose, contrast and brightness: see ``POSE_UNKNOWNS``."""
    free: tuple[bool, ...] = (False,) * POSE_UNKNOWNS
    """(5,) which entries of ``pose`` are unknowns of the fit."""
    distorted: bool = True
    """False if the photograph has no distortion, as an image of a known pair."""
    border_px: float = 4.0
    """Width of the excluded margin [px], where spline and blur rely on the mirrored image."""


def checked_images(images: Sequence[ArrayLike], names: Sequence[str]) -> list[FloatImage]:
    """The images as floats; InputError if sizes differ or are small, or one shows no pattern."""
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
    """Spline of an image blurred by a Gaussian with standard deviation ``blur_px`` [px]."""
    return SplineImage.of(ndimage.gaussian_filter(image, blur_px) if blur_px else image, order)


def with_poses(views: Sequence[View], poses: FloatArray) -> list[View]:
    """The same views with other poses (views, 5)."""
    return [replace(view, pose=pose) for view, pose in zip(views, poses, strict=True)]


def normalised_illumination(
    images: Sequence[FloatImage], shifts: FloatArray | None = None
) -> FloatArray:
    """(m, 5) poses with given shifts (m, 2) [px]; mean and spread of grey levels as in image 0."""
    mean, spread = (np.array([f(im, dtype=np.float64) for im in images]) for f in (np.mean, np.std))
    poses = np.zeros((len(images), POSE_UNKNOWNS))
    poses[:, :2] = 0.0 if shifts is None else shifts
    poses[:, 3] = spread[0] / spread
    poses[:, 4] = mean[0] - poses[:, 3] * mean
    return poses


_FINE = 16
"""Samples per px of the response to a single noisy pixel."""


def sampled_noise(blur_px: float, order: int, stride_px: float) -> tuple[float, float]:
    """Variance factors of blurred, interpolated white noise: of a sample, of many samples' mean.

    The first is averaged over all positions between pixels. The second is the sum of the samples'
    covariances, which holds for a field that varies slowly from sample to sample. It is 1 for a
    stride of 1 px, where no information is lost. Both are for noise of variance 1.

    blur_px, order : standard deviation of the blur before the spline [px]; the spline's order.
    stride_px : distance between samples along rows and columns [px].
    """
    lags, correlations = sampled_correlations(blur_px, order, stride_px)
    return float(correlations[lags == 0.0].sum()) ** 2, float(correlations.sum()) ** 2


def sampled_correlations(
    blur_px: float, order: int, stride_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lags [px] along one axis, and the covariances of blurred, sampled white noise at them."""
    reach = int(np.ceil(16 + 6 * blur_px))
    impulse = np.zeros((24, 2 * reach + 1))
    impulse[:, reach] = 1.0  # a line: the response doesn't depend on the other axis
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
"""Number of points assembled at a time."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of the least-squares fit."""

    coefficients: FloatArray
    """(k,) coefficients of the model."""
    poses: FloatArray
    """(views, 5) poses of the views."""
    inverse: FloatArray
    """(K, K) inverse normal matrix: the coefficients, then the free unknowns of each view."""
    free: NDArray[np.bool_]
    """(views, 5) which of the views' unknowns are free, in the order of ``inverse``."""
    sum_of_squares: float
    """Sum of squares of the scatter about the mean [grey levels squared]."""
    freedom: int
    """Degrees of freedom of ``sum_of_squares``."""
    converged: bool
    """Whether the last step was below the tolerance."""
    matches: FloatArray
    """(views,) correlation of each photograph with the mean of the others [-]."""

    @property
    def variance(self) -> float:
        """Mean square of the scatter: variance of the interpolated noise [grey levels squared]."""
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

    model, c, views : model of S; its initial coefficients (k,); photographs with initial poses.
    points : (n,) rows and columns of the ideal positions to use [px].
    tolerance_px : iterations stop when S and the shifts change by less than this [px].
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
    """Assemble the normal matrix and the gradient of the scatter about the mean.

    Also its sum of squares, degrees of freedom, and each view's correlation with the others' mean.
    """
    k, own = len(c), [sum(view.free) for view in views]
    ends = k + np.cumsum(own)
    where = [np.r_[:k, end - n : end] for n, end in zip(own, ends, strict=True)]
    size = int(ends[-1])
    matrix, gradient, squares, freedom = np.zeros((size, size)), np.zeros(size), 0.0, 0
    sums = np.zeros((len(views), 6))  # of 1, a, b, a^2, b^2, a b; a: a view, b: mean of the others
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
    """(inside, grey levels, derivatives) of a view at the points; levels are 0 where not inside."""
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
