"""A lattice's case as something that can be computed with: its cell and its primary path."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from modeharvest.errors import MissingDependencyError
from modeharvest.lattice.case import LatticeCase
from modeharvest.lattice.patterns import marched

if TYPE_CHECKING:  # their modules need dolfinx
    from modeharvest.fem.cell import CellPath, PeriodicCell
    from modeharvest.fem.lattices import UnitCell

_NO_DOLFINX = (
    "infinite lattices need dolfinx >= 0.9, petsc4py and gmsh: install them with 'conda install "
    "-c conda-forge fenics-dolfinx petsc4py python-gmsh' or, on Debian 13, 'apt install "
    "python3-dolfinx python3-petsc4py python3-gmsh python3-h5py-mpi'"
)


class LatticeModel:
    """Cell and path of a case, made when they are asked for.

    Parameters
    ----------
    case
        The case.
    """

    def __init__(self, case: LatticeCase) -> None:
        self.case = case

    @cached_property
    def unit(self) -> UnitCell:
        """The primitive cell's mesh and lattice vectors.

        Raises
        ------
        InputError
            If there is no such lattice, or its cell isn't periodic.
        MissingDependencyError
            If dolfinx or gmsh is not there.
        """
        try:
            return self.case.lattice.cell()
        except ImportError as error:
            raise MissingDependencyError(_NO_DOLFINX) from error

    @cached_property
    def cell(self) -> PeriodicCell:
        """The primitive cell with its material; raises as ``unit``."""
        unit = self.unit
        try:
            from modeharvest.fem.cell import PeriodicCell
        except ImportError as error:
            raise MissingDependencyError(_NO_DOLFINX) from error
        return PeriodicCell(unit, self.case.material)

    def path(self, load: float = 0.0) -> CellPath:
        """A new primary path, followed up to a load [-]; raises as ``unit``.

        From the beginning, so that no stage depends on another's steps.
        """
        cell = self.cell  # first: without dolfinx it says what is missing
        from modeharvest.fem.cell import CellPath

        path = CellPath(cell, self.case.loading.macro())
        return marched(path, load, self.case.search.largest_step)
