"""Deformed images brought back to the reference's frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from filling_mode import MASK, case, error_px
from manufactured import GRID

from modeharvest.idic.correlate import correlate
from modeharvest.idic.photograph.measure import warped_back
from modeharvest.imaging.pair import ImagePair


def test_the_truth_brings_the_reference_back() -> None:
    ansatz, truth, f, g = case()
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=truth)
    back, seen = warped_back(g, result)
    assert seen[MASK].all()
    # The spline's own error on this speckle, docs/explanation/idic.md.
    assert np.abs(back - f)[MASK].max() < 1e-4


def test_an_image_against_the_pulled_back_one_gives_the_whole_displacement() -> None:
    ansatz, truth, f, g = case()
    first = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=truth)
    back, seen = warped_back(g, first)
    again = correlate(
        ImagePair(back, g, GRID, MASK & seen), ansatz, guess=ansatz.initial_guess(0.05, 1.0)
    )
    assert error_px(again, truth) < 1e-4


def test_pixels_off_the_image_are_reported() -> None:
    ansatz, truth, f, g = case()
    result = correlate(ImagePair(f, g, GRID, MASK), ansatz, guess=truth)
    shifted = ansatz.initial_guess()
    shifted[ansatz.v0_slice(0)][0] = 20.5 * GRID.pixel_size
    shifted[ansatz.v_slice(0)] = 0.0
    back, seen = warped_back(g, replace(result, unknowns=shifted))
    assert seen[:, :-21].all()
    assert not seen[:, -20:].any()
    assert np.isfinite(back).all()
