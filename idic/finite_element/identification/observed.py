"""Observations of a state, images or displacements, compared with a model's nodal displacements.

A pixel x in an element has J = grad g(x + u) . sum N_a S_a, with the sensitivities S = du/dp of the
nodes to a model's parameters. So the normal equations of the parameters are the projected ones of
the nodes. Where parameters move nodes by X', a pixel sees only S = u' - grad u . X' of u' at nodes:
a point of the material stays where the reference shows it. Pixels are sorted anew on every level.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from modeharvest.fem.field import Mesh
from modeharvest.idic.finite_element.equations.continued import continued_spline, images_on
from modeharvest.idic.finite_element.equations.normal_equations import (
    NodalEquations,
    normal_equations,
)
from modeharvest.idic.finite_element.equations.pixels import MeshPixels
from modeharvest.idic.finite_element.fields import determinant, element_gradients, nodal_gradient
from modeharvest.idic.finite_element.result import located, nodal_values
from modeharvest.idic.solver.final_smoothing import speckle_size, spline_order
from modeharvest.idic.solver.noise import ImageNoise, NoiseTransfer, estimated_noise, slope_noise
from modeharvest.idic.solver.pyramid import FULL, Level, eroded
from modeharvest.imaging.distortion.lens import Distortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.elements import shape_functions
from modeharvest.util.errors import InputError

if TYPE_CHECKING:  # dolfinx makes the model; nothing here needs it
    from modeharvest.fem.path.parametric import ParametricState as ModelState

_EDGE_PX = 2
"""Pixels left out at edges: 1 px would give more information, but errors of g's continuation."""
_LEAST_DET = 0.1
_MOST_NOISE = 0.9  # of the mean square slope
_TINY = float(np.finfo(np.float64).tiny)
_CHUNK = 1024  # elements
_ALONG = 8
"""Parts of the body along its length whose residuals are taken to be independent."""


@dataclass(frozen=True, eq=False)
class StateEquations:
    """Contribution of a state to the normal equations of the k unknowns, by the data's weights."""

    blocks: FloatArray
    """(b, k): -J'r of parts of the data that are far from each other."""
    matrix: FloatArray
    squares: float
    count: int
    residual: float
    """Rms residual of what is compared: grey levels, or mm per component."""
    expected: float
    """The rms residual due to noise alone."""
    shared: float = 0.0
    """Factor of the noise of a reference that states share: their gradients have the covariance of
    two such factors times the product that :meth:`ImageData.shared` gives."""


Light = Callable[[ImagePair, Mesh, FloatArray], ImagePair]
"""From a pair, a mesh and displacements (n, 2) [mm] to a pair of equal brightness and contrast."""


class StateObservation(Protocol):
    """Data of one state apart from force and strain; by default, nothing is shared."""

    def prepare(self, level: Level, state: ModelState) -> None:
        """Prepare the data of a level, weighted as the model's state requires."""
        return

    def weigh_by_reference(self) -> None:
        """Weigh the residual by slopes whose noise is independent of the residual's."""
        return

    def equations(self, state: ModelState) -> StateEquations:
        """The contribution to the normal equations at the model's state."""

    def shared(self, state: ModelState, other: ModelState) -> FloatArray:
        """(k, k) products of the slopes of this state and of another one in the same reference."""
        return np.zeros((len(state.displacement_by),) * 2)


