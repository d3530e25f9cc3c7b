"""Furnaces: where all surfaces send out what they get, nothing can be seen but that."""

from __future__ import annotations

from dataclasses import replace

import bsdf_truth
import numpy as np
import pytest
from scene_builder import (
    IDENTITY,
    assert_blocks_equal,
    build,
    camera,
    dented_bowl,
    flat,
    floor,
    glowing,
    inside_out,
    lambertian,
    luminance_blocks,
    render,
)

from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Environment, Material
from psf_cl.settings import Settings

Z_LIMIT = 5.0
MIRRORED = transform.scaling((-1, 1, 1))
SQUASHED = transform.rotation_xyz_degrees((20, 70, -40)) @ transform.scaling((1.5, -0.7, 1.1))


@pytest.mark.parametrize("matrix", [IDENTITY, MIRRORED, SQUASHED], ids=["", "mirrored", "squashed"])
@pytest.mark.parametrize("direct_sampling", ["mis", "bsdf"])
def test_closed_lambertian_box_has_radiance_one_everywhere(device, matrix, direct_sampling):
    walls = inside_out(primitives.box())
    points = transform.transform_points(matrix, [[0.3, 0.2, 0.6], [-0.5, -0.7, -1]])
    scene = build([(walls, matrix, glowing(0.5, 0.5))], camera(*points, 80), (16, 16))
    image = render(
        device, scene, 256, direct_sampling=direct_sampling, max_depth=1000, roulette_depth=12
    )
    assert_blocks_equal(image, 1.0, 0.005)


