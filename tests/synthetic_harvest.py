"""A harvest made up in memory, from small photographs with holes: for its report's tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from known_fields import sampled_field
from manufactured import image_pair, reference_points, speckle
from numpy.typing import NDArray

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import FourierMode, square_family
from modeharvest.idic.photograph.geometry import Geometry, Region, SpecimenTable
from modeharvest.idic.photograph.holes import find_hole_lattice
from modeharvest.idic.result import Result
from modeharvest.idic.solver.gauss_newton import Iteration, Outcome
from modeharvest.idic.solver.noise import CameraNoise
from modeharvest.idic.spectra.pattern import read_pattern
from modeharvest.idic.spectra.spectrum import spectral_density
from modeharvest.idic.uncertainty.covariance import field_errors
from modeharvest.idic.uncertainty.identifiability import identifiability
from modeharvest.imaging.distortion.calibrate import Calibration, DegreeTrial
from modeharvest.imaging.distortion.fit import PolynomialModel
from modeharvest.imaging.distortion.lens import PolynomialDistortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.runs.photographs.case import Images, ImageScale, PhotographCase
from modeharvest.runs.photographs.prepare import Optics
from modeharvest.runs.photographs.results import FrameTruth, Harvest, HarvestedFrame, HarvestTruth
from modeharvest.validation.onset import ImageAmplitude, find_buckling
from modeharvest.validation.summary import Expectation

FloatArray = NDArray[np.float64]

PITCH, HOLES, DIAMETER = 0.5, (4, 6), 0.38
GRID = PixelGrid.centred(290, 210, 0.0125)
CELLULAR = Box.centred(PITCH * HOLES[0], PITCH * HOLES[1])
DOMAIN = Box.centred(2.3, 3.3)
LEVELS = 4095.0
NOISE = 25.0


def material(x: FloatArray, y: FloatArray) -> NDArray[np.bool_]:
    """A rectangle with round holes in its cells' middles, at positions [mm]."""
    in_cell = [np.mod(t + 0.5 * n * PITCH, PITCH) - 0.5 * PITCH
               for t, n in ((x, HOLES[0]), (y, HOLES[1]))]  # fmt: skip
    cellular = (abs(x) < CELLULAR.x_max) & (abs(y) < CELLULAR.y_max)
    inside = (abs(x) < DOMAIN.x_max) & (abs(y) < DOMAIN.y_max)
    return np.asarray(inside & ~(cellular & (np.hypot(*in_cell) < 0.5 * DIAMETER)))


MASK = material(*np.meshgrid(GRID.x, GRID.y))


def ansatz(fixed: bool = False) -> Ansatz:
    """The paper's, its mode fixed or free."""
    made = Ansatz.on(DOMAIN, [(square_family(), CELLULAR)], PITCH)
    mode = made.modes[0]
    family = mode.family.fixed() if fixed else mode.family
    return replace(made, modes=(FourierMode(family, mode.half_wavelength, mode.scale, mode.taper),))


def photographs(a: Ansatz, unknowns: FloatArray) -> tuple[Any, Any, NDArray[np.bool_]]:
    """Reference, deformed image and its mask: bright speckle on material, dark elsewhere."""
    f, g = image_pair(speckle(3, GRID), a, unknowns, GRID)
    at = reference_points(a, unknowns, GRID)
    seen = material(at[..., 0], at[..., 1])
    rng = np.random.default_rng(0)
    levels = [np.where(m, 700 + 2600 * image, 250.0) for m, image in ((MASK, f), (seen, g))]
    reference, deformed = (np.asarray(i + NOISE * rng.normal(size=i.shape), np.float32)
                           for i in levels)  # fmt: skip
    return reference, deformed, seen


def frame(name: str, strain: float, amplitude: float, fixed: bool = False) -> HarvestedFrame:
    """A photograph whose pattern has that amplitude [mm, times max phi = 0.04]."""
    kinematics = ansatz(fixed)
    a = kinematics.initial_guess(strain, amplitude)
    _, deformed, seen = photographs(kinematics, a)
    steps = ((8, 1, 3.0), (8, 2, 0.1), (1, 1, 0.2), (1, 2, 1e-4))
    result = Result(
        kinematics, GRID, a, 1e-13 * np.eye(kinematics.size), 45.0, int(MASK.sum()), 0,
        Outcome.CONVERGED, 1e3, tuple(Iteration(f, n, 60.0, s, 0.0, 100) for f, n, s in steps),
        residual_correlation=0.1, slope_square=1e13 * GRID.pixel_size**2 / int(MASK.sum()),
    )  # fmt: skip
    x, y = GRID.x[::8], GRID.y[::8]
    model_error = 1e-8 * np.eye(kinematics.size)
    u = result.displacement() + wave()
    spectrum = spectral_density(u, GRID, MASK, PITCH)
    rng = np.random.default_rng(1)
    local = sampled_field(u, GRID, MASK, 6, "a local DIC")
    noisy = local.u + 1e-4 * rng.normal(size=local.u.shape)
    return HarvestedFrame(
        name=name,
        strain_x=strain,
        strain_y=-0.2 * strain,
        image=deformed,
        mask=seen,
        result=result,
        identifiability=identifiability(result, MASK),
        residual_test=result.residual_test(NOISE),
        error_x=x,
        error_y=y,
        by_noise=field_errors(result, x, y, result.covariance(NOISE)),
        by_model_error=field_errors(result, x, y, model_error),
        spectrum=spectrum,
        pattern=read_pattern(spectrum),
        w=replace(local, u=noisy, sd=np.full(noisy.shape, 1e-4)).less(
            partial(kinematics.displacement_at, a)
        ),
        start_text=("v0 starts from the local DIC.",),
    )


