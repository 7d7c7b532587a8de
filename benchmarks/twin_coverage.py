"""Coverage of the twin's 95 % intervals over many seeds of the camera's noise.

Each seed photographs the twin again. A 95 % interval of a field, 1.96 standard deviations by noise
about the result of a photograph, should hold the noise-free result in 95 of 100
(docs/how-to/harvest.md). With --whole-field the whole displacement is measured in each; intervals
of u, by noise and smoothing, should hold the truth, and those of the refitted ansatz its best fit
to the truth. With --speckles each seed also has its own speckle and masks, because the effects of
smoothing and of edges depend on the speckle (docs/explanation/whole_field_accuracy.md).

Needs the twin's photographs and harvest (minutes), which it makes in out/twin unless they exist:
modeharvest run paper-real-twin --out out/twin. It continues where it was stopped.

Run: scripts/env python benchmarks/twin_coverage.py [--seeds 100] [--workers 2] [--folder out/twin]
     [--name deformed_1270] [--whole-field | --speckles]
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from modeharvest.fem.field import Solution
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.finite_element.result import refitted
from modeharvest.idic.photograph.displacement import displacement_from
from modeharvest.idic.photograph.measure import image_noise
from modeharvest.idic.result import Result
from modeharvest.idic.uncertainty.covariance import FieldErrors, covariance, field_errors
from modeharvest.imaging.distortion.lens import undistorted
from modeharvest.imaging.pair import ImagePair
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.runs.photographs.case import DistortionTable, PhotographCase
from modeharvest.runs.photographs.pipeline import HarvestRun
from modeharvest.runs.photographs.twin import Twin, TwinRun, make_twin
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.validation.campaign import Campaign, grid
from modeharvest.validation.workers import Workers

NOISE, WHOLE = "twin_coverage:one_seed", "twin_coverage:one_whole"
SPECKLE = "twin_coverage:one_speckle"
EDGE_PX = 10
SIZES = ["cutoff_px", "unknowns", "longest_px", "refit_px", "rms_px", "sd_px", "off_percent", "off"]
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
    return _shares(pairs)


def one_whole(case: Mapping[str, Any], folder: Path) -> dict[str, float]:
    """Photograph once more, measure the whole displacement, and compare it with the truth.

    For the parameters see :func:`one_seed`. Returns errors [px], the cut-off wavelength, the share
    of pixels, points and parameters covered, and the rms error over its standard deviation.
    """
    setup = _setup(folder, case["name"])
    return _whole(setup, setup.pair.with_images(*setup.photographs(case["seed"])))


def one_speckle(case: Mapping[str, Any], folder: Path) -> dict[str, float]:
    """Photograph another speckle and measure the whole displacement, as :func:`one_whole` does."""
    setup, name = _setup(folder, case["name"]), case["name"]
    with tempfile.TemporaryDirectory() as own:
        other = setup.with_speckle(case["seed"], Path(own))
        return _whole(other, other.harvesting.prepared.pair(name))


def _whole(setup: _CoverageSetup, pair: ImagePair) -> dict[str, float]:
    """Measure the whole displacement of a pair, and compare it with the truth."""
    (body, how), start = setup.harvesting._mesh, setup.start
    known, a = start.ansatz, start.unknowns
    gain, offset = known.gain_and_offset(a, pair.grid.x, pair.grid.y)
    pair = replace(pair, reference=((pair.reference - offset) / gain).astype(np.float32))
    found = displacement_from(known.displacement_at(a, body.mesh.nodes), pair, body, how)
    true, px = setup.true, pair.grid.pixel_size
    there = np.isfinite(true).all(axis=-1)
    apart = {"u": there, "u edges": there & (distance_transform_edt(there) <= EDGE_PX)}
    error, sd = found.displacement_on() - true, found.standard_deviation_on()
    got = {"cutoff_px": found.cutoff_px, "unknowns": found.effective_unknowns,
           "longest_px": float(np.linalg.norm(error[there], axis=-1).max()) / px}  # fmt: skip
    parts: dict[str, tuple[FloatArray, FloatArray]] = {}
    for name, where in apart.items():
        got[f"rms_px {name}"] = float(np.sqrt(np.mean(error[where] ** 2))) / px
        got[f"sd_px {name}"] = float(np.sqrt(np.mean(sd[where] ** 2))) / px
        parts[name] = error[where], sd[where]
    refit = refitted(found, known, a, setup.mask)
    best, at = setup.best, (setup.x, setup.y)
    apart_px = (refit.displacement() - best.displacement())[setup.mask] / px
    got["refit_px"] = float(np.sqrt(np.mean(apart_px**2)))
    errors = field_errors(refit, *at, refit.covariance())
    parts["v0"] = known.v0(refit.unknowns, *at) - known.v0(best.unknowns, *at), errors.v0
    for i, mode in enumerate(known.modes):
        v, v_best = (known.v(i, fit.unknowns, *at) for fit in (refit, best))
        parts[f"v{i + 1}"] = v - v_best, errors.v[i]
        got[f"off_percent v{i + 1}"] = 100.0 * float(abs(v - v_best).max() / abs(v_best).max())
        own, bars = known.phi_slice(i), np.sqrt(np.diag(errors.covariance))
        for name, k in zip(mode.family.names, range(own.start, own.stop), strict=True):
            off = refit.unknowns[k] - best.unknowns[k]
            parts[f"{name} of phi{i + 1}"] = np.array([off]), bars[[k]]
            got[f"off {name} of phi{i + 1}"] = float(off)
    return got | _shares(parts)


def _shares(parts: Mapping[str, tuple[FloatArray, FloatArray]]) -> dict[str, float]:
    """Share of each part's deviations within intervals, and their rms in standard deviations."""
    shares = {}
    for name, (deviation, error) in parts.items():
        ratio = deviation[error > 0] / error[error > 0]
        shares[f"covered {name}"] = float(np.mean(np.abs(ratio) <= INTERVAL))
        shares[f"deviation {name}"] = float(np.sqrt(np.mean(ratio**2)))
    return shares


