"""Homogenized specimens with bulk edges compared with direct simulations; their cost.

``scripts/env python benchmarks/homogenized_specimens.py [SECTION ...]`` prints, as Markdown, tables
of the pages docs/explanation/homogenization_PAGE.md (PAGE in brackets):

- ``specimen`` (specimens): the 6 x 10 and the 12 x 10 specimen, direct and homogenized.
- ``choices`` (specimens): effects of the RVE's centre, of v at bulk edges, of mode parameters.
- ``positions`` (positions): strips and specimens by the mean over positions of the RVE, spread
  evenly over a cell.
- ``translations`` (edges): specimens whose lattice is moved within its bulk, and their mean.
- ``edges`` (studies): energy by solid strips at plates and along sides, before buckling.
- ``zones`` (edge_energy): where the homogenized 6 x 10 specimen has too much energy.
- ``plates`` (plates): specimens with and without solid strips at the plates, at 8 to 11 %.
- ``corrected`` (edge_energy): specimens whose lattice is extended to correct the edges' energy.
- ``bent`` (triangular): a specimen bent or sheared while it is compressed.
- ``triangular`` (triangular): a specimen of triangular stacking.
- ``cost`` (strips): time and memory per linearisation and RVE, with 60 to 10 000 RVEs.
- ``shipped`` (strips): processor time of the stages of the case paper-homogenized.
- ``ranks`` (strips): seconds of the 6 x 10 specimen under ``mpirun -n N``; not by default.

Conditions are those of ``homogenization.py``.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from homogenization import (
    DIAMETER,
    HOLE,
    JUNCTION,
    MATERIAL,
    PATTERN,
    PITCH,
    SIZE,
    FloatArray,
    analytic,
    computed,
    direct_strip,
    head,
    homogenized_strip,
    row,
    run_sections,
    spread,
    supercell,
)
from homogenized_bowing import with_shear
from mpi4py import MPI

from modeharvest.fem.experiment import Experiment, PathOptions
from modeharvest.fem.field import Mesh, Solution
from modeharvest.fem.lattice.cells import hexagonal
from modeharvest.fem.lattice.micromorphic.body import PlateLoading, quadrature
from modeharvest.fem.lattice.micromorphic.branches import Homogenized, homogenize
from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody, LinearisedBody
from modeharvest.fem.lattice.micromorphic.edges import edge_shifts
from modeharvest.fem.lattice.micromorphic.patterns import PlaneWaves
from modeharvest.fem.lattice.micromorphic.rve import RVE
from modeharvest.fem.materials import JetMatrix
from modeharvest.fem.meshing import (
    SIGNS,
    MeshBlock,
    divisions_of,
    join,
    mesh_block,
    mesh_specimen,
    quarter_cell,
    rectangle,
)
from modeharvest.fem.path.bifurcation import follow_branch, locate_critical
from modeharvest.fem.path.continuation import PathFollower
from modeharvest.fem.path.equilibrium import EdgeCompression, Structure
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz
from modeharvest.runs.homogenization.case import HomogenizationCase
from modeharvest.runs.homogenization.pipeline import HomogenizationRun
from modeharvest.validation.homogenization import LatticeMode


def homogenized_specimen(
    rves: RVE | list[RVE],
    size: tuple[int, int],
    divisions: tuple[int, int],
    loads: tuple[float, ...],
    points: int | None = None,
    **options: Any,
) -> tuple[Homogenized, HomogenizedBody, float]:
    """Homogenize a specimen: the result, its body, and the wall-clock time [s]."""
    body = HomogenizedBody.of_specimen(
        Specimen(*size), rves, PlateLoading(**options), divisions=divisions, points=points
    )
    start = time.perf_counter()
    return homogenize(body, loads), body, time.perf_counter() - start


def compared(values: list[float], exact: list[float]) -> list[str]:
    """A critical strain, energies and a force as text, each with its relative difference."""
    texts = [f"{values[0]:.3%}", *(f"{v:.5f}" for v in values[1:])]
    pairs = zip(texts, values, exact[: len(values)], strict=True)
    with_difference = [f"{t} ({v / e - 1:+.2%})" for t, v, e in pairs]
    return with_difference + [""] * (len(exact) - len(values))


def specimen() -> None:
    for size, loads in (((6, 10), (0.078, 0.128)), ((12, 10), (0.082, 0.127))):
        columns = [f"energy at {e:.1%} [N]" for e in loads]
        name = f"{size[0]} x {size[1]}"
        head(name, "RVEs", "ε_c", *columns, "force there [N/mm]", "negative eigenvalues", "s")
        start = time.perf_counter()
        direct = simulate(Experiment(Specimen(*size), strains=loads))
        states = [direct.at(e) for e in loads]
        seconds = time.perf_counter() - start
        exact = [direct.info["critical"]["strain"], *(s.energy for s in states), states[1].reaction]
        texts = [f"{exact[0]:.3%}", *(f"{v:.5f}" for v in exact[1:])]
        row("direct", "", *texts, states[1].negative_pivots, f"{seconds:.0f}")
        x, y = size
        without = RVE(supercell(), MATERIAL, [], JUNCTION)
        for what, rve, parts, options in (
            ("quarter", analytic(), (x // 2 + 1, y // 2 + 1), {"quarter": True}),
            ("quarter", analytic(), (x, y), {"quarter": True}),
            ("quarter", analytic(), (2 * x, 2 * y), {"quarter": True}),
            ("quarter, 3 x 3 points", analytic(), (x, y), {"quarter": True, "points": 3}),
            ("quarter, Bloch φ", computed(), (x, y), {"quarter": True}),
            ("whole", analytic(), (x // 2, y // 2), {}),
            ("first order, quarter", without, (x, y), {"quarter": True}),
        ):
            found, body, seconds = homogenized_specimen(rve, size, parts, loads, **options)
            critical = found.critical.load if found.critical else np.nan
            values = [critical, *(s.energy for s in found.states)]
            buckled = [s for s in found.states if s.branch != "primary"]
            values = [*values, buckled[-1].force] if buckled else values[:2]
            unstable = buckled[-1].negative_eigenvalues if buckled else ""
            row(what, body.point_count, *compared(values, exact), unstable, f"{seconds:.0f}")


def choices() -> None:
    head("6 x 10, quarter, 24 RVEs", "ε_c", "change", "force at 12.8 % [N/mm]", "change")
    reference: list[float] = []

    def case(name: str, rves: RVE | list[RVE], **options: Any) -> None:
        found = homogenized_specimen(rves, (6, 10), (4, 6), (0.128,), quarter=True, **options)[0]
        e = found.critical.load if found.critical else np.nan
        force = found.states[-1].force if found.states else np.nan
        reference[:] = reference or [e, force]
        changes = [f"{v / r - 1:+.2%}" for v, r in zip((e, force), reference, strict=True)]
        row(name, f"{e:.3%}", changes[0], f"{force:.4f}", changes[1])

    case("as above", analytic())
    case("centre on a hole", analytic(HOLE))
    case("mean over 5 positions in a cell", spread(5))
    case("v free at bulk along the sides", analytic(), pattern_at_bulk="free")
    case("v free at bulk before the plates", analytic(), pattern_at_plates="free")
    case("v free at all bulk", analytic(), pattern_at_plates="free", pattern_at_bulk="free")
    case("Bloch φ", computed())
    sine = PATTERN.sine
    for name, change in (
        ("φ_x up by 10 %", PlaneWaves(PATTERN.vectors, PATTERN.cosine, sine * [1.1, 1.0])),
        ("one wave up by 2 %", PlaneWaves(PATTERN.vectors, PATTERN.cosine, sine * [[1.0], [1.02]])),
        ("φ moved by l/20 both ways", PATTERN.moved((0.05 * PITCH, 0.05 * PITCH))),
    ):
        case(name, RVE(supercell(), MATERIAL, [change], JUNCTION))


def positions() -> None:
    head("body", "positions", "RVEs", "ε_c", "stress at 8 and 10 % or energy, force")
    for n in (6, 12):
        both = [direct_strip(n, is_cut) for is_cut in (False, True)]
        exact = np.mean([e for e, _ in both])
        stress = np.mean([s for _, s in both], axis=0)
        for count in (1, 3, 5, 8):
            e, found = homogenized_strip(n, spread(count))
            changes = ", ".join(f"{x:+.2%}" for x in found / stress - 1)
            row(f"strip, {n} cells", count, "", f"{100 * e:.3f} ({e / exact - 1:+.2%})", changes)
    for size, parts, counts in (
        ((6, 10), (4, 6), (1, 5, 8, 13)), ((6, 10), (6, 10), (1, 5)),
        ((12, 10), (7, 6), (1, 5, 8)), ((12, 10), (12, 10), (1, 5)), ((12, 10), (24, 20), (1,)),
    ):  # fmt: skip
        loads = LOADS[size]
        direct = simulate(Experiment(Specimen(*size), strains=loads))
        exact, states = direct.info["critical"]["strain"], [direct.at(e) for e in loads]
        at = ", ".join(f"{100 * e:.3g}" for e in loads)
        for count in counts:
            whole, body, _ = homogenized_specimen(spread(count), size, parts, loads, quarter=True)
            e = whole.critical.load if whole.critical else np.nan
            changes = "; ".join(
                f"{ours.energy / state.energy - 1:+.2%}, {ours.force / state.reaction - 1:+.2%}"
                for ours, state in zip(whole.states, states, strict=True)
            )
            name = f"{size[0]} x {size[1]}, at {at} %"
            row(name, count, body.point_count * count, f"{e:.3%} ({e / exact - 1:+.2%})", changes)


LOADS = {(6, 10): (0.128,), (12, 10): (0.09, 0.1, 0.11, 0.127)}
"""Nominal strains at which specimens are compared [-]; at the last one 12 x 10 is unstable."""
PARTS = {(6, 10): (4, 6), (12, 10): (7, 6)}
"""Macroscopic elements of the whole specimen; a quarter has half as many along x and y."""


def half_cells(count: int, end: float, is_moved: bool) -> list[tuple[float, float]]:
    """A hole's coordinate and its side (-1 or 1), for all half cells between -end and end."""
    at = PITCH * (np.arange(count + is_moved) + 0.5 * (not is_moved)) - end
    return [(float(x), s) for x in at for s in (-1.0, 1.0) if abs(x + 0.25 * s * PITCH) < end]


