"""TOML scenes: what a good one becomes, and the one line that each kind of mistake gets."""

from __future__ import annotations

import base64
import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from psf_cl.errors import InputError
from psf_cl.scene.load import load_scene
from psf_cl.scene.transform import transform_points

QUAD = '[[shapes]]\nprimitive = "quad"\n'
CAMERA = "[camera]\nposition = [0, 1, 4]\ntarget = [0, 1, 0]\n"

TRIANGLES = """mtllib box.mtl
v 0 0 0
v 1 0 0
v 0 1 0
usemtl red
f 1 2 3
usemtl blue
f 3 2 1
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a mesh of two materials, an image and a broken mesh."""
    (tmp_path / "tri.obj").write_text(TRIANGLES)
    (tmp_path / "box.mtl").write_text("newmtl red\nKd 0.5 0.1 0.1\nnewmtl blue\nKd 0.1 0.1 0.5\n")
    (tmp_path / "broken.ply").write_text("ply\nformat ascii 1.0\nelement vertex three\n")
    header = struct.pack("<BBBHHBHHHHBB", 0, 0, 2, 0, 0, 0, 0, 0, 2, 1, 24, 0x20)
    (tmp_path / "pixels.tga").write_bytes(header + bytes([0, 0, 255, 0, 255, 0]))
    return tmp_path


def load(folder: Path, text: str):
    (folder / "scene.toml").write_text(text)
    return load_scene(folder / "scene.toml")


def test_transform_steps_are_applied_in_the_order_they_are_written(folder):
    steps = "{ scale = [2, 1, 1] }, { rotate = [0, 90, 0] }, { translate = [0, 0, 5] }"
    scene = load(folder, QUAD + f"transform = [{steps}]")
    moved = transform_points(scene.shapes[0].transform, np.array([[1.0, 0, 0], [0, 0, 1]]))
    # x = 1 is scaled to 2, turned about Y by 90 degrees to z = -2, moved to z = 3; z = 1 goes to
    # x = 1, z = 5.  Worked out by hand.
    assert np.array_equal(moved, [[0, 0, 3], [1, 0, 5]])


def test_a_matrix_step_is_read_row_by_row(folder):
    step = "transform = [{ matrix = [[0, -1, 0, 7], [1, 0, 0, 8], [0, 0, 1, 9], [0, 0, 0, 1]] }]"
    scene = load(folder, QUAD + step)
    assert np.array_equal(transform_points(scene.shapes[0].transform, [[1, 2, 3]]), [[5, 9, 12]])


def test_the_camera_looks_from_its_position_at_its_target(folder):
    text = "[camera]\nposition = [1, 2, 3]\ntarget = [4, 2, 3]\nfov_y = 40\nlens_radius = 0.1\n"
    camera = load(folder, QUAD + text).cameras[0]
    assert np.allclose(camera.transform @ [0, 0, -1, 0], [1, 0, 0, 0], atol=1e-12)
    assert np.allclose(camera.transform @ [0, 1, 0, 0], [0, 1, 0, 0], atol=1e-12)
    assert np.array_equal(camera.transform[:3, 3], [1, 2, 3])
    assert camera.fov_y == pytest.approx(math.pi * 40 / 180)
    assert camera.focus_distance == 3.0


def test_a_camera_with_a_height_is_orthographic(folder):
    assert load(folder, QUAD + CAMERA + "height = 2.5\n").cameras[0].height == 2.5


def test_a_material_table_overrides_the_mesh_files_material_of_that_name_only(folder):
    text = '[materials.red]\nroughness = 0.25\n[[shapes]]\nmesh = "tri.obj"\n'
    materials = {material.name: material for material in load(folder, text).materials}
    assert materials["red"].roughness == 0.25
    assert materials["red"].base_color == (0.5, 0.1, 0.1)
    assert materials["blue"].roughness == 1.0


