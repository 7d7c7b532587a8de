"""Convergence of the correlation from initial guesses with wrong parameters of the mode.

The paper's case after buckling (12.8 %), noise-free images at its resolution. All seven parameters
of the mode are changed at once: a1 ... a5 by up to a share of 1, the two phases by up to that share
of the unit cell; at random within the box, and at random corners of it. v0 starts with the applied
strain, v1 with a constant, as always. A result is *the same* as that of the standard guess if the
displacements are less than 0.01 px rms apart. Table: docs/explanation/metrology.md.

The images are made once, in out/initial_guesses, with a file of the results, from which a run
continues. Remove that file (initial_guesses-....json) after a change of the solver.

Run: scripts/env python benchmarks/initial_guesses.py [--quick] [--count 16] [--picture FILE]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest.fem.field import Solution
from modeharvest.idic.correlate import correlate
from modeharvest.idic.result import Result
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.report.figures.style import BLUE, GREEN, RED, figure
from modeharvest.runs.case import Case, shipped_solution
from modeharvest.util.files import atomic, read_json, write_json

FloatArray = NDArray[np.float64]

FOLDER = Path("out/initial_guesses")
STRAIN = 0.128
RADII = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)
SAME_PX = 0.01
EVERY = 4
"""Displacements are compared at every fourth pixel, because they are smooth."""
QUICK_PIXEL = 0.04


@dataclass(frozen=True)
class End:
    """Result of one initial guess.

    Parameters
    ----------
    radius
        Largest change of a parameter [share of 1, or of a unit cell].
    corner
        Whether all parameters are changed by that much, or by a random part of it.
    distance_px
        From the result of the standard guess, rms length [px].
    start_distance_px
        Distance of the initial guess from that result, rms length [px].
    outcome
        Outcome of the correlation.
    iterations, all_iterations
        On the full image, and on all levels.
    residual
        Rms residual [fraction of full scale].
    seconds
        Wall-clock time [s].
    """

    radius: float
    corner: bool
    distance_px: float
    start_distance_px: float
    outcome: str
    iterations: int
    all_iterations: int
    residual: float
    seconds: float

    @property
    def is_same(self) -> bool:
        """Whether the end is the minimum of the standard guess."""
        return self.distance_px < SAME_PX


class Map:
    """The images of the paper's case, and correlations of them from many initial guesses."""

    def __init__(self, pixel_size: float) -> None:
        case, path = Case(), shipped_solution("paper-virtual")
        spec = replace(case.imaging, pixel_size=pixel_size)
        folder = FOLDER / f"images-{1000 * pixel_size:g}um"
        images = make_images(Solution.read(path), spec, folder, (STRAIN,))
        self.pitch = case.experiment.specimen.pitch
        self.how = case.correlation
        self.ansatz = self.how.ansatz(case.experiment.specimen)
        self.standard = self.ansatz.initial_guess(STRAIN, self.how.start_amplitude)
        self.grid = images.grid
        self._input = self._read(images)

    @staticmethod
    def _read(images: ImageSet) -> tuple[NDArray[Any], ...]:
        return (images.reference(), images.deformed(STRAIN), images.mask(),
                images.deformed_mask(STRAIN))  # fmt: skip

    def correlate(self, start: FloatArray) -> Result:
        """Correlate as the case says, from another initial guess."""
        f, g, mask, deformed_mask = self._input
        options = self.how.options()
        return correlate(
            ImagePair(f, g, self.grid, mask, deformed_mask),
            self.ansatz,
            guess=start,
            options=options,
        )

    def disturbed(self, radius: float, corner: bool, seed: int) -> FloatArray:
        """Change the mode's parameters, in the same directions for every radius."""
        rng = np.random.default_rng(seed)
        unit = rng.choice([-1.0, 1.0], 7) if corner else rng.uniform(-1.0, 1.0, 7)
        start = self.standard.copy()
        start[self.ansatz.phi_slice(0)] += radius * unit * np.array([1.0] * 5 + [self.pitch] * 2)
        return start

    def field(self, a: FloatArray) -> FloatArray:
        """(points, 2) displacement at some pixels of the material [px]."""
        some = (slice(None, None, EVERY), slice(None, None, EVERY))
        u = self.ansatz.displacement(a, self.grid.x[::EVERY], self.grid.y[::EVERY])
        return np.asarray(u[self._input[2][some]] / self.grid.pixel_size)

    def apart(self, one: FloatArray, other: FloatArray) -> float:
        """Rms length of the difference of two fields [px]."""
        return float(np.sqrt(((one - other) ** 2).sum(axis=-1).mean()))


def wanted(count: int) -> Iterator[tuple[float, bool, int]]:
    """Radius, whether a corner, and seed of every initial guess."""
    for radius in RADII:
        for seed in range(count):
            yield radius, seed % 2 == 1, seed


