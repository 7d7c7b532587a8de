"""From images to a start with no number typed: the same optimum as from the paper's start."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_fields import sampled_field, square_mode

from modeharvest.fem.field import Solution
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.ansatz import AnsatzOptions
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import correlate
from modeharvest.idic.local.field import LocalField
from modeharvest.idic.local.motion import edge_motion, first_motion, robust_fit
from modeharvest.idic.modes import FourierMode
from modeharvest.idic.photograph.geometry import Geometry, SpecimenTable, find_geometry
from modeharvest.idic.photograph.initial_guess import (
    InitialGuess,
    chosen_modes,
    hole_centres,
    initial_guess,
)
from modeharvest.idic.setup import PhotographOptions, SquareLatticeOptions
from modeharvest.idic.solver.gauss_newton import Outcome
from modeharvest.idic.spectra.pattern import REFERENCE_MODE
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.pair import ImagePair
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.runs.case import shipped_solution
from modeharvest.util.errors import InputError

PITCH = 1.9
CELLULAR = Box.centred(6 * PITCH, 10 * PITCH)
PIXEL = 0.04


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> ImageSet:
    """The paper's specimen before and after buckling, at a quarter of the paper's resolution."""
    solution = Solution.read(shipped_solution("paper-virtual"))
    folder: Path = tmp_path_factory.mktemp("images")
    return make_images(solution, ImagingSpec(pixel_size=PIXEL), folder, [0.078, 0.128])


def start_of(images: ImageSet, strain: float, **more: object) -> InitialGuess:
    return initial_guess(images.pair(strain), PITCH, CELLULAR, **more)


def correlated(images: ImageSet, strain: float, ansatz, unknowns):
    return correlate(images.pair(strain), ansatz, guess=unknowns)


def fluctuation(start: InitialGuess, points: np.ndarray) -> np.ndarray:
    """(n, 2) sum of v_i phi_i of the start at points."""
    total = start.ansatz.displacement_at(start.unknowns, points)
    return total - start.ansatz.v0(start.unknowns, points[:, None, 0], points[:, None, 1])[:, 0]


def test_images_alone_lead_where_the_papers_start_leads(images: ImageSet) -> None:
    """After buckling, at 12.8 %: nothing but images, masks, cell size and the cellular part."""
    start = start_of(images, 0.128)
    assert start.family == "square"
    assert not start.ansatz.fixed
    found = correlated(images, 0.128, start.ansatz, start.unknowns)
    assert found.outcome is Outcome.CONVERGED
    setup = SquareLatticeOptions()
    ansatz = setup.ansatz(Specimen())
    paper = correlated(images, 0.128, ansatz, ansatz.initial_guess(0.128, setup.start_amplitude))
    apart = (found.displacement() - paper.displacement())[images.mask()] / PIXEL
    # One minimum, reached from two sides: the tolerance of the iteration is 1e-3 px.
    assert np.sqrt(np.mean(apart**2)) < 2e-3


def test_without_a_pattern_the_mode_is_fixed(images: ImageSet) -> None:
    """Before buckling, at 7.8 %: the lattice's own pattern, its origin on a junction, held."""
    start = start_of(images, 0.078)
    assert start.ansatz.fixed
    assert start.patterns[0].family == "none"
    assert start.ansatz.modes[0].family.size == 0
    assert any("fixed at the square pattern" in s for s in start.text)
    x, y = np.linspace(-5, 5, 31), np.linspace(-9, 9, 41)
    phi = start.ansatz.phi(0, start.unknowns, x, y)
    ideal = square_mode(REFERENCE_MODE, PITCH, x[None, :], y[:, None])
    cosine = np.sum(phi * ideal) / (np.linalg.norm(phi) * np.linalg.norm(ideal))
    assert abs(cosine) > 0.999  # holes' centres are found to a small part of a pixel
    found = correlated(images, 0.078, start.ansatz, start.unknowns)
    assert found.outcome is Outcome.CONVERGED
    off = (found.displacement() - images.truth(0.078).displacement)[images.mask()] / PIXEL
    assert np.sqrt(np.mean(off**2)) < 0.5


def test_a_local_field_is_taken_at_its_word(images: ImageSet) -> None:
    """From the truth at the points of a subset DIC the start is within 0.6 px of the truth."""
    truth, mask = images.truth(0.128).displacement, images.mask()
    local = sampled_field(truth, images.grid, mask, 4)
    start = start_of(images, 0.128, local=local)
    assert start.patterns[0].start is not None
    off = (start.ansatz.displacement(start.unknowns, images.grid.x, images.grid.y) - truth)[mask]
    # What the ansatz can't say is 0.5 px here; the start has lower degrees, besides.
    assert np.sqrt(np.mean(off**2)) / PIXEL < 1.0


