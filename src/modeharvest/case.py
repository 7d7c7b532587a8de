"""A virtual experiment: everything one run needs, read from a TOML file and checked beforehand.

The tables of the file are the project's own dataclasses, so a case file, ``--help`` and the
Python objects use the same names and units::

    title = "..."
    [experiment]              # fem.experiment.Experiment
    strains = [0.078, 0.128]
    [experiment.specimen]     # fem.specimen.Specimen
    [experiment.material]     # kind = "ogden" or "two-term-I1", and its constants
    [imaging]                 # imaging.spec.ImagingSpec
    [imaging.speckle]         # imaging.speckle.SpeckleSpec
    [imaging.distortion]      # imaging.distortion.CameraDistortion
    [correlation]             # idic.setup.Identification

A table ``[calibration]`` (imaging.calibration_target.CalibrationTarget) makes it the twin of a
real experiment: photographs through a lens that has to be calibrated first, to be harvested.

Infinite lattices have cases of their own: :mod:`modeharvest.lattice.case`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import field_validator

from modeharvest.case_file import (
    MATERIALS,
    CaseModel,
    case_text,
    checked,
    is_lattice,
    kind_of,
    of_kind,
    read_tables,
    shipped_cases,
    shipped_solution,
)
from modeharvest.errors import InputError
from modeharvest.fem.experiment import Experiment
from modeharvest.idic.setup import Identification
from modeharvest.imaging.calibration_target import CalibrationTarget
from modeharvest.imaging.distortion.undistort import CameraDistortion
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.typed import plain

__all__ = ["Case", "TwinCase", "case_text", "read_case", "shipped_cases", "shipped_solution"]

_LENSES = {"camera": CameraDistortion}


class Case(CaseModel):
    """A virtual experiment: what is simulated, how it is imaged, how it is correlated."""

    experiment: Experiment = Experiment()
    imaging: ImagingSpec = ImagingSpec()
    correlation: Identification = Identification()

    @field_validator("experiment", mode="before")
    @classmethod
    def _with_material(cls, table: Any) -> Any:
        if not isinstance(table, dict) or not isinstance(table.get("material"), dict):
            return table
        return {**table, "material": of_kind(table["material"], MATERIALS, "experiment.material")}

    @field_validator("imaging", mode="before")
    @classmethod
    def _with_lens(cls, table: Any) -> Any:
        if not isinstance(table, dict) or not isinstance(table.get("distortion"), dict):
            return table
        lens = of_kind(table["distortion"], _LENSES, "imaging.distortion")
        return {**table, "distortion": lens}

    def plain(self) -> dict[str, Any]:
        """The case as plain JSON values, materials by their kind."""
        content = {name: plain(getattr(self, name)) for name in type(self).model_fields}
        content["experiment"]["material"] = kind_of(self.experiment.material, MATERIALS)
        for name in ("tilt", "guided"):  # as before there were any: what is finished stays so
            if not content["experiment"][name]:
                del content["experiment"][name]
        return content


class TwinCase(Case):
    """The twin of a real experiment: its specimen, its photographs, those of the calibration."""

    calibration: CalibrationTarget = CalibrationTarget()


def is_twin(tables: Mapping[str, Any]) -> bool:
    """Whether tables describe the twin of a real experiment."""
    return "calibration" in tables


def read_case(name: str | Path) -> Case:
    """Read a case by the name of a shipped one or by the path of a TOML file.

    The twin of a real experiment is a :class:`TwinCase`.

    Raises
    ------
    InputError
        If there is no such case, it is an infinite lattice, it is not TOML, a key is unknown (the
        nearest known one is suggested) or a value is out of its range.
    """
    tables = read_tables(name)
    if is_lattice(tables):
        raise InputError(
            f"{name}: expected a virtual experiment, got an infinite lattice; run 'modeharvest "
            f"modes {name} --out DIR', or 'modeharvest bloch {name} --out DIR' for its stability"
        )
    return checked(TwinCase if is_twin(tables) else Case, tables, name)
