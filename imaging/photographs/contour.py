"""Contours in photographs: smooth curves, distances of points from them, shapes of holes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from modeharvest.util.arrays import BoolArray, FloatArray, IntArray

_FINER = 0.25
"""Spacing of the trial points for the nearest point, relative to that of the contour's points."""


def signed_area(points: FloatArray) -> float:
    """Signed area of a polygon (n, 2): positive if its points run anticlockwise (x right, y up)."""
    after = np.roll(points, -1, axis=0)
    return 0.5 * float(np.sum(points[:, 0] * after[:, 1] - points[:, 1] * after[:, 0]))


class Contour:
    """A smooth curve through points (n, 2) [mm], each once; closed, or cut by an image's border."""

    def __init__(self, points: FloatArray, closed: bool = True) -> None:
        through = np.vstack([points, points[:1]]) if closed else points
        length = np.linalg.norm(np.diff(through, axis=0), axis=1)
        keep = np.append(length > 1e-3 * np.median(length), True)
        through, s = through[keep], np.concatenate([[0.0], np.cumsum(length[keep[:-1]])])
        if closed:
            through[-1] = through[0]
        self.points = np.asarray(through[:-1] if closed else through, np.float64)
        self.length, self.closed = float(s[-1]), closed
        self._curve = CubicSpline(s, through, bc_type="periodic" if closed else "not-a-knot")

    @cached_property
    def moments(self) -> tuple[float, FloatArray, FloatArray]:
        """Signed area [mm^2], centroid (2,) [mm], second central moments (2, 2) / area [mm^2]."""
        p, q = self.points, np.roll(self.points, -1, axis=0)
        cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
        area = signed_area(p)
        centre = (p + q).T @ cross / (6.0 * area)
        a, b = p - centre, q - centre
        around = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        pairs = np.einsum("ni,nj->nij", a + b, a + b) + np.einsum("ni,nj->nij", a, a)
        second = np.einsum("nij,n->ij", pairs + np.einsum("ni,nj->nij", b, b), around)
        return area, np.asarray(centre, np.float64), np.asarray(second / (24.0 * area))

    def evenly(self, step: float) -> tuple[FloatArray, float]:
        """(n, 2) equidistant points on the curve, n >= 16, about ``step`` apart; their spacing."""
        count = max(16, round(self.length / step))
        step = self.length / (count if self.closed else count - 1)
        return self._curve(np.arange(count) * step), step

    def _dense_lengths(self) -> FloatArray:
        """(k,) arc lengths [mm] of the trial points for the nearest point of the curve."""
        step = _FINER * self.length / len(self.points)
        count = int(self.length / step)
        return np.linspace(0.0, self.length, count, endpoint=not self.closed, dtype=np.float64)


class Contours:
    """Several contours, to compute at once the distance of each point from its contour."""

    def __init__(self, contours: Sequence[Contour]) -> None:
        self.length = np.array([contour.length for contour in contours])
        self.is_cut = np.array([not contour.closed for contour in contours])
        self.step = self.length / [len(contour.points) for contour in contours]
        # All contours share one arc-length axis s, one after the other with gaps between them.
        self._begin = 2.0 * np.cumsum(self.length) - self.length
        curves, fine = [c._curve for c in contours], [c._dense_lengths() for c in contours]
        pairs = zip(self._begin, curves, strict=True)
        self._knots = np.concatenate([s + c.x[:-1] for s, c in pairs])
        self._coefficients = np.concatenate([c.c for c in curves], axis=1)
        self._fine = np.concatenate(fine)
        points = np.vstack([c(s) for c, s in zip(curves, fine, strict=True)])
        self._far = 10.0 * float(np.ptp(points, axis=0).max() + self.length.max())
        number = np.repeat(np.arange(len(fine)), [len(s) for s in fine])
        self._tree = cKDTree(self._separated(points, number))

    def _separated(self, x: FloatArray, number: IntArray) -> FloatArray:
        """(n, 3) points x (n, 2) with a third coordinate that separates different contours."""
        return np.column_stack([x, self._far * number])

    def _at(self, s: FloatArray, number: IntArray) -> tuple[FloatArray, ...]:
        """(n, 2) points of the contours at arc length s, and first and second derivatives by s."""
        at = self._begin[number] + s
        piece = np.searchsorted(self._knots, at, "right") - 1
        (a, b, c, d), t = self._coefficients[:, piece], (at - self._knots[piece])[:, None]
        return ((a * t + b) * t + c) * t + d, (3.0 * a * t + 2.0 * b) * t + c, 6.0 * a * t + 2.0 * b

    def distance(self, x: FloatArray, number: IntArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """(n,) signed distance of points x (n, 2) from their contours [mm]; (n, 2) its gradient.

        Third, (n,) True where the point lies beyond the end of an open contour: the distance is
        from the tangent there. ``number`` (n,): index of each point's contour.
        """
        s = self._fine[self._tree.query(self._separated(x, number))[1]]
        step, length, is_cut = self.step[number], self.length[number], self.is_cut[number]
        for _ in range(3):
            there, along, bent = self._at(s, number)
            off, square = there - x, (along**2).sum(axis=1)
            slope = square + (off * bent).sum(axis=1)
            slope = np.where(slope > 0.2 * square, slope, square)
            s = s - np.clip((off * along).sum(axis=1) / slope, -step, step)
            s = np.where(is_cut, np.clip(s, 0.0, length), np.mod(s, length))
        there, along, _ = self._at(s, number)
        along, off = along / np.linalg.norm(along, axis=1, keepdims=True), x - there
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
        d = (off * normal).sum(axis=1)
        return d, normal, is_cut & (np.abs((off * along).sum(axis=1)) > step)


@dataclass(frozen=True, eq=False)
class SeenContours:
    """Contours of the same edges in a reference and a deformed image."""

    reference: tuple[Contour, ...]
    deformed: tuple[Contour, ...]
    """Contours in corresponding order, traversed in the same sense [mm]."""
    noise: float
    """Variance of the contours' distance times its correlation length [mm^3]."""
    correlated: float
    """Correlation length of that noise [mm]."""
    dots: tuple[tuple[Contour, Contour], ...] = ()
    """Contours of marks on the material, in the reference and in the deformed image [mm]."""
    is_part: bool = False
    """Whether the border of the reference image cuts the body."""


@dataclass(frozen=True)
class HoleShape:
    """A hole's shape, from the moments of its contour."""

    x: float
    y: float
    """Centroid [mm]."""
    area: float
    """Area [mm^2]."""
    ellipticity: float
    """1 - b / a, with b / a the axes' ratio of the ellipse with the same second moments [-]."""
    orientation_deg: float
    """Angle from x to the longer axis, anticlockwise, -90 to 90 [degrees]."""

    @classmethod
    def of(cls, contour: Contour) -> HoleShape:
        """The shape of a contour [mm]."""
        area, (x, y), second = contour.moments
        values, vectors = np.linalg.eigh(second)
        along = vectors[:, 1] * np.sign(vectors[0, 1] or 1.0)
        ratio = float(np.sqrt(values[0] / values[1]))
        angle = float(np.degrees(np.arctan2(along[1], along[0])))
        return cls(float(x), float(y), abs(area), 1.0 - ratio, angle)
