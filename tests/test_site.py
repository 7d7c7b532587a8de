"""The documentation builds without a warning and without a network, and loads nothing."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import fields
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

from modeharvest.runs.case import table_of_kind

ROOT = Path(__file__).parents[1]
NO_NETWORK = dict.fromkeys(
    ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"), "http://[::1]:9"
)
LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}


class Links(HTMLParser):
    """What a page loads, what it links to, and the places that it has."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: set[str] = set()
        self.links: set[str] = set()
        self.places: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.places.add(given.get("id", ""))
        if tag in LOADED and given.get("rel") not in ("next", "prev", "canonical"):
            self.loads.add(given.get(LOADED[tag], ""))
        if tag == "a":
            self.links.add(given.get("href", ""))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as ``make docs`` does, by one process: it is not alone on the processors."""
    out = tmp_path_factory.mktemp("site") / "html"
    command = [sys.executable, "-m", "sphinx", "-b", "html", "-q", "-W", "--keep-going"]
    done = subprocess.run(
        [*command, ROOT / "docs", out],
        capture_output=True, text=True, check=False, env=os.environ | NO_NETWORK,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-5000:]
    return out


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Links]:
    """Every page of it, read."""
    found = {}
    for path in site.rglob("*.html"):
        found[path] = Links()
        found[path].feed(path.read_text("utf-8"))
    return found


@pytest.mark.dolfinx
def test_no_page_loads_anything_from_elsewhere(site: Path, pages: dict[Path, Links]) -> None:
    foreign = {
        (path.name, name)
        for path, page in pages.items()
        for name in page.loads
        if re.match(r"(\w+:)?//", name)
    }
    assert foreign == set()
    for style in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?(\w+:)?//", style.read_text("utf-8")), style


@pytest.mark.dolfinx
def test_every_link_leads_somewhere(pages: dict[Path, Links]) -> None:
    lost = set()
    for path, page in pages.items():
        for link in page.links | page.loads:
            target, _, place = unquote(link).partition("#")
            if re.match(r"\w+:|//", target) or not (target or place):
                continue
            there = (path.parent / target.partition("?")[0]).resolve() if target else path
            there = there / "index.html" if there.is_dir() else there
            if not there.exists() or (
                place and there in pages and place not in pages[there].places
            ):
                lost.add((path.name, link))
    assert lost == set()


@pytest.mark.dolfinx
def test_the_gallery_has_a_dozen_pictures_most_without_dolfinx(site: Path) -> None:
    programs = sorted((ROOT / "examples/gallery").glob("plot_*.py"))
    assert len(programs) >= 12
    needing = [
        p.name for p in programs if re.search(r"fem\.(bloch|lattice|simulate)", p.read_text())
    ]
    assert len(needing) <= 3
    for program in programs:
        page = (site / "generated/gallery" / f"{program.stem}.html").read_text("utf-8")
        assert f"sphx_glr_{program.stem}_001.png" in page


@pytest.mark.dolfinx
def test_a_page_shows_its_own_contents_and_the_titles_of_all(site: Path) -> None:
    page = (site / "generated/api/modeharvest.idic.solver.html").read_text("utf-8")
    before, _, contents = page.partition('class="toc-tree"')
    assert 'href="#modeharvest.idic.solver.assembly.NormalEquations"' in contents
    sidebar = before.partition('class="sidebar-tree"')[2].partition("</aside>")[0]
    for other in ("modeharvest.fem.path.html", "tutorials/photographs.html"):
        assert f'{other}"' in sidebar
    assert ".html#" not in sidebar


@pytest.mark.dolfinx
def test_equations_are_markup(site: Path) -> None:
    page = (site / "tutorials/virtual_experiment.html").read_text("utf-8")
    assert "<math" in page
    # Without a depth subscripts are on the base line in fonts without a table of mathematics.
    assert re.search(r'<msub><mpadded depth="0.25em"><mi[^>]*>v</mi></mpadded><mn>0</mn>', page)


@pytest.mark.dolfinx
@pytest.mark.parametrize(
    ("page", "texts"),
    [
        ("keys/virtual_experiment", ["fill_factor", "0 to 1", "1 to 16", "0 &lt; … &lt; 1.9"]),
        ("keys/photographs", ["formulation", "v0_degree", "mm/px"]),
        ("command_line", ["modeharvest benchmark make", "--whole-field", "TOML file"]),
        ("api/modeharvest.idic", ["correlate", "Kinematics", "ImagePair", "[source]",
                                  'title="modeharvest.util.arrays.FloatArray"']),
    ],
)  # fmt: skip
def test_references_are_drawn_from_the_code(site: Path, page: str, texts: list[str]) -> None:
    text = (site / f"generated/{page}.html").read_text("utf-8")
    assert [t for t in texts if t.lower() not in text.lower()] == []
    # Left where Sphinx can't parse a signature, and links no type in it.
    assert not re.findall(r"TypeAliasForwardRef|~modeharvest|&lt;factory&gt;", text)


@pytest.mark.dolfinx
def test_every_key_has_a_meaning_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs/_ext"))
    import key_pages

    models = [model for _, model, _ in key_pages.CASES.values()]
    tables = [table for model in models for table in key_pages.tables(model)]
    assert len(tables) > 50
    for path, cls in tables:
        rows = list(key_pages.keys(cls, path))
        meanings = [meaning for *_, meaning in rows]
        assert len(set(meanings)) == len(meanings), path
        for name, _, _, default, span, meaning in rows:
            assert meaning, (path, name)
            assert not {":class:", ":data:"} & set(re.findall(r":\w+:", meaning)), (path, name)
            assert "nan" not in default, (path, name)
            low, to, high = span.partition(" to ")
            assert not to or low != high, (path, name)
    named = {base.__name__: base for _, cls in tables for base in cls.__mro__}
    for name, own in key_pages.MEANINGS.items():
        assert own.keys() <= {f.name for f in fields(named[name])}, name


UNITLESS = {"", "-", "–", "fraction of full scale"}


@pytest.mark.dolfinx
def test_the_reference_has_the_keys_of_shipped_cases_with_their_units(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Keys in comments are options; a comment says a number's unit in brackets at its end."""
    monkeypatch.syspath_prepend(str(ROOT / "docs/_ext"))
    import key_pages

    compared = 0
    for case in sorted((ROOT / "src/modeharvest/cases").rglob("*.toml")):
        text = case.read_text("utf-8")
        kind = table_of_kind(tomllib.loads(text))
        (model,) = (m for _, m, _ in key_pages.CASES.values() if m.table == kind)
        known = {
            (path, row[0].strip("`")): row for path, cls in key_pages.tables(model)
            for row in key_pages.keys(cls, path)
        }  # fmt: skip
        table = ""
        for line in text.splitlines():
            if head := re.match(r"(?:# )?\[+([\w.]+)\]+ *(#|$)", line):
                table = head[1]
            elif (key := re.match(r"(?:# )?(\w+) = [^#]*# (.*)", line)) and key[1] != "kind":
                if table in ("", "unknowns"):  # names of parameters
                    continue
                _, what, unit, *_ = known[table, key[1]]
                stated = re.findall(r"\[([^\]\d\"'=,]{1,40})\]", key[2])
                if stated and "number" in what and unit != "``unit``":
                    assert unit == stated[-1] or {unit, stated[-1]} <= UNITLESS, (case, line)
                    compared += 1
    assert compared > 100


@pytest.mark.dolfinx
def test_no_page_differs_from_build_to_build(site: Path) -> None:
    """As by the address of an object, where its text would be."""
    for path in site.rglob("*.html"):
        assert not re.search(r"\bat 0x[0-9a-f]{6,}", path.read_text("utf-8")), path.name


@pytest.mark.dolfinx
def test_it_can_be_searched(site: Path) -> None:
    text = (site / "searchindex.js").read_text("utf-8")
    index = json.loads(text[text.index("{") : text.rindex("}") + 1])
    assert "tutorials/virtual_experiment" in index["docnames"]


@pytest.mark.dolfinx
def test_no_equation_has_a_command_that_nothing_has_drawn(site: Path) -> None:
    for path in site.rglob("*.html"):
        for equation in re.findall(r"<math.*?</math>", path.read_text("utf-8"), re.DOTALL):
            assert not re.search(r">\\\w", equation), (path.name, equation)


@pytest.mark.dolfinx
def test_options_keep_both_dashes_and_attributes_their_texts(site: Path) -> None:
    assert "–out" not in (site / "generated/command_line.html").read_text("utf-8")
    text = (site / "generated/api/modeharvest.idic.html").read_text("utf-8")
    assert "231 unknowns per field" in text
