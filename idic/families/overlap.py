"""How alike a nodal field and an analytic mode are, over the material.

The normalised overlap |∫ u·φ dA| / (‖u‖ ‖φ‖) is 1 for fields that differ by a factor. Both are
taken without their mean over the material: a rigid translation is no part of a mode.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError
from modeharvest.fem.field import Mesh
from modeharvest.idic.families.quadrature import Quadrature, points_for
from modeharvest.idic.fourier import ModeFamily

FloatArray = NDArray[np.float64]


def overlap(
    mesh: Mesh,
    values: ArrayLike,
    family: ModeFamily,
    pitch: float,
    parameters: ArrayLike | None = None,
) -> float:
    """Normalised overlap of a nodal field with a family's waves [-], between 0 and 1.

    Parameters
    ----------
    mesh
        Of the field [mm].
    values
        (n, 2) field at the nodes [any unit].
    family
        Whose waves to compare with; the taper is left out.
    pitch
        l [mm].
    parameters
        (m,) of the mode; by default the family's start.

    Raises
    ------
    InputError
        If the field's shape differs from the nodes', or one of the two is only a translation.
    """
    u = np.asarray(values, dtype=np.float64)
    if u.shape != mesh.nodes.shape or not np.isfinite(u).all():
        raise InputError(
            f"overlap: expected a finite field of shape {mesh.nodes.shape}, got {u.shape}"
        )
    waves = family.waves(family.start if parameters is None else parameters)
    largest = float(np.linalg.norm(waves[:, 2:4], axis=1).max())
    rule = Quadrature(mesh, points_for(mesh, 2.0 * np.pi * largest / pitch))
    phi = wave_values(rule, waves, pitch)
    return float(np.sqrt(best_amplitude(rule, rule.without_mean(rule.values(u)), phi)[1]))


def wave_values(rule: Quadrature, waves: FloatArray, pitch: float) -> FloatArray:
    """(q, 2) sum of waves (w, 5) at the points of a quadrature [-], without mean."""
    phases = np.pi / pitch * (rule.positions @ waves[:, 2:4].T + waves[:, 4])
    return rule.without_mean(np.sin(phases) @ waves[:, :2])


def best_amplitude(rule: Quadrature, u: FloatArray, phi: FloatArray) -> tuple[float, float]:
    """Factor a that makes a φ nearest to u, and the share of ∫ |u|² that a φ is.

    The share is the square of the normalised overlap.

    Raises
    ------
    InputError
        If one of the two is zero.
    """
    mixed, uu, pp = rule.product(u, phi), rule.product(u, u), rule.product(phi, phi)
    if not (uu > 0 and pp > 0):
        raise InputError("overlap: expected two fields that are more than a translation, got zero")
    return mixed / pp, min(1.0, mixed**2 / (uu * pp))
