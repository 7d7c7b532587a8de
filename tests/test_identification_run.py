"""modeharvest identify: a twin from its own images to its report, and what can't be used."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from summary_schemas import faults

from modeharvest.fem.experiment import Experiment
from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.fem.materials import JetMatrix, Ogden, stress_and_tangent
from modeharvest.fem.specimen import Specimen
from modeharvest.idic.finite_element.identification.identify import UnlikeDataError
from modeharvest.idic.local.field import LocalField, write_field
from modeharvest.idic.uncertainty.parameters import compared_by_evidence
from modeharvest.imaging.distortion.files import write_distortion
from modeharvest.imaging.distortion.lens import CameraDistortion, PolynomialDistortion
from modeharvest.imaging.imageset import ImageSet, make_images
from modeharvest.imaging.photographs.files import read_image, write_image
from modeharvest.imaging.spec import ImagingSpec
from modeharvest.report.identification import identification_report
from modeharvest.runs.case import Case
from modeharvest.runs.identification.case import IdentificationCase
from modeharvest.runs.identification.pipeline import (
    IdentificationRun,
    _path_warnings,
    _surface_warnings,
    run_identification,
)
from modeharvest.util.elements import reference_element
from modeharvest.util.errors import InputError

pytestmark = pytest.mark.usefixtures("unrendered_pictures")

SPECIMEN = {"holes_x": 4, "holes_y": 2, "diameter": 1.5, "bulk_x": 0.9, "bulk_y": 0.4}
BEFORE: dict[str, Any] = {
    "title": "small",
    "experiment": {"specimen": SPECIMEN, "strains": [0.03, 0.05], "mesh_size": 0.55},
    "unknowns": {"moduli[0]": {"start": 2.4, "bounds": [0.1, 10.0]},
                 "kappa": {"start": 2.7, "bounds": [0.5, 50.0]},
                 "tilt": {"start": 0.0, "bounds": [-0.5, 0.5]}},
    "finer_mesh_size": 0.45,
    "twin": {"mesh_size": 0.5, "tilt": 0.1, "force_sd": 0.002, "force_seed": 5},
    "imaging": {"pixel_size": 0.05, "margin_px": 10,
                "sensor": {"read_noise": 0.01, "read_seed": 5}},
}  # fmt: skip
OTHER_LAW = {"name": "I1",
             "material": {"kind": "two-term-I1", "c1": 1.0, "c2": 0.1, "bulk": 9.0},
             "unknowns": {"c1": {"start": 1.0, "bounds": [0.1, 5.0]},
                          "bulk": {"start": 9.0, "bounds": [0.5, 50.0]}}}  # fmt: skip
HARD_LAW = {"name": "hard", "material": {"kind": "ogden", "kappa": 50.0},
            "unknowns": {"moduli[0]": BEFORE["unknowns"]["moduli[0]"]}}  # fmt: skip
WITH_LAWS = BEFORE | {"laws": [OTHER_LAW, HARD_LAW]}
FIELDS = {"fields": ["a.csv", "b.csv"], "field_sd_mm": 1.0}
FORCES = {"forces_N_per_mm": [0.2, 0.3], "force_sd": 0.002}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("identified")
    return folder, run_identification(WITH_LAWS, folder)


def require_truth(summary: dict[str, Any]) -> None:
    for p in summary["parameters"]:
        assert abs(p["value"] - p["true"]) < 4.0 * p["sd_with_model_error"]


@pytest.mark.dolfinx
def test_a_twin_is_identified_from_its_own_images(run: tuple[Path, dict[str, Any]]) -> None:
    folder, summary = run
    assert summary["outcome"] == "converged"
    require_truth(summary)
    units = {p["name"]: p["unit"] for p in summary["parameters"]}
    assert units == {"moduli[0]": "MPa", "kappa": "MPa", "tilt": "rad"}
    for p in summary["parameters"]:  # a factor of two off, and now a few percent
        assert p["sd_with_model_error"] < 0.2 * max(abs(p["start"]), 0.2)
    for state in summary["states"]:
        assert state["residual_rms"] == pytest.approx(state["residual_noise"], rel=0.05)
    assert np.allclose(np.diag(summary["correlations"]), 1.0)
    assert summary["model_error"]["p_value"] > 1e-3
    assert summary["statements"][0].startswith("the model is not seen to be wrong (chi")
    assert summary["law_error"]["degrees_of_freedom"] == 3
    assert summary["statements"][1].startswith("the material's law isn't seen to lack")
    assert json.loads((folder / "summary.json").read_text("utf-8")) == summary
    page = (folder / "report.html").read_text("utf-8")
    assert 'id="residual-2"' in page
    report = identification_report(summary)
    assert [row[0] for row in next(report.tables).rows] == [
        "moduli[0] [MPa]", "kappa [MPa]", "tilt [rad]",
    ]  # fmt: skip


@pytest.mark.dolfinx
def test_a_run_is_not_done_twice(run: tuple[Path, dict[str, Any]]) -> None:
    folder, summary = run
    made = (folder / "summary.json").stat().st_mtime_ns
    assert run_identification(WITH_LAWS, folder) == summary
    assert (folder / "summary.json").stat().st_mtime_ns == made


@pytest.mark.dolfinx
def test_files_of_images_or_of_fields_say_the_same(
    run: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    """The twin's own photographs, and its exact displacement at every fifth pixel."""
    folder, summary = run
    images = ImageSet.read(folder / "images")
    for k, strain in enumerate(images.strains):
        record = images.info["snapshots"][k]
        image = read_image(images.folder / record["camera_image"])
        write_image(tmp_path / f"g{k}.tif", image)
        write_image(tmp_path / f"moved{k}.tif", np.roll(image, 3, axis=1))
        u = images.truth(strain).displacement[::5, ::5]
        x, y = np.meshgrid(images.grid.x[::5], images.grid.y[::5])
        inside = np.isfinite(u[..., 0])
        write_field(tmp_path / f"u{k}.csv", LocalField(x[inside], y[inside], u[inside]))
    camera = images.info["reference"]["camera_image"]
    write_image(tmp_path / "f.tif", read_image(images.folder / camera))
    readings = json.loads((folder / "forces.json").read_text("utf-8"))["forces_N_per_mm"]
    forces = {"forces_N": [8.0 * F for F in readings], "thickness_mm": 8.0, "force_sd": 0.016}
    by_data = {
        "images": {"reference": "f.tif", "deformed": ["g*.tif"], "pixel_size": 0.05, **forces},
        "fields": {"fields": ["u*.csv"], "field_sd_mm": 1e-3, **forces},
    }
    moved = {"deformed": ["moved*.tif"], "rigid_motion": True}
    by_data["moved camera"] = by_data["images"] | moved
    for name, data in by_data.items():
        tables = {key: value for key, value in BEFORE.items() if key not in ("twin", "imaging")}
        case = IdentificationCase.model_validate(tables | {"data": data})
        case._base = tmp_path
        found = run_identification(case, tmp_path / name)
        own, frame = found["parameters"][:3], found["parameters"][3:]
        shifts = [p["value"] for p in frame if p["name"].startswith("shift_x")]
        assert shifts == ([] if name != "moved camera" else pytest.approx([0.15, 0.15], abs=0.01))
        for p, q in zip(own, summary["parameters"], strict=True):
            assert p["true"] is None
            assert abs(p["value"] - q["true"]) < 4.0 * p["sd_with_model_error"]


