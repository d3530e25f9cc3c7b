"""Images are decoded to the pixels that were put in, and broken ones are refused in one line."""

from __future__ import annotations

import io
import random
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from psf_cl.errors import InputError
from psf_cl.scene import texture
from psf_cl.scene.texture import decode_pixels, load_texture


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, depth: int, color: int, rows: bytes, extra: bytes = b"") -> bytes:
    """Return a PNG written without Pillow; every row starts with filter byte 0."""
    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + png_chunk(b"IHDR", header)
        + extra
        + png_chunk(b"IDAT", zlib.compress(rows))
        + png_chunk(b"IEND", b"")
    )


RGBA = png(2, 2, 8, 6, bytes([0, 1, 2, 3, 4, 5, 6, 7, 8, 0, 9, 10, 11, 12, 13, 14, 15, 16]))


def test_rgba_keeps_every_byte_and_the_first_row_on_top() -> None:
    expected = np.arange(1, 17, dtype=np.uint8).reshape(2, 2, 4)
    pixels = decode_pixels(RGBA, "image")
    assert pixels.dtype == np.uint8
    np.testing.assert_array_equal(pixels, expected)


def test_rgb_is_opaque() -> None:
    pixels = decode_pixels(png(1, 1, 8, 2, bytes([0, 10, 20, 30])), "image")
    assert pixels.tolist() == [[[10, 20, 30, 255]]]


def test_grey_fills_the_three_colours() -> None:
    pixels = decode_pixels(png(2, 1, 8, 0, bytes([0, 7, 200])), "image")
    assert pixels.tolist() == [[[7, 7, 7, 255], [200, 200, 200, 255]]]


def test_grey_with_alpha_keeps_its_alpha() -> None:
    assert decode_pixels(png(1, 1, 8, 4, bytes([0, 50, 60])), "x").tolist() == [[[50, 50, 50, 60]]]


def test_one_bit_grey_is_black_and_white() -> None:
    pixels = decode_pixels(png(2, 1, 1, 0, bytes([0, 0b01000000])), "image")
    assert pixels[0, :, 0].tolist() == [0, 255]


def test_palette_is_looked_up_with_its_transparency() -> None:
    palette = png_chunk(b"PLTE", bytes([1, 2, 3, 40, 50, 60])) + png_chunk(b"tRNS", bytes([9]))
    pixels = decode_pixels(png(2, 1, 8, 3, bytes([0, 1, 0]), palette), "image")
    assert pixels.tolist() == [[[40, 50, 60, 255], [1, 2, 3, 9]]]


def test_16_bit_grey_is_rounded_not_clipped() -> None:
    values = [0, 128, 129, 257 * 100, 65535]
    rows = b"\0" + struct.pack(">5H", *values)
    pixels = decode_pixels(png(5, 1, 16, 0, rows), "image")
    # 255 / 65535 = 1 / 257.
    assert pixels[0, :, 1].tolist() == [round(value / 257) for value in values]
    assert (pixels[..., 3] == 255).all()


def test_16_bit_colour_is_within_one_step() -> None:
    values = np.array([0, 1000, 30000, 65535])
    pixels = decode_pixels(png(1, 1, 16, 6, b"\0" + struct.pack(">4H", *values)), "image")
    np.testing.assert_allclose(pixels[0, 0], values / 257, atol=1.0)


@pytest.mark.parametrize("kind", ["JPEG", "WEBP", "BMP", "TGA", "TIFF", "PPM"])
def test_other_formats_are_read(kind: str) -> None:
    stream = io.BytesIO()
    Image.new("RGB", (8, 4), (200, 100, 50)).save(stream, kind)
    pixels = decode_pixels(stream.getvalue(), "image")
    assert pixels.shape == (4, 8, 4)
    # Lossy formats may be off by a few steps.
    np.testing.assert_allclose(pixels[2, 3], [200, 100, 50, 255], atol=4)


def test_floats_are_refused() -> None:
    stream = io.BytesIO()
    Image.fromarray(np.ones((2, 2), np.float32)).save(stream, "TIFF")
    with pytest.raises(InputError, match="expected 8 or 16 bits"):
        decode_pixels(stream.getvalue(), "image")


@pytest.mark.parametrize("data", [b"", b"not an image", b"%!PS-Adobe-3.0 EPSF-3.0\n"])
def test_what_is_no_texture_is_refused_in_one_line(data: bytes) -> None:
    with pytest.raises(InputError) as caught:
        decode_pixels(data, "scene.glb: images[3]")
    assert str(caught.value).startswith("scene.glb: images[3]: unreadable texture: expected one of")
    assert "\n" not in str(caught.value)


def test_a_truncated_file_is_refused_as_long_as_pixels_are_missing() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (8, 8, 4), np.uint8)
    stream = io.BytesIO()
    Image.fromarray(noise).save(stream, "PNG")
    data = stream.getvalue()
    # Behind the pixels: an end mark, the checksums of zlib and IDAT, 4 bytes each, IEND with 12.
    for length in range(len(data) - 22):
        with pytest.raises(InputError):
            decode_pixels(data[:length], "image")
    np.testing.assert_array_equal(decode_pixels(data, "image"), noise)


def test_a_huge_image_is_refused_before_it_is_decoded() -> None:
    # 16 GB of pixels in a file of 100 bytes.
    with pytest.raises(InputError, match="unreadable texture"):
        decode_pixels(png(65535, 65535, 8, 6, b"\0"), "image")


def test_the_limit_counts_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texture, "MAX_PIXELS", 4)
    assert decode_pixels(RGBA, "image").shape == (2, 2, 4)
    monkeypatch.setattr(texture, "MAX_PIXELS", 3)
    with pytest.raises(InputError, match="at most 3 pixels, got 2 x 2"):
        decode_pixels(RGBA, "image")


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF"])
def test_damaged_bytes_give_pixels_or_an_input_error(kind: str) -> None:
    stream = io.BytesIO()
    noise = np.random.default_rng(2).integers(0, 256, (6, 5, 3), np.uint8)
    Image.fromarray(noise).save(stream, kind)
    original = stream.getvalue()
    chance = random.Random(3)
    for _ in range(100):
        data = bytearray(original)
        for _ in range(chance.choice([1, 3, 10])):
            data[chance.randrange(len(data))] = chance.randrange(256)
        try:
            pixels = decode_pixels(bytes(data), "image")
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert pixels.dtype == np.uint8 and pixels.shape[2] == 4


def test_a_file_becomes_a_texture_named_like_it(tmp_path: Path) -> None:
    path = tmp_path / "wood.png"
    path.write_bytes(RGBA)
    loaded = load_texture(path, srgb=False)
    assert (loaded.name, loaded.srgb, loaded.wrap) == ("wood.png", False, ("repeat", "repeat"))
    np.testing.assert_array_equal(loaded.pixels, decode_pixels(RGBA, "image"))


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.png: expected a file, got nothing"):
        load_texture(tmp_path / "none.png")
    with pytest.raises(InputError, match="expected a file, got a folder"):
        load_texture(tmp_path)
