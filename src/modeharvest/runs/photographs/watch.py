"""Measures photographs while a test runs: pattern amplitude, and the predicted strain of buckling.

::

    watch.html    a page that reloads itself
    watch.json    measurements of every photograph and predictions; read again after a stop

Each photograph is correlated with fixed modes on binned pixels; the initial guess is extrapolated
from the last two. A harvest of all photographs, after the test, is finer and has other error bars.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from modeharvest.idic.ansatz import Ansatz, AnsatzOptions
from modeharvest.idic.correlate import ASTRAY, correlate
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.local.motion import SLOW_DEGREE, first_motion, fit_unknowns
from modeharvest.idic.modes import ModeFamily, turning_family
from modeharvest.idic.photograph.geometry import find_geometry, junction
from modeharvest.idic.photograph.matching.holes import matched_holes
from modeharvest.idic.photograph.material import find_material, window_for
from modeharvest.idic.photograph.plain.surface import coat_of_paint
from modeharvest.idic.result import Result
from modeharvest.idic.setup import CorrelationOptions
from modeharvest.idic.solver.gauss_newton import GaussNewtonOptions
from modeharvest.idic.solver.noise import estimated_noise
from modeharvest.idic.solver.pyramid import FULL, Level, binned
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.files import read_mask, read_stored
from modeharvest.imaging.photographs.photograph import (
    Photograph,
    read_photograph,
    read_reference,
    require_alike,
)
from modeharvest.imaging.photographs.sequence import PICTURES, natural
from modeharvest.runs.photographs.case import PhotographCase
from modeharvest.util.arrays import BoolArray, FloatArray, FloatImage
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, sha256_of, write_json
from modeharvest.util.stages import digest, exclusive
from modeharvest.util.typed import to_plain
from modeharvest.validation.growth import Prediction, fastest_growth, follow_growth, half_wave
from modeharvest.validation.onset import load_axis, mean_strain

_PIXELS = 0.8e6
"""Approximate number of pixels of a binned photograph."""
_DEGREES = AnsatzOptions(v0_degree=5, v_degree=4, brightness=0)
_QUICK = CorrelationOptions(
    levels=(Level(2, 1.0), FULL), order=3, gradient="deformed",
    gauss_newton=GaussNewtonOptions(tolerance_px=1e-3),
)  # fmt: skip
_CAREFUL = replace(_QUICK, levels=(Level(8, 3.0), Level(4, 3.0), Level(2, 3.0), FULL))
_SETTLED_S, _GIVEN_UP_S = 0.3, 10.0
"""A file unchanged for the first time [s] is complete; one unreadable for the second is damaged."""
_POLL_S = 0.2
_COLUMNS = "strain", "amplitude_mm", "sd_mm", "model_sd_mm"
_PAGE_S = 2.0
"""Time between two updates of the page [s] while photographs are waiting."""


@dataclass
class WatchedTest:
    """Results so far of a test that is watched."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    """By photograph: ``name``, ``strain``, ``amplitude_mm``, its standard deviations ``sd_mm``
    by noise and ``model_sd_mm``, ``pattern_px`` (rms of v1 phi1), ``seconds``; and of its file
    ``sha256`` and ``state`` (:func:`_state_of`)."""
    skipped: list[dict[str, Any]] = field(default_factory=list)
    """``name`` and ``reason`` of each photograph that was not measured, and of its file the same.
    """
    conclusion: str = ""
    """Why watching has ended; empty while it goes on."""
    _predicted: list[Prediction | None] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path, key: str) -> WatchedTest:
        """Read the results of a stopped watch; empty if they are of another test."""
        content = read_json(path) if path.is_file() else {}
        if content.get("key") != key:
            return cls()
        return cls(list(content["frames"]), list(content["skipped"]))

    @property
    def columns(self) -> FloatArray:
        """(4, n) strains [-], amplitudes and their standard deviations [mm]."""
        return np.array([[row[key] for row in self.rows] for key in _COLUMNS])

    @property
    def predictions(self) -> list[Prediction | None]:
        """The strain of buckling, predicted after each photograph."""
        self._predicted = follow_growth(self.columns, self._predicted)
        return self._predicted

    @property
    def buckled(self) -> tuple[float, float] | None:
        """The strains between which the pattern grew fastest, once it has buckled; else None."""
        return fastest_growth(self.columns) if self.rows else None

    def of_file(self, name: str) -> dict[str, Any] | None:
        """The entry of a photograph, measured or skipped; None if there is none."""
        return next((e for e in (*self.rows, *self.skipped) if e["name"] == name), None)

    def is_known(self, path: Path) -> bool:
        """Whether a file was measured or skipped, and is still the same or was only renamed."""
        entry, state = self.of_file(path.name), _state_of(path)
        if entry and entry["state"] == state:
            return True
        sha, entries = sha256_of(path), (*self.rows, *self.skipped)
        same = entry if entry and entry["sha256"] == sha else None
        for other in () if entry else entries:
            if other["sha256"] == sha and not path.with_name(other["name"]).exists():
                same = other
        if same is not None:
            same.update(name=path.name, state=state)
        return same is not None

    def put(self, entry: dict[str, Any]) -> bool:
        """Add a photograph's entry, in place of one of the same name; whether there was one."""
        before, wanted = (
            self.of_file(entry["name"]),
            self.skipped if "reason" in entry else self.rows,
        )
        if before in wanted:
            wanted[wanted.index(before)] = entry
        else:
            wanted.append(entry)
        for entries in (self.rows, self.skipped):
            if before in entries and entries is not wanted:
                entries.remove(before)
        self._predicted = [] if before else self._predicted
        return before is not None

    def summary(self) -> dict[str, Any]:
        """The results and predictions as plain JSON values."""
        content = {"frames": self.rows, "skipped": self.skipped, "conclusion": self.conclusion}
        last: Prediction | None = next(reversed(self.predictions), None)
        return {**content, "prediction": to_plain(last), "buckled": to_plain(self.buckled)}


