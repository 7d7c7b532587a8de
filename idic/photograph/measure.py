"""Measurement of one photograph: its noise, initial guess, correlation, residual test.

With it a sequence can be correlated image by image: g_k against g_(k-1) at x + u_(k-1), which takes
the reference's place. The unknowns remain those of the total displacement, so that there is nothing
to add up, and the ansatz and its taper stay in place. However, what is lost in one image is lost in
the next ones, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz, for_cells
from modeharvest.idic.chebyshev import Brightness
from modeharvest.idic.correlate import ASTRAY, correlate, refitted_result
from modeharvest.idic.finite_element.equations.system import Body
from modeharvest.idic.finite_element.light import LOCAL
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.result import WholeField, refitted, refitted_correlation
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.local.motion import first_motion
from modeharvest.idic.photograph.displacement import block_motion, displacement_from, misfit_of
from modeharvest.idic.photograph.geometry import Geometry
from modeharvest.idic.photograph.initial_guess import (
    InitialGuess,
    chosen_modes,
    initial_guess,
    shows_more,
)
from modeharvest.idic.photograph.matching.blocks import (
    expected_by,
    match_blocks,
    require_same_surface,
)
from modeharvest.idic.photograph.matching.holes import matched_holes
from modeharvest.idic.result import Result
from modeharvest.idic.setup import PhotographOptions
from modeharvest.idic.solver.final_smoothing import speckle_size
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.idic.solver.noise import GIVEN, CameraNoise, ImageNoise, spline_autocorrelation
from modeharvest.idic.solver.pyramid import eroded
from modeharvest.idic.solver.residual_test import ResidualTest, autocorrelation, lags_for
from modeharvest.idic.uncertainty.identifiability import identifiability
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.util.arrays import FloatArray
from modeharvest.util.progress import Progress, silent

POINTS_A_CELL = 24
"""Points per cell at which the whole displacement is sampled for spectra."""
_REFITTED = (
    "From the best start there is the correlation ended in a local minimum: the result is the "
    "ansatz refitted to the whole displacement, with the standard deviations by noise that a "
    "correlation would have."
)
_LOCAL_LIGHT = (
    "The light changed along the material otherwise than by polynomials, which a correlation takes "
    "for displacement: the result is the ansatz refitted to the whole displacement, for which gain "
    "and offset were taken from around each pixel; light the specimen evenly."
)
_LOWER = "There are few cells: v0 is of degree {} and v1 of degree {}."


def image_noise(pair: ImagePair, camera: CameraNoise) -> ImageNoise:
    """Noise of the reference and of a deformed photograph [grey levels].

    Unless it was given for both, the deformed image's noise is scaled by the ratio of the noise
    estimates of both images, which shows an aged lamp or another exposure.
    """
    sd = camera.sd
    if camera.source == GIVEN:
        return ImageNoise(sd, sd)
    seen = ImageNoise.estimated(pair)
    return ImageNoise(sd, sd * seen.deformed / seen.reference if seen.reference > 0.0 else sd)


def residual_test(result: Result, pair: ImagePair, noise: ImageNoise, edge_px: int) -> ResidualTest:
    """Test the residual of the unfiltered photographs against their noise.

    Pixels closer than ``edge_px`` to a hole are left out.
    """
    if result.final_smoothing is None or result.final_smoothing.blur_px == 0.0:
        return result.residual_test(noise)
    back, inside = warped_back(pair.deformed, result, result.order)
    used = eroded(pair.masks[0], edge_px) & inside
    f, g = pair.reference[used], back[used]
    gain = np.cov(f, g)[0, 1] / g.var(dtype=np.float64)
    offset = f.mean(dtype=np.float64) - gain * g.mean(dtype=np.float64)
    residual = np.where(used, pair.reference - np.float32(gain) * back - np.float32(offset), np.nan)
    rms = float(np.sqrt(np.nanmean(np.square(residual, dtype=np.float64))))
    lags = lags_for(speckle_size(pair.reference, used))
    by_spline = spline_autocorrelation(
        result.ansatz, result.unknowns, pair.grid, used, result.order, lags
    )
    return ResidualTest.of(
        rms, autocorrelation(residual, lags, by_spline), int(used.sum()), result.ansatz.size,
        result.residual_noise(noise), lags,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class MeasuredPhotograph:
    """The results of one photograph."""

    result: Result
    local: LocalField
    """The displacement field whose spectra chose the modes, a local DIC's if there is one."""
    text: tuple[str, ...]
    whole: WholeField | None = None
    """The whole displacement, if it was measured: then ``local`` is taken from it."""
    warnings: tuple[str, ...] = ()


