"""Parameters of a compression test by name: their effect on the model, and their units.

Constants of the material are parameters of its energy. Everything else is linear in its parameters:
the holes' positions, from which a smooth map moves the mesh's nodes, and the loaded edges' motion.
Polynomials are Legendre products: P_i(x/a) P_j(y/b) over the cellular part, P_j(y/b) along an edge.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import Legendre

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.specimen import Specimen
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

TRAVEL, TILT = "travel", "tilt"
"""Unknowns of the loaded edges: a factor on all nominal strains [-], and the tilt of the edge at
x > 0 per nominal strain [rad]."""
PARTS = ("x", "y", "diameter", "oval0", "oval45")
"""Deviations of a hole, in the order of :func:`modeharvest.fem.meshing.hole_motion`."""
_ODD = {"x": (True, False), "y": (False, True), "oval45": (True, True)}
"""Whether a deviation changes its sign under x -> -x and y -> -y; the others don't."""
_PART, _DEGREE = f"({'|'.join(PARTS)})", r"(\d+)"
_OWN = re.compile(rf"holes\[(\d+)\]\.{_PART}")
_SMOOTH = re.compile(rf"holes\.{_PART}\[{_DEGREE}, ?{_DEGREE}\]")
_EDGE = re.compile(rf"(left|right)\.(x|y)\[{_DEGREE}\]")
_AMPLITUDE = re.compile(r"amplitude\[(\d+)\]")
HIGHEST = 6
"""Highest degree of a polynomial."""
_OPEN = 0.5
"""Largest motion of a hole's edge, over half a ligament; above it the map of the mesh folds."""


@dataclass(frozen=True)
class EdgeMotion:
    """Polynomial motion of a loaded edge per unit of a parameter and of nominal strain."""

    side: int
    """-1 for the edge at x < 0, 1 for that at x > 0."""
    axis: int
    degree: int
    factor: float = 1.0

    def at(self, nodes: FloatArray, spec: Specimen) -> FloatArray:
        """(n, 2) displacement of nodes (n, 2) per nominal strain [mm per unit]; else 0."""
        half, found = spec.half_size, np.zeros_like(nodes)
        there = np.abs(nodes[:, 0] - self.side * half[0]) < 1e-8 * half[0]
        profile = Legendre.basis(self.degree)(nodes[there, 1] / half[1])
        found[there, self.axis] = self.factor * profile
        return found


@dataclass(frozen=True, eq=False)
class Parameter:
    """Changes of a test's model per unit of a parameter."""

    unit: str
    constant: str = ""
    """Name of the material's constant."""
    holes: FloatArray | None = None
    """(holes, 5) deviations of the holes, in the order of PARTS [mm per unit]."""
    edge: EdgeMotion | None = None
    is_symmetric: bool = True
    """Whether the symmetry needed for a bifurcation is kept: for holes about both axes, for edges
    about the x axis, under which the pattern of an even number of rows changes its sign. The test
    then still buckles at a bifurcation, whose strain depends on the parameter."""


