"""The whole displacement in photographs of a test, from what was correlated: a stage of a harvest.

::

    whole_field/NAME.h5  NAME.vtu    what was measured, on a mesh of the material
    whole_field/NAME_refit.json      the correlation's ansatz, refitted to it
    whole_field/NAME_start.json      where it started from, or why it could not be measured

Each photograph starts from its own correlation. Where that did not find the displacement, it
starts from the images, and from the photograph before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.idic.finite_element.files import Given
from modeharvest.idic.finite_element.measure import FiniteElementOptions
from modeharvest.idic.finite_element.pixels import continued
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.finite_element.system import Body
from modeharvest.idic.photograph.displacement import block_motion, displacement_from, is_misfit
from modeharvest.idic.photograph.measure import MeasuredPhotograph, image_noise
from modeharvest.idic.result import Result
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.idic.uncertainty.identifiability import identifiability
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spline import SplineImage
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.runs.photographs.prepare import PreparedPhotographs
from modeharvest.runs.photographs.results import HarvestedFrame, TruthCheck
from modeharvest.runs.whole_field import WholeFields
from modeharvest.util.arrays import BoolArray
from modeharvest.util.progress import Progress
from modeharvest.util.stages import StagedRun, digest
from modeharvest.util.typed import to_plain
from modeharvest.validation.whole_field import (
    WholeField,
    WholeFieldSummary,
    refitted,
    v_percent,
    waves_percent,
)

_ASTRAY = (Outcome.LOCAL_MINIMUM, Outcome.OUTSIDE_IMAGE, Outcome.SINGULAR)
"""Outcomes of a correlation that is no start."""
_EDGE_PX = 2
"""A camera's pixels on an edge show some background, and taking out distortion mixes it further."""
_REFIT_WAVES, _REFIT_AMPLITUDE = 0.05, 0.5
"""What must come out by the whole displacement [%], both against the best fit."""


