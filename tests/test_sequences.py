"""Folders, videos and machines' logs: which photographs there are, when, and under what force."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter
from synthetic_photographs import Photographed, lattice_points, of

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import square_family
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.photographs.sequence import Video, natural, numbered, odd_numbers, times_of
from modeharvest.runs.measure import measure
from modeharvest.runs.photographs.machine_log import LogTable, read_log
from modeharvest.runs.photographs.pipeline import harvest
from modeharvest.runs.photographs.sequence import (
    ChosenFrames,
    FrameChoice,
    chosen_frames,
    named_files,
)
from modeharvest.util.errors import InputError, MissingDependencyError

SHAPE = (48, 64)


def grey(level: int) -> np.ndarray:
    image = np.full(SHAPE, level, np.uint8)
    image[:, ::8] = 255 - level
    return image


def folder_of(folder: Path, names: list[str]) -> Path:
    folder.mkdir()
    for k, name in enumerate(names):
        write_image(folder / f"{name}.tif", grey(10 + k))
    return folder


def film(path: Path, count: int, rate: float = 4.0) -> Path:
    """A video whose frames' grey levels tell their numbers."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    stream = ffmpeg.write_frames(
        str(path), SHAPE[::-1], pix_fmt_in="gray", fps=rate, macro_block_size=1,
        codec="libx264", output_params=["-crf", "1"], ffmpeg_log_level="error",
    )  # fmt: skip
    stream.send(None)
    for k in range(count):
        stream.send(np.ascontiguousarray(np.full(SHAPE, 10 * k + 20, np.uint8)))
    stream.close()
    return path


def chosen(base: Path, *names: str, log: LogTable | None = None, **choice: object) -> ChosenFrames:
    how = FrameChoice(**choice)  # type: ignore[arg-type]
    if not (base / "ref.tif").exists():
        write_image(base / "ref.tif", grey(10))
    return chosen_frames(base, "ref.tif", names, how, log or LogTable(), base / "out")


def test_frame_2_comes_before_frame_10(tmp_path: Path) -> None:
    folder_of(tmp_path / "shots", ["frame_10", "frame_2", "frame_1"])
    (tmp_path / "shots/notes.txt").write_text("no photograph")
    (tmp_path / "shots/.hidden.tif").write_text("none either")
    expected = ["frame_1", "frame_2", "frame_10"]
    for name in ("shots", "shots/*.tif"):
        assert [path.stem for path in chosen(tmp_path, name).deformed] == expected
    assert sorted(["b10", "B9", "a"], key=natural) == ["a", "B9", "b10"]


def test_folders_may_have_brackets_in_their_names(tmp_path: Path) -> None:
    base = tmp_path / "Probe [3]"
    base.mkdir()
    folder_of(base / "shots [a]", ["f1", "f2"])
    for name in ("shots [a]", "shots [a]/f1.tif", "shots*/f[1-2].tif"):
        assert chosen(base, name).deformed[0] == base / "shots [a]/f1.tif"
    assert len(named_files(Path(), [str(base / "shots [a]/f1.tif")])) == 1


def test_the_reference_is_not_among_the_deformed(tmp_path: Path) -> None:
    folder_of(tmp_path / "shots", ["f0", "f1", "f2"])
    how, log, out = FrameChoice(), LogTable(), tmp_path / "out"
    found = chosen_frames(tmp_path, "shots/f0.tif", ["shots"], how, log, out)
    assert [path.stem for path in found.deformed] == ["f1", "f2"]
    folder_of(tmp_path / "alone", ["f0"])
    with pytest.raises(InputError, match="besides the reference, got none"):
        chosen_frames(tmp_path, "alone/f0.tif", ["alone"], how, log, out)


def test_the_log_begins_with_the_reference_if_that_is_the_first(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("Time [s];Force [N]\n0;0\n90;9\n")
    folder_of(tmp_path / "shots", [f"cam_2026-03-01_10-00-{s}" for s in ("00", "20", "50")])
    reference, log = "shots/cam_2026-03-01_10-00-00.tif", LogTable("log.csv")
    how = FrameChoice(), log, tmp_path / "out"
    found = chosen_frames(tmp_path, reference, ["shots"], *how)
    assert [known["time_s"] for known in found.recorded.values()] == pytest.approx([20.0, 50.0])
    assert [known["force_N"] for known in found.recorded.values()] == pytest.approx([2.0, 5.0])


def test_an_empty_folder_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "shots").mkdir()
    with pytest.raises(InputError, match="found none among its 0 entries"):
        chosen(tmp_path, "shots")


