"""The estimators against truth: closed forms, quadrature in NumPy, and each other.

Where noise is left, a test takes ``sampler = random``, whose samples are independent, so that the
variance AOV gives honest error bars, and asks for less than Z_LIMIT standard errors: about one
false alarm in 10^6 comparisons.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scene_builder import (
    IDENTITY,
    LUMINANCE,
    build,
    camera,
    film_points,
    flat,
    floor,
    floor_points,
    glowing,
    lambertian,
    luminance_blocks,
    render,
    renderer,
    z_scores,
)

from psf_cl.scene import primitives, transform
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Environment, Light, Material, Texture

Z_LIMIT = 5.0
CORNELL_BOX = Path(__file__).resolve().parents[1] / "scenes" / "cornell_box.toml"
COLOR = np.array([0.8, 0.5, 0.2])

MIRRORED = transform.scaling((-1, 1, 1))
SQUASHED = transform.rotation_xyz_degrees((20, 70, -40)) @ transform.scaling((1.5, -0.7, 1.1))

# One bounce on a Lambertian floor: radiance is reflectance / pi times an irradiance of known form.

SIZE = (8, 8)
# Below the lights, and all of it below the horizon: nothing but the floor is in the picture.
VIEW = camera((0.4, 0.5, 1.0), (0.5, 0.0, -0.2), 22)


def floor_radiance(irradiance):
    """Return the pixels' radiance for a function from floor points ``(..., 3)`` to irradiance."""
    return irradiance(floor_points(VIEW, SIZE, sub=16)).mean(axis=-1)[..., None] * COLOR / np.pi


def on_floor(parts=(), **values):
    return build([floor(20.0, lambertian(COLOR)), *parts], VIEW, SIZE, **values)


def point_irradiance(points, position):
    to_light = np.asarray(position) - points
    distance2 = (to_light**2).sum(axis=-1)
    return to_light[..., 1] / distance2**1.5, distance2


def test_point_light_falls_off_with_the_square_of_the_distance(device):
    light = Light("point", (3.0, 5.0, 7.0), position=(0.2, 1.5, 0.3))
    image = render(device, on_floor(lights=[light]), 256, max_depth=1)
    truth = floor_radiance(lambda p: point_irradiance(p, light.position)[0]) * light.intensity
    np.testing.assert_allclose(image.rgb, truth, rtol=2e-3)


def test_range_fades_a_light_out_by_the_window_of_khr_lights_punctual(device):
    light = Light("point", (5.0, 5.0, 5.0), position=(0.4, 1.5, 0.0), range=1.7)

    def irradiance(points):
        falling, distance2 = point_irradiance(points, light.position)
        return falling * np.clip(1.0 - (distance2 / light.range**2) ** 2, 0.0, 1.0) * 5.0

    truth = floor_radiance(irradiance)
    assert (truth == 0.0).any() and (truth > 0.0).any()
    image = render(device, on_floor(lights=[light]), 1024, max_depth=1)
    np.testing.assert_allclose(image.rgb, truth, rtol=5e-3, atol=2e-4 * truth.max())


def test_spot_light_has_a_cone_with_a_smooth_rim(device):
    direction = np.array([0.3, -1.0, -0.2]) / np.linalg.norm([0.3, -1.0, -0.2])
    light = Light(
        "spot",
        (4.0, 4.0, 4.0),
        position=(0.1, 1.5, 0.2),
        direction=tuple(direction),
        inner_angle=np.radians(10),
        outer_angle=np.radians(25),
    )

    def irradiance(points):
        falling, distance2 = point_irradiance(points, light.position)
        cosine = ((points - light.position) @ direction) / np.sqrt(distance2)
        ramp = (cosine - np.cos(light.outer_angle)) / (
            np.cos(light.inner_angle) - np.cos(light.outer_angle)
        )
        return falling * np.clip(ramp, 0.0, 1.0) ** 2 * 4.0

    truth = floor_radiance(irradiance)
    assert (truth == 0.0).any() and (truth > 0.0).any()
    image = render(device, on_floor(lights=[light]), 1024, max_depth=1)
    np.testing.assert_allclose(image.rgb, truth, rtol=5e-3, atol=2e-4 * truth.max())


