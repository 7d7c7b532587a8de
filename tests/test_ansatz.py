"""The ansatz: order and names of the unknowns, sensitivities, fast grids, n modes."""

from __future__ import annotations

import manufactured
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modeharvest.idic.ansatz import Ansatz, AnsatzOptions, ansatz_from_dict, for_cells
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import square_family
from modeharvest.util.errors import InputError
from modeharvest.util.typed import to_plain

few = settings(max_examples=15, deadline=None, derandomize=True)


def test_the_papers_77_unknowns() -> None:
    ansatz = Ansatz.on(Box.centred(15.2, 20.8), [(square_family(), Box.centred(11.4, 19.0))], 1.9)
    assert ansatz.size == 21 + 21 + 28 + 7 == 77
    assert len(set(ansatz.names)) == 77
    assert ansatz.names[0] == "v0x[0,0]"
    assert ansatz.names[21] == "v0y[0,0]"
    assert ansatz.names[42] == "v1[0,0]"
    assert ansatz.names[-7:] == tuple(f"phi1.a{k}" for k in range(1, 8))
    assert ansatz.units == ("mm",) * 70 + ("-",) * 5 + ("mm",) * 2


def test_two_modes_have_their_own_places() -> None:
    ansatz = manufactured.two_modes()
    assert ansatz.size == 2 * 10 + 2 * 6 + 7 + 4
    places = np.concatenate(
        [np.arange(ansatz.size)[ansatz.v0_slice(c)] for c in (0, 1)]
        + [np.arange(ansatz.size)[ansatz.v_slice(i)] for i in (0, 1)]
        + [np.arange(ansatz.size)[ansatz.phi_slice(i)] for i in (0, 1)]
    )
    np.testing.assert_array_equal(places, np.arange(ansatz.size))
    assert ansatz.names[20] == "v1[0,0]"
    assert ansatz.names[26] == "v2[0,0]"
    assert ansatz.names[39] == "phi2.A1"


@pytest.mark.parametrize("make", [manufactured.one_mode, manufactured.two_modes])
@few
@given(seed=st.integers(0, 1000))
def test_sensitivities_against_differences(make: type[Ansatz], seed: int) -> None:
    ansatz = make()
    rng = np.random.default_rng(seed)
    a = manufactured.random_unknowns(ansatz, seed, 0.3)
    x, y = rng.uniform(-1.6, 1.6, 4), rng.uniform(-1.8, 1.8, 5)
    h = 1e-5
    differences = np.stack(
        [
            (ansatz.displacement(a + s, x, y) - ansatz.displacement(a - s, x, y)) / (2 * h)
            for s in h * np.eye(ansatz.size)
        ],
        axis=-1,
    )
    # Only the wave vectors enter nonlinearly: 0.04 v (pi x/l)^3 h^2/6 < 1e-9; the rest is
    # rounding, 1e-16/1e-5 times displacements up to 10.
    np.testing.assert_allclose(ansatz.sensitivities(a, x, y), differences, atol=2e-9)


def test_grid_points_and_parts_agree() -> None:
    ansatz = manufactured.two_modes()
    a = manufactured.random_unknowns(ansatz, 5, 0.3)
    x, y = np.linspace(-1.5, 1.5, 6), np.linspace(1.4, -1.4, 4)
    on_grid = ansatz.displacement(a, x, y)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    assert on_grid.shape == (4, 6, 2)
    np.testing.assert_allclose(ansatz.displacement_at(a, points), on_grid, atol=1e-14)
    np.testing.assert_allclose(ansatz.displacement_at(a, points[0]), on_grid[0], atol=1e-14)
    parts = ansatz.v0(a, x, y) + sum(
        ansatz.v(i, a, x, y)[..., None] * ansatz.phi(i, a, x, y) for i in (0, 1)
    )
    np.testing.assert_allclose(parts, on_grid, atol=1e-14)


def test_start_is_the_applied_compression() -> None:
    ansatz = Ansatz.on(
        Box(-7.0, 8.2, -10.4, 10.4), [(square_family(), Box.centred(11.4, 19.0))], 1.9
    )
    a = ansatz.initial_guess(0.128, amplitude=0.5)
    ends = ansatz.v0(a, np.array([0.6 - 5.7, 0.6 + 5.7]), np.array([3.0]))[0]
    # The cellular part, 11.4 mm long, gets shorter by 12.8 % around the domain's centre.
    np.testing.assert_allclose(ends, [[0.128 * 5.7, 0], [-0.128 * 5.7, 0]], atol=1e-14)
    np.testing.assert_allclose(ansatz.v(0, a, np.zeros(1), np.zeros(1)), 0.5)
    np.testing.assert_array_equal(a[ansatz.phi_slice(0)], [1, 1, 1, -1, 1, 0, 0])


def test_no_mode_is_a_global_polynomial() -> None:
    ansatz = Ansatz(Box.centred(2, 2), v0_degree=1)
    assert ansatz.size == 6
    assert ansatz.displacement(np.arange(6.0), np.zeros(3), np.zeros(2)).shape == (2, 3, 2)


def test_round_trip_as_plain_values() -> None:
    ansatz = manufactured.two_modes()
    again = ansatz_from_dict(to_plain(ansatz))
    a = manufactured.random_unknowns(ansatz, 1)
    x, y = np.linspace(-1, 1, 5), np.linspace(-1, 1, 3)
    assert again.names == ansatz.names
    assert again.units == ansatz.units
    np.testing.assert_array_equal(again.displacement(a, x, y), ansatz.displacement(a, x, y))


def test_bad_input() -> None:
    ansatz = manufactured.one_mode()
    with pytest.raises(InputError, match=r"expected 77 unknowns.*\(76,\)"):
        ansatz.displacement(np.zeros(76), np.zeros(2), np.zeros(2))
    bad = ansatz.initial_guess()
    bad[43] = np.nan
    with pytest.raises(InputError, match=r"v1\[1,0\]"):
        ansatz.checked(bad)
    with pytest.raises(InputError, match="v0_degree from 1"):
        Ansatz(Box.centred(1, 1), v0_degree=0)


@pytest.mark.parametrize(("cells", "degrees"), [(1, 2), (2, 2), (3, 4), (3.4, 4), (4, 6), (9, 6)])
def test_few_cells_have_lower_degrees(cells: float, degrees: int) -> None:
    pattern, specimen = Box.centred(1.9 * cells, 38.0), Box.centred(19.0, 38.0)
    lower = for_cells(AnsatzOptions(), specimen, pattern, 1.9)
    assert (lower.v0_degree, lower.v_degree) == (5, degrees)
    assert for_cells(AnsatzOptions(1, 0), pattern, pattern, 1.9) == AnsatzOptions(1, 0)
