"""A T6 mesh of the material, made from a mask or from a mesh that is given.

The boundary of a mask is the contour at one half of the mask blurred by 1.5 px, smoothed along its
length, with its corners restored. It lies within some 0.2 px of a smooth edge, also at holes.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage import measure

from modeharvest.fem.field import Mesh, with_mid_sides
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.bernstein import non_positive_jacobians, require_positive_jacobian
from modeharvest.imaging.photographs.contour import signed_area
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.errors import InputError
from modeharvest.util.masks import large_parts, opened

find_contours: Any = measure.find_contours

_BLUR_PX = 1.5
_WINDOW_PX = 41
"""Longest window of the cubic fits to a contour: it removes the steps of pixels, no curvature."""
_ROUNDED_PX = 4
"""Length of a contour, on each side of a corner, that the blur rounds off."""
_CORNER = np.deg2rad(40.0)
_ARM_PX = 12
"""Length of the sides by which a corner is found; their nearest third is rounded off."""
_LEAST_SINE = 0.2
"""Least sine of the angle between a corner's two sides for which their intersection is used."""
_NARROWEST_PX = 3.0
"""Least width of material between two holes that can be meshed."""

_PIPE, _MESHER = subprocess.PIPE, (sys.executable, "-P", "-m", "modeharvest.fem.meshing")
_SECONDS, _SECONDS_PER_ELEMENT = 60.0, 2e-3
"""Time that gmsh may take [s]: many times what it takes where no boundaries cross."""
_LEAST_ISLAND, _LEAST_HOLE = 4.0, 0.25
"""Least areas of what is meshed, over the square of an element's edge [-]."""
_MARGIN = 1.1
"""Area of a mask's pixels over that inside the smoothed boundary around them, at most [-]."""
_OPENINGS_PX = (2.0, 3.0, 4.0)
"""Radii of the disks of a morphological opening, tried in turn where material is too narrow."""
_ISLANDS_NAMED = 3

Loops = tuple[tuple[FloatArray, ...], ...]
"""Boundary loops of an island, the outer one first. Each consists of curves (k, 2) of (column,
-row) [px] that end at the loop's corners."""
_REVERSED = {"T3": [0, 2, 1], "T6": [0, 2, 1, 5, 4, 3]}
"""Order of an element's nodes that reverses its orientation."""


class MeshedMaterial(NamedTuple):
    """The part of a mask that is measured, and its mesh."""

    mesh: Mesh
    """T6 mesh [mm, or px where the size of a pixel isn't known]."""
    mask: BoolArray
    """(rows, cols) True on material that the mesh covers."""
    changes: tuple[str, ...]
    """What was left out of the mask, or filled, in sentences."""


def meshable(mask: BoolArray, element_px: float) -> tuple[BoolArray, float, tuple[str, ...]]:
    """Fill holes, and remove islands and ligaments, that are too small for elements of this size.

    Returns the remaining mask, its least width [px], and what was changed, in sentences.
    ``element_px``: length of the elements' sides along edges [px].
    """
    changes = []
    kept = mask | ~large_parts(~mask, _LEAST_HOLE * element_px**2)
    filled = int((kept & ~mask).sum())
    if filled:
        changes.append(
            f"Holes in the mask smaller than {_LEAST_HOLE * element_px**2:.0f} px were filled, "
            f"{filled} px in all."
        )
    wide, narrowest = kept, _narrowest(kept)
    for radius in _OPENINGS_PX:
        if narrowest >= _NARROWEST_PX:
            break
        wide = opened(kept, radius, at_border=True)
        narrowest = _narrowest(wide)
    if wide is not kept:
        lost = f"{int((kept & ~wide).sum())} px in all."
        changes.append(f"Material narrower than {2.0 * radius:g} px was left out, {lost}")
        kept = wide
    least = _MARGIN * _LEAST_ISLAND * element_px**2
    large = large_parts(kept, least)
    small, count = ndimage.label(kept & ~large)
    if count and large.any():
        sizes = np.bincount(small.ravel())[1:]
        where = [f"{sizes[k]} px at row {int(i[0].start)}, column {int(i[1].start)}"
                 for k, i in enumerate(ndimage.find_objects(small)[:_ISLANDS_NAMED])]  # fmt: skip
        changes.append(
            f"{count} island{'s' * (count > 1)} of the mask smaller than {least:.0f} px "
            f"{'was' if count == 1 else 'were'} left out: {'; '.join(where)}"
            f"{'; ...' if count > len(where) else ''}."
        )
        kept, narrowest = large, _narrowest(large)
    return kept, narrowest, tuple(changes)


