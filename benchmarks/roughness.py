"""Smoothness with less weight where the displacement is rough, against uniform weights.

On the specimens of cutoff.py: two pixel sizes, 8-bit images and images with 1 and 2 % of noise,
speckles of 4, 8 and 12 px. After the usual measurement, jumps across sides are weighted by the
inverse of their mean square around there, to a power, and the cut-off wavelength is found again
(for splines: C. Storlie et al., J. Comput. Graph. Stat. 19 (2010)). For each power: errors over
those without weights (rms per component of all material and within 10 px of edges, 99.9 % quantile,
longest) as geometric means and ranges over the cases; coverage of 95 % intervals; ratio of times.
Table: docs/explanation/whole_field_alternatives.md.

Run: scripts/env python benchmarks/roughness.py [--power 0.5 1] [--noise 0 0.01 0.02]
     [--speckle 4 8 12] [--pixel 0.01 0.02]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from cutoff import SPECIMENS, cases
from scipy import ndimage
from scipy.sparse import csr_array
from whole_field import EDGE_PX

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import Ansatz, AnsatzOptions
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.finite_element.correlation import COARSE
from modeharvest.idic.finite_element.equations.system import (
    Body,
    Smoothness,
    SmoothnessRoots,
    interior_sides,
)
from modeharvest.idic.finite_element.measure import FiniteElementOptions, LastStage, started
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.arrays import FloatArray

AROUND, CONTRAST = 2, 100.0
"""Layers of elements over which roughness is averaged; largest weight, and 1 over the least."""
NAMES = ("all", "edges", "99.9 %", "longest")


class Weighed(Smoothness):
    """Smoothness on a body with less weight where displacements ``like`` (n, 2) are rough."""

    def __init__(self, body: Body, start: FloatArray, like: FloatArray, power: float) -> None:
        super().__init__(body, start)
        roots, corners = SmoothnessRoots.of(body.mesh), body.mesh.nodes[body.mesh.cells[:, :3]]
        areas = 0.5 * np.abs(np.linalg.det(np.diff(corners, axis=1)))
        first, _, second, _ = interior_sides(body.mesh.cells).T
        (count, k), area = roots.nodes.shape, areas[first] + areas[second]
        begin, one = np.arange(0, roots.nodes.size + 1, k), np.ones(roots.nodes.size)
        on = csr_array((one, roots.nodes.ravel(), begin), (count, roots.size))
        jumps = np.einsum("skc,skd->scd", roots.roots, (like - start)[roots.nodes])
        both = np.stack([(jumps**2).sum(axis=(1, 2)), area], axis=1)
        for _ in range(AROUND):
            both = on @ (on.T @ both)
        rough = np.maximum(both[:, 0] / both[:, 1], np.finfo(float).tiny)
        usual = np.exp(np.average(np.log(rough), weights=area))
        weight = np.clip((usual / rough) ** power, 1.0 / CONTRAST, CONTRAST)
        weighed = roots._replace(roots=np.sqrt(weight)[:, None, None] * roots.roots)
        self.matrix = weighed.matrix(body.pattern)

    def linearised(self, u: FloatArray) -> tuple[csr_array, FloatArray]:
        """(2 n, 2 n) R and (2 n,) R(u - u_0)."""
        return self.matrix, self.matrix @ (u - self.start)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--power", type=float, nargs="+", default=[0.5, 1.0])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.01, 0.02])
    parser.add_argument("--speckle", type=float, nargs="+", default=[4.0, 8.0, 12.0])
    parser.add_argument("--pixel", type=float, nargs="+", default=[0.01, 0.02])
    given = parser.parse_args()
    print("specimen, pixel [mm], speckle [px], noise, power (0: as it is): cut-off [px], errors "
          f"({', '.join(NAMES)}) [px], 95 % intervals hold (all, edges), s")  # fmt: skip
    found = []
    for name, pixel, width, noise, pair in cases(given.pixel, given.speckle, given.noise):
        case = {}
        for power, row in rows(pair, SPECIMENS[name][0], given.power):
            case[power] = row
            what = f"{name:22s} {pixel:5.3f} {width:4.0f} {noise:6.3f} {power:4.2f}"
            print(what, *(f"{v:8.4g}" for v in row), flush=True)
        found.append(case)
    for power in given.power:
        ratios = np.array([case[power] / case[0.0] for case in found])
        means = np.exp(np.log(ratios).mean(axis=0))
        covered = np.array([case[power] for case in found])
        print(f"power {power:g}, {len(found)} cases, over those without weights:")
        for k, what in enumerate(NAMES, 1):
            print(f"  {what:8s} {means[k]:5.2f} ({ratios[:, k].min():.2f} ... "
                  f"{ratios[:, k].max():.2f})")  # fmt: skip
        for k, what in ((5, "all"), (6, "edges")):
            before = np.array([case[0.0][k] for case in found])
            print(f"  intervals hold, {what}: {covered[:, k].mean():.3f} (at least "
                  f"{covered[:, k].min():.3f}); without {before.mean():.3f} "
                  f"({before.min():.3f})")  # fmt: skip
        print(f"  time     {means[7]:5.2f}")


def rows(
    pair: ImagePair, specimen: Specimen, powers: list[float]
) -> list[tuple[float, FloatArray]]:
    """Numbers of the usual measurement, power 0, and of those that continue from it."""
    assert pair.truth is not None
    ansatz, options = (
        Ansatz.of_specimen(specimen, options=AnsatzOptions(4, 3)),
        FiniteElementOptions(),
    )
    guess = ansatz.initial_guess(pair.strain)
    start = fit_displacement(pair.truth.displacement, pair.grid, ansatz, guess, pair.mask)
    body, begin = options.body(pair.masks[0], pair.grid), time.perf_counter()
    course = LastStage(correlation := started(pair, start, body, options), options)
    for stage in COARSE:
        correlation.through(stage)
    course.regularise()
    taken = time.perf_counter() - begin
    found, cutoff = [(0.0, numbers(course, pair, taken))], course.cutoff_px
    u = correlation.u.copy()
    for power in powers:
        begin = time.perf_counter()
        weighed = Weighed(body, correlation.start, u.reshape(-1, 2), power)
        correlation.regularised_by(weighed, u.copy())
        course.with_cutoff(cutoff, None)
        more = time.perf_counter() - begin
        found.append((power, numbers(course, pair, taken + more)))
    return found


def numbers(course: LastStage, pair: ImagePair, seconds: float) -> FloatArray:
    """Cut-off wavelength and errors [px], coverage of 95 % intervals, seconds."""
    assert pair.truth is not None
    found, px, mask = course.result(), pair.grid.pixel_size, pair.masks[0]
    error = (found.displacement_on() - pair.truth.displacement) / px
    holds = np.abs(error) < 1.96 * found.standard_deviation_on() / px
    edges = mask & (ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] <= EDGE_PX)
    length = np.linalg.norm(error[mask], axis=1)
    rms = (np.sqrt(np.mean(error[where] ** 2)) for where in (mask, edges))
    return np.array([
        course.cutoff_px, *rms, np.quantile(length, 0.999), length.max(),
        holds[mask].mean(), holds[edges].mean(), seconds,
    ])  # fmt: skip


if __name__ == "__main__":
    main()
