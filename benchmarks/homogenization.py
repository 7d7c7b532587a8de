"""Micromorphic homogenization compared with Bloch waves, direct simulations and other code.

``scripts/env python benchmarks/homogenization.py [SECTION ...]`` prints tables of
docs/explanation/homogenization_strips.md (``flower``: homogenization_triangular.md), as Markdown:

- ``cell``: homogeneous patterns: critical strain, and stress on the branch, against Bloch waves and
  the branch of the periodic cell.
- ``strips``: n cells between clamped plates, periodic sideways: direct simulations (mean of two
  positions of the lattice at the plates), and homogenized ones with an analytic mode, the critical
  Bloch mode, and the mode measured in the images of the case paper-homogenized. ``--picture PNG``
  draws the size effect.
- ``flower``: three modes of triangular stacking under equibiaxial load, computed, analytic and
  measured in an image: all branches by energy, against those of the periodic cell.
- ``loads``: homogeneous bodies by sides and shear, against Bloch waves; bending, against a beam.
- ``independence``: a strip of six cells by macroscopic elements, their points and RVE's elements.

Unless stated otherwise: square stacking, pitch 1.9 mm, d = 1.5 mm, the default Ogden material,
elements of 0.2 mm. ``homogenized_specimens.py`` is for specimens with bulk edges,
``homogenized_bowing.py`` for their bowing.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.bloch.critical import critical_at, first_critical
from modeharvest.fem.bloch.modes import BranchState, ModeSet
from modeharvest.fem.bloch.postbuckling import follow
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.experiment import PathOptions
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, hexagonal, square
from modeharvest.fem.lattice.micromorphic.body import PlateLoading, rectangle_mesh
from modeharvest.fem.lattice.micromorphic.branches import homogenize
from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody, LinearisedBody
from modeharvest.fem.lattice.micromorphic.patterns import ModeField, rotation_pattern
from modeharvest.fem.lattice.micromorphic.rve import RVE, spread_positions
from modeharvest.fem.lattice.options import (
    CriticalSearch,
    MacroLoading,
    equibiaxial,
    uniaxial,
    uniaxial_strain,
)
from modeharvest.fem.materials import Ogden, TwoTermI1
from modeharvest.fem.meshing import SIGNS, MeshBlock, join, quarter_cell
from modeharvest.fem.path.bifurcation import follow_branch, locate_critical
from modeharvest.fem.path.continuation import PathFollower
from modeharvest.fem.path.equilibrium import EdgeCompression, Structure
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
    """RVEs at ``count`` positions of a lattice rule, as by the key ``positions`` of a case."""
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
    """Mesh from the centres of one row of holes to those of the next, where u_y = 0 by symmetry.

    Plates touch the lattice between holes or, with ``is_cut``, cut through holes.
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
    """RVE with the mode measured in the images of the shipped case, snapped to the lattice."""
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
    """Critical strain [-] and stresses [MPa] (n, 3) of strips, by kind of prediction.

    Those of direct simulations are (n, 2, 3), for the two positions of the lattice at the plates.
    """
    free = PlateLoading(sides="periodic", pattern_at_plates="free")
    one = HomogenizedBody.of_specimen(
        Specimen(2, 2, bulk_x=0, bulk_y=0), analytic(), free, divisions=(1, 1)
    )
    local = homogenize(one, STRESSES)
    assert local.critical is not None  # plates prescribe F̄ alone: the same for every n
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


HEXAGONAL = Specimen(7, 7, 1.28, 1.386, bulk_x=0.0, bulk_y=0.0, stacking="triangular")
"""The lattice of the case hexagonal-lattice; the image of its modes has 46 holes."""


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
    """Modes phi_i that IDIC measures in an image of the flower, snapped to the lattice."""
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

    D = LinearisedBody(body, 0.0, body.start).moduli[0]  # relaxed moduli at rest
    modulus = D[0, 0] - D[0, 3] ** 2 / D[3, 3]
    head("pure bending of a beam at 0.1 % in the outer fibre", "energy [N]", "E b e² L / 3", "off")
    bent = PlateLoading(0.0, 0.0, 1.0, plates="sliding")
    body = HomogenizedBody.of_specimen(
        Specimen(6, 4, bulk_x=0, bulk_y=0), analytic(), bent, divisions=(3, 2)
    )
    energy = homogenize(body, [1e-3]).states[0].energy
    exact = modulus * 2 * PITCH * 1e-6 * body.length / 3
    row("6 x 4 cells", f"{energy:.6e}", f"{exact:.6e}", f"{energy / exact - 1:.1e}")


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


PICTURE: list[Path] = []
"""File of the picture of the size effect; empty for none."""


SECTIONS: dict[str, Callable[[], None]] = {
    "cell": cell, "strips": strips, "flower": flower, "loads": loads,
    "independence": independence,
}  # fmt: skip


def run_sections(
    parser: argparse.ArgumentParser, sections: Mapping[str, Callable[[], None]], *extra: str
) -> None:
    """Run the sections that the command line names, by default all but ``extra``."""
    parser.formatter_class = argparse.RawTextHelpFormatter
    parser.add_argument("section", nargs="*", help=", ".join(sections))
    options = parser.parse_args()
    PICTURE[:] = [options.picture] if getattr(options, "picture", None) else []
    for name in options.section or [name for name in sections if name not in extra]:
        sections[name]()


if __name__ == "__main__":
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--picture", type=Path, help="where to draw the size effect (PNG)")
    run_sections(given, SECTIONS)
