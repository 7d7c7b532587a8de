"""What a homogenized specimen's run found: its fields, its summary, what the report shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modeharvest.fem.field import Mesh, read_values, write_values
from modeharvest.idic.result import Result
from modeharvest.util.arrays import FloatArray
from modeharvest.util.files import atomic_hdf5, open_hdf5
from modeharvest.util.stages import versions
from modeharvest.util.typed import to_plain
from modeharvest.validation.homogenization import (
    LatticeMode,
    ModeParameters,
    Response,
    StateNumbers,
)

if TYPE_CHECKING:
    from modeharvest.fem.lattice.micromorphic.branches import Homogenized
    from modeharvest.fem.lattice.micromorphic.continuum import HomogenizedBody

FORMAT = "modeharvest-homogenized-1"
_QUARTERS = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])
"""Signs of x and y."""
_V = 4
"""Where v1 is among the generalised strains."""
_REVERSED = [0, 3, 2, 1, 7, 6, 5, 4]
"""The nodes of a Q8 element the other way round."""


@dataclass(frozen=True, eq=False)
class StateFields:
    """A state of the homogenized specimen on its macroscopic mesh."""

    load: float
    """Nominal strain [-]."""
    displacement: FloatArray
    amplitudes: FloatArray
    """(n, 2) u [mm] and (n, m) v_i [mm], NaN where there is no lattice."""
    strains: FloatArray
    stresses: FloatArray
    """(p, 4 + 3 m) F̄, v, g and P̄, Pi, Lambda at the points of the lattice, row by row."""
    microstructure: FloatArray
    """(p, k, 2) displacement of the RVE's nodes at each point, from its middle [mm]."""


def write_fields(found: Homogenized, body: HomogenizedBody, path: Path) -> None:
    """Write mesh and states of the whole as HDF5, a group ``states/K`` each.

    Of a quarter its mirror images are written too; its points stay those of the quarter.
    """
    signs = _QUARTERS[: body.copies]
    with atomic_hdf5(path) as file:
        file.attrs.update(format=FORMAT, copies=body.copies)
        write_values(file.create_group("mesh"), _unfolded(body.mesh, signs))
        write_values(file.create_group("rve"), body.rves[0].cell.cell.mesh)
        file["points"] = body.places
        for k, state in enumerate(found.states):
            u = np.concatenate([state.displacement * sign for sign in signs])
            v = np.tile(state.amplitudes, (len(signs), 1))
            micro = np.stack([
                body.microstructure(state.value, state.strains, number)
                for number in range(0, len(body.places) * len(body.rves), len(body.rves))
            ])  # fmt: skip
            fields = StateFields(state.load, u, v, state.strains, state.stresses, micro)
            write_values(file.create_group(f"states/{k:03d}"), fields)


def _unfolded(mesh: Mesh, signs: FloatArray) -> Mesh:
    """A mesh and its mirror images, one after the other; nodes on mirrors are there twice."""
    nodes = np.concatenate([mesh.nodes * sign for sign in signs])
    first = len(mesh.nodes) * np.arange(len(signs))
    cells = [
        (mesh.cells if sign.prod() > 0 else mesh.cells[:, _REVERSED]) + offset
        for sign, offset in zip(signs, first, strict=True)
    ]
    return Mesh(nodes, np.concatenate(cells), mesh.element)


@dataclass(frozen=True, eq=False)
class HomogenizedFields:
    """The content of ``homogenized.h5``."""

    mesh: Mesh
    """Macroscopic, of the whole specimen [mm]."""
    rve: Mesh
    """Of the first RVE at a point, from its middle [mm]."""
    points: FloatArray
    """(p, 2) where the RVEs are [mm]; of a quarter its own."""
    copies: int
    """4 where a quarter was followed, 1 otherwise."""
    states: tuple[StateFields, ...]

    @classmethod
    def read(cls, path: Path) -> HomogenizedFields:
        """What :func:`write_fields` wrote."""
        with open_hdf5(path, "a homogenized specimen", form=FORMAT) as file:
            states = file.get("states", {})
            found = tuple(read_values(states[key], StateFields) for key in sorted(states))
            mesh, rve = (read_values(file[name], Mesh) for name in ("mesh", "rve"))
            return cls(mesh, rve, file["points"][()], int(file.attrs["copies"]), found)