def test_emission_on_a_shape_copies_its_materials_and_leaves_the_others_dark(folder):
    text = '[[shapes]]\nmesh = "tri.obj"\nemission = [1, 2, 3]\n[[shapes]]\nmesh = "tri.obj"\n'
    scene = load(folder, text)
    emission = [scene.materials[shape.material].emission for shape in scene.shapes]
    assert sorted(emission) == [(0, 0, 0), (0, 0, 0), (1, 2, 3), (1, 2, 3)]
    assert {scene.materials[shape.material].name for shape in scene.shapes} == {"red", "blue"}
    assert not any(material.double_sided for material in scene.materials)


def test_two_sided_makes_both_sides_emit(folder):
    scene = load(folder, QUAD + "emission = [1, 1, 1]\ntwo_sided = true\n")
    assert scene.materials[scene.shapes[0].material].double_sided


@pytest.mark.parametrize(
    ("keys", "expected"),
    [("", False), ("double_sided = false", True), ("double_sided = true", False)],
)
def test_backs_are_hidden_where_the_file_says_so(folder, keys, expected):
    text = f'[materials.red]\nroughness = 0.25\n{keys}\n[[shapes]]\nmesh = "tri.obj"\n'
    (red,) = (material for material in load(folder, text).materials if material.name == "red")
    assert red.back_hidden == expected


def test_what_emits_from_both_sides_is_seen_from_both(folder):
    text = "[materials.lamp]\ndouble_sided = false\n"
    text += QUAD + 'material = "lamp"\nemission = [1, 1, 1]\ntwo_sided = true\n'
    scene = load(folder, text)
    assert not scene.materials[scene.shapes[0].material].back_hidden


def test_a_mesh_that_is_placed_twice_is_loaded_once(folder):
    scene = load(folder, '[[shapes]]\nmesh = "tri.obj"\n' * 2)
    assert len(scene.shapes) == 4
    assert len({id(shape.mesh) for shape in scene.shapes}) == 2


def write_gltf(folder: Path) -> None:
    """Write a textured triangle, a camera at z = 5 that looks along -Z, and a point light."""
    positions = base64.b64encode(struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)).decode()
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_lights_punctual"],
        "extensions": {
            "KHR_lights_punctual": {"lights": [{"type": "point", "intensity": 3, "name": "bulb"}]}
        },
        "scene": 0,
        "scenes": [{"nodes": [0, 1, 2]}],
        "nodes": [
            {"mesh": 0},
            {"camera": 0, "translation": [0, 0, 5], "name": "view"},
            {"translation": [0, 1, 0], "extensions": {"KHR_lights_punctual": {"light": 0}}},
        ],
        "cameras": [
            {"type": "perspective", "name": "view", "perspective": {"yfov": 0.5, "znear": 0.1}}
        ],
        "images": [{"uri": "pixels.png"}],
        "textures": [{"source": 0}],
        "materials": [
            {"name": "cloth", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 3,
                "type": "VEC3",
                "min": [0, 0, 0],
                "max": [1, 1, 0],
            }
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": f"data:application/octet-stream;base64,{positions}"}],
    }
    (folder / "tri.gltf").write_text(json.dumps(document))
    Image.new("RGB", (1, 1), (1, 2, 3)).save(folder / "pixels.png")


def test_a_gltf_file_brings_its_camera_and_light_along_its_shapes_transform(folder):
    write_gltf(folder)
    text = (
        '[[shapes]]\nmesh = "tri.gltf"\ntransform = [{ scale = 2 }, { translate = [10, 0, 0] }]\n'
        '[camera]\nfrom = "view"\nlens_radius = 0.5\n'
    )
    scene = load(folder, text)
    camera = scene.cameras[scene.camera]
    expected = np.eye(4)
    expected[:3, 3] = [10, 0, 10]
    assert np.allclose(camera.transform, expected)
    assert (camera.fov_y, camera.lens_radius) == (0.5, 0.5)
    (light,) = scene.lights
    assert light.position == (10, 2, 0)
    assert light.intensity == (3, 3, 3)


