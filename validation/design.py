"""Design of a test: the errors that its noise will make, before anything is cut or photographed.

With S the derivatives of the displacement by the unknowns, those of the residual are h = ∇f F⁻¹ S,
and the Cramér–Rao bound of the unknowns is the inverse of

    M = Σ h' h / (s² (1 + 1/det F)) = G / (2 p⁴ s²) ∫ S' (F F')⁻¹ S / (1 + 1/det F) dA,

for noise s of either image. In place of an image's gradient stands its mean square G [1/px²],
alike in all directions, and in place of the pixels, of size p, the material without its edges. No
image is made: M is an integral over the specimen times a number, and only the pixels that are left
out along edges make the integral depend on p.

What the ansatz can't describe, w, is no noise, and no part of these errors.
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
"""At which the integrand is taken, evenly over the specimen's rectangle."""
_PER_CELL = 24
"""Places a pitch at which a simulated displacement is fitted by the ansatz."""
_HARMONICS = 20
Mapped = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""F (k, 2, 2) of a state and derivatives of u (k, 2, n), at points (k, 2) [mm]."""
LARGEST = 0.04
"""Of ||phi|| [-], as modes are scaled."""


@dataclass(frozen=True)
class DesignRanges:
    """Table ``[design.ranges]``: what each is varied over, all else as in the case; rising."""

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
"""Of these the value is sought that a wanted error needs."""
WANTED = ("v1_percent", "wave_number", "phase")


@dataclass(frozen=True)
class DesignOptions:
    """Table ``[design]`` of a case; InputError if a value is out of its range."""

    v1_percent: float = 0.02
    wave_number: float = 3e-5
    phase: float = 1e-4
    parameter_percent: float = 1.0
    """Wanted, of the :class:`ExpectedErrors`."""
    parameters: tuple[str, ...] = ()
    """To be identified from all states' images and forces, as in ``[unknowns]`` of an
    identification; none by default."""
    force_sd: float = 0.0
    """Of the load cell; 0 for a test without [N/mm]."""
    strain: float | None = None
    """Of the state [-]; by default the case's last."""
    pattern: float | None = None
    """Largest displacement of an even pattern [mm], instead of that of a simulated solution."""
    noise: float = 0.01
    """Read noise of an exposure [fraction of full scale], where the case's sensor has no noise."""
    exposures: int = 1
    """Averaged, of the reference and of each state."""
    map: tuple[str, str] = ("pixel_size", "noise")
    contour: str = "v1_percent"
    """What is varied along the map's axes, over its ranges, and the error that it shows."""
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
        """Names of the errors that are looked at."""
        return (*WANTED, "parameter_percent") if self.parameters else WANTED


@dataclass(frozen=True)
class DesignSetup:
    """How a test is photographed and measured; the names are those of the ranges."""

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
    """Standard deviations by noise, at the Cramér–Rao bound."""

    u_px: float = quantity("u, rms", "px")
    v1_px: float = quantity("v₁ max‖φ₁‖, rms", "px")
    v1_percent: float = quantity("v₁, rms", "% of its largest")
    wave_number: float = quantity("wave numbers, largest")
    phase: float = quantity("phases, largest", "mm")
    image_noise: float = quantity("noise of an image", "% of full scale")
    parameter_percent: float | None = quantity("parameters, largest", "% of the value")
    """Of those whose value isn't 0; None if none are sought."""
    w_px: float | None = quantity("model error, rms", "px")
    """What the ansatz leaves of the simulated displacement: no part of the others. None if that
    was not simulated: a pattern that was given, another strain."""
    parameter_sd: tuple[float, ...] = ()
    """Of each that is sought, in its own unit."""


