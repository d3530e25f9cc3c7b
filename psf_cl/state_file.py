"""Arrays of a device in a file that says what it belongs to: checkpoints, and what was learned."""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from psf_cl.errors import InputError
from psf_cl.files import write_parts

_LENGTH = struct.Struct("<Q")
_DIGEST_BYTES = 32

#: What to do without a file, by its kind.
_WAYS = {
    "checkpoint": "an older one, or a render from the start, is the way",
    "cache": "render without --load-cache, which learns anew",
}

#: Bytes of the description at most: a damaged length must not ask for memory.
_MAX_HEADER_BYTES = 1 << 20


def write_state(
    path: str | os.PathLike[str],
    kind: str,
    header: Mapping[str, Any],
    buffers: Mapping[str, np.ndarray],
) -> None:
    """Write arrays, whole or not at all: whoever looks sees the old file or the new one.

    Args:
        kind: what the file is, ``"checkpoint"`` or ``"cache"``.
        header: plain JSON values, among them ``"identity"``: what the arrays belong to.
        buffers: name to array, 1-D.

    Raises:
        InputError: it cannot be written; an old file stays as it was.
    """
    sizes = {name: array.nbytes for name, array in buffers.items()}
    text = json.dumps({**header, "buffers": sizes}).encode()

    def parts() -> Iterator[bytes | memoryview]:
        digest = hashlib.sha256()
        contents = (np.ascontiguousarray(a).view(np.uint8) for a in buffers.values())
        yield _magic(kind)
        for part in (_LENGTH.pack(len(text)), text, *contents):
            digest.update(part)
            yield part
        yield digest.digest()

    write_parts(path, parts())


def read_state(
    path: str | os.PathLike[str],
    kind: str,
    identity: Mapping[str, Any],
    buffers: Mapping[str, tuple[np.dtype[Any], int]],
    is_sound: Callable[[Mapping[str, Any]], bool] = lambda header: True,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the description and the arrays of a file that belongs to ``identity``.

    Nothing is allocated for what the file claims: its size has to be that of these ``buffers``.

    Args:
        identity: by words that an error can name.
        buffers: name to type and number of items.
        is_sound: whether the rest of a description is one; it is called before anything is used.

    Raises:
        InputError: no such file, a damaged one, or one of something else; the message says which.
    """
    path = Path(path)
    if not path.is_file():
        found = "a folder" if path.is_dir() else "something else" if path.exists() else "nothing"
        raise InputError(f"{path}: expected a {kind}, got {found}")
    try:
        with path.open("rb") as file:
            return _read(file, path, kind, identity, buffers, is_sound)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def damaged(path: str | os.PathLike[str], kind: str) -> InputError:
    """Return the error of a file that is not what was written."""
    return InputError(f"{path}: damaged or truncated {kind}; {_WAYS[kind]}")


def refuse_fault(path: str | os.PathLike[str], kind: str, fault: str | None) -> None:
    """Refuse a file with a ``fault`` in what it holds, if there is one.

    Raises:
        InputError: there is.
    """
    if fault is not None:
        raise InputError(f"{path}: unsound {kind}: {fault}; {_WAYS[kind]}")


def _magic(kind: str) -> bytes:
    return f"psf_cl {kind} 1\n".encode()


def _read(
    file: BinaryIO,
    path: Path,
    kind: str,
    identity: Mapping[str, Any],
    buffers: Mapping[str, tuple[np.dtype[Any], int]],
    is_sound: Callable[[Mapping[str, Any]], bool],
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    if file.read(len(_magic(kind))) != _magic(kind):
        raise InputError(f"{path}: expected a {kind} of this version of psf-cl")
    digest = hashlib.sha256()
    length = file.read(_LENGTH.size)
    digest.update(length)
    size = _LENGTH.unpack(length)[0] if len(length) == _LENGTH.size else 0
    if not 0 < size <= _MAX_HEADER_BYTES:
        raise damaged(path, kind)
    text = file.read(size)
    digest.update(text)
    header = _parsed(text)
    if header is None or not is_sound(header):
        raise damaged(path, kind)
    different = [key for key in identity if header["identity"].get(key) != identity[key]]
    if different:
        raise InputError(f"{path}: {_difference(header['identity'], identity, different[0])}")
    wanted = {name: dtype.itemsize * count for name, (dtype, count) in buffers.items()}
    if header["buffers"] != wanted:
        raise damaged(path, kind)
    contents = {}
    for name, (dtype, count) in buffers.items():
        array = np.empty(count, dtype)
        view = memoryview(array.view(np.uint8))
        if file.readinto(view) != len(view):
            raise damaged(path, kind)
        digest.update(view)
        contents[name] = array
    if file.read(_DIGEST_BYTES + 1) != digest.digest():
        raise damaged(path, kind)
    return header, contents


def _parsed(text: bytes) -> dict[str, Any] | None:
    """Return the description if it is one, else None."""
    try:
        header = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(header, dict):
        return None
    for name in ("identity", "buffers"):
        if not isinstance(header.get(name), dict):
            return None
    return header


def _difference(found: Mapping[str, Any], wanted: Mapping[str, Any], key: str) -> str:
    """Say in what two renders differ."""
    one, other = found.get(key), wanted[key]
    if isinstance(one, dict) and isinstance(other, dict):
        for name in other:
            if one.get(name) != other[name]:
                return f"is of a render with {name}={one.get(name)}; this one has {other[name]}"
    return f"is of another {key}"
