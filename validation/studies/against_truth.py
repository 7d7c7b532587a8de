"""How wrong one measurement is: its error in the parts that the ansatz and the images make."""

from __future__ import annotations

import numpy as np

from modeharvest.idic.result import Result
from modeharvest.validation.metrics import describe
from modeharvest.validation.studies.subject import Scene
from modeharvest.validation.truth import compare


def against_truth(scene: Scene, result: Result) -> dict[str, float]:
    """Set a result against the truth of its images and the best fit of its ansatz.

    Parameters
    ----------
    scene
        What was measured.
    result
        The measurement.

    Returns
    -------
    dict
        ``w_px``, ``best_px``, ``lost_px``: rms per component of truth - IDIC, truth - best fit
        and IDIC - best fit [px]; ``v1_percent``: rms difference of v1 from the best fit's over
        the cellular material, of the largest of the best fit's.
    """
    found = compare(scene.images, scene.strain, result, scene.start(), camera=scene.how.camera)
    parts = {"w_px": found.w, "best_px": found.best_error, "lost_px": found.idic_to_best}
    px = found.grid.pixel_size
    rms = {
        name: float(describe(part, found.mask, px)["rms_per_component"])
        for name, part in parts.items()
    }
    a, b = scene.specimen.cellular_half_size
    x, y = np.abs(found.grid.x)[None, :], np.abs(found.grid.y)[:, None]
    inside = found.mask & (x <= a) & (y <= b)
    v, at_best = (fit.v(0)[inside] for fit in (result, found.best))
    apart = float(np.sqrt(np.mean((v - at_best) ** 2)) / np.abs(at_best).max())
    return {**rms, "v1_percent": 100.0 * apart}
