"""Kernels compiled ahead of time in child processes, while the finite elements leave a core idle.

numba holds the GIL while it compiles, so threads do not help. Each child process runs a small
example of later stages, whose kernels are cached on disk, where the run finds them. This is
optional: kernels that a child has not compiled in time are compiled when they are needed.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from modeharvest.fem.field import Solution
from modeharvest.idic.correlate import best_fit, correlate
from modeharvest.idic.finite_element.equations.normal_equations import accumulate_elements
from modeharvest.idic.finite_element.measure import FiniteElementOptions, measure_displacement
from modeharvest.idic.solver.passes import accumulate
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import make_images
from modeharvest.imaging.mapping.rasterise import rasterise
from modeharvest.imaging.pair import ImagePair, Truth
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.util.compiled import cached_in, sources
from modeharvest.util.machine import is_alone
from modeharvest.util.progress import Progress, silent

_CASE = "paper-virtual"


def _images() -> None:
    """Run a small example that compiles the kernels of the stage ``image``."""
    case, solution = Case.read(_CASE), shipped_solution(_CASE)
    spec = replace(case.imaging, pixel_size=0.1)
    with tempfile.TemporaryDirectory() as folder:
        make_images(Solution.read(solution), spec, folder, case.experiment.strains[-1:])


def _correlation() -> None:
    """Run a small example that compiles the kernels of ``correlate`` and ``validate``."""
    case, rng = Case.read(_CASE), np.random.default_rng(0)
    grid, strain = PixelGrid.centred(444, 320, 0.05), case.experiment.strains[-1]
    f, mask = rng.random(grid.shape, np.float32), np.ones(grid.shape, np.bool_)
    options = case.correlation.options()
    options = replace(options, gauss_newton=replace(options.gauss_newton, max_iterations=1))
    pair = ImagePair(f, f[::-1].copy(), grid, mask, mask, strain=strain)
    found = correlate(pair, case.correlation.ansatz(case.experiment.specimen), options=options)
    best_fit(Truth.of(displacement=found.displacement()), found)


def _measurement() -> None:
    """Run a small example that compiles the further kernels of the stage ``measure``."""
    rng, grid = np.random.default_rng(0), PixelGrid.centred(200, 240, 0.05)
    f = gaussian_filter(rng.random(grid.shape, np.float32), 2.0)
    mask = np.ones(grid.shape, np.bool_)
    mask[80:120, 90:150] = False
    pair = ImagePair(f, f.copy(), grid, mask, mask)
    found = measure_displacement(pair, np.zeros_like, options=FiniteElementOptions(steps=1))
    found.standard_deviation_on()


_PARTS: dict[str, tuple[Callable[[], None], Callable[..., object]]] = {
    "image": (_images, rasterise),
    "correlate": (_correlation, accumulate),
    "measure": (_measurement, accumulate_elements),
}
"""By stage: the example that a child runs, and the kernel in whose cache folder its stamp is."""
_CHAINS = ("image",), ("correlate", "measure")
"""Stages of each child: ``measure`` calls kernels of the other two, and finds them compiled."""


def _stamp(stage: str) -> Path | None:
    """A stage's stamp file, ``*.nbi`` so that it is deleted with the kernels; None: no cache."""
    folder = cached_in(_PARTS[stage][1])
    return None if folder is None else folder / f"precompiled-{sources()}.nbi"


def stamps() -> dict[str, float]:
    """By stage, how long compiling its kernels ahead took [s]; 0 if not done."""
    found = {stage: _stamp(stage) for stage in _PARTS}
    texts = {s: p.read_text() if p is not None and p.exists() else "" for s, p in found.items()}
    return {stage: float(text or 0.0) for stage, text in texts.items()}


def _is_missing(stage: str) -> bool:
    return (stamp := _stamp(stage)) is not None and not stamp.exists()


@dataclass(frozen=True)
class Precompilation:
    """Child processes, by the stage whose kernels they compile."""

    children: dict[str, subprocess.Popen[bytes]]

    def wait(self, stage: str, progress: Progress = silent) -> None:
        """Wait for a stage's kernels: compiling them a second time would not be faster."""
        child = self.children.get(stage)
        while child is not None and child.poll() is None and _is_missing(stage):
            progress(0, 1, "compile kernels, once")
            time.sleep(0.1)


@contextmanager
def precompiling(stages: Iterable[str]) -> Iterator[Precompilation]:
    """Start child processes for stages whose kernels are missing; stops them all on exit."""
    children: dict[str, subprocess.Popen[bytes]] = {}
    missing = set(filter(_is_missing, stages))
    if is_alone() and (os.cpu_count() or 1) > 1:
        for chain in _CHAINS:
            if todo := [stage for stage in chain if stage in missing]:
                command = [sys.executable, "-m", "modeharvest.runs.precompile", *todo]
                nowhere = subprocess.DEVNULL
                child = subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere)
                children |= dict.fromkeys(todo, child)
    try:
        yield Precompilation(children)
    finally:
        for child in children.values():
            child.kill()
            child.wait()


def _main(stages: list[str]) -> None:
    gc.disable()  # saves a twentieth of the time, for 60 MB more memory
    if hasattr(os, "nice"):
        os.nice(10)  # the finite elements have priority
    for stage in stages:
        begin = time.perf_counter()
        _PARTS[stage][0]()
        if (stamp := _stamp(stage)) is not None:
            for old in stamp.parent.glob("precompiled-*.nbi"):
                old.unlink(missing_ok=True)
            stamp.write_text(f"{time.perf_counter() - begin:.1f}")  # for `modeharvest doctor`


if __name__ == "__main__":
    _main(sys.argv[1:])
