"""``report.html`` of an infinite lattice: one page like the paper's Figs. "modes" and "graded"."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from modeharvest.fem.bloch.modes import Branch
from modeharvest.fem.lattice.options import Wave
from modeharvest.idic.spectra.lattice_spectrum import upward
from modeharvest.report.figures.lattice import (
    draw_amplitudes,
    draw_captured,
    draw_critical_strains,
    draw_differences,
    draw_dispersion,
    draw_energies,
    draw_growth,
    draw_lattice,
    draw_lattice_spectrum,
    draw_overlaps,
    draw_overlay,
    draw_zone_map,
)
from modeharvest.report.figures.outlines import LatticePatch
from modeharvest.report.figures.style import to_svg
from modeharvest.report.model import Picture, material_text, render, short
from modeharvest.runs.lattice.results import (
    DRAWN_AMPLITUDE,
    FoundPattern,
    LatticeRun,
    combination_name,
)
from modeharvest.util.arrays import FloatArray
from modeharvest.util.files import atomic
from modeharvest.util.progress import Progress, silent
from modeharvest.validation.studies.lattice import LatticeModeStudy
from modeharvest.validation.studies.lattice_pattern import ModeRow, PatternMode

if TYPE_CHECKING:
    from modeharvest.runs.lattice.results import CriticalPoint


_KINDS = {
    "pattern": "(π, π)",
    "long waves": "long waves",
    "other waves": "other waves",
    "none": "none in the range",
    "path ends": "the path ends before",
}


def wave_name(wave: Wave) -> str:
    """Phases in units of pi where they are simple fractions of it: "(π, 0)", "(4π/3, 2π/3)"."""
    return f"({', '.join(_phase(phase) for phase in wave)})"


def _phase(phase: float) -> str:
    part = Fraction(phase / math.pi).limit_denominator(12)
    if abs(float(part) - phase / math.pi) > 1e-4:
        return f"{phase:.4g}".replace("-", "−")
    if part == 0:
        return "0"
    above = "" if abs(part.numerator) == 1 else str(abs(part.numerator))
    below = "" if part.denominator == 1 else f"/{part.denominator}"
    return ("−" if part < 0 else "") + f"{above}π{below}"


def percent(value: float, digits: int = 4) -> str:
    """A share or a strain in percent, without the sign of it."""
    return "–" if math.isnan(value) else f"{100 * value:.{digits}g}"


def waves_text(point: CriticalPoint) -> str:
    """The critical waves of a point, long ones by their direction."""
    if not point.found:
        return "–"
    if point.angle is not None:
        return f"long waves along {math.degrees(point.angle) + 0.0:.3g}°"
    return ", ".join(wave_name(wave) for wave in point.waves)


def proof(point: CriticalPoint) -> str:
    """What shows that the point is critical, and the first one."""
    if not point.found:
        return f"lowest measure {short(point.value)} MPa, above zero"
    if point.angle is not None:
        said = "the acoustic tensor of the effective moduli is singular"
    else:
        below, above = (", ".join(map(str, n)) for n in (point.below, point.above))
        said = f"negative eigenvalues a millionth below: {below}, above: {above}"
    others = len(point.earlier)
    return said + (f"; but {others} other waves are unstable before" if others else
                   "; no other wave of the grid is unstable before")  # fmt: skip


def key_numbers(run: LatticeRun) -> list[dict[str, str]]:
    """The few numbers at the top: what they are called, the number, its unit, a remark."""
    keys = []
    if run.critical:
        point = run.critical[0]
        keys += [
            _key("critical strain" if point.found else "stable up to", percent(point.load), "%",
                 point.loading),
            _waves_key(point, run) if point.found else
            _key("lowest measure", short(point.value), "MPa", "filling · λ / k², above zero"),
        ]  # fmt: skip
        if point.found and point.angle is None:
            before = f"{sum(point.below)} → {sum(point.above)}"
            keys.append(_key("negative eigenvalues", before, "", "a millionth below → above"))
    if run.patterns:
        family = next((p for p in run.patterns if p.stable), run.patterns[0]).family
        waves = family.family.wave_count
        keys += [
            _key("captured", percent(family.captured, 3), "%",
                 f"of the pattern's energy, by {waves} wave{'s' * (waves != 1)}"),
            _key("mode family", str(family.family.size), "parameters", family.family.name),
        ]  # fmt: skip
    stable = [b for b in run.branches if b.states and b.states[-1].negative_eigenvalues == 0]
    if stable:
        low = min(stable, key=lambda b: b.states[-1].energy - b.states[-1].primary_energy)
        keys.append(_key("stable branch", combination_name(low.combination), "",
                         f"lowest energy at {percent(low.states[-1].load)} %"))  # fmt: skip
    return keys


def _waves_key(point: CriticalPoint, run: LatticeRun) -> dict[str, str]:
    copies = (run.modes.info if run.modes is not None else {}).get("copies")
    remark = f"repeat after {copies[0]} × {copies[1]} cells" if copies else "phases (k·a₁, k·a₂)"
    named = waves_text(point)
    if len(point.waves) > 1:
        return _key("critical waves", str(len(point.waves)), "at once", named)
    return _key("critical wave", "long" if point.angle is not None else named, "", remark)


def _key(name: str, value: str, unit: str, remark: str) -> dict[str, str]:
    return {"name": name, "value": value, "unit": unit, "remark": remark}


def branch_rows(branches: Sequence[Branch]) -> list[dict[str, Any]]:
    """Rows of the table of branches, at their last state."""
    rows = []
    for branch in branches:
        row: dict[str, Any] = {"name": combination_name(branch.combination),
                               "outcome": branch.outcome}  # fmt: skip
        if branch.states:
            state = branch.states[-1]
            row |= {
                "load": percent(state.load),
                "excess": 1e3 * (state.energy - state.primary_energy),
                "negative": state.negative_eigenvalues,
                "amplitudes": ", ".join(short(float(a)) for a in _cleared(state.amplitudes)),
            }
        rows.append(row)
    return rows


def _cleared(amplitudes: FloatArray) -> FloatArray:
    """What is nothing beside the largest is 0."""
    return np.where(np.abs(amplitudes) > 1e-6 * np.abs(amplitudes).max(), amplitudes, 0.0)


def study_text(study: LatticeModeStudy) -> list[str]:
    """What a study says, drawn from its rows."""
    said = []
    for limit in study.limits:
        said.append(
            f"Under {limit.loading} loading the pattern is what buckles first from d/l = "
            f"{limit.with_:.4g} on; at {limit.without:.4g} it is {_KINDS[limit.instead]}."
        )
    limited = {limit.loading for limit in study.limits}
    for loading in dict.fromkeys(row.loading for row in study.ratios):
        rows = [row for row in study.ratios if row.loading == loading]
        if loading not in limited and all(row.is_first for row in rows):
            ratios = [row.ratio for row in rows]
            said.append(f"Under {loading} loading it is the first for every d/l "
                        f"looked at, from {min(ratios):.4g} to {max(ratios):.4g}.")  # fmt: skip
    if study.ratios:
        best = max(study.ratios, key=lambda row: row.overlap)
        worst = min(study.ratios, key=lambda row: row.overlap)
        said.append(
            f"The overlap with Eq. (mode) lies between {worst.overlap:.3f} (d/l = "
            f"{worst.ratio:.4g}, {worst.loading}) and {best.overlap:.4f} (d/l = {best.ratio:.4g}, "
            f"{best.loading})."
        )
    said += _likeness_text(study.scales, "cell sizes", "1 to rounding by construction: equations and "
                      "mesh scale, only rounding differs")  # fmt: skip
    said += _likeness_text(study.materials, "materials", "")
    return said


def _likeness_text(rows: Sequence[ModeRow], what: str, remark: str) -> list[str]:
    known = [row.likeness for row in rows if not math.isnan(row.likeness)]
    if not known:
        return []
    least = min(known)
    number = f"1 − {short(1 - least)}" if 0 < 1 - least < 1e-4 else f"{least:.6g}"
    text = f"Modes of other {what} overlap with the reference's by at least {number}"
    return [text + (f" ({remark})." if remark else ".")]


def study_rows(rows: Sequence[ModeRow]) -> list[dict[str, Any]]:
    """Rows of the study's tables."""
    return [
        {
            "material": row.material,
            "loading": row.loading,
            "pitch": row.pitch,
            "ratio": row.ratio,
            "first": percent(row.first) if row.found else f"> {percent(row.first)}",
            "kind": _KINDS[row.kind],
            "is_first": row.is_first,
            "pattern": percent(row.pattern),
            "overlap": f"{row.overlap:.4f}",
            "captured": f"{percent(row.captured)} ({row.waves})",
            "likeness": "–" if math.isnan(row.likeness) else f"{row.likeness:.6f}",
        }
        for row in rows
    ]


