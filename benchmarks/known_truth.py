"""A displacement in the ansatz, exact images of it, and the Cramer-Rao bound of its measurement.

With J the derivatives of f(x) - g(x + u) by the unknowns, made from the exact gradient of the
pattern (not from the correlation's matrix), and noise s_f in f and s_g in g, the bound is

    (J' W J)^-1,   1/W = s_f^2 + s_g^2 / det F,

because fewer pixels of g show material that has shrunk. Used by cramer_rao.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import FourierMode, Taper, square_family
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.pyramid import eroded
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.speckle.pattern import Speckle

FloatArray = NDArray[np.float64]

PIXEL = 0.01
GRID = PixelGrid.centred(360, 320, PIXEL)
BORDER_PX = 40
STRAIN = 0.05


@dataclass(frozen=True, eq=False)
class Truth:
    """A displacement that the ansatz can describe, with its images and its bound.

    Parameters
    ----------
    ansatz, a
        Ansatz and true unknowns (n,).
    """

    ansatz: Ansatz
    a: FloatArray

    @classmethod
    def default(cls) -> Truth:
        """Strain of 5 %, pattern, random changes of all unknowns; displacements of up to 11 px."""
        everywhere = Taper(Box.centred(3.4, 3.8), 0.5)
        mode = FourierMode.scaled(square_family("junction"), 1.0, everywhere)
        ansatz = Ansatz(Box.centred(2.6, 3.0), (mode,))
        rng = np.random.default_rng(0)
        a = ansatz.initial_guess(STRAIN, 1.5)
        for c in (0, 1):
            a[ansatz.v0_slice(c)] += 0.003 * rng.normal(size=ansatz.v0_space.size)
        a[ansatz.v_slice(0)][1:] += 0.05 * rng.normal(size=ansatz.v_space.size - 1)
        a[ansatz.phi_slice(0)] += 0.02 * rng.normal(size=mode.family.size)
        return cls(ansatz, a)

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """(rows, cols) True on pixels that the displacement does not move off the image."""
        mask = np.zeros(GRID.shape, dtype=np.bool_)
        mask[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
        return mask

    @cached_property
    def used(self) -> tuple[NDArray[np.intp], ...]:
        """Rows and columns of the pixels that a correlation uses."""
        return np.nonzero(eroded(self.mask, CorrelationOptions().edge_px))

    @cached_property
    def sensitivities(self) -> FloatArray:
        """(pixels, 2, n) derivatives of the displacement along x and y by the unknowns."""
        row, col = self.used
        points = GRID.x[col, None], GRID.y[row, None]  # two-dimensional: points, not axes
        return self.ansatz.sensitivities(self.a, *points)[:, 0]

    @cached_property
    def deformation_gradient(self) -> FloatArray:
        """(pixels, 2, 2) F by central differences, with errors of the order h^2."""
        row, col = self.used
        at, h = np.stack([GRID.x[col], GRID.y[row]], axis=-1), 1e-5
        F = np.tile(np.eye(2), (len(at), 1, 1))
        for k, step in enumerate(h * np.eye(2)):
            ahead, behind = (self.ansatz.displacement_at(self.a, at + s) for s in (step, -step))
            F[:, :, k] += (ahead - behind) / (2 * h)
        return F

    @cached_property
    def came_from(self) -> FloatArray:
        """(rows, cols, 2) X with X + u(X) = x at the pixels x, by fixed-point iteration [mm]."""
        at = np.stack(np.meshgrid(GRID.x, GRID.y), axis=-1)
        low, high = at[-1, 0], at[0, -1]
        point = at
        for _ in range(300):
            # Polynomials grow fast outside the image; points from there aren't correlated.
            moved = at - self.ansatz.displacement_at(self.a, np.clip(point, low, high))
            change = abs(moved - point).max()
            point = moved
            if change < 1e-12:
                return point
        raise AssertionError(f"the inverse of the displacement has not converged: {change} mm")

    def images(self, speckle: Speckle) -> tuple[FloatArray, FloatArray]:
        """Exact f and g [fraction of full scale]."""
        row, col = GRID.to_px(self.came_from[..., 0], self.came_from[..., 1])
        return speckle.image(), speckle.exact(row, col)

    def bound(self, speckle: Speckle, in_f: float, in_g: float) -> FloatArray:
        """(n, n) covariance that no unbiased estimator can undercut, for noise in f and in g."""
        d_row, d_col = speckle.gradient(*self.used)
        slope = np.stack([d_col, -d_row], axis=-1) / PIXEL  # of f along x and y [1/mm]
        moved = np.linalg.solve(np.swapaxes(self.deformation_gradient, 1, 2), slope[..., None])
        J = np.einsum("pc,pcn->pn", moved[..., 0], self.sensitivities)
        det = np.linalg.det(self.deformation_gradient)
        information = J.T @ (J / (in_f**2 + in_g**2 / det)[:, None])
        return np.asarray(np.linalg.inv(information))
