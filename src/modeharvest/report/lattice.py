"""Report of an infinite lattice: one page like the paper's Figs. "modes" and "graded"."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from markupsafe import Markup

from modeharvest.fem.lattice.options import Wave
from modeharvest.idic.spectra.lattice_spectrum import upward
from modeharvest.report.figures import lattice as figures
from modeharvest.report.figures.boundaries import LatticePatch
from modeharvest.report.model import (
    Card,
    Cell,
    KeyNumber,
    Mark,
    Report,
    ReportFigure,
    ReportTable,
    Section,
    caption,
    fixed,
    material_text,
    number,
    percent,
    text_of,
)
from modeharvest.runs.lattice.results import (
    DRAWN_AMPLITUDE,
    FoundPattern,
    LatticeRun,
    combination_name,
)
from modeharvest.validation.studies.lattice import LatticeModeStudy, ModeRow, PatternMode

Summary = Mapping[str, Any]

CELLS = 4
"""Unit cells along the side of a picture's window."""
VISIBLE = 0.12
"""Largest fluctuation that a deformed lattice is drawn with, at least [l]."""
_KINDS = {
    "pattern": "(π, π)",
    "long waves": "long waves",
    "other waves": "other waves",
    "none": "none in the range",
    "path ends": "the path ends before",
}


def lattice_report(summary: Summary, run: LatticeRun | None = None) -> Report:
    """The report of a lattice.

    ``summary``: the content of ``summary.json``. ``run``: what its figures show; without, the
    report has numbers only, as for the terminal.
    """
    return Report(
        kind="lattice",
        title=summary["title"],
        lead=caption("page-lattice")["lead"],
        findings=findings(summary),
        keys=key_numbers(summary),
        sections=[
            *([_pattern_section(run)] if run else []),
            Section.of("critical", _critical_cards(summary)),
            Section.of("dispersion", _dispersion_cards(summary, run)),
            *([_mode_section(run)] if run else []),
            Section.of("branches", _branch_cards(summary, run)),
            *([Section.of("family", [_family_card(p) for p in run.patterns]), _study_section(run)]
              if run else []),
        ],
        warnings=summary["notes"],
        notes=notes(summary),
        command=run.command if run else "",
        case=summary["case"],
        files=summary["files"],
        costs={"nodes of the primitive cell": number(len(run.mesh.nodes))} if run else {},
        versions=summary["versions"],
        hero=_hero(run) if run else None,
        hero_caption=text_of("lattice-hero", largest=DRAWN_AMPLITUDE) if summary["modes"] else "",
    )  # fmt: skip


def wave_name(wave: Wave | Sequence[float]) -> str:
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


def waves_text(critical: Mapping[str, Any]) -> str:
    """The critical waves, long ones by their direction."""
    if not critical["found"]:
        return "–"
    if critical["long_wave_angle"] is not None:
        return f"long waves along {math.degrees(critical['long_wave_angle']) + 0.0:.3g}°"
    return ", ".join(wave_name(wave) for wave in critical["waves"])


def proof(critical: Mapping[str, Any]) -> str:
    """What shows that the point is critical, and the first one."""
    if not critical["found"]:
        return f"lowest filling · λ/k² is {number(critical['value'])} MPa, above zero"
    if critical["long_wave_angle"] is not None:
        text = "the acoustic tensor of the effective moduli is singular"
    else:
        below, above = (", ".join(map(str, critical[side])) for side in ("below", "above"))
        text = f"negative eigenvalues a millionth below: {below}, above: {above}"
    others = len(critical["earlier"])
    return text + (f"; but {others} other waves are unstable before" if others else
                   "; no other wave of the grid is unstable before")  # fmt: skip


