"""Fields from files: the truth scores zero whatever its format, a known error scores that error.

Guards: every format, unit, axis and origin comes to the same; a file of another benchmark is not
taken; what was lost is counted. What a field may mean instead: test_scoring_conventions.py.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
import synthetic_benchmark as made
from numpy.typing import NDArray
from scipy.io import savemat
from synthetic_benchmark import PIXEL, STRAIN

from modeharvest.runs.benchmark import declarations
from modeharvest.util.errors import InputError
from modeharvest.validation.scoring.benchmark import BenchmarkTruth, Declared, read_measured
from modeharvest.validation.scoring.score import Score, regions, score

FloatArray = NDArray[np.float64]
ROUNDED_PX = 1e-6
"""Nine digits of tens of px are kept in the files written here."""
OTHER = "0123456789ab"


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> BenchmarkTruth:
    return BenchmarkTruth.read(made.make(tmp_path_factory.mktemp("benchmark"))[1])


def graded(truth: BenchmarkTruth, path: Path, declared: Declared | None = None) -> Score:
    field = read_measured(path, truth.grid, truth.id, declared)
    labels = regions(truth.mask, truth.grid, truth.specimen, edge_px=3)
    return score(field, truth.displacement(STRAIN, field.x, field.y), labels, truth.grid)


def in_px(truth: BenchmarkTruth, x: FloatArray, y: FloatArray, u: FloatArray) -> FloatArray:
    """(n, 4) column, row, u, v down [px]."""
    row, col = truth.grid.to_px(x, y)
    return np.column_stack([col, row, u[:, 0] / PIXEL, -u[:, 1] / PIXEL])


def write_csv(path: Path, table: FloatArray, header: str) -> Path:
    np.savetxt(path, table, "%.9g", ",", header=header, comments="")
    return path


def as_csv(truth: BenchmarkTruth, folder: Path, u: FloatArray | None = None) -> Path:
    """As the README asks for it."""
    x, y, true = made.points(truth)
    header = f"# benchmark: {truth.id}\nx [px],y down [px],u [px],v down [px]"
    return write_csv(folder / "code.csv", in_px(truth, x, y, true if u is None else u), header)


def test_the_truth_scores_zero_as_csv(truth: BenchmarkTruth, tmp_path: Path) -> None:
    score = graded(truth, as_csv(truth, tmp_path))
    assert score.everywhere.max_px < ROUNDED_PX
    assert score.everywhere.returned == 1.0
    assert score.covered > 0.99
    assert score.off_material == 0
    assert score.source == "code"


def binary(truth: BenchmarkTruth, folder: Path, suffix: str, benchmark: str) -> Path:
    x, y, u = made.points(truth)
    path = folder / f"code{suffix}"
    columns = dict(zip(("x", "y", "u", "v"), (x, y, *u.T), strict=True))
    if suffix == ".npz":
        np.savez(path, benchmark=np.array(benchmark), **columns)
    elif suffix == ".mat":
        savemat(path, {"benchmark": benchmark, **columns})
    elif suffix == ".h5":
        with h5py.File(path, "w") as file:
            file.attrs["benchmark"] = benchmark
            for name, values in columns.items():
                file[name] = values
    else:
        flat = np.zeros(len(x))
        cells = [("vertex", np.arange(len(x))[:, None])]
        u3 = np.column_stack([u, flat])
        meshio.Mesh(np.column_stack([x, y, flat]), cells, {"displacement": u3}).write(path)
    return path


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".mat", ".vtu", ".vtk"])
def test_the_truth_scores_zero_in_every_format(
    truth: BenchmarkTruth, tmp_path: Path, suffix: str
) -> None:
    path = binary(truth, tmp_path, suffix, truth.id)
    score = graded(truth, path, Declared(units="mm", y_axis="up"))
    assert score.everywhere.max_px < ROUNDED_PX
    assert score.everywhere.points > 500


def test_matlab_counts_from_one_and_other_names_are_declared(
    truth: BenchmarkTruth, tmp_path: Path
) -> None:
    table = in_px(truth, *made.points(truth))
    table[:, :2] += 1.0
    path = write_csv(tmp_path / "ncorr.csv", table, "a,b,c,d")
    (declared,) = declarations(
        [path], ["Ncorr"], ["px"], ["down"], [1], ["x=a", "y=2", "u=c", "v=d"]
    ).values()
    score = graded(truth, path, declared)
    assert score.everywhere.max_px < ROUNDED_PX
    assert score.source == "Ncorr"


@pytest.mark.parametrize("sd_px", [0.01, 0.3])
def test_known_noise_scores_that_noise(truth: BenchmarkTruth, tmp_path: Path, sd_px: float) -> None:
    _, _, u = made.points(truth)
    rng = np.random.default_rng(0)
    noise = PIXEL * (sd_px * rng.normal(size=u.shape) + [3 * sd_px, 0.0])
    score = graded(truth, as_csv(truth, tmp_path, u + noise)).everywhere
    n = score.points
    bias_sd, rms = sd_px / np.sqrt(n), sd_px * np.sqrt(1 + 3**2 / 2)
    # Four standard deviations of mean and rms of so many numbers.
    assert score.bias_px == pytest.approx([3 * sd_px, 0.0], abs=4 * bias_sd)
    assert score.rms_px == pytest.approx(rms, abs=4 * 3 * bias_sd)


def test_lost_points_are_counted(truth: BenchmarkTruth, tmp_path: Path) -> None:
    _, _, u = made.points(truth)
    u[::5] = np.nan
    score = graded(truth, as_csv(truth, tmp_path, u))
    assert score.everywhere.points == len(u)
    assert score.everywhere.returned == pytest.approx(1 - len(u[::5]) / len(u))
    assert sum(part.points for part in score.by_region.values()) == len(u)


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".mat"])
def test_a_field_of_another_benchmark_is_not_taken(
    truth: BenchmarkTruth, tmp_path: Path, suffix: str
) -> None:
    path = binary(truth, tmp_path, suffix, OTHER)
    with pytest.raises(InputError, match=f"of benchmark {truth.id}, but it says .* {OTHER}"):
        graded(truth, path, Declared(units="mm", y_axis="up"))


def test_a_csv_of_another_benchmark_is_not_taken(truth: BenchmarkTruth, tmp_path: Path) -> None:
    path = as_csv(truth, tmp_path)
    path.write_text(path.read_text("utf-8").replace(truth.id, OTHER), "utf-8")
    with pytest.raises(InputError, match=OTHER):
        graded(truth, path)


@pytest.mark.parametrize(
    ("unit", "y_axis", "words"),
    [
        ("mm", "down", "pixels declared as mm"),
        ("px", "up", "mm declared as pixels"),
        ("px", "down", "mm declared as pixels"),
    ],
)
def test_positions_in_another_unit_are_recognised(
    truth: BenchmarkTruth, tmp_path: Path, unit: str, y_axis: str, words: str
) -> None:
    x, y, u = made.points(truth)
    table = in_px(truth, x, y, u) if unit == "mm" else np.column_stack([x, y, u])
    path = write_csv(tmp_path / "code.csv", table, "x,y,u,v")
    with pytest.raises(InputError, match=words):
        graded(truth, path, Declared(units=unit, y_axis=y_axis))


def test_a_file_that_is_no_field_is_named(truth: BenchmarkTruth, tmp_path: Path) -> None:
    for name in ("a.vtu", "a.mat", "a.xyz", "a.csv"):
        (tmp_path / name).write_text("nothing", "utf-8")
    (tmp_path / "units.csv").write_text("x,y,u,v\n1,2,3,4\n", "utf-8")
    (tmp_path / "folder.csv").mkdir()
    for path, words in (
        (tmp_path / "a.mat", r"expected a MAT file at .*a\.mat"),
        (tmp_path / "a.xyz", r"a\.xyz: expected one of .*\.vtu, got '\.xyz'"),
        (tmp_path / "a.csv", r"a\.csv: expected lines of numbers"),
        (tmp_path / "folder.csv", r"folder\.csv, found a folder"),
        (tmp_path / "units.csv", "give --unit px or mm"),
        (tmp_path / "a.vtu", r"expected a mesh that meshio reads at .*a\.vtu"),
        (tmp_path / "b.vtu", "found no such file"),
        (tmp_path / "c.csv", "found no such file"),
    ):
        with pytest.raises(InputError, match=words):
            read_measured(path, truth.grid, truth.id)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"names": ["one"]}, "a --name for each of 2"),
        ({"units": ["px"] * 3}, "expected --unit once"),
        ({"first_pixels": [2]}, "expected --first-pixel 0 or 1"),
        ({"columns": ["u"]}, "expected --column ROLE=NAME"),
        ({"columns": ["w=c"]}, "x, y, u, v, sd_u, sd_v, sigma, valid, got 'w'"),
    ],
)
def test_declarations_that_do_not_fit_are_reported(
    options: dict[str, list[str]], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        declarations([Path("a.csv"), Path("b.csv")], **options)  # type: ignore[arg-type]


def test_declarations_count_for_all_or_for_each() -> None:
    a, b = Path("a.csv"), Path("b.csv")
    both = declarations([a, b], units=["px"], y_axes=["file", "up"])
    assert (both[a].units, both[b].units) == ("px", "px")
    assert (both[a].y_axis, both[b].y_axis) == (None, "up")
    with pytest.raises(InputError, match="different files"):
        declarations([a, a])
