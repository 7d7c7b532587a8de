"""Pages of the Python API, one for each package, generated from docstrings at every build."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from docutils.nodes import Element, bullet_list
from rst import FOLDER, heading, write
from sphinx.application import Sphinx
from sphinx.domains.python import PythonDomain
from sphinx.environment import BuildEnvironment

SOURCE = Path(__file__).resolve().parents[2] / "src" / "modeharvest"
COMMANDS = "cli"
"""The package of the commands, which are documented on a separate page."""
DEPTH = 3
"""Levels in an API page's contents: the package, its modules, their classes and functions."""


class IndexedDomain(PythonDomain):
    """The Python domain with an index by the last part of names; Sphinx searches all objects."""

    _count, _by_last_name = -1, dict[str, dict[str, Any]]()

    def find_obj(
        self, env: BuildEnvironment, modname: str, classname: str, name: str, *how: Any
    ) -> list[tuple[str, Any]]:
        """Find objects as the base class does, among those with the same last part of the name."""
        every = self.data["objects"]
        if len(every) != self._count:
            self._count, self._by_last_name = len(every), {}
            for whole, entry in every.items():
                alike = self._by_last_name.setdefault(whole.rpartition(".")[2], {})
                alike[whole] = entry
        last = name.removesuffix("()").rpartition(".")[2]
        self.data["objects"] = self._by_last_name.get(last, {})
        try:
            return super().find_obj(env, modname, classname, name, *how)
        finally:
            self.data["objects"] = every


def packages(folder: Path = SOURCE) -> dict[str, list[str]]:
    """Public modules of each package in a folder, by its dotted name, except the commands'."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.name != COMMANDS and (path / "__init__.py").exists():
            name = ".".join(path.relative_to(SOURCE.parent).parts)
            found[name] = sorted(p.stem for p in path.glob("*.py") if p.stem[0] != "_")
            found |= packages(path)
    return found


def first_line(path: Path) -> str:
    """First line of a module's docstring."""
    text = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
    return text.partition("\n")[0]


def public_names() -> str:
    """Page of the names that ``import modeharvest as mh`` provides."""
    import modeharvest

    page = heading("modeharvest")
    page += "What most scripts need, after ``import modeharvest as mh``.\n\n"
    for name, module in sorted(modeharvest._HOMES.items()):
        page += f"- ``mh.{name}``: :py:obj:`modeharvest.{module}.{name}`\n"
    return page


def draw(app: Sphinx) -> None:
    """Write the pages into the documentation's source."""
    folder = Path(app.srcdir) / FOLDER / "api"
    write(folder / "modeharvest.rst", public_names())
    listed = "- :doc:`modeharvest </generated/api/modeharvest>`: what most scripts need.\n"
    for name, modules in packages().items():
        init = SOURCE.parent.joinpath(*name.split("."), "__init__.py")
        defines = any(isinstance(n, ast.FunctionDef) for n in ast.parse(init.read_text()).body)
        page = heading(name.partition(".")[2]) + f"Package ``{name}``.\n\n"  # no word to break
        page += f".. automodule:: {name}" if defines else first_line(init)
        for module in modules:
            page += "\n\n" + heading(module, "-") + f".. automodule:: {name}.{module}"
        write(folder / f"{name}.rst", page + "\n")
        listed += f"- :doc:`{name} </generated/api/{name}>`: {first_line(init)}\n"
    write(folder / "packages.inc", listed)


def shorten_contents(_: Sphinx, env: BuildEnvironment) -> None:
    """Remove members of classes from the contents, which every page's sidebar contains."""
    for name, contents in env.tocs.items():
        if name.startswith(f"{FOLDER}/api/"):
            prune(contents, DEPTH)


def prune(contents: Element, depth: int) -> None:
    """Remove the items of nested lists that are deeper than ``depth``."""
    for item in contents.children:
        for part in [part for part in item.children if isinstance(part, bullet_list)]:
            if depth > 1:
                prune(part, depth - 1)
            else:
                item.remove(part)


def leave_titles(app: Sphinx, page: str, *_: Any) -> None:
    """Hide the contents of other pages while furo makes a sidebar of their titles.

    Otherwise Sphinx copies the contents of all pages for every page, only to remove them later.
    """
    for name in app.env.metadata.keys() - app.env.toctree_includes.keys() - {page}:
        app.env.metadata[name]["tocdepth"] = 1


def show_contents(app: Sphinx, *_: Any) -> None:
    """Undo :func:`leave_titles` before the contents of the next page are made."""
    for about in app.env.metadata.values():
        about.pop("tocdepth", None)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension: pages are written before Sphinx reads any."""
    app.add_domain(IndexedDomain, override=True)
    app.connect("builder-inited", draw)
    app.connect("env-updated", shorten_contents)
    app.connect("html-page-context", leave_titles, priority=400)  # furo's is 500
    app.connect("html-page-context", show_contents, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
