"""A harvest of photographs in one folder, in stages that can be interrupted and resumed.

::

    distortion.json  calibration.json   optics      distortion S, if calibrated, and how
    prepared/                           prepare     undistorted photographs, masks
    results/NAME.json  NAME.npz         correlate   result, and the field it started from
    results/NAME_start.json                         description of the initial guess
    results/NAME_holes.csv  NAME_dots.csv           shapes of holes, if there is no speckle
    whole_field/NAME.h5  NAME.vtu                   whole displacements, if requested
    whole_field/NAME_refit.json                     the result's ansatz, refitted to them
    contours/NAME.json                  contours    results by contours beside speckle, if requested
    gauges.csv  gauges_along.csv                    readings of the gauges, if any
    report.html  summary.json           report      all results
    stages.json timings.json                        finished stages, and their durations
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.idic.chebyshev import Box, Brightness
from modeharvest.idic.correlate import correlate
from modeharvest.idic.finite_element.equations.continued import continued
from modeharvest.idic.finite_element.equations.system import Body
from modeharvest.idic.finite_element.files import Given, read_result
from modeharvest.idic.finite_element.light import UNEVEN, uneven_light
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.result import WholeField
from modeharvest.idic.local.field import read_field, write_field
from modeharvest.idic.photograph.axes import turned_sides
from modeharvest.idic.photograph.gauges import along_axes, points_of, reading_rows, write_gauges
from modeharvest.idic.photograph.geometry import Geometry, find_geometry
from modeharvest.idic.photograph.material import mixed_edge_px
from modeharvest.idic.photograph.measure import (
    MeasuredPhotograph,
    image_noise,
    measure,
    measure_whole,
    residual_test,
    warped_back,
    with_brightness,
)
from modeharvest.idic.photograph.plain.measure import measure_contours, write_shapes
from modeharvest.idic.photograph.plain.surface import (
    MaterialContours,
    away_from_cuts,
    plain_surface,
)
from modeharvest.idic.photograph.speckled_edges import (
    ByContours,
    body_for_edges,
    edges_of_speckled,
    measure_by_contours,
)
from modeharvest.idic.result import Covariance, Result
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.idic.solver.residual_test import ResidualTest
from modeharvest.idic.spectra.pattern import read_pattern
from modeharvest.idic.spectra.spectrum import measured_spectrum
from modeharvest.idic.uncertainty.covariance import covariance
from modeharvest.idic.uncertainty.identifiability import identifiability
from modeharvest.imaging.distortion.files import read_distortion
from modeharvest.imaging.pair import ImagePair
from modeharvest.runs.case import CaseModel
from modeharvest.runs.photographs import prepare
from modeharvest.runs.photographs.case import ContourTable, PhotographCase
from modeharvest.runs.photographs.prepare import Optics, PreparedPhotographs
from modeharvest.runs.photographs.results import (
    MOST_SHOWN,
    Harvest,
    HarvestedFrame,
    HarvestTruth,
    PartSpectrum,
    amplitude_of,
    error_fields,
    frame_numbers,
    harvest_summary,
    in_view,
    shown_moments,
)
from modeharvest.runs.photographs.sequence import named_files
from modeharvest.runs.whole_field import WholeFields, change_of, with_remedy
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import require_writable, sha256_of, write_json
from modeharvest.util.progress import Progress, counted, silent
from modeharvest.util.stages import StagedRun, command_line, digest, exclusive, stage_key, versions
from modeharvest.util.typed import picked, to_plain
from modeharvest.validation.onset import find_buckling, load_axis, mean_strain

_ALONG = 120
"""Number of points of error bars along the longer side; they are as smooth as the ansatz."""
_BOTH = "", "_speckle"
"""Suffixes of the file names of results by contours, and by speckle for comparison."""
_MUCH = 0.01
_UNEVEN = (
    "The light changed along the material, by {:.0f} %, which is taken for displacement: harvest "
    "with brightness = {} or {} in [correlation], or with --whole-field; light the specimen evenly."
)
_LEFT = (
    "{:.0f} % of the material has left the image: there v0 and v1 are extrapolated, with larger "
    "errors than their error bars say; the numbers of the pattern are those of the rest"
)


@dataclass(frozen=True)
class HarvestRun(StagedRun[PhotographCase]):
    """The stages of a harvest."""

    source: str = "EXPERIMENT.toml"
    """Path of the case's TOML file, for the report."""

    @cached_property
    def optics(self) -> Optics:
        """The lens; calibrating it writes ``distortion.json`` and ``calibration.json``."""
        table, base = self.case.distortion, self.case.base
        if table.file:
            return Optics(read_distortion(base / table.file))
        if not table.calibration:
            return Optics()
        files = named_files(base, table.calibration, unique=False)

        def work() -> tuple[Path, ...]:
            prepare.calibrate_lens(table, base, self.folder, self.progress)
            return self.folder / "distortion.json", self.folder / "calibration.json"

        key = stage_key([to_plain(table), [sha256_of(path) for path in files]], *prepare.CODE)
        self.do("optics", key, work)
        return prepare.calibrated_lens(self.folder)

    @cached_property
    def prepared(self) -> PreparedPhotographs:
        """Prepare the photographs for correlation; writes ``prepared/``."""
        folder = self.folder / "prepared"

        def work() -> tuple[Path, ...]:
            distortion = self.optics.distortion
            return prepare.prepare(self.case, folder, distortion, self.progress).files

        self.do("prepare", self._prepared_key(), work)
        return PreparedPhotographs.read(folder)

    @cached_property
    def geometry(self) -> Geometry:
        """Holes, lattice and cellular part of the specimen, found in the reference."""
        prepared, table = self.prepared, self.case.specimen
        mask = prepared.mask()
        if self._plain and self._plain.is_part:  # leave out a cell's width at the cuts
            mask = away_from_cuts(mask, prepared.grid, table.cell_size)
        return find_geometry(mask, prepared.grid, table, self.case.base)

    def results(self) -> Mapping[str, MeasuredPhotograph]:
        """Correlate every photograph, each starting from the one before; writes ``results/``.

        A photograph that can't be measured is left out (see :meth:`failures`), and the next starts
        from the last one measured. Raises InputError if none can be measured.
        """
        found, failed = self._correlated
        if not found:
            name, reason = next(iter(failed.items()))
            raise InputError(f"{name}: {reason}")
        return found

    @cached_property
    def _keys(self) -> dict[str, str]:
        """Keys of the correlation stages by photograph, each including those before it."""
        how, local, keys = self.case.plain(), self.case.local.files, {}
        whole = how["whole_field"] if self.case.whole_field.measure else None
        key = digest([self._prepared_key(), [how["correlation"], how["local"], whole]])
        fields = prepare.of_each_photograph(self.case, local, "local.files")
        for name in self.prepared.names:
            key = digest([key, name, sha256_of(fields[name]) if name in fields else ""])
            keys[name] = key
        return keys

    def failures(self) -> tuple[tuple[str, str], ...]:
        """Names of the photographs that were read but could not be measured, and why."""
        return tuple(self._correlated[1].items())

    def harvest(self, truth: HarvestTruth | None = None) -> Harvest:
        """All results of the test, for the report; ``truth``: if they are from a simulation."""
        case, prepared, region = self.case, self.prepared, self.geometry.region
        results, source = self.results(), Path(self.source)
        turned = () if case.specimen.angle else turned_sides(prepared.mask(), "specimen.angle =")
        known = Harvest(
            case, self.geometry, prepared.image(), (), prepared.noise,
            skipped=(*prepared.skipped, *self.failures()), optics=self.optics,
            full_scale=prepared.full_scale, text=(*prepared.notes, *region.text, *turned),
            warnings=(*prepared.warnings, *self.geometry.few_cells(case.specimen.cell_size)),
            truth=truth,
            command=command_line("harvest", self.source, "--out", self.folder),
            toml=source.read_text("utf-8") if source.is_file() else "",
            versions=versions(*prepare.LIBRARIES),
        )  # fmt: skip
        moments, numbers, kept = [], [], {}
        for name in counted(tuple(results), self.progress, "error bars"):
            frame = self._frame(name, results[name])
            moments.append(amplitude_of(frame, region.cellular))
            numbers.append(frame_numbers(replace(known, timeline=moments[-1:]), frame))
            if len(results) <= MOST_SHOWN:  # more might not fit into memory
                kept[name] = frame
        keys = "strain_x", "strain_y"
        along = keys[load_axis(np.array([[row[key] for key in keys] for row in numbers]))]
        numbers = [{**row, "strain": row[along]} for row in numbers]
        moments = [replace(m, strain=row[along]) for m, row in zip(moments, numbers, strict=True)]
        shown = [moments[k].name for k in shown_moments(moments)]
        frames = (kept.get(name) or self._frame(name, results[name]) for name in shown)
        return replace(
            known,
            frames=tuple(frames),
            numbers=tuple(numbers),
            timeline=moments,
            buckling=find_buckling(moments),
        )

    def all(self, truth: HarvestTruth | None = None) -> dict[str, Any]:
        """Run every stage that is not finished; returns the content of ``summary.json``.

        Raises InputError if another process works in the folder, the folder can't be written to, or
        no photograph can be measured.
        """
        with exclusive(self.folder):
            require_writable(self.folder)
            from modeharvest.report.model.output import write_page
            from modeharvest.report.photographs import photographs_report

            harvest = replace(self.harvest(truth), gauges=self._gauges())
            summary = harvest_summary(harvest)
            report = photographs_report(summary, harvest)
            write_page(report, self.folder / "report.html", self.progress)
            write_json(self.folder / "summary.json", summary)
        return summary

    # -- parts --------------------------------------------------------------------------

    @cached_property
    def _correlated(self) -> tuple[Mapping[str, MeasuredPhotograph], dict[str, str]]:
        """Measured photographs by name, and for each failed one the reason."""
        _ = self.geometry  # so that errors of the reference aren't reported for an image
        if self.case.gauges and self._plain is None and not self.case.whole_field.measure:
            raise InputError(
                "gauges: expected whole displacements, which they read, got none: give "
                "--whole-field, or set measure = true in [whole_field]"
            )
        for gauge in self.case.gauges:  # InputError first, if one is beside the material
            points_of(gauge, self.geometry.grid, self._mesh[0].mesh)

        def work(
            name: str, last: tuple[str, MeasuredPhotograph] | None
        ) -> tuple[Sequence[Path], dict[str, Any]]:
            result, field, _ = self._paths(name)
            if self._plain is not None:
                measured, files = self._by_contours(name, self._plain, last and last[1])
            else:
                measured, files = self._correlated_pair(name, last)
            write_field(field, measured.local)
            replace(measured.result, errors=self._errors(name, measured)).write(result)
            whole = measured.whole and measured.whole.start
            return (result, field, *files), {"whole": whole, **picked(measured, "text warnings")}

        def read(name: str, start: dict[str, Any]) -> MeasuredPhotograph:
            result, field, refit = self._paths(name)
            wholes, whole = self._wholes, None
            if start["whole"]:
                whole = WholeField(wholes.read(name), Result.read(refit), start["whole"])
            text, warnings = tuple(start["text"]), tuple(start["warnings"])
            return MeasuredPhotograph(Result.read(result), read_field(field), text, whole, warnings)

        return self.do_in_turn("correlate", self._keys, self.folder / "results", work, read)

    def _correlated_pair(
        self, name: str, last: tuple[str, MeasuredPhotograph] | None
    ) -> tuple[MeasuredPhotograph, Sequence[Path]]:
        """Correlate a photograph; with the files of its whole displacement, if requested."""
        case, pair = self.case, self._pair(name, last)
        local = prepare.local_field(case, self.prepared, name, self.optics.distortion)
        measured = measure(
            pair, self.geometry, case.specimen.cell_size, case.correlation, local,
            last and last[1], self.progress,
        )  # fmt: skip
        if not case.whole_field.measure:
            return measured, ()
        return self._with_whole(name, pair, measured)

    @cached_property
    def _beside(self) -> tuple[Mapping[str, ByContours], dict[str, str]]:
        """Modes by contours of speckled photographs, if requested; for failed ones the reason."""
        folder, grid, cell = self.folder / "contours", self.prepared.grid, self.case.specimen
        cell_px = cell.cell_size / grid.pixel_size
        if not self.case.contours.measure or self._plain is not None:
            return {}, {}

        @cache
        def reference() -> tuple[MaterialContours, Body]:
            mask = self.prepared.mask()
            edges = edges_of_speckled(self.prepared.image(), mask, cell_px)
            return edges, body_for_edges(mask, grid, cell_px)

        def work(name: str, _: object) -> tuple[Sequence[Path], dict[str, Any]]:
            (edges, body), paths = reference(), [folder / f"{name}{of}.json" for of in _BOTH]
            pair, speckle = self.prepared.pair(name), self.results()[name].result
            found = measure_by_contours(edges, pair, speckle, cell.cell_size, body, self.progress)
            if edges.is_part:  # other pixels give another fit: the ansatz doesn't describe w
                mask = away_from_cuts(pair.masks[0], grid, cell.cell_size)
                speckle = self._correlated_again(replace(pair, mask=mask), found.result)
            for path, result in zip(paths, (found.result, speckle), strict=True):
                result.write(path)
            return paths, picked(found, "edge_sd_px")

        def read(name: str, about: dict[str, Any]) -> ByContours:
            found, speckle = (Result.read(folder / f"{name}{of}.json") for of in _BOTH)
            return ByContours(found, speckle, about["edge_sd_px"])

        keys = {name: digest(["contours", self._keys[name]]) for name in self.results()}
        return self.do_in_turn("contours", keys, folder, work, read)

    def _correlated_again(self, pair: ImagePair, known: Result) -> Result:
        """Correlate a result's ansatz, starting from it, on the pair's pixels; with errors."""
        table = self.case.correlation
        (ansatz, a), how = with_brightness(known, table), table.options()
        how = replace(how, levels=how.levels[-1:])
        found = correlate(pair, ansatz, guess=a, options=how, progress=self.progress)
        return replace(found, errors=self._covariance(found, pair))

    @cached_property
    def _plain(self) -> MaterialContours | None:
        """The reference's contours if the specimen has no speckle, else None."""
        if not self.prepared.is_plain:
            return None
        if self.case.local.code != "none":
            raise InputError(
                f"local: expected code = 'none', got {self.case.local.code!r}: a specimen without "
                "speckle is measured by its contours; leave [local] out"
            )
        return plain_surface(self.prepared.image())

    def _by_contours(
        self, name: str, plain: MaterialContours, before: MeasuredPhotograph | None
    ) -> tuple[MeasuredPhotograph, Sequence[Path]]:
        """Measure a photograph by its contours; returns the result and its files."""
        case, (body, _) = self.case, self._mesh
        found, contours = measure_contours(
            plain, self.prepared.pair(name), name, self.geometry, case.specimen.cell_size,
            case.correlation, body, self.progress, before,
        )  # fmt: skip
        shapes = write_shapes(self.folder / "results", name, contours)
        return found, (*shapes, *self._whole_files(name, found))

    def _gauges(self) -> list[dict[str, Any]]:
        """Readings of the gauges in every whole displacement; writes ``gauges.csv``."""
        if not (wanted := along_axes(self.case.gauges, self.case.specimen.angle)):
            return []
        found = {name: self._wholes.path(name) for name, m in self.results().items() if m.whole}
        each = ((name, read_result(path, with_roots=True)) for name, path in found.items())
        return reading_rows(write_gauges(self.folder, wanted, each, "mm")) if found else []

    def _whole_files(self, name: str, found: MeasuredPhotograph) -> tuple[Path, ...]:
        """Write a whole displacement and the ansatz refitted to it; returns the files."""
        whole, refit = found.whole, self._paths(name)[-1]
        assert whole
        whole.refit.write(refit)
        return (*self._wholes.write(name, whole.measured, Given(correlation=found.result)), refit)

    @cached_property
    def _mesh(self) -> tuple[Body, FiniteElementOptions]:
        """The mesh of the reference's material, and the options of measuring on it."""
        mixed = mixed_edge_px(self.prepared.image(), self.prepared.mask())
        how = replace(self.case.whole_field.on_mesh(), edge_px=mixed)
        return how.body(self.prepared.mask(), self.prepared.grid), how

    def _with_whole(
        self, name: str, pair: ImagePair, first: MeasuredPhotograph
    ) -> tuple[MeasuredPhotograph, Sequence[Path]]:
        """Add the whole displacement to a correlated photograph; returns also its files.

        If it can't be measured, the photograph keeps its modes and gets a warning.
        """
        case = self.case
        try:
            with with_remedy(name):
                found = measure_whole(
                    pair, self.geometry, case.specimen.cell_size, case.correlation, first,
                    *self._mesh, self.prepared.noise, self.progress,
                )  # fmt: skip
        except InputError as error:
            return replace(first, warnings=(*first.warnings, str(error))), ()
        return found, self._whole_files(name, found)

    def _frame(self, name: str, measured: MeasuredPhotograph) -> HarvestedFrame:
        """One photograph's measurement, with its error bars and spectra."""
        case, geometry, result = self.case, self.geometry, measured.result
        pair, cell = self.prepared.pair(name), case.specimen.cell_size
        box = geometry.region.cellular
        x, y = _axes(geometry.region.domain)
        beside, why = self._beside
        test = ResidualTest(result.residual_correlation, result.pixels)
        if self._plain is None or not measured.whole:
            noise = image_noise(pair, self.prepared.noise)
            test = residual_test(result, pair, noise, case.correlation.edge_px)
        found = result.errors
        assert found is not None
        by_noise, by_model_error = error_fields(result, x, y)
        along, across = mean_strain(result, box, case.specimen.angle)
        spectrum = measured_spectrum(measured.local, cell, box)
        pattern = read_pattern(spectrum)
        known, w = measured.local, None
        parts = geometry.parts if len(geometry.parts) > 1 else {}
        own = {n: measured_spectrum(known, cell, box) for n, box in parts.items()}
        if case.whole_field.measure or self._plain is not None or case.local.code != "none":
            w = known.less(partial(result.ansatz.displacement_at, result.unknowns))
            own["w"] = measured_spectrum(w, cell, box)
        out = result.outside_image / max(1, result.pixels + result.outside_image)
        left = (_LEFT.format(100 * out),) * (out > _MUCH)
        if self._plain is None and out < 0.5 and result.outcome is not Outcome.REFITTED:
            degree = Brightness.of(case.correlation.brightness).degree or 0
            change = uneven_light(pair, result.displacement(), degree)
            left += (_UNEVEN.format(100 * change, degree + 1, degree + 2),) * (change > UNEVEN)
        seen = geometry.mask & in_view(result, pair.grid.x, pair.grid.y) if left else geometry.mask
        return HarvestedFrame(
            name=name, strain_x=along, strain_y=across, image=pair.deformed,
            mask=pair.deformed_mask, result=result,
            identifiability=identifiability(result, seen), residual_test=test, error_x=x,
            error_y=y, by_noise=by_noise, by_model_error=by_model_error,
            spectrum=spectrum, pattern=pattern,
            parts=tuple(PartSpectrum(name, s, read_pattern(s)) for name, s in own.items()), w=w,
            whole=measured.whole, contours=beside.get(name), rigid=self.prepared.rigid.get(name),
            start_text=tuple(s for s in measured.text if s not in pattern.text),
            warnings=(*left, *found.warnings, *measured.warnings,
                      *([why[name]] if name in why else ())),
        )  # fmt: skip

    def _errors(self, name: str, measured: MeasuredPhotograph) -> Covariance:
        """Covariances of a photograph's unknowns, by noise and by model error."""
        result = measured.result
        if self._plain is not None and measured.whole:
            return Covariance(result.covariance(), measured.whole.refit.covariance())
        return self._covariance(result, self.prepared.pair(name))

    def _covariance(self, result: Result, pair: ImagePair) -> Covariance:
        """Covariances of the unknowns of a correlated pair, by noise and by model error."""
        case, noise = self.case, image_noise(pair, self.prepared.noise)
        return covariance(result, pair, noise, case.specimen.cell_size, case.correlation.edge_px)

    def _pair(self, name: str, last: tuple[str, MeasuredPhotograph] | None) -> ImagePair:
        """The pair to correlate; "updated": with the last photograph, warped back."""
        pair = self.prepared.pair(name)
        if self.case.correlation.formulation != "updated" or last is None:
            return pair
        before, result, whole = last[0], last[1].result, last[1].whole
        image = continued(self.prepared.image(before), self.prepared.mask(before))
        u = whole.measured.displacement_on() if whole else None
        reference, inside = warped_back(image, result, result.order, u)
        return replace(pair, reference=reference, mask=self.prepared.mask() & inside)

    def _paths(self, name: str) -> tuple[Path, Path, Path]:
        results, refit = self.folder / "results", self._wholes.folder / f"{name}_refit.json"
        return results / f"{name}.json", results / f"{name}.npz", refit

    @property
    def _wholes(self) -> WholeFields:
        return WholeFields(self.folder / "whole_field")

    def _prepared_key(self) -> str:
        tables, files = self.case.plain(), prepare.all_files(self.case)
        wanted = {k: tables[k] for k in ("images", "scale", "specimen", "distortion", "noise")}
        del wanted["specimen"]["angle"]  # of strains and gauges alone
        return stage_key([wanted, [[path.name, sha256_of(path)] for path in files]], *prepare.CODE)


