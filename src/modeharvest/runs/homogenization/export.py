"""Export of an RVE to other codes: mesh, modes, moduli as HDF5, and for a MATLAB FE2 code.

``examples/read_rve.py`` reads the HDF5 file with h5py only; its layout: docs/reference/rve.md.
"""

from __future__ import annotations

import inspect
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import ArrayLike
from scipy.io import savemat

from modeharvest.fem.field import COMPRESSED
from modeharvest.fem.lattice.micromorphic.patterns import PlaneWaves
from modeharvest.fem.lattice.periodicity import Periodicity
from modeharvest.fem.materials import TwoTermI1, material_table
from modeharvest.util.arrays import IntArray
from modeharvest.util.files import atomic, atomic_hdf5
from modeharvest.validation.homogenization import MeasuredModes

if TYPE_CHECKING:
    from modeharvest.fem.lattice.micromorphic.rve import RVE, RVEState

FORMAT = "modeharvest-rve-1"
THICKNESS = 1.0  # mm: the program's forces and energies are per unit thickness
_PER_STRAIN, _STRESS = "of the strain", "MPa by the unit of the strain"
QUANTITIES = {
    "nodes": ("mm", "undeformed, from the RVE's centre"),
    "cells": ("-", "six-node triangles: corners counter-clockwise, then mid-sides 12, 23, 31"),
    "materials": ("-", "of each cell, the number of its law among material/0 ..."),
    "thickness": ("mm", "to which forces and energies refer; plane strain"),
    "lattice": ("mm", "the RVE's lattice vectors, as rows"),
    "area": ("mm^2", "|Q| of the RVE, holes included"),
    "centre": ("mm", "of the RVE, in the coordinates of the cell that modes were given on"),
    "pairs": ("-", "image and source node, of which the latter is no image"),
    "shifts": ("-", "lattice vectors from source to image: X_image - X_source = shifts @ lattice"),
    "fixed_node": ("-", "a source; w = 0 there, or <w> = 0, takes away translations"),
    "modes": ("-", "phi_i at the nodes, of mean 0 over the material"),
    "scales": ("-", "what each mode, as it was given, was multiplied by"),
    "averages": ("-", "weights: <w>, <(w - <w>) . phi_i>, <((w - <w>) . phi_i) X> by |Q|"),
    "vectors": ("rad/mm", "wave vectors k"),
    "cosine": ("-", "phi = scale sum cosine cos(k . X) + sine sin(k . X), less its mean"),
    "sine": ("-", "the same of the sines"),
    "covariance": ("-", "of cosine and sine, each row by row: J C J^T, C the larger one known"),
    "derivatives": ("1/unit", "J: of cosine and sine by the parameters, waves snapped"),
    "parameters": ("units", "of all modes, as measured; attributes names and units"),
    "by_noise": ("units", "covariance of the parameters by the images' noise"),
    "by_model_error": ("units", "covariance by noise and model error; absent where unknown"),
    "strains": (_PER_STRAIN, "F11, F12, F21, F22, v_i, then dv_i/dx, dv_i/dy of each mode"),
    "energy": ("MPa", "W, stored by |Q|"),
    "stresses": (_STRESS, "dW by the strains: P, Pi_i, Lambda_i in the same order"),
    "moduli": (_STRESS, "derivatives of the stresses by the strains, w in equilibrium"),
    "fluctuations": ("mm", "w at the nodes, <w> = 0; of a primary state the primary field"),
    "negative_eigenvalues": ("-", "of the tangent in w at fixed strains; 0: stable"),
    "loads": ("-", "nominal strain of the specimen"),
    "points": ("mm", "where in the specimen"),
    "buckled": ("-", "1: on the buckled branch, 0: on the primary path"),
}
"""Unit and description of each dataset, which are also written as its attributes."""


def write_rve(
    path: Path | str, rve: RVE, states: Sequence[RVEState] = (),
    measured: MeasuredModes | None = None, position: tuple[int, int] = (1, 1),
    **of_states: ArrayLike,
) -> None:  # fmt: skip
    """Write an RVE with its modes, and its stresses and moduli at some states, as HDF5.

    measured : parameters and covariances of all modes, if they were measured.
    position : number of this RVE, from 1, and the number of RVEs averaged at each point.
    of_states : "loads" (k,), "points" (k, 2) [mm], "buckled" (k,) of the states, if they are
        those of a specimen.
    """
    mesh, periodicity, m = rve.cell.cell.mesh, rve.cell.cell.periodicity, rve.mode_count
    pairs = periodic_pairs(periodicity)
    with atomic_hdf5(path) as file:
        file.attrs.update(format=FORMAT, element=mesh.element, normalisation=rve.normalisation)
        file.attrs.update(position=position[0], positions=position[1])
        file.attrs["strains"] = _named(m, "F11 F12 F21 F22", "v{}", "dv{}/dx dv{}/dy")
        file.attrs["strain_units"] = _named(m, "- - - -", "mm", "- -")
        file.attrs["stresses"] = _named(m, "P11 P12 P21 P22", "Pi{}", "Lambda{}x Lambda{}y")
        file.attrs["stress_units"] = _named(m, *["MPa MPa MPa MPa", "MPa/mm", "MPa MPa"])
        materials, shifts = np.zeros(len(mesh.cells), np.int64), periodicity.shift[pairs]
        _put(file, nodes=mesh.nodes, cells=mesh.cells, materials=materials, thickness=THICKNESS)
        _put(file, lattice=rve.cell.cell.lattice, area=rve.area, centre=rve.centre)
        _put(file, pairs=pairs, shifts=shifts[:, 0] - shifts[:, 1], fixed_node=pairs[0, 1])
        _put(file, modes=rve.shapes, scales=rve.scales, averages=rve.averages)
        law = file.create_group("material/0")
        law.attrs.update(material_table(rve.material))
        law.attrs["law"] = inspect.getdoc(rve.material) or ""
        for k, mode in enumerate(rve.modes):
            if isinstance(mode, PlaneWaves):
                _put(file.create_group(f"waves/{k}"), **vars(mode.moved(-rve.centre)))
        if measured is not None:
            _put_measured(file, measured, rve)
        if states:
            names = "strains", "stresses", "moduli", "energy", "negative_eigenvalues"
            every = {name: [getattr(s, name) for s in states] for name in names}
            fluctuations = [s.fluctuation for s in states]
            _put(file.create_group("states"), **every, fluctuations=fluctuations, **of_states)


