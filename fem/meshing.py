"""T6 meshes with the specimen's own symmetries: one quarter cell, mirrored and tiled.

A mesh without the mirror symmetries makes the bifurcation imperfect, and Newton's method may slip
onto a branch unnoticed. So gmsh meshes only a few small blocks, with equal divisions on shared
sides, and numpy reflects and places them. Mid-side nodes of hole edges lie on the ellipse.
"""

from __future__ import annotations

import math
import pickle
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import gmsh
import numpy as np

from modeharvest.fem.specimen import Imperfection, Specimen, centred
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.errors import InputError
from modeharvest.util.machine import require_memory

if TYPE_CHECKING:  # imported where needed: a child process for meshing starts in half the time
    from modeharvest.fem.field import Mesh


def perturb(mesh: Mesh, specimen: Specimen, imperfection: Imperfection) -> Mesh:
    """Move a mesh's holes randomly; InputError if 4 standard deviations exceed half a ligament."""
    half = 0.5 * specimen.ligament_width
    growth_sd = imperfection.diameter_sd + imperfection.ovality_sd
    reach = 4.0 * (imperfection.position_sd + 0.5 * growth_sd)
    if reach > half:
        raise InputError(
            f"imperfection: expected 4 (position_sd + diameter_sd / 2 + ovality_sd / 2) <= "
            f"{half:.3g} mm, half a ligament, got {reach:.3g} mm; make the scatter smaller"
        )
    if imperfection.is_none:
        return mesh
    holes = imperfection.drawn(len(specimen.hole_centres))
    return replace(mesh, nodes=mesh.nodes + hole_motion(mesh.nodes, specimen, holes))


def hole_motion(nodes: FloatArray, specimen: Specimen, holes: FloatArray) -> FloatArray:
    """(n, 2) motion of nodes (n, 2) due to deviations ``holes`` (holes, 5) of the holes [mm].

    The deviations are: x and y of the centre; the diameter, at constant aspect of an ellipse; the
    ovality, longer along x and shorter along y; and the same along the diagonals x = y and x = -y.
    Edges of holes stay ellipses. The motion decreases to zero at the cell's boundary, so cells do
    not affect each other and the outer edges stay straight. Linear in ``holes``.
    """
    number, scale = specimen.nearest_hole(nodes), np.array([1.0, specimen.aspect])
    radius, outer = 0.5 * specimen.diameters[number], 0.5 * specimen.largest_diameter
    arm = (nodes - specimen.hole_centres[number]) / scale
    distance = np.linalg.norm(arm, axis=1)
    fade = np.clip((distance - radius) / (outer - radius), 0.0, 1.0)
    weight = np.where(distance < outer, np.cos(0.5 * np.pi * fade) ** 2, 0.0)
    x, y = arm.T / distance
    d, along_x, slant = 0.5 * holes[number, 2:].T
    growth = np.column_stack([(d + along_x) * x + slant * y, slant * x + (d - along_x) * y])
    return np.asarray(weight[:, None] * (holes[number, :2] + growth * scale))


# Reflection inverts a T6 element; this reorders its nodes counter-clockwise.
REVERSED_T6 = [0, 2, 1, 5, 4, 3]
_BYTES_PER_ELEMENT = 15e3
"""Memory for meshing, assembly and factor; 13 kB were measured for 9 000 to 83 000 elements."""
SIGNS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
"""Signs of the coordinates (x, y) in the four quadrants."""


@dataclass(frozen=True)
class MeshBlock:
    """A small T6 mesh to be placed many times."""

    nodes: FloatArray
    """(n, 2) positions [mm]."""
    cells: IntArray
    """(m, 6) node numbers of each element."""

    def placed(self, sign: tuple[float, float], origin: tuple[float, float]) -> MeshBlock:
        """The block reflected about its own axes by ``sign`` and moved to ``origin`` [mm]."""
        cells = self.cells if sign[0] * sign[1] > 0 else self.cells[:, REVERSED_T6]
        return MeshBlock(np.asarray(origin) + np.asarray(sign) * self.nodes, cells)

    def turned(self, angle: float) -> MeshBlock:
        """The block rotated counter-clockwise about the origin by ``angle`` [rad]."""
        c, s = math.cos(angle), math.sin(angle)
        return MeshBlock(self.nodes @ np.array([[c, s], [-s, c]]), self.cells)


