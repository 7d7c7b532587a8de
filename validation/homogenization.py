"""Measured modes in homogenization: snapping to the lattice, propagation of error bars.

A mode measured in images is a mode of the lattice except for errors. Its wave vectors and phases
are snapped to the lattice, because an error of 1 % of a wave number changes the critical strain by
10 %. The remaining errors, those of the amplitudes, are propagated to critical strain, forces and
energies by finite differences.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modeharvest.fem.field import Solution
from modeharvest.fem.lattice.micromorphic.patterns import PlaneWaves, snapped
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.modes import PER_WAVE, FourierMode
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError

_LEAST_STEP = 1e-3
"""Least difference step of a parameter [-, mm]: smaller steps would give rounding errors."""
_LEAST_OVERLAP = 0.9
"""Least overlap of a mode with itself after snapping its phases [-]."""
_SAME = 1e-9
"""Relative difference below which two patterns are the same."""


@dataclass(frozen=True)
class StateNumbers:
    """A state of a specimen, homogenized or simulated directly."""

    nominal_strain: float
    """Nominal strain [-]."""
    force_N_per_mm: float
    """Compressive force on the loaded edge per thickness."""
    energy_N: float
    """Stored energy per thickness."""
    branch: str = "primary"
    negative_eigenvalues: int | None = None
    """Negative eigenvalues of the tangent (of both scales if two); 0: stable, None: unknown."""
    force_sd_N_per_mm: float | None = None
    energy_sd_N: float | None = None
    """Standard deviations by the larger known covariance of the modes; None without covariance."""
    force_sd_noise_N_per_mm: float | None = None
    energy_sd_noise_N: float | None = None
    force_sd_model_error_N_per_mm: float | None = None
    energy_sd_model_error_N: float | None = None
    """Standard deviations by noise, and by model error including noise; None if unknown."""


@dataclass(frozen=True)
class Response:
    """Response of a specimen to its load."""

    critical_strain: float | None
    """Critical strain [-]; None if there is no instability."""
    states: tuple[StateNumbers, ...]
    """States at ascending strains."""
    outcome: str = ""
    """How far the path was followed."""
    critical_strain_sd: float | None = None
    critical_strain_sd_noise: float | None = None
    critical_strain_sd_model_error: float | None = None

    @property
    def values(self) -> FloatArray:
        """(1 + 2 states,) critical strain, forces, energies; NaN without a critical strain."""
        critical = np.nan if self.critical_strain is None else self.critical_strain
        rows = [(s.force_N_per_mm, s.energy_N) for s in self.states]
        return np.concatenate([[critical], np.reshape(rows, (-1, 2)).T.ravel()])

    def values_at(self, other: Response) -> FloatArray:
        """``values`` at the strains of another response; NaN at strains not reached."""
        found = {s.nominal_strain: s for s in self.states}
        lost = StateNumbers(np.nan, np.nan, np.nan)
        states = tuple(found.get(s.nominal_strain, lost) for s in other.states)
        return replace(self, states=states).values


def direct_response(solution: Solution) -> Response:
    """The response of a direct simulation; of two states at a strain the buckled one is used."""
    states = {}
    for s in sorted(solution.snapshots, key=lambda s: s.branch != "primary"):
        numbers = s.nominal_strain, s.reaction, s.energy, s.branch, s.negative_pivots
        states[s.nominal_strain] = StateNumbers(*numbers)
    critical: Mapping[str, Any] = solution.info.get("critical") or {}
    ordered = tuple(states[strain] for strain in sorted(states))
    return Response(critical.get("strain"), ordered, str(solution.info.get("outcome", "complete")))


@dataclass(frozen=True, eq=False)
class LatticeMode:
    """A mode of a specimen as a pattern of its infinite lattice."""

    measured: PlaneWaves
    """As measured, in the lattice's coordinates: the origin is the centre of a hole."""
    snapped: PlaneWaves
    """With the wave vectors and phases snapped to the lattice."""

    @classmethod
    def of(
        cls, mode: FourierMode, parameters: ArrayLike, specimen: Specimen, vectors: ArrayLike
    ) -> LatticeMode:
        """From a Fourier mode of a specimen; ``vectors`` (2, 2): lattice vectors of the RVE [mm].

        Phases are kept at the specimen's centre, its origin. InputError if a wave vector differs
        by more than a tenth from one that is periodic on the RVE, or if snapping the phases changes
        the pattern.
        """
        waves, centres = mode.family.waves(parameters), specimen.hole_centres
        hole = centres[int(np.argmin(np.linalg.norm(centres, axis=1)))]  # the first if several
        found = PlaneWaves.of_sines(waves, mode.half_wavelength, mode.scale).moved(-hole)
        return cls.of_waves(found, vectors, -hole)

    @classmethod
    def of_waves(
        cls, found: PlaneWaves, vectors: ArrayLike, about: ArrayLike = (0.0, 0.0)
    ) -> LatticeMode:
        """As :meth:`of`, from waves in the lattice's coordinates; phases stay at ``about`` [mm]."""
        mode_found = cls(found, snapped(found, vectors, about, inversion_centre=(0.0, 0.0)))
        as_found = snapped(found, vectors, about)
        a, b = (np.stack([w.cosine, w.sine]).ravel() for w in (mode_found.snapped, as_found))
        overlap = a @ b / (np.linalg.norm(a) * np.linalg.norm(b))
        if not overlap >= _LEAST_OVERLAP:
            raise InputError(
                "mode: expected phases of the lattice, its holes at points of symmetry, got a "
                f"pattern of which snapping them leaves {100 * overlap:.0f} % (overlap); take one "
                "that is observable, measured with the specimen's middle at the origin"
            )
        return mode_found

    @property
    def wave_change(self) -> FloatArray:
        """(w,) changes of the wave vectors by snapping, relative to their lengths [-]."""
        k, to = self.measured.vectors, self.snapped.vectors
        return np.asarray(np.linalg.norm(to - k, axis=1) / np.linalg.norm(k, axis=1))

    def deviation(self, mode: FourierMode, covariance: FloatArray) -> float:
        """Largest change of a wave vector by snapping, in standard deviations [-].

        ``mode``: the measured mode; ``covariance`` (m, m): of its parameters.
        """
        slopes = mode.family.matrix.reshape(self.measured.vectors.shape[0], PER_WAVE, -1)[:, 2:4]
        change = (self.snapped.vectors - self.measured.vectors) * mode.half_wavelength / np.pi
        inverse = np.linalg.pinv(slopes @ covariance @ slopes.swapaxes(1, 2), hermitian=True)
        return float(np.sqrt(np.einsum("wi,wij,wj->w", change, inverse, change)).max())

    def is_same(self, other: LatticeMode) -> bool:
        """Whether both modes have the same pattern after snapping."""
        mine, its = (np.vstack(list(vars(mode.snapped).values())) for mode in (self, other))
        return bool(np.abs(mine - its).max() <= _SAME * np.abs(mine).max())


