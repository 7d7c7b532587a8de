"""Measured modes in homogenization: snapped to the lattice, and what their error bars do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from modeharvest.fem.lattice.micromorphic.patterns import rotation_pattern
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz
from modeharvest.util.errors import InputError
from modeharvest.validation.homogenization import (
    LatticeMode,
    MeasuredModes,
    ModeParameters,
    Response,
    StateNumbers,
    with_errors,
)

FloatArray = NDArray[np.float64]
SPECIMENS = [Specimen(6, 10), Specimen(5, 4), Specimen(4, 7), Specimen(3, 3)]


def cell_vectors(specimen: Specimen) -> FloatArray:
    return 2.0 * specimen.pitch * np.eye(2)


@pytest.mark.parametrize("specimen", SPECIMENS)
def test_the_exact_mode_of_a_specimen_is_that_of_its_lattice(specimen: Specimen) -> None:
    (mode,) = Ansatz.of_specimen(specimen).modes
    found = LatticeMode.of(mode, mode.family.start, specimen, cell_vectors(specimen))
    assert found.wave_change.max() < 1e-12
    points = np.random.default_rng(0).uniform(-4, 4, (40, 2))
    exact = rotation_pattern(specimen.pitch)(points)
    ratio = np.sum(found.snapped(points) * exact) / np.sum(exact**2)
    assert abs(ratio) == pytest.approx(mode.scale * 2.0, rel=1e-9)
    np.testing.assert_allclose(found.snapped(points), ratio * exact, atol=1e-12)
    np.testing.assert_allclose(found.measured(points), ratio * exact, atol=1e-12)


@given(
    st.lists(st.floats(-0.02, 0.02), min_size=4, max_size=4),
    st.lists(st.floats(-0.1, 0.1), min_size=2, max_size=2),
    st.floats(-0.2, 0.2),
)
def test_errors_of_waves_and_phases_are_snapped_away(
    waves: list[float], phases: list[float], ratio: float
) -> None:
    specimen = Specimen(6, 10)
    (mode,) = Ansatz.of_specimen(specimen).modes
    start = mode.family.start
    vectors = cell_vectors(specimen)
    exact = LatticeMode.of(mode, start + np.array([ratio, 0, 0, 0, 0, 0, 0]), specimen, vectors)
    off = start + np.array([ratio, *waves, *phases])
    found = LatticeMode.of(mode, off, specimen, vectors)
    assert found.is_same(exact)
    k = math.pi / specimen.pitch * np.hypot(off[[1, 3]], off[[2, 4]])
    np.testing.assert_allclose(np.linalg.norm(found.measured.vectors, axis=1), k)


def test_snapping_is_measured_in_standard_deviations() -> None:
    specimen = Specimen(6, 10)
    (mode,) = Ansatz.of_specimen(specimen).modes
    off = mode.family.start + np.array([0, 0.01, 0, 0, -0.02, 0, 0])
    found = LatticeMode.of(mode, off, specimen, cell_vectors(specimen))
    errors = np.diag([1.0, 0.005, 0.1, 0.1, 0.004, 1.0, 1.0]) ** 2
    assert found.deviation(mode, errors) == pytest.approx(5.0)
    errors[1, 2] = errors[2, 1] = 0.8 * 0.005 * 0.1  # what goes with kx's error is no excuse
    assert found.deviation(mode, errors) == pytest.approx(5.0)
    errors[4, 4] = 1.0
    assert found.deviation(mode, errors) == pytest.approx(2.0 / 0.6)


def test_a_wave_of_another_lattice_is_refused() -> None:
    specimen = Specimen(6, 10)
    (mode,) = Ansatz.of_specimen(specimen).modes
    off = mode.family.start * [1, 1.3, 1, 1, 1, 1, 1]
    with pytest.raises(InputError, match=r"within 10% of one that repeats on the cell"):
        LatticeMode.of(mode, off, specimen, cell_vectors(specimen))


def test_a_pattern_between_the_holes_of_its_lattice_is_refused() -> None:
    specimen = Specimen(6, 10)
    (mode,) = Ansatz.of_specimen(specimen).modes
    moved = mode.family.start + np.array([0, 0, 0, 0, 0, 0.4, 0.4])
    with pytest.raises(InputError, match=r"expected phases of the lattice"):
        LatticeMode.of(mode, moved, specimen, cell_vectors(specimen))


class Linear:
    """A response that is linear in the first amplitude of a mode."""

    def __init__(self, reached: int = 2) -> None:
        self.reached, self.calls = reached, 0
        self.specimen = Specimen(6, 10)
        (self.mode,) = Ansatz.of_specimen(self.specimen).modes
        self.start = self.mode.family.start

    def snapped(self, parameters: FloatArray) -> tuple[LatticeMode]:
        vectors = cell_vectors(self.specimen)
        return (LatticeMode.of(self.mode, parameters, self.specimen, vectors),)

    def response(self, modes: Sequence[LatticeMode]) -> Response:
        (mode,) = modes
        self.calls += 1
        sizes = np.hypot(mode.snapped.sine, mode.snapped.cosine)
        a1 = float(sizes[0, 0] / sizes[0, 1])
        states = [StateNumbers(0.1 * k, 2.0 * k * a1, 3.0 * a1) for k in (1, 2)]
        return Response(
            0.1 + 0.01 * a1, tuple(states[: self.reached] if self.calls > 1 else states)
        )


def parameters(linear: Linear, sd: float) -> ModeParameters:
    free, noise = np.diag([sd, *6 * [1e-3]]) ** 2, np.diag(7 * [1e-4]) ** 2
    names = tuple(f"a{k + 1}" for k in range(7))
    return ModeParameters(names, 5 * ("-",) + 2 * ("mm",), linear.start, noise, free)


def test_error_bars_are_propagated_by_differences() -> None:
    linear = Linear()
    response = linear.response(linear.snapped(linear.start))
    measured = MeasuredModes(parameters(linear, 0.02), linear.snapped)
    found, effects = with_errors(response, measured, linear.response)
    assert linear.calls == 2, "one run for a1; the lattice says the other six"
    assert found.critical_strain_sd == pytest.approx(0.01 * 0.02)
    assert [s.force_sd_N_per_mm for s in found.states] == pytest.approx([2 * 0.02, 4 * 0.02])
    assert [s.energy_sd_N for s in found.states] == pytest.approx([3 * 0.02] * 2)
    assert [e.snapped for e in effects] == [False, *6 * [True]]
    assert effects[0].force == pytest.approx((2.0, 4.0))
    assert effects[0].sd_noise == pytest.approx(1e-4)


def test_without_images_error_bars_are_those_of_noise() -> None:
    linear = Linear()
    response = linear.response(linear.snapped(linear.start))
    errors = replace(parameters(linear, 0.02), by_model_error=None)
    measured = MeasuredModes(errors, linear.snapped)
    found, effects = with_errors(response, measured, linear.response)
    assert found.critical_strain_sd == pytest.approx(0.01 * 1e-4)
    assert effects[0].sd_model_error is None


def test_a_state_that_a_changed_mode_does_not_reach_has_no_error_bar() -> None:
    linear = Linear(reached=1)
    response = linear.response(linear.snapped(linear.start))
    measured = MeasuredModes(parameters(linear, 0.02), linear.snapped)
    found, effects = with_errors(response, measured, linear.response)
    assert found.states[0].force_sd_N_per_mm == pytest.approx(0.04)
    assert found.states[1].force_sd_N_per_mm is None
    assert effects[0].energy[1] is None