class ImageData:
    """A pair of images of a state, compared on the pixels that the model's mesh covers.

    pixels : pixels of the model's initial mesh.
    noise : noise of the two; by default estimated from the reference there, equal in both.
    light : makes g(x + u) as bright as f, before each level; None for images of one brightness.
    lens : lens that both were taken through. Points are mapped to where it shows them: in resampled
        images, noise and slopes would be correlated.
    """

    def __init__(
        self, pair: ImagePair, pixels: MeshPixels, noise: ImageNoise | None = None,
        light: Light | None = None, lens: Distortion | None = None,
    ) -> None:  # fmt: skip
        self._given, self._lens = pair, lens
        if lens is not None:
            shown, _ = through_lens(pixels.mesh.nodes, lens, pair.grid)
            pixels = MeshPixels(replace(pixels.mesh, nodes=shown))
        self._sort(pixels)
        estimate = estimated_noise(pair.reference, self.pair.masks[0]).sd
        self.noise, self._light = noise or ImageNoise.of(estimate), light
        self.order = spline_order(speckle_size(pair.reference, self.pair.mask))
        self.block = _blocks(pixels.mesh)

    def _sort(self, pixels: MeshPixels) -> None:
        """Take the pixels that a mesh covers."""
        self.pixels = pixels
        covered = _covered(pixels.mesh, self._given.grid, _EDGE_PX)
        self.pair = replace(self._given, mask=covered & self._given.masks[0])

    def prepare(self, level: Level, state: ModelState) -> None:
        """Prepare images of a level; coarse ones are weighted by the residual, not by noise."""
        state = self._shown(state)
        if not np.array_equal(state.mesh.nodes, self.pixels.mesh.nodes):
            self._sort(MeshPixels(state.mesh))
        order, mesh, pair = self.order if level == FULL else 5, self.pixels.mesh, self.pair
        light = 1.0  # gain of the deformed image
        if self._light is not None:
            pair = self._light(pair, mesh, state.displacement)
            light = float(np.std(pair.deformed) / np.std(self.pair.deformed))
        if level == FULL:  # beyond the material that the model predicts there, g is continued
            moved = replace(mesh, nodes=mesh.nodes + state.displacement)
            shown = eroded(_covered(moved, pair.grid, 1), 1)
            pair = replace(pair, deformed_mask=pair.masks[1] & shown)
        self._images = images_on(pair, level, _EDGE_PX, order)
        if level == FULL:  # no pixel comes or goes on the way: the cost would jump
            self._images = replace(self._images, valid=None)
        images = self._images
        self._own = self.pixels.on(images.grid, images.mask, images.reference)
        if level == FULL:  # nor any that shows near or beyond the deformed image's border
            at, limit = self._in_deformed(state), np.array(images.grid.shape)[:, None] - 1
            is_inside = (at >= _EDGE_PX) & (at <= limit - _EDGE_PX)
            self._own = self._own.only(np.all(is_inside, axis=0))
        self._weight, self._gain, self._shared = 1.0, 1.0, 0.0
        if level == FULL:
            self._by_noise(pair, state, light)
        nodal = self._nodal(state)
        if nodal.pixels == 0:
            raise InputError("expected pixels of the model's mesh in both images, got none")
        if level != FULL:
            # Blurred pixels are correlated: as many count as there are independent ones.
            self._expected = nodal.rms
            self._weight = 1.0 / (nodal.rms**2 * max(1.0, 4.0 * np.pi * level.blur**2))

    def _by_noise(self, pair: ImagePair, state: ModelState, light: float) -> None:
        """Compute slopes of the reference, and weights by the noise of both images."""
        px, u, own = pair.grid.pixel_size, displacement_at(state, self.pixels.mesh.nodes), self._own
        spline = continued_spline(pair.reference, pair.masks[0], self.order)
        _, d_row, d_col = spline.sample(own.row, own.col)
        self._slope = np.stack([d_col, -d_row]).astype(np.float32) / np.float32(px)
        F = self._deformation(state)
        det = np.maximum(determinant(F), _LEAST_DET)
        transfer = NoiseTransfer.at(u[self.pixels.mesh.cells].mean(axis=1) / px, det, self.order)
        f, g = self.noise.reference**2, (light * self.noise.deformed) ** 2
        slopes = float(np.mean(d_row**2 + d_col**2))
        share = min(2.0 * f * slope_noise(self.order, 0.0) / max(slopes, _TINY), _MOST_NOISE)
        self._expected = float(np.sqrt(f + g * transfer.value))
        # The slopes' noise meets g's alone: its product with f's averages out in smooth fields.
        self._gain = 1.0 - share
        noise = self._gain * f + g * (transfer.density * self._gain + transfer.value * share)
        self._weight = self._gain / noise
        self._shared = self._gain * np.sqrt(self._gain * f) / noise

    def weigh_by_reference(self) -> None:
        """Let the reference's slopes, pushed forward, weigh the residual in place of g's.

        Between pixels the noise of g has less variance; so the mean of its product with its slope
        is not 0 but half the slope of the variance, which biases the best fit.
        """
        self._own = self._own._replace(slope=self._slope)

    def _shown(self, state: ModelState) -> ModelState:
        """Map a state to what the lens shows of it."""
        if self._lens is None:
            return state
        X, grid = state.mesh.nodes, self._given.grid
        nodes, _ = through_lens(X, self._lens, grid)
        x, slopes = through_lens(X + state.displacement, self._lens, grid)
        return replace(
            state, mesh=replace(state.mesh, nodes=nodes), displacement=x - nodes,
            displacement_by=np.einsum("nij,knj->kni", slopes, state.displacement_by),
        )  # fmt: skip

    def _deformation(self, state: ModelState) -> FloatArray:
        """(m, 2, 2) mean deformation gradient of the elements of the pixels' mesh."""
        mesh = self.pixels.mesh
        u = displacement_at(state, mesh.nodes)
        return np.asarray(np.eye(2) + element_gradients(mesh, u).mean(axis=1))

    def _nodal(self, state: ModelState) -> NodalEquations:
        mesh = self.pixels.mesh
        return normal_equations(self._own, mesh, self._images, displacement_at(state, mesh.nodes))

    def equations(self, state: ModelState) -> StateEquations:
        """Project the normal equations of the nodes' displacements on the unknowns."""
        state = self._shown(state)
        nodal, cells, by = self._nodal(state), self.pixels.mesh.cells, state.displacement_by
        blocks = np.zeros((self.block.max() + 1, len(by)))
        for some, S in _chunks(by, cells):
            np.add.at(
                blocks, self.block[some], -(nodal.gradient[some].reshape(-1, 1, 12) @ S)[:, 0]
            )
        matrix, w = self._gain * _products(by, cells, _square(nodal)), self._weight
        return StateEquations(
            w * blocks, w * 0.5 * (matrix + matrix.T), w * nodal.square_sum, nodal.pixels,
            nodal.rms, self._expected, self._shared,
        )  # fmt: skip

    def shared(self, state: ModelState, other: ModelState) -> FloatArray:
        """(k, k) sums of products of the slopes along a state's fields and along another's."""
        state, other = self._shown(state), self._shown(other)
        pulled = self._deformation(state) @ np.linalg.inv(self._deformation(other))  # slopes: F^-T
        squares = np.einsum("mijab,mjl->milab", _square(self._nodal(state)), pulled)
        return _products(state.displacement_by, self.pixels.mesh.cells, squares)

    def residual(self, state: ModelState) -> FloatArray:
        """(rows, cols) f - g(x + u) [grey levels] of the pixels compared; NaN elsewhere."""
        state = self._shown(state)
        own, found = self._own, np.full(self._images.grid.shape, np.nan)
        g, *_ = self._images.deformed.sample(*self._in_deformed(state))
        found[own.row, own.col] = own.grey - g
        return found

    def _in_deformed(self, state: ModelState) -> FloatArray:
        """(2, p) row and column of the compared pixels in the deformed image [px]."""
        own, mesh, px = self._own, self.pixels.mesh, self._images.grid.pixel_size
        element = np.repeat(np.arange(len(mesh.cells)), np.diff(own.start))
        N = shape_functions("T6", own.xi.T.astype(np.float64))
        u = np.einsum("pa,pai->pi", N, displacement_at(state, mesh.nodes)[mesh.cells[element]])
        return np.stack([own.row - u[:, 1] / px, own.col + u[:, 0] / px])


