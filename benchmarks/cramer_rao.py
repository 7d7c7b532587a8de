"""Errors of the correlation compared with the Cramer-Rao bound, by Monte Carlo.

The true displacement is in the ansatz (77 unknowns, a pattern everywhere, 360 x 320 px), and images
are exact before noise is added. Each realisation has its own speckle, and is used with noise n and
with -n: the mean of the two errors is of second order in the noise, so it shows a bias that the
scatter would hide. The bound is that of known_truth.py, which doesn't use the correlation's matrix.
Ten minutes of processor time; tables: docs/explanation/metrology.md.

Run: scripts/env python benchmarks/cramer_rao.py [--pairs 100] [--only TEXT] [--standard-start]
     [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from known_truth import GRID, PIXEL, STRAIN, Truth
from numpy.typing import NDArray

from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import FULL
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.validation.studies.noise_statistics import Estimate, PairedErrors

FloatArray = NDArray[np.float64]

ROUNDING = 1 / (255 * np.sqrt(12))
EVERY = 8
"""Fields are compared at every eighth pixel, because they are as smooth as the ansatz."""


@dataclass(frozen=True)
class Noise:
    """Noise of the images, and options of their correlation.

    Parameters
    ----------
    name
        Name in the table.
    in_f, in_g
        Standard deviations [fraction of full scale].
    rounded
        Whether the noise is that of rounding to 8 bits alone.
    gradient, blur_px
        ``gradient`` and ``gradient_blur_px`` of :class:`CorrelationOptions`.
    """

    name: str
    in_f: float
    in_g: float
    rounded: bool = False
    gradient: str | None = None
    blur_px: float | None = None

    def draw(self, f: FloatArray, g: FloatArray, seed: int) -> tuple[FloatArray, FloatArray]:
        """Draw a realisation of the noise of f and of g [fraction of full scale]."""
        if self.rounded:
            return np.rint(255 * f) / 255 - f, np.rint(255 * g) / 255 - g
        normal = np.random.default_rng([seed, 1]).normal(size=(2, *f.shape))
        return self.in_f * normal[0], self.in_g * normal[1]

    @property
    def known(self) -> ImageNoise:
        """The noise that is given to the results' covariances."""
        return ImageNoise(self.in_f, self.in_g)


NOISES = (
    Noise("0.2 % in both", 0.002, 0.002),
    Noise("0.5 % in both", 0.005, 0.005),
    Noise("1 % in both", 0.01, 0.01),
    Noise("2 % in both", 0.02, 0.02),
    Noise("4 % in both", 0.04, 0.04),
    Noise("1 % in g only", 0.0, 0.01),
    Noise("1 % in f only", 0.01, 0.0),
    Noise("8-bit rounding", ROUNDING, ROUNDING, rounded=True),
    Noise("least squares, 1 % in both", 0.01, 0.01, gradient="deformed", blur_px=0.0),
    Noise("least squares, 2 % in both", 0.02, 0.02, gradient="deformed", blur_px=0.0),
    Noise("deformed image's gradient, 2 % in both", 0.02, 0.02, gradient="deformed"),
)


@dataclass(frozen=True, eq=False)
class Quantity:
    """A part of the displacement at some pixels, or the unknowns themselves.

    Parameters
    ----------
    name
        Name in the table.
    of
        Function from the unknowns (n,) to an array (...).
    S
        (..., n) derivatives by the unknowns.
    """

    name: str
    of: Callable[[FloatArray], FloatArray]
    S: FloatArray

    def sd(self, covariance: FloatArray) -> FloatArray:
        """(...) standard deviations that follow from a covariance (n, n) of the unknowns."""
        return np.sqrt(np.einsum("...n,...n->...", self.S @ covariance, self.S))


def quantities(truth: Truth) -> list[Quantity]:
    """The compared quantities: u, v0, v1, v1 phi1 and the unknowns."""
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
    pattern = np.where(slow, 0.0, S)
    return [
        Quantity("u", lambda a: ansatz.displacement(a, x, y)[:, 0], S),
        Quantity("v0", lambda a: ansatz.v0(a, x, y)[:, 0], np.where(slow, S, 0.0)),
        Quantity("v1", lambda a: ansatz.v(0, a, x, y), v),
        Quantity("v1 phi1", lambda a: ansatz.fluctuation(0, a, x, y)[:, 0], pattern),
        Quantity("unknowns", lambda a: a, np.eye(ansatz.size)),
    ]


@dataclass(frozen=True, eq=False)
class Realisation:
    """Two correlations with opposite noise.

    Parameters
    ----------
    bound
        (n, n) covariance of the unknowns at the bound.
    found
        The two results.
    """

    bound: FloatArray
    found: tuple[Result, Result]


