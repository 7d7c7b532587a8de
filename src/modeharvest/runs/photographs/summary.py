"""``summary.json`` of measured photographs: every number of the report, for programs to read.

A number that is not known, or infinite, is null. Standard deviations come in pairs: by the
photographs' noise, and by model error (noise included); lengths that follow the
images are in px, positions and fields in mm. rms is per component.

``title``, ``experiment``
    What was harvested, the experiment's every value.
``pixel_size_mm``, ``cell_size_mm``, ``cellular_mm``, ``domain_mm``
    Scale; the boxes [x_min, x_max, y_min, y_max] of the part with holes and of the material.
``noise``
    ``sd`` [grey levels], ``of_full_scale`` [-], ``source``.
``frames``
    In the order of the test: ``name``, ``strain_x``, ``strain_y``, ``strain`` (that of the time
    line) [-, compression positive], ``has_pattern``, ``outcome``, ``outcome_why``,
    ``iterations`` (on the full image), ``iterations_all_levels``, ``pixels``,
    ``residual_rms`` [grey levels], ``residual_of_full_scale``, ``residual_correlation``,
    ``chi_square``, ``residual_test`` and ``weighting`` (text), ``model_error_px`` (of what the
    ansatz can't describe, estimated from the images), ``condition_number``, ``undetermined``,
    ``errors_px`` (``noise`` and ``model_error``: rms standard deviation of ``v0``, ``fluctuation``
    and ``displacement`` over the part with holes), ``local`` (``source``, ``points``, ``lost``,
    ``w_rms_px``, ``sd_px``, ``w_beyond_noise_px``), ``modes``, ``pattern_reading`` and
    ``start`` (text), ``warnings``.
``frames[].modes``
    One for each mode: ``family``, ``fixed``, ``observable``, ``amplitude_px`` (rms of v phi),
    ``largest_px`` (its largest length), ``v_max_mm`` with ``v_max_sd_noise_mm`` and
    ``v_max_sd_model_error_mm`` (largest |v| over the part with holes), ``overlap`` (with v0, the
    largest cosine), ``parameters`` (``name``, ``unit``, ``value``, ``sd_noise``,
    ``sd_model_error``), ``waves`` (``xi``, the wave vector [1/l], with ``sd_noise`` and
    ``sd_model_error``; null where the mode was fixed).
``timeline``
    For each frame ``name``, ``strain``, ``amplitude_px``, ``model_error_px``, ``noise_px``,
    ``has_pattern``.
``buckling``
    ``before``, ``after``, ``estimate`` [-], ``text``.
``lattice``
    ``kind``, ``holes``, ``missing``, ``extra``, ``misfit_px``, ``pitch_px``, ``diameter_px``,
    ``vectors_px`` and ``origin_px`` (row, col), ``rotation_deg``, ``text``; null without.
``optics``
    ``max_px`` and ``rms_px`` of the distortion; where it was calibrated ``sd_rms_px``,
    ``degree``, ``trials`` (``degree``, ``unknowns``, ``residual_rms``, ``bic``, ``change_px``,
    ``sd_px``), ``shifts_px`` (row, col) and ``angles_rad`` of the target with ``shifts_sd_px``
    and ``angles_sd_rad``, ``noise_sd``, ``matches``, ``text``; null without.
``skipped``, ``text``
    Photographs not used (``name``, ``reason``); what was done and found, in words.
``truth``
    Rows ``quantity``, ``obtained``, ``expected``, ``unit``, ``ok``, where the truth is known.
``versions``
    With which software; what it took is in ``timings.json``.
"""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

import numpy as np

from modeharvest.idic.modes import PER_WAVE
from modeharvest.idic.uncertainty.covariance import FieldErrors, propagated_sd
from modeharvest.runs.photographs.prepare import calibration_text
from modeharvest.runs.photographs.results import Harvest, HarvestedFrame
from modeharvest.util.arrays import FloatArray
from modeharvest.util.typed import to_plain

_CELLS = 360
"""Along the images' longer side, at which fields are evaluated for their largest values."""