def shifted_mesh(specimen: Specimen, shift: tuple[bool, bool], size: float = SIZE) -> Mesh:
    """Mesh of a specimen and its bulk with the lattice moved by half a cell along x, y or both.

    Bulk edges then cut holes in two, so that the amount of material stays the same.
    """
    half, gap = 0.5 * PITCH, 0.5 * (PITCH - DIAMETER)
    (a, b), (nx, ny) = specimen.cellular_half_size, (specimen.holes_x, specimen.holes_y)
    bx, by = specimen.bulk_x, specimen.bulk_y
    quarter = quarter_cell(PITCH, DIAMETER, size)
    columns, rows = half_cells(nx, a, shift[0]), half_cells(ny, b, shift[1])
    blocks = [quarter.placed((sx, sy), (x, y)) for x, sx in columns for y, sy in rows]

    def strip(width: float, is_cut: bool, along_x: bool) -> MeshBlock:
        """Bulk beside half a cell, from the hole's centre at 0 to the cell's corner at l / 2."""
        n, m = divisions_of(width, size), divisions_of(half, size)
        if not is_cut:
            return rectangle(width, half, n, m) if along_x else rectangle(half, width, m, n)
        hole, solid = divisions_of(half - gap, size), divisions_of(gap, size)
        corners = [(0.0, 0.0), (width, 0.0), (width, half), (0.0, half), (0.0, half - gap)]
        counts = [n, m, n, solid, hole]
        if along_x:
            return mesh_block(corners, counts)
        corners = [(y, x) for x, y in reversed(corners)]
        return mesh_block([corners[-1], *corners[:-1]], [hole, solid, n, m, n])

    beside, above = strip(bx, shift[0], True), strip(by, shift[1], False)
    blocks += [beside.placed((s, sy), (s * a, y)) for s in (-1.0, 1.0) for y, sy in rows]
    blocks += [above.placed((sx, s), (x, s * b)) for s in (-1.0, 1.0) for x, sx in columns]
    corner = rectangle(bx, by, divisions_of(bx, size), divisions_of(by, size))
    blocks += [corner.placed(s, (s[0] * a, s[1] * b)) for s in SIGNS]
    return join(blocks, 1e-7 * PITCH)


