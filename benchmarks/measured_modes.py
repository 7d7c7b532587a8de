"""Accuracy that a test needs for a homogenized force that is right within 1 %.

For every d/l a 6 x 10 specimen is compressed until its pattern is three quarters as strong as the
paper's at 12.8 %. It is photographed like that, without and with noise, and the mode is measured in
the images. Homogenization with that mode (a quarter, 24 RVEs) predicts the critical strain, and at
the strain of the images the force and the rms of v1. Three tables are printed, as Markdown:

- the prediction with the noise-free mode, beside the direct simulation;
- for each parameter, the change of the prediction by an error of 1 % (of l for phases), up or down,
  whichever is larger, if the mode is used *as it was measured*; and the error that changes the
  force by 1 %. Amplitudes act everywhere, phases are those in the specimen's middle. An error of a
  wave number shifts the pattern in proportion to the distance from there; the table has its effect
  at the ends of the cellular part along x or y;
- for each noise, the rms error of the parameters over the seeds (from the noise-free measurement),
  and the mean of their standard deviations by noise and by model error, each of the worst parameter
  of a kind; and the errors of the prediction that remain if the mode is snapped: those by its
  amplitudes, to first order.

Run: scripts/env python benchmarks/measured_modes.py [--ratios 0.7 ...] [--noise 0.005 ...]
     [--seeds 3] [--parameters a1 ...] [--out FOLDER]

The folder keeps solutions and images, so that an interrupted run continues. Some five minutes for
each d/l, more where ligaments are thin (docs/explanation/homogenization_measured_mode*.md).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from whole_field import noisy

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.lattice.cells import UnitCell, square
from modeharvest.fem.lattice.micromorphic.body import PlateLoading
from modeharvest.fem.lattice.micromorphic.branches import homogenize
from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody
from modeharvest.fem.lattice.micromorphic.patterns import PlaneWaves, snapped
from modeharvest.fem.lattice.micromorphic.rve import RVE
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.correlate import correlate
from modeharvest.idic.modes import FourierMode
from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.uncertainty.covariance import covariance
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import Case
from modeharvest.runs.experiment import Run
from modeharvest.validation.homogenization import LatticeMode
from modeharvest.validation.studies.modes_specimen import PatternCells, buckle

FloatArray = NDArray[np.float64]
PAPER, SHARE = 0.128, 0.75
"""Nominal strain of the paper's specimen, and the fraction of its amplitude there for all [-]."""
PITCH, LARGEST = 1.9, 0.35
"""Pitch [mm]; nominal strain up to which a critical point is searched for [-]."""


KINDS = ("amplitude", "wave number", "phase")
"""Kinds of a mode's parameters, in [-], [pi/l], [mm]."""


def row(*cells: object) -> None:
    print("|", " | ".join(str(cell) for cell in cells), "|", flush=True)


def head(*cells: str) -> None:
    print()
    row(*cells)
    print("|" + "---|" * len(cells))


@dataclass(frozen=True)
class Prediction:
    """Prediction of a homogenized specimen."""

    critical: float
    force: float
    """Force at the strain of the images [N/mm]."""
    v: float
    """Rms of v1 over the lattice at that strain [mm]."""

    def against(self, other: Prediction) -> FloatArray:
        """(3,) relative differences from another prediction."""
        mine, its = (np.array([p.critical, p.force, p.v]) for p in (self, other))
        return np.asarray(mine / its - 1.0)


