"""Gauges in known displacements, and their standard deviations by a known covariance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modeharvest.fem.field import Mesh, with_mid_sides
from modeharvest.idic.finite_element.files import read_result, write_result
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.photograph.gauges import Gauge, along, read_at, read_gauges, write_gauges
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

GRID = PixelGrid.centred(81, 121, 0.1)


def plate() -> Mesh:
    """Triangles over the image."""
    x, y = np.meshgrid(np.linspace(-5.5, 5.5, 23), np.linspace(-3.5, 3.5, 15))
    k = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (v.ravel() for v in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    cells = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    nodes = np.column_stack([x.ravel(), y.ravel()])
    return Mesh(*with_mid_sides(nodes, cells), "T6")


MESH = plate()
TURN = np.radians(7.0)
R = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
STRETCH = np.diag([1.3, 0.85])
GAUGES = (
    Gauge("P", point=(1.0, -0.5)),
    Gauge("L", line=((-4.0, -1.0), (4.0, 2.0))),
    Gauge("A", polygon=((-2.0, -2.0), (3.0, -1.5), (0.5, 2.5))),
)


def result(u: FloatArray, roots: FloatArray | None = None) -> NodalResult:
    n = len(MESH.nodes)
    sd, none = np.full((n, 2), 1e-3), np.zeros((n, 4, 4))
    return NodalResult(
        MESH, u, 0.0 * u, sd, sd, none, GRID, 20.0, (), 0.01, 0.01, 1, 0, 1.0, "", roots=roots
    )


def affine(F: FloatArray) -> FloatArray:
    return MESH.nodes @ (F - np.eye(2)).T


def test_a_turned_stretch_is_read_exactly() -> None:
    found = result(affine(R @ STRETCH) + np.array([0.2, -0.1]))
    point, line, area = (
        {name: r.value for name, r in read_at(gauge, found).items()} for gauge in GAUGES
    )
    strains = {"strain_xx": np.log(1.3), "strain_yy": np.log(0.85), "strain_xy": 0.0, "rotation": 7}
    for read in (point, area):
        assert {name: read[name] for name in strains} == pytest.approx(strains, abs=1e-9)
    at = R @ STRETCH @ [1.0, -0.5] - [1.0, -0.5] + [0.2, -0.1]
    assert [point["u"], point["v"]] == pytest.approx(list(at))
    assert (point["stretch_1"], point["stretch_2"]) == pytest.approx((1.3, 0.85))
    assert area["J"] == pytest.approx(1.3 * 0.85)
    before, now = np.array([8.0, 3.0]), STRETCH @ [8.0, 3.0]
    strain = np.linalg.norm(now) / np.linalg.norm(before) - 1.0
    turn = 7.0 + np.degrees(np.arctan2(now[1], now[0]) - np.arctan2(3.0, 8.0))
    expected = {"length": np.linalg.norm(now), "engineering_strain": strain,
                "true_strain": np.log1p(strain), "turn": turn, "strain_along": strain}  # fmt: skip
    assert line == pytest.approx(expected)
    assert all(np.isnan(r.sd) for g in GAUGES for r in read_at(g, found).values())


def test_a_gradient_is_averaged_over_its_material() -> None:
    x, y = MESH.nodes.T
    found = result(np.column_stack([0.01 * x**2, 0.0 * y]))
    line = Gauge("L", line=((0.0, 0.0), (4.0, 0.0)))
    read = read_at(line, found)
    assert read["engineering_strain"].value == pytest.approx(0.04)
    assert read["strain_along"].value == pytest.approx(0.04, rel=1e-3)
    s, x, y, u, v, strain = along(line, found).T
    np.testing.assert_allclose(strain[5:-5], 0.02 * x[5:-5], rtol=1e-6)
    np.testing.assert_allclose([s, y, u, v], [x, 0 * x, 0.01 * x**2, 0 * x], atol=1e-9)
    area = read_at(Gauge("A", polygon=((1.0, -1.0), (3.0, -1.0), (3.0, 1.0), (1.0, 1.0))), found)
    mean = np.log1p(0.02 * np.linspace(1.0, 3.0, 1001)).mean()
    assert area["strain_xx"].value == pytest.approx(mean, rel=1e-3)


def test_standard_deviations_count_correlation() -> None:
    rng, n = np.random.default_rng(3), len(MESH.nodes)
    x, y = (MESH.nodes / 3.0).T
    smooth = np.stack([f(k * x + p * y) for k in (1, 2) for p in (0, 1, 2)
                       for f in (np.cos, np.sin)], axis=-1)  # fmt: skip
    roots = 1e-3 * np.stack([smooth * rng.normal(size=12), smooth * rng.normal(size=12)], axis=1)
    found = result(affine(R @ STRETCH), roots)
    draws = [found.displacement + roots @ rng.normal(size=12) for _ in range(300)]
    assert roots.shape == (n, 2, 12)
    for gauge in GAUGES:
        sampled = [[r.value for r in read_at(gauge, result(u)).values()] for u in draws]
        sd = [r.sd for r in read_at(gauge, found).values()]
        np.testing.assert_allclose(np.std(sampled, axis=0), sd, rtol=0.2)  # 5 times 1/sqrt(600)
    moved = result(affine(R @ STRETCH), np.ones((n, 2, 1)))  # of all nodes alike: no strain
    assert read_at(GAUGES[1], moved)["engineering_strain"].sd == pytest.approx(0.0, abs=1e-12)
    assert read_at(GAUGES[0], moved)["u"].sd == pytest.approx(1.0)


def test_positions_in_pixels_are_those_of_an_image_viewer() -> None:
    found = result(affine(R @ STRETCH))
    row, col = GRID.to_px(1.0, -0.5)
    same = Gauge("P", point=(float(col), float(row)), pixels=True)
    a, b = (read_at(gauge, found) for gauge in (GAUGES[0], same))
    assert {k: r.value for k, r in a.items()} == pytest.approx({k: r.value for k, r in b.items()})


def test_roots_are_kept_in_the_file(tmp_path: Path) -> None:
    roots = np.random.default_rng(1).normal(0.0, 1e-4, (len(MESH.nodes), 2, 9))
    found = result(affine(STRETCH), roots)
    write_result(tmp_path / "a.h5", found)
    read = read_result(tmp_path / "a.h5")
    assert read.roots is None
    again = read_result(tmp_path / "a.h5", with_roots=True)
    assert again.roots is not None
    np.testing.assert_allclose(again.roots, roots, atol=1e-3 * abs(roots).max())
    write_result(tmp_path / "b.h5", replace(found, roots=None))
    assert read_result(tmp_path / "b.h5", with_roots=True).roots is None


def test_a_table_of_a_sequence(tmp_path: Path) -> None:
    results = {f"image_{k}": result(affine(np.eye(2) * (1.0 + 0.1 * k))) for k in (1, 2)}
    read = write_gauges(tmp_path, GAUGES, results.items(), "mm")
    head, *rows = (tmp_path / "gauges.csv").read_text().splitlines()
    assert head.startswith("image,P u [mm],P sd u [mm],P v [mm]")
    assert "L engineering_strain [-]" in head
    assert [row.split(",")[0] for row in rows] == ["image_1", "image_2"]
    assert read["image_2"]["L"]["true_strain"].value == pytest.approx(np.log(1.2))
    lines = (tmp_path / "gauges_along.csv").read_text().splitlines()
    assert lines[0] == "image,gauge,s [mm],x [mm],y up [mm],u [mm],v up [mm],strain_along [-]"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1", "expected [[gauges]], got none"),
        ('[[gauges]]\nname = "a"', "expected one of point, line, polygon, got none"),
        ('[[gauges]]\nname = "a"\npoint = [0, 0]\nline = [[0, 0], [1, 0]]', "got point and line"),
        ('[[gauges]]\nname = "a"\nline = [[1, 0], [1, 0]]', "a line of some length"),
        ('[[gauges]]\nname = "a"\npolygon = [[1, 0], [1, 1]]', "3 corners or more, got 2"),
        ('[[gauges]]\nname = "a"\npoint = [1, 0]\n' * 2, "different names, got 'a' again"),
        ('[[gauges]]\nname = "a"\npoints = [1, 0]', "did you mean 'point'"),
        ('[[gauges]]\nname = ""\npoint = [1, 0]', "expected a name"),
        ("[[gauges", "expected gauges (TOML)"),
        ('[gauges]\nname = "a"\npoint = [1, 0]', "got [gauges]; write two brackets"),
        ('[[gauges]]\nname = "a"\npoint = [1, 0, 0]', "point: expected at most 2 values, got [1"),
        ('[[gauges]]\nname = "a"\npoint = "1, 0"', "point: expected a list, got '1, 0'"),
        ('[[gauges]]\nname = 1\npoint = [1, 0]', "name: expected a text, got 1"),
        ('gauges = ["a"]', "gauges: expected a table, got 'a'"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_gauges_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "gauges.toml").write_text(text)
    with pytest.raises(InputError) as caught:
        read_gauges(tmp_path / "gauges.toml")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_byte_order_mark_and_any_order_of_keys_are_read(tmp_path: Path) -> None:
    text = '\ufeff[[gauges]]\r\nangle = 5\r\npoint = [1, 2]\r\nname = "a"\r\n'
    (tmp_path / "gauges.toml").write_bytes(text.encode())
    assert read_gauges(tmp_path / "gauges.toml") == (Gauge("a", point=(1.0, 2.0), angle=5.0),)


def test_gauges_beside_the_material_are_named() -> None:
    found = result(affine(STRETCH))
    with pytest.raises(InputError, match=r"gauge 'P': expected it on the material, got it beside"):
        read_at(Gauge("P", point=(9.0, 0.0)), found)
    with pytest.raises(InputError, match=r"x = -5.5 to 5.5 and y = -3.5 to 3.5, y up; for \[col"):
        read_at(Gauge("A", polygon=((9.0, 0.0), (9.5, 0.0), (9.0, 1.0))), found)
    with pytest.raises(InputError, match=r"row = 5 to 75 and column = 5 to 115$"):
        read_at(Gauge("P", point=(200.0, 10.0), pixels=True), found)
    with pytest.raises(InputError, match="an area of 1 px or more, got less"):
        read_at(Gauge("A", polygon=((0.0, 0.0), (1.0, 0.0), (2.0, 0.0))), found)
