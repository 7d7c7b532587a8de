"""What the report of a lattice says in words and numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.modes import Branch, Wave
from modeharvest.validation.lattice.mode_study import ModeStudy
from modeharvest.validation.lattice.mode_table import ModeRow
from modeharvest.validation.lattice.plots_branches import combination_name
from modeharvest.validation.page import short

FloatArray = NDArray[np.float64]

if TYPE_CHECKING:
    from modeharvest.validation.lattice.run import CriticalPoint, LatticeRun

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


def waves_in_words(point: CriticalPoint) -> str:
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
    named = waves_in_words(point)
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


def study_sentences(study: ModeStudy) -> list[str]:
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
    said += _likeness(study.scales, "cell sizes", "1 to rounding by construction: equations and "
                      "mesh scale, only rounding differs")  # fmt: skip
    said += _likeness(study.materials, "materials", "")
    return said


def _likeness(rows: Sequence[ModeRow], what: str, remark: str) -> list[str]:
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