def explore(pixel_size: float, count: int, record: Path) -> list[End]:
    """Correlate from every initial guess that is not in the file of results yet."""
    done: dict[str, Any] = read_json(record) if record.is_file() else {}
    where = Map(pixel_size)
    nominal = where.correlate(where.standard)
    at_nominal = where.field(nominal.unknowns)
    ends = []
    for radius, corner, seed in wanted(count):
        key = f"{radius:g} {seed}"
        if key not in done:
            start = where.disturbed(radius, corner, seed)
            begin = time.perf_counter()
            found = where.correlate(start)
            end = End(
                radius=radius,
                corner=corner,
                distance_px=where.apart(where.field(found.unknowns), at_nominal),
                start_distance_px=where.apart(where.field(start), at_nominal),
                outcome=found.outcome.value,
                iterations=found.iterations,
                all_iterations=len(found.history),
                residual=found.residual_rms,
                seconds=time.perf_counter() - begin,
            )
            done[key] = asdict(end)
            write_json(record, done)
            print(f"{100 * radius:3.0f} % {'corner' if corner else 'inside'}  {end.outcome:14} "
                  f"{end.distance_px:.2g} px", file=sys.stderr, flush=True)  # fmt: skip
        ends.append(End(**done[key]))
    return ends


def tell(ends: list[End]) -> None:
    """Print the table."""
    print("| off by | initial guesses | distance of the guess, largest [px] | same end: inside, "
          "corners | local minimum, recognised | other end, called converged | iterations on the "
          "full image | largest distance among the same [px] |\n"
          "|---|---|---|---|---|---|---|---|")  # fmt: skip
    for radius in RADII:
        at = [e for e in ends if e.radius == radius]
        same = [e for e in at if e.is_same]
        lost = [e for e in at if not e.is_same]
        inside, corners = ([e for e in at if e.corner is corner] for corner in (False, True))
        unnoticed = sum(e.outcome == "converged" for e in lost)
        print(f"| ±{100 * radius:.0f} % | {len(at)} | {max(e.start_distance_px for e in at):.1f} | "
              f"{share(inside)}, {share(corners)} | {len(lost) - unnoticed} of {len(lost)} | "
              f"{unnoticed} | {span([e.iterations for e in same])} | "
              f"{max((e.distance_px for e in same), default=float('nan')):.1g} |")  # fmt: skip


def share(ends: list[End]) -> str:
    return f"{sum(e.is_same for e in ends)} of {len(ends)}"


def span(counts: list[int]) -> str:
    return f"{min(counts)} – {max(counts)}" if counts else "–"


def draw(ends: list[End], path: Path) -> None:
    """Draw the shares of initial guesses over the radius."""
    made = figure(5.0, 3.6)
    axes = made.add_subplot()
    percent = [100 * r for r in RADII]

    def shares(which: list[End], good: Any) -> list[float]:
        by_radius = [[e for e in which if e.radius == r] for r in RADII]
        return [100 * sum(map(good, at)) / len(at) for at in by_radius]

    inside, corners = ([e for e in ends if e.corner is corner] for corner in (False, True))
    axes.plot(percent, shares(inside, lambda e: e.is_same), "o-", color=BLUE,
              label="same minimum, initial guesses within the box")  # fmt: skip
    axes.plot(percent, shares(corners, lambda e: e.is_same), "s-", color=GREEN,
              label="same minimum, corners of the box")  # fmt: skip
    unnoticed = shares(ends, lambda e: not e.is_same and e.outcome == "converged")
    axes.plot(percent, unnoticed, "x--", color=RED, label="another end, not recognised")
    axes.set(xlabel="all seven mode parameters off by up to [%]", ylabel="initial guesses [%]",
             ylim=(-3, 103), xlim=(0, None))  # fmt: skip
    axes.grid(alpha=0.25)
    made.legend(*axes.get_legend_handles_labels(), frameon=False, loc="upper left", fontsize=8)
    made.tight_layout(rect=(0, 0, 1, 0.82))
    made.patch.set_facecolor("white")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary:
        made.savefig(temporary, format="png", dpi=150, facecolor="white")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--quick", action="store_true", help="images of 0.04 mm/px")
    parser.add_argument("--count", type=int, default=16, help="initial guesses for each radius")
    parser.add_argument("--picture", type=Path, help="PNG; by default beside the record")
    options = parser.parse_args()
    pixel_size = QUICK_PIXEL if options.quick else Case().imaging.pixel_size
    record = FOLDER / f"initial_guesses-{1000 * pixel_size:g}um.json"
    record.parent.mkdir(parents=True, exist_ok=True)
    ends = explore(pixel_size, options.count, record)
    tell(ends)
    picture = options.picture or record.with_suffix(".png")
    draw(ends, picture)
    print(f"\npicture: {picture}")


if __name__ == "__main__":
    main()
