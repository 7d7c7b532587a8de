"""Identification of material and tilt through a lens, with scattered holes and painted dots.

    scripts/env python benchmarks/identification_twins.py --seeds 100 [--holes hidden | --whole]

The specimen of ``identification_statistics.py``. Each seed scatters the holes anew, simulates the
specimen with polynomials of degree 4, and photographs it with dots of ink on its speckle, through a
known lens, with noise in images and forces. A model of degree 3 on another mesh identifies the
material, the tilt, and x, y and diameter of every hole; the last steps use the residual of a third
mesh of degree 4. It starts at the true values, and its states are linear about them. ``--holes
hidden`` takes the holes as drawn, and uses the model itself. ``--whole`` uses it, too, from values
off by a factor of two. A dask campaign, which continues where it was stopped. Table:
docs/explanation/identification_supports.md.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from identification_statistics import (
    FORCE_NOISE,
    NOISE,
    SPECIMEN,
    TRUE,
    TRUTH,
    UNKNOWNS,
    linear_about,
    made,
)

from modeharvest.fem.field import Snapshot, Solution
from modeharvest.fem.path.parameters import PARTS
from modeharvest.fem.path.parametric import ParametricTest
from modeharvest.fem.specimen import Imperfection
from modeharvest.idic.finite_element.equations.pixels import MeshPixels
from modeharvest.idic.finite_element.identification.identify import (
    LEVELS,
    FinerMesh,
    Readings,
    Unknown,
    identify,
)
from modeharvest.idic.finite_element.identification.model_error import corrections
from modeharvest.idic.finite_element.identification.observed import (
    ImageData,
    at_fixed_points,
    displacement_at,
)
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import FULL
from modeharvest.imaging.distortion.lens import CameraDistortion
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import Ink, SpeckleSpec
from modeharvest.runs.identification.pipeline import error_ratio
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.campaign import Campaign
from modeharvest.validation.workers import Workers

FUNCTION = "identification_twins:one_seed"
LAST = 0.1
"""Strain of the second state: with thinner ligaments free edges wrinkle earlier."""
ROUND = PARTS[:3]
OWN = tuple(f"holes[{k}].{part}" for k in range(len(SPECIMEN.hole_centres)) for part in ROUND)
MODEL = 0.35
"""Size of the model's elements [mm]."""
LENS = CameraDistortion(700.0, 700.0, 170.0, 140.0, k1=0.2, p1=0.01)
"""Shifts corners of images of 0.03 mm/px by up to 8 px, of 0.02 mm/px by up to 47 px."""
SPECKLE = SpeckleSpec(ink=Ink())
REACH_MM = 0.07


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--holes", choices=("unknown", "hidden"), default="unknown")
    parser.add_argument("--scatter", type=float, default=0.006, help="of x, y, diameter, sd [mm]")
    parser.add_argument("--pixel-size", type=float, default=0.03, help="[mm/px]")
    parser.add_argument("--finer-mesh", type=float, default=0.25, help="[mm]")
    parser.add_argument("--twin-mesh", type=float, default=0.2, help="[mm]")
    parser.add_argument("--plain", action="store_true", help="without lens and ink")
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path("out/identification"))
    how = parser.parse_args()
    here = str(Path(__file__).parent)  # where workers find FUNCTION
    os.environ["PYTHONPATH"] = os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])
    names = ("holes", "scatter", "pixel_size", "finer_mesh", "twin_mesh", "plain", "whole")
    cases = tuple({**{n: getattr(how, n) for n in names}, "seed": s} for s in range(how.seeds))
    campaign = Campaign(FUNCTION, cases, how.folder.resolve())
    done = campaign.run(Workers(how.workers), lambda d, n, what: print(f"{d}/{n}", end="\r"))
    for error in sorted(set(done["error"]) - {""}):
        print(f"{int((done['error'] == error).sum())} seeds failed: {error}")
    if not (done := done[done["error"] == ""]).empty:
        report(done)


def report(done: pd.DataFrame) -> None:
    """Print bias, scatter and coverage over seeds."""
    print("| parameter | seeds | bias [%] | scatter [%] | bias [standard errors] "
          "| scatter [standard errors] | within 95 % by noise | with model error "
          "| largest error [%] |")  # fmt: skip
    print("|---" * 9 + "|")
    for name, true in TRUE.items():
        off, sd, full = (np.array(done[f"{name} {w}"]) for w in ("off", "sd", "full"))
        within = [f"{100.0 * np.mean(abs(off) < 1.959964 * s):.0f} %" for s in (sd, full)]
        percent, z = 100.0 * off / true, off / full
        print(f"| `{name}` | {len(off)} | {percent.mean():+.2f} | {percent.std(ddof=1):.2f} "
              f"| {z.mean():+.2f} | {z.std(ddof=1):.2f} | {' | '.join(within)} "
              f"| {abs(percent).max():.2f} |")  # fmt: skip
    for part in ROUND if "x error" in done else ():
        error, sd = (1e3 * root_mean(np.array(done[f"{part} {w}"])) for w in ("error", "sd"))
        print(f"\nHoles' {part}: {error:.2f} um off, rms, predicted {sd:.2f} um; "
              f"{100.0 * done[f'{part} within'].mean():.1f} % within 95 % intervals")  # fmt: skip
    print(f"\nTest of the model: p below 5 % in {int((done['p'] < 0.05).sum())} of {len(done)}, "
          f"below 1 % in {int((done['p'] < 0.01).sum())}, median {done['p'].median():.2g}; "
          f"residual over noise {done['residual'].mean():.3f} "
          f"(largest {done['residual'].max():.3f}); "
          f"{done['seconds'].mean():.0f} s of processor and {done['evaluations'].mean():.1f} "
          f"evaluations of the model a seed; outcomes {sorted(set(done['outcome']))}")  # fmt: skip


