"""Study of measured modes: hole size, cell size, material and graded holes of buckled specimens.

A case's files in ``specimens/NAME/`` of the study's folder, NAME the digest of the description::

    specimen.json          the specimen, its imaging and its correlation
    solution.h5            the exact displacement, a copy of a file in ``solutions/``
    result.json best.json  the measurement, and the best fit of its ansatz to the truth
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh, Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.result import Result
from modeharvest.idic.spectra.pattern import mode_equivalent
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.studies.lattice import STUDIED_MATERIALS, PatternMode
from modeharvest.validation.studies.modes_specimen import (
    SpecimenSpec,
    buckle,
    lattice_mode,
    nearest_aspect,
    overlap_on_specimen,
)
from modeharvest.validation.studies.study import ImagePairSpec, Study, VirtualImagePair
from modeharvest.validation.truth import Comparison
from modeharvest.validation.workers import Case, Cases, Row

PARAMETERS = tuple(f"a{k}" for k in range(1, 8))
WAVE_VECTORS = list(PARAMETERS[1:5])
IDEAL = np.array([1.0, 1.0, 1.0, -1.0, 1.0, 0.0, 0.0])
"""Parameters of Eq. (6) with a solid junction at the origin; phases a₆ and a₇ divided by l."""
NOISE = 0.01
"""Noise for which error bars are predicted [fraction of full scale]; the images have no noise."""
PATTERN_SHARE = 0.8
"""Least share of the pattern, with any amplitude in each cell, in a mode that counts as it."""
BASE = "base"


@dataclass(frozen=True, eq=False)
class SpecimenPatterns:
    """A specimen's fields at the nodes of its mesh, (n, 2) each [mm]."""

    mesh: Mesh
    """Mesh of T6 elements [mm]."""
    pitch: float
    """Unit cell size l [mm]."""
    displacement: FloatArray
    found: FloatArray
    """The true and the measured displacement."""
    pattern: FloatArray
    """The true displacement minus the best fit's v₀."""
    found_pattern: FloatArray
    """The measured v₁φ₁."""

    @classmethod
    def read(cls, folder: Path) -> SpecimenPatterns:
        """From the files of :func:`one_specimen`."""
        solution = Solution.read(folder / "solution.h5")
        result, best = (Result.read(folder / f"{name}.json") for name in ("result", "best"))
        (snapshot,) = solution.snapshots
        x, y = solution.mesh.nodes.T[:, :, None]
        ansatz, a = result.ansatz, result.unknowns
        return cls(
            solution.mesh,
            ansatz.modes[0].half_wavelength,
            snapshot.displacement,
            ansatz.displacement(a, x, y)[:, 0],
            snapshot.displacement - best.ansatz.v0(best.unknowns, x, y)[:, 0],
            ansatz.fluctuation(0, a, x, y)[:, 0],
        )


def deviations(measured: pd.DataFrame, prefix: str = "") -> pd.DataFrame:
    """Parameters minus those of Eq. (6); phases divided by l."""
    values = measured[[prefix + name for name in PARAMETERS]].to_numpy(np.float64) - IDEAL
    return pd.DataFrame(values, measured.index, list(PARAMETERS))


def standardised_errors(measured: pd.DataFrame) -> NDArray[np.float64]:
    """(specimens, 7) measured minus best-fit parameters, in standard deviations by model error."""
    sd = measured[[f"{name}_sd_model_error" for name in PARAMETERS]].to_numpy(np.float64)
    return np.asarray((deviations(measured) - deviations(measured, "best_")).to_numpy() / sd)


def one_specimen(case: Case, folder: Path) -> Row:
    """Buckle, image, measure and compare: :func:`_specimen_row` and :func:`_measured_row`."""
    own = folder / "specimens" / case["specimen"]
    described = SpecimenSpec.read(own / "specimen.json")
    experiment, path = described.experiment, described.solution_path(folder)
    if not path.is_file():  # simulation takes most time, and doesn't depend on the images
        if described.given:
            raise InputError(f"expected the base's solution at {path}, found none; run it again")
        buckle(experiment, described.amplitude, described.largest).write(path)
    solution = Solution.read(path)
    lattice = lattice_mode(experiment.specimen, experiment.material, described.divisions)
    row = _specimen_row(described, solution, lattice)
    if row["first"] == "none":
        return row
    spec = ImagePairSpec(experiment, described.imaging, described.correlation, lambda: solution)
    pair = VirtualImagePair.open(own, spec.describe(own, row["strain"]))
    try:
        return row | _measured_row(pair, lattice, own)
    finally:
        pair.discard()