def findings(summary: Summary) -> list[str]:
    """What was found, in sentences."""
    text, point = [], summary["critical"]
    if point is not None and point["found"]:
        text.append(text_of("lattice-critical", point=point, load=100 * point["load"],
                            waves=waves_text(point), proof=proof(point)))  # fmt: skip
    elif point is not None:
        text.append(f"Under {point['loading']} loading: {summary['outcome']}; {proof(point)}.")
    text += [
        text_of("lattice-zone", at=percent(part["load"]), wave=wave_name(part["wave"]),
                 eigenvalue=number(part["eigenvalue"])) for part in summary["zone"]
    ]  # fmt: skip
    text += [
        text_of("lattice-family", **family | {"waves": len(family["waves"]),
                                               "captured": percent(family["captured"])})
        for family in summary["families"]
    ]  # fmt: skip
    study = summary["study"]
    if study is not None:
        low, high = study["overlap"]
        count = f"{study['lattices']} lattice{'s' * (study['lattices'] != 1)}"
        text.append(f"Study of {count}: overlap with the analytic mode {low:.4f} to {high:.4f}.")
    text.append(f"The lattice is of the {material_text(summary['case']['material'])}.")
    return text


def key_numbers(summary: Summary) -> list[KeyNumber]:
    """The few numbers at the top."""
    keys, point = [], summary["critical"]
    if point is not None:
        load = f"{100 * point['load']:.4g}"
        if point["found"]:
            keys += [KeyNumber("critical strain", load, "%", point["loading"]),
                     _waves_key(point, summary)]  # fmt: skip
        else:
            keys += [KeyNumber("stable up to", load, "%", point["loading"]),
                     KeyNumber("lowest filling · λ/k²", point["value"], "MPa",
                               "above zero")]  # fmt: skip
        if point["found"] and point["long_wave_angle"] is None:
            change = f"{sum(point['below'])} → {sum(point['above'])}"
            keys.append(KeyNumber("negative eigenvalues", change, "", "a millionth below → above"))
    if summary["families"]:
        family = summary["families"][0]
        waves = len(family["waves"])
        keys += [
            KeyNumber("captured", f"{100 * family['captured']:.3g}", "%",
                      f"of the energy of {family['of']}, by {waves} wave{'s' * (waves != 1)}"),
            KeyNumber("mode family", str(family["parameters"]), "parameters", family["family"]),
        ]  # fmt: skip
    stable = [b for b in summary["branches"]
              if b["states"] and b["states"][-1]["negative_eigenvalues"] == 0]  # fmt: skip
    if stable:
        low = min(stable, key=lambda b: _excess(b["states"][-1]))
        remark = f"lowest energy at {percent(low['states'][-1]['load'])}"
        keys.append(KeyNumber("stable branch", combination_name(low["combination"]), "", remark))
    return keys


def _waves_key(point: Mapping[str, Any], summary: Summary) -> KeyNumber:
    copies = (summary["modes"] or {}).get("copies")
    remark = f"repeat after {copies[0]} × {copies[1]} cells" if copies else "phases (k·a₁, k·a₂)"
    if len(point["waves"]) > 1:
        return KeyNumber("critical waves", str(len(point["waves"])), "at once", waves_text(point))
    is_long = point["long_wave_angle"] is not None
    return KeyNumber("critical wave", "long" if is_long else waves_text(point), "", remark)


def _excess(state: Mapping[str, Any]) -> float:
    """Energy over that of the primary path at the same load [kPa]."""
    return 1e3 * float(state["energy"] - state["primary_energy"])


def notes(summary: Summary) -> list[str]:
    """What a reader should know before trusting the numbers, drawn from the data."""
    text, point = [], summary["critical"]
    if point is not None and not point["found"]:
        text.append(text_of("lattice-no-proof", loading=point["loading"],
                             load=percent(point["load"]), outcome=summary["outcome"]))  # fmt: skip
    elif point is not None and point["long_wave_angle"] is not None:
        text.append(text_of("lattice-long-waves", loading=point["loading"]))
    if any(branch["states"] for branch in summary["branches"]):
        text.append(text_of("lattice-branches"))
    if summary["study"] is not None:
        text.append(text_of("lattice-material"))
    return [*text, text_of("lattice-densities")]


def _window(run: LatticeRun, width: float = CELLS, height: float = CELLS) -> LatticePatch:
    """Cells of the modes where there are some, primitive ones otherwise [l]."""
    mesh, lattice = run.mesh, run.lattice
    if run.modes is not None:
        mesh, lattice = run.modes.mesh, run.modes.lattice
    return LatticePatch.of(mesh, lattice, (width * run.pitch, height * run.pitch))


