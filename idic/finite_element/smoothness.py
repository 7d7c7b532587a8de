"""Smoothness of a displacement on a mesh, without a material law.

    u'Ru = sum over elements int |grad grad u|^2 dA
         + sum over inner sides (2/h) int |[grad u]|^2 ds,

[.] being the jump across a side of length h: zero for affine displacements alone, and natural
(free) at all boundaries. It is the energy of a bent plate in the interior-penalty form of G.
Engel et al., Comput. Methods Appl. Mech. Eng. 191 (2002), doi 10.1016/S0045-7825(02)00286-4. A
wave of length T costs (2 pi/T)^4 times its mean square, so that a weight of (l/T)^4 v'Mv/v'Rv for
any wave v halves what of it is at the wavelength l: H. Leclerc, J.-N. Perie, S. Roux, F. Hild,
Exp. Mech. 51 (2011), doi 10.1007/s11340-010-9435-9.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from modeharvest.fem.field import Mesh
from modeharvest.imaging.mapping.elements import reference_element, shape_gradients
from modeharvest.util.arrays import FloatArray, IntArray

_PENALTY = 2.0
"""Of jumps across sides, against second gradients [-]."""
_QUADRATURE = np.array([[1 / 6, 1 / 6], [2 / 3, 1 / 6], [1 / 6, 2 / 3]])
_GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)


def inner_sides(cells: IntArray) -> IntArray:
    """(s, 4) first cell, its side 0 ... 2, second cell and its side, of sides between two cells."""
    corners = np.sort(np.stack([cells[:, [k, (k + 1) % 3]] for k in range(3)], axis=1), axis=2)
    flat = corners.reshape(-1, 2)
    order = np.lexsort(flat.T)
    same = (flat[order[1:]] == flat[order[:-1]]).all(axis=1)
    first, second = order[:-1][same], order[1:][same]
    return np.stack([first // 3, first % 3, second // 3, second % 3], axis=1)


def second_gradients(mesh: Mesh) -> tuple[FloatArray, FloatArray]:
    """(m, q, k, 2, 2) second derivatives of the shape functions [1/mm^2], (m, q) weights [mm^2]."""
    local = shape_gradients(mesh.element, _QUADRATURE)  # (q, k, 2)
    coefficients = reference_element(mesh.element).coefficients
    # Of 1, xi, eta, xi^2, xi eta, eta^2 only the last three have second derivatives.
    second = np.array([[[2, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 2]]], dtype=float)
    curved = np.einsum("mij,mk->kij", second, coefficients[3:6])
    x = mesh.nodes[mesh.cells]
    F = np.einsum("eki,qkj->eqij", x, local)
    inverse = np.linalg.inv(F)
    slopes = np.einsum("qkj,eqji->eqki", local, inverse)
    bending = np.einsum("eki,klm->eilm", x, curved)
    bare = curved - np.einsum("eqki,eilm->eqklm", slopes, bending)
    found = np.einsum("eqli,eqklm,eqmj->eqkij", inverse, bare, inverse)
    return found, np.linalg.det(F) / 6.0


def side_jumps(mesh: Mesh, sides: IntArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Jumps of the gradient across inner sides.

    Returns
    -------
    nodes, jumps, weights
        (s, 2 k) node numbers of both cells, (s, g, 2 k, 2) jump of the gradient for each of them
        [1/mm] at Gauss points, (s, g) lengths that these stand for, over that of the side [-].
    """
    corners = reference_element(mesh.element).nodes[:3]
    parts, weights = [], np.empty(0)
    for sign, cell, side, forwards in ((1.0, 0, 1, True), (-1.0, 2, 3, False)):
        begin, end = corners[sides[:, side]], corners[(sides[:, side] + 1) % 3]
        t = _GAUSS if forwards else 1.0 - _GAUSS  # the other cell goes the other way
        at = begin[:, None] + t[:, None] * (end - begin)[:, None]
        local = shape_gradients(mesh.element, at)  # (s, g, k, 2)
        x = mesh.nodes[mesh.cells[sides[:, cell]]]
        F = np.einsum("ski,sgkj->sgij", x, local)
        parts.append(sign * np.einsum("sgkj,sgji->sgki", local, np.linalg.inv(F)))
        if forwards:
            along = np.linalg.norm(np.einsum("sgij,sj->sgi", F, end - begin), axis=-1)
            weights = 0.5 * along / along.mean(axis=1, keepdims=True)
    nodes = np.hstack([mesh.cells[sides[:, 0]], mesh.cells[sides[:, 2]]])
    return nodes, np.concatenate(parts, axis=2), weights


def smoothness_matrix(mesh: Mesh) -> csr_array:
    """(n, n) R of one component [1/mm^2], for nodal values (n,) on a T6 mesh; sorted indices."""
    gradients, weights = second_gradients(mesh)
    inside = np.einsum("eq,eqkij,eqlij->ekl", weights, gradients, gradients, optimize=True)
    nodes, jumps, shares = side_jumps(mesh, inner_sides(mesh.cells))
    across = _PENALTY * np.einsum("sg,sgki,sgli->skl", shares, jumps, jumps, optimize=True)
    n = len(mesh.nodes)
    total = csr_array((n, n))
    for groups, blocks in ((mesh.cells, inside), (nodes, across)):
        k = groups.shape[1]
        at = np.repeat(groups, k, axis=1).ravel(), np.tile(groups, (1, k)).ravel()
        total = total + csr_array((blocks.ravel(), at), shape=(n, n))
    total.sort_indices()
    return total


def add_at(total: FloatArray, nodes: IntArray, values: FloatArray) -> None:
    """Add values (m, k, s) to the rows of (n, s) whose numbers are (m, k)."""
    flat = nodes.ravel()
    ones = csr_array((np.ones(flat.size), (flat, np.arange(flat.size))), (len(total), flat.size))
    total += ones @ values.reshape(flat.size, -1)
