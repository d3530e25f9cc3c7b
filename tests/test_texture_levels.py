"""Smaller textures for what paths meet behind the first surface."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scene_builder import IDENTITY, build, camera, floor, lambertian, render

from psf_cl import tables
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Texture
from psf_cl.scene.texture import decoded_srgb, smaller_levels
from psf_cl.settings import Settings

CHECKER = np.full((16, 16, 4), 255, np.uint8)
CHECKER[(np.indices((16, 16)).sum(axis=0) % 2) == 0, :3] = 0
#: Repeated so often that whatever is seen of it has many repetitions.
FINE = Texture("fine", CHECKER, srgb=False, transform=(1e4, 0.0, 0.0, 0.0, 1e4, 0.0))
FOOTPRINT = Settings(texture_level="footprint")


def wall_over(material, textures=(), size=(16, 8)):
    """Return a matt wall over a floor of ``material``, which is not seen, under a sky."""
    turn = transform.rotation_xyz_degrees((90, 0, 0))
    wall = primitives.quad(), transform.translation((0, 1, -1)) @ turn, lambertian(0.8)
    view = camera((0, 1, 2), (0, 1.2, -1), 25)
    return build([floor(4, material), wall], view, size, environment=1.0, textures=textures)


@pytest.mark.parametrize("srgb", [False, True])
@pytest.mark.parametrize("size", [(8, 8), (7, 5), (1, 6)])
def test_levels_are_means_of_linear_values(srgb, size):
    pixels = np.random.default_rng(1).integers(0, 256, (*size, 4)).astype(np.uint8)
    levels = smaller_levels(Texture("t", pixels, srgb))
    shapes = [level.shape[:2] for level in levels]
    assert shapes[-1] == (1, 1)
    for larger, smaller in zip([size, *shapes], shapes, strict=False):
        assert smaller == tuple(max(n // 2, 1) for n in larger)
    values = pixels / 255.0
    last = levels[-1][0, 0] / 255.0
    if srgb:
        values[..., :3], last[:3] = decoded_srgb(values[..., :3]), decoded_srgb(last[:3])
    np.testing.assert_allclose(last, values.mean(axis=(0, 1)), atol=0.006)


def test_the_plan_counts_the_texels_of_levels():
    material = lambertian(1.0, base_color_texture=0, normal_texture=1)
    normal = Texture("n", np.full((4, 4, 4), 128, np.uint8), srgb=False)
    scene = wall_over(material, (FINE, normal))
    assert tables.leveled_textures(scene) == [0]
    for settings, leveled in ((FOOTPRINT, [0]), (Settings(), [])):
        table, texels = tables.texture_tables(scene.textures, 4, leveled)
        sizes = {buffer.name: buffer.bytes for buffer in make_plan(scene, settings).buffers}
        assert sizes["texels"] == texels.size
        assert sizes["textures"] == table.nbytes
    table, texels = tables.texture_tables(scene.textures, 4, [0])
    assert table["smaller"].tolist() == [2, 0, 0, 0, 0, 0]
    assert table["width"].tolist() == [16, 4, 8, 4, 2, 1]
    last = texels[table["offset"][-1]]
    np.testing.assert_allclose(last, [128, 128, 128, 255], atol=1)


def test_densities_are_areas_over_areas():
    quad = primitives.quad()
    scene = build([(quad, transform.scaling(3.0), lambertian(1.0))], camera((0, 5, 5), (0, 0, 0)))
    geometry = tables.flatten(scene)
    # Coordinates from 0 to 1 on 6 m by 6 m.
    np.testing.assert_allclose(geometry.uvs["density"], 1.0 / 36.0, rtol=1e-6)
    flat = dataclasses.replace(quad, positions=quad.positions * np.float32([1, 1, 0]))
    scene = build([(flat, IDENTITY, lambertian(1.0))], camera((0, 5, 5), (0, 0, 0)))
    assert (tables.flatten(scene).uvs["density"] == 0.0).all()


def test_light_of_a_fine_texture_is_that_of_its_mean(device):
    """The same random numbers: pictures are equal up to the 8 bits of the mean."""
    fine = wall_over(lambertian(1.0, base_color_texture=0), (FINE,))
    ways = {"max_depth": 2, "roulette_depth": 8}
    leveled = render(device, fine, 16, texture_level="footprint", **ways).rgb
    even = render(device, wall_over(lambertian(128 / 255)), 16, **ways).rgb
    np.testing.assert_allclose(leveled, even, rtol=1e-3)
    full = render(device, fine, 16, **ways).rgb
    assert np.abs(full - even).mean() > 1e-3
    assert full.mean() == pytest.approx(even.mean(), rel=0.02)


def test_what_is_seen_first_keeps_its_texels(device):
    scene = wall_over(lambertian(1.0, base_color_texture=0), (FINE,))
    seen = dataclasses.replace(scene, cameras=(camera((0, 2, 2), (0, 0, 0), 40),))
    images = [
        render(device, seen, 4, max_depth=1, texture_level=way).rgb for way in ("full", "footprint")
    ]
    assert np.array_equal(*images)
    assert images[0].std() > 0.05


def test_a_coarse_texture_is_looked_up_as_it_is(device):
    """Texels of 4 m are larger than any footprint here."""
    pixels = np.random.default_rng(2).integers(0, 256, (2, 2, 4)).astype(np.uint8)
    scene = wall_over(lambertian(1.0, base_color_texture=0), (Texture("t", pixels),))
    ways = {"max_depth": 2, "roulette_depth": 8}
    images = [
        render(device, scene, 8, texture_level=way, **ways).rgb for way in ("full", "footprint")
    ]
    np.testing.assert_allclose(*images, rtol=1e-6)
