"""Mesh convergence and cost of the finite-element path: prints the tables of docs/fem.md.

Run ``scripts/env python benchmarks/fem_path.py`` (minutes); ``--sizes 0.3 0.2`` for less.
Seconds depend on the machine and are printed only to compare the rows with each other.
"""

from __future__ import annotations

import argparse
import time

from modeharvest.fem.field import Solution
from modeharvest.fem.materials import Material, Ogden, TwoTermI1
from modeharvest.fem.simulate import Experiment, simulate

SIZES = (0.3, 0.2, 0.15, 0.12, 0.1)
MATERIALS: dict[str, Material] = {"Ogden": Ogden(), "TwoTermI1": TwoTermI1()}
HEADER = (
    "| material | h [mm] | unknowns | critical strain [%] | energy at 12.8 % [N] "
    "| factorisations | seconds |\n|---|---|---|---|---|---|---|"
)


def run(material: Material, size: float) -> tuple[Solution, float]:
    """The 6 x 10 specimen through both snapshots; the solution and the seconds it took."""
    start = time.perf_counter()
    solution = simulate(Experiment(material=material, mesh_size=size))
    return solution, time.perf_counter() - start


def row(name: str, size: float, solution: Solution, seconds: float) -> str:
    info = solution.info
    critical = info["critical"]
    strain = "none" if critical is None else f"{100 * critical['strain']:.4f}"
    energy = solution.snapshots[-1].energy
    cost = f"{info['factorisations']} | {seconds:.0f}"
    line = f"| {name} | {size:g} | {info['unknowns']} | {strain} | {energy:.5f} | {cost} |"
    return line if info["outcome"] == "complete" else f"{line} {info['outcome']}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", type=float, nargs="+", default=SIZES, help="mesh sizes [mm]")
    parser.add_argument("--materials", nargs="+", choices=MATERIALS, default=list(MATERIALS))
    arguments = parser.parse_args()
    print(HEADER, flush=True)
    for name in arguments.materials:
        for size in arguments.sizes:
            print(row(name, size, *run(MATERIALS[name], size)), flush=True)


if __name__ == "__main__":
    main()
