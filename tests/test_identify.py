"""Parameters identified from images, fields and forces: a model of a closed form.

A plate is stretched along x by a and, by b a, along y, under a force c a. Images are sums of waves,
exact at every point.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from modeharvest.fem.field import Mesh
from modeharvest.idic.finite_element.equations.pixels import MeshPixels
from modeharvest.idic.finite_element.identification.identify import (
    LEVELS,
    FinerMesh,
    Identified,
    Readings,
    Unknown,
    identify,
)
from modeharvest.idic.finite_element.identification.model_error import corrections, in_words
from modeharvest.idic.finite_element.identification.observed import (
    MOTION,
    PLACE,
    FieldData,
    ImageData,
    imaged,
    rigidly_moved,
    through_lens,
)
from modeharvest.idic.finite_element.light import alike
from modeharvest.idic.finite_element.mesh import quadratic
from modeharvest.idic.finite_element.result import nodal_values
from modeharvest.idic.solver.noise import ImageNoise
from modeharvest.idic.solver.pyramid import FULL, Level
from modeharvest.idic.uncertainty.parameters import undetermined_combinations
from modeharvest.imaging.distortion.lens import CameraDistortion, Distortion
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.pair import ImagePair
from modeharvest.util.errors import InputError

FloatArray = NDArray[np.float64]


def plate(width: float, height: float, n: int, m: int) -> Mesh:
    """A rectangle about the origin of 2 n m triangles."""
    x, y = np.meshgrid(
        np.linspace(-0.5, 0.5, n + 1) * width, np.linspace(-0.5, 0.5, m + 1) * height
    )
    a = (np.arange(m)[:, None] * (n + 1) + np.arange(n)).ravel()
    corners = [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]
    return quadratic(Mesh(np.stack([x.ravel(), y.ravel()], 1), np.hstack(corners).T, "T3"))


MESH = plate(4.0, 3.0, 5, 4)
GRID = PixelGrid.centred(90, 116, 0.04)
TRUE = np.array([0.05, -0.6, 2.0])
NOISE = 0.01
LOADS = (1.0, 2.0)


@dataclass(frozen=True)
class State:
    strain: float
    displacement: FloatArray
    force: float
    displacement_by: FloatArray
    force_by: FloatArray
    strain_by: FloatArray
    nodes_by: FloatArray = field(default_factory=lambda: np.zeros((3, *MESH.nodes.shape)))
    mesh: Mesh = MESH


def model(values: FloatArray) -> list[State]:
    a, b, c = values
    x, y = MESH.nodes.T
    none = np.zeros_like(x)
    return [
        State(
            e * a, e * a * np.stack([x, b * y], axis=1), e * a * c,
            np.stack([e * np.stack([x, b * y], 1), e * a * np.stack([none, y], 1), 0 * MESH.nodes]),
            np.array([e * c, 0.0, e * a]), np.array([e, 0.0, 0.0]),
        )
        for e in LOADS
    ]  # fmt: skip


def pattern(x: FloatArray, y: FloatArray) -> FloatArray:
    """Waves of 7 to 20 px."""
    rng = np.random.default_rng(0)
    k, phase = 2 * np.pi / rng.uniform(0.28, 0.8, 60), rng.uniform(0, 2 * np.pi, (2, 60))
    waves = np.cos(
        k * (np.cos(phase[0]) * x[..., None] + np.sin(phase[0]) * y[..., None]) + phase[1]
    )
    return np.asarray(0.5 + 0.03 * waves.sum(axis=-1))


def images(seed: int, lens: Distortion | None = None, sd: float = NOISE) -> list[ImageData]:
    """Of both states, through a lens, with noise of a standard deviation."""
    rng, values, pixels = np.random.default_rng(seed), TRUE, MeshPixels(MESH)
    x, y = np.meshgrid(GRID.x, GRID.y)
    if lens is not None:
        x, y = GRID.to_mm(*lens.ideal(*np.mgrid[: GRID.rows, : GRID.cols]))

    def noisy(image: FloatArray) -> FloatArray:
        return image + rng.normal(0.0, sd, GRID.shape)

    f = noisy(pattern(x, y))
    moved = [
        noisy(pattern(x / (1 + e * values[0]), y / (1 + e * values[0] * values[1]))) for e in LOADS
    ]
    noise = ImageNoise(NOISE, NOISE)
    return [ImageData(ImagePair(f, g, GRID), pixels, noise, lens=lens) for g in moved]  # type: ignore[arg-type]


UNKNOWNS = {
    "a": Unknown(0.025, (0.001, 0.5)),
    "b": Unknown(-0.3, (-2.0, 2.0)),
    "c": Unknown(1.0, (0.1, 9.0)),
}
FORCES = Readings(np.array([e * TRUE[0] * TRUE[2] for e in LOADS]), 1e-3)


def found_from(seed: int, **more: object) -> Identified:
    rng = np.random.default_rng(1000 + seed)
    readings = Readings(FORCES.values + rng.normal(0.0, FORCES.sd, 2), FORCES.sd)
    given = {"forces": readings, "pixel_size": GRID.pixel_size, **more}
    return identify(model, images(seed), UNKNOWNS, **given)  # type: ignore[arg-type]


def test_errors_are_what_their_standard_deviations_predict() -> None:
    """From values off by a factor of two; 12 seeds of 3 parameters: chi squared of 36."""
    every = []
    for seed in range(12):
        found = found_from(seed, levels=(FULL,)) if seed else found_from(seed)
        off = found.values - TRUE
        every.append(off @ np.linalg.solve(found.covariance, off))
        if seed == 0:  # coarse levels lead to the same minimum
            same = found_from(seed, levels=(FULL,)).values
            assert np.all(np.abs(found.values - same) < 0.05 * found.sd)
            assert found.statements == ()
            for share in found.state_equations:
                assert share.residual == pytest.approx(share.expected, rel=0.02)
    assert 19.0 < sum(every) < 59.0  # 1 % and 99 % of chi squared of 36 degrees


def test_the_gradient_is_the_cost_s() -> None:
    """Where g has no noise: by differences of the cost, which grows with the square of the step."""
    states = images(0)
    values = TRUE * [1.02, 1.05, 1.0]
    for data, k in ((states[1], 1),):
        data.prepare(FULL, model(values)[k])
        here = data.equations(model(values)[k])
        for i, step in enumerate((1e-5, 1e-4)):
            h = np.eye(3)[i] * step
            cost = [0.5 * data.equations(model(values + s * h)[k]).squares for s in (1.0, -1.0)]
            slope = (cost[0] - cost[1]) / (2 * step)
            assert here.blocks.sum(axis=0)[i] == pytest.approx(slope, rel=1e-3)


def test_a_camera_that_has_moved() -> None:
    """By up to 8 px and 1 degree between the images: a shift and a turn of each are unknowns."""
    motions = np.array([[0.2, -0.1, 0.01], [0.3, 0.1, -0.02]])

    def moved(values: FloatArray) -> list[State]:
        own, motion = values[:3], values[3:].reshape(2, 3)
        return [imaged(s, None, motion, k) for k, s in enumerate(model(own))]  # type: ignore[misc, arg-type]

    x, y = np.meshgrid(GRID.x, GRID.y)
    rng, f, data = np.random.default_rng(0), pattern(x, y), []
    for (tx, ty, turn), e in zip(motions, LOADS, strict=True):
        c, s = np.cos(turn), np.sin(turn)
        X, Y = c * (x - tx) + s * (y - ty), -s * (x - tx) + c * (y - ty)
        g = pattern(X / (1 + e * TRUE[0]), Y / (1 + e * TRUE[0] * TRUE[1]))
        noisy = [image + rng.normal(0.0, NOISE, GRID.shape) for image in (f, g)]
        pair = ImagePair(*noisy, GRID)  # type: ignore[arg-type]
        data.append(ImageData(pair, MeshPixels(MESH), ImageNoise(NOISE, NOISE)))
    frame = {f"{n}[{k}]": Unknown(0.0, (-0.6, 0.6)) for k in range(2) for n in MOTION}
    levels = (Level(4, 3.0), *LEVELS)
    found = identify(moved, data, UNKNOWNS | frame, pixel_size=0.04, forces=FORCES, levels=levels)
    exact = np.append(TRUE, motions.ravel())
    assert np.all(np.abs(found.values - exact) < 4.5 * found.sd)
    assert np.all(found.sd[3:] < 0.05 * GRID.pixel_size)


def test_a_specimen_that_is_not_in_the_middle_under_a_light_that_changes() -> None:
    """15 px off, and turned: the place is an unknown, too; found whatever gain and offset are."""
    place = np.array([0.5, -0.35, 0.02])
    off = place + np.array([0.04, -0.03, 0.005])  # what it starts from: 1 px

    def placed(values: FloatArray) -> list[State]:
        return [imaged(s, values[3:], np.zeros((0, 3)), k) for k, s in enumerate(model(values[:3]))]  # type: ignore[misc, arg-type]

    x, y = np.meshgrid(GRID.x, GRID.y)
    (tx, ty), c, s = place[:2], np.cos(place[2]), np.sin(place[2])
    X, Y = c * (x - tx) + s * (y - ty), -s * (x - tx) + c * (y - ty)
    rng, noise = np.random.default_rng(0), ImageNoise(NOISE, 0.8 * NOISE)
    start = rigidly_moved(MESH.nodes, np.zeros((0, *MESH.nodes.shape)), off)[0]
    pixels, data = MeshPixels(replace(MESH, nodes=start)), []
    for e in LOADS:
        gx, gy = X / (1 + e * TRUE[0]), Y / (1 + e * TRUE[0] * TRUE[1])
        f, g = (pattern(a, b) + rng.normal(0.0, NOISE, GRID.shape) for a, b in ((X, Y), (gx, gy)))
        pair = ImagePair(f, 0.8 * g + 0.05, GRID)  # type: ignore[arg-type]
        data.append(ImageData(pair, pixels, noise, partial(alike, light=0)))
    where = {n: Unknown(v, (v - 0.2, v + 0.2)) for n, v in zip(PLACE, off, strict=True)}
    found = identify(placed, data, UNKNOWNS | where, pixel_size=0.04, forces=FORCES)  # type: ignore[arg-type]
    assert np.all(np.abs(found.values - np.append(TRUE, place)) < 4.0 * found.sd)
    assert np.all(found.sd[3:] < [0.01, 0.01, 0.01])
    assert found.statements == ()
    for share in found.state_equations:
        assert share.residual == pytest.approx(share.expected, rel=0.03)


LENS = CameraDistortion(200.0, 180.0, 50.0, 40.0, k1=0.3, p1=0.02, p2=-0.01)
"""By up to 3 px."""


def test_points_through_a_lens() -> None:
    """Derivatives by differences, and the lens' own inverse."""
    X, step = np.random.default_rng(0).uniform([-2.0, -1.5], [2.0, 1.5], (9, 2)), 1e-5
    shown, slopes = through_lens(X, LENS, GRID)
    for j, along in enumerate(np.eye(2) * step):
        ahead, back = (through_lens(X + s * along, LENS, GRID)[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(slopes[:, :, j], (ahead - back) / (2.0 * step), atol=1e-9)
    back = np.column_stack(GRID.to_mm(*LENS.ideal(*GRID.to_px(*shown.T))))
    np.testing.assert_allclose(back, X, atol=1e-9)


def test_a_known_lens() -> None:
    """Nothing left of images without noise but interpolation; with noise the values are as good."""
    left = []
    for lens in (None, LENS):
        found = identify(
            model, images(0, lens, 0.0), UNKNOWNS, pixel_size=0.04, forces=FORCES, levels=(FULL,)
        )
        np.testing.assert_array_less(np.abs(found.values - TRUE), 0.1 * found.sd)
        left.append(max(share.residual for share in found.state_equations))
    assert left[1] < 1.5 * left[0]
    for seed in range(3):
        found = identify(
            model, images(seed, LENS), UNKNOWNS, pixel_size=0.04, forces=FORCES, levels=(FULL,)
        )
        assert np.all(np.abs(found.values - TRUE) < 3.5 * found.sd)
        for share in found.state_equations:
            assert share.residual == pytest.approx(share.expected, rel=0.03)


def test_a_displacement_field_instead_of_images() -> None:
    rng = np.random.default_rng(0)
    points, sd = rng.uniform([-2.1, -1.6], [2.1, 1.6], (400, 2)), 1e-3
    true = [e * TRUE[0] * points * [1.0, TRUE[1]] for e in LOADS]
    data = [FieldData(points, u + rng.normal(0, sd, u.shape), sd, MESH) for u in true]
    found = identify(model, data, UNKNOWNS, pixel_size=0.04, forces=FORCES)
    assert np.all(np.abs(found.values - TRUE) < 4 * found.sd)
    assert np.all(found.sd[:2] / np.abs(TRUE[:2]) < 0.02)
    np.testing.assert_allclose(
        nodal_values(MESH, MESH.nodes, points, beside=True), points, atol=1e-9
    )


def test_statements_name_what_the_data_do_not_determine() -> None:
    found = identify(model, images(0), UNKNOWNS, pixel_size=0.04)
    assert np.isinf(found.sd[2])
    assert found.statements == ("c is hardly determined (nothing determines it): add a force",)
    prior = {**UNKNOWNS, "c": Unknown(1.0, (0.1, 9.0), prior_sd=0.1)}
    with_prior = identify(model, images(0), prior, pixel_size=0.04)
    assert with_prior.sd[2] == pytest.approx(0.1, rel=1e-6)
    assert with_prior.statements == ()
    tight = {**UNKNOWNS, "b": Unknown(-0.3, (-0.5, 0.0))}
    stopped = identify(model, images(0), tight, pixel_size=0.04, forces=FORCES)
    assert stopped.statements[0].startswith("b is at its bound: the data may want it beyond [-0.5,")


def test_a_combination_of_many_parameters_has_words_too() -> None:
    """Holes all alike, and each by itself: 17 components of a unit vector, none of them large."""
    names = ["holes.diameter[0,0]", *(f"holes[{k}].diameter" for k in range(16))]
    design = np.hstack([np.ones((16, 1)), np.eye(16)])
    (text,) = undetermined_combinations(names, 1e6 * design.T @ design, [1.0] * 17)
    assert text.startswith("holes.diameter[0,0] and holes[0].diameter and holes[1].diameter and")
    assert "(nothing determines it): leave one of them out, give it a prior_sd, or add" in text


def test_a_wrong_model_widens_the_intervals() -> None:
    """The specimen is sheared, too, which the model can't do; forces contradict each other."""

    def sheared(values: FloatArray) -> list[State]:
        return [
            replace(s, displacement=s.displacement + 4e-3 * np.sin(2 * MESH.nodes[:, ::-1]))
            for s in model(values)
        ]

    right = found_from(0, levels=(FULL,))
    wrong = identify(sheared, images(0), UNKNOWNS, pixel_size=0.04, forces=FORCES)
    assert np.all(right.sd_with_model_error < 2.0 * right.sd)
    assert np.all(wrong.sd_with_model_error[:2] > 2.0 * wrong.sd[:2])


def test_noise_between_pixels_does_not_bias() -> None:
    """A shift by a quarter of a pixel, where interpolated noise varies most from place to place.

    The slopes of g would make it 3 to 5 standard errors too large in each of 8 seeds.
    """
    shift, x, y = 0.25 * GRID.pixel_size, *np.meshgrid(GRID.x, GRID.y)
    along = np.tile([1.0, 0.0], (1, len(MESH.nodes), 1))
    by = {"displacement_by": along, "nodes_by": 0.0 * along}

    def shifted(values: FloatArray) -> list[State]:
        none = np.zeros(1)
        return [State(0.0, values[0] * along[0], 0.0, force_by=none, strain_by=none, **by)]

    z, noise, unknown = [], 0.05, {"shift": Unknown(0.0, (-0.04, 0.04))}
    for seed in range(8):
        rng = np.random.default_rng(seed)
        f, g = (pattern(x - s, y) + rng.normal(0.0, noise, GRID.shape) for s in (0.0, shift))
        data = ImageData(ImagePair(f, g, GRID), MeshPixels(MESH), ImageNoise(noise, noise))
        found = identify(shifted, [data], unknown, pixel_size=GRID.pixel_size, levels=(FULL,))
        z.append((found.values[0] - shift) / found.sd[0])
    assert abs(np.mean(z)) < 3.0 / np.sqrt(len(z))


def test_edges_beyond_the_images_border_do_not_count() -> None:
    """A plate with an edge 1 px out of the reference: in view, or farther out, once it is moved."""
    grid = replace(GRID, cols=107)
    x, y = np.meshgrid(grid.x, grid.y)
    for shift_px in (-9.3, 6.4):
        shift = shift_px * grid.pixel_size
        f, g = (
            np.where((abs(x - s) < 2.0) & (abs(y) < 1.5), pattern(x - s, y), 0.0).astype(np.float32)
            for s in (0.0, shift)
        )
        state = model(0.0 * TRUE)[0]
        state = replace(state, displacement=state.displacement + np.array([shift, 0.0]))
        data = ImageData(ImagePair(f, g, grid), MeshPixels(MESH), ImageNoise(NOISE, NOISE))
        data.prepare(FULL, state)  # type: ignore[arg-type]
        residual, shown = data.residual(state), np.arange(107) + shift_px  # type: ignore[arg-type]
        assert np.isnan(residual[:, shown > 104.0]).all()
        assert np.isfinite(residual[30:60, 20:95]).all()
        if shift_px < 0.0:
            assert np.nanmax(abs(residual[:, 90:])) < 2e-3  # 6e-3 beside the edge


CORRECTIONS = corrections(MESH.nodes, np.eye(2) * 1.5, degree=1)


def test_a_right_model_is_seldom_rejected() -> None:
    """12 seeds of 158 corrections: the mean of chi squared, and no p-value below 0.1 %."""
    tests = []
    for seed in range(12):
        test = found_from(seed, levels=(FULL,), corrections=CORRECTIONS).model_error
        assert test is not None
        tests.append(test)
    counts = {test.degrees_of_freedom for test in tests}
    assert max(counts) <= 2 * len(CORRECTIONS) + 2  # of each state, and of its force
    ratio = np.mean([t.chi_squared / t.degrees_of_freedom for t in tests])
    assert ratio == pytest.approx(1.0, abs=3.5 * np.sqrt(2.0 * 1.25 / min(counts) / 12))
    assert min(t.p_value for t in tests) > 1e-3
    assert in_words(tests[0], None)[0].startswith("the model is not seen to be wrong (chi")


def test_a_wrong_model_is_rejected() -> None:
    """It can't shear, or its force is a third off and has a law of its own; noise hides neither."""
    shear = 2e-3 * np.sin(2 * MESH.nodes[:, ::-1])

    def sheared(values: FloatArray) -> list[State]:
        return [replace(s, displacement=s.displacement + shear) for s in model(values)]

    given = {"pixel_size": 0.04, "corrections": CORRECTIONS}
    wrong = identify(sheared, images(0), UNKNOWNS, forces=FORCES, **given)  # type: ignore[arg-type]
    test = wrong.model_error
    assert test is not None
    assert test.p_value < 1e-9
    size = np.sqrt(2.0 * (shear**2).sum(axis=1).mean())  # of both states together
    assert 0.7 * size < test.rms < 1.2 * size
    assert wrong.statements[0].startswith("the model is wrong, by displacements of")
    forces = Readings(FORCES.values * [1.0, 1.3], FORCES.sd)
    found = identify(model, images(0), UNKNOWNS, forces=forces, **given)  # type: ignore[arg-type]
    assert found.model_error is not None
    assert found.model_error.is_rejected


def test_what_a_mesh_is_wrong_by_does_not_make_a_law_wrong() -> None:
    """Its error is that of the test before, and on a finer mesh a quarter of it."""
    shear = 2e-3 * np.sin(2 * MESH.nodes[:, ::-1])

    def by_mesh(values: FloatArray) -> list[State]:
        return [replace(s, displacement=s.displacement + shear) for s in model(values)]

    def finer(values: FloatArray) -> list[State]:
        return [replace(s, displacement=s.displacement + 0.25 * shear) for s in model(values)]

    given = {"pixel_size": 0.04, "corrections": CORRECTIONS, "forces": FORCES}
    found = identify(
        by_mesh, images(0), UNKNOWNS, finer=FinerMesh(finer, 0.25), **given  # type: ignore[arg-type]
    )  # fmt: skip
    assert found.model_error is not None
    assert not found.model_error.is_rejected


def test_a_finer_mesh_has_the_last_word() -> None:
    """Its states here are those of other parameters, which the data then want back.

    Of half the elements' size, it takes three quarters of the error away; the limit does the rest.
    """
    shift = np.array([1e-3, 0.01, 0.02])

    def states(values: FloatArray) -> list[State]:
        return model(values + shift)

    plain = found_from(0, levels=(FULL,))
    found = found_from(0, levels=(FULL,), finer=FinerMesh(states, 0.25))
    assert np.all(np.abs(found.minimum.unknowns + shift - plain.values) < 0.2 * plain.sd)
    assert np.all(np.abs(found.values + 4.0 / 3.0 * shift - plain.values) < 0.2 * plain.sd)
    assert np.all(np.abs(found.mesh_error + shift / 3.0) < 0.1 * plain.sd)
    assert np.all(found.sd_with_model_error > np.abs(found.mesh_error))


def test_bad_input_is_one_line() -> None:
    with pytest.raises(InputError, match=r"start between them, got a start of 3 and bounds of \[1"):
        Unknown(3.0, (1.0, 2.0))
    with pytest.raises(InputError, match="images, displacements or forces to identify from"):
        identify(model, [None, None], UNKNOWNS, pixel_size=1.0)
    with pytest.raises(InputError, match="at points of the specimen, got none there"):
        FieldData(MESH.nodes + 10.0, MESH.nodes, 1.0, MESH)
