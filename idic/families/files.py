"""A found mode family and the Fourier coefficients it comes from, as one JSON file.

Programs that don't know this project can read it: a field is ``amplitude`` times the sum over the
waves of (A, B) sin(π/l (kx x + ky y + c)), [mm]; parameters a give the waves as rows of
``matrix`` a + ``offset``. Numbers are written so that reading gives the very same ones.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.errors import InputError
from modeharvest.files import read_record, write_json
from modeharvest.idic.families.automatic import FoundFamily
from modeharvest.idic.families.lattice_spectrum import LatticeSpectrum
from modeharvest.idic.fourier import ModeFamily
from modeharvest.reading import reading

FORMAT = "modeharvest-family-1"
_WHAT = f"a whole {FORMAT} file"

_CONVENTIONS = {
    "field": "u(x) = amplitude * sum over waves of (A, B) * sin(pi/pitch * (kx*x + ky*y + c))",
    "wave": ["A [-]", "B [-]", "kx [-]", "ky [-]", "c [mm]"],
    "parameters": "flattened waves = matrix . parameters + offset",
    "axes": "x to the right, y up, mm; the origin is that of the cell's mesh",
    "normalisation": "the amplitude held by the family is 1 or -1; amplitude has the field's unit",
    "captured": "share of the integral of |u|^2 over the material, rigid translation apart",
    "coefficients": "integral over the cell of u exp(-2 pi i xi.x/pitch) dA, u = 0 in the holes",
}


def write_family(
    path: Path | str,
    found: FoundFamily,
    info: Mapping[str, Any] | None = None,
    spectrum: LatticeSpectrum | None = None,
) -> None:
    """Write a family, atomically.

    Parameters
    ----------
    path
        Of the JSON file.
    found
        The family.
    info
        Plain JSON values to add to the family's own ``info``, such as the critical strain.
    spectrum
        Fourier coefficients of the same field, to keep beside it.

    Raises
    ------
    InputError
        If ``info`` can't be written as JSON, or the file can't be written.
    """
    family = found.family
    content: dict[str, Any] = {
        "format": FORMAT,
        "conventions": _CONVENTIONS,
        "name": family.name,
        "pitch": found.pitch,
        "amplitude": found.amplitude,
        "captured": found.captured,
        "growth": [list(step) for step in found.growth],
        "sentences": list(found.sentences),
        "waves": found.waves.tolist(),
        "matrix": family.matrix.tolist(),
        "offset": family.offset.tolist(),
        "start": family.start.tolist(),
        "names": list(family.names),
        "units": list(family.units),
        "info": {**found.info, **(info or {})},
    }
    if spectrum is not None:
        content["spectrum"] = _spectrum_to_dict(spectrum)
    try:
        json.dumps(content, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"family file {path}: expected plain, finite JSON values, got {error}"
        ) from error
    write_json(path, content)


def read_family(path: Path | str) -> FoundFamily:
    """Read what :func:`write_family` wrote; InputError if it is damaged or something else."""
    with reading(path, _WHAT):
        content = read_record(path, FORMAT, _WHAT, "make it again")
        family = ModeFamily(
            str(content["name"]),
            np.array(content["matrix"], dtype=np.float64),
            np.array(content["offset"], dtype=np.float64),
            np.array(content["start"], dtype=np.float64),
            tuple(str(name) for name in content["names"]),
            tuple(str(unit) for unit in content["units"]),
        )
        return FoundFamily(
            family,
            float(content["pitch"]),
            float(content["amplitude"]),
            float(content["captured"]),
            tuple((int(count), float(share)) for count, share in content["growth"]),
            tuple(str(sentence) for sentence in content["sentences"]),
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


def _spectrum_to_dict(spectrum: LatticeSpectrum) -> dict[str, Any]:
    """Coefficients as [[re, im] of u_x, [re, im] of u_y] for each wave vector."""
    u = spectrum.coefficients
    return {
        "pitch": spectrum.pitch,
        "lattice": spectrum.lattice.tolist(),
        "energy": spectrum.energy,
        "material": spectrum.material,
        "translation": list(spectrum.translation),
        "xi": spectrum.xi.tolist(),
        "coefficients": np.stack([u.real, u.imag], axis=-1).tolist(),
    }
