"""The pattern of a square lattice, computed: what it may depend on, and what it must not.

Guards: the mode doesn't depend on the cell's size, nor the critical strain; it is near to Eq.
(mode) for large holes, and farther for small ones, as the paper says; a mode drawn again from
its row is that mode; what comes first is told apart from the pattern. Meshes are coarse.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from modeharvest.util.errors import InputError
from modeharvest.validation.studies.lattice import (
    LOADINGS,
    ModeTable,
    PatternMode,
    StudiedLattice,
    mode_likeness,
    ogden,
    overlap_of_fields,
    pattern_mode,
    pattern_row,
    study_likeness,
)

BASE = StudiedLattice(ratio=0.8, loading=LOADINGS["equibiaxial"], divisions=6)


@cache
def mode(lattice: StudiedLattice) -> PatternMode:
    return pattern_mode(lattice, pattern_row(lattice))


def test_the_pattern_comes_first_where_an_independent_calculation_has_it() -> None:
    # 2.6 % for d/l = 0.7895, equibiaxial (c1/c2/K material, ± 2-3 %); here with elements of l/6.
    row = mode(replace(BASE, ratio=0.7895)).row
    assert row.kind == "pattern"
    assert row.first == row.pattern == row.state
    assert row.first == pytest.approx(0.026, rel=0.08)


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_neither_mode_nor_strain_depends_on_the_cell_s_size(factor: float) -> None:
    one, other = mode(BASE), mode(replace(BASE, pitch=factor * BASE.pitch))
    # The root is located to 1e-10 of the load, a few 1e-9 of the critical one.
    assert other.row.first == pytest.approx(one.row.first, rel=1e-7)
    assert other.row.overlap == pytest.approx(one.row.overlap, rel=1e-7)
    assert mode_likeness(one, other) == pytest.approx(1.0, abs=1e-9)


def test_small_holes_have_another_mode_than_large_ones() -> None:
    small = replace(BASE, ratio=0.45)
    assert mode(BASE).row.overlap > 0.99
    assert mode(small).row.overlap < 0.97


def test_a_mode_drawn_again_from_its_row_is_that_mode() -> None:
    found = mode(BASE)
    rebuilt = pattern_mode(BASE, found.row)
    assert mode_likeness(found, rebuilt) == pytest.approx(1.0, abs=1e-9)
    # Over one cell, with the analytic mode at the nodes only: interpolation by T6 of l/6.
    assert overlap_of_fields(found.mesh, found.shape, found.analytic) == pytest.approx(
        found.row.overlap, abs=1e-4
    )


def test_both_modes_have_the_symmetry_of_the_pattern() -> None:
    # A quarter turn about the hole's centre reverses it: u(R x) = -R u(x).
    found = mode(BASE)
    nodes = found.mesh.nodes
    off, turned = cKDTree(nodes).query(nodes @ [[0.0, 1.0], [-1.0, 0.0]])
    pairs = off < 1e-9  # the mesh itself is symmetric to x and y only
    assert pairs.sum() > 50
    for field, tolerance in ((found.shape, 0.02), (found.analytic, 1e-12)):
        rotated = np.stack([-field[:, 1], field[:, 0]], axis=1)
        np.testing.assert_allclose(field[turned[pairs]], -rotated[pairs], atol=tolerance)


def test_a_lattice_that_does_not_buckle_in_the_range_still_has_its_mode() -> None:
    row = mode(replace(BASE, largest=0.01)).row
    assert row.kind == "none"
    assert not row.found
    assert row.state == row.first == 0.01
    assert np.isnan(row.pattern)
    assert row.eigenvalue > 0
    assert row.overlap > 0.99


def test_long_waves_come_first_for_smaller_holes_in_uniaxial_compression() -> None:
    row = mode(replace(BASE, ratio=0.6, loading=LOADINGS["uniaxial"])).row
    assert row.kind == "long waves"
    assert row.eigenvalue > 0
    assert row.pattern > row.first


def test_other_materials_have_nearly_the_same_mode() -> None:
    other = replace(BASE, material=ogden(3.0, 0.45))
    (row,) = study_likeness(BASE, [other], ModeTable())
    assert 0.99 < row.likeness < 1.0 - 1e-9
    assert row.material == "Ogden m=3, nu=0.45"


def test_modes_of_different_lattices_are_not_compared_node_by_node() -> None:
    with pytest.raises(InputError, match="the same d/l and divisions"):
        mode_likeness(mode(BASE), mode(replace(BASE, ratio=0.7895)))
