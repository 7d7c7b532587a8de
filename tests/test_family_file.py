"""A found family as a file: the same to the last bit when read again, and no other file for it."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from known_fields import square_mode
from perforated import OBLIQUE, PITCH, SQUARE, holed_cell

from modeharvest.idic.ansatz import Ansatz
from modeharvest.idic.chebyshev import Box
from modeharvest.idic.correlate import fit_displacement
from modeharvest.idic.modes import FourierMode, Taper
from modeharvest.idic.spectra.lattice_spectrum import LatticeSpectrum, lattice_spectrum
from modeharvest.idic.spectra.mode_family import (
    FORMAT,
    FoundFamily,
    mode_family,
    read_family,
    read_spectrum,
    write_family,
)
from modeharvest.imaging.grid import PixelGrid
from modeharvest.util.errors import InputError

MESH, LATTICE = holed_cell(SQUARE, 4, (2, 2)), 2 * SQUARE
FIELD = square_mode([0.987654321, 1, 1, 1, -1, 0.1, -0.07], PITCH, *MESH.nodes.T)
INFO = {"critical_strain": 0.1 + 0.2, "loading": {"name": "uniaxial", "axis": "x"}, "ν": None}


@pytest.fixture(scope="module")
def found() -> FoundFamily:
    return mode_family(MESH, LATTICE, FIELD, PITCH, info={"lattice": "square"})


@pytest.fixture(scope="module")
def spectrum() -> LatticeSpectrum:
    return lattice_spectrum(MESH, LATTICE, FIELD, PITCH)


def assert_same(ours: Any, theirs: Any) -> None:
    """Every field of a dataclass equal, arrays to the last bit."""
    for f in fields(ours):
        a, b = getattr(ours, f.name), getattr(theirs, f.name)
        if f.name == "family":
            assert_same(a, b)
        elif isinstance(a, np.ndarray):
            assert np.array_equal(a, b), f.name
            assert a.dtype == b.dtype
        elif f.name != "info":
            assert a == b, f.name


def test_round_trip_is_exact(tmp_path: Path, found: FoundFamily, spectrum: LatticeSpectrum) -> None:
    path = tmp_path / "new" / "family.json"
    write_family(path, found, INFO, spectrum)
    again, coefficients = read_family(path), read_spectrum(path)
    assert_same(found, again)
    assert again.info == {"lattice": "square", **INFO}
    assert coefficients is not None
    assert_same(spectrum, coefficients)
    write_family(path, again, spectrum=coefficients)
    assert_same(read_family(path), found)
    assert [p.name for p in path.parent.iterdir()] == ["family.json"]


def test_file_is_readable_without_this_project(tmp_path: Path, found: FoundFamily) -> None:
    """The formula under "conventions" gives the field, and the spectrum is optional."""
    path = tmp_path / "family.json"
    write_family(path, found)
    content = json.loads(path.read_text("utf-8"))
    x, y = MESH.nodes.T
    u = np.zeros_like(FIELD)
    for A, B, kx, ky, c in content["waves"]:
        sine = np.sin(np.pi / content["pitch"] * (kx * x + ky * y + c))
        u += content["amplitude"] * np.outer(sine, [A, B])
    # Six-node elements of a quarter pitch follow the waves to about 1 %.
    np.testing.assert_allclose(u, FIELD, atol=0.03)
    parameters = np.array(content["matrix"]) @ content["start"] + content["offset"]
    assert np.array_equal(parameters.reshape(-1, 5), content["waves"])
    assert read_spectrum(path) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "modeharvest-solution-1"}, FORMAT),
        ({"matrix": [[1.0]]}, "matrix"),
        ({"matrix": [[1.0], [1.0, 2.0]]}, "matrix|inhomogeneous"),
        ({"start": "a"}, "float"),
        ({"start": None}, "start"),
        ({"pitch": -1.0}, "pitch"),
        ({"captured": float("nan")}, "finite"),
        ({"growth": [1]}, "whole"),
        ({"names": ["a1"]}, "names"),
        ({"info": 3}, "whole"),
    ],
)
def test_damaged_files_are_refused(
    tmp_path: Path, found: FoundFamily, change: dict[str, Any], words: str
) -> None:
    path = tmp_path / "family.json"
    write_family(path, found)
    content = {**json.loads(path.read_text("utf-8")), **change}
    path.write_text(json.dumps(content), "utf-8")
    with pytest.raises(InputError, match=words) as caught:
        read_family(path)
    assert "\n" not in str(caught.value)


def test_foreign_files_are_refused(
    tmp_path: Path, found: FoundFamily, spectrum: LatticeSpectrum
) -> None:
    path = tmp_path / "family.json"
    write_family(path, found, spectrum=spectrum)
    whole = path.read_text("utf-8")
    for text in (whole[: len(whole) // 2], "[1, 2]", "3", ""):
        path.write_text(text, "utf-8")
        for read in (read_family, read_spectrum):
            with pytest.raises(InputError, match=r"family\.json") as caught:
                read(path)
            assert "\n" not in str(caught.value)
    content = json.loads(whole)
    for key in ("name", "matrix", "text"):
        path.write_text(json.dumps({k: v for k, v in content.items() if k != key}), "utf-8")
        with pytest.raises(InputError, match=f"no '{key}'"):
            read_family(path)
    content["spectrum"]["coefficients"] = [[1.0, 2.0]]
    path.write_text(json.dumps(content), "utf-8")
    with pytest.raises(InputError, match="whole"):
        read_spectrum(path)
    with pytest.raises(InputError, match="absent"):
        read_family(tmp_path / "absent.json")


def test_what_json_cannot_hold_is_refused(tmp_path: Path, found: FoundFamily) -> None:
    for value in (float("inf"), np.zeros(2), {1, 2}):
        with pytest.raises(InputError, match="plain, finite JSON") as caught:
            write_family(tmp_path / "family.json", found, {"value": value})
        assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_family_from_a_file_can_be_fitted(tmp_path: Path) -> None:
    """The found family of a hexagonal flower, tied amplitudes and all, in an ansatz of idic.

    A displacement of the ansatz itself, one hundredth off the start, is found again: the flower's
    waves share columns of the matrix, which the paper's square family does, too, but only in A.
    """
    mesh, rng = holed_cell(OBLIQUE, 4, (2, 2)), np.random.default_rng(5)
    angles = np.pi / 6 + np.pi / 3 * np.arange(3)
    n = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    m = np.stack([-n[:, 1], n[:, 0]], axis=1)
    phases = 2 * np.pi / PITCH / np.sqrt(3) * mesh.nodes @ n.T
    write_family(
        tmp_path / "flower.json",
        mode_family(mesh, 2 * OBLIQUE, np.sin(phases) @ (m + 0.3 * n), PITCH),
    )
    found = read_family(tmp_path / "flower.json")
    assert found.family.names[0] == "L1,2,3"

    cellular, grid = Box.centred(8 * PITCH, 8 * PITCH), PixelGrid.centred(160, 160, 0.1)
    mode = FourierMode.scaled(found.family, found.pitch, Taper(cellular, 0.5 * PITCH))
    ansatz = Ansatz(Box.centred(8 * PITCH, 8 * PITCH), (mode,), v0_degree=1, v_degree=1)
    start = ansatz.initial_guess(0.02, 3.0)
    truth = start.copy()
    truth[ansatz.phi_slice(0)] += 0.01 * rng.uniform(-1, 1, found.family.size)
    u = ansatz.displacement(truth, grid.x[None, :], grid.y[:, None])
    result = fit_displacement(u, grid, ansatz, start)
    np.testing.assert_allclose(result.unknowns, truth, atol=1e-5)
