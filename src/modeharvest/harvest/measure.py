"""One deformed photograph against the reference: where to start, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.harvest.experiment import Measurement
from modeharvest.harvest.geometry import Geometry
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.automatic_start import Start, StartOptions, automatic_start
from modeharvest.idic.brightness import Brightness
from modeharvest.idic.correlate import correlate
from modeharvest.idic.finish import Finish, blurred_pair, finish_for
from modeharvest.idic.fourier import FourierMode, square_family
from modeharvest.idic.gauss_newton import Outcome
from modeharvest.idic.identifiability import identifiability
from modeharvest.idic.local_field import LocalField
from modeharvest.idic.region import junction
from modeharvest.idic.result import Result
from modeharvest.idic.scene import Expected, compare_scenes, require_same_scene
from modeharvest.idic.support import Taper
from modeharvest.progress import Progress, silent

FloatArray = NDArray[np.float64]
FloatImage = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Pair:
    """What is correlated.

    Parameters
    ----------
    reference, deformed
        (rows, cols) f and g.
    mask, deformed_mask
        (rows, cols) True on material.
    """

    reference: FloatImage
    deformed: FloatImage
    mask: BoolArray
    deformed_mask: BoolArray


@dataclass(frozen=True, eq=False)
class Measured:
    """What came out of one photograph.

    Parameters
    ----------
    result
        Of the correlation.
    local
        The displacement field that the start was read from, a local DIC's if there is one.
    held
        Whether the mode was held.
    blur_px
        Of the images that the correlation ended on [px]; 0 for the images as they are.
    sentences
        Where the correlation started from and ended, in words.
    """

    result: Result
    local: LocalField
    held: bool
    blur_px: float
    sentences: tuple[str, ...]


def measure(
    pair: Pair,
    geometry: Geometry,
    cell_size: float,
    how: Measurement,
    local: LocalField | None = None,
    before: Measured | None = None,
    progress: Progress = silent,
) -> Measured:
    """Find start and ansatz, and correlate.

    Parameters
    ----------
    pair
        Of images.
    geometry
        Of the specimen.
    cell_size
        l [mm].
    how
        The ansatz and how to correlate.
    local
        A local DIC's field.
    before
        What came out of the photograph before. If it had a pattern, its ansatz is kept and its
        unknowns are the start; the start is found anew if that leads nowhere.
    progress
        Listener.

    Raises
    ------
    InputError
        If the two images don't show the same surface, or the spectrum contradicts the cell size.
    """
    motion, said = geometry.motion_in(pair.deformed_mask)
    holes = None if motion is None else motion.in_mm(geometry.grid)
    expected: Expected | None = None if motion is None else motion.at
    if motion is None and before is not None:
        holes, expected = _moved_holes(before.result, geometry), partial(_moved_to, before.result)
        said += " v0 starts from the photograph before."
    if expected is not None:
        said += " " + _same_surface(pair, expected)
    options = StartOptions(how.v0_degree, how.v_degree, how.brightness())
    start = automatic_start(
        pair.reference, pair.deformed, geometry.grid, cell_size, geometry.region.cellular,
        pair.mask, pair.deformed_mask, local=local, holes=holes, lattice=geometry.lattice_mm,
        domain=geometry.region.domain, options=options,
    )  # fmt: skip
    ansatz, unknowns, held = chosen_modes(start, geometry, cell_size, how)
    sentences = (said, *start.sentences)
    if before is not None and _goes_on(before, held):
        found, finish = correlated(pair, geometry, *_lit(before.result, how), how, progress)
        if found.outcome is Outcome.CONVERGED:
            words = "The correlation started from the result of the photograph before."
            said_all = (*sentences, words, finish.sentence)
            return Measured(found, start.local, before.held, finish.blur_px, said_all)
    found, finish = correlated(pair, geometry, ansatz, unknowns, how, progress)
    return Measured(found, start.local, held, finish.blur_px, (*sentences, finish.sentence))


def correlated(
    pair: Pair,
    geometry: Geometry,
    ansatz: Ansatz,
    unknowns: FloatArray,
    how: Measurement,
    progress: Progress = silent,
) -> tuple[Result, Finish]:
    """Correlate from coarse to fine, and finish as the leftover on the last coarse level asks for.

    Parameters
    ----------
    pair, geometry
        Images and specimen.
    ansatz, unknowns
        The start.
    how
        How to correlate.
    progress
        Listener.

    Returns
    -------
    result, finish
        A result on blurred images has no unknowns for gain and offset: levelling did that.
    """
    options, grid = how.options(), geometry.grid
    masks = pair.mask, pair.deformed_mask
    coarse = replace(options, levels=options.levels[:-1])
    images: tuple[NDArray[Any], NDArray[Any]] = pair.reference, pair.deformed
    rough = correlate(*images, grid, ansatz, unknowns, *masks, coarse, progress)
    binned = rough.grid.pixel_size / grid.pixel_size
    leftover_px = binned * identifiability(rough, None).leftover_px
    finish = finish_for(pair.reference, pair.mask, leftover_px)
    if finish.blur_px > 0.0:
        images = blurred_pair(*images, *masks, finish.blur_px)
        ansatz = replace(ansatz, brightness=Brightness())
    fine = replace(options, levels=options.levels[-1:])
    start = rough.unknowns[: ansatz.size]
    result = correlate(*images, grid, ansatz, start, *masks, fine, progress)
    return replace(result, history=(*rough.history, *result.history)), finish


def _lit(result: Result, how: Measurement) -> tuple[Ansatz, FloatArray]:
    """Ansatz and unknowns of a result with the brightness that was asked for, to start from."""
    ansatz = replace(result.ansatz, brightness=how.brightness())
    first = result.ansatz.phi_offset(len(result.ansatz.modes))
    start = np.zeros(ansatz.size)
    start[:first] = result.unknowns[:first]
    return ansatz, start


def _same_surface(pair: Pair, expected: Expected) -> str:
    """A sentence about blocks of the reference that were found where they are expected."""
    seen = compare_scenes(pair.reference, pair.deformed, pair.mask, expected)
    require_same_scene(seen, "the reference", "the deformed one")
    return seen.sentence


def chosen_modes(
    start: Start, geometry: Geometry, cell_size: float, how: Measurement
) -> tuple[Ansatz, FloatArray, bool]:
    """The start's ansatz and unknowns with the family and the holding that were asked for."""
    ansatz, unknowns, held = start.ansatz, start.unknowns, start.held
    wants_square = how.family == "square" and geometry.lattice is not None
    if (wants_square and "square" not in start.family) or (held and how.hold_mode is False):
        ansatz, unknowns = _with_square_mode(ansatz, unknowns, geometry, cell_size)
        held = False
    if how.hold_mode is True and not held:
        ansatz, unknowns = with_held_modes(ansatz, unknowns)
        held = True
    return ansatz, unknowns, held


