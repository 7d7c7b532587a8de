"""The star's images in a folder, for any DIC code, with all that is needed to make them again.

::

    DIR/reference.tif deformed.tif                          exact, float
        reference_1pct.tif still_1pct.tif deformed_1pct.tif a camera's, for each level of noise
        star.json README.md

Nothing is secret: the displacement is a formula. The set's id is a digest of its files.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modeharvest import __version__
from modeharvest.errors import InputError
from modeharvest.files import atomic, read_json, read_record, sha256_of, write_json
from modeharvest.imaging.io import write_image
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.speckle import SpeckleSpec
from modeharvest.progress import Progress, silent
from modeharvest.reading import reading
from modeharvest.stages import stage_key
from modeharvest.typed import made
from modeharvest.validation.resolution.star import Star, StarImages, fine_speckle
from modeharvest.validation.resolution.star_words import readme
from modeharvest.validation.scoring.benchmark_words import RETURNED

FORMAT = "modeharvest-star-1"
SIDECAR, README = "star.json", "README.md"
ROLES = ("reference", "still", "deformed")
"""Images of a level of noise: still shows what reference shows, with noise of its own."""


@dataclass(frozen=True)
class StarSpec:
    """What a star set holds.

    Parameters
    ----------
    star
        The wave and the size of the image.
    speckle
        What moves.
    noise
        Standard deviations of the white noise in the camera's images [fraction of full scale]:
        0.01 is 2.6 of 255 levels.
    bits
        Of the camera's images.
    seed
        Of the noise.

    Raises
    ------
    InputError
        If a level comes twice or is out of range.
    """

    star: Star = field(default_factory=Star)
    speckle: SpeckleSpec = field(default_factory=fine_speckle)
    noise: tuple[float, ...] = (0.01,)
    bits: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "noise", tuple(self.noise))
        if len({level_name(n) for n in self.noise}) < len(self.noise) or not all(
            1e-4 <= n <= 0.1 for n in self.noise
        ):
            raise InputError(
                "star: expected different levels of noise from 0.0001 to 0.1 of full scale, got "
                f"{', '.join(f'{n:g}' for n in self.noise)}"
            )
        if not 1 <= self.bits <= 16 or self.seed < 0:
            raise InputError(
                f"star: expected 1 to 16 bits and a seed of 0 or more, got {self.bits} and "
                f"{self.seed}"
            )


@dataclass(frozen=True, eq=False)
class StarSet:
    """A star set in its folder.

    Parameters
    ----------
    folder
        Where it is.
    spec
        What it holds.
    info
        The content of its ``star.json``.
    """

    folder: Path
    spec: StarSpec
    info: Mapping[str, Any]

    @classmethod
    def read(cls, folder: Path | str) -> StarSet:
        """Open a set.

        Raises
        ------
        InputError
            If there is none.
        """
        path = Path(folder) / SIDECAR
        what, remedy = "a star set", "'modeharvest benchmark star' makes one"
        with reading(path, what, remedy):
            info = read_record(path, FORMAT, what, remedy)
            return cls(Path(folder), made(StarSpec, info["spec"]), info | {"id": str(info["id"])})

    @property
    def id(self) -> str:
        """Of the set."""
        return str(self.info["id"])


def make_star_set(spec: StarSpec, folder: Path | str, progress: Progress = silent) -> StarSet:
    """Write a star set; a whole one of the same spec is left as it is.

    Parameters
    ----------
    spec
        What to make.
    folder
        Where; made if it does not exist.
    progress
        Listener.
    """
    folder = Path(folder)
    if not _is_whole(folder, spec):
        (folder / SIDECAR).unlink(missing_ok=True)
        progress(0, 3, "star: images")
        f, g, residual_px = StarImages(spec.star, spec.speckle).render()
        progress(1, 3, "star: images")
        files = _write_images(folder, spec, f, g)
        progress(2, 3, "star: images")
        info = _info(spec, files, residual_px)
        with atomic(folder / README) as part:
            part.write_text(readme(info), "utf-8")
        write_json(folder / SIDECAR, info)  # last: it says that all is there
        progress(3, 3, "star: images")
    return StarSet.read(folder)


def level_name(noise: float) -> str:
    """A level of noise as part of a file's name: 0.01 is 1pct, 0.005 is 0p5pct."""
    return f"{100.0 * noise:g}pct".replace(".", "p")


def image_name(role: str, noise: float | None = None) -> str:
    """The file of an image: an exact one, or one of a level of noise."""
    return f"{role}.tif" if noise is None else f"{role}_{level_name(noise)}.tif"


def _write_images(
    folder: Path, spec: StarSpec, f: NDArray[np.float64], g: NDArray[np.float64]
) -> dict[str, Any]:
    """Write all images; returns their sizes and digests."""
    still, moved = f.astype(np.float32), g.astype(np.float32)
    exact = {"reference": still, "still": still, "deformed": moved}
    images: dict[str, NDArray[Any]] = {
        image_name(role): exact[role] for role in ("reference", "deformed")
    }
    for noise in spec.noise:
        camera = Sensor(read_noise=noise, read_seed=spec.seed)
        for role in ROLES:
            name = image_name(role, noise)
            images[name] = camera.expose(exact[role], spec.bits, name)
    for name, image in images.items():
        write_image(folder / name, image)
    return {
        name: {"bytes": (folder / name).stat().st_size, "sha256": sha256_of(folder / name)}
        for name in images
    }


def _info(spec: StarSpec, files: Mapping[str, Any], residual_px: float) -> dict[str, Any]:
    """The content of ``star.json``."""
    star = spec.star
    return {
        "format": FORMAT,
        "id": hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()[:12],
        "key": _key(spec),
        "licence": "CC-BY-4.0",
        "made_with": f"modeharvest {__version__}",
        "law": {
            "v_down_px": f"{star.amplitude_px:g} cos(2 pi (row - {star.centre_row}) / period)",
            "period_px": f"{star.shortest_px:g} + {star.longest_px - star.shortest_px:g} "
            f"col / {star.cols - 1}",
            "u_px": 0,
            "of": "points of the reference image; the centre of the upper left pixel is (0, 0)",
            "residual_of_inversion_px": residual_px,
        },
        "spec": asdict(spec),
        "returned": RETURNED,
        "files": dict(files),
    }


def _key(spec: StarSpec) -> str:
    return stage_key(asdict(spec))


def _is_whole(folder: Path, spec: StarSpec) -> bool:
    """Whether the folder holds this set, nothing missing or changed."""
    try:
        info = read_json(folder / SIDECAR)
        return bool(
            info["key"] == _key(spec)
            and (folder / README).read_text("utf-8") == readme(info)
            and all(sha256_of(folder / n) == f["sha256"] for n, f in info["files"].items())
        )
    except (InputError, OSError, ValueError, KeyError, TypeError):
        return False