def test_hole_centres_are_used_and_strays_set_aside(images: ImageSet) -> None:
    grid, mask = images.grid, images.mask()
    pair = images.pair(0.128)
    centres = hole_centres(pair, [CELLULAR], PITCH)
    assert len(centres) == 60
    x, y = np.meshgrid(grid.x, grid.y)
    u = np.array(
        [
            np.nanmean(images.truth(0.128).displacement[np.hypot(x - a, y - b) < 0.9], axis=0)
            for a, b in centres
        ]
    )
    u[7] += 3.0  # a hole taken for another
    u[9] = np.nan
    domain = Box.centred(15.2, 20.8)
    motion, message = first_motion(domain, pair, LocalField(*centres.T, u))
    assert "the motion of 59 hole centres: a polynomial of degree 3" in message
    assert "2 of 118 components are outliers" in message
    off = motion(np.stack(np.meshgrid(grid.x, grid.y), -1)) - images.truth(0.128).displacement
    # The best cubic through all the material leaves 2.0 px, the pattern; here the solid strips
    # beyond the holes are extrapolated.
    assert np.sqrt(np.mean(off[mask] ** 2)) / PIXEL < 2.6


def patterned(grid: PixelGrid, shift=(0.0, 0.0), amplitude: float = 0.15) -> np.ndarray:
    """(rows, cols, 2) bending and the square pattern, moved."""
    x, y = np.meshgrid(grid.x - shift[0], grid.y - shift[1])
    slow = np.stack([-0.1 * x + 0.001 * x * y, 0.03 * y - 0.002 * x**2], axis=-1)
    envelope = (1 - 0.3 * (x / 6) ** 2)[..., None]
    return slow + amplitude * envelope * square_mode(REFERENCE_MODE, PITCH, x, y)


def holes_mask(
    grid: PixelGrid, vectors: np.ndarray, radius: float, origin=(0.0, 0.0)
) -> np.ndarray:
    """True outside circles around the lattice's points."""
    points = np.stack(np.meshgrid(grid.x - origin[0], grid.y - origin[1]), axis=-1)
    steps = points @ np.linalg.inv(vectors)
    nearest = steps - np.floor(steps)
    corners = [(0, 0), (0, 1), (1, 0), (1, 1)]
    away = [np.linalg.norm((nearest - c) @ vectors, axis=-1) for c in corners]
    return np.asarray(np.min(away, axis=0) > radius)


GRID = PixelGrid.centred(300, 220, 0.06)
NOISE = np.random.default_rng(0).normal(size=GRID.shape)
UNSEEN = ImagePair(NOISE, NOISE, GRID)
"""Images that are not looked at."""


def from_field(
    local: LocalField, cellular, cell_size: float = PITCH, **more: object
) -> InitialGuess:
    return initial_guess(UNSEEN, cell_size, cellular, local=local, **more)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.95, 0.95), (0.3, -0.7), (-1.4, 0.2)])
@pytest.mark.parametrize("amplitude", [0.15, -0.08])
def test_the_origin_may_be_anywhere_and_the_sign_either(shift, amplitude) -> None:
    """The pattern v1 phi1 of the start is the field's, wherever the axes' origin lies."""
    origin = np.array(shift) + 0.5 * PITCH
    mask = holes_mask(GRID, PITCH * np.eye(2), 0.7, origin)
    u = patterned(GRID, shift, amplitude)
    start = from_field(sampled_field(u, GRID, mask, 2), Box.centred(11.4, 15.2))
    assert start.family == "square"
    rng = np.random.default_rng(0)
    points = rng.uniform((-5, -7), (5, 7), (500, 2))
    x, y = (points - shift).T
    expected = amplitude * (1 - 0.3 * (x / 6) ** 2)[:, None]
    expected = expected * square_mode(REFERENCE_MODE, PITCH, x, y)
    error = fluctuation(start, points) - expected
    # A peak read 0.01 off drifts by 0.2 rad over the specimen's half.
    assert np.sqrt(np.mean(error**2)) < 0.15 * np.sqrt(np.mean(expected**2))


