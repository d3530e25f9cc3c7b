"""OBJ, PLY and STL files, and the primitives."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from psf_cl.errors import InputError
from psf_cl.scene.load import load_scene
from psf_cl.scene.mesh import load_mesh_scene
from psf_cl.scene.model import Mesh
from psf_cl.scene.primitives import PRIMITIVES


def obj(folder: Path, text: str):
    (folder / "a.obj").write_text(text)
    return load_mesh_scene(folder / "a.obj")


def corners(mesh: Mesh) -> list:
    """Return the positions of the corners of every triangle, as nested lists."""
    return mesh.positions[mesh.triangles].tolist()


def area_and_volume(mesh: Mesh) -> tuple[float, float]:
    """Return the area, and the volume by the divergence theorem: positive if fronts face out."""
    p = mesh.positions[mesh.triangles].astype(float)
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    volume = np.einsum("ij,ij->", p[:, 0], cross) / 6
    return float(np.linalg.norm(cross, axis=1).sum() / 2), float(volume)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def test_box_and_sphere_are_closed_and_face_outwards():
    area, volume = area_and_volume(PRIMITIVES["box"]())
    assert (area, volume) == (24, 8)
    # The inscribed sphere is a little smaller than the true one.
    area, volume = area_and_volume(PRIMITIVES["sphere"]())
    assert 0.99 * 4 * np.pi < area < 4 * np.pi
    assert 0.99 * 4 / 3 * np.pi < volume < 4 / 3 * np.pi


@pytest.mark.parametrize("name", ["box", "sphere"])
def test_every_edge_of_a_closed_primitive_is_met_once_from_each_side(name):
    mesh = PRIMITIVES[name]()
    _, same = np.unique(mesh.positions + 0.0, axis=0, return_inverse=True)
    triangles = same.reshape(-1)[mesh.triangles]
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert (edges[:, 0] != edges[:, 1]).all()
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}


@pytest.mark.parametrize(("name", "area"), [("quad", 4.0), ("disk", np.pi)])
def test_quad_and_disk_lie_in_the_xz_plane_and_face_up(name, area):
    mesh = PRIMITIVES[name]()
    p = mesh.positions[mesh.triangles].astype(float)
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert (mesh.positions[:, 1] == 0).all()
    assert (cross[:, 1] > 0).all()
    assert area_and_volume(mesh)[0] == pytest.approx(area, rel=2e-3)


def test_sphere_normals_are_its_positions_and_agree_with_its_winding():
    mesh = PRIMITIVES["sphere"]()
    assert np.array_equal(mesh.normals, mesh.positions)
    p = mesh.positions[mesh.triangles]
    ng = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert (np.einsum("ij,ij->i", ng, p.mean(axis=1)) > 0).all()


@pytest.mark.parametrize("name", ["quad", "box", "sphere", "disk"])
def test_primitive_textures_are_not_mirrored(name):
    # The area of a triangle in (u, -v) has the sign of its area as seen from its front.
    mesh = PRIMITIVES[name]()
    uv = mesh.uvs[mesh.triangles] * [1, -1]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    assert (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0).all()
    assert mesh.uvs.min() >= 0
    assert mesh.uvs.max() <= 1


def test_an_obj_triangle_comes_through(tmp_path):
    scene = obj(tmp_path, TRIANGLE + "f 1 2 3\n")
    assert corners(scene.shapes[0].mesh) == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
    assert scene.shapes[0].mesh.normals is None
    assert scene.shapes[0].mesh.uvs is None


def test_an_obj_polygon_becomes_a_fan_with_its_winding(tmp_path):
    angle = 2 * np.pi * np.arange(7) / 7
    lines = "".join(f"v {np.cos(a)} {np.sin(a)} 0\n" for a in angle)
    scene = obj(tmp_path, lines + "f 1 2 3 4 5 6 7\n")
    p = scene.shapes[0].mesh.positions[scene.shapes[0].mesh.triangles].astype(float)
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert len(p) == 5
    assert (cross[:, 2] > 0).all()
    assert cross[:, 2].sum() / 2 == pytest.approx(7 / 2 * np.sin(2 * np.pi / 7))


def test_obj_triangles_and_polygons_may_be_mixed(tmp_path):
    text = TRIANGLE + "v 1 1 0\nv 2 0.5 0\nf 1 2 3\nf 2 4 3\nf 2 5 4 3\nf 1 2 5 4 3\n"
    area = area_and_volume(obj(tmp_path, text).shapes[0].mesh)[0]
    # 1/2 + 1/2, then the quad 1/2 + 1/2, then the pentagon 1 + 1/2.
    assert area == pytest.approx(3.5)


def test_obj_negative_indices_count_from_the_line_they_stand_on(tmp_path):
    text = TRIANGLE + "f -3 -2 -1\n" + "v 0 0 5\nv 1 0 5\nv 0 1 5\nf -3 -2 -1\n"
    depths = np.array(corners(obj(tmp_path, text).shapes[0].mesh))[..., 2]
    assert depths.tolist() == [[0, 0, 0], [5, 5, 5]]


def test_obj_normals_and_uvs_are_kept_with_v_turned_over(tmp_path):
    text = (
        TRIANGLE
        + "vt 0 0.25\nvt 1 0\nvt 0.5 1\nvn 0 0 2\nvn 0 3 0\nvn 1 0 0\nf 1/1/1 2/2/2 3/3/3\n"
    )
    mesh = obj(tmp_path, text).shapes[0].mesh
    order = mesh.triangles[0]
    assert corners(mesh) == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
    assert mesh.normals[order].tolist() == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    assert mesh.uvs[order].tolist() == [[0, 0.75], [1, 1], [0.5, 0]]


def test_an_obj_vertex_with_two_uvs_is_split(tmp_path):
    text = TRIANGLE + "v 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\nf 2/1 4/2 3/2\n"
    mesh = obj(tmp_path, text).shapes[0].mesh
    assert mesh.uvs[mesh.triangles].tolist() == [
        [[0, 1], [1, 1], [0, 0]],
        [[0, 1], [1, 1], [1, 1]],
    ]


def test_obj_faces_of_different_forms_do_not_mix_up_their_indices(tmp_path):
    # Both lines have six numbers, but the second index is a uv in one and a normal in the other.
    head = TRIANGLE + "v 1 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\n"
    mesh = obj(tmp_path, head + "f 1/1 2/2 3/3\nf 2//1 4//1 3//1\n").shapes[0].mesh
    assert mesh.uvs[mesh.triangles[0]].tolist() == [[0, 1], [1, 1], [0, 0]]
    assert mesh.normals is None
    assert area_and_volume(mesh)[0] == pytest.approx(1.0)


def test_obj_text_may_have_comments_tabs_indents_continuations_and_crlf(tmp_path):
    text = "# top\r\nv 0 0 0 # origin\r\n  v\t1 0 0\r\nv 0 1 \\\r\n0\r\nf  1 2   3 # all\r\n"
    assert corners(obj(tmp_path, text).shapes[0].mesh) == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]


def test_obj_materials_keep_color_emission_and_texture(tmp_path):
    from PIL import Image

    Image.new("RGB", (2, 1), (10, 20, 30)).save(tmp_path / "wood grain.png")
    (tmp_path / "a.mtl").write_text(
        "newmtl lamp\nKd 0 0 0\nKe 5 6 7\nnewmtl dark wood\nKd 0.5 0.5 2\nmap_Kd wood grain.png\n"
    )
    text = "mtllib a.mtl\n" + TRIANGLE + "usemtl lamp\nf 1 2 3\nusemtl dark wood\nf 3 2 1\n"
    scene = obj(tmp_path, text)
    by_name = {scene.materials[shape.material].name: shape for shape in scene.shapes}
    lamp = scene.materials[by_name["lamp"].material]
    wood = scene.materials[by_name["dark wood"].material]
    assert lamp.emission == (5, 6, 7)
    assert wood.base_color == (0.5, 0.5, 1.0)
    assert scene.textures[wood.base_color_texture].pixels[0, 1].tolist() == [10, 20, 30, 255]
    assert corners(by_name["dark wood"].mesh) == [[[0, 1, 0], [1, 0, 0], [0, 0, 0]]]


def test_obj_coordinates_that_are_not_finite_are_0(tmp_path):
    text = TRIANGLE + "vt nan 0.25\nvt 1e99 0\nf 1/1 2/2 3/1\n"
    uvs = obj(tmp_path, text).shapes[0].mesh.uvs
    assert sorted(map(tuple, uvs.tolist())) == [(0.0, 0.75), (0.0, 0.75), (0.0, 1.0)]


@pytest.mark.filterwarnings("error")
def test_obj_normals_beyond_float_are_none(tmp_path):
    text = TRIANGLE + "vn 1e200 0 0\nf 1//1 2//1 3//1\n"
    assert obj(tmp_path, text).shapes[0].mesh.normals is None


def test_missing_mtl_and_textures_are_noted_not_fatal(tmp_path):
    (tmp_path / "b.mtl").write_text("newmtl m\nKd 0.1 0.2 0.3\nmap_Kd gone.png\n")
    text = TRIANGLE + "mtllib a.mtl\nmtllib b.mtl\nusemtl m\nf 1 2 3\nusemtl n\nf 1 2 3\n"
    scene = obj(tmp_path, text)
    assert {material.name for material in scene.materials} == {"m", "n"}
    assert scene.textures == ()
    notes = " ".join(scene.notes)
    assert "a.mtl" in notes
    assert "gone.png" in notes
    assert "undefined materials stay grey: n" in notes


def test_vertices_that_are_not_finite_are_kept_and_left_out_of_the_view(tmp_path):
    (tmp_path / "a.obj").write_text("v nan 0 0\nv 1e99 0 0\n" + TRIANGLE + "f 1 2 3\nf 3 4 5\n")
    scene = load_scene(tmp_path / "a.obj")
    positions = scene.shapes[0].mesh.positions
    assert np.isnan(positions).sum() == 1
    assert np.isinf(positions).sum() == 1
    assert np.isfinite(scene.cameras[0].transform).all()


def ply(folder: Path, data: bytes | str):
    (folder / "a.ply").write_bytes(data if isinstance(data, bytes) else data.encode())
    return load_mesh_scene(folder / "a.ply")


def ply_header(form: str, vertices: int, faces: int, more: str = "") -> str:
    return (
        f"ply\nformat {form} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\n"
        f"property float z\n{more}element face {faces}\nproperty list uchar int vertex_indices\n"
        "end_header\n"
    )


def ply_ragged() -> bytes:
    """Return a PLY file whose vertices have lists of different lengths as coordinates."""
    head = ply_header("ascii", 3, 1).replace("property float x", "property list uchar float x")
    return (head + "1 0 0 0\n2 1 1 0 0\n1 0 1 0\n3 0 1 2\n").encode()


def ply_of_float_counts() -> bytes:
    """Return a binary PLY file whose faces have a number of corners that is no integer."""
    head = ply_header("binary_little_endian", 3, 1).replace("list uchar", "list float")
    return head.encode() + struct.pack("<9f", *range(9)) + struct.pack("<f3i", 3.0, 0, 1, 2)


def test_an_ascii_ply_of_triangles_and_quads_comes_through(tmp_path):
    text = ply_header("ascii", 4, 2) + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n4 0 1 2 3\n"
    assert area_and_volume(ply(tmp_path, text).shapes[0].mesh)[0] == pytest.approx(1.5)


@pytest.mark.parametrize(("form", "order"), [("little", "<"), ("big", ">")])
def test_a_binary_ply_comes_through_in_both_byte_orders(tmp_path, form, order):
    data = ply_header(f"binary_{form}_endian", 3, 1).encode()
    data += struct.pack(order + "9fB3i", 0, 0, 0, 2, 0, 0, 0, 3, 0, 3, 0, 1, 2)
    assert corners(ply(tmp_path, data).shapes[0].mesh) == [[[0, 0, 0], [2, 0, 0], [0, 3, 0]]]


@pytest.mark.parametrize(("form", "order"), [("little", "<"), ("big", ">")])
def test_a_binary_ply_may_mix_polygons(tmp_path, form, order):
    more = "property float s\nproperty float t\nproperty uchar red\nproperty uchar green\n"
    head = ply_header(f"binary_{form}_endian", 5, 3, more + "property uchar blue\n")
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 2, 0)]
    body = b"".join(struct.pack(order + "5f3B", *p, p[0], p[1], 255, 0, 0) for p in points)
    for face in ((0, 1, 2, 3), (2, 4, 3), (0, 1, 2, 4, 3)):
        body += struct.pack(f"{order}B{len(face)}i", len(face), *face)
    mesh = ply(tmp_path, head.encode() + body).shapes[0].mesh
    fans = [[0, 1, 2], [0, 2, 3], [2, 4, 3], [0, 1, 2], [0, 2, 4], [0, 4, 3]]
    assert mesh.triangles.tolist() == fans
    np.testing.assert_allclose(mesh.positions, points)
    np.testing.assert_allclose(mesh.uvs, [(x, 1 - y) for x, y, _ in points])
    np.testing.assert_allclose(mesh.colors, [(1, 0, 0, 1)] * 5)
    with pytest.raises(InputError, match="not a sound PLY"):
        ply(tmp_path, head.encode() + body[:-1])


def test_ply_normals_and_uvs_are_kept_with_v_turned_over(tmp_path):
    more = "".join(f"property float {name}\n" for name in ("nx", "ny", "nz", "u", "v"))
    text = ply_header("ascii", 3, 1, more)
    text += "0 0 0 0 0 2 0 0.25\n1 0 0 0 0 1 1 0\n0 1 0 1 0 0 0 1\n3 0 1 2\n"
    mesh = ply(tmp_path, text).shapes[0].mesh
    order = mesh.triangles[0]
    assert mesh.uvs[order].tolist() == [[0, 0.75], [1, 1], [0, 0]]
    assert mesh.normals[order].tolist() == [[0, 0, 1], [0, 0, 1], [1, 0, 0]]


def ply_triangle(face: str) -> bytes:
    return (ply_header("ascii", 3, 1) + "0 0 0\n1 0 0\n0 1 0\n" + face).encode()


def stl(count: int, claimed: int | None = None) -> bytes:
    record = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0)
    return bytes(80) + struct.pack("<I", count if claimed is None else claimed) + count * record


def test_binary_and_ascii_stl_come_through(tmp_path):
    (tmp_path / "a.stl").write_bytes(stl(2))
    mesh = load_mesh_scene(tmp_path / "a.stl").shapes[0].mesh
    assert corners(mesh) == 2 * [[[0, 0, 0], [2, 0, 0], [0, 3, 0]]]
    assert mesh.normals is None
    loop = "outer loop\nvertex 0 0 0\nvertex 2 0 0\nvertex 0 3 0\nendloop"
    text = f"facet normal 0 0 1\n{loop}\nendfacet"
    solids = "".join(f"solid {name}\n{text}\nendsolid {name}\n" for name in "ab")
    (tmp_path / "b.stl").write_text(solids)
    shapes = load_mesh_scene(tmp_path / "b.stl").shapes
    assert [corners(shape.mesh) for shape in shapes] == 2 * [[[[0, 0, 0], [2, 0, 0], [0, 3, 0]]]]


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("a.obj", b"", "has no triangles"),
        ("a.obj", TRIANGLE.encode(), "has no triangles"),
        ("a.obj", TRIANGLE.encode() + b"f 1 2 4\n", "not a sound OBJ|out of range"),
        ("a.obj", TRIANGLE.encode() + b"f 0 1 2\n", "index 0"),
        ("a.obj", TRIANGLE.encode() + b"f -4 1 2\n", "out of range"),
        ("a.obj", TRIANGLE.encode() + b"f 1 2 99999999999999999999999\n", "a.obj"),
        ("a.obj", TRIANGLE.encode() + b"f 1 2 x\n", "a.obj"),
        ("a.obj", b"v 0 0 zero\n" + TRIANGLE.encode() + b"f 1 2 3\n", "not a sound OBJ"),
        ("a.obj", b"v 0 0\nv 0 0\nv 0 0\nf 1 2 3\n", "a.obj"),
        ("a.ply", b"", "not a sound PLY"),
        ("a.ply", b"ply\n", "not a sound PLY"),
        ("a.ply", ply_triangle("3 0 1 3\n"), "index 3"),
        ("a.ply", ply_triangle("3 0 1 -1\n"), "index -1"),
        ("a.ply", ply_triangle("2 0 1\n"), "at least 3"),
        ("a.ply", ply_header("ascii", 10**15, 1).encode() + b"0 0 0\n", "a.ply"),
        ("a.ply", ply_header("binary_little_endian", 10**18, 1).encode(), "not a sound PLY"),
        ("a.ply", ply_header("ascii", 0, 0).encode(), "has no triangles"),
        # Lists in place of numbers come out of the reader ragged.
        ("a.ply", ply_ragged(), "not a sound PLY"),
        ("a.ply", ply_of_float_counts(), "not a sound PLY"),
        ("a.ply", ply_header("ascii", 3, 1, "property half w\n").encode(), "not a sound PLY"),
        ("a.stl", b"", "a.stl"),
        ("a.stl", stl(0), "a.stl"),
        ("a.stl", stl(2, claimed=3), "neither ASCII STL nor binary STL"),
        ("a.stl", stl(2)[:-1], "neither ASCII STL nor binary STL"),
        ("a.stl", b"solid a\nvertex 1 2\nendsolid", "a.stl"),
    ],
)
def test_a_broken_mesh_gets_one_line(tmp_path, name, data, expected):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=expected) as caught:
        load_scene(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "b.ply", "a.stl"])
def test_a_damaged_mesh_loads_or_is_refused(tmp_path, name):
    normal = "vt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\n"
    whole = {
        "a.obj": (TRIANGLE + normal + "f 1/1/1 2/2/1 3/3/1\nf -1/-1/-1 -2/1 2\n").encode(),
        "a.ply": ply_triangle("3 0 1 2\n"),
        "b.ply": ply_header("binary_little_endian", 3, 1).encode()
        + struct.pack("<9fB3i", 0, 0, 0, 2, 0, 0, 0, 3, 0, 3, 0, 1, 2),
        "a.stl": stl(2),
    }[name]
    damaged = [whole[:end] for end in range(0, len(whole), 3)]
    rng = np.random.default_rng(3)
    for _ in range(150):
        changed = bytearray(whole)
        changed[rng.integers(len(whole))] = rng.integers(256)
        damaged.append(bytes(changed))
    loaded = 0
    for data in damaged:
        (tmp_path / name).write_bytes(data)
        try:
            scene = load_scene(tmp_path / name)
        except InputError as error:
            assert "\n" not in str(error)
            continue
        loaded += 1
        for shape in scene.shapes:
            assert shape.mesh.triangles.max() < len(shape.mesh.positions)
    assert 0 < loaded < len(damaged)


@pytest.mark.slow
@pytest.mark.skipif("PSF_CL_SHARED_SCENES" not in os.environ, reason="needs the shared scenes")
def test_every_shared_mesh_loads_or_is_refused():
    root = Path(os.environ["PSF_CL_SHARED_SCENES"])
    files = [file for suffix in ("obj", "ply", "stl") for file in root.rglob(f"*.{suffix}")]
    assert files
    for file in files:
        try:
            scene = load_scene(file)
        except InputError as error:
            assert "\n" not in str(error)
            continue
        assert any(len(shape.mesh.triangles) for shape in scene.shapes)


def _area_of(mesh: Mesh) -> np.ndarray:
    """Return the sum of all triangles' vector areas, and the sum of their lengths."""
    p = mesh.positions[mesh.triangles].astype(float)
    cross = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) / 2
    return np.append(cross.sum(axis=0), np.linalg.norm(cross, axis=1).sum())


