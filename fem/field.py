"""A mesh, nodal displacements on it, and their origin: plain numpy, no dolfinx.

The result of a finite-element simulation. The file is HDF5, readable with h5py alone::

    nodes (n, 2) [mm]    cells (m, k)    @format @element @info (JSON: what was simulated)
    snapshots/0000/displacement (n, 2) [mm]    @nominal_strain @branch ...

Nodes of a cell: corners counter-clockwise, then mid-sides starting between the first two corners,
then (Q9) the centre; this is the order of VTK, gmsh and meshio.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import h5py
import meshio
import numpy as np

from modeharvest.fem.specimen import Specimen
from modeharvest.util.arrays import FloatArray, FloatImage, IntArray
from modeharvest.util.elements import shape_functions
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, atomic_hdf5, open_hdf5, read_in_child, reading
from modeharvest.util.typed import made

T = TypeVar("T")

FORMAT = "modeharvest-solution-1"
COMPRESSED = {"compression": 1, "shuffle": True}
"""Compression of HDF5 datasets: higher levels take twice as long and save 1 % of measured u."""
NODES_PER_CELL = {"T3": 3, "T6": 6, "Q4": 4, "Q8": 8, "Q9": 9}
_FLAT = 1e-6  # largest variation of z in a plane mesh, relative to its size
MESHIO_NAME = {"T3": "triangle", "T6": "triangle6", "Q4": "quad", "Q8": "quad8", "Q9": "quad9"}

_TRIANGLES: dict[str, dict[str, tuple[list[int], ...]]] = {
    "T3": {"triangle": ([0, 1, 2],), "quad": ([0, 1, 2], [0, 2, 3])},
    "T6": {"triangle6": ([*range(6)],), "quad9": ([0, 1, 2, 4, 5, 8], [0, 2, 3, 8, 6, 7])},
}
"""Nodes of the triangles into which cells are split."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A plane isoparametric mesh of one element type: T3, T6, Q4, Q8 or Q9."""

    nodes: FloatArray
    """(n, 2) positions [mm]."""
    cells: IntArray
    """(m, k) node numbers of each cell, ordered as in the module's docstring."""
    element: str

    def __post_init__(self) -> None:
        if self.element not in (known := list(NODES_PER_CELL)):
            raise InputError(f"expected an element among {known}, got {self.element}")
        object.__setattr__(self, "nodes", np.ascontiguousarray(self.nodes, dtype=np.float64))
        object.__setattr__(self, "cells", np.ascontiguousarray(self.cells, dtype=np.int64))
        k = NODES_PER_CELL[self.element]
        if self.nodes.ndim != 2 or self.nodes.shape[1] != 2:
            raise InputError(f"expected nodes of shape (n, 2), got {self.nodes.shape}")
        if self.cells.ndim != 2 or self.cells.shape[1] != k:
            what = f"{self.element} cells of shape (m, {k})"
            raise InputError(f"expected {what}, got {self.cells.shape}")
        if not np.isfinite(self.nodes).all():
            raise InputError("expected finite node positions, got NaN or infinity")
        if self.cells.size and not 0 <= self.cells.min() <= self.cells.max() < len(self.nodes):
            raise InputError(f"a cell names a node outside 0 ... {len(self.nodes) - 1}")


def with_mid_sides(nodes: FloatArray, cells: IntArray) -> tuple[FloatArray, IntArray]:
    """Nodes (n + s, 2) and cells (m, 6) of T6 elements with straight sides, from T3's (m, 3)."""
    ends = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    sides, number = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    middle = len(nodes) + number.reshape(-1, 3)
    return np.vstack([nodes, nodes[sides].mean(axis=1)]), np.hstack([cells, middle])


