"""Report of photographs of a test, with figures like the paper's Figs. 6 and 7."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from markupsafe import Markup

from modeharvest.report.experiment import expected_cards, outcome_text
from modeharvest.report.explore import explored_photographs
from modeharvest.report.figures import fits
from modeharvest.report.figures import photographs as figures
from modeharvest.report.figures.curves import draw_onset, draw_waves
from modeharvest.report.figures.on_photographs import axis_text, draw_gauges_on, gauge_cards
from modeharvest.report.figures.photographs import PhotographState
from modeharvest.report.figures.sequence import force_cards
from modeharvest.report.figures.whole_field import whole_cards, whole_panel_numbers
from modeharvest.report.model.content import (
    Card,
    KeyNumber,
    Report,
    ReportFigure,
    ReportTable,
    Section,
)
from modeharvest.report.model.text import (
    Cell,
    Mark,
    Measured,
    caption,
    indexed,
    number,
    percent,
    text_of,
)
from modeharvest.runs.photographs.results import Harvest

Summary = Mapping[str, Any]
Frame = Mapping[str, Any]

_PANELED = ("photographs", "found", "whole", "residual-and-model-error", "uncertainty", "errors")
"""Names of the sections that have panels, in the order of the page."""


def photographs_report(summary: Summary, harvest: Harvest | None = None) -> Report:
    """The report of measured photographs.

    ``summary``: the content of ``summary.json``. ``harvest``: the data of the figures; if None, the
    report has no figures, as for the terminal.
    """
    frames = {frame["name"]: frame for frame in summary["frames"]}
    shown = (
        [frames[f.name] for f in figures.shown_frames(harvest)] if harvest else summary["frames"]
    )
    names = photograph_labels(shown)
    states = figures.photograph_states(harvest, names) if harvest else []
    buckling, along = summary.get("buckling") or {}, axis_text(summary.get("angle_deg", 0.0))
    panels = fits.panel_sections(
        _PANELED, photograph_panels(states), states,
        lambda key, s: (
            panel_numbers(key, frames[s.frame.name], along) or fits.shape_numbers(key, s)
        ),
        known="These photographs were made by a simulation, so the truth is known. ",
        source="Fig. 7 of the paper. ", pattern=Markup("v<sub>1</sub>φ<sub>1</sub>"),
    )  # fmt: skip
    drawn: list[Section] = []
    if harvest:
        text = {names[f["name"]]: [*f["pattern_reading"], *f["start"]] for f in shown}
        readings = Card(text=text, name="reading", wide=True, **caption("readings"))
        panels[0] = replace(panels[0], cards=[*panels[0].cards, readings])
        drawn = [_reference(harvest, summary, states), _optics(harvest, summary), *panels]
    steps = [fits.convergence_card(s, frames[s.frame.name]["outcome_why"]) for s in states]
    last = summary["frames"][-1]
    state = photograph_label(last).lower()
    return Report(
        kind="photographs",
        title=summary["title"],
        findings=[buckling["text"]] if buckling.get("text") else [],
        keys=key_numbers(summary),
        sections=[
            *drawn,
            Section.of("truth", expected_cards("truth", summary.get("truth") or []), "expected"),
            *([_timeline(harvest, summary)] if harvest else []),
            Section.of("gauges", _gauge_cards(summary, states)),
            Section.of("numbers", number_cards(summary, shown, names)),
            Section.of("convergence", steps),
        ],
        warnings=[
            *summary.get("warnings", []),
            *(f"not used: {row['name']}: {row['reason']}" for row in summary.get("skipped", [])),
            *(f"{frame['name']}: {_full_stop(warning)}" for frame in summary["frames"]
              for warning in frame["warnings"]),
        ],
        notes=notes(summary),
        command=harvest.command if harvest else "",
        toml=harvest.toml if harvest else "",
        case=summary["experiment"],
        versions=summary["versions"],
        hero=ReportFigure("hero", "The last photograph", partial(figures.draw_hero, states[-1]))
        if states else None,
        explore=partial(explored_photographs, states, figures.truth_of, figures.residual_of)
        if states else None,
        hero_caption=text_of("photographs-hero", name=last["name"], state=state),
        **caption("page-photographs"),
    )  # fmt: skip


def photograph_label(frame: Frame) -> str:
    """Heading of a photograph's figures: its state, and its nominal strain [%]."""
    has = frame["has_pattern"]
    state = "Deformed" if has is None else "After buckling" if has else "Before buckling"
    return f"{state} · {percent(frame['strain'])}"


