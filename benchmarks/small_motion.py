"""Bias and scatter of small motions under noise, compared with standard errors and the bound.

The bias by interpolated noise depends on positions between pixels. Motions of many pixels average
it out; small ones don't. Here images move by 0, 0.125 ... 1 px along x, along y and both ways, and
stretch by 0.1 to 1 %; noise is in both images or in one; speckles are 3 to 12 px wide; polynomials
are of degree 1 to 5. Noise is used as n and as -n: the mean of the two errors shows a bias that the
scatter would hide. 55 minutes of processor time; table: docs/explanation/metrology.md.

The truth is in the ansatz, so that noise is the only error. The Cramer-Rao bound uses the pattern's
exact gradient. Scatter over a few realisations is mostly chance. Errors are therefore divided by
those of the efficient linear estimator under the same noise, which is at the bound on average: I^-1
(sum J n_f over the pixels of f - sum J n_g/det F over those of g), I = sum J J'. Every motion has
its own noise. If the variance of an estimator is a share e above the bound, its error has an
additional, uncorrelated part of that variance, and the ratio of chi squared to the efficient one's
scatters by 2 sqrt(e/n) for n independent errors. This standard error, estimated from the scatter of
the pairs, follows each ratio. "Least squares" uses the deformed image's gradient, and a quintic
spline for all speckles.

Run: scripts/env python benchmarks/small_motion.py [--pairs 8] [--step 0.125] [--only TEXT]
     [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import FULL, eroded
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec

FloatArray = NDArray[np.float64]

PIXEL = 0.01
GRID = PixelGrid.centred(220, 300, PIXEL)
BORDER_PX = 24
EVERY = 8
PAPER_PX = 12.0
"""Size of the default speckle [px]."""
LEAST_SQUARES = {"gradient": "deformed", "gradient_blur_px": 0.0, "order": 5}
BLURRED = {"gradient": "deformed", "order": 5}


@dataclass(frozen=True)
class Row:
    """One row of the table.

    Parameters
    ----------
    in_f, in_g
        Noise [fraction of full scale].
    width_px
        Full width at half maximum of the speckle's autocorrelation [px].
    degree
        Degree of the polynomials.
    options
        Options of the correlation that aren't the defaults.
    """

    in_f: float
    in_g: float
    width_px: float = PAPER_PX
    degree: int = 1
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name in the table."""
        where = "both" if self.in_f and self.in_g else "f" if self.in_f else "g"
        blurred = ", deformed image's gradient, blurred" if self.options else ""
        how = ", least squares" if self.options == LEAST_SQUARES else blurred
        if self.options.get("gradient") == "reference":
            how = f", blur of {self.options['gradient_blur_px']:g} px"
        noise = 100 * max(self.in_f, self.in_g)
        return f"{noise:g} % in {where}, {self.width_px:g} px, degree {self.degree}{how}"


ROWS = (
    *(Row(s, s) for s in (0.002, 0.005, 0.01, 0.02, 0.04)),
    *(Row(s, 0.0) for s in (0.002, 0.01, 0.04)),
    *(Row(0.0, s) for s in (0.002, 0.01, 0.04)),
    *(Row(0.01, 0.01, PAPER_PX, degree) for degree in (2, 3, 4, 5)),
    *(
        Row(f * s, g * s, width)
        for width in (3.0, 4.0, 6.0)
        for f, g in ((1, 1), (1, 0), (0, 1))
        for s in (0.002, 0.01, 0.04)
    ),
    *(
        Row(0.002 * f, 0.002 * g, 3.0, degree)
        for degree in (4, 5)
        for f, g in ((1, 1), (1, 0), (0, 1))
    ),
    *(Row(s, s, 6.0, degree) for degree in (3, 5) for s in (0.01, 0.04)),
    *(Row(s, s, 8.0) for s in (0.002, 0.01, 0.04)),
    *(Row(s, s, options=LEAST_SQUARES) for s in (0.002, 0.01, 0.04)),
    Row(0.0, 0.01, options=LEAST_SQUARES),
    *(Row(0.01, 0.01, width, options=LEAST_SQUARES) for width in (3.0, 6.0)),
    *(Row(in_f, 0.01, options=BLURRED) for in_f in (0.01, 0.0)),
    *(
        Row(0.002, 0.002, 3.0, options={"gradient": "reference", "gradient_blur_px": blur})
        for blur in (0.6, 0.75)
    ),
)


