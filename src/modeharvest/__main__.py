"""``python -m modeharvest`` and the ``modeharvest`` command."""

from __future__ import annotations

import os
import sys
import warnings


def start() -> None:
    """Load the command line and run it; Ctrl-C may come before there is anything to catch it."""
    if not sys.warnoptions:  # else libraries would print theirs beside our lines
        warnings.simplefilter("ignore")
    for library in ("OMP", "OPENBLAS", "MKL"):  # they spin on the kernels' cores
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    try:
        from modeharvest.cli.root import main
    except KeyboardInterrupt:
        sys.exit(130)
    main()


if __name__ == "__main__":
    start()
