"""The dispersion of a lattice: its symmetries, its limits, its file, and wrong wave vectors."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from modeharvest.fem.bloch.dispersion import ZONES, Dispersion, dispersion, zone_map
from modeharvest.fem.bloch.eigen import BlochWaves
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import hexagonal, square
from modeharvest.fem.lattice.options import equibiaxial, uniaxial, wave_of
from modeharvest.fem.materials import TwoTermI1
from modeharvest.runs.lattice.results import write_dispersion_table
from modeharvest.util.errors import InputError

LOADS = (0.0, 0.02)


@pytest.fixture(scope="module")
def path() -> CellPath:
    return CellPath(PeriodicCell(square(1.0, 0.8, 1 / 8), TwoTermI1()), uniaxial())


@pytest.fixture(scope="module")
def found(path: CellPath) -> Dispersion:
    return dispersion(path, ZONES["oblique"], LOADS, count=21, bands=3)


def test_a_tour_that_comes_back_finds_the_same_again(found: Dispersion) -> None:
    first, last = (stop for stop, label in zip(found.stops, found.labels, strict=True)
                   if label == "M")  # fmt: skip
    # To what a scan allows: 1e-9 of lambda + s, of which lambda is a part.
    largest = found.eigenvalues.max()
    np.testing.assert_allclose(
        found.eigenvalues[:, first], found.eigenvalues[:, last], atol=1e-8 * largest
    )


def test_at_rest_x_and_y_are_alike_and_under_load_not(found: Dispersion) -> None:
    at = dict(zip(found.labels, found.stops, strict=True))
    rest, loaded = (values[:, 0] for values in found.eigenvalues)
    assert rest[at["X"]] == pytest.approx(rest[at["Y"]], rel=1e-2)  # the mesh is nearly so
    assert abs(loaded[at["X"]] / loaded[at["Y"]] - 1.0) > 0.05


def test_long_waves_begin_as_the_acoustic_tensor_says(path: CellPath) -> None:
    """lambda = smallest eigenvalue of Q(n) k^2 / filling, up to k^4 (the cell is 1 mm)."""
    short = (("Γ", (0.0, 0.0)), ("near", (0.04, 0.02)))
    part = dispersion(path, short, LOADS, count=5, bands=2)
    k, angle = part.distances[-1], math.atan2(0.02, 0.04)
    for load, values in zip(part.loads, part.eigenvalues, strict=True):
        state = path.at(float(load))
        assert state is not None
        limit = BlochWaves(path.cell, state).acoustic(angle) / path.cell.filling
        assert values[-1, 0] / k**2 == pytest.approx(limit, rel=k**2)
        assert values[0] == pytest.approx(0.0)


def test_the_map_holds_the_path_and_is_its_own_opposite(path: CellPath, found: Dispersion) -> None:
    part = zone_map(path, LOADS[1], divisions=4)
    np.testing.assert_allclose(part.eigenvalues, part.eigenvalues[::-1, ::-1], rtol=1e-6)
    np.testing.assert_allclose(part.eigenvalues[0], part.eigenvalues[-1], rtol=1e-6)
    stop = dict(zip(found.labels, found.stops, strict=True))["M"]
    assert part.eigenvalues[-1, -1] == pytest.approx(found.eigenvalues[1, stop, 0], rel=1e-6)
    assert part.eigenvalues[2, 2] == 0.0


def test_the_softest_wave_of_the_square_s_grid_is_the_pattern(path: CellPath) -> None:
    """Whose eigenvalue is not the lowest of the grid: long waves' are, but not over |k|^2."""
    part = zone_map(path, LOADS[1], divisions=24)
    value, wave = part.least_stable
    assert wave == (math.pi, math.pi)
    assert 0 < np.partition(part.eigenvalues.ravel(), 1)[1] < value


def test_the_hexagon_s_corners_of_a_kind_are_alike_without_load() -> None:
    path = CellPath(PeriodicCell(hexagonal(1.0, 0.8, 1 / 6), TwoTermI1()), equibiaxial())
    tour = dispersion(path, ZONES["rhombic"], [0.01], count=7)
    value = dict(zip(tour.labels, tour.eigenvalues[0, list(tour.stops), 0], strict=True))
    assert value["K"] == pytest.approx(value["K′"], rel=1e-6)
    assert value["M₁"] == pytest.approx(value["M₂"], rel=1e-6)
    assert value["K"] != pytest.approx(value["M₁"], rel=1e-2)
    # The zone's corners are as far from Γ as they should be: 4/3 pi and 2 pi / sqrt(3).
    assert tour.distances[tour.stops[1]] == pytest.approx(4 * math.pi / 3)
    sixth = dispersion(path, ZONES["hexagonal"], [0.01], count=4)
    assert sixth.distances[1] == pytest.approx(2 * math.pi / math.sqrt(3))


def test_files_give_back_what_was_written(
    path: CellPath, found: Dispersion, tmp_path: Path
) -> None:
    part = zone_map(path, 0.01, divisions=2)
    whole = Dispersion(found.labels, found.stops, found.waves, found.distances, found.loads,
                       found.eigenvalues, (part,))  # fmt: skip
    whole.write(tmp_path / "d.h5")
    again = Dispersion.read(tmp_path / "d.h5")
    assert (again.labels, again.stops) == (whole.labels, whole.stops)
    for name in ("waves", "distances", "loads", "eigenvalues"):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))
    assert again.zone[0].load == part.load
    np.testing.assert_array_equal(again.zone[0].eigenvalues, part.eigenvalues)
    write_dispersion_table(whole, tmp_path / "d.csv")
    with (tmp_path / "d.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(LOADS) * len(found.waves)
    assert float(rows[1]["eigenvalue_1_N_per_mm4"]) == pytest.approx(found.eigenvalues[0, 1, 0])


@pytest.mark.parametrize(
    "wave", [(1.0, 0.0, 0.2), (1.0,), (math.nan, 0.0), (math.inf, 1.0), "M", None, ((0, 1), (1, 0))]
)
def test_a_wave_vector_outside_the_plane_is_refused(path: CellPath, wave: object) -> None:
    with pytest.raises(InputError, match="wave vector: expected its phases"):
        wave_of(wave)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="wave vector: expected its phases"):
        dispersion(path, [("Γ", (0, 0)), ("?", wave)], [0.0])  # type: ignore[list-item]


def test_a_load_out_of_reach_and_an_odd_grid_are_refused(path: CellPath) -> None:
    with pytest.raises(InputError, match=r"path reaches, got 0\.99"):
        dispersion(path, ZONES["square"], [0.99])
    with pytest.raises(InputError, match="even number of divisions, got 5"):
        zone_map(path, 0.0, divisions=5)
    with pytest.raises(InputError, match="expected a dispersion file"):
        Dispersion.read("nowhere.h5")
