"""Data to share: folders as RO-Crates, the twelve standard cases, the leaderboard.

Guards: every file is listed with size and checksum, and every change is noticed; what tells a
truth is not shared; licence, units, software, command and the paper's DOI are there; the cases are
twelve and differ as their names say; a blind seed changes strains, speckles and noise; codes are
ranked by what they hand in, and what can't be graded is named.
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_benchmark as synthetic
from html_page import Page
from typer.testing import CliRunner

from modeharvest.cli.root import app
from modeharvest.idic.local.field import LocalField, write_field
from modeharvest.runs.benchmark.crate import METADATA, PAPER, verify, write_crate
from modeharvest.runs.benchmark.standard import FORMAT, TRUTH, leaderboard, standard_cases
from modeharvest.util.errors import InputError
from modeharvest.util.files import sha256_of, write_json
from modeharvest.validation.scoring.benchmark import BenchmarkTruth

SUMMARY = {
    "title": "A study of <nothing>",
    "command": "modeharvest study nothing --out DIR",
    "pixel_size_mm": 0.01,
    "largest_px": 12.5,
    "cases": 3,
    "versions": {"modeharvest": "0.1.0", "numpy": "2.0"},
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A finished run, with what is nobody's business."""
    made = tmp_path / "run"
    (made / "tables").mkdir(parents=True)
    write_json(made / "summary.json", SUMMARY)
    (made / "tables" / "table.csv").write_text("x [mm],u [px]\n1,2\n")
    (made / "field.h5").write_bytes(bytes(range(100)))
    (made / ".lock").write_text("someone")
    (made / "crash.log").write_text("/home/someone/secret")
    return made


def entities(content: Any) -> dict[str, Any]:
    return {entity["@id"]: entity for entity in content["@graph"]}


def test_a_crate_says_all_that_an_archive_asks_for(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    write_crate(folder, author="A. Person <https://orcid.org/0000-0001-2345-6789>")
    found = entities(json.loads((folder / METADATA).read_text("utf-8")))
    root = found["./"]
    assert found[METADATA]["conformsTo"]["@id"] == "https://w3id.org/ro/crate/1.1"
    assert root["name"] == SUMMARY["title"]
    assert root["datePublished"] == "1970-01-02"
    assert root["license"]["@id"] == "https://creativecommons.org/licenses/by/4.0/"
    assert root["citation"]["@id"] == PAPER
    assert found[PAPER]["@type"] == "ScholarlyArticle"
    assert [a["@id"] for a in root["author"]] == ["https://orcid.org/0000-0001-2345-6789"]
    assert {part["@id"] for part in root["hasPart"]} == {
        "summary.json", "tables/table.csv", "field.h5"
    }  # fmt: skip
    file = found["field.h5"]
    assert (file["contentSize"], file["sha256"]) == ("100", sha256_of(folder / "field.h5"))
    assert found["tables/table.csv"]["encodingFormat"] == "text/csv"
    assert found["#made"]["name"] == SUMMARY["command"]
    assert found["#numpy"]["version"] == "2.0"
    units = {found[u["@id"]]["name"]: found[u["@id"]]["unitText"] for u in root["variableMeasured"]}
    assert units == {"pixel_size_mm": "mm", "largest_px": "px"}
    # Whatever is pointed at is there.
    pointed = [value["@id"] for entity in found.values() for value in values_of(entity)]
    assert set(pointed) - {"https://w3id.org/ro/crate/1.1"} <= set(found)


def test_a_study_s_columns_have_units_and_a_run_its_command(folder: Path) -> None:
    (folder / "table.csv").write_text("seed,w_px,curvature_sd_mm\n1,2,3\n")
    run = {key: value for key, value in SUMMARY.items() if key != "command"} | {"snapshots": []}
    write_json(folder / "summary.json", run)
    found = entities(write_crate(folder))
    measured = [found[of["@id"]] for of in found["./"]["variableMeasured"]]
    assert [(m["name"], m["unitText"]) for m in measured[2:]] == [
        ("w_px", "px"), ("curvature_sd_mm", "mm")
    ]  # fmt: skip
    assert found["#made"]["name"].startswith("modeharvest run CASE.toml --out DIR, ")


def values_of(entity: dict[str, Any]) -> list[dict[str, str]]:
    each = [v if isinstance(v, list) else [v] for v in entity.values()]
    return [value for values in each for value in values if isinstance(value, dict)]


def test_every_change_is_noticed(folder: Path) -> None:
    write_crate(folder)
    assert verify(folder) == []
    (folder / "field.h5").write_bytes(bytes(reversed(range(100))))
    (folder / "tables" / "table.csv").unlink()
    (folder / "new.txt").write_text("?")
    assert verify(folder) == [
        "field.h5: changed (SHA-256)",
        "tables/table.csv: missing",
        f"new.txt: not listed in {METADATA}",
    ]


def test_a_crate_can_not_point_outside(folder: Path, tmp_path: Path) -> None:
    content = write_crate(folder)
    (tmp_path / "other").write_text("x")
    for entity in content["@graph"]:
        if entity["@id"] == "./":
            entity["hasPart"].append({"@id": "../other"})
    content["@graph"].append(
        {"@id": "../other", "contentSize": "1", "sha256": sha256_of(tmp_path / "other")}
    )
    write_json(folder / METADATA, content)
    assert verify(folder) == ["../other: lies outside the folder"]


@pytest.mark.parametrize(
    "content", [{}, {"@graph": []}, {"@graph": [{"@id": "./"}]}, [], {"@graph": 3}]
)
def test_what_is_no_crate_is_refused(folder: Path, content: Any) -> None:
    write_json(folder / METADATA, content)
    with pytest.raises(InputError, match="expected an RO-Crate"):
        verify(folder)


def test_a_folder_without_a_description_names_the_command_for_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="got none: 'modeharvest share' makes it"):
        verify(tmp_path)


