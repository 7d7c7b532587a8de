"""``import modeharvest as mh``: its names, and what each of them has to load."""

from __future__ import annotations

import ast
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

import modeharvest as mh
from modeharvest.util.errors import MissingDependencyError

NUMBERS = {"numpy", "scipy", "h5py", "numba", "pydantic"}
DRAWING = {"matplotlib", "jinja2", "typer"}  # rich comes with meshio
EXPERIMENTS = ("Experiment", "Ogden", "Specimen")
MEASURED = (
    "Ansatz", "ImagePair", "ImagingSpec", "Result", "Solution", "best_fit", "correlate",
    "harvest", "make_images", "run", "score", "shipped_solution",
)  # fmt: skip


def loaded_by(*names: str) -> set[str]:
    """Top-level packages that a new Python has loaded once it has used these names."""
    script = f"import json, sys, modeharvest as mh\nfor name in {names!r}: getattr(mh, name)\n"
    script += "print(json.dumps(sorted(sys.modules)))"
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return {name.partition(".")[0] for name in json.loads(done.stdout)}


@pytest.mark.dolfinx
@pytest.mark.parametrize("name", [name for name in mh.__all__ if name != "__version__"])
def test_every_name_is_its_module_s_own(name: str) -> None:
    own_module = importlib.import_module(f"modeharvest.{mh._HOMES[name]}")
    assert getattr(mh, name) is getattr(own_module, name)
    assert name in dir(mh)


def test_type_checkers_see_the_same_names_from_the_same_homes() -> None:
    tree = ast.parse(Path(str(mh.__file__)).read_text("utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {
        name.name: str(line.module).removeprefix("modeharvest.")
        for line in block.body
        if isinstance(line, ast.ImportFrom) and line.module != "typing"
        for name in line.names
    }
    assert seen == mh._HOMES
    assert sorted({*seen, "__version__"}) == sorted(mh.__all__)


def test_the_package_itself_loads_neither_numbers_nor_drawing() -> None:
    assert not loaded_by() & (NUMBERS | DRAWING | {"typing"})


def test_an_experiment_is_described_without_heavy_libraries() -> None:
    assert not loaded_by(*EXPERIMENTS) & ((NUMBERS | DRAWING) - {"numpy"})


def test_images_are_made_and_measured_without_drawing() -> None:
    assert not loaded_by(*EXPERIMENTS, *MEASURED) & DRAWING


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'corelate'"):
        _ = mh.corelate


def test_simulating_says_how_to_get_dolfinx(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [n for n in sys.modules if n.startswith("modeharvest.fem.simulate")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(vars(mh), "simulate", raising=False)
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    with pytest.raises(MissingDependencyError, match="conda install"):
        _ = mh.simulate