def measure(truth: Truth, noise: Noise, seed: int, standard_start: bool) -> Realisation:
    """Correlate images with noise n and with -n."""
    ansatz = truth.ansatz
    levels = CorrelationOptions().levels if standard_start else (FULL,)
    options = CorrelationOptions(levels, gradient=noise.gradient, gradient_blur_px=noise.blur_px)
    start = ansatz.initial_guess(STRAIN, 1.0) if standard_start else truth.a
    speckle = Speckle(SpeckleSpec(seed=seed), GRID.shape)
    f, g = truth.images(speckle)
    n_f, n_g = noise.draw(f, g, seed)
    plus, minus = (
        correlate(
            ImagePair(f + s * n_f, g + s * n_g, GRID, truth.mask),
            ansatz,
            guess=start,
            options=options,
        )
        for s in (1, -1)
    )
    return Realisation(truth.bound(speckle, noise.in_f, noise.in_g), (plus, minus))


def assess(quantity: Quantity, truth: Truth, noise: Noise, made: list[Realisation]) -> PairedErrors:
    """Errors of a quantity, the standard deviations that results predict, and the bound."""
    true = quantity.of(truth.a)

    def of_all(value: Callable[[Result], FloatArray]) -> FloatArray:
        return np.array([[value(r) for r in one.found] for one in made])

    return PairedErrors(
        of_all(lambda r: quantity.of(r.unknowns) - true),
        of_all(lambda r: quantity.sd(r.covariance(noise.known))),
        np.sqrt(np.mean([quantity.sd(one.bound) ** 2 for one in made], axis=0)),
    )


def chi_square(truth: Truth, made: list[Realisation]) -> Estimate:
    """Mean square of the unknowns' errors, standardised by the bound's full covariance."""
    n = truth.ansatz.size
    distance = []
    for one in made:
        errors = np.array([r.unknowns - truth.a for r in one.found])
        weighted = np.linalg.solve(one.bound, errors.T).T
        distance.append((errors * weighted).sum() / len(errors) / n)
    return Estimate(float(np.mean(distance)), float(np.std(distance, ddof=1) / np.sqrt(len(made))))


def study(pairs: int, standard_start: bool, only: str) -> dict[str, Any]:
    """Measure all rows whose names begin with ``only``; their numbers as for JSON."""
    truth = Truth.default()
    parts = quantities(truth)
    rows: dict[str, Any] = {}
    for noise in (noise for noise in NOISES if noise.name.startswith(only)):
        print(f"{noise.name} ...", file=sys.stderr, flush=True)
        made = [measure(truth, noise, seed, standard_start) for seed in range(pairs)]
        assessed = {part.name: assess(part, truth, noise, made) for part in parts}
        results = [r for one in made for r in one.found]
        unknowns = assessed.pop("unknowns").standardised
        rows[noise.name] = {
            "bound_px": assessed["u"].rms_bound * np.sqrt(2.0) / PIXEL,
            "blur_px": float(np.mean([r.weighting.blur_px for r in results])),
            "fields": {name: {"ratio": vars(part.ratio), "bias": vars(part.bias)}
                       for name, part in assessed.items()},
            "chi_square": vars(chi_square(truth, made)),
            "ratios": [float(unknowns.ratios.min()), float(unknowns.ratios.max())],
            "predicted_over_error": float(
                np.sqrt((unknowns.predicted**2).mean() / (unknowns.errors**2).mean())
            ),
            "coverage": vars(unknowns.coverage),
            "chi_square_of_residual": float(
                np.mean([r.residual_test(noise.known).chi_square for r in results])
            ),
            "not_converged": sum(r.outcome.value != "converged" for r in results),
        }  # fmt: skip
    det = np.quantile(np.linalg.det(truth.deformation_gradient), (0.0, 0.5, 1.0))
    return {
        "pairs": pairs,
        "pixels": len(truth.used[0]),
        "unknowns": truth.ansatz.size,
        "det_F": det.tolist(),
        "noises": rows,
    }


def tell(found: dict[str, Any]) -> None:
    """Print the tables."""
    print(f"{found['pairs']} pairs of realisations, {found['pixels']} px, "
          f"{found['unknowns']} unknowns; det F from {found['det_F'][0]:.2f} to "
          f"{found['det_F'][2]:.2f}, median {found['det_F'][1]:.2f}\n")  # fmt: skip
    for heading, key in (("rms error / bound", "ratio"), ("bias / bound", "bias")):
        print(f"| {heading} | bound of u, rms [px] | u | v0 | v1 | v1 phi1 |")
        print("|---|---|---|---|---|---|")
        for noise, row in found["noises"].items():
            cells = " | ".join(str(Estimate(**f[key])) for f in row["fields"].values())
            print(f"| {noise} | {row['bound_px']:.2e} | {cells} |")
        print()
    print("| noise | blur of the gradient [px] | chi squared of the unknowns | each unknown's rms "
          "error / bound | predicted standard error / rms error | share in 95 % intervals | chi "
          "squared of the residual |\n|---|---|---|---|---|---|---|")  # fmt: skip
    for noise, row in found["noises"].items():
        print(f"| {noise} | {row['blur_px']:.2f} | {Estimate(**row['chi_square'])} | "
              f"{row['ratios'][0]:.2f} – {row['ratios'][1]:.2f} | "
              f"{row['predicted_over_error']:.3f} | {Estimate(**row['coverage'])} | "
              f"{row['chi_square_of_residual']:.3f} |")  # fmt: skip
        if row["not_converged"]:
            print(f"{noise}: {row['not_converged']} correlations did not converge")


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
