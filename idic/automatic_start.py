"""From images to an ansatz and a start, with no number typed.

What the paper does by eye in its Section "Parametrization and Initial Guess of the Patterning
Modes": a displacement field, its spectral densities, the waves that they show, the family that
these belong to. The field is a local DIC's where there is one, and otherwise a rough one that the
images give by themselves (:mod:`modeharvest.idic.coarse_field`).

1. v0: through the local field; else through the motion of hole centres; else of the outlines.
2. A field, rough or measured, and its spectrum over the cellular part.
3. Modes: the square family with seven parameters, or free waves, or the pattern that the lattice of
   holes allows, held, where the images show none.
4. v0 and every v_i once more, together, by robust least squares through the field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.brightness import Brightness
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.coarse_field import Slow, coarse_field
from modeharvest.idic.fourier import FourierMode
from modeharvest.idic.inputs import checked_mask
from modeharvest.idic.local_field import LocalField
from modeharvest.idic.measured_spectrum import measured_spectrum
from modeharvest.idic.pattern import Pattern, read_pattern
from modeharvest.idic.spectrum import Spectrum
from modeharvest.idic.start_fits import RobustFit, degree_for, fit_unknowns, outline_motion
from modeharvest.idic.start_modes import (
    StartMode,
    held_square,
    is_square,
    lattice_vectors,
    modes_of,
    require_cell_size,
)
from modeharvest.idic.support import Taper
from modeharvest.imaging.grid import PixelGrid

FloatArray = NDArray[np.float64]

SLOW_DEGREE = 3
"""Total degree of v0 at the start, at most: what bends and barrels, but doesn't follow cells."""
AMPLITUDE_DEGREE = 2
"""Total degree of every v_i at the start: strongest in the middle, weaker at clamped edges."""
HELD_AMPLITUDE = 1.0
"""v_i where no pattern is seen [mm]; as the paper's start, 40 um with max ||phi|| = 0.04."""


@dataclass(frozen=True)
class StartOptions:
    """What the ansatz is to be able to say.

    Parameters
    ----------
    v0_degree, v_degree
        Total degrees of v0 and of every v_i; the paper's.
    brightness
        Whether gain and offset are unknowns.
    """

    v0_degree: int = 5
    v_degree: int = 6
    brightness: Brightness = field(default_factory=Brightness)


@dataclass(frozen=True, eq=False)
class Start:
    """Where a correlation begins, and why there.

    Parameters
    ----------
    ansatz
        With the modes found.
    unknowns
        (size,) for :func:`modeharvest.idic.correlate.correlate`.
    family
        Names of the modes' families.
    pattern
        What the spectrum shows.
    spectrum
        Of the field that the start was read from.
    local
        That field.
    held
        Whether the modes are held because no pattern is seen.
    sentences
        What was found, in words.
    """

    ansatz: Ansatz
    unknowns: FloatArray
    family: str
    pattern: Pattern
    spectrum: Spectrum
    local: LocalField
    held: bool
    sentences: tuple[str, ...]


def automatic_start(
    reference: ArrayLike,
    deformed: ArrayLike,
    grid: PixelGrid,
    cell_size: float,
    cellular: Box,
    mask: ArrayLike | None = None,
    deformed_mask: ArrayLike | None = None,
    *,
    local: LocalField | None = None,
    holes: tuple[ArrayLike, ArrayLike] | None = None,
    lattice: ArrayLike | None = None,
    domain: Box | None = None,
    options: StartOptions | None = None,
) -> Start:
    """Find ansatz and start for a pair of images.

    Parameters
    ----------
    reference, deformed
        (rows, cols) grey levels.
    grid
        Their pixels.
    cell_size
        l [mm].
    cellular
        The part with holes, or the region with a pattern of its own [mm].
    mask, deformed_mask
        (rows, cols) True on material.
    local
        A displacement field of a local DIC.
    holes
        (n, 2) hole centres in the reference and (n, 2) their displacements [mm].
    lattice
        (2, 2) vectors of the lattice of holes as rows [mm]; by default square, along x and y.
    domain
        Of the Chebyshev polynomials [mm]; by default the material's bounding box.
    options
        Degrees, brightness.

    Raises
    ------
    InputError
        If the lattice or the spectrum contradict the cell size, or the images are no pair.
    """
    options = options or StartOptions()
    vectors = lattice_vectors(cell_size, lattice)
    inside, landing = (
        checked_mask(mask, "mask", grid),
        checked_mask(deformed_mask, "deformed mask", grid),
    )
    domain = domain or _bounding_box(inside, grid)
    slow = Ansatz(domain, (), min(SLOW_DEGREE, options.v0_degree), 0)
    said: list[str] = []
    if local is None:
        known = _slow_motion(slow, inside, landing, grid, holes, said)
        local = coarse_field(reference, deformed, grid, cell_size, known, inside, landing)
        said.append(f"No local DIC is given: {local.x.size} points of the {local.source} stand in.")
    else:
        said.append(
            f"Local field {local.source}: {local.x.size} points, {100 * local.valid_share:.1f} % "
            "of them valid."
        )
    spectrum = measured_spectrum(local, cell_size, cellular)
    pattern = read_pattern(spectrum)
    said += pattern.sentences
    if lattice is None:
        require_cell_size(pattern, cell_size)
    held = not pattern.waves
    modes = (
        _held_mode(vectors, cell_size, cellular, holes, said)
        if held
        else modes_of(pattern, vectors, cell_size)
    )
    ansatz, a = _assembled(modes, cell_size, cellular, domain, options)
    fit = _fitted(ansatz, a, local, held)
    said.append(_fit_words(ansatz, fit.sd, fit.outliers, held))
    family = " and ".join(m.family.name for m in modes)
    return Start(ansatz, fit.coefficients, family, pattern, spectrum, local, held, tuple(said))


