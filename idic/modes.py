"""Patterning modes: truncated Fourier series, their families of parameters, and their support.

A mode is phi(x) = s tau(x) sum_w (A_w, B_w) sin(pi/l (kx_w x + ky_w y + c_w)): k is
dimensionless (1 is a wavelength of 2 l), c is in mm, s is a fixed scale and tau the support.
A family maps the few parameters a of the mode to the five parameters of each wave, P = C a + P0;
the paper's Eq. (6) is one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.chebyshev import Box, sum_of_products
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError


@dataclass(frozen=True)
class Taper:
    """Support of a mode: the factor tau(x) = tau_x(x) tau_y(y)."""

    cellular: Box
    """Region where tau = 1 [mm]."""
    width: float
    """Distance over which tau falls linearly to 0 outside it [mm]; the paper takes half the size of
    the unit cell."""

    def __post_init__(self) -> None:
        if not self.width > 0:
            raise InputError(f"expected a taper wider than 0 mm, got {self.width} mm")

    def along_x(self, x: ArrayLike) -> FloatArray:
        """tau_x [-] at x [mm]."""
        return _ramp(x, self.cellular.x_min, self.cellular.x_max, self.width)

    def along_y(self, y: ArrayLike) -> FloatArray:
        """tau_y [-] at y [mm]."""
        return _ramp(y, self.cellular.y_min, self.cellular.y_max, self.width)


def _ramp(t: ArrayLike, low: float, high: float, width: float) -> FloatArray:
    t = np.asarray(t, dtype=np.float64)
    outside = np.maximum(low - t, t - high)
    return np.clip(1.0 - outside / width, 0.0, 1.0)


PER_WAVE = 5
"""Parameters of a wave, in this order: A, B [-], kx, ky [-], c [mm]."""


@dataclass(frozen=True, eq=False)
class ModeFamily:
    """A linear map from a mode's parameters to its waves."""

    name: str
    """Name of the family, e.g. "square, origin at a junction"."""
    matrix: FloatArray
    """(5 w, m): C, from the m parameters to A, B, kx, ky, c of each of the w waves."""
    offset: FloatArray
    """(5 w,): P0, the part of the waves that doesn't depend on the parameters."""
    start: FloatArray
    """(m,): initial parameters of a correlation."""
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    """Names and units of the m parameters; by default a1, a2, ... and "-"."""

    def __post_init__(self) -> None:
        for key in ("matrix", "offset", "start"):
            object.__setattr__(self, key, np.array(getattr(self, key), dtype=np.float64))
        if self.matrix.ndim != 2 or len(self.matrix) % PER_WAVE or not len(self.matrix):
            raise InputError(
                f"mode family {self.name!r}: expected a matrix of shape (5 waves, parameters), "
                f"got {self.matrix.shape}"
            )
        rows, m = self.matrix.shape
        if self.offset.shape != (rows,) or self.start.shape != (m,):
            raise InputError(
                f"mode family {self.name!r}: expected offset ({rows},) and start ({m},), got "
                f"{self.offset.shape} and {self.start.shape}"
            )
        names = tuple(self.names) or tuple(f"a{k + 1}" for k in range(m))
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "units", tuple(self.units) or ("-",) * m)
        if len(self.names) != m or len(self.units) != m:
            raise InputError(
                f"mode family {self.name!r}: expected {m} names and units, got "
                f"{len(self.names)} and {len(self.units)}"
            )

    @property
    def size(self) -> int:
        """Number of parameters m."""
        return len(self.start)

    @property
    def wave_count(self) -> int:
        """Number of waves w."""
        return len(self.matrix) // PER_WAVE

    def waves(self, parameters: ArrayLike) -> FloatArray:
        """(w, 5): A, B, kx, ky [-] and c [mm] of every wave."""
        full = self.matrix @ np.asarray(parameters, dtype=np.float64) + self.offset
        return full.reshape(-1, PER_WAVE)

    def fixed(self) -> ModeFamily:
        """Make the family whose only mode is the ``start`` of this one: it has no parameters.

        For images without a pattern, in which the mode's parameters aren't observable.
        """
        waves = self.waves(self.start).ravel()
        return ModeFamily(f"{self.name}, fixed", np.zeros((waves.size, 0)), waves, np.zeros(0))

    def moved(self, shift: ArrayLike) -> ModeFamily:
        """Make the family whose start is this family's, translated by ``shift`` (2,) [mm].

        For a specimen whose origin differs from the one for which the mode was found; raises
        InputError if the family's phases aren't free to follow.
        """
        change = np.zeros((self.wave_count, PER_WAVE))
        change[:, 4] = -self.waves(self.start)[:, 2:4] @ np.asarray(shift, dtype=np.float64)
        step = np.linalg.lstsq(self.matrix, change.ravel(), rcond=None)[0]
        start = np.asarray(self.start + step, np.float64)
        if not np.allclose(self.matrix @ step, change.ravel(), atol=1e-9):
            raise InputError(f"mode family {self.name!r}: expected free phases, to move the mode")
        return replace(self, start=start)


