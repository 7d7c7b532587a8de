"""The analysis of an infinite lattice in one folder, in stages that can be resumed.

Their files: docs/bloch.md. ``modeharvest bloch`` is the first two and the report, ``modeharvest
modes`` all of them.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from modeharvest.fem.bloch import modes as mode_files
from modeharvest.fem.bloch.dispersion import Dispersion, ZoneMap, dispersion, zone_map
from modeharvest.fem.bloch.modes import Branch, ModeSet
from modeharvest.idic.spectra.mode_family import write_family
from modeharvest.runs.lattice import results
from modeharvest.runs.lattice.case import FileLattice, LatticeCase
from modeharvest.runs.lattice.modes import LatticeModel, found_pattern, to_be_shown
from modeharvest.runs.lattice.results import CriticalPoint, LatticeRun, PeriodicField
from modeharvest.util import __version__
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, reading, sha256_of, write_json
from modeharvest.util.progress import counted
from modeharvest.util.stages import StagedRun, digest, exclusive, stage_key
from modeharvest.util.typed import made, to_plain


@dataclass(frozen=True)
class LatticeAnalysis(StagedRun[LatticeCase]):
    """The stages of a lattice's analysis."""

    source: str = "CASE"
    """Name or file of the case, for the report."""

    def critical(self) -> CriticalPoint:
        """Find the first critical load over all wave vectors; leaves ``critical.json``.

        There ``history`` has the least stable wave at each load looked at. Raises InputError if
        the cell is not periodic or the lattice is a mechanism, MissingDependencyError if dolfinx
        is not there.
        """
        path = self.folder / "critical.json"

        def work() -> tuple[Path, ...]:
            found = self._model.critical()
            point = CriticalPoint.of(self.case.loading.name, found)
            write_json(path, to_plain({"point": point, "history": found.history}))
            return (path,)

        self.do("critical", self._keys["critical"], work)
        with reading(path, "a critical point", "remove it"):
            return made(CriticalPoint, read_json(path)["point"])

    def dispersion(self) -> Dispersion:
        """Compute the lowest eigenvalues; leaves ``dispersion.h5`` and, as a table, ``.csv``."""
        critical, plan = self.critical(), self.case.dispersion
        path, table = self.folder / "dispersion.h5", self.folder / "dispersion.csv"

        def work() -> tuple[Path, ...]:
            loads = plan.loads or (0.0, 0.5 * critical.load, critical.load)
            cell_path, zone = self._model.path(max(loads)), list[ZoneMap]()
            tour = plan.tour(self.case.lattice, self.case.loading)
            found = dispersion(cell_path, tour, loads, plan.points, plan.bands, self.progress)
            if plan.map_divisions:
                zone.append(zone_map(cell_path, critical.load, plan.map_divisions, self.progress))
            replace(found, zone=tuple(zone)).write(path)
            results.write_dispersion_table(found, table)
            return path, table

        self.do("dispersion", self._keys["dispersion"], work)
        return Dispersion.read(path)

    def modes(self) -> tuple[ModeSet | None, tuple[Branch, ...]]:
        """Find modes and branches; leaves ``modes.h5``, ``.vtu`` and ``.xdmf``, if there are any.

        Raises InputError if a wave asked for doesn't repeat within a dozen cells, or a load can't
        be reached.
        """
        critical = self.critical()
        if self._model.why_no_modes(critical):
            return None, ()
        path = self.folder / "modes.h5"
        vtu, xdmf = path.with_suffix(".vtu"), path.with_suffix(".xdmf")

        def work() -> tuple[Path, ...]:
            found = self._model.modes(critical, self._info(critical))
            mode_files.write_modes(path, *found)
            mode_files.write_vtu(vtu, *found)
            mode_files.write_xdmf(xdmf, *found)
            return path, vtu, xdmf

        self.do("modes", self._keys["modes"], work)
        return mode_files.read_modes(path)

    def families(self) -> None:
        """Find the mode families of modes, branches and primary path; leaves ``family_*.json``."""
        self.modes()
        index = self.folder / "families.json"

        def work() -> list[Path]:
            for pattern in counted(self._patterns, self.progress, "mode families"):
                found = pattern.analysed(self.case.lattice.pitch)
                write_family(self.folder / pattern.file, found.family, spectrum=found.spectrum)
            write_json(index, {pattern.file: pattern.name for pattern in self._patterns})
            return [index, *(self.folder / pattern.file for pattern in self._patterns)]

        self.do("families", self._keys["families"], work)

    def study(self) -> None:
        """Do the study, if the case has one; leaves ``study.csv``."""
        if self.case.study is None:
            return
        path, key = self.folder / "study.csv", self._keys["study"]
        rows = self.folder / f"study-{key[:8]}.csv"  # of this very study, to go on from

        def work() -> tuple[Path, ...]:
            self.case.run_study(rows, self.progress)
            rows.replace(path)
            for other in self.folder.glob("study-*.csv"):  # of studies given up
                other.unlink()
            return (path,)

        self.do("study", key, work)

    def report(self) -> dict[str, Any]:
        """Write all that is finished into ``report.html`` and ``summary.json``; returns the latter.

        Whatever was computed in this folder for this very case is in it.
        """
        path, page = self.folder / "summary.json", self.folder / "report.html"
        done = {n: key for n, key in self._keys.items() if self.is_finished(n, key)}

        def work() -> tuple[Path, ...]:
            from modeharvest.report.lattice import lattice_report
            from modeharvest.report.model import write_page

            run = self._run(done)
            fields = self._patterns if "families" in done else []
            summary = results.summary_of(run, [found_pattern(it, self.folder) for it in fields])
            write_page(lattice_report(summary, run), page, self.progress)
            write_json(path, summary)
            return path, page

        key = stage_key([done, self.case.title, self.source])
        self.do("report", key, work)
        return dict(read_json(path))

    def bloch(self) -> dict[str, Any]:
        """Stability against all waves, and dispersion; returns the content of ``summary.json``.

        Raises InputError if another process works in the folder.
        """
        with exclusive(self.folder):
            self.dispersion()
            return self.report()

    def all(self) -> dict[str, Any]:
        """All stages that are not finished; returns the content of ``summary.json``.

        Raises InputError if another process works in the folder, or modes can't be had; what
        there is is reported before.
        """
        with exclusive(self.folder):
            self.dispersion()
            try:
                self.families()
                self.study()
            except InputError:
                self.report()
                raise
            return self.report()

    # -- parts --------------------------------------------------------------------------

    def _info(self, critical: CriticalPoint) -> dict[str, Any]:
        """What a mode's user must know of where it comes from."""
        content = self.case.plain()
        tables = {name: content[name] for name in ("title", "lattice", "material", "loading")}
        return {**tables, "critical": asdict(critical)}

    @cached_property
    def _model(self) -> LatticeModel:
        return LatticeModel(self.case, self.progress)

    @cached_property
    def _patterns(self) -> list[PeriodicField]:
        """All fields in which families are looked for."""
        critical = self.critical()
        return self._model.fields(critical, *self.modes(), self._info(critical))

    def _run(self, done: Collection[str]) -> LatticeRun:
        """All there is, for the report."""
        from modeharvest.fem import dolfinx_api

        unit, critical = self._model.unit, self.critical()
        modes, branches = self.modes() if "modes" in done else (None, ())
        command = "modes" if "families" in done else "bloch"
        return LatticeRun(
            title=self.case.title or "An infinite lattice",
            case=self.case.plain(),
            command=f"modeharvest {command} {self.source} --out {self.folder}",
            mesh=unit.mesh,
            lattice=unit.lattice,
            pitch=self.case.lattice.pitch,
            critical=critical,
            dispersion=self.dispersion() if "dispersion" in done else None,
            modes=modes,
            branches=branches,
            patterns=to_be_shown(self._patterns, modes, self.case.lattice.pitch, self.folder)
            if modes and "families" in done else (),
            study=self.case.run_study(self.folder / "study.csv", self.progress)
            if "study" in done else None,  # of which the rows are all there
            notes=[note for note in (self._model.why_no_modes(critical),) if note],
            exports=results.exports_in(self.folder),
            versions={"modeharvest": __version__, "dolfinx": dolfinx_api.VERSION},
        )  # fmt: skip

    @cached_property
    def _keys(self) -> dict[str, str]:
        """By stage, the digest of all that it depends on; a cell's own file included."""
        case, content = self.case, self.case.plain()
        if isinstance(case.lattice, FileLattice):
            content["lattice"]["content"] = sha256_of(case.lattice.path)
        tables = {name: content[name] for name in ("lattice", "material", "loading", "search")}
        critical = stage_key(tables)
        return {
            "critical": critical,
            "dispersion": digest([critical, content["dispersion"]]),
            "modes": digest([critical, content["modes"]]),
            "families": digest([critical, content["modes"], "families"]),
            "study": stage_key([tables, content["study"]]),
        }
