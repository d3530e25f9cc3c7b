"""The project's own scenes: what each promises in its first lines, checked by geometry."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Scene
from psf_cl.scene.transform import transform_points
from psf_cl.settings import resolve

ROOT = Path(__file__).resolve().parent.parent
NAMES = ["cornell_box", "ajar_door", "many_lights", "glossy", "furnace", "tiny_light"]


def load(name: str) -> Scene:
    return load_scene(ROOT / "scenes" / f"{name}.toml")


def world_triangles(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return ``(n, 3, 3)`` corners in world space and ``(n,)`` material indices."""
    corners, materials = [], []
    for shape in scene.shapes:
        points = transform_points(shape.transform, shape.mesh.positions)
        corners.append(points[shape.mesh.triangles])
        materials.append(np.full(len(shape.mesh.triangles), shape.material))
    return np.concatenate(corners), np.concatenate(materials)


def distance_along(origin, direction, corners) -> np.ndarray:
    """Return the ray distance to each triangle, inf where it is missed (Moeller, Trumbore 1997)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    # A triangle seen edge on gives infinities and NaN, which fail every comparison.
    with np.errstate(all="ignore"):
        p = np.cross(direction, c - a)
        scale = 1 / np.einsum("ij,ij->i", b - a, p)
        u = np.einsum("ij,ij->i", origin - a, p) * scale
        q = np.cross(origin - a, b - a)
        v = (q @ direction) * scale
        t = np.einsum("ij,ij->i", c - a, q) * scale
        return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6), t, np.inf)


def camera_position(scene: Scene) -> np.ndarray:
    return scene.cameras[scene.camera].transform[:3, 3]


def emitters(scene: Scene, corners, materials):
    """Return corners, unit normals and areas of the emitting triangles."""
    glow = np.array([any(material.emission) for material in scene.materials])[materials]
    lit = corners[glow]
    cross = np.cross(lit[:, 1] - lit[:, 0], lit[:, 2] - lit[:, 0])
    length = np.linalg.norm(cross, axis=1)
    return lit, cross / length[:, None], length / 2


@pytest.mark.parametrize("name", NAMES)
def test_scenes_load_without_notes_and_with_sound_settings(name):
    scene = load(name)
    assert scene.notes == ()
    assert (ROOT / "scenes" / f"{name}.toml").read_text().startswith("# ")
    resolve(scene.render, scene.path)


def test_scenes_are_small():
    files = [file for file in (ROOT / "scenes").rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in files) < 3_000_000


def test_making_the_meshes_again_gives_the_same_bytes(tmp_path):
    command = [sys.executable, str(ROOT / "tools/make_scenes.py"), str(tmp_path)]
    subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    made = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    kept = {file.name: file.read_bytes() for file in (ROOT / "scenes/meshes").iterdir()}
    assert made == kept


@pytest.mark.parametrize("name", NAMES)
def test_the_camera_is_enclosed_and_touches_nothing(name):
    scene = load(name)
    corners, _ = world_triangles(scene)
    origin = camera_position(scene)
    ways = np.random.default_rng(7).normal(size=(64, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    if name == "cornell_box":
        # Open towards the camera, which stands before it: the view must meet the box only.
        matrix = scene.cameras[0].transform[:3, :3]
        slope = np.tan(scene.cameras[0].fov_y / 2)
        ways = np.stack(np.meshgrid([-0.97, -0.3, 0.3, 0.97], [-0.97, -0.3, 0.3, 0.97]), -1)
        ways = np.column_stack([ways.reshape(-1, 2) * slope, -np.ones(16)]) @ matrix.T
    distance = np.array([distance_along(origin, way, corners).min() for way in ways])
    assert np.isfinite(distance).all()
    assert distance.min() > 0.1


def test_the_cornell_box_has_36_triangles_and_walls_that_meet_exactly():
    scene = load("cornell_box")
    corners, _ = world_triangles(scene)
    assert len(corners) == 36
    walls = [shape for shape in scene.shapes if "box" not in shape.name and shape.name != "light"]
    points = np.concatenate(
        [transform_points(shape.transform, shape.mesh.positions) for shape in walls]
    ).astype(np.float32)
    assert len(np.unique(points + 0.0, axis=0)) == 8
    assert all(material.specular == 0 for material in scene.materials)
    (light,) = [m for m in scene.materials if any(m.emission)]
    assert light.emission == (17, 12, 4)


@pytest.mark.parametrize("name", ["cornell_box", "tiny_light", "glossy", "ajar_door"])
def test_area_lights_face_down(name):
    scene = load(name)
    _, normals, _ = emitters(scene, *world_triangles(scene))
    assert np.allclose(normals, [0, -1, 0])


def test_every_wall_of_the_cornell_box_faces_the_inside():
    scene = load("cornell_box")
    for shape in scene.shapes:
        if "box" in shape.name:
            continue
        p = transform_points(shape.transform, shape.mesh.positions)[shape.mesh.triangles]
        ng = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        assert (np.einsum("ij,ij->i", ng, np.array([0, 1, 0]) - p[:, 0]) > 0).all()


def test_the_furnace_has_radiance_one_everywhere():
    scene = load("furnace")
    (material,) = scene.materials
    for color, emission in zip(material.base_color, material.emission, strict=True):
        assert emission / (1 - color) == 1.0
    assert material.specular == 0
    # Its camera is inside, where a box shows its back: both sides have to emit.
    assert material.double_sided


def test_the_tiny_light_is_one_millimetre_wide():
    scene = load("tiny_light")
    lit, _, areas = emitters(scene, *world_triangles(scene))
    assert areas.sum() == pytest.approx(1e-6)
    assert np.ptp(lit[..., 0]) == pytest.approx(1e-3)


def test_the_lamp_behind_the_ajar_door_lights_no_point_of_the_front_room_directly():
    scene = load("ajar_door")
    corners, materials = world_triangles(scene)
    lit, _, _ = emitters(scene, corners, materials)
    rng = np.random.default_rng(11)
    low, high = lit.reshape(-1, 3).min(axis=0), lit.reshape(-1, 3).max(axis=0)
    # Anywhere in the front room, and closely before the gap.
    room = rng.uniform([-2.9, 0.05, 0.35], [2.5, 2.6, 4.9], (100, 3))
    gap = rng.uniform([0.3, 0.05, 0.12], [1.6, 2.6, 0.6], (100, 3))
    for point in np.concatenate([room, gap]):
        way = rng.uniform(low, high) - point
        assert distance_along(point, way, corners).min() < 0.999


def test_the_door_is_ajar():
    scene = load("ajar_door")
    corners, _ = world_triangles(scene)
    # Through the gap between the frame and the leaf, and against the closed part of the leaf.
    through = distance_along(np.array([0.3, 1.0, 0.35]), np.array([0.45, 0, -0.5]), corners).min()
    assert 0.3 + 0.45 * through > 0.5
    assert 0.35 - 0.5 * through < -0.3
    against = distance_along(np.array([1.0, 1.0, 1.0]), np.array([0, 0, -1.0]), corners).min()
    assert 0.8 < against < 1.0


def test_many_lights_has_2000_lamps_of_powers_spread_over_decades():
    scene = load("many_lights")
    corners, materials = world_triangles(scene)
    radiance = np.array([np.mean(material.emission) for material in scene.materials])[materials]
    shown = corners[radiance > 0]
    # A lamp is a quad of 2 triangles that face down, or a box of 12, of which 2 face up.
    cross = np.cross(shown[:, 1] - shown[:, 0], shown[:, 2] - shown[:, 0])
    power = np.linalg.norm(cross, axis=1) / 2 * radiance[radiance > 0]
    cell = np.unique((shown.mean(axis=1)[:, [0, 2]] // 6).astype(int), axis=0)
    assert len(cell) == 48
    boxes = np.count_nonzero(cross[:, 1] > 1e-12) // 2
    quads = (len(shown) - 12 * boxes) // 2
    assert boxes + quads == 2000
    assert np.log10(power.max() / power.min()) > 3
    assert len({material.emission for material in scene.materials}) > 30


def test_most_lamps_of_many_lights_are_hidden_from_the_camera():
    scene = load("many_lights")
    corners, materials = world_triangles(scene)
    lit, _, _ = emitters(scene, corners, materials)
    origin = camera_position(scene)
    targets = lit[::97].mean(axis=1)
    seen = [distance_along(origin, p - origin, corners).min() > 0.999 for p in targets]
    assert 0 < np.mean(seen) < 0.35


def test_glossy_has_metals_of_several_roughness_glass_and_plastic():
    scene = load("glossy")
    corners, _ = world_triangles(scene)
    metals = {material.roughness for material in scene.materials if material.metallic == 1}
    assert len(metals) >= 5
    assert sum(material.transmission == 1 for material in scene.materials) == 1
    assert 40_000 < len(corners) < 60_000


def test_glass_of_glossy_is_closed_and_faces_outwards():
    scene = load("glossy")
    glass = [s for s in scene.shapes if scene.materials[s.material].transmission == 1]
    corners = np.concatenate(
        [transform_points(s.transform, s.mesh.positions)[s.mesh.triangles] for s in glass]
    )
    points, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = index.reshape(-1, 3)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}
    assert np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0
    assert points[:, 1].min() > 0
