"""What is told of a harvest: every result with its error bars, the spectra, the time line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.errors import InputError
from modeharvest.harvest.experiment import Experiment
from modeharvest.harvest.geometry import Geometry
from modeharvest.harvest.measure import Measured
from modeharvest.harvest.noise import GIVEN, estimated_noise
from modeharvest.harvest.optics import Optics
from modeharvest.harvest.pair import Pair
from modeharvest.harvest.prepare import Prepared
from modeharvest.idic.agreement import Agreement, autocorrelation, lags_for
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.compared import Compared
from modeharvest.idic.error_bars import (
    FieldErrors,
    field_errors,
    noise_covariance,
    softened,
)
from modeharvest.idic.families.pattern import read_pattern
from modeharvest.idic.fields.measured_spectrum import measured_spectrum
from modeharvest.idic.finish import blurred_pair
from modeharvest.idic.identifiability import identifiability
from modeharvest.idic.noise_transfer import ImageNoise
from modeharvest.idic.pull_back import pulled_back
from modeharvest.idic.pyramid import eroded
from modeharvest.idic.speckle_width import speckle_width
from modeharvest.progress import Progress, silent
from modeharvest.validation.harvest.run import Harvest, HarvestedFrame, HarvestTruth, PartSpectrum
from modeharvest.validation.harvest.timeline import Moment, find_buckling, mean_strain

FloatArray = NDArray[np.float64]

_ALONG = 120
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
    versions
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
        versions=versions,
    )


def _frame(
    experiment: Experiment, prepared: Prepared, geometry: Geometry, name: str, measured: Measured
) -> HarvestedFrame:
    result, image = measured.result, prepared.image(name)
    box = geometry.region.cellular
    cell = experiment.specimen.cell_size
    x, y = _axes(geometry.region.domain)
    noise = noise_of(prepared, name)
    by_noise, by_leftover, warnings = covariances(measured, _seen(prepared, name), noise, cell)
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
        agreement=_agreement(measured, prepared.image(), image, prepared, noise),
        error_x=x,
        error_y=y,
        by_noise=field_errors(result, x, y, by_noise),
        by_leftover=None if by_leftover is None else field_errors(result, x, y, by_leftover),
        noise_covariance=by_noise,
        leftover_covariance=by_leftover,
        spectrum=spectrum,
        pattern=pattern,
        parts=_parts(measured, geometry, cell),
        local=measured.local if experiment.local.code != "none" else None,
        start_sentences=tuple(s for s in measured.sentences if s not in pattern.sentences),
        warnings=warnings,
    )


def noise_of(prepared: Prepared, name: str) -> ImageNoise:
    """Noise of the reference and of a deformed photograph [grey levels].

    Unless it was given for both, the deformed one's is larger or smaller by as much as its finest
    details are: a lamp that has aged, or other exposure, shows there.
    """
    sd = prepared.noise.sd
    if prepared.noise.source == GIVEN:
        return ImageNoise(sd, sd)
    seen = _seen(prepared, name)
    in_f, in_g = (
        estimated_noise(image, np.ones(image.shape, dtype=np.bool_) if mask is None else mask).sd
        for image, mask in ((seen.reference, seen.mask), (seen.deformed, seen.deformed_mask))
    )
    return ImageNoise(sd, sd * in_g / in_f if in_f > 0.0 else sd)


def _parts(measured: Measured, geometry: Geometry, cell: float) -> tuple[PartSpectrum, ...]:
    """Spectra of the parts, where there are several."""
    if len(geometry.parts) == 1:
        return ()
    spectra = {p.name: measured_spectrum(measured.local, cell, p.box) for p in geometry.parts}
    return tuple(PartSpectrum(name, s, read_pattern(s)) for name, s in spectra.items())


def covariances(
    measured: Measured, pair: Pair, noise: ImageNoise, cell: float
) -> tuple[FloatArray, FloatArray | None, tuple[str, ...]]:
    """Covariances of the unknowns by the images' noise and by what the ansatz leaves over.

    Parameters
    ----------
    measured
        What came out of a photograph.
    pair
        That was correlated.
    noise
        Of the two photographs.
    cell
        Edge of the blocks that are taken for independent [mm].

    Returns
    -------
    by_noise, by_leftover, warnings
        (n, n) each; the second None where there are too few cells, which the warnings say.
    """
    result, blur, order = measured.result, measured.blur_px, measured.result.order
    images: tuple[NDArray[Any], NDArray[Any]] = pair.reference, pair.deformed
    if blur > 0.0:
        images = blurred_pair(*images, pair.mask, pair.deformed_mask, blur)
    seen = Compared.of(result, images, (pair.mask, pair.deformed_mask), _EDGE_PX)
    soft = seen.softness(result)
    by_noise = softened(result, noise, soft)
    try:
        by_leftover = seen.leftover_covariance(result, cell, soft)
        if blur > 0.0:
            by_noise = noise_covariance(
                result, seen.reference, seen.deformed, _noises(pair, blur, noise), seen.used,
                cell, order, soft,
            )  # fmt: skip
    except InputError as error:
        return by_noise, None, (f"No error bars for what the ansatz leaves over: {error}.",)
    return by_noise, by_leftover, ()


_EDGE_PX = 3
"""Pixels so near to a hole have no say in error bars [px]."""


def _noises(
    pair: Pair, blur: float, noise: ImageNoise
) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """What a blur makes of examples of white noise in both images."""
    rng = np.random.default_rng(0)
    quiet = blurred_pair(pair.reference, pair.deformed, pair.mask, pair.deformed_mask, blur)
    for _ in range(_EXAMPLES):
        f, g = (
            image + np.float32(sd) * rng.standard_normal(image.shape, dtype=np.float32)
            for image, sd in ((pair.reference, noise.reference), (pair.deformed, noise.deformed))
        )
        loud = blurred_pair(f, g, pair.mask, pair.deformed_mask, blur)
        yield loud[0] - quiet[0], loud[1] - quiet[1]


_EXAMPLES = 4
"""Examples of noise: with 100 cells a standard deviation is good to 4 %."""


def _seen(prepared: Prepared, name: str) -> Pair:
    return Pair(prepared.image(), prepared.image(name), prepared.mask(), prepared.mask(name))


def _agreement(
    measured: Measured, reference: NDArray[Any], image: NDArray[Any], prepared: Prepared,
    noise: ImageNoise,
) -> Agreement:  # fmt: skip
    """The residual of the photographs as they are against their noise, lit alike."""
    result = measured.result
    if measured.blur_px == 0.0:
        return result.agreement(noise)
    back, seen = pulled_back(image, result, result.order)
    used = eroded(prepared.mask(), _EDGE_PX) & seen
    f, g = reference[used], back[used]
    gain = np.cov(f, g)[0, 1] / g.var(dtype=np.float64)
    offset = f.mean(dtype=np.float64) - gain * g.mean(dtype=np.float64)
    residual = np.where(used, reference - np.float32(gain) * back - np.float32(offset), np.nan)
    rms = float(np.sqrt(np.nanmean(np.square(residual, dtype=np.float64))))
    lags = lags_for(speckle_width(reference, used))
    return Agreement.of(
        rms, autocorrelation(residual, lags), int(used.sum()), result.ansatz.size,
        result.residual_noise(noise), lags,
    )  # fmt: skip


def _moment(frame: HarvestedFrame, cellular: Box) -> Moment:
    seen, px = frame.identifiability, frame.result.grid.pixel_size
    return Moment(
        name=frame.name,
        strain=frame.strain_x,
        amplitude_px=float(np.linalg.norm(seen.amplitude_px)),
        leftover_px=seen.leftover_px,
        noise_px=_inside(frame.by_noise, frame.error_x, frame.error_y, cellular) / px,
    )


def _inside(errors: FieldErrors, x: FloatArray, y: FloatArray, box: Box) -> float:
    """Rms per component of the pattern's standard deviation over a box [mm]; 0 without a mode."""
    if not len(errors.fluctuation):
        return 0.0
    cols, rows = (box.x_min <= x) & (x <= box.x_max), (box.y_min <= y) & (y <= box.y_max)
    variance = (errors.fluctuation**2).sum(axis=0)[np.ix_(rows, cols)]
    return float(np.sqrt(np.mean(variance)))


def _axes(domain: Box) -> tuple[FloatArray, FloatArray]:
    """Positions over the specimen, about as dense both ways [mm]."""
    across, up = (max(2, round(_ALONG * half / max(domain.half)) + 1) for half in domain.half)
    return (
        np.linspace(domain.x_min, domain.x_max, across, dtype=np.float64),
        np.linspace(domain.y_min, domain.y_max, up, dtype=np.float64),
    )
