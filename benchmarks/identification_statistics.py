"""Identification of material and tilt from images and forces: bias, scatter, coverage, cost.

    scripts/env python benchmarks/identification_statistics.py --seeds 100
        [--linear] [--seeds 12 --pixel-size 0.02 --compare] [--fields] [--cost]

A small specimen, simulated with polynomials of degree 4, is photographed once without noise. Each
seed adds noise to images and forces, and identifies from values off by a factor of two (tilt from
0), by a model of degree 3 on another mesh. The last steps use the residual of a third mesh of
degree 4. It is a dask campaign, which continues where it was stopped. ``--linear`` starts from the
true values, with states that are linear about them, in a small part of the time. ``--compare`` also
updates the same model from displacements that were measured first: the whole displacement
(finite-element DIC without a law, started at the best fit of the ansatz), and pyvale's subsets
(MODEHARVEST_PYVALE names a Python that has it). ``--fields`` gives the error by the mesh: exact
displacements and forces of a fine mesh are identified on coarser ones. ``--cost`` times states of
the model with and without derivatives, on the whole path and from states nearby, also of the
paper's specimen. Tables: docs/explanation/identification_accuracy.md, identification_compared.md.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.path.parametric import ParametricState, ParametricTest
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz, AnsatzOptions
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.finite_element.equations.pixels import MeshPixels
from modeharvest.idic.finite_element.fields import element_gradients
from modeharvest.idic.finite_element.identification.identify import (
    LEVELS,
    FinerMesh,
    Model,
    Readings,
    Unknown,
    identify,
)
from modeharvest.idic.finite_element.identification.model_error import corrections
from modeharvest.idic.finite_element.identification.observed import (
    FieldData,
    ImageData,
    StateObservation,
)
from modeharvest.idic.finite_element.measure import measure_displacement
from modeharvest.idic.finite_element.result import nodal_values
from modeharvest.idic.local.subsets import SubsetOptions, subset_field
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import FULL
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.identification.pipeline import error_ratio
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, MissingDependencyError
from modeharvest.util.files import read_json, write_json
from modeharvest.validation.campaign import Campaign
from modeharvest.validation.workers import Workers

FUNCTION = "identification_statistics:one_seed"
SPECIMEN = Specimen(4, 4, diameter=1.6, bulk_x=0.9, bulk_y=0.4)
STRAINS = (0.06, 0.11)
"""Above the second strain edges of holes wrinkle, and results depend on the mesh."""
TRUE = {"moduli[0]": 1.2, "exponents[0]": 3.0, "kappa": 5.4, "tilt": 0.01}
UNKNOWNS = {
    "moduli[0]": Unknown(2.4, (0.1, 10.0)),
    "exponents[0]": Unknown(1.5, (0.5, 10.0)),
    "kappa": Unknown(10.8, (0.5, 100.0)),
    "tilt": Unknown(0.0, (-0.2, 0.2)),
}
TRUTH = np.array(list(TRUE.values()))
NOISE, FORCE_NOISE = 0.01, 0.005
IMAGES, WHOLE, SUBSETS = "images", "whole displacement", "subsets"
SUBSET = SubsetOptions(subset_px=21, step_px=5, threads=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--mesh", type=float, default=0.35, help="[mm]")
    parser.add_argument("--finer-mesh", type=float, default=0.25, help="[mm]")
    parser.add_argument("--twin-mesh", type=float, default=0.2, help="[mm]")
    parser.add_argument("--pixel-size", type=float, default=0.03, help="[mm/px]")
    parser.add_argument("--tilt", type=float, default=0.0, help="of the fields [rad]")
    parser.add_argument("--last", type=float, default=STRAINS[-1], help="strain of the fields")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("out/identification"))
    for name in ("compare", "fields", "cost", "linear"):
        parser.add_argument(f"--{name}", action="store_true")
    how = parser.parse_args()
    if how.fields:
        by_mesh(how.tilt, how.last)
    elif how.cost:
        costs()
    else:
        by_seed(how)


def made(
    size: float, degree: int = 3, names: tuple[str, ...] = tuple(TRUE), last: float = STRAINS[-1]
) -> ParametricTest:
    """Model with elements of ``size`` [mm] and polynomials of ``degree``, up to the last strain."""
    experiment = Experiment(SPECIMEN, strains=(STRAINS[0], last), mesh_size=size)
    return ParametricTest.meshed(experiment, names, degree)


def finer_mesh(
    size: float, mesh: float, linear_on: Mesh | None = None, last: float = STRAINS[-1]
) -> FinerMesh:
    """Mesh of degree 4 for the last steps, after elements of another size, ``mesh`` [mm]."""
    fine, ratio = made(size, 4, last=last), error_ratio(size / mesh)
    if linear_on is not None:
        return FinerMesh(linearised(fine, TRUTH, linear_on), ratio)
    return FinerMesh(lambda values: fine.near(values, False), ratio)


def linearised(test: ParametricTest, values: FloatArray, mesh: Mesh | None = None) -> Model:
    """Model that is linear about ``values``; its states are on another mesh if that is given."""
    states = test.at(values)
    if mesh is not None:
        own, nodes = test.mesh, mesh.nodes
        states = [
            replace(s, mesh=mesh, nodes_by=s.nodes_by[:0],
                    displacement=nodal_values(own, s.displacement, nodes, beside=True),
                    displacement_by=np.array([
                        nodal_values(own, by, nodes, beside=True) for by in s.displacement_by
                    ])) for s in states
        ]  # fmt: skip

    return linear_about(values, states)


def linear_about(values: FloatArray, states: list[ParametricState]) -> Model:
    """Model that is linear about ``values``, whose states and derivatives are given."""

    def near(others: FloatArray) -> list[ParametricState]:
        by = others - values
        return [
            replace(s, displacement=s.displacement + np.tensordot(by, s.displacement_by, 1),
                    force=s.force + float(by @ s.force_by)) for s in states
        ]  # fmt: skip

    return near


def by_mesh(tilt: float, last: float) -> None:
    """Print parameters that models of several meshes identify from exact states of a fine one."""
    fine, (x, y) = made(0.15, 4, last=last), np.mgrid[-4.7:4.7:0.06, -4.2:4.2:0.06].reshape(2, -1)
    states = fine.at(np.append(TRUTH[:3], tilt), False)
    points = np.column_stack([x, y])
    hole = SPECIMEN.pitch * (np.round(points / SPECIMEN.pitch - 0.5) + 0.5)  # the nearest
    points = points[np.linalg.norm(points - hole, axis=1) > 0.5 * SPECIMEN.diameter + 0.02]
    fields = [nodal_values(fine.mesh, s.displacement, points) for s in states]
    forces = Readings(np.array([s.force for s in states]), 0.002)
    print("| degree | elements [mm] | finer mesh of degree 4 [mm] | modulus | exponent "
          "| kappa | tilt | least stretch | residual, last state [um] | seconds |")  # fmt: skip
    print("|---" * 10 + "|")
    print("| 4 | 0.15 | truth |", *(f"{v:g} |" for v in (*TRUTH[:3], tilt)),
          f"{least_stretch(states[-1]):.3f} | | |", flush=True)  # fmt: skip
    for degree, size, finer in (
        (2, 0.35, None), (2, 0.2, None), (2, 0.12, None), (3, 0.35, None), (3, 0.25, None),
        (3, 0.35, 0.25), (3, 0.35, 0.2), (3, 0.25, 0.2),
    ):  # fmt: skip
        begin, model = time.process_time(), made(size, degree, last=last)
        data = [FieldData(points, u, 5e-4, model.mesh) for u in fields]
        fine_model = None if finer is None else finer_mesh(finer, size, last=last)
        found = identify(
            model.near, data, UNKNOWNS, pixel_size=0.03, forces=forces, finer=fine_model
        )
        residual = 1e3 * found.state_equations[-1].residual
        least = least_stretch(found.states[-1])
        # Values of the finer mesh, without their extrapolation.
        row = (f"{v:.4g}" for v in (*(found.values - found.mesh_error), least, residual))
        seconds = time.process_time() - begin
        print("|", degree, "|", size, "|", finer or "", "|", " | ".join(row), "|",
              f"{seconds:.0f} |", flush=True)  # fmt: skip


def least_stretch(state: ParametricState) -> float:
    """Least principal stretch in the elements [-]."""
    F = np.eye(2) + element_gradients(state.mesh, state.displacement)
    return float(np.linalg.svd(F, compute_uv=False).min())


def costs() -> None:
    """Print least processor times of states [s], medians of their ratios, and factorisations."""
    paper = Experiment(strains=(0.078, 0.11, 0.128), mesh_size=0.4)
    small = Experiment(SPECIMEN, strains=(0.06, 0.09, 0.12), mesh_size=0.35)
    names = ("moduli[0]", "exponents[0]", "kappa", "tilt", "travel")
    true, other = np.array([1.2, 3.0, 5.4, 0.01, 1.0]), np.array([1.22, 2.9, 5.5, 0.012, 1.001])
    print("| specimen | displacements | states | with derivatives | factorisations |")
    print("|---" * 5 + "|")
    for kind, experiment in (("4 x 4", small), ("6 x 10", paper)):
        model = ParametricTest.meshed(experiment, names)
        model.at(true)
        for what, find in (("whole path", model.at), ("nearby", model.near)):
            times = np.empty((1 if find == model.at else 9, 2))
            for pair in times:  # alternately, for other load
                for k, wanted in enumerate((False, True)):
                    find(true)
                    count, begin = model.structure.factorisations, time.process_time()
                    find(other, wanted)
                    pair[k] = time.process_time() - begin
                    count = model.structure.factorisations - count
            (plain, full), ratio = times.min(axis=0), np.median(times[:, 1] / times[:, 0])
            print(f"| {kind}, {what} | {model.unknowns} | {plain:.2f} s | {full:.2f} s, "
                  f"{ratio:.2f} times | {count} |", flush=True)  # fmt: skip


def by_seed(how: argparse.Namespace) -> None:
    """Print bias, scatter and coverage over seeds."""
    here = str(Path(__file__).parent)  # where workers find FUNCTION
    os.environ["PYTHONPATH"] = os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])
    twin = f"twin-{how.twin_mesh:g}-{how.pixel_size:g}"
    make_twin(how.folder / twin, how.twin_mesh, how.pixel_size)
    base = {"mesh": how.mesh, "finer": how.finer_mesh, "twin": twin, "linear": how.linear}
    base["methods"] = [IMAGES, WHOLE, SUBSETS] if how.compare else [IMAGES]
    cases = tuple({**base, "seed": seed} for seed in range(how.seeds))
    campaign = Campaign(FUNCTION, cases, how.folder.resolve())
    done = campaign.run(Workers(how.workers), lambda d, n, what: print(f"{d}/{n}", end="\r"))
    for error in sorted(set(done["error"]) - {""}):
        print(f"{int((done['error'] == error).sum())} seeds failed: {error}")
    if (done := done[done["error"] == ""]).empty:
        return
    print("| from | parameter | seeds | mean | bias [%] | scatter [%] | bias [standard errors] "
          "| scatter [standard errors] | within 95 % by noise | with model error "
          "| largest error [%] |")  # fmt: skip
    print("|---" * 11 + "|")
    for method in base["methods"]:
        found = done[done[f"{method} failed"] == ""]
        for name, true in TRUE.items() if len(found) else ():
            print(row_of(found, method, name, true))
    for method in base["methods"]:
        for reason, count in Counter(done[f"{method} failed"]).items():
            if reason:
                print(f"\n{method}: missing in {count} of {len(done)} seeds: {reason}")
    if "p" in done:
        p = done["p"].dropna()
        print(f"\nTest of the model: p below 5 % in {int((p < 0.05).sum())} of {len(p)}, median "
              f"{p.median():.2g}; {done['seconds'].mean():.1f} s of processor and "
              f"{done['evaluations'].mean():.1f} evaluations of the model for a seed by images; "
              f"outcomes {sorted(set(done['outcome'].dropna()))}")  # fmt: skip


def row_of(done: pd.DataFrame, method: str, name: str, true: float) -> str:
    """A line of the table."""
    value, sd, full = (np.array(done[f"{method} {name} {w}"]) for w in ("value", "sd", "full"))
    off, z = value - true, (value - true) / sd
    within = [100.0 * np.mean(abs(off) < 1.959964 * s) for s in (sd, full)]
    scatter = [np.std(each, ddof=1) if len(each) > 1 else np.nan for each in (off, z)]
    return (
        f"| {method} | `{name}` | {len(done)} | {value.mean():.5g} | "
        f"{100 * off.mean() / true:+.2f} | {100 * scatter[0] / true:.2f} | {z.mean():+.2f} | "
        f"{scatter[1]:.2f} | {within[0]:.0f} % | {within[1]:.0f} % | "
        f"{100 * abs(off).max() / true:.2f} |"
    )


def make_twin(folder: Path, size: float, pixel_size: float) -> None:
    """Make noise-free images and exact forces of the true test, unless they exist."""
    if (folder / "forces.json").exists():
        return
    twin = made(size, 4)
    states = twin.at(TRUTH, False)
    snapshots = tuple(
        Snapshot(e, s.displacement, s.force, branch=s.branch)
        for e, s in zip(STRAINS, states, strict=True)
    )
    spec = ImagingSpec(pixel_size=pixel_size, margin_px=12)
    make_images(Solution(twin.mesh, snapshots, {}), spec, folder, STRAINS)
    write_json(folder / "forces.json", [s.force for s in states])


@dataclass(frozen=True)
class Setting:
    """Data and models that all seeds of a campaign share."""

    images: ImageSet
    forces: FloatArray
    mesh: Mesh
    model: Model
    finer: FinerMesh
    pixels: MeshPixels
    corrections: FloatArray


@cache
def setting(twin: Path, mesh: float, finer: float, linear: bool) -> Setting:
    """Make the setting, once in each worker."""
    model = made(mesh)
    return Setting(
        ImageSet.read(twin), np.array(read_json(twin / "forces.json")), model.mesh,
        linearised(model, TRUTH) if linear else model.near,
        finer_mesh(finer, mesh, model.mesh if linear else None),
        MeshPixels(model.mesh), corrections(model.mesh.nodes, SPECIMEN.vectors),
    )  # fmt: skip


def one_seed(case: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Identify from the images and readings of one seed by each method; columns of the table."""
    known = setting(folder / case["twin"], case["mesh"], case["finer"], case["linear"])
    images, rng = known.images, np.random.default_rng(case["seed"])
    exact = (images.reference(), *(images.deformed(e) for e in STRAINS))
    f, *deformed = (i + rng.normal(0.0, NOISE, i.shape) for i in exact)
    force_sd = FORCE_NOISE * float(known.forces.max())
    readings = known.forces + rng.normal(0.0, force_sd, len(known.forces))
    forces = Readings(readings, force_sd)
    pairs = [images.pair(e).with_images(f, g) for e, g in zip(STRAINS, deformed, strict=True)]
    row: dict[str, Any] = {}
    initial = TRUE if case["linear"] else {n: u.start for n, u in UNKNOWNS.items()}
    unknowns = {n: Unknown(initial[n], u.bounds) for n, u in UNKNOWNS.items()}
    for method in case["methods"]:
        begin = time.process_time()
        try:
            found = identify(
                known.model, observed(method, pairs, known), unknowns,
                pixel_size=images.grid.pixel_size, forces=forces,
                levels=(FULL,) if case["linear"] else LEVELS, finer=known.finer,
                corrections=known.corrections if method == IMAGES else None,
            )  # fmt: skip
        except (InputError, MissingDependencyError) as error:
            row[f"{method} failed"] = str(error)
            continue
        row[f"{method} failed"] = ""
        parts = zip(TRUE, found.values, found.sd, found.sd_with_model_error, strict=True)
        for name, *numbers in parts:
            for what, number in zip(("value", "sd", "full"), numbers, strict=True):
                row[f"{method} {name} {what}"] = float(number)
        if method == IMAGES:
            row["seconds"] = time.process_time() - begin
            assert found.model_error is not None
            row["p"] = found.model_error.p_value
            row["evaluations"], row["outcome"] = found.evaluations, found.minimum.outcome.value
    return row


