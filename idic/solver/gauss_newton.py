"""Gauss-Newton with a Levenberg safeguard, on the eigenvectors of the scaled matrix.

A full Gauss-Newton step is tried first. One that raises the cost is solved again from the
stored matrix with more damping, until the cost falls. The matrix is scaled to a unit diagonal
and decomposed into eigenvectors; directions the images say nothing about (the mode's
parameters where v is zero) get no step instead of an enormous one.

Once steps are short, J'J hardly changes, and its difference from the Hessian makes convergence
linear. From then on it isn't assembled, but corrected by the change of the gradient in each step
(Broyden, Fletcher, Goldfarb & Shanno): iterations are cheaper, and fewer. J'J itself is assembled
again where the iteration ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from modeharvest.idic.solver.assembly import NormalEquations
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.scaled_eigen import ScaledEigen


class Outcome(Enum):
    """Why an iteration ended; ``explanation`` says it in a sentence."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "max_iterations"
    STAGNATED = "stagnated"
    SINGULAR = "singular"
    OUTSIDE_IMAGE = "outside_image"
    LOCAL_MINIMUM = "local_minimum"
    UNWEIGHTED = "unweighted"
    REFITTED = "refitted"

    @property
    def explanation(self) -> str:
        """One sentence for a reader of the result."""
        return _EXPLANATIONS[self]


_EXPLANATIONS = {
    Outcome.CONVERGED: "The displacement changed by less than the tolerance.",
    Outcome.MAX_ITERATIONS: (
        "The largest number of iterations was reached before the displacement settled; "
        "start closer, or allow more iterations."
    ),
    Outcome.STAGNATED: (
        "No step, however short, lowered the cost, yet the last one was above the tolerance."
    ),
    Outcome.SINGULAR: (
        "The images hold no information about the unknowns: no pixel was used, or the deformed "
        "image has no gradient there."
    ),
    Outcome.OUTSIDE_IMAGE: (
        "Too many pixels are mapped outside the deformed image; check the sign of the start, "
        "the pixel size and the origin of the grid."
    ),
    Outcome.LOCAL_MINIMUM: (
        "The iteration ended where parts of the images don't match at all: a local minimum; "
        "start closer, with other mode parameters, or with coarser speckle: beside a large model "
        "error, fine speckle has local minima near any initial guess."
    ),
    Outcome.UNWEIGHTED: (
        "The least-squares minimum was found, but from there no way to where the gradient that "
        "was to weigh the residual does so: this is the least-squares minimum, which noise biases "
        "by more than its standard errors say; try gradient_blur_px, or gradient = 'deformed'."
    ),
    Outcome.REFITTED: (
        "The correlation ended where parts of the images don't match; these are the unknowns of "
        "the ansatz refitted to the measured whole displacement."
    ),
}


@dataclass(frozen=True)
class GaussNewtonOptions:
    """Tolerances and limits of the iteration."""

    tolerance_px: float = 1e-4
    """Converged once a step changes the displacement by less than this, rms [px]. The error left is
    no larger than about the last step. 1e-4 px is a hundredth of the best noise floor of DIC."""
    coarse_tolerance_px: float = 1e-2
    """The same in *binned* px on the coarse levels, which only have to lead to the next."""
    tolerance_errors: float = 0.01
    """Also converged if no step lowers the cost any more and the last one is shorter than this, rms
    over the unknowns in standard errors, with the residual taken for noise: the relative offset of
    Bates & Watts, Technometrics 23 (1981), doi 10.1080/00401706.1981.10486254."""
    max_iterations: int = 50
    """Most iterations on each level."""
    max_outside: float = 0.2
    """Fraction of the pixels that may be mapped outside the deformed image [-]."""

    def __post_init__(self) -> None:
        if not (self.tolerance_px > 0 and self.coarse_tolerance_px > 0):
            raise InputError(
                "expected tolerances above 0 px, got "
                f"{self.tolerance_px} and {self.coarse_tolerance_px} px"
            )
        if self.max_iterations < 1 or not 0 <= self.max_outside <= 1:
            raise InputError(
                "expected at least 1 iteration and max_outside in [0, 1], got "
                f"{self.max_iterations} and {self.max_outside}"
            )


@dataclass(frozen=True)
class Iteration:
    """One accepted (or the last refused) step."""

    factor: int
    """Binning of the level [px]."""
    number: int
    """Counted from 1 on each level, and again whenever the pixels used are chosen anew."""
    mean_square: float
    """Mean of r^2 after the step."""
    step_px: float
    """Rms change of the displacement [px of the full image]."""
    damping: float
    """Levenberg's damping of the scaled matrix [-]; 0 is a full step."""
    pixels: int


@dataclass(frozen=True, eq=False)
class Minimum:
    """The point where the iteration ended, and its outcome."""

    unknowns: FloatArray
    """(n,): the best unknowns found."""
    equations: NormalEquations
    outcome: Outcome
    history: tuple[Iteration, ...]
    curvature: FloatArray
    """(n, n): J'J corrected by what the steps did to the gradient; see :func:`minimise`."""


Evaluate = Callable[[FloatArray, bool], NormalEquations]
StepLength = Callable[[FloatArray, FloatArray], float]

_FIRST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e4

_SHORT = 0.1
"""Steps shorter than this [binned px] leave J'J nearly as it was: speckles are 3 px or more."""

_FALLING = 0.9
"""Ratio of the costs after and before a step below which the cost is said to fall a lot."""

_LEAST_CURVATURE = 0.05
"""Share of J'J's curvature along a step that the gradient's change must show at least."""