def quarter_cell(pitch: float, diameter: float, size: float) -> MeshBlock:
    """A quarter of the square unit cell, [0, l/2]^2; see :func:`quarter_polygon`."""
    half, radius = 0.5 * pitch, 0.5 * diameter
    return quarter_polygon((half, half), half, (radius, radius), size)


def quarter_polygon(
    heights: tuple[float, float], width: float, radii: tuple[float, float], size: float
) -> MeshBlock:
    """A quarter of a unit cell around an elliptical hole with its centre at the origin.

    InputError if ``size`` leaves fewer than two elements on a quarter of the hole's edge.

    heights : y of the cell's upper side at x = width and at x = 0 [mm]; equal for a rectangle.
    width : half the cell's width [mm].
    radii : semi-axes of the hole along x and y [mm].
    size : target edge length of the elements [mm].
    """
    from scipy.special import ellipe

    low, high = heights
    a, b = radii
    arc = float(max(a, b) * ellipe(1.0 - (min(a, b) / max(a, b)) ** 2))
    coarsest = 0.5 * arc
    if size > coarsest:
        raise InputError(
            f"mesh size: expected at most {coarsest:.3g} mm (two elements on a quarter of the "
            f"hole's edge), got {size} mm; give a smaller mesh size"
        )
    corners = [(a, 0.0), (width, 0.0), (width, low), (0.0, high), (0.0, b)]
    lengths = [width - a, low, math.hypot(width, high - low), high - b, arc]
    return mesh_block(corners, [divisions_of(length, size) for length in lengths], arcs=[4])


def rectangle(width: float, height: float, n_width: int, n_height: int) -> MeshBlock:
    """The block [0, width] x [0, height] with the given numbers of elements on its sides."""
    corners = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)]
    return mesh_block(corners, [n_width, n_height, n_width, n_height])


def mesh_specimen(specimen: Specimen, size: float) -> Mesh:
    """The specimen's T6 mesh, exactly symmetric (to the last bit) about the holes' mirror axes.

    These are both axes, unless diameters are graded. ``size``: target edge length of the elements
    [mm]; InputError if it is not positive, or too large for the cells.
    """
    width, height = specimen.half_size
    require_size(size, 4.0 * width * height)
    return join(list(_tiles(specimen, size)), tolerance=1e-7 * specimen.pitch)


def require_size(size: float, area: float) -> None:
    """Raise InputError for an unusable edge length ``size`` of elements [mm].

    That is, if it is not positive, or so small that meshing and factorisation would need more
    memory than there is; ``area``: area to be meshed, including holes [mm^2].
    """
    if not 0 < size < math.inf:
        raise InputError(f"mesh size: expected a positive length in mm, got {size}")
    count = area / size / size
    what = f"a mesh of about {count:.2g} elements"
    require_memory(_BYTES_PER_ELEMENT * count, what, "enlarge mesh_size")


