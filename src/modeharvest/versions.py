"""Which software made a result: what belongs into every summary."""

from __future__ import annotations

import platform
from importlib.metadata import version

from modeharvest import __version__


def versions(*libraries: str) -> dict[str, str]:
    """Versions of modeharvest, of Python, and of installed libraries, by their names."""
    own = {"modeharvest": __version__, "python": platform.python_version()}
    return own | {name: version(name) for name in libraries}
