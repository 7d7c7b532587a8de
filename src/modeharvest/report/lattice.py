"""Report of an infinite lattice, with figures like the paper's Figs. "modes" and "graded"."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from markupsafe import Markup

from modeharvest.fem.bloch.modes import ModeSet
from modeharvest.fem.lattice.options import Wave
from modeharvest.idic.spectra.lattice_spectrum import upward
from modeharvest.report.figures import lattice as figures
from modeharvest.report.figures.boundaries import LatticePatch
from modeharvest.report.model.content import (
    Card,
    KeyNumber,
    Report,
    ReportFigure,
    ReportTable,
    Section,
)
from modeharvest.report.model.text import (
    Mark,
    caption,
    fixed,
    material_text,
    number,
    percent,
    text_of,
)
from modeharvest.runs.lattice.loads import LoadQuantity
from modeharvest.runs.lattice.results import (
    DRAWN_AMPLITUDE,
    FoundPattern,
    LatticeRun,
    combination_name,
)
from modeharvest.validation.studies.lattice import LatticeModeStudy, ModeRow, PatternMode

Summary = Mapping[str, Any]

CELLS = 4
"""Side of the part of the lattice that a figure shows [unit cells]."""
VISIBLE = 0.12
"""A deformed lattice whose largest fluctuation is less is drawn magnified to this value [l]."""
_KINDS = {
    "pattern": "(π, π)",
    "long waves": "long waves",
    "other waves": "other waves",
    "none": "none in the range",
    "path ends": "the path ends before",
}


def lattice_report(summary: Summary, run: LatticeRun | None = None) -> Report:
    """The report of a lattice.

    ``summary``: the content of ``summary.json``. ``run``: the data of the figures; if None, the
    report has no figures, as for the terminal.
    """
    return Report(
        kind="lattice",
        title=summary["title"],
        findings=findings(summary),
        keys=key_numbers(summary),
        sections=[
            *([_pattern_section(run)] if run else []),
            Section.of("critical", _critical_cards(summary)),
            Section.of("dispersion", _dispersion_cards(summary, run)),
            *([_mode_section(run, run.modes)] if run and run.modes else []),
            Section.of("branches", _branch_cards(summary, run)),
            Section.of("family", [_family_card(p) for p in run.patterns] if run else []),
            *([_study_section(run.study)] if run and run.study else []),
        ],
        warnings=[*summary["notes"], *_splitting(summary["critical"])],
        notes=notes(summary),
        command=run.command if run else "",
        case=summary["case"],
        files=summary["files"],
        costs={"nodes of the primitive cell": number(len(run.mesh.nodes))} if run else {},
        versions=summary["versions"],
        hero=_hero(run) if run else None,
        hero_caption=text_of("lattice-hero", largest=DRAWN_AMPLITUDE) if summary["modes"] else "",
        **caption("page-lattice"),
    )


def wave_name(wave: Wave | Sequence[float]) -> str:
    """A wave's phases [rad], as multiples of pi where these are simple: "(4π/3, 2π/3)"."""
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
    """The critical waves as text: their phases, or the direction of long waves; "–" if none."""
    if not critical["found"]:
        return "–"
    if critical["long_wave_angle"] is not None:
        return f"long waves along {math.degrees(critical['long_wave_angle']) + 0.0:.3g}°"
    return ", ".join(wave_name(wave) for wave in critical["waves"])


def proof(critical: Mapping[str, Any]) -> str:
    """Text: the evidence that the load is critical, or not, and waves unstable at lower loads."""
    if not critical["found"]:
        return f"lowest filling · λ/k² is {number(critical['value'])} MPa, above zero"
    if critical["long_wave_angle"] is not None:
        text = "the acoustic tensor of the effective moduli is singular"
    else:
        below, above = (", ".join(map(str, critical[side])) for side in ("below", "above"))
        text = f"negative eigenvalues a millionth below this load: {below}, above: {above}"
    others = len(critical["earlier"])
    return text + (f"; but {others} other waves are unstable before" if others else
                   "; no other wave that was examined is unstable before")  # fmt: skip