def as_seen(lens: CameraDistortion, shape: tuple[int, int]) -> PolynomialDistortion:
    """A camera that is turned by 1 degree and 11 and 14 px off, behind a lens of degree 3."""
    row, col = (i.ravel() for i in np.indices(shape)[:, ::10, ::10])
    y, x = row - 0.5 * (shape[0] - 1), col - 0.5 * (shape[1] - 1)
    c, s = np.cos(np.radians(1.0)), np.sin(np.radians(1.0))
    at = np.stack([row - y + c * y - s * x - 11.0, col - x + s * y + c * x + 14.0])
    off = np.stack(lens.observed(*at)) - [row, col]
    basis = PolynomialDistortion(shape, np.zeros((2, 10))).basis(row, col)
    return PolynomialDistortion(shape, np.linalg.lstsq(basis, off.T)[0].T)


@pytest.mark.dolfinx
def test_photographs_off_the_middle_of_another_light_and_through_a_lens(tmp_path: Path) -> None:
    from modeharvest.fem.meshing import mesh_specimen
    from modeharvest.fem.path.parametric import ParametricTest

    experiment = Experiment(Specimen(**SPECIMEN), strains=(0.03, 0.05), mesh_size=0.5)
    mesh, lens = mesh_specimen(experiment.specimen, 0.5), CameraDistortion(900, 900, 130, 80, 0.2)
    states = ParametricTest(experiment, ("tilt",), mesh).at(np.array([0.1]), False)
    snapshots = tuple(Snapshot(s.strain, s.displacement) for s in states)
    write_distortion(tmp_path / "seen.json", as_seen(lens, (170, 262)))
    write_distortion(tmp_path / "lens.json", lens)
    imaging = ImagingSpec(
        pixel_size=0.05, shape=(170, 262), margin_px=0, distortion=str(tmp_path / "seen.json")
    )
    images = make_images(Solution(mesh, snapshots), imaging, tmp_path / "images", (0.03, 0.05))
    random = np.random.default_rng(0)
    for name, image in (("f", images.reference()), ("g1", images.deformed(0.03)),
                        ("g2", images.deformed(0.05))):  # fmt: skip
        grey = image if name == "f" else 0.8 * image + 0.08
        write_image(tmp_path / f"{name}.tif", grey + random.normal(0.0, 0.01, grey.shape))
    data = {"reference": "f.tif", "deformed": ["g*.tif"], "pixel_size": 0.05, "noise_sd": 0.01,
            "distortion": "lens.json", "forces_N_per_mm": [s.force for s in states],
            "force_sd": 0.002}  # fmt: skip
    tables = {key: value for key, value in BEFORE.items() if key not in ("twin", "imaging")}

    def identified(**more: object) -> dict[str, Any]:
        case = IdentificationCase.model_validate(tables | {"data": data | more})
        case._base = tmp_path
        return run_identification(case, tmp_path / "out")

    found = identified()["parameters"]
    assert [p["name"] for p in found[3:]] == ["centre_x", "centre_y", "orientation"]
    assert [p["unit"] for p in found[3:]] == ["mm", "mm", "rad"]
    true = [1.2, 5.4, 0.1, 0.7, 0.55, np.radians(1.0)]
    for p, exact in zip(found, true, strict=True):
        assert abs(p["value"] - exact) < 4.0 * p["sd_with_model_error"]
    assert abs(found[3]["start"] - 0.7) < 0.02  # holes say so, to 0.4 px
    with pytest.raises(InputError, match=r"place of the specimen in the reference: .* a cell size"):
        identified(pixel_size=0.07)
    with pytest.raises(InputError, match=r"none\.json"):
        identified(distortion="none.json")