def mode_numbers(harvest: Harvest, frame: HarvestedFrame, i: int) -> dict[str, Any]:
    """Describe mode i (from 0) of a frame; keys as in ``summary.json``."""
    result, identified = frame.result, frame.identifiability
    family, part = result.ansatz.modes[i].family, result.ansatz.phi_slice(i)
    noise = frame.noise_covariance[part, part]
    left = (
        None if frame.model_error_covariance is None else frame.model_error_covariance[part, part]
    )
    sd_noise, sd_left = _sd(np.eye(family.size), noise), _sd(np.eye(family.size), left)
    return {
        "family": family.name,
        "fixed": family.size == 0,
        "observable": i not in identified.unobservable,
        "amplitude_px": identified.amplitude_px[i],
        **_largest_values(harvest, frame, i),
        "overlap": identified.overlap[i],
        "parameters": [
            {"name": name, "unit": unit, "value": value, "sd_noise": _item(sd_noise, k),
             "sd_model_error": _item(sd_left, k)}
            for k, (name, unit, value) in enumerate(
                zip(family.names, family.units, result.mode_parameters(i), strict=True))
        ],
        "waves": _wave_vectors(harvest, frame, i, noise, left),
    }  # fmt: skip


def _wave_vectors(
    harvest: Harvest, frame: HarvestedFrame, i: int, noise: FloatArray, left: FloatArray | None
) -> list[dict[str, Any]]:
    """Wave vectors [1/l]: k is in units of half a wavelength's inverse, like the mode's length."""
    mode = frame.result.ansatz.modes[i]
    to_xi = harvest.pitch / (2.0 * mode.half_wavelength)
    waves = mode.family.waves(frame.result.mode_parameters(i))
    found = []
    for w, wave in enumerate(waves):
        rows = to_xi * mode.family.matrix[PER_WAVE * w + 2 : PER_WAVE * w + 4]
        fixed = not rows.any()
        found.append({
            "xi": to_xi * wave[2:4],
            "sd_noise": None if fixed else _sd(rows, noise),
            "sd_model_error": None if fixed else _sd(rows, left),
        })  # fmt: skip
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
    at = (
        int(np.abs(frame.error_y - y[row]).argmin()),
        int(np.abs(frame.error_x - x[col]).argmin()),
    )
    by_model_error = frame.by_model_error
    return {
        "largest_px": float(length.max(initial=0.0, where=inside)) / grid.pixel_size,
        "v_max_mm": v[row, col],
        "v_max_sd_noise_mm": frame.by_noise.v[i][at],
        "v_max_sd_model_error_mm": None if by_model_error is None else by_model_error.v[i][at],
    }


def _sd(rows: FloatArray, covariance: FloatArray | None) -> FloatArray | None:
    """(k,) standard deviations of rows (k, m) times unknowns; infinite where one of them is."""
    return None if covariance is None else propagated_sd(rows, covariance)


def _item(values: FloatArray | None, k: int) -> float | None:
    return None if values is None else float(values[k])


def harvest_summary(harvest: Harvest) -> dict[str, Any]:
    """Make the content of ``summary.json``, plain JSON values; keys as documented above."""
    truth, buckling = harvest.truth, harvest.buckling
    summary = {
        "title": harvest.title,
        "experiment": harvest.experiment,
        "pixel_size_mm": harvest.grid.pixel_size,
        "cell_size_mm": harvest.pitch,
        "cellular_mm": astuple(harvest.cellular),
        "domain_mm": astuple(harvest.domain),
        "noise": {
            "sd": harvest.noise_sd,
            "of_full_scale": _share(harvest.noise_sd, harvest.full_scale),
            "source": harvest.noise_source,
        },
        "frames": [_frame(harvest, frame) for frame in harvest.frames],
        "timeline": [
            {k: getattr(m, k) for k in ("name", "strain", "amplitude_px", "model_error_px",
                                        "noise_px", "has_pattern")}
            for m in harvest.timeline
        ],
        "buckling": None if buckling is None else {
            "before": buckling.before, "after": buckling.after, "estimate": buckling.estimate,
            "text": buckling.text},
        "lattice": _lattice(harvest),
        "optics": _optics(harvest),
        "skipped": [{"name": name, "reason": reason} for name, reason in harvest.skipped],
        "text": harvest.text,
        "truth": [] if truth is None else truth.rows,
        "versions": harvest.versions,
    }  # fmt: skip
    plain: dict[str, Any] = to_plain(summary)
    return plain


