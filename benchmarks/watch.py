"""Watching a test: time per photograph, and prediction of the strain of buckling.

scripts/env python benchmarks/watch.py            # predictions, 32 seeds
scripts/env python benchmarks/watch.py --step 0.01 --last 0.7    # a photograph every hundredth
scripts/env python benchmarks/watch.py --compare  # with other estimators, as a table
scripts/env python benchmarks/watch.py --time     # time per photograph of 3 Mpx
scripts/env python benchmarks/watch.py --memory harvest 20 200    # peak memory by photographs
scripts/env python benchmarks/watch.py --memory measure 20
scripts/env python benchmarks/watch.py --seeds 1 --picture docs/images/watch.png

Specimens of the paper's kind, 6 x 10 holes with a scatter of 0.01 mm in position and diameter, are
simulated at strains up to 0.95 of their own critical strains, photographed with 3 Mpx, 8 bits and
noise of 1 %, and measured as by `modeharvest harvest --watch`. Scatter, speckle and noise differ
for each seed. Results: docs/how-to/sequences.md.
"""

from __future__ import annotations

import argparse
import io
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Imperfection
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.report.figures import style
from modeharvest.report.figures.sequence import draw_amplitude, draw_growth
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.watch import QuickMeasurement, WatchedTest
from modeharvest.util.arrays import FloatArray
from modeharvest.validation.growth import follow_growth, predict

LAST = 0.95
"""Strain up to which photographs are taken, over the specimen's own critical strain [-]."""
PIXEL_SIZE = 0.0107
"""Pixel size of images of 3.14 Mpx [mm]."""
ASKED = (0.5, 0.6, 0.7, 0.8, 0.9)


def solved(experiment: Experiment, path: Path) -> Solution:
    """The solution of an experiment, computed once and kept in a file."""
    from modeharvest.fem.simulate import simulate

    if not path.is_file():
        simulate(experiment).write(path)
    return Solution.read(path)


def photographed(solution: Solution, folder: Path, pixel_size: float, seed: int) -> Path:
    """Photograph all states with a seed's speckle and noise; the experiment's TOML file."""
    spec = ImagingSpec(
        pixel_size, speckle=SpeckleSpec(seed=seed), sensor=Sensor(read_noise=0.01, read_seed=seed)
    )
    made = make_images(solution, spec, folder)
    for old in folder.glob("truth_*.h5"):
        old.unlink()
    shots = folder / "shots"
    shots.mkdir(exist_ok=True)
    for strain in made.strains:
        name = f"deformed_{1e4 * strain:04.0f}_8bit.tif"
        (shots / name).write_bytes((folder / name).read_bytes())
    path = folder / "experiment.toml"
    path.write_text(
        '[images]\nreference = "reference_8bit.tif"\ndeformed = ["shots"]\n'
        f"[scale]\npixel_size = {pixel_size}\n[specimen]\ncell_size = 1.9\n"
    )
    return path


def critical_strain(experiment: Experiment) -> float:
    """Critical strain of a specimen whose holes are the mean of this one's four mirror images [-].

    It has a bifurcation. To first order in the scatter, its strain is that to which this one's
    growth points, because mirroring reverses the critical mode but not its eigenvalue.
    """
    from modeharvest.fem.meshing import hole_motion, mesh_specimen
    from modeharvest.fem.path.parametric import ParametricTest

    spec = experiment.specimen
    mesh = mesh_specimen(spec, experiment.mesh_size)
    holes = experiment.imperfection.drawn(len(spec.hole_centres))
    holes = holes.reshape(spec.holes_x, spec.holes_y, -1)
    holes = 0.5 * (holes + holes[::-1] * [-1, 1, 1, 1, -1])
    holes = 0.5 * (holes + holes[:, ::-1] * [1, -1, 1, 1, -1])
    moved = hole_motion(mesh.nodes, spec, holes.reshape(-1, holes.shape[2]))
    perfect = replace(experiment, imperfection=Imperfection(), strains=experiment.strains[-1:])
    test = ParametricTest(perfect, (), replace(mesh, nodes=mesh.nodes + moved))
    test.with_critical = True  # also beyond the strains
    test.at(np.zeros(0), with_derivatives=False)
    assert test.critical_strain is not None
    return test.critical_strain


