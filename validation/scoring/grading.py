"""Scores of several fields of one image: their comparison, ``scores.json`` and ``scores.csv``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.util.arrays import BoolArray
from modeharvest.util.typed import to_plain
from modeharvest.validation.scoring.benchmark import BenchmarkTruth
from modeharvest.validation.scoring.score import (
    ENOUGH_COVERED,
    PERCENTILES,
    ErrorSpectrum,
    RegionScore,
    Score,
)

SCORES_FORMAT = "modeharvest-scores-1"

EVERYWHERE, COMMON = "everywhere", "where all measure"


@dataclass(frozen=True, eq=False)
class Grading:
    """Graded fields of one deformed image."""

    truth: BenchmarkTruth
    strain: float
    """Of the image [-]."""
    edge_px: int
    """Width of the region of edges [px]."""
    labels: NDArray[np.int8]
    """(rows, cols) of :func:`~modeharvest.validation.scoring.score.regions`."""
    scores: tuple[Score, ...]
    """The best first."""
    spectra: Mapping[str, ErrorSpectrum | None]
    """Of each field's error, by its name."""
    remarks: tuple[str, ...] = ()
    """Probable errors in what was declared."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Why a field was not graded, by its file's name."""

    @cached_property
    def _covered(self) -> BoolArray:
        """(rows, cols) True where all fields cover the material."""
        return np.asarray(np.logical_and.reduce([graded.near for graded in self.scores]))

    @cached_property
    def common(self) -> dict[str, RegionScore]:
        """By name, the error over the material that all fields cover."""
        grid = self.truth.grid
        return {graded.source: graded.over(self._covered, grid) for graded in self.scores}

    @property
    def common_share(self) -> float:
        """Share of the material that all fields cover [-]."""
        return float(self._covered.sum() / (self.labels >= 0).sum())

    def parts(self, graded: Score) -> dict[str, RegionScore]:
        """A field's rows of the table: everywhere, where all measure, by region."""
        common = {COMMON: self.common[graded.source]} if len(self.scores) > 1 else {}
        return {EVERYWHERE: graded.everywhere, **common, **graded.by_region}

    @property
    def notes(self) -> list[str]:
        """What a reader has to know."""
        return [
            *(f"not graded: {why}" for why in self.refused.values()),
            *self.remarks,
            *(f"{graded.source} covers {100 * graded.covered:.0f} % of the material, less than "
              f"{100 * ENOUGH_COVERED:.0f} %, and is ranked after those that cover more"
              for graded in self.scores if graded.covered < ENOUGH_COVERED),
        ]  # fmt: skip


def grading_summary(grading: Grading) -> dict[str, Any]:
    """The grades as plain values: for each field, the best first, all that is known of it."""
    fields = [
        {"name": graded.source, "points_off_material": graded.off_material,
         "spacing_px": graded.spacing_px, "covered": graded.covered, **grading.parts(graded),
         "spectrum": grading.spectra.get(graded.source)}
        for graded in grading.scores
    ]  # fmt: skip
    content = {
        "format": SCORES_FORMAT,
        "benchmark": grading.truth.id,
        "nominal_strain": grading.strain,
        "edge_px": grading.edge_px,
        "percentiles": PERCENTILES,
        "covered_by_all": grading.common_share,
        "fields": fields,
        "refused": grading.refused,
        "remarks": grading.notes,
    }
    return dict(to_plain(content))


def csv_lines(grading: Grading) -> Iterator[str]:
    """The table as CSV: a line for each field and region."""
    percentiles = ",".join(f"p{p} [px]" for p in PERCENTILES)
    yield ("field,region,points,returned [-],covered [-],bias x [px],bias y up [px],rms [px],"
           f"{percentiles},max [px]")  # fmt: skip
    for graded in grading.scores:
        for name, part in grading.parts(graded).items():
            covered = f"{graded.covered:.6g}" if name == EVERYWHERE else ""
            values = [*part.bias_px, part.rms_px, *part.percentiles_px, part.max_px]
            numbers = ",".join(f"{v:.6g}" for v in values)
            yield f'"{graded.source}",{name},{part.points},{part.returned:.6g},{covered},{numbers}'
