"""Mode families of lattices: waves, parameters, energy captured.

Prints the numbers in the table of docs/explanation/families.md.
"""

from __future__ import annotations

import numpy as np

from modeharvest.fem.bloch.critical import first_critical
from modeharvest.fem.bloch.real_modes import real_modes
from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
from modeharvest.fem.lattice.cells import UnitCell, chiral, hexagonal, square
from modeharvest.fem.lattice.options import MacroLoading, equibiaxial, uniaxial, uniaxial_strain
from modeharvest.fem.materials import TwoTermI1
from modeharvest.idic.spectra.mode_family import mode_family


def show(name: str, cell: UnitCell, loading: MacroLoading, *, combined: bool = False) -> None:
    """Print the family of the first critical mode, or of the sum of all of them; l = 1 mm."""
    body = PeriodicCell(cell, TwoTermI1())
    critical = first_critical(CellPath(body, loading))
    assert critical.state is not None, critical.outcome
    modes = real_modes(body, critical.state, critical.waves)
    field = modes.shapes.sum(axis=0) if combined else modes.shapes[0]
    for growth in (0.04, 0.1):
        found = mode_family(modes.mesh, modes.lattice, field, 1.0, growth=growth)
        later = [share for count, share in found.growth if count > len(found.waves)]
        gain = 100 * (later[0] - found.captured) if later else 0.0
        print(
            f"{name}, growth {growth}: {len(found.waves)} waves, {found.family.size} parameters, "
            f"{100 * found.captured:.1f} % captured, next {gain:.1f} %; {found.family.name}, "
            f"first parameters {np.round(found.family.start[:2], 3)}"
        )


if __name__ == "__main__":
    for d in (0.7895, 0.8696, 0.95):
        cell = square(1.0, d, 1 / 12)
        show(f"square {d}, uniaxial", cell, uniaxial())
        show(f"square {d}, uniaxial strain", cell, uniaxial_strain())
        show(f"square {d}, equibiaxial", cell, equibiaxial())
    cell = hexagonal(1.0, 0.924, 1 / 12)
    show("hexagonal, equibiaxial, one mode", cell, equibiaxial())
    show("hexagonal, equibiaxial, flower", cell, equibiaxial(), combined=True)
    show("hexagonal, uniaxial y", cell, uniaxial(1))
    show("hexagonal, uniaxial x, both modes", cell, uniaxial(0), combined=True)
    show("tetrachiral, equibiaxial", chiral(1.0, 1 / 12, 4), equibiaxial())
