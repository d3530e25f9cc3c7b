"""Programs that several processes build: they are there, in order, whatever becomes of others."""

import dataclasses
import json
import os
import subprocess
import sys

import pytest

from psf_cl.device import builders
from psf_cl.device.builders import Wanted, build_programs, builders_for
from psf_cl.device.program import load_program
from psf_cl.errors import DeviceError

#: A macro that no program uses, so that caches know nothing of it.
FRESH = os.getpid()


@pytest.fixture
def cold(monkeypatch, device):
    """Take every program for one that has to be made, beside one other process."""
    monkeypatch.setattr(builders, "_COLD_RATIO", -1.0)
    monkeypatch.setattr(device, "builders", 1)
    sent = []
    send = builders._send

    def noting(process, message):
        sent.append(message)
        send(process, message)

    monkeypatch.setattr(builders, "_send", noting)
    return sent


def wanted(*numbers):
    return [Wanted("primitives.cl", {"FRESH": FRESH, "N": n}, ()) for n in numbers]


def test_programs_come_in_the_order_asked_for(device, cold):
    programs = build_programs(device, wanted(5, 3, 4, 1))
    assert [program.defines["N"] for program in programs] == [5, 3, 4, 1]
    assert all(program.is_warm for program in programs)
    assert [load_program(device, p.file, p.defines) for p in programs] == programs
    # The other process was told of its device, and of a program from the end.
    assert cold[0]["device"] == device.name and cold[1]["defines"]["N"] == 1


def test_what_another_process_leaves_undone_is_built_here(device, cold, monkeypatch):
    monkeypatch.setattr(sys, "executable", "false")
    programs = build_programs(device, wanted(11, 12, 13))
    assert [program.defines["N"] for program in programs] == [11, 12, 13]
    assert all(program.is_warm for program in programs) and len(cold) > 1


def test_programs_that_do_not_build_are_told(device, cold):
    broken = Wanted("primitives.cl", {"FRESH": FRESH, "uint": 7}, ())
    with pytest.raises(DeviceError, match=r"primitives\.cl does not build"):
        build_programs(device, [*wanted(21), broken, *wanted(22)])


def test_nobody_is_asked_for_what_is_there(device, cold, monkeypatch):
    build_programs(device, wanted(31, 32))
    cold.clear()
    build_programs(device, wanted(31, 32))
    assert not cold


def test_a_builder_answers_each_line(device):
    head = {"device": device.name, "traits": dataclasses.asdict(device.traits)}
    broken = Wanted("primitives.cl", {"FRESH": FRESH, "uint": 8}, ())
    jobs = [dataclasses.asdict(each) for each in (*wanted(41), broken, *wanted(42))]
    done = subprocess.run(
        [sys.executable, "-m", "psf_cl.device.builders"],
        input="".join(json.dumps(line) + "\n" for line in (head, *jobs)),
        capture_output=True,
        text=True,
    )
    assert done.stdout.split() == ["built", "failed", "built"] and done.returncode == 0


def test_only_drivers_that_share_what_they_build_get_builders(device):
    processors = len(os.sched_getaffinity(0))
    is_pocl = "Portable Computing Language" in device.name
    assert builders_for(device) == (min(processors - 1, 3) if is_pocl else 0)
