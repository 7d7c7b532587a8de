"""Material and supports identified from images and forces: a case, and a folder it is run in.

::

    images/ forces.json                 data       of a twin: what a test of known truth would leave
    solution.h5 solution.vtu            identify   the model's states with what was found
    report.html summary.json

A case has a table ``[experiment]``, the model: specimen, mesh, nominal strains of the states, and
the values of what isn't unknown; ``[unknowns]``, each with its start and bounds; and either
``[data]``, files of images or displacement fields and the load cell's readings, or ``[twin]`` with
``[imaging]``: data made by the program itself, on another mesh than the one that identifies.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import PrivateAttr, model_validator

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.materials import MATERIALS, Material, Ogden
from modeharvest.idic.finite_element.identify import (
    FinerMesh,
    Identified,
    Scalar,
    Unknown,
    identify,
)
from modeharvest.idic.finite_element.observed import FieldData, ImageData, StateData, nodal_values
from modeharvest.idic.finite_element.pixels import MeshPixels
from modeharvest.idic.local.field import read_field
from modeharvest.idic.solver.noise import ImageNoise, estimated_noise
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.photograph import read_frame, read_reference
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import CaseModel, checked, of_kind, with_kind
from modeharvest.runs.photographs.prepare import named_files
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError, require_within, requiring_dolfinx
from modeharvest.util.files import read_json, sha256_of, write_json
from modeharvest.util.stages import StagedRun, exclusive, stage_key, versions
from modeharvest.util.typed import to_plain

_UNITS = {"exponents": "-", "travel": "-", "tilt": "rad", "amplitude": "mm"}  # else MPa
_LIBRARIES = ("numpy", "scipy", "numba", "h5py", "fenics-dolfinx")


@dataclass(frozen=True)
class MeasuredData:
    """What a test has left; names of files are relative to the case's."""

    reference: str = ""
    deformed: tuple[str, ...] = ()
    """Images: of the undeformed state, and of each strain in the order of the test."""
    pixel_size: float | None = None
    """[mm/px]; the specimen's middle is the middle of the images."""
    noise_sd: float | None = None
    """Of the camera, in each image [grey levels of the files]; else estimated from the images."""
    fields: tuple[str, ...] = ()
    """Displacement fields in mm by any DIC code, one for each strain, instead of images; origin
    in the specimen's middle, y up."""
    field_sd_mm: float | None = None
    """Their standard deviation per component."""
    forces_N: tuple[float, ...] = ()
    thickness_mm: float | None = None
    forces_N_per_mm: tuple[float, ...] = ()
    """Readings of the load cell at each strain, compression positive: with the specimen's
    thickness, or by thickness."""
    force_sd: float | None = None
    """Standard deviation of the load cell, in the unit of the forces."""
    strain_sd: float = 1e-5
    """Standard deviation of nominal strains, for states found by an amplitude [-]."""

    def __post_init__(self) -> None:
        if bool(self.fields) == bool(self.reference or self.deformed):
            raise InputError(
                "data: expected images (reference and deformed) or fields, got "
                f"{'both' if self.fields else 'neither'}"
            )
        if bool(self.reference) != bool(self.deformed):
            raise InputError("data: expected a reference and deformed images, got one of the two")
        if self.reference and self.pixel_size is None:
            raise InputError("data: expected a pixel_size [mm/px] for images, got none")
        if self.fields and self.field_sd_mm is None:
            raise InputError("data: expected field_sd_mm for displacement fields, got none")
        if self.forces_N and self.forces_N_per_mm:
            raise InputError("data: expected forces_N or forces_N_per_mm, got both")
        if self.forces_N and self.thickness_mm is None:
            raise InputError("data: expected thickness_mm with forces_N, got none")
        if (self.forces_N or self.forces_N_per_mm) and self.force_sd is None:
            raise InputError("data: expected force_sd with forces, got none")
        for name in ("pixel_size", "noise_sd", "field_sd_mm", "thickness_mm", "force_sd"):
            if (value := getattr(self, name)) is not None:
                require_within(f"data: expected {name}", value, 0.0, above=True)
        require_within("data: expected strain_sd", self.strain_sd, 0.0, above=True)

    @property
    def forces(self) -> Scalar | None:
        """By thickness [N/mm]; None without any."""
        values = self.forces_N or self.forces_N_per_mm
        if not values or self.force_sd is None:
            return None
        thickness = self.thickness_mm if self.forces_N and self.thickness_mm else 1.0
        return Scalar(np.array(values) / thickness, self.force_sd / thickness)


@dataclass(frozen=True)
class TwinTruth:
    """What is true in a test that the program makes itself."""

    material: Material = field(default_factory=Ogden)
    mesh_size: float = 0.25
    """Edge length of the elements that the data are made with [mm]."""
    travel: float = 1.0
    tilt: float = 0.0
    force_sd: float = 0.0
    """Of the load cell; 0 for a test without forces [N/mm]."""
    force_seed: int = 0

    def __post_init__(self) -> None:
        require_within("twin: expected mesh_size [mm]", self.mesh_size, 0.0, above=True)
        require_within("twin: expected force_sd [N/mm]", self.force_sd, 0.0)

    def value(self, name: str) -> float | None:
        """Of a parameter by its name; None if it has none of that name."""
        if name in ("travel", "tilt"):
            return float(getattr(self, name))
        base, _, number = name.rstrip("]").partition("[")
        found = getattr(self.material, base, None)
        if number and isinstance(found, tuple):
            return float(found[int(number)]) if int(number) < len(found) else None
        return None if found is None else float(found)


