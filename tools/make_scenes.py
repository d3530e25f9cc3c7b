"""Write the generated meshes of scenes/: ``python tools/make_scenes.py [FOLDER]``.

The same bytes come out every time and everywhere: positions are rounded to 2^-16 m, which hides
the last bits in which processors' sines differ, and random numbers come from ``random.random()``,
whose sequence Python guarantees.
"""

from __future__ import annotations

import argparse
import json
import random
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Mesh

Point = Sequence[float]

# glTF's default is a metal.
PLAIN = {"pbrMetallicRoughness": {"metallicFactor": 0}}

POSITION_STEPS = 1 << 16
NORMAL_STEPS = 1 << 14


@dataclass
class Model:
    """Triangles gathered by material, to be written as one glTF mesh.

    Attributes:
        materials: by name, the glTF material; one that is not listed is ``PLAIN``.
        parts: by material and whether it has normals, lists of positions, normals and triangles.
    """

    name: str
    materials: dict[str, dict[str, Any]] = field(default_factory=dict)
    parts: dict[tuple[str, bool], list[Mesh]] = field(default_factory=dict)

    def add(self, material: str, mesh: Mesh, matrix: np.ndarray | None = None) -> None:
        """Add a mesh moved by ``matrix``, whose determinant is positive."""
        matrix = np.eye(4) if matrix is None else matrix
        normals = mesh.normals
        if normals is not None:
            normals = normals @ np.linalg.inv(matrix[:3, :3])
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        positions = transform.transform_points(matrix, mesh.positions)
        moved = Mesh(mesh.name, positions, mesh.triangles, normals)
        self.parts.setdefault((material, normals is not None), []).append(moved)

    def slab(self, material: str, low: Point, high: Point) -> None:
        """Add the box between two opposite corners."""
        low_, high_ = np.array(low, float), np.array(high, float)
        placed = transform.translation((low_ + high_) / 2) @ transform.scaling((high_ - low_) / 2)
        self.add(material, primitives.box(), placed)

    def write(self, folder: Path) -> None:
        """Write ``name.glb`` into ``folder``."""
        (folder / f"{self.name}.glb").write_bytes(self._glb())

    def _glb(self) -> bytes:
        blob = bytearray()
        views: list[dict[str, Any]] = []
        accessors: list[dict[str, Any]] = []

        def accessor(
            values: np.ndarray, kind: str, component: int, target: int, **more: Any
        ) -> int:
            views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": values.nbytes})
            views[-1]["target"] = target
            blob.extend(values.tobytes() + bytes(-values.nbytes % 4))
            accessors.append({"bufferView": len(views) - 1, "componentType": component})
            accessors[-1] |= {"count": len(values), "type": kind, **more}
            return len(accessors) - 1

        names = list(dict.fromkeys(name for name, _ in self.parts))
        drawn = []
        for (name, smooth), meshes in self.parts.items():
            first = np.cumsum([0, *(len(mesh.positions) for mesh in meshes)])
            positions = _rounded([mesh.positions for mesh in meshes], POSITION_STEPS)
            low, high = positions.min(axis=0).tolist(), positions.max(axis=0).tolist()
            attributes = {"POSITION": accessor(positions, "VEC3", 5126, 34962, min=low, max=high)}
            if smooth:
                normals = _rounded([mesh.normals for mesh in meshes], NORMAL_STEPS)
                attributes["NORMAL"] = accessor(normals, "VEC3", 5126, 34962)
            shifted = [mesh.triangles + start for mesh, start in zip(meshes, first, strict=False)]
            indices = np.concatenate(shifted).reshape(-1)
            short = len(positions) < 65535
            indices = indices.astype("<u2" if short else "<u4")
            index = accessor(indices, "SCALAR", 5123 if short else 5125, 34963)
            drawn.append(
                {"attributes": attributes, "indices": index, "material": names.index(name)}
            )
        materials = [{"name": name, **self.materials.get(name, PLAIN)} for name in names]
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "psf_cl make_scenes"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": self.name, "mesh": 0}],
            "meshes": [{"name": self.name, "primitives": drawn}],
            "materials": materials,
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": len(blob)}],
        }
        used = sorted({key for item in materials for key in item.get("extensions", {})})
        if used:
            document["extensionsUsed"] = used
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(blob), b"BIN\0") + bytes(blob)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _rounded(arrays: Sequence[np.ndarray | None], steps: int) -> np.ndarray:
    whole = np.concatenate([array for array in arrays if array is not None])
    # Adding 0 turns -0 into 0.
    return (np.rint(whole * steps) / steps + 0.0).astype("<f4")


