"""How much of a displacement is the square pattern, cell by cell, and specimens buckled into it."""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from modeharvest.errors import MissingDependencyError
from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.families.quadrature import Quadrature

FloatArray = NDArray[np.float64]

NO_DOLFINX = (
    "simulating specimens needs dolfinx >= 0.9, which is not on PyPI; with conda-forge: 'conda "
    "install fenics-dolfinx=0.11 petsc=*=real* python-gmsh', or use 'scripts/env' of the repository"
)
_QUADRATURE = 4
"""Points per direction: the pattern's waves are long against the elements."""


def buckle(experiment: Experiment, wanted: float, largest: float) -> Solution:
    """Compress a specimen until its pattern is as strong as wanted (needs dolfinx).

    Parameters
    ----------
    experiment
        Specimen, material, mesh, edges and path options; strains and branches are not used.
    wanted
        The pattern's amplitude to be reached, see :meth:`PatternCells.amplitude` [mm].
    largest
        Nominal strain up to which to look for the first critical point [-].

    Returns
    -------
    Solution
        Of :func:`modeharvest.fem.pattern_branch.simulate_pattern`.

    Raises
    ------
    MissingDependencyError
        If dolfinx is not there.
    """
    try:
        from modeharvest.fem.meshing import mesh_specimen
        from modeharvest.fem.pattern_branch import simulate_pattern
    except ModuleNotFoundError as error:
        raise MissingDependencyError(NO_DOLFINX) from error
    mesh = mesh_specimen(experiment.specimen, experiment.mesh_size)
    pattern = PatternCells(mesh, experiment.specimen)
    return simulate_pattern(experiment, mesh, pattern, wanted, largest)


class PatternCells:
    """Projections of a displacement on the square pattern, unit cell by unit cell.

    Parameters
    ----------
    mesh
        Of the displacement.
    specimen
        Whose pattern, :meth:`modeharvest.fem.specimen.Specimen.pattern`.
    """

    def __init__(self, mesh: Mesh, specimen: Specimen) -> None:
        self._rule = rule = Quadrature(mesh, _QUADRATURE)
        half = np.array(specimen.cellular_half_size)
        self._shape = specimen.holes_x, specimen.holes_y
        place = np.floor((rule.positions + half) / specimen.pitch).astype(np.int64)
        self._inside = np.all((place >= 0) & (place < self._shape), axis=1)
        self._cell = np.ravel_multi_index(tuple(place[self._inside].T), self._shape)
        self._pattern = specimen.pattern(rule.positions)
        self._own = self._products(self._pattern)

    def _products(self, values: FloatArray) -> FloatArray:
        """(holes_x, holes_y) integral of values (q, 2) times the pattern over each cell."""
        density = self._rule.weights * (values * self._pattern).sum(axis=1)
        cells = np.bincount(self._cell, density[self._inside])
        return np.asarray(cells.reshape(self._shape), np.float64)

    def share(self, displacement: FloatArray) -> float:
        """How much of a nodal field (n, 2) is the pattern, whatever its amplitude in each cell.

        The root of the share of ∫ |u|² that lies in the span of the pattern's restrictions to
        single cells, between 0 and 1, with the sign of the overlap with the whole pattern.
        """
        u = self._rule.values(displacement)
        mixed = self._products(u)
        share = math.sqrt(np.sum(mixed**2 / self._own) / self._rule.product(u, u))
        return math.copysign(share, mixed.sum())

    def amplitude(self, displacement: FloatArray) -> float:
        """The pattern's amplitude in a nodal displacement (n, 2), where it is largest [mm].

        In each 2 x 2 cells the projection on the pattern: what has the lattice's own period, and
        what is linear, has none there.
        """
        cells = self._products(self._rule.values(displacement)) / self._own
        blocks = sliding_window_view(cells, tuple(min(2, n) for n in self._shape))
        return float(np.abs(blocks.mean(axis=(2, 3))).max())