def translations() -> None:
    """Print direct simulations of specimens whose lattice is moved within its bulk."""
    # At the last strain all 12 x 10 specimens are stable, but not all 6 x 10 ones.
    for size, first, load in (((6, 10), 0.078, 0.128), ((12, 10), 0.082, 0.1)):
        name, specimen = f"{size[0]} x {size[1]}", Specimen(*size)
        head(name, "ε_c", f"energy at {first:.1%} [N]", f"energy at {load:.1%} [N]",
             "force there [N/mm]", "negative eigenvalues")  # fmt: skip
        found = []
        for shift in product((False, True), repeat=2):
            loading = EdgeCompression(specimen.half_size[0], specimen.length)
            structure = Structure(shifted_mesh(specimen, shift), MATERIAL, loading)
            follower = PathFollower(structure, PathOptions())
            path = [follower.start()]
            follower.follow_primary(path, (first, load), until_unstable=True)
            is_odd = specimen.holes_x + shift[0], specimen.holes_y + shift[1]
            critical = None
            if any(n % 2 == 0 for n in is_odd):
                critical = locate_critical(follower, path[-2], path[-1])
                assert critical is not None
                (state,) = follow_branch(follower, critical, [load], 1, PITCH)
            else:  # the pattern has the specimen's symmetries, and grows from the start
                path, follower.linearisation = path[:1], None
                follower.follow_primary(path, (first, load), refuse_unstable=True)
                state = path[-1]
            before = next(s for s in path if abs(s.strain - first) < 1e-12)
            values = [structure.energy(before.u), structure.energy(state.u),
                      structure.reaction(state.u, specimen.length)]  # fmt: skip
            if abs(state.strain - load) > 1e-12:  # it became unstable before
                values[1:] = [np.nan, np.nan]
            e = critical.strain if critical else np.nan
            found.append([e, *values])
            moved = " and ".join(axis for axis, is_moved in zip("xy", shift, strict=True)
                                 if is_moved)  # fmt: skip
            name_of = f"moved along {moved}" if moved else "whole cells"
            row(name_of, f"{e:.3%}" if critical else "none",
                *(f"{v:.5f}" for v in values), state.negative_pivots)  # fmt: skip
        mean = np.nanmean(found, axis=0)
        row("mean", f"{mean[0]:.3%}", *(f"{v:.5f}" for v in mean[1:]), "")
        for count in (1, 5, 8):
            whole, _, _ = homogenized_specimen(
                spread(count), size, PARTS[size], (first, load), quarter=True
            )
            critical_strain = whole.critical.load if whole.critical else np.nan
            early, last = whole.states
            cells = compared(
                [critical_strain, early.energy, last.energy, last.force], mean.tolist()
            )
            row(f"homogenized, {count} position(s)", *cells, last.negative_eigenvalues)


