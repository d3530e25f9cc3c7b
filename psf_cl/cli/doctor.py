"""``psf-cl doctor``: which OpenCL devices work, and what to do about those that do not."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import sys
from typing import Any

import psf_cl
from psf_cl.cli.common import show
from psf_cl.errors import DeviceError
from psf_cl.settings import DEVICE_VARIABLE

_PACKAGES = ("numpy", "pyopencl", "OpenEXR", "pillow", "rich", "trimesh")

# What the text of a failure contains, and the way out; the first that fits.  {driver} is the
# command that installs PoCL on this system.
_FIXES = (
    (
        "cannot compile",
        "unset what changes how the driver compiles (such as POCL_EXTRA_BUILD_FLAGS); see that the "
        "disk of its cache has room (~/.cache, POCL_CACHE_DIR); else update it: {driver}",
    ),
    ("pyopencl", "install the Python binding: pip install pyopencl"),
    ("libOpenCL", "install an OpenCL loader and a driver: {driver}"),
    (
        "crashed",
        "the driver is broken, lacks the compiler or linker that it calls, or is too old for this "
        "processor: update it, or take another device with --device; for PoCL: {driver}",
    ),
    ("no answer", "the driver hangs: update it, or take another device with --device"),
    (
        "no device",
        "unset what hides its devices (such as POCL_DEVICES); PoCL needs a cache that it can write "
        "(POCL_CACHE_DIR, ~/.cache); of a graphics card, see that you may open it (ls -l /dev/dri)",
    ),
    (
        "too little memory",
        "take another device with --device, or give this one more (a virtual machine's setting, "
        "PoCL's POCL_MEMORY_LIMIT)",
    ),
    (
        "wrong results",
        "do not render on it: update the driver, or take another device with --device",
    ),
    (
        "",
        "the driver or its compiler fails: update it, or take another device with --device; "
        "for PoCL: {driver}",
    ),
)


def add_parser(commands: Any) -> None:
    """Add the command to the subparsers of ``psf-cl``."""
    parser = commands.add_parser("doctor", help="test the OpenCL devices and say how to fix them")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print devices, drivers and self-test results; return 0 if one can be used, else 1."""
    from rich.table import Table
    from rich.text import Text

    from psf_cl.device.advice import driver_command, system_ids
    from psf_cl.device.drivers import driver_problems
    from psf_cl.device.selftest import probe_devices

    driver = driver_command(system_ids())

    def fix(reason: str) -> str:
        text = next(text for symptom, text in _FIXES if symptom in reason)
        return f"fix: {text.format(driver=driver)}"

    versions = Table("software", "version", title="Versions", title_justify="left")
    for name, version in _versions().items():
        versions.add_row(name, version)
    show(versions, Text())

    for problem, way_out in driver_problems():
        print(f"{problem}\n  fix: {way_out}")
    try:
        reports = probe_devices()
    except DeviceError as error:
        print(f"{error}\n{fix(str(error))}")
        return 1
    devices = Table("platform", "device", "driver", "self-test", title="Devices")
    devices.title_justify = "left"
    for report in reports:
        result = f"passed in {report.seconds:.2f} s" if report.ok else f"FAILED: {report.reason}"
        devices.add_row(report.platform, report.device, report.driver, result)
    if reports:
        show(devices, Text())
    for report in reports:
        if not report.ok:
            print(f"{report.platform}: {report.device}: {report.reason}\n  {fix(report.reason)}")
    usable = sum(report.ok for report in reports)
    if wanted := os.environ.get(DEVICE_VARIABLE):
        print(f"{DEVICE_VARIABLE}={wanted} limits the choice to devices of that name")
    if not usable:
        print("no OpenCL device can be used")
        print(f"fix: install your GPU's driver, or PoCL for the CPU: {driver}")
        return 1
    print(f"{usable} of {len(reports)} devices can be used")
    return 0


def _versions() -> dict[str, str]:
    versions = {
        "psf-cl": psf_cl.__version__,
        "Python": f"{platform.python_version()} ({sys.executable})",
        "system": platform.platform(),
    }
    return versions | {name: _version_of(name) for name in _PACKAGES}


def _version_of(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