def test_a_matt_furnace_is_the_same_in_a_build_with_gloss(device):
    # Nothing reaches the metal behind the walls, but for its sake all is built.
    walls = (inside_out(primitives.box()), IDENTITY, glowing(0.5, 0.5))
    metal = (primitives.quad(), transform.translation((0, 5, 0)), Material(metallic=1.0))
    images = []
    for parts, gloss in (([walls], 0), ([walls, metal], 1)):
        scene = build(parts, camera((0.3, 0.2, 0.6), (-0.5, -0.7, -1), 80), (16, 16))
        assert make_plan(scene, Settings()).features["GLOSSY"].value == gloss
        images.append(render(device, scene, 64, max_depth=100, roulette_depth=2))
    assert_blocks_equal(images[0], 1.0, 0.05)
    np.testing.assert_allclose(images[0].rgb, images[1].rgb, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("view", [(0.9, 0.9, 0.9), (-0.9, 0.1, -0.2), (0.1, -0.95, 0.3)])
@pytest.mark.parametrize("sampler", ["sobol", "random"])
def test_closed_lambertian_box_has_radiance_one_with_default_roulette(device, view, sampler):
    walls = inside_out(primitives.box())
    scene = build([(walls, IDENTITY, glowing(0.5, 0.5))], camera(view, (0, 0, 0), 90), (16, 16))
    image = render(device, scene, 8192, sampler=sampler, max_depth=1000)
    assert_blocks_equal(image, 1.0, 0.005)


@pytest.mark.parametrize("light_sampling", ["uniform", "power"])
def test_closed_sphere_has_radiance_one_by_light_sampling_alone(device, light_sampling):
    # Inside a sphere every point of it sheds equal light on every other, so this has little noise;
    # in a box it would be without bound at the edges.
    wall = inside_out(primitives.sphere(32, 16))
    scene = build(
        [(wall, MIRRORED, glowing(0.5, 0.5))], camera((0.3, 0.1, 0.4), (-1, 0, 0), 60), (8, 8)
    )
    image = render(
        device,
        scene,
        1024,
        direct_sampling="light",
        light_sampling=light_sampling,
        max_depth=1000,
        roulette_depth=12,
    )
    assert_blocks_equal(image, 1.0, 0.005, blocks=2)


@pytest.mark.parametrize("max_depth", [0, 1, 2, 3])
def test_max_depth_counts_bounces(device, max_depth):
    wall = inside_out(primitives.sphere(32, 16))
    scene = build([(wall, IDENTITY, glowing(0.5, 0.5))], camera((0, 0, 0), (-1, 0, 0), 60), (8, 8))
    truth = 1.0 - 0.5 ** (max_depth + 1)
    alone = render(device, scene, 4, direct_sampling="bsdf", max_depth=max_depth)
    np.testing.assert_allclose(alone.rgb, truth, rtol=1e-6)
    both = render(device, scene, 256, max_depth=max_depth)
    assert_blocks_equal(both, truth, 0.005, blocks=2)


GREY_IMAGE = Environment(
    (0.5, 0.5, 0.5),
    np.full((4, 8, 3), 2.0, np.float32),
    transform.rotation_xyz_degrees((30, 50, 70))[:3, :3],
)


@pytest.mark.parametrize(
    "environment", [1.0, GREY_IMAGE], ids=["constant sky", "rotated grey image"]
)
@pytest.mark.parametrize("direct_sampling", ["mis", "bsdf"])
def test_white_bowl_looks_like_its_environment(device, environment, direct_sampling):
    scene = build(
        [(dented_bowl(), IDENTITY, lambertian(1.0))],
        camera((0, 2.2, 1.0), (0, 0, 0)),
        (16, 16),
        environment=environment,
    )
    image = render(
        device,
        scene,
        1024,
        ["variance"],
        direct_sampling=direct_sampling,
        sampler="random",
        max_depth=100_000,
        roulette_depth=40,
    )
    np.testing.assert_allclose(image.rgb.mean(), 1.0, rtol=0.005)
    # A block of sky has neither noise nor error; roulette ends so few paths that samples do not
    # show how much that adds.
    deviation, variance = luminance_blocks(image, 4)
    assert (np.abs(deviation - 1.0) <= Z_LIMIT * np.sqrt(variance) + 1e-4).all()
    assert np.sqrt(variance).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    "environment", [1.0, GREY_IMAGE], ids=["constant sky", "rotated grey image"]
)
def test_every_part_of_the_white_bowl_looks_like_its_environment(device, environment):
    scene = build(
        [(dented_bowl(64, 32), IDENTITY, lambertian(1.0))],
        camera((0, 2.2, 1.0), (0, 0, 0)),
        (16, 16),
        environment=environment,
    )
    image = render(device, scene, 16384, max_depth=100_000)
    assert_blocks_equal(image, 1.0, 0.005)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("degrees", "roughness", "least"), [(40, 0.0, 0.97), (40, 0.3, 0.9), (33, 0.0, 0.93)]
)
def test_glass_is_not_dark_where_its_shading_normals_lean(device, degrees, roughness, least):
    """A wall whose corners share their normals with its rim: all lean towards it.

    By 40 degrees they would mirror light between its faces through them, where there is none.
    Single facets of rough glass still do.  By 33 they would mirror it along the wall.  Few paths do
    not get out in 16 bounces.
    """
    box = primitives.box()
    across, along = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    leaning = box.positions * [0.0, 0.0, across] + [0.0, along, 0.0]
    wall = replace(box, positions=box.positions * np.float32([20, 20, 0.1]), normals=leaning)
    glass = Material(base_color=(1.0, 1.0, 1.0), transmission=1.0, roughness=roughness)
    scene = build(
        [(wall, IDENTITY, glass)],
        camera((0, 0, 3), (0, 0, 0), 60),
        (16, 16),
        environment=1.0,
    )
    image = render(device, scene, 256, max_depth=16, roulette_depth=16)
    assert least < image.rgb.mean() < 1.005


@pytest.mark.slow
def test_sheen_finer_than_its_fit_is_taken_as_the_finest_of_it(device):
    """Roughness 0.3; finer sheen would give back more than comes."""
    pictures = []
    for roughness in (0.0, 0.1, 0.3, 0.5):
        velvet = Material(base_color=(1.0, 1.0, 1.0), sheen_color=(1, 1, 1))
        scene = build(
            [(primitives.sphere(), IDENTITY, replace(velvet, sheen_roughness=roughness))],
            camera((0, 0, 2), (0, 0, 0), 30),
            (16, 16),
            environment=1.0,
        )
        pictures.append(render(device, scene, 4096, max_depth=1).rgb)
    means = np.mean(pictures, axis=(1, 2, 3))
    assert (means < 1.001).all() and (means > 0.99).all()
    for picture in pictures[:2]:
        np.testing.assert_array_equal(picture, pictures[2])
    assert (pictures[3] != pictures[2]).any()