def notes(run: LatticeRun) -> list[str]:
    """What a reader should know before trusting the numbers, drawn from the data."""
    said = list(run.notes)
    for point in run.critical:
        if not point.found:
            said.append(
                f"Under {point.loading} no critical point was found up to {percent(point.load)} %. "
                f"That is no proof beyond: {point.outcome}."
            )
        elif point.angle is not None:
            said.append(
                f"Under {point.loading} waves much longer than the cell come first: a loss of "
                "ellipticity of the effective medium, which no finite cell has as a mode."
            )
    if any(branch.states for branch in run.branches):
        said.append(
            "Stability of branches is judged for fields with the period of the cell shown; longer "
            "waves are not looked at there. Contact is not modelled."
        )
    if run.study is not None:
        said.append(
            "The paper does not give its material constants, and its overlays show the mode that "
            "was identified in a specimen; here the analytic mode is Eq. (mode) with its ideal "
            "parameters."
        )
    said.append(
        "The spectral densities are of a field that is zero in the holes, integrated over one cell "
        "that repeats; they are drawn in decibels, so that small ones are seen."
    )
    return said


LATTICE_TEMPLATE = "lattice.html"
WORDS = {
    "percent": percent,
    "key_numbers": key_numbers,
    "branch_rows": branch_rows,
    "study_sentences": study_text,
    "study_rows": study_rows,
    "notes": notes,
    "waves_in_words": waves_text,
    "proof": proof,
}
"""What the template calls by name."""
CELLS = 4
"""Unit cells along the side of a picture's window."""
VISIBLE = 0.12
"""Largest fluctuation that a deformed lattice is drawn with, at least [l]."""


