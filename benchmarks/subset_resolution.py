"""Resolution and noise of DIC on the star of DIC Challenge 2.0, measured and by theory.

pyvale (``MODEHARVEST_PYVALE``, see docs/how-to/fields.md) measures the star with subsets of several
sizes, and its fields are graded like any others. l10 is the period at which 10 % of a wave is lost,
n the noise floor. Theory: l10 by Savitzky and Golay's weights, and

    n = sqrt(2) s / (w G),   G^2 the mean squared gradient of the speckle along y,

for an affine subset of w x w px, more for a quadratic one. Both assume an even speckle. In others a
correlation weights each pixel of a subset by its gradient ("this speckle"), which causes the
pattern-induced bias; such fits are graded, too. Tables: docs/explanation/resolution.md.

With ``--cutoffs`` the whole displacement is measured instead, with cut-off wavelengths l, or the
one found from the deformed image ("found"), which is also used for the image without motion. Theory
of its smoothing, T = 1/(1 + (l/p)^6):

    l10 = 9^(1/6) l,    n = sqrt(2) s/(l G) sqrt(4 pi^2/(9 sqrt(3))).

Printed are then means and standard deviations over four meshes, which begin a quarter of an element
apart: elements hold waves of their own length more or less, depending on where they lie.

``python benchmarks/subset_resolution.py`` (2 minutes of processor time; --out keeps all files).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve, savgol_coeffs

from modeharvest.idic.chebyshev import orders
from modeharvest.idic.finite_element.measure import FiniteElementOptions, measure_displacement
from modeharvest.idic.local.field import LocalField, write_field
from modeharvest.idic.local.subsets import SubsetOptions, subset_field
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.files import read_image
from modeharvest.imaging.speckle.pattern import Speckle
from modeharvest.report.grades import star_report, write_grading
from modeharvest.report.model.output import print_report
from modeharvest.validation.scoring.star import Star, StarSet, StarSpec, image_name, make_star_set
from modeharvest.validation.scoring.star_grades import (
    Attenuation,
    StarGrade,
    StarGrading,
    ranked_grades,
)
from modeharvest.validation.studies.transfer import finest_period

FloatArray = NDArray[np.float64]

DEGREES = {"rigid": 0, "affine": 1, "quad": 2}


def main() -> None:
    """Measure, grade, and compare with theory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--widths", type=int, nargs="+", default=[11, 17, 25])
    parser.add_argument("--shapes", nargs="+", default=["affine"], choices=list(DEGREES))
    parser.add_argument("--cutoffs", nargs="+", help='of the whole displacement [px], or "found"')
    parser.add_argument("--elements", type=float, default=24.0, help="edge length of its [px]")
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--band", type=int, default=40, help="rows beside the centre row")
    parser.add_argument("--step", type=int, default=5)
    parser.add_argument("--theory", action="store_true", help="exact filters instead of pyvale")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.theory:
        grade_filters(options.shapes, options.widths)
        return
    with tempfile.TemporaryDirectory() as name:
        out = options.out or Path(name)
        star_set = make_star_set(StarSpec(noise=(options.noise,)), out / "star")
        if options.cutoffs:
            grade_whole(star_set, options)
            return
        grades = {
            (shape, width): grade(star_set, shape, width, options)
            for shape in options.shapes
            for width in options.widths
        }
        grading = StarGrading(star_set, tuple(ranked_grades(list(grades.values()))))
        write_grading(out / "graded", grading)
        print_report(star_report(grading), out / "graded")
    expected = ["theory", "this speckle"]
    columns = ["subset", "l10 [px]", *expected, "n [10⁻³ px]", *expected, "n l10 [px²]", *expected]
    print(f"| {' | '.join(columns)} |", "|---" * len(columns) + "|", sep="\n")
    for (shape, width), graded in grades.items():
        print(row(star_set, shape, width, options.noise, graded))


def grade(star_set: StarSet, shape: str, width: int, options: argparse.Namespace) -> StarGrade:
    """Measure with and without motion, under noise, along the middle of the image."""
    star = star_set.spec.star
    how = SubsetOptions(width, options.step, shape, largest_px=2)
    mask = np.zeros((star.rows, star.cols), dtype=np.bool_)
    reach = options.band + width // 2
    mask[star.centre_row - reach : star.centre_row + reach + 1] = True
    f = read_image(star_set.folder / image_name("reference", options.noise))
    fields: list[LocalField] = []
    for role in ("deformed", "still"):
        g = read_image(star_set.folder / image_name(role, options.noise))
        measured = subset_field(ImagePair(f, g, star.grid, mask), how)
        named = LocalField(
            measured.x, measured.y, measured.u, measured.valid, source=f"{shape}, {width} px"
        )
        write_field(star_set.folder.parent / "fields" / f"{shape}_{width}_{role}.csv", named)
        fields.append(named)
    return StarGrade(star, *fields)


