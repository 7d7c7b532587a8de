"""Contours of a picture matched with the same ones in another: closed ones, cut ones, dots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from modeharvest.idic.photograph.plain.surface import CORRELATED_PX, MaterialContours
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.contour import Contour, SeenContours
from modeharvest.util.arrays import FloatArray, IntArray
from modeharvest.util.errors import InputError

_ROUNDS = 3
_TURNS_DEG = np.arange(-24.0, 25.0, 6.0)
"""Rotations of the specimen between two pictures that are tried."""
_GROWING = np.array([4.0, 6.0, 9.0, 14.0, 20.0, 30.0, np.inf, np.inf])
"""Distances from the picture's middle within which holes are matched in turn, over the reach of a
match: holes matched before predict where the next ones are."""
_ALIKE = 0.4
"""Radius within which a hole is searched, over the distance to the next hole."""


@dataclass(frozen=True, eq=False)
class MatchedContours:
    """The same contours in two pictures."""

    seen: SeenContours
    affine: FloatArray
    """(3, 2): a point's displacement is about (x, y, 1) times this [-, and mm]."""
    holes: tuple[tuple[Contour, Contour], ...]
    """Contours of the same holes in the reference and in the deformed picture."""
    lost: int
    """Holes of the reference that weren't found in the deformed picture."""

    def start(self, points: FloatArray) -> FloatArray:
        """(n, 2) displacement of points (n, 2) [mm] by the affine motion."""
        return affine_displacement(points, self.affine)


def matched_contours(
    reference: MaterialContours, deformed: MaterialContours, grid: PixelGrid
) -> MatchedContours:
    """Find each contour of a picture again in another one.

    InputError if fewer than half of the holes are found, or fewer than three in a part of a
    specimen. Contours that are cut are searched where the holes' affine motion takes them.
    """
    outer, holes, cut, dots = reference.on(grid)
    outer_g, others, cut_g, dots_g = deformed.on(grid)
    whole = bool(outer and outer_g)
    a = np.array([hole.moments[1] for hole in holes]).reshape(-1, 2)
    b = np.array([hole.moments[1] for hole in others]).reshape(-1, 2)
    pairs = _paired(a, b, whole) if len(holes) > 2 and len(others) > 2 else []
    if 2 * len(pairs) < len(holes) or not (whole or len(pairs) > 2):
        part = "," if whole else ", of which not all is in view,"
        raise InputError(
            f"expected the reference's {len(holes)} holes in the deformed picture{part} found "
            f"{len(pairs)} of them among {len(others)}; give pictures in "
            "between, or of one and the same specimen"
        )
    found = tuple((holes[i], others[j]) for i, j in pairs)
    if len(pairs) < 3:
        (centre, second), (centre_g, second_g) = (c[0].moments[1:] for c in (outer, outer_g))
        linear = np.diag(np.sqrt(np.diag(second_g)) / np.sqrt(np.diag(second)))
        affine = np.vstack([linear - np.eye(2), centre_g - centre @ linear])
    else:
        i, j = np.array(pairs).T
        affine = fitted_affine(a[i], b[j])
    left = [hole for k, hole in enumerate(holes) if k not in dict(pairs)]
    taken = {j for _, j in pairs}
    left_g = [hole for k, hole in enumerate(others) if k not in taken]
    rest, rest_g = [*cut, *left, *outer], [*cut_g, *left_g, *outer_g]
    arcs = () if whole else _paired_arcs(rest, rest_g, affine, _ALIKE * median_spacing(a))
    every = (*zip(outer, outer_g, strict=False), *found) if whole else (*found, *arcs)
    noise = (reference.noise + deformed.noise) * grid.pixel_size**3
    sides = tuple(c for c, _ in every), tuple(c for _, c in every)
    seen = SeenContours(*sides, noise, CORRELATED_PX * grid.pixel_size,
                        _paired_dots(dots, dots_g, affine), reference.is_part)  # fmt: skip
    lost = len(left) - sum(any(c is hole for hole in left) for c, _ in arcs)
    return MatchedContours(seen, affine, found, lost)