def test_directional_light_has_lux_on_a_plane_that_faces_it(device):
    direction = np.array([0.6, -0.8, 0.0])
    light = Light("directional", (2.0, 3.0, 4.0), direction=tuple(direction))
    image = render(device, on_floor(lights=[light]), 4, max_depth=1)
    truth = COLOR / np.pi * 0.8 * light.intensity
    np.testing.assert_allclose(image.rgb, np.broadcast_to(truth, image.rgb.shape), rtol=1e-5)


def test_light_under_the_floor_does_not_reach_its_upper_side(device):
    light = Light("point", (100.0,) * 3, position=(0.2, -0.5, 0.3))
    assert not render(device, on_floor(lights=[light]), 16, max_depth=8).rgb.any()


def test_shadow_of_an_occluder_is_black_and_sharp(device):
    light = Light("point", (5.0,) * 3, position=(0.5, 4.0, -0.2))
    screen = transform.translation((0.5, 2.0, -0.2)) @ transform.scaling(0.1)
    scene = on_floor([(primitives.quad(), screen, lambertian(0.0))], lights=[light])

    def shadowed(points):
        # Half-way between floor and light: the shadow is twice as large as the screen.
        return (np.abs(points[..., [0, 2]] - [0.5, -0.2]) < 0.2).all(axis=-1)

    def irradiance(points):
        return np.where(shadowed(points), 0.0, 5.0 * point_irradiance(points, light.position)[0])

    truth = floor_radiance(irradiance)
    # The corners of the pixels, and not the samples, decide which pixels have one part only.
    share = shadowed(floor_points(VIEW, SIZE, sub=64)).mean(axis=-1)
    assert (share == 1.0).any()
    image = render(device, scene, 1024, max_depth=1)
    # Pixels on the rim: the share of their samples in the shadow is known to about 2 %.
    np.testing.assert_allclose(image.rgb, truth, rtol=2e-3, atol=0.02 * truth.max())
    clear = (share == 0.0) | (share == 1.0)
    np.testing.assert_allclose(image.rgb[clear], truth[clear], rtol=2e-3)


def polygon_irradiance(points, corners):
    """Return the irradiance on a plane facing +Y under a polygon of radiance 1 above it.

    Lambert's formula: half the sum over the edges of the angle they span, times the component along
    the normal of the unit vector across that angle.  Its sign is that of the polygon's winding.
    """
    total = 0.0
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        to_a = (a - points) / np.linalg.norm(a - points, axis=-1, keepdims=True)
        to_b = (b - points) / np.linalg.norm(b - points, axis=-1, keepdims=True)
        across = np.cross(to_a, to_b)
        length = np.linalg.norm(across, axis=-1)
        total = total + np.arctan2(length, (to_a * to_b).sum(axis=-1)) * across[..., 1] / length
    return np.abs(total) / 2


def assert_floor(device, parts, irradiance, precision, spp=1024, textures=(), **settings):
    """Check the picture of a floor under area lights; ``precision`` bounds its noise."""
    truth = floor_radiance(irradiance) @ LUMINANCE
    scene = on_floor(parts, textures=textures)
    image = render(device, scene, spp, ["variance"], max_depth=1, sampler="random", **settings)
    error = image.rgb @ LUMINANCE - truth
    noise = np.sqrt(image.aovs["variance"][..., 0])
    assert (np.abs(error) < Z_LIMIT * noise + 1e-4 * truth.max()).all()
    assert noise.mean() < precision * truth.mean()
    # Errors of one sign add up over the picture, noise does not.
    assert abs(error.sum()) < Z_LIMIT * np.sqrt((noise**2).sum()) + 1e-4 * truth.sum()


