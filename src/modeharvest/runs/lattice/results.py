"""Result types of the analysis of a lattice, and the content of ``summary.json``.

Its keys: docs/explanation/bloch.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from modeharvest.fem.bloch.dispersion import Dispersion
from modeharvest.fem.bloch.modes import Branch, ModeSet
from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.options import Wave
from modeharvest.idic.spectra.lattice_spectrum import LatticeSpectrum, lattice_spectrum
from modeharvest.idic.spectra.mode_family import (
    FoundFamily,
    mode_family,
    read_family,
    read_spectrum,
)
from modeharvest.runs.lattice.loads import STRAIN, LoadQuantity
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, write_csv
from modeharvest.util.typed import picked, to_plain
from modeharvest.validation.studies.lattice import LatticeModeStudy

if TYPE_CHECKING:
    from modeharvest.fem.bloch.critical import LatticeCritical
    from modeharvest.fem.lattice.cell import CellState, PeriodicCell


_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
DRAWN_AMPLITUDE = 0.16
"""Largest displacement of modes in figures, divided by the unit cell size l [-]."""


def combination_name(combination: Sequence[float] | FloatArray) -> str:
    """Text of a combination of modes: "φ₁ + φ₂", or "0.8 φ₁ − 0.6 φ₂" if magnitudes differ."""
    parts = [(k, c) for k, c in enumerate(combination, start=1) if abs(c) > 1e-6]
    alike = np.ptp([abs(c) for _, c in parts] or [0.0]) < 1e-6
    text = ""
    for k, c in parts:
        text += " − " if c < 0 else " + "
        text += ("" if alike else f"{abs(c):.2g} ") + f"φ{k}".translate(_SUBSCRIPTS)
    return text[3:] if text.startswith(" + ") else "−" + text[3:]


@dataclass(frozen=True)
class CriticalPoint:
    """First instability of a lattice: the content of ``LatticeCritical`` as plain values."""

    loading: str
    load: float
    """Critical load [-]; if no critical point was found, the largest load at which the lattice was
    found stable."""
    found: bool
    outcome: str
    waves: tuple[Wave, ...] = ()
    below: tuple[int, ...] = ()
    above: tuple[int, ...] = ()
    earlier: tuple[Wave, ...] = ()
    """Waves of the grid that are unstable already below the critical load."""
    value: float = 0.0
    """Lowest filling · λ / k² at ``load`` [MPa]."""
    angle: float | None = None
    """Direction of the wave vector of long waves [rad]; None for other waves."""
    splitting: float = 0.0
    splitting_bound: float = 0.0
    """Splitting of a degenerate set by the mesh, and its bound [-]: ``LatticeCritical``."""
    error: float | None = None
    order: float | None = None
    """Estimated excess of the load due to the mesh, and the order of convergence assumed [-]."""

    @classmethod
    def of(
        cls, loading: str, found: LatticeCritical, error: tuple[float, float] | None = None
    ) -> CriticalPoint:
        """From a search's result; waves sorted by rounded phases, largest first."""
        every = zip(found.waves, found.below, found.above, strict=True)
        ordered = sorted(every, key=lambda one: [-round(phase, 3) for phase in one[0]])
        waves, below, above = zip(*ordered, strict=True) if ordered else ((), (), ())
        least = found.least_stable
        return cls(loading, found.load, found.found, found.outcome, waves, below, above,
                   found.unstable_before, least.value, least.angle,
                   found.splitting, found.splitting_bound, *(error or ()))  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class PeriodicField:
    """A periodic field of a lattice, whose mode family is to be determined."""

    file: str
    """Name of the family's file, such as "family_mode_1.json"."""
    name: str
    """Name of the field, such as "φ₁ at 8.8 %"."""
    mesh: Mesh
    lattice: FloatArray
    """Mesh of one period [mm], and its (2, 2) lattice vectors as rows [mm]."""
    displacement: FloatArray
    gradient: FloatArray
    """(n, 2) displacement of nodes, [-] for modes, else [mm]; F̄ (2, 2) of its affine part."""
    info: Mapping[str, Any]
    """Load and other information on the field's origin, as plain JSON values."""
    stable: bool | None = None
    """Whether the equilibrium is stable for fields with the period of its cell; None for a mode,
    which is no equilibrium."""
    energy: float = 0.0
    """Energy per area minus that of the unbuckled lattice [MPa]; 0 except for branches."""

    @classmethod
    def of_mode(cls, modes: ModeSet, k: int, info: Mapping[str, Any]) -> PeriodicField:
        """Field of mode k (from 0) of a set."""
        return cls(
            file=f"family_mode_{k + 1}.json",
            name=f"mode {combination_name(np.eye(len(modes.waves))[k])}",
            mesh=modes.mesh,
            lattice=modes.lattice,
            displacement=modes.shapes[k],
            gradient=np.eye(2),
            info={**info, "load": modes.load, "wave": list(modes.waves[k])},
        )

    @classmethod
    def of_branch(
        cls, modes: ModeSet, k: int, branch: Branch, info: Mapping[str, Any],
        load: LoadQuantity = STRAIN,
    ) -> PeriodicField:  # fmt: skip
        """Displacement in the last state of branch k (from 1)."""
        last = branch.states[-1]
        return cls(
            file=f"family_branch_{k}.json",
            name=f"{combination_name(branch.combination)} at {load.text(last.load)}",
            mesh=modes.mesh,
            lattice=modes.lattice,
            displacement=last.displacement,
            gradient=last.gradient,
            info={**info, "load": last.load, "combination": list(branch.combination)},
            stable=last.negative_eigenvalues == 0,
            energy=last.energy - last.primary_energy,
        )

    @classmethod
    def of_primary(
        cls,
        cell: PeriodicCell,
        state: CellState,
        load: float,
        modes: ModeSet | None,
        info: Mapping[str, Any],
        quantity: LoadQuantity = STRAIN,
    ) -> PeriodicField:
        """The unbuckled lattice at a load, on the modes' cell if there is one."""
        unit, gradient = cell.cell, state.gradient - np.eye(2)
        mesh, lattice = (unit.mesh, unit.lattice) if modes is None else (modes.mesh, modes.lattice)
        w = cell.displacement(state) - unit.mesh.nodes @ gradient.T
        known, wanted = (_in_cell(nodes, unit.lattice) for nodes in (unit.mesh.nodes, mesh.nodes))
        same = cKDTree(known, boxsize=1.0).query(wanted)[1]
        return cls(
            file="family_primary.json",
            name=f"primary path at {quantity.text(load)}",
            mesh=mesh,
            lattice=lattice,
            displacement=w[same] + mesh.nodes @ gradient.T,
            gradient=state.gradient,
            info={**info, "load": load},
            stable=True,
        )

    @property
    def fluctuation(self) -> FloatArray:
        """(n, 2) displacement without the affine part."""
        affine = self.mesh.nodes @ (self.gradient - np.eye(2)).T
        return np.asarray(self.displacement - affine)

    def scaled(self, largest: float) -> PeriodicField:
        """The mode, scaled to this largest displacement [mm]."""
        shape = self.displacement
        u = largest / float(np.linalg.norm(shape, axis=1).max()) * shape
        return replace(self, displacement=u)

    def analysed(self, pitch: float) -> FoundPattern:
        """The field with its spectrum and family; ``pitch``: unit cell size l [mm]."""
        place = (self.mesh, self.lattice, self.fluctuation, pitch)
        family = mode_family(*place, info={**self.info, "of": self.name})
        return FoundPattern(**vars(self), spectrum=lattice_spectrum(*place), family=family)


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundPattern(PeriodicField):
    """A periodic field with the spectrum and the mode family of its fluctuation."""

    spectrum: LatticeSpectrum
    family: FoundFamily

    @classmethod
    def read(cls, pattern: PeriodicField, folder: Path) -> FoundPattern:
        """A field with spectrum and family of its file in a folder; InputError if incomplete."""
        path = folder / pattern.file
        family, spectrum = read_family(path), read_spectrum(path)
        if spectrum is None:
            raise InputError(f"expected Fourier coefficients in {path}, found none; make it again")
        return cls(**vars(pattern), spectrum=spectrum, family=family)


