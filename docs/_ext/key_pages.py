"""Pages of all keys of case files, made from the models: type, unit, default, range, meaning.

Ranges are found by trial: values of a key, with the defaults of all other keys, are tried until the
model's checks reject them.
"""

from __future__ import annotations

import ast
import inspect
import math
import re
import textwrap
import tomllib
import types
from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from rst import FOLDER, heading, table, write
from sphinx.application import Sphinx

from modeharvest.fem.materials import MATERIALS
from modeharvest.idic.finite_element.identification.identify import Unknown
from modeharvest.idic.photograph.geometry import SpecimenTable
from modeharvest.imaging.distortion.lens import CameraDistortion
from modeharvest.runs.case import Case, CaseModel
from modeharvest.runs.design import DesignCase
from modeharvest.runs.homogenization.case import MODES, FileMode, HomogenizationCase
from modeharvest.runs.identification.case import IdentificationCase, MeasuredData, OtherLaw
from modeharvest.runs.lattice.case import LATTICES, FileLattice, LatticeCase
from modeharvest.runs.photographs.case import Images, ImageScale, PhotographCase
from modeharvest.runs.photographs.machine_log import LogTable
from modeharvest.runs.study import KINDS, StudyCase

CASES: dict[str, tuple[str, type[CaseModel], str]] = {
    "virtual_experiment": ("A virtual experiment", Case, "run"),
    "photographs": ("Photographs of a test", PhotographCase, "harvest"),
    "lattice": ("An infinite lattice", LatticeCase, "bloch and modes"),
    "homogenization": ("A homogenized specimen", HomogenizationCase, "homogenize"),
    "identification": ("An identification", IdentificationCase, "identify"),
    "design": ("The design of a test", DesignCase, "design"),
    "study": ("A study", StudyCase, "study"),
}
CHOICES: dict[str, dict[str, type[Any]]] = {
    "material": MATERIALS, "lattice": LATTICES, "mode": MODES, "study": KINDS,
    "distortion": {"camera": CameraDistortion},
}  # fmt: skip
"""Tables whose keys depend on a key ``kind``: the classes of the kinds, by the table's name."""
EXAMPLES: dict[type[Any], dict[str, Any]] = {
    Images: {"reference": "reference.tif", "deformed": ("frame_1.tif",)},
    ImageScale: {"pixel_size": 0.01},
    SpecimenTable: {"cell_size": 1.9},
    FileLattice: {"path": "cell.msh", "pitch": 1.9},
    FileMode: {"path": "modes.h5"},
    LogTable: {"file": "log.csv"},
    CameraDistortion: {"fx": 2000.0, "fy": 2000.0, "cx": 500.0, "cy": 500.0},
    Unknown: {"start": 1.0, "bounds": (0.5, 2.0)},
    MeasuredData: {"reference": "reference.tif", "deformed": ("f.tif",), "pixel_size": 0.01},
}
"""Example values of the keys that have no default, by class."""
MEANINGS: dict[str, dict[str, str]] = tomllib.loads(
    Path(__file__).with_name("keys.toml").read_text("utf-8")
)
"""Meanings of keys whose classes have no separate docstring for each, by class."""
NUMBERS = sorted(
    sign * value
    for value in (0.0, 1e-9, 1e-6, 1e-3, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, *range(1, 17), 20.0, 30.0,
                  50.0, 70.0, 99.0, 101.0, 300.0, 999.0, 1001.0, 1e4 - 1, 1e4 + 1, 1e6, 1e9)
    for sign in ((1, -1) if value else (1,))
)  # fmt: skip
FARTHEST = 1e9


def docstrings(cls: type[Any]) -> dict[str, str]:
    """Meanings by field of a class and its bases: below fields, in docstrings, or ``MEANINGS``."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if base.__module__.startswith("modeharvest"):
            found |= below_fields(base) | in_parameters(base) | MEANINGS.get(base.__name__, {})
    return found


def below_fields(cls: type[Any]) -> dict[str, str]:
    """Docstrings below the fields of a class; neighbours share the one below the last of them."""
    body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body  # type: ignore[attr-defined]
    found: dict[str, str] = {}
    waiting: list[str] = []
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            waiting.append(node.target.id)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            found |= dict.fromkeys(waiting, inspect.cleandoc(str(node.value.value)))
            waiting = []
        else:
            waiting = []
    return found


def in_parameters(cls: type[Any]) -> dict[str, str]:
    """Meanings in the numpy-style block of parameters of a class' docstring."""
    text = inspect.cleandoc(cls.__doc__ or "")
    if "Parameters\n---" not in text:
        return {}
    block = re.split(r"\n\w+\n-+\n", text.split("Parameters\n")[1].partition("\n")[2])[0]
    found = {}
    for names, about in re.findall(r"^(\w[\w, ]*)(?: :[^\n]*)?\n((?: +[^\n]*\n?)+)", block, re.M):
        found |= {name.strip(): inspect.cleandoc(about) for name in names.split(",")}
    return found


