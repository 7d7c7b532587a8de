"""Tools of every package that contain no mechanics or imaging, and the version of all of it."""

from __future__ import annotations

from functools import cache

RELEASE = "0.1.0"
"""The last release, or the one that is prepared. Files name it: it is the same for all commits of
a release, and the digest of the code in a stage's key distinguishes those that differ."""

TYPE_CHECKING = False  # typing's own takes longer to import than everything here


@cache
def version() -> str:
    """The version by git's tags, or of what is installed; see docs/development/releases.md.

    ``0.1.0`` at the tag v0.1.0, ``0.1.0.post5+g1a2b3c4`` five commits later, with ``dirty`` where
    files have changed. In a clone without tags RELEASE and the commit, without git RELEASE.
    """
    from importlib.metadata import distributions
    from pathlib import Path

    package, root = Path(__file__).resolve().parents[1], Path(__file__).resolve().parents[3]
    if (root / ".git").exists():
        return _from_description(_described(root))
    for found in distributions(name="modeharvest", path=[str(package.parent)]):
        return found.version
    archived = root / ".git_archival.txt"  # filled in by ``git archive``
    return _from_description(archived.read_text("utf-8") if archived.is_file() else "")


def _described(root: object) -> str:
    """What ``git describe`` says of a checkout; "" if it can't be run."""
    import os
    import subprocess

    where, _, given = os.environ.get("MODEHARVEST_DESCRIBED", "").rpartition(" ")
    if where == str(root):  # by scripts/env, inside which there is no git
        return given
    options = ["describe", "--tags", "--match", "v[0-9]*", "--always", "--dirty"]
    try:
        done = subprocess.run(["git", "-C", str(root), *options], capture_output=True, text=True)
    except OSError:
        return ""
    return done.stdout if done.returncode == 0 else ""


def _from_description(text: str) -> str:
    """The version (PEP 440) in what ``git describe`` says; RELEASE where that has no tag."""
    import re

    pattern = r"(?:v([\w.]+)(?:-(\d+)-g([0-9a-f]+))?|([0-9a-f]+))?(-dirty)?"
    found = re.fullmatch(pattern, text.strip())
    tag, count, after, alone, dirty = found.groups() if found else [None] * 5
    commit = after or alone
    local = ".".join([f"g{commit}"] * bool(commit) + ["dirty"] * bool(dirty))
    return (tag or RELEASE) + (f".post{count}" if count else "") + (local and f"+{local}")


if not TYPE_CHECKING:

    def __getattr__(name: str) -> str:
        """``__version__`` when it is first asked for, since git may have to be."""
        if name == "__version__":
            return version()
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