def test_waves_that_share_nothing_are_modes_of_their_own() -> None:
    """Three M waves of a hexagonal stacking: three modes, each with the amplitude of its wave."""
    pitch = 1.386
    vectors = pitch * np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
    first, second = np.linalg.inv(vectors).T
    waves = [(first / 2, 0.12), (second / 2, 0.08), ((first + second) / 2, 0.1)]
    x, y = np.meshgrid(GRID.x, GRID.y)
    u = np.stack([-0.05 * x, 0.02 * y], axis=-1)
    for k, (vector, amplitude) in enumerate(waves):
        across = np.array([-vector[1], vector[0]]) / np.linalg.norm(vector)
        phase = 2 * np.pi * (vector[0] * x + vector[1] * y) + 0.7 * k
        u += amplitude * np.sin(phase)[..., None] * across
    mask = holes_mask(GRID, vectors, 0.6)
    start = from_field(
        sampled_field(u, GRID, mask, 2), Box.centred(12.0, 16.0), pitch, lattice=vectors
    )
    assert len(start.ansatz.modes) == 3
    assert start.family == "1 wave, free and 1 wave, free and 1 wave, free"
    points = np.random.default_rng(1).uniform((-5, -7), (5, 7), (500, 2))
    error = (
        fluctuation(start, points)
        - (
            np.stack([u[..., 0] + 0.05 * x, u[..., 1] - 0.02 * y], -1)[
                tuple(np.rint(GRID.to_px(*points.T)).astype(int))
            ]
        )
    )
    assert np.sqrt(np.mean(error**2)) < 0.02  # of waves of 0.1 mm; half a pixel makes 0.006


def test_two_halves_with_patterns_of_their_own_get_modes_of_their_own() -> None:
    """Square above, the same pattern a cell aside below: neither is seen in the whole."""
    mask = holes_mask(GRID, PITCH * np.eye(2), 0.7, (PITCH / 2, PITCH / 2))
    above = np.broadcast_to((GRID.y > 0)[:, None, None], (*GRID.shape, 2))
    u = np.where(above, patterned(GRID), patterned(GRID, (PITCH, 0.0), 0.1))
    # Their slow parts differ by a translation, which is taken out.
    u = u + np.where(above, 0.0, [0.1 * PITCH * -1.0, 0.0])
    boxes = [Box(-5.7, 5.7, 0.0, 7.6), Box(-5.7, 5.7, -7.6, 0.0)]
    start = from_field(sampled_field(u, GRID, mask, 2), boxes)
    assert [mode.taper.cellular for mode in start.ansatz.modes] == boxes
    assert all(pattern.start is not None for pattern in start.patterns)
    for box, shift, amplitude in zip(boxes, ((0, 0), (PITCH, 0)), (0.15, 0.1), strict=True):
        low, high = (box.x_min + 1, box.y_min + 1.5), (box.x_max - 1, box.y_max - 1.5)
        points = np.random.default_rng(2).uniform(low, high, (300, 2))
        x, y = (points - shift).T
        expected = amplitude * (1 - 0.3 * (x / 6) ** 2)[:, None]
        expected = expected * square_mode(REFERENCE_MODE, PITCH, x, y)
        error = fluctuation(start, points) - expected
        assert np.sqrt(np.mean(error**2)) < 0.25 * np.sqrt(np.mean(expected**2))


def test_a_wrong_cell_size_is_contradicted(images: ImageSet) -> None:
    grid, mask = images.grid, images.mask()
    local = sampled_field(images.truth(0.128).displacement, grid, mask, 4)
    pair = images.pair(0.128)
    unmasked = replace(pair, mask=None, deformed_mask=None)
    # By the holes in the mask, whether there is a pattern or not.
    with pytest.raises(InputError, match=r"got 1.89 mm between neighbours of 60 holes"):
        initial_guess(pair, 3.8, CELLULAR, local=local)
    # By the spectrum, where no mask shows the holes.
    with pytest.raises(InputError, match=r"peaks at .* belong to a cell of 1\.9 mm"):
        initial_guess(unmasked, 1.6, CELLULAR, local=local)
    # By the lattice that was found.
    with pytest.raises(InputError, match=r"a lattice of holes 1.9 mm apart"):
        initial_guess(unmasked, 1.6, CELLULAR, local=local, lattice=1.9 * np.eye(2))


def test_options_are_what_the_ansatz_can_say() -> None:
    mask = holes_mask(GRID, PITCH * np.eye(2), 0.7, (PITCH / 2, PITCH / 2))
    local = sampled_field(patterned(GRID), GRID, mask, 2)
    options = AnsatzOptions(2, 1, brightness=0)
    ansatz = from_field(local, Box.centred(11.4, 15.2), options=options).ansatz
    assert ansatz.size == 2 * 6 + 3 + 7 + 2
    assert ansatz.domain == Box(*GRID.extent)


