"""Memory: planned before it is taken, smaller pools where there is less, refusals in one line."""

from __future__ import annotations

import contextlib
import dataclasses
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from scene_builder import build, camera, floor, glowing, renderer

from psf_cl.cli.main import main
from psf_cl.device.device import Device
from psf_cl.device.hash_map import LEAST_SLOTS
from psf_cl.errors import DeviceError, InputError
from psf_cl.plan import MAX_HALVINGS, MAX_PIXELS, MIN_SLOTS, TABLE_HALVINGS, Room, make_plan
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Light, Material
from psf_cl.settings import Settings

LIGHT = transform.translation((0, 2.5, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
GIB = 1 << 30
ROOT = Path(__file__).resolve().parents[1]


def scene(size=(24, 16), columns=12):
    """Return a scene of 172 triangles, which has a tree."""
    ball = transform.translation((0, 0.6, 0)) @ transform.scaling(0.6)
    return build(
        [
            floor(3.0, Material(roughness=0.6)),
            (primitives.sphere(columns, 2 * columns // 3), ball, Material()),
            (primitives.quad(), LIGHT @ transform.scaling(0.3), glowing((8.0, 6.0, 4.0))),
        ],
        camera((0, 1.5, 3), (0, 0.5, 0), 45),
        size,
    )


def test_with_less_room_the_pool_is_smaller_and_nothing_else_changes():
    large = scene((256, 192))
    whole = make_plan(large, Settings(path_filter="hash_grid"))
    assert whole.lacks(Room(whole.peak_bytes)) is None
    assert whole.lacks(Room(whole.peak_bytes - 1)) is not None
    room = Room(whole.peak_bytes - 1)
    fitted = make_plan(large, Settings(path_filter="hash_grid"), room=room)
    assert fitted.peak_bytes <= room.total < whole.peak_bytes
    assert fitted.traits.slots < whole.traits.slots and fitted.ring <= whole.ring
    assert fitted.features == whole.features and fitted.scene_buffers == whole.scene_buffers
    least = make_plan(large, Settings(path_filter="hash_grid"), halvings=MAX_HALVINGS)
    assert least.traits.slots == MIN_SLOTS and least.table_halvings == 0


def two_lights(size, columns=12):
    """Return the scene with another light, so that there is a choice."""
    lamp = Light("point", (2.0, 2.0, 2.0), position=(-1.5, 1.0, 1.0))
    return dataclasses.replace(scene(size, columns), lights=(lamp,))


def test_where_a_small_pool_does_not_do_tables_are_smaller_too():
    large = two_lights((256, 192))
    many = Settings(path_filter="hash_grid", guiding="learned", termination="cache")
    many = many.with_values({"light_sampling": "photon"})
    least = make_plan(large, many, halvings=MAX_HALVINGS)
    tables = {b.name: b.count for b in least.buffers if b.name.endswith("_keys")}
    assert set(tables) == {"cell_keys", "guide_keys", "cache_keys", "particle_keys"}
    fitted = make_plan(large, many, room=Room(least.peak_bytes - 1))
    assert (
        fitted.table_halvings == 1
        and ("slots", "of large hash tables 1 of 2 is there: too little room") in fitted.left_out
    )
    assert {b.name: 2 * b.count for b in fitted.buffers if b.name in tables} == tables
    floor = make_plan(large, many, halvings=MAX_HALVINGS + TABLE_HALVINGS)
    assert min(b.count for b in floor.buffers if b.name in tables) >= LEAST_SLOTS
    with pytest.raises(DeviceError, match=r"needs \d+ MiB, the most of it for \w+ .* a smaller"):
        make_plan(large, many, room=Room(floor.peak_bytes - 1))


def test_a_render_with_smaller_tables_shares_less_is_as_bright_and_resumes_no_other(
    device, tmp_path
):
    few = two_lights((96, 64), columns=6)
    values = {"path_filter": "hash_grid", "guiding": "learned", "light_sampling": "photon"}
    settings = Settings().with_values(values | {"cell_size": 1.0})
    least = make_plan(few, settings, traits=device.traits, halvings=MAX_HALVINGS)
    seen = []
    for room in (None, Room(least.peak_bytes - 1)):
        with contextlib.closing(Renderer(few, settings, device, room=room)) as opened:
            if room is not None:
                with pytest.raises(InputError, match="is of another size of hash tables"):
                    opened.resume(tmp_path / "whole")
            opened.render(spp=4)
            assert opened.save(tmp_path / "whole")
            image = opened.image()
        seen.append((image.stats["table_halvings"], image.rgb.mean(), image.stats["cells"]["load"]))
    assert [halvings for halvings, _, _ in seen] == [0, 1]
    assert seen[0][1] == pytest.approx(seen[1][1], rel=0.03)
    # As many cells in half of the slots.
    assert seen[1][2] == pytest.approx(2 * seen[0][2], rel=0.1)


def test_no_buffer_is_larger_than_the_device_allows():
    large = scene((2048, 2048))
    samples = {b.name: b.bytes for b in make_plan(large, Settings()).buffers}["samples"]
    small = scene((64, 64))
    most = {b.name: b.bytes for b in make_plan(small, Settings()).buffers}["samples"] // 2
    fitted = make_plan(small, Settings(), room=Room(64 * GIB, most))
    assert max(b.bytes for b in fitted.buffers) <= most
    assert samples == 2 * 16 * 2048**2  # Two passes are in flight: there is nothing to halve.
    with pytest.raises(DeviceError, match="MiB in one buffer, 100 are allowed"):
        make_plan(large, Settings(), room=Room(64 * GIB, 100 << 20))


def test_pictures_beyond_what_kernels_can_count_are_refused():
    huge = scene((16384, 16385))
    with pytest.raises(InputError, match=f"more than {MAX_PIXELS} pixels; render parts"):
        make_plan(huge, Settings())
    make_plan(huge, Settings(), crop=(0, 0, 64, 64))


def test_building_a_tree_takes_what_was_planned(device):
    device.peak_bytes = before = device.allocated_bytes
    alone = renderer(device, scene(columns=150))
    planned, taken = alone.plan, device.peak_bytes - before
    assert planned.building and alone.bvh is not None
    # The estimate of the tree itself is on the safe side.
    assert 0.6 * planned.peak_bytes < taken <= planned.peak_bytes
    alone.close()


def test_a_device_that_has_no_room_gets_a_smaller_pool_and_shows_the_same_image(
    device, monkeypatch
):
    few, before = scene(columns=6), device.allocated_bytes
    truth = renderer(device, few)
    truth.render(spp=3)
    image, whole = truth.image(), truth.plan
    truth.close()
    least = make_plan(few, Settings(), traits=device.traits, halvings=MAX_HALVINGS)
    failures = []

    def limit(room):
        failures.clear()
        allocate = Device.allocate

        def refusing(self, name, dtype, count):
            size = count * np.dtype(dtype).itemsize
            with monkeypatch.context() as patch:
                if self.allocated_bytes - before + size > room:
                    failures.append(name)
                    patch.setattr(Device, "largest_buffer", 0)
                return allocate(self, name, dtype, count)

        return refusing

    with monkeypatch.context() as patch:
        patch.setattr(Device, "allocate", limit((whole.peak_bytes + least.peak_bytes) // 2))
        small = renderer(device, few)
        assert failures and small.plan.traits.slots < whole.traits.slots
        small.render(spp=3)
        assert small.image().rgb.tobytes() == image.rgb.tobytes()
        small.close()
    with monkeypatch.context() as patch:
        patch.setattr(Device, "allocate", limit(least.peak_bytes // 4))
        with pytest.raises(DeviceError, match="in one buffer; a smaller --size"):
            renderer(device, few)
    assert device.allocated_bytes == before


def test_a_driver_that_fails_to_allocate_is_told_of_at_once(device, monkeypatch):
    """Whatever the driver says: by its own code, and with nothing left behind."""
    before = device.allocated_bytes

    def failing(self, size):
        raise cl.MemoryError("create_buffer", cl.status_code.OUT_OF_HOST_MEMORY, "")

    monkeypatch.setattr(Device, "memory", failing)
    with pytest.raises(DeviceError, match=r"failed at allocating .* a smaller --size") as told:
        renderer(device, scene(columns=6))
    assert "\n" not in str(told.value)
    assert device.allocated_bytes == before


@pytest.mark.slow
def test_a_process_without_memory_ends_by_one_line(device, tmp_path):
    """A real limit: drivers that allocate on first use would end the process by a signal."""
    command = [sys.executable, "-m", "psf_cl", "render", str(ROOT / "scenes/cornell_box.toml")]
    command += "--preset psf --size 1200x1200 --spp 1 --quiet -o".split()
    command.append(str(tmp_path / "out.exr"))
    for mebibytes in (600, 800, 1000, 1500):
        done = subprocess.run(
            command,
            cwd=ROOT,
            capture_output=True,
            text=True,
            preexec_fn=lambda size=mebibytes: resource.setrlimit(
                resource.RLIMIT_AS, (size << 20, size << 20)
            ),
        )
        assert done.returncode in (0, 1), (mebibytes, done.stderr)
        lines = [line for line in done.stderr.splitlines() if line.startswith("psf-cl: error")]
        assert len(lines) == done.returncode, done.stderr


def test_memory_is_limited_by_an_option(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.toml").write_text(
        '[[shapes]]\nprimitive = "quad"\n[camera]\nposition = [0, 1, 3]\ntarget = [0, 0, 0]\n'
    )
    assert main("plan a.toml --memory 1".split()) == 1
    (error,) = (e for e in capsys.readouterr().err.splitlines() if not e.startswith("note: "))
    assert error.startswith("psf-cl: error: the render needs ") and "1 are there" in error
    assert main("plan a.toml --memory 5000".split()) == 0
    assert main("plan a.toml --memory 0".split()) == 2


def test_guards_tell_of_kernels_that_write_behind_a_buffer(device, monkeypatch):
    monkeypatch.setenv("PSF_CL_GUARDS", "1")
    guarded = Device(device.context, device.traits)
    fine, written = (guarded.allocate(name, np.uint32, 3) for name in ("fine", "written"))
    guarded.fill(fine, 1)
    behind = dataclasses.replace(written, count=4)
    guarded.write(behind, np.full(4, 7, np.uint32))
    guarded.release(fine)
    with pytest.raises(DeviceError, match="a kernel wrote behind the end of written"):
        guarded.release(written)
    assert guarded.allocated_bytes == 0
