"""Design of a test: prediction of its errors by noise, before a specimen is made or photographed.

With S = du/da, a the unknowns, the derivative of the residual is h = ∇f F⁻¹ S, and the
Cramér–Rao bound of the unknowns' covariance is the inverse of

    M = Σ h' h / (s² (1 + 1/det F)) = G / (2 p⁴ s²) ∫ S' (F F')⁻¹ S / (1 + 1/det F) dA,

for noise s in each image. The image gradient is replaced by its mean square G [1/px²], assumed
isotropic, and the sum over pixels of size p by an integral over the material without its edges. No
image is made: M is an integral over the specimen times a factor. The integral depends on p only
through the pixels excluded along edges.

The model error w, which the ansatz can't describe, is not noise and not part of these errors.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from math import pi
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import qmc

from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.modes import PER_WAVE
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.uncertainty.covariance import propagated_sd
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.imaging.speckle.statistics import SpeckleStatistics
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError, require_within
from modeharvest.util.scaled_eigen import ScaledEigen
from modeharvest.util.typed import quantity
from modeharvest.validation.design_parameters import ModelStates
from modeharvest.validation.truth import rms

_POINTS = 16_384
"""Number of integration points, distributed evenly over the specimen's rectangle."""
_PER_CELL = 24
"""Points per pitch at which the ansatz is fitted to a simulated displacement."""
_HARMONICS = 20
Mapped = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""From points (k, 2) [mm] to F (k, 2, 2) of a state and derivatives of u (k, 2, n)."""
LARGEST = 0.04
"""Largest ||phi|| [-], by the normalisation of modes."""


@dataclass(frozen=True)
class DesignRanges:
    """Table ``[design.ranges]``: ascending values of each quantity, the others as in the case."""

    pixel_size: tuple[float, ...] = quantity(
        "pixel size", "mm", default=(0.005, 0.01, 0.02, 0.03, 0.04, 0.06)
    )
    speckle_width: tuple[float, ...] = quantity(
        "speckle in px, times the case's", default=(0.4, 0.7, 1.0, 1.5, 2.0, 3.0)
    )
    noise: tuple[float, ...] = quantity("read noise", default=(0.002, 0.005, 0.01, 0.02, 0.04))
    exposures: tuple[int, ...] = quantity("exposures averaged", default=(1, 2, 4, 8, 16, 32))
    light: tuple[float, ...] = quantity("light, times the case's", default=(0.125, 0.25, 0.5, 1.0))
    v0_degree: tuple[int, ...] = quantity("degree of v₀", default=(3, 4, 5, 6, 7))
    v_degree: tuple[int, ...] = quantity("degree of v₁", default=(4, 5, 6, 7, 8))
    strain: tuple[float, ...] = quantity("nominal strain", default=(0.1, 0.11, 0.12, 0.128))

    def __post_init__(self) -> None:
        for name, values in vars(self).items():
            if not values or values[0] <= 0 or any(np.diff(values) <= 0):
                what = f"design: expected rising positive values of {name}"
                raise InputError(f"{what}, got {list(values)}")


AXES = tuple(f.name for f in fields(DesignRanges))
NEEDED = AXES[:5]
"""Quantities whose value for a wanted error is computed."""
WANTED = ("v1_percent", "wave_number", "phase")


@dataclass(frozen=True)
class DesignOptions:
    """Table ``[design]`` of a case; InputError if a value is out of range."""

    v1_percent: float = 0.02
    wave_number: float = 3e-5
    phase: float = 1e-4
    parameter_percent: float = 1.0
    """Wanted values of the :class:`ExpectedErrors` of the same names."""
    parameters: tuple[str, ...] = ()
    """Parameters to be identified from images and forces of all states, named as in ``[unknowns]``
    of an identification; none by default."""
    force_sd: float = 0.0
    """Standard deviation of the load cell [N/mm]; 0: no load cell."""
    strain: float | None = None
    """Nominal strain of the state [-]; by default the last one of the case."""
    pattern: float | None = None
    """Largest displacement of a uniform pattern [mm], instead of a simulated solution's pattern."""
    noise: float = 0.01
    """Read noise of an exposure [fraction of full scale], if the case's sensor has no noise."""
    exposures: int = 1
    """Number of exposures averaged, for the reference and for each state."""
    map: tuple[str, str] = ("pixel_size", "noise")
    contour: str = "v1_percent"
    """Quantities varied over their ranges along the map's two axes, and the error it shows."""
    ranges: DesignRanges = field(default_factory=DesignRanges)

    def __post_init__(self) -> None:
        require_within("design: expected force_sd [N/mm]", self.force_sd, 0.0)
        for name in (*WANTED, "parameter_percent", "noise", "pattern", "strain"):
            if (value := getattr(self, name)) is not None:
                require_within(f"design: expected a {name}", value, 0.0, above=True)
        require_within("design: expected exposures", self.exposures, 1)
        if len({*self.map} & {*NEEDED}) < 2 or self.contour not in self.wanted:
            wanted = f"two of {list(NEEDED)} as map and one of {list(self.wanted)} as contour"
            raise InputError(f"design: expected {wanted}, got {self.map} and {self.contour!r}")

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the errors to compare with wanted values."""
        return (*WANTED, "parameter_percent") if self.parameters else WANTED


@dataclass(frozen=True)
class DesignSetup:
    """How a test is photographed and measured; fields as in :class:`DesignRanges`."""

    pixel_size: float
    noise: float
    v0_degree: int
    v_degree: int
    strain: float
    exposures: float = 1
    speckle_width: float = 1.0
    light: float = 1.0


@dataclass(frozen=True)
class ExpectedErrors:
    """Standard deviations due to noise, at the Cramér–Rao bound."""

    u_px: float = quantity("u, rms", "px")
    v1_px: float = quantity("v₁ max‖φ₁‖, rms", "px")
    v1_percent: float = quantity("v₁, rms", "% of its largest")
    wave_number: float = quantity("wave numbers, largest")
    phase: float = quantity("phases, largest", "mm")
    image_noise: float = quantity("noise of an image", "% of full scale")
    parameter_percent: float | None = quantity("parameters, largest", "% of the value")
    """Of parameters whose value isn't 0; None without parameters to identify."""
    w_px: float | None = quantity("model error, rms", "px")
    """Residual of the ansatz fitted to the simulated displacement; not part of the other errors.
    None without a simulation of the state: a given pattern, another strain."""
    parameter_sd: tuple[float, ...] = ()
    """Standard deviation of each parameter, in its unit."""


