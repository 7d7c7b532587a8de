"""Results from photographs of a test: their types, and their ``summary.json``.

The keys of ``summary.json``: docs/how-to/harvest.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.finite_element.result import WHOLE, WholeField
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.modes import PER_WAVE
from modeharvest.idic.photograph.geometry import Geometry
from modeharvest.idic.photograph.holes import HoleLattice
from modeharvest.idic.photograph.matching.holes import RigidMotion
from modeharvest.idic.photograph.plain.surface import away_from_cuts
from modeharvest.idic.photograph.speckled_edges import ByContours
from modeharvest.idic.result import Result
from modeharvest.idic.solver.noise import CameraNoise
from modeharvest.idic.solver.residual_test import ResidualTest
from modeharvest.idic.spectra.pattern import WavePattern
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.idic.uncertainty.covariance import FieldErrors, field_errors, propagated_sd
from modeharvest.idic.uncertainty.identifiability import Identifiability
from modeharvest.imaging.distortion.lens import Distortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.prepare import Optics, calibration_text
from modeharvest.runs.photographs.sequence import recorded_with
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.typed import picked, to_plain
from modeharvest.validation.onset import Buckling, ImageAmplitude
from modeharvest.validation.summary import Expectation
from modeharvest.validation.whole_field import WholeFieldSummary, whole_numbers


@dataclass(frozen=True, eq=False)
class PartSpectrum:
    """Spectrum of a part of the displacement, and the pattern determined from it."""

    name: str
    """Name of a region of the specimen that has separate modes; or "w"."""
    spectrum: Spectrum
    """Spectrum of the displacement in that region, or of w, without the affine part."""
    pattern: WavePattern


@dataclass(frozen=True, eq=False)
class HarvestedFrame:
    """The results of one deformed photograph."""

    name: str
    """Name of the photograph, unique in the test."""
    strain_x: float
    strain_y: float
    """Mean nominal compression of the cellular part [-]."""
    image: FloatImage
    mask: BoolArray | None
    """(rows, cols) the undistorted photograph [grey levels], and its mask, True on material; the
    mask is None if not known. May be memory-mapped."""
    result: Result
    identifiability: Identifiability
    residual_test: ResidualTest
    error_x: FloatArray
    error_y: FloatArray
    """(p,) and (q,) axes [mm] of the error bars."""
    by_noise: FieldErrors
    """Error bars on these axes by image noise, arrays (q, p, ...)."""
    by_model_error: FieldErrors | None = None
    """Error bars on these axes by model error; None if not available."""
    spectrum: Spectrum | None = None
    """Spectrum of the displacement without its affine part."""
    pattern: WavePattern | None = None
    """Wave pattern determined from the spectrum."""
    parts: tuple[PartSpectrum, ...] = ()
    """Spectra of parts, in the same order for all photographs."""
    w: LocalField | None = None
    """Microfluctuation w: local DIC's field, or the whole displacement, minus the ansatz."""
    whole: WholeField | None = None
    """The whole displacement, if it was measured."""
    contours: ByContours | None = None
    """The same ansatz measured by contours beside speckle, if requested."""
    rigid: RigidMotion | None = None
    """Rigid motion removed from the photograph before it was measured; None if the rotation was
    negligible."""
    start_text: tuple[str, ...] = ()
    """Description of the correlation's initial guess."""
    warnings: tuple[str, ...] = ()

    @property
    def by_contours(self) -> bool:
        """Whether contours were measured, and the ansatz fitted to the displacement from them."""
        return self.whole is not None and self.whole.measured.shown == "contours"

    @property
    def modes(self) -> range:
        """Indices of the modes, from 0."""
        return range(len(self.result.ansatz.modes))


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """The truth of one frame, in the reference frame."""

    displacement: NDArray[Any]
    """(rows, cols, 2) true displacement [mm], NaN off the material; may be memory-mapped."""
    best: Result
    """The best fit of the frame's ansatz to the true displacement."""
    whole: WholeFieldSummary | None = None
    """Errors of the whole displacement against the truth, if it was measured."""


