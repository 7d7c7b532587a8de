"""Identifiability: which unknowns and modes the images determine, and which they do not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.idic.result import Result
from modeharvest.imaging.pair import checked_mask
from modeharvest.util.arrays import FloatArray
from modeharvest.util.scaled_eigen import ScaledEigen

_POINTS = 4000  # at which displacements are compared
_LISTED = 3  # combinations, and terms of each
FINE = 5.0
"""Least speckle size over w: for w of 2 px rms, IDIC is 0.25 px off the best fit with speckles of
12 px, 0.47 px with 0.7 of that, in a local minimum with half (docs/explanation/systematic.md)."""
OBSERVABLE = 2.0
"""A mode counts as observable if v_i phi_i is at least this many times the model error."""


@dataclass(frozen=True)
class Combination:
    """A combination of unknowns that the images hardly determine."""

    eigenvalue: float
    """Eigenvalue of the column-scaled Gauss-Newton matrix [-]; the mean of all is 1."""
    terms: tuple[tuple[str, float], ...]
    """The largest parts: name of the unknown and its weight in the scaled eigenvector."""

    def __str__(self) -> str:
        parts = " ".join(f"{weight:+.2f} {name}" for name, weight in self.terms)
        return f"{parts} (eigenvalue {self.eigenvalue:.1e})"


@dataclass(frozen=True)
class Identifiability:
    """Measures of how well a correlation's unknowns are determined."""

    condition_number: float
    """Condition number of the column-scaled Gauss-Newton matrix."""
    undetermined: tuple[str, ...]
    """Names of the unknowns that the images don't determine."""
    worst: tuple[Combination, ...]
    """The worst-determined combinations of the others, the worst first."""
    overlap: tuple[float, ...]
    """For each mode the largest cosine between a displacement by its v_i and phi_i and one by v0
    [-]; 1 means that both can describe the same displacement."""
    model_error_px: float
    """Estimated model error, rms per component: residual over grey-level gradient [px]."""
    amplitude_px: tuple[float, ...]
    """For each mode the rms of v_i phi_i per component [px]."""
    speckle_px: float = np.inf
    """Full width at half maximum of the speckle's autocorrelation [px]; infinite if not known."""

    @property
    def unobservable(self) -> tuple[int, ...]:
        """Numbers (from 0) of the modes that are too weak for phi_i to be meaningful."""
        least = OBSERVABLE * self.model_error_px
        return tuple(i for i, size in enumerate(self.amplitude_px) if size < least)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user, one sentence each."""
        has_others = len(self.unobservable) < len(self.amplitude_px)
        why = ("before buckling there is no pattern to measure", "others are")[has_others]
        found = [
            f"phi{i + 1} is not observable: v{i + 1} phi{i + 1} is {self.amplitude_px[i]:.2g} px "
            f"rms, the model error about {self.model_error_px:.2g} px ({why}); fix the mode, or "
            "don't interpret it" for i in self.unobservable
        ]  # fmt: skip
        if self.speckle_px < FINE * self.model_error_px:
            found.append(
                f"the speckle is {self.speckle_px:.2g} px wide, the model error about "
                f"{self.model_error_px:.2g} px: speckles finer than {FINE:g} times that pull the "
                "measurement away from the best fit, finer than twice possibly to a local minimum; "
                "spray coarser, take pictures of fewer pixels, or blur them"
            )
        if self.undetermined:
            names = ", ".join(self.undetermined[:_LISTED])
            more = ", ..." if len(self.undetermined) > _LISTED else ""
            what = f"{len(self.undetermined)} unknowns: {names}{more}"
            found.append(f"the images say nothing about {what}")
        return tuple(found)


def identifiability(result: Result, mask: ArrayLike | None = None) -> Identifiability:
    """Examine the Gauss-Newton matrix and the displacements that the unknowns cause.

    For a correlation, or a fit to a displacement (then ``model_error_px`` is its residual); the
    mask (rows, cols) is True on material, everywhere by default. Raises InputError if it is not of
    the images' size or has no material.
    """
    S, u = _sensitivities(result, mask)
    ansatz, n_modes = result.ansatz, len(result.ansatz.modes)
    v0 = S[:, : ansatz.v0_slice(1).stop]
    overlaps = []
    for i in range(n_modes):
        own = np.hstack([S[:, ansatz.v_slice(i)], S[:, ansatz.phi_slice(i)]])
        overlaps.append(float(np.linalg.svd(_orthonormal(v0).T @ _orthonormal(own))[1][0]))
    px = result.grid.pixel_size
    amplitudes = tuple(float(np.sqrt((u[i] ** 2).mean()) / px) for i in range(n_modes))
    return Identifiability(
        result.condition_number, result.undetermined, _worst(result), tuple(overlaps),
        result.model_error_px, amplitudes, result.weighting.speckle_size_px,
    )  # fmt: skip


def _sensitivities(result: Result, mask: ArrayLike | None) -> tuple[FloatArray, list[FloatArray]]:
    """At some points of the material: (2 p, n) du/da, and for each mode (p, 2) v_i phi_i [mm]."""
    grid, a = result.grid, result.unknowns
    inside = checked_mask(mask, "mask", grid)
    inside = np.ones(grid.shape, dtype=np.bool_) if inside is None else inside
    stride = max(1, int(np.sqrt(inside.sum() / _POINTS)))
    row, col = (index * stride for index in np.nonzero(inside[::stride, ::stride]))
    if not row.size:
        row, col = np.nonzero(inside)
    x, y = grid.x[col][:, None], grid.y[row][:, None]  # as columns: positions, not axes
    S = result.ansatz.sensitivities(a, x, y)
    modes = range(len(result.ansatz.modes))
    u = [result.ansatz.fluctuation(i, a, x, y)[:, 0] for i in modes]
    return S.reshape(-1, result.ansatz.size), u


def _orthonormal(columns: FloatArray) -> FloatArray:
    """An orthonormal basis of the columns' span; columns of zeros are left out."""
    lengths = np.linalg.norm(columns, axis=0)
    used = columns[:, lengths > 0] / lengths[lengths > 0]
    left, sizes, _ = np.linalg.svd(used, full_matrices=False)
    return np.asarray(left[:, sizes > 1e-10 * sizes.max(initial=0.0)])


def _worst(result: Result) -> tuple[Combination, ...]:
    kept = np.flatnonzero(np.isfinite(np.diag(result.inverse)))
    matrix = np.linalg.inv(result.inverse[np.ix_(kept, kept)])
    eigen = ScaledEigen.of(np.asarray(matrix, np.float64))
    found = []
    for value, vector in zip(eigen.values[:_LISTED], eigen.vectors.T[:_LISTED], strict=True):
        largest = np.argsort(-abs(vector))[:_LISTED]
        vector = vector * np.sign(vector[largest[0]])
        terms = tuple((result.names[kept[k]], float(vector[k])) for k in largest)
        found.append(Combination(float(value), terms))
    return tuple(found)
