"""Distortions survive their files, and those of OpenCV and DICe are read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from modeharvest.imaging.distortion.files import AnyDistortion, read_distortion, write_distortion
from modeharvest.imaging.distortion.lens import (
    CameraDistortion,
    PolynomialDistortion,
    SampledDistortion,
)
from modeharvest.util.errors import InputError

RNG = np.random.default_rng(0)
LENS = CameraDistortion(2600.5, 2600.25, 959.5, 539.5, -0.25, 0.1, 1e-3, -2e-3, 0.03)
KINDS: list[AnyDistortion] = [
    LENS,
    PolynomialDistortion((30, 40), RNG.normal(size=(2, 10))),
    SampledDistortion(np.arange(4.0), np.arange(5.0) / 3, RNG.normal(size=(2, 4, 5))),
]

# As cv::FileStorage writes them.
YAML = """%YAML:1.0
---
calibration_time: "2026"
image_width: 1920
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 2600.5, 0., 959.5, 0., 2600.25, 539.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.5e-01, 0.1, 1.0e-03, -2.0e-03,
       3.0000000000000000e-02 ]
"""
XML = """<?xml version="1.0"?>
<opencv_storage>
<camera_matrix type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>2600.5 0. 959.5 0. 2600.25 539.5 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix">
  <rows>1</rows><cols>5</cols><dt>d</dt>
  <data>-2.5e-01 0.1 1e-03
    -2e-03 3e-02</data></distortion_coefficients>
</opencv_storage>
"""
DICE = """<ParameterList>
  <Parameter name="xml_file_format" type="string" value="DICe_xml_camera_system_file" />
  <ParameterList name="CAMERA 0">
    <Parameter name="CAMERA_ID" type="string" value="left" />
    <Parameter name="CX" type="double" value="959.5" />
    <Parameter name="CY" type="double" value="539.5" />
    <Parameter name="FX" type="double" value="2600.5" />
    <Parameter name="FY" type="double" value="2600.25" />
    <Parameter name="FS" type="double" value="0.0" />
    <Parameter name="K1" type="double" value="-2.5e-01" />
    <Parameter name="K2" type="double" value="0.1" />
    <Parameter name="K3" type="double" value="0.03" />
    <Parameter name="P1" type="double" value="0.001" />
    <Parameter name="P2" type="double" value="-0.002" />
    <Parameter name="LENS_DISTORTION_MODEL" type="string" value="OPENCV_LENS_DISTORTION" />
  </ParameterList>
</ParameterList>
"""


def same(a: AnyDistortion, b: AnyDistortion) -> bool:
    at = np.arange(0.0, 30.0), np.arange(5.0, 35.0)
    return type(a) is type(b) and np.array_equal(a.shift(*at), b.shift(*at))


@pytest.mark.parametrize("distortion", KINDS)
def test_writing_and_reading_changes_no_bit(distortion: AnyDistortion, tmp_path: Path) -> None:
    write_distortion(tmp_path / "lens.json", distortion)
    assert same(read_distortion(tmp_path / "lens.json"), distortion)


@pytest.mark.parametrize(("name", "text"), [("a.yml", YAML), ("b.xml", XML), ("c.xml", DICE)])
def test_other_codes_files_are_read(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    assert same(read_distortion(tmp_path / name), LENS)


def test_opencvs_json_is_read(tmp_path: Path) -> None:
    matrix = {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d"}
    matrix["data"] = [2600.5, 0.0, 959.5, 0.0, 2600.25, 539.5, 0.0, 0.0, 1.0]
    coefficients = {"rows": 1, "cols": 5, "dt": "d", "data": [-0.25, 0.1, 1e-3, -2e-3, 0.03]}
    content = {"camera_matrix": matrix, "distortion_coefficients": coefficients}
    (tmp_path / "a.json").write_text(json.dumps(content))
    assert same(read_distortion(tmp_path / "a.json"), LENS)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", '{"kind": "fisheye"}', "kind among"),
        ("a.json", '{"kind": "camera", "fx": 1}', "expected fy"),
        ("a.json", "[1, 2]", "expected a distortion"),
        ("a.json", '{"kind": ', "expected a JSON file"),
        ("a.yml", "x: 1\n", "camera_matrix"),
        ("a.xml", "<ParameterList>", "expected a distortion"),
        ("a.xml", DICE.replace("OPENCV_LENS", "K1R1_K2R2_K3R3"), "K1R1_K2R2_K3R3"),
        ("a.xml", DICE.replace('"FX"', '"F"'), "expected fx"),
        ("a.txt", "x", "json, .xml"),
    ],
)
def test_what_is_no_distortion_is_refused_in_a_line(
    name: str, text: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_distortion(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused_in_a_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a distortion at"):
        read_distortion(tmp_path / "none.xml")
