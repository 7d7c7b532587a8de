"""What the images of a set depend on, as one digest: a set with the same key need not be made."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from modeharvest.fem.field import Solution
from modeharvest.files import sha256_of
from modeharvest.imaging.distortion.files import read_distortion
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.versions import source_digest

FORMAT = "modeharvest-images-1"


def image_key(solution: Solution, strains: Sequence[float], spec: ImagingSpec) -> str:
    """Digest everything that the images depend on, hexadecimal.

    Parameters
    ----------
    solution
        Mesh and displacements.
    strains
        Nominal strains of the snapshots to image [-].
    spec
        How.

    Raises
    ------
    InputError
        If a snapshot is missing, or a distortion's file can't be read.
    """
    digest = hashlib.sha256()
    wanted = {"format": FORMAT, "code": source_digest("fem", "imaging"), "spec": asdict(spec),
              "element": solution.mesh.element, "strains": [float(s) for s in strains]}  # fmt: skip
    digest.update(json.dumps(wanted, sort_keys=True).encode())
    if isinstance(spec.distortion, str):
        read_distortion(spec.distortion)  # says what is wrong with it
        digest.update(sha256_of(spec.distortion).encode())
    for array in (solution.mesh.nodes, solution.mesh.cells):
        digest.update(array.tobytes())
    for strain in strains:
        digest.update(np.ascontiguousarray(solution.at(strain).displacement).tobytes())
    return digest.hexdigest()
