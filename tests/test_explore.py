"""Fields to explore on a page: packed within their quantisation, and shown, read and saved as such.

Guards, without a browser: numbers come back within the stated step, small pages, nothing loaded,
readable without JavaScript. In headless Chromium: the value under the pointer is the field's there;
panels zoom together; blinking switches truth and measurement; files hold the data; keys and words
for those who don't see; no errors, no requests.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_report as made_up
from browser import WHY_SKIPPED, Tab, browser, find_browser
from explored import content_of, quantity, samples, unpacked
from html_page import Page
from numpy.typing import NDArray

from modeharvest.report import explore
from modeharvest.report.experiment import experiment_report
from modeharvest.report.explore import LENGTH_STEP, Packer
from modeharvest.report.figures import style
from modeharvest.report.model import output
from modeharvest.report.model.output import write_page

FLOATS = NDArray[np.float64]


@pytest.mark.parametrize("kind", ["smooth", "noise", "constant", "holes"])
def test_packed_numbers_come_back_within_half_a_step(kind: str) -> None:
    random = np.random.default_rng(3)
    y, x = np.mgrid[0:37, 0:53] / 10.0
    values = {
        "smooth": 40.0 * np.sin(x) * y,
        "noise": random.normal(size=x.shape),
        "constant": np.full(x.shape, 2.5),
        "holes": np.where(np.hypot(x - 2, y - 2) < 1, np.nan, 1e3 * x + y),
    }[kind]
    packer = Packer()
    found = unpacked(packer.packed[packer.add(values, 1e-3)], packer.masks, (37, 53))
    step = packer.packed[0]["step"]
    reach = np.nanmax(values) - np.nanmin(values)
    assert step <= max(reach / 65535, 1e-3) * (1 + 1e-12) or kind == "constant"
    assert np.array_equal(np.isnan(found), np.isnan(values))
    assert np.nanmax(np.abs(found - values)) <= 0.5001 * step
    assert packer.packed[0]["predicted"] == (kind in ("smooth", "holes"))


def test_a_mask_is_stored_once() -> None:
    packer = Packer()
    field = np.where(np.eye(9) > 0, np.nan, np.arange(81.0).reshape(9, 9))
    assert [packer.add(values, 0.0) for values in (field, 2 * field)] == [0, 1]
    assert len(packer.masks) == 1


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a virtual experiment, small and made up."""
    data, path = made_up.data(), tmp_path_factory.mktemp("explore") / "report.html"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "DPI", 65)
        long = {"warnings": [f"/{'folder' * 30}/field.csv: expected numbers, got none"]}
        write_page(experiment_report(made_up.summary(data) | long, data), path)
    return path


@pytest.fixture(scope="module")
def content(page: Path) -> Any:
    """The numbers on it."""
    return content_of(page.read_text("utf-8"))


def test_the_page_can_be_read_without_javascript(page: Path) -> None:
    text = page.read_text("utf-8")
    assert re.search(r'<section id="explore" class="explore" hidden>', text)
    assert re.search(r'<li class="ex-link" hidden>', text)
    assert Page(text).tags["svg"] > 20  # the static pictures


def test_the_page_forbids_the_browser_to_load_anything(page: Path) -> None:
    text = page.read_text("utf-8")
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    assert policy.startswith("default-src 'none'; ")
    assert not re.search(r"https?:|connect-src|\*", policy)
    assert not re.search(r"<script[^>]* src=", text)


@pytest.mark.parametrize(("spare", "factor"), [(1, 1), (-15_000, 2), (-80_000, 1)])
def test_samples_are_fewer_where_that_makes_a_page_small_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spare: int, factor: int
) -> None:
    data, path = made_up.data(), tmp_path / "report.html"
    monkeypatch.setattr(explore, "MOST_SAMPLES", 2 * 10 * int(made_up.MASK.sum()))
    report = experiment_report(made_up.summary(data), data)
    assert report.explore is not None
    pictures = {figure.name: 1000 * " " for figure in report.figures}
    most = sum(map(len, pictures.values())) + len(report.explore(1.0)) + spare
    monkeypatch.setattr(output, "MOST_BYTES", most)
    write_page(report, path, pictures=pictures)
    text = path.read_text("utf-8")
    assert content_of(text)["factor"] == factor
    (shown,) = re.findall(r'(?s)<section id="explore".*</script>', text)
    assert (len(shown) + sum(map(len, pictures.values())) <= most) == (spare > -80_000)


