"""Text in reports: captions filled with values, number formats, contents of table cells."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from math import isfinite
from string import Formatter
from typing import Any

from markupsafe import Markup

from modeharvest.fem.materials import Ogden

NBSP = "\N{NO-BREAK SPACE}"
_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?(e[+-]\d+)?")
_JOINED = r" (?=(?:%|px|mm|±)(?!\w))|(?<=±) |(?<=\d) (?=l\b|· 10)|(?<=\d ·) (?=10)"
_INDICES = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


@cache
def captions() -> dict[str, dict[str, Any]]:
    """Content of ``captions.toml``, read once per process."""
    source = resources.files("modeharvest.report").joinpath("captions.toml")
    return tomllib.loads(source.read_text("utf-8"))


def caption(name: str, **values: object) -> dict[str, Any]:
    """Title, caption, lead etc. in table ``name`` of ``captions.toml``, with values filled in."""
    words = captions()[name].items()
    return {k: Markup(v).format(**values) if isinstance(v, str) else v for k, v in words}


@dataclass(frozen=True)
class _Readable:
    """A value formatted by a function; a format specification is its number of digits."""

    written: Callable[..., str]
    value: Any

    def __format__(self, digits: str) -> str:
        return self.written(self.value, *map(int, digits.split()))


class Template(Formatter):
    """Fills values into plain text: ``{x!n:3}`` by :func:`number`, ``{x!p}`` by :func:`percent`."""

    def convert_field(self, value: Any, conversion: Any) -> Any:
        """Apply the conversions n, p and z (four digits, keeping zeros at the end)."""
        ways: dict[str, Callable[..., str]] = {"n": number, "p": percent}
        ways["z"] = lambda x: f"{x:#.4g}" if 1e-3 <= abs(x) < 1e3 else number(x)  # 1.530
        if conversion in ways:
            return _Readable(ways[conversion], value)
        return super().convert_field(value, conversion)


def text_of(name: str, /, **values: object) -> str:
    """Plain text ``name`` in table ``text`` of ``captions.toml``, with values filled in."""
    return Template().vformat(captions()["text"][name], (), values)


@dataclass(frozen=True)
class Mark:
    """A word on a coloured label: green if good, red if not."""

    text: str
    good: bool


@dataclass(frozen=True)
class Measured:
    """A value with its standard errors: None if not known, infinite if not determined."""

    value: float
    errors: tuple[float | None, ...] = ()
    decimals: int = 5

    def __str__(self) -> str:
        return " ".join([fixed(self.value, self.decimals), *self.error_texts])

    @property
    def error_texts(self) -> list[str]:
        """Each standard error as text: "± 0.00020", or "< 0.00001" if it would be rounded to 0."""
        least = 0.5 * 10.0**-self.decimals
        return [
            "± –" if error is None or error != error
            else "± ∞" if not isfinite(error)
            else f"± {error:.{self.decimals}f}" if error >= least or error == 0.0
            else f"< {2 * least:.{self.decimals}f}"
            for error in self.errors
        ]  # fmt: skip


Cell = str | float | int | None | Mark | Measured


def number(value: Any, digits: int | None = None) -> str:
    """Format a number: integers in full, others with four digits at most, or as 1.2 · 10⁻⁵.

    ``digits``: number of significant digits to which the number is rounded first.
    """
    if value is None:
        return "–"
    if isinstance(value, Mark):
        return value.text
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return typeset(str(value)) if _NUMBER.fullmatch(str(value)) else str(value)
    if not isfinite(value):
        return "∞" if value > 0 else "–"
    if digits is not None:
        value = float(f"{value:.{digits}g}")
    if value == int(value) and abs(value) < 1e9:
        return f"{int(value):,}".replace(",", "\u202f").replace("-", "−")
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.4g}".replace("-", "−")
    mantissa, power = f"{value:.1e}".split("e")
    return f"{mantissa} · {ten_to(int(power))}".replace("-", "−")


def ten_to(power: int) -> str:
    """Format a power of ten with a superscript exponent."""
    return "10" + str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def fixed(value: float, decimals: int = 5) -> str:
    """Format with a fixed number of decimals and a typographic minus, but no minus before zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−")


def percent(value: float | None, digits: int = 4) -> str:
    """Format a ratio or a strain [-] in percent, including the percent sign."""
    if value is None or value != value:
        return "–"
    return f"{100 * value:.{digits}g}{NBSP}%".replace("-", "−")


def material_text(table: Mapping[str, Any]) -> str:
    """Describe a material's kind and constants, and whether they are the default ones.

    ``table``: ``kind`` and the constants, as in a case or in a solution's ``info``.
    """
    constants = {name: value for name, value in table.items() if name != "kind"}
    values = ", ".join(f"{name} {_plain_number(value)}" for name, value in constants.items())
    usual = {name: _plain_number(value) for name, value in vars(Ogden()).items()}
    is_usual = {name: _plain_number(value) for name, value in constants.items()} == usual
    return f"{'default ' * is_usual}material {table['kind']}: {values} (moduli in MPa)"


def _plain_number(value: Any) -> str:
    return ", ".join(f"{v:g}" for v in value) if isinstance(value, list | tuple) else f"{value:g}"


def typeset(text: str) -> str:
    """Text as it is printed: minus signs, powers of ten, indices of v and φ, no-break spaces."""
    new = re.sub(r"(?<![\w.])(\d[\d.]*)e([+-]?\d+)\b", _power, text)
    new = re.sub(r"(?<![\w./-])(v|phi|φ)(\d)(?![\w/]|\.\w)", _symbol, new)
    new = re.sub(r"(?<=\d) x (?=\d)", f"{NBSP}×{NBSP}", new)
    new = re.sub(r"(?<![\w.)/-])-(?=\d)", "−", new)
    return type(text)(re.sub(_JOINED, NBSP, new))


def indexed(name: str) -> str:
    """A parameter's name with its number as an index: "a₁" for "a1"."""
    return re.sub(r"\b(\w)(\d+)\b", _symbol, name)


def _power(found: re.Match[str]) -> str:
    return f"{found[1]} · {ten_to(int(found[2]))}".removeprefix("1 · ")


def _symbol(found: re.Match[str]) -> str:
    return found[1].replace("phi", "φ") + found[2].translate(_INDICES)
