"""Metropolis light transport: chains sample what they should, and all of their light arrives."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import planes
import pytest
from scene_builder import (
    LUMINANCE,
    block_means,
    build,
    camera,
    floor,
    glowing,
    lambertian,
    renderer,
)
from scene_builder import render as render_path
from scipy import stats

from psf_cl.device.layout import CHAIN_FIELDS, COUNTER_INDEX, PARAMS, SPLAT_SUM
from psf_cl.errors import InputError
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Light
from psf_cl.settings import Settings, resolve
from psf_cl.stages.metropolis import choose_starts

ROOT = Path(__file__).resolve().parents[1]

#: A right program fails a test once in ten thousand; the numbers are fixed, so it never does again.
P_MIN = 1e-4


def room(size=(24, 16), reflectance=0.6, radiance=8.0, sky=0.2):
    """Return a floor under a small light and a sky."""
    over = transform.translation((0, 1.5, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    return build(
        [
            floor(2.0, lambertian(reflectance)),
            (primitives.quad(), over @ transform.scaling(0.3), glowing(radiance, 0.5)),
        ],
        camera((0, 1.2, 3), (0, 0.4, 0), 45),
        size,
        environment=sky,
    )


def render(device, scene, spp, **settings):
    opened = renderer(device, scene, **({"integrator": "metropolis", "chains": 256} | settings))
    opened.render(spp=spp)
    image = opened.image()
    opened.close()
    return image


def params(device, **values):
    record = np.zeros(1, PARAMS.dtype)
    for name, value in values.items():
        record[0][name] = value
    return device.upload("params", record)


def ridge(x, y):
    across = np.abs(x - y)
    distance = np.minimum(across, 1 - across)
    return np.where(distance < 0.25, (0.26 - distance) * (x + 0.1), 0.0)


def walk(device, states, steps, large_steps):
    """Return the states (2, n) after ``steps`` of n chains, and how many each accepted."""
    count = states.shape[1]
    buffers = {
        "params": params(
            device, chain_numbers=16, chain_pairs=1, large_steps=large_steps, sampler=1
        ),
        "chains": device.allocate("chains", np.float32, count * len(CHAIN_FIELDS)),
        "numbers": device.allocate("numbers", np.uint32, count * 16),
        "states": device.upload("states", states),
        "accepted": device.allocate("accepted", np.uint32, count),
    }
    program = planes.load_program(device, "chain_test.cl", {"METROPOLIS": 1}, planes.KERNELS)
    program.bind("walk", **buffers, steps=steps)(count // device.traits.lanes, group=planes.GROUP)
    result = device.read(buffers["states"]).reshape(2, count), device.read(buffers["accepted"])
    device.release(*buffers.values())
    return result


@pytest.mark.parametrize(("steps", "large_steps"), [(64, 0.0), (7, 0.5)])
def test_chains_stay_in_the_density_that_they_start_from(device, steps, large_steps):
    """A chi-square test over one state of each of many independent chains."""
    count, bins = 1 << 16, 16
    random = np.random.default_rng(5)
    points = random.random((2, 16 * count))
    points = points[:, random.random(16 * count) * 0.286 < ridge(*points)][:, :count]
    assert points.shape[1] == count
    after, accepted = walk(device, (points * 2.0**32).astype(np.uint32), steps, large_steps)
    x, y = after / 2.0**32
    found, _, _ = np.histogram2d(x, y, bins, [[0, 1], [0, 1]])
    fine = (np.arange(bins * 32) + 0.5) / (bins * 32)
    density = ridge(*np.meshgrid(fine, fine, indexing="ij"))
    wanted = density.reshape(bins, 32, bins, 32).sum(axis=(1, 3))
    wanted *= count / wanted.sum()
    assert not found[wanted == 0].any() and (wanted[wanted > 0] > 10).all()
    assert stats.chisquare(found[wanted > 0], wanted[wanted > 0]).pvalue > P_MIN
    # They moved, and were held back.
    share = accepted.sum() / (count * steps)
    assert 0.1 < share < 0.98
    moved = np.abs(x - points[0])
    assert np.median(np.minimum(moved, 1 - moved)) > 0.01


def test_steps_of_single_chains_are_small_and_symmetric(device):
    """One accepted step from the brightest place of the ridge's flank."""
    states = np.full((2, 1 << 14), 1 << 31, np.uint32)
    after, _ = walk(device, states, 1, 0.0)
    shift = (after.astype(np.int64) - (1 << 31)) / 2.0**32
    moved = shift[:, shift[0] != 0]
    assert (np.abs(moved) >= 2.0**-10).all() and (np.abs(moved) < 2.0**-6).all()
    # Each octave takes a quarter, and either direction half.  Acceptance hardly depends on it.
    octaves = np.bincount((np.floor(np.log2(np.abs(moved[1]))) + 10).astype(int), minlength=4)
    np.testing.assert_allclose(octaves / moved.shape[1], 0.25, atol=0.03)
    np.testing.assert_allclose((moved > 0).mean(axis=1), 0.5, atol=0.03)