def photograph_labels(frames: Sequence[Frame]) -> dict[str, str]:
    """Labels of photographs by their names; where labels are equal, the name is appended."""
    made = {frame["name"]: photograph_label(frame) for frame in frames}
    often = Counter(made.values())
    return {name: text if often[text] == 1 else f"{text} · {name}" for name, text in made.items()}


def key_numbers(summary: Summary) -> list[KeyNumber]:
    """The key numbers at the top of the page."""
    last, rows = summary["frames"][-1], [r for r in summary["truth"] if r["ok"] is not None]
    used, left = len(summary["frames"]), len(summary["skipped"])
    count, key = f"{used} of {used + left}", "some-used" if left else "all-used"
    first = KeyNumber.of(key, count, left=left)
    if rows:
        first = KeyNumber.of("truth", f"{sum(row['ok'] for row in rows)} of {len(rows)}")
    modes = _mode_keys(last) if last["modes"] else []
    return [first, _buckling(summary), *modes, _model_error_key(last)]


def _buckling(summary: Summary) -> KeyNumber:
    found = summary["buckling"]
    if found is None or found["after"] is None:
        return KeyNumber.of("no-buckling", None)
    after = f"{100 * found['after']:.4g}"
    if found["before"] is None:
        return KeyNumber.of("all-buckled", f"< {after}")
    key = "buckling" if found["estimate"] is None else "buckling-estimate"
    return KeyNumber.of(key, f"{100 * found['before']:.4g} … {after}", **found)


def _mode_keys(frame: Frame) -> list[KeyNumber]:
    mode, at = frame["modes"][0], f"at {percent(frame['strain'])}"
    wave, count = mode["waves"][0], len(mode["waves"])
    xi = ", ".join(f"{value:.3f}".replace("-", "−") for value in wave["xi"])
    known = [*(wave["sd_noise"] or []), *(wave["sd_model_error"] or [])]
    largest = max((sd for sd in known if sd is not None), default=float("nan"))
    sd = "fixed" if mode["fixed"] else f"± {number(largest, 1)}"
    return [
        KeyNumber.of("pattern", number(mode["largest_px"], 3), symbol="v₁φ₁", at=at),
        KeyNumber.of("amplitude", _micro(mode["v_max_mm"], 4), sd=_two_errors(mode)),
        KeyNumber.of("wave", f"({xi})", sd=sd, count=count),
    ]


def _two_errors(mode: Mapping[str, Any]) -> str:
    """Text of the standard errors of the mode's amplitude where it is largest."""
    parts = [f"±\u00a0{_micro(mode['v_max_sd_noise_mm'])}\u00a0µm by noise"]
    if (sd := mode["v_max_sd_model_error_mm"]) is not None:
        parts.append(f"±\u00a0{_micro(sd)}\u00a0µm by model error")
    return ", ".join(parts)


def _micro(millimetres: float | None, digits: int = 2) -> str:
    """A length [mm] as text [µm], by default with two digits, as for errors; "∞" for None."""
    return "∞" if millimetres is None else number(1e3 * millimetres, digits)


def _model_error_key(frame: Frame) -> KeyNumber:
    local, whole = frame["local"], frame["whole_field"]
    name = "estimated-w"
    if whole is not None:
        name = "whole-w"
    elif local is not None and local["w_beyond_noise_px"] is not None:
        name = "local-w"
    return KeyNumber.of(name, **frame)


def panel_numbers(key: str, frame: Frame, along: str = "x") -> str:
    """Line of numbers below a panel's picture; empty if there is nothing to add.

    ``along``: the axis of its strains.
    """
    local = frame["local"]
    if key.startswith("whole-"):
        return whole_panel_numbers(key, frame["whole_field"])
    if key == "image":
        return text_of("photographs-image", frame=frame, along=along)
    if key == "residual":
        return _residual_numbers(frame)
    if key == "w" and local is not None:
        text = text_of("photographs-local", **local)
        text += "" if local["sd_px"] is None else text_of("photographs-local-sd", **local)
        return text + (f"; {local['lost']} points lost" if local["lost"] else "")
    field, _, cause = key.partition("-")
    errors = frame["errors_px"]["noise" if cause == "noise" else "model_error"] if cause else None
    if errors is None or field not in ("v0", "fluc1") or len(frame["modes"]) > 1:
        return ""
    rms = errors[{"v0": "v0", "fluc1": "fluctuation"}[field]]
    return "" if rms is None else f"rms {number(rms, 2)} px per component"


def _residual_numbers(frame: Frame) -> str:
    names = ("residual_rms", "residual_of_full_scale", "chi_square")
    known = [name for name in names if frame[name] is not None]
    return "".join(text_of(f"photographs-{name}", **frame) for name in known)


