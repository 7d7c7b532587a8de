"""The design of a test: bounds without images, how they scale, what is needed, bad input."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from summary_schemas import faults

from modeharvest.cli.root import main
from modeharvest.fem.field import Mesh
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.finite_element.mesh import quadratic
from modeharvest.idic.setup import SquareLatticeOptions
from modeharvest.idic.solver.pyramid import eroded
from modeharvest.imaging.grid import PixelGrid
from modeharvest.imaging.sensor import Aperture, Sensor, quantise
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.imaging.speckle.pattern import Ink, Speckle, SpeckleSpec
from modeharvest.imaging.speckle.statistics import SpeckleStatistics
from modeharvest.runs import run
from modeharvest.runs.case import Case, checked
from modeharvest.runs.design import DesignCase
from modeharvest.util.arrays import FloatArray
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json
from modeharvest.validation.design import (
    WANTED,
    Design,
    DesignOptions,
    DesignRanges,
    averaged_noise,
)
from modeharvest.validation.design_parameters import ModelStates

SPECIMEN = Specimen(2, 3, bulk_x=0.6, bulk_y=0.5)
DEGREES = SquareLatticeOptions(v0_degree=2, v_degree=2)
DEEP = ImagingSpec(0.02, bits=16)
"""Rounding is no part of its noise."""
PX = 256


def design(spec: ImagingSpec = DEEP, edge_px: int = 0, **options: Any) -> Design:
    how = replace(DEGREES, edge_px=edge_px)
    return Design(SPECIMEN, spec, how, DesignOptions(**{"pattern": 0.25, **options}), 0.08)


@pytest.mark.parametrize(
    ("spec", "aperture"),
    [
        (SpeckleSpec(), Aperture()),
        (SpeckleSpec(blur_px=1.5, standard_deviation=0.1), Aperture(1.0, 0.6)),
        (SpeckleSpec(ink=Ink(coverage=0.3)), Aperture()),
    ],
    ids=["one layer", "pixels that average", "ink"],
)
def test_a_speckle_s_statistics_are_those_of_its_images(
    spec: SpeckleSpec, aperture: Aperture
) -> None:
    transfer = None if aperture.is_point else aperture.transfer
    specs = [replace(spec, seed=s, ink=spec.ink and replace(spec.ink, seed=s)) for s in range(6)]
    images = [Speckle(each, (PX, PX)).image(transfer) for each in specs]
    slope = 2j * np.pi * np.fft.rfftfreq(PX)  # images are periodic
    gradient = [
        np.mean(np.fft.irfft(slope * np.fft.rfft(lines), PX) ** 2)
        for image in images for lines in (image, image.T)
    ]  # fmt: skip
    found = SpeckleStatistics.of(spec, aperture.psf_px**2 + aperture.fill_factor / 12.0)
    assert found.mean == pytest.approx(np.mean(images), rel=0.01)
    assert found.variance == pytest.approx(np.var(images), rel=0.03)
    assert found.gradient == pytest.approx(2.0 * np.mean(gradient), rel=0.03)


def bound_by_pixels(of: Design, edge_px: int, noise: float, seed: int) -> FloatArray:
    """As in benchmarks/known_truth.py: from the exact gradient of a speckle at every pixel."""
    state, p = of.state(of.setup), of.imaging.pixel_size
    (a, b), centres = SPECIMEN.half_size, SPECIMEN.hole_centres
    grid = PixelGrid.centred(2 * round(b / p) + 9, 2 * round(a / p) + 9, p)
    x, y = grid.x[None, :], grid.y[:, None]
    mask = (abs(x) <= a) & (abs(y) <= b)
    for cx, cy in centres:
        mask &= np.hypot(x - cx, y - cy) > 0.5 * SPECIMEN.diameter
    row, col = np.nonzero(eroded(mask, edge_px))
    d_row, d_col = Speckle(SpeckleSpec(seed=seed), grid.shape).gradient(row, col)
    at, F = np.stack([grid.x[col], grid.y[row]], axis=1), np.tile(np.eye(2), (len(row), 1, 1))
    for k, step in enumerate(1e-5 * np.eye(2)):
        ahead, behind = (
            state.ansatz.displacement_at(state.unknowns, at + s) for s in (step, -step)
        )
        F[:, :, k] += (ahead - behind) / 2e-5
    slope = np.stack([d_col, -d_row], axis=1)[..., None] / p
    moved = np.linalg.solve(np.swapaxes(F, 1, 2), slope)[..., 0]
    S = state.ansatz.sensitivities(state.unknowns, *at.T[..., None])[:, 0]
    J = np.einsum("kc,kcn->kn", moved, S)
    weight = 1.0 / (noise**2 * (1.0 + 1.0 / np.linalg.det(F)))
    return np.asarray(J.T @ (J * weight[:, None]))


def test_the_bound_is_that_of_the_pixels_of_an_image() -> None:
    of = design(edge_px=2)
    noise = of.image_noise(of.setup)
    M = np.mean([bound_by_pixels(of, 2, noise, seed) for seed in range(4)], axis=0)
    expected = np.sqrt(np.diag(of.covariance(of.setup)))
    ratio = expected / np.sqrt(np.diag(np.linalg.inv(M)))
    assert ratio == pytest.approx(np.ones(len(ratio)), abs=0.05)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.02)


def test_errors_scale_as_they_have_to() -> None:
    of = design()
    own = of.expected(of.setup)

    def ratios(
        names: tuple[str, ...] = (*WANTED, "u_px", "v1_px"), **changed: float
    ) -> list[float]:
        other = of.expected(replace(of.setup, **changed))  # type: ignore[arg-type]
        return [getattr(other, name) / getattr(own, name) for name in names]

    assert ratios(noise=2 * of.setup.noise) == pytest.approx([2.0] * 5, rel=1e-4)
    assert ratios(exposures=9) == pytest.approx([1 / 3] * 5, rel=1e-6)
    assert ratios(light=0.5) == pytest.approx([2.0] * 5, rel=1e-6)
    assert ratios(speckle_width=2.0) == pytest.approx([2.0] * 5, rel=1e-6)
    # In pixels as the pixel, in mm and shares as its square.
    assert ratios(pixel_size=0.04) == pytest.approx([4.0, 4.0, 4.0, 2.0, 2.0], rel=1e-6)
    # Twice the pattern: the same v1 in px, half of it in per cent and of phases.
    twice = design(pattern=0.5).expected(of.setup)
    assert twice.v1_px == pytest.approx(own.v1_px, rel=0.1)
    assert twice.v1_percent == pytest.approx(0.5 * own.v1_percent, rel=0.1)
    assert twice.phase == pytest.approx(0.5 * own.phase, rel=0.1)


def test_edges_cost_more_where_pixels_are_large() -> None:
    with_edges, without = design(edge_px=2), design()
    found = [
        of.expected(replace(of.setup, pixel_size=p)).v1_percent / p**2
        for of in (without, with_edges) for p in (0.01, 0.04)
    ]  # fmt: skip
    assert found[0] == pytest.approx(found[1])
    assert found[1] < 1.1 * found[2] < 1.1 * found[3]


def test_shot_noise_goes_with_the_root_of_the_light() -> None:
    of = design(replace(DEEP, sensor=Sensor(full_well=1000.0)))
    setup = replace(of.setup, noise=0.0)
    mean = of.image_noise(setup) ** 2 * 1000.0  # variance is grey level over full well
    assert mean == pytest.approx(0.6, rel=1e-3)
    ratio = of.expected(replace(setup, light=0.25)).v1_px / of.expected(setup).v1_px
    assert ratio == pytest.approx(2.0, rel=1e-3)


@pytest.mark.parametrize("levels", [0.0, 0.2, 0.5, 2.0])
def test_rounding_is_averaged_away_only_by_noise(levels: float) -> None:
    sensor, rng = Sensor(read_noise=levels / 255), np.random.default_rng(0)
    grey = rng.uniform(0.3, 0.7, 40_000)
    noisy = grey + sensor.read_noise * rng.standard_normal((8, grey.size))
    error = np.mean(quantise(noisy, 8) / 255, axis=0) - grey
    assert averaged_noise(sensor, 8, 0.5, 8) == pytest.approx(np.std(error), rel=0.03)


@pytest.mark.parametrize("axis", ["pixel_size", "speckle_width", "noise", "exposures", "light"])
def test_what_is_needed_gives_what_is_wanted(axis: str) -> None:
    of = design(edge_px=2)
    error = of.expected(of.setup).v1_percent
    wanted = 0.6 * error if axis == "exposures" else 1.3 * error
    of = design(edge_px=2, v1_percent=wanted)
    value = of.needed(axis, "v1_percent")
    assert value is not None
    setup = replace(of.setup, **{axis: value})  # type: ignore[arg-type]
    assert of.expected(setup).v1_percent == pytest.approx(wanted, rel=1e-2)
    assert design(v1_percent=1e-6 * error).needed(axis, "v1_percent") is None
    easiest = {"exposures": 1, "light": 0.125}
    last = easiest.get(axis) or getattr(of.options.ranges, axis)[-1]
    assert design(v1_percent=1e6 * error).needed(axis, "v1_percent") == last


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"v1_percent": 0.0}, "expected a v1_percent above 0, got 0"),
        ({"exposures": 0}, "expected exposures of 1 or more, got 0"),
        ({"noise": -0.1}, "expected a noise above 0"),
        ({"pattern": 0.0}, "expected a pattern above 0"),
        ({"map": ["noise", "noise"]}, "expected two of .* as map"),
        ({"map": ["noise", "v_degree"]}, "expected two of .* as map"),
        ({"contour": "kappa"}, "one of .* as contour, got .*'kappa'"),
        ({"ranges": {"noise": [0.02, 0.01]}}, "expected rising positive values of noise"),
        ({"ranges": {"light": []}}, "expected rising positive values of light"),
        ({"ranges": {"pixel": [0.02]}}, "unknown key design.ranges.pixel; did you mean"),
        ({"wavenumber": 1e-3}, "unknown key design.wavenumber; did you mean 'wave_number'"),
    ],
)
def test_bad_options_are_refused_in_one_line(table: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as refused:
        checked(DesignCase, {"experiment": {}, "design": table}, "mine")
    assert "\n" not in str(refused.value)


def test_what_can_not_be_designed_is_refused() -> None:
    of = design(edge_px=2)
    with pytest.raises(InputError, match=r"brightest grey level below saturation.*light smaller"):
        of.expected(replace(of.setup, light=1.5))
    with pytest.raises(InputError, match="show every unknown, got nothing of v0x"):
        of.expected(replace(of.setup, pixel_size=1.0))
    with pytest.raises(InputError, match="expected strains beyond the critical"):
        of.expected(replace(of.setup, strain=0.1))
    with pytest.raises(InputError, match="expected ranges of two values or more of pixel_size"):
        design(ranges=DesignRanges(noise=(0.02,))).mapped()
    with pytest.raises(InputError, match="expected a solution or a pattern"):
        Design(SPECIMEN, DEEP, DEGREES, DesignOptions(), 0.08)


def test_what_can_not_be_is_left_out() -> None:
    of = design(ranges=DesignRanges(light=(0.5, 1.0, 1.5), speckle_width=(0.1, 1.0), noise=(0.02,)))
    assert [value for value, _ in of.varied("light")] == [0.5, 1.0]
    assert [value for value, _ in of.varied("speckle_width")] == [1.0]
    assert of.varied("strain") == []


def test_a_pattern_that_is_given_needs_no_solution(tmp_path: Path) -> None:
    case = tmp_path / "mine.toml"
    case.write_text(
        "[experiment.specimen]\nholes_x = 2\nholes_y = 2\n[correlation]\nv0_degree = 2\n"
        "v_degree = 2\n[design]\npattern = 0.2\nmap = ['exposures', 'light']\n[design.ranges]\n"
        "v0_degree = [2]\nv_degree = [2]\n",
        "utf-8",
    )
    summary = run(case, tmp_path / "out")
    assert summary["expected"]["w_px"] is None
    assert summary["critical_strain"] is None
    assert [row["value"] for row in summary["varied"]["strain"]] == [0.128]
    assert "The model error isn’t known" in (tmp_path / "out/report.html").read_text("utf-8")
    with pytest.raises(InputError, match="expected a virtual experiment, got the design of a test"):
        Case.read(case)
    with pytest.raises(InputError, match="expected the design of a test, got an infinite lattice"):
        DesignCase.read("square-lattice")


def test_the_paper_s_case_is_designed_as_it_is_shipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        sys, "argv", ["modeharvest", "design", "paper-virtual", "--out", str(tmp_path)]
    )
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    printed = " ".join(capsys.readouterr().out.split())
    assert "Noise is not what limits this test" in printed
    assert "read noise of 1 % of full scale is assumed" in printed
    summary = read_json(tmp_path / "summary.json")
    assert faults(summary, "design") == []
    expected, varied = summary["expected"], summary["varied"]
    assert expected["w_px"] > 100 * expected["u_px"]
    # Beyond the critical strain the pattern grows, and its numbers are known the better.
    strains, phases = zip(*((row["value"], row["phase"]) for row in varied["strain"]), strict=True)
    assert strains == (0.1, 0.11, 0.12, 0.128)
    assert list(phases) == sorted(phases, reverse=True)
    assert [row["w_px"] is None for row in varied["strain"]] == [True, True, True, False]
    errors = np.array(summary["map"]["errors"])
    assert (np.diff(errors, axis=0) > 0).all()
    assert (np.diff(errors, axis=1) > 0).all()
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "model’s parameters" not in page


def stretched(names: tuple[str, ...] = ("a", "b", "c")) -> Design:
    """The specimen under a uniform strain a, times b across, and a force a c, at two strains."""
    half = SPECIMEN.half_size
    grid = np.meshgrid(np.linspace(-half[0], half[0], 9), np.linspace(-half[1], half[1], 9))
    x, y = (axis.ravel() for axis in grid)
    corner = (9 * np.arange(8)[:, None] + np.arange(8)).ravel()
    cells = np.hstack([[corner, corner + 1, corner + 10], [corner, corner + 10, corner + 9]]).T
    mesh = quadratic(Mesh(np.stack([x, y], 1), cells, "T3"))
    (x, y), zero = mesh.nodes.T, np.zeros(len(mesh.nodes))
    a, b, c = -1.0, -0.5, 2.0

    def state(e: float) -> SimpleNamespace:
        by_a, by_b = np.stack([e * x, e * b * y], 1), np.stack([zero, e * a * y], 1)
        return SimpleNamespace(
            mesh=mesh, displacement=e * a * np.stack([x, b * y], 1),
            displacement_by=np.array([by_a, by_b, 0.0 * by_a]), nodes_by=np.zeros((3, len(x), 2)),
            force_by=np.array([-e * c, 0.0, -e * a]),
        )  # fmt: skip

    states = {e: state(e) for e in (0.04, 0.06, 0.08)}
    model = ModelStates(names, np.array([a, b, c]), states, (0.04, 0.08), 1e-3)  # type: ignore[arg-type]
    options = DesignOptions(pattern=0.25, parameters=names)
    return Design(SPECIMEN, DEEP, replace(DEGREES, edge_px=2), options, 0.08, None, model)


def test_a_model_s_parameters() -> None:
    """In closed form: u is linear in x, so the integral is that of x x, y y over the material."""
    of, e = stretched(), (0.04, 0.08)
    setup, signal = of.setup, of.signal(of.setup)
    inside = of.points[of.used(2 * setup.pixel_size)]
    area = 4.0 * np.prod(SPECIMEN.half_size) / len(of.points)
    M = np.zeros((3, 3))
    for strain in e:
        lx, ly = 1.0 - strain, 1.0 + 0.5 * strain
        weight = signal * area / (1.0 + 1.0 / (lx * ly))
        xx, yy = (inside**2).sum(axis=0) * weight / np.array([lx, ly]) ** 2
        M[0, 0] += strain**2 * (xx + 0.25 * yy)
        M[0, 1] += 0.5 * strain**2 * yy
        M[1, 1] += strain**2 * yy
        J = strain * np.array([-2.0, 0.0, 1.0]) / 1e-3
        M += np.outer(J, J)
    M[1, 0] = M[0, 1]
    sd = np.sqrt(np.diag(np.linalg.inv(M)))
    found = of.expected(setup)
    assert found.parameter_sd == pytest.approx(sd, rel=1e-5)
    assert found.parameter_percent == pytest.approx(max(100 * sd / [1.0, 0.5, 2.0]), rel=1e-5)
    coarse = of.expected(replace(setup, noise=2 * setup.noise)).parameter_sd
    assert coarse[1] / sd[1] == pytest.approx(2.0, rel=0.01)
    assert coarse[2] < 2.0 * sd[2]  # the load cell stays as it is
    weighed = replace(of, model=replace(of.model, force_sd=0.0), _known={})  # type: ignore[type-var]
    with pytest.raises(InputError, match="none that determine c; give the load cell's force_sd"):
        weighed.parameter_sd(setup)
    assert (of.parameter_sd(replace(setup, strain=0.06)) > sd).all()
    with pytest.raises(InputError, match=r"expected a model with a state at 0\.07, got none"):
        of.parameter_sd(replace(setup, strain=0.07))
    with pytest.raises(InputError, match="expected a model whose parameters are sought, got none"):
        replace(of, model=None)


@pytest.mark.dolfinx
def test_a_design_for_a_material(tmp_path: Path) -> None:
    """Photographs alone know an exponent, no modulus; a load cell changes that."""
    tables: dict[str, Any] = {
        "experiment": {"specimen": {"holes_x": 2, "holes_y": 2}, "strains": [0.03, 0.06],
                       "mesh_size": 0.55},
        "imaging": {"pixel_size": 0.03, "sensor": {"read_noise": 0.01}},
        "correlation": {"v0_degree": 2, "v_degree": 2},
    }  # fmt: skip
    asked = {
        "pattern": 0.2, "parameters": ["moduli[0]", "kappa"], "contour": "parameter_percent",
        "ranges": {"strain": [0.05, 0.06], "v0_degree": [2], "v_degree": [2]},
    }  # fmt: skip
    with pytest.raises(InputError, match=r"none that determine moduli\[0\] and kappa; give the"):
        run(checked(DesignCase, tables | {"design": asked}, "mine"), tmp_path)
    case = checked(DesignCase, tables | {"design": asked | {"force_sd": 0.002}}, "mine")
    summary = run(case, tmp_path)
    assert 0.0 < summary["expected"]["parameter_sd"][0] < 0.05
    coarse = summary["varied"]["pixel_size"][-1]
    assert (np.array(coarse["parameter_sd"]) > summary["expected"]["parameter_sd"]).all()
    assert faults(summary, "design") == []
    assert summary["map"]["errors"][0][0] > 0.0