#: An arrow's head, a comb and a frame whose hole hangs on a bridge, with their areas.
CONCAVE = {
    "arrow": ([(2, 1), (0, 3), (-2, 1), (0, 2)], 2.0),
    "comb": ([(0, 0), (5, 0), (5, 4), (4, 4), (4, 1), (3, 1), (3, 4), (0, 4)], 17.0),
    "frame": (
        [(1, 1), (1, 3), (3, 3), (3, 1), (1, 1), (0, 0), (4, 0), (4, 4), (0, 4), (0, 0)],
        12.0,
    ),
}


@pytest.mark.parametrize("start", range(8))
@pytest.mark.parametrize("shape", CONCAVE)
@pytest.mark.parametrize("plane", ["z = 1", "x = 1", "y = 1", "backwards"])
def test_concave_polygons_are_covered_once(tmp_path, shape, start, plane):
    outline, area = CONCAVE[shape]
    outline = [*outline[start % len(outline) :], *outline[: start % len(outline)]]
    turned = {"z = 1": (0, 1, 2), "x = 1": (2, 0, 1), "y = 1": (1, 2, 0), "backwards": (1, 0, 2)}
    points = np.array([(x, y, 1) for x, y in outline])[:, turned[plane]]
    text = "".join("v {} {} {}\n".format(*point) for point in points)
    text += "f " + " ".join(map(str, range(1, len(points) + 1))) + "\nf 1 2 3\n"
    mesh = obj(tmp_path, text).shapes[0].mesh
    vector = np.cross(points - points[0], np.roll(points, -1, axis=0) - points[0]).sum(axis=0) / 2
    whole = Mesh("", mesh.positions, mesh.triangles[: len(points) - 2])
    # Triangles that overlap or turn over have a larger sum of areas than the polygon.
    assert _area_of(whole) == pytest.approx([*vector, area])
    assert len(mesh.triangles) == len(points) - 1


