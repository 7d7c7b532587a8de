"""The finite specimen: a lattice of holes in a rectangle with bulk edges; scatter of the holes."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, require_within

MOST_HOLES = 1000
"""Largest number of holes in a direction."""


@dataclass(frozen=True)
class Stacking:
    """How rows of holes along x are stacked along y."""

    shift: float
    """Offset of a row along x relative to the row below: 0 or 0.5 [pitch]."""
    rise: float | None
    """Distance of the rows [pitch]; None if ``pitch_y`` gives it."""


STACKINGS = {
    "square": Stacking(0.0, 1.0),
    "rectangular": Stacking(0.0, None),
    "triangular": Stacking(0.5, math.sqrt(0.75)),
}
"""The hole lattices that a specimen can have, by name."""


@dataclass(frozen=True)
class Specimen:
    """A rectangular specimen with ``holes_y`` rows of ``holes_x`` round or elliptical holes.

    The origin is the specimen's centre; x is the loading direction. Defaults are the virtual
    experiment of the paper (section "Virtual Experiments").

    In triangular stacking every second row, counted from below, has one hole less: no hole is cut,
    the specimen is symmetric about the y axis, and with an odd number of rows about the x axis too.
    The cellular part is the bounding box of the holes' cells; its rest is solid.
    """

    holes_x: int = 6
    holes_y: int = 10
    """Number of holes in a row, along the loading direction; number of rows."""
    diameter: float = 1.5
    """Hole diameter d [mm]; of ellipses along x; of a graded specimen at its centre."""
    pitch: float = 1.9
    """Centre-to-centre distance l along a row, the unit cell size [mm]."""
    bulk_x: float = 1.9
    bulk_y: float = 0.9
    """Width of the solid strips at loaded and at free edges [mm]; 0: none."""
    grading_x: float = 0.0
    grading_y: float = 0.0
    """Gradients of the diameter along the loading and the transverse direction [mm/mm]: a hole with
    its centre at (x, y) has d(x, y) = diameter + grading_x x + grading_y y. A specimen graded in
    one direction keeps its mirror symmetry in the other. Ellipses keep their aspect."""
    stacking: str = "square"
    """"square", "rectangular" or "triangular" (equilateral, rows along x): ``STACKINGS``."""
    pitch_y: float | None = None
    """Distance of the rows in rectangular stacking [mm]; in others it follows from ``pitch``."""
    diameter_y: float | None = None
    """Diameter of elliptical holes along y [mm]; None for round ones."""

    def __post_init__(self) -> None:
        if not (1 <= self.holes_x <= MOST_HOLES and 1 <= self.holes_y <= MOST_HOLES):
            raise InputError(
                f"specimen: expected 1 x 1 to {MOST_HOLES} x {MOST_HOLES} holes, got "
                f"{self.holes_x} x {self.holes_y}; set holes_x and holes_y"
            )
        if self.stacking not in (known := list(STACKINGS)):
            raise InputError(f"specimen: expected a stacking among {known}, got {self.stacking!r}")
        if (self.pitch_y is None) == (STACKINGS[self.stacking].rise is None):
            raise InputError(
                f"specimen: expected {'a' if self.pitch_y is None else 'no'} pitch_y for "
                f"{self.stacking} stacking, got {self.pitch_y}"
            )
        if self.is_staggered and self.holes_x == 1 < self.holes_y:
            raise InputError(
                f"specimen: expected 2 or more holes_x in {self.stacking} stacking (every second "
                "row has one less), got 1"
            )
        if not 0 < self.diameter < self.pitch:
            raise InputError(
                "specimen: expected 0 < diameter < pitch (holes must not touch), got "
                f"diameter = {self.diameter} mm, pitch = {self.pitch} mm"
            )
        if not np.isfinite(self.pitch):
            raise InputError(f"specimen: expected a finite pitch, got {self.pitch} mm")
        if not (0 <= self.bulk_x < np.inf and 0 <= self.bulk_y < np.inf):
            raise InputError(
                "specimen: expected bulk edges of 0 mm or more, got "
                f"bulk_x = {self.bulk_x} mm, bulk_y = {self.bulk_y} mm"
            )
        if not (0 < self.aspect < np.inf and 0 < self.row_distance < np.inf):
            raise InputError(
                "specimen: expected a positive pitch_y and diameter_y, got "
                f"{self.pitch_y} mm and {self.diameter_y} mm"
            )
        ratio = 2.0 * self.row_distance / self.pitch
        if self.is_staggered and not self.aspect < ratio:
            raise InputError(
                f"specimen: expected diameter_y < {ratio:.4g} diameter in {self.stacking} stacking "
                f"(a hole must stay in its row), got {self.diameter_y} mm and {self.diameter} mm"
            )
        smallest, largest, limit = self.diameters.min(), self.diameters.max(), self.largest_diameter
        if not 0 < smallest <= largest < limit:
            what = f"{limit:.5g} mm" + (", the pitch" if limit == self.pitch else "")
            raise InputError(
                f"specimen: expected 0 < d < {what}, of every hole, got d from "
                f"{smallest:.5g} to {largest:.5g} mm; make diameters or gradings smaller"
            )

    def plain(self) -> dict[str, Any]:
        """Values for files; options beyond the square lattice of circles only if used."""
        usual = {"stacking": "square", "pitch_y": None, "diameter_y": None}
        return {n: v for n, v in asdict(self).items() if n not in usual or v != usual[n]}

    @property
    def is_staggered(self) -> bool:
        """Whether every second row is offset by half a pitch."""
        return STACKINGS[self.stacking].shift != 0.0

    @property
    def row_distance(self) -> float:
        """Distance of neighbouring rows of holes [mm]."""
        rise = STACKINGS[self.stacking].rise
        return self.pitch * rise if rise is not None else float(self.pitch_y or 0.0)

    @property
    def vectors(self) -> FloatArray:
        """(2, 2) vectors of the hole lattice as rows [mm]: along a row, and to the next row."""
        shift = STACKINGS[self.stacking].shift * self.pitch
        return np.array([[self.pitch, 0.0], [shift, self.row_distance]])

    @property
    def aspect(self) -> float:
        """The holes' diameter along y over that along x [-]."""
        return 1.0 if self.diameter_y is None else self.diameter_y / self.diameter

    @property
    def largest_diameter(self) -> float:
        """Diameter at which holes of this aspect would touch [mm]."""
        row = self.row_distance / self.aspect  # with y scaled so that holes are circles
        return min(self.pitch, math.hypot(0.5 * self.pitch, row) if self.is_staggered else row)

    @property
    def ligament_width(self) -> float:
        """Width of the thinnest ligament between two holes [mm]."""
        return float((self.largest_diameter - self.diameters.max()) * min(1.0, self.aspect))

    @property
    def cell_heights(self) -> tuple[float, float]:
        """y of the upper corners of a hole's cell at x = l/2 and at x = 0 [mm].

        The cell is the region nearest to a hole, with y scaled so that holes are circles: a
        rectangle, or in staggered rows a hexagon with two sides along y.
        """
        half = 0.5 * self.row_distance
        if not self.is_staggered:
            return half, half
        off = 0.125 * (self.aspect * self.pitch) ** 2 / self.row_distance
        return half - off, half + off

    @property
    def quarter_places(self) -> tuple[FloatArray, FloatArray]:
        """Centres of ligaments (n, 2) and of junctions (m, 2) relative to a hole's centre [mm].

        They are those in the quarter of its cell with x, y >= 0.
        """
        half, (low, high) = 0.5 * self.pitch, self.cell_heights
        if not self.is_staggered:
            return np.array([[half, 0.0], [0.0, high]]), np.array([[half, high]])
        ligaments = np.array([[half, 0.0], [0.5 * half, 0.5 * self.row_distance]])
        return ligaments, np.array([[half, low], [0.0, high]])

    @property
    def row_counts(self) -> NDArray[np.int64]:
        """(holes_y,) number of holes in each row, from below."""
        counts = np.full(self.holes_y, self.holes_x)
        counts[1::2] -= self.is_staggered
        return counts

    @property
    def row_heights(self) -> FloatArray:
        """(holes_y,) y of each row [mm]."""
        return centred(self.holes_y) * self.row_distance

    @property
    def length(self) -> float:
        """L, the length of the cellular part, to which nominal strain refers [mm]."""
        return self.holes_x * self.pitch

    @property
    def cellular_half_size(self) -> tuple[float, float]:
        """Half the width and height of the cellular part [mm]."""
        b = 0.5 * self.holes_y * self.row_distance
        if self.is_staggered:
            b = 0.5 * (self.holes_y - 1) * self.row_distance + self.cell_heights[1]
        return 0.5 * self.holes_x * self.pitch, b

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the width and height of the whole specimen [mm]."""
        a, b = self.cellular_half_size
        return a + self.bulk_x, b + self.bulk_y

    @property
    def hole_centres(self) -> FloatArray:
        """(holes, 2) positions of the hole centres [mm], exactly symmetric; sorted by x, then y."""
        rows = zip(self.row_heights, self.row_counts, strict=True)
        centres = np.array([(x, y) for y, count in rows for x in centred(count) * self.pitch])
        return np.asarray(centres[np.lexsort((centres[:, 1], centres[:, 0]))])

    @property
    def diameters(self) -> FloatArray:
        """(holes,) diameters of the holes along x [mm], in the order of ``hole_centres``."""
        return np.asarray(self.diameter + self.hole_centres @ [self.grading_x, self.grading_y])

    @property
    def mid_junctions(self) -> tuple[tuple[float, float], ...]:
        """Cell corners (x, 0) between holes on the line of mid-height [mm]."""
        x = (np.arange(1, self.holes_x) - 0.5 * self.holes_x) * self.pitch
        return tuple((float(at), 0.0) for at in x)

    def nearest_hole(self, points: FloatArray) -> NDArray[np.int64]:
        """(n,) number of the hole whose cell contains, or is nearest to, each point (n, 2) [mm].

        Distances are measured with y scaled so that holes are circles, as in ``cell_heights``.
        """
        counts, heights = self.row_counts, self.row_heights
        rows = np.repeat(np.arange(self.holes_y), counts)
        columns = np.concatenate([np.arange(count) for count in counts])
        order = np.lexsort((rows, columns - 0.5 * counts[rows]))  # as in hole_centres
        number = np.zeros((self.holes_y, self.holes_x), np.int64)
        number[rows[order], columns[order]] = np.arange(len(order))
        below = np.floor((points[:, 1] - heights[0]) / self.row_distance)
        found, least = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
        for step in (0, 1):
            row = np.clip(below + step, 0, self.holes_y - 1).astype(np.int64)
            first = -0.5 * (counts[row] - 1)
            column = np.clip(np.rint(points[:, 0] / self.pitch - first), 0, counts[row] - 1)
            dx = points[:, 0] - (column + first) * self.pitch
            distance = np.hypot(dx, (points[:, 1] - heights[row]) / self.aspect)
            is_nearer = distance < least
            found[is_nearer] = number[row, column.astype(np.int64)][is_nearer]
            least = np.minimum(distance, least)
        return found

    def pattern(self, points: FloatArray) -> FloatArray:
        """The rectangular lattice's buckling pattern at ``points`` (n, 2), amplitude 1 [-].

        u_x = -cos(pi x/l) sin(pi y/l), u_y = sin(pi x/l) cos(pi y/l) with the origin at a
        solid junction between four holes (Eq. (6) of the paper). Holes become ellipses,
        neighbours rotate in opposite senses. Along y, l is the distance of the rows.
        """
        a, b = self.cellular_half_size
        x = np.pi * (points[:, 0] + a) / self.pitch
        y = np.pi * (points[:, 1] + b) / self.row_distance
        return np.stack([-np.cos(x) * np.sin(y), np.sin(x) * np.cos(y)], axis=-1)

    def asymmetric(self, points: FloatArray) -> FloatArray:
        """A field at points (n, 2) that no symmetry of a rectangle maps to plus or minus itself."""
        x, y = (points / self.half_size).T
        along, across = (1.0 + 0.7 * x) * (1.0 + 0.3 * y), (1.0 - 0.2 * x) * (1.0 - 0.6 * y)
        return np.stack([along, across], axis=1)


def centred(count: int) -> FloatArray:
    """(count,) numbers with spacing 1 and a mean of exactly 0."""
    return np.asarray(np.arange(count) - 0.5 * (count - 1))


@dataclass(frozen=True)
class Imperfection:
    """Independent normally distributed scatter of every hole."""

    position_sd: float = 0.0
    """Standard deviation of each coordinate of a hole's centre [mm]."""
    diameter_sd: float = 0.0
    """Standard deviation of a hole's diameter [mm]."""
    seed: int = 0
    ovality_sd: float = 0.0
    """Standard deviation of a hole's ovality: longer along x and shorter along y, and the same
    along the diagonals [mm]."""

    def __post_init__(self) -> None:
        if not all(sd >= 0 for sd in (self.position_sd, self.diameter_sd, self.ovality_sd)):
            raise InputError(f"imperfection: expected standard deviations >= 0 mm, got {self}")
        require_within("imperfection: expected a seed", self.seed, 0)

    @property
    def is_none(self) -> bool:
        """Whether there is no scatter at all: the specimen keeps its symmetries."""
        return self.position_sd == self.diameter_sd == self.ovality_sd == 0.0

    def drawn(self, count: int) -> FloatArray:
        """(count, 5) random deviations of holes, see ``fem.meshing.hole_motion`` [mm]."""
        random = np.random.default_rng(self.seed)
        shift = random.normal(0.0, 1.0, (count, 2)) * self.position_sd
        growth = random.normal(0.0, 1.0, count) * self.diameter_sd
        ovality = random.normal(0.0, 1.0, (count, 2)) * self.ovality_sd
        return np.column_stack([shift, growth, ovality])
