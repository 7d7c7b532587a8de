"""What all studies have in common: cases to run, and findings to read off their table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import pandas as pd
from matplotlib.figure import Figure

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
    """

    name: str
    title: str
    drawn: Figure
    caption: str = ""


@dataclass(frozen=True, eq=False)
class Findings:
    """What a study's table tells.

    Parameters
    ----------
    numbers
        The study's results as plain values, with their units in the names.
    sentences
        The same in words, the most important first.
    plots
        Pictures.
    tables
        Tables by their titles.
    """

    numbers: Mapping[str, Any]
    sentences: tuple[str, ...]
    plots: tuple[Plot, ...] = ()
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)


class Study(Protocol):
    """A question, as options in a frozen dataclass."""

    @property
    def function(self) -> str:
        """The "package.module:name" of what runs one case."""

    def prepare(self, subject: Subject, folder: Path, progress: Progress) -> tuple[Case, ...]:
        """Make what the cases share (images) in ``folder``; returns the cases.

        The random choices of a case follow from a seed that it holds.
        """

    def findings(self, table: pd.DataFrame) -> Findings:
        """Read the table of all cases; those that failed have an ``error``."""