class QuickMeasurement:
    """Measures photographs one after another, with fixed modes, on binned pixels."""

    def __init__(self, case: PhotographCase) -> None:
        self.case = case
        images, table = case.images, case.specimen
        self.reference = read_reference(case.base / images.reference)
        self.factor = max(1, round(np.sqrt(self.reference.image.size / _PIXELS)))
        self.grid = PixelGrid.centred(*self.reference.shape, case.scale.mm_per_px)
        if table.material:
            mask = read_mask(case.base / table.material)
        else:
            mask = self._material(self.reference.image)
        self.geometry = find_geometry(mask, self.grid, table, case.base)
        self._before: tuple[FloatArray, FloatArray] | None = None
        self.thumbnail: FloatImage | None = None

    def _material(self, image: FloatImage) -> BoolArray:
        return find_material(image, window_for(self._cell_px), coat_of_paint(image)).mask

    @property
    def _cell_px(self) -> float:
        return self.case.specimen.cell_size / self.case.scale.mm_per_px

    @cached_property
    def ansatz(self) -> Ansatz:
        """The ansatz of the lattice's pattern; InputError if this isn't square or rectangular.

        Its first mode is the pattern. The other modes are periodic over all cells, and present from
        the start of the test: without them, part of that could be taken for the first mode.
        """
        geometry, cell = self.geometry, self.case.specimen.cell_size
        lattice = geometry.lattice
        if lattice is None or lattice.kind not in ("square", "rectangular"):
            raise InputError(
                "watch: expected holes on a square or rectangular lattice, whose pattern is known "
                f"beforehand, got {'no' if lattice is None else lattice.kind} lattice; harvest "
                "the photographs when there are some"
            )
        vectors = cell * np.eye(2) if geometry.lattice_mm is None else geometry.lattice_mm
        origin, part = np.array(junction(lattice, geometry.grid)), geometry.region
        first = turning_family(vectors, cell, origin).fixed()
        families = (first, *periodic_families(vectors, cell, origin))
        modes = [(family, part.cellular) for family in families]
        return Ansatz.on(part.domain, modes, cell, _DEGREES)

    def measure(self, path: Path, from_holes: bool = False) -> dict[str, Any]:
        """Measure one photograph; returns its row of :class:`WatchedTest`.

        ``from_holes``: whether it isn't the next one of the test, and the last ones don't help.
        InputError if it can't be read, differs in kind from the reference, or doesn't match it.
        """
        begin = time.perf_counter()
        frame = require_alike(self.reference, read_photograph(path))
        image, mask, grid, noise = self._few
        pair = ImagePair(image, binned(frame.image, None, self.factor)[0], grid, mask)
        result = None if from_holes else self._from_the_last(pair)
        if result is None or result.outcome in ASTRAY:
            result = self._from_holes(frame, pair)
        if result.outcome in ASTRAY:
            raise InputError(f"{path}: it doesn't match the reference ({result.outcome.value})")
        a = result.unknowns
        if not from_holes:
            self._before = (a, a if self._before is None else self._before[0])
        cellular = self.geometry.region.cellular
        amplitude, sd, model_sd = half_wave(result, cellular, noise)
        few = self.grid.binned(max(1, round(self._cell_px / 8)))
        inside = cellular.contains(*np.meshgrid(few.x, few.y))
        pattern = result.fluctuation(0, few)[inside] / self.grid.pixel_size
        self.thumbnail = pair.deformed
        strains = mean_strain(result, cellular, self.case.specimen.angle)
        strain = strains[load_axis(np.array([strains]))]
        row = {"name": path.name, "strain": strain, "amplitude_mm": amplitude, "sd_mm": sd}
        row |= {"model_sd_mm": model_sd, "pattern_px": float(np.sqrt(np.mean(pattern**2)))}
        return row | {"seconds": time.perf_counter() - begin}

    @cached_property
    def _few(self) -> tuple[FloatImage, BoolArray, PixelGrid, float]:
        """Binned reference, mask of its full pixels, their grid, noise sd [grey levels]."""
        image, _ = binned(self.reference.image, None, self.factor)
        mask = binned(self.reference.image, self.geometry.mask, self.factor)[1] > 0.99
        return image, mask, self.grid.binned(self.factor), estimated_noise(image, mask).sd

    def _from_the_last(self, pair: ImagePair) -> Result | None:
        """Correlate, starting from an extrapolation of the last two; None for the first."""
        if self._before is None:
            return None
        now, before = self._before
        result = correlate(pair, self.ansatz, guess=2.0 * now - before, options=_QUICK)
        if result.outcome in ASTRAY:
            result = correlate(pair, self.ansatz, guess=now, options=_CAREFUL)
        return result

    def _from_holes(self, frame: Photograph, pair: ImagePair) -> Result:
        """Correlate, starting from the motion of the holes, in any order of photographs."""
        material = self._material(frame.image)
        images = self.reference.image, frame.image
        whole = ImagePair(*images, self.grid, self.geometry.mask, material)
        motion, _ = matched_holes(whole, self.geometry.lattice)
        holes = None if motion is None else motion.in_mm(self.grid)
        slow, _ = first_motion(self.geometry.region.domain, whole, holes)
        few = self.grid.binned(max(1, round(self._cell_px / 4)))
        x, y = (axis.ravel() for axis in np.meshgrid(few.x, few.y))
        known = LocalField(x, y, slow(np.column_stack([x, y])), source="the holes")
        ansatz = self.ansatz
        start = fit_unknowns(ansatz, ansatz.initial_guess(), known, SLOW_DEGREE).coefficients
        return correlate(pair, ansatz, guess=start, options=_CAREFUL)


