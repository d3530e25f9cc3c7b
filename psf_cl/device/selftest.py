"""Find out which OpenCL devices work: a small kernel has to give NumPy's answer.

A driver may be listed and yet unable to compile, give wrong numbers, crash the process or hang.  So
``probe_devices`` asks each device in a process of its own; ``python -m psf_cl.device.selftest``
prints what it finds, one JSON line a device.
"""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from psf_cl.errors import DeviceError

if TYPE_CHECKING:
    import pyopencl as cl

PROBE_SECONDS = 120.0

#: Memory that small pictures of small scenes take.
LEAST_BYTES = 128 << 20

_NO_DEVICE = "this platform has no device"

_GROUP = 64
_BINS = 13
_SOURCE = """
#define GROUP 64
#define BINS 13

// What floats a register holds, where the compiler is one for a CPU that says so; else 0.
#if defined(__AVX512F__)
#define REGISTER_FLOATS 16
#elif defined(__AVX__)
#define REGISTER_FLOATS 8
#else
#define REGISTER_FLOATS 0
#endif

/// What the renderer's kernels are made of: vectors of 16, fma, selects by mask, local memory
/// between barriers, integer atomics.  The last group is partly filled.
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void self_test(
    global const float *x,
    global float *y,
    volatile global uint *histogram,
    global uint *group_sums,
    global uint *register_floats,
    const uint count)
{
    local uint sums[GROUP];
    const uint i = get_global_id(0);
    const uint l = get_local_id(0);
    uint value = 0u;
    if (i < count) {
        const float16 v = vload16(i, x);
        const float16 w = fma(v, v, (float16)(-1.0f));
        vstore16(select(sqrt(fabs(w)), w, v < 1.0f), i, y);
        value = i * 2654435761u;
        atomic_add(&histogram[value % BINS], i);
    }
    sums[l] = value;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint step = GROUP / 2u; step > 0u; step /= 2u) {
        if (l < step)
            sums[l] += sums[l + step];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (l == 0u)
        group_sums[get_group_id(0)] = sums[0];
    if (i == 0u)
        *register_floats = REGISTER_FLOATS;
}
"""


@dataclass(frozen=True)
class SelfTest:
    """What the kernel found out about a device.

    Attributes:
        reason: one line on what is wrong; None if nothing is.
        register_floats: that a vector register of a CPU holds; 0 if the compiler does not say.
    """

    reason: str | None
    register_floats: int = 0


@dataclass(frozen=True)
class DeviceReport:
    """What one device answered.

    Attributes:
        platform, device, driver: names as the driver gives them.
        ok: whether it passed.
        reason: one line on why not; empty if ``ok``.
        seconds: what compiling and running the self-test took, 0 if it did not get there.
    """

    platform: str
    device: str
    driver: str
    ok: bool
    reason: str
    seconds: float


