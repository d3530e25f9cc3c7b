"""A glTF file becomes the scene that was written into it, or one clear error.

The files are built here, byte by byte, from arrays.
"""

from __future__ import annotations

import base64
import copy
import dataclasses
import io
import json
import math
import os
import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from psf_cl.errors import InputError
from psf_cl.scene import gltf_draco
from psf_cl.scene.animation import baked
from psf_cl.scene.gltf import load_gltf
from psf_cl.scene.gltf_material import film_reflectance
from psf_cl.scene.model import Scene

# A reader that warns has computed with something that it should have sorted out before.
pytestmark = pytest.mark.filterwarnings("error")

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
QUAD = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]


class Builder:
    """A glTF document under construction; ``root`` is its JSON."""

    def __init__(self) -> None:
        self.root: dict[str, Any] = {"asset": {"version": "2.0"}}
        self.binary = bytearray()

    def add(self, array: str, **values: Any) -> int:
        """Append an object to a list of the root and return its index."""
        self.root.setdefault(array, []).append(values)
        return len(self.root[array]) - 1

    def view(self, data: bytes, **values: Any) -> int:
        self.binary += bytes(-len(self.binary) % 4)
        offset = len(self.binary)
        self.binary += data
        place = {"buffer": 0, "byteOffset": offset, "byteLength": len(data)}
        return self.add("bufferViews", **place, **values)

    def accessor(self, values: Any, kind: str = "f4", **more: Any) -> int:
        array = np.asarray(values, "<" + kind)
        array = array.reshape(len(array), -1)
        return self.add(
            "accessors",
            bufferView=self.view(array.tobytes()),
            componentType=COMPONENTS[kind],
            count=len(array),
            type=TYPES[array.shape[1]],
            **more,
        )

    def mesh(self, positions: Any = QUAD[:3], indices: Any = None, **primitive: Any) -> int:
        """Add a mesh of one primitive; attributes besides POSITION go by name."""
        attributes = {"POSITION": self.accessor(positions)}
        for name in [key for key in primitive if key.isupper()]:
            attributes[name] = primitive.pop(name)
        if indices is not None:
            primitive["indices"] = self.accessor(indices, "u2")
        return self.add("meshes", primitives=[{"attributes": attributes, **primitive}])

    def node(self, **values: Any) -> int:
        """Add a node that the default scene draws."""
        index = self.add("nodes", **values)
        self.root.setdefault("scenes", [{"nodes": []}])[0]["nodes"].append(index)
        return index

    def glb(self) -> bytes:
        if self.binary:
            self.root["buffers"] = [{"byteLength": len(self.binary)}]
        return pack_glb(self.root, bytes(self.binary))

    def load(self, folder: Path) -> Scene:
        path = folder / "scene.glb"
        path.write_bytes(self.glb())
        return load_gltf(path)


