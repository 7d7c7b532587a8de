"""When a pattern appears in a sequence of images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filling_mode import MASK, case
from manufactured import GRID

from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.local.motion import fit_unknowns
from modeharvest.idic.photograph.axes import turned_axes
from modeharvest.imaging.pair import ImagePair
from modeharvest.validation.onset import ImageAmplitude, find_buckling, load_axis, mean_strain

CRITICAL = 0.091


def moment(strain: float) -> ImageAmplitude:
    """A pitchfork of amplitude 100 px times the square root of the strain beyond."""
    size = 100.0 * np.sqrt(max(0.0, strain - CRITICAL))
    return ImageAmplitude(f"at {strain}", strain, 0.3 + size, 0.5, 0.01)


def test_the_strain_is_bracketed_and_estimated() -> None:
    found = find_buckling([moment(e) for e in (0.05, 0.08, 0.1, 0.11, 0.12)])
    assert (found.before, found.after) == (0.08, 0.1)
    # The constant 0.3 px that isn't of the pitchfork moves the estimate a little.
    assert found.estimate == pytest.approx(CRITICAL, abs=2e-3)
    assert "between strains of 8.00 % (at 0.08) and 10.00 %" in found.text


def test_an_unloading_is_not_taken_for_a_loading() -> None:
    found = find_buckling([moment(e) for e in (0.05, 0.1, 0.12, 0.06)])
    assert (found.before, found.after) == (0.05, 0.1)


@pytest.mark.parametrize("strains", [(), (0.02, 0.05)])
def test_no_pattern_is_reported(strains: tuple[float, ...]) -> None:
    found = find_buckling([moment(e) for e in strains])
    assert np.isnan(found.after)
    assert "No image" in found.text


def test_a_pattern_from_the_beginning_is_reported() -> None:
    found = find_buckling([moment(e) for e in (0.1, 0.12)])
    assert np.isnan(found.before)
    assert "Every image" in found.text


@pytest.mark.parametrize("strains", [(0.1, -0.04), (0.1, -0.1), (0.1, 0.08), (-0.1, 0.04)])
def test_the_axis_of_the_load_is_found(strains: tuple[float, float]) -> None:
    test = np.outer([0.1, 1.0], strains)
    assert (load_axis(test), load_axis(test[:, ::-1])) == (0, 1)


def test_mean_strain_is_that_of_the_slow_field() -> None:
    ansatz, _, f, g = case()
    a = ansatz.initial_guess(0.037, 1.0)
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=a)
    along, across = mean_strain(replace(result, unknowns=a), Box.centred(2.0, 2.4))
    assert along == pytest.approx(0.037 * 1.0, rel=1e-12)
    assert across == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 12.0, -100.0])
def test_mean_strain_is_along_the_specimens_own_axes(angle: float) -> None:
    """A specimen at this angle is compressed by 4 % along its axis, widens by 1 %, and turns."""
    axes, turn = turned_axes(angle), turned_axes(7.0)
    F = turn @ axes.T @ np.diag([0.96, 1.01]) @ axes
    ansatz, _, f, g = case()
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=ansatz.initial_guess(0.0, 1.0))
    x, y = (part.ravel() for part in np.meshgrid(GRID.x, GRID.y))
    known = LocalField(x, y, np.column_stack([x, y]) @ (F - np.eye(2)).T)
    a = fit_unknowns(ansatz, ansatz.initial_guess(0.0, 1.0), known, 1).coefficients
    found = mean_strain(replace(result, unknowns=a), Box.centred(2.0, 2.4), angle)
    assert found == pytest.approx((0.04, -0.01), abs=1e-6)
