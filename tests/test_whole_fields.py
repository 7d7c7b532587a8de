"""Strains, stresses and their standard deviations on a mesh: exact fields."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from perforated import OBLIQUE, holed_cell
from plate_with_hole import GRID

from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import JetMatrix, Ogden, TwoTermI1
from modeharvest.idic.finite_element.fields import (
    FIELDS,
    deviation_of,
    field_of,
    interpolation_error,
    nodal_gradient,
)
from modeharvest.idic.finite_element.files import (
    Given,
    field_at,
    field_names,
    read_result,
    write_csv,
    write_maps,
    write_result,
)
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.util.errors import InputError

MATERIALS = [Ogden(), Ogden((0.5, 0.3), (1.5, -2.0), 3.0), TwoTermI1()]
STATES = np.array([[[0.7, 0.1], [-0.2, 1.1]], [[1.2, 0.0], [0.0, 1.2]], [[1.3, 0.0], [0.4, 0.8]]])
TURN = np.array([[0.8, -0.6], [0.6, 0.8]])


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    """A cell with straight sides, so that quadratic displacements are exact."""
    made = holed_cell(OBLIQUE, 6)
    nodes = made.nodes.copy()
    for k in range(3):
        ends = made.cells[:, [k, (k + 1) % 3]]
        nodes[made.cells[:, 3 + k]] = nodes[ends].mean(axis=1)
    return Mesh(nodes, made.cells, "T6")


def known(mesh: Mesh, u: np.ndarray, covariance: np.ndarray | None = None) -> NodalResult:
    """A result with a known displacement."""
    n, sd = len(mesh.nodes), np.full_like(u, 1e-3)
    C = np.zeros((n, 4, 4)) if covariance is None else np.broadcast_to(covariance, (n, 4, 4))
    return NodalResult(
        mesh, u, np.zeros_like(u), sd, sd, C, GRID, 20.0, (), 0.01, 0.01, 1, 0, 1.0, ""
    )


def affine(mesh: Mesh, F: np.ndarray) -> NodalResult:
    return known(mesh, mesh.nodes @ (F - np.eye(2)).T)


def same(found: np.ndarray, expected: Any) -> None:
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=1e-9)


@pytest.mark.parametrize("turn", [np.eye(2), TURN])
def test_fields_of_a_turned_stretch(mesh: Mesh, turn: np.ndarray) -> None:
    axes = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    U = axes @ np.diag([1.2, 0.9]) @ axes.T
    result = affine(mesh, turn @ U)
    same(result.field("F"), turn @ U)
    same(result.field("J"), 1.2 * 0.9)
    same(result.field("stretch_1"), 1.2)
    same(result.field("stretch_2"), 0.9)
    same(result.field("direction_1"), axes[:, 0])
    same(result.field("green_lagrange"), 0.5 * (U @ U - np.eye(2)))
    same(result.field("logarithmic"), axes @ np.diag(np.log([1.2, 0.9])) @ axes.T)


def test_a_rotation_strains_and_stresses_nothing(mesh: Mesh) -> None:
    result = affine(mesh, TURN)
    for name in ("green_lagrange", "logarithmic", "P", "cauchy", "energy_density"):
        same(result.field(name, material=Ogden()), 0.0)


def test_gradient_of_a_quadratic(mesh: Mesh) -> None:
    x, y = mesh.nodes.T
    u = np.stack([0.03 * x * y, 0.02 * x**2 - 0.01 * y**2], axis=1)
    F = np.stack([1 + 0.03 * y, 0.03 * x, 0.04 * x, 1 - 0.02 * y], axis=1).reshape(-1, 2, 2)
    result = known(mesh, u)
    same(result.field("F"), F)
    same(result.field("J"), np.linalg.det(F))
    points = mesh.nodes[mesh.cells[::7, :3]].mean(axis=1)
    px, py = points.T
    same(result.field("F", points)[:, 0, 1], 0.03 * px)
    same(result.field("J", points), (1 + 0.03 * py) * (1 - 0.02 * py) - 0.0012 * px**2)


@pytest.mark.parametrize("material", MATERIALS)
def test_stresses(material: Any) -> None:
    P, J = field_of("P", STATES, material), np.linalg.det(STATES)
    step = 1e-5
    for i in (0, 1):
        for j in (0, 1):
            change = np.zeros((2, 2))
            change[i, j] = step
            W = [field_of("energy_density", STATES + s * change, material) for s in (1, -1)]
            np.testing.assert_allclose(P[:, i, j], (W[0] - W[1]) / (2 * step), atol=1e-8)
    sigma = field_of("cauchy", STATES, material)
    np.testing.assert_allclose(sigma, P @ STATES.swapaxes(1, 2) / J[:, None, None], atol=1e-12)
    np.testing.assert_allclose(sigma, sigma.swapaxes(1, 2), atol=1e-12)


def test_uniaxial_stretch_of_an_ogden_material() -> None:
    """P_11 = c/m (l^(m-1) - 1/l) + kappa (l - 1), P_22 = kappa (l - 1) l, by hand."""
    stretch, material = 0.8, Ogden((1.2,), (3.0,), 5.4)
    F = np.diag([stretch, 1.0])[None]
    P = field_of("P", F, material)[0]
    first = 0.4 * (stretch**2 - 1 / stretch) + 5.4 * (stretch - 1)
    np.testing.assert_allclose(P, np.diag([first, 5.4 * (stretch - 1) * stretch]), atol=1e-12)
    sigma = field_of("cauchy", F, material)[0]
    np.testing.assert_allclose(sigma, np.diag([first, 5.4 * (stretch - 1)]), atol=1e-12)


@pytest.mark.parametrize("name", FIELDS)
def test_deviations_against_many_samples(name: str) -> None:
    random = np.random.default_rng(3)
    root = 1e-4 * random.standard_normal((4, 4))
    F = STATES[:1]
    many = F + (random.standard_normal((40_000, 4)) @ root.T).reshape(-1, 2, 2)
    values = field_of(name, many, Ogden())
    if name == "direction_1":
        values *= np.sign(values[:, :1] * values[0, 0])
    expected = values.std(axis=0)
    found = deviation_of(name, F, (root @ root.T)[None], Ogden())[0]
    # Of 40 000 samples a standard deviation is known to 0.4 %.
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=1e-3 * np.max(expected))


def test_energy_where_nothing_can_be_is_missing() -> None:
    folded = np.array([np.diag([-0.1, 1.0]), np.eye(2)])
    found = field_of("energy_density", folded, Ogden())
    np.testing.assert_array_equal(found, [np.nan, 0.0])
    assert JetMatrix(folded)[0, 0].value[0] == -0.1


def test_what_is_missing_is_reported(mesh: Mesh) -> None:
    result = affine(mesh, np.eye(2))
    with pytest.raises(InputError, match="expected a material for the field 'cauchy'"):
        result.field("cauchy")
    with pytest.raises(InputError, match="expected a field, got 'cauchi'"):
        result.field("cauchi")
    with pytest.raises(InputError, match="expected a correlation"):
        field_at(result, "microfluctuation")


def test_gradient_is_linear(mesh: Mesh) -> None:
    random = np.random.default_rng(0)
    a, b = random.standard_normal((2, len(mesh.nodes), 3))
    together = nodal_gradient(mesh, a + 2 * b)
    np.testing.assert_allclose(
        together, nodal_gradient(mesh, a) + 2 * nodal_gradient(mesh, b), atol=1e-9
    )


def test_files_hold_every_field(mesh: Mesh, tmp_path: Path) -> None:
    small = Mesh(0.8 * mesh.nodes / np.abs(mesh.nodes).max(), mesh.cells, "T6")
    given = Given(material=Ogden())
    result = replace(
        affine(small, STATES[0]),
        gradient_covariance=np.broadcast_to(1e-6 * np.eye(4), (len(small.nodes), 4, 4)),
    )
    write_result(tmp_path / "u.h5", result, given=given)
    again = read_result(tmp_path / "u.h5")
    np.testing.assert_array_equal(again.gradient_covariance, result.gradient_covariance)
    with h5py.File(tmp_path / "u.h5") as file:
        for name in field_names(given)[2:]:
            values = field_at(result, name, None, given)
            np.testing.assert_allclose(file[f"fields/{name}"], values, rtol=1e-6, atol=1e-12)
        assert file["fields/cauchy"].attrs["unit"] == "MPa"
    write_csv(tmp_path / "u.csv", result, given=given)
    table = np.genfromtxt(tmp_path / "u.csv", delimiter=",", names=True, deletechars="")
    assert table["cauchy_xy_[MPa]"] == pytest.approx(result.field("cauchy", None, Ogden())[:, 0, 1])
    # sd of F_xx is 1e-3.
    assert table["sd_F_xx"] == pytest.approx(1e-3)
    paths = write_maps(tmp_path / "u", result, names=("cauchy", "sd_J"), given=given)
    assert [path.name for path in paths] == [
        "u_cauchy_xx_MPa.tif", "u_cauchy_yy_MPa.tif", "u_cauchy_xy_MPa.tif", "u_sd_J.tif"
    ]  # fmt: skip


def test_interpolation_error_of_a_cubic() -> None:
    """Of a wave on ever smaller elements it falls by h^3, and is about what is missing."""
    found = []
    for n in (8, 16):
        mesh = holed_cell(OBLIQUE, n)
        x, y = mesh.nodes.T
        wave = np.stack([np.sin(1.5 * x + y), np.cos(x - 2.0 * y)], axis=1)
        at = mesh.nodes[mesh.cells[:, :3]].mean(axis=1)
        exact = np.stack([np.sin(1.5 * at[:, 0] + at[:, 1]), np.cos(at[:, 0] - 2.0 * at[:, 1])], 1)
        inside = known(mesh, wave).at(at)
        there = np.isfinite(inside[:, 0])
        missing = np.sqrt(np.mean((inside - exact)[there] ** 2))
        found.append(np.sqrt(np.mean(interpolation_error(mesh, wave) ** 2)))
        assert 0.3 < found[-1] / missing < 6.0
    assert 5.0 < found[0] / found[1] < 11.0


def test_interpolation_error_of_a_quadratic(mesh: Mesh) -> None:
    x, y = mesh.nodes.T
    assert interpolation_error(mesh, np.stack([x**2, x * y], axis=1)).max() < 1e-12