@pytest.mark.dolfinx
def test_larger_holes_and_a_bowed_edge_are_found(tmp_path: Path) -> None:
    """Under a light that changes, through a known lens; the holes are scattered, too."""
    unknowns = {"moduli[0]": {"start": 2.4, "bounds": [0.1, 10.0]},
                "kappa": {"start": 2.7, "bounds": [0.5, 50.0]},
                "holes.diameter[0,0]": {"start": 0.0, "bounds": [-0.1, 0.1]},
                "holes[1].y": {"start": 0.0, "bounds": [-0.05, 0.05]},
                "right.x[2]": {"start": 0.0, "bounds": [-1.0, 1.0]}}  # fmt: skip
    twin = {"mesh_size": 0.5, "force_sd": 0.002, "force_seed": 3,
            "values": {"holes.diameter[0,0]": 0.04, "holes[1].y": 0.02, "right.x[2]": 0.3},
            "imperfection": {"position_sd": 1e-4, "diameter_sd": 1e-4}}  # fmt: skip
    sensor = {"read_noise": 0.01, "read_seed": 5, "flicker": 0.05, "flicker_seed": 2}
    lens = {"kind": "camera", "fx": 900, "fy": 900, "cx": 108, "cy": 58, "k1": 0.2}
    imaging = {"pixel_size": 0.05, "margin_px": 14, "sensor": sensor, "distortion": lens}
    tables = BEFORE | {"unknowns": unknowns, "twin": twin, "imaging": imaging}
    summary = run_identification(tables, tmp_path)
    assert summary["outcome"] == "converged"
    require_truth(summary)
    true = {p["name"]: p["true"] for p in summary["parameters"]}
    assert true["right.x[2]"] == 0.3
    assert true["holes.diameter[0,0]"] == pytest.approx(0.04, abs=1e-3)
    assert {p["unit"] for p in summary["parameters"][2:]} == {"mm"}
    hole = summary["holes"][1]
    assert hole["centre"] == pytest.approx([-2.85, 0.95])
    assert hole["off"][1:] == [*(p["value"] for p in summary["parameters"][3:1:-1]), 0.0, 0.0]
    assert hole["true"][1] == pytest.approx(0.02, abs=1e-3)
    page = (tmp_path / "report.html").read_text("utf-8")
    assert 'id="holes"' in page
    assert faults(summary, "identify") == []


