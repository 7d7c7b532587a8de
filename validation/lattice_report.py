"""The report of an infinite lattice: one page like the paper's Figs. "modes" and "graded"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.fem.modes import Branch, ModeSet, Wave
from modeharvest.files import atomic
from modeharvest.progress import Progress, silent
from modeharvest.validation.page import render
from modeharvest.validation.patch import Patch
from modeharvest.validation.plots_lattice import draw_lattice
from modeharvest.validation.style import to_svg

if TYPE_CHECKING:  # its module needs dolfinx
    from modeharvest.fem.bloch_critical import LatticeCritical

FloatArray = NDArray[np.float64]

TEMPLATE = "lattice_report.html"
CELLS = 4
"""Unit cells along the side of a picture's window."""


@dataclass(frozen=True)
class CriticalPoint:
    """What ``LatticeCritical`` says, in plain values: where a lattice first becomes unstable.

    Parameters
    ----------
    loading
        Its name, e.g. "uniaxial".
    load
        Critical load [-]; without one, the largest at which the lattice was found stable.
    found
        Whether there is a critical point up to there.
    outcome
        In words.
    waves
        Phases (k . a1, k . a2) of the critical waves [rad]; empty for long waves.
    below, above
        Negative eigenvalues at each of them a millionth of the load below and above.
    earlier
        Waves of the grid that are unstable already below.
    value
        Lowest measure filling · λ / k² at ``load`` [MPa].
    angle
        Direction of long waves [rad]; None for others.
    """

    loading: str
    load: float
    found: bool
    outcome: str
    waves: tuple[Wave, ...] = ()
    below: tuple[int, ...] = ()
    above: tuple[int, ...] = ()
    earlier: tuple[Wave, ...] = ()
    value: float = 0.0
    angle: float | None = None

    @classmethod
    def of(cls, loading: str, found: LatticeCritical) -> CriticalPoint:
        """Take the plain values of a search's result."""
        least = found.least
        return cls(loading, found.load, found.found, found.outcome, found.waves, found.below,
                   found.above, found.earlier, least.value, least.angle)  # fmt: skip


@dataclass(frozen=True, eq=False)
class LatticeRun:
    """All that the report of a lattice shows; what is None or empty is left out.

    Parameters
    ----------
    title
        Of the page.
    case
        What was run, as plain values.
    command
        That makes this page again.
    mesh, lattice
        Primitive cell [mm], and its (2, 2) lattice vectors as rows [mm].
    pitch
        Unit cell size l [mm].
    critical
        First critical points, one for each loading.
    dispersion
        :class:`modeharvest.fem.dispersion.Dispersion`.
    modes, branches
        At the critical point, and what leaves there.
    spectrum
        :class:`modeharvest.idic.lattice_spectrum.LatticeSpectrum` of the pattern.
    family
        :class:`modeharvest.idic.automatic.FoundFamily` of it.
    study
        :class:`modeharvest.validation.independence.ModeStudy`.
    exports
        Files beside the page, and what each holds.
    notes
        What a reader should know before trusting the numbers.
    timings, versions
        Stage to seconds [s]; software to version.
    """

    title: str
    case: Mapping[str, Any]
    command: str
    mesh: Mesh
    lattice: FloatArray
    pitch: float
    critical: Sequence[CriticalPoint] = ()
    dispersion: Any = None
    modes: ModeSet | None = None
    branches: Sequence[Branch] = ()
    spectrum: Any = None
    family: Any = None
    study: Any = None
    exports: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Picture:
    """A picture in the page: anchor, what is written above it, the picture, a line below it."""

    id: str
    label: str
    svg: str
    fact: str = ""

    @classmethod
    def of(cls, id: str, label: str, drawn: Figure, fact: str = "") -> Picture:
        """Turn a figure into a picture."""
        return cls(id, label, to_svg(drawn, id, label), fact)


def write_lattice_report(path: Path | str, run: LatticeRun, progress: Progress = silent) -> None:
    """Write the report of a lattice, atomically.

    Parameters
    ----------
    path
        The HTML file.
    run
        What it shows.
    progress
        Listener.
    """
    page = render(TEMPLATE, title=run.title, run=run, cells=_cells(run))
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")
    progress(1, 1, "report")


def _cells(run: LatticeRun) -> list[Picture]:
    """The lattice before and after."""
    side = CELLS * run.pitch
    still = Patch.of(run.mesh, run.lattice, (side, side))
    return [Picture.of("reference", "Reference", draw_lattice(still, run.pitch))]
