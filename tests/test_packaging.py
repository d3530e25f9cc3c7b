"""The wheel: built, installed into a clean environment, used from another folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def run(*command: object, cwd: Path) -> str:
    """Run a command that has to succeed; return its standard output."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Build the wheel from a copy, since setuptools writes beside its sources."""
    folder = tmp_path_factory.mktemp("wheel")
    ignore = shutil.ignore_patterns(".*", "out", "build", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT, folder / "checkout", ignore=ignore)
    run(
        sys.executable, "-m", "pip", "wheel", folder / "checkout", "-w", folder,
        "--no-deps", "--no-index", "--no-build-isolation",
        cwd=folder,
    )  # fmt: skip
    (built,) = folder.glob("*.whl")
    return built


@pytest.mark.slow
def test_the_wheel_carries_every_kernel_source_and_module(wheel):
    expected = {
        *(f"psf_cl/{path.relative_to(ROOT)}" for path in (ROOT / "cl").rglob("*.cl")),
        *(f"psf_cl/{path.relative_to(ROOT)}" for path in (ROOT / "cl").rglob("*.h")),
        *(str(path.relative_to(ROOT)) for path in (ROOT / "psf_cl").rglob("*.py")),
        *(f"psf_cl/measure/report.{kind}" for kind in ("html", "css", "js")),
        "psf_cl/cl/__init__.py",
    }
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == expected


@pytest.mark.slow
def test_the_wheel_renders_from_another_folder(wheel, tmp_path):
    environment = tmp_path / "environment"
    run(sys.executable, "-m", "venv", environment, cwd=tmp_path)
    python = environment / "bin" / "python"
    run(python, "-m", "pip", "install", "--no-deps", "--no-index", wheel, cwd=tmp_path)
    # The dependencies are those of this environment, so that nothing is downloaded; a path in a
    # .pth file comes after the environment's own packages, and editable installs there are unseen.
    (site,) = environment.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes")

    where = run(python, "-c", "import psf_cl; print(psf_cl.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(environment)
    scene = tmp_path / "scenes" / "cornell_box.toml"
    for number, command in enumerate(([python, "-m", "psf_cl"], [environment / "bin" / "psf-cl"])):
        output = tmp_path / f"box{number}.exr"
        run(*command, "render", scene, "-o", output, "--size", "32x32", "--spp", "1", cwd=tmp_path)
        assert output.is_file() and output.with_suffix(".png").is_file()