def _hero(run: LatticeRun) -> ReportFigure:
    drawn = partial(figures.draw_lattice, _window(run), run.pitch)
    if run.modes is not None:
        shape, patterns = run.modes.shapes[0], run.patterns
        if patterns:
            shown = next((p for p in patterns if p.stable), patterns[0])
            shape = shown.fluctuation
        amplitude = DRAWN_AMPLITUDE * run.pitch
        drawn = partial(figures.draw_growth, _window(run, 7.0, 5.6), shape, amplitude, run.pitch)
    return ReportFigure("hero", "The lattice and its pattern", drawn)


def _pattern_section(run: LatticeRun) -> Section:
    """The reference, and for each pattern the deformed lattice and both densities."""
    drawn = partial(figures.draw_lattice, _window(run), run.pitch)
    reference = ReportFigure("reference", "Reference", drawn, "dashed: the cell that repeats")
    cards = [
        Card(found.name, [*([reference] if n == 1 else []), _deformed(run, found, n),
                          *_densities(found, n)], paper="paper: Fig. modes", wide=True)
        for n, found in enumerate(run.patterns, start=1)
    ]  # fmt: skip
    cards = cards or [Card("The lattice", [reference])]
    section = Section.of("lattice", cards)
    return section if run.patterns else replace(section, lead="")


def _deformed(run: LatticeRun, found: FoundPattern, n: int) -> ReportFigure:
    """The deformed lattice; a fluctuation that is too small to be visible is magnified."""
    assert run.modes is not None
    fluctuation = found.fluctuation
    largest = float(np.linalg.norm(fluctuation, axis=1).max()) / run.pitch
    factor = DRAWN_AMPLITUDE / largest if found.stable is None else max(1.0, VISIBLE / largest)
    u = found.displacement + (factor - 1.0) * fluctuation
    drawn = partial(figures.draw_lattice, _window(run), run.pitch, u, found.gradient)
    if found.stable is None:
        text = f"a mode, no equilibrium; largest displacement {DRAWN_AMPLITUDE} l"
    else:
        text = "stable; " if found.stable else "unstable; "
        text += f"fluctuation × {factor:.3g}" if factor > 1.005 else "true to scale"
    return ReportFigure(f"deformed-{n}", "Deformed", drawn, text)


def _densities(found: FoundPattern, n: int) -> list[ReportFigure]:
    spectrum = found.spectrum
    both = {"xx": spectrum.S_xx, "yy": spectrum.S_yy}
    largest = float(max(S.max() for S in both.values()))
    made = []
    for name, S in both.items():
        up = np.where(upward(spectrum.xi), S, 0.0)
        xi = [float(x) for x in spectrum.xi[int(np.argmax(up))]]
        of = "" if found.stable is None else f" {number(float(S.max()))} mm⁶"  # a mode has no size
        text = f"largest{of} at ±({number(xi[0])}, {number(xi[1])})"
        drawn = partial(figures.draw_lattice_spectrum, spectrum.xi, S, largest)
        made.append(ReportFigure(f"S{name}-{n}", Markup(f"S<sub>{name}</sub>"), drawn, text))
    return made


def _critical_cards(summary: Summary) -> list[Card]:
    point = summary["critical"]
    if point is None:
        return []
    mark = Mark("critical", True) if point["found"] else Mark("stable so far", False)
    row = (point["loading"], f"{100 * point['load']:.5g}", waves_text(point), mark, proof(point))
    columns = ("loading", "strain [%]", "critical waves", "", "proof")
    table = ReportTable("Critical point", columns, [row])
    return Card.tabular(table, wide=True)


def _dispersion_cards(summary: Summary, run: LatticeRun | None) -> list[Card]:
    rows = summary["dispersion"]
    if not rows:
        return []
    names = dict.fromkeys(name for name, _ in rows[0]["corners"] if name != "Γ")
    table = ReportTable(
        "Lowest eigenvalue [N/mm⁴]", ("wave", *(percent(row["load"]) for row in rows)),
        [(name, *(dict(row["corners"])[name] for row in rows)) for name in names],
        on_terminal=True,
    )  # fmt: skip
    corners = Card.tabular(table)
    if run is None or run.dispersion is None:
        return corners
    found, waves = run.dispersion, run.critical.waves if run.critical else ()
    path = partial(figures.draw_dispersion, found, waves)
    maps = [
        ReportFigure(f"zone-{n}", f"At {100 * part.load:.4g} %",
                     partial(figures.draw_zone_map, part, run.pitch, waves))
        for n, part in enumerate(found.zone, start=1)
    ]  # fmt: skip
    cards = [Card.captioned("dispersion-path", path), Card(figures=maps, **caption("zone"))]
    return [*(card for card in cards if card.figures), *corners]