@dataclass(frozen=True, eq=False)
class ModeParameters:
    """The parameters of measured modes with their covariances."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: FloatArray
    """(m,) parameters."""
    by_noise: FloatArray
    by_model_error: FloatArray | None = None
    """(m, m) covariances by noise, and by model error including noise (from the residual by unit
    cells). The latter is None if unknown: a result without its images, a specimen of few cells."""
    of_fields: FloatArray | None = None
    """(n, n) the larger covariance of all unknowns of the correlation, including v0 and v1."""
    deviations: tuple[float, ...] = ()
    """For each mode the largest change of a wave vector by snapping, in standard deviations; empty
    if the model error is unknown."""

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> ModeParameters:
        """From plain values, as read from JSON."""
        made = {"names": tuple, "units": tuple, "deviations": tuple}
        given = {k: v for k, v in content.items() if v is not None}
        known: dict[str, Any] = {k: made.get(k, np.array)(v) for k, v in given.items()}
        return cls(**known)

    @property
    def covariance(self) -> FloatArray:
        """The larger covariance that is known."""
        return self.by_noise if self.by_model_error is None else self.by_model_error

    @property
    def steps(self) -> FloatArray:
        """(m,) steps of finite differences: a standard deviation, at least _LEAST_STEP."""
        return np.asarray(np.maximum(_LEAST_STEP, np.sqrt(np.diag(self.covariance))))


@dataclass(frozen=True, eq=False)
class MeasuredModes:
    """Snapped modes as functions of their measured parameters."""

    parameters: ModeParameters
    """Parameters of all modes."""
    modes: Callable[[FloatArray], Sequence[LatticeMode]]
    """The snapped modes for given parameters (m,)."""

    def derivatives(self, centre: ArrayLike) -> list[FloatArray]:
        """For each mode (4 w, m): derivatives of its cosine and sine amplitudes by the parameters.

        The waves' origin is at ``centre`` in the lattice's coordinates. By finite differences.
        """

        def amplitudes(values: FloatArray) -> list[FloatArray]:
            waves = [mode.snapped.moved(-np.asarray(centre)) for mode in self.modes(values)]
            return [np.concatenate([w.cosine.ravel(), w.sine.ravel()]) for w in waves]

        values, steps = self.parameters.values, self.parameters.steps
        changed = [amplitudes(values + step) for step in np.diag(steps)]
        return [
            (np.stack([there[k] for there in changed], axis=1) - here[:, None]) / steps
            for k, here in enumerate(amplitudes(values))
        ]


@dataclass(frozen=True)
class ParameterEffect:
    """Effect of a parameter of a mode on the response."""

    name: str
    unit: str
    value: float
    sd_noise: float | None
    sd_model_error: float | None
    """Standard deviations of the parameter by noise and by model error."""
    snapped: bool
    """Whether the parameter has no effect after snapping to the lattice."""
    critical_strain: float | None
    force: tuple[float | None, ...]
    energy: tuple[float | None, ...]
    """Derivatives of the critical strain and of each state's force [N/mm] and energy [N]; None
    where the path with the changed parameter did not reach the state."""


def with_errors(
    response: Response, measured: MeasuredModes,
    predicted: Callable[[Sequence[LatticeMode]], Response],
) -> tuple[Response, tuple[ParameterEffect, ...]]:  # fmt: skip
    """Propagate the covariance of the modes' parameters to the response of the measured modes.

    ``predicted``: gives the response for modes; called for each parameter that isn't snapped away.
    """
    parameters, modes = measured.parameters, measured.modes
    m, here = len(parameters.values), modes(parameters.values)
    J, is_snapped = np.zeros((len(response.values), m)), np.zeros(m, bool)
    both = parameters.by_noise, parameters.by_model_error
    sds = [np.full(m, np.nan) if C is None else np.sqrt(np.diag(C)) for C in both]
    for k, step in enumerate(np.diag(parameters.steps)):
        there = modes(parameters.values + step)
        is_snapped[k] = all(a.is_same(b) for a, b in zip(here, there, strict=True))
        if not is_snapped[k]:
            J[:, k] = (predicted(there).values_at(response) - response.values) / step[k]
    count = len(response.states)
    causes = {"": parameters.covariance, "_noise": both[0], "_model_error": both[1]}
    for cause, C in causes.items():
        if C is not None:
            sd: list[Any] = [_known(sd) for sd in np.sqrt(np.einsum("ik,kl,il->i", J, C, J))]
            force, energy = f"force_sd{cause}_N_per_mm", f"energy_sd{cause}_N"
            pairs = zip(response.states, sd[1 : 1 + count], sd[1 + count :], strict=True)
            states = tuple(replace(s, **{force: f, energy: e}) for s, f, e in pairs)
            response = replace(response, states=states, **{f"critical_strain_sd{cause}": sd[0]})
    effects = tuple(
        ParameterEffect(
            name=parameters.names[k], unit=parameters.units[k], value=float(parameters.values[k]),
            sd_noise=_known(sds[0][k]), sd_model_error=_known(sds[1][k]),
            snapped=bool(is_snapped[k]), critical_strain=_known(J[0, k]),
            force=tuple(map(_known, J[1 : 1 + count, k])),
            energy=tuple(map(_known, J[1 + count :, k])),
        )
        for k in range(m)
    )  # fmt: skip
    return response, effects


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
