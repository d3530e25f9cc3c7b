"""Backs of single-sided materials: the camera looks through them, and nothing else does."""

from __future__ import annotations

import dataclasses

import numpy as np
import planes
import pytest
from rays import NO_HIT, all_hits, rays_through, soup
from scene_builder import (
    IDENTITY,
    SMALL,
    assert_blocks_equal,
    build,
    camera,
    flat,
    glowing,
    inside_out,
    lambertian,
    render,
)

from psf_cl import few, instancing, tables
from psf_cl.device import layout
from psf_cl.device.bvh import build_bvh
from psf_cl.device.device import Device
from psf_cl.device.two_levels import build_two_levels
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Mesh, hides_back
from psf_cl.settings import PRESETS, Settings

MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
HIDDEN = lambertian(0.5, back_hidden=True)
SHOWN = lambertian(0.5)


def mesh_of(triangles):
    """Return ``(n, 3, 3)`` as a mesh."""
    indices = np.arange(3 * len(triangles), dtype=np.uint32).reshape(-1, 3)
    return Mesh("soup", triangles.reshape(-1, 3), indices)


def soups(count, seed):
    """Return a scene of ``count`` triangles, a third of each: hidden, so and mirrored, shown."""
    parts = np.split(soup(count, seed, 0.6), 3)
    ways = ((IDENTITY, HIDDEN), (MIRROR, HIDDEN), (IDENTITY, SHOWN))
    return build(
        [(mesh_of(part), *way) for part, way in zip(parts, ways, strict=True)],
        camera((0, 0, 4), (0, 0, 0)),
    )


