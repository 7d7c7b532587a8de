"""Report of photographs: one page like the paper's Figs. "spect_real" and "real"."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from markupsafe import Markup

from modeharvest.report.experiment import verdict
from modeharvest.report.figures.curves import draw_convergence, draw_onset, draw_waves
from modeharvest.report.figures.fits import (
    Panel,
    ansatz_panels,
    has_mode,
    panel_sections,
    shape_numbers,
    spectrum_panels,
)
from modeharvest.report.figures.photographs import (
    CLOSE,
    PhotographState,
    draw_closeup,
    draw_deformed,
    draw_distortion,
    draw_distortion_error,
    draw_distortion_sd,
    draw_error,
    draw_error_against_truth,
    draw_hero,
    draw_part_spectrum,
    draw_reference,
    draw_residual,
    draw_w,
    photograph_states,
    shown_frames,
)
from modeharvest.report.model import (
    Card,
    Cell,
    KeyNumber,
    Mark,
    Measured,
    Report,
    ReportFigure,
    ReportTable,
    Section,
    number,
    percent,
)
from modeharvest.runs.photographs.results import Harvest

Summary = Mapping[str, Any]
Frame = Mapping[str, Any]

_LEAD = Markup(
    "Photographs of a compressed cellular specimen, measured by micromorphic digital image "
    "correlation: a smooth field v<sub>0</sub>, a pattern φ<sub>1</sub> and its amplitude "
    "v<sub>1</sub>, with their uncertainties."
)
_HEADS = {
    "photographs": (
        "Photographs and pattern",
        "Fig. “spect_real” of the paper. The family of the mode, which its authors read off the "
        "spectral densities by eye, is read by the program here.",
    ),
    "found": (
        "Measured displacement",
        Markup(
            "Fig. “real” of the paper: the displacement as u = v<sub>0</sub> + "
            "v<sub>1</sub>φ<sub>1</sub>, a smooth field and a correlated pattern with its "
            "amplitude. Every colour bar has its own range."
        ),
    ),
    "residual-and-model-error": (
        "Residual and model error",
        "The residual of the photographs once the measured displacement is taken out, and the "
        "difference from a local DIC, which assumes little and is noisy.",
    ),
    "uncertainty": (
        "Uncertainty",
        "Two causes of error, apart: the photographs’ noise, and model error. One standard "
        "deviation; both components of a vector together.",
    ),
    "errors": (
        "Error analysis",
        "These photographs were made by a simulation, so the truth is known. The error has two "
        "parts: the model (ansatz) error, which remains however well the displacement is measured, "
        "and the measurement error on top of it.",
    ),
}


def photographs_report(summary: Summary, harvest: Harvest | None = None) -> Report:
    """The report of measured photographs.

    Parameters
    ----------
    summary
        The content of ``summary.json``.
    harvest
        What its figures show; without, the report has numbers only, as for the terminal.
    """
    frames = {frame["name"]: frame for frame in summary["frames"]}
    shown = [frames[f.name] for f in shown_frames(harvest)] if harvest else summary["frames"]
    names = photograph_labels(shown)
    states = photograph_states(harvest, names) if harvest else []
    buckling = summary.get("buckling") or {}
    sections = panel_sections(
        photograph_panels(states), states, _HEADS,
        lambda key, s: panel_numbers(key, frames[s.frame.name]) or shape_numbers(key, s),
    ) if states else []  # fmt: skip
    last = summary["frames"][-1]
    hero = ReportFigure("hero", "The last photograph", partial(draw_hero, states[-1])) if (
        states) else None  # fmt: skip
    return Report(
        kind="photographs",
        title=summary["title"],
        lead=_LEAD,
        findings=[buckling["text"]] if buckling.get("text") else [],
        keys=key_numbers(summary),
        sections=[
            *([_reference(harvest, summary, states)] if harvest else []),
            *([_optics(harvest, summary)] if harvest and harvest.lens is not None else []),
            *_with_readings(sections, shown, names),
            Section("truth", "Obtained and expected values", _truth_cards(summary)),
            *([_timeline(harvest, summary)] if harvest else []),
            Section("numbers", "Numbers", number_cards(summary, shown, names)),
            *([_convergence(states, frames)] if states else []),
        ],
        warnings=[
            *(f"not used: {row['name']}: {row['reason']}" for row in summary.get("skipped", [])),
            *(f"{frame['name']}: {_sentence(warning)}" for frame in summary["frames"]
              for warning in frame["warnings"]),
        ],
        notes=notes(summary),
        command=harvest.command if harvest else "",
        toml=harvest.toml if harvest else "",
        case=summary["experiment"],
        versions=summary["versions"],
        hero=hero,
        hero_caption=f"{last['name']}, {photograph_label(last).lower()}: the photograph turns, "
        "from left to right, into the length of the pattern that was measured in it.",
    )  # fmt: skip


def photograph_label(frame: Frame) -> str:
    """What a photograph is called above its pictures."""
    has = frame["has_pattern"]
    state = "Deformed" if has is None else "After buckling" if has else "Before buckling"
    return f"{state} · {percent(frame['strain'])}"


def photograph_labels(frames: Sequence[Frame]) -> dict[str, str]:
    """Each photograph's label by its name, which is added where labels would be the same."""
    made = {frame["name"]: photograph_label(frame) for frame in frames}
    often = Counter(made.values())
    return {name: text if often[text] == 1 else f"{text} · {name}" for name, text in made.items()}