def test_boundaries_give_stretch_and_translation() -> None:
    before = np.zeros(GRID.shape, dtype=bool)
    before[50:250, 40:180] = True
    before[100:120, 60:80] = False  # a hole
    after = np.zeros(GRID.shape, dtype=bool)
    after[44:264, 60:186] = True
    affine = edge_motion(before, after, GRID)
    assert affine is not None
    np.testing.assert_allclose([affine[0, 1], affine[1, 2]], [-0.1, 0.1], atol=1e-4)
    x, y = GRID.to_mm(149.5, 109.5)
    moved = affine @ [1.0, float(x), float(y)]
    np.testing.assert_allclose(moved, [13 * 0.06, -4 * 0.06], atol=1e-9)
    before[0, 100] = True
    assert edge_motion(before, after, GRID) is None


def test_stray_values_hardly_move_a_robust_fit() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(-1, 1, 200)
    matrix = np.column_stack([np.ones(200), x])
    values = 2.0 - 3.0 * x + rng.normal(0, 0.01, 200)
    values[:30] += 50.0
    fit = robust_fit(matrix, values)
    np.testing.assert_allclose(fit.coefficients, [2.0, -3.0], atol=0.01)
    assert fit.outliers == 30
    # A median of which 15 % are strays is the good ones' 59th percentile: 1.22 times the sd.
    assert fit.sd == pytest.approx(0.0122, rel=0.2)


def chosen(vectors: np.ndarray, how: PhotographOptions) -> tuple[Geometry, FourierMode]:
    """The mode of a field without a pattern, on a plate with holes of 1.4 mm."""
    x, y = np.meshgrid(GRID.x, GRID.y)
    holes = ~holes_mask(GRID, vectors, 0.7, vectors.sum(axis=0) / 2)
    mask = ~(holes & Box.centred(4 * 1.9, 6 * vectors[1, 1]).contains(x, y))
    geometry = find_geometry(mask, GRID, SpecimenTable(1.9), Path())
    field = sampled_field(patterned(GRID, amplitude=0.0), GRID, mask, 2)
    boxes = list(geometry.parts.values())
    guess = from_field(field, boxes, lattice=geometry.lattice_mm, options=how)
    ansatz, unknowns = chosen_modes(guess, geometry, 1.9, how)
    assert unknowns.size == ansatz.size
    (mode,) = ansatz.modes
    return geometry, mode


@pytest.mark.parametrize("cells", [(2, 5), (6, 2), (3, 3), (4, 6)])
def test_a_pattern_of_few_cells_is_warned_of(cells: tuple[int, int]) -> None:
    around = Box.centred(*(1.9 * n for n in cells))
    x, y = np.meshgrid(GRID.x, GRID.y)
    holes = ~holes_mask(
        GRID, 1.9 * np.eye(2), 0.7, (0.95 * ((1 + cells[0]) % 2), 0.95 * ((1 + cells[1]) % 2))
    )
    geometry = find_geometry(~(holes & around.contains(x, y)), GRID, SpecimenTable(1.9), Path())
    assert geometry.lattice is not None
    assert len(geometry.lattice) == np.prod(cells)
    warned = " ".join(geometry.few_cells(1.9))
    assert ("is 2.0 cells across in view: on fewer than 3" in warned) == (min(cells) < 3)


@pytest.mark.parametrize("height", [1.9, 2.4])
@pytest.mark.parametrize("how", [{"family": "square"}, {"fixed_mode": False}])
def test_eq_mode_begins_on_the_lattice_of_the_holes(height: float, how: dict[str, object]) -> None:
    geometry, mode = chosen(np.diag([1.9, height]), PhotographOptions(**how))
    assert mode.family.size == (7 if "fixed_mode" in how else 0)  # none is observable
    rows = mode.family.waves(mode.family.start)
    expected = [[-height / 1.9, 1, 1, 1.9 / height], [-height / 1.9, -1, -1, 1.9 / height]]
    np.testing.assert_allclose(rows[:, :4], expected, rtol=1e-3)
    # Holes turn about their centres, neighbours in opposite senses.
    lattice = geometry.lattice
    assert lattice is not None
    x, y = GRID.to_mm(*lattice.centres.T)
    phase = np.pi / 1.9 * (np.outer(rows[:, 2], x) + np.outer(rows[:, 3], y) + rows[:, 4:])
    assert np.abs(np.sin(phase)).max() < 0.5 * np.pi * GRID.pixel_size / 1.9  # half a pixel


def test_eq_mode_is_refused_on_staggered_holes() -> None:
    vectors = 1.9 * np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
    for how in (PhotographOptions(family="square"), PhotographOptions(fixed_mode=False)):
        with pytest.raises(InputError, match=r"rectangular lattice.*got hexagonal lattice; set"):
            chosen(vectors, how)
