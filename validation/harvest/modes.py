"""The numbers of an identified mode: parameters, wave vectors and amplitude, with error bars."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.fourier import PER_WAVE
from modeharvest.validation.harvest.run import Harvest, HarvestedFrame

FloatArray = NDArray[np.float64]

_CELLS = 360
"""Along the images' longer side, at which fields are evaluated for their largest values."""


def mode_numbers(harvest: Harvest, frame: HarvestedFrame, i: int) -> dict[str, Any]:
    """Describe mode i (from 0) of a frame; keys as in ``summary.json``."""
    result, seen = frame.result, frame.identifiability
    family, part = result.ansatz.modes[i].family, result.ansatz.phi_slice(i)
    noise = frame.noise_covariance[part, part]
    left = None if frame.leftover_covariance is None else frame.leftover_covariance[part, part]
    sd_noise, sd_left = _sd(np.eye(family.size), noise), _sd(np.eye(family.size), left)
    return {
        "family": family.name,
        "held": family.size == 0,
        "observable": i not in seen.unobservable,
        "amplitude_px": seen.amplitude_px[i],
        **_largest(harvest, frame, i),
        "overlap": seen.overlap[i],
        "parameters": [
            {"name": name, "unit": unit, "value": value, "sd_noise": _item(sd_noise, k),
             "sd_leftover": _item(sd_left, k)}
            for k, (name, unit, value) in enumerate(
                zip(family.names, family.units, result.mode_parameters(i), strict=True))
        ],
        "waves": _waves(harvest, frame, i, noise, left),
    }  # fmt: skip


def _waves(
    harvest: Harvest, frame: HarvestedFrame, i: int, noise: FloatArray, left: FloatArray | None
) -> list[dict[str, Any]]:
    """Wave vectors [1/l]: k is in units of half a wavelength's inverse, like the mode's length."""
    mode = frame.result.ansatz.modes[i]
    to_xi = harvest.pitch / (2.0 * mode.half_wavelength)
    waves = mode.family.waves(frame.result.mode_parameters(i))
    found = []
    for w, wave in enumerate(waves):
        rows = to_xi * mode.family.matrix[PER_WAVE * w + 2 : PER_WAVE * w + 4]
        held = not rows.any()
        found.append({
            "xi": to_xi * wave[2:4],
            "sd_noise": None if held else _sd(rows, noise),
            "sd_leftover": None if held else _sd(rows, left),
        })  # fmt: skip
    return found


def _largest(harvest: Harvest, frame: HarvestedFrame, i: int) -> dict[str, Any]:
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
    by_leftover = frame.by_leftover
    return {
        "largest_px": float(length.max(initial=0.0, where=inside)) / grid.pixel_size,
        "v_max_mm": v[row, col],
        "v_max_sd_noise_mm": frame.by_noise.v[i][at],
        "v_max_sd_leftover_mm": None if by_leftover is None else by_leftover.v[i][at],
    }


def _sd(rows: FloatArray, covariance: FloatArray | None) -> FloatArray | None:
    """(k,) standard deviations of rows (k, m) times unknowns; infinite where one of them is."""
    if covariance is None:
        return None
    lost = np.isinf(np.diag(covariance))
    known = np.where(lost[:, None] | lost[None, :], 0.0, covariance)
    variance = np.einsum("km,mn,kn->k", rows, known, rows)
    touched = (rows[:, lost] != 0.0).any(axis=1)
    return np.where(touched, np.inf, np.sqrt(np.maximum(variance, 0.0)))


def _item(values: FloatArray | None, k: int) -> float | None:
    return None if values is None else float(values[k])
