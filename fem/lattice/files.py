"""Unit cells from files: a mesh in a format of meshio, or a geometry or model of gmsh.

Lengths are in mm, except in the file, whose unit can be given. Triangles become a plane T6 mesh,
see ``foreign``. That the copies of a cell fit together is checked by ``periodicity``, which names
nodes that don't fit.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gmsh
import numpy as np
from numpy.typing import ArrayLike

from modeharvest.fem.field import Mesh, read_any_mesh
from modeharvest.fem.lattice.cells import UnitCell
from modeharvest.fem.lattice.foreign import millimetres, require_unit, sound_t6
from modeharvest.fem.lattice.geometries import mesh_periodically
from modeharvest.fem.lattice.options import lattice_vectors
from modeharvest.fem.meshing import gmsh_options, quiet_gmsh, require_size
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import reading, require_file

Blocks = dict[str, list[IntArray]]  # blocks of elements, by meshio's element names

GEOMETRY = (".geo", ".geo_unrolled", ".step", ".stp", ".brep", ".iges", ".igs")
"""Suffixes of geometry files, which gmsh meshes."""

_PROBE = """
import gmsh, sys
gmsh.initialize(interruptible=False)
gmsh.option.setNumber("General.Terminal", 0)
try:
    gmsh.merge(sys.argv[1])
except Exception as error:
    sys.exit(str(error) or gmsh.logger.getLastError())
print("read")
"""
_PROBE_SECONDS = 300.0
_FARTHEST = 1e9
"""Largest distance from the origin [mm]; nodes of a damaged file may be anywhere."""
_LOWER = ("vertex", "line")  # types of lower dimension, which are ignored


def read_cell(
    path: Path | str,
    lattice: ArrayLike | None = None,
    size: float | None = None,
    unit: str | None = None,
) -> UnitCell:
    """Read the unit cell of a lattice from a file.

    Nodes keep the file's order; ``UnitCell.origin`` gives their numbers in the file, ``notes`` what
    was changed. InputError for a damaged file, one without a plane mesh of valid triangles, or one
    that isn't periodic; the message asks for the unit if the cell is unusually small or large.

    path : a plane mesh of six-node triangles, in any format of meshio or gmsh; three-node triangles
        get mid-side nodes on straight sides. Or a geometry that gmsh meshes (suffixes
        ``GEOMETRY``). A gmsh file's physical surfaces, if any, are the material.
    lattice : (2, 2) lattice vectors a1 and a2 as rows [mm]. None: the cell is the bounding
        rectangle of its material along x and y.
    size : largest edge length of the elements of a geometry [mm]; None: as set in the geometry.
    unit : unit of lengths in the file, one of ``foreign.MILLIMETRES``; None: mm. STEP and IGES
        files contain their unit, and are converted to mm.
    """
    path = Path(path)
    require_file(path, "a cell (mesh or geometry)", "draw or export one")
    is_geometry = path.suffix.lower() in GEOMETRY
    if size is not None and not is_geometry:
        raise InputError(f"{path}: a size is for geometries ({', '.join(GEOMETRY)}), not meshes")
    if is_geometry or path.suffix.lower() == ".msh":
        _require_readable(path)
        with quiet_gmsh():
            _merge(path)
            return _from_model(lattice, size, is_geometry, str(path), unit)
    source = read_any_mesh(path)
    blocks: dict[str, list[IntArray]] = {}
    for block in source.cells:
        blocks.setdefault(block.type, []).append(np.asarray(block.data, dtype=np.int64))
    points = np.asarray(source.points, dtype=np.float64)
    return _unit_cell(points, blocks, np.arange(len(points)), lattice, str(path), unit)


def cell_from_gmsh(
    lattice: ArrayLike | None = None, size: float | None = None, unit: str | None = None
) -> UnitCell:
    """The unit cell in gmsh's current model, which stays open.

    An existing mesh of the model is used unchanged; otherwise the model is meshed with equal
    divisions on opposite sides. Parameters and errors are those of :func:`read_cell`.
    """
    if not gmsh.isInitialized():
        raise InputError("expected a gmsh model, got none: call gmsh.initialize() and build one")
    with gmsh_options({"General.Terminal": 0, "Mesh.MeshSizeMax": 1e22}):
        to_mesh = not gmsh.model.mesh.getElementTypes(2).size
        return _from_model(lattice, size, to_mesh, "gmsh model", unit)


def _require_readable(path: Path) -> None:
    """Read the file in a child process first, as some files make gmsh abort or exit the process."""
    with reading(path, "a file that gmsh reads", "export it again"):
        command = [sys.executable, "-P", "-c", _PROBE, str(path)]
        done = subprocess.run(command, capture_output=True, timeout=_PROBE_SECONDS, check=False)
        if done.returncode < 0:
            raise ValueError(f"a file that makes gmsh crash (signal {-done.returncode})")
        if not done.stdout.endswith(b"read\n"):
            raise ValueError(done.stderr.decode(errors="replace") or "a file that ends gmsh")


def _merge(path: Path) -> None:
    unit = gmsh.option.getString("Geometry.OCCTargetUnit")
    gmsh.option.setString("Geometry.OCCTargetUnit", "MM")
    try:
        gmsh.merge(str(path))  # already read once, in a child process
    finally:
        gmsh.option.setString("Geometry.OCCTargetUnit", unit)


def _from_model(
    lattice: ArrayLike | None, size: float | None, to_mesh: bool, source: str, unit: str | None
) -> UnitCell:
    """The cell in gmsh's current model."""
    mm = millimetres(unit)
    if not gmsh.model.getEntities(2):
        raise InputError(f"{source}: expected a surface, got none")
    if size is not None:
        low, high = np.reshape(gmsh.model.getBoundingBox(-1, -1), (2, 3))[:, :2]
        require_size(size, mm**2 * float(np.prod(high - low)))
        gmsh.option.setNumber("Mesh.MeshSizeMax", size / mm)
    if to_mesh:
        try:
            given = None if lattice is None else lattice_vectors(lattice, "periodic cell")
            mesh_periodically(None if given is None else np.asarray(given / mm))
        except InputError as error:
            raise InputError(f"{source}: {error}") from error
        except Exception as error:  # gmsh raises plain exceptions only
            why = " ".join((str(error) or gmsh.logger.getLastError()).split())
            raise InputError(
                f"{source}: gmsh can't mesh it ({why}); holes must neither overlap nor "
                "touch each other"
            ) from error
    return _unit_cell(*_current_mesh(), lattice, source, unit)


