"""Feed readers with damaged files: scenes, images, saved renders load soundly or are refused.

    python tools/fuzz_readers.py gltf --seconds 600
    python tools/fuzz_readers.py obj --seed 81234 --count 1     # once more what seed 81234 found

The file of a seed depends on the seed and the corpus alone, so that a run goes on where another
ended (--seed).  The corpus is a small file with much in it, and, with --corpus FOLDER, all small
files of the format there.  A file fails if its reader raises anything but an InputError of one
line, takes more than 10 s or 6 GiB, ends the process, or returns a scene that is not sound.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import io
import json
import multiprocessing
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

from psf_cl import tables
from psf_cl.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from psf_cl.device import layout
from psf_cl.errors import InputError
from psf_cl.image import Image, write_exr
from psf_cl.learned import MOST_VISITS, read_learned, write_learned
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import TEXTURE_FIELDS, Scene

ROOT = Path(__file__).resolve().parent.parent

#: Seconds of computing, of waiting, and bytes that one file may take.
SECONDS = 10
PATIENCE = 100
MEMORY = 6 << 30

#: Files of a corpus up to this size are used, bytes: larger ones are slow to damage.
LARGEST = 1 << 17

KINDS = ("gltf", "obj", "ply", "toml", "exr", "hdr", "png", "jpg", "checkpoint", "cache")

#: Files that end with a digest of what is in them.
SIGNED = ("checkpoint", "cache")

#: What numbers are replaced by.
NUMBERS = (
    *(
        0,
        1,
        -1,
        2,
        3,
        7,
        255,
        256,
        65535,
        65536,
        2**31 - 1,
        2**31,
        2**32 - 1,
        2**32,
        2**63,
        -(2**63),
    ),
    *(2**64, 1e300, -1e300, 1e-300, 1e39, 0.5, -0.5, 1e-7, 10**30, 5120, 5126, 1e20),
)
WORDS = (
    *("nan", "inf", "-inf", "1e999", "0x10", "-", "", " ", "\\", "/", "..", "\0", "é", "\ud83d"),
    *('"', "'", "true", "1_000", "%2e%2e/a", "data:,", "file:///etc/passwd", "\n", "\r", "\t", "#"),
)

PNG = base64.b64encode(
    bytes.fromhex(
        "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de0000000c49444154789c63"
        "68686800000304018101"
    )
    + struct.pack(">I", 0x4BD2C6F6)
    + bytes.fromhex("0000000049454e44ae426082")
).decode()


def rich_gltf() -> bytes:
    """Return a .gltf that uses most of what the reader knows."""
    parts = {
        "positions": np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]], "<f4"),
        "normals": np.tile(np.array([0, 0, 1], "<f4"), (4, 1)),
        "uvs": np.array([[0, 0], [1, 0], [0, 1], [1, 1]], "<f4"),
        "indices": np.array([0, 1, 2, 2, 1, 3], "<u2"),
        "moves": np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0]], "<f4"),
        "joints": np.zeros((4, 4), "u1"),
        "weights": np.tile(np.array([1, 0, 0, 0], "<f4"), (4, 1)),
        "times": np.array([0, 1], "<f4"),
        "turns": np.array([[0, 0, 0, 1], [0, 1, 0, 0]], "<f4"),
        "binds": np.tile(np.eye(4, dtype="<f4").reshape(1, 16), (2, 1)),
        "tangents": np.tile(np.array([1, 0, 0, 1], "<f4"), (4, 1)),
    }
    codes = {"f": 5126, "H": 5123, "B": 5121}
    kinds = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
    views, accessors, index, binary = [], [], {}, b""
    for name, values in parts.items():
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes})
        index[name] = len(accessors)
        columns = 1 if values.ndim == 1 else values.shape[1]
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": codes[values.dtype.char],
                "count": len(values),
                "type": kinds[columns],
            }
        )
        binary += values.tobytes() + bytes(-values.nbytes % 4)
    accessors[index["positions"]]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": index["indices"], "componentType": 5123},
        "values": {"bufferView": index["normals"]},
    }
    picture = {
        "index": 0,
        "texCoord": 0,
        "extensions": {"KHR_texture_transform": {"scale": [2, 2]}},
    }
    materials = {
        "anisotropy": {"anisotropyStrength": 0.5, "anisotropyTexture": picture},
        "clearcoat": {"clearcoatFactor": 0.5, "clearcoatTexture": picture},
        "diffuse_transmission": {"diffuseTransmissionFactor": 0.5},
        "dispersion": {"dispersion": 1.0},
        "emissive_strength": {"emissiveStrength": 5.0},
        "ior": {"ior": 1.4},
        "iridescence": {"iridescenceFactor": 1.0, "iridescenceThicknessMaximum": 300},
        "sheen": {"sheenColorFactor": [1, 1, 1], "sheenRoughnessFactor": 0.5},
        "specular": {"specularFactor": 0.5, "specularColorFactor": [1, 0.5, 1]},
        "transmission": {"transmissionFactor": 0.5},
        "volume": {"thicknessFactor": 1.0, "attenuationDistance": 2.0},
    }
    glossy = {
        "diffuseTexture": {"index": 0},
        "specularGlossinessTexture": {"index": 0},
        "specularFactor": [0.5, 0.5, 0.5],
        "glossinessFactor": 0.5,
    }
    attributes = {
        "POSITION": index["positions"],
        "NORMAL": index["normals"],
        "TEXCOORD_0": index["uvs"],
        "TANGENT": index["tangents"],
        "COLOR_0": index["weights"],
        "JOINTS_0": index["joints"],
        "WEIGHTS_0": index["weights"],
    }
    primitive = {
        "attributes": attributes,
        "indices": index["indices"],
        "material": 0,
        "targets": [{"POSITION": index["normals"], "NORMAL": index["normals"]}],
    }
    instances = {"attributes": {"TRANSLATION": index["moves"]}}
    document = {
        "asset": {"version": "2.0", "minVersion": "2.0"},
        "extensionsUsed": ["KHR_lights_punctual"],
        "extensionsRequired": ["KHR_texture_transform"],
        "scene": 0,
        "scenes": [{"nodes": [0, 3, 4, 5]}, {"nodes": [1]}],
        "nodes": [
            {"mesh": 0, "children": [1, 2], "translation": [0, 1, 0], "scale": [1, -1, 1]},
            {"camera": 0, "rotation": [0, 0, 0, 1], "name": "view"},
            {"mesh": 1, "matrix": np.eye(4).ravel().tolist(), "name": "a"},
            {"mesh": 0, "skin": 0},
            {"mesh": 1, "extensions": {"EXT_mesh_gpu_instancing": instances}},
            {
                "camera": 1,
                "extensions": {
                    "KHR_lights_punctual": {"light": 0},
                    "KHR_node_visibility": {"visible": True},
                },
            },
        ],
        "meshes": [
            {"primitives": [primitive, {**primitive, "mode": 5}], "weights": [0.5]},
            {"primitives": [{"attributes": {"POSITION": 0}, "material": 1, "mode": 6}]},
        ],
        "skins": [{"joints": [0, 1], "inverseBindMatrices": index["binds"], "skeleton": 0}],
        "animations": [
            {
                "channels": [
                    {"sampler": 0, "target": {"node": 0, "path": "translation"}},
                    {"sampler": 1, "target": {"node": 1, "path": "rotation"}},
                ],
                "samplers": [
                    {"input": index["times"], "output": index["moves"], "interpolation": "STEP"},
                    {"input": index["times"], "output": index["turns"]},
                ],
            }
        ],
        "cameras": [
            {"type": "perspective", "perspective": {"yfov": 0.8, "aspectRatio": 1.5, "znear": 1}},
            {"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "zfar": 9, "znear": 0}},
        ],
        "materials": [
            {
                "name": "m",
                "pbrMetallicRoughness": {
                    "baseColorFactor": [1, 0.5, 0.2, 1],
                    "baseColorTexture": picture,
                    "metallicFactor": 0.5,
                    "metallicRoughnessTexture": picture,
                },
                "normalTexture": {"index": 0, "scale": 2},
                "emissiveFactor": [1, 1, 1],
                "emissiveTexture": picture,
                "alphaMode": "MASK",
                "alphaCutoff": 0.3,
                "doubleSided": True,
                "extensions": {f"KHR_materials_{name}": value for name, value in materials.items()},
            },
            {"extensions": {"KHR_materials_pbrSpecularGlossiness": glossy}, "alphaMode": "BLEND"},
        ],
        "textures": [
            {"source": 0, "sampler": 0, "extensions": {"EXT_texture_webp": {"source": 0}}}
        ],
        "samplers": [{"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}],
        "images": [{"uri": f"data:image/png;base64,{PNG}"}],
        "extensions": {
            "KHR_lights_punctual": {
                "lights": [{"type": "spot", "intensity": 5, "range": 9, "spot": {}}]
            }
        },
        "buffers": [
            {
                "byteLength": len(binary),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(binary).decode(),
            }
        ],
        "bufferViews": views,
        "accessors": accessors,
    }
    return json.dumps(document).encode()


RICH_OBJ = b"""# top
mtllib a.mtl
v 0 0 0 1 0 0
v 1 0 0 0 1 0
v 0 1 0 0 0 1
v 1 1 0
vt 0 0
vt 1 0 0
vt 0 1
vn 0 0 1
o thing
g a b
s 1
usemtl red paint
f 1/1/1 2/2/1 3/3/1
f 1//1 2//1 3//1
f -1 -2 \\
-3 -4
usemtl other
f 1/1 2/2 3/3
l 1 2 3
p 1
"""

RICH_MTL = b"""newmtl red paint
Kd 1 0.5 0.1
Ks 0.5 0.5 0.5
Ns 50
Ke 1 2 3
d 0.5
Ni 1.4
illum 7
Tf 1 1 1
map_Kd -s 1 2 3 -o 0.1 -clamp on -bm 1 a.png
map_d a.png
newmtl other
Pr 0.3
Pm 1
Tr 0.2
map_Ke a.png
bump -bm 2 a.png
norm a.png
"""

RICH_PLY = b"""ply
format ascii 1.0
comment TextureFile a.png
element vertex 4
property float x
property double y
property float32 z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
property float s
property float t
element face 2
property list uchar int vertex_indices
property uchar red
element edge 1
property int vertex1
property int vertex2
end_header
0 0 0 0 0 1 255 0 0 0 0
1 0 0 0 0 1 255 0 0 1 0
0 1 0 0 0 1 255 0 0 0 1
1 1 0 0 0 1 255 0 0 1 1
3 0 1 2 7
4 0 1 3 2 7
0 1
"""


RICH_TOML = b"""[film]
width = 64
height = 48

