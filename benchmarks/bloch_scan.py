"""Bloch analysis of infinite lattices: its cost, and its critical strains by mesh size.

Run ``scripts/env python benchmarks/bloch_scan.py``. The first table compares, in one run, a scan of
60 wave vectors along the zone's boundary with 60 sparse factorisations of the reduced matrix (their
order of elimination being known, and found anew each time); the second is the one of docs/bloch.md.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

from modeharvest.fem.bloch import BlochWaves, scan
from modeharvest.fem.bloch_critical import first_critical
from modeharvest.fem.cell import CellPath, PeriodicCell
from modeharvest.fem.lattices import SQUARE_ZONE, UnitCell, hexagonal, square
from modeharvest.fem.macroscopic import MacroLoading, equibiaxial, uniaxial, uniaxial_strain
from modeharvest.fem.materials import TwoTermI1
from modeharvest.fem.reduction import factorise
from modeharvest.fem.zone import zone_path

POINTS = 60
RATIOS = (0.8696, 0.7895, 0.95)
LOADINGS = {"uniaxial": uniaxial(), "strain": uniaxial_strain(), "equibiaxial": equibiaxial()}
HEXAGONAL = {"equibiaxial": equibiaxial(), "y": uniaxial(1), "x": uniaxial(0)}


def seconds(work: Callable[[], object], repeats: int = 3) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def cost(per_pitch: int, ratio: float) -> str:
    cell = PeriodicCell(square(1.0, ratio, 1 / per_pitch), TwoTermI1())
    state = CellPath(cell, uniaxial()).at(0.002)
    assert state is not None
    points, _ = zone_path(SQUARE_ZONE, cell.cell.lattice, POINTS)
    matrix = BlochWaves(cell, state).stiffness.at((0.7, 2.1))

    def factorisations(order: str) -> None:
        for _ in range(POINTS):
            factorise(matrix, order)

    whole = seconds(lambda: scan(BlochWaves(cell, state), points))
    known = seconds(lambda: factorisations("NATURAL"))
    anew = seconds(lambda: factorisations("MMD_AT_PLUS_A"))
    return (
        f"| {ratio} | 1/{per_pitch} | {cell.reduction.size} | {1e3 * whole:.0f} ms "
        f"| {whole / known:.2f} | {whole / anew:.2f} |"
    )


def critical(cell: UnitCell, loading: MacroLoading) -> str:
    found = first_critical(CellPath(PeriodicCell(cell, TwoTermI1()), loading))
    waves = f"{len(found.waves)} wave(s)" if found.found else found.outcome
    return f"{100 * found.load:.4f} ({waves})"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=(12, 24), help="elements a pitch")
    sizes = parser.parse_args().sizes
    print("| d/l | h/l | unknowns | scan | over 60 known orders | over 60 new orders |")
    print("|---|---|---|---|---|---|")
    for ratio in RATIOS:
        for n in sizes:
            print(cost(n, ratio), flush=True)
    print("\n| lattice | loading | " + " | ".join(f"h = l/{n} [%]" for n in sizes) + " |")
    print("|---|---|" + "---|" * len(sizes))
    for ratio in RATIOS:
        cells = [square(1.0, ratio, 1 / n) for n in sizes]
        for name, loading in LOADINGS.items():
            values = " | ".join(critical(cell, loading) for cell in cells)
            print(f"| square {ratio} | {name} | {values} |", flush=True)
    cells = [hexagonal(1.386, 1.28, 1.386 / n) for n in sizes]
    for name, loading in HEXAGONAL.items():
        values = " | ".join(critical(cell, loading) for cell in cells)
        print(f"| hexagonal 0.924 | {name} | {values} |", flush=True)


if __name__ == "__main__":
    main()