def test_every_quantity_has_colours_in_every_state(content: Any) -> None:
    keys = [quantity["key"] for quantity in content["quantities"]]
    assert keys == ["ux", "uy", "v0x", "v0y", "v1", "fluc1x", "fluc1y", "w", "best", "loss",
                    "residual"]  # fmt: skip
    for entry in content["quantities"]:
        for low, high, least, most in entry["ends"]:
            assert least <= low <= high <= most
    assert [q["key"] for q in content["quantities"] if q["truth"]] == ["ux", "uy"]


def test_quantities_are_those_of_the_run(content: Any) -> None:
    for k, one in enumerate(made_up.data().comparisons):
        u, true = one.result.displacement(), one.displacement
        fields = {"ux": u[..., 0], "w": np.linalg.norm(true - u, axis=-1),
                  "loss": np.linalg.norm(u - one.best.displacement(), axis=-1),
                  "v0y": one.result.v0()[..., 1], "residual": one.residual}  # fmt: skip
        for key, field in fields.items():
            expected = np.where(samples(content, made_up.MASK), samples(content, field), np.nan)
            reach = np.nanmax(expected) - np.nanmin(expected)
            step = 4 * LENGTH_STEP * content["pixel"] if key != "residual" else reach / 1000
            assert np.array_equal(np.isnan(expected), np.isnan(quantity(content, k, key)))
            assert np.nanmax(np.abs(quantity(content, k, key) - expected)) <= step, key
        truth = quantity(content, k, "uy", "truth") - samples(content, true)[..., 1]
        assert np.nanmax(np.abs(truth)) <= 2 * LENGTH_STEP * content["pixel"]


def test_lengths_are_as_fine_as_stated(content: Any) -> None:
    for state in content["states"]:
        for name in ("ux", "wx", "f1x"):
            packed = content["packed"][state["arrays"][name]]
            assert packed["step"] <= LENGTH_STEP * content["pixel"] * (1 + 1e-12)


# -- in a browser ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def downloads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("downloads")


@pytest.fixture(scope="module")
def opened(page: Path, downloads: Path) -> Iterator[Tab]:
    """The page in a headless browser; what it said and asked for is checked in the end."""
    command = find_browser()
    if command is None:
        pytest.skip(WHY_SKIPPED)
    with browser(command, downloads) as tab:
        tab.open(page)
        tab.run("explorer.ready")
        tab.run("document.documentElement.style.scrollBehavior = 'auto'")
        yield tab
        assert tab.messages == []
        assert [address for address in tab.requests if address != page.as_uri()] == []


@pytest.fixture
def tab(opened: Tab) -> Tab:
    """The page as it is in the beginning."""
    opened.run("(async () => { const e = explorer; e.acts.measured(); e.shared.fixed = false;"
               " e.setState(1); await e.arrange(2); await e.reshape(0); e.acts.all();"
               " e.panels.forEach((p, k) => { p.quantity = k; p.choice.value = k; p.own = -1; });"
               " document.getElementById('explore').scrollIntoView();"
               " await e.draw(); })()")  # fmt: skip
    return opened


def box(tab: Tab, panel: int = 0) -> tuple[float, float, float, float]:
    """Left, top, width and height of a panel's map in the window [CSS px]."""
    left, top, width, height = tab.run(
        f"(r => [r.left, r.top, r.width, r.height])(explorer.panels[{panel}]"
        ".over.getBoundingClientRect())"
    )
    return left, top, width, height


def value_of(tab: Tab, panel: int = 0) -> float:
    """The value that a panel shows."""
    text = tab.run(f"explorer.panels[{panel}].value.querySelector('b')?.textContent ?? 'nan'")
    return float(text.replace("\N{MINUS SIGN}", "-"))


def displacement(state: int, truth: bool = False) -> FLOATS:
    """(rows, cols, 2) [µm] of the made-up experiment's images."""
    one = made_up.data().comparisons[state]
    return 1e3 * (one.displacement if truth else one.result.displacement())


