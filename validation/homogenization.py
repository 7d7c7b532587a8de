"""Measured modes in homogenization: snapped to the lattice, and what their error bars do.

A mode from images is the lattice's own but for errors: its wave vectors and phases are snapped to
the lattice, because 1 % of a wave number makes ten of the critical strain. What is left of its
errors, those of its amplitudes, is propagated to critical strain, forces and energies by
differences.
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
"""Of a parameter [-], [mm]: smaller differences would be rounding."""
_LEAST_OVERLAP = 0.9
"""Of a mode with itself, its phases snapped [-]."""
_SAME = 1e-9
"""Of the largest wave number: patterns closer than that are one."""


@dataclass(frozen=True)
class StateNumbers:
    """A state of a specimen, homogenized or simulated directly."""

    nominal_strain: float
    """[-]."""
    force_N_per_mm: float
    """On the loaded edge, by thickness; compressive."""
    energy_N: float
    """Stored, by thickness."""
    branch: str = "primary"
    negative_eigenvalues: int | None = None
    """Of the tangent, of both scales where there are two; 0: stable, None: unknown."""
    force_sd_N_per_mm: float | None = None
    energy_sd_N: float | None = None
    """Standard deviations by the mode's larger covariance that is known; None where it has none."""
    force_sd_noise_N_per_mm: float | None = None
    energy_sd_noise_N: float | None = None
    force_sd_model_error_N_per_mm: float | None = None
    energy_sd_model_error_N: float | None = None
    """By noise, and by model error, noise included; None where that is not known."""


@dataclass(frozen=True)
class Response:
    """What a specimen does under load."""

    critical_strain: float | None
    """[-]; None where nothing becomes unstable."""
    states: tuple[StateNumbers, ...]
    """At ascending strains."""
    outcome: str = ""
    """How far it was followed."""
    critical_strain_sd: float | None = None
    critical_strain_sd_noise: float | None = None
    critical_strain_sd_model_error: float | None = None

    @property
    def values(self) -> FloatArray:
        """(1 + 2 states,) critical strain, forces and energies, in one row; NaN for none."""
        critical = np.nan if self.critical_strain is None else self.critical_strain
        rows = [(s.force_N_per_mm, s.energy_N) for s in self.states]
        return np.concatenate([[critical], np.reshape(rows, (-1, 2)).T.ravel()])

    def values_at(self, other: Response) -> FloatArray:
        """The same at the strains of another one; NaN at those that this one did not reach."""
        found = {s.nominal_strain: s for s in self.states}
        lost = StateNumbers(np.nan, np.nan, np.nan)
        states = tuple(found.get(s.nominal_strain, lost) for s in other.states)
        return replace(self, states=states).values


def direct_response(solution: Solution) -> Response:
    """That of a direct simulation; of two states at a strain the buckled one counts."""
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
    """In the lattice's coordinates, a hole's centre at the origin, as it was found."""
    snapped: PlaneWaves
    """With wave vectors and phases of the lattice."""

    @classmethod
    def of(
        cls, mode: FourierMode, parameters: ArrayLike, specimen: Specimen, vectors: ArrayLike
    ) -> LatticeMode:
        """Of a Fourier mode of a specimen; ``vectors`` (2, 2) of the RVE as rows [mm].

        Phases are kept at the specimen's middle, where the origin is. InputError where a wave
        vector is farther than a tenth from one that repeats on the RVE, or where snapping the
        phases leaves another pattern.
        """
        waves, centres = mode.family.waves(parameters), specimen.hole_centres
        hole = centres[int(np.argmin(np.linalg.norm(centres, axis=1)))]  # the first of several
        found = PlaneWaves.of_sines(waves, mode.half_wavelength, mode.scale).moved(-hole)
        return cls.of_waves(found, vectors, -hole)

    @classmethod
    def of_waves(
        cls, found: PlaneWaves, vectors: ArrayLike, about: ArrayLike = (0.0, 0.0)
    ) -> LatticeMode:
        """Of waves in the lattice's coordinates, whose phases are kept at a point; as ``of``."""
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
        """(w,) changes of the wave vectors by snapping, over their lengths [-]."""
        k, to = self.measured.vectors, self.snapped.vectors
        return np.asarray(np.linalg.norm(to - k, axis=1) / np.linalg.norm(k, axis=1))

    def deviation(self, mode: FourierMode, covariance: FloatArray) -> float:
        """By how many standard deviations snapping changes a wave vector, at most of all [-].

        ``mode``: that was measured, ``covariance`` (m, m): of its parameters.
        """
        slopes = mode.family.matrix.reshape(self.measured.vectors.shape[0], PER_WAVE, -1)[:, 2:4]
        change = (self.snapped.vectors - self.measured.vectors) * mode.half_wavelength / np.pi
        inverse = np.linalg.pinv(slopes @ covariance @ slopes.swapaxes(1, 2), hermitian=True)
        return float(np.sqrt(np.einsum("wi,wij,wj->w", change, inverse, change)).max())

    def is_same(self, other: LatticeMode) -> bool:
        """Whether snapping has made one pattern of both."""
        mine, its = (np.vstack(list(vars(mode.snapped).values())) for mode in (self, other))
        return bool(np.abs(mine - its).max() <= _SAME * np.abs(mine).max())