def _mode_section(run: LatticeRun) -> Section:
    """Every mode of the set upon the undeformed lattice."""
    modes = run.modes
    if modes is None:
        return Section("modes", "Modes", [])
    still, drawn = _window(run), []
    for k, (wave, value) in enumerate(zip(modes.waves, modes.eigenvalues, strict=True)):
        shape = modes.shapes[k]
        u = DRAWN_AMPLITUDE * run.pitch / float(np.linalg.norm(shape, axis=1).max()) * shape
        name = combination_name([float(j == k) for j in range(len(modes.waves))])
        drawn.append(ReportFigure(
            f"mode-{k + 1}", f"{name} · wave {wave_name(wave)}",
            partial(figures.draw_lattice, still, run.pitch, u),
            f"eigenvalue {number(float(value))} N/mm⁴",
        ))  # fmt: skip
    many = text_of("lattice-modes", count=len(drawn)) if len(drawn) > 1 else ""
    return Section.of("modes", [Card("Modes", drawn, wide=True)], many=many,
                      load=percent(modes.load), largest=DRAWN_AMPLITUDE)  # fmt: skip


def _branch_cards(summary: Summary, run: LatticeRun | None) -> list[Card]:
    rows = [_branch_row(branch) for branch in summary["branches"]]
    if not rows:
        return []
    columns = ("branch", "last strain [%]", "energy − primary [kPa]", "negative eigenvalues",
               "amplitudes [mm]", "outcome")  # fmt: skip
    table = ReportTable("Branches at their last states", columns, rows, on_terminal=True)
    return [*(_branch_figures(run) if run else []), *Card.tabular(table, wide=True)]


def _branch_row(branch: Mapping[str, Any]) -> tuple[Cell, ...]:
    name = combination_name(branch["combination"])
    if not branch["states"]:
        return (name, None, None, None, "–", branch["outcome"])
    state = branch["states"][-1]
    sizes = np.array(state["amplitudes"])
    sizes = np.where(np.abs(sizes) > 1e-6 * np.abs(sizes).max(), sizes, 0.0)
    amplitudes = ", ".join(number(float(a)) for a in sizes)
    return (name, f"{100 * state['load']:.4g}", _excess(state), state["negative_eigenvalues"],
            amplitudes, branch["outcome"])  # fmt: skip


def _branch_figures(run: LatticeRun) -> list[Card]:
    followed = [branch for branch in run.branches if branch.states]
    if not followed or run.modes is None:
        return []
    critical = run.modes.load
    drawn = {
        "energies": partial(figures.draw_energies, followed, critical),
        "amplitudes": partial(figures.draw_amplitudes, followed, critical),
    }
    if len(followed) > 1:
        drawn["differences"] = partial(figures.draw_differences, followed)
    return [Card.captioned(name, draw) for name, draw in drawn.items()]


def _family_card(found: FoundPattern) -> Card:
    family = found.family
    rows: list[tuple[Cell, ...]] = [
        (k, *(fixed(float(v)) for v in wave)) for k, wave in enumerate(family.waves, start=1)
    ]
    table = ReportTable(f"Waves of {found.name}", ("wave", "A", "B", "kₓ", "k_y", "c [mm]"), rows)
    guess = ", ".join(
        f"{name} = {number(round(float(value), 5))}"
        for name, value in zip(family.family.names, family.family.start, strict=True)
    )
    growth = ", ".join(f"{count}: {percent(share)}" for count, share in family.growth)
    caption = (
        f"Initial parameters: {guess}. Energy captured by 1, 2, … independent waves: {growth}."
    )
    return Card(found.name, tables=[table], text=family.text, caption=caption,
                paper=family.family.name, wide=True)  # fmt: skip


