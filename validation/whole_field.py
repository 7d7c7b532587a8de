"""The whole displacement against the truth: errors up to every edge, coverage, refitted modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.result import Result
from modeharvest.idic.spectra.pattern import mode_equivalent
from modeharvest.util.arrays import FloatArray
from modeharvest.util.typed import quantity
from modeharvest.validation.scoring.score import BULK, EDGES, JUNCTIONS, LIGAMENTS, REGIONS, regions
from modeharvest.validation.truth import Comparison, lengths

_NORMAL_95 = 1.959964


@dataclass(frozen=True, kw_only=True)
class WholeFieldSummary:
    """Errors of the whole displacement, rms per component over the material's pixels.

    Regions are those of scores. Two runs differ in nothing but ``seconds``.
    """

    rms_px: float = quantity("whole displacement: truth − measured, rms", "px")
    rms_edges_px: float | None = quantity("… within 10 px of an edge", "px")
    rms_ligaments_px: float | None = quantity("… of ligaments", "px")
    rms_junctions_px: float | None = quantity("… of junctions", "px")
    rms_bulk_px: float | None = quantity("… of the bulk", "px")
    max_px: float = quantity("… largest length", "px")
    coverage: float = quantity("… share of the material measured", "–")
    rms_refit_to_best_fit_px: float = quantity("… refitted ansatz − best fit, rms", "px")
    cutoff_px: float = quantity("… cut-off wavelength of the regularisation", "px")
    unknowns: int = quantity("… unknowns", "–")
    interval_coverage: float = quantity("… truth within 95 % intervals", "–")
    """Share of the components of all pixels."""
    interval_coverage_edges: float | None = quantity("… the same within 10 px of an edge", "–")
    mode: tuple[float, ...]
    """Parameters of a single mode in the ansatz refitted to the whole displacement."""
    library: str
    """That factorised the matrices."""
    warnings: tuple[str, ...]
    seconds: float
    """Of the measurement, on this machine."""


@dataclass(frozen=True, eq=False)
class WholeFieldComparison:
    """A whole displacement beside the truth."""

    measured: NodalResult
    displacement: FloatArray
    """(rows, cols, 2) measured u [mm]; NaN off the mesh."""
    error: FloatArray
    """(rows, cols, 2) truth - measured [mm]."""
    standard_deviation: FloatArray
    """(rows, cols, 2) of the measured displacement [mm]."""
    refit: Result
    """The correlation's ansatz, fitted to what was measured."""
    summary: WholeFieldSummary


def compare_whole(
    comparison: Comparison, measured: NodalResult, specimen: Specimen, seconds: float
) -> WholeFieldComparison:
    """Set a whole displacement against the truth, and refit to it the ansatz of a correlation.

    comparison : of that correlation with the truth.
    seconds : what the measurement took.
    """
    grid, mask, px = comparison.grid, comparison.mask, comparison.grid.pixel_size
    u = measured.displacement_on(grid)
    error = comparison.displacement - u
    there = mask & np.isfinite(u[..., 0])
    correlated, best = comparison.result, comparison.best
    refit = fit_displacement(u, grid, correlated.ansatz, correlated.unknowns, there)
    apart = (refit.displacement() - best.displacement())[mask] / px
    deviation = measured.standard_deviation_on(grid)
    inside = np.abs(error) < _NORMAL_95 * deviation
    labels = np.where(there, regions(mask, grid, specimen), -1)
    places = {name: labels == REGIONS.index(name) for name in REGIONS}
    rms = {name: _rms(error[place]) / px for name, place in places.items() if place.any()}
    ideal = correlated.ansatz.initial_guess(comparison.strain)[correlated.ansatz.phi_slice(0)]
    is_single = len(correlated.ansatz.modes) == 1 and ideal.size > 0
    summary = WholeFieldSummary(
        rms_px=_rms(error[there]) / px,
        rms_edges_px=rms.get(EDGES),
        rms_ligaments_px=rms.get(LIGAMENTS),
        rms_junctions_px=rms.get(JUNCTIONS),
        rms_bulk_px=rms.get(BULK),
        max_px=float(lengths(error[there]).max()) / px,
        coverage=float(there.sum() / mask.sum()),
        rms_refit_to_best_fit_px=_rms(apart),
        cutoff_px=measured.cutoff_px,
        unknowns=measured.unknowns,
        interval_coverage=float(inside[there].mean()),
        interval_coverage_edges=float(inside[places[EDGES]].mean()) if EDGES in rms else None,
        mode=(
            tuple(mode_equivalent(refit.mode_parameters(), specimen.pitch, ideal)[0])
            if is_single
            else ()
        ),
        library=measured.library,
        warnings=measured.warnings,
        seconds=seconds,
    )
    return WholeFieldComparison(measured, u, error, deviation, refit, summary)


def _rms(values: NDArray[Any]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
