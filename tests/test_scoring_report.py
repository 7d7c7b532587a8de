"""Several fields: ranked, in files and on a page, by command.

Guards: the best comes first, whoever covers little does not win; numbers of table, files and page
are the same; nothing is loaded from elsewhere; the error's spectrum adds up.
"""

from __future__ import annotations

import csv
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic_benchmark as made
from explored import content_of, quantity
from html_page import Page
from numpy.typing import NDArray
from summary_schemas import faults
from synthetic_benchmark import PIXEL, STRAIN

from modeharvest.cli.root import main
from modeharvest.idic.local.field import LocalField, write_field
from modeharvest.imaging.grid import PixelGrid
from modeharvest.report.model.text import number
from modeharvest.runs import benchmark
from modeharvest.validation.scoring import score as grades
from modeharvest.validation.scoring import score as spectra
from modeharvest.validation.scoring.benchmark import BenchmarkTruth
from modeharvest.validation.scoring.score import (
    REGIONS,
    Grading,
    Score,
    error_spectrum,
    ranked,
    regions,
    score,
)

FloatArray = NDArray[np.float64]


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> BenchmarkTruth:
    return BenchmarkTruth.read(made.make(tmp_path_factory.mktemp("benchmark"))[1])


def noisy(truth: BenchmarkTruth, sd_px: float, name: str, share: float = 1.0) -> LocalField:
    """The truth with noise; the last points lost."""
    x, y, u = made.points(truth)
    u = u + sd_px * PIXEL * np.random.default_rng(0).normal(size=u.shape)
    u[int(share * len(u)) :] = np.nan
    return LocalField(x, y, u, source=name)


def labels(truth: BenchmarkTruth) -> NDArray[np.int8]:
    return regions(truth.mask, truth.grid, truth.specimen, edge_px=3)


def score_of(truth: BenchmarkTruth, field: LocalField) -> Score:
    true = truth.displacement(STRAIN, field.x, field.y)
    return score(field, true, labels(truth), truth.grid)


def test_regions_without_material_are_named(truth: BenchmarkTruth) -> None:
    """With wide edges the ligaments of small images are all edge, and their row is empty."""
    graded = score_of(truth, noisy(truth, 0.1, "one"))
    for edge_px, empty in ((3, ["bulk"]), (1000, ["ligaments", "junctions", "bulk"])):  # no bulk
        own = regions(truth.mask, truth.grid, truth.specimen, edge_px)
        notes = Grading(truth, STRAIN, edge_px, own, (graded,), {}).notes
        expected = [
            f"no material is in {name}, {edge_px} px or more from any edge" for name in empty
        ]
        assert [note for note in notes if note.startswith("no material")] == expected


@pytest.fixture(scope="module")
def command(
    truth: BenchmarkTruth, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str, int]:
    """Folder, what was said, and exit code of ``modeharvest score`` on three fields."""
    folder = tmp_path_factory.mktemp("codes")
    for name, sd, share in (("fair", 0.1, 0.9), ("good", 0.01, 1.0), ("sparse", 0.001, 0.4)):
        write_field(folder / f"{name}.csv", noisy(truth, sd, name, share))
    fields = [folder / f"{name}.csv" for name in ("fair", "sparse", "good")]
    with pytest.MonkeyPatch.context() as patch:
        return folder, *run(patch, folder, truth, fields)


def run(
    patch: pytest.MonkeyPatch, folder: Path, truth: BenchmarkTruth, fields: list[Path]
) -> tuple[str, int]:
    arguments = ["score", *fields, "--truth", truth.folder, "--strain", STRAIN]
    patch.setattr(sys, "argv", ["modeharvest", *map(str, arguments), "--out", str(folder / "out")])
    message: list[str] = []
    patch.setattr(
        "rich.console.Console.print", lambda _, *what, **how: message.extend(map(str, what))
    )
    try:
        main()
    except SystemExit as end:
        return "\n".join(message), int(end.code or 0)
    return "\n".join(message), 0