def mesh_of_mask(
    mask: BoolArray, grid: PixelGrid, element_px: float, edge_element_px: float
) -> MeshedMaterial:
    """Mesh a mask (rows, cols) as far as possible; element sizes [px] in the interior, at edges.

    InputError if there is no island of at least four elements, or gmsh isn't installed.
    """
    if find_spec("gmsh") is None:
        raise InputError(
            "expected gmsh to make a mesh from a mask, got none; 'pip install gmsh', or give a mesh"
        )
    # gmsh is loaded while the boundaries are found.
    with subprocess.Popen(_MESHER, stdin=_PIPE, stdout=_PIPE, stderr=_PIPE) as child:
        kept, narrowest, changes = meshable(mask, edge_element_px)
        # Elements longer than a ligament is wide would make chords of its two edges cross.
        edge = min(edge_element_px, narrowest)
        if edge < _NARROWEST_PX:
            raise InputError(
                f"expected material at least {_NARROWEST_PX:g} px wide between holes, got "
                f"{edge:.1f} px; take images of more pixels, or fill the holes in the mask"
            )
        parts = boundaries(kept, edge)
        if not parts:
            raise InputError(
                f"expected a mask with material for elements of {element_px:g} px, got "
                f"{int(kept.sum())} px of it, in islands smaller than four elements; check the mask"
            )
        nodes, cells = _meshed(child, parts, element_px, edge, int(kept.sum()))
    x, y = grid.to_mm(-nodes[:, 1], nodes[:, 0])
    over = (_twice_area(nodes, cells) < 0.0)[:, None]
    cells = np.where(over, cells[:, _REVERSED["T6"]], cells)
    mesh = quadratic(Mesh(_unfolded(np.stack([x, y], axis=1), cells), cells, "T6"))
    return MeshedMaterial(mesh, kept, changes)


def _unfolded(nodes: FloatArray, cells: IntArray) -> FloatArray:
    """Nodes (n, 2); T6 elements that curved sides fold, as in a notch, get straight sides."""
    folded, straight = cells[non_positive_jacobians(nodes, cells, "T6")], nodes.copy()
    corners = nodes[folded[:, :3]]
    straight[folded[:, 3:]] = 0.5 * (corners + np.roll(corners, -1, axis=1))
    return straight


def _meshed(
    child: subprocess.Popen[bytes], parts: tuple[Loops, ...], element_px: float, edge_px: float,
    area_px: int,
) -> tuple[FloatArray, IntArray]:  # fmt: skip
    """Nodes (n, 2) [px] and T6 elements by gmsh, in a separate process that may crash or hang."""
    seconds = _SECONDS + _SECONDS_PER_ELEMENT * area_px / min(element_px, edge_px) ** 2
    try:
        found, errors = child.communicate(pickle.dumps((parts, element_px, edge_px)), seconds)
        failed = child.returncode != 0
        got = (errors.decode(errors="replace").strip().splitlines() or ["a crash"])[-1]
    except subprocess.TimeoutExpired:
        child.kill()
        failed, got = True, f"none in {seconds:.0f} s"
    if failed:
        lacks = got.startswith(("OSError: ", "ImportError: "))  # gmsh always loads graphics
        advice = "install that library" if lacks else "smooth the mask, fill its narrow holes"
        raise InputError(f"expected gmsh to mesh the mask, got {got}; {advice}, or give a mesh")
    nodes, cells = pickle.loads(found)
    return nodes, cells


