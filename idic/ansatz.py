"""The ansatz u(x) = v0(x) + sum_i v_i(x) phi_i(x): unknowns, fields, sensitivities.

Optionally also a gain and an offset between the images' grey levels.

Source: the paper's Eq. (4). Everything is in mm in the physical frame (x right, y up).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.chebyshev import Box, Brightness, ChebyshevField
from modeharvest.idic.modes import FAMILIES, FourierMode, ModeFamily, Taper
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError


def ansatz_from_dict(content: Mapping[str, Any]) -> Ansatz:
    """Rebuild an ansatz from the dictionary that :func:`~modeharvest.util.typed.to_plain` made."""
    modes = (
        FourierMode(
            ModeFamily(**mode["family"]),
            mode["half_wavelength"],
            mode["scale"],
            Taper(Box(**mode["taper"]["cellular"]), mode["taper"]["width"]),
        )
        for mode in content["modes"]
    )
    brightness = Brightness(**content.get("brightness", {}))
    degrees = content["v0_degree"], content["v_degree"]
    return Ansatz(Box(**content["domain"]), tuple(modes), *degrees, brightness)


HIGHEST_DEGREE = 20
"""Highest total degree of v0 and v_i: 231 unknowns per field; above it they resolve the pattern."""


def require_degrees(v0_degree: int, v_degree: int) -> None:
    """Raise InputError unless the degrees of v0 and v_i are within their limits."""
    if not (1 <= v0_degree <= HIGHEST_DEGREE and 0 <= v_degree <= HIGHEST_DEGREE):
        raise InputError(
            f"expected v0_degree from 1 and v_degree from 0 to {HIGHEST_DEGREE}, got {v0_degree} "
            f"and {v_degree}"
        )


@dataclass(frozen=True)
class AnsatzOptions:
    """Polynomial degrees of an ansatz; the paper's by default."""

    v0_degree: int = 5
    v_degree: int = 6
    """Total degrees of the Chebyshev polynomials of v0 and of every v_i."""
    brightness: int | str = "none"
    """Total degree, 0 to 6, of gain and offset between the images' grey levels; or "none"."""

    def __post_init__(self) -> None:
        require_degrees(self.v0_degree, self.v_degree)
        Brightness.of(self.brightness)  # checks it


_Degrees = TypeVar("_Degrees", bound="AnsatzOptions | Ansatz")
FEWEST_CELLS = 3
"""Fewest cells across a pattern: with fewer, its mode is off by percents whatever the degrees."""


def for_cells(degrees: _Degrees, specimen: Box, pattern: Box, cell_size: float) -> _Degrees:
    """Lower the degrees of v0 and v_i to what boxes [mm] only a few cells wide can determine.

    The limit is 2 (n - 1) for n cells across the box, but at least 2: above it, v1 and the mode's
    parameters can replace one another (``benchmarks/few_cells.py``).
    """
    v0, v = (max(2, 2 * round(cells_across(box, cell_size)) - 2) for box in (specimen, pattern))
    return replace(degrees, v0_degree=min(v0, degrees.v0_degree), v_degree=min(v, degrees.v_degree))


def cells_across(box: Box, cell_size: float) -> float:
    """A box's shorter side over a cell size [mm]."""
    return 2.0 * min(box.half) / cell_size


