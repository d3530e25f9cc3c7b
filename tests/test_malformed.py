"""Every file of a collection of malformed and unusual ones is refused in one line, or loads.

They are in the folder that $PSF_CL_SHARED_SCENES names, with an index of what a validator says.
"""

from __future__ import annotations

import csv
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from psf_cl.scene.gltf import load_gltf

ROOT = os.environ.get("PSF_CL_SHARED_SCENES", "")
FOLDER = Path(ROOT) / "malformed"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not ROOT, reason="PSF_CL_SHARED_SCENES is not set"),
]

#: Six gibibytes and a time that nobody would call a hang.
MEMORY = 6 << 30
SECONDS = 20

#: Valid files of what is not supported.
UNSUPPORTED = {
    "malformed/asset/min_version_valid.gltf": "glTF 2.0",
    "malformed/required-ext/Box.gltf": "the extra draco",
}

# Reads paths, and writes for each the exit code, what went to standard error, and the time.
PLANS = """
import contextlib, io, json, sys, time
from psf_cl.cli.main import main
for line in sys.stdin:
    error, start = io.StringIO(), time.perf_counter()
    with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
        code = main(["plan", json.loads(line)])
    print(json.dumps([code, error.getvalue(), time.perf_counter() - start]), flush=True)
"""


def planned(paths: list[Path]) -> list[tuple[int, str, float]]:
    """Return exit code, error text and seconds of ``psf-cl plan`` for each path.

    All in one process, as starting one takes longer than most files, within ``MEMORY``.
    """
    lines = "".join(json.dumps(str(path)) + "\n" for path in paths)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PLANS],
        input=lines,
        capture_output=True,
        text=True,
        check=False,
        timeout=SECONDS * len(paths),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY)),
    )
    assert done.returncode == 0, done.stderr
    results = [tuple(json.loads(line)) for line in done.stdout.splitlines()]
    assert len(results) == len(paths), done.stderr
    return results


def check_answers(paths: list[Path]) -> set[Path]:
    """Assert that each path loads or is refused as it should be; return those that load."""
    loaded = set()
    for path, (code, error, seconds) in zip(paths, planned(paths), strict=True):
        lines = error.splitlines()
        assert seconds < SECONDS, path
        if code == 0:
            assert all(line.startswith("note: ") for line in lines), (path, error)
            loaded.add(path)
        else:
            assert code == 2, (path, error)
            assert len(lines) == 1 and lines[0].startswith("psf-cl: error: "), (path, error)
            assert path.name in error, error
    return loaded


def index() -> list[dict[str, str]]:
    with (FOLDER / "INDEX.tsv").open() as file:
        return list(csv.DictReader(file, delimiter="\t"))


def test_every_malformed_file_is_refused_in_one_line_or_loads():
    suffixes = (".gltf", ".glb", ".obj", ".ply", ".stl")
    paths = [path for path in sorted(FOLDER.rglob("*")) if path.suffix in suffixes]
    assert len(paths) > 200
    assert check_answers(paths)


def test_every_file_without_errors_can_be_read():
    valid = [row["file"] for row in index() if row["validator_errors"] == "0"]
    assert valid
    for name in valid:
        if name not in UNSUPPORTED:
            # Most are about one thing and show nothing, which only a render refuses.
            load_gltf(Path(ROOT) / name)
    refused = [Path(ROOT) / name for name in UNSUPPORTED]
    for path, (code, error, _) in zip(refused, planned(refused), strict=True):
        assert code == 0 or UNSUPPORTED[f"malformed/{path.parent.name}/{path.name}"] in error


def test_broken_pictures_are_refused_in_one_line_or_load(tmp_path):
    pictures = sorted((FOLDER / "png-crashers").glob("*.png"))
    assert pictures
    paths = []
    for picture in pictures:
        (tmp_path / picture.name).write_bytes(picture.read_bytes())
        (tmp_path / f"{picture.stem}.toml").write_text(
            '[[shapes]]\nprimitive = "quad"\nmaterial = "m"\n'
            f'[materials.m]\nbase_color_texture = "{picture.name}"\n'
        )
        paths.append(tmp_path / f"{picture.stem}.toml")
    check_answers(paths)