def _narrowest(mask: BoolArray) -> float:
    """Least width of the material between two holes, or between a hole and the outside [px]."""
    outside = np.pad(~mask, 1, constant_values=True)
    hole, count = ndimage.label(outside)
    edge = np.nonzero(outside & ndimage.binary_dilation(~outside))
    own, points, apart = hole[edge], np.stack(edge, axis=1), np.inf
    for bit in range(count.bit_length()):  # the numbers of any two holes differ in one
        one = (own >> bit) % 2 == 1
        gaps, _ = cKDTree(points[one]).query(points[~one], distance_upper_bound=apart)
        apart = min(apart, gaps.min(initial=np.inf))
    return float(apart) - 1.0


def quadratic(mesh: Mesh) -> Mesh:
    """Convert a mesh of T3 elements to T6 by adding mid-side nodes; a T6 mesh is kept.

    Unused nodes are removed; if all elements are numbered clockwise, they are reversed. InputError
    if the elements are of another type, or folded.
    """
    used = np.unique(mesh.cells)
    if len(used) < len(mesh.nodes):
        mesh = Mesh(mesh.nodes[used], np.searchsorted(used, mesh.cells), mesh.element)
    if mesh.element in _REVERSED and (_twice_area(mesh.nodes, mesh.cells) < 0.0).all():
        mesh = Mesh(mesh.nodes, mesh.cells[:, _REVERSED[mesh.element]], mesh.element)
    if mesh.element == "T3":
        mesh = Mesh(*with_mid_sides(mesh.nodes, mesh.cells), "T6")
    if mesh.element != "T6":
        raise InputError(
            f"expected a mesh of T3 or T6 elements to measure on, got {mesh.element}; split them "
            "into triangles"
        )
    require_positive_jacobian(mesh.nodes, mesh.cells, mesh.element, "mesh of the material")
    return mesh


def _twice_area(nodes: FloatArray, cells: IntArray) -> FloatArray:
    """(m,) twice the areas of the elements' corner triangles, positive if counter-clockwise."""
    return np.asarray(np.linalg.det(nodes[cells[:, 1:3]] - nodes[cells[:, :1]]))


def boundaries(mask: BoolArray, element_px: float) -> tuple[Loops, ...]:
    """Find the boundary loops of each island of a mask, for elements of this size [px].

    Islands and holes too small for such elements are left out; :func:`meshable` reports them.
    """
    inside = np.pad(mask, 8)
    islands, count = ndimage.label(inside)
    blurred = ndimage.gaussian_filter(inside.astype(np.float32), _BLUR_PX)
    # Where both sides are the same island a blur must not close a slit, nor join two islands.
    if count > 1:
        nearest = ndimage.distance_transform_edt(~inside, None, False, True)
    loops: dict[int, list[tuple[float, FloatArray]]] = {}
    for contour in find_contours(blurred, 0.5):
        points = np.stack([contour[-2::-1, 1], -contour[-2::-1, 0]], axis=1)
        area = signed_area(points)
        row, col = np.rint(contour[0]).astype(int)
        island = 1 if count == 1 else int(islands[tuple(nearest[:, row, col])])
        # The signed area is positive for material inside a contour, x right and y up.
        if abs(area) < (_LEAST_ISLAND if area > 0.0 else _LEAST_HOLE) * element_px**2:
            continue
        loops.setdefault(island, []).append((area, points + np.array([-8.0, 8.0])))
    parts = []
    for found in (loops[k] for k in sorted(loops)):
        outer = max(found, key=lambda loop: abs(loop[0]))
        if outer[0] <= 0.0:
            continue  # a hole of an island that is too small itself
        others = [loop for loop in found if loop is not outer]
        parts.append(tuple(_smooth(points, element_px) for _, points in (outer, *others)))
    return tuple(parts)


