"""Initial guess: ansatz and unknowns from a pair of images, without manual input.

What the paper does by eye in its Section "Parametrization and Initial Guess of the Patterning
Modes" is automated here: from a displacement field to its spectral densities, the waves that they
show, and the family of these waves. The field is that of a local DIC if there is one, otherwise a
rough one that is measured from the images.

1. v0: fitted to the motion of hole centres, or of boundaries; not needed with a local DIC's field.
2. A field, rough or measured, and its spectrum over each region.
3. Modes: the square family with seven parameters, or free waves, or the pattern that the lattice of
   holes allows, fixed, where the images show none.
4. v0 and every v_i, fitted together to the field by robust least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from modeharvest.fem.lattice.options import lattice_vectors
from modeharvest.idic.ansatz import Ansatz, AnsatzOptions
from modeharvest.idic.chebyshev import Box, Brightness
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.local.motion import (
    SLOW_DEGREE,
    RobustFit,
    coarse_field,
    first_motion,
    fit_unknowns,
)
from modeharvest.idic.modes import ModeFamily, Taper, free_family, turning_family
from modeharvest.idic.photograph.geometry import Geometry, box_of, junction
from modeharvest.idic.photograph.holes import find_holes
from modeharvest.idic.setup import PhotographOptions
from modeharvest.idic.spectra.pattern import WavePattern, nearest_origin, read_pattern
from modeharvest.idic.spectra.spectrum import measured_spectrum
from modeharvest.idic.spectra.waves import PlaneWave, grouped
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

DIAGONAL = 0.1
"""Relative difference of |kx| and |ky| up to which a wave counts as lying along a diagonal."""
SAME_WAVE = 0.15
"""Distance [1/l] within which two wave vectors are the same, up to a reciprocal lattice vector."""
AMPLITUDE_DEGREE = 2
"""Total degree of every v_i at first: largest in the middle, smaller at clamped edges."""


@dataclass(frozen=True, eq=False)
class InitialGuess:
    """The initial guess of a correlation, and how it was found."""

    ansatz: Ansatz
    unknowns: FloatArray
    """(size,) initial unknowns for :func:`modeharvest.idic.correlate.correlate`."""
    patterns: tuple[WavePattern, ...]
    """Wave patterns in the spectra of the field, one for each part; modes are in the same order."""
    local: LocalField
    text: tuple[str, ...]

    @property
    def family(self) -> str:
        """Names of the modes' families."""
        return " and ".join(mode.family.name for mode in self.ansatz.modes) or "none"


def initial_guess(
    pair: ImagePair, cell_size: float, cellular: Box | Sequence[Box], *,
    local: LocalField | None = None, holes: LocalField | None = None,
    lattice: ArrayLike | None = None, domain: Box | None = None,
    options: AnsatzOptions | None = None,
) -> InitialGuess:  # fmt: skip
    """Find ansatz and initial guess for a pair of images.

    InputError if the holes or the spectrum contradict the cell size.

    cell_size : l, the distance of neighbouring holes [mm].
    cellular : The part with holes [mm]; or several parts, each with modes of its own.
    local : A displacement field of a local DIC; the grey levels are not used then.
    holes : Displacements of the holes' centres.
    lattice : (2, 2) vectors of the lattice of holes as rows [mm]; by default square, along x and y.
    domain : Box of the Chebyshev polynomials [mm]; by default the material's bounding box.
    options : Polynomial degrees; the paper's by default.
    """
    options = options or AnsatzOptions()
    boxes = (cellular,) if isinstance(cellular, Box) else tuple(cellular)
    if domain is None:
        domain = Box(*pair.grid.extent) if pair.mask is None else box_of(pair.mask, pair.grid)
    cells = Cells.found(cell_size, lattice, pair, boxes, holes)
    if local is None:
        known, motion_text = first_motion(domain, pair, holes)
        local = coarse_field(pair, cell_size, known)
        text = [motion_text, f"Without a local DIC: {local.x.size} points of {local.source}."]
    else:
        share = 100 * local.valid_share
        text = [f"Local field ({local.source}): {local.x.size} points, {share:.1f} % valid."]
        text += [local.read_as] * bool(local.convention)
    patterns = tuple(read_pattern(measured_spectrum(local, cell_size, box)) for box in boxes)
    modes: list[tuple[ModeFamily, Box]] = []
    for box, pattern in zip(boxes, patterns, strict=True):
        if lattice is None:
            require_cell_size(pattern, cell_size)
        families = modes_of(pattern, cells)
        modes += [(family, box) for family in families]
        text += pattern.text
        if pattern.start is not None and cells.turned:
            text.append("The lattice is turned and Eq. (6) can't be: its two waves are free.")
        if len(families) > 1:
            text.append(
                f"The waves share no vector of the reciprocal lattice: {len(families)} modes, each "
                "with an amplitude of its own."
            )
    if not modes and cells.square:
        fixed = turning_family(cells.vectors, cell_size, cells.junction).fixed()
        modes = [(fixed, box) for box in boxes]
        text.append(
            "The mode is fixed at the square pattern that the lattice of holes allows: without a "
            "pattern, its parameters aren't observable."
        )
    elif not modes:
        text.append("The lattice of holes isn't square, and what it allows not known: v0 alone.")
    ansatz = Ansatz.on(domain, modes, cell_size, options)
    fit = _fitted(ansatz, local)
    count = 0 if ansatz.fixed else len(modes)
    fitted = " and ".join(["v0", *(f"v{i + 1}" for i in range(count))])
    text.append(
        f"{fitted} fitted to the field: an sd of {1e3 * fit.sd:.0f} µm remains; {fit.outliers} "
        "components are outliers and left out."
    )
    return InitialGuess(ansatz, fit.coefficients, patterns, local, tuple(text))


