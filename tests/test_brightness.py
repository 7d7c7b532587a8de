"""Gain and offset as unknowns: recovered, harmless, and saved."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import drifting_light
import manufactured
import numpy as np
import pytest
from filling_mode import MASK, STRAIN, case, error_px
from manufactured import GRID
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Brightness
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.result import Result
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

SLOW = Brightness(gain_degree=1, offset_degree=2)


@cache
def lit_differently() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """F, a g that a light from the right made brighter and flatter, and the gain and offset."""
    _, truth, f, g = case()
    x, y = np.meshgrid(GRID.x, GRID.y)
    # In f = (1 + b) g + c the two are functions of the reference position.
    gain = 1.15 + 0.06 * x - 0.03 * y
    offset = -0.2 + 0.05 * x + 0.02 * y**2
    ansatz = case()[0]
    at = manufactured.reference_points(ansatz, truth)
    gain_there = 1.15 + 0.06 * at[..., 0] - 0.03 * at[..., 1]
    offset_there = -0.2 + 0.05 * at[..., 0] + 0.02 * at[..., 1] ** 2
    return f, (g - offset_there) / gain_there, gain, offset


def found(brightness: Brightness) -> Result:
    f, g, _, _ = lit_differently()
    ansatz = replace(case()[0], brightness=brightness)
    return correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(STRAIN, 1.0))


def test_slowly_varying_gain_and_offset_are_recovered() -> None:
    result, (_, _, gain, offset) = found(SLOW), lit_differently()
    assert result.outcome is Outcome.CONVERGED
    kinematic = result.ansatz.size - SLOW.size
    truth = np.concatenate([case()[1], np.zeros(SLOW.size)])
    assert error_px(result, truth) < 1e-4
    seen = result.ansatz.gain_and_offset(result.unknowns, GRID.x, GRID.y)
    # A speckle tells g from 1 by its contrast, about 0.4: as exact as the displacement.
    assert np.abs(seen[0] - gain)[MASK].max() < 1e-5
    assert np.abs(seen[1] - offset)[MASK].max() < 1e-5
    assert result.names[kinematic:] == (
        *("gain[0,0]", "gain[1,0]", "gain[0,1]"),
        *("offset[0,0]", "offset[1,0]", "offset[0,1]"),
        *("offset[2,0]", "offset[1,1]", "offset[0,2]"),
    )
    f, g, _, _ = lit_differently()
    inside = np.abs(result.residual(ImagePair(f, g, GRID)))[MASK]
    assert np.sqrt((inside**2).mean()) == pytest.approx(result.residual_rms, abs=3e-7)


def test_left_out_they_spoil_the_displacement() -> None:
    truth = np.concatenate([case()[1], np.zeros(SLOW.size)])
    # The control of the test above.
    assert error_px(found(Brightness()), truth[: case()[0].size]) > 1e-2


def test_asked_for_without_need_they_are_one_and_zero() -> None:
    ansatz, truth, f, g = case()
    ansatz = replace(ansatz, brightness=Brightness(0, 0))
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(STRAIN, 1.0))
    np.testing.assert_allclose(result.unknowns[-2:], 0.0, atol=1e-6)
    assert error_px(result, np.concatenate([truth, [0.0, 0.0]])) < 1e-5


def test_a_displacement_has_no_brightness() -> None:
    ansatz = Ansatz(manufactured.DOMAIN, v0_degree=2, brightness=SLOW)
    u = np.stack(np.meshgrid(0.01 * GRID.x, 0.02 * GRID.y), axis=-1)
    fit = fit_displacement(u, GRID, ansatz, ansatz.initial_guess())
    assert fit.ansatz.size == ansatz.size - SLOW.size
    assert fit.residual_rms < 1e-12


def test_brightness_survives_a_file(tmp_path: Path) -> None:
    result = found(SLOW)
    result.write(tmp_path / "r.json")
    again = Result.read(tmp_path / "r.json")
    assert again.ansatz.brightness == SLOW
    np.testing.assert_array_equal(again.unknowns, result.unknowns)
    assert again.ansatz.units[-1] == "grey levels"


@pytest.mark.parametrize("degrees", [(-1, None), (None, 7)])
def test_bad_degrees(degrees: tuple[int | None, int | None]) -> None:
    with pytest.raises(InputError, match="degree of gain and offset"):
        Brightness(*degrees)


def test_beside_a_spot_of_light_modes_are_those_of_the_whole_displacement(tmp_path: Path) -> None:
    """A correlation takes the spot for displacement: v0 + v1 phi1 was off by 0.11 px."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drifting_light, "STRAINS", (0.06,))
        light = drifting_light.LIGHTS["spot30"]
        run, _ = drifting_light.harvested(tmp_path, lambda _, x, y: light(2, x, y), 1, True)
        (measured,) = run.results().values()
    plate, (known, a) = drifting_light.shown(), drifting_light.ansatz_of(0.06)
    there = known.displacement_at(a, plate.points[plate.mask])
    off = measured.result.displacement()[plate.mask] - there
    assert measured.result.outcome is Outcome.REFITTED
    assert any("The light changed" in text for text in measured.warnings)
    assert np.sqrt(np.mean(off**2)) < 0.08 * drifting_light.PIXEL
