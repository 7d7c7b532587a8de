"""The numbers of a validated virtual experiment: the content of its ``summary.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.modes import two_waves_near
from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.spectra import pattern as mode_pattern
from modeharvest.idic.spectra.spectrum import Spectrum, spectral_density
from modeharvest.idic.uncertainty.covariance import MatchedImages
from modeharvest.idic.uncertainty.identifiability import Identifiability, identifiability
from modeharvest.imaging.imageset import ImageSet
from modeharvest.util.errors import InputError
from modeharvest.util.typed import quantity, to_plain
from modeharvest.validation.truth import Comparison, VectorStatistics, compare, pattern_size
from modeharvest.validation.whole_field import WholeFieldSummary

REQUIREMENT = "this project's requirement"
PAPER = "Maraghechi et al. 2024, doi 10.1016/j.ijsolstr.2024.112916"
INDEPENDENT = "independent calculation"


@dataclass(frozen=True)
class Expectation:
    """A result and its expected value, in ``unit`` or as text, and the source of the latter."""

    quantity: str
    obtained: float | str | None
    expected: float | str
    ok: bool | None
    """Whether the result meets the expectation; None where nothing was expected of it."""
    unit: str = ""
    source: str = ""

    @classmethod
    def at_most(
        cls, quantity: str, obtained: float, limit: float, unit: str, source: str = REQUIREMENT
    ) -> Expectation:
        """Expect a number to be at most ``limit``, in the same unit; ``source`` of the limit."""
        return cls(quantity, obtained, f"≤ {limit:g}", obtained <= limit, unit, source)


@dataclass(frozen=True)
class BuckledEnergy:
    """Stored energy per thickness of a buckled snapshot and of the unstable path there [N]."""

    nominal_strain: float
    branch_N: float
    unstable_N: float


@dataclass(frozen=True)
class ModeSummary:
    """A mode's parameters: of all equivalent sets the one nearest to the ideal parameters."""

    name: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    found: tuple[float, ...]
    ideal: tuple[float, ...]
    """The exact pattern with its origin on a solid junction."""
    standard_error: tuple[float | None, ...]
    model_error: tuple[float | None, ...]
    """Standard errors of ``found``, by noise and by model error; the latter is empty if the mode is
    not observable."""
    best_fit: tuple[float, ...]
    amplitude_px: float
    """Rms of v_i phi_i per component."""
    observable: bool


_SINGLE = {"mode": "found", "mode_ideal": "ideal", "mode_standard_error": "standard_error",
           "mode_model_error": "model_error", "mode_best_fit": "best_fit"}  # fmt: skip
"""Keys in ``summary.json`` for the parameters of a single mode."""
_OPTIONAL = {"gain_min", "gain_max", "offset_min", "offset_max", "mode_deviation_percent", "modes",
             "whole_field"}  # fmt: skip
"""Keys that ``summary.json`` omits if they were not measured."""


@dataclass(frozen=True, kw_only=True)
class SnapshotSummary:
    """One strain of a virtual experiment; rms values are per component.

    The lengths ``pattern_...`` are those of v1 phi1, or of the sum over all modes. ``modes`` is
    empty without free parameters. Gain and offset are None if they are not unknowns; numbers about
    noise are None for noise-free images.
    """

    nominal_strain: float
    branch: str
    negative_pivots: int | None = quantity("negative pivots of the tangent stiffness", "–")
    pattern_amplitude_px: float = quantity("pattern v₁φ₁, largest length", "px")
    pattern_inner_px: float = quantity("… without the outermost ring of cells", "px")
    pattern_corners_px: float = quantity("… in the four corner cells", "px")
    rms_w_px: float = quantity("w = truth − IDIC, rms", "px")
    rms_best_fit_px: float = quantity("model error: truth − best fit, rms", "px")
    rms_idic_to_best_fit_px: float = quantity("measurement error: IDIC − best fit, rms", "px")
    rms_residual: float = quantity("residual, rms, as a fraction of full scale", "–")
    pixels: int = quantity("pixels compared", "–")
    iterations: int = quantity("iterations at full resolution", "–")
    iterations_all_levels: int = quantity("iterations on all levels", "–")
    condition_number: float = quantity("condition number", "–")
    residual_correlation: float = quantity("autocorrelation of the residual, 4 to 12 px", "–")
    noise_sd: float | None = quantity("noise of the camera images, rms, share of full scale", "–")
    """Rms over the material in both images."""
    chi_square: float | None = quantity("χ² of the residual: 1 if that noise and no more", "–")
    gain_min: float | None = quantity("gain between the images, smallest", "–", default=None)
    gain_max: float | None = quantity("… largest", "–", default=None)
    offset_min: float | None = quantity("offset, smallest, share of full scale", "–", default=None)
    offset_max: float | None = quantity("… largest", "–", default=None)
    model_error_estimate_px: float = quantity("w, estimated from the images alone, rms", "px")
    mode_polynomial_overlap: float = quantity("overlap of the mode's part with v₀", "–")
    outcome: str = quantity("outcome")
    outcome_why: str
    modes: tuple[ModeSummary, ...] = ()
    mode_deviation_percent: tuple[float, ...] = ()
    """Deviation of a single mode, Eq. (6), from the ideal one; empty with several modes."""
    mode_observable: bool
    worst_determined: tuple[str, ...]
    undetermined: tuple[str, ...]
    identifiability_warnings: tuple[str, ...]
    residual_verdict: str
    weighting: str
    details_px: Mapping[str, VectorStatistics]
    """Statistics of w, best-fit error, and IDIC - best fit."""
    pattern_reading: tuple[str, ...]
    whole_field: WholeFieldSummary | None = None

    def plain(self) -> dict[str, Any]:
        """As plain values, including the parameters of a single mode; empty values are omitted."""
        values: dict[str, Any] = to_plain(self)
        if self.mode_deviation_percent:
            (mode,) = values.pop("modes")
            values |= {key: mode[name] for key, name in _SINGLE.items()}
        return {k: v for k, v in values.items() if k not in _OPTIONAL or v not in (None, [])}


