"""Pages of the documentation: every code block works, and none is long without a figure."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import typer
from PIL import Image
from typer.testing import CliRunner

import modeharvest as mh
from modeharvest.cli.root import app
from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.sensor import quantise
from modeharvest.runs.case import case_text, shipped_cases, shipped_solution

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(p for p in DOCS.rglob("*.md") if not {"generated", "_build"} & set(p.parts))
MOST_WORDS = 1200
"""Of a page without a figure."""

RUN_ELSEWHERE = {
    "bloch": "test_fem_bloch", "distortion": "test_distortion_page",
    "extending": "test_extending", "families": "test_fem_families", "idic": "test_idic_recipe",
    "imaging": "test_imaging_page",
    "lattices": "test_fem_cell_files", "modes": "test_fem_postbuckling",
    "own_cell": "test_fem_cell_files",
    "photographs": "test_photographs_page",
}  # fmt: skip
"""Pages whose Python is run by tests that also look at what it finds."""
COARSER = {
    "fem": {"mesh_size=0.2": "mesh_size=0.5"},
    "homogenization": {"size=0.2": "size=0.5"},
    "independence": {"overlays=()": "overlays=(), divisions=6", "1 / 12": "1 / 6"},
    "photographs": {
        "pixel_size=0.03": "pixel_size=0.06",
        "pixel_size = 0.03 ": "pixel_size = 0.06 ",
    },
    "score_my_code": {
        "pixel_size=0.04": "pixel_size=0.06",
        "num_warp=20": "num_warp=5",
        "make paper-virtual": "make coarse.toml --solution solution.h5",
    },
    "virtual_experiment": {
        "pixel_size=0.03": "pixel_size=0.07",
        "run paper-virtual": "run coarse.toml --solution solution.h5",
    },
}
"""What is replaced in a page's code for it to take a second or two."""


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
    images = mh.make_images(solution, spec, tmp_path_factory.mktemp("images"), [0.128])
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
    (folder / "out/test/results").mkdir(parents=True)
    known["result"].write(folder / "out/test/results/frame_2.json")
    known["x"], known["y"] = np.meshgrid(pair.grid.x, pair.grid.y)
    return folder, known


