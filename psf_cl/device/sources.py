"""Where the OpenCL sources are."""

import hashlib
from pathlib import Path

from psf_cl.errors import DeviceError


def kernel_folder() -> Path:
    """Return the folder of the ``.cl`` files: inside an installed package, else beside it.

    A wheel carries the folder as ``psf_cl/cl``; in a checkout, installed editable or not, it is
    the package's neighbour.

    Raises:
        DeviceError: neither is there.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "cl", package.parent / "cl"):
        if (folder / "common").is_dir():
            return folder
    raise DeviceError(f"the OpenCL sources are missing: no folder {package / 'cl'}; install again")


def source_digest() -> str:
    """Return a fingerprint of all OpenCL sources."""
    folder = kernel_folder()
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.suffix in (".cl", ".h")):
        digest.update(f"{path.relative_to(folder).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]