def observed(method: str, pairs: list[ImagePair], known: Setting) -> list[StateObservation]:
    """Data of each state for a method: images, or displacements measured in them."""
    if method == IMAGES:
        plain = (ImagePair(pair.reference, pair.deformed, pair.grid) for pair in pairs)
        return [ImageData(pair, known.pixels, ImageNoise(NOISE, NOISE)) for pair in plain]
    measure = whole if method == WHOLE else by_subsets
    return [FieldData(x, u, sd, known.mesh) for x, u, sd in map(measure, pairs)]


def whole(pair: ImagePair) -> tuple[FloatArray, FloatArray, float]:
    """Nodes, whole displacement there, and its rms standard deviation by noise [mm]."""
    assert pair.truth is not None
    ansatz = Ansatz.of_specimen(SPECIMEN, options=AnsatzOptions(4, 3))
    guess, u = ansatz.initial_guess(pair.strain), pair.truth.displacement
    found = measure_displacement(pair, fit_displacement(u, pair.grid, ansatz, guess, pair.mask))
    sd = float(np.sqrt(np.mean(found.noise_deviation**2)))
    return found.mesh.nodes, found.displacement, sd


def by_subsets(pair: ImagePair) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same by pyvale, from subsets of material alone, with predicted standard deviations."""
    field = subset_field(pair, SUBSET)
    assert field.sd is not None
    return np.stack([field.x, field.y], 1)[field.good], field.u[field.good], field.sd[field.good]


if __name__ == "__main__":
    main()
