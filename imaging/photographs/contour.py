"""Contours in photographs: smooth curves, the distance of points from them, shapes of holes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from modeharvest.util.arrays import FloatArray

_FINE_PX = 0.25
"""Between the points of a contour among which the nearest is sought."""


def signed_area(points: FloatArray) -> float:
    """Of a polygon (n, 2): positive where x, y go around it anticlockwise."""
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
    def _fine(self) -> tuple[FloatArray, cKDTree]:
        step = _FINE_PX * self.length / len(self.points)
        s = np.linspace(0.0, self.length, int(self.length / step), endpoint=not self.closed)
        return np.asarray(s, dtype=np.float64), cKDTree(self._curve(s))

    @cached_property
    def moments(self) -> tuple[float, FloatArray, FloatArray]:
        """Signed area [mm^2], centroid (2,) [mm], second central moments (2, 2) over it [mm^2]."""
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
        """Points (n, 2) about so far apart along the curve, at least 16, and their distance."""
        count = max(16, round(self.length / step))
        step = self.length / (count if self.closed else count - 1)
        return self._curve(np.arange(count) * step), step

    def distance(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) signed distance of points (n, 2) from the curve [mm], and (n, 2) its gradient.

        NaN and 0 beyond the ends of a curve that is cut.
        """
        fine, tree = self._fine
        s, step = fine[tree.query(x)[1]], self.length / len(self.points)
        for _ in range(3):
            off, along, bent = self._curve(s) - x, self._curve(s, 1), self._curve(s, 2)
            square = (along**2).sum(axis=1)
            slope = square + (off * bent).sum(axis=1)
            slope = np.where(slope > 0.2 * square, slope, square)
            s = s - np.clip((off * along).sum(axis=1) / slope, -step, step)
            s = np.mod(s, self.length) if self.closed else np.clip(s, 0.0, self.length)
        along, off = self._curve(s, 1), x - self._curve(s)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
        d = (off * normal).sum(axis=1)
        if not self.closed:
            beyond = np.abs((off * along).sum(axis=1)) > step
            d[beyond], normal[beyond] = np.nan, 0.0
        return d, normal


@dataclass(frozen=True, eq=False)
class SeenContours:
    """Contours of one and the same edges in two images."""

    reference: tuple[Contour, ...]
    deformed: tuple[Contour, ...]
    """One after the other, gone along in the same sense [mm]."""
    noise: float
    """Variance of their distance times the length over which it is correlated [mm^3]."""
    correlated: float
    """That length [mm]."""
    dots: tuple[tuple[Contour, Contour], ...] = ()
    """Around marks on the material, in the reference and in the deformed image [mm]."""


@dataclass(frozen=True)
class HoleShape:
    """A hole's shape, by the moments of its contour."""

    x: float
    y: float
    """Its centre [mm]."""
    area: float
    """[mm^2]."""
    ellipticity: float
    """1 less the ratio of the ellipse's axes that has the same second moments [-]."""
    orientation_deg: float
    """Of the longer axis, from x, anticlockwise, -90 to 90 [degrees]."""

    @classmethod
    def of(cls, contour: Contour) -> HoleShape:
        """Of a contour [mm]."""
        area, (x, y), second = contour.moments
        values, vectors = np.linalg.eigh(second)
        along = vectors[:, 1] * np.sign(vectors[0, 1] or 1.0)
        ratio = float(np.sqrt(values[0] / values[1]))
        angle = float(np.degrees(np.arctan2(along[1], along[0])))
        return cls(float(x), float(y), abs(area), 1.0 - ratio, angle)
