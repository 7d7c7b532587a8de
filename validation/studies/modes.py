"""Study of measured modes: hole size, cell size, material and graded holes of buckled specimens.

One case in ``specimens/NAME/`` of the study's folder, NAME the digest of the description::

    specimen.json          how it is made, imaged and correlated
    solution.h5            the exact displacement, a copy of the one in ``solutions/``
    result.json best.json  the measurement, and the best fit of its ansatz to the truth
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh, Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.spectra.pattern import mode_equivalent
from modeharvest.idic.uncertainty.covariance import MatchedImages
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.studies.lattice_pattern import STUDIED_MATERIALS
from modeharvest.validation.studies.modes_specimen import (
    LatticeMode,
    SpecimenSpec,
    buckle,
    specimen_folder,
)
from modeharvest.validation.studies.study import (
    ImagePairSpec,
    VirtualImagePair,
    require_different,
    require_mode,
)
from modeharvest.validation.truth import Comparison, compare, describe
from modeharvest.validation.workers import Case


def measured_patterns(ran: pd.DataFrame) -> pd.DataFrame:
    """The specimens whose pattern was there to be measured and was: converged on a pattern."""
    if "outcome" not in ran:
        return ran.iloc[:0]
    return ran[(ran["first"] == "pattern") & (ran["outcome"] == "converged")]


def hole_sizes(rows: pd.DataFrame) -> pd.DataFrame:
    """Those that differ from the base in d/l only, and the base."""
    return rows[rows["varied"].isin(["base", "d/l"])]


@dataclass(frozen=True, eq=False)
class SpecimenPatterns:
    """A specimen's fields at the nodes of its mesh.

    Parameters
    ----------
    mesh
        T6 [mm].
    pitch
        l [mm].
    displacement, found
        (n, 2) the truth and the measurement [mm].
    pattern, found_pattern
        (n, 2) the truth less the best fit's v₀, and v₁φ₁ of the measurement [mm].
    """

    mesh: Mesh
    pitch: float
    displacement: FloatArray
    found: FloatArray
    pattern: FloatArray
    found_pattern: FloatArray

    @classmethod
    def read(cls, folder: Path) -> SpecimenPatterns:
        """Of what :func:`~modeharvest.validation.studies.modes.one_specimen` left."""
        solution = Solution.read(folder / "solution.h5")
        result, best = (Result.read(folder / f"{name}.json") for name in ("result", "best"))
        (snapshot,) = solution.snapshots
        x, y = solution.mesh.nodes.T[:, :, None]

        def at_nodes(field: Callable[..., FloatArray], fit: Result) -> FloatArray:
            return np.asarray(field(fit.unknowns, x, y)[:, 0])

        true = snapshot.displacement
        ansatz = result.ansatz
        return cls(
            solution.mesh,
            ansatz.modes[0].half_wavelength,
            true,
            at_nodes(ansatz.displacement, result),
            true - at_nodes(best.ansatz.v0, best),
            at_nodes(lambda a, x, y: ansatz.fluctuation(0, a, x, y), result),
        )


IDEAL = np.array([1.0, 1.0, 1.0, -1.0, 1.0, 0.0, 0.0])


PARAMETERS = tuple(f"a{k}" for k in range(1, 8))


WAVE_VECTORS = list(PARAMETERS[1:5])


def deviations(seen: pd.DataFrame, prefix: str = "") -> pd.DataFrame:
    """Parameters less those of Eq. (mode), phases in shares of l."""
    values = seen[[prefix + name for name in PARAMETERS]].to_numpy(np.float64) - IDEAL
    return pd.DataFrame(values, seen.index, list(PARAMETERS))


def standardised_errors(seen: pd.DataFrame) -> NDArray[np.float64]:
    """(specimens, 7) measured less best fit, in standard deviations by what is left over."""
    sd = seen[[f"{name}_sd_model_error" for name in PARAMETERS]].to_numpy(np.float64)
    return np.asarray((deviations(seen) - deviations(seen, "best_")).to_numpy() / sd)


"""Of Eq. (mode); a₆ and a₇ are told in shares of l."""
NOISE = 0.01
"""Of the images, for which error bars are told; the images have none [fraction of full scale]."""


def one_specimen(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Buckle, image, measure and compare.

    Parameters
    ----------
    case
        One of :meth:`modeharvest.validation.studies.modes.MeasuredModesStudy.prepare`.
    folder
        Of the study.

    Returns
    -------
    dict
        ``ratio``, ``pitch_mm``, ...: the specimen; ``first``: "pattern", "other" or "none", what it
        buckles into; ``critical_strain``, ``strain``; of the lattice ``lattice_...``; and where it
        buckles, of the measurement and the best fit what :func:`_measured` returns.
    """
    own = specimen_folder(folder, case["specimen"])
    described = SpecimenSpec.read(own / "specimen.json")
    solution = _solution(described, folder)
    lattice = LatticeMode.of(described.specimen, described.material, described.divisions)
    row = _specimen_row(described, solution) | _lattice_row(lattice)
    if row["first"] == "none":
        return row
    subject = ImagePairSpec(
        described.experiment, described.imaging, described.correlation, lambda: solution
    )
    scene = VirtualImagePair.open(own, subject.describe(own, row["strain"]))
    try:
        return row | _measured_row(scene, lattice, own)
    finally:
        scene.discard()