@pytest.mark.dolfinx
def test_displacements_of_the_ansatz_beside_the_model(tmp_path: Path) -> None:
    """What supports did to one state, without a parameter for it; another state has none of it."""
    true = {"v0[1].x[0,2]": 0.03, "v0[1].y[1,1]": -0.02, "v1[1][0,0]": 0.02}
    beside = [*true, "v0[0].x[0,2]"]
    unknowns = {name: {"start": 0.0, "bounds": [-0.2, 0.2]} for name in beside}
    tables = BEFORE | {"twin": BEFORE["twin"] | {"values": true}}
    known = tables | {"unknowns": BEFORE["unknowns"] | unknowns}
    summary = run_identification(known, tmp_path / "known")
    assert summary["outcome"] == "converged"
    require_truth(summary)
    assert [p["true"] for p in summary["parameters"][3:]] == [*true.values(), 0.0]
    assert {p["unit"] for p in summary["parameters"][3:]} == {"mm"}
    for p in summary["parameters"][3:]:
        assert p["sd_with_model_error"] < 1e-3
    assert summary["model_error"]["p_value"] > 1e-3
    assert faults(summary, "identify") == []
    tables["finer_mesh_size"] = None
    alone = run_identification(tables, tmp_path / "known")  # of the same images
    assert alone["states"][1]["residual_rms"] > 1.2 * alone["states"][1]["residual_noise"]


@pytest.mark.dolfinx
def test_the_summary_is_as_its_schema_says(run: tuple[Path, dict[str, Any]]) -> None:
    assert faults(run[1], "identify") == []


SMALL = {"holes_x": 4, "holes_y": 4, "diameter": 1.6, "bulk_x": 0.9, "bulk_y": 0.4}
"""Buckles at about 8 %."""


