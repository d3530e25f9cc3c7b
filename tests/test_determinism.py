"""Same bits: whatever runs beside, however the work is cut, wherever a path is computed."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_builder import LUMINANCE, build, camera, floor, glowing, render, renderer

from psf_cl.device.device import open_device
from psf_cl.errors import InputError
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Light, Material
from psf_cl.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
OUTPUTS = ("albedo", "normal", "depth", "direct", "indirect", "variance", "samples")


def scene(size=(24, 16), columns=12):
    """Return a scene with an area light, a point light, a sky, and glossy things.

    It has 172 triangles and so a tree; with 6 ``columns`` 40, and so a list of them.
    """
    over = transform.translation((0, 2.5, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    metal = Material(base_color=(0.9, 0.7, 0.4), metallic=1.0, roughness=0.3)
    ball = transform.translation((0, 0.6, 0)) @ transform.scaling(0.6)
    return build(
        [
            floor(3.0, Material(roughness=0.6)),
            (primitives.sphere(columns, 2 * columns // 3), ball, metal),
            (primitives.quad(), over @ transform.scaling(0.3), glowing((8.0, 6.0, 4.0))),
        ],
        camera((0, 1.5, 3), (0, 0.5, 0), 45),
        size,
        lights=[Light("point", (1.0, 2.0, 3.0), position=(1.0, 1.0, 1.0))],
        environment=0.1,
    )


def assert_same_bits(one, other):
    assert one.aovs.keys() == other.aovs.keys()
    for name in one.aovs:
        assert one.aovs[name].tobytes() == other.aovs[name].tobytes(), name


@pytest.fixture(scope="module")
def truth(device):
    return render(device, scene(), 40, OUTPUTS)


def test_two_renders_have_the_same_bits_and_two_seeds_have_not(device, truth):
    assert_same_bits(render(device, scene(), 40, OUTPUTS), truth)
    other = render(device, scene(), 40, OUTPUTS, seed=1)
    assert (other.rgb != truth.rgb).mean() > 0.5


def test_single_steps_give_the_bits_of_one_render(device, truth):
    opened = renderer(device, scene(), OUTPUTS)
    for count in range(1, 41):
        opened.step()
        assert opened.scheduler.passes == count
    assert_same_bits(opened.image(), truth)
    opened.close()


def test_looking_at_the_image_in_between_changes_nothing(device, truth):
    opened = renderer(device, scene(), OUTPUTS)
    assert not opened.image().aovs["samples"].any()
    for spp in (1, 7, 8, 40):
        opened.render(spp=spp)
        opened.snapshot(("rgb", "direct"))
        assert (opened.image().aovs["samples"] == spp).all()
    assert_same_bits(opened.image(), truth)
    opened.close()


def test_a_number_of_seconds_gives_the_bits_of_its_number_of_passes(device):
    timed = renderer(device, scene(), OUTPUTS)
    timed.render(seconds=0.3)
    image = timed.image()
    passes = image.stats["passes"]
    assert passes >= 1 and (image.aovs["samples"] == passes).all()
    assert_same_bits(render(device, scene(), passes, OUTPUTS), image)
    timed.render(seconds=0.05)
    more = timed.image()
    timed.close()
    assert more.stats["passes"] > passes
    assert_same_bits(render(device, scene(), more.stats["passes"], OUTPUTS), more)


def test_two_renderers_alive_at_once_give_the_bits_that_each_gives_alone(device, truth):
    other_scene = replace(scene((9, 5)), lights=())
    alone = render(device, other_scene, 40, ["variance"])
    first = renderer(device, scene(), OUTPUTS)
    second = renderer(device, other_scene, ["variance"])
    for spp in (3, 10, 40):
        first.render(spp=spp)
        second.render(spp=spp)
    assert_same_bits(first.image(), truth)
    assert_same_bits(second.image(), alone)
    first.close()
    assert_same_bits(second.image(), alone)
    second.close()


def test_the_scenes_are_one_with_a_tree_and_one_with_a_list():
    tree, few = (make_plan(scene(columns=columns), Settings()) for columns in (12, 6))
    assert not tree.features["FEW"].value and few.features["FEW"].value


@pytest.mark.parametrize(
    ("slots", "run"), [(128, 3), (1024, 1), pytest.param(128, 1, marks=pytest.mark.slow)]
)
def test_size_of_the_pool_does_not_show(device, truth, slots, run):
    small = open_device(traits=replace(device.traits, slots=slots, run=run))
    assert_same_bits(render(small, scene(), 40, OUTPUTS), truth)


def test_size_of_the_pool_does_not_show_without_a_tree(device):
    few = scene(columns=6)
    whole = render(device, few, 40, OUTPUTS)
    for slots in (128, 1024):
        small = open_device(traits=replace(device.traits, slots=slots))
        assert_same_bits(render(small, few, 40, OUTPUTS), whole)


@pytest.mark.parametrize("crop", [(0, 0, 24, 16), (5, 3, 7, 9), (23, 15, 1, 1), (0, 8, 24, 1)])
def test_crop_has_the_bits_of_its_part_of_the_whole(device, truth, crop):
    x, y, width, height = crop
    part = render(device, scene(), 40, OUTPUTS, crop)
    assert (part.x, part.y, part.full_width, part.full_height) == (x, y, 24, 16)
    for name, pixels in truth.aovs.items():
        expected = pixels[y : y + height, x : x + width]
        np.testing.assert_array_equal(part.aovs[name], expected, err_msg=name)


def assert_lane_widths_agree(device, some_scene, spp, outputs=(), **settings):
    def image(lanes):
        traits = replace(device.traits, lanes=lanes, block=16, slots=1024)
        return render(open_device(traits=traits), some_scene, spp, outputs, **settings)

    narrow = image(1)
    assert narrow.rgb.any()
    for wide in (image(8), image(16)):
        for name, pixels in narrow.aovs.items():
            np.testing.assert_allclose(wide.aovs[name], pixels, rtol=1e-5, atol=1e-7, err_msg=name)


@pytest.mark.parametrize(
    "columns",
    [pytest.param(12, marks=pytest.mark.slow, id="tree"), pytest.param(6, id="list")],
)
def test_lane_widths_agree(device, columns):
    assert_lane_widths_agree(device, scene(columns=columns), 40, OUTPUTS)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell_box", "ajar_door", "glossy"])
def test_lane_widths_agree_on_the_scenes(device, name):
    loaded = load_scene(ROOT / "scenes" / f"{name}.toml")
    small = replace(loaded, width=64, height=48)
    assert_lane_widths_agree(device, small, 64, OUTPUTS, **loaded.render)


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (7, 1), (1, 17)])
def test_tiny_pictures_have_every_sample_of_every_pixel(device, size):
    image = render(device, scene(size), 100, ["samples"])
    assert image.rgb.shape == (size[1], size[0], 3)
    assert (image.aovs["samples"] == 100).all()
    assert np.isfinite(image.rgb).all() and image.rgb.min() >= 0 and image.rgb.any()


def test_one_pixel_has_the_mean_of_the_many_that_show_the_same(device):
    one = render(device, scene((1, 1)), 16384, ["variance"], sampler="random")
    many = render(device, scene((16, 16)), 256, ["variance"], sampler="random")
    noise = np.sqrt(one.aovs["variance"].mean() + many.aovs["variance"].mean() / 256)
    difference = (one.rgb.mean(axis=(0, 1)) - many.rgb.mean(axis=(0, 1))) @ LUMINANCE
    assert abs(difference) < 5 * noise
    assert noise < 0.05 * (many.rgb.mean(axis=(0, 1)) @ LUMINANCE)


def test_stopping_after_some_passes_leaves_exactly_those(device):
    seen = []

    def stop(progress):
        seen.append(progress.passes)
        return progress.passes < 5

    opened = renderer(device, scene(), OUTPUTS)
    assert opened.render(spp=100_000, progress=stop) is False
    image = opened.image()
    passes = image.stats["passes"]
    assert 5 <= passes == seen[-1] < 100_000
    assert_same_bits(render(device, scene(), passes, OUTPUTS), image)
    # It can go on as if nothing had been.
    assert opened.render(spp=passes + 3) is True
    assert_same_bits(render(device, scene(), passes + 3, OUTPUTS), opened.image())
    opened.close()


def test_stopping_in_the_first_pass_leaves_the_samples_that_there_are(device):
    # So large for its pool that the second look comes before the first pass is done.
    small = open_device(traits=replace(device.traits, slots=device.traits.block * 4))
    opened = renderer(small, scene((96, 64)), OUTPUTS)
    looks = iter([True])
    assert opened.render(spp=100, progress=lambda progress: next(looks, False)) is False
    assert opened.scheduler.passes == 0
    partial = opened.image()
    there = partial.aovs["samples"][..., 0]
    assert set(np.unique(there)) == {0.0, 1.0}
    whole = render(device, scene((96, 64)), 1, OUTPUTS)
    for name in ("rgb", "direct", "depth"):
        np.testing.assert_array_equal(partial.aovs[name][there == 1], whole.aovs[name][there == 1])
    assert not partial.rgb[there == 0].any()
    # Looking at it has not spoiled what comes after.
    opened.render(spp=2)
    assert_same_bits(opened.image(), render(device, scene((96, 64)), 2, OUTPUTS))
    opened.close()


THREADS = """
import hashlib, sys
sys.path.insert(0, "tests")
from test_determinism import OUTPUTS, scene
from scene_builder import render
from psf_cl.device.device import open_device
device = open_device()
digest = hashlib.sha256()
shared = {"path_filter": "hash_grid", "filter_vertex": "1", "filter_restore": True}
renders = [(12, OUTPUTS, {}), (6, OUTPUTS, {}), (6, ["variance"], shared)]
for columns, outputs, settings in renders:
    image = render(device, scene(columns=columns), 40, outputs, **settings)
    for name in sorted(image.aovs):
        digest.update(image.aovs[name].tobytes())