@dataclass(frozen=True, eq=False)
class HarvestTruth:
    """The truth of photographs that were made by a simulation."""

    frames: Mapping[str, FrameTruth]
    """Truth of the photographs, by name; some may be missing."""
    distortion: Distortion | None = None
    rows: tuple[Expectation, ...] = ()
    """Measured values compared with the truth."""


@dataclass(frozen=True, eq=False)
class Harvest:
    """All data that the report of a harvest shows; None or empty fields are left out."""

    case: PhotographCase
    geometry: Geometry
    """The reference's material, holes and cellular part, on the pixels of the ideal images."""
    reference: FloatImage
    """(rows, cols) the undistorted photograph of the undeformed state [grey levels]."""
    frames: tuple[HarvestedFrame, ...]
    """Photographs in the order of the test; of many, only those of :func:`shown_moments`."""
    noise: CameraNoise
    numbers: Sequence[Mapping[str, Any]] = ()
    """``frames`` of the summary for all photographs; if empty, made from ``frames``."""
    skipped: tuple[tuple[str, str], ...] = ()
    """Names of photographs that were not used, and the reasons."""
    timeline: Sequence[ImageAmplitude] = ()
    """Amplitudes of all photographs, in the order of the test."""
    buckling: Buckling | None = None
    optics: Optics = field(default_factory=Optics)
    full_scale: float | None = None
    """Largest grey level of the camera; None if not known."""
    gauges: Sequence[Mapping[str, Any]] = ()
    """``gauges`` of the summary: reading of each gauge in every photograph."""
    warnings: tuple[str, ...] = ()
    """What makes errors larger, and what else the photographs show."""
    text: tuple[str, ...] = ()
    """Text on how the photographs were processed, and what was found in them."""
    truth: HarvestTruth | None = None
    command: str = "modeharvest harvest EXPERIMENT.toml"
    toml: str = ""
    """Command and TOML text that reproduce the report; if ``toml`` is empty, it shows the case."""
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def grid(self) -> PixelGrid:
        """The pixels of the ideal images."""
        return self.geometry.grid

    @property
    def mask(self) -> BoolArray:
        """(rows, cols) True on material of the reference."""
        return self.geometry.mask

    @property
    def pitch(self) -> float:
        """Unit cell size l [mm]."""
        return self.case.specimen.cell_size


def error_fields(
    result: Result, x: FloatArray, y: FloatArray
) -> tuple[FieldErrors, FieldErrors | None]:
    """Error bars of a result on axes [mm]: by noise, and by model error (None if unknown)."""
    assert result.errors is not None
    noise, model = field_errors(result, x, y, result.errors.by_noise), result.errors.by_model_error
    return noise, None if model is None else field_errors(result, x, y, model)


def in_view(result: Result, x: FloatArray, y: FloatArray) -> BoolArray:
    """(q, p) True where points on axes [mm] are in the deformed image, too."""
    u = result.ansatz.displacement(result.unknowns, x, y)
    row, col = result.grid.to_px(x + u[..., 0], y[:, None] + u[..., 1])
    rows, cols = result.grid.shape
    return np.asarray((row >= 0.0) & (row <= rows - 1.0) & (col >= 0.0) & (col <= cols - 1.0))


def amplitude_of(frame: HarvestedFrame, cellular: Box) -> ImageAmplitude:
    """A frame's point on the test's time line."""
    identified, noise = frame.identifiability, rms_errors(frame, frame.by_noise, cellular)
    return ImageAmplitude(
        name=frame.name,
        strain=frame.strain_x,
        amplitude_px=float(np.linalg.norm(identified.amplitude_px)),
        model_error_px=identified.model_error_px,
        noise_px=noise.get("fluctuation", 0.0),
    )


MOST_SHOWN = 6
"""Largest number of photographs shown as pictures; numbers are given for all."""