class FieldData(StateObservation):
    """Displacements of a state at points, measured by any code.

    points, u : (p, 2) in the reference's frame [mm]; points outside the mesh are left out.
    sd : standard deviation of each component [mm], one for all or (p, 2).
    """

    def __init__(
        self, points: FloatArray, u: FloatArray, sd: FloatArray | float, mesh: Mesh
    ) -> None:
        element, _ = located(mesh, points)
        inside = (element >= 0) & np.isfinite(u).all(axis=1)
        if not inside.any():
            raise InputError("expected displacements at points of the specimen, got none there")
        self._points = np.asarray(points, np.float64)[inside]
        self._u = np.asarray(u, np.float64)[inside]
        self._w = 1.0 / np.broadcast_to(np.asarray(sd, np.float64), u.shape)[inside] ** 2
        self._block = _blocks(mesh)[element[inside]]
        self._sort(mesh)

    def _sort(self, mesh: Mesh) -> None:
        element, xi = located(mesh, self._points, beside=True)
        self._mesh, self._nodes = mesh, mesh.cells[element]
        self._N = shape_functions(mesh.element, xi)

    def equations(self, state: ModelState) -> StateEquations:
        """Equations from the differences of displacements at the points."""
        if not np.array_equal(state.mesh.nodes, self._mesh.nodes):
            self._sort(state.mesh)
        left = self._u - np.einsum("pa,pai->pi", self._N, state.displacement[self._nodes])
        J = np.einsum("pa,kpai->kpi", self._N, state.displacement_by[:, self._nodes])
        blocks = np.zeros((self._block.max() + 1, len(J)))
        np.add.at(blocks, self._block, -np.einsum("kpi,pi->pk", J, self._w * left))
        matrix = np.einsum("jpi,kpi->jk", J, self._w * J)
        expected = float(np.sqrt(np.mean(1.0 / self._w)))
        return StateEquations(
            blocks, matrix, float(np.sum(self._w * left**2)), left.size,
            float(np.sqrt(np.mean(left**2))), expected,
        )  # fmt: skip