def write_lattice_report(path: Path | str, run: LatticeRun, progress: Progress = silent) -> None:
    """Write the report of a lattice, atomically.

    Parameters
    ----------
    path
        The HTML file.
    run
        What it shows.
    progress
        Listener.
    """
    parts = [_hero, _reference, _patterns, _dispersion, _modes, _branches, _study]
    content: dict[str, Any] = {}
    for n, part in enumerate(parts):
        progress(n, len(parts), "report")
        content[part.__name__.removeprefix("_")] = part(run)
    material = material_text(run.case["material"])
    page = render(
        LATTICE_TEMPLATE, title=run.title, run=run, words=WORDS, material=material, **content
    )
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")
    progress(1, 1, "report")


def _lattice_picture(name: str, label: str, drawn: Figure, fact: str = "") -> Picture:
    return Picture(name, label, to_svg(drawn, name, label), fact)


def _window(run: LatticeRun, width: float, height: float) -> LatticePatch:
    """Cells of the modes where there are some, primitive ones otherwise [l]."""
    mesh, lattice = run.mesh, run.lattice
    if run.modes is not None:
        mesh, lattice = run.modes.mesh, run.modes.lattice
    return LatticePatch.of(mesh, lattice, (width * run.pitch, height * run.pitch))


def _hero(run: LatticeRun) -> str:
    if run.modes is None:
        drawn = draw_lattice(_window(run, CELLS, CELLS), run.pitch)
    else:
        shape, patterns = run.modes.shapes[0], run.patterns
        if patterns:
            shown = next((p for p in patterns if p.stable), patterns[0])
            shape = shown.fluctuation
        drawn = draw_growth(_window(run, 7.0, 5.6), shape, DRAWN_AMPLITUDE * run.pitch, run.pitch)
    return to_svg(drawn, "hero", "The lattice and its pattern")


def _reference(run: LatticeRun) -> Picture:
    drawn = draw_lattice(_window(run, CELLS, CELLS), run.pitch)
    return _lattice_picture("reference", "Reference", drawn, "dashed: the cell that repeats")


def _patterns(run: LatticeRun) -> list[dict[str, Any]]:
    """For each pattern the deformed lattice and both densities, and its family."""
    return [
        {"found": found, "waves": found.family.waves,
         "pictures": [_deformed(run, found, n), *_densities(found, n)]}
        for n, found in enumerate(run.patterns, start=1)
    ]  # fmt: skip


def _deformed(run: LatticeRun, found: FoundPattern, n: int) -> Picture:
    """The deformed lattice; a fluctuation that is too small to be seen is magnified."""
    assert run.modes is not None
    fluctuation = found.fluctuation
    largest = float(np.linalg.norm(fluctuation, axis=1).max()) / run.pitch
    factor = DRAWN_AMPLITUDE / largest if found.stable is None else max(1.0, VISIBLE / largest)
    u = found.displacement + (factor - 1.0) * fluctuation
    drawn = draw_lattice(_window(run, CELLS, CELLS), run.pitch, u, found.gradient)
    if found.stable is None:
        fact = f"a mode, no equilibrium; largest displacement {DRAWN_AMPLITUDE} l"
    else:
        fact = "stable; " if found.stable else "unstable; "
        fact += f"fluctuation × {factor:.3g}" if factor > 1.005 else "true to scale"
    return _lattice_picture(f"deformed-{n}", "Deformed", drawn, fact)


