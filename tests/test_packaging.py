"""What users install: a wheel that holds everything, and runs elsewhere without dolfinx."""

from __future__ import annotations

import os
import re
import shutil
import site
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import modeharvest
from modeharvest import util
from modeharvest.util import RELEASE

PROJECT = Path(__file__).resolve().parent.parent
SOURCE = PROJECT / "src" / "modeharvest"

# h5py may itself be built on mpi4py; none of the others may be needed outside fem.
UNAVAILABLE = ("dolfinx", "basix", "ufl", "ffcx", "petsc4py", "slepc4py", "gmsh")

IMPORT_WITHOUT_DOLFINX = """
import importlib, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {unavailable!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
for name in {names!r}:
    importlib.import_module(name)
print(sys.modules["modeharvest"].__file__)
"""


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command with none of the checkout's paths in its environment."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL"))}
    result = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


def build(project: Path, what: str, out: Path) -> Path:
    """Build ``what`` (``wheel`` or ``sdist``) of ``project`` with what is installed here."""
    run(
        *(sys.executable, "-m", "build", f"--{what}", "--no-isolation", "--outdir", out, project),
        cwd=project,
    )
    (artefact,) = out.iterdir()
    return artefact


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what packaging reads, since setuptools writes into the tree it builds."""
    copy = tmp_path_factory.mktemp("checkout")
    ignore = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for folder in ("src", *(link.name for link in SOURCE.iterdir() if link.is_symlink())):
        shutil.copytree(PROJECT / folder, copy / folder, symlinks=True, ignore=ignore)
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(PROJECT / file, copy)
    return copy


@pytest.fixture(scope="module")
def wheel(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(checkout, "wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of a new virtual environment with the wheel, and dependencies from here."""
    folder = tmp_path_factory.mktemp("venv")
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder)
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    pip = (sys.executable, "-m", "pip", "--python", python, "--disable-pip-version-check")
    run(*pip, "install", "--quiet", "--no-index", "--no-deps", wheel, cwd=folder)
    here = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    purelib = run(python, "-c", "import site; print(site.getsitepackages()[0])", cwd=folder)
    lines = "\n".join([*here, *site.getsitepackages()])
    Path(purelib.strip(), "dependencies.pth").write_text(lines + "\n", "utf-8")
    return python


def files_of(wheel: Path) -> dict[str, bytes]:
    """Name and content of every file of the package in a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return {n: archive.read(n) for n in archive.namelist() if n.startswith("modeharvest/")}


def test_the_wheel_holds_every_module_and_data_file(wheel: Path) -> None:
    present = {
        path.relative_to(SOURCE.parent).as_posix()
        for folder, _, names in os.walk(SOURCE, followlinks=True)
        for path in (Path(folder, name) for name in names)
        if "__pycache__" not in path.parts and path.suffix != ".md" and path.name[0] != "."
    }
    assert {"modeharvest/fem/field.py", "modeharvest/py.typed"} <= present
    assert set(files_of(wheel)) == present


def test_a_wheel_made_from_the_sdist_is_the_same(
    wheel: Path, checkout: Path, tmp_path: Path
) -> None:
    sdist = build(checkout, "sdist", tmp_path / "sdist")
    shutil.unpack_archive(sdist, tmp_path / "unpacked", filter="data")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    assert files_of(build(unpacked, "wheel", tmp_path / "wheel")) == files_of(wheel)


def test_all_but_fem_imports_elsewhere_without_dolfinx(
    wheel: Path, installed: Path, tmp_path: Path
) -> None:
    modules = [
        name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        for name in files_of(wheel)
        if name.endswith(".py") and not name.endswith("__main__.py")
    ]
    fem_without_dolfinx = {"modeharvest.fem", "modeharvest.fem.field"}
    names = [n for n in modules if ".fem" not in n or n in fem_without_dolfinx]
    assert len(names) > 5
    script = IMPORT_WITHOUT_DOLFINX.format(unavailable=UNAVAILABLE, names=names)
    where = Path(run(installed, "-c", script, cwd=tmp_path).strip())
    assert where.is_relative_to(installed.parent.parent), where


def test_the_installed_version_is_the_package_s(installed: Path, tmp_path: Path) -> None:
    script = "from importlib.metadata import version; import modeharvest as m; "
    script += "print(version('modeharvest'), m.__version__)"
    assert run(installed, "-c", script, cwd=tmp_path).split() == [RELEASE, RELEASE]


def test_the_installed_command_says_its_version(installed: Path, tmp_path: Path) -> None:
    command = installed.with_name("modeharvest")
    assert run(command, "--version", cwd=tmp_path).strip() == RELEASE


@pytest.mark.parametrize(
    ("described", "version"),
    [
        ("v1.2.0\n", "1.2.0"),
        ("v1.2.0-5-g1a2b3c4", "1.2.0.post5+g1a2b3c4"),
        ("v1.2.0-5-g1a2b3c4-dirty", "1.2.0.post5+g1a2b3c4.dirty"),
        ("v1.2.0rc1-dirty", "1.2.0rc1+dirty"),
        ("1a2b3c4d", f"{RELEASE}+g1a2b3c4d"),  # no tag, as in a shallow clone
        ("", RELEASE),  # no git
        ("$Format:%(describe)$", RELEASE),  # an archive that git didn't make
    ],
)
def test_the_version_follows_from_the_tag(
    described: str, version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The folder of a checkout, and what scripts/env has found there.
    monkeypatch.setenv("MODEHARVEST_DESCRIBED", f"{PROJECT} {described}")
    assert util._from_description(util._described(PROJECT)) == version


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_versions_of_clones_and_archives(tmp_path: Path) -> None:
    def version(folder: Path) -> str:
        script = "import modeharvest as m; print(m.__version__)"
        path = f"import sys; sys.path.insert(0, {str(folder / 'src')!r}); {script}"
        return run(sys.executable, "-c", path, cwd=tmp_path).strip()

    clone = tmp_path / "clone"
    git = ("git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", clone)
    run("git", "init", "--quiet", clone, cwd=tmp_path)
    for name in ("src/modeharvest/__init__.py", "src/modeharvest/util/__init__.py",
                 ".gitattributes", ".git_archival.txt"):  # fmt: skip
        (clone / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(PROJECT / name, clone / name)
    run(*git, "add", ".", cwd=tmp_path)
    run(*git, "commit", "--quiet", "-m", "first", cwd=tmp_path)
    assert version(clone).startswith(f"{RELEASE}+g")
    run(*git, "tag", "v7.1.0", cwd=tmp_path)
    assert version(clone) == "7.1.0"
    run(*git, "commit", "--quiet", "--allow-empty", "-m", "second", cwd=tmp_path)
    assert version(clone).startswith("7.1.0.post1+g")
    archive = tmp_path / "archive"
    run(*git, "archive", "--output", tmp_path / "a.tar", "v7.1.0", cwd=tmp_path)
    shutil.unpack_archive(tmp_path / "a.tar", archive, filter="data")
    assert version(archive) == "7.1.0"


def test_what_is_recorded_of_the_release_agrees() -> None:
    citation = (PROJECT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    assert f"version: {RELEASE}" in citation
    changes = (PROJECT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## \[(.+?)\]", changes, re.MULTILINE)[:2] == ["Unreleased", RELEASE]
    tagged = re.match(r"\d+(\.\d+)*$", modeharvest.__version__)
    assert not tagged or modeharvest.__version__ == RELEASE, "set RELEASE before the tag"
