"""What moves: curves by closed forms, vertices by NumPy, frames by scenes that stand still."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gltf_truth import Glb
from scene_builder import build, camera, floor, glowing, lambertian
from test_gltf import Builder

from psf_cl import tables
from psf_cl.errors import InputError, NoRoomError
from psf_cl.plan import make_plan
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.animation import baked, posed, shaped
from psf_cl.scene.curve import Curve, smooth_curve
from psf_cl.scene.digest import scene_digest
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Mesh, Morphs, Node, Skin
from psf_cl.settings import Settings

SHARED = os.environ.get("PSF_CL_SHARED_SCENES")

# Curves


def curve(values, interpolation="linear", turning=False, times=(1.0, 2.0, 4.0)):
    return Curve(np.array(times), np.array(values, float), interpolation, turning)


def test_a_step_holds_and_a_line_divides_and_both_stand_still_outside():
    keys = [[0.0], [10.0], [30.0]]
    for time, step, line in [(0, 0, 0), (1.5, 0, 5), (2, 10, 10), (3.5, 10, 25), (9, 30, 30)]:
        assert curve(keys, "step").at(time) == step
        assert curve(keys).at(time) == line


def test_a_cubic_curve_is_the_polynomial_that_its_slopes_are_of():
    times = np.array([0.5, 1.25, 3.0])

    def value(t):
        return 2 * t**3 - 5 * t**2 + t - 7

    slope = 6 * times**2 - 10 * times + 1
    keys = np.stack([slope, value(times), slope], axis=1)[:, :, None]
    for time in (0.5, 0.7, 1.25, 2.0, 3.0):
        found = Curve(times, keys, "cubic").at(time)
        np.testing.assert_allclose(found, value(time), rtol=1e-12)


def test_a_smooth_curve_reproduces_parabolas_inside_and_its_keys():
    times = np.array([0.0, 1.0, 2.5, 3.0, 5.0])
    keys = (3 * times**2 - times)[:, None]
    smooth = smooth_curve(times, keys)
    for time, key in zip(times, keys, strict=True):
        np.testing.assert_allclose(smooth.at(time), key)
    np.testing.assert_allclose(smooth.at(1.7), 3 * 1.7**2 - 1.7, rtol=1e-12)
    np.testing.assert_allclose(smooth.at(2.8), 3 * 2.8**2 - 2.8, rtol=1e-12)


def test_quaternions_turn_at_constant_speed_along_the_shorter_arc():
    def about_z(degrees):
        half = np.radians(degrees) / 2
        return np.array([0, 0, np.sin(half), np.cos(half)])

    # The second key is the same rotation as 60 degrees, the long way round.
    turn = curve([about_z(0), -about_z(60), about_z(60)], turning=True)
    for share in (0.25, 0.5, 0.9):
        found = transform.rotation_quaternion(turn.at(1 + share))
        wanted = transform.rotation_xyz_degrees((0, 0, 60 * share))
        np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_the_peak_of_a_curve_is_its_largest_value():
    assert curve([[1.0], [9.0], [4.0]]).peak() == 9
    times = np.array([0.0, 1.0])
    # t (1 - t) has its peak of 1 / 4 between the keys.
    parabola = Curve(times, np.array([[[0.0], [0.0], [1.0]], [[-1.0], [0.0], [0.0]]]), "cubic")
    np.testing.assert_allclose(parabola.peak(), 0.25, rtol=1e-2)


# Scenes


def bending(size=(16, 12), with_tree=False):
    """Return a scene whose last shapes are a lamp, a turning box, and a skinned and morphed strip.

    It is a list of triangles, unless it shall have a tree.
    """
    rows = np.linspace(0.0, 1.0, 5)
    points = np.array([[x, y, 0.1 * y] for y in rows for x in (-0.2, 0.2)], np.float32)
    faces = [[2 * k, 2 * k + 1, 2 * k + 3] for k in range(4)]
    faces += [[2 * k, 2 * k + 3, 2 * k + 2] for k in range(4)]
    share = points[:, 1:2]
    strip = Mesh(
        "strip",
        points,
        np.array(faces, np.uint32),
        normals=np.tile(np.float32([0, 0, 1]), (10, 1)),
        morphs=Morphs(
            np.stack([0.3 * points, np.sin(9 * points)]).astype(np.float32),
            np.stack([points, -points]).astype(np.float32),
            None,
        ),
        joints=np.tile(np.uint32([0, 1]), (10, 1)),
        weights=np.concatenate([1 - share, share], axis=1).astype(np.float32),
    )
    times = np.array([0.0, 1.0])
    turn = Curve(times, np.array([[0.0, 0.0, 0.0], [0.0, 90.0, 40.0]]))
    grow = Curve(times, np.array([[1.0, 1.0, 1.0], [1.0, 2.0, -1.5]]))
    weigh = Curve(times, np.array([[0.0, 0.5], [1.0, -0.25]]))
    rise = Curve(times, np.array([[0.0, 2.0, 0.0], [0.5, 3.0, 0.0]]))
    turned = transform.rotation_xyz_degrees((180, 0, 0))
    nodes = (
        Node(translation=(0.5, 0.0, 0.0), curves={"rotation": turn}),
        Node(0, translation=(0.0, 0.5, 0.0), curves={"rotation": turn, "scale": grow}),
        Node(weights=(0.0, 0.5), curves={"weights": weigh}),
        Node(matrix=transform.translation((-0.7, 0.5, 0.0)) @ transform.scaling(0.3)),
        Node(3, curves={"rotation": turn, "scale": grow}),
        Node(curves={"translation": rise}),
        Node(5, matrix=turned),
    )
    inverse = np.stack([np.eye(4), transform.translation((0.0, -0.5, 0.0))])
    scene = build(
        [
            floor(2.0, lambertian(0.6)),
            (primitives.sphere(12, 8), transform.translation((1, 0.3, -1)), lambertian(0.4)),
            (primitives.quad(), turned, glowing(3.0)),
            (primitives.box(), np.eye(4), lambertian((0.7, 0.3, 0.2))),
            (strip, np.eye(4), lambertian((0.2, 0.6, 0.3))),
        ],
        camera((0, 1.2, 4), (0, 0.5, 0), 40),
        size,
    )
    still, ball, lamp, box, bent = scene.shapes
    moving = (
        replace(lamp, node=6),
        replace(box, node=4),
        replace(bent, node=2, skin=Skin((0, 1), inverse)),
    )
    # It brightens, and at 2 s it is switched off.
    glow = Curve(np.array([0.0, 1.0, 2.0]), np.repeat([[3.0], [5.0], [0.0]], 3, axis=1), "step")
    materials = list(scene.materials)
    materials[lamp.material] = replace(materials[lamp.material], emission_curve=glow)
    shapes = (still, *([ball] if with_tree else []), *moving)
    return replace(scene, nodes=nodes, shapes=shapes, materials=tuple(materials))


def expected_strip(time):
    """Return the strip's vertices at ``time``, vertex by vertex."""
    (mesh,) = [shape.mesh for shape in bending().shapes if shape.skin]
    angle = transform.rotation_xyz_degrees((0, 90 * time, 40 * time))
    lower = transform.translation((0.5, 0, 0)) @ angle
    scale = transform.scaling((1, 1 + time, 1 - 2.5 * time))
    upper = lower @ transform.translation((0, 0.5, 0)) @ angle @ scale
    upper = upper @ transform.translation((0, -0.5, 0))
    weights = (time, 0.5 - 0.75 * time)
    found = []
    for index, point in enumerate(mesh.positions.astype(float)):
        first, second = mesh.morphs.positions[:, index]
        form = point + weights[0] * first + weights[1] * second
        parts = [(matrix @ [*form, 1])[:3] for matrix in (lower, upper)]
        share = mesh.weights[index]
        found.append(share[0] * parts[0] + share[1] * parts[1])
    return np.array(found)


