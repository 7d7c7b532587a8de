"""Whether tests reject a wrong material law, and not a right one: p-values over seeds.

    scripts/env python benchmarks/wrong_law.py --seeds 20

Data of an Ogden and of a two-term I1 material are identified with an Ogden model: a specimen of 4 x
4 holes in one state before and one or more after buckling, noise of 1 % in images, of 0.5 % of the
larger force in forces. The first seed starts far off; the others start at its result, with states
that are linear about it. Elements are those of ``modeharvest identify``: cubic, degree 4 on a finer
mesh for last steps, and finer ones for the data. Table: docs/explanation/identification_laws.md.
"""

from __future__ import annotations

import argparse
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from identification_statistics import linearised

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Snapshot, Solution
from modeharvest.fem.materials import Material, Ogden, TwoTermI1
from modeharvest.fem.path.parametric import ParametricTest
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.finite_element.equations.pixels import MeshPixels
from modeharvest.idic.finite_element.identification.identify import (
    LEVELS,
    FinerMesh,
    Readings,
    Unknown,
    identify,
)
from modeharvest.idic.finite_element.identification.model_error import corrections
from modeharvest.idic.finite_element.identification.observed import ImageData
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import FULL
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.runs.identification.pipeline import error_ratio

SPECIMEN = Specimen(4, 4, diameter=1.6, bulk_x=0.9, bulk_y=0.4)
NOISE, FORCE_NOISE = 0.01, 0.005
MESH, FINER, TWIN = 0.35, 0.25, 0.2
UNKNOWNS = {
    "moduli[0]": Unknown(1.5, (0.1, 10.0)),
    "exponents[0]": Unknown(2.0, (0.5, 30.0)),
    "kappa": Unknown(10.0, (0.5, 300.0)),
    "tilt": Unknown(0.0, (-0.2, 0.2)),
}
TESTS = ("model_error", "law_error")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--data", nargs="+", default=["Ogden", "I1"])
    parser.add_argument("--strains", nargs="+", type=float, default=[0.06, 0.11])
    parser.add_argument("--pixel-size", type=float, default=0.03, help="[mm/px]")
    parser.add_argument("--speckle", type=float, default=0.05, help="[cycles/px]")
    how = parser.parse_args()
    laws: dict[str, Material] = {"Ogden": Ogden(), "I1": TwoTermI1()}
    rows = [f"| {name} | {' | '.join(by_law(laws[name], how))} |" for name in how.data]
    print("\n| data | p of the model, median | below 5 % | p of the law, median | below 5 % "
          "| one of them below 2.5 % |", "|---" * 6 + "|", *rows, sep="\n")  # fmt: skip


def test(
    material: Material, names: list[str], size: float, degree: int, strains: tuple[float, ...]
) -> ParametricTest:
    """Model with elements of ``size`` [mm] and ``degree``."""
    experiment = Experiment(SPECIMEN, material=material, strains=strains, mesh_size=size)
    return ParametricTest.meshed(experiment, names, degree)


def by_law(material: Material, how: argparse.Namespace) -> list[str]:
    """Identify an Ogden model from data of this law; medians of p, and how many are small."""
    seeds, strains, px = how.seeds, tuple(how.strains), how.pixel_size
    twin = test(material, ["tilt"], TWIN, 4, strains)
    states = twin.at(np.array([0.01]), False)
    model, fine = (test(Ogden(), list(UNKNOWNS), h, d, strains) for h, d in ((MESH, 3), (FINER, 4)))
    forces = np.array([s.force for s in states])
    sd = FORCE_NOISE * float(forces.max())
    snapshots = tuple(
        Snapshot(e, s.displacement, s.force, branch=s.branch)
        for e, s in zip(strains, states, strict=True)
    )
    speckle = SpeckleSpec(how.speckle, blur_px=0.15 / how.speckle)
    spec, pixels = ImagingSpec(px, margin_px=12, speckle=speckle), MeshPixels(model.mesh)
    unknowns, levels, found = UNKNOWNS, tuple(LEVELS), list[list[float]]()
    find, last, omitted = (
        model.near,
        partial(fine.near, with_derivatives=False),
        model.omitted_terms,
    )
    with tempfile.TemporaryDirectory() as folder:
        images = make_images(Solution(twin.mesh, snapshots, {}), spec, Path(folder), strains)
        exact = [images.reference(), *(images.deformed(e) for e in strains)]
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        f, *deformed = ((i + rng.normal(0.0, NOISE, i.shape)).astype(np.float32) for i in exact)
        data = [
            ImageData(ImagePair(f, g, images.grid), pixels, ImageNoise(NOISE, NOISE))
            for g in deformed
        ]
        result = identify(
            find, data, unknowns, pixel_size=px, levels=levels,
            forces=Readings(forces + rng.normal(0.0, sd, len(forces)), sd),
            finer=FinerMesh(last, error_ratio(FINER / MESH)), omitted=omitted,
            corrections=corrections(model.mesh.nodes, SPECIMEN.vectors),
        )  # fmt: skip
        tests = [getattr(result, name) for name in TESTS]
        found.append([each.p_value for each in tests])
        residual = result.state_equations[-1]
        print(seed, result.minimum.outcome.value, *(f"{v:.4f}" for v in result.values),
              f"residual {residual.residual / residual.expected:.3f}", *tests, sep="; ",
              flush=True)  # fmt: skip
        if not seed:
            values = result.minimum.unknowns
            find, last = linearised(model, values), linearised(fine, values, model.mesh)
            terms = omitted(values)
            unknowns = {
                name: Unknown(float(value), u.bounds)
                for (name, u), value in zip(unknowns.items(), values, strict=True)
            }
            levels, omitted = (FULL,), lambda _, terms=terms: terms
    p = np.array(found)
    small = [f"{int(count)} of {seeds}" for count in (p < 0.05).sum(axis=0)]
    median = [f"{value:.2g}" for value in np.median(p, axis=0)]
    either = f"{int((p.min(axis=1) < 0.025).sum())} of {seeds}"
    return [median[0], small[0], median[1], small[1], either]


if __name__ == "__main__":
    main()
