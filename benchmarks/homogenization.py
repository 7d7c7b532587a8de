"""Micromorphic homogenization against Bloch waves, direct simulations and an independent code.

``scripts/env python benchmarks/homogenization.py [SECTION ...]`` prints the tables of
docs/homogenization.md, as Markdown:

- ``cell``: homogeneous patterns: critical strain and stress on the branch, against Bloch waves and
  the branch of the periodic cell.
- ``strips``: n cells between clamped plates, periodic sideways: direct simulations (mean of two
  positions of the lattice against the plates), and homogenized ones with an analytic mode, the
  critical Bloch mode, and the mode that is measured in the images of the case paper-homogenized.
  ``--picture PNG`` draws the size effect.
- ``specimen``: the 6 x 10 and the 12 x 10 specimen, direct and homogenized.
- ``choices``: what the RVE's centre, v at bulk edges and the mode's parameters do to the former.
- ``positions``: means over positions of the RVE that are spread evenly over a cell, of strips and
  specimens.
- ``translations``: specimens whose lattice is moved against their bulk edges, and their mean.
- ``bowing``: where a whole specimen becomes unstable once more, and how.
- ``flower``: three modes of triangular stacking under equibiaxial load, computed, analytic and
  measured in an image: all branches by energy, against those of the periodic cell.
- ``loads``: sides, shear and bending: against Bloch waves, and a specimen bent or sheared as it is
  compressed against its direct simulation.
- ``independence``: a strip of six cells with other macroscopic elements, points and RVE's elements.
- ``triangular``: a specimen of triangular stacking, direct and homogenized.
- ``cost``: seconds and memory a linearisation and RVE, from 60 to 10 000 RVEs.
- ``ranks``: seconds of the 6 x 10 specimen, for ``mpirun -n N`` before ``python``.

What isn't said otherwise has square stacking, pitch 1.9 mm, d = 1.5 mm, the default Ogden material,
elements of 0.2 mm. All sections but ``ranks``, which are what is run by default, take about
an hour.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.spatial import cKDTree

from modeharvest.fem.bloch.critical import critical_at, first_critical
from modeharvest.fem.bloch.modes import BranchState, ModeSet
from modeharvest.fem.bloch.postbuckling import follow
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.experiment import Experiment, PathOptions
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, hexagonal, square
from modeharvest.fem.lattice.micromorphic.branches import Homogenized, homogenize
from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody, LinearisedBody
from modeharvest.fem.lattice.micromorphic.mesh import rectangle_mesh
from modeharvest.fem.lattice.micromorphic.options import PlateLoading
from modeharvest.fem.lattice.micromorphic.patterns import ModeField, PlaneWaves, rotation_pattern
from modeharvest.fem.lattice.micromorphic.rve import RVE, spread_positions
from modeharvest.fem.lattice.options import (
    CriticalSearch,
    MacroLoading,
    equibiaxial,
    uniaxial,
    uniaxial_strain,
)
from modeharvest.fem.materials import Ogden, TwoTermI1
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
from modeharvest.idic.ansatz import Ansatz, AnsatzOptions
from modeharvest.idic.correlate import correlate
from modeharvest.idic.uncertainty.identifiability import identifiability
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.report.figures.style import BLUE, GOLD, GREEN, RED, figure
from modeharvest.runs.homogenization.case import HomogenizationCase
from modeharvest.runs.homogenization.pipeline import HomogenizationRun
from modeharvest.util.files import atomic
from modeharvest.validation.homogenization import LatticeMode

FloatArray = NDArray[np.float64]
PITCH, DIAMETER, SIZE = 1.9, 1.5, 0.2
JUNCTION, HOLE = (0.5 * PITCH, 0.5 * PITCH), (0.0, 0.0)
MATERIAL, PATTERN = Ogden(), rotation_pattern(PITCH)
REFERENCE = {4: (7.445, 6.604), 6: (6.223, 5.948), 8: (5.791, 5.665), 10: (5.585, 5.523)}
REFERENCE |= {12: (5.478, 5.442)}
"""Critical strains [%] of strips, direct and micromorphic, by an independent code (T6, 0.2 mm)."""


def row(*cells: object) -> None:
    print("|", " | ".join(str(cell) for cell in cells), "|", flush=True)


def head(*cells: str) -> None:
    print()
    row(*cells)
    print("|" + "---|" * len(cells))


def supercell(size: float = SIZE) -> UnitCell:
    return square(PITCH, DIAMETER, size).enlarged(2, 2)


@cache
def analytic(centre: tuple[float, float] = JUNCTION, size: float = SIZE) -> RVE:
    return RVE(supercell(size), MATERIAL, [PATTERN], centre)


def spread(count: int) -> list[RVE]:
    """Of as many positions of a lattice rule, as ``positions`` of a case has them."""
    at = np.array(JUNCTION) + PITCH * spread_positions(count)
    return [analytic((float(x), float(y))) for x, y in at]


@cache
def bloch_modes(loading: MacroLoading) -> ModeSet:
    primitive = PeriodicCell(square(PITCH, DIAMETER, SIZE), MATERIAL)
    found = first_critical(CellPath(primitive, loading), CriticalSearch(divisions=2))
    return real_modes(primitive, found.state, found.waves)


@cache
def computed() -> RVE:
    modes = bloch_modes(uniaxial_strain())
    return RVE(UnitCell(modes.mesh, modes.lattice), MATERIAL, list(modes.shapes), JUNCTION)


def cell() -> None:
    head("loading", "what", "homogenized", "lattice", "difference")
    fixed = PlateLoading(sides="periodic", pattern_at_plates="free")
    loose = PlateLoading(plates="sliding", pattern_at_plates="free")
    for name, plates, loading in (
        ("uniaxial strain", fixed, uniaxial_strain()),
        ("uniaxial stress", loose, uniaxial()),
    ):
        body = HomogenizedBody.of_specimen(
            Specimen(2, 2, bulk_x=0, bulk_y=0), analytic(), plates, divisions=(1, 1)
        )
        found, modes = homogenize(body, [0.1]), bloch_modes(loading)
        assert found.critical is not None
        e, exact = found.critical.load, modes.load
        row(name, "critical strain", f"{e:.6%}", f"{exact:.6%}", f"{e / exact - 1:.1e}")
        path = CellPath(PeriodicCell(supercell(), MATERIAL), loading)
        branch = follow(path, modes, (1.0,), [0.1]).states[0]
        P, exact = -found.states[0].stresses[0, 0], -branch.stress[0, 0]
        row("", "stress at 10 % [MPa]", f"{P:.8f}", f"{exact:.8f}", f"{P / exact - 1:.1e}")


def strip_mesh(cells: int, is_cut: bool, size: float) -> Mesh:
    """From the centres of one row of holes to those of the next, where u_y = 0 by symmetry.

    Plates touch the lattice between holes or, ``is_cut``, cut through them.
    """
    quarter, half = quarter_cell(PITCH, DIAMETER, size), 0.5 * cells * PITCH
    columns = (
        np.arange(cells + 1) * PITCH - half
        if is_cut
        else np.arange(cells) * PITCH + JUNCTION[0] - half
    )
    blocks = [
        quarter.placed(sign, (float(x), -0.5 * sign[1] * PITCH))
        for x in columns
        for sign in SIGNS
        if abs(x + 0.25 * sign[0] * PITCH) < half
    ]
    return join(blocks, 1e-7 * PITCH)


def direct_strip(cells: int, is_cut: bool, size: float = SIZE) -> tuple[float, list[float]]:
    """Critical strain and nominal stresses at 8 and 10 % [MPa] of a strip."""
    mesh, length = strip_mesh(cells, is_cut, size), cells * PITCH
    edge = mesh.nodes[np.abs(np.abs(mesh.nodes[:, 1]) - 0.5 * PITCH) < 1e-6]
    pins = tuple((float(x), float(y)) for x, y in edge)
    structure = Structure(mesh, MATERIAL, EdgeCompression(0.5 * length, length, pins=pins))
    follower = PathFollower(structure, PathOptions(first_step=0.02, largest_step=0.02))
    path = [follower.start()]
    follower.follow_primary(path, (0.12,), until_unstable=True)
    critical = locate_critical(follower, path[-2], path[-1])
    assert critical is not None
    states = follow_branch(follower, critical, [0.08, 0.1], 1, PITCH)
    return critical.strain, [structure.reaction(s.u, length) / PITCH for s in states]


def homogenized_strip(
    cells: int, rve: RVE | list[RVE], parts: int | None = None, points: int = 2
) -> tuple[float, list[float]]:
    specimen, divisions = Specimen(cells, 2, bulk_x=0, bulk_y=0), (parts or cells, 1)
    body = HomogenizedBody.of_specimen(
        specimen, rve, PlateLoading(sides="periodic"), divisions=divisions, points=points
    )
    found = homogenize(body, [0.08, 0.1])
    critical = found.critical.load if found.critical else np.nan
    return critical, [state.force / (2 * PITCH) for state in found.states]


@cache
def measured() -> RVE:
    """With the mode that the images of the shipped case show, snapped to the lattice."""
    with tempfile.TemporaryDirectory() as folder:
        run = HomogenizationRun(HomogenizationCase.read("paper-homogenized"), Path(folder))
        run.virtual.fem()
        run.virtual.image()
        (mode,), _, _ = run.mode()
    return RVE(supercell(), MATERIAL, [mode.snapped], JUNCTION)


MODES = {"analytic φ": analytic, "Bloch φ": computed, "measured φ": measured}
STRESSES = (0.08, 0.1)
"""Nominal strains at which stresses are compared [-]."""


def size_effect() -> dict[str, FloatArray]:
    """Critical strain [-] and stresses [MPa] (n, 3) of strips, of each kind of prediction.

    Direct simulations are (n, 2, 3), for the lattice's two positions against the plates.
    """
    free = PlateLoading(sides="periodic", pattern_at_plates="free")
    one = HomogenizedBody.of_specimen(
        Specimen(2, 2, bulk_x=0, bulk_y=0), analytic(), free, divisions=(1, 1)
    )
    local = homogenize(one, STRESSES)
    assert local.critical is not None  # with plates that hold F̄ alone, the same for every n
    first = local.critical.load, *(state.force / (2 * PITCH) for state in local.states)
    found: dict[str, FloatArray] = {"direct": np.array([
        [(e, *stresses) for e, stresses in (direct_strip(n, is_cut) for is_cut in (False, True))]
        for n in REFERENCE
    ])}  # fmt: skip
    for name, rve in MODES.items():
        strips_of = [homogenized_strip(n, rve()) for n in REFERENCE]
        found[name] = np.array([(e, *stresses) for e, stresses in strips_of])
    return found | {"first order": np.tile(first, (len(REFERENCE), 1))}


def strips() -> None:
    found = size_effect()
    direct, kinds = found["direct"].mean(axis=1), [*MODES, "first order"]
    head(
        "cells", "direct ε_c [%]", *kinds, "direct stress at 8, 10 % [MPa]", *kinds,
        "independent: direct, analytic φ",
    )  # fmt: skip
    for k, n in enumerate(REFERENCE):
        e, *stress = direct[k]
        both = ", ".join(f"{100 * x:.3f}" for x in found["direct"][k, :, 0])
        strains = [found[kind][k, 0] for kind in kinds]
        changes = [found[kind][k, 1:] / stress - 1 for kind in kinds]
        row(
            n, f"{100 * e:.3f} ({both})", *(f"{100 * x:.3f} ({x / e - 1:+.1%})" for x in strains),
            ", ".join(f"{s:.5f}" for s in stress),
            *(", ".join(f"{x:+.1%}" for x in change) for change in changes),
            ", ".join(f"{e:.3f}" for e in REFERENCE[n]),
        )  # fmt: skip
    if PICTURE:
        draw_size_effect(found, PICTURE[0])


def draw_size_effect(found: dict[str, FloatArray], path: Path) -> None:
    """Draw critical strains and stresses over the number of cells."""
    made, n = figure(9.0, 3.2), list(REFERENCE)
    labels = ["critical strain [%]", *(f"nominal stress at {e:.0%} [kPa]" for e in STRESSES)]
    looks = (BLUE, "o-"), (GREEN, "s-"), (RED, "^--"), (GOLD, ":")
    for k, (axes, label) in enumerate(zip(made.subplots(1, 3), labels, strict=True)):
        scale = 1000 if k else 100
        both = scale * found["direct"][:, :, k].T
        axes.errorbar(
            n, both.mean(axis=0), 0.5 * np.ptp(both, axis=0), color="black", marker="D", ms=4,
            lw=1.2, capsize=2.5, label="direct: mean and both positions",
        )  # fmt: skip
        for kind, (colour, line) in zip([*MODES, "first order"], looks, strict=True):
            name = f"micromorphic, {kind}" if kind in MODES else kind
            axes.plot(n, scale * found[kind][:, k], line, color=colour, ms=3.5, lw=1.2, label=name)
        axes.set(xlabel="cells between the plates", ylabel=label, xticks=n)
        axes.grid(alpha=0.25)
    handles = made.axes[0].get_legend_handles_labels()
    made.legend(*handles, frameon=False, loc="upper center", ncols=5, fontsize=7.5)
    made.tight_layout(rect=(0, 0, 1, 0.92))
    made.patch.set_facecolor("white")
    with atomic(path) as temporary:
        made.savefig(temporary, format="png", dpi=150, facecolor="white")


def homogenized_specimen(
    rves: RVE | list[RVE],
    size: tuple[int, int],
    divisions: tuple[int, int],
    loads: tuple[float, ...],
    points: int = 2,
    **options: Any,
) -> tuple[Homogenized, HomogenizedBody, float]:
    """What is found, of what, and in how many seconds."""
    body = HomogenizedBody.of_specimen(
        Specimen(*size), rves, PlateLoading(**options), divisions=divisions, points=points
    )
    start = time.perf_counter()
    return homogenize(body, loads), body, time.perf_counter() - start


def compared(values: list[float], exact: list[float]) -> list[str]:
    """A critical strain, energies and a force, each with its difference."""
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
    for size, parts, counts in (((6, 10), (4, 6), (1, 5, 8, 13)), ((6, 10), (6, 10), (1, 5)),
                                ((12, 10), (7, 6), (1, 5, 8))):  # fmt: skip
        load = LOADS[size]
        direct = simulate(Experiment(Specimen(*size), strains=(load,)))
        exact = direct.info["critical"]["strain"]
        state = direct.at(load)
        for count in counts:
            whole, body, _ = homogenized_specimen(spread(count), size, parts, (load,), quarter=True)
            e, reached = whole.critical.load if whole.critical else np.nan, whole.states[-1]
            row(
                f"{size[0]} x {size[1]}, {load:.1%}", count, body.point_count * count,
                f"{e:.3%} ({e / exact - 1:+.2%})", f"{reached.energy / state.energy - 1:+.2%}, "
                f"{reached.force / state.reaction - 1:+.2%}",
            )  # fmt: skip


LOADS = {(6, 10): 0.128, (12, 10): 0.127}
"""Nominal strains at which specimens are compared [-]."""
PARTS = {(6, 10): (4, 6), (12, 10): (7, 6)}
"""Their macroscopic elements, of which a quarter has half as many."""


def half_cells(count: int, end: float, is_moved: bool) -> list[tuple[float, float]]:
    """A hole's coordinate and the side of it, for all half cells between -end and end."""
    at = PITCH * (np.arange(count + is_moved) + 0.5 * (not is_moved)) - end
    return [(float(x), s) for x in at for s in (-1.0, 1.0) if abs(x + 0.25 * s * PITCH) < end]