def key_numbers(summary: Summary) -> list[KeyNumber]:
    """The few numbers at the top."""
    last, rows = summary["frames"][-1], summary["truth"]
    used, left = len(summary["frames"]), len(summary["skipped"])
    remark = f"{left} of them left out, see below" if left else "all of them"
    first = KeyNumber("photographs used", f"{used} of {used + left}", "", remark)
    if rows:
        met = f"{sum(row['ok'] for row in rows)} of {len(rows)}"
        first = KeyNumber("within the specified error", met, "", "table below")
    modes = _mode_keys(last) if last["modes"] else []
    return [first, _buckling(summary), *modes, _model_error_key(last)]


def _buckling(summary: Summary) -> KeyNumber:
    found = summary["buckling"]
    if found is None or found["after"] is None:
        return KeyNumber("buckling", None, "", "no pattern that stands out")
    if found["before"] is None:
        return KeyNumber("buckling", f"< {100 * found['after']:.4g}", "%", "all show the pattern")
    span = f"{100 * found['before']:.4g} … {100 * found['after']:.4g}"
    remark = "the pattern appears between these strains"
    if found["estimate"] is not None:
        remark = f"its growth extrapolates to {percent(found['estimate'])}"
    return KeyNumber("buckling", span, "%", remark)


def _mode_keys(frame: Frame) -> list[KeyNumber]:
    mode, at = frame["modes"][0], f"at {percent(frame['strain'])}"
    wave, count = mode["waves"][0], len(mode["waves"])
    xi = ", ".join(f"{value:.3f}".replace("-", "−") for value in wave["xi"])
    known = [*(wave["sd_noise"] or []), *(wave["sd_model_error"] or [])]
    largest = max((sd for sd in known if sd is not None), default=float("nan"))
    sd = "fixed" if mode["fixed"] else f"± {number(largest, 1)}"
    return [
        KeyNumber("pattern", number(mode["largest_px"], 3), "px", f"largest v₁φ₁ {at}"),
        KeyNumber("largest v₁", _micro(mode["v_max_mm"], 4), "µm", f"± {_two_errors(mode)} µm"),
        KeyNumber("wave vector ξ", f"({xi})", "1/l", f"{sd}; the first of {count}"),
    ]


def _two_errors(mode: Mapping[str, Any]) -> str:
    """Standard errors of the largest v [µm]."""
    parts = [f"{_micro(mode['v_max_sd_noise_mm'])} by noise"]
    if mode["v_max_sd_model_error_mm"] is not None:
        parts.append(f"{_micro(mode['v_max_sd_model_error_mm'])} by model error")
    return " ± ".join(parts)


def _micro(millimetres: float | None, digits: int = 2) -> str:
    """Micrometres; two digits do for errors."""
    return "∞" if millimetres is None else number(1e3 * millimetres, digits)


