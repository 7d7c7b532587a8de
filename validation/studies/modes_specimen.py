"""Specimens of the study of measured modes: descriptions, buckling, and their lattices' modes.

A description is in ``specimens/NAME/specimen.json`` of the study's folder, where NAME is the digest
of its content.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Solution
from modeharvest.fem.materials import MATERIALS, Material, material_of, material_table
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.modes import ModeFamily
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.spectra.lattice_spectrum import MeshQuadrature
from modeharvest.idic.spectra.mode_family import overlap
from modeharvest.imaging.imageset import image_key
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, requiring_dolfinx
from modeharvest.util.files import read_json
from modeharvest.util.stages import digest
from modeharvest.util.typed import made, to_plain
from modeharvest.validation.studies.lattice import PatternMode, StudiedLattice, pattern_mode
from modeharvest.validation.studies.study import ImagePairSpec
from modeharvest.validation.workers import leave

_QUADRATURE = 4
"""Quadrature points per direction: the pattern's waves are long compared with the elements."""


def buckle(experiment: Experiment, wanted: float, largest: float) -> Solution:
    """Compress a specimen until its pattern has the wanted amplitude, by ``simulate_pattern``.

    ``experiment``: its strains and branches are ignored; ``wanted``: the pattern's amplitude to be
    reached, see :meth:`PatternCells.amplitude` [mm]; ``largest``: nominal strain up to which to
    look for the first critical point [-]. MissingDependencyError without dolfinx.
    """
    with requiring_dolfinx("simulating specimens needs"):
        from modeharvest.fem.meshing import mesh_specimen
        from modeharvest.fem.simulate import simulate_pattern
    mesh = mesh_specimen(experiment.specimen, experiment.mesh_size)
    pattern = PatternCells(mesh, experiment.specimen)
    return simulate_pattern(experiment, mesh, pattern, wanted, largest)


class PatternCells:
    """Projections of a displacement on the square pattern, unit cell by unit cell."""

    def __init__(self, mesh: Mesh, specimen: Specimen) -> None:
        self._rule = rule = MeshQuadrature(mesh, _QUADRATURE)
        half = np.array(specimen.cellular_half_size)
        self._shape = specimen.holes_x, specimen.holes_y
        cell = specimen.pitch, specimen.row_distance
        place = np.floor((rule.positions + half) / cell).astype(np.int64)
        self._inside = np.all((place >= 0) & (place < self._shape), axis=1)
        self._cell = np.ravel_multi_index(tuple(place[self._inside].T), self._shape)
        self._pattern = specimen.pattern(rule.positions)
        self._own = self._products(self._pattern)

    def _products(self, values: FloatArray) -> FloatArray:
        """(holes_x, holes_y) integral of values (q, 2) times the pattern over each cell."""
        density = self._rule.weights * (values * self._pattern).sum(axis=1)
        cells = np.bincount(self._cell, density[self._inside])
        return np.asarray(cells.reshape(self._shape), np.float64)

    def share(self, displacement: FloatArray) -> float:
        """Share of the pattern, with any amplitude in each cell, in a nodal field (n, 2) [-].

        The root of the fraction of ∫ |u|² in the span of the pattern's restrictions to single
        cells, with the sign of the overlap with the whole pattern; its absolute value is 0 to 1.
        """
        u = self._rule.values(displacement)
        mixed = self._products(u)
        share = math.sqrt(np.sum(mixed**2 / self._own) / self._rule.product(u, u))
        return math.copysign(share, mixed.sum())

    def amplitude(self, displacement: FloatArray) -> float:
        """The pattern's largest amplitude in a nodal displacement (n, 2) [mm].

        Averaged over blocks of 2 x 2 cells: lattice-periodic and linear fields contribute nothing.
        """
        cells = self._products(self._rule.values(displacement)) / self._own
        blocks = sliding_window_view(cells, tuple(min(2, n) for n in self._shape))
        return float(np.abs(blocks.mean(axis=(2, 3))).max())


