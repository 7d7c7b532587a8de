"""The same pattern written with other numbers: equivalents of the mode's seven parameters.

The square family of modes is (Eq. (mode) of the paper), with θᵢ the arguments of its sines::

    φ = a₁ [−sin θ₁ − sin θ₂] e_x + [sin θ₁ − sin θ₂] e_y
    θ₁ = π/l (a₂ x + a₃ y + a₆)        θ₂ = π/l (a₄ x + a₅ y + a₇)

Only the product v₁φ can be seen, and these changes leave it as it is:

* turning a wave round: (k, c) → (−k, l − c), because sin(π − θ) = sin θ;
* shifting a phase c by a multiple of 2l;
* swapping the two waves, with a₁ → −a₁ and v₁ → −v₁: φ_y changes sign by the swap, φ_x by a₁;
* shifting both phases by l, with v₁ → −v₁.

Shifting *one* phase by l gives another field: the pattern moved by one cell.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.errors import InputError

FloatArray = NDArray[np.float64]

REFERENCE_MODE: tuple[float, ...] = (1.0, 1.0, 1.0, -1.0, 1.0, 0.0, 0.0)
"""The ideal square pattern with the origin at a solid junction between four holes."""


def square_mode(mode: ArrayLike, pitch: float, x: ArrayLike, y: ArrayLike) -> FloatArray:
    """Eq. (mode) itself: unscaled and without the taper at the specimen's edge.

    Parameters
    ----------
    mode
        (7,) a₁ … a₅ [-], a₆ and a₇ [mm].
    pitch
        Unit cell size l [mm].
    x, y
        (...) positions [mm].

    Returns
    -------
    (..., 2) components along x and y [-]; the largest possible norm for a₁ = 1 is 2.
    """
    a = _checked(mode)
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    first = np.sin(np.pi / pitch * (a[1] * x + a[2] * y + a[5]))
    second = np.sin(np.pi / pitch * (a[3] * x + a[4] * y + a[6]))
    return np.stack([-a[0] * (first + second), first - second], axis=-1)


def mode_equivalent(
    mode: ArrayLike, pitch: float, nearest_to: ArrayLike = REFERENCE_MODE
) -> tuple[FloatArray, int]:
    """Find the equivalent parameters nearest to a given mode.

    Parameters
    ----------
    mode
        (7,) a₁ … a₅ [-], a₆ and a₇ [mm].
    pitch
        Unit cell size l [mm].
    nearest_to
        (7,) what to be near to; distance is Euclidean, with the phases in units of l.

    Returns
    -------
    (7,) parameters, and the sign that v₁ takes so that v₁φ stays the same field.
    """
    target = _checked(nearest_to)
    scale = np.array([1, 1, 1, 1, 1, 1 / pitch, 1 / pitch])
    candidates = []
    for candidate, sign in _equivalents(_checked(mode), pitch):
        turns = np.round((candidate[5:] - target[5:]) / (2 * pitch))
        candidate[5:] -= 2 * pitch * turns
        candidates.append((float(np.linalg.norm((candidate - target) * scale)), candidate, sign))
    _, best, sign = min(candidates, key=lambda c: c[0])
    return best + 0.0, sign  # adding zero turns -0.0 into 0.0


def mode_deviation(
    mode: ArrayLike, pitch: float, expected: ArrayLike = REFERENCE_MODE
) -> FloatArray:
    """Deviation of a mode from the expected one [%], equivalents resolved.

    Returns
    -------
    (7,) differences: of a₁ … a₅ in % of 1, of the phases a₆ and a₇ in % of l.
    """
    nearest, _ = mode_equivalent(mode, pitch, expected)
    difference = nearest - _checked(expected)
    difference[5:] /= pitch
    return 100 * difference


def _equivalents(a: FloatArray, pitch: float) -> Iterator[tuple[FloatArray, int]]:
    """Go through the 16 equivalents, phases not wrapped."""
    for swap, both, turn1, turn2 in product((False, True), repeat=4):
        sign = 1
        ratio, k1, k2, c1, c2 = a[0], a[1:3], a[3:5], a[5], a[6]
        if swap:
            ratio, k1, k2, c1, c2, sign = -ratio, k2, k1, c2, c1, -sign
        if both:
            c1, c2, sign = c1 + pitch, c2 + pitch, -sign
        if turn1:
            k1, c1 = -k1, pitch - c1
        if turn2:
            k2, c2 = -k2, pitch - c2
        yield np.array([ratio, *k1, *k2, c1, c2]), sign


def _checked(mode: ArrayLike) -> FloatArray:
    a = np.asarray(mode, dtype=np.float64)
    if a.shape != (7,) or not np.isfinite(a).all():
        raise InputError(f"expected 7 finite mode parameters a1 ... a7, got {a.tolist()}")
    return a
