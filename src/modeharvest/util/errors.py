"""Exceptions that end a run early for a cause outside the program: input, or a missing library."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """The user's input can't be used; the message is one line that says what to do.

    Its parts are *expected, got, where, what to do*. The command line prints it without a
    traceback and exits with code 2.
    """


def require_within(
    what: str, value: float, low: float, high: float = math.inf, *, above: bool = False
) -> None:
    """Raise InputError unless value is finite, low <= value <= high; ``above``: low < value.

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
    """A file can't be written (full disk, for example); not caused by the input's content."""


class SingularMatrixError(InputError, ArithmeticError):
    """The input does not determine all unknowns; the message names the library that failed."""

    def __init__(self, found: str) -> None:
        super().__init__(
            f"expected data that determine every unknown, got a singular matrix ({found}); check "
            "images, mask and supports"
        )


class MissingDependencyError(ImportError):
    """An optional library is needed for this step; the message says how to get it."""


def dolfinx_missing(what: str) -> MissingDependencyError:
    """The error for a missing dolfinx; ``what`` begins its message ("the design needs")."""
    return MissingDependencyError(
        f"{what} dolfinx >= 0.9, petsc4py and gmsh: install them with 'conda install -c "
        "conda-forge fenics-dolfinx petsc4py python-gmsh' or, on Debian 13, 'apt install "
        "python3-dolfinx python3-petsc4py python3-gmsh python3-h5py-mpi'"
    )


@contextmanager
def requiring_dolfinx(what: str) -> Iterator[None]:
    """Turn a failed import in the block into the error of :func:`dolfinx_missing`."""
    try:
        yield
    except ImportError as error:
        raise dolfinx_missing(what) from error