def findings(summary: Summary) -> list[str]:
    """The results in sentences."""
    text, point, load = [], summary["critical"], LoadQuantity(**summary["load"])
    if point is not None and point["found"]:
        text.append(text_of("lattice-critical", under=_under(point["loading"]), load=load,
                            at=load.text(point["load"], 5), waves=waves_text(point),
                            proof=proof(point)))  # fmt: skip
        if point["error"] is not None:
            error = load.text(point["error"], 2)
            text.append(text_of("lattice-error", load=load, error=error, order=point["order"],
                                share=point["error"] / point["load"]))  # fmt: skip
    elif point is not None:
        outcome = load.in_units(summary["outcome"])
        text.append(f"Under {_under(point['loading'])}: {outcome}; {proof(point)}.")
    for part in summary["zone"]:
        at = load.text(part["load"])
        text.append(text_of("lattice-zone", name=wave_name(part["wave"]), at=at, **part))
    for family in summary["families"]:
        text.append(text_of("lattice-family", count=len(family["waves"]), **family))
    study = summary["study"]
    if study is not None:
        plural = "s" * (study["lattices"] != 1)
        text.append(text_of("lattice-study", plural=plural, **study))
    text.append(f"The lattice is of the {material_text(summary['case']['material'])}.")
    return text


def _under(loading: str) -> str:
    """A loading's description in a sentence: "uniaxial loading along x"."""
    return re.sub(r"(?= along|,|$)", " loading", loading, count=1)


def _splitting(point: Mapping[str, Any] | None) -> list[str]:
    """A warning if the mesh splits a degenerate set of critical waves; else none."""
    is_split = point is not None and len(point["waves"]) > 1 and point["splitting"] > 1e-5
    return [text_of("lattice-splitting", **point)] if point and is_split else []


def key_numbers(summary: Summary) -> list[KeyNumber]:
    """The key numbers at the top of the page."""
    keys, point, load = [], summary["critical"], LoadQuantity(**summary["load"])
    if point is not None:
        names = ["critical-load"] if point["found"] else ["stable-load", "lowest-filling"]
        words = {"load": load, "value": load.per_load * point["load"], "point": point}
        keys += [KeyNumber.of(name, **words) for name in names]
        if point["found"]:
            keys.append(_waves_key(point, summary))
        if point["found"] and point["long_wave_angle"] is None:
            change = f"{sum(point['below'])} → {sum(point['above'])}"
            keys.append(KeyNumber.of("negative", change))
    if summary["families"]:
        family = summary["families"][0]
        count = len(family["waves"])
        values = {"share": 100 * family["captured"], "by": f"{count} wave{'s' * (count != 1)}"}
        keys += [KeyNumber.of(name, **values, **family) for name in ("captured", "family")]
    stable = [b for b in summary["branches"]
              if b["states"] and b["states"][-1]["negative_eigenvalues"] == 0]  # fmt: skip
    if stable:
        low = min(stable, key=lambda b: _excess(b["states"][-1]))
        name = combination_name(low["combination"])
        keys.append(KeyNumber.of("stable-branch", name, at=load.text(low["states"][-1]["load"])))
    return keys


def _waves_key(point: Mapping[str, Any], summary: Summary) -> KeyNumber:
    text, copies = waves_text(point), (summary["modes"] or {}).get("copies")
    if len(point["waves"]) > 1:
        return KeyNumber.of("critical-waves", str(len(point["waves"])), waves=text)
    value = text if point["long_wave_angle"] is None else "long"
    key = "copied-wave" if copies else "critical-wave"
    return KeyNumber.of(key, value, copies=copies)


def _excess(state: Mapping[str, Any]) -> float:
    """Stored energy per area minus that of the primary path at the same load [kPa]."""
    return 1e3 * float(state["energy"] - state["primary_energy"])


def notes(summary: Summary) -> list[str]:
    """Notes on the conditions and limits of the numbers, made from the data."""
    text, point = [], summary["critical"]
    if point is not None and not point["found"]:
        load = LoadQuantity(**summary["load"])
        outcome, upto = load.in_units(summary["outcome"]), load.text(point["load"])
        text.append(text_of("lattice-no-proof", outcome=outcome, point=point, load=upto))
    elif point is not None and point["long_wave_angle"] is not None:
        text.append(text_of("lattice-long-waves", loading=point["loading"]))
    if any(branch["states"] for branch in summary["branches"]):
        text.append(text_of("lattice-branches"))
    if summary["study"] is not None:
        text.append(text_of("lattice-material"))
    return [*text, text_of("lattice-densities")]


