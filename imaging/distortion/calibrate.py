"""Optical distortion from photographs of a speckled flat target that a stage has shifted.

A distortion S makes a rigid shift t appear as t + S(x + t) - S(x). This apparent motion varies over
the image, and S is found from the variation. The grey levels of all photographs are fitted at once
(:mod:`modeharvest.imaging.distortion.fit`), with the shifts as unknowns beside S. The idea is from
Maraghechi et al. 2019, the paper's reference for S; the fit was developed in this project.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from skimage.registration import phase_cross_correlation

from modeharvest.imaging.distortion.fit import (
    POSE_UNKNOWNS,
    Fit,
    PolynomialModel,
    View,
    blurred_spline,
    checked_images,
    fit_views,
    normalised_illumination,
    sampled_noise,
    with_poses,
)
from modeharvest.imaging.distortion.lens import Distortion, PolynomialDistortion
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent

_COARSE_PX = 512
"""Size to which photographs are binned to estimate their shifts to within a few px."""
_COARSE_DEGREE = 3
*_COARSE_BLURS_PX, _BLUR_PX = 12.0, 6.0, 3.0, 0.7
"""Gaussian blurs of the photographs, in turn. The first covers the errors of the binned correlation
and of S. The last makes the noise of a sample independent of its position between pixels; otherwise
S would be biased towards half pixels."""
_ORDER = 5
"""Order of the spline that interpolates the photographs."""
_BORDER_PX = 4.0
_MATCH = 0.5
"""A photograph whose correlation with the others is lower shows something else."""
_LEAST_SHIFT, _LEAST_BREADTH = 5.0, 0.05
"""Least length of the longest shift [px]; least ratio of the shifts' spread across and along."""


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of the calibration."""

    degrees: tuple[int, ...] = (2, 3, 4, 5, 6, 7, 8)
    """Total degrees of S to compare, ascending, from 2; ends when the BIC rises twice in a row."""
    rotations: bool = True
    """Whether small rotations of the target are unknowns; only if the shifts are not given."""
    points: int = 100_000
    """About how many points of the target to use; more points lower the standard deviation."""

    def __post_init__(self) -> None:
        if not self.degrees or self.degrees[0] < 2 or list(self.degrees) != sorted(self.degrees):
            raise InputError(f"expected ascending degrees from 2 on, got {self.degrees}")
        if self.points < 1000:
            raise InputError(f"expected at least 1000 points, got {self.points}")


@dataclass(frozen=True, eq=False)
class LensEstimate:
    """A distortion estimated by a fit, with its covariance."""

    distortion: Distortion
    """The estimated S."""
    coefficients: FloatArray
    covariance: FloatArray
    """(k,) estimates of the model's unknowns, and their (k, k) covariance."""
    model: PolynomialModel
    """Defines the unknowns."""
    noise_sd: float
    """Standard deviation of an image's noise, from the residual [grey levels]."""
    matches: FloatArray
    """(m,) correlation of each image with the mean of the others, without distortion [-]."""
    bic: float = math.nan
    """Bayesian information criterion, lower is better within one set; NaN if not kept."""

    @classmethod
    def of(cls, model: PolynomialModel, fit: Fit, noise: tuple[float, float]) -> LensEstimate:
        """The estimate of a fit; ``noise`` is the result of :func:`sampled_noise`."""
        one, many = noise
        k = len(fit.coefficients)
        return cls(
            distortion=model.distortion(fit.coefficients), coefficients=fit.coefficients,
            covariance=fit.inverse[:k, :k] * (fit.variance * many / one), model=model,
            noise_sd=float(np.sqrt(fit.variance / one)), matches=fit.matches, bic=fit.bic,
        )  # fmt: skip

    def sd(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Standard deviation of S [px] at ideal positions [px], due to image noise alone."""
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        columns = self.model.sensitivities(self.coefficients, row.ravel(), col.ravel())
        products = np.einsum("ckn,kl->cln", columns, self.covariance, optimize=True)
        variance = np.maximum((products * columns).sum(axis=1), 0.0)
        along_row, along_col = np.sqrt(variance).reshape(2, *row.shape)
        return along_row, along_col


@dataclass(frozen=True)
class DegreeTrial:
    """Result of the fit with one polynomial degree of S."""

    degree: int
    """Total degree."""
    unknowns: int
    """Number of all unknowns."""
    residual_rms: float
    """Scatter of the photographs about their mean [grey levels]."""
    bic: float
    """Bayesian information criterion minus its lowest value: N log(residual^2) + unknowns log N for
    N values [-]; the degree with 0 is chosen."""
    change_px: float
    """Rms per component, over the image, of the change of S from the previous degree [px]."""
    sd_px: float
    """Rms per component, over the image, of the standard deviation of S [px]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration(LensEstimate):
    """Result of a calibration: S without its unobservable part, and the target's motion."""

    distortion: PolynomialDistortion
    model: PolynomialModel
    """S and its model, whose ``fixed`` terms are not observable and are zero."""
    shifts: FloatArray
    shifts_sd: FloatArray
    """(m, 2) shift of the target since the first photograph (along rows, along columns) [px], and
    its standard deviation, which is 0 where the shift was given."""
    angles: FloatArray
    angles_sd: FloatArray
    """(m,) rotation of the target and its standard deviation, from column to row axis [rad]."""
    trials: tuple[DegreeTrial, ...]
    """One for each degree tried."""


def calibrate(
    images: Sequence[ArrayLike],
    shifts: ArrayLike | None = None,
    options: CalibrationOptions | None = None,
    progress: Progress = silent,
) -> Calibration:
    """Find the distortion of a lens from photographs of one flat target in several positions.

    InputError if the photographs are too few, differ in size, have no speckle, show different
    objects, or are not shifted enough.

    images : m >= 3 photographs (rows, cols), the target shifted along two directions or more.
    shifts : (m, 2) stage positions along rows and columns [px], if known; their errors bias S.
        Without them the affine part of S is not observable and is set to zero.
    """
    options = options or CalibrationOptions()
    if len(images) < 3:
        raise InputError(
            "expected a calibration set of at least 3 photographs, shifted along two directions, "
            f"got {len(images)}: a calibration set without enough shifts"
        )
    names = [f"{n + 1}. calibration" for n in range(len(images))]
    photographs = checked_images(images, names)
    known = shifts is not None
    start = _given(shifts, len(images)) if known else _rough_shifts(photographs)
    free = (not known, not known, not known and options.rotations)
    steps, done = len(_COARSE_BLURS_PX) + 1 + len(options.degrees), itertools.count(1)

    def report() -> None:
        progress(next(done), steps, "calibrate")

    poses = normalised_illumination(photographs, start)
    coarse, fit = _coarse_fit(photographs, poses, free, options, report)
    _require_shifts(fit.poses)
    _require_matches(fit)
    trials, stride = _trials(photographs, coarse, fit, free, options, report)
    _require_matches(min(trials, key=lambda trial: trial[1].bic)[1])
    progress(1, 1, "calibrate")
    return calibration_of(trials, sampled_noise(_BLUR_PX, _ORDER, stride))


def _coarse_fit(
    photographs: Sequence[FloatImage],
    poses: FloatArray,
    moving: tuple[bool, bool, bool],
    options: CalibrationOptions,
    report: Callable[[], None],
) -> tuple[PolynomialModel, Fit]:
    """Estimate the shifts and an S of at most third degree from blurred photographs."""
    rows, cols = photographs[0].shape
    degree = min(_COARSE_DEGREE, options.degrees[-1])
    model = PolynomialModel((rows, cols), degree, fixed=3 if moving[0] else 1)
    c = model.start
    for blur in _COARSE_BLURS_PX:
        # Before the images match, fitting contrast and brightness would rather remove the contrast.
        views = _views(photographs, poses, (*moving, False, False), blur)
        points, _ = _points((rows, cols), poses, options.points // 4)
        fit = fit_views(model, c, views, points, tolerance_px=0.02, max_iterations=10)
        c, poses = fit.coefficients, fit.poses
        report()
    return model, fit


def _trials(
    photographs: Sequence[FloatImage], model: PolynomialModel, fit: Fit,
    moving: tuple[bool, bool, bool], options: CalibrationOptions, report: Callable[[], None],
) -> tuple[list[tuple[PolynomialModel, Fit]], float]:  # fmt: skip
    """A fit for each degree, the best one iterated to convergence; the points' spacing [px]."""
    free = (*moving, True, True)
    views = _views(photographs, fit.poses, free, _BLUR_PX)
    points, stride = _points(model.shape, fit.poses, options.points)
    trials: list[tuple[PolynomialModel, Fit]] = []
    c = fit.coefficients
    for degree in options.degrees:
        # With too low a degree the fit converges slowly; full convergence isn't needed here.
        model, c = model.of_degree(c, degree)
        fit = fit_views(model, c, views, points, tolerance_px=1e-3, max_iterations=6)
        c, views = fit.coefficients, with_poses(views, fit.poses)
        trials.append((model, fit))
        report()
        criteria = [fit.bic for _, fit in trials]
        if len(criteria) > 2 and criteria[-3] < criteria[-2] < criteria[-1]:
            break
    best = int(np.argmin(criteria))
    model, fit = trials[best]
    settled = fit_views(model, fit.coefficients, with_poses(views, fit.poses), points)
    trials[best] = model, settled
    return trials, stride


def _given(shifts: ArrayLike | None, count: int) -> FloatArray:
    found = np.asarray(shifts, dtype=np.float64)
    if found.shape != (count, 2) or not np.isfinite(found).all():
        raise InputError(
            f"expected {count} finite shifts (row, col) [px], one for each calibration "
            f"photograph, got shape {found.shape}"
        )
    relative: FloatArray = found - found[0]
    return relative


def _rough_shifts(photographs: Sequence[FloatImage]) -> FloatArray:
    """(m, 2) shifts since the first photograph [px], within a few px, from binned photographs."""
    factor = max(1, max(photographs[0].shape) // _COARSE_PX)
    register: Any = phase_cross_correlation  # has no type annotations
    rows, cols = (n // factor for n in photographs[0].shape)
    whole = np.s_[: rows * factor, : cols * factor]
    blocks = [image[whole].reshape(rows, factor, cols, factor) for image in photographs]
    first, *others = (block.mean(axis=(1, 3)) for block in blocks)
    everywhere = np.ones((rows, cols), dtype=np.bool_)
    options = {"reference_mask": everywhere, "moving_mask": everywhere, "overlap_ratio": 0.2}
    found = [-register(first, image, **options)[0] for image in others]
    return np.array([np.zeros(2), *found]) * factor


def _views(
    photographs: Sequence[FloatImage], poses: FloatArray, free: tuple[bool, ...], blur: float
) -> list[View]:
    """Photographs as splines with poses; the pose of the first one is fixed."""
    return [
        View(
            blurred_spline(image, blur, _ORDER),
            pose,
            free if n else (False,) * POSE_UNKNOWNS,
            border_px=max(_BORDER_PX, blur),
        )
        for n, (image, pose) in enumerate(zip(photographs, poses, strict=True))
    ]


def _points(
    shape: tuple[int, ...], poses: FloatArray, count: int
) -> tuple[tuple[FloatArray, FloatArray], float]:
    """Ideal positions on a regular grid, about ``count`` per photograph, and its spacing [px]."""
    shifts = poses[:, :2]
    low, high = -shifts.max(axis=0) - 20.0, np.array(shape) - shifts.min(axis=0) + 20.0
    stride = max(1.0, float(np.sqrt(np.prod(shape) / count)))
    axes = [np.arange(a, b, stride) for a, b in zip(low, high, strict=True)]
    row, col = np.meshgrid(*axes, indexing="ij")
    return (row.ravel(), col.ravel()), stride


def _require_matches(fit: Fit) -> None:
    worst = int(np.argmin(fit.matches))
    if fit.matches[worst] < _MATCH:
        raise InputError(
            "expected calibration photographs of one target, shifted in its plane, got number "
            f"{worst + 1} whose grey levels correlate with the others' by "
            f"{fit.matches[worst]:.2f} only; leave it out, or give the shifts"
        )


def _require_shifts(poses: FloatArray) -> None:
    """Raise InputError unless the shifts span the plane; otherwise S is not determined."""
    shifts = poses[:, :2]
    along, across = np.linalg.svd(shifts, compute_uv=False)
    longest = float(np.hypot(*shifts.T).max())
    if longest < _LEAST_SHIFT or across < _LEAST_BREADTH * along:
        raise InputError(
            f"expected shifts of {_LEAST_SHIFT:g} px or more along two directions, got "
            f"{longest:.1f} px at most and {across / max(along, 1e-9):.3f} as much across: "
            "a calibration set without enough shifts; photograph the target shifted both ways"
        )


def calibration_of(
    trials: Sequence[tuple[PolynomialModel, Fit]], noise: tuple[float, float]
) -> Calibration:
    """Choose the degree with the lowest BIC; ``noise``: the result of :func:`sampled_noise`."""
    model, fit = min(trials, key=lambda trial: trial[1].bic)
    one, many = noise
    own, covariance = np.zeros(fit.free.shape), fit.inverse * (fit.variance * many / one)
    own[fit.free] = np.sqrt(np.diag(covariance)[len(fit.coefficients) :])
    return Calibration(
        **vars(LensEstimate.of(model, fit, noise)), shifts=fit.poses[:, :2], shifts_sd=own[:, :2],
        angles=fit.poses[:, 2], angles_sd=own[:, 2], trials=_tried(trials, noise),
    )  # fmt: skip


def _tried(
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
