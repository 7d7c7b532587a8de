"""Correlation of an image pair on a mesh: Gauss-Newton steps in the displacements of its nodes.

Minimises sum (f(x) - g(x + u))^2 + lambda (u - u_0)'R(u - u_0), stage by stage, from blurred images
and long cut-off wavelengths to the unfiltered images. In these the residual is weighed by the
reference's gradient, blurred as much as its noise requires.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modeharvest.idic.finite_element.equations.continued import (
    NONE_CONTINUED,
    ContinuedPixels,
    continued_pixels,
    continued_spline,
    images_on,
)
from modeharvest.idic.finite_element.equations.normal_equations import normal_equations
from modeharvest.idic.finite_element.equations.pixels import ElementPixels, flat
from modeharvest.idic.finite_element.equations.system import Body, Imbalance, Linearised, Smoothness
from modeharvest.idic.finite_element.fields import determinant, element_gradients
from modeharvest.idic.solver.final_smoothing import speckle_size, spline_order
from modeharvest.idic.solver.free_edges import FreeEdges
from modeharvest.idic.solver.noise import ImageNoise, NoiseTransfer, slope_noise
from modeharvest.idic.solver.pyramid import FULL, Level, LevelPair, smoothed
from modeharvest.idic.solver.sampling import well_sampled
from modeharvest.idic.solver.weighting import best_blur
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.elements import shape_functions
from modeharvest.util.errors import InputError
from modeharvest.util.masks import grown

BESIDE_PX = 4.0
"""Pixels so close to those that don't count don't either: splines mix them."""
_SHORT_PX, _SHORT_AT_A_NODE_PX = 0.1, 0.5
"""Matrices are kept after steps shorter than these, rms over nodes and longest of one node [px],
if only the images change them (no law) and steps decrease."""
_LONGEST_STEP_PX = 8.0
"""Largest change of a node's displacement in one step."""
_LEAST_DET = 0.1
"""Lower bound on det F [-]: an element that shrinks to less shows a diverged iteration."""
_AROUND_PX = 60.0
"""Shortest wave of the displacement of nodes that is taken from their neighbours."""


@dataclass(frozen=True)
class Stage:
    """One stage of the coarse-to-fine sequence."""

    level: Level
    """Binning and blur of the images."""
    cutoff_px: float
    """Wavelength whose amplitude the regularisation halves [px]."""
    tolerance_px: float = 0.1
    """The stage ends once the step's rms over nodes and a tenth of its longest are below [px]."""


COARSE = (Stage(Level(2, 3.0), 120.0, 0.2), Stage(Level(2, 1.5), 50.0, 0.2), Stage(FULL, 30.0))
"""Stages before the last, which uses unfiltered images and the cut-off that is searched for. Those
of blurred images with tolerance 0.4 left places in local minima ("lens" in docs/how-to/scoring.md).
"""
_COARSE_FROM_PX = 15.0
"""Speckle size from which on the wavelengths of these stages, and of starts, grow with it [px]."""


def coarseness(speckle_px: float) -> float:
    """Factor of wavelengths: shorter ones aren't determined by speckle of this size [px]."""
    return max(1.0, speckle_px / _COARSE_FROM_PX)


@dataclass(frozen=True, eq=False)
class _LevelOnMesh:
    """A pyramid level of an image pair on a mesh, with the gradient that weighs its residual."""

    level: Level
    images: LevelPair
    pixels: ElementPixels
    slope_noise: float = 0.0
    """Noise variance of the gradient that weighs the residual [grey levels^2/mm^2]."""
    continued: ContinuedPixels = NONE_CONTINUED


