"""Coverage of gauges' intervals: a plate with a hole under a known deformation, over seeds.

``scripts/env python benchmarks/gauges.py [--seeds 20] [--noise 0.01]`` measures images of 220 x 260
px, with noise of 1 % in both, drawn anew for each seed. For each reading of a point, a line and an
area it prints the rms error, the rms of the predicted standard deviations, and the share of errors
within 1.96 of them. Table: docs/how-to/measure.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from plate_with_hole import GRID, plate_pair

from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.photograph.displacement import block_motion, displacement_from
from modeharvest.idic.photograph.gauges import Gauge, read_at

F = np.array([[1.06, -0.02], [0.05, 0.97]])
GAUGES = (
    Gauge("point", point=(0.8, 0.3)),
    Gauge("line", line=((-0.9, -0.7), (0.9, -0.7))),
    Gauge("area", polygon=((-1.0, 0.4), (1.0, 0.4), (1.0, 0.9), (-1.0, 0.9))),
)


def motion(points: np.ndarray) -> np.ndarray:
    """(..., 2) displacement at points (..., 2) [mm]: a homogeneous stretch with a rotation."""
    return 0.02 + points @ (F - np.eye(2)).T


def truth(gauge: Gauge) -> dict[str, float]:
    """True readings of a gauge under this motion."""
    values, vectors = np.linalg.eigh(F.T @ F)
    strain = vectors @ np.diag(0.5 * np.log(values)) @ vectors.T
    turn = np.degrees(np.arctan2(F[1, 0] - F[0, 1], F[0, 0] + F[1, 1]))
    engineering = float(np.linalg.norm(F[:, 0])) - 1.0
    found = {
        "strain_xx": strain[0, 0], "strain_yy": strain[1, 1], "strain_xy": strain[0, 1],
        "rotation": turn, "engineering_strain": engineering,
        "true_strain": np.log1p(engineering), "strain_along": engineering,
        "turn": np.degrees(np.arctan2(F[1, 0], F[0, 0])),
    }  # fmt: skip
    if gauge.point is not None:
        u, v = motion(np.array(gauge.point))
        found |= {"u": u, "v": v}
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--noise", type=float, default=0.01)
    options, errors, predicted = parser.parse_args(), dict(), dict()
    for seed in range(options.seeds):
        pair = plate_pair(motion, options.noise, seed=seed)
        body = FiniteElementOptions().body(pair.masks[0], GRID)
        start = block_motion(pair, body, 0.0 * body.mesh.nodes)
        found = displacement_from(start, pair, body)
        for gauge in GAUGES:
            true = truth(gauge)
            for what, (value, sd, _) in read_at(gauge, found).items():
                if what in true:
                    key = f"{gauge.name} {what}"
                    errors.setdefault(key, []).append(value - true[what])
                    predicted.setdefault(key, []).append(sd)
    print("reading                       rms error   predicted   within 1.96 sd")
    within = []
    for key in errors:
        error, sd = np.array(errors[key]), np.array(predicted[key])
        inside = np.abs(error) < 1.96 * sd
        within.append(inside)
        rms = np.sqrt(np.mean(error**2)), np.sqrt(np.mean(sd**2))
        print(f"{key:28s} {rms[0]:10.2e}  {rms[1]:10.2e}  {inside.mean():10.0%}")
    print(f"all: {np.mean(within):.1%} of {np.size(within)}")


if __name__ == "__main__":
    main()