def pack_glb(root: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        binary += bytes(-len(binary) % 4)
        body += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def png(color: tuple[int, ...], size: tuple[int, int] = (1, 1)) -> bytes:
    stream = io.BytesIO()
    Image.new("RGBA", size, color).save(stream, "PNG")
    return stream.getvalue()


def with_material(**values: Any) -> Builder:
    builder = Builder()
    builder.node(mesh=builder.mesh(material=builder.add("materials", **values)))
    return builder


@pytest.fixture
def builder() -> Builder:
    return Builder()


# Containers


@pytest.mark.parametrize("container", ["glb", "data URI", "external file"])
def test_all_containers_give_the_same_mesh(
    builder: Builder, tmp_path: Path, container: str
) -> None:
    builder.node(mesh=builder.mesh(QUAD, [0, 1, 2, 2, 1, 3]))
    content = builder.glb()
    path = tmp_path / "scene"
    if container != "glb":
        uri = "data:application/octet-stream;base64," + base64.b64encode(builder.binary).decode()
        if container == "external file":
            (tmp_path / "sub").mkdir()
            (tmp_path / "sub" / "the data.bin").write_bytes(builder.binary)
            uri = "sub/the%20data.bin"
        builder.root["buffers"] = [{"byteLength": len(builder.binary), "uri": uri}]
        content = json.dumps(builder.root).encode()
    path.write_bytes(content)
    scene = load_gltf(path)
    assert scene.path == str(path)
    assert scene.notes == ()
    (shape,) = scene.shapes
    np.testing.assert_array_equal(shape.mesh.positions, np.array(QUAD, np.float32))
    assert shape.mesh.triangles.tolist() == [[0, 1, 2], [2, 1, 3]]
    assert (shape.mesh.positions.dtype, shape.mesh.triangles.dtype) == (np.float32, np.uint32)
    assert shape.mesh.normals is None and shape.mesh.uvs is None


@pytest.mark.parametrize(
    "uri", ["../secret.bin", "%2e%2e/secret.bin", "sub/../../secret.bin", "{absolute}", "link.bin"]
)
def test_a_file_outside_of_the_folder_is_never_read(
    builder: Builder, tmp_path: Path, uri: str
) -> None:
    builder.node(mesh=builder.mesh())
    secret = tmp_path / "secret.bin"
    secret.write_bytes(builder.binary)
    folder = tmp_path / "folder"
    (folder / "sub").mkdir(parents=True)
    (folder / "link.bin").symlink_to(secret)
    builder.root["buffers"] = [
        {"byteLength": len(builder.binary), "uri": uri.format(absolute=secret)}
    ]
    path = folder / "scene.gltf"
    path.write_text(json.dumps(builder.root))
    with pytest.raises(InputError, match=r"buffers\[0\]\.uri: expected a relative path that stays"):
        load_gltf(path)


@pytest.mark.parametrize("cut", ["glb", "gltf"])
def test_a_truncated_file_is_refused_wherever_it_ends(
    builder: Builder, tmp_path: Path, cut: str
) -> None:
    builder.node(mesh=builder.mesh())
    data = builder.glb() if cut == "glb" else json.dumps(builder.root).encode()
    path = tmp_path / "cut"
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(InputError) as caught:
            load_gltf(path)
        assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["[]", "1", "[" * 100_000, '{"asset": NaN}', '{"a": ' + "9" * 9999 + "}", "\xff"]
)
def test_json_that_is_no_gltf_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "scene.gltf"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"scene\.gltf: "):
        load_gltf(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.glb: expected a file, got nothing"):
        load_gltf(tmp_path / "none.glb")
    with pytest.raises(InputError, match="expected a file, got a folder"):
        load_gltf(tmp_path)


@pytest.mark.parametrize(
    ("asset", "good"),
    [
        ({"version": "2.0"}, True),
        ({"version": "2.7"}, True),
        ({"version": "2.7", "minVersion": "2.0"}, True),
        ({"version": "2.7", "minVersion": "2.1"}, False),
        ({"version": "1.0"}, False),
        ({"version": 2.0}, False),
        ({}, False),
    ],
)
def test_versions_that_a_reader_of_2_0_may_read(
    builder: Builder, tmp_path: Path, asset: dict[str, Any], good: bool
) -> None:
    builder.root["asset"] = asset
    if good:
        assert builder.load(tmp_path).shapes == ()
    else:
        with pytest.raises(InputError, match=r"asset\."):
            builder.load(tmp_path)


def test_an_unknown_required_extension_is_refused_with_what_is_known(
    builder: Builder, tmp_path: Path
) -> None:
    builder.root["extensionsRequired"] = ["KHR_lights_punctual", "EXT_meshopt_compression"]
    with pytest.raises(InputError, match=r"KHR_mesh_quantization.*'EXT_meshopt_com"):
        builder.load(tmp_path)
    builder.root["extensionsRequired"].pop()
    builder.load(tmp_path)


def test_a_name_with_line_breaks_makes_no_second_line(builder: Builder, tmp_path: Path) -> None:
    builder.node(mesh=builder.mesh())
    path = tmp_path / "scene.gltf"
    builder.root["buffers"] = [{"byteLength": 36, "uri": "a\nb\r.bin"}]
    path.write_text(json.dumps(builder.root))
    with pytest.raises(InputError, match=r"a b .bin: expected a file") as caught:
        load_gltf(path)
    assert len(str(caught.value).splitlines()) == 1


# Accessors


def test_interleaved_attributes_are_taken_apart(builder: Builder, tmp_path: Path) -> None:
    rows = np.random.default_rng(1).normal(size=(7, 8)).astype("<f4")  # position, normal, uv
    rows[:, 3:6] /= np.linalg.norm(rows[:, 3:6], axis=1, keepdims=True)
    view = builder.view(b"skipped!" + rows.tobytes(), byteStride=32)
    parts = [("POSITION", 8, 3), ("NORMAL", 20, 3), ("TEXCOORD_0", 32, 2)]
    attributes = {
        name: builder.add(
            "accessors",
            bufferView=view,
            byteOffset=offset,
            componentType=5126,
            count=7,
            type=TYPES[width],
        )
        for name, offset, width in parts
    }
    indices = builder.accessor([6, 5, 4, 3, 2, 1, 0, 1, 2], "u1")
    primitive = {"attributes": attributes, "indices": indices}
    builder.node(mesh=builder.add("meshes", primitives=[primitive]))
    mesh = builder.load(tmp_path).shapes[0].mesh
    np.testing.assert_array_equal(mesh.positions, rows[:, :3])
    np.testing.assert_allclose(mesh.normals, rows[:, 3:6], atol=1e-6)
    np.testing.assert_array_equal(mesh.uvs, rows[:, 6:])
    assert mesh.triangles.tolist() == [[6, 5, 4], [3, 2, 1], [0, 1, 2]]


@pytest.mark.parametrize(
    ("kind", "normalized", "stored", "meant"),
    [
        ("i1", True, [127, -128, 64], [1.0, -1.0, 64 / 127]),
        ("u1", True, [255, 0, 51], [1.0, 0.0, 0.2]),
        ("i2", True, [32767, -32768, -16384], [1.0, -1.0, -16384 / 32767]),
        ("u2", True, [65535, 0, 13107], [1.0, 0.0, 0.2]),
        ("i1", False, [127, -128, 64], [127.0, -128.0, 64.0]),
        ("u2", False, [65535, 0, 1], [65535.0, 0.0, 1.0]),
    ],
)
def test_quantised_positions_mean_what_the_specification_says(
    builder: Builder,
    tmp_path: Path,
    kind: str,
    normalized: bool,
    stored: list[int],
    meant: list[float],
) -> None:
    accessor = builder.accessor([stored, [0, 1, 0], [1, 0, 0]], kind, normalized=normalized)
    primitive = {"attributes": {"POSITION": accessor}}
    builder.node(mesh=builder.add("meshes", primitives=[primitive]))
    mesh = builder.load(tmp_path).shapes[0].mesh
    np.testing.assert_allclose(mesh.positions[0], meant, rtol=1e-6)


@pytest.mark.parametrize("has_base", [True, False])
def test_sparse_elements_replace_the_base(builder: Builder, tmp_path: Path, has_base: bool) -> None:
    mesh = builder.mesh(QUAD, [0, 1, 2, 1, 2, 3])
    accessor = builder.root["accessors"][0]
    if not has_base:
        del accessor["bufferView"]
    accessor["sparse"] = {
        "count": 2,
        "indices": {
            "bufferView": builder.view(np.array([1, 3], "<u2").tobytes()),
            "componentType": 5123,
        },
        "values": {"bufferView": builder.view(np.array([[7, 8, 9], [4, 5, 6]], "<f4").tobytes())},
    }
    builder.node(mesh=mesh)
    expected = np.array(QUAD, float) * has_base
    expected[[1, 3]] = [[7, 8, 9], [4, 5, 6]]
    np.testing.assert_array_equal(builder.load(tmp_path).shapes[0].mesh.positions, expected)


# Meshes


def rotated(triangles: np.ndarray) -> list[tuple[int, ...]]:
    """Return each triangle from its lowest index on: equal if they wind the same way."""
    return [tuple(np.roll(triangle, -np.argmin(triangle))) for triangle in triangles]


@pytest.mark.parametrize(
    ("mode", "expected"),
    [
        (4, [(0, 1, 2), (3, 4, 5)]),
        (5, [(0, 1, 2), (1, 3, 2), (2, 3, 4), (3, 5, 4)]),
        (6, [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]),
    ],
)
@pytest.mark.parametrize("indexed", [True, False])
def test_lists_strips_and_fans_wind_as_the_specification_says(
    builder: Builder, tmp_path: Path, mode: int, expected: list[tuple[int, ...]], indexed: bool
) -> None:
    corners = np.random.default_rng(2).normal(size=(6, 3)).astype(np.float32)
    # Indexed, the vertices are stored backwards and the indices undo that.
    stored = corners[::-1] if indexed else corners
    indices = [5, 4, 3, 2, 1, 0] if indexed else None
    builder.node(mesh=builder.mesh(stored, indices, mode=mode))
    mesh = builder.load(tmp_path).shapes[0].mesh
    triangles = 5 - mesh.triangles.astype(int) if indexed else mesh.triangles
    assert rotated(triangles) == expected


def test_points_and_lines_are_left_out_and_said(builder: Builder, tmp_path: Path) -> None:
    for mode in (0, 1, 2, 3):
        builder.node(mesh=builder.mesh(mode=mode))
    scene = builder.load(tmp_path)
    assert scene.shapes == ()
    assert "points and lines are left out (4 times)" in scene.notes


def test_indices_left_over_are_dropped_and_said(builder: Builder, tmp_path: Path) -> None:
    builder.node(mesh=builder.mesh(QUAD))
    scene = builder.load(tmp_path)
    assert scene.shapes[0].mesh.triangles.tolist() == [[0, 1, 2]]
    assert any("no whole triangle" in note for note in scene.notes)


def test_a_primitive_keeps_only_the_vertices_that_it_uses(builder: Builder, tmp_path: Path) -> None:
    positions = np.arange(30).reshape(10, 3)
    uvs = builder.accessor(np.arange(20).reshape(10, 2))
    builder.node(mesh=builder.mesh(positions, [9, 2, 5], TEXCOORD_0=uvs))
    mesh = builder.load(tmp_path).shapes[0].mesh
    np.testing.assert_array_equal(mesh.positions[mesh.triangles[0]], positions[[9, 2, 5]])
    np.testing.assert_array_equal(mesh.uvs[mesh.triangles[0]], [[18, 19], [4, 5], [10, 11]])
    assert len(mesh.positions) == 3


def test_broken_normals_become_those_of_the_surface(builder: Builder, tmp_path: Path) -> None:
    signalling_nan = np.array(0x7FA00000, "<u4").view("<f4")
    stored = np.array([[0, 0, 0], [0, 3, 4], [0, 0, 1]], "<f4")
    stored[2, 0] = signalling_nan
    normals = builder.accessor(stored)
    builder.node(mesh=builder.mesh([[0, 0, 0], [0, 2, 0], [0, 0, 2]], NORMAL=normals))
    mesh = builder.load(tmp_path).shapes[0].mesh
    np.testing.assert_allclose(mesh.normals, [[1, 0, 0], [0, 0.6, 0.8], [1, 0, 0]], atol=1e-7)


def test_nodes_that_share_a_mesh_share_its_arrays(builder: Builder, tmp_path: Path) -> None:
    mesh = builder.mesh()
    builder.node(mesh=mesh, name="left")
    builder.node(mesh=mesh, name="right", translation=[1, 0, 0])
    left, right = builder.load(tmp_path).shapes
    assert left.mesh is right.mesh
    assert (left.name, right.name) == ("left", "right")


def compressed_quad(builder: Builder) -> bytearray:
    """Add a node of a quad that is there in Draco's form alone; return that form."""
    draco = pytest.importorskip("DracoPy")
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.uint32)
    data = draco.encode(np.array(QUAD, np.float32), faces, quantization_bits=14)
    ids = [part["unique_id"] for part in draco.decode(data).attributes]
    more = {"bufferView": builder.view(data), "attributes": {"POSITION": ids[0]}}
    counts = {"POSITION": (4, "VEC3", 5126), "indices": (6, "SCALAR", 5123)}
    position, indices = (
        builder.add("accessors", count=count, type=kind, componentType=component)
        for count, kind, component in counts.values()
    )
    primitive = {"attributes": {"POSITION": position}, "indices": indices}
    primitive["extensions"] = {"KHR_draco_mesh_compression": more}
    builder.node(mesh=builder.add("meshes", primitives=[primitive]))
    builder.root["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    return builder.binary


def test_compressed_meshes_are_decoded(builder: Builder, tmp_path: Path) -> None:
    compressed_quad(builder)
    scene = builder.load(tmp_path)
    mesh = scene.shapes[0].mesh
    corners = {tuple(np.round(corner, 3)) for corner in mesh.positions.tolist()}
    assert corners == {tuple(map(float, corner)) for corner in QUAD}
    assert len(mesh.triangles) == 2 and not scene.notes
    builder.root["accessors"][0]["count"] = 5
    with pytest.raises(InputError, match=r"POSITION: expected as much compressed data"):
        builder.load(tmp_path)


def test_broken_compressed_data_is_one_error(builder: Builder, tmp_path: Path) -> None:
    binary = compressed_quad(builder)
    binary[:] = bytes(len(binary))
    with pytest.raises(InputError, match=r"draco_mesh_compression.bufferView: expected sound Dr"):
        builder.load(tmp_path)


def test_compressed_meshes_are_refused_without_the_package(
    builder: Builder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    builder.node(mesh=builder.mesh())
    builder.root["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    monkeypatch.setattr(gltf_draco, "is_available", lambda: False)
    with pytest.raises(InputError, match=r"extensionsRequired: expected the extra draco"):
        builder.load(tmp_path)


# Nodes


def test_transforms_compose_from_the_root_down(builder: Builder, tmp_path: Path) -> None:
    half = math.sqrt(0.5)
    mesh = builder.mesh()
    child = builder.add("nodes", mesh=mesh, scale=[-2, 1, 1])
    builder.node(translation=[1, 2, 3], rotation=[0, half, 0, half], children=[child])
    (shape,) = builder.load(tmp_path).shapes
    # (1, 0, 0) is scaled to (-2, 0, 0), turned about Y by 90 degrees to (0, 0, 2), then moved.
    np.testing.assert_allclose(shape.transform @ [1, 0, 0, 1], [1, 2, 5, 1], atol=1e-12)
    assert np.linalg.det(shape.transform) == pytest.approx(-2.0)


def test_a_matrix_is_stored_by_columns(builder: Builder, tmp_path: Path) -> None:
    matrix = [0, 2, 0, 0, -3, 0, 0, 0, 0, 0, 4, 0, 10, 20, 30, 1]
    builder.node(mesh=builder.mesh(), matrix=matrix)
    (shape,) = builder.load(tmp_path).shapes
    np.testing.assert_array_equal(shape.transform @ [1, 1, 1, 1], [7, 22, 34, 1])


def test_depth_is_bounded_by_memory_only(builder: Builder, tmp_path: Path) -> None:
    depth = 20_000
    builder.mesh()
    for index in range(depth - 1):
        builder.add("nodes", children=[index + 1], translation=[1, 0, 0])
    builder.add("nodes", mesh=0, translation=[1, 0, 0])
    builder.root["scenes"] = [{"nodes": [0]}]
    (shape,) = builder.load(tmp_path).shapes
    assert shape.transform[0, 3] == depth


@pytest.mark.parametrize(
    ("children", "message"),
    [
        ([[0]], "no cycle"),
        ([[1], [2], [0]], "no cycle"),
        ([[], [2], [1]], "no cycle"),
        ([[2], [2], []], "another parent"),
        ([[1, 1], []], "another parent"),
        ([[1]], "indices of nodes, which has 1"),
    ],
)
def test_what_is_no_tree_is_refused(
    builder: Builder, tmp_path: Path, children: list[list[int]], message: str
) -> None:
    for below in children:
        builder.node(children=below)
    with pytest.raises(InputError, match=rf"nodes\[\d\]\.children: expected .*{message}"):
        builder.load(tmp_path)


def test_the_default_scene_is_the_one_drawn(builder: Builder, tmp_path: Path) -> None:
    mesh = builder.mesh()
    builder.root["nodes"] = [{"mesh": mesh, "name": name} for name in ("a", "b", "c")]
    builder.root["scenes"] = [{"nodes": [0]}, {"nodes": [2, 1]}]

    def names() -> list[str]:
        return [shape.name for shape in builder.load(tmp_path).shapes]

    assert names() == ["a"]
    builder.root["scene"] = 1
    assert names() == ["c", "b"]
    del builder.root["scene"], builder.root["scenes"]
    assert names() == ["a", "b", "c"]


def test_a_node_that_is_not_visible_hides_all_below_it(builder: Builder, tmp_path: Path) -> None:
    mesh = builder.mesh()
    below = builder.add("nodes", mesh=mesh, name="below")
    for name, visible in (("hidden", {"visible": False}), ("shown", {"visible": True})):
        builder.node(mesh=mesh, name=name, extensions={"KHR_node_visibility": visible})
    builder.root["nodes"][builder.root["scenes"][0]["nodes"][0]]["children"] = [below]
    assert [shape.name for shape in builder.load(tmp_path).shapes] == ["shown"]


def instanced(builder: Builder, **attributes: Any) -> int:
    """Add a node of one triangle, 2 above the ground, at several places."""
    extension = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    return builder.node(mesh=builder.mesh(), translation=[0, 2, 0], extensions=extension)


def test_instances_are_placed_before_their_node(builder: Builder, tmp_path: Path) -> None:
    instanced(
        builder,
        TRANSLATION=builder.accessor([[0, 0, 0], [5, 0, 0]]),
        ROTATION=builder.accessor([[0, 0, 0, 127], [0, 0, 90, 90]], "i1", normalized=True),
        SCALE=builder.accessor([[1, 1, 1], [2, 3, 4]]),
    )
    shapes = builder.load(tmp_path).shapes
    assert len(shapes) == 2 and shapes[0].mesh is shapes[1].mesh
    np.testing.assert_allclose(shapes[0].transform @ [0, 0, 0, 1], [0, 2, 0, 1])
    # Scaled by (2, 3, 4), turned a quarter about Z: x becomes y.  Bytes round only the length.
    np.testing.assert_allclose(shapes[1].transform @ [1, 0, 0, 1], [5, 4, 0, 1], atol=1e-6)
    np.testing.assert_allclose(shapes[1].transform @ [0, 1, 0, 1], [2, 2, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        ({}, "of one count"),
        ({"TRANSLATION": [[0, 0, 0]] * 2, "SCALE": [[1, 1, 1]]}, "of one count"),
        ({"ROTATION": [[0, 0, 0, 0]]}, "finite transforms"),
        ({"TRANSLATION": [[np.inf, 0, 0]]}, "finite transforms"),
    ],
)
def test_instances_without_sound_places_are_refused(
    builder: Builder, tmp_path: Path, attributes: dict[str, Any], expected: str
) -> None:
    instanced(builder, **{key: builder.accessor(value) for key, value in attributes.items()})
    with pytest.raises(InputError, match=rf"nodes\[0\].*attributes: .*{expected}"):
        builder.load(tmp_path)


def test_primitives_that_differ_in_material_alone_share_a_mesh(
    builder: Builder, tmp_path: Path
) -> None:
    builder.mesh()
    primitive = builder.root["meshes"][0]["primitives"][0]
    colors = [builder.add("materials", name=name) for name in ("red", "blue")]
    builder.root["meshes"] = [{"primitives": [{**primitive, "material": m}]} for m in colors]
    for mesh in range(2):
        builder.node(mesh=mesh)
    first, second = builder.load(tmp_path).shapes
    assert first.mesh is second.mesh and first.material != second.material


def test_a_skinned_mesh_stands_where_its_joints_put_it(builder: Builder, tmp_path: Path) -> None:
    inverse_bind = np.diag([0.5, 0.5, 0.5, 1.0])
    inverse_bind[:3, 3] = [0, -1, 0]
    joints = [builder.node(translation=[0, 0, 7]), builder.node(translation=[4, 0, 0])]
    binds = builder.accessor([inverse_bind.T.ravel(), np.eye(4).ravel()])
    skin = builder.add("skins", joints=joints, inverseBindMatrices=binds)
    mesh = builder.mesh(
        [[2, 4, 6], [2, 4, 6], [0, 0, 0]],
        JOINTS_0=builder.accessor([[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]], "u2"),
        WEIGHTS_0=builder.accessor([[1, 0, 0, 0], [2, 0, 0, 0], [0.25, 0.75, 0, 0]]),
    )
    # The transform of its own node does not count.
    builder.node(mesh=mesh, skin=skin, translation=[100, 100, 100])
    (shape,) = baked(builder.load(tmp_path), None).shapes
    expected = [[1, 1, 10], [6, 4, 6], [3, -0.25, 1.75]]
    np.testing.assert_allclose(shape.mesh.positions, expected, atol=1e-6)
    np.testing.assert_array_equal(shape.transform, np.eye(4))


# Materials


def test_defaults_are_those_of_gltf(builder: Builder, tmp_path: Path) -> None:
    builder.node(mesh=builder.mesh())
    (material,) = builder.load(tmp_path).materials
    assert material.base_color == (1.0, 1.0, 1.0)
    assert (material.metallic, material.roughness, material.ior) == (1.0, 1.0, 1.5)
    assert (material.specular, material.transmission) == (1.0, 0.0)
    assert material.emission == (0.0, 0.0, 0.0)
    assert (material.alpha_mode, material.double_sided) == ("opaque", False)
    assert material.back_hidden
    assert material.base_color_texture == material.emission_texture == -1


def test_every_factor_arrives(tmp_path: Path) -> None:
    scene = with_material(
        name="paint",
        pbrMetallicRoughness={
            "baseColorFactor": [0.1, 0.2, 0.3, 0.4],
            "metallicFactor": 0.5,
            "roughnessFactor": 0.6,
        },
        emissiveFactor=[1, 0.5, 0.25],
        alphaMode="MASK",
        alphaCutoff=0.7,
        doubleSided=True,
        extensions={
            "KHR_materials_emissive_strength": {"emissiveStrength": 8},
            "KHR_materials_ior": {"ior": 1.33},
            "KHR_materials_transmission": {"transmissionFactor": 0.9},
            "KHR_materials_specular": {"specularFactor": 0.8},
        },
        extras=17,
    ).load(tmp_path)
    (material,) = scene.materials
    assert scene.notes == ()
    assert material.name == "paint"
    assert (*material.base_color, material.alpha) == (0.1, 0.2, 0.3, 0.4)
    assert (material.metallic, material.roughness) == (0.5, 0.6)
    assert material.emission == (8.0, 4.0, 2.0)
    assert (material.alpha_mode, material.alpha_cutoff) == ("mask", 0.7)
    assert (material.ior, material.transmission, material.specular) == (1.33, 0.9, 0.8)
    assert material.double_sided
    assert not material.back_hidden


def test_blending_and_unlit_are_read(tmp_path: Path) -> None:
    scene = with_material(
        alphaMode="BLEND",
        pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.25]},
        extensions={"KHR_materials_unlit": {}},
    ).load(tmp_path)
    material = scene.materials[0]
    assert (material.alpha_mode, material.alpha, material.unlit) == ("blend", 0.25, True)
    assert not scene.notes


def test_what_is_not_rendered_is_said(tmp_path: Path) -> None:
    scene = with_material(
        occlusionTexture={"index": 0},
        extensions={
            "KHR_materials_clearcoat": {"clearcoatNormalTexture": {"index": 0}},
            "KHR_materials_new": {},
            "KHR_materials_iridescence": {"iridescenceFactor": 1.0},
            "KHR_materials_dispersion": {"dispersion": 0.5},
            "KHR_materials_diffuse_transmission": {"diffuseTransmissionFactor": 0.5},
        },
    ).load(tmp_path)
    said = " ".join(scene.notes)
    ignored = ("occlusionTexture", "clearcoatNormalTexture", "KHR_materials_new", "dispersion")
    for name in (*ignored, "iridescence is approx", "diffuse transmission is approx"):
        assert name in said


EXTENSIONS = {
    "KHR_materials_clearcoat": {"clearcoatFactor": 0.5, "clearcoatRoughnessFactor": 0.25},
    "KHR_materials_sheen": {"sheenColorFactor": [1, 0.5, 0], "sheenRoughnessFactor": 0.75},
    "KHR_materials_anisotropy": {"anisotropyStrength": 0.5, "anisotropyRotation": 1.5},
    "KHR_materials_specular": {"specularFactor": 0.5, "specularColorFactor": [0, 0.5, 1]},
    "KHR_materials_transmission": {"transmissionFactor": 0.5},
    "KHR_materials_volume": {
        "thicknessFactor": 2.0,
        "attenuationDistance": 0.5,
        "attenuationColor": [1, 0.5, 0.25],
    },
    "KHR_materials_ior": {"ior": 1.25},
}


def test_every_extension_of_materials_is_read(tmp_path: Path) -> None:
    scene = with_material(extensions=EXTENSIONS).load(tmp_path)
    material = scene.materials[0]
    expected = {
        "clearcoat": 0.5,
        "clearcoat_roughness": 0.25,
        "sheen_color": (1.0, 0.5, 0.0),
        "sheen_roughness": 0.75,
        "anisotropy": 0.5,
        "anisotropy_rotation": 1.5,
        "specular": 0.5,
        "specular_color": (0.0, 0.5, 1.0),
        "transmission": 0.5,
        "thin_walled": False,
        "attenuation_distance": 0.5,
        "attenuation_color": (1.0, 0.5, 0.25),
        "ior": 1.25,
    }
    assert {name: getattr(material, name) for name in expected} == expected
    assert not scene.notes


def metallic_of(material: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the diffuse and the specular colour of a metallic material."""
    base, m = np.array(material.base_color), material.metallic
    return base * (1 - m), 0.04 * (1 - m) + base * m


@pytest.mark.parametrize(
    ("diffuse", "specular"),
    [
        ((0.5, 0.2, 0.1), (0.04, 0.04, 0.04)),
        ((0.0, 0.0, 0.0), (0.9, 0.6, 0.3)),
        ((0.8, 0.8, 0.8), (0.0, 0.0, 0.0)),
        ((0.3, 0.3, 0.3), (0.5, 0.5, 0.5)),
    ],
)
@pytest.mark.parametrize("textured", [False, True])
def test_specular_glossiness_keeps_both_colours(
    tmp_path: Path, diffuse: tuple[float, ...], specular: tuple[float, ...], textured: bool
) -> None:
    values: dict[str, Any] = {
        "diffuseFactor": [*diffuse, 0.5],
        "specularFactor": list(specular),
        "glossinessFactor": 0.75,
    }
    if textured:
        values["specularGlossinessTexture"] = {"index": 0}
    builder = with_material(extensions={"KHR_materials_pbrSpecularGlossiness": values})
    builder.add("textures", source=builder.add("images", bufferView=0))
    builder.root["images"][0]["bufferView"] = builder.view(png((255, 255, 255, 128), (2, 1)))
    builder.root["images"][0]["mimeType"] = "image/png"
    scene = builder.load(tmp_path)
    material = scene.materials[0]
    roughness = material.roughness
    if textured:
        code = scene.textures[material.base_color_texture].pixels[0, 1, :3] / 255.0
        base = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
        roughness, metallic = (
            scene.textures[material.metallic_roughness_texture].pixels[0, 1, 1:3] / 255.0
        )
        material = dataclasses.replace(material, base_color=tuple(base), metallic=metallic)
    assert roughness == pytest.approx(1 - 0.75 * 128 / 255 if textured else 0.25, abs=0.003)
    assert material.alpha == 0.5
    found_diffuse, found_specular = metallic_of(material)
    albedo = np.array(diffuse) * (1 - max(specular)) / 0.96
    np.testing.assert_allclose(found_diffuse, albedo, atol=0.02)
    np.testing.assert_allclose(found_specular, np.maximum(specular, 0.04), atol=0.02)


def test_a_thin_film_reflects_what_its_waves_add_up_to() -> None:
    # No film, or one that is as dense as the surface, changes nothing: 1.5 reflects 4 %.
    glass = np.full(3, 0.04)
    np.testing.assert_allclose(film_reflectance(glass, 1.0, 500.0), glass, rtol=1e-5)
    np.testing.assert_allclose(film_reflectance(glass, 1.5, 500.0), glass, rtol=1e-5)
    # A quarter of a wave of the root of the index takes the reflection away.
    coated = film_reflectance(glass, math.sqrt(1.5), 549.0 / 4 / math.sqrt(1.5))
    assert coated[1] < 1e-6 < coated[0]


def test_glass_without_a_thickness_is_a_thin_wall(tmp_path: Path) -> None:
    scene = with_material(
        extensions={"KHR_materials_transmission": {"transmissionFactor": 1.0}}
    ).load(tmp_path)
    assert scene.materials[0].thin_walled


def test_an_attenuation_distance_of_0_is_refused(tmp_path: Path) -> None:
    extensions = {"KHR_materials_volume": {"attenuationDistance": 0.0}}
    with pytest.raises(InputError, match="attenuationDistance: expected a number above 0"):
        with_material(extensions=extensions).load(tmp_path)


def test_only_used_materials_are_kept_and_equal_uses_shared(
    builder: Builder, tmp_path: Path
) -> None:
    for name in ("unused", "red", "blue"):
        builder.add("materials", name=name)
    for material in (2, 1, 2):
        builder.node(mesh=builder.mesh(material=material))
    scene = builder.load(tmp_path)
    assert [material.name for material in scene.materials] == ["blue", "red"]
    assert [shape.material for shape in scene.shapes] == [0, 1, 0]


# Textures


def test_textures_are_one_for_each_image_and_sampler_in_use(
    builder: Builder, tmp_path: Path
) -> None:
    red = builder.add("images", bufferView=builder.view(png((255, 0, 0, 128))))
    encoded = base64.b64encode(png((0, 255, 0, 255), (2, 1))).decode()
    green = builder.add("images", uri="data:image/png;base64," + encoded)
    builder.add("images", bufferView=builder.view(b"broken, but not used"))
    nearest = builder.add("samplers", wrapS=33071, wrapT=33648, magFilter=9728)
    uses = [
        builder.add("textures", source=red),
        builder.add("textures", source=red, sampler=nearest),
        builder.add("textures", source=red, sampler=builder.add("samplers")),
        builder.add("textures", source=green),
        builder.add("textures", source=2),
    ]
    for base, emissive in ((0, 3), (1, 0), (2, 1)):
        material = builder.add(
            "materials",
            pbrMetallicRoughness={"baseColorTexture": {"index": uses[base]}},
            emissiveFactor=[1, 1, 1],
            emissiveTexture={"index": uses[emissive], "texCoord": 0},
        )
        builder.node(mesh=builder.mesh(material=material))
    scene = builder.load(tmp_path)
    indices = [(m.base_color_texture, m.emission_texture) for m in scene.materials]
    first, second, third = indices
    assert len(scene.textures) == 3
    assert third == (first[0], second[0]) and second[1] == first[0]
    plain, clamped, other = (scene.textures[i] for i in (first[0], second[0], first[1]))
    assert plain.pixels.tolist() == [[[255, 0, 0, 128]]]
    assert other.pixels.tolist() == [[[0, 255, 0, 255]] * 2]
    assert (plain.wrap, plain.filter, plain.srgb) == (("repeat", "repeat"), "linear", True)
    assert (clamped.wrap, clamped.filter) == (("clamp", "mirror"), "nearest")
    assert clamped.pixels is plain.pixels


def test_a_texture_of_a_third_set_of_coordinates_is_ignored_and_said(tmp_path: Path) -> None:
    builder = with_material(pbrMetallicRoughness={"baseColorTexture": {"index": 0, "texCoord": 2}})
    scene = builder.load(tmp_path)
    assert scene.materials[0].base_color_texture == -1
    assert any("TEXCOORD_1" in note for note in scene.notes)


def test_textures_have_their_encoding_coordinates_and_transform(tmp_path: Path) -> None:
    change = {"offset": [0.5, 0.25], "rotation": math.pi / 2, "scale": [2, 3], "texCoord": 1}
    builder = with_material(
        pbrMetallicRoughness={
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {
                "index": 0,
                "extensions": {"KHR_texture_transform": change},
            },
        },
        normalTexture={"index": 0, "texCoord": 1, "scale": 0.5},
    )
    builder.add(
        "textures", source=builder.add("images", bufferView=builder.view(png((1, 2, 3, 4))))
    )
    scene = builder.load(tmp_path)
    material = scene.materials[0]
    base, rough, normal = (
        scene.textures[index]
        for index in (
            material.base_color_texture,
            material.metallic_roughness_texture,
            material.normal_texture,
        )
    )
    assert (base.srgb, base.uv_set, base.transform) == (True, 0, (1, 0, 0, 0, 1, 0))
    assert (normal.srgb, normal.uv_set, material.normal_scale) == (False, 1, 0.5)
    assert (rough.srgb, rough.uv_set) == (False, 1)
    # A quarter turn counter-clockwise with v growing downwards: u becomes -v, v becomes u.
    np.testing.assert_allclose(rough.transform, (0, 3, 0.5, -2, 0, 0.25), atol=1e-12)
    assert base.pixels is rough.pixels is normal.pixels


def test_colours_second_coordinates_and_tangents_of_vertices_are_read(
    builder: Builder, tmp_path: Path
) -> None:
    colors = np.array([[0, 51, 255], [255, 0, 0], [0, 0, 0]], np.uint8)
    uvs = np.arange(6, dtype=np.float32).reshape(3, 2)
    tangents = np.tile(np.array([[1, 0, 0, -1]], np.float32), (3, 1))
    mesh = builder.mesh(
        COLOR_0=builder.accessor(colors, "u1", normalized=True),
        TEXCOORD_1=builder.accessor(uvs),
        TANGENT=builder.accessor(tangents),
    )
    builder.node(mesh=mesh)
    read = builder.load(tmp_path).shapes[0].mesh
    np.testing.assert_allclose(read.colors, np.c_[colors / 255.0, np.ones(3)], atol=1e-6)
    np.testing.assert_array_equal(read.uvs1, uvs)
    np.testing.assert_array_equal(read.tangents, tangents)


def test_an_unreadable_texture_in_use_is_one_error(tmp_path: Path) -> None:
    builder = with_material(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})
    view = builder.view(png((1, 2, 3, 4), (9, 9))[:50])
    builder.add("textures", source=builder.add("images", bufferView=view))
    with pytest.raises(InputError, match=r"scene\.glb: images\[0\]: unreadable texture: "):
        builder.load(tmp_path)


# Cameras and lights


def test_cameras_are_placed_without_scale_and_named_once(builder: Builder, tmp_path: Path) -> None:
    half = math.sqrt(0.5)
    lens = {"yfov": 0.8, "aspectRatio": 1.5, "znear": 0.1}
    wide = builder.add("cameras", type="perspective", perspective=lens, name="wide")
    turned = {"rotation": [0, half, 0, half], "scale": [3, 3, 3], "translation": [1, 2, 3]}
    builder.node(camera=wide, **turned)
    builder.node(camera=wide, name="door")
    builder.node(camera=wide, name="wide")
    scene = builder.load(tmp_path)
    assert [camera.name for camera in scene.cameras] == ["wide", "door", "wide-2"]
    assert (scene.width, scene.height) == (768, 512)
    first = scene.cameras[0]
    assert first.fov_y == 0.8
    # Turned by 90 degrees about Y, the view direction -Z becomes -X.
    np.testing.assert_allclose(first.transform @ [0, 0, -1, 0], [-1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(first.transform[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(first.transform[:3, :3].T @ first.transform[:3, :3], np.eye(3))


def test_an_orthographic_camera_has_a_height(builder: Builder, tmp_path: Path) -> None:
    lens = {"xmag": 3.0, "ymag": -1.5, "zfar": 10.0, "znear": 0.1}
    builder.node(camera=builder.add("cameras", type="orthographic", orthographic=lens))
    scene = builder.load(tmp_path)
    assert (scene.cameras[0].height, scene.width, scene.height) == (3.0, 1024, 512)
    lens["xmag"] = 0
    with pytest.raises(InputError, match=r"cameras\[0\].orthographic.xmag: .*other than 0"):
        builder.load(tmp_path)


@pytest.mark.parametrize(("aspect", "width"), [(1e30, 4096), (1e-6, 1), (None, 512), (1.7777, 910)])
def test_the_width_follows_the_aspect_ratio_within_bounds(
    builder: Builder, tmp_path: Path, aspect: float | None, width: int
) -> None:
    lens = {"yfov": 1.0} if aspect is None else {"yfov": 1.0, "aspectRatio": aspect}
    builder.node(camera=builder.add("cameras", type="perspective", perspective=lens))
    scene = builder.load(tmp_path)
    assert (scene.width, scene.height) == (width, 512)


def test_lights_are_placed_in_the_world_whatever_the_scale(
    builder: Builder, tmp_path: Path
) -> None:
    half = math.sqrt(0.5)
    builder.root["extensions"] = {
        "KHR_lights_punctual": {
            "lights": [
                {"type": "directional", "color": [1, 0.5, 0], "intensity": 4},
                {"type": "point", "range": 9},
                {"type": "spot", "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.2}},
                {"type": "spot", "spot": {}, "name": "lamp"},
                {"type": "laser"},
            ]
        }
    }
    for index in range(5):
        builder.node(
            rotation=[half, 0, 0, half],
            scale=[5, 5, 5],
            translation=[1, 2, index],
            extensions={"KHR_lights_punctual": {"light": index}},
        )
    scene = builder.load(tmp_path)
    sun, bulb, spot, lamp = scene.lights
    assert any("laser" in note for note in scene.notes)
    assert (sun.kind, sun.intensity) == ("directional", (4.0, 2.0, 0.0))
    # Turned by 90 degrees about X, -Z becomes +Y.
    np.testing.assert_allclose(sun.direction, [0, 1, 0], atol=1e-12)
    assert (bulb.kind, bulb.position, bulb.range) == ("point", (1.0, 2.0, 1.0), 9.0)
    assert (spot.kind, spot.range) == ("spot", math.inf)
    assert (spot.inner_angle, spot.outer_angle) == (0.1, 0.2)
    assert (lamp.name, lamp.inner_angle, lamp.outer_angle) == ("lamp", 0.0, math.pi / 4)


# Malformed input


def sound() -> Builder:
    """Return a file that uses every part that is read."""
    builder = Builder()
    image = builder.add("images", bufferView=builder.view(png((1, 2, 3, 4))))
    texture = builder.add("textures", source=image, sampler=builder.add("samplers", wrapS=10497))
    material = builder.add(
        "materials",
        pbrMetallicRoughness={"baseColorTexture": {"index": texture}, "roughnessFactor": 0.5},
        emissiveFactor=[1, 1, 1],
        alphaMode="MASK",
        extensions={"KHR_materials_ior": {"ior": 1.4}},
    )
    mesh = builder.mesh(
        QUAD,
        [0, 1, 2, 2, 1, 3],
        NORMAL=builder.accessor([[0, 0, 1]] * 4),
        TEXCOORD_0=builder.accessor([[0, 0]] * 4),
        material=material,
    )
    builder.root["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": builder.view(b"\3"), "componentType": 5121},
        "values": {"bufferView": builder.view(np.ones(3, "<f4").tobytes())},
    }
    camera = builder.add("cameras", type="perspective", perspective={"yfov": 1, "aspectRatio": 2})
    builder.root["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "spot", "spot": {}}]}}
    child = builder.add("nodes", mesh=mesh, translation=[1, 2, 3])
    light = {"KHR_lights_punctual": {"light": 0}}
    builder.node(camera=camera, extensions=light, children=[child], rotation=[0, 0, 0, 1])
    builder.glb()
    return builder


def test_the_sound_file_loads_completely(tmp_path: Path) -> None:
    scene = sound().load(tmp_path)
    counts = [len(part) for part in (scene.shapes, scene.textures, scene.cameras, scene.lights)]
    assert counts == [1, 1, 1, 1]
    assert scene.notes == ()


HUGE = 1 << 60

# Some wrong values are sound by themselves and contradict another.
BLAMED = {
    ("accessors[0].byteOffset", repr(HUGE)): "accessors[0].count",
    ("bufferViews[1].byteStride", repr(HUGE)): "accessors[0].count",
    ("bufferViews[1].byteOffset", repr(HUGE)): "bufferViews[1].byteLength",
    ("meshes[0].primitives[0].indices", "1"): "accessors[1].type",
}


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("accessors[0].count", HUGE),
        ("accessors[0].count", -1),
        ("accessors[0].count", 0),
        ("accessors[0].count", True),
        ("accessors[0].count", 5),
        ("accessors[0].byteOffset", HUGE),
        ("accessors[0].componentType", 5125),
        ("accessors[0].type", "VEC2"),
        ("accessors[0].bufferView", 99),
        ("accessors[0].bufferView", -1),
        ("accessors[0].bufferView", "0"),
        ("accessors[0].sparse.count", HUGE),
        ("accessors[0].sparse.indices.componentType", 5126),
        ("accessors[0].sparse.indices.bufferView", None),
        ("accessors[0].sparse.values.byteOffset", 1),
        ("accessors[0].normalized", 1),
        ("bufferViews[1].byteStride", 11),
        ("bufferViews[1].byteStride", HUGE),
        ("bufferViews[1].byteLength", HUGE),
        ("bufferViews[1].byteLength", 0),
        ("bufferViews[1].byteOffset", HUGE),
        ("bufferViews[1].buffer", 1),
        ("buffers[0].byteLength", HUGE),
        ("meshes[0].primitives[0].mode", 7),
        ("meshes[0].primitives[0].indices", 1),
        ("meshes[0].primitives[0].material", 4),
        ("meshes[0].primitives", {}),
        ("meshes[0].primitives[0].attributes", []),
        ("nodes[0].mesh", 1),
        ("nodes[0].translation", [1, 2]),
        ("nodes[0].translation", [1, 2, 1e39]),
        ("nodes[0].translation", [1, 2, 10**400]),
        ("nodes[0].translation", "abc"),
        ("nodes[0].matrix", [1] * 16),
        ("nodes[1].rotation", [0, 0, 0, 0]),
        ("nodes[1].camera", 1),
        ("nodes[1].extensions.KHR_lights_punctual.light", 1),
        ("nodes[1].extensions.KHR_lights_punctual", 1),
        ("nodes[1].children", [HUGE]),
        ("scene", 1),
        ("scenes[0].nodes", [2]),
        ("materials[0].pbrMetallicRoughness.roughnessFactor", 1.5),
        ("materials[0].pbrMetallicRoughness.baseColorTexture.index", 1),
        ("materials[0].pbrMetallicRoughness.baseColorFactor", [1, 1, 1]),
        ("materials[0].emissiveFactor", [1, 1, -1]),
        ("materials[0].alphaMode", "GLOW"),
        ("materials[0].extensions.KHR_materials_ior.ior", 0.5),
        ("materials[0].doubleSided", "yes"),
        ("materials[0].name", 5),
        ("textures[0].source", 1),
        ("textures[0].sampler", 1),
        ("samplers[0].wrapS", 1),
        ("images[0].bufferView", 99),
        ("cameras[0].perspective.yfov", 0),
        ("cameras[0].perspective.yfov", 4),
        ("cameras[0].type", "fisheye"),
        ("extensions.KHR_lights_punctual.lights[0].type", None),
        ("extensions.KHR_lights_punctual.lights[0].intensity", -1),
        ("extensions.KHR_lights_punctual.lights[0].spot.innerConeAngle", 0.8),
    ],
)
def test_each_wrong_value_is_named_in_one_line(tmp_path: Path, place: str, value: Any) -> None:
    builder = sound()
    target: Any = builder.root
    *parents, last = place.replace("[", ".").replace("]", "").split(".")
    for key in parents:
        target = target[int(key) if key.isdecimal() else key]
    target[last] = value
    path = tmp_path / "scene.glb"
    path.write_bytes(pack_glb(builder.root, bytes(builder.binary)))
    with pytest.raises(InputError) as caught:
        load_gltf(path)
    message = str(caught.value)
    assert ", got " in message and "\n" not in message
    blamed = BLAMED.get((place, repr(value)), place)
    assert message.startswith(f"{path}: {blamed}: expected ")


def test_an_index_beyond_the_vertices_is_refused(builder: Builder, tmp_path: Path) -> None:
    builder.node(mesh=builder.mesh(QUAD[:3], [0, 1, 3]))
    with pytest.raises(InputError, match=r"primitives\[0\]\.indices: expected indices below 3.*3$"):
        builder.load(tmp_path)


def test_sparse_indices_must_ascend_and_stay_inside(tmp_path: Path) -> None:
    for wrong in ([4], [2, 2], [3, 1]):
        builder = sound()
        sparse = builder.root["accessors"][0]["sparse"]
        sparse["count"] = len(wrong)
        sparse["indices"]["bufferView"] = builder.view(bytes(wrong))
        sparse["values"]["bufferView"] = builder.view(np.ones(6, "<f4").tobytes())
        with pytest.raises(InputError, match=r"accessors\[0\]\.sparse\.indices: expected"):
            builder.load(tmp_path)


def test_a_huge_accessor_of_implied_zeros_is_refused(tmp_path: Path) -> None:
    builder = sound()
    del builder.root["accessors"][0]["bufferView"]
    builder.root["accessors"][0]["count"] = 1 << 40
    with pytest.raises(InputError, match=r"accessors\[0\]\.count: expected at most"):
        builder.load(tmp_path)


def test_unusual_but_valid_files_load(tmp_path: Path) -> None:
    builder = sound()
    for extras in (None, [1, {"a": 2}], "text", 3.5):
        for array in ("nodes", "meshes", "materials", "accessors", "scenes"):
            builder.root[array][0]["extras"] = copy.deepcopy(extras)
        builder.root["unknownProperty"] = extras
        assert len(builder.load(tmp_path).shapes) == 1
    builder.root["accessors"][0]["count"] = 4.0
    builder.root["nodes"][0]["name"] = "line\nbreak \ud800"
    scene = builder.load(tmp_path)
    assert scene.shapes[0].name.encode()


def test_a_buffer_without_data_leaves_its_meshes_out(builder: Builder, tmp_path: Path) -> None:
    builder.node(mesh=builder.mesh())
    builder.root["buffers"] = [{"byteLength": len(builder.binary)}]
    path = tmp_path / "scene.gltf"
    path.write_text(json.dumps(builder.root))
    scene = load_gltf(path)
    assert scene.shapes == ()
    assert any("no data" in note for note in scene.notes)


ODD_VALUES: list[Any] = [
    *(None, True, -1, 0, 1, 2, 7, 255, 65536, 1 << 32, 1 << 64, 10**400, 0.5, 1e308, -1e308),
    *("", "x", "VEC3", "\ud800", "data:,", "data:;base64,AAAA", "\0", "../x", "a" * 5000),
    *([], [0], [[]], [1e308] * 16, {}, {"index": 0}, 5121, 5125, 5126),
]


def change_something(value: Any, chance: random.Random) -> None:
    """Replace or drop one value somewhere inside ``value``."""
    while value:
        key = chance.choice(list(value) if isinstance(value, dict) else range(len(value)))
        if isinstance(value[key], (dict, list)) and value[key] and chance.random() < 0.85:
            value = value[key]
        elif chance.random() < 0.2:
            del value[key]
            return
        else:
            value[key] = copy.deepcopy(chance.choice(ODD_VALUES))
            return


def check_scene(scene: Scene) -> None:
    """Check what every later stage relies on."""
    for shape in scene.shapes:
        mesh = shape.mesh
        count = len(mesh.positions)
        assert mesh.positions.shape == (count, 3) and mesh.positions.dtype == np.float32
        assert mesh.triangles.ndim == 2 and mesh.triangles.shape[1] == 3
        assert mesh.triangles.dtype == np.uint32 and mesh.triangles.max() < count
        if mesh.normals is not None:
            assert mesh.normals.shape == (count, 3) and mesh.normals.dtype == np.float32
            np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
        if mesh.uvs is not None:
            assert mesh.uvs.shape == (count, 2) and np.isfinite(mesh.uvs).all()
        assert np.isfinite(shape.transform).all() and shape.transform.shape == (4, 4)
        assert 0 <= shape.material < len(scene.materials)
    for material in scene.materials:
        for texture in (material.base_color_texture, material.emission_texture):
            assert -1 <= texture < len(scene.textures)
    for texture in scene.textures:
        assert texture.pixels.dtype == np.uint8 and texture.pixels.shape[2:] == (4,)
    for light in scene.lights:
        assert np.isfinite([*light.position, *light.intensity]).all()
        assert np.linalg.norm(light.direction) == pytest.approx(1.0)
    assert len({camera.name for camera in scene.cameras}) == len(scene.cameras)
    for note in scene.notes:
        assert note.encode()


def load_or_refuse(load: Callable[[], Scene]) -> Scene | None:
    try:
        scene = load()
    except InputError as error:
        assert "\n" not in str(error) and str(error).encode()
        return None
    check_scene(scene)
    return scene


def test_random_damage_gives_a_sound_scene_or_an_input_error(tmp_path: Path) -> None:
    chance = random.Random(4)
    original = sound()
    loaded = 0
    path = tmp_path / "scene.glb"
    for _ in range(600):
        root, binary = copy.deepcopy(original.root), bytearray(original.binary)
        for _ in range(chance.choice([0, 1, 1, 2])):
            change_something(root, chance)
        for _ in range(chance.choice([0, 0, 10])):
            binary[chance.randrange(len(binary))] = chance.randrange(256)
        path.write_bytes(pack_glb(root, bytes(binary)))
        loaded += load_or_refuse(lambda: load_gltf(path)) is not None
    assert 60 < loaded < 540


@pytest.mark.slow
@pytest.mark.skipif("PSF_CL_SHARED_SCENES" not in os.environ, reason="needs $PSF_CL_SHARED_SCENES")
def test_every_shared_file_gives_a_sound_scene_or_an_input_error() -> None:
    folder = Path(os.environ["PSF_CL_SHARED_SCENES"])
    paths = [path for path in sorted(folder.rglob("*")) if path.suffix in (".glb", ".gltf")]
    assert paths
    refused = [path for path in paths if load_or_refuse(lambda path=path: load_gltf(path)) is None]
    assert not [path for path in refused if "malformed" not in path.parts]
