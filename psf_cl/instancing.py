"""Which shapes share a tree of their mesh, placed several times, and which stand alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from psf_cl import tables
from psf_cl.device import layout
from psf_cl.scene.model import Scene, Shape, emits, has_tangents, hides_back, is_cut_out

#: A scene of two levels has at most one of so many of the triangles that it shows: the upper level
#: and the way of rays into meshes cost time.
LEAST_REUSE = 2

#: Triangles that placing a mesh must save: a tree of its own takes as long as one of about so many
#: triangles more of the others.
LEAST_SAVED = 1 << 14

#: Bits of a hit's index below the number of the instance, to choose from: kernels are compiled for
#: each.
INDEX_BITS = (8, 12, 16, 20, 24)

#: Indices of hits end here: above are ALPHA_BIT and NO_HIT.
MOST_INDICES = 1 << 31

#: By how much a transform may stretch one direction more than another: rounding grows with it.
MOST_STRETCH = 1e3


@dataclass(frozen=True)
class Part:
    """Shapes that share the triangles of one mesh.

    Attributes:
        shapes: those, of one mesh.
        own_material: whether their materials are one, which the triangles name.
    """

    shapes: tuple[Shape, ...]
    own_material: bool

    @property
    def triangle_count(self) -> int:
        return len(self.shapes[0].mesh.triangles)


@dataclass(frozen=True)
class Levels:
    """How a scene is split.

    Attributes:
        single: shapes that are in the world's own tree, emitters among them.
        parts: meshes with trees of their own.
        index_bits: of a hit's index, below the number of the instance.
    """

    single: tuple[Shape, ...]
    parts: tuple[Part, ...]
    index_bits: int

    @property
    def single_count(self) -> int:
        return sum(len(shape.mesh.triangles) for shape in self.single)

    @property
    def triangle_count(self) -> int:
        """Return the triangles that there are in memory."""
        return self.single_count + sum(part.triangle_count for part in self.parts)

    @property
    def place_count(self) -> int:
        """Return how often a mesh is placed."""
        return sum(len(part.shapes) for part in self.parts)

    @property
    def instance_count(self) -> int:
        """Return the records of instances: a large mesh has several a place."""
        return _instance_count(self.single_count, self.parts, self.index_bits)


def split(scene: Scene) -> Levels | None:
    """Return how to split ``scene`` into two levels, or None if one is better.

    What moves, emits (an emitter is in the light table with its place) or is all but flattened by
    its transform stays single.
    """
    shapes = tables.visible_shapes(scene)
    total = sum(len(shape.mesh.triangles) for shape in shapes)
    meshes = {id(shape.mesh): len(shape.mesh.triangles) for shape in shapes}
    if scene.nodes or total < LEAST_REUSE * sum(meshes.values()) or total < LEAST_SAVED:
        return None
    placeable = _placeable(shapes)
    groups: dict[tuple[object, ...], list[int]] = {}
    for index, shape in enumerate(shapes):
        material = scene.materials[shape.material]
        if placeable[index] and not emits(material) and material.emission_curve is None:
            groups.setdefault(_mesh_key(scene, shape), []).append(index)
    single = np.ones(len(shapes), bool)
    parts = []
    for key, members in groups.items():
        count = len(shapes[members[0]].mesh.triangles)
        if (len(members) - 1) * count >= LEAST_SAVED:
            single[members] = False
            parts.append(Part(tuple(shapes[i] for i in members), key[-1] is not None))
    levels = Levels(
        tuple(shape for shape, alone in zip(shapes, single, strict=True) if alone), tuple(parts), 0
    )
    if not parts or total < LEAST_REUSE * levels.triangle_count:
        return None
    return replace(levels, index_bits=_index_bits(levels))


def _placeable(shapes: list[Shape]) -> np.ndarray:
    """Return ``(n,)`` bool: whose transform has an inverse that rounding spares."""
    linear = np.array([shape.transform[:3, :3] for shape in shapes])
    good = np.array([np.isfinite(shape.transform).all() for shape in shapes])
    with np.errstate(all="ignore"):
        stretch = np.linalg.svd(np.where(good[:, None, None], linear, 0.0), compute_uv=False)
        # Beyond these sizes products leave the range of float32.
        sizes = (stretch[:, 0] < 1e15) & (stretch[:, 2] > 1e-15)
        return good & sizes & (stretch[:, 0] < MOST_STRETCH * stretch[:, 2])


def _mesh_key(scene: Scene, shape: Shape) -> tuple[object, ...]:
    """Return what the triangles of a shape depend on; last its material, if they name it."""
    material = scene.materials[shape.material]
    directions: tuple[object, ...] | None = None
    if has_tangents(material):
        index = max(material.normal_texture, material.anisotropy_texture)
        texture = scene.textures[index] if index >= 0 else None
        directions = (texture.uv_set, texture.transform) if texture is not None else ()
    own = shape.material if is_cut_out(material, shape.mesh) else None
    return (id(shape.mesh), directions, hides_back(material), own)


def _index_bits(levels: Levels) -> int:
    """Return enough bits for the largest mesh, or as many as all indices leave room for."""
    largest = max(part.triangle_count for part in levels.parts)
    wanted = max(largest, levels.single_count, 1) - 1
    fitting = [
        bits
        for bits in INDEX_BITS
        if _instance_count(levels.single_count, levels.parts, bits) << bits < MOST_INDICES
    ]
    return next((bits for bits in fitting if wanted < 1 << bits), fitting[-1])


def _instance_count(single: int, parts: tuple[Part, ...], bits: int) -> int:
    pages = max(-(-single >> bits), 1)
    return pages + sum(len(part.shapes) * -(-part.triangle_count >> bits) for part in parts)


@dataclass(frozen=True)
class Placed:
    """What the device needs of a scene of two levels.

    Attributes:
        geometry: the single shapes' triangles in the world, then those of each part in the space of
            its mesh; its radius and center are the world's.
        starts: where in ``geometry`` each part begins, the single shapes first; one more, the end.
        instances: ``(n,)`` layout.INSTANCE, number 0 for the single shapes; ``root`` still 0.
        part_of: ``(n,)``, which of the starts each instance belongs to.
        boxes: ``(m, 6)`` float32 around the places, low and high corner; world, m.
        first: ``(m,)`` uint32, the instance of each place.
    """

    geometry: tables.Geometry
    starts: np.ndarray
    instances: np.ndarray
    part_of: np.ndarray
    boxes: np.ndarray
    first: np.ndarray


def place(scene: Scene, levels: Levels) -> Placed:
    """Return the tables of a scene of two levels."""
    meshes = [replace(part.shapes[0], transform=np.eye(4)) for part in levels.parts]
    geometry = tables.flatten(replace(scene, shapes=(*levels.single, *meshes)))
    counts = [levels.single_count, *(part.triangle_count for part in levels.parts)]
    starts = np.cumsum([0, *counts])
    bits = levels.index_bits
    instances = np.zeros(levels.instance_count, layout.INSTANCE.dtype)
    part_of = np.zeros(len(instances), np.int64)
    boxes, first = [], []
    single_pages = max(-(-levels.single_count >> bits), 1)
    _fill(instances[:single_pages], np.eye(4)[None], np.zeros((1, 3)))
    instances["offset"][:single_pages] = 0.0
    instances["material"] = layout.CONSTANT["OWN_MATERIAL"]
    at = single_pages
    for number, part in enumerate(levels.parts, start=1):
        pages = -(-part.triangle_count >> bits)
        rows = instances[at : at + pages * len(part.shapes)]
        part_of[at : at + len(rows)] = number
        transforms = np.array([shape.transform for shape in part.shapes])
        low, high = _box(geometry.positions[starts[number] : starts[number + 1]])
        _fill(rows, np.repeat(transforms, pages, axis=0), np.maximum(np.abs(low), np.abs(high)))
        firsts = at + pages * np.arange(len(part.shapes))
        rows["base"] = np.repeat((firsts << bits) - starts[number], pages).astype(np.uint32)
        if not part.own_material:
            materials = np.array([shape.material for shape in part.shapes])
            rows["material"] = np.repeat(materials, pages)
        boxes.append(_world_boxes(transforms, low, high))
        first.append(firsts)
        at += len(rows)
    around = np.concatenate(boxes)
    low, high = _box(geometry.positions[: starts[1]])
    low = np.minimum(low, around[:, :3].min(axis=0)) if starts[1] else around[:, :3].min(axis=0)
    high = np.maximum(high, around[:, 3:].max(axis=0)) if starts[1] else around[:, 3:].max(axis=0)
    return Placed(
        replace(
            geometry,
            radius=float(np.linalg.norm(high.astype(float) - low)) / 2,
            center=(high.astype(float) + low) / 2,
        ),
        starts,
        instances,
        part_of,
        around,
        np.concatenate(first).astype(np.uint32),
    )


def _fill(rows: np.ndarray, transforms: np.ndarray, extent: np.ndarray) -> None:
    """Set the placing of ``rows``.

    Args:
        transforms: ``(n, 4, 4)``.
        extent: ``(3,)``, largest coordinates of the mesh.
    """
    linear, position = transforms[:, :3, :3], transforms[:, :3, 3]
    inverse = np.linalg.inv(linear)
    for row, name in enumerate(("x_row", "y_row", "z_row")):
        rows[name] = linear[:, row]
    rows["position"] = position
    rows["inverse"] = inverse.reshape(-1, 9)
    rows["mirroring"] = np.sign(np.linalg.det(linear))
    # A point is made of these coordinates, a ray's way into the mesh and back of these.
    parts = np.abs(linear) @ np.broadcast_to(extent, (len(rows), 3))[..., None]
    world = parts + np.abs(position)[..., None]
    there_and_back = np.abs(linear) @ (np.abs(inverse) @ (parts + world))
    size = np.maximum(world, there_and_back)[..., 0].max(axis=1)
    rows["offset"] = np.maximum(layout.OFFSET_EPSILON * size, np.finfo(np.float32).tiny)


def _box(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box around the finite triangles; zero if there are none."""
    finite = positions[np.isfinite(positions).all(axis=1)].reshape(-1, 3).astype(np.float64)
    if not len(finite):
        return np.zeros(3), np.zeros(3)
    return finite.min(axis=0), finite.max(axis=0)


def _world_boxes(transforms: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return ``(n, 6)`` float32 boxes around a box under each transform, rounded outwards."""
    corners = np.stack([low, high])[np.indices((2, 2, 2)).reshape(3, 8).T, np.arange(3)]
    world = corners @ np.swapaxes(transforms[:, :3, :3], 1, 2) + transforms[:, None, :3, 3]
    room = layout.OFFSET_EPSILON * np.abs(world).max(axis=(1, 2))[:, None]
    boxes = np.concatenate([world.min(axis=1) - room, world.max(axis=1) + room], axis=1)
    return boxes.astype(np.float32)