@dataclass(frozen=True, eq=False)
class Ansatz:
    """Slow field v0, amplitudes v_i and modes phi_i, and the order of their unknowns.

    The unknowns are, in this order: v0 along x, v0 along y [mm], v_1 ... v_n [mm], then the
    parameters of phi_1 ... phi_n, then those of the brightness.
    """

    domain: Box
    """Box on which the Chebyshev polynomials are defined [mm]: the whole specimen."""
    modes: tuple[FourierMode, ...] = ()
    """phi_1 ... phi_n; none gives a plain global DIC with v0 alone."""
    v0_degree: int = 5
    v_degree: int = 6
    """Total degrees of v0 (5 in the paper) and of every v_i (6)."""
    brightness: Brightness = field(default_factory=Brightness)
    """Gain and offset of the grey levels, if they are unknowns too; by default they are not."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "modes", tuple(self.modes))
        require_degrees(self.v0_degree, self.v_degree)

    @classmethod
    def on(
        cls,
        domain: Box,
        families: Sequence[tuple[ModeFamily, Box]],
        cell_size: float,
        options: AnsatzOptions | None = None,
    ) -> Ansatz:
        """Make an ansatz of mode families, each on a part of the domain [mm].

        Each family comes with the box [mm] of the cellular part, outside which its mode tapers off
        over half a unit cell. ``cell_size`` is l [mm]; the degrees are the paper's by default.
        """
        how = options or AnsatzOptions()
        modes = tuple(
            FourierMode.scaled(family, cell_size, Taper(cellular, 0.5 * cell_size))
            for family, cellular in families
        )
        return cls(domain, modes, how.v0_degree, how.v_degree, Brightness.of(how.brightness))

    @classmethod
    def square(
        cls, specimen: Specimen, *, fixed_mode: bool = False, options: AnsatzOptions | None = None
    ) -> Ansatz:
        """Call :meth:`of_specimen`; raises InputError unless the stacking is square."""
        if specimen.stacking != "square":
            raise InputError(
                f"Ansatz.square: expected a specimen in square stacking, got {specimen.stacking} "
                "stacking; take Ansatz.of_specimen"
            )
        return cls.of_specimen(specimen, fixed_mode=fixed_mode, options=options)

    @classmethod
    def of_specimen(
        cls, specimen: Specimen, *, fixed_mode: bool = False, options: AnsatzOptions | None = None
    ) -> Ansatz:
        """Make the ansatz with a specimen's modes; in square stacking the paper's 77 unknowns.

        The initial modes are those of the infinite lattice (``idic.modes.FAMILIES``), with phases
        such that they fit the specimen's holes: [1, 1, 1, -1, 1, 0, 0] in square stacking with an
        even number of holes along x and along y. The origin is the specimen's centre.

        fixed_mode : Keep the modes fixed at the ideal pattern; for images that show no pattern from
            which they could be found.
        options : Degrees; the paper's by default.
        """
        (a, b), (width, height) = specimen.cellular_half_size, specimen.half_size
        families = FAMILIES[specimen.stacking](specimen)
        modes = [(f.fixed() if fixed_mode else f, Box(-a, a, -b, b)) for f in families]
        domain = Box(-width, width, -height, height)
        return cls.on(domain, modes, specimen.pitch, options)

    @property
    def v0_space(self) -> ChebyshevField:
        """The polynomial space of each component of v0."""
        return ChebyshevField(self.domain, self.v0_degree)

    @property
    def v_space(self) -> ChebyshevField:
        """The polynomial space of every v_i."""
        return ChebyshevField(self.domain, self.v_degree)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.phi_offset(len(self.modes)) + self.brightness.size

    @property
    def fixed(self) -> bool:
        """Whether no mode has parameters among the unknowns."""
        return not any(mode.family.size for mode in self.modes)

    def v0_slice(self, component: int) -> slice:
        """Slice of the unknowns that holds v0 along x (0) or y (1)."""
        n = self.v0_space.size
        return slice(component * n, (component + 1) * n)

    def v_slice(self, i: int) -> slice:
        """Slice of the unknowns that holds v of the mode number i (from 0)."""
        first = 2 * self.v0_space.size + i * self.v_space.size
        return slice(first, first + self.v_space.size)

    def phi_offset(self, i: int) -> int:
        """Count the unknowns before the parameters of the mode number i (from 0)."""
        slow = 2 * self.v0_space.size + len(self.modes) * self.v_space.size
        return slow + sum(mode.family.size for mode in self.modes[:i])

    def phi_slice(self, i: int) -> slice:
        """Slice of the unknowns that holds the parameters of the mode number i (from 0)."""
        return slice(self.phi_offset(i), self.phi_offset(i + 1))

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each unknown: ``v0x[2,1]``, ``v1[0,3]``, ``phi1.a4``, ``gain[0,0]``."""
        v0 = [f"v0{c}[{i},{j}]" for c in "xy" for i, j in self.v0_space.orders]
        v = [f"v{k + 1}[{i},{j}]" for k in range(len(self.modes)) for i, j in self.v_space.orders]
        phi = [f"phi{k + 1}.{name}" for k, m in enumerate(self.modes) for name in m.family.names]
        return (*v0, *v, *phi, *self.brightness.names)

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each unknown."""
        slow = ("mm",) * self.phi_offset(0)
        modes = tuple(unit for mode in self.modes for unit in mode.family.units)
        return slow + modes + self.brightness.units

    def checked(self, a: ArrayLike) -> FloatArray:
        """Return the unknowns as (size,) floats; raises InputError if the size is wrong."""
        a = np.asarray(a, dtype=np.float64)
        if a.shape != (self.size,):
            raise InputError(
                f"expected {self.size} unknowns for this ansatz, got an array of shape {a.shape}"
            )
        if not np.isfinite(a).all():
            bad = int(np.argmin(np.isfinite(a)))
            raise InputError(f"expected finite unknowns, got {a[bad]} for {self.names[bad]}")
        return a

    def initial_guess(self, strain: float = 0.0, amplitude: float = 1.0) -> FloatArray:
        """Make the initial guess of a correlation, (size,) unknowns, as in the paper.

        strain : Nominal compression along x [-], the shortening over the length of the cellular
            part; v0x = -strain (x - centre), so that the ends of the cellular part move by half the
            shortening. Positive in compression.
        amplitude : Constant initial value of every v_i [mm]; not zero, because the modes would not
            be observable. 1 mm with max ||phi|| = 0.04 is a pattern of 40 um.
        """
        a = np.zeros(self.size)
        a[self.v0_slice(0)][1] = -strain * self.domain.half[0]
        for i, mode in enumerate(self.modes):
            a[self.v_slice(i)][0] = amplitude
            a[self.phi_slice(i)] = mode.family.start
        return a

    def v0(self, a: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """(..., 2): the slow field [mm]; positions as in :meth:`displacement`."""
        a, (x, y) = self.checked(a), open_grid(x, y)
        space = self.v0_space
        # Each component in a contiguous array: faster to work on.
        components = np.empty((2, *np.broadcast_shapes(x.shape, y.shape)))
        for c in (0, 1):
            space.evaluate(a[self.v0_slice(c)], x, y, components[c])
        return np.moveaxis(components, 0, -1)

    def v(self, i: int, a: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """(...): the amplitude of the mode number i (from 0) [mm]."""
        a, (x, y) = self.checked(a), open_grid(x, y)
        return self.v_space.evaluate(a[self.v_slice(i)], x, y)

    def phi(self, i: int, a: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """(..., 2): the mode number i (from 0) [-]."""
        a, (x, y) = self.checked(a), open_grid(x, y)
        return self.modes[i].evaluate(a[self.phi_slice(i)], x, y)

    def fluctuation(self, i: int, a: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """(..., 2): v_i phi_i of the mode number i (from 0) [mm]."""
        found = self.phi(i, a, x, y)
        found *= self.v(i, a, x, y)[..., None]
        return found

    def displacement(self, a: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """(..., 2): the whole displacement [mm] at unknowns ``a`` (size,).

        x, y : Two axes [mm], one-dimensional both (``grid.x`` and ``grid.y``), which give an array
            (len(y), len(x), 2) fast; or arrays of any other shapes that broadcast together.
        """
        total = self.v0(a, x, y)
        for i in range(len(self.modes)):
            total += self.fluctuation(i, a, x, y)
        return total

    def displacement_at(self, a: ArrayLike, points: ArrayLike) -> FloatArray:
        """(..., 2): the whole displacement [mm] at points (..., 2) [mm]."""
        points = np.asarray(points, dtype=np.float64)
        at = self.displacement(a, points[..., None, 0], points[..., None, 1])
        return np.asarray(at[..., 0, :])

    def gain_and_offset(
        self, a: ArrayLike, x: ArrayLike, y: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """1 + b [-] and c [grey levels]: f = (1 + b) g(x + u) + c; 1 and 0 where not unknowns."""
        a, (x, y) = self.checked(a), open_grid(x, y)
        return self.brightness.evaluate(self.domain, a[self.phi_offset(len(self.modes)) :], x, y)

    def sensitivities(self, a: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """(..., 2, size): derivatives of the displacement with respect to the unknowns.

        Zero for gain and offset. For tests and few points; the correlation never forms this array.
        """
        a, (x, y) = self.checked(a), open_grid(x, y)
        x, y = np.broadcast_arrays(x, y)
        result = np.zeros((*x.shape, 2, self.size))
        for c in (0, 1):
            result[..., c, self.v0_slice(c)] = self.v0_space.basis(x, y)
        for i, mode in enumerate(self.modes):
            part = self.phi_slice(i)
            phi, v = mode.evaluate(a[part], x, y), self.v_space.evaluate(a[self.v_slice(i)], x, y)
            result[..., self.v_slice(i)] = phi[..., None] * self.v_space.basis(x, y)[..., None, :]
            result[..., part] = v[..., None, None] * mode.sensitivities(a[part], x, y)
        return result


def open_grid(x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Turn two one-dimensional axes into an open grid; return anything else unchanged."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if x.ndim == 1 and y.ndim == 1:
        return x[None, :], y[:, None]
    return x, y
