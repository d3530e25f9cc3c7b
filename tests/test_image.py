"""Images: what goes into EXR and PNG files comes out again, whole or not at all."""

import io
import json
import os

import numpy as np
import OpenEXR
import PIL.Image
import pytest

import psf_cl
from psf_cl import files
from psf_cl.errors import InputError
from psf_cl.files import check_writable, write_whole
from psf_cl.image import Image, json_text, output_paths, read_exr, tone_map, write_exr, write_png

COMPONENTS = {
    "rgb": 3,
    "albedo": 3,
    "normal": 3,
    "depth": 1,
    "direct": 3,
    "indirect": 3,
    "variance": 3,
    "samples": 1,
}


def random_image(width=13, height=7, seed=0):
    rng = np.random.default_rng(seed)
    return Image(
        {
            name: rng.lognormal(0.0, 3.0, (height, width, count)).astype(np.float32)
            for name, count in COMPONENTS.items()
        }
    )


def raw_exr(channels, header=None):
    buffer = io.BytesIO()
    with OpenEXR.File(header or {}, channels) as file:
        file.write(buffer)
    return buffer.getvalue()


def file_channels(path):
    """Return the planes as the library alone reads them."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


def test_floats_come_back_bit_for_bit(tmp_path):
    image = random_image()
    image.rgb[0, 0] = (np.nan, np.inf, -1e-40)
    write_exr(tmp_path / "a.exr", image)
    again = read_exr(tmp_path / "a.exr")
    assert again.aovs.keys() == image.aovs.keys()
    for name, pixels in image.aovs.items():
        assert again.aovs[name].dtype == np.float32
        assert again.aovs[name].tobytes() == pixels.tobytes(), name


def test_channels_have_the_documented_names(tmp_path):
    image = random_image()
    write_exr(tmp_path / "a.exr", image)
    planes = file_channels(tmp_path / "a.exr")
    assert set("RGB") | {"normal.X", "normal.Y", "normal.Z", "depth.Z", "samples.Y"} < planes.keys()
    for name in ("albedo", "direct", "indirect", "variance"):
        for index, letter in enumerate("RGB"):
            assert np.array_equal(planes[f"{name}.{letter}"], image.aovs[name][..., index])
    for index, letter in enumerate("RGB"):
        assert np.array_equal(planes[letter], image.rgb[..., index])


def test_half_is_within_half_an_ulp_and_never_overflows(tmp_path):
    image = random_image()
    image.rgb[0, 0] = (1e8, -1e8, np.nan)
    image.rgb[0, 1] = (np.inf, 1.0, 65504.0)
    image.aovs["samples"][:] = 4097.0
    write_exr(tmp_path / "a.exr", image, half=True)
    assert file_channels(tmp_path / "a.exr")["albedo.G"].dtype == np.float16
    again = read_exr(tmp_path / "a.exr")
    assert again.rgb[0, 0, 0] == 65504.0 and again.rgb[0, 0, 1] == -65504.0
    assert np.isnan(again.rgb[0, 0, 2]) and np.isinf(again.rgb[0, 1, 0])
    assert np.array_equal(again.aovs["samples"], image.aovs["samples"])
    assert np.array_equal(again.aovs["depth"], image.aovs["depth"])
    expected = np.minimum(image.aovs["albedo"], 65504.0)
    # 11 significant bits; below 2^-14 halves are 2^-24 apart.
    tolerance = np.maximum(expected * 2.0**-11, 2.0**-25)
    assert np.all(np.abs(again.aovs["albedo"] - expected) <= tolerance)
    assert not np.array_equal(again.aovs["albedo"], image.aovs["albedo"])


def test_a_crop_keeps_its_place(tmp_path):
    full = random_image(20, 10)
    crop = full.cropped(5, 2, 8, 6)
    write_exr(tmp_path / "a.exr", crop)
    with OpenEXR.File(str(tmp_path / "a.exr"), header_only=True) as file:
        header = dict(file.header())
    assert [corner.tolist() for corner in header["dataWindow"]] == [[5, 2], [12, 7]]
    assert [corner.tolist() for corner in header["displayWindow"]] == [[0, 0], [19, 9]]
    again = read_exr(tmp_path / "a.exr")
    assert (again.x, again.y, again.full_width, again.full_height) == (5, 2, 20, 10)
    assert np.array_equal(again.rgb, full.rgb[2:8, 5:13])
    assert full.covers(again) and not again.covers(full)
    assert np.array_equal(again.cropped(6, 3, 2, 2).rgb, full.rgb[3:5, 6:8])
    with pytest.raises(ValueError):
        again.cropped(4, 2, 2, 2)


def test_settings_seed_and_version_are_in_the_header_and_times_are_not(tmp_path):
    image = random_image()
    image.stats = {
        "settings": {"max_depth": 4},
        "seed": 7,
        "spp": np.int64(16),
        "render_seconds": 1.25,
    }
    write_exr(tmp_path / "a.exr", image)
    expected = {
        "version": psf_cl.__version__,
        "settings": {"max_depth": 4},
        "seed": 7,
        "spp": 16,
    }
    assert read_exr(tmp_path / "a.exr").stats == expected
    image.stats["render_seconds"] = 2.5
    write_exr(tmp_path / "b.exr", image)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_integer_grey_and_foreign_channels_are_read(tmp_path):
    values = np.arange(12, dtype=np.uint32).reshape(3, 4)
    (tmp_path / "grey.exr").write_bytes(raw_exr({"Y": values}))
    grey = read_exr(tmp_path / "grey.exr")
    assert np.array_equal(grey.rgb, np.repeat(values[..., None], 3, axis=2))

    half = values.astype(np.float16)
    names = ["R", "G", "B", "A", "Z", "view.layer.B", "view.layer.R", "view.layer.G"]
    planes = {name: half + index for index, name in enumerate(names)}
    (tmp_path / "foreign.exr").write_bytes(raw_exr(planes))
    foreign = read_exr(tmp_path / "foreign.exr")
    assert foreign.aovs.keys() == {"rgb", "A", "Z", "view.layer"}
    assert np.array_equal(foreign.rgb[0, 0], (0.0, 1.0, 2.0))
    assert np.array_equal(foreign.aovs["view.layer"][0, 0], (6.0, 7.0, 5.0))


def broken_files():
    good = raw_exr({name: np.zeros((8, 8), np.float32) for name in "RGB"})
    window = good.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    huge = good[: window + 8] + (0x7FFFFFF0).to_bytes(4, "little") * 2 + good[window + 16 :]
    many = good[: window + 8] + (40000).to_bytes(4, "little") * 2 + good[window + 16 :]
    middle = len(good) // 2
    return {
        "empty": b"",
        "text": b"not an image\n" * 100,
        "header only": good[:60],
        "truncated": good[:-20],
        "noise": good[:middle] + bytes(range(256)) * (middle // 256 + 1),
        "huge window": huge,
        "too many pixels": many,
        "no colour": raw_exr({"depth.Z": np.zeros((8, 8), np.float32)}),
    }


@pytest.mark.parametrize("kind", broken_files())
def test_a_broken_exr_is_one_line_and_nothing_else(tmp_path, capfd, kind):
    path = tmp_path / "bad.exr"
    path.write_bytes(broken_files()[kind])
    with pytest.raises(InputError) as caught:
        read_exr(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["missing.exr", "."])
def test_what_is_no_file_cannot_be_read(tmp_path, name):
    with pytest.raises(InputError, match="expected a file, got"):
        read_exr(tmp_path / name)


def test_flipped_bytes_never_leak_a_library_error(tmp_path, capfd):
    good = bytearray(raw_exr({name: np.ones((8, 8), np.float32) for name in "RGB"}))
    rng = np.random.default_rng(5)
    path, refused = tmp_path / "bad.exr", 0
    for _ in range(200):
        bad = good.copy()
        for position in rng.integers(4, len(good), 3):
            bad[position] = rng.integers(256)
        path.write_bytes(bad)
        try:
            read_exr(path)
        except InputError:
            refused += 1
    assert 100 < refused < 200  # A changed pixel is no damage.
    assert capfd.readouterr() == ("", "")


def test_output_paths_are_an_exr_and_the_png_beside_it(tmp_path):
    exr, png = output_paths(tmp_path / "a.b.exr")
    assert (exr, png) == (tmp_path / "a.b.exr", tmp_path / "a.b.png")
    for name in ("a.png", "a", "/dev/null"):
        with pytest.raises(InputError, match=r"\.exr"):
            output_paths(name)


def test_unwritable_places_are_found_beforehand(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "folder.exr").mkdir()
    for place, reason in (
        ("missing/x.exr", "there is no folder"),
        ("file/x.exr", "Not a directory"),
        ("folder.exr", "not a file"),
        ("x" * 300 + ".exr", "too long"),
    ):
        path = tmp_path / place
        with pytest.raises(InputError, match=f"cannot write: .*{reason}"):
            check_writable(path)
        with pytest.raises(InputError, match="cannot write"):
            write_whole(path, b"data")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder.exr"]


def test_a_check_leaves_nothing_and_keeps_what_is_there(tmp_path):
    path = tmp_path / "x.exr"
    check_writable(path)
    assert not list(tmp_path.iterdir())
    path.write_bytes(b"old")
    check_writable(path)
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("existing", [True, False])
def test_a_write_that_fails_half_way_leaves_the_old_file_or_none(tmp_path, monkeypatch, existing):
    path = tmp_path / "x.exr"
    if existing:
        path.write_bytes(b"old")

    def full_disk(file):
        os.ftruncate(file, os.fstat(file).st_size // 2)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full_disk)
    with pytest.raises(InputError, match="cannot write: No space left on device"):
        write_exr(path, random_image())
    with pytest.raises(InputError, match="cannot write: No space left on device"):
        write_png(path.with_suffix(".png"), random_image())
    assert [p.name for p in tmp_path.iterdir()] == (["x.exr"] if existing else [])
    if existing:
        assert path.read_bytes() == b"old"


def test_a_symbolic_link_is_followed(tmp_path):
    (tmp_path / "link.exr").symlink_to(tmp_path / "real.exr")
    write_whole(tmp_path / "link.exr", b"data")
    assert (tmp_path / "link.exr").is_symlink()
    assert (tmp_path / "real.exr").read_bytes() == b"data"


def test_tone_mapping_keeps_dark_colours_and_encodes_srgb():
    linear = np.array([[[0.0, 0.0031308, 0.18], [0.5, 0.2, 0.1]]])
    # IEC 61966-2-1: 0.18 is 117.7 / 255 and so on.
    assert tone_map(linear).tolist() == [[[0, 10, 118], [188, 124, 89]]]
    # One stop doubles.
    assert np.array_equal(tone_map(linear / 2.0, 1.0), tone_map(linear))


def test_tone_mapping_is_monotonic_and_keeps_hue_order_of_highlights():
    grey = np.repeat(np.geomspace(1e-4, 1e6, 400)[:, None], 3, axis=1)[None]
    levels = tone_map(grey)[0, :, 0].astype(int)
    assert np.all(np.diff(levels) >= 0) and levels[-1] == 255
    assert np.max(np.diff(levels)) < 8  # No jump where the shoulder begins.
    orange = tone_map(np.array([[[40.0, 20.0, 4.0]]]))[0, 0].astype(int)
    assert orange[0] > orange[1] > orange[2] > 0


def test_pixels_that_are_not_finite_are_seen_and_negative_ones_are_black():
    linear = np.array([[[np.nan, 0.0, 0.0], [np.inf, 1.0, 1.0], [-1.0, -2.0, -0.5]]])
    assert tone_map(linear).tolist() == [[[255, 0, 255], [255, 0, 255], [0, 0, 0]]]


def test_the_png_holds_the_tone_mapped_pixels(tmp_path):
    image = random_image()
    write_png(tmp_path / "a.png", image, exposure_ev=-1.0)
    with PIL.Image.open(tmp_path / "a.png") as png:
        assert png.mode == "RGB"
        assert np.array_equal(np.asarray(png), tone_map(image.rgb, -1.0))


def test_json_is_strict_and_takes_numpy_numbers():
    value = {"a": np.float32(0.5), "b": np.arange(3), "c": float("nan"), "d": (np.True_, None)}
    assert json.loads(json_text(value)) == {"a": 0.5, "b": [0, 1, 2], "c": None, "d": [True, None]}
