"""Errors that a test's design predicts, compared with those of simulated images.

For three very different setups of the paper's case, images are made, exposed and correlated under
several draws of the sensor's noise. The scatter of the results, and the standard deviations that
they report, are divided by the design's predictions, which use no image. The displacement is the
ansatz's best fit to the simulated one, so that noise is the only error, or the simulated one, whose
model error w lowers the curvature of the cost. The error of v1 without noise is the effect of w
itself.

With --strains the test is simulated at four strains beyond buckling. Errors predicted with these
states are divided by those that the root law of a pitchfork extrapolates from the last one.

With --parameters the material and tilt of a small specimen (identification_statistics.py) are
identified at three setups from images and forces, with the model that made the data. Scatter and
reported standard deviations are over the predicted ones. Tables: docs/how-to/design.md.

Run: scripts/env python benchmarks/design.py [--seeds 30] [--json FILE] [--strains | --parameters]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Snapshot, Solution
from modeharvest.idic.correlate import correlate
from modeharvest.idic.modes import PER_WAVE
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions, SquareLatticeOptions
from modeharvest.idic.solver.pyramid import FULL
from modeharvest.idic.uncertainty.covariance import propagated_sd
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.validation.design import WANTED, Design, DesignOptions, DesignSetup

FloatArray = NDArray[np.float64]
STRAIN = 0.128
SETUPS: dict[str, tuple[Sensor, dict[str, float]]] = {
    "0.04 mm/px, 2 % of read noise": (Sensor(), {"pixel_size": 0.04, "noise": 0.02}),
    "0.02 mm/px, 1 %, speckle 0.7 times as wide": (
        Sensor(), {"pixel_size": 0.02, "noise": 0.01, "speckle_width": 0.7},
    ),
    "0.03 mm/px, full well 1000, 0.5 %, half the light, 4 exposures, pixels of area": (
        Sensor(fill_factor=1.0, psf_px=0.5, full_well=1000.0),
        {"pixel_size": 0.03, "noise": 0.005, "light": 0.5, "exposures": 4},
    ),
}  # fmt: skip
PARTS = "u", "v1", "wave numbers", "phases"


def exposed(pair: ImagePair, design: Design, setup: DesignSetup, seed: int) -> ImagePair:
    """The mean of the setup's number of exposures, of either image."""
    bits, sensor = design.imaging.bits, design.imaging.sensor
    sensor = replace(sensor, read_noise=setup.noise, shot_seed=seed, read_seed=seed)
    f, g = (
        np.mean([sensor.expose(np.float32(setup.light) * image, bits, f"{name} {k}")
                 for k in range(int(setup.exposures))], axis=0) / (2**bits - 1)
        for name, image in (("f", pair.reference), ("g", pair.deformed))
    )  # fmt: skip
    return pair.with_images(f, g)


def sensitivities(design: Design, setup: DesignSetup) -> dict[str, FloatArray]:
    """(..., n) derivatives of u and v1 at points, of wave numbers and of phases by the unknowns."""
    state = design.state(setup)
    ansatz, a = state.ansatz, state.unknowns
    at = design.points[design.used(0.0)][::16]
    inside = (abs(at) <= design.specimen.cellular_half_size).all(axis=1)
    x, y = at[inside].T[..., None]
    v1 = np.zeros((len(x), ansatz.size))
    v1[:, ansatz.v_slice(0)] = ansatz.v_space.basis(x, y)[:, 0]
    waves = np.zeros((len(ansatz.modes[0].family.matrix), ansatz.size))
    waves[:, ansatz.phi_slice(0)] = ansatz.modes[0].family.matrix
    number = np.arange(len(waves)) % PER_WAVE
    S = ansatz.sensitivities(a, *at.T[..., None])
    return dict(zip(PARTS, (S, v1, waves[(number == 2) | (number == 3)], waves[number == 4]),
                    strict=True))  # fmt: skip