@pytest.mark.parametrize("time", [0.0, 0.3, 1.0, 7.0])
def test_joints_and_morph_targets_form_the_mesh(time):
    (mesh,) = [shape.mesh for shape in shaped(bending(), time).shapes if shape.mesh.name == "strip"]
    np.testing.assert_allclose(mesh.positions, expected_strip(min(time, 1.0)), atol=1e-6)


def test_a_baked_scene_stands_still():
    still = baked(bending(), 0.5)
    assert still.nodes == () and all(shape.node < 0 for shape in still.shapes)
    assert not make_plan(still, Settings()).features["MOTION"].value


def test_a_still_scene_has_no_stage_that_moves_anything_and_the_plan_says_why():
    plan = make_plan(baked(bending(), 0.0), Settings())
    assert "animate" not in [stage.name for stage in plan.stages]
    assert ("motion", "no triangle moves") in plan.left_out
    plan = make_plan(bending(), Settings())
    assert plan.features["MOTION"].reason == "22 triangles move between frames"


# The device


def frame_renderer(device, scene, outputs=(), **settings):
    return Renderer(scene, Settings(**settings), device, outputs)


def records(renderer, name):
    return renderer.device.read(renderer.buffers[name])


@pytest.fixture(scope="module")
def moving(device):
    renderer = frame_renderer(device, bending())
    yield renderer
    renderer.close()


