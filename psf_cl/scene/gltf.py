"""Read a glTF 2.0 file into a Scene: what its default scene shows at rest.

Appearance that the renderer lacks is left out and said in the scene's notes; what cannot be read
with certainty is an error.

Source: Khronos Group, "glTF 2.0 Specification", and the extensions listed in ``SUPPORTED``.
"""

from __future__ import annotations

import math
import reprlib
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from psf_cl.errors import InputError
from psf_cl.scene import gltf_draco
from psf_cl.scene.gltf_animation import (
    NodeCurves,
    Rig,
    read_curves,
    read_joints,
    read_morphs,
)
from psf_cl.scene.gltf_file import (
    FLOAT,
    QUANTISED_OR_FLOAT,
    UNSIGNED,
    GltfFile,
    Item,
    MissingData,
    open_gltf,
)
from psf_cl.scene.gltf_material import MaterialReader
from psf_cl.scene.model import (
    MAX_TRIANGLES,
    Camera,
    Light,
    Material,
    Mesh,
    Morphs,
    Scene,
    Shape,
)
from psf_cl.scene.transform import rotation_matrices, rotation_quaternion, without_scale

# A file may list these as required; anything else required is refused.
SUPPORTED = (
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "KHR_lights_punctual",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_diffuse_transmission",
    "KHR_materials_dispersion",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_volume",
    "KHR_materials_variants",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
)

# Nodes times primitives can be far more than the file's size suggests.
MAX_SHAPES = 1 << 20
MAX_WIDTH = 4096

_TRIANGLES, _STRIP, _FAN = 4, 5, 6

# What of a primitive makes its mesh.
_GEOMETRY = ("attributes", "indices", "mode", "targets", "extensions")


def load_gltf(path: Path, clip: str | None = None, animated: bool = False) -> Scene:
    """Return what the default scene of a .gltf or .glb shows; an empty one has no shapes.

    The materials are those in use, by first use.  Width and height follow the first camera's aspect
    ratio; the environment is black.  Skins and morph targets are for ``animation`` to apply.

    Args:
        clip: as in ``read_curves``.
        animated: whether to read the animations.

    Raises:
        InputError: the file or a file it names cannot be read, is malformed where it is used, or
            requires an unknown extension.
    """
    gltf = open_gltf(path)
    _check_version(gltf.root.item("asset"))
    _check_required(gltf.root)
    return _Reader(gltf, clip, animated).scene(str(path))


