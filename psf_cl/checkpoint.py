"""Checkpoints: all that a render needs to go on later, in one file that says what it belongs to."""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from psf_cl.errors import InputError
from psf_cl.files import write_parts

_MAGIC = b"psf_cl checkpoint 1\n"
_LENGTH = struct.Struct("<Q")
_DIGEST_BYTES = 32

#: Bytes of the description at most: a damaged length must not ask for memory.
_MAX_HEADER_BYTES = 1 << 20

_BROKEN = "damaged or truncated checkpoint; an older one, or a render from the start, is the way"


@dataclass(frozen=True)
class Checkpoint:
    """A render at the end of a pass.

    Attributes:
        identity: what it belongs to, by words that an error can name: two renders whose identities
            are equal go on with each other's checkpoints.
        passes: whole passes in it.
        epoch: first pass of the epoch, and the first after it.
        seconds: spent on rendering so far.
        device: that it was rendered on.
        buffers: name to what the device held, 1-D, of the buffer's type.
    """

    identity: Mapping[str, Any]
    passes: int
    epoch: tuple[int, int]
    seconds: float
    device: str
    buffers: Mapping[str, np.ndarray]


def write_checkpoint(path: str | os.PathLike[str], checkpoint: Checkpoint) -> None:
    """Write a checkpoint, whole or not at all: whoever looks sees the old one or the new one.

    Raises:
        InputError: it cannot be written; the old one stays as it was.
    """
    header = json.dumps(
        {
            "identity": checkpoint.identity,
            "passes": checkpoint.passes,
            "epoch": list(checkpoint.epoch),
            "seconds": checkpoint.seconds,
            "device": checkpoint.device,
            "buffers": {name: array.nbytes for name, array in checkpoint.buffers.items()},
        }
    ).encode()

    def parts() -> Iterator[bytes | memoryview]:
        digest = hashlib.sha256()
        contents = (np.ascontiguousarray(a).view(np.uint8) for a in checkpoint.buffers.values())
        yield _MAGIC
        for part in (_LENGTH.pack(len(header)), header, *contents):
            digest.update(part)
            yield part
        yield digest.digest()

    write_parts(path, parts())


def read_checkpoint(
    path: str | os.PathLike[str],
    identity: Mapping[str, Any],
    buffers: Mapping[str, tuple[np.dtype[Any], int]],
) -> Checkpoint:
    """Read a checkpoint for the render that ``identity`` and ``buffers`` describe.

    Nothing is allocated for what the file claims: its size has to be that of these ``buffers``.

    Args:
        buffers: name to type and number of items.

    Raises:
        InputError: no checkpoint, a damaged one, or one of another render; the message says which.
    """
    path = Path(path)
    if not path.is_file():
        found = "a folder" if path.is_dir() else "something else" if path.exists() else "nothing"
        raise InputError(f"{path}: expected a checkpoint, got {found}")
    try:
        with path.open("rb") as file:
            return _read(file, path, identity, buffers)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def _read(
    file: BinaryIO,
    path: Path,
    identity: Mapping[str, Any],
    buffers: Mapping[str, tuple[np.dtype[Any], int]],
) -> Checkpoint:
    if file.read(len(_MAGIC)) != _MAGIC:
        raise InputError(f"{path}: expected a checkpoint of this version of psf-cl")
    digest = hashlib.sha256()
    length = file.read(_LENGTH.size)
    digest.update(length)
    size = _LENGTH.unpack(length)[0] if len(length) == _LENGTH.size else 0
    if not 0 < size <= _MAX_HEADER_BYTES:
        raise InputError(f"{path}: {_BROKEN}")
    text = file.read(size)
    digest.update(text)
    header = _parsed(text)
    if header is None:
        raise InputError(f"{path}: {_BROKEN}")
    different = [key for key in identity if header["identity"].get(key) != identity[key]]
    if different:
        raise InputError(f"{path}: {_difference(header['identity'], identity, different[0])}")
    wanted = {name: dtype.itemsize * count for name, (dtype, count) in buffers.items()}
    if header["buffers"] != wanted:
        raise InputError(f"{path}: {_BROKEN}")
    contents = {}
    for name, (dtype, count) in buffers.items():
        array = np.empty(count, dtype)
        view = memoryview(array.view(np.uint8))
        if file.readinto(view) != len(view):
            raise InputError(f"{path}: {_BROKEN}")
        digest.update(view)
        contents[name] = array
    if file.read(_DIGEST_BYTES + 1) != digest.digest():
        raise InputError(f"{path}: {_BROKEN}")
    first, end = header["epoch"]
    return Checkpoint(
        identity, header["passes"], (first, end), header["seconds"], header["device"], contents
    )


def _parsed(text: bytes) -> dict[str, Any] | None:
    """Return the description if it is one, else None."""
    try:
        header = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(header, dict):
        return None
    epoch = header.get("epoch")
    counts = [header.get("passes"), *(epoch if isinstance(epoch, list) else ())]
    seconds = header.get("seconds")
    if (
        not isinstance(header.get("identity"), dict)
        or not isinstance(header.get("buffers"), dict)
        or not isinstance(header.get("device"), str)
        or len(counts) != 3
        or not all(type(count) is int and 0 <= count <= 1 << 32 for count in counts)
        or not isinstance(seconds, (int, float))
        or not 0.0 <= seconds < 1e12
        or not counts[1] <= counts[0] <= counts[2]
    ):
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
