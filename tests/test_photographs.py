"""Files from a camera: what is read is what was stored, and what is wrong is reported in one line.

Pictures are written here, by the libraries themselves, so the truth is the array that went in.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

from modeharvest.imaging.photographs.files import LUMA, _upright
from modeharvest.imaging.photographs.photograph import (
    neighbour_correlation,
    read_frame,
    read_photograph,
    read_reference,
    require_alike,
    require_usable,
)
from modeharvest.util.errors import InputError


def speckle(shape: tuple[int, int] = (96, 128), seed: int = 0, size: float = 1.5) -> NDArray[Any]:
    """A pattern between 0.2 and 0.8 of full scale, speckles of about 2 to 3 ``size`` px."""
    field = gaussian_filter(np.random.default_rng(seed).normal(size=shape), size)
    return 0.5 + 0.3 * np.tanh(field / field.std())


def counts(bits: int, **options: Any) -> NDArray[Any]:
    levels = np.rint(speckle(**options) * (2**bits - 1))
    levels[0, 0] = 2**bits - 2  # so that they fill their bits
    return levels.astype(np.uint8 if bits <= 8 else np.uint16)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_grey_levels_stay_counts_and_their_bits_are_found(tmp_path: Path, bits: int) -> None:
    levels = counts(bits)
    tifffile.imwrite(tmp_path / "a.tif", levels)
    photograph = read_photograph(tmp_path / "a.tif")
    np.testing.assert_array_equal(photograph.image, levels)
    assert photograph.image.dtype == np.float32
    assert (photograph.bits, photograph.full_scale) == (bits, 2**bits - 1)
    assert not any("Colour" in note for note in photograph.notes)


@pytest.mark.parametrize("response", [(0.95, 1.0, 0.9), (0.6, 1.0, 0.5)])
def test_a_raw_image_of_a_colour_camera_is_one_line(
    tmp_path: Path, response: tuple[float, float, float]
) -> None:
    """Its pixels of three colours were taken for speckle, which doesn't move."""
    levels = 255 * speckle(size=3.0)
    tifffile.imwrite(tmp_path / "grey.tif", levels.astype(np.uint8))
    red, green, blue = response
    colours = np.tile([[red, green], [green, blue]], (48, 64))
    tifffile.imwrite(tmp_path / "raw.tif", (colours * levels).astype(np.uint8))
    assert read_photograph(tmp_path / "grey.tif").bits == 8
    with pytest.raises(InputError, match=r"raw\.tif, got a colour camera's raw image"):
        read_photograph(tmp_path / "raw.tif")


@pytest.mark.parametrize("kind", ["png", "tif"])
@pytest.mark.parametrize("bits", [8, 16])
def test_lossless_formats_agree(tmp_path: Path, kind: str, bits: int) -> None:
    levels = counts(bits)
    Image.fromarray(levels).save(tmp_path / f"a.{kind}")
    np.testing.assert_array_equal(read_photograph(tmp_path / f"a.{kind}").image, levels)


@pytest.mark.parametrize("codec", ["tiff_lzw", "tiff_adobe_deflate", "packbits"])
@pytest.mark.parametrize("bits", [8, 16])
def test_compressed_tiff(tmp_path: Path, codec: str, bits: int) -> None:
    levels = counts(bits)
    Image.fromarray(levels).save(tmp_path / "a.tif", compression=codec)
    np.testing.assert_array_equal(read_photograph(tmp_path / "a.tif").image, levels)


def test_jpeg_loses_little(tmp_path: Path) -> None:
    levels = counts(8)
    Image.fromarray(levels).save(tmp_path / "a.jpg", quality=98)
    off = read_photograph(tmp_path / "a.jpg").image - levels
    assert off.std() < 2.0  # quality 98 quantises its coefficients in steps of 1 to 4 levels


