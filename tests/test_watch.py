"""A test that is watched: photographs measured as they come, buckling predicted before it does."""

from __future__ import annotations

import json
import os
import re
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
from synthetic_photographs import Displacement, Photographed, lattice_points, of
from test_cli import called

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import square_family
from modeharvest.imaging.grid import PixelGrid
from modeharvest.report.figures.sequence import watch_text
from modeharvest.runs.photographs.watch import WatchedTest, arriving, watch
from modeharvest.util.errors import InputError
from modeharvest.validation.growth import Prediction, fastest_growth, follow_growth, predict

PITCH, PIXEL = 1.9, 0.035
CRITICAL = 0.06
CELLULAR = Box.centred(4 * PITCH, 5 * PITCH)
DOMAIN = Box.centred(4 * PITCH + 1.6, 5 * PITCH + 1.6)
HOLES = lattice_points(PITCH * np.eye(2), CELLULAR, (PITCH / 2, 0.0))
STRAINS = CRITICAL * np.linspace(0.1, 0.7, 7)


# -- the prediction ----------------------------------------------------------------------


def grown(load: np.ndarray, linear: float = 3.0, imperfection: float = 5.0) -> np.ndarray:
    return linear * load + imperfection * load / (0.1 - load)


def predicted(
    load: np.ndarray, amplitude: np.ndarray, sd: np.ndarray, model_sd: float = 0.0
) -> Prediction | None:
    return predict(np.array([load, amplitude, sd, sd + model_sd]))


def test_growth_without_noise_points_to_the_critical_load() -> None:
    load = np.linspace(0.005, 0.06, 12)
    for linear, imperfection in ((0.0, 5.0), (40.0, 5.0), (-20.0, -1.0)):
        found = predicted(load, grown(load, linear, imperfection), np.full(12, 1e-6))
        assert found is not None
        assert found.critical == pytest.approx(0.1, rel=2e-3)  # the grid of what is tried
        assert found.imperfection == pytest.approx(imperfection, rel=0.02)
        assert found.low < 0.1 < found.high
        assert (found.largest, found.count) == (0.06, 12)


def test_intervals_hold_over_seeds() -> None:
    """95 %, and a little more, as the method's own error is in them and not in the data."""
    load, sd = np.linspace(0.004, 0.07, 20), np.full(20, 0.05)
    covered = []
    for seed in range(200):
        noise = sd * np.random.default_rng(seed).normal(size=20)
        found = predicted(load, grown(load) + noise, sd)
        assert found is not None
        covered.append(found.low <= 0.1 <= found.high)
    assert 0.93 <= np.mean(covered) <= 1.0


def test_model_error_grows_with_the_load_and_is_no_noise() -> None:
    """A linear part as large as it says leaves the prediction; as noise it would blur it."""
    load, random = np.linspace(0.004, 0.07, 20), np.random.default_rng(5)
    noise, model = 0.02, 2.0
    amplitude = grown(load, -model / load[-1]) + noise * random.normal(size=20)
    sd = np.full(20, noise)
    apart, as_noise, unknown = (
        predicted(load, amplitude, *how) for how in ((sd, model), (sd + model,), (sd,))
    )
    assert apart is not None
    assert as_noise is not None
    assert unknown is not None
    assert apart.low < 0.1 < apart.high
    assert apart.high - apart.low < 0.5 * (as_noise.high - as_noise.low)
    assert abs(apart.critical - 0.1) < abs(unknown.critical - 0.1)


def test_noise_that_is_larger_than_it_says_widens_the_interval() -> None:
    load, random = np.linspace(0.004, 0.07, 20), np.random.default_rng(3)
    amplitude = grown(load) + 0.1 * random.normal(size=20)
    modest, honest = (predicted(load, amplitude, np.full(20, sd)) for sd in (1e-4, 0.1))
    assert modest is not None
    assert honest is not None
    assert modest.high - modest.low > 0.7 * (honest.high - honest.low)


def test_what_does_not_grow_predicts_nothing() -> None:
    load = np.linspace(0.01, 0.06, 12)
    noise = np.random.default_rng(1).normal(size=12)
    found = predicted(load, noise, np.ones(12))
    assert found is None or not found.is_useful
    found = predicted(load, 3.0 * load, np.full(12, 1e-3))  # along a straight line
    assert found is None or not found.is_useful
    assert predicted(load[:4], grown(load[:4]), np.ones(4)) is None


def test_a_photograph_that_determines_no_amplitude_does_not_count() -> None:
    load, sd = np.linspace(0.005, 0.06, 12), np.full(12, 1e-6)
    sd[[3, 11]] = np.inf
    found = predicted(load, grown(load), sd)
    assert found == predicted(*(part[np.isfinite(sd)] for part in (load, grown(load), sd)))
    assert found is not None
    assert found.count == 10