PLACE = ("centre_x", "centre_y", "orientation")
"""Unknowns of the specimen's position in the reference: its centre [mm], and its rotation about it
[rad]."""
MOTION = ("shift_x", "shift_y", "turn")
"""Unknowns of the camera's frame in each state: shift [mm], rotation about the origin [rad]."""


def imaged(
    state: ModelState, place: FloatArray | None, motions: FloatArray, number: int
) -> ModelState:
    """Map a state to what a camera sees: at its place in the reference, by a camera that moved.

    place : (3,) in the order of PLACE; None for a specimen in the middle.
    motions : (count, 3) of all states in the order of MOTION; (0, 3) for a camera at rest.
    number : index of this state. Derivatives by place and motions follow the model's own, and are
        zero for motions of other states.
    """
    mesh, X_by = state.mesh, state.nodes_by
    x, x_by = mesh.nodes + state.displacement, X_by + state.displacement_by
    if place is not None:
        (X, X_by), (x, x_by) = rigidly_moved(mesh.nodes, X_by, place), rigidly_moved(x, x_by, place)
        mesh = replace(mesh, nodes=X)
    none = np.zeros((motions.size, *x.shape))
    if len(motions):
        x, x_by = rigidly_moved(x, x_by, motions[number])
        own, first = len(X_by), 3 * number
        x_by = np.concatenate([x_by[:own], none[:first], x_by[own:], none[first + 3 :]])
        X_by = np.concatenate([X_by, none])
    rest = np.zeros(len(X_by) - len(state.force_by))
    return replace(
        state, mesh=mesh, displacement=x - mesh.nodes, displacement_by=x_by - X_by,
        nodes_by=X_by, force_by=np.append(state.force_by, rest),
        strain_by=np.append(state.strain_by, rest),
    )  # fmt: skip


