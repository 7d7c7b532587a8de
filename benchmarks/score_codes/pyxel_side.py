"""pyxel-dic on a public folder, without modeharvest: ``python pyxel_side.py PUBLIC IMAGE FIELD``.

Finite-element DIC on triangles that pyxel makes of the mask. The start is pyxel's optical flow (its
multiscale start from zero did not find motions of 37 px on a repeating pattern). Then it runs at
full resolution with weak regularisation over 30, 15 and 8 px, each from the previous result. 4 px
next to edges are left out: with 2 px, elements at some holes diverged.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pyxel
from PIL import Image
from scipy import ndimage

ELEMENT_PX, SMOOTHED_PX, POINTS = 12.0, 1.5, 6
LENGTHS_PX = 30.0, 15.0, 8.0
EDGE_PX, MAX_ITERATIONS, TOLERANCE = 4, 30, 1e-4


def picture(pixels: np.ndarray) -> pyxel.Image:
    made = pyxel.Image("")
    made.pix = np.asarray(pixels, dtype=np.float64)
    return made


def main(public: Path, deformed: str, field: Path) -> None:
    info = json.loads((public / "benchmark.json").read_text("utf-8"))
    f = picture(Image.open(public / info["reference"]["camera_image"]))
    g = picture(Image.open(public / deformed))
    mask = np.asarray(Image.open(public / info["reference"]["mask"])) > 0
    material = picture(255 * ndimage.binary_erosion(mask, iterations=EDGE_PX))
    mesh, camera = pyxel.MeshFromImage(material, 127, ELEMENT_PX, appls=SMOOTHED_PX)
    mesh.e = {2: mesh.e[2]}  # triangles alone, no edges and corners
    mesh.Connectivity()
    found, _ = pyxel.DISFlowInit(f, g, mesh, camera)
    mesh.DICIntegrationFast(POINTS)
    for length in LENGTHS_PX:
        found, _ = pyxel.Correlate(f, g, mesh, camera, U0=found, l0=length, direct=True,
                                   eps=TOLERANCE, maxiter=MAX_ITERATIONS)  # fmt: skip
    points = mesh.Copy()
    points.DICIntegrationFast(2)
    u, v = points.phix @ found, points.phiy @ found
    header = f"# benchmark: {info['id']}\nx [px],y down [px],u [px],v down [px]"
    table = np.column_stack([points.pgx, -points.pgy, u, -v])
    np.savetxt(field, table, "%.6f", ",", header=header, comments="")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
