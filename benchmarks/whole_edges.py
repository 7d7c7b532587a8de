"""Causes of the longest errors of the whole displacement, pixel by pixel.

On the images of a virtual experiment (``modeharvest run paper-virtual --out FOLDER``), without and
with noise. The error at a pixel is the sum of

- mesh: the best fit of the elements to the truth over all pixels, less the truth;
- smoothing: what the regularisation removes from that fit, A^-1 lambda R (u_0 - u), less the part
  that is added back;
- images: other errors with exact images at the same cut-off wavelength: splines between pixels,
  pixels continued beyond edges, conditions of free edges, steps that are not linear;
- noise: additional errors with camera images, by quantisation or noise.

Printed for each cause and for all of them are the rms per component (all, edges), the longest error
and the number of pixels with more than 0.3 and 0.5 px; then the pixels with the longest errors, one
for each place: position, depth in the mask, whether in the mesh, principal stretches, and errors
along x and y by cause. Table: docs/explanation/whole_field_accuracy.md.

Run: scripts/env python benchmarks/whole_edges.py FOLDER [--strain 0.128] [--noise 0 0.01]
     [--mesh mask|specimen] [--element 24 12] [--places 12]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from whole_field import noisy, specimen_of

from modeharvest.fem.field import Mesh
from modeharvest.fem.meshing import mesh_specimen
from modeharvest.idic.finite_element.correlation import MeshCorrelation
from modeharvest.idic.finite_element.equations.system import Body
from modeharvest.idic.finite_element.measure import FiniteElementOptions, LastStage, started
from modeharvest.idic.finite_element.mesh import quadratic
from modeharvest.idic.finite_element.result import NodalResult
from modeharvest.idic.result import Result
from modeharvest.imaging.imageset import ImageSet
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.elements import shape_functions

EDGE_PX, LONG_PX = 10, (0.3, 0.5)
APART_PX = 40
"""Pixels with long errors that are closer than this are one place [px]."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--strain", type=float, default=0.128)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0])
    parser.add_argument("--mesh", choices=["mask", "specimen"], default="mask")
    parser.add_argument("--element", type=float, nargs=2, default=[24.0, 12.0], metavar="PX")
    parser.add_argument("--places", type=int, default=12)
    given = parser.parse_args()
    images = ImageSet.read(given.folder / "images")
    start = Result.read(given.folder / f"correlation/result_{round(1e4 * given.strain):04d}.json")
    options = FiniteElementOptions(*given.element)
    exact = noisy(images, given.strain, -1.0, 0)
    if given.mesh == "specimen":
        mesh = mesh_specimen(specimen_of(images), 16.0 * exact.grid.pixel_size)
        body = Body(quadratic(mesh))
    else:
        body = options.body(exact.masks[0], exact.grid)
    for noise in given.noise:
        pair = noisy(images, given.strain, noise, 0)
        parts = causes(pair, exact, start, body, options)
        print(f"noise {noise:g}, {given.mesh}'s mesh")
        show(parts, exact, body.mesh, given.places)


def causes(
    pair: ImagePair, exact: ImagePair, start: Result, body: Body, options: FiniteElementOptions
) -> dict[str, FloatArray]:
    """(rows, cols, 2) errors by each cause [px], "all" of them first."""
    assert pair.truth is not None
    true, px = pair.truth.displacement, pair.grid.pixel_size
    found, _ = measured(pair, start, body, options)
    fixed = replace(options, cutoff_px=found.cutoff_px)
    print(f"cut-off wavelength {found.cutoff_px:.1f} px")
    clean, correlation = measured(exact, start, body, fixed)
    best = fitted(true, exact, body, found)
    at = correlation.linearised()
    weight = at.weight(found.cutoff_px * px)
    off = best.ravel() - at.prior.start  # type: ignore[union-attr]
    lost = -at.factor(weight).solve(weight * (at.R @ off)).reshape(-1, 2)
    lost += clean.displacement - correlation.u.reshape(-1, 2)
    of = {
        "all": found.displacement_on() - true,
        "mesh": found.on_pixels(best) - true,
        "smoothing": found.on_pixels(lost),
        "images": found.on_pixels(clean.displacement - best - lost),
        "noise": found.on_pixels(found.displacement - clean.displacement),
    }
    return {name: values / px for name, values in of.items()}


def measured(
    pair: ImagePair, start: Result, body: Body, options: FiniteElementOptions
) -> tuple[NodalResult, MeshCorrelation]:
    """The result, and the correlation at its end."""
    last = LastStage(correlation := started(pair, start, body, options), options)
    for stage in correlation.coarse:
        correlation.through(stage)
    last.regularise()
    return last.result(), correlation