MASK: NDArray[np.bool_] = np.zeros(GRID.shape, dtype=np.bool_)
MASK[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
USED = np.nonzero(eroded(MASK, CorrelationOptions().edge_px))
"""Rows and columns of the pixels that a correlation compares."""
AT = GRID.x[USED[1], None], GRID.y[USED[0], None]  # two-dimensional: points, not axes


@dataclass(frozen=True)
class Motion:
    """A translation, and a stretch along x.

    Parameters
    ----------
    dx_px, dy_px
        Along x and y [px].
    strain
        [-].
    """

    dx_px: float
    dy_px: float
    strain: float

    @property
    def came_from(self) -> tuple[FloatArray, FloatArray]:
        """(rows, cols) x and y before the motion of the points that the pixels of g show [mm]."""
        across, up = np.meshgrid(GRID.x, GRID.y)
        return (across - self.dx_px * PIXEL) / (1.0 + self.strain), up - self.dy_px * PIXEL

    @property
    def shown(self) -> NDArray[np.bool_]:
        """(rows, cols) True on pixels of g that show the area of the compared pixels of f."""
        inside = np.ones(GRID.shape, dtype=np.bool_)
        for at, own in zip(GRID.to_px(*self.came_from), USED, strict=True):
            inside &= (own.min() - 0.5 <= at) & (at < own.max() + 0.5)
        return inside

    def displacement(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(..., 2) displacement of points x, y before the motion [mm]."""
        return np.stack([self.dx_px * PIXEL + self.strain * x, np.full_like(y, self.dy_px * PIXEL)],
                        axis=-1)  # fmt: skip


def motions(step: float) -> Iterator[Motion]:
    """Translations along x, along y and both ways, and stretches."""
    for k in range(round(1.0 / step) + 1):
        yield Motion(step * k, 0.0, 0.0)
        yield Motion(0.0, step * k, 0.0)
        yield Motion(step * k, step * k, 0.0)
    for strain in (0.001, 0.002, 0.005, 0.01):
        yield Motion(0.0, 0.0, strain)


@lru_cache(maxsize=64)
def speckle(width_px: float, seed: int) -> Speckle:
    """The default speckle, scaled to a size of ``width_px``."""
    scale = width_px / PAPER_PX
    spec = SpeckleSpec(standard_deviation=0.05 / scale, blur_px=3.0 * scale, seed=seed)
    return Speckle(spec, GRID.shape)


@lru_cache(maxsize=64)
def slopes(width_px: float, seed: int) -> FloatArray:
    """(2, pixels) exact derivatives of f along rows and columns at compared pixels [1/px]."""
    return np.asarray(speckle(width_px, seed).gradient(*USED))


@lru_cache(maxsize=256)
def moved(width_px: float, seed: int, motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Exact g, and (2, pixels) derivatives before the motion at its compared pixels [1/px]."""
    pattern, came_from = speckle(width_px, seed), GRID.to_px(*motion.came_from)
    return pattern.exact(*came_from), np.asarray(
        pattern.gradient(*(at[motion.shown] for at in came_from))
    )


@dataclass(frozen=True, eq=False)
class Measured:
    """The errors under one motion.

    Parameters
    ----------
    errors
        (pairs, 2, n) of the unknowns under n and -n.
    bounds
        (pairs, n, n) covariances at the bound.
    predicted
        (pairs, 2, n, n) covariances that the results give if the noise is known.
    efficient
        (pairs, n) errors of the efficient estimator under n.
    to_px
        (n, n): a' to_px a is the mean square displacement by unknowns a, per component [px^2].
    """

    errors: FloatArray
    bounds: FloatArray
    predicted: FloatArray
    efficient: FloatArray
    to_px: FloatArray

    @property
    def bound(self) -> float:
        """Mean square of the displacement's error by the bound [px^2]."""
        return float(np.einsum("pij,ij->", self.bounds, self.to_px) / len(self.bounds))

    @property
    def mean_squares(self) -> FloatArray:
        """(2, pairs) of the displacement's error, and of the efficient estimator's [px^2]."""

        def square(errors: FloatArray) -> FloatArray:
            return np.einsum("...i,ij,...j->...", errors, self.to_px, errors)

        return np.array([square(self.errors).mean(axis=1), square(self.efficient)])

    @property
    def bias_square(self) -> float:
        """Mean square bias of the displacement, less that by the scatter of the mean [px^2]."""
        means = self.errors.mean(axis=1)
        products = np.einsum("pi,ij,qj->pq", means, self.to_px, means)
        n = len(means)
        return float((products.sum() - np.trace(products)) / (n * (n - 1)))

    @property
    def chi_squares(self) -> FloatArray:
        """(3, pairs) mean squares of the unknowns' standardised errors.

        Of the errors by the bound and by the predicted covariances, and of the efficient
        estimator's by the bound.
        """

        def square(errors: FloatArray, covariances: FloatArray) -> FloatArray:
            standardised = np.linalg.solve(covariances, errors[..., None])[..., 0]
            return np.asarray((errors * standardised).mean(axis=-1))

        return np.array([
            square(self.errors, self.bounds[:, None]).mean(axis=1),
            square(self.errors, self.predicted).mean(axis=1),
            square(self.efficient, self.bounds),
        ])  # fmt: skip


def measure(row: Row, motion: Motion, pairs: int, number: int = 0) -> Measured:
    """Correlate all realisations under one motion; ``number`` seeds the noise of this motion."""
    ansatz = Ansatz(Box.centred(GRID.cols * PIXEL, GRID.rows * PIXEL), v0_degree=row.degree)
    options, stretch = CorrelationOptions((FULL,), **row.options), 1.0 + motion.strain
    shown, rest = motion.shown, np.zeros(ansatz.size)
    S = ansatz.sensitivities(rest, *AT)[:, 0]
    S_g = ansatz.sensitivities(rest, *(at[shown, None] for at in motion.came_from))[:, 0]
    u = motion.displacement(*AT)[::EVERY].ravel()
    truth = np.linalg.lstsq(S[::EVERY].reshape(-1, ansatz.size), u, rcond=None)[0]
    errors, bounds, predicted, efficient = [], [], [], []
    for seed in range(pairs):
        f = speckle(row.width_px, seed).image()
        g, slopes_g = moved(row.width_px, seed, motion)
        noise = np.random.default_rng([seed, 1, number]).normal(size=(2, *GRID.shape))
        J, J_g = (
            (d_col[:, None] * of[:, 0] / stretch - d_row[:, None] * of[:, 1]) / PIXEL
            for (d_row, d_col), of in ((slopes(row.width_px, seed), S), (slopes_g, S_g))
        )
        inverse = np.linalg.inv(J.T @ J)
        bounds.append((row.in_f**2 + row.in_g**2 / stretch) * inverse)
        push = row.in_f * noise[0][USED] @ J - row.in_g / stretch * noise[1][shown] @ J_g
        efficient.append(inverse @ push)
        found = [
            correlate(
                ImagePair(
                    f + sign * row.in_f * noise[0], g + sign * row.in_g * noise[1], GRID, MASK
                ),
                ansatz, guess=rest, options=options,
            )
            for sign in (1, -1)
        ]  # fmt: skip
        known = ImageNoise(row.in_f, row.in_g)
        errors.append([result.unknowns - truth for result in found])
        predicted.append([result.covariance(known) for result in found])
    to_px = np.einsum("pcn,pcm->nm", S[::EVERY], S[::EVERY]) / (2 * len(S[::EVERY])) / PIXEL**2
    made = (np.array(values) for values in (errors, bounds, predicted, efficient))
    return Measured(*made, to_px=to_px)


@dataclass(frozen=True)
class Ratio:
    """A ratio of two sums, and its standard error by the scatter of their terms."""

    value: float
    error: float

    @classmethod
    def of(cls, above: FloatArray, below: FloatArray) -> Ratio:
        """The ratio of the sums of independent pairs of terms (k,)."""
        value = above.sum() / below.sum()
        scatter = np.square(above - value * below).sum()
        return cls(float(value), float(np.sqrt(scatter) / below.sum()))

    @property
    def root(self) -> Ratio:
        """Its square root."""
        return Ratio(float(np.sqrt(self.value)), float(0.5 * self.error / np.sqrt(self.value)))

    def __str__(self) -> str:
        return f"{self.value:.3f} ± {self.error:.3f}"


@dataclass(frozen=True)
class Summary:
    """Results of a row over all its motions.

    Parameters
    ----------
    bound_px
        Rms standard error of a component by the bound [px].
    bias
        Rms bias over that, under the worst motion [-].
    ratio
        Rms error over that of the efficient estimator, all motions [-].
    chi_square, chi_square_predicted
        Of the unknowns by the bound and by the results' own covariances, over that of the
        efficient estimator by the bound [-].
    """

    bound_px: float
    bias: float
    ratio: Ratio
    chi_square: Ratio
    chi_square_predicted: Ratio


def summarise(row: Row, pairs: int, step: float) -> Summary:
    """Measure a row under all motions."""
    made = [measure(row, motion, pairs, number) for number, motion in enumerate(motions(step))]
    error, efficient = np.hstack([one.mean_squares for one in made])
    by_bound, by_own, expected = np.hstack([one.chi_squares for one in made])
    return Summary(
        bound_px=float(np.sqrt(np.mean([one.bound for one in made]))),
        bias=float(np.sqrt(max(max(0.0, one.bias_square) / one.bound for one in made))),
        ratio=Ratio.of(error, efficient).root,
        chi_square=Ratio.of(by_bound, expected),
        chi_square_predicted=Ratio.of(by_own, expected),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--pairs", type=int, default=8, help="realisations n, each with its -n")
    parser.add_argument("--step", type=float, default=0.125, help="of the translations [px]")
    parser.add_argument("--only", default="", help="rows whose names contain this text")
    parser.add_argument("--json", type=Path, help="where to leave all numbers")
    options = parser.parse_args()
    print("| noise, speckle, polynomials | bound of *u* [px] | largest bias / bound | rms error / "
          "bound | chi squared: bound | own covariance |\n|---|---|---|---|---|---|")  # fmt: skip
    found = {}
    for row in ROWS:
        if options.only in row.name:
            one = summarise(row, options.pairs, options.step)
            found[row.name] = asdict(one)
            print(f"| {row.name} | {one.bound_px:.2e} | {one.bias:.3f} | {one.ratio} | "
                  f"{one.chi_square} | {one.chi_square_predicted} |", flush=True)  # fmt: skip
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