def test_textures_of_a_gltf_file_stay_with_their_materials(folder):
    write_gltf(folder)
    text = (
        '[materials.a]\nbase_color_texture = "pixels.tga"\n[materials.cloth]\nroughness = 0.5\n'
        + QUAD + 'material = "a"\n[[shapes]]\nmesh = "tri.gltf"\n'
    )  # fmt: skip
    scene = load(folder, text)
    first = {
        material.name: scene.textures[material.base_color_texture].pixels[0, 0, :3].tolist()
        for material in scene.materials
    }
    assert first == {"a": [255, 0, 0], "cloth": [1, 2, 3]}
    assert {material.roughness for material in scene.materials} == {0.5, 1.0}


def test_a_texture_of_a_material_is_found_beside_the_scene(folder):
    text = '[materials.a]\nbase_color_texture = "pixels.tga"\n' + QUAD + 'material = "a"\n'
    scene = load(folder, text)
    assert scene.materials[scene.shapes[0].material].base_color_texture == 0
    assert scene.textures[0].pixels[0].tolist() == [[255, 0, 0, 255], [0, 255, 0, 255]]


def test_a_texture_may_be_a_table_and_numbers_are_not_decoded(folder):
    table = (
        '{ file = "pixels.tga", uv_set = 1, scale = 2, rotation = 90, offset = [0.5, 0], '
        'wrap = "mirror", filter = "nearest" }'
    )
    text = f"[materials.a]\nmetallic_roughness_texture = {table}\n" + QUAD + 'material = "a"\n'
    text = text.replace("[[shapes]]", 'base_color_texture = "pixels.tga"\n[[shapes]]')
    scene = load(folder, text)
    material = scene.materials[scene.shapes[0].material]
    base = scene.textures[material.base_color_texture]
    rough = scene.textures[material.metallic_roughness_texture]
    assert (base.srgb, base.wrap, base.filter) == (True, ("repeat", "repeat"), "linear")
    assert (rough.srgb, rough.wrap, rough.filter) == (False, ("mirror", "mirror"), "nearest")
    assert rough.uv_set == 1 and rough.pixels is base.pixels
    np.testing.assert_allclose(rough.transform, (0, 2, 0.5, -2, 0, 0), atol=1e-12)


def test_every_parameter_of_a_material_can_be_written(folder):
    values = {
        "specular_color": (0.5, 0.25, 1.0),
        "thin_walled": True,
        "attenuation_color": (0.5, 1.0, 0.25),
        "attenuation_distance": 2.0,
        "clearcoat": 0.5,
        "clearcoat_roughness": 0.25,
        "sheen_color": (1.0, 0.5, 0.0),
        "sheen_roughness": 0.75,
        "anisotropy": 0.5,
        "normal_scale": -1.0,
        "alpha": 0.5,
        "unlit": True,
    }
    lines = "".join(
        f"{name} = {json.dumps(value)}\n"
        for name, value in (values | {"anisotropy_rotation": 90.0}).items()
    )
    scene = load(folder, f'[materials.a]\nalpha_mode = "blend"\n{lines}{QUAD}material = "a"\n')
    material = scene.materials[0]
    assert {name: getattr(material, name) for name in values} == values
    assert material.alpha_mode == "blend"
    assert material.anisotropy_rotation == pytest.approx(np.pi / 2)


def test_a_spot_light_is_color_times_intensity_with_angles_in_radians(folder):
    text = """[[lights]]
type = "spot"
position = [0, 2, 0]
direction = [0, -5, 0]
color = [1, 0.5, 0]
intensity = 100
inner_angle = 20
outer_angle = 30
"""
    (light,) = load(folder, QUAD + text).lights
    assert light.intensity == (100, 50, 0)
    assert light.direction == (0, -1, 0)
    assert (light.inner_angle, light.outer_angle) == pytest.approx((math.pi / 9, math.pi / 6))


