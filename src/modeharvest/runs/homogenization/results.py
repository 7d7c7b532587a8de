"""Results of a homogenized specimen: its fields, its summary, the data of the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modeharvest.fem.field import Mesh, read_values, write_values
from modeharvest.fem.lattice.micromorphic.body import quadrature
from modeharvest.idic.result import Result
from modeharvest.idic.uncertainty.covariance import field_errors
from modeharvest.util.arrays import FloatArray
from modeharvest.util.files import atomic_hdf5, open_hdf5
from modeharvest.util.machine import on_first
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
"""Signs of x and y in the four quarters of the specimen."""
_REVERSED = [0, 3, 2, 1, 7, 6, 5, 4]
"""Node order of a Q8 element with reversed orientation, as after mirroring."""


@dataclass(frozen=True, eq=False)
class StateFields:
    """A state of the homogenized specimen on its macroscopic mesh."""

    load: float
    """Nominal strain [-]."""
    displacement: FloatArray
    amplitudes: FloatArray
    """(n, 2) u [mm] and (n, m) v_i [mm] at the nodes; NaN where there is no lattice."""
    strains: FloatArray
    stresses: FloatArray
    """(p, 4 + 3 m) F̄, v, g and P̄, Pi, Lambda at the lattice's points, tensors row by row."""
    microstructure: FloatArray
    """(p, k, 2) displacement of the RVE's nodes at each point, relative to its centre [mm]."""


def write_fields(found: Homogenized, body: HomogenizedBody, path: Path) -> None:
    """Write mesh and states of the whole specimen as HDF5, a group ``states/K`` for each state.

    If a quarter was simulated, fields are mirrored; the points remain those of the quarter.
    """
    signs, every, count = _QUARTERS[: body.copies], list[StateFields](), len(body.rves)
    for state in found.states:  # on all ranks, each of which has some of the RVEs
        u = np.concatenate([state.displacement * sign for sign in signs])
        v = np.tile(state.amplitudes, (len(signs), 1))
        micro = np.stack([
            body.microstructure(state.value, state.strains, number)
            for number in range(0, len(body.places) * count, count)
        ])  # fmt: skip
        every.append(StateFields(state.load, u, v, state.strains, state.stresses, micro))

    def write() -> None:
        with atomic_hdf5(path) as file:
            file.attrs.update(format=FORMAT, copies=body.copies)
            write_values(file.create_group("mesh"), _unfolded(body.mesh, signs))
            write_values(file.create_group("rve"), body.rves[0].cell.cell.mesh)
            file["points"] = body.places
            for k, fields in enumerate(every):
                write_values(file.create_group(f"states/{k:03d}"), fields)

    on_first(write)


def _unfolded(mesh: Mesh, signs: FloatArray) -> Mesh:
    """A mesh and its mirror images, concatenated; nodes on mirror lines are duplicated."""
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
    """Macroscopic mesh of the whole specimen [mm]."""
    rve: Mesh
    """Mesh of the first RVE at a point, relative to its centre [mm]."""
    points: FloatArray
    """(p, 2) positions of the RVEs [mm]; only those in the quarter if a quarter is simulated."""
    states: tuple[StateFields, ...]

    @classmethod
    def read(cls, path: Path) -> HomogenizedFields:
        """Read a file of :func:`write_fields`."""
        with open_hdf5(path, "a homogenized specimen", form=FORMAT) as file:
            states = file.get("states", {})
            found = tuple(read_values(states[key], StateFields) for key in sorted(states))
            mesh, rve = (read_values(file[name], Mesh) for name in ("mesh", "rve"))
            return cls(mesh, rve, file["points"][()], found)


def response_of(found: Homogenized) -> Response:
    """Loads, forces, energies and critical load of a simulated homogenized specimen."""
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
    """Response of the direct simulation; no states if its specimen or load is another."""
    path: Mapping[str, Any]
    """``Solution.info["path"]`` of the direct simulation."""
    modes: tuple[LatticeMode, ...]
    parameters: ModeParameters | None
    """Measured mode parameters; None if the modes were not measured."""
    warnings: tuple[str, ...]
    """Warnings of the mode's measurement."""
    fields: HomogenizedFields
    measured: Result | None
    measured_strain: float
    """Result measured in the specimen's images (None if there is none), and its strain [-]."""
    command: str

    @property
    def compared(self) -> StateFields | None:
        """The homogenized state at the measured strain; None if there is none."""
        near = [s for s in self.fields.states if abs(s.load - self.measured_strain) < 1e-9]
        return near[0] if near and self.measured is not None else None

    def measured_at(self, points: FloatArray) -> FloatArray:
        """(n, 3) measured v0 and v1 [mm] at points (n, 2) [mm]."""
        assert self.measured is not None
        (x, y), a, of = points.T[..., None], self.measured.unknowns, self.measured.ansatz
        return np.hstack([of.v0(a, x, y)[:, 0], of.v(0, a, x, y)])

    def measured_sd(self, points: FloatArray) -> FloatArray:
        """(n, 3) standard deviations of the measured v0 and v1 [mm] at points (n, 2) [mm]."""
        (x, y), known = points.T[..., None], self.parameters
        assert self.measured is not None
        errors = field_errors(self.measured, x, y, np.asarray(known and known.of_fields))
        return np.hstack([errors.v0[:, 0], errors.v[0]])