@pytest.mark.dolfinx
def test_the_frames_of_a_film_bracket_the_critical_strain(tmp_path: Path) -> None:
    """One photograph long before it, and a film that shows between which 0.1 % it is."""
    experiment = {"specimen": SMALL, "strains": [0.05], "mesh_size": 0.55}
    twin = BEFORE["twin"] | {"frame_strain": 0.001, "tilt": 0.02}
    summary = run_identification(BEFORE | {"experiment": experiment, "twin": twin}, tmp_path)
    assert (summary["outcome"], summary["warnings"]) == ("converged", [])
    require_truth(summary)
    critical = summary["critical_strain"]
    assert critical["measured"] == pytest.approx(0.0785)
    assert critical["measured_sd"] == pytest.approx(0.001 / np.sqrt(12.0))
    assert abs(critical["value"] - critical["measured"]) < 0.7e-3
    assert 0.0 < critical["sd"] < 1e-4
    assert len(summary["states"]) == 1
    assert faults(summary, "identify") == []


@pytest.mark.dolfinx
def test_images_of_the_other_branch_are_noticed(tmp_path: Path) -> None:
    """The pattern's mirror image is that of the other branch, whatever the case names."""
    experiment = {"specimen": SMALL, "strains": [0.1], "mesh_size": 0.62}
    twin = BEFORE["twin"] | {"tilt": 0.01}
    other = BEFORE | {"experiment": experiment | {"branches": ["buckled-"]}, "twin": twin}
    true = IdentificationRun(IdentificationCase.model_validate(other), tmp_path)
    true._make_twin(true.case.twin)
    images = ImageSet.read(tmp_path / "images")
    records = images.info["reference"], *images.info["snapshots"]
    for name, record in zip("fg", records, strict=True):
        image = read_image(images.folder / record["camera_image"])
        write_image(tmp_path / f"{name}.tif", image)
    readings = json.loads((tmp_path / "forces.json").read_text("utf-8"))
    data = {"reference": "f.tif", "deformed": ["g.tif"], "pixel_size": 0.05,
            "force_sd": 0.002, **readings}  # fmt: skip
    tables = {key: value for key, value in BEFORE.items() if key not in ("twin", "imaging")}
    tables |= {"experiment": experiment, "finer_mesh_size": 0.55, "data": data}
    case = IdentificationCase.model_validate(tables)
    case._base = tmp_path
    found = run_identification(case, tmp_path / "found")
    assert "the specimen is on buckled-: on buckled+ the model fits worse" in found["statements"]
    assert [s["branch"] for s in found["states"]] == ["buckled-"]
    assert found["warnings"] == []
    ogden = Ogden()
    for p, value in zip(found["parameters"], (ogden.moduli[0], ogden.kappa, 0.01), strict=False):
        assert abs(p["value"] - value) < 4.0 * p["sd_with_model_error"]


NEVER = float("nan")


