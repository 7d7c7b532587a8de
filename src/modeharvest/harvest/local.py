"""The local DIC of a harvest: another code's files, or pyvale's subsets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from modeharvest.harvest.experiment import Experiment
from modeharvest.harvest.inputs import of_each_photograph
from modeharvest.harvest.prepare import Prepared
from modeharvest.idic.fields.files import read_field
from modeharvest.idic.fields.local_field import LocalField
from modeharvest.idic.fields.subsets import SubsetOptions, subset_field
from modeharvest.imaging.distortion.mapping import Distortion
from modeharvest.imaging.grid import PixelGrid


def local_field(
    experiment: Experiment,
    base: Path,
    prepared: Prepared,
    name: str,
    distortion: Distortion | None,
) -> LocalField | None:
    """The displacement field of one deformed photograph by a local DIC; None if there is none.

    Files are of the photographs as they are; what the lens did to them is taken out here.

    Parameters
    ----------
    experiment, base
        What there is, and the folder its names are relative to.
    prepared
        The photographs, made ready.
    name
        Of the deformed photograph.
    distortion
        Of the lens.

    Raises
    ------
    InputError
        If there aren't as many files as photographs, or this one's can't be used.
    """
    table, grid = experiment.local, prepared.grid
    if table.code == "none":
        return None
    if table.code == "pyvale":
        options = SubsetOptions(subset_px=table.subset, step_px=table.step)
        return subset_field(
            prepared.image(), prepared.image(name), grid, prepared.mask(), prepared.mask(name),
            options,
        )  # fmt: skip
    path = of_each_photograph(experiment, base, table.files, "local.files")[name]
    field = read_field(
        path,
        grid,
        units=_told(table.unit),
        y_axis=_told(table.y_axis),
        first_pixel=table.first_pixel,
        columns=table.columns,
    )
    return field if distortion is None else without_distortion(field, grid, distortion)


def _told(value: str) -> str | None:
    return None if value == "auto" else value


def without_distortion(field: LocalField, grid: PixelGrid, distortion: Distortion) -> LocalField:
    """The field that an ideal lens would have shown: both ends of every displacement put right.

    Parameters
    ----------
    field
        Measured on photographs as they are.
    grid
        Their pixels.
    distortion
        Of the lens.
    """
    u = np.where(field.good[:, None], field.u, 0.0)
    row, col = distortion.ideal(*grid.to_px(field.x, field.y))
    row2, col2 = distortion.ideal(*grid.to_px(field.x + u[:, 0], field.y + u[:, 1]))
    x, y = grid.to_mm(row, col)
    x2, y2 = grid.to_mm(row2, col2)
    return replace(field, x=x, y=y, u=np.column_stack([x2 - x, y2 - y]))
