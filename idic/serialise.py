"""An ansatz and a result as plain JSON values, and back. Null is infinity, or NaN."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.brightness import Brightness
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.fourier import FourierMode, ModeFamily
from modeharvest.idic.gauss_newton import Iteration, Outcome
from modeharvest.idic.noise_transfer import NoiseTransfer
from modeharvest.idic.support import Taper
from modeharvest.idic.weighting import Gradient, Weighting
from modeharvest.imaging.grid import PixelGrid

if TYPE_CHECKING:
    from modeharvest.idic.result import Result


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


def result_to_dict(result: Result) -> dict[str, Any]:
    """Everything a result holds, and what it means in words."""
    weighting = result.weighting
    return {
        "outcome": result.outcome.value,
        "explanation": result.outcome.explanation,
        "unknowns": dict(zip(result.names, map(float, result.unknowns), strict=True)),
        "units": list(result.ansatz.units),
        "residual_rms": _finite(result.residual_rms),
        "pixels": result.pixels,
        "left_image": result.left_image,
        "condition_number": _finite(result.condition_number),
        "history": [{k: _finite(v) for k, v in vars(s).items()} for s in result.history],
        "residual_correlation": _finite(result.residual_correlation),
        "residual_lags_px": list(result.residual_lags_px),
        "unmatched": _finite(result.unmatched),
        "weighting": {
            "gradient": weighting.gradient.value,
            "blur_px": weighting.blur_px,
            "width_px": _finite(weighting.width_px),
            "explanation": weighting.sentence,
        },
        "slope_square": _finite(result.slope_square),
        "weight_square": _finite(result.weight_square),
        "noise_transfer": vars(result.noise_transfer),
        "order": result.order,
        "grid": vars(result.grid),
        "ansatz": ansatz_to_dict(result.ansatz),
        "inverse": [[_finite(float(v)) for v in row] for row in result.inverse],
    }


def result_fields(content: Mapping[str, Any]) -> dict[str, Any]:
    """Make the arguments of the result that :func:`result_to_dict` described."""
    weighting = content["weighting"]
    plain = ("pixels", "left_image", "order")
    steps = ({k: _or(np.inf, v) for k, v in step.items()} for step in content["history"])
    return {
        **{name: content[name] for name in plain},
        "ansatz": ansatz_from_dict(content["ansatz"]),
        "grid": PixelGrid(**content["grid"]),
        "unknowns": np.array(list(content["unknowns"].values())),
        "inverse": np.array([[_or(np.inf, v) for v in row] for row in content["inverse"]]),
        "residual_rms": _or(np.inf, content["residual_rms"]),
        "outcome": Outcome(content["outcome"]),
        "condition_number": _or(np.inf, content["condition_number"]),
        "history": tuple(Iteration(**step) for step in steps),
        "residual_correlation": _or(np.nan, content["residual_correlation"]),
        "residual_lags_px": tuple(content["residual_lags_px"]),
        "unmatched": _or(np.nan, content["unmatched"]),
        "slope_square": _or(np.inf, content["slope_square"]),
        "weight_square": _or(np.inf, content["weight_square"]),
        "noise_transfer": NoiseTransfer(**content["noise_transfer"]),
        "weighting": Weighting(
            Gradient(weighting["gradient"]),
            weighting["blur_px"],
            _or(np.inf, weighting["width_px"]),
        ),
    }


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _or(missing: float, value: Any) -> Any:
    return missing if value is None else value


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
