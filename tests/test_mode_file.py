"""Modes on disk: lossless, readable by anyone, whole or absent, and errors that help."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest

from modeharvest.fem.bloch.modes import (
    Branch,
    BranchState,
    ModeSet,
    read_modes,
    write_modes,
    write_vtu,
    write_xdmf,
)
from modeharvest.fem.field import Mesh
from modeharvest.util.errors import InputError

CORNERS = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
MIDDLES = [[0.5, 0.0], [1.0, 0.5], [0.5, 1.0], [0.0, 0.5], [0.5, 0.5]]
CELLS = [[0, 1, 2, 4, 5, 8], [0, 2, 3, 8, 6, 7]]
MESH = Mesh(np.array(CORNERS + MIDDLES), np.array(CELLS), "T6")
SHAPE = MESH.nodes.shape
Writer = Callable[[Path, ModeSet, Sequence[Branch]], None]


def sample() -> tuple[ModeSet, tuple[Branch, ...]]:
    """Two modes, a branch with two states and one that couldn't be followed."""
    random = np.random.default_rng(3)
    modes = ModeSet(
        mesh=MESH,
        lattice=2.0 * np.eye(2),
        primitive=np.eye(2),
        waves=((math.pi, 0.0), (2 * math.pi / 3, -0.1)),
        eigenvalues=np.array([1e-13, -2.5]),
        shapes=random.normal(size=(2, *SHAPE)),
        load=0.0768,
        gradient=np.array([[0.92, 0.0], [1e-17, 1.03]]),
        info={"material": {"c1": 0.55}, "text": "µm -- two hyphens", "copies": [2, 2]},
    )

    def state(load: float, primary: float) -> BranchState:
        square, u = random.normal(size=(2, 2, 2)), random.normal(size=SHAPE)
        return BranchState(load, *square, 1.5e-3, primary, 1, u, random.normal(size=2))

    states = (state(0.08, 1.6e-3), state(0.12, math.nan))
    curve = np.array([[0.0, 0.0768], [0.01, 0.08]])
    return modes, (Branch((0.6, -0.8), states, "followed", curve), Branch((1.0, 0.0), (), "not"))


def assert_same(a: object, b: object) -> None:
    """All fields alike, to the last bit; NaN is NaN."""
    for field in fields(a):  # type: ignore[arg-type]
        left, right = getattr(a, field.name), getattr(b, field.name)
        if field.name == "mesh":
            assert_same(left, right)
        elif field.name == "states":
            for s, t in zip(left, right, strict=True):
                assert_same(s, t)
        elif isinstance(left, np.ndarray | float):
            np.testing.assert_array_equal(left, right)
        else:
            assert left == right


def test_hdf5_round_trip_is_lossless(tmp_path: Path) -> None:
    modes, branches = sample()
    write_modes(tmp_path / "new folder" / "modes.h5", modes, branches)
    back, followed = read_modes(tmp_path / "new folder" / "modes.h5")
    assert_same(back, modes)
    for a, b in zip(followed, branches, strict=True):
        assert_same(a, b)


def test_a_file_without_branches_is_whole(tmp_path: Path) -> None:
    write_modes(tmp_path / "m.h5", sample()[0])
    assert read_modes(tmp_path / "m.h5")[1] == ()


def test_the_layout_is_the_one_described(tmp_path: Path) -> None:
    """What the module's docstring promises to programs that don't know this project."""
    modes, branches = sample()
    write_modes(tmp_path / "m.h5", modes, branches)
    with h5py.File(tmp_path / "m.h5") as file:
        assert file.attrs["format"] == "modeharvest-modes-1"
        assert file.attrs["element"] == "T6"
        assert "mean over the cell's material" in file.attrs["normalisation"]
        assert file.attrs["load"] == 0.0768
        assert json.loads(file.attrs["info"])["material"] == {"c1": 0.55}
        for name in ("lattice", "primitive", "eigenvalues", "shapes", "gradient", "waves"):
            assert np.array_equal(file[name][:], getattr(modes, name))
        assert np.array_equal(file["cells"][:], CELLS)
        assert list(file["branches"]) == ["0000", "0001"]
        assert np.array_equal(file["branches/0000/curve"][:], branches[0].curve)
        state = file["branches/0000/states/0001"]
        assert np.array_equal(state["displacement"][:], branches[0].states[1].displacement)
        assert state.attrs["negative_eigenvalues"] == 1