def unit(name: str, about: str, kind: str) -> str:
    """Unit of a number by the ending of its name, or by the last brackets of its meaning."""
    if kind not in ("number", "whole number", "list") and "number" not in kind:
        return ""
    for ending, known in (("_px", "px"), ("_mm", "mm"), ("_N", "N"), ("_N_per_mm", "N/mm"),
                          ("_percent", "%"), ("seed", ""), ("degree", "")):  # fmt: skip
        if name.endswith(ending):
            return known
    found = re.findall(r"\[([^\]\d\"'=,]{1,40})\]", about)
    return "" if not found or found[-1] in ("-", "–") else str(found[-1])


def plain_type(hint: Any) -> str:
    """Name of the TOML type for a Python type."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return plain_type(inner[0])
    if origin is Literal:
        return "text"
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(plain_type(k) for k in inner if k is not type(None)))
    if origin in (tuple, list) or hint in (tuple, list):
        own = [plain_type(k) for k in inner if k is not Ellipsis]
        count = "" if Ellipsis in inner or not own else f" {len(own)}"
        many = f" {plural(own[0])}" if len(set(own)) == 1 else ""
        return f"list of{count}{many}" if count or many else "list"
    if origin is dict:
        return "table"
    names = {bool: "true or false", int: "whole number", float: "number", str: "text"}
    return names.get(hint, "table")


def plural(kind: str) -> str:
    """The name of a TOML type for several values."""
    word, of, rest = kind.partition(" of ")
    return word + ("" if word == "text" else "s") + of + rest


def literal(value: Any) -> str:
    """A default value in TOML's notation."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(literal(v) for v in value)}]"
    return f'"{value}"' if isinstance(value, str) else f"{value}"


@cache
def accepted(cls: type[Any], name: str) -> str:
    """The values of a key that the checks accept, with the prototype's values of other keys."""
    hint, made = get_type_hints(cls, include_extras=True)[name], prototype(cls)
    if made is None:
        return ""
    kinds = plain_type(hint)
    choices = [v for k in (hint, *get_args(hint)) if get_origin(k) is Literal for v in get_args(k)]
    if choices:
        return ", ".join(literal(v) for v in choices)
    if kinds == "text":
        message = refusal(made, name, "?")
        listed = re.search(r"among \[([^\]]*)\]|known are: (.*)", message)
        if listed:
            return (listed[1] or listed[2]).replace("'", '"')
        quoted = re.findall(r"'(\w+)'", message.partition(", got")[0])
        return ", ".join(f'"{word}"' for word in quoted)
    if "number" not in kinds or "list" in kinds:
        return ""
    whole = "whole" in kinds

    def is_fine(value: float) -> bool:
        return not refusal(made, name, int(value) if whole else value)

    return interval(is_fine, whole)


def refusal(prototype: Any, name: str, value: Any) -> str:
    """The error message of the checks for a value; "" if it is accepted."""
    try:
        replace(prototype, **{name: value})
    except (ValueError, TypeError, ArithmeticError, KeyError) as error:
        return str(error) or type(error).__name__
    return ""


def interval(is_fine: Callable[[float], bool], whole: bool) -> str:
    """Text of the interval of accepted numbers; "" if there is none or no bound."""
    tried = [n for n in NUMBERS if not whole or n == int(n)]
    fine = [n for n in tried if is_fine(n)]
    if not fine:
        return ""
    low = edge(is_fine, fine[0], [n for n in tried if n < fine[0]][-1:], whole)
    high = edge(is_fine, fine[-1], [n for n in tried if n > fine[-1]][:1], whole)
    if low is None and high is None:
        return ""
    if high is None:
        return f"{'≥' if is_fine(low) else '>'} {low:g}"
    if low is None:
        return f"{'≤' if is_fine(high) else '<'} {high:g}"
    if is_fine(low) and is_fine(high):
        return f"{low:g} to {high:g}"
    return f"{low:g} {'≤' if is_fine(low) else '<'} … {'≤' if is_fine(high) else '<'} {high:g}"


def edge(
    is_fine: Callable[[float], bool], fine: float, beyond: list[float], whole: bool
) -> float | None:
    """The bound between an accepted and a rejected number, by bisection; None if none rejected."""
    if not beyond:
        return None
    bad = beyond[0]
    for _ in range(60):
        middle = 0.5 * (fine + bad)
        if whole and abs(fine - bad) <= 1:
            return fine
        middle = float(round(middle)) if whole else middle
        if middle in (fine, bad):
            break
        fine, bad = (middle, bad) if is_fine(middle) else (fine, middle)
    return round(fine, 9) + 0.0


def prototype(cls: type[Any]) -> Any:
    """An instance of a class with defaults and ``EXAMPLES``; None if these don't suffice."""
    try:
        return cls(**EXAMPLES.get(cls, {}))
    except (TypeError, ValueError):
        return None


def nested(hint: Any) -> type[Any] | None:
    """The dataclass in a type hint, from which a table is read; None if there is none."""
    for kind in (hint, *get_args(hint), *(k for h in get_args(hint) for k in get_args(h))):
        if isinstance(kind, type) and is_dataclass(kind) and not issubclass(kind, CameraDistortion):
            return kind
    return None


