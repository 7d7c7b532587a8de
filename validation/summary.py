"""The numbers of a validated virtual experiment: the content of its ``summary.json``.

Keys of ``summary.json`` (rms is per component, see :mod:`modeharvest.validation.truth`):

``title``, ``case``
    What was run.
``critical_strain``, ``critical``
    Critical nominal strain [-] or null, and how it was found and proven.
``energy_below_unstable``
    For each buckled snapshot: stored energy of the branch and of the unstable path [N].
``snapshots``
    A list, one entry for each strain: ``nominal_strain`` [-], ``branch``, ``negative_pivots``,
    ``pattern_amplitude_px``, ``pattern_inner_px``, ``pattern_corners_px`` (largest length of
    v1 phi1, or of the sum over all modes), ``rms_w_px``, ``rms_best_fit_px``, ``rms_idic_to_best_fit_px``, ``rms_residual``
    [fraction of full scale], ``mode`` (the 7, of all equivalents the one nearest to the ideal),
    ``mode_ideal`` (the exact pattern with its origin on a solid junction of this specimen),
    ``mode_standard_error`` (by noise) and ``mode_model_error`` (by what the ansatz can't
    describe; empty where the mode is not observable), ``mode_deviation_percent``,
    ``mode_best_fit``; in staggered rows instead of these ``modes``, for each its ``name``, parameters
    (``names``, ``units``, ``found``, ``ideal``, ``standard_error``, ``model_error``, ``best_fit``),
    ``amplitude_px`` (rms of v_i phi_i per component) and whether it is ``observable``;
    ``iterations`` (on the full image), ``iterations_all_levels``,
    ``outcome``, ``outcome_why``,
    ``condition_number``, ``undetermined``, ``worst_determined`` (combinations of unknowns),
    ``mode_observable``, ``model_error_estimate_px`` (of w, from the images alone),
    ``mode_polynomial_overlap`` (largest cosine), ``residual_correlation``,
    ``noise_sd`` (of the images that were correlated, rms over the material and both images
    [fraction of full scale]; null for the noise-free ones), ``chi_square`` (the residual against
    that noise, or null), ``gain_min``, ``gain_max``, ``offset_min``, ``offset_max`` (over the
    material, where they were unknowns), ``residual_verdict`` and ``weighting``
    (sentences), ``identifiability_warnings``, ``pixels``, ``details_px`` (more statistics of w,
    best-fit error and IDIC - best fit), ``pattern_reading`` (the spectral densities, in words).
``expected``
    Rows of expected and obtained values.
``inverse_map_max_residual_px``, ``factorisations``, ``versions``
    How good the images are, what the path took, and with which software. Seconds are in
    ``timings.json``, so that two runs leave the same summary.
``simulation_outcome``, ``warnings``
    How far the simulation got, and what to beware of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from typing import Any, TypeVar

import numpy as np

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.spectra.pattern import (
    WavePattern,
    mode_deviation,
    mode_equivalent,
    read_pattern,
)
from modeharvest.idic.spectra.spectrum import Spectrum, spectral_density
from modeharvest.idic.uncertainty.covariance import MatchedImages
from modeharvest.idic.uncertainty.identifiability import Identifiability, identifiability
from modeharvest.imaging.imageset import ImageSet
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.validation.truth import Comparison, compare, describe, pattern_size

PAPER = "Maraghechi et al. 2024, doi 10.1016/j.ijsolstr.2024.112916"
INDEPENDENT = "independent calculation"


@dataclass(frozen=True)
class Expectation:
    """An expected value against the one obtained.

    Parameters
    ----------
    quantity, unit
        What, and in what.
    expected
        In words, with its range.
    obtained
        The value of this run.
    ok
        Whether it lies in the range.
    source
        Where the expectation comes from.
    """

    quantity: str
    unit: str
    expected: str
    obtained: float
    ok: bool
    source: str


def expectations(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Compare a summary of the paper's specimen with what is expected of it.

    Parameters
    ----------
    summary
        The content of ``summary.json``.

    Returns
    -------
    list of dict
        The fields of :class:`Expectation`, a row each; snapshots that are not there, and a
        critical strain that was not found, are left out.
    """
    rows = [
        Expectation(
            "largest residual of the inverse mapping", "px", "at most 1e-10",
            summary["inverse_map_max_residual_px"],
            summary["inverse_map_max_residual_px"] <= 1e-10, "this project's promise",
        )
    ]  # fmt: skip
    critical = summary.get("critical_strain")
    if critical is not None:
        ok = abs(100 * critical - 9.6) <= 0.3
        rows.insert(0, Expectation("critical strain", "%", "9.6 ± 0.3", 100 * critical, ok,
                                   INDEPENDENT))  # fmt: skip
    for snapshot in summary["snapshots"]:
        is_buckled = critical is not None and snapshot["nominal_strain"] > critical
        rows += _after(snapshot) if is_buckled else _before(snapshot)
    return [asdict(row) for row in rows]


