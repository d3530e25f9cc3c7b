"""What the film hands out: sums that do not stall, and the AOVs."""

from __future__ import annotations

import numpy as np
import pytest
from scene_builder import (
    IDENTITY,
    LUMINANCE,
    build,
    camera,
    film_points,
    floor,
    floor_points,
    glowing,
    lambertian,
    render,
)

from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Light, Material, Texture

SIZE = (8, 8)


@pytest.mark.parametrize("radiance", [1 / 3, 1e-7, 3e6])
def test_a_million_equal_samples_have_their_value_as_mean(device, radiance):
    scene = build(
        [(primitives.quad(), IDENTITY, glowing((radiance, 1.0, 0.1)))],
        camera((0, 2, 0.1), (0, 0, 0), 20),
        (1, 1),
    )
    image = render(device, scene, 1 << 20, ["samples", "variance"], max_depth=0)
    truth = np.float32([radiance, 1.0, 0.1])
    np.testing.assert_allclose(image.rgb[0, 0], truth, rtol=1e-6)
    assert image.aovs["samples"][0, 0, 0] == 1 << 20


def test_a_million_samples_of_a_million_to_one_keep_the_small_ones(device):
    # Red and green count the samples of the two lights, blue adds up their radiance.
    left, right = transform.translation((-1, 0, 0)), transform.translation((1.2, 0, 0))
    quad = primitives.quad()
    scene = build(
        [(quad, left, glowing((1, 0, 1e6))), (quad, right, glowing((0, 1, 1)))],
        camera((0.1, 2, 0), (0.1, 0, 0), 20, up=(0, 0, -1)),
        (1, 1),
    )
    image = render(device, scene, 1 << 20, max_depth=0)
    red, green, blue = image.rgb[0, 0].astype(np.float64)
    assert 0.3 < red < 0.4 and 0.3 < green < 0.4
    np.testing.assert_allclose(blue, red * 1e6 + green, rtol=1e-6)


def test_depth_normal_and_albedo_are_those_of_the_first_surface(device):
    view = camera((0.4, 0.5, 1.0), (0.5, 0.0, -0.2), 22)
    scene = build([floor(20.0, lambertian((0.8, 0.5, 0.2)))], view, SIZE, environment=1.0)
    image = render(device, scene, 256, ["albedo", "normal", "depth"])
    np.testing.assert_allclose(
        image.aovs["albedo"], np.broadcast_to(np.float32([0.8, 0.5, 0.2]), (8, 8, 3)), rtol=1e-6
    )
    np.testing.assert_allclose(image.aovs["normal"][..., 1], 1.0, rtol=1e-6)
    np.testing.assert_allclose(image.aovs["normal"][..., [0, 2]], 0.0, atol=1e-6)
    distances = np.linalg.norm(
        floor_points(view, SIZE, sub=16) - view.transform[:3, 3], axis=-1
    ).mean(axis=-1)
    np.testing.assert_allclose(image.aovs["depth"][..., 0], distances, rtol=1e-3)


def test_normals_are_smooth_and_face_the_camera(device):
    view = camera((0, 0, 5), (0, 0, 0), 12)
    scene = build([(primitives.sphere(), IDENTITY, lambertian(0.5))], view, SIZE, environment=1.0)
    image = render(device, scene, 64, ["normal"])
    origin, directions = film_points(view, SIZE, sub=8)
    along = -(directions @ origin)
    distance = along - np.sqrt(along**2 - origin @ origin + 1)
    points = origin + distance[..., None] * directions
    np.testing.assert_allclose(image.aovs["normal"], points.mean(axis=2), atol=0.01)

    # From inside, the same sphere shows its normals turned round.
    inside = build(
        [(primitives.sphere(), IDENTITY, lambertian(0.5))],
        camera((0, 0, 0), (0, 0, -1), 12),
        SIZE,
        environment=1.0,
    )
    image = render(device, inside, 16, ["normal"])
    assert (image.aovs["normal"][..., 2] > 0.95).all()


def test_albedo_has_the_texture_in_it_and_sky_has_none(device):
    levels = np.array([[255, 188], [0, 51]], np.uint8)
    pixels = np.repeat(levels[..., None], 4, axis=-1)
    texture = Texture("levels", pixels, filter="nearest")
    material = lambertian((1.0, 0.5, 0.25), base_color_texture=0)
    # The square fills the middle half of a 4 x 4 picture.
    above = camera((0, 4, 0), (0, 0, 0), np.degrees(2 * np.arctan(0.5)), up=(0, 0, -1))
    scene = build(
        [(primitives.quad(), IDENTITY, material)],
        above,
        (4, 4),
        textures=[texture],
        environment=1.0,
    )
    image = render(device, scene, 16, ["albedo", "depth", "normal"])
    code = levels / 255.0
    linear = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    truth = np.zeros((4, 4, 3))
    truth[1:3, 1:3] = linear[..., None] * [1.0, 0.5, 0.25]
    np.testing.assert_allclose(image.aovs["albedo"], truth, rtol=1e-5)
    seen = truth.any(axis=-1)
    seen[2, 1] = True  # Black, but there.
    np.testing.assert_array_equal(image.aovs["depth"][..., 0] > 0, seen)
    np.testing.assert_array_equal(image.aovs["normal"].any(axis=-1), seen)