def shown_moments(moments: Sequence[ImageAmplitude]) -> tuple[int, ...]:
    """Indices of the photographs shown as pictures: around buckling, and evenly spaced."""
    count = len(moments)
    if count <= MOST_SHOWN:
        return tuple(range(count))
    has_pattern = [m.has_pattern for m in moments]
    first = has_pattern.index(True) if True in has_pattern else 0
    chosen = {max(0, first - 1), first, count - 1}
    for k in np.linspace(0, count - 1, MOST_SHOWN).round().astype(int):
        if len(chosen) < MOST_SHOWN:
            chosen.add(int(k))
    return tuple(sorted(chosen))


def rms_errors(frame: HarvestedFrame, errors: FieldErrors, box: Box) -> dict[str, float]:
    """Rms standard deviation per component over a box [px], by field; pattern only with modes."""
    inside = box.contains(frame.error_x, frame.error_y[:, None])
    px = frame.result.grid.pixel_size
    squares = {"v0": errors.v0**2, "displacement": errors.displacement**2}
    if frame.modes:
        squares["fluctuation"] = (errors.fluctuation**2).sum(axis=0)
    return {name: float(np.sqrt(np.mean(part[inside]))) / px for name, part in squares.items()}


_CELLS = 360
"""Number of points along the longer side at which fields' largest values are searched."""


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
    """Standard deviations of ``rows`` @ parameters of mode i; None if not available."""
    part = frame.result.ansatz.phi_slice(i)
    return {
        name: None if errors is None else propagated_sd(rows, errors.covariance[part, part])
        for name, errors in (("sd_noise", frame.by_noise), ("sd_model_error", frame.by_model_error))
    }


def _wave_vectors(harvest: Harvest, frame: HarvestedFrame, i: int) -> list[dict[str, Any]]:
    """Wave vectors xi [1/l] of mode i; its own are in units of 1 / (2 ``half_wavelength``)."""
    mode, found = frame.result.ansatz.modes[i], []
    to_xi = harvest.pitch / (2.0 * mode.half_wavelength)
    for w, wave in enumerate(mode.family.waves(frame.result.mode_parameters(i))):
        rows = to_xi * mode.family.matrix[PER_WAVE * w + 2 : PER_WAVE * w + 4]
        is_fixed = not rows.any()
        sd = {"sd_noise": None, "sd_model_error": None} if is_fixed else _deviations(frame, i, rows)
        found.append({"xi": to_xi * wave[2:4], **sd})
    return found


def _few_pixels(harvest: Harvest) -> tuple[FloatArray, FloatArray, BoolArray]:
    """x and y axes of a subset of pixels [mm], and the material mask on it."""
    grid, step = harvest.grid, max(1, round(max(harvest.grid.shape) / _CELLS))
    return grid.x[::step], grid.y[::step], harvest.mask[::step, ::step]


def _largest_values(harvest: Harvest, frame: HarvestedFrame, i: int) -> dict[str, Any]:
    """The largest |v| and the largest length of v phi on material of the mode's region."""
    (x, y, mask), box = _few_pixels(harvest), frame.result.ansatz.modes[i].taper.cellular
    inside = mask & box.contains(x, y[:, None]) & in_view(frame.result, x, y)
    ansatz, a = frame.result.ansatz, frame.result.unknowns
    v = np.where(inside, np.abs(ansatz.v(i, a, x, y)), 0.0)
    length = np.linalg.norm(ansatz.fluctuation(i, a, x, y), axis=-1)
    row, col = np.unravel_index(int(v.argmax()), v.shape)
    at = np.abs(frame.error_y - y[row]).argmin(), np.abs(frame.error_x - x[col]).argmin()
    by_model_error = frame.by_model_error
    return {
        "largest_px": float(length.max(initial=0.0, where=inside)) / harvest.grid.pixel_size,
        "v_max_mm": v[row, col],
        "v_max_sd_noise_mm": frame.by_noise.v[i][at],
        "v_max_sd_model_error_mm": None if by_model_error is None else by_model_error.v[i][at],
    }


