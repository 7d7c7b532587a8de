"""One deformed photograph against the reference: where to start, and what comes out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.harvest.geometry import Geometry
from modeharvest.harvest.modes import chosen_modes, shows_more
from modeharvest.harvest.options import Measurement
from modeharvest.harvest.pair import Pair
from modeharvest.harvest.surface import confirmed, followed_holes
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.brightness import Brightness
from modeharvest.idic.correlate import correlate
from modeharvest.idic.fields.local_field import LocalField
from modeharvest.idic.finish import Finish, blurred_pair, finish_for
from modeharvest.idic.gauss_newton import Outcome
from modeharvest.idic.identifiability import identifiability
from modeharvest.idic.result import Result
from modeharvest.idic.start.automatic import Start, StartOptions, automatic_start
from modeharvest.progress import Progress, silent

FloatArray = NDArray[np.float64]


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
        What came out of the photograph before. If it shows all waves that are seen now, its
        ansatz is kept and its unknowns are the start; the start is found anew if that leads
        nowhere.
    progress
        Listener.

    Raises
    ------
    InputError
        If the two images don't show the same surface, or the spectrum contradicts the cell size.
    """
    motion, said = followed_holes(pair, geometry)
    holes = None if motion is None else motion.in_mm(geometry.grid)
    if motion is None and before is not None:
        holes = _moved_holes(before.result, geometry)
        said += " v0 starts from the photograph before. "
        said += confirmed(pair, partial(_moved_to, before.result))
    options = StartOptions(how.v0_degree, how.v_degree, how.brightness())
    boxes = [part.box for part in geometry.parts]
    start = automatic_start(
        pair.reference, pair.deformed, geometry.grid, cell_size, boxes, pair.mask,
        pair.deformed_mask, local=local, holes=holes, lattice=geometry.lattice_mm,
        domain=geometry.region.domain, options=options,
    )  # fmt: skip
    ansatz, unknowns, held = chosen_modes(start, geometry, cell_size, how)
    sentences = (said, *_start_in_words(start, ansatz, geometry))
    if before is not None and _goes_on(before, ansatz, unknowns, held):
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


def _goes_on(before: Measured, ansatz: Ansatz, unknowns: FloatArray, held: bool) -> bool:
    """Whether the photograph before is a start: it was measured, and shows all that is seen now."""
    result = before.result
    if result.outcome is not Outcome.CONVERGED or before.held != held:
        return False
    return not shows_more(ansatz, unknowns, result.ansatz, result.unknowns)


def _start_in_words(start: Start, ansatz: Ansatz, geometry: Geometry) -> tuple[str, ...]:
    """The start's sentences; those about a spectrum name its part, where there are several."""
    if len(geometry.parts) == 1:
        return start.sentences
    read = {sentence for region in start.regions for sentence in region.pattern.sentences}
    said = [sentence for sentence in start.sentences if sentence not in read]
    for part, region in zip(geometry.parts, start.regions, strict=True):
        own = [k + 1 for k, mode in enumerate(ansatz.modes) if mode.taper.cellular == part.box]
        modes = " and ".join(f"v{k} phi{k}" for k in own) or "no mode"
        said.append(f"Region {part.name!r}, {modes}: {' '.join(region.pattern.sentences)}")
    return tuple(said)


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