@pytest.mark.parametrize(
    "rotation", ["[0, 90, 0]", "[[0, 0, 1], [0, 1, 0], [-1, 0, 0]]",
                 "[[0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]]"]
)  # fmt: skip
def test_an_environment_turns_by_angles_or_by_a_matrix(folder, rotation):
    text = f"[environment]\nradiance = [1, 2, 3]\nrotation = {rotation}\n"
    environment = load(folder, QUAD + text).environment
    assert environment.radiance == (1, 2, 3)
    assert np.allclose(environment.rotation @ [1, 0, 0], [0, 0, -1], atol=1e-12)


def test_film_and_render_tables_come_through(folder):
    text = '[film]\nwidth = 32\nheight = 16\n[render]\npreset = "pt"\nmax_depth = 3\n'
    scene = load(folder, text + QUAD)
    assert (scene.width, scene.height) == (32, 16)
    assert scene.render == {"preset": "pt", "max_depth": 3}


def test_a_scene_without_camera_and_light_gets_both_and_says_so(folder):
    scene = load(folder, QUAD)
    assert scene.environment.radiance == (1, 1, 1)
    assert len(scene.cameras) == 1
    assert sum("no camera" in note for note in scene.notes) == 1
    assert sum("no light" in note for note in scene.notes) == 1


@pytest.mark.parametrize(
    "light",
    [
        "emission = [0, 1, 0]\n",
        '[[lights]]\ntype = "point"\nposition = [0, 1, 0]\n',
        "[environment]\nradiance = [0, 0, 0.1]\n",
    ],
)
def test_a_scene_with_any_light_keeps_its_environment(folder, light):
    scene = load(folder, QUAD + light)
    assert scene.environment.radiance != (1, 1, 1)
    assert not any("no light" in note for note in scene.notes)


@pytest.mark.parametrize("primitive", ["box", "sphere"])
def test_the_framing_view_shows_every_vertex(folder, primitive):
    film = "[film]\nwidth = 100\nheight = 300\n"
    part = f'[[shapes]]\nprimitive = "{primitive}"\ntransform = [{{ scale = [9, 0.1, 2] }}, '
    near, far = "{ translate = [100, -50, 3] }]\n", "{ rotate = [30, 50, 70] }]\n"
    scene = load(folder, film + part + near + part + far)
    (camera,) = scene.cameras
    world = np.concatenate(
        [transform_points(shape.transform, shape.mesh.positions) for shape in scene.shapes]
    )
    seen = transform_points(np.linalg.inv(camera.transform), world)
    slope_y = math.tan(camera.fov_y / 2)
    assert (seen[:, 2] < 0).all()
    assert (np.abs(seen[:, 1]) <= slope_y * -seen[:, 2]).all()
    assert (np.abs(seen[:, 0]) <= slope_y / 3 * -seen[:, 2]).all()


def test_a_texture_of_light_that_is_not_there_is_left_out(folder):
    used = textured_quad(folder, "emission = [0, 0, 1]\n")
    assert len(used.textures) == 1 and used.materials[0].emission_texture == 0
    dark = textured_quad(folder, "")
    assert dark.textures == () and dark.materials[0].emission_texture == -1


def textured_quad(folder, more):
    Image.new("RGB", (2, 2)).save(folder / "glow.png")
    material = f'[materials.m]\nemission_texture = "glow.png"\n{more}'
    return load(folder, material + QUAD + 'material = "m"\n')