def _solution(described: SpecimenSpec, folder: Path) -> Solution:
    """The one that is there, or a new one: simulating costs most, and knows nothing of images."""
    path = described.solution_path(folder)
    if not path.is_file():
        if described.given:
            raise InputError(f"expected the base's solution at {path}, found none; run it again")
        buckle(described.experiment, described.amplitude, described.largest).write(path)
    return Solution.read(path)


PATTERN_SHARE = 0.8
"""A critical mode of which less is the pattern, whatever its amplitude in each cell, is another."""


def _specimen_row(described: SpecimenSpec, solution: Solution) -> dict[str, Any]:
    """What a specimen is, and how it buckles."""
    specimen, critical = described.specimen, solution.info.get("critical")
    share = critical["pattern_overlap_by_cell"] if critical else np.nan
    is_pattern = share >= PATTERN_SHARE
    strain = max(s.nominal_strain for s in solution.snapshots)
    smallest, largest = specimen.diameters.min(), specimen.diameters.max()
    return {
        "ratio": specimen.diameter / specimen.pitch,
        "smallest_ratio": float(smallest / specimen.pitch),
        "largest_ratio": float(largest / specimen.pitch),
        "pitch_mm": specimen.pitch,
        "first": ("pattern" if is_pattern else "other") if critical else "none",
        "pattern_share": share,
        "critical_strain": critical["strain"] if critical else np.nan,
        "strain": strain,
        "unstable_pivots": solution.at(strain).negative_pivots,
        "simulation": solution.info.get("outcome", ""),
    }


def _lattice_row(lattice: LatticeMode) -> dict[str, Any]:
    row = lattice.mode.row
    return {
        "lattice_first": row.kind,
        "lattice_pattern_strain": row.pattern,
        "lattice_overlap_ideal": row.overlap,
        "lattice_a1": lattice.aspect,
    }


