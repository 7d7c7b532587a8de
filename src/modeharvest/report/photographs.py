"""``report.html`` of photographs: one page like the paper's Figs. "spect_real" and "real"."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from modeharvest.report.figures.curves import draw_convergence, draw_onset, draw_waves
from modeharvest.report.figures.photograph_panels import (
    PHOTOGRAPH_SECTIONS,
    PhotographPanel,
    draw_distortion,
    draw_distortion_error,
    draw_distortion_sd,
    draw_reference,
    photograph_panels,
)
from modeharvest.report.figures.photographs import (
    DRAWN_SHAPE,
    PhotographReportData,
    draw_hero,
    mode_scale,
)
from modeharvest.report.figures.style import to_svg
from modeharvest.report.model import Picture, render, short
from modeharvest.runs.photographs.results import Harvest, HarvestedFrame
from modeharvest.runs.photographs.summary import harvest_summary
from modeharvest.util.files import atomic
from modeharvest.util.progress import Progress, silent

Summary = Mapping[str, Any]
Frame = Mapping[str, Any]

NBSP = "\N{NO-BREAK SPACE}"
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def percent(value: float | None, digits: int = 4) -> str:
    """A strain in percent, with its sign."""
    if value is None:
        return "–"
    return f"{100 * value:.{digits}g}{NBSP}%".replace("-", "−")


def state(frame: Frame) -> str:
    """Whether a photograph shows the pattern."""
    has = frame["has_pattern"]
    return "Deformed" if has is None else "After buckling" if has else "Before buckling"


def photograph_label(frame: Frame) -> str:
    """How a photograph is called above its pictures."""
    return f"{state(frame)} · {percent(frame['strain'])}"


def photograph_labels(frames: Sequence[Frame]) -> dict[str, str]:
    """Each photograph's label by its name, which is added where labels would be the same."""
    said = {frame["name"]: photograph_label(frame) for frame in frames}
    often = Counter(said.values())
    return {name: text if often[text] == 1 else f"{text} · {name}" for name, text in said.items()}


def key_numbers(summary: Summary) -> list[dict[str, str]]:
    """The few numbers at the top: what they are called, the number, its unit, a remark."""
    last = summary["frames"][-1]
    keys = [_photographs(summary), _buckling(summary)]
    if last["modes"]:
        keys += _mode_keys(last)
    keys.append(_model_error_key(last))
    if summary["truth"]:
        rows = summary["truth"]
        met = sum(row["ok"] for row in rows)
        keys[0] = _key("as near to the truth as asked", f"{met} of {len(rows)}", "", "table below")
    return keys


def _photographs(summary: Summary) -> dict[str, str]:
    used, left = len(summary["frames"]), len(summary["skipped"])
    remark = f"{left} of them left out, see below" if left else "all of them"
    return _key("photographs used", f"{used} of {used + left}", "", remark)


def _buckling(summary: Summary) -> dict[str, str]:
    found = summary["buckling"]
    if found is None or found["after"] is None:
        return _key("buckling", "–", "", "no pattern that stands out")
    if found["before"] is None:
        return _key("buckling", f"< {100 * found['after']:.4g}", "%", "all show the pattern")
    span = f"{100 * found['before']:.4g} … {100 * found['after']:.4g}"
    remark = "the pattern appears between these strains"
    if found["estimate"] is not None:
        remark = f"its growth points back to {percent(found['estimate'])}"
    return _key("buckling", span, "%", remark)


def _mode_keys(frame: Frame) -> list[dict[str, str]]:
    mode, at = frame["modes"][0], f"at {percent(frame['strain'])}"
    wave = mode["waves"][0]
    xi = ", ".join(f"{value:.3f}".replace("-", "−") for value in wave["xi"])
    errors = [f"± {_micro(mode['v_max_sd_noise_mm'])} µm by noise"]
    if mode["v_max_sd_model_error_mm"] is not None:
        errors.append(f"± {_micro(mode['v_max_sd_model_error_mm'])} by what is left over")
    count = len(mode["waves"])
    sd = "fixed" if mode["fixed"] else f"± {_digits(max(_wave_sd(wave)), 1)}"
    return [
        _key("pattern", _digits(mode["largest_px"], 3), "px", f"largest v₁φ₁ {at}"),
        _key("largest v₁", _micro(mode["v_max_mm"], 4), "µm", ", ".join(errors)),
        _key("wave vector ξ", f"({xi})", "1/l", f"{sd}; the first of {count}"),
    ]


