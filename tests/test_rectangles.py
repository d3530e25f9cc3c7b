"""Lights that are rectangles: drawn by the solid angle that they fill, densities included."""

from __future__ import annotations

import dataclasses

import numpy as np
import planes
import pytest
from scene_builder import IDENTITY, build, camera, floor, glowing, lambertian, render
from scipy import stats

from psf_cl import tables
from psf_cl.device import layout
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.settings import Settings

#: Where a rectangle of 2 m by 1 m with its corner at the origin, in the plane z = 0, is seen from.
VIEWS = {
    "near": (0.7, 0.4, 0.1),
    "above": (1.0, 0.5, 2.0),
    "beside": (2.8, 0.2, 0.8),
    "low": (-1.0, 0.5, 0.15),
    "corner": (-0.2, -0.3, 0.2),
    "behind": (1.5, 0.9, -0.6),
}


def solid_angle(x, y, point):
    """Return that of rectangles from ``x[..., 0]`` to ``x[..., 1]``, likewise ``y``, in z = 0."""
    px, py, pz = point
    total = 0.0
    for i in range(2):
        for j in range(2):
            a, b = x[..., i] - px, y[..., j] - py
            angle = np.arctan2(a * b, abs(pz) * np.sqrt(a * a + b * b + pz * pz))
            total = total + (1 if i == j else -1) * angle
    return total


def drawn(device, point, count=1 << 15):
    """Return parts ``(2, n)``, solid angles and nearness ``(n,)`` for stratified numbers."""
    side = int(np.sqrt(count))
    u = (np.stack(np.meshgrid(*[np.arange(side)] * 2)).reshape(2, -1) + 0.5) / side
    inputs = {
        "rectangle": np.repeat(np.float32([[0, 0, 0, 2, 0, 0, 0, 1, 0]]).T, u.shape[1], axis=1),
        "points": np.repeat(np.float32([point]).T, u.shape[1], axis=1),
        "random": u.astype(np.float32),
    }
    outputs = {"parts": (np.float32, 2), "solid": (np.float32, 1), "near": (np.uint32, 1)}
    kernel = "rectangle_test.cl", "draw_in_rectangle"
    return planes.run(device, *kernel, inputs, outputs, {"RECTANGLES": 1})


@pytest.mark.parametrize("name", VIEWS)
def test_directions_to_a_rectangle_are_uniform(lane_device, name):
    parts, solid, near = drawn(lane_device, VIEWS[name])
    whole = solid_angle(np.array([0.0, 2.0]), np.array([0.0, 1.0]), VIEWS[name])
    np.testing.assert_allclose(solid, whole, rtol=2e-5)
    assert (near == 1).all()
    # Numbers are on a grid: each of 8 x 8 parts of the rectangle has as many as it takes up.
    edges = np.linspace(0, 1, 9)
    found, _, _ = np.histogram2d(parts[0], parts[1], bins=(edges, edges))
    x = 2 * np.stack([edges[:-1], edges[1:]], axis=-1)[:, None]
    y = np.stack([edges[:-1], edges[1:]], axis=-1)[None]
    expected = solid_angle(x, y, VIEWS[name]) / whole
    np.testing.assert_allclose(found / parts.shape[1], expected, atol=2e-3)
    assert stats.entropy(expected.ravel()) < np.log(64)


def test_points_that_no_rectangle_can_be_drawn_from_are_told(lane_device):
    for point in ((1.0, 0.5, 2.3), (1.0, 0.5, 100.0), (5.0, 0.5, 0.0), (1e30, 0.0, 1.0)):
        parts, _, near = drawn(lane_device, point, 256)
        assert (near == 0).all()
        assert np.isfinite(parts).all()