@pytest.mark.parametrize(
    ("costs", "best"),
    [
        ({"buckled+": None}, "buckled+"),
        ({"buckled+": 3.0, "buckled-": None}, "buckled-"),
        ({"buckled+": 3.0, "buckled-": 2.0}, "buckled-"),
        ({"buckled+": 3.0, "buckled-": 4.0}, "buckled+"),
        ({"buckled+": 3.0, "buckled-": NEVER}, "buckled+"),
        ({"primary": 3.0}, "primary"),
    ],
)
def test_the_other_branch_is_tried_where_states_are_unlike(
    costs: dict[str, float | None], best: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Costs are those of states unlike the data: none where they are alike, NaN without states."""

    def identified(
        _: IdentificationRun, case: IdentificationCase, unlike_is_error: bool = False
    ) -> tuple[Any, str]:
        (named,) = case.experiment.branches
        cost = costs[named]
        if cost is not None and np.isnan(cost):
            raise InputError("no states")
        if cost is not None and unlike_is_error:
            raise UnlikeDataError("unlike")
        return SimpleNamespace(
            states=[SimpleNamespace(branch=named)],
            state_equations=[SimpleNamespace(residual=2.0 if cost else 1.0, expected=1.0)],
            minimum=SimpleNamespace(equations=SimpleNamespace(cost=cost)),
        ), named

    monkeypatch.setattr(IdentificationRun, "_identified", identified)
    experiment = BEFORE["experiment"] | {"branches": [next(iter(costs))]}
    case = IdentificationCase.model_validate(BEFORE | {"experiment": experiment})
    _, found, statements = IdentificationRun(case, tmp_path)._best(case)
    assert found == best
    text = "the specimen is on buckled-: on buckled+ the model fits worse"
    assert statements == [text] * (best == "buckled-")


@pytest.mark.parametrize(("branch", "travel"), [("buckled+", 1.0), ("buckled-", 1.01)])
def test_states_beside_the_critical_point_get_an_amplitude(branch: str, travel: float) -> None:
    """Those within 100 standard deviations of their strains, of the branch that is named."""
    strains = (0.06, 0.0795, 0.0801, 0.09)
    data = {**FIELDS, "strain_sd": 1e-5}
    case = IdentificationCase.model_validate({
        "experiment": {"strains": strains, "branches": [branch]},
        "unknowns": BEFORE["unknowns"], "data": data,
    })  # fmt: skip
    unknowns = {"travel": None, "amplitude[2]": None}
    found: Any = SimpleNamespace(
        unknowns=unknowns, minimum=SimpleNamespace(unknowns=np.array([travel, 0.1]))
    )
    fine = SimpleNamespace(critical_strain=0.08 * travel, experiment=case.experiment)
    near = IdentificationRun(case, Path())._beside_critical(found, fine)
    assert list(near) == ["amplitude[1]"]
    assert np.sign(near["amplitude[1]"].start) == (1.0 if branch == "buckled+" else -1.0)
    fine.critical_strain = None
    assert IdentificationRun(case, Path())._beside_critical(found, fine) == {}


@pytest.mark.dolfinx
def test_several_laws_are_compared_by_their_evidence(run: tuple[Path, dict[str, Any]]) -> None:
    """Before buckling two laws that fit are not told apart, and one too hard to compress is."""
    summary = run[1]
    laws = summary["laws"]
    assert [law["name"] for law in laws] == ["Ogden", "I1", "hard"]
    names = [[p["name"] for p in law["parameters"]] for law in laws]
    assert names[1:] == [["c1", "bulk", "tilt"], ["moduli[0]", "tilt"]]
    assert laws[0]["parameters"][0]["value"] == summary["parameters"][0]["value"]
    evidence = [law["log_evidence"] for law in laws]
    assert abs(evidence[0] - evidence[1]) < 1.0
    assert max(evidence) > evidence[2] + 10.0
    assert re.match("(Ogden and I1|I1 and Ogden) are not disting", summary["statements"][-1])
    tables = {table.title: table for table in identification_report(summary).tables}
    assert len(tables["Materials compared"].rows) == 3


@pytest.mark.dolfinx
def test_omitted_terms_begin_beyond_linear_elasticity() -> None:
    from modeharvest.fem.path.sensitivity import with_omitted_terms

    law = with_omitted_terms(Ogden())
    object.__setattr__(law, "omitted", (1.0, 2.0, 3.0))
    rest = np.eye(2)[None]
    for own, wider in zip(
        stress_and_tangent(Ogden(), rest), stress_and_tangent(law, rest), strict=True
    ):
        np.testing.assert_allclose(own, wider, atol=1e-12)
    strained = rest + 0.1 * np.array([[1.0, 0.3], [0.0, -0.5]])
    own, wider = (stress_and_tangent(m, strained)[0] for m in (Ogden(), law))
    step = np.array([[1e-6, 0.0], [0.0, 0.0]])

    def energy(F: Any) -> float:
        return float(law.energy(JetMatrix(F)).value[0] - Ogden().energy(JetMatrix(F)).value[0])

    slope = (energy(strained + step) - energy(strained - step)) / 2e-6
    assert (wider - own)[0, 0, 0] == pytest.approx(slope, rel=1e-6)
    assert abs(slope) > 1e-3


def test_evidence_in_words() -> None:
    text = compared_by_evidence(["Ogden", "I1"], [(-90.0, 0.5), (-100.0, 1.0)], ["I1"])
    assert text.startswith("evidence for Ogden against I1 is decisive (the logarithm of")
    assert text.endswith("at least)")
    text = compared_by_evidence(["Ogden", "I1"], [(-100.0, 3.0), (-98.0, 0.0)], ["I1"])
    assert text.startswith("I1 and Ogden are not distinguishable (the logarithm")
    assert text.endswith("; but the tests reject I1 itself: it is the least wrong of these")


def test_the_shipped_case_is_one() -> None:
    case = IdentificationCase.read("identify-twin")
    assert case.twin is not None
    assert case.twin.value("exponents[0]") == 3.0
    with pytest.raises(InputError, match="run 'modeharvest identify identify-twin"):
        Case.read("identify-twin")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"unknowns": {}}, "expected at least one, got none"),
        ({"unknowns": {"kappa": {"start": 1.0, "bounds": [2.0, 3.0]}}},
         "start between them, got a start of 1 and bounds of [2, 3]"),
        ({"unknowns": {"kappa": {"start": 1.0, "bounds": [-2.0, 3.0]}}},
         "unknowns.kappa: expected bounds of 0 or more, got -2.0"),
        ({"unknowns": {"kappa": {"start": 1.0}}}, "expected unknowns.kappa.bounds, got none"),
        ({"experiment": {"strains": [0.05, 0.03]}}, "expected ascending positive ones"),
        ({"data": {"reference": "f.tif", "deformed": ["g.tif", "h.tif"]}},
         "expected a pixel_size [mm/px] for images"),
        ({"data": {"fields": ["a.csv", "b.csv"]}}, "expected field_sd_mm"),
        ({"data": {}}, "expected images (reference and deformed) or fields, got neither"),
        ({"data": {"fields": ["a.csv", "b.csv"], "field_sd_mm": 1.0, "forces_N": [1.0, 2.0],
                   "force_sd": 0.1}}, "expected thickness_mm with forces_N"),
        ({"data": {"fields": ["a.csv", "b.csv"], "field_sd_mm": 1.0, "forces_N_per_mm": [1.0],
                   "force_sd": 0.1}}, "as many forces_N_per_mm as strains (2), got 1"),
        ({"data": {"fields": ["a.csv", "b.csv"], "field_sd_mm": 1.0, **FORCES, "force_sd": None}},
         "expected force_sd with forces"),
        ({"finer_mesh_size": 0.6}, "expected finer_mesh_size [mm] above 0 and at most 0.495"),
        ({"unknowns": {"holes[8].x": {"start": 0.0, "bounds": [-0.1, 0.1]}}},
         "expected a hole from 0 to 7 in holes[8].x, got 8"),
        ({"unknowns": {"v0[2].x[0,0]": {"start": 0.0, "bounds": [-0.1, 0.1]}}},
         "expected a state from 0 to 1 in v0[2].x[0,0], got 2"),
        ({"unknowns": {"v1[0][7,0]": {"start": 0.0, "bounds": [-0.1, 0.1]}}},
         "expected a degree from 0 to 6 in v1[0][7,0], got 7"),
        ({"unknowns": {"v0[0].z[0,0]": {"start": 0.0, "bounds": [-0.1, 0.1]}}},
         "'v0[k].x[i,j]'"),
        ({"twin": {"values": {"bow": 0.1}}}, "got 'bow'"),
        ({"twin": {"force_seed": -1}}, "twin: expected a force_seed of 0 or more, got -1"),
        ({"data": {"fields": ["a.csv", "b.csv"], "field_sd_mm": 1.0, "distortion": "lens.json"}},
         "expected images for the distortion of a lens, got fields"),
        ({"data": {"reference": "f.tif", "deformed": ["g.tif", "h.tif"], "pixel_size": 0.1,
                   "brightness": 9}}, "0 (even) to 6, or 'none', got 9"),
        ({"twin": None}, "expected a table [data] or a table [twin]"),
        ({"data": {**FIELDS, "critical_strain": [0.08, 0.07]}},
         "expected critical_strain = [low, high] above 0, got [0.08, 0.07]"),
        ({"laws": [{"name": "Ogden", "material": {"kind": "ogden"}, "unknowns": {}}]},
         "laws: expected names that differ, got ['Ogden', 'Ogden']"),
        ({"laws": [{"name": "a", "material": {"kind": "foam"}, "unknowns": {}}]},
         "expected a laws.material kind among ['ogden', 'two-term-I1'], got 'foam'"),
    ],
)  # fmt: skip
def test_a_case_that_makes_no_sense_is_refused_in_one_line(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    tables = BEFORE | change
    if "data" in change:
        del tables["twin"]
    tables = {name: value for name, value in tables.items() if value is not None}
    path = tmp_path / "case.json"
    with pytest.raises(InputError, match=re.escape(message)) as refused:
        IdentificationCase.of(made(tables, path))
    assert "\n" not in str(refused.value)


def made(tables: dict[str, Any], path: Path) -> IdentificationCase:
    from modeharvest.runs.case import checked

    return checked(IdentificationCase, tables, path)


@pytest.mark.dolfinx
def test_images_of_another_number_are_refused(tmp_path: Path) -> None:
    tables = {name: value for name, value in BEFORE.items() if name != "twin"}
    data = {"reference": "f.tif", "deformed": ["g.tif"], "pixel_size": 0.05}
    for name in ("f", "g"):
        write_image(tmp_path / f"{name}.tif", np.zeros((20, 20), np.uint8))
    fields = {"fields": ["f.tif"], "field_sd_mm": 1.0}
    for table, what in ((data, "deformed images"), (fields, "fields")):
        case = made(tables | {"data": table}, tmp_path)
        case._base = tmp_path
        with pytest.raises(InputError, match=rf"as many {what} as strains \(2\), got 1"):
            run_identification(case, tmp_path / "out")


@pytest.mark.parametrize(("stretch", "is_beyond"), [(0.6, False), (0.5, True)])
def test_states_beyond_the_surface_instability_are_warned_of(
    stretch: float, is_beyond: bool
) -> None:
    nodes = reference_element("T6").nodes
    u = nodes @ np.diag([0.2, stretch - 1.0])
    state = SimpleNamespace(mesh=Mesh(nodes, np.arange(6)[None], "T6"), displacement=u, strain=0.12)
    assert [f"At 12 % a stretch is {stretch:.3f}" in w for w in _surface_warnings(state)] == [
        True
    ] * is_beyond


def test_states_that_are_not_those_of_the_whole_path_are_warned_of() -> None:
    def ends_at(u: float) -> list[SimpleNamespace]:
        return [SimpleNamespace(displacement=np.full((3, 2), u))]

    def lost(values: object, with_derivatives: bool) -> list[SimpleNamespace]:
        raise InputError("expected an equilibrium, got none")

    near, same, other = (lambda *_, u=u: ends_at(u) for u in (0.1, 0.1 + 1e-7, 0.3))
    none = np.zeros(0)
    assert _path_warnings(SimpleNamespace(near=near, at=same), none) == []
    (text,) = _path_warnings(SimpleNamespace(near=near, at=other), none)
    assert "up to 0.2 mm from those of the whole path with the same parameters" in text
    (text,) = _path_warnings(SimpleNamespace(near=near, at=lost), none)
    assert text.endswith("following the whole path failed: expected an equilibrium, got none")
