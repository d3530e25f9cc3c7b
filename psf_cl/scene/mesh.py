"""OBJ, PLY and STL files: trimesh reads them, this module checks what it returns.

The format readers of trimesh are called directly: its mesh class would merge and reorder.  It also
drops most of what an MTL file says, so ``mtl`` reads it; ``obj_text`` puts OBJ text into the plain
form that trimesh's reader expects first.
"""

from __future__ import annotations

import io
import os
import re
import struct
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from psf_cl.errors import InputError
from psf_cl.files import decoded_text, read_file
from psf_cl.scene.model import Material, Mesh, Scene, Shape
from psf_cl.scene.mtl import MaterialLibrary, Picture, listed
from psf_cl.scene.obj_text import plain_obj, with_concave_cut
from psf_cl.scene.polygons_ply import load_polygons, plain_ply
from psf_cl.scene.texture import decoded_srgb

SUFFIXES = (".obj", ".ply", ".stl")

# What trimesh 5.2 lets out for malformed files: text that is no number (ValueError, and
# DeprecationWarning made an error below), missing columns and indices out of range (IndexError),
# unknown property types and names (KeyError, UnboundLocalError), absent data (TypeError,
# AttributeError), counts that no memory holds (OverflowError, MemoryError), and headers that are
# no Python literals (SyntaxError, RecursionError).  Ragged lists come out as they are, and NumPy
# refuses them when they become arrays (TypeError, ValueError).
_READER_ERRORS = (
    ValueError,
    DeprecationWarning,
    IndexError,
    KeyError,
    UnboundLocalError,
    TypeError,
    AttributeError,
    OverflowError,
    MemoryError,
    SyntaxError,
    RecursionError,
    struct.error,
)

Found = TypeVar("Found")


def load_mesh_scene(path: Path) -> Scene:
    """Return the shapes of an OBJ, PLY or STL file, one a material, with OBJ's materials.

    Normals and texture coordinates are kept where the file has them; vertices that are not finite
    are kept too.  Polygons become triangles, fans in PLY
    files even where they are concave.  Missing material files and textures are
    noted.

    Raises:
        InputError: missing or malformed file, or an index out of range.
    """
    data = read_file(path)
    if path.suffix.lower() == ".obj":
        return _load_obj(path, data)
    return _load_ply(path, data) if path.suffix.lower() == ".ply" else _load_stl(path, data)


def _load_ply(path: Path, data: bytes) -> Scene:
    from trimesh.exchange.ply import load_ply

    data = plain_ply(data)

    def read_ply() -> dict[str, Any]:
        try:
            return load_ply(io.BytesIO(data), skip_materials=True)
        except _READER_ERRORS:
            polygons = load_polygons(data)
            if polygons is None:
                raise
            return polygons

    read = _guarded(path, "PLY", read_ply)
    library = MaterialLibrary(path)
    material = Material()
    # MeshLab's way to name a texture.
    named = re.search(rb"^comment TextureFile (.+?)\s*$", data[:4096], re.MULTILINE)
    if named is not None:
        name = named[1].decode("utf-8", "replace")
        material = Material(base_color_texture=library.texture(Picture(name, {})))
    shapes = _shapes(path, [read])
    notes = [f"left out: {reason}" for reason in library.lost]
    if not shapes and np.ndim(read.get("vertices")) == 2:
        notes.append("points are left out")
    return Scene(
        path=str(path),
        shapes=shapes,
        materials=(material,),
        textures=tuple(library.textures),
        notes=tuple(notes),
        files=(str(path), *library.files),
    )


def _load_stl(path: Path, data: bytes) -> Scene:
    from trimesh.exchange.stl import load_stl_ascii, load_stl_binary

    # Some binary files begin with "solid" too, so the length decides.
    if len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        read = _guarded(path, "STL", lambda: load_stl_binary(io.BytesIO(data)))
    elif data.lstrip()[:5].lower() == b"solid":
        read = _guarded(path, "STL", lambda: load_stl_ascii(io.StringIO(decoded_text(data))))
    else:
        raise InputError(f"{path}: neither ASCII STL nor binary STL of the length in its header")
    # A file with several solids has a table of meshes, any other is the mesh itself.
    parts = read.get("geometry", {"": read}).values()
    return Scene(path=str(path), shapes=_shapes(path, parts), files=(str(path),))


def _shapes(path: Path, parts: Iterable[dict[str, Any]]) -> tuple[Shape, ...]:
    meshes = [_checked_mesh(path, path.stem, part) for part in parts]
    return tuple(Shape(mesh.name, mesh, np.eye(4), 0) for mesh in meshes if mesh is not None)


def _guarded(path: Path, name: str, read: Callable[[], Found]) -> Found:
    """Return what ``read`` returns; what it raises becomes an InputError."""
    try:
        with warnings.catch_warnings():
            # At text that is no number NumPy only warns, and drops the rest of the file.
            warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
            warnings.filterwarnings("ignore", category=RuntimeWarning)
            return read()
    except _READER_ERRORS as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: not a sound {name} file ({reason})") from None


def _checked_mesh(path: Path, name: str, part: dict[str, Any]) -> Mesh | None:
    """Return trimesh's raw arrays as a mesh with every index checked; None if it has no faces."""
    return _guarded(path, path.suffix[1:].upper(), lambda: _mesh_of(path, name, part))