@pytest.mark.parametrize("time", [0.2, 0.9])
def test_the_device_moves_triangles_as_numpy_does(moving, time):
    moving.set_frame(time)
    truth = tables.flatten(shaped(bending(), time))
    found, normals = records(moving, "surfaces"), records(moving, "normals")
    np.testing.assert_allclose(found["p0"], truth.surfaces["p0"], atol=1e-6)
    # Where joints mirror, the corners of the scene that stands still go round the other way.
    swapped = np.abs(found["e1"] - truth.surfaces["e1"]).max(axis=1) > 1e-6
    assert not swapped[:-8].any()
    for name, other in (("e1", "e2"), ("e2", "e1")):
        wanted = np.where(swapped[:, None], truth.surfaces[other], truth.surfaces[name])
        np.testing.assert_allclose(found[name], wanted, atol=1e-6)
    np.testing.assert_allclose(found["ng"], truth.surfaces["ng"], atol=1e-4)
    np.testing.assert_allclose(found["offset"], truth.surfaces["offset"], rtol=1e-5)
    np.testing.assert_allclose(normals["n0"], truth.normals["n0"], atol=1e-5)


def test_the_frame_before_is_kept(moving):
    corners = {}
    for time in (0.1, 0.4, 0.4, 0.4):
        corners[time] = tables.flatten(shaped(bending(), time)).positions[-22:]
        moving.set_frame(time)
    # The second frame at the same time: nothing has moved since the frame before.
    np.testing.assert_allclose(records(moving, "previous")["p"], corners[0.4], atol=1e-6)
    moving.set_frame(0.8)
    np.testing.assert_allclose(records(moving, "previous")["p"], corners[0.4], atol=1e-6)


def means(renderer, spp):
    renderer.render(spp=spp)
    return renderer.image()


@pytest.mark.parametrize("with_tree", [False, True], ids=["list", "tree"])
def test_a_frame_is_the_picture_of_the_scene_as_it_is_then(device, with_tree):
    scene = bending(with_tree=with_tree)
    renderer = frame_renderer(device, scene)
    assert bool(renderer.plan.features["FEW"].value) != with_tree
    for time in (0.3, 1.6):
        # The same random numbers: no pass has been rendered before.
        renderer.set_frame(time)
    fresh = frame_renderer(device, baked(scene, 1.6))
    found, truth = means(renderer, 32), means(fresh, 32)
    assert truth.rgb.mean() > 0.05
    # Vertices are rounded otherwise: a few paths of a few pixels miss an edge, or meet it.
    same = np.abs(found.rgb - truth.rgb).max(axis=2) < 1e-5
    assert same.mean() > 0.8
    np.testing.assert_allclose(found.rgb, truth.rgb, atol=0.1 * truth.rgb.max())
    renderer.set_frame(2.0)
    assert not means(renderer, 2).rgb.any(), "the lamp is off"
    renderer.close()
    fresh.close()


def test_sequences_have_the_same_bits_again(device):
    def sequence():
        renderer = frame_renderer(device, bending())
        images = [means(renderer, 2).rgb]
        for time in (0.25, 0.5, 0.5):
            renderer.set_frame(time)
            images.append(means(renderer, 2).rgb)
        renderer.close()
        return np.stack(images)

    one, other = sequence(), sequence()
    assert one.tobytes() == other.tobytes()
    # Random numbers go on from frame to frame.
    assert (one[2] != one[3]).any()


def test_frames_take_no_memory_and_trees_that_are_built_anew_give_back_the_old(device, monkeypatch):
    scene = bending(with_tree=True)
    renderer = frame_renderer(device, scene)
    taken = []
    for time, most in ((0.2, np.inf), (0.4, np.inf), (0.6, 0.0), (0.6, 0.0), (0.7, np.inf)):
        monkeypatch.setattr("psf_cl.renderer.REBUILD_RATIO", most)
        renderer.set_frame(time)
        taken.append(device.allocated_bytes - renderer.bvh.nodes.bytes - renderer.bvh.blocks.bytes)
    # The refit has two words a node.
    assert max(taken) - min(taken) < 1024
    assert renderer.stats()["bvh"]["rebuilds"] == 1, "at the second 0.6 s nothing had moved"
    fresh = frame_renderer(device, baked(scene, 0.7))
    same = np.abs(means(renderer, 16).rgb - means(fresh, 16).rgb).max(axis=2) < 1e-5
    assert same.mean() > 0.8
    renderer.close()
    fresh.close()


