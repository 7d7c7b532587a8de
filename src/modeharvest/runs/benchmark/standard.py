"""The standard set of twelve cases, and a leaderboard of the fields that codes submit for it.

::

    DIR/         CASE/ summary.json ro-crate-metadata.json     benchmark standard
    DIR-truth/   CASE/ standard.json
    CODES/       CODE/CASE.csv                                 submitted fields, any file type
    OUT/         CASE/report.html leaderboard.json report.html benchmark leaderboard
"""

from __future__ import annotations

import random
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.specimen import Imperfection, Specimen
from modeharvest.idic.local.tables import READERS
from modeharvest.runs.benchmark import make_benchmark, score, truth_folder
from modeharvest.runs.benchmark.crate import write_crate
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.util.errors import InputError
from modeharvest.util.files import make_folder, read_record, write_json
from modeharvest.util.progress import Progress, counted, silent
from modeharvest.util.stages import digest, versions
from modeharvest.validation.scoring.benchmark import SOLUTION, Declared
from modeharvest.validation.scoring.score import ENOUGH_COVERED

FORMAT, TRUTH = "modeharvest-standard-1", "standard.json"
_REASONS = 3
"""How many reasons are named if nothing could be graded."""


def standard_cases(seed: int = 0) -> dict[str, Case]:
    """The twelve cases of ``standard.toml``; ``seed`` varies strains, speckles and noise."""
    base, cases = Case.read("paper-virtual"), {}
    factor = random.Random(seed).uniform(0.95, 1.05) if seed else 1.0
    text = resources.files(__package__).joinpath("standard.toml").read_text("utf-8")
    for n, (name, own) in enumerate(tomllib.loads(text).items()):
        drawn, experiment = 1000 * seed + n, base.experiment
        speckle = replace(base.imaging.speckle, seed=drawn, **own.get("speckle", {}))
        seeds = {"read_seed": drawn, "shot_seed": drawn}
        sensor = replace(base.imaging.sensor, **seeds, **own.get("sensor", {}))
        size = own.get("imaging", {"pixel_size": 0.02})
        imaging = replace(base.imaging, speckle=speckle, sensor=sensor, **size)
        if "specimen" in own:
            scatter = Imperfection(seed=drawn, **own.get("imperfection", {}))
            experiment = Experiment(Specimen(**own["specimen"]), imperfection=scatter)
        experiment = replace(experiment, strains=(round(factor * own["strain"], 5),))
        cases[name] = Case(title=own["title"], experiment=experiment, imaging=imaging)
    return cases


def make_standard(
    public: Path | str, truth: Path | str | None = None, seed: int = 0, progress: Progress = silent
) -> dict[str, Any]:
    """Make the standard set: a public folder that is an RO-Crate, and separately the truth.

    Can be resumed. ``seed``: 0 is the open set, which anybody can reproduce with its truth; the
    truth for another seed is known only to its maker. Returns the content of ``summary.json``.
    """
    public = Path(public)
    truth = truth_folder(public) if truth is None else Path(truth)
    solution, made = shipped_solution("paper-virtual") if seed == 0 else None, {}
    cases = standard_cases(seed)
    for name in counted(tuple(cases), progress, "standard set"):
        case = cases[name]
        own = case.experiment != cases["reference"].experiment
        info = make_benchmark(
            case, public / name, truth / name, None if own else solution, progress
        )
        solution = solution or truth / "reference" / SOLUTION
        (strain,) = case.experiment.strains
        made[name] = {"what": case.title, "nominal_strain": strain, "id": info["id"]}
    kind = "open" if seed == 0 else "blind"
    summary = {
        "title": f"modeharvest standard set 1 for DIC on perforated material, {kind}",
        "question": "How well does a DIC code measure displacements in perforated and patterned "
        "material? Twelve pairs of images; each folder's README.md says what to return.",
        "command": f"modeharvest benchmark standard --out {public.name}"
        + (" --seed SEED" if seed else ""),
        "id": digest([entry["id"] for entry in made.values()])[:12],
        "cases": made,
        "versions": versions(),
    }
    write_json(truth / TRUTH, {"format": FORMAT, "seed": seed, **summary})
    write_json(public / "summary.json", summary)
    write_crate(public)
    return summary