def _model_error_key(frame: Frame) -> KeyNumber:
    local = frame["local"]
    if local is not None and local["w_beyond_noise_px"] is not None:
        remark = f"rms of local DIC − IDIC beyond the local DIC’s {local['sd_px']:.2g} px"
        return KeyNumber("model error w", number(local["w_beyond_noise_px"], 2), "px", remark)
    remark = "rms, estimated from the residual"
    return KeyNumber("model error w", number(frame["model_error_px"], 2), "px", remark)


def panel_numbers(key: str, frame: Frame) -> str:
    """One line of numbers under a picture; empty if there is nothing to add."""
    local = frame["local"]
    if key == "image":
        return f"{frame['name']}; compression {percent(frame['strain_x'])} along x, " + (
            f"{percent(frame['strain_y'])} along y"
        )
    if key == "residual":
        return _residual_numbers(frame)
    if key == "w" and local is not None:
        text = f"rms {local['w_rms_px']:.3g} px per component at {local['points']} points"
        if local["sd_px"] is not None:
            text += f", of which the local DIC’s own error {local['sd_px']:.2g} px"
        return text + (f"; {local['lost']} points lost" if local["lost"] else "")
    field, _, cause = key.partition("-")
    errors = frame["errors_px"]["noise" if cause == "noise" else "model_error"] if cause else None
    if errors is None or field not in ("v0", "fluc1") or len(frame["modes"]) > 1:
        return ""
    rms = errors[{"v0": "v0", "fluc1": "fluctuation"}[field]]
    return "" if rms is None else f"rms {number(rms, 2)} px per component"


def _residual_numbers(frame: Frame) -> str:
    share, chi = frame["residual_of_full_scale"], frame["chi_square"]
    text = f"rms {number(frame['residual_rms'])} grey levels"
    if share is not None:
        text += f", {percent(share, 2)} of full scale"
    return text + ("" if chi is None else f"; χ² {chi:.3g}")


def photograph_panels(states: Sequence[PhotographState]) -> list[Panel[PhotographState]]:
    """Every quantity that is drawn of one of these photographs."""
    modes = max((len(state.frame.modes) for state in states), default=0)
    panels: list[Panel[PhotographState]] = [
        *_image_panels(),
        *spectrum_panels("photographs", "spect_real", "photographs", _has_spectrum),
        *(p for k, part in enumerate(states[0].frame.parts) for p in _part_panels(k, part.name)),
        *ansatz_panels("found", "real", modes),
        *_residual_panels(),
        *_error_panels("v0", "v<sub>0</sub>", "Smooth field"),
    ]
    for i in range(modes):
        n = f"<sub>{i + 1}</sub>"
        panels += _error_panels(f"v{i + 1}", f"v{n}", "Amplitude of the mode", i)
        panels += _error_panels(f"fluc{i + 1}", f"v{n}φ{n}", "Correlated fluctuation", i)
    panels += _truth_panels()
    return [panel for panel in panels if any(panel.shows(state) for state in states)]


def _image_panels() -> list[Panel[PhotographState]]:
    return [
        Panel(
            "photographs", "image", "", "Deformed photograph", "spect_real (a)",
            "As it was correlated, free from optical distortion. Over it, in yellow, the "
            "material’s outline in the reference, moved by the measured displacement: it should "
            "run along the edges.",
            draw_deformed,
        ),
        Panel(
            "photographs", "closeup", "", "A closer look", "",
            f"{CLOSE} × {CLOSE} cells in the middle, pixel by pixel, with the outline as above.",
            draw_closeup,
        ),
    ]  # fmt: skip


def _part_panels(k: int, name: str) -> list[Panel[PhotographState]]:
    """Spectral densities of part k (from 0)."""
    return [
        Panel(
            "photographs", f"S{axis}{axis}-part{k + 1}", f"S<sub>{axis}{axis}</sub>",
            f"Spectral density along {axis}, region “{name}”", "",
            "Of the displacement in this region alone, which has modes of its own.",
            partial(draw_part_spectrum, part=k, component=component),
        )
        for component, axis in enumerate("xy")
    ]  # fmt: skip


