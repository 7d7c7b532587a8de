"""Damaged files: every reader, 300 variants each, reads one or says in a line what is wrong.

Never another exception, never a crash, never a wait, never more memory than a file deserves. The
variants are the same in every run.
"""

from __future__ import annotations

import faulthandler
import json
import re
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
import synthetic_benchmark as made
import tifffile
from known_fields import square_mode
from perforated import PITCH, SQUARE, holed_cell
from PIL import Image
from scipy.io import savemat
from test_mode_file import sample
from test_result import some_result

import modeharvest
from modeharvest.fem import field
from modeharvest.fem.bloch.modes import read_modes, write_modes
from modeharvest.fem.field import Solution, read_any_mesh, read_meshio
from modeharvest.idic.local import tables
from modeharvest.idic.local.field import read_field
from modeharvest.idic.local.tables import read_mat
from modeharvest.idic.result import Result
from modeharvest.idic.spectra.lattice_spectrum import lattice_spectrum
from modeharvest.idic.spectra.mode_family import (
    mode_family,
    read_family,
    read_spectrum,
    write_family,
)
from modeharvest.imaging.distortion.files import read_distortion, write_distortion
from modeharvest.imaging.distortion.lens import PolynomialDistortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet
from modeharvest.imaging.pair import Truth
from modeharvest.imaging.photographs.files import read_image, read_mask
from modeharvest.imaging.photographs.photograph import read_photograph
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.runs.case import Case, case_text
from modeharvest.runs.homogenization.case import HomogenizationCase
from modeharvest.runs.lattice.case import LatticeCase
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.prepare import PreparedPhotographs
from modeharvest.runs.study import StudyCase
from modeharvest.util.errors import InputError
from modeharvest.util.files import open_hdf5, reading
from modeharvest.validation.scoring.benchmark import BenchmarkTruth, Declared, read_measured
from modeharvest.validation.scoring.star import Star, StarSet, StarSpec, make_star_set

VARIANTS = 300
LONGEST_S = 60.0
"""Of fifty variants; none should take a second."""
LARGEST_BYTES = 300e6
"""Most by which reading files of some kB may make this process grow."""
GRID = PixelGrid.centred(40, 50, 0.1)
Damage = Callable[[np.random.Generator, bytes], bytes]


# --- what is damaged ----------------------------------------------------------------------


@dataclass(frozen=True)
class Readable:
    """A file of a kind, and who reads it."""

    path: Path
    read: Callable[[Path], object]
    child: str | None = None
    """The kind, if a child reads it."""


@pytest.fixture(scope="module")
def readables(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Readable]:
    """A whole file of every kind."""
    folder = tmp_path_factory.mktemp("whole")
    return {**_cases(folder), **_own(folder), **_sets(folder), **_foreign(folder), **_seen(folder)}


def _cases(folder: Path) -> dict[str, Readable]:
    root = Path(str(modeharvest.__file__)).parent
    harvest = folder / "experiment.toml"
    options = re.sub(r"^# (?=\w+ = (?!.*e\.g\.))", "", case_text("photographs"), flags=re.MULTILINE)
    harvest.write_text(options, "utf-8")
    return {
        "case": Readable(root / "cases" / "paper-virtual.toml", Case.read),
        "twin": Readable(root / "cases" / "paper-real-twin.toml", Case.read),
        "lattice": Readable(root / "cases" / "square-lattice.toml", LatticeCase.read),
        "study": Readable(root / "cases" / "studies" / "noise.toml", StudyCase.read),
        "homogenized": Readable(root / "cases" / "paper-homogenized.toml", HomogenizationCase.read),
        "experiment": Readable(harvest, PhotographCase.read),
    }


def _own(folder: Path) -> dict[str, Readable]:
    solution = made.solution(divisions=4)
    solution.write(folder / "solution.h5")
    write_modes(folder / "modes.h5", *sample())
    some_result().write(folder / "result.json")
    mesh, lattice = holed_cell(SQUARE, 4, (2, 2)), 2 * SQUARE
    motion = square_mode([1, 1, 1, 1, -1, 0, 0], PITCH, *mesh.nodes.T)
    found = mode_family(mesh, lattice, motion, PITCH)
    write_family(
        folder / "family.json", found, {}, lattice_spectrum(mesh, lattice, motion, PITCH, reach=4)
    )
    write_distortion(folder / "lens.json", PolynomialDistortion((40, 50), np.ones((2, 6))))
    return {
        "solution": Readable(folder / "solution.h5", Solution.read),
        "modes": Readable(folder / "modes.h5", read_modes),
        "result": Readable(folder / "result.json", Result.read),
        "family": Readable(folder / "family.json", lambda p: (read_family(p), read_spectrum(p))),
        "lens": Readable(folder / "lens.json", read_distortion),
    }