def join(blocks: list[MeshBlock], tolerance: float) -> Mesh:
    """Join blocks to one T6 mesh; nodes closer than ``tolerance`` [mm] are merged."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    from modeharvest.fem.field import Mesh

    offsets = np.cumsum([0] + [len(b.nodes) for b in blocks[:-1]])
    nodes = np.vstack([b.nodes for b in blocks])
    cells = np.vstack([b.cells + k for b, k in zip(blocks, offsets, strict=True)])
    pairs = cKDTree(nodes).query_pairs(tolerance, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(nodes), len(nodes)))
    count, label = connected_components(links, directed=False)
    merged = np.empty((count, 2))
    for axis, values in enumerate(np.where(np.abs(nodes) < tolerance, 0.0, nodes).T):
        # Of coordinates that differ by rounding, take the smallest: consistent with mirror images.
        order = np.lexsort((np.abs(values), label))
        _, first = np.unique(label[order], return_index=True)
        merged[:, axis] = values[order][first]
    return Mesh(merged, label[cells].astype(np.int64), "T6")


def divisions_of(length: float, size: float) -> int:
    """Number of elements of at most ``size`` [mm] along a side of ``length`` [mm]."""
    return max(1, math.ceil(length / size - 1e-9))


def _tiles(specimen: Specimen, size: float) -> Iterator[MeshBlock]:
    half, aspect = 0.5 * specimen.pitch, specimen.aspect
    a, b = specimen.cellular_half_size
    low, high = heights = specimen.cell_heights
    diameters, which = np.unique(specimen.diameters, return_inverse=True)
    radii = [(0.5 * float(d), 0.5 * float(aspect * d)) for d in diameters]
    cells = [quarter_polygon(heights, half, radius, size) for radius in radii]
    for (x, y), k in zip(specimen.hole_centres, which, strict=True):
        yield from (cells[k].placed(sign, (x, y)) for sign in SIGNS)
    if specimen.is_staggered:
        yield from _fillers(specimen, size)

    n_half = divisions_of(half, size)
    n_x, n_y = divisions_of(specimen.bulk_x, size), divisions_of(specimen.bulk_y, size)
    if specimen.bulk_x > 0:
        sides = {h: rectangle(specimen.bulk_x, h, n_x, divisions_of(h, size)) for h in heights}
        is_full = specimen.row_counts == specimen.holes_x
        for y, full in zip(specimen.row_heights, is_full, strict=True):
            strip = sides[low if full else high]
            yield from (strip.placed(s, (s[0] * a, y)) for s in SIGNS)
    if specimen.bulk_y > 0:
        strip = rectangle(half, specimen.bulk_y, n_half, n_y)
        for x in centred(specimen.holes_x) * specimen.pitch:
            yield from (strip.placed(s, (x, s[1] * b)) for s in SIGNS)
    if specimen.bulk_x > 0 and specimen.bulk_y > 0:
        corner = rectangle(specimen.bulk_x, specimen.bulk_y, n_x, n_y)
        yield from (corner.placed(s, (s[0] * a, s[1] * b)) for s in SIGNS)


def _fillers(specimen: Specimen, size: float) -> Iterator[MeshBlock]:
    """Blocks that complete the hexagonal cells of staggered rows to a rectangle.

    These are half cells without a hole at both ends of a shorter row, triangles between the
    corners of the cells at top and bottom, and the bulk beside the last triangles.
    """
    half, (low, high) = 0.5 * specimen.pitch, specimen.cell_heights
    a, _ = specimen.cellular_half_size
    n_half, n_low, n_high, n_gap = (divisions_of(d, size) for d in (half, low, high, high - low))
    slant = divisions_of(math.hypot(half, high - low), size)
    corners = [(0.0, 0.0), (half, 0.0), (half, low), (0.0, high)]
    end = mesh_block(corners, [n_half, n_low, slant, n_high])
    gap = mesh_block([(0.0, high), (half, low), (half, high)], [slant, n_gap, n_half])
    last = specimen.holes_y - 1
    for row, (y, count) in enumerate(zip(specimen.row_heights, specimen.row_counts, strict=True)):
        is_full = count == specimen.holes_x
        halves = [] if is_full else [(-a, 1.0), (a, -1.0)]  # x, and direction inwards
        for x, sign in halves:
            yield from (end.placed((sign, up), (x, y)) for up in (1.0, -1.0))
        centres = centred(count) * specimen.pitch
        for up in (side for side, at in ((-1.0, 0), (1.0, last)) if at == row):
            places = [*halves, *((x, sign) for x in centres for sign in (1.0, -1.0))]
            yield from (gap.placed((sign, up), (x, y)) for x, sign in places)
            if is_full and (width := specimen.bulk_x) > 0:
                beside = rectangle(width, high - low, divisions_of(width, size), n_gap)
                yield from (beside.placed((s, up), (s * a, y + up * low)) for s in (1.0, -1.0))


def mesh_block(
    corners: list[tuple[float, float]], divisions: list[int], arcs: Collection[int] = ()
) -> MeshBlock:
    """Mesh a polygon with T6 elements, by gmsh.

    corners, divisions : the polygon's corners, counter-clockwise [mm]; number of elements on each
        side, the first side from the first to the second corner.
    arcs : numbers of the sides that are arcs about the origin: of a circle, or, if they end on both
        axes, of an ellipse.
    """
    with quiet_gmsh():
        geo = gmsh.model.geo
        points = [geo.addPoint(x, y, 0.0) for x, y in corners]
        centre = geo.addPoint(0.0, 0.0, 0.0) if arcs else 0
        curves = []
        for k, (p, q) in enumerate(zip(points, points[1:] + points[:1], strict=True)):
            if k not in arcs:
                curves.append(geo.addLine(p, q))
                continue
            ends = math.hypot(*corners[k]), math.hypot(*corners[(k + 1) % len(corners)])
            if math.isclose(*ends, rel_tol=1e-9):
                curves.append(geo.addCircleArc(p, centre, q))
            else:
                curves.append(geo.addEllipseArc(p, centre, p if ends[0] > ends[1] else q, q))
        for curve, n in zip(curves, divisions, strict=True):
            geo.mesh.setTransfiniteCurve(curve, n + 1)
        geo.addPlaneSurface([geo.addCurveLoop(curves)])
        geo.synchronize()
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(2)
        return _current_block()


@contextmanager
def quiet_gmsh() -> Iterator[None]:
    """Context with an empty gmsh model and no output; the caller's open models are kept."""
    if ours := not gmsh.isInitialized():
        gmsh.initialize(interruptible=False)
    before = gmsh.model.getCurrent()
    numbers = {"Mesh.Algorithm": 6, "Mesh.SecondOrderLinear": 0, "Mesh.MeshSizeMax": 1e22}
    try:
        with gmsh_options({"General.Terminal": 0, "General.NumThreads": 1, **numbers}):
            gmsh.model.add("modeharvest")
            yield
    finally:
        if ours:
            gmsh.finalize()
        else:
            gmsh.model.remove()
            gmsh.model.setCurrent(before)


