"""What one pixel averages: its sensitive area, behind the blur of the lens.

A pixel at x shows ``integral h(t) I(x + t) dt`` of the irradiance I on the sensor, with h the
indicator of a centred square convolved with a Gaussian; t is in pixels of *that* image. In
Fourier space h is a product, ``sinc(a f_row) sinc(a f_col) exp(-2 pi^2 s^2 |f|^2)``, which is
exact on the reference image's pattern. A deformed pattern isn't a sum of plane waves any more:
there the average is a Gauss rule whose weight function is h itself. At the edge of the material
I jumps, and equally weighted points take the rule's place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh_tridiagonal
from scipy.special import ndtr

from modeharvest.errors import InputError

FloatArray = NDArray[np.float64]

EDGE_POINTS = 233  # a Fibonacci number
_GOLDEN = 0.5 * (1.0 + math.sqrt(5.0))
_FINE = 64  # nodes for each of the two convolved parts of h
_THIN = 1e-6  # px: as good as a point
_TAIL = 5.0  # standard deviations of the blur; 6e-7 of it lie beyond


@dataclass(frozen=True)
class Aperture:
    """The weight h with which a pixel averages what falls on the sensor.

    Parameters
    ----------
    fill_factor
        Sensitive part of the pixel's area [-], a centred square: 1 is the whole pixel, 0 a
        point.
    psf_px
        Standard deviation of the lens's Gaussian point spread [px]; 0 is a perfect lens.

    Raises
    ------
    InputError
        If a value is out of its range.
    """

    fill_factor: float = 0.0
    psf_px: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.fill_factor <= 1.0:
            raise InputError(f"sensor: expected a fill factor in 0 ... 1, got {self.fill_factor}")
        if not 0.0 <= self.psf_px <= 2.0:
            raise InputError(
                f"sensor: expected a point spread of 0 to 2 px, got {self.psf_px}; "
                "a pattern that is blurred on the specimen has a larger blur_px"
            )

    @property
    def is_point(self) -> bool:
        """Whether pixels show single points, so that there is nothing to average."""
        return self.fill_factor == 0.0 and self.psf_px == 0.0

    @property
    def side_px(self) -> float:
        """Side of the sensitive square [px]."""
        return math.sqrt(self.fill_factor)

    @property
    def reach_px(self) -> int:
        """How many whole pixels away, along rows or columns, the weight is negligible."""
        return math.ceil(0.5 * self.side_px + _TAIL * self.psf_px)

    def transfer(self, f: ArrayLike) -> FloatArray:
        """Fourier transform of h along one axis at frequencies f [cycles/px]; even, 1 at 0.

        For a plane wave the axes' transfers multiply.
        """
        f = np.asarray(f, dtype=np.float64)
        blur = np.exp(-2.0 * (math.pi * self.psf_px * f) ** 2)
        return np.asarray(np.sinc(self.side_px * f) * blur)

    def rule(self, points: int) -> tuple[FloatArray, FloatArray]:
        """Gauss rule for the weight h along one axis: (nodes [px], weights), each (points,).

        Exact for polynomials up to degree 2 points - 1. With a perfect lens it is the
        Gauss-Legendre rule, with a fill factor of 0 the Gauss-Hermite one.
        """
        nodes, weights = self._fine_rule()
        before, polynomial = np.zeros_like(nodes), np.ones_like(nodes)
        beta = np.zeros(points)
        for k in range(1, points):  # Stieltjes' recurrence; the weight is even
            polynomial, before = nodes * polynomial - beta[k - 1] * before, polynomial
            beta[k] = math.sqrt(weights @ polynomial**2)
            polynomial /= beta[k]
        x, v = eigh_tridiagonal(np.zeros(points), beta[1:])
        return x, v[0] ** 2

    def scattered(self, points: int = EDGE_POINTS) -> FloatArray:
        """(points, 2) offsets (row, col) [px], all of the same weight, that sample h evenly.

        A Fibonacci lattice put through the inverse of h's cumulative sum: no two points share
        a row or a column, so an edge along the pixels is seen as finely as any other. The part
        of a pixel that a straight edge cuts off is off by 0.0047 rms for 233
        points, and by points^(-3/4) of that for other Fibonacci numbers.
        """
        a, s = max(self.side_px, _THIN), max(self.psf_px, _THIN)

        t = np.linspace(-1.0, 1.0, 20_001) * (0.5 * a + 6.0 * s)
        high, low = (t + 0.5 * a) / s, (t - 0.5 * a) / s
        # The normal distribution's cumulative one, integrated: z ndtr(z) + exp(-z^2 / 2) / ...
        bell = (np.exp(-0.5 * high**2) - np.exp(-0.5 * low**2)) / math.sqrt(2.0 * math.pi)
        upto = s / a * (high * ndtr(high) - low * ndtr(low) + bell)
        k = np.arange(points)
        unit = np.stack([k, k * round(points / _GOLDEN) % points], axis=1) + 0.5
        return np.asarray(np.interp(unit / points, upto, t))

    def _fine_rule(self) -> tuple[FloatArray, FloatArray]:
        """Nodes [px] and weights of a fine rule along one axis: square times Gaussian."""
        x, v = np.polynomial.legendre.leggauss(_FINE)
        y, w = np.polynomial.hermite_e.hermegauss(_FINE)
        nodes = 0.5 * self.side_px * x[:, None] + self.psf_px * y
        return nodes.ravel(), np.outer(v / v.sum(), w / w.sum()).ravel()