def minimise(
    evaluate: Evaluate, step_length: StepLength, start: FloatArray, options: GaussNewtonOptions,
    factor: int = 1, on_iteration: Callable[[int], None] = lambda number: None,
    curvature: FloatArray | None = None, eigenvalue_cutoff: float = 0.0,
) -> Minimum:  # fmt: skip
    """Minimise 1/2 sum r^2.

    evaluate : Makes the normal equations at given unknowns, with their matrix or without.
    step_length : Rms difference of the displacement between two sets of unknowns [px].
    start : (n,) initial unknowns.
    options : Tolerances and limits.
    factor : Binning of the level [px].
    on_iteration : Called with the number of each finished iteration.
    curvature : (n, n) initial curvature in place of J'J, if it is known already.
    eigenvalue_cutoff : Directions with an eigenvalue below this share of the largest one get no
        step [-].
    """
    is_assembled = curvature is None
    here = evaluate(start, is_assembled)
    known = here.matrix if curvature is None else curvature
    at = _SearchPoint(start, here, is_assembled, known, has_fallen=is_assembled)
    history: list[Iteration] = []
    outcome = Outcome.OUTSIDE_IMAGE if _share_outside(at.equations) > options.max_outside else None
    while outcome is None:
        if not np.any(at.curvature):
            outcome = Outcome.SINGULAR
            break
        step = _descend(at, evaluate, step_length, options, _SHORT * factor, eigenvalue_cutoff)
        at = step.to if step.accepted else at
        number, damping, here = len(history) + 1, step.damping, at.equations
        taken = Iteration(factor, number, here.mean_square, step.length_px, damping, here.pixels)
        history.append(taken)
        on_iteration(number)
        outcome = _ending(step, number, options)
        at = replace(at, damping=0.0 if damping <= _FIRST_DAMPING else 0.1 * damping)
    there = at.equations if at.is_assembled else evaluate(at.a, True)
    return Minimum(at.a, there, outcome, tuple(history), at.curvature)


@dataclass(frozen=True, eq=False)
class _SearchPoint:
    """The present unknowns, and what is known of the cost there."""

    a: FloatArray
    equations: NormalEquations
    is_assembled: bool
    curvature: FloatArray
    has_fallen: bool = True
    """Whether the cost still falls a lot: then the Gauss-Newton matrix itself is the best."""
    damping: float = 0.0


@dataclass(frozen=True, eq=False)
class _TrialStep:
    """A step from one point to another, and whether it is accepted."""

    to: _SearchPoint
    length_px: float
    errors: float
    damping: float
    accepted: bool


def _descend(
    at: _SearchPoint, evaluate: Evaluate, step_length: StepLength, options: GaussNewtonOptions,
    short_px: float, eigenvalue_cutoff: float,
) -> _TrialStep:  # fmt: skip
    """Take a step that lowers the cost, damped as much as necessary."""
    eigen, damping = ScaledEigen.of(at.curvature), at.damping
    while True:
        a = at.a - eigen.solve(at.equations.gradient, damping, eigenvalue_cutoff)
        length = step_length(at.a, a)
        is_settling = damping == 0.0 and length < short_px and not at.has_fallen
        # The last step's matrix is wanted for the covariance.
        is_assembled = not is_settling or length <= options.tolerance_px
        found = evaluate(a, is_assembled)
        descends = found.mean_square <= at.equations.mean_square
        accepted = descends and _share_outside(found) <= options.max_outside
        if accepted or length <= options.tolerance_px or damping >= _LARGEST_DAMPING:
            break
        damping = max(_FIRST_DAMPING, 10.0 * damping)
    curvature = found.matrix
    if is_settling:
        change = found.gradient - at.equations.gradient
        curvature = corrected(at.curvature, a - at.a, change)
    has_fallen = found.mean_square < _FALLING * at.equations.mean_square
    errors = standard_errors(a - at.a, at.curvature, at.equations)
    to = _SearchPoint(a, found, is_assembled, curvature, has_fallen)
    return _TrialStep(to, length, errors, damping, accepted)


def _ending(step: _TrialStep, number: int, options: GaussNewtonOptions) -> Outcome | None:
    """Why to stop after this step, if there is a reason."""
    if step.length_px <= options.tolerance_px and step.damping <= _FIRST_DAMPING:
        return Outcome.CONVERGED
    if step.accepted and number < options.max_iterations:
        return None
    if step.damping <= _FIRST_DAMPING and step.errors <= options.tolerance_errors:
        return Outcome.CONVERGED
    return Outcome.MAX_ITERATIONS if step.accepted else Outcome.STAGNATED


def corrected(matrix: FloatArray, step: FloatArray, change: FloatArray) -> FloatArray:
    """Correct a matrix by the curvature seen along a step: matrix . step = change of gradient.

    Returned unchanged where the gradient shows no positive curvature.
    """
    product = matrix @ step
    curvature, observed = float(step @ product), float(step @ change)
    if not observed > _LEAST_CURVATURE * curvature > 0:
        return matrix
    lost, gained = np.outer(product, product) / curvature, np.outer(change, change) / observed
    return np.asarray(matrix - lost + gained)


def standard_errors(step: FloatArray, curvature: FloatArray, at: NormalEquations) -> float:
    """Length of a step in the unknowns' standard errors, which follow from the residual; rms."""
    squares = max(0.0, float(step @ curvature @ step))
    if not at.mean_square > 0.0:
        return np.inf
    return float(np.sqrt(squares / (at.mean_square * step.size)))


def _share_outside(equations: NormalEquations) -> float:
    """Fraction of the pixels that are mapped outside the image."""
    return equations.outside_image / max(1, equations.outside_image + equations.pixels)
