"""A lens from two images of one scene, without and with its distortion.

Such pairs are made in a computer, or by two lenses one of which is ideal. The target doesn't move,
so all of S is observable, its affine part included.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from modeharvest.imaging.distortion.calibration.fit import (
    Pose,
    View,
    blurred_spline,
    checked_images,
    fit_views,
    normalised_illumination,
)
from modeharvest.imaging.distortion.calibration.model import (
    CameraModel,
    DistortionModel,
    PolynomialModel,
)
from modeharvest.imaging.distortion.calibration.result import LensEstimate, sampled_noise
from modeharvest.imaging.distortion.lens import CameraDistortion, Distortion
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.util.errors import InputError

_BLURS_PX = (12.0, 6.0, 3.0, 0.7)
_COARSE_POINTS, _COARSE_DEGREE = 30_000, 3
_MARGIN_PX = 8.0
"""Nearer to the edge of the image blur and spline see beyond the edge of the scene."""


def recover_camera(
    undistorted: ArrayLike,
    distorted: ArrayLike,
    model: DistortionModel | None = None,
    mask: ArrayLike | None = None,
    points: int = 200_000,
    order: int = 5,
) -> LensEstimate:
    """Find the lens that shows the scene of one image as another.

    InputError if sizes differ, an image is blank, or the images don't show the same scene.

    undistorted, distorted : (rows, cols) grey levels of one scene.
    model : what the lens may be: a :class:`CameraModel` or a :class:`PolynomialModel` with
        ``fixed=0``. By default an OpenCV camera with unknown cx, cy, k1, k2, k3; its focal length
        is taken as the larger size of the image, because another f with other k is the same S.
    mask, points : (rows, cols) where the undistorted image counts; about how many pixels of it.
    order : of the spline that samples the images: 5 or 3.
    """
    images = checked_images((undistorted, distorted), ("undistorted", "distorted"))
    rows, cols = images[0].shape
    focal = float(max(rows, cols))
    camera = CameraDistortion(focal, focal, 0.5 * (cols - 1), 0.5 * (rows - 1))
    model = model or CameraModel(camera)
    # Far from the solution a cubic is led less astray than a camera or a high degree.
    coarse: DistortionModel = PolynomialModel((rows, cols), _COARSE_DEGREE, fixed=0)
    c, poses = coarse.start, normalised_illumination(images)
    at, _ = _points(rows, cols, _COARSE_POINTS, mask)
    for blur in _BLURS_PX[:-1]:
        fit = fit_views(coarse, c, _views(images, poses, blur, order, False), at, 0.02, 10)
        c = fit.coefficients
    at, stride = _points(rows, cols, points, mask)
    c = _nearest(model, coarse.distortion(c), (rows, cols))
    views = _views(images, poses, _BLURS_PX[-1], order, True)
    fit = fit_views(model, c, views, at, tolerance_px=1e-5)
    if fit.matches.min() < 0.5 or not fit.converged:
        raise InputError(
            "expected two images of one scene, without and with distortion, got a pair whose grey "
            f"levels correlate by {fit.matches.min():.2f} only; check files, or try another model"
        )
    return LensEstimate.of(model, fit, sampled_noise(_BLURS_PX[-1], order, stride))


def _views(
    images: list[FloatImage], poses: Sequence[Pose], blur: float, order: int, light: bool
) -> list[View]:
    """The image without and that with distortion; of the latter the light may change."""
    ideal, observed = (blurred_spline(image, blur, order) for image in images)
    free = (False, False, False, light, light)
    return [View(ideal, poses[0], distorted=False), View(observed, poses[1], free)]


def _nearest(model: DistortionModel, distortion: Distortion, shape: tuple[int, int]) -> FloatArray:
    """Coefficients with which a model comes nearest to a distortion over the image."""
    axes = [np.linspace(0.0, n - 1.0, 21) for n in shape]
    row, col = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    target = np.stack(distortion.shift(row, col))
    scale = model.scale

    def misfit(scaled: FloatArray) -> FloatArray:
        return (np.stack(model.distortion(scaled * scale).shift(row, col)) - target).ravel()

    def slope(scaled: FloatArray) -> FloatArray:
        columns = model.sensitivities(scaled * scale, row, col) * scale[:, None]
        return np.asarray(np.moveaxis(columns, 1, -1).reshape(-1, scale.size))

    found = least_squares(misfit, model.start / scale, slope, method="lm")
    return np.asarray(found.x * scale)


def _points(
    rows: int, cols: int, count: int, mask: ArrayLike | None
) -> tuple[tuple[FloatArray, FloatArray], float]:
    """Pixels of the undistorted image to look at, and their stride [px]."""
    stride = max(1, round(np.sqrt(rows * cols / count)))
    axes: list[FloatArray] = [np.arange(_MARGIN_PX, n - _MARGIN_PX, stride) for n in (rows, cols)]
    row, col = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    if mask is not None:
        inside = np.asarray(mask, dtype=np.bool_)
        if inside.shape != (rows, cols) or not inside.any():
            what = f"a mask of {rows} x {cols} px with something in it"
            raise InputError(f"expected {what}, got {inside.shape}")
        kept = inside[row.astype(np.intp), col.astype(np.intp)]
        return (row[kept], col[kept]), float(stride)
    return (row, col), float(stride)