MARGIN_PX = 100
"""Rows measured beyond the graded ones, up to the body's edges; half as many columns are not
graded at the image's ends."""


MESHES = 4
"""Number of meshes; each begins a quarter of an element's length above the one before."""


def grade_whole(star_set: StarSet, options: argparse.Namespace) -> None:
    """Measure the whole displacement with and without motion; print resolution and noise."""
    star = star_set.spec.star
    rows = slice(star.centre_row - options.band, star.centre_row + options.band + 1, options.step)
    row, col = np.mgrid[rows, MARGIN_PX // 2 : star.cols - MARGIN_PX // 2 : options.step]
    x, y = star.grid.to_mm(row.ravel(), col.ravel())
    f, moved, still = (
        read_image(star_set.folder / image_name(role, options.noise))
        for role in ("reference", "deformed", "still")
    )
    how = FiniteElementOptions(options.elements, min(12.0, options.elements))
    masks = np.zeros((MESHES, star.rows, star.cols), dtype=np.bool_)
    for k, mask in enumerate(masks):
        reach = options.band + MARGIN_PX + round(k * options.elements / MESHES)
        mask[star.centre_row - reach : star.centre_row + reach + 1] = True
    bodies = [how.body(mask, star.grid) for mask in masks]
    slope = float(np.sqrt(np.mean(slopes(star_set)[0] ** 2)))
    level = np.sqrt(2.0) * np.hypot(options.noise, _rounding(star_set)) / slope
    print("| ℓ [px] | l10 [px] | theory | n [10⁻³ px] | theory | n l10 [px²] | theory |")
    print("|---" * 7 + "|")
    for wanted in options.cutoffs:
        given = None if wanted == "found" else float(wanted)
        found: list[tuple[float, ...]] = []
        for mask, body in zip(masks, bodies, strict=True):
            cutoff, fields = given, []
            for g in (moved, still):
                measured = measure_displacement(
                    ImagePair(f, g, star.grid, mask), np.zeros_like, body,
                    options=replace(how, cutoff_px=cutoff),
                )  # fmt: skip
                cutoff, u = measured.cutoff_px, measured.displacement_on()[row, col]
                fields.append(LocalField(x, y, u.reshape(-1, 2), source=f"l = {wanted}"))
            graded = StarGrade(star, *fields)
            assert graded.noise is not None
            assert cutoff is not None
            at, n = graded.attenuation, graded.noise
            found.append((cutoff, at.finest_px, 1e3 * n.v_px, graded.indicator_px2))
        cutoff, *mean = np.nanmean(found, axis=0)
        sd = np.nanstd(found, axis=0, ddof=1)[1:]
        finest, floor = 9.0 ** (1.0 / 6.0) * cutoff, level / cutoff * FLOOR
        cells = [f"{cutoff:.1f}" + " (found)" * (wanted == "found")]
        if count := sum(np.isnan(l10) for _, l10, _, _ in found):
            cells[0] += f", {MESHES - count} meshes"  # others keep 0.9 of all waves, or of none
        for of, by, theory, digits in zip(
            mean, sd, (finest, 1e3 * floor, floor * finest), (1, 2, 3), strict=True
        ):
            cells += [f"{of:.{digits}f} ± {by:.{digits}f}", f"{theory:.{digits}f}"]
        print(f"| {' | '.join(cells)} |", flush=True)


FLOOR = float(np.sqrt(4.0 * np.pi**2 / (9.0 * np.sqrt(3.0))))
"""Root of the integral of T^2 over all wave vectors, times l [-]."""


def grade_filters(shapes: list[str], widths: list[int]) -> None:
    """Print l10 of exact filters: theory, the smoothed curve, and the Challenge's method."""
    star = Star()
    row, col = np.indices((star.rows, star.cols))
    true = star.down(row, col)
    print("| subset | theory [px] | smoothed curve | centre row, degree 12 |", "|---|---|---|---|",
          sep="\n")  # fmt: skip
    for shape, width in product(shapes, widths):
        degree, half = DEGREES[shape], width // 2
        x, y = np.meshgrid(*[np.arange(-half, half + 1.0)] * 2)
        basis = np.stack([(x**i * y**j).ravel() for i, j in orders(degree)], axis=-1)
        kernel = np.linalg.pinv(basis)[0].reshape(width, width)
        v = fftconvolve(true, kernel, mode="valid")
        at = star.grid.to_mm(
            row[half:-half, half:-half].ravel(), col[half:-half, half:-half].ravel()
        )
        u = np.column_stack([np.zeros(v.size), -v.ravel()])
        found = Attenuation.of(star, LocalField(*at, u, source=shape))
        finest = finest_period(lambda p, w=width, d=degree: subset_transfer(w, d, p), 4.0, 2000.0)
        print(f"| {shape}, {width} px | {finest:.2f} | {found.finest_px:.2f} | "
              f"{found.challenge_px:.2f} |")  # fmt: skip


def subset_transfer(width: int, degree: int, period: FloatArray) -> FloatArray:
    """(...) T at the centre of a subset, for waves along one of its edges [-]."""
    offsets = np.arange(width) - width // 2
    phase = 2.0 * np.pi * offsets / np.asarray(period)[..., None]
    return np.asarray(np.cos(phase) @ savgol_coeffs(width, degree))


def subset_noise(width: int, degree: int) -> float:
    """Noise floor at the centre of a subset on even speckle, over sqrt(2) s / G [1/px]."""
    t = np.linspace(-1.0, 1.0, width)
    x, y = (a.ravel() for a in np.meshgrid(t, t))
    basis = np.stack([x**i * y**j for i, j in orders(degree)], axis=-1)
    return float(np.sqrt(np.linalg.inv(basis.T @ basis)[0, 0]))


@cache
def slopes(star_set: StarSet) -> FloatArray:
    """(2, rows, cols) exact derivatives of the speckle down and along x [1/px]."""
    star = star_set.spec.star
    row, col = np.indices((star.rows, star.cols)).astype(float)
    return Speckle(star_set.spec.speckle, row.shape).gradient(row, col)


def weighted(star_set: StarSet, degree: int, width: int, at: LocalField) -> LocalField:
    """Fits of a subset's shape functions to the true displacement, weighted by the gradient.

    The normal equations of Gauss and Newton at the points of a field, with the standard deviations
    of v for a noise of 1 in one image.
    """
    star, half = star_set.spec.star, width // 2
    g_y, g_x = slopes(star_set)
    row, col = np.indices(g_y.shape)
    true = star.down(row, col)
    y, x = (o.ravel().astype(float) for o in np.mgrid[-half : half + 1, -half : half + 1])
    shapes = [x**i * y**j for i, j in orders(degree)]
    basis = np.stack(shapes, axis=-1)
    v, sd = np.empty((2, at.x.size))
    for k, (r, c) in enumerate(zip(*(np.rint(i).astype(int) for i in star.grid.to_px(at.x, at.y)),
                                   strict=True)):  # fmt: skip
        here = np.s_[r - half : r + half + 1, c - half : c + half + 1]
        along_x, along_y = g_x[here].ravel()[:, None], g_y[here].ravel()[:, None]
        J = np.hstack([along_x * basis, along_y * basis])
        seen = along_y[:, 0] * true[here].ravel()
        inverse = np.linalg.inv(J.T @ J)
        v[k] = (inverse @ (J.T @ seen))[len(shapes)]
        sd[k] = np.sqrt(inverse[len(shapes), len(shapes)])
    u = np.column_stack([0.0 * v, -v])
    return LocalField(at.x, at.y, u, sd=np.column_stack([sd, sd]), source="weighted")


def _rounding(star_set: StarSet) -> float:
    """Standard deviation of rounding to the set's number of bits [of full scale]."""
    return float(1.0 / np.sqrt(12.0) / (2**star_set.spec.bits - 1))


def row(star_set: StarSet, shape: str, width: int, noise: float, graded: StarGrade) -> str:
    """A row of the table of subsets."""
    star, degree = star_set.spec.star, DEGREES[shape]
    finest = finest_period(lambda p: subset_transfer(width, degree, p), 4.0, 2000.0)
    fitted = weighted(star_set, degree, width, graded.moved)
    here = Attenuation.of(star, fitted)
    slope = float(np.sqrt(np.mean(slopes(star_set)[0] ** 2)))
    both = np.sqrt(2.0) * np.hypot(noise, _rounding(star_set))
    floor = both / slope * subset_noise(width, degree)
    found = graded.attenuation
    assert graded.noise is not None
    cells = [
        f"{shape}, {width} px",
        f"{found.finest_px:.1f} ± {found.finest_se_px:.1f}",
        f"{finest:.1f}",
        f"{here.finest_px:.1f} ± {here.finest_se_px:.1f}",
        f"{1e3 * graded.noise.v_px:.2f} ± {1e3 * graded.noise.v_se_px:.2f}",
        f"{1e3 * floor:.2f}",
        f"{1e3 * both * fitted.sd_rms:.2f}",
        f"{graded.indicator_px2:.3f} ± {graded.indicator_se_px2:.3f}",
        f"{floor * finest:.3f}",
        f"{both * fitted.sd_rms * here.finest_px:.3f}",
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
