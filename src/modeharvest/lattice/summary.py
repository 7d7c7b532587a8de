"""``summary.json`` of a lattice's analysis.

Its keys; loads are nominal strains or what else the case's loading makes of the load parameter
[-], waves are phases (k . a1, k . a2) [rad], eigenvalues those of K x = lambda M x with M of unit
density [N/mm^4]:

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
    Names of the files beside this one, and what they hold.
``versions``
    With which software; what it took is in ``timings.json``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from modeharvest.fem.dispersion import Dispersion
from modeharvest.fem.modes import Branch, ModeSet
from modeharvest.files import read_json
from modeharvest.lattice.case import LatticeCase
from modeharvest.validation.lattice.mode_study import ModeStudy
from modeharvest.validation.lattice.run import CriticalPoint, FoundPattern, LatticeRun

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
    """Files for further use that are in a folder, and what they hold."""
    known = {name: text for name, text in _EXPORTS.items() if (folder / name).is_file()}
    index = folder / "families.json"
    families = read_json(index) if index.is_file() else {}
    return {**known, **{file: f"{_FAMILY}: {of}" for file, of in families.items()}}


def summary_of(
    run: LatticeRun, case: LatticeCase, families: Sequence[FoundPattern]
) -> dict[str, Any]:
    """The content of ``summary.json``."""
    (critical,) = run.critical
    return {
        "title": run.title,
        "case": case.plain(),
        "outcome": critical.outcome,
        "critical": _critical(critical),
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
        "found": list(family.sentences),
        "peaks": [asdict(peak) for peak in found.spectrum.peaks[:_PEAKS]],
    }


def _study(study: ModeStudy) -> dict[str, Any]:
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
        {"load": part.load, "wave": list(part.softest[1]), "eigenvalue": part.softest[0]}
        for part in found.zone
    ]
    return {"dispersion": along, "zone": zone}
