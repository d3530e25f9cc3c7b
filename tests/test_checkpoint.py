"""Checkpoints: a resumed render has the bits of one that never stopped; bad files are refused."""

from __future__ import annotations

import contextlib
import json
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_builder import build, camera, floor, glowing, renderer

from psf_cl.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from psf_cl.device.device import Device
from psf_cl.errors import InputError
from psf_cl.files import remove_leftovers, write_parts
from psf_cl.image import read_exr
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Material
from psf_cl.settings import PRESETS

ROOT = Path(__file__).resolve().parents[1]
OUTPUTS = ("albedo", "normal", "depth", "direct", "indirect", "variance", "samples")
FAST_PRESETS = ("pt", "psf")
IDENTITY = {"scene": "a", "settings": {"max_depth": 3, "seed": 1}}
BUFFERS = {"film": (np.dtype("<f4"), 5), "counters": (np.dtype("<u4"), 3)}


def scene():
    over = transform.translation((0, 2.5, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    ball = transform.translation((0, 0.6, 0)) @ transform.scaling(0.6)
    return build(
        [
            floor(3.0, Material(roughness=0.6)),
            (primitives.sphere(6, 4), ball, Material(base_color=(0.9, 0.7, 0.4))),
            (primitives.quad(), over @ transform.scaling(0.3), glowing((8.0, 6.0, 4.0))),
        ],
        camera((0, 1.5, 3), (0, 0.5, 0), 45),
        (24, 16),
    )


SPP = 500


@pytest.fixture(scope="module")
def small(device):
    """Return the device with a pool of few paths, so that passes end one by one."""
    traits = replace(device.traits, slots=512)
    return Device(device.context, traits)


@pytest.mark.parametrize(
    "preset",
    [
        name if name in FAST_PRESETS else pytest.param(name, marks=pytest.mark.slow)
        for name in PRESETS
    ],
)
def test_a_resumed_render_has_the_bits_of_one_that_never_stopped(small, tmp_path, preset):
    """Of every preset, whatever tables it carries from pass to pass."""
    path = tmp_path / "state"
    settings, outputs = dict(PRESETS[preset]), OUTPUTS
    if settings.get("integrator") == "metropolis":
        # Epochs of few chains are short enough to end in between.
        settings["chains"], outputs = 128, ()

    def fresh():
        return renderer(small, scene(), outputs, **settings)

    with contextlib.closing(fresh()) as whole:
        whole.render(spp=SPP)
        truth = whole.image()
    with contextlib.closing(fresh()) as first:
        # Later passes are on their way when it is saved, if the technique allows it.
        assert not first.render(
            spp=SPP, progress=lambda now: now.passes < 5 or not first.save(path)
        )
    with contextlib.closing(fresh()) as second:
        second.resume(path)
        assert 5 <= second.scheduler.passes < SPP - 100
        second.render(spp=second.scheduler.passes + 37)
        assert second.save(path)  # At the end of a run there is always a moment.
    with contextlib.closing(fresh()) as third:
        third.resume(path)
        third.render(spp=SPP)
        image = third.image()
    assert image.stats["spp"] == truth.stats["spp"] == SPP
    for name in truth.aovs:
        assert image.aovs[name].tobytes() == truth.aovs[name].tobytes(), name


def example(path):
    arrays = {"film": np.arange(5, dtype="<f4"), "counters": np.arange(3, dtype="<u4")}
    write_checkpoint(path, Checkpoint(IDENTITY, 7, (4, 8), 1.5, "some device", arrays))
    return path.read_bytes()


def test_a_checkpoint_comes_back_as_it_was(tmp_path):
    path = tmp_path / "state"
    example(path)
    back = read_checkpoint(path, IDENTITY, BUFFERS)
    assert (back.passes, back.epoch, back.seconds, back.device) == (7, (4, 8), 1.5, "some device")
    assert back.buffers["film"].tolist() == [0, 1, 2, 3, 4]
    assert back.buffers["counters"].tolist() == [0, 1, 2]


def test_no_changed_byte_and_no_cut_is_taken_for_a_checkpoint(tmp_path):
    path = tmp_path / "state"
    whole = example(path)
    for place in range(len(whole)):
        for data in (
            whole[:place],
            whole[:place] + bytes([whole[place] ^ 0x20]) + whole[place + 1 :],
        ):
            path.write_bytes(data)
            with pytest.raises(InputError, match=r"state: \w"):
                read_checkpoint(path, IDENTITY, BUFFERS)
    path.write_bytes(whole + b"x")
    with pytest.raises(InputError, match="damaged"):
        read_checkpoint(path, IDENTITY, BUFFERS)


@pytest.mark.parametrize(
    "header",
    [
        b"",
        b"[]",
        b"{}",
        b"[" * 100000,
        b'{"identity": 1}',
        json.dumps({"identity": IDENTITY, "buffers": {"film": 1 << 62}, "passes": 1}).encode(),
        json.dumps(
            {
                "identity": IDENTITY,
                "buffers": {"film": 20, "counters": 12},
                "passes": -1,
                "epoch": [0, 4],
                "seconds": 0,
                "device": "",
            }
        ).encode(),
        b'{"identity": {}, "seconds": NaN, "passes": 1e999, "epoch": [0, 0], "buffers": {}}',
    ],
)
def test_a_description_that_makes_no_sense_is_refused(tmp_path, header):
    path = tmp_path / "state"
    path.write_bytes(example(path)[:20] + struct.pack("<Q", len(header)) + header + b"\0" * 64)
    with pytest.raises(InputError, match="damaged"):
        read_checkpoint(path, IDENTITY, BUFFERS)


@pytest.mark.parametrize(
    ("identity", "text"),
    [
        ({"scene": "b"}, "is of another scene"),
        ({"settings": {"max_depth": 3, "seed": 2}}, "with seed=1; this one has 2"),
        ({"version": "9"}, "is of another version"),
    ],
)
def test_the_checkpoint_of_another_render_is_refused_with_the_difference(tmp_path, identity, text):
    path = tmp_path / "state"
    example(path)
    with pytest.raises(InputError, match=text):
        read_checkpoint(path, IDENTITY | identity, BUFFERS)


def test_what_is_no_file_is_refused(tmp_path):
    for name, text in (("nothing", "got nothing"), (".", "got a folder")):
        with pytest.raises(InputError, match=text):
            read_checkpoint(tmp_path / name, IDENTITY, BUFFERS)


def test_a_full_disk_leaves_the_last_good_file_and_nothing_else(tmp_path):
    path = tmp_path / "state"
    whole = example(path)

    def parts():
        yield b"begun"
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match="state: cannot write: No space left on device"):
        write_parts(path, parts())
    assert path.read_bytes() == whole and os.listdir(tmp_path) == ["state"]


def test_a_file_beyond_what_the_system_allows_leaves_the_last_good_one(tmp_path):
    """A real limit, in a process of its own: what is refused comes after the first parts."""
    path = tmp_path / "state"
    whole = example(path)
    command = (
        "import sys; from psf_cl.errors import InputError; from psf_cl.files import write_parts\n"
        "try: write_parts(sys.argv[1], [bytes(4096)] * 100)\n"
        "except InputError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", command, path],
        cwd=ROOT,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, 1 << 16)),
    )
    assert done.stdout == f"{path}: cannot write: File too large\n", done.stderr
    assert path.read_bytes() == whole and os.listdir(tmp_path) == ["state"]