def _residual_panels() -> list[Panel[PhotographState]]:
    return [
        Panel(
            "residual-and-model-error", "residual", "f − g∘φ", "Residual", "real (g) and (o)",
            "In the deformed configuration; single pixels, not averages. The colours end at the "
            "99th percentile. Camera noise is in it, and model error. Blank along the edges: not "
            "compared there.",
            draw_residual, exact=True,
        ),
        Panel(
            "residual-and-model-error", "w", "‖w‖", "Microfluctuation field", "real (h) and (p)",
            "Local DIC − IDIC in the deformed configuration, the local DIC’s own errors included; "
            "blank where it has no point. The colours end at the 99.8th percentile.",
            draw_w, lambda state: state.frame.local is not None,
        ),
    ]  # fmt: skip


def _error_panels(
    field: str, symbol: str, title: str, i: int | None = None
) -> list[Panel[PhotographState]]:
    """Standard deviations of a field by both causes."""

    def shows(state: PhotographState) -> bool:
        return i is None or has_mode(i)(state)

    return [
        Panel(
            "uncertainty", f"{field}-noise", f"sd({symbol})", f"{title}, by noise", "",
            "One standard deviation by the photographs’ noise.",
            partial(draw_error, field=field, cause="noise"), shows,
        ),
        Panel(
            "uncertainty", f"{field}-model", f"sd({symbol})", f"{title}, by model error", "",
            "One standard deviation by the part of the displacement that the ansatz can’t "
            "describe, which perturbs its unknowns cell by cell; noise included.",
            partial(draw_error, field=field, cause="model"),
            lambda state: state.frame.by_model_error is not None and shows(state),
        ),
    ]  # fmt: skip


def _truth_panels() -> list[Panel[PhotographState]]:
    def shows(state: PhotographState) -> bool:
        truth = state.harvest.truth
        return truth is not None and state.frame.name in truth.frames

    parts = {
        "true_w": ("‖w‖", "Truth − IDIC",
                   "The whole error of the measured displacement, in the deformed configuration. "
                   "The colours end at the 99.8th percentile, here and beside."),
        "best": ("‖u − u<sub>best</sub>‖", "Model (ansatz) error",
                 "Truth − best fit of the same unknowns to the true displacement."),
        "loss": ("‖u<sub>best</sub> − u<sub>IDIC</sub>‖", "Measurement error",
                 "Best fit − IDIC: what the measurement adds, on its own, smaller scale."),
    }  # fmt: skip
    return [
        Panel("errors", key, symbol, title, "", caption,
              partial(draw_error_against_truth, part=key), shows)
        for key, (symbol, title, caption) in parts.items()
    ]  # fmt: skip


def _has_spectrum(state: PhotographState) -> bool:
    return state.frame.spectrum is not None


def _with_readings(
    sections: Sequence[Section], shown: Sequence[Frame], names: Mapping[str, str]
) -> Sequence[Section]:
    """The first section with what is read off the densities, and the initial guesses."""
    if not sections:
        return sections
    first, *others = sections
    text = {names[f["name"]]: [*f["pattern_reading"], *f["start"]] for f in shown}
    card = Card("Reading of the densities, and initial guess", text=text, name="reading", wide=True)
    return [Section(first.name, first.title, [*first.cards, card], first.lead), *others]


def _reference(harvest: Harvest, summary: Summary, states: Sequence[PhotographState]) -> Section:
    """What was found in the reference, and the photographs that were not used."""
    lattice, px = summary["lattice"], summary["pixel_size_mm"]
    rows: list[tuple[str, Cell]] = []
    sentences: list[str] = []
    if lattice:
        holes = f"{lattice['holes']}; {lattice['missing']}; {lattice['extra']}"
        pitch, diameter = lattice["pitch_px"], lattice["diameter_px"]
        rows = [
            ("lattice", lattice["kind"]),
            ("holes; missing; not on it", holes),
            ("cell size as found", f"{number(pitch)} px = {number(pitch * px)} mm"),
            ("mean diameter d", f"{number(diameter * px)} mm, d/l {diameter / pitch:.3f}"),
            ("holes off the straight lattice, rms", f"{lattice['misfit_px']:.2f} px"),
        ]
        sentences = list(lattice["text"])
    rows += [
        ("cell size as given", f"{number(summary['cell_size_mm'])} mm"),
        ("pixel size", f"{number(1000 * px)} µm"),
        ("camera noise", f"{number(summary['noise']['sd'])} levels"),
    ]
    drawn = partial(draw_reference, harvest, states[0].view.outline, states[0].levels)
    figure = ReportFigure("reference", "The reference", drawn, wide=True)
    table = ReportTable("Reference", ("", ""), rows)
    title = "Material, holes, lattice and the part with holes"
    cards = [Card(title, [figure], [table], [*sentences, *summary["text"]], wide=True)]
    skipped = [(row["name"], row["reason"]) for row in summary["skipped"]]
    table = ReportTable("Photographs not used", ("photograph", "reason"), skipped, "skipped")
    cards += [Card.tabular(table, wide=True)] if skipped else []
    lead = (
        "All results rest on what is drawn here. If the outline does not follow the material, or "
        "the lattice the holes, give a mask image or a polygon and the cell size."
    )
    return Section("confirm", "Reference", cards, lead)