def test_a_concave_polygon_keeps_its_material_normals_and_coordinates(tmp_path):
    points = "".join(f"v {x} {y} 0\nvt {x} {y}\n" for x, y in CONCAVE["comb"][0])
    text = points + "vn 0 0 1\nusemtl a\nf 1 2 3\nusemtl b\nf "
    scene = obj(
        tmp_path, text + " ".join(f"{i}/{i}/1" for i in range(1, 9)) + "\nusemtl c\nf 1 2 4"
    )
    mesh = {shape.name: shape.mesh for shape in scene.shapes}["b"]
    assert len(mesh.triangles) == 6
    np.testing.assert_allclose(mesh.uvs[:, 0], mesh.positions[:, 0])
    np.testing.assert_allclose(1 - mesh.uvs[:, 1], mesh.positions[:, 1])
    np.testing.assert_allclose(mesh.normals, np.broadcast_to([0, 0, 1], mesh.normals.shape))


def test_a_polygon_that_crosses_itself_comes_to_an_end(tmp_path):
    star = [(np.cos(4 * np.pi * k / 5), np.sin(4 * np.pi * k / 5)) for k in range(5)]
    text = "".join(f"v {x} {y} 0\n" for x, y in [*star, *star[::-1], *star])
    mesh = obj(tmp_path, text + "f " + " ".join(map(str, range(1, 16)))).shapes[0].mesh
    assert len(mesh.triangles) == 13


