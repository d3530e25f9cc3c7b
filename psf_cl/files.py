"""Read files that the user named; write files whole or not at all, and check beforehand."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from psf_cl.errors import InputError


def read_file(path: Path) -> bytes:
    """Return the bytes of a regular file.

    Raises:
        InputError: it is missing, something else than a file, or not readable.
    """
    try:
        if path.is_file():
            return path.read_bytes()
        found = "a folder" if path.is_dir() else "something else" if path.exists() else "nothing"
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, MemoryError) as error:  # a name that no file can have; a file beyond memory
        raise InputError(f"{str(path)!r}: cannot be read: {error}") from None
    raise InputError(f"{path}: expected a file, got {found}")


def check_writable(path: str | os.PathLike[str]) -> None:
    """Make sure that ``write_whole(path, ...)`` would find a place; leaves nothing behind.

    Raises:
        InputError: the folder is missing or read-only, or ``path`` is something else than a file.
    """
    target, part = _target_and_part(path)
    try:
        part.touch(exist_ok=False)
        part.unlink()
        if target.exists() and not target.is_file():
            raise InputError(f"{path}: cannot write: it exists and is not a file")
    except OSError as error:
        raise InputError(f"{path}: cannot write: {_reason(error, target)}") from error


def write_whole(path: str | os.PathLike[str], data: bytes) -> None:
    """Write ``data`` beside ``path`` and rename it; whoever looks sees the old file or the new one.

    Raises:
        InputError: it cannot be written; nothing is left behind and an old file stays as it was.
    """
    target, part = _target_and_part(path)
    try:
        try:
            part.write_bytes(data)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot write: {_reason(error, target)}") from error


def _target_and_part(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    # A rename would replace a symbolic link by the file: follow it first.
    target = Path(os.path.realpath(path))
    return target, target.with_name(f".psf_cl-{secrets.token_hex(4)}.part")


def _reason(error: OSError, target: Path) -> str:
    if isinstance(error, FileNotFoundError) and not target.parent.exists():
        return f"there is no folder {target.parent}"
    return error.strerror or str(error)