def _wave_sd(wave: Mapping[str, Any]) -> list[float]:
    known = [*(wave["sd_noise"] or []), *(wave["sd_model_error"] or [])]
    return [value for value in known if value is not None] or [float("nan")]


def _model_error_key(frame: Frame) -> dict[str, str]:
    local = frame["local"]
    if local is not None and local["w_beyond_noise_px"] is not None:
        remark = f"rms of local DIC − IDIC beyond the local DIC’s {local['sd_px']:.2g} px"
        return _key("left over, w", _digits(local["w_beyond_noise_px"], 2), "px", remark)
    remark = "rms, estimated from the residual"
    return _key("left over, w", _digits(frame["model_error_px"], 2), "px", remark)


def panel_numbers(key: str, frame: Frame) -> str:
    """One line of numbers under a picture; empty if there is nothing to add."""
    local, left = frame["local"], frame["errors_px"]["model_error"]
    if key == "image":
        return f"{frame['name']}; compression {percent(frame['strain_x'])} along x, " + (
            f"{percent(frame['strain_y'])} along y"
        )
    if key == "residual":
        return _residual(frame)
    if key == "w" and local is not None:
        said = f"rms {local['w_rms_px']:.3g} px per component at {local['points']} points"
        if local["sd_px"] is not None:
            said += f", of which the local DIC’s own error {local['sd_px']:.2g} px"
        return said + (f"; {local['lost']} points lost" if local["lost"] else "")
    if key.startswith("v") and key[1:].isdigit() and key != "v0":
        return _amplitude(frame["modes"][int(key[1:]) - 1], key[1:])
    field, _, cause = key.partition("-")
    errors = frame["errors_px"]["noise"] if cause == "noise" else left if cause else None
    if errors is None or field not in ("v0", "fluc1") or len(frame["modes"]) > 1:
        return ""
    name = {"v0": "v0", "fluc1": "fluctuation"}[field]
    return "" if errors[name] is None else f"rms {_digits(errors[name], 2)} px per component"


def _residual(frame: Frame) -> str:
    share, chi = frame["residual_of_full_scale"], frame["chi_square"]
    said = f"rms {short(frame['residual_rms'])} grey levels"
    if share is not None:
        said += f", {100 * share:.2g}{NBSP}% of full scale"
    return said + ("" if chi is None else f"; χ² {chi:.3g}")


def _amplitude(mode: Mapping[str, Any], n: str) -> str:
    sd = [f"{_micro(mode['v_max_sd_noise_mm'])} by noise"]
    if mode["v_max_sd_model_error_mm"] is not None:
        sd.append(f"± {_micro(mode['v_max_sd_model_error_mm'])} by what is left over")
    subscript = n.translate(_SUBSCRIPTS)
    said = f"largest among the holes {_micro(mode['v_max_mm'], 4)} ± {' '.join(sd)} µm"
    return said if mode["observable"] else f"{said}; too weak for φ{subscript} to mean anything"


FRAME_COLUMNS = (
    ("photograph", ""), ("strain x", "%"), ("strain y", "%"), ("pattern, rms", "px"),
    ("largest", "px"), ("sd of it: noise", "px"), ("… leftover", "px"),
    ("w, estimated", "px"), ("w, local DIC", "px"), ("residual", "levels"),
    ("χ²", "–"), ("iterations", ""), ("outcome", ""),
)  # fmt: skip
"""Heads of the table of all photographs, and their units."""


def frame_rows(summary: Summary) -> list[dict[str, Any]]:
    """A row of that table for each photograph: its name, its cells, and how it ended."""
    rows = []
    for frame in summary["frames"]:
        modes, errors, local = frame["modes"], frame["errors_px"], frame["local"]
        rows.append({
            "name": frame["name"],
            "cells": [
                _digits(100 * frame["strain_x"], 4), _digits(100 * frame["strain_y"], 4),
                _digits(max((m["amplitude_px"] for m in modes), default=None), 3),
                _digits(max((m["largest_px"] for m in modes), default=None), 3),
                *(_digits((errors[cause] or {}).get("fluctuation"), 2)
                  for cause in ("noise", "model_error")),
                _digits(frame["model_error_px"], 2),
                _digits(None if local is None else local["w_rms_px"], 2),
                _digits(frame["residual_rms"], 3), _digits(frame["chi_square"], 3),
                f"{frame['iterations']} of {frame['iterations_all_levels']}",
            ],
            "outcome": frame["outcome"],
        })  # fmt: skip
    return rows