def test_splats_sum_up_exactly_whatever_meets_in_a_pixel(device):
    random = np.random.default_rng(3)
    count, pixels, ring, steps = 4096, 5, 2, 2.0**24
    where = random.integers(0, pixels, count).astype(np.uint32)
    which = random.integers(0, ring, count).astype(np.uint32)
    # From 2^23 steps on nothing is rounded; sums pass 2^32.
    whole = random.integers(1 << 23, 1 << 24, (3, count)) * random.integers(0, 2, (3, count))
    light = (whole * 2.0 ** random.integers(-24, -14, count)).astype(np.float32)
    light[:, 7] = 1e30  # More than a sum can hold.
    buffers = {
        "params": params(device, splat_steps=steps, pixel_count=pixels, ring=ring),
        "pass": device.upload("pass", which),
        "pixel": device.upload("pixel", where),
        "light": device.upload("light", light.reshape(-1)),
        "splats": device.allocate("splats", SPLAT_SUM.dtype, ring * pixels),
        "counters": device.allocate("counters", np.uint32, 64),
    }
    program = planes.load_program(device, "chain_test.cl", {"METROPOLIS": 1}, planes.KERNELS)
    program.bind("splat_all", **buffers)(count // device.traits.lanes, group=planes.GROUP)
    found = device.read(buffers["splats"])
    rejected = device.read(buffers["counters"])[COUNTER_INDEX["rejected_samples"]]
    device.release(*buffers.values())
    kept = np.arange(count) != 7
    expected = np.zeros((ring * pixels, 3), np.uint64)
    for channel in range(3):
        value = (light[channel].astype(np.float64) * steps)[kept].astype(np.uint64)
        np.add.at(expected[:, channel], (which * pixels + where)[kept], value)
    assert (expected > 1 << 32).any()
    sums = found["low"].astype(np.uint64) + (found["high"].astype(np.uint64) << np.uint64(32))
    np.testing.assert_array_equal(sums, expected)
    assert rejected == 1


def test_first_states_are_chosen_in_proportion_to_their_luminance():
    random = np.random.default_rng(1)
    luminances = (random.random(1000) ** 4 * (random.random(1000) < 0.3)).astype(np.float32)
    starts, mean = choose_starts(luminances, 512, seed=3)
    assert mean == pytest.approx(luminances.mean(dtype=np.float64), rel=1e-9)
    assert starts.dtype == np.uint32 and starts.shape == (512,)
    expected = luminances / luminances.sum(dtype=np.float64) * 512
    times = np.bincount(starts, minlength=1000)
    assert not times[luminances == 0].any()
    assert (np.abs(times - expected) < 1 + 1e-4).all()


def test_where_nothing_shines_the_image_is_black(device):
    image = render(device, room(radiance=0.0, sky=0.0), 4)
    assert not image.rgb.any() and image.stats["metropolis"]["brightness"] == 0.0


@pytest.fixture(scope="module")
def image(device):
    return render(device, room(), 96)


def test_the_same_bits_in_one_go_step_by_step_and_after_looks(device, image):
    opened = renderer(device, room(), integrator="metropolis", chains=256)
    opened.step()
    opened.render(spp=50)
    opened.image()
    opened.render(spp=96)
    again = opened.image()
    opened.close()
    assert again.rgb.tobytes() == image.rgb.tobytes()
    other = render(device, room(), 96, seed=1)
    assert (other.rgb != image.rgb).mean() > 0.5


def test_a_checkpoint_goes_on_with_the_same_bits(device, image, tmp_path):
    first = renderer(device, room(), integrator="metropolis", chains=256)
    first.render(spp=90)
    assert first.save(tmp_path / "file")
    first.close()
    second = renderer(device, room(), integrator="metropolis", chains=256)
    second.resume(tmp_path / "file")
    second.render(spp=96)
    assert second.image().rgb.tobytes() == image.rgb.tobytes()
    second.close()


def test_a_number_of_seconds_gives_the_bits_of_its_number_of_passes(device):
    opened = renderer(device, room(), integrator="metropolis", chains=256)
    opened.render(seconds=0.2)
    timed = opened.image()
    opened.close()
    assert timed.stats["spp"] > 1
    assert render(device, room(), timed.stats["spp"]).rgb.tobytes() == timed.rgb.tobytes()


def test_steps_and_acceptance_are_in_the_statistics(image):
    found = image.stats["metropolis"]
    assert found["chains"] == 256
    # A pass has as many mutations as pixels, and a share of them are large steps.
    mutations = 24 * 16 * 96
    assert found["large_steps"] + found["small_steps"] == mutations
    assert found["large_steps"] / mutations == pytest.approx(0.3, abs=0.01)
    assert 0.05 < found["large_accepted"] < found["small_accepted"] < 1.0
    # The start: every chain traces its first state again.
    assert image.stats["rays"]["camera"] >= mutations + found["start_paths"] + 256


def test_the_image_is_that_of_independent_paths(device, image):
    truth = render_path(device, room(), 1024)
    mean, right = (
        float(one.rgb.astype(np.float64).mean(axis=(0, 1)) @ LUMINANCE) for one in (image, truth)
    )
    # Chains of one short run: a per cent or two.
    assert mean == pytest.approx(right, rel=0.05)
    assert np.median(block_means(image.rgb, 4) / block_means(truth.rgb, 4)) == pytest.approx(
        1, abs=0.05
    )


def test_a_crop_is_a_part_of_the_image(device):
    scene, crop = room((32, 32)), (8, 12, 16, 10)
    truth = render_path(device, scene, 256).rgb[12:22, 8:24]
    opened = renderer(device, scene, crop=crop, integrator="metropolis", chains=256)
    opened.render(spp=128)
    found = opened.image().rgb
    opened.close()
    assert found.shape == truth.shape
    np.testing.assert_allclose(
        found.reshape(2, 5, 2, 8, 3).mean(axis=(1, 3)),
        truth.reshape(2, 5, 2, 8, 3).mean(axis=(1, 3)),
        rtol=0.15,
    )


def test_a_furnace_is_uniform(device):
    """What glows with 0.5 and reflects 0.5, or reflects all, shines with 1 under a sky of 1."""
    found = render(device, room((16, 16), 1.0, 0.5, 1.0), 256, max_depth=64)
    means = block_means(found.rgb, 2)
    np.testing.assert_allclose(means, 1.0, rtol=0.03)
    np.testing.assert_allclose(found.rgb.mean(axis=(0, 1), dtype=np.float64), 1.0, rtol=0.01)


def test_paths_that_are_not_finite_are_refused_and_counted(device):
    lights = [Light("point", (3e38, 3e38, 3e38), position=(0.0, 0.001, 0.0))]
    found = render(device, replace(room(), lights=lights), 8)
    assert found.stats["counters"]["rejected_samples"] > 0
    assert np.isfinite(found.rgb).all()


@pytest.mark.parametrize(
    ("settings", "options", "message"),
    [
        ({"path_filter": "hash_grid"}, {}, "integrator=metropolis needs path_filter=off"),
        ({"screen_filter": "path_space"}, {}, "integrator=metropolis needs screen_filter=off"),
        ({}, {"outputs": ["albedo"]}, "--aov: integrator=metropolis has no further images"),
        ({}, {"halves": True}, "--noise: integrator=metropolis cannot tell its error"),
    ],
)
def test_what_needs_the_samples_of_a_pixel_is_refused_in_one_line(settings, options, message):
    with pytest.raises(InputError, match=message) as caught:
        make_plan(room(), Settings(integrator="metropolis", **settings), **options)
    assert "\n" not in str(caught.value)


def test_the_preset_leaves_out_what_chains_do_not_need():
    plan = make_plan(room(), resolve({}, "test", "mlt"))
    names = [stage.name for stage in plan.stages]
    assert names == ["metropolis", "intersect", "shade", "connect", "splats", "film"]
    assert plan.features["METROPOLIS"].reason == "integrator is metropolis"
    assert "metropolis" not in [stage.name for stage in make_plan(room(), Settings()).stages]


THREADS = """
import hashlib, psf_cl
image = psf_cl.render("scenes/cornell_box.toml", preset="mlt", spp=4, chains=512)
print(hashlib.sha256(image.rgb.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_number_of_threads_does_not_show(device):
    if "portable computing language" not in device.name.lower():
        pytest.skip("the number of threads can only be chosen for PoCL")
    digests = set()
    for threads in (1, 2):
        names = dict.fromkeys(("POCL_CPU_MAX_CU_COUNT", "POCL_MAX_PTHREAD_COUNT"), str(threads))
        done = subprocess.run(
            [sys.executable, "-c", THREADS],
            cwd=ROOT,
            env=os.environ | names,
            capture_output=True,
            text=True,
            check=True,
        )
        digests.add(done.stdout)
    assert len(digests) == 1


@pytest.mark.slow
def test_mean_over_seeds_is_that_of_path_tracing(device):
    """Within 1 % over 8 seeds, and each block within five standard errors."""
    scene = load_scene(ROOT / "scenes/cornell_box.toml", size=(64, 64))
    truth = render_path(device, scene, 2048).rgb
    images = [
        render(device, scene, 128, chains=1024, seed=seed).rgb.astype(np.float64)
        for seed in range(8)
    ]
    assert np.mean(images) == pytest.approx(float(truth.mean(dtype=np.float64)), rel=0.01)
    blocks = np.array([block_means(one, 4) @ LUMINANCE for one in images])
    right = block_means(truth, 4) @ LUMINANCE
    error = np.maximum(blocks.std(axis=0, ddof=1) / np.sqrt(8), 0.01 * right)
    assert (np.abs(blocks.mean(axis=0) - right) < 5 * error).all()