@dataclass(frozen=True, eq=False)
class PatternState:
    """A state of the specimen, described by an ansatz."""

    ansatz: Ansatz
    unknowns: FloatArray
    """(n,) unknowns of the ansatz."""
    w: float | None = None
    """Model error, rms per component [mm]; None if not known."""

    @classmethod
    def fitted(
        cls, ansatz: Ansatz, pitch: float, solution: Solution, strain: float, amplitude: float
    ) -> PatternState:
        """Fit an ansatz to a solution's snapshot, from an initial ``amplitude`` of v_i [mm]."""
        mesh, u = solution.mesh, solution.at(strain).displacement
        low, high, step = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0), pitch / _PER_CELL
        cols, rows = (int(n) for n in (high - low) / step)
        grid = PixelGrid(rows, cols, step, low[0] + 0.5 * step, high[1] - 0.5 * step)
        found = locate(mesh.nodes, mesh.cells, mesh.element, grid, "the solution's mesh", u)
        target, start = np.moveaxis(found.values, 0, -1), ansatz.initial_guess(strain, amplitude)
        fit = fit_displacement(target, grid, ansatz, start, found.mask)
        return cls(fit.ansatz, fit.unknowns, fit.residual_rms)

    def mapped(self, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        """F (k, 2, 2) and derivatives of u by the unknowns (k, 2, n) at points (k, 2) [mm]."""
        ansatz, a, F = self.ansatz, self.unknowns, np.tile(np.eye(2), (len(at), 1, 1))
        for k, step in enumerate(1e-5 * np.eye(2)):
            ahead, behind = (ansatz.displacement_at(a, at + s) for s in (step, -step))
            F[:, :, k] += (ahead - behind) / 2e-5
        return F, ansatz.sensitivities(a, *at.T[..., None])[:, 0]


def _weighted(F: FloatArray, S: FloatArray) -> FloatArray:
    """(k, 2, n) R S with R'R = (F F')⁻¹ / (1 + 1/det F)."""
    root = (1.0 + 1.0 / np.linalg.det(F)) ** -0.5
    return np.asarray(root[:, None, None] * np.linalg.solve(F, S))


@dataclass(frozen=True, eq=False)
class Design:
    """Computes the expected errors of a test; InputError without a solution or a pattern."""

    specimen: Specimen
    imaging: ImagingSpec
    correlation: SquareLatticeOptions
    options: DesignOptions
    strain: float
    """Nominal strain of the state designed for [-]."""
    solution: Solution | None = None
    """Simulated displacement of the state; ignored if the options give a pattern."""
    model: ModelStates | None = None
    """States of the model whose parameters are to be identified; None if there are none."""
    _known: dict[Any, Any] = field(default_factory=dict)
    """Cache of states, integrands, signals with errors, and speckles, by what they depend on."""

    def __post_init__(self) -> None:
        if self.options.pattern is None and self.solution is None:
            raise InputError("design: expected a solution or a pattern [mm], got neither")
        if self.options.parameters and self.model is None:
            raise InputError("design: expected a model whose parameters are sought, got none")

    @property
    def setup(self) -> DesignSetup:
        """The setup of the case."""
        sensor, how = self.imaging.sensor, self.correlation
        is_noisy = sensor.read_noise > 0.0 or sensor.full_well > 0.0
        noise = sensor.read_noise if is_noisy else self.options.noise
        degrees, exposures = (how.v0_degree, how.v_degree), self.options.exposures
        return DesignSetup(self.imaging.pixel_size, noise, *degrees, self.strain, exposures)

    @cached_property
    def critical(self) -> float:
        """Nominal critical strain of buckling [-]; infinite if unknown."""
        info = self.solution.info if self.solution and self.options.pattern is None else {}
        return float((info.get("critical") or {"strain": np.inf})["strain"])

    @cached_property
    def points(self) -> FloatArray:
        """(k, 2) points spread evenly over the specimen's rectangle, including holes [mm]."""
        half = np.array(self.specimen.half_size)
        return np.asarray((2.0 * qmc.Halton(2, scramble=False).random(_POINTS) - 1.0) * half)

    def used(self, margin: float) -> BoolArray:
        """(k,) True where a square of half side ``margin`` [mm] about the point is all material."""
        specimen, points = self.specimen, self.points
        number = specimen.nearest_hole(points)
        off = np.maximum(abs(points - specimen.hole_centres[number]) - margin, 0.0)
        off[:, 1] /= specimen.aspect
        is_in_hole = np.hypot(*off.T) <= 0.5 * specimen.diameters[number]
        is_inside = (abs(points) <= np.array(specimen.half_size) - margin).all(axis=1)
        return np.asarray(is_inside & ~is_in_hole)

    def state(self, setup: DesignSetup) -> PatternState:
        """The measured state, described by the setup's ansatz.

        For another strain than the design's, v0 is scaled in proportion to the strain and the
        pattern by a pitchfork's square-root law. InputError unless both exceed the critical strain.
        """
        degrees, own, least = (setup.v0_degree, setup.v_degree), self.strain, self.critical
        if degrees not in self._known:
            how = replace(self.correlation, brightness="none")
            how = replace(how, v0_degree=degrees[0], v_degree=degrees[1])
            ansatz, pattern = how.ansatz(self.specimen), self.options.pattern
            if pattern is not None or self.solution is None:
                even = ansatz.initial_guess(own, (pattern or 0.0) / LARGEST)
                self._known[degrees] = PatternState(ansatz, even)
            else:
                fit = self.specimen.pitch, self.solution, own, how.start_amplitude
                self._known[degrees] = PatternState.fitted(ansatz, *fit)
        found: PatternState = self._known[degrees]
        if setup.strain == own:
            return found
        if not min(setup.strain, own) > least:
            got = f"{least:.4g}, got {own:g} and {setup.strain:g}"
            raise InputError(f"design: expected strains beyond the critical {got}")
        a, slow = found.unknowns.copy(), found.ansatz.v0_slice(1).stop
        a[:slow] *= setup.strain / own
        a[slow : found.ansatz.phi_offset(0)] *= ((setup.strain - least) / (own - least)) ** 0.5
        return replace(found, unknowns=a, w=None)

    def signal(self, setup: DesignSetup) -> float:
        """G/(2 p⁴ s²), the factor of the integral in M [1/mm⁴]."""
        _, found = self.speckle(setup)
        contrast = self.imaging.sensor.gain * setup.light
        noise = self.image_noise(setup) * setup.pixel_size**2
        return 0.5 * contrast**2 * found.gradient / noise**2

    def image_noise(self, setup: DesignSetup) -> float:
        """Standard deviation of an image's noise by the sensor's model [fraction of full scale].

        InputError if the light saturates the sensor.
        """
        spec, speckle = self.speckle(setup)
        sensor = replace(self.imaging.sensor, read_noise=setup.noise)
        brightest = sensor.gain * setup.light * spec.bright + sensor.offset
        if brightest > sensor.saturation + 1e-9:
            got = f"below saturation, {sensor.saturation:g}, got {brightest:g}; make light smaller"
            raise InputError(f"design: expected a brightest grey level {got}")
        grey = sensor.gain * setup.light * speckle.mean
        return averaged_noise(sensor, self.imaging.bits, grey, setup.exposures)

    def expected(self, setup: DesignSetup) -> ExpectedErrors:
        """The expected errors of a setup: of u over the material, of v1 over the lattice."""
        key = "errors", setup.v0_degree, setup.v_degree, setup.strain, setup.pixel_size
        if key not in self._known:
            self._known[key] = self.signal(setup), self._errors(setup)
        signal, known = self._known[key]
        assert isinstance(known, ExpectedErrors)
        times, noise = (signal / self.signal(setup)) ** 0.5, 100.0 * self.image_noise(setup)
        errors = {name: times * getattr(known, name) for name in ("u_px", "v1_px", *WANTED)}
        if self.model is not None:
            sds = self.parameter_sd(setup)
            shares = [100.0 * s / abs(v) for s, v in zip(sds, self.model.values, strict=True) if v]
            largest = max(shares, default=0.0)
            known = replace(known, parameter_percent=largest, parameter_sd=tuple(sds))
        return replace(known, image_noise=noise, **errors)

    def parameter_sd(self, setup: DesignSetup) -> FloatArray:
        """(k,) standard deviations of the model's parameters.

        From images and forces of all states up to the setup's strain. InputError if the model has
        no state at that strain, or if a parameter is not observable.
        """
        model, last = self.model, setup.strain
        if model is None or last not in model.states:
            raise InputError(f"design: expected a model with a state at {last:g}, got none")
        key = "information", last, setup.pixel_size
        if key not in self._known:
            by = ((e, partial(model.mapped, e)) for e in model.photographed(last))
            self._known[key] = sum(self._information(("model", e), f, setup) for e, f in by)
        M = self.signal(setup) * self._known[key] + model.by_forces(last)
        sd = np.sqrt(np.diag(ScaledEigen.of(M).inverse()))
        if not np.isfinite(sd).all():
            lost = " and ".join(n for n, s in zip(model.names, sd, strict=True) if np.isinf(s))
            raise InputError(
                f"design: expected data that show every parameter, got none that determine {lost}; "
                "give the load cell's force_sd, or leave one out"
            )
        return np.asarray(sd)

    def _information(self, key: Any, mapped: Mapped, setup: DesignSetup) -> FloatArray:
        """(n, n) ∫ S' (F F')⁻¹ S / (1 + 1/det F) dA over the material used [mm²]."""
        if key not in self._known:
            inside, points = self.used(0.0), self.points
            found = _weighted(*mapped(points[inside]))
            self._known[key] = np.zeros((len(points), *found.shape[1:]))
            self._known[key][inside] = found
        used = self.used(self.correlation.edge_px * setup.pixel_size)
        H = self._known[key][used].reshape(-1, self._known[key].shape[-1])
        return np.asarray(H.T @ H * 4.0 * float(np.prod(self.specimen.half_size)) / _POINTS)

    def varied(self, axis: str) -> list[tuple[float, ExpectedErrors]]:
        """(value, errors) for one of :data:`AXES` varied over its range, all else as in the case.

        Impossible values are left out: too much light, too fine speckle, strains before buckling.
        """
        if axis not in self._known:
            self._known[axis] = []
            for value in getattr(self.options.ranges, axis):
                with suppress(InputError):
                    errors = self.expected(self._with({axis: value}))
                    self._known[axis].append((value, errors))
        return list(self._known[axis])

    def needed(self, axis: str, name: str) -> float | None:
        """The value of one of :data:`NEEDED` at which the error ``name`` is the wanted one.

        All else as in the case. If the whole range is good enough, its least demanding end; None if
        no value is.
        """
        wanted, values = getattr(self.options, name), [value for value, _ in self.varied(axis)]

        def excess(value: float) -> float:
            errors = self.expected(self._with({axis: float(np.exp(value))}))
            return float(getattr(errors, name) / wanted - 1.0)

        ends = [excess(np.log(value)) for value in values[:: max(1, len(values) - 1)]]
        if not ends or min(ends) > 0.0:
            return None
        if max(ends) <= 0.0:
            return float(values[0 if axis in ("exposures", "light") else -1])
        return float(np.exp(brentq(excess, *np.log([values[0], values[-1]]), xtol=1e-4)))

    def mapped(self, points: int = 33) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Values along the map's two axes, (points,) each; errors [second axis, first axis]."""
        (x, y), name = self.options.map, self.options.contour
        ranges = [[value for value, _ in self.varied(axis)] for axis in (x, y)]
        if min(map(len, ranges)) < 2:
            raise InputError(f"design: expected ranges of two values or more of {x} and {y}")
        first, second = (np.asarray(np.geomspace(v[0], v[-1], points), float) for v in ranges)
        setups = [[self._with({x: u, y: v}) for u in first] for v in second]
        errors = [[getattr(self.expected(setup), name) for setup in row] for row in setups]
        return first, second, np.array(errors)

    def _with(self, changed: dict[str, Any]) -> DesignSetup:
        return replace(self.setup, **changed)

    def covariance(self, setup: DesignSetup) -> FloatArray:
        """(n, n) bound of the unknowns' covariance; InputError if one isn't observable."""
        state = self.state(setup)
        key = "integrand", setup.v0_degree, setup.v_degree, setup.strain
        M = self.signal(setup) * self._information(key, state.mapped, setup)
        scale = np.sqrt(np.diag(M))
        if not (scale > 0.0).all():
            lost = state.ansatz.names[int(np.argmin(scale))]
            raise InputError(
                f"design: expected a pattern and pixels that show every unknown, got nothing of "
                f"{lost} at {setup.pixel_size:g} mm/px"
            )
        sizes = np.outer(scale, scale)
        return np.asarray(np.linalg.inv(M / sizes) / sizes)

    def _errors(self, setup: DesignSetup) -> ExpectedErrors:
        """The errors that follow from the covariance: all except the image noise."""
        state, covariance, p = self.state(setup), self.covariance(setup), setup.pixel_size
        ansatz, a, at = state.ansatz, state.unknowns, self.points[self.used(0.0)][::8]
        is_cellular = (abs(at) <= self.specimen.cellular_half_size).all(axis=1)
        x, y = at[is_cellular].T[..., None]
        basis, v = ansatz.v_space.basis(x, y)[:, 0], ansatz.v_slice(0)
        of_v1 = rms(propagated_sd(basis, covariance[v, v]))
        waves: FloatArray = np.zeros((1, PER_WAVE))
        for k, mode in enumerate(ansatz.modes):
            phi = ansatz.phi_slice(k)
            sd = propagated_sd(mode.family.matrix, covariance[phi, phi])
            waves = np.vstack([waves, sd.reshape(-1, PER_WAVE)])
        return ExpectedErrors(
            u_px=rms(propagated_sd(ansatz.sensitivities(a, *at.T[..., None]), covariance)) / p,
            v1_px=LARGEST * of_v1 / p,
            v1_percent=100.0 * of_v1 / float(abs(ansatz.v(0, a, x, y)).max()),
            wave_number=float(waves[:, 2:4].max()),
            phase=float(waves[:, 4].max()),
            image_noise=0.0,
            parameter_percent=None,
            w_px=None if state.w is None else state.w / p,
        )

    def speckle(self, setup: DesignSetup) -> tuple[SpeckleSpec, SpeckleStatistics]:
        """The case's speckle, coarser by the factor ``speckle_width``, and its statistics."""
        times = setup.speckle_width
        if ("speckle", times) not in self._known:
            spec, ink = self.imaging.speckle, self.imaging.speckle.ink
            if ink is not None:
                spread, blur = ink.standard_deviation / times, ink.blur_px * times
                ink = replace(ink, standard_deviation=spread, blur_px=blur)
            spread, blur = spec.standard_deviation / times, spec.blur_px * times
            spec = replace(spec, standard_deviation=spread, blur_px=blur, ink=ink)
            aperture = self.imaging.sensor.aperture
            spread = aperture.psf_px**2 + aperture.side_px**2 / 12.0  # Gaussian of equal variance
            found = SpeckleStatistics.of(spec, spread)
            self._known["speckle", times] = spec, found
        spec, found = self._known["speckle", times]
        return spec, found


def averaged_noise(sensor: Sensor, bits: int, grey: float, exposures: float) -> float:
    """Noise of the mean of several exposures [fraction of full scale]; ``grey``: above the offset.

    Averaging reduces rounding errors only if the noise exceeds them: in two exposures with noise of
    s levels, rounding errors have the correlation 6/pi² Σ exp(-4 pi² k² s²)/k².

    Source: B. Widrow, I. Kollár, Quantization Noise (Cambridge 2008), doi
    10.1017/CBO9780511754661.
    """
    constant, slope = sensor.noise_model(bits)
    step = 1.0 / (2**bits - 1)
    rounding = step**2 / 12.0
    random, k = constant - rounding + slope * grey, np.arange(1, _HARMONICS + 1)
    alike = 6.0 / pi**2 * float(np.sum(np.exp(-random * (2.0 * pi * k / step) ** 2) / k**2))
    kept = rounding * alike * (1.0 - 1.0 / exposures)
    return float(np.sqrt((random + rounding) / exposures + kept))