def sample(tab: Tab, content: Any) -> tuple[int, int]:
    """Row and column in the images of the pixel at the cross."""
    k = tab.run("explorer.shared.at")
    row, col = divmod(int(k), content["cols"])
    first, factor = content["first"], content["factor"]
    return first[0] + factor * row, first[1] + factor * col


@pytest.mark.parametrize(("right", "down"), [(0.3, 0.35), (0.5, 0.2), (0.71, 0.66)])
def test_the_value_under_the_pointer_is_the_field_s(
    tab: Tab, content: Any, right: float, down: float
) -> None:
    left, top, width, height = box(tab)
    tab.mouse(left + right * width, top + down * height)
    row, col = sample(tab, content)
    # Where the pointer is, by the panel's own scale, lies within that sample.
    at = f"{right} * p.map.width, {down} * p.map.height"
    x, y = tab.run(f"(p => p.toMm({at}))(explorer.panels[0])")
    grid = made_up.GRID
    reach = 0.51 * content["factor"] * grid.pixel_size + 1.5 / tab.run(
        "explorer.panels[0].transform().s"
    )
    assert abs(grid.x[col] - x) <= reach
    assert abs(grid.y[row] - y) <= reach
    true = displacement(1)[row, col]
    for c in range(2):
        step = content["packed"][content["states"][1]["arrays"]["ux"]]["step"]
        rounding = 1e3 * step + 0.6e-3 * abs(true[c])  # four digits are shown
        assert abs(value_of(tab, c) - true[c]) <= rounding


def test_deformed_the_pointer_finds_the_material_point(tab: Tab, content: Any) -> None:
    tab.run("explorer.reshape(5).then(() => explorer.draw()).then(() => 0)")
    left, top, width, height = box(tab)
    tab.mouse(left + 0.4 * width, top + 0.3 * height)
    row, col = sample(tab, content)
    x, y = tab.run("(p => p.toMm(p.map.width * 0.4, p.map.height * 0.3))(explorer.panels[0])")
    u = 1e-3 * displacement(1)[row, col]
    reach = 1.2 * content["factor"] * made_up.GRID.pixel_size
    assert abs(made_up.GRID.x[col] + 5 * u[0] - x) <= reach
    assert abs(made_up.GRID.y[row] + 5 * u[1] - y) <= reach
    assert np.abs(5 * u).max() > reach  # it moved by more than that


def test_zoom_is_linked_and_keeps_the_point_under_the_pointer(tab: Tab) -> None:
    left, top, width, height = box(tab)
    at = left + 0.6 * width, top + 0.4 * height
    tab.click(*at)
    where = (
        "explorer.panels.map(p => [p.transform().s,"
        " ...p.toMm(0.6 * p.map.width, 0.4 * p.map.height)])"
    )
    before = tab.run(where)
    tab.mouse(*at, "mouseWheel", deltaX=0, deltaY=-400)
    tab.run("explorer.draw().then(() => 0)")
    after = tab.run(where)
    assert after[0] == pytest.approx(after[1])
    assert after[0][0] > 1.5 * before[0][0]
    assert after[0][1:] == pytest.approx(before[0][1:], abs=1.5 / before[0][0])


def test_dragging_moves_all_panels(tab: Tab) -> None:
    tab.run("explorer.setView(4, 0, 0).then(() => 0)")
    left, top, width, height = box(tab)
    x, y = left + 0.5 * width, top + 0.5 * height
    tab.mouse(x, y, "mousePressed", button="left", clickCount=1)
    for shift in (10, 40):
        tab.mouse(x + shift, y, button="left", buttons=1)
    tab.mouse(x + 40, y, "mouseReleased", button="left", clickCount=1)
    tab.run("explorer.draw().then(() => 0)")
    moved, scale = tab.run("[explorer.shared.x, explorer.panels[1].transform().s]")
    assert moved == pytest.approx(-40 / scale, rel=0.1)