class IdentificationCase(CaseModel):
    """A model with unknowns, and the data that they are identified from."""

    table = "unknowns"

    experiment: Annotated[Experiment, of_kind(MATERIALS, "experiment.material", "material")] = (
        Experiment()
    )
    unknowns: dict[str, Unknown]
    data: MeasuredData | None = None
    twin: Annotated[TwinTruth | None, of_kind(MATERIALS, "twin.material", "material")] = None
    imaging: ImagingSpec = ImagingSpec()
    finer_mesh_size: float | None = None
    """Of the mesh whose residual the last steps take [mm]; by default 0.6 of the model's."""

    _base: Path = PrivateAttr(Path())

    @classmethod
    def read(cls, name: str | Path) -> Self:
        """Read a case as every other; the files it names are found beside its own."""
        case = super().read(name)
        case._base = Path(name).parent
        return case

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.finer_mesh_size is not None:
            largest = self.experiment.mesh_size
            require_within("expected finer_mesh_size [mm]", self.finer_mesh_size, 0.0, above=True)
            if self.finer_mesh_size >= largest:
                raise InputError(
                    f"expected finer_mesh_size below mesh_size ({largest:g} mm), got "
                    f"{self.finer_mesh_size:g}"
                )
        if not self.unknowns:
            raise InputError("unknowns: expected at least one, got none")
        if (self.data is None) == (self.twin is None):
            raise InputError("expected a table [data] or a table [twin], got both or neither")
        strains = len(self.experiment.strains)
        if self.data is not None:
            for name in ("forces_N", "forces_N_per_mm"):
                if (got := len(getattr(self.data, name))) not in (0, strains):
                    raise InputError(
                        f"data: expected as many {name} as strains ({strains}), got {got}"
                    )
        return self

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values, materials by their kind."""
        content = super().plain()
        content["experiment"]["material"] = with_kind(self.experiment.material, MATERIALS)
        content["experiment"]["specimen"] = self.experiment.specimen.plain()
        if self.twin is not None:
            content["twin"]["material"] = with_kind(self.twin.material, MATERIALS)
        return content


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
        experiment, unknowns = self.case.experiment, self.case.unknowns
        model = self._model(experiment, list(unknowns))
        data, forces, px = self._data(model.mesh)
        strain_sd = 1e-5 if self.case.data is None else self.case.data.strain_sd
        found = identify(
            model.at, data, unknowns, pixel_size=px, forces=forces,
            strains=Scalar(np.array(experiment.strains), strain_sd),
            finer=self._finer(list(unknowns), model.mesh), progress=self.progress,
        )  # fmt: skip
        solution = Solution(model.mesh, tuple(
            Snapshot(s.strain, s.displacement, s.force, negative_pivots=s.negative_pivots,
                     branch=s.branch) for s in found.states
        ), {"specimen": experiment.specimen.plain()})  # fmt: skip
        names = ("solution.h5", "solution.vtu", "report.html", "summary.json")
        h5, vtu, page, path = (self.folder / name for name in names)
        solution.write(h5)
        solution.write_vtu(vtu)
        summary = self._summary(found, model)
        from modeharvest.report.identification import identification_report
        from modeharvest.report.model import write_page

        write_page(identification_report(summary, found, model.mesh, data), page, self.progress)
        write_json(path, summary)
        return [h5, vtu, page, path]

    def _finer(self, names: list[str], mesh: Mesh) -> FinerMesh:
        """The states on a finer mesh, at this mesh's nodes."""
        experiment = self.case.experiment
        size = self.case.finer_mesh_size or 0.6 * experiment.mesh_size
        model = self._model(replace(experiment, mesh_size=size), names)

        def states(values: FloatArray) -> list[tuple[FloatArray, float]]:
            return [
                (nodal_values(model.mesh, state.displacement, mesh.nodes), state.force)
                for state in model.at(values, False)
            ]

        return FinerMesh(states, size / experiment.mesh_size)

    def _data(self, mesh: Any) -> tuple[list[StateData | None], Scalar | None, float]:
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
            forces = Scalar(readings, twin.force_sd) if twin.force_sd > 0.0 else None
            return [*states], forces, images.grid.pixel_size
        assert data is not None
        if data.fields:
            assert data.field_sd_mm is not None
            fields = [read_field(path) for path in self._files]
            measured = [
                FieldData(f.points[f.good], f.u[f.good], data.field_sd_mm, mesh) for f in fields
            ]
            return [*measured], data.forces, data.field_sd_mm
        return [*self._photographed(data, MeshPixels(mesh))], data.forces, data.pixel_size or 1.0

    def _photographed(self, data: MeasuredData, pixels: MeshPixels) -> list[ImageData]:
        """The images of the files."""
        reference = read_reference(self._files[0])
        grid = PixelGrid.centred(*reference.shape, data.pixel_size or 1.0)
        found = []
        for path in self._files[1:]:
            image = read_frame(path, reference).image
            pair = ImagePair(reference.image, image, grid)
            sds = [data.noise_sd] * 2
            if data.noise_sd is None:
                sds = [estimated_noise(i, pair.masks[0]).sd for i in (reference.image, image)]
            found.append(ImageData(pair, pixels, ImageNoise(*map(float, sds))))  # type: ignore[arg-type]
        return found

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
        of_states = zip(found.states, found.force_sd, readings, found.sums, strict=True)
        states = [
            {"nominal_strain": s.strain, "branch": s.branch, "negative_pivots": s.negative_pivots,
             "force_N_per_mm": s.force, "force_sd_N_per_mm": sd, "force_measured_N_per_mm": F,
             "residual_rms": sums.residual, "residual_noise": sums.expected, "count": sums.count}
            for s, sd, F, sums in of_states
        ]  # fmt: skip
        return dict[str, Any](to_plain({
            "title": case.title,
            "command": f"modeharvest identify {self.source} --out {self.folder}",
            "parameters": parameters,
            "correlations": found.correlations,
            "statements": found.statements,
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
