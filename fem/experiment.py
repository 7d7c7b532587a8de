"""Description of a virtual compression test: plain dataclasses, no dolfinx."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any

from modeharvest.fem.materials import Material, Ogden, material_table
from modeharvest.fem.specimen import Imperfection, Specimen
from modeharvest.util.errors import InputError, require_within

EDGES = ("clamped", "sliding")
BRANCHES = ("primary", "buckled+", "buckled-")
SMALLEST_STEP = 1e-5
"""Smallest step along a path [-]; smaller steps would take forever."""
_LARGEST_TILT = 1.0


def require_edges(edges: str) -> None:
    """Raise InputError unless ``edges`` is a known kind of loaded edges."""
    if edges not in EDGES:
        raise InputError(f"edges: expected {' or '.join(map(repr, EDGES))}, got {edges!r}")


@dataclass(frozen=True)
class PathOptions:
    """Options of following the equilibrium path."""

    first_step: float = 0.04
    largest_step: float = 0.04
    """First and largest step of nominal strain along the primary path [-]."""
    critical_tolerance: float = 1e-7
    """Tolerance of the critical strain [-]."""
    first_amplitude: float = 0.08
    """Largest nodal displacement of the first step onto the branch, relative to the pitch or
    another given length [-]."""
    growth: float = 2.0
    """Largest factor by which the mode's amplitude may grow in one step along the branch [-]."""

    def __post_init__(self) -> None:
        what, tolerance = "path options: expected a", self.critical_tolerance
        for name in ("first_step", "largest_step", "first_amplitude"):
            require_within(f"{what} {name}", getattr(self, name), SMALLEST_STEP, 1.0)
        require_within(f"{what} growth", self.growth, 1.0, 100.0, above=True)
        require_within(f"{what} critical_tolerance", tolerance, 1e-12, 1.0)


@dataclass(frozen=True)
class Experiment:
    """A virtual compression test. Defaults: the paper's 6 x 10 specimen."""

    specimen: Specimen = field(default_factory=Specimen)
    material: Material = field(default_factory=Ogden)
    """Geometry [mm] and strain energy density [MPa]."""
    strains: tuple[float, ...] = (0.078, 0.128)
    """Nominal strains of the snapshots, ascending, compression positive [-]."""
    mesh_size: float = 0.2
    """Target edge length of the T6 elements [mm]."""
    edges: str = "clamped"
    """Kind of loaded edges: "clamped" or "sliding"."""
    branches: tuple[str, ...] = ("buckled+",)
    """Branches to keep above the critical strain: "primary" (unstable there), "buckled+" and
    "buckled-" (stable; + has a positive overlap with ``Specimen.pattern`` if it has any)."""
    imperfection: Imperfection = field(default_factory=Imperfection)
    """Scatter of the holes; with scatter there is no bifurcation but one natural path."""
    path: PathOptions = field(default_factory=PathOptions)
    """How the equilibrium path is followed."""
    tilt: float = 0.0
    """Rotation of the loaded edge at x > 0 [rad per nominal strain], counter-clockwise about its
    middle: at the strain e, -e tilt y is added to its u_x. This models a stage that is not quite
    parallel; 0.0137 is 0.1 degrees at 12.7 %. The natural path is followed."""
    guided: bool = False
    """Fix u_y at the solid junctions on the line of mid-height, like pins in a straight rail;
    ``holes_y`` must be even, rows not staggered. Prevents long specimens from bowing."""

    def __post_init__(self) -> None:
        strains = self.strains
        if not strains or not strains[0] > 0 or any(not b > a for a, b in pairwise(strains)):
            raise InputError(f"strains: expected ascending positive ones, got {list(strains)}")
        if strains[-1] >= 0.5:
            raise InputError(f"strains: expected below 0.5 (0.128 is 12.8 %), got {strains[-1]}")
        if not 0.0 < self.mesh_size < float("inf"):
            raise InputError(f"mesh_size: expected a positive length in mm, got {self.mesh_size}")
        require_edges(self.edges)
        if not self.branches or not set(self.branches) <= set(BRANCHES):
            raise InputError(f"branches: expected some of {BRANCHES}, got {self.branches}")
        if not abs(self.tilt) <= _LARGEST_TILT:
            raise InputError(
                f"tilt: expected at most {_LARGEST_TILT} rad per nominal strain (0.0137 is 0.1 "
                f"degrees at 12.7 %), got {self.tilt}"
            )
        if self.guided and (self.specimen.holes_y % 2 or self.specimen.is_staggered):
            raise InputError(
                "guided: expected rows in line and an even holes_y (junctions at mid-height), got "
                f"{self.specimen.stacking} stacking and {self.specimen.holes_y}"
            )

    @property
    def is_perfect(self) -> bool:
        """Whether there is neither scatter nor tilt, so that a bifurcation is possible."""
        return self.imperfection.is_none and self.tilt == 0.0

    def described(self) -> dict[str, dict[str, Any]]:
        """Specimen, material, loading and imperfection, for a solution's ``info``.

        Values are as JSON returns them. The other options say how the solution is found.
        """
        loading = {"edges": self.edges, "length_mm": self.specimen.length}
        tables = {
            "specimen": self.specimen.plain(),
            "material": material_table(self.material),
            "loading": {**loading, "tilt_rad": self.tilt, "guided": self.guided},
            "imperfection": asdict(self.imperfection),
        }
        plain: dict[str, dict[str, Any]] = json.loads(json.dumps(tables))
        return plain