_TURNED = 0.0175
"""Tangent of the angle from which on a lattice is turned: a degree."""
NEARLY_SQUARE = 0.05
"""Relative difference of lengths, and cosine between directions, up to which vectors are square."""
WRONG_CELL = 0.07
"""Relative difference of a cell size given from one found, beyond which they contradict each
other: over the paper's six cells the phase of its mode drifts by 1.3 rad, and a correlation may
settle in a local minimum. A measured field's peaks are known to a few hundredths."""
_FEWEST_HOLES = 4
_SMALLEST_HOLE = 0.01
"""Area of a hole [cells] below which it is a speck in the mask."""


@dataclass(frozen=True, eq=False)
class Cells:
    """The lattice of holes."""

    cell_size: float
    """l, the distance of neighbouring holes [mm]."""
    vectors: FloatArray
    """(2, 2) lattice vectors as rows [mm]; square where they aren't known."""
    junction: FloatArray
    """(2,) the middle of the solid between four holes [mm]."""

    @classmethod
    def found(
        cls,
        cell_size: float,
        lattice: ArrayLike | None,
        pair: ImagePair,
        boxes: Sequence[Box],
        holes: LocalField | None,
    ) -> Cells:
        """Use what is given, and find the rest from the mask; InputError if they contradict."""
        if not cell_size > 0:
            raise InputError(f"initial guess: expected a positive cell size, got {cell_size} mm")
        vectors = _matching_vectors(cell_size, lattice)
        centres = np.zeros((0, 2)) if holes is None else holes.points
        if holes is None and pair.mask is not None and not pair.mask.all():
            centres = hole_centres(pair, boxes, cell_size)
        centres = centres[np.isfinite(centres).all(axis=1)]
        if len(centres) >= _FEWEST_HOLES:
            apart = float(np.median(KDTree(centres).query(centres, k=2)[0][:, 1]))
            found = f"{apart:.3g} mm between neighbours of {len(centres)} holes"
            _require_hole_distance(apart, cell_size, found)
        corner = np.array([boxes[0].x_min, boxes[0].y_min])
        hole = _middle_hole(centres, vectors) if len(centres) else corner + vectors.sum(axis=0) / 2
        junction = np.asarray(hole - 0.5 * vectors.sum(axis=0))
        return cls(cell_size, vectors, junction)

    @property
    def square(self) -> bool:
        """Whether the lattice vectors are equally long, and at right angles."""
        a, b = np.linalg.norm(self.vectors, axis=1)
        cosine = abs(self.vectors[0] @ self.vectors[1]) / (a * b)
        return bool(abs(a - b) <= NEARLY_SQUARE * a and cosine <= NEARLY_SQUARE)

    @property
    def turned(self) -> bool:
        """Whether the first lattice vector is a degree or more off the x axis."""
        x, y = self.vectors[0]
        return bool(abs(y) > _TURNED * abs(x))


