"""The recipes of docs/how-to/extending.md run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modeharvest.fem import materials, specimen
from modeharvest.idic import modes
from modeharvest.util.typed import quantities

PAGE = Path(__file__).parents[1] / "docs/how-to/extending.md"


def run(heading: str) -> dict[str, Any]:
    """What the code below a heading defines."""
    code = PAGE.read_text("utf-8").split(f"## {heading}")[1].split("```python\n")[1].split("```")[0]
    names: dict[str, Any] = {"__name__": "recipe"}
    exec(compile(code, str(PAGE), "exec", dont_inherit=True), names)
    return names


@pytest.mark.dolfinx
def test_a_material(monkeypatch: pytest.MonkeyPatch) -> None:
    """At rest its energy and stress vanish, and a case's table makes it."""
    import ufl

    monkeypatch.setattr(materials, "MATERIALS", materials.MATERIALS.copy())
    run("A material")
    made = materials.material_of({"kind": "neo-hookean", "mu": 0.5})
    F = ufl.variable(ufl.as_matrix([[1.0, 0.0], [0.0, 1.0]]))
    P = ufl.diff(made.energy(F), F)
    assert float(made.energy(F)) == pytest.approx(0.0)
    for i in (0, 1):
        for j in (0, 1):
            applied = ufl.algorithms.apply_derivatives.apply_derivatives(
                ufl.algorithms.apply_algebra_lowering.apply_algebra_lowering(P[i, j])
            )
            assert float(applied) == pytest.approx(0.0)
    P, tangent = materials.stress_and_tangent(made, np.eye(2)[None])
    assert np.abs(P).max() < 1e-15
    assert tangent[0, 0, 1, 0, 1] == pytest.approx(made.mu)
    assert materials.material_of(materials.material_table(made)) == made
    assert materials.material_table(made) == {"kind": "NeoHookean", "mu": 0.5, "kappa": 5.4}


def test_a_number_in_the_report() -> None:
    names = run("A number in the report of a virtual experiment")
    assert list(quantities(names["Snapshot"])) == [("w, largest", "px", "largest_w_px")]


def test_a_noise_of_the_sensor() -> None:
    made = run("A noise of the sensor")["Sensor"]
    camera = made(full_well=5000.0, dark_electrons=2000.0, gain=0.8, shot_seed=1)
    light = np.full((300, 300), 0.5, dtype=np.float32)
    grey = camera.expose(light, 16, "one") / (2**16 - 1)
    # Of 90 000 numbers the variance scatters by sqrt(2 / 90 000) = 0.5 %.
    assert grey.var() == pytest.approx(float(camera.noise_variance(0.4, 16)), rel=0.02)
    assert grey.mean() == pytest.approx(0.4, abs=1e-3)
    assert np.array_equal(camera.expose(light, 16, "one") / (2**16 - 1), grey)
    assert not np.array_equal(camera.expose(light, 16, "two") / (2**16 - 1), grey)
    assert grey.var() > 1.5 * float(made(full_well=5000.0, gain=0.8).noise_variance(0.4, 16))


def test_a_hole_lattice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(specimen, "STACKINGS", dict(specimen.STACKINGS))
    monkeypatch.setattr(modes, "FAMILIES", dict(modes.FAMILIES))
    made = run("A hole lattice of specimens")["specimen"]
    assert made.vectors[1] == pytest.approx((0.95, 1.7))


def test_every_recipe_is_run() -> None:
    recipes = [part for part in PAGE.read_text("utf-8").split("\n## ")[1:] if "```python" in part]
    tests = Path(__file__).read_text("utf-8")
    assert [part for part in recipes if f'run("{part.splitlines()[0]}")' not in tests] == []