@contextmanager
def gmsh_options(numbers: Mapping[str, float]) -> Iterator[None]:
    """Context in which options of gmsh, by name, have given values."""
    kept = {name: gmsh.option.getNumber(name) for name in numbers}
    for name, value in numbers.items():
        gmsh.option.setNumber(name, value)
    try:
        yield
    finally:
        for name, value in kept.items():
            gmsh.option.setNumber(name, value)


def _current_block() -> MeshBlock:
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    _, connectivity = gmsh.model.mesh.getElementsByType(9)  # 9: the six-node triangle
    cells = connectivity.reshape(-1, 6)
    used, numbers = np.unique(cells, return_inverse=True)
    position = dict(zip(tags, coordinates.reshape(-1, 3)[:, :2], strict=True))
    return MeshBlock(np.array([position[tag] for tag in used]), numbers.astype(np.int64))


def mesh_boundaries(
    parts: Collection[Collection[Collection[FloatArray]]], size: float, edge_size: float
) -> MeshBlock:
    """Mesh plane bodies bounded by smooth curves with T6 elements.

    parts : For each body its loops: the outer boundary first, then the holes. A loop is a sequence
        of curves (k, 2) [any unit], each of which ends where the next one begins; each curve is a
        spline through its points.
    size, edge_size : Edge length of the elements inside and along the loops [the same unit], with
        a transition over two elements; shorter along short loops.
    """
    grow = {"Mesh.MeshSizeExtendFromBoundary": 0, "Mesh.MeshSizeMax": size}
    with quiet_gmsh(), gmsh_options(grow):
        geo = gmsh.model.geo
        for loops in parts:
            geo.addPlaneSurface([_add_loop(loop, edge_size) for loop in loops])
        geo.synchronize()
        curves = [tag for _, tag in gmsh.model.getEntities(1)]
        numbers = {"InField": 1, "SizeMin": edge_size, "SizeMax": size, "DistMax": 2.0 * size}
        field = gmsh.model.mesh.field
        field.add("Distance", 1)
        field.setNumbers(1, "CurvesList", curves)
        field.add("Threshold", 2)
        for name, value in numbers.items():
            field.setNumber(2, name, value)
        field.setAsBackgroundMesh(2)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(2)
        return _current_block()


_LEAST_ELEMENTS, _ELEMENTS = 8, 32
"""Around a loop; the latter unless sides would be shorter than two thirds of the given size."""


def _add_loop(loop: Collection[FloatArray], size: float) -> int:
    geo = gmsh.model.geo
    lengths = [float(np.linalg.norm(np.diff(c, axis=0), axis=1).sum()) for c in loop]
    size = min(size, max(sum(lengths) / _ELEMENTS, size / 1.5), sum(lengths) / _LEAST_ELEMENTS)
    begins = [geo.addPoint(*curve[0], 0.0) for curve in loop]
    curves = []
    for k, (curve, length) in enumerate(zip(loop, lengths, strict=True)):
        interior = [geo.addPoint(*point, 0.0) for point in curve[1:-1]]
        ends = begins[k], begins[(k + 1) % len(begins)]
        curves.append(geo.addSpline([ends[0], *interior, ends[1]]))
        geo.mesh.setTransfiniteCurve(curves[-1], max(1, round(length / size)) + 1)
    return int(geo.addCurveLoop(curves))


if __name__ == "__main__":  # run in a child process with a time limit: gmsh can't be interrupted
    block = mesh_boundaries(*pickle.load(sys.stdin.buffer))
    sys.stdout.buffer.write(pickle.dumps((block.nodes, block.cells)))
