"""A lens from two images of one scene, without and with its distortion; used by distortion.py.

Such pairs are computed, or taken through two lenses one of which is ideal. The target doesn't move,
so all of S is observable, its affine part included. The fit that calibrations use can therefore be
compared with a known camera (docs/how-to/distortion.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from modeharvest.imaging.distortion.calibrate import LensEstimate
from modeharvest.imaging.distortion.fit import (
    PolynomialModel,
    View,
    blurred_spline,
    checked_images,
    fit_views,
    normalised_illumination,
    sampled_noise,
)
from modeharvest.imaging.distortion.lens import CameraDistortion, Distortion
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

_BLURS_PX = (12.0, 6.0, 3.0, 0.7)
_COARSE_POINTS, _COARSE_DEGREE = 30_000, 3
_MARGIN_PX = 8.0
"""Margin along the image's edge, where blur and spline use values beyond the scene."""


@dataclass(frozen=True)
class CameraModel:
    """A camera, some parameters of which are unknown; coefficients change S by about 1 px each.

    It is used in place of a :class:`PolynomialModel`.
    """

    camera: CameraDistortion
    """The known parameters, and initial values of the unknown ones."""
    unknown: tuple[str, ...] = ("cx", "cy", "k1", "k2", "k3")
    """Names among cx, cy and k1 ... p2; not focal lengths: with other k they give the same S."""

    def __post_init__(self) -> None:
        known = tuple(f.name for f in fields(CameraDistortion))[2:]
        if not self.unknown or not set(self.unknown) <= set(known):
            what = f"unknown camera parameters among {known}"
            raise InputError(f"expected {what}, got {self.unknown}")

    @property
    def scale(self) -> FloatArray:
        """(k,) changes of the parameters that change S by about 1 px at the image's corner."""
        row, col = np.zeros(1), np.zeros(1)  # the upper left one
        slopes = [np.abs(self._slope(n, row, col)).max() for n in self.unknown]
        return 1.0 / np.maximum(slopes, 1e-3)

    @property
    def start(self) -> FloatArray:
        """(k,) coefficients of the camera given."""
        return np.array([getattr(self.camera, name) for name in self.unknown]) / self.scale

    def distortion(self, c: FloatArray) -> CameraDistortion:
        """The camera with these coefficients."""
        parameters = map(float, c * self.scale)
        return replace(self.camera, **dict(zip(self.unknown, parameters, strict=True)))

    def sensitivities(self, c: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
        """(2, k, n) derivatives of S(row, col) [px] with respect to the coefficients."""
        model = replace(self, camera=self.distortion(c))
        slopes = np.stack([model._slope(name, row, col) for name in self.unknown], axis=1)
        return np.asarray(slopes * self.scale[:, None])

    def _slope(self, name: str, row: FloatArray, col: FloatArray) -> FloatArray:
        """(2, n) derivative of S with respect to one parameter."""
        if name in ("cx", "cy"):  # S depends on p - c alone
            return -self.camera.gradient(row, col)[:, 0 if name == "cy" else 1]
        lens = self.camera
        x, y = lens.normalised(row, col)
        s = x * x + y * y
        if name == "p1":
            return np.stack([lens.fy * (s + 2 * y * y), lens.fx * 2 * x * y])
        if name == "p2":
            return np.stack([lens.fy * 2 * x * y, lens.fx * (s + 2 * x * x)])
        top, below = (1.0 + part for part in lens.radial(s))
        power = {"k1": s, "k2": s**2, "k3": s**3, "k4": s, "k5": s**2, "k6": s**3}[name]
        slope = power / below if name in ("k1", "k2", "k3") else -power * top / below**2
        return np.stack([lens.fy * y * slope, lens.fx * x * slope])


def recover_camera(
    undistorted: ArrayLike,
    distorted: ArrayLike,
    model: CameraModel | PolynomialModel | None = None,
    mask: ArrayLike | None = None,
    points: int = 200_000,
    order: int = 5,
) -> LensEstimate:
    """Find the lens from two images of one scene, without and with its distortion.

    InputError if sizes differ, an image is blank, or the images don't show the same scene.

    undistorted, distorted : (rows, cols) grey levels of one scene.
    model : form of the lens: a :class:`CameraModel` or a :class:`PolynomialModel` with
        ``fixed=0``. By default an OpenCV camera with unknown cx, cy, k1, k2, k3; its focal length
        is taken as the larger size of the image, because another f with other k is the same S.
    mask, points : (rows, cols) True where the undistorted image is used; about how many pixels.
    order : of the spline that samples the images: 5 or 3.
    """
    images = checked_images((undistorted, distorted), ("undistorted", "distorted"))
    rows, cols = images[0].shape
    focal = float(max(rows, cols))
    lens = CameraDistortion(focal, focal, 0.5 * (cols - 1), 0.5 * (rows - 1))
    wanted: Any = model or CameraModel(lens)
    # Far from the solution a cubic is more robust than a camera or a high degree.
    coarse = PolynomialModel((rows, cols), _COARSE_DEGREE, fixed=0)
    c, poses = coarse.start, normalised_illumination(images)
    at, _ = _points(rows, cols, _COARSE_POINTS, mask)
    for blur in _BLURS_PX[:-1]:
        fit = fit_views(coarse, c, _views(images, poses, blur, order, False), at, 0.02, 10)
        c = fit.coefficients
    at, stride = _points(rows, cols, points, mask)
    c = _nearest(wanted, coarse.distortion(c), (rows, cols))
    views = _views(images, poses, _BLURS_PX[-1], order, True)
    fit = fit_views(wanted, c, views, at, tolerance_px=1e-5)
    if fit.matches.min() < 0.5 or not fit.converged:
        raise InputError(
            "expected two images of one scene, without and with distortion, got a pair whose grey "
            f"levels correlate by {fit.matches.min():.2f} only; check files, or try another model"
        )
    return LensEstimate.of(wanted, fit, sampled_noise(_BLURS_PX[-1], order, stride))


def _views(
    images: Sequence[NDArray[np.float32]], poses: FloatArray, blur: float, order: int, light: bool
) -> list[View]:
    """Views of the images without and with distortion; ``light``: gain and offset are free."""
    ideal, observed = (blurred_spline(image, blur, order) for image in images)
    free = (False, False, False, light, light)
    return [View(ideal, poses[0], distorted=False), View(observed, poses[1], free)]


def _nearest(model: Any, distortion: Distortion, shape: tuple[int, int]) -> FloatArray:
    """Coefficients of a model that is nearest to a distortion over the image."""
    axes = [np.linspace(0.0, n - 1.0, 21) for n in shape]
    row, col = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    target = np.stack(distortion.shift(row, col))

    def misfit(c: FloatArray) -> FloatArray:
        return np.asarray((np.stack(model.distortion(c).shift(row, col)) - target).ravel())

    def slope(c: FloatArray) -> FloatArray:
        columns = model.sensitivities(c, row, col)
        return np.asarray(np.moveaxis(columns, 1, -1).reshape(-1, c.size))

    return np.asarray(least_squares(misfit, model.start, slope, method="lm").x)


def _points(
    rows: int, cols: int, count: int, mask: ArrayLike | None
) -> tuple[tuple[FloatArray, FloatArray], float]:
    """Rows and columns of the pixels of the undistorted image that are used; their stride [px]."""
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
