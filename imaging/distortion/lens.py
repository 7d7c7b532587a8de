"""Optical distortions: polynomial, OpenCV's camera model, sampled; inverse, undistorted images.

A lens shows the ideal image position p at phi_S(p) = p + S(p), the paper's Eq. (5). Here S is in
px and in the image frame: components along the rows' index (down) and the columns' index (right).
Source of the camera model, here without thin prisms and tilts:
https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html.

:func:`undistorted` computes f(phi_S(x)) of that equation: it resamples each image once on the ideal
pixel grid, so that the correlation of such images needs no lens model.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, require_within

Positions = tuple[FloatArray, FloatArray]
"""(row, col) [px], two arrays of the same shape."""
_BAND = 64
"""Number of rows resampled, or inverted, at a time."""
_CHUNK = 8192
"""Number of points inverted at a time, so that they stay in the cache."""
_SETTLED_PX = 1e-7
"""Newton's method converges quadratically: after so short a step the error is below rounding."""
_STEPS = 30


class Distortion(ABC):
    """A mapping of ideal image positions to the positions observed through a lens.

    Subclasses define :meth:`shift` and :meth:`gradient`; mapping and inverse follow. Positions are
    (row, col) in px, whole numbers at pixel centres, of any shapes that broadcast together; an
    open grid, (rows, 1) and (1, cols), is fastest.
    """

    @abstractmethod
    def shift(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """S: the components (d_row, d_col) [px] at ideal positions [px]."""

    @abstractmethod
    def gradient(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(2, 2, ...) derivatives of S [-]: [component, direction], rows' index before columns'."""

    def observed(self, row: ArrayLike, col: ArrayLike) -> Positions:
        """phi_S: where ideal positions (row, col) are observed [px]."""
        d_row, d_col = self.shift(row, col)
        return np.add(row, d_row), np.add(col, d_col)

    def ideal(self, row: ArrayLike, col: ArrayLike) -> Positions:
        """Invert phi_S: ideal positions of the points observed at (row, col) [px].

        Newton's method, to rounding (better than 1e-10 px); NaN where a position is NaN.
        InputError if the mapping folds, that is, is not one-to-one there.
        """
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        observed = np.stack([row.ravel(), col.ravel()])
        found = np.empty_like(observed)
        for first in range(0, observed.shape[1], _CHUNK):
            part = slice(first, first + _CHUNK)
            found[:, part] = self._newton(observed[:, part])
        return found[0].reshape(row.shape), found[1].reshape(row.shape)

    def _newton(self, observed: FloatArray) -> FloatArray:
        """(2, n) ideal positions of observed positions (2, n) [px]."""
        found = observed - np.stack(self.shift(*observed))
        for _ in range(_STEPS):
            misfit = np.stack(self.observed(*found)) - observed
            (rr, rc), (cr, cc) = self.gradient(*found)
            det = (1.0 + rr) * (1.0 + cc) - rc * cr
            if (det <= 0.0).any():
                raise _folds(observed[:, int(np.argmax(det <= 0.0))])
            found[0] -= ((1.0 + cc) * misfit[0] - rc * misfit[1]) / det
            found[1] -= ((1.0 + rr) * misfit[1] - cr * misfit[0]) / det
            length = np.abs(misfit).max(axis=0) / np.minimum(det, 1.0)
            if not (length > _SETTLED_PX).any():  # NaN counts as settled
                return found
        raise _folds(observed[:, int(np.nanargmax(length))])


def _folds(position: FloatArray) -> InputError:
    return InputError(
        "expected a distortion that is one-to-one over the image, got one that folds at row "
        f"{position[0]:.0f}, column {position[1]:.0f}; check its coefficients and their units"
    )


def require_finite(values: FloatArray, what: str) -> None:
    """Raise InputError if a value of a distortion is NaN or infinite."""
    if not np.isfinite(values).all():
        raise InputError(f"distortion: expected finite {what}, got NaN or infinity")


@dataclass(frozen=True, eq=False)
class PolynomialDistortion(Distortion):
    """S as a polynomial of a total degree, in products of Chebyshev polynomials.

    S(row, col) = sum over i + j <= degree of c_ij T_i(xi) T_j(eta), where xi and eta run from -1 to
    1 from the first to the last column and row. The same polynomial holds beyond the image.
    """

    shape: tuple[int, int]
    """(rows, cols) of the image [px]."""
    coefficients: FloatArray
    """(2, n) c_ij along the row and the column index [px], n = (degree + 1)(degree + 2)/2, in the
    order of i + j, then of j: 1, xi, eta, T_2(xi), xi eta, T_2(eta), ..."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", (int(self.shape[0]), int(self.shape[1])))
        object.__setattr__(self, "coefficients", np.array(self.coefficients, dtype=np.float64))
        if min(self.shape) < 2:
            raise InputError(f"distortion: expected an image of 2 x 2 px or more, got {self.shape}")
        c = self.coefficients
        if c.ndim != 2 or len(c) != 2 or self.size_of(self.degree) != c.shape[1]:
            raise InputError(
                "distortion: expected (2, n) coefficients with n = 1, 3, 6, 10, ... for degree "
                f"0, 1, 2, 3, ..., got shape {c.shape}"
            )
        require_finite(c, "coefficients")

    @staticmethod
    def size_of(degree: int) -> int:
        """Count the coefficients of one component."""
        return (degree + 1) * (degree + 2) // 2

    @staticmethod
    def orders(degree: int) -> tuple[tuple[int, int], ...]:
        """(i, j) of each coefficient: i along the columns' index, j along the rows'."""
        return tuple((total - j, j) for total in range(degree + 1) for j in range(total + 1))

    @property
    def degree(self) -> int:
        """Total degree."""
        return int((np.sqrt(8 * self.coefficients.shape[-1] + 1) - 3) / 2 + 1e-9)

    @cached_property
    def _tables(self) -> tuple[FloatArray, FloatArray]:
        """(2, n, n) coefficients [component, j, i], and (2, 2, n, n) for the derivatives."""
        n, (rows, cols) = self.degree + 1, self.shape
        table = np.zeros((2, n, n))
        i, j = np.array(self.orders(self.degree)).T
        table[:, j, i] = self.coefficients
        slopes = np.zeros((2, 2, n, n))
        if n > 1:
            slopes[:, 0, :-1, :] = chebyshev.chebder(table, axis=1) * (2.0 / (rows - 1))
            slopes[:, 1, :, :-1] = chebyshev.chebder(table, axis=2) * (2.0 / (cols - 1))
        return table, slopes

    def shift(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """S: the components (d_row, d_col) [px] at ideal positions [px]."""
        d_row, d_col = self._evaluate(self._tables[0], row, col)
        return d_row, d_col

    def gradient(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(2, 2, ...) derivatives of S [-]: [component, direction], rows' index before columns'."""
        return self._evaluate(self._tables[1], row, col)

    def basis(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(..., n): every product T_i(xi) T_j(eta), in the order of the coefficients."""
        eta, xi = self._normalised(row, col)
        along_col, along_row = (_powers(t, self.degree) for t in (xi, eta))
        return np.stack([along_col[i] * along_row[j] for i, j in self.orders(self.degree)], axis=-1)

    def _normalised(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        rows, cols = self.shape
        eta = 2.0 * np.asarray(row, dtype=np.float64) / (rows - 1) - 1.0
        xi = 2.0 * np.asarray(col, dtype=np.float64) / (cols - 1) - 1.0
        return eta, xi

    def _evaluate(self, tables: FloatArray, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(..., positions) polynomials with coefficients (..., n, n), by matrix products."""
        eta, xi = self._normalised(row, col)
        along_row, along_col = _powers(eta, self.degree), _powers(xi, self.degree)
        partial = np.tensordot(tables, along_col, axes=1)  # (..., j, positions of col)
        if eta.ndim == 2 and eta.shape[1] == 1 and xi.shape[:1] == (1,):
            return np.asarray(along_row[:, :, 0].T @ partial[..., 0, :])
        axis = tables.ndim - 2
        total = np.take(partial, 0, axis) * along_row[0]
        for j in range(1, len(along_row)):
            total = total + np.take(partial, j, axis) * along_row[j]
        return np.asarray(total)


def _powers(t: FloatArray, degree: int) -> FloatArray:
    """T_0(t) ... T_degree(t), stacked along a new first axis."""
    values = chebyshev.chebvander(t, degree).reshape(*t.shape, degree + 1)
    return np.ascontiguousarray(np.moveaxis(values, -1, 0))


@dataclass(frozen=True)
class CameraDistortion(Distortion):
    """The lens of OpenCV's camera model (Brown-Conrady, with its rational extension).

    With x = (col - cx) / fx, y = (row - cy) / fy and r^2 = x^2 + y^2 an ideal position appears at

        x' = x q + 2 p1 x y + p2 (r^2 + 2 x^2),   y' = y q + p1 (r^2 + 2 y^2) + 2 p2 x y,
        q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),

    col' = cx + fx x', row' = cy + fy y'. The ideal image has the same fx, fy, cx, cy.
    """

    fx: float
    fy: float
    """Focal lengths [px]."""
    cx: float
    cy: float
    """Principal point, column and row [px]; whole numbers are pixel centres, as in OpenCV."""
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    """Coefficients [-], in OpenCV's order."""

    def __post_init__(self) -> None:
        require_finite(np.array(astuple(self)), "camera parameters")
        for focal in (self.fx, self.fy):
            require_within("distortion: expected focal lengths", focal, 0.0, above=True)

    def normalised(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """x and y of image positions [-]."""
        x: FloatArray = np.subtract(col, self.cx, dtype=np.float64) / self.fx
        y: FloatArray = np.subtract(row, self.cy, dtype=np.float64) / self.fy
        return x, y

    def radial(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Numerator and denominator of q, each minus 1, at s = r^2."""
        top = s * (self.k1 + s * (self.k2 + s * self.k3))
        return top, s * (self.k4 + s * (self.k5 + s * self.k6))

    def shift(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """S: the components (d_row, d_col) [px] at ideal positions [px]."""
        x, y = self.normalised(row, col)
        x2, y2, xy = x * x, y * y, x * y
        s = x2 + y2
        top, below = self.radial(s)
        more = (top - below) / (1.0 + below)  # q - 1 without cancellation
        d_col = self.fx * (x * more + 2.0 * self.p1 * xy + self.p2 * (s + 2.0 * x2))
        d_row = self.fy * (y * more + self.p1 * (s + 2.0 * y2) + 2.0 * self.p2 * xy)
        return np.asarray(d_row), np.asarray(d_col)

    def gradient(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(2, 2, ...) derivatives of S [-]: [component, direction], rows' index before columns'."""
        x, y = np.broadcast_arrays(*self.normalised(row, col))
        s = x * x + y * y
        top, below = self.radial(s)
        more = (top - below) / (1.0 + below)
        d_top = self.k1 + s * (2.0 * self.k2 + 3.0 * s * self.k3)
        d_below = self.k4 + s * (2.0 * self.k5 + 3.0 * s * self.k6)
        slope = 2.0 * (d_top - (1.0 + more) * d_below) / (1.0 + below)  # dq/dx = slope x
        p1, p2 = self.p1, self.p2
        xx = more + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        yy = more + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        aspect = self.fy / self.fx
        return np.array([[yy, aspect * xy], [xy / aspect, xx]])


@dataclass(frozen=True, eq=False)
class SampledDistortion(Distortion):
    """S sampled on a grid: bicubic spline interpolation, linear extrapolation outside."""

    rows: FloatArray
    cols: FloatArray
    """(n,) and (m,) positions of the grid lines [px], ascending, at least 4 of each."""
    field: FloatArray
    """(2, n, m) S along the row and the column index [px]."""

    def __post_init__(self) -> None:
        for name in ("rows", "cols", "field"):
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64))
            require_finite(getattr(self, name), name)
        axes, shape = (self.rows, self.cols), (2, self.rows.size, self.cols.size)
        if any(a.ndim != 1 or a.size < 4 or (np.diff(a) <= 0).any() for a in axes):
            raise InputError(
                "distortion: expected at least 4 ascending rows and cols of a sampled field [px], "
                f"got {self.rows.size} and {self.cols.size}"
            )
        if self.field.shape != shape:
            what = f"a field of shape {shape} like its rows and cols"
            raise InputError(f"distortion: expected {what}, got {self.field.shape}")

    @cached_property
    def _splines(self) -> list[RectBivariateSpline]:
        return [RectBivariateSpline(self.rows, self.cols, f, s=0) for f in self.field]

    def _evaluate(
        self, row: ArrayLike, col: ArrayLike, orders: tuple[tuple[int, int], ...]
    ) -> tuple[list[tuple[FloatArray, ...]], FloatArray, FloatArray]:
        """Derivatives of both components at the nearest point of the grid, and its distance."""
        row, col = np.asarray(row, dtype=np.float64), np.asarray(col, dtype=np.float64)
        near_row = np.clip(row, self.rows[0], self.rows[-1])
        near_col = np.clip(col, self.cols[0], self.cols[-1])
        is_grid = row.ndim == 2 and row.shape[1] == 1 and col.shape[:1] == (1,)
        found = []
        for spline in self._splines:
            if is_grid and (np.diff(row[:, 0]) > 0).all() and (np.diff(col[0]) > 0).all():
                # Clipped axes don't ascend strictly, which the spline allows.
                at = near_row[:, 0], near_col[0]
                values = tuple(spline(*at, dx=i, dy=j) for i, j in orders)
            else:
                values = tuple(spline.ev(near_row, near_col, dx=i, dy=j) for i, j in orders)
            found.append(values)
        return found, row - near_row, col - near_col

    def shift(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """S: the components (d_row, d_col) [px] at ideal positions [px]."""
        found, dr, dc = self._evaluate(row, col, ((0, 0), (1, 0), (0, 1), (1, 1)))
        d_row, d_col = (s + s_r * dr + (s_c + s_rc * dr) * dc for s, s_r, s_c, s_rc in found)
        return d_row, d_col

    def gradient(self, row: ArrayLike, col: ArrayLike) -> FloatArray:
        """(2, 2, ...) derivatives of S [-]: [component, direction], rows' index before columns'."""
        found, dr, dc = self._evaluate(row, col, ((1, 0), (0, 1), (1, 1)))
        return np.array([[s_r + s_rc * dc, s_c + s_rc * dr] for s_r, s_c, s_rc in found])


def undistorted(image: ArrayLike, distortion: Distortion, order: int = 5) -> NDArray[np.float32]:
    """Undistort an image (rows, cols): f(phi_S(x)) at pixels x of the ideal grid.

    Where phi_S(x) lies outside the photograph, the grey level is that of its nearest pixel, and
    :func:`undistorted_mask` is False. ``order``: of the B-spline that interpolates the
    photograph. InputError if the image isn't two-dimensional, or the order isn't available.
    """
    spline = SplineImage.of(image, order)
    rows, cols = spline.shape
    result = np.empty(spline.shape, dtype=np.float32)
    for first in range(0, rows, _BAND):
        row, col = _observed_from(distortion, spline.shape, slice(first, first + _BAND))
        np.clip(row, 0, rows - 1, out=row)
        np.clip(col, 0, cols - 1, out=col)
        result[first : first + _BAND] = spline.sample(row, col)[0]
    return result


def undistorted_mask(mask: ArrayLike, distortion: Distortion) -> NDArray[np.bool_]:
    """Undistort a mask (rows, cols), by the value at the nearest pixel of the photograph.

    All True gives the pixels of the ideal grid that were photographed. InputError unless 2-D.
    """
    inside = np.asarray(mask, dtype=np.bool_)
    if inside.ndim != 2:
        raise InputError(f"expected a mask of shape (rows, cols), got {inside.shape}")
    rows, cols = inside.shape
    result = np.zeros(inside.shape, dtype=np.bool_)
    for first in range(0, rows, _BAND):
        band = slice(first, first + _BAND)
        row, col = _observed_from(distortion, inside.shape, band)
        kept = (row >= 0) & (row <= rows - 1) & (col >= 0) & (col <= cols - 1)
        i, j = (np.rint(a[kept]).astype(np.intp) for a in (row, col))
        result[band][kept] = inside[i, j]
    return result


def _observed_from(distortion: Distortion, shape: tuple[int, ...], band: slice) -> Positions:
    """phi_S at the pixels of a band of rows."""
    row = np.arange(shape[0], dtype=np.float64)[band, None]
    col = np.arange(shape[1], dtype=np.float64)[None, :]
    return distortion.observed(row, col)


def apart_without_affine(
    found: Distortion, true: Distortion, row: ArrayLike, col: ArrayLike
) -> FloatArray:
    """(2, ...) S_found - S_true [px] at positions (row, col) [px] that broadcast together.

    The affine part of the difference, which is not observable, is subtracted.
    """
    row, col = np.broadcast_arrays(row, col)
    apart = np.stack(found.shift(row, col)) - np.stack(true.shift(row, col))
    basis = np.column_stack([np.ones(row.size), row.ravel(), col.ravel()])
    flat = apart.reshape(2, -1).T
    affine = basis @ np.linalg.lstsq(basis, flat, rcond=None)[0]
    return np.asarray((flat - affine).T.reshape(apart.shape))


def ideal_points(distortion: Distortion, shape: tuple[int, int]) -> Positions:
    """Ideal positions (row, col) of the pixels, each (rows, cols) [px]; InputError if S folds."""
    row, col = np.ogrid[: shape[0], : shape[1]]
    strips = [slice(k, k + _BAND) for k in range(0, shape[0], _BAND)]
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        found = list(pool.map(lambda strip: distortion.ideal(row[strip], col), strips))
    return np.concatenate([r for r, _ in found]), np.concatenate([c for _, c in found])


_DEGREE = 9
_NEGLIGIBLE_PX = 1e-12


def without_affine(distortion: Distortion, shape: tuple[int, int]) -> PolynomialDistortion:
    """The distortion without its affine part over images of (rows, cols) px, as a polynomial.

    The terms 1, xi, eta of its Chebyshev series over the image are left out, and so are negligible
    terms of the highest degrees. Exact for lenses that are polynomials of degree 9 or less (those
    with k1 ... k3, p1, p2 only).
    """
    nodes = chebyshev.chebpts1(_DEGREE + 1)
    row, col = (0.5 * (n - 1) * (1.0 + nodes) for n in shape)
    fields = distortion.shift(row[:, None], col[None, :])
    transform = chebyshev.chebvander(nodes, _DEGREE) * 2.0 / (_DEGREE + 1)
    transform[:, 0] *= 0.5
    series = [transform.T @ np.broadcast_to(f, (nodes.size,) * 2) @ transform for f in fields]
    orders = PolynomialDistortion.orders(_DEGREE)
    coefficients = np.array([[s[j, i] for i, j in orders] for s in series])
    coefficients[:, :3] = 0.0
    is_large = np.abs(coefficients).max(axis=0) > _NEGLIGIBLE_PX
    degree = int(np.max(np.sum(orders, axis=1)[is_large], initial=0))
    return PolynomialDistortion(shape, coefficients[:, : PolynomialDistortion.size_of(degree)])