def test_frames_go_on_with_the_fitted_tree_where_another_has_no_room(device, monkeypatch):
    def full(*_):
        raise NoRoomError("no room for a tree")

    renderer = frame_renderer(device, bending(with_tree=True))
    monkeypatch.setattr("psf_cl.renderer.REBUILD_RATIO", 0.0)
    monkeypatch.setattr("psf_cl.renderer.build_bvh", full)
    renderer.set_frame(0.6)
    image = means(renderer, 2)
    renderer.close()
    assert np.isfinite(image.rgb).all()
    assert image.stats["bvh"]["rebuilds"] == 0
    assert image.stats["bvh"]["rebuilds_without_room"] >= 1


def test_frames_of_a_still_scene_add_up_to_one_long_render(device):
    still = baked(bending(), 0.4)
    renderer, long = frame_renderer(device, still), frame_renderer(device, still)
    total = np.zeros((12, 16, 3))
    for frame in range(8):
        if frame:
            renderer.set_frame(frame / 24)
        total += means(renderer, 2).rgb
    np.testing.assert_allclose(total / 8, means(long, 16).rgb, rtol=1e-4, atol=1e-5)
    renderer.close()
    long.close()


def test_motion_is_how_far_points_moved_on_the_film(device):
    # A wall 4 m before the camera goes 0.5 m up, the camera 0.25 m to the right.
    side = transform.rotation_xyz_degrees((90, 0, 0))
    up = Curve(np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]]))
    right = Curve(np.array([0.0, 1.0]), np.array([[0.0, 0.0, 4.0], [0.25, 0.0, 4.0]]))
    scene = build(
        [(primitives.quad(), side @ transform.scaling(9.0), lambertian(0.5))],
        camera((0, 0, 4), (0, 0, 0), 40),
        (20, 10),
        environment=1.0,
    )
    view = replace(scene.cameras[0], node=2)
    (wall,) = scene.shapes
    nodes = (Node(curves={"translation": up}), Node(0, matrix=wall.transform))
    nodes += (Node(curves={"translation": right}),)
    wall = replace(wall, node=1)
    scene = replace(scene, nodes=nodes, cameras=(view,), shapes=(wall,))
    renderer = frame_renderer(device, scene, ("motion",), max_depth=0)
    assert np.abs(means(renderer, 2).aovs["motion"]).max() < 1e-5
    renderer.set_frame(1.0)
    found = means(renderer, 2).aovs["motion"]
    pixel = 2 * np.tan(np.radians(20)) * 4 / 10
    # Seen from the camera the wall went left and up.
    np.testing.assert_allclose(found[..., 0], -0.25 / pixel, rtol=1e-3)
    np.testing.assert_allclose(found[..., 1], -0.5 / pixel, rtol=1e-3)
    renderer.close()


# TOML

SCENE = """
[camera]
position = [0, 1, 5]
target = [0, 0, 0]
[materials.lamp]
emission = [1, 2, 3]
[[shapes]]
name = "door"
primitive = "box"
transform = [{ scale = 0.5 }, { translate = [1, 0, 0] }]
[[shapes]]
primitive = "quad"
material = "lamp"
[[lights]]
type = "point"
name = "bulb"
position = [0, 1, 0]
color = [1, 0.5, 0]
[[animation]]
target = "door"
property = "rotation"
pivot = [0.5, 0, 0]
times = [0, 2]
values = [[0, 0, 0], [0, 90, 0]]
[[animation]]
target = "lamp"
property = "emission"
times = [0, 1]
values = [[1, 1, 1], [5, 6, 7]]
interpolation = "step"
[[animation]]
target = "bulb"
property = "intensity"
times = [0, 1]
values = [10, 20]
[[animation]]
target = "bulb"
property = "position"
times = [0, 1]
values = [[0, 1, 0], [2, 1, 0]]
[[animation]]
target = "camera"
property = "target"
times = [0, 1]
values = [[0, 0, 0], [1, 0, 0]]
interpolation = "cubic"
"""


