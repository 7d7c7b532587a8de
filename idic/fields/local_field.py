"""A displacement field known at points: what a local DIC measures, of whatever make.

A point that failed stays in the field, marked as not valid: what was lost is counted, not hidden.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from modeharvest.errors import InputError
from modeharvest.idic.chebyshev import Box
from modeharvest.imaging.grid import PixelGrid

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class LocalField:
    """Displacements at points of the reference image.

    Parameters
    ----------
    x, y
        (n,) positions in the physical frame, y up [mm].
    u
        (n, 2) displacements along x and y [mm]; anything where not ``valid``.
    valid
        (n,) True where the displacement counts; by default wherever it is finite.
    sd
        (n, 2) standard deviations of u [mm]; None if not known.
    source
        Where the field comes from, in a few words.
    """

    x: FloatArray
    y: FloatArray
    u: FloatArray
    valid: BoolArray | None = None
    sd: FloatArray | None = None
    source: str = ""

    def __post_init__(self) -> None:
        for name in ("x", "y", "u", "sd"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64))
        n = self.x.size
        if self.x.shape != (n,) or self.y.shape != (n,) or self.u.shape != (n, 2) or n == 0:
            raise InputError(
                f"local field{self._named}: expected x (n,), y (n,) and u (n, 2) with n > 0, got "
                f"{self.x.shape}, {self.y.shape} and {self.u.shape}"
            )
        if self.sd is not None and self.sd.shape != (n, 2):
            raise InputError(f"local field{self._named}: expected sd ({n}, 2), got {self.sd.shape}")
        finite = np.isfinite(np.column_stack([self.x, self.y, self.u])).all(axis=1)
        given = finite if self.valid is None else np.asarray(self.valid, dtype=np.bool_)
        if given.shape != (n,):
            raise InputError(f"local field{self._named}: expected valid ({n},), got {given.shape}")
        object.__setattr__(self, "valid", given & finite)
        if not self.good.any():
            raise InputError(
                f"local field{self._named}: expected at least one valid point, got {n} points "
                "without a finite displacement; measure again with a looser threshold"
            )

    @property
    def _named(self) -> str:
        return f" {self.source}" if self.source else ""

    @property
    def good(self) -> BoolArray:
        """(n,) True at valid points."""
        assert self.valid is not None  # set when the field was made
        return self.valid

    @property
    def lost(self) -> int:
        """Number of points that are not valid."""
        return int((~self.good).sum())

    @property
    def valid_share(self) -> float:
        """Share of the points that are valid [-]."""
        return float(self.good.mean())

    @property
    def rms(self) -> float:
        """Root mean square of a component of u over the valid points [mm]."""
        return float(np.sqrt(np.mean(self.u[self.good] ** 2)))

    @property
    def sd_rms(self) -> float:
        """Root mean square of the standard deviations over the valid points [mm]; NaN if none."""
        if self.sd is None:
            return float("nan")
        return float(np.sqrt(np.mean(self.sd[self.good] ** 2)))

    @property
    def spacing(self) -> float:
        """Median distance of a point from its nearest neighbour [mm]; infinite for one point."""
        points = np.column_stack([self.x, self.y])[np.isfinite(self.x) & np.isfinite(self.y)]
        if len(points) < 2:
            return float("inf")
        return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))

    @property
    def box(self) -> Box:
        """The smallest box around the valid points [mm]."""
        x, y = self.x[self.good], self.y[self.good]
        return Box(float(x.min()), float(x.max()), float(y.min()), float(y.max()))

    def valid_points(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(m,) x, (m,) y and (m, 2) u of the valid points [mm]."""
        return self.x[self.good], self.y[self.good], self.u[self.good]

    def within(self, region: Box) -> LocalField:
        """The part of the field inside a box; raises InputError if no valid point is there."""
        inside = (self.x >= region.x_min) & (self.x <= region.x_max)
        inside &= (self.y >= region.y_min) & (self.y <= region.y_max)
        return self.selected(inside, "the box")

    def selected(self, keep: BoolArray, what: str = "the selection") -> LocalField:
        """The points that ``keep`` (n,) names; raises InputError if none of them is valid."""
        if not (keep & self.good).any():
            raise InputError(
                f"local field{self._named}: expected valid points in {what}, got none; the field "
                f"covers x = {self.box.x_min:.2f} to {self.box.x_max:.2f} and "
                f"y = {self.box.y_min:.2f} to {self.box.y_max:.2f} mm"
            )
        sd = None if self.sd is None else self.sd[keep]
        return LocalField(
            self.x[keep], self.y[keep], self.u[keep], self.good[keep], sd, self.source
        )

    def less(self, displacement: Callable[[FloatArray], FloatArray]) -> LocalField:
        """What a model leaves over: w = u − model, with the field's own standard deviations.

        Parameters
        ----------
        displacement
            From (n, 2) points to (n, 2) displacements [mm], as
            ``partial(ansatz.displacement_at, unknowns)``.
        """
        points = np.column_stack([self.x, self.y])
        where = np.isfinite(points).all(axis=1)
        model = np.full(self.u.shape, np.nan)
        model[where] = displacement(points[where])
        return replace(self, u=self.u - model)

    @property
    def rms_beyond_noise(self) -> float:
        """√(rms² − sd²) [mm]: what is there beyond the field's own errors; 0 if nothing is.

        NaN if the standard deviations are not known.
        """
        return float(np.sqrt(np.maximum(0.0, self.rms**2 - self.sd_rms**2)))


def sampled_field(
    displacement: ArrayLike, grid: PixelGrid, mask: ArrayLike, step: int, source: str = "sampled"
) -> LocalField:
    """Take a field known at pixels at every ``step``-th of them, where there is material.

    Parameters
    ----------
    displacement
        (rows, cols, 2) [mm].
    grid
        Its pixels.
    mask
        (rows, cols) True where the displacement counts.
    step
        Distance of the points [px].
    source
        What to call it.

    Raises
    ------
    InputError
        If the shapes differ from the grid's, or the step is less than 1 px.
    """
    u, inside = np.asarray(displacement, np.float64), np.asarray(mask, np.bool_)
    if u.shape != (*grid.shape, 2) or inside.shape != grid.shape or step < 1:
        raise InputError(
            f"expected a displacement {(*grid.shape, 2)}, a mask {grid.shape} and a step of at "
            f"least 1 px, got {u.shape}, {inside.shape} and {step}"
        )
    row, col = np.mgrid[step // 2 : grid.rows : step, step // 2 : grid.cols : step]
    row, col = (i[inside[row, col]] for i in (row, col))
    x, y = grid.to_mm(row, col)
    return LocalField(x, y, u[row, col], source=source)