def leaderboard(
    handed_in: Path | str, truth: Path | str, out: Path | str, progress: Progress = silent
) -> dict[str, Any]:
    """Grade a folder of submissions, ``CODE/CASE.*``; writes a page for each case and one for all.

    A code's score is the geometric mean of its rms errors [px] over the cases in which it covers
    at least half of the material; codes with more such cases rank first, those without any come
    last, without a rank. Returns the content of ``leaderboard.json``. InputError if no file can be
    graded.
    """
    from modeharvest.report.model.content import Card, Report, ReportTable, Section
    from modeharvest.report.model.output import write_page

    handed_in, truth, out = Path(handed_in), Path(truth), Path(out)
    remedy = "'modeharvest benchmark standard' leaves it beside the public folder"
    known = read_record(truth / TRUTH, FORMAT, "the truth of a standard set", remedy)
    codes = sorted(p.name for p in handed_in.iterdir() if p.is_dir()) if handed_in.is_dir() else []
    found: dict[str, dict[str, Mapping[str, float]]] = {code: {} for code in codes}
    refused = {
        str(path): f"{path}: expected a file named as one of the cases {', '.join(known['cases'])}"
        for code in codes for path in sorted((handed_in / code).iterdir())
        if path.suffix.lower() in READERS and path.stem not in {*known["cases"], "README", "readme"}
    }  # fmt: skip
    for name, case in known["cases"].items():
        files = {path: Declared(name=code) for code in codes
                 for path in sorted((handed_in / code).glob(f"{name}.*"))[:1]}  # fmt: skip
        if not files:
            continue
        make_folder(out / name)
        try:
            done = score(files, truth / name, case["nominal_strain"], out / name, progress=progress)
        except InputError as error:
            refused[name] = str(error)
            continue
        refused |= done.refused
        for one in done.scores:
            numbers = {"rms_px": one.everywhere.rms_px, "covered": one.covered}
            found[one.source][name] = numbers
    rows = [{"code": code, **_overall(cases), "cases": cases} for code, cases in found.items()]
    rows.sort(key=lambda r: (-r["counted"], r["rms_px"] or 0.0, not r["cases"]))
    if not any(found.values()):
        raise InputError(
            f"expected files CODE/CASE.csv in {handed_in}, got none to grade"
            + "".join(f"; {why}" for why in [*refused.values()][:_REASONS])
            + f"; and {len(refused) - _REASONS} more" * (len(refused) > _REASONS)
        )
    board = {"set": known["id"], "title": known["title"], "codes": rows, "refused": refused}
    columns = ["code", "cases that count", "geometric mean of rms [px]", *known["cases"]]
    cells = [[f"{n}. {r['code']}" if r["counted"] else r["code"], r["counted"], r["rms_px"],
              *(r["cases"].get(c, {}).get("rms_px") for c in known["cases"])]
             for n, r in enumerate(rows, 1)]  # fmt: skip
    what = [[n, c["what"], 100 * c["nominal_strain"]] for n, c in known["cases"].items()]
    board_table = ReportTable("Rms error per component [px]", columns, cells, "board")
    about = ReportTable("Cases", ["case", "what it is", "nominal strain [%]"], what, "cases")
    cards = [card for t in (board_table, about) for card in Card.tabular(t, wide=True)]
    pages = {f"{name}/report.html": case["what"] for name, case in known["cases"].items()}
    graded = {name: what for name, what in pages.items() if (out / name).is_file()}
    report = Report(
        kind="leaderboard", title=known["title"],
        lead=f"Set {known['id']}. Rms errors in px per component, over the points that each code "
        f"returns; a case counts if its points cover {100 * ENOUGH_COVERED:g} % of the material. "
        "Codes without a number have no case that counts.",
        sections=[Section("ranking", "Ranking", cards)],
        warnings=list(refused.values()), command="modeharvest benchmark leaderboard CODES "
        "--truth DIR-truth --out DIR", files=graded,
    )  # fmt: skip
    write_page(report, out / "report.html", progress)
    write_json(out / "leaderboard.json", board)
    return board


def _overall(cases: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """The number of cases that count, and the geometric mean of their errors [px]."""
    errors = [max(c["rms_px"], 1e-9) for c in cases.values() if c["covered"] >= ENOUGH_COVERED]
    rms = float(np.exp(np.mean(np.log(errors)))) if errors else None
    return {"counted": len(errors), "rms_px": rms}