@dataclass(frozen=True)
class Setting:
    """Models that all seeds of a campaign share."""

    twin: ParametricTest
    model: ParametricTest
    fine: ParametricTest
    pixels: MeshPixels


@cache
def setting(names: tuple[str, ...], finer_mesh: float, twin_mesh: float) -> Setting:
    """Make the setting, once in each worker."""
    sizes = (twin_mesh, 4, ("tilt", *OWN)), (MODEL, 3, names), (finer_mesh, 4, names)
    twin, model, fine = (made(*size, last=LAST) for size in sizes)
    return Setting(twin, model, fine, MeshPixels(model.mesh))


def one_seed(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Identify the parameters of one specimen; their errors and standard deviations."""
    seed, is_hidden = case["seed"], case["holes"] == "hidden"
    names = tuple(TRUE) if is_hidden else (*TRUE, *OWN)
    known = setting(names, case["finer_mesh"], case["twin_mesh"])
    rng = np.random.default_rng(seed)
    holes = Imperfection(case["scatter"], case["scatter"], seed=seed).drawn(len(OWN) // 3)[:, :3]
    states = known.twin.at(np.array([TRUE["tilt"], *holes.ravel()]), False)
    forces = np.array([s.force for s in states])
    force_sd = FORCE_NOISE * float(forces.max())
    strains = known.twin.experiment.strains
    data = photographed(case, Solution(
        states[0].mesh,
        tuple(Snapshot(e, s.displacement) for e, s in zip(strains, states, strict=True)),
    ), known.pixels)  # fmt: skip
    readings = Readings(forces + rng.normal(0.0, force_sd, len(forces)), force_sd)
    truth = TRUTH if is_hidden else np.append(TRUTH, holes)
    own = dict.fromkeys(OWN, Unknown(0.0, (-REACH_MM, REACH_MM)))
    unknowns = {name: (UNKNOWNS | own)[name] for name in names}
    begin = time.process_time()
    model, finer = known.model.near, partial(known.fine.near, with_derivatives=False)
    if not case["whole"]:
        unknowns = {n: Unknown(t, unknowns[n].bounds) for n, t in zip(names, truth, strict=True)}
    if not case["whole"] and not is_hidden:
        coarse = [at_fixed_points(s) for s in model(truth)]
        last = [
            replace(c, displacement=displacement_at(f, c.mesh.nodes), force=f.force)
            for c, f in zip(coarse, finer(truth), strict=True)
        ]
        model, finer = linear_about(truth, coarse), linear_about(truth, last)
    found = identify(
        model, data, unknowns, pixel_size=case["pixel_size"], forces=readings,
        levels=LEVELS if case["whole"] else (FULL,),
        finer=FinerMesh(finer, error_ratio(case["finer_mesh"] / MODEL)),
        corrections=corrections(known.model.mesh.nodes, SPECIMEN.vectors),
    )  # fmt: skip
    assert found.model_error is not None
    off, full = found.values - truth, found.sd_with_model_error
    row: dict[str, Any] = {"p": found.model_error.p_value, "seconds": time.process_time() - begin,
                           "evaluations": found.evaluations,
                           "outcome": found.minimum.outcome.value,
                           "residual": max(s.residual / s.expected
                                           for s in found.state_equations)}  # fmt: skip
    for k, name in enumerate(TRUE):
        row |= {f"{name} off": off[k], f"{name} sd": found.sd[k], f"{name} full": full[k]}
    for k, part in enumerate(() if is_hidden else ROUND):
        error, sd = (np.reshape(v[len(TRUE) :], (-1, len(ROUND)))[:, k] for v in (off, full))
        row |= {f"{part} error": root_mean(error), f"{part} sd": root_mean(sd),
                f"{part} within": np.mean(abs(error) < 1.959964 * sd)}  # fmt: skip
    return {name: v if isinstance(v, str) else float(v) for name, v in row.items()}


def photographed(
    case: Mapping[str, Any], solution: Solution, pixels: MeshPixels
) -> list[ImageData]:
    """Make camera images of all states."""
    seed, strains = case["seed"], [s.nominal_strain for s in solution.snapshots]
    sensor = Sensor(read_noise=NOISE, read_seed=seed)
    spec = ImagingSpec(case["pixel_size"], margin_px=12, bits=12, sensor=sensor)
    if not case["plain"]:
        spec = replace(spec, distortion=LENS, speckle=replace(SPECKLE, seed=seed))
    with tempfile.TemporaryDirectory() as folder:
        images = make_images(solution, spec, Path(folder), strains)
        f, *deformed = (images.reference(camera=True),
                        *(images.deformed(e, camera=True) for e in strains))  # fmt: skip
    lens, noise = spec.lens(images.grid.shape), ImageNoise(NOISE, NOISE)
    return [ImageData(ImagePair(f, g, images.grid), pixels, noise, lens=lens) for g in deformed]


def root_mean(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    main()
