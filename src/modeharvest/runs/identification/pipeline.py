"""Material and supports identified from images and forces, in stages that can be resumed.

::

    images/ forces.json                 data       twin only: synthetic data of known truth
    solution.h5 solution.vtu            identify   the model's states with the identified values
    report.html summary.json
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.path.parameters import PARTS, holes_of, parameter
from modeharvest.idic.chebyshev import Brightness
from modeharvest.idic.finite_element.equations.pixels import MeshPixels
from modeharvest.idic.finite_element.fields import element_gradients
from modeharvest.idic.finite_element.identification.ansatz_terms import terms_of, with_terms
from modeharvest.idic.finite_element.identification.identify import (
    LEVELS,
    FinerMesh,
    Identified,
    Readings,
    Unknown,
    UnlikeDataError,
    are_unlike,
    identify,
)
from modeharvest.idic.finite_element.identification.model_error import corrections
from modeharvest.idic.finite_element.identification.observed import (
    MOTION,
    PLACE,
    FieldData,
    ImageData,
    StateObservation,
    imaged,
    rigidly_moved,
)
from modeharvest.idic.finite_element.light import alike
from modeharvest.idic.local.field import LocalField, read_field
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import Level
from modeharvest.idic.uncertainty.parameters import compared_by_evidence
from modeharvest.imaging.distortion.files import read_distortion
from modeharvest.imaging.distortion.lens import Distortion, undistorted
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.photograph import read_frame, read_reference
from modeharvest.runs.case import checked
from modeharvest.runs.identification.case import IdentificationCase, MeasuredData, TwinTruth
from modeharvest.runs.identification.placement import found_place
from modeharvest.runs.photographs.sequence import named_files
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, requiring_dolfinx
from modeharvest.util.files import read_json, sha256_of, write_json
from modeharvest.util.stages import StagedRun, command_line, exclusive, stage_key, versions
from modeharvest.util.typed import to_plain

_FRAME = {"centre": (0.005, "mm"), "orientation": (0.005, "rad"),
          "shift": (0.1, "mm"), "turn": (0.1, "rad")}  # fmt: skip
"""Possible errors of the initial guesses of the camera frame's unknowns (lengths relative to the
specimen's), and units."""
_DEGREE, _FINE_DEGREE = 3, 4
"""Polynomial degrees of elements: of the model's mesh, and of the finer mesh and of twins."""
_OTHER = {"buckled+": "buckled-", "buckled-": "buckled+"}
_NEAR = 100.0  # distance from the critical strain [strain_sd], below which amplitudes are tried
_SAME_MM = 1e-5
"""Tolerance between states found step by step and those found along the whole path [mm]."""
_WRINKLES = 0.544
"""Stretch at which a free surface of a neo-Hookean material becomes unstable in plane strain: Biot,
Appl. Sci. Res. A 12 (1963) 168-182."""
_LIBRARIES = ("numpy", "scipy", "numba", "h5py", "fenics-dolfinx")


