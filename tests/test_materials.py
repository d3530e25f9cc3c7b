"""What textures, colours of vertices and opacity do to a whole render, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scene_builder import IDENTITY, build, camera, grey, lambertian, render

from psf_cl.scene import transform
from psf_cl.scene.model import Environment, Light, Material, Mesh, Texture

FRONT = camera((0, 0, 4), (0, 0, 0), 20)


def quad(**attributes):
    """Return a square of 2 m in the plane z = 0 that faces +Z, u to the right, v downwards."""
    values = {"uvs": np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)} | attributes
    return Mesh(
        "quad",
        np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        **values,
    )


def uniform(color, **values):
    """Return a texture of one colour, given as 8-bit codes."""
    pixels = np.zeros((1, 1, 4), np.uint8)
    pixels[0, 0, : len(color)] = color
    return Texture("uniform", pixels, **values)


NORMAL_CODES = (160, 106, 240)
MAPPED = np.array(NORMAL_CODES) / 255 * 2 - 1


def expected_of_normal(normal, direction, lux=2.0, albedo=0.5):
    """Lambert: albedo / pi times lux times cosine."""
    return albedo / np.pi * lux * max(-np.dot(normal, direction) / np.linalg.norm(normal), 0)


MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
TURNED = transform.rotation_xyz_degrees((0, 0, 90))
LEFT = np.tile(np.array([[-1, 0, 0, -1]], np.float32), (4, 1))
MIRRORED_UVS = np.array([[1, 1], [0, 1], [0, 0], [1, 0]], np.float32)


@pytest.mark.parametrize(
    ("attributes", "matrix", "texture", "right", "up"),
    [
        ({}, IDENTITY, {}, (1, 0), (0, 1)),
        ({"uvs": MIRRORED_UVS}, IDENTITY, {}, (-1, 0), (0, 1)),
        ({}, MIRROR, {}, (-1, 0), (0, 1)),
        ({"uvs": MIRRORED_UVS}, MIRROR, {}, (1, 0), (0, 1)),
        ({}, TURNED, {}, (0, 1), (-1, 0)),
        # TANGENT says what u and v do not: to the left, and its sign makes it point upwards.
        ({"tangents": LEFT}, IDENTITY, {}, (-1, 0), (0, 1)),
        ({"tangents": LEFT}, MIRROR, {}, (1, 0), (0, 1)),
        # A texture that was turned by a quarter: its u grows where v did not.
        (
            {},
            IDENTITY,
            {"transform": transform.uv_rows((0, 0), np.pi / 2, (1, 1))},
            (0, -1),
            (1, 0),
        ),
        ({"uvs": None, "uvs1": MIRRORED_UVS}, IDENTITY, {"uv_set": 1}, (-1, 0), (0, 1)),
    ],
)
@pytest.mark.parametrize("scale", [1.0, -0.5])
def test_a_normal_map_turns_the_normal(device, attributes, matrix, texture, right, up, scale):
    direction = np.array([-0.3, -0.5, -0.8]) / np.linalg.norm([-0.3, -0.5, -0.8])
    material = lambertian(0.5, normal_texture=0, normal_scale=scale)
    scene = build(
        [(quad(**attributes), matrix, material)],
        FRONT,
        lights=[Light("directional", grey(2.0), direction=tuple(direction))],
        textures=[uniform(NORMAL_CODES, srgb=False, **texture)],
    )
    x, y, z = MAPPED * (scale, scale, 1)
    normal = [x * right[0] + y * up[0], x * right[1] + y * up[1], z]
    image = render(device, scene, 1, max_depth=1)
    np.testing.assert_allclose(image.rgb, expected_of_normal(normal, direction), rtol=1e-4)


def test_from_behind_a_bump_is_a_dent(device):
    direction = np.array([0.3, -0.4, 0.8]) / np.linalg.norm([0.3, -0.4, 0.8])
    scene = build(
        [(quad(), IDENTITY, lambertian(0.5, normal_texture=0))],
        camera((0, 0, -4), (0, 0, 0), 20),
        lights=[Light("directional", grey(2.0), direction=tuple(direction))],
        textures=[uniform(NORMAL_CODES, srgb=False)],
    )
    image = render(device, scene, 1, max_depth=1)
    np.testing.assert_allclose(image.rgb, expected_of_normal(-MAPPED, direction), rtol=1e-4)


def test_colours_of_vertices_are_interpolated_and_unlit_shows_them(device):
    rng = np.random.default_rng(1)
    corners = rng.random((4, 4)).astype(np.float32)
    material = Material(base_color=(0.5, 1.0, 0.25), unlit=True)
    scene = build([(quad(colors=corners), IDENTITY, material)], FRONT, environment=1.0)
    image = render(device, scene, 64).rgb
    # The view is 2 tan 10 degrees times 4 m high: pixel centres on the quad.
    half = 4 * np.tan(np.radians(10))
    at = ((np.arange(8) + 0.5) / 4 - 1) * half
    x, y = np.meshgrid((at + 1) / 2, (1 - at) / 2)
    zero = 0 * x
    lower = np.stack([1 - x, x - y, y, zero], axis=-1)
    upper = np.stack([1 - y, zero, x, y - x], axis=-1)
    weights = np.where((y <= x)[..., None], lower, upper)
    expected = (weights @ corners)[..., :3] * material.base_color
    off_diagonal = abs(x - y) > 0.13
    np.testing.assert_allclose(image[off_diagonal], expected[off_diagonal], atol=0.01)


def test_unlit_is_no_light(device):
    """It is seen, and may brighten others where rays find it, but is in no light table."""
    scene = build([(quad(), IDENTITY, Material(unlit=True))], FRONT, environment=1.0)
    with_light = render(device, scene, 4).rgb
    np.testing.assert_allclose(with_light, 0.8, rtol=1e-6)


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("textured", [False, True])
def test_blending_shows_as_much_as_alpha_says(device, alpha, textured):
    values = {"alpha": alpha}
    textures = []
    if textured:
        code = round(alpha * 255)
        values, alpha = {"base_color_texture": 0}, code / 255
        textures = [uniform((255, 255, 255, code))]
    material = lambertian(0.0, emission=grey(3.0), alpha_mode="blend", **values)
    scene = build([(quad(), IDENTITY, material)], FRONT, textures=textures, environment=1.0)
    samples = 512
    image = render(device, scene, samples, max_depth=0).rgb.astype(np.float64)
    deviation = 2 * np.sqrt(alpha * (1 - alpha) / samples / 64)
    assert abs(image.mean() - (3 * alpha + 1 - alpha)) < 4 * deviation + 1e-5
    # Pixels are independent of each other: their spread is that of a coin.
    assert abs(image[..., 0].std() - 8 * deviation) < 0.3 * 8 * deviation + 1e-5


def test_two_blended_sheets_are_chosen_independently(device):
    near = transform.translation((0, 0, 0.5))
    material = lambertian(0.0, alpha_mode="blend", alpha=0.5)
    parts = [(quad(), IDENTITY, material), (quad(), near, material)]
    image = render(device, build(parts, FRONT, environment=1.0), 1024, max_depth=0).rgb
    deviation = np.sqrt(0.25 * 0.75 / 1024 / 64)
    assert abs(image.mean() - 0.25) < 4 * deviation


@pytest.mark.parametrize("sampling", ["mis", "light", "bsdf"])
def test_a_blended_light_gives_its_share_and_casts_part_of_a_shadow(device, sampling):
    """A floor under a blended sheet that glows, below a sky: both estimators see the same."""
    facing_down = transform.translation((0, 1, 0)) @ transform.rotation_xyz_degrees((90, 0, 0))
    lamp = lambertian(0.0, emission=grey(4.0), alpha_mode="blend", alpha=0.25)
    floor = (quad(), transform.rotation_xyz_degrees((-90, 0, 0)), lambertian(0.5))
    view = camera((0, 0.5, 0.6), (0, 0, 0), 10)
    scene = build([floor, (quad(), facing_down, lamp)], view, environment=1.0)
    found = render(device, scene, 2048, max_depth=1, direct_sampling=sampling).rgb.mean()
    opaque = replace(lamp, alpha_mode="opaque", emission=grey(4.0 * 0.25 + 0.75))
    scene = build([floor, (quad(), facing_down, opaque)], view, environment=1.0)
    expected = render(device, scene, 2048, max_depth=1).rgb.mean()
    assert found == pytest.approx(expected, rel=0.01)


def test_blending_is_the_same_for_every_number_of_lanes(lane_device, device):
    material = lambertian(0.5, alpha_mode="blend", alpha=0.5)
    near = transform.translation((0, 0, 0.5))
    parts = [(quad(), IDENTITY, material), (quad(), near, material)]
    scene = build(parts, FRONT, environment=Environment(grey(1.0)))
    one, other = (render(opened, scene, 4).rgb for opened in (lane_device, device))
    np.testing.assert_allclose(one, other, rtol=1e-4)


def test_roughness_and_metalness_come_from_green_and_blue(device):
    """A texture of one colour is the same as factors."""
    texture = uniform((0, 128, 51, 255), srgb=False)
    mapped = Material(metallic=1.0, roughness=0.5, metallic_roughness_texture=0)
    plain = Material(metallic=51 / 255, roughness=0.5 * 128 / 255)
    sky = Environment(grey(1.0), np.linspace(0, 2, 4 * 8 * 3, dtype=np.float32).reshape(4, 8, 3))
    images = [
        render(
            device,
            build([(quad(), IDENTITY, m)], FRONT, textures=[texture], environment=sky),
            16,
        ).rgb
        for m in (mapped, plain)
    ]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4)


def test_a_texture_may_make_glass_of_a_metal(device):
    """Metalness 1 times a texture of 0, and transmission: the sky behind is seen."""
    glass = Material(
        base_color=(1.0, 1.0, 1.0),
        metallic=1.0,
        roughness=0.0,
        metallic_roughness_texture=0,
        transmission=1.0,
        thin_walled=True,
        ior=1.0,
    )
    textures = [uniform((0, 0, 0, 255), srgb=False)]
    scene = build([(quad(), IDENTITY, glass)], FRONT, textures=textures, environment=1.0)
    # A tenth of the samples goes to a reflection that is next to nothing.
    assert render(device, scene, 64).rgb.mean() == pytest.approx(1.0, abs=0.02)