def _smooth(name: str, positions: np.ndarray, triangles: np.ndarray) -> Mesh:
    """Return a mesh whose vertex normals are the area-weighted means of its faces' normals."""
    corners = positions[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], face)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(name, positions, triangles.astype(np.uint32), normals)


def _grid(rows: int, columns: int) -> np.ndarray:
    """Return the triangles of a torus of ``rows`` times ``columns`` vertices."""
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    below, right = (row + 1) % rows, (column + 1) % columns
    a, b = row * columns + column, below * columns + column
    c, d = below * columns + right, row * columns + right
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def lathe(profile: Sequence[Point], segments: int, *, closed: bool = False) -> Mesh:
    """Return the surface that a profile of ``(radius, y)`` sweeps around Y, smooth.

    Fronts are to the right of the profile's way as seen with the radius to the right and Y up, so
    a profile that goes up has its front outside.  ``closed`` joins its end to its start.
    """
    outline = np.array(profile, float)
    angle = 2 * np.pi * np.arange(segments) / segments
    circle = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    positions = np.empty((len(outline), segments, 3))
    positions[..., [0, 2]] = outline[:, None, :1] * circle
    positions[..., 1] = outline[:, None, 1]
    triangles = _grid(len(outline), segments).reshape(len(outline), segments, 2, 3)[..., ::-1]
    if not closed:
        triangles = triangles[:-1]
    return _smooth("lathe", positions.reshape(-1, 3), triangles.reshape(-1, 3))


def torus(tube: float, columns: int, rows: int) -> Mesh:
    """Return the torus of radius 1 around Y with a tube of radius ``tube``."""
    angle = 2 * np.pi * np.arange(rows) / rows
    outline = np.stack([1 + tube * np.cos(angle), tube * np.sin(angle)], axis=-1)
    return lathe(outline, columns, closed=True)


def knot(tube: float, columns: int, rows: int) -> Mesh:
    """Return a trefoil knot of radius about 1 around Y with a tube of radius ``tube``."""
    t = 2 * np.pi * np.arange(columns) / columns

    def curve(t: np.ndarray) -> np.ndarray:
        radius = 0.67 + 0.33 * np.cos(3 * t)
        return np.stack(
            [radius * np.cos(2 * t), 0.4 * np.sin(3 * t), radius * np.sin(2 * t)], axis=-1
        )

    center = curve(t)
    along = curve(t + 1e-3) - curve(t - 1e-3)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # The knot never points along Y, so that this frame turns smoothly and closes.
    side = np.cross(along, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, along)
    turn = 2 * np.pi * np.arange(rows)[None, :, None] / rows
    offset = np.cos(turn) * side[:, None] + np.sin(turn) * up[:, None]
    positions = center[:, None] + tube * offset
    return _smooth("knot", positions.reshape(-1, 3), _grid(columns, rows))


def cylinder(segments: int) -> Mesh:
    """Return the open cylinder of radius 1 around Y from y = -1 to 1, its front outside."""
    return lathe([(1, -1), (1, 1)], segments)


def _at(offset: Point, scale: float | Point = 1.0, turn: Point = (0, 0, 0)) -> np.ndarray:
    rotated = transform.rotation_xyz_degrees(turn) @ transform.scaling(scale)
    return transform.translation(offset) @ rotated