def test_licences_and_folders_are_checked(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a licence"):
        write_crate(folder, licence="mine")
    with pytest.raises(InputError, match="expected a finished run"):
        write_crate(tmp_path)
    assert write_crate(folder, licence="https://example.org/licence")


@pytest.fixture(scope="module")
def benchmark(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return synthetic.make(tmp_path_factory.mktemp("set"))


def test_a_public_set_is_a_crate_without_its_truth(
    benchmark: tuple[Path, Path], tmp_path: Path
) -> None:
    public = tmp_path / "set"
    shutil.copytree(benchmark[0], public)
    found = entities(write_crate(public, licence="CC0-1.0"))
    assert found["./"]["license"]["@id"].endswith("/by/4.0/")  # its own licence counts
    assert found["#pixel_size_mm"]["value"] == synthetic.PIXEL
    assert verify(public) == []
    info = json.loads((public / "benchmark.json").read_text("utf-8"))
    write_json(public / "benchmark.json", info | {"id": "0" * 12})
    assert any("isn't that of its files" in fault for fault in verify(public))
    (public / "solution.h5").write_bytes(b"")
    with pytest.raises(InputError, match="expected a public folder without truth"):
        write_crate(public)


def test_commands_say_what_is_wrong(folder: Path) -> None:
    run = CliRunner().invoke
    assert run(app, ["share", str(folder)]).exit_code == 0
    assert run(app, ["benchmark", "verify", str(folder)]).exit_code == 0
    (folder / "field.h5").unlink()
    done = run(app, ["benchmark", "verify", str(folder)])
    assert done.exit_code == 2
    assert done.output == "field.h5: missing\n"


def test_the_standard_set_has_twelve_different_cases() -> None:
    cases = standard_cases()
    assert len(cases) == 12
    assert len({str(case.plain()) for case in cases.values()}) == 12
    reference = cases["reference"]
    for name in ("noise-1", "noise-3", "speckle-fine", "speckle-coarse", "resolution-low",
                 "resolution-high", "lens"):  # fmt: skip
        assert cases[name].experiment == reference.experiment
        assert cases[name].imaging != reference.imaging
    assert cases["noise-3"].imaging.sensor.read_noise == 0.03
    ratio = {
        n: c.experiment.specimen.diameter / c.experiment.specimen.pitch for n, c in cases.items()
    }
    assert ratio["ligaments-thick"] == pytest.approx(0.6)
    assert ratio["ligaments-thin"] > 0.86
    seeds = [case.imaging.speckle.seed for case in cases.values()]
    assert len(set(seeds)) == 12


def test_a_blind_seed_changes_what_could_be_known() -> None:
    open_set, blind = standard_cases(), standard_cases(7)
    for name, case in blind.items():
        assert case.experiment.strains != open_set[name].experiment.strains
        assert case.imaging.speckle.seed != open_set[name].imaging.speckle.seed
        assert case.imaging.sensor.read_seed != open_set[name].imaging.sensor.read_seed
    assert standard_cases(7).keys() == open_set.keys()
    assert [c.plain() for c in standard_cases(7).values()] == [c.plain() for c in blind.values()]


def test_codes_are_ranked_over_the_cases(benchmark: tuple[Path, Path], tmp_path: Path) -> None:
    truth, codes = tmp_path / "truth", tmp_path / "codes"
    cases = {}
    for name in ("first", "second"):
        shutil.copytree(benchmark[1], truth / name)
        known = BenchmarkTruth.read(truth / name)
        cases[name] = {"what": f"the {name}", "nominal_strain": synthetic.STRAIN, "id": known.id}
    write_json(truth / TRUTH, {"format": FORMAT, "seed": 0, "id": "abc", "title": "T <1>",
                               "cases": cases})  # fmt: skip
    x, y, u = synthetic.points(known, 4)
    random, px = np.random.default_rng(0), known.grid.pixel_size

    def hand_in(code: str, case: str, noise_px: float) -> None:
        (codes / code).mkdir(parents=True, exist_ok=True)
        noisy = u + noise_px * px * random.normal(size=u.shape)
        write_field(codes / code / f"{case}.csv", LocalField(x, y, noisy))

    hand_in("fine", "first", 0.02)
    hand_in("fine", "second", 0.08)
    hand_in("coarse", "first", 0.2)
    hand_in("coarse", "second", 0.2)
    hand_in("half", "first", 0.001)
    (codes / "half" / "second.csv").write_text("nothing\n")
    (codes / "half" / "secnd.csv").write_text("nothing\n")
    (codes / "half" / "README.txt").write_text("no field\n")
    (codes / "broken").mkdir()
    (codes / "broken" / "first.csv").write_text("nothing\n")
    board = leaderboard(codes, truth, tmp_path / "out")
    assert [row["code"] for row in board["codes"]] == ["fine", "coarse", "half", "broken"]
    assert [row["counted"] for row in board["codes"]] == [2, 2, 1, 0]
    assert board["codes"][-1]["rms_px"] is None
    assert board["codes"][0]["rms_px"] == pytest.approx(0.04, rel=0.1)  # the root of 0.02 * 0.08
    refused = [("half", "secnd"), ("broken", "first"), ("half", "second")]
    assert list(board["refused"]) == [str(codes / code / f"{n}.csv") for code, n in refused]
    assert "one of the cases first, second" in board["refused"][str(codes / "half" / "secnd.csv")]
    command = ("benchmark", "leaderboard", codes, "--truth", truth, "--out", tmp_path / "again")
    done = CliRunner().invoke(app, list(map(str, command)))
    assert done.exit_code == 2
    assert done.output.count("error: ") == 3
    assert "   broken: no case that counts" in done.output
    text = (tmp_path / "out" / "report.html").read_text("utf-8")
    page = Page(text)
    assert {"first/report.html", "second/report.html"} <= set(page.links)
    assert "T &lt;1&gt;" in text
    assert re.search(r"<th[^>]*>broken</th>", text)
    assert (tmp_path / "out" / "first" / "report.html").is_file()


def test_an_empty_folder_of_codes_is_refused(tmp_path: Path) -> None:
    write_json(tmp_path / TRUTH, {"format": FORMAT, "cases": {}, "id": "a", "title": "t"})
    with pytest.raises(InputError, match=r"expected files CODE/CASE\.csv"):
        leaderboard(tmp_path / "none", tmp_path, tmp_path / "out")


def test_of_many_unusable_files_a_few_are_named(tmp_path: Path) -> None:
    cases = {name: {} for name in "abcde"}
    write_json(tmp_path / TRUTH, {"format": FORMAT, "cases": cases, "id": "a", "title": "t"})
    (tmp_path / "codes" / "mine").mkdir(parents=True)
    for n in range(5):
        (tmp_path / "codes" / "mine" / f"{n}.csv").write_text("nothing\n")
    with pytest.raises(InputError, match=r"mine/2\.csv: [^;]*; and 2 more$"):
        leaderboard(tmp_path / "codes", tmp_path, tmp_path / "out")
