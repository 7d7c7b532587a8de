"""The result as a file, its fields and its error bars, without a correlation."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import manufactured
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from manufactured import GRID

from modeharvest.idic.result import Covariance, Result
from modeharvest.idic.solver.gauss_newton import Iteration, Outcome
from modeharvest.idic.solver.noise import ImageNoise, NoiseTransfer
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.errors import InputError


def some_result(seed: int = 0, outcome: Outcome = Outcome.CONVERGED) -> Result:
    ansatz = manufactured.two_modes()
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(ansatz.size, ansatz.size)) * 10.0 ** rng.uniform(-9, 3, ansatz.size)
    return Result(
        ansatz=ansatz,
        grid=GRID,
        unknowns=manufactured.random_unknowns(ansatz, seed, 0.3),
        inverse=half.T @ half,
        residual_rms=0.1 / 3,
        pixels=12345,
        outside_image=7,
        outcome=outcome,
        condition_number=1e5 / 7,
        history=(Iteration(8, 1, 0.1, 1 / 3, 1e-4, 99), Iteration(1, 1, 0.02, 2e-5, 0.0, 12345)),
    )


def assert_equal(one: Result, other: Result) -> None:
    for name in ("unknowns", "inverse"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name in (
        "grid", "residual_rms", "pixels", "outside_image", "outcome", "condition_number",
        "history", "names", "noise_sd", "iterations", "undetermined",
    ):  # fmt: skip
        assert getattr(one, name) == getattr(other, name)
    assert one.ansatz.units == other.ansatz.units
    small = GRID.binned(40)
    np.testing.assert_array_equal(one.displacement(small), other.displacement(small))


@pytest.mark.parametrize("outcome", Outcome)
def test_a_file_holds_everything_exactly(outcome: Outcome, tmp_path: Path) -> None:
    result = some_result(1, outcome)
    result.write(tmp_path / "result.json")
    assert_equal(Result.read(tmp_path / "result.json"), result)
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["explanation"] == outcome.explanation
    assert content["unknowns"]["phi2.kx1"] == result.unknowns[result.names.index("phi2.kx1")]


def test_a_file_holds_error_bars_and_older_ones_have_none(tmp_path: Path) -> None:
    path, n = tmp_path / "result.json", some_result().ansatz.size
    noise, larger = np.diag(np.arange(1.0, n + 1)), np.diag(np.arange(2.0, n + 2))
    noise[0, 0] = np.inf
    for model_error in (larger, None):
        replace(some_result(), errors=Covariance(noise, model_error, ("few cells",))).write(path)
        found = Result.read(path).errors
        assert found is not None
        np.testing.assert_array_equal(found.by_noise, noise)
        assert (found.by_model_error is None) == (model_error is None)
        np.testing.assert_array_equal(found.by_model_error, model_error)
        assert found.warnings == ("few cells",)
    content = json.loads(path.read_text())
    del content["errors"]
    path.write_text(json.dumps(content))
    assert Result.read(path).errors is None


def test_a_result_that_knows_nothing_is_strict_json(tmp_path: Path) -> None:
    """Infinite values are null in the file: JSON knows no infinity."""

    def refuse(name: str) -> float:
        raise AssertionError(f"{name} is not JSON")

    n = manufactured.two_modes().size
    inverse = np.zeros((n, n))
    inverse[range(n), range(n)] = np.inf
    step = Iteration(1, 1, np.inf, 0.0, 0.0, 0)
    lost = replace(
        some_result(2, Outcome.SINGULAR), inverse=inverse, condition_number=np.inf,
        residual_rms=np.inf, pixels=0, history=(step,),
    )  # fmt: skip
    lost.write(tmp_path / "result.json")
    json.loads((tmp_path / "result.json").read_text(), parse_constant=refuse)
    again = Result.read(tmp_path / "result.json")
    assert_equal(again, lost)
    assert again.undetermined == again.names


@given(share=st.floats(0, 0.999))
def test_a_truncated_file_is_refused(
    share: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("cut") / "result.json"
    some_result().write(path)
    text = path.read_text()
    path.write_text(text[: int(share * (len(text) - 2))])
    with pytest.raises(InputError, match=r"result\.json"):
        Result.read(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "modeharvest-result-0"}, "modeharvest-result-5"),
        ({"outcome": "splendid"}, "complete"),
        ({"inverse": [[1.0, 2.0], [3.0]]}, "complete"),
        ({"inverse": [[1.0]]}, "inverse of shape"),
        ({"grid": {"rows": 3}}, "complete"),
        ({"unknowns": {"v0x[0,0]": 1.0}}, "expected 43 unknowns"),
        ({"ansatz": None}, "complete"),
    ],
)
def test_a_damaged_file_is_refused(change: dict[str, object], words: str, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    some_result().write(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=words) as error:
        Result.read(path)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing\.json"):
        Result.read(tmp_path / "nothing.json")


def test_parts_add_up_to_the_displacement() -> None:
    result, coarse = some_result(3), GRID.binned(20)
    parts = result.v0(coarse) + result.fluctuation(0, coarse) + result.fluctuation(1, coarse)
    np.testing.assert_allclose(parts, result.displacement(coarse), atol=1e-14)
    product = result.v(1, coarse)[..., None] * result.phi(1, coarse)
    np.testing.assert_allclose(product, result.fluctuation(1, coarse), atol=1e-14)
    np.testing.assert_array_equal(result.mode_parameters(1), result.unknowns[-4:])


def test_covariance_of_noise_in_one_or_both_images() -> None:
    result = some_result()
    np.testing.assert_allclose(result.covariance(0.1), 2 * 0.1**2 * result.inverse)
    for one in (ImageNoise(0.1, 0.0), ImageNoise(0.0, 0.1)):
        np.testing.assert_allclose(result.covariance(one), 0.1**2 * result.inverse)
    shrunk = replace(result, noise_transfer=NoiseTransfer(density=1.2))
    np.testing.assert_allclose(shrunk.covariance(0.1), 2.2 * 0.1**2 * result.inverse)
    np.testing.assert_allclose(
        result.standard_errors(0.1), 0.1 * np.sqrt(2 * np.diag(result.inverse))
    )
    for bad in (-0.1, float("nan"), float("inf")):
        with pytest.raises(InputError, match="noise of 0 grey levels or more"):
            result.covariance(bad)


def test_the_residual_says_how_much_noise_there_is() -> None:
    """An unbiased variance of it, and what the spline took of g's put back."""
    result = replace(some_result(), noise_transfer=NoiseTransfer(value=0.7))
    variance = 0.1**2 / 9 * 12345 / (12345 - result.ansatz.size)
    assert 1.7 * result.noise_sd**2 == pytest.approx(variance)
    np.testing.assert_allclose(result.covariance(), 2 * result.noise_sd**2 * result.inverse)
    assert result.residual_noise(ImageNoise(0.3, 0.4)) == pytest.approx(np.sqrt(0.09 + 0.7 * 0.16))


def test_bad_shapes() -> None:
    result = some_result()
    with pytest.raises(InputError, match=r"inverse of shape \(43, 43\), got \(2, 2\)"):
        replace(result, inverse=np.eye(2))
    with pytest.raises(InputError, match="expected 43 unknowns"):
        replace(result, unknowns=np.zeros(3))
    small = np.eye(3)
    with pytest.raises(InputError, match=r"images of \(360, 320\) px.*\(3, 3\)"):
        result.residual(ImagePair(small, small, PixelGrid.centred(3, 3, 0.01)))


def test_residual_is_nan_off_the_image() -> None:
    result = some_result()
    far = replace(result, grid=PixelGrid.centred(20, 30, 0.01), unknowns=np.zeros(43) + 9.0)
    image = np.random.default_rng(0).random((20, 30))
    assert np.isnan(far.residual(ImagePair(image, image, far.grid))).all()