class MeshCorrelation:
    """The displacement of the nodes, which stages improve, and the images of a stage."""

    def __init__(
        self, pair: ImagePair, start: FloatArray, body: Body, edge_px: int = 0, steps: int = 4
    ) -> None:
        """Start from (n, 2) displacements of a body's nodes [mm].

        ``edge_px``: distance from the mask's edge of pixels that count [px]; ``steps``: largest
        number of steps in a stage.
        """
        pair = pair if body.mask is None else replace(pair, mask=pair.masks[0] & body.mask)
        pair = pair.without_extremes()
        self.speckle_px = speckle_size(pair.reference, pair.mask)
        factor = coarseness(self.speckle_px)
        self.coarse = tuple(replace(stage, cutoff_px=factor * stage.cutoff_px) for stage in COARSE)
        """Stages before the last."""
        given, pair = pair, well_sampled(pair, self.speckle_px)
        self.is_sharp = pair is not given
        """Whether the speckle has edges sharper than pixels: paint of few grey levels."""
        self.order = spline_order(self.speckle_px)
        self.blank: tuple[BoolArray, ...] = tuple(
            mask & (not self.is_sharp) & grown(flat(image, mask, self.speckle_px), BESIDE_PX)
            for image, mask in zip((pair.reference, pair.deformed), pair.masks, strict=True)
        )
        """(rows, cols) True for pixels of each image without speckle."""
        self.hidden = self.blank[0]
        """(rows, cols) True for pixels of the reference that don't count."""
        if self.blank[1].any() and (pair.deformed_mask is not None or pair.masks[0].all()):
            pair = replace(pair, deformed_mask=pair.masks[1] & ~self.blank[1])
        self.pair, self.body, self.start = pair, body, start
        self.edge_px, self.steps = edge_px, steps
        self.prior: Smoothness | Imbalance = Smoothness(body, start)
        self.u: FloatArray = start.ravel().copy()
        """(2 n,) displacements of the nodes [mm]."""
        self.edges: FreeEdges | None = None
        noise = ImageNoise.estimated(pair)
        self.noise = noise.reference**2, noise.deformed**2
        """Variances of the noise of f and g [grey levels^2]."""
        self.noise_power = 1.0
        """Power of the noise at long waves, over its variance."""
        self._level: _LevelOnMesh | None = None
        self._kept: Linearised | None = None

    def on(self, level: Level) -> _LevelOnMesh:
        """Make the images of a level those that are correlated."""
        if self._level is None or self._level.level != level:
            order = self.order if level == FULL else 5
            images = images_on(self.pair, level, self.edge_px, order)
            (rows, cols), n = images.mask.shape, level.factor
            hidden = self.hidden[: rows * n, : cols * n].reshape(rows, n, cols, n).any(axis=(1, 3))
            pixels = self.body.pixels.on(images.grid, images.mask & ~hidden, images.reference)
            self._level, self._kept = _LevelOnMesh(level, images, pixels), None
            if level == FULL:
                self._level = self._weighed_by_reference(self._level)
        return self._level

    def _weighed_by_reference(self, on: _LevelOnMesh) -> _LevelOnMesh:
        """Weigh the residual by the reference's gradient, blurred as much as its noise requires."""
        f, mask, px = self.pair.reference, self.pair.masks[0], self.pair.grid.pixel_size
        spline = continued_spline(f, mask, self.order)
        _, d_row, d_col = spline.sample(on.pixels.row, on.pixels.col)
        noise, noise_g = self.noise
        square = 0.5 * float(np.mean(d_row**2 + d_col**2)) - noise * slope_noise(self.order, 0.0)
        blur = best_blur(noise / max(square, 0.2 * square), self.speckle_px, self.order)
        if blur > 0.0:
            spline = SplineImage.of(smoothed(f, mask, blur), self.order)
            _, d_row, d_col = spline.sample(on.pixels.row, on.pixels.col)
        slope = np.stack([d_col, -d_row]).astype(np.float32) / np.float32(px)
        return replace(
            on, pixels=on.pixels._replace(slope=slope),
            slope_noise=noise * slope_noise(self.order, blur) / px**2,
            continued=continued_pixels(self.pair, noise, noise_g, on.images.valid),
        )  # fmt: skip

    def linearised(self, anew: bool = False) -> Linearised:
        """Normal equations at u; after short steps the matrices are those before, unless anew."""
        on, kept, body = self._level, None if anew else self._kept, self.body
        assert on is not None
        if kept and kept.u is self.u and kept.prior is self.prior and kept.edges is self.edges:
            return kept
        nodal, is_new = self.u.reshape(-1, 2), kept is None
        sums = normal_equations(on.pixels, body.mesh, on.images, nodal, on.continued, is_new)
        if sums.pixels == 0:
            raise InputError("expected pixels of the material in both images, got none in common")
        R, penalty = self.prior.linearised(self.u)
        if kept is None:
            F = self._deformation_gradient()
            pushed = (F**2).sum(axis=(1, 2)) / np.maximum(determinant(F), _LEAST_DET) ** 2
            signal, gain = sums.signal(on.slope_noise * pushed)
            blocks = (gain * signal[:, None, None, None]) ** 2 * sums.blocks
            M = body.matrix(blocks)
            rough = body.roughness if R is body.smoothness else body.energies(R)
            ratio = body.energies(M) / rough
        else:
            blocks, M, ratio = kept.sums.blocks, kept.M, kept.ratio
            signal, gain = kept.signal, kept.gain
        gradient = body.vector(gain * signal[:, None, None] * sums.gradient)
        sums = replace(sums, blocks=blocks)
        known = self.edges, kept.known[0] if kept and kept.edges is self.edges else None
        found = body, self.prior, self.u, sums, signal, gain, M, gradient, R, penalty, ratio
        self._kept = Linearised(*found, *known)
        return self._kept

    def through(self, stage: Stage) -> None:
        """Make Gauss-Newton steps until they are shorter than the stage's tolerance."""
        self.on(stage.level)
        px, last = self.pair.grid.pixel_size, np.inf
        for _ in range(self.steps):
            at = self.linearised()
            step = at.step(stage.cutoff_px * px)
            length = np.linalg.norm(step.reshape(-1, 2), axis=1) / px
            share = np.minimum(1.0, _LONGEST_STEP_PX / np.maximum(length, 1e-12))
            self.u = at.u + step * np.repeat(share, 2)
            rms, longest = float(np.sqrt(np.mean(length**2))), float(length.max())
            is_short = rms <= min(_SHORT_PX, 0.5 * last) and longest <= _SHORT_AT_A_NODE_PX
            if isinstance(self.prior, Imbalance) or not is_short:
                self._kept = None
            if max(last := rms, 0.1 * longest) < stage.tolerance_px:
                break

    def without(self, hidden: BoolArray) -> None:
        """Let other pixels (rows, cols) not count from now on."""
        self.hidden, self._level = hidden, None

    def from_around(self, nodal: FloatArray, known: BoolArray) -> FloatArray:
        """(n, 2) smooth displacement [mm] through that of the nodes (n,) where it is known."""
        return self.body.smoothed(nodal, _AROUND_PX * self.pair.grid.pixel_size, known)

    def restart(self, start: FloatArray, known: BoolArray) -> None:
        """Start from (n, 2) [mm], with u where it is known (n,), else that of its neighbours."""
        nodal = self.u.reshape(-1, 2)
        u = np.where(known[:, None], nodal, self.from_around(nodal, known))
        self.regularised_by(Smoothness(self.body, start), u.ravel())

    def regularised_by(self, prior: Smoothness | Imbalance, u: FloatArray | None = None) -> None:
        """Use another regularisation, from the present displacement or from (2 n,) u [mm]."""
        self.prior, self.u, self._kept = prior, self.u if u is None else u, None

    def moved(self, some: ElementPixels) -> tuple[FloatArray, FloatArray]:
        """Rows and columns (p,) to which u takes some of the unfiltered pixels [px]."""
        nodal, count = self.u.reshape(-1, 2) / self.pair.grid.pixel_size, np.diff(some.start)
        row, col = some.row.astype(np.float64), some.col.astype(np.float64)
        each = zip(shape_functions("T6", some.xi.T).T, self.body.mesh.cells.T, strict=True)
        for N, nodes in each:  # one node of all elements after the other, to save memory
            row -= N * np.repeat(nodal[nodes, 1], count)
            col += N * np.repeat(nodal[nodes, 0], count)
        return row, col

    def residual(self, some: ElementPixels) -> FloatArray:
        """(rows, cols) f - g(x + u) of some of the unfiltered pixels, else NaN [grey levels]."""
        g, _, _ = self.on(FULL).images.deformed.sample(*self.moved(some))
        residual = np.full(self.pair.grid.shape, np.nan)
        residual[some.row, some.col] = some.grey - g
        return residual

    def noise_in(self, at: Linearised) -> FloatArray:
        """(m,) noise variance of each element's gradient over that of the residual [-].

        Noise of f is independent of its slopes' noise: only their signal counts; g's is over det F.
        """
        u, det = self.u.reshape(-1, 2)[self.body.mesh.cells], self._deformation_gradient()
        det = np.maximum(determinant(det), _LEAST_DET)
        value = NoiseTransfer.at(u.mean(axis=1) / self.pair.grid.pixel_size, det, self.order).value
        f, g = self.noise if any(self.noise) else (1.0, 1.0)
        return np.asarray(self.noise_power * (f * at.signal + g / det) / (f + g * value))

    def _deformation_gradient(self) -> FloatArray:
        """(m, 2, 2) F of each element [-]."""
        gradients = element_gradients(self.body.mesh, self.u.reshape(-1, 2))
        return np.asarray(np.eye(2) + gradients.mean(axis=1))
