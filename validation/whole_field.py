"""The finite-element displacement: comparison with a correlation, errors against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.finite_element.result import WholeField
from modeharvest.idic.result import Result
from modeharvest.idic.spectra.pattern import REFERENCE_MODE, mode_equivalent
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.typed import picked, quantity
from modeharvest.validation.scoring.score import BULK, EDGES, JUNCTIONS, LIGAMENTS, REGIONS, regions
from modeharvest.validation.truth import lengths, rms

_NORMAL_95 = 1.959964


@dataclass(frozen=True, kw_only=True)
class WholeFieldSummary:
    """Errors of the whole displacement, rms per component over the material's pixels.

    Regions: see :mod:`modeharvest.validation.scoring.score`. Two runs differ only in ``seconds``.
    """

    rms_px: float = quantity("whole displacement: truth − measured, rms", "px")
    rms_edges_px: float | None = quantity("… within 10 px of an edge", "px")
    rms_ligaments_px: float | None = quantity("… of ligaments", "px")
    rms_junctions_px: float | None = quantity("… of junctions", "px")
    rms_bulk_px: float | None = quantity("… of the bulk", "px")
    max_px: float = quantity("… largest length", "px")
    coverage: float = quantity("… share of the material measured", "–")
    rms_refit_to_best_fit_px: float = quantity("… refitted ansatz − best fit, rms", "px")
    cutoff_px: float | None = quantity("… cut-off wavelength of the regularisation", "px")
    unknowns: int = quantity("… unknowns", "–")
    interval_coverage: float = quantity("… truth within 95 % intervals", "–")
    """Fraction of the displacement components of all pixels."""
    interval_coverage_edges: float | None = quantity("… the same within 10 px of an edge", "–")
    contradicted: float | None = quantity("… nodes of free edges against the law", "–")
    """Fraction of nodes where a material law changes u by over 3 sd; None without a law."""
    mode: tuple[float, ...]
    """Parameters of a single mode in the ansatz refitted to the whole displacement."""
    library: str
    """Library that factorised the matrices."""
    warnings: tuple[str, ...]
    seconds: float | None = None
    """Time of the run's stage that measures all images, on this machine [s]."""


@dataclass(frozen=True, kw_only=True)
class ModeBothWays:
    """A mode from the correlation, and from the ansatz refitted to the whole displacement."""

    v_max_mm: float
    correlated_v_max_mm: float
    """Largest |v| over the part of the specimen where the mode is defined [mm]."""
    parameters: tuple[dict[str, Any], ...]
    """For each parameter: ``name``, ``unit``, ``refitted`` value with its ``deviation`` (None if
    not determined), and ``correlated`` value."""


@dataclass(frozen=True, kw_only=True)
class WholeFieldNumbers:
    """Numbers of a whole displacement without known truth; rms per component."""

    w_rms_px: float = quantity("w = measured − IDIC, rms", "px")
    w_max_px: float = quantity("… largest length", "px")
    rms_beyond_refit_px: float = quantity("measured − refitted ansatz, rms", "px")
    rms_refit_to_idic_px: float = quantity("refitted ansatz − IDIC, rms", "px")
    sd_px: float = quantity("standard deviation of the measured displacement, rms", "px")
    coverage: float = quantity("share of the material measured", "–")
    cutoff_px: float | None = quantity("cut-off wavelength of the regularisation", "px")
    unknowns: int = quantity("unknowns", "–")
    residual_rms: float = quantity("residual, rms", "levels; contours: px")
    noise_power: float = quantity("noise at long waves: power over variance, 1 if white", "–")
    modes: tuple[ModeBothWays, ...]
    library: str
    """Library that factorised the matrices."""
    start: str
    """Initial guess of the measurement, as text."""
    warnings: tuple[str, ...]


def whole_numbers(whole: WholeField, correlated: Result, mask: BoolArray) -> WholeFieldNumbers:
    """Numbers of a whole displacement on a mask's pixels, compared with a correlation's result."""
    measured, refit, px = whole.measured, whole.refit, correlated.grid.pixel_size
    u = measured.displacement_on(correlated.grid)
    there = mask & np.isfinite(u[..., 0])
    by_idic, by_refit = (fit.displacement()[there] for fit in (correlated, refit))
    w = u[there] - by_idic
    return WholeFieldNumbers(
        w_rms_px=rms(w) / px, w_max_px=float(lengths(w).max()) / px, start=whole.start,
        rms_beyond_refit_px=rms(u[there] - by_refit) / px,
        rms_refit_to_idic_px=rms(by_refit - by_idic) / px,
        sd_px=rms(measured.standard_deviation) / px, coverage=measured.coverage(there, mask),
        modes=tuple(_both_ways(refit, correlated, i) for i in range(len(refit.ansatz.modes))),
        **picked(measured, "cutoff_px unknowns residual_rms noise_power library warnings"),
    )  # fmt: skip


