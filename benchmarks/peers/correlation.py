"""IDIC compared with pyxel-dic: same images, pixels, initial guess and step at which to stop.

pyxel's basis is linear, so the mode's parameters are given to it, and to modeharvest in rows "mode
given". In rows "mode free" modeharvest finds them, which is its usual task.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import pyxel_side
from laps import in_turn, use_threads
from numpy.typing import NDArray
from pairs import ImagePair, inside_the_ansatz, paper

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import correlate, fit_displacement
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions

FloatArray = NDArray[np.float64]

FREE, GIVEN = "modeharvest, mode free", "modeharvest, mode given"
WAYS = {
    "dense": "pyxel, basis per pixel (dense)",
    "sparse": "pyxel, basis per pixel (sparse)",
    "elements": "pyxel, elements and reduced basis",
}
QUANTISATION = 1.0 / np.sqrt(12.0)


def rows(quick: bool) -> dict[str, dict[str, Any]]:
    """Names of the rows, and the options of :func:`measure` for each."""
    inside = {"kind": "inside", "shape": (520, 416) if quick else (1040, 832), "seed": 1}
    of_paper = {"kind": "paper", "shape": None if quick else (2207, 2751),
                "pixel_size": 0.03 if quick else 0.01}  # fmt: skip
    return {
        "correlation-inside-1": {**inside, "laps": 1, "threads": 1},
        "correlation-inside-2": {**inside, "laps": 1 if quick else 2, "threads": 2},
        "correlation-paper-2": {**of_paper, "laps": 1, "threads": 2},
        "correlation-patterns": {
            "shape": (520, 416) if quick else (1040, 832),
            "seeds": 3 if quick else 8,
            "threads": 2,
        },
        "correlation-many-patterns": {
            "shape": (624, 500),
            "seeds": 3 if quick else 24,
            "threads": 2,
        },
    }


def measure(options: dict[str, Any]) -> dict[str, Any]:
    """Measure one row, or a block of rows."""
    use_threads(options["threads"])
    if "seeds" in options:
        return _patterns(options)
    if options["kind"] == "inside":
        pair, name = inside_the_ansatz(options["shape"], options["seed"]), "inside the ansatz"
    else:
        pair, name = paper(options["shape"], options["pixel_size"]), "paper's specimen"
    ways = _Ways(pair)
    own = {FREE: ways.free, GIVEN: ways.mode_given}
    peers = {label: ways.pyxel(way) for way, label in WAYS.items()}
    found: dict[str, Any] = {}
    for label, lap in in_turn(own | peers, options["laps"], warm_up=own).items():
        best = ways.best_free if label == FREE else ways.best
        found[label] = ways.assessed(lap.result, best) | {"first_s": lap.first_s}
        if label in own:
            found[label] |= {"seconds": lap.median_s, "setup_s": 0.0}
    return {
        "images": name,
        "shape": pair.grid.shape,
        "pixels": int(ways.pixels.sum()),
        "threads": options["threads"],
        "rms_displacement_px": pair.error_px(np.zeros_like(pair.truth)),
        "found": found,
    }


class _Ways:
    """All ways to correlate a pair."""

    def __init__(self, pair: ImagePair) -> None:
        self.pair = pair
        self.edge_px = 0 if pair.deformed_mask is None else 2
        self.best = self._best(*pair.fixed())
        self.best_free = self._best(pair.ansatz, pair.start)
        self.pixels = pair.pixels(self.best, self.edge_px)
        self.seconds: dict[str, list[float]] = {}

    def _best(self, ansatz: Ansatz, start: FloatArray) -> FloatArray:
        """Displacement of the best fit of an ansatz to the truth [mm]."""
        pair = self.pair
        return fit_displacement(pair.truth, pair.grid, ansatz, start, pair.mask).displacement()

    def free(self) -> Result:
        """Correlate with modeharvest, all 77 unknowns."""
        return self._ours(self.pair.ansatz, self.pair.start)

    def mode_given(self) -> Result:
        """Correlate with modeharvest, with the unknowns that pyxel has."""
        return self._ours(*self.pair.fixed())

    def _ours(self, ansatz: Ansatz, start: FloatArray) -> Result:
        options = CorrelationOptions(edge_px=self.edge_px)
        return correlate(self.pair.images, ansatz, guess=start, options=options)

    def pyxel(self, way: str) -> Callable[[], pyxel_side.Found]:
        """A correlation with pyxel, in one of three ways."""

        def run() -> pyxel_side.Found:
            found = pyxel_side.correlate(self.pair, way, self.pixels)
            self.seconds.setdefault(way, []).append(found.seconds)
            return found

        return run

    def assessed(self, found: Any, best: FloatArray) -> dict[str, Any]:
        """Numbers of a result for the table."""
        if isinstance(found, Result):
            displacement = found.displacement()
            assessed: dict[str, Any] = {
                "unknowns": int(np.isfinite(np.diag(found.inverse)).sum()),
                "iterations": [sum(h.factor == k for h in found.history) for k in (8, 4, 2, 1)],
                "outcome": found.outcome.value,
            }
        else:
            displacement = found.displacement
            full = max(found.iterations) >= pyxel_side.MAX_ITERATIONS
            assessed = {
                "unknowns": self.pair.ansatz.phi_offset(0),
                "iterations": list(found.iterations),
                "outcome": "max_iterations" if full else "converged",
                "seconds": statistics.median(self.seconds[found.way]),
                "setup_s": found.setup_s,
            }
        assessed["error_px"] = self.pair.error_px(displacement)
        assessed["from_best_px"] = self.pair.error_px(displacement, best)
        return assessed


def _patterns(options: dict[str, Any]) -> dict[str, Any]:
    """Errors over several speckle patterns, and those that quantisation alone predicts."""
    found: dict[str, list[dict[str, Any]]] = {FREE: [], GIVEN: [], WAYS["dense"]: []}
    for seed in range(options["seeds"]):
        pair = inside_the_ansatz(options["shape"], 100 + seed)
        ways = _Ways(pair)
        for name, way in zip(found, (ways.free, ways.mode_given, ways.pyxel("dense")), strict=True):
            result = way()
            one = ways.assessed(result, pair.truth)
            if isinstance(result, Result):
                one["predicted_px"] = _predicted_px(pair, result)
            found[name].append(one)
    return {
        "shape": pair.grid.shape,
        "pixels": int(pair.mask.sum()),
        "patterns": options["seeds"],
        "found": {name: _together(each) for name, each in found.items()},
        "ratios": _ratios(found[GIVEN], found[WAYS["dense"]]),
    }


def _ratios(ours: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> dict[str, float]:
    """Our error over theirs, pattern by pattern: worst, mean and the mean's standard error."""
    each = [a["error_px"] / b["error_px"] for a, b in zip(ours, theirs, strict=True)]
    scatter = float(np.std(each, ddof=1) / np.sqrt(len(each)))
    return {"worst": max(each), "mean": float(np.mean(each)), "standard_error": scatter}


