"""What the analysis of a lattice found: its result types, and their ``summary.json``.

Keys of the latter; loads are nominal strains or what else the case's loading makes of the load
parameter [-], waves are phases (k . a1, k . a2) [rad], eigenvalues those of K x = lambda M x with M
of unit density [N/mm^4]:

``title``, ``case``
    What was run.
``outcome``
    In words: critical at which load, or up to which load it was found stable.
``critical``
    ``loading``, ``found``, ``load`` (critical, or the largest reached), ``waves`` (the whole
    degenerate set; empty for long waves), ``long_wave_angle`` [rad] or null, ``value`` (lowest
    filling · lambda / k² at that load [MPa]); the proof: ``below`` and ``above`` (negative
    eigenvalues at each wave a millionth of the load below and above), ``earlier`` (waves of the
    grid that are unstable already below).
``dispersion``
    A list, one entry for each load: ``load``, ``corners`` (names and lowest eigenvalues of the
    path's corners).
``zone``
    For each map of the whole zone: ``load``, the ``wave`` of its grid with the lowest λ / k², and
    its ``eigenvalue``.
``modes``
    Null without, else: ``load`` (whose tangent they belong to), ``copies`` (m, n: of the primitive
    cell), ``waves`` and ``eigenvalues`` of each mode.
``branches``
    A list: ``combination`` of the modes it starts with, ``outcome`` in words, and ``states``, each
    with ``load``, ``energy`` and ``primary_energy`` (per area of the cell, of the branch and of the
    unbuckled lattice at the same load [MPa]), ``negative_eigenvalues`` (0: stable against the
    branch's own period) and ``amplitudes`` of the modes [mm].
``families``
    A list: ``of`` (which field), ``family``, ``captured`` (share of the field's energy [-]),
    ``waves`` (rows A, B, kx, ky [-], c [mm]), ``parameters`` (number), ``found`` (sentences),
    ``peaks`` (wave vectors [1/l], S_xx + S_yy [mm^6], shares).
``study``
    Null without, else: ``lattices`` (how many; ``study.csv`` has them all), ``overlap`` (smallest
    and largest with the analytic mode) and ``limits``: for each ``loading`` between which d/l
    (``without``, ``with_``) the pattern stops being what buckles first, and what does ``instead``.
``notes``
    What a reader should know.
``files``
    Names of the files beside this one, and what is in them.
``versions``
    With which software; what it took is in ``timings.json``.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modeharvest.fem.bloch.dispersion import Dispersion
from modeharvest.fem.bloch.modes import Branch, ModeSet
from modeharvest.fem.field import Mesh
from modeharvest.fem.lattice.options import Wave
from modeharvest.idic.spectra.lattice_spectrum import LatticeSpectrum, lattice_spectrum
from modeharvest.idic.spectra.mode_family import FoundFamily, mode_family
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import atomic, read_json
from modeharvest.validation.studies.lattice import LatticeModeStudy

if TYPE_CHECKING:
    from modeharvest.fem.bloch.critical import LatticeCritical


_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def combination_name(combination: Sequence[float]) -> str:
    """Modes and signs, with numbers where their sizes differ: "φ₁ + φ₂" or "0.8 φ₁ − 0.6 φ₂"."""
    parts = [(k, c) for k, c in enumerate(combination, start=1) if abs(c) > 1e-6]
    alike = np.ptp([abs(c) for _, c in parts] or [0.0]) < 1e-6
    text = ""
    for k, c in parts:
        text += " − " if c < 0 else " + "
        text += ("" if alike else f"{abs(c):.2g} ") + f"φ{k}".translate(_SUBSCRIPTS)
    return text[3:] if text.startswith(" + ") else "−" + text[3:]


DRAWN_AMPLITUDE = 0.16
"""Largest displacement that modes are drawn with [l]."""


@dataclass(frozen=True)
class CriticalPoint:
    """What ``LatticeCritical`` says, in plain values: where a lattice first becomes unstable.

    Parameters
    ----------
    loading
        Its name, e.g. "uniaxial".
    load
        Critical load [-]; without one, the largest at which the lattice was found stable.
    found
        Whether there is a critical point up to there.
    outcome
        In words.
    waves
        Phases (k . a1, k . a2) of the critical waves [rad]; empty for long waves.
    below, above
        Negative eigenvalues at each of them a millionth of the load below and above.
    earlier
        Waves of the grid that are unstable already below.
    value
        Lowest measure filling · λ / k² at ``load`` [MPa].
    angle
        Direction of long waves [rad]; None for others.
    """

    loading: str
    load: float
    found: bool
    outcome: str
    waves: tuple[Wave, ...] = ()
    below: tuple[int, ...] = ()
    above: tuple[int, ...] = ()
    earlier: tuple[Wave, ...] = ()
    value: float = 0.0
    angle: float | None = None

    @classmethod
    def of(cls, loading: str, found: LatticeCritical) -> CriticalPoint:
        """Take the plain values of a search's result."""
        least = found.least_stable
        return cls(loading, found.load, found.found, found.outcome, found.waves, found.below,
                   found.above, found.unstable_before, least.value, least.angle)  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class PeriodicField:
    """A periodic field of a lattice, in which a mode family is looked for.

    Parameters
    ----------
    file
        Name of the family's file, such as "family_mode_1.json".
    name
        What it is, such as "φ₁ at 8.8 %".
    mesh, lattice
        One period [mm], with its (2, 2) lattice vectors as rows [mm].
    displacement, gradient
        (n, 2) of the nodes, [-] for modes, [mm] otherwise; its affine part has this F̄ (2, 2).
    info
        Load and whatever else must be known of it, as plain JSON values.
    stable
        Whether it is an equilibrium that is stable for fields with the period of its cell; None
        for a mode, which is no equilibrium.
    energy
        Beyond that of the unbuckled lattice, per area [MPa]; 0 for all but branches.
    """

    file: str
    name: str
    mesh: Mesh
    lattice: FloatArray
    displacement: FloatArray
    gradient: FloatArray
    info: Mapping[str, Any]
    stable: bool | None = None
    energy: float = 0.0

    @classmethod
    def of_mode(cls, modes: ModeSet, k: int, info: Mapping[str, Any]) -> PeriodicField:
        """Mode k (from 0) of a set."""
        name = combination_name([float(j == k) for j in range(len(modes.waves))])
        return PeriodicField(
            file=f"family_mode_{k + 1}.json",
            name=f"mode {name}",
            mesh=modes.mesh,
            lattice=modes.lattice,
            displacement=modes.shapes[k],
            gradient=np.eye(2),
            info={**info, "load": modes.load, "wave": list(modes.waves[k])},
        )

    @classmethod
    def of_branch(
        cls, modes: ModeSet, k: int, branch: Branch, info: Mapping[str, Any]
    ) -> PeriodicField:
        """The last state of branch k (from 1)."""
        last = branch.states[-1]
        return PeriodicField(
            file=f"family_branch_{k}.json",
            name=f"{combination_name(branch.combination)} at {100 * last.load:.4g} %",
            mesh=modes.mesh,
            lattice=modes.lattice,
            displacement=last.displacement,
            gradient=last.gradient,
            info={**info, "load": last.load, "combination": list(branch.combination)},
            stable=last.negative_eigenvalues == 0,
            energy=last.energy - last.primary_energy,
        )

    @property
    def fluctuation(self) -> FloatArray:
        """(n, 2) displacement without the affine part."""
        affine = self.mesh.nodes @ (self.gradient - np.eye(2)).T
        return np.asarray(self.displacement - affine)

    def scaled(self, largest: float) -> PeriodicField:
        """A mode with this largest displacement [mm]."""
        shape = self.displacement
        u = largest / float(np.linalg.norm(shape, axis=1).max()) * shape
        return replace(self, displacement=u)

    def analysed(self, pitch: float) -> FoundPattern:
        """The same with its spectrum and family; ``pitch``: unit cell size l [mm]."""
        place = (self.mesh, self.lattice, self.fluctuation, pitch)
        family = mode_family(*place, info={**self.info, "of": self.name})
        return FoundPattern(**vars(self), spectrum=lattice_spectrum(*place), family=family)


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundPattern(PeriodicField):
    """A periodic field with the spectrum and the mode family of its fluctuation."""

    spectrum: LatticeSpectrum
    family: FoundFamily