def _whole_truth(path: Path) -> object:
    names = "displacement", "reference_point", "deformed_displacement", "element", "residual_px"
    return [getattr(Truth.read(path), name) for name in names]


def _sets(folder: Path) -> dict[str, Readable]:
    _, truth = made.make(folder)
    star = make_star_set(
        StarSpec(Star(rows=41, cols=120), SpeckleSpec(blur_px=1.0)), folder / "star"
    )

    prepared = {
        "names": ["a", "b"], "skipped": [["c", "blank"]], "noise": {"sd": 1.5, "source": "repeats"},
        "grid": asdict(GRID), "full_scale": 255.0, "notes": ["cropped"],
    }  # fmt: skip
    (folder / "prepared.json").write_text(json.dumps(prepared, indent=2), "utf-8")

    def images(path: Path) -> object:
        read = ImageSet.read(_beside(path, truth / "images"))
        strain = read.strains[0]
        known = read.truth(strain).displacement
        return read.reference(camera=True), read.mask(), read.deformed(strain), known

    def benchmark(path: Path) -> object:
        known = BenchmarkTruth.read(_beside(path, truth))
        return known.displacement(known.strains[0], [0.1], [0.1])

    return {
        "images": Readable(truth / "images" / "images.json", images),
        "truth": Readable(next((truth / "images").glob("truth_*.h5")), _whole_truth),
        "benchmark": Readable(truth / "benchmark.json", benchmark),
        "prepared": Readable(
            folder / "prepared.json", lambda p: PreparedPhotographs.read(p.parent)
        ),
        "star": Readable(star.folder / "star.json", lambda p: StarSet.read(p.parent)),
    }


def _beside(path: Path, whole: Path) -> Path:
    """The folder of a damaged sidecar, with the whole one's other files in it."""
    for other in whole.iterdir():
        link = path.parent / other.name
        if other.is_file() and not link.exists():
            link.symlink_to(other)
    return path.parent


def _foreign(folder: Path) -> dict[str, Readable]:
    mesh = holed_cell(SQUARE, 2, (1, 1))
    points = np.column_stack([mesh.nodes, np.zeros(len(mesh.nodes))])
    u = {"u": 0.01 * points}
    x, y = (a.ravel().astype(float) for a in np.meshgrid(np.arange(6), np.arange(5)))
    columns = {"x": x, "y": y, "u": 0.1 * x, "v": 0.2 * y}
    readables = {}
    forms = {"msh": "gmsh", "inp": "abaqus"}
    for kind in ("vtu", "vtk", "msh", "inp", "xdmf", "med"):
        path, data = folder / f"mesh.{kind}", {} if kind == "inp" else u
        whole = meshio.Mesh(points, [("triangle6", mesh.cells)], point_data=data)
        whole.write(path, forms.get(kind, kind))
        readables[kind] = Readable(path, read_any_mesh if kind == "inp" else _solved, "mesh")
    readables["vtu field"] = Readable(folder / "mesh.vtu", _measured, "mesh")
    savemat(folder / "field.mat", {"result": columns, "benchmark": "0123456789ab"})
    savemat(folder / "packed.mat", columns, do_compression=True)
    for name in ("field.mat", "packed.mat"):
        readables[name] = Readable(folder / name, _measured, "mat")

    table = np.column_stack(list(columns.values()))
    np.savetxt(folder / "field.csv", table, delimiter=",", header="x,y,u,v", comments="")
    np.savez(folder / "field.npz", **columns)
    np.savez_compressed(folder / "packed.npz", **columns)
    with h5py.File(folder / "field.h5", "w") as file:
        for name, values in columns.items():
            file.create_dataset(f"result/{name}", data=values, compression=4, chunks=(10,))
        file.attrs["benchmark"] = "0123456789ab"
    for name in ("field.csv", "field.npz", "packed.npz", "field.h5"):
        readables[name] = Readable(folder / name, _measured)

    (folder / "lens.yml").write_text(_YAML, "utf-8")
    (folder / "lens.xml").write_text(_XML, "utf-8")
    (folder / "dice.xml").write_text(_DICE, "utf-8")
    for name in ("lens.yml", "lens.xml", "dice.xml"):
        readables[name] = Readable(folder / name, read_distortion)
    return readables


def _solved(path: Path) -> object:
    return read_meshio(path, "u", 0.1)


def _measured(path: Path) -> object:
    return read_measured(path, GRID, "0123456789ab", Declared(units="px", y_axis="down"))


