"""Run pyvale's subset DIC in the Python that has it: ``python pyvale_side.py FOLDER``.

Imports nothing of modeharvest, which that Python need not have. FOLDER holds ``request.npz``: the
images f and g, the mask, and the arguments of ``calculate_2d`` as JSON. A CSV is the result.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import numpy as np


def run(folder: Path) -> None:
    """Run the correlation that ``request.npz`` in the folder specifies."""
    with np.load(folder / "request.npz") as request:
        reference, deformed, mask = (request[name] for name in ("f", "g", "mask"))
        arguments = json.loads(str(request["arguments"]))
    dic = importlib.import_module("pyvale.dic")
    dic.calculate_2d(
        reference=reference,
        deformed=deformed,
        roi_mask=mask,
        output_basepath=folder,
        output_prefix="subsets_",
        print_level=0,
        **arguments,
    )


if __name__ == "__main__":
    run(Path(sys.argv[1]))
