"""The twin of a real experiment: made, harvested from its files alone, set against its truth.

::

    twin/experiment/    the photographs, as a user has them
    twin/truth/         what they were made from
    harvest/            all that a harvest leaves; its report also shows the truth
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.case import TwinCase
from modeharvest.harvest.experiment import read_experiment
from modeharvest.harvest.measure import Measured
from modeharvest.harvest.pipeline import Harvesting
from modeharvest.harvest.twin import Twin, make_twin
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.identifiability import identifiability
from modeharvest.idic.result import Result
from modeharvest.imaging.distortion.mapping import Distortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.pipeline import Run
from modeharvest.progress import Progress, silent
from modeharvest.stages import exclusive
from modeharvest.validation.harvest.run import FrameTruth, HarvestTruth, TruthRow

FloatArray = NDArray[np.float64]

_WAVES, _AMPLITUDE, _LENS_PX = 0.01, 0.03, 0.05
"""What must come out: wave vectors within 1 %, v1 within 3 % of the best fit's maximum, S within
0.05 px rms without its affine part."""


@dataclass(frozen=True)
class TwinRun:
    """A twin's case, the folder it leaves its files in, and who listens.

    Parameters
    ----------
    case
        Of the twin.
    folder
        Where.
    progress
        Listener.
    solution
        A solution file to use instead of simulating.
    """

    case: TwinCase
    folder: Path
    progress: Progress = silent
    solution: Path | None = None

    def twin(self) -> Twin:
        """Make the photographs and their truth, unless they are there."""
        solution = Run(self.case, self.folder, self.progress, self.solution).solved()
        return make_twin(self.case, solution, self.folder / "twin", self.progress)

    def harvesting(self, twin: Twin) -> Harvesting:
        """The harvest of the photographs; knows nothing of the truth."""
        experiment = read_experiment(twin.experiment)
        folder = self.folder / "harvest"
        source = str(twin.experiment)
        return Harvesting(experiment, twin.experiment.parent, folder, self.progress, source)

    def all(self) -> dict[str, Any]:
        """Make, harvest, compare; returns the content of the harvest's ``summary.json``."""
        with exclusive(self.folder):
            twin = self.twin()
            harvesting = self.harvesting(twin)
            results = harvesting.results()
            truth = compare(twin, harvesting, results, self.progress)
            return harvesting.all(truth)


def compare(
    twin: Twin, harvesting: Harvesting, results: Mapping[str, Measured], progress: Progress = silent
) -> HarvestTruth:
    """Set a harvest against the truth of its twin."""
    images, geometry = twin.images, harvesting.geometry
    frames, rows = {}, []
    for k, (name, measured) in enumerate(results.items()):
        progress(k, len(results), "compare with the truth")
        strain = _strain_of(name, images.strains)
        true = images.truth(strain).displacement
        inside = np.asarray(
            np.isfinite(true).all(axis=-1)
        )  # the images' own masks are as the lens shows them
        result = measured.result
        best = fit_displacement(true, result.grid, result.ansatz, result.unknowns, inside)
        frames[name] = FrameTruth(true, best)
        rows += _frame_rows(name, result, best, true, inside, geometry.region.cellular)
    if harvesting.optics.distortion is not None:
        rows.append(_lens_row(harvesting.optics.distortion, twin.distortion, images.grid))
    return HarvestTruth(frames, twin.distortion, tuple(rows))


def _strain_of(name: str, strains: tuple[float, ...]) -> float:
    """The strain that a photograph's name tells in hundredths of a per cent."""
    number = int(name.rsplit("_", 1)[-1]) / 1e4
    return min(strains, key=lambda strain: abs(strain - number))


def _frame_rows(
    name: str,
    result: Result,
    best: Result,
    true: FloatArray,
    inside: NDArray[np.bool_],
    cellular: Box,
) -> list[TruthRow]:
    """What of one photograph was found, against the truth and the best fit of the ansatz."""
    px = result.grid.pixel_size
    found = result.displacement()
    left, lost = (_rms(field[inside]) / px for field in (true - found, best.displacement() - found))
    rows = [
        TruthRow(f"{name}: w = truth − IDIC, rms", left, "as measured", True, "px"),
        TruthRow(f"{name}: IDIC − best fit, rms", lost, "small against w", lost < left, "px"),
    ]
    if not result.ansatz.modes or not result.ansatz.modes[0].family.size:
        return rows
    if identifiability(result, inside).unobservable:
        words = f"{name}: wave vectors and v1"
        return [*rows, TruthRow(words, "no pattern is seen", "asked of one that is", True)]
    x, y = _over(cellular)
    v, at_best = (r.ansatz.v(0, r.unknowns, x, y) for r in (result, best))
    apart = float(np.abs(v - at_best).max() / np.abs(at_best).max())
    waves = result.ansatz.modes[0].family.waves(result.mode_parameters())[:, 2:4]
    off = float(np.abs(np.abs(waves) - 1.0).max())
    return [
        *rows,
        TruthRow(
            f"{name}: wave vectors, largest deviation from (±½, ±½)",
            100 * off, f"≤ {100 * _WAVES:g}", off <= _WAVES, "%",
        ),
        TruthRow(
            f"{name}: v1 − v1 of the best fit, largest over the cellular part, of its maximum",
            100 * apart, f"≤ {100 * _AMPLITUDE:g}", apart <= _AMPLITUDE, "%",
        ),
    ]  # fmt: skip


def _lens_row(found: Distortion, true: Distortion, grid: PixelGrid) -> TruthRow:
    """Rms difference of two distortions per component, without what is affine in it."""
    row, col = np.linspace(0, grid.rows - 1, 60), np.linspace(0, grid.cols - 1, 75)
    R, C = (axis.ravel() for axis in np.meshgrid(row, col, indexing="ij"))
    apart = np.stack(found.shift(R, C)) - np.stack(true.shift(R, C))
    design = np.column_stack([np.ones(R.size), R, C])
    affine = design @ np.linalg.lstsq(design, apart.T, rcond=None)[0]
    rms = _rms(apart.T - affine)
    words = "distortion of the lens: found − true without the affine part, rms per component"
    return TruthRow(words, rms, f"≤ {_LENS_PX:g}", rms <= _LENS_PX, "px")


def _over(box: Box) -> tuple[FloatArray, FloatArray]:
    return (
        np.linspace(box.x_min, box.x_max, 200, dtype=np.float64),
        np.linspace(box.y_min, box.y_max, 200, dtype=np.float64),
    )


def _rms(values: NDArray[Any]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