def boundary_sides(mesh: Mesh) -> IntArray:
    """(s, 3) first corner, mid-side and second corner of the sides that belong to one cell only.

    The material is to the left of them; without mid-side nodes the second column repeats the first.
    """
    k = np.arange(3 if mesh.element in ("T3", "T6") else 4)
    middle = k + k.size if mesh.cells.shape[1] > k.size else k
    every = mesh.cells[:, np.stack([k, middle, np.roll(k, -1)], axis=1)]
    every = every.swapaxes(0, 1).reshape(-1, 3)  # a row for each side of each cell
    pairs = np.sort(every[:, [0, 2]], axis=1)
    _, number, count = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(every[count[number.ravel()] == 1])


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One equilibrium state."""

    nominal_strain: float
    """Applied shortening over L, the length of the cellular part [-]."""
    displacement: FloatArray
    """(n, 2) displacement of the mesh's nodes [mm]."""
    reaction: float = float("nan")
    """Compressive force on the loaded edge per unit thickness [N/mm]."""
    energy: float = float("nan")
    """Stored energy per unit thickness [N]."""
    negative_pivots: int | None = None
    """Number of negative eigenvalues of the tangent stiffness; 0: stable, None: unknown."""
    eigenvalues: tuple[float, ...] = ()
    """Lowest eigenvalues of K x = lambda M x, ascending [N/mm^4], if computed; M is the mass matrix
    of unit density."""
    branch: str = "primary"
    """Either "primary", "buckled+" or "buckled-"."""


@dataclass(frozen=True, eq=False)
class Solution:
    """A mesh and its snapshots, with everything needed to reproduce them."""

    mesh: Mesh
    """The undeformed specimen."""
    snapshots: tuple[Snapshot, ...]
    """Equilibrium states of the specimen."""
    info: Mapping[str, Any] = field(default_factory=dict)
    """Plain JSON values: geometry, material, loading, versions, seed, critical strain and the
    computational cost of the path."""

    def __post_init__(self) -> None:
        if not len(self.mesh.cells):
            raise InputError("expected cells of a mesh, got none: nothing to show")
        for s in self.snapshots:
            where, shape = f"snapshot at strain {s.nominal_strain}", self.mesh.nodes.shape
            if not np.isfinite(s.nominal_strain):
                raise InputError(f"expected a finite nominal strain, got {s.nominal_strain}")
            if s.displacement.shape != shape:
                raise InputError(
                    f"{where}: expected displacements {shape}, got {s.displacement.shape}"
                )
            if not np.isfinite(s.displacement).all():
                raise InputError(f"{where}: expected finite displacements, got NaN or infinity")

    @property
    def specimen(self) -> Specimen:
        """The simulated specimen; InputError for a solution of another solver."""
        if "specimen" not in self.info:
            raise InputError(
                "expected a solution that says of which specimen it is, got one that does not "
                "(read from another solver's mesh); state a Specimen"
            )
        return made(Specimen, self.info["specimen"])

    def at(self, nominal_strain: float) -> Snapshot:
        """The snapshot at a nominal strain, a stable one if available; InputError if none."""
        found = [s for s in self.snapshots if abs(s.nominal_strain - nominal_strain) < 1e-9]
        if not found:
            have = ", ".join(f"{s.nominal_strain:.4f}" for s in self.snapshots) or "none"
            raise InputError(f"expected a snapshot at strain {nominal_strain}, have: {have}")
        return min(found, key=lambda s: s.negative_pivots or 0)

    def write(self, path: Path | str) -> None:
        """Write HDF5, atomically; displacements and nodes are stored losslessly."""
        with atomic_hdf5(path) as file:
            file.attrs["format"] = FORMAT
            file.attrs["info"] = json.dumps(dict(self.info))
            write_mesh(file, self.mesh)
            for k, s in enumerate(self.snapshots):
                pivots = -1 if s.negative_pivots is None else s.negative_pivots
                group = file.create_group(f"snapshots/{k:04d}")
                write_values(group, replace(s, negative_pivots=pivots))

    @classmethod
    def read(cls, path: Path | str) -> Solution:
        """Read a file of :meth:`write`; InputError for any other file."""
        remedy = "make it again with 'modeharvest fem'"
        with open_hdf5(path, "a solution (HDF5)", remedy, FORMAT) as file:
            mesh = read_mesh(file)
            groups = file.get("snapshots", {})
            snapshots = tuple(_read_snapshot(groups[name]) for name in sorted(groups))
            return cls(mesh, snapshots, dict(json.loads(file.attrs["info"])))

    def write_vtu(self, path: Path | str) -> None:
        """Write mesh and all displacements as VTU for ParaView, atomically."""
        fields = {
            f"u_mm_{k:04d}_{s.branch}_{100 * s.nominal_strain:.3f}pct": s.displacement
            for k, s in enumerate(self.snapshots)
        }
        with atomic(path) as temporary:
            in_space(self.mesh, fields).write(temporary, file_format="vtu")


