"""The Python API, a page for each package, drawn from docstrings when the site is built."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from rst import FOLDER, heading, write
from sphinx.application import Sphinx

SOURCE = Path(__file__).resolve().parents[2] / "src" / "modeharvest"


def packages(folder: Path = SOURCE) -> dict[str, list[str]]:
    """Packages by dotted names, and the modules of each."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.is_dir() and (path / "__init__.py").exists():
            name = ".".join(path.relative_to(SOURCE.parent).parts)
            found[name] = sorted(p.stem for p in path.glob("*.py") if p.stem[0] != "_")
            found |= packages(path)
    return found


def first_line(path: Path) -> str:
    """Of a module's docstring."""
    text = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
    return text.partition("\n")[0]


def public_names() -> str:
    """What ``import modeharvest as mh`` gives, as a page."""
    import modeharvest

    page = heading("modeharvest")
    page += "What most scripts need, after ``import modeharvest as mh``.\n\n"
    for name, module in sorted(modeharvest._HOMES.items()):
        page += f"- ``mh.{name}``: :py:obj:`modeharvest.{module}.{name}`\n"
    return page


def draw(app: Sphinx) -> None:
    """Write the pages."""
    folder = Path(app.srcdir) / FOLDER / "api"
    write(folder / "modeharvest.rst", public_names())
    for name, modules in packages().items():
        init = SOURCE.parent.joinpath(*name.split("."), "__init__.py")
        defines = any(isinstance(n, ast.FunctionDef) for n in ast.parse(init.read_text()).body)
        page = heading(name) + (f".. automodule:: {name}" if defines else first_line(init))
        for module in modules:
            page += "\n\n" + heading(module, "-") + f".. automodule:: {name}.{module}"
        write(folder / f"{name}.rst", page + "\n")


def setup(app: Sphinx) -> dict[str, Any]:
    """Have the pages written before any is read."""
    app.connect("builder-inited", draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