def _paired_arcs(
    f: Sequence[Contour], g: Sequence[Contour], affine: FloatArray, reach: float
) -> tuple[tuple[Contour, Contour], ...]:
    """Pairs of the same contour in two pictures; at least one of each pair is cut."""
    trees, found = [cKDTree(contour.points) for contour in g], []
    for contour in f:
        x = contour.points + affine_displacement(contour.points, affine)
        far = [
            float(np.median(tree.query(x)[0])) if not (contour.closed and other.closed) else np.inf
            for tree, other in zip(trees, g, strict=True)
        ]
        if far and min(far) < reach:
            found.append((contour, g[int(np.argmin(far))]))
    return tuple(found)


def _paired_dots(
    f: Sequence[Contour], g: Sequence[Contour], affine: FloatArray
) -> tuple[tuple[Contour, Contour], ...]:
    """Pairs of the same dot in two pictures, near where the holes' affine motion takes it."""
    if not (f and g):
        return ()
    a, b = (np.array([contour.moments[1] for contour in side]) for side in (f, g))
    reach = _ALIKE * median_spacing(a) if len(a) > 1 else np.inf
    pairs = _assigned(a + affine_displacement(a, affine), b, reach)
    return tuple((f[i], g[j]) for i, j in pairs)


def median_spacing(a: FloatArray) -> float:
    """Median distance of points (n, 2) to the nearest other one."""
    return float(np.median(cKDTree(a).query(a, k=2)[0][:, 1]))


def fitted_affine(a: FloatArray, b: FloatArray) -> FloatArray:
    """(3, 2) affine displacement of points a to points b (n, 2), fitted by least squares."""
    return np.asarray(np.linalg.lstsq(np.column_stack([a, np.ones(len(a))]), b - a)[0])


def affine_displacement(points: FloatArray, affine: FloatArray) -> FloatArray:
    """(n, 2) displacement of points (n, 2) by an affine one (3, 2): (x, y, 1) times this."""
    return np.asarray(np.column_stack([points, np.ones(len(points))]) @ affine)


def _assigned(a: FloatArray, b: FloatArray, reach: float) -> IntArray:
    """(k, 2) indices of points a (n, 2) and b (m, 2) that are the same, nearer than ``reach``."""
    distance = np.linalg.norm(a[:, None] - b, axis=2)
    i, j = linear_sum_assignment(np.minimum(distance, 2.0 * reach))
    return np.asarray(np.stack([i, j], axis=1)[distance[i, j] < reach])


def _paired(a: FloatArray, b: FloatArray, whole: bool) -> list[tuple[int, int]]:
    """Pairs of indices of points a (n, 2) and the same points in b (m, 2), after a motion.

    If not all is in view, those in the middle have moved by less than 0.4 of their spacing.
    """
    reach = _ALIKE * median_spacing(a)
    there, far = (_laid_over(a, b, reach), [np.inf] * _ROUNDS) if whole else (a, _GROWING * reach)
    for radius in far:
        pairs = _assigned(there, b, reach)
        pairs = pairs[np.linalg.norm(a[pairs[:, 0]], axis=1) < radius]
        if len(pairs) > 2:
            there = a + affine_displacement(a, fitted_affine(a[pairs[:, 0]], b[pairs[:, 1]]))
    return [(int(i), int(j)) for i, j in pairs]


def _laid_over(a: FloatArray, b: FloatArray, reach: float) -> FloatArray:
    """Points a (n, 2) rotated, stretched and shifted so that they lie about upon b (m, 2)."""
    best: tuple[float, FloatArray] = (np.inf, a)
    for turn in np.deg2rad(_TURNS_DEG):
        back = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        upright = (b - b.mean(axis=0)) @ back
        centred = a - a.mean(axis=0)
        scale = upright.std(axis=0) / np.maximum(centred.std(axis=0), 1e-12)
        stretched = centred * np.where(centred.std(axis=0) > 0.0, scale, 1.0)
        there = stretched @ back.T + b.mean(axis=0)
        distance = cKDTree(b).query(there)[0]
        cost = float(np.minimum(distance, reach).sum())
        best = min(best, (cost, there), key=lambda found: found[0])
    return best[1]
