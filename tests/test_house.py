"""The shape of the project: how many modules, where what draws is, and the words it speaks."""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parent.parent
TOPS = [PROJECT / name for name in ("fem", "imaging", "idic", "validation", "src/modeharvest")]
MOST_ENTRIES = 12
MOST_MODULES, MOST_LINES = 172, 35_853
"""See docs/decisions/0014-size.md; of everything that has no bound of its own."""

HOMOGENIZATION = (
    "fem/lattice/micromorphic", "fem/lattice/cell.py", "fem/sparse_factor.py",
    "validation/homogenization.py", "src/modeharvest/runs/homogenization",
    "src/modeharvest/cli/homogenization.py",
    "src/modeharvest/report/homogenization.py", "src/modeharvest/report/figures/homogenization.py",
)  # fmt: skip
OWN_CELLS = (
    "fem/lattice/foreign.py", "fem/lattice/symmetry.py", "fem/lattice/primitive.py",
    "fem/lattice/geometries.py", "fem/bloch/degenerate.py", "fem/bloch/mesh_error.py",
    "src/modeharvest/runs/lattice/loads.py",
)  # fmt: skip
IDENTIFICATION = (
    "fem/path/sensitivity.py", "fem/path/parametric.py", "fem/path/parameters.py",
    "fem/path/equilibrium.py", "fem/specimen.py", "fem/meshing.py",
    "fem/hyperelastic.py", "idic/finite_element/identification", "idic/uncertainty/parameters.py",
    "src/modeharvest/runs/identification", "src/modeharvest/report/identification.py",
    "src/modeharvest/cli/identification.py",
)  # fmt: skip
DESIGN = (
    "validation/design.py", "validation/design_parameters.py", "imaging/speckle/statistics.py",
    "src/modeharvest/runs/design.py", "src/modeharvest/report/design.py",
    "src/modeharvest/cli/design.py",
)  # fmt: skip
CONTOURS = (
    "imaging/photographs/contour.py", "idic/finite_element/contours", "idic/photograph/plain",
    "idic/photograph/measure.py", "idic/photograph/speckled_edges.py",
    "src/modeharvest/runs/measure.py", "src/modeharvest/report/measure.py",
    "src/modeharvest/runs/photographs/pipeline.py", "src/modeharvest/runs/photographs/prepare.py",
    "src/modeharvest/runs/photographs/results.py", "src/modeharvest/report/photographs.py",
)  # fmt: skip
SEQUENCES = (
    "imaging/photographs/sequence.py", "validation/growth.py", "idic/photograph/matching",
    "src/modeharvest/runs/photographs/machine_log.py", "src/modeharvest/runs/photographs/watch.py",
    "src/modeharvest/runs/photographs/sequence.py", "src/modeharvest/report/figures/sequence.py",
    "src/modeharvest/runs/photographs/case.py",
    "src/modeharvest/util/stages.py", "src/modeharvest/cli/commands.py",
)  # fmt: skip
EXPLORE = ("src/modeharvest/report/explore.py",)
SHARED_DATA = (
    "src/modeharvest/runs/benchmark/crate.py", "src/modeharvest/runs/benchmark/standard.py",
    "src/modeharvest/cli/sharing.py",
)  # fmt: skip
GAUGES_AND_FORMATS = (
    "idic/local/tables.py", "idic/local/field.py", "idic/local/formats.py",
    "idic/local/export.py",
    "idic/photograph/gauges.py", "idic/photograph/axes.py",
    "idic/photograph/finished.py", "src/modeharvest/report/figures/on_photographs.py",
    "src/modeharvest/cli/fields.py",
)  # fmt: skip
FIRST_TOUCH = (
    "src/modeharvest/cli/demo.py", "src/modeharvest/cli/doctor.py",
    "src/modeharvest/runs/precompile.py",
)  # fmt: skip
WHOLE_DISPLACEMENT = (
    "idic/solver/free_edges.py", "idic/solver/sampling.py",
    "idic/finite_element/equations", "idic/finite_element/measure.py",
    "idic/finite_element/correlation.py", "idic/finite_element/mismatch.py",
    "idic/finite_element/cutoff.py", "idic/finite_element/fields.py", "idic/finite_element/mesh.py",
)  # fmt: skip
OWN_BOUNDS = {
    HOMOGENIZATION: (19, 3_820), OWN_CELLS: (7, 960), IDENTIFICATION: (19, 4_073),
    DESIGN: (6, 856),
    FIRST_TOUCH: (3, 350),
    CONTOURS: (17, 4_478), SEQUENCES: (12, 3_086), EXPLORE: (2, 306), SHARED_DATA: (3, 471),
    GAUGES_AND_FORMATS: (9, 2_067),
    WHOLE_DISPLACEMENT: (13, 2_720),
}  # fmt: skip
"""Modules and lines of capabilities that came later, with the modules that they are built into."""

