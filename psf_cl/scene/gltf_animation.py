"""What moves in a glTF file: animations, skins and morph targets.

Source: Khronos Group, "glTF 2.0 Specification", sections 3.7.2.2, 3.7.3 and 3.11.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from psf_cl.errors import InputError
from psf_cl.scene.curve import Curve
from psf_cl.scene.gltf_file import FLOAT, QUANTISED_OR_FLOAT, GltfFile, Item, MissingData
from psf_cl.scene.model import Morphs, Node, Skin

#: Vertices times morph targets of a mesh: targets may share the bytes of the file.
MAX_MORPHED = 1 << 26
MAX_TARGETS = 1 << 12
MAX_JOINT_SETS = 4

_KINDS = {
    "translation": ("VEC3", FLOAT),
    "rotation": ("VEC4", (5120, 5121, 5122, 5123, *FLOAT)),
    "scale": ("VEC3", FLOAT),
    "weights": ("SCALAR", (5120, 5121, 5122, 5123, *FLOAT)),
}
_INTERPOLATIONS = {"STEP": "step", "LINEAR": "linear", "CUBICSPLINE": "cubic"}
_TARGET_KEYS = ("POSITION", "NORMAL", "TANGENT")

NodeCurves = dict[int, dict[str, Curve]]


def read_curves(gltf: GltfFile, clip: str | None, notes: Counter[str]) -> NodeCurves:
    """Return the curves of the file's animations by node and by what they change.

    Args:
        clip: name of the one animation to play, or its number; None for all of them that do not
            change what an earlier one changes.

    Raises:
        InputError: an animation is malformed, or there is none of that name.
    """
    root = gltf.root
    items = [root.element("animations", i) for i in range(root.length("animations"))]
    names = [item.text("name", "") or str(i) for i, item in enumerate(items)]
    if clip is not None:
        chosen = [i for i, name in enumerate(names) if clip in (name, str(i))]
        if not chosen:
            known = ", ".join(repr(name) for name in names) or "none"
            raise InputError(f"{root.file}: no animation {clip!r}; known: {known}")
        items = [items[chosen[0]]]
    curves: NodeCurves = {}
    played = []
    for item, name in zip(items, names, strict=False):
        own = _read_animation(gltf, item, notes)
        if any(curves.get(node, {}).keys() & parts.keys() for node, parts in own.items()):
            continue
        played.append(name)
        for node, parts in own.items():
            curves.setdefault(node, {}).update(parts)
    if clip is None and len(played) < len(names):
        others = ", ".join(repr(name) for name in names if name not in played)
        notes[f"the animation {played[0]!r} is played; --clip picks another: {others}"] += 1
    return curves


def _read_animation(gltf: GltfFile, item: Item, notes: Counter[str]) -> NodeCurves:
    curves: NodeCurves = {}
    samplers: dict[tuple[int, str, int], Curve] = {}
    for i in range(item.length("channels")):
        channel = item.element("channels", i)
        target = channel.item("target")
        path = target.text("path")
        if path == "pointer":
            notes["animations of other things than nodes are left out"] += 1
            continue
        if path not in _KINDS:
            target.fail("path", f"one of {', '.join(_KINDS)}")
        node = gltf.index(target, "node", "nodes")
        if node is None:
            continue
        index = channel.integer("sampler")
        count = item.length("samplers")
        if index >= count:
            channel.fail("sampler", f"an index of samplers, which has {count} entries")
        place = gltf.root.element("nodes", node)
        if path != "weights" and "matrix" in place:
            target.fail("node", f"a node without a matrix ({place.place} has one)")
        width = {"translation": 3, "rotation": 4, "scale": 3}.get(path, 0)
        if path == "weights":
            width = node_targets(gltf, place)
            if width == 0:
                target.fail("node", "a node whose mesh has morph targets")
        if path in curves.setdefault(node, {}):
            target.fail("path", f"one channel for the {path} of {place.place}")
        key = (index, path, width)
        if key not in samplers:
            try:
                samplers[key] = _read_sampler(gltf, item.element("samplers", index), path, width)
            except MissingData:
                notes["animations whose buffer has no data are left out"] += 1
                continue
        curves[node][path] = samplers[key]
    return {node: parts for node, parts in curves.items() if parts}


def _read_sampler(gltf: GltfFile, sampler: Item, path: str, width: int) -> Curve:
    interpolation = sampler.text("interpolation", "LINEAR")
    if interpolation not in _INTERPOLATIONS:
        sampler.fail("interpolation", f"one of {', '.join(_INTERPOLATIONS)}")
    times = gltf.accessor(sampler, "input", "SCALAR", FLOAT)
    if times is None:
        sampler.fail("input", "an index of accessors")
    times = times[:, 0].astype(np.float64)
    if not (np.isfinite(times).all() and (np.diff(times) > 0.0).all()):
        sampler.fail("input", "an accessor of finite times that grow")
    kind, components = _KINDS[path]
    values = gltf.accessor(sampler, "output", kind, components)
    if values is None:
        sampler.fail("output", "an index of accessors")
    values = values.astype(np.float64)
    parts = 3 if interpolation == "CUBICSPLINE" else 1
    rows = parts * len(times) * (width if path == "weights" else 1)
    if len(values) != rows:
        sampler.fail("output", f"an accessor of {rows} elements for {len(times)} times")
    if not np.isfinite(values).all():
        sampler.fail("output", "an accessor of finite numbers")
    values = values.reshape(len(times), parts, width)
    if path == "rotation":
        middle = values[:, parts // 2]
        if not middle.any(axis=1).all():
            sampler.fail("output", "an accessor of quaternions that are not zero")
    if parts == 1:
        values = values[:, 0]
    return Curve(times, values, _INTERPOLATIONS[interpolation], turning=path == "rotation")


def node_targets(gltf: GltfFile, node: Item) -> int:
    """Return how many morph targets the mesh of a node has.

    Raises:
        InputError: its primitives disagree.
    """
    index = gltf.index(node, "mesh", "meshes")
    if index is None:
        return 0
    mesh = gltf.root.element("meshes", index)
    counts = set()
    for i in range(mesh.length("primitives")):
        primitive = mesh.element("primitives", i)
        counts.add(primitive.length("targets"))
        if len(counts) > 1:
            primitive.fail("targets", "as many morph targets as the mesh's other primitives have")
    return counts.pop() if counts else 0


def read_morphs(gltf: GltfFile, primitive: Item, vertex_count: int) -> Morphs | None:
    """Return the morph targets of a primitive, or None if it has none."""
    count = primitive.length("targets")
    if count > MAX_TARGETS or count * vertex_count > MAX_MORPHED:
        primitive.fail("targets", f"at most {MAX_TARGETS}, and {MAX_MORPHED} vertices in all")
    if count == 0:
        return None
    parts: list[np.ndarray | None] = []
    for key in _TARGET_KEYS:
        part = None
        for i in range(count):
            target = primitive.element("targets", i)
            values = gltf.accessor(target, key, "VEC3", QUANTISED_OR_FLOAT)
            if values is None:
                continue
            if len(values) != vertex_count:
                target.fail(key, f"as many elements as POSITION, {vertex_count}", str(len(values)))
            if not np.isfinite(values).all():
                target.fail(key, "an accessor of finite numbers")
            if part is None:
                part = np.zeros((count, vertex_count, 3), np.float32)
            part[i] = values
        parts.append(part)
    if all(part is None for part in parts):
        # What changes nothing still has its weights.
        parts[0] = np.zeros((count, vertex_count, 3), np.float32)
    return Morphs(*parts)


def read_joints(
    gltf: GltfFile, attributes: Item, vertex_count: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the joints of each vertex and their weights, ``(n, k)`` each, or None.

    Weights are made to add up to 1; a vertex without any hangs on its first joint.
    """
    joints, weights = [], []
    while f"JOINTS_{len(joints)}" in attributes and len(joints) < MAX_JOINT_SETS:
        keys = f"JOINTS_{len(joints)}", f"WEIGHTS_{len(joints)}"
        indices = gltf.accessor(attributes, keys[0], "VEC4", (5121, 5123), as_float=False)
        shares = gltf.accessor(attributes, keys[1], "VEC4", (5121, 5123, *FLOAT))
        if shares is None:
            attributes.fail(keys[1], f"an accessor beside {keys[0]}")
        for key, values in zip(keys, (indices, shares), strict=True):
            if len(values) != vertex_count:
                expected = f"as many elements as POSITION, {vertex_count}"
                attributes.fail(key, expected, str(len(values)))
        if not (np.isfinite(shares).all() and (shares >= 0.0).all()):
            attributes.fail(keys[1], "an accessor of numbers from 0 on")
        joints.append(indices)
        weights.append(shares)
    if not joints:
        return None
    joint, weight = np.concatenate(joints, axis=1), np.concatenate(weights, axis=1)
    total = weight.sum(axis=1, keepdims=True, dtype=np.float64)
    first = np.eye(1, weight.shape[1])
    with np.errstate(all="ignore"):
        share = np.where(total > 0.0, weight / total, first)
    used = share.any(axis=0)
    return joint[:, used].astype(np.uint32), share[:, used].astype(np.float32)


