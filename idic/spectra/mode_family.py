"""Mode families found in periodic fields: identification, overlap with nodal fields, JSON files.

Automates what the paper does by eye in its Section "Parametrization and Initial Guess of the
Patterning Modes": find the peaks, take the waves that matter (``waves``), see what they have in
common (``constraints``), and describe them. For the (π, π) mode of a square lattice this is Eq.
(mode) with its seven parameters.

The normalised overlap |∫ u·φ dA| / (‖u‖ ‖φ‖) is 1 for fields that differ by a factor. Both are
taken without their mean over the material: a rigid translation isn't part of a mode.

Programs that don't know this project can read the file: a field is ``amplitude`` times the sum over
the waves of (A, B) sin(π/l (kx x + ky y + c)), [mm]; parameters a give the waves as rows of
``matrix`` a + ``offset``. Numbers are written so that reading returns them exactly.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.fem.field import Mesh
from modeharvest.idic.modes import ModeFamily, free_family
from modeharvest.idic.spectra.constraints import (
    SAME_AMPLITUDE,
    describe,
    find_ties,
    real_waves,
    tied_family,
)
from modeharvest.idic.spectra.lattice_spectrum import (
    LatticeSpectrum,
    MeshQuadrature,
    lattice_spectrum,
    points_for,
)
from modeharvest.idic.spectra.pattern import nearest_origin, square_parameters
from modeharvest.idic.spectra.waves import GROWTH, select_waves
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_record, reading, write_json
from modeharvest.util.typed import to_plain


def overlap(
    mesh: Mesh,
    values: ArrayLike,
    family: ModeFamily,
    pitch: float,
    parameters: ArrayLike | None = None,
) -> float:
    """Normalised overlap of a nodal field with a family's waves [-], between 0 and 1.

    The field (n, 2) is in any unit; the waves are those of the mode's parameters (m,), by default
    the family's start, without the taper. Raises InputError if the field's shape differs from the
    nodes', or one of the two is only a translation.
    """
    u = np.asarray(values, dtype=np.float64)
    if u.shape != mesh.nodes.shape or not np.isfinite(u).all():
        raise InputError(
            f"overlap: expected a finite field of shape {mesh.nodes.shape}, got {u.shape}"
        )
    waves = family.waves(family.start if parameters is None else parameters)
    largest = float(np.linalg.norm(waves[:, 2:4], axis=1).max())
    rule = MeshQuadrature(mesh, points_for(mesh, 2.0 * np.pi * largest / pitch))
    phi = wave_values(rule, waves, pitch)
    return float(np.sqrt(best_amplitude(rule, rule.without_mean(rule.values(u)), phi)[1]))


def wave_sum(waves: FloatArray, positions: FloatArray, pitch: float) -> FloatArray:
    """(n, 2) sum of waves (w, 5) at positions (n, 2) [mm], without scale and support [-]."""
    phases = np.pi / pitch * (positions @ waves[:, 2:4].T + waves[:, 4])
    return np.asarray(np.sin(phases) @ waves[:, :2])


def wave_values(rule: MeshQuadrature, waves: FloatArray, pitch: float) -> FloatArray:
    """(q, 2) sum of waves at the points of a quadrature, without its mean."""
    return rule.without_mean(wave_sum(waves, rule.positions, pitch))


def best_amplitude(rule: MeshQuadrature, u: FloatArray, phi: FloatArray) -> tuple[float, float]:
    """Factor a that makes a φ nearest to u, and the share of ∫ |u|² that a φ describes.

    The share is the square of the normalised overlap. Raises InputError if one of the two is zero.
    """
    mixed, uu, pp = rule.product(u, phi), rule.product(u, u), rule.product(phi, phi)
    if not (uu > 0 and pp > 0):
        raise InputError("overlap: expected two fields that are more than a translation, got zero")
    return mixed / pp, min(1.0, mixed**2 / (uu * pp))


NEAR_DIAGONAL = 0.1
"""Difference of a wave vector's components from ±1 [π/l] up to which it counts as diagonal: the
next reciprocal vectors of even a 10 x 10 cell are 0.2 away."""


@dataclass(frozen=True, eq=False)
class FoundFamily:
    """A mode family, its origin, and the share of the field that it describes.

    The field is about ``amplitude`` times the sum of the family's waves at its start.
    """

    family: ModeFamily
    pitch: float
    """l [mm], the half-wavelength of :class:`modeharvest.idic.modes.FourierMode`."""
    amplitude: float
    """Factor of the family's waves, with sign [unit of the field]."""
    captured: float
    """Share of ∫ |u|² over the material, translation apart, that amplitude and start describe."""
    growth: tuple[tuple[int, float], ...]
    """(number of waves, share described by so many, nothing tied); continues beyond those taken."""
    text: tuple[str, ...]
    info: Mapping[str, Any] = field(default_factory=dict)
    """Plain JSON values of the caller: lattice, material, loading, critical strain."""

    def __post_init__(self) -> None:
        if not (0 < self.pitch < np.inf and np.isfinite([self.amplitude, self.captured]).all()):
            raise InputError(
                f"mode family {self.family.name!r}: expected a positive pitch and finite numbers, "
                f"got {self.pitch} mm, amplitude {self.amplitude}, captured {self.captured}"
            )

    @property
    def waves(self) -> FloatArray:
        """(w, 5) A, B, kx, ky [-] and c [mm] of the waves at the start."""
        return self.family.waves(self.family.start)