def test_float_images_keep_their_levels(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", speckle().astype(np.float32))
    photograph = read_photograph(tmp_path / "a.tif")
    np.testing.assert_array_equal(photograph.image, speckle().astype(np.float32))
    assert (photograph.bits, photograph.full_scale) == (0, 1.0)


@pytest.mark.parametrize("bits", [8, 16])
def test_colour_becomes_grey_and_that_is_noted(tmp_path: Path, bits: int) -> None:
    colour = np.stack([counts(bits, seed=k) for k in range(3)], axis=-1)
    tifffile.imwrite(tmp_path / "a.tif", colour, photometric="rgb")
    photograph = read_photograph(tmp_path / "a.tif")
    np.testing.assert_allclose(photograph.image, colour @ np.array(LUMA), rtol=1e-6)
    assert "Colour was turned to grey" in photograph.notes[0]


def test_planes_one_after_the_other_are_the_same_colour_image(tmp_path: Path) -> None:
    colour = np.stack([counts(8, seed=k) for k in range(3)], axis=-1)
    tifffile.imwrite(tmp_path / "a.tif", colour, photometric="rgb")
    tifffile.imwrite(
        tmp_path / "b.tif", np.moveaxis(colour, -1, 0), photometric="rgb", planarconfig="separate"
    )
    one, other = (read_photograph(tmp_path / n) for n in ("a.tif", "b.tif"))
    np.testing.assert_array_equal(one.image, other.image)


def test_grey_stored_as_colour_with_alpha_is_grey(tmp_path: Path) -> None:
    levels = counts(8)
    alpha = np.full_like(levels, 255)
    Image.fromarray(np.stack([levels] * 3 + [alpha], axis=-1)).save(tmp_path / "a.png")
    photograph = read_photograph(tmp_path / "a.png")
    np.testing.assert_array_equal(photograph.image, levels)
    assert not any("Colour" in note for note in photograph.notes)


def test_inks_are_turned_to_grey(tmp_path: Path) -> None:
    """In a TIFF cyan, magenta and yellow were read as red, green and blue: a constant grey."""
    grey = np.random.default_rng(0).integers(10, 240, (60, 60), dtype=np.uint8)
    Image.fromarray(grey).convert("CMYK").save(tmp_path / "inks.tif")
    np.testing.assert_allclose(read_photograph(tmp_path / "inks.tif").image, grey, atol=0.6)


def test_white_stored_as_zero_is_inverted(tmp_path: Path) -> None:
    levels = counts(8)
    tifffile.imwrite(tmp_path / "a.tif", 255 - levels, photometric="miniswhite")
    photograph = read_photograph(tmp_path / "a.tif")
    np.testing.assert_array_equal(photograph.image, levels)
    assert photograph.notes == ("It stores white as 0 and was inverted.",)


def test_first_page_of_several_is_taken_and_that_is_noted(tmp_path: Path) -> None:
    pages = np.stack([counts(8, seed=k) for k in range(3)])
    tifffile.imwrite(tmp_path / "a.tif", pages, photometric="minisblack")
    photograph = read_photograph(tmp_path / "a.tif")
    np.testing.assert_array_equal(photograph.image, pages[0])
    assert photograph.notes == ("Of its 3 pages the first was taken.",)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_obeyed_as_pillow_does(tmp_path: Path, orientation: int) -> None:
    picture = Image.fromarray(counts(8))
    exif = Image.Exif()
    exif[274] = orientation
    picture.save(tmp_path / "a.png", exif=exif)
    expected = read_photograph(tmp_path / "a.png")
    turned, notes = _upright(counts(8), orientation)
    np.testing.assert_array_equal(turned, expected.image)
    assert notes == expected.notes


def test_saturation_is_counted_where_the_camera_cuts_off(tmp_path: Path) -> None:
    levels = counts(12)
    ceiling = np.quantile(levels, 0.9).astype(np.uint16)  # below full scale, as many cameras do
    cut = np.minimum(levels, ceiling)
    tifffile.imwrite(tmp_path / "a.tif", cut)
    share = read_photograph(tmp_path / "a.tif").saturated.mean()
    assert share == pytest.approx((levels >= ceiling).mean(), abs=1e-12)


@given(bits=st.sampled_from([8, 12]), seed=st.integers(0, 10))
@settings(max_examples=6, deadline=None, derandomize=True)
def test_speckle_is_distinguished_from_noise(bits: int, seed: int) -> None:
    noise = np.random.default_rng(seed).normal(size=(128, 128)).astype(np.float32)
    ramp = np.linspace(0, 30, 128, dtype=np.float32)  # uneven lighting is no speckle
    assert abs(neighbour_correlation(noise + ramp)) < 0.05  # 128 px squared: sd 0.008
    fine = speckle(seed=seed, size=1.0).astype(np.float32)
    assert neighbour_correlation(fine) > 0.5  # a Gaussian of 1 px: exp(-1/4) = 0.78


def test_a_blank_frame_is_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(20, 2, size=(96, 128))
    tifffile.imwrite(tmp_path / "cap.tif", np.rint(noise).astype(np.uint8))
    with pytest.raises(InputError, match=r"blank image.*correlation 0\.0"):
        require_usable(read_photograph(tmp_path / "cap.tif"))


def test_saturated_material_is_refused_but_a_white_background_is_not(tmp_path: Path) -> None:
    levels, mask = counts(8), np.zeros((96, 128), dtype=bool)
    mask[:, :40] = True
    levels[~mask] = 255
    tifffile.imwrite(tmp_path / "a.tif", levels)
    photograph = read_photograph(tmp_path / "a.tif")
    assert require_usable(photograph, mask) == ()
    with pytest.raises(InputError, match=r"got 100\.0 % of the material saturated"):
        require_usable(photograph, ~mask)
    assert "68.8 % of the image is saturated" in require_usable(photograph)[0]  # 88 of 128


BAD = [
    ("nowhere.tif", None, "no such file"),
    ("empty.tif", b"", "empty file"),
    ("text.tif", b"not a picture", "damaged file"),
    ("text.png", b"not a picture", "damaged file"),
]


@pytest.mark.parametrize(("name", "content", "words"), BAD)
def test_bad_files_are_one_line_with_their_name(
    tmp_path: Path, name: str, content: bytes | None, words: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        read_photograph(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["tif", "png", "jpg"])
def test_files_cut_short_are_damaged(tmp_path: Path, kind: str) -> None:
    Image.fromarray(counts(8)).save(tmp_path / f"a.{kind}")
    content = (tmp_path / f"a.{kind}").read_bytes()
    (tmp_path / f"a.{kind}").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="damaged file"):
        read_photograph(tmp_path / f"a.{kind}")


def test_deep_colour_that_would_lose_bits_is_refused(tmp_path: Path) -> None:
    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    size = struct.pack(">IIBBBBB", 2, 2, 16, 2, 0, 0, 0)  # 2 x 2 px, 16 bits, red green blue
    rows = zlib.compress(2 * (b"\0" + bytes(range(12))))
    (tmp_path / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    )
    with pytest.raises(InputError, match="got 16-bit colour"):
        read_photograph(tmp_path / "a.png")


def test_constant_and_nan_images_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "flat.tif", np.full((9, 9), 7, dtype=np.uint8))
    with pytest.raises(InputError, match="got the constant grey level 7"):
        read_photograph(tmp_path / "flat.tif")
    holed = speckle().astype(np.float32)
    holed[3, 4] = np.nan
    tifffile.imwrite(tmp_path / "nan.tif", holed)
    with pytest.raises(InputError, match="1 NaN or infinite"):
        read_photograph(tmp_path / "nan.tif")
    tifffile.imwrite(tmp_path / "large.tif", 1e300 * speckle().astype(np.float64))
    with pytest.raises(InputError, match="NaN or infinite"):
        read_photograph(tmp_path / "large.tif")