@dataclass(frozen=True, kw_only=True)
class ExperimentSummary:
    """The case, its buckling, and the errors of each snapshot's measurement.

    Run times are in ``timings.json``, so that two runs give the same summary.
    """

    title: str
    case: Mapping[str, Any]
    critical_strain: float | None
    critical: Mapping[str, Any] | None
    """How the critical point was found and verified."""
    energy_below_unstable: tuple[BuckledEnergy, ...]
    snapshots: tuple[SnapshotSummary, ...]
    inverse_map_max_residual_px: float
    factorisations: int | None
    simulation_outcome: str | None
    """How far the simulation followed the path."""
    warnings: tuple[str, ...]
    versions: Mapping[str, str]
    expected: tuple[Expectation, ...] = ()

    def plain(self) -> dict[str, Any]:
        """The content of ``summary.json``."""
        return {**to_plain(self), "snapshots": [part.plain() for part in self.snapshots]}


def expectations(summary: ExperimentSummary) -> tuple[Expectation, ...]:
    """Compare a summary of the paper's specimen with the expected values.

    Missing snapshots, and a critical strain that was not found, are omitted.
    """
    residual, critical = summary.inverse_map_max_residual_px, summary.critical_strain
    rows = []
    if critical is not None:
        found = 100 * critical
        rows = [Expectation("critical strain", found, "9.6 ± 0.3", abs(found - 9.6) <= 0.3, "%",
                            INDEPENDENT)]  # fmt: skip
    words = "largest residual of the inverse mapping"
    rows.append(Expectation.at_most(words, residual, 1e-10, "px"))
    for snapshot in summary.snapshots:
        at, pivots = f" at {100 * snapshot.nominal_strain:.1f} %", snapshot.negative_pivots
        is_buckled = critical is not None and snapshot.nominal_strain > critical
        rows.append(Expectation("negative pivots" + at, pivots, "0", pivots == 0, "-", "stability"))
        rows += _of_buckled(snapshot, at) if is_buckled else _of_stable(snapshot, at)
    return tuple(rows)


def _of_stable(snapshot: SnapshotSummary, at: str) -> list[Expectation]:
    inner, corners = snapshot.pattern_inner_px, snapshot.pattern_corners_px
    return [
        Expectation("pattern inside over pattern in the corners" + at, inner / corners,
                    "below 1: v₁ near zero except at the corners", inner < corners, "-",
                    PAPER + ", Fig. 5"),
    ]  # fmt: skip