def test_colour_limits_have_their_unit_beside_them(tab: Tab, content: Any) -> None:
    residual = [quantity["key"] for quantity in content["quantities"]].index("residual")
    tab.run(f"explorer.shared.unit = 2; explorer.panels[1].quantity = {residual}; 0")
    units = "explorer.panels.map(p => p.element.querySelector('.ex-unit').textContent)"
    assert tab.run(f"explorer.draw().then(() => {units})") == ["px", "of full scale, or levels"]
    tab.run("explorer.shared.unit = 0; explorer.panels[1].quantity = 1; explorer.draw()")


def test_blinking_switches_truth_and_measurement(tab: Tab, content: Any) -> None:
    left, top, width, height = box(tab)
    tab.click(left + 0.35 * width, top + 0.3 * height)
    row, col = sample(tab, content)
    measured, true = (displacement(1, truth)[row, col, 0] for truth in (False, True))
    assert abs(true - measured) > 1.0
    assert value_of(tab) == pytest.approx(measured, abs=0.1)
    tab.press("b")
    tab.run("explorer.draw().then(() => 0)")
    assert value_of(tab) == pytest.approx(true, abs=0.1)
    assert (
        tab.run("document.querySelector('[data-do=truth]').getAttribute('aria-pressed')") == "true"
    )
    assert tab.run("explorer.panels[0].tag.textContent") == "truth"
    tab.press("b")
    tab.run("explorer.draw().then(() => 0)")
    assert value_of(tab) == pytest.approx(measured, abs=0.1)
    seen = tab.run("new Promise(done => { const seen = []; explorer.acts.blink();"
                   " setTimeout(() => { seen.push(explorer.shared.truth); setTimeout(() => {"
                   " seen.push(explorer.shared.truth); explorer.acts.blink(); done(seen); }, 500);"
                   " }, 250); })")  # fmt: skip
    assert seen[0] != seen[1]


def test_the_slider_goes_through_the_states(tab: Tab, content: Any) -> None:
    left, top, width, height = box(tab)
    tab.click(left + 0.35 * width, top + 0.3 * height)
    row, col = sample(tab, content)
    assert value_of(tab) == pytest.approx(displacement(1)[row, col, 0], abs=0.1)
    tab.press("[")
    tab.run("explorer.draw().then(() => 0)")
    assert tab.run("document.getElementById('ex-label').textContent").startswith("Before buckling")
    assert value_of(tab) == pytest.approx(displacement(0)[row, col, 0], abs=0.1)


def test_colours_have_the_reader_s_limits(tab: Tab) -> None:
    auto = tab.run("explorer.panels[0].ends")
    assert auto[0] == -auto[1]
    tab.run("(p => { p.low.value = '\u221250'; p.high.value = '120'; p.readLimits(); })"
            "(explorer.panels[0])")  # fmt: skip
    assert tab.run("explorer.panels[0].ends") == pytest.approx([-0.05, 0.12])
    assert tab.run("explorer.panels[1].ends") != pytest.approx([-0.05, 0.12])
    tab.run("(p => { p.low.value = 'nonsense'; p.readLimits(); })(explorer.panels[0])")
    invalid = "explorer.panels[0].low.getAttribute('aria-invalid')"
    border = "(p => getComputedStyle(p.low).borderColor == getComputedStyle(p.high).borderColor"
    other = f"{border} && getComputedStyle(p.low).borderColor)(explorer.panels[0])"
    for _ in range(2):  # a drawing leaves what the reader has to correct
        assert tab.run(invalid) == "true"
        assert tab.run("explorer.panels[0].low.value") == "nonsense"
        assert tab.run(other) != tab.run(other.replace("panels[0]", "panels[1]"))
        assert tab.run("explorer.panels[0].ends") == pytest.approx([-0.05, 0.12])
        tab.run("explorer.draw().then(() => 0)")
    tab.run("explorer.panels[0].element.querySelector('.ex-auto').click()")
    tab.run("explorer.draw().then(() => 0)")
    assert tab.run(invalid) == "false"
    assert tab.run("explorer.panels[0].low.value") != "nonsense"
    assert tab.run("explorer.panels[0].ends") == auto


def saved(tab: Tab, downloads: Path, name: str) -> bytes:
    """A file that the page saves."""
    tab.run(f"explorer.panels[0].save({name.rpartition('.')[2]!r})")
    for _ in range(100):
        if (downloads / name).exists() and (downloads / name).stat().st_size:
            return (downloads / name).read_bytes()
        tab.run("new Promise(done => setTimeout(done, 50))")
    raise AssertionError(f"{name} was not saved, but {list(downloads.iterdir())}")


