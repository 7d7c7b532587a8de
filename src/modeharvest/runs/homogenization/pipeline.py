"""A specimen homogenized with its lattice's modes, in stages that can be resumed.

::

    experiment/                    the virtual experiment: direct simulation, images, measured mode
    mode.json                      mode         as it was found, snapped to the lattice, error bars
    homogenized.json               homogenize   critical strain, forces, energies, sensitivities
    homogenized.h5                              the same states as fields
    report.html summary.json       report       beside the direct simulation
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modeharvest.fem.lattice.micromorphic.options import PlateLoading
from modeharvest.fem.lattice.micromorphic.patterns import ModeField, PlaneWaves, rotation_pattern
from modeharvest.fem.lattice.options import uniaxial
from modeharvest.idic.result import Result
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.uncertainty.covariance import Covariance, covariance
from modeharvest.idic.uncertainty.identifiability import identifiability
from modeharvest.imaging.imageset import ImageSet
from modeharvest.imaging.pair import ImagePair
from modeharvest.runs.experiment import Run
from modeharvest.runs.homogenization.case import (
    AnalyticMode,
    FileMode,
    HomogenizationCase,
    MeasuredMode,
)
from modeharvest.runs.homogenization.results import (
    HomogenizationData,
    HomogenizedFields,
    response_of,
    summary_of,
    write_fields,
)
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, requiring_dolfinx
from modeharvest.util.files import read_json, reading, sha256_of, write_json
from modeharvest.util.progress import named
from modeharvest.util.stages import StagedRun, exclusive, stage_key
from modeharvest.util.typed import picked, to_plain
from modeharvest.validation.homogenization import (
    LatticeMode,
    ModeParameters,
    ParameterEffect,
    Response,
    direct_response,
    with_errors,
)

if TYPE_CHECKING:
    from modeharvest.fem.lattice.cells import UnitCell
    from modeharvest.fem.lattice.micromorphic.branches import Homogenized
    from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody

_CRITICAL = "load kind negative_before negative_after"


@dataclass(frozen=True)
class HomogenizationRun(StagedRun[HomogenizationCase]):
    """The stages of a homogenized specimen.

    All raise InputError if the case can't be homogenized, and MissingDependencyError without
    dolfinx.
    """

    source: str = "CASE"
    """Name or file of the case, for the report."""

    @cached_property
    def virtual(self) -> Run:
        """The virtual experiment."""
        return Run(self.case.virtual, self.folder / "experiment", self.progress)

    def mode(self) -> tuple[LatticeMode | None, ModeParameters | None, tuple[str, ...]]:
        """The mode, the parameters it was measured with, and warnings; leaves ``mode.json``.

        None for a mode that is computed, and for parameters of one that is not measured.
        """
        path = self.folder / "mode.json"

        def work() -> tuple[Path, ...]:
            names = "mode", "parameters", "warnings"
            write_json(path, to_plain(dict(zip(names, self._found_mode(), strict=True))))
            return (path,)

        self.do("mode", self._mode_key, work)
        with reading(path, "a mode", "remove it"):
            content = read_json(path)
            mode, parameters = content["mode"], content["parameters"]
            found = mode and LatticeMode(*(PlaneWaves(**mode[k]) for k in ("measured", "snapped")))
            known = parameters and ModeParameters.of(parameters)
            return found, known, tuple(content["warnings"])

    def homogenize(self) -> dict[str, Any]:
        """Follow the homogenized specimen; leaves ``homogenized.json`` and ``.h5``."""
        path, fields = self.folder / "homogenized.json", self.folder / "homogenized.h5"
        mode, parameters, _ = self.mode()
        how = self.case.homogenization

        def work() -> tuple[Path, ...]:
            body = self._body(self._modes(mode))
            found = self._followed(body, "homogenized specimen")
            response, effects = response_of(found), tuple[ParameterEffect, ...]()
            if parameters is not None and how.error_bars:
                response, effects = with_errors(
                    response, parameters, self._mode_of, partial(self._predicted, what="error bars")
                )
            first = self._followed(self._body([]), "first order") if how.first_order else None
            write_json(path, to_plain({
                "response": response,
                "effects": effects,
                "criticals": [picked(c, _CRITICAL) for c in found.criticals],
                "first_order_critical_strain": first and first.critical and first.critical.load,
                "rves": body.point_count * len(body.rves),
                "linearisations": found.linearisations,
            }))  # fmt: skip
            write_fields(found, body, fields)
            return path, fields

        self.do("homogenize", self._homogenized_key, work)
        with reading(path, "a homogenized specimen", "remove it"):
            return dict(read_json(path))

    def report(self) -> dict[str, Any]:
        """Compare with the direct simulation; leaves ``report.html`` and ``summary.json``."""
        path, page = self.folder / "summary.json", self.folder / "report.html"

        def work() -> tuple[Path, ...]:
            from modeharvest.report.homogenization import homogenization_report
            from modeharvest.report.model import write_page

            data = self._data()
            summary = summary_of(self.case.title, self.case.plain(), data)
            write_page(homogenization_report(summary, data), page, self.progress)
            write_json(path, summary)
            return path, page

        self.do("report", stage_key([self._homogenized_key, self.case.title, self.source]), work)
        return dict(read_json(path))

    def all(self) -> dict[str, Any]:
        """All stages that are not finished; returns the content of ``summary.json``.

        Raises InputError if another process works in the folder.
        """
        with exclusive(self.folder):
            if isinstance(self.case.mode, MeasuredMode):
                self.virtual.all()
            self.homogenize()
            return self.report()

    # -- parts --------------------------------------------------------------------------

    @cached_property
    def _mode_key(self) -> str:
        plain, mode = self.case.plain(), self.case.mode
        depends: list[Any] = [plain["mode"]]
        if isinstance(mode, FileMode):
            depends.append(sha256_of(mode.path))
        if isinstance(mode, MeasuredMode):
            depends += [plain["experiment"], plain["imaging"], plain["correlation"]]
        return stage_key([*depends, plain["experiment"]["specimen"]])

    @cached_property
    def _homogenized_key(self) -> str:
        plain = self.case.plain()
        return stage_key([self._mode_key, plain["experiment"], plain["homogenization"]])

    @cached_property
    def _cell(self) -> UnitCell:
        """The RVE's mesh: 2 x 2 cells, a hole's centre at the origin."""
        with requiring_dolfinx("homogenization needs"):
            from modeharvest.fem.lattice.cells import square

            specimen = self.case.experiment.specimen
            size = self.case.homogenization.mesh_size
            return square(specimen.pitch, specimen.diameter, size).enlarged(2, 2)

    @cached_property
    def result(self) -> Result | None:
        """The correlation that the mode was measured by, if it was."""
        mode = self.case.mode
        if isinstance(mode, FileMode):
            return Result.read(mode.path)
        if not isinstance(mode, MeasuredMode):
            return None
        return self.virtual.correlate()[self._measured_strain]

    @property
    def _measured_strain(self) -> float:
        """Of the image that shows the mode [-]."""
        strains, strain = self.case.experiment.strains, getattr(self.case.mode, "strain", None)
        return strains[-1] if strain is None else float(strain)

    def _mode_of(self, parameters: FloatArray) -> LatticeMode:
        assert self.result is not None
        first = self.result.ansatz.modes[0]
        return LatticeMode.of(first, parameters, self.case.experiment.specimen, self._cell.lattice)

    def _found_mode(self) -> tuple[LatticeMode | None, ModeParameters | None, tuple[str, ...]]:
        result, specimen = self.result, self.case.experiment.specimen
        if isinstance(self.case.mode, AnalyticMode):
            ideal = rotation_pattern(specimen.pitch)
            return LatticeMode(ideal, ideal), None, ()
        if result is None:
            return None, None, ()
        if not result.ansatz.modes or not result.ansatz.modes[0].family.size:
            raise InputError("mode: expected a result with a free mode, got one without")
        pair = self._pair
        seen = identifiability(result, None if pair is None else pair.mask)
        try:
            mode = self._mode_of(result.mode_parameters())
        except InputError as error:
            if 0 not in seen.unobservable:
                raise
            raise InputError(f"mode: expected an image of the buckled specimen, got one in which "
                             f"{seen.warnings[0]}") from error  # fmt: skip
        return mode, self._parameters(result, pair), seen.warnings

    @property
    def _pair(self) -> ImagePair | None:
        """The images that the mode was measured in, if they are there."""
        if not isinstance(self.case.mode, MeasuredMode):
            return None
        images = ImageSet.read(self.virtual.folder / "images")
        return images.pair(self._measured_strain, camera=self.case.correlation.camera)

    def _parameters(self, result: Result, pair: ImagePair | None) -> ModeParameters:
        """With the covariances that the result, and its images where they are there, have."""
        family, part = result.ansatz.modes[0].family, result.ansatz.phi_slice(0)
        values, known = result.mode_parameters(), Covariance(result.covariance(), None)
        if pair is not None:
            noise, pitch = ImageNoise.of(result.noise_sd), self.case.experiment.specimen.pitch
            known = covariance(result, pair, noise, pitch, self.case.correlation.edge_px)
        both = (C if C is None else C[part, part] for C in (known.by_noise, known.by_model_error))
        return ModeParameters(family.names, family.units, values, *both)  # type: ignore[arg-type]

    def _modes(self, mode: LatticeMode | None) -> list[ModeField]:
        """phi in the RVE's coordinates; one that is not given is computed."""
        if mode is not None:
            return [mode.snapped]
        from modeharvest.fem.bloch.critical import critical_at
        from modeharvest.fem.bloch.real_modes import real_modes
        from modeharvest.fem.lattice.cell import CellPath, PeriodicCell
        from modeharvest.fem.lattice.cells import square

        experiment, size = self.case.experiment, self.case.homogenization.mesh_size
        specimen, loading = experiment.specimen, uniaxial(0)
        unit = square(specimen.pitch, specimen.diameter, size)
        cell = PeriodicCell(unit, experiment.material)
        critical = critical_at(CellPath(cell, loading), (np.pi, np.pi))
        return list(real_modes(cell, critical.state, [(np.pi, np.pi)]).shapes)

    def _body(self, modes: Sequence[ModeField]) -> HomogenizedBody:
        """The macroscopic finite elements with their RVEs."""
        experiment, how, cell = self.case.experiment, self.case.homogenization, self._cell
        from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody
        from modeharvest.fem.lattice.micromorphic.rve import RVE

        pitch, n = experiment.specimen.pitch, how.positions
        middle = 0.5 * pitch if how.centre == "junction" else 0.0
        places = middle + pitch * (np.arange(n) + 0.5 - 0.5 * n) / n
        rves = [
            RVE(cell, experiment.material, modes, centre, normalisation="given")
            for centre in product(places, places)
        ]
        loading = PlateLoading(
            plates=experiment.edges, quarter=how.quarter,
            pattern_at_plates=how.pattern_at_plates, pattern_at_bulk=how.pattern_at_bulk,
        )  # fmt: skip
        return HomogenizedBody.of_specimen(
            experiment.specimen, rves, loading, divisions=how.divisions
        )

    def _followed(self, body: HomogenizedBody, what: str) -> Homogenized:
        from modeharvest.fem.lattice.micromorphic.branches import homogenize

        experiment, progress = self.case.experiment, named(self.progress, what)
        return homogenize(body, experiment.strains, experiment.path, progress)

    def _predicted(self, mode: LatticeMode, what: str) -> Response:
        return response_of(self._followed(self._body([mode.snapped]), what))

    def _data(self) -> HomogenizationData:
        """All that the report shows."""
        found, (mode, parameters, warnings) = self.homogenize(), self.mode()
        fields = HomogenizedFields.read(self.folder / "homogenized.h5")
        return HomogenizationData(
            found=found,
            direct=direct_response(solution := self.virtual.fem()),
            path=solution.info["path"],
            mode=mode,
            parameters=parameters,
            warnings=warnings,
            fields=fields,
            measured=self.result if isinstance(self.case.mode, MeasuredMode) else None,
            measured_strain=self._measured_strain,
            command=f"modeharvest homogenize {self.source} --out {self.folder}",
        )
