"""Initial guess: ansatz and unknowns from a pair of images, with no number typed.

What the paper does by eye in its Section "Parametrization and Initial Guess of the Patterning
Modes": a displacement field, its spectral densities, the waves that they show, the family that
these belong to. The field is a local DIC's where there is one, and otherwise a rough one that the
images give by themselves.

1. v0: through the motion of hole centres, or of outlines; not needed with a local DIC's field.
2. A field, rough or measured, and its spectrum over each region.
3. Modes: the square family with seven parameters, or free waves, or the pattern that the lattice of
   holes allows, fixed, where the images show none.
4. v0 and every v_i, together, by robust least squares through the field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.idic.ansatz import Ansatz, AnsatzOptions
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.local.motion import (
    SLOW_DEGREE,
    RobustFit,
    coarse_field,
    first_motion,
    fit_unknowns,
)
from modeharvest.idic.modes import ModeFamily, Taper, square_family
from modeharvest.idic.photograph.geometry import Geometry
from modeharvest.idic.photograph.initial_modes import (
    SAME_WAVE,
    Cells,
    InitialMode,
    fixed_square,
    modes_of,
    require_cell_size,
)
from modeharvest.idic.photograph.region import box_of, junction
from modeharvest.idic.setup import PhotographOptions
from modeharvest.idic.slow_fields import Box, Brightness
from modeharvest.idic.spectra.pattern import WavePattern, read_pattern
from modeharvest.idic.spectra.spectrum import Spectrum, measured_spectrum
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import FloatArray

_Placed = tuple[InitialMode, Box]
"""A mode and its region."""

AMPLITUDE_DEGREE = 2
"""Total degree of every v_i at the start: strongest in the middle, weaker at clamped edges."""
FIXED_AMPLITUDE = 1.0
"""v_i where no pattern is seen [mm]; as the paper's start, 40 um with max ||phi|| = 0.04."""


@dataclass(frozen=True, eq=False)
class RegionPattern:
    """A part of the specimen with a pattern of its own.

    Parameters
    ----------
    box
        Where [mm].
    spectrum
        Of the field there.
    pattern
        What the spectrum shows.
    modes
        Indices of the ansatz's modes that belong to it.
    """

    box: Box
    spectrum: Spectrum
    pattern: WavePattern
    modes: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class InitialGuess:
    """Where a correlation begins, and why there.

    Parameters
    ----------
    ansatz
        With the modes found.
    unknowns
        (size,) for :func:`modeharvest.idic.correlate.correlate`.
    regions
        One or more, with their spectra.
    local
        The field that the start was read from.
    fixed
        Whether the modes are fixed because no pattern is seen.
    sentences
        What was found, in words.
    """

    ansatz: Ansatz
    unknowns: FloatArray
    regions: tuple[RegionPattern, ...]
    local: LocalField
    fixed: bool
    sentences: tuple[str, ...]

    @property
    def family(self) -> str:
        """Names of the modes' families."""
        return " and ".join(mode.family.name for mode in self.ansatz.modes) or "none"

    @property
    def spectrum(self) -> Spectrum:
        """Of the first region."""
        return self.regions[0].spectrum

    @property
    def pattern(self) -> WavePattern:
        """Of the first region."""
        return self.regions[0].pattern


def initial_guess(
    pair: ImagePair,
    cell_size: float,
    cellular: Box | Sequence[Box],
    *,
    local: LocalField | None = None,
    holes: LocalField | None = None,
    lattice: ArrayLike | None = None,
    domain: Box | None = None,
    options: AnsatzOptions | None = None,
) -> InitialGuess:
    """Find ansatz and initial guess for a pair of images.

    Parameters
    ----------
    pair
        The images.
    cell_size
        l, the distance of neighbouring holes [mm].
    cellular
        The part with holes [mm]; or several parts, each with modes of its own.
    local
        A displacement field of a local DIC; the grey levels are not looked at then.
    holes
        Displacements of the holes' centres.
    lattice
        (2, 2) vectors of the lattice of holes as rows [mm]; by default square, along x and y.
    domain
        Of the Chebyshev polynomials [mm]; by default the material's bounding box.
    options
        Degrees; the paper's by default.

    Raises
    ------
    InputError
        If the holes or the spectrum contradict the cell size.
    """
    options = options or AnsatzOptions()
    boxes = (cellular,) if isinstance(cellular, Box) else tuple(cellular)
    if domain is None:
        domain = Box(*pair.grid.extent) if pair.mask is None else box_of(pair.mask, pair.grid)
    cells = Cells.found(cell_size, lattice, pair, boxes, holes)
    said: list[str] = []
    if local is None:
        known, sentence = first_motion(domain, pair, holes)
        local = coarse_field(pair, cell_size, known)
        said += [sentence, f"Without a local DIC: {local.x.size} points of {local.source}."]
    else:
        share = 100 * local.valid_share
        said.append(f"Local field {local.source}: {local.x.size} points, {share:.1f} % valid.")
    regions, modes = _read_regions(local, boxes, cells, said)
    fixed = not modes
    if fixed:
        modes = _fixed_mode(boxes[0], cells, said)
    ansatz, a = _assembled(modes, cell_size, domain, options)
    fit = _fitted(ansatz, a, local, fixed)
    said.append(_fit_words(ansatz, fit, fixed))
    return InitialGuess(ansatz, fit.coefficients, regions, local, fixed, tuple(said))


