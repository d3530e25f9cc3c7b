"""How to get an OpenCL driver that works, said for the system that this is; needs no OpenCL."""

from __future__ import annotations

import platform

# By the distribution's ID or what it is like; PoCL runs on any CPU and needs no graphics card.
_COMMANDS = {
    "debian": "sudo apt-get install pocl-opencl-icd",
    "ubuntu": "sudo apt-get install pocl-opencl-icd",
    "fedora": "sudo dnf install pocl",
    "rhel": "sudo dnf install epel-release && sudo dnf install pocl",
    "arch": "sudo pacman -S pocl",
    "suse": "sudo zypper install pocl",
    "darwin": 'brew install pocl && export OCL_ICD_VENDORS="$(brew --prefix)/etc/OpenCL/vendors"',
}
_ANYWHERE = "conda install -c conda-forge pyopencl pocl  (and use that environment's Python)"


def system_ids() -> list[str]:
    """Return names of this system, the most exact first: ``["ubuntu", "debian"]``."""
    if platform.system() != "Linux":
        return [platform.system().lower()]
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return ["linux"]
    return [release.get("ID", "linux"), *release.get("ID_LIKE", "").split()]


def driver_command(ids: list[str]) -> str:
    """Return the shell command that installs PoCL on the system that ``system_ids`` names."""
    for name in ids:
        # openSUSE calls itself opensuse-leap, opensuse-tumbleweed ...
        for key, command in _COMMANDS.items():
            if name == key or name.startswith(f"open{key}"):
                return command
    return _ANYWHERE
