"""A local DIC on the star of DIC Challenge 2.0: what theory says of its subsets, and what it does.

pyvale, or whatever ``MODEHARVEST_PYVALE`` names (docs/fields.md), measures the star with subsets of
several sizes; its fields are graded as anybody's. Theory: l10 by Savitzky and Golay's weights, and

    n = sqrt(2) s / (w G),   G^2 the mean squared gradient of the speckle along y,

for a subset of w x w px whose displacement at the centre is a mean of w^2 px (affine, rigid).

``python benchmarks/subset_resolution.py`` (4 minutes of processor time; --out keeps all files).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from modeharvest.idic.fields.files import write_field
from modeharvest.idic.fields.local_field import LocalField
from modeharvest.idic.fields.subsets import SubsetOptions, subset_field
from modeharvest.imaging.io import read_image
from modeharvest.imaging.speckle import Speckle
from modeharvest.validation.resolution.graded import print_star_grading
from modeharvest.validation.resolution.grading import StarGrade, ranked
from modeharvest.validation.resolution.star_report import StarGrading, write_star_grading
from modeharvest.validation.resolution.star_set import (
    StarSet,
    StarSpec,
    image_name,
    make_star_set,
)
from modeharvest.validation.resolution.transfer import finest_period, subset_transfer

DEGREES = {"rigid": 0, "affine": 1, "quad": 2}


def main() -> None:
    """Measure, grade, and set against theory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--widths", type=int, nargs="+", default=[11, 17, 25])
    parser.add_argument("--shapes", nargs="+", default=["affine"], choices=list(DEGREES))
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--band", type=int, default=40, help="rows beside the centre row")
    parser.add_argument("--step", type=int, default=5)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        out = options.out or Path(name)
        star_set = make_star_set(StarSpec(noise=(options.noise,)), out / "star")
        grades = {
            (shape, width): grade(star_set, shape, width, options)
            for shape in options.shapes
            for width in options.widths
        }
        grading = StarGrading(star_set, tuple(ranked(list(grades.values()))))
        write_star_grading(out / "graded", grading)
        print_star_grading(grading, out / "graded")
    print("| subset | l10 [px] | theory | n [10⁻³ px] | theory | n l10 [px²] | theory |")
    print("|---|---|---|---|---|---|---|")
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
        measured = subset_field(f, g, star.grid, mask, options=how)
        named = LocalField(
            measured.x, measured.y, measured.u, measured.valid, source=f"{shape}, {width} px"
        )
        write_field(star_set.folder.parent / "fields" / f"{shape}_{width}_{role}.csv", named)
        fields.append(named)
    return StarGrade(star, *fields)


def row(star_set: StarSet, shape: str, width: int, noise: float, graded: StarGrade) -> str:
    """A row of the table."""
    star = star_set.spec.star
    finest = finest_period(lambda p: subset_transfer(width, DEGREES[shape], p), 4.0, 2000.0)
    speckle = Speckle(star_set.spec.speckle, (star.rows, star.cols))
    rows, cols = (a.astype(float) for a in np.mgrid[200:300:3, 0 : star.cols : 5])
    slope = float(np.sqrt(np.mean(speckle.gradient(rows, cols)[0] ** 2)))
    rounding = 1.0 / np.sqrt(12.0) / (2**star_set.spec.bits - 1)
    floor = np.sqrt(2.0) * np.hypot(noise, rounding) / (width * slope)
    found = graded.attenuation
    assert graded.noise is not None
    cells = [
        f"{shape}, {width} px",
        f"{found.finest_px:.1f} ± {found.finest_se_px:.1f}",
        f"{finest:.1f}",
        f"{1e3 * graded.noise.v_px:.2f} ± {1e3 * graded.noise.v_se_px:.2f}",
        f"{1e3 * floor:.2f}" if shape != "quad" else "–",
        f"{graded.indicator_px2:.3f} ± {graded.indicator_se_px2:.3f}",
        f"{floor * finest:.3f}" if shape != "quad" else "–",
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
