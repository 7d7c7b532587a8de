"""The two ways a run ends early, apart from a fault in the program itself."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """What the user gave can't be used; the message is one line that says what to do.

    Write it as *expected, got, where, what to do*. The command line prints it without a
    traceback and exits with code 2.
    """


def require_within(
    what: str, value: float, low: float, high: float = math.inf, *, above: bool = False
) -> None:
    """Raise InputError unless low <= value <= high, finite; ``above``: unless it is above low.

    ``what`` begins the message, for example "sensor: expected a gain".
    """
    if math.isfinite(value) and low <= value <= high and not (above and value == low):
        return
    limits = f"above {low:g}" if above else f"of {low:g}"
    if high < math.inf:
        limits += f" and at most {high:g}" if above else f" to {high:g}"
    elif not above:
        limits += " or more"
    raise InputError(f"{what} {limits}, got {value}")


class WriteError(InputError):
    """A file can't be written, as on a full disk: no fault of what was given, so not its result."""


class SingularMatrixError(InputError, ArithmeticError):
    """What was given determines no solution; the message names the library that found so."""

    def __init__(self, found: str) -> None:
        super().__init__(
            f"expected data that determine every unknown, got a singular matrix ({found}); check "
            "images, mask and supports"
        )


class MissingDependencyError(ImportError):
    """An optional library is needed for this step; the message says how to get it."""


def dolfinx_missing(what: str) -> MissingDependencyError:
    """The error for ``what`` needs dolfinx where there is none, and how to get it."""
    return MissingDependencyError(
        f"{what} dolfinx >= 0.9, petsc4py and gmsh: install them with 'conda install -c "
        "conda-forge fenics-dolfinx petsc4py python-gmsh' or, on Debian 13, 'apt install "
        "python3-dolfinx python3-petsc4py python3-gmsh python3-h5py-mpi'"
    )


@contextmanager
def requiring_dolfinx(what: str) -> Iterator[None]:
    """Have an import that fails in the block end with what :func:`dolfinx_missing` says."""
    try:
        yield
    except ImportError as error:
        raise dolfinx_missing(what) from error