def _study_section(run: LatticeRun) -> Section:
    """Curves, overlays and rows of a study."""
    study = run.study
    if study is None:
        return Section("study", "Parameter study", [])
    overlays = [_overlay(mode, n) for n, mode in enumerate(study.overlays, start=1)]
    tables = [
        ReportTable(f"{name}: every value", _STUDY_COLUMNS, study_rows(rows), folded=True)
        for name, rows in (("Hole size and loading", study.ratios), ("Cell size", study.scales),
                           ("Material", study.materials)) if rows
    ]  # fmt: skip
    drawn = {"strains": figures.draw_critical_strains, "overlaps": figures.draw_overlaps,
             "captured": figures.draw_captured} if study.ratios else {}  # fmt: skip
    cards = [
        Card("Findings of the study", text=study_text(study), wide=True),
        Card(figures=overlays, wide=True, **caption("overlay")),
        *(Card.captioned(name, partial(draw, study.ratios)) for name, draw in drawn.items()),
        Card("Tables", tables=tables, wide=True),
    ]  # fmt: skip
    return Section.of("study", [c for c in cards if c.figures or c.tables or c.text])


def _overlay(mode: PatternMode, n: int) -> ReportFigure:
    """Both modes on one cell, less enlarged where small holes would close."""
    row = mode.row
    size = min(DRAWN_AMPLITUDE, 0.4 * row.ratio)
    drawn = partial(figures.draw_overlay, mode.mesh, row.pitch, mode.shape, mode.analytic,
                    size * row.pitch)  # fmt: skip
    text = f"overlap {row.overlap:.4f}; largest displacement {size:.3g} l; {row.loading}, state at "
    text += percent(row.state) + ("" if row.is_first else ", where it is not critical")
    return ReportFigure(f"overlay-{n}", f"d/l = {row.ratio:.4g}", drawn, text)


_STUDY_COLUMNS = (
    "material", "loading", "l [mm]", "d/l", "first critical", "first waves", "(π, π) critical",
    "overlap with Eq. (mode)", "captured (waves)", "overlap with reference",
)  # fmt: skip


def study_rows(rows: Sequence[ModeRow]) -> list[tuple[Cell, ...]]:
    """Rows of the study's tables."""
    return [
        (row.material, row.loading, row.pitch, row.ratio,
         percent(row.first) if row.found else f"> {percent(row.first)}",
         Mark(_KINDS[row.kind], True) if row.is_first else _KINDS[row.kind],
         percent(row.pattern), f"{row.overlap:.4f}", f"{percent(row.captured)} ({row.waves})",
         None if math.isnan(row.likeness) else f"{row.likeness:.6f}")
        for row in rows
    ]  # fmt: skip


def study_text(study: LatticeModeStudy) -> list[str]:
    """What a study shows, drawn from its rows."""
    text = [text_of("lattice-limit", limit=limit, instead=_KINDS[limit.instead])
            for limit in study.limits]  # fmt: skip
    limited = {limit.loading for limit in study.limits}
    for loading in dict.fromkeys(row.loading for row in study.ratios):
        rows = [row for row in study.ratios if row.loading == loading]
        if loading not in limited and all(row.is_first for row in rows):
            ratios = [row.ratio for row in rows]
            text.append(text_of("lattice-always", loading=loading, least=min(ratios),
                                most=max(ratios)))  # fmt: skip
    if study.ratios:
        best = max(study.ratios, key=lambda row: row.overlap)
        worst = min(study.ratios, key=lambda row: row.overlap)
        text.append(text_of("lattice-overlap", worst=worst, best=best))
    text += _likeness_text(study.scales, "cell sizes", " (1 to rounding by construction: equations "
                           "and mesh scale, only rounding differs)")  # fmt: skip
    return text + _likeness_text(study.materials, "materials", "")


def _likeness_text(rows: Sequence[ModeRow], what: str, remark: str) -> list[str]:
    known = [row.likeness for row in rows if not math.isnan(row.likeness)]
    if not known:
        return []
    least = min(known)
    value = f"1 − {number(1 - least)}" if 0 < 1 - least < 1e-4 else f"{least:.6g}"
    return [f"Modes of other {what} overlap with the reference's by at least {value}{remark}."]