# One vertex of a rough surface under a white sky: its directional albedo, against quadrature over
# the microfacets that are hit, which knows nothing of how the renderer draws them.


def fresnel(cosine, eta):
    """Return the reflectance of a boundary into a medium of relative index ``eta``."""
    sine2 = (1 - cosine**2) / eta**2
    beyond = np.sqrt(np.maximum(1 - sine2, 0))
    s = (cosine - eta * beyond) / (cosine + eta * beyond)
    p = (eta * cosine - beyond) / (eta * cosine + beyond)
    return np.where(sine2 >= 1, 1.0, (s**2 + p**2) / 2)


def schlick(f0, cosine):
    return f0 + (1 - f0) * (1 - cosine) ** 5


def microfacets(alpha, angle):
    """Return wo, microfacet normals h, and weights: D times o.h / cos_o over the density of h.

    The slopes are those of Walter et al., "Microfacet Models for Refraction", 2007, equation 35, at
    u = 1 - t^2 on a grid in t, which is fine where facets stand upright and weigh most.
    """
    count = 1000
    t, v = np.meshgrid((np.arange(count) + 0.5) / count, (np.arange(count) + 0.5) / count)
    tangent = alpha * np.sqrt(1 - t**2) / t
    cosine = 1 / np.sqrt(1 + tangent**2)
    sine = tangent * cosine
    h = np.stack([sine * np.cos(2 * np.pi * v), sine * np.sin(2 * np.pi * v), cosine], axis=-1)
    wo = np.array([np.sin(angle), 0.0, np.cos(angle)])
    return wo, h, 2 * t * np.maximum(h @ wo, 0.0) / (wo[2] * cosine)


def masking_lambda(cosine, alpha):
    """Return Smith's Lambda of GGX; Heitz, "Understanding the Masking-Shadowing Function", 2014."""
    tangent2 = (1 - cosine**2) / np.maximum(cosine**2, 1e-12)
    return (np.sqrt(1 + alpha**2 * tangent2) - 1) / 2


def masked(wo, cos_i, alpha):
    """Return height-correlated G; 0 where wi is on the wrong side."""
    g = 1 / (1 + masking_lambda(wo[2], alpha) + masking_lambda(cos_i, alpha))
    return np.where(cos_i > 0, g, 0.0)


def reflected(alpha, angle, reflectance):
    """Return what a mirror of microfacets reflects of a white sky, with ``reflectance(cosine)``."""
    wo, h, weight = microfacets(alpha, angle)
    oh = h @ wo
    cos_i = 2 * oh * h[..., 2] - wo[2]
    return (weight * masked(wo, cos_i, alpha) * reflectance(np.maximum(oh, 0.0))).mean()


def given_away_by_glass(alpha, angle, eta):
    """Return the radiance that a rough boundary into a medium of index ``eta`` shows.

    What is stopped behind one way of a facet takes the other; what has neither meets the smooth
    boundary.  The sky beyond has radiance 1, which the boundary changes by 1 / eta^2.
    """
    wo, h, weight = microfacets(alpha, angle)
    oh = np.maximum(h @ wo, 0.0)
    sine2 = (1 - oh**2) / eta**2
    up = 2 * oh * h[..., 2] - wo[2]
    down = -wo[2] / eta + (oh / eta - np.sqrt(np.maximum(1 - sine2, 0))) * h[..., 2]
    closed = (sine2 >= 1) | (down >= 0)
    back = np.where(closed, 1.0, fresnel(oh, eta)) * masked(wo, up, alpha)
    through = np.where(closed, 0.0, (1 - fresnel(oh, eta)) * masked(wo, -down, alpha))
    weight = weight / (1 + masking_lambda(wo[2], alpha))
    both = np.maximum(back + through, 1e-12)
    again = np.where(closed & (up < 0), fresnel(np.abs(up), eta), 0.0)
    again_through = np.where(closed & (up < 0), 1 - again, 0.0)
    returned = (weight * (back / both + again)).mean()
    return returned + (weight * (through / both + again_through)).mean() / eta**2


