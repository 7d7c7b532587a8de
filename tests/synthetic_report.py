"""A validation made up in memory, small, without images on disk: for the report's tests."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from manufactured import DOMAIN, UNIT_CELL, one_mode
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.result import Result
from modeharvest.idic.solver.gauss_newton import Iteration, Outcome
from modeharvest.idic.spectra.pattern import WavePattern, read_pattern
from modeharvest.idic.spectra.spectrum import Spectrum, spectral_density
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet
from modeharvest.report.experiment import ExperimentData
from modeharvest.runs.case import Case
from modeharvest.validation.truth import Comparison

GRID = PixelGrid.centred(130, 110, 0.05)
MASK: NDArray[np.bool_] = (np.abs(GRID.y)[:, None] <= DOMAIN.y_max) & (
    np.abs(GRID.x)[None, :] <= DOMAIN.x_max
)


@dataclass(frozen=True, eq=False)
class MadeUpImages(ImageSet):
    """Noise for every image; only what the report asks for."""

    @property
    def grid(self) -> PixelGrid:
        """The grid of everything here."""
        return GRID

    def deformed(self, strain: float, *, camera: bool = False) -> NDArray[np.float32]:
        """White noise."""
        return np.asarray(np.random.default_rng(0).random(GRID.shape), dtype=np.float32)

    def mask(self) -> NDArray[np.bool_]:
        """The plate's material."""
        return MASK

    def deformed_mask(self, strain: float) -> NDArray[np.bool_]:
        """The reference's."""
        return MASK