def root_mean(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def compared(design: Design, setup: DesignSetup, solution: Solution, seeds: int) -> dict[str, Any]:
    """Scatter and reported standard deviations of ``seeds`` correlations, over the design's."""
    imaging, state = design.imaging, design.state(setup)
    spec, _ = design.speckle(setup)
    imaging = replace(imaging, pixel_size=setup.pixel_size, speckle=spec)
    # Images of the irradiance, without noise and gain, through the sensor's aperture.
    plain = Sensor(imaging.sensor.fill_factor, imaging.sensor.psf_px)
    with tempfile.TemporaryDirectory() as folder:
        made = make_images(solution, replace(imaging, sensor=plain), Path(folder), (STRAIN,))
        pair = made.pair(STRAIN)
    options = CorrelationOptions((FULL,), edge_px=design.correlation.edge_px)

    def found(noisy: ImagePair, guess: FloatArray) -> Result:
        return correlate(noisy, state.ansatz, guess=guess, options=options)

    scale = design.imaging.sensor.gain * setup.light
    exact = found(pair.with_images(*(np.float32(scale) * i for i in
                                     (pair.reference, pair.deformed))), state.unknowns)  # fmt: skip
    results = [found(exposed(pair, design, setup, s), exact.unknowns) for s in range(seeds)]
    unknowns = np.array([result.unknowns for result in results])
    deviations, bound = unknowns - unknowns.mean(axis=0), design.covariance(setup)
    noise = design.image_noise(setup)
    reported = np.mean([result.covariance(noise) for result in results], axis=0)
    rows: dict[str, Any] = {}
    for name, S in sensitivities(design, setup).items():
        scatter = np.sqrt(np.sum((deviations @ S.reshape(-1, S.shape[-1]).T) ** 2, axis=0))
        scatter /= np.sqrt(seeds - 1)
        predicted = propagated_sd(S, bound).ravel()
        # Equal weights for fields; for parameters, whose sizes differ, their own sd.
        weight = 1.0 / predicted if S.ndim == 2 and name != "v1" else np.ones_like(predicted)
        named_sd = propagated_sd(S, reported).ravel()
        rows[name] = {
            "scatter": root_mean(weight * scatter) / root_mean(weight * predicted),
            "reported": root_mean(weight * named_sd) / root_mean(weight * predicted),
        }
    v1 = sensitivities(design, setup)["v1"]
    off, own = v1 @ (exact.unknowns - state.unknowns), v1 @ state.unknowns
    return {
        "parts": rows,
        "outcomes": sorted({result.outcome.name for result in results}),
        "gradients": sorted({result.weighting.gradient.value for result in results}),
        "v1_off_percent": 100.0 * root_mean(off) / float(abs(own).max()),
    }


def other_strains(case: Case) -> None:
    """Print errors predicted with simulated states, over those of the design's root law."""
    from modeharvest.fem.simulate import simulate

    strains = DesignOptions().ranges.strain
    solution = simulate(replace(case.experiment, strains=strains))
    names = ("u_px", "v1_px", *WANTED)

    def designed(strain: float) -> Design:
        how = case.experiment.specimen, case.imaging, case.correlation, DesignOptions()
        return Design(*how, strain, solution)

    last = designed(strains[-1])
    print("| strain [%] | w [px] | " + " | ".join(names) + " |\n" + "|---" * (2 + len(names)) + "|")
    for strain in strains[:-1]:
        own, law = designed(strain), last.expected(replace(last.setup, strain=strain))
        errors = own.expected(own.setup)
        ratios = (f"{getattr(errors, name) / getattr(law, name):.3f}" for name in names)
        print(f"| {100 * strain:g} | {errors.w_px:.2f} | " + " | ".join(ratios) + " |", flush=True)


PARAMETER_SETUPS = {
    "0.05 mm/px, 1 % of read noise": (0.003, {"pixel_size": 0.05, "noise": 0.01}),
    "0.04 mm/px, 3 %, speckle 0.7 times as wide": (
        0.003, {"pixel_size": 0.04, "noise": 0.03, "speckle_width": 0.7},
    ),
    "0.05 mm/px, 2 %, 4 exposures, load cell 0.01 N/mm": (
        0.01, {"pixel_size": 0.05, "noise": 0.02, "exposures": 4},
    ),
}  # fmt: skip
"""Noise of the load cell [N/mm], and changes of the design's setup."""


def of_parameters(seeds: int) -> None:
    """Print scatter and reported standard deviations of a model's parameters over the design's."""
    from identification_statistics import SPECIMEN, STRAINS, TRUE, UNKNOWNS, made

    from modeharvest.idic.finite_element.equations.pixels import MeshPixels
    from modeharvest.idic.finite_element.identification.identify import Readings, Unknown, identify
    from modeharvest.idic.finite_element.identification.observed import ImageData
    from modeharvest.idic.solver.noise import ImageNoise
    from modeharvest.validation.design_parameters import ModelStates

    test, true, names = made(0.4), np.array(list(TRUE.values())), tuple(TRUE)
    states, pixels = test.at(true), MeshPixels(test.mesh)
    unknowns = {n: Unknown(v, UNKNOWNS[n].bounds) for n, v in zip(names, true, strict=True)}
    snapshots = tuple(Snapshot(e, s.displacement) for e, s in zip(STRAINS, states, strict=True))
    forces = np.array([s.force for s in states])
    heads = [f"{name}, {what}" for name in names for what in ("predicted", "scatter", "reported")]
    print("| setup | " + " | ".join(heads) + " |\n" + "|---" * (1 + len(heads)) + "|")
    for kind, (force_sd, changed) in PARAMETER_SETUPS.items():
        imaging = ImagingSpec(pixel_size=changed["pixel_size"], margin_px=12, bits=16)
        how = replace(SquareLatticeOptions(), edge_px=2)
        model = ModelStates(names, true, dict(zip(STRAINS, states, strict=True)), STRAINS, force_sd)
        options = DesignOptions(pattern=0.3, parameters=names, force_sd=force_sd)
        design = Design(SPECIMEN, imaging, how, options, STRAINS[-1], None, model)
        setup = replace(design.setup, **changed)  # type: ignore[arg-type]
        predicted, noise = design.parameter_sd(setup), design.image_noise(setup)
        imaging = replace(imaging, speckle=design.speckle(setup)[0])
        with tempfile.TemporaryDirectory() as folder:
            solution = Solution(test.mesh, snapshots, {})
            images = make_images(solution, imaging, Path(folder), STRAINS)
            exact = images.reference(), *(images.deformed(e) for e in STRAINS)
        found, sds = [], []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            f, *deformed = (i + rng.normal(0.0, noise, i.shape) for i in exact)
            data = [
                ImageData(ImagePair(f, g, images.grid), pixels, ImageNoise(noise, noise))
                for g in deformed
            ]
            readings = Readings(forces + rng.normal(0.0, force_sd, len(forces)), force_sd)
            given = {"pixel_size": setup.pixel_size, "forces": readings, "levels": (FULL,)}
            result = identify(test.near, data, unknowns, **given)  # type: ignore[arg-type]
            found.append(result.values)
            sds.append(result.sd)
        scatter, reported = np.std(found, axis=0, ddof=1), np.mean(sds, axis=0)
        cells = zip(predicted, scatter / predicted, reported / predicted, strict=True)
        text = (f"{p:.3g} | {s:.2f} | {r:.2f}" for p, s, r in cells)
        print(f"| {kind} | " + " | ".join(text) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=30, help="draws of the noise")
    parser.add_argument("--json", type=Path, help="where to leave all numbers")
    parser.add_argument("--strains", action="store_true", help="the root law instead")
    parser.add_argument("--parameters", action="store_true", help="of a model, instead")
    options = parser.parse_args()
    if options.parameters:
        of_parameters(options.seeds)
        return
    case, path = Case.read("paper-virtual"), shipped_solution("paper-virtual")
    if options.strains:
        other_strains(case)
        return
    solution = Solution.read(path)
    every: dict[str, Any] = {}
    heads = [f"{p}, {what}" for p in PARTS for what in ("scatter", "reported")]
    print(
        "| setup | displacement | predicted v1 [%] | off without noise [%] | "
        + " | ".join(heads)
        + " |"
    )
    print("|" + "---|" * (4 + len(heads)))
    for name, (sensor, changed) in SETUPS.items():
        imaging = replace(case.imaging, sensor=sensor)
        design = Design(case.experiment.specimen, imaging, case.correlation, DesignOptions(),
                        STRAIN, solution)  # fmt: skip
        setup = replace(design.setup, **changed)
        state, expected = design.state(setup), design.expected(setup)
        own = state.ansatz.displacement_at(state.unknowns, solution.mesh.nodes)
        inside = Solution(solution.mesh, (Snapshot(STRAIN, own),), solution.info)
        for kind, shown in (("the ansatz'", inside), ("simulated", solution)):
            row = compared(design, setup, shown, options.seeds)
            every[f"{name}, {kind}"] = {**row, "expected": asdict(expected)}
            cells = " | ".join(
                f"{part[what]:.3f}" for part in row["parts"].values() for what in part
            )
            v1 = f"{expected.v1_percent:.4f} | {row['v1_off_percent']:.4f}"
            print(f"| {name} | {kind} | {v1} | {cells} |", flush=True)
    if options.json:
        options.json.write_text(json.dumps(every, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
