"""``summary.json`` of measured photographs: every number of the report, for programs to read.

Its keys: docs/harvest.md.
"""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

import numpy as np

from modeharvest.idic.modes import PER_WAVE
from modeharvest.idic.photograph.holes import HoleLattice
from modeharvest.idic.uncertainty.covariance import propagated_sd
from modeharvest.imaging.distortion.lens import Distortion
from modeharvest.runs.photographs.prepare import calibration_text
from modeharvest.runs.photographs.results import Harvest, HarvestedFrame, rms_errors
from modeharvest.runs.photographs.whole_field import whole_summary
from modeharvest.util.arrays import FloatArray
from modeharvest.util.typed import picked, to_plain

_CELLS = 360
"""Along the images' longer side, at which fields are evaluated for their largest values."""


def mode_numbers(harvest: Harvest, frame: HarvestedFrame, i: int) -> dict[str, Any]:
    """Describe mode i (from 0) of a frame; keys as in ``summary.json``."""
    family, identified = frame.result.ansatz.modes[i].family, frame.identifiability
    parameters: dict[str, Any] = {
        "name": family.names,
        "unit": family.units,
        "value": frame.result.mode_parameters(i),
        **_deviations(frame, i, np.eye(family.size)),
    }
    return {
        "family": family.name,
        "fixed": family.size == 0,
        "observable": i not in identified.unobservable,
        "amplitude_px": identified.amplitude_px[i],
        **_largest_values(harvest, frame, i),
        "overlap": identified.overlap[i],
        "parameters": [
            {key: None if column is None else column[k] for key, column in parameters.items()}
            for k in range(family.size)
        ],
        "waves": _wave_vectors(harvest, frame, i),
    }


def _deviations(frame: HarvestedFrame, i: int, rows: FloatArray) -> dict[str, FloatArray | None]:
    """Standard deviations of ``rows`` @ parameters of mode i; None where they can't be had."""
    part = frame.result.ansatz.phi_slice(i)
    return {
        name: None if errors is None else propagated_sd(rows, errors.covariance[part, part])
        for name, errors in (("sd_noise", frame.by_noise), ("sd_model_error", frame.by_model_error))
    }


def _wave_vectors(harvest: Harvest, frame: HarvestedFrame, i: int) -> list[dict[str, Any]]:
    """Wave vectors [1/l]: k is in units of half a wavelength's inverse, like the mode's length."""
    mode, found = frame.result.ansatz.modes[i], []
    to_xi = harvest.pitch / (2.0 * mode.half_wavelength)
    for w, wave in enumerate(mode.family.waves(frame.result.mode_parameters(i))):
        rows = to_xi * mode.family.matrix[PER_WAVE * w + 2 : PER_WAVE * w + 4]
        is_fixed = not rows.any()
        sd = {"sd_noise": None, "sd_model_error": None} if is_fixed else _deviations(frame, i, rows)
        found.append({"xi": to_xi * wave[2:4], **sd})
    return found


def _largest_values(harvest: Harvest, frame: HarvestedFrame, i: int) -> dict[str, Any]:
    """The largest |v| and the largest length of v phi on the material of the mode's own part."""
    grid, box = harvest.grid, frame.result.ansatz.modes[i].taper.cellular
    step = max(1, round(max(grid.shape) / _CELLS))
    x, y, mask = grid.x[::step], grid.y[::step], harvest.mask[::step, ::step]
    inside = mask & ((box.y_min <= y) & (y <= box.y_max))[:, None]
    inside &= ((box.x_min <= x) & (x <= box.x_max))[None, :]
    ansatz, a = frame.result.ansatz, frame.result.unknowns
    v = np.where(inside, np.abs(ansatz.v(i, a, x, y)), 0.0)
    length = np.linalg.norm(ansatz.fluctuation(i, a, x, y), axis=-1)
    row, col = np.unravel_index(int(v.argmax()), v.shape)
    at = np.abs(frame.error_y - y[row]).argmin(), np.abs(frame.error_x - x[col]).argmin()
    by_model_error = frame.by_model_error
    return {
        "largest_px": float(length.max(initial=0.0, where=inside)) / grid.pixel_size,
        "v_max_mm": v[row, col],
        "v_max_sd_noise_mm": frame.by_noise.v[i][at],
        "v_max_sd_model_error_mm": None if by_model_error is None else by_model_error.v[i][at],
    }