def _seen(folder: Path) -> dict[str, Readable]:
    levels = np.random.default_rng(0).integers(1, 250, (24, 30)).astype(np.uint8)
    colour = np.stack([levels, levels[::-1], levels], axis=-1)
    tifffile.imwrite(folder / "plain.tif", levels.astype(np.uint16))
    tifffile.imwrite(folder / "packed.tif", colour, photometric="rgb", compression="zlib")
    for name in ("grey.png", "grey.bmp", "grey.jpg"):
        Image.fromarray(levels).save(folder / name)
    Image.fromarray(colour).save(folder / "colour.png")

    def every(path: Path) -> object:
        lines = [_outcome(read, path) for read in (read_image, read_mask)]
        read_photograph(path)
        return lines

    names = ("plain.tif", "packed.tif", "grey.png", "grey.bmp", "grey.jpg", "colour.png")
    return {name: Readable(folder / name, every) for name in names}


_YAML = """%YAML:1.0
---
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 900., 0., 25., 0., 900., 20., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.1, 0.02, 0.001, 0.002, 0.003 ]
"""
_XML = """<?xml version="1.0"?>
<opencv_storage>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>900. 0. 25. 0. 900. 20. 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>5</cols><dt>d</dt>
<data>-0.1 0.02 0.001 0.002 0.003</data></distortion_coefficients>
</opencv_storage>
"""
_DICE = """<ParameterList><ParameterList name="CAMERA 0">
<Parameter name="CAMERA_ID" type="string" value="left"/>
<Parameter name="CX" type="double" value="25"/><Parameter name="CY" type="double" value="20"/>
<Parameter name="FX" type="double" value="900"/><Parameter name="FY" type="double" value="900"/>
<Parameter name="FS" type="double" value="0"/><Parameter name="K1" type="double" value="-0.1"/>
<Parameter name="LENS_DISTORTION_MODEL" type="string" value="OPENCV_LENS_DISTORTION"/>
</ParameterList></ParameterList>
"""


# --- how ----------------------------------------------------------------------------------


def _cut(random: np.random.Generator, whole: bytes) -> bytes:
    return whole[: random.integers(len(whole))]


def _flipped(random: np.random.Generator, whole: bytes) -> bytes:
    content = bytearray(whole)
    for at in random.integers(len(content), size=random.integers(1, 9)):
        content[at] = random.integers(256)
    return bytes(content)


def _hole(random: np.random.Generator, whole: bytes) -> bytes:
    at, length = random.integers(len(whole)), random.integers(1, 200)
    filler = (b"", b"\0" * int(length), random.bytes(int(length)))[random.integers(3)]
    return whole[:at] + filler + whole[at + length :]


_WORDS = (
    b"nan", b"-1", b"0", b"1e300", b"-inf", b"true", b'"text"', b"[]", b"{}", b"", b"null",
    b"1e999", b"99999999999999999999", b"[[1, 2], 3]", b"\xe9", b"[/bold]", b"2.5",
)  # fmt: skip


def _other_words(random: np.random.Generator, whole: bytes) -> bytes:
    """Texts only: values, names and lines replaced, doubled or left out."""
    places = list(re.finditer(rb'[-+.\w]+|"[^"\n]*"|\[[^\]\n]*\]', whole))
    if not places:
        return _cut(random, whole)
    content = whole
    chosen = sorted(random.integers(len(places), size=random.integers(1, 3)), reverse=True)
    for k in chosen:
        a, b = places[k].span()
        content = content[:a] + _WORDS[random.integers(len(_WORDS))] + content[b:]
    if random.random() < 0.2:
        lines = content.splitlines(keepends=True)
        del lines[random.integers(len(lines))]
        content = b"".join(lines)
    return content


_BYTES: tuple[Damage, ...] = (_cut, _flipped, _hole)
_TEXTS = (".toml", ".json", ".csv", ".xml", ".yml", ".inp", ".vtk", ".vtu", ".xdmf")


def variants(name: str, whole: Path) -> Iterator[bytes]:
    """The damaged contents, the same in every run."""
    random = np.random.default_rng([zlib.crc32(name.encode()), 1])
    content = whole.read_bytes()
    ways = (*_BYTES, _other_words, _other_words) if whole.suffix in _TEXTS else _BYTES
    for k in range(VARIANTS):
        if whole.suffix in (".h5", ".med") and k % 2:
            yield _other_types(random, whole)
        else:
            yield ways[k % len(ways)](random, content)