def test_a_name_of_no_file_is_one_line_before_any_frame_is_written(tmp_path: Path) -> None:
    for name in ("ref", "f1"):
        write_image(tmp_path / f"{name}.tif", grey(10))
    for names in (["f1.tif", "nothing.tif"], ["shots"]):
        with pytest.raises(InputError, match=f"{names[-1]}, found no such file; check its name"):
            chosen(tmp_path, *names)
    video = film(tmp_path / "test.mp4", 3)
    with pytest.raises(InputError, match="found no such file"):
        chosen(tmp_path, video.name, "nothing.tif")
    with pytest.raises(InputError, match="expected a file at no"):
        measure(video, [video], tmp_path / "out", mask=Path("no.png"))
    assert not (tmp_path / "out").exists()


def test_missing_and_repeated_numbers_are_reported() -> None:
    def text(*names: str) -> str:
        return " ".join(odd_numbers(numbered([Path(f"{name}.tif") for name in names])))

    assert text("f1", "f2", "f3") == ""
    assert "missing: 3, 4 of 6" in text("f1", "f2", "f5", "f6")
    assert "numbers 2 are there twice" in text("f1", "f2", "f02", "f3")
    assert text("f100", "f200", "f300") == ""  # that is how they are numbered
    assert text("strain_0310", "strain_0455", "strain_0500") == ""


def test_two_photographs_of_one_name_are_one(tmp_path: Path) -> None:
    folder_of(tmp_path / "shots", ["f1", "f2"])
    Image.fromarray(grey(3)).save(tmp_path / "shots/f1.png")
    found = chosen(tmp_path, "shots")
    assert len(found.deformed) == 2
    assert [reason for _, reason in found.skipped] == ["another photograph has this name"]
    folder_of(tmp_path / "later", ["f1"])  # as a shell names them
    found = chosen(tmp_path, "shots/f1.tif", "later/f1.tif")
    assert len(found.deformed) == 1
    assert [reason for _, reason in found.skipped] == ["another photograph has this name"]


def test_frames_are_chosen(tmp_path: Path) -> None:
    folder_of(tmp_path / "shots", [f"f{k}" for k in range(10)])

    def numbers(**choice: object) -> list[int]:
        return [int(path.stem[1:]) for path in chosen(tmp_path, "shots", **choice).deformed]

    assert numbers(every=4) == [0, 4, 8]
    assert numbers(frames=(7, 2)) == [2, 7]
    assert numbers(per_second=2.0, between_s=(1.0, 2.1)) == [2, 3, 4]
    with pytest.raises(InputError, match="got 12 that none has; there are 0 to 9"):
        numbers(frames=(3, 12))
    with pytest.raises(InputError, match="got none of 10"):
        numbers(per_second=2.0, between_s=(90.0, 99.0))
    with pytest.raises(InputError, match="expected a log with a crosshead and a length"):
        numbers(strains=(0.1,))


def test_times_are_of_names_exif_or_files(tmp_path: Path) -> None:
    names = [tmp_path / f"cam_2026-03-01_10-00-{s}.tif" for s in ("00", "07", "30-5")]
    times, source = times_of(names)
    assert source == "names"
    assert times is not None
    assert np.diff(times) == pytest.approx([7.0, 23.5])
    assert times_of([Path("t=0.5s.tif"), Path("t=12.0s.tif")])[0] == [0.5, 12.0]
    plain = [tmp_path / "a.jpg", tmp_path / "b.jpg"]
    for k, path in enumerate(plain):
        exif = Image.Exif()
        exif[306] = f"2026:03:01 10:00:0{k}"
        Image.fromarray(grey(9)).save(path, exif=exif)
        os.utime(path, (5000.0 + 3 * k, 5000.0 + 3 * k))
    times, source = times_of(plain)
    assert (np.diff(times or []), source) == (1.0, "Exif")
    for path in plain:
        Image.fromarray(grey(9)).save(path)
    for k, path in enumerate(plain):
        os.utime(path, (5000.0 + 3 * k, 5000.0 + 3 * k))
    times, source = times_of(plain)
    assert (np.diff(times or []), source) == (3.0, "times of change")


