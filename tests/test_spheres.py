"""Lights that are spheres: drawn by what is seen of them, densities included."""

from __future__ import annotations

import dataclasses

import numpy as np
import planes
import pytest
from scene_builder import (
    build,
    camera,
    floor,
    glowing,
    inside_out,
    lambertian,
    luminance_blocks,
    render,
)
from scipy import stats

from psf_cl import tables
from psf_cl.device import layout
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.settings import Settings

RADIUS = 0.5
CENTER = np.array([0.3, 1.0, -0.2])
TURN = transform.rotation_xyz_degrees((20, 50, -70))
PLACE = transform.translation(CENTER) @ TURN @ transform.scaling(RADIUS)

#: Distances from the center, in radii, from which the sphere is seen.
VIEWS = {
    "center": 0.0,
    "inside": 0.6,
    "touching": 1.0005,
    "close": 1.004,
    "near": 1.5,
    "room": 8.0,
    "far": 1e4,
}
#: Where to: along no axis of the mesh.
TOWARD = np.array([0.48, 0.6, 0.64])


def lamp(matrix=PLACE, **material):
    """Return a sphere that glows, and nothing else."""
    parts = [(primitives.sphere(), matrix, glowing(1.0, **material))]
    return build(parts, camera((0, 1, 5), (0, 1, 0)))


def table_of(scene):
    geometry = tables.flatten(scene)
    return geometry, tables.light_table(scene, geometry, "power", {"spheres"})


def drawn(device, name, u):
    """Return what sphere_test.cl makes of numbers ``(2, n)``."""
    lights = device.upload("lights", table_of(lamp())[1])
    point = CENTER + VIEWS[name] * RADIUS * TOWARD
    inputs = {
        "points": np.repeat(np.float32([point]).T, u.shape[1], axis=1),
        "random": u.astype(np.float32),
    }
    outputs = {
        "directions": (np.float32, 3),
        "densities": (np.float32, 1),
        "distances": (np.float32, 1),
        "normals": (np.float32, 3),
        "areas": (np.float32, 1),
    }
    defines = {"SPHERES": 1}
    found = planes.run(
        device, "sphere_test.cl", "draw_on_spheres", inputs, outputs, defines, lights=lights
    )
    device.release(lights)
    return [part.astype(np.float64) for part in found]


def grid(side):
    return (np.stack(np.meshgrid(*[np.arange(side)] * 2)).reshape(2, -1) + 0.5) / side


@pytest.mark.parametrize("name", VIEWS)
def test_points_of_a_sphere_follow_their_density(lane_device, name):
    """Chi-square of directions at the center, against the formula of the cone in float64."""
    rng = np.random.default_rng(3)
    n, density, *_ = drawn(lane_device, name, rng.random((2, 1 << 15)))
    distance = VIEWS[name]
    cosine = TOWARD @ n
    across = np.cross(TOWARD, (0.0, 1.0, 0.0))
    across /= np.linalg.norm(across)
    turns = np.arctan2(np.cross(TOWARD, across) @ n, across @ n) / (2 * np.pi) + 0.5

    def part_seen(c):
        """Return the chance of directions with a cosine above ``c``."""
        all_around = (1 - c) / 2
        if distance <= 1.001:
            return all_around
        # Of the cone, what lies within the angle at which the point at c is seen.
        edge = np.maximum(c, 1 / distance)
        gap = np.stack([distance - edge, np.sqrt(1 - edge * edge)])
        angle = np.arctan2(gap[1], gap[0])
        inside = np.sin(angle / 2) ** 2 / np.sin(np.arcsin(1 / distance) / 2) ** 2
        return all_around / 16 + inside * 15 / 16

    edges = np.quantile(cosine, np.linspace(0, 1, 17))
    edges[[0, -1]] = -1, 1
    # Edges from the samples would fit them too well: these are rounded.
    edges[1:-1] = np.round(edges[1:-1], 2 if distance < 1.01 else 3)
    edges = np.unique(edges)
    share = -np.diff(part_seen(edges))
    counts, _, _ = np.histogram2d(cosine, turns, bins=(edges, np.linspace(0, 1, 9)))
    expected = np.repeat(share[:, None] / 8, 8, axis=1) * len(cosine)
    assert (expected > 5).all()
    score = ((counts - expected) ** 2 / expected).sum()
    assert stats.chi2.sf(score, counts.size - 1) > 1e-4
    # One over the density is the solid angle that a sample stands for: all of them, all around.
    weights = 1.0 / density
    error = weights.std() / np.sqrt(len(weights))
    assert abs(weights.mean() - 4 * np.pi) < 4.5 * error + 1e-4


def test_directions_from_the_center_name_points_of_the_mesh(lane_device):
    """Distance and normal are those of the triangle that the direction meets."""
    n, _, r, normals, _ = drawn(lane_device, "inside", grid(24))
    geometry, _ = table_of(lamp())
    surfaces = geometry.surfaces
    inward = ((surfaces["p0"] - CENTER) * surfaces["ng"]).sum(axis=1)
    # Of a convex mesh the nearest of all planes is the one that is met.
    facing = surfaces["ng"].astype(np.float64) @ n
    distance = np.where(facing > 1e-3, inward[:, None] / np.maximum(facing, 1e-3), np.inf)
    np.testing.assert_allclose(r, distance.min(axis=0), rtol=3e-6)
    nearest = surfaces["ng"][distance.argmin(axis=0)]
    on_an_edge = np.sort(distance, axis=0)[2] - r < 1e-5 * RADIUS
    agree = (nearest * normals.T).sum(axis=1)
    assert (agree[~on_an_edge] > 1 - 1e-6).all()
    assert on_an_edge.mean() < 0.02