def test_a_prediction_stays_once_buckling_is_near() -> None:
    load = np.linspace(0.005, 0.13, 26)
    amplitude = np.where(load < 0.097, grown(np.minimum(load, 0.097)), 200.0)
    found = follow_growth(np.array([load, amplitude, 0.0 * load + 0.01, 0.0 * load + 0.01]))
    assert found[3] is None
    assert found[-1] == found[20]
    assert found[-1] is not None
    assert found[-1].critical == pytest.approx(0.1, rel=0.01)
    assert found[-1].largest < 0.1


def pitchfork(load: np.ndarray, imperfection: float) -> np.ndarray:
    """Amplitudes a > 0 of an imperfect pitchfork, a^3 = (p / 0.1 - 1) a + imperfection p / 0.1."""
    roots = [np.roots([1.0, 0.0, 1.0 - p / 0.1, -imperfection * p / 0.1]) for p in load]
    return np.array([r[abs(r.imag) < 1e-9].real.max() for r in roots])


@pytest.mark.parametrize("imperfection", [0.001, 0.005, 0.02])
def test_a_pattern_that_has_grown_more_slowly_has_buckled(imperfection: float) -> None:
    """Predictions followed the slower growth away from the critical load, up to twice that."""
    load, sd = np.linspace(0.005, 0.15, 30), np.full(30, 0.002)
    columns = np.array([load, pitchfork(load, imperfection), sd, sd])
    assert all(fastest_growth(columns[:, :n]) is None for n in range(1, 20))
    fastest = fastest_growth(columns)
    assert fastest is not None
    assert fastest[0] == pytest.approx(0.1, abs=0.0051)
    assert fastest_growth(columns[:, [*range(30), *range(20, 0, -1)]]) == fastest  # unloaded
    last = follow_growth(columns)[-1]
    assert last is None or (last.largest < 0.1 and last.critical < 0.12)


def test_growth_before_buckling_is_not_taken_for_its_end() -> None:
    load, random = np.linspace(0.004, 0.09, 40), np.random.default_rng(4)
    for mean in (grown(load), grown(load, -40.0), 300.0 * load, 300.0 * load - 1500.0 * load**2):
        for sd in (0.02, 0.5):
            amplitude = mean + sd * random.normal(size=40)
            columns = np.array([load, amplitude, *np.full((2, 40), sd)])
            assert all(fastest_growth(columns[:, :n]) is None for n in range(1, 41))


# -- watching ----------------------------------------------------------------------------


def photographed(seed: int = 2) -> Photographed:
    return Photographed(PixelGrid.centred(360, 300, PIXEL), DOMAIN, HOLES, 1.4, seed)


