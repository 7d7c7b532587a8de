"""What is told of a harvest: every result with its error bars, the spectra, the time line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.harvest.experiment import Experiment
from modeharvest.harvest.geometry import Geometry
from modeharvest.harvest.measure import Measured
from modeharvest.harvest.optics import Optics
from modeharvest.harvest.prepare import Prepared
from modeharvest.harvest.timeline import Moment, find_buckling, mean_strain
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.error_bars import FieldErrors, field_errors, leftover_covariance
from modeharvest.idic.identifiability import identifiability
from modeharvest.idic.measured_spectrum import measured_spectrum
from modeharvest.idic.pattern import read_pattern
from modeharvest.progress import Progress, silent
from modeharvest.validation.harvest_run import Harvest, HarvestedFrame, HarvestTruth

FloatArray = NDArray[np.float64]

_ALONG = 48
"""Points of the error bars along the longer side: they are as smooth as the ansatz."""


def harvest_of(
    experiment: Experiment,
    prepared: Prepared,
    geometry: Geometry,
    optics: Optics,
    results: Mapping[str, Measured],
    *,
    skipped: tuple[tuple[str, str], ...] = (),
    truth: HarvestTruth | None = None,
    source: str,
    folder: Path,
    timings: Mapping[str, float],
    versions: Mapping[str, str],
    progress: Progress = silent,
) -> Harvest:
    """Gather what a harvest found.

    Parameters
    ----------
    experiment, prepared, geometry, optics, results
        The stages' outcomes.
    skipped
        Names of photographs that were not used, and why.
    truth
        Of photographs made by a simulation.
    source, folder
        The experiment's file and the folder of the harvest, for the command to make it again.
    timings, versions
        For the record.
    progress
        Listener.
    """
    frames, moments = [], []
    for k, (name, measured) in enumerate(results.items()):
        progress(k, len(results), "error bars")
        frame = _frame(experiment, prepared, geometry, name, measured)
        frames.append(frame)
        moments.append(_moment(frame, geometry.region.cellular))
    noise, path = prepared.noise, Path(source)
    return Harvest(
        title=experiment.title or "Photographs of a test",
        experiment=experiment.plain(),
        grid=prepared.grid,
        reference=prepared.image(),
        mask=prepared.mask(),
        cellular=geometry.region.cellular,
        domain=geometry.region.domain,
        frames=tuple(frames),
        noise_sd=noise.sd,
        noise_source=noise.source,
        lattice=geometry.lattice,
        skipped=skipped,
        timeline=tuple(moments),
        buckling=find_buckling(moments),
        calibration=optics.calibration,
        distortion=optics.distortion,
        full_scale=float(prepared.info["full_scale"]),
        sentences=(*prepared.info["notes"], *geometry.region.sentences),
        truth=truth,
        command=f"modeharvest harvest {source} --out {folder}",
        toml=path.read_text("utf-8") if path.is_file() else "",
        timings=timings,
        versions=versions,
    )


def _frame(
    experiment: Experiment, prepared: Prepared, geometry: Geometry, name: str, measured: Measured
) -> HarvestedFrame:
    result, image = measured.result, prepared.image(name)
    how, box = experiment.correlation, geometry.region.cellular
    cell, noise_sd = experiment.specimen.cell_size, prepared.noise.sd
    x, y = _axes(geometry.region.domain)
    leftover, warnings = None, []
    try:
        leftover = leftover_covariance(
            result, prepared.image(), image, prepared.mask(), cell, how.order
        )
    except InputError as error:
        warnings.append(f"No error bars for what the ansatz leaves over: {error}.")
    seen = identifiability(result, prepared.mask())
    along, across = mean_strain(result, box)
    spectrum = measured_spectrum(measured.local, cell, box)
    pattern = read_pattern(spectrum)
    return HarvestedFrame(
        name=name,
        strain_x=along,
        strain_y=across,
        image=image,
        mask=prepared.mask(name),
        result=result,
        identifiability=seen,
        agreement=result.agreement(noise_sd, order=how.order),
        error_x=x,
        error_y=y,
        by_noise=field_errors(result, x, y, result.covariance(noise_sd)),
        by_leftover=None if leftover is None else field_errors(result, x, y, leftover),
        leftover_covariance=leftover,
        spectrum=spectrum,
        pattern=pattern,
        local=measured.local if experiment.local.code != "none" else None,
        start_sentences=tuple(s for s in measured.sentences if s not in pattern.sentences),
        warnings=tuple(warnings),
    )


def _moment(frame: HarvestedFrame, cellular: Box) -> Moment:
    seen, px = frame.identifiability, frame.result.grid.pixel_size
    return Moment(
        name=frame.name,
        strain=frame.strain_x,
        amplitude_px=seen.amplitude_px[0] if seen.amplitude_px else 0.0,
        leftover_px=seen.leftover_px,
        noise_px=_inside(frame.by_noise, frame.error_x, frame.error_y, cellular) / px,
    )


def _inside(errors: FieldErrors, x: FloatArray, y: FloatArray, box: Box) -> float:
    """Rms per component of the pattern's standard deviation over a box [mm]; 0 without a mode."""
    if not len(errors.fluctuation):
        return 0.0
    cols, rows = (box.x_min <= x) & (x <= box.x_max), (box.y_min <= y) & (y <= box.y_max)
    part = errors.fluctuation[0][np.ix_(rows, cols)]
    return float(np.sqrt(np.mean(part**2)))


def _axes(domain: Box) -> tuple[FloatArray, FloatArray]:
    """Positions over the specimen, about as dense both ways [mm]."""
    across, up = (max(2, round(_ALONG * half / max(domain.half)) + 1) for half in domain.half)
    return (
        np.linspace(domain.x_min, domain.x_max, across, dtype=np.float64),
        np.linspace(domain.y_min, domain.y_max, up, dtype=np.float64),
    )