@dataclass
class _Reader:
    """The parts of the scene collected so far; materials and meshes are read at first use."""

    gltf: GltfFile
    clip: str | None
    animated: bool
    notes: Counter[str] = field(default_factory=Counter)
    extensions: set[str] = field(default_factory=set)
    cameras: list[Camera] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    shapes: list[Shape] = field(default_factory=list)
    meshes: dict[int, list[tuple[Mesh, int | None]]] = field(default_factory=dict)
    primitives: dict[str, Mesh | None] = field(default_factory=dict)
    unskinned: dict[int, Mesh] = field(default_factory=dict)
    aspect: float | None = None
    triangle_count: int = 0

    def __post_init__(self) -> None:
        self.materials = MaterialReader(self.gltf, self.notes, self.extensions)

    def scene(self, path: str) -> Scene:
        """Read all nodes of the default scene."""
        root = self.gltf.root
        self.extensions.update(root.texts("extensionsUsed"))
        nodes = [root.element("nodes", i) for i in range(root.length("nodes"))]
        children = [self.gltf.indices(node, "children", "nodes") for node in nodes]
        order, parents = _order_nodes(nodes, children)
        world = _world_transforms(nodes, order, parents)
        curves: NodeCurves = {}
        if self.animated:
            curves = read_curves(self.gltf, self.clip, self.notes)
        elif root.length("animations"):
            self.notes["the file is animated: --frames renders it moving"] += 1
        self.rig = Rig(self.gltf, nodes, parents, world, curves)
        for index in self._drawn_nodes(children, parents):
            self._read_node(index, world[index])
        if not self.shapes:
            self.notes["the default scene has no triangles"] += 1
        known = {*SUPPORTED, *([gltf_draco.EXTENSION] if gltf_draco.is_available() else [])}
        ignored = sorted(self.extensions - known)
        if ignored:
            self.notes[f"extensions are ignored: {', '.join(ignored)}"] += 1
        height = Scene.height
        width = height if self.aspect is None else round(height * min(self.aspect, MAX_WIDTH))
        return Scene(
            path,
            width=min(max(width, 1), MAX_WIDTH),
            height=height,
            cameras=tuple(self.cameras),
            textures=tuple(self.materials.textures),
            materials=tuple(self.materials.materials) or (Material(),),
            shapes=tuple(self.shapes),
            lights=tuple(self.lights),
            notes=tuple(
                text if count == 1 else f"{text} ({count} times)"
                for text, count in self.notes.items()
            ),
            files=(path, *self.gltf.files),
            nodes=tuple(self.rig.nodes),
        )

    def _drawn_nodes(self, children: list[list[int]], parents: list[int]) -> list[int]:
        """Return the nodes below the roots of the default scene, parents first."""
        root = self.gltf.root
        scene_index = self.gltf.index(root, "scene", "scenes")
        if scene_index is None and root.length("scenes"):
            scene_index = 0
        if scene_index is None:
            self.notes["the file has no scene: all of its nodes are drawn"] += 1
            pending = [index for index, parent in enumerate(parents) if parent < 0]
        else:
            scene = root.element("scenes", scene_index)
            pending = self.gltf.indices(scene, "nodes", "nodes")
        pending = pending[::-1]
        drawn: dict[int, None] = {}
        while pending:
            index = pending.pop()
            visibility = root.element("nodes", index).extension("KHR_node_visibility")
            if visibility is not None and not visibility.flag("visible", True):
                continue
            if index not in drawn:
                drawn[index] = None
                pending.extend(reversed(children[index]))
        return list(drawn)

    def _read_node(self, index: int, transform: np.ndarray) -> None:
        node = self.rig.items[index]
        self.extensions.update(node.extension_names())
        camera_index = self.gltf.index(node, "camera", "cameras")
        if camera_index is not None:
            camera = self.gltf.root.element("cameras", camera_index)
            self._read_camera(camera, index, transform)
        light = node.extension("KHR_lights_punctual")
        if light is not None:
            self._read_light(light, index, transform)
        mesh_index = self.gltf.index(node, "mesh", "meshes")
        if mesh_index is not None:
            self._place_mesh(mesh_index, index, transform)

    def _moving_node(self, index: int) -> int:
        return self.rig.node(index) if self.rig.moves(index) else -1

    # Cameras and lights

    def _read_camera(self, camera: Item, index: int, transform: np.ndarray) -> None:
        kind = camera.text("type")
        fov_y, height, aspect = Camera.fov_y, 0.0, None
        if kind == "orthographic":
            lens = camera.item(kind)
            # Negative magnifications are discouraged, not forbidden (section 5.13.3).
            x, y = (abs(lens.number(key)) for key in ("xmag", "ymag"))
            if not (x > 0.0 and y > 0.0):
                lens.fail("xmag" if y > 0.0 else "ymag", "a number other than 0")
            height, aspect = 2.0 * y, x / y
        elif kind == "perspective":
            lens = camera.item(kind)
            fov_y = lens.number("yfov", low=1e-6, high=math.pi - 1e-6)
            aspect = lens.number("aspectRatio", low=1e-6) if "aspectRatio" in lens else None
        else:
            camera.fail("type", "perspective or orthographic")
        try:
            pose = without_scale(transform)
        except ValueError:
            self.notes["cameras with a degenerate transform are left out"] += 1
            return
        if not self.cameras:
            self.aspect = aspect
        name = self._camera_name(self.rig.items[index], camera)
        node = self._moving_node(index)
        self.cameras.append(Camera(pose, fov_y, name, height=height, node=node))

    def _camera_name(self, node: Item, camera: Item) -> str:
        name = node.text("name", "") or camera.text("name", "") or "camera"
        taken = {other.name for other in self.cameras}
        number = 2
        unique = name
        while unique in taken:
            unique = f"{name}-{number}"
            number += 1
        return unique

    def _read_light(self, use: Item, node: int, transform: np.ndarray) -> None:
        """Add a light of KHR_lights_punctual; the scale of the node does not count."""
        table = self.gltf.root.extension("KHR_lights_punctual") or Item(use.file, "", {})
        index = use.integer("light")
        count = table.length("lights")
        if index >= count:
            use.fail("light", f"an index of the file's lights, which has {count} entries")
        light = table.element("lights", index)
        kind = light.text("type")
        if kind not in ("point", "spot", "directional"):
            self.notes[f"lights of type {kind!r} are left out"] += 1
            return
        color = light.numbers("color", (1.0, 1.0, 1.0), 0.0, 1.0)
        intensity = light.number("intensity", 1.0, 0.0)
        reach = light.number("range", low=0.0) if "range" in light else math.inf
        if reach == 0.0:
            light.fail("range", "a number above 0")
        cone = light.item("spot") if kind == "spot" else Item(light.file, "", {})
        inner = cone.number("innerConeAngle", 0.0, 0.0, math.pi / 2)
        outer = cone.number("outerConeAngle", math.pi / 4, 0.0, math.pi / 2 + 1e-6)
        if inner >= outer:
            cone.fail("innerConeAngle", f"less than outerConeAngle, {outer:.9g}")
        length = np.linalg.norm(transform[:3, 2])
        if kind != "point" and length == 0.0:
            self.notes["lights with a degenerate transform are left out"] += 1
            return
        direction = -transform[:3, 2] / length if length > 0.0 else np.array([0.0, 0.0, -1.0])
        self.lights.append(
            Light(
                kind,
                self.materials.limited(intensity * channel for channel in color),
                light.text("name", ""),
                position=tuple(transform[:3, 3].tolist()),
                direction=tuple(direction.tolist()),
                range=reach,
                inner_angle=inner,
                outer_angle=outer,
                node=self._moving_node(node),
            )
        )

    # Meshes

    def _place_mesh(self, mesh_index: int, index: int, transform: np.ndarray) -> None:
        item, node = self.gltf.root.element("meshes", mesh_index), self.rig.items[index]
        if mesh_index not in self.meshes:
            self.meshes[mesh_index] = self._read_mesh(item)
        name = node.text("name", "") or item.text("name", "") or node.place
        skin_index = self.gltf.index(node, "skin", "skins")
        instancing = node.extension("EXT_mesh_gpu_instancing")
        places = [np.eye(4)]
        if instancing is not None:
            places = _instances(self.gltf, instancing, transform)
        meshes = self.meshes[mesh_index]
        if len(self.shapes) + len(places) * len(meshes) > MAX_SHAPES:
            node.fail("mesh", f"at most {MAX_SHAPES} primitives in all nodes together")
        for mesh, material_index in meshes:
            shape = Shape(name, mesh, transform, self.materials.index_of(material_index))
            if mesh.joints is not None and skin_index is not None:
                self._place_skinned(shape, index, skin_index)
                continue
            if mesh.joints is not None:
                shape = replace(shape, mesh=self._without_joints(mesh))
            elif skin_index is not None:
                self.notes["skins of meshes without joints are ignored"] += 1
            if mesh.morphs is not None or self.rig.moves(index):
                shape = replace(shape, node=self.rig.node(index))
            self.shapes.extend(
                self._placed(shape, place, instancing is not None) for place in places
            )

    def _placed(self, shape: Shape, place: np.ndarray, is_instance: bool) -> Shape:
        """Return one instance of ``shape``, or the shape where it is if there are none."""
        if not is_instance:
            return shape
        world = shape.transform @ place
        if shape.node >= 0:
            return replace(shape, transform=world, node=self.rig.child(shape.node, place))
        return replace(shape, transform=world)

    def _place_skinned(self, shape: Shape, index: int, skin_index: int) -> None:
        """Add a shape that its joints place: the transform of its own node does not count."""
        skin = self.rig.skin(skin_index)
        mesh = shape.mesh
        if mesh.joints is not None and mesh.joints.max(initial=0) >= len(skin.joints):
            count = len(skin.joints)
            self.gltf.root.element("skins", skin_index).fail(
                "joints", f"more than {mesh.joints.max()} nodes, as JOINTS_0 asks for", str(count)
            )
        node = self.rig.node(index) if mesh.morphs is not None else -1
        self.shapes.append(replace(shape, transform=np.eye(4), node=node, skin=skin))

    def _without_joints(self, mesh: Mesh) -> Mesh:
        if id(mesh) not in self.unskinned:
            self.unskinned[id(mesh)] = replace(mesh, joints=None, weights=None)
        return self.unskinned[id(mesh)]

    def _read_mesh(self, item: Item) -> list[tuple[Mesh, int | None]]:
        """Return the triangle meshes of all primitives with their material indices in the file."""
        meshes = []
        name = item.text("name", "") or item.place
        for i in range(item.length("primitives")):
            primitive = item.element("primitives", i)
            self.extensions.update(primitive.extension_names())
            # Meshes that differ in their materials alone are one.
            key = repr({key: primitive.values.get(key) for key in _GEOMETRY})
            if key not in self.primitives:
                try:
                    self.primitives[key] = self._read_primitive(primitive, name)
                except MissingData:
                    self.notes["primitives whose buffer has no data are left out"] += 1
                    continue
            mesh = self.primitives[key]
            if mesh is not None:
                meshes.append((mesh, self.gltf.index(primitive, "material", "materials")))
        return meshes

    def _read_primitive(self, primitive: Item, name: str) -> Mesh | None:
        mode = primitive.integer("mode", _TRIANGLES)
        if mode > _FAN:
            primitive.fail("mode", "0 to 6")
        attributes = primitive.item("attributes")
        if mode < _TRIANGLES:
            self.notes["points and lines are left out"] += 1
            return None
        if gltf_draco.decode_primitive(self.gltf, primitive):
            mode = _TRIANGLES
        positions = self.gltf.accessor(attributes, "POSITION", "VEC3", QUANTISED_OR_FLOAT)
        if positions is None:
            self.notes["primitives without POSITION are left out"] += 1
            return None
        normals = self.gltf.accessor(attributes, "NORMAL", "VEC3", QUANTISED_OR_FLOAT)
        uvs, uvs1 = (
            self.gltf.accessor(attributes, key, "VEC2", QUANTISED_OR_FLOAT)
            for key in ("TEXCOORD_0", "TEXCOORD_1")
        )
        tangents = self.gltf.accessor(attributes, "TANGENT", "VEC4", QUANTISED_OR_FLOAT)
        colors = self._colors(attributes)
        of_vertices = {
            "NORMAL": normals,
            "TEXCOORD_0": uvs,
            "TEXCOORD_1": uvs1,
            "TANGENT": tangents,
            "COLOR_0": colors,
        }
        for key, values in of_vertices.items():
            if values is not None and len(values) != len(positions):
                expected = f"as many elements as POSITION, {len(positions)}"
                attributes.fail(key, expected, str(len(values)))
        joints, weights = read_joints(self.gltf, attributes, len(positions)) or (None, None)
        morphs = read_morphs(self.gltf, primitive, len(positions))
        triangles = self._triangles(primitive, mode, len(positions))
        if len(triangles) == 0:
            return None
        # Each mesh takes memory, however few bytes of the file many of them share.
        self.triangle_count += len(triangles)
        if self.triangle_count > MAX_TRIANGLES:
            primitive.fail("indices", f"at most {MAX_TRIANGLES} triangles in all meshes")

        used = np.zeros(len(positions), bool)
        used[triangles] = True
        if not used.all():
            # Primitives often share one large vertex buffer: keep what each needs.
            triangles = (np.cumsum(used) - 1)[triangles]
            positions = positions[used]
            normals, uvs, uvs1, tangents, colors, joints, weights = (
                None if values is None else values[used]
                for values in (normals, uvs, uvs1, tangents, colors, joints, weights)
            )
            morphs = morphs and _used_morphs(morphs, used)
        if normals is not None:
            normals = _unit_normals(normals, positions, triangles)
        uvs, uvs1, tangents = (
            None if values is None else np.where(np.isfinite(values), values, np.float32(0.0))
            for values in (uvs, uvs1, tangents)
        )
        return Mesh(
            name,
            positions,
            triangles.astype(np.uint32),
            normals,
            uvs,
            uvs1,
            colors,
            tangents,
            morphs,
            joints,
            weights,
        )

    def _colors(self, attributes: Item) -> np.ndarray | None:
        """Return the colours of the vertices, ``(n, 4)`` float32 in [0, 1]."""
        if "COLOR_0" not in attributes:
            return None
        index = self.gltf.index(attributes, "COLOR_0", "accessors")
        kind = self.gltf.root.element("accessors", index).text("type", "")
        if kind not in ("VEC3", "VEC4"):
            attributes.fail("COLOR_0", "an accessor of type VEC3 or VEC4", kind)
        stored = self.gltf.accessor(attributes, "COLOR_0", kind, (5121, 5123, *FLOAT))
        colors = np.ones((len(stored), 4), np.float32)
        colors[:, : stored.shape[1]] = np.where(np.isfinite(stored), stored, np.float32(1.0))
        return np.clip(colors, 0.0, 1.0)

    def _triangles(self, primitive: Item, mode: int, vertex_count: int) -> np.ndarray:
        """Return ``(m, 3)`` vertex indices, all below ``vertex_count``."""
        stored = self.gltf.accessor(primitive, "indices", "SCALAR", UNSIGNED, as_float=False)
        if stored is None:
            indices = np.arange(vertex_count)
        else:
            indices = stored[:, 0].astype(np.int64)
            if indices.max() >= vertex_count:
                expected = f"indices below {vertex_count}, the number of vertices"
                primitive.fail("indices", expected, str(indices.max()))
        if len(indices) < 3 or (mode == _TRIANGLES and len(indices) % 3):
            self.notes["indices that make no whole triangle are left out"] += 1
        return _assemble_triangles(indices, mode)