def test_what_a_killed_writer_left_is_removed_and_that_of_a_living_one_is_not(tmp_path):
    path = tmp_path / "state"
    command = (
        "import os, signal, sys; from psf_cl.files import write_parts\n"
        "def parts():\n"
        "    yield b'begun'\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "write_parts(sys.argv[1], parts())\n"
    )
    assert subprocess.run([sys.executable, "-c", command, path], cwd=ROOT).returncode < 0
    assert [name.endswith(".part") for name in os.listdir(tmp_path)] == [True]

    def parts():
        remove_leftovers(path)
        yield b"good"

    write_parts(path, parts())
    assert os.listdir(tmp_path) == ["state"] and path.read_bytes() == b"good"


@pytest.mark.slow
def test_twenty_kills_lose_nothing_but_the_work_since_the_last_checkpoint(device, tmp_path):
    """Kills come at random times, many of them while a checkpoint is being written."""
    state, spp = tmp_path / "state", 3000
    command = [sys.executable, "-m", "psf_cl", "render", "scenes/cornell_box.toml"]
    command += ["--size", "32x32", "--aov", "all", "--quiet"]
    files = ["--checkpoint", str(state), "--checkpoint-seconds", "0.001"]
    chance = random.Random(11)
    passes = kills = 0
    while kills < 20:
        resume = ["--resume", str(state)] if state.exists() else []
        whole = [*command, *files, *resume, "--spp", "100000000", "-o", str(tmp_path / "x.exr")]
        before = state.stat().st_mtime_ns if state.exists() else 0
        with subprocess.Popen(whole, cwd=ROOT) as process:
            while not state.exists() or state.stat().st_mtime_ns == before:
                assert process.poll() is None, "it ended by itself"
                time.sleep(0.01)
            time.sleep(chance.random() * 0.3)
            process.send_signal(signal.SIGKILL)
        kills += 1
        data = state.read_bytes()
        (size,) = struct.unpack_from("<Q", data, 20)
        held = json.loads(data[28 : 28 + size])["passes"]
        assert held > passes, "a checkpoint is older than the one that was resumed"
        passes = held
    spp = passes + 100
    end = [*command, "--spp", str(spp)]
    again = [*end, "--resume", str(state), "--checkpoint", str(state), "-o"]
    subprocess.run([*again, str(tmp_path / "resumed.exr")], cwd=ROOT, check=True)
    subprocess.run([*end, "-o", str(tmp_path / "whole.exr")], cwd=ROOT, check=True)
    one, other = (read_exr(tmp_path / f"{name}.exr") for name in ("resumed", "whole"))
    for name in other.aovs:
        assert one.aovs[name].tobytes() == other.aovs[name].tobytes(), name
    assert not list(tmp_path.glob(".psf_cl*"))
