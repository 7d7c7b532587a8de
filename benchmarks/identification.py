"""Material and tilt identified from images and forces: bias and coverage over seeds, cost.

    scripts/env python benchmarks/identification.py --seeds 10

A small specimen is simulated with known parameters and photographed once without noise; each seed
adds noise to images and forces and identifies from values off by a factor of two. ``--mesh`` is the
model's mesh, ``--twin-mesh`` that of the data: with one mesh for both what is seen is statistics
alone. ``--fields`` instead identifies exact displacements and forces of a model of 0.1 mm elements
by coarser ones: the error by the mesh. ``--unknown holes`` instead identifies a specimen whose
holes are 2 % larger than the model's and scattered, with its holes ignored, all as large as they
are on average, or each by itself; ``--unknown edges`` one whose loaded edges bow, slide and spread,
ignored or unknown; data and model have meshes of their own.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Snapshot, Solution
from modeharvest.fem.meshing import mesh_specimen
from modeharvest.fem.path.parameters import PARTS, holes_of
from modeharvest.fem.path.parametric import ParametricTest
from modeharvest.fem.specimen import Imperfection, Specimen
from modeharvest.idic.finite_element.identify import FinerMesh, Readings, Unknown, identify
from modeharvest.idic.finite_element.model_error import corrections
from modeharvest.idic.finite_element.observed import FieldData, ImageData
from modeharvest.idic.finite_element.pixels import MeshPixels
from modeharvest.idic.finite_element.result import nodal_values
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spec import ImagingSpec

SPECIMEN = Specimen(4, 4, diameter=1.6, bulk_x=0.9, bulk_y=0.4)
STRAINS = (0.06, 0.12)
TRUE = {"moduli[0]": 1.2, "exponents[0]": 3.0, "kappa": 5.4, "tilt": 0.01}
UNKNOWNS = {
    "moduli[0]": Unknown(2.4, (0.1, 10.0)),
    "exponents[0]": Unknown(1.5, (0.5, 10.0)),
    "kappa": Unknown(10.8, (0.5, 100.0)),
    "tilt": Unknown(0.0, (-0.2, 0.2)),
}
NOISE, FORCE_NOISE = 0.01, 0.005


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--mesh", type=float, default=0.35, help="[mm]")
    parser.add_argument("--twin-mesh", type=float, default=0.35, help="[mm]")
    parser.add_argument("--pixel-size", type=float, default=0.04, help="[mm/px]")
    parser.add_argument("--fields", action="store_true")
    parser.add_argument("--unknown", choices=list(SETS))
    how = parser.parse_args()
    if how.fields:
        by_mesh()
    elif how.unknown:
        by_unknowns(how.unknown, how.seeds)
    else:
        by_seed(how)


def test(size: float) -> ParametricTest:
    """The model with elements of a size [mm]."""
    experiment = Experiment(SPECIMEN, strains=STRAINS, mesh_size=size)
    return ParametricTest(experiment, list(TRUE), mesh_specimen(SPECIMEN, size))


def by_mesh() -> None:
    """Print what models of several meshes make of the states of a fine one."""
    fine, (x, y) = test(0.1), np.mgrid[-4.7:4.7:0.06, -4.2:4.2:0.06].reshape(2, -1)
    states = fine.at(np.array([*list(TRUE.values())[:3], 0.0]), False)
    points = np.column_stack([x, y])
    hole = SPECIMEN.pitch * (np.round(points / SPECIMEN.pitch - 0.5) + 0.5)  # the nearest one
    points = points[np.linalg.norm(points - hole, axis=1) > 0.5 * SPECIMEN.diameter + 0.02]
    fields = [nodal_values(fine.mesh, s.displacement, points) for s in states]
    forces = Readings(np.array([s.force for s in states]), 0.002)
    print("| elements [mm] | modulus | exponent | kappa | residual, last state [um] |")
    print("|---|---|---|---|---|")
    for size in (0.35, 0.25, 0.2, 0.15):
        model = test(size)
        data = [FieldData(points, u, 5e-4, model.mesh) for u in fields]
        found = identify(model.at, data, UNKNOWNS, pixel_size=0.03, forces=forces)
        row = (f"{v:.4g}" for v in (*found.values[:3], 1e3 * found.state_equations[-1].residual))
        print("|", size, "|", " | ".join(row), "|", flush=True)


SCATTER = Imperfection(0.006, 0.006, seed=1)
OWN = [f"holes[{k}].{part}" for k in range(len(SPECIMEN.hole_centres)) for part in PARTS]
TRUTHS = {
    "holes": {"holes.diameter[0,0]": 0.03,
              **dict(zip(OWN, SCATTER.drawn(len(OWN) // 3).ravel(), strict=True))},
    "edges": {"right.x[2]": 0.1, "right.y[0]": 0.1, "left.y[1]": -0.1},
}  # fmt: skip
SETS = {
    "holes": {"ignored": [], "alike": ["holes.diameter[0,0]"], "each": OWN},
    "edges": {"ignored": [], "each": list(TRUTHS["edges"])},
}
"""True values [mm], and which parameters are unknown."""
MESHES = {
    "holes": ((0.25, 3), (0.35, 3), (0.35, 4), 0.1),
    "edges": ((0.2, 4), (0.35, 3), (0.25, 4), 0.06),
}
"""Size [mm] and degree of elements of the data, of the model and of its finer mesh, and the ratio
of the errors of these two. With more, no states of such scattered holes are found at 12 %."""


def by_unknowns(what: str, seeds: int) -> None:
    """Print what is found where holes or edges are ignored or unknown."""

    def model(names: list[str], size: float, degree: int) -> ParametricTest:
        experiment = Experiment(SPECIMEN, strains=STRAINS, mesh_size=size)
        return ParametricTest.meshed(experiment, names, degree)

    truth = {"tilt": 0.01, **TRUTHS[what]}
    of_data, of_model, of_finer, ratio = MESHES[what]
    finest = model(list(truth), *of_data)
    states = finest.at(np.array(list(truth.values())), False)
    holes = holes_of(list(truth), list(truth.values()), finest.experiment)
    forces = np.array([s.force for s in states])
    sd = FORCE_NOISE * float(forces.max())
    snapshots = tuple(Snapshot(e, s.displacement) for e, s in zip(STRAINS, states, strict=True))
    print("| seed |", what, "| modulus | kappa | tilt | errors [um] | predicted [um] | within 95 % "
          "| residual over noise | p | processor [s] |")  # fmt: skip
    print("|" + 11 * "---|")
    with tempfile.TemporaryDirectory() as folder:
        spec = ImagingSpec(pixel_size=0.03, margin_px=12)
        solution = Solution(states[0].mesh, snapshots, {})
        images = make_images(solution, spec, Path(folder), STRAINS)
        clear = [images.reference(), *(images.deformed(e) for e in STRAINS)]
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            f, *others = (i + rng.normal(0.0, NOISE, i.shape) for i in clear)
            readings = Readings(forces + rng.normal(0.0, sd, len(forces)), sd)
            for name, unknown in SETS[what].items():
                names = ["moduli[0]", "kappa", "tilt", *unknown]
                coarse, fine = model(names, *of_model), model(names, *of_finer)
                pixels, noise = MeshPixels(coarse.mesh), ImageNoise(NOISE, NOISE)
                data = [ImageData(ImagePair(f, g, images.grid), pixels, noise) for g in others]
                reach = 0.08 if what == "holes" else 0.5
                unknowns = {n: UNKNOWNS.get(n, Unknown(0.0, (-reach, reach))) for n in names}
                begin = time.process_time()
                found = identify(
                    coarse.near, data, unknowns, pixel_size=0.03, forces=readings,
                    finer=FinerMesh(partial(fine.near, with_derivatives=False), ratio),
                    corrections=corrections(coarse.mesh.nodes, SPECIMEN.vectors),
                )  # fmt: skip
                seconds = time.process_time() - begin
                predicted = found.sd_with_model_error
                if what == "holes":  # x, y and diameter of all, rms
                    error = holes_of(names, found.values, coarse.experiment) - holes
                    own = predicted[3:].reshape(-1, 3 if unknown == OWN else 1)
                    sizes, own_sizes = (
                        np.sqrt(np.mean(e**2, axis=0)) if e.size else e[0:0, 0]
                        for e in (error, own)
                    )
                else:
                    error = sizes = found.values[3:] - np.array([truth[n] for n in unknown])
                    own = own_sizes = predicted[3:]
                z = error / own if own.shape == error.shape else np.zeros(0)
                test = found.model_error
                row = [
                    *(f"{found.values[k]:.4g} ± {predicted[k]:.2g}" for k in range(3)),
                    *(", ".join(f"{1e3 * v:.1f}" for v in part) for part in (sizes, own_sizes)),
                    f"{(abs(z) < 1.96).sum()} of {z.size}",
                    f"{max(s.residual / s.expected for s in found.state_equations):.3f}",
                    "" if test is None else f"{test.p_value:.2g}",
                    f"{seconds:.0f}",
                ]  # fmt: skip
                print("|", seed, "|", name, "|", " | ".join(row), "|", flush=True)


def by_seed(how: argparse.Namespace) -> None:
    """Print bias, scatter and coverage over seeds."""
    names = list(TRUE)
    twin, model = test(how.twin_mesh), test(how.mesh)
    true = np.array(list(TRUE.values()))
    states = twin.at(true, False)
    forces = np.array([s.force for s in states])
    force_sd = FORCE_NOISE * float(forces.max())
    snapshots = tuple(
        Snapshot(e, s.displacement, s.force, branch=s.branch)
        for e, s in zip(STRAINS, states, strict=True)
    )
    spec = ImagingSpec(pixel_size=how.pixel_size, margin_px=12)
    pixels, errors, inside, counts = MeshPixels(model.mesh), [], [], []
    begin = time.process_time()
    model.at(true, False)
    forward = time.process_time() - begin
    begin = time.process_time()
    model.at(true)
    with_derivatives = time.process_time() - begin
    with tempfile.TemporaryDirectory() as folder:
        images = make_images(Solution(twin.mesh, snapshots, {}), spec, Path(folder), STRAINS)
        f, exact = images.reference(), [images.deformed(e) for e in STRAINS]
        begin = time.process_time()
        for seed in range(how.seeds):
            rng = np.random.default_rng(seed)
            noisy = [i + rng.normal(0.0, NOISE, i.shape) for i in (f, *exact)]
            data = [
                ImageData(ImagePair(noisy[0], g, images.grid), pixels, ImageNoise(NOISE, NOISE))
                for g in noisy[1:]
            ]
            readings = Readings(forces + rng.normal(0.0, force_sd, len(forces)), force_sd)
            found = identify(model.at, data, UNKNOWNS, pixel_size=how.pixel_size, forces=readings)
            errors.append((found.values - true) / found.sd)
            inside.append(abs(found.values - true) < 1.96 * found.sd)
            counts.append(found.evaluations)
            print(seed, found.minimum.outcome.value, *(f"{v:.4f}" for v in found.values),
                  "sd", *(f"{v:.4f}" for v in found.sd), flush=True)  # fmt: skip
        seconds = (time.process_time() - begin) / how.seeds
    z = np.array(errors)
    print("\n| parameter | bias [standard errors] | scatter [standard errors] | within 95 % |")
    print("|---|---|---|---|")
    for k, name in enumerate(names):
        share = 100 * np.mean(inside, axis=0)[k]
        print(f"| {name} | {z[:, k].mean():+.2f} | {z[:, k].std(ddof=1):.2f} | {share:.0f} % |")
    print(
        f"\n{model.unknowns} displacements; {forward:.2f} s of processor for the states, "
        f"{with_derivatives / forward:.2f} times that with derivatives; {np.mean(counts):.1f} "
        f"evaluations and {seconds:.1f} s for a seed"
    )


if __name__ == "__main__":
    main()