def test_a_line_of_pixels_has_no_speckle() -> None:
    assert neighbour_correlation(np.arange(40.0, dtype=np.float32)[None] % 7) == 0.0


def test_a_frame_of_another_size_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "r.tif", counts(8))
    tifffile.imwrite(tmp_path / "small.tif", counts(8, shape=(90, 128)))
    reference = read_reference(tmp_path / "r.tif")
    with pytest.raises(InputError, match=r"r\.tif with 96 x 128 and .*small\.tif with 90 x 128"):
        read_frame(tmp_path / "small.tif", reference)


def test_other_bit_depths_are_refused_but_a_darker_frame_is_not(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "r.tif", counts(12))
    tifffile.imwrite(tmp_path / "dark.tif", counts(12) // 2)
    tifffile.imwrite(tmp_path / "8.tif", counts(8))
    tifffile.imwrite(tmp_path / "8in16.tif", counts(8).astype(np.uint16))
    reference = read_reference(tmp_path / "r.tif")
    dark = read_frame(tmp_path / "dark.tif", reference)
    assert (dark.bits, dark.full_scale) == (12, 4095)
    for name in ("8.tif", "8in16.tif"):
        with pytest.raises(InputError, match=r"one bit depth, got 12 bits in 16.*8 bits"):
            require_alike(reference, read_photograph(tmp_path / name))


@pytest.mark.parametrize("size", [1.5, 2.5, 4.0])
def test_compression_that_shows_is_noted(tmp_path: Path, size: float) -> None:
    levels = counts(8, shape=(300, 400), size=size)
    for quality, corner in ((95, 0), (30, 0), (30, 3)):
        Image.fromarray(levels).save(tmp_path / "a.jpg", quality=quality)
        stored = np.asarray(Image.open(tmp_path / "a.jpg"))[corner:, corner:]
        Image.fromarray(stored).save(tmp_path / "a.png")  # saved again, and cropped
        notes = read_photograph(tmp_path / "a.png").warnings
        assert any("blocks of 8 x 8 px" in note for note in notes) == (quality == 30)
