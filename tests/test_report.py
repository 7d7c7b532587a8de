"""The page: whole, self-contained, and there for runs of every kind.

Guards: nothing is loaded from elsewhere; every panel is there for every snapshot; links and ids
fit together; a run without buckling, without a path or without a mode still gets its report;
what was missed is said.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import synthetic_report as made_up
from html_page import Page

from modeharvest.idic.ansatz import Ansatz
from modeharvest.report.experiment import (
    ExperimentData,
    SnapshotState,
    experiment_figures,
    experiment_report,
    notes,
    snapshot_panels,
)
from modeharvest.report.figures import fits
from modeharvest.report.model.content import Card, KeyNumber, Report, ReportTable, Section
from modeharvest.report.model.output import draw_figures, print_report, write_page
from modeharvest.report.model.text import Measured, fixed, indexed, number, text_of, typeset


def report(data: ExperimentData, folder: Path, summary: dict[str, Any]) -> str:
    path = folder / "report.html"
    write_page(experiment_report(summary, data), path)
    return path.read_text("utf-8")


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    data = made_up.data()
    return report(data, tmp_path_factory.mktemp("report"), made_up.summary(data))


def test_nothing_is_loaded_from_elsewhere(text: str) -> None:
    page = Page(text)
    assert page.open == []
    assert page.sources
    assert all(source.startswith("data:") for source in page.sources)
    outside = {link for link in page.links if not link.startswith("#")}
    assert all(link.startswith("https://doi.org/") for link in outside)
    assert not {"link", "iframe", "object"} & set(page.tags)
    assert not re.search(r"@import|url\((?!#)|<script[^>]*\bsrc|\bfetch\(|XMLHttpRequest", text)
    assert "default-src 'none'" in text  # so the browser loads nothing, whatever a script asks


def without_mesh(modes: int) -> list[fits.Panel[SnapshotState]]:
    """The panels of a run that does not measure the whole displacement."""
    return [panel for panel in snapshot_panels(modes) if panel.section != "whole"]


def test_texts_write_numbers_for_a_reader() -> None:
    row = {"nominal_strain": 0.128, "branch_N": 1.23456e-5, "unstable_N": 1.53}
    words = text_of("experiment-energy", **row)
    assert words.startswith("At 12.8\u00a0% the buckled state stores an energy per thickness of ")
    assert " of 1.2 · 10⁻⁵ N·mm/mm, " in words
    assert words.endswith(" 1.530 N·mm/mm.")
    key = KeyNumber.of("cutoff", last={"cutoff_px": 12.3456})
    assert (key.name, key.value, key.unit) == ("cut-off wavelength", "12.3", "px")


@pytest.mark.parametrize(
    ("plain", "printed"),
    [
        ("v1 phi1 is -0.36 px rms", "v₁ φ₁ is −0.36\u00a0px rms"),
        ("≤ 1e-10, [-1, 2], below v0.", "≤ 10⁻¹⁰, [−1, 2], below v₀."),
        ("--pixel-size 0.1, frame-2.tif, v1.tif, v0_degree, 2024-11-05", None),
        ("4.5e-05 of 0.16 l", "4.5\u00a0·\u00a010⁻⁵ of 0.16\u00a0l"),
    ],
)
def test_text_is_typeset(plain: str, printed: str | None) -> None:
    assert typeset(plain) == (printed or plain)


def test_every_panel_is_there_for_every_snapshot(text: str) -> None:
    ids = Page(text).ids
    for strain in ("0500", "1000"):
        assert all(ids[f"{panel.key}-{strain}"] == 1 for panel in without_mesh(1))
        assert ids[f"convergence-{strain}"] == 1
    for name in (
        "hero",
        "keys",
        "findings",
        "expected",
        "load",
        "eigenvalues",
        "numbers",
        "mode",
        "notes",
    ):
        assert ids[name] == 1
    assert "Before buckling · 5 %" in text
    assert "After buckling · 10 %" in text


def test_ids_are_unique_and_links_lead_somewhere(text: str) -> None:
    page = Page(text)
    assert [name for name, count in page.ids.items() if count > 1] == []
    inner = {link[1:] for link in page.links if link.startswith("#")}
    assert inner <= set(page.ids)
    assert set(re.findall(r"url\(#([^)]+)\)", text)) <= set(page.ids)


def test_the_page_is_small_enough_to_send(text: str) -> None:
    assert len(text.encode()) < 8e6


def test_words_are_escaped(text: str) -> None:
    assert "Made up &lt;for tests&gt;" in text
    assert "<for tests>" not in text


def test_what_was_missed_is_reported(text: str) -> None:
    assert text.count("✗ missed") == 1
    assert text.count("✓ met") == 1
    missed = "Missed 1 of 2 expected values: best fit: expected at most 1, obtained 1.5 px."
    assert missed in text.replace("\N{NO-BREAK SPACE}", " ")


@pytest.mark.usefixtures("unrendered_pictures")
def test_one_snapshot_before_buckling_is_enough(tmp_path: Path) -> None:
    data = made_up.data((0.05,))
    text = report(data, tmp_path, made_up.summary(data))
    ids = Page(text).ids
    assert all(f"{panel.key}-0500" in ids for panel in without_mesh(1))
    assert "After buckling" not in text


@pytest.mark.usefixtures("unrendered_pictures")
def test_a_solution_from_elsewhere_has_no_path(tmp_path: Path) -> None:
    data = made_up.data((0.05,))
    data = replace(data, solution=made_up.solution((0.05,), {"source": "mesh.vtu"}))
    summary = made_up.summary(data, critical=None) | {"factorisations": None, "expected": []}
    text = report(data, tmp_path, summary)
    page = Page(text)
    assert "load" not in page.ids
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)
    assert "Deformed · 5 %" in text
    assert "none found" in text


@pytest.mark.usefixtures("unrendered_pictures")
def test_a_specimen_that_stays_stable_has_no_critical_point(tmp_path: Path) -> None:
    data = made_up.data((0.05,))
    info = {"critical": None, "path": {"primary": made_up.PATH["primary"]}}
    data = replace(data, solution=made_up.solution((0.05,), info))
    text = report(data, tmp_path, made_up.summary(data, critical=None))
    assert "No bifurcation on the path" in text
    assert "load" in Page(text).ids


@pytest.mark.usefixtures("unrendered_pictures")
def test_a_correlation_without_a_mode_has_no_panels_of_it(tmp_path: Path) -> None:
    plain = Ansatz(made_up.DOMAIN, (), v0_degree=3)
    data = made_up.data((0.05,), plain)
    ids = Page(report(data, tmp_path, made_up.summary(data))).ids
    without = {panel.key for panel in without_mesh(0)}
    for panel in without_mesh(1):
        assert (f"{panel.key}-0500" in ids) is (panel.key in without)
    assert "mode" not in ids


@pytest.mark.usefixtures("unrendered_pictures")
def test_progress_is_reported_up_to_the_end() -> None:
    reported: list[float] = []
    figures = experiment_figures(made_up.data((0.05,)))
    draw_figures(figures, lambda done, total, what: reported.append(done / total))
    assert reported == sorted(reported)
    assert reported[-1] == 1.0


def test_what_is_drawn_before_the_numbers_is_what_the_page_shows(tmp_path: Path) -> None:
    data = made_up.data()
    made = experiment_report(made_up.summary(data), data)
    first = experiment_figures(data)
    assert sorted(f.name for f in first) == sorted(f.name for f in made.figures)
    pictures = {figure.name: f"<svg>{figure.name}</svg>" for figure in first}
    write_page(made, tmp_path / "r.html", pictures=pictures)
    page = (tmp_path / "r.html").read_text("utf-8")
    assert all(picture in page for picture in pictures.values())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"negative_pivots": 2}, "the state is unstable (2 negative pivots)"),
        ({"outcome": "stagnated", "outcome_why": "No step."}, "ended as “stagnated”: No step."),
        ({"undetermined": ["phi1.a1"]}, "the images do not determine phi1.a1"),
        ({"pattern_inner_px": 0.2}, "no pattern is observable"),
    ],
)
def test_a_snapshot_to_be_wary_of_is_named(change: dict[str, Any], message: str) -> None:
    data = made_up.data((0.1,))
    summary = made_up.summary(data)
    summary["snapshots"][0] |= {"pattern_inner_px": 3.0}
    assert not any(message in note for note in notes(summary))
    summary["snapshots"][0] |= change
    assert any(note.startswith("At 10 %") and message in note for note in notes(summary))


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (None, "–"), (float("nan"), "–"), (float("inf"), "∞"), (0, "0"), (-1.0, "−1"),
        (1971562, "1\u202f971\u202f562"), (0.256, "0.256"), (-9.62694, "−9.627"),
        (1.1368e-12, "1.1 · 10⁻¹²"), ("converged", "converged"), (True, "True"),
        ("-1.20e-05", "−1.20\u00a0·\u00a010⁻⁵"), ("-1_a", "-1_a"),
    ],
)  # fmt: skip
def test_numbers_are_written_for_readers(value: object, written: str) -> None:
    assert number(value) == written


def test_columns_of_signed_numbers_are_numeric() -> None:
    rows = [["a", "+0.3", "–", "x1"], ["b", "-0.25", "−4", "1"]]
    assert ReportTable("", ["", "", "", ""], rows).numeric == [False, True, True, False]
    assert indexed("a7 of φ1") == "a₇ of φ₁"
    assert indexed("largest |v2|") == "largest |v₂|"


def test_numbers_are_rounded_to_the_digits_asked_for() -> None:
    assert number(1234.5, 2) == "1\u202f200"
    assert number(0.012345, 2) == "0.012"


def test_errors_are_written_behind_their_value() -> None:
    value = Measured(-0.5, (2e-4, None, float("inf"), 1e-9))
    assert str(value) == "−0.50000 ± 0.00020 ± – ± ∞ < 0.00001"
    assert str(Measured(1.0, (0.25,), 2)) == "1.00 ± 0.25"


def test_the_terminal_shows_what_the_page_does(capsys: pytest.CaptureFixture[str]) -> None:
    data = made_up.data()
    summary = made_up.summary(data) | {"warnings": ["Beware [of this]."]}
    print_report(experiment_report(summary), Path("out"))
    text = capsys.readouterr().out
    assert "Made up <for tests>" in text
    assert "Critical strain 6.0000 %" in text
    assert "model error" in text
    assert "Beware [of this]." in text
    assert text.rstrip().endswith("out/report.html")


def test_the_table_on_the_terminal_fits_80_columns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    print_report(experiment_report(made_up.summary(made_up.data())), Path("out"))
    lines = capsys.readouterr().out.splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith("───")) + 1
    rows = lines[first : lines.index("", first)]
    assert all(len(row) <= 80 and row[0] != " " for row in rows)  # a wrapped row begins blank
    assert any(row.startswith("measurement error, rms [px] ") for row in rows)
    assert 3 <= len(rows) <= 10


@pytest.mark.parametrize("images", [7, 20])
def test_no_word_of_a_wide_table_is_cut(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, images: int
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    heads = ["image", *(f"quantity_{k:02} [px]" for k in range(9))]
    rows = [[f"frame_{n:04}", *(float(10 * n + k) for k in range(9))] for n in range(images)]
    cards = Card.tabular(ReportTable("Images", heads, rows, on_terminal=True))
    print_report(Report("kind", "title", sections=[Section("s", "S", cards)]), Path("out"))
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert text.count("Images") == 1
    words = text.split()
    for name, *values in rows:
        assert name in words
        assert all(number(value) in words for value in values)


def test_fixed_numbers_have_no_minus_before_zero() -> None:
    assert fixed(-1e-9) == "0.00000"
    assert fixed(-0.5) == "−0.50000"
