"""Public image sets: whole, free of truth, the same again; and the truth apart from them.

Guards: nobody can read the displacements out of the public folder; the truth at a point is that
of its element; folders that don't belong together are not taken for each other.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import synthetic_benchmark as made
from synthetic_benchmark import PIXEL, STRAIN

from modeharvest.cli.root import main
from modeharvest.imaging.photographs.files import read_image, read_mask
from modeharvest.runs.benchmark import make_benchmark
from modeharvest.util.errors import InputError
from modeharvest.validation.scoring.benchmark import BenchmarkTruth

PUBLIC = {
    "README.md", "benchmark.json", "mask.tif", "reference.tif", "reference_8bit.tif",
    "deformed_0500.tif", "deformed_0500_8bit.tif",
}  # fmt: skip


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return made.make(tmp_path_factory.mktemp("benchmark"))


@pytest.fixture
def copies(both: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Path]:
    for folder in both:
        shutil.copytree(folder, tmp_path / folder.name)
    for name in ("case.toml", "solution.h5"):
        shutil.copy(both[0].parent / name, tmp_path / name)
    return tmp_path / both[0].name, tmp_path / both[1].name


def again(public: Path) -> dict[str, object]:
    case, solution = (public.parent / name for name in ("case.toml", "solution.h5"))
    return make_benchmark(case, public, solution=solution)


def test_the_public_folder_holds_images_and_no_truth(both: tuple[Path, Path]) -> None:
    public, truth = both
    assert {path.name for path in public.iterdir()} == PUBLIC
    info = json.loads((public / "benchmark.json").read_text("utf-8"))
    text = (public / "README.md").read_text("utf-8") + json.dumps(info)
    hidden = json.loads((truth / "benchmark.json").read_text("utf-8"))
    for secret in ("moduli", "ogden", "seed", "imperfection", hidden["key"],
                   hidden["solution_sha256"]):  # fmt: skip
        assert secret not in text
    with h5py.File(truth / "solution.h5") as file:
        number = np.float64(file["snapshots/0000/displacement"][7, 0])
    for path in public.iterdir():
        assert number.tobytes() not in path.read_bytes()
    assert not {"experiment", "specimen", "spec", "solution", "key"} & set(info)


def test_the_images_are_whole_and_named_by_their_digests(both: tuple[Path, Path]) -> None:
    public, truth = both
    info = json.loads((public / "benchmark.json").read_text("utf-8"))
    assert set(info["files"]) == PUBLIC - {"README.md", "benchmark.json"}
    for name, entry in info["files"].items():
        assert hashlib.sha256((public / name).read_bytes()).hexdigest() == entry["sha256"]
    assert info["id"] == BenchmarkTruth.read(truth).id
    assert f"Benchmark {info['id']}" in (public / "README.md").read_text("utf-8")
    assert "CC-BY 4.0" in (public / "README.md").read_text("utf-8")
    shape = (info["rows"], info["cols"])
    assert read_image(public / info["deformed"][0]["image"]).shape == shape
    mask = read_mask(public / info["reference"]["mask"])
    assert np.array_equal(mask, BenchmarkTruth.read(truth).mask)


def test_the_command_says_what_is_where(
    copies: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    public, truth = copies
    case, solution = tmp_path / "case.toml", tmp_path / "solution.h5"
    arguments = ["benchmark", "make", case, "--out", public, "--solution", solution]
    monkeypatch.setattr(sys, "argv", ["modeharvest", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    message = capsys.readouterr().out
    assert f"benchmark {BenchmarkTruth.read(truth).id}: 1 deformed images in {public}" in message
    assert f"truth, not to be given away: {truth}" in message


def test_making_it_again_changes_nothing(copies: tuple[Path, Path]) -> None:
    public, _ = copies
    before = {path.name: path.stat().st_mtime_ns for path in public.iterdir()}
    again(public)
    assert {path.name: path.stat().st_mtime_ns for path in public.iterdir()} == before


@pytest.mark.parametrize("name", ["deformed_0500.tif", "benchmark.json", "README.md"])
def test_what_is_damaged_is_made_again(copies: tuple[Path, Path], name: str) -> None:
    public, truth = copies
    whole = (public / name).read_bytes()
    if name == "README.md":
        (public / name).unlink()
    else:
        (public / name).write_bytes(whole[: len(whole) // 2])
    again(public)
    assert (public / name).read_bytes() == whole
    assert BenchmarkTruth.read(truth).id in whole.decode("latin-1") or name.endswith(".tif")


def test_truth_in_public_is_refused(both: tuple[Path, Path], tmp_path: Path) -> None:
    case, solution = (both[0].parent / name for name in ("case.toml", "solution.h5"))
    for truth in (tmp_path / "set", tmp_path / "set" / "inside"):
        with pytest.raises(InputError, match="expected the truth apart"):
            make_benchmark(case, tmp_path / "set", truth, solution)
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "truth_0500.h5").touch()
    with pytest.raises(InputError, match=r"without truth, got truth_0500\.h5"):
        make_benchmark(case, tmp_path / "used", None, solution)


def test_distorted_images_are_refused(both: tuple[Path, Path], tmp_path: Path) -> None:
    case, solution = tmp_path / "lens.toml", both[0].parent / "solution.h5"
    case.write_text(
        made.CASE + '[imaging.distortion]\nkind = "camera"\n'
        "fx = 400.0\nfy = 400.0\ncx = 50.0\ncy = 70.0\nk1 = 0.01\n"
    )
    for distorted in (case, "paper-real-twin"):
        with pytest.raises(InputError, match="expected images without a lens"):
            make_benchmark(distorted, tmp_path / "set", None, solution)


def test_other_folders_are_not_taken_for_the_truth(copies: tuple[Path, Path]) -> None:
    public, truth = copies
    with pytest.raises(InputError, match=r"public folder.* without truth"):
        BenchmarkTruth.read(public)
    with pytest.raises(InputError, match=r"images/benchmark\.json, found no such file"):
        BenchmarkTruth.read(truth / "images")
    made.solution(made.affine).write(truth / "solution.h5")
    with pytest.raises(InputError, match="the solution that benchmark"):
        BenchmarkTruth.read(truth)


def test_the_truth_of_an_affine_field_is_exact_anywhere(both: tuple[Path, Path]) -> None:
    """Between pixels, too; every isoparametric element holds it."""
    truth = BenchmarkTruth.read(both[1])
    vars(truth)["solution"] = made.solution(made.affine)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.9, 1.9, 500), rng.uniform(-2.85, 2.85, 500)
    u = truth.displacement(STRAIN, x, y)
    known = np.isfinite(u).all(axis=1)
    hole = np.hypot(np.mod(x, 1.9) - 0.95, np.mod(y + 0.95, 1.9) - 0.95)
    assert not known[hole < 0.74].any()  # the boundary of a hole is a parabola per element
    assert known[hole > 0.76].all()
    # Local coordinates are known to about 1e-12 of an element.
    np.testing.assert_allclose(u[known], made.affine(x, y)[known], atol=1e-11)


def test_the_truth_of_a_smooth_field_converges(both: tuple[Path, Path]) -> None:
    truth = BenchmarkTruth.read(both[1])
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1.9, 1.9, 400), rng.uniform(-2.85, 2.85, 400)
    worst = []
    for divisions in (8, 16):
        vars(truth)["solution"] = made.solution(divisions=divisions)
        u = truth.displacement(STRAIN, x, y)
        worst.append(np.nanmax(np.abs(u - made.wavy(x, y))))
    # Third order: 8 times smaller; 5 leaves room for where the points happen to lie.
    assert worst[1] < worst[0] / 5
    assert worst[0] < 0.1 * PIXEL


def test_positions_off_the_material_have_no_truth(both: tuple[Path, Path]) -> None:
    truth = BenchmarkTruth.read(both[1])
    u = truth.displacement(STRAIN, [np.nan, 0.95, 50.0, 0.0], [0.0, 0.0, 0.0, 0.95])
    assert np.isfinite(u).all(axis=1).tolist() == [False, False, False, True]
    with pytest.raises(InputError, match=r"it has 0\.05"):
        truth.displacement(0.1, [0.0], [0.0])