def _check_version(asset: Item) -> None:
    """Refuse anything but glTF 2 that a reader of 2.0 may read."""
    for key, default in (("version", None), ("minVersion", "2.0")):
        version = asset.text(key, default)
        major, _, minor = version.partition(".")
        if major != "2" or not minor.isdecimal() or (key == "minVersion" and int(minor) > 0):
            asset.fail(key, "glTF 2.0")


def _check_required(root: Item) -> None:
    for name in root.texts("extensionsRequired"):
        if name == gltf_draco.EXTENSION:
            if not gltf_draco.is_available():
                expected = "the extra draco for compressed meshes: pip install 'psf_cl[draco]'"
                root.fail("extensionsRequired", expected, name)
        elif name not in SUPPORTED:
            known = ", ".join(SUPPORTED)
            root.fail("extensionsRequired", f"none but {known}", reprlib.repr(name))


def _order_nodes(nodes: list[Item], children: list[list[int]]) -> tuple[list[int], list[int]]:
    """Return all nodes, parents first, and each one's parent, -1 for none.

    Raises:
        InputError: a node has two parents or is its own ancestor.
    """
    parents = [-1] * len(nodes)
    for index, below in enumerate(children):
        for child in below:
            if parents[child] >= 0:
                nodes[index].fail("children", f"nodes without another parent (nodes[{child}] has)")
            parents[child] = index
    order = [index for index, parent in enumerate(parents) if parent < 0]
    for index in order:  # grows as it is read
        order.extend(children[index])
    if len(order) < len(nodes):
        looped = min(set(range(len(nodes))).difference(order))
        nodes[looped].fail("children", "no cycle")
    return order, parents


