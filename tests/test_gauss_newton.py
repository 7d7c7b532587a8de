"""The iteration on problems small enough to know the answer, and every way it can end."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from modeharvest.idic.solver.assembly import NormalEquations
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions, Minimum, Outcome, minimise
from modeharvest.util.errors import InputError
from modeharvest.util.scaled_eigen import ScaledEigen

FloatArray = NDArray[np.float64]
Residual = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def run(residual: Residual, start: list[float], left: float = 0.0, **options: float) -> Minimum:
    """Minimise 1/2 sum r^2 given r and J = -dr/da; beyond |a| = 10 a share ``left`` is lost."""

    def evaluate(a: FloatArray, with_matrix: bool) -> NormalEquations:
        r, J = residual(a)
        off = round(100 * left) if np.linalg.norm(a) > 10 else 0
        matrix = J.T @ J if with_matrix else np.zeros((len(a), len(a)))
        return NormalEquations(matrix, -J.T @ r, 0.5 * float(r @ r), 100 - off, off)

    return minimise(
        evaluate,
        lambda a, b: float(np.linalg.norm(b - a)),
        np.array(start, dtype=float),
        GaussNewtonOptions(**options),  # type: ignore[arg-type]
    )


def rosenbrock(a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Write the valley 1/2 (100 (y - x^2)^2 + (1 - x)^2) as two residuals."""
    x, y = a
    r = np.array([10 * (y - x**2), 1 - x])
    return r, np.array([[20 * x, -10.0], [1.0, 0.0]])


def line(a: FloatArray) -> tuple[FloatArray, FloatArray]:
    t = np.linspace(-1, 1, 7)
    J = np.stack([np.ones(7), t], axis=1)
    return 3.0 + 2.0 * t + 0.1 * t**2 - J @ a, J


def test_a_linear_problem_takes_one_step_and_one_to_see_it() -> None:
    found = run(line, [9.0, -4.0])
    assert found.outcome is Outcome.CONVERGED
    assert [step.damping for step in found.history] == [0, 0]
    r, J = line(found.unknowns)
    np.testing.assert_allclose(J.T @ r, 0, atol=1e-13)  # the least-squares solution


def test_the_curved_valley_is_followed_downhill() -> None:
    found = run(rosenbrock, [-1.2, 1.0], tolerance_px=1e-10)
    assert found.outcome is Outcome.CONVERGED
    np.testing.assert_allclose(found.unknowns, 1.0, atol=1e-9)
    costs = [step.mean_square for step in found.history]
    assert costs == sorted(costs, reverse=True)
    assert [step.number for step in found.history] == list(range(1, len(costs) + 1))


