"""Interactive display of fields on a page: sampling, quantisation and compression of their values.

The page contains arrays of numbers, which ``explore.js`` unpacks, draws and saves. The quantities
offered, and how they are computed from these arrays, are defined in ``explore.toml``.
"""

from __future__ import annotations

import base64
import json
import re
import tomllib
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import resources
from itertools import product
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.result import Result
from modeharvest.imaging.grid import PixelGrid
from modeharvest.report.figures import style
from modeharvest.report.figures.boundaries import MeshBoundary
from modeharvest.report.figures.fits import FittedState, S
from modeharvest.report.figures.maps import MapFrame
from modeharvest.report.figures.whole_field import middle_pixels
from modeharvest.report.model.output import page_template
from modeharvest.util.arrays import BoolArray, FloatArray, IntArray
from modeharvest.util.typed import picked
from modeharvest.validation.scoring.score import Grading, Score
from modeharvest.validation.truth import lengths

MOST_SAMPLES, LENGTH_STEP = 2_700_000, 1e-3
"""Largest count of values on a page, of about a byte each; quantisation step of lengths [px], at
least 1/65535 and at most 1/1000 of an array's range."""
_LEVELS, _COARSE = 65535, 1000  # largest and smallest number of steps in an array's range
_SHARES, _FEW, _STATES = (0.002, 0.998), 8, 40


@dataclass(frozen=True, eq=False)
class ExploredState:
    """Arrays of a deformed state, or of a DIC code's field, on the sampled pixels."""

    name: str
    label: str
    """Last part of the anchors of the state's static figures, and the state's label."""
    arrays: Mapping[str, FloatArray]
    boundary: FloatArray | None = None
    """Arrays (rows, cols) by name, NaN where unknown; displacement (n, 2) of the mesh's nodes, if
    known. It and the arrays ``ux`` and ``uy`` displace the drawn material [mm or px]."""


@dataclass(frozen=True, eq=False)
class Explorer:
    """Fields of several states, sampled at the middle pixels of a map's cells."""

    kind: str
    """Name of the table in ``explore.toml``."""
    frame: MapFrame
    grid: PixelGrid
    """Pixels of the images."""
    states: Sequence[ExploredState]
    unit: str = "mm"
    """Unit of positions and lengths, mm or px."""

    def html(self) -> Markup:
        """HTML of the interactive display, including data and program."""
        content = json.dumps(self.content(), separators=(",", ":"), allow_nan=False)
        safe = Markup(content.replace("<", "\\u003c"))
        return Markup(page_template("explore.html").render(content=safe, explorer=self))

    def content(self) -> dict[str, Any]:
        """All data that ``explore.js`` needs, as plain values."""
        packer, frame, quantities = Packer(), self.frame, _quantities(self.kind, self.states)
        sampled, (rows, cols) = middle_pixels(frame, self.grid), frame.pixels
        steps, small = _tables()["steps"], LENGTH_STEP * self.grid.pixel_size
        drawn = np.concatenate([loop[:, :2].ravel() for loop in frame.boundary.loops])
        states = [
            {
                **picked(s, "name label"),
                "arrays": {n: packer.add(a, steps.get(n, small)) for n, a in s.arrays.items()},
                "boundary": None if s.boundary is None else packer.add(s.boundary[drawn].T, 0.0),
            }
            for s in self.states
        ]
        ends = ([_ends(s, q["terms"]) for s in self.states] for q in quantities)
        colours = {n: getattr(style, n)(np.arange(256), bytes=True) for n in ("SIGNED", "SIZE")}
        return {
            **picked(self, "kind unit"),
            "pixel": self.grid.pixel_size,
            "factor": frame.factor,
            "first": [int(rows[0]), int(cols[0])],
            **{name: getattr(sampled, name) for name in ("rows", "cols", "x0", "y0")},
            "states": states,
            "quantities": [{**q, "ends": e} for q, e in zip(quantities, ends, strict=True)],
            "loops": [len(loop) for loop in frame.boundary.loops],
            "boundary": packer.add(frame.boundary.nodes[drawn].T, 0.0),
            "colours": {n: base64.b64encode(c.tobytes()).decode() for n, c in colours.items()},
            "packed": packer.packed,
            "masks": packer.masks,
        }


