"""Commands of an infinite lattice: its stability, and its modes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from modeharvest.cli.arguments import CaseName, OutFolder
from modeharvest.cli.messages import bars

if TYPE_CHECKING:
    from modeharvest.lattice.pipeline import LatticeAnalysis


def bloch(case: CaseName, out: OutFolder) -> None:
    """Analyse an infinite lattice: what makes it buckle first, of all waves (needs dolfinx).

    Leaves the first critical load and waves with their proof, the lowest eigenvalues against the
    wave vector at several loads (dispersion.csv, dispersion.h5), report.html and summary.json.
    """
    from modeharvest.lattice.terminal import print_lattice

    with _analysis(case, out) as analysis:
        summary = analysis.bloch()
    print_lattice(summary, out)


def modes(case: CaseName, out: OutFolder) -> None:
    """Find an infinite lattice's modes, buckled branches and mode families (needs dolfinx).

    Does what 'bloch' does, unless that is there already, and goes on: real modes on the smallest
    cell, branches with their energies, spectra, and the Fourier mode families found in them.
    """
    from modeharvest.lattice.terminal import print_lattice

    with _analysis(case, out) as analysis:
        summary = analysis.all()
    print_lattice(summary, out)


@contextmanager
def _analysis(case: str, out: Path) -> Iterator[LatticeAnalysis]:
    """The analysis of a lattice's case, under progress bars."""
    from modeharvest.lattice.case import read_lattice_case

    checked = read_lattice_case(case)  # before the heavy imports, so that a typo is told at once
    from modeharvest.lattice.pipeline import LatticeAnalysis

    with bars() as progress:
        yield LatticeAnalysis(checked, out, progress, case)