def _before(snapshot: Mapping[str, Any]) -> list[Expectation]:
    at = f" at {100 * snapshot['nominal_strain']:.1f} %"
    inner, corners = snapshot["pattern_inner_px"], snapshot["pattern_corners_px"]
    return [
        Expectation("negative pivots" + at, "-", "0", snapshot["negative_pivots"],
                    snapshot["negative_pivots"] == 0, "stability"),
        Expectation("pattern inside over pattern in the corners" + at, "-",
                    "below 1: v₁ near zero except at the corners", inner / corners,
                    inner < corners, PAPER + ", Fig. (virt)"),
    ]  # fmt: skip


def _after(snapshot: Mapping[str, Any]) -> list[Expectation]:
    at = f" at {100 * snapshot['nominal_strain']:.1f} %"
    worst = max((abs(v) for v in snapshot.get("mode_deviation_percent", ())), default=0.0)
    pattern, best = snapshot["pattern_amplitude_px"], snapshot["rms_best_fit_px"]
    loss = snapshot["rms_idic_to_best_fit_px"]
    length = snapshot["details_px"]["idic_to_best_fit"]["rms_length"]
    return [
        Expectation("negative pivots" + at, "-", "0", snapshot["negative_pivots"],
                    snapshot["negative_pivots"] == 0, "stability"),
        Expectation("pattern amplitude" + at, "px", "about 28 (25 to 31)", pattern,
                    25 <= pattern <= 31, INDEPENDENT),
        Expectation("mode's largest deviation from [1, 1, 1, −1, 1, 0, 0]" + at, "%", "at most 2",
                    worst, worst <= 2, INDEPENDENT),
        Expectation("best possible fit, rms per component" + at, "px", "about 1.9 (1.7 to 2.1)",
                    best, 1.7 <= best <= 2.1, INDEPENDENT),
        Expectation("IDIC − best fit, rms per component" + at, "px", "at most 0.35", loss,
                    loss <= 0.35, INDEPENDENT),
        Expectation("IDIC − best fit, rms of the vector's length" + at, "px", "at most 0.35",
                    length, length <= 0.35, "the same, read strictly"),
    ]  # fmt: skip


T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class MeasuredExperiment:
    """What is to be judged.

    Parameters
    ----------
    experiment
        What was simulated: geometry, material, strains.
    how
        How the images were correlated.
    solution, images
        Where the truth comes from.
    results
        What IDIC found, by nominal strain.
    """

    experiment: Experiment
    how: SquareLatticeOptions
    solution: Solution
    images: ImageSet
    results: Mapping[float, Result]

    @property
    def specimen(self) -> Specimen:
        """The geometry."""
        return self.experiment.specimen


