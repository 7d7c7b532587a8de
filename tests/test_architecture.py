"""Imports go one way: fem → imaging → idic → validation → cli (contracts in pyproject.toml).

The property is checked by import-linter; that the check sees through the symbolic links of
``src/modeharvest`` is itself tested, by breaking each contract in a copy.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parent.parent
PACKAGES = ("fem", "imaging", "idic", "validation")


def lint_imports(project: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the checkout in ``project``."""
    script = "from importlinter.cli import lint_imports_command as main; main()"
    return subprocess.run(
        [sys.executable, "-c", script, "--no-cache"],
        cwd=project,
        env={**os.environ, "PYTHONPATH": str(project / "src"), "PYTHONIOENCODING": "utf-8"},
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the checkout's code, with its links, to break."""
    ignore = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for folder in ("src", *PACKAGES):
        shutil.copytree(PROJECT / folder, tmp_path / folder, symlinks=True, ignore=ignore)
    shutil.copy(PROJECT / "pyproject.toml", tmp_path)
    return tmp_path


def test_the_code_keeps_its_contracts() -> None:
    result = lint_imports(PROJECT)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 broken" in result.stdout


def test_every_inner_layer_has_its_contract() -> None:
    """Each package of three modules or more says which of them may import which."""
    settings = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["tool"][
        "importlinter"
    ]
    layered = {name for each in settings["contracts"] for name in each.get("containers", ())}
    root = PROJECT / "src/modeharvest"
    for folder, _, files in os.walk(root, followlinks=True):
        found = [Path(folder, name).parent for name in files if name.endswith(".py")]
        inner = [path for path in Path(folder).iterdir() if (path / "__init__.py").is_file()]
        if len(found) + len(inner) > 3:  # one is __init__
            package = ".".join(("modeharvest", *Path(folder).relative_to(root).parts))
            assert package in layered


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("fem", "modeharvest.imaging.grid"),
        ("imaging", "modeharvest.idic"),
        ("idic", "modeharvest.validation"),
        ("imaging", "dolfinx"),
        ("validation", "gmsh"),
    ],
)
def test_an_import_the_wrong_way_is_reported(copy: Path, importer: str, imported: str) -> None:
    (copy / importer / "offender.py").write_text(f"import {imported}\n", encoding="utf-8")
    result = lint_imports(copy)
    assert result.returncode == 1, result.stdout + result.stderr
    assert f"modeharvest.{importer}.offender" in result.stdout


def test_a_module_without_a_place_is_reported(copy: Path) -> None:
    (copy / "src/modeharvest/offender.py").write_text("", encoding="utf-8")
    result = lint_imports(copy)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "modeharvest.offender" in result.stdout


def test_only_fem_may_import_dolfinx(copy: Path) -> None:
    (copy / "src/modeharvest/util/errors.py").write_text("import dolfinx\n", encoding="utf-8")
    result = lint_imports(copy)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "modeharvest.util.errors -> dolfinx" in result.stdout


@pytest.mark.parametrize("folder", ["src/modeharvest/runs", "src/modeharvest/util", "validation"])
def test_only_report_and_the_command_line_draw(copy: Path, folder: str) -> None:
    (copy / folder / "offender.py").write_text("import matplotlib\n", encoding="utf-8")
    result = lint_imports(copy)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "offender -> matplotlib" in result.stdout


def test_every_package_is_reached_by_a_relative_link() -> None:
    for package in PACKAGES:
        link = PROJECT / "src/modeharvest" / package
        assert link.is_symlink(), f"{link} must be a link (does git check out links here?)"
        assert os.readlink(link) == f"../../{package}"
