"""A fingerprint of all that a picture is of, whatever files it came from."""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from psf_cl.scene.model import Scene


def scene_digest(scene: Scene) -> str:
    """Return the SHA-256 of what the picture is of: also of meshes and textures in other files.

    Settings that the scene file brings are no part of it.
    """
    digest = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
        elif is_dataclass(value):
            for item in fields(value):
                if item.name not in ("path", "notes", "files", "render"):
                    add(getattr(value, item.name))
        elif isinstance(value, (tuple, list)):
            digest.update(f"{len(value)}:".encode())
            for item in value:
                add(item)
        else:
            digest.update(repr(value).encode() + b";")

    add(scene)
    return digest.hexdigest()
