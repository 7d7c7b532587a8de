"""pyxel-dic with the ansatz's basis: the linear part u = v0 + v1 phi1, phi1 given.

pyxel solves for the degrees of freedom of a mesh, whose ``phix`` and ``phiy`` map them to the
displacement of integration points. The ansatz is given to it in three ways, with pyxel's engine
(``Correlate``: modified Gauss-Newton, bicubic splines, normalisation of brightness, direct solver)
and pyramid (``MultiscaleInit``'s scales 3, 2, 1, then full resolution):

* ``dense``: a column of phix and phiy for each unknown, a row for each pixel, as plain arrays;
* ``sparse``: the same as sparse matrices, the format that pyxel's own integration makes;
* ``elements``: a finite-element mesh, and the ansatz at its nodes as pyxel's reduced ``Basis``.
"""

from __future__ import annotations

import contextlib
import io
import time
import warnings
from dataclasses import dataclass
from functools import partial

import numpy as np
import pyxel
import scipy.sparse
from numpy.typing import NDArray
from pairs import ImagePair

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SCALES = (3, 2, 1, 0)
MAX_ITERATIONS = 100
TOLERANCE_PX, COARSE_TOLERANCE_PX = 1e-4, 1e-2
"""Rms step at which to stop, the second in binned px: the defaults of modeharvest."""
ELEMENT_PX = 10
"""Edge of the Q9 elements of images without a specimen's mesh [px]."""
_CHUNK = 100_000


@dataclass(frozen=True, eq=False)
class Found:
    """Result of pyxel.

    Parameters
    ----------
    way
        "dense", "sparse" or "elements".
    displacement
        (rows, cols, 2) at the reference's pixels [mm].
    seconds
        From the standard start to convergence, without ``setup_s``.
    setup_s
        Seconds it took to evaluate the basis, or to integrate over elements.
    iterations
        From the coarsest scale to the finest.
    """

    way: str
    displacement: FloatArray
    seconds: float
    setup_s: float
    iterations: tuple[int, ...]