def _specimen_row(described: SpecimenSpec, solution: Solution, lattice: PatternMode) -> Row:
    """A specimen's geometry, and the buckling of the specimen and of the infinite lattice.

    ``ratio``: d/l at the centre; ``first``: first buckling mode, "pattern", "other" or "none";
    ``pattern_share``: the pattern's share of that mode; ``strain``: where it is measured, with
    ``unstable_pivots`` negative pivots; ``lattice_...``: ``kind``, ``pattern``, ``overlap`` of the
    lattice's :class:`~modeharvest.validation.studies.lattice.ModeRow`, and its a₁.
    """
    specimen, critical = described.specimen, solution.info.get("critical")
    first, share, buckles_at = "none", np.nan, np.nan
    if critical:
        share, buckles_at = critical["pattern_overlap_by_cell"], critical["strain"]
        first = "pattern" if share >= PATTERN_SHARE else "other"
    strain = max(s.nominal_strain for s in solution.snapshots)
    ratios = specimen.diameters / specimen.pitch
    return {
        "ratio": specimen.diameter / specimen.pitch,
        "smallest_ratio": float(ratios.min()),
        "largest_ratio": float(ratios.max()),
        "pitch_mm": specimen.pitch,
        "first": first,
        "pattern_share": share,
        "critical_strain": buckles_at,
        "strain": strain,
        "unstable_pivots": solution.at(strain).negative_pivots,
        "simulation": solution.info.get("outcome", ""),
        "lattice_first": lattice.row.kind,
        "lattice_pattern_strain": lattice.row.pattern,
        "lattice_overlap_ideal": lattice.row.overlap,
        "lattice_a1": nearest_aspect(lattice),
    }


def _measured_row(pair: VirtualImagePair, lattice: PatternMode, own: Path) -> Row:
    """Correlate from the standard initial guess; compare with truth, best fit and lattice.

    ``a1`` ... ``a7`` of the measurement and ``best_a1`` ... of the best fit: equivalent parameters
    nearest to the ideal, phases divided by l; ``a1_sd_model_error`` and ``a1_sd_noise`` ...: their
    standard deviations by model error, and by noise of :data:`NOISE`. ``overlap_lattice``: of the
    mode with the infinite lattice's mode, both of constant amplitude, over all cells;
    ``overlap_truth``: of v₁φ₁ with the truth minus the best fit's v₀ over the cellular material;
    ``best_...``: of the best fit. ``amplitude``: rms length of v₁φ₁ there, divided by l.
    """
    result = pair.correlate()
    found, specimen = pair.compare(result), pair.specimen
    result.write(own / "result.json")
    found.best.write(own / "best.json")
    units = np.array([1.0] * 5 + [specimen.pitch] * 2)
    row: Row = {"outcome": result.outcome.value, "iterations": len(result.history)}
    for prefix, fit in (("", result), ("best_", found.best)):
        family, a = fit.ansatz.modes[0].family, fit.mode_parameters()
        nearest, _ = mode_equivalent(a, specimen.pitch, family.start)
        row |= _columns(nearest / units, prefix + "{}")
        row[prefix + "overlap_lattice"] = overlap_on_specimen(lattice, specimen, family, a)
    covariances = {"model_error": pair.matched(result).sandwich_covariance(specimen.pitch),
                   "noise": result.covariance(NOISE)}  # fmt: skip
    for cause, covariance in covariances.items():
        sd = np.sqrt(np.diag(covariance)[result.ansatz.phi_slice(0)]) / units
        row |= _columns(sd, "{}_sd_" + cause)
    return row | found.error_parts() | _patterns(found, specimen)


def _columns(values: Iterable[float], name: str) -> dict[str, float]:
    """The mode's seven parameters by column name: ``name`` with {} replaced by the parameter's."""
    return {name.format(key): value for key, value in zip(PARAMETERS, values, strict=True)}


def _patterns(found: Comparison, specimen: Specimen) -> dict[str, float]:
    """Overlap of v₁φ₁ with the specimen's true pattern, and its amplitude."""
    inside = found.cellular(specimen)
    true = (found.displacement - found.best.v0())[inside]
    measured, best = (fit.fluctuation()[inside] for fit in (found.result, found.best))
    return {
        "overlap_truth": likeness(true, measured),
        "best_overlap_truth": likeness(true, best),
        "amplitude": float(np.sqrt((measured**2).sum(axis=-1).mean())) / specimen.pitch,
    }


def likeness(first: FloatArray, second: FloatArray) -> float:
    """Normalised overlap |Σ u·φ| / (‖u‖ ‖φ‖) of two fields (n, 2), both without their mean [-]."""
    u, phi = (values - values.mean(axis=0) for values in (first, second))
    return float(abs((u * phi).sum()) / np.sqrt((u**2).sum() * (phi**2).sum()))


@dataclass(frozen=True, eq=False)
class ModesAnalysis:
    """Evaluation of the table of measured modes; each part has a row for each specimen."""

    ran: pd.DataFrame
    """All specimens that succeeded."""
    measured: pd.DataFrame
    """Specimens that buckled into the pattern and whose correlation converged on it."""
    sizes: pd.DataFrame
    """Among these, the base and the specimens that differ from it only in d/l."""
    folder: Path
    """The study's folder, which has the specimens."""