def seen_under_white_sky(device, material, degrees, side=1.0):
    """Return the radiance of a plane of ``material``, seen at ``degrees``, and its error."""
    angle = np.radians(degrees)
    view = camera((50 * np.sin(angle), 50 * side * np.cos(angle), 0), (0, 0, 0), 0.5, up=(0, 0, 1))
    scene = build([floor(20.0, material)], view, (8, 8), environment=1.0)
    image = render(device, scene, 2048, ["variance"], sampler="random", max_depth=1)
    means, variances = luminance_blocks(image, 1)
    return means.item(), np.sqrt(variances).item()


ANGLES = [0, 45, 75]


@pytest.mark.parametrize("roughness", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("degrees", ANGLES)
def test_a_white_metal_gives_back_what_it_gets_and_never_more(device, roughness, degrees):
    """One reflection alone gives back as little as 0.31: light between facets is compensated."""
    metal = Material(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=roughness)
    seen, noise = seen_under_white_sky(device, metal, degrees)
    once = reflected(roughness**2, np.radians(degrees), np.ones_like)
    assert once - Z_LIMIT * noise < seen < 1.001
    assert seen > 0.989 - Z_LIMIT * noise
    assert noise < 0.005


@pytest.mark.parametrize("roughness", [0.2, 0.7])
@pytest.mark.parametrize("degrees", ANGLES)
def test_white_plastic_reflects_what_quadrature_says(device, roughness, degrees):
    seen, noise = seen_under_white_sky(
        device, Material(base_color=(1.0, 1.0, 1.0), roughness=roughness), degrees
    )
    angle = np.radians(degrees)
    coat = reflected(roughness**2, angle, lambda cosine: schlick(0.04, cosine))
    # A white base gives back all that the coat, by the fit of its albedo, lets in.
    plastic = bsdf_truth.Bsdf(roughness=roughness, ior=1.5)
    truth = coat + 1 - bsdf_truth.coat_albedo(plastic, np.cos(angle))
    assert abs(seen - truth) < Z_LIMIT * noise + 1e-3 * truth
    assert 0.9 < seen < 1.012 + Z_LIMIT * noise
    assert noise < 0.005


@pytest.mark.parametrize("roughness", [0.1, 0.6])
@pytest.mark.parametrize("degrees", ANGLES)
@pytest.mark.parametrize("side", [1.0, -1.0], ids=["from outside", "from inside"])
def test_glass_boundary_reflects_and_refracts_what_quadrature_says(
    device, roughness, degrees, side
):
    glass = Material(base_color=(1.0, 1.0, 1.0), roughness=roughness, transmission=1.0, ior=1.5)
    seen, noise = seen_under_white_sky(device, glass, degrees, side)
    eta = 1.5 if side > 0 else 1 / 1.5
    truth = given_away_by_glass(roughness**2, np.radians(degrees), eta)
    assert abs(seen - truth) < Z_LIMIT * noise + 1e-3 * truth
    assert noise < 0.011


@pytest.mark.parametrize("shape", ["smooth sphere", "faceted sphere", "box"])
@pytest.mark.parametrize("roughness", [0.0, 0.4])
def test_glass_gives_back_what_it_gets(device, shape, roughness):
    mesh = {
        "smooth sphere": primitives.sphere(),
        "faceted sphere": flat(primitives.sphere(32, 16)),
        "box": primitives.box(),
    }[shape]
    glass = Material(base_color=(1.0, 1.0, 1.0), roughness=roughness, transmission=1.0)
    turned = transform.rotation_xyz_degrees((20, 30, 0))
    view = camera((0, 0, 12), (0, 0, 0), 5)
    scene = build([(mesh, turned, glass)], view, (8, 8), environment=1.0)
    seen = render(device, scene, 512, max_depth=10_000).rgb.mean()
    np.testing.assert_allclose(seen, 1.0, rtol=0.005)