PRIVATE_WORDS = """
    told judged leftover softness softened pushes unmatched trapped landed levelled marched
    walker desk nobodys atlas mistakes introduce grains sheet sentence sentences fact facts
    starts home finish rim outline outlines held ended said subject subjects scene scenes
"""
"""Parts of names that once meant something to this project alone."""
OTHERS_NAMES = {"HOME", "XDG_CACHE_HOME", "pytest_collection_finish"}

PRIVATE_PHRASES = (
    "what is left over",
    "what the model can't say",
    "what the measurement loses",
    "lit alike",
    "left over",
    "outline",
    "brought back",
    "the images as they are",
)


def modules() -> list[Path]:
    """Every module of the four folders and of the application, once."""
    found = {path.resolve() for top in TOPS for path in top.rglob("*.py")}
    return sorted(path for path in found if "__pycache__" not in path.parts)


def pages_of_code() -> list[Path]:
    """Those, and the tests, benchmarks, examples and scripts around them."""
    around = (PROJECT / name for name in ("tests", "benchmarks", "examples", "scripts"))
    return [*modules(), *sorted(path for folder in around for path in folder.rglob("*.py"))]


def names(module: Path) -> Iterator[tuple[int, str]]:
    """Every name in a module's code, with its line."""
    text = module.read_text(encoding="utf-8")
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME:
            yield token.start[0], token.string


def test_there_are_few_modules_and_lines() -> None:
    sizes = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules()}
    for places, (most_modules, most_lines) in OWN_BOUNDS.items():
        roots = [PROJECT / place for place in places]
        own = [path for path in sizes if any(path.is_relative_to(root) for root in roots)]
        lines = [sizes.pop(path) for path in own]
        assert len(lines) <= most_modules
        assert sum(lines) <= most_lines
    assert len(sizes) <= MOST_MODULES
    assert sum(sizes.values()) <= MOST_LINES


def test_a_folder_can_be_taken_in_at_a_glance() -> None:
    folders = {path.parent for path in modules()}
    for folder in folders:
        entries = {path.stem for path in folder.glob("*.py")} - {"__init__", "__main__"}
        entries |= {
            path.name for path in folder.iterdir() if path.is_dir() and any(path.glob("*.py"))
        }
        assert len(entries) <= MOST_ENTRIES, f"{folder.relative_to(PROJECT)}: {sorted(entries)}"


def test_no_two_classes_share_a_name() -> None:
    found = Counter(
        node.name
        for path in modules()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in found.items() if count > 1] == []


def test_every_module_says_what_it_is() -> None:
    for path in modules():
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        assert re.match(r"\S.*\.$", text.partition("\n")[0]), path.relative_to(PROJECT)


def test_names_are_the_field_s() -> None:
    private = set(PRIVATE_WORDS.split())
    found = [
        f"{path.relative_to(PROJECT)}:{line}: {name}"
        for path in pages_of_code()
        for line, name in names(path)
        if name not in OTHERS_NAMES
        and private & set(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().split("_"))
    ]
    assert found == []


def test_phrases_are_the_field_s() -> None:
    pages = [*modules(), *PROJECT.glob("*.md"), *(PROJECT / "docs").rglob("*.md")]
    found = [
        f"{path.relative_to(PROJECT)}: {phrase}"
        for path in pages
        for phrase in PRIVATE_PHRASES
        if phrase in " ".join(path.read_text(encoding="utf-8").lower().split())
    ]
    assert found == []


def test_the_architecture_page_is_drawn_from_the_code() -> None:
    script = [sys.executable, PROJECT / "scripts/architecture.py", "--check"]
    assert subprocess.run(script, check=False).returncode == 0, "run scripts/architecture.py"


@pytest.mark.parametrize(
    "line", ["import modeharvest", "from modeharvest.fem.specimen import Specimen"]
)
def test_what_does_not_draw_loads_no_plotting(line: str) -> None:
    drawing = {"matplotlib", "pandas", "rich", "jinja2"}
    script = f"{line}; import sys; print(*{drawing} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == []
