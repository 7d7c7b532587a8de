"""From a specimen to an ansatz and a start: 77 unknowns, and the mode's origin on a junction."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.util.errors import InputError

SETUP = SquareLatticeOptions()


@pytest.mark.parametrize("holes_x", [1, 2, 3, 6])
@pytest.mark.parametrize("holes_y", [1, 2, 5, 10])
def test_the_start_is_the_specimens_own_pattern(holes_x: int, holes_y: int) -> None:
    """phi of the start is +-0.04 times Specimen.pattern over the whole cellular part."""
    specimen = Specimen(holes_x=holes_x, holes_y=holes_y)
    ansatz = SETUP.ansatz(specimen)
    start = ansatz.initial_guess(0.1, SETUP.start_amplitude)
    a, b = specimen.cellular_half_size
    x, y = np.linspace(-a, a, 23), np.linspace(-b, b, 31)
    phi = ansatz.phi(0, start, x, y).reshape(-1, 2)
    # Eq. (6) is 2 cos sin at its largest where the pattern is cos sin: 0.04 times it.
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    pattern = 0.04 * specimen.pattern(points)
    sign = np.sign(np.sum(phi * pattern))
    np.testing.assert_allclose(phi, sign * pattern, atol=1e-15)


@given(holes_x=st.integers(1, 30), holes_y=st.integers(1, 30), pitch=st.floats(0.25, 32))
def test_the_modes_origin_is_a_solid_junction(holes_x: int, holes_y: int, pitch: float) -> None:
    """There phi vanishes and turns the material rigidly, as between four holes."""
    specimen = Specimen(holes_x, holes_y, diameter=0.8 * pitch, pitch=pitch)
    ansatz = SETUP.ansatz(specimen)
    start = ansatz.initial_guess(0.0, SETUP.start_amplitude)
    _, k1x, k1y, k2x, k2y, c1, c2 = start[ansatz.phi_slice(0)]
    origin = np.linalg.solve([[k1x, k1y], [k2x, k2y]], [-c1, -c2])  # both phases zero
    corner = -np.array(specimen.cellular_half_size)
    cells = (origin - corner) / pitch  # junctions are a whole number of cells from the corner
    np.testing.assert_allclose(cells, np.round(cells), atol=1e-12)
    assert abs(start[ansatz.phi_slice(0)][5:]).max() <= pitch * (1 + 1e-12)


def test_the_papers_numbers() -> None:
    specimen = Specimen()
    ansatz = SETUP.ansatz(specimen)
    start = ansatz.initial_guess(0.128, SETUP.start_amplitude)
    assert ansatz.size == len(ansatz.names) == len(ansatz.units) == 77
    np.testing.assert_array_equal(start[ansatz.phi_slice(0)], [1, 1, 1, -1, 1, 0, 0])
    assert dict(zip(ansatz.names, ansatz.units, strict=True))["phi1.a6"] == "mm"
    # The mode is 1 over the cellular part and gone half a cell beyond it.
    taper = ansatz.modes[0].taper
    np.testing.assert_allclose(
        taper.along_x([5.7, 5.7 + 0.475, 5.7 + 0.95]), [1, 0.5, 0], atol=1e-14
    )
    np.testing.assert_allclose(taper.along_y([9.5, 9.5 + 0.95]), [1, 0], atol=1e-14)
    assert ansatz.domain.half == (7.6, 10.4)
    # Both loaded edges of the cellular part move by half of 12.8 % of 11.4 mm.
    ends = ansatz.v0(start, np.array([-5.7, 5.7]), np.zeros(1))[0]
    np.testing.assert_allclose(ends, [[0.7296, 0], [-0.7296, 0]], atol=1e-12)
    np.testing.assert_allclose(ansatz.v(0, start, np.zeros(1), np.zeros(1)), 1.0)


def test_options_are_handed_on() -> None:
    setup = SquareLatticeOptions(edge_px=5, order=3, v0_degree=3, v_degree=2)
    options = setup.options()
    assert (options.edge_px, options.order) == (5, 3)
    assert setup.ansatz(Specimen()).size == 2 * 10 + 6 + 7


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"v0_degree": 0}, "v0_degree from 1"),
        ({"v_degree": -1}, "v_degree from 0"),
        ({"start_amplitude": 0.0}, "start_amplitude that is not 0 mm"),
        ({"edge_px": -1}, "edge_px from 0"),
        ({"order": 4}, "order 3, 5 or 11"),
    ],
)
def test_bad_values_are_named(values: dict[str, float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        SquareLatticeOptions(**values)  # type: ignore[arg-type]


def test_a_fixed_mode_has_no_unknowns_and_is_the_ideal_one() -> None:
    specimen = Specimen(holes_x=5, holes_y=4)
    free, fixed = (SquareLatticeOptions(fixed_mode=h).ansatz(specimen) for h in (False, True))
    assert fixed.size == free.size - 7
    x, y = np.linspace(-5, 5, 7), np.linspace(-4, 4, 9)
    np.testing.assert_allclose(
        fixed.phi(0, fixed.initial_guess(), x, y),
        free.phi(0, free.initial_guess(), x, y),
        atol=1e-15,
    )


def test_gain_and_offset_can_be_asked_for() -> None:
    ansatz = SquareLatticeOptions(brightness=1).ansatz(Specimen())
    assert ansatz.names[77:81] == ("gain[0,0]", "gain[1,0]", "gain[0,1]", "offset[0,0]")
    assert SquareLatticeOptions().ansatz(Specimen()).size == 77
    for wrong in (9, -1, "linear"):
        with pytest.raises(InputError, match=f"0 .even. to 6, or 'none', got {wrong!r}"):
            SquareLatticeOptions(brightness=wrong)
