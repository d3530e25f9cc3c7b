"""Cells that keep their light from frame to frame: what they keep, forget, and add to pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_builder import build, camera, glowing, lambertian, render, renderer
from test_temporal import error_of, room, sequence

from psf_cl.device.device import open_device
from psf_cl.device.layout import CONSTANT
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.settings import Settings

SIZE = (40, 30)
CELLS = {"path_filter": "hash_grid", "filter_vertex": "1", "cell_size": 6.0, "cell_shrink": False}
AHEAD = camera((0, 1.5, 3), (0, 0.5, 0), 45)
ASIDE = camera((0, 1.5, 3), (3, 0.5, 1), 45)


def kept(opened):
    """Return the keys of all slots, and what the cells of those that are taken know."""
    keys = opened.device.read(opened.buffers["kept_keys"])
    return keys, opened.device.read(opened.buffers["kept_cells"])[keys != 0]


def frames_of(device, views, spp=1, scene=None, **settings):
    """Yield the renderer after each frame; the last one is kept in the history, too."""
    scene = replace(scene or room(), cameras=(views[0],))
    opened = renderer(device, scene, ("history",), **(CELLS | settings))
    for frame in range(1, len(views) + 1):
        opened.render(spp=spp)
        image = opened.image()
        opened.moving = replace(opened.moving, cameras=(views[min(frame, len(views) - 1)],))
        opened.set_frame(frame / 24)
        yield opened, image
    opened.close()


def test_cells_keep_nothing_unless_frames_share_light():
    on = make_plan(room(), Settings(temporal="cumulative", **CELLS))
    assert "cell_history" in {stage.name for stage in on.stages}
    for off, reason in (
        ({"temporal": "off"}, "temporal is off"),
        ({"path_filter": "off"}, "path_filter is off"),
        ({"cell_history": 0.0}, "cell_history is 0: cells begin anew with each frame"),
    ):
        plan = make_plan(room(), Settings(**(CELLS | {"temporal": "cumulative"} | off)))
        assert dict(plan.left_out)["cell_history"] == reason
        assert "cell_history" not in {stage.name for stage in plan.stages}
        assert not any(spec.name.startswith("kept") for s in plan.stages for spec in s.buffers)


@pytest.mark.parametrize("rule", [pytest.param("cumulative", marks=pytest.mark.slow), "adaptive"])
def test_a_picture_that_stands_still_has_the_bits_of_its_pixels_histories(device, rule):
    """No cell knows more than the pixels that see it, and none is rejected."""
    scene = room(change=(3, 1.0))
    images = sequence(device, scene, 6, temporal=rule, **CELLS)
    truth = sequence(device, scene, 6, temporal="cumulative", cell_history=0.0, **CELLS)
    for number, (image, expected) in enumerate(zip(images, truth, strict=True), start=1):
        assert image.rgb.tobytes() == expected.rgb.tobytes()
        np.testing.assert_array_equal(image.aovs["history"], number)


@pytest.mark.parametrize("rule", ["cumulative", "exponential"])
def test_cells_follow_the_recurrence_of_their_rule(device, rule):
    """One cell has all samples: it knows the mean of each frame, weighed by the rule."""
    settings = {"cell_size": 1e5, "cell_jitter": False, "cell_near": False, "cell_walls": False}
    settings |= {"sampler": "random", "filter_direct": True, "max_depth": 1}
    wall = transform.rotation_xyz_degrees((90, 0, 0)) @ transform.scaling(50.0)
    lamp = transform.translation((0, 1, 1)) @ transform.rotation_xyz_degrees((90, 0, 0))
    parts = [
        (primitives.quad(), wall, lambertian(0.5)),
        (primitives.quad(), lamp @ transform.scaling(0.2), glowing(8.0)),
    ]
    view = camera((0, 0, 0.4), (0, 0, 0), 30)
    scene = build(parts, view, (16, 12))
    views = [view] * 5
    alone = [image.rgb.mean(axis=(0, 1)) for _, image in frames_of(device, views, 2, scene)]
    alpha = 0.3
    expected = alone[0]
    for number, mean in enumerate(alone[1:], start=2):
        weight = 1 / number if rule == "cumulative" else alpha
        expected = (1 - weight) * expected + weight * mean
    settings |= {"temporal": rule, "temporal_alpha": alpha}
    for opened, _ in frames_of(device, views, 2, scene, **settings):
        _, cells = kept(opened)
    # What reflects it is divided out.
    mean = (cells["mean"] * cells["count"][:, None]).sum(axis=0) / cells["count"].sum()
    np.testing.assert_allclose(0.5 * mean, expected, rtol=1e-4)


def test_cells_that_nobody_sees_are_evicted_in_time_and_the_others_are_found(device):
    """Linear probing: from where probing for a key starts to its slot, none is free."""
    size = CONSTANT["BUCKET_SLOTS"]
    views = [AHEAD] * 3 + [ASIDE] * 5
    counts = []
    for frame, (opened, _) in enumerate(
        frames_of(device, views, temporal="cumulative", cell_history=0.1, cell_size=1.5)
    ):
        keys, cells = kept(opened)
        counts.append(len(cells))
        assert (frame / 24 - cells["seen"]).max() <= 0.1 + 1e-6
        assert (cells["count"] > 0).all() and not cells["fresh"].any()
        buckets = keys.reshape(-1, size)
        for bucket in buckets:
            taken = bucket[bucket != 0]
            assert len(np.unique(taken)) == len(taken)
            for slot in np.flatnonzero(bucket):
                start = bucket[slot] % size
                assert bucket[(start + np.arange((slot - start) % size + 1)) % size].all()
    # Both views are known for a while; then the first one is forgotten.
    assert counts[3] > counts[2] and counts[-1] < 0.8 * counts[3]


def test_cells_know_what_pixels_have_not_seen_before(device):
    """The camera looks away and back: pixels begin anew, cells do not."""
    views = [AHEAD] * 12 + [ASIDE] * 2 + [AHEAD]
    truth = render(device, replace(room(), cameras=(AHEAD,)), 1024, **CELLS).rgb
    errors = {}
    for seconds in (0.0, 2.0):
        *_, (_, image) = frames_of(device, views, temporal="cumulative", cell_history=seconds)
        errors[seconds] = error_of(image.rgb, truth)
        if seconds:
            assert np.median(image.aovs["history"]) > 4.0
    assert errors[2.0] < 0.75 * errors[0.0]


def test_what_cells_know_survives_a_change_of_level(device):
    """A camera that jumps to twice the distance sees cells of another size."""
    near, far = camera((0, 0.75, 1.5), (0, 0.25, 0), 60), camera((0, 1.5, 3), (0, 0.5, 0), 60)
    # In between it sees nothing, so that no pixel has a history.
    views = [near] * 12 + [camera((0, 1, 3), (0, 5, 3.1), 30), far]
    for seconds, known in ((2.0, True), (0.0, False)):
        *_, (_, image) = frames_of(device, views, temporal="cumulative", cell_history=seconds)
        middle = image.aovs["history"][12:20, 14:26]
        assert np.median(middle) > 2.5 if known else (middle == 1.0).all()


def test_nothing_is_kept_in_cells_of_a_light_that_is_switched_off(device):
    scene = room(sky=0.0, change=(6, 0.0))
    images = sequence(device, scene, 8, temporal="adaptive", **CELLS)
    lit = images[5].rgb.max(axis=-1) > 0.0
    assert lit.mean() > 0.4
    assert (images[6].rgb[lit] == 0.0).mean() > 0.98


def test_a_full_table_degrades_is_counted_and_repeats_its_bits(device):
    """Each sample has a cell of its own, and the camera moves: more cells than slots."""
    views = [camera((0.1 * k, 1.5, 3), (0.1 * k, 0.5, 0), 45) for k in range(8)]
    settings = {"temporal": "cumulative", "cell_size": 0.02, "cell_walls": False}
    runs = []
    for _ in range(2):
        failed, images = 0, []
        for _, image in frames_of(device, views, scene=room((32, 32)), **settings):
            failed += image.stats["cells"]["failed_histories"]
            images.append(image.rgb.tobytes())
            assert np.isfinite(image.rgb).all()
        runs.append((failed, images))
    assert runs[0][0] > 0 and runs[0] == runs[1]


@pytest.mark.parametrize(
    "settings",
    [
        {"temporal": "adaptive", "screen_filter": "path_space", "spp": 2},
        # Passes of a frame fill buckets before others of it have looked there.
        {"temporal": "cumulative", "cell_size": 2.5, "cell_walls": False, "spp": 8},
    ],
)
def test_cells_have_the_same_bits_for_any_pool(device, settings):
    views = [camera((0.1 * k, 1.5, 3), (0.1 * k, 0.5, 0), 45) for k in range(6)]
    small = open_device(traits=replace(device.traits, slots=64))
    truth, images = (
        [
            image.rgb.tobytes()
            for _, image in frames_of(where, views, scene=room((32, 32)), **settings)
        ]
        for where in (device, small)
    )
    assert truth == images


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["cumulative", "adaptive"])
def test_64_frames_with_cells_have_the_error_of_64_samples(device, rule):
    """Against the limit of the filter, whose blur both have."""
    truth = render(device, room(), 4096, seed=3, **CELLS).rgb
    image = sequence(device, room(), 64, temporal=rule, **CELLS)[-1]
    expected = error_of(render(device, room(), 64, **CELLS).rgb, truth)
    assert error_of(image.rgb, truth) == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_100_frames_take_no_more_memory_and_repeat_their_bits_and_no_cell_is_old():
    views = [camera((0.03 * k, 1.5, 3), (0.05 * k, 0.5, 0), 45) for k in range(100)]
    bits, peaks = [], []
    for frames in (2, 100, 100):
        fresh = open_device()
        for number, (opened, last) in enumerate(
            frames_of(fresh, views[:frames], temporal="adaptive", cell_history=0.5)
        ):
            _, cells = kept(opened)
            assert number / 24 - cells["seen"].min() <= 0.5 + 1e-5
            image = last
        bits.append(image.rgb.tobytes())
        peaks.append(image.stats["peak_device_bytes"])
    assert bits[1] == bits[2]
    assert peaks[0] == peaks[1] == peaks[2]
