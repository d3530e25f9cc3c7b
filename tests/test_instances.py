"""A scene of two levels looks as the same scene made flat, and takes memory for its meshes alone.

The tree of one level is compared with brute force elsewhere (test_bvh.py); here it is the truth.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scene_builder import build, camera, dented_bowl, floor, glowing, lambertian

from psf_cl import instancing
from psf_cl.device import layout
from psf_cl.plan import make_plan
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Light, Mesh, Scene, Texture
from psf_cl.settings import Settings


def turned(angles, scale, place):
    """Return a matrix that scales, turns by degrees about the axes, and moves."""
    linear = transform.rotation_xyz_degrees(angles) @ transform.scaling(scale)
    return transform.translation(place) @ linear


def bumps() -> Texture:
    """Return a normal map that leans in all directions, and is opaque here and there."""
    chance = np.random.default_rng(3)
    pixels = chance.integers(90, 166, (8, 8, 4), np.uint8)
    pixels[..., 2] = 255
    pixels[..., 3] = np.where(chance.random((8, 8)) < 0.3, 0, 255)
    return Texture("bumps", pixels, srgb=False, filter="nearest")


def with_uvs(mesh: Mesh) -> Mesh:
    """Return ``mesh`` with coordinates from above."""
    return dataclasses.replace(mesh, uvs=np.ascontiguousarray(mesh.positions[:, [0, 2]] * 2))


BOWL = with_uvs(dented_bowl(14, 8))
PLACES = [
    turned((20 * i, 70 * i, 10), (0.5, 0.3 + 0.1 * (i % 3), 0.4), (i % 4 - 1.5, 0.5, i // 4 - 1.0))
    for i in range(12)
]
# Every third one is mirrored.
PLACES[::3] = [place @ np.diag([-1.0, 1.0, 1.0, 1.0]) for place in PLACES[::3]]

MATERIALS = (
    lambertian((0.8, 0.3, 0.2), normal_texture=0),
    lambertian((0.2, 0.5, 0.8), base_color_texture=0, alpha_mode="mask", normal_texture=0),
    dataclasses.replace(lambertian(0.9), transmission=1.0, specular=1.0, roughness=0.0),
    lambertian(0.7, anisotropy=0.7, metallic=1.0, roughness=0.4),
)


def crowd(materials) -> Scene:
    """Return bowls everywhere on a floor, under a lamp and a point light; two of them glow."""
    lamp = turned((180, 0, 0), 0.5, (0, 2.5, 0))
    parts = [floor(3, lambertian(0.6)), (primitives.quad(), lamp, glowing(8.0))]
    parts += [
        (BOWL, place, glowing(0.5, 0.2) if i in (3, 7) else materials[i % len(materials)])
        for i, place in enumerate(PLACES)
    ]
    scene = build(
        parts,
        camera((0.5, 2.5, 4), (0, 0.3, 0), 45),
        (48, 40),
        lights=[Light("point", (2.0, 2.0, 2.0), position=(2.0, 3.0, 2.0))],
        environment=0.2,
        textures=[bumps()],
    )
    # One record for each material, as readers make them.
    distinct = list(dict.fromkeys(scene.materials))
    shapes = tuple(
        dataclasses.replace(shape, material=distinct.index(scene.materials[shape.material]))
        for shape in scene.shapes
    )
    return dataclasses.replace(scene, materials=tuple(distinct), shapes=shapes)


@pytest.fixture
def small_counts(monkeypatch):
    """Let small scenes have two levels, with several instances for each place of the bowl."""
    monkeypatch.setattr(instancing, "LEAST_SAVED", 1)
    monkeypatch.setattr(instancing, "LEAST_REUSE", 1)
    monkeypatch.setattr(instancing, "INDEX_BITS", (6,))


def rendered(device, scene, levels: bool, monkeypatch, outputs=(), spp=16, **settings):
    with monkeypatch.context() as patch:
        if not levels:
            patch.setattr(instancing, "LEAST_SAVED", 1 << 60)
        renderer = Renderer(scene, Settings(**settings), device, outputs)
    try:
        assert (renderer.plan.levels is not None) == levels
        renderer.render(spp=spp)
        return renderer.image()
    finally:
        renderer.close()


@pytest.mark.parametrize(
    "materials",
    [MATERIALS[:2], pytest.param(MATERIALS, marks=pytest.mark.slow)],
    ids=["few", "all"],
)
def test_two_levels_look_as_one(lane_device, small_counts, monkeypatch, materials):
    scene = crowd(materials)
    outputs = ["normal", "depth", "albedo"]
    flat, levels = (
        rendered(lane_device, scene, way, monkeypatch, outputs, max_depth=4)
        for way in (False, True)
    )
    # Rounding lets a few rays pass an edge on its other side.
    for name in ("depth", "normal", "albedo"):
        differ = np.abs(flat.aovs[name] - levels.aovs[name]).max(axis=-1) > 1e-3
        assert differ.mean() < 0.01, name
    assert (np.abs(flat.rgb - levels.rgb).max(axis=-1) > 1e-2).mean() < 0.05
    assert levels.rgb.mean() == pytest.approx(flat.rgb.mean(), rel=0.01)
    # They are not the same render: bowls are everywhere, and none of them is missing.
    assert flat.aovs["albedo"].std() > 0.05


@pytest.mark.slow
def test_what_blends_is_there_as_often_in_every_instance(device, small_counts, monkeypatch):
    veil = lambertian(0.5, alpha=0.4, alpha_mode="blend")
    flat, levels = (
        rendered(device, crowd((veil,)), way, monkeypatch, ["albedo"], spp=64, max_depth=0)
        for way in (False, True)
    )
    difference = flat.aovs["albedo"] - levels.aovs["albedo"]
    assert abs(difference.mean()) < 0.003
    assert np.abs(difference).mean() < 0.06


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_equally_near_instances_the_first_is_seen(lane_device, small_counts, monkeypatch, order):
    colors = [lambertian((1.0, 0.0, 0.0)), lambertian((0.0, 1.0, 0.0))]
    place = turned((0, 30, 0), 1.0, (0, 0, 0))
    parts = [(BOWL, place, colors[index]) for index in order]
    scene = build(parts, camera((0, 3, 1), (0, 0, 0), 45), (24, 24), environment=1.0)
    image = rendered(lane_device, scene, True, monkeypatch, ["albedo"], spp=2, max_depth=0)
    seen = image.aovs["albedo"].sum(axis=(0, 1))
    assert seen[order[0]] > 50
    assert seen[order[1]] == 0


def many(count: int, moved=None) -> Scene:
    mesh = primitives.sphere(64)
    places = [turned((0, i, 0), 0.4, (i % 10, i // 10, 0.0)) for i in range(count)]
    material = lambertian(0.5)
    parts = [(mesh, place, material) for place in places]
    scene = build(parts, camera((5, 5, 30), (5, 5, 0)), (16, 16), environment=1.0)
    shapes = tuple(dataclasses.replace(shape, material=0) for shape in scene.shapes)
    if moved is not None:
        shapes = tuple(dataclasses.replace(shape, transform=moved) for shape in shapes)
    return dataclasses.replace(scene, materials=(material,), shapes=shapes)


def bytes_of(plan) -> dict[str, int]:
    return {buffer.name: buffer.bytes for buffer in plan.scene_buffers}


def test_memory_grows_with_meshes_not_with_instances():
    few, more = (bytes_of(make_plan(many(count), Settings())) for count in (20, 100))
    grown = {name: more[name] - few[name] for name in more}
    instances = grown.pop("instances")
    assert not any(grown.values())
    assert instances == 80 * layout.INSTANCE.dtype.itemsize


def test_a_scene_without_reuse_has_one_level():
    scene = many(20)
    once = dataclasses.replace(scene, shapes=scene.shapes[:1])
    # What is all but flat, or has no inverse, is made flat.
    sheets = [np.diag([1.0, 1e-9, 1.0, 1.0]), np.diag([1.0, 0.0, 1.0, 1.0])]
    for flat in (once, *(many(20, moved=sheet) for sheet in sheets)):
        plan = make_plan(flat, Settings())
        assert plan.features["INSTANCES"].value == 0 and plan.levels is None
        assert "instances" not in bytes_of(plan)
    assert make_plan(scene, Settings()).features["INSTANCES"].value > 0


def test_every_index_names_its_triangle_and_place():
    levels = instancing.split(many(20))
    assert levels is not None
    for bits in (8, 12):
        levels = dataclasses.replace(levels, index_bits=bits)
        placed = instancing.place(many(20), levels)
        count = levels.parts[0].triangle_count
        for number, first in enumerate(placed.first):
            base = placed.instances["base"][first]
            hits = (base + np.arange(count, dtype=np.uint32)).astype(np.uint32)
            rows = placed.instances[hits >> bits]
            assert ((hits - rows["base"]) == np.arange(count)).all()
            place = levels.parts[0].shapes[number].transform
            np.testing.assert_allclose(rows["position"], np.tile(place[:3, 3], (count, 1)))
            inverse = rows["inverse"][0].reshape(3, 3) @ place[:3, :3]
            np.testing.assert_allclose(inverse, np.eye(3), atol=1e-5)