def photograph_panels(states: Sequence[PhotographState]) -> list[fits.Panel[PhotographState]]:
    """All quantities that are drawn for at least one of these photographs."""
    modes = max((len(state.frame.modes) for state in states), default=0)
    parts = states[0].frame.parts if states else ()
    fields = [("v0", 0), *((name, i) for i in range(modes) for name in ("v", "fluc"))]

    def has_spectrum(state: PhotographState) -> bool:
        return state.frame.spectrum is not None

    def has_local(state: PhotographState) -> bool:
        return state.frame.w is not None and state.frame.whole is None  # else drawn above

    def has_residual(state: PhotographState) -> bool:
        return not state.frame.by_contours

    def is_known(state: PhotographState) -> bool:
        return figures.truth_of(state) is not None

    last, Panel = "residual-and-model-error", fits.Panel[PhotographState]
    panels: list[fits.Panel[PhotographState]] = [
        Panel("photographs", "image", figures.draw_deformed, text="photograph"),
        Panel("photographs", "closeup", figures.draw_closeup, values={"cells": figures.CLOSE}),
        *fits.spectrum_panels("photographs", "6", "photographs", has_spectrum),
        *(Panel("photographs", f"S{axis}{axis}-part{k + 1}",
                partial(figures.draw_part_spectrum, part=k, component=c), text=f"part-{axis}",
                values={"part": part.name if part.name == "w" else f"region “{part.name}”"})
          for k, part in enumerate(parts) for c, axis in enumerate("xy")),
        *fits.ansatz_panels("found", "7", modes),
        *figures.WHOLE_MAPS.panels(),
        Panel(last, "residual", figures.draw_residual, has_residual, "photograph-residual",
              exact=True),
        Panel(last, "w", figures.draw_w, has_local, "photograph-w"),
        *(Panel("uncertainty", f"{name}{'' if name == 'v0' else i + 1}-{cause}",
                partial(figures.draw_error, name=name, i=i, cause=cause),
                partial(figures.has_error, name=name, i=i, cause=cause), f"{name}-{cause}",
                values={"n": i + 1})
          for name, i in fields for cause in ("noise", "model")),
        *(Panel("errors", part, partial(figures.draw_error_against_truth, part=part), is_known,
                part.replace("_", "-")) for part in ("true_w", "best", "loss")),
    ]  # fmt: skip
    return [panel for panel in panels if any(map(panel.shows, states))]


def _reference(harvest: Harvest, summary: Summary, states: Sequence[PhotographState]) -> Section:
    """Holes, lattice and scale found in the reference; the photographs that were not used."""
    lattice, px = summary["lattice"], summary["pixel_size_mm"]
    rows: list[tuple[str, Cell]] = []
    text: list[str] = []
    if lattice:
        holes = f"{lattice['holes']}; {lattice['missing']}; {lattice['extra']}"
        pitch, diameter = lattice["pitch_px"], lattice["diameter_px"]
        rows = [
            ("lattice", lattice["kind"]),
            ("holes on the lattice; missing; off it", holes),
            ("cell size as found", f"{number(pitch)} px = {number(pitch * px)} mm"),
            ("mean diameter d", f"{number(diameter * px)} mm, d/l {diameter / pitch:.3f}"),
            ("distance of holes from the lattice, rms", f"{lattice['misfit_px']:.2f} px"),
        ]
        text = list(lattice["text"])
    rows += [
        ("cell size as given", f"{number(summary['cell_size_mm'])} mm"),
        ("pixel size", f"{number(1000 * px)} µm"),
        ("camera noise", f"{number(summary['noise']['sd'])} grey levels"),
    ]
    drawn = partial(figures.draw_reference, harvest, states[0].view.boundary, states[0].levels)
    figure = ReportFigure("reference", "The reference", drawn, wide=True)
    table = ReportTable("Reference", ("", ""), rows)
    words = caption("reference")
    card = Card(**words, figures=[figure], tables=[table], text=text + summary["text"], wide=True)
    skipped = ReportTable.of("skipped", summary["skipped"])
    return Section.of("confirm", [card, *Card.tabular(skipped, wide=True)])