@dataclass(frozen=True)
class IdentificationRun(StagedRun[IdentificationCase]):
    """Runs the stages of an identification."""

    source: str = "EXPERIMENT.toml"
    """The case's name, for the command in the report."""

    def all(self) -> dict[str, Any]:
        """Run all unfinished stages; returns the content of ``summary.json``.

        Raises InputError if the data can't be used or the model doesn't reach their states, and
        MissingDependencyError without dolfinx.
        """
        path = self.folder / "summary.json"
        with exclusive(self.folder):
            if self.case.twin is not None:
                self.do("data", self._data_key, lambda: self._make_twin(self.case.twin))
            self.do("identify", self._key, self._identify)
        return dict(read_json(path))

    @cached_property
    def _data_key(self) -> str:
        plain = self.case.plain()
        return stage_key([plain[n] for n in ("experiment", "twin", "imaging")], "fem", "imaging")

    @cached_property
    def _key(self) -> str:
        files = [sha256_of(path) for path in (*self._files, *self._lens)]
        return stage_key([self.case.plain(), files, self._data_key])

    @cached_property
    def _files(self) -> tuple[Path, ...]:
        """The data files named in the case: reference and deformed images, or fields."""
        if (data := self.case.data) is None:
            return ()
        names = data.fields or (data.reference, *data.deformed)
        found = named_files(self.case._base, names, unique=False)
        strains = len(self.case.experiment.strains)
        if (got := len(found) - bool(data.reference)) != strains:
            what = "fields" if data.fields else "deformed images"
            raise InputError(f"data: expected as many {what} as strains ({strains}), got {got}")
        return found

    @cached_property
    def _given(self) -> list[LocalField]:
        if not (data := self.case.data) or not data.fields:
            return []
        return [read_field(path, units="mm", y_axis=data.y_axis) for path in self._files]

    @property
    def _lens(self) -> tuple[Path, ...]:
        """The file of the lens distortion, as a tuple; empty if there is none."""
        data = self.case.data
        return (self.case._base / data.distortion,) if data and data.distortion else ()

    def _model(self, experiment: Experiment, names: list[str], degree: int = _DEGREE) -> Any:
        with requiring_dolfinx("identification needs"):
            from modeharvest.fem.path.parametric import ParametricTest
        return ParametricTest.meshed(experiment, names, degree)

    def _make_twin(self, twin: TwinTruth | None) -> list[Path]:
        """Write images of the true states, and readings of a load cell; returns the files."""
        assert twin is not None
        true = replace(self.case.experiment, material=twin.material, mesh_size=twin.mesh_size)
        values = twin.every(true)
        model = self._model(true, list(values), _FINE_DEGREE)
        model.with_critical = twin.frame_strain > 0.0
        states = model.at(np.array(list(values.values())), False)
        terms = terms_of(twin.values, len(true.strains))
        added = np.array([twin.values[name] for name in terms])
        states = with_terms(states, terms.values(), added, model.mesh.nodes, true.specimen)
        readings = dict[str, Any]()
        if twin.frame_strain:
            low = twin.frame_strain * np.floor(states.pop().strain / twin.frame_strain)
            readings["critical_strain"] = [low, low + twin.frame_strain]
        strains, folder = self.case.experiment.strains, self.folder / "images"
        snapshots = tuple(
            Snapshot(e, s.displacement, s.force, negative_pivots=s.negative_pivots, branch=s.branch)
            for e, s in zip(strains, states, strict=True)
        )
        true_states = Solution(states[0].mesh, snapshots, {})
        images = make_images(true_states, self.case.imaging, folder, strains, self.progress)
        forces = np.array([s.force for s in states])
        noise = np.random.default_rng(twin.force_seed).normal(0.0, 1.0, len(forces))
        path = self.folder / "forces.json"
        readings["forces_N_per_mm"] = list(forces + twin.force_sd * noise)
        write_json(path, readings)
        return [*images.files, path]

    def _identify(self) -> list[Path]:
        experiment = self.case.experiment
        data, *given = self._data(self._model(experiment, []).mesh)
        data += [None] * (len(self._strains.values) - len(data))  # the critical state
        found, model, choices = self._best(self.case, data, *given)
        laws, comparison = self._laws(found, data, *given)
        solution = Solution(found.states[0].mesh, tuple(
            Snapshot(s.strain, s.displacement, s.force, negative_pivots=s.negative_pivots,
                     branch=s.branch) for s in found.states[: len(experiment.strains)]
        ), {"specimen": experiment.specimen.plain()})  # fmt: skip
        names = ("solution.h5", "solution.vtu", "report.html", "summary.json")
        h5, vtu, page, path = (self.folder / name for name in names)
        solution.write(h5)
        solution.write_vtu(vtu)
        model.with_critical = False  # at that point, displacement along the mode needs no energy
        warnings = _path_warnings(model, found.minimum.unknowns[: len(model.names)])
        warnings += [text for s in found.states for text in _surface_warnings(s)]
        summary = self._summary(found, model)
        statements = [*found.statements, *choices, *comparison, *(f.read_as for f in self._given)]
        summary |= to_plain({"laws": laws, "statements": statements, "warnings": warnings})
        from modeharvest.report.identification import identification_report
        from modeharvest.report.model.output import write_page

        write_page(identification_report(summary, found, data), page, self.progress)
        write_json(path, summary)
        return [h5, vtu, page, path]

    def _best(self, case: IdentificationCase, *data: Any) -> tuple[Identified, Any, list[str]]:
        """Identified unknowns, the model and notes; on the other branch if it fits better."""
        named = case.experiment.branches[0]
        with suppress(UnlikeDataError):
            return *self._identified(case, *data, unlike_is_error=True), []
        if named not in _OTHER:
            return *self._identified(case, *data), []
        experiment = replace(case.experiment, branches=(_OTHER[named],))
        other = case.model_copy(update={"experiment": experiment})
        text = f"the specimen is on {_OTHER[named]}: on {named} the model fits worse"
        with suppress(InputError):  # states not reached, or unlike the data, too
            return *self._identified(other, *data, unlike_is_error=True), [text]
        found, model = self._identified(case, *data)
        is_buckled = any(state.branch in _OTHER for state in found.states)
        with suppress(InputError):
            if is_buckled and are_unlike(found.state_equations):
                there = self._identified(other, *data)
                if there[0].minimum.equations.cost <= found.minimum.equations.cost:
                    return *there, [text]
        return found, model, []

    def _identified(
        self, case: IdentificationCase, data: list[StateObservation | None],
        forces: Readings | None, px: float, frame: dict[str, Unknown],
        *, unlike_is_error: bool = False,
    ) -> tuple[Identified, Any]:  # fmt: skip
        """Identify the unknowns of a case and of the camera's frame; returns the model, too."""
        experiment = case.experiment
        terms = terms_of(case.unknowns, len(experiment.strains))
        unknowns = {name: unknown for name, unknown in case.unknowns.items() if name not in terms}
        model = self._model(experiment, list(unknowns))
        size = self.case.finer_mesh_size or 0.7 * experiment.mesh_size
        fine = self._model(replace(experiment, mesh_size=size), list(unknowns), _FINE_DEGREE)
        model.with_critical = fine.with_critical = len(data) > len(experiment.strains)
        has_place = any(name in PLACE for name in frame)
        every = unknowns | {name: case.unknowns[name] for name in terms} | frame

        def seen(model: Any, values: FloatArray, with_derivatives: bool) -> list[Any]:
            parts = np.cumsum([len(unknowns), len(terms), 3 * has_place])
            own, added, place, motions = np.split(values, parts)
            at = model.mesh.nodes, experiment.specimen
            states = with_terms(model.near(own, with_derivatives), terms.values(), added, *at)
            motions = motions.reshape(-1, 3)  # the critical state has no image
            return [imaged(state, place if has_place else None, motions, min(k, len(motions) - 1))
                    for k, state in enumerate(states)]  # fmt: skip

        found = identify(
            lambda values: seen(model, values, True), data, every, pixel_size=px,
            forces=forces, levels=(*[Level(4, 3.0)] * (f"{MOTION[0]}[0]" in frame), *LEVELS),
            strains=self._strains,
            finer=FinerMesh(
                lambda values: seen(fine, values, False), error_ratio(size / experiment.mesh_size)
            ),
            corrections=corrections(model.mesh.nodes, experiment.specimen.vectors),
            omitted=lambda values: model.omitted_terms(values[: len(unknowns)]),
            unlike_is_error=unlike_is_error, progress=self.progress,
        )  # fmt: skip
        if not (near := self._beside_critical(found, fine)):
            return found, model
        wider = case.model_copy(update={"unknowns": case.unknowns | near})
        other = self._identified(wider, data, forces, px, frame, unlike_is_error=unlike_is_error)
        return min((found, model), other, key=lambda pair: pair[0].minimum.equations.cost)

    def _beside_critical(self, found: Identified, fine: Any) -> dict[str, Unknown]:
        """Unknown amplitudes of states so near the critical point that strain hardly fixes them."""
        critical, experiment = fine.critical_strain, fine.experiment
        travel = dict(zip(found.unknowns, found.minimum.unknowns, strict=True)).get("travel", 1.0)
        off = np.abs(travel * np.array(experiment.strains) - (critical or np.inf))
        reach = 0.5 * experiment.specimen.pitch
        start = 0.04 * reach * (-1.0 if experiment.branches[0] == "buckled-" else 1.0)
        near = np.flatnonzero(off < _NEAR * np.ravel(self._strains.sd)[0])
        names = {f"amplitude[{k}]" for k in near} - found.unknowns.keys()
        return {name: Unknown(start, (-reach, reach)) for name in sorted(names)}

    def _laws(self, found: Identified, *data: Any) -> tuple[list[dict[str, Any]], list[str]]:
        """The evidence for each material of the case, and a text that compares them."""
        results = {type(self.case.experiment.material).__name__: found}
        for law in self.case.laws:
            results[law.name], _, _ = self._best(self.case.with_law(law), *data)
        if len(results) == 1:
            return [], []
        evidence = [result.log_evidence() for result in results.values()]
        rejected = [name for name, result in results.items() if result.is_rejected]
        text = compared_by_evidence(list(results), evidence, rejected)
        return [
            {"name": name, "log_evidence": log, "log_evidence_by_mesh": by_mesh,
             "model_error": result.model_error, "law_error": result.law_error,
             "outcome": result.minimum.outcome.value, "parameters": [
                 {"name": n, "value": value, "sd_with_model_error": sd} for n, value, sd
                 in zip(result.unknowns, result.values, result.sd_with_model_error, strict=True)
             ]}
            for (name, result), (log, by_mesh) in zip(results.items(), evidence, strict=True)
        ], [text]  # fmt: skip

    def _data(
        self, mesh: Mesh
    ) -> tuple[list[StateObservation | None], Readings | None, float, dict[str, Unknown]]:
        """Data of each state, forces, pixel size [mm], unknowns of the camera's frame."""
        twin, data = self.case.twin, self.case.data
        if twin is not None:
            readings = np.array(read_json(self.folder / "forces.json")["forces_N_per_mm"])
            forces = Readings(readings, twin.force_sd) if twin.force_sd > 0.0 else None
            images = ImageSet.read(self.folder / "images")
            return [*self._exposed(images, mesh)], forces, images.grid.pixel_size, {}
        assert data is not None
        count = len(self.case.experiment.strains) if data.rigid_motion else 0
        start = {f"{name}[{k}]": 0.0 for k in range(count) for name in MOTION}
        if data.fields:
            assert data.field_sd_mm is not None
            px, given = data.field_sd_mm, self._given
            found: list[Any] = [FieldData(f.points[f.good], f.u[f.good], px, mesh) for f in given]
        else:
            pairs, place, lens = self._photographed(data)
            if place is not None:
                start = dict(zip(PLACE, place, strict=True)) | start
                none = np.zeros((0, *mesh.nodes.shape))
                mesh = replace(mesh, nodes=rigidly_moved(mesh.nodes, none, place)[0])
            noise = None if data.noise_sd is None else ImageNoise.of(data.noise_sd)
            pixels, degree = MeshPixels(mesh), Brightness.of(data.brightness).degree
            light = None if degree is None else partial(alike, light=degree)
            found = [ImageData(pair, pixels, noise, light, lens) for pair in pairs]
            px = pairs[0].grid.pixel_size
        length, frame = float(np.ptp(mesh.nodes[:, 0])), dict[str, Unknown]()
        for name, value in start.items():
            share, unit = _FRAME[re.split(r"[_[]", name)[0]]
            reach = share * (length if unit == "mm" else 1.0)
            frame[name] = Unknown(value, (value - reach, value + reach))
        return found, data.forces, px, frame

    @property
    def _strains(self) -> Readings:
        """Strains of the states, and the critical strain of a film: uniform between two frames."""
        e, data = np.array(self.case.experiment.strains), self.case.data
        sds = np.full(len(e), 1e-5 if data is None else data.strain_sd)
        path = self.folder / "forces.json"
        frames = data.critical_strain if data else read_json(path).get("critical_strain")
        if frames is None:
            return Readings(e, sds)
        sd = np.ptp(frames) / np.sqrt(12.0)
        return Readings(np.append(e, np.mean(frames)), np.append(sds, sd))

    def _exposed(self, images: ImageSet, mesh: Mesh) -> Iterator[ImageData]:
        """The image data of a twin, for each strain; its lens distortion is known."""
        lens, grid = self.case.imaging.lens(images.grid.shape), images.grid
        light = partial(alike, light=0) if self.case.imaging.sensor.flicker else None
        reference, pixels = images.reference(camera=True), MeshPixels(mesh)
        for e in images.strains:
            at = ((None, images.mask()), (e, images.deformed_mask(e)))
            sds = [float(images.noise_sd(which)[where].mean()) for which, where in at]
            pair = ImagePair(reference, images.deformed(e, camera=True), grid)
            yield ImageData(pair, pixels, ImageNoise(*sds), light, lens)

    def _photographed(
        self, data: MeasuredData
    ) -> tuple[list[ImagePair], FloatArray | None, Distortion | None]:
        """Image pairs of the files, the specimen's place in the reference, lens distortion."""
        reference = read_reference(self._files[0])
        others = [read_frame(path, reference).image for path in self._files[1:]]
        lens = next(map(read_distortion, self._lens), None)
        first = reference.image if lens is None else undistorted(reference.image, lens)
        grid = PixelGrid.centred(*reference.shape, data.pixel_size or 1.0)
        specimen = self.case.experiment.specimen
        place = None if data.placement == "centred" else found_place(first, grid, specimen)
        return [ImagePair(reference.image, other, grid) for other in others], place, lens

    def _holes(self, found: Identified) -> tuple[list[dict[str, Any]] | None, dict[str, Any]]:
        """The identified holes (None if not unknown), and true values of a twin's unknowns."""
        experiment, twin = self.case.experiment, self.case.twin
        true = {} if twin is None else {name: twin.value(name) for name in found.unknowns}
        chosen = [k for k, name in enumerate(found.unknowns) if name.startswith("holes")]
        if not chosen:
            return None, true
        names = [list(found.unknowns)[k] for k in chosen]
        design = np.array([holes_of([name], [1.0], experiment).ravel() for name in names]).T
        off = (design @ found.values[chosen]).reshape(-1, len(PARTS))
        covariance = found.covariance_with_model_error[np.ix_(chosen, chosen)]
        own = np.nan_to_num(covariance, posinf=1e6)  # of undetermined unknowns
        variance = np.einsum("ij,jk,ik->i", design, own, design)
        sd = np.hypot(np.sqrt(variance), design @ found.mesh_error[chosen]).reshape(off.shape)
        values = {} if twin is None else twin.every(experiment)
        exact = holes_of(list(values), list(values.values()), experiment)
        if twin is not None:
            true |= dict(zip(names, np.linalg.lstsq(design, exact.ravel())[0], strict=True))
        spec = experiment.specimen
        return [
            {"centre": spec.hole_centres[k], "diameter": spec.diameters[k], "off": off[k],
             "off_sd": sd[k], "true": None if twin is None else exact[k]}
            for k in range(len(off))
        ], true  # fmt: skip

    def _unit(self, name: str) -> str:
        """Unit of an unknown."""
        if frame := _FRAME.get(re.split(r"[_[]", name)[0]):
            return frame[1]
        experiment = self.case.experiment
        if terms_of([name], len(experiment.strains)):
            return "mm"
        return parameter(name, experiment).unit

    def _critical(self, found: Identified, model: Any) -> dict[str, Any] | None:
        """Critical strain of the model with the identified values, and its measured value."""
        last, reading = found.states[-1], self._strains
        is_datum, own = last.branch == "critical", found.minimum.unknowns[: len(model.names)]
        if (state := last if is_datum else model.critical_state(own)) is None:
            return None
        by, n = state.strain_by, len(state.strain_by)
        covariance = np.nan_to_num(found.covariance_with_model_error[:n, :n], posinf=0.0)
        measured, sd = (reading.values[-1], np.ravel(reading.sd)[-1]) if is_datum else (None, None)
        return {"value": state.strain, "sd": np.sqrt(by @ covariance @ by),
                "measured": measured, "measured_sd": sd}  # fmt: skip

    def _summary(self, found: Identified, model: Any) -> dict[str, Any]:
        case, forces, (holes, true) = self.case, found.forces, self._holes(found)
        parameters = [
            {"name": name, "unit": self._unit(name), "start": unknown.start,
             "bounds": unknown.bounds, "value": value, "sd": sd, "sd_with_model_error": sd_model,
             "mesh_error": off, "true": true.get(name)}
            for (name, unknown), value, sd, sd_model, off in zip(
                found.unknowns.items(), found.values, found.sd, found.sd_with_model_error,
                found.mesh_error, strict=True)
        ]  # fmt: skip
        readings = [np.nan] * len(found.states) if forces is None else forces.values
        of_states = zip(found.states, found.force_sd, readings, found.state_equations, strict=False)
        states = [
            {"nominal_strain": s.strain, "branch": s.branch, "negative_pivots": s.negative_pivots,
             "force_N_per_mm": s.force, "force_sd_N_per_mm": sd, "force_measured_N_per_mm": F,
             "residual_rms": part.residual, "residual_noise": part.expected, "count": part.count}
            for s, sd, F, part in of_states
        ]  # fmt: skip
        return dict[str, Any](to_plain({
            "title": case.title,
            "command": command_line("identify", self.source, "--out", self.folder),
            "parameters": parameters,
            "correlations": found.correlations,
            "model_error": found.model_error,
            "law_error": found.law_error,
            "outcome": found.minimum.outcome.value,
            "explanation": found.minimum.outcome.explanation,
            "critical_strain": self._critical(found, model),
            "states": states,
            "holes": holes,
            "force_sd_N_per_mm": None if forces is None else forces.sd,
            "evaluations": found.evaluations,
            "model_unknowns": model.unknowns,
            "case": case.plain(),
            "versions": versions(*_LIBRARIES),
        }))  # fmt: skip