def mode_tables(frames: Sequence[Frame]) -> list[dict[str, Any]]:
    """For each mode its parameters in each of these frames, with both standard errors."""
    tables = []
    for i in range(max((len(frame["modes"]) for frame in frames), default=0)):
        of = [frame for frame in frames if i < len(frame["modes"])]
        free = [frame for frame in of if not frame["modes"][i]["fixed"]]
        found = [{p["name"]: p for p in frame["modes"][i]["parameters"]} for frame in free]
        units = {name: p["unit"] for column in found for name, p in column.items()}
        tables.append({
            "number": i + 1,
            "families": list(dict.fromkeys(frame["modes"][i]["family"] for frame in free)),
            "frames": free,
            "fixed": [frame for frame in of if frame["modes"][i]["fixed"]],
            "rows": [{"name": name, "unit": unit, "cells": [c.get(name) for c in found]}
                     for name, unit in units.items()],
        })  # fmt: skip
    return tables


def wave_rows(frames: Sequence[Frame]) -> list[dict[str, Any]]:
    """Wave vectors of all modes in these frames, with both standard errors."""
    rows = []
    for frame in frames:
        for i, mode in enumerate(frame["modes"], start=1):
            for w, wave in enumerate(mode["waves"], start=1):
                noise, left = wave["sd_noise"] or [None] * 2, wave["sd_model_error"] or [None] * 2
                rows.append({
                    "frame": frame, "mode": i, "wave": w, "first": i == w == 1,
                    "fixed": mode["fixed"], "observable": mode["observable"],
                    "cells": list(zip(wave["xi"], noise, left, strict=True)),
                })  # fmt: skip
    return rows


def error_text(noise: float | None, leftover: float | None) -> str:
    """Both standard errors behind a value of five decimals: "± 0.00020 ± 0.00310"."""
    known = [value for value in (noise, leftover) if value is not None]
    return " ".join(f"± {value:.5f}" if value >= 5e-6 else "< 0.00001" for value in known)


def notes(summary: Summary) -> list[str]:
    """What a reader should know before trusting the numbers."""
    said = []
    for frame in summary["frames"]:
        at = f"{frame['name']}, {percent(frame['strain'])}:"
        if frame["outcome"] != "converged":
            ended = f"the correlation ended as “{frame['outcome']}”: {frame['outcome_why']}"
            said.append(f"{at} {ended}")
        said += [f"{at} {_sentence(warning)}" for warning in frame["warnings"]]
        said += [f"{at} {frame['residual_test']}", f"{at} {_sentence(frame['weighting'])}"]
    noise = summary["noise"]
    share = "" if noise["of_full_scale"] is None else (
        f", {100 * noise['of_full_scale']:.2g} % of full scale")  # fmt: skip
    said += [
        f"Camera noise: {noise['sd']:.3g} grey levels{share}, {noise['source']}.",
        "Two standard errors are given apart. The first is what the photographs’ noise does, the "
        "Cramér–Rao bound. The second is what the part of the displacement that the ansatz can’t "
        "describe does to the unknowns, estimated from the residual with one block for each cell; "
        "it includes the noise, and takes cells for independent.",
        "Neither of them is the difference between the measured field and the true displacement: "
        "that is w, shown as what is left over.",
        "rms is per component: the root of the mean square over both components.",
    ]
    return said


def _sentence(text: str) -> str:
    return text if text.endswith(".") else f"{text}."


def _micro(millimetres: float | None, digits: int = 2) -> str:
    """Micrometres; two digits do for errors."""
    return "∞" if millimetres is None else _digits(1e3 * millimetres, digits)


def _digits(value: float | None, digits: int) -> str:
    return "–" if value is None else short(float(f"{value:.{digits}g}"))


def _key(name: str, value: str, unit: str, remark: str) -> dict[str, str]:
    return {"name": name, "value": value, "unit": unit, "remark": remark}


PHOTOGRAPHS_TEMPLATE = "photographs.html"
WORDS = {
    "FRAME_COLUMNS": FRAME_COLUMNS,
    "frame_rows": frame_rows,
    "mode_tables": mode_tables,
    "error_text": error_text,
    "wave_rows": wave_rows,
    "percent": percent,
    "key_numbers": key_numbers,
    "notes": notes,
    "label": photograph_label,
}
"""What the template calls by name."""


