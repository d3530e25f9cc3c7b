"""Make a bare checkout ready: .venv, the package in it, and an OpenCL device that works.

Runs with any Python 3 and its standard library; doing it again takes about a second.  What it
changes outside the checkout is at most two Debian packages (python3-venv, pocl-opencl-icd), each
said before; PSF_CL_NO_SYSTEM_INSTALL=1 forbids that.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
VENV_PYTHON = VENV / "bin" / "python"
STAMP = VENV / "installed"
OLDEST_PYTHON = (3, 11)
POCL_WHEEL = "pocl-binary-distribution"


def say(text: str) -> None:
    """Print one line of progress."""
    print(f"set-up: {text}", flush=True)


def fail(text: str) -> None:
    """Print why the set-up stops, and stop."""
    print(f"set-up: {text}", file=sys.stderr)
    sys.exit(1)


def use_new_python() -> None:
    """Go on in a newer Python if this one is too old and there is one."""
    if sys.version_info >= OLDEST_PYTHON:
        return
    for minor in range(OLDEST_PYTHON[1] + 9, OLDEST_PYTHON[1] - 1, -1):
        found = shutil.which(f"python3.{minor}")
        if found:
            os.execv(found, [found, *sys.argv])
    wanted, here = ("{}.{}".format(*version) for version in (OLDEST_PYTHON, sys.version_info))
    fail(f"needs Python {wanted} or newer, this is {here}; then: make PYTHON=/path/to/python3")


def make_environment() -> None:
    """Make ``.venv`` and install the checkout into it, unless that was done for these files."""
    inputs = [ROOT / "setup.cfg", ROOT / "pyproject.toml"]
    # A moved checkout or another Python needs a new environment: both are part of the stamp.
    state = hashlib.sha256(f"{VENV} {sys.version} {sys.base_prefix}".encode())
    for path in inputs:
        state.update(path.read_bytes())
    if STAMP.is_file() and STAMP.read_text() == state.hexdigest():
        return
    say(f"making {VENV.name} with Python {sys.version.split()[0]}")
    make = [sys.executable, "-m", "venv", "--clear", str(VENV)]
    error = run(make)
    if error and install_debian("python3-venv"):
        error = run(make)
    if error:
        fail(f"{error}\nOn Debian: sudo apt-get install python3-venv")
    say("installing psf_cl and what it needs")
    # By path: the import hook of other editable installs loses against a folder named psf_cl, which
    # is what a checkout is called where somebody may well stand.
    by_path = ("--config-settings", "editable_mode=compat")
    if pip("install", *by_path, "--editable", f"{ROOT}[test]"):
        fail("pip could not install the packages (see above); is there a network?")
    STAMP.write_text(state.hexdigest())


def run(command: list[str]) -> str:
    """Run ``command`` without its output; return "", or what it said last if it failed."""
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    lines = done.stdout.strip().splitlines() or [f"exit code {done.returncode}"]
    return lines[-1] if done.returncode else ""


def pip(*arguments: str) -> int:
    """Run pip of ``.venv``; return its exit code."""
    command = [str(VENV_PYTHON), "-m", "pip", "--quiet", "--disable-pip-version-check", *arguments]
    return subprocess.run(command, check=False).returncode


def install_debian(package: str) -> bool:
    """Install a Debian package if that needs no password; return whether it is there now."""
    if os.environ.get("PSF_CL_NO_SYSTEM_INSTALL") or not shutil.which("apt-get"):
        return False
    rights = [] if os.geteuid() == 0 else ["sudo", "-n"]
    if rights and (not shutil.which("sudo") or run([*rights, "true"])):
        return False
    apt = [*rights, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get"]
    install = [*apt, "install", "-y", "--no-install-recommends", package]
    say(f"installing Debian's {package}")
    error = run(install)
    if error:  # The package lists may be missing or old.
        error = run([*apt, "update"]) or run(install)
    if error:
        say(error)
    return not error


def working_device() -> tuple[str, list[str]]:
    """Return the first device that passes the self-test, or "", and what is wrong instead."""
    done = subprocess.run(
        [str(VENV_PYTHON), "-m", "psf_cl.device.selftest"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    failures = []
    for line in done.stdout.splitlines():
        report = json.loads(line)
        name = "{platform}: {device}".format(**report)
        if report["ok"]:
            return name, []
        failures.append(f"{name}: {report['reason']}")
    if done.stderr.strip():
        failures.append(done.stderr.strip().splitlines()[-1])
    return "", failures or ["there is no OpenCL driver"]


def ensure_device() -> None:
    """Make sure that a device passes the self-test: as it is, by Debian's PoCL, or by the wheel."""
    device, failures = working_device()
    if not device:
        for failure in failures:
            say(failure)
        if install_debian("pocl-opencl-icd"):
            device, failures = working_device()
    if not device:
        say(f"installing {POCL_WHEEL} into {VENV.name}")
        if pip("install", POCL_WHEEL) == 0:
            device, failures = working_device()
            if not device:
                # It would be listed as a broken device for ever.
                pip("uninstall", "--yes", POCL_WHEEL)
    if not device:
        for failure in failures:
            say(failure)
        sys.path.insert(0, str(ROOT))
        from psf_cl.device.advice import driver_command, system_ids

        fail(
            "no OpenCL device works; install your graphics card's driver, or PoCL for the CPU:\n"
            f"    {driver_command(system_ids())}\nand run make again."
        )
    say(f"OpenCL device {device}")


if __name__ == "__main__":
    use_new_python()
    make_environment()
    ensure_device()
