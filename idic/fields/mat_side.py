"""Read a MAT file in a process of its own: ``python mat_side.py FILE TARGET BYTES``.

scipy's parser trusts the file; a damaged one makes it read where there is no memory of its own,
which ends the process that it runs in. TARGET is written as NPZ: every numeric variable and every
text, and as ``names`` what they are called; those in structures by their path. BYTES are the most
that the process may take. Imports nothing of modeharvest, to start fast.
"""

from __future__ import annotations

import sys
import warnings
from typing import Any

import numpy as np
from scipy.io import loadmat


def main(path: str, target: str, most_bytes: float) -> str:
    """Read ``path`` and write ``target``; returns why that failed, or an empty text."""
    _limit(most_bytes)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is doubtful is left out below
            found = _flattened(loadmat(path, simplify_cells=True))
        kept = {n: a for n, a in found.items() if a.dtype.kind in "fiubU"}
        np.savez(target, *kept.values(), names=np.array(list(kept), dtype=np.str_))
    except Exception as error:  # a damaged file makes it raise anything
        return " ".join(str(error).split()) or type(error).__name__
    return ""


def _flattened(content: dict[str, Any], above: str = "") -> dict[str, np.ndarray[Any, Any]]:
    flat: dict[str, Any] = {}
    for name, value in content.items():
        if name.startswith("__"):
            continue
        if isinstance(value, dict):
            flat |= _flattened(value, f"{above}{name}/")
        else:
            flat[above + name] = np.asarray(value)
    return flat


def _limit(most_bytes: float) -> None:
    """Where the system can, let wild allocations fail instead of filling the memory."""
    try:
        import resource
    except ImportError:  # Windows
        return
    resource.setrlimit(resource.RLIMIT_AS, (int(most_bytes), resource.RLIM_INFINITY))


if __name__ == "__main__":
    said = main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
    print(said, file=sys.stderr)
    sys.exit(bool(said))