@dataclass(frozen=True)
class Test:
    """A specimen of one d/l, buckled and photographed."""

    ratio: float
    folder: Path

    @cached_property
    def specimen(self) -> Specimen:
        """Specimen with 6 x 10 holes."""
        return Specimen(diameter=self.ratio * PITCH)

    @property
    def size(self) -> float:
        """Size of the elements [mm]: at least two across a ligament."""
        return min(0.2, 0.5 * PITCH * (1.0 - self.ratio))

    @cached_property
    def solution(self) -> Solution:
        """Solution with the buckled state; simulated once."""
        path = self.folder / f"{self.ratio:g}.h5"
        if not path.exists():
            paper = Run(Case.read("paper-virtual"), self.folder / "paper").fem()
            u = paper.at(PAPER).displacement
            wanted = SHARE * PatternCells(paper.mesh, paper.specimen).amplitude(u)
            buckle(Experiment(self.specimen, mesh_size=self.size), wanted, LARGEST).write(path)
        return Solution.read(path)

    @property
    def strain(self) -> float:
        """Nominal strain of the buckled state [-]."""
        return self.solution.snapshots[0].nominal_strain

    @cached_property
    def images(self) -> ImageSet:
        """Images with the paper's imaging; made once."""
        folder = self.folder / f"images_{self.ratio:g}"
        if not (folder / "images.json").exists():
            make_images(self.solution, ImagingSpec(), folder)
        return ImageSet.read(folder)

    def measured(self, noise: float, seed: int) -> tuple[Result, FloatArray, FloatArray]:
        """The result, and (m,) standard deviations of the mode by noise and by model error."""
        pair, how = noisy(self.images, self.strain, noise, seed), SquareLatticeOptions()
        result = correlate(pair, how.ansatz(self.specimen), strain=self.strain)
        found = covariance(result, pair, ImageNoise.of(result.noise_sd), PITCH, how.edge_px)
        part = result.ansatz.phi_slice(0)
        both = found.by_noise, found.by_model_error
        sds = [np.sqrt(np.diag(C)[part]) if C is not None else np.full(7, np.nan) for C in both]
        return result, sds[0], sds[1]

    def pattern(self, mode: FourierMode, parameters: FloatArray) -> PlaneWaves:
        """The mode as it is used: snapped to the lattice."""
        return LatticeMode.of(mode, parameters, self.specimen, self.cell.lattice).snapped

    def as_measured(self, mode: FourierMode, parameters: FloatArray, at: FloatArray) -> PlaneWaves:
        """The mode with its phases at a position ``at`` of the specimen [mm], not snapped.

        In the lattice's coordinates, with its wave vectors, because an RVE can't have others.
        """
        hole = self.specimen.hole_centres[0]
        waves = mode.family.waves(parameters)
        found = PlaneWaves.of_sines(waves, mode.half_wavelength, mode.scale).moved(-hole)
        return snapped(found, self.cell.lattice, at - hole)

    @cached_property
    def cell(self) -> UnitCell:
        """Unit cell of the RVE, 2 x 2 holes."""
        return square(PITCH, self.specimen.diameter, self.size).enlarged(2, 2)

    def predicted(self, pattern: PlaneWaves) -> Prediction:
        """Homogenize a quarter of the specimen with a mode."""
        half = 0.5 * PITCH
        rve = RVE(self.cell, Experiment().material, [pattern], (half, half), "given")
        body = HomogenizedBody.of_specimen(
            self.specimen, rve, PlateLoading(quarter=True), divisions=(4, 6)
        )
        found = homogenize(body, [self.strain])
        critical = found.critical.load if found.critical else np.nan
        if not found.states:
            print(f"(not at {self.strain:.2%}: {found.outcome})")
            return Prediction(critical, np.nan, np.nan)
        state = found.states[0]
        v = float(np.sqrt(np.mean(state.strains[:, 4] ** 2)))
        return Prediction(critical, state.force, v)


