"""Pages of one file: the frame and style that all reports share, and numbers for readers."""

from __future__ import annotations

from importlib import resources
from math import isfinite
from typing import Any

import jinja2


def render(template: str, **content: Any) -> str:
    """Fill one of the templates; a value that it needs and does not get is an error."""
    folder = str(resources.files(__package__) / "templates")
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"short": short, "fixed": fixed}
    return environment.get_template(template).render(**content)


def short(value: Any) -> str:
    """A number as a reader wants it: three or four digits, a true minus, powers of ten raised."""
    if value is None:
        return "–"
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return str(value)
    if not isfinite(value):
        return "∞" if value > 0 else "–"
    if value == int(value) and abs(value) < 1e9:
        return f"{int(value):,}".replace(",", "\u202f").replace("-", "−")
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.4g}".replace("-", "−")
    digits, power = f"{value:.1e}".split("e")
    raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{digits} · 10{raised}".replace("-", "−")


def fixed(value: float) -> str:
    """Five decimals with a true minus, and no minus before a zero."""
    return f"{round(value, 5) + 0.0:.5f}".replace("-", "−")