def under_a_lamp(height=0.3, **material):
    """Return a floor close under a lamp, 2 m wide, that looks down, and a camera beside them."""
    lamp = transform.translation((0, height, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    parts = [floor(6, lambertian(0.5)), (primitives.quad(), lamp, glowing(1.0, **material))]
    view = camera((0, 0.25 * height, 4), (0, 0.1 * height, 0), 25)
    return build(parts, view, (16, 8))


def test_quads_are_one_light_and_both_triangles_name_it():
    scene = under_a_lamp()
    geometry = tables.flatten(scene)
    lights = tables.light_table(scene, geometry, "power", kinds={"rectangles"})
    assert len(lights) == 1
    assert lights["flags"][0] & layout.CONSTANT["LIGHT_RECTANGLE"]
    assert lights["area"][0] == pytest.approx(4.0)
    names = geometry.surfaces["light"]
    assert (names == 0).sum() == 2
    # Corners of all four: what the record says is the lamp.
    p, e1, e2 = (lights[name][0].astype(float) for name in ("position", "e1", "e2"))
    corners = {tuple(np.round(c, 5)) for c in (p, p + e1, p + e2, p + e1 + e2)}
    assert corners == {(x, np.round(0.3, 5), z) for x in (-1.0, 1.0) for z in (-1.0, 1.0)}
    np.testing.assert_allclose(np.cross(e1, e2) / 4.0, lights["direction"][0], atol=1e-6)
    assert len(tables.light_table(scene, tables.flatten(scene), "power")) == 2


def test_only_what_is_a_rectangle_and_glows_evenly_is_one():
    quad = primitives.quad()
    slanted = dataclasses.replace(
        quad, positions=quad.positions + quad.positions[:, [2, 1, 0]] * 0.1
    )
    disk = primitives.disk()
    squeezed = dataclasses.replace(
        disk, positions=disk.positions + disk.positions[:, [2, 1, 0]] * 0.1
    )
    for mesh, material, expected in (
        (quad, glowing(1.0), 1),
        (slanted, glowing(1.0), 0),
        (quad, glowing(1.0, emission_texture=0), 0),
        (quad, glowing(1.0, alpha=0.5, alpha_mode="blend"), 0),
        (primitives.box(), glowing(1.0), 6),
        (primitives.disk(), glowing(1.0), 1),
        (squeezed, glowing(1.0), 0),
        (quad, lambertian(1.0), 0),
    ):
        scene = build([(mesh, IDENTITY, material)], camera((0, 2, 5), (0, 0, 0)))
        assert tables.count_whole_lights(scene, "rectangles")[0] == expected


SOLID = Settings(area_sampling="solid_angle")


def test_the_plan_says_whether_there_are_rectangles():
    found = make_plan(under_a_lamp(), SOLID).features["RECTANGLES"]
    assert found.value == 1 and found.reason.startswith("1 lights are flat")
    left = make_plan(under_a_lamp(), Settings(area_sampling="area")).features["RECTANGLES"]
    assert (left.value, left.reason) == (0, "area_sampling is area")


@pytest.mark.parametrize("mesh", [primitives.quad(), primitives.disk()], ids=["quad", "disk"])
def test_flat_lights_give_the_same_light_with_less_noise(device, mesh):
    """All ways to sample agree; light by solid angle has less than a tenth of the variance."""
    scene = under_a_lamp()
    lamp = dataclasses.replace(scene.shapes[1], mesh=mesh)
    view = camera((0, 0.24, 1.2), (0, 0, 0.2), 25)
    scene = dataclasses.replace(scene, shapes=(scene.shapes[0], lamp), cameras=(view,))

    def irradiance_image(device, spp, **settings):
        return render(device, scene, spp, max_depth=1, **settings).rgb.mean(axis=-1)

    truth = irradiance_image(device, 4096, direct_sampling="bsdf")
    errors = {}
    for way in ("solid_angle", "area"):
        image = irradiance_image(device, 64, direct_sampling="light", area_sampling=way)
        errors[way] = ((image - truth) ** 2).mean()
        assert image.mean() == pytest.approx(truth.mean(), rel=0.02 if way != "area" else 0.1)
    mis = irradiance_image(device, 64, direct_sampling="mis")
    assert mis.mean() == pytest.approx(truth.mean(), rel=0.01)
    assert errors["solid_angle"] < 0.1 * errors["area"]


def test_irradiance_below_a_disk_is_that_of_the_formula(device):
    """Near it and far: pi sin^2 of half of its angle; and above it, where there is none."""
    for height in (0.02, 0.5, 40.0):
        lamp = transform.translation((0, height, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
        patch = (primitives.quad(), transform.scaling(1e-3), lambertian(1.0))
        view = camera((0, 5e-3, 5e-3), (0, 0, 0), 8)
        scene = build([patch, (primitives.disk(), lamp, glowing(1.0))], view, (8, 8))
        image = render(device, scene, 256, max_depth=1, area_sampling="solid_angle")
        assert image.rgb.mean() == pytest.approx(1 / (1 + height**2), rel=0.01)
        dark = dataclasses.replace(scene.shapes[1], transform=transform.translation((0, height, 0)))
        scene = dataclasses.replace(scene, shapes=(scene.shapes[0], dark))
        image = render(device, scene, 4, max_depth=1, area_sampling="solid_angle")
        assert image.rgb.max() == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("way", ["hierarchy", "photon"])
def test_rectangles_among_others_are_drawn_from_the_tree_too(device, way):
    scene = under_a_lamp()
    lamp = transform.translation((3, 0.5, 0)) @ transform.rotation_xyz_degrees((0, 0, 90))
    shape = dataclasses.replace(scene.shapes[1], transform=lamp)
    scene = dataclasses.replace(scene, shapes=(*scene.shapes, shape))
    truth = render(device, scene, 4096, max_depth=2, direct_sampling="bsdf").rgb
    ways = {"area_sampling": "solid_angle", "direct_sampling": "light", "light_sampling": way}
    image = render(device, scene, 1024, max_depth=2, **ways)
    assert image.rgb.mean() == pytest.approx(truth.mean(), rel=0.01)