def square_family(origin: str = "junction") -> ModeFamily:
    """Make the paper's Eq. (6): two waves along the diagonals, seven parameters.

    phi_x = a1 [-sin t1 - sin t2], phi_y = sin t1 - sin t2 with t1 = pi/l (a2 x + a3 y + a6) and t2
    = pi/l (a4 x + a5 y + a7); a6 and a7 are in mm. The origin is a "junction", the solid between
    four holes, where a mode starts from [1, 1, 1, -1, 1, 0, 0], or the centre of a "hole": [1, 1,
    1, 1, -1, 0, 0]; anything else raises InputError.
    """
    guesses = {"junction": [1, 1, 1, -1, 1, 0, 0], "hole": [1, 1, 1, 1, -1, 0, 0]}
    if origin not in guesses:
        raise InputError(f"expected an origin among {list(guesses)}, got {origin!r}")
    matrix, offset = np.zeros((10, 7)), np.zeros(10)
    matrix[[0, 5], 0] = -1.0  # A1 = A2 = -a1
    offset[[1, 6]] = 1.0, -1.0  # B1 = 1, B2 = -1
    for row, column in ((2, 1), (3, 2), (4, 5), (7, 3), (8, 4), (9, 6)):
        matrix[row, column] = 1.0
    units = ("-",) * 5 + ("mm",) * 2
    return ModeFamily(
        f"square, origin at a {origin}", matrix, offset, np.array(guesses[origin]), units=units
    )


def rotation_family(specimen: Specimen) -> ModeFamily:
    """Make the :func:`turning_family` of a specimen with rows that aren't staggered."""
    a, b = specimen.cellular_half_size
    x0 = 0.0 if specimen.holes_x % 2 == 0 else a % specimen.pitch
    y0 = 0.0 if specimen.holes_y % 2 == 0 else b % specimen.row_distance
    return turning_family(specimen.vectors, specimen.pitch, (x0, y0))


def turning_family(vectors: FloatArray, cell_size: float, junction: ArrayLike) -> ModeFamily:
    """Make Eq. (6) for a rectangular lattice, rows of ``vectors`` (2, 2), about a junction [mm].

    The initial wave vectors are those of the lattice, in units of pi over the cell size [mm]; a1
    starts as the ratio of amplitudes with which junctions rotate without changing shape.
    """
    first, second = np.linalg.inv(vectors / cell_size).T
    along, across = np.linalg.norm(vectors, axis=1)
    start = np.array([across / along, *(first + second), *(second - first), 0.0, 0.0])
    return replace(square_family("junction"), start=start).moved(junction)


T2 = -0.45
"""Second over first amplitude of a triangular lattice's modes [-]; -0.42 to -0.46 were found for
d/l = 0.87 and 0.92 and five loadings (docs/explanation/families.md)."""


def zone_boundary_families(specimen: Specimen) -> tuple[ModeFamily, ...]:
    """Make the mode families of the three M points of a specimen with staggered rows.

    Each has two waves: one towards its M point, mostly transverse, and one across, with the
    shortest wave vector that the lattice couples to it. Both are zero at the holes' centres
    (docs/explanation/families.md). The first wave's transverse amplitude is 1. The parameters are
    L1, the first wave's longitudinal amplitude; T2, the second's transverse amplitude; the first
    wave vector, with which the second rotates and scales; and the two phases.
    """
    reciprocal = 2.0 * specimen.pitch * np.linalg.inv(specimen.vectors).T  # of waves [pi/l]
    steps = np.array([(m, n) for m in range(-2, 3) for n in range(-2, 3)])
    centres = specimen.hole_centres
    hole = centres[np.argmin(np.linalg.norm(centres, axis=1))]
    families = []
    for point in ((1, 0), (0, 1), (1, 1)):
        waves = (0.5 * np.array(point) + steps) @ reciprocal
        lengths = np.round(np.linalg.norm(waves, axis=1), 9)
        first, _, second, _ = waves[np.lexsort((waves[:, 0] < 0, lengths))][:4]  # and opposites
        families.append(_two_waves(f"zone boundary {point}", first, second).moved(hole))
    return tuple(families)