[[cameras]]
name = "view"
position = [0, 1, 5]
target = [0, 0, 0]
up = [0, 1, 0]
fov_y = 40
lens_radius = 0.01
focus_distance = 5

[[cameras]]
name = "plan"
position = [0, 5, 0.1]
target = [0, 0, 0]
height = 4

[environment]
radiance = [0.1, 0.1, 0.2]
rotation = [0, 90, 0]

[render]
preset = "pt"
max_depth = 3

[materials.red]
base_color = [1, 0.2, 0.1]
base_color_texture = { file = "a.png", scale = [2, 2], rotation = 30, wrap = "mirror" }
metallic = 0.5
roughness = 0.2
clearcoat = 1
sheen_color = [1, 1, 1]
emission = [1, 0, 0]

[materials.glass]
transmission = 1
ior = 1.4
attenuation_color = [0.5, 1, 1]
attenuation_distance = 2

[[shapes]]
name = "a"
primitive = "sphere"
material = "red"
transform = [{ scale = [1, 2, 1] }, { rotate = [10, 20, 30] }, { translate = [1, 0, 0] }]

[[shapes]]
name = "b"
primitive = "quad"
material = "glass"
emission = [3, 3, 3]
two_sided = true
transform = [{ matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]] }]

[[lights]]
type = "spot"
name = "lamp"
position = [0, 3, 0]
direction = [0, -1, 0]
intensity = 10
color = [1, 1, 0.5]
inner_angle = 10
outer_angle = 20
range = 9