def hole_centres(pair: ImagePair, boxes: Sequence[Box], cell_size: float) -> FloatArray:
    """(n, 2) centres of the holes of the reference that lie in boxes [mm]; specks are left out."""
    holes = find_holes(pair.masks[0], _SMALLEST_HOLE * (cell_size / pair.grid.pixel_size) ** 2)
    x, y = pair.grid.to_mm(*holes.centres.T)
    return np.vstack([np.column_stack([x, y])[box.contains(x, y)] for box in boxes])


def _require_hole_distance(apart: float, cell_size: float, found: str) -> None:
    """Raise InputError if neighbouring holes, so far ``apart`` [mm], are not a cell size apart."""
    if abs(apart - cell_size) > WRONG_CELL * cell_size:
        raise InputError(
            f"initial guess: expected holes {cell_size:g} mm apart, the cell size given, got "
            f"{found}; give cell size {apart:.3g} mm, or check the pixel size"
        )


def _middle_hole(centres: FloatArray, vectors: FloatArray) -> FloatArray:
    """(2,) position of the middle hole, as the mean of itself and its neighbours' [mm]."""
    middle = centres[np.argmin(np.linalg.norm(centres - centres.mean(axis=0), axis=1))]
    steps = np.linalg.solve(vectors.T, (centres - middle).T).T
    near = np.abs(steps).max(axis=1) < 1.5
    return np.asarray((centres - np.round(steps) @ vectors)[near].mean(axis=0))


def _matching_vectors(cell_size: float, lattice: ArrayLike | None) -> FloatArray:
    """(2, 2) vectors of the lattice of holes as rows [mm], the first one nearest to the x axis.

    Raises InputError if ``lattice`` isn't one, or its shortest distance isn't l within 7 %.
    """
    if lattice is None:
        return cell_size * np.eye(2)
    vectors = lattice_vectors(lattice, "initial guess")
    i = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)), axis=-1).reshape(-1, 2)
    lengths = np.linalg.norm(i[np.any(i != 0, axis=1)] @ vectors, axis=1)
    shortest = float(lengths.min())
    _require_hole_distance(shortest, cell_size, f"a lattice of holes {shortest:.3g} mm apart")
    if np.prod(np.abs(np.diag(vectors[::-1]))) > np.prod(np.abs(np.diag(vectors))):
        vectors = vectors[::-1]
    signs = np.where(np.diag(vectors) < 0, -1.0, 1.0)
    return np.asarray(vectors * signs[:, None])


def require_cell_size(pattern: WavePattern, cell_size: float) -> None:
    """Raise InputError if a pattern's waves are those of a square lattice of another cell size.

    Two waves along both diagonals, equally long, are what the square pattern looks like with a
    wrong cell size: at |ξ| = l / 2l₀ along each axis, where l₀ is the right one.
    """
    k = np.abs([w.k for w in pattern.waves])
    if len(k) != 2 or np.ptp(k) > DIAGONAL * k.mean():
        return
    found = cell_size / float(k.mean())
    if abs(found - cell_size) > WRONG_CELL * cell_size:
        xi = 0.5 * float(k.mean())
        raise InputError(
            f"initial guess: expected the spectrum's peaks at ξ = (±0.50, ±0.50) for a cell of "
            f"{cell_size:g} mm, got (±{xi:.2f}, ±{xi:.2f}), which belong to a cell of {found:.3g} "
            f"mm; give that cell size, or the lattice of the holes if the pattern isn't theirs"
        )


def modes_of(pattern: WavePattern, cells: Cells) -> list[ModeFamily]:
    """Make the modes of a pattern: the paper's family for the square pattern, else free waves.

    On a lattice that is turned against x and y the square pattern's two waves are free, too: they
    displace along directions of their own, and Eq. (6) has one ratio a1 of x to y for both.
    Waves whose vectors differ by a reciprocal lattice vector are coupled by the holes and make one
    mode. Each group of such waves has its own mode, with its own amplitude v.
    """
    if pattern.start is not None and not cells.turned:
        return [replace(nearest_origin(pattern.start, cells.cell_size), name="square")]
    return [_free_mode(group) for group in grouped(pattern.waves, partial(_coupled, cells))]