@pytest.mark.parametrize(("write", "name"), [(write_vtu, "m.vtu"), (write_xdmf, "m.xdmf")])
def test_paraview_files_carry_modes_with_units_in_their_names(
    write: Writer, name: str, tmp_path: Path
) -> None:
    modes, branches = sample()
    write(tmp_path / name, modes, branches)
    assert [path.name for path in tmp_path.iterdir()] == [name]  # one file, no leftovers
    back = meshio.read(tmp_path / name)
    assert list(back.point_data) == [
        "mode_1_phases_1pi_0pi_unit_mean_square",
        "mode_2_phases_0.6667pi_-0.03183pi_unit_mean_square",
        "branch_1_state_1_load_0.08_displacement_mm",
        "branch_1_state_1_load_0.08_fluctuation_mm",
        "branch_1_state_2_load_0.12_displacement_mm",
        "branch_1_state_2_load_0.12_fluctuation_mm",
    ]
    for field, shape in zip(back.point_data.values(), modes.shapes, strict=False):
        assert np.array_equal(field[:, :2], shape)
        assert not field[:, 2].any()
    state = branches[0].states[1]
    fluctuation = back.point_data["branch_1_state_2_load_0.12_fluctuation_mm"][:, :2]
    affine = MESH.nodes @ (state.gradient - np.eye(2)).T
    assert np.allclose(fluctuation + affine, state.displacement, atol=1e-14)
    assert np.array_equal(back.points[:, :2], MESH.nodes)
    assert [block.type for block in back.cells] == ["triangle6"]
    assert np.array_equal(back.cells[0].data, CELLS)


@pytest.mark.parametrize(("write", "name"), [(write_vtu, "m.vtu"), (write_xdmf, "m.xdmf")])
def test_paraview_files_tell_the_rest_in_a_comment(
    write: Writer, name: str, tmp_path: Path
) -> None:
    modes, branches = sample()
    write(tmp_path / name, modes, branches)
    text = (tmp_path / name).read_text(encoding="utf-8")
    reported = json.loads(text.split("<!-- ")[1].split(" -->")[0])
    assert reported["info"] == modes.info  # the two hyphens, too, which no comment may have
    assert reported["load"] == modes.load
    assert reported["waves_rad"] == [list(wave) for wave in modes.waves]
    assert reported["branches"][0] == {"combination": [0.6, -0.8], "outcome": "followed"}


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_clipped_file_is_refused_in_one_line(share: float, tmp_path: Path) -> None:
    path = tmp_path / "m.h5"
    write_modes(path, *sample())
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=r"expected modes \(HDF5\) at .*m\.h5, got: ") as caught:
        read_modes(path)
    assert "\n" not in str(caught.value)


def test_foreign_and_missing_files_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found no such file"):
        read_modes(tmp_path / "none.h5")
    path = tmp_path / "foreign.h5"
    path.write_text("not HDF5")
    with pytest.raises(InputError, match=r"expected modes \(HDF5\)"):
        read_modes(path)
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "modeharvest-solution-1"
    with pytest.raises(InputError, match=r"modeharvest-modes-1 file .* 'modeharvest-solution-1'"):
        read_modes(path)


@pytest.mark.parametrize("lost", ["shapes", "waves", "branches/0000/states/0000/displacement"])
def test_a_file_that_lacks_something_is_refused(lost: str, tmp_path: Path) -> None:
    write_modes(tmp_path / "m.h5", *sample())
    with h5py.File(tmp_path / "m.h5", "a") as file:
        del file[lost]
    with pytest.raises(InputError, match="make it again") as caught:
        read_modes(tmp_path / "m.h5")
    assert "\n" not in str(caught.value)


def test_arrays_that_do_not_fit_the_mesh_are_refused(tmp_path: Path) -> None:
    modes, branches = sample()
    for wrong in (modes.shapes[:, :-1], modes.shapes[:1], np.full((2, *SHAPE), np.nan)):
        with pytest.raises(InputError, match=r"expected finite shapes of shape \(2, 9, 2\)"):
            replace(modes, shapes=wrong)
    cut = replace(branches[0].states[0], displacement=np.zeros((3, 2)))
    write_modes(tmp_path / "m.h5", modes, [replace(branches[0], states=(cut,))])
    with pytest.raises(InputError, match=r"shape \(3, 2\) on 9 nodes"):
        read_modes(tmp_path / "m.h5")
