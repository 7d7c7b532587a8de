"""Case of an identification of material and supports: model, unknowns, and data or a twin.

The table ``[experiment]`` is the model: specimen, mesh, nominal strains of the states, and the
values of known parameters. ``[unknowns]`` has each unknown with its initial guess and bounds. The
data are either ``[data]``, files of images or displacement fields and readings of the load cell,
or ``[twin]`` with ``[imaging]``: synthetic data, made on another mesh than that of the model.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import PrivateAttr, model_validator

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.materials import MATERIALS, Material, Ogden
from modeharvest.fem.path.parameters import PARTS, TILT, TRAVEL, parameter
from modeharvest.fem.specimen import Imperfection
from modeharvest.idic.chebyshev import Brightness
from modeharvest.idic.finite_element.identification.ansatz_terms import NAMES, Term
from modeharvest.idic.finite_element.identification.identify import Readings, Unknown
from modeharvest.imaging.distortion.lens import CameraDistortion
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import CaseModel, of_kind, with_kind
from modeharvest.util.errors import InputError, require_within


@dataclass(frozen=True)
class MeasuredData:
    """Data of a test; file names are relative to the folder of the case file."""

    reference: str = ""
    deformed: tuple[str, ...] = ()
    """Image files: of the undeformed state, and of each strain in the order of the test."""
    pixel_size: float | None = None
    """Size of a pixel on the specimen [mm/px]."""
    placement: Literal["found", "centred"] = "found"
    """Position of the specimen: "found" by its holes in the reference image, then refined with the
    unknowns; or "centred", with its centre at the centre of the images."""
    brightness: int | str = 0
    """Total degree, 0 to 6, of gain and offset between the images' grey levels; or "none"."""
    distortion: str = ""
    """Lens distortion: a file of modeharvest (JSON) or of a calibration program. Images are not
    resampled; points are mapped to their distorted positions."""
    noise_sd: float | None = None
    """Standard deviation of each image's noise [grey levels of the files]; by default estimated."""
    fields: tuple[str, ...] = ()
    y_axis: Literal["up", "down"] | None = None
    field_sd_mm: float | None = None
    """Instead of images, displacement fields [mm] of any DIC code, one per strain, origin at the
    specimen's centre; direction of y if columns don't tell; standard deviation per component."""
    forces_N: tuple[float, ...] = ()
    thickness_mm: float | None = None
    forces_N_per_mm: tuple[float, ...] = ()
    """Readings of the load cell at each strain, compression positive: in N, with the specimen's
    thickness in mm, or in N per mm of thickness."""
    force_sd: float | None = None
    """Standard deviation of the load cell, in the unit of the forces."""
    rigid_motion: bool = False
    """Whether specimen and camera may have moved relative to each other between the images. If so,
    a translation and a rotation of each state are identified, too, of up to some 10 px."""
    strain_sd: float = 1e-5
    """Standard deviation of the nominal strains [-], used for states given by an amplitude."""
    critical_strain: tuple[float, float] | None = None
    """Nominal strains [-] of the last frame of a film without pattern and the first with it."""

    def __post_init__(self) -> None:
        if self.critical_strain and not 0.0 < self.critical_strain[0] < self.critical_strain[1]:
            got = [*self.critical_strain]
            raise InputError(f"data: expected critical_strain = [low, high] above 0, got {got}")
        images, forces = self.reference or self.deformed, self.forces_N or self.forces_N_per_mm
        for is_wrong, text in (
            (bool(images) == bool(self.fields), "images (reference and deformed) or fields, got "
             f"{'both' if images else 'neither'}"),
            (bool(self.reference) != bool(self.deformed),
             "a reference and deformed images, got one of the two"),
            (images and self.pixel_size is None, "a pixel_size [mm/px] for images, got none"),
            (self.fields and self.field_sd_mm is None,
             "field_sd_mm for displacement fields, got none"),
            (self.forces_N and self.forces_N_per_mm, "forces_N or forces_N_per_mm, got both"),
            (self.forces_N and self.thickness_mm is None, "thickness_mm with forces_N, got none"),
            (forces and self.force_sd is None, "force_sd with forces, got none"),
            (self.distortion and not images, "images for the distortion of a lens, got fields"),
        ):  # fmt: skip
            if is_wrong:
                raise InputError(f"data: expected {text}")
        for name in ("pixel_size", "noise_sd", "field_sd_mm", "thickness_mm", "force_sd"):
            if (value := getattr(self, name)) is not None:
                require_within(f"data: expected {name}", value, 0.0, above=True)
        require_within("data: expected strain_sd", self.strain_sd, 0.0, above=True)
        Brightness.of(self.brightness)  # checks it

    @property
    def forces(self) -> Readings | None:
        """Readings of the load cell per thickness [N/mm]; None if there are none."""
        values = self.forces_N or self.forces_N_per_mm
        if not values or self.force_sd is None:
            return None
        thickness = self.thickness_mm if self.forces_N and self.thickness_mm else 1.0
        return Readings(np.array(values) / thickness, self.force_sd / thickness)