def measure(
    pair: ImagePair, geometry: Geometry, cell_size: float, how: PhotographOptions,
    local: LocalField | None = None, before: MeasuredPhotograph | None = None,
    progress: Progress = silent,
) -> MeasuredPhotograph:  # fmt: skip
    """Find ansatz and initial guess, and correlate.

    InputError if the two images don't show the same surface, or the spectrum contradicts the cell
    size.

    cell_size : l [mm].
    how : The ansatz and how to correlate.
    local : A local DIC's field.
    before : Results of the previous photograph. If they contain all waves that are observed now,
        their ansatz is kept and their unknowns are the initial guess; if that doesn't converge, a
        new one is found.
    """
    motion, matching = matched_holes(pair, geometry.lattice)
    holes = None if motion is None else motion.in_mm(geometry.grid)
    if motion is None and before is not None:
        holes = _moved_holes(before.result, geometry)
        known = partial(before.result.ansatz.displacement_at, before.result.unknowns)
        blocks = match_blocks(pair, expected_by(known, pair.grid))
        require_same_surface(blocks)
        matching += f" v0 starts from the photograph before. {blocks.text}"
    guess, ansatz, unknowns, text = found_modes(pair, geometry, cell_size, how, local, holes)
    text = (matching, *text)
    options, found = how.options(), None
    if before is not None and _goes_on(before.result, ansatz, unknowns):
        again, there = with_brightness(before.result, how)
        found = correlate(pair, again, guess=there, options=options, progress=progress)
    if found is not None and found.outcome is Outcome.CONVERGED:
        text = (*text, "The correlation started from the result of the photograph before.")
    else:
        found = correlate(pair, ansatz, guess=unknowns, options=options, progress=progress)
    assert found.final_smoothing is not None  # as asked for by how.options()
    return MeasuredPhotograph(found, guess.local, (*text, found.final_smoothing.text))


def measure_whole(
    pair: ImagePair, geometry: Geometry, cell_size: float, how: PhotographOptions,
    first: MeasuredPhotograph, body: Body, on_mesh: FiniteElementOptions, camera: CameraNoise,
    progress: Progress = silent,
) -> MeasuredPhotograph:  # fmt: skip
    """Measure the whole displacement of a photograph that was correlated, and the modes in it.

    The measurement starts from the correlation, or from blocks of the speckle if that failed. The
    ansatz fitted to the measurement is the result if the light changed otherwise than by
    polynomials; else it starts another correlation if the spectra show other waves than the first
    one has, or a family with fewer parameters for them, or if that one isn't converged; if the
    second fails, too, the fit itself is the result. For the rest see :func:`measure`.
    """
    mesh, found, mask = body.mesh, first.result, geometry.mask
    if found.outcome not in ASTRAY:
        start, known, a = "the result of its correlation", found.ansatz, found.unknowns
        gain, offset = known.gain_and_offset(a, pair.grid.x, pair.grid.y)
        normalised = replace(pair, reference=((pair.reference - offset) / gain).astype(np.float32))
        begin = known.displacement_at(a, mesh.nodes)
    else:
        start, normalised = "blocks of the speckle", pair
        slow, _ = first_motion(geometry.region.domain, pair, first.local)
        begin = block_motion(pair, body, slow(mesh.nodes))
    light = Brightness.of(how.brightness).degree or 0
    measured = displacement_from(begin, normalised, body, on_mesh, progress, light)
    noise = image_noise(pair, camera)
    expected = float(np.hypot(noise.reference, noise.deformed))
    misfit = misfit_of(measured, expected, pair.reference[pair.masks[0]])
    warnings = (*first.warnings, *measured.warnings, *misfit)
    guess, ansatz, unknowns, reading = found_modes(
        pair, geometry, cell_size, how, measured.at_points(cell_size / POINTS_A_CELL)
    )
    now, before = (sum(mode.family.size for mode in one.modes) for one in (ansatz, found.ansatz))
    if measured.light == LOCAL:
        refit = refitted(measured, ansatz, unknowns, mask)
        a = np.append(refit.unknowns, unknowns[refit.unknowns.size :])
        found = refitted_result(pair, ansatz, a, how.options())
        text, warnings = (first.text[0], *reading), (*warnings, _LOCAL_LIGHT)
    elif now >= before and _goes_on(found, ansatz, unknowns):
        refit = refitted(measured, found.ansatz, found.unknowns, mask)
        text = (*first.text, "The spectra of the whole displacement show no other waves.")
    else:
        found, refit = refitted_correlation(
            measured, pair, ansatz, unknowns, mask, how.options(), progress
        )
        text = (
            first.text[0],
            *reading,
            f"A first correlation, of other modes, ended as “{first.result.outcome.value}”; this "
            "one started from the ansatz fitted to the whole displacement.",
            *([found.final_smoothing.text] if found.final_smoothing else ()),
        )
        if found.outcome is Outcome.REFITTED:
            warnings = (*warnings, _REFITTED)
    whole = WholeField(measured, refit, start=start)
    return MeasuredPhotograph(found, guess.local, text, whole, warnings)


