"""Decode primitives of glTF that are compressed with Draco, where the package DracoPy is there.

Source: Khronos Group, KHR_draco_mesh_compression.
"""

from __future__ import annotations

import importlib.util

import numpy as np

from psf_cl.scene.gltf_file import GltfFile, Item

EXTENSION = "KHR_draco_mesh_compression"


def is_available() -> bool:
    """Return whether the package that decodes is installed: the extra ``draco``."""
    return importlib.util.find_spec("DracoPy") is not None


def decode_primitive(gltf: GltfFile, primitive: Item) -> bool:
    """Give the accessors of ``primitive`` what its compressed data says.

    Returns:
        Whether it was compressed: its indices are then a list of triangles.

    Raises:
        InputError: the data is broken, or is not what the accessors say.
    """
    compressed = primitive.extension(EXTENSION)
    if compressed is None or not is_available():
        return False
    import DracoPy

    view_index = gltf.index(compressed, "bufferView", "bufferViews")
    if view_index is None:
        compressed.fail("bufferView", "an index of bufferViews")
    try:
        mesh = DracoPy.decode(bytes(gltf.view_data(view_index)))
        stored = {int(part["unique_id"]): np.asarray(part["data"]) for part in mesh.attributes}
        faces = np.asarray(mesh.faces, np.uint32).reshape(-1, 1)
    except (
        DracoPy.FileTypeException,
        AttributeError,  # points without faces
        ValueError,
        TypeError,
        MemoryError,
        RuntimeError,
    ) as error:
        reason = " ".join(str(error).split())[:120]
        compressed.fail("bufferView", "sound Draco data of a mesh", reason)
    attributes, ids = primitive.item("attributes"), compressed.item("attributes")
    for key in ids.values:
        name = ids.integer(key)
        if key not in attributes or name not in stored:
            ids.fail(key, "an attribute of the primitive and of its Draco data")
        index = gltf.index(attributes, key, "accessors")
        gltf.put(attributes, key, index, stored[name])
    if "indices" in primitive:
        index = gltf.index(primitive, "indices", "accessors")
        gltf.put(primitive, "indices", index, faces)
    return True