def truth(strain: float) -> Displacement:
    """An imperfect pattern on its way to buckling, of holes that turn."""
    family = square_family("junction").moved((0.0, PITCH / 2))
    ansatz = Ansatz.on(DOMAIN, [(family, CELLULAR)], PITCH)
    return of(ansatz, ansatz.initial_guess(strain, 0.5 * strain / (CRITICAL - strain)))


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven states up to 70 % of the critical strain, and what is no photograph of them."""
    folder = tmp_path_factory.mktemp("test")
    shots = folder / "shots"
    shots.mkdir()
    shown = photographed()
    tifffile.imwrite(folder / "reference.tif", shown.image())
    for k, strain in enumerate(STRAINS):
        light = 0.9 + 0.02 * k  # which drifts
        levels = light * shown.image(truth(strain), exposure=k + 1)
        tifffile.imwrite(shots / f"frame_{k + 1}.tif", levels.astype(np.uint8))
    tifffile.imwrite(shots / "frame_10.tif", photographed(seed=9).image(truth(0.03)))
    (shots / "frame_11.tif").write_bytes(b"II*\0 and no more")
    old = time.time() - 60.0
    for path in shots.iterdir():
        os.utime(path, (old, old))
    (folder / "experiment.toml").write_text(
        '[images]\nreference = "reference.tif"\ndeformed = ["shots"]\n'
        f"[scale]\npixel_size = {PIXEL}\n[specimen]\ncell_size = {PITCH}\n"
    )
    return folder / "experiment.toml"


@pytest.fixture(scope="module")
def watched(experiment: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, WatchedTest]:
    out = tmp_path_factory.mktemp("out")
    return out, watch(experiment, out, until_still=0.1)


def test_photographs_are_measured_in_their_order(watched: tuple[Path, WatchedTest]) -> None:
    _, test = watched
    assert [row["name"] for row in test.rows] == [f"frame_{k}.tif" for k in range(1, 8)]
    assert [row["strain"] for row in test.rows] == pytest.approx(list(STRAINS), abs=5e-4)
    assert test.conclusion == "No photograph came for 0.1 s."


def test_buckling_is_predicted_from_seven_tenths(watched: tuple[Path, WatchedTest]) -> None:
    found = watched[1].predictions[-1]
    assert found is not None
    assert found.critical == pytest.approx(CRITICAL, rel=0.03)
    assert found.low < CRITICAL < found.high
    assert found.largest == pytest.approx(0.7 * CRITICAL, rel=0.01)


def test_others_are_skipped_with_a_reason(watched: tuple[Path, WatchedTest]) -> None:
    _, test = watched
    reasons = {row["name"]: row["reason"] for row in test.skipped}
    assert set(reasons) == {"frame_10.tif", "frame_11.tif"}
    assert "surface" in reasons["frame_10.tif"]
    assert "frame_11.tif" in reasons["frame_11.tif"]


def test_the_page_holds_all_and_reloads_until_the_end(
    watched: tuple[Path, WatchedTest], experiment: Path, tmp_path: Path
) -> None:
    out, test = watched
    page = (out / "watch.html").read_text("utf-8")
    assert page.count("<svg") == 3
    assert "Buckling is predicted at" in page
    assert "http-equiv" not in page
    assert "src=" not in page
    # A curve of a colour that the page doesn't know isn't there.
    assert {name for name in re.findall(r"var\((--\w+)\)", page) if f"{name}:" not in page} == set()
    assert "var(--muted)" in page
    assert "font-size: 10px" not in page  # matplotlib's own style
    from modeharvest.report.figures.sequence import write_watch_page

    write_watch_page(tmp_path / "watch.html", "<b>", WatchedTest(test.rows[:1]), None)
    page = (tmp_path / "watch.html").read_text("utf-8")
    assert "1 photograph, the last" in page
    assert 'http-equiv="refresh"' in page
    assert "&lt;b&gt;" in page


def test_words_before_at_and_after_buckling(watched: tuple[Path, WatchedTest]) -> None:
    rows = watched[1].rows
    assert "This strain is reached" not in watch_text(WatchedTest(rows))
    assert "This strain is reached." in watch_text(
        WatchedTest([*rows, rows[-1] | {"strain": 1.1 * CRITICAL, "amplitude_mm": 4.0}])
    )
    strains = CRITICAL * np.linspace(0.05, 1.5, 30)
    shown = zip(strains, pitchfork(0.1 * strains / CRITICAL, 0.005), strict=True)
    after = [rows[0] | {"strain": p, "amplitude_mm": a, "sd_mm": 2e-3} for p, a in shown]
    text = watch_text(WatchedTest(after))
    assert "The specimen has buckled: the pattern grew fastest from 6.00 to 6.30 %." in text
    assert "Buckling is predicted" not in text


def test_it_goes_on_where_it_stopped(watched: tuple[Path, WatchedTest], experiment: Path) -> None:
    out, test = watched
    seconds = [row["seconds"] for row in json.loads((out / "watch.json").read_text())["frames"]]
    again = watch(experiment, out, until_still=0.1)
    assert [row["seconds"] for row in again.rows] == seconds
    assert again.skipped == test.skipped


def test_what_a_version_with_other_columns_left_is_measured_again(
    watched: tuple[Path, WatchedTest],
    experiment: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def show(line: str) -> None:
        if not line.startswith("watching"):
            raise KeyboardInterrupt

    shutil.copytree(watched[0], tmp_path / "out")
    columns = ("strain", "amplitude_mm", "sd_mm", "sd_mm")
    monkeypatch.setattr("modeharvest.runs.photographs.watch._COLUMNS", columns)
    again = watch(experiment, tmp_path / "out", until_still=0.1, show=show)
    assert len(again.rows) == 1


def test_a_photograph_that_was_replaced_is_measured_again(
    watched: tuple[Path, WatchedTest], experiment: Path, tmp_path: Path
) -> None:
    """In its own place; while the test runs, or after a stop."""
    shots, out, old = tmp_path / "shots", tmp_path / "out", experiment.parent / "shots"
    shots.mkdir()
    for k in (1, 2, 3):
        shutil.copy2(old / f"frame_{k}.tif", shots)
    (shots / "frame_4.tif").write_bytes(b"II*\0 and no more")
    long_ago = time.time() - 60.0
    os.utime(shots / "frame_4.tif", (long_ago, long_ago))
    lines: list[str] = []

    def show(line: str) -> None:
        lines.append(line)
        if line.startswith("frame_4.tif: not used"):
            shutil.copy2(old / "frame_4.tif", shots)
            os.utime(shots / "frame_4.tif", (long_ago, long_ago))  # of another size
            shutil.copy2(old / "frame_5.tif", shots / "frame_2.tif")
            os.utime(shots / "frame_2.tif", (long_ago, long_ago))
            (shots / "frame_3.tif").unlink()  # its measurement stays

    test = watch(experiment, out, shots, until_still=0.4, show=show)
    assert [row["name"] for row in test.rows] == [f"frame_{k}.tif" for k in (1, 2, 3, 4)]
    strains = [row["strain"] for row in test.rows]
    assert strains == pytest.approx(list(STRAINS[[0, 4, 2, 3]]), abs=5e-4)
    assert test.skipped == []
    assert sum("frame_2.tif, changed: " in line for line in lines) == 1

    shutil.copy2(old / "frame_2.tif", shots)
    (shots / "frame_1.tif").rename(shots / "frame_0.tif")
    os.utime(shots / "frame_4.tif")  # touched, but the same
    lines.clear()
    again = watch(experiment, out, shots, until_still=0.4, show=lines.append)
    assert [row["name"] for row in again.rows] == [f"frame_{k}.tif" for k in (0, 2, 3, 4)]
    assert again.rows[1]["strain"] == pytest.approx(STRAINS[1], abs=5e-4)
    assert len(lines) == 2
    assert again.predictions == follow_growth(again.columns)


def test_the_last_photograph_is_on_the_page_while_nothing_comes(
    experiment: Path, tmp_path: Path
) -> None:
    """Though it was measured soon after the one before; also where the folder goes."""
    shots, out = tmp_path / "shots", tmp_path / "out"
    shots.mkdir()
    for k in (1, 2):
        shutil.copy2(experiment.parent / f"shots/frame_{k}.tif", shots)
    seen = []

    def look() -> None:
        time.sleep(1.0)
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline and len(seen) < 2:
            if (out / "watch.json").is_file():
                seen[:] = json.loads((out / "watch.json").read_text())["frames"]
            time.sleep(0.05)
        shutil.rmtree(shots)

    thread = threading.Thread(target=look)
    thread.start()
    watch(experiment, out, shots, until_still=5.0)
    thread.join()
    assert len(seen) == 2


def test_another_reference_ends_the_watch(experiment: Path, tmp_path: Path) -> None:
    for path in (experiment, experiment.parent / "reference.tif"):
        shutil.copy2(path, tmp_path)
    shots = tmp_path / "shots"
    shots.mkdir()
    for k in (1, 2):
        shutil.copy2(experiment.parent / f"shots/frame_{k}.tif", shots)

    def show(line: str) -> None:
        if line.startswith("frame_1"):
            os.utime(tmp_path / "reference.tif")

    with pytest.raises(InputError, match=r"got another in .*reference\.tif; start again"):
        watch(tmp_path / experiment.name, tmp_path / "out", until_still=0.2, show=show)
    assert (tmp_path / "out/watch.html").is_file()


def test_a_file_half_written_is_waited_for(tmp_path: Path) -> None:
    shots = tmp_path / "shots"
    shots.mkdir()
    tifffile.imwrite(tmp_path / "whole.tif", np.arange(64 * 64, dtype=np.uint8).reshape(64, 64))
    content = (tmp_path / "whole.tif").read_bytes()
    path = shots / "a.tif"

    def camera() -> None:
        with path.open("wb") as file:
            for part in np.array_split(np.frombuffer(content, np.uint8), 4):
                file.write(part.tobytes())
                file.flush()
                time.sleep(0.3)

    thread = threading.Thread(target=camera)
    thread.start()
    (found,) = arriving(shots, tmp_path / "whole.tif", WatchedTest(), 0.4)  # shorter than that
    assert found.read_bytes() == content
    thread.join()


def test_an_interruption_leaves_what_is_there(experiment: Path, tmp_path: Path) -> None:
    def show(line: str) -> None:
        if not line.startswith("watching"):
            raise KeyboardInterrupt

    test = watch(experiment, tmp_path, show=show)
    assert test.conclusion == "Watching was interrupted."
    assert len(json.loads((tmp_path / "watch.json").read_text())["frames"]) == 1
    assert (tmp_path / "watch.html").is_file()


def test_bad_input_is_one_line(experiment: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a folder to watch"):
        watch(experiment, tmp_path, tmp_path / "nowhere")


def test_the_command(
    experiment: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shots = tmp_path / "few"
    shots.mkdir()
    (shots / "frame_1.tif").write_bytes((experiment.parent / "shots/frame_1.tif").read_bytes())
    still = "--until-still", "0.5", "--out", tmp_path / "out"
    assert called(monkeypatch, "harvest", experiment, *still) == 2
    assert "expected --watch FOLDER beside --until-still" in capsys.readouterr().err
    code = called(monkeypatch, "harvest", experiment, "--watch", shots, "--until-still", "0.5",
                  "--out", tmp_path / "out")  # fmt: skip
    printed = capsys.readouterr().out
    assert code == 0
    assert "frame_1.tif" in printed
    assert "No photograph came for 0.5 s." in printed
