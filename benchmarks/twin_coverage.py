"""Coverage of the twin's 95 % intervals over many seeds of the camera's noise.

Each seed photographs the twin again: a 95 % interval of a field, 1.96 standard deviations by noise
about what one photograph shows, should hold the noise-free result in 95 of 100 of them.

Needs the twin's photographs and harvest (minutes), which it makes in out/twin unless they are
there: modeharvest run paper-real-twin --out out/twin. Goes on where it was stopped.

Run: scripts/env python benchmarks/twin_coverage.py [--seeds 100] [--workers 2] [--folder out/twin]
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.correlate import correlate
from modeharvest.idic.photograph.measure import image_noise
from modeharvest.idic.result import Result
from modeharvest.idic.uncertainty.covariance import FieldErrors, covariance, field_errors
from modeharvest.imaging.distortion.lens import undistorted
from modeharvest.imaging.pair import ImagePair
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun
from modeharvest.runs.twin import Twin, TwinRun
from modeharvest.util.arrays import FloatArray, FloatImage
from modeharvest.validation.campaign import Campaign, grid
from modeharvest.validation.workers import Workers

FUNCTION = "twin_coverage:one_seed"
INTERVAL = 1.96
"""Standard deviations of a 95 % interval."""
_POINTS = 25
"""Points along each side of the cellular part at which intervals are counted."""


def one_seed(case: Mapping[str, Any], folder: Path) -> dict[str, float]:
    """Photograph and measure once more; the share of intervals that hold the noise-free result.

    Parameters
    ----------
    case
        ``name`` of the deformed photograph and ``seed``.
    folder
        Of a finished twin run (``twin/`` and ``harvest/``).

    Returns
    -------
    dict
        For v0, v1 and v1 phi1 the share of points covered, and the rms of the deviation over its
        standard deviation, which should be 1.
    """
    setup = _setup(folder, case["name"])
    found = setup.measured(setup.photographs(case["seed"]))
    clean, sd = setup.clean, setup.errors
    ansatz, at = found.ansatz, (setup.x, setup.y)
    pairs = {
        "v0": (ansatz.v0(found.unknowns, *at) - ansatz.v0(clean.unknowns, *at), sd.v0),
        "v1": (ansatz.v(0, found.unknowns, *at) - ansatz.v(0, clean.unknowns, *at), sd.v[0]),
        "v1phi1": (
            ansatz.fluctuation(0, found.unknowns, *at) - ansatz.fluctuation(0, clean.unknowns, *at),
            sd.fluctuation[0],
        ),
    }
    shares = {}
    for name, (deviation, error) in pairs.items():
        ratio = deviation[error > 0] / error[error > 0]
        shares[f"covered {name}"] = float(np.mean(np.abs(ratio) <= INTERVAL))
        shares[f"deviation {name}"] = float(np.sqrt(np.mean(ratio**2)))
    return shares


@dataclass(frozen=True, eq=False)
class _CoverageSetup:
    """All that does not depend on the seed: what a worker keeps."""

    twin: Twin
    harvesting: HarvestRun
    pair: ImagePair
    name: str
    blur_px: float
    start: Result
    clean: Result
    errors: FieldErrors
    x: FloatArray
    y: FloatArray

    def photographs(self, seed: int | None) -> tuple[FloatImage, FloatImage]:
        """Reference and deformed photograph with the noise of a seed, or none; undistorted."""
        spec, images = self.twin.images.spec, self.twin.images
        strain = min(images.strains, key=lambda e: abs(e - int(self.name.rsplit("_", 1)[1]) / 1e4))
        white = 2**spec.bits - 1
        taken = []
        for grey, label in (
            (images.reference(), "reference"),
            (images.deformed(strain), "deformed"),
        ):
            levels: NDArray[Any] = white * grey
            if seed is not None:
                sensor = replace(spec.sensor, shot_seed=1000 + seed, read_seed=2000 + seed)
                irradiance = ((grey - sensor.offset) / sensor.gain).astype(np.float32)
                levels = sensor.expose(irradiance, spec.bits, label)
            distortion = self.harvesting.optics.distortion
            image = levels.astype(np.float32)
            taken.append(image if distortion is None else undistorted(image, distortion))
        return taken[0], taken[1]

    def measured(self, images: tuple[FloatImage, FloatImage]) -> Result:
        """Correlate as the harvest finished, from the harvest's result on."""
        options = self.harvesting.case.correlation.options()
        finest = replace(options, levels=options.levels[-1:], final_smoothing_px=self.blur_px)
        pair, start = self.pair.with_images(*images), self.start
        return correlate(pair, start.ansatz, guess=start.unknowns, options=finest)


@lru_cache(maxsize=1)
def _setup(folder: Path, name: str) -> _CoverageSetup:
    twin = Twin(folder / "twin")
    case = PhotographCase.read(twin.experiment)
    harvesting = HarvestRun(case, folder / "harvest")
    prepared, measured = harvesting.prepared, harvesting.results()[name]
    pair = prepared.pair(name)
    box = harvesting.geometry.region.cellular
    x = np.linspace(box.x_min, box.x_max, _POINTS, dtype=np.float64)
    y = np.linspace(box.y_min, box.y_max, _POINTS, dtype=np.float64)
    result, noise = measured.result, image_noise(pair, prepared.noise)
    cell, edge_px = case.specimen.cell_size, case.correlation.edge_px
    by_noise = covariance(result, pair, noise, cell, edge_px).by_noise
    errors = field_errors(result, x, y, by_noise)
    assert result.final_smoothing is not None
    blur_px = result.final_smoothing.blur_px
    setup = _CoverageSetup(
        twin, harvesting, pair, name, blur_px, result, result, errors, x, y
    )  # fmt: skip
    return replace(setup, clean=setup.measured(setup.photographs(None)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("out/twin"))
    parser.add_argument("--name", default="deformed_1270")
    options = parser.parse_args()
    here = str(Path(__file__).parent)  # where workers find FUNCTION
    os.environ["PYTHONPATH"] = os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])
    TwinRun(
        Case.read("paper-real-twin"), options.folder, solution=shipped_solution("paper-real-twin")
    ).all()
    cases = grid({"name": options.name, "seed": 0}, seed=range(options.seeds))
    campaign = Campaign(FUNCTION, cases, options.folder.resolve())
    table = campaign.run(Workers(options.workers), lambda d, n, what: print(f"{d}/{n}", end="\r"))
    failed = int((table["error"] != "").sum())
    print(f"{len(table)} seeds of noise, {failed} failed; {options.name}")
    print(f"{'field':10}{'covered by 95 % intervals':>28}{'rms deviation / its sd':>26}")
    for field in ("v0", "v1", "v1phi1"):
        covered, deviation = table[f"covered {field}"].mean(), table[f"deviation {field}"]
        print(f"{field:10}{100 * covered:26.1f} %{(deviation**2).mean() ** 0.5:26.3f}")


if __name__ == "__main__":
    main()
