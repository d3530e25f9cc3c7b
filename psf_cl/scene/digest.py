"""A fingerprint of all that a picture is of, whatever files it came from."""

from __future__ import annotations

import hashlib
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

import numpy as np

from psf_cl.scene.model import Scene

# What a scene has beside the picture: settings, and where it came from.
_LEFT_OUT = ("path", "notes", "files", "render")


def scene_digest(scene: Scene) -> str:
    """Return the SHA-256 of what the picture is of: also of meshes and textures in other files.

    Values that are the default do not count, so that new fields leave old digests as they are.
    """
    digest = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
        elif is_dataclass(value):
            digest.update(f"{type(value).__name__}(".encode())
            for item in fields(value):
                own = getattr(value, item.name)
                if item.name not in _LEFT_OUT and not _is_default(item, own):
                    digest.update(f"{item.name}=".encode())
                    add(own)
            digest.update(b")")
        elif isinstance(value, dict):
            add(sorted(value.items()))
        elif isinstance(value, (tuple, list)):
            digest.update(f"{len(value)}:".encode())
            for item in value:
                add(item)
        else:
            digest.update(repr(value).encode() + b";")

    add(scene)
    return digest.hexdigest()


def _is_default(item: Field[Any], value: Any) -> bool:
    default = item.default
    if default is MISSING:
        if item.default_factory is MISSING:
            return False
        default = item.default_factory()
    if isinstance(value, np.ndarray) or isinstance(default, np.ndarray):
        return np.array_equal(value, default)
    # A scene of one default material equals the default, arrays within or not.
    return type(value) is type(default) and repr(value) == repr(default)
