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
from modeharvest.report import experiment as words
from modeharvest.report.experiment import draw, write_experiment_report
from modeharvest.report.figures.experiment import PANELS, ExperimentReportData
from modeharvest.report.model import fixed, short


def report(atlas: ExperimentReportData, folder: Path, summary: dict[str, Any]) -> str:
    path = folder / "report.html"
    write_experiment_report(path, made_up.case(), draw(atlas), summary)
    return path.read_text("utf-8")


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    atlas = made_up.atlas()
    return report(atlas, tmp_path_factory.mktemp("report"), made_up.summary(atlas))


def test_nothing_is_loaded_from_elsewhere(text: str) -> None:
    page = Page(text)
    assert page.open == []
    assert page.sources
    assert all(source.startswith("data:") for source in page.sources)
    outside = {link for link in page.links if not link.startswith("#")}
    assert all(link.startswith("https://doi.org/") for link in outside)
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert not re.search(r"@import|url\((?!#)", text)


def test_every_panel_is_there_for_every_snapshot(text: str) -> None:
    ids = Page(text).ids
    for strain in ("0500", "1000"):
        assert all(ids[f"{panel.key}-{strain}"] == 1 for panel in PANELS)
        assert ids[f"convergence-{strain}"] == 1
    for name in ("hero", "keys", "expected", "load", "eigenvalues", "numbers", "mode", "notes"):
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


def test_what_was_missed_is_said(text: str) -> None:
    assert text.count("✗ missed") == 1
    assert text.count("✓ met") == 1
    assert "Missed 1 of 2 expected values: best fit: expected at most 1, obtained 1.5 px." in text


def test_one_snapshot_before_buckling_is_enough(tmp_path: Path) -> None:
    atlas = made_up.atlas((0.05,))
    text = report(atlas, tmp_path, made_up.summary(atlas))
    ids = Page(text).ids
    assert all(f"{panel.key}-0500" in ids for panel in PANELS)
    assert "After buckling" not in text


def test_a_solution_from_elsewhere_has_no_path(tmp_path: Path) -> None:
    atlas = made_up.atlas((0.05,))
    atlas = replace(atlas, solution=made_up.solution((0.05,), {"source": "mesh.vtu"}))
    summary = made_up.summary(atlas, critical=None) | {"factorisations": None, "expected": []}
    text = report(atlas, tmp_path, summary)
    page = Page(text)
    assert "load" not in page.ids
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)
    assert "Deformed · 5 %" in text
    assert "none found" in text


def test_a_specimen_that_stays_stable_has_no_critical_point(tmp_path: Path) -> None:
    atlas = made_up.atlas((0.05,))
    info = {"critical": None, "path": {"primary": made_up.PATH["primary"]}}
    atlas = replace(atlas, solution=made_up.solution((0.05,), info))
    text = report(atlas, tmp_path, made_up.summary(atlas, critical=None))
    assert "No critical point was found" in text
    assert "load" in Page(text).ids


def test_a_correlation_without_a_mode_has_no_panels_of_it(tmp_path: Path) -> None:
    plain = Ansatz(made_up.DOMAIN, (), v0_degree=3)
    atlas = made_up.atlas((0.05,), plain)
    ids = Page(report(atlas, tmp_path, made_up.summary(atlas))).ids
    for panel in PANELS:
        assert (f"{panel.key}-0500" in ids) is not panel.needs_mode
    assert "mode" not in ids


def test_progress_is_told_up_to_the_end() -> None:
    told: list[float] = []
    draw(made_up.atlas((0.05,)), lambda done, total, what: told.append(done / total))
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_the_truth_is_waited_for_last() -> None:
    class NotYet(list[Any]):
        def __getitem__(self, k: Any) -> Any:
            raise TimeoutError

        def __iter__(self) -> Any:
            raise TimeoutError

    drawn: list[float] = []
    atlas = replace(made_up.atlas((0.05,)), comparisons=NotYet([0]), spectra=NotYet([0]))
    with pytest.raises(TimeoutError):
        draw(atlas, lambda done, total, what: drawn.append(done))
    assert drawn[-1] == sum(not panel.needs_truth for panel in PANELS) == 7


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"negative_pivots": 2}, "the state is unstable (2 negative pivots)"),
        ({"outcome": "stagnated", "outcome_why": "No step."}, "ended as “stagnated”: No step."),
        ({"undetermined": ["phi1.a1"]}, "the images say nothing about phi1.a1"),
        ({"pattern_inner_px": 0.2}, "there is no pattern to be observed"),
    ],
)
def test_a_snapshot_to_be_wary_of_is_named(change: dict[str, Any], said: str) -> None:
    atlas = made_up.atlas((0.1,))
    summary = made_up.summary(atlas)
    summary["snapshots"][0] |= {"pattern_inner_px": 3.0}
    assert not any(said in note for note in words.notes(summary))
    summary["snapshots"][0] |= change
    assert any(note.startswith("At 10 %") and said in note for note in words.notes(summary))


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (None, "–"), (float("nan"), "–"), (float("inf"), "∞"), (0, "0"), (-1.0, "−1"),
        (1971562, "1\u202f971\u202f562"), (0.256, "0.256"), (-9.62694, "−9.627"),
        (1.1368e-12, "1.1 · 10⁻¹²"), ("converged", "converged"), (True, "True"),
    ],
)  # fmt: skip
def test_numbers_are_written_for_readers(value: object, written: str) -> None:
    assert short(value) == written


def test_fixed_numbers_have_no_minus_before_zero() -> None:
    assert fixed(-1e-9) == "0.00000"
    assert fixed(-0.5) == "−0.50000"