def _frame(harvest: Harvest, frame: HarvestedFrame) -> dict[str, Any]:
    result, identified = frame.result, frame.identifiability
    moment = next((m for m in harvest.timeline if m.name == frame.name), None)
    return {
        "name": frame.name,
        "strain_x": frame.strain_x,
        "strain_y": frame.strain_y,
        "strain": max(frame.strain_x, frame.strain_y, key=abs) if moment is None
        else moment.strain,
        "has_pattern": None if moment is None else moment.has_pattern,
        "outcome": result.outcome.name.lower(),
        "outcome_why": result.outcome.explanation,
        "iterations": result.iterations,
        "iterations_all_levels": len(result.history),
        "pixels": result.pixels,
        "residual_rms": result.residual_rms,
        "residual_of_full_scale": _share(result.residual_rms, harvest.full_scale),
        "residual_correlation": frame.residual_test.correlation,
        "chi_square": frame.residual_test.chi_square,
        "residual_test": frame.residual_test.sentence,
        "weighting": result.weighting.sentence,
        "model_error_px": identified.model_error_px,
        "condition_number": identified.condition_number,
        "undetermined": identified.undetermined,
        "errors_px": {
            "noise": _rms_errors(harvest, frame, frame.by_noise),
            "model_error": _rms_errors(harvest, frame, frame.by_model_error),
        },
        "local": _local(harvest, frame),
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


def _rms_errors(
    harvest: Harvest, frame: HarvestedFrame, errors: FieldErrors | None
) -> dict[str, float] | None:
    """Rms standard deviations per component among the holes [px]."""
    if errors is None:
        return None
    box = harvest.cellular
    rows = (box.y_min <= frame.error_y) & (frame.error_y <= box.y_max)
    cols = (box.x_min <= frame.error_x) & (frame.error_x <= box.x_max)
    if not (rows.any() and cols.any()):
        return None
    fields = {"v0": errors.v0, "displacement": errors.displacement}
    if frame.modes:
        fields["fluctuation"] = np.sqrt((errors.fluctuation**2).sum(axis=0))
    px = harvest.grid.pixel_size
    return {
        name: float(np.sqrt(np.mean(field[np.ix_(rows, cols)] ** 2))) / px
        for name, field in fields.items()
    }


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


def _lattice(harvest: Harvest) -> dict[str, Any] | None:
    lattice = harvest.lattice
    if lattice is None:
        return None
    return {
        "kind": lattice.kind,
        "holes": len(lattice),
        "missing": len(lattice.missing),
        "extra": len(lattice.extra),
        "misfit_px": lattice.misfit_px,
        "pitch_px": lattice.pitch_px,
        "diameter_px": lattice.diameters.mean(),
        "vectors_px": lattice.vectors,
        "origin_px": lattice.origin,
        "rotation_deg": lattice.rotation_deg,
        "text": lattice.text,
    }


def _optics(harvest: Harvest) -> dict[str, Any] | None:
    found = harvest.calibration
    distortion = harvest.lens
    if distortion is None:
        return None
    rows, cols = (np.linspace(0.0, size - 1.0, 25) for size in harvest.grid.shape)
    at = rows[:, None], cols[None, :]
    length = np.hypot(*distortion.shift(*at))
    summary = {"max_px": length.max(), "rms_px": np.sqrt(np.mean(length**2) / 2.0)}
    if found is not None:
        summary |= {
            "sd_rms_px": np.sqrt(np.mean(np.square(found.sd(*at)))),
            "degree": found.distortion.degree,
            "trials": found.trials,
            "shifts_px": found.shifts,
            "shifts_sd_px": found.shifts_sd,
            "angles_rad": found.angles,
            "angles_sd_rad": found.angles_sd,
            "noise_sd": found.noise_sd,
            "matches": found.matches,
            "text": calibration_text(found),
        }
    return summary


def _share(level: float, full_scale: float | None) -> float | None:
    return level / full_scale if full_scale else None
