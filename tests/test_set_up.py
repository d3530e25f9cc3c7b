"""Set-up: the self-test tells working devices from broken ones, and advice fits the system."""

from __future__ import annotations

import sys
import types
from pathlib import Path

import pyopencl as cl
import pytest
import set_up

from psf_cl.device import selftest
from psf_cl.device.advice import driver_command
from psf_cl.device.device import open_device
from psf_cl.device.drivers import driver_problems
from psf_cl.errors import DeviceError

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def fake_python(tmp_path, monkeypatch):
    """Let the probe start a shell script: one device is listed, then ``answer`` runs."""

    def install(answer: str, listing: str | None = None) -> None:
        names = '{"platform": "P", "device": "D", "driver": "1"}'
        script = tmp_path / "python"
        script.write_text(
            '#!/bin/sh\nif [ "$3" = --list ]; then\n'
            + (listing or f"echo driver noise; echo '[[0, 0, {names}]]'")
            + f"; exit; fi\n{answer}\n"
        )
        script.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(script))

    return install


def test_the_device_of_the_tests_passes_in_a_process_of_its_own(device):
    reports = selftest.probe_devices()
    assert device.name in [f"{report.platform}: {report.device}" for report in reports if report.ok]


@pytest.mark.parametrize(
    ("right", "wrong", "part"),
    [
        ("fma(v, v, (float16)(-1.0f))", "fma(v, v, (float16)(-1.0001f))", "vector arithmetic"),
        ("w, v < 1.0f)", "w, v > 1.0f)", "vector arithmetic"),
        ("atomic_add(&histogram[value % BINS], i)", "histogram[value % BINS] = i", "atomic adds"),
        ("sums[l] += sums[l + step]", "sums[l] += 1u", "local memory"),
    ],
)
def test_a_wrong_result_fails_the_self_test(device, monkeypatch, right, wrong, part):
    assert right in selftest._SOURCE
    monkeypatch.setattr(selftest, "_SOURCE", selftest._SOURCE.replace(right, wrong))
    assert selftest.run_self_test(device.cl_device).reason == f"wrong results: {part}"


@pytest.mark.parametrize("register_floats, lanes", [(0, None), (8, 8), (16, 16)])
def test_paths_are_as_many_abreast_as_registers_of_the_device_hold(
    device, monkeypatch, register_floats, lanes
):
    stated = selftest._SOURCE.replace("= REGISTER_FLOATS", f"= {register_floats}")
    monkeypatch.setattr(selftest, "_SOURCE", stated)
    opened = open_device(device.name)
    if lanes is None:
        lanes = 8 if device.cl_device.native_vector_width_float == 8 else 16
    if opened.traits.kind == "cpu":
        assert opened.traits.lanes == opened.traits.block == lanes


def test_a_compiler_error_is_one_line(device, monkeypatch):
    monkeypatch.setattr(selftest, "_SOURCE", selftest._SOURCE.replace("fma(", "no_such_function("))
    reason = selftest.run_self_test(device.cl_device).reason
    assert reason.startswith("cannot compile: ") and "no_such_function" in reason
    assert "\n" not in reason


def test_the_doctor_compiles_anew_for_a_cache_hides_a_broken_compiler(device, monkeypatch):
    asked = []

    def build(program, options=(), **others):
        asked.append(tuple(options))
        raise cl.RuntimeError("build failed\nx.c:1: error: no such thing\nmore")

    monkeypatch.setattr(cl.Program, "build", build)
    for _ in range(2):
        reason = selftest.run_self_test(device.cl_device, anew=True).reason
        assert reason == "cannot compile: x.c:1: error: no such thing"
    selftest.run_self_test(device.cl_device)
    selftest.run_self_test(device.cl_device)
    assert len(set(asked)) == 3


def test_a_platform_without_a_device_is_reported(fake_python):
    names = '{"platform": "P", "device": "none", "driver": "1"}'
    fake_python("exit 9", listing=f"echo '[[0, null, {names}]]'")
    (report,) = selftest.probe_devices()
    assert (report.ok, report.platform) == (False, "P")
    assert report.reason == "this platform has no device"


def test_a_crashing_driver_is_reported(fake_python):
    fake_python("kill -SEGV $$")
    (report,) = selftest.probe_devices()
    assert not report.ok
    assert report.reason == "the driver crashed (SIGSEGV)"
    assert (report.platform, report.device, report.driver) == ("P", "D", "1")


