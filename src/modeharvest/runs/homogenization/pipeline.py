"""Homogenization of a specimen with the modes of its lattice, in stages that can be resumed.

::

    experiment/                    the virtual experiment: direct simulation, images, measured mode
    mode.json                      mode         as measured, snapped to the lattice, error bars
    homogenized.json               homogenize   critical strain, forces, energies, sensitivities
    homogenized.h5                              the same states as fields
    rve.h5 rve.mat                              the RVE with modes and moduli, for other codes;
                                                with several positions rve2, rve3, ... too
    report.html summary.json       report       compared with the direct simulation
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modeharvest.fem.bloch.modes import ModeSet, read_modes
from modeharvest.fem.lattice.micromorphic.body import quadrature
from modeharvest.fem.lattice.micromorphic.patterns import ModeField, PlaneWaves, rotation_pattern
from modeharvest.fem.lattice.options import MacroLoading
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.modes import FAMILIES
from modeharvest.idic.result import Covariance, Result
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.spectra.mode_family import FORMAT as FAMILY_FORMAT
from modeharvest.idic.spectra.mode_family import read_family
from modeharvest.idic.uncertainty.covariance import covariance
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
from modeharvest.runs.homogenization.export import write_fe2, write_rve
from modeharvest.runs.homogenization.results import (
    HomogenizationData,
    HomogenizedFields,
    not_reached,
    response_of,
    summary_of,
    write_fields,
)
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, requiring_dolfinx
from modeharvest.util.files import read_json, reading, sha256_of, write_json
from modeharvest.util.machine import on_first
from modeharvest.util.progress import named
from modeharvest.util.stages import StagedRun, command_line, exclusive, stage_key
from modeharvest.util.typed import picked, to_plain
from modeharvest.validation.homogenization import (
    LatticeMode,
    MeasuredModes,
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
    from modeharvest.fem.lattice.micromorphic.path import HomogenizedState
    from modeharvest.fem.lattice.micromorphic.rve import RVEState

_FAR = 3.44
"""Standard deviations by which snapping may change a wave vector; by chance two components exceed
it in 0.27 % of cases, as one component exceeds 3."""
_SAME = 0.01
"""Tolerance [-] between cells of the same lattice, for lattice vectors and solid share, and for the
length of a wave without standard deviations; for the right lattice it was 0.7 % at most."""
_CRITICAL = "load kind negative_before negative_after"
_WAVES = {"square": [(np.pi, np.pi)], "triangular": [(np.pi, 0.0), (0.0, np.pi), (np.pi, np.pi)]}
"""Phases of the modes along a1 and a2 [rad], by stacking, in the order of ``FAMILIES``."""

FoundModes = tuple[tuple[LatticeMode, ...], ModeParameters | None, tuple[str, ...]]


@dataclass(frozen=True)
class HomogenizationRun(StagedRun[HomogenizationCase]):
    """Runs the stages of a homogenized specimen.

    All raise InputError if the case can't be homogenized, and MissingDependencyError without
    dolfinx.
    """

    source: str = "CASE"
    """Name or file of the case, for the report."""

    @cached_property
    def virtual(self) -> Run:
        """The run of the virtual experiment, in the folder ``experiment``."""
        return Run(self.case.virtual, self.folder / "experiment", self.progress)

    def mode(self) -> FoundModes:
        """The modes, their measured parameters, and warnings; writes ``mode.json``.

        Modes are empty if they are computed, parameters are None if they are not measured.
        """
        path = self.folder / "mode.json"

        def work() -> tuple[Path, ...]:
            names = "modes", "parameters", "warnings"
            write_json(path, to_plain(dict(zip(names, self._found_modes(), strict=True))))
            return (path,)

        _ = self.result  # a separate stage, in which all ranks take part
        self.do("mode", self._mode_key, work)
        with reading(path, "a mode", "remove it"):
            content = read_json(path)
            parts = "measured", "snapped"
            found = [LatticeMode(*(PlaneWaves(**m[k]) for k in parts)) for m in content["modes"]]
            known = content["parameters"] and ModeParameters.of(content["parameters"])
            return tuple(found), known, tuple(content["warnings"])

    def homogenize(self) -> dict[str, Any]:
        """Simulate the homogenized specimen; writes ``homogenized.json``, ``.h5``, and its RVEs.

        Under mpirun the RVEs are distributed over the ranks.
        """
        path, fields = self.folder / "homogenized.json", self.folder / "homogenized.h5"
        modes, parameters, _ = self.mode()
        how = self.case.homogenization

        def work() -> tuple[Path, ...]:
            body = self._body(self._fields(modes))
            found = self._followed(body, "homogenized specimen")
            response, effects = response_of(found), tuple[ParameterEffect, ...]()
            measured = MeasuredModes(parameters, self._modes_of) if parameters else None
            if measured and how.error_bars:
                response, effects = with_errors(response, measured, self._predicted)
            first = self._followed(self._body([]), "first order") if how.first_order else None
            content = to_plain({
                "response": response,
                "effects": effects,
                "criticals": [picked(c, _CRITICAL) for c in found.criticals],
                "branches": [
                    {"pattern": pattern, **picked(s, "load energy negative_eigenvalues")}
                    for pattern, s in found.ranked
                ],
                "first_order_critical_strain": first and first.critical and first.critical.load,
                "edge_shifts_mm": self._edge_shifts,
                "rves": body.point_count * len(body.rves),
                "linearisations": found.linearisations,
            })  # fmt: skip
            on_first(lambda: write_json(path, content))
            write_fields(found, body, fields)
            return path, fields, *self._exported(found, body, measured)

        self.do("homogenize", self._homogenized_key, work, collective=True)
        with reading(path, "a homogenized specimen", "remove it"):
            return dict(read_json(path))

    def report(self) -> dict[str, Any]:
        """Compare with the direct simulation; writes ``report.html`` and ``summary.json``."""
        path, page = self.folder / "summary.json", self.folder / "report.html"
        data = self._data()

        def work() -> tuple[Path, ...]:
            from modeharvest.report.homogenization import homogenization_report
            from modeharvest.report.model.output import write_page

            summary = summary_of(self.case.title, self.case.plain(), data)
            write_page(homogenization_report(summary, data), page, self.progress)
            write_json(path, summary)
            return path, page

        self.do("report", stage_key([self._homogenized_key, self.case.title, self.source]), work)
        return dict(read_json(path))

    def all(self) -> dict[str, Any]:
        """Run all unfinished stages; returns the content of ``summary.json``.

        Raises InputError if another process works in the folder.
        """
        with exclusive(self.folder):
            if isinstance(self.case.mode, MeasuredMode):
                self.virtual.all()
            return self.report()

    # -- parts --------------------------------------------------------------------------

    @cached_property
    def _mode_key(self) -> str:
        plain, mode = self.case.plain(), self.case.mode
        depends: list[Any] = [plain["mode"]]
        if isinstance(mode, FileMode):
            depends += map(sha256_of, mode.files)
        if isinstance(mode, MeasuredMode):
            depends += [plain["experiment"], plain["imaging"], plain["correlation"]]
        return stage_key([*depends, plain["experiment"]["specimen"]])

    @cached_property
    def _homogenized_key(self) -> str:
        plain = self.case.plain()
        own = [plain[name] for name in ("experiment", "homogenization", "loading")]
        mesh = self.case.homogenization.mesh
        return stage_key([self._mode_key, *own, mesh and sha256_of(mesh)])

    @cached_property
    def _cell(self) -> UnitCell:
        """The RVE: the cell of the modes' file, or else 2 x 2 cells with a hole at the origin."""
        with requiring_dolfinx("homogenization needs"):
            from modeharvest.fem.lattice.cells import UnitCell
        if (given := self._computed) is not None:
            return UnitCell(given.mesh, given.lattice)
        return self._primitive.enlarged(2, 2)

    @cached_property
    def _computed(self) -> ModeSet | None:
        """Modes in a file of ``modeharvest modes``, checked unless a mesh is given; or None."""
        mode, specimen = self.case.mode, self.case.experiment.specimen
        if not (isinstance(mode, FileMode) and mode.is_computed):
            return None
        given, count = read_modes(mode.path)[0], max(mode.numbers, default=1)
        if count > len(given.shapes):
            raise InputError(f"{mode.path}: expected {count} modes, got {len(given.shapes)}")
        steps = given.primitive @ np.linalg.inv(specimen.vectors)
        share = quadrature(given.mesh, 3).weights.sum() / abs(np.linalg.det(given.lattice))
        wanted = 1 - np.pi * specimen.diameter**2 / 4 / abs(np.linalg.det(specimen.vectors))
        is_same = np.abs(steps - np.rint(steps)).max() < _SAME > abs(abs(np.linalg.det(steps)) - 1)
        if self.case.homogenization.mesh is None and not (is_same and abs(share - wanted) < _SAME):
            what = f"{mode.path}: expected modes of the specimen's lattice, {wanted:.1%} solid"
            got = f"vectors {given.primitive.round(4).tolist()} mm, {share:.1%} solid"
            remedy = "compute them for this specimen, or give a mesh of another body"
            raise InputError(f"{what}, got modes of a cell with {got}; {remedy}")
        return given

    @cached_property
    def _families(self) -> list[PlaneWaves]:
        """Waves of the modes given as mode families, in the lattice's coordinates; or none."""
        mode, pitch = self.case.mode, self.case.experiment.specimen.pitch
        if not isinstance(mode, FileMode) or mode.is_computed:
            return []
        content = read_json(mode.files[0])
        if not isinstance(content, dict) or content.get("format") != FAMILY_FORMAT:
            return []
        found, count = [read_family(path) for path in mode.files], max(mode.numbers, default=1)
        if len(found) < count or any(abs(f.pitch / pitch - 1.0) > _SAME for f in found):
            got = f"{len(found)} with {', '.join(f'{f.pitch:g}' for f in found)} mm"
            what = f"{count} or more families of the specimen's pitch, {pitch:g} mm"
            raise InputError(f"{mode.path}: expected {what}, got {got}")
        numbers = mode.numbers or range(1, len(found) + 1)
        return [PlaneWaves.of_sines(found[k - 1].waves, found[k - 1].pitch) for k in numbers]

    @cached_property
    def _primitive(self) -> UnitCell:
        """The primitive cell of the specimen's lattice, with a hole's centre at the origin."""
        with requiring_dolfinx("homogenization needs"):
            from modeharvest.fem.lattice.cells import hexagonal, square

            specimen = self.case.experiment.specimen
            of = hexagonal if specimen.is_staggered else square
            return of(specimen.pitch, specimen.diameter, self.case.homogenization.mesh_size)

    @property
    def _vectors(self) -> FloatArray:
        """(2, 2) primitive vectors of the lattice, as rows [mm]."""
        given = self._computed
        return self.case.experiment.specimen.vectors if given is None else given.primitive

    @cached_property
    def result(self) -> Result | None:
        """Result of the correlation that measured the mode; None if it is not measured."""
        mode = self.case.mode
        if isinstance(mode, FileMode):
            return None if mode.is_computed or self._families else Result.read(mode.path)
        if not isinstance(mode, MeasuredMode):
            return None
        return self.virtual.correlate()[self._measured_strain]

    @property
    def _measured_strain(self) -> float:
        """Nominal strain of the image in which the mode is measured [-]."""
        strains, strain = self.case.experiment.strains, getattr(self.case.mode, "strain", None)
        return strains[-1] if strain is None else float(strain)

    @property
    def _numbers(self) -> tuple[int, ...]:
        """Numbers of the modes to use, from 0."""
        specimen, given = self.case.experiment.specimen, self._computed
        every = range(len(FAMILIES[specimen.stacking](specimen) if given is None else given.shapes))
        return tuple(k - 1 for k in self.case.mode.numbers) or tuple(every)

    def _modes_of(self, parameters: FloatArray) -> tuple[LatticeMode, ...]:
        """The measured modes to use; ``parameters``: those of all these modes, concatenated."""
        assert self.result is not None
        modes, given = self.result.ansatz.modes, list(parameters)
        specimen, found = self.case.experiment.specimen, list[LatticeMode]()
        for k in self._numbers:
            own = [given.pop(0) for _ in range(modes[k].family.size)]
            try:
                found.append(LatticeMode.of(modes[k], own, specimen, self._cell.lattice))
            except InputError as error:
                raise InputError(f"phi{k + 1}: {error}") from error
        # Modes of one stacking are images of each other, a hole's centre fixed.
        waves, size = [mode.snapped for mode in found], np.linalg.norm
        parities = ["odd" if size(w.sine) > size(w.cosine) else "even" for w in waves]
        if len(set(parities)) > 1:
            what = "modes: expected all of them to be odd about a hole's centre or all even, got"
            raise InputError(f"{what} {', '.join(parities)}; leave out what is not observable")
        return tuple(found)

    def _found_modes(self) -> FoundModes:
        result, specimen, vectors = self.result, self.case.experiment.specimen, self._cell.lattice
        if isinstance(self.case.mode, AnalyticMode) and not specimen.is_staggered:
            ideal = rotation_pattern(specimen.pitch)
            return (LatticeMode(ideal, ideal),), None, ()
        if isinstance(self.case.mode, AnalyticMode):
            every = Ansatz.of_specimen(specimen).modes
            ideals = [(every[k], every[k].family.start) for k in self._numbers]
            return tuple(LatticeMode.of(*s, specimen, vectors) for s in ideals), None, ()
        if self._families:
            given = tuple(LatticeMode.of_waves(w, vectors) for w in self._families)
            return given, None, self._far_waves(given)
        if result is None:
            return (), None, ()
        modes, numbers = result.ansatz.modes, self._numbers
        if len(modes) <= max(numbers) or not all(modes[k].family.size for k in numbers):
            free = sum(mode.family.size > 0 for mode in modes)
            what = f"{max(numbers) + 1} free mode(s), as {specimen.stacking} stacking has"
            got = f"{free} of {len(modes)}; give the numbers of those to use"
            raise InputError(f"mode: expected a result with {what}, got {got}")
        pair: ImagePair | None = None  # in which the mode was measured, if available
        if isinstance(self.case.mode, MeasuredMode):
            images = ImageSet.read(self.virtual.folder / "images")
            pair = images.pair(self._measured_strain, camera=self.case.correlation.camera)
        parameters = self._parameters(result, pair)
        seen = identifiability(result, None if pair is None else pair.mask)
        try:
            found = self._modes_of(parameters.values)
        except InputError as error:
            lost = [k for k, at in enumerate(seen.unobservable) if at in numbers]
            if not lost:
                raise
            raise InputError(f"mode: expected an image of the buckled specimen, got one in which "
                             f"{seen.warnings[lost[0]]}; {error}") from error  # fmt: skip
        parameters = replace(parameters, deviations=self._deviations(found, parameters))
        return found, parameters, (*seen.warnings, *self._far_waves(found, parameters.deviations))

    def _deviations(
        self, found: Sequence[LatticeMode], parameters: ModeParameters
    ) -> tuple[float, ...]:
        """Largest change of a wave vector by snapping, for each mode [standard deviations]."""
        assert self.result is not None
        if parameters.by_model_error is None:
            return ()
        own = [self.result.ansatz.modes[k] for k in self._numbers]
        last = np.cumsum([mode.family.size for mode in own])
        parts = np.split(np.arange(last[-1]), last[:-1])
        return tuple(
            mode.deviation(m, parameters.by_model_error[np.ix_(part, part)])
            for mode, m, part in zip(found, own, parts, strict=True)
        )

    def _far_waves(
        self, found: Sequence[LatticeMode], deviations: Sequence[float] = ()
    ) -> tuple[str, ...]:
        """Refuse modes that snapping changed by more than error bars allow; or return warnings."""
        warnings = list[str]()
        for k, mode in enumerate(found):
            change, most = float(mode.wave_change.max()), f"{_SAME:.0%} of their lengths"
            is_far, got = change > _SAME, f"one {change:.2%} off, model error unknown"
            if deviations:
                is_far, most = deviations[k] > _FAR, f"{_FAR:g} of their standard deviations"
                got = f"one {deviations[k]:.1f} of them ({change:.2%}) off"
            if is_far:
                what = f"phi{k + 1}: expected wave vectors within {most} of the lattice's"
                warnings.append(f"{what}, got {got}: is this its lattice?")
        if warnings and not getattr(self.case.mode, "snap_anyway", False):
            raise InputError(f"{warnings[0]} If so, set snap_anyway = true in [mode]")
        return tuple(warnings)

    def _parameters(self, result: Result, pair: ImagePair | None) -> ModeParameters:
        """Mode parameters with covariances, of the result and, if given, its images."""
        known, ansatz = result.errors or Covariance(result.covariance(), None), result.ansatz
        if pair is not None:
            images, pitch = ImageNoise.of(result.noise_sd), self.case.experiment.specimen.pitch
            known = covariance(result, pair, images, pitch, self.case.correlation.edge_px)
        at = np.concatenate([np.arange(result.unknowns.size)[ansatz.phi_slice(k)]
                             for k in self._numbers])  # fmt: skip
        both, every = (known.by_noise, known.by_model_error), np.ix_(at, at)
        prefix = "" if len(self._numbers) > 1 else f"phi{self._numbers[0] + 1}."
        names = tuple(result.names[k].removeprefix(prefix) for k in at)
        units, larger = tuple(ansatz.units[k] for k in at), both[known.by_model_error is not None]
        noise, error = (C if C is None else C[every] for C in both)
        return ModeParameters(names, units, result.unknowns[at], noise, error, larger)  # type: ignore[arg-type]

    def _fields(self, modes: Sequence[LatticeMode]) -> list[ModeField]:
        """Mode fields phi in the RVE's coordinates; computed if no modes are given."""
        if modes:
            return [mode.snapped for mode in modes]
        if self._computed is not None:
            return [self._computed.shapes[k] for k in self._numbers]
        from modeharvest.fem.bloch.critical import critical_at
        from modeharvest.fem.bloch.real_modes import real_modes
        from modeharvest.fem.lattice.cell import CellPath, PeriodicCell

        cell, path = PeriodicCell(self._primitive, self.case.experiment.material), self.case.plates
        side = None if path.sides == "free" else -path.lateral
        pushed = -path.compression - abs(path.bending)
        lattice = CellPath(cell, MacroLoading(((pushed, 0.0), (path.shear, side))))
        waves = _WAVES[self.case.experiment.specimen.stacking]
        found = [c for c in (critical_at(lattice, wave) for wave in waves) if c.found]
        if not found:
            raise InputError("mode: expected a lattice that buckles under the load, got one that "
                             "does not; take another kind of mode or another load")  # fmt: skip
        state = min(found, key=lambda c: c.load).state
        return list(real_modes(cell, state, [waves[k] for k in self._numbers]).shapes)

    def _body(self, modes: Sequence[ModeField]) -> HomogenizedBody:
        """The macroscopic finite element model with its RVEs."""
        experiment, how, cell = self.case.experiment, self.case.homogenization, self._cell
        from modeharvest.fem.lattice.micromorphic.body import read_body_mesh
        from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody
        from modeharvest.fem.lattice.micromorphic.rve import RVE, spread_positions

        specimen, half = experiment.specimen, 0.5 * experiment.specimen.pitch
        junction = half, half / np.sqrt(3.0) if specimen.is_staggered else half
        known: dict[Any, Any] = {"junction": junction, "hole": (0.0, 0.0)}
        middle = known.get(self.case.centre, self.case.centre)
        centres = middle + spread_positions(how.positions if modes else 1) @ self._vectors
        rves = [RVE(cell, experiment.material, modes, c, normalisation="given") for c in centres]
        plates = self.case.plates
        if how.mesh is None:
            return HomogenizedBody.of_specimen(
                specimen, rves, plates, divisions=how.divisions, edge_shifts=self._edge_shifts
            )
        mesh, is_lattice, edges = read_body_mesh(how.mesh)
        if (extent := float(np.ptp(mesh.nodes, axis=0).min())) < specimen.pitch:
            what = f"a body of at least one cell, {specimen.pitch:g} mm"
            raise InputError(f"{how.mesh}: expected {what}, got {extent:.3g} mm; is it in metres?")
        return HomogenizedBody(mesh, rves, plates, is_lattice=is_lattice, edges=edges)

    @cached_property
    def _edge_shifts(self) -> tuple[float, float]:
        """Extension of the lattice at each plate and at each side [mm]."""
        from modeharvest.fem.lattice.micromorphic.edges import edge_shifts

        how, of = self.case.homogenization, self.case.experiment
        if how.mesh is not None or isinstance(how.edge_shifts, tuple):
            return (0.0, 0.0) if how.edge_shifts == "find" else how.edge_shifts
        return edge_shifts(of.specimen, of.material, how.mesh_size, self.case.plates)

    def _followed(self, body: HomogenizedBody, what: str) -> Homogenized:
        from modeharvest.fem.lattice.micromorphic.branches import homogenize

        experiment, progress = self.case.experiment, named(self.progress, what)
        return homogenize(body, self.case.loads, experiment.path, progress)

    def _exported(
        self, found: Homogenized, body: HomogenizedBody, measured: MeasuredModes | None
    ) -> list[Path]:
        """Write the RVE of each position, also with the state before the critical point."""
        before = [found.critical.state] if found.critical else []
        states = sorted([*before, *found.states], key=lambda state: state.load)
        points, count = len(body.places), len(body.rves)
        every = [dict(chain(*body.comm.allgather(_own_states(body, s)))) for s in states]
        of_states = {
            "loads": np.repeat([s.load for s in states], points),
            "points": np.tile(body.places, (len(states), 1)),
            "buckled": np.repeat([int(s.branch != "primary") for s in states], points),
        }

        def write() -> list[Path]:
            paths = []
            for k, rve in enumerate(body.rves):
                own = [at[k + count * point] for at in every for point in range(points)]
                name = f"rve{k + 1 if k else ''}"
                h5, mat = (self.folder / f"{name}.{kind}" for kind in ("h5", "mat"))
                write_rve(h5, rve, own, measured, (k + 1, count), **of_states)
                write_fe2(mat, rve)
                paths += [h5, mat]
            return paths

        return on_first(write)

    def _predicted(self, modes: Sequence[LatticeMode]) -> Response:
        return response_of(self._followed(self._body(self._fields(modes)), "error bars"))

    def _data(self) -> HomogenizationData:
        """All that the report shows."""
        found, (modes, parameters, warnings) = self.homogenize(), self.mode()
        fields = HomogenizedFields.read(self.folder / "homogenized.h5")
        solution = self.virtual.fem() if self.case.is_experiment else None
        is_compared = isinstance(self.case.mode, MeasuredMode) and solution
        return HomogenizationData(
            found=found,
            direct=Response(None, ()) if solution is None else direct_response(solution),
            path={} if solution is None else solution.info["path"], modes=modes,
            parameters=parameters,
            warnings=(*warnings, *not_reached(found["response"], len(self.case.loads))),
            fields=fields, measured=self.result if is_compared else None,
            measured_strain=self._measured_strain,
            command=command_line("homogenize", self.source, "--out", self.folder),
        )  # fmt: skip


def _own_states(body: HomogenizedBody, state: HomogenizedState) -> list[tuple[int, RVEState]]:
    """States of this rank's RVEs in a state of the body, with the RVEs' numbers."""
    return [
        (int(k), rve.equilibrium(q, rve.cell.reduction.displacement(w)))
        for k, w in zip(body.own, body.fluctuations(state.value), strict=True)
        for rve, q in [(body.rve(k), state.strains[k // len(body.rves)])]
    ]
