"""Score three DIC codes from PyPI, the whole displacement and micromorphic IDIC on a benchmark.

Run: benchmarks/score_codes/run [--specimen paper|plate] [--pixel-size 0.02] [--strain 0.128]
     [--only CODE ...] [--standard DIR [--cases CASE ...] [--table]]

Each code gets the public folder: 8-bit images, mask, benchmark.json (IDIC also uses the paper's
lattice). It returns a file in a public format, and 'modeharvest score' grades the files. All files
and the report are in out/score_codes. Specimens: the paper's, with 60 holes, and a plate with one.
With all codes, at that pixel size, the specimen's table in docs/how-to/scoring.md is written.

--standard: instead, the cases of a set that 'modeharvest benchmark standard --out DIR' made, and
their leaderboard; existing fields are kept, so that a run can be interrupted. With all cases its
table in docs/how-to/scoring.md is written; columns of codes without any field are kept there, if
the set is the same. --table: only grade the existing fields, and write that table.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.correlate import correlate
from modeharvest.idic.finite_element.files import read_result
from modeharvest.idic.finite_element.measure import measure_displacement
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.local.field import LocalField, write_field
from modeharvest.idic.local.subsets import WHERE, SubsetOptions, subset_field
from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.files import read_image, read_mask
from modeharvest.report.grades import grading_report
from modeharvest.report.model.output import print_report
from modeharvest.runs.benchmark import make_benchmark, score, truth_folder
from modeharvest.runs.benchmark.standard import leaderboard
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.runs.measure import measure
from modeharvest.util.errors import InputError, MissingDependencyError
from modeharvest.util.files import read_json

HERE = Path(__file__).resolve().parent
PAGE = HERE.parents[1] / "docs/how-to/scoring.md"
sys.path.append(str(HERE.parent / "peers"))
import document  # noqa: E402
import tables  # noqa: E402

OUT = HERE.parents[1] / "out" / "score_codes"
SUBSET_PX, STEP_PX = 21, 5
PIXEL_SIZE = 0.02
"""Pixel size of the comparison in docs/how-to/scoring.md [mm]."""
TIMEOUT_S = 600.0
"""Time limit, far longer than any code takes; for those that hang."""


@dataclass(frozen=True, eq=False)
class Task:
    """What a code gets: images [0 ... 255], masks and their pixels."""

    public: Path
    image: str
    mask_image: str
    reference_image: str
    reference: np.ndarray
    deformed: np.ndarray
    mask: np.ndarray
    grid: PixelGrid
    strain: float

    @classmethod
    def read(cls, public: Path, strain: float) -> Task:
        """Read the task of a public folder."""
        info: dict[str, Any] = json.loads((public / "benchmark.json").read_text("utf-8"))
        (entry,) = (d for d in info["deformed"] if abs(d["nominal_strain"] - strain) < 1e-9)
        corner = info["first_pixel_mm"]
        grid = PixelGrid(info["rows"], info["cols"], info["pixel_size_mm"], corner["x"],
                         corner["y_up"])  # fmt: skip
        first, second = info["reference"]["camera_image"], entry["camera_image"]
        f, g = (255.0 * read_image(public / name) for name in (first, second))
        masked = info["reference"]["mask"]
        mask = read_mask(public / masked)
        return cls(public, second, masked, first, f, g, mask, grid, strain)

    @property
    def pair(self) -> ImagePair:
        """The images with both masks."""
        return ImagePair(self.reference, self.deformed, self.grid, self.mask, self.deformed_mask)

    @property
    def deformed_mask(self) -> np.ndarray:
        """(rows, cols) True on the material of the deformed image, which is not black."""
        return np.asarray(self.deformed > 25)


def correlated(task: Task) -> Result:
    """Micromorphic IDIC with the paper's ansatz and start, and so its positions of holes."""
    how = SquareLatticeOptions()
    ansatz = how.ansatz(Specimen())
    guess = ansatz.initial_guess(task.strain, how.start_amplitude)
    return correlate(task.pair, ansatz, guess=guess, options=how.options())


