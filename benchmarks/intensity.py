"""Errors of the images' grey levels against the analytic pattern, before they are rounded.

A window of the paper's specimen after buckling (the shipped solution). At some random pixels the
rendered float32 image is compared with the pattern at the material point that the pixel shows,
computed in two ways that share no code with the renderer or with each other:

spectral sum
    Fourier coefficients by matrix products with the binary pattern, then the sum of all plane
    waves, term by term: no fast transform, no interpolation;
quadrature
    the binary pattern times a Gaussian centred on the point, summed in space out to 12 standard
    deviations, which is the trapezoidal rule for the blur's integral.

Then the same window for a sensor whose pixels average over an area behind a lens: the renderer's
rule against 16 x 16 points in every pixel, for pixels within one element and for pixels cut by an
element's edge (where the deformation has a kink); at holes, where material meets background,
against 1597 evenly scattered points (accurate to 0.0011). Tables: docs/explanation/imaging.md.

Run: scripts/env python benchmarks/intensity.py
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from modeharvest.fem.field import Mesh, Solution
from modeharvest.imaging.camera import integrate, near_edges
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.mapping.isoparametric import locate
from modeharvest.imaging.render import ImagedState, render_deformed
from modeharvest.imaging.sensor import Aperture
from modeharvest.imaging.speckle.pattern import Layer, Speckle, SpeckleSpec
from modeharvest.runs.case import shipped_solution

STRAIN = 0.128
WINDOW = PixelGrid(200, 200, 0.01, -1.0, 1.0)  # about one cell of 190 px, with its holes
POINTS = 1000
FloatArray = NDArray[np.float64]


def binary_samples(speckle: Speckle) -> FloatArray:
    """The pattern's two phases before the blur, over its period."""
    return Layer(speckle.spec.binary_field, speckle.shape).binary()


def spectral_sum(speckle: Speckle, row: FloatArray, col: FloatArray) -> FloatArray:
    """(n,) intensities at image positions (row, col), (n,) each [px], as a sum of plane waves."""
    waves = []
    for n in speckle.period:
        k = np.arange(n) - n // 2
        blur = np.exp(-2.0 * (math.pi * speckle.spec.blur_px * k / n) ** 2)
        waves.append((k / n, np.exp(-2j * math.pi * np.outer(k, np.arange(n)) / n), blur / n))
    (f_row, to_row, blur_row), (f_col, to_col, blur_col) = waves
    coefficients = to_row @ binary_samples(speckle) @ to_col.T * np.outer(blur_row, blur_col)
    along_row = np.exp(2j * math.pi * np.outer(row, f_row))
    along_col = np.exp(2j * math.pi * np.outer(col, f_col))
    return np.asarray(((along_row @ coefficients) * along_col).sum(axis=1).real)


def quadrature(speckle: Speckle, row: FloatArray, col: FloatArray) -> FloatArray:
    """(n,) intensities at image positions (row, col), (n,) each [px], as a sum in space."""
    b, binary = speckle.spec.blur_px, binary_samples(speckle)
    reach = np.arange(-math.ceil(12 * b), math.ceil(12 * b) + 1)

    def weights(position: float) -> tuple[NDArray[np.int64], FloatArray]:
        at = math.floor(position) + reach
        return at, np.exp(-0.5 * ((at - position) / b) ** 2) / (b * math.sqrt(2 * math.pi))

    values = []
    for r, c in zip(row, col, strict=True):
        (rows, by_row), (cols, by_col) = weights(r), weights(c)
        part = binary.take(rows, axis=0, mode="wrap").take(cols, axis=1, mode="wrap")
        values.append(by_row @ part @ by_col)
    return np.array(values)


def point_errors(
    mesh: Mesh, displacement: FloatArray, grid: PixelGrid, speckle: Speckle, points: int
) -> dict[str, float]:
    """Largest differences at random pixels of the deformed image [fraction of full scale]."""
    undeformed = locate(mesh.nodes, mesh.cells, mesh.element, grid)
    state = ImagedState(mesh, displacement, grid, speckle, 0.0)
    rendering, truth = render_deformed(state, undeformed)
    some = np.random.default_rng(0).choice(np.flatnonzero(rendering.mask), points)
    X = truth.reference_point.reshape(-1, 2)[some]
    at = grid.to_px(X[:, 0], X[:, 1])
    shown = {
        "image (float32)": rendering.image.ravel()[some].astype(np.float64),
        "image before it becomes float32": speckle(*at),
    }
    routes = {"spectral sum": spectral_sum(speckle, *at), "quadrature": quadrature(speckle, *at)}
    errors = {
        f"{what} - {route}": float(np.abs(a - b).max())
        for what, a in shown.items()
        for route, b in routes.items()
    }
    errors["spectral sum - quadrature"] = float(np.abs(np.subtract(*routes.values())).max())
    return errors


