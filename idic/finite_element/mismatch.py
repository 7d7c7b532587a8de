"""Where the images of a correlation don't match: local minima, and surfaces that have changed.

Such places are measured again from the displacement around them. Where that doesn't help, paint has
come off, a crack has opened, or something hides the surface: those pixels don't count any more.
What the noise of the matching pixels has in common with its neighbours is found here, too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import label
from scipy.stats import median_abs_deviation

from modeharvest.idic.finite_element.correlation import BESIDE_PX, MeshCorrelation, Stage
from modeharvest.idic.finite_element.equations.pixels import ElementPixels
from modeharvest.idic.finite_element.equations.system import Linearised
from modeharvest.idic.solver.noise import power_of_long_waves
from modeharvest.idic.solver.pyramid import FULL
from modeharvest.util.arrays import BoolArray, FloatArray
from modeharvest.util.masks import grown, large_parts

_UNLIKE = 0.25
"""Images don't match in an element whose mean square residual less noise, over the reference's
variance, is larger."""
_SEEN = 0.25
"""Least share of an element's pixels that are on the deformed image's material."""
_BY_CHANCE = 5.0
"""Largest departure of a mean square of noise from its variance [standard deviations]."""
_SOME_PIXELS = 200
"""So many pixels in all may not match: elements of an edge that show some background."""
_AROUND = 2
"""Layers of elements around such elements that count, too, as few speckles also match elsewhere."""
_DIFFERS, _MOST_HIDDEN = 0.5, 0.8
"""Pixels differ if their residual, beyond noise, is larger than this, over the speckle's standard
deviation; they count nevertheless if they are a larger share of the material."""
_SPECK, _OF_SPECKLE, _ROUNDS = 6, 0.25, 3
"""So many connected pixels that differ don't count, either, and a square of this share of a speckle
at least; largest number of searches. Residuals of displacements that aren't resolved exceed the
limit in a few connected pixels."""
_SAMPLED = 200_000
_EVERY = 8
"""Pixels from which noise is estimated; or one of so many."""
_WITHOUT = 0.01
"""Share of the material in elements without speckle above which a warning is given [-]."""
_GUESS = (
    "there the displacement is the smoothest that fits around, and its standard deviation a guess."
)


def unlike(correlation: MeshCorrelation, at: Linearised | None = None) -> BoolArray:
    """(m,) True for elements in which the unfiltered images don't match."""
    grey, sums = correlation.on(FULL).pixels.grey, (at or correlation.linearised()).sums
    chance = sums.weights + _BY_CHANCE * np.sqrt(2.0 * sums.weights)
    expected = _UNLIKE * float(grey.var()) * sums.weights + sum(correlation.noise) * chance
    return np.asarray(sums.squares > expected)


def again_where_unlike(correlation: MeshCorrelation, *then: Stage) -> None:
    """Measure again from the displacement around where images don't match, while that helps.

    Where it doesn't, pixels don't count. ``then``: stages after the coarse ones.
    """
    stages, body = (*correlation.coarse, *then), correlation.body
    pixels = np.diff(correlation.on(FULL).pixels.start)
    while pixels[off := unlike(correlation)].sum() > _SOME_PIXELS:
        u, prior, known = correlation.u, correlation.prior, body.away_from(off, _AROUND)
        smooth = correlation.from_around(correlation.start, known)
        start = np.where(known[:, None], correlation.start, smooth)
        correlation.restart(start, known)
        for stage in stages:
            correlation.through(stage)
        if unlike(correlation).sum() >= off.sum():
            correlation.regularised_by(prior, u)
            _hide(correlation, np.asarray(~known[body.mesh.cells].any(axis=1)), *stages)
            break
        correlation.start = start


def leave_out_specks(correlation: MeshCorrelation) -> None:
    """Measure without places that differ, too small for an element not to match: such as dust.

    The cut-off wavelength is found from the residual of all pixels.
    """
    least = max(_SPECK, (_OF_SPECKLE * correlation.speckle_px) ** 2)
    for _ in range(_ROUNDS):
        pixels = correlation.on(FULL).pixels
        residual = correlation.residual(pixels)
        limit = _limit(pixels, residual[pixels.row, pixels.col][::_EVERY])
        specks = large_parts(np.abs(residual) > limit, least)
        hidden = correlation.hidden | grown(specks, BESIDE_PX)
        if not specks.any() or hidden[pixels.row, pixels.col].mean() > _MOST_HIDDEN:
            break
        correlation.without(hidden)
        for stage in correlation.coarse:
            correlation.through(stage)


def _limit(pixels: ElementPixels, residual: FloatArray) -> float:
    """Residual beyond which pixels differ [grey levels], from that of many of them (k,)."""
    noise = median_abs_deviation(residual, scale="normal", nan_policy="omit")  # of any kind
    return _DIFFERS * float(pixels.grey.std()) + _BY_CHANCE * float(noise)


def _some(pixels: ElementPixels, use: BoolArray | bool = True) -> ElementPixels:
    """Pixels of middle rows, of those to use (p,), from which noise is estimated."""
    share = min(1.0, _SAMPLED / pixels.row.size)
    low, high = np.quantile(pixels.row, [0.5 - 0.5 * share, 0.5 + 0.5 * share])
    return pixels.only((pixels.row >= low) & (pixels.row <= high) & use)