def _measured_row(scene: VirtualImagePair, lattice: LatticeMode, own: Path) -> dict[str, Any]:
    """Correlate from the standard start; set against the truth, its best fit and the lattice.

    Returns
    -------
    dict
        ``a1`` ... ``a7`` of the measurement and ``best_a1`` ... of the best fit, in the form
        nearest to the ideal one, phases in shares of l; ``a1_sd_model_error`` and ``a1_sd_noise``
        ...: standard deviations by what the ansatz leaves over, and by noise of :data:`NOISE`.
        ``w_px``, ``best_px``, ``lost_px``: rms per component of truth - IDIC, truth - best fit
        and IDIC - best fit. ``overlap_lattice``: of the mode, of constant amplitude, with the
        infinite lattice's over all cells; ``overlap_truth``: of v₁φ₁ with the truth less the best
        fit's v₀ over the cellular material; ``best_...`` the same of the best fit.
        ``amplitude``: rms length of v₁φ₁ over the cellular material, in shares of l.
    """
    result = scene.correlate()
    found = compare(scene.images, scene.strain, result, scene.start(), camera=scene.how.camera)
    result.write(own / "result.json")
    found.best.write(own / "best.json")
    pitch = scene.specimen.pitch
    sd = {
        "model_error": _model_error_sd(scene, result),
        "noise": _sd(result, result.covariance(NOISE), pitch),
    }
    row: dict[str, Any] = {"outcome": result.outcome.value, "iterations": len(result.history)}
    for prefix, fit in (("", result), ("best_", found.best)):
        row |= dict(
            zip((prefix + a for a in PARAMETERS), _nearest_parameters(fit, pitch), strict=True)
        )
        row[prefix + "overlap_lattice"] = lattice.overlap(
            scene.specimen, fit.ansatz.modes[0].family, fit.mode_parameters()
        )
    for cause, values in sd.items():
        row |= dict(zip((f"{a}_sd_{cause}" for a in PARAMETERS), values, strict=True))
    return row | _errors(found) | _patterns(found, scene.specimen)


def _errors(found: Comparison) -> dict[str, float]:
    """Rms per component of the error's parts [px]."""
    parts = {"w_px": found.w, "best_px": found.best_error, "lost_px": found.idic_to_best}
    px = found.grid.pixel_size
    return {k: float(describe(v, found.mask, px)["rms_per_component"]) for k, v in parts.items()}


def _patterns(found: Comparison, specimen: Specimen) -> dict[str, float]:
    """How alike v₁φ₁ and the specimen's own pattern are, and how strong the first is."""
    a, b = specimen.cellular_half_size
    x, y = np.abs(found.grid.x)[None, :], np.abs(found.grid.y)[:, None]
    inside = found.mask & (x <= a) & (y <= b)
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


def _nearest_parameters(fit: Result, pitch: float) -> FloatArray:
    """(7,) in the form nearest to the ideal one; the phases in shares of l [-]."""
    nearest, _ = mode_equivalent(fit.mode_parameters(), pitch, fit.ansatz.modes[0].family.start)
    return np.asarray(nearest / _units(pitch))


def _sd(result: Result, covariance: FloatArray, pitch: float) -> FloatArray:
    """(7,) standard deviations of :func:`_parameters`."""
    part = result.ansatz.phi_slice(0)
    return np.asarray(np.sqrt(np.diag(covariance)[part]) / _units(pitch))


def _model_error_sd(scene: VirtualImagePair, result: Result) -> FloatArray:
    """The same by the model error, cell by cell."""
    pitch = scene.specimen.pitch
    pair = ImagePair(*scene.pair(), scene.images.grid, *scene.masks())
    seen = MatchedImages.of(result, pair, scene.how.edge_px)
    return _sd(result, seen.sandwich_covariance(pitch), pitch)


def _units(pitch: float) -> FloatArray:
    return np.array([1.0] * 5 + [pitch] * 2)


BASE = "base"