def write_harvest_report(
    path: Path | str,
    harvest: Harvest,
    summary: Mapping[str, Any] | None = None,
    progress: Progress = silent,
) -> None:
    """Write the report of a harvest, atomically.

    Parameters
    ----------
    path
        The HTML file.
    harvest
        What it shows.
    summary
        Its :func:`~modeharvest.runs.photographs.summary.harvest_summary`, if it is there.
    progress
        Listener.
    """
    told = harvest_summary(harvest) if summary is None else summary
    atlas = PhotographReportData(harvest)
    by_name = {frame["name"]: frame for frame in told["frames"]}
    shown = [by_name[frame.name] for frame in atlas.shown]
    labels = photograph_labels(shown)
    page = render(
        PHOTOGRAPHS_TEMPLATE,
        title=harvest.title,
        harvest=harvest,
        summary=told,
        words=WORDS,
        shown=shown,
        labels=labels,
        hero=to_svg(draw_hero(atlas), "hero", "The last photograph and its pattern"),
        reference=_photograph_picture("reference", "The reference", draw_reference(atlas)),
        optics=_optics(harvest),
        sections=_sections(atlas, by_name, labels, progress),
        curves=_curves(harvest, told),
        convergence=[
            _photograph_picture(
                f"convergence-{k}", labels[frame.name], draw_convergence(frame.result)
            )
            for k, frame in enumerate(atlas.shown, start=1)
        ],
    )
    with atomic(path) as temporary:
        temporary.write_text(page, "utf-8")
    progress(1, 1, "report")


def _photograph_picture(
    name: str, label: str, drawn: Figure, fact: str = "", exact: bool = False
) -> Picture:
    return Picture(name, label, to_svg(drawn, name, label, exact=exact), fact)


def _sections(
    atlas: PhotographReportData,
    frames: Mapping[str, Mapping[str, Any]],
    labels: Mapping[str, str],
    progress: Progress,
) -> list[dict[str, Any]]:
    """The groups of panels, each panel with a picture for every photograph that has it."""
    every = photograph_panels(atlas)
    cards: dict[str, list[dict[str, Any]]] = {anchor: [] for anchor, _ in PHOTOGRAPH_SECTIONS}
    for n, panel in enumerate(every):
        progress(n, len(every), "report")
        pictures = [
            _photograph_picture(f"{panel.key}-{k}", labels[frame.name], panel.draw(atlas, frame),
                     _panel_caption(panel, atlas, frame, frames[frame.name]), panel.exact)
            for k, frame in enumerate(atlas.shown, start=1) if panel.shows(atlas, frame)
        ]  # fmt: skip
        cards[panel.section].append({"panel": panel, "pictures": pictures})
    return [{"id": anchor, "title": title, "cards": cards[anchor]}
            for anchor, title in PHOTOGRAPH_SECTIONS if cards[anchor]]  # fmt: skip


def _panel_caption(
    panel: PhotographPanel,
    atlas: PhotographReportData,
    frame: HarvestedFrame,
    told: Mapping[str, Any],
) -> str:
    if panel.key.startswith("phi"):
        i = int(panel.key.removeprefix("phi"))
        scale = mode_scale(atlas, frame, i - 1)
        return f"drawn as with {scale:.3g} mm for v everywhere: at most {DRAWN_SHAPE} l"
    return panel_numbers(panel.key, told)


def _optics(harvest: Harvest) -> list[Picture]:
    """Distortion, its standard deviation and its error, as far as they are known."""
    lens, grid = harvest.lens, harvest.grid
    if lens is None:
        return []
    pictures = [_photograph_picture("distortion", "Distortion S", draw_distortion(lens, grid))]
    if harvest.calibration is not None:
        drawn = draw_distortion_sd(harvest.calibration, grid)
        pictures.append(_photograph_picture("distortion-sd", "Standard deviation of S", drawn))
    if harvest.truth is not None and harvest.truth.distortion is not None:
        drawn = draw_distortion_error(lens, harvest.truth.distortion, grid)
        pictures.append(
            _photograph_picture("distortion-error", "S − truth, affine part aside", drawn)
        )
    return pictures


def _curves(harvest: Harvest, summary: Mapping[str, Any]) -> list[Picture]:
    """The test from photograph to photograph, where there is more than one."""
    curves = []
    if harvest.timeline:
        drawn = draw_onset(harvest.timeline, harvest.buckling)
        curves.append(_photograph_picture("timeline-pattern", "The pattern’s amplitude", drawn))
    frames = [frame for frame in summary["frames"] if frame["modes"]]
    if len(frames) > 1:
        curves.append(_photograph_picture("timeline-waves", "Its wave vectors", draw_waves(frames)))
    return curves