def _other_types(random: np.random.Generator, whole: Path) -> bytes:
    """HDF5 only: an object or attribute left out, or another in its place."""
    places = _places(whole)
    above, name, is_attribute = places[random.integers(len(places))]
    with h5py.File(whole, "r+", driver="core", backing_store=False) as file:  # a copy in memory
        where = file[above].attrs if is_attribute else file[above]
        new = _OTHERS[random.integers(len(_OTHERS))]
        del where[name]
        if new is not None:
            where[name] = new
        file.flush()
        return bytes(file.id.get_file_image())


@cache
def _places(whole: Path) -> list[tuple[str, str, bool]]:
    """Of an HDF5 file: what each object and attribute is in, its name, and whether it is one."""
    with h5py.File(whole, "r") as file:
        places = [("/", name, True) for name in file.attrs]

        def look_at(name: str, thing: Any) -> None:
            above, _, last = name.rpartition("/")
            places.append((above or "/", last, False))
            places.extend((name, attribute, True) for attribute in thing.attrs)

        file.visititems(look_at)
    return places


_OTHERS: tuple[Any, ...] = (
    None, None, "text", b"\xff\xfe", 3, -1, np.nan, [1.0, np.inf], np.zeros((0, 2)),
    np.zeros((3, 2, 2)), np.ones(4, complex), np.array(["a", "b"], dtype="S1"),
    np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f8")]), np.full((9, 2), 10**12),
)  # fmt: skip


# --- what becomes of it -------------------------------------------------------------------


def _outcome(read: Callable[[Path], object], path: Path) -> str:
    """Empty if it reads; one line if it doesn't. Any exception but InputError goes on."""
    try:
        read(path)
    except InputError as error:
        line = str(error)
        assert "\n" not in line
        assert line.strip()
        return line
    return ""