def watched(experiment: Path) -> list[dict[str, float]]:
    """Measure every photograph in turn."""
    measuring = QuickMeasurement(PhotographCase.read(experiment))
    return [measuring.measure(path) for path in sorted((experiment.parent / "shots").iterdir())]


def small_photographs(folder: Path, count: int) -> Path:
    """Make a reference and ``count`` states of 300 x 300 px, compressed by up to 4 %."""
    shots, pixel, l = folder / "shots", 0.035, 1.9  # noqa: E741
    shots.mkdir(parents=True, exist_ok=True)
    grid = PixelGrid.centred(300, 300, pixel)
    x, y = np.meshgrid(grid.x, grid.y)
    speckle = Speckle(SpeckleSpec(seed=2), grid.shape)
    for k in range(count + 1):
        X, Y = x / (1.0 - 0.04 * k / count), y / (1.0 + 0.02 * k / count)
        inside = (np.abs(X) < 2.35 * l) & (np.abs(Y) < 2.35 * l)
        near = np.hypot(X - l * np.rint(X / l), Y - l * np.rint(Y / l))
        inside &= (near > 0.7) | (np.abs(X) > 2.5 * l) | (np.abs(Y) > 2.5 * l)
        noise = 2.0 * np.random.default_rng(k).normal(size=grid.shape)
        levels = np.where(inside, 60.0 + 180.0 * speckle(*grid.to_px(X, Y)), 20.0) + noise
        name = f"shots/f{k}.tif" if k else "reference.tif"
        write_image(folder / name, np.clip(np.rint(levels), 0, 255).astype(np.uint8))
    path = folder / "experiment.toml"
    path.write_text(
        '[images]\nreference = "reference.tif"\ndeformed = ["shots"]\n'
        f"[scale]\npixel_size = {pixel}\n[specimen]\ncell_size = {l}\n"
        "[correlation]\nv0_degree = 2\nv_degree = 1\n"
    )
    return path