TILTED = (
    transform.translation((0.1, 0.9, -0.3))
    @ transform.rotation_xyz_degrees((150, 20, 0))
    @ transform.scaling((0.5, 1.0, 0.3))
)
TILTED_CORNERS = transform.transform_points(TILTED, primitives.quad().positions)


@pytest.mark.parametrize("direct_sampling", ["mis", "light", "bsdf"])
@pytest.mark.parametrize("mirror", [1, -1], ids=["", "mirrored"])
def test_rectangular_light_follows_lamberts_polygon_formula(device, direct_sampling, mirror):
    matrix = TILTED @ transform.scaling((mirror, 1, 1))
    assert_floor(
        device,
        [(primitives.quad(), matrix, glowing(5.0))],
        lambda points: 5.0 * polygon_irradiance(points, TILTED_CORNERS),
        precision=0.15,
        direct_sampling=direct_sampling,
    )


@pytest.mark.parametrize("direct_sampling", ["mis", "light", "bsdf"])
def test_back_of_a_light_is_dark_unless_both_sides_emit(device, direct_sampling):
    turned = TILTED @ transform.rotation_xyz_degrees((180, 0, 0))
    mesh = primitives.quad()
    one_sided = on_floor([(mesh, turned, glowing(5.0))])
    image = render(device, one_sided, 64, max_depth=1, direct_sampling=direct_sampling)
    assert not image.rgb.any()
    assert_floor(
        device,
        [(mesh, turned, glowing(5.0, double_sided=True))],
        lambda points: 5.0 * polygon_irradiance(points, TILTED_CORNERS),
        precision=0.15,
        direct_sampling=direct_sampling,
    )