def shifted_mesh(specimen: Specimen, shift: tuple[bool, bool], size: float = SIZE) -> Mesh:
    """The same rectangle with its bulk, the lattice moved by half a cell along x, y or both.

    Where it is moved bulk edges cut holes in two, so that as much of it is material.
    """
    half, gap = 0.5 * PITCH, 0.5 * (PITCH - DIAMETER)
    (a, b), (nx, ny) = specimen.cellular_half_size, (specimen.holes_x, specimen.holes_y)
    bx, by = specimen.bulk_x, specimen.bulk_y
    quarter = quarter_cell(PITCH, DIAMETER, size)
    columns, rows = half_cells(nx, a, shift[0]), half_cells(ny, b, shift[1])
    blocks = [quarter.placed((sx, sy), (x, y)) for x, sx in columns for y, sy in rows]

    def strip(width: float, is_cut: bool, along_x: bool) -> MeshBlock:
        """Bulk beside half a cell, from its hole's centre at 0 to its corner at l / 2."""
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
    """Direct simulations of specimens whose lattice is moved against their bulk edges."""
    for size, first in (((6, 10), 0.078),):  # of 12 x 10 moved along x no branch was followed
        load, name, specimen = LOADS[size], f"{size[0]} x {size[1]}", Specimen(*size)
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
            else:  # its pattern has the specimen's own symmetries, and grows from the beginning
                path, follower.linearisation = path[:1], None
                follower.follow_primary(path, (first, load), refuse_unstable=True)
                state = path[-1]
            before = next(s for s in path if abs(s.strain - first) < 1e-12)
            values = [structure.energy(before.u), structure.energy(state.u),
                      structure.reaction(state.u, specimen.length)]  # fmt: skip
            if abs(state.strain - load) > 1e-12:  # unstable before
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