def test_the_best_comes_first_and_the_sparse_last(truth: BenchmarkTruth) -> None:
    fields = [noisy(truth, 0.1, "fair"), noisy(truth, 0.001, "sparse", 0.4),
              noisy(truth, 0.01, "good"), noisy(truth, 0.05, "holey", 0.8)]  # fmt: skip
    scores = [score_of(truth, field) for field in fields]
    assert [s.source for s in ranked(scores)] == ["good", "holey", "fair", "sparse"]
    assert [s.source for s in ranked(scores[::-1])] == ["good", "holey", "fair", "sparse"]


def test_files_and_page_tell_the_same(command: tuple[Path, str, int]) -> None:
    folder, message, code = command
    assert code == 0
    summary = json.loads((folder / "out" / "scores.json").read_text("utf-8"))
    assert faults(summary, "score") == []
    assert [field["name"] for field in summary["fields"]] == ["good", "fair", "sparse"]
    assert summary["fields"][1]["everywhere"]["returned"] == pytest.approx(0.9, abs=1e-3)
    page = (folder / "out" / "report.html").read_text("utf-8")
    with (folder / "out" / "scores.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * (2 + len(REGIONS))
    for field in summary["fields"]:
        rms = field["everywhere"]["rms_px"]
        (row,) = (r for r in rows if (r["field"], r["region"]) == (field["name"], "everywhere"))
        assert float(row["rms [px]"]) == pytest.approx(rms, rel=1e-5)
        assert number(rms, 3) in page
    assert "sparse covers" in message
    assert "sparse covers" in page
    assert "report.html" in message


def test_regions_without_points_are_null_in_json(truth: BenchmarkTruth, tmp_path: Path) -> None:
    def refuse(name: str) -> None:
        raise AssertionError(name)

    write_field(tmp_path / "one.csv", noisy(truth, 0.1, "one"))
    benchmark.score([tmp_path / "one.csv"], truth.folder, STRAIN, tmp_path / "out", edge_px=1000)
    text = (tmp_path / "out" / "scores.json").read_text("utf-8")
    (field,) = json.loads(text, parse_constant=refuse)["fields"]
    assert field["edges"]["rms_px"] > 0.0
    assert field["bulk"]["rms_px"] is None
    assert field["bulk"]["bias_px"] == [None, None]


def test_where_all_measure_is_where_the_sparse_one_does(command: tuple[Path, str, int]) -> None:
    summary = json.loads((command[0] / "out" / "scores.json").read_text("utf-8"))
    sparse = summary["fields"][-1]
    assert summary["covered_by_all"] == pytest.approx(sparse["covered"], abs=0.01)
    for field, sd in zip(summary["fields"], (0.01, 0.1, 0.001), strict=True):
        # Of several hundred points: within a few percent of the noise that was put in.
        assert field["where all measure"]["rms_px"] == pytest.approx(sd, rel=0.15)


def test_the_page_is_whole_and_loads_nothing(command: tuple[Path, str, int]) -> None:
    text = (command[0] / "out" / "report.html").read_text("utf-8")
    page = Page(text)
    assert page.open == []
    assert max(page.ids.values()) == 1
    assert all(source.startswith("data:") for source in page.sources)
    outside = [link for link in page.links if not link.startswith("#")]
    assert all(link.startswith("https://doi.org/") for link in outside)
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)
    for name in ("ranking", "histogram", "distribution", "regions", "spectrum", "maps", "findings"):
        assert page.ids[name] == 1
    for n in range(3):
        assert all(page.ids[f"{kind}-{n}"] == 1 for kind in ("length", "x", "y"))