def harvest(
    case: str | Path | CaseModel, folder: Path | str, progress: Progress = silent,
    whole_field: bool | None = None, contours: bool | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Harvest modes from photographs of a test; what ``modeharvest harvest`` does.

    ``case``: the path of its TOML file, or the case itself; ``folder``: where files are written;
    ``whole_field``: whether to measure whole displacements; ``contours``: whether to also measure
    modes by contours beside speckle; both None for the case's own choice.
    Returns the content of ``summary.json``. Raises InputError if the case can't be used; if a file
    is missing, before anything is computed.
    """
    found = PhotographCase.of(case)
    beside = {} if contours is None else {"contours": ContourTable(contours)}
    found = found.model_copy(update=change_of(found.whole_field, whole_field) | beside)
    prepare.require_inputs(found := prepare.with_chosen_frames(found, Path(folder), progress))
    source = "CASE" if isinstance(case, CaseModel) else str(case)
    return HarvestRun(found, Path(folder), progress, source).all()


def _axes(domain: Box) -> tuple[FloatArray, FloatArray]:
    """x and y axes over the specimen, about equally dense [mm]."""
    across, up = (max(2, round(_ALONG * half / max(domain.half)) + 1) for half in domain.half)
    return (
        np.linspace(domain.x_min, domain.x_max, across, dtype=np.float64),
        np.linspace(domain.y_min, domain.y_max, up, dtype=np.float64),
    )