def response_of(found: Homogenized) -> Response:
    """The numbers of a followed specimen."""
    states = tuple(
        StateNumbers(s.load, s.force, s.energy, s.branch, s.negative_eigenvalues)
        for s in found.states
    )
    critical = found.critical
    return Response(None if critical is None else critical.load, states, found.outcome)


@dataclass(frozen=True, eq=False)
class HomogenizationData:
    """All that the report of a homogenized specimen shows."""

    found: Mapping[str, Any]
    """The content of ``homogenized.json``."""
    direct: Response
    """Of the direct simulation; without states where it is of another specimen or load."""
    path: Mapping[str, Any]
    """``Solution.info["path"]`` of it."""
    modes: tuple[LatticeMode, ...]
    parameters: ModeParameters | None
    """None where they were not given, or not measured."""
    warnings: tuple[str, ...]
    """Of the mode's measurement."""
    fields: HomogenizedFields
    measured: Result | None
    measured_strain: float
    """What was measured in the specimen's own images, and at which strain; None if nothing was."""
    command: str

    @property
    def compared(self) -> StateFields | None:
        """The homogenized state at the strain of the measured one."""
        near = [s for s in self.fields.states if abs(s.load - self.measured_strain) < 1e-9]
        return near[0] if near and self.measured is not None else None

    def measured_at(self, points: FloatArray) -> FloatArray:
        """(n,) v1 as it was measured, at points (n, 2) [mm]."""
        assert self.measured is not None
        x, y = points.T[..., None]
        return self.measured.ansatz.v(0, self.measured.unknowns, x, y)[:, 0]


def summary_of(title: str, case: Mapping[str, Any], data: HomogenizationData) -> dict[str, Any]:
    """The content of ``summary.json``."""
    found, response = data.found, data.found["response"]
    modes = data.modes
    return {
        "title": title,
        "case": dict(case),
        "outcome": response["outcome"],
        "critical_strain": response["critical_strain"],
        "critical_strain_sd": response["critical_strain_sd"],
        "criticals": found["criticals"],
        "branches": found["branches"],
        "first_order_critical_strain": found["first_order_critical_strain"],
        "states": response["states"],
        "direct": to_plain({"critical_strain": data.direct.critical_strain,
                            "states": data.direct.states}),
        "mode": to_plain({
            "kind": case["mode"]["kind"],
            "wave_change": [change for mode in modes for change in mode.wave_change],
            "waves": [mode.snapped for mode in modes],
            "errors": _errors(data.parameters),
        }) if modes else None,
        "sensitivities": found["effects"],
        "amplitude": _amplitude(data),
        "warnings": list(data.warnings),
        "rves": found["rves"],
        "linearisations": found["linearisations"],
        "files": {
            "homogenized.h5": "mesh and states: u, v_i, generalised strains, stresses, RVEs (HDF5)",
            "rve.h5": "the RVE for other codes: mesh, pairs, modes, moduli (HDF5)",
            "rve.mat": "the same mesh, pairs and modes in the layout of a MATLAB FE2 code",
            "homogenized.json": "critical strain, forces, energies, sensitivities",
            "mode.json": "the modes as they were measured and snapped, with their covariances",
            "experiment/": "the virtual experiment: simulation, images, what was measured in them",
        },
        "versions": versions(),
    }  # fmt: skip


def _errors(parameters: ModeParameters | None) -> str | None:
    """What the standard deviations of states count."""
    if parameters is None:
        return None
    return "noise" if parameters.by_model_error is None else "model error"


def _amplitude(data: HomogenizationData) -> dict[str, float] | None:
    """Rms over the lattice of v1 homogenized, measured, and of their difference [mm].

    Over the quadrature points, of a quarter's mirror images too, which stand for areas alike.
    """
    state, points = data.compared, data.fields.points
    if state is None:
        return None
    signs = _QUARTERS[: data.fields.copies]
    measured = np.concatenate([data.measured_at(points * sign) for sign in signs])
    v = np.tile(state.strains[:, _V], len(signs))
    homogenized, measured = aligned(v, measured)
    difference = homogenized - measured
    values = {"homogenized": homogenized, "measured": measured, "difference": difference}
    rms = {f"{name}_rms_mm": float(np.sqrt(np.mean(v**2))) for name, v in values.items()}
    return {"nominal_strain": state.load} | rms


def aligned(homogenized: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two amplitude fields (n,), the first with the sign of the second where both are known.

    A pattern and its mirror image are one buckled state.
    """
    sign = -1.0 if float(np.nansum(homogenized * measured)) < 0.0 else 1.0
    return sign * homogenized, measured