def _smooth(points: FloatArray, element_px: float) -> tuple[FloatArray, ...]:
    """Smooth a closed contour between its corners, and sample it at two points per element."""
    from scipy.signal import savgol_filter  # 0.2 s to load, which few commands need

    length = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    total, count = float(length.sum()), max(16, int(length.sum()))
    at = np.arange(count) * total / count  # one point per pixel
    s, closed = np.concatenate([[0.0], np.cumsum(length)]), np.vstack([points, points[:1]])
    raw = np.stack([np.interp(at, s, closed[:, k]) for k in (0, 1)], axis=1)
    corners = _corners(raw)
    if not corners.size:
        around = savgol_filter(raw, _window(count), 3, axis=0, mode="wrap")
        k = max(16, round(2.0 * total / element_px))
        return (around[np.rint(np.arange(k + 1) * count / k).astype(int) % count],)
    curves = []
    for begin, end in zip(corners, np.roll(corners, -1), strict=True):
        span = int((end - begin) % count) or count
        side = raw[(begin + np.arange(_ROUNDED_PX, span - _ROUNDED_PX + 1)) % count]
        if len(side) > 5:
            side = savgol_filter(side, _window(len(side)), 3, axis=0, mode="interp")
        k = max(1, round(2.0 * len(side) / element_px))
        interior = side[np.rint(np.arange(1, k) * len(side) / k).astype(int)]
        ends = [_intersection(raw, int(corner))[None] for corner in (begin, end)]
        curves.append(np.vstack([ends[0], interior, ends[1]]))
    return tuple(curves)


def _window(count: int) -> int:
    """Smoothing window [px] of a contour of ``count`` px: odd, an eighth of it, at most 41."""
    return int(np.clip(count // 8, 5, _WINDOW_PX)) | 1


def _corners(points: FloatArray) -> IntArray:
    """Indices of the points (one per pixel) where a contour turns sharply, ascending."""
    if len(points) < 4 * _ARM_PX:
        return np.empty(0, dtype=np.int64)
    near = _ARM_PX // 3
    ahead, behind = (np.roll(points, -s * _ARM_PX, axis=0) - np.roll(points, -s * near, axis=0)
                     for s in (1, -1))  # fmt: skip
    cross = ahead[:, 0] * behind[:, 1] - ahead[:, 1] * behind[:, 0]
    turn = np.pi - np.abs(np.arctan2(cross, (ahead * behind).sum(axis=1)))
    most = ndimage.maximum_filter1d(turn, 2 * _ARM_PX + 1, mode="wrap")
    # A circle turns, too: from the middle of one arm to that of the other, 16 px, by 16 px/radius.
    least = _CORNER + (_ARM_PX + near) * 2.0 * np.pi / len(points)
    peaks = np.flatnonzero((turn == most) & (turn > least))
    middle = ndimage.gaussian_filter1d(turn, 2.0, mode="wrap")
    if peaks.size and not peaks.size < len(points) / (2 * _ARM_PX):
        return np.empty(0, dtype=np.int64)  # a small circle turns everywhere
    return np.array(
        sorted({int((p - 2 + np.argmax(middle[(p + np.arange(-2, 3)) % len(points)]))
                    % len(points)) for p in peaks}), dtype=np.int64
    )  # fmt: skip


def _intersection(points: FloatArray, corner: int) -> FloatArray:
    """Intersection of lines through a corner's two sides; the corner itself if that is far off."""
    lines = []
    for sign in (1, -1):
        side = points[(corner + sign * np.arange(_ARM_PX // 3, _ARM_PX + 1)) % len(points)]
        middle = side.mean(axis=0)
        direction = np.linalg.svd(side - middle)[2][0]
        normal = np.array([-direction[1], direction[0]])
        lines.append((normal, float(normal @ middle)))
    (a, c), (b, d) = lines
    normals = np.stack([a, b])
    if abs(np.linalg.det(normals)) < _LEAST_SINE:  # the end of a slit has another corner near
        return np.asarray(points[corner])
    found = np.linalg.solve(normals, np.array([c, d]))
    far = np.linalg.norm(found - points[corner]) >= _ROUNDED_PX
    return np.asarray(points[corner] if far else found)
