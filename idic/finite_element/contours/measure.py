"""Measurement of the displacement that contours alone determine, with standard deviations.

A surface without speckle shows where its material ends, but nothing inside or along an edge.
Mechanics supplies what is missing there. With the right law, free edges have no traction and the
springs carry nothing; a wrong law therefore has little effect, which is estimated by how much laws
of other compressibility change u. Contours don't show sliding; what it would change counts in the
standard deviation. At cuts, tractions of other distributions matter nearby only (Saint-Venant), and
count in the standard deviation as if they were as large as the stress in the body.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.sparse import diags_array

from modeharvest.fem.materials import Material, Ogden
from modeharvest.idic.finite_element.contours.penalised_body import (
    ROUGH_PX,
    PenalisedBody,
    straight_sides,
)
from modeharvest.idic.finite_element.cutoff import Deviations, gradient_covariance
from modeharvest.idic.finite_element.equations.system import SAMPLES, SOME, Body
from modeharvest.idic.finite_element.fields import interpolation_error
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.contour import SeenContours
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.progress import Progress, silent

ELASTOMER = Ogden(moduli=(2.0,), exponents=(2.0,), kappa=9.0)
"""Neo-Hookean law, Poisson's ratio 0.45, which is assumed where a body's law isn't known."""
_SOFTER, _STIFFER = 7.0 / 3.0, 49.0
"""Volumetric constants, over the shear modulus, for Poisson's ratios 0.35 and 0.49."""
_SPRINGS = (0.5, 5.0)
"""Stiffnesses of the springs, used one after the other [shear modulus/px]."""
_TOLERANCE_PX, _PROBES, _TINY = 0.01, 4, 1e-200
UNSETTLED = (
    "The displacement from contours didn't converge: don't use it; give pictures in between, or of "
    "more pixels across notches and slits."
)
_UNEXPLAINED_PX = 0.05
"""Rms distance from contours, beyond their noise, that shows that pictures are thresholded."""
_STEP_PX, STEPS_PX3 = 1.0 / np.sqrt(6.0), 0.6765**2 / np.pi
"""Of two thresholded pictures: standard deviation of a straight edge's position, rectangular in
each, and variance of a hole's edge times its length [px^3], as the hole's area is known to 0.6765
sqrt(radius) in each: M. G. Kendall, Q. J. Math. 19 (1948) 1."""
_STEPPED = (
    "Contours are met within {:.2f} px, of which noise explains {:.2f} px: thresholded pictures, "
    "or a body far from the assumed law. Standard deviations are those of thresholded pictures."
)
_TRIANGULAR, _RECTANGULAR = 6.0, 3.0
"""Half-width squared over variance of a triangular distribution (most likely in the middle), and of
a rectangular one (equally likely everywhere); JCGM 100, 4.3.7 and 4.3.9."""