def experiment_summary(
    measured: MeasuredExperiment, case: Mapping[str, Any], snapshots: list[dict[str, Any]]
) -> dict[str, Any]:
    info, images = measured.solution.info, measured.images
    critical = info.get("critical")
    summary: dict[str, Any] = {
        "title": case.get("title", ""),
        "case": dict(case),
        "critical_strain": None if critical is None else critical["strain"],
        "critical": critical,
        "energy_below_unstable": _energies(measured.solution),
        "snapshots": snapshots,
        "inverse_map_max_residual_px": images.max_residual_px,
        "factorisations": info.get("factorisations"),
        "simulation_outcome": info.get("outcome"),
        "warnings": list(info.get("warnings", [])),
        "versions": {**info.get("versions", {}), **images.info.get("versions", {})},
    }
    # What is expected is known for the paper's experiment at its resolution, and no other.
    is_known = measured.experiment == Experiment() and images.spec.pixel_size == 0.01
    summary["expected"] = expectations(summary) if is_known else []
    return summary


def displacement_spectrum(
    comparisons: Sequence[Comparison], k: int, measured: MeasuredExperiment
) -> tuple[Spectrum, WavePattern]:
    comparison = comparisons[k]
    spectrum = spectral_density(
        comparison.displacement, comparison.grid, comparison.mask, measured.specimen.pitch
    )
    return spectrum, read_pattern(spectrum)


def compare_snapshot(measured: MeasuredExperiment, strain: float) -> Comparison:
    result, how = measured.results[strain], measured.how
    start = result.ansatz.initial_guess(strain, how.start_amplitude)
    return compare(measured.images, strain, result, start, how.camera)


def snapshot_summary(
    comparisons: Sequence[Comparison],
    spectra: Sequence[tuple[Spectrum, WavePattern]],
    k: int,
    measured: MeasuredExperiment,
) -> dict[str, Any]:
    comparison, (_, pattern) = comparisons[k], spectra[k]
    result, mask = comparison.result, comparison.mask
    specimen, state = measured.specimen, measured.solution.at(comparison.strain)
    size = pattern_size(comparison, specimen)
    parts = {
        "w": comparison.w,
        "best_fit": comparison.best_error,
        "idic_to_best_fit": comparison.idic_to_best,
    }
    px = {n: describe(part, mask, comparison.grid.pixel_size) for n, part in parts.items()}
    seen = identifiability(result, mask)
    noise = _snapshot_noise(measured, comparison.strain)
    test = result.residual_test(noise)
    return {
        "nominal_strain": comparison.strain,
        "branch": state.branch,
        "negative_pivots": state.negative_pivots,
        "pattern_amplitude_px": size.anywhere,
        "pattern_inner_px": size.inner,
        "pattern_corners_px": size.corners,
        "rms_w_px": px["w"]["rms_per_component"],
        "rms_best_fit_px": px["best_fit"]["rms_per_component"],
        "rms_idic_to_best_fit_px": px["idic_to_best_fit"]["rms_per_component"],
        "rms_residual": result.residual_rms,
        **_mode_numbers(comparison, measured, seen),
        **_brightness(comparison),
        "mode_observable": not seen.unobservable,
        "model_error_estimate_px": seen.model_error_px,
        "mode_polynomial_overlap": max(seen.overlap),
        "worst_determined": [str(combination) for combination in seen.worst],
        "residual_correlation": result.residual_correlation,
        "noise_sd": None if noise is None else float(np.hypot(*astuple(noise)) / np.sqrt(2.0)),
        "chi_square": None if noise is None else test.chi_square,
        "identifiability_warnings": list(seen.warnings),
        "residual_verdict": test.sentence,
        "weighting": result.weighting.sentence,
        "iterations": result.iterations,
        "iterations_all_levels": len(result.history),
        "outcome": result.outcome.name.lower(),
        "outcome_why": result.outcome.explanation,
        "condition_number": result.condition_number,
        "undetermined": list(result.undetermined),
        "pixels": result.pixels,
        "details_px": px,
        "pattern_reading": list(pattern.text),
    }


def _snapshot_noise(measured: MeasuredExperiment, strain: float) -> ImageNoise | None:
    """Noise of the exposures [fraction of full scale]; None if noise-free images were measured.

    The roots of mean variances, since chi squared compares sums of squares.
    """
    if not measured.how.camera:
        return None
    images = measured.images
    in_f = images.noise_sd()[images.mask()]
    in_g = images.noise_sd(strain)[images.deformed_mask(strain)]
    return ImageNoise(*(float(np.sqrt((sd**2).mean())) for sd in (in_f, in_g)))