class Packer:
    """Encodes arrays as text: 16-bit quantisation, prediction from neighbours, deflate, base64."""

    def __init__(self) -> None:
        self.packed: list[dict[str, Any]] = []
        self.masks: list[str] = []
        self._known: dict[bytes, tuple[int, tuple[IntArray, ...]]] = {}

    def add(self, values: FloatArray, step: float) -> int:
        """Pack an array (rows, cols), NaN where unknown; returns its index in ``packed``."""
        valid = np.isfinite(values)
        mask, nearest = self._mask(valid) if not valid.all() else (-1, None)
        whole = values if nearest is None else values[nearest]
        low, high = (float(end) for end in (whole.min(), whole.max()))
        step = max((high - low) / _LEVELS, min((high - low) / _COARSE, step)) or 1.0
        levels = np.rint((whole - low) / step).astype(np.uint16, order="C")
        self.packed.append({"low": low, "step": step, "mask": mask, **deflated(levels)})
        return len(self.packed) - 1

    def _mask(self, valid: BoolArray) -> tuple[int, tuple[IntArray, ...]]:
        """Index of a mask (rows, cols) in ``masks``, and indices of each pixel's nearest valid."""
        bits = np.packbits(valid, bitorder="little").tobytes()
        if bits not in self._known:
            away = ndimage.distance_transform_edt(~valid, None, False, True)
            self.masks.append(base64.b64encode(zlib.compress(bits, 9)).decode())
            self._known[bits] = len(self.masks) - 1, tuple(away)
        return self._known[bits]


def deflated(levels: NDArray[np.uint16]) -> dict[str, Any]:
    """Deflate an array (rows, cols), all low bytes before all high ones.

    Encodes values, or if shorter, differences from a prediction: left + upper - upper left.
    """
    change = levels.copy()
    change[1:] -= levels[:-1]
    change[:, 1:] -= change[:, :-1].copy()
    signed = change.view(np.int16)
    both = (levels, ((signed << 1) ^ (signed >> 15)).view(np.uint16))
    texts = [zlib.compress(part.view(np.uint8).reshape(-1, 2).T.tobytes(), 4) for part in both]
    predicted = len(texts[1]) < len(texts[0])
    return {"predicted": predicted, "data": base64.b64encode(texts[predicted]).decode()}


@cache
def _tables() -> dict[str, Any]:
    return tomllib.loads(resources.files(__package__).joinpath("explore.toml").read_text("utf-8"))


def _quantities(kind: str, states: Iterable[ExploredState]) -> list[dict[str, Any]]:
    """Entries of ``kind`` whose arrays exist in some state; those with {n} for modes 1 to 9."""
    have, found = sorted({name for state in states for name in state.arrays}), []
    for entry, n in product(_tables()[kind], range(1, 10)):
        text = json.dumps(entry, ensure_ascii=False)
        if n == 1 or "{n}" in text:
            filled = json.loads(text.replace("{n}", str(n)).replace("{i}", chr(0x2080 + n)))
            own, truth = (_terms(filled.get(key, ()), have) for key in ("terms", "truth"))
            found += [{**filled, "terms": own, "truth": truth}] if own else []
    return found


def _terms(sums: Iterable[str], have: Sequence[str]) -> list[dict[str, float]]:
    """Coefficients, by array, of sums like "ux - f*x", * being any mode; [] if one is missing."""
    parts: list[dict[str, float]] = []
    for text in sums:
        parts.append({})
        for sign, pattern in re.findall(r"([+-]?)\s*([\w*]+)", text):
            names = [n for n in have if re.fullmatch(pattern.replace("*", r"\d"), n)]
            if not names:
                return []
            parts[-1] |= dict.fromkeys(names, -1.0 if sign == "-" else 1.0)
    return parts


def _ends(state: ExploredState, terms: Sequence[Mapping[str, float]]) -> list[float] | None:
    """Ends of a quantity's colours (quantiles), its minimum and maximum; None if not known."""
    if not all(name in state.arrays for part in terms for name in part):
        return None
    sums = [np.sum([c * state.arrays[n] for n, c in part.items()], axis=0) for part in terms]
    values = sums[0] if len(sums) == 1 else lengths(np.stack(sums, axis=-1))
    known = values[np.isfinite(values)]
    ends = (*np.quantile(known, _SHARES), known.min(), known.max()) if known.size else ()
    return [float(f"{end:.6g}") for end in ends] or None


