"""What renders learn, in files: renders from other places begin with it, bad files are refused."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace

import numpy as np
import pytest
from scene_builder import camera, luminance_blocks, renderer
from test_guide import room

from psf_cl.cli.main import main
from psf_cl.device import layout
from psf_cl.device.device import Device
from psf_cl.errors import InputError
from psf_cl.learned import MOST_VISITS, fade, table_names
from psf_cl.scene.curve import Curve
from psf_cl.scene.model import Node
from psf_cl.settings import Settings

BOTH = {"guiding": "learned", "termination": "cache"}
OTHER_EYE = (0.6, 1.2, 2.8)


def seen_from(eye):
    return replace(room(), cameras=(camera(eye, (0, 0.5, 0), 45),))


def painted(index, **values):
    """Return the room with another material."""
    materials = list(room().materials)
    materials[index] = replace(materials[index], **values)
    return replace(room(), materials=tuple(materials))


@pytest.fixture(scope="module")
def small(device):
    """Return the device with a small pool, so that epochs are short."""
    return Device(device.context, replace(device.traits, slots=1024))


@pytest.fixture(scope="module")
def saved(small, tmp_path_factory):
    """Return the file of a render from another place."""
    path = tmp_path_factory.mktemp("saved") / "room.cache"
    with contextlib.closing(renderer(small, seen_from(OTHER_EYE), **BOTH)) as first:
        first.render(spp=128)
        first.save_cache(path)
    return path


def begun(device, path, scene=None, **settings):
    opened = renderer(device, scene or room(), ("variance",), **(BOTH | settings))
    try:
        opened.load_cache(path)
    except InputError:
        opened.close()
        raise
    return opened


def test_a_render_begins_with_what_another_one_knows(small, saved):
    """It has the tables, and less noise in its first passes."""
    fresh = contextlib.closing(renderer(small, room(), ("variance",), **BOTH))
    with fresh as one, contextlib.closing(begun(small, saved)) as other:
        images = []
        for opened in (one, other):
            opened.render(spp=8)
            images.append(opened.image())
    ended = [image.stats["cache"]["ended_paths"] for image in images]
    assert ended[1] > ended[0] + 0.2
    variance = [luminance_blocks(image, 1)[1].item() for image in images]
    assert variance[1] < 0.8 * variance[0]


def test_cameras_and_the_time_of_a_frame_do_not_make_another_scene(small, saved):
    rise = Curve(np.array([0.0, 1.0]), np.array([[0.0, 1.5, 3.0], [0.0, 1.6, 2.0]]))
    view = room().cameras[0]
    flight = replace(
        room(),
        nodes=(Node(curves={"translation": rise}),),
        cameras=(view, replace(view, node=0)),
        camera=1,
    )
    with contextlib.closing(begun(small, saved, flight)) as opened:
        opened.set_frame(0.5)
        opened.load_cache(saved)


def test_what_is_loaded_is_what_was_saved(small, saved, tmp_path):
    again = tmp_path / "again.cache"
    with contextlib.closing(begun(small, saved)) as opened:
        opened.save_cache(again)
    assert again.read_bytes() == saved.read_bytes()


def test_bits_with_a_loaded_cache_do_not_depend_on_the_pool_or_a_stop(
    device, small, saved, tmp_path
):
    with contextlib.closing(begun(small, saved)) as opened:
        opened.render(spp=20)
        truth = opened.image().rgb.tobytes()
    larger = Device(device.context, replace(device.traits, slots=4096))
    with contextlib.closing(begun(larger, saved)) as opened:
        opened.render(spp=7)
        opened.render(spp=20)
        assert opened.image().rgb.tobytes() == truth
    with contextlib.closing(begun(small, saved)) as first:
        first.render(spp=10)
        assert first.save(tmp_path / "state")
    with contextlib.closing(begun(small, saved)) as second:
        second.resume(tmp_path / "state")
        second.render(spp=20)
        assert second.image().rgb.tobytes() == truth
    # A checkpoint does not go on without what it began with.
    bare = renderer(small, room(), ("variance",), **BOTH)
    with contextlib.closing(bare), pytest.raises(InputError, match="of another loaded cache"):
        bare.resume(tmp_path / "state")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scene": painted(0, base_color=(0.7, 0.5, 0.2))}, "is of another scene"),
        ({"scene": painted(3, emission=(41.0, 30.0, 20.0))}, "is of another scene"),
        ({"max_depth": 3}, "max_depth=16; this one has 3"),
        ({"scene": room(size=(16, 24))}, r"size=\[24, 16\]; this one has \[16, 24\]"),
        ({"guide_cell_size": 16.0}, "guide_cell_size=64.0; this one has 16.0"),
    ],
)
def test_tables_of_something_else_are_refused_in_one_line(small, saved, change, message):
    with pytest.raises(InputError, match=message) as caught:
        begun(small, saved, **change)
    assert "\n" not in str(caught.value)


def test_damaged_files_are_refused(small, saved, tmp_path):
    whole = saved.read_bytes()
    path = tmp_path / "bad.cache"
    rng = np.random.default_rng(3)
    with contextlib.closing(renderer(small, room(), **BOTH)) as opened:
        for place in (0, 5, 21, 40, 300, *rng.integers(0, len(whole), 5)):
            for data in (
                whole[:place],
                whole[:place] + bytes([whole[place] ^ 0x20]) + whole[place + 1 :],
            ):
                path.write_bytes(data)
                with pytest.raises(InputError, match=r"bad.cache: \w"):
                    opened.load_cache(path)
        with pytest.raises(InputError, match="expected a cache, got nothing"):
            opened.load_cache(tmp_path / "missing")


def test_sums_that_are_about_to_run_over_are_refused(small, saved, tmp_path):
    with contextlib.closing(begun(small, saved)) as opened:
        sums = opened.device.read(opened.buffers["guide_sums"])
        sums["high"][3, 4] = 1 << 31
        opened.device.write(opened.buffers["guide_sums"], sums)
        opened.save_cache(tmp_path / "huge.cache")
        with pytest.raises(InputError, match=r"unsound cache: .* render without --load-cache"):
            opened.load_cache(tmp_path / "huge.cache")


def test_cells_of_many_visits_fade_to_the_same_mean():
    sums = np.zeros(3, layout.GUIDE_SUM.dtype)
    sums["count"][0, :2] = 5 * MOST_VISITS, 10
    sums["low"][0, 0], sums["high"][0, 0] = 7, 40
    sums["count"][1], sums["low"][1] = MOST_VISITS, 9
    before = sums.copy()
    fade(sums)
    # 5 times as many: halved three times.
    assert sums["count"][0, 0] == 5 * MOST_VISITS // 8 and sums["count"][0, 1] == 1
    assert sums["high"][0, 0] == 5 and sums["low"][0, 0] == 0
    assert (sums[1:] == before[1:]).all()


def test_visits_from_nearby_fade_with_all_visits():
    sums = np.zeros(2, layout.CACHE_SUM.dtype)
    sums["count"], sums["near"] = 4 * MOST_VISITS, (MOST_VISITS, 0)
    fade(sums)
    np.testing.assert_array_equal(sums["count"], MOST_VISITS)
    np.testing.assert_array_equal(sums["near"], [MOST_VISITS // 4, 0])


def test_settings_that_learn_nothing_are_refused():
    with pytest.raises(InputError, match="--save-cache: nothing is learned with guiding=off"):
        table_names(Settings(), "--save-cache")


SCENE = """
[film]
width = 16
height = 16
[camera]
position = [0, 0, 3]
target = [0, 0, 0]
[environment]
radiance = [1, 1, 1]
[materials.grey]
base_color = [0.5, 0.5, 0.5]
specular = 0.0
[[shapes]]
primitive = "sphere"
material = "grey"
"""


def test_statistics_are_written_before_a_cache_that_finds_no_room(
    device, tmp_path, monkeypatch, capsys
):
    def full(path, *_):
        raise InputError(f"{path}: no space left")

    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.toml").write_text(SCENE)
    monkeypatch.setattr("psf_cl.learned.write_learned", full)
    run = "render a.toml --preset learned --spp 1 --quiet -o a.exr --stats s.json --save-cache c"
    assert main(run.split()) == 2
    assert capsys.readouterr().err.strip().endswith("c: no space left")
    assert json.loads((tmp_path / "s.json").read_text())["spp"] == 1


def test_a_fly_through_saves_and_loads_on_the_command_line(device, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.toml").write_text(SCENE)
    run = "render a.toml --preset learned --spp 2 --quiet -o a.exr".split()
    assert main([*run, "--save-cache", "c"]) == 0
    assert main([*run, "--load-cache", "c", "--save-cache", "c"]) == 0
    (tmp_path / "c").write_bytes(b"nonsense")
    assert main([*run, "--load-cache", "c"]) == 2
    assert main("render a.toml --quiet --save-cache c".split()) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 2 and "c: expected a cache of this version" in lines[0]
    assert "--save-cache: nothing is learned" in lines[1]