def _densities(found: FoundPattern, n: int) -> list[Picture]:
    spectrum = found.spectrum
    both = {"xx": spectrum.S_xx, "yy": spectrum.S_yy}
    largest = float(max(S.max() for S in both.values()))
    pictures = []
    for name, S in both.items():
        up = np.where(upward(spectrum.xi), S, 0.0)
        xi = [float(x) for x in spectrum.xi[int(np.argmax(up))]]
        of = "" if found.stable is None else f" {short(float(S.max()))} mm⁶"  # a mode has no size
        fact = f"largest{of} at ±({short(xi[0])}, {short(xi[1])})"
        svg = to_svg(draw_lattice_spectrum(spectrum.xi, S, largest), f"S{name}-{n}", f"S_{name}")
        pictures.append(Picture(f"S{name}-{n}", Markup(f"S<sub>{name}</sub>"), svg, fact))
    return pictures


def _dispersion(run: LatticeRun) -> dict[str, Any]:
    """The path's curves and the zone's maps."""
    found = run.dispersion
    if found is None:
        return {}
    waves = [wave for point in run.critical for wave in point.waves]
    return {
        "path": _lattice_picture("dispersion-path", "Along a path", draw_dispersion(found, waves)),
        "maps": [
            _lattice_picture(f"zone-{n}", f"At {100 * part.load:.4g} %",
                     draw_zone_map(part, run.pitch, waves))
            for n, part in enumerate(found.zone, start=1)
        ],
    }  # fmt: skip


def _modes(run: LatticeRun) -> list[Picture]:
    """Every mode of the set upon the undeformed lattice."""
    modes = run.modes
    if modes is None:
        return []
    still, pictures = _window(run, CELLS, CELLS), []
    for k, (wave, value) in enumerate(zip(modes.waves, modes.eigenvalues, strict=True)):
        shape = modes.shapes[k]
        u = DRAWN_AMPLITUDE * run.pitch / float(np.linalg.norm(shape, axis=1).max()) * shape
        name = combination_name([float(j == k) for j in range(len(modes.waves))])
        label = f"{name} · wave {wave_name(wave)}"
        fact = f"eigenvalue {short(float(value))} N/mm⁴"
        pictures.append(
            _lattice_picture(f"mode-{k + 1}", label, draw_lattice(still, run.pitch, u), fact)
        )
    return pictures


def _branches(run: LatticeRun) -> list[Picture]:
    followed = [branch for branch in run.branches if branch.states]
    if not followed or run.modes is None:
        return []
    critical = run.modes.load
    return [
        _lattice_picture("energies", "Energy", draw_energies(followed, critical)),
        _lattice_picture("amplitudes", "Amplitude", draw_amplitudes(followed, critical)),
        *([_lattice_picture("differences", "Which one is lowest", draw_differences(followed))]
          if len(followed) > 1 else []),
    ]  # fmt: skip


def _study(run: LatticeRun) -> dict[str, Any]:
    """Curves and overlays of a study."""
    study = run.study
    if study is None:
        return {}
    curves = [
        _lattice_picture("strains", "Critical strain", draw_critical_strains(study.ratios)),
        _lattice_picture("overlaps", "Overlap with Eq. (mode)", draw_overlaps(study.ratios)),
        _lattice_picture("captured", "Energy captured", draw_captured(study.ratios)),
    ]
    overlays = [_overlay(mode, n) for n, mode in enumerate(study.overlays, start=1)]
    return {"curves": curves if study.ratios else [], "overlays": overlays}


def _overlay(mode: PatternMode, n: int) -> Picture:
    """Both modes on one cell, less enlarged where small holes would close."""
    row = mode.row
    size = min(DRAWN_AMPLITUDE, 0.4 * row.ratio)
    drawn = draw_overlay(mode.mesh, row.pitch, mode.shape, mode.analytic, size * row.pitch)
    fact = f"overlap {row.overlap:.4f}; largest displacement {size:.3g} l; {row.loading}, state at "
    fact += f"{100 * row.state:.4g} %" + ("" if row.is_first else ", where it is not critical")
    return _lattice_picture(f"overlay-{n}", f"d/l = {row.ratio:.4g}", drawn, fact)
