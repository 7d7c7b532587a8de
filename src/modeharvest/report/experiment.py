"""Report of a virtual experiment: the panels of the paper's figures for each snapshot, tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from modeharvest.fem.field import Solution
from modeharvest.idic.finite_element.result import WholeField
from modeharvest.idic.result import Result
from modeharvest.idic.spectra.pattern import REFERENCE_MODE, WavePattern
from modeharvest.idic.spectra.spectrum import Spectrum
from modeharvest.imaging.imageset import ImageSet
from modeharvest.imaging.sensor import Sensor
from modeharvest.report.explore import KnownFields, explored_fits
from modeharvest.report.figures import fits
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.curves import draw_eigenvalues, draw_load
from modeharvest.report.figures.maps import ColourScale, MapFrame, draw_field, draw_image
from modeharvest.report.figures.whole_field import WholeMaps, whole_panel_numbers
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
    material_text,
    number,
    percent,
    text_of,
    typeset,
)
from modeharvest.util.typed import headings
from modeharvest.validation.summary import SnapshotSummary
from modeharvest.validation.truth import Comparison, lengths, pattern_field
from modeharvest.validation.whole_field import WholeFieldSummary

Snapshot = Mapping[str, Any]
Summary = Mapping[str, Any]

_MODE = tuple(zip([f"a{i}" for i in "₁₂₃₄₅₆₇"], ("-",) * 5 + ("mm",) * 2, strict=True))


@dataclass(frozen=True, eq=False)
class ExperimentData:
    """Data of the figures of a virtual experiment; snapshots are in order of ascending strain."""

    solution: Solution
    images: ImageSet
    strains: Sequence[float]
    """Nominal strain of each snapshot [-]."""
    results: Sequence[Result]
    comparisons: Sequence[Comparison]
    """Comparison of each result with the truth; access may wait until it has been computed."""
    spectra: Sequence[tuple[Spectrum, WavePattern]]
    """Spectral densities of each, and the pattern found in them; access may wait, too."""
    pitch: float
    """Unit cell size l [mm]."""
    wholes: Sequence[tuple[WholeField, WholeFieldSummary]] = ()
    """Whole displacement of each and its errors, if measured; access may wait, too."""

    @cached_property
    def states(self) -> list[SnapshotState]:
        """The states to draw, one for each snapshot."""
        boundary, images = MeshBoundary.of(self.solution.mesh), self.images
        view = fits.SpecimenView(boundary, images.grid, images.mask(), self.pitch)
        return [
            SnapshotState(f"{round(1e4 * strain):04d}", self._label(strain), view, result,
                          partial(self._densities, k), self, k)
            for k, (strain, result) in enumerate(zip(self.strains, self.results, strict=True))
        ]  # fmt: skip

    @property
    def modes(self) -> int:
        """Number of modes that all snapshots have."""
        return min(len(result.ansatz.modes) for result in self.results)

    def _label(self, strain: float) -> str:
        critical = self.solution.info.get("critical")
        at = None if critical is None else critical["strain"]
        return snapshot_label(strain, self.solution.at(strain).branch, at)

    @cached_property
    def _density_end(self) -> float:
        return fits.largest_density(self.spectra)

    def _densities(self, k: int) -> tuple[Spectrum, WavePattern, float]:
        return (*self.spectra[k], self._density_end)


@dataclass(frozen=True, eq=False)
class SnapshotState(fits.FittedState):
    """Snapshot number ``k`` (from 0) of ``data``."""

    data: ExperimentData
    k: int

    @property
    def comparison(self) -> Comparison:
        """Comparison of the snapshot with the truth."""
        return self.data.comparisons[self.k]


def snapshot_label(strain: float, branch: str, critical: float | None) -> str:
    """A snapshot's name on the page. Strains [-]; ``critical`` is None if there is none."""
    if branch != "primary":
        state = "After buckling"
    elif critical is None:
        state = "Deformed"
    else:
        state = "Before buckling" if strain < critical else "Unstable path"
    return f"{state} · {100 * strain:.4g} %"