# -- videos ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["mp4", "avi", "mov"])
def test_frames_of_a_video(tmp_path: Path, kind: str) -> None:
    film(tmp_path / f"test.{kind}", 12)
    video = Video.of(tmp_path / f"test.{kind}")
    assert (video.count, video.rate) == (12, pytest.approx(4.0, rel=0.1))
    found = chosen_frames(
        tmp_path, f"test.{kind}", [f"test.{kind}"], FrameChoice(every=5), LogTable(),
        tmp_path / "out",
    )  # fmt: skip
    assert found.reference.stem == "test_000000"
    assert [path.stem for path in found.deformed] == ["test_000001", "test_000006", "test_000011"]
    levels = [np.asarray(Image.open(path)).mean() for path in (found.reference, *found.deformed)]
    assert levels == pytest.approx([20, 30, 80, 130], abs=2.0)
    assert [known["time_s"] for known in found.recorded.values()] == (
        pytest.approx([0.25, 1.5, 2.75])  # the reference is the first
    )
    stamps = [path.stat().st_mtime_ns for path in found.deformed]
    chosen_frames(tmp_path, f"test.{kind}", [f"test.{kind}"], FrameChoice(every=5), LogTable(),
                  tmp_path / "out")  # fmt: skip
    assert [path.stat().st_mtime_ns for path in found.deformed] == stamps  # finished before


