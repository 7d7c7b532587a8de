"""A lens is recovered from a pair of images of one scene, without and with its distortion."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_set import photographs, random_lens
from lens_pair import CameraModel, recover_camera
from numpy.typing import NDArray

from modeharvest.imaging.distortion.calibrate import LensEstimate
from modeharvest.imaging.distortion.fit import PolynomialModel
from modeharvest.imaging.distortion.lens import CameraDistortion, Distortion, PolynomialDistortion
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]

SHAPE = (240, 320)
LENS = CameraDistortion(440, 440, 161.3, 117.2, k1=-0.24, k2=-0.1, k3=-0.4)  # up to 9 px
NOISE = 0.01
POSITIONS = np.arange(0.0, 240.0, 8)[:, None], np.arange(0.0, 320.0, 8)[None, :]


def pair(lens: Distortion, noise: float = NOISE) -> tuple[FloatArray, FloatArray]:
    """Make both images exactly: the lens shows the scene at the inverse of phi_S."""
    nothing = PolynomialDistortion(SHAPE, np.zeros((2, 1)))
    (ideal,) = photographs(nothing, SHAPE, [[0.0, 0.0]], noise=noise, seed=4)
    (observed,) = photographs(lens, SHAPE, [[0.0, 0.0]], seed=4)
    return ideal, observed + noise * np.random.default_rng(8).normal(size=SHAPE)


def difference(found: LensEstimate, lens: Distortion) -> float:
    """Rms per component over the image [px]."""
    d = np.stack(found.distortion.shift(*POSITIONS)) - np.stack(lens.shift(*POSITIONS))
    return float(np.sqrt(np.mean(d**2)))


def predicted(found: LensEstimate) -> float:
    return float(np.sqrt(np.mean(np.square(found.sd(*POSITIONS)))))


def test_a_camera_is_recovered_within_its_error_bars() -> None:
    found = recover_camera(*pair(LENS))
    assert difference(found, LENS) < 2 * predicted(found) < 0.01  # 0.01 px is what is asked
    assert found.noise_sd == pytest.approx(NOISE, rel=0.1)
    lens = found.distortion
    assert isinstance(lens, CameraDistortion)
    assert (lens.cx, lens.cy) == pytest.approx((LENS.cx, LENS.cy), abs=0.5)
    # The focal length is a matter of choice: k1 / f^2 is what is observable.
    assert lens.k1 / lens.fx**2 == pytest.approx(LENS.k1 / LENS.fx**2, rel=0.05)


def test_tangential_and_rational_coefficients_are_recovered() -> None:
    lens = CameraDistortion(440, 450, 159.5, 119.5, k1=-0.2, p1=4e-3, p2=-6e-3, k4=0.1)
    start = CameraDistortion(440, 450, 159.5, 119.5)
    found = recover_camera(*pair(lens), CameraModel(start, ("k1", "p1", "p2", "k4")))
    assert difference(found, lens) < 2 * predicted(found) < 0.02


def test_a_polynomial_is_recovered_with_its_affine_part() -> None:
    lens = random_lens(SHAPE, 4, 6.0, affine=1.0)
    found = recover_camera(*pair(lens), PolynomialModel(SHAPE, 4, fixed=0))
    assert difference(found, lens) < 2 * predicted(found) < 0.02


def test_the_better_model_has_the_lower_bic() -> None:
    images = pair(LENS)
    camera, low, high = (
        recover_camera(*images, model)
        for model in (None, PolynomialModel(SHAPE, 3, 0), PolynomialModel(SHAPE, 6, 0))
    )
    assert camera.bic < min(low.bic, high.bic)


def test_a_mask_leaves_out_what_changed() -> None:
    ideal, observed = pair(LENS)
    observed[100:140, 100:180] = 0.5  # something lay on the scene
    mask = np.ones(SHAPE, np.bool_)
    mask[85:155, 85:195] = False
    found = recover_camera(ideal, observed, mask=mask)
    assert difference(found, LENS) < 0.02


@pytest.mark.parametrize("kind", ["camera", "polynomial"])
def test_sensitivities_are_derivatives(kind: str) -> None:
    row, col = np.array([3.0, 120.0, 230.0]), np.array([300.0, 20.0, 170.0])
    if kind == "camera":
        lens = CameraDistortion(440, 450, 150, 110, 0.1, 0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6)
        names = ("cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        model: CameraModel | PolynomialModel = CameraModel(lens, names)
        c = model.start
    else:
        model = PolynomialModel(SHAPE, 4)
        c = np.random.default_rng(0).normal(size=model.start.size)
    slopes = model.sensitivities(c, row, col)
    h = 1e-5 * np.maximum(1.0, np.abs(c))
    for k, step in enumerate(np.diag(h)):
        ahead, behind = (np.stack(model.distortion(c + s * step).shift(row, col)) for s in (1, -1))
        # Rounding of 100 px over 1e-5: 1e-9 relative to the largest slopes of some 100 px.
        np.testing.assert_allclose(slopes[:, k], (ahead - behind) / (2 * h[k]), atol=1e-6)


def test_pairs_that_cannot_be_used_are_refused_in_a_line() -> None:
    ideal, observed = pair(LENS)
    with pytest.raises(InputError, match="of one size"):
        recover_camera(ideal, observed[:-1])
    with pytest.raises(InputError, match="constant grey level"):
        recover_camera(ideal, np.ones(SHAPE))
    with pytest.raises(InputError, match="finite grey levels"):
        recover_camera(ideal, np.full(SHAPE, np.nan))
    with pytest.raises(InputError, match="of one scene"):
        recover_camera(ideal, observed[::-1])
    with pytest.raises(InputError, match="a mask of 240 x 320 px"):
        recover_camera(ideal, observed, mask=np.zeros(SHAPE))
    with pytest.raises(InputError, match="unknown camera parameters among"):
        CameraModel(LENS, ("fx",))
