"""Guards images and masks in and out: scales, refusals in one line, nothing half-written."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skimage.io
import tifffile
from numpy.typing import NDArray

from modeharvest.imaging.photographs.files import (
    read_image,
    read_mask,
    require_same_shape,
    write_image,
)
from modeharvest.imaging.sensor import quantise
from modeharvest.util.errors import InputError

RAMP = np.linspace(0.0, 1.0, 30 * 20, dtype=np.float32).reshape(30, 20)


def refusal(error: pytest.ExceptionInfo[InputError]) -> str:
    """Return the message, after checking that it is one line that expects something."""
    message = str(error.value)
    assert "\n" not in message
    assert message.startswith("expected")
    return message


def test_float_images_come_back_bit_for_bit(tmp_path: Path) -> None:
    write_image(tmp_path / "a.tif", RAMP)
    back = read_image(tmp_path / "a.tif")
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, RAMP)


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_quantisation_rounds_to_the_nearest_of_the_levels(bits: int, dtype: Any) -> None:
    levels = quantise(RAMP, bits)
    assert levels.dtype == dtype
    assert (levels.min(), levels.max()) == (0, 2**bits - 1)
    # Half a level, and what float32 adds to the product.
    assert np.abs(levels / (2**bits - 1) - RAMP).max() <= 0.5 / (2**bits - 1) + 1e-7


def test_quantisation_clips_and_knows_its_bits() -> None:
    np.testing.assert_array_equal(quantise(np.array([[-1.0, 0.5, 7.0]]), 8), [[0, 128, 255]])
    with pytest.raises(InputError, match="expected 1 to 16 bits, got 0"):
        quantise(RAMP, 0)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("suffix", [".tif", ".tiff", ".png"])
def test_whole_numbers_are_read_as_fractions_of_full_scale(
    tmp_path: Path, bits: int, suffix: str
) -> None:
    levels, path = quantise(RAMP, bits), tmp_path / f"a{suffix}"
    if suffix == ".png":
        skimage.io.imsave(path, levels, check_contrast=False)
    else:
        write_image(path, levels)
    np.testing.assert_allclose(read_image(path), levels / (2**bits - 1), rtol=1e-7)


def test_jpeg_is_read_within_its_loss(tmp_path: Path) -> None:
    skimage.io.imsave(tmp_path / "a.jpg", quantise(RAMP, 8), check_contrast=False)
    assert np.abs(read_image(tmp_path / "a.jpg") - RAMP).max() < 3 / 255


@pytest.mark.parametrize("channels", [3, 4])
def test_colour_becomes_luma(tmp_path: Path, channels: int) -> None:
    colour = np.zeros((30, 20, channels), dtype=np.uint8)
    colour[:10, :, 0] = colour[10:20, :, 1] = colour[20:, :, 2] = 255  # red, green, blue bands
    skimage.io.imsave(tmp_path / "a.png", colour, check_contrast=False)
    weights = read_image(tmp_path / "a.png")[[5, 15, 25], 3]
    np.testing.assert_allclose(weights, [0.2125, 0.7154, 0.0721], atol=1e-6)  # ITU-R BT.709


def test_mask_comes_back(tmp_path: Path) -> None:
    mask = RAMP > 0.3
    write_image(tmp_path / "m.tif", mask)
    assert set(np.unique(tifffile.imread(tmp_path / "m.tif"))) == {0, 255}
    np.testing.assert_array_equal(read_mask(tmp_path / "m.tif"), mask)


def test_full_mask_is_fine_and_black_mask_is_not(tmp_path: Path) -> None:
    write_image(tmp_path / "white.tif", np.ones((4, 5), dtype=np.bool_))
    write_image(tmp_path / "black.tif", np.zeros((4, 5), dtype=np.bool_))
    assert read_mask(tmp_path / "white.tif").all()
    with pytest.raises(InputError, match="black everywhere") as error:
        read_mask(tmp_path / "black.tif")
    assert "black.tif" in refusal(error)


def test_soft_edges_of_a_mask_count_from_half_on_and_labels_all(tmp_path: Path) -> None:
    soft = np.round(255.0 * np.clip(4.0 * RAMP - 0.8, 0.0, 1.0)).astype(np.uint8)
    write_image(tmp_path / "soft.tif", soft)
    np.testing.assert_array_equal(read_mask(tmp_path / "soft.tif"), soft > 127.5)
    for edges in ([0.3, 0.4], [0.3, 0.5, 0.9], np.linspace(0.3, 0.9, 60)):
        labels = np.digitize(RAMP, edges).astype(np.uint8)
        write_image(tmp_path / "labels.tif", labels)
        np.testing.assert_array_equal(read_mask(tmp_path / "labels.tif"), labels > 0)
    write_image(tmp_path / "grey.tif", np.where(RAMP > 0.3, 220, 40).astype(np.uint8))
    with pytest.raises(InputError, match="no black at all, levels from 40 to 220") as error:
        read_mask(tmp_path / "grey.tif")
    refusal(error)


@pytest.mark.parametrize("read", [read_image, read_mask])
@pytest.mark.parametrize("name", ["a.tif", "a.png"])
def test_missing_file(tmp_path: Path, read: Any, name: str) -> None:
    with pytest.raises(InputError, match="no such file") as error:
        read(tmp_path / name)
    refusal(error)


@pytest.mark.parametrize("read", [read_image, read_mask])
@pytest.mark.parametrize("suffix", [".tif", ".png", ".jpg"])
@pytest.mark.parametrize("kept", [0.0, 0.01, 0.3, 0.9])
def test_file_cut_short(tmp_path: Path, read: Any, suffix: str, kept: float) -> None:
    path = tmp_path / f"cut{suffix}"
    noise = np.random.default_rng(0).integers(0, 256, (64, 64), dtype=np.uint8)
    skimage.io.imsave(path, noise, check_contrast=False)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InputError, match="cut short") as error:
        read(path)
    refusal(error)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_not_finite(tmp_path: Path, value: float) -> None:
    image = RAMP.copy()
    image[3, 4] = value
    write_image(tmp_path / "a.tif", image)
    with pytest.raises(InputError, match="got 1 NaN or infinite px") as error:
        read_image(tmp_path / "a.tif")
    refusal(error)


def test_constant_image(tmp_path: Path) -> None:
    write_image(tmp_path / "a.tif", np.full((5, 5), 51, dtype=np.uint8))
    with pytest.raises(InputError, match=r"got the constant grey level 0\.2") as error:
        read_image(tmp_path / "a.tif")
    refusal(error)


@pytest.mark.parametrize("shape", [(7, 30, 20), (2, 7, 30, 20)])
def test_not_one_plane_image(tmp_path: Path, shape: tuple[int, ...]) -> None:
    stack = np.random.default_rng(0).random(shape, dtype=np.float32)
    tifffile.imwrite(tmp_path / "a.tif", stack, photometric="minisblack")
    with pytest.raises(InputError, match=r"one plane image .* got an array of shape") as error:
        read_image(tmp_path / "a.tif")
    refusal(error)


def test_signed_integers_have_no_full_scale(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.arange(20, dtype=np.int16).reshape(4, 5))
    with pytest.raises(InputError, match="got int16") as error:
        read_image(tmp_path / "a.tif")
    refusal(error)


def test_sizes_must_match() -> None:
    require_same_shape(RAMP, RAMP > 0.5, "f.tif", "mask.tif")
    with pytest.raises(InputError, match=r"f\.tif with 30 x 20 .* mask\.tif with 29 x 20") as error:
        require_same_shape(RAMP, RAMP[1:], "f.tif", "mask.tif")
    refusal(error)


@pytest.mark.parametrize(
    ("name", "image"), [("a.png", RAMP), ("a.tif", RAMP[0]), ("a.tif", RAMP.astype(np.complex128))]
)
def test_refuses_to_write_what_it_could_not_read(
    tmp_path: Path, name: str, image: NDArray[Any]
) -> None:
    with pytest.raises(InputError) as error:
        write_image(tmp_path / name, image)
    refusal(error)
    assert not list(tmp_path.iterdir())


def test_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_image(tmp_path / "a.tif", RAMP)

    def full_disk(path: Path, content: bytes) -> None:
        path.write_text("II*")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(InputError, match="No space left on device"):
        write_image(tmp_path / "a.tif", RAMP[::-1])
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"]
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), RAMP)
