"""Whether a correlation's errors are at the Cramer-Rao bound, by Monte Carlo.

The truth is inside the ansatz (77 unknowns, a pattern everywhere, 320 x 360 px), the images are
exact. Noise is added; each realisation has a speckle of its own and comes twice, as n and as -n:
what the mean of the two errors leaves is of second order in the noise, so a bias shows long
before it would out of the scatter.

The bound is that of benchmarks/known_truth.py, made without the correlation's own matrix.

Run: scripts/env python benchmarks/cramer_rao.py [--pairs 100] [--only TEXT] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from known_truth import GRID, PIXEL, STRAIN, Truth
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.correlate import CorrelationOptions, correlate
from modeharvest.idic.pyramid import Level
from modeharvest.idic.result import Result
from modeharvest.imaging.speckle import Speckle, SpeckleSpec

FloatArray = NDArray[np.float64]

ROUNDING = 1 / (255 * np.sqrt(12))
EVERY = 8
"""Fields are compared at every eighth pixel: they are as smooth as the ansatz."""


@dataclass(frozen=True)
class Noise:
    """What is wrong with the images.

    Parameters
    ----------
    name
        For the table.
    in_f, in_g
        Standard deviations [fraction of full scale].
    rounded
        No noise but that of rounding to 8 bits.
    blur_px
        Gaussian blur of both images before they are correlated [px].
    """

    name: str
    in_f: float
    in_g: float
    rounded: bool = False
    blur_px: float = 0.0

    def draw(self, f: FloatArray, g: FloatArray, seed: int) -> tuple[FloatArray, FloatArray]:
        """Make a realisation for both images."""
        if self.rounded:
            return np.rint(255 * f) / 255 - f, np.rint(255 * g) / 255 - g
        normal = np.random.default_rng([seed, 1]).normal(size=(2, *f.shape))
        return self.in_f * normal[0], self.in_g * normal[1]

    @property
    def as_told(self) -> tuple[float, int]:
        """``noise_sd`` and ``noisy_images`` of :meth:`Result.covariance`."""
        return max(self.in_f, self.in_g), int(self.in_f > 0) + int(self.in_g > 0)

    def seen(self, image: FloatArray) -> FloatArray:
        """What is correlated of a noisy image."""
        return ndimage.gaussian_filter(image, self.blur_px) if self.blur_px else image


NOISES = (
    Noise("0.2 % in both", 0.002, 0.002),
    Noise("0.5 % in both", 0.005, 0.005),
    Noise("1 % in both", 0.01, 0.01),
    Noise("2 % in both", 0.02, 0.02),
    Noise("2 % in both, blurred by 1 px", 0.02, 0.02, blur_px=1.0),
    Noise("1 % in g only", 0.0, 0.01),
    Noise("1 % in f only", 0.01, 0.0),
    Noise("8-bit rounding", ROUNDING, ROUNDING, rounded=True),
)


@dataclass(frozen=True, eq=False)
class Field:
    """A part of the displacement at some pixels.

    Parameters
    ----------
    name
        For the table.
    of
        From unknowns to (points, components) [mm].
    S
        (points, components, n) its derivatives.
    """

    name: str
    of: Callable[[FloatArray], FloatArray]
    S: FloatArray

    def variance(self, covariance: FloatArray) -> float:
        """Mean over the points of the variance, all components together [mm^2]."""
        return float(np.einsum("pcn,nm,pcm->", self.S, covariance, self.S, optimize=True)
                     / len(self.S))  # fmt: skip


def fields(truth: Truth) -> list[Field]:
    """u, v0, v1 and v1 phi1."""
    ansatz = truth.ansatz
    row, col = (at[(truth.used[0] % EVERY == 0) & (truth.used[1] % EVERY == 0)]
                for at in truth.used)  # fmt: skip
    x, y = GRID.x[col, None], GRID.y[row, None]  # two-dimensional: points, not axes
    S = ansatz.sensitivities(truth.a, x, y)[:, 0]
    slow = np.zeros(ansatz.size, dtype=np.bool_)
    for c in (0, 1):
        slow[ansatz.v0_slice(c)] = True
    v = np.zeros((len(row), 1, ansatz.size))
    v[:, 0, ansatz.v_slice(0)] = ansatz.v_space.basis(x, y)[:, 0]
    return [
        Field("u", lambda a: ansatz.displacement(a, x, y)[:, 0], S),
        Field("v0", lambda a: ansatz.v0(a, x, y)[:, 0], np.where(slow, S, 0.0)),
        Field("v1", lambda a: ansatz.v(0, a, x, y), v),
        Field("v1 phi1", lambda a: ansatz.fluctuation(0, a, x, y)[:, 0], np.where(slow, 0.0, S)),
    ]


@dataclass(frozen=True, eq=False)
class Pair:
    """Two correlations with opposite noise.

    Parameters
    ----------
    bound
        (n, n) covariance.
    found
        The two results.
    """

    bound: FloatArray
    found: tuple[Result, Result]


def measure(truth: Truth, noise: Noise, pairs: int, standard_start: bool) -> Iterator[Pair]:
    """Correlate images with n and with -n, a new speckle for each pair."""
    ansatz = truth.ansatz
    options = CorrelationOptions() if standard_start else CorrelationOptions((Level(1, 0.0),))
    start = ansatz.start(STRAIN, 1.0) if standard_start else truth.a
    for seed in range(pairs):
        speckle = Speckle(SpeckleSpec(seed=seed), GRID.shape)
        f, g = truth.images(speckle)
        n_f, n_g = noise.draw(f, g, seed)
        signed = [(noise.seen(f + s * n_f), noise.seen(g + s * n_g)) for s in (1, -1)]
        plus, minus = (
            correlate(*images, GRID, ansatz, start, truth.mask, options=options)
            for images in signed
        )
        yield Pair(truth.bound(speckle, noise.in_f, noise.in_g), (plus, minus))


def judge_field(field: Field, truth: Truth, pairs: list[Pair]) -> dict[str, float]:
    """Ratio of the rms error to the bound, and bias over the bound, with standard errors."""
    true, count = field.of(truth.a), len(pairs)
    errors = np.array([[field.of(r.unknowns) - true for r in p.found] for p in pairs])
    squares = (errors**2).sum(axis=-1).mean(axis=(1, 2))
    bound = np.sqrt(np.mean([field.variance(p.bound) for p in pairs]))
    ratio = np.sqrt(squares.mean()) / bound
    even, odd = errors.mean(axis=1), 0.5 * (errors[:, 0] - errors[:, 1])

    def mean_square_and_scatter(part: FloatArray) -> tuple[float, float]:
        mean, variance = part.mean(axis=0), part.var(axis=0, ddof=1)
        return (float((mean**2).sum(axis=-1).mean()),
                float(variance.sum(axis=-1).mean()) / count)  # fmt: skip

    bias, scatter = mean_square_and_scatter(even)
    drift, drift_scatter = mean_square_and_scatter(odd)
    return {
        "bound_px": bound / PIXEL,
        "ratio": ratio,
        "ratio_se": 0.5 * ratio * squares.std(ddof=1) / squares.mean() / np.sqrt(count),
        "bias": np.sqrt(max(0.0, bias - scatter)) / bound,
        "bias_se": np.sqrt(scatter) / bound,
        "odd_mean": np.sqrt(drift) / bound,
        "odd_mean_expected": np.sqrt(drift_scatter) / bound,
    }


def judge_unknowns(truth: Truth, noise: Noise, pairs: list[Pair]) -> dict[str, Any]:
    """Standardised errors by the bound, and intervals by what each result says of itself."""
    n, sd = truth.ansatz.size, noise.as_told
    errors = np.array([[r.unknowns - truth.a for r in p.found] for p in pairs])
    distance = np.array([
        np.mean(np.einsum("sn,nm,sm->s", e, np.linalg.inv(p.bound), e)) / n
        for e, p in zip(errors, pairs, strict=True)
    ])  # fmt: skip
    bound = np.array([np.diag(p.bound) for p in pairs])[:, None]
    ratio = np.sqrt((errors**2 / bound).mean(axis=(0, 1)))
    is_white = noise.blur_px == 0.0  # what a result tells is for white noise
    own = np.array([[np.diag(r.covariance(*sd)) for r in p.found] for p in pairs])
    covered = (abs(errors) < 1.96 * np.sqrt(own)).mean(axis=(1, 2))
    return {
        "chi_square": distance.mean(),
        "chi_square_se": distance.std(ddof=1) / np.sqrt(len(pairs)),
        "smallest_ratio": ratio.min(),
        "largest_ratio": ratio.max(),
        "told_over_error": float(np.sqrt((own / bound).mean() / (errors**2 / bound).mean()))
        if is_white else None,
        "coverage": covered.mean() if is_white else None,
        "coverage_se": covered.std(ddof=1) / np.sqrt(len(pairs)),
        "chi_square_of_residual": float(
            np.mean([r.agreement(*sd).chi_square for p in pairs for r in p.found])
        ) if is_white and noise.in_f > 0 else None,
        "not_converged": sum(r.outcome.value != "converged" for p in pairs for r in p.found),
    }  # fmt: skip


def study(pairs: int, standard_start: bool, only: str) -> dict[str, Any]:
    """All rows whose names begin with a text."""
    truth = Truth.default()
    parts = fields(truth)
    found: dict[str, Any] = {}
    for noise in (noise for noise in NOISES if noise.name.startswith(only)):
        print(f"{noise.name} ...", file=sys.stderr, flush=True)
        measured = list(measure(truth, noise, pairs, standard_start))
        found[noise.name] = {
            "fields": {field.name: judge_field(field, truth, measured) for field in parts},
            "unknowns": judge_unknowns(truth, noise, measured),
        }
    return {
        "pairs": pairs,
        "pixels": len(truth.used[0]),
        "unknowns": truth.ansatz.size,
        "det_F": [float(v) for v in np.quantile(
            np.linalg.det(truth.deformation_gradient), (0.0, 0.5, 1.0))],
        "noises": found,
    }  # fmt: skip


def tell(found: dict[str, Any]) -> None:
    """Print the tables."""
    print(f"{found['pairs']} pairs of realisations, {found['pixels']} px, "
          f"{found['unknowns']} unknowns; det F from {found['det_F'][0]:.2f} to "
          f"{found['det_F'][2]:.2f}, median {found['det_F'][1]:.2f}\n")  # fmt: skip
    for heading, key in (("rms error / bound", "ratio"), ("bias / bound", "bias")):
        print(f"| {heading} | bound of u, rms [px] | u | v0 | v1 | v1 phi1 |")
        print("|---|---|---|---|---|---|")
        for noise, row in found["noises"].items():
            cells = [f"{f[key]:.3f} ± {f[key + '_se']:.3f}"
                     for f in row["fields"].values()]  # fmt: skip
            print(f"| {noise} | {row['fields']['u']['bound_px']:.2e} | {' | '.join(cells)} |")
        print()
    print("| noise | chi squared of the unknowns | each unknown's rms error / bound | told "
          "standard error / rms error | share in 95 % intervals | chi squared of the residual |\n"
          "|---|---|---|---|---|---|")  # fmt: skip
    for noise, row in found["noises"].items():
        u = row["unknowns"]
        told, covered, residual = (
            "–" if u[key] is None else f"{u[key]:.3f}"
            for key in ("told_over_error", "coverage", "chi_square_of_residual")
        )
        print(f"| {noise} | {u['chi_square']:.3f} ± {u['chi_square_se']:.3f} | "
              f"{u['smallest_ratio']:.2f} – {u['largest_ratio']:.2f} | {told} | {covered} ± "
              f"{u['coverage_se']:.3f} | {residual} |")  # fmt: skip
        if u["not_converged"]:
            print(f"{noise}: {u['not_converged']} correlations did not converge")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--pairs", type=int, default=100, help="realisations n, each with its -n")
    parser.add_argument("--standard-start", action="store_true", help="not from the truth: slower")
    parser.add_argument("--only", default="", help="rows whose names begin with this text")
    parser.add_argument("--json", type=Path, help="where to leave all numbers")
    options = parser.parse_args()
    found = study(options.pairs, options.standard_start, options.only)
    tell(found)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