@dataclass
class Rig:
    """The nodes of a scene that are needed for what moves, made as shapes ask for them.

    Attributes:
        items, parents, world: of all nodes of the file; parents -1 for none.
        curves: of ``read_curves``.
        nodes: those that were asked for, with what moves above them; parents first.
    """

    gltf: GltfFile
    items: Sequence[Item]
    parents: Sequence[int]
    world: Sequence[np.ndarray]
    curves: NodeCurves
    nodes: list[Node] = field(default_factory=list)
    _made: dict[int, int] = field(default_factory=dict)
    _moving: dict[int, bool] = field(default_factory=dict)
    _skins: dict[int, Skin] = field(default_factory=dict)

    def moves(self, index: int) -> bool:
        """Return whether a node of the file, or one above it, changes its place."""
        chain = []
        while index >= 0 and index not in self._moving:
            chain.append(index)
            if self.curves.get(index, {}).keys() - {"weights"}:
                self._moving[index] = True
                break
            index = self.parents[index]
        moving = index >= 0 and self._moving[index]
        self._moving.update(dict.fromkeys(chain, moving))
        return moving

    def node(self, index: int) -> int:
        """Return the place in ``nodes`` of a node of the file."""
        chain = []
        while index >= 0 and index not in self._made:
            chain.append(index)
            if not self.moves(index):
                break
            index = self.parents[index]
        for index in reversed(chain):
            self._made[index] = len(self.nodes)
            self.nodes.append(self._make(index))
        return self._made[index if not chain else chain[0]]

    def child(self, node: int, matrix: np.ndarray) -> int:
        """Return a new node with the weights of ``node``, at ``matrix`` in its space."""
        above = self.nodes[node]
        weights = {name: curve for name, curve in above.curves.items() if name == "weights"}
        self.nodes.append(Node(node, matrix=matrix, weights=above.weights, curves=weights))
        return len(self.nodes) - 1

    def _make(self, index: int) -> Node:
        item, curves = self.items[index], self.curves.get(index, {})
        weights = self._rest_weights(item)
        if not self.moves(index):
            return Node(matrix=self.world[index], weights=weights, curves=curves)
        parent = self.parents[index]
        parent = -1 if parent < 0 else self._made[parent]
        if "matrix" in item:
            stored = item.numbers("matrix", np.eye(4).ravel().tolist())
            matrix = np.array(stored).reshape(4, 4).T
            matrix[3] = (0.0, 0.0, 0.0, 1.0)
            return Node(parent, matrix=matrix, weights=weights, curves=curves)
        return Node(
            parent,
            item.numbers("translation", (0.0, 0.0, 0.0)),
            item.numbers("rotation", (0.0, 0.0, 0.0, 1.0)),
            item.numbers("scale", (1.0, 1.0, 1.0)),
            weights=weights,
            curves=curves,
        )

    def _rest_weights(self, node: Item) -> tuple[float, ...]:
        count = node_targets(self.gltf, node)
        if count == 0:
            return ()
        zeros = (0.0,) * count
        if "weights" in node:
            return node.numbers("weights", zeros)
        index = self.gltf.index(node, "mesh", "meshes")
        return self.gltf.root.element("meshes", index).numbers("weights", zeros)

    def skin(self, index: int) -> Skin:
        """Return a skin of the file.

        Raises:
            InputError: it is malformed.
        """
        if index not in self._skins:
            item = self.gltf.root.element("skins", index)
            joints = self.gltf.indices(item, "joints", "nodes")
            if not joints:
                item.fail("joints", "at least one node")
            inverse = np.tile(np.eye(4), (len(joints), 1, 1))
            stored = self.gltf.accessor(item, "inverseBindMatrices", "MAT4", FLOAT)
            if stored is not None:
                if len(stored) < len(joints) or not np.isfinite(stored).all():
                    expected = f"an accessor of at least {len(joints)} finite matrices"
                    item.fail("inverseBindMatrices", expected)
                # Stored by columns.
                inverse = stored[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1).astype(float)
                inverse[:, 3] = (0.0, 0.0, 0.0, 1.0)
            nodes = tuple(self.node(joint) for joint in joints)
            self._skins[index] = Skin(nodes, inverse)
        return self._skins[index]
