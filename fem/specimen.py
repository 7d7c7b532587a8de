"""The finite specimen: holes on a square lattice in a rectangle with bulk edges; their scatter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modeharvest.util.errors import InputError

MOST_HOLES = 1000
"""In a direction."""


@dataclass(frozen=True)
class Specimen:
    """A rectangular specimen with ``holes_x`` x ``holes_y`` circular holes.

    The origin is the specimen's centre; x is the loading direction. Defaults are the
    virtual experiment of the paper (section "Virtual Experiments").

    Parameters
    ----------
    holes_x, holes_y
        Number of holes in the loading and in the transverse direction [-].
    diameter
        Hole diameter d [mm]; of a graded specimen, the one at its centre.
    pitch
        Centre-to-centre distance l, the unit cell size [mm].
    bulk_x, bulk_y
        Width of the solid strips beside the cellular part, at the loaded edges and at the
        free edges [mm]; 0 leaves them out.
    grading_x, grading_y
        Change of the diameter from hole to hole, per distance of their centres in the loading and
        in the transverse direction [mm/mm]: d(x, y) = diameter + grading_x x + grading_y y. A
        specimen graded in one direction keeps its mirror symmetry in the other.
    """

    holes_x: int = 6
    holes_y: int = 10
    diameter: float = 1.5
    pitch: float = 1.9
    bulk_x: float = 1.9
    bulk_y: float = 0.9
    grading_x: float = 0.0
    grading_y: float = 0.0

    def __post_init__(self) -> None:
        if not (1 <= self.holes_x <= MOST_HOLES and 1 <= self.holes_y <= MOST_HOLES):
            raise InputError(
                f"specimen: expected 1 x 1 to {MOST_HOLES} x {MOST_HOLES} holes, got "
                f"{self.holes_x} x {self.holes_y}; set holes_x and holes_y"
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
        smallest, largest = self.diameters.min(), self.diameters.max()
        if not 0 < smallest <= largest < self.pitch:
            raise InputError(
                f"specimen: expected 0 < d < {self.pitch} mm, the pitch, of every hole, got d from "
                f"{smallest:.5g} to {largest:.5g} mm; make grading_x and grading_y smaller"
            )

    @property
    def length(self) -> float:
        """L, the length of the cellular part, which nominal strain refers to [mm]."""
        return self.holes_x * self.pitch

    @property
    def cellular_half_size(self) -> tuple[float, float]:
        """Half the width and height of the cellular part [mm]."""
        return 0.5 * self.holes_x * self.pitch, 0.5 * self.holes_y * self.pitch

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the width and height of the whole specimen [mm]."""
        a, b = self.cellular_half_size
        return a + self.bulk_x, b + self.bulk_y

    @property
    def hole_centres(self) -> NDArray[np.float64]:
        """(holes_x * holes_y, 2) positions of the hole centres [mm], exactly symmetric."""
        x = (np.arange(self.holes_x) - 0.5 * (self.holes_x - 1)) * self.pitch
        y = (np.arange(self.holes_y) - 0.5 * (self.holes_y - 1)) * self.pitch
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)

    @property
    def diameters(self) -> NDArray[np.float64]:
        """(holes_x * holes_y,) diameters of the holes [mm], in the order of ``hole_centres``."""
        return self.diameter + self.hole_centres @ [self.grading_x, self.grading_y]

    @property
    def mid_junctions(self) -> tuple[tuple[float, float], ...]:
        """Corners (x, 0) of the unit cells between the holes [mm], on the line of mid-height."""
        x = (np.arange(1, self.holes_x) - 0.5 * self.holes_x) * self.pitch
        return tuple((float(at), 0.0) for at in x)

    def pattern(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The square lattice's buckling pattern at ``points`` (n, 2), amplitude 1 [-].

        u_x = -cos(pi x/l) sin(pi y/l), u_y = sin(pi x/l) cos(pi y/l) with the origin at a
        solid junction between four holes (Eq. (mode) of the paper); holes rotate into
        ellipses, neighbours in opposite senses.
        """
        a, b = self.cellular_half_size
        x = np.pi * (points[:, 0] + a) / self.pitch
        y = np.pi * (points[:, 1] + b) / self.pitch
        return np.stack([-np.cos(x) * np.sin(y), np.sin(x) * np.cos(y)], axis=-1)


@dataclass(frozen=True)
class Imperfection:
    """Independent normal scatter of every hole.

    Parameters
    ----------
    position_sd
        Standard deviation of each coordinate of a hole's centre [mm].
    diameter_sd
        Standard deviation of a hole's diameter [mm].
    seed
        Seed of the random generator.
    """

    position_sd: float = 0.0
    diameter_sd: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (self.position_sd >= 0 and self.diameter_sd >= 0):
            raise InputError(f"imperfection: expected standard deviations >= 0 mm, got {self}")
        if self.seed < 0:
            raise InputError(f"imperfection: expected a seed of 0 or more, got {self.seed}")

    @property
    def is_none(self) -> bool:
        """Whether there is no scatter at all: the specimen keeps its symmetries."""
        return self.position_sd == 0.0 and self.diameter_sd == 0.0
