"""The design of a test, from case to report: uncertainty expected from noise, and how to reduce it.

A case has the tables of a virtual experiment, and may have a table ``[design]``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

from modeharvest.fem.field import Solution
from modeharvest.runs.case import Case, checked, read_tables, table_of_kind
from modeharvest.runs.experiment import Run
from modeharvest.util.errors import requiring_dolfinx
from modeharvest.util.files import require_writable, write_json
from modeharvest.util.stages import StagedRun, command_line, exclusive, versions
from modeharvest.util.typed import to_plain
from modeharvest.validation.design import AXES, NEEDED, Design, DesignOptions
from modeharvest.validation.design_parameters import ModelStates


class DesignCase(Case):
    """A virtual experiment, with the options of the design of its test."""

    table = "design"

    design: DesignOptions = DesignOptions()

    @classmethod
    def read(cls, name: str | Path) -> Self:
        """Read a design case; a virtual experiment without ``[design]`` gets the defaults."""
        tables = read_tables(name, "paper-virtual")
        if table_of_kind(tables) == "experiment":
            return checked(cls, tables, name)
        return super().read(name)


@dataclass(frozen=True)
class DesignRun(StagedRun[DesignCase]):
    """Computes the design of a test and writes its report."""

    solution: Path | None = None
    """A solution file, used instead of the case's shipped solution or a simulation."""
    source: str = "CASE"
    """The case's name, for the report."""

    def design(self) -> Design:
        """The design, which predicts errors; simulates the test unless its solution is known."""
        case, strains = self.case, self.case.experiment.strains
        strain, how = case.design.strain or strains[-1], (case.imaging, case.correlation)
        solution = self._solved() if case.design.pattern is None else None
        model = self._model(strain) if case.design.parameters else None
        return Design(case.experiment.specimen, *how, case.design, strain, solution, model)

    def _model(self, strain: float) -> ModelStates:
        """The model's states and their derivatives at all strains that the design uses."""
        with requiring_dolfinx("the design for a model's parameters needs"):
            from modeharvest.fem.path.parametric import ParametricTest
        design, own = self.case.design, self.case.experiment
        strains = sorted({*own.strains, *design.ranges.strain, strain})
        test = ParametricTest.meshed(replace(own, strains=tuple(strains)), design.parameters)
        states = dict(zip(strains, test.at(test.own_values), strict=True))
        of_test = tuple(e for e in own.strains if e < strain)
        return ModelStates(design.parameters, test.own_values, states, (*of_test, strain),
                           design.force_sd)  # fmt: skip

    def all(self) -> dict[str, Any]:
        """Write summary and report; returns the content of ``summary.json``."""
        from modeharvest.report.design import design_report
        from modeharvest.report.model.output import write_page

        require_writable(self.folder)
        with exclusive(self.folder):
            summary = self.summary(self.design())
            write_json(self.folder / "summary.json", summary)
            write_page(design_report(summary), self.folder / "report.html", self.progress)
        return summary

    def summary(self, design: Design) -> dict[str, Any]:
        """The content of ``summary.json``; its keys: docs/how-to/design.md."""
        setup, options, state = design.setup, design.options, design.state(design.setup)
        expected = design.expected(setup)
        varied = {x: [{"value": v, **asdict(e)} for v, e in design.varied(x)] for x in AXES}
        wanted = options.wanted
        first, second, errors = design.mapped()
        shown = {"first": first, "second": second, "errors": errors}
        found = {
            "title": self.case.title or "Design of a test",
            "command": command_line("design", self.source, "--out", self.folder),
            "critical_strain": design.critical,
            "setup": setup,
            "expected": expected,
            "parameters": [] if design.model is None else design.model.names,
            "wanted": {name: getattr(options, name) for name in wanted},
            "needed": {axis: {n: design.needed(axis, n) for n in wanted} for axis in NEEDED},
            "varied": varied,
            "map": {"axes": options.map, "contour": options.contour, **shown},
            "unknowns": state.ansatz.size,
            "case": {**self.case.plain(), "design": options},
            "versions": versions("numpy", "scipy"),
        }
        return dict(to_plain(found))

    def _solved(self) -> Solution:
        run = Run(self.case, self.folder, self.progress, self.solution)
        return (None if self.solution else run.shipped()) or run.solved()
