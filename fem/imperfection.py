"""Scatter of hole positions and diameters, as moulding leaves it: seeded, on request."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modeharvest.errors import InputError
from modeharvest.fem.field import Mesh
from modeharvest.fem.specimen import Specimen


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


def perturb(mesh: Mesh, specimen: Specimen, imperfection: Imperfection) -> Mesh:
    """Move the mesh so that every hole has its own centre and diameter.

    Hole edges stay circles; the motion fades out towards the cell's boundary, so cells do
    not disturb each other and the outer edges stay straight.

    Raises
    ------
    InputError
        If the scatter could close the thinnest ligament: four standard deviations beyond half of
        it.
    """
    ligament = specimen.pitch - specimen.diameters.max()
    reach = 4.0 * (imperfection.position_sd + 0.5 * imperfection.diameter_sd)
    if reach > 0.5 * ligament:
        raise InputError(
            f"imperfection: expected 4 (position_sd + diameter_sd / 2) <= {0.5 * ligament:.3g} mm, "
            f"half a ligament, got {reach:.3g} mm; make the scatter smaller"
        )
    if imperfection.is_none:
        return mesh
    random = np.random.default_rng(imperfection.seed)
    centres = specimen.hole_centres
    shift = random.normal(0.0, 1.0, centres.shape) * imperfection.position_sd
    growth = random.normal(0.0, 1.0, len(centres)) * 0.5 * imperfection.diameter_sd

    nodes = mesh.nodes.copy()
    radii, outer = 0.5 * specimen.diameters, 0.5 * specimen.pitch
    for centre, radius, move, grow in zip(centres, radii, shift, growth, strict=True):
        arm = mesh.nodes - centre
        distance = np.linalg.norm(arm, axis=1)
        near = distance < outer
        fade = np.clip((distance[near] - radius) / (outer - radius), 0.0, 1.0)
        weight = np.cos(0.5 * np.pi * fade)[:, None] ** 2
        outwards = arm[near] / distance[near][:, None]
        nodes[near] += weight * (move + grow * outwards)
    return Mesh(nodes, mesh.cells, mesh.element)