def periodic_families(vectors: FloatArray, cell: float, at: FloatArray) -> list[ModeFamily]:
    """Mode families periodic over a lattice (2, 2): first waves about a junction ``at``; [mm]."""
    first, second = 2.0 * cell * np.linalg.inv(vectors).T
    both, apart = first + second, first - second
    parts = [(1, 0, *first)], [(0, 1, *second)], [(1, 0, *both), (1, 0, *apart)]
    waves = [np.array(part) for part in (*parts, [(0, 1, *both), (0, -1, *apart)])]
    flat = [np.column_stack([part, -part[:, 2:] @ at]).ravel() for part in waves]
    return [ModeFamily("periodic", np.zeros((p.size, 0)), p, np.zeros(0)) for p in flat]


class _Watch:
    """A test while it is watched: measures photographs, and keeps its files up to date."""

    def __init__(self, case: PhotographCase, folder: Path, where: Path) -> None:
        self.folder, self.title, self.measuring = folder, case.title, QuickMeasurement(case)
        self.reference = self.measuring.reference.path
        self._state, self._drawn, self._is_new = _state_of(self.reference), 0.0, True
        files = sha256_of(self.reference), str(where.absolute())
        self._key = digest(["periodic modes, files' states", _COLUMNS, case.plain(), *files])
        self.test = WatchedTest.read(folder / "watch.json", self._key)

    def measure(self, path: Path) -> str:
        """Measure a photograph that has arrived; returns a line on it, empty if it has gone again.

        InputError if the reference isn't the one of the beginning any more.
        """
        if (now := _state_of(self.reference)) and now != self._state:
            raise InputError(
                f"expected the reference as it was at first, got another in {self.reference}; "
                "start again to measure all photographs anew"
            )
        again, state = self.test.of_file(path.name) is not None, _state_of(path)
        if not state:  # deleted; measured if it comes back
            return ""
        try:
            sha = sha256_of(path)
            entry = self.measuring.measure(path, again)
        except InputError as error:
            entry = {"reason": str(error)}
        except FileNotFoundError:
            return ""
        self.test.put(entry | {"name": path.name, "state": state, "sha256": sha})
        self._is_new = True
        text = _line(self.test, path.name) if "strain" in entry else f"not used: {entry['reason']}"
        return f"{path.name}{', changed' * again}: {text}"

    def save(self, after: float = 0.0) -> None:
        """Write results and page if there is something new, and the last ones are this old [s]."""
        if self._is_new and time.monotonic() - self._drawn >= after:
            self._drawn, self._is_new = time.monotonic(), False
            self._write()

    def conclude(self, text: str) -> None:
        """Write results and page with the reason why watching has ended."""
        self.test.conclusion = text
        self._write()

    def _write(self) -> None:
        from modeharvest.report.figures.sequence import write_watch_page

        page, picture = self.folder / "watch.html", self.measuring.thumbnail
        write_json(self.folder / "watch.json", {"key": self._key, **self.test.summary()})
        write_watch_page(page, self.title, self.test, picture)