NAMES = (
    "case", "twin", "lattice", "study", "experiment", "solution", "modes", "result", "family",
    "lens", "images", "truth", "benchmark", "star", "vtu", "vtk", "msh", "inp", "xdmf", "med",
    "vtu field", "field.csv", "field.npz", "packed.npz", "field.h5", "field.mat", "packed.mat",
    "lens.yml", "lens.xml", "dice.xml", "plain.tif", "packed.tif", "grey.png", "grey.bmp",
    "grey.jpg", "colour.png", "prepared", "homogenized",
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_reads_or_is_refused_in_a_line(
    readables: dict[str, Readable],
    reader: subprocess.Popen[str],
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    readable = readables[name]
    assert _outcome(readable.read, readable.path) == ""
    damaged = variants(name, readable.path)
    files: Iterable[Path]
    if readable.child is None:
        files = _one_after_the_other(tmp_path / readable.path.name, damaged)
    else:
        files = [tmp_path / f"{k:03d}{readable.path.suffix}" for k in range(VARIANTS)]
        for path, content in zip(files, damaged, strict=True):
            path.write_bytes(content)
        _read_at_once(monkeypatch, reader, readable.child, files)
    refused, begin = 0, _peak_bytes(reset=True)
    for k, path in enumerate(files):
        if k % 50 == 0:  # a limit for so many together: setting one takes longer than many a read
            faulthandler.dump_traceback_later(LONGEST_S, exit=True)
        refused += bool(_outcome(readable.read, path))
    faulthandler.cancel_dump_traceback_later()
    assert refused > VARIANTS / 20
    assert _peak_bytes() - begin < LARGEST_BYTES


def _one_after_the_other(path: Path, contents: Iterable[bytes]) -> Iterator[Path]:
    """The path, again and again, each time of another file."""
    for content in contents:
        path.unlink(missing_ok=True)  # a new file, also where a reader still holds the old one
        path.write_bytes(content)
        yield path


_READER = """
import json, mmap, os, signal, sys
import meshio, scipy.io
from modeharvest.util import child
begun = mmap.mmap(-1, 8)  # how many files, counted by forks
for line in sys.stdin:
    limit, kind, *paths = json.loads(line)
    first = 0
    while first < len(paths):
        if os.fork() == 0:
            signal.alarm(limit)
            child.limit_memory(paths[first])
            for k in range(first, len(paths)):
                begun[:] = (k + 1).to_bytes(8)
                message = child.convert(kind, paths[k], paths[k] + ".npz")
                print(json.dumps([paths[k], message]), flush=True)
            os._exit(0)
        end, last = os.waitstatus_to_exitcode(os.wait()[1]), int.from_bytes(begun[:])
        if end == -signal.SIGALRM or last <= first:
            sys.exit(f"no end, or no beginning: {paths[last - 1]}")
        first = last
    begun[:] = bytes(8)
    print("null", flush=True)
"""


@pytest.fixture(scope="module")
def reader() -> Iterator[subprocess.Popen[str]]:
    """A process that has imported the parsers, for forks of it to read files."""
    command, pipe = [sys.executable, "-c", _READER], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        yield process
        process.communicate(timeout=LONGEST_S)


def _read_at_once(
    monkeypatch: pytest.MonkeyPatch, reader: subprocess.Popen[str], kind: str, files: list[Path]
) -> None:
    """Let one fork read all the variants, a second one what it leaves if it crashes, and so on."""
    assert reader.stdin is not None
    assert reader.stdout is not None
    print(json.dumps([int(LONGEST_S), kind, *map(str, files)]), file=reader.stdin, flush=True)
    message: dict[str, str] = {}
    while found := json.loads(reader.stdout.readline()):
        message |= [found]

    def read(kind: str, path: Path, what: str, remedy: str) -> dict[str, Any]:
        with reading(path, what, remedy):
            if message.get(str(path)) or not (found := Path(f"{path}.npz")).is_file():
                raise ValueError(message.get(str(path)) or "a file that makes its parser crash")
            with np.load(found) as file:
                return {str(n): file[f"arr_{k}"] for k, n in enumerate(file["names"])}

    for module in (field, tables):
        monkeypatch.setattr(module, "read_in_child", read)


def _peak_bytes(*, reset: bool = False) -> float:
    """The most memory that this process has taken since the last reset; 0 if nobody knows."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        status = Path("/proc/self/status").read_text()
    except OSError:
        return 0.0
    (peak,) = re.findall(r"VmHWM:\s+(\d+) kB", status)
    return 1e3 * float(peak)


def test_a_file_that_crashes_its_parser_is_reported_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "child.py"
    script.write_text("import os\nos.abort()\n")
    monkeypatch.setattr("modeharvest.util.child.__file__", str(script))
    savemat(tmp_path / "field.mat", {"x": 1.0})
    with pytest.raises(InputError, match=r"field\.mat, got: a file that makes its parser crash"):
        read_mat(tmp_path / "field.mat")


def test_wild_numbers_do_not_fill_the_memory(tmp_path: Path) -> None:
    """A mesh of one triangle whose nodes' numbers reach 10^10: meshio makes a table so long."""
    path = tmp_path / "wild.msh"
    path.write_text(
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 3 1 10000000000\n2 1 0 3\n1\n2\n"
        "10000000000\n0 0 0\n1 0 0\n0 1 0\n$EndNodes\n$Elements\n1 1 1 1\n2 1 2 1\n"
        "1 1 2 10000000000\n$EndElements\n"
    )
    with pytest.raises(InputError, match=r"wild\.msh, got: .* more numbers than"):
        read_any_mesh(path)


def _external(file: h5py.File, secret: Path) -> None:
    file.create_dataset("x", (4,), "u1", external=[(str(secret), 0, 4)])


def _linked(file: h5py.File, secret: Path) -> None:
    file["x"] = h5py.ExternalLink(str(secret), "/x")


def _virtual(file: h5py.File, secret: Path) -> None:
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource(str(secret), "x", (4,))
    file.create_virtual_dataset("x", layout)


@pytest.mark.parametrize("outside", [_external, _linked, _virtual])
@pytest.mark.parametrize("name", ["field.h5", "field.mat"])
def test_hdf5_that_reads_other_files_is_refused(
    outside: Callable[[h5py.File, Path], None], name: str, tmp_path: Path
) -> None:
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["x"] = np.arange(4.0)
    with h5py.File(tmp_path / name, "w") as file:
        outside(file, secret)
        for role in "yuv":
            file[role] = np.arange(4.0)
    with pytest.raises(InputError, match=r"expected all data in the file itself, got 'x'"):
        read_field(tmp_path / name, GRID, units="px", y_axis="down")


def test_hdf5_whose_texts_have_no_end_is_refused(tmp_path: Path) -> None:
    """libhdf5 1.14 looks for them for ever."""
    path = tmp_path / "labels.h5"
    with h5py.File(path, "w") as file:
        file.attrs["labels"] = ["X", "M"]
    whole = path.read_bytes()
    first = whole.index(b"GCOL") + 16
    path.write_bytes(whole[:first] + bytes(32) + whole[first + 32 :])
    with pytest.raises(InputError, match="expected texts that end"), open_hdf5(path, "labels"):
        pass


def test_hdf5_of_a_few_bytes_declares_no_terabyte(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "field.h5", "w") as file:
        for role in "xyuv":
            file.create_dataset(role, (10**6, 10**6), chunks=(100, 100))
    with pytest.raises(InputError, match=r"bytes that declare 1\.6e\+13"):
        read_field(tmp_path / "field.h5", GRID, units="px", y_axis="down")
