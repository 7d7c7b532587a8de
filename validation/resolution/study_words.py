"""The sentences of a resolution study."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from modeharvest.validation.resolution.curves import Curves, Passband
from modeharvest.validation.resolution.degrees import Degree
from modeharvest.validation.resolution.measure import Subject

_KEPT = 0.85
"""Share of a wave that is found, from which on images are set against best fits apart [-]."""


@dataclass(frozen=True, eq=False)
class Answers:
    """What a resolution study has found.

    Parameters
    ----------
    subject
        What was measured.
    degrees, chosen
        All degrees, and the one that is told of most: that of the subject's own v0.
    curves, passband
        Best fits of waves, and of patterns of other wavelengths.
    waves, floors
        Tables: images against best fits, scatter against covariance.
    local_px2
        The indicator of an affine subset [px^2].
    """

    subject: Subject
    degrees: list[Degree]
    chosen: Degree
    curves: Curves
    passband: Passband
    waves: pd.DataFrame
    floors: pd.DataFrame
    local_px2: float

    @property
    def sentences(self) -> tuple[str, ...]:
        """The same in words, the most important first."""
        return (
            self._finest,
            self._trade_off,
            self._product,
            "What a degree gains in resolution it costs in noise, so the indicator does not "
            "choose: take the smallest degree whose period is below what v0 and v1 are expected "
            "to show.",
            *([self._images] if len(self.waves) else []),
            *([self._noise] if len(self.floors) else []),
            self._pattern,
        )

    @property
    def _pitch_px(self) -> float:
        return self.subject.buckled.specimen.pitch / self.subject.buckled.pixel_size

    @property
    def _finest(self) -> str:
        b, pitch = self.subject.buckled, self._pitch_px
        width = 2.0 * b.specimen.half_size[0] / b.pixel_size
        v0, v1 = (self.chosen.finest_px[f"{part} x"] for part in ("v0", "v1"))
        return (
            f"At degree {self.chosen.degree} a wave along x keeps 90 % of its amplitude from a "
            f"period of {v0:.0f} px on if it is of v0 ({v0 / pitch:.1f} cells, "
            f"{100 * v0 / width:.0f} % of the specimen's width), and from {v1:.0f} px on "
            f"({v1 / pitch:.1f} cells) if it is of v1, which lives in the cellular part only."
        )

    @property
    def _trade_off(self) -> str:
        first, last, pitch = self.degrees[0], self.degrees[-1], self._pitch_px
        return (
            f"From degree {first.degree} to {last.degree} that period of v0 falls from "
            f"{first.finest_px['v0 x'] / pitch:.1f} to {last.finest_px['v0 x'] / pitch:.1f} cells, "
            f"and the noise floor of v0 rises from {1e3 * first.floor_px['v0']:.2g} to "
            f"{1e3 * last.floor_px['v0']:.2g} · 10⁻³ px, that of v1 φ1 from "
            f"{1e3 * first.floor_px['v1phi1']:.2g} to {1e3 * last.floor_px['v1phi1']:.2g} · 10⁻³ "
            "px."
        )

    @property
    def _product(self) -> str:
        first, last = self.degrees[0], self.degrees[-1]
        v0 = [d.indicator_px2["v0"] for d in self.degrees]
        gain = first.finest_px["v0 x"] / last.finest_px["v0 x"]
        return (
            f"While that period becomes {gain:.1f} times shorter, n l₁₀ % of v0 stays within "
            f"{min(v0):.2f} to {max(v0):.2f} px². That of v1 φ1 goes from "
            f"{first.indicator_px2['v1']:.2f} to {last.indicator_px2['v1']:.2f} px², with φ1 held "
            f"and without motion from {first.held_px2:.2f} to {last.held_px2:.2f} px²: the rest is "
            "mostly the noise of φ1's own parameters. An affine subset on the same speckle under "
            f"the same noise has {self.local_px2:.2f} px², whatever its size (theory)."
        )

    @property
    def _images(self) -> str:
        off, kept = self.waves["difference"].abs(), self.waves["best fit"] >= _KEPT
        elsewhere = "" if kept.all() else f", elsewhere by {100 * off[~kept].max():.1f} %"
        anywhere, resolved = self.curves.cross_talk()
        return (
            f"Correlated images give what the best fits promise: where these keep "
            f"{100 * _KEPT:.0f} % or more of a wave of {self.subject.amplitude_px:g} px, its share "
            f"differs by {100 * off[kept].max():.1f} % of the amplitude at most{elsewhere}. Of a "
            f"wave of one part up to {100 * resolved:.1f} % is found in the other where it is "
            f"resolved, up to {100 * anywhere:.0f} % where it isn't."
        )

    @property
    def _noise(self) -> str:
        ratio = self.floors["Monte Carlo / told"]
        return (
            f"Scatter under noise is {ratio.min():.2f} to {ratio.max():.2f} times what the "
            f"results' own covariance tells, each ± {self.floors['±'].mean():.2f}, with and "
            "without motion."
        )

    @property
    def _pattern(self) -> str:
        """Why l10 means nothing for the pattern itself."""
        band = self.passband
        kept = band.stretch[(band.stretch > 0.82) & (band.added >= 0.9)]
        return (
            "The pattern itself has a wavelength of 2 cells along x and y, "
            f"{2 * self._pitch_px:.0f} px, far below those periods, and none of it is lost: it is "
            "one of the functions that are fitted. A small pattern beside it passes as through a "
            f"filter, from {kept.min():.2f} to {kept.max():.2f} times its wave numbers at degree "
            f"{self.chosen.degree}; but if the pattern itself is up to {100 * band.retuned:.0f} % "
            "longer or shorter, its wave numbers follow, and all of its amplitude is found: "
            "l₁₀ % is a filter's number, and φ1 isn't filtered but tuned."
        )