_FITTED = "The ansatz is fitted to a displacement field; w is the difference from this fit."
_ALIKE = "All pixels of the material have the same weight in the fit."


def harvest_summary(harvest: Harvest) -> dict[str, Any]:
    """The content of ``summary.json``, plain JSON values."""
    summary = {
        "title": harvest.case.title or "Photographs of a test",
        "command": harvest.command,
        "experiment": harvest.case.plain(),
        "pixel_size_mm": harvest.grid.pixel_size,
        "cell_size_mm": harvest.pitch,
        "angle_deg": harvest.case.specimen.angle,
        "cellular_mm": astuple(harvest.geometry.region.cellular),
        "domain_mm": astuple(harvest.geometry.region.domain),
        "noise": {
            "sd": harvest.noise.sd,
            "of_full_scale": _share(harvest.noise.sd, harvest.full_scale),
            "source": harvest.noise.source,
        },
        "frames": harvest.numbers or [frame_numbers(harvest, frame) for frame in harvest.frames],
        "timeline": [
            picked(m, "name strain amplitude_px model_error_px noise_px has_pattern")
            for m in harvest.timeline
        ],
        "buckling": harvest.buckling,
        "lattice": _lattice(harvest.geometry.lattice) if harvest.geometry.lattice else None,
        "optics": harvest.optics.distortion and _optics(harvest, harvest.optics.distortion),
        "skipped": [{"name": name, "reason": reason} for name, reason in harvest.skipped],
        **picked(harvest, "gauges text warnings"),
        "truth": [] if harvest.truth is None else harvest.truth.rows,
        "versions": harvest.versions,
    }
    plain: dict[str, Any] = to_plain(summary)
    return plain


def frame_numbers(harvest: Harvest, frame: HarvestedFrame) -> dict[str, Any]:
    """Entry of ``summary.json`` for a photograph, also one that is not in ``harvest.frames``."""
    result, identified = frame.result, frame.identifiability
    residual = None if frame.by_contours else result.residual_rms
    moment = next((m for m in harvest.timeline if m.name == frame.name), None)
    return {
        **picked(frame, "name strain_x strain_y"),
        **recorded_with(harvest.case.sequence, frame.name),
        "strain": moment.strain if moment else max(frame.strain_x, frame.strain_y, key=abs),
        "has_pattern": moment and moment.has_pattern,
        "outcome": result.outcome.name.lower(),
        "outcome_why": result.outcome.explanation,
        "shown": "contours" if frame.by_contours else "speckle",
        **picked(result, "iterations pixels"),
        "iterations_all_levels": len(result.history),
        "residual_rms": residual,
        "residual_of_full_scale": _share(residual, harvest.full_scale),
        "residual_correlation": frame.residual_test.correlation,
        "chi_square": frame.residual_test.chi_square,
        "residual_test": _FITTED if frame.by_contours else frame.residual_test.text,
        "weighting": _ALIKE if frame.by_contours else result.weighting.text,
        **picked(identified, "model_error_px condition_number undetermined"),
        "errors_px": {
            "noise": rms_errors(frame, frame.by_noise, harvest.geometry.region.cellular),
            "model_error": frame.by_model_error
            and rms_errors(frame, frame.by_model_error, harvest.geometry.region.cellular),
        },
        "local": _local(harvest, frame),
        "whole_field": _whole(harvest, frame),
        "contours": _contours(harvest, frame),
        "modes": [mode_numbers(harvest, frame, i) for i in frame.modes],
        "pattern_reading": () if frame.pattern is None else frame.pattern.text,
        "rigid_motion": frame.rigid,
        "start": frame.start_text,
        "warnings": (*_frame_warnings(frame), *frame.warnings),
    }  # fmt: skip