def sections(cls: type[Any], path: str) -> Iterator[tuple[str, type[Any], str]]:
    """Tables of a class and below it: name in a file, class, and the ``kind`` that chooses it."""
    yield path, cls, ""
    hints = get_type_hints(cls, include_extras=True)
    for f in fields(cls):
        yield from below(f.name, hints[f.name], f"{path}.{f.name}")


def below(name: str, hint: Any, path: str) -> Iterator[tuple[str, type[Any], str]]:
    """The tables of a key whose value is a table; none for other keys."""
    cls = nested(hint)
    if (
        name in CHOICES
        and plain_type(hint) != "text"
        and (cls is None or get_origin(hint) is Annotated)
    ):
        for kind, cls in CHOICES[name].items():
            yield path, cls, kind
    elif cls is not None and cls is not OtherLaw:
        yield from sections(cls, path)


def keys(cls: type[Any], path: str) -> Iterator[tuple[str, ...]]:
    """A row for each key: name, type, unit, default, range, meaning."""
    about, hints = docstrings(cls), get_type_hints(cls, include_extras=True)
    for f in fields(cls):
        if not f.init or f.name.startswith("_"):
            continue
        hint = hints[f.name]
        if list(below(f.name, hint, "")):
            yield f"``{f.name}``", "table", "", "", "", f"Below: ``[{path}.{f.name}]``."
            continue
        kind = plain_type(hint)
        default = None if f.default is MISSING else f.default
        if f.default is MISSING and f.default_factory is not MISSING:
            default = f.default_factory()
        none = f.default is MISSING and f.default_factory is MISSING
        needed = none or (isinstance(default, float) and math.isnan(default))
        shown = "required" if needed else "none" if default is None else f"``{literal(default)}``"
        text = about.get(f.name, "") or f.metadata.get("label", "")
        of = f.metadata.get("unit") or unit(f.name, text, kind)
        span = accepted(cls, f.name)
        yield f"``{f.name}``", kind, of, shown, escaped(span), text


def escaped(text: str) -> str:
    """The text with the special characters of reStructuredText escaped."""
    return re.sub(r"([*_`|\\])", r"\\\1", text)


def tables(model: type[CaseModel]) -> Iterator[tuple[str, type[Any]]]:
    """All tables of a kind of case: name in a file, and class."""
    hints = get_type_hints(model, include_extras=True)
    for name in model.model_fields:
        yield from ((path, cls) for path, cls, _ in below(name, hints[name], name))


HEAD = "key", "type", "unit", "default", "range", "meaning"


def page(title: str, model: type[CaseModel], command: str, others: dict[type[Any], str]) -> str:
    """Page of all tables of a kind of case, with links to tables on an earlier page."""
    text = heading(title)
    for name in command.split(" and "):
        text += f"Run by ``modeharvest {name}``. "
    text += "Ranges are those that the checks accept beside the defaults of all other keys.\n\n"
    rows = [("``title``", "text", "", '``""``', "", "Title of the report.")]
    plain = []
    for name, field in model.model_fields.items():
        hint = get_type_hints(model, include_extras=True)[name]
        tables = list(below(name, hint, name))
        if not tables and name != "title":
            kind = plain_type(hint)
            about = docstrings(model).get(name, "")
            default = "none" if field.default is None else f"``{literal(field.default)}``"
            rows.append((f"``{name}``", kind, unit(name, about, kind), default, "", about))
        plain += tables
    text += table(HEAD, rows, "16 12 8 14 16 34")
    for path, cls, kind in plain:
        label = label_of(path, cls)
        if label in others:
            continue
        others[label] = title
        head = f"[{path}]" + (f' with ``kind = "{kind}"``' if kind else "")
        text += f".. _{label}:\n\n" + heading(head, "-")
        summary = inspect.cleandoc(cls.__doc__ or "").partition("\n\n")[0]
        text += summary.replace("\n", " ") + "\n\n"
        found = list(keys(cls, path))
        text += table(HEAD, found, "16 12 8 14 16 34") if found else ""
    shared = {path: label_of(path, cls) for path, cls, _ in plain
              if others[label_of(path, cls)] != title}  # fmt: skip
    if shared:
        text += heading("As in other kinds of cases", "-")
        text += "".join(f"- :ref:`[{path}] <{label}>`\n" for path, label in shared.items())
    return text


def label_of(path: str, cls: type[Any]) -> str:
    """Label for links to a table."""
    return f"keys-{path}-{cls.__name__}".lower().replace(".", "-")


def draw(app: Sphinx) -> None:
    """Write the pages into the documentation's source."""
    others: dict[Any, str] = {}
    for name, (title, model, command) in CASES.items():
        text = page(title, model, command, others)
        write(Path(app.srcdir) / FOLDER / "keys" / f"{name}.rst", text)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension: pages are written before Sphinx reads any."""
    app.connect("builder-inited", draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