def not_reached(response: Mapping[str, Any], count: int) -> list[str]:
    """A warning if there are fewer states than the specified ``count``."""
    found = len(response["states"])
    text = f"{count - found} of {count} states were not reached: {response['outcome']}"
    return [text] if found < count else []


def summary_of(title: str, case: Mapping[str, Any], data: HomogenizationData) -> dict[str, Any]:
    """The content of ``summary.json``."""
    found, response = data.found, data.found["response"]
    modes, known = data.modes, data.parameters
    source = "found" if case["homogenization"]["edge_shifts"] == "find" else "given"
    return {
        "title": title,
        "command": data.command,
        "case": dict(case),
        "outcome": response["outcome"],
        "critical_strain": response["critical_strain"],
        **{k: response[k] for k in response if k.startswith("critical_strain_sd")},
        "criticals": found["criticals"],
        "branches": found["branches"],
        "first_order_critical_strain": found["first_order_critical_strain"],
        "states": response["states"],
        "direct": to_plain({"critical_strain": data.direct.critical_strain,
                            "states": data.direct.states}),
        "mode": to_plain({
            "kind": case["mode"]["kind"],
            "wave_change": [change for mode in modes for change in mode.wave_change],
            "wave_deviation": known.deviations or None if known else None,
            "waves": [mode.snapped for mode in modes],
            "errors": known and ("noise" if known.by_model_error is None else "model error"),
        }) if modes else None,
        "sensitivities": found["effects"],
        "edge_shifts": {"mm": found["edge_shifts_mm"], "source": source},
        **_compared(data),
        "warnings": list(data.warnings),
        "rves": found["rves"],
        "linearisations": found["linearisations"],
        "files": {
            "homogenized.h5": "mesh and states: u, v_i, generalised strains, stresses, RVEs (HDF5)",
            "rve.h5": "the RVE for other codes: mesh, pairs, modes, moduli (HDF5)",
            "rve.mat": "the same mesh, pairs and modes in the layout of a MATLAB FE2 code",
            **{f"rve{k}.{kind}": f"the same of position {k}" for kind in ("h5", "mat")
               for k in range(2, case["homogenization"]["positions"] + 1)},
            "homogenized.json": "critical strain, forces, energies, sensitivities",
            "mode.json": "the modes as they were measured and snapped, with their covariances",
            "experiment/": "the virtual experiment: simulation, images, what was measured in them",
        },
        "versions": versions(),
    }  # fmt: skip


def _compared(data: HomogenizationData) -> dict[str, dict[str, float] | None]:
    """Compare u with v0, and v1 with v1: rms of homogenized, measured and their difference [mm].

    Over the lattice; for v0 rms of its length. Also the standard deviation of the measured field,
    and the difference relative to it, per component. With several modes v1 isn't compared: which
    one is strongest, and their signs, depend on which of several equivalent branches is found.
    """
    state, mesh = data.compared, data.fields.mesh
    found: dict[str, dict[str, float] | None] = {"displacement": None, "amplitude": None}
    if state is None:
        return found
    cells = mesh.cells[np.isfinite(state.amplitudes[:, 0][mesh.cells]).all(axis=1)]
    at = quadrature(Mesh(mesh.nodes, cells, mesh.element), 3)
    nodal = np.hstack([state.displacement, state.amplitudes])[cells]
    homogenized = np.einsum("pk,ckf->cpf", at.shapes, nodal).reshape(-1, nodal.shape[-1])
    places, weights = at.places.reshape(-1, 2), at.weights.ravel()
    measured, sd = data.measured_at(places), data.measured_sd(places)
    parts = {"displacement": (homogenized[:, :2], measured[:, :2], sd[:, :2])}
    if len(data.modes) == 1:
        parts["amplitude"] = *aligned(homogenized[:, 2:], measured[:, 2:]), sd[:, 2:]
    for name, (ours, theirs, error) in parts.items():
        off = ours - theirs
        values = {"homogenized": ours, "measured": theirs, "measured_sd": error, "difference": off}
        rms = {f"{k}_rms_mm": float(np.sqrt(np.average(np.sum(v**2, axis=1), weights=weights)))
               for k, v in values.items()}  # fmt: skip
        ratio = np.sqrt(np.average(np.mean((off / error) ** 2, axis=1), weights=weights))
        found[name] = {"nominal_strain": state.load, "difference_over_sd": float(ratio)} | rms
    return found


def aligned(homogenized: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two amplitude fields of equal shape, the first with its overall sign matched to the second.

    A pattern and its mirror image are the same buckled state. NaN values are ignored.
    """
    sign = -1.0 if float(np.nansum(homogenized * measured)) < 0.0 else 1.0
    return sign * homogenized, measured
