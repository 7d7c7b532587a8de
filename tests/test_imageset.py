"""Guards the folder of images: finished or not, never taken for what it isn't."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from modeharvest.fem.field import Mesh, Snapshot, Solution
from modeharvest.imaging import imageset as set_key
from modeharvest.imaging.imageset import ImageSet, image_key, is_complete, make_images
from modeharvest.imaging.pair import Truth
from modeharvest.imaging.sensor import Sensor
from modeharvest.imaging.spec import ImagingSpec, choose_grid
from modeharvest.imaging.speckle.pattern import SpeckleSpec
from modeharvest.util.errors import InputError

SPEC = ImagingSpec(pixel_size=0.05, margin_px=5, background=0.1)
STRAINS = (0.078, 0.128)


def plate() -> Solution:
    """Two Q4 elements, 2 mm x 1 mm off the origin, compressed along x."""
    nodes = np.array([[3, -1], [4, -1], [5, -1], [3, 0], [4, 0], [5, 0]], dtype=np.float64)
    mesh = Mesh(nodes, np.array([[0, 1, 4, 3], [1, 2, 5, 4]]), "Q4")
    shape = (nodes - [4.0, -0.5]) * [-1.0, 0.3]
    snapshots = tuple(Snapshot(s, s * shape) for s in STRAINS)
    return Solution(mesh, snapshots, {"note": "affine"})


@pytest.fixture
def made(tmp_path: Path) -> ImageSet:
    return make_images(plate(), SPEC, tmp_path / "set", STRAINS)


def stamps(folder: Path) -> dict[str, int]:
    return {p.name: p.stat().st_mtime_ns for p in folder.iterdir()}


def test_holds_the_promised_files_and_nothing_else(made: ImageSet) -> None:
    names = {"reference.tif", "reference_8bit.tif", "mask.tif", "images.json"}
    for label in ("0780", "1280"):
        names |= {f"deformed_{label}.tif", f"deformed_{label}_8bit.tif"}
        names |= {f"deformed_{label}_mask.tif", f"truth_{label}.h5"}
    assert {p.name for p in made.folder.iterdir()} == names


def test_reads_back(made: ImageSet) -> None:
    reopened = ImageSet.read(made.folder)
    assert reopened.strains == STRAINS
    assert reopened.spec == SPEC
    assert reopened.max_residual_px <= 1e-10
    assert reopened.reference().shape == reopened.mask().shape == reopened.grid.shape
    mask = reopened.mask()
    assert mask.sum() == 41 * 21  # 2 mm x 1 mm at 0.05 mm, edges on pixel centres included
    assert (reopened.reference()[~mask] == np.float32(0.1)).all()
    for strain in STRAINS:
        truth = reopened.truth(strain)
        inside = reopened.deformed_mask(strain)
        np.testing.assert_array_equal(np.isnan(truth.residual_px), ~inside)
        x, y = np.meshgrid(reopened.grid.x, reopened.grid.y)
        exact = np.stack([-strain * (x - 4.0), 0.3 * strain * (y + 0.5)], axis=-1)
        np.testing.assert_allclose(truth.displacement[mask], exact[mask], atol=1e-14)


@pytest.mark.parametrize("bits", [4, 8, 12, 16])
def test_camera_images_differ_by_half_a_level(tmp_path: Path, bits: int) -> None:
    made = make_images(plate(), replace(SPEC, bits=bits), tmp_path, STRAINS[:1])
    assert (tmp_path / f"reference_{bits}bit.tif").is_file()
    off = made.reference(camera=True) - made.reference()
    assert np.abs(off).max() <= 0.5 / (2**bits - 1) + 1e-6  # and float32 rounding
    off = made.deformed(STRAINS[0], camera=True) - made.deformed(STRAINS[0])
    assert np.abs(off).max() <= 0.5 / (2**bits - 1) + 1e-6


def test_truth_states_units_and_precision(made: ImageSet) -> None:
    with h5py.File(made.folder / "truth_0780.h5") as file:
        units = {name: file[name].attrs["unit"] for name in file}
        types = {name: str(file[name].dtype) for name in file}
        assert file.attrs["nominal_strain"] == 0.078
        assert file.attrs["pixel_size"] == 0.05
    assert units == {
        "displacement": "mm",
        "reference_point": "mm",
        "deformed_displacement": "mm",
        "element": "-",
        "residual_px": "px",
    }
    assert types["displacement"] == types["reference_point"] == "float64"


def test_again_does_nothing(made: ImageSet) -> None:
    before = stamps(made.folder)
    make_images(plate(), SPEC, made.folder, STRAINS)
    assert stamps(made.folder) == before


def test_same_input_same_bits(made: ImageSet, tmp_path: Path) -> None:
    other = make_images(plate(), SPEC, tmp_path / "other", STRAINS)
    assert other.info["files"] == made.info["files"]


@pytest.mark.parametrize(
    ("strains", "spec"),
    [
        (STRAINS, replace(SPEC, speckle=SpeckleSpec(seed=1))),
        (STRAINS, replace(SPEC, bits=12)),
        (STRAINS[1:], SPEC),
    ],
)
def test_another_set_replaces_it_without_leftovers(
    made: ImageSet, strains: tuple[float, ...], spec: ImagingSpec
) -> None:
    (made.folder / "notes.txt").write_text("the user's own")
    again = make_images(plate(), spec, made.folder, strains)
    listed = {*again.info["files"], "images.json", "notes.txt"}
    assert {p.name for p in made.folder.iterdir()} == listed
    assert is_complete(made.folder, image_key(plate(), spec, strains))
    assert not is_complete(made.folder, image_key(plate(), SPEC, STRAINS))


def test_key_depends_on_the_displacement() -> None:
    one, other = plate(), plate()
    other.snapshots[1].displacement[3, 1] += 1e-15
    assert image_key(one, SPEC, STRAINS) != image_key(other, SPEC, STRAINS)
    assert image_key(one, SPEC, STRAINS[:1]) == image_key(other, SPEC, STRAINS[:1])


def test_key_depends_on_the_sensor_and_on_the_code_that_makes_pixels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    keys = {image_key(plate(), SPEC, STRAINS)}
    keys.add(image_key(plate(), replace(SPEC, sensor=Sensor(read_noise=0.01)), STRAINS))
    monkeypatch.setattr(set_key, "source_digest", lambda *folders: "of other code")
    keys.add(image_key(plate(), SPEC, STRAINS))
    assert len(keys) == 3


def test_a_sidecar_without_a_sensor_reads_as_the_default_one(made: ImageSet) -> None:
    path = made.folder / "images.json"
    content = json.loads(path.read_text())
    del content["spec"]["sensor"]
    path.write_text(json.dumps(content))
    assert ImageSet.read(made.folder).spec == SPEC


NOISY = replace(SPEC, bits=12, sensor=Sensor(gain=0.9, offset=0.02, full_well=1e4, read_noise=0.01))


def test_a_sensor_is_recorded_and_its_noise_is_the_predicted_one(tmp_path: Path) -> None:
    made = make_images(plate(), NOISY, tmp_path / "noisy", STRAINS)
    assert ImageSet.read(made.folder).spec == NOISY
    clean = make_images(plate(), SPEC, tmp_path / "clean", STRAINS)
    for strain in (None, *STRAINS):
        if strain is None:
            pair, mask = [made.reference(camera=c) for c in (False, True)], made.mask()
            irradiance, entry = clean.reference(), made.info["reference"]
        else:
            pair = [made.deformed(strain, camera=c) for c in (False, True)]
            mask, irradiance = made.deformed_mask(strain), clean.deformed(strain)
            entry = made.info["snapshots"][STRAINS.index(strain)]
        np.testing.assert_allclose(pair[0], 0.9 * irradiance + 0.02, atol=1e-7)
        sd = made.noise_sd(strain)
        error = ((pair[1] - pair[0]) / sd)[mask]
        assert abs(error.mean()) < 4 / np.sqrt(error.size)
        assert abs(error.var() - 1) < 4 * np.sqrt(2 / error.size)
        assert entry["noise_sd"] == pytest.approx(float(np.sqrt((sd[mask] ** 2).mean())))
        assert entry["saturated_px"] == 0
        law = made.info["noise"]
        predicted = np.sqrt(law["constant"] + law["slope"] * (pair[0] - law["offset"]))
        np.testing.assert_allclose(predicted[mask], sd[mask], rtol=1e-5)


def test_noise_is_an_image_s_own_and_does_not_depend_on_the_others(tmp_path: Path) -> None:
    both = make_images(plate(), NOISY, tmp_path / "both", STRAINS)
    alone = make_images(plate(), NOISY, tmp_path / "alone", STRAINS[1:])
    name = "deformed_1280_12bit.tif"
    assert both.info["files"][name] == alone.info["files"][name]
    noise = [both.reference(camera=True) - both.reference()]
    noise += [both.deformed(s, camera=True) - both.deformed(s) for s in STRAINS]
    mask = both.mask() & both.deformed_mask(STRAINS[0]) & both.deformed_mask(STRAINS[1])
    correlation = np.corrcoef([n[mask] for n in noise]) - np.eye(3)
    assert np.abs(correlation).max() < 4 / np.sqrt(mask.sum())


def test_averaging_pixels_tell_how_they_were_averaged(tmp_path: Path) -> None:
    spec = replace(SPEC, sensor=Sensor(fill_factor=1.0))
    made = make_images(plate(), spec, tmp_path / "areas", STRAINS[:1])
    plain = make_images(plate(), SPEC, tmp_path / "points", STRAINS[:1])
    assert made.info["reference"]["quadrature"]["points"] == 0
    deformed = made.info["snapshots"][0]["quadrature"]
    assert deformed["points"] == 9
    assert deformed["rms_bound"] <= 1e-7
    assert "quadrature" not in plain.info["reference"]
    # An average over an area loses contrast: sinc(f) at the pattern's 0.05 cycles/px and more.
    inside = np.s_[10:-10, 10:-10]
    loss = made.reference()[inside].std() / plain.reference()[inside].std()
    assert 0.95 < loss < 1.0
    np.testing.assert_array_equal(made.mask(), plain.mask())


def test_a_specimen_that_overlaps_gives_a_warning(made: ImageSet, tmp_path: Path) -> None:
    assert made.info["warnings"] == []
    solution = plate()
    apart = Mesh(solution.mesh.nodes[[0, 1, 4, 3, 1, 2, 5, 4]], np.arange(8).reshape(2, 4), "Q4")
    slid = np.repeat([[0.2, 0.0], [0.0, 0.0]], 4, axis=0)  # the left half by 4 px to the right
    moved = Solution(apart, (Snapshot(0.1, slid),), {})
    overlapping = make_images(moved, SPEC, tmp_path / "overlap", (0.1,))
    # Strictly inside both: 3 columns; of 21 rows, 2 lie on the boundary.
    assert overlapping.info["snapshots"][0]["doubly_covered_px"] == 3 * 19
    assert overlapping.info["reference"]["doubly_covered_px"] == 0
    (warning,) = overlapping.info["warnings"]
    assert warning.startswith("deformed_1000.tif: 57 px lie inside more than one element")


@pytest.mark.parametrize("at", [0, 1, 2])
def test_interrupted_set_is_not_taken_for_finished(tmp_path: Path, at: int) -> None:
    def interrupt(done: float, total: float, what: str) -> None:
        if done >= at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_images(plate(), SPEC, tmp_path, STRAINS, interrupt)
    assert not is_complete(tmp_path, image_key(plate(), SPEC, STRAINS))
    with pytest.raises(InputError, match="expected a finished image set"):
        ImageSet.read(tmp_path)
    assert make_images(plate(), SPEC, tmp_path, STRAINS).strains == STRAINS


def test_interrupted_replacement_does_not_pass_for_the_old_set(made: ImageSet) -> None:
    def interrupt(done: float, total: float, what: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_images(plate(), replace(SPEC, bits=12), made.folder, STRAINS, interrupt)
    assert not is_complete(made.folder, image_key(plate(), SPEC, STRAINS))


@pytest.mark.parametrize("name", ["truth_1280.h5", "reference.tif", "mask.tif"])
def test_damage_is_noticed_and_repaired(made: ImageSet, name: str) -> None:
    key = image_key(plate(), SPEC, STRAINS)
    path = made.folder / name
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    assert not is_complete(made.folder, key)
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert not is_complete(made.folder, key)
    path.unlink()
    assert not is_complete(made.folder, key)
    make_images(plate(), SPEC, made.folder, STRAINS)
    assert path.read_bytes() == whole


def test_an_image_that_is_not_what_was_written_is_not_read(made: ImageSet) -> None:
    """Every value of the other set is a sound image: only its digest tells."""
    readers = {
        "reference.tif": made.reference,
        "mask.tif": made.mask,
        "deformed_0780_8bit.tif": lambda: made.deformed(0.078, camera=True),
        "deformed_1280_mask.tif": lambda: made.deformed_mask(0.128),
        "truth_0780.h5": lambda: made.truth(0.078).displacement,
    }
    others = {"truth_0780.h5": "truth_1280.h5", "deformed_0780_8bit.tif": "reference_8bit.tif"}
    for name, read in readers.items():
        read()
        path = made.folder / name
        if name in others:
            path.write_bytes((made.folder / others[name]).read_bytes())
        else:
            pixels = tifffile.imread(path)
            tifffile.imwrite(path, np.roll(pixels, 1, axis=0), photometric="minisblack")
        with pytest.raises(InputError, match=f"{name} as images.json has its SHA-256") as error:
            read()
        assert "\n" not in str(error.value)


def test_pairs_come_one_after_the_other(tmp_path: Path) -> None:
    made = make_images(plate(), SPEC, tmp_path / "set")  # of all snapshots
    exposed = made.pair(STRAINS[0], camera=True)
    np.testing.assert_array_equal(exposed.reference, made.reference(camera=True))
    for strain, pair in zip(STRAINS, made, strict=True):
        assert pair.strain == strain
        assert pair.grid == made.grid
        assert pair.truth is not None
        np.testing.assert_array_equal(pair.deformed, made.deformed(strain))
        np.testing.assert_array_equal(pair.deformed_mask, made.deformed_mask(strain))
        (made.folder / f"truth_{round(1e4 * strain):04d}.h5").unlink()
        with pytest.raises(InputError, match="truth"):  # it is read when asked for
            _ = pair.truth.displacement


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.99])
def test_truth_cut_short(made: ImageSet, kept: float) -> None:
    path = made.folder / "truth_0780.h5"
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InputError, match="expected a truth file") as error:
        _ = Truth.read(path).displacement
    assert "\n" not in str(error.value)


def test_sidecar_cut_short(made: ImageSet) -> None:
    path = made.folder / "images.json"
    path.write_text(path.read_text()[:100])
    with pytest.raises(InputError, match="expected a JSON file"):
        ImageSet.read(made.folder)
    path.write_text(json.dumps({"format": "something else"}))
    with pytest.raises(InputError, match="modeharvest-images-1"):
        ImageSet.read(made.folder)


def test_asks_for_what_is_there(made: ImageSet) -> None:
    with pytest.raises(InputError, match=r"have: 0\.0780, 0\.1280"):
        made.deformed(0.1)
    with pytest.raises(InputError, match=r"expected a snapshot at strain 0\.2"):
        make_images(plate(), SPEC, made.folder, (0.2,))
    for clash in ((), (0.078, 0.078)):
        with pytest.raises(InputError, match=r"differ by 0\.01 %"):
            make_images(plate(), SPEC, made.folder, clash)
    assert is_complete(made.folder, image_key(plate(), SPEC, STRAINS))


def test_grid_is_centred_and_holds_every_state_with_its_margin() -> None:
    solution = plate()
    grid = choose_grid(solution, STRAINS, SPEC)
    assert grid.x[0] + grid.x[-1] == pytest.approx(2 * 4.0, abs=1e-12)
    assert grid.y[0] + grid.y[-1] == pytest.approx(2 * -0.5, abs=1e-12)
    # Half width 1 mm at rest, half height 0.5 (1 + 0.3 * 0.128) mm at the end: 20 and 10.4 px.
    assert grid.shape == (2 * (11 + 5) + 1, 2 * (20 + 5) + 1)


def test_prescribed_shape_must_hold_the_specimen() -> None:
    assert choose_grid(plate(), STRAINS, replace(SPEC, shape=(60, 50))).shape == (60, 50)
    with pytest.raises(InputError, match=r"at least 23 x 41 px .* got 60 x 40"):
        choose_grid(plate(), STRAINS, replace(SPEC, shape=(60, 40)))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"pixel_size": 0.0}, "pixel size"),
        ({"pixel_size": float("inf")}, "pixel size"),
        ({"margin_px": -1}, "margin"),
        ({"background": 1.5}, "background"),
        ({"bits": 17}, "bits"),
    ],
)
def test_refuses_impossible_imaging(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ImagingSpec(**bad)