def _window(run: LatticeRun, width: float = CELLS, height: float = CELLS) -> LatticePatch:
    """A part of the lattice of ``width`` x ``height`` [l]: of modes' cells, else primitive ones."""
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
    """The reference; for each pattern the deformed lattice, S_xx and S_yy."""
    drawn = partial(figures.draw_lattice, _window(run), run.pitch)
    reference = ReportFigure("reference", "Reference", drawn, "dashed: the cell that repeats")
    cards = [
        Card(found.name, [*([reference] if n == 1 else []), _deformed(run, found, n),
                          *_densities(found, n)], paper="paper: Fig. 2", wide=True)
        for n, found in enumerate(run.patterns, start=1)
    ]  # fmt: skip
    cards = cards or [Card("The lattice", [reference])]
    section = Section.of("lattice", cards)
    return section if run.patterns else replace(section, lead="")


def _deformed(run: LatticeRun, found: FoundPattern, n: int) -> ReportFigure:
    """The deformed lattice; small fluctuations are magnified, modes scaled to a fixed size."""
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
    both = dict(zip(("xx", "yy"), spectrum.density.T, strict=True))
    largest = float(max(S.max() for S in both.values()))
    made = []
    for name, S in both.items():
        up = np.where(upward(spectrum.xi), S, 0.0)
        xi = [float(x) for x in spectrum.xi[int(np.argmax(up))]]
        of = "" if found.stable is None else f" {number(float(S.max()))} mm⁶"  # modes: arbitrary
        text = f"largest{of} at ±({number(xi[0])}, {number(xi[1])})"
        drawn = partial(figures.draw_lattice_spectrum, spectrum.xi, S, largest)
        made.append(ReportFigure(f"S{name}-{n}", Markup(f"S<sub>{name}</sub>"), drawn, text))
    return made


def _critical_cards(summary: Summary) -> list[Card]:
    point = summary["critical"]
    if point is None:
        return []
    mark = Mark("critical", True) if point["found"] else Mark("stable so far", False)
    load = LoadQuantity(**summary["load"])
    row = {"loading": point["loading"], "load": load.text(point["load"], 5),
           "waves": waves_text(point), "found": mark, "proof": proof(point)}  # fmt: skip
    return Card.tabular(ReportTable.of("critical", [row]), wide=True)


def _dispersion_cards(summary: Summary, run: LatticeRun | None) -> list[Card]:
    rows = summary["dispersion"]
    if not rows:
        return []
    names = {name: name for name, _ in rows[0]["corners"] if name != "Γ"}
    load = LoadQuantity(**summary["load"])
    loads = [(load.text(row["load"]), dict(row["corners"])) for row in rows]
    corners = Card.tabular(ReportTable.of_states("corners", loads, names))
    if run is None or run.dispersion is None:
        return corners
    found, waves = run.dispersion, run.critical.waves if run.critical else ()
    path = partial(figures.draw_dispersion, found, waves, load)
    maps = [
        ReportFigure(f"zone-{n}", f"At {load.text(part.load)}",
                     partial(figures.draw_zone_map, part, run.pitch, waves))
        for n, part in enumerate(found.zone, start=1)
    ]  # fmt: skip
    cards = [Card.captioned("dispersion-path", path), Card(figures=maps, **caption("zone"))]
    return [*(card for card in cards if card.figures), *corners]


def _mode_section(run: LatticeRun, modes: ModeSet) -> Section:
    """All modes of the set, each drawn as a displacement of the undeformed lattice."""
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
                      load=run.load.text(modes.load), largest=DRAWN_AMPLITUDE)  # fmt: skip


def _branch_cards(summary: Summary, run: LatticeRun | None) -> list[Card]:
    load = LoadQuantity(**summary["load"])
    rows = [_last_state(branch, load) for branch in summary["branches"]]
    table = ReportTable.of("branches", rows)
    return [*(_branch_figures(run) if run else []), *Card.tabular(table, wide=True)]


