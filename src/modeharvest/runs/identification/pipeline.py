"""Material and supports identified from images and forces, in a folder that can be resumed.

::

    images/ forces.json                 data       of a twin: what a test of known truth would leave
    solution.h5 solution.vtu            identify   the model's states with what was found
    report.html summary.json
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.idic.finite_element.identify import (
    LEVELS,
    FinerMesh,
    Identified,
    Readings,
    Unknown,
    identify,
    log_evidence,
)
from modeharvest.idic.finite_element.observed import (
    MOTION,
    FieldData,
    ImageData,
    StateObservation,
    rigidly_moved,
    superposed_motion,
)
from modeharvest.idic.finite_element.pixels import MeshPixels
from modeharvest.idic.finite_element.result import nodal_values
from modeharvest.idic.local.field import read_field
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import Level
from modeharvest.idic.uncertainty.model_error import corrections
from modeharvest.idic.uncertainty.parameters import compared_by_evidence
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.photograph import read_frame, read_reference
from modeharvest.runs.case import checked
from modeharvest.runs.identification.case import IdentificationCase, MeasuredData, TwinTruth
from modeharvest.runs.photographs.prepare import named_files
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, requiring_dolfinx
from modeharvest.util.files import read_json, sha256_of, write_json
from modeharvest.util.stages import StagedRun, exclusive, stage_key, versions
from modeharvest.util.typed import to_plain

_UNITS = {"exponents": "-", "travel": "-", "tilt": "rad", "amplitude": "mm",
          "shift_x": "mm", "shift_y": "mm", "turn": "rad"}  # else MPa  # fmt: skip
_LIBRARIES = ("numpy", "scipy", "numba", "h5py", "fenics-dolfinx")


@dataclass(frozen=True)
class IdentificationRun(StagedRun[IdentificationCase]):
    """The stages of an identification."""

    source: str = "EXPERIMENT.toml"
    """The case's name, for the command in the report."""

    def all(self) -> dict[str, Any]:
        """Do everything that is not finished; returns the content of ``summary.json``.

        Raises InputError if the data can't be used or the model doesn't reach their states, and
        MissingDependencyError without dolfinx.
        """
        path = self.folder / "summary.json"
        with exclusive(self.folder):
            if self.case.twin is not None:
                self.do("data", self._data_key, lambda: self._make_twin(self.case.twin))
            self.do("identify", self._key, self._identify)
        return dict(read_json(path))

    # -- parts --------------------------------------------------------------------------

    @cached_property
    def _data_key(self) -> str:
        plain = self.case.plain()
        return stage_key([plain[n] for n in ("experiment", "twin", "imaging")], "fem", "imaging")

    @cached_property
    def _key(self) -> str:
        files = [sha256_of(path) for path in self._files]
        return stage_key([self.case.plain(), files, self._data_key])

    @cached_property
    def _files(self) -> tuple[Path, ...]:
        """Those that the case names."""
        data, base = self.case.data, self.case._base
        if data is None:
            return ()
        names = data.fields or (data.reference, *data.deformed)
        found = named_files(base, names, unique=False)
        strains = len(self.case.experiment.strains)
        if (got := len(found) - bool(data.reference)) != strains:
            what = "fields" if data.fields else "deformed images"
            raise InputError(f"data: expected as many {what} as strains ({strains}), got {got}")
        return found

    def _model(self, experiment: Experiment, names: list[str]) -> Any:
        with requiring_dolfinx("identification needs"):
            from modeharvest.fem.meshing import mesh_specimen, perturb
            from modeharvest.fem.path.parametric import ParametricTest
        spec = experiment.specimen
        mesh = perturb(mesh_specimen(spec, experiment.mesh_size), spec, experiment.imperfection)
        return ParametricTest(experiment, names, mesh)

    def _make_twin(self, twin: TwinTruth | None) -> list[Path]:
        """Images of the true states, and readings of a load cell."""
        assert twin is not None
        true = replace(self.case.experiment, material=twin.material, mesh_size=twin.mesh_size)
        model = self._model(true, ["travel", "tilt"])
        states = model.at(np.array([twin.travel, twin.tilt]), False)
        strains, folder = self.case.experiment.strains, self.folder / "images"
        snapshots = tuple(
            Snapshot(e, s.displacement, s.force, negative_pivots=s.negative_pivots, branch=s.branch)
            for e, s in zip(strains, states, strict=True)
        )
        images = make_images(
            Solution(model.mesh, snapshots, {}), self.case.imaging, folder, strains, self.progress
        )
        forces = np.array([s.force for s in states])
        noise = np.random.default_rng(twin.force_seed).normal(0.0, 1.0, len(forces))
        path = self.folder / "forces.json"
        write_json(path, {"forces_N_per_mm": list(forces + twin.force_sd * noise)})
        return [*images.files, path]

    def _identify(self) -> list[Path]:
        model = self._model(self.case.experiment, list(self.case.unknowns))
        data, forces, px = self._data(model.mesh)
        found = self._identified(self.case, model, data, forces, px)
        experiment = self.case.experiment
        laws, comparison = self._laws(found, data, forces, px)
        solution = Solution(model.mesh, tuple(
            Snapshot(s.strain, s.displacement, s.force, negative_pivots=s.negative_pivots,
                     branch=s.branch) for s in found.states
        ), {"specimen": experiment.specimen.plain()})  # fmt: skip
        names = ("solution.h5", "solution.vtu", "report.html", "summary.json")
        h5, vtu, page, path = (self.folder / name for name in names)
        solution.write(h5)
        solution.write_vtu(vtu)
        summary = self._summary(found, model)
        summary |= to_plain({"laws": laws, "statements": [*found.statements, *comparison]})
        from modeharvest.report.identification import identification_report
        from modeharvest.report.model import write_page

        write_page(identification_report(summary, found, model.mesh, data), page, self.progress)
        write_json(path, summary)
        return [h5, vtu, page, path]

    def _identified(
        self, case: IdentificationCase, model: Any, data: list[StateObservation | None],
        forces: Readings | None, px: float,
    ) -> Identified:  # fmt: skip
        """A case's unknowns by the data."""
        experiment, unknowns, count = case.experiment, case.unknowns, 0
        if self.case.data is not None and self.case.data.rigid_motion:
            count = len(experiment.strains)
        length = float(np.ptp(model.mesh.nodes[:, 0]))
        bounds = {"shift_x": 0.1 * length, "shift_y": 0.1 * length, "turn": 0.1}
        frame = {f"{name}[{k}]": Unknown(0.0, (-bounds[name], bounds[name]))
                 for k in range(count) for name in MOTION}  # fmt: skip

        def states(values: FloatArray) -> list[Any]:
            own, motions = np.split(values, [len(unknowns)])
            found = model.at(own)
            return [
                rigidly_moved(state, model.mesh.nodes, motion, k, count)
                for k, (state, motion) in enumerate(zip(found, motions.reshape(-1, 3), strict=True))
            ] if count else found  # fmt: skip

        strain_sd = 1e-5 if self.case.data is None else self.case.data.strain_sd
        return identify(
            states, data, unknowns | frame, pixel_size=px, forces=forces,
            levels=(*[Level(4, 3.0)] * (count > 0), *LEVELS),
            strains=Readings(np.array(experiment.strains), strain_sd),
            finer=self._finer(experiment, list(unknowns), model.mesh),
            corrections=corrections(model.mesh.nodes, experiment.specimen.vectors),
            progress=self.progress,
        )  # fmt: skip

    def _laws(self, found: Identified, *data: Any) -> tuple[list[dict[str, Any]], list[str]]:
        """The evidence for each of the case's materials, and which is the best, in words."""
        results = {type(self.case.experiment.material).__name__: found}
        for law in self.case.laws:
            case = self.case.with_law(law)
            model = self._model(case.experiment, list(case.unknowns))
            results[law.name] = self._identified(case, model, *data)
        if len(results) == 1:
            return [], []
        # All by the same weights, those of the last.
        evidence = [log_evidence(result, data[0]) for result in results.values()]
        rejected = [bool(r.model_error and r.model_error.is_rejected) for r in results.values()]
        text = compared_by_evidence(list(results), evidence, rejected)
        return [
            {"name": name, "log_evidence": log, "log_evidence_by_mesh": by_mesh,
             "model_error": result.model_error, "outcome": result.minimum.outcome.value,
             "parameters": [
                 {"name": n, "value": value, "sd_with_model_error": sd} for n, value, sd
                 in zip(result.unknowns, result.values, result.sd_with_model_error, strict=True)
             ]}
            for (name, result), (log, by_mesh) in zip(results.items(), evidence, strict=True)
        ], [text]  # fmt: skip

    def _finer(self, experiment: Experiment, names: list[str], mesh: Mesh) -> FinerMesh:
        """The states on a finer mesh, at this mesh's nodes."""
        size = self.case.finer_mesh_size or 0.6 * experiment.mesh_size
        model = self._model(replace(experiment, mesh_size=size), names)

        def states(values: FloatArray) -> list[tuple[FloatArray, float]]:
            own, motions = np.split(values, [len(names)])
            found = [
                (nodal_values(model.mesh, state.displacement, mesh.nodes, beside=True), state.force)
                for state in model.at(own, False)
            ]
            for k, motion in enumerate(motions.reshape(-1, 3)):
                found[k] = superposed_motion(found[k][0], mesh.nodes, motion)[0], found[k][1]
            return found

        return FinerMesh(states, size / experiment.mesh_size)

    def _data(self, mesh: Any) -> tuple[list[StateObservation | None], Readings | None, float]:
        """Of each state, with the forces, and the size of a pixel [mm]."""
        twin, data = self.case.twin, self.case.data
        if twin is not None:
            images, pixels = ImageSet.read(self.folder / "images"), MeshPixels(mesh)
            f, mask = images.reference(camera=True), images.mask()
            states = []
            for e in images.strains:
                g = images.deformed(e, camera=True)
                at = ((None, mask), (e, images.deformed_mask(e)))
                sds = [float(images.noise_sd(which)[where].mean()) for which, where in at]
                pair = ImagePair(f, g, images.grid)
                states.append(ImageData(pair, pixels, ImageNoise(*sds)))
            readings = np.array(read_json(self.folder / "forces.json")["forces_N_per_mm"])
            forces = Readings(readings, twin.force_sd) if twin.force_sd > 0.0 else None
            return [*states], forces, images.grid.pixel_size
        assert data is not None
        if data.fields:
            assert data.field_sd_mm is not None
            fields = [read_field(path, y_axis=data.y_axis) for path in self._files]
            measured = [
                FieldData(f.points[f.good], f.u[f.good], data.field_sd_mm, mesh) for f in fields
            ]
            return [*measured], data.forces, data.field_sd_mm
        return [*self._photographed(data, MeshPixels(mesh))], data.forces, data.pixel_size or 1.0

    def _photographed(self, data: MeasuredData, pixels: MeshPixels) -> list[ImageData]:
        """The images of the files."""
        reference = read_reference(self._files[0])
        grid = PixelGrid.centred(*reference.shape, data.pixel_size or 1.0)
        noise = None if data.noise_sd is None else ImageNoise.of(data.noise_sd)
        frames = (read_frame(path, reference).image for path in self._files[1:])
        pairs = (ImagePair(reference.image, image, grid) for image in frames)
        return [ImageData(pair, pixels, noise) for pair in pairs]

    def _summary(self, found: Identified, model: Any) -> dict[str, Any]:
        case, twin, forces = self.case, self.case.twin, found.forces
        rows = zip(found.unknowns, found.unknowns.values(), found.values, found.sd,
                   found.sd_with_model_error, found.mesh_error, strict=True)  # fmt: skip
        parameters = [
            {"name": name, "unit": _UNITS.get(re.sub(r"\[.*", "", name), "MPa"),
             "start": unknown.start, "bounds": unknown.bounds, "value": value, "sd": sd,
             "sd_with_model_error": sd_model, "mesh_error": off,
             "true": None if twin is None else twin.value(name)}
            for name, unknown, value, sd, sd_model, off in rows
        ]  # fmt: skip
        readings: FloatArray = (
            np.full(len(found.states), np.nan) if forces is None else forces.values
        )
        of_states = zip(found.states, found.force_sd, readings, found.state_equations, strict=True)
        states = [
            {"nominal_strain": s.strain, "branch": s.branch, "negative_pivots": s.negative_pivots,
             "force_N_per_mm": s.force, "force_sd_N_per_mm": sd, "force_measured_N_per_mm": F,
             "residual_rms": part.residual, "residual_noise": part.expected, "count": part.count}
            for s, sd, F, part in of_states
        ]  # fmt: skip
        return dict[str, Any](to_plain({
            "title": case.title,
            "command": f"modeharvest identify {self.source} --out {self.folder}",
            "parameters": parameters,
            "correlations": found.correlations,
            "model_error": found.model_error,
            "outcome": found.minimum.outcome.value,
            "explanation": found.minimum.outcome.explanation,
            "critical_strain": model.critical_strain,
            "states": states,
            "force_sd_N_per_mm": None if forces is None else forces.sd,
            "evaluations": found.evaluations,
            "model_unknowns": model.unknowns,
            "warnings": [],
            "case": case.plain(),
            "versions": versions(*_LIBRARIES),
        }))  # fmt: skip


def run_identification(
    case: IdentificationCase | Mapping[str, Any] | str | Path, folder: Path | str, **how: Any
) -> dict[str, Any]:
    """Identify a case's unknowns in a folder; returns what ``summary.json`` holds."""
    source = str(case) if isinstance(case, (str, Path)) else "EXPERIMENT.toml"
    if isinstance(case, Mapping):
        case = checked(IdentificationCase, case, "case")
    known = IdentificationCase.of(case)
    return IdentificationRun(known, Path(folder), source=source, **how).all()
