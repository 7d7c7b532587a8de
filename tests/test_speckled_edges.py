"""Contours of speckled photographs: a second measurement of the modes, beside the speckle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from summary_schemas import faults
from synthetic_photographs import Photographed, lattice_points

from modeharvest.fem.field import Solution
from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.photograph.plain.surface import away_from_cuts
from modeharvest.idic.photograph.speckled_edges import (
    body_for_edges,
    edges_of_speckled,
    measure_by_contours,
)
from modeharvest.idic.result import Result
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.photographs.contour import Contour
from modeharvest.imaging.photographs.files import write_image
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.runs.photographs.pipeline import harvest
from modeharvest.util.errors import InputError
from modeharvest.validation.whole_field import v_percent, waves_percent

pytest.importorskip("gmsh")
pytestmark = pytest.mark.usefixtures("coarse_pictures", "unrendered_pictures")

SHIPPED = Path(__file__).parents[1] / "src/modeharvest/cases/paper-virtual.h5"
PITCH, PIXEL, FINER, DIAMETER = 1.9, 0.035, 0.025, 1.4
CELLULAR, DOMAIN = Box.centred(4 * PITCH, 4 * PITCH), Box.centred(4 * PITCH + 1.6, 4 * PITCH + 1.6)
HOLES = lattice_points(PITCH * np.eye(2), CELLULAR, (PITCH / 2, PITCH / 2))
PHOTOGRAPHED = Photographed(PixelGrid.centred(310, 310, PIXEL), DOMAIN, HOLES, DIAMETER)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped specimen, buckled: what contours don't show follows from its equilibrium."""
    path = tmp_path_factory.mktemp("photographs")
    spec = ImagingSpec(
        FINER, 20, background=0.06, speckle=SpeckleSpec(standard_deviation=0.1, blur_px=1.0),
        sensor=Sensor(read_noise=0.01), bits=8,
    )  # fmt: skip
    make_images(Solution.read(SHIPPED), spec, path, [0.128])
    (path / "experiment.toml").write_text(
        '[images]\nreference = "reference_8bit.tif"\ndeformed = ["deformed_*_8bit.tif"]\n'
        f"[scale]\npixel_size = {FINER}\n[specimen]\ncell_size = {PITCH}\n"
    )
    return path


def test_edges_are_found_to_parts_of_a_pixel_and_know_their_noise() -> None:
    image, grid, mask = PHOTOGRAPHED.image(), PHOTOGRAPHED.grid, PHOTOGRAPHED.mask
    found = edges_of_speckled(image, mask, PITCH / PIXEL)
    assert len(found.contours) == 1 + len(HOLES)
    off, lengths = [], []
    for points in found.contours[1:]:
        contour = Contour(np.column_stack(grid.to_mm(*points.T)))
        x, _ = contour.evenly(0.5 * PIXEL)
        nearest = HOLES[np.linalg.norm(HOLES - contour.moments[1], axis=1).argmin()]
        off.append((np.linalg.norm(x - nearest, axis=1) - DIAMETER / 2) / PIXEL)
        lengths.append(contour.length / PIXEL)
    every = np.concatenate(off)
    assert abs(every.mean()) < 0.25  # of both photographs alike
    assert every.std() < 0.5
    # A hole's mean radius averages noise over its edge; half of the variance is in common.
    of_means = np.var([part.mean() for part in off]) * np.mean(lengths)
    assert 0.3 < 2.0 * found.noise / of_means < 3.0


def test_contours_alone_show_the_modes(folder: Path) -> None:
    pair = ImageSet.read(folder).pair(0.128, camera=True)
    assert pair.truth is not None
    specimen = Solution.read(SHIPPED).specimen
    assert specimen is not None
    true, mask, grid = pair.truth.displacement, pair.masks[0], pair.grid
    ansatz = Ansatz.of_specimen(specimen)
    best = fit_displacement(true, grid, ansatz, ansatz.initial_guess(0.128), mask)
    edges = edges_of_speckled(pair.reference, mask, PITCH / FINER)
    body = body_for_edges(mask, grid, PITCH / FINER)
    found = measure_by_contours(edges, pair, best, PITCH, body)
    assert v_percent(found.result, best) < 2.0
    assert waves_percent(found.result, best) < 0.5
    assert found.edge_sd_px < 0.5


def test_of_a_part_in_view_the_pixels_away_from_its_border_are_compared(
    folder: Path, tmp_path: Path
) -> None:
    rows, cols = np.s_[150:650], np.s_[125:525]
    for path in folder.glob("*_8bit.tif"):
        write_image(tmp_path / path.name, tifffile.imread(path)[rows, cols])
    text = (folder / "experiment.toml").read_text("utf-8")
    (tmp_path / "experiment.toml").write_text(text)
    summary = harvest(tmp_path / "experiment.toml", tmp_path / "out", contours=True)
    (frame,) = summary["frames"]
    assert faults(summary, "harvest") == []
    assert "by contours alone" in (tmp_path / "out/report.html").read_text("utf-8")
    name, beside = frame["name"], frame["contours"]
    assert any("Not all of the specimen is in view" in text for text in beside["warnings"])
    found, speckle = (
        Result.read(tmp_path / f"out/contours/{name}{of}.json") for of in ("", "_speckle")
    )
    true = ImageSet.read(folder).truth(0.128).displacement[rows, cols]
    inner = away_from_cuts(np.isfinite(true).all(axis=-1), found.grid, PITCH)
    assert speckle.pixels < inner.sum() < 0.7 * frame["pixels"]
    best = fit_displacement(true, found.grid, found.ansatz, found.unknowns, inner)
    off = [np.linalg.norm((r.displacement() - best.displacement())[inner], axis=-1).mean()
           for r in (found, speckle)]  # fmt: skip
    assert off[0] < min(0.3 * FINER, off[1])
    assert waves_percent(found, best) < 0.3
    # Three by five cells show no more; the whole picture does.
    assert (found.ansatz.v0_degree, found.ansatz.v_degree) == (4, 4)
    assert beside["edge_sd_px"] < 0.5
    waves = [row["difference_sd"] for row in beside["compared"] if "wave" in row["what"]]
    assert np.abs(waves).max() < 2.0
    assert abs(beside["pattern_ratio"] - 1.0) < 0.06


def test_too_small_a_part_is_refused() -> None:
    """Of a picture of four by four cells two are a cell from its border."""
    inner = np.s_[46:-46, 46:-46]
    image, mask = PHOTOGRAPHED.image()[inner], PHOTOGRAPHED.mask[inner]
    grid = PixelGrid.centred(*mask.shape, PIXEL)
    edges = edges_of_speckled(image, mask, PITCH / PIXEL)
    pair = ImagePair(image, image, grid, mask, mask)
    known = fit_displacement(
        np.zeros((*mask.shape, 2)), grid, Ansatz(Box(*grid.extent)), np.zeros(42)
    )
    body = body_for_edges(mask, grid, PITCH / PIXEL)
    with pytest.raises(InputError, match=r"3 cells across or more .* got 2\.0; take more"):
        measure_by_contours(edges, pair, known, PITCH, body)