def placed_soups():
    """Return a scene of one mesh in many places, some mirrored, some hidden."""
    mesh = mesh_of(soup(30, 5, 0.4))
    parts = []
    for i in range(8):
        turn = transform.rotation_xyz_degrees((40 * i, 70 * i, 10))
        place = transform.translation((0.3 * (i % 3), 0.2 * (i % 4) - 0.3, 0.1 * i - 0.4)) @ turn
        matrix = place @ transform.scaling(0.3 + 0.1 * i)
        parts.append((mesh, matrix @ (MIRROR if i % 2 else IDENTITY), (HIDDEN, SHOWN)[i // 2 % 2]))
    return build(parts, camera((0, 0, 4), (0, 0, 0)))


def truth(scene, rays, of_camera):
    """Return the distance to what each ray meets, inf for nothing, and which rays pass no edge."""
    corners, hides, mirrored = [], [], []
    for shape in scene.shapes:
        points = shape.mesh.positions @ shape.transform[:3, :3].T + shape.transform[:3, 3]
        corners.append(points[shape.mesh.triangles])
        count = len(shape.mesh.triangles)
        hides.append(np.full(count, scene.materials[shape.material].back_hidden))
        mirrored.append(np.full(count, np.linalg.det(shape.transform[:3, :3]) < 0))
    triangles = np.concatenate(corners).astype(np.float32).astype(np.float64)
    t, _, _, margin = all_hits(triangles, rays)
    # glTF: counter-clockwise corners are seen from the front, clockwise ones of what is mirrored.
    front = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    front[np.concatenate(mirrored)] *= -1.0
    front /= np.linalg.norm(front, axis=1, keepdims=True)
    cosine = rays[:, 3:6].astype(np.float64) @ front.T
    through = of_camera[:, None] & np.concatenate(hides) & (cosine > 0.0)
    clear = (margin.min(axis=1) > 1e-4) & (np.abs(cosine).min(axis=1) > 1e-5)
    return np.where(through, np.inf, t).min(axis=1), clear, through & np.isfinite(t)


def scene_tables(device, scene, plan):
    """Return the tables of a scene that its rays need, and the depth of their stack."""
    placed = instancing.place(scene, plan.levels) if plan.levels is not None else None
    geometry = tables.flatten(scene) if placed is None else placed.geometry
    contents = {
        "params": np.zeros(1, layout.PARAMS.dtype),
        "surfaces": geometry.surfaces,
        "materials": tables.material_table(scene.materials),
    }
    if plan.features["FEW"].value:
        listed = few.few_triangles(geometry.positions)
        hides = np.array([hides_back(material) for material in scene.materials])
        plates = few.flat_pieces(listed, hides[geometry.surfaces["material"]])
        contents |= {"corners": listed.corners, "faces": listed.faces, "plates": plates.records}
        contents["params"]["corner_count"] = len(listed.corners)
        contents["params"]["face_count"] = len(listed.faces)
        contents["params"]["plate_count"] = len(plates.records)
        contents["params"]["pair_count"] = plates.pairs
        tree = None
    elif placed is None:
        positions = device.upload("positions", geometry.positions.reshape(-1))
        tree = build_bvh(device, positions, geometry.count)
        device.release(positions)
    else:
        parts = np.split(geometry.positions, placed.starts[1:-1])
        tree, roots = build_two_levels(device, parts, placed.boxes, placed.first)
        placed.instances["root"] = roots[placed.part_of]
        contents["instances"] = placed.instances
    buffers = {name: device.upload(name, values) for name, values in contents.items()}
    if tree is None:
        return buffers, {}
    return buffers | {"nodes": tree.nodes, "blocks": tree.blocks}, {"STACK_SIZE": tree.stack_size}


def traced(device, scene, rays, of_camera):
    """Return triangles and distances as the device finds them, and the features of the scene."""
    plan = make_plan(scene, Settings(), traits=device.traits)
    features = {name: item.value for name, item in plan.features.items()}
    buffers, stack = scene_tables(device, scene, plan)
    defines = {name: features[name] for name in ("FEW", "INSTANCES", "ALPHA", "BACK_FACES")}
    inputs = {
        "rays": np.ascontiguousarray(rays[:, :6].T, np.float32),
        "of_camera": of_camera.astype(np.uint32),
    }
    outputs = {"triangles": (np.uint32, 1), "distances": (np.float32, 1)}
    kernel = "sides_test.cl", "trace_first_hits"
    found = planes.run(device, *kernel, inputs, outputs, defines | stack, **buffers)
    device.release(*buffers.values())
    return *found, features


@pytest.fixture
def few_device(lane_device):
    traits = dataclasses.replace(lane_device.traits, **SMALL)
    return Device(lane_device.context, traits)


def check(device, scene):
    """Compare the first hits of rays, every other one the camera's, with brute force."""
    rays = rays_through(2000, seed=7)
    of_camera = np.arange(len(rays)) % 2 == 0
    expected, clear, through = truth(scene, rays, of_camera)
    triangles, distances, features = traced(device, scene, rays, of_camera)
    assert features["BACK_FACES"] == 1
    assert clear.mean() > 0.5
    assert (through.any(axis=1) & clear & of_camera).mean() > 0.1
    hit = np.isfinite(expected)
    np.testing.assert_array_equal((triangles != NO_HIT)[clear], hit[clear])
    np.testing.assert_allclose(distances[clear & hit], expected[clear & hit], rtol=1e-4, atol=1e-6)
    return features


def test_camera_rays_through_a_tree_pass_hidden_backs(lane_device):
    assert not check(lane_device, soups(300, 3))["FEW"]


def test_camera_rays_through_a_list_pass_hidden_backs(few_device):
    assert check(few_device, soups(36, 4))["FEW"]


def test_camera_rays_through_two_levels_pass_hidden_backs(lane_device, monkeypatch):
    for name in ("LEAST_SAVED", "LEAST_REUSE"):
        monkeypatch.setattr(instancing, name, 1)
    assert check(lane_device, placed_soups())["INSTANCES"]


def furnace(matrix, **values):
    """Return a closed box that glows inwards, 2 m wide, and a camera outside that looks in."""
    walls = glowing(0.4, 0.5, **values)
    view = camera((0.3, 0.2, 6), (0, 0, 0), 15)
    return build([(inside_out(flat(primitives.box())), matrix, walls)], view, (16, 16))


@pytest.mark.parametrize("matrix", [IDENTITY, MIRROR], ids=["as it is", "mirrored"])
def test_a_furnace_that_is_seen_through_its_wall_stays_one(device, matrix):
    scene = furnace(matrix, back_hidden=True)
    image = render(device, scene, 64, ["depth", "normal"], max_depth=64, termination="off")
    # All that is inside: 0.4 / (1 - 0.5); through walls that are open nearly half would get lost.
    assert_blocks_equal(image, 0.8, 0.01)
    assert image.aovs["depth"].min() > 6.5
    np.testing.assert_allclose(image.aovs["normal"][4:12, 4:12, 2], 1.0, atol=1e-3)
    ways = {"back_faces": "shown", "area_sampling": "solid_angle"}
    shown = render(device, scene, 4, ["depth"], **ways)
    # Black but for light from nearer to an edge than shadow rays go, some 1e-6 of the coordinates.
    assert shown.rgb.max() < 1e-3 and np.median(shown.rgb) < 1e-6
    assert shown.aovs["depth"].max() < 5.5


@pytest.mark.slow
@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_every_preset_looks_through_the_wall_alone(device, preset):
    scene = furnace(IDENTITY, back_hidden=True)
    image = render(device, scene, 256, max_depth=32, **PRESETS[preset])
    assert image.rgb.mean() == pytest.approx(0.8, rel=0.02)


def test_what_is_not_said_to_be_single_sided_or_is_glass_is_seen_from_behind(device):
    for values in ({}, {"back_hidden": True, "transmission": 1.0, "thin_walled": True}):
        wall = (
            primitives.quad(),
            transform.rotation_xyz_degrees((-90, 0, 0)),
            lambertian(0.5, **values),
        )
        scene = build([wall], camera((0, 0, 3), (0, 0, 0), 20))
        plan = make_plan(scene, Settings())
        assert plan.features["BACK_FACES"].value == 0
        assert "single-sided" in dict(plan.left_out)["back_faces"]
        image = render(device, scene, 1, ["depth"])
        assert image.aovs["depth"].max() < 3.5


def test_only_the_first_rays_of_paths_ask_for_sides():
    plan = make_plan(furnace(IDENTITY, back_hidden=True), Settings())
    asked = {stage.name for stage in plan.stages if plan.defines(stage)["BACK_FACES"]}
    assert asked == {"intersect"}
    shown = make_plan(furnace(IDENTITY, back_hidden=True), Settings(back_faces="shown"))
    assert dict(shown.left_out)["back_faces"] == "back_faces is shown"


def test_a_mesh_is_not_shared_by_hidden_and_shown_backs(monkeypatch):
    for name in ("LEAST_SAVED", "LEAST_REUSE"):
        monkeypatch.setattr(instancing, name, 1)
    levels = instancing.split(placed_soups())
    assert [len(part.shapes) for part in levels.parts] == [4, 4]


def test_the_flag_is_that_of_the_material():
    glass = lambertian(0.5, back_hidden=True, transmission=1.0)
    flags = tables.material_table((HIDDEN, SHOWN, glass))["flags"]
    bit = layout.CONSTANT["MATERIAL_HIDES_BACK"]
    np.testing.assert_array_equal(flags & bit != 0, [True, False, False])
