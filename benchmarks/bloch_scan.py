"""Bloch analysis of infinite lattices: its cost, critical strains, convergence and branches.

Run: scripts/env python benchmarks/bloch_scan.py TABLE [--sizes 12 24] [--meshes 4], where TABLE is
``cost`` (time of a scan of 60 wave vectors along the zone's boundary, assembly included, over that
of 60 sparse factorisations of the reduced complex matrix with a known or a new elimination order;
medians of alternate turns in one process), ``critical`` (critical strains by mesh size), ``rates``
(order of convergence on nested meshes), ``splitting`` (of a degenerate set by a mesh),
``distances`` (branches from loads that aren't critical) or ``study`` (ten lattices under three
loadings, with time and memory). Tables: docs/explanation/bloch.md; of ``distances``:
docs/explanation/modes.md.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time
from collections.abc import Callable, Sequence

import gmsh
import numpy as np
from refinement import refined_cell

from modeharvest.fem.bloch import postbuckling
from modeharvest.fem.bloch.critical import critical_at, first_critical
from modeharvest.fem.bloch.degenerate import distinct_combinations
from modeharvest.fem.bloch.dispersion import ZONES, zone_path
from modeharvest.fem.bloch.eigen import BlochWaves, scan
from modeharvest.fem.bloch.postbuckling import follow
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.lattice.bloch_map import factorise
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, chiral, hexagonal, square
from modeharvest.fem.lattice.files import cell_from_gmsh
from modeharvest.fem.lattice.options import (
    CriticalSearch,
    MacroLoading,
    equibiaxial,
    uniaxial,
    uniaxial_strain,
)
from modeharvest.fem.materials import Material, TwoTermI1

POINTS = 60
TURNS = 7
RATIOS = (0.8696, 0.7895, 0.95)
STUDY = (0.25, 0.35, 0.45, 0.55, 0.6, 0.65, 0.7, 0.7895, 0.8696, 0.95)
LOADINGS = {"uniaxial": uniaxial(), "strain": uniaxial_strain(), "equibiaxial": equibiaxial()}
HEXAGONAL = {"equibiaxial": equibiaxial(), "y": uniaxial(1), "x": uniaxial(0)}


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def cost(per_pitch: int, ratio: float) -> str:
    cell = PeriodicCell(square(1.0, ratio, 1 / per_pitch), TwoTermI1())
    state = CellPath(cell, uniaxial()).at(0.002)
    assert state is not None
    points, _ = zone_path(ZONES["oblique"], cell.cell.lattice, POINTS)
    matrix = BlochWaves(cell, state).stiffness((0.7, 2.1))

    def factorisations(order: str) -> Callable[[], None]:
        return lambda: [factorise(matrix, order) for _ in range(POINTS)] and None

    works = (
        lambda: scan(BlochWaves(cell, state), points),
        factorisations("NATURAL"),
        factorisations("MMD_AT_PLUS_A"),
    )
    turns = np.array([[seconds(work) for work in works] for _ in range(TURNS)])
    known, anew = (statistics.median(turns[:, 0] / turns[:, k]) for k in (1, 2))
    milliseconds = 1e3 * statistics.median(turns[:, 0])
    return (
        f"| {ratio} | 1/{per_pitch} | {cell.reduction.size} | {milliseconds:.0f} ms "
        f"| {known:.2f} | {anew:.2f} |"
    )


def costs(sizes: Sequence[int]) -> None:
    print("| d/l | h/l | unknowns | scan | over 60 known orders | over 60 new orders |")
    print("|---|---|---|---|---|---|")
    for ratio in RATIOS:
        for n in sizes:
            print(cost(n, ratio), flush=True)


def critical(cell: UnitCell, loading: MacroLoading) -> str:
    found = first_critical(CellPath(PeriodicCell(cell, TwoTermI1()), loading))
    waves = f"{len(found.waves)} wave(s)" if found.found else found.outcome
    return f"{100 * found.load:.4f} ({waves})"


def criticals(sizes: Sequence[int]) -> None:
    print("| lattice | loading | " + " | ".join(f"h = l/{n} [%]" for n in sizes) + " |")
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


def nested(cell: UnitCell, diameter: float, count: int) -> list[UnitCell]:
    cells = [cell]
    while len(cells) < count:
        cells.append(refined_cell(cells[-1], diameter))
    return cells


def rate(cells: Sequence[UnitCell], loading: MacroLoading, material: Material) -> str:
    """Critical strain of one wave on each mesh [%], and its orders of convergence."""
    search = CriticalSearch()
    paths = [CellPath(PeriodicCell(cell, material), loading) for cell in cells]
    wave = first_critical(paths[0]).waves[0]
    loads = np.array([critical_at(path, wave, search).load for path in paths])
    changes = np.abs(np.diff(loads))
    values = " | ".join(f"{100 * load:.4f}" for load in loads)
    return f"{values} | {', '.join(f'{o:.2f}' for o in np.log2(changes[:-1] / changes[1:]))} |"


def rates(count: int) -> None:
    print(
        "| lattice | material | loading | h = l/6 and halved [%] |"
        + " |" * (count - 1)
        + " order |"
    )
    print("|---|---|---|" + "---|" * (count + 1))
    families = [(f"square {r}", nested(square(1.0, r, 1 / 6), r, count), LOADINGS) for r in RATIOS]
    families.append(
        ("hexagonal 0.924", nested(hexagonal(1.0, 0.924, 1 / 6), 0.924, count), HEXAGONAL)
    )
    for name, cells, loadings in families:
        for loading_name, loading in loadings.items():
            values = rate(cells, loading, TwoTermI1())
            print(f"| {name} | ν = 0.49 | {loading_name} | {values}", flush=True)
    values = rate(families[0][1], equibiaxial(), TwoTermI1(bulk=1.0))
    print(f"| {families[0][0]} | compressible | equibiaxial | {values}", flush=True)


def rhombus(size: float, ratio: float = 0.9) -> UnitCell:
    """A rhombic cell of hexagonal stacking in gmsh's mesh, without the lattice's symmetry."""
    vectors = np.array([[1.0, 0.0], [0.5, 0.75**0.5]])
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    occ, r = gmsh.model.occ, 0.5 * ratio
    ends = [occ.addPoint(*(p @ vectors), 0.0) for p in ([0, 0], [1, 0], [1, 1], [0, 1])]
    sides = [occ.addLine(*pair) for pair in zip(ends, ends[1:] + ends[:1], strict=True)]
    plate = occ.addPlaneSurface([occ.addCurveLoop(sides)])
    holes = [occ.addDisk(*(p @ vectors), 0.0, r, r) for p in ([0, 0], [0, 1], [1, 0], [1, 1])]
    occ.cut([(2, plate)], [(2, hole) for hole in holes])
    occ.synchronize()
    cell = cell_from_gmsh(vectors, size)
    gmsh.finalize()
    return cell


def splitting(size: float) -> None:
    """Print how much gmsh's mesh of a rhombus splits the three M points of hexagonal stacking.

    Also which branches start at the critical load of the first of them.
    """
    cell = rhombus(size)
    path = CellPath(PeriodicCell(cell, TwoTermI1()), equibiaxial())
    found = first_critical(path)
    print(f"size {size}: {found.outcome}", end="; ")
    print(f"split by {found.splitting:.3%}, bound {found.splitting_bound:.3%}")
    modes = real_modes(path.cell, found.state, found.waves)
    copies = PeriodicCell(cell.enlarged(2, 2), TwoTermI1())
    for row in distinct_combinations(copies, modes):
        branch = follow(CellPath(copies, equibiaxial()), modes, row, [1.2 * modes.load])
        print(f"    {row}: {branch.outcome}", flush=True)


SHARES = (1.0, 0.99, 0.97, 0.9)
"""Loads at which modes are computed, as fractions of the critical load [-]."""


def distances() -> None:
    """Print how far modes at lower loads are from critical, and the energies of their branches."""
    postbuckling._CRITICAL = np.inf  # no mode is refused
    print("| lattice | loading |", *(f"from {share:.0%}: distance, energy |" for share in SHARES))
    print("|---|---|" + "---|" * len(SHARES))
    for name, cell, loading in (
        ("square 0.7895", square(1.0, 0.7895, 1 / 8), "uniaxial"),
        ("square 0.7895", square(1.0, 0.7895, 1 / 8), "equibiaxial"),
        ("square 0.95", square(1.0, 0.95, 1 / 8), "uniaxial"),
        ("hexagonal 0.924", hexagonal(1.386, 1.28, 1.386 / 8), "equibiaxial"),
        ("hexagonal 0.924", hexagonal(1.386, 1.28, 1.386 / 8), "uniaxial"),
        ("hexachiral", chiral(1.9, 0.095, 6), "strain"),
        ("rhombus 0.9", rhombus(0.1), "equibiaxial"),
        ("rhombus 0.7", rhombus(0.1, 0.7), "equibiaxial"),
    ):
        path = CellPath(PeriodicCell(cell, TwoTermI1()), LOADINGS[loading])
        found, texts = first_critical(path, CriticalSearch(divisions=2)), []
        for share in SHARES:
            state = found.state if share == 1.0 else path.at(share * found.load)
            modes = real_modes(path.cell, state, found.waves)
            whole = PeriodicCell(cell.enlarged(*modes.info["copies"]), TwoTermI1())
            copies = CellPath(whole, LOADINGS[loading])
            before = copies.at((1.0 - 1e-4) * modes.load)
            assert before is not None
            far = whole.critical_distances(before, modes.shapes, modes.eigenvalues).max()
            along = np.eye(len(modes.waves))[0].tolist()
            (reached,) = follow(copies, modes, along, [1.2 * found.load]).states
            texts.append(f"{far:.2%}, {reached.energy:.9g}")
        print(f"| {name} | {loading} | {' | '.join(texts)} |", flush=True)


def study() -> None:
    start, used = time.perf_counter(), time.process_time()
    print("| d/l | loading | critical | CPU s |")
    print("|---|---|---|---|")
    for ratio in STUDY:
        cell = square(1.0, ratio, 1 / 12)
        for name, loading in LOADINGS.items():
            begun = time.process_time()
            value = critical(cell, loading)
            print(f"| {ratio} | {name} | {value} | {time.process_time() - begun:.1f} |", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    passed, used = time.perf_counter() - start, time.process_time() - used
    print(f"\n{passed:.0f} s, {used:.0f} s of one core, {peak:.0f} MiB at the most")


WHAT = ("cost", "critical", "rates", "splitting", "distances", "study")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=WHAT)
    parser.add_argument("--sizes", type=int, nargs="+", default=(12, 24), help="elements a pitch")
    parser.add_argument("--meshes", type=int, default=4, help="number of nested meshes")
    asked = parser.parse_args()
    if asked.what == "cost":
        costs(asked.sizes)
    elif asked.what == "critical":
        criticals(asked.sizes)
    elif asked.what == "rates":
        rates(asked.meshes)
    elif asked.what == "splitting":
        for size in (0.1, 0.06):
            splitting(size)
    elif asked.what == "distances":
        distances()
    else:
        study()


if __name__ == "__main__":
    main()