def _optics(harvest: Harvest, summary: Summary) -> Section:
    """Distortion, its standard deviation and its error, as far as they are known."""
    lens, grid, numbers = harvest.lens, harvest.grid, summary["optics"]
    assert lens is not None

    cards = [
        Card.single("distortion", "Distortion S", partial(draw_distortion, lens, grid),
             f"Colour: its length, at most {number(numbers['max_px'])} px. Arrows: S itself, "
             "enlarged."),
    ]  # fmt: skip
    if harvest.calibration is not None:
        drawn = partial(draw_distortion_sd, harvest.calibration, grid)
        cards.append(Card.single("distortion-sd", "Standard deviation of S", drawn,
                          f"By the noise of the calibration’s photographs, "
                          f"{number(numbers['sd_rms_px'])} px rms."))  # fmt: skip
    if harvest.truth is not None and harvest.truth.distortion is not None:
        drawn = partial(draw_distortion_error, lens, harvest.truth.distortion, grid)
        cards.append(Card.single("distortion-error", "S − truth, affine part aside", drawn,
                          "Known for the photographs of a simulation."))  # fmt: skip
    lead = (
        "Eq. (r2) of the paper: the lens shows the ideal position x at x + S(x). The photographs "
        "are freed from S once, before anything is measured."
    )
    return Section("optics", "Optical distortion", [*cards, *_calibration_cards(numbers)], lead)


def _calibration_cards(numbers: Mapping[str, Any]) -> list[Card]:
    if "trials" not in numbers:
        return []
    rows = [
        (t["degree"], t["unknowns"], t["residual_rms"], t["bic"], t["change_px"], t["sd_px"],
         Mark("chosen", True) if t["bic"] == 0 else "")
        for t in numbers["trials"]
    ]  # fmt: skip
    columns = ("degree", "unknowns", "residual [levels]", "BIC − lowest", "change of S [px]",
               "sd of S [px]", "")  # fmt: skip
    parts = zip(numbers["shifts_px"], numbers["shifts_sd_px"], numbers["angles_rad"],
                numbers["angles_sd_rad"], numbers["matches"], strict=True)  # fmt: skip
    motion = [
        (k, Measured(shift[1], (sd[1],), 3), Measured(shift[0], (sd[0],), 3),
         Measured(1000 * angle, (1000 * angle_sd,), 3), f"{match:.3f}")
        for k, (shift, sd, angle, angle_sd, match) in enumerate(parts, start=1)
    ]  # fmt: skip
    heads = ("", "right [px]", "down [px]", "turn [mrad]", "match")
    tables = [
        ReportTable("Choice of the degree", columns, rows, "degrees"),
        ReportTable(f"The target’s motion in {len(motion)} photographs", heads, motion,
                    folded=True),
    ]  # fmt: skip
    return [Card("Choice of the degree", tables=tables, text=numbers["text"], wide=True)]


def _truth_cards(summary: Summary) -> list[Card]:
    rows = [
        (row["quantity"], row["obtained"], row["unit"], row["expected"], verdict(row["ok"]))
        for row in summary.get("truth") or []
    ]
    columns = ("quantity", "obtained", "unit", "expected", "")
    table = ReportTable("Against the truth", columns, rows, "obtained", on_terminal=True)
    return [Card.tabular(table, wide=True)] if rows else []