HEXAGONAL = Specimen(7, 7, 1.28, 1.386, bulk_x=0.0, bulk_y=0.0, stacking="triangular")
"""The lattice of the case hexagonal-lattice; 46 holes for the image that shows its modes."""
SOFT = TwoTermI1()
FLOWER_LOADS = (0.0075, 0.01, 0.015, 0.02)
COMBINATIONS = ((1.0, 1.0, 1.0), (1.0, 1.0, 0.0), (1.0, 0.0, 0.0))


def flower() -> None:
    primitive = PeriodicCell(hexagonal(HEXAGONAL.pitch, HEXAGONAL.diameter, 0.2), SOFT)
    critical = first_critical(CellPath(primitive, equibiaxial()), CriticalSearch(divisions=2))
    modes = real_modes(primitive, critical.state, critical.waves)
    four = UnitCell(modes.mesh, modes.lattice)
    branches = [
        follow(CellPath(PeriodicCell(four, SOFT), equibiaxial()), modes, c, FLOWER_LOADS).states
        for c in COMBINATIONS
    ]
    waves = [
        LatticeMode.of(m, m.family.start, HEXAGONAL, modes.lattice).snapped
        for m in Ansatz.of_specimen(HEXAGONAL).modes
    ]
    kinds: dict[str, Sequence[ModeField]] = {
        "Bloch": list(modes.shapes),
        "analytic": waves,
        "measured": measured_flower(modes, branches[0][-1]),
    }
    names = ("flower", "two modes", "one mode")
    head(
        "φ", "ε_c", "from Bloch waves", "at e", "branches",
        *(f"{n}: energy over the lattice's - 1, negative eigenvalues" for n in names),
    )  # fmt: skip
    for name, fields in kinds.items():
        rve = RVE(four, SOFT, fields, HOLE)
        pressed = PlateLoading(sides="periodic", lateral=1.0, pattern_at_plates="free")
        body = HomogenizedBody(rectangle_mesh([0, 1], [0, 1]), rve, pressed)
        for k, load in enumerate(FLOWER_LOADS):
            found = homogenize(body, [load], PathOptions(first_step=0.003, largest_step=0.003))
            assert found.critical is not None
            e, ranked = found.critical.load, dict(found.ranked)
            order = [sum(v != 0 for v in pattern) for pattern in ranked]
            assert order == sorted(order, reverse=True), "the flower first, single modes last"
            values = [
                f"{ranked[c].energy / b[k].energy - 1:.1e}, {ranked[c].negative_eigenvalues}"
                for c, b in zip(COMBINATIONS, branches, strict=True)
            ]
            row(
                name, f"{e:.5%}", f"{e / critical.load - 1:.1e}", f"{load:.2%}", len(order), *values
            )


