"""Paths that end by a radiance cache, against plain ones, closed forms and a model in NumPy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_builder import (
    build,
    camera,
    glowing,
    luminance_blocks,
    render,
    renderer,
    z_scores,
)
from test_guide import noisy, room

from psf_cl.device import layout
from psf_cl.device.device import Device
from psf_cl.device.program import load_program
from psf_cl.errors import InputError
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.load import load_scene
from psf_cl.settings import Settings
from psf_cl.stages import cache

CACHE = {"termination": "cache"}
STEPS = 64.0
SCENES = Path(__file__).parent.parent / "scenes"


@pytest.fixture(scope="module")
def small(device):
    """Return the device with a small pool, so that epochs are short."""
    return Device(device.context, replace(device.traits, slots=1024))


@pytest.fixture(scope="module")
def plain(small):
    return noisy(small, 256)


def test_a_cache_that_is_off_leaves_nothing_behind():
    plan = make_plan(room(), Settings())
    assert plan.features["CACHE"].value == 0
    assert dict(plan.left_out)["cache"] == "termination is roulette"
    assert not plan.in_epochs
    planned = make_plan(room(), Settings(**CACHE))
    assert planned.in_epochs and "cache" in [stage.name for stage in planned.stages]


def test_what_does_not_go_with_it_is_refused():
    with pytest.raises(InputError, match="goes with any termination but cache"):
        make_plan(room(), Settings(integrator="metropolis", **CACHE))
    negative = Settings(path_filter="hash_grid", cache_trace=0.5, **CACHE)
    with pytest.raises(InputError, match="needs cache_trace=0"):
        make_plan(room(), negative)


def random_sums(count):
    rng = np.random.default_rng(4)
    sums = np.zeros(count, layout.CACHE_SUM.dtype)
    sums["count"] = rng.poisson(10.0 ** rng.uniform(-1, 4, count))
    sums["near"] = rng.binomial(sums["count"], rng.choice([0.0, 0.1, 0.2], count))
    value = sums["count"][:, None] * 10.0 ** rng.uniform(0, 8, (count, 3))
    square = sums["count"] * 256.0 * (1 + 10.0 ** rng.uniform(-1, 3, count))
    value = np.concatenate([value, square[:, None]], axis=1)
    value[rng.random(count) < 0.1, :3] = 0
    whole = value.astype(np.uint64)
    sums["low"], sums["high"] = whole & np.uint64(0xFFFFFFFF), whole >> np.uint64(32)
    return sums


@pytest.mark.parametrize("trace", [0.0, 0.25, 1.0])
def test_frozen_cells_are_those_of_the_model(device, trace):
    """The second time squares are relative to the mean that there was."""
    sums, before = random_sums(512), 3.0
    cells = np.zeros(512, layout.CACHE_CELL.dtype)
    cells["mean"][::2] = before
    params = np.zeros(1, layout.PARAMS.dtype)
    params[0]["cache_slots"], params[0]["cache_steps"] = 512, STEPS
    params[0]["cache_trace"] = trace
    full = np.zeros(max(512 // layout.CONSTANT["BUCKET_SLOTS"], 1), np.uint32)
    full[-1] = 1
    buffers = {
        "params": device.upload("params", params),
        "cache_keys": device.upload("cache_keys", np.ones(512, np.uint32)),
        "cache_full": device.upload("cache_full", full),
        "cache_sums": device.upload("cache_sums", sums),
        "cache_cells": device.upload("cache_cells", cells),
    }
    features = dict.fromkeys(make_plan(room(), Settings()).features, 0) | {"CACHE": 1}
    program = load_program(device, "cache.cl", features)
    program.bind("freeze_cache", **buffers, fades=0)(512)
    found = device.read(buffers["cache_cells"])
    program.bind("renew_cache", **buffers)(len(full))
    keys, renewed = (device.read(buffers[name]) for name in ("cache_keys", "cache_cells"))
    device.release(*buffers.values())

    n = np.maximum(sums["count"], 1)
    value = (sums["low"] + sums["high"] * 2.0**32) / n[:, None]
    mean = value[:, :3] / STEPS
    now = mean @ [0.2126, 0.7152, 0.0722]
    square = np.full(512, 9.0)
    again = (np.arange(512) % 2 == 0) & (now > 0)
    square[again] = value[again, 3] / 256 * (before / now[again]) ** 2
    unsure = np.clip(16 * np.maximum(square - 1, 0) / n, 0, 1)
    # Where an eighth of the visits come from nearby a cell is next to something else.
    known = (sums["count"] >= 16) & (sums["near"] <= sums["count"] / 8)
    known[-layout.CONSTANT["BUCKET_SLOTS"] :] = False
    ends = (1 - trace) * (1 - unsure) if trace else np.ones(512)
    np.testing.assert_allclose(found["mean"], np.where(known[:, None], mean, 0), rtol=1e-5)
    np.testing.assert_allclose(found["ends"], np.where(known, ends, 0), atol=2e-4)
    assert known.any() and not known.all() and (0 < unsure[known]).any()
    # The part that ran over begins anew, the others stay.
    lost = slice(-layout.CONSTANT["BUCKET_SLOTS"], None)
    assert not keys[lost].any() and keys[: lost.start].all()
    assert not renewed["visits"][lost].any()


@pytest.mark.parametrize("trace", [0.2, 0.6])
def test_paths_that_go_on_by_chance_bring_the_same_on_average(small, plain, trace):
    image = noisy(small, 256, cache_trace=trace, cache_cell_size=4.0, **CACHE)
    assert image.stats["cache"]["ended_paths"] > 0.005
    # 16 blocks: the largest of so many standard normals is below 4 with a chance of 0.999.
    assert np.abs(z_scores(image, plain, 4)).max() < 4
    means, variances = luminance_blocks(image, 1)
    assert variances.item() < (0.05 * means.item()) ** 2


def test_a_chance_of_1_is_plain_path_tracing(small):
    image = noisy(small, 20, cache_trace=1.0, **CACHE)
    assert image.stats["cache"]["known_cells"] > 0 and image.stats["cache"]["ended_paths"] == 0
    assert image.rgb.tobytes() == noisy(small, 20).rgb.tobytes()


def test_bits_do_not_depend_on_the_pool(device, small):
    settings = CACHE | {"cache_trace": 0.3}
    image = noisy(small, 20, **settings)
    larger = Device(device.context, replace(device.traits, slots=4096))
    assert noisy(larger, 20, **settings).rgb.tobytes() == image.rgb.tobytes()


def test_what_a_lamp_lit_is_forgotten_when_it_goes_out(small):
    """The lamp goes out after a third of a second; before and after that the cache lasts."""
    scene = load_scene(SCENES / "moving" / "light_off.toml", moving=True, size=(40, 30))
    opened = renderer(small, scene, **CACHE)
    visits, means = [], []
    for time in (0.0, 0.1, 0.2, 0.4, 0.5, 0.6):
        if time:
            opened.set_frame(time)
            # Frames of which nothing was rendered must not hide the change.
            opened.set_frame(time)
        opened.render(spp=16)
        cells = opened.device.read(opened.buffers["cache_sums"])
        visits.append(int(cells["count"].sum()))
        means.append(opened.image().rgb.mean())
    opened.close()
    plain = renderer(small, scene)
    plain.set_frame(0.6)
    plain.render(spp=64)
    dark = plain.image().rgb.mean()
    plain.close()
    assert visits[1] > 1.2 * visits[0] and visits[2] > visits[1]
    assert visits[3] < 0.7 * visits[2]
    assert visits[4] > 1.2 * visits[3]
    assert min(means[:3]) > 3 * dark
    np.testing.assert_allclose(means[3:], dark, rtol=0.15)


def test_paths_get_shorter_and_a_furnace_keeps_its_light(small):
    """In a closed room that glows by 1 and reflects half, all radiance is 2."""
    box = (primitives.box(), transform.scaling(4.0), glowing(1.0, 0.5, double_sided=True))
    scene = build([box], camera((0, 0, 0.5), (0, 0, 0), 60), (24, 16))
    images = [render(small, scene, 256, max_depth=32, **more) for more in ({}, CACHE)]
    rays = [image.stats["paths"]["mean_rays"] for image in images]
    assert rays[1] < 0.75 * rays[0]
    # In 98304 samples of a spread of a half or less: 0.5 % is six standard errors.
    np.testing.assert_allclose([image.rgb.mean() for image in images], 2.0, rtol=5e-3)


def test_tables_have_room_for_small_and_large_pictures():
    assert cache.slots_of(1) == cache.LEAST_SLOTS
    assert cache.slots_of(1 << 28) == cache.MOST_SLOTS
