"""Light that drifts over a sequence of photographs: its effect on what a harvest measures.

A plate of 6 x 8 cells buckles in four photographs, of 8 bits with noise of 2 grey levels. Their
displacement is an ansatz of degrees 2 and 1 and a microfluctuation, the same in every cell. The
light changes in different ways, which are measured with constant and varying gain and offset::

    scripts/env python benchmarks/drifting_light.py                        # about half an hour
    scripts/env python benchmarks/drifting_light.py --lights even sloping40 --degrees none 1

Each row gives the outcomes and, of the photograph where it is largest: the rms error of v0 + v1
phi1 and of the whole displacement (with --whole-field) [px], the largest errors of v1 (of its
maximum) and of wave vectors [%], and how far the unknowns of v0 and v1 are from those measured in
the same way without change of light, rms, over their standard deviations by noise.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tifffile
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from synthetic_photographs import DARK, NOISE, Displacement, Photographed, lattice_points, of

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.modes import square_family
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.speckle.pattern import Speckle, SpeckleSpec
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]
PITCH, PIXEL, CRITICAL = 1.9, 0.035, 0.042
CELLULAR = Box.centred(6 * PITCH, 8 * PITCH)
DOMAIN = Box.centred(6 * PITCH + 1.6, 8 * PITCH + 1.6)
STRAINS = (0.03, 0.05, 0.06, 0.07)
FULL_SCALE = 255.0
DEGREES: dict[str, int | str] = {"none": "none", "0": 0, "1": 1, "2": 2}

Light = Callable[[int, FloatArray, FloatArray], tuple[FloatArray, float]]
"""Gain [-] and offset [grey levels] of photograph 1 to 4, at x and y from -1 to 1."""


def uniform(gain: float, offset: float = 0.0) -> Light:
    """A lamp that fades to ``gain``, and a level that rises by ``offset``, over the sequence."""
    return lambda k, x, y: (1.0 + (gain - 1.0) * k / 4 + 0.0 * x, offset * k / 4)


def sloping(change: float, oblique: bool = False) -> Light:
    """A vertical or oblique gradient that arises and moves: ``change`` from end to end."""

    def light(k: int, x: FloatArray, y: FloatArray) -> tuple[FloatArray, float]:
        along = (x + y) / np.sqrt(2.0) if oblique else y
        return 1.0 - 0.5 * change * (1.0 + along * k / 4), 0.0

    return light


def spot(size: float, share: float) -> Light:
    """A spot of light that moves: its width (sd) over half an edge, and how much brighter it is."""

    def light(k: int, x: FloatArray, y: FloatArray) -> tuple[FloatArray, float]:
        square = (x + 0.6 - 0.3 * k) ** 2 + (y - 0.3) ** 2
        return 0.8 + 0.8 * share * np.exp(-0.5 * square / size**2), 0.0

    return light


LIGHTS: dict[str, Light] = {
    "even": uniform(1.0), "fades5": uniform(0.95), "fades20": uniform(0.8),
    "fades40": uniform(0.6), "rises40": uniform(0.7, 40.0), "sloping5": sloping(0.05),
    "sloping20": sloping(0.2), "sloping40": sloping(0.4), "oblique20": sloping(0.2, True),
    "spot20": spot(0.3, 0.2), "spot30": spot(0.3, 0.3), "small10": spot(0.2, 0.1),
    "small20": spot(0.13, 0.2), "wide30": spot(0.5, 0.3),
    "flicker20": lambda k, x, y: ((0.8, 1.0, 0.85, 0.95)[k - 1] + 0.0 * x, 0.0),
    "overexposed": lambda k, x, y: ((1.35 if k == 2 else 1.0) + 0.0 * x, 0.0),
}  # fmt: skip


def shown() -> Photographed:
    """The plate in front of the camera."""
    holes = lattice_points(PITCH * np.eye(2), CELLULAR, (PITCH / 2, PITCH / 2))
    return Photographed(PixelGrid.centred(530, 420, PIXEL), DOMAIN, holes, 1.4)


def ansatz_of(strain: float) -> tuple[Ansatz, FloatArray]:
    """The ansatz of the true displacement, and its unknowns: a pitchfork at the critical strain."""
    ansatz = Ansatz.on(DOMAIN, [(square_family(), CELLULAR)], PITCH)
    return ansatz, ansatz.initial_guess(strain, 20.0 * np.sqrt(max(0.0, strain - CRITICAL)))


def fluctuation(strain: float) -> Displacement:
    """w: periodic over cells, up to 0.6 px at 7 %."""

    def w(points: FloatArray) -> FloatArray:
        x, y = (2.0 * np.pi / PITCH * points[..., k] for k in (0, 1))
        size = 0.6 * PIXEL * strain / 0.07
        return size * np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y)], axis=-1)

    return w


def truth(strain: float) -> Displacement:
    """The true displacement."""
    smooth, w = of(*ansatz_of(strain)), fluctuation(strain)
    return lambda points: smooth(points) + w(points)


def photograph(strain: float, light: Light, number: int) -> FloatArray:
    """(rows, cols) grey levels of one state in a given light."""
    plate = shown()
    at = plate.points if strain == 0.0 else plate.came_from(truth(strain))
    speckle = Speckle(SpeckleSpec(seed=plate.seed), plate.grid.shape)
    levels = 40.0 + 140.0 * speckle(*plate.grid.to_px(at[..., 0], at[..., 1]))
    levels = np.where(plate.material(at), levels, DARK)
    rows, cols = plate.grid.shape
    y, x = np.meshgrid(np.linspace(1, -1, rows), np.linspace(-1, 1, cols), indexing="ij")
    gain, offset = light(number, x, y) if number else (1.0, 0.0)
    noise = NOISE * np.random.default_rng(number).normal(size=levels.shape)
    return np.clip(np.rint(gain * levels + offset + noise), 0, FULL_SCALE)


def harvested(
    folder: Path, light: Light, degree: int | str, whole: bool
) -> tuple[HarvestRun, float]:
    """Take the photographs and harvest them; processor seconds."""
    for k, strain in enumerate((0.0, *STRAINS)):
        image = photograph(strain, light, k).astype(np.uint8)
        tifffile.imwrite(folder / (f"frame_{k}.tif" if k else "reference.tif"), image)
    (folder / "case.toml").write_text(
        '[images]\nreference = "reference.tif"\ndeformed = ["frame*.tif"]\n'
        f"[scale]\npixel_size = {PIXEL}\n[specimen]\ncell_size = {PITCH}\n"
        "[correlation]\nv0_degree = 3\nv_degree = 2\n"
        f"[whole_field]\nmeasure = {str(whole).lower()}\n"
    )
    case, begin = PhotographCase.read(folder / "case.toml"), time.process_time()
    how = replace(case.correlation, brightness=degree)
    run = HarvestRun(case.model_copy(update={"correlation": how}), folder / "out")
    run.results()
    return run, time.process_time() - begin


Unknowns = dict[str, tuple[FloatArray, FloatArray]]
"""By photograph: unknowns of v0 and v1, and their standard deviations by noise."""


def row(name: str, keys: str, run: HarvestRun, seconds: float, even: Unknowns) -> Unknowns:
    """Print a line; returns the unknowns."""
    results, plate, found = run.results(), shown(), Unknowns()
    mask, points = plate.mask, plate.points
    inside = points[mask]
    off, whole, v1, waves, apart = ([0.0] for _ in range(5))
    for frame, measured in results.items():
        result, strain = measured.result, STRAINS[int(frame[-1]) - 1]
        known, a = ansatz_of(strain)
        error = result.displacement()[mask] - known.displacement_at(a, inside)
        off.append(np.sqrt(np.mean(error**2)) / PIXEL)
        if measured.whole:
            u = measured.whole.measured.displacement_on()[mask] - truth(strain)(inside)
            whole.append(np.sqrt(np.nanmean(u**2)) / PIXEL)
        if strain > CRITICAL and not result.ansatz.fixed:
            x, y = plate.grid.x[None], plate.grid.y[:, None]
            true = known.v(0, a, x, y)[mask]
            got = result.ansatz.v(0, result.unknowns, x, y)[mask]
            v1.append(abs(abs(got) - true).max() / true.max())
            k = result.ansatz.modes[0].family.waves(result.mode_parameters(0))[:, 2:4]
            waves.append(abs(abs(k) - 1.0).max())
        size, errors = result.ansatz.phi_offset(0), result.errors
        assert errors is not None
        found[frame] = result.unknowns[:size], np.sqrt(np.diag(errors.by_noise))[:size]
        if frame in even and even[frame][0].shape == (size,):
            change = (found[frame][0] - even[frame][0]) / found[frame][1]
            apart.append(np.sqrt(np.mean(change**2)))
    outcomes = " ".join(m.result.outcome.value for m in results.values())
    lost = len(run.failures()) + len(run.prepared.skipped)
    numbers = f"{max(off):.3f} | {max(whole):.3f} | {100 * max(v1):.2f} | {100 * max(waves):.3f}"
    skipped = f", {lost} skipped" if lost else ""
    numbers += f" | {max(apart):.1f} | {seconds:.0f}"
    print(f"| {name} | {keys} | {outcomes}{skipped} | {numbers} |", flush=True)
    return found


def main() -> None:
    """Print a row for each light and each way to measure."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--lights", nargs="*", default=[*LIGHTS], choices=LIGHTS)
    options.add_argument("--degrees", nargs="*", default=[*DEGREES], choices=DEGREES)
    options.add_argument("--whole-field", action="store_true")
    how = options.parse_args()
    even: dict[str, Unknowns] = {}
    head = "light", "degree", "outcomes", "u", "whole u", "v1 [%]", "waves [%]", "off [sd]", "s"
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for name in how.lights:
        for degree in how.degrees:
            with TemporaryDirectory() as folder:
                try:
                    run, seconds = harvested(Path(folder), LIGHTS[name], DEGREES[degree],
                                             how.whole_field)  # fmt: skip
                    known = row(name, degree, run, seconds, even.get(degree, {}))
                except InputError as error:
                    print(f"| {name} | {degree} | {error} |", flush=True)
                    continue
                if name == "even":
                    even[degree] = known


if __name__ == "__main__":
    main()