def measured_flower(modes: ModeSet, state: BranchState) -> list[ModeField]:
    """phi_i as IDIC finds them in an image of the flower, snapped to the lattice."""
    cell = hexagonal(HEXAGONAL.pitch, HEXAGONAL.diameter, 0.2)
    centres = HEXAGONAL.hole_centres
    blocks = [MeshBlock(cell.mesh.nodes + at, cell.mesh.cells) for at in centres]
    mesh = join(blocks, 1e-7 * HEXAGONAL.pitch)
    steps = np.array(list(product(range(-4, 5), repeat=2))) @ modes.lattice
    places = cKDTree((modes.mesh.nodes + steps[:, None]).reshape(-1, 2))
    hole = centres[np.argmin(np.linalg.norm(centres, axis=1))]
    distance, number = places.query(mesh.nodes - hole)
    assert distance.max() < 1e-6, "the specimen's nodes are the lattice's"
    fluctuation = state.fluctuation(modes.mesh)[number % len(modes.mesh.nodes)]
    u = fluctuation + mesh.nodes @ (state.gradient - np.eye(2)).T
    solution = Solution(mesh, (Snapshot(state.load, u, branch="buckled+"),), {})
    with tempfile.TemporaryDirectory() as folder:
        spec = ImagingSpec(pixel_size=0.01)
        (pair,) = make_images(solution, spec, folder, (state.load,))
    result = correlate(pair, Ansatz.of_specimen(HEXAGONAL, options=AnsatzOptions(v_degree=3)))
    found = [
        LatticeMode.of(m, result.mode_parameters(i), HEXAGONAL, modes.lattice)
        for i, m in enumerate(result.ansatz.modes)
    ]
    amplitudes = identifiability(result, pair.mask).amplitude_px
    print("\nmeasured:", result.outcome.value, "; L1, T2, wave change, rms:", "; ".join(
        f"{p[0]:.3f}, {p[1]:.3f}, {m.wave_change.max():.2%}, {a:.2f} px"
        for p, m, a in zip(
            map(result.mode_parameters, range(3)), found, amplitudes, strict=True
        )
    ))  # fmt: skip
    return [mode.snapped for mode in found]