def _of_buckled(snapshot: SnapshotSummary, at: str) -> list[Expectation]:
    worst = max((abs(v) for v in snapshot.mode_deviation_percent), default=0.0)
    pattern, best = snapshot.pattern_amplitude_px, snapshot.rms_best_fit_px
    length = snapshot.details_px["idic_to_best_fit"].rms_length
    at_most = Expectation.at_most
    return [
        Expectation("pattern amplitude" + at, pattern, "about 28 (25 to 31)", 25 <= pattern <= 31,
                    "px", INDEPENDENT),
        at_most("mode's largest deviation from [1, 1, 1, −1, 1, 0, 0]" + at, worst, 2, "%",
                INDEPENDENT),
        Expectation("best possible fit, rms per component" + at, best, "about 1.9 (1.7 to 2.1)",
                    1.7 <= best <= 2.1, "px", INDEPENDENT),
        at_most("IDIC − best fit, rms length of the vectors" + at, length, 0.35, "px", INDEPENDENT),
    ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class MeasuredExperiment:
    """A virtual experiment with its images and measurements, to be assessed."""

    experiment: Experiment
    options: SquareLatticeOptions
    solution: Solution
    images: ImageSet
    results: Mapping[float, Result]
    """Results by nominal strain."""

    @property
    def specimen(self) -> Specimen:
        """The geometry of the specimen."""
        return self.experiment.specimen


def experiment_summary(
    measured: MeasuredExperiment, case: Mapping[str, Any], snapshots: Sequence[SnapshotSummary]
) -> ExperimentSummary:
    """All numbers of an experiment, from the summaries of its snapshots."""
    info, images = measured.solution.info, measured.images
    critical = info.get("critical")
    summary = ExperimentSummary(
        title=case.get("title", ""), case=case, critical=critical,
        critical_strain=None if critical is None else critical["strain"],
        energy_below_unstable=_energies(measured.solution), snapshots=tuple(snapshots),
        inverse_map_max_residual_px=images.max_residual_px,
        factorisations=info.get("factorisations"), simulation_outcome=info.get("outcome"),
        warnings=tuple(info.get("warnings", [])),
        versions={**info.get("versions", {}), **images.info.get("versions", {})},
    )  # fmt: skip
    # Expected values are known only for the paper's experiment at its resolution.
    is_known = measured.experiment == Experiment() and images.spec.pixel_size == 0.01
    return replace(summary, expected=expectations(summary)) if is_known else summary


def displacement_spectrum(
    comparisons: Sequence[Comparison], k: int, measured: MeasuredExperiment
) -> tuple[Spectrum, mode_pattern.WavePattern]:
    """Spectral densities [mm⁶] of the k-th true displacement, and the pattern read from them."""
    at, pitch = comparisons[k], measured.specimen.pitch
    spectrum = spectral_density(at.displacement, at.grid, at.mask, pitch)
    return spectrum, mode_pattern.read_pattern(spectrum)


def compare_snapshot(k: int, measured: MeasuredExperiment) -> Comparison:
    """Compare the k-th result, by ascending strain, with the truth."""
    strain = sorted(measured.results)[k]
    result, options = measured.results[strain], measured.options
    start = result.ansatz.initial_guess(strain, options.start_amplitude)
    return compare(measured.images, strain, result, start, options.camera)


def snapshot_summary(
    comparisons: Sequence[Comparison],
    spectra: Sequence[tuple[Spectrum, mode_pattern.WavePattern]],
    k: int,
    measured: MeasuredExperiment,
) -> SnapshotSummary:
    """The numbers of the k-th snapshot."""
    comparison, (_, pattern) = comparisons[k], spectra[k]
    result, state = comparison.result, measured.solution.at(comparison.strain)
    anywhere, inner, corners = pattern_size(comparison, measured.specimen)
    px = comparison.statistics()
    found = identifiability(result, comparison.mask)
    noise = _snapshot_noise(measured, comparison.strain)
    test = result.residual_test(noise)
    rms = {name: statistics.rms_per_component for name, statistics in px.items()}
    return SnapshotSummary(
        nominal_strain=comparison.strain, branch=state.branch,
        negative_pivots=state.negative_pivots, pattern_amplitude_px=anywhere,
        pattern_inner_px=inner, pattern_corners_px=corners,
        rms_w_px=rms["w"], rms_best_fit_px=rms["best_fit"],
        rms_idic_to_best_fit_px=rms["idic_to_best_fit"], rms_residual=result.residual_rms,
        **_mode_numbers(comparison, measured, found), **_brightness(comparison),
        mode_observable=not found.unobservable, model_error_estimate_px=found.model_error_px,
        mode_polynomial_overlap=max(found.overlap),
        worst_determined=tuple(str(combination) for combination in found.worst),
        residual_correlation=result.residual_correlation,
        noise_sd=None if noise is None else float(np.hypot(*astuple(noise)) / np.sqrt(2.0)),
        chi_square=None if noise is None else test.chi_square,
        identifiability_warnings=tuple(found.warnings), residual_verdict=test.text,
        weighting=result.weighting.text, iterations=result.iterations,
        iterations_all_levels=len(result.history), outcome=result.outcome.name.lower(),
        outcome_why=result.outcome.explanation, condition_number=result.condition_number,
        undetermined=tuple(result.undetermined), pixels=result.pixels, details_px=px,
        pattern_reading=tuple(pattern.text),
    )  # fmt: skip


def _snapshot_noise(measured: MeasuredExperiment, strain: float) -> ImageNoise | None:
    """Noise of the exposures [fraction of full scale]; None if noise-free images were measured.

    Each is the root of the mean variance, since chi squared compares sums of squares.
    """
    if not measured.options.camera:
        return None
    images = measured.images
    in_f = images.noise_sd()[images.mask()]
    in_g = images.noise_sd(strain)[images.deformed_mask(strain)]
    return ImageNoise(*(float(np.sqrt((sd**2).mean())) for sd in (in_f, in_g)))


def _brightness(comparison: Comparison) -> dict[str, Any]:
    """Ranges of gain [-] and offset [of full scale] over the material; empty if not unknowns."""
    grid, ansatz = comparison.grid, comparison.result.ansatz
    degrees = ansatz.brightness.gain_degree, ansatz.brightness.offset_degree
    fields = ansatz.gain_and_offset(comparison.result.unknowns, grid.x, grid.y)
    found: dict[str, Any] = {}
    for name, degree, values in zip(("gain", "offset"), degrees, fields, strict=True):
        if degree is not None:
            on_material = np.broadcast_to(values, grid.shape)[comparison.mask]
            found[f"{name}_min"] = float(on_material.min())
            found[f"{name}_max"] = float(on_material.max())
    return found


def _mode_numbers(
    comparison: Comparison, measured: MeasuredExperiment, found: Identifiability
) -> dict[str, Any]:
    """The modes' parameters and the ideal ones; empty if the parameters were fixed."""
    result, best, pitch = comparison.result, comparison.best, measured.specimen.pitch
    ansatz = result.ansatz
    start = ansatz.initial_guess(comparison.strain, measured.options.start_amplitude)
    parts = [ansatz.phi_slice(i) for i in range(len(ansatz.modes))]
    if not any(start[part].size for part in parts):
        return {}
    noise = result.standard_errors()
    is_any = len(found.unobservable) < len(parts)
    model = _model_errors(comparison, measured) if is_any else (None,) * ansatz.size
    is_staggered = measured.specimen.is_staggered
    modes = []
    for i, (mode, part) in enumerate(zip(ansatz.modes, parts, strict=True)):
        family, is_observable, ideal = mode.family, i not in found.unobservable, start[part]
        at, at_best = (
            two_waves_near(fit.mode_parameters(i), ideal, pitch) if is_staggered
            else mode_pattern.mode_equivalent(fit.mode_parameters(i), pitch, ideal)[0]
            for fit in (result, best)
        )  # fmt: skip
        modes.append(ModeSummary(
            family.name, tuple(family.names), tuple(family.units), tuple(at), tuple(ideal),
            tuple(noise[part]), model[part] if is_observable else (), tuple(at_best),
            found.amplitude_px[i], is_observable,
        ))  # fmt: skip
    if is_staggered:
        return {"modes": tuple(modes)}
    found_mode, pattern = result.mode_parameters(), modes[0].ideal
    deviation = mode_pattern.mode_deviation(found_mode, pitch, pattern)
    return {"modes": tuple(modes), "mode_deviation_percent": tuple(deviation)}


def _model_errors(comparison: Comparison, measured: MeasuredExperiment) -> tuple[float | None, ...]:
    """Standard deviations of the unknowns by model error, clustered by cell; None if unknown."""
    options, result = measured.options, comparison.result
    pair = measured.images.pair(comparison.strain, camera=options.camera)
    try:
        matched = MatchedImages.of(result, pair, options.edge_px)
        covariance = matched.sandwich_covariance(measured.specimen.pitch)
    except InputError:  # a specimen of too few cells
        return (None,) * result.ansatz.size
    return tuple(np.sqrt(np.diag(covariance)))


def _energies(solution: Solution) -> tuple[BuckledEnergy, ...]:
    """Energies of the buckled snapshots and of the unstable path."""
    primary = solution.info.get("path", {}).get("primary", {})
    at = dict(zip(primary.get("nominal_strain", []), primary.get("energy_N", []), strict=True))
    return tuple(
        BuckledEnergy(s.nominal_strain, s.energy, at[s.nominal_strain])
        for s in solution.snapshots
        if s.branch != "primary" and s.nominal_strain in at
    )
