"""Recompute the mean stresses in an RVE file from its mesh, modes and law, with numpy alone.

python examples/rve_stress.py out/homogenized/rve.h5
"""

import sys

import numpy as np
from read_rve import read


def displacement(rve, q, w):
    """(n, 2) u = (F - I) X + sum (v_i + g_i . X) phi_i + w [mm] for generalised strains q."""
    X, m = rve["nodes"], len(rve["modes"])
    amplitudes = q[4 : 4 + m] + X @ q[4 + m :].reshape(m, 2).T
    affine = X @ (q[:4].reshape(2, 2) - np.eye(2)).T
    return affine + np.einsum("ni,inx->nx", amplitudes, rve["modes"]) + w


def stress(F, law):
    """(..., 2, 2) first Piola-Kirchhoff stress dW/dF [MPa], from the principal stretches s."""
    U, s, V = np.linalg.svd(F)
    J, I1 = np.prod(s, axis=-1)[..., None], np.sum(s**2, axis=-1)[..., None] + 1
    if law["kind"] == "Ogden":
        terms = zip(law["moduli"], law["exponents"], strict=True)
        slopes = sum(c / m * (s**m - 1) / s for c, m in terms) + law["kappa"] * (J - 1) * J / s
    else:  # TwoTermI1
        slopes = 2 * law["c1"] * (s - 1 / s) + 4 * law["c2"] * (I1 - 3) * s
        slopes += law["bulk"] * (J - 1) * J / s
    return U * slopes[..., None, :] @ V


def mean_stress(rve, law, u):
    """(2, 2) mean P [MPa]: three-point Gauss rule, divided by the area that includes holes."""
    a, b, c = (1 + 3 * np.eye(3)) / 6  # barycentric coordinates of the three points
    none = np.zeros(3)
    by_b = [1 - 4 * a, 4 * b - 1, none, 4 * (a - b), 4 * c, -4 * c]
    by_c = [1 - 4 * a, none, 4 * c - 1, -4 * b, 4 * b, 4 * (a - c)]
    at_nodes = np.stack([rve["nodes"], u])[:, rve["cells"]]
    J, H = np.einsum("xkp,feky->fepyx", [by_b, by_c], at_nodes)
    P = stress(np.eye(2) + H @ np.linalg.inv(J), law)
    return np.einsum("ep,epxy->xy", np.linalg.det(J) / 6, P) / rve["area"]


if __name__ == "__main__":
    rve, attributes = read(sys.argv[1])
    law = attributes["material/0"]
    pairs = zip(rve["states/strains"], rve["states/fluctuations"], strict=True)
    found = [mean_stress(rve, law, displacement(rve, q, w)).ravel() for q, w in pairs]
    off = np.abs(found - rve["states/stresses"][:, :4]).max()
    print(f"{len(found)} states: P rebuilt within {off:.1e} MPa of the file's")