def _both_ways(refit: Result, correlated: Result, i: int) -> ModeBothWays:
    mode = refit.ansatz.modes[i]
    sd = refit.standard_errors()[refit.ansatz.phi_slice(i)]
    deviation: list[float | None] = [float(v) if np.isfinite(v) else None for v in sd]
    each = zip(mode.family.names, mode.family.units, refit.mode_parameters(i), deviation,
               correlated.mode_parameters(i), strict=True)  # fmt: skip
    keys = ("name", "unit", "refitted", "deviation", "correlated")
    return ModeBothWays(
        v_max_mm=float(np.abs(_amplitude(refit, i)).max()),
        correlated_v_max_mm=float(np.abs(_amplitude(correlated, i)).max()),
        parameters=tuple(dict(zip(keys, values, strict=True)) for values in each),
    )


def _amplitude(fit: Result, i: int) -> FloatArray:
    """v of mode i over the part of the specimen where the mode is defined [mm]."""
    box = fit.ansatz.modes[i].taper.cellular
    x, y = np.linspace(box.x_min, box.x_max, 200), np.linspace(box.y_min, box.y_max, 200)
    return fit.ansatz.v(i, fit.unknowns, x, y)


def v_percent(fit: Result, best: Result, i: int = 0) -> float:
    """Largest difference of mode i's v from the best fit's [% of the latter's maximum]."""
    v, at_best = _amplitude(fit, i), _amplitude(best, i)
    return 100.0 * float(np.abs(v - at_best).max() / np.abs(at_best).max())


def waves_percent(fit: Result, best: Result, i: int = 0) -> float:
    """Largest difference of mode i's wave vectors from the best fit's [% of their length]."""
    family = best.ansatz.modes[i].family
    found, at_best = (family.waves(f.mode_parameters(i))[:, 2:4] for f in (fit, best))
    return 100.0 * float((lengths(found - at_best) / lengths(at_best)).max())


def compare_whole(
    whole: WholeField, true: FloatArray, best: Result, mask: BoolArray, specimen: Specimen
) -> WholeFieldSummary:
    """Compare a whole displacement with the truth.

    true : (rows, cols, 2) true displacement [mm].
    best : the best fit, to the truth, of the ansatz refitted to the measurement.
    mask : (rows, cols) True on material of the undeformed specimen.
    """
    measured, refit, grid, px = whole.measured, whole.refit, best.grid, best.grid.pixel_size
    error = true - measured.displacement_on(grid)
    there = mask & np.isfinite(error[..., 0])
    inside = np.abs(error) < _NORMAL_95 * measured.standard_deviation_on(grid)
    labels = np.where(there, regions(mask, grid, specimen), -1)
    places = {name: labels == REGIONS.index(name) for name in REGIONS}
    by_region = {name: rms(error[place]) / px for name, place in places.items() if place.any()}
    return WholeFieldSummary(
        rms_px=rms(error[there]) / px, rms_edges_px=by_region.get(EDGES),
        rms_ligaments_px=by_region.get(LIGAMENTS), rms_junctions_px=by_region.get(JUNCTIONS),
        rms_bulk_px=by_region.get(BULK), max_px=float(lengths(error[there]).max()) / px,
        coverage=measured.coverage(there, mask),
        rms_refit_to_best_fit_px=rms((refit.displacement() - best.displacement())[mask]) / px,
        interval_coverage=float(inside[there].mean()),
        interval_coverage_edges=float(inside[places[EDGES]].mean()) if EDGES in by_region else None,
        mode=_square_mode(refit, specimen.pitch),
        **picked(measured, "cutoff_px unknowns contradicted library warnings"),
    )  # fmt: skip


def _square_mode(refit: Result, pitch: float) -> tuple[float, ...]:
    """Equivalent parameters of the paper's mode nearest to the ideal; empty for other ansatzes."""
    families = [mode.family for mode in refit.ansatz.modes]
    if [family.size for family in families] != [len(REFERENCE_MODE)]:
        return ()
    return tuple(mode_equivalent(refit.mode_parameters(), pitch, families[0].start)[0])
