"""What a specimen of a study of measured modes is: written down once, read by a worker.

In ``specimens/NAME/specimen.json`` of the study's folder, NAME the digest of its content.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from modeharvest.errors import InputError
from modeharvest.fem.experiment import Experiment, PathOptions
from modeharvest.fem.materials import Material, Ogden, TwoTermI1
from modeharvest.fem.specimen import Specimen
from modeharvest.files import read_json, write_json
from modeharvest.idic.setup import Identification
from modeharvest.imaging.imageset import image_key
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.stages import digest
from modeharvest.validation.studies.modes.pattern import PatternCells
from modeharvest.validation.studies.subject import Subject

_MATERIALS = {kind.__name__: kind for kind in (Ogden, TwoTermI1)}
_SPEC = TypeAdapter(ImagingSpec)


@dataclass(frozen=True)
class Description:
    """All that a specimen's measurement depends on.

    Parameters
    ----------
    specimen, material, mesh_size, edges, path
        As in :class:`~modeharvest.fem.experiment.Experiment`.
    amplitude
        The pattern's amplitude that it is compressed to [mm].
    largest
        Strain up to which to look for where it buckles [-].
    divisions
        Elements along l of the infinite lattice's cell.
    imaging, correlation
        How it is imaged and correlated.
    given
        The digest of a solution that is there already; "" to simulate.
    """

    specimen: Specimen
    material: Material
    mesh_size: float
    edges: str
    path: PathOptions
    amplitude: float
    largest: float
    divisions: int
    imaging: ImagingSpec
    correlation: Identification
    given: str = ""

    @classmethod
    def of(cls, subject: Subject, strain: float, largest: float, divisions: int) -> Description:
        """Of a simulated experiment, as strongly buckled as it is at a strain [-].

        Raises
        ------
        InputError
            If the experiment is not perfect, did not buckle, or has a material that can't be
            written down.
        """
        e = subject.experiment
        if not e.is_perfect or e.guided:
            raise InputError(
                "study: expected a perfect specimen that buckles at a strain of its own, got an "
                "experiment with an imperfection, a tilt or guides; leave them out"
            )
        if type(e.material) not in _MATERIALS.values():
            raise InputError(
                f"study: expected a material among {list(_MATERIALS)}, got {e.material!r}"
            )
        critical = subject.solution.info.get("critical")
        if not critical or critical["strain"] >= strain:
            raise InputError(
                f"study: expected an experiment that has buckled at {100 * strain:g} %, got one "
                + (f"with {100 * critical['strain']:.4g} % as its" if critical else "with no")
                + " critical strain"
            )
        there = subject.solution.at(strain).displacement
        amplitude = PatternCells(subject.solution.mesh, e.specimen).amplitude(there)
        return cls(
            specimen=e.specimen,
            material=e.material,
            mesh_size=e.mesh_size,
            edges=e.edges,
            path=e.path,
            amplitude=amplitude,
            largest=largest,
            divisions=divisions,
            imaging=subject.imaging,
            correlation=subject.correlation,
            given=image_key(subject.solution, (strain,), subject.imaging)[:16],
        )

    @property
    def experiment(self) -> Experiment:
        """The compression test, its strains still to be found."""
        return Experiment(
            self.specimen,
            self.material,
            mesh_size=self.mesh_size,
            edges=self.edges,
            path=self.path,
        )

    def changed(self, material: Material | None = None, **specimen: Any) -> Description:
        """With another material, or other values of the specimen; to be simulated."""
        return replace(
            self,
            specimen=replace(self.specimen, **specimen),
            material=material or self.material,
            given="",
        )

    def scaled(self, pitch: float) -> Description:
        """Everything in the same proportions to another l [mm], elements and pixels included."""
        old, factor = self.specimen, pitch / self.specimen.pitch
        lengths = {n: factor * getattr(old, n) for n in ("diameter", "bulk_x", "bulk_y")}
        specimen = replace(old, pitch=pitch, **lengths)
        pixel, start = self.imaging.pixel_size, self.correlation.start_amplitude
        return replace(
            self,
            specimen=specimen,
            mesh_size=factor * self.mesh_size,
            amplitude=factor * self.amplitude,
            imaging=replace(self.imaging, pixel_size=factor * pixel),
            correlation=replace(self.correlation, start_amplitude=factor * start),
            given="",
        )

    def solution_path(self, folder: Path) -> Path:
        """Where the solution of a study's specimen is: that of all that simulating depends on."""
        unseen = ("imaging", "correlation", "divisions")
        simulated = {name: value for name, value in self.plain().items() if name not in unseen}
        return folder / "solutions" / f"{digest(simulated)[:16]}.h5"

    def plain(self) -> dict[str, Any]:
        """As plain JSON values."""
        material = {"kind": type(self.material).__name__, **vars(self.material)}
        imaging = _SPEC.dump_python(self.imaging, mode="json")
        return {**asdict(self), "material": material, "imaging": imaging}

    @classmethod
    def read(cls, path: Path) -> Description:
        """Read what :meth:`leave` wrote."""
        values = dict(read_json(path))
        material = dict(values["material"])
        kind = _MATERIALS[material.pop("kind")]
        made = {
            "specimen": Specimen(**values["specimen"]),
            "material": TypeAdapter(kind).validate_python(material),
            "path": PathOptions(**values["path"]),
            "imaging": _SPEC.validate_python(values["imaging"]),
            "correlation": Identification(**values["correlation"]),
        }
        return cls(**{**values, **made})

    def leave(self, folder: Path) -> str:
        """Write it into the study's folder; returns the specimen's name."""
        name = digest(self.plain())[:16]
        write_json(folder_of(folder, name) / "specimen.json", self.plain())
        return name


def folder_of(folder: Path, name: str) -> Path:
    """Where a specimen of a study is."""
    return folder / "specimens" / name
