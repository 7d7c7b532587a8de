"""Three free modes in triangular stacking: convergence, and distance from the best fit.

Two kinds of truth, both by finite elements, each imaged with several speckles and correlated with
the three families of the zone's boundary, all their parameters free:

* "flower": the lattice under equibiaxial compression, on the branch on which all three modes are
  equally strong; a specimen is cut out of it, without edges that would restrain it.
* "plates": a specimen compressed along its rows between clamped edges, as by an ``Experiment``. Two
  of the three modes appear, as in the lattice, in specimens that are much higher than long; others
  bulge sideways, and show none.

Columns: holes; degree of v_i; unknowns; strain; correlations that converged; rms length of v_i
phi_i and of w at the best fit, and of IDIC's distance from it [px]; the largest error of wave
vectors against it [pi/l], of observable modes (v_i phi_i at least twice w) and others, with their
number. Other numbers are medians over the speckles. Table: docs/explanation/three_modes.md.

Run: scripts/env python benchmarks/three_modes.py [--quick]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from modeharvest.fem.bloch.critical import first_critical
from modeharvest.fem.bloch.postbuckling import follow
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Snapshot, Solution
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import hexagonal
from modeharvest.fem.lattice.options import equibiaxial
from modeharvest.fem.materials import Ogden
from modeharvest.fem.meshing import MeshBlock, join
from modeharvest.fem.simulate import simulate
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz, AnsatzOptions
from modeharvest.idic.correlate import best_fit, correlate
from modeharvest.idic.modes import two_waves_near
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.idic.uncertainty.identifiability import OBSERVABLE
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec

PITCH, DIAMETER, MESH_SIZE = 1.9, 1.7, 0.35
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """One correlation with three free modes, compared with the best fit."""

    converged: bool
    modes_px: tuple[float, ...]
    """Rms of v_i phi_i at the best fit [px]."""
    w_px: float
    idic_px: float
    """Rms of the best fit from the truth, and of IDIC from the best fit [px]."""
    wave_errors: tuple[float, ...]
    """Distances of the modes' wave vectors from the best fit's [pi/l]."""

    @property
    def is_observable(self) -> tuple[bool, ...]:
        """Whether each mode is strong enough for its parameters to be meaningful."""
        return tuple(size >= OBSERVABLE * self.w_px for size in self.modes_px)


def flowers(specimens: Sequence[Specimen], strain: float) -> Iterator[Solution]:
    """Specimens cut out of the infinite lattice on the branch of all three modes."""
    cell = hexagonal(PITCH, DIAMETER, MESH_SIZE)
    body = PeriodicCell(cell, Ogden())
    critical = first_critical(CellPath(body, equibiaxial()))
    assert critical.state is not None, critical.outcome
    modes = real_modes(body, critical.state, critical.waves)
    path = CellPath(PeriodicCell(cell.enlarged(2, 2), Ogden()), equibiaxial())
    (state,) = follow(path, modes, (1, 1, 1), (strain,)).states
    shifts = np.array([(m, n) for m in range(-3, 4) for n in range(-3, 4)]) @ modes.lattice
    places = cKDTree((modes.mesh.nodes + shifts[:, None]).reshape(-1, 2))
    fluctuation = np.tile(state.fluctuation(modes.mesh), (len(shifts), 1))
    for specimen in specimens:
        centres = specimen.hole_centres
        blocks = [MeshBlock(cell.mesh.nodes + centre, cell.mesh.cells) for centre in centres]
        mesh = join(blocks, 1e-7 * PITCH)
        at = mesh.nodes - centres[np.argmin(np.linalg.norm(centres, axis=1))]
        at -= np.floor(at @ np.linalg.inv(modes.lattice)) @ modes.lattice
        distance, number = places.query(at)
        assert distance.max() < 1e-6, "the specimen's nodes are the lattice's"
        u = fluctuation[number] + mesh.nodes @ (state.gradient - np.eye(2)).T
        yield Solution(mesh, (Snapshot(strain, u, 0.0, 0.0, 0, (), "buckled+"),), {})


def measured(pair: ImagePair, specimen: Specimen, degree: int) -> Measured:
    """Correlate with three free modes, and compare with the best fit."""
    ansatz = Ansatz.of_specimen(specimen, options=AnsatzOptions(v_degree=degree))
    result = correlate(pair, ansatz)
    assert pair.truth is not None, "the images are virtual ones"
    best, grid, truth = best_fit(pair.truth, result), pair.grid, pair.truth.displacement
    is_material = np.isfinite(truth[..., 0])

    def rms_px(field: FloatArray) -> float:
        return float(np.sqrt(np.mean(np.sum(field[is_material] ** 2, axis=-1))) / grid.pixel_size)

    u = ansatz.displacement(best.unknowns, grid.x, grid.y)
    errors = []
    for i, mode in enumerate(ansatz.modes):
        part, start = ansatz.phi_slice(i), mode.family.start
        found, true = (two_waves_near(b.unknowns[part], start, PITCH) for b in (result, best))
        errors.append(float(np.linalg.norm(found[2:4] - true[2:4])))
    return Measured(
        result.outcome is Outcome.CONVERGED,
        tuple(rms_px(ansatz.fluctuation(i, best.unknowns, grid.x, grid.y)) for i in range(3)),
        rms_px(truth - u),
        rms_px(ansatz.displacement(result.unknowns, grid.x, grid.y) - u),
        tuple(errors),
    )


def row(solution: Solution, specimen: Specimen, degree: int, seeds: int, pixel: float) -> str:
    """Correlate images with several speckles; returns a row of the table."""
    found = []
    for seed in range(seeds):
        spec = ImagingSpec(pixel_size=pixel, speckle=SpeckleSpec(seed=seed))
        with tempfile.TemporaryDirectory() as folder:
            (pair,) = make_images(solution, spec, folder, (solution.snapshots[-1].nominal_strain,))
            found.append(measured(pair, specimen, degree))
    holes = len(specimen.hole_centres)
    unknowns = Ansatz.of_specimen(specimen, options=AnsatzOptions(v_degree=degree)).size
    seen = [(e, ok) for m in found for e, ok in zip(m.wave_errors, m.is_observable, strict=True)]

    def largest(observable: bool) -> str:
        errors = [error for error, ok in seen if ok is observable]
        return f"{max(errors):.3f} ({len(errors)})" if errors else "none"

    def median(values: Sequence[float]) -> str:
        return f"{np.median(values):.2f}"

    return " | ".join([
        f"| {specimen.holes_x} x {specimen.holes_y}, {holes} holes", str(degree), str(unknowns),
        f"{100 * solution.snapshots[-1].nominal_strain:g} %",
        f"{sum(m.converged for m in found)} of {len(found)}",
        ", ".join(median([m.modes_px[i] for m in found]) for i in range(3)),
        median([m.w_px for m in found]), median([m.idic_px for m in found]),
        largest(True), f"{largest(False)} |",
    ])  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few sizes, one seed")
    parser.add_argument("--pixel", type=float, default=0.02, help="size of a pixel [mm]")
    options = parser.parse_args()
    seeds = 1 if options.quick else 4
    sizes = (
        ((4, 5), (8, 9)) if options.quick else ((3, 3), (4, 5), (5, 6), (6, 7), (8, 9), (10, 12))
    )
    print("flower, equibiaxial")
    specimens = [
        Specimen(*size, DIAMETER, PITCH, bulk_x=0.0, bulk_y=0.0, stacking="triangular")
        for size in sizes
    ]
    for strain in (0.02,) if options.quick else (0.016, 0.02, 0.03):
        for specimen, solution in zip(specimens, flowers(specimens, strain), strict=True):
            for degree in (1, 3, 6):
                print(row(solution, specimen, degree, seeds, options.pixel), flush=True)
    print("plates, uniaxial")
    for nx, ny in ((4, 21),) if options.quick else ((4, 13), (4, 21), (6, 25)):
        specimen = Specimen(nx, ny, DIAMETER, PITCH, bulk_x=0.9, stacking="triangular")
        solution = simulate(Experiment(specimen, strains=(0.05, 0.06), mesh_size=MESH_SIZE))
        for degree in (1, 3, 6):
            print(row(solution, specimen, degree, seeds, options.pixel), flush=True)


if __name__ == "__main__":
    main()
