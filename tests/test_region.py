"""The cellular part from a lattice, a polygon or a mask image: one specimen, one set of boxes."""

from __future__ import annotations

import re
from dataclasses import astuple

import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.fem.specimen import Specimen
from modeharvest.idic.photograph.geometry import (
    junction,
    region_of_lattice,
    region_of_mask,
    region_of_polygon,
)
from modeharvest.idic.photograph.holes import find_hole_lattice
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.errors import InputError

SPECIMEN = Specimen(holes_x=4, holes_y=3)
GRID = PixelGrid.centred(251, 401, 0.04)  # [mm/px]; room for the bulk all around


def specimen_mask(grid: PixelGrid = GRID) -> NDArray[np.bool_]:
    x, y = grid.x[None, :], grid.y[:, None]
    width, height = SPECIMEN.half_size
    mask = (abs(x) <= width) & (abs(y) <= height)
    for cx, cy in SPECIMEN.hole_centres:
        mask = mask & (np.hypot(x - cx, y - cy) > 0.5 * SPECIMEN.diameter)
    return np.asarray(mask)


def test_boxes_of_the_specimen_are_found() -> None:
    mask = specimen_mask()
    region = region_of_lattice(find_hole_lattice(mask), mask, GRID)
    (a, b), (width, height) = SPECIMEN.cellular_half_size, SPECIMEN.half_size
    px = GRID.pixel_size
    np.testing.assert_allclose(astuple(region.cellular), (-a, a, -b, b), atol=0.1 * px)
    np.testing.assert_allclose(astuple(region.domain), (-width, width, -height, height), atol=px)


def test_all_three_ways_agree() -> None:
    mask = specimen_mask()
    by_lattice = region_of_lattice(find_hole_lattice(mask), mask, GRID)
    box = by_lattice.cellular
    (top, bottom), (left, right) = GRID.to_px([box.x_min, box.x_max], [box.y_max, box.y_min])
    by_polygon = region_of_polygon(
        [(top, left), (top, right), (bottom, right), (bottom, left)], mask, GRID
    )
    part = np.zeros(GRID.shape, dtype=bool)
    part[round(float(top)) : round(float(bottom)) + 1, round(float(left)) : round(float(right))] = 1
    by_mask = region_of_mask(part, mask, GRID)
    for other in (by_polygon, by_mask):
        np.testing.assert_allclose(
            astuple(other.cellular), astuple(by_lattice.cellular), atol=1.01 * GRID.pixel_size
        )
        assert other.domain == by_lattice.domain


def test_junction_lies_between_holes() -> None:
    mask = specimen_mask()
    x, y = junction(find_hole_lattice(mask), GRID)
    nearest = np.linalg.norm(SPECIMEN.hole_centres - (x, y), axis=1).min()
    assert nearest == pytest.approx(SPECIMEN.pitch / np.sqrt(2.0), rel=1e-3)


def test_edges_outside_the_image_are_named() -> None:
    grid = PixelGrid.centred(251, 201, 0.04)  # cuts both loaded edges off
    mask = specimen_mask(grid)
    corners = [(60, 30), (60, 170), (190, 170), (190, 30)]
    region = region_of_polygon(corners, mask, grid)
    assert "leaves the image at the left, right" in region.text[-1]


def test_a_region_that_is_no_rectangle_is_reported() -> None:
    triangle = [(60.0, 60.0), (60.0, 340.0), (190.0, 60.0)]
    region = region_of_polygon(triangle, specimen_mask(), GRID)
    assert re.search(r"fills 5[01] % of its bounding box", region.text[1])  # rounding of px


def test_bad_regions_are_refused() -> None:
    mask = specimen_mask()
    with pytest.raises(InputError, match="at least three corners"):
        region_of_polygon([(0, 0), (1, 1)], mask, GRID)
    with pytest.raises(InputError, match="inside the image of 251 x 401"):
        region_of_polygon([(0, 0), (0, 500), (100, 0)], mask, GRID)
    with pytest.raises(InputError, match=r"got 0\.0 % of it"):
        region_of_polygon([(0, 0), (0, 10), (10, 0)], mask, GRID)
    with pytest.raises(InputError, match="shape"):
        region_of_mask(mask[:-1], mask, GRID)
    line = np.zeros(GRID.shape, dtype=bool)
    line[120] = True
    with pytest.raises(InputError, match="lie in one line"):
        region_of_mask(line, mask, GRID)
    with pytest.raises(InputError, match=r"got 0\.0 % of it"):
        region_of_mask(np.zeros(GRID.shape), mask, GRID)