def add_wall(
    model: Model,
    material: str,
    start: tuple[float, float],
    length: float,
    along: str,
    height: float,
    opening: tuple[float, float, float] | None = None,
    thickness: float = 0.15,
) -> None:
    """Add a wall from ``start`` (x, z) along ``"x"`` or ``"z"``, with a doorway if asked for.

    Args:
        opening: where the doorway begins and ends, meters from ``start``, and its height.
    """

    def piece(begin: float, end: float, low: float, high: float) -> None:
        if end - begin < 1e-6 or high - low < 1e-6:
            return
        x, z = start
        half = thickness / 2
        if along == "x":
            model.slab(material, (x + begin, low, z - half), (x + end, high, z + half))
        else:
            model.slab(material, (x - half, low, z + begin), (x + half, high, z + end))

    if opening is None:
        piece(0.0, length, 0.0, height)
        return
    begin, end, top = opening
    piece(0.0, begin, 0.0, height)
    piece(end, length, 0.0, height)
    piece(begin, end, top, height)


def add_table(model: Model, material: str, center: Point, size: Point) -> None:
    """Add a table: ``center`` (x, z), ``size`` (x, height, z)."""
    (x, z), (width, height, depth) = center, size
    model.slab(
        material,
        (x - width / 2, height - 0.04, z - depth / 2),
        (x + width / 2, height, z + depth / 2),
    )
    for side_x in (-1, 1):
        for side_z in (-1, 1):
            leg_x = x + side_x * (width / 2 - 0.06)
            leg_z = z + side_z * (depth / 2 - 0.06)
            model.slab(
                material,
                (leg_x - 0.03, 0, leg_z - 0.03),
                (leg_x + 0.03, height - 0.04, leg_z + 0.03),
            )


# Outside from the middle of the bottom up to the lip, then inside down again.  A hole of 0.01 is
# left on the axis, as a lathe has no tip; joined end to start, the wall is closed around it.
VASE = [
    (0.01, 0.0), (0.45, 0.0), (0.55, 0.08), (0.72, 0.35), (0.78, 0.62), (0.7, 0.9), (0.5, 1.15),
    (0.34, 1.35), (0.3, 1.52), (0.36, 1.68), (0.48, 1.8), (0.46, 1.82), (0.33, 1.68),
    (0.26, 1.52), (0.3, 1.35), (0.46, 1.13), (0.66, 0.88), (0.73, 0.62), (0.67, 0.36),
    (0.5, 0.12), (0.4, 0.05), (0.01, 0.05),
]  # fmt: skip


def refined(profile: Sequence[Point], count: int) -> np.ndarray:
    """Return ``count`` points on a smooth curve through a profile (Catmull and Rom, 1974)."""
    p = np.array(profile, float)
    p = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    t = np.linspace(0, len(p) - 3 - 1e-9, count)
    k = t.astype(int)
    t = (t - k)[:, None]
    a, b, c, d = p[k], p[k + 1], p[k + 2], p[k + 3]
    cubic = 2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2
    return (cubic + (3 * b - a - 3 * c + d) * t**3) / 2