def peak(command: str, count: int, folder: Path) -> float:
    """Peak memory of harvesting or measuring ``count`` photographs [MiB]."""
    experiment = small_photographs(folder, count)
    what = [str(experiment)]
    if command == "measure":
        what = [str(folder / "reference.tif"), str(folder / "shots")]
    script = (
        "import resource, sys; from modeharvest.cli.root import main\n"
        "try: main()\n"
        "finally: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    ran = subprocess.run(
        [sys.executable, "-c", script, command, *what, "--out", str(folder / "out")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return float(ran.stdout.split()[-1])


def draw(rows: list[dict[str, float]], path: Path) -> None:
    """Draw the figure of docs/how-to/sequences.md for one test."""
    test = WatchedTest(rows)
    last = test.predictions[-1]
    assert last
    parts = []
    with style.style():
        for drawn in (draw_amplitude(test, last), draw_growth(test, last)):
            memory = io.BytesIO()
            drawn.savefig(memory, dpi=110, facecolor="white")
            parts.append(Image.open(memory))
    whole = Image.new("RGB", (sum(part.width for part in parts), parts[0].height))
    for k, part in enumerate(parts):
        whole.paste(part, (k * parts[0].width, 0))
    whole.quantize(64).save(path, optimize=True)


def least_deviation(columns: FloatArray, imperfection: float, critical: float) -> float:
    """Least standard deviation of any unbiased prediction, over the critical load (Cramér–Rao).

    ``columns`` (4, n): load, amplitude, and its standard deviations by noise (half of this variance
    is common to all images) and by model error. Priors are 0 +- 0.15 of the imperfection's part,
    and the model error, for the linear part, and the model error for the quadratic one
    (``validation/growth.py``).
    """
    load, _, sd, model = columns
    ahead, a0 = critical - load, abs(imperfection)
    x = load / load[-1]
    J = np.stack([-a0 * load / ahead**2, load / ahead, x, x**2, sd], axis=1)
    J /= (sd * np.sqrt(0.5))[:, None]
    linear = np.hypot(0.15 * a0 * load[-1] / critical, model[-1])
    prior = np.diag([0.0, 0.0, 1.0 / linear**2, 1.0 / model[-1] ** 2, 2.0])
    information = J.T @ J + prior
    return float(np.sqrt(np.linalg.inv(information)[0, 0])) / critical


def by_southwell_plot(columns: FloatArray) -> float:
    """The critical load by Southwell's plot: 1 over the slope of a/p against a, weighted."""
    load, amplitude, sd, _ = columns
    weight = load / sd
    line = np.stack([np.ones_like(load), amplitude], axis=1) * weight[:, None]
    return float(1.0 / np.linalg.lstsq(line, amplitude / load * weight)[0][1])


def by_least_squares(columns: FloatArray) -> float:
    """The critical load by least squares of a = a0 p / (p_c - p) + e, e common to all images."""
    load, amplitude, sd, _ = columns
    tried = load.max() * np.geomspace(1.01, 4.0, 600)
    ahead = load / (tried[:, None] - load)
    A = np.stack([ahead, np.ones_like(ahead)], axis=2) / sd[:, None]
    a = amplitude / sd
    fit = np.linalg.solve(A.mT @ A, (A.mT @ a)[..., None])
    left = (((A @ fit)[..., 0] - a) ** 2).sum(axis=1)
    return float(tried[np.argmin(np.where(fit[:, 0, 0] * amplitude[-1] > 0.0, left, np.inf))])


def by_posterior(columns: FloatArray) -> float:
    """The critical load as predicted by the program."""
    found = predict(columns)
    return found.critical if found else float("nan")


def upper_half(columns: FloatArray) -> FloatArray:
    """Images at more than half of the largest load."""
    return columns[:, columns[0] > 0.5 * columns[0].max()]


ESTIMATORS: dict[str, Callable[[FloatArray], float]] = {
    "posterior, as used": by_posterior,
    "posterior, upper half of the loads": lambda c: by_posterior(upper_half(c)),
    "Southwell's plot": by_southwell_plot,
    "Southwell's plot, upper half": lambda c: by_southwell_plot(upper_half(c)),
    "least squares, no slow part": by_least_squares,
}


def print_compared(tests: Sequence[tuple[FloatArray, float]], shares: FloatArray) -> None:
    """Print the estimators' errors; ``tests``: columns, and the true critical load."""
    heads = "estimator", "at", "within 3 %", "rms [%]", "median size [%]", "largest [%]"
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for share, (name, of) in product((0.6, 0.7, 0.8), ESTIMATORS.items()):
        count = int((shares <= share + 1e-6).sum())
        off = np.array([100.0 * (of(columns[:, :count]) / there - 1.0) for columns, there in tests])
        size = np.where(np.isfinite(off), np.abs(off), np.inf)
        numbers = np.sqrt(np.mean(size**2)), np.median(size), size.max()
        cells = f"{(size < 3.0).sum()} of {len(off)}", *(f"{value:.1f}" for value in numbers)
        print(f"| {name} | {share:.0%} | {' | '.join(cells)} |")


def print_memory(command: str, counts: Iterable[int]) -> None:
    """Print peak memory, and time per photograph, for each count of photographs."""
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            begin = time.perf_counter()
            most = peak(command, count, Path(folder))
            took = (time.perf_counter() - begin) / count
        print(f"{command}, {count} photographs: {most:.0f} MiB, {took:.1f} s each", flush=True)


def print_times(strains: Sequence[float], out: Path) -> None:
    """Print the time that each photograph of a specimen takes."""
    experiment = Experiment(strains=strains, imperfection=Imperfection(0.01, 0.01, 1))
    path = photographed(solved(experiment, out / "time.h5"), out / "time", PIXEL_SIZE, 1)
    measuring = QuickMeasurement(PhotographCase.read(path))
    print(f"{measuring.reference.image.size / 1e6:.2f} Mpx")
    for shot in sorted((path.parent / "shots").iterdir()):
        begin = time.process_time()
        row = measuring.measure(shot)
        busy = time.process_time() - begin
        print(f"{row['name']}: {row['seconds']:.2f} s, {busy:.2f} s of processors, strain "
              f"{100 * row['strain']:.2f} %", flush=True)  # fmt: skip


def measured(experiment: Experiment, seed: int, kept: Path) -> list[dict[str, float]]:
    """Measure an experiment's photographs; the result is kept in a file for the next run."""
    if not kept.is_file():
        solution = solved(experiment, kept.with_suffix(".h5"))
        rows = watched(photographed(solution, kept.with_suffix(""), PIXEL_SIZE, seed))
        kept.write_text(json.dumps(rows))
    return json.loads(kept.read_text())


class Checked(NamedTuple):
    """A prediction at a share of the critical load, compared with the true critical load."""

    share: float
    error: float
    """Relative error of the critical load [-]."""
    holds: bool
    """Whether its 95 % interval holds."""
    is_useful: bool
    text: str


def checked(columns: FloatArray, there: float, shares: FloatArray) -> Iterator[Checked]:
    """Predictions at the shares ``ASKED`` of the true critical load ``there``."""
    predictions = follow_growth(columns)
    for share in ASKED:
        at = predictions[int(np.flatnonzero(share + 1e-6 >= shares)[-1])]
        if at is not None and share <= shares[-1] + 1e-6:
            least = least_deviation(columns[:, : at.count], at.imperfection, there)
            text = (f"{share:.0%} {100 * at.critical:.2f} ({at.interval}; sd at least "
                    f"{100 * least:.1f} % of it)")  # fmt: skip
            holds = at.low <= there <= at.high
            yield Checked(share, at.critical / there - 1.0, holds, at.is_useful, text)


def print_shares(found: Sequence[Checked], seeds: int) -> None:
    """Print errors and coverage of predictions, by the load at which they were made."""
    for share in sorted({f.share for f in found}):
        _, off, holds, useful, _ = (
            np.array(of) for of in zip(*(f for f in found if f.share == share), strict=True)
        )
        of_use = off[useful]
        print(
            f"at {share:.0%}: of {seeds}, within 3 % {(np.abs(off) < 0.03).sum()}, intervals "
            f"hold {holds.sum()}; said to be of use {useful.sum()}, of these median "
            f"{100 * np.median(of_use):+.1f} %, rms {100 * np.sqrt(np.mean(of_use**2)):.1f} %, "
            f"largest {100 * np.abs(of_use).max():.1f} %, within 3 % "
            f"{(np.abs(of_use) < 0.03).sum()}, intervals hold {holds[useful].sum()}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--memory", nargs="+", metavar=("COMMAND", "COUNT"))
    parser.add_argument("--compare", action="store_true")
    parser.add_argument("--time", action="store_true")
    parser.add_argument("--seeds", type=int, default=32)
    parser.add_argument("--scatter", type=float, default=0.01)
    parser.add_argument("--step", type=float, default=0.05, help="of the critical strain")
    parser.add_argument("--last", type=float, default=LAST, help="of the critical strain")
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "watch")
    given = parser.parse_args()
    if given.memory:
        print_memory(given.memory[0], map(int, given.memory[1:]))
        return
    given.out.mkdir(exist_ok=True)
    shares = given.step * np.arange(1, round(given.last / given.step) + 1)
    perfect = critical_strain(Experiment())
    print(f"critical strain of the perfect specimen {100 * perfect:.3f} % nominal")
    if given.time:
        print_times(tuple(np.round(perfect * shares, 4))[::4], given.out)
        return
    found, tests = list[Checked](), list[tuple[FloatArray, float]]()
    for seed in range(1, given.seeds + 1):
        experiment = Experiment(imperfection=Imperfection(given.scatter, given.scatter, seed))
        critical = critical_strain(experiment)
        strains = tuple(np.round(critical * shares, 4))
        name = f"{given.scatter:g}_{given.step:g}_{given.last:g}_{seed}_{critical:.5f}.json"
        rows = measured(replace(experiment, strains=strains), seed, given.out / name)
        if seed == 1 and given.picture is not None:
            draw(rows[: int((shares < 0.71).sum())], given.picture)
        columns = WatchedTest(rows).columns
        # The measured strain is that of the cellular part, without the bulk at its edges.
        there = float(np.polyval(np.polyfit(strains, columns[0], 2), critical))
        tests.append((columns, there))
        own = list(checked(columns, there, shares))
        found += own
        texts = [f"seed {seed}: {100 * there:.2f} % ({100 * critical:.3f} % nominal);"]
        print("  ".join(texts + [f.text for f in own]), flush=True)
    print_shares(found, given.seeds)
    if given.compare:
        print_compared(tests, shares)


if __name__ == "__main__":
    main()
