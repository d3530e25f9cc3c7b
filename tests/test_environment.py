"""Environment images: OpenEXR and Radiance files, sound and broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from psf_cl.errors import InputError
from psf_cl.scene.environment import load_environment
from psf_cl.scene.load import load_scene

SKY = np.random.default_rng(5).uniform(0, 9, (4, 16, 3)).astype(np.float32)


def write_exr(path: Path, channels: dict) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    return path


def write_hdr(path: Path, body: bytes, width: int, height: int) -> Path:
    text = f"#?RADIANCE\n# by a test\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    path.write_bytes(text.encode() + body)
    return path


def rgbe(color: tuple[float, float, float]) -> bytes:
    """Return the shared-exponent code of a colour, by frexp."""
    exponent = int(np.frexp(max(color))[1])
    return bytes([int(value * 2.0 ** (8 - exponent)) for value in color] + [exponent + 128])


def row_in_runs(texels: bytes) -> bytes:
    """Return a row in the run-length code: each channel as one run, or as literals."""
    width = len(texels) // 4
    code = bytes([2, 2, width >> 8, width & 255])
    for channel in range(4):
        values = texels[channel::4]
        one_run = len(set(values)) == 1
        code += bytes([128 + width, values[0]]) if one_run else bytes([width]) + values
    return code


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_an_exr_comes_through_row_by_row(tmp_path, dtype):
    pixels = SKY.astype(dtype)
    image, notes = load_environment(write_exr(tmp_path / "a.exr", {"RGB": pixels}))
    assert image.dtype == np.float32
    assert np.array_equal(image, pixels.astype(np.float32))
    assert notes == ()


def test_an_exr_of_one_channel_is_grey(tmp_path):
    image, _ = load_environment(write_exr(tmp_path / "a.exr", {"Y": SKY[..., 0].copy()}))
    assert np.array_equal(image, np.repeat(SKY[..., :1], 3, axis=-1))


def test_an_exr_with_alpha_and_more_channels_gives_its_colour(tmp_path):
    alpha = np.ones(SKY.shape[:2], np.float32)
    channels = {"RGBA": np.dstack([SKY, alpha]), "Z": alpha}
    image, _ = load_environment(write_exr(tmp_path / "a.EXR", channels))
    assert np.array_equal(image, SKY)


def test_texels_that_are_no_radiance_are_mended_and_noted(tmp_path):
    pixels = SKY.copy()
    pixels[0, 0] = [-1, 2, 3]
    pixels[1, 2] = [1, np.nan, 3]
    pixels[2, 3] = [np.inf, 1, -np.inf]
    image, notes = load_environment(write_exr(tmp_path / "a.exr", {"RGB": pixels}))
    largest = pixels[np.isfinite(pixels)].max()
    assert image[0, 0].tolist() == [0, 2, 3]
    assert image[1, 2].tolist() == [1, 0, 3]
    assert image[2, 3].tolist() == [largest, 1, 0]
    assert "3 negative or NaN texels" in notes[0]
    assert "1 infinite texels" in notes[1]
    changed = np.array([[0, 0], [1, 2], [2, 3]])
    assert (image != pixels).any(axis=-1).nonzero()[0].tolist() == changed[:, 0].tolist()


def test_a_radiance_texel_is_its_mantissa_times_the_shared_power_of_two(tmp_path):
    # 2^(129 - 136) = 1/128, 2^(144 - 136) = 256, and an exponent of 0 is black.
    body = bytes([128, 64, 32, 129, 1, 0, 255, 144, 9, 9, 9, 0])
    image, _ = load_environment(write_hdr(tmp_path / "a.hdr", body, 3, 1))
    assert image.tolist() == [[[1, 0.5, 0.25], [256, 0, 65280], [0, 0, 0]]]


def test_flat_and_run_length_rows_say_the_same(tmp_path):
    rows = [b"".join(rgbe(tuple(texel)) for texel in row) for row in SKY]
    rows[2] = rgbe((3.0, 1.0, 0.25)) * SKY.shape[1]
    flat, _ = load_environment(write_hdr(tmp_path / "a.hdr", b"".join(rows), 16, 4))
    runs = b"".join(row_in_runs(row) for row in rows)
    packed, _ = load_environment(write_hdr(tmp_path / "b.hdr", runs, 16, 4))
    assert np.array_equal(flat, packed)
    # A mantissa has 8 bits, the largest of a texel at least 7 of them.
    largest = SKY.max(axis=-1, keepdims=True)
    assert (np.abs(flat - SKY) <= largest / 128)[[0, 1, 3]].all()
    assert (flat[2] == [3.0, 1.0, 0.25]).all()


def test_the_oldest_repeat_code_counts_in_digits_of_256(tmp_path):
    first, second = rgbe((1, 2, 3)), rgbe((4, 4, 4))
    # first, repeated 2 + 256 * 1 times more; then second.
    body = first + bytes([1, 1, 1, 2]) + bytes([1, 1, 1, 1]) + second
    image, _ = load_environment(write_hdr(tmp_path / "a.hdr", body, 260, 1))
    assert (image[0, :259] == [1, 2, 3]).all()
    assert (image[0, 259] == 4).all()


def test_exposure_is_divided_out_and_sign_flips_the_rows(tmp_path):
    body = rgbe((1, 1, 1)) + rgbe((2, 2, 2))
    text = b"#?RGBE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\nEXPOSURE= 2.0\n\n+Y 2 +X 1\n"
    (tmp_path / "a.hdr").write_bytes(text + body)
    image, _ = load_environment(tmp_path / "a.hdr")
    assert image[:, 0, 0].tolist() == [0.5, 0.25]


GOOD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 8\n"


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("a.png", b"", "expected an environment image, .exr or .hdr"),
        ("a.exr", b"", "expected an OpenEXR image"),
        ("a.exr", b"\x76\x2f\x31\x01", "damaged or truncated OpenEXR"),
        ("a.hdr", b"", "no #? header"),
        ("a.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\nabcd", "expected FORMAT"),
        ("a.hdr", b"#?RADIANCE\nEXPOSURE=0\n\n-Y 1 +X 1\nabcd", "EXPOSURE"),
        ("a.hdr", b"#?RADIANCE\nEXPOSURE=x\n\n-Y 1 +X 1\nabcd", "EXPOSURE"),
        ("a.hdr", b"#?RADIANCE\n\n+X 1 -Y 1\nabcd", "expected a size"),
        ("a.hdr", b"#?RADIANCE\n\n-Y 0 +X 1\nabcd", "size 1x0"),
        ("a.hdr", b"#?RADIANCE\n\n-Y 999999999 +X 999999999\nabcd", "size 999999999x999999999"),
        ("a.hdr", GOOD, "cut short"),
        ("a.hdr", GOOD + bytes(16 * 4 - 1), "cut short"),
        ("a.hdr", GOOD + bytes([2, 2, 0, 8]) + bytes([136, 7]) * 3, "broken or cut short"),
        ("a.hdr", GOOD + bytes([2, 2, 0, 8]) + bytes([137, 7]) * 4, "leaves its row"),
        ("a.hdr", GOOD + bytes([2, 2, 0, 8, 0]), "broken or cut short"),
    ],
)
def test_a_broken_image_gets_one_line_that_names_it(tmp_path, name, data, expected):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError) as caught:
        load_environment(tmp_path / name)
    message = str(caught.value)
    assert expected in message
    assert message.startswith(str(tmp_path / name))
    assert "\n" not in message


def test_a_damaged_exr_loads_or_is_refused(tmp_path):
    whole = write_exr(tmp_path / "a.exr", {"RGB": SKY}).read_bytes()
    start = whole.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    # A data window of 2^31 columns: refused before anything is allocated.
    huge = whole[: start + 8] + b"\xff\xff\xff\x7f" + whole[start + 12 :]
    for data in (whole[: len(whole) // 2], whole[:-9], huge):
        (tmp_path / "b.exr").write_bytes(data)
        with pytest.raises(InputError, match=r"b\.exr"):
            load_environment(tmp_path / "b.exr")


def test_depth_alone_is_no_environment(tmp_path):
    path = write_exr(tmp_path / "a.exr", {"Z": SKY[..., 0].copy()})
    with pytest.raises(InputError, match="expected channels R, G, B or Y; there are: Z"):
        load_environment(path)


def test_an_environment_asked_for_replaces_the_scenes(tmp_path):
    sky = write_exr(tmp_path / "sky.exr", {"RGB": SKY})
    text = '[environment]\nradiance = [9, 9, 9]\n[[shapes]]\nprimitive = "quad"\n'
    (tmp_path / "a.toml").write_text(text)
    scene = load_scene(tmp_path / "a.toml", environment=sky)
    assert scene.environment.radiance == (1, 1, 1)
    assert np.array_equal(scene.environment.image, SKY)


def test_a_scenes_image_is_scaled_and_turned(tmp_path):
    write_exr(tmp_path / "sky.exr", {"RGB": SKY})
    text = '[environment]\nimage = "sky.exr"\nscale = 2.5\nrotation = [0, 180, 0]\n'
    (tmp_path / "a.toml").write_text(text + '[[shapes]]\nprimitive = "quad"\n')
    environment = load_scene(tmp_path / "a.toml").environment
    assert environment.radiance == (2.5, 2.5, 2.5)
    assert np.allclose(environment.rotation, np.diag([-1, 1, -1]))


def test_a_black_image_is_no_light(tmp_path):
    write_exr(tmp_path / "sky.exr", {"RGB": 0 * SKY})
    text = '[environment]\nimage = "sky.exr"\n[[shapes]]\nprimitive = "quad"\n'
    (tmp_path / "a.toml").write_text(text)
    scene = load_scene(tmp_path / "a.toml")
    assert scene.environment.image.min() > 0.0
    assert any("no light" in note for note in scene.notes)