def run_self_test(
    device: cl.Device, context: cl.Context | None = None, anew: bool = False
) -> SelfTest:
    """Run the kernel on ``device`` in this process.

    Args:
        context: to run in, if it is to be used afterwards: PoCL takes most of a second to get ready
            for the first program that it compiles in a context.
        anew: compile even if the driver has the program in a cache, which hides that its compiler
            no longer works.
    """
    import pyopencl as cl

    for what, size, least in (
        ("of the device", device.global_mem_size, LEAST_BYTES),
        ("in one buffer", device.max_mem_alloc_size, LEAST_BYTES // 4),
    ):
        if size < least:
            return SelfTest(f"too little memory {what}: {size >> 20} MiB, {least >> 20} are needed")
    count = 1000
    group_count = -(-count // _GROUP)
    # Near 1 the square needs more bits than a float has: only a fused x * x - 1 is right there.
    x = (1.0 + np.arange(-8 * count, 8 * count) * 2.0**-23).astype(np.float32)
    y = np.empty_like(x)
    histogram = np.zeros(_BINS, np.uint32)
    group_sums = np.empty(group_count, np.uint32)
    register_floats = np.zeros(1, np.uint32)
    try:
        context = context or cl.Context([device])
        queue = cl.CommandQueue(context)
        flags = cl.mem_flags
        x_buffer = cl.Buffer(context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=x)
        y_buffer = cl.Buffer(context, flags.WRITE_ONLY, y.nbytes)
        histogram_buffer = cl.Buffer(
            context, flags.READ_WRITE | flags.COPY_HOST_PTR, hostbuf=histogram
        )
        sums_buffer = cl.Buffer(context, flags.WRITE_ONLY, group_sums.nbytes)
        floats_buffer = cl.Buffer(context, flags.WRITE_ONLY, register_floats.nbytes)
        options = ["-cl-std=CL1.2", "-w"] + [f"-DRUN={time.time_ns()}"] * anew
        try:
            program = cl.Program(context, _SOURCE).build(options=options, cache_dir=False)
        except cl.RuntimeError as error:
            return SelfTest(_one_line(f"cannot compile: {_complaint(str(error))}"))
        kernel = cl.Kernel(program, "self_test")
        kernel.set_args(
            x_buffer, y_buffer, histogram_buffer, sums_buffer, floats_buffer, np.uint32(count)
        )
        cl.enqueue_nd_range_kernel(queue, kernel, (group_count * _GROUP,), (_GROUP,))
        cl.enqueue_copy(queue, y, y_buffer)
        cl.enqueue_copy(queue, histogram, histogram_buffer)
        cl.enqueue_copy(queue, group_sums, sums_buffer)
        cl.enqueue_copy(queue, register_floats, floats_buffer)
        queue.finish()
    except cl.Error as error:
        return SelfTest(_one_line(str(error)))

    index = np.arange(count, dtype=np.uint32)
    value = index * np.uint32(2654435761)
    exact = x.astype(np.float64) ** 2 - 1.0
    padded = np.zeros(group_count * _GROUP, np.uint32)
    padded[:count] = value
    checks = {
        # A device may round its square root by a few units in the last place, and a fma not at all.
        "vector arithmetic": np.array_equal(y[x < 1.0], exact[x < 1.0].astype(np.float32))
        and np.allclose(y[x >= 1.0], np.sqrt(exact[x >= 1.0]), rtol=1e-6, atol=0.0),
        "atomic adds": np.array_equal(
            histogram, np.bincount(value % _BINS, weights=index, minlength=_BINS).astype(np.uint32)
        ),
        "local memory": np.array_equal(
            group_sums, padded.reshape(-1, _GROUP).sum(axis=1, dtype=np.uint32)
        ),
    }
    wrong = [name for name, right in checks.items() if not right]
    reason = f"wrong results: {', '.join(wrong)}" if wrong else None
    return SelfTest(reason, int(register_floats[0]))


def probe_devices() -> list[DeviceReport]:
    """Test every OpenCL device, each in its own process, in the loader's order.

    Raises:
        DeviceError: OpenCL could not even be asked which devices there are.
    """
    listed, failure = _child("--list")
    if listed is None:
        raise DeviceError(f"OpenCL does not start: {failure}")
    reports = []
    for platform_index, device_index, names in listed:
        if device_index is None:
            reports.append(DeviceReport(**names, ok=False, reason=_NO_DEVICE, seconds=0.0))
            continue
        answer, failure = _child(str(platform_index), str(device_index))
        if answer is None:
            answer = {**names, "ok": False, "reason": failure, "seconds": 0.0}
        reports.append(DeviceReport(**answer))
    return reports


def _child(*arguments: str) -> tuple[Any, str]:
    """Run this module in a fresh process; return its JSON answer, or None and why there is none."""
    command = [sys.executable, "-m", "psf_cl.device.selftest", *arguments]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=PROBE_SECONDS
        )
    except subprocess.TimeoutExpired:
        return None, f"no answer within {PROBE_SECONDS:.0f} s"
    if done.returncode < 0:
        return None, f"the driver crashed ({signal.Signals(-done.returncode).name})"
    lines = done.stdout.splitlines()
    if done.returncode != 0 or not lines:
        errors = done.stderr.strip().splitlines()
        return None, _one_line(errors[-1] if errors else f"exit code {done.returncode}")
    # Drivers print to standard output too; the answer is the last line.
    return json.loads(lines[-1]), ""


def _complaint(log: str) -> str:
    """Return the line of a compiler's log that says most."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    complaints = [line for line in lines if "error:" in line.lower()]
    return (complaints or lines or ["it does not say why"])[0]


def _one_line(text: str) -> str:
    return " ".join(text.split())[:300]


def _listed() -> list[tuple[int, int | None, dict[str, str]]]:
    """Return indices and names of all devices; no index of one where a platform has none."""
    import pyopencl as cl

    try:
        platforms = cl.get_platforms()
    except cl.LogicError:  # The loader's way to say that no driver is installed.
        return []
    found = []
    for platform_index, platform in enumerate(platforms):
        try:
            devices = platform.get_devices()
        except cl.Error:  # A platform without a device says so by an error.
            devices = []
        found += [(platform_index, index, _names(device)) for index, device in enumerate(devices)]
        if not devices:
            names = {"platform": platform.name, "device": "none", "driver": platform.version}
            found.append((platform_index, None, names))
    return found


def _names(device: cl.Device) -> dict[str, str]:
    return {
        "platform": device.platform.name.strip(),
        "device": device.name.strip(),
        "driver": f"{device.platform.version.strip()} / {device.driver_version.strip()}",
    }


def main(arguments: list[str]) -> int:
    """Print a JSON line per device; return 0 if one of them works, else 1.

    Args:
        arguments: empty; the child processes are told ``--list`` or platform and device index.
    """
    if arguments == ["--list"]:
        print(json.dumps(_listed()))
        return 0
    if arguments:
        import pyopencl as cl

        platform_index, index = (int(argument) for argument in arguments)
        device = cl.get_platforms()[platform_index].get_devices()[index]
        start = time.perf_counter()
        reason = run_self_test(device, anew=True).reason
        seconds = time.perf_counter() - start
        answer = _names(device) | {"ok": reason is None, "reason": reason or "", "seconds": seconds}
        print(json.dumps(answer))
        return 0
    try:
        reports = probe_devices()
    except DeviceError as error:
        print(error, file=sys.stderr)
        return 1
    for report in reports:
        print(json.dumps(dataclasses.asdict(report)))
    return 0 if any(report.ok for report in reports) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
