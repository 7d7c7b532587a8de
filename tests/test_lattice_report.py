"""The page of a lattice: whole, self-contained, and there for runs of any completeness.

Guards: nothing is loaded from elsewhere; links and ids fit together; what a run doesn't have is
left out; what was not found, or is no equilibrium, is said.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import synthetic_lattice as made_up
from html_page import Page
from summary_schemas import faults

from modeharvest.report.lattice import (
    lattice_report,
    notes,
    proof,
    study_text,
    wave_name,
    waves_text,
)
from modeharvest.report.model.output import write_page
from modeharvest.runs.lattice.results import CriticalPoint, LatticeRun, PeriodicField, summary_of

pytestmark = pytest.mark.usefixtures("coarse_pictures")

SECTIONS = ("critical", "dispersion", "modes", "branches", "family", "study")


def page(run: LatticeRun, folder: Path) -> str:
    write_page(lattice_report(summary_of(run, run.patterns), run), folder / "report.html")
    return (folder / "report.html").read_text("utf-8")


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    return page(made_up.run(), tmp_path_factory.mktemp("report"))


def test_the_summary_is_as_its_schema_says() -> None:
    run = made_up.run()
    summary = summary_of(run, run.patterns)
    assert faults(summary, "modes") == []


def test_a_degenerate_set_that_the_mesh_splits_is_warned_of() -> None:
    run = made_up.run()
    summary = summary_of(run, run.patterns)
    summary["critical"] |= {"waves": [[1.0, 0.0], [0.0, 1.0]], "splitting": 1e-7}
    assert not any("splits" in warning for warning in lattice_report(summary).warnings)
    summary["critical"] |= {"splitting": 0.0032, "splitting_bound": 0.07}
    (found,) = [warning for warning in lattice_report(summary).warnings if "splits" in warning]
    assert "0.32" in found
    assert "7" in found
    assert "mesh one sector" in found


def test_nothing_is_loaded_from_elsewhere(text: str) -> None:
    seen = Page(text)
    assert seen.open == []
    assert all(source.startswith("data:") for source in seen.sources)
    outside = {link for link in seen.links if not link.startswith("#")} - {"modes.h5"}
    assert all(link.startswith("https://doi.org/") for link in outside)
    assert not {"script", "link", "iframe", "object"} & set(seen.tags)
    assert not re.search(r"@import|url\((?!#)", text)


def test_ids_are_unique_and_links_lead_somewhere(text: str) -> None:
    seen = Page(text)
    assert [name for name, count in seen.ids.items() if count > 1] == []
    assert {link[1:] for link in seen.links if link.startswith("#")} <= set(seen.ids)
    assert set(re.findall(r"url\(#([^)]+)\)", text)) <= set(seen.ids)


def test_everything_of_a_full_run_is_there(text: str) -> None:
    ids = Page(text).ids
    pictures = ("hero", "reference", "deformed-1", "Sxx-1", "Syy-1", "deformed-2", "zone-1",
                "mode-1", "mode-2", "energies", "amplitudes", "differences", "strains", "overlaps",
                "captured", "overlay-1")  # fmt: skip
    assert all(ids[name] == 1 for name in (*SECTIONS, *pictures))
    assert "Made up &lt;for tests&gt;" in text
    assert "<for tests>" not in text
    assert "soft &lt;stuff&gt;" in text
    assert "A note &lt;of the caller&gt;." in text


def test_the_paper_s_family_is_recognised_and_its_waves_are_written(text: str) -> None:
    # The made-up pattern is Eq. (6) itself: two waves along the diagonals, seven parameters.
    assert "This is Eq. (6) of the paper (square, origin at a hole): seven parameters" in text


def test_what_a_run_does_not_have_is_left_out(tmp_path: Path) -> None:
    bare = made_up.run(critical=None, dispersion=None, modes=None, branches=(), patterns=(),
                       study=None, exports={}, notes=())  # fmt: skip
    seen = Page(page(bare, tmp_path))
    assert not set(SECTIONS) & set(seen.ids)
    assert {"hero", "reference", "notes", "again"} <= set(seen.ids)
    assert {link[1:] for link in seen.links if link.startswith("#")} <= set(seen.ids)


def test_a_lattice_that_stays_stable_is_an_outcome(tmp_path: Path) -> None:
    point = CriticalPoint("uniaxial", 0.28, False, "stable up to e = 0.28", value=0.3)
    run = made_up.run(critical=point, modes=None, branches=(), patterns=())
    text = page(run, tmp_path)
    assert "stable so far" in text
    assert "stable up to 28\N{NO-BREAK SPACE}%" in text
    assert "critical wave</dt>" not in text
    assert "lowest filling · λ/k² is 0.3 MPa, above zero" in text
    assert "no critical point was found up to 28\N{NO-BREAK SPACE}%" in text


def critical(point: CriticalPoint) -> dict[str, Any]:
    """As it is in ``summary.json``."""
    summary: dict[str, Any] = summary_of(made_up.run(critical=point), ())
    return summary


def test_long_waves_are_named_by_their_direction() -> None:
    point = CriticalPoint("uniaxial", 0.21, True, "critical", value=0.0, angle=math.pi / 4)
    summary = critical(point)
    assert waves_text(summary["critical"]) == "long waves along 45°"
    assert "acoustic tensor" in proof(summary["critical"])
    assert any("loss of ellipticity" in note for note in notes(summary))


def test_waves_that_come_earlier_are_not_kept_quiet() -> None:
    point = CriticalPoint("uniaxial", 0.1, True, "critical", (made_up.M,), (0,), (1,))
    text = proof(critical(point)["critical"])
    assert text.endswith("no other wave that was examined is unstable before")
    point = replace(point, earlier=((1.0, 2.0), (1.5, 2.0)))
    text = proof(critical(point)["critical"])
    assert text.endswith("but 2 other waves are unstable before")


def test_a_branch_that_could_not_be_followed_has_its_row(tmp_path: Path) -> None:
    run = made_up.run(patterns=())
    lost = replace(run.branches[0], states=(), outcome="not followed: no equilibrium")
    text = page(replace(run, branches=(lost,)), tmp_path)
    assert "not followed: no equilibrium" in text
    assert "energies" not in Page(text).ids


def test_a_mode_is_no_equilibrium_and_a_small_pattern_is_magnified(tmp_path: Path) -> None:
    run = made_up.run(branches=())
    assert run.modes is not None
    shape = PeriodicField.of_mode(run.modes, 0, {})
    mode = shape.scaled(0.16 * run.pitch).analysed(run.pitch)
    assert mode.stable is None
    small = replace(mode, displacement=0.1 * mode.displacement, stable=True)
    text = page(replace(run, patterns=(mode, small)), tmp_path)
    assert "a mode, no equilibrium; largest displacement 0.16\u00a0l" in text
    # drawn with 0.12 l instead of 0.016 l
    assert "stable; fluctuation × 7.5" in text


def test_progress_is_reported_up_to_the_end(tmp_path: Path) -> None:
    reported: list[float] = []
    run = made_up.run(study=None)
    report = lattice_report(summary_of(run, run.patterns), run)
    write_page(report, tmp_path / "r.html", lambda done, total, what: reported.append(done / total))
    assert reported == sorted(reported)
    assert reported[-1] == 1.0


@pytest.mark.parametrize(
    ("wave", "written"),
    [
        ((0.0, math.pi), "(0, π)"),
        ((4 * math.pi / 3, 2 * math.pi / 3), "(4π/3, 2π/3)"),
        ((-math.pi / 2, -math.pi), "(−π/2, −π)"),
        ((1.234, -0.5), "(1.234, −0.5)"),
    ],
)
def test_waves_are_written_in_units_of_pi(wave: tuple[float, float], written: str) -> None:
    assert wave_name(wave) == written


def test_a_study_says_where_the_pattern_stops_coming_first() -> None:
    message = " ".join(study_text(made_up.study()))
    assert "from d/l = 0.69 on; at 0.67 it is long waves" in message
    assert "between 0.930 (d/l = 0.3" in message
    every = replace(made_up.study(), ratios=(made_up.row(0.7), made_up.row(0.9)), limits=())
    assert "first for every d/l examined, from 0.7 to 0.9" in " ".join(study_text(every))