def _last_state(branch: Mapping[str, Any], load: LoadQuantity) -> Mapping[str, Any]:
    """The table's row of a branch: its last state."""
    outcome = load.in_units(branch["outcome"])
    named = {"name": combination_name(branch["combination"]), "outcome": outcome}
    if not branch["states"]:
        return named | {"amplitudes": "–"}
    state = branch["states"][-1]
    sizes = np.array(state["amplitudes"])
    sizes = np.where(np.abs(sizes) > 1e-6 * np.abs(sizes).max(), sizes, 0.0)
    amplitudes = ", ".join(number(float(a)) for a in sizes)
    shown = {"at": load.text(state["load"]), "excess": _excess(state)}
    return {**state, **named, **shown, "amplitudes": amplitudes}


def _branch_figures(run: LatticeRun) -> list[Card]:
    followed = [branch for branch in run.branches if branch.states]
    if not followed or run.modes is None:
        return []
    critical = run.modes.load
    drawn = {
        "energies": partial(figures.draw_energies, followed, critical, run.load),
        "amplitudes": partial(figures.draw_amplitudes, followed, critical, run.load),
    }
    if len(followed) > 1:
        drawn["differences"] = partial(figures.draw_differences, followed, run.load)
    return [Card.captioned(name, draw) for name, draw in drawn.items()]


def _family_card(found: FoundPattern) -> Card:
    family = found.family
    rows = [{"wave": k, **dict(zip("ABxyc", map(fixed, map(float, wave)), strict=True))}
            for k, wave in enumerate(family.waves, start=1)]  # fmt: skip
    guess = ", ".join(
        f"{name} = {number(round(float(value), 5))}"
        for name, value in zip(family.family.names, family.family.start, strict=True)
    )
    growth = ", ".join(f"{count}: {percent(share)}" for count, share in family.growth)
    words = text_of("lattice-waves", guess=guess, growth=growth)
    return Card(found.name, tables=[ReportTable.of("family", rows, of=found.name)],
                text=family.text, caption=words, paper=family.family.name, wide=True)  # fmt: skip


def _study_section(study: LatticeModeStudy) -> Section:
    """Text, overlays of modes, curves and tables of a study."""
    overlays = [_overlay(mode, n) for n, mode in enumerate(study.overlays, start=1)]
    series = {"Hole size and loading": study.ratios, "Cell size": study.scales,
              "Material": study.materials}  # fmt: skip
    tables = [ReportTable.of("study", map(_study_row, rows), of=name)
              for name, rows in series.items() if rows]  # fmt: skip
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
    """Numerical and analytic mode on a quarter cell, less enlarged if small holes would close."""
    row = mode.row
    size = min(DRAWN_AMPLITUDE, 0.4 * row.ratio)
    drawn = partial(figures.draw_overlay, mode.mesh, row.pitch, mode.shape, mode.analytic,
                    size * row.pitch)  # fmt: skip
    text = text_of("lattice-overlay", row=row, size=size)
    text += "" if row.is_first else ", where it is not critical"
    return ReportFigure(f"overlay-{n}", f"d/l = {row.ratio:.4g}", drawn, text)


def _study_row(row: ModeRow) -> Mapping[str, Any]:
    """A lattice's row in the tables of the study."""
    kind = _KINDS[row.kind]
    return vars(row) | {
        "first": percent(row.first) if row.found else f"> {percent(row.first)}",
        "kind": Mark(kind, True) if row.is_first else kind,
        "pattern": percent(row.pattern),
        "overlap": f"{row.overlap:.4f}",
        "captured": f"{percent(row.captured)} ({row.waves})",
        "likeness": None if math.isnan(row.likeness) else f"{row.likeness:.6f}",
    }


def study_text(study: LatticeModeStudy) -> list[str]:
    """The results of a study in sentences, made from its rows."""
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
    for what, others in {"scales": study.scales, "materials": study.materials}.items():
        known = [row.likeness for row in others if not math.isnan(row.likeness)]
        if known:
            least = min(known)
            value = f"1 − {number(1 - least)}" if 0 < 1 - least < 1e-4 else f"{least:.6g}"
            text.append(text_of(f"lattice-{what}", value=value))
    return text