EARLY = 0.01
"""Nominal strain before buckling, at which there is no pattern [-]."""


def edges() -> None:
    """Print the excess energy of homogenized specimens of several sizes, by their solid edges.

    For n x m cells it is e0 + e1 m + e2 n + e3 n m: of corners, plates, sides and the inside.
    """
    sizes = ((6, 10), (12, 10), (12, 20), (24, 20))
    rve = RVE(supercell(), MATERIAL, [], JUNCTION)
    head(f"at {EARLY:.0%}: strips before plates, along sides [mm]",
         *(f"{n} x {m} [1e-6 N]" for n, m in sizes), "inside, of a cell's",
         "plates, a row", "sides, a column", "corners")  # fmt: skip
    n, m = np.array(sizes, float).T
    terms = np.stack([n**0, m, n, n * m], axis=1)
    for bulk_y, bulk_x in product((0.9, 0.0), (1.9, 0.0)):
        both = list[tuple[float, float]]()
        for size in sizes:
            specimen = Specimen(*size, bulk_x=bulk_x, bulk_y=bulk_y)
            loading = EdgeCompression(specimen.half_size[0], specimen.length)
            structure = Structure(mesh_specimen(specimen, SIZE), MATERIAL, loading)
            follower = PathFollower(structure, PathOptions())
            path = [follower.start()]
            follower.follow_primary(path, (EARLY,), until_unstable=True)
            body = HomogenizedBody.of_specimen(
                specimen, rve, PlateLoading(quarter=True), divisions=size
            )
            found = homogenize(body, [EARLY])
            both.append((found.states[0].energy, structure.energy(path[-1].u)))
        energy, exact = 1e6 * np.array(both).T
        cell = np.linalg.solve(terms, exact)[3]
        corners, plates, sides, inside = np.linalg.solve(terms, energy - exact)
        row(f"{bulk_x:g}, {bulk_y:g}",
            *(f"{a - b:+.0f} ({a / b - 1:+.2%})" for a, b in zip(energy, exact, strict=True)),
            f"{inside / cell:+.2%}", f"{plates:+.1f}", f"{sides:+.1f}",
            f"{corners:+.0f}")  # fmt: skip