def _timeline(harvest: Harvest, summary: Summary) -> Section:
    """The test from photograph to photograph, where there is more than one."""
    cards = []
    if harvest.timeline:
        drawn = partial(draw_onset, harvest.timeline, harvest.buckling)
        cards.append(Card.single(
            "timeline-pattern", "Amplitude of the pattern", drawn,
            "Bars: two standard deviations by noise. A pattern is observable above both "
            "bands, of model error and of noise. Shaded: the strains between which it appears. "
            "Dashed: growth with the square root of the strain beyond the ringed one, as after a "
            "pitchfork bifurcation.",
        ))  # fmt: skip
    frames = [frame for frame in summary["frames"] if frame["modes"]]
    if len(frames) > 1:
        drawn = partial(draw_waves, frames)
        cards.append(Card.single(
            "timeline-waves", "Wave vectors of the pattern", drawn,
            "Bars: two standard deviations by the larger cause. Open: the mode was fixed, "
            "or not observable.",
        ))  # fmt: skip
    return Section("timeline", "Time line", cards)


_FRAME_COLUMNS = (
    "photograph", "strain x [%]", "strain y [%]", "pattern, rms [px]", "largest [px]",
    "sd of it by noise [px]", "… by model error [px]", "model error w, estimated [px]",
    "w by local DIC [px]", "residual [levels]", "χ²", "iterations on the full image",
    "… on all levels", "outcome",
)  # fmt: skip


def number_cards(summary: Summary, shown: Sequence[Frame], names: Mapping[str, str]) -> list[Card]:
    """Tables of all photographs, and of the modes in those that are shown."""
    frames = ReportTable("Every photograph", _FRAME_COLUMNS, frame_rows(summary), "frames",
                         on_terminal=True)  # fmt: skip
    return [
        Card.tabular(frames, wide=True),
        *_amplitude_cards(shown, names),
        *mode_cards(shown, names),
        *_wave_cards(shown, names),
    ]


def frame_rows(summary: Summary) -> list[tuple[Cell, ...]]:
    """A row for each photograph."""
    rows: list[tuple[Cell, ...]] = []
    for frame in summary["frames"]:
        modes, errors, local = frame["modes"], frame["errors_px"], frame["local"]
        amplitude = max((m["amplitude_px"] for m in modes), default=None)
        largest = max((m["largest_px"] for m in modes), default=None)
        sds = [(errors[cause] or {}).get("fluctuation") for cause in ("noise", "model_error")]
        rows.append((
            frame["name"], number(100 * frame["strain_x"], 4), number(100 * frame["strain_y"], 4),
            number(amplitude, 3), number(largest, 3), *(number(sd, 2) for sd in sds),
            number(frame["model_error_px"], 2),
            number(None if local is None else local["w_rms_px"], 2),
            number(frame["residual_rms"], 3), number(frame["chi_square"], 3),
            frame["iterations"], frame["iterations_all_levels"],
            Mark(frame["outcome"], frame["outcome"] == "converged"),
        ))  # fmt: skip
    return rows


def _amplitude_cards(frames: Sequence[Frame], names: Mapping[str, str]) -> list[Card]:
    rows: list[tuple[Cell, ...]] = [
        (names[frame["name"]], f"φ{i}",
         ("observable" if mode["observable"] else "not observable")
         + (", fixed" if mode["fixed"] else ""),
         number(mode["largest_px"], 3), f"{_micro(mode['v_max_mm'], 4)} ± {_two_errors(mode)}")
        for frame in frames for i, mode in enumerate(frame["modes"], start=1)
    ]  # fmt: skip
    columns = ("", "mode", "", "largest v φ [px]", "largest v among the holes [µm]")
    table = ReportTable("Amplitudes of the modes", columns, rows, "amplitudes", on_terminal=True)
    return [Card.tabular(table, wide=len(frames) > 2)] if rows else []