def wave() -> FloatArray:
    """What the ansatz can't describe: (rows, cols, 2), 4 um [mm]."""
    x, y = np.meshgrid(GRID.x, GRID.y)
    k = 2.0 * np.pi / PITCH
    return 0.004 * np.stack([np.sin(k * x) * np.cos(2 * k * y), np.cos(k * x)], axis=-1)


def lens(size: float = 1.0) -> PolynomialDistortion:
    """A distortion of a few pixels."""
    c = np.zeros((2, 10))
    c[0, 3:], c[1, 3:] = [0.8, -0.2, 1.5, 0.1, 0.6, 0.0, 0.9], [1.2, 0.3, 0.5, 0.9, 0.0, 0.7, 0.1]
    return PolynomialDistortion(GRID.shape, size * c)


def calibration() -> Calibration:
    """That distortion, as if found."""
    trials = tuple(
        DegreeTrial(d, 2 * n, r, b, c, 0.002)
        for d, n, r, b, c in (
            (2, 3, 90.0, 5e4, 1.1),
            (3, 7, 40.0, 0.0, 0.6),
            (4, 12, 40.0, 70, 3e-3),
        )
    )
    shifts = np.array([[0.0, 0.0], [0.1, 60.0], [-55.0, 0.3]])
    found, fixed = lens(), 3
    return Calibration(
        distortion=found,
        coefficients=found.coefficients[:, fixed:].ravel(),
        covariance=1e-6 * np.eye(14),
        model=PolynomialModel(found.shape, found.degree, fixed),
        noise_sd=24.0,
        matches=np.array([0.99, 0.98, 0.99]),
        shifts=shifts,
        shifts_sd=np.full((3, 2), 0.004),
        angles=np.zeros(3),
        angles_sd=np.full(3, 1e-6),
        trials=trials,
    )


def harvest(
    states: Sequence[tuple[str, float, float]] = (("IMG_1", 0.04, 0.02), ("IMG_2", 0.07, 0.9)),
) -> Harvest:
    """Photographs (name, strain, amplitude), everything known; the first one's mode is fixed."""
    frames = tuple(frame(*state, fixed=k == 0) for k, state in enumerate(states))
    reference, _, _ = photographs(ansatz(), ansatz().initial_guess(0.0, 0.0))
    timeline = [moment(one) for one in frames]
    truth = {
        one.name: FrameTruth(
            np.where(MASK[..., None], one.result.displacement() + wave(), np.nan),
            replace(one.result, unknowns=one.result.unknowns + 1e-4),
        )
        for one in frames
    }
    rows = (
        Expectation("largest v₁ against the best fit", 1.2, "within 3", True, "%"),
        Expectation("distortion, affine part aside", 0.07, 0.05, False, "px"),
    )
    case = PhotographCase(
        title="Made up <for tests>",
        images=Images("reference.tif", tuple(f"{one.name}.tif" for one in frames)),
        scale=ImageScale(GRID.pixel_size),
        specimen=SpecimenTable(PITCH),
    )
    region = Region(CELLULAR, DOMAIN, ())
    return Harvest(
        case=case,
        geometry=Geometry(GRID, MASK, find_hole_lattice(MASK), region, {"": CELLULAR}),
        reference=reference,
        frames=frames,
        noise=CameraNoise(NOISE, "measured from 3 exposures"),
        skipped=(("IMG_3.tif", "expected an image <of 290 x 250 px>, got a damaged file"),),
        timeline=timeline,
        buckling=find_buckling(timeline),
        optics=Optics(lens(), calibration()),
        full_scale=LEVELS,
        text=("The material was found by its speckle.",),
        truth=HarvestTruth(truth, lens(1.01), rows),
        versions={"modeharvest": "0"},
    )


def moment(one: HarvestedFrame) -> ImageAmplitude:
    """Its place in the time line."""
    seen = one.identifiability
    return ImageAmplitude(one.name, one.strain_x, seen.amplitude_px[0], seen.model_error_px, 0.01)