def test_a_step_that_overshoots_is_damped() -> None:
    """The full step of arctan from beyond 1.39 moves away from the zero; damping saves it."""

    def residual(a: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.array([np.arctan(a[0])]), np.array([[-1 / (1 + a[0] ** 2)]])

    found = run(residual, [3.0])
    assert found.outcome is Outcome.CONVERGED
    assert found.unknowns[0] == pytest.approx(0, abs=1e-9)
    assert found.history[0].damping > 0
    assert found.history[-1].damping < 1e-3 * found.history[0].damping  # released again


def test_too_few_iterations() -> None:
    found = run(rosenbrock, [-1.2, 1.0], max_iterations=2)
    assert found.outcome is Outcome.MAX_ITERATIONS
    assert len(found.history) == 2
    r, _ = rosenbrock(found.unknowns)
    assert found.equations.cost == 0.5 * r @ r  # the best found, with its own equations


def test_a_wrong_gradient_is_found_out() -> None:
    def uphill(a: FloatArray) -> tuple[FloatArray, FloatArray]:
        r, J = line(a)
        return r, -J

    found = run(uphill, [9.0, -4.0])
    assert found.outcome is Outcome.STAGNATED
    np.testing.assert_array_equal(found.unknowns, [9.0, -4.0])


def test_no_information_at_all() -> None:
    found = run(lambda a: (np.ones(3), np.zeros((3, 2))), [1.0, 2.0])
    assert found.outcome is Outcome.SINGULAR
    np.testing.assert_array_equal(found.unknowns, [1.0, 2.0])
    assert found.history == ()


def test_an_unknown_without_information_stays_where_it_is() -> None:
    def residual(a: FloatArray) -> tuple[FloatArray, FloatArray]:
        r, J = line(a[:2])
        return r, np.hstack([J, np.zeros((7, 1))])

    found = run(residual, [9.0, -4.0, 7.5])
    assert found.outcome is Outcome.CONVERGED
    np.testing.assert_allclose(found.unknowns, [*run(line, [9.0, -4.0]).unknowns, 7.5])


def test_a_start_outside_the_image_is_not_iterated() -> None:
    found = run(line, [20.0, 0.0], left=0.5)
    assert found.outcome is Outcome.OUTSIDE_IMAGE
    assert found.history == ()
    # As much as is allowed may be outside.
    assert run(line, [20.0, 0.0], left=0.5, max_outside=0.5).outcome is Outcome.CONVERGED


def test_a_step_that_leaves_the_image_is_refused() -> None:
    """The minimum lies beyond |a| = 10: no step goes there, however good it looks."""

    def residual(a: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.array([12.0, 0.0]) - a, np.eye(2)

    found = run(residual, [0.0, 0.0], left=0.9)
    assert found.outcome is not Outcome.CONVERGED
    assert 9 < np.linalg.norm(found.unknowns) <= 10


def test_every_outcome_has_a_text() -> None:
    explanations = [outcome.explanation for outcome in Outcome]
    assert len(set(explanations)) == len(Outcome)
    assert all(text[0].isupper() and text.endswith(".") for text in explanations)


@given(seed=st.integers(0, 10**6), n=st.integers(1, 8))
def test_inverse_solve_and_condition_do_not_care_for_units(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(3 * n, n))
    units = 10.0 ** rng.uniform(-4, 4, n)
    matrix, scaled = J.T @ J, (J * units).T @ (J * units)
    eigen, other = ScaledEigen.of(matrix), ScaledEigen.of(scaled)
    assert other.condition_number == pytest.approx(eigen.condition_number, rel=1e-9)
    rounding = 1e-14 * n * eigen.condition_number
    product = eigen.inverse() @ matrix
    np.testing.assert_allclose(product, np.eye(n), atol=rounding)
    right = rng.normal(size=n)
    np.testing.assert_allclose(
        other.solve(right * units) * units, eigen.solve(right), rtol=1e-6, atol=rounding
    )
    np.testing.assert_allclose(matrix @ eigen.solve(right), right, atol=10 * rounding)


def test_a_lost_direction_is_infinite_for_those_it_touches_only() -> None:
    J = np.random.default_rng(0).normal(size=(9, 4))
    J[:, 3] = -2 * J[:, 1]  # 1 and 3 can't be told apart
    eigen = ScaledEigen.of(J.T @ J)
    inverse = eigen.inverse()
    assert np.isinf(np.diag(inverse)).tolist() == [False, True, False, True]
    assert eigen.condition_number == np.inf
    known = np.linalg.inv(J[:, [0, 1, 2]].T @ J[:, [0, 1, 2]])
    np.testing.assert_allclose(inverse[np.ix_([0, 2], [0, 2])], known[np.ix_([0, 2], [0, 2])])


def test_a_column_of_rounding_is_not_scaled_up() -> None:
    J = np.random.default_rng(0).normal(size=(9, 3))
    J[:, 1] *= 1e-15
    eigen = ScaledEigen.of(J.T @ J)
    assert np.isinf(np.diag(eigen.inverse())).tolist() == [False, True, False]
    step = eigen.solve(J.T @ np.ones(9))
    assert step[1] == 0
    np.testing.assert_allclose(step[[0, 2]], np.linalg.lstsq(J[:, [0, 2]], np.ones(9))[0])


def test_bad_options() -> None:
    with pytest.raises(InputError, match="tolerances above 0 px"):
        GaussNewtonOptions(tolerance_px=0.0)
    with pytest.raises(InputError, match="at least 1 iteration"):
        GaussNewtonOptions(max_iterations=0)
    with pytest.raises(InputError, match="max_outside in"):
        GaussNewtonOptions(max_outside=1.5)