def _read_regions(
    local: LocalField, boxes: Sequence[Box], cells: Cells, said: list[str]
) -> tuple[tuple[RegionPattern, ...], list[_Placed]]:
    """The regions, and the modes of all of them."""
    regions: list[RegionPattern] = []
    modes: list[_Placed] = []
    for box in boxes:
        region, found = _read_region(local, box, cells, len(modes), said)
        regions.append(region)
        modes += found
    return tuple(regions), modes


def _read_region(
    local: LocalField, box: Box, cells: Cells, first: int, said: list[str]
) -> tuple[RegionPattern, list[_Placed]]:
    """Read the spectrum of one region, and make its modes, numbered from ``first``."""
    spectrum = measured_spectrum(local, cells.cell_size, box)
    pattern = read_pattern(spectrum)
    said += pattern.sentences
    if not cells.given:
        require_cell_size(pattern, cells.cell_size)
    modes = modes_of(pattern, cells) if pattern.waves else []
    if len(modes) > 1:
        said.append(
            f"The waves share no vector of the reciprocal lattice: {len(modes)} modes, each with "
            "an amplitude of its own."
        )
    numbers = tuple(range(first, first + len(modes)))
    return RegionPattern(box, spectrum, pattern, numbers), [(mode, box) for mode in modes]


def _fixed_mode(box: Box, cells: Cells, said: list[str]) -> list[_Placed]:
    """The pattern that a square lattice allows; none on others, of which we don't know it."""
    if not cells.square:
        said.append("The lattice of holes isn't square, and what it allows not known: v0 alone.")
        return []
    said.append(
        "The mode is fixed at the square pattern that the lattice of holes allows: without a "
        "pattern, its parameters can't be seen."
    )
    return [(InitialMode(fixed_square(cells), 0.0), box)]


def _assembled(
    modes: Sequence[_Placed], cell_size: float, domain: Box, options: AnsatzOptions
) -> tuple[Ansatz, FloatArray]:
    """The ansatz, and unknowns in which every v_i is a constant."""
    families = [(mode.family, box) for mode, box in modes]
    ansatz = Ansatz.on(domain, families, cell_size, options)
    a = ansatz.initial_guess()
    for i, (mode, _) in enumerate(modes):
        a[ansatz.v_slice(i)][0] = mode.amplitude / ansatz.modes[i].scale or FIXED_AMPLITUDE
    return ansatz, a


def _fitted(ansatz: Ansatz, a: FloatArray, local: LocalField, fixed: bool) -> RobustFit:
    """v0 and every v_i through the field; a mode that can't be seen isn't fitted."""
    slow = min(SLOW_DEGREE, ansatz.v0_degree)
    if not fixed:
        return fit_unknowns(ansatz, a, local, slow, min(AMPLITUDE_DEGREE, ansatz.v_degree))
    alone = replace(ansatz, modes=(), brightness=Brightness())
    fit = fit_unknowns(alone, np.zeros(alone.size), local, slow, -1)
    return replace(fit, coefficients=np.concatenate([fit.coefficients, a[alone.size :]]))


def _fit_words(ansatz: Ansatz, fit: RobustFit, fixed: bool) -> str:
    modes = () if fixed else ansatz.modes
    what = " and ".join(["v0", *(f"v{i + 1}" for i in range(len(modes)))])
    return (
        f"{what} through the field: leaves {1e3 * fit.sd:.0f} µm, {fit.outliers} components set "
        "aside."
    )


def chosen_modes(
    start: InitialGuess, geometry: Geometry, cell_size: float, how: PhotographOptions
) -> tuple[Ansatz, FloatArray, bool]:
    """The start's ansatz and unknowns with the specified family, its modes fixed or not."""
    ansatz, unknowns, fixed = start.ansatz, start.unknowns, start.fixed
    wants_square = how.family == "square" and geometry.lattice is not None
    if (wants_square and "square" not in start.family) or (fixed and how.fixed_mode is False):
        family = _square(geometry)
        ansatz, unknowns = _in_every_part(family, ansatz, unknowns, geometry, cell_size)
        fixed = False
    elif fixed and ansatz.modes and len(geometry.parts) > 1:
        family = ansatz.modes[0].family
        ansatz, unknowns = _in_every_part(family, ansatz, unknowns, geometry, cell_size)
    if how.fixed_mode is True and not fixed:
        ansatz, unknowns = with_fixed_modes(ansatz, unknowns)
        fixed = True
    return ansatz, unknowns, fixed


def with_fixed_modes(ansatz: Ansatz, unknowns: FloatArray) -> tuple[Ansatz, FloatArray]:
    """The same ansatz with its modes fixed where the unknowns have them, and fewer unknowns."""
    modes = []
    for i, mode in enumerate(ansatz.modes):
        here = replace(mode.family, start=unknowns[ansatz.phi_slice(i)])
        modes.append(replace(mode, family=here.fixed()))
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
    families = [(family, part.box) for part in geometry.parts]
    made = replace(ansatz, modes=Ansatz.on(ansatz.domain, families, cell_size).modes)
    a = made.initial_guess()
    slow = 2 * ansatz.v0_space.size
    a[:slow] = unknowns[:slow]
    return made, a


def _square(geometry: Geometry) -> ModeFamily:
    """The paper's Eq. (mode) with its origin on a junction."""
    assert geometry.lattice is not None
    return square_family("junction").moved(junction(geometry.lattice, geometry.grid))
