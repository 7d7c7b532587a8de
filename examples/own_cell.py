"""Modes of a lattice with the user's own unit cell, from a mesh in metres and a case file.

gmsh makes the cell; any other mesher can be used. The cell is a rectangle with an oval hole, and
opposite sides have matching nodes. The case has the file's name and unit; all else is in mm. The
mode is read with h5py alone, at the file's nodes. Run: ``scripts/env python examples/own_cell.py``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gmsh
import h5py

import modeharvest

CASE = """
title = "Oval holes in rectangular stacking"

[lattice]
kind = "file"
path = "cell.msh"           # beside this file; anything that meshio or gmsh reads
unit = "m"                  # of the nodes in that file; all else is in mm
pitch = 2.0                 # l [mm], the unit of wave lengths in spectra
# vectors = [[2.0, 0.0], [0.0, 1.6]]   # a1, a2 [mm]; none: the rectangle that the mesh fills

[material]
kind = "two-term-I1"

[loading]
kind = "uniaxial-strain"
axis = "y"

[search]
largest = 0.2

[dispersion]
points = 20
map_divisions = 0
"""


def make_cell(path: Path) -> None:
    """Write the mesh [m] of a rectangle of 2 x 1.6 mm with an oval hole, made by gmsh."""
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    width, height = 2e-3, 1.6e-3
    plate = gmsh.model.occ.addRectangle(0, 0, 0, width, height)
    hole = gmsh.model.occ.addDisk(width / 2, height / 2, 0, 0.8e-3, 0.65e-3)
    gmsh.model.occ.cut([(2, plate)], [(2, hole)])
    gmsh.model.occ.synchronize()
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.12e-3)
    for axis, size in enumerate((width, height)):  # right side as left, top as bottom
        sides: dict[bool, int] = {}
        for _, curve in gmsh.model.getEntities(1):
            box = gmsh.model.getBoundingBox(1, curve)
            if box[3 + axis] - box[axis] < 1e-6:
                sides[box[axis] > size / 2] = curve
        shift = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        shift[3 + 4 * axis] = size
        gmsh.model.mesh.setPeriodic(1, [sides[True]], [sides[False]], shift)
    gmsh.model.mesh.generate(2)
    gmsh.model.mesh.setOrder(2)
    gmsh.write(str(path))
    gmsh.finalize()


def main(folder: Path) -> dict[str, Any]:
    """Write mesh and case in a folder, and run it; returns the content of ``summary.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    make_cell(folder / "cell.msh")
    (folder / "case.toml").write_text(CASE, "utf-8")
    summary = modeharvest.run(folder / "case.toml", folder / "out")
    print(summary["outcome"], *summary["notes"], sep="\n")
    with h5py.File(folder / "out" / "modes.h5") as file:
        tags, mode = file["origin"][:], file["shapes"][0]
    for k in range(3):  # the first nodes are those of the file, with their tags
        print(f"node {tags[k]}: mode ({mode[k, 0]:.3f}, {mode[k, 1]:.3f})")
    return summary


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/own-cell"))