def _in_cell(nodes: FloatArray, lattice: FloatArray) -> FloatArray:
    """(n, 2) fractional coordinates in [0, 1) of nodes in the cell of a lattice."""
    fractional = np.mod(nodes @ np.linalg.inv(lattice), 1.0)
    return np.asarray(np.mod(fractional, 1.0))  # the modulo of -1e-17 is 1


@dataclass(frozen=True, eq=False)
class LatticeRun:
    """Data of the report of a lattice; parts that are None or empty are omitted."""

    title: str
    case: Mapping[str, Any]
    """The case, as plain values."""
    command: str
    """The command that reproduces the report."""
    mesh: Mesh
    lattice: FloatArray
    """Mesh of the primitive cell [mm] and its (2, 2) lattice vectors as rows [mm]."""
    pitch: float
    """Unit cell size l [mm]."""
    load: LoadQuantity = STRAIN
    """The quantity that the load parameter stands for."""
    critical: CriticalPoint | None = None
    dispersion: Dispersion | None = None
    modes: ModeSet | None = None
    branches: Sequence[Branch] = ()
    patterns: Sequence[FoundPattern] = ()
    """Fields on the cell of ``modes``; the first one is shown at the top."""
    study: LatticeModeStudy | None = None
    exports: Mapping[str, str] = field(default_factory=dict)
    """Files in the folder of the report, with a description of each."""
    notes: Sequence[str] = ()
    """Notes on the reliability of the numbers."""
    versions: Mapping[str, str] = field(default_factory=dict)