def report(test: Test, noises: list[float], seeds: int, parameters: Sequence[str] = ()) -> None:
    """Print the tables of one d/l, for some parameters or all."""
    exact, noise_model, model_error = test.measured(-1.0, 0)
    mode, p, family = exact.ansatz.modes[0], exact.mode_parameters(), exact.ansatz.modes[0].family
    base = test.predicted(test.pattern(mode, p))
    snapshot, critical = test.solution.snapshots[0], test.solution.info["critical"]["strain"]
    head(f"d/l {test.ratio:g}, {test.strain:.2%}", "critical strain", "force there [N/mm]",
         "rms of v1 [mm]", "rms w [px]")  # fmt: skip
    row("direct", f"{critical:.4%}", f"{snapshot.reaction:.5f}", "", "")
    off = base.critical / critical - 1.0, base.force / snapshot.reaction - 1.0
    row("homogenized", f"{base.critical:.4%} ({off[0]:+.2%})", f"{base.force:.5f} ({off[1]:+.2%})",
        f"{base.v:.3f}", f"{exact.model_error_px:.2f}")  # fmt: skip
    head("parameter", "is", "value", "error", "critical strain", "force", "v1",
         "error for 1 % of force")  # fmt: skip
    for k, (name, unit) in enumerate(zip(family.names, family.units, strict=True)):
        if parameters and name not in parameters:
            continue
        changes = effect(test, mode, p, k, base)
        # The effect of phases and wave numbers is even: it grows as the square of the error.
        kind, size = kinds(mode)[k], 0.01 * (PITCH if unit == "mm" else 1.0)
        power = 1.0 if kind == "amplitude" else 2.0
        enough = size * (0.01 / abs(changes[1])) ** (1.0 / power)
        row(name, kind, f"{p[k]:.5f} {unit}", f"{size:g} {unit}", *(f"{c:+.3%}" for c in changes),
            f"{enough:.4f} {unit}")  # fmt: skip
    head("noise", *(f"{kind}: rms error, by noise, by model error" for kind in KINDS),
         "critical strain", "force")  # fmt: skip
    row("none", *(f"–, {text}" for text in grouped(mode, noise_model, model_error)), "", "")
    slopes = np.zeros((len(p), 3))
    for k in np.flatnonzero(kinds(mode) == KINDS[0]):
        there = p + 0.01 * np.eye(len(p))[k]
        slopes[k] = test.predicted(test.pattern(mode, there)).against(base) / 0.01
    for noise in noises:
        found = [test.measured(noise, seed) for seed in range(seeds)]
        errors = np.array([result.mode_parameters() - p for result, _, _ in found])
        rms = np.sqrt(np.mean(errors**2, axis=0))
        bars = [np.mean([f[i] for f in found], axis=0) for i in (1, 2)]
        left = np.sqrt(np.mean(np.square(errors @ slopes), axis=0))
        row(f"{noise:.1%}", *grouped(mode, rms, *bars), f"{left[0]:.4%}", f"{left[1]:.4%}")


def grouped(mode: FourierMode, *values: FloatArray) -> list[str]:
    """Largest of some values (m,) for each kind of parameter, as text."""
    of = kinds(mode)
    return [", ".join(f"{v[of == kind].max():.1e}" for v in values) for kind in KINDS]


def effect(test: Test, mode: FourierMode, p: FloatArray, k: int, base: Prediction) -> FloatArray:
    """(3,) relative changes of the prediction by an error of 1 % of parameter k.

    The larger one of an error up and down: in a quarter of the specimen they differ.
    """
    at, row_of = np.zeros(2), int(np.flatnonzero(mode.family.matrix[:, k])[0]) % 5
    if kinds(mode)[k] == "wave number":
        at[row_of - 2] = test.specimen.cellular_half_size[row_of - 2]
    changes = []
    for sign in (1.0, -1.0):
        ideal = np.where(kinds(mode) == "amplitude", p, mode.family.start)
        ideal[k] += 0.01 * sign * (PITCH if mode.family.units[k] == "mm" else 1.0)
        changes.append(test.predicted(test.as_measured(mode, ideal, at)).against(base))
    both = np.array(changes)
    return np.asarray(both[np.abs(both).argmax(axis=0), np.arange(3)])


def kinds(mode: FourierMode) -> NDArray[np.str_]:
    """(m,) kinds of the parameters, by their places among A, B, kx, ky, c of a wave."""
    names = (KINDS[0], KINDS[0], KINDS[1], KINDS[1], KINDS[2])
    columns = (np.flatnonzero(column)[0] % 5 for column in mode.family.matrix.T)
    return np.array([names[c] for c in columns])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--ratios", type=float, nargs="+", default=[0.7, 0.79, 0.87, 0.95])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.005, 0.01, 0.02, 0.04])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--parameters", nargs="+", default=[], help="rows; else all")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for ratio in options.ratios:
            report(Test(ratio, folder), options.noise, options.seeds, options.parameters)


if __name__ == "__main__":
    main()