@dataclass(frozen=True)
class TwinTruth:
    """True values of a synthetic test, from which the program makes its data."""

    material: Material = field(default_factory=Ogden)
    mesh_size: float = 0.25
    """Edge length of the elements of the simulation that makes the data [mm]."""
    travel: float = 1.0
    tilt: float = 0.0
    values: dict[str, float] = field(default_factory=dict)
    """Other unknowns' true values [mm]: "holes.diameter[0,0]", "right.x[2]", "v0[0].x[2,0]" etc."""
    imperfection: Imperfection = field(default_factory=Imperfection)
    """Scatter of the holes, added to those values."""
    force_sd: float = 0.0
    """Standard deviation of the load cell [N/mm]; 0 for a test without forces."""
    force_seed: int = 0
    frame_strain: float = 0.0
    """Strain between frames of a film that brackets the critical strain [-]; 0: no film."""

    def __post_init__(self) -> None:
        require_within("twin: expected frame_strain", self.frame_strain, 0.0)
        require_within("twin: expected mesh_size [mm]", self.mesh_size, 0.0, above=True)
        require_within("twin: expected force_sd [N/mm]", self.force_sd, 0.0)
        require_within("twin: expected a force_seed", self.force_seed, 0)

    def every(self, experiment: Experiment) -> dict[str, float]:
        """True values of the model's parameters by name, without those of the material."""
        count = len(experiment.strains)
        own = {name: v for name, v in self.values.items() if Term.named(name, count) is None}
        found = {TRAVEL: self.travel, TILT: self.tilt, **own}
        for k, hole in enumerate(self.imperfection.drawn(len(experiment.specimen.hole_centres))):
            for part, off in zip(PARTS, hole, strict=True):
                if off != 0.0:
                    name = f"holes[{k}].{part}"
                    found[name] = found.get(name, 0.0) + float(off)
        return found

    def value(self, name: str) -> float | None:
        """True value of a parameter, except of holes; None if there is no such parameter."""
        if (known := {TRAVEL: self.travel, TILT: self.tilt, **self.values}).get(name) is not None:
            return known[name]
        if name.startswith(("left.", "right.", "v0[", "v1[")):
            return 0.0
        base, _, number = name.rstrip("]").partition("[")
        found = getattr(self.material, base, None)
        if number and isinstance(found, tuple):
            return float(found[int(number)]) if int(number) < len(found) else None
        return None if found is None else float(found)


@dataclass(frozen=True)
class OtherLaw:
    """Another material model to be identified from the data, with its unknown constants."""

    name: str
    material: Material
    unknowns: dict[str, Unknown]


class IdentificationCase(CaseModel):
    """A model with unknown parameters, and the data from which they are identified."""

    table = "unknowns"

    experiment: Annotated[Experiment, of_kind(MATERIALS, "experiment.material", "material")] = (
        Experiment()
    )
    unknowns: dict[str, Unknown]
    laws: tuple[Annotated[OtherLaw, of_kind(MATERIALS, "laws.material", "material")], ...] = ()
    """Other material models, identified from the same data and compared by their evidence."""
    data: MeasuredData | None = None
    twin: Annotated[TwinTruth | None, of_kind(MATERIALS, "twin.material", "material")] = None
    imaging: Annotated[
        ImagingSpec, of_kind({"camera": CameraDistortion}, "imaging.distortion", "distortion")
    ] = ImagingSpec()
    finer_mesh_size: float | None = None
    """Element size of the mesh for the last steps' residual [mm]; by default 0.7 of the model's."""

    _base: Path = PrivateAttr(Path())

    @classmethod
    def read(cls, name: str | Path) -> Self:
        """Read a case as for any kind; paths in it are relative to the folder of its file."""
        case = super().read(name)
        case._base = Path(name).parent
        return case

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.finer_mesh_size is not None:
            what, most = "expected finer_mesh_size [mm]", 0.9 * self.experiment.mesh_size
            require_within(what, self.finer_mesh_size, 0.0, most, above=True)
        if not self.unknowns:
            raise InputError("unknowns: expected at least one, got none")
        names = [type(self.experiment.material).__name__, *(law.name for law in self.laws)]
        if len(set(names)) < len(names):
            raise InputError(f"laws: expected names that differ, got {names}")
        for name in (*self.unknowns, *(self.twin.values if self.twin is not None else ())):
            if Term.named(name, len(self.experiment.strains)) is None:
                parameter(name, self.experiment, NAMES)
        for name in {"kappa", "bulk", "c1", TRAVEL} & self.unknowns.keys():
            require_within(f"unknowns.{name}: expected bounds", self.unknowns[name].bounds[0], 0.0)
        if (self.data is None) == (self.twin is None):
            raise InputError("expected a table [data] or a table [twin], got both or neither")
        strains = len(self.experiment.strains)
        if self.data is not None:
            for name in ("forces_N", "forces_N_per_mm"):
                if (got := len(getattr(self.data, name))) not in (0, strains):
                    what = f"as many {name} as strains ({strains})"
                    raise InputError(f"data: expected {what}, got {got}")
        return self

    def with_law(self, law: OtherLaw) -> IdentificationCase:
        """The case with another material; its unknown constants replace those of this material."""
        own = vars(self.experiment.material)
        rest = {n: u for n, u in self.unknowns.items() if n.partition("[")[0] not in own}
        experiment = replace(self.experiment, material=law.material)
        return self.model_copy(update={"experiment": experiment, "unknowns": law.unknowns | rest})

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values; materials have their ``kind``."""
        content = super().plain()
        content["experiment"]["material"] = with_kind(self.experiment.material, MATERIALS)
        content["experiment"]["specimen"] = self.experiment.specimen.plain()
        for law, table in zip(self.laws, content["laws"], strict=True):
            table["material"] = with_kind(law.material, MATERIALS)
        if self.twin is not None:
            content["twin"]["material"] = with_kind(self.twin.material, MATERIALS)
        return content