@pytest.mark.parametrize("height", [2.0, -2.0], ids=["front", "back"])
@pytest.mark.parametrize("double_sided", [False, True])
@pytest.mark.parametrize("matrix", [IDENTITY, MIRRORED], ids=["", "mirrored"])
def test_emission_is_seen_on_the_front_and_on_both_sides_if_asked_for(
    device, height, double_sided, matrix
):
    light = glowing((1.0, 2.0, 3.0), double_sided=double_sided)
    view = camera((0, height, 0.1), (0, 0, 0), 20)
    image = render(device, build([(primitives.quad(), matrix, light)], view), 2, max_depth=0)
    truth = (1.0, 2.0, 3.0) if height > 0 or double_sided else (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(image.rgb, np.broadcast_to(np.float32(truth), image.rgb.shape))


def test_spherical_light_acts_as_from_its_centre(device):
    # pi L sin^2 cos: Nicodemus, for a sphere wholly above the horizon.
    centre, radius = np.array([0.3, 1.3, -0.2]), 0.25
    ball = primitives.sphere(64, 32)
    matrix = transform.translation(centre) @ transform.scaling(radius)

    def irradiance(points):
        falling, _ = point_irradiance(points, centre)
        # The mesh lies inside the sphere: its mean cross-section is a quarter of its area (Cauchy).
        return 7.0 * falling * mesh_area(flat(ball)) / 4.0 * radius**2

    assert_floor(device, [(ball, matrix, glowing(7.0))], irradiance, precision=0.06)


def mesh_area(mesh):
    a, b, c = (mesh.positions[mesh.triangles[:, i]].astype(np.float64) for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def test_disk_light_follows_its_closed_form(device):
    # Configuration factor of a parallel disk from a point off its axis: Howell, catalog, B-13.
    centre, radius = np.array([0.2, 1.1, 0.1]), 0.6
    matrix = (
        transform.translation(centre)
        @ transform.rotation_xyz_degrees((180, 0, 0))
        @ transform.scaling(radius)
    )

    def irradiance(points):
        h2 = (centre[1] / radius) ** 2
        a2 = ((points - centre)[..., [0, 2]] ** 2).sum(axis=-1) / radius**2
        z = 1 + h2 + a2
        return 3.0 * np.pi / 2 * (1 - (h2 + a2 - 1) / np.sqrt(z**2 - 4 * a2))

    part = (primitives.disk(512), matrix, glowing(3.0))
    assert_floor(device, [part], irradiance, precision=0.02, direct_sampling="light")


LEVELS = np.array([[255, 102], [0, 51]])
LEVELS_TEXTURE = Texture(
    "levels",
    np.repeat(LEVELS[..., None], 4, axis=-1).astype(np.uint8),
    srgb=False,
    filter="nearest",
)


@pytest.mark.parametrize("direct_sampling", ["mis", "light", "bsdf"])
def test_emissive_texture_scales_the_light_of_each_part(device, direct_sampling):
    def irradiance(points):
        total = 0.0
        for row, column in np.ndindex(2, 2):
            # On the unit quad u grows with x and v with z.
            shift = np.array([column - 0.5, 0.0, row - 0.5])
            corners = primitives.quad().positions * 0.5 + shift
            quarter = transform.transform_points(TILTED, corners)
            total = total + LEVELS[row, column] / 255.0 * polygon_irradiance(points, quarter)
        return 5.0 * total

    assert_floor(
        device,
        [(primitives.quad(), TILTED, glowing(5.0, emission_texture=0))],
        irradiance,
        precision=0.15,
        textures=[LEVELS_TEXTURE],
        direct_sampling=direct_sampling,
    )


def test_emissive_texture_is_seen_where_it_lies(device):
    above = camera((0, 4, 0), (0, 0, 0), np.degrees(2 * np.arctan(0.25)), up=(0, 0, -1))
    part = (primitives.quad(), IDENTITY, glowing(5.0, emission_texture=0))
    image = render(device, build([part], above, (2, 2), textures=[LEVELS_TEXTURE]), 4, max_depth=0)
    np.testing.assert_allclose(image.rgb[..., 0], 5.0 * LEVELS / 255.0, rtol=1e-6)


# The environment: what a direction sees, and what it sends to a floor.


def sky_image():
    """Return a smooth lat-long image with a bright spot, ``(12, 24, 3)``."""
    row, column = np.mgrid[0:12, 0:24]
    image = np.stack(
        [1 + row / 12, 1 + np.cos(column / 24 * 2 * np.pi), 2 - row / 12], axis=-1
    ).astype(np.float32)
    image[3, 5] = 30.0
    return image


def sky_radiance(environment, directions):
    """Return the bilinear look-up that model.Environment describes, for world ``(..., 3)``."""
    x, y, z = np.moveaxis(directions @ environment.rotation, -1, 0)
    height, width = environment.image.shape[:2]
    u = np.arctan2(x, -z) / (2 * np.pi) % 1.0 * width - 0.5
    v = np.arccos(np.clip(y, -1, 1)) / np.pi * height - 0.5
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    fu, fv = (u - i)[..., None], (v - j)[..., None]
    rows = [np.clip(j + k, 0, height - 1) for k in (0, 1)]
    columns = [(i + k) % width for k in (0, 1)]
    image = environment.image.astype(np.float64)
    upper = image[rows[0], columns[0]] * (1 - fu) + image[rows[0], columns[1]] * fu
    lower = image[rows[1], columns[0]] * (1 - fu) + image[rows[1], columns[1]] * fu
    return (upper * (1 - fv) + lower * fv) * environment.radiance


SKY = Environment(
    (0.5, 1.0, 2.0), sky_image(), transform.rotation_xyz_degrees((40, 100, -20))[:3, :3]
)
SPECK = (primitives.quad(), transform.translation((0, -50, 0)), lambertian(0.0))


@pytest.mark.parametrize("rotated", [False, True])
@pytest.mark.parametrize("target", [(1, 0.2, 0.3), (-1, -0.4, -0.8), (0, 1, 0.01), (0.01, 0.1, -1)])
def test_camera_sees_the_environment_in_the_direction_of_its_pixels(device, target, rotated):
    sky = SKY if rotated else dataclasses.replace(SKY, rotation=np.eye(3))
    view = camera((0, 0, 0), target, 60)
    image = render(device, build([SPECK], view, SIZE, environment=sky), 1024, max_depth=0)
    _, directions = film_points(view, SIZE, sub=16)
    truth = sky_radiance(sky, directions).mean(axis=2)
    np.testing.assert_allclose(image.rgb, truth, rtol=0.02)
    np.testing.assert_allclose(image.rgb.mean(), truth.mean(), rtol=1e-3)


@pytest.mark.parametrize("direct_sampling", ["mis", "light", "bsdf"])
def test_environment_image_lights_a_floor_as_its_integral_says(device, direct_sampling):
    scene = on_floor(environment=SKY)
    image = render(
        device,
        scene,
        1024,
        ["variance"],
        max_depth=1,
        sampler="random",
        direct_sampling=direct_sampling,
    )
    height, azimuth = np.meshgrid((np.arange(1000) + 0.5) / 1000, np.arange(2000) / 1000 * np.pi)
    # Uniform in the square of the cosine: cosine-weighted directions of equal weight.
    sine = np.sqrt(1 - height)
    up = np.stack([sine * np.cos(azimuth), np.sqrt(height), sine * np.sin(azimuth)], axis=-1)
    truth = sky_radiance(SKY, up).mean(axis=(0, 1)) * COLOR
    z = z_scores(image, truth @ LUMINANCE, 2)
    assert np.abs(z).max() < Z_LIMIT
    np.testing.assert_allclose(image.rgb.mean(axis=(0, 1)), truth, rtol=0.02)
    assert np.sqrt(luminance_blocks(image, 1)[1]) < 0.005 * (truth @ LUMINANCE)


# Estimators against each other: what no closed form covers.


def varied_scene():
    """Return area lights, a sky image and a point light over glossy and matt things."""
    quad, ball, lift = primitives.quad(), primitives.sphere(24, 12), transform.translation
    plastic = Material(base_color=(0.6, 0.3, 0.2), roughness=0.5)
    metal = Material(base_color=(0.9, 0.8, 0.5), metallic=1.0, roughness=0.4)
    over = transform.rotation_xyz_degrees((180, 0, 0))
    return build(
        [
            floor(4.0, plastic),
            (ball, lift((-0.7, 0.6, 0.0)) @ transform.scaling(0.6), metal),
            (primitives.box(), lift((0.7, 0.4, -0.2)) @ transform.scaling(0.4), lambertian(0.7)),
            (quad, lift((0.0, 2.5, -0.5)) @ over @ transform.scaling(0.5), glowing(3.0)),
            (quad, lift((1.2, 1.5, 0.8)) @ over @ transform.scaling(0.1), glowing((9, 30, 9))),
            (quad, lift((-2, 1.5, 0)) @ transform.scaling(0.3), glowing(4.0, double_sided=True)),
        ],
        camera((0, 1.6, 3.2), (0, 0.5, 0), 40),
        (16, 16),
        lights=[Light("point", (1.0, 1.0, 3.0), position=(0.3, 1.2, 1.0))],
        environment=dataclasses.replace(SKY, radiance=(0.05, 0.05, 0.05)),
    )


VARIED = {"max_depth": 4, "roulette_depth": 2, "sampler": "random"}


@pytest.fixture(scope="module")
def varied_reference(device):
    return render(device, varied_scene(), 2048, ["variance"], seed=1, **VARIED)


@pytest.mark.parametrize(
    "settings",
    [
        {"light_sampling": "uniform"},
        {"direct_sampling": "light"},
        {"direct_sampling": "light", "light_sampling": "uniform"},
        {"direct_sampling": "bsdf"},
        {"termination": "off"},
        {"termination": "off", "sampler": "sobol"},
        {"roulette_depth": 0},
        {"roulette_depth": 0, "sampler": "sobol"},
        {"sampler": "sobol"},
    ],
    ids=lambda settings: " ".join(f"{value}" for value in settings.values()),
)
def test_estimators_agree_within_their_confidence_intervals(device, varied_reference, settings):
    image = render(device, varied_scene(), 1024, ["variance"], seed=2, **(VARIED | settings))
    z = z_scores(image, varied_reference, 4)
    assert np.abs(z).max() < Z_LIMIT
    # Errors of one sign add up over the picture; sobol's are smaller than its variance AOV says.
    whole = z_scores(image, varied_reference, 1)
    assert np.abs(whole).max() < 4.0
    mean, variance = luminance_blocks(image, 1)
    assert np.sqrt(variance) < 0.01 * mean


def test_confidence_intervals_would_show_a_bias_of_three_percent(device, varied_reference):
    image = render(device, varied_scene(), 1024, ["variance"], seed=3, **VARIED)
    image.aovs["rgb"] *= 1.03
    assert np.abs(z_scores(image, varied_reference, 1)).max() > Z_LIMIT


# The camera's lens.


def lens_scene(distance, half_size, **lens):
    """Return a small light at ``distance`` before the camera, ``lens`` as in model.Camera."""
    place = transform.translation((0, 0, -distance)) @ transform.rotation_xyz_degrees((90, 0, 0))
    part = (primitives.quad(), place @ transform.scaling(half_size), glowing(1.0))
    return build([part], camera((0, 0, 0), (0, 0, -1), 10, **lens), (16, 16))


@pytest.mark.parametrize("distance", [1.2, 3.0])
def test_small_light_out_of_focus_becomes_its_circle_of_confusion(device, distance):
    focus, radius, half_size = 2.0, 0.1, 0.02
    scene = lens_scene(distance, half_size, lens_radius=radius, focus_distance=focus)
    image = render(device, scene, 4096, ["variance"], max_depth=0, sampler="random")

    # From a point of the film's image in the focal plane through every point of the lens.
    rng = np.random.default_rng(1)
    count = 20_000
    half_film = focus * np.tan(np.radians(5))
    truth = np.zeros((16, 16))
    for row, column in np.ndindex(16, 16):
        x = ((column + rng.random(count)) / 8 - 1) * half_film
        y = (1 - (row + rng.random(count)) / 8) * half_film
        angle, r = rng.random(count) * 2 * np.pi, radius * np.sqrt(rng.random(count))
        share = distance / focus
        hit_x = r * np.cos(angle) * (1 - share) + x * share
        hit_y = r * np.sin(angle) * (1 - share) + y * share
        truth[row, column] = (np.maximum(np.abs(hit_x), np.abs(hit_y)) < half_size).mean()
    variance = truth * (1 - truth) * (1 / 4096 + 1 / count)
    assert (np.abs(image.rgb[..., 0] - truth) < Z_LIMIT * np.sqrt(variance) + 2e-3).all()

    # What the lens spreads is where the circle of confusion says, and nowhere else.
    blur = radius * abs(1 - focus / distance)
    size = half_size * focus / distance
    centre = (np.arange(16) + 0.5) / 8 - 1
    away = np.hypot(*np.meshgrid(centre, centre)) * half_film
    pixel = half_film / 8
    assert not image.rgb[away > blur + (size + pixel) * np.sqrt(2)].any()
    assert image.rgb[away < blur - (size + pixel) * np.sqrt(2)].all()


def test_parallel_rays_see_everything_in_its_own_size(device):
    # A film 2 m high and 16 pixels wide and high: the light covers 8 x 8 of them at any distance.
    for distance in (1.0, 50.0):
        scene = lens_scene(distance, 0.5, height=2.0)
        image = render(device, scene, 4, max_depth=0).rgb[..., 0]
        expected = np.zeros((16, 16))
        expected[4:12, 4:12] = image.max()
        assert image.max() > 0
        np.testing.assert_allclose(image, expected)


def test_lens_leaves_what_is_in_focus_sharp(device):
    sharp = render(device, lens_scene(2.0, 0.05), 256, max_depth=0)
    scene = lens_scene(2.0, 0.05, lens_radius=0.3, focus_distance=2.0)
    through_lens = render(device, scene, 256, max_depth=0)
    np.testing.assert_allclose(through_lens.rgb, sharp.rgb, atol=0.01)


# Convergence.


def relative_errors(device, scene, reference, noise, spps, **settings):
    """Return relMSE at each of ``spps``, without the part that is the reference's ``noise``."""
    opened = renderer(device, scene, **settings)
    errors = []
    for spp in spps:
        opened.render(spp=spp)
        square = ((opened.snapshot().rgb.astype(np.float64) - reference) @ LUMINANCE) ** 2 - noise
        errors.append(
            (square / ((reference @ LUMINANCE) ** 2 + 0.01 * reference.mean() ** 2)).mean()
        )
    opened.close()
    return np.array(errors)


def convergence(device, size, reference_spp, spps, seeds, **settings):
    """Return relMSE over ``spps`` of the samplers ``random`` and ``sobol`` on the Cornell box."""
    scene = dataclasses.replace(load_scene(CORNELL_BOX), width=size, height=size)
    reference = render(
        device, scene, reference_spp, ["variance"], sampler="random", seed=99, **settings
    )
    truth = reference.rgb.astype(np.float64)
    noise = reference.aovs["variance"][..., 0].astype(np.float64)
    return {
        sampler: np.mean(
            [
                relative_errors(
                    device, scene, truth, noise, spps, sampler=sampler, seed=seed, **settings
                )
                for seed in range(seeds)
            ],
            axis=0,
        )
        for sampler in ("random", "sobol")
    }


def slope(spps, errors):
    return np.polyfit(np.log(spps), np.log(errors), 1)[0]


def test_error_falls_with_the_number_of_samples(device):
    spps = [16, 32, 64, 128, 256]
    errors = convergence(device, 24, 2048, spps, seeds=2, max_depth=3)
    assert abs(slope(spps, errors["random"]) + 1.0) < 0.1
    assert slope(spps, errors["sobol"]) < -0.9
    assert (errors["sobol"] < 1.05 * errors["random"]).all()


@pytest.mark.slow
def test_error_falls_with_the_number_of_samples_to_a_thousand(device):
    spps = [16, 32, 64, 128, 256, 512, 1024]
    errors = convergence(device, 48, 8192, spps, seeds=2)
    assert abs(slope(spps, errors["random"]) + 1.0) < 0.1
    assert slope(spps, errors["sobol"]) < -0.9
    assert (errors["sobol"] < 1.05 * errors["random"]).all()


@pytest.mark.parametrize("strategy", ["mis", "light", "bsdf"])
def test_holes_of_a_cut_out_emitter_give_no_light(device, strategy):
    """A quad of which a texture leaves the half x < 0 lights like the half alone."""
    pixels = np.full((2, 2, 4), 255, np.uint8)
    pixels[:, 1, 3] = 0
    holes = Texture("holes", pixels, wrap=("clamp", "clamp"), filter="nearest")
    down = transform.translation((0, 1, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    half = down @ transform.translation((-0.5, 0, 0)) @ transform.scaling((0.5, 1, 1))
    masked = glowing(3.0, alpha_mode="mask", base_color_texture=0)
    cut_out = on_floor([(primitives.quad(), down, masked)], textures=[holes])
    alone = on_floor([(primitives.quad(), half, glowing(3.0))])
    images = [
        render(
            device,
            scene,
            1024,
            ["variance"],
            sampler="random",
            max_depth=1,
            direct_sampling=strategy,
        )
        for scene in (cut_out, alone)
    ]
    assert np.abs(z_scores(*images, 2)).max() < Z_LIMIT