@dataclass(frozen=True)
class MeasuredModesStudy:
    """Measure the mode on specimens that differ from a base in one respect each.

    Each is compressed until its pattern is as strong as the base's, in shares of l.

    Parameters
    ----------
    strain
        Of the base's deformed image [-]; it has to be buckled there.
    ratios
        Other d/l than the base's [-].
    pitches
        Other l [mm]; specimen, elements and pixels are scaled with it.
    materials
        Names among :data:`modeharvest.validation.studies.lattice_pattern.STUDIED_MATERIALS`.
    gradings_x, gradings_y
        Change of the diameter along and across the load [mm/mm], each by itself; d at the
        specimen's centre stays.
    largest
        Strain up to which to look for where a specimen buckles [-].
    divisions
        Elements along l of the infinite lattice's cell.

    Raises
    ------
    InputError
        If a value is out of its range, or comes twice.
    """

    strain: float = 0.128
    ratios: tuple[float, ...] = (0.6, 0.65, 0.7, 0.75, 0.85, 0.9, 0.95)
    pitches: tuple[float, ...] = (0.95,)
    materials: tuple[str, ...] = ("two-term I1", "Ogden m=3, nu=0.40", "Ogden m=3, nu=0.49")
    gradings_x: tuple[float, ...] = (0.02,)
    gradings_y: tuple[float, ...] = (0.02,)
    largest: float = 0.28
    divisions: int = 13

    def __post_init__(self) -> None:
        if not all(0.0 < r < 1.0 for r in self.ratios):
            raise InputError(f"study: expected ratios d/l between 0 and 1, got {list(self.ratios)}")
        if not all(0.0 < p < float("inf") for p in self.pitches):
            raise InputError(f"study: expected pitches above 0 mm, got {list(self.pitches)}")
        unknown = [name for name in self.materials if name not in STUDIED_MATERIALS]
        if unknown:
            raise InputError(
                f"study: expected materials among {list(STUDIED_MATERIALS)}, got {unknown}"
            )
        if 0.0 in (*self.gradings_x, *self.gradings_y):
            raise InputError("study: expected gradings other than 0, which the base has, got 0")
        if not (0.0 < self.largest < 0.5 and 4 <= self.divisions <= 200):
            raise InputError(
                "study: expected largest between 0 and 0.5 and 4 to 200 divisions, got "
                f"{self.largest} and {self.divisions}"
            )
        for name in ("ratios", "pitches", "materials", "gradings_x", "gradings_y"):
            require_different(name, getattr(self, name))

    @property
    def question(self) -> str:
        """What is asked, for the report."""
        return (
            "The paper argues that the pattern of a square stacking of holes is one mode, "
            "whatever the size of its cells, nearly whatever that of its holes, and the material. "
            "Here it is measured: specimens are buckled, imaged and correlated with the mode’s "
            "parameters free, and what is found is set against the mode of the infinite lattice, "
            "against Eq. (mode) of the paper, and against the best fit to the specimen’s own "
            "displacement."
        )

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""
        return f"{one_specimen.__module__}:{one_specimen.__name__}"

    @property
    def seeds(self) -> str:
        """The only thing that is random."""
        return "one speckle, of imaging.speckle.seed"

    def require(self, correlation: SquareLatticeOptions) -> None:
        """The mode's parameters have to be free."""
        require_mode(correlation)

    def quick(self) -> Self:
        """A third of the d/l beside the base's, and one graded specimen."""
        return replace(
            self,
            ratios=self.ratios[2::3],
            pitches=(),
            materials=(),
            gradings_x=(),
            gradings_y=self.gradings_y[:1],
        )

    def prepare(
        self, subject: ImagePairSpec, folder: Path, progress: Progress = silent
    ) -> tuple[Case, ...]:
        """Describe the specimens; they are simulated and imaged case by case.

        Raises
        ------
        InputError
            If the base has no critical point below the strain, or a specimen can't be.
        """
        base = SpecimenSpec.of(subject, self.strain, self.largest, self.divisions)
        name = base.leave(folder)
        snapshot = subject.solution.at(self.strain)
        own = Solution(subject.solution.mesh, (snapshot,), subject.solution.info)
        own.write(base.solution_path(folder))
        others = [
            {"varied": varied, "level": level, "specimen": described.leave(folder)}
            for varied, level, described in self._others(base)
        ]
        return ({"varied": BASE, "level": "", "specimen": name}, *others)

    def _others(self, base: SpecimenSpec) -> Iterator[tuple[str, str, SpecimenSpec]]:
        """What is varied, its level in words, and the specimen."""
        pitch = base.specimen.pitch
        for ratio in self.ratios:
            yield "d/l", f"{ratio:g}", base.changed(diameter=ratio * pitch)
        for other in self.pitches:
            yield "l", f"{other:g} mm", base.scaled(other)
        for material in self.materials:
            yield "material", material, base.changed(STUDIED_MATERIALS[material])
        for along in self.gradings_x:
            yield "graded along the load", f"{along:g}", base.changed(grading_x=along)
        for across in self.gradings_y:
            yield "graded across the load", f"{across:g}", base.changed(grading_y=across)
