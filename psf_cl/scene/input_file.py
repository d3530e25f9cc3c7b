"""Read a file that the user named, or say in one line why not."""

from __future__ import annotations

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