def in_space(mesh: Mesh, fields: Mapping[str, FloatArray | FloatImage]) -> meshio.Mesh:
    """A mesh with nodal fields by name, padded to three dimensions as VTK requires.

    Scalars are (n,), vectors (n, 2), tensors (n, 2, 2); a tensor's nine components become one row.
    """

    def padded(values: FloatArray | FloatImage) -> Any:
        spatial = np.pad(values, ((0, 0), *((0, 1),) * (values.ndim - 1)))
        return spatial if values.ndim < 3 else spatial.reshape(len(values), 9)

    data = {name: padded(values) for name, values in fields.items()}
    cells = [(MESHIO_NAME[mesh.element], mesh.cells)]
    return meshio.Mesh(padded(mesh.nodes), cells, point_data=data)


def write_mesh(file: h5py.File, mesh: Mesh) -> None:
    """Write a mesh into an HDF5 file: datasets nodes and cells, attribute element."""
    file.attrs["element"] = mesh.element
    file.create_dataset("nodes", data=mesh.nodes, **COMPRESSED)
    file.create_dataset("cells", data=mesh.cells.astype(np.int32), **COMPRESSED)


def read_mesh(file: h5py.File) -> Mesh:
    """Read a mesh written by :func:`write_mesh`."""
    return Mesh(file["nodes"][:], file["cells"][:], str(file.attrs["element"]))


def write_values(group: h5py.Group, record: Any) -> None:
    """Write a dataclass into an HDF5 group: arrays as datasets, other values as attributes."""
    for name, value in vars(record).items():
        if isinstance(value, np.ndarray):
            group.create_dataset(name, data=value, **COMPRESSED)
        else:
            group.attrs[name] = value


def read_values(group: h5py.Group, kind: type[T]) -> T:
    """Read a dataclass written by :func:`write_values`."""
    found: dict[str, Any] = {}
    for name in (f.name for f in fields(kind)):  # type: ignore[arg-type]
        is_array = name in group
        found[name] = group[name][()] if is_array else np.asarray(group.attrs[name]).tolist()
    return kind(**found)


def _read_snapshot(group: h5py.Group) -> Snapshot:
    found = read_values(group, Snapshot)
    pivots = None if found.negative_pivots == -1 else found.negative_pivots
    return replace(found, negative_pivots=pivots, eigenvalues=tuple(found.eigenvalues))


def read_any_mesh(path: Path | str) -> meshio.Mesh:
    """Points, cells, named cell sets and nodal fields of a file in any format of meshio."""
    what, remedy = "a mesh that meshio reads", "export it again, for example as VTU"
    found = read_in_child("mesh", path, what, remedy)
    with reading(path, what, remedy):
        named = [(name.split("/", 2), values) for name, values in found.items()]
        cells = [(name[2], values) for name, values in named if name[0] == "cells"]
        fields = {"/".join(name[1:]): v for name, v in named if name[0] == "point_data"}
        names = {name[2] for name, _ in named if name[0] == "cell_sets"}
        sets = {n: [found.get(f"cell_sets/{k}/{n}", ()) for k in range(len(cells))] for n in names}
        return meshio.Mesh(found["points"], cells, point_data=fields, cell_sets=sets)


