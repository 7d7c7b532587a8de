"""The whole displacement as a stage of a run: options, measurement, and files."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np
from numba import get_num_threads

from modeharvest.fem.experiment import Experiment
from modeharvest.idic.correlate import ASTRAY
from modeharvest.idic.finite_element.equations.system import Body
from modeharvest.idic.finite_element.files import Given, read_result, write_result, write_vtu
from modeharvest.idic.finite_element.measure import FiniteElementOptions, Law, measure_displacement
from modeharvest.idic.finite_element.result import (
    NodalResult,
    WholeField,
    refitted,
    refitted_correlation,
)
from modeharvest.idic.result import Result
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.imaging.imageset import ImageSet
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import make_folder
from modeharvest.util.machine import available_bytes, is_alone
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.summary import MeasuredExperiment
from modeharvest.validation.truth import Comparison
from modeharvest.validation.whole_field import WholeFieldSummary, compare_whole

BYTES_PER_PIXEL = 420.0
"""Memory needed to measure an image [bytes/px]; from 1.6 GB measured for an image of 4 Mpx."""
_REFUSED = 2
"""Exit code of a child process after an InputError."""


@dataclass(frozen=True)
class WholeFieldOptions:
    """How the whole displacement is measured on a mesh of the material, from the ansatz' result."""

    measure: bool = False
    """Whether the whole displacement is measured; this takes longer than the rest of the run."""
    element_px: float = 24.0
    """Edge length of the elements [px]."""
    edge_element_px: float = 12.0
    """Edge length of the elements along edges of the material [px]."""
    cutoff_px: float | None = None
    """Cut-off wavelength of the regularisation [px]; None to find it from the images."""

    def __post_init__(self) -> None:
        self.on_mesh()

    def on_mesh(self, law: Law | None = None) -> FiniteElementOptions:
        """The options of the finite element measurement, with a material law if given."""
        sizes = self.element_px, self.edge_element_px
        return FiniteElementOptions(*sizes, cutoff_px=self.cutoff_px, law=law)


def change_of(how: WholeFieldOptions, measure: bool | None) -> dict[str, WholeFieldOptions]:
    """Changes to a case so that it measures or not; none for None, which keeps its own choice."""
    return {} if measure is None else {"whole_field": replace(how, measure=measure)}


@dataclass(frozen=True)
class VirtualWholeFieldOptions(WholeFieldOptions):
    """Options of the whole displacement of a virtual experiment, whose exact images are known."""

    camera: bool = True
    """Whether to measure in the camera's quantised images, or else in the exact ones."""
    material_law: bool = False
    """Whether to regularise by the equilibrium of the experiment's material."""

    @property
    def of_photographs(self) -> WholeFieldOptions:
        """Those of the options that photographs also have."""
        return WholeFieldOptions(*(getattr(self, f.name) for f in fields(WholeFieldOptions)))

    def of(self, experiment: Experiment, pixel_size: float) -> FiniteElementOptions:
        """Finite element options for an experiment; its two ends along x are loaded."""
        if not self.material_law:
            return self.on_mesh()
        on_ends = partial(_on_ends, experiment.specimen.half_size[0], pixel_size)
        return self.on_mesh(Law(experiment.material, on_ends))


def _on_ends(half_length: float, within: float, points: FloatArray) -> BoolArray:
    """(n,) True for points within a distance [mm] of the two ends of a specimen along x."""
    return np.asarray(np.abs(np.abs(points[:, 0]) - half_length) < within)


@contextmanager
def with_remedy(of: str) -> Iterator[None]:
    """Add to an InputError which whole displacement failed, and how to run without it."""
    try:
        yield
    except InputError as error:
        raise InputError(
            f"whole displacement, {of}: {error}; or leave it out: [whole_field] measure = "
            "false, --no-whole-field"
        ) from error


def name_of(strain: float) -> str:
    """File name, without extension, of the whole displacement at a nominal strain [-]."""
    return f"displacement_{round(1e4 * strain):04d}"


