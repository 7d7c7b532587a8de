"""The report's pictures: right way up, in the right place, with units, and none of the globals.

Guards: every colour bar states its unit; a field lands where its pixels are; missing values are
left blank; the signed colours are even to both sides; the SVG stands on its own.
"""

from __future__ import annotations

import re
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
import synthetic_report as made_up
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from numpy.typing import NDArray

from modeharvest.idic.spectra.pattern import WavePattern
from modeharvest.idic.spectra.waves import PlaneWave
from modeharvest.report.experiment import (
    ExperimentData,
    SnapshotState,
    draw_hero,
    experiment_figures,
    snapshot_panels,
)
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.curves import (
    curve,
    draw_convergence,
    draw_density,
    draw_eigenvalues,
    draw_load,
    draw_waves,
    pattern_density,
    plain_ticks,
)
from modeharvest.report.figures.fits import Panel
from modeharvest.report.figures.maps import ColourScale, MapFrame, draw_field
from modeharvest.report.figures.style import BLUE, INK, MUTED, SIGNED, style, to_svg

UNITS = {"µm", "mm⁶"}
FRACTIONS = {"image", "residual"}  # of full scale


PANELS = [panel for panel in snapshot_panels(1) if panel.section != "whole"]


@pytest.fixture(scope="module")
def data() -> ExperimentData:
    return made_up.data()


@pytest.fixture(scope="module")
def states(data: ExperimentData) -> list[SnapshotState]:
    return data.states


def colour_bar_units(drawn: Figure) -> list[str]:
    texts = [text for axes in drawn.axes for text in axes.texts]
    return [text.get_text() for text in texts if text.get_label() == "colour bar"]


def pixels(drawn: Figure) -> NDArray[np.uint8]:
    drawn.canvas.draw()
    return np.asarray(drawn.canvas.buffer_rgba())  # type: ignore[attr-defined]  # Agg's own


def test_no_label_is_cut_off(data: ExperimentData) -> None:
    """All text lies in its figure, as narrow screens show nothing beyond it."""
    draws = {figure.name: figure.draw for figure in experiment_figures(data)}
    wave = {"xi": [0.5001, 0.5002], "sd_noise": None, "sd_model_error": None}
    mode = {"waves": [wave], "fixed": False, "observable": True}
    draws["waves"] = lambda: draw_waves([{"strain": s, "modes": [mode]} for s in (0.1, 0.12)])
    for name, draw in draws.items():
        with style():
            drawn = draw()
            pixels(drawn)
            box = drawn.get_tightbbox()
        over = np.maximum(-box.min, box.max - drawn.get_size_inches())
        assert over.max() < 0.02, f"{name}: {over} in"


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: panel.key)
def test_every_panel_states_the_unit_of_its_colours(
    states: list[SnapshotState], panel: Panel[SnapshotState]
) -> None:
    units = colour_bar_units(panel.draw(states[1]))
    if panel.key in FRACTIONS:
        assert units == ["full scale"]
    else:
        assert set(units) <= UNITS
    assert len(units) == (0 if panel.key == "phi1" else 1)  # a deformed shape has no colours


def test_the_panels_of_the_paper_are_all_there() -> None:
    named = " ".join(panel.words["paper"] for panel in PANELS)
    assert all(f"({letter})" in named for letter in "abcdefghijklmnop")


@pytest.mark.parametrize("name", ["residual", "w", "best", "loss"])
def test_a_field_without_any_value_is_drawn_blank(data: ExperimentData, name: str) -> None:
    nothing = np.full_like(data.comparisons[0].displacement, np.nan)
    empty = replace(data.comparisons[0], displacement=nothing, residual=nothing[..., 0])
    panel = next(p for p in PANELS if p.key == name)
    drawn = panel.draw(replace(data, comparisons=[empty, empty]).states[0])
    assert colour_bar_units(drawn)


def sides(drawn: Figure) -> dict[str, NDArray[np.float64]]:
    """Mean colour of a small patch well inside each quarter of the map."""
    shown = pixels(drawn)
    box = drawn.axes[0].get_window_extent()
    height = shown.shape[0]

    def at(across: float, up: float) -> NDArray[np.float64]:
        col = int(box.x0 + across * box.width)
        row = int(height - box.y0 - up * box.height)
        return np.asarray(shown[row - 4 : row + 4, col - 4 : col + 4, :3].mean(axis=(0, 1)))

    return {"upper left": at(0.2, 0.8), "upper right": at(0.8, 0.8),
            "lower left": at(0.2, 0.2), "lower right": at(0.8, 0.2)}  # fmt: skip


