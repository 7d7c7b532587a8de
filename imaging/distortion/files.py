"""Distortion files: this project's JSON, OpenCV's file storage, DICe's calibration files.

Formats that are read: the JSON written by :func:`write_distortion`; the YAML, XML or JSON of
OpenCV's ``cv::FileStorage`` with ``camera_matrix`` (or ``cameraMatrix``, ``K``) and
``distortion_coefficients`` (or ``distCoeffs``, ``D``) of 4, 5 or 8 numbers; and DICe's
``cal.xml`` with ``OPENCV_LENS_DISTORTION``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from modeharvest.imaging.distortion import lens
from modeharvest.imaging.distortion.lens import CameraDistortion
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, reading, write_json
from modeharvest.util.typed import made, to_plain

AnyDistortion = lens.PolynomialDistortion | CameraDistortion | lens.SampledDistortion
_KINDS: dict[str, type[AnyDistortion]] = {
    "polynomial": lens.PolynomialDistortion,
    "camera": CameraDistortion,
    "sampled": lens.SampledDistortion,
}

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M1", "M")
_COEFFICIENTS = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D", "D1")
_CAMERA = tuple(f.name for f in fields(CameraDistortion))  # coefficients in OpenCV's order
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def write_distortion(path: Path | str, distortion: AnyDistortion) -> None:
    """Write a distortion as JSON, atomically; every number is kept exactly."""
    kind = next(name for name, known in _KINDS.items() if isinstance(distortion, known))
    frame = "px; components along rows (down), columns (right)"
    write_json(path, {"frame": frame, "kind": kind, **to_plain(distortion)})


def read_distortion(path: Path | str, camera: int | str = 0) -> AnyDistortion:
    """Read a distortion from any of the formats above: ``.json``, ``.xml``, ``.yml`` or ``.yaml``.

    ``camera`` is the number or CAMERA_ID of the camera in a DICe file. InputError if the file is
    missing, cut short or of another kind.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    with reading(path, "a distortion", "calibrate the lens again"):
        if suffix == ".json":
            return _from_json(read_json(path), path)
        text = path.read_text("utf-8-sig")
        if suffix == ".xml":
            root = ElementTree.fromstring(text)
            if root.tag == "ParameterList":
                return _from_dice(root, camera, path)
            matrices = {child.tag: _numbers(child.findtext("data") or "") for child in root}
            return _camera(matrices, path)
        if suffix in (".yml", ".yaml"):
            return _camera(_opencv_yaml(text), path)
        raise InputError(f"expected a distortion as .json, .xml, .yml or .yaml, got {path}")


def _from_json(content: Any, path: Path) -> AnyDistortion:
    if not isinstance(content, dict):
        raise InputError(f"expected a distortion at {path}, got {type(content).__name__}")
    if "kind" not in content:  # OpenCV's file storage can also be JSON
        entries = {k: v.get("data") for k, v in content.items() if isinstance(v, dict)}
        return _camera(entries, path)
    name, known = content["kind"], list(_KINDS)
    if name not in known:
        raise InputError(f"expected a distortion of a kind among {known} at {path}, got {name!r}")
    values = {k: v for k, v in content.items() if k not in ("kind", "frame")}
    kind: Any = _KINDS[name]
    found: AnyDistortion = made(kind, values) if kind is CameraDistortion else kind(**values)
    return found


def _numbers(data: str) -> list[float]:
    """Parse the numbers of an OpenCV matrix."""
    return [float(number) for number in re.findall(_NUMBER, data)]


def _opencv_yaml(text: str) -> dict[str, list[float]]:
    """Matrices of OpenCV's YAML: ``name: !!opencv-matrix`` with ``data: [ ... ]``."""
    matrix = r"^(\w+):\s*(?:!!opencv-matrix)?\s*\n(?:\s+\w+:[^\[\n]*\n)*?\s+data:\s*\[([^\]]*)\]"
    return {name: _numbers(data) for name, data in re.findall(matrix, text, re.MULTILINE)}


def _camera(entries: Mapping[str, Any], path: Path) -> CameraDistortion:
    """The camera given by the matrices of an OpenCV file."""
    matrix, coefficients = (
        next((np.ravel(entries[name]) for name in names if entries.get(name) is not None), None)
        for names in (_MATRIX, _COEFFICIENTS)
    )
    if matrix is None or coefficients is None or matrix.size != 9:
        raise InputError(
            f"expected OpenCV's camera_matrix (3 x 3) and distortion_coefficients at {path}, "
            f"got the entries {sorted(entries)}"
        )
    if coefficients.size > 8 and np.any(coefficients[8:]):
        raise InputError(
            f"expected at most 8 distortion coefficients at {path}, got {coefficients.size}: "
            "thin prisms and tilted sensors are not supported"
        )
    fx, _, cx, _, fy, cy, *_ = (float(number) for number in matrix)
    lens = dict(zip(_CAMERA[4:], map(float, coefficients), strict=False))
    return made(CameraDistortion, {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **lens})


def _from_dice(root: ElementTree.Element, which: int | str, path: Path) -> CameraDistortion:
    """The camera given by a DICe calibration file."""
    cameras = [
        {p.get("name", ""): p.get("value", "") for p in item.iter("Parameter")}
        for item in root.findall("ParameterList")
        if item.get("name", "").startswith("CAMERA")
    ]
    ids = [camera.get("CAMERA_ID", "") for camera in cameras]
    index = ids.index(which) if which in ids else which
    if not (isinstance(index, int) and 0 <= index < len(cameras)):
        raise InputError(f"expected camera {which!r} at {path}, got the cameras {ids}")
    entries = cameras[index]
    model = entries.get("LENS_DISTORTION_MODEL", "OPENCV_LENS_DISTORTION")
    if model != "OPENCV_LENS_DISTORTION" or float(entries.get("FS", 0.0)) != 0.0:
        raise InputError(
            f"expected OPENCV_LENS_DISTORTION without skew (FS) at {path}, got {model} with FS "
            f"{entries.get('FS', 0.0)}"
        )
    lens = {n: float(entries[n.upper()]) for n in _CAMERA if n.upper() in entries}
    return made(CameraDistortion, lens)
