"""Holes in a mask of the material, and the lattice on which they lie.

The vectors from hole to neighbouring hole cluster around the lattice's own. The two most frequent
ones that are not parallel are reduced to the shortest. Stepping from each hole to its neighbours
then gives every hole its index (i, j), also where the lattice is bent or holes are missing.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import center_of_mass, label
from scipy.spatial import Delaunay, KDTree

from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.errors import InputError

_MUCH_SMALLER = 0.25
"""Openings below this share of the typical area are scratches, bubbles and noise."""
_ALIKE = 0.25
"""Distance, as a share of the pitch, within which vectors are the same lattice vector, and holes
are at a lattice point: locally, strain differs by 10 %, and holes are moulded a little off."""


@dataclass(frozen=True, eq=False)
class Holes:
    """Holes of one image."""

    centres: FloatArray
    """(n, 2) centroids, (row, col) [px]."""
    diameters: FloatArray
    """(n,) diameters of circles with the holes' areas [px]."""
    too_small: int
    """Number of openings left out because the others are much larger."""
    at_border: int
    """Number of openings that reach the image's border: background, or holes cut off."""

    def __len__(self) -> int:
        return len(self.centres)


def find_holes(mask: ArrayLike, smallest_px2: float | None = None) -> Holes:
    """Find the holes in a mask (rows, cols), True on material.

    Holes have at least ``smallest_px2`` [px^2], by default a quarter of the typical area. Raises
    InputError if the mask is not plane, or has no material or nothing else in it.
    """
    material = np.asarray(mask, dtype=np.bool_)
    if material.ndim != 2:
        raise InputError(f"expected a mask of rows x columns, got shape {material.shape}")
    if not material.any() or material.all():
        raise InputError(
            "expected material and holes in the mask, got a mask with nothing in it: "
            f"{'True' if material.any() else 'False'} everywhere"
        )
    parts, count = label(~material)
    border = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    border = border[border > 0]
    areas = np.bincount(parts.ravel(), minlength=count + 1).astype(np.float64)
    inner = np.setdiff1d(np.arange(1, count + 1), border)
    if smallest_px2 is None:
        # By the area above which half of all the hole area lies: many specks don't change it.
        ordered = np.sort(areas[inner])[::-1]
        half = np.searchsorted(np.cumsum(ordered), 0.5 * ordered.sum())
        smallest_px2 = _MUCH_SMALLER * float(ordered[half]) if inner.size else 0.0
    large = inner[areas[inner] >= smallest_px2]
    centres = np.array(center_of_mass(~material, parts, large), dtype=np.float64)
    return Holes(
        centres=centres.reshape(-1, 2),
        diameters=2.0 * np.sqrt(areas[large] / np.pi),
        too_small=int(inner.size - large.size),
        at_border=int(border.size),
    )


def spanning_vectors(spots: FloatArray) -> FloatArray | None:
    """The two shortest vectors that span the lattice on which most of some points (n, 2) lie.

    (2, 2) vectors as rows, the first to the right and the second upwards, like the points (up,
    right) [px]; None if the points lie in one row.
    """
    tree = KDTree(spots)
    distance, neighbour = tree.query(spots, k=min(9, len(spots)))
    nearest = float(np.median(distance[:, 1]))
    steps = (spots[neighbour] - spots[:, None])[(distance > 0) & (distance < 1.7 * nearest)]
    steps = np.concatenate([steps, -steps])
    gathered = KDTree(steps)
    near = gathered.query_ball_point(steps, _ALIKE * nearest)
    crowd = np.array([len(k) for k in near])
    # Of two equally frequent steps, the shorter one.
    order = np.lexsort([np.linalg.norm(steps, axis=1).round(6), -crowd])
    first = steps[near[order[0]]].mean(axis=0)
    for k in order:
        second = steps[near[k]].mean(axis=0)
        if _sine(first, second) > 0.5:
            return _oriented(_reduced(first, second))
    return None


def _sine(a: FloatArray, b: FloatArray) -> float:
    return abs(float(a[0] * b[1] - a[1] * b[0])) / float(np.linalg.norm(a) * np.linalg.norm(b))