[[animation]]
target = "a"
property = "rotation"
times = [0, 0.5, 1]
values = [[0, 0, 0], [0, 90, 0], [0, 180, 0]]
interpolation = "linear"
pivot = [0, 0, 1]

[[animation]]
target = "view"
property = "position"
times = [0, 1]
values = [[0, 1, 5], [1, 1, 5]]

[[animation]]
target = "red"
property = "emission"
times = [0, 1]
values = [[1, 0, 0], [0, 1, 0]]

[[animation]]
target = "lamp"
property = "intensity"
times = [0, 1]
values = [1, 2]
"""


def binary_ply(mixed: bool) -> bytes:
    """Return a binary file of a quad, and of a triangle if it is ``mixed``."""
    head = RICH_PLY.split(b"property float nx")[0].replace(b"ascii", b"binary_little_endian")
    head += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    corners = b"".join(struct.pack("<fdf", x, y, 0) for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)))
    more = struct.pack("<B3i", 3, 0, 1, 2) if mixed else b""
    head = head.replace(b"face 1", b"face 2") if mixed else head
    return head + corners + struct.pack("<B4i", 4, 0, 1, 3, 2) + more


def pictures(kind: str) -> list[bytes]:
    """Return small images of the ways in which the format keeps pixels."""
    chance = np.random.default_rng(1)
    noise = chance.integers(0, 256, (7, 9, 4), np.uint8)
    light = chance.random((7, 9, 3), np.float32)
    if kind == "exr":
        more = {"rgb": light, "depth": light[..., :1]}
        return [_exr({"rgb": light}, False), _exr(more, True)]
    if kind == "hdr":
        head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\n\n"
        rows = b"".join(
            b"\2\2\0\x09" + b"\x89\x40" * 2 + b"\x09" + bytes(9) + b"\x89\x81" for _ in "ab"
        )
        return [head + b"-Y 7 +X 9\n" + noise.tobytes(), head + b"-Y 2 +X 9\n" + rows]
    modes = {"png": ("RGBA", "RGB", "L", "LA", "P", "1", "I;16"), "jpg": ("RGB", "L", "CMYK")}[kind]
    files = []
    for mode in modes:
        for options in ({}, {"progressive": True}) if kind == "jpg" else ({}, {"optimize": True}):
            picture = PIL.Image.fromarray(noise)
            picture = picture.convert("L").convert(mode) if "16" in mode else picture.convert(mode)
            stream = io.BytesIO()
            picture.save(stream, {"jpg": "jpeg"}.get(kind, kind), **options)
            files.append(stream.getvalue())
    return files


def _exr(aovs: dict[str, np.ndarray], half: bool) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        write_exr(path, Image(aovs, {"spp": 4}), half)
        return path.read_bytes()


IDENTITY = {"scene": "a", "settings": {"max_depth": 3}}
BUFFERS = {"film": (np.dtype("<f4"), 50), "counters": (np.dtype("<u4"), 3)}


def a_checkpoint() -> bytes:
    """Return a small checkpoint."""
    arrays = {name: np.arange(count, dtype=dtype) for name, (dtype, count) in BUFFERS.items()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        write_checkpoint(path, Checkpoint(IDENTITY, 7, (4, 8), 1.5, "a device", arrays))
        return path.read_bytes()


TABLES = {
    "guide_keys": (np.dtype("<u4"), 8),
    "guide_sums": (layout.GUIDE_SUM.dtype, 8),
    "cache_sums": (layout.CACHE_SUM.dtype, 8),
    "cache_cells": (layout.CACHE_CELL.dtype, 8),
}


def a_cache() -> bytes:
    """Return a small file of what was learned."""
    chance = np.random.default_rng(1)
    tables = {
        name: chance.integers(0, 100, count * dtype.itemsize // 4, np.uint32).view(dtype)
        for name, (dtype, count) in TABLES.items()
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        write_learned(path, IDENTITY, tables)
        return path.read_bytes()


def signed(data: bytes) -> bytes:
    """Return a file of arrays, damaged, with the digest that it should have."""
    first = data.find(b"\n") + 1
    body = data[first:-32]
    return data[:first] + body + hashlib.sha256(body).digest()


def corpus(kind: str, folders: list[Path]) -> list[bytes]:
    """Return the files to damage; an OBJ file carries its MTL after a NUL."""
    own: list[bytes] = {
        "exr": lambda: pictures(kind),
        "hdr": lambda: pictures(kind),
        "png": lambda: pictures(kind),
        "jpg": lambda: pictures(kind),
        "checkpoint": lambda: [a_checkpoint()],
        "cache": lambda: [a_cache()],
        "gltf": lambda: [rich_gltf()],
        "obj": lambda: [RICH_OBJ + b"\0" + RICH_MTL],
        "ply": lambda: [RICH_PLY, binary_ply(False), binary_ply(True)],
        "toml": lambda: [
            RICH_TOML,
            *(path.read_bytes() for path in sorted((ROOT / "scenes").glob("*.toml"))),
        ],
    }[kind]()
    suffixes = {"gltf": (".gltf", ".glb")}.get(kind, (f".{kind}",))
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.suffix in suffixes and path.is_file() and path.stat().st_size <= LARGEST:
                more = path.with_suffix(".mtl")
                own.append(path.read_bytes() + (b"\0" + _text(more) if kind == "obj" else b""))
    return own


def _text(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""


def damaged(kind: str, data: bytes, chance: random.Random) -> bytes:
    """Return ``data`` with one to a few changes."""
    document: Any = None
    if kind == "gltf" and data[:4] != b"glTF":
        try:
            document = json.loads(data)
        except (ValueError, RecursionError):
            document = None
    if isinstance(document, dict) and chance.random() < 0.85:
        for _ in range(chance.choice([1, 1, 1, 2, 3, 6])):
            change_json(document, chance)
        return json.dumps(document).encode("utf-8", "surrogatepass")
    changes = (change_words, change_words, change_lines, change_bytes)
    for _ in range(chance.choice([1, 1, 2, 3, 8])):
        data = chance.choice(changes)(data, chance)
    # Whoever makes a file on purpose knows how to sign it.
    return signed(data) if kind in SIGNED and chance.random() < 0.7 else data


def change_json(document: Any, chance: random.Random) -> None:
    """Change something at a random place of a document."""
    place = document
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        if not keys:
            return
        key = chance.choice(keys)
        value = place[key]
        if not (isinstance(value, (dict, list)) and value and chance.random() < 0.85):
            break
        place = value
    what = chance.randrange(8)
    if what == 0:
        del place[key]
    elif what == 1:
        place[key] = chance.choice([None, True, [], {}, [[]], "", [1], {"a": 1}, *WORDS])
    elif what == 2 and isinstance(place, list):
        place.insert(key, value)
    elif what == 3 and isinstance(place, dict):
        other = chance.choice(list(place))
        place[key], place[other] = place[other], value
    elif what == 4 and isinstance(value, str) and value.startswith("data:"):
        at = chance.randrange(len(value))
        place[key] = value[:at] + chance.choice("A/+=z") + value[at + 1 :]
    elif isinstance(value, str) and chance.random() < 0.5:
        place[key] = value[: chance.randrange(len(value) + 1)] + chance.choice(WORDS)
    else:
        place[key] = chance.choice([*NUMBERS, *range(12)])


def change_words(data: bytes, chance: random.Random) -> bytes:
    """Replace, copy or remove a word or number."""
    words = list(re.finditer(rb"[\w.+-]+", data))
    if not words:
        return data
    word, other = chance.choice(words), chance.choice(words)
    text = chance.choice([str(chance.choice(NUMBERS)), chance.choice(WORDS)])
    new = chance.choice([text.encode("utf-8", "surrogatepass"), other[0], b""])
    return data[: word.start()] + new + data[word.end() :]


def change_lines(data: bytes, chance: random.Random) -> bytes:
    """Repeat, remove or move lines."""
    lines = data.split(b"\n")
    start = chance.randrange(len(lines))
    some = lines[start : start + chance.choice([1, 1, 2, 8])]
    what = chance.randrange(3)
    if what:
        del lines[start : start + len(some)]
    if what != 1:
        at = chance.randrange(len(lines) + 1)
        lines[at:at] = some * chance.choice([1, 1, 2, 50])
    return b"\n".join(lines)


def change_bytes(data: bytes, chance: random.Random) -> bytes:
    """Change, remove, insert or cut off bytes."""
    if not data:
        return data
    at, size = chance.randrange(len(data)), chance.choice([1, 1, 2, 4, 64])
    what = chance.randrange(4)
    if what == 0:
        return data[:at]
    if what == 1:
        return data[:at] + data[at + size :]
    fresh = chance.choice([chance.randbytes(size), b"\xff" * size, bytes(size)])
    return data[:at] + fresh + data[at + size * (what == 2) :]


def check_scene(scene: Scene) -> None:
    """Assert that nothing of ``scene`` leads anything astray that reads it."""
    for shape in scene.shapes:
        mesh = shape.mesh
        count = len(mesh.positions)
        assert 0 <= shape.material < len(scene.materials), "material"
        assert shape.transform.shape == (4, 4) and np.isfinite(shape.transform).all(), "transform"
        assert mesh.triangles.dtype == np.uint32 and mesh.triangles.max(initial=0) < count, "index"
        widths = {"positions": 3, "normals": 3, "uvs": 2, "uvs1": 2, "colors": 4, "tangents": 4}
        for name, width in widths.items():
            values = getattr(mesh, name)
            assert values is None or values.shape == (count, width), name
            assert values is None or values.dtype == np.float32, name
    for material in scene.materials:
        for name in TEXTURE_FIELDS:
            assert -1 <= getattr(material, name) < len(scene.textures), name
    for texture in scene.textures:
        assert texture.pixels.dtype == np.uint8 and texture.pixels.shape[2] == 4, "pixels"
        assert np.isfinite(texture.transform).all(), "texture transform"
    assert np.isfinite(scene.cameras[scene.camera].transform).all(), "camera"
    if sum(len(shape.mesh.triangles) for shape in scene.shapes) < 1 << 16:
        geometry = tables.flatten(scene)
        tables.light_table(scene, geometry, "power")
        tables.texture_tables(scene.textures, geometry.count)
        tables.material_table(scene.materials)


def check_tables(tables: dict[str, np.ndarray]) -> None:
    """Assert that what was learned is finite and has room for more."""
    for name in ("guide_sums", "cache_sums"):
        assert tables[name]["count"].max() <= MOST_VISITS, "visits"
        assert (tables[name]["high"] < 1 << 31).all(), "sums"
    assert np.isfinite(tables["cache_cells"].view(np.float32)).all(), "cells"


#: What makes a scene that reads an image.
TEXTURED = '[materials.m]\nbase_color_texture = "{name}"\n'
LIT = '[environment]\nimage = "{name}"\n[materials.m]\n'
USED_BY = {"png": TEXTURED, "jpg": TEXTURED, "exr": LIT, "hdr": LIT}
QUAD = '[[shapes]]\nprimitive = "quad"\nmaterial = "m"\n'


class TimeIsUp(BaseException):
    """Reading takes too long; no reader catches it."""


def try_file(kind: str, data: bytes, folder: Path) -> None:
    """Read ``data``; raise what should not have happened."""
    data, _, library = data.partition(b"\0") if kind == "obj" else (data, b"", b"")
    path = folder / f"a.{kind}"
    path.write_bytes(data)
    if kind in USED_BY:
        path = folder / "a.toml"
        path.write_text(USED_BY[kind].format(name=f"a.{kind}") + QUAD)
    if kind == "obj":
        (folder / "a.mtl").write_bytes(library)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.alarm(PATIENCE)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            if kind == "checkpoint":
                read_checkpoint(path, IDENTITY, BUFFERS)
            elif kind == "cache":
                check_tables(read_learned(path, IDENTITY, TABLES)[0])
            else:
                check_scene(load_scene(path, size=(16, 16)))
            if kind in ("gltf", "toml"):
                check_scene(load_scene(path, size=(16, 16), time=0.4))
                load_scene(path, size=(16, 16), moving=True)
    except InputError as error:
        assert str(error) and "\n" not in str(error), "not one line"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)


def _time_is_up(number: int, frame: Any) -> None:
    raise TimeIsUp


def file_of(kind: str, files: list[bytes], seed: int) -> bytes:
    """Return the damaged file of a seed."""
    chance = random.Random(seed)
    return damaged(kind, chance.choice(files), chance)


def work(kind: str, files: list[bytes], folder: Path, now: Any, end: Callable[[int], bool]) -> None:
    """Try seeds from ``now`` on, in a process of its own, which the first fault ends."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, _time_is_up)
    while not end(now.value):
        try_file(kind, file_of(kind, files, now.value), folder)
        now.value += 1


