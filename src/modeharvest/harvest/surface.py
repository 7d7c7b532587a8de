"""Where the reference's surface has gone: followed by the holes, confirmed by the speckle."""

from __future__ import annotations

from collections.abc import Sequence

from modeharvest.harvest.geometry import Geometry
from modeharvest.harvest.pair import Pair
from modeharvest.idic.specimen.hole_motion import HoleMotion
from modeharvest.idic.specimen.scene import Expected, SceneMatch, compare_scenes, require_same_scene


def followed_holes(pair: Pair, geometry: Geometry) -> tuple[HoleMotion | None, str]:
    """How the holes have moved, and a sentence about it; None where they can't be followed.

    Where a column of holes has left the image, the holes alone allow several answers, and the
    speckle between them tells which is right.

    Raises
    ------
    InputError
        If the images don't show the same surface.
    """
    motions, why_not = geometry.motions_in(pair.deformed_mask)
    if not motions:
        return None, why_not
    motion, seen = _likeliest(pair, motions)
    require_same_scene(seen, "the reference", "the deformed one")
    said = [*motion.sentences, seen.sentence]
    if motion is not motions[0] or motion.rivals:
        said.append("Which hole is which was told by the speckle between them.")
    return motion, " ".join(said)


def confirmed(pair: Pair, expected: Expected) -> str:
    """A sentence about blocks of the reference that were found where they are expected.

    Raises
    ------
    InputError
        If the images don't show the same surface.
    """
    seen = compare_scenes(pair.reference, pair.deformed, pair.mask, expected)
    require_same_scene(seen, "the reference", "the deformed one")
    return seen.sentence


def _likeliest(pair: Pair, motions: Sequence[HoleMotion]) -> tuple[HoleMotion, SceneMatch]:
    """The motion that the speckle agrees with best.

    Those that match as many holes come first, all others only if none of these is right.
    """
    tied = motions[0].rivals + 1
    best = _best(pair, motions[:tied])
    if best[1].is_same or len(motions) == tied:
        return best
    return max(best, _best(pair, motions[tied:]), key=_share)


def _best(pair: Pair, motions: Sequence[HoleMotion]) -> tuple[HoleMotion, SceneMatch]:
    return max(
        ((m, compare_scenes(pair.reference, pair.deformed, pair.mask, m.at)) for m in motions),
        key=_share,
    )


def _share(found: tuple[HoleMotion, SceneMatch]) -> float:
    return found[1].share
