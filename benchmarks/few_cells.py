"""Errors of the mode in the best fit to a known displacement, when few cells are in view.

::

    scripts/env python benchmarks/few_cells.py

The ansatz is fitted to the true displacement of the shipped specimen at 12.8 %, at points 0.05 mm
apart in cells around its middle. No images are used, so errors are those of the ansatz. Printed
are those of wave vectors and of a1 [%], by degrees of v0 and v1. Table: docs/explanation/idic.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modeharvest.fem.field import Solution
from modeharvest.idic.ansatz import Ansatz, AnsatzOptions, for_cells
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.modes import turning_family
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate

SHIPPED = Path(__file__).parents[1] / "src/modeharvest/cases/paper-virtual.h5"
STRAIN, PIXEL = 0.128, 0.05
VIEWS = (1, 6), (2, 2), (2, 3), (2, 10), (6, 2), (3, 3), (3, 10), (4, 4), (4, 8), (6, 8)
DEGREES = (5, 6), (3, 4), (3, 2)


def main() -> None:
    """Print the table."""
    solution = Solution.read(SHIPPED)
    specimen, mesh, cell = solution.specimen, solution.mesh, solution.specimen.pitch
    width, height = specimen.half_size
    grid = PixelGrid.centred(round(2 * height / PIXEL), round(2 * width / PIXEL), PIXEL)
    u = solution.at(STRAIN).displacement
    found = locate(mesh.nodes, mesh.cells, mesh.element, grid, nodal=u)
    true = np.moveaxis(found.values, 0, -1)
    heads = [f"{v0}, {v}" for v0, v in DEGREES]
    print(f"| cells | {' | '.join(heads)} | as lowered |\n|---{'|---' * 4}|")
    for cells in VIEWS:
        # If only one of both numbers is odd, the cells are half a cell beside the middle.
        of = np.array([specimen.holes_x, specimen.holes_y])
        centre, half = 0.5 * cell * ((of - cells) % 2), 0.5 * cell * np.array(cells)
        low, high = centre - half, centre + half
        box = Box(low[0], high[0], low[1], high[1])
        family = turning_family(cell * np.eye(2), cell, low + cell)
        inside = found.mask & box.contains(grid.x, grid.y[:, None])
        degrees = [AnsatzOptions(*pair) for pair in DEGREES]
        row = []
        for options in (*degrees, for_cells(AnsatzOptions(), box, box, cell)):
            ansatz = Ansatz.on(box, [(family, box)], cell, options)
            a = fit_displacement(true, grid, ansatz, ansatz.initial_guess(), inside).unknowns
            parameters = a[ansatz.phi_slice(0)]
            k = family.waves(parameters)[:, 2:4]
            off = 100.0 * np.abs(np.abs(k) - 1.0).max(), 100.0 * abs(parameters[0] - 1.0)
            row.append(f"{off[0]:.1f} / {off[1]:.0f}")
        print(f"| {cells[0]} × {cells[1]} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