def _mesh_of(path: Path, name: str, part: dict[str, Any]) -> Mesh | None:
    faces = part.get("faces")
    if faces is None or np.size(faces) == 0:
        return None
    faces = np.asarray(faces)
    positions = _float32(part["vertices"])
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise InputError(f"{path}: expected vertices of 3 coordinates")
    if faces.ndim != 2 or faces.dtype.kind not in "iu" or faces.shape[1] < 3:
        raise InputError(f"{path}: expected faces of at least 3 integer vertex indices")
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(positions):
        bad = low if low < 0 else high
        raise InputError(f"{path}: vertex index {bad} is out of range; there are {len(positions)}")
    fan = [faces[:, [0, corner, corner + 1]] for corner in range(1, faces.shape[1] - 1)]
    visual = part.get("visual")
    uvs = getattr(visual, "uv", part.get("uvs"))
    uvs = None if uvs is None or np.shape(uvs) != (len(positions), 2) else _float32(uvs)
    if uvs is not None:
        # v grows upwards in these formats.
        uvs = np.stack([uvs[:, 0], 1 - uvs[:, 1]], axis=-1)
        uvs = np.where(np.isfinite(uvs), uvs, np.float32(0.0))
    return Mesh(
        name=name,
        positions=positions,
        triangles=np.stack(fan, axis=1).reshape(-1, 3).astype(np.uint32),
        normals=_unit_normals(part.get("vertex_normals"), len(positions)),
        uvs=uvs,
        colors=_linear_colors(part.get("vertex_colors"), len(positions)),
    )


def _linear_colors(colors: Any, count: int) -> np.ndarray | None:
    """Return linear RGBA in [0, 1] of sRGB colours, bytes or floats; None unless all have one."""
    colors = None if colors is None else np.asarray(colors)
    if colors is None or colors.ndim != 2 or len(colors) != count or colors.shape[1] not in (3, 4):
        return None
    scale = 255.0 if colors.dtype.kind in "iu" else 1.0
    values = np.ones((count, 4), np.float32)
    values[:, : colors.shape[1]] = np.nan_to_num(colors / scale, nan=1.0).clip(0.0, 1.0)
    values[:, :3] = decoded_srgb(values[:, :3])
    return values


def _unit_normals(normals: Any, count: int) -> np.ndarray | None:
    """Return unit normals; None unless each vertex has one of finite, nonzero length."""
    if normals is None or np.shape(normals) != (count, 3):
        return None
    normals = np.asarray(normals, np.float64)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        return None
    return (normals / length).astype(np.float32)


def _float32(values: Any) -> np.ndarray:
    # A coordinate beyond float32 becomes infinite, and its triangles are dropped with NaN's.
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, dtype=np.float32)


class _MaterialNames:
    """Stand in for trimesh's file resolver: the only file it finds lists the material names.

    With it trimesh tells which faces use which material even where the MTL file is missing.
    """

    def __init__(self, text: str) -> None:
        names = dict.fromkeys(re.findall(r"^usemtl (.+)$", text, re.MULTILINE))
        self._mtl = "".join(f"newmtl {name}\n" for name in names).encode()

    def __getitem__(self, name: str) -> bytes:
        return self._mtl

    get = __getitem__


def _load_obj(path: Path, data: bytes) -> Scene:
    from trimesh.exchange.obj import load_obj

    text = with_concave_cut(plain_obj(path, decoded_text(data)))
    libraries = re.findall(r"^mtllib (.+)$", text, re.MULTILINE)
    text = "mtllib names\n" + text
    resolver: Any = _MaterialNames(text)
    read = _guarded(path, "OBJ", lambda: load_obj(io.StringIO(text), resolver=resolver))

    library = _read_libraries(path, libraries)
    known, notes = library.materials, library.notes
    left_out = len(re.findall(r"^[lp] ", text, re.MULTILINE))
    if left_out:
        notes.append(f"{path}: points and lines are left out ({left_out} times)")
    materials: dict[str, Material] = {}
    shapes = []
    unknown: list[str] = []
    for part in read.get("geometry", {}).values():
        used = getattr(part.get("visual"), "material", None)
        name = str(used.name) if used is not None and used.name else Material().name
        mesh = _checked_mesh(path, name, part)
        if mesh is None:
            continue
        if name not in known and name != Material().name:
            unknown.append(name)
        materials.setdefault(name, known.get(name, Material(name=name)))
        shapes.append(Shape(name, mesh, np.eye(4), list(materials).index(name)))
    if unknown:
        notes.append(f"{path}: undefined materials stay grey: {listed(unknown)}")
    return Scene(
        path=str(path),
        shapes=tuple(shapes),
        materials=tuple(materials.values()) or (Material(),),
        textures=tuple(library.textures),
        notes=tuple(notes),
        files=(str(path), *library.files),
    )


def _read_libraries(path: Path, libraries: list[str]) -> MaterialLibrary:
    """Return the materials of all ``mtllib`` lines."""
    library = MaterialLibrary(path)
    names: list[str] = []
    for line in libraries:
        # A line names one file with spaces in its name, or several files.
        whole = os.path.isfile(path.parent / line)
        names += [line] if whole else re.split(r"(?<!\\) ", line)
    # Some programs put a backslash before each space of a name.
    library.read(name.replace("\\ ", " ") for name in dict.fromkeys(names))
    if library.lost:
        library.notes.append(f"{path}: textures are left out: {listed(library.lost)}")
    return library