def with_held_modes(ansatz: Ansatz, unknowns: FloatArray) -> tuple[Ansatz, FloatArray]:
    """The same ansatz with its modes held where the unknowns have them, and fewer unknowns."""
    modes = []
    for i, mode in enumerate(ansatz.modes):
        here = replace(mode.family, start=unknowns[ansatz.phi_slice(i)])
        modes.append(replace(mode, family=here.held()))
    first, last = ansatz.phi_offset(0), ansatz.phi_offset(len(ansatz.modes))
    return replace(ansatz, modes=tuple(modes)), np.concatenate([unknowns[:first], unknowns[last:]])


def _with_square_mode(
    ansatz: Ansatz, unknowns: FloatArray, geometry: Geometry, cell_size: float
) -> tuple[Ansatz, FloatArray]:
    """The paper's Eq. (mode) with its origin on a junction, started as in the paper."""
    assert geometry.lattice is not None
    family = square_family("junction").moved(junction(geometry.lattice, geometry.grid))
    taper = Taper(geometry.region.cellular, 0.5 * cell_size)
    mode = FourierMode.scaled(family, cell_size, taper)
    made = replace(ansatz, modes=(mode,))
    a = made.start()
    slow = 2 * ansatz.v0_space.size
    a[:slow] = unknowns[:slow]
    return made, a


def _goes_on(before: Measured, held: bool) -> bool:
    """Whether the photograph before is a start: it was measured, and the pattern is still there."""
    return before.result.outcome is Outcome.CONVERGED and before.held == held


def _moved_holes(result: Result, geometry: Geometry) -> tuple[FloatArray, FloatArray] | None:
    """The reference's holes and v0 there [mm], as if they had been followed; None without any."""
    if geometry.lattice is None:
        return None
    x, y = geometry.grid.to_mm(*geometry.lattice.centres.T)
    moved = result.ansatz.v0(result.unknowns, x[:, None], y[:, None])[:, 0]
    return np.column_stack([x, y]), moved


def _moved_to(result: Result, points: FloatArray) -> FloatArray:
    """(n, 2) (row, col) that positions (n, 2) of the reference have moved to [px]."""
    grid = result.grid
    x, y = grid.to_mm(points[:, 0], points[:, 1])
    moved = np.column_stack([x, y]) + result.ansatz.displacement_at(
        result.unknowns, np.column_stack([x, y])
    )
    return np.column_stack(grid.to_px(moved[:, 0], moved[:, 1]))