def test_toml_keyframes_move_shapes_lights_cameras_and_emission(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(SCENE)
    scene = posed(load_scene(path, moving=True), 1.0)
    door = scene.shapes[-1]
    assert door.name == "door"
    # The corner at the hinge stays, what was 0.5 m right of it is now turned by 45 degrees.
    np.testing.assert_allclose((door.transform @ [-1, 1, 0, 1])[:3], [0.5, 0.5, 0], atol=1e-12)
    half = 0.5 * np.sqrt(0.5)
    middle = (door.transform @ [0, 0, 0, 1])[:3]
    np.testing.assert_allclose(middle, [0.5 + half, 0, -half], atol=1e-12)
    assert scene.materials[scene.shapes[0].material].emission == (5.0, 6.0, 7.0)
    (bulb,) = scene.lights
    assert bulb.intensity == (20.0, 10.0, 0.0) and bulb.position == (2.0, 1.0, 0.0)
    back = scene.cameras[0].transform[:3, 2]
    np.testing.assert_allclose(back, np.array([-1, 1, 5]) / np.sqrt(27))


def test_without_time_a_scene_is_as_if_it_had_no_animation(tmp_path):
    path, plain = tmp_path / "a.toml", tmp_path / "b.toml"
    path.write_text(SCENE)
    plain.write_text(SCENE.split("[[animation]]")[0])
    still, truth = load_scene(path), load_scene(plain)
    assert still.nodes == () and still.lights == truth.lights and still.materials == truth.materials
    for one, other in zip(still.shapes, truth.shapes, strict=True):
        np.testing.assert_array_equal(one.transform, other.transform)


def test_a_sequence_of_a_scene_without_animation_is_told_so(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(SCENE.split("[[animation]]")[0])
    scene = load_scene(path, moving=True)
    assert scene.nodes == () and "every frame shows the same" in scene.notes[-1]


def test_a_camera_that_looks_at_itself_is_told_with_the_time(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(SCENE.replace("[1, 0, 0]]\ninterpolation", "[0, 1, 5]]\ninterpolation"))
    scene = load_scene(path, moving=True)
    with pytest.raises(InputError, match="camera '' at 1 s"):
        posed(scene, 1.0)


@pytest.mark.parametrize("path", sorted(Path(__file__).parents[1].glob("scenes/moving/*.toml")))
def test_example_scenes_move_and_say_what_for(path):
    assert path.read_text().startswith("# ")
    scene = load_scene(path, moving=True)
    assert scene.notes == ()
    early, late = (load_scene(path, time=time) for time in (0.0, 0.6))
    assert scene_digest(early) != scene_digest(late)


# glTF


def animated(builder, **changes):
    """Add a triangle with two morph targets that an animation moves; ``changes`` go into its parts.

    Keys are ``sampler``, ``channel``, ``target``, ``times``, ``values`` and ``node``.
    """
    deltas = [{"POSITION": builder.accessor(np.ones((3, 3)))} for _ in range(2)]
    mesh = builder.mesh(targets=deltas)
    builder.node(mesh=mesh, **changes.get("node", {}))
    path = changes.get("target", {}).get("path", "translation")
    width = {"rotation": 4, "weights": 1}.get(path, 3)
    times, values = changes.get("times", [0, 1]), changes.get("values", np.ones((2, width)))
    sampler = {"input": builder.accessor(times), "output": builder.accessor(values)}
    channel = {"sampler": 0, "target": {"node": 0, "path": path} | changes.get("target", {})}
    builder.add(
        "animations",
        name="move",
        samplers=[sampler | changes.get("sampler", {})],
        channels=[channel | changes.get("channel", {})],
    )
    return builder


MISTAKES = [
    ({"sampler": {"interpolation": "SMOOTH"}}, "samplers[0].interpolation: expected one of STEP"),
    ({"sampler": {"input": 99}}, "samplers[0].input: expected an index of accessors"),
    ({"channel": {"sampler": 1}}, "channels[0].sampler: expected an index of samplers"),
    ({"target": {"path": "color"}}, "target.path: expected one of translation"),
    ({"target": {"node": 7}}, "target.node: expected an index of nodes"),
    ({"times": [1, 1]}, "samplers[0].input: expected an accessor of finite times that grow"),
    ({"times": [0, np.nan]}, "samplers[0].input: expected an accessor of finite times that grow"),
    ({"values": np.ones((3, 3))}, "samplers[0].output: expected an accessor of 2 elements"),
    ({"values": [[1, 2, np.inf], [0, 0, 0]]}, "samplers[0].output: expected an accessor of finite"),
    ({"sampler": {"interpolation": "CUBICSPLINE"}}, "expected an accessor of 6 elements"),
    ({"target": {"path": "weights"}}, "samplers[0].output: expected an accessor of 4 elements"),
    (
        {"target": {"path": "rotation"}, "values": np.zeros((2, 4))},
        "samplers[0].output: expected an accessor of quaternions that are not zero",
    ),
    ({"node": {"matrix": np.eye(4).ravel().tolist()}}, "expected a node without a matrix"),
    ({"node": {"weights": [1]}}, "nodes[0].weights: expected 2 numbers"),
]


@pytest.mark.parametrize(("changes", "message"), MISTAKES, ids=[text for _, text in MISTAKES])
def test_a_mistake_in_an_animation_is_told_in_one_line(tmp_path, changes, message):
    (tmp_path / "a.glb").write_bytes(animated(Builder(), **changes).glb())
    with pytest.raises(InputError) as caught:
        posed(load_scene(tmp_path / "a.glb", moving=True), 0.5)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_clips_are_picked_by_name_or_number(tmp_path):
    builder = animated(Builder(), values=[[0, 0, 0], [1, 0, 0]])
    second = {"input": 3, "output": builder.accessor([[0, 0, 0], [0, 5, 0]])}
    channel = {"sampler": 0, "target": {"node": 0, "path": "translation"}}
    builder.add("animations", name="jump", samplers=[second], channels=[channel])
    (tmp_path / "a.glb").write_bytes(builder.glb())
    for clip, place in ((None, [1, 0, 0]), ("jump", [0, 5, 0]), ("1", [0, 5, 0])):
        scene = load_scene(tmp_path / "a.glb", time=9.0, clip=clip)
        np.testing.assert_array_equal(scene.shapes[0].transform[:3, 3], place)
    with pytest.raises(InputError, match="no animation 'walk'; known: 'move', 'jump'"):
        load_scene(tmp_path / "a.glb", time=9.0, clip="walk")


# Files


def shared_clips():
    if not SHARED:
        return [pytest.param("none", 0, marks=pytest.mark.skip("PSF_CL_SHARED_SCENES is not set"))]
    found = []
    for path in sorted(Path(SHARED, "animated").glob("*.glb")):
        clips = len(Glb(path).json["animations"])
        # Of the files with several, one has a clip for each thing and one has three for all.
        found += [(path.name, clip) for clip in (range(clips) if "Fox" in path.name else [None])]
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("name", "clip"), shared_clips())
def test_vertices_are_those_of_an_evaluation_of_its_own(device, name, clip):
    path = Path(SHARED, "animated", name)
    truth = Glb(path)
    clips = [clip] if clip is not None else list(range(len(truth.json["animations"])))
    ends = [
        truth.read(sampler["input"]).max()
        for index in clips
        for sampler in truth.json["animations"][index]["samplers"]
    ]
    text = None if clip is None else str(clip)
    scene = load_scene(path, moving=True, clip=text, size=(16, 16))
    renderer = Renderer(scene, Settings(), device)
    for time in np.linspace(0.03, 1.05, 5) * max(ends):
        renderer.set_frame(float(time))
        surfaces = records(renderer, "surfaces")
        found = np.stack(
            [surfaces["p0"], surfaces["p0"] + surfaces["e1"], surfaces["p0"] + surfaces["e2"]],
            axis=1,
        )
        wanted = np.concatenate(truth.corners(clips, float(time)))
        bounds = np.linalg.norm(wanted.max(axis=(0, 1)) - wanted.min(axis=(0, 1)))
        # Shapes that move come last here: compare triangle by triangle, in a common order.
        found, wanted = (in_order(corners, bounds) for corners in (found, wanted))
        assert np.abs(found - wanted).max() < 1e-5 * bounds
    renderer.close()


def in_order(corners, bounds):
    rows = corners.reshape(-1, 9)
    keys = np.round(rows.mean(axis=1) / bounds * 1e3), *np.round(rows / bounds * 1e3).T
    return rows[np.lexsort(keys)]


def test_scenes_without_a_gltf_file_have_no_clips():
    scene = Path(__file__).resolve().parents[1] / "scenes" / "moving" / "door_opens.toml"
    with pytest.raises(InputError, match="clip: expected a scene with a glTF file"):
        load_scene(scene, clip="1", moving=True)