ZONES = ("cells inside", "cells at the sides", "cells at the plates", "cells in the corners",
         "solid along the sides", "solid before the plates")  # fmt: skip


def energies_by_zone(specimen: Specimen, places: FloatArray, energy: FloatArray) -> FloatArray:
    """(6,) sums over ``ZONES`` of energies (n,) at places (n, 2) [mm]."""
    (x, y), (a, b) = np.abs(places).T, specimen.cellular_half_size
    at_plates, at_sides = x > a - PITCH, y > b - PITCH
    cells = np.where(at_sides, np.where(at_plates, 3, 1), np.where(at_plates, 2, 0))
    zone = np.where(x > a, 5, np.where(y > b, 4, cells))
    return np.bincount(zone, energy, len(ZONES))


def zones() -> None:
    """Print where a homogenized specimen has more energy than the direct one."""
    loads, specimen = (0.04, 0.08, 0.1, 0.128), Specimen()
    direct = simulate(Experiment(specimen, strains=loads))
    at, exact = quadrature(direct.mesh, 3), []
    for snapshot in map(direct.at, loads):
        H = np.einsum("cka,cpkb->cpab", snapshot.displacement[direct.mesh.cells], at.gradients)
        W = MATERIAL.energy(JetMatrix(np.eye(2) + H.reshape(-1, 2, 2))).value
        places = at.places.reshape(-1, 2)
        exact.append(energies_by_zone(specimen, places, at.weights.ravel() * W))
    rve, loading = analytic(), PlateLoading(quarter=True)
    body = HomogenizedBody.of_specimen(specimen, rve, loading, divisions=(6, 10))
    head("6 x 10, in excess, of the direct energy of all", *ZONES, "all")
    for state, energies in zip(homogenize(body, loads).states, exact, strict=True):
        each = zip(state.strains, body.fluctuations(state.value), strict=True)
        strains = body.strains(body.unknowns(state.value, state.load))
        densities = np.array([rve.energy(q, w) for q, w in each]), body.bulk_response(strains[1])[0]
        ours = np.zeros(len(ZONES))
        for region, W in zip(body.regions, densities, strict=True):
            places, weights = region.at.places.reshape(-1, 2), region.at.weights.ravel()
            ours += body.copies * energies_by_zone(specimen, places, weights * W)
        excess = (ours - energies) / energies.sum()
        row(f"{state.load:.1%}", *(f"{x:+.2%}" for x in excess), f"{excess.sum():+.2%}")


STRAINS = (0.08, 0.09, 0.1, 0.11)


