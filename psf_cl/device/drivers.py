"""What the OpenCL loader is told to load, and why it does not; needs no OpenCL."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

#: Variables of the two loaders (ocl-icd, Khronos) for where drivers are registered.
VARIABLES = ("OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH")

_DEFAULT = "/etc/OpenCL/vendors"
_LOAD = "import ctypes, sys; ctypes.CDLL(sys.argv[1])"
_LOAD_SECONDS = 30.0


def driver_problems() -> list[tuple[str, str]]:
    """Return (what is wrong, the fix) of each registered driver that cannot be loaded.

    Drivers are loaded in processes of their own, for a broken one may crash.
    """
    if sys.platform != "linux":
        return []
    problems = []
    folder = Path(_DEFAULT)
    for variable in VARIABLES:
        if value := os.environ.get(variable):
            folder = Path(value)
            if not folder.exists():
                problems.append((f"{variable}={value} is not there", f"unset {variable}"))
            elif not _registered(folder):
                problems.append((f"{variable}={value} registers no driver", f"unset {variable}"))
    files = _registered(folder)
    for file in files:
        if file.suffix != ".icd":
            continue
        try:
            library = file.read_text(errors="replace").strip().partition("\n")[0]
        except OSError as error:
            problems.append((f"{file}: {error.strerror}", "make it readable, or remove it"))
            continue
        failure = _load_failure(library)
        if failure:
            what = f"{file} names {library or 'no library'}, which does not load: {failure}"
            problems.append((what, f"install that driver again, or remove {file}"))
    return problems


def _registered(place: Path) -> list[Path]:
    """Return the files that register drivers."""
    return [place] if place.is_file() else sorted(place.glob("*.icd"))


def _load_failure(library: str) -> str:
    """Return why a library does not load, empty if it does."""
    command = [sys.executable, "-c", _LOAD, library or "/"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=_LOAD_SECONDS
        )
    except (subprocess.TimeoutExpired, ValueError) as error:
        return str(error)
    if done.returncode == 0:
        return ""
    lines = done.stderr.strip().splitlines()
    return lines[-1].removeprefix("OSError: ") if lines else f"exit code {done.returncode}"