@dataclass(frozen=True)
class WholeFields:
    """The files of whole displacements in a folder, named by image."""

    folder: Path

    def path(self, name: str) -> Path:
        """The HDF5 file of an image; the VTU beside it has the same name."""
        return self.folder / f"{name}.h5"

    def result_path(self, strain: float) -> Path:
        """The JSON file of the correlation that replaces one that had failed."""
        return self.folder / f"{name_of(strain)}_result.json"

    def write(self, name: str, found: NodalResult, given: Given) -> tuple[Path, Path]:
        """Write the whole displacement of an image; returns the HDF5 and the VTU file."""
        path = self.path(name)
        make_folder(self.folder)
        write_result(path, found, given=given)
        write_vtu(path.with_suffix(".vtu"), found, given=given)
        return path, path.with_suffix(".vtu")

    def of_images(
        self, images: ImageSet, results: Mapping[float, Result], options: VirtualWholeFieldOptions,
        correlation: SquareLatticeOptions, experiment: Experiment, progress: Progress,
    ) -> list[Path]:  # fmt: skip
        """Measure every deformed image of a virtual experiment, starting from its correlation.

        If the correlation had failed, it is repeated from the measured displacement. The images are
        distributed over processes, as many as cores and memory allow. Returns the files.
        """
        how, mask = options.of(experiment, images.grid.pixel_size), images.mask()
        most = min(get_num_threads() if is_alone() else 1, len(images.strains))
        count = max(1, min(most, int(available_bytes() / (BYTES_PER_PIXEL * mask.size))))
        with _children(count - 1) as children:
            with with_remedy("mesh of the material"):
                body = how.body(mask, images.grid)
            # The last state takes longest; it is measured here, so that its progress is shown.
            first, *others = (
                partial(
                    _measure, self, images.folder, body, how, options.camera, correlation,
                    {strain: results[strain] for strain in images.strains[-1 - k :: -count]},
                )
                for k in range(count)
            )  # fmt: skip
            for child, share in zip(children, others, strict=True):
                assert child.stdin
                with suppress(BrokenPipeError), child.stdin as to:  # reported at the end
                    pickle.dump(share, to)
            first(progress)
        stems = [self.path(name_of(strain)) for strain in images.strains]
        again = [p for p in map(self.result_path, images.strains) if p.exists()]
        return again + [path.with_suffix(kind) for path in stems for kind in (".h5", ".vtu")]

    def compared(
        self, comparisons: Sequence[Comparison], k: int, measured: MeasuredExperiment
    ) -> tuple[WholeField, WholeFieldSummary]:
        """The k-th whole displacement with the ansatz refitted to it, and its errors."""
        known, name = comparisons[k], name_of(comparisons[k].strain)
        found, true, fit = self.read(name), known.displacement, known.result
        refit = refitted(found, fit.ansatz, fit.unknowns, known.mask)
        whole = WholeField(found, refit)
        return whole, compare_whole(whole, true, known.best, known.mask, measured.specimen)

    def read(self, name: str) -> NodalResult:
        """The whole displacement of an image; InputError if its file is missing or damaged."""
        return read_result(self.path(name))


def _measure(
    files: WholeFields, folder: Path, body: Body, how: FiniteElementOptions, camera: bool,
    correlation: SquareLatticeOptions, results: Mapping[float, Result], progress: Progress,
) -> None:  # fmt: skip
    """Measure the images of a folder in turn, each from its correlation in ``results``."""
    images, law = ImageSet.read(folder), None if how.law is None else how.law.material

    def say(of: str, done: float, total: float, what: str) -> None:
        progress(done, total, f"{what}, {of}")

    for strain, result in results.items():
        of = f"strain {100 * strain:.2f} %"
        with with_remedy(of):
            pair = images.pair(strain, camera=camera)
            found = measure_displacement(pair, result, body, options=how, progress=partial(say, of))
        files.result_path(strain).unlink(missing_ok=True)
        if result.outcome in ASTRAY:
            pair, a = images.pair(strain, camera=correlation.camera), result.unknowns
            where = result.ansatz, a, images.mask()
            result, _ = refitted_correlation(found, pair, *where, correlation.options())
            make_folder(files.folder)
            result.write(files.result_path(strain))
        files.write(name_of(strain), found, Given(material=law, correlation=result))


@contextmanager
def _children(count: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Child processes that run the pickled work sent to their stdin; all are stopped on exit.

    Passes on an InputError of a child; InputError if one was killed; RuntimeError if it fails else.
    """
    command, pipe = [sys.executable, "-P", "-m", "modeharvest.runs.whole_field"], subprocess.PIPE
    with ExitStack() as stack:
        children = [
            stack.enter_context(subprocess.Popen(command, stdin=pipe, stderr=pipe))
            for _ in range(count)
        ]
        try:
            yield children
            for child in children:
                assert child.stderr
                text, code = child.stderr.read().decode(errors="replace").strip(), child.wait()
                if code == _REFUSED:
                    raise InputError(text.splitlines()[-1])
                if code < 0:
                    raise InputError(
                        f"a process that measures was killed by signal {-code}, as happens when "
                        "memory runs out; free some, or measure with NUMBA_NUM_THREADS=1"
                    )
                if code != 0:
                    raise RuntimeError(text or f"a process that measures ended with {code}")
        finally:
            for child in children:
                child.kill()


if __name__ == "__main__":
    try:
        pickle.load(sys.stdin.buffer)(silent)
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(_REFUSED)
