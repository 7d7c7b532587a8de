"""Pages of the documentation: every code block works, and none is long without a figure."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import typer
from PIL import Image

import modeharvest as mh
from modeharvest.cli.root import app
from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.sensor import quantise
from modeharvest.runs.case import shipped_solution

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(p for p in DOCS.rglob("*.md") if not {"generated", "_build"} & set(p.parts))
MOST_WORDS = 1200
"""Of a page without a figure."""

RUN_ELSEWHERE = {
    "bloch": "test_fem_bloch", "distortion": "test_distortion_page",
    "extending": "test_extending", "families": "test_fem_families", "fem": "test_fem_materials",
    "harvest": "test_harvest_example", "idic": "test_idic_recipe", "imaging": "test_imaging_page",
    "lattices": "test_fem_cell_files", "modes": "test_fem_postbuckling",
    "own_cell": "test_fem_cell_files",
    "photographs": "test_photographs_page",
}  # fmt: skip
"""Pages whose Python is run by tests that also look at what it finds."""
COARSER = {
    "homogenization": {"size=0.2": "size=0.5"},
    "independence": {"overlays=()": "overlays=(), divisions=6", "1 / 12": "1 / 6"},
    "photographs": {
        "pixel_size=0.03": "pixel_size=0.06",
        "pixel_size = 0.03 ": "pixel_size = 0.06 ",
    },
    "score_my_code": {"pixel_size=0.04": "pixel_size=0.06", "num_warp=20": "num_warp=5"},
    "virtual_experiment": {"pixel_size=0.03": "pixel_size=0.07"},
}
"""What is replaced in a page's Python and TOML for it to take a second or two."""


def blocks(page: Path, language: str) -> list[str]:
    """The code of a page in a language."""
    pattern = rf"^```{language}\n(.*?)^```"
    return re.findall(pattern, page.read_text("utf-8"), re.DOTALL | re.MULTILINE)


RUN_HERE = [
    page for page in PAGES
    if blocks(page, "python") and page.stem != "studies"
    and (page.stem not in RUN_ELSEWHERE or "tutorials" in page.parts)
]  # fmt: skip


def names(pages: list[Path]) -> list[str]:
    return [page.relative_to(DOCS).as_posix() for page in pages]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Files and names that pages begin with: an image pair, its result, a field of another code."""
    folder = tmp_path_factory.mktemp("given")
    solution = mh.Solution.read(shipped_solution("paper-virtual"))
    spec = mh.ImagingSpec(pixel_size=0.05)
    images = mh.make_images(solution, spec, folder / "images", [0.128])
    pair = images.pair(0.128)
    write_image(folder / "reference.tif", quantise(pair.reference, 8))
    write_image(folder / "deformed.tif", quantise(pair.deformed, 8))
    Image.fromarray((255 * images.mask()).astype("uint8")).save(folder / "mask.png")
    known = {
        "pair": pair, "f": pair.reference, "g": pair.deformed, "grid": pair.grid,
        "mask": pair.mask, "deformed_mask": pair.deformed_mask, "material": mh.Ogden(),
        "result": mh.correlate(pair, mh.Ansatz.square(solution.specimen)),
    }  # fmt: skip
    assert pair.truth is not None
    rows, cols = np.nonzero(images.mask() & (np.indices(pair.grid.shape) % 5 == 0).all(axis=0))
    u = pair.truth.displacement[rows, cols] / spec.pixel_size
    table = np.column_stack([cols, rows, u[:, 0], -u[:, 1], np.full(rows.size, 0.01)])
    np.savetxt(folder / "vic.csv", table, "%.6g", ",", header="x,y,u,v,sigma", comments="")
    return folder, known


@pytest.mark.dolfinx
@pytest.mark.usefixtures("undrawn_pictures")
@pytest.mark.parametrize("page", RUN_HERE, ids=names(RUN_HERE))
def test_the_python_of_a_page_runs_from_top_to_bottom(
    page: Path, given: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from modeharvest.fem import materials

    mpl.use("agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(materials, "MATERIALS", dict(materials.MATERIALS))
    found: dict[str, Any] = {"__name__": "page"}
    if "tutorials" not in page.parts:  # these make all that they need
        folder, known = given
        found |= known
        for file in folder.glob("*.*"):
            shutil.copy(file, tmp_path)
    text = page.read_text("utf-8")
    assert all(fine in text for fine in COARSER.get(page.stem, {}))
    for language, code in re.findall(r"^```(python|toml)\n(.*?)^```", text, re.DOTALL | re.M):
        for fine, coarse in COARSER.get(page.stem, {}).items():
            code = code.replace(fine, coarse)
        if language == "toml":  # as the tutorial says, it is written to this file
            (tmp_path / "experiment.toml").write_text(code, "utf-8")
        else:
            exec(compile(code, str(page), "exec", dont_inherit=True), found)


def test_a_study_of_one_s_own_is_a_program(tmp_path: Path) -> None:
    (code,) = blocks(DOCS / "how-to/studies.md", "python")
    (tmp_path / "mine.py").write_text(code + "    print(sum(table['square']))\n", "utf-8")
    paths = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "mine.py"], cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.split() == ["28"], done.stderr


@pytest.mark.parametrize("page", PAGES, ids=names(PAGES))
def test_the_toml_of_a_page_is_toml(page: Path) -> None:
    for block in blocks(page, "toml"):
        tomllib.loads(block)


@pytest.mark.parametrize("page", PAGES, ids=names(PAGES))
def test_the_commands_of_a_page_exist_with_those_options(page: Path) -> None:
    root = typer.main.get_command(app)
    for line in "".join(blocks(page, "sh")).replace("\\\n", " ").splitlines():
        words = shlex.split(re.split(r"\s[>|]\s", line.replace("'", "’"))[0], comments=True)
        if "modeharvest" not in words or words[0] in ("python3", "pip"):
            continue
        words = words[words.index("modeharvest") + 1 :]
        if words and words[0].isalpha() and "|" not in line:
            command: Any = root
            while hasattr(command, "commands"):
                command = command.commands[words.pop(0)]
            known = {o for p in command.params for o in (*p.opts, *p.secondary_opts)} | {"--help"}
            options = {w.partition("=")[0] for w in words if w.startswith("--")}
            assert options <= known, line


def test_pages_that_are_run_elsewhere_are() -> None:
    for page, test in RUN_ELSEWHERE.items():
        text = (ROOT / f"tests/{test}.py").read_text("utf-8")
        assert f"{page}.md" in text, page


def words(page: Path) -> int:
    """Of the text and its tables, code aside."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    return len(re.findall(r"\w[\w'’-]*", text))


def test_no_page_is_long_without_a_figure() -> None:
    long = {
        page.stem for page in PAGES
        if "decisions" not in page.parts and page.name != "changes.md"
        and words(page) > MOST_WORDS
        and not re.search(r"!\[|```\{figure\}", page.read_text("utf-8"))
    }  # fmt: skip
    assert long == set()


@pytest.mark.parametrize("page", PAGES, ids=names(PAGES))
def test_a_figure_says_how_it_is_made(page: Path) -> None:
    for figure in re.findall(
        r"^```\{figure\}[^\n]*\n(.*?)^```", page.read_text("utf-8"), re.S | re.M
    ):
        assert re.search(r"`[^`]*(modeharvest|python|make) [^`]*`", figure), figure