@dataclass(frozen=True)
class MeasuredModesStudy(Study[ModesAnalysis]):
    """Measure the mode on specimens that each differ from a base in one respect.

    Each is compressed until its pattern's amplitude over l equals the base's. InputError if a value
    is out of range, or occurs twice.
    """

    question: ClassVar[str] = (
        "The paper argues that the pattern of a square stacking of holes is one mode, whatever "
        "the size of its cells, nearly whatever that of its holes, and the material. Here it is "
        "measured: specimens are buckled, imaged and correlated with the mode’s parameters free, "
        "and what is found is set against the mode of the infinite lattice, against Eq. (6) of "
        "the paper, and against the best fit to the specimen’s own displacement."
    )
    function: ClassVar[str] = f"{__name__}:one_specimen"
    measures_mode: ClassVar[bool] = True

    strain: float = 0.128
    """Nominal strain of the base's deformed image [-]; the base must be buckled there."""
    ratios: tuple[float, ...] = (0.6, 0.65, 0.7, 0.75, 0.85, 0.9, 0.95)
    """Other d/l [-]."""
    pitches: tuple[float, ...] = (0.95,)
    """Other l [mm]; specimen, elements and pixels are scaled with it."""
    materials: tuple[str, ...] = ("two-term-I1", "Ogden m=3, nu=0.40", "Ogden m=3, nu=0.49")
    """Names among ``STUDIED_MATERIALS``."""
    gradings_x: tuple[float, ...] = (0.02,)
    gradings_y: tuple[float, ...] = (0.02,)
    """Gradients of the diameter along and across the load [mm/mm], one at a time; d at the
    specimen's centre is kept."""
    largest: float = 0.28
    """Strain up to which to look for a specimen's critical point [-]."""
    divisions: int = 13
    """Elements along l of the infinite lattice's cell."""

    def __post_init__(self) -> None:
        if not all(0.0 < r < 1.0 for r in self.ratios):
            raise InputError(f"study: expected ratios d/l between 0 and 1, got {list(self.ratios)}")
        if not all(0.0 < p < float("inf") for p in self.pitches):
            raise InputError(f"study: expected pitches above 0 mm, got {list(self.pitches)}")
        if unknown := set(self.materials) - set(STUDIED_MATERIALS):
            known = list(STUDIED_MATERIALS)
            raise InputError(f"study: expected materials among {known}, got {sorted(unknown)}")
        if 0.0 in (*self.gradings_x, *self.gradings_y):
            raise InputError("study: expected gradings other than 0, which the base has, got 0")
        if not (0.0 < self.largest < 0.5 and 4 <= self.divisions <= 200):
            wanted = "largest between 0 and 0.5 and 4 to 200 divisions"
            raise InputError(f"study: expected {wanted}, got {self.largest} and {self.divisions}")
        for name in ("ratios", "pitches", "materials", "gradings_x", "gradings_y"):
            self.require_different(name, getattr(self, name))

    @property
    def seeds(self) -> str:
        """Text on the only random numbers."""
        return "one speckle, of imaging.speckle.seed"

    def quick(self) -> Self:
        """A third of the other d/l, and one graded specimen."""
        fewer = replace(self, ratios=self.ratios[2::3], gradings_y=self.gradings_y[:1])
        return replace(fewer, pitches=(), materials=(), gradings_x=())

    def prepare(self, spec: ImagePairSpec, folder: Path, progress: Progress = silent) -> Cases:
        """Describe the specimens; they are simulated and imaged case by case.

        InputError if the base has no critical point below the strain, or a geometry is impossible.
        """
        base = SpecimenSpec.of(spec, self.strain, self.largest, self.divisions)
        own = replace(spec.solution, snapshots=(spec.solution.at(self.strain),))
        own.write(base.solution_path(folder))
        pitch = base.specimen.pitch
        along, across = "graded along the load", "graded across the load"
        specimens = [
            (BASE, "", base),
            *(("d/l", f"{r:g}", base.changed(diameter=r * pitch)) for r in self.ratios),
            *(("l", f"{p:g} mm", base.scaled(p)) for p in self.pitches),
            *(("material", m, base.changed(STUDIED_MATERIALS[m])) for m in self.materials),
            *((along, f"{g:g}", base.changed(grading_x=g)) for g in self.gradings_x),
            *((across, f"{g:g}", base.changed(grading_y=g)) for g in self.gradings_y),
        ]
        return tuple(
            {"varied": varied, "level": level, "specimen": described.leave(folder)}
            for varied, level, described in specimens
        )

    def analyse(self, table: pd.DataFrame, folder: Path) -> ModesAnalysis:
        """The specimens whose pattern was measured."""
        ran = table[table["error"] == ""]
        is_converged = ran["outcome"] == "converged" if "outcome" in ran else False
        measured = ran[(ran["first"] == "pattern") & is_converged]
        sizes = measured[measured["varied"].isin([BASE, "d/l"])].sort_values("ratio")
        return ModesAnalysis(ran, measured, sizes, folder)