def fitted(true: FloatArray, pair: ImagePair, body: Body, like: NodalResult) -> FloatArray:
    """(n, 2) nodal displacements of the best fit to the truth at the pixels [mm]."""
    pixels, mesh = body.pixels.on(pair.grid, pair.masks[0], pair.reference), body.mesh
    blocks, right = np.zeros((len(mesh.cells), 3, 6, 6)), np.zeros((len(mesh.cells), 6, 2))
    element = np.repeat(np.arange(len(mesh.cells)), np.diff(pixels.start))
    N = shape_functions("T6", pixels.xi.T.astype(np.float64))
    values = true[pixels.row, pixels.col]
    there = np.isfinite(values).all(axis=1)
    N[~there], values[~there] = 0.0, 0.0
    for a in range(6):
        for c in (0, 1):
            right[:, a, c] = np.bincount(element, N[:, a] * values[:, c], len(mesh.cells))
        for b in range(6):
            blocks[:, 0, a, b] = np.bincount(element, N[:, a] * N[:, b], len(mesh.cells))
    blocks[:, 2] = blocks[:, 0]
    M, R = body.matrix(blocks), body.smoothness
    u = like.displacement.ravel()
    # The least smoothness that determines nodes without pixels.
    weight = 1e-9 * body.energies(M) / body.energies(R)
    step = body.factor(M, R, weight).solve(body.vector(right) - M @ u)
    return (u + step).reshape(-1, 2)


def show(parts: dict[str, FloatArray], pair: ImagePair, mesh: Mesh, places: int) -> None:
    """Print errors by cause, and the places of the longest errors."""
    mask = pair.masks[0]
    depth = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    edges = mask & (depth <= EDGE_PX)
    lengths = {name: np.linalg.norm(np.nan_to_num(e), axis=-1) for name, e in parts.items()}
    print("cause       rms, all  rms, edges  longest   > 0.3 px  > 0.5 px  outermost pixels alone")
    outermost = mask & (depth <= 1.0)
    for name, length in lengths.items():
        rms = (np.sqrt(0.5 * np.mean(length[w] ** 2)) for w in (mask, edges))
        counts = [int((length[mask] > limit).sum()) for limit in LONG_PX]
        own = int((length[outermost] > LONG_PX[0]).sum())
        print(
            f"{name:10} {next(rms):9.4f} {next(rms):11.4f} {length[mask].max():8.3f} "
            f"{counts[0]:10d} {counts[1]:9d} {own:9d}"
        )
    inside = locate(mesh.nodes, mesh.cells, mesh.element, pair.grid).mask
    far: NDArray[np.float64] = np.where(mask, lengths["all"], 0.0)
    assert pair.truth is not None
    F = gradient_of(pair.truth.displacement, mask) / pair.grid.pixel_size
    print(
        "   row   col  depth in mesh  |error|  stretches        "
        + "".join(f"{name:>18}" for name in parts)
    )
    for _ in range(places):
        row, col = np.unravel_index(int(far.argmax()), far.shape)
        s = np.linalg.svd(np.eye(2) + F[row, col], compute_uv=False)
        each = "".join(f"   ({e[row, col, 0]:6.3f} {e[row, col, 1]:6.3f})" for e in parts.values())
        print(
            f"{row:6d} {col:5d} {depth[row, col]:5.1f} {inside[row, col]!s:>7} "
            f"{far[row, col]:8.3f}  {s[0]:5.2f} {s[1]:5.2f}     {each}"
        )
        far[max(0, row - APART_PX) : row + APART_PX, max(0, col - APART_PX) : col + APART_PX] = 0.0


def gradient_of(u: FloatArray, mask: BoolArray) -> FloatArray:
    """(rows, cols, 2, 2) du/dX [mm/px], by one-sided differences at edges."""
    u = np.where(mask[..., None], u, np.nan)
    found = np.zeros((*mask.shape, 2, 2))
    for axis, k, sign in ((1, 0, 1.0), (0, 1, -1.0)):
        ahead = np.diff(u, axis=axis, append=np.nan)
        behind = np.roll(ahead, 1, axis=axis)
        both = np.stack([ahead, behind])
        count = np.isfinite(both).sum(axis=0)
        found[..., k] = sign * np.nansum(both, axis=0) / np.maximum(count, 1)
    return found


if __name__ == "__main__":
    main()
