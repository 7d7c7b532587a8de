"""Options of homogenization: how a homogenized specimen is supported, loaded and divided."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modeharvest.fem.experiment import require_edges
from modeharvest.util.errors import InputError

SIDES = ("free", "periodic", "guided", "clamped")
PATTERN = ("zero", "free")


@dataclass(frozen=True)
class PlateMotion:
    """Two plates at the edges of least and largest x, moved in proportion to the load e.

    At x = +-a they have u_x = -+ e L (compression + bending y / b) / 2 and u_y = +- e L shear / 2
    - e lateral y, with b half the height: e is the nominal strain of ``compression = 1``, the mean
    shear of ``shear = 1``, the nominal strain of the uppermost fibre of ``bending = 1`` (small
    turns), and with ``lateral = 1`` the nominal strain across, too, for sides that aren't free.
    """

    compression: float = 1.0
    shear: float = 0.0
    bending: float = 0.0
    lateral: float = 0.0
    plates: str = "clamped"
    """With "sliding", u_y is free on the plates but for one node, which keeps the body there."""
    sides: str = "free"
    """The edges of least and largest y: "free"; "periodic": v is alike on both, and u but for the
    lateral strain; "guided": u_y is linear between the plates; "clamped": u_x is, too."""


@dataclass(frozen=True)
class PlateLoading(PlateMotion):
    """A load, what holds the pattern, and whether only a quarter is looked at."""

    pattern_at_plates: str = "zero"
    pattern_at_bulk: str = "zero"
    """Whether v is 0 where the lattice meets a plate, solid before a plate, or a clamped side, and
    where it meets other solid bulk, such as along the sides; or "free": Lambda . n = 0."""
    quarter: bool = False
    """Whether the body is the quarter x, y >= 0 of one that is its own mirror image: u symmetric,
    v even. Compression only. Instabilities of another symmetry, such as bowing, aren't seen."""

    def __post_init__(self) -> None:
        require_edges(self.plates)
        rates = self.compression, self.shear, self.bending, self.lateral
        if not np.isfinite(rates).all() or not any(rates):
            raise InputError(f"plates: expected finite rates, one of them not 0, got {rates}")
        if self.shear and self.plates != "clamped":
            raise InputError("plates: expected clamped ones to shear a specimen, got 'sliding'")
        if self.quarter and (self.shear or self.bending or self.sides != "free"):
            raise InputError("quarter: expected compression between free sides, got another load")
        if self.sides not in SIDES:
            raise InputError(f"sides: expected one of {SIDES}, got {self.sides!r}")
        if self.bending and self.sides == "periodic":
            raise InputError("sides: expected others in bending, got 'periodic'")
        if self.lateral and self.sides == "free":
            raise InputError("sides: expected others with lateral, got 'free'")
        for name in ("pattern_at_plates", "pattern_at_bulk"):
            if getattr(self, name) not in PATTERN:
                raise InputError(f"{name}: expected one of {PATTERN}, got {getattr(self, name)!r}")