def found_modes(
    pair: ImagePair, geometry: Geometry, cell_size: float, how: PhotographOptions,
    local: LocalField | None, holes: LocalField | None = None,
) -> tuple[InitialGuess, Ansatz, FloatArray, tuple[str, ...]]:  # fmt: skip
    """Find a guess for holes ``cell_size`` [mm] apart; ansatz, unknowns (n,) and text from it."""
    region = geometry.region
    lower = for_cells(how, region.domain, region.cellular, cell_size)
    guess = initial_guess(
        pair, cell_size, list(geometry.parts.values()), local=local, holes=holes,
        lattice=geometry.lattice_mm, domain=region.domain, options=lower,
    )  # fmt: skip
    ansatz, unknowns = chosen_modes(guess, geometry, cell_size, lower)
    text = (_LOWER.format(lower.v0_degree, lower.v_degree),) * (lower != how)
    return guess, ansatz, unknowns, (*_guess_text(guess, ansatz, geometry), *text)


def with_brightness(result: Result, how: PhotographOptions) -> tuple[Ansatz, FloatArray]:
    """Ansatz and unknowns of a result with the specified brightness, as an initial guess."""
    ansatz = replace(result.ansatz, brightness=Brightness.of(how.brightness))
    first = result.ansatz.phi_offset(len(result.ansatz.modes))
    start = np.zeros(ansatz.size)
    start[:first] = result.unknowns[:first]
    return ansatz, start


def _goes_on(before: Result, ansatz: Ansatz, unknowns: FloatArray) -> bool:
    """Whether the previous result can start this one: converged, with all waves observed now.

    Free waves that weren't observable there have drifted anywhere.
    """
    if before.outcome is not Outcome.CONVERGED or before.ansatz.fixed != ansatz.fixed:
        return False
    if not ansatz.fixed and identifiability(before).unobservable:
        return False
    return not shows_more(ansatz, unknowns, before.ansatz, before.unknowns)


def _guess_text(guess: InitialGuess, ansatz: Ansatz, geometry: Geometry) -> tuple[str, ...]:
    """The initial guess's text; lines about a spectrum name its part, where there are several."""
    if len(geometry.parts) == 1:
        return guess.text
    read = {line for pattern in guess.patterns for line in pattern.text}
    text = [line for line in guess.text if line not in read]
    for (name, box), pattern in zip(geometry.parts.items(), guess.patterns, strict=True):
        own = [k + 1 for k, mode in enumerate(ansatz.modes) if mode.taper.cellular == box]
        modes = " and ".join(f"v{k} phi{k}" for k in own) or "no mode"
        text.append(f"Region {name!r}, {modes}: {' '.join(pattern.text)}")
    return tuple(text)


def _moved_holes(result: Result, geometry: Geometry) -> LocalField | None:
    """v0 at the reference's holes, in place of their observed motion; None without holes."""
    if geometry.lattice is None:
        return None
    x, y = geometry.grid.to_mm(*geometry.lattice.centres.T)
    v0 = result.ansatz.v0(result.unknowns, x[:, None], y[:, None])[:, 0]
    return LocalField(x, y, v0, source="v0 at the holes")


def warped_back(
    deformed: NDArray[Any], result: Result, order: int = 5, u: FloatArray | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Show a deformed image g (rows, cols) in the frame of the reference.

    Returns (1 + b) g(x + u) + c [grey levels], and where x + u is known and inside the image. u is
    a result's displacement, or the one given, (rows, cols, 2) [mm]; gain and offset are used if
    they were unknowns. The spline's order is 3 or 5.
    """
    spline = SplineImage.of(np.asarray(deformed, dtype=np.float32), order)
    image = np.vstack([np.float32(band) for band in result.warped_back(spline, u)])
    inside = np.isfinite(image)
    image[~inside] = 0.0
    return image, inside