def make_ajar_door() -> Model:
    """Two rooms; the lamp is in the back one, and a nearly closed door is all that joins them."""
    model = Model("ajar_door")
    chance = random.Random(1).random
    height = 2.7
    # The front room is z in [0, 5], the back room z in [-4, 0], both x in [-3, 3].
    model.slab("floor", (-3.1, -0.1, -4.1), (3.1, 0.0, 5.1))
    model.slab("ceiling", (-3.1, height, -4.1), (3.1, height + 0.1, 5.1))
    for z in (-4.0, 5.0):
        add_wall(model, "wall", (-3.1, z), 6.2, "x", height)
    for x in (-3.0, 3.0):
        add_wall(model, "wall", (x, -4.1), 9.2, "z", height)
    add_wall(model, "wall", (-3.1, 0.0), 6.2, "x", height, (3.6, 4.5, 2.04))
    for x in (0.5, 1.4):
        model.slab("frame", (x - 0.05, 0.0, -0.1), (x + 0.02, 2.06, 0.1))
    model.slab("frame", (0.45, 2.02, -0.1), (1.42, 2.1, 0.1))

    # The leaf turns on its hinge at x = 1.38 and stands open into the front room.
    hinge = _at((1.38, 0.0, 0.02), turn=(0, 14, 0))
    leaf = _at((-0.43, 1.01, 0.02), (0.43, 1.005, 0.02))
    model.add("door", primitives.box(), hinge @ leaf)
    for low, high in ((0.15, 0.9), (1.05, 1.85)):
        panel = _at((-0.43, (low + high) / 2, 0.045), (0.3, (high - low) / 2, 0.006))
        model.add("door", primitives.box(), hinge @ panel)
    knob = primitives.sphere(32, 16)
    model.add("brass", knob, hinge @ _at((-0.79, 1.0, 0.09), 0.032))
    stem = _at((-0.79, 1.0, 0.06), (0.012, 0.03, 0.012), (90, 0, 0))
    model.add("brass", cylinder(24), hinge @ stem)

    # The lamp hangs beside the doorway, where the front room cannot see it.
    model.add("lamp", primitives.quad(), _at((-1.2, 2.5, -2.2), (0.35, 1.0, 0.35), (180, 0, 0)))
    model.slab("frame", (-1.56, 2.52, -2.56), (-0.84, 2.56, -1.84))
    model.slab("shelf", (-2.9, 0.0, -3.9), (-1.4, 1.1, -3.4))

    add_table(model, "wood", (-0.9, 1.9), (1.7, 0.74, 0.95))
    vase = lathe(refined(VASE, 61), 48, closed=True)
    model.add("china", vase, _at((-1.25, 0.74, 1.9), 0.16))
    model.add("bowl", knot(0.14, 96, 14), _at((-0.45, 0.86, 1.75), 0.17, (0, 30, 0)))
    for index, place in enumerate([(-0.75, 2.15), (-0.6, 2.22), (-0.66, 2.08)]):
        color = ("orange", "lemon", "plum")[index]
        model.add(color, primitives.sphere(32, 16), _at((place[0], 0.785, place[1]), 0.045))
    for x, z, turn in ((-1.4, 2.75, 10.0), (-0.3, 2.8, -15.0)):
        seat = _at((x, 0.0, z), turn=(0, turn, 0))
        for low, high in (
            ((-0.22, 0.42, -0.22), (0.22, 0.46, 0.22)),
            ((-0.22, 0.46, 0.18), (0.22, 0.95, 0.22)),
            ((-0.22, 0.0, -0.22), (-0.18, 0.42, -0.18)),
            ((0.18, 0.0, -0.22), (0.22, 0.42, -0.18)),
            ((-0.22, 0.0, 0.18), (-0.18, 0.46, 0.22)),
            ((0.18, 0.0, 0.18), (0.22, 0.46, 0.22)),
        ):
            low_, high_ = np.array(low), np.array(high)
            model.add("wood", primitives.box(), seat @ _at((low_ + high_) / 2, (high_ - low_) / 2))

    # A bookcase on the right wall: boards, and books of random size and colour.
    for shelf in range(6):
        y = 0.08 + 0.36 * shelf
        model.slab("shelf", (2.6, y - 0.015, 0.9), (2.92, y + 0.015, 2.7))
        z = 0.95
        while shelf < 5 and z < 2.6:
            width, tall = 0.02 + 0.035 * chance(), 0.2 + 0.11 * chance()
            deep = 0.17 + 0.07 * chance()
            color = ("orange", "lemon", "plum", "china", "bowl")[int(5 * chance())]
            if chance() < 0.9 and z + width < 2.62:
                model.slab(color, (2.9 - deep, y + 0.015, z), (2.9, y + 0.015 + tall, z + width))
            z += width + 0.003
    for z in (0.88, 2.7):
        model.slab("shelf", (2.6, 0.0, z - 0.02), (2.92, 1.95, z + 0.02))
    model.slab("picture", (-2.92, 1.1, 1.2), (-2.88, 1.9, 2.4))
    model.add("wood", torus(0.06, 64, 12), _at((-1.6, 1.6, 0.1), 0.35, (90, 0, 0)))
    model.add("china", primitives.disk(), _at((-1.6, 1.6, 0.085), 0.34, (90, 0, 0)))
    return model