def _bounding_box(mask: NDArray[np.bool_] | None, grid: PixelGrid) -> Box:
    """The outer edges of the pixels that show material."""
    if mask is None:
        return Box(*grid.extent)
    rows, cols = (np.flatnonzero(mask.any(axis=1 - k))[[0, -1]] for k in range(2))
    x, y = grid.to_mm(rows, cols)
    h = 0.5 * grid.pixel_size
    return Box(float(x[0]) - h, float(x[1]) + h, float(y[1]) - h, float(y[0]) + h)


def _slow_motion(
    slow: Ansatz,
    mask: NDArray[np.bool_] | None,
    deformed_mask: NDArray[np.bool_] | None,
    grid: PixelGrid,
    holes: tuple[ArrayLike, ArrayLike] | None,
    said: list[str],
) -> Slow:
    """The slow field by what is given: hole centres, else outlines, else none."""
    if holes is not None:
        centres, moved = (np.asarray(h, dtype=np.float64) for h in holes)
        good = np.isfinite(np.hstack([centres, moved])).all(axis=1)
        degree = degree_for(int(good.sum()), slow.v0_degree)
        if degree:
            zero = np.zeros(slow.size)
            fit = fit_unknowns(slow, zero, centres[good], moved[good], degree, -1)
            said.append(
                f"v0 through the motion of {good.sum()} hole centres: degree {degree}, leaves "
                f"{1e3 * fit.sd:.0f} µm, {fit.outliers} of {2 * good.sum()} components set aside."
            )
            return partial(slow.displacement_at, fit.coefficients)
    affine = None
    if mask is not None and deformed_mask is not None:
        affine = outline_motion(mask, deformed_mask, grid)
    if affine is None:
        said.append("v0 starts from no motion: neither hole centres nor whole outlines are seen.")
        return np.zeros_like
    said.append(
        f"v0 through the outlines: {100 * affine[0, 1]:+.1f} % along x and "
        f"{100 * affine[1, 2]:+.1f} % along y."
    )
    plane = affine
    return lambda points: plane[:, 0] + points @ plane[:, 1:].T


def _held_mode(
    vectors: FloatArray,
    cell_size: float,
    cellular: Box,
    holes: tuple[ArrayLike, ArrayLike] | None,
    said: list[str],
) -> list[StartMode]:
    """The pattern that a square lattice allows; none on others, of which we don't know it."""
    if not is_square(vectors):
        said.append("No pattern is seen and the lattice isn't square: v0 alone.")
        return []
    if holes is None:
        hole = np.array([cellular.x_min, cellular.y_min]) + 0.5 * vectors.sum(axis=0)
    else:
        hole = np.asarray(holes[0], dtype=np.float64)[0]
    said.append(
        "The mode is held at the square pattern that the lattice of holes allows: without a "
        "pattern, its parameters can't be seen."
    )
    return [StartMode(held_square(vectors, cell_size, hole - 0.5 * vectors.sum(axis=0)), 0.0)]


def _assembled(
    modes: Sequence[StartMode],
    cell_size: float,
    cellular: Box,
    domain: Box,
    options: StartOptions,
) -> tuple[Ansatz, FloatArray]:
    """The ansatz, and unknowns in which every v_i is a constant."""
    taper = Taper(cellular, 0.5 * cell_size)
    fourier = tuple(FourierMode.scaled(mode.family, cell_size, taper) for mode in modes)
    ansatz = Ansatz(domain, fourier, options.v0_degree, options.v_degree, options.brightness)
    a = ansatz.start()
    for i, mode in enumerate(modes):
        a[ansatz.v_slice(i)][0] = mode.amplitude / fourier[i].scale or HELD_AMPLITUDE
    return ansatz, a


def _fitted(ansatz: Ansatz, a: FloatArray, local: LocalField, held: bool) -> RobustFit:
    x, y, u = local.valid_points()
    points = np.column_stack([x, y])
    degrees = min(SLOW_DEGREE, ansatz.v0_degree), min(AMPLITUDE_DEGREE, ansatz.v_degree)
    if not held:
        return fit_unknowns(ansatz, a, points, u, *degrees)
    # A mode that can't be seen isn't fitted either.
    without = replace(ansatz, modes=())
    fit = fit_unknowns(without, np.zeros(without.size), points, u, degrees[0], -1)
    a = a.copy()
    n = 2 * ansatz.v0_space.size
    a[:n] = fit.coefficients[:n]
    return replace(fit, coefficients=a)


def _fit_words(ansatz: Ansatz, sd: float, outliers: int, held: bool) -> str:
    what = "v0" if held else "v0 and " + ", ".join(f"v{i + 1}" for i in range(len(ansatz.modes)))
    return f"{what} through the field: leaves {1e3 * sd:.0f} µm, {outliers} components set aside."