def _two_waves(name: str, first: FloatArray, second: FloatArray) -> ModeFamily:
    """Two waves of given wave vectors [pi/l], the second transverse, phases zero at the origin."""
    n, m = local_frame(first)
    turn = np.column_stack([first, (-first[1], first[0])])  # maps (1, 0) to the first wave
    turn = np.column_stack([second, (-second[1], second[0])]) @ np.linalg.inv(turn)
    matrix, offset = np.zeros((2, PER_WAVE, 6)), np.zeros((2, PER_WAVE))
    offset[0, :2] = m
    matrix[0, :2, 0], matrix[1, :2, 1] = n, local_frame(second)[1]
    matrix[:, 2:4, 2:4] = np.eye(2), turn
    matrix[0, 4, 4] = matrix[1, 4, 5] = 1.0
    names, units = ("L1", "T2", "kx", "ky", "c1", "c2"), ("-",) * 4 + ("mm",) * 2
    start = np.array([0.0, T2, *first, 0.0, 0.0])
    return ModeFamily(name, matrix.reshape(-1, 6), offset.ravel(), start, names, units)


def two_waves_near(parameters: ArrayLike, ideal: ArrayLike, half_wavelength: float) -> FloatArray:
    """(6,) equivalent parameters of :func:`zone_boundary_families`, phases nearest to the ideal.

    Moving a wave's phase by l changes its sign: v takes up the first wave's, T2 the second's.
    """
    near, ideal = np.array(parameters, dtype=np.float64), np.asarray(ideal)
    turns = np.round((near[4:] - ideal[4:]) / half_wavelength)
    near[4:] -= turns * half_wavelength
    near[1] *= (-1.0) ** turns.sum()
    return near


def local_frame(vector: FloatArray) -> FloatArray:
    """(2, 2) rows: the direction of a vector, and that direction rotated by +90 degrees."""
    x, y = vector / np.linalg.norm(vector)
    return np.array([[x, y], [-y, x]])


FAMILIES: dict[str, Callable[[Specimen], tuple[ModeFamily, ...]]] = {
    "square": lambda specimen: (rotation_family(specimen),),
    "rectangular": lambda specimen: (rotation_family(specimen),),
    "triangular": zone_boundary_families,
}
"""Makers of the families of a specimen's modes, by its stacking."""


def free_family(waves: ArrayLike) -> ModeFamily:
    """Make the family in which every wave has its own five parameters.

    v_i already describes an amplitude common to all waves. Therefore the largest amplitude of
    ``waves``, (w, 5) initial A, B, kx, ky, c, is fixed. Raises InputError for any other shape.
    """
    full = np.atleast_2d(np.asarray(waves, dtype=np.float64))
    if full.ndim != 2 or full.shape[1] != PER_WAVE:
        raise InputError(f"expected waves of shape (w, 5), got {full.shape}")
    flat = full.ravel()
    amplitudes = np.where(np.tile([1, 1, 0, 0, 0], len(full)) == 1, np.abs(flat), -1.0)
    largest = int(np.argmax(amplitudes))
    kept = np.delete(np.arange(flat.size), largest)
    offset = np.zeros(flat.size)
    offset[largest] = flat[largest]
    names = [f"{p}{w + 1}" for w in range(len(full)) for p in ("A", "B", "kx", "ky", "c")]
    units = ["-", "-", "-", "-", "mm"] * len(full)
    return ModeFamily(
        f"{len(full)} wave{'s' * (len(full) != 1)}, free",
        np.eye(flat.size)[:, kept],
        offset,
        flat[kept],
        tuple(names[k] for k in kept),
        tuple(units[k] for k in kept),
    )


_LARGEST = 0.04
"""Maximum of ||phi|| [-]."""