def _brightness(comparison: Comparison) -> dict[str, float]:
    """Gain [-] and offset [fraction of full scale] over the material; nothing if not unknown."""
    result, grid = comparison.result, comparison.grid
    fields = zip(
        ("gain", "offset"),
        (result.ansatz.brightness.gain_degree, result.ansatz.brightness.offset_degree),
        result.ansatz.gain_and_offset(result.unknowns, grid.x, grid.y),
        strict=True,
    )
    found: dict[str, float] = {}
    for name, degree, values in fields:
        if degree is not None:
            seen = np.broadcast_to(values, grid.shape)[comparison.mask]
            found |= {f"{name}_min": float(seen.min()), f"{name}_max": float(seen.max())}
    return found


def _mode_numbers(
    comparison: Comparison, measured: MeasuredExperiment, seen: Identifiability
) -> dict[str, Any]:
    """The modes' parameters against the ideal ones; nothing where they were fixed."""
    result, best, pitch = comparison.result, comparison.best, measured.specimen.pitch
    ansatz = result.ansatz
    start = ansatz.initial_guess(comparison.strain, measured.how.start_amplitude)
    parts = [ansatz.phi_slice(i) for i in range(len(ansatz.modes))]
    if not any(start[part].size for part in parts):
        return {}
    noise = result.standard_errors()
    is_any = len(seen.unobservable) < len(parts)
    model = _model_errors(comparison, measured) if is_any else [None] * ansatz.size
    if measured.specimen.is_staggered:
        return {
            "modes": [
                {
                    "name": mode.family.name,
                    "names": list(mode.family.names),
                    "units": list(mode.family.units),
                    "found": result.mode_parameters(i).tolist(),
                    "ideal": start[part].tolist(),
                    "standard_error": _finite_or_none(noise[part]),
                    "model_error": model[part] if i not in seen.unobservable else [],
                    "best_fit": best.mode_parameters(i).tolist(),
                    "amplitude_px": seen.amplitude_px[i],
                    "observable": i not in seen.unobservable,
                }
                for i, (mode, part) in enumerate(zip(ansatz.modes, parts, strict=True))
            ]
        }
    found, ideal = result.mode_parameters(), start[parts[0]]
    return {
        "mode": mode_equivalent(found, pitch, ideal)[0].tolist(),
        "mode_ideal": ideal.tolist(),
        "mode_standard_error": _finite_or_none(noise[parts[0]]),
        "mode_model_error": model[parts[0]] if not seen.unobservable else [],
        "mode_deviation_percent": mode_deviation(found, pitch, ideal).tolist(),
        "mode_best_fit": mode_equivalent(best.mode_parameters(), pitch, ideal)[0].tolist(),
    }


def _model_errors(comparison: Comparison, measured: MeasuredExperiment) -> list[float | None]:
    """Standard deviations of the unknowns by what the ansatz can't describe; None if not known.

    Each unit cell's share of the residual counts as one draw: where noise says how well the
    images determine the unknowns, this says how far w moves them.
    """
    how, result = measured.how, comparison.result
    pair = measured.images.pair(comparison.strain, camera=how.camera)
    try:
        matched = MatchedImages.of(result, pair, how.edge_px)
        found = matched.sandwich_covariance(measured.specimen.pitch)
    except InputError:  # a specimen of too few cells
        return [None] * result.ansatz.size
    return _finite_or_none(np.sqrt(np.diag(found)))


def _energies(solution: Solution) -> list[dict[str, float]]:
    """Energies [N] of the buckled snapshots and of the primary path at the same strain."""
    primary = solution.info.get("path", {}).get("primary", {})
    at = dict(zip(primary.get("nominal_strain", []), primary.get("energy_N", []), strict=True))
    return [
        {
            "nominal_strain": s.nominal_strain,
            "branch_N": s.energy,
            "unstable_N": at[s.nominal_strain],
        }
        for s in solution.snapshots
        if s.branch != "primary" and s.nominal_strain in at
    ]


def _finite_or_none(values: FloatArray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]