@pytest.mark.parametrize("kind", ["mp4", "mkv"])
def test_a_video_at_unequal_times_has_every_frame_once(tmp_path: Path, kind: str) -> None:
    """As telephones film: to keep a rate, frames were repeated, and as many at the end left out."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    late = "setpts=(N+4*gte(N\\,2))/(4*TB)"  # a second passes after the second frame
    subprocess.run(
        [ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", film(tmp_path / "even.mp4", 6), "-vf", late,
         "-crf", "1", tmp_path / f"test.{kind}"], check=True,
    )  # fmt: skip
    path = f"test.{kind}"
    found = chosen_frames(tmp_path, path, [path], FrameChoice(), LogTable(), tmp_path / "out")
    levels = [np.asarray(Image.open(path)).mean() for path in (found.reference, *found.deformed)]
    assert levels == pytest.approx([20, 30, 40, 50, 60, 70], abs=2.0)
    times = [known["time_s"] for known in found.recorded.values()]
    assert times == pytest.approx([0.25, 1.5, 1.75, 2.0, 2.25], abs=0.01)
    assert any("at unequal times" in note for note in found.notes)


def test_a_video_compressed_to_mush_is_one_line(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    noise = np.random.default_rng(0).normal(128.0, 20.0, (8, 64, 96))
    for quality in (1, 28):
        stream = ffmpeg.write_frames(
            str(tmp_path / f"crf{quality}.mp4"), (96, 64), pix_fmt_in="gray", codec="libx264",
            output_params=["-crf", f"{quality}"], macro_block_size=1, ffmpeg_log_level="error",
        )  # fmt: skip
        stream.send(None)
        for image in gaussian_filter(noise, (0, 2, 2)):  # speckle of 7 px
            stream.send(np.clip(128 + 10 * (image - 128), 0, 255).astype(np.uint8))
        stream.close()
    assert len(Video.of(tmp_path / "crf1.mp4").about()) == 1
    assert re.match(
        r"crf28\.mp4 is compressed to 0\.\d", Video.of(tmp_path / "crf28.mp4").about()[1]
    )


def test_a_reference_inside_a_video(tmp_path: Path) -> None:
    film(tmp_path / "test.mp4", 6)
    found = chosen_frames(
        tmp_path, "test.mp4#3", ["test.mp4"], FrameChoice(), LogTable(), tmp_path / "out"
    )
    assert found.reference.stem == "test_000003"
    assert [path.stem[-1] for path in found.deformed] == list("01245")


def test_videos_that_cannot_be_read_are_one_line(tmp_path: Path) -> None:
    whole = film(tmp_path / "test.mp4", 12).read_bytes()
    (tmp_path / "none.mp4").write_bytes(b"no video at all" * 100)
    with pytest.raises(InputError, match="ffmpeg says"):
        Video.of(tmp_path / "none.mp4")
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.mp4"):
        Video.of(tmp_path / "cut.mp4")
    assert [number for number, _ in Video.of(tmp_path / "test.mp4").levels([7, 40])] == [7]


def test_without_the_library_one_line_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "test.mp4").write_bytes(b"whatever")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingDependencyError, match="pip install imageio-ffmpeg"):
        chosen(tmp_path, "test.mp4")


# -- logs --------------------------------------------------------------------------------

LOGS = {
    "german": (
        "Prüfung;Nr. 7\nZeit;Standardweg;Standardkraft\ns;mm;N\n"
        "0,0;0,000;0,0\n1,0;0,100;2,5\n2,0;0,200;5,0\n3,0;0,300;1.007,5\n"
    ),
    "english": (
        "Operator,Smith\nTime (s),Crosshead (mm),Load (kN)\n"
        "0.0,0.000,0.0\n1.0,0.100,0.0025\n2.0,0.200,0.005\n3.0,0.300,1.0075\n"
    ),
    "tabs": (
        "Elapsed Time [ms]\tForce [N]\tPosition [µm]\n"
        "0\t0.0\t0\n1000\t2.5\t100\n2000\t5.0\t200\n3000\t1007.5\t300\n"
    ),
    "blanks": "t F x\n0.0 0.0 0.0\n1.0 2.5 0.1\n2.0 5.0 0.2\n3.0 1007.5 0.3\n",
    "clock": (
        "Date;Time;Force / N;Crosshead / mm\n01.03.2026;10:00:00,0;0;0\n"
        "01.03.2026;10:00:01,0;2,5;0,1\n01.03.2026;10:00:02,0;5;0,2\n01.03.2026;10:00:03,0;1007,5;0,3\n"
    ),
}


@pytest.mark.parametrize("name", LOGS)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_logs_of_many_dialects(tmp_path: Path, name: str, encoding: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(LOGS[name], encoding)
    log = read_log(path, LogTable("log.csv"))
    assert log.time - log.time[0] == pytest.approx([0, 1, 2, 3])
    assert log.force == pytest.approx([0, 2.5, 5, 1007.5])
    assert log.crosshead == pytest.approx([0, 0.1, 0.2, 0.3])
    assert log.is_dated == (name == "clock")


def test_columns_are_named_where_they_are_not_known(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("uptime,P,unrelated\n0,1,9\n1,2,9\n2,3,9\n")
    with pytest.raises(InputError, match=r"expected a column of time, got uptime, P, unrelated"):
        read_log(path, LogTable("log.csv"))
    with pytest.raises(InputError, match="expected a column of force or crosshead"):
        read_log(path, LogTable("log.csv", time="uptime"))
    with pytest.raises(InputError, match=r"expected the column 'Q' of log\.force"):
        read_log(path, LogTable("log.csv", time="uptime", force="Q"))
    assert read_log(path, LogTable("log.csv", time="uptime", force="P")).force is not None
    path.write_text("nothing here\n")
    with pytest.raises(InputError, match="rows of two numbers"):
        read_log(path, LogTable("log.csv"))


@pytest.mark.parametrize(
    "text",
    [
        "Zeit [s];Kraft [N]\n0,5;1.000\n1,5;2.000\n",
        "Time [s];Force [N]\n0.5;1,000\n1.5;2,000\n",
        '"Time","Force"\n"(s)","(N)"\n"0.5","1,000"\n"1.5","2,000"\n',
        '"Zeit","Kraft"\n"(s)","(N)"\n"0,5","1.000,0"\n"1,5","2.000,0"\n',
    ],
)
def test_thousands_are_no_fractions(tmp_path: Path, text: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    log = read_log(tmp_path / "log.csv", LogTable("log.csv"))
    assert (list(log.time), list(log.force)) == ([0.5, 1.5], [1000.0, 2000.0])


def stamped(base: Path, hour: int = 10) -> Path:
    return folder_of(base / "shots", [f"c_20260301_{hour}000{s}" for s in range(4)])


def test_forces_are_joined_by_time(tmp_path: Path) -> None:
    stamped(tmp_path)
    (tmp_path / "log.csv").write_text(LOGS["clock"])
    table = LogTable("log.csv", length=10.0)
    found = chosen(tmp_path, "shots", log=table)
    forces = [known["force_N"] for known in found.recorded.values()]
    assert forces == pytest.approx([0, 2.5, 5, 1007.5])
    assert not any("time zone" in note for note in found.notes)
    found = chosen(tmp_path, "shots", log=table, strains=(0.01, 0.03))
    assert [path.stem[-1] for path in found.deformed] == ["1", "3"]


def test_another_time_zone_is_found_and_reported(tmp_path: Path) -> None:
    stamped(tmp_path, hour=12)
    (tmp_path / "log.csv").write_text(LOGS["clock"])
    found = chosen(tmp_path, "shots", log=LogTable("log.csv"))
    forces = [known["force_N"] for known in found.recorded.values()]
    assert forces == pytest.approx([0, 2.5, 5, 1007.5])
    assert any("2 h behind" in note and "time zone" in note for note in found.notes)


@pytest.mark.parametrize(
    ("head", "row"),
    [("Time", "2026-03-01T10:{:02}:00"), ("Uhrzeit", "10:{:02}:00"),
     ("Time", "03/01/2026 10:{:02}:00 AM"), ("Time", "10:{:02}:00 AM")],
)  # fmt: skip
def test_photographs_from_before_the_log_are_in_its_time_zone(
    tmp_path: Path, head: str, row: str
) -> None:
    """A quarter of an hour later all of them would be within the log."""
    rows = [f"{row.format(minute)};{minute}" for minute in range(60)]
    (tmp_path / "log.csv").write_text("\n".join([f"{head};Force [N]", *rows]))
    folder_of(tmp_path / "shots", [f"c_20260301_{t}00" for t in ("0955", "1005", "1010", "1030")])
    found = chosen(tmp_path, "shots", log=LogTable("log.csv"))
    assert [known["force_N"] for known in found.recorded.values()] == [None, 5.0, 10.0, 30.0]
    assert not any("time zone" in note for note in found.notes)


def test_a_log_without_dates_goes_on_after_midnight(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("Time;Force [N]\n23:59:50;1\n00:00:00;2\n00:00:10;3\n")
    folder_of(tmp_path / "shots", ["c_20260301_235950", "c_20260302_000005"])
    found = chosen(tmp_path, "shots", log=LogTable("log.csv"))
    assert [known["force_N"] for known in found.recorded.values()] == [1.0, 2.5]


def test_an_offset_may_be_given_and_what_was_not_logged_has_no_force(tmp_path: Path) -> None:
    stamped(tmp_path)
    (tmp_path / "log.csv").write_text(LOGS["clock"])
    found = chosen(tmp_path, "shots", log=LogTable("log.csv", offset_s=4.0))
    forces = [known["force_N"] for known in found.recorded.values()]
    assert forces[0] == pytest.approx(1007.5)
    assert forces[-1] is None
    assert any("3 of 4 photographs were taken while nothing was logged" in n for n in found.notes)


def test_a_log_without_dates_begins_with_the_first_photograph(tmp_path: Path) -> None:
    stamped(tmp_path)
    (tmp_path / "log.csv").write_text(LOGS["english"])
    found = chosen(tmp_path, "shots", log=LogTable("log.csv"))
    assert [known["force_N"] for known in found.recorded.values()] == pytest.approx(
        [0, 2.5, 5, 1007.5]
    )
    assert any("taken to begin with the first photograph" in note for note in found.notes)


def test_a_video_is_harvested_with_its_log(
    tmp_path: Path, undrawn_pictures: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the files that a camera and a testing machine leave to force over strain."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    pitch, pixel = 1.9, 0.035
    cellular, domain = (Box.centred(4 * pitch + d, 5 * pitch + d) for d in (0.0, 1.6))
    holes = lattice_points(pitch * np.eye(2), cellular, (pitch / 2, 0.0))
    shown = Photographed(PixelGrid.centred(360, 300, pixel), domain, holes, 1.4)
    ansatz = Ansatz.on(domain, [(square_family(), cellular)], pitch)
    strains = (0.0, 0.01, 0.02, 0.03)
    stream = ffmpeg.write_frames(
        str(tmp_path / "test.avi"), (300, 360), pix_fmt_in="gray", pix_fmt_out="gray", fps=2.0,
        macro_block_size=1, codec="ffv1", ffmpeg_log_level="error",
    )  # fmt: skip
    stream.send(None)
    for k, strain in enumerate(strains):
        state = of(ansatz, ansatz.initial_guess(strain, 1e-9))
        stream.send(np.ascontiguousarray(shown.image(state, exposure=k)))
    stream.close()
    (tmp_path / "log.csv").write_text("Time [s];Force [kN]\n0;0\n10;0,1\n")
    (tmp_path / "experiment.toml").write_text(
        '[images]\nreference = "test.avi"\ndeformed = ["test.avi"]\nevery = 2\n'
        f'[log]\nfile = "log.csv"\n[scale]\npixel_size = {pixel}\n'
        f"[specimen]\ncell_size = {pitch}\n[correlation]\nv0_degree = 2\nv_degree = 1\n"
    )
    summary = harvest(tmp_path / "experiment.toml", tmp_path / "out")
    frames = summary["frames"]
    assert [frame["name"] for frame in frames] == ["test_000001", "test_000003"]
    assert [frame["strain"] for frame in frames] == pytest.approx([0.01, 0.03], abs=5e-4)
    assert [frame["time_s"] for frame in frames] == [0.5, 1.5]
    assert [frame["force_N"] for frame in frames] == pytest.approx([5.0, 15.0])
    assert summary["experiment"]["images"]["deformed"] == ["test.avi"]
    assert "timeline-force" in (tmp_path / "out/report.html").read_text("utf-8")
    # A second run does nothing anew, not even the decoding.
    monkeypatch.setattr(Video, "levels", None)
    assert harvest(tmp_path / "experiment.toml", tmp_path / "out") == summary
