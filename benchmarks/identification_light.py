"""Effect of unknown illumination on the intervals of identified parameters.

An identification finds gain and offset of the illumination before each level, as polynomials over
the image, and then keeps them. Here they are unknowns beside the parameters (a Schur complement of
the joint normal matrix), for the two states of identification_statistics.py and speckles of two
sizes. Printed are standard deviations with them over those without, and errors of parameters by
gain and offset that are off by one sd: see docs/how-to/identification.md, "Photographs".

Run: scripts/env python benchmarks/identification_light.py
"""

from __future__ import annotations

import numpy as np
from identification_statistics import NOISE, STRAINS, TRUE, made
from scipy.ndimage import gaussian_filter

from modeharvest.idic.finite_element.result import located, nodal_values
from modeharvest.util.arrays import FloatArray

PIXEL = 0.03
"""Pixel size [mm]."""
FORCE_SD = 0.003
"""Standard deviation of the load cell [N/mm]."""


def main() -> None:
    model = made(0.35)
    states = model.at(np.array(list(TRUE.values())))
    mesh, k = states[0].mesh, len(TRUE)
    (x0, y0), (x1, y1) = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    x, y = np.meshgrid(np.arange(x0, x1, PIXEL), np.arange(y0, y1, PIXEL))
    points = np.column_stack([x.ravel(), y.ravel()])
    inside = located(mesh, points)[0] >= 0
    fields = [np.moveaxis(s.displacement_by, 0, 2) for s in states]
    seen = [nodal_values(mesh, S, points[inside]) for S in fields]  # (p, 2, k)
    print(
        "| speckle, sd of the blur [px] | degree of the light | sd with over without | off [sd] |"
    )
    print("|---|---|---|---|")
    for blur in (1.5, 3.0):
        noise = np.random.default_rng(0).normal(size=x.shape)
        image = gaussian_filter(noise, blur)
        image = 0.5 + 0.2 * image / image.std()
        slopes = np.stack(np.gradient(image)[::-1], axis=-1).reshape(-1, 2)[inside] / PIXEL
        for degree in (0, 1, 2, 4):
            light = light_of(points[inside], image.ravel()[inside], degree)
            print(
                f"| {blur} | {degree} | " + " | ".join(row(states, seen, slopes, light, k)) + " |"
            )


def light_of(points: FloatArray, grey: FloatArray, degree: int) -> FloatArray:
    """(p, n) derivatives of grey levels by the coefficients of offset and gain, polynomials."""
    u, v = (points / np.abs(points).max(axis=0)).T
    smooth = [u**i * v**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.array([*smooth, *(p * grey for p in smooth)]).T


def row(states: list, seen: list, slopes: FloatArray, light: FloatArray, k: int) -> list[str]:  # type: ignore[type-arg]
    """Ratios of standard deviations, and the largest error by the light over the sd without it."""
    n = light.shape[1]
    matrix = np.zeros((k + len(STRAINS) * n,) * 2)
    for number, (state, S) in enumerate(zip(states, seen, strict=True)):
        J = np.einsum("pi,pik->pk", slopes, S)
        full = np.zeros((len(J), len(matrix)))
        full[:, :k] = J
        full[:, k + number * n : k + (number + 1) * n] = light
        matrix += full.T @ full / (2.0 * NOISE**2)
        matrix[:k, :k] += np.outer(state.force_by, state.force_by) / FORCE_SD**2
    alone, joint = np.linalg.inv(matrix[:k, :k]), np.linalg.inv(matrix)
    sd, wider = np.sqrt(np.diag(alone)), np.sqrt(np.diag(joint)[:k])
    off = np.sqrt(np.maximum(wider**2 - sd**2, 0.0)) / sd
    return [f"{', '.join(f'{v:.4f}' for v in wider / sd)}", f"{off.max():.3f}"]


if __name__ == "__main__":
    main()