def plates() -> None:
    """Print specimens with and without solid strips at the plates, by choices of the method."""
    at = (f"energy, force at {e:.0%}" for e in STRAINS)
    head("specimen", "strips [mm]", "homogenized", "RVEs", "ε_c", *at)
    quarter, free = {"quarter": True}, {"quarter": True, "pattern_at_bulk": "free"}
    for size, strip in product(((6, 10), (12, 10)), (0.0, 1.9)):
        specimen, name = Specimen(*size, bulk_x=strip), f"{size[0]} x {size[1]}"
        direct = simulate(Experiment(specimen, strains=STRAINS))
        states, exact = states_of(direct, STRAINS), direct.info["critical"]["strain"]
        row(name, strip, "direct", "", f"{exact:.3%}",
            *(f"{energy:.5f} N, {force:.5f} N/mm" for energy, force, _ in states))  # fmt: skip
        cases: list[tuple[str, RVE | list[RVE], dict[str, Any]]]
        cases = [("1 position", analytic(), quarter), ("5 positions", spread(5), quarter)]
        if strip:
            cases.append(("v free along the sides", analytic(), free))
            cases.append(("whole, with φ_S as a second mode", with_shear(), {}))
        if strip and size == (12, 10):
            cases.append(("Bloch φ", computed(), quarter))
            cases.append(("centre on a hole", analytic(HOLE), quarter))
        for what, rves, options in cases:
            parts = PARTS[size] if options else (size[0] // 2, size[1] // 2)
            body = HomogenizedBody.of_specimen(
                specimen, rves, PlateLoading(**options), divisions=parts
            )
            found = homogenize(body, STRAINS)
            e = found.critical.load if found.critical else np.nan
            both = zip(found.states, states, strict=False)
            row(name, strip, what, body.point_count * len(body.rves),
                f"{e:.3%} ({e / exact - 1:+.2%})",
                *(f"{h.energy / energy - 1:+.2%}, {h.force / force - 1:+.2%}"
                  for h, (energy, force, _) in both))  # fmt: skip


def corrected() -> None:
    """Print specimens whose lattice is extended to correct the energy of its edges."""
    bare, loading = Specimen(bulk_x=0.0, bulk_y=0.0), PlateLoading(quarter=True)
    start = time.process_time()
    shifts = edge_shifts(Specimen(), MATERIAL, SIZE, loading)
    seconds = time.process_time() - start
    without = edge_shifts(bare, MATERIAL, SIZE, loading)
    print(f"\nLonger and higher at each end by {np.round(shifts, 5)} mm, found in {seconds:.2f} s; "
          f"without strips {np.round(without, 5)} mm.")  # fmt: skip
    for size, strains in (((6, 10), (*STRAINS, 0.128)), ((12, 10), STRAINS)):
        specimen, name = Specimen(*size), f"{size[0]} x {size[1]}"
        direct = simulate(Experiment(specimen, strains=strains))
        states, exact = states_of(direct, strains), direct.info["critical"]["strain"]
        at = (f"energy, force at {e:.3g}%" for e in 100 * np.array(strains))
        head(name, "RVEs", "ε_c", *at, "negative eigenvalues")
        for count in (1, 5):
            body = HomogenizedBody.of_specimen(
                specimen, spread(count), loading, divisions=PARTS[size], edge_shifts=shifts
            )
            found = homogenize(body, strains)
            e = found.critical.load if found.critical else np.nan
            both = zip(found.states, states, strict=True)
            row(f"{count} position(s)", body.point_count * count, f"{e:.3%} ({e / exact - 1:+.2%})",
                *(f"{h.energy / energy - 1:+.2%}, {h.force / force - 1:+.2%}"
                  for h, (energy, force, _) in both),
                found.states[-1].negative_eigenvalues)  # fmt: skip


DirectState = tuple[float, float, int]
"""Energy [N], force [N/mm], negative eigenvalues."""


def states_of(direct: Solution, strains: Sequence[float]) -> list[DirectState]:
    return [(s.energy, s.reaction, s.negative_pivots) for s in map(direct.at, strains)]


def direct_row(
    title: str, strains: Sequence[float], states: Sequence[DirectState], seconds: float,
    critical: float | None = None,
) -> None:  # fmt: skip
    """Print the head of a table and its row of the direct simulation."""
    at = (f"energy, force at {e:.0%}" for e in strains)
    head(title, "RVEs", "ε_c", *at, "negative eigenvalues", "s")
    values = (f"{energy:.5f} N, {force:.5f} N/mm" for energy, force, _ in states)
    unstable = ", ".join(str(negative) for _, _, negative in states)
    row("direct", "", f"{critical:.3%}" if critical else "", *values, unstable, f"{seconds:.0f}")


def homogenized_row(
    name: str, body: HomogenizedBody, strains: Sequence[float], exact: Sequence[DirectState],
    critical: float | None = None, shortening: FloatArray | None = None,
) -> None:  # fmt: skip
    """Print a row; ``shortening``: rates of all unknowns on which the direct force does work."""
    start, values = time.perf_counter(), list[str]()
    found = homogenize(body, strains)
    seconds = time.perf_counter() - start
    for h, (energy, force, _) in zip(found.states, exact, strict=False):
        ours = h.force
        if shortening is not None:
            ours = LinearisedBody(body, h.load, h.value).forces @ shortening / body.length
        values.append(f"{h.energy / energy - 1:+.2%}, {ours / force - 1:+.2%}")
    values += [""] * (len(exact) - len(values))
    e = f"{found.critical.load:.3%}" if found.critical else "none"
    if critical and found.critical:
        e += f" ({found.critical.load / critical - 1:+.1%})"
    unstable = ", ".join(str(h.negative_eigenvalues) for h in found.states)
    row(name, body.point_count, e, *values, unstable, f"{seconds:.0f}")


SHEAR = 0.5
"""Transverse displacement of the plates per unit of compression [-]."""


class ShearedStructure(Structure):
    """Plates that also move transversely, as with ``PlateLoading(shear=SHEAR)``."""

    def _constrain(self, loading: EdgeCompression) -> None:
        super()._constrain(loading)
        x = self.V.tabulate_dof_coordinates()[:, 0]
        on_plates = np.abs(np.abs(x) - loading.half_width) < 1e-8 * loading.half_width
        across = self._direction.x.array.reshape(-1, 2)[:, 1]
        across[on_plates] = 0.5 * SHEAR * loading.length * np.sign(x[on_plates])
        self._shortening = self._direction.x.array.copy()  # so that a reaction is dE/de


def sheared() -> None:
    strains, specimen, small = (0.04, 0.08, 0.1, 0.12), Specimen(), PathOptions(0.01, 0.01)
    start = time.perf_counter()
    compression = EdgeCompression(specimen.half_size[0], specimen.length)
    structure = ShearedStructure(mesh_specimen(specimen, SIZE), MATERIAL, compression)
    follower = PathFollower(structure, small)
    path = [follower.start()]
    follower.follow_primary(path, strains, refuse_unstable=True)
    exact = [
        (structure.energy(s.u), structure.reaction(s.u, specimen.length), s.negative_pivots)
        for s in path
        if np.abs(np.array(strains) - s.strain).min() < 1e-12
    ]
    title = f"6 x 10, compressed and sheared by {SHEAR:g} of that"
    direct_row(title, strains, exact, time.perf_counter() - start)
    for parts in ((3, 5), (6, 10)):
        loading = PlateLoading(shear=SHEAR)
        body = HomogenizedBody.of_specimen(specimen, analytic(), loading, divisions=parts)
        homogenized_row("homogenized", body, strains, exact)


def ranks() -> None:
    world = MPI.COMM_WORLD
    start, used = time.perf_counter(), time.process_time()
    found, body, _ = homogenized_specimen(analytic(), (6, 10), (6, 10), (0.128,), quarter=True)
    spent = world.gather((time.perf_counter() - start, time.process_time() - used))
    if spent is not None:
        assert found.critical is not None
        head("ranks", "RVEs", "ε_c", "force at 12.8% [N/mm]", "seconds", "of each rank's core")
        row(
            world.size, body.point_count, f"{found.critical.load:.4%}",
            f"{found.states[-1].force:.5f}", f"{max(s for s, _ in spent):.1f}",
            ", ".join(f"{s:.1f}" for _, s in spent),
        )  # fmt: skip


def tilted(body: HomogenizedBody, tilt: float) -> FloatArray:
    """Turn the right plate by ``tilt`` per unit of strain [rad]; returns the rates without that."""
    shortening, nodes = body.direction.copy(), body.mesh.nodes
    right = np.flatnonzero(nodes[:, 0] > nodes[:, 0].max() - 1e-9)
    body.direction[right * (2 + body.mode_count)] -= tilt * nodes[right, 1]
    return shortening


def bent() -> None:
    strains = (0.03, 0.05, 0.06, 0.07, 0.08)
    start = time.perf_counter()
    direct = simulate(Experiment(Specimen(), strains=strains, tilt=1.0))
    exact_states = states_of(direct, strains)
    title = "6 x 10, one plate turned by 1 rad a unit of strain"
    direct_row(title, strains, exact_states, time.perf_counter() - start)
    shifts = edge_shifts(Specimen(), MATERIAL, SIZE, PlateLoading())
    none = (0.0, 0.0)
    for name, parts, moved in (
        ("homogenized", (3, 5), none), ("homogenized", (6, 10), none),
        ("with edge shifts", (3, 5), shifts),
    ):  # fmt: skip
        body = HomogenizedBody.of_specimen(
            Specimen(), analytic(), PlateLoading(), divisions=parts, edge_shifts=moved
        )
        homogenized_row(name, body, strains, exact_states, shortening=tilted(body, 1.0))
    sheared()


def triangular() -> None:
    strains, specimen = (0.06, 0.08, 0.1), Specimen(8, 17, 1.68, stacking="triangular")
    start = time.perf_counter()
    direct = simulate(Experiment(specimen, strains=strains, mesh_size=0.3))
    states, critical = states_of(direct, strains), direct.info["critical"]["strain"]
    direct_row("8 x 17, triangular", strains, states, time.perf_counter() - start, critical)
    four = hexagonal(specimen.pitch, specimen.diameter, 0.3).enlarged(2, 2)
    waves = [
        LatticeMode.of(m, m.family.start, specimen, four.lattice).snapped
        for m in Ansatz.of_specimen(specimen).modes
    ]
    for name, modes in (("φ₁, φ₂, φ₃", waves), ("φ₁, φ₃", waves[::2]), ("first order", [])):
        rve = RVE(four, MATERIAL, modes, HOLE)
        body = HomogenizedBody.of_specimen(specimen, rve, PlateLoading(), divisions=(4, 8))
        homogenized_row(name, body, strains, states, critical)


def cost() -> None:
    head(
        "RVEs",
        "macroscopic unknowns",
        "ms a linearisation and RVE",
        "peak memory [MB]",
        "kB an RVE",
    )
    loading, before = PlateLoading(), 0.0
    for parts in ((3, 5), (6, 10), (12, 20), (25, 40), (50, 50)):
        body = HomogenizedBody.of_specimen(Specimen(), analytic(), loading, divisions=parts)
        value = body.start
        value[: body.free_count][body.is_pattern] = 0.01
        start = time.process_time()
        LinearisedBody(body, 0.01, value)
        seconds, count = time.process_time() - start, body.point_count
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        row(
            count,
            body.free_count,
            f"{1e3 * seconds / count:.2f}",
            f"{peak:.0f}",
            f"{1024 * (peak - before) / count:.0f}" if before else "",
        )
        before = before or peak


def shipped() -> None:
    """Print the processor time of the stages of the shipped case [s]."""
    with tempfile.TemporaryDirectory() as folder:
        run = HomogenizationRun(HomogenizationCase.read("paper-homogenized"), Path(folder))
        virtual, seconds = run.virtual, []
        for stage in (virtual.fem, virtual.image, virtual.correlate, virtual.all, run.mode,
                      run.homogenize, run.report):  # fmt: skip
            start = time.process_time()
            stage()
            seconds.append(time.process_time() - start)
    head("direct simulation", "images", "correlation", "what that run compares and draws",
         "mode, snapped", "homogenized, error bars, first order, RVEs", "report")  # fmt: skip
    row(*(f"{s:.1f}" for s in seconds))


SECTIONS: dict[str, Callable[[], None]] = {
    "specimen": specimen, "choices": choices, "positions": positions,
    "translations": translations, "edges": edges, "zones": zones, "plates": plates,
    "corrected": corrected, "bent": bent,
    "triangular": triangular, "cost": cost, "shipped": shipped, "ranks": ranks,
}  # fmt: skip

if __name__ == "__main__":
    run_sections(argparse.ArgumentParser(description=__doc__), SECTIONS, "ranks")
