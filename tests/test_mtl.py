"""What an MTL file says arrives as the parameter that comes nearest to it."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from psf_cl.scene.mesh import load_mesh_scene
from psf_cl.scene.mtl import normals_of_heights

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"


def scene_of(folder, statements, more=""):
    """Return the scene of a triangle with one material."""
    (folder / "a.mtl").write_text("newmtl m\n" + statements)
    text = f"mtllib a.mtl\n{TRIANGLE}usemtl m\nf 1/1 2/2 3/3\n{more}"
    (folder / "a.obj").write_text(text)
    return load_mesh_scene(folder / "a.obj")


def material_of(folder, statements):
    return scene_of(folder, statements).materials[0]


def picture(folder, name, colors):
    """Write a picture of one row."""
    Image.fromarray(np.array([colors], np.uint8)).save(folder / name)


@pytest.mark.parametrize(
    ("statements", "expected"),
    [
        ("Kd 0.1 0.2 0.3", {"base_color": (0.1, 0.2, 0.3), "specular": 1.0, "roughness": 1.0}),
        ("Kd 0.5\nKs 0 0 0\nNs 10", {"base_color": (0.5, 0.5, 0.5), "specular": 0.0}),
        ("Ks 0.5 0.25 0", {"specular": 0.5, "specular_color": (1.0, 0.5, 0.0)}),
        ("Kd 0 0 0\nKs 0.9 0.6 0.3", {"metallic": 1.0, "base_color": (0.9, 0.6, 0.3)}),
        # alpha^2 = 2 / (Ns + 2) = 1 / 16, roughness^2 = alpha.
        ("Ks 1 1 1\nNs 30", {"roughness": 0.5}),
        ("Ks 1 1 1\nNs 30\nPr 0.3\nPm 2", {"roughness": 0.3, "metallic": 1.0}),
        ("Ni 1.33", {"ior": 1.33}),
        ("Ni 1", {"ior": 1.5}),
        ("Ke 5 6 7", {"emission": (5.0, 6.0, 7.0)}),
        ("d 0.25", {"alpha": 0.25, "alpha_mode": "blend", "transmission": 0.0}),
        ("Tr 0.25", {"alpha": 0.75, "alpha_mode": "blend"}),
        ("Tr 1\nd 1", {"alpha": 1.0, "alpha_mode": "opaque"}),
        ("d 0\nillum 7\nNi 1.3\nKd 0 0 0", {"transmission": 1.0, "ior": 1.3, "roughness": 0.0}),
        ("d 0\nillum 4\nTf 1 0.5 0", {"transmission": 1.0, "base_color": (1.0, 0.5, 0.0)}),
        ("Kd nonsense\nNs nan\nd inf\nPr", {"base_color": (0.8, 0.8, 0.8), "alpha": 1.0}),
        ("Kd 0.1 \\\n 0.2 0.3", {"base_color": (0.1, 0.2, 0.3)}),
    ],
)
def test_each_statement_arrives(tmp_path, statements, expected):
    material = material_of(tmp_path, statements)
    for name, value in expected.items():
        assert getattr(material, name) == pytest.approx(value), name


def test_options_before_a_name_place_the_picture(tmp_path):
    picture(tmp_path, "wood grain.png", [(10, 20, 30)])
    statement = "map_Kd -s 2 3 -o 0.5 0.25 -clamp on -mm 0 1 -blendu on wood grain.png"
    scene = scene_of(tmp_path, statement)
    texture = scene.textures[scene.materials[0].base_color_texture]
    assert texture.pixels[0, 0].tolist() == [10, 20, 30, 255]
    assert texture.wrap == ("clamp", "clamp")
    # A vertex at (u, v) of the file shows the picture, whose v grows upwards, at (2 u + 0.5,
    # 3 v + 0.25).
    matrix = np.reshape(texture.transform, (2, 3))
    for u, v in ((0.0, 0.0), (0.3, 0.9)):
        at_u, at_v = matrix @ (u, 1 - v, 1)
        assert (at_u, 1 - at_v) == pytest.approx((2 * u + 0.5, 3 * v + 0.25))


@pytest.mark.filterwarnings("error")
def test_numbers_beyond_float32_do_not_count(tmp_path):
    picture(tmp_path, "a.png", [(1, 2, 3)])
    scene = scene_of(tmp_path, "map_Kd -s 1e300 1 -o 1e39 a.png\nNi 1e99\nNs 1e39")
    assert scene.textures[0].transform == (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    assert scene.materials[0].ior == 1.5


def test_pictures_of_light_and_opacity_are_read(tmp_path):
    picture(tmp_path, "glow.png", [(255, 0, 0)])
    picture(tmp_path, "holes.png", [(255, 255, 255), (0, 0, 0)])
    picture(tmp_path, "veil.png", [(128, 128, 128)])
    picture(tmp_path, "color.png", [(9, 8, 7), (6, 5, 4)])
    scene = scene_of(tmp_path, "map_Ke glow.png\nmap_Kd color.png\nmap_d -o 0 holes.png")
    material = scene.materials[0]
    assert material.emission == (1.0, 1.0, 1.0)
    assert scene.textures[material.emission_texture].pixels[0, 0, 0] == 255
    texels = scene.textures[material.base_color_texture].pixels[0].tolist()
    assert texels == [[9, 8, 7, 255], [6, 5, 4, 0]]
    assert material.alpha_mode == "mask"
    assert material_of(tmp_path, "map_d veil.png").alpha_mode == "blend"


def test_heights_become_normals_that_lean_away_from_the_rise(tmp_path):
    heights = np.zeros((4, 8, 4), np.uint8)
    heights[..., :3] = (np.arange(8) * 20)[None, :, None]  # rises along u
    normals = normals_of_heights(heights)[1, 3, :3] / 255.0 * 2.0 - 1.0
    slope = 20 / 255
    expected = np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1.0)
    np.testing.assert_allclose(normals, expected, atol=0.005)
    Image.fromarray(heights[..., 0]).save(tmp_path / "bump.png")
    Image.new("RGB", (1, 1), (128, 128, 255)).save(tmp_path / "normal.png")
    for statement, blue in (("bump -bm 2 bump.png", 254), ("norm normal.png", 255)):
        scene = scene_of(tmp_path, statement)
        material = scene.materials[0]
        pixels = scene.textures[material.normal_texture].pixels
        assert not scene.textures[material.normal_texture].srgb
        assert abs(int(pixels[0, pixels.shape[1] // 2, 2]) - blue) <= 1
        assert material.normal_scale == (2.0 if "-bm" in statement else 1.0)


def test_names_of_other_machines_are_found_beside_the_file_and_nothing_outside_is_read(tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    picture(inside, "wood.png", [(1, 2, 3)])
    picture(tmp_path, "secret.png", [(1, 2, 3)])
    assert scene_of(inside, "map_Kd C:\\\\textures\\wood.png").textures
    scene = scene_of(inside, "map_Kd ../secret.png")
    assert not scene.textures and "inside the folder" in " ".join(scene.notes)


def test_points_and_lines_are_left_out_and_said(tmp_path):
    scene = scene_of(tmp_path, "Kd 1 1 1", more="p 1\nl 1 2\n")
    assert len(scene.shapes) == 1
    assert "points and lines are left out (2 times)" in " ".join(scene.notes)


def test_colours_of_vertices_are_decoded(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0 1 0 0\nv 1 0 0 0.5 0.5 0.5\nv 0 1 0 0 0 1\nf 1 2 3\n")
    mesh = load_mesh_scene(tmp_path / "a.obj").shapes[0].mesh
    expected = [[1, 0, 0, 1], [0.2140, 0.2140, 0.2140, 1], [0, 0, 1, 1]]
    np.testing.assert_allclose(mesh.colors, expected, atol=1e-4)
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    header += "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    body = "0 0 0 255 0 0\n1 0 0 188 188 188\n0 1 0 0 0 255\n3 0 1 2\n"
    (tmp_path / "a.ply").write_text(header + body)
    mesh = load_mesh_scene(tmp_path / "a.ply").shapes[0].mesh
    # 188 is half of the light.
    half = [0.5029] * 3
    np.testing.assert_allclose(mesh.colors[:, :3], [[1, 0, 0], half, [0, 0, 1]], atol=1e-3)


def test_a_library_of_another_name_is_said_and_the_file_of_the_same_name_stands_in(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 1 0 0\n")
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text("mtllib old.mtl older.mtl\n" + triangle)
    scene = load_mesh_scene(tmp_path / "a.obj")
    assert scene.materials[0].base_color == (1, 0, 0)
    (note,) = scene.notes
    assert "old.mtl: expected a file" in note and note.endswith("a.mtl is read instead")


def test_spaces_in_names_of_libraries_may_have_a_backslash(tmp_path):
    (tmp_path / "my own.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (tmp_path / "other.mtl").write_text("newmtl n\nKd 0 1 0\n")
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\nusemtl n\nf 2 3 1\n"
    (tmp_path / "a.obj").write_text("mtllib other.mtl my\\ own.mtl\n" + triangle)
    scene = load_mesh_scene(tmp_path / "a.obj")
    assert not scene.notes
    colors = {material.name: material.base_color for material in scene.materials}
    assert colors == {"m": (1, 0, 0), "n": (0, 1, 0)}