def parameter(name: str, experiment: Experiment, others: Sequence[str] = ()) -> Parameter:
    """The parameter with a given name.

    Names are: constants of the material, such as "kappa", "moduli[0]"; TRAVEL, TILT;
    "amplitude[k]", of the pattern in state number k; "holes.x[i,j]", "holes.diameter[i,j]" etc.
    (see PARTS), polynomials over all holes; "holes[k].x" etc., of hole number k alone, in the order
    of ``Specimen.hole_centres``; "right.x[j]", "left.y[j]" etc., of the loaded edges. InputError if
    the test has no such parameter; ``others``: further valid names, for the message.
    """
    spec = experiment.specimen
    if name in (known := list(_constants(experiment))):
        return Parameter("-" if name.startswith("exponents") else "MPa", constant=name)
    if name == TRAVEL:
        return Parameter("-")
    if name == TILT:
        return Parameter("rad", edge=EdgeMotion(1, 0, 1, -spec.half_size[1]), is_symmetric=False)
    if found := _AMPLITUDE.fullmatch(name):
        require_number(name, "a state", int(found[1]), len(experiment.strains))
        return Parameter("mm")
    if found := _OWN.fullmatch(name):
        number, holes = int(found[1]), np.zeros((len(spec.hole_centres), len(PARTS)))
        require_number(name, "a hole", number, len(holes))
        holes[number, PARTS.index(found[2])] = 1.0
        return Parameter("mm", holes=holes, is_symmetric=False)
    if found := _SMOOTH.fullmatch(name):
        degrees, part = (int(found[2]), int(found[3])), found[1]
        require_number(name, "a degree", max(degrees), HIGHEST + 1)
        where = (spec.hole_centres / spec.cellular_half_size).T
        along, across = (Legendre.basis(d)(s) for d, s in zip(degrees, where, strict=True))
        holes = np.zeros((len(along), len(PARTS)))
        holes[:, PARTS.index(part)] = along * across
        odd = tuple(degree % 2 == 1 for degree in degrees)
        return Parameter("mm", holes=holes, is_symmetric=odd == _ODD.get(part, (False, False)))
    if found := _EDGE.fullmatch(name):
        axis, degree = "xy".index(found[2]), int(found[3])
        require_number(name, "a degree", degree, HIGHEST + 1)
        if axis == 1 and experiment.edges != "clamped":
            raise InputError(
                f"unknowns: expected clamped edges for {name}, got {experiment.edges!r} ones, "
                "along which nothing is prescribed"
            )
        motion = EdgeMotion(-1 if found[1] == "left" else 1, axis, degree)
        is_symmetric = spec.holes_y % 2 == 0 and degree % 2 == axis
        return Parameter("mm", edge=motion, is_symmetric=is_symmetric)
    known += [TRAVEL, TILT, "amplitude[k]", *(f"holes.{part}[i,j]" for part in PARTS)]
    known += [f"holes[k].{part}" for part in PARTS]
    known += [f"{side}.{axis}[j]" for side in ("right", "left") for axis in "xy"]
    raise InputError(f"unknowns: expected some of {[*known, *others]}, got {name!r}")


def _constants(experiment: Experiment) -> Iterator[str]:
    for name, value in vars(experiment.material).items():
        parts = range(len(value)) if isinstance(value, tuple) else ()
        yield from (f"{name}[{k}]" for k in parts) if parts else [name]


def require_number(name: str, what: str, number: int, count: int) -> None:
    """Raise InputError unless a number in an unknown's name is 0 ... count - 1."""
    if number >= count:
        raise InputError(f"unknowns: expected {what} from 0 to {count - 1} in {name}, got {number}")


def holes_of(
    names: Sequence[str], values: Sequence[float] | FloatArray, experiment: Experiment
) -> FloatArray:
    """(holes, 5) deviations of holes from the specimen's, due to parameters [mm]."""
    parts = [parameter(name, experiment).holes for name in names]
    total = np.zeros((len(experiment.specimen.hole_centres), len(PARTS)))
    for value, part in zip(values, parts, strict=True):
        total = total if part is None else total + value * part
    return total


def require_open(specimen: Specimen, holes: FloatArray) -> None:
    """Raise InputError if deviations of holes are so large that they get close to neighbours."""
    growth = np.abs(holes[:, 2]) + np.linalg.norm(holes[:, 3:], axis=1)
    moved = np.linalg.norm(holes[:, :2], axis=1) + 0.5 * growth
    share = moved / (0.5 * (specimen.largest_diameter - specimen.diameters))
    if share.max() > _OPEN:
        k = int(np.argmax(share))
        raise InputError(
            f"expected edges of holes that move by at most {100 * _OPEN:.0f} % of half a ligament, "
            f"got {moved[k]:.3g} mm of hole {k}; make the bounds of the holes' unknowns narrower, "
            "or the specimen's diameter more like the real one's"
        )