def _world_transforms(nodes: list[Item], order: list[int], parents: list[int]) -> list[np.ndarray]:
    """Return the ``(4, 4)`` float64 node-to-world matrix of every node."""
    world = [np.eye(4)] * len(nodes)
    with np.errstate(over="ignore", invalid="ignore"):
        for index in order:
            node = nodes[index]
            matrix = _local_transform(node)
            if parents[index] >= 0:
                matrix = world[parents[index]] @ matrix
            if not np.isfinite(matrix).all():
                place = f"{node.file}: {node.place}"
                raise InputError(f"{place}: expected a finite transform, got overflow")
            world[index] = matrix
    return world


def _local_transform(node: Item) -> np.ndarray:
    if "matrix" in node:
        if any(key in node for key in ("translation", "rotation", "scale")):
            node.fail("matrix", "no translation, rotation or scale beside it")
        # Stored by columns.
        matrix = np.array(node.numbers("matrix", np.eye(4).ravel().tolist())).reshape(4, 4).T
        if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-5):
            node.fail("matrix", "an affine matrix: entries 3, 7, 11, 15 being 0, 0, 0, 1")
        matrix[3] = (0.0, 0.0, 0.0, 1.0)
        return matrix
    # The product translation * rotation * scale, written out: files can have very many nodes.
    matrix = np.eye(4)
    if "rotation" in node:
        try:
            matrix = rotation_quaternion(node.numbers("rotation", (0.0, 0.0, 0.0, 1.0)))
        except ValueError:
            node.fail("rotation", "a quaternion that is not zero")
    if "scale" in node:
        matrix[:3, :3] *= node.numbers("scale", (1.0, 1.0, 1.0))
    if "translation" in node:
        matrix[:3, 3] = node.numbers("translation", (0.0, 0.0, 0.0))
    return matrix