def test_saved_files_hold_the_field(tab: Tab, downloads: Path, content: Any) -> None:
    state = content["states"][1]["name"]
    text = saved(tab, downloads, f"ux-{state}.csv").decode()
    head, columns, *lines = text.strip().split("\n")
    assert head == "# Displacement u along x, After buckling · 10 %, measured"
    assert columns == "x [mm],y [mm],row [px],column [px],ux [µm]"
    x, y, row, col, u = np.array([line.split(",") for line in lines], dtype=np.float64).T
    at = row.astype(int), col.astype(int)
    assert len(u) == made_up.MASK[content["first"][0] :: content["factor"],
                                  content["first"][1] :: content["factor"]].sum()  # fmt: skip
    grid = made_up.GRID
    assert np.abs(x - grid.x[at[1]]).max() < 1e-5
    assert np.abs(y - grid.y[at[0]]).max() < 1e-5
    step = content["packed"][content["states"][1]["arrays"]["ux"]]["step"]
    assert np.abs(u - displacement(1)[at][:, 0]).max() <= 0.51e3 * step

    picture = saved(tab, downloads, f"ux-{state}.svg").decode()
    assert picture.startswith("<svg ")
    assert "Displacement u along x" in picture
    assert Page(picture).open == []
    assert saved(tab, downloads, f"ux-{state}.png")[:8] == b"\x89PNG\r\n\x1a\n"


def test_a_click_off_the_material_fixes_nothing(tab: Tab) -> None:
    left, top, width, height = box(tab)
    tab.click(left + 0.01 * width, top + 0.01 * height)
    tab.mouse(left + 0.35 * width, top + 0.3 * height)
    assert np.isfinite(value_of(tab))
    tab.press("Escape")
    tab.press("Enter")
    tab.mouse(left + 0.36 * width, top + 0.3 * height)
    assert np.isfinite(value_of(tab))


def test_two_fingers_zoom_and_move(tab: Tab) -> None:
    tab.run("explorer.setView(2, 0, 0).then(() => 0)")
    left, top, width, height = box(tab)
    x, y = left + 0.5 * width, top + 0.4 * height

    def touch(kind: str, apart: float, down: float) -> None:
        points = [{"x": x + side * apart, "y": y + down, "id": side + 1} for side in (-1, 1)]
        tab.send("Input.dispatchTouchEvent", type=kind, touchPoints=points if apart else [])

    def under(down: float) -> list[float]:
        at = f"0.5 * p.map.width, 0.4 * p.map.height + {down}"
        return list(tab.run(f"explorer.draw().then(() => (p => p.toMm({at}))(explorer.panels[0]))"))

    before = under(0)
    touch("touchStart", 30, 0)
    for k in range(1, 11):
        touch("touchMove", 30 + 3 * k, 4 * k)
    touch("touchEnd", 0, 0)
    zoom = tab.run("explorer.shared.zoom")
    assert zoom > 3.0
    scale = tab.run("explorer.panels[0].transform().s")
    assert under(40) == pytest.approx(before, abs=10 / scale)


def test_keys_work_from_buttons_and_leave_the_browser_its_own(tab: Tab) -> None:
    tab.run("document.querySelector('[data-do=all]').focus()")
    tab.press("+")
    assert tab.run("explorer.shared.zoom") == pytest.approx(1.5)
    for where in ("document.activeElement", "explorer.panels[0].over"):
        how = "{key: '+', ctrlKey: true, cancelable: true, bubbles: true}"
        assert tab.run(f"{where}.dispatchEvent(new KeyboardEvent('keydown', {how}))")
    assert tab.run("explorer.shared.zoom") == pytest.approx(1.5)