def watch(
    case: str | Path, folder: Path, photographs: Path | None = None, *,
    until_still: float | None = None, show: Callable[[str], None] = lambda line: None,
) -> WatchedTest:  # fmt: skip
    """Measure the photographs of a folder as they arrive; writes a page that follows the test.

    ``case``: a TOML file of a harvest, whose first ``deformed`` is the folder unless one is given;
    ``until_still``: ends after this time without a new photograph [s], None for never; ``show``: is
    called with a line on the page, then with one for each photograph. Can be interrupted safely.
    Raises InputError if the case, or the reference, can't be used.
    """
    found = PhotographCase.read(case)
    where = found.base / found.images.deformed[0] if photographs is None else photographs
    if not where.is_dir():
        raise InputError(
            f"expected a folder to watch, got {where}; name it after --watch, or make it"
        )
    with exclusive(folder):
        watched, conclusion = _Watch(found, folder, where), ""
        show(f"watching {where}: open {folder / 'watch.html'}")
        try:
            for path in arriving(where, watched.reference, watched.test, until_still, watched.save):
                if line := watched.measure(path):
                    show(line)
                    watched.save(_PAGE_S)
            conclusion = f"No photograph came for {until_still:g} s."
        except KeyboardInterrupt:
            conclusion = "Watching was interrupted."
        finally:
            watched.conclude(conclusion)
    return watched.test


def arriving(
    folder: Path, reference: Path, test: WatchedTest, until_still: float | None,
    idle: Callable[[], None] = lambda: None,
) -> Iterator[Path]:  # fmt: skip
    """Yield the photographs of a folder when they are complete, those already there first.

    Those that were replaced come again. Ends when none has come, and none grows, for
    ``until_still`` seconds. ``idle`` is called while nothing comes.
    """
    seen, still = dict[Path, list[int]](), time.monotonic()
    while until_still is None or time.monotonic() - still < until_still:
        new = []
        with suppress(FileNotFoundError):  # of a folder or drive that has gone
            new = [p for p in folder.iterdir() if p.suffix.lower() in PICTURES and p.name[0] != "."]
        seen, count = {path: state for path, state in seen.items() if path in new}, 0
        for path in sorted(new, key=natural):
            state = _state_of(path)
            if not state or seen.get(path) == state or path.absolute() == reference.absolute():
                continue
            count += 1
            with suppress(FileNotFoundError):  # deleted meanwhile
                if _is_whole(path):
                    seen[path] = state
                    if not test.is_known(path):
                        yield path
        if count:
            still = time.monotonic()
        else:
            idle()
            time.sleep(_POLL_S)


def _state_of(path: Path) -> list[int]:
    """Size [bytes] and time of change [ns] of a file; empty if there is none."""
    with suppress(FileNotFoundError):
        about = path.stat()
        return [about.st_size, about.st_mtime_ns]
    return []


def _is_whole(path: Path) -> bool:
    """Whether a file is complete: it doesn't grow, and can be read or is damaged for good."""
    before = path.stat()
    age = time.time() - before.st_mtime
    if age > _GIVEN_UP_S:
        return True
    time.sleep(_SETTLED_S if age < _SETTLED_S else 0.0)
    try:
        read_stored(path)
    except InputError:
        time.sleep(_POLL_S)
        return False
    return path.stat().st_mtime_ns == before.st_mtime_ns


def _line(test: WatchedTest, name: str) -> str:
    """Text with a photograph's numbers, and the prediction after it."""
    k = [row["name"] for row in test.rows].index(name)
    row, found = test.rows[k], test.predictions[k]
    text = (
        f"{100 * row['strain']:.2f} %, pattern {row['pattern_px']:.2f} px, {row['seconds']:.1f} s"
    )
    if found and found.is_useful:
        text += f"; buckling predicted at {100 * found.critical:.2f} % ({found.interval})"
    return f"{text}; buckled" if test.buckled else text