ROOM = 6.0
ROOM_COLUMNS, ROOM_ROWS = 8, 6
LAMP_COUNT = 2000
LAMP_COLORS = (
    (1.0, 0.85, 0.65), (0.75, 0.85, 1.0), (1.0, 0.35, 0.2), (0.3, 1.0, 0.45), (0.45, 0.4, 1.0),
)  # fmt: skip
LAMP_LEVELS = tuple(0.15 * 2.5**level for level in range(8))


def make_many_lights() -> Model:
    """8 x 6 cells of 6 m, joined by doorways or opened into halls, with 2,000 lamps.

    A lamp's radiance is one of ``LAMP_LEVELS`` (more often a low one) in one of ``LAMP_COLORS``:
    power is spread over more than four decades, as the lamps' areas differ too.
    """
    model = Model("many_lights")
    chance = random.Random(2).random
    height = 3.2
    wide, deep = ROOM * ROOM_COLUMNS, ROOM * ROOM_ROWS
    model.slab("floor", (-0.2, -0.1, -0.2), (wide + 0.2, 0.0, deep + 0.2))
    model.slab("ceiling", (-0.2, height, -0.2), (wide + 0.2, height + 0.1, deep + 0.2))
    for z in (0.0, deep):
        add_wall(model, "wall", (-0.1, z), wide + 0.2, "x", height)
    for x in (0.0, wide):
        add_wall(model, "wall", (x, -0.1), deep + 0.2, "z", height)

    # Two halls of several cells: no walls inside, pillars at the corners of their cells.
    halls = [(2, 2, 3, 2), (6, 0, 2, 2)]

    def hall(column: int, row: int) -> int:
        for index, (x, z, columns, rows) in enumerate(halls):
            if x <= column < x + columns and z <= row < z + rows:
                return index
        return -1 - (row * ROOM_COLUMNS + column)

    for row in range(ROOM_ROWS):
        for column in range(ROOM_COLUMNS):
            x, z = column * ROOM, row * ROOM
            for other, start, along in (
                ((column + 1, row), (x + ROOM, z), "z"),
                ((column, row + 1), (x, z + ROOM), "x"),
            ):
                inside = other[0] < ROOM_COLUMNS and other[1] < ROOM_ROWS
                if not inside or hall(*other) == hall(column, row):
                    continue
                # Every cell keeps a doorway to the next one in its row: no room is shut off.
                begin = 0.6 + 3.4 * chance()
                doorway = (begin, begin + 1.3, 2.2)
                closed = along == "x" and chance() < 0.4
                add_wall(model, "wall", start, ROOM, along, height, None if closed else doorway)
    for x, z, columns, rows in halls:
        for column in range(2 * columns + 1):
            for row in range(2 * rows + 1):
                on_rim = column in (0, 2 * columns) or row in (0, 2 * rows)
                if not on_rim:
                    place = ((x + column / 2) * ROOM, height / 2, (z + row / 2) * ROOM)
                    model.add("pillar", cylinder(32), _at(place, (0.22, height / 2, 0.22)))
    for row in range(ROOM_ROWS):
        for column in range(ROOM_COLUMNS):
            if chance() < 0.6:
                x = (column + 0.3 + 0.4 * chance()) * ROOM
                z = (row + 0.3 + 0.4 * chance()) * ROOM
                model.slab("crate", (x - 0.45, 0.0, z - 0.35), (x + 0.45, 0.8, z + 0.35))

    for level, strength in enumerate(LAMP_LEVELS):
        for color, rgb in enumerate(LAMP_COLORS):
            model.materials[f"lamp_{level}_{color}"] = {
                "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0},
                "emissiveFactor": list(rgb),
                "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": strength}},
            }
    # Rooms differ: the share of the lamps that a room gets is random too.
    shares = [0.1 + chance() ** 2 for _ in range(ROOM_COLUMNS * ROOM_ROWS)]
    ends = np.cumsum(shares) / sum(shares)
    for _ in range(LAMP_COUNT):
        cell = min(int(np.searchsorted(ends, chance())), len(shares) - 1)
        row, column = divmod(cell, ROOM_COLUMNS)
        level = min(int(len(LAMP_LEVELS) * chance() ** 1.7), len(LAMP_LEVELS) - 1)
        material = f"lamp_{level}_{int(len(LAMP_COLORS) * chance() ** 1.5)}"
        x = column * ROOM + 0.4 + (ROOM - 0.8) * chance()
        z = row * ROOM + 0.4 + (ROOM - 0.8) * chance()
        size = 0.02 * 6 ** chance()
        if chance() < 0.6:
            # The top of the panel touches the ceiling but for a gap that keeps the two apart.
            lamp = _at((x, height - 0.01, z), size, (180, 0, 0))
            model.add(material, primitives.quad(), lamp)
        else:
            lamp = _at((x, 0.9 + 1.9 * chance(), z), size / 2, (0, 90 * chance(), 0))
            model.add(material, primitives.box(), lamp)
    return model