def _instances(gltf: GltfFile, instancing: Item, transform: np.ndarray) -> list[np.ndarray]:
    """Return where EXT_mesh_gpu_instancing puts a mesh in its node, ``(4, 4)`` float64 each."""
    attributes = instancing.item("attributes")
    components = (*FLOAT, 5120, 5122)
    moves, turns, scales = (
        gltf.accessor(attributes, key, kind, allowed)
        for key, kind, allowed in (
            ("TRANSLATION", "VEC3", FLOAT),
            ("ROTATION", "VEC4", components),
            ("SCALE", "VEC3", FLOAT),
        )
    )
    counts = {len(values) for values in (moves, turns, scales) if values is not None}
    if len(counts) != 1:
        instancing.fail("attributes", "TRANSLATION, ROTATION or SCALE, of one count")
    (count,) = counts
    if count > MAX_SHAPES:
        instancing.fail("attributes", f"at most {MAX_SHAPES} instances", str(count))
    local = np.tile(np.eye(4), (count, 1, 1))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        if turns is not None:
            local[:, :3, :3] = rotation_matrices(turns.astype(float))
        if scales is not None:
            local[:, :3, :3] *= scales.astype(float)[:, None, :]
        if moves is not None:
            local[:, :3, 3] = moves
        places = transform @ local
    if not np.isfinite(places).all():
        instancing.fail("attributes", "accessors of finite transforms", "one that is not")
    return list(local)