class CountingEngine(pyxel.dic.DICEngine):  # type: ignore[misc]
    """pyxel's engine, which counts its right-hand sides."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def ComputeRHS(self, *arguments: object) -> object:  # noqa: D102
        self.count += 1
        return super().ComputeRHS(*arguments)


def correlate(pair: ImagePair, way: str, pixels: BoolArray) -> Found:
    """Correlate a pair at ``pixels``; ``way`` is "dense", "sparse" or "elements"."""
    n = pair.ansatz.phi_offset(0)
    scaling = _scaling(pair, pixels, diagonal=way == "sparse")
    unknowns = np.asarray(np.linalg.solve(scaling, pair.start[:n]))
    over = _over_elements if way == "elements" else partial(_over_pixels, way)
    unknowns, clock = over(pair, pixels, scaling, unknowns)
    a = np.concatenate([scaling @ unknowns, pair.start[n:]])
    displacement = pair.ansatz.displacement(a, pair.grid.x, pair.grid.y)
    return Found(way, displacement, clock.solve_s, clock.setup_s, tuple(clock.iterations))


class _Clock:
    """Seconds of setting up and of solving, and iterations."""

    def __init__(self) -> None:
        self.setup_s = self.solve_s = 0.0
        self.iterations: list[int] = []
        self._last = time.perf_counter()

    def lap(self) -> float:
        """Seconds since the last lap."""
        now = time.perf_counter()
        seconds, self._last = now - self._last, now
        return seconds


def basis(pair: ImagePair, x: FloatArray, y: FloatArray, scaling: FloatArray) -> FloatArray:
    """(p, 2, n): displacement [px] along x and y at positions (p,) [mm] for each unknown."""
    out = np.empty((len(x), 2, len(scaling)))
    for begin in range(0, len(x), _CHUNK):
        some = slice(begin, begin + _CHUNK)
        S = pair.ansatz.sensitivities(pair.start, x[some, None], y[some, None])[:, 0]
        out[some] = S[..., : len(scaling)] @ (scaling / pair.grid.pixel_size)
    return out


def _scaling(pair: ImagePair, pixels: BoolArray, *, diagonal: bool) -> FloatArray:
    """(n, n): makes the basis orthonormal over the pixels; a diagonal one keeps its zeros.

    Then the norm of the unknowns is the rms displacement [px], exactly or nearly, so that
    pyxel's criterion |dU| / |U| can be set to stop at the step at which modeharvest does.
    """
    row, col = (index[::37] for index in np.nonzero(pixels))
    n = pair.ansatz.phi_offset(0)
    B = basis(pair, pair.grid.x[col], pair.grid.y[row], np.eye(n)).reshape(-1, n)
    gram = B.T @ B / len(row)
    if diagonal:
        return np.diag(1.0 / np.sqrt(np.diag(gram)))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(gram)).T)


def _over_pixels(
    way: str, pair: ImagePair, pixels: BoolArray, scaling: FloatArray, unknowns: FloatArray
) -> tuple[FloatArray, _Clock]:
    clock = _Clock()
    for scale in SCALES:
        mesh = _pixel_mesh(pair, way, pixels, scaling, 2**scale)
        clock.setup_s += clock.lap()
        rms_px = float(np.linalg.norm(unknowns))
        unknowns = _one_scale(pair, mesh, scale, unknowns, rms_px, clock)
        clock.solve_s += clock.lap()
    return unknowns, clock


def _pixel_mesh(
    pair: ImagePair, way: str, pixels: BoolArray, scaling: FloatArray, factor: int
) -> pyxel.Mesh:
    """Make a mesh without elements, whose integration points are the (binned) pixels."""
    grid = pair.grid.binned(factor)
    blocks = pixels[: grid.rows * factor, : grid.cols * factor]
    share = blocks.reshape(grid.rows, factor, grid.cols, factor).mean(axis=(1, 3))
    row, col = np.nonzero(share >= 0.5)
    columns = basis(pair, grid.x[col], grid.y[row], scaling)
    mesh = pyxel.Mesh({}, np.zeros((0, 2)))
    mesh.ndof, mesh.conn = len(scaling), np.zeros((1, 2), dtype=int)
    mesh.phix, mesh.phiy = (np.ascontiguousarray(columns[:, c]) for c in (0, 1))
    if way == "sparse":
        mesh.phix, mesh.phiy = (scipy.sparse.csr_matrix(p) for p in (mesh.phix, mesh.phiy))
    # pyxel's camera divides by the factor, and ignores the half pixel between the centres of a
    # block and of its first pixel. This has no effect, because it is the same in both images.
    mesh.pgx, mesh.pgy = factor * col.astype(np.float64), -factor * row.astype(np.float64)
    mesh.npg, mesh.wdetJ = len(row), np.ones(len(row))
    return mesh


def _over_elements(
    pair: ImagePair, pixels: BoolArray, scaling: FloatArray, unknowns: FloatArray
) -> tuple[FloatArray, _Clock]:
    clock = _Clock()
    mesh = _element_mesh(pair)
    with contextlib.redirect_stdout(io.StringIO()):
        mesh.Connectivity()
    x, y = pair.grid.to_mm(-mesh.n[:, 1], mesh.n[:, 0])
    at_nodes = basis(pair, x, y, scaling)
    reduced = np.zeros((mesh.ndof, len(unknowns)))
    used = mesh.conn[:, 0] >= 0
    for c in (0, 1):
        reduced[mesh.conn[used, c]] = at_nodes[used, c]
    nodal = reduced @ unknowns
    size = int(mesh.GetApproxElementSize(pyxel.Camera(2)))
    for scale in SCALES:
        here = mesh.Copy()
        here.DICIntegrationFast(max(size // 2**scale, 2))
        _keep(here, pixels)
        clock.setup_s += clock.lap()
        rms_px = float(np.sqrt(2.0 * np.mean(nodal**2)))
        nodal = _one_scale(pair, here, scale, nodal, rms_px, clock, reduced)
        clock.solve_s += clock.lap()
    return np.asarray(np.linalg.lstsq(reduced, nodal)[0]), clock


def _keep(mesh: pyxel.Mesh, pixels: BoolArray) -> None:
    """Remove the integration points at pixels that are not used."""
    row, col = np.rint(-mesh.pgy).astype(int), np.rint(mesh.pgx).astype(int)
    keep = pixels[row, col]
    mesh.phix, mesh.phiy = mesh.phix[keep], mesh.phiy[keep]
    mesh.pgx, mesh.pgy, mesh.wdetJ = mesh.pgx[keep], mesh.pgy[keep], mesh.wdetJ[keep]
    mesh.npg = int(keep.sum())


def _element_mesh(pair: ImagePair) -> pyxel.Mesh:
    """Make the specimen's own mesh if there is one, else squares of Q9; nodes in px, y up."""
    if pair.mesh is None:
        inside = np.argwhere(pair.mask)[:, ::-1]
        box = np.array([inside.min(axis=0), inside.max(axis=0)], dtype=np.float64)
        return pyxel.MeshFromROI(box, ELEMENT_PX, typel=10)[0]
    assert pair.mesh.element == "T6", "pyxel's elements of type 9 are six-node triangles"
    row, col = pair.grid.to_px(*pair.mesh.nodes.T)
    return pyxel.Mesh({9: pair.mesh.cells}, np.column_stack([col, -row]))


def _one_scale(
    pair: ImagePair, mesh: pyxel.Mesh, scale: int, unknowns: FloatArray, rms_px: float,
    clock: _Clock, reduced: FloatArray | None = None,
) -> FloatArray:  # fmt: skip
    """Run pyxel on one scale of the images."""
    images = []
    for pixels in (pair.reference, pair.deformed):
        image = pyxel.Image("")
        image.pix = pixels.astype(np.float64)
        if scale > 0:
            image.SubSample(scale)
        images.append(image)
    step_px = TOLERANCE_PX if scale == 0 else COARSE_TOLERANCE_PX * 2**scale
    engine = CountingEngine()
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.sparse.SparseEfficiencyWarning)
        found, _ = pyxel.Correlate(
            *images, mesh, pyxel.Camera(2).SubSampleCopy(scale), dic=engine, U0=unknowns,
            Basis=reduced, direct=True, eps=step_px / rms_px, maxiter=MAX_ITERATIONS,
        )  # fmt: skip
    clock.iterations.append(engine.count)
    return np.asarray(found)
