"""PLY files that trimesh does not read: faces of several sizes in binary ones, ends of lines.

Source: Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_HEADER = re.compile(
    rb"ply\r?\nformat binary_(little|big)_endian 1.0.*?\nend_header\r?\n", re.DOTALL
)


def plain_ply(data: bytes) -> bytes:
    """Return a PLY file whose header's lines end in LF, as only that is read.

    Programs from the Mac end them, and in ASCII files all lines, with CR alone.
    """
    if re.match(rb"ply\r[^\n]", data) is None:
        return data
    header, end, body = data.partition(b"end_header\r")
    if b"format ascii" in header:
        body = body.replace(b"\r", b"\n")
    return (header + end).replace(b"\r", b"\n") + body


def load_polygons(data: bytes) -> dict[str, Any] | None:
    """Return vertices and triangles under trimesh's names, or None if ``data`` is no such file.

    Vertices must come first and have numbers alone; of faces the first list counts, as fans.

    Raises:
        ValueError: the file is shorter than its header says, or a corner's number is no integer.
    """
    head = _HEADER.match(data)
    if head is None:
        return None
    order = "<" if head[1] == b"little" else ">"
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in head[0].decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["element"] and len(words) == 3:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(words[1:])
    if [name for name, _, _ in elements[:2]] != ["vertex", "face"]:
        return None
    (_, count, properties), (_, face_count, face_properties) = elements[:2]
    if any(len(words) != 2 or words[0] not in _TYPES for words in properties):
        return None
    record = np.dtype([(words[1], order + _TYPES[words[0]]) for words in properties])
    vertices = np.frombuffer(data, record, count, head.end())
    triangles = _fans(data, head.end() + vertices.nbytes, face_count, face_properties, order)
    read: dict[str, Any] = {
        "vertices": _columns(vertices, ("x", "y", "z")),
        "faces": triangles,
        "vertex_normals": _columns(vertices, ("nx", "ny", "nz")),
        "vertex_colors": _columns(vertices, ("red", "green", "blue")),
    }
    for names in (("s", "t"), ("u", "v"), ("texture_u", "texture_v")):
        uvs = _columns(vertices, names)
        if uvs is not None:
            read["uvs"] = uvs
    return read


def _columns(vertices: np.ndarray, names: tuple[str, ...]) -> np.ndarray | None:
    if not set(names) <= set(vertices.dtype.names or ()):
        return None
    return np.stack([vertices[name] for name in names], axis=-1)


def _fans(data: bytes, at: int, count: int, properties: list[list[str]], order: str) -> np.ndarray:
    """Return ``(n, 3)`` corners of the triangles of ``count`` faces that begin at byte ``at``."""
    kinds = []
    for words in properties:
        if words[0] == "list" and len(words) == 4:
            kinds.append((np.dtype(order + _TYPES[words[1]]), np.dtype(order + _TYPES[words[2]])))
        else:
            kinds.append((None, np.dtype(order + _TYPES[words[0]])))
    if not any(length is not None for length, _ in kinds):
        raise ValueError("faces without a list of corners")
    corners, sizes = [], []
    for _ in range(count):
        found = None
        for length, kind in kinds:
            size = 1
            if length is not None:
                if length.kind == "f":
                    raise ValueError("a number of corners is no integer")
                size = int(np.frombuffer(data, length, 1, at)[0])
                at += length.itemsize
            if size < 0 or at + size * kind.itemsize > len(data):
                raise ValueError("a face ends behind the file")
            if length is not None and found is None:
                if kind.kind == "f":
                    raise ValueError("corners are no integers")
                found = np.frombuffer(data, kind, size, at)
            at += size * kind.itemsize
        corners.append(found)
        sizes.append(len(found))
    every = np.concatenate(corners).astype(np.int64) if corners else np.zeros(0, np.int64)
    start = np.cumsum([0, *sizes])[:-1]
    fans = np.maximum(np.array(sizes, np.int64) - 2, 0)
    of = np.repeat(np.arange(len(sizes)), fans)
    step = np.arange(len(of)) - np.repeat(np.cumsum(fans) - fans, fans)
    return np.stack(
        [every[start[of]], every[start[of] + step + 1], every[start[of] + step + 2]], axis=-1
    )
