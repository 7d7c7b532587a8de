"""An ansatz as plain JSON values, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.brightness import Brightness
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.fourier import FourierMode, ModeFamily
from modeharvest.idic.support import Taper


def ansatz_to_dict(ansatz: Ansatz) -> dict[str, Any]:
    """Everything needed to make the same ansatz again."""
    return {
        "domain": asdict(ansatz.domain),
        "v0_degree": ansatz.v0_degree,
        "v_degree": ansatz.v_degree,
        "modes": [_mode_to_dict(mode) for mode in ansatz.modes],
        "brightness": asdict(ansatz.brightness),
    }


def ansatz_from_dict(content: Mapping[str, Any]) -> Ansatz:
    """Make the ansatz that :func:`ansatz_to_dict` described."""
    return Ansatz(
        domain=Box(**content["domain"]),
        modes=tuple(_mode_from_dict(mode) for mode in content["modes"]),
        v0_degree=content["v0_degree"],
        v_degree=content["v_degree"],
        brightness=Brightness(**content.get("brightness", {})),
    )


def _mode_to_dict(mode: FourierMode) -> dict[str, Any]:
    family = mode.family
    return {
        "family": {
            "name": family.name,
            "names": list(family.names),
            "units": list(family.units),
            "start": family.start.tolist(),
            "matrix": family.matrix.tolist(),
            "offset": family.offset.tolist(),
        },
        "half_wavelength": mode.half_wavelength,
        "scale": mode.scale,
        "taper": {"cellular": asdict(mode.taper.cellular), "width": mode.taper.width},
    }


def _mode_from_dict(content: Mapping[str, Any]) -> FourierMode:
    family, taper = content["family"], content["taper"]
    return FourierMode(
        family=ModeFamily(
            family["name"],
            np.array(family["matrix"]),
            np.array(family["offset"]),
            np.array(family["start"]),
            tuple(family["names"]),
            tuple(family["units"]),
        ),
        half_wavelength=content["half_wavelength"],
        scale=content["scale"],
        taper=Taper(Box(**taper["cellular"]), taper["width"]),
    )