@dataclass(frozen=True)
class SpecimenSpec:
    """Everything that a specimen's measurement depends on."""

    experiment: Experiment
    """The compression test, without its strains, which are yet to be found."""
    amplitude: float
    """Amplitude of the pattern to which it is compressed [mm]."""
    largest: float
    """Strain up to which to look for its critical point [-]."""
    divisions: int
    """Elements along l of the infinite lattice's cell."""
    imaging: ImagingSpec
    correlation: SquareLatticeOptions
    given: str = ""
    """The digest of an existing solution; "" to simulate."""

    @classmethod
    def of(cls, spec: ImagePairSpec, strain: float, largest: float, divisions: int) -> SpecimenSpec:
        """From a simulated experiment, with its pattern's amplitude at a strain [-].

        InputError if the experiment has an imperfection, did not buckle, or has a material that
        can't be written to a file.
        """
        e = spec.experiment
        if not e.is_perfect or e.guided:
            raise InputError(
                "study: expected a perfect specimen that buckles at a strain of its own, got an "
                "experiment with an imperfection, a tilt or guides; leave them out"
            )
        if e.specimen.stacking != "square" or e.specimen.aspect != 1.0:
            raise InputError(
                "study: expected round holes in square stacking, got a specimen in "
                f"{e.specimen.stacking} stacking with holes of aspect {e.specimen.aspect:.3g}"
            )
        if type(e.material) not in MATERIALS.values():
            known = [kind.__name__ for kind in MATERIALS.values()]
            raise InputError(f"study: expected a material among {known}, got {e.material!r}")
        critical = spec.solution.info.get("critical")
        if not critical or critical["strain"] >= strain:
            raise InputError(
                f"study: expected an experiment that has buckled at {100 * strain:g} %, got one "
                + (f"with {100 * critical['strain']:.4g} % as its" if critical else "with no")
                + " critical strain"
            )
        there = spec.solution.at(strain).displacement
        return cls(
            Experiment(e.specimen, e.material, mesh_size=e.mesh_size, edges=e.edges, path=e.path),
            PatternCells(spec.solution.mesh, e.specimen).amplitude(there),
            largest,
            divisions,
            spec.imaging,
            spec.correlation,
            given=image_key(spec.solution, spec.imaging, (strain,))[:16],
        )

    @property
    def specimen(self) -> Specimen:
        """The specimen's geometry."""
        return self.experiment.specimen

    def changed(self, material: Material | None = None, **specimen: Any) -> SpecimenSpec:
        """The description with another material, or other values of the specimen; to simulate."""
        experiment = replace(
            self.experiment,
            specimen=replace(self.specimen, **specimen),
            material=material or self.experiment.material,
        )
        return replace(self, experiment=experiment, given="")

    def scaled(self, pitch: float) -> SpecimenSpec:
        """The description scaled to another l [mm], including elements and pixels."""
        old, factor = self.specimen, pitch / self.specimen.pitch
        lengths = {n: factor * getattr(old, n) for n in ("diameter", "bulk_x", "bulk_y")}
        other = self.changed(pitch=pitch, **lengths)
        pixel, start = self.imaging.pixel_size, self.correlation.start_amplitude
        return replace(
            other,
            experiment=replace(other.experiment, mesh_size=factor * self.experiment.mesh_size),
            amplitude=factor * self.amplitude,
            imaging=replace(self.imaging, pixel_size=factor * pixel),
            correlation=replace(self.correlation, start_amplitude=factor * start),
        )

    def solution_path(self, folder: Path) -> Path:
        """File of the solution, named by a digest of everything the simulation depends on."""
        unseen = ("imaging", "correlation", "divisions")
        simulated = {name: value for name, value in self.plain().items() if name not in unseen}
        return folder / "solutions" / f"{digest(simulated)[:16]}.h5"

    def plain(self) -> dict[str, Any]:
        """The description as plain JSON values."""
        values: dict[str, Any] = to_plain(self)
        values["experiment"]["material"] = material_table(self.experiment.material)
        return values

    @classmethod
    def read(cls, path: Path) -> SpecimenSpec:
        """Read what :meth:`leave` wrote."""
        values = dict(read_json(path))
        experiment = values["experiment"]
        experiment["material"] = material_of(experiment["material"])
        return made(cls, values)

    def leave(self, folder: Path) -> str:
        """Write the description into the study's folder; return the specimen's name."""
        return leave(self.plain(), folder, "specimens/{}/specimen.json")


def lattice_mode(specimen: Specimen, material: Material, divisions: int) -> PatternMode:
    """The mode of the infinite lattice of a specimen's cells, under uniaxial compression.

    It is computed at the first critical state, or at the last state if there is none. For a graded
    specimen, the lattice has the cell at its centre. ``divisions``: elements along l.
    MissingDependencyError without dolfinx.
    """
    ratio, pitch = specimen.diameter / specimen.pitch, specimen.pitch
    lattice = StudiedLattice(ratio, material=material, pitch=pitch, divisions=divisions)
    with requiring_dolfinx("the mode of an infinite lattice needs"):
        return pattern_mode(lattice)


def nearest_aspect(mode: PatternMode) -> float:
    """The a₁ of Eq. (6) that is nearest to a lattice's mode [-].

    By symmetry and periodicity, the mode's wave vectors and phases are exactly the ideal ones. Of
    the seven parameters only a₁ can differ, the ratio of the two components' amplitudes.
    """
    rule = MeshQuadrature(mode.mesh)
    shape, ideal = rule.values(mode.shape), rule.values(mode.analytic)
    along, across = (
        rule.weights @ (shape[:, c] * ideal[:, c]) / (rule.weights @ ideal[:, c] ** 2)
        for c in (0, 1)
    )
    return float(along / across)


def overlap_on_specimen(
    mode: PatternMode, specimen: Specimen, family: ModeFamily, parameters: ArrayLike
) -> float:
    """Normalised overlap of a lattice's mode with a family's mode over a specimen's cells [-].

    |∫ u·φ| / (‖u‖ ‖φ‖), both without mean and of constant amplitude; u is the lattice's mode on
    copies of its cell around all holes, with opposite signs in neighbouring cells.
    """
    mesh, centres = mode.mesh, specimen.hole_centres
    steps = np.rint((centres - centres[0]) / specimen.pitch).astype(int).sum(axis=1)
    nodes = (centres[:, None, :] + mesh.nodes).reshape(-1, 2)
    first = len(mesh.nodes) * np.arange(len(centres))
    cells = (first[:, None, None] + mesh.cells).reshape(-1, mesh.cells.shape[1])
    field = (((-1.0) ** steps)[:, None, None] * mode.shape).reshape(-1, 2)
    copies = Mesh(nodes, cells, mesh.element)
    return overlap(copies, field, family, specimen.pitch, parameters)
