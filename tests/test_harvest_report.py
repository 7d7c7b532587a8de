"""The report of a harvest: whole, self-contained, right in its numbers, for every kind of test.

Guards: nothing is loaded from elsewhere; every panel is there for every photograph; links and ids
fit together; what is not known is left out and not made up; the boundary follows the mask; numbers
in the summary are those of the measurement they stand for.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path as File
from typing import Any

import numpy as np
import pytest
import synthetic_harvest as made_up
from explored import content_of, quantity, samples
from html_page import Page
from matplotlib.path import Path
from summary_schemas import faults

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.modes import FourierMode, Taper, free_family
from modeharvest.idic.uncertainty.covariance import field_errors
from modeharvest.idic.uncertainty.identifiability import identifiability
from modeharvest.imaging.distortion.lens import PolynomialDistortion, apart_without_affine
from modeharvest.report.figures.boundaries import mask_boundary
from modeharvest.report.figures.photographs import (
    MOST_SHOWN,
    PhotographState,
    photograph_states,
    shown_frames,
)
from modeharvest.report.model.output import write_page
from modeharvest.report.photographs import (
    key_numbers,
    mode_cards,
    notes,
    number_cards,
    photograph_labels,
    photograph_panels,
    photographs_report,
)
from modeharvest.runs.photographs.prepare import Optics
from modeharvest.runs.photographs.results import Harvest, harvest_summary

pytestmark = pytest.mark.usefixtures("coarse_pictures")


@pytest.fixture(scope="module")
def harvest() -> Harvest:
    return made_up.harvest()


@pytest.fixture(scope="module")
def summary(harvest: Harvest) -> dict[str, Any]:
    return harvest_summary(harvest)


@pytest.fixture(scope="module")
def text(harvest: Harvest, tmp_path_factory: pytest.TempPathFactory) -> str:
    return report(harvest, tmp_path_factory.mktemp("report"))


def report(harvest: Harvest, folder: File) -> str:
    path = folder / "report.html"
    write_page(photographs_report(harvest_summary(harvest), harvest), path)
    return path.read_text("utf-8")


def states(harvest: Harvest) -> list[PhotographState]:
    return photograph_states(harvest, {frame.name: frame.name for frame in harvest.frames})


def bare(harvest: Harvest) -> Harvest:
    """One photograph of which only the correlation is known."""
    frame = replace(harvest.frames[1], mask=None, by_model_error=None, spectrum=None, pattern=None,
                    w=None, start_text=())  # fmt: skip
    return replace(harvest, geometry=replace(harvest.geometry, lattice=None), frames=(frame,),
                   skipped=(), timeline=(), buckling=None, optics=Optics(), full_scale=None,
                   text=(), truth=None, versions={})  # fmt: skip


def test_the_summary_is_as_its_schema_says(summary: dict[str, Any]) -> None:
    assert faults(summary, "harvest") == []


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
    assert len(text.encode()) < 8e6


def test_its_fields_can_be_explored(text: str, harvest: Harvest) -> None:
    content = content_of(text)
    keys = {q["key"] for q in content["quantities"]}
    assert {"ux", "uy", "v0x", "v1", "fluc1x", "residual"} <= keys
    assert [s["name"] for s in content["states"]] == [s.name for s in states(harvest)]
    for k, state in enumerate(states(harvest)):
        u = samples(content, np.where(harvest.mask, state.result.displacement()[..., 0], np.nan))
        found = quantity(content, k, "ux")
        assert np.array_equal(np.isnan(found), np.isnan(u))
        assert (
            np.nanmax(np.abs(found - u)) <= np.nanmax(np.abs(u)) / 30_000 + 1e-3 * content["pixel"]
        )


def test_every_panel_is_there_for_every_photograph(harvest: Harvest, text: str) -> None:
    ids = Page(text).ids
    every = photograph_panels(states(harvest))
    assert {"image", "Sxx", "v0y", "v1", "phi1", "fluc1x", "residual", "w", "v0-noise",
            "fluc1-model", "loss"} <= {panel.key for panel in every}  # fmt: skip
    for panel in every:
        assert all(ids[f"{panel.key}-{k}"] == 1 for k in (1, 2))
    for name in ("hero", "keys", "reference", "distortion", "distortion-sd", "distortion-error",
                 "degrees", "skipped", "obtained", "timeline-pattern", "timeline-waves", "frames",
                 "mode", "waves", "notes"):  # fmt: skip
        assert ids[name] == 1, name
    assert "Before buckling · 4\N{NO-BREAK SPACE}%" in text
    assert "After buckling · 7\N{NO-BREAK SPACE}%" in text


def test_ids_are_unique_and_links_lead_somewhere(text: str) -> None:
    page = Page(text)
    assert [name for name, count in page.ids.items() if count > 1] == []
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)
    assert set(re.findall(r"url\(#([^)]+)\)", text)) <= set(page.ids)


def test_words_of_users_are_escaped_and_reported(text: str) -> None:
    assert "Made up &lt;for tests&gt;" in text
    assert "expected an image &lt;of 290 x 250 px&gt;, got a damaged file" in text
    assert "<for tests>" not in text
    for message in ("The material was found by its speckle.", "v₀ starts from the local DIC.",
                 "S is a polynomial of degree 3", "measured from 3 exposures",
                 "modeharvest harvest EXPERIMENT.toml"):  # fmt: skip
        assert message in text
    assert text.count("✗ missed") == text.count("✓ met") == 1


def test_what_is_not_known_is_left_out(harvest: Harvest, tmp_path: File) -> None:
    reported: list[float] = []
    unknown = bare(harvest)
    write_page(photographs_report(harvest_summary(unknown), unknown), tmp_path / "report.html",
               lambda done, total, what: reported.append(done / total))  # fmt: skip
    assert reported == sorted(reported)
    assert reported[-1] == 1.0
    page = Page((tmp_path / "report.html").read_text("utf-8"))
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)
    for panel in photograph_panels(states(harvest)):
        known = panel.key not in ("Sxx", "Syy", "w", "true_w", "best", "loss")
        known &= not panel.key.endswith("-model")
        assert (f"{panel.key}-1" in page.ids) is known, panel.key
    for name in ("skipped", "optics", "obtained", "timeline", "truth"):
        assert name not in page.ids


def test_a_plain_global_dic_has_a_report_too(harvest: Harvest, tmp_path: File) -> None:
    frame = bare(harvest).frames[0]
    plain = Ansatz(made_up.DOMAIN, (), v0_degree=3)
    result = replace(frame.result, ansatz=plain, unknowns=plain.initial_guess(0.05),
                     inverse=1e-12 * np.eye(plain.size))  # fmt: skip
    by_noise = result.covariance(made_up.NOISE)
    errors = field_errors(result, frame.error_x, frame.error_y, by_noise)
    frame = replace(frame, result=result, by_noise=errors,
                    identifiability=identifiability(result, made_up.MASK))  # fmt: skip
    ids = Page(report(replace(bare(harvest), frames=(frame,)), tmp_path)).ids
    assert "v0x-1" in ids
    assert "v1-1" not in ids
    assert "mode" not in ids


def test_every_mode_has_its_panels(harvest: Harvest) -> None:
    frame = bare(harvest).frames[0]
    single = FourierMode.scaled(
        free_family([[0.3, 1.0, 1.2, 0.4, 0.1]]), made_up.PITCH, Taper(made_up.CELLULAR, 0.25)
    )
    both = replace(frame.result.ansatz, modes=(*frame.result.ansatz.modes, single))
    result = replace(frame.result, ansatz=both, unknowns=both.initial_guess(0.05, 0.4),
                     inverse=1e-12 * np.eye(both.size))  # fmt: skip
    by_noise = result.covariance(made_up.NOISE)
    errors = field_errors(result, frame.error_x, frame.error_y, by_noise)
    frame = replace(frame, result=result, by_noise=errors,
                    identifiability=identifiability(result, made_up.MASK))  # fmt: skip
    both_modes = replace(bare(harvest), frames=(frame,))
    (state,) = states(both_modes)
    second = [panel for panel in photograph_panels([state]) if "2" in panel.key]
    assert [panel.key for panel in second] == [
        "v2", "phi2", "fluc2x", "fluc2y", "v2-noise", "fluc2-noise"]  # fmt: skip
    drawn = second[0].draw(state)
    drawn.canvas.draw()
    reported = harvest_summary(both_modes)["frames"][0]
    assert reported["modes"][1]["waves"][0]["xi"] == pytest.approx([0.6, 0.2])
    cards = mode_cards([reported], {reported["name"]: "it"})
    assert [len(table.rows) for card in cards for table in card.tables] == [7, 4]


def test_photographs_alike_are_distinguished_by_their_names(summary: dict[str, Any]) -> None:
    first, second = summary["frames"]
    message = photograph_labels([first, second, second | {"name": "again"}])
    at = "After buckling · 7\N{NO-BREAK SPACE}%"
    assert list(message.values())[1:] == [f"{at} · IMG_2", f"{at} · again"]
    assert "IMG_1" not in message["IMG_1"]


def test_advice_that_was_taken_is_not_given_again(harvest: Harvest) -> None:
    fixed, free = harvest.frames[0], replace(harvest.frames[1], name="free")
    weak = free.result.ansatz.initial_guess(0.05, 0.01)
    result = replace(free.result, unknowns=weak)
    free = replace(free, result=result, identifiability=identifiability(result, made_up.MASK))
    reported = harvest_summary(replace(harvest, frames=(fixed, free)))["frames"]
    assert fixed.identifiability.unobservable == free.identifiability.unobservable == (0,)
    assert reported[0]["warnings"] == []
    assert "phi1 is not observable" in reported[1]["warnings"][0]


def test_many_photographs_have_numbers_and_some_have_pictures(harvest: Harvest) -> None:
    strains = np.linspace(0.01, 0.2, 20)
    frames = tuple(
        replace(harvest.frames[int(e > 0.085)], name=f"IMG_{k}", strain_x=e)
        for k, e in enumerate(strains)
    )
    moments = [made_up.moment(frame) for frame in frames]
    long = replace(harvest, frames=frames, timeline=moments, truth=None)
    shown = shown_frames(long)
    assert len(shown) == MOST_SHOWN
    first = next(k for k, moment in enumerate(moments) if moment.has_pattern)
    assert {frames[0], frames[first - 1], frames[first], frames[-1]} <= set(shown)
    (every,) = number_cards(harvest_summary(long), [], {})[0].tables
    assert len(every.rows) == 20


def test_the_summary_is_plain_json(harvest: Harvest, summary: dict[str, Any]) -> None:
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    unknown = bare(harvest)
    lost = replace(unknown.frames[0].result, inverse=np.diag([np.inf] * 77))
    by_noise = replace(unknown.frames[0].by_noise, covariance=lost.inverse)
    frame = replace(unknown.frames[0], result=lost, by_noise=by_noise)
    reported = harvest_summary(replace(unknown, frames=(frame,)))
    assert json.dumps(reported, allow_nan=False)
    assert reported["frames"][0]["modes"][0]["parameters"][0]["sd_noise"] is None


def test_the_summary_tells_the_measured_numbers(harvest: Harvest, summary: dict[str, Any]) -> None:
    frame, reported = harvest.frames[1], summary["frames"][1]
    mode, result = reported["modes"][0], frame.result
    part = result.ansatz.phi_slice(0)
    # v is a constant, phi's two waves are the diagonals, with a wavelength of two cells.
    assert mode["v_max_mm"] == pytest.approx(0.9)
    assert [wave["xi"] for wave in mode["waves"]] == [[0.5, 0.5], [-0.5, 0.5]]
    # The wave vector is half the parameter, so its error is half the parameter's.
    errors = result.standard_errors(made_up.NOISE)[part]
    assert [p["sd_noise"] for p in mode["parameters"]] == pytest.approx(errors)
    assert mode["waves"][0]["sd_noise"] == pytest.approx(errors[1:3] / 2)
    assert mode["waves"][0]["sd_model_error"] == pytest.approx([0.5e-4, 0.5e-4])
    # w was made up: two waves of 4 um, of 0.32 px, on top of what was measured; as seen at the
    # local DIC's points, of which every sixth pixel has one.
    at = made_up.wave()[3::6, 3::6][made_up.MASK[3::6, 3::6]] / made_up.GRID.pixel_size
    assert reported["local"]["w_beyond_noise_px"] == pytest.approx(
        np.sqrt((at**2).mean()), rel=1e-2
    )
    fixed = summary["frames"][0]["modes"][0]
    assert fixed["fixed"]
    assert fixed["waves"][0]["sd_noise"] is None
    assert summary["lattice"]["pitch_px"] == pytest.approx(40.0, abs=0.1)
    assert summary["buckling"]["before"] == 0.04


def test_units_of_a_mode_of_another_length(harvest: Harvest) -> None:
    frame = harvest.frames[1]
    mode = replace(frame.result.ansatz.modes[0], half_wavelength=2 * made_up.PITCH)
    result = replace(frame.result, ansatz=replace(frame.result.ansatz, modes=(mode,)))
    reported = harvest_summary(replace(harvest, frames=(replace(frame, result=result),)))
    # The same k is a wave twice as long.
    assert reported["frames"][0]["modes"][0]["waves"][0]["xi"] == [0.25, 0.25]


def test_the_boundary_follows_the_mask() -> None:
    boundary = mask_boundary(made_up.MASK, made_up.GRID)
    assert len(boundary.loops) == 25  # the edge and 24 holes
    areas = [_area(boundary.nodes[loop[:, 0]]) for loop in boundary.loops]
    edge = int(np.argmax(np.abs(areas)))
    assert abs(areas[edge]) == pytest.approx(2.3 * 3.3, rel=0.01)
    # Holes run the other way round, so that they stay open when the boundary is filled.
    holes = np.sign(-areas[edge]) * np.delete(areas, edge)
    # A circle of pixels has the circle's area within half a pixel along its edge.
    area = np.pi * made_up.DIAMETER**2 / 4
    assert holes == pytest.approx(area, rel=2 * made_up.GRID.pixel_size / made_up.DIAMETER)
    x, y = np.meshgrid(made_up.GRID.x, made_up.GRID.y)
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    inside = np.logical_xor.reduce(
        [Path(boundary.nodes[loop[:, 0]]).contains_points(points) for loop in boundary.loops]
    )
    # It runs between the pixels, at most a third of one off: they are told apart but for a few.
    assert np.mean(inside != made_up.MASK.ravel()) < 0.01


def test_specks_and_an_empty_mask_have_no_boundary() -> None:
    mask = np.zeros(made_up.GRID.shape, dtype=np.bool_)
    assert not mask_boundary(mask, made_up.GRID).loops
    mask[50:53, 50:53] = True
    assert len(mask_boundary(mask, made_up.GRID).loops) == 1
    assert not mask_boundary(mask, made_up.GRID, least=20 * made_up.GRID.pixel_size**2).loops


def test_an_affine_part_of_a_distortion_is_not_an_error() -> None:
    found = made_up.lens()
    c = found.coefficients.copy()
    c[:, :3] += [[3.0, 1.0, -2.0], [1.0, 0.5, 0.2]]
    same = PolynomialDistortion(found.shape, c)
    row, col = (np.linspace(0.0, n - 1.0, 40) for n in found.shape)
    at = row[:, None], col[None, :]
    assert np.abs(apart_without_affine(found, same, *at)).max() < 1e-10
    assert np.abs(apart_without_affine(found, made_up.lens(2.0), *at)).max() > 0.5


def test_warnings_outcomes_and_the_noise_are_reported(summary: dict[str, Any]) -> None:
    change = {"outcome": "stagnated", "outcome_why": "No step.", "warnings": ["beware of this"]}
    frame = summary["frames"][1] | change
    message = notes(summary | {"frames": [frame]})
    at = "IMG_2, 7\N{NO-BREAK SPACE}%: "
    assert f"{at}the correlation ended as “stagnated”: No step." in message
    report = photographs_report(summary | {"frames": [frame]})
    assert "IMG_2: beware of this." in report.warnings
    assert any("25 grey levels, 0.61 % of full scale, measured" in note for note in message)


@pytest.mark.parametrize(
    ("buckling", "value"),
    [
        (None, None),
        ({"before": None, "after": None, "estimate": None}, None),
        ({"before": None, "after": 0.05, "estimate": None}, "< 5"),
        ({"before": 0.04, "after": 0.05, "estimate": 0.045}, "4 … 5"),
    ],
)
def test_buckling_is_reported_as_far_as_it_is_known(
    summary: dict[str, Any], buckling: dict[str, Any] | None, value: str | None
) -> None:
    keys = key_numbers(summary | {"buckling": buckling, "truth": []})
    assert next(key for key in keys if key.name == "buckling").value == value
    assert keys[0].value == "2 of 3"


def _area(corners: np.ndarray[Any, Any]) -> float:
    x, y = corners.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
