"""Grades on the star as files: ``report.html``, ``resolution.json``, ``resolution.csv``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from modeharvest.files import atomic, write_json
from modeharvest.validation.page import render
from modeharvest.validation.report import Picture
from modeharvest.validation.resolution.grading import StarGrade
from modeharvest.validation.resolution.plots_star import (
    COLOURS,
    draw_attenuation,
    draw_centre_row,
    draw_map,
    draw_trade_off,
)
from modeharvest.validation.resolution.star_set import StarSet
from modeharvest.validation.style import to_svg

FORMAT = "modeharvest-resolution-1"
TEMPLATE = "star.html"
COLUMNS = {
    "l10 [px]": "finest_px",
    "± l10 [px]": "finest_se_px",
    "n [px]": "noise_px",
    "± n [px]": "noise_se_px",
    "n l10 [px²]": "indicator_px2",
    "± n l10 [px²]": "indicator_se_px2",
    "l10, centre row [px]": "challenge_px",
    "ripple [%]": "ripple_percent",
    "left at the longest [%]": "left_percent",
    "points": "points",
    "returned [%]": "returned_percent",
}
"""Heading of a number in tables: its key in ``resolution.json``."""


@dataclass(frozen=True, eq=False)
class StarGrading:
    """Codes graded on a star set, the best first; and why others were not."""

    star_set: StarSet
    grades: tuple[StarGrade, ...]
    refused: Mapping[str, str] = field(default_factory=dict)

    @property
    def notes(self) -> list[str]:
        """What a reader has to know, in sentences."""
        told = [f"not graded: {why}" for why in self.refused.values()]
        return [*told, *(note for grade in self.grades for note in grade.notes)]


def numbers(grade: StarGrade) -> dict[str, Any]:
    """A code's grade as plain values, units in the names; None where not known."""
    found, noise = grade.attenuation, grade.noise
    row: dict[str, Any] = {
        "name": grade.name,
        "finest_px": found.finest_px,
        "finest_se_px": found.finest_se_px,
        "safe_px": found.safe_px,
        "challenge_px": found.challenge_px,
        "noise_px": np.nan if noise is None else noise.v_px,
        "noise_se_px": np.nan if noise is None else noise.v_se_px,
        "indicator_px2": grade.indicator_px2,
        "indicator_se_px2": grade.indicator_se_px2,
        "ripple_percent": 100.0 * found.ripple,
        "left_percent": 100.0 * found.at(float(found.period[-1])),
        "points": grade.moved.x.size,
        "returned_percent": 100.0 * grade.moved.valid_share,
        "shortest_px": float(found.period[0]),
        "longest_px": float(found.period[-1]),
    }
    return {key: _plain(value) for key, value in row.items()}


def write_star_grading(folder: Path | str, grading: StarGrading) -> None:
    """Write the three files, each whole or not at all."""
    folder = Path(folder)
    write_json(folder / "resolution.json", summary(grading))
    with atomic(folder / "resolution.csv") as part:
        part.write_text("\n".join(_lines(grading.grades)) + "\n", "utf-8")
    with atomic(folder / "report.html") as part:
        part.write_text(page(grading), "utf-8")


def summary(grading: StarGrading) -> dict[str, Any]:
    """The content of ``resolution.json``: codes, the best first, and their curves."""
    codes = []
    for grade in grading.grades:
        found = grade.attenuation
        share, error = found.curve
        curve = {"period_px": found.period, "left": share, "standard_error": error}
        codes.append({
            **numbers(grade),
            "noise": None if grade.noise is None else asdict(grade.noise),
            "curve": {k: [_plain(float(v)) for v in values] for k, values in curve.items()},
        })  # fmt: skip
    star_set = grading.star_set
    return {"format": FORMAT, "benchmark": star_set.id, "spec": star_set.info["spec"],
            "codes": codes, "remarks": grading.notes}  # fmt: skip


def _lines(grades: Sequence[StarGrade]) -> Iterator[str]:
    """The table as CSV."""
    yield ",".join(["name", *COLUMNS])
    for grade in grades:
        row = numbers(grade)
        values = [row[key] for key in COLUMNS.values()]
        cells = ["" if v is None else f"{v:.6g}" for v in values]
        yield ",".join([f'"{grade.name}"', *cells])


def _plain(value: Any) -> Any:
    """NaN as None, which JSON knows."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def page(grading: StarGrading) -> str:
    """The report, HTML."""
    grades = grading.grades
    curves = [_picture("attenuation", "What is left of a wave", draw_attenuation(grades))]
    if any(np.isfinite(g.indicator_px2) and g.indicator_px2 > 0.0 for g in grades):
        curves.append(_picture("trade-off", "Noise against resolution", draw_trade_off(grades)))
    return render(
        TEMPLATE,
        title="How fine a displacement is resolved",
        grading=grading,
        star=grading.star_set.spec.star,
        columns=COLUMNS,
        rows=[numbers(grade) for grade in grades],
        curves=curves,
        codes=[_code(grade, n) for n, grade in enumerate(grades)],
    )


def _code(grade: StarGrade, n: int) -> dict[str, Any]:
    """A code's row and maps."""
    colour = COLOURS[n % len(COLOURS)]
    down = np.where(grade.moved.good, -grade.moved.u[:, 1], np.nan)
    maps = {
        "row": ("Along the centre row", draw_centre_row(grade.attenuation, colour)),
        "v": ("v, down", draw_map(grade, down, 1.2 * grade.star.amplitude_px)),
        "error": ("Its error, down", draw_map(grade, -grade.error_px[:, 1])),
    }
    pictures = [_picture(f"{key}-{n}", *drawn) for key, drawn in maps.items()]
    return {"name": grade.name, "pictures": pictures}


def _picture(name: str, label: str, drawn: Figure) -> Picture:
    return Picture(name, label, to_svg(drawn, name, label))