def _optics(harvest: Harvest, summary: Summary) -> Section:
    """The lens distortion, its standard deviation and its error, as far as they are known."""
    lens, grid, numbers = harvest.optics.distortion, harvest.grid, summary["optics"]
    if lens is None:
        return Section.of("optics", [])
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
    chosen = Mark("chosen", True)
    trials = [{**t, "chosen": chosen if t["bic"] == 0 else ""} for t in numbers["trials"]]
    parts = zip(numbers["shifts_px"], numbers["shifts_sd_px"], numbers["angles_rad"],
                numbers["angles_sd_rad"], numbers["matches"], strict=True)  # fmt: skip
    motion = [
        {"number": k, "right": Measured(shift[1], (sd[1],), 3),
         "down": Measured(shift[0], (sd[0],), 3),
         "turn": Measured(1000 * angle, (1000 * angle_sd,), 3), "match": f"{match:.3f}"}
        for k, (shift, sd, angle, angle_sd, match) in enumerate(parts, start=1)
    ]  # fmt: skip
    tables = [
        ReportTable.of("degrees", trials),
        ReportTable.of("motion", motion, count=len(motion)),
    ]
    return [Card(tables[0].title, tables=tables, text=numbers["text"], wide=True)]


def _timeline(harvest: Harvest, summary: Summary) -> Section:
    """Amplitude, force and wave vectors over the sequence of photographs, where known."""
    cards = []
    if harvest.timeline:
        drawn = partial(draw_onset, harvest.timeline, harvest.buckling)
        cards.append(Card.captioned("timeline-pattern", drawn))
    cards += force_cards(summary["frames"], "strain", "nominal strain")
    frames = [frame for frame in summary["frames"] if frame["modes"]]
    if len(frames) > 1:
        cards.append(Card.captioned("timeline-waves", partial(draw_waves, frames)))
    return Section.of("timeline", cards)


def _gauge_cards(summary: Summary, states: Sequence[PhotographState]) -> list[Card]:
    """Readings of gauges; their places, if the last photograph shown has a whole displacement."""
    rows, placed = summary.get("gauges", ()), None
    read = {row["image"] for row in rows}
    # Strains of photographs are positive in compression, those of gauges in tension.
    strains = {f["name"]: -f["strain_x"] for f in summary["frames"] if f["name"] in read}
    if rows and states and (whole := states[-1].frame.whole):
        image, gauges = states[-1].frame.image, states[-1].harvest.case.gauges
        placed = partial(draw_gauges_on, whole.measured, gauges, image / image.max(), "mm")
    return gauge_cards(rows, strains, placed, axis_text(summary.get("angle_deg", 0.0)))


def number_cards(summary: Summary, shown: Sequence[Frame], names: Mapping[str, str]) -> list[Card]:
    """Table of all photographs; tables of the whole displacement and modes of those ``shown``."""
    return [
        *Card.tabular(ReportTable.of("frames", map(_frame_numbers, summary["frames"])), wide=True),
        *whole_cards([(names[f["name"]], f["whole_field"]) for f in shown if f.get("whole_field")]),
        *_amplitude_cards(shown, names),
        *mode_cards(shown, names),
        *_wave_cards(shown, names),
        *_contour_cards(shown, names),
    ]


def _frame_numbers(frame: Frame) -> dict[str, Cell]:
    """A photograph's row in the table of all photographs."""
    modes, errors, local = frame["modes"], frame["errors_px"], frame["local"] or {}
    noise, model = ((errors[cause] or {}).get("fluctuation") for cause in ("noise", "model_error"))
    return {
        **frame,
        "strain_x": number(100 * frame["strain_x"], 4),
        "strain_y": number(100 * frame["strain_y"], 4),
        "pattern": number(max((m["amplitude_px"] for m in modes), default=None), 3),
        "largest": number(max((m["largest_px"] for m in modes), default=None), 3),
        "noise": number(noise, 2),
        "model": number(model, 2),
        "model_error_px": number(frame["model_error_px"], 2),
        "local": number(local.get("w_rms_px"), 2),
        "residual_rms": number(frame["residual_rms"], 3),
        "chi_square": number(frame["chi_square"], 3),
        "outcome": Mark(frame["outcome"], frame["outcome"] == "converged"),
    }


def _amplitude_cards(frames: Sequence[Frame], names: Mapping[str, str]) -> list[Card]:
    rows = [
        {"photograph": names[frame["name"]], "mode": indexed(f"φ{i}"),
         "state": "not " * (not mode["observable"]) + "observable" + ", fixed" * mode["fixed"],
         "largest": number(mode["largest_px"], 3),
         "v": f"{_micro(mode['v_max_mm'], 4)} {_two_errors(mode)}"}
        for frame in frames for i, mode in enumerate(frame["modes"], start=1)
    ]  # fmt: skip
    return Card.tabular(ReportTable.of("amplitudes", rows), wide=True)