def read_meshio(path: Path | str, displacement: str, nominal_strain: float) -> Solution:
    """Read mesh and displacement of any solver from a file in any format of meshio.

    Cells are T3, T6, Q4, Q8 or Q9 in the x-y plane [mm]; ``displacement``: name of a nodal vector
    field [mm]; ``nominal_strain``: of the snapshot [-]. InputError if the file can't be read, or
    has no such cells, several types of them, or no such field.
    """
    source = read_any_mesh(path)
    mesh = plane_mesh(source, path)
    if displacement not in source.point_data:
        names = list(source.point_data)
        raise InputError(f"expected a nodal field {displacement!r} in {path}, got {names}")
    u = np.asarray(source.point_data[displacement], dtype=np.float64)
    if u.ndim != 2 or u.shape[1] not in (2, 3):
        raise InputError(f"expected {displacement!r} of 2 or 3 components in {path}, got {u.shape}")
    return Solution(mesh, (Snapshot(nominal_strain, u[:, :2].copy()),), {"source": str(path)})


def plane_mesh(source: meshio.Mesh, path: Path | str) -> Mesh:
    """The T3, T6, Q4, Q8 or Q9 mesh with z = const from a file's content.

    InputError if it has no such cells or several types of them, or isn't plane.
    """
    types = sorted({block.type for block in source.cells})
    found = [e for e, name in MESHIO_NAME.items() if name in types]
    if len(found) != 1:
        known = ", ".join(MESHIO_NAME.values())
        raise InputError(
            f"expected cells of one of the types {known} in {path}, got {', '.join(types)}; export "
            "a plane mesh of one type"
        )
    nodes = in_plane(source.points, f" in {path}")
    return Mesh(nodes, source.get_cells_type(MESHIO_NAME[found[0]]), found[0])


def plane_triangles(source: meshio.Mesh, path: Path | str) -> Mesh:
    """The T3 or T6 mesh of a file's content; quadrilaterals are split along a diagonal.

    InputError if it isn't plane, or has linear beside quadratic cells, or none at all.
    """
    nodes, own = in_plane(source.points, f" in {path}"), dict(source.cells_dict)
    if (eight := own.get("quad8")) is not None:  # the element's own centre
        centres = shape_functions("Q8", [0.0, 0.0]) @ nodes[eight]
        nine = np.column_stack([eight, len(nodes) + np.arange(len(eight))])
        own["quad9"] = np.vstack([own.get("quad9", nine[:0]), nine])
        nodes = np.vstack([nodes, centres])
    found = {element: [own[name][:, part] for name, parts in types.items() if name in own
                       for part in parts] for element, types in _TRIANGLES.items()}  # fmt: skip
    cells = {element: np.vstack(parts) for element, parts in found.items() if parts}
    if len(cells) != 1:
        raise InputError(
            f"expected a mesh of linear or of quadratic triangles or quadrilaterals in {path}, got "
            f"{' and '.join(source.cells_dict) or 'no cells'}; export a plane mesh of one order"
        )
    ((element, all_cells),) = cells.items()
    return Mesh(nodes, all_cells, element)


def in_plane(points: FloatArray, where: str = "") -> FloatArray:
    """(n, 2) x and y of points (n, 2) or (n, 3); InputError unless they are finite, z = const."""
    if not np.isfinite(points).all():
        raise InputError(f"expected finite node positions{where}, got NaN or infinity")
    z = points[:, 2:]
    if z.size and np.ptp(z) > _FLAT * np.ptp(points[:, :2]):
        got = f"z from {z.min():.5g} to {z.max():.5g}"
        raise InputError(f"expected a plane mesh, z = const{where}, got {got}")
    return points[:, :2]
