"""Mirrors and clear glass: lights are not sampled for them, nothing that they show is filtered."""

from __future__ import annotations

import numpy as np
import pytest
from scene_builder import build, camera, floor, glowing, grey, lambertian, render

from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Material

MIRROR = Material(base_color=grey(0.9), metallic=1.0, roughness=0.0)
GLASS = Material(base_color=grey(1.0), transmission=1.0, roughness=0.0)


def still_life(*materials, light=None, environment=0.0, size=(24, 24)):
    """Return spheres side by side, seen from the front, under a lamp of ``light``."""
    places = np.linspace(-1.2, 1.2, len(materials)) if len(materials) > 1 else [0.0]
    parts = [
        (
            primitives.sphere(),
            transform.translation((x, 0, 0)) @ transform.scaling(0.9 / len(materials)),
            material,
        )
        for x, material in zip(places, materials, strict=True)
    ]
    if light is not None:
        lamp = transform.translation((0, 3, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
        parts.append((primitives.quad(), lamp, light))
    return build(parts, camera((0, 0.5, 5), (0, 0, 0), 30), size, environment=environment)


def test_a_mirror_under_a_sky_has_no_noise_and_no_shadow_rays(device):
    image = render(device, still_life(MIRROR, environment=1.0), 1)
    assert image.stats["rays"]["shadow"] == 0
    assert image.stats["rays"]["bounce"] > 50
    middle = image.rgb[8:16, 8:16]
    # Schlick's reflectance of the angles in the middle of the sphere; only that varies.
    assert 0.899 < middle.min() <= middle.max() < 0.91


@pytest.mark.slow
@pytest.mark.parametrize("cell_size", [16.0, 1e-3])
def test_nothing_that_others_know_changes_what_mirrors_and_glass_show(device, cell_size):
    light = glowing(20.0)
    scene = still_life(MIRROR, GLASS, light=light, environment=0.3)
    plain = render(device, scene, 8, max_depth=8)
    everything = render(
        device,
        scene,
        8,
        max_depth=8,
        path_filter="hash_grid",
        cell_size=cell_size,
        screen_filter="path_space",
        light_sampling="photon",
    )
    np.testing.assert_array_equal(everything.rgb, plain.rgb)
    assert plain.stats["rays"]["shadow"] == 0 == everything.stats["rays"]["shadow"]


@pytest.mark.slow
def test_the_guide_keeps_no_cell_for_mirrors_and_glass(device):
    matt = lambertian(0.5)
    images = [
        render(device, still_life(*materials, environment=0.3), 8, guiding="learned")
        for materials in ((MIRROR, GLASS), (matt, GLASS))
    ]
    cells = [image.stats["guide"]["cells"] for image in images]
    assert cells[0] == 0 < cells[1]


@pytest.mark.slow
def test_the_radiance_cache_knows_no_cell_of_mirrors_and_glass(device):
    matt = lambertian(0.5)
    known = [
        render(device, still_life(*materials, environment=0.3), 64, termination="cache")
        for materials in ((MIRROR, GLASS), (matt, GLASS))
    ]
    cells = [image.stats["cache"]["known_cells"] for image in known]
    assert cells[0] == 0 < cells[1]


@pytest.mark.parametrize("material", [MIRROR, GLASS], ids=["mirror", "glass"])
def test_all_ways_to_light_a_room_agree_on_what_is_seen_in_it(device, material):
    """Sampling lights alone must not lose the lamp that a mirror shows."""
    white = lambertian(0.6)
    ball = primitives.sphere(), transform.translation((0, 1, 0)), material
    lamp = transform.translation((0, 3, 1)) @ transform.rotation_xyz_degrees((180, 0, 0))
    parts = [floor(4, white), ball, (primitives.quad(), lamp, glowing(5.0))]
    scene = build(parts, camera((0, 2.5, 5), (0, 1, 0), 40), (16, 16))
    images = {
        way: render(device, scene, 1024, max_depth=3, direct_sampling=way).rgb
        for way in ("mis", "light", "bsdf")
    }
    for way in ("mis", "light"):
        assert images[way].mean() == pytest.approx(images["bsdf"].mean(), rel=0.015)