@dataclass(frozen=True, kw_only=True)
class PhotographWholeFields(StagedRun[PhotographCase]):
    """Whole displacements of the photographs of a harvest, in its folder."""

    prepared: PreparedPhotographs
    results: Mapping[str, MeasuredPhotograph]
    """Of the correlations, in the order of the test."""
    keys: Mapping[str, str]
    """Of the stages that left them."""

    @property
    def found(self) -> dict[str, WholeField]:
        """Measure every photograph that was correlated; leaves ``whole_field/``.

        One that can't be measured is left out, and its frame has a warning.
        """
        return self._measured[0]

    def added(self, frame: HarvestedFrame) -> HarvestedFrame:
        """A frame with its whole displacement, and warnings of it."""
        found, failed = self._measured
        whole = found.get(frame.name)
        warnings = (failed[frame.name],) if whole is None else whole.measured.warnings
        return replace(frame, whole=whole, warnings=(*frame.warnings, *warnings))

    @cached_property
    def _files(self) -> WholeFields:
        return WholeFields(self.folder / "whole_field")

    @cached_property
    def _how(self) -> FiniteElementOptions:
        return replace(self.case.whole_field.on_mesh(), edge_px=_EDGE_PX)

    @cached_property
    def _body(self) -> Body:
        return self._how.body(self.prepared.mask(), self.prepared.grid)

    @cached_property
    def _measured(self) -> tuple[dict[str, WholeField], dict[str, str]]:
        """Whole displacements, and why some photographs have none."""
        keys, key = {}, digest(to_plain(self.case.whole_field))
        for name in self.results:
            keys[name] = key = digest([key, self.keys[name]])

        def work(
            name: str, last: tuple[str, WholeField] | None
        ) -> tuple[Sequence[Path], dict[str, Any]]:
            correlated = self.results[name].result
            is_usable = correlated.outcome not in _ASTRAY

            def measured(progress: Progress) -> NodalResult:
                pair, body = self._pair(name, last), self._body
                if is_usable:
                    begin = correlated.ansatz.displacement_at(correlated.unknowns, body.mesh.nodes)
                else:
                    known = last and last[1].measured
                    begin = block_motion(pair, body.mesh, known, ("the reference", name))
                found = displacement_from(begin, pair, body, self._how, progress)
                return self._warned(found, name)

            given, refit = Given(correlation=correlated), self._refit(name)
            files = self._files.measure(name, name, measured, self.progress, given)
            refitted(self._files.read(name), correlated, self.prepared.mask()).write(refit)
            text = "the result of its correlation" if is_usable else "blocks of the speckle"
            text += "" if is_usable or last is None else " and the photograph before"
            return (*files, refit), {"start": text}

        def read(name: str, about: dict[str, Any]) -> WholeField:
            measured, refit = self._files.read(name), Result.read(self._refit(name))
            return WholeField(measured, refit, self._files.seconds(name), about["start"])

        folder = self._files.folder
        return self.do_in_turn("whole field", keys, folder, work, read, {"start": ""})

    def _refit(self, name: str) -> Path:
        return self._files.folder / f"{name}_refit.json"

    def _pair(self, name: str, last: tuple[str, WholeField] | None) -> ImagePair:
        """A photograph and its reference, whose brightness is made the photograph's."""
        pair, correlated = self.prepared.pair(name), self.results[name].result
        reference, mask = pair.reference, pair.mask
        if last and self.case.correlation.formulation == "updated":
            reference, inside = self._pulled_back(last[0], last[1].measured)
            mask = self.prepared.mask() & inside
        grid = pair.grid
        gain, offset = correlated.ansatz.gain_and_offset(correlated.unknowns, grid.x, grid.y)
        reference = ((reference - offset) / gain).astype(np.float32)
        return replace(pair, reference=reference, mask=mask)

    def _pulled_back(
        self, name: str, measured: NodalResult
    ) -> tuple[NDArray[np.float32], BoolArray]:
        """A photograph g at x + u, in the reference's brightness, and where that is known."""
        correlated, u = self.results[name].result, measured.displacement_on()
        grid = measured.grid
        rows, cols = np.nonzero(np.isfinite(u[..., 0]))
        moved = u[rows, cols] / grid.pixel_size
        beyond = continued(self.prepared.image(name), self.prepared.mask(name))
        spline = SplineImage.of(beyond, correlated.order)
        image = np.full(grid.shape, np.nan, dtype=np.float32)
        image[rows, cols] = spline.sample(rows - moved[:, 1], cols + moved[:, 0])[0]
        gain, offset = correlated.ansatz.gain_and_offset(correlated.unknowns, grid.x, grid.y)
        inside = np.isfinite(image)
        return np.where(inside, gain * image + offset, 0.0).astype(np.float32), inside

    def _warned(self, measured: NodalResult, name: str) -> NodalResult:
        """With a warning where the images don't match although noise is small."""
        pair = self.prepared.pair(name)
        noise = image_noise(pair, self.prepared.noise)
        expected = float(np.hypot(noise.reference, noise.deformed))
        if not is_misfit(measured, expected, pair.reference[pair.masks[0]]):
            return measured
        text = (
            f"The residual of the whole displacement is {measured.residual_rms:.3g} grey levels, "
            f"of which noise is about {expected:.2g}: somewhere the images don't match."
        )
        return replace(measured, warnings=(*measured.warnings, text))


def whole_checks(
    name: str, refit: Result, best: Result, errors: WholeFieldSummary, inside: NDArray[np.bool_]
) -> list[TruthCheck]:
    """What of one photograph's whole displacement was found, against the truth."""
    of, edges = f"{name}: whole displacement", errors.rms_edges_px
    rows = [
        TruthCheck(f"{of}: truth − measured, rms", errors.rms_px, "as measured", True, "px"),
        TruthCheck(f"{of}: … within 10 px of an edge", edges or 0.0, "as measured", True, "px"),
    ]
    has_pattern = best.ansatz.modes and best.ansatz.modes[0].family.size
    if not has_pattern or identifiability(best, inside).unobservable:
        return rows
    v, waves = v_percent(refit, best), waves_percent(refit, best)
    words = f"{of}: v1 of the refitted ansatz − of the best fit, largest, of its maximum"
    return [
        *rows,
        TruthCheck.at_most(words, v, _REFIT_AMPLITUDE, "%"),
        TruthCheck.at_most(f"{of}: wave vectors likewise", waves, _REFIT_WAVES, "%"),
    ]
