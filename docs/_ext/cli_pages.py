"""The page of the command line, generated from the commands at every build of the site."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from rst import FOLDER, heading, table, write
from sphinx.application import Sphinx

# A command in bold type, in quotes, or as an example; an option: two dashes of text become one.
LITERAL = re.compile(
    r"\[bold\](.*?)\[/bold\]|'(modeharvest [^']*)'|(?<=For example: )(modeharvest .*)"
    r"|(?<![\w-])(--[a-z]+(?:-[a-z]+)*(?:=\w+)?)"
)


def plain(text: str | None) -> str:
    """Help text in reStructuredText, with commands and options as literals."""
    parts = LITERAL.split(text or "")  # text, and a literal in one of four groups, in turn
    made = [re.sub(r"([*_`|\\])", r"\\\1", part) for part in parts[::5]]
    found = [next(filter(None, parts[k : k + 4])) for k in range(1, len(parts), 5)]
    for k, literal in enumerate(found):
        made[k] += f"``{' '.join(literal.split())}``"
    return "".join(made)


def parameters(command: Any) -> Iterator[tuple[str, str, str]]:
    """Names, default and help text of each argument and option of a command."""
    for parameter in command.params:
        if parameter.name == "help":
            continue
        is_option = parameter.param_type_name == "option"
        names = [*parameter.opts, *parameter.secondary_opts]
        name = " / ".join(names) if is_option else (parameter.metavar or parameter.name.upper())
        if is_option and not parameter.is_flag:
            name += f" {parameter.metavar or (parameter.name or '').upper()}"
        default = parameter.default
        shown = "required" if parameter.required else str(default)
        if default is None or (is_option and default is False) or "UNSET" in str(default):
            shown = "required" if parameter.required else ""
        yield f"``{name}``", shown and plain(shown), plain(getattr(parameter, "help", ""))


def section(name: str, command: Any, mark: str = "-") -> str:
    """Section of a command and its subcommands: help text, arguments, options."""
    page = heading(name, mark) + plain(command.help) + "\n\n"
    if hasattr(command, "commands"):
        return page + "".join(section(f"{name} {n}", c, "~") for n, c in command.commands.items())
    rows = list(parameters(command))
    head = "argument or option", "default", "what it is"
    return page + (table(head, rows, "34 14 52") if rows else "")


def draw(app: Sphinx) -> None:
    """Write the page into the documentation's source."""
    from modeharvest.cli.root import app as root

    command = typer.main.get_command(root)
    page = heading("Command line") + plain(command.help) + "\n\n" + plain(command.epilog) + "\n\n"
    page += "In a clone that isn't installed, ``scripts/env modeharvest …`` does the same.\n\n"
    for name, member in command.commands.items():  # type: ignore[attr-defined]
        page += section(f"modeharvest {name}", member)
    write(Path(app.srcdir) / FOLDER / "command_line.rst", page)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension: the page is written before Sphinx reads any."""
    app.connect("builder-inited", draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