def draw_hero(state: SnapshotState) -> Figure:
    """Blend of the deformed image, from left to right, with the measured pattern (no modes: w)."""
    images, strain = state.data.images, state.data.strains[state.k]
    map_frame = state.view.map_frame()
    if fits.has_mode(0)(state):
        size = fits.UM * lengths(pattern_field(state.result, map_frame.grid))
    else:
        size = map_frame.average(fits.UM * lengths(state.comparison.w))
    return fits.draw_dissolving(state, images.deformed(strain), images.deformed_mask(strain), size)


def _image(state: SnapshotState) -> Figure:
    images, strain = state.data.images, state.data.strains[state.k]
    return draw_image(
        state.view.map_frame(), images.deformed(strain), images.deformed_mask(strain), images.grid,
        state.data.solution.at(strain).displacement,
    )  # fmt: skip


def _residual(state: SnapshotState) -> Figure:
    map_frame = state.view.map_frame(fits.FINE)
    residual = map_frame.sample(state.comparison.residual.astype(np.float64))
    scale = ColourScale.signed(residual, "full scale", 0.99)
    return draw_field(map_frame, residual, scale, state.motion)


def _length_of(name: str) -> Callable[[SnapshotState], Figure]:
    """A function that draws the length of one of the comparison's vector fields."""

    def draw(state: SnapshotState) -> Figure:
        length = lengths(getattr(state.comparison, name))
        return fits.draw_length(state, state.view.map_frame().average(length))

    return draw


_WHOLE_MAPS: WholeMaps[SnapshotState] = WholeMaps(
    lambda state: state.data.wholes[state.k][0], lambda state: state.comparison.displacement,
    lambda state: len(state.data.wholes) > 0,
)  # fmt: skip


def snapshot_panels(modes: int) -> list[fits.Panel[SnapshotState]]:
    """All quantities that are drawn for a snapshot; ``modes``: number of modes of the ansatz."""
    spectra, fields = ("4", "5") if modes <= 1 else ("", "")  # the paper has one mode
    return [
        fits.Panel("images", "image", _image, figure=spectra),
        *fits.spectrum_panels("images", spectra, "snapshots", fits.always),
        *fits.ansatz_panels("found", fields, modes),
        fits.Panel("errors", "residual", _residual, figure=fields, exact=True, late=True),
        fits.Panel("errors", "w", _length_of("w"), figure=fields, late=True),
        fits.Panel("errors", "best", _length_of("best_error"), late=True),
        fits.Panel("errors", "loss", _length_of("idic_to_best"), late=True),
        *_WHOLE_MAPS.panels(fields, "whole-w"),
    ]


def experiment_report(summary: Summary, data: ExperimentData | None = None) -> Report:
    """The report of a virtual experiment.

    ``summary``: the content of ``summary.json``. ``data``: the data of the figures; if None, the
    report has no figures, as for the terminal.
    """
    case = summary.get("case", {})
    imperfection = case.get("experiment", {}).get("imperfection")
    seeds = [f"speckle {case['imaging']['speckle']['seed']}"] if "imaging" in case else []
    seeds += [f"imperfection {imperfection['seed']}"] if imperfection else []
    material = case.get("experiment", {}).get("material")
    residual = number(summary["inverse_map_max_residual_px"])
    states, snapshots = data.states if data is not None else [], summary["snapshots"]
    brief = [(percent(s["nominal_strain"]), s) for s in snapshots]
    steps = [fits.convergence_card(s, snapshots[s.k]["outcome_why"]) for s in states]
    return Report(
        kind="virtual experiment",
        title=summary.get("title") or "Validation",
        findings=[
            critical_line(summary.get("critical_strain"), material),
            *_expected(summary.get("expected", [])),
            *(
                text_of("experiment-energy", **row)
                for row in summary.get("energy_below_unstable", [])
            ),
        ],
        keys=key_numbers(summary),
        brief=ReportTable.of_states("brief", brief),
        sections=[
            Section.of("expected", expected_cards("expected", summary.get("expected", []))),
            *([] if data is None else _figures(data, summary)),
            Section.of("numbers", number_cards(summary)),
            Section.of("solver", steps),
        ],
        warnings=summary.get("warnings", []),
        notes=notes(summary),
        case=case,
        costs={
            "factorisations of the whole path": number(summary.get("factorisations")),
            "largest residual of the inverse mapping": f"{residual} px",
        },
        versions=summary.get("versions", {}),
        hero=_hero(data) if data is not None else None,
        explore=None if data is None else partial(explored_fits, states, _known),
        hero_caption=text_of("experiment-hero", state=states[-1].label if states else ""),
        **caption("page-experiment", seeds=", ".join(seeds)),
    )


