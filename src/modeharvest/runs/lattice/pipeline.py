"""Analysis of an infinite lattice, in stages that can be resumed.

For the files see docs/explanation/bloch.md. ``modeharvest bloch`` runs the first two stages and the
report, ``modeharvest modes`` all stages.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from modeharvest.fem.bloch import modes as mode_files
from modeharvest.fem.bloch.dispersion import Dispersion, ZoneMap, dispersion, zone_map
from modeharvest.fem.bloch.modes import Branch, ModeSet
from modeharvest.idic.spectra.mode_family import write_family
from modeharvest.runs.lattice import results
from modeharvest.runs.lattice.case import FileLattice, LatticeCase
from modeharvest.runs.lattice.results import CriticalPoint, FoundPattern, LatticeRun, PeriodicField
from modeharvest.util import RELEASE
from modeharvest.util.errors import InputError, requiring_dolfinx
from modeharvest.util.files import read_json, reading, sha256_of, write_json
from modeharvest.util.progress import counted, named
from modeharvest.util.stages import StagedRun, command_line, digest, exclusive, stage_key
from modeharvest.util.typed import made, to_plain

if TYPE_CHECKING:
    from modeharvest.fem.lattice.cell import CellPath, CellState, PeriodicCell
    from modeharvest.fem.lattice.cells import UnitCell

BEYOND = (1.02, 1.1, 1.25, 1.5)
"""Loads at which states of branches are stored, divided by the critical load [-]."""


@dataclass(frozen=True)
class LatticeAnalysis(StagedRun[LatticeCase]):
    """Runs the stages of a lattice's analysis.

    All raise InputError if no such lattice exists or its cell isn't periodic, and
    MissingDependencyError if dolfinx or gmsh is not installed.
    """

    source: str = "CASE"
    """Name or file of the case, for the report."""

    def critical(self) -> CriticalPoint:
        """Find the first critical load over all wave vectors; writes ``critical.json``.

        Its ``history`` has the least stable wave at each load examined. Raises InputError if
        the lattice is a mechanism.
        """
        path = self.folder / "critical.json"

        def work() -> tuple[Path, ...]:
            primary = self._path()
            from modeharvest.fem.bloch.critical import first_critical
            from modeharvest.fem.bloch.mesh_error import load_error

            progress, search = named(self.progress, "first critical load"), self.case.search
            found = first_critical(primary, search, progress)
            error = load_error(found, primary, self.case.material, search)
            point = CriticalPoint.of(self.case.loading.name, found, error)
            write_json(path, to_plain({"point": point, "history": found.history}))
            return (path,)

        self.do("critical", self._keys["critical"], work)
        with reading(path, "a critical point", "remove it"):
            return made(CriticalPoint, read_json(path)["point"])

    def dispersion(self) -> Dispersion:
        """Compute the lowest eigenvalues; writes ``dispersion.h5`` and, as a table, ``.csv``."""
        critical, plan = self.critical(), self.case.dispersion
        path, table = self.folder / "dispersion.h5", self.folder / "dispersion.csv"

        def work() -> tuple[Path, ...]:
            loads = plan.loads or (0.0, 0.5 * critical.load, critical.load)
            cell_path, zone = self._path(max(loads)), list[ZoneMap]()
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
        """Find modes and branches; writes ``modes.h5``, ``.vtu`` and ``.xdmf`` if there are any.

        Raises InputError if a specified wave doesn't repeat within a dozen cells, or a load can't
        be reached.
        """
        critical = self.critical()
        if self._why_no_modes(critical):
            return None, ()
        path = self.folder / "modes.h5"
        vtu, xdmf = path.with_suffix(".vtu"), path.with_suffix(".xdmf")

        def work() -> tuple[Path, ...]:
            found = self._modes(critical)
            mode_files.write_modes(path, *found)
            mode_files.write_vtu(vtu, *found)
            mode_files.write_xdmf(xdmf, *found)
            return path, vtu, xdmf

        self.do("modes", self._keys["modes"], work)
        return mode_files.read_modes(path)

    def families(self) -> None:
        """Find the mode families of modes, branches and primary path; writes ``family_*.json``."""
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
        """Run the study if the case has one; writes ``study.csv``."""
        if self.case.study is None:
            return
        path, key = self.folder / "study.csv", self._keys["study"]
        rows = self.folder / f"study-{key[:8]}.csv"  # unfinished rows of the same study

        def work() -> tuple[Path, ...]:
            self.case.run_study(rows, self.progress)
            rows.replace(path)
            for other in self.folder.glob("study-*.csv"):  # of abandoned studies
                other.unlink()
            return (path,)

        self.do("study", key, work)

    def report(self) -> dict[str, Any]:
        """Write ``report.html`` and ``summary.json``; returns the content of the latter.

        They contain everything that was computed in this folder for the same case.
        """
        path, page = self.folder / "summary.json", self.folder / "report.html"
        done = {n: key for n, key in self._keys.items() if self.is_finished(n, key)}

        def work() -> tuple[Path, ...]:
            from modeharvest.report.lattice import lattice_report
            from modeharvest.report.model.output import write_page

            run = self._run(done)
            fields = self._patterns if "families" in done else []
            found = [FoundPattern.read(field, self.folder) for field in fields]
            summary = results.summary_of(run, found)
            write_page(lattice_report(summary, run), page, self.progress)
            write_json(path, summary)
            return path, page

        key = stage_key([done, self.case.title, self.source])
        self.do("report", key, work)
        return dict(read_json(path))

    def bloch(self) -> dict[str, Any]:
        """Analyse stability and dispersion for all waves; returns the content of ``summary.json``.

        Raises InputError if another process works in the folder.
        """
        with exclusive(self.folder):
            self._search()
            return self.report()

    def all(self) -> dict[str, Any]:
        """Run all unfinished stages; returns the content of ``summary.json``.

        Raises InputError if another process works in the folder, or if modes can't be computed; in
        the latter case the other results are reported first.
        """
        with exclusive(self.folder):
            self._search()
            try:
                self.families()
                self.study()
            except InputError:
                self.report()
                raise
            return self.report()

    # -- parts --------------------------------------------------------------------------

    def _search(self) -> None:
        """Find the critical point, and the dispersion if the case specifies it."""
        if self.case.dispersion.points:
            self.dispersion()
        else:
            self.critical()

    def _info(self, critical: CriticalPoint) -> dict[str, Any]:
        """The origin of a mode, as stored with it."""
        content = self.case.plain()
        tables = {name: content[name] for name in ("title", "lattice", "material", "loading")}
        return {**tables, "critical": asdict(critical)}

    @cached_property
    def _unit(self) -> UnitCell:
        """Mesh and lattice vectors of the primitive cell."""
        with requiring_dolfinx("infinite lattices need"):
            return self.case.lattice.cell()

    @cached_property
    def _cell(self) -> PeriodicCell:
        """The primitive cell with its material."""
        unit = self._unit
        with requiring_dolfinx("infinite lattices need"):
            from modeharvest.fem.lattice.cell import PeriodicCell
        return PeriodicCell(unit, self.case.material)

    def _path(self, load: float = 0.0, cell: PeriodicCell | None = None) -> CellPath:
        """A new primary path, followed up to a load [-] in steps that skip no state.

        It begins at load 0, so that no stage depends on the steps of another one.
        """
        cell = cell or self._cell  # first: raises MissingDependencyError without dolfinx
        from modeharvest.fem.lattice.cell import CellPath

        path, step = CellPath(cell, self.case.loading.macro()), self.case.search.largest_step
        for k in range(int(load / step) + 1):
            if path.at(k * step) is None:
                break
        return path

    def _why_no_modes(self, critical: CriticalPoint) -> str:
        """Reason why no mode can be computed; empty if there is a wave for it."""
        if self.case.modes.waves or critical.waves:
            return ""
        what = "long waves are modes of no finite cell" if critical.found else "no critical point"
        return f"no modes: {what}; name waves in [modes], such as waves = [[1, 1]]"

    def _modes(self, critical: CriticalPoint) -> tuple[ModeSet, tuple[Branch, ...]]:
        """The specified modes as real fields, and the branches that start from critical modes.

        Raises InputError if a wave doesn't repeat within a dozen cells, the load can't be reached,
        or combinations don't have one coefficient for each mode.
        """
        plan = self.case.modes
        path = self._path(max(plan.load, critical.load))
        from modeharvest.fem.bloch.real_modes import real_modes

        state = _state(path, plan.load or critical.load)
        self.progress(0, 1, "modes")
        modes = real_modes(path.cell, state, plan.phases or critical.waves, self._info(critical))
        self.progress(1, 1, "modes")
        if not critical.found or state.load != critical.load:
            return modes, ()
        return modes, tuple(self._branches(modes))

    def _branches(self, modes: ModeSet) -> list[Branch]:
        """Follow a branch for each combination of modes, on their commensurate cell."""
        from modeharvest.fem.bloch.degenerate import distinct_combinations
        from modeharvest.fem.bloch.postbuckling import follow
        from modeharvest.fem.lattice.cell import PeriodicCell

        plan = self.case.modes
        loads = plan.branch_loads or tuple(factor * modes.load for factor in BEYOND)
        cell = PeriodicCell(self._unit.enlarged(*modes.info["copies"]), self.case.material)
        combinations = plan.combinations or distinct_combinations(cell, modes)
        found = []
        for k, combination in enumerate(combinations, start=1):
            listener = named(self.progress, f"branch {k} of {len(combinations)}")
            path = self._path(0.98 * modes.load, cell)
            found.append(follow(path, modes, combination, loads, progress=listener))
        return found

    @cached_property
    def _patterns(self) -> list[PeriodicField]:
        """All fields whose families are determined: modes, ends of branches, primary path."""
        critical, (modes, branches) = self.critical(), self.modes()
        info, found = self._info(critical), []
        if modes is not None:
            found += [PeriodicField.of_mode(modes, k, info) for k in range(len(modes.waves))]
            found += [
                PeriodicField.of_branch(modes, k, branch, info, self.case.loading.quantity)
                for k, branch in enumerate(branches, start=1) if branch.states
            ]  # fmt: skip
        load = self.case.modes.load or critical.load
        path = self._path(load)
        state = _state(path, load)
        quantity = self.case.loading.quantity
        return [*found, PeriodicField.of_primary(path.cell, state, load, modes, info, quantity)]

    def _shown(self, modes: ModeSet) -> list[FoundPattern]:
        """Fields to show: branches by ascending energy, or else modes; then the primary path."""
        every, pitch = self._patterns, self.case.lattice.pitch
        branches = sorted((p for p in every[:-1] if p.stable is not None), key=lambda p: p.energy)
        found = [FoundPattern.read(pattern, self.folder) for pattern in branches]
        if not found:
            largest = results.DRAWN_AMPLITUDE * pitch
            found = [mode.scaled(largest).analysed(pitch) for mode in every[: len(modes.waves)]]
        return [*found, FoundPattern.read(every[-1], self.folder)]

    def _run(self, done: Collection[str]) -> LatticeRun:
        """All finished results, for the report."""
        from modeharvest.fem import dolfinx_api
        from modeharvest.fem.bloch.mesh_error import ligament_notes

        unit, critical = self._unit, self.critical()
        why_no_modes = self._why_no_modes(critical)
        modes, branches = self.modes() if "modes" in done else (None, ())
        command = "modes" if "families" in done else "bloch"
        return LatticeRun(
            title=self.case.title or "An infinite lattice",
            case=self.case.plain(),
            command=command_line(command, self.source, "--out", self.folder),
            mesh=unit.mesh,
            lattice=unit.lattice,
            pitch=self.case.lattice.pitch,
            load=self.case.loading.quantity,
            critical=critical,
            dispersion=self.dispersion() if "dispersion" in done else None,
            modes=modes,
            branches=branches,
            patterns=self._shown(modes) if modes and "families" in done else (),
            study=self.case.run_study(self.folder / "study.csv", self.progress)
            if "study" in done else None,  # whose rows are complete
            notes=[*unit.notes, *ligament_notes(unit), *filter(None, [why_no_modes])],
            exports=results.exports_in(self.folder),
            versions={"modeharvest": RELEASE, "dolfinx": dolfinx_api.VERSION},
        )  # fmt: skip

    @cached_property
    def _keys(self) -> dict[str, str]:
        """For each stage, the digest of all that it depends on, including a cell's file."""
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


def _state(path: CellPath, load: float) -> CellState:
    """The state at a load, or a millionth below it if that is critical with the cell's period."""
    state = path.at(load) or path.at((1.0 - 1e-6) * load)
    if state is None:
        raise InputError(f"modes: expected a load that the lattice's path reaches, got {load:.6g}")
    return state
