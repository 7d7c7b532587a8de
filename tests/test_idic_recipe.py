"""The recipe of docs/explanation/idic.md works as printed: a new mode family is recovered."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import manufactured
import numpy as np
from manufactured import GRID, PIXEL

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.correlate import correlate
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.imaging.pair import ImagePair

PAGE = Path(__file__).parents[1] / "docs/explanation/idic.md"


def test_the_printed_family_is_recovered() -> None:
    (block,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(block, str(PAGE), "exec"), names)
    ansatz: Ansatz = names["ansatz"]
    truth = ansatz.initial_guess(0.04, 1.5)
    truth[: ansatz.phi_offset(0)] += 0.003 * np.random.default_rng(0).normal(size=26)
    truth[ansatz.phi_slice(0)] += [0.02, 0.03, -0.04, 0.05]
    f, g = manufactured.image_pair(manufactured.speckle(), ansatz, truth)
    mask = manufactured.inner_mask(0.1)
    result = correlate(
        ImagePair(f, g, GRID, mask), ansatz, guess=ansatz.initial_guess(strain=0.04, amplitude=1.0)
    )
    assert result.outcome is Outcome.CONVERGED
    error = (result.displacement() - ansatz.displacement(truth, GRID.x, GRID.y))[mask] / PIXEL
    assert np.sqrt((error**2).sum(axis=-1).mean()) < 1e-5
    np.testing.assert_allclose(result.mode_parameters(), truth[ansatz.phi_slice(0)], atol=1e-5)