def test_a_field_is_drawn_the_right_way_up() -> None:
    frame = MapFrame.of(MeshBoundary.of(made_up.plate()), made_up.GRID)
    up = np.repeat(np.sign(frame.grid.y)[:, None], frame.grid.cols, axis=1)
    colour = sides(draw_field(frame, up, ColourScale.signed(up, "µm")))
    for side in ("left", "right"):
        red, blue = colour[f"upper {side}"], colour[f"lower {side}"]
        assert red[0] > red[2] + 40
        assert blue[2] > blue[0] + 40


def test_a_field_is_drawn_where_the_motion_takes_it() -> None:
    frame = MapFrame.of(MeshBoundary.of(made_up.plate()), made_up.GRID)
    X, Y = frame.moved_corners(None)
    moved_X, moved_Y = frame.moved_corners(
        lambda x, y: np.stack(np.broadcast_arrays(0.3 + 0 * x * y, 2 * y + 0 * x), axis=-1)
    )
    np.testing.assert_allclose(moved_X, X + 0.3, atol=1e-12)
    np.testing.assert_allclose(moved_Y, 3 * Y, atol=1e-12)
    assert np.all(np.diff(Y[:, 0]) <= 0)  # rows run down the image
    nodes = frame.moved_nodes(lambda x, y: np.stack([x, -y], axis=-1))
    np.testing.assert_array_equal(nodes, frame.boundary.nodes * [1, -1])


def test_averages_leave_missing_pixels_out() -> None:
    frame = MapFrame.of(MeshBoundary.of(made_up.plate()), made_up.GRID, cells=26)
    assert frame.factor == 5
    field = np.full(made_up.GRID.shape, 2.0)
    field[::2] = np.nan
    field[:5, :5] = np.nan
    coarse = frame.average(field)
    assert coarse.shape == frame.grid.shape == frame.sample(field).shape
    assert np.isnan(coarse[0, 0])
    np.testing.assert_array_equal(coarse.ravel()[1:], 2.0)


def test_the_signed_colours_darken_evenly_to_both_sides() -> None:
    rgb = SIGNED(np.linspace(0.0, 1.0, 255))[:, :3]
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    lightness = 116 * np.cbrt(linear @ [0.2126, 0.7152, 0.0722]) - 16  # CIE L*
    middle = 127
    assert lightness.argmax() == middle
    assert np.all(np.diff(lightness[: middle + 1]) > 0)
    assert np.all(np.diff(lightness[middle:]) < 0)
    # CIE's and Oklab's lightness are not the same: equal within a just noticeable few.
    np.testing.assert_allclose(lightness, lightness[::-1], atol=5)


def test_the_unstable_path_is_dashed_from_the_critical_point_on() -> None:
    drawn = draw_load(made_up.PATH, made_up.CRITICAL_STRAIN)
    primary = [line for line in drawn.axes[0].lines if line.get_color() == BLUE]
    stable, unstable = primary
    assert stable.get_linestyle() == "-"
    assert unstable.get_linestyle() != "-"
    # 0.06 lies a fifth of the way from (5 %, 0.5 N/mm) to (10 %, 1 N/mm)
    for line, end in ((stable, -1), (unstable, 0)):
        np.testing.assert_allclose(np.asarray(line.get_xydata())[end], [6.0, 0.6])


def test_without_a_critical_point_the_solid_line_ends_with_the_last_stable_state() -> None:
    drawn = draw_load({"primary": made_up.PATH["primary"]}, None)
    stable = drawn.axes[0].lines[0]
    assert np.asarray(stable.get_xdata())[-1] == 5.0


@pytest.mark.parametrize("critical", [None, made_up.CRITICAL])
@pytest.mark.parametrize("path", [{}, {"primary": {}}, made_up.PATH], ids=["none", "empty", "all"])
def test_paths_of_any_completeness_are_drawn(
    path: dict[str, dict[str, list[float]]], critical: dict[str, float] | None
) -> None:
    assert pixels(draw_load(path, None if critical is None else critical["strain"])).size
    assert pixels(draw_eigenvalues(path, critical)).size


