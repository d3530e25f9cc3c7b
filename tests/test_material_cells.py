"""The parameter cloud: textures behind the first surface, looked up once a cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_builder import build, camera, floor, glowing, lambertian, render, renderer
from test_texture_levels import FINE, wall_over

from psf_cl.device import layout
from psf_cl.device.device import open_device
from psf_cl.device.program import load_program
from psf_cl.errors import InputError
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Texture
from psf_cl.settings import Settings

CACHE = {"material_cache": "hash_grid"}
STRIPES = np.full((1, 16, 4), 255, np.uint8)
STRIPES[:, ::2, :3] = (40, 120, 200)
#: Half a meter each on the floor: wider than cells.
WIDE = Texture("wide", STRIPES, srgb=False, filter="nearest")


def room(texture=WIDE, size=(24, 16)):
    """Return a shining box over a floor with a texture, and a glossy one: paths of many bounces."""
    over = transform.translation((0, 2.5, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    box = transform.translation((0, 0.5, 0)) @ transform.scaling(0.5)
    metal = replace(lambertian(0.9), metallic=1.0, roughness=0.6, metallic_roughness_texture=0)
    return build(
        [
            (floor(4.0, lambertian(0.8, base_color_texture=0))),
            (primitives.box(), box, replace(metal, base_color_texture=0)),
            (primitives.quad(), over @ transform.scaling(0.5), glowing((8.0, 6.0, 4.0))),
        ],
        camera((0, 1.5, 3.5), (0, 0.5, 0), 45),
        size,
        environment=0.3,
        textures=(texture,),
    )


def test_a_cache_without_textures_is_left_out_and_the_plan_says_why():
    plain = wall_over(lambertian(0.5))
    for scene, settings, why in (
        (room(), Settings(), "material_cache is off"),
        (room(), Settings(max_depth=0, **CACHE), "max_depth is 0"),
        (plain, Settings(**CACHE), "no material has a texture of its base colour"),
    ):
        plan = make_plan(scene, settings)
        assert why in dict(plan.left_out)["material_cells"]
        assert not plan.in_epochs and "material_keys" not in {b.name for b in plan.buffers}
    plan = make_plan(room(), Settings(**CACHE))
    assert plan.in_epochs and "material_cells" in [stage.name for stage in plan.stages]
    with pytest.raises(InputError, match="metropolis needs material_cache=off"):
        make_plan(room(), Settings(integrator="metropolis", **CACHE))


def test_a_texture_of_one_colour_gives_the_image_without_cells(device):
    even = Texture("even", np.full((4, 4, 4), (200, 130, 77, 255), np.uint8))
    expected = render(device, room(even), 64).rgb
    image = render(device, room(even), 64, **CACHE, material_cell_size=16.0)
    np.testing.assert_allclose(image.rgb, expected, rtol=1e-4, atol=1e-5)
    assert image.stats["materials"]["known_cells"] > 10
    assert image.stats["materials"]["failed_inserts"] == 0


def test_light_of_a_fine_texture_is_that_of_its_mean(device):
    """A cell holds thousands of checks, and is known by 16: paths are those of the even floor."""
    ways = {"max_depth": 2, "roulette_depth": 8}
    fine = wall_over(lambertian(1.0, base_color_texture=0), (FINE,))

    def second_half(scene, **settings):
        opened = renderer(device, scene, **ways, **settings)
        opened.render(spp=256)
        before = opened.image().rgb
        opened.render(spp=512)
        image = 2.0 * opened.image().rgb - before
        opened.close()
        return image

    even = second_half(wall_over(lambertian(0.5)))
    cells = second_half(fine, **CACHE, material_cell_size=40.0)
    assert cells.mean() == pytest.approx(even.mean(), rel=0.01)
    assert np.abs(cells - even).mean() < 0.5 * np.abs(second_half(fine) - even).mean()


def test_what_is_seen_first_keeps_its_texels(device):
    images = [render(device, room(), 4, max_depth=1, **ways).rgb for ways in ({}, CACHE)]
    # Its lamp is met at the second vertex, which reflects nothing any more.
    np.testing.assert_array_equal(*images)


def test_known_cells_are_means_of_what_was_stored_and_stay(device):
    rng = np.random.default_rng(5)
    params = np.zeros(1, layout.PARAMS.dtype)
    params["material_slots"] = count = 256
    sums = np.zeros(count, layout.MATERIAL_SUM.dtype)
    sums["count"] = rng.integers(0, 2, count) * rng.integers(0, 64, count)
    whole = (rng.random((count, 5)) * sums["count"][:, None] * 2.0**24).astype(np.uint64)
    sums["low"], sums["high"] = whole & np.uint64(0xFFFFFFFF), whole >> np.uint64(32)
    cells = np.zeros(count, layout.MATERIAL_CELL.dtype)
    cells["visits"][::5], cells["color"][::5] = 7, 0.25
    before = cells.copy()
    keys = rng.integers(0, 2, count).astype(np.uint32)
    full = np.array([0, 1, 0, 0], np.uint32)
    buffers = {
        "params": params,
        "material_keys": keys,
        "material_full": full,
        "material_sums": sums,
        "material_cells": cells,
    }
    held = {name: device.upload(name, array) for name, array in buffers.items()}
    flags = make_plan(room(), Settings(**CACHE)).features
    defines = {name: 0 for name in flags} | {"W": 1, "BLOCK": 1, "RUN": 1}
    load_program(device, "material_cells.cl", defines).bind("freeze_materials", **held)(count)
    got = device.read(held["material_cells"])
    device.release(*held.values())
    new = (keys != 0) & (np.repeat(full, 64) == 0) & (before["visits"] == 0) & (sums["count"] >= 16)
    assert 20 < new.sum() < 120
    np.testing.assert_array_equal(got[~new], before[~new])
    means = whole / 2.0**24 / np.maximum(sums["count"], 1)[:, None]
    values = np.column_stack([got["color"], got["roughness"], got["metallic"]])
    np.testing.assert_allclose(values[new], means[new], rtol=1e-6)
    np.testing.assert_array_equal(got["visits"][new], sums["count"][new])


def test_same_bits_for_any_pool(device):
    truth = render(device, room(), 40, **CACHE).rgb
    assert not np.array_equal(truth, render(device, room(), 40).rgb)
    for slots in (128, 1024):
        small = open_device(traits=replace(device.traits, slots=slots))
        assert render(small, room(), 40, **CACHE).rgb.tobytes() == truth.tobytes()