@pytest.mark.dolfinx
@pytest.mark.usefixtures("undrawn_pictures")
@pytest.mark.parametrize("page", RUN_HERE, ids=names(RUN_HERE))
def test_the_code_of_a_page_runs_from_top_to_bottom(
    page: Path, given: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from modeharvest.fem import materials

    mpl.use("agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(materials, "MATERIALS", dict(materials.MATERIALS))
    found: dict[str, Any] = {"__name__": "page"}
    if "tutorials" in page.parts:  # these make all that they need
        shutil.copy(shipped_solution("paper-virtual"), "solution.h5")
        case = case_text("paper-virtual").replace("pixel_size = 0.01 ", "pixel_size = 0.07 ")
        Path("coarse.toml").write_text(case, "utf-8")
    else:
        folder, known = given
        found |= known
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    text = page.read_text("utf-8")
    assert all(fine in text for fine in COARSER.get(page.stem, {}))
    for language, code in re.findall(r"^```(python|toml|sh)\n(.*?)^```", text, re.DOTALL | re.M):
        for fine, coarse in COARSER.get(page.stem, {}).items():
            code = code.replace(fine, coarse)
        if language == "toml":  # as the tutorial says, it is written to this file
            (tmp_path / "experiment.toml").write_text(code, "utf-8")
        elif language == "python":
            exec(compile(code, str(page), "exec", dont_inherit=True), found)
        elif "tutorials" in page.parts:
            for line in code.splitlines():
                done = CliRunner().invoke(app, shlex.split(line)[1:])
                assert done.exit_code == 0, (line, done.output)


def test_a_study_of_one_s_own_is_a_program(tmp_path: Path) -> None:
    (code,) = blocks(DOCS / "how-to/studies.md", "python")
    (tmp_path / "mine.py").write_text(code + "    print(sum(table['square']))\n", "utf-8")
    paths = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "mine.py"], cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.split() == ["28"], done.stderr


def keys_of(table: dict[str, Any], path: str = "") -> Iterator[tuple[str, str]]:
    """The keys of a table and of those in it: path of the table, key."""
    for key, value in table.items():
        yield path, key
        for one in value if isinstance(value, list) else [value]:
            if isinstance(one, dict):
                yield from keys_of(one, f"{path}.{key}".strip("."))


@pytest.mark.dolfinx
def test_the_toml_of_the_pages_has_keys_of_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    import key_pages

    known: dict[str, set[str]] = {"": set()}
    for _, model, _ in key_pages.CASES.values():
        known[""] |= set(model.model_fields)
        for path, cls in key_pages.tables(model):
            names = {row[0].strip("`") for row in key_pages.keys(cls, path)}
            known[path] = known.get(path, {"kind"}) | names
    for page in PAGES:
        for block in blocks(page, "toml"):
            for path, key in keys_of(tomllib.loads(block)):
                assert key in known[path], (page.stem, path, key)


def commands(page: Path) -> Iterator[list[str]]:
    """The words of a page's commands: lines of shell, and what stands in the text as code."""
    text = page.read_text("utf-8")
    lines = "".join(blocks(page, "sh")).replace("\\\n", " ").splitlines()
    text = re.sub(r"^```(?!\{figure).*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    lines += [" ".join(code.split()) for code in re.findall(r"(?<!`)`([^`]+)`(?!`)", text)]
    for line in lines:
        try:
            first = re.split(r"\s[>|]\s|\s&&\s", line.replace("'", "’"))[0]
            words = shlex.split(first, comments=True)
        except ValueError:  # code of another language
            continue
        while words and words[0] in ("scripts/env", "python", "mpirun", "-n", "2"):
            del words[0]
        if len(words) > 1 or (words and "/" in words[0]):
            yield words


COMMANDED = [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]


@pytest.mark.parametrize("page", COMMANDED, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_the_commands_of_a_page_exist_with_those_options(page: Path) -> None:
    targets = re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    for name, *words in commands(page):
        options = {w.partition("=")[0] for w in words if w.startswith("--")} - {"--help"}
        if name == "make":
            assert words[0] in targets
        elif re.match(r"(benchmarks|examples|scripts)/\w", name):
            found = [path for path in ROOT.glob(name) if path.is_file()]
            assert found or (ROOT / name).is_dir(), name
            beside = found[0].parent.glob("*.py") if name.endswith("/run") else ()
            source = "".join(path.read_text("utf-8") for path in (*found, *beside))
            assert [option for option in options if option not in source] == [], name
        elif name == "modeharvest":
            command: Any = typer.main.get_command(app)
            while hasattr(command, "commands") and words and not words[0].startswith("-"):
                command = command.commands[words.pop(0)]
            known = {o for p in command.params for o in (*p.opts, *p.secondary_opts)}
            assert options <= known | {"--version"}, words
            takes_case = command.params[:1] and command.params[0].name == "case"
            if takes_case and words and re.fullmatch(r"[a-z][a-z-]+", words[0]):
                assert words[0] in shipped_cases(), words


def test_pages_that_are_run_elsewhere_are() -> None:
    for page, test in RUN_ELSEWHERE.items():
        text = (ROOT / f"tests/{test}.py").read_text("utf-8")
        assert f"{page}.md" in text, page
        assert "exec(" in text, page


def words(page: Path) -> int:
    """Of the text and its tables, code aside."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    return len(re.findall(r"\w[\w'’-]*", text))


def test_no_page_is_long_without_a_figure() -> None:
    long = {
        page.stem for page in PAGES
        if "decisions" not in page.parts and page.name != "changes.md"
        and words(page) > MOST_WORDS
        and "```{figure}" not in page.read_text("utf-8")
    }  # fmt: skip
    assert long == set()


@pytest.mark.parametrize("page", PAGES, ids=names(PAGES))
def test_a_figure_says_how_it_is_made(page: Path) -> None:
    text = page.read_text("utf-8")
    assert "![" not in text, "a figure with a caption"
    for figure in re.findall(r"^```\{figure\}[^\n]*\n(.*?)^```", text, re.S | re.M):
        assert re.search(r"`[^`]*(modeharvest|python|make) [^`]*`", figure), figure