def test_a_hanging_driver_is_reported(fake_python, monkeypatch):
    monkeypatch.setattr(selftest, "PROBE_SECONDS", 1.0)
    fake_python("exec sleep 60")
    (report,) = selftest.probe_devices()
    assert report.reason == "no answer within 1 s"


def test_a_loader_that_crashes_is_a_device_error(fake_python):
    fake_python("exit 0", listing="kill -SEGV $$")
    with pytest.raises(DeviceError, match="OpenCL does not start: the driver crashed"):
        selftest.probe_devices()


def test_a_device_of_too_little_memory_is_reported():
    small = types.SimpleNamespace(global_mem_size=64 << 20, max_mem_alloc_size=64 << 20)
    reason = selftest.run_self_test(small).reason
    assert reason == "too little memory of the device: 64 MiB, 128 are needed"
    small.global_mem_size, small.max_mem_alloc_size = 1 << 40, 8 << 20
    reason = selftest.run_self_test(small).reason
    assert reason == "too little memory in one buffer: 8 MiB, 32 are needed"


def test_drivers_that_cannot_be_loaded_are_named_with_the_fix(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "platform", "linux")
    (tmp_path / "gone.icd").write_text("libof_nobody.so\n")
    (tmp_path / "fine.icd").write_text("libm.so.6\n")
    (tmp_path / "odd.icd").write_text("")
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path))
    gone, odd = driver_problems()
    assert "gone.icd names libof_nobody.so, which does not load: libof_nobody.so: " in gone[0]
    assert gone[1] == f"install that driver again, or remove {tmp_path / 'gone.icd'}"
    assert "odd.icd names no library" in odd[0]
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.setenv("OCL_ICD_VENDORS", str(empty))
    told = (f"OCL_ICD_VENDORS={empty} registers no driver", "unset OCL_ICD_VENDORS")
    assert driver_problems() == [told]
    nowhere = tmp_path / "nowhere"
    monkeypatch.setenv("OCL_ICD_VENDORS", str(nowhere))
    told = (f"OCL_ICD_VENDORS={nowhere} is not there", "unset OCL_ICD_VENDORS")
    assert driver_problems() == [told]


def test_no_driver_gives_no_reports(monkeypatch, tmp_path):
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path / "nothing"))
    assert selftest.probe_devices() == []
    assert selftest.main([]) == 1


@pytest.mark.parametrize(
    ("ids", "command"),
    [
        (["debian"], "apt-get install pocl-opencl-icd"),
        (["linuxmint", "ubuntu", "debian"], "apt-get install pocl-opencl-icd"),
        (["fedora"], "dnf install pocl"),
        (["opensuse-leap", "suse", "opensuse"], "zypper install pocl"),
        (["manjaro", "arch"], "pacman -S pocl"),
        (["darwin"], "brew install pocl"),
        (["nixos"], "conda-forge"),
    ],
)
def test_the_advice_fits_the_system(ids, command):
    assert command in driver_command(ids)


def test_set_up_stops_with_the_command_where_it_may_install_nothing(monkeypatch, capsys):
    monkeypatch.setenv("PSF_CL_NO_SYSTEM_INSTALL", "1")
    monkeypatch.setattr(set_up, "working_device", lambda: ("", ["P: D: wrong results"]))
    monkeypatch.setattr(set_up, "pip", lambda *arguments: 1)
    monkeypatch.setattr(set_up, "run", lambda command: pytest.fail(f"ran {command}"))
    monkeypatch.setattr("psf_cl.device.advice.system_ids", lambda: ["fedora"])
    with pytest.raises(SystemExit) as stop:
        set_up.ensure_device()
    output = capsys.readouterr()
    assert stop.value.code == 1
    assert "P: D: wrong results" in output.out
    assert "sudo dnf install pocl" in output.err


def test_set_up_takes_a_wheel_that_does_not_work_away_again(monkeypatch):
    done = []
    monkeypatch.setenv("PSF_CL_NO_SYSTEM_INSTALL", "1")
    monkeypatch.setattr(set_up, "working_device", lambda: ("", ["broken"]))
    monkeypatch.setattr(set_up, "pip", lambda *arguments: done.append(arguments[0]) or 0)
    with pytest.raises(SystemExit):
        set_up.ensure_device()
    assert done == ["install", "uninstall"]