def _together(each: list[dict[str, Any]]) -> dict[str, Any]:
    """Rms over the runs that converged, and how many did."""
    converged = [one for one in each if one["outcome"] == "converged"]
    together: dict[str, Any] = {"converged": len(converged)}
    for key in ("error_px", "predicted_px"):
        values = [one[key] for one in converged if key in one]
        together[key] = float(np.sqrt(np.mean(np.square(values)))) if values else None
    return together


def _predicted_px(pair: ImagePair, result: Result) -> float:
    """Rms length that the covariance predicts for quantisation noise in both images [px]."""
    n = np.isfinite(np.diag(result.inverse))
    x, y = pair.grid.x[None, ::8], pair.grid.y[::8, None]
    S = result.ansatz.sensitivities(result.unknowns, x, y)[pair.mask[::8, ::8]][..., n]
    A = np.einsum("pcn,pcm->nm", S, S) / len(S) / pair.grid.pixel_size**2
    return float(np.sqrt(np.trace(result.covariance(QUANTISATION)[np.ix_(n, n)] @ A)))


def table(found: dict[str, dict[str, Any]]) -> list[str]:
    """Lines of Markdown."""
    lines = [
        "| images | | threads | unknowns | iterations, coarse to fine | basis made [s] |"
        " start to convergence [s] | this ÷ ours, mode given | from truth [px rms] |"
        " from best fit [px rms] |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in found.values():
        if "images" not in row:
            continue
        ours = row["found"][GIVEN]["seconds"]
        for name, one in row["found"].items():
            iterations = " ".join(str(n) for n in one["iterations"])
            if one["outcome"] != "converged":
                iterations += f" ({one['outcome']})"
            lines.append(
                f"| {row['images']}, {row['shape'][0]} × {row['shape'][1]}, "
                f"{row['pixels'] / 1e6:.2f} Mpx counted | {name} | {row['threads']} "
                f"| {one['unknowns']} | {iterations} | {one['setup_s']:.1f} "
                f"| {one['seconds']:.1f} | {one['seconds'] / ours:.1f} "
                f"| {one['error_px']:.3g} | {one['from_best_px']:.3g} |"
            )
    for name in ("correlation-patterns", "correlation-many-patterns"):
        lines += _pattern_lines(found.get(name))
    return lines


def _pattern_lines(row: dict[str, Any] | None) -> list[str]:
    if row is None:
        return []
    lines = [
        "",
        f"Over {row['patterns']} speckle patterns of {row['shape'][0]} × {row['shape'][1]} px, 8 "
        "bits, displacement inside the ansatz:",
        "",
        "| | converged | error [px rms] | that quantisation predicts [px rms] | ratio |",
        "|---|---|---|---|---|",
    ]
    for name, one in row["found"].items():
        # Programs with the same unknowns have the same bound.
        bound = one["predicted_px"] or row["found"][GIVEN]["predicted_px"]
        if one["error_px"] is None:
            lines.append(f"| {name} | 0 | – | – | – |")
            continue
        lines.append(
            f"| {name} | {one['converged']} | {one['error_px']:.3g} | {bound:.3g} "
            f"| {one['error_px'] / bound:.2f} |"
        )
    ratios = row["ratios"]
    return [
        *lines,
        "",
        f"modeharvest (mode given) ÷ pyxel, pattern by pattern: {ratios['mean']:.4f} "
        f"± {ratios['standard_error']:.4f} (mean and its standard error), {ratios['worst']:.3f} on "
        "the worst.",
    ]