def idic(task: Task, field: Path, codes: str) -> None:
    """Write the displacement of the ansatz alone."""
    found = correlated(task)
    step, grid = STEP_PX, task.grid
    row, col = np.mgrid[step // 2 : grid.rows : step, step // 2 : grid.cols : step]
    row, col = (i[task.mask[row, col]] for i in (row, col))
    write_field(field, LocalField(*grid.to_mm(row, col), found.displacement()[row, col]))


def whole(task: Task, field: Path, codes: str) -> None:
    """Write the whole displacement, started at the ansatz's result, as by 'run --whole-field'."""
    _write(task, field, measure_displacement(task.pair, correlated(task)))


def _write(task: Task, field: Path, found: NodalResult) -> None:
    """Write a displacement at every pixel of the material."""
    row, col = np.nonzero(task.mask)
    write_field(field, LocalField(*task.grid.to_mm(row, col), found.displacement_on()[row, col]))


def measured(task: Task, field: Path, codes: str) -> None:
    """Write the whole displacement as by 'modeharvest measure', from any images and their mask.

    It uses no law, lattice or mode, and does not know the material in the deformed image.
    """
    folder, pixel_size = field.parent / "measure", task.grid.pixel_size
    shutil.rmtree(folder, ignore_errors=True)
    reference, image, mask = (
        task.public / name for name in (task.reference_image, task.image, task.mask_image)
    )
    measure(reference, [image], folder, mask=mask, pixel_size=pixel_size)
    _write(task, field, read_result(folder / f"results/{image.stem}.h5"))


def pyvale(filling: float) -> Callable[[Task, Path, str], None]:
    """pyvale's subsets, with the options of its 2-D DIC documentation except for the first window.

    ``filling``: least share of a subset's pixels that must be material [-].
    """

    def run(task: Task, field: Path, codes: str) -> None:
        os.environ[WHERE] = codes
        options = SubsetOptions(subset_px=SUBSET_PX, step_px=STEP_PX, filling=filling)
        write_field(field, subset_field(task.pair, options))

    return run


def other(script: str) -> Callable[[Task, Path, str], None]:
    """A measurement by a script, in the environment of the three codes."""

    def run(task: Task, field: Path, codes: str) -> None:
        field.parent.mkdir(parents=True, exist_ok=True)
        quiet = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        done = subprocess.run(
            [codes, str(HERE / script), str(task.public), task.image, str(field)],
            cwd=field.parent, capture_output=True, text=True, timeout=TIMEOUT_S, env=quiet,
            check=False,
        )  # fmt: skip
        (field.with_suffix(".log")).write_text(done.stdout + done.stderr, "utf-8")
        if done.returncode != 0:
            raise RuntimeError(done.stderr.strip().rsplit("\n", 1)[-1] or f"{done.returncode}")

    return run


CODES: dict[str, Callable[[Task, Path, str], None]] = {
    "whole displacement": whole,
    "whole displacement, by measure": measured,
    "micromorphic IDIC, 77 unknowns": idic,
    "pyvale": pyvale(filling=1.0),
    "pyvale, partial subsets": pyvale(filling=0.7),
    "pyxel-dic": other("pyxel_side.py"),
    "al-dic": other("aldic_side.py"),
}


PLATE = Experiment(
    Specimen(1, 1, diameter=6.0, pitch=12.0, bulk_x=4.0, bulk_y=2.0),
    strains=(0.06,),
    mesh_size=0.25,
)
"""A plate with a hole, 20 x 16 mm."""
SPECIMENS = {"paper": 0.128, "plate": 0.06}
"""Nominal strains at which the specimens are measured [-]."""


OTHER_SPECIMENS = ("ligaments-thick", "ligaments-thin", "irregular", "plate")
"""Cases of the standard set without the paper's lattice, which two of the codes use."""


def standard(public: Path, arguments: argparse.Namespace) -> None:
    """Measure the cases of a standard set with every code; print and write a leaderboard."""
    handed_in, cases = OUT / "standard" / "codes", read_json(public / "summary.json")["cases"]
    wanted = () if arguments.table else arguments.cases or cases
    for case, code in product(wanted, arguments.only or CODES):
        field = handed_in / code / f"{case}.csv"
        if field.exists() or is_skipped(code, case):
            continue
        begin = time.perf_counter()
        try:
            task = Task.read(public / case, cases[case]["nominal_strain"])
            CODES[code](task, field, arguments.codes)
        except (RuntimeError, InputError, MissingDependencyError, subprocess.TimeoutExpired) as e:
            field.unlink(missing_ok=True)
            print(f"{case}, {code}: failed: {e}", flush=True)
            continue
        print(f"{case}, {code}: {time.perf_counter() - begin:.1f} s", flush=True)
    board = leaderboard(handed_in, truth_folder(public), OUT / "standard" / "graded")
    for row in board["codes"]:
        rms = {case: round(numbers["rms_px"], 4) for case, numbers in row["cases"].items()}
        print(f"{row['code']}: {row['rms_px']:.3g} px over {row['counted']} cases: {rms}")
    if not arguments.cases:
        earlier = tables.lines_of(PAGE, "standard")
        document.write(PAGE, {"standard": tables.standard(board, cases, is_skipped, earlier)})


def is_skipped(code: str, case: str) -> bool:
    """Whether a code starts from the paper's lattice, and the case has another one."""
    return CODES[code] in (idic, whole) and case in OTHER_SPECIMENS


def main() -> None:
    arguments = _arguments()
    if arguments.standard is not None:
        standard(arguments.standard.resolve(), arguments)
        return
    case, is_plate = Case.read("paper-virtual"), arguments.specimen == "plate"
    imaging = replace(case.imaging, pixel_size=arguments.pixel_size)
    case = case.model_copy(
        update={"imaging": imaging, **({"experiment": PLATE} if is_plate else {})}
    )
    out = OUT / arguments.specimen
    public = out / "set"
    solution = None if is_plate else shipped_solution("paper-virtual")
    info = make_benchmark(case, public, solution=solution)
    task = Task.read(public, arguments.strain or SPECIMENS[arguments.specimen])
    print(f"benchmark {info['id']}: {task.grid.rows} x {task.grid.cols} px")
    fields: list[Path] = []
    for name in arguments.only or CODES:
        if CODES[name] in (idic, whole) and is_plate:
            continue  # one hole has no pattern
        field = out / "fields" / f"{name}.csv"
        begin = time.perf_counter()
        try:
            CODES[name](task, field, arguments.codes)
        except (RuntimeError, InputError, MissingDependencyError, subprocess.TimeoutExpired) as e:
            print(f"{name}: failed: {e}")
            continue
        print(f"{name}: {time.perf_counter() - begin:.1f} s", flush=True)
        fields.append(field)
    graded = out / "graded"
    done = score(fields, truth_folder(public), task.strain, graded)
    print_report(grading_report(done), graded)
    if not (arguments.only or arguments.strain) and arguments.pixel_size == PIXEL_SIZE:
        document.write(PAGE, {arguments.specimen: tables.comparison(done)})


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="benchmarks/score_codes/run", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--specimen", choices=list(SPECIMENS), default="paper")
    parser.add_argument("--pixel-size", type=float, default=PIXEL_SIZE, help="[mm/px]")
    parser.add_argument("--strain", type=float, help="of the paper's: 0.078 or 0.128")
    parser.add_argument("--only", nargs="+", choices=list(CODES), help="only these codes")
    parser.add_argument("--standard", type=Path, metavar="DIR", help="a standard set's folder")
    parser.add_argument("--cases", nargs="+", help="only these of the standard set")
    parser.add_argument("--table", action="store_true", help="grade, measure nothing")
    parser.add_argument("--codes", required=True, help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    main()