def _current_mesh() -> tuple[FloatArray, Blocks, IntArray]:
    """Nodes (n, 3), elements and nodes' tags (n,) of gmsh's current model.

    If there are physical surfaces, elements are only those of these.
    """
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    order = np.argsort(tags)
    of_group = gmsh.model.getEntitiesForPhysicalGroup
    named = [int(e) for _, n in gmsh.model.getPhysicalGroups(2) for e in of_group(2, n)]
    cells: Blocks = {}
    for entity in named or [tag for _, tag in gmsh.model.getEntities(2)]:
        for kind, _, nodes in zip(*gmsh.model.mesh.getElements(2, entity), strict=True):
            _, _, degree, count, *_ = gmsh.model.mesh.getElementProperties(kind)
            name = {(1, 3): "triangle", (2, 6): "triangle6"}.get((degree, count), f"{count}-node")
            place = np.searchsorted(tags[order], nodes).reshape(-1, count)
            cells.setdefault(name, []).append(place.astype(np.int64))
    return coordinates.reshape(-1, 3)[order], cells, tags[order].astype(np.int64)


def _unit_cell(
    points: FloatArray,
    blocks: Blocks,
    names: IntArray,
    lattice: ArrayLike | None,
    source: str,
    unit: str | None,
) -> UnitCell:
    """Check a mesh read from a file, bring it into standard form, and find its periodicity.

    ``points`` and ``blocks``: nodes and elements of the file; ``names`` (n,): numbers of the nodes.
    """
    cells = {name: np.vstack(parts) for name, parts in blocks.items()}
    kinds = sorted(name for name in cells if not name.startswith(_LOWER) and len(cells[name]))
    if kinds not in (["triangle"], ["triangle6"]):
        got = " and ".join(kinds) or "no elements"
        raise InputError(
            f"{source}: expected triangles of three or of six nodes and nothing else, got {got}"
        )
    if not np.abs(points).max(initial=0.0) < _FARTHEST:
        raise InputError(f"{source}: expected finite nodes less than {_FARTHEST:g} mm from 0")
    try:
        vectors = None if lattice is None else lattice_vectors(lattice, "periodic cell")
        if unit is None:
            require_unit(points[np.unique(cells[kinds[0]])][:, :2], vectors)
        found = sound_t6(millimetres(unit) * points, cells[kinds[0]])
        mesh, names = found.mesh, np.append(names, -1)
        if vectors is None:
            _refuse_unless_rectangular(mesh)
            vectors = np.diag(np.ptp(mesh.nodes, axis=0))
        return UnitCell(mesh, vectors, names[found.origin], found.notes)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error


def _refuse_unless_rectangular(mesh: Mesh) -> None:
    """Raise InputError unless element sides lie on each side of the mesh's bounding rectangle."""
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    middles = mesh.nodes[np.unique(mesh.cells[:, 3:])]
    near = 1e-6 * (high - low).min()
    gaps = [np.abs(middles - bound).min(axis=0) for bound in (low, high)]
    if np.max(gaps) > near:
        raise InputError(
            "expected lattice vectors as two rows, because the cell does not fill a rectangle of "
            f"{high[0] - low[0]:.5g} x {high[1] - low[1]:.5g} mm along x and y, got none"
        )