def bowing() -> None:
    """On the buckled branch of the 6 x 10 specimen."""
    strains = (0.1, 0.107, 0.112, 0.12, 0.128, 0.135, 0.14, 0.145)
    head("nominal strain", "direct: lowest eigenvalue", "negative pivots")
    direct = simulate(Experiment(Specimen(), strains=strains))
    for s in direct.snapshots:
        lowest = min(s.eigenvalues) if s.eigenvalues else np.nan
        row(f"{s.nominal_strain:.1%}", f"{lowest:.6f}", s.negative_pivots)
    head("whole", "RVEs", "ε_c", "stable up to", "not at", "its mode: u along y over u along x",
         "parity of u along y: x, y")  # fmt: skip
    loads = tuple(np.arange(0.1, 0.12, 0.001).round(3).tolist())
    for name, rves, parts, options in (
        ("one position", [analytic()], (3, 5), {}),
        ("5 positions", spread(5), (3, 5), {}),
        ("one position, finer mesh", [analytic()], (6, 10), {}),
        ("one position, v free along the sides", [analytic()], (3, 5), {"pattern_at_bulk": "free"}),
    ):
        found, body, _ = homogenized_specimen(rves, (6, 10), parts, loads, **options)
        assert found.critical is not None
        bowed = next(k for k, s in enumerate(found.states) if s.negative_eigenvalues)
        state = found.states[bowed]
        at = LinearisedBody(body, state.load, state.value)
        scale = np.sqrt(np.abs(LinearisedBody(body, 0.0, body.start).stiffness.diagonal()))
        K = at.stiffness.toarray() / np.outer(scale, scale)
        mode = eigh(K, subset_by_index=(0, 0))[1][:, 0] / scale
        u, _ = body.fields(body.T @ mode)
        tree, across = cKDTree(body.mesh.nodes), u[:, 1]
        images = [across[tree.query(body.mesh.nodes * sign)[1]] for sign in ((-1, 1), (1, -1))]
        parities = ", ".join(f"{across @ image / (across @ across):+.2f}" for image in images)
        row(name, body.point_count * len(body.rves), f"{found.critical.load:.3%}",
            f"{loads[bowed - 1]:.1%}", f"{loads[bowed]:.1%}",
            f"{np.linalg.norm(across) / np.linalg.norm(u[:, 0]):.2f}", parities)  # fmt: skip