def test_the_rings_are_at_the_wave_vectors(data: ExperimentData) -> None:
    spectrum, _ = data.spectra[1]
    waves = (
        PlaneWave((1.0, 0.9), (0.1, 0.1), 0.0, 0.0),
        PlaneWave((-1.0, 0.8), (0.1, 0.1), 0.0, 0.0),
    )
    pattern = WavePattern(waves, None, ())
    drawn = draw_density(spectrum, pattern, 0, pattern_density(spectrum, pattern))
    rings = {tuple(np.ravel(line.get_xydata()).tolist()) for line in drawn.axes[0].lines}
    # In units of 1/l, half of those of pi/l; a real wave has two vectors.
    assert rings == {(0.5, 0.45), (-0.5, -0.45), (-0.5, 0.4), (0.5, -0.4)}


def test_the_colours_of_a_density_end_at_the_pattern() -> None:
    made_spectrum, _ = made_up.spectrum(made_up.comparison(0.1, 4.0))
    wave = PlaneWave((1.0, 1.0), (0.1, 0.1), 0.0, 0.0)
    pattern = WavePattern((wave,), None, ())
    end = pattern_density(made_spectrum, pattern)
    assert end == np.max(np.abs(made_spectrum.at((0.5, 0.5))) ** 2)
    image = draw_density(made_spectrum, pattern, 1, end).axes[0].images[0]
    assert image.get_clim() == (0.0, end)
    assert pattern_density(made_spectrum, replace(pattern, waves=())) == 0.0


def test_each_level_of_the_correlation_is_a_curve(data: ExperimentData) -> None:
    history = data.comparisons[0].result.history
    curves = draw_convergence(data.comparisons[0].result).axes[0].lines
    assert [len(np.asarray(line.get_xdata())) for line in curves] == [2, 2]
    drawn = np.concatenate([np.asarray(line.get_ydata()) for line in curves])
    np.testing.assert_array_equal(drawn, [step.step_px for step in history])
    assert draw_convergence(replace(data.comparisons[0].result, history=())).axes
    (axes,) = draw_convergence(replace(data.comparisons[0].result, history=history[:1])).axes
    assert [tick for tick in axes.get_xticks() if 0.5 <= tick <= 1.5] == [1.0]


@pytest.mark.parametrize(("low", "labels"), [(0.05, {"2", "3", "5"}), (0.001, {"2", "5"})])
def test_minor_ticks_of_long_logarithmic_axes_have_fewer_labels(
    low: float, labels: set[str]
) -> None:
    drawn, axes = curve("", "")
    axes.set(xscale="log", xlim=(low, 8.0))
    plain_ticks(axes.xaxis)
    drawn.canvas.draw()
    assert {
        tick.get_text()[-1] for tick in axes.get_xminorticklabels() if tick.get_text()
    } == labels


def test_the_svg_stands_on_its_own(states: list[SnapshotState]) -> None:
    svg = to_svg(draw_hero(states[1]), "hero", 'a "title" & more')
    sizes = 'style="max-width: (\\d+)px; --least: (\\d+)px"'
    head = re.match(r'<svg viewBox="0 0 ([\d.]+) [\d.]+" ' + sizes, svg)
    assert head is not None
    assert float(head[2]) == pytest.approx(float(head[1]) * 150.0 / 72.0, abs=0.5)
    assert float(head[3]) == pytest.approx(float(head[1]) * 90.0 / 72.0, abs=0.5)
    assert svg.endswith("</svg>")
    assert 'aria-label="a &quot;title&quot; &amp; more"' in svg
    ids = re.findall(r'\bid="([^"]+)"', svg)
    assert len(ids) == len(set(ids))
    assert all(name.startswith("hero-") for name in ids)
    wanted = set(re.findall(r'url\(#([^)]+)\)|href="#([^"]+)"', svg))
    assert {a or b for a, b in wanted} <= set(ids)
    sources = re.findall(r'href="(?!#)([^"]{0,16})', svg)
    assert sources
    assert all(source.startswith("data:image/webp;") for source in sources)
    assert "http" not in svg
    assert "font-family" not in svg
    assert to_hex(INK) not in svg
    assert to_hex(MUTED) not in svg


def test_drawing_leaves_matplotlib_as_it_was(states: list[SnapshotState]) -> None:
    before = dict(mpl.rcParams)
    to_svg(draw_hero(states[0]), "hero", "")
    assert dict(mpl.rcParams) == before