def mode_cards(frames: Sequence[Frame], names: Mapping[str, str]) -> list[Card]:
    """Tables of each mode's parameters in all these photographs, with both standard errors."""
    cards = []
    for i in range(max((len(frame["modes"]) for frame in frames), default=0)):
        of = [frame for frame in frames if i < len(frame["modes"])]
        free = [frame for frame in of if not frame["modes"][i]["fixed"]]
        fixed = [names[frame["name"]] for frame in of if frame["modes"][i]["fixed"]]
        found = [{p["name"]: p for p in frame["modes"][i]["parameters"]} for frame in free]
        units = {name: p["unit"] for column in found for name, p in column.items()}
        rows = [(indexed(name), unit.replace("-", "–"), *(_measured(c.get(name)) for c in found))
                for name, unit in units.items()]  # fmt: skip
        columns = ("", "unit", *(names[frame["name"]] for frame in free))
        anchor = "mode" if i == 0 else f"mode-{i + 1}"
        table = ReportTable(indexed(f"Parameters of φ{i + 1}"), columns, rows, anchor)
        families = dict.fromkeys(frame["modes"][i]["family"] for frame in free)
        caption = "± standard error by noise ± by model error." + (
            f" Fixed: {'; '.join(fixed)}." if fixed else "")  # fmt: skip
        cards += Card.tabular(table, caption=caption, paper="; ".join(families),
                              wide=len(free) > 1)  # fmt: skip
    return cards


def _measured(parameter: Mapping[str, Any] | None) -> Measured | None:
    if parameter is None:
        return None
    return Measured(parameter["value"], _known(parameter["sd_noise"], parameter["sd_model_error"]))


def _known(*errors: float | None) -> tuple[float, ...]:
    return tuple(error for error in errors if error is not None)


def _wave_cards(frames: Sequence[Frame], names: Mapping[str, str]) -> list[Card]:
    """Table of the wave vectors of all modes in these photographs, with both standard errors."""
    rows: list[dict[str, Cell]] = []
    for frame in frames:
        for i, mode in enumerate(frame["modes"], start=1):
            for w, wave in enumerate(mode["waves"], start=1):
                noise, model = wave["sd_noise"] or [None] * 2, wave["sd_model_error"] or [None] * 2
                remark = ", fixed" * mode["fixed"] or ", not observable" * (not mode["observable"])
                xi1, xi2 = (Measured(wave["xi"][c], _known(noise[c], model[c])) for c in (0, 1))
                rows.append({"photograph": names[frame["name"]] if i == w == 1 else "", "xi1": xi1,
                             "xi2": xi2, "wave": indexed(f"φ{i}: {w}") + remark})  # fmt: skip
    words = text_of("photographs-waves")
    return Card.tabular(ReportTable.of("waves", rows), caption=words, wide=True)


def _contour_cards(frames: Sequence[Frame], names: Mapping[str, str]) -> list[Card]:
    """Table of modes by speckle and by contours; differences in standard deviations."""
    rows: list[dict[str, Cell]] = [
        {**row, "photograph": names[frame["name"]] if k == 0 else "",
         "what": indexed(f"{row['what']} of φ{row['mode']}"),
         "speckle": Measured(row["speckle"], (row["speckle_sd"],)),
         "contours": Measured(row["contours"], (row["contours_sd"],)),
         "difference": number(row["difference_sd"], 2)}
        for frame in frames if frame.get("contours")
        for k, row in enumerate(frame["contours"]["compared"])
    ]  # fmt: skip
    words = text_of("contours-beside")
    return Card.tabular(ReportTable.of("contours-beside", rows), caption=words, wide=True)


def notes(summary: Summary) -> list[str]:
    """Notes on the conditions and limits of the numbers, made from the data."""
    text = []
    for frame in summary["frames"]:
        at = f"{frame['name']}, {percent(frame['strain'])}:"
        if frame["outcome"] != "converged":
            text.append(f"{at} {outcome_text(frame)}")
        text += [f"{at} {frame['residual_test']}", f"{at} {_full_stop(frame['weighting'])}"]
    noise, by = summary["noise"], "photographs"
    if summary["frames"][-1]["shown"] == "contours":
        by = "contours"
    share = "" if noise["of_full_scale"] is None else (
        f", {100 * noise['of_full_scale']:.2g} % of full scale")  # fmt: skip
    text += [
        f"Camera noise: {noise['sd']:.3g} grey levels{share}, {noise['source']}.",
        *map(text_of, (f"{by}-errors", "photographs-w", "photographs-rms")),
    ]
    return text


def _full_stop(text: str) -> str:
    return text if text.endswith(".") else f"{text}."