def plate(cells: int = 6) -> Mesh:
    """The domain in Q4 elements with one of them left out: a square hole."""
    t = np.linspace(-1.0, 1.0, cells + 1)
    X, Y = np.meshgrid(DOMAIN.x_max * t, DOMAIN.y_max * t)
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    quads = np.stack([first, first + 1, first + cells + 2, first + cells + 1], axis=1)
    quads = np.delete(quads, (cells // 2) * cells + cells // 2, axis=0)
    return Mesh(np.stack([X.ravel(), Y.ravel()], axis=1), quads, "Q4")


def result(ansatz: Ansatz, amplitude: float) -> Result:
    """A pattern of that amplitude [mm, times max phi = 0.04], found on two levels."""
    a = ansatz.initial_guess(0.05, amplitude)
    steps = ((8, 1, 3.0), (8, 2, 0.1), (1, 1, 0.2), (1, 2, 1e-4))
    history = tuple(Iteration(f, n, 0.01, s, 0.0, 1000) for f, n, s in steps)
    return Result(ansatz, GRID, a, 1e-6 * np.eye(ansatz.size), 0.05, int(MASK.sum()), 0,
                  Outcome.CONVERGED, 1e3, history)  # fmt: skip


def comparison(strain: float, amplitude: float, ansatz: Ansatz | None = None) -> Comparison:
    """Truth = measurement and a fast wave; the best fit is a little off the measurement."""
    found = result(ansatz or one_mode(), amplitude)
    best = replace(found, unknowns=found.unknowns + 1e-4)
    x, y = np.meshgrid(GRID.x, GRID.y)
    fast = 0.01 * np.stack([np.sin(9 * x), np.cos(9 * y)], axis=-1)
    truth = np.where(MASK[..., None], found.displacement() + fast, np.nan)
    residual = np.where(MASK, 0.1 * np.sin(40 * x * y), np.nan)
    return Comparison(strain, GRID, MASK, truth, found, best, residual)


def spectrum(one: Comparison) -> tuple[Spectrum, WavePattern]:
    """What the truth's spectral densities say."""
    made = spectral_density(np.nan_to_num(one.displacement), GRID, MASK, UNIT_CELL)
    return made, read_pattern(made)


CRITICAL_STRAIN = 0.06
CRITICAL: dict[str, Any] = {
    "strain": CRITICAL_STRAIN,
    "eigenvalues_N_per_mm4": [[0.055, 0.001], [0.06, 0.0], [0.07, -0.01]],
}
PATH: dict[str, Any] = {
    "primary": {
        "nominal_strain": [0.0, 0.05, 0.1],
        "reaction_N_per_mm": [0.0, 0.5, 1.0],
        "energy_N": [0.0, 0.1, 0.4],
        "negative_pivots": [0, 0, 1],
        "lowest_eigenvalues_N_per_mm4": [[0.02, 0.03], [0.01, 0.02, 0.03], [-0.02]],
    },
    "buckled+": {
        "nominal_strain": [0.1],
        "reaction_N_per_mm": [0.8],
        "energy_N": [0.35],
        "negative_pivots": [0],
        "lowest_eigenvalues_N_per_mm4": [[0.005, 0.01]],
    },
}


def solution(strains: tuple[float, ...], info: dict[str, Any] | None = None) -> Solution:
    """A plate that is not deformed."""
    mesh = plate()
    still = np.zeros_like(mesh.nodes)
    shots = tuple(Snapshot(e, still, negative_pivots=0, branch=_branch(e)) for e in strains)
    return Solution(mesh, shots, {"critical": CRITICAL, "path": PATH} if info is None else info)


def data(strains: tuple[float, ...] = (0.05, 0.1), ansatz: Ansatz | None = None) -> ExperimentData:
    """Everything that the pictures show."""
    found = [comparison(e, 4.0 if _branch(e) != "primary" else 0.1, ansatz) for e in strains]
    images = MadeUpImages(Path(), {})
    results, spectra = [c.result for c in found], [spectrum(c) for c in found]
    return ExperimentData(solution(strains), images, strains, results, found, spectra, UNIT_CELL)


def case() -> dict[str, Any]:
    """The default case with this unit cell."""
    plain = Case().plain()
    plain["experiment"]["specimen"]["pitch"] = UNIT_CELL
    return plain


def summary(of: ExperimentData, critical: float | None = 0.06) -> dict[str, Any]:
    """What ``summary.json`` would hold, numbers made up."""
    return {
        "title": "Made up <for tests>",
        "case": case(),
        "critical_strain": critical,
        "energy_below_unstable": [],
        "snapshots": [_snapshot(c, pattern) for c, (_, pattern)
                      in zip(of.comparisons, of.spectra, strict=True)],
        "inverse_map_max_residual_px": 1e-12,
        "factorisations": 12,
        "simulation_outcome": "complete",
        "versions": {"modeharvest": "0"},
        "expected": [
            {"quantity": "critical strain", "unit": "%", "expected": "6", "obtained": 6.0,
             "ok": True, "source": "made up"},
            {"quantity": "best fit", "unit": "px", "expected": "at most 1", "obtained": 1.5,
             "ok": False, "source": "made up"},
        ],
    }  # fmt: skip


def _snapshot(one: Comparison, pattern: WavePattern) -> dict[str, Any]:
    has_mode = bool(one.result.ansatz.modes)
    mode = [float(v) for v in one.result.mode_parameters()] if has_mode else []
    stats = {"rms_per_component": 0.1, "median_length": 0.1, "max_length": 0.5}
    return {
        "nominal_strain": one.strain,
        "branch": _branch(one.strain),
        "negative_pivots": 0,
        "pattern_amplitude_px": 3.0,
        "pattern_inner_px": 1.0,
        "pattern_corners_px": 2.0,
        "rms_w_px": 0.3,
        "rms_best_fit_px": 0.25,
        "rms_idic_to_best_fit_px": 0.05,
        "rms_residual": 0.05,
        "mode": mode,
        "mode_standard_error": [None, *[1e-3] * 6] if mode else [],
        "mode_deviation_percent": [0.5] * len(mode),
        "mode_best_fit": mode,
        "iterations": 2,
        "iterations_all_levels": 4,
        "outcome": "converged",
        "outcome_why": one.result.outcome.explanation,
        "condition_number": float("inf"),
        "undetermined": [],
        "pixels": one.result.pixels,
        "details_px": {name: stats for name in ("w", "best_fit", "idic_to_best_fit")},
        "pattern_reading": list(pattern.text),
    }


def _branch(strain: float) -> str:
    return "primary" if strain < CRITICAL_STRAIN else "buckled+"