def _reduced(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lagrange's reduction: the shortest two vectors that span the same lattice."""
    while True:
        if a @ a > b @ b:
            a, b = b, a
        turns = np.round((a @ b) / (a @ a))
        if turns == 0.0:
            return a, b
        b = b - turns * a


def _oriented(basis: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Choose i to the right and j upwards; of three directions 60 degrees apart, the best two."""
    a, b = basis
    third = a - b if a @ b > 0 else a + b
    candidates = [a, b]
    if np.linalg.norm(third) < 1.2 * np.linalg.norm(b):
        candidates.append(third)
    candidates += [-v for v in candidates]
    unit = [v / np.linalg.norm(v) for v in candidates]
    # A slight preference for the upper one settles ties.
    i = int(np.argmax([u[1] + 1e-3 * u[0] for u in unit]))
    j = int(np.argmax([u[0] + 1e-3 * u[1] if _sine(u, unit[i]) > 0.5 else -1.0 for u in unit]))
    return np.stack([candidates[i], candidates[j]])


Kind = Literal["square", "hexagonal", "rectangular", "oblique"]

_BENT = 0.25
"""Largest rms distance from a straight lattice, as a share of the pitch."""
_MOST = 0.5
"""Share of the holes that must be on the lattice."""
_EQUAL, _RIGHT_DEG = 0.06, 4.0
"""Tolerances of "equally long" and of angles."""
_WRONG_CELL = 0.1
"""Relative difference from which on a given cell size is contradicted by the holes."""
_FLIP = np.array([-1.0, 1.0])
"""(row, col) times this is (up, right)."""


@dataclass(frozen=True, eq=False)
class HoleLattice:
    """Holes and the lattice they lie on.

    The centre of hole (i, j) is ``origin + i vectors[0] + j vectors[1]`` within ``misfit_px``.
    """

    centres: FloatArray
    """(n, 2) hole centres on the lattice, (row, col) [px]."""
    index: IntArray
    """(n, 2) integers (i, j) from 0: i to the right, j upwards."""
    vectors: FloatArray
    """(2, 2) lattice vectors as rows, each (row, col) [px], of the best straight lattice."""
    origin: FloatArray
    """(2,) position (row, col) of the lattice point (0, 0) [px]."""
    diameters: FloatArray
    """(n,) diameters of circles with the holes' areas [px]."""
    missing: IntArray
    """(m, 2) indices of lattice points amid the others without a hole."""
    extra: FloatArray
    """(k, 2) centres of holes that are not on the lattice, (row, col) [px]."""
    misfit_px: float
    """Rms distance of the centres from the straight lattice [px]."""
    kind: Kind
    too_small: int
    """Number of much smaller openings that were left out."""

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def pitch_px(self) -> float:
        """Cell size: mean length of the two lattice vectors [px]."""
        return float(np.linalg.norm(self.vectors, axis=1).mean())

    @property
    def rotation_deg(self) -> float:
        """Angle from the image's rows to the first lattice vector, anticlockwise [degrees]."""
        up, right = self.vectors[0] * _FLIP
        return float(np.degrees(np.arctan2(up, right)))

    @property
    def counts(self) -> tuple[int, int]:
        """Number of different i and of different j."""
        i, j = np.ptp(self.index, axis=0) + 1
        return int(i), int(j)

    @property
    def text(self) -> tuple[str, ...]:
        """What was found."""
        d, (i, j), (a, b) = self.diameters, self.counts, np.linalg.norm(self.vectors, axis=1)
        turn = round(self.rotation_deg, 2) + 0.0  # not −0.00
        text = [
            f"{len(self)} holes on a {self.kind} lattice, {i} x {j}, of {a:.1f} and {b:.1f} px, "
            f"turned by {turn:+.2f} degrees, {self.misfit_px:.2f} px rms off it; "
            f"diameters {d.mean():.2f} ± {d.std():.2f} px."
        ]
        if len(self.missing):
            text.append(f"Holes missing at lattice points amid them: {len(self.missing)}.")
        if len(self.extra):
            text.append(f"Holes off the lattice, left out: {len(self.extra)}.")
        if self.too_small:
            text.append(f"Much smaller openings, left out: {self.too_small}.")
        return tuple(text)

    def position(self, index: ArrayLike) -> FloatArray:
        """(..., 2) (row, col) [px] of lattice points (i, j), which need not be whole numbers."""
        return np.asarray(self.origin + np.asarray(index, dtype=np.float64) @ self.vectors)


def find_hole_lattice(mask: ArrayLike, cell_px: float | None = None) -> HoleLattice:
    """Find the lattice in a mask (rows, cols), True on material.

    The cell size [px], if it is known, is compared with what is found. Raises InputError if there
    are fewer than four holes, no lattice in them, or another cell size.
    """
    return lattice_of(find_holes(mask), cell_px)


def lattice_of(holes: Holes, cell_px: float | None = None) -> HoleLattice:
    """Find the lattice of given holes; see :func:`find_hole_lattice`."""
    if len(holes) < 4:
        cut = f" ({cut} openings at the border don't count)" if (cut := holes.at_border) > 1 else ""
        raise _no_lattice(len(holes), f"where 2 x 2 are needed{cut}")
    spots = holes.centres * _FLIP
    vectors = spanning_vectors(spots)
    if vectors is None:
        raise _no_lattice(len(holes), "in one row")
    index, known = _counted(spots, vectors)
    if known.mean() < _MOST or known.sum() < 4 or np.ptp(index[known], axis=0).min() == 0:
        raise _no_lattice(len(holes), f"of which {known.sum()} are a lattice vector apart")
    origin, vectors, misfit = _straight(spots[known], index[known])
    pitch = float(np.linalg.norm(vectors, axis=1).mean())
    if misfit > _BENT * pitch:
        raise _no_lattice(len(holes), f"up to {misfit:.0f} px off one of {pitch:.0f} px")
    found = HoleLattice(
        centres=holes.centres[known], index=index[known], vectors=vectors * _FLIP,
        origin=origin * _FLIP, diameters=holes.diameters[known], missing=_missing(index[known]),
        extra=holes.centres[~known], misfit_px=misfit, kind=_kind(vectors),
        too_small=holes.too_small,
    )  # fmt: skip
    apart = float(np.linalg.norm(vectors, axis=1).min())
    off = 0.0 if cell_px is None else cell_px / apart - 1.0
    if cell_px is not None and (not cell_px > 0 or abs(off) > _WRONG_CELL):
        raise InputError(
            f"expected a cell size near {apart:.1f} px, the distance of neighbouring holes in the "
            f"image, got {cell_px:.3g} px ({100 * off:+.0f} %); correct the cell size or pixel size"
        )
    return found


def _counted(spots: FloatArray, vectors: FloatArray) -> tuple[IntArray, BoolArray]:
    """(index from 0, known): count from neighbour to neighbour, in the largest connected part."""
    steps = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
    tree, reach = KDTree(spots), _ALIKE * float(np.linalg.norm(vectors, axis=1).min())
    distance, there = tree.query(spots[:, None] + steps @ vectors, distance_upper_bound=reach)
    best: dict[int, tuple[int, int]] = {}
    free = set(range(len(spots)))
    while len(free) > len(best):
        part = _connected(min(free), there, np.isfinite(distance), steps)
        free -= set(part)
        best = max(best, part, key=len)
    taken = Counter(best.values())
    index, known = np.zeros((len(spots), 2), dtype=np.int64), np.zeros(len(spots), dtype=np.bool_)
    for spot, ij in best.items():
        index[spot], known[spot] = ij, taken[ij] == 1  # two holes can't be one lattice point
    if known.any():
        index -= index[known].min(axis=0)
    return index, known


def _connected(
    start: int, there: IntArray, exists: BoolArray, steps: IntArray
) -> dict[int, tuple[int, int]]:
    """Index of every hole that can be reached from one."""
    index, queue = {start: (0, 0)}, deque([start])
    while queue:
        here = queue.popleft()
        i, j = index[here]
        for k in np.flatnonzero(exists[here]):
            neighbour = int(there[here, k])
            if neighbour not in index:
                index[neighbour] = i + int(steps[k, 0]), j + int(steps[k, 1])
                queue.append(neighbour)
    return index


def _straight(spots: FloatArray, index: IntArray) -> tuple[FloatArray, FloatArray, float]:
    """(origin, vectors, rms distance) of the straight lattice nearest to the holes."""
    matrix: FloatArray = np.column_stack([np.ones(len(index)), index])
    found = np.asarray(np.linalg.lstsq(matrix, spots, rcond=None)[0], dtype=np.float64)
    off = spots - matrix @ found
    return found[0], found[1:], float(np.sqrt((off**2).sum(axis=1).mean()))


def _missing(index: IntArray) -> IntArray:
    """Lattice points inside the hull of the others that have no hole."""
    size = np.ptp(index, axis=0) + 1
    every = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1).reshape(-1, 2)
    inside = every[Delaunay(index).find_simplex(every) >= 0]
    return np.asarray(inside[~(inside[:, None] == index).all(axis=-1).any(axis=1)])


def _kind(vectors: FloatArray) -> Kind:
    a, b = np.linalg.norm(vectors, axis=1)
    angle = np.degrees(np.arccos(np.clip(vectors[0] @ vectors[1] / (a * b), -1.0, 1.0)))
    equal = abs(a / b - 1.0) < _EQUAL
    if abs(angle - 90.0) < _RIGHT_DEG:
        return "square" if equal else "rectangular"
    if equal and min(abs(angle - 60.0), abs(angle - 120.0)) < _RIGHT_DEG:
        return "hexagonal"
    return "oblique"


def _no_lattice(holes: int, why: str) -> InputError:
    return InputError(
        "expected holes on a lattice, got a mask with no lattice in it: "
        f"{holes or 'no'} hole{'s' * (holes != 1)} {why}; check it, or draw the cellular part"
    )