def _coupled(cells: Cells, one: PlaneWave, other: PlaneWave) -> bool:
    """Whether two waves, or one and the other's opposite, differ by a reciprocal lattice vector."""
    apart = np.array(other.xi) - np.outer((1.0, -1.0), one.xi)
    periods = cells.vectors @ apart.T / cells.cell_size
    rest = np.linalg.solve(cells.vectors, periods - np.round(periods)) * cells.cell_size
    return bool((np.linalg.norm(rest, axis=0) <= SAME_WAVE).any())


def _free_mode(waves: list[PlaneWave]) -> ModeFamily:
    rows = np.array([w.row for w in waves])
    rows[:, :2] /= np.abs(rows[:, :2]).max()
    return free_family(rows)


def _fitted(ansatz: Ansatz, local: LocalField) -> RobustFit:
    """Fit v0 and every v_i to the field; a mode that isn't observable isn't fitted."""
    a, slow = ansatz.initial_guess(), min(SLOW_DEGREE, ansatz.v0_degree)
    if not ansatz.fixed:
        return fit_unknowns(ansatz, a, local, slow, min(AMPLITUDE_DEGREE, ansatz.v_degree))
    alone = replace(ansatz, modes=(), brightness=Brightness())
    fit = fit_unknowns(alone, np.zeros(alone.size), local, slow)
    return replace(fit, coefficients=np.concatenate([fit.coefficients, a[alone.size :]]))


def chosen_modes(
    guess: InitialGuess, geometry: Geometry, cell_size: float, how: PhotographOptions
) -> tuple[Ansatz, FloatArray]:
    """Adapt the guess's ansatz and unknowns to the specified family, and fix the modes or not."""
    ansatz, unknowns = guess.ansatz, guess.unknowns
    lattice = geometry.lattice
    wants_square = how.family == "square" and lattice is not None and "square" not in guess.family
    if wants_square or (ansatz.fixed and how.fixed_mode is False):
        if lattice is None or lattice.kind not in ("square", "rectangular"):
            raise InputError(
                "correlation: expected holes on a square or rectangular lattice, for Eq. (6) to "
                f"start from, got {'no' if lattice is None else lattice.kind} lattice; set family "
                "and fixed_mode to 'auto'"
            )
        vectors = _matching_vectors(cell_size, geometry.lattice_mm)
        family = turning_family(vectors, cell_size, junction(lattice, geometry.grid))
        families = [(family, box) for box in geometry.parts.values()]
        v0 = unknowns[: 2 * ansatz.v0_space.size]
        ansatz = replace(ansatz, modes=Ansatz.on(ansatz.domain, families, cell_size).modes)
        unknowns = ansatz.initial_guess()
        unknowns[: v0.size] = v0
    keep = guess.ansatz.fixed if how.fixed_mode == "auto" else how.fixed_mode
    if keep and not ansatz.fixed:
        return with_fixed_modes(ansatz, unknowns)
    return ansatz, unknowns


def with_fixed_modes(ansatz: Ansatz, unknowns: FloatArray) -> tuple[Ansatz, FloatArray]:
    """Fix an ansatz' modes at the parameters in its unknowns; returns it with fewer unknowns."""
    modes = []
    for i, mode in enumerate(ansatz.modes):
        here = replace(mode.family, start=unknowns[ansatz.phi_slice(i)])
        modes.append(replace(mode, family=here.fixed()))
    first, last = ansatz.phi_offset(0), ansatz.phi_offset(len(ansatz.modes))
    return replace(ansatz, modes=tuple(modes)), np.concatenate([unknowns[:first], unknowns[last:]])


def shows_more(
    now: Ansatz, unknowns: FloatArray, before: Ansatz, unknowns_before: FloatArray
) -> bool:
    """Whether ``now``, with its unknowns (n,), has a wave in a part that ``before`` lacks there."""
    known = _waves(before, unknowns_before)
    return not all(
        any(
            taper == other and 0.5 * min(map(np.linalg.norm, (xi - k, xi + k))) <= SAME_WAVE
            for other, k in known
        )
        for taper, xi in _waves(now, unknowns)
    )


def _waves(ansatz: Ansatz, unknowns: FloatArray) -> list[tuple[Taper, FloatArray]]:
    """Every wave's part of the specimen, and its wave vector [half turns per cell]."""
    return [
        (mode.taper, wave[2:4])
        for i, mode in enumerate(ansatz.modes)
        for wave in mode.family.waves(unknowns[ansatz.phi_slice(i)])
    ]