@dataclass(frozen=True, eq=False)
class LatticeRun:
    """All that the report of a lattice shows; what is None or empty is left out.

    Parameters
    ----------
    title
        Of the page.
    case
        What was run, as plain values.
    command
        That makes this page again.
    mesh, lattice
        Primitive cell [mm], and its (2, 2) lattice vectors as rows [mm].
    pitch
        Unit cell size l [mm].
    critical
        First critical points, one for each loading.
    dispersion
        Lowest eigenvalues along a path and over the zone.
    modes, branches
        At the critical point, and what leaves there.
    patterns
        On the cell of ``modes``; the first is shown at the top.
    study
        How the pattern depends on d/l and more.
    exports
        Files beside the page, and what each holds.
    notes
        What a reader should know before trusting the numbers.
    versions
        Of software.
    """

    title: str
    case: Mapping[str, Any]
    command: str
    mesh: Mesh
    lattice: FloatArray
    pitch: float
    critical: Sequence[CriticalPoint] = ()
    dispersion: Dispersion | None = None
    modes: ModeSet | None = None
    branches: Sequence[Branch] = ()
    patterns: Sequence[FoundPattern] = ()
    study: LatticeModeStudy | None = None
    exports: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.patterns and self.modes is None:
            raise InputError("lattice report: expected the modes of the patterns, got none")