def test_it_works_by_keys_and_speaks(tab: Tab, content: Any) -> None:
    tab.run("explorer.panels[0].over.focus()")
    tab.press("ArrowRight")
    before = sample(tab, content)
    tab.press("ArrowRight")
    tab.press("ArrowDown")
    after = sample(tab, content)
    factor = content["factor"]
    assert (after[0] - before[0], after[1] - before[1]) == (factor, factor)
    spoken = tab.run("document.getElementById('ex-live').textContent")
    assert "Displacement u along x: " in spoken
    assert f"row {after[0]}" in spoken
    nodes = tab.send("Accessibility.getFullAXTree")["nodes"]
    spoken_alone = [node for node in nodes if node.get("role", {}).get("value") == "status"]
    assert len(spoken_alone) == 2  # the state, and position with values: nothing is read twice
    for key, zoom in (("+", 1.5), ("+", 2.25), ("-", 1.5), ("0", 1.0)):
        tab.press(key)
        assert tab.run("explorer.shared.zoom") == pytest.approx(zoom)
    unlabelled = tab.run(
        "[...document.querySelectorAll('#explore :is(button, select, input, canvas)')].filter(e =>"
        " !e.matches('.ex-map, [aria-hidden]') && !(e.getAttribute('aria-label') || e.textContent"
        ".trim() || e.closest('label'))).map(e => e.outerHTML)"
    )
    assert unlabelled == []
    assert tab.run("explorer.panels[0].over.getAttribute('aria-label')") == (
        "Displacement u along x, After buckling · 10 %, measured"
    )


def test_a_static_picture_leads_to_its_field(tab: Tab) -> None:
    tab.run("document.querySelector('#w-0500 .ex-jump').click()")
    tab.run("explorer.draw().then(() => 0)")
    assert tab.run("[explorer.panels[0].spec.key, explorer.shared.state]") == ["w", 0]


def test_it_fits_a_telephone(tab: Tab) -> None:
    tab.resize(420, 900)
    try:
        tab.run("explorer.draw().then(() => 0)")
        assert tab.run("document.documentElement.scrollWidth") <= 420
        _, _, width, _ = box(tab)
        assert 250 < width <= 420
    finally:
        tab.resize(1280, 900)


@pytest.mark.parametrize("width", [500, 860, 1280])
def test_pictures_of_a_row_are_at_one_height_and_apart(tab: Tab, width: int) -> None:
    """Of six photographs: their headings wrapped in some, and pictures lay on their neighbours."""
    tab.resize(width, 900)
    tab.run("(row => { const one = row.firstElementChild; row.dataset.test = '';"
            " for (let k = 0; k < 5; k++) row.append(one.cloneNode(true));"
            " [...row.children].forEach((f, k) => { f.querySelector('.label').textContent ="
            " k % 2 ? 'A long heading that wraps to two lines or to three' : 'A'; }); })"
            "(document.querySelector('#fluc1x-0500').parentElement)")  # fmt: skip
    try:
        boxes = tab.run("[...document.querySelectorAll('[data-test] svg')].map(e =>"
                        " (r => [r.left, r.right, r.top])(e.getBoundingClientRect()))")  # fmt: skip
        assert len(boxes) >= 6
        for (_, right, top), (left, _, beside) in pairwise(boxes):
            assert abs(top - beside) < 0.5 or beside > top + 50.0
            assert right < left or beside > top
    finally:
        tab.run("(row => { while (row.children.length > 2) row.lastElementChild.remove();"
                " delete row.dataset.test; })(document.querySelector('[data-test]'))")  # fmt: skip
        tab.resize(1280, 900)


@pytest.mark.parametrize("width", [420, 800, 1100, 1200, 1280])
def test_no_panel_has_controls_beyond_its_edge(tab: Tab, content: Any, width: int) -> None:
    """Not even with the longest unit; where three panels just fit beside each other, they did."""
    residual = [quantity["key"] for quantity in content["quantities"]].index("residual")
    tab.resize(width, 900)
    try:
        for count in (1, 3, 4):
            tab.run(f"explorer.arrange({count}).then(() => {{ explorer.panels[0].quantity ="
                    f" {residual}; return explorer.draw(); }}).then(() => 0)")  # fmt: skip
            assert (
                tab.run(
                    "(right => explorer.panels.flatMap(p => [...p.element.querySelectorAll('*')]"
                    ".filter(e => right(e) > right(p.element) + 0.5).map(e => e.className)))"
                    "(e => e.getBoundingClientRect().right)"
                )
                == []
            )
    finally:
        tab.resize(1280, 900)