def mode_cards(frames: Sequence[Frame], names: Mapping[str, str]) -> list[Card]:
    """For each mode its parameters in each of these frames, with both standard errors."""
    cards = []
    for i in range(max((len(frame["modes"]) for frame in frames), default=0)):
        of = [frame for frame in frames if i < len(frame["modes"])]
        free = [frame for frame in of if not frame["modes"][i]["fixed"]]
        fixed = [names[frame["name"]] for frame in of if frame["modes"][i]["fixed"]]
        found = [{p["name"]: p for p in frame["modes"][i]["parameters"]} for frame in free]
        units = {name: p["unit"] for column in found for name, p in column.items()}
        rows = [(name, unit, *(_measured(column.get(name)) for column in found))
                for name, unit in units.items()]  # fmt: skip
        columns = ("", "unit", *(names[frame["name"]] for frame in free))
        anchor = "mode" if i == 0 else f"mode-{i + 1}"
        table = ReportTable(f"Parameters of φ{i + 1}", columns, rows, anchor)
        families = dict.fromkeys(frame["modes"][i]["family"] for frame in free)
        caption = "± standard error by noise ± by model error." + (
            f" Fixed: {'; '.join(fixed)}." if fixed else "")  # fmt: skip
        if rows:
            cards.append(Card.tabular(table, caption=caption,
                              paper="; ".join(families), wide=len(free) > 2))  # fmt: skip
    return cards


def _measured(parameter: Mapping[str, Any] | None) -> Measured | None:
    if parameter is None:
        return None
    return Measured(parameter["value"], _known(parameter["sd_noise"], parameter["sd_model_error"]))


def _known(*errors: float | None) -> tuple[float, ...]:
    return tuple(error for error in errors if error is not None)


def _wave_cards(frames: Sequence[Frame], names: Mapping[str, str]) -> list[Card]:
    """Wave vectors of all modes in these frames, with both standard errors."""
    rows: list[tuple[Cell, ...]] = []
    for frame in frames:
        for i, mode in enumerate(frame["modes"], start=1):
            for w, wave in enumerate(mode["waves"], start=1):
                noise, model = wave["sd_noise"] or [None] * 2, wave["sd_model_error"] or [None] * 2
                remark = ", fixed" * mode["fixed"] or ", not observable" * (not mode["observable"])
                rows.append((
                    names[frame["name"]] if i == w == 1 else "", f"{w} of φ{i}{remark}",
                    *(Measured(wave["xi"][c], _known(noise[c], model[c])) for c in (0, 1)),
                ))  # fmt: skip
    table = ReportTable("Wave vectors", ("", "wave", "ξ₁ [1/l]", "ξ₂ [1/l]"), rows, "waves",
                        on_terminal=True)  # fmt: skip
    caption = (
        "± standard error by noise ± by model error. A wave of wavelength λ has |ξ| = l/λ; "
        "(½, ½) repeats after two cells."
    )
    return [Card.tabular(table, caption=caption, wide=len(frames) > 2)] if rows else []


def _convergence(states: Sequence[PhotographState], frames: Mapping[str, Frame]) -> Section:
    cards = [
        Card.single(f"convergence-{state.name}", state.label,
                    partial(draw_convergence, state.result),
                    frames[state.frame.name]["outcome_why"])
        for state in states
    ]  # fmt: skip
    return Section("convergence", "Convergence", cards)


def notes(summary: Summary) -> list[str]:
    """What a reader should know before trusting the numbers."""
    text = []
    for frame in summary["frames"]:
        at = f"{frame['name']}, {percent(frame['strain'])}:"
        if frame["outcome"] != "converged":
            ended = f"the correlation ended as “{frame['outcome']}”: {frame['outcome_why']}"
            text.append(f"{at} {ended}")
        text += [f"{at} {frame['residual_test']}", f"{at} {_sentence(frame['weighting'])}"]
    noise = summary["noise"]
    share = "" if noise["of_full_scale"] is None else (
        f", {100 * noise['of_full_scale']:.2g} % of full scale")  # fmt: skip
    text += [
        f"Camera noise: {noise['sd']:.3g} grey levels{share}, {noise['source']}.",
        "Two standard errors are given apart. The first is by the photographs’ noise, the "
        "Cramér–Rao bound. The second is by model error, the part of the displacement that the "
        "ansatz can’t describe, estimated from the residual with one block for each cell; it "
        "includes the noise, and takes cells for independent.",
        "Neither of them is the difference between the measured field and the true displacement: "
        "that is the microfluctuation field w.",
        "rms is per component: the root of the mean square over both components.",
    ]
    return text


def _sentence(text: str) -> str:
    return text if text.endswith(".") else f"{text}."