def loads() -> None:
    head("homogeneous strain", "sides", "ε_c", "Bloch waves", "difference")
    primitive = PeriodicCell(square(PITCH, DIAMETER, SIZE), MATERIAL)
    one = Specimen(4, 2, bulk_x=0, bulk_y=0)
    for name, (c, shear, lateral), sides in (
        ("compression", (1.0, 0.0, 0.0), "periodic"),
        ("compression", (1.0, 0.0, 0.0), "clamped"),
        ("equibiaxial", (1.0, 0.0, 1.0), "guided"),
        ("compression, shear 0.5", (1.0, 0.5, 0.0), "periodic"),
        ("compression, shear 0.5, across 0.3", (1.0, 0.5, 0.3), "clamped"),
    ):
        macro = MacroLoading(((-c, 0.0), (shear, -lateral)))
        exact = critical_at(CellPath(primitive, macro), (np.pi, np.pi)).load
        fixed = PlateLoading(c, shear, 0.0, lateral, sides=sides, pattern_at_plates="free")
        body = HomogenizedBody.of_specimen(one, analytic(), fixed, divisions=(1, 1))
        found = homogenize(body, [1.05 * exact]).critical
        e = found.load if found else np.nan
        row(name, sides, f"{e:.6%}", f"{exact:.6%}", f"{e / exact - 1:.1e}")

    D = LinearisedBody(body, 0.0, body.start).moduli[0]  # relaxed at rest
    modulus = D[0, 0] - D[0, 3] ** 2 / D[3, 3]
    head("pure bending of a beam at 0.1 % in the outer fibre", "energy [N]", "E b e² L / 3", "off")
    bent = PlateLoading(0.0, 0.0, 1.0, plates="sliding")
    body = HomogenizedBody.of_specimen(
        Specimen(6, 4, bulk_x=0, bulk_y=0), analytic(), bent, divisions=(3, 2)
    )
    energy = homogenize(body, [1e-3]).states[0].energy
    exact = modulus * 2 * PITCH * 1e-6 * body.length / 3
    row("6 x 4 cells", f"{energy:.6e}", f"{exact:.6e}", f"{energy / exact - 1:.1e}")

    strains = (0.03, 0.05, 0.06, 0.07, 0.08)
    start = time.perf_counter()
    direct = simulate(Experiment(Specimen(), strains=strains, tilt=1.0))
    exact_states = states_of(direct, strains)
    title = "6 x 10, one plate turned by 1 rad a unit of strain"
    direct_row(title, strains, exact_states, time.perf_counter() - start)
    for parts in ((3, 5), (6, 10)):
        body = HomogenizedBody.of_specimen(Specimen(), analytic(), PlateLoading(), divisions=parts)
        homogenized_row("homogenized", body, strains, exact_states, shortening=tilted(body, 1.0))
    sheared()


