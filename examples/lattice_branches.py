"""Buckled branches of lattices: energies, stability, amplitudes.

Prints the table of docs/explanation/modes.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modeharvest.fem.bloch.critical import first_critical
from modeharvest.fem.bloch.postbuckling import follow
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, hexagonal, square
from modeharvest.fem.lattice.options import MacroLoading, equibiaxial, uniaxial
from modeharvest.fem.materials import TwoTermI1
from modeharvest.util.arrays import FloatArray

FACTORS = (1.05, 1.2, 1.5)


def show(
    name: str, cell: UnitCell, loading: MacroLoading, combinations: Sequence[tuple[float, ...]]
) -> None:
    """Print a line for each state of each branch, in a lattice with unit cell size l = 1 mm."""
    primitive = PeriodicCell(cell, TwoTermI1())
    critical = first_critical(CellPath(primitive, loading))
    modes = real_modes(primitive, critical.state, critical.waves)
    path = CellPath(PeriodicCell(cell.enlarged(*modes.info["copies"]), TwoTermI1()), loading)
    for combination in combinations:
        found = follow(path, modes, combination, [f * modes.load for f in FACTORS])
        for state in found.states:
            saved = 100 * (1 - state.energy / state.primary_energy)
            amplitudes = ", ".join(f"{1000 * a:+.1f}" for a in state.amplitudes)
            print(
                f"| {name} | {combination} | {state.load / modes.load:.2f} | {saved:.4f} "
                f"| {state.negative_eigenvalues} | {amplitudes} |"
            )
        print(f"  {found.outcome}; root law {exponent(found.curve):.3f}")


def exponent(curve: FloatArray) -> float:
    """Exponent of e - e_c in the initial growth of the amplitude [-]: 1/2 at a pitchfork."""
    excess = np.abs(curve[1:3, 1] - curve[0, 1])
    return float(np.diff(np.log(curve[1:3, 0]))[0] / np.diff(np.log(excess))[0])


if __name__ == "__main__":
    for d in (0.8696, 0.7895):
        show(f"square {d}, uniaxial", square(1.0, d, 1 / 12), uniaxial(), [(1,), (-1,)])
    honeycomb = hexagonal(1.0, 0.924, 1 / 12)
    patterns = [(1, 0, 0), (1, 1, 0), (1, -1, 0), (1, 1, 1), (-1, -1, -1), (1, 1, -1)]
    show("hexagonal, equibiaxial", honeycomb, equibiaxial(), patterns)
    show("hexagonal, uniaxial y", honeycomb, uniaxial(1), [(1,)])
    show("hexagonal, uniaxial x", honeycomb, uniaxial(0), [(1, 0), (1, 1)])