def make_glossy() -> Model:
    """A room of rough and smooth metals, glass and plastic on a plinth each."""
    model = Model("glossy")
    model.slab("floor", (-3.1, -0.1, -2.1), (3.1, 0.0, 5.1))
    model.slab("wall", (-3.1, 3.0, -2.1), (3.1, 3.1, 5.1))
    model.slab("wall", (-3.1, 0.0, -2.1), (3.1, 3.0, -2.0))
    model.slab("wall", (-3.1, 0.0, 5.0), (3.1, 3.0, 5.1))
    model.slab("red_wall", (-3.1, 0.0, -2.0), (-3.0, 3.0, 5.0))
    model.slab("blue_wall", (3.0, 0.0, -2.0), (3.1, 3.0, 5.0))
    model.add("lamp_warm", primitives.quad(), _at((-1.2, 2.98, 0.8), (0.5, 1, 0.3), (180, 0, 0)))
    model.add("lamp_cold", primitives.quad(), _at((1.8, 2.98, 1.4), (0.15, 1, 0.15), (180, 0, 0)))

    ball = primitives.sphere(64, 32)
    for index in range(5):
        x = -2.0 + index
        model.slab("plinth", (x - 0.32, 0.0, -1.42), (x + 0.32, 0.5, -0.78))
        model.add(f"steel_{index}", ball, _at((x, 0.82, -1.1), 0.32))
    ring = torus(0.32, 80, 24)
    model.add("gold_rough", ring, _at((-1.9, 0.3, 0.3), 0.42, (20, 0, 70)))
    tangle = knot(0.15, 144, 20)
    model.add("copper", tangle, _at((-0.75, 0.36, 0.2), 0.55, (25, 0, 0)))
    model.add("plastic", tangle, _at((1.95, 0.36, 0.1), 0.55, (-20, 40, 0)))
    model.add("glass", lathe(refined(VASE, 81), 56, closed=True), _at((0.45, 0.005, 0.3), 0.5))
    model.add("glass", ball, _at((1.0, 0.3, 1.0), 0.298))
    model.add("plastic_smooth", ball, _at((-0.15, 0.22, 1.15), 0.218))
    model.add("gold_smooth", ball, _at((-1.3, 0.2, 1.2), 0.198))
    return model


MODELS = (make_ajar_door, make_many_lights, make_glossy)


def main() -> None:
    """Write all meshes into the folder that the command line names."""
    parser = argparse.ArgumentParser(description="Write the generated meshes of scenes/.")
    default = Path(__file__).resolve().parent.parent / "scenes" / "meshes"
    parser.add_argument("folder", nargs="?", type=Path, default=default)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for make in MODELS:
        make().write(folder)


if __name__ == "__main__":
    main()
