"""One specimen of a study of measured modes: buckled, imaged, measured, compared.

In ``specimens/NAME/`` of the study's folder, NAME the digest of the description::

    specimen.json          how it is made, imaged and correlated
    solution.h5            the exact displacement, a copy of the one in ``solutions/``
    result.json best.json  the measurement, and the best fit of its ansatz to the truth
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.compared import Compared
from modeharvest.idic.families.equivalents import mode_equivalent
from modeharvest.idic.result import Result
from modeharvest.validation.metrics import describe
from modeharvest.validation.studies.modes.description import Description, folder_of
from modeharvest.validation.studies.modes.lattice import LatticeMode
from modeharvest.validation.studies.modes.pattern import buckle
from modeharvest.validation.studies.subject import Scene, Subject
from modeharvest.validation.truth import Comparison, compare

FloatArray = NDArray[np.float64]

PARAMETERS = tuple(f"a{k}" for k in range(1, 8))
"""Of Eq. (mode); a₆ and a₇ are told in shares of l."""
NOISE = 0.01
"""Of the images, for which error bars are told; the images have none [fraction of full scale]."""


def one_specimen(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Buckle, image, measure and compare.

    Parameters
    ----------
    case
        One of :meth:`modeharvest.validation.studies.modes.study.Modes.prepare`.
    folder
        Of the study.

    Returns
    -------
    dict
        ``ratio``, ``pitch_mm``, ...: the specimen; ``first``: "pattern", "other" or "none", what it
        buckles into; ``critical_strain``, ``strain``; of the lattice ``lattice_...``; and where it
        buckles, of the measurement and the best fit what :func:`_measured` returns.
    """
    own = folder_of(folder, case["specimen"])
    described = Description.read(own / "specimen.json")
    solution = _solution(described, folder)
    lattice = LatticeMode.of(described.specimen, described.material, described.divisions)
    row = _told(described, solution) | _told_of_lattice(lattice)
    if row["first"] == "none":
        return row
    subject = Subject(
        described.experiment, described.imaging, described.correlation, lambda: solution
    )
    scene = Scene.open(own, subject.describe(own, row["strain"]))
    try:
        return row | _measured(scene, lattice, own)
    finally:
        scene.discard()


def _solution(described: Description, folder: Path) -> Solution:
    """The one that is there, or a new one: simulating costs most, and knows nothing of images."""
    path = described.solution_path(folder)
    if not path.is_file():
        if described.given:
            raise InputError(f"expected the base's solution at {path}, found none; run it again")
        buckle(described.experiment, described.amplitude, described.largest).write(path)
    return Solution.read(path)


PATTERN_SHARE = 0.8
"""A critical mode of which less is the pattern, whatever its amplitude in each cell, is another."""


def _told(described: Description, solution: Solution) -> dict[str, Any]:
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


def _told_of_lattice(lattice: LatticeMode) -> dict[str, Any]:
    row = lattice.mode.row
    return {
        "lattice_first": row.kind,
        "lattice_pattern_strain": row.pattern,
        "lattice_overlap_ideal": row.overlap,
        "lattice_a1": lattice.aspect,
    }


def _measured(scene: Scene, lattice: LatticeMode, own: Path) -> dict[str, Any]:
    """Correlate from the standard start; set against the truth, its best fit and the lattice.

    Returns
    -------
    dict
        ``a1`` ... ``a7`` of the measurement and ``best_a1`` ... of the best fit, in the form
        nearest to the ideal one, phases in shares of l; ``a1_sd_leftover`` and ``a1_sd_noise``
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
        "leftover": _leftover_sd(scene, result),
        "noise": _sd(result, result.covariance(NOISE), pitch),
    }
    row: dict[str, Any] = {"outcome": result.outcome.value, "iterations": len(result.history)}
    for prefix, fit in (("", result), ("best_", found.best)):
        row |= dict(zip((prefix + a for a in PARAMETERS), _parameters(fit, pitch), strict=True))
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


def _parameters(fit: Result, pitch: float) -> FloatArray:
    """(7,) in the form nearest to the ideal one; the phases in shares of l [-]."""
    nearest, _ = mode_equivalent(fit.mode_parameters(), pitch, fit.ansatz.modes[0].family.start)
    return np.asarray(nearest / _units(pitch))


def _sd(result: Result, covariance: FloatArray, pitch: float) -> FloatArray:
    """(7,) standard deviations of :func:`_parameters`."""
    part = result.ansatz.phi_slice(0)
    return np.asarray(np.sqrt(np.diag(covariance)[part]) / _units(pitch))


def _leftover_sd(scene: Scene, result: Result) -> FloatArray:
    """The same by what the ansatz leaves over, cell by cell."""
    pitch, how = scene.specimen.pitch, scene.how.options()
    seen = Compared.of(result, scene.pair(), scene.masks(), how.edge_px)
    return _sd(result, seen.leftover_covariance(result, pitch), pitch)


def _units(pitch: float) -> FloatArray:
    return np.array([1.0] * 5 + [pitch] * 2)
