"""The modes that a correlation starts with: those found, those asked for, held or free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from modeharvest.harvest.geometry import Geometry
from modeharvest.harvest.options import Measurement
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.fourier import FourierMode, ModeFamily, square_family
from modeharvest.idic.specimen.region import junction
from modeharvest.idic.start.automatic import Start
from modeharvest.idic.start.modes import SAME_WAVE
from modeharvest.idic.support import Taper

FloatArray = NDArray[np.float64]


def chosen_modes(
    start: Start, geometry: Geometry, cell_size: float, how: Measurement
) -> tuple[Ansatz, FloatArray, bool]:
    """The start's ansatz and unknowns with the family and the holding that were asked for."""
    ansatz, unknowns, held = start.ansatz, start.unknowns, start.held
    wants_square = how.family == "square" and geometry.lattice is not None
    if (wants_square and "square" not in start.family) or (held and how.hold_mode is False):
        family = _square(geometry)
        ansatz, unknowns = _in_every_part(family, ansatz, unknowns, geometry, cell_size)
        held = False
    elif held and ansatz.modes and len(geometry.parts) > 1:
        family = ansatz.modes[0].family
        ansatz, unknowns = _in_every_part(family, ansatz, unknowns, geometry, cell_size)
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


def shows_more(
    now: Ansatz, unknowns: FloatArray, before: Ansatz, unknowns_before: FloatArray
) -> bool:
    """Whether a part of the specimen shows a wave that it did not show before."""
    known = _waves(before, unknowns_before)
    return any(
        not any(part == other and _same(xi, k) for other, k in known)
        for part, xi in _waves(now, unknowns)
    )


def _waves(ansatz: Ansatz, unknowns: FloatArray) -> list[tuple[Taper, FloatArray]]:
    """Every wave's part of the specimen, and its vector in half turns a cell."""
    return [
        (mode.taper, wave[2:4])
        for i, mode in enumerate(ansatz.modes)
        for wave in mode.family.waves(unknowns[ansatz.phi_slice(i)])
    ]


def _same(one: FloatArray, other: FloatArray) -> bool:
    """Whether two wave vectors are one, or each other's opposite, up to what is read off."""
    apart = min(np.linalg.norm(one - other), np.linalg.norm(one + other))
    return bool(0.5 * apart <= SAME_WAVE)


def _in_every_part(
    family: ModeFamily,
    ansatz: Ansatz,
    unknowns: FloatArray,
    geometry: Geometry,
    cell_size: float,
) -> tuple[Ansatz, FloatArray]:
    """One family in each part, with v0 as it was and every v_i where the paper starts it."""
    modes = tuple(
        FourierMode.scaled(family, cell_size, Taper(part.box, 0.5 * cell_size))
        for part in geometry.parts
    )
    made = replace(ansatz, modes=modes)
    a = made.start()
    slow = 2 * ansatz.v0_space.size
    a[:slow] = unknowns[:slow]
    return made, a


def _square(geometry: Geometry) -> ModeFamily:
    """The paper's Eq. (mode) with its origin on a junction."""
    assert geometry.lattice is not None
    return square_family("junction").moved(junction(geometry.lattice, geometry.grid))
