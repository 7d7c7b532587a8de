"""The infinite lattice's own mode, laid over a specimen's holes to be compared with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import MissingDependencyError
from modeharvest.fem.field import Mesh
from modeharvest.fem.materials import Material
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.families.overlap import overlap
from modeharvest.idic.families.quadrature import Quadrature
from modeharvest.idic.fourier import ModeFamily
from modeharvest.validation.lattice.independence import Lattice, PatternMode, pattern_mode
from modeharvest.validation.studies.modes.pattern import NO_DOLFINX

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LatticeMode:
    """The numerical (π, π) mode of an infinite lattice, and what a mode family makes of it.

    Parameters
    ----------
    mode
        On one cell about a hole, beside Eq. (mode) with its ideal parameters.
    """

    mode: PatternMode

    @classmethod
    def of(cls, specimen: Specimen, material: Material, divisions: int) -> LatticeMode:
        """Of the lattice of a specimen's cells, in uniaxial compression.

        In its first critical state, or where it stays stable in the last one looked at. Of a graded
        specimen: the lattice of the cell at its centre.

        Parameters
        ----------
        specimen, material
            Whose.
        divisions
            Elements along l.

        Raises
        ------
        MissingDependencyError
            If dolfinx is not there.
        """
        ratio = specimen.diameter / specimen.pitch
        lattice = Lattice(ratio, material=material, pitch=specimen.pitch, divisions=divisions)
        try:
            return cls(pattern_mode(lattice))
        except ModuleNotFoundError as error:
            raise MissingDependencyError(NO_DOLFINX) from error

    @property
    def aspect(self) -> float:
        """a₁ of Eq. (mode) that is nearest to the mode [-].

        By symmetry and period the mode's wave vectors and phases are the ideal ones exactly; of the
        seven parameters a₁ is left, the ratio of the two components' amplitudes.
        """
        rule = Quadrature(self.mode.mesh)
        mode, ideal = rule.values(self.mode.shape), rule.values(self.mode.analytic)
        along, across = (
            rule.weights @ (mode[:, c] * ideal[:, c]) / (rule.weights @ ideal[:, c] ** 2)
            for c in (0, 1)
        )
        return float(along / across)

    def over(self, specimen: Specimen) -> tuple[Mesh, FloatArray]:
        """The mode on copies of its cell about all holes: mesh [mm] and (n, 2) nodal field [-].

        Neighbours have opposite signs.
        """
        mesh, shape = self.mode.mesh, self.mode.shape
        centres = specimen.hole_centres
        steps = np.rint((centres - centres[0]) / specimen.pitch).astype(int).sum(axis=1)
        nodes = (centres[:, None, :] + mesh.nodes).reshape(-1, 2)
        first = len(mesh.nodes) * np.arange(len(centres))
        cells = (first[:, None, None] + mesh.cells).reshape(-1, mesh.cells.shape[1])
        field = ((-1.0) ** steps)[:, None, None] * shape
        return Mesh(nodes, cells, mesh.element), field.reshape(-1, 2)

    def overlap(self, specimen: Specimen, family: ModeFamily, parameters: ArrayLike) -> float:
        """Normalised overlap with a family's mode over all unit cells of a specimen [-].

        |∫ u·φ| / (‖u‖ ‖φ‖), both without mean and of constant amplitude: 1 if they differ by a
        factor only.
        """
        return overlap(*self.over(specimen), family, specimen.pitch, parameters)