def rigidly_moved(
    points: FloatArray, by: FloatArray, motion: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rotate points (n, 2) about the origin, then shift them; and their derivatives (k + 3, n, 2).

    by : (k, n, 2) derivatives of points by parameters, followed in the result by those by motion.
    motion : (3,) shift along x and y [mm] and turn [rad].
    """
    c, s = np.cos(motion[2]), np.sin(motion[2])
    R, slope = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
    shifts = np.broadcast_to(np.eye(2)[:, None], (2, *points.shape))
    return points @ R.T + motion[:2], np.concatenate([by @ R.T, shifts, [points @ slope.T]])


def _covered(mesh: Mesh, grid: PixelGrid, edge_px: int) -> BoolArray:
    """(rows, cols) pixels on a mesh, away from its edges that lie beyond the image's border."""
    w, px = edge_px, grid.pixel_size
    wider = PixelGrid(grid.rows + 2 * w, grid.cols + 2 * w, px, grid.x0 - w * px, grid.y0 + w * px)
    found = locate(mesh.nodes, mesh.cells, mesh.element, wider, "mesh of the model").mask
    kept, inner = eroded(found, w), (slice(w, -w), slice(w, -w))
    kept[2 * w : -2 * w, 2 * w : -2 * w] = True
    return (found & kept)[inner]


def through_lens(
    points: FloatArray, lens: Distortion, grid: PixelGrid
) -> tuple[FloatArray, FloatArray]:
    """Where a lens shows points (n, 2) [mm], and the derivatives of this mapping (n, 2, 2)."""
    at = grid.to_px(*points.T)
    (rr, rc), (cr, cc) = lens.gradient(*at)
    shown = np.column_stack(grid.to_mm(*lens.observed(*at)))
    return shown, np.moveaxis(np.array([[1.0 + cc, -cr], [-rc, 1.0 + rr]]), 2, 0)


def displacement_at(state: ModelState, nodes: FloatArray) -> FloatArray:
    """(n, 2) a state's displacement at the nodes of another mesh, continued into holes."""
    if np.array_equal(state.mesh.nodes, nodes):
        return state.displacement
    return nodal_values(state.mesh, state.displacement, nodes, beside=True)


def at_fixed_points(state: ModelState) -> ModelState:
    """A state with the derivatives of u at the points of the material where nodes are now."""
    if not state.nodes_by.any():
        return state
    slopes = nodal_gradient(state.mesh, state.displacement)
    by = state.displacement_by - np.einsum("nij,knj->kni", slopes, state.nodes_by)
    return replace(state, displacement_by=by, nodes_by=state.nodes_by[:0])


def _square(nodal: NodalEquations) -> FloatArray:
    """(m, 2, 2, 6, 6) products of slopes along x and y."""
    xx, xy, yy = np.moveaxis(nodal.blocks, 1, 0)
    return np.moveaxis(np.array([[xx, xy], [xy, yy]]), 2, 0)


def _chunks(by: FloatArray, cells: IntArray) -> Iterator[tuple[slice, FloatArray]]:
    """Some elements at a time, with fields (k, n, 2) at their nodes (m, 12, k): to save memory."""
    for first in range(0, len(cells), _CHUNK):
        some = slice(first, first + _CHUNK)
        yield some, np.moveaxis(by[:, cells[some]], 0, -1).reshape(-1, 12, len(by))


def _products(by: FloatArray, cells: IntArray, blocks: FloatArray) -> FloatArray:
    """(k, k) sums over elements of fields (k, n, 2) times blocks times fields."""
    matrix = np.zeros((len(by), len(by)))
    for some, S in _chunks(by, cells):
        B = np.einsum("mijab->maibj", blocks[some]).reshape(-1, 12, 12)
        matrix += S.reshape(-1, len(by)).T @ (B @ S).reshape(-1, len(by))
    return matrix


def _blocks(mesh: Mesh) -> IntArray:
    """(m,) number of the part of the body in which each element lies."""
    middle = mesh.nodes[mesh.cells].mean(axis=1) - mesh.nodes.min(axis=0)
    size = np.ptp(mesh.nodes[:, 0]) / _ALONG
    place = np.floor(middle / size).astype(np.int64)
    part = place[:, 0] * (1 + place[:, 1].max()) + place[:, 1]
    return np.asarray(np.unique(part, return_inverse=True)[1], np.int64)
