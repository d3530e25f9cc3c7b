"""Path space filtering against closed forms, plain path tracing and a model in NumPy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_builder import (
    LUMINANCE,
    build,
    camera,
    floor,
    glowing,
    lambertian,
    render,
    renderer,
)

from psf_cl import load_scene
from psf_cl.device import layout
from psf_cl.device.device import open_device
from psf_cl.errors import InputError
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Environment, Material
from psf_cl.settings import Settings, preset_values
from psf_cl.stages.cells import VIEWS

FILTER = {"path_filter": "hash_grid"}
CORNELL_BOX = Path(__file__).parents[1] / "scenes" / "cornell_box.toml"


def room(size=(24, 16), **values):
    """Return a lamp over a floor with a box on it: shadows, and light between surfaces."""
    over = transform.translation((0.5, 2.0, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    box = transform.translation((0, 0.4, 0)) @ transform.scaling(0.4)
    return build(
        [
            floor(3.0, lambertian((0.7, 0.5, 0.3))),
            (primitives.box(), box, lambertian((0.3, 0.6, 0.8))),
            (primitives.quad(), over @ transform.scaling(0.3), glowing((8.0, 6.0, 4.0))),
        ],
        camera((0, 1.5, 3), (0, 0.5, 0), 45),
        size,
        environment=0.2,
        **values,
    )


def patched(opened, **values):
    """Change parameters that no setting has."""
    params = opened.device.read(opened.buffers["params"])
    for name, value in values.items():
        params[name] = value
    opened.device.write(opened.buffers["params"], params)
    return opened


def one_cell(opened):
    """Make cells larger than any scene, without jitter."""
    return patched(opened, cell_width=1e30, cell_flags=0)


def image_of(opened, spp):
    try:
        opened.render(spp=spp)
        return opened.image()
    finally:
        opened.close()


def test_filter_that_is_off_leaves_nothing_behind():
    plan = make_plan(room(), Settings())
    assert plan.features["CELLS"].value == 0
    assert "cells" not in [stage.name for stage in plan.stages]
    assert dict(plan.left_out)["cells"] == "path_filter is off"
    pool = next(buffer for buffer in plan.buffers if buffer.name == "pool")
    assert pool.count == plan.traits.slots * len(layout.PATH_FIELDS)
    on = make_plan(room(), Settings(**FILTER))
    more = next(buffer for buffer in on.buffers if buffer.name == "pool")
    assert more.count == on.traits.slots * layout.path_field_count({"CELLS": 1})
    assert more.count > pool.count


@pytest.mark.parametrize("vertex", ["1", "2", "auto"])
@pytest.mark.parametrize("direct", [True, False])
def test_samples_with_cells_of_their_own_give_the_image_of_plain_path_tracing(
    device, vertex, direct
):
    expected = render(device, room((48, 32)), 8).rgb
    opened = renderer(
        device,
        room((48, 32)),
        **FILTER,
        filter_vertex=vertex,
        filter_direct=direct,
        cell_size=1.0,
        cell_jitter=False,
        cell_shrink=False,
    )
    identity = layout.CONSTANT["CELL_IDENTITY"]
    image = image_of(patched(opened, cell_flags=identity), 8)
    # A step of the sums is 1e-9 of the lamp's radiance; the light is divided and multiplied once.
    np.testing.assert_allclose(image.rgb, expected, rtol=1e-5, atol=1e-6)
    assert image.stats["cells"]["failed_inserts"] == image.stats["cells"]["rejected_cells"] == 0
    stored = image.stats["cells"]["cells_per_pass"]
    assert stored > 50


def test_one_cell_for_all_gives_the_mean_of_all_that_falls_on_a_plane(device):
    """A square under a sky of 1: every pixel of it shows its mean radiance, here its albedo."""
    scene = build(
        [floor(50.0, lambertian((0.2, 0.5, 0.8)))],
        camera((0, 2, 0.001), (0, 0, 0), 40),
        (16, 16),
        environment=1.0,
    )
    # Without shadow rays the sky is all that is found: each sample is the albedo.
    settings = {"direct_sampling": "bsdf"}
    opened = renderer(device, scene, **FILTER, **settings, filter_vertex="1")
    image = image_of(one_cell(opened), 1)
    mean = image.rgb.mean(axis=(0, 1))
    # All pixels have the same value, and it is the mean of the unfiltered image.
    np.testing.assert_allclose(image.rgb, np.broadcast_to(mean, image.rgb.shape), rtol=1e-5)
    plain = render(device, scene, 1, **settings)
    np.testing.assert_allclose(mean, plain.rgb.mean(axis=(0, 1)), rtol=1e-5)
    np.testing.assert_allclose(mean, (0.2, 0.5, 0.8), rtol=1e-4)


def test_one_cell_for_all_shows_the_mean_of_a_lit_plane_times_its_texture(device):
    """Two squares of different albedo share the light that falls on them."""
    right = transform.translation((1, 0, 0))
    left = transform.translation((-1, 0, 0))
    over = transform.translation((-1.5, 1.0, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    scene = build(
        [
            (primitives.quad(), right, lambertian((0.1, 0.2, 0.9))),
            (primitives.quad(), left, lambertian((0.8, 0.4, 0.2))),
            (primitives.quad(), over @ transform.scaling(0.2), glowing(10.0)),
        ],
        camera((0, 6, 0.001), (0, 0, 0), 12),
        (32, 32),
    )
    opened = renderer(device, scene, ["albedo"], **FILTER, filter_vertex="1")
    image = image_of(one_cell(opened), 4)
    plain = render(device, scene, 4, ["albedo"])
    seen = plain.aovs["albedo"].min(axis=-1) > 0.05
    edge = (image.aovs["albedo"].max(axis=-1) > 0.85) & seen
    light = plain.rgb[seen] / plain.aovs["albedo"][seen]
    shared = image.rgb[seen] / image.aovs["albedo"][seen]
    assert edge.any() and light.std() > 0.3 * light.mean()
    # Within a pass all light is equal; the means of four passes are those of plain path tracing.
    np.testing.assert_allclose(
        shared, np.broadcast_to(shared.mean(axis=0), shared.shape), rtol=1e-4
    )
    np.testing.assert_allclose(shared.mean(axis=0), light.mean(axis=0), rtol=1e-4)


def plane_of_cells(device, outputs=()):
    """Render a plane without jitter and with edges of one level: squares that NumPy tells apart.

    Returns:
        image; for the pixels that see the plane: a mask in the order of the queue, that order, the
        numbers of their cells, their light behind the plane (n, 3) and what the plane lets through.
    """
    lamp = transform.translation((0.3, 0.5, 0.2)) @ transform.rotation_xyz_degrees((180, 0, 0))
    scene = build(
        [
            floor(1.0, lambertian((0.5, 0.6, 0.7))),
            (primitives.quad(), lamp @ transform.scaling(0.1), glowing(10.0)),
        ],
        # So far away that all paths are of about the same length: 200 m.
        camera((0, 200, 0.001), (0, 0, 0), 0.6),
        (48, 48),
    )
    settings = {**FILTER, "filter_vertex": "1", "cell_jitter": False, "cell_shrink": False}
    settings["cell_walls"] = False
    opened = patched(renderer(device, scene, outputs, **settings), cell_width=0.25 / 199.99)
    opened.render(spp=1)
    image, order = opened.image(), opened.order
    beyond, vertices = (
        opened.device.read(opened.buffers[name])[: len(order)] for name in ("beyond", "vertices")
    )
    opened.close()
    low = beyond["vertex"] & layout.CONSTANT["VERTEX_MASK"] == 1
    low &= np.abs(vertices["p"][:, 1]) < 1e-3
    assert low.sum() > 1500
    gate = vertices["gate"][low].astype(np.float64)
    np.testing.assert_allclose(gate, np.broadcast_to((0.5, 0.6, 0.7), gate.shape), rtol=1e-6)
    places = vertices["p"][low].astype(np.float64) / 0.25 + (0.37, 0.61, 0.83)
    near = beyond["vertex"][low, None] >> 31
    cell = np.unique(np.hstack([np.floor(places), near]), axis=0, return_inverse=True)[1].ravel()
    assert cell.max() > 40
    return image, low, order, cell, beyond["radiance"][low] / gate, gate


def test_a_plane_equals_a_model_of_its_cells(device):
    image, low, order, cell, light, gate = plane_of_cells(device)
    sums = np.zeros((cell.max() + 1, 3))
    np.add.at(sums, cell, light)
    expected = (sums / np.bincount(cell)[:, None])[cell] * gate
    # Lengths differ by 1e-4: a few samples are in cells of the next level, or look there.
    pixels = image.rgb.reshape(-1, 3)[order][low]
    found = np.isclose(pixels, expected, rtol=1e-4, atol=1e-5).all(axis=1)
    assert found.mean() > 0.97
    assert expected.std() > 0.3 * expected.mean()


def test_images_of_cells_equal_a_model_of_them(device):
    image, low, order, cell, light, _ = plane_of_cells(device, VIEWS)

    def seen(name):
        return image.aovs[name].reshape(len(order), -1)[order][low]

    count = np.bincount(cell)
    luminance = light @ LUMINANCE
    mean = np.bincount(cell, luminance) / count
    variance = np.bincount(cell, luminance**2) / count - mean**2
    assert (seen("filter_weight") == 1).all()
    assert (seen("cell_count")[:, 0] == count[cell]).mean() > 0.97
    close = np.isclose(seen("cell_variance")[:, 0], variance[cell], rtol=1e-3, atol=1e-5)
    assert close.mean() > 0.97 and variance.max() > 1e-3
    # Colours tell cells apart, and nothing else does.
    colors = np.unique(np.hstack([seen("cells"), cell[:, None]]), axis=0)
    assert cell.max() < len(colors) < 1.2 * cell.max()
    assert len(np.unique(colors[:, :3], axis=0)) > 0.95 * len(colors)
    occupancy = seen("occupancy")
    assert ((occupancy >= 1 / 64) & (occupancy <= 1)).all()
    np.testing.assert_array_equal(occupancy * 64, np.round(occupancy * 64))


def test_images_of_cells_are_empty_without_cells(device):
    image = render(device, room(), 2, VIEWS)
    for name in VIEWS:
        assert not image.aovs[name].any(), name
    opened = renderer(device, room(), VIEWS, **FILTER, filter_vertex="1", cell_size=0.001)
    image = image_of(patched(opened, cell_slots=1), 2)
    assert not any(image.aovs[name].any() for name in ("cells", "cell_count", "filter_weight"))


def test_images_of_cells_change_no_bit_of_the_picture(device):
    plain = render(device, room(), 3, **FILTER, filter_vertex="1")
    viewed = render(device, room(), 3, VIEWS, **FILTER, filter_vertex="1")
    np.testing.assert_array_equal(viewed.rgb, plain.rgb)
    weight = viewed.aovs["filter_weight"]
    assert weight.max() == 1 and (weight <= 1).all()


@pytest.mark.parametrize("slots", [1, 64])
def test_tables_that_are_too_small_fall_back_to_plain_path_tracing(device, slots):
    expected = render(device, room(), 4).rgb
    opened = renderer(device, room(), **FILTER, filter_vertex="1", cell_size=0.001)
    image = image_of(patched(opened, cell_slots=slots), 4)
    assert image.stats["cells"]["failed_inserts"] > 0
    np.testing.assert_allclose(image.rgb, expected, rtol=1e-5, atol=1e-6)


def test_same_bits_for_any_pool_and_steps_with_the_filter(device):
    settings = {**FILTER, "cell_size": 4.0}
    truth = render(device, room(), 24, ["variance"], **settings)
    for slots in (128, 1024):
        small = open_device(traits=replace(device.traits, slots=slots))
        image = render(small, room(), 24, ["variance"], **settings)
        assert image.rgb.tobytes() == truth.rgb.tobytes()
        assert image.aovs["variance"].tobytes() == truth.aovs["variance"].tobytes()
    opened = renderer(device, room(), ["variance"], **settings)
    for _ in range(24):
        opened.step()
        opened.snapshot()
    image = image_of(opened, 24)
    assert image.rgb.tobytes() == truth.rgb.tobytes()


def test_same_bits_where_the_table_is_half_full_of_holes(device):
    """Buckets overflow in some passes: what happens there must not depend on the order."""
    images = []
    for slots in (128, 1024, device.traits.slots):
        pool = open_device(traits=replace(device.traits, slots=slots))
        opened = renderer(pool, room((64, 64)), **FILTER, filter_vertex="1", cell_size=1.0)
        image = image_of(patched(opened, cell_slots=256), 6)
        assert 0 < image.stats["cells"]["failed_inserts"]
        assert image.stats["cells"]["unfiltered_samples"] < 6 * 64 * 64
        images.append(image.rgb.tobytes())
    assert images[0] == images[1] == images[2]


@pytest.mark.slow
@pytest.mark.parametrize(("one", "other"), [(1, 16), (8, 16)])
def test_lane_widths_agree_with_the_filter(device, one, other):
    def image(lanes):
        traits = replace(device.traits, lanes=lanes, block=max(lanes, 8), slots=512)
        settings = {**FILTER, "cell_size": 4.0}
        return render(open_device(traits=traits), room(), 16, (), **settings).rgb

    narrow, wide = image(one), image(other)
    # A point that rounding moves into the next cell has another average: a few pixels may differ.
    close = np.isclose(wide, narrow, rtol=1e-4, atol=1e-6).all(axis=-1)
    assert close.mean() > 0.97
    np.testing.assert_allclose(wide.mean(axis=(0, 1)), narrow.mean(axis=(0, 1)), rtol=1e-3)


def test_an_interrupted_first_pass_shows_what_it_has(device):
    """Nothing is averaged yet: the image is that of plain path tracing, interrupted alike."""
    small = open_device(traits=replace(device.traits, slots=128))
    opened = renderer(small, room((64, 64)), ["samples"], **FILTER, filter_vertex="1")
    done = np.zeros(1)
    while not done.any():
        opened.scheduler.bounces = 1
        opened.render(spp=1, progress=lambda now: False)
        image = opened.image()
        done = image.aovs["samples"][..., 0] > 0
    assert opened.scheduler.passes == 0 and 0.01 < done.mean() < 1
    expected = render(device, room((64, 64)), 1).rgb
    np.testing.assert_allclose(image.rgb[done], expected[done], rtol=1e-5, atol=1e-6)
    opened.render(spp=1)
    whole = opened.image().rgb
    opened.close()
    again = render(device, room((64, 64)), 1, **FILTER, filter_vertex="1").rgb
    np.testing.assert_array_equal(whole, again)


def shiny(size=(48, 32)):
    """Return the room with coats, metal and glass in it."""
    over = transform.translation((0.5, 2.0, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))

    def ball(x):
        return transform.translation((x, 0.4, 0)) @ transform.scaling(0.4)

    return build(
        [
            floor(3.0, Material(base_color=(0.7, 0.5, 0.3), roughness=0.3)),
            (primitives.sphere(12, 8), ball(-0.9), Material(metallic=0.6, roughness=0.2)),
            (primitives.sphere(12, 8), ball(0.0), Material(transmission=0.7, roughness=0.1)),
            (primitives.sphere(12, 8), ball(0.9), lambertian((0.2, 0.3, 0.9))),
            (primitives.quad(), over @ transform.scaling(0.3), glowing((8.0, 6.0, 4.0))),
        ],
        camera((0, 1.5, 3), (0, 0.5, 0), 45),
        size,
        environment=0.2,
    )


@pytest.mark.parametrize("vertex", ["1", pytest.param("2", marks=pytest.mark.slow), "auto"])
@pytest.mark.parametrize("direct", [True, False, "sky"])
def test_only_what_the_base_reflects_is_shared_and_all_of_it_arrives(device, vertex, direct):
    expected = render(device, shiny(), 8).rgb
    share = {"filter_direct": direct is True, "filter_sky": direct == "sky"}
    settings = {"filter_vertex": vertex, **share, "cell_size": 1.0}
    opened = renderer(device, shiny(), **FILTER, **settings)
    assert opened.plan.features["CELLS"].value == 2
    identity = layout.CONSTANT["CELL_IDENTITY"]
    image = image_of(patched(opened, cell_flags=identity), 8)
    # Colours are divided and multiplied once more than where all light is shared.
    np.testing.assert_allclose(image.rgb, expected, rtol=2e-5, atol=2e-6)
    assert image.stats["cells"]["cells_per_pass"] > 50


def under_a_sky(environment):
    """Return a matt box on a floor that only the sky lights."""
    box = transform.translation((0, 0.4, 0)) @ transform.scaling(0.4)
    parts = [floor(3.0, lambertian(0.7)), (primitives.box(), box, lambertian((0.3, 0.6, 0.8)))]
    scene = build(parts, camera((0, 1.5, 3), (0, 0.5, 0), 45), (48, 32))
    return replace(scene, environment=environment)


def test_an_even_sky_is_shared_as_all_direct_light_is(device):
    image = np.random.default_rng(1).random((8, 16, 3), np.float32)
    scene = under_a_sky(Environment((0.5, 0.6, 0.8), image))
    ways = {**FILTER, "filter_vertex": "1"}
    sky = render(device, scene, 4, **ways, filter_direct=False, filter_sky=True).rgb
    everything = render(device, scene, 4, **ways, filter_direct=True).rgb
    nothing = render(device, scene, 4, **ways, filter_direct=False).rgb
    np.testing.assert_array_equal(sky, everything)
    assert np.abs(sky - nothing).mean() > 0.01


def test_light_of_the_sun_is_no_sky_s(device):
    """Of a sky that is black but for a spot only what a look-up finds of its edge is even."""
    image = np.zeros((64, 128, 3), np.float32)
    image[16:18, 60:62] = 1000.0
    scene = under_a_sky(Environment((1.0, 1.0, 1.0), image))
    ways = {**FILTER, "filter_vertex": "1"}
    sky = render(device, scene, 4, **ways, filter_direct=False, filter_sky=True).rgb
    everything = render(device, scene, 4, **ways, filter_direct=True).rgb
    nothing = render(device, scene, 4, **ways, filter_direct=False).rgb
    assert np.abs(sky - nothing).mean() < 0.1 * np.abs(everything - nothing).mean()


def test_a_mirror_image_stays_sharp_under_the_filter(device):
    """A metal has no diffuse base: nothing of it is shared, whatever the size of cells."""
    scene = build(
        [floor(3.0, Material(base_color=(0.9, 0.8, 0.7), metallic=1.0, roughness=0.2))],
        camera((0, 1.5, 3), (0, 0.5, 0), 45),
        (24, 16),
        environment=Environment((1, 1, 1), np.random.default_rng(1).random((8, 16, 3), np.float32)),
    )
    filtered = render(device, scene, 4, **FILTER, filter_vertex="1", cell_size=64.0)
    assert filtered.stats["cells"]["cells_per_pass"] == 0
    np.testing.assert_array_equal(filtered.rgb, render(device, scene, 4).rgb)


def test_a_slit_under_a_plate_stays_dark(device):
    """Floor that little light reaches: the open floor beside it must not light it up as much."""
    plate = transform.translation((0, 0.05, 0)) @ transform.scaling((0.5, 0.02, 0.5))
    scene = build(
        [floor(3.0, lambertian(0.5)), (primitives.box(), plate, lambertian(0.5))],
        camera((0, 0.04, 3), (0, 0.02, 0), 12),
        (64, 64),
        environment=1.0,
    )
    truth = render(device, scene, 256).rgb.mean(axis=-1)
    slit = truth < 0.1 * truth.max()
    assert slit.sum() > 50
    bias = {}
    for near in (False, True):
        # No shadow rays: paths themselves find the plate or the sky, near or far.
        settings = {**FILTER, "cell_near": near, "direct_sampling": "bsdf", "cell_size": 64.0}
        settings |= {"filter_vertex": "1", "cell_walls": False}
        bias[near] = render(device, scene, 16, (), **settings).rgb.mean(axis=-1)[slit].mean()
        bias[near] -= truth[slit].mean()
    assert bias[False] > 0.03 and abs(bias[True]) < 0.25 * bias[False], bias


def test_a_lit_plane_is_flat_across_levels(device):
    """A floor that runs away from the camera, under a sky of 1: its albedo, whatever the level."""
    scene = build(
        [floor(200.0, lambertian((0.2, 0.5, 0.8)))],
        camera((0, 2, 150), (0, 0, 140), 40),
        (48, 64),
        environment=1.0,
    )
    # Independent samples of the sky by shadow rays: noise that is known to be the same everywhere.
    settings = {"direct_sampling": "light", "sampler": "random"}
    shared = {**FILTER, "filter_vertex": "1", "cell_shrink": False, "cell_size": 8.0}
    albedo = np.array((0.2, 0.5, 0.8))
    plain = render(device, scene, 4, **settings).rgb[24:].mean(axis=1) / albedo
    image = render(device, scene, 4, **settings, **shared).rgb[24:] / albedo
    rows = image.mean(axis=(1, 2))
    noise = plain[:, 0].std()
    # Distances along the floor grow by 8: three levels.  Each row is as bright as it should be.
    np.testing.assert_allclose(rows, 1.0, atol=6 * noise)
    assert 0 < image.std() < plain.std() * np.sqrt(48)


def test_cells_with_few_samples_give_way_to_wider_ones(device):
    """Most cells of two pixels have less than eight samples."""
    names = ["cell_count", "filter_weight"]
    settings = {**FILTER, "filter_vertex": "1", "cell_size": 2.0}

    def view(**more):
        image = render(device, room((48, 32)), 4, names, **settings, **more)
        used = image.aovs["filter_weight"] == 1
        assert used.mean() > 0.5
        return image.rgb.mean(), image.aovs["cell_count"][used]

    mean, counts = view()
    wide_mean, wide_counts = view(cell_min_count=8)
    assert (counts < 8).mean() > 0.5
    assert np.median(wide_counts) > 1.5 * np.median(counts)
    np.testing.assert_allclose(wide_mean, mean, rtol=0.01)
    small = open_device(traits=replace(device.traits, slots=128))
    again = render(small, room((48, 32)), 4, names, **settings, cell_min_count=8)
    assert again.rgb.mean() == wide_mean


def test_wider_cells_cost_nothing_where_nobody_asks_for_them():
    def names(**settings):
        return {b.name for b in make_plan(room(), Settings(**FILTER, **settings)).buffers}

    assert "crowds" not in names() | names(cell_min_count=1)
    assert "crowds" in names(cell_min_count=2)


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "x"])
def test_cells_without_size_are_refused(value):
    with pytest.raises(InputError, match=r"cell_size must be"):
        Settings().with_values({"cell_size": value})


def test_switches_and_numbered_choices_are_read_from_text_and_files():
    settings = Settings().with_values({"filter_direct": "false", "filter_vertex": 2})
    assert settings.filter_direct is False and settings.filter_vertex == "2"
    for values in ({"filter_direct": "maybe"}, {"filter_direct": 1}, {"filter_vertex": 0}):
        with pytest.raises(InputError):
            Settings().with_values(values)


@pytest.mark.parametrize("vertex", ["1", "2"])
def test_all_sides_of_a_room_of_few_cells_find_room_near_where_probing_starts(device, vertex):
    scene = load_scene(CORNELL_BOX, size=(64, 64))
    opened = renderer(device, scene, **preset_values("psf") | {"filter_vertex": vertex})
    opened.render(spp=1)
    cells = opened.stats()["cells"]
    opened.close()
    assert cells["cells_per_pass"] > 200
    assert cells["failed_inserts"] == cells["unfiltered_samples"] == 0
    assert 1.0 <= cells["mean_probes"] < 2.0
