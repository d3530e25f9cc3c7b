"""Read files that the user named; write files whole or not at all, and check beforehand."""

from __future__ import annotations

import codecs
import contextlib
import glob
import hashlib
import os
import platform
import secrets
from collections.abc import Iterable
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


def decoded_text(data: bytes) -> str:
    """Return text in UTF-8 or UTF-16 as its first bytes say, else UTF-8, else Latin-1."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


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
    write_parts(path, (data,))


def write_parts(path: str | os.PathLike[str], parts: Iterable[bytes | memoryview]) -> None:
    """Write ``parts``, one after another, as ``write_whole`` does."""
    target, part = _target_and_part(path)
    try:
        try:
            with part.open("xb") as file:
                for data in parts:
                    file.write(data)
                # The name must not outlive the content if the power fails.
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot write: {_reason(error, target)}") from error


def remove_leftovers(path: str | os.PathLike[str]) -> None:
    """Remove what processes that were killed while they wrote ``path`` have left beside it."""
    target = Path(os.path.realpath(path))
    for part in target.parent.glob(glob.escape(f"{_prefix(target)}") + "*.part"):
        process = part.name.removeprefix(_prefix(target)).split("-")[0]
        if process.isdecimal() and not _runs(int(process)):
            with contextlib.suppress(OSError):
                part.unlink()


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _target_and_part(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    # A rename would replace a symbolic link by the file: follow it first.
    target = Path(os.path.realpath(path))
    name = f"{_prefix(target)}{os.getpid()}-{secrets.token_hex(4)}.part"
    return target, target.with_name(name)


def _prefix(target: Path) -> str:
    # Short, whatever the length of the target's name; numbers of processes are those of a machine.
    whose = os.fsencode(target.name) + b"/" + platform.node().encode()
    return f".psf_cl-{hashlib.sha256(whose).hexdigest()[:8]}-"


def _reason(error: OSError, target: Path) -> str:
    if isinstance(error, FileNotFoundError) and not target.parent.exists():
        return f"there is no folder {target.parent}"
    return error.strerror or str(error)