print(device.cl_device.max_compute_units, digest.hexdigest())
"""


def test_number_of_threads_does_not_show(device):
    if "portable computing language" not in device.name.lower():
        pytest.skip("the number of threads can only be chosen for PoCL")
    units, digests = [], []
    for threads in (1, 2):
        # Older versions of PoCL know only the second name.
        names = dict.fromkeys(("POCL_CPU_MAX_CU_COUNT", "POCL_MAX_PTHREAD_COUNT"), str(threads))
        done = subprocess.run(
            [sys.executable, "-c", THREADS],
            cwd=ROOT,
            env=os.environ | names,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        unit, digest = done.stdout.split()
        units.append(int(unit))
        digests.append(digest)
    assert digests[0] == digests[1]
    assert units[0] == 1 and units[1] == min(2, os.cpu_count() or 1)


@pytest.mark.parametrize(
    "budget",
    [
        {},
        {"spp": 1, "seconds": 1.0},
        {"spp": 0},
        {"spp": 2.5},
        {"spp": 1 << 40},
        {"seconds": 0.0},
        {"seconds": float("nan")},
        {"seconds": float("inf")},
    ],
)
def test_a_budget_that_would_never_end_is_refused(device, budget):
    opened = renderer(device, scene((2, 2)))
    with pytest.raises(InputError, match=r"spp|seconds"):
        opened.render(**budget)
    opened.close()


def test_batches_start_small_again_after_an_empty_pool(device):
    """Tails of passes leave the pool empty: their speed says nothing about a full one."""
    opened = renderer(device, scene())
    for _ in range(10):
        opened.step()
    looks = []
    opened.render(spp=400, progress=lambda progress: looks.append(progress.passes))
    # The first look comes long before the end.
    assert looks[0] < 200 and len(looks) > 2
    opened.close()


def test_a_renderer_that_could_not_be_made_holds_no_memory(device, monkeypatch):
    before = device.allocated_bytes
    monkeypatch.setattr("psf_cl.renderer.build_bvh", lambda *arguments: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        renderer(device, scene())
    assert device.allocated_bytes == before