@dataclass(frozen=True, eq=False)
class FourierMode:
    """A mode phi: a family, its half-wavelength, its scale and its support."""

    family: ModeFamily
    """The map from the mode's parameters to its waves."""
    half_wavelength: float
    """l [mm], half the wavelength at k = 1; the paper takes the size of the unit cell."""
    scale: float
    """The fixed scale s [-]."""
    taper: Taper

    def __post_init__(self) -> None:
        if not (self.half_wavelength > 0 and self.scale > 0):
            raise InputError(
                "expected a positive half-wavelength and scale, got "
                f"{self.half_wavelength} mm and {self.scale}"
            )

    @classmethod
    def scaled(cls, family: ModeFamily, half_wavelength: float, taper: Taper) -> FourierMode:
        """Choose the scale that makes max ||phi|| the paper's 0.04 [-] at the family's start.

        ``half_wavelength`` is l [mm], ``taper`` the mode's support. Raises InputError if the start
        gives a mode that is zero.
        """
        unit = cls(family, half_wavelength, 1.0, taper)
        # Twelve wavelengths at k = 1, sampled at 1/32 of one, hold the maximum of any family
        # with k near 1 to well under 1 %; the square one is hit exactly.
        t = np.asarray(half_wavelength * np.arange(-192, 193) / 16.0, dtype=np.float64)
        x, y = t[None, :], t[:, None]
        phi = unit._weighted_sum(family.start, x, y, np.ones_like(x), np.ones_like(y))
        largest = float(np.sqrt((phi**2).sum(axis=-1).max()))
        if not largest > 0:
            raise InputError(f"mode family {family.name!r}: the start gives a mode that is zero")
        return cls(family, half_wavelength, _LARGEST / largest, taper)

    def evaluate(self, parameters: ArrayLike, x: FloatArray, y: FloatArray) -> FloatArray:
        """(..., 2): phi [-] of parameters (p,), at positions x, y [mm] that broadcast together."""
        taper_x, taper_y = self.scale * self.taper.along_x(x), self.taper.along_y(y)
        return self._weighted_sum(parameters, x, y, taper_x, taper_y)

    def _weighted_sum(
        self, parameters: ArrayLike, x: FloatArray, y: FloatArray, of_x: FloatArray,
        of_y: FloatArray,
    ) -> FloatArray:  # fmt: skip
        """(..., 2): sum of (A, B) sin theta [-], times a function of x and one of y."""
        per_mm = np.pi / self.half_wavelength
        waves = self.family.waves(parameters)
        tx = [per_mm * kx * x for kx in waves[:, 2]]
        ty = [per_mm * (ky * y + c) for ky, c in waves[:, 3:]]
        # sin(tx + ty) in products of one-dimensional tables: on an open grid no sine per pixel.
        along_x = of_x * np.stack([*np.sin(tx), *np.cos(tx)])
        along_y = of_y * np.stack([*np.cos(ty), *np.sin(ty)])
        twice = np.vstack([waves, waves]).reshape(-1, PER_WAVE, *(1,) * np.ndim(y))
        components = np.empty((2, *np.broadcast_shapes(np.shape(x), np.shape(y))))
        for c in (0, 1):
            sum_of_products(along_x, twice[:, c] * along_y, components[c])
        return np.moveaxis(components, 0, -1)

    def sensitivities(self, parameters: ArrayLike, x: FloatArray, y: FloatArray) -> FloatArray:
        """(..., 2, m): derivatives of phi with respect to the mode's parameters."""
        x, y = np.broadcast_arrays(x, y)
        waves = self.family.waves(parameters)
        per_mm = np.pi / self.half_wavelength
        full = np.zeros((*x.shape, 2, PER_WAVE * len(waves)))
        for w, (_, _, kx, ky, c) in enumerate(waves):
            k, theta = PER_WAVE * w, per_mm * (kx * x + ky * y + c)
            full[..., 0, k] = full[..., 1, k + 1] = np.sin(theta)
            slope = per_mm * np.cos(theta)[..., None] * waves[w, :2]
            full[..., k + 2], full[..., k + 3] = slope * x[..., None], slope * y[..., None]
            full[..., k + 4] = slope
        envelope = self.scale * self.taper.along_x(x) * self.taper.along_y(y)
        return np.asarray(envelope[..., None, None] * full @ self.family.matrix)