@pytest.mark.parametrize("name", VIEWS)
def test_areas_of_samples_add_up_to_that_of_the_mesh(lane_device, name):
    *_, areas = drawn(lane_device, name, np.random.default_rng(5).random((2, 1 << 15)))
    surfaces = table_of(lamp())[0].surfaces
    whole = np.linalg.norm(np.cross(surfaces["e1"], surfaces["e2"]), axis=1).sum() / 2
    error = areas.std() / np.sqrt(len(areas))
    assert abs(areas.mean() - whole) < 4.5 * error + 1e-5
    assert error < 0.03 * whole


def test_a_sphere_is_one_light_that_all_its_triangles_name():
    geometry, lights = table_of(lamp())
    assert len(lights) == 1
    assert (geometry.surfaces["light"] == 0).all()
    light = lights[0]
    assert light["flags"] & layout.CONSTANT["LIGHT_SPHERE"]
    np.testing.assert_allclose(light["position"], CENTER, rtol=1e-6)
    # Power of a light in the tree is what it sends along its brightest direction: pi r^2 L.
    assert light["power"] == pytest.approx(np.pi * RADIUS**2, rel=0.01)
    assert len(tables.light_table(lamp(), geometry, "power")) == len(geometry.surfaces)


def test_only_what_is_round_and_glows_evenly_is_a_sphere():
    ball = primitives.sphere()
    squashed = transform.scaling((1, 0.5, 1))
    mirrored = transform.scaling((-2, 2, 2))
    for mesh, matrix, material, expected in (
        (ball, PLACE, glowing(1.0), 1),
        (ball, mirrored, glowing(1.0, double_sided=True), 1),
        (ball, squashed, glowing(1.0), 0),
        (inside_out(ball), PLACE, glowing(1.0), 0),
        (primitives.sphere(32, 16), PLACE, glowing(1.0), 0),
        (ball, PLACE, glowing(1.0, emission_texture=0), 0),
        (ball, PLACE, lambertian(1.0), 0),
    ):
        scene = build([(mesh, matrix, material)], camera((0, 2, 5), (0, 0, 0)))
        assert tables.count_whole_lights(scene, "spheres")[0] == expected


def test_the_plan_says_whether_there_are_spheres():
    found = make_plan(lamp(), Settings()).features["SPHERES"]
    assert found.value == 1 and found.reason.startswith("1 lights are spheres (3968 triangles)")
    left = make_plan(lamp(), Settings(area_sampling="area")).features["SPHERES"]
    assert (left.value, left.reason) == (0, "area_sampling is area")
    still = dataclasses.replace(lamp(), shapes=())
    assert make_plan(still, Settings()).features["SPHERES"].value == 0


def over_a_floor(height, radius, **material):
    """Return a floor under a glowing ball, seen from above, beside the ball."""
    matrix = transform.translation((0, height, 0)) @ TURN @ transform.scaling(radius)
    parts = [floor(20, lambertian(0.5)), (primitives.sphere(), matrix, glowing(1.0, **material))]
    size = 2 * radius
    view = camera((8 * size, 3 * size, 0), (0.75 * size, 0, 0), 6)
    return build(parts, view, (4, 4))


def test_ways_to_sample_a_sphere_agree_and_seen_ones_have_less_noise(device):
    """A floor just below a large lamp; variances are of one sample, over the mean squared."""
    scene = over_a_floor(1.0, 0.9)
    results = {}
    for name, settings in {
        "directions": {"direct_sampling": "bsdf"},
        "area": {"direct_sampling": "light", "area_sampling": "area"},
        "seen": {"direct_sampling": "light"},
        "both": {},
    }.items():
        image = render(device, scene, 1024, ["variance"], sampler="random", max_depth=1, **settings)
        means, variances = luminance_blocks(image, 1)
        results[name] = means.item(), variances.item()
    for name, (mean, variance) in results.items():
        truth, noise = results["both"]
        assert abs(mean - truth) < 4.5 * np.sqrt(variance + noise), name
        assert np.sqrt(variance) < 0.06 * mean, name
    assert results["seen"][1] < 0.2 * results["area"][1]


@pytest.mark.parametrize("radius", [1e-4, 1e3])
@pytest.mark.parametrize("height", [1.002, 3.0, 1e4])
def test_irradiance_below_a_sphere_is_that_of_its_disk(device, radius, height):
    """Equal pi L sin^2 below it (Nicodemus), however large, far or near it is."""
    matrix = transform.translation((0, height * radius, 0)) @ TURN @ transform.scaling(radius)
    patch = 1e-4 * radius
    white = (primitives.quad(), transform.scaling(patch), lambertian(1.0))
    view = camera((0, 5 * patch, 5 * patch), (0, 0, 0), 10)
    scene = build([white, (primitives.sphere(), matrix, glowing(1.0))], view, (8, 8))
    seen = render(device, scene, 256, max_depth=1).rgb.mean()
    # The mesh's mean cross-section is smaller than the sphere's by 0.4 %.
    assert seen == pytest.approx(1 / height**2, rel=0.01)