def displacement_from_contours(
    seen: SeenContours, body: Body, grid: PixelGrid, start: FloatArray, law: Material | None = None,
    *, slides: bool = False, progress: Progress = silent,
) -> NodalResult:  # fmt: skip
    """Find the displacement of a body from the contours of its edges.

    InputError if no contour is at the mesh's edge, or the contours don't hold the body.

    seen : contours in the reference and in the deformed image [mm].
    body : T6 mesh of the material in the reference.
    grid : pixels of the images.
    start : (n, 2) initial displacement [mm], with which each contour is nearer than half a hole to
        its counterpart in the deformed image; an affine motion will do.
    law : material law of the body, in plane strain; by default :data:`ELASTOMER`. Scale-free.
    slides : whether edges slide on plates, which contours don't show; by default they don't.
    progress : progress listener.
    """
    state = PenalisedBody(body, seen, grid, law or ELASTOMER, start)
    soft, stiff = _SPRINGS
    step = partial(progress, total=3, what="displacement from contours")
    try:
        step(0)
        state.settle(soft, ROUGH_PX)
        sides = state.pressed_sides()
        state.press(sides, slides=slides)
        step(1)
        state.settle(soft, 10.0 * _TOLERANCE_PX)
        before = state.u
        step(2)
        state.take_up(stiff / soft)
        converged = state.settle(stiff, _TOLERANCE_PX)
        step(3)
        u, mesh = state.u.reshape(-1, 2), body.mesh
        left = np.asarray(state.u - before).reshape(-1, 2) * (soft / (stiff - soft))
        d, _ = state.distances()
        rms = float(np.sqrt(np.average(d**2, weights=state.edge.length))) / state.px
        by_noise = float(np.sqrt(seen.noise / seen.correlated)) / state.px
        if is_stepped := rms**2 > by_noise**2 + _UNEXPLAINED_PX**2:
            state.noise = max(seen.noise, STEPS_PX3 * state.px**3)
        sd, known = _deviations(state, law is None, bool(sides) and not slides, is_stepped, left)
    except ArithmeticError as error:
        raise InputError(
            f"expected contours that hold the body, got others: {UNSETTLED}"
        ) from error
    stepped = (_STEPPED.format(rms, by_noise),) if is_stepped else ()
    return NodalResult(
        mesh=mesh,
        displacement=u,
        start=start,
        standard_deviation=np.hypot(sd.by_noise, sd.bias),
        noise_deviation=sd.by_noise,
        gradient_covariance=sd.gradient,
        roots=sd.roots,
        grid=grid,
        cutoff_px=None,
        tried=(),
        residual_rms=rms,
        residual_noise=by_noise,
        pixels=int(state.edge.length.sum() / grid.pixel_size),
        outside=int((state.edge.length == 0.0).sum()),
        effective_unknowns=known,
        library="" if state.last_factor is None else state.last_factor.library,
        light=0,  # contours are edges in each image by itself
        shown="contours",
        warnings=stepped if converged else (UNSETTLED, *stepped),
    )


def _deviations(
    state: PenalisedBody, law_is_assumed: bool, may_slide: bool, is_stepped: bool, left: FloatArray
) -> tuple[Deviations, float]:
    """Standard deviations due to noise, law, plates and springs; effective number of unknowns."""
    mesh, edge, rng = state.mesh, state.edge, np.random.default_rng(0)
    A, springs, _ = state.linearised()
    _, normal = state.distances()
    pulls = edge.normal_shapes(normal).T @ diags_array(state.stiffness * edge.length)
    drawn = rng.standard_normal((len(normal), SAMPLES))
    off = np.sqrt(state.noise / np.maximum(edge.length, _TINY))[:, None] * drawn
    for side in straight_sides(mesh) if is_stepped else ():
        steps = _STEP_PX * state.px * rng.choice([-1.0, 1.0], SAMPLES)
        off[: len(edge.points)] += np.outer(edge.on(side), steps)
    z, factor = rng.choice([-1.0, 1.0], (state.u.size, _PROBES)), state.factor(A)
    known = float(np.sum(z * factor.solve(springs @ z))) / _PROBES
    found = state.with_tractions(factor.solve(pulls @ off), factor, off)
    samples = found.reshape(-1, 2, SAMPLES)
    error, none = interpolation_error(mesh, state.u.reshape(-1, 2)), samples[..., :0]
    sd = Deviations(samples, none, none, error, gradient_covariance(mesh, samples))
    sd = sd.with_bias(mesh, left)
    changes = []
    if state.tractions.size:
        others = state.by_other_tractions(factor, SOME)
        changes = list(np.moveaxis(others, 2, 0) / np.sqrt(SOME))
    if law_is_assumed:
        laws = (Ogden(ELASTOMER.moduli, ELASTOMER.exponents, k) for k in (_SOFTER, _STIFFER))
        changes += [state.change_by(other) / np.sqrt(2.0 * _TRIANGULAR) for other in laws]
    if may_slide:
        changes.append(state.change_by(slides=True) / np.sqrt(_RECTANGULAR))
    for change in changes:
        sd = sd.with_bias(mesh, change)
    return sd, known