def harvest_summary(harvest: Harvest) -> dict[str, Any]:
    """The content of ``summary.json``, plain JSON values."""
    summary = {
        "title": harvest.case.title or "Photographs of a test",
        "experiment": harvest.case.plain(),
        "pixel_size_mm": harvest.grid.pixel_size,
        "cell_size_mm": harvest.pitch,
        "cellular_mm": astuple(harvest.geometry.region.cellular),
        "domain_mm": astuple(harvest.geometry.region.domain),
        "noise": {
            "sd": harvest.noise.sd,
            "of_full_scale": _share(harvest.noise.sd, harvest.full_scale),
            "source": harvest.noise.source,
        },
        "frames": [_frame(harvest, frame) for frame in harvest.frames],
        "timeline": [
            picked(m, "name strain amplitude_px model_error_px noise_px has_pattern")
            for m in harvest.timeline
        ],
        "buckling": harvest.buckling,
        "lattice": _lattice(harvest.geometry.lattice) if harvest.geometry.lattice else None,
        "optics": harvest.optics.distortion and _optics(harvest, harvest.optics.distortion),
        "skipped": [{"name": name, "reason": reason} for name, reason in harvest.skipped],
        "text": harvest.text,
        "truth": [] if harvest.truth is None else harvest.truth.rows,
        "versions": harvest.versions,
    }
    plain: dict[str, Any] = to_plain(summary)
    return plain


def _frame(harvest: Harvest, frame: HarvestedFrame) -> dict[str, Any]:
    result, identified = frame.result, frame.identifiability
    moment = next((m for m in harvest.timeline if m.name == frame.name), None)
    return {
        **picked(frame, "name strain_x strain_y"),
        "strain": moment.strain if moment else max(frame.strain_x, frame.strain_y, key=abs),
        "has_pattern": moment and moment.has_pattern,
        "outcome": result.outcome.name.lower(),
        "outcome_why": result.outcome.explanation,
        **picked(result, "iterations pixels residual_rms"),
        "iterations_all_levels": len(result.history),
        "residual_of_full_scale": _share(result.residual_rms, harvest.full_scale),
        "residual_correlation": frame.residual_test.correlation,
        "chi_square": frame.residual_test.chi_square,
        "residual_test": frame.residual_test.text,
        "weighting": result.weighting.text,
        **picked(identified, "model_error_px condition_number undetermined"),
        "errors_px": {
            "noise": rms_errors(frame, frame.by_noise, harvest.geometry.region.cellular),
            "model_error": frame.by_model_error
            and rms_errors(frame, frame.by_model_error, harvest.geometry.region.cellular),
        },
        "local": _local(harvest, frame),
        "whole_field": whole_summary(harvest, frame),
        "modes": [mode_numbers(harvest, frame, i) for i in frame.modes],
        "pattern_reading": () if frame.pattern is None else frame.pattern.text,
        "start": frame.start_text,
        "warnings": (*_frame_warnings(frame), *frame.warnings),
    }  # fmt: skip


def _frame_warnings(frame: HarvestedFrame) -> list[str]:
    """What identifiability warns of, but for modes that are fixed, as it advises."""
    identified, modes = frame.identifiability, frame.result.ansatz.modes
    first = zip(identified.unobservable, identified.warnings, strict=False)  # those come first
    expected = {warning for i, warning in first if not modes[i].family.size}
    return [warning for warning in identified.warnings if warning not in expected]


def _local(harvest: Harvest, frame: HarvestedFrame) -> dict[str, Any] | None:
    local, result, px = frame.local, frame.result, harvest.grid.pixel_size
    if local is None:
        return None
    w = local.less(lambda points: result.ansatz.displacement_at(result.unknowns, points))
    return {
        "source": local.source,
        "points": local.x.size,
        "lost": local.lost,
        "w_rms_px": w.rms / px,
        "sd_px": w.sd_rms / px,
        "w_beyond_noise_px": w.rms_beyond_noise / px,
    }


def _lattice(lattice: HoleLattice) -> dict[str, Any]:
    return {
        **picked(lattice, "kind misfit_px pitch_px rotation_deg text"),
        "holes": len(lattice),
        "missing": len(lattice.missing),
        "extra": len(lattice.extra),
        "diameter_px": lattice.diameters.mean(),
        "vectors_px": lattice.vectors,
        "origin_px": lattice.origin,
    }


def _optics(harvest: Harvest, lens: Distortion) -> dict[str, Any]:
    rows, cols = (np.linspace(0.0, size - 1.0, 25) for size in harvest.grid.shape)
    at = rows[:, None], cols[None, :]
    length, found = np.hypot(*lens.shift(*at)), harvest.optics.calibration
    summary = {"max_px": length.max(), "rms_px": np.sqrt(np.mean(length**2) / 2.0)}
    if found is not None:
        summary |= {
            **picked(found, "trials noise_sd matches"),
            "sd_rms_px": np.sqrt(np.mean(np.square(found.sd(*at)))),
            "degree": found.distortion.degree,
            "shifts_px": found.shifts,
            "shifts_sd_px": found.shifts_sd,
            "angles_rad": found.angles,
            "angles_sd_rad": found.angles_sd,
            "text": calibration_text(found),
        }
    return summary


def _share(level: float, full_scale: float | None) -> float | None:
    return level / full_scale if full_scale else None