def square_rule(aperture: Aperture, side: int) -> tuple[FloatArray, FloatArray]:
    """Offsets (side^2, 2) [px] and weights of side x side Gauss points."""
    nodes, weights = aperture.rule(side)
    offsets = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    return offsets, np.asarray(np.outer(weights, weights).ravel(), dtype=np.float64)


def aperture_errors(
    imaged: ImagedState, aperture: Aperture, fine: int = 16, finest: int = 1597
) -> tuple[int, dict[str, FloatArray]]:
    """Points per pixel, and the errors of single pixels, by where these lie.

    Errors are against a rule of ``fine`` points a side; at the edges of holes, where a rule for
    smooth functions fails, against ``finest`` evenly scattered points.
    """
    assert imaged.displacement is not None
    mesh, grid = imaged.mesh, imaged.grid
    located = locate(mesh.nodes + imaged.displacement, mesh.cells, mesh.element, grid)
    image, how = integrate(imaged, aperture, located.mask)
    near = near_edges(located.mask, aperture.reach_px)
    size = 2 * aperture.reach_px + 1
    one_element = ndimage.maximum_filter(located.element, size) == ndimage.minimum_filter(
        located.element, size
    )
    even = aperture.scattered(finest), np.full(finest, 1.0 / finest)
    groups = {
        "within one element": (located.mask & ~near & one_element, square_rule(aperture, fine)),
        "cut by an element's edge": (
            located.mask & ~near & ~one_element, square_rule(aperture, fine),
        ),
        "at a hole's edge": (near, even),
    }  # fmt: skip
    errors = {
        name: image[where] - imaged.average(*rule, where) for name, (where, rule) in groups.items()
    }
    return how.points, errors


def part_in(grid: PixelGrid, mesh: Mesh, displacement: FloatArray) -> Mesh:
    """The mesh without the elements that lie outside a grid by more than 0.3 mm if deformed."""
    left, right, bottom, top = np.add(grid.extent, [-0.3, 0.3, -0.3, 0.3])
    x, y = (mesh.nodes + displacement)[mesh.cells].transpose(2, 0, 1)
    inside = ((x > left) & (x < right) & (y > bottom) & (y < top)).any(axis=1)
    return Mesh(mesh.nodes, mesh.cells[inside], mesh.element)


def main() -> None:
    path = shipped_solution("paper-virtual")
    solution = Solution.read(path)
    mesh, u = solution.mesh, solution.at(STRAIN).displacement
    mesh = part_in(WINDOW, mesh, u)
    speckle = Speckle(SpeckleSpec(), WINDOW.shape)
    print(f"{WINDOW.rows} x {WINDOW.cols} px of the paper's specimen at {100 * STRAIN:.1f} %\n")
    print(f"| points, {POINTS} random pixels | largest difference [of full scale] |\n|---|---|")
    for what, error in point_errors(mesh, u, WINDOW, speckle, POINTS).items():
        print(f"| {what} | {error:.1e} |")
    imaged = ImagedState(mesh, u, WINDOW, speckle, 0.0)
    print("\n| averages over pixels | points/px | where | pixels | rms error | largest |")
    print("|---|---|---|---|---|---|")
    for aperture in (Aperture(1.0), Aperture(0.8, 0.5)):
        points, errors = aperture_errors(imaged, aperture)
        name = f"fill factor {aperture.fill_factor:g}, point spread {aperture.psf_px:g} px"
        for where, e in errors.items():
            rms, largest = float(np.sqrt((e**2).mean())), float(np.abs(e).max())
            at = points if "hole" not in where else len(aperture.scattered())
            print(f"| {name} | {at} | {where} | {e.size} | {rms:.1e} | {largest:.1e} |")


if __name__ == "__main__":
    main()