@dataclass(frozen=True, eq=False)
class ModeParameters:
    """The parameters of measured modes with their covariances, whose names they have."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: FloatArray
    """(m,)."""
    by_noise: FloatArray
    by_model_error: FloatArray | None = None
    """(m, m) covariances by noise, and by the residual cell by cell, noise included; None where
    that is not known: a result without its images, a specimen of few cells."""
    of_fields: FloatArray | None = None
    """(n, n) the larger one of all the correlation's unknowns, v0's and v1's among them."""
    deviations: tuple[float, ...] = ()
    """Of each mode by how many of its standard deviations snapping changed a wave vector, at most;
    none where the model error is not known."""

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> ModeParameters:
        """From plain values."""
        made = {"names": tuple, "units": tuple, "deviations": tuple}
        given = {k: v for k, v in content.items() if v is not None}
        known: dict[str, Any] = {k: made.get(k, np.array)(v) for k, v in given.items()}
        return cls(**known)

    @property
    def covariance(self) -> FloatArray:
        """The larger one that is known."""
        return self.by_noise if self.by_model_error is None else self.by_model_error

    @property
    def steps(self) -> FloatArray:
        """(m,) changes by which differences are taken: a standard deviation, or a little more."""
        return np.asarray(np.maximum(_LEAST_STEP, np.sqrt(np.diag(self.covariance))))


@dataclass(frozen=True, eq=False)
class MeasuredModes:
    """How snapped modes were measured, and how far their waves are known."""

    parameters: ModeParameters
    """Of all of them."""
    modes: Callable[[FloatArray], Sequence[LatticeMode]]
    """From parameters (m,), snapped."""

    def derivatives(self, centre: ArrayLike) -> list[FloatArray]:
        """(4 w, m) of each mode: its cosine and sine amplitudes, row by row, by the parameters.

        Of waves whose origin is at a centre in the lattice's coordinates; by differences.
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
    """What a parameter of the mode does to the response."""

    name: str
    unit: str
    value: float
    sd_noise: float | None
    sd_model_error: float | None
    """Of the parameter, by its two causes."""
    snapped: bool
    """Whether snapping to the lattice has taken away all that the parameter does."""
    critical_strain: float | None
    force: tuple[float | None, ...]
    energy: tuple[float | None, ...]
    """Derivatives of the critical strain and of each state's force [N/mm] and energy [N]; None
    where the specimen with the parameter changed did not come so far."""


def with_errors(
    response: Response, measured: MeasuredModes,
    predicted: Callable[[Sequence[LatticeMode]], Response],
) -> tuple[Response, tuple[ParameterEffect, ...]]:  # fmt: skip
    """Propagate the covariance of the modes' parameters to the response that they themselves make.

    ``predicted``: the response with modes; called once for each parameter that snapping leaves.
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