def _known(state: SnapshotState) -> KnownFields:
    c, wholes = state.comparison, state.data.wholes
    whole = wholes[state.k][0].measured if wholes else None
    return KnownFields(c.displacement, c.best, whole, partial(MapFrame.sample, field=c.residual))


def critical_line(strain: float | None, material: Mapping[str, Any] | None) -> str:
    """Sentence on the critical strain [-] (None: no bifurcation) and, if given, the material."""
    text = text_of("experiment-no-bifurcation")
    if strain is not None:
        text = f"Critical strain {100 * strain:.4f} %"
    return f"{text}; {material_text(material)}." if material else f"{text}."


def _expected(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    missed = [text_of("experiment-missed-value", **row) for row in rows if row["ok"] is False]
    if missed:
        return [f"Missed {len(missed)} of {len(rows)} expected values: {'; '.join(missed)}."]
    return [f"All {len(rows)} expected values are met."] if rows else []


def key_numbers(summary: Summary) -> list[KeyNumber]:
    """The key numbers at the top of the page, of the last snapshot."""
    last = summary["snapshots"][-1]
    at = f"at {percent(last['nominal_strain'])}"
    critical = summary.get("critical_strain")
    expected, whole = summary.get("expected", []), last.get("whole_field")
    met = f"{sum(bool(row['ok']) for row in expected)} of {len(expected)}"

    def key(name: str, value: float | None, digits: int = 3) -> KeyNumber:
        known = None if value is None or value != value else f"{value:.{digits}g}"
        return KeyNumber.of(name, known, symbol=_symbol(last), at=at)

    return [
        key("not-critical", None) if critical is None else key("critical", 100 * critical, 4),
        key("pattern", last["pattern_amplitude_px"]),
        _mode_key(last, at),
        key("best-fit", last["rms_best_fit_px"]),
        key("loss", last["rms_idic_to_best_fit_px"], 2),
        *([key("whole", whole["rms_px"], 2)] if whole else []),
        KeyNumber.of("expected", met) if expected else key("not-expected", None),
    ]


def _mode_key(last: Snapshot, at: str) -> KeyNumber:
    """Deviation of the mode from the ideal one; for several modes, the number observable."""
    if "modes" in last:
        observable = [mode["observable"] for mode in last["modes"]]
        return KeyNumber.of("modes", f"{sum(observable)} of {len(observable)}", at=at)
    if not _is_free(last):
        return KeyNumber.of("fixed-mode", None)
    return KeyNumber.of("mode", f"{_largest_deviation(last):.2g}", at=at)


def _symbol(snapshot: Snapshot) -> str:
    """Symbol of the pattern, for one mode or for several."""
    return "Σ vᵢφᵢ" if "modes" in snapshot else "v₁φ₁"


def expected_cards(name: str, rows: Sequence[Mapping[str, Any]]) -> list[Card]:
    """The table ``name`` of obtained and expected values, and whether each is met; or no card."""
    marks = {True: Mark("✓ met", True), False: Mark("✗ missed", False), None: None}
    records = [{**row, "unit": row["unit"].replace("-", "–"), "ok": marks[row["ok"]],
                **{key: typeset(str(row[key])) for key in ("quantity", "expected")}}
               for row in rows]  # fmt: skip
    return Card.tabular(ReportTable.of(name, records), wide=True)


def number_cards(summary: Summary) -> list[Card]:
    """Tables of all snapshots; rows without a value in any snapshot are left out."""
    snapshots, critical = summary["snapshots"], summary.get("critical_strain")
    heads = headings(SnapshotSummary, WholeFieldSummary)
    heads = {k: head.replace("v₁φ₁", _symbol(snapshots[0])) for k, head in heads.items()}
    states = [
        (snapshot_label(s["nominal_strain"], s["branch"], critical), s | s.get("whole_field", {}))
        for s in snapshots
    ]
    table = ReportTable.of_states("results", states, heads)
    return [*Card.tabular(table, wide=True), *_mode_cards(summary)]


def _mode_cards(summary: Summary) -> list[Card]:
    """Table of the modes' parameters with both standard errors, beside those of the best fit."""
    found = [(percent(s["nominal_strain"]), modes)
             for s in summary["snapshots"] if (modes := _modes_of(s))]  # fmt: skip
    several = bool(found) and len(found[0][1]) > 1
    columns, rows = ["", "ideal"], []
    for strain, _ in found:
        columns += [f"{strain}: IDIC ± noise ± model error", f"{strain}: best fit"]
    for i, mode in enumerate(found[0][1] if found else ()):
        for k, (name, unit) in enumerate(zip(mode["names"], mode["units"], strict=True)):
            text = f"φ{i + 1} {name}" if several else name
            row: list[Cell] = [f"{text} [{unit}]" if unit != "-" else text, mode["ideal"][k]]
            rows.append(row + [cell for _, modes in found for cell in _parameter(modes[i], k)])
    table = ReportTable("Parameters of the modes", columns, rows, name="mode")
    words = text_of("experiment-modes" if several else "experiment-mode")
    return Card.tabular(table, caption=words, wide=True)


def _modes_of(snapshot: Snapshot) -> Sequence[Mapping[str, Any]]:
    """The modes with their parameters, in the same form for one mode and for several."""
    if "modes" in snapshot:
        return list(snapshot["modes"])
    if len(snapshot.get("mode", ())) != len(_MODE):
        return []
    names, units = zip(*_MODE, strict=True)
    keys = ("standard_error", "model_error", "best_fit")
    return [{
        "names": names, "units": units, "found": snapshot["mode"],
        "ideal": snapshot.get("mode_ideal", REFERENCE_MODE),
        **{key: snapshot.get(f"mode_{key}") for key in keys},
    }]  # fmt: skip


def _parameter(mode: Mapping[str, Any], k: int) -> list[Cell]:
    """Parameter k (from 0) with its standard errors, and its value in the best fit."""
    noise, model, best = (mode[key][k] if mode[key] else None
                          for key in ("standard_error", "model_error", "best_fit"))  # fmt: skip
    errors = float("inf") if noise is None else noise, model
    return [Measured(mode["found"][k], errors), None if best is None else Measured(best)]


def experiment_figures(data: ExperimentData) -> list[ReportFigure]:
    """The figures of :func:`experiment_report`, to be drawn before the summary is available."""
    cards = [
        *_path_cards(data.solution),
        *(fits.convergence_card(state) for state in data.states),
        *(p.card(data.states, lambda key, state: "") for p in snapshot_panels(data.modes)),
    ]
    return [_hero(data), *(figure for card in cards for figure in card.figures)]


def _hero(data: ExperimentData) -> ReportFigure:
    drawn = partial(draw_hero, data.states[-1])
    return ReportFigure("hero", "Image and pattern", drawn, late=not data.modes)


def _figures(data: ExperimentData, summary: Summary) -> list[Section]:
    snapshots: Sequence[Snapshot] = summary["snapshots"]
    several = data.modes > 1
    images, *others = fits.panel_sections(
        ("images", "found", "errors", "whole"), snapshot_panels(data.modes), data.states,
        lambda key, state: panel_numbers(key, snapshots[state.k]) or fits.shape_numbers(key, state),
        pattern=Markup("Σ v<sub>i</sub>φ<sub>i</sub>" if several else "v<sub>1</sub>φ<sub>1</sub>"),
        of_spectra="" if several else "Fig. 4 of the paper. ",
        known="",
        source="" if several else "Fig. 5 of the paper. ",
    )  # fmt: skip
    text = {s.label: snapshots[s.k].get("pattern_reading", ()) for s in data.states}
    reading = Card("Reading of the densities", text=text, name="reading")
    images = replace(images, cards=[*images.cards[:2], reading, *images.cards[2:]])
    return [Section.of("path", _path_cards(data.solution)), images, *others]


def panel_numbers(key: str, snapshot: Snapshot) -> str:
    """Line of numbers below the picture of a panel; empty if there is nothing to add."""
    if key == "residual":
        return f"rms {snapshot['rms_residual']:.3g} of full scale"
    if key.startswith("whole-"):
        return whole_panel_numbers(key, snapshot["whole_field"])
    part = {"w": "w", "best": "best_fit", "loss": "idic_to_best_fit"}.get(key, "")
    details = snapshot.get("details_px", {}).get(part)
    return "" if details is None else text_of("experiment-lengths", **details)


def _path_cards(solution: Solution) -> list[Card]:
    """Load path and eigenvalues, if the solution has them."""
    path, critical = solution.info.get("path"), solution.info.get("critical")
    if not path or not path.get("primary", {}).get("nominal_strain"):
        return []
    load = partial(draw_load, path, None if critical is None else critical["strain"])
    eigenvalues = partial(draw_eigenvalues, path, critical)
    return [Card.captioned("load", load), Card.captioned("eigenvalues", eigenvalues)]


def notes(summary: Summary) -> list[str]:
    """Notes on the conditions and limits of the numbers, made from the data."""
    expected, outcome = summary.get("expected"), summary.get("simulation_outcome") or "complete"
    return [
        *([] if expected else [text_of("experiment-not-expected")]),
        *([] if outcome == "complete" else [f"The simulation is {outcome}."]),
        *(text for snapshot in summary["snapshots"] for text in _about(snapshot)),
        _standard_errors(summary),
        text_of("experiment-weights"),
        text_of("experiment-rms"),
        *([text_of("experiment-material")] if expected else []),
    ]


def _standard_errors(summary: Summary) -> str:
    """Text on the meaning of the standard errors for these images."""
    noise = [s["noise_sd"] for s in summary["snapshots"] if s.get("noise_sd") is not None]
    sensor = Sensor(**summary.get("case", {}).get("imaging", {}).get("sensor", {}))
    text = text_of("experiment-noise-free")
    if noise:
        text = text_of("experiment-exposures", noise=max(noise))
    elif sensor.noise_model(bits=16) != Sensor().noise_model(bits=16):
        text = text_of("experiment-averages")
    return text_of("experiment-errors", text=text)


def _about(snapshot: Snapshot) -> list[str]:
    """Notes on one snapshot."""
    at = f"At {100 * snapshot['nominal_strain']:.4g} %"
    text = []
    if snapshot.get("negative_pivots"):
        text.append(text_of("experiment-unstable", at=at, pivots=snapshot["negative_pivots"]))
    if snapshot["outcome"] != "converged":
        text.append(f"{at} {outcome_text(snapshot)}")
    if snapshot.get("undetermined"):
        text.append(f"{at} the images do not determine {', '.join(snapshot['undetermined'])}.")
    text += [f"{at} {warning}." for warning in snapshot.get("identifiability_warnings", ())]
    if "residual_verdict" in snapshot:
        text.append(f"{at} {_lower(snapshot['residual_verdict'])}")
    if snapshot.get("noise_sd") and "weighting" in snapshot:  # a choice made because of the noise
        text.append(f"{at} {_lower(snapshot['weighting'])}")
    inner, corners = snapshot.get("pattern_inner_px"), snapshot.get("pattern_corners_px")
    if inner is not None and corners is not None and inner < corners:
        kind = "several" if "modes" in snapshot else "free" if _is_free(snapshot) else "fixed"
        describes = text_of(f"experiment-{kind}", deviation=_largest_deviation(snapshot))
        text.append(text_of("experiment-no-pattern", at=at, symbol=_symbol(snapshot), inner=inner,
                            corners=corners, describes=describes))  # fmt: skip
    return text


def outcome_text(state: Mapping[str, Any]) -> str:
    """The outcome of a snapshot's or a photograph's correlation, and the reason."""
    return f"the correlation ended as “{state['outcome']}”: {state['outcome_why']}"


def _lower(text: str) -> str:
    return f"{text[0].lower()}{text[1:]}"


def _is_free(snapshot: Snapshot) -> bool:
    """Whether the mode's parameters were unknowns of the correlation."""
    return bool(snapshot.get("mode_deviation_percent"))


def _largest_deviation(snapshot: Snapshot) -> float:
    """Largest deviation of a mode parameter from its ideal value [%]; NaN if none is known."""
    return max((abs(v) for v in snapshot.get("mode_deviation_percent", ())), default=float("nan"))