_EXPORTS = {
    "dispersion.h5": "eigenvalues along the path and over the zone (HDF5)",
    "dispersion.csv": "eigenvalues along the path, for own plots",
    "modes.h5": "modes and branches on their mesh (HDF5), without loss",
    "modes.vtu": "the same for ParaView",
    "modes.xdmf": "the same as XDMF",
    "study.csv": "every lattice of the study",
}
_FAMILY = "mode family and Fourier coefficients"
_PEAKS = 8


def exports_in(folder: Path) -> dict[str, str]:
    """Files for further use that are in a folder, and what is in them."""
    known = {name: text for name, text in _EXPORTS.items() if (folder / name).is_file()}
    index = folder / "families.json"
    families = read_json(index) if index.is_file() else {}
    return {**known, **{file: f"{_FAMILY}: {of}" for file, of in families.items()}}


def summary_of(run: LatticeRun, families: Sequence[FoundPattern]) -> dict[str, Any]:
    """The content of ``summary.json``."""
    critical = run.critical[0] if run.critical else None
    return {
        "title": run.title,
        "case": dict(run.case),
        "outcome": critical.outcome if critical else "",
        "critical": _critical(critical) if critical else None,
        **_eigenvalues(run.dispersion),
        "modes": None if run.modes is None else _modes(run.modes),
        "branches": [_branch(branch) for branch in run.branches],
        "families": [_family(found) for found in families],
        "study": None if run.study is None else _study(run.study),
        "notes": list(run.notes),
        "files": dict(run.exports),
        "versions": dict(run.versions),
    }


def _modes(modes: ModeSet) -> dict[str, Any]:
    return {
        "load": modes.load,
        "copies": modes.info["copies"],
        "waves": [list(wave) for wave in modes.waves],
        "eigenvalues": modes.eigenvalues.tolist(),
    }


def _branch(branch: Branch) -> dict[str, Any]:
    names = ("load", "energy", "primary_energy", "negative_eigenvalues")
    states = [
        {**{name: getattr(state, name) for name in names}, "amplitudes": state.amplitudes.tolist()}
        for state in branch.states
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
        "peaks": [asdict(peak) for peak in found.spectrum.peaks[:_PEAKS]],
    }


def _study(study: LatticeModeStudy) -> dict[str, Any]:
    rows = (*study.ratios, *study.scales, *study.materials)
    overlaps = [row.overlap for row in rows]
    return {
        "lattices": len(rows),
        "overlap": [min(overlaps), max(overlaps)],
        "limits": [asdict(limit) for limit in study.limits],
    }


def _critical(point: CriticalPoint) -> dict[str, Any]:
    names = ("loading", "found", "load", "waves", "value", "below", "above", "earlier")
    return {**{n: getattr(point, n) for n in names}, "long_wave_angle": point.angle}


def _eigenvalues(found: Dispersion | None) -> dict[str, Any]:
    if found is None:
        return {"dispersion": [], "zone": []}
    along = []
    for load, values in zip(found.loads, found.eigenvalues[..., 0], strict=True):
        pairs = zip(found.labels, found.stops, strict=True)
        corners = [[label, float(values[stop])] for label, stop in pairs]
        along.append({"load": float(load), "corners": corners})
    zone = [
        {"load": part.load, "wave": list(part.least_stable[1]), "eigenvalue": part.least_stable[0]}
        for part in found.zone
    ]
    return {"dispersion": along, "zone": zone}


def write_dispersion_table(found: Dispersion, path: Path | str) -> None:
    """Write the path as a table for own plots: a row for each load and wave vector."""
    at = dict(zip(found.stops, found.labels, strict=True))
    bands = [f"eigenvalue_{k + 1}_N_per_mm4" for k in range(found.bands)]
    head = ["load", "corner", "phase_1_rad", "phase_2_rad", "distance_rad_per_mm", *bands]
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(head)
        for load, values in zip(found.loads, found.eigenvalues, strict=True):
            for k, (wave, row) in enumerate(zip(found.waves, values, strict=True)):
                numbers = [*wave, found.distances[k], *row]
                table.writerow([f"{load:.9g}", at.get(k, ""), *(f"{x:.9g}" for x in numbers)])
