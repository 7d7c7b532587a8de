"""``summary.json`` of a harvest: every number of its report, for programs to read.

A number that is not known, or infinite, is null. Standard deviations come in pairs: by the
photographs' noise, and by what the ansatz leaves over (noise included); lengths that follow the
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
    ``chi_square``, ``agreement`` and ``weighting`` (sentences), ``leftover_px`` (of what the
    ansatz can't describe, estimated from the images), ``condition_number``, ``undetermined``,
    ``errors_px`` (``noise`` and ``leftover``: rms standard deviation of ``v0``, ``fluctuation``
    and ``displacement`` over the part with holes), ``local`` (``source``, ``points``, ``lost``,
    ``w_rms_px``, ``sd_px``, ``w_beyond_noise_px``), ``modes``, ``pattern_reading`` and
    ``start`` (sentences), ``warnings``.
``frames[].modes``
    One for each mode: ``family``, ``held``, ``observable``, ``amplitude_px`` (rms of v phi),
    ``largest_px`` (its largest length), ``v_max_mm`` with ``v_max_sd_noise_mm`` and
    ``v_max_sd_leftover_mm`` (largest |v| over the part with holes), ``overlap`` (with v0, the
    largest cosine), ``parameters`` (``name``, ``unit``, ``value``, ``sd_noise``,
    ``sd_leftover``), ``waves`` (``xi``, the wave vector [1/l], with ``sd_noise`` and
    ``sd_leftover``; null where the mode was held).
``timeline``
    For each frame ``name``, ``strain``, ``amplitude_px``, ``leftover_px``, ``noise_px``,
    ``has_pattern``.
``buckling``
    ``before``, ``after``, ``estimate`` [-], ``sentence``.
``lattice``
    ``kind``, ``holes``, ``missing``, ``extra``, ``misfit_px``, ``pitch_px``, ``diameter_px``,
    ``vectors_px`` and ``origin_px`` (row, col), ``rotation_deg``, ``sentences``; null without.
``optics``
    ``max_px`` and ``rms_px`` of the distortion; where it was calibrated ``sd_rms_px``,
    ``degree``, ``trials`` (``degree``, ``unknowns``, ``residual_rms``, ``bic``, ``change_px``,
    ``sd_px``), ``shifts_px`` (row, col) and ``angles_rad`` of the target with ``shifts_sd_px``
    and ``angles_sd_rad``, ``noise_sd``, ``matches``, ``sentences``; null without.
``skipped``, ``sentences``
    Photographs not used (``name``, ``reason``); what was done and found, in words.
``truth``
    Rows ``quantity``, ``obtained``, ``expected``, ``unit``, ``ok``, where the truth is known.
``versions``
    With which software; what it took is in ``timings.json``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.error_bars import FieldErrors
from modeharvest.validation.harvest.modes import mode_numbers
from modeharvest.validation.harvest.run import Harvest, HarvestedFrame

FloatArray = NDArray[np.float64]


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
            {k: getattr(m, k) for k in ("name", "strain", "amplitude_px", "leftover_px",
                                        "noise_px", "has_pattern")}
            for m in harvest.timeline
        ],
        "buckling": None if buckling is None else {
            k: getattr(buckling, k) for k in ("before", "after", "estimate", "sentence")},
        "lattice": _lattice(harvest),
        "optics": _optics(harvest),
        "skipped": [{"name": name, "reason": reason} for name, reason in harvest.skipped],
        "sentences": harvest.sentences,
        "truth": [] if truth is None else [asdict(row) for row in truth.rows],
        "versions": harvest.versions,
    }  # fmt: skip
    plain: dict[str, Any] = _plain(summary)
    return plain


def _frame(harvest: Harvest, frame: HarvestedFrame) -> dict[str, Any]:
    result, seen = frame.result, frame.identifiability
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
        "residual_correlation": frame.agreement.correlation,
        "chi_square": frame.agreement.chi_square,
        "agreement": frame.agreement.sentence,
        "weighting": result.weighting.sentence,
        "leftover_px": seen.leftover_px,
        "condition_number": seen.condition_number,
        "undetermined": seen.undetermined,
        "errors_px": {
            "noise": _errors(harvest, frame, frame.by_noise),
            "leftover": _errors(harvest, frame, frame.by_leftover),
        },
        "local": _local(harvest, frame),
        "modes": [mode_numbers(harvest, frame, i) for i in frame.modes],
        "pattern_reading": () if frame.pattern is None else frame.pattern.sentences,
        "start": frame.start_sentences,
        "warnings": (*_warnings(frame), *frame.warnings),
    }  # fmt: skip


def _warnings(frame: HarvestedFrame) -> list[str]:
    """What identifiability warns of, but for modes that are held, as it advises."""
    seen, modes = frame.identifiability, frame.result.ansatz.modes
    said = dict(zip(seen.unobservable, seen.warnings, strict=False))  # those come first
    return [w for w in seen.warnings
            if not any(w == said[i] and not modes[i].family.size for i in said)]  # fmt: skip


def _errors(
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
        "sentences": lattice.sentences,
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
            "sentences": found.sentences,
        }
    return summary


def _share(level: float, full_scale: float | None) -> float | None:
    return level / full_scale if full_scale else None


def _plain(value: Any) -> Any:
    """Dictionaries, lists, strings, numbers; null for what is not a finite number."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