def test_depth_of_a_half_covered_pixel_is_that_of_the_covered_half(device):
    above = camera((1, 4, 0), (1, 0, 0), 1.0, up=(0, 0, -1))
    scene = build([(primitives.quad(), IDENTITY, lambertian(0.6))], above, (1, 1), environment=1.0)
    image = render(device, scene, 1024, ["depth", "albedo"])
    np.testing.assert_allclose(image.aovs["depth"], 4.0, rtol=1e-3)
    np.testing.assert_allclose(image.aovs["albedo"], 0.3, rtol=0.05)


def lit_room(size=SIZE):
    """Return walls in corners under an area light and a point light, seen so that light shows."""
    over = transform.translation((0, 1.9, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    wall = transform.translation((0, 1, -1)) @ transform.rotation_xyz_degrees((90, 0, 0))
    return build(
        [
            floor(2.0, lambertian((0.8, 0.6, 0.4))),
            (primitives.quad(), wall, Material(roughness=0.5)),
            (primitives.quad(), over @ transform.scaling(0.4), glowing(6.0)),
        ],
        camera((0, 1, 3), (0, 1, 0), 50),
        size,
        lights=[Light("point", (0.5, 0.5, 1.5), position=(0.5, 1.0, 0.5))],
        environment=0.2,
    )


def test_direct_is_what_one_bounce_brings_and_indirect_is_the_rest(device):
    image = render(device, lit_room(), 64, ["direct", "indirect"], max_depth=6, roulette_depth=50)
    one_bounce = render(device, lit_room(), 64, max_depth=1)
    np.testing.assert_allclose(image.aovs["direct"], one_bounce.rgb, rtol=1e-5)
    np.testing.assert_allclose(
        image.aovs["direct"] + image.aovs["indirect"], image.rgb, rtol=1e-5, atol=1e-6
    )
    assert image.aovs["indirect"].mean() > 0.03 * image.rgb.mean()
    assert image.aovs["indirect"].min() >= -1e-5 * image.rgb.max()


def test_bounces_are_those_of_the_paths(device):
    """In a closed room all paths have as many as they may; else the rays have been counted too."""
    box = (primitives.box(), transform.scaling(4.0), glowing(1.0, 0.5, double_sided=True))
    closed = build([box], camera((0, 0, 0.5), (0, 0, 0), 60), SIZE)
    image = render(device, closed, 4, ["bounces"], max_depth=3, termination="off")
    np.testing.assert_array_equal(image.aovs["bounces"], 3.0)
    scene = build([floor(2.0, lambertian(0.7)), box], camera((0, 0.4, 1), (0, 0, 0), 60), SIZE)
    image = render(device, scene, 16, ["bounces"])
    rays = image.stats["rays"]
    assert image.aovs["bounces"].std() > 0
    assert image.aovs["bounces"].mean() == pytest.approx(rays["bounce"] / rays["camera"], rel=1e-6)


@pytest.mark.parametrize("direct_sampling", ["light", "bsdf"])
def test_direct_does_not_hang_on_how_light_is_found(device, direct_sampling):
    image = render(
        device, lit_room(), 1024, ["direct"], max_depth=4, direct_sampling=direct_sampling
    )
    one_bounce = render(device, lit_room(), 1024, max_depth=1)
    np.testing.assert_allclose(image.aovs["direct"].mean(), one_bounce.rgb.mean(), rtol=0.01)


def test_variance_is_that_of_the_mean_over_independent_seeds(device):
    means, variances = [], []
    for seed in range(24):
        image = render(
            device, lit_room((16, 16)), 32, ["variance"], seed=seed, sampler="random", max_depth=2
        )
        means.append(image.rgb.astype(np.float64) @ LUMINANCE)
        variances.append(image.aovs["variance"][..., 0])
    ratio = np.mean(variances) / np.var(means, axis=0, ddof=1).mean()
    # 24 seeds of 256 pixels: a standard error of about sqrt(2 / 23 / 256), more for unequal pixels.
    assert abs(ratio - 1.0) < 0.1


def test_variance_of_one_sample_is_not_known_and_of_equal_samples_is_zero(device):
    scene = build([floor(1.0, glowing(0.7))], camera((0, 2, 0.1), (0, 0, 0), 10), SIZE)
    for spp in (1, 64):
        image = render(device, scene, spp, ["variance"], max_depth=0)
        np.testing.assert_allclose(image.aovs["variance"], 0.0, atol=1e-12)


def under_a_light(radiance):
    over = transform.translation((0, 0.5, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    return build(
        [floor(2.0, lambertian(1.0)), (primitives.quad(), over, glowing(radiance))],
        camera((0, 0.2, 1.5), (0, 0, 0), 20),
        SIZE,
    )


def test_light_too_strong_for_sums_is_left_out_and_counted(device):
    image = render(device, under_a_light(3e38), 64, ["variance", "direct"], max_depth=8)
    assert all(np.isfinite(pixels).all() for pixels in image.aovs.values())
    assert image.stats["counters"]["rejected_samples"] > 0


@pytest.mark.parametrize("radiance", [1e-25, 1e25])
def test_scale_of_the_light_does_not_show_in_its_picture(device, radiance):
    image = render(device, under_a_light(radiance), 64, ["variance"], max_depth=8)
    truth = render(device, under_a_light(1.0), 64, max_depth=8)
    assert all(np.isfinite(pixels).all() for pixels in image.aovs.values())
    assert image.stats["counters"]["rejected_samples"] == 0
    np.testing.assert_allclose(image.rgb / np.float32(radiance), truth.rgb, rtol=1e-4)
