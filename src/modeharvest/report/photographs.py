"""Report of photographs: one page like the paper's Figs. "spect_real" and "real"."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from markupsafe import Markup

from modeharvest.report.experiment import verdict
from modeharvest.report.figures import fits
from modeharvest.report.figures import photographs as figures
from modeharvest.report.figures.curves import draw_onset, draw_waves
from modeharvest.report.figures.photographs import PhotographState
from modeharvest.report.figures.whole_field import whole_cards, whole_panel_numbers
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
    caption,
    number,
    percent,
    text_of,
)
from modeharvest.runs.photographs.results import Harvest

Summary = Mapping[str, Any]
Frame = Mapping[str, Any]

_PANELED = ("photographs", "found", "whole", "residual-and-model-error", "uncertainty", "errors")
"""Sections of panels, in this order."""


def photographs_report(summary: Summary, harvest: Harvest | None = None) -> Report:
    """The report of measured photographs.

    ``summary``: the content of ``summary.json``. ``harvest``: what its figures show; without, the
    report has numbers only, as for the terminal.
    """
    frames = {frame["name"]: frame for frame in summary["frames"]}
    shown = (
        [frames[f.name] for f in figures.shown_frames(harvest)] if harvest else summary["frames"]
    )
    names = photograph_labels(shown)
    states = figures.photograph_states(harvest, names) if harvest else []
    buckling = summary.get("buckling") or {}
    sections = fits.panel_sections(
        _PANELED, photograph_panels(states), states,
        lambda key, s: panel_numbers(key, frames[s.frame.name]) or fits.shape_numbers(key, s),
        known="These photographs were made by a simulation, so the truth is known. ",
        source="Fig. “real” of the paper. ", pattern=Markup("v<sub>1</sub>φ<sub>1</sub>"),
    )  # fmt: skip
    sections = [section for section in sections if section.cards or section.name != "whole"]
    steps = [fits.convergence_card(s, frames[s.frame.name]["outcome_why"]) for s in states]
    last, hero = summary["frames"][-1], None
    if states:
        drawn = partial(figures.draw_hero, states[-1])
        hero = ReportFigure("hero", "The last photograph", drawn)
    return Report(
        kind="photographs",
        title=summary["title"],
        lead=caption("page-photographs")["lead"],
        findings=[buckling["text"]] if buckling.get("text") else [],
        keys=key_numbers(summary),
        sections=[
            *([_reference(harvest, summary, states)] if harvest else []),
            *([_optics(harvest, summary)] if harvest and harvest.optics.distortion else []),
            *(_with_readings(sections, shown, names) if states else []),
            Section("truth", "Obtained and expected values", _truth_cards(summary)),
            *([_timeline(harvest, summary)] if harvest else []),
            Section("numbers", "Numbers", number_cards(summary, shown, names)),
            Section("convergence", "Convergence", steps),
        ],
        warnings=[
            *(f"not used: {row['name']}: {row['reason']}" for row in summary.get("skipped", [])),
            *(f"{frame['name']}: {_capitalised(warning)}" for frame in summary["frames"]
              for warning in frame["warnings"]),
        ],
        notes=notes(summary),
        command=harvest.command if harvest else "",
        toml=harvest.toml if harvest else "",
        case=summary["experiment"],
        versions=summary["versions"],
        hero=hero,
        hero_caption=text_of("photographs-hero", name=last["name"],
                             state=photograph_label(last).lower()),
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
    local, whole = frame["local"], frame["whole_field"]
    if whole is not None:
        remark = "rms of whole displacement − IDIC"
        return KeyNumber("model error w", number(whole["w_rms_px"], 2), "px", remark)
    if local is not None and local["w_beyond_noise_px"] is not None:
        remark = f"rms of local DIC − IDIC beyond the local DIC’s {local['sd_px']:.2g} px"
        return KeyNumber("model error w", number(local["w_beyond_noise_px"], 2), "px", remark)
    remark = "rms, estimated from the residual"
    return KeyNumber("model error w", number(frame["model_error_px"], 2), "px", remark)


def panel_numbers(key: str, frame: Frame) -> str:
    """One line of numbers under a picture; empty if there is nothing to add."""
    local = frame["local"]
    if key.startswith("whole-"):
        return whole_panel_numbers(key, frame["whole_field"])
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


def photograph_panels(states: Sequence[PhotographState]) -> list[fits.Panel[PhotographState]]:
    """Every quantity that is drawn of one of these photographs."""
    modes = max((len(state.frame.modes) for state in states), default=0)
    parts = states[0].frame.parts if states else ()

    def has_spectrum(state: PhotographState) -> bool:
        return state.frame.spectrum is not None

    def is_known(state: PhotographState) -> bool:
        return figures.truth_of(state) is not None

    last = "residual-and-model-error"
    panels: list[fits.Panel[PhotographState]] = [
        fits.Panel.of("photographs", "image", figures.draw_deformed, text="photograph"),
        fits.Panel.of("photographs", "closeup", figures.draw_closeup, cells=figures.CLOSE),
        *fits.spectrum_panels("photographs", "spect_real", "photographs", has_spectrum),
        *(fits.Panel.of("photographs", f"S{axis}{axis}-part{k + 1}",
                   partial(figures.draw_part_spectrum, part=k, component=c), text=f"part-{axis}",
                   part=part.name)
          for k, part in enumerate(parts) for c, axis in enumerate("xy")),
        *fits.ansatz_panels("found", "real", modes),
        *figures.WHOLE_MAPS.panels(),
        fits.Panel.of(last, "residual", figures.draw_residual, text="photograph-residual",
                      exact=True),
        fits.Panel.of(last, "w", figures.draw_w, lambda state: state.frame.local is not None,
                      "photograph-w"),
        *_error_panels("v0", "v0"),
    ]  # fmt: skip
    for i in range(modes):
        panels += [*_error_panels(f"v{i + 1}", "v", i), *_error_panels(f"fluc{i + 1}", "fluc", i)]
    for part, text in {"true_w": "true-w", "best": "best", "loss": "loss"}.items():
        drawn = partial(figures.draw_error_against_truth, part=part)
        panels.append(fits.Panel.of("errors", part, drawn, is_known, text))
    return [panel for panel in panels if any(map(panel.shows, states))]


def _error_panels(field: str, text: str, i: int | None = None) -> list[fits.Panel[PhotographState]]:
    """Standard deviations of a field by both causes."""

    def shows(state: PhotographState) -> bool:
        return i is None or fits.has_mode(i)(state)

    def shows_model(state: PhotographState) -> bool:
        return state.frame.by_model_error is not None and shows(state)

    causes: dict[figures.Cause, Callable[[PhotographState], bool]]
    causes = {"noise": shows, "model": shows_model}
    return [
        fits.Panel.of("uncertainty", f"{field}-{cause}",
                 partial(figures.draw_error, field=field, cause=cause), shown, f"{text}-{cause}",
                 n=(i or 0) + 1)
        for cause, shown in causes.items()
    ]  # fmt: skip


def _with_readings(
    sections: Sequence[Section], shown: Sequence[Frame], names: Mapping[str, str]
) -> Sequence[Section]:
    """The first section with what is read off the densities, and the initial guesses."""
    first, *others = sections
    text = {names[f["name"]]: [*f["pattern_reading"], *f["start"]] for f in shown}
    card = Card("Reading of the densities, and initial guess", text=text, name="reading", wide=True)
    return [Section(first.name, first.title, [*first.cards, card], first.lead), *others]


def _reference(harvest: Harvest, summary: Summary, states: Sequence[PhotographState]) -> Section:
    """What was found in the reference, and the photographs that were not used."""
    lattice, px = summary["lattice"], summary["pixel_size_mm"]
    rows: list[tuple[str, Cell]] = []
    text: list[str] = []
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
        text = list(lattice["text"])
    rows += [
        ("cell size as given", f"{number(summary['cell_size_mm'])} mm"),
        ("pixel size", f"{number(1000 * px)} µm"),
        ("camera noise", f"{number(summary['noise']['sd'])} levels"),
    ]
    drawn = partial(figures.draw_reference, harvest, states[0].view.boundary, states[0].levels)
    figure = ReportFigure("reference", "The reference", drawn, wide=True)
    table = ReportTable("Reference", ("", ""), rows)
    title = "Material, holes, lattice and the part with holes"
    cards = [Card(title, [figure], [table], [*text, *summary["text"]], wide=True)]
    skipped = [(row["name"], row["reason"]) for row in summary["skipped"]]
    table = ReportTable("Photographs not used", ("photograph", "reason"), skipped, "skipped")
    cards += Card.tabular(table, wide=True)
    return Section.of("confirm", cards)


def _optics(harvest: Harvest, summary: Summary) -> Section:
    """Distortion, its standard deviation and its error, as far as they are known."""
    lens, grid, numbers = harvest.optics.distortion, harvest.grid, summary["optics"]
    assert lens is not None

    cards = [Card.captioned("distortion", partial(figures.draw_distortion, lens, grid),
                            largest=number(numbers["max_px"]))]  # fmt: skip
    if harvest.optics.calibration is not None:
        drawn = partial(figures.draw_distortion_sd, harvest.optics.calibration, grid)
        cards.append(Card.captioned("distortion-sd", drawn, rms=number(numbers["sd_rms_px"])))
    if harvest.truth is not None and harvest.truth.distortion is not None:
        drawn = partial(figures.draw_distortion_error, lens, harvest.truth.distortion, grid)
        cards.append(Card.captioned("distortion-error", drawn))
    return Section.of("optics", [*cards, *_calibration_cards(numbers)])


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
    return Card.tabular(table, wide=True)


def _timeline(harvest: Harvest, summary: Summary) -> Section:
    """The test from photograph to photograph, where there is more than one."""
    cards = []
    if harvest.timeline:
        drawn = partial(draw_onset, harvest.timeline, harvest.buckling)
        cards.append(Card.captioned("timeline-pattern", drawn))
    frames = [frame for frame in summary["frames"] if frame["modes"]]
    if len(frames) > 1:
        cards.append(Card.captioned("timeline-waves", partial(draw_waves, frames)))
    return Section.of("timeline", cards)


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
        *Card.tabular(frames, wide=True),
        *whole_cards([(names[f["name"]], f["whole_field"]) for f in shown if f.get("whole_field")]),
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
    return Card.tabular(table, wide=len(frames) > 2)


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
        cards += Card.tabular(table, caption=caption, paper="; ".join(families),
                              wide=len(free) > 2)  # fmt: skip
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
    words = text_of("photographs-waves")
    return Card.tabular(table, caption=words, wide=len(frames) > 2)


def notes(summary: Summary) -> list[str]:
    """What a reader should know before trusting the numbers."""
    text = []
    for frame in summary["frames"]:
        at = f"{frame['name']}, {percent(frame['strain'])}:"
        if frame["outcome"] != "converged":
            ended = f"the correlation ended as “{frame['outcome']}”: {frame['outcome_why']}"
            text.append(f"{at} {ended}")
        text += [f"{at} {frame['residual_test']}", f"{at} {_capitalised(frame['weighting'])}"]
    noise = summary["noise"]
    share = "" if noise["of_full_scale"] is None else (
        f", {100 * noise['of_full_scale']:.2g} % of full scale")  # fmt: skip
    text += [
        f"Camera noise: {noise['sd']:.3g} grey levels{share}, {noise['source']}.",
        *map(text_of, ("photographs-errors", "photographs-w", "photographs-rms")),
    ]
    return text


def _capitalised(text: str) -> str:
    return text if text.endswith(".") else f"{text}."