_EXPORTS = {
    "dispersion.h5": "eigenvalues along the path and over the zone (HDF5)",
    "dispersion.csv": "eigenvalues along the path, for own plots",
    "modes.h5": "modes and branches on their mesh (HDF5), without loss",
    "modes.vtu": "the same for ParaView",
    "modes.xdmf": "the same as XDMF",
    "study.csv": "every lattice of the study",
}
_CRITICAL = (
    "loading found load waves value below above earlier splitting splitting_bound error order"
)
_FAMILY = "mode family and Fourier coefficients"
_PEAKS = 8


def exports_in(folder: Path) -> dict[str, str]:
    """Files for further use that exist in a folder, with a description of each."""
    known = {name: text for name, text in _EXPORTS.items() if (folder / name).is_file()}
    index = folder / "families.json"
    families = read_json(index) if index.is_file() else {}
    return {**known, **{file: f"{_FAMILY}: {of}" for file, of in families.items()}}


def summary_of(run: LatticeRun, families: Sequence[FoundPattern]) -> dict[str, Any]:
    """The content of ``summary.json``."""
    critical, modes, study = run.critical, run.modes, run.study
    return {
        "title": run.title,
        "command": run.command,
        "case": dict(run.case),
        "outcome": critical.outcome if critical else "",
        "load": to_plain(run.load),
        "critical": critical and {
            **to_plain(picked(critical, _CRITICAL)),
            "long_wave_angle": critical.angle,
        },
        **_eigenvalues(run.dispersion),
        "modes": modes and {
            **to_plain(picked(modes, "load waves primitive eigenvalues")),
            "copies": modes.info["copies"],
        },
        "branches": [_branch(branch) for branch in run.branches],
        "families": [_family(found) for found in families],
        "study": study and _study(study),
        "notes": list(run.notes),
        "files": dict(run.exports),
        "versions": dict(run.versions),
    }  # fmt: skip


def _branch(branch: Branch) -> dict[str, Any]:
    names = "load energy primary_energy negative_eigenvalues"
    states = [
        {**picked(state, names), "amplitudes": state.amplitudes.tolist()} for state in branch.states
    ]
    return {"combination": list(branch.combination), "outcome": branch.outcome, "states": states}


def _family(found: FoundPattern) -> dict[str, Any]:
    family = found.family
    return {
        "of": found.name,
        "family": family.family.name,
        "captured": family.captured,
        "waves": family.waves.tolist(),
        "parameters": family.family.size,
        "found": list(family.text),
        "peaks": to_plain(found.spectrum.peaks[:_PEAKS]),
    }


def _study(study: LatticeModeStudy) -> dict[str, Any]:
    rows = (*study.ratios, *study.scales, *study.materials)
    overlaps = [row.overlap for row in rows]
    limits = to_plain(study.limits)
    return {"lattices": len(rows), "overlap": [min(overlaps), max(overlaps)], "limits": limits}


def _eigenvalues(found: Dispersion | None) -> dict[str, Any]:
    if found is None:
        return {"dispersion": [], "zone": []}
    along = []
    for load, values in zip(found.loads, found.eigenvalues[..., 0], strict=True):
        pairs = zip(found.labels, found.stops, strict=True)
        corners = [[label, float(values[stop])] for label, stop in pairs]
        along.append({"load": float(load), "corners": corners})
    least = [(part.load, *part.least_stable) for part in found.zone]
    zone = [{"load": e, "wave": list(wave), "eigenvalue": value} for e, value, wave in least]
    return {"dispersion": along, "zone": zone}


def write_dispersion_table(found: Dispersion, path: Path | str) -> None:
    """Write the path as a CSV table for plotting: one row for each load and wave vector."""
    at = dict(zip(found.stops, found.labels, strict=True))
    bands = [f"eigenvalue_{k + 1}_N_per_mm4" for k in range(found.bands)]
    head = ["load", "corner", "phase_1_rad", "phase_2_rad", "distance_rad_per_mm", *bands]
    rows = [
        (f"{load:.9g}", at.get(k, ""), *(f"{x:.9g}" for x in (*wave, found.distances[k], *row)))
        for load, values in zip(found.loads, found.eigenvalues, strict=True)
        for k, (wave, row) in enumerate(zip(found.waves, values, strict=True))
    ]
    write_csv(path, head, rows)