def _frame(boundary: MeshBoundary, grid: PixelGrid, values: int, coarser: float) -> MapFrame:
    """Frame for arrays of that many pixels altogether: the finest, or one that much coarser."""
    factor = max(1, int(np.ceil(coarser * np.sqrt(values / MOST_SAMPLES))))
    return MapFrame.of(boundary, grid, max(1, max(grid.shape) // factor))


@dataclass(frozen=True, eq=False)
class KnownFields:
    """Further data of a fitted state: true u (rows, cols, 2) [mm], best fit, whole u, residual."""

    truth: FloatArray | None = None
    best: Result | None = None
    whole: NodalResult | None = None
    residual: Callable[[MapFrame], NDArray[Any]] | None = None


def explored_fits(states: Sequence[S], known_of: Callable[[S], KnownFields], coarser: float) -> str:
    """HTML to explore fits to images of one specimen, with errors if the truth is known."""
    view, modes = states[0].view, max(len(s.result.ansatz.modes) for s in states)
    known = [known_of(s) for s in states]
    arrays = 7 + 3 * modes + 3 * any(k.whole is not None for k in known)
    values = len(states) * arrays * int(view.mask.sum())
    frame = _frame(view.boundary, view.grid, values, coarser)
    material = view.mask[np.ix_(*frame.pixels)]
    made = [
        ExploredState(
            s.name, s.label, split(_fitted(s, k, frame), material), frame.moved_nodes(s.motion)
        )
        for s, k in zip(states, known, strict=True)
    ]
    return Explorer("fits", frame, view.grid, made).html()


def _fitted(state: FittedState, known: KnownFields, frame: MapFrame) -> dict[str, NDArray[Any]]:
    """Arrays of a fitted state, by their names in ``explore.toml``."""
    result, grid = state.result, middle_pixels(frame, state.view.grid)
    u = result.displacement(grid)
    arrays: dict[str, NDArray[Any]] = {"u": u}
    for i, mode in enumerate(result.ansatz.modes):
        taper = mode.taper.along_y(grid.y)[:, None] * mode.taper.along_x(grid.x)[None, :]
        arrays[f"f{i + 1}"] = result.fluctuation(i, grid)
        arrays[f"v{i + 1}"] = np.where(taper > 0.0, result.v(i, grid), np.nan)
    if known.truth is not None:
        arrays["w"] = frame.sample(known.truth) - u
    if known.best is not None:
        arrays["l"] = u - known.best.displacement(grid)
    if known.residual is not None:
        arrays["r"] = known.residual(frame)
    if known.whole is not None:
        arrays["m"] = known.whole.displacement_on(grid) - u
        arrays["sd"] = lengths(known.whole.standard_deviation_on(grid))
    return arrays


def explored_photographs(
    states: Sequence[S], truth_of: Any, residual_of: Any, coarser: float
) -> str:
    """HTML to explore fits to photographs, with errors if these were simulated."""

    def known(state: Any) -> KnownFields:
        true, whole = truth_of(state), state.frame.whole
        u, best = (true.displacement, true.best) if true else (None, None)
        return KnownFields(u, best, whole.measured if whole else None, partial(residual_of, state))

    return explored_fits(states, known, coarser)


def explored_images(
    results: Mapping[str, NodalResult], unit: str, residual: Any, coarser: float
) -> str:
    """HTML to explore images measured on one mesh; with residuals if there are at most _FEW."""
    names = [*results][:: -(1 + len(results) // _STATES)][::-1]  # every n-th, including the last
    one, made = results[names[0]], []
    frame = _frame(MeshBoundary.of(one.mesh), one.grid, 7 * len(names) * one.pixels, coarser)
    grid = middle_pixels(frame, one.grid)
    for n, (name, result) in enumerate((name, results[name]) for name in names):
        strain = result.on_pixels(result.field("logarithmic"), grid)
        arrays = {"exx": strain[..., 0, 0], "eyy": strain[..., 1, 1], "exy": strain[..., 0, 1]}
        if residual and result.shown == "speckle" and len(names) <= _FEW:
            arrays["r"] = frame.sample(residual(name, result))
        sd = lengths(result.standard_deviation_on(grid))
        fields = split({"u": result.displacement_on(grid), "sd": sd, **arrays})
        made.append(ExploredState(str(n + 1), name, fields, result.displacement))
    return Explorer("measure", frame, one.grid, made, unit).html()


def explored_scores(
    grading: Grading, nearest: Callable[[MapFrame, Score], IntArray], coarser: float
) -> str:
    """HTML to explore graded fields; ``nearest``: index of the point shown in each map cell."""
    truth, made = grading.truth, []
    count = 4 * len(grading.scores) * int(truth.mask.sum())
    frame = _frame(MeshBoundary.of(truth.solution.mesh), truth.grid, count, coarser)
    at = replace(frame, grid=middle_pixels(frame, truth.grid))
    for n, graded in enumerate(grading.scores):
        true = truth.displacement(grading.strain, graded.x, graded.y)
        values = np.column_stack([true, truth.grid.pixel_size * graded.error_px])
        cells = np.vstack([values, np.full((1, 4), np.nan)])[nearest(at, graded)]
        fields = split({"t": cells[..., :2], "e": cells[..., 2:]})
        made.append(ExploredState(str(n), graded.source, fields))
    return Explorer("scores", frame, truth.grid, made).html()


def split(arrays: Mapping[str, NDArray[Any]], where: Any = True) -> dict[str, FloatArray]:
    """Split vector fields (rows, cols, 2), "u" into "ux" and "uy"; NaN where ``where`` is False."""
    parts = {name: array for name, array in arrays.items() if array.ndim == 2}
    for name, array in arrays.items():
        if array.ndim == 3:
            parts |= {f"{name}x": array[..., 0], f"{name}y": array[..., 1]}
    masked = {name: np.where(where, array, np.nan) for name, array in parts.items()}
    return {name: array for name, array in masked.items() if np.isfinite(array).any()}