def error_ratio(sizes: float) -> float:
    """Ratio of the finer mesh's error to the model's; ``sizes``: ratio of their element sizes.

    Empirical, for most parameters of a specimen: benchmarks/identification_statistics.py --fields.
    """
    return float(0.02 * (sizes / 0.7) ** 5)


def _path_warnings(model: Any, values: FloatArray) -> list[str]:
    """Follow the whole path to states found step by step; returns a warning if they differ."""
    near = model.near(values, False)
    try:
        whole = model.at(values, False)
    except InputError as error:
        return [f"The states were found step by step; following the whole path failed: {error}"]
    pairs = zip(near, whole, strict=True)
    off = max(float(np.abs(a.displacement - b.displacement).max()) for a, b in pairs)
    if off < _SAME_MM:
        return []
    return [f"The states were found step by step, up to {off:.2g} mm from those of the whole "
            "path with the same parameters: they may be on another branch."]  # fmt: skip


def _surface_warnings(state: Any) -> list[str]:
    """A warning if a state compresses the material so far that free edges are unstable."""
    F = np.eye(2) + element_gradients(state.mesh, state.displacement)
    if (least := float(np.linalg.svd(F, compute_uv=False).min())) > _WRINKLES:
        return []
    return [f"At {100 * state.strain:.4g} % a stretch is {least:.3f}: free edges wrinkle below "
            f"{_WRINKLES} (Biot), and the state depends on the mesh. Leave it out."]  # fmt: skip


def run_identification(
    case: IdentificationCase | Mapping[str, Any] | str | Path, folder: Path | str, **how: Any
) -> dict[str, Any]:
    """Identify a case's unknowns in a folder; returns the content of ``summary.json``."""
    source = str(case) if isinstance(case, (str, Path)) else "EXPERIMENT.toml"
    if isinstance(case, Mapping):
        case = checked(IdentificationCase, case, "case")
    known = IdentificationCase.of(case)
    return IdentificationRun(known, Path(folder), source=source, **how).all()