DirectState = tuple[float, float, int]
"""Energy [N], force [N/mm], negative eigenvalues."""


def states_of(direct: Solution, strains: Sequence[float]) -> list[DirectState]:
    return [(s.energy, s.reaction, s.negative_pivots) for s in map(direct.at, strains)]


def direct_row(
    title: str, strains: Sequence[float], states: Sequence[DirectState], seconds: float,
    critical: float | None = None,
) -> None:  # fmt: skip
    """The head of a table, too."""
    at = (f"energy, force at {e:.0%}" for e in strains)
    head(title, "RVEs", "ε_c", *at, "negative eigenvalues", "s")
    values = (f"{energy:.5f} N, {force:.5f} N/mm" for energy, force, _ in states)
    unstable = ", ".join(str(negative) for _, _, negative in states)
    row("direct", "", f"{critical:.3%}" if critical else "", *values, unstable, f"{seconds:.0f}")


def homogenized_row(
    name: str, body: HomogenizedBody, strains: Sequence[float], exact: Sequence[DirectState],
    critical: float | None = None, shortening: FloatArray | None = None,
) -> None:  # fmt: skip
    """``shortening``: the rates of all unknowns that the direct simulation's force works on."""
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
"""Of plates, a unit of compression [-]."""


class ShearedStructure(Structure):
    """Plates that move across, too, as ``PlateLoading(shear=SHEAR)`` has them."""

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