@dataclass(frozen=True, eq=False)
class PatternState:
    """A state of the specimen as an ansatz has it, and what an integral over it needs."""

    ansatz: Ansatz
    unknowns: FloatArray
    """(n,)."""
    w: float | None = None
    """Model error, rms per component [mm]; None if not known."""

    @classmethod
    def fitted(
        cls, ansatz: Ansatz, pitch: float, solution: Solution, strain: float, amplitude: float
    ) -> PatternState:
        """Fit an ansatz to a solution's snapshot, beginning with an ``amplitude`` of v_i [mm]."""
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
    """What a test's design needs; InputError without a solution or a pattern."""

    specimen: Specimen
    imaging: ImagingSpec
    correlation: SquareLatticeOptions
    options: DesignOptions
    strain: float
    """Nominal, of the state designed for [-]."""
    solution: Solution | None = None
    """Its displacement; not looked at where the options give a pattern."""
    model: ModelStates | None = None
    """States of the model whose parameters are sought; needed if any are."""
    _known: dict[Any, Any] = field(default_factory=dict)
    """States, their integrands, signals with their errors, speckles, by what they depend on."""

    def __post_init__(self) -> None:
        if self.options.pattern is None and self.solution is None:
            raise InputError("design: expected a solution or a pattern [mm], got neither")
        if self.options.parameters and self.model is None:
            raise InputError("design: expected a model whose parameters are sought, got none")

    @property
    def setup(self) -> DesignSetup:
        """The case's own."""
        sensor, how = self.imaging.sensor, self.correlation
        is_noisy = sensor.read_noise > 0.0 or sensor.full_well > 0.0
        noise = sensor.read_noise if is_noisy else self.options.noise
        degrees, exposures = (how.v0_degree, how.v_degree), self.options.exposures
        return DesignSetup(self.imaging.pixel_size, noise, *degrees, self.strain, exposures)

    @cached_property
    def critical(self) -> float:
        """Nominal strain of buckling [-]; infinite where it is not known."""
        info = self.solution.info if self.solution and self.options.pattern is None else {}
        return float((info.get("critical") or {"strain": np.inf})["strain"])

    @cached_property
    def points(self) -> FloatArray:
        """(k, 2) evenly over the specimen's rectangle [mm], holes included."""
        half = np.array(self.specimen.half_size)
        return np.asarray((2.0 * qmc.Halton(2, scramble=False).random(_POINTS) - 1.0) * half)

    def used(self, margin: float) -> BoolArray:
        """(k,) True where all of a square is material, half its side ``margin`` [mm]."""
        specimen, points = self.specimen, self.points
        number = specimen.nearest_hole(points)
        off = np.maximum(abs(points - specimen.hole_centres[number]) - margin, 0.0)
        off[:, 1] /= specimen.aspect
        is_in_hole = np.hypot(*off.T) <= 0.5 * specimen.diameters[number]
        is_inside = (abs(points) <= np.array(specimen.half_size) - margin).all(axis=1)
        return np.asarray(is_inside & ~is_in_hole)

    def state(self, setup: DesignSetup) -> PatternState:
        """The state that is measured, as the setup's ansatz has it.

        At another strain than the design's v0 grows in proportion, and the pattern by the root law
        of a pitchfork from the critical strain on. InputError unless both are beyond that.
        """
        degrees, own, least = (setup.v0_degree, setup.v_degree), self.strain, self.critical
        if degrees not in self._known:
            how = replace(self.correlation, gain_degree=None, offset_degree=None)
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
        """G/(2 p⁴ s²) [1/mm⁴], which the integral is multiplied by."""
        _, found = self.speckle(setup)
        contrast = self.imaging.sensor.gain * setup.light
        noise = self.image_noise(setup) * setup.pixel_size**2
        return 0.5 * contrast**2 * found.gradient / noise**2

    def image_noise(self, setup: DesignSetup) -> float:
        """Standard deviation of an image's noise by the sensor's model [fraction of full scale].

        InputError if the light saturates it.
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
        """The errors to expect of a setup, over the material and the lattice."""
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

        By the images and forces of all states; that of the setup's strain is the last. InputError
        if the model has no state of that strain, or if nothing shows one of the parameters.
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
        """(n, n) ∫ S' (F F')⁻¹ S / (1 + 1/det F) dA over the pixels that are used [mm²]."""
        if key not in self._known:
            inside, points = self.used(0.0), self.points
            found = _weighted(*mapped(points[inside]))
            self._known[key] = np.zeros((len(points), *found.shape[1:]))
            self._known[key][inside] = found
        used = self.used(self.correlation.edge_px * setup.pixel_size)
        H = self._known[key][used].reshape(-1, self._known[key].shape[-1])
        return np.asarray(H.T @ H * 4.0 * float(np.prod(self.specimen.half_size)) / _POINTS)

    def varied(self, axis: str) -> list[tuple[float, ExpectedErrors]]:
        """The errors with one of :data:`AXES` varied over its range, all else as in the case.

        What can't be is left out: too much light, too narrow speckles, strains before buckling.
        """
        if axis not in self._known:
            self._known[axis] = []
            for value in getattr(self.options.ranges, axis):
                with suppress(InputError):
                    errors = self.expected(self._with({axis: value}))
                    self._known[axis].append((value, errors))
        return list(self._known[axis])

    def needed(self, axis: str, name: str) -> float | None:
        """The value of one of :data:`NEEDED` with which the error ``name`` is as wanted.

        All else as in the case. The easiest end of the range if all of it will do; None if nothing
        does.
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
        """Values along the map's axes, (points,) each, and the errors, the second down rows."""
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
        """(n, n) bound of the unknowns' covariance; InputError if one of them doesn't show."""
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
        """From the covariance, all but the image's noise."""
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
        """The case's speckle, its layers that much wider, and its statistics."""
        times = setup.speckle_width
        if ("speckle", times) not in self._known:
            spec, ink = self.imaging.speckle, self.imaging.speckle.ink
            if ink is not None:
                spread, blur = ink.standard_deviation / times, ink.blur_px * times
                ink = replace(ink, standard_deviation=spread, blur_px=blur)
            spread, blur = spec.standard_deviation / times, spec.blur_px * times
            spec = replace(spec, standard_deviation=spread, blur_px=blur, ink=ink)
            aperture = self.imaging.sensor.aperture
            spread = aperture.psf_px**2 + aperture.side_px**2 / 12.0  # as if it were a Gaussian
            found = SpeckleStatistics.of(spec, spread)
            self._known["speckle", times] = spec, found
        spec, found = self._known["speckle", times]
        return spec, found


def averaged_noise(sensor: Sensor, bits: int, grey: float, exposures: float) -> float:
    """Standard deviation of the mean of exposures, at a grey level above the offset [fraction].

    Rounding is averaged away only by noise that exceeds it: its errors in two exposures whose noise
    is of s levels have the correlation 6/pi² Σ exp(-4 pi² k² s²)/k².

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