@pytest.mark.parametrize("encoding", ["ascii", "binary_big_endian"])
def test_ply_lines_may_end_as_on_old_macs(tmp_path, encoding):
    text = ply_header(encoding, 3, 1) + ("0 0 0\n2 0 0\n0 3 0\n3 0 1 2\n" * (encoding == "ascii"))
    data = text.replace("\n", "\r").encode()
    if encoding != "ascii":
        data += struct.pack(">9fB3i", 0, 0, 0, 2, 0, 0, 0, 3, 0, 3, 0, 1, 2)
    (tmp_path / "a.ply").write_bytes(data)
    mesh = load_mesh_scene(tmp_path / "a.ply").shapes[0].mesh
    assert corners(mesh) == [[[0, 0, 0], [2, 0, 0], [0, 3, 0]]]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_obj_and_mtl_may_be_encoded_as_windows_does(tmp_path, encoding):
    (tmp_path / "a.mtl").write_bytes("newmtl æ\nKd 1 0 0\n".encode(encoding))
    text = f"mtllib a.mtl\n{TRIANGLE}usemtl æ\nf 1 2 3\n"
    (tmp_path / "a.obj").write_bytes(text.encode(encoding))
    scene = load_mesh_scene(tmp_path / "a.obj")
    assert not scene.notes and scene.materials[0].base_color == (1, 0, 0)


def test_vertices_that_are_no_number_are_not_finite(tmp_path):
    mesh = obj(tmp_path, f"{TRIANGLE}v 1.#IND -1.#INF nan\nf 1 2 3\nf 1 2 4\n").shapes[0].mesh
    assert np.isfinite(mesh.positions[mesh.triangles]).all(axis=(1, 2)).tolist() == [True, False]


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.obj", (TRIANGLE + "p 1 2 3\n").encode()),
        ("a.ply", (ply_header("ascii", 1, 0) + "0 0 0\n").encode()),
    ],
)
def test_a_file_of_points_is_told_so(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=r"no triangles .*points"):
        load_scene(tmp_path / name)
