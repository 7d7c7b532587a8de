"""What all studies have in common: cases to run, and findings to read off their table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

import pandas as pd
from matplotlib.figure import Figure

from modeharvest.errors import InputError
from modeharvest.idic.setup import Identification
from modeharvest.progress import Progress
from modeharvest.validation.campaign import Case
from modeharvest.validation.studies.subject import Subject


@dataclass(frozen=True, eq=False)
class Plot:
    """A picture of a study.

    Parameters
    ----------
    name, title
        A short name for files and links, and what it is called.
    drawn
        The figure, in the style of :mod:`modeharvest.validation.style`.
    caption
        What is to be seen.
    wide
        Whether it needs the whole width of the page.
    """

    name: str
    title: str
    drawn: Figure
    caption: str = ""
    wide: bool = False


@dataclass(frozen=True)
class KeyNumber:
    """One of the few numbers that a study is about.

    Parameters
    ----------
    name, value, unit
        What it is, its value as a reader wants it, and its unit (may be empty).
    remark
        What to compare it with.
    """

    name: str
    value: str
    unit: str
    remark: str


@dataclass(frozen=True, eq=False)
class Findings:
    """What a study's table tells.

    Parameters
    ----------
    numbers
        The study's results as plain values, with their units in the names.
    sentences
        The same in words, the most important first.
    keys
        Up to six numbers to begin with.
    plots
        Pictures.
    tables
        Tables by their titles.
    attachments
        Tables that are too long for the page: files only; or, by the title of a table that is
        written to be read, the same in numbers, which its file then holds.
    """

    numbers: Mapping[str, Any]
    sentences: tuple[str, ...]
    keys: tuple[KeyNumber, ...] = ()
    plots: tuple[Plot, ...] = ()
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    attachments: Mapping[str, pd.DataFrame] = field(default_factory=dict)


class Study(Protocol):
    """A question, as options in a frozen dataclass.

    One's own needs these and a module-level function for one case: see docs/studies.md.
    """

    strain: float
    """Of the deformed image [-]."""

    @property
    def question(self) -> str:
        """What is asked, in a sentence or two, for the report."""

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""

    @property
    def seeds(self) -> str:
        """The seeds of all that is random, in words, for the report."""

    def require(self, correlation: Identification) -> None:
        """Raise InputError if the correlation contradicts the study."""

    def quick(self) -> Self:
        """The same question with fewer cases: a first look."""

    def prepare(self, subject: Subject, folder: Path, progress: Progress) -> tuple[Case, ...]:
        """Make what the cases share (images) in ``folder``; returns the cases.

        The random choices of a case follow from a seed that it holds.
        """


def require_mode(correlation: Identification) -> None:
    """Raise InputError where the mode is held: nothing of it would be measured."""
    if correlation.hold_mode:
        raise InputError(
            "study: expected correlation.hold_mode = false, got true: nothing of the mode would "
            "be found"
        )


MOST = 100_000
"""Of what is repeated in a study; each is a case and its file."""


def require_different(name: str, values: tuple[Any, ...]) -> None:
    """Raise InputError if a value comes twice."""
    if len(set(values)) < len(values):
        raise InputError(f"study: expected {name} that differ, got {list(values)}")