def _frame_warnings(frame: HarvestedFrame) -> list[str]:
    """Warnings of identifiability, without those for fixed modes, whose fixing they advise."""
    identified, modes = frame.identifiability, frame.result.ansatz.modes
    first = zip(identified.unobservable, identified.warnings, strict=False)  # those come first
    expected = {warning for i, warning in first if not modes[i].family.size}
    return [warning for warning in identified.warnings if warning not in expected]


def _whole(harvest: Harvest, frame: HarvestedFrame) -> dict[str, Any] | None:
    if frame.whole is None:
        return None
    known = harvest.truth.frames.get(frame.name) if harvest.truth else None
    errors = asdict(known.whole) if known and known.whole else {}
    return {**errors, **asdict(whole_numbers(frame.whole, frame.result, harvest.mask))}


def _contours(harvest: Harvest, frame: HarvestedFrame) -> dict[str, Any] | None:
    """The modes' values by speckle and by contours, and their differences."""
    found = frame.contours
    if found is None:
        return None
    both = []
    for result in (found.speckle, found.result):
        noise, model = error_fields(result, frame.error_x, frame.error_y)
        both.append(replace(frame, result=result, by_noise=noise, by_model_error=model))
    mask = away_from_cuts(harvest.mask, harvest.grid, harvest.pitch)
    harvest, compared = replace(harvest, geometry=replace(harvest.geometry, mask=mask)), []
    for i in frame.modes:
        rows = (_values(mode_numbers(harvest, one, i)) for one in both)
        for (what, unit, speckle, sd), (_, _, value, own_sd) in zip(*rows, strict=True):
            compared.append(
                {"mode": i + 1, "what": what, "unit": unit, "speckle": speckle, "speckle_sd": sd,
                 "contours": value, "contours_sd": own_sd,
                 "difference_sd": (value - speckle) / float(np.hypot(sd, own_sd))}
            )  # fmt: skip
    return {
        "edge_sd_px": found.edge_sd_px,
        "pattern_ratio": _pattern_ratio(harvest, *(one.result for one in reversed(both))),
        "compared": compared,
        "warnings": found.result.errors.warnings if found.result.errors else (),
    }


def _values(mode: Mapping[str, Any]) -> Iterator[tuple[str, str, float, float]]:
    """Name, unit, value and standard deviation of each quantity that describes a mode."""
    sd = mode["v_max_sd_model_error_mm"]
    yield "largest v", "mm", mode["v_max_mm"], mode["v_max_sd_noise_mm"] if sd is None else sd
    for p in mode["parameters"]:
        sd = p["sd_noise"] if p["sd_model_error"] is None else p["sd_model_error"]
        yield p["name"], p["unit"], p["value"], sd
    for k, wave in enumerate(mode["waves"], start=1):
        known = wave["sd_noise"] if wave["sd_model_error"] is None else wave["sd_model_error"]
        for axis, xi, sd in zip("xy", wave["xi"], () if known is None else known, strict=False):
            yield f"wave vector {k}, {axis}", "1/l", xi, sd


def _pattern_ratio(harvest: Harvest, result: Result, other: Result) -> float | None:
    """Ratio of one result's pattern to another's, by least squares over the material."""
    (x, y, mask), modes = _few_pixels(harvest), range(len(result.ansatz.modes))
    a, b = (sum(r.ansatz.fluctuation(i, r.unknowns, x, y)[mask] for i in modes)
            for r in (result, other))  # fmt: skip
    square = float(np.sum(b * b))
    return float(np.sum(a * b)) / square if square > 0.0 else None


def _local(harvest: Harvest, frame: HarvestedFrame) -> dict[str, Any] | None:
    w, px = frame.w, harvest.grid.pixel_size
    if w is None:
        return None
    return {
        "source": WHOLE if frame.whole else w.source,
        "points": w.x.size,
        "lost": w.lost,
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


def _share(level: float | None, full_scale: float | None) -> float | None:
    return level / full_scale if full_scale and level is not None else None