def independence() -> None:
    head(
        "strip of six cells", "RVEs", "elements of the lattice [mm]", "ε_c [%]", "change",
        "stress at 8, 10 % [MPa]", "change",
    )  # fmt: skip
    reference: list[FloatArray] = []

    def case(name: str, rves: object, size: float, found: tuple[float, list[float]]) -> None:
        values = np.array([found[0], *found[1]])
        reference[:] = reference or [values]
        off = values / reference[0] - 1
        row(name, rves, size, f"{100 * values[0]:.4f}", f"{off[0]:+.3%}",
            ", ".join(f"{s:.5f}" for s in values[1:]),
            ", ".join(f"{x:+.3%}" for x in off[1:]))  # fmt: skip

    for name, parts, points, size in (
        ("homogenized", 6, 2, SIZE), ("half as many elements", 3, 2, SIZE),
        ("twice as many", 12, 2, SIZE), ("four times as many", 24, 2, SIZE),
        ("3 x 3 points", 6, 3, SIZE), ("finer RVE", 6, 2, 0.5 * SIZE),
    ):  # fmt: skip
        found = homogenized_strip(6, analytic(JUNCTION, size), parts, points)
        case(name, parts * points**2, size, found)
    reference.clear()
    for name, size in (("direct, mean of both positions", SIZE), ("finer", 0.5 * SIZE)):
        both = [direct_strip(6, is_cut, size) for is_cut in (False, True)]
        stress = np.mean([s for _, s in both], axis=0).tolist()
        case(name, "", size, (float(np.mean([e for e, _ in both])), stress))


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
    """Turn the right plate, per unit of strain [rad]; the rates of all unknowns without that."""
    shortening, nodes = body.direction.copy(), body.mesh.nodes
    right = np.flatnonzero(nodes[:, 0] > nodes[:, 0].max() - 1e-9)
    body.direction[right * (2 + body.mode_count)] -= tilt * nodes[right, 1]
    return shortening


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


PICTURE: list[Path] = []
"""Where to draw the size effect, if anywhere."""
SECTIONS: dict[str, Callable[[], None]] = {
    "cell": cell, "strips": strips, "specimen": specimen, "choices": choices,
    "positions": positions, "translations": translations, "bowing": bowing,
    "flower": flower, "loads": loads, "independence": independence,
    "triangular": triangular, "cost": cost, "ranks": ranks,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("section", nargs="*", help=", ".join(SECTIONS))
    parser.add_argument("--picture", type=Path, help="where to draw the size effect (PNG)")
    options = parser.parse_args()
    PICTURE[:] = [options.picture] if options.picture else []
    for name in options.section or [name for name in SECTIONS if name != "ranks"]:
        SECTIONS[name]()


if __name__ == "__main__":
    main()