def _used_morphs(morphs: Morphs, used: np.ndarray) -> Morphs:
    parts = (morphs.positions, morphs.normals, morphs.tangents)
    return Morphs(*(None if part is None else part[:, used] for part in parts))


def _assemble_triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    """Return ``(m, 3)`` triangles of a list, strip or fan of indices (section 3.7.2.1)."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    first = np.arange(max(len(indices) - 2, 0))
    if mode == _STRIP:
        odd = first % 2
        return indices[np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)]
    return indices[np.stack([first + 1, first + 2, first * 0], axis=1)]


def _unit_normals(normals: np.ndarray, positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return ``(n, 3)`` float32 normals of length 1.

    Zero and non-finite ones become the area-weighted mean normal of the triangles around.
    """
    # Signalling NaNs and overflow warn where they are computed with; they are sorted out here.
    with np.errstate(over="ignore", invalid="ignore"):
        unit, good = _normalised(normals.astype(float))
        if not good.all():
            corners = positions.astype(float)[triangles]
            faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            faces[~np.isfinite(faces).all(axis=1)] = 0.0
            around = np.zeros_like(unit)
            for corner in range(3):
                np.add.at(around, triangles[:, corner], faces)
            mean, _ = _normalised(around)
            unit[~good] = mean[~good]
    return unit.astype(np.float32)


def _normalised(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors, +Z in place of what has no direction, and which had one."""
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    good = np.isfinite(length) & (length > 0.0)
    unit = np.tile([0.0, 0.0, 1.0], (len(vectors), 1))
    np.divide(vectors, length[:, None], out=unit, where=good[:, None])
    return unit, good