def _hide(correlation: MeshCorrelation, cells: BoolArray, *stages: Stage) -> None:
    """Measure without the pixels of elements (m,), then with those of them that match."""
    on, full = correlation.on(FULL), [stage for stage in stages if stage.level == FULL]
    there, before = on.pixels.only(np.repeat(cells, np.diff(on.pixels.start))), correlation.hidden
    if there.row.size > _MOST_HIDDEN * on.pixels.row.size:
        return
    differ: BoolArray = np.ones(there.row.size, np.bool_)
    some = _some(on.pixels)
    limit = _limit(on.pixels, correlation.residual(some)[some.row, some.col])
    for then in (stages, full, full):  # blurred images mix them with what is around
        hidden = np.zeros_like(before)
        hidden[there.row[differ], there.col[differ]] = True
        correlation.without(before | grown(hidden, BESIDE_PX))
        known = correlation.body.away_from(np.diff(correlation.on(FULL).pixels.start) == 0)
        correlation.start = correlation.from_around(correlation.u.reshape(-1, 2), known)
        correlation.restart(correlation.start, known)
        for stage in then:
            correlation.through(stage)
        residual = correlation.residual(there)[there.row, there.col]
        differ = there.completed(~(np.abs(residual) <= limit))


def noise_power(correlation: MeshCorrelation) -> float:
    """Power of the noise at long waves over its variance, from middle rows of the residual."""
    pixels = correlation.on(FULL).pixels
    some = _some(pixels, np.repeat(~unlike(correlation), np.diff(pixels.start)))
    residual = correlation.residual(some)
    contrast = float(some.grey.std()) if some.grey.size else 0.0
    where, at_edges = np.isfinite(residual), correlation.is_sharp
    return power_of_long_waves(np.nan_to_num(residual), where, contrast, at_edges)


def matched(correlation: MeshCorrelation) -> BoolArray:
    """(n,) True at nodes where the unfiltered images match, and both show the material."""
    body, pixels = correlation.body, np.diff(correlation.on(FULL).pixels.start)
    at = correlation.linearised()
    is_off, is_seen = unlike(correlation, at), at.sums.counts >= _SEEN * pixels
    return np.asarray(body.away_from(is_off, _AROUND) & body.away_from(~is_seen))


class NotCompared(NamedTuple):
    """Pixels of the material that don't count in the end, (rows, cols) each, by the reason."""

    blank: BoolArray
    changed: BoolArray
    gone: BoolArray
    """They have no speckle in an image, their surface has changed, or has left the picture."""


def not_compared(correlation: MeshCorrelation) -> NotCompared:
    """The pixels of the material that don't count at the present displacement."""
    pixels, (in_f, in_g) = correlation.on(FULL).pixels, correlation.blank
    if not in_g.any() and _in_picture(correlation):
        return NotCompared(in_f, correlation.hidden & ~in_f, np.zeros_like(in_f))
    row, col = (np.rint(at).astype(int) for at in correlation.moved(pixels))
    stays = (row >= 0) & (row < in_g.shape[0]) & (col >= 0) & (col < in_g.shape[1])
    blank, gone = in_f.copy(), np.zeros_like(in_f)
    gone[pixels.row[~stays], pixels.col[~stays]] = True
    blank[pixels.row[stays], pixels.col[stays]] = in_g[row[stays], col[stays]]
    return NotCompared(blank, correlation.hidden & ~in_f, gone)


def _in_picture(correlation: MeshCorrelation) -> bool:
    """Whether all nodes are moved to pixels of the deformed image, clear of its border."""
    grid, nodes = correlation.pair.grid, correlation.body.mesh.nodes
    where = grid.to_px(*(nodes + correlation.u.reshape(-1, 2)).T)
    return all(
        at.min() > BESIDE_PX and at.max() < most - BESIDE_PX
        for at, most in zip(where, grid.shape, strict=True)
    )


def mismatches(correlation: MeshCorrelation, at: Linearised, lost: NotCompared) -> tuple[str, ...]:
    """Warnings of places without speckle, of changed surfaces, and of images that don't match."""
    found, counts = [], np.diff(correlation.on(FULL).pixels.start)
    total, mesh = counts.sum() + correlation.hidden.sum(), correlation.body.mesh
    for pixels, what in (
        (lost.blank, "an image has one grey level, as reflections have"),
        (lost.changed, "the surface has changed, or is hidden"),
    ):
        if pixels.any():
            share = 100.0 * pixels.sum() / total
            found.append(f"{_place(pixels)} {what} (on {share:.2g} % of the material): {_GUESS}")
    without = float(counts[at.signal == 0.0].sum() / total)
    if without > _WITHOUT:
        found.append(
            f"{100 * without:.0f} % of the material shows no speckle that is in both images: "
            f"{_GUESS}"
        )
    if counts[off := unlike(correlation, at)].sum() > _SOME_PIXELS:
        worst = np.argmax(at.sums.squares / np.maximum(at.sums.weights, 1.0))
        row, col = correlation.pair.grid.to_px(*mesh.nodes[mesh.cells[worst]].mean(axis=0))
        found.append(
            f"Around row {row:.0f}, column {col:.0f} the images don't match (on "
            f"{100 * counts[off].sum() / counts.sum():.2g} % of the material): there the "
            "surface has changed, or the displacement is wrong."
        )
    return tuple(found)


def _place(pixels: BoolArray) -> str:
    """Where the largest connected part of some pixels (rows, cols) is, and how many others."""
    parts, count = label(pixels)
    largest = np.argwhere(parts == 1 + np.bincount(parts.ravel())[1:].argmax())
    (row, col), others = largest.mean(axis=0), f" and in {count - 1} smaller place"
    text = f"Around row {row:.0f}, column {col:.0f}"
    return text if count == 1 else text + others + "s" * (count > 2)