def _named(count: int, gradient: str, each: str, slope: str) -> list[str]:
    """Names of all generalised strains: of F̄, of each mode, of each mode's gradient."""
    numbers = range(1, count + 1)
    parts = [gradient, *(each.format(k) for k in numbers), *(slope.format(k, k) for k in numbers)]
    return " ".join(parts).split()


def _put(group: h5py.Group, **values: ArrayLike | None) -> None:
    """Write values that are not None, each with its unit and description as attributes."""
    for name, value in values.items():
        if value is not None:
            kept = COMPRESSED if np.ndim(value) > 1 else {}
            data = group.create_dataset(name, data=np.asarray(value), **kept)
            data.attrs["unit"], data.attrs["meaning"] = QUANTITIES[name]


def _put_measured(file: h5py.File, measured: MeasuredModes, rve: RVE) -> None:
    """Write parameters and covariances, and each mode's error bars and waves before snapping."""
    known = measured.parameters
    group, covariances = file.create_group("measured"), ("by_noise", "by_model_error")
    _put(group, parameters=known.values, **{name: getattr(known, name) for name in covariances})
    group["parameters"].attrs.update(names=known.names, units=known.units)
    modes, derivatives = measured.modes(known.values), measured.derivatives(rve.centre)
    for k, (mode, J) in enumerate(zip(modes, derivatives, strict=True)):
        _put(file[f"waves/{k}"], covariance=J @ known.covariance @ J.T, derivatives=J)
        before = mode.measured.moved(-rve.centre)
        _put(file.create_group(f"waves/{k}/measured"), **vars(before))


def periodic_pairs(periodicity: Periodicity) -> IntArray:
    """(p, 2) image and source of all periodic node pairs; no source is an image."""
    _, first = np.unique(periodicity.master, return_index=True)
    sources = first[periodicity.master]
    images = np.flatnonzero(sources != np.arange(len(sources)))
    return np.stack([images, sources[images]], axis=1)


def write_fe2(path: Path | str, rve: RVE) -> None:
    """Write an RVE as a MATLAB file: ``RVEmesh``, and materials if the FE2 code has their law.

    The layout is that of the code of Doskar, Rokos and others, github.com/FHendriks11/
    mechmetamat_homogenization: node numbers from 1, six-node triangles in the order of this
    program, unknowns x1, y1, x2, ...; the modes are the columns of ``[RVEmesh.phi{:}]``.
    """
    mesh = rve.cell.cell.mesh
    images, sources = periodic_pairs(rve.cell.cell.periodicity).T + 1.0
    phi = np.empty((1, rve.mode_count), dtype=object)
    phi[0] = [shape.reshape(-1, 1) for shape in rve.shapes]
    content: dict[str, Any] = {"RVEmesh": {
        "nodes": np.column_stack([mesh.nodes, np.ones(len(mesh.nodes))]),
        "nNodes": float(len(mesh.nodes)),
        "elements": mesh.cells + 1.0,
        "nElems": float(len(mesh.cells)),
        "elemMats": np.ones((len(mesh.cells), 1)),
        "FE2": {
            "V": rve.area,
            "periodicSourceNodes": sources[:, None],
            "periodicImageNodes": images[:, None],
            "fixedNode": sources[0],
        },
        "phi": phi,
    }}  # fmt: skip
    if isinstance(law := rve.material, TwoTermI1):
        row = [2.0, law.c1, law.c2, 0.0, 0.0, 0.0, law.bulk, THICKNESS]
        content["microMaterials"] = np.array([row])
    memory = io.BytesIO()
    savemat(memory, content, do_compression=True)
    with atomic(path) as temporary:
        # By default the header's text, 116 bytes, contains the date.
        head = b"MATLAB 5.0 MAT-file, RVE in mm and MPa".ljust(116)
        temporary.write_bytes(head + memory.getvalue()[116:])
