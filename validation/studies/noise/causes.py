"""Why noise scatters a measurement by more than the Cramér–Rao bound, one cause after another.

A measurement ends where the gradient of the cost vanishes. Noise pushes that gradient, with a
covariance V, and the unknowns give way by the inverse of the cost's curvature H: their covariance
is H⁻¹VH⁻¹. With noise s in both images, to first order in s:

===============  ================  ==========================================================
name             covariance / s²   what it takes into account
===============  ================  ==========================================================
bound            2 M⁻¹             M = JᵀJ: the ansatz describes everything, and nothing shrinks
det F            M⁻¹ V₀ M⁻¹        and where the material has shrunk, pixels share the noise of g
curvature        H⁻¹ V₀ H⁻¹        and what the ansatz leaves over makes the cost softer
least            H⁻¹ V H⁻¹         and the gradient of g's noise pushes there, too
===============  ================  ==========================================================

The last is the least that least squares can do. Further up, noise is not weak any more: the
gradient of g's own noise is no longer small against the speckle's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.compared import Compared
from modeharvest.idic.error_bars import noise_covariance
from modeharvest.idic.result import Result
from modeharvest.validation.studies.subject import Images, Scene

FloatArray = NDArray[np.float64]

CAUSES = ("bound", "det F", "curvature", "least")
"""Each with all that stand before it."""
SOFTENED = "softened"
"""2 H⁻¹MH⁻¹, the curvature only: what :func:`modeharvest.idic.error_bars.softened` knows of."""
LADDER = (*CAUSES, SOFTENED)
EXAMPLES = 24
"""Of the noise, for V; each counts as many times as there are unit cells."""
_WEAK = 0.01
"""Noise of the examples [fraction of full scale]; only its linear effect is taken."""


def compared(scene: Scene, result: Result, images: Images) -> Compared:
    """What a correlation of images of this scene compared at its end."""
    options = scene.how.options()
    return Compared.of(result, images, scene.masks(), options.edge_px)


def explained(seen: Compared, result: Result) -> Compared:
    """The same without a residual: f is what g says that it is."""
    left = result.residual(seen.reference, seen.deformed, seen.order)
    f = np.where(seen.used, seen.reference - left, seen.reference).astype(np.float32)
    return replace(seen, reference=f)


def covariances(scene: Scene, result: Result, seed: int) -> dict[str, FloatArray]:
    """The (n, n) covariances of the unknowns for noise of 1 in both images, by their causes.

    Parameters
    ----------
    scene, result
        A pair of exact images, and what was found of it.
    seed
        Of the examples of noise.

    Returns
    -------
    dict
        For each of ``CAUSES`` and ``SOFTENED``; infinite on the diagonal where the images say
        nothing.
    """
    seen, cell = compared(scene, result, scene.pair()), scene.specimen.pitch
    lost = np.isinf(np.diag(result.inverse))
    at = np.ix_(~lost, ~lost)
    inverse, soft = result.inverse[at], seen.softness(result)[at]
    M = np.linalg.inv(inverse)
    # Noise in f pushes by s²M, noise in g by what its examples do.
    V0, V = (
        M + M @ _by_noise_of_g(images, result, cell, seed)[at] @ M
        for images in (explained(seen, result), seen)
    )
    known = {
        "bound": 2.0 * inverse,
        "det F": inverse @ V0 @ inverse,
        "curvature": soft @ V0 @ soft,
        "least": soft @ V @ soft,
        SOFTENED: 2.0 * soft @ M @ soft,
    }
    found = {}
    for name, covariance in known.items():
        found[name] = np.diag(np.where(lost, np.inf, 0.0))
        found[name][at] = covariance
    return found


def _by_noise_of_g(seen: Compared, result: Result, cell: float, seed: int) -> FloatArray:
    """(n, n) M⁻¹V_gM⁻¹ / s²: V_g by noise s in g alone, pushing every cell independently."""
    found = noise_covariance(
        result, seen.reference, seen.deformed, _noises(seen.reference, seed), seen.used, cell,
        seen.order, result.inverse,
    )  # fmt: skip
    return np.asarray(found / _WEAK**2, dtype=np.float64)


def _noises(like: NDArray[np.float32], seed: int) -> Iterator[Images]:
    rng = np.random.default_rng([seed, EXAMPLES])
    none = np.zeros_like(like)
    for _ in range(EXAMPLES):
        noise = rng.standard_normal(none.shape, dtype=np.float32)
        yield none, np.float32(_WEAK) * noise