def test_every_file_that_was_read_is_known(folder):
    Image.new("RGB", (2, 2)).save(folder / "glow.png")
    (folder / "skin.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    (folder / "a.mtl").write_text("newmtl a\nmap_Kd glow.png\n")
    scene = load(folder, '[[shapes]]\nmesh = "skin.obj"\n')
    names = {Path(name).name for name in scene.files}
    assert names == {"scene.toml", "skin.obj", "a.mtl", "glow.png"}
    assert all(Path(name).is_file() for name in scene.files)


def test_cameras_are_picked_by_name(folder):
    two = "".join(
        f'[[cameras]]\nname = "{name}"\nposition = [0, 0, {z}]\ntarget = [0, 0, 0]\n'
        for name, z in (("near", 1), ("far", 9))
    )
    (folder / "scene.toml").write_text(QUAD + two)
    scene = load_scene(folder / "scene.toml", camera="far")
    assert scene.cameras[scene.camera].transform[2, 3] == 9
    with pytest.raises(InputError, match=r"no camera 'middle'; known: 'near', 'far'"):
        load_scene(folder / "scene.toml", camera="middle")


def test_size_replaces_the_films_and_is_checked(folder):
    (folder / "scene.toml").write_text(QUAD)
    scene = load_scene(folder / "scene.toml", size=(7, 9))
    assert (scene.width, scene.height) == (7, 9)
    with pytest.raises(InputError, match="size"):
        load_scene(folder / "scene.toml", size=(0, 9))


# Each row: the text, then what the message must contain.
MISTAKES = [
    ("[film\n", "line 1"),
    ("width = 3\n", "width: unknown key"),
    ("[film]\nwdith = 3\n", "film.wdith: unknown key; did you mean width?"),
    ("[film]\nwidth = 0\n", "film.width: expected an integer from 1 to 16384 (pixels); got 0"),
    ("[film]\nwidth = 10.5\n", "film.width: expected an integer"),
    ("[film]\nwidth = true\n", "film.width: expected an integer"),
    ('[film]\nwidth = "10"\n', "film.width: expected an integer from 1 to 16384 (pixels); got '1"),
    ("film = 3\n", "film: expected a table; got 3"),
    ("[[camera]]\n", "camera: expected a table"),
    ("[camera]\nposition = [0, 0, 1]\n", "camera.target: missing"),
    ("[camera]\nposition = [0, 0]\ntarget = [0, 0, 0]\n", "camera.position: expected 3 finite"),
    ("[camera]\nposition = [0, 0, nan]\ntarget = [0, 0, 0]\n", "camera.position: expected 3"),
    ("[camera]\nposition = [0, 0, 0]\ntarget = [0, 0, 0]\n", "camera: position, target and up"),
    ("[camera]\nposition = [0, 1, 0]\ntarget = [0, 0, 0]\n", "camera: position, target and up"),
    (CAMERA + "fov_y = 40\nheight = 2\n", "camera.height: expected either height or fov_y"),
    (CAMERA + "height = 0\n", "camera.height: expected a finite number above 0"),
    (CAMERA + "fov_y = 180\n", "camera.fov_y: expected a finite number from 0.001 to 179"),
    (CAMERA + "focus_distance = 0\n", "camera.focus_distance: expected"),
    ('[camera]\nfrom = "x"\n', "camera.from: no camera 'x' in the meshes; known: none"),
    ('[camera]\nfrom = "x"\nup = [0, 1, 0]\n', "camera.up: expected either from or"),
    (CAMERA + "[[cameras]]\n", "cameras: expected either [camera] or [[cameras]]"),
    ("[environment]\nradiance = [1, 1, -1]\n", "environment.radiance: expected 3 finite"),
    ("[environment]\nradiance = [1, 1, inf]\n", "environment.radiance: expected 3 finite"),
    ("[environment]\nscale = 2\n", "environment.scale: "),
    ('[environment]\nimage = "sky.exr"\n', "environment.image: no such file"),
    ('[environment]\nimage = "tri.obj"\n', "environment.image: "),
    ("[environment]\nrotation = [1, 2]\n", "environment.rotation: expected"),
    ("[environment]\nrotation = [[1, 0, 0], [0, 2, 0], [0, 0, 1]]\n", "rotation: expected a rot"),
    ("[materials.a]\ncolour = [1, 1, 1]\n", "materials.a.colour: unknown key"),
    ("[materials.a]\nbase_colour = [1, 1, 1]\n", "did you mean base_color"),
    ("[materials.a]\nbase_color = [1, 1, 2]\n", "materials.a.base_color: expected 3 finite"),
    ("[materials.a]\nroughness = -1\n", "materials.a.roughness: expected"),
    ("[materials.a]\nior = 0.5\n", "materials.a.ior: expected"),
    ('[materials.a]\nalpha_mode = "BLEND"\n', "a.alpha_mode: expected one of opaque, mask, blend"),
    ('[materials.a]\nbase_color_texture = "no.png"\n', "a.base_color_texture: no such file"),
    ('[materials.a]\nbase_color_texture = "tri.obj"\n', "materials.a.base_color_texture: "),
    ("[materials.a]\nnormal_texture = { uv_set = 1 }\n", "normal_texture.file: missing"),
    ('[materials.a]\nnormal_texture = { file = "no.png" }\n', "normal_texture.file: no such"),
    ("[materials]\na = 3\n", "materials.a: expected a table"),
    ("[shapes]\n", "shapes: expected an array of tables"),
    ("shapes = [3]\n", "shapes: expected an array of tables"),
    ("[[shapes]]\n", "shapes[0]: expected either mesh or primitive"),
    (QUAD + 'mesh = "tri.obj"\n', "shapes[0]: expected either mesh or primitive"),
    ('[[shapes]]\nprimitive = "cube"\n', "shapes[0].primitive: expected one of quad, box, sphere"),
    ('[[shapes]]\nmesh = "none.obj"\n', "shapes[0].mesh: no such file"),
    ('[[shapes]]\nmesh = "."\n', "shapes[0].mesh: expected a file"),
    ('[[shapes]]\nmesh = "box.mtl"\n', "shapes[0].mesh: "),
    ('[[shapes]]\nmesh = "broken.ply"\n', "shapes[0].mesh: "),
    ('[[shapes]]\nmesh = "scene.toml"\n', "shapes[0].mesh: "),
    (QUAD + 'material = "a"\n', "shapes[0].material: no [materials.a] in this file; known: none"),
    (QUAD + "emission = 5\n", "shapes[0].emission: expected 3 finite"),
    (QUAD + "two_sided = 1\n", "shapes[0].two_sided: expected true or false"),
    (QUAD + QUAD + 'transform = [{ rotate = "x" }]\n', "shapes[1].transform[0].rotate: expected 3"),
    (QUAD + "transform = [{ scale = 0 }]\n", "shapes[0].transform[0].scale: expected"),
    (QUAD + "transform = [{}]\n", "shapes[0].transform[0]: expected exactly one of scale"),
    (QUAD + "transform = [{ scale = 1, rotate = [0, 0, 0] }]\n", "transform[0]: expected exactly"),
    (QUAD + "transform = [{ turn = 3 }]\n", "shapes[0].transform[0].turn: unknown key"),
    (QUAD + "transform = { scale = 3 }\n", "shapes[0].transform: expected an array of tables"),
    (QUAD + "transform = [{ matrix = [[1]] }]\n", "shapes[0].transform[0].matrix: expected a 4x4"),
    (
        QUAD + "transform = [{ matrix = [[1,0,0,0],[1,0,0,0],[0,0,1,0],[0,0,0,1]] }]\n",
        "shapes[0].transform[0].matrix: expected an invertible",
    ),
    ("[[lights]]\n", "lights[0].type: missing"),
    ('[[lights]]\ntype = "sun"\n', "lights[0].type: expected one of point, spot, directional"),
    ('[[lights]]\ntype = "point"\n', "lights[0].position: missing"),
    ('[[lights]]\ntype = "directional"\n', "lights[0].direction: missing"),
    (
        '[[lights]]\ntype = "directional"\ndirection = [0, 0, 0]\n',
        "lights[0].direction: expected a direction",
    ),
    (
        '[[lights]]\ntype = "directional"\ndirection = [0, 1, 0]\nrange = 3\n',
        "lights[0].range: a directional light has no range",
    ),
    (
        '[[lights]]\ntype = "spot"\nposition = [0, 0, 0]\ndirection = [0, 1, 0]\n'
        "inner_angle = 50\n",
        "lights[0].inner_angle: expected less than outer_angle",
    ),
    ('[[lights]]\ntype = "point"\nposition = [0, 0, 0]\nintensity = -1\n', "lights[0].intensity: "),
    ("[[animation]]\n", "animation[0].target: missing"),
    (
        '[[animation]]\ntarget = "a"\nproperty = "scale"\ntimes = [1, 0]\nvalues = [1, 2]\n',
        "animation[0].times: expected times that grow",
    ),
    (
        '[[animation]]\ntarget = "a"\nproperty = "scale"\ntimes = [0, 1]\nvalues = [1, 2]\n',
        "animation[0].target: no shape is called 'a'",
    ),
    (
        '[[animation]]\ntarget = "a"\nproperty = "scale"\ntimes = [0, 1]\nvalues = [1]\n',
        "animation[0].values: expected one value a time, 2; got 1",
    ),
    (
        '[[animation]]\ntarget = "a"\nproperty = "emission"\ntimes = [0]\nvalues = [1]\n',
        "animation[0].values: expected for each time of emission: 3 numbers",
    ),
    (
        '[[animation]]\ntarget = "a"\nproperty = "intensity"\ntimes = [0]\nvalues = [-1]\n',
        "animation[0].values: expected numbers from 0 to 1e+20",
    ),
    (
        '[[animation]]\ntarget = "a"\nproperty = "rotation"\ntimes = [0]\n'
        "values = [[0, 0, 0, 0]]\n",
        "animation[0].values: expected quaternions that are not zero",
    ),
    (
        '[[animation]]\ntarget = "a"\nproperty = "position"\ntimes = [0]\nvalues = [[0, 0, 0]]\n'
        "pivot = [0, 0, 0]\n",
        "animation[0].pivot: is for rotation and scale",
    ),
    ("", "has no triangles"),
    ("x = " + "[" * 5000 + "]" * 5000, "not valid TOML"),
    ("[film]\nwidth = 0x1" + "0" * 6000, "film.width: expected an integer"),
    ("[camera]\nposition = [0, 0, 0x1" + "0" * 6000 + "]\ntarget = [0, 0, 0]\n", "camera.position"),
    ('["a\\nb"]\n', "unknown key"),
]


@pytest.mark.parametrize(("text", "expected"), MISTAKES)
def test_a_mistake_gets_one_line_that_names_file_and_key(folder, text, expected):
    with pytest.raises(InputError) as caught:
        load(folder, text)
    message = str(caught.value)
    assert expected in message
    assert str(folder / "scene.toml") in message
    assert "\n" not in message
    assert len(message) < 600


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("scene.toml", b"\xff\xfe", "UTF-8"),
        ("scene.blend", b"", "expected a file ending in .toml"),
        ("scene", b"", "expected a file ending in .toml"),
    ],
)
def test_a_file_that_is_no_scene_is_refused_by_name(tmp_path, name, content, expected):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=expected):
        load_scene(tmp_path / name)


@pytest.mark.parametrize("suffix", [".toml", ".gltf", ".glb", ".obj", ".ply", ".stl", ".OBJ"])
def test_missing_files_and_folders_are_refused(tmp_path, suffix):
    (tmp_path / f"folder{suffix}").mkdir()
    for name in (f"folder{suffix}", f"missing{suffix}", f"{'long' * 99}{suffix}", f"\0{suffix}"):
        with pytest.raises(InputError) as caught:
            load_scene(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_a_scene_cut_anywhere_loads_or_is_refused(folder):
    whole = (
        "[film]\nwidth = 8\n" + CAMERA + "[materials.a]\nroughness = 0.5\n" + QUAD
        + 'material = "a"\ntransform = [{ scale = 2 }, { rotate = [1, 2, 3] }]\n'
    )  # fmt: skip
    outcomes = set()
    for end in range(len(whole)):
        try:
            load(folder, whole[:end])
            outcomes.add("loaded")
        except InputError:
            outcomes.add("refused")
    assert outcomes == {"loaded", "refused"}