def main() -> int:
    """Run the command line; return 1 if something was found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--seed", type=int, default=0, help="the first one")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--count", type=int, default=1 << 60, help="at most so many seeds")
    parser.add_argument("--corpus", type=Path, action="append", default=[], help="a folder")
    parser.add_argument("--keep", type=Path, help="folder for the files that fail")
    options = parser.parse_args()
    files = corpus(options.kind, options.corpus)
    last, stop = options.seed + options.count, time.monotonic() + options.seconds

    def end(seed: int) -> bool:
        return seed >= last or time.monotonic() > stop

    if options.keep is not None:
        options.keep.mkdir(parents=True, exist_ok=True)
    now = multiprocessing.get_context("fork").Value("q", options.seed)
    faults = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "a.png").write_bytes(base64.b64decode(PNG))
        for extra in (ROOT / "scenes").iterdir() if options.kind == "toml" else ():
            if extra.suffix != ".toml":
                (folder / extra.name).symlink_to(extra)
        while not end(now.value):
            arguments = (options.kind, files, folder, now, end)
            child = multiprocessing.get_context("fork").Process(target=work, args=arguments)
            child.start()
            child.join()
            if child.exitcode:
                faults += 1
                print(f"seed {now.value} fails: exit code {child.exitcode}", flush=True)
                if options.keep is not None:
                    data = file_of(options.kind, files, now.value)
                    (options.keep / f"{now.value}.{options.kind}").write_bytes(data)
                now.value += 1
    print(
        f"{options.kind}: {now.value - options.seed} files, {faults} faults; next seed {now.value}"
    )
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