def mode_family(
    mesh: Mesh, lattice: ArrayLike, values: ArrayLike, pitch: float, *, shared: bool = True,
    growth: float = GROWTH, info: Mapping[str, Any] | None = None,
) -> FoundFamily:  # fmt: skip
    """Find the truncated Fourier series of a periodic field, and make it a family.

    mesh, lattice, values, pitch : As for
        :func:`~modeharvest.idic.spectra.lattice_spectrum.lattice_spectrum` [any unit].
    shared : Look for constraints; otherwise every wave has five parameters of its own (but one).
    growth : Least share of the energy that a further star of waves must add [-]; larger for fewer
        waves.
    info : Plain JSON values to keep with the family.
    """
    spectrum = lattice_spectrum(mesh, lattice, values, pitch)
    rule = MeshQuadrature(mesh, points_for(mesh, 6.0 * np.pi / pitch))
    u = rule.without_mean(rule.values(values))
    selection = select_waves(spectrum, rule, u, growth)
    waves = real_waves(selection)
    ties = find_ties(waves)
    rows = np.array([wave.row for wave in waves]) * [1.0, 1.0, 1.0, 1.0, pitch]
    rows[:, :2] /= np.abs(rows[:, :2]).max()
    if shared:
        family = as_square(rows, pitch) or tied_family(waves, ties, pitch)
    else:
        family = free_family(rows)
    phi = wave_values(rule, family.waves(family.start), pitch)
    amplitude, captured = best_amplitude(rule, u, phi)
    text = describe(selection, waves, ties if shared else [], family, captured)
    return FoundFamily(family, pitch, amplitude, captured, selection.growth, text, dict(info or {}))


def as_square(waves: FloatArray, pitch: float) -> ModeFamily | None:
    """Make the paper's Eq. (6) with these waves (w, 5) as its start if they fit it; else None.

    They fit if they are two near the two diagonals, |A| equal, |B| equal, and signs the same in one
    component and opposite in the other. The origin is at a junction or a hole, whichever is nearer.
    """
    if len(waves) != 2:
        return None
    amplitudes, k = waves[:, :2], waves[:, 2:4]
    same = SAME_AMPLITUDE * np.linalg.norm(amplitudes, axis=1).max()
    diagonal = np.all(np.abs(np.abs(k) - 1.0) <= NEAR_DIAGONAL) and k.prod() < 0
    equal = np.all(np.abs(np.diff(np.abs(amplitudes), axis=0)) <= same)
    if not (diagonal and equal and amplitudes.prod() < 0):
        return None
    return nearest_origin(square_parameters(waves, pitch)[0], pitch)


FORMAT = "modeharvest-family-1"
_WHAT = f"a whole {FORMAT} file"

_CONVENTIONS = {
    "field": "u(x) = amplitude * sum over waves of (A, B) * sin(pi/pitch * (kx*x + ky*y + c))",
    "wave": ["A [-]", "B [-]", "kx [-]", "ky [-]", "c [mm]"],
    "parameters": "flattened waves = matrix . parameters + offset",
    "axes": "x to the right, y up, mm; the origin is that of the cell's mesh",
    "normalisation": "the amplitude fixed by the family is 1 or -1; amplitude has the field's unit",
    "captured": "share of the integral of |u|^2 over the material, rigid translation apart",
    "coefficients": "integral over the cell of u exp(-2 pi i xi.x/pitch) dA, u = 0 in the holes",
}


def write_family(
    path: Path | str,
    found: FoundFamily,
    info: Mapping[str, Any] | None = None,
    spectrum: LatticeSpectrum | None = None,
) -> None:
    """Write a family as JSON, atomically.

    ``info`` are plain JSON values to add to the family's own, such as the critical strain; a
    spectrum of the same field is stored with it. Raises InputError if ``info`` can't be written as
    JSON, or the file can't be written.
    """
    plain = to_plain(found)
    content: dict[str, Any] = {
        "format": FORMAT,
        "conventions": _CONVENTIONS,
        **plain.pop("family"),
        **plain,
        "waves": found.waves.tolist(),
        "info": {**found.info, **(info or {})},
    }
    if spectrum is not None:
        u = spectrum.coefficients  # as [[re, im] of u_x, [re, im] of u_y] for each wave vector
        pairs = np.stack([u.real, u.imag], axis=-1)
        content["spectrum"] = to_plain(vars(spectrum) | {"coefficients": pairs})
    try:
        json.dumps(content, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"family file {path}: expected plain, finite JSON values, got {error}"
        ) from error
    write_json(path, content)


def read_family(path: Path | str) -> FoundFamily:
    """Read what :func:`write_family` wrote; InputError if it is damaged or another kind of file."""
    with reading(path, _WHAT):
        content = read_record(path, FORMAT, _WHAT, "make it again")
        return FoundFamily(
            ModeFamily(**{f.name: content[f.name] for f in fields(ModeFamily)}),
            float(content["pitch"]),
            float(content["amplitude"]),
            float(content["captured"]),
            tuple((int(count), float(share)) for count, share in content["growth"]),
            tuple(str(line) for line in content["text"]),
            dict(content["info"]),
        )


def read_spectrum(path: Path | str) -> LatticeSpectrum | None:
    """Read the Fourier coefficients in a family's file; None if there are none."""
    with reading(path, _WHAT):
        content = read_record(path, FORMAT, _WHAT, "make it again").get("spectrum")
        if content is None:
            return None
        parts = np.array(content["coefficients"], dtype=np.float64)
        x, y = content["translation"]
        return LatticeSpectrum(
            np.array(content["xi"], dtype=np.float64),
            parts[:, :, 0] + 1j * parts[:, :, 1],
            float(content["pitch"]),
            np.array(content["lattice"], dtype=np.float64),
            float(content["energy"]),
            float(content["material"]),
            (float(x), float(y)),
        )