def test_errors_can_be_explored(command: tuple[Path, str, int], truth: BenchmarkTruth) -> None:
    content = content_of((command[0] / "out" / "report.html").read_text("utf-8"))
    assert [s["label"] for s in content["states"]] == ["good", "fair", "sparse"]
    for k, sd in enumerate((0.01, 0.1, 0.001)):
        error = quantity(content, k, "x") / PIXEL
        assert np.nanstd(error) == pytest.approx(sd, rel=0.15)
        both = quantity(content, k, "ux") - quantity(content, k, "ux", "truth")
        assert np.nanmax(np.abs(both - PIXEL * error)) < 1e-9
    # Where every pixel is next to a measured one, the truth is that of its neighbourhood.
    row, col = np.mgrid[: content["rows"], : content["cols"]]
    spacing = PIXEL * content["factor"]
    x, y = content["x0"] + spacing * col, content["y0"] - spacing * row
    true = truth.displacement(STRAIN, x.ravel(), y.ravel())[:, 0].reshape(x.shape)
    assert np.nanmax(np.abs(quantity(content, 0, "ux", "truth") - true)) < 0.3 * PIXEL


@pytest.mark.usefixtures("unrendered_pictures")
def test_a_perfect_field_alone_gets_its_page(
    truth: BenchmarkTruth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing to compare with, and no logarithm of its errors."""
    x, y, u = made.points(truth)
    np.savez(tmp_path / "exact.npz", **{"x [mm]": x, "y up [mm]": y, "u [mm]": u[:, 0],
                                        "v up [mm]": u[:, 1]})  # fmt: skip
    message, code = run(monkeypatch, tmp_path, truth, [tmp_path / "exact.npz"])
    assert code == 0
    assert "that all cover" not in message
    text = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert Page(text).open == []
    assert "where all measure" not in text


@pytest.mark.usefixtures("unrendered_pictures")
def test_a_field_that_lost_all_of_the_material_gets_its_page(
    truth: BenchmarkTruth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, y, u = made.points(truth)
    hole = LocalField(np.append(x, 0.95), np.append(y, 0.0), np.vstack([u * np.nan, [0.0, 0.0]]))
    write_field(tmp_path / "lost.csv", hole)
    write_field(tmp_path / "good.csv", noisy(truth, 0.01, "good"))
    fields = [tmp_path / "lost.csv", tmp_path / "good.csv"]
    _, code = run(monkeypatch, tmp_path, truth, fields)
    assert code == 0
    summary = json.loads((tmp_path / "out" / "scores.json").read_text("utf-8"))
    good, lost = summary["fields"]
    assert (good["name"], lost["name"]) == ("good", "lost")
    assert (lost["everywhere"]["returned"], lost["covered"]) == (0.0, 0.0)
    assert lost["points_off_material"] == 1
    assert lost["everywhere"]["rms_px"] is None
    assert Page((tmp_path / "out" / "report.html").read_text("utf-8")).open == []


def test_bad_input_is_one_line(
    truth: BenchmarkTruth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    message, code = run(monkeypatch, tmp_path, truth, [tmp_path / "none.csv"])
    assert code == 2
    assert re.search(r"error:.*none\.csv", message)
    assert not (tmp_path / "out" / "report.html").exists()


@pytest.mark.usefixtures("unrendered_pictures")
def test_fields_that_cannot_be_graded_do_not_stop_the_others(
    truth: BenchmarkTruth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_field(tmp_path / "good.csv", noisy(truth, 0.01, "good"))
    (tmp_path / "bad.csv").write_text("nothing", "utf-8")
    fields = [tmp_path / "bad.csv", tmp_path / "good.csv", tmp_path / "none.csv"]
    message, code = run(monkeypatch, tmp_path, truth, fields)
    assert code == 2
    for name in ("bad", "none"):
        assert re.search(rf"error:.*{name}\.csv", message)
    summary = json.loads((tmp_path / "out" / "scores.json").read_text("utf-8"))
    assert [field["name"] for field in summary["fields"]] == ["good"]
    assert list(summary["refused"]) == [str(fields[0]), str(fields[2])]
    assert "bad.csv" in (tmp_path / "out" / "report.html").read_text("utf-8")


def test_displacements_in_another_unit_are_refused(
    truth: BenchmarkTruth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    field = noisy(truth, 0.05, "it")
    for factor, words in ((1 / PIXEL, "pixels had been declared as mm"),
                          (PIXEL, "mm had been declared as pixels")):  # fmt: skip
        write_field(tmp_path / "it.csv", replace(field, u=factor * field.u))
        message, code = run(monkeypatch, tmp_path, truth, [tmp_path / "it.csv"])
        assert code == 2
        assert words in message


@pytest.mark.parametrize("length_px", [12.0, 30.0])
def test_a_wave_of_error_is_found_at_its_wavelength(length_px: float) -> None:
    """On a full grid: nothing leaks but by the box's edges."""
    grid = PixelGrid.centred(240, 360, PIXEL)
    row, col = np.mgrid[0 : grid.rows : 2, 0 : grid.cols : 2]
    x, y = grid.to_mm(row.ravel(), col.ravel())
    wave = 0.2 * np.cos(2 * np.pi * col.ravel() / length_px)
    error = np.column_stack([wave, np.zeros_like(wave)])
    plain = LocalField(x, y, PIXEL * error, source="wave")
    graded = score(plain, np.zeros((x.size, 2)), np.zeros(grid.shape, dtype=np.int8), grid)
    spectrum = error_spectrum(graded, grid)
    assert spectrum is not None
    top = int(np.argmax(spectrum.rms_px))
    # The middle of its third of an octave is at most a sixth of one away.
    assert abs(np.log2(spectrum.wavelength_px[top] / length_px)) < 1 / 6 + 1e-9
    rms = 0.2 / 2  # of a cosine, over two components
    assert spectrum.rms_px[top] == pytest.approx(rms, rel=0.02)
    everything = np.sqrt((spectrum.rms_px**2).sum() + spectrum.affine_px**2)
    assert everything == pytest.approx(graded.everywhere.rms_px, rel=1e-9)
    moved = replace(graded, error_px=graded.error_px + np.array([0.3, 0.0]))
    shifted = error_spectrum(moved, grid)
    assert shifted is not None
    assert shifted.affine_px == pytest.approx(0.3 / np.sqrt(2), rel=1e-2)


def test_a_field_of_too_many_points_is_averaged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of waves long against the squares, averaging over 2 x 2 points leaves sinc of their width."""
    grid = PixelGrid(96, 96, PIXEL, 0.0, 95 * PIXEL)
    col, row = (i.ravel() for i in np.meshgrid(np.arange(96.0), np.arange(96.0)))
    x, y = grid.to_mm(row, col)
    wave = 0.2 * np.cos(2 * np.pi * col / 32)
    field = LocalField(x, y, PIXEL * np.column_stack([wave, 0 * wave]), source="wave")
    graded = score(field, np.zeros((x.size, 2)), np.zeros(grid.shape, dtype=np.int8), grid)
    monkeypatch.setattr(spectra, "_MOST", 48)
    spectrum = error_spectrum(graded, grid)
    assert spectrum is not None
    everything = np.sqrt((spectrum.rms_px**2).sum() + spectrum.affine_px**2)
    left = np.cos(np.pi / 32)  # 0.5 % less, of two points 1 px apart
    # The affine part, a thousandth of all, is that of the points and not of their averages.
    assert everything == pytest.approx(left * graded.everywhere.rms_px, rel=5e-4)


def test_a_part_of_the_points_tells_their_spacing(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = PixelGrid(60, 60, PIXEL, 0.0, 59 * PIXEL)
    col, row = (i.ravel() for i in np.meshgrid(np.arange(0.0, 60, 3), np.arange(0.0, 60, 3)))
    x, y = grid.to_mm(row, col)
    field = LocalField(x, y, np.zeros((x.size, 2)), source="still")
    monkeypatch.setattr(grades, "_ENOUGH_POINTS", 7)
    graded = score(field, np.zeros((x.size, 2)), np.zeros(grid.shape, dtype=np.int8), grid)
    assert graded.spacing_px == pytest.approx(3.0, rel=1e-12)


def test_points_in_a_line_have_no_spectrum(truth: BenchmarkTruth) -> None:
    field = noisy(truth, 0.1, "line")
    (x,) = {field.x[0]}
    line = field.selected(field.x == x)
    assert error_spectrum(score_of(truth, line), truth.grid) is None
