"""pyxel-dic on a public folder, without modeharvest: ``python pyxel_side.py PUBLIC IMAGE FIELD``.

Finite-element DIC on triangles of 8 px that pyxel makes of the mask, from its own multiscale start
(scales 3, 2, 1 with its automatic regularisation), then at full resolution.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pyxel
from PIL import Image

ELEMENT_PX, SMOOTHED_PX, LENGTH_PX = 8.0, 0.8, 8.0
MAX_ITERATIONS, TOLERANCE = 100, 1e-5


def picture(pixels: np.ndarray) -> pyxel.Image:
    made = pyxel.Image("")
    made.pix = np.asarray(pixels, dtype=np.float64)
    return made


def main(public: Path, deformed: str, field: Path) -> None:
    info = json.loads((public / "benchmark.json").read_text("utf-8"))
    f = picture(Image.open(public / info["reference"]["camera_image"]))
    g = picture(Image.open(public / deformed))
    material = picture(Image.open(public / info["reference"]["mask"]))
    mesh, camera = pyxel.MeshFromImage(material, 127, ELEMENT_PX, appls=SMOOTHED_PX)
    mesh.e = {2: mesh.e[2]}  # triangles alone, no edges and corners
    mesh.Connectivity()
    start = pyxel.MultiscaleInit(f, g, mesh, camera, scales=[3, 2, 1])
    found, _ = pyxel.Correlate(f, g, mesh, camera, U0=start, l0=LENGTH_PX, direct=True,
                               eps=TOLERANCE, maxiter=MAX_ITERATIONS)  # fmt: skip
    points = mesh.Copy()
    points.DICIntegrationFast(2)
    u, v = points.phix @ found, points.phiy @ found
    header = f"# benchmark: {info['id']}\nx [px],y down [px],u [px],v down [px]"
    table = np.column_stack([points.pgx, -points.pgy, u, -v])
    np.savetxt(field, table, "%.6f", ",", header=header, comments="")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