@dataclass(frozen=True, eq=False)
class _CoverageSetup:
    """Data that do not depend on the seed, which a worker keeps."""

    twin: Twin
    harvesting: HarvestRun
    pair: ImagePair
    name: str
    blur_px: float
    start: Result
    errors: FieldErrors
    x: FloatArray
    y: FloatArray

    @property
    def strain(self) -> float:
        """The nominal strain in the photograph's name [-]."""
        of_name = int(self.name.rsplit("_", 1)[1]) / 1e4
        return min(self.twin.images.strains, key=lambda e: abs(e - of_name))

    @cached_property
    def true(self) -> FloatArray:
        """(rows, cols, 2) displacement [mm], NaN off the material."""
        return self.twin.images.truth(self.strain).displacement

    @cached_property
    def mask(self) -> BoolArray:
        """(rows, cols) True on material, as found in the reference, whose truth is known."""
        return self.harvesting.geometry.mask & np.isfinite(self.true).all(axis=-1)

    @cached_property
    def best(self) -> Result:
        """The best fit of the ansatz to the truth, at the pixels of the mask.

        With the ideal mask it differs by some 0.01 px, because the ansatz doesn't describe w.
        """
        start = self.start
        return fit_displacement(self.true, start.grid, start.ansatz, start.unknowns, self.mask)

    @cached_property
    def clean(self) -> Result:
        """The result of photographs without noise."""
        return self.measured(self.photographs(None))

    def photographs(self, seed: int | None) -> tuple[FloatImage, FloatImage]:
        """Reference and deformed photograph with the noise of a seed, or none; undistorted."""
        spec, images = self.twin.images.spec, self.twin.images
        white = 2**spec.bits - 1
        taken = []
        for grey, label in (
            (images.reference(), "reference"),
            (images.deformed(self.strain), "deformed"),
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

    def with_speckle(self, seed: int, folder: Path) -> _CoverageSetup:
        """The same specimen with another speckle, other noise, and masks found anew."""
        case, images = Case.read("paper-real-twin"), self.twin.images
        speckle, sensor = images.spec.speckle, images.spec.sensor
        assert speckle.ink is not None
        assert case.calibration is not None
        speckle = replace(speckle, seed=1000 + seed, ink=replace(speckle.ink, seed=2000 + seed))
        sensor = replace(sensor, shot_seed=1000 + seed, read_seed=2000 + seed)
        case = case.model_copy(update={
            "experiment": replace(case.experiment, strains=(self.strain,)),
            "imaging": replace(images.spec, speckle=speckle, sensor=sensor),
            "calibration": replace(case.calibration, shifts_px=((0.0, 0.0),)),
        })  # fmt: skip
        solution = Solution.read(self.twin.truth / "solution.h5")
        twin = make_twin(case, solution, folder / "twin")
        lens = DistortionTable(file=str((self.harvesting.folder / "distortion.json").resolve()))
        photographs = PhotographCase.read(twin.experiment).model_copy(update={"distortion": lens})
        return replace(self, twin=twin, harvesting=HarvestRun(photographs, folder / "harvest"))

    def measured(self, images: tuple[FloatImage, FloatImage]) -> Result:
        """Correlate with the last level of the harvest, starting from its result."""
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
    return _CoverageSetup(twin, harvesting, pair, name, blur_px, result, errors, x, y)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("out/twin"))
    parser.add_argument("--name", default="deformed_1270")
    parser.set_defaults(of=NOISE)
    parser.add_argument("--whole-field", action="store_const", const=WHOLE, dest="of")
    parser.add_argument("--speckles", action="store_const", const=SPECKLE, dest="of")
    options = parser.parse_args()
    here = str(Path(__file__).parent)  # where workers find FUNCTION
    os.environ["PYTHONPATH"] = os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])
    TwinRun(
        Case.read("paper-real-twin"), options.folder, solution=shipped_solution("paper-real-twin")
    ).all()
    cases = grid({"name": options.name, "seed": 0}, seed=range(options.seeds))
    campaign = Campaign(options.of, cases, options.folder.resolve())
    workers = Workers(options.workers, "8GiB")
    table = campaign.run(workers, lambda done, count, what: print(f"{done}/{count}", end="\r"))
    failed = int((table["error"] != "").sum())
    print(f"{len(table)} seeds of noise, {failed} failed; {options.name}")
    for name in table:
        if name.partition(" ")[0] in SIZES:
            column = table[name]
            print(f"{name:24} {column.mean():10.5f} +- {column.std():.5f}, largest "
                  f"{column.abs().max():.5f}")  # fmt: skip
    print(f"{'field':20}{'covered by 95 % intervals':>28}{'rms deviation / its sd':>26}")
    for field in (name.removeprefix("covered ") for name in table if name.startswith("covered ")):
        covered, deviation = table[f"covered {field}"].mean(), table[f"deviation {field}"]
        print(f"{field:20}{100 * covered:26.1f} %{(deviation**2).mean() ** 0.5:26.3f}")


if __name__ == "__main__":
    main()
