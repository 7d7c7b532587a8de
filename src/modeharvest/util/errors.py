"""The two ways a run ends early, apart from a fault in the program itself."""

from __future__ import annotations


class InputError(ValueError):
    """What the user gave can't be used; the message is one line that says what to do.

    Write it as *expected, got, where, what to do*. The command line prints it without a
    traceback and exits with code 2.
    """


class MissingDependencyError(ImportError):
    """An optional library is needed for this step; the message says how to get it."""
