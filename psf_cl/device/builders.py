"""Build programs in several processes: for drivers that compile one kernel at a time and keep them.

PoCL compiles under one lock, so threads gain nothing, but what it has built lies in a folder that
all processes share.  ``python -m psf_cl.device.builders`` builds what it is told on standard input,
one JSON line a program, and answers each with a line.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pyopencl as cl

from psf_cl.device.device import Device, list_devices
from psf_cl.device.program import Program, load_program
from psf_cl.errors import DeviceError
from psf_cl.traits import DeviceTraits

#: Processes besides this one; more would wait for the program that takes longest.
MOST_BUILDERS = 3

# Code that is there already loads in a tenth of the time that its source takes to look through;
# code that has to be made takes at least as long.
_COLD_RATIO = 1.0 / 3.0

_BUILT, _FAILED = "built", "failed"


@dataclass(frozen=True)
class Wanted:
    """A program that is to be built down to machine code.

    Attributes:
        kernels: those to warm up; all of them do nothing where their parameters are 0.
    """

    file: str
    defines: dict[str, int]
    kernels: tuple[str, ...]


def builders_for(device: Device) -> int:
    """Return how many processes besides this one are worth having to build programs."""
    if device.cl_device.platform.name != "Portable Computing Language":
        return 0
    processors = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    return min(processors - 1, MOST_BUILDERS)


def build_programs(device: Device, wanted: Sequence[Wanted]) -> list[Program]:
    """Return the programs, ready to run.

    As soon as one turns out not to be in the driver's cache, ``device.builders`` processes take
    others off the end of the list.  One that fails leaves its program to this process.

    Raises:
        DeviceError: a program does not build.
    """
    waiting = deque(wanted)
    helpers: list[_Helper] = []
    try:
        while waiting:
            is_cold = _build(device, waiting.popleft())
            if is_cold and not helpers:
                # One after the other, for systems that have no room for more.
                with contextlib.suppress(OSError):
                    for _ in range(min(device.builders, len(waiting))):
                        helpers.append(_Helper(device, waiting))
        for helper in helpers:
            helper.thread.join()
    finally:
        for helper in helpers:
            helper.end()
    for each in wanted:
        _build(device, each)
    return [load_program(device, each.file, each.defines) for each in wanted]


def _build(device: Device, wanted: Wanted) -> bool:
    """Build a program that is not yet; return whether the driver had to make its code."""
    program = load_program(device, wanted.file, wanted.defines)
    if program.is_warm:
        return False
    before = program.seconds
    program.warm_up(*wanted.kernels)
    return program.seconds - before > _COLD_RATIO * before


class _Helper:
    """A process that builds for ``device`` what a thread takes off the end of ``waiting``."""

    def __init__(self, device: Device, waiting: deque[Wanted]) -> None:
        package = str(Path(__file__).resolve().parents[2])
        paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
        self.process = subprocess.Popen(
            # -P: what lies in the current folder is not meant.
            [sys.executable, "-P", "-m", "psf_cl.device.builders"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
            # Ctrl-C is for this process.
            start_new_session=True,
        )
        _send(self.process, {"device": device.name, "traits": dataclasses.asdict(device.traits)})
        self.thread = threading.Thread(target=_keep_busy, args=(self.process, waiting), daemon=True)
        self.thread.start()

    def end(self) -> None:
        """End the process, whatever it is at, then the thread, which waits for its answers."""
        self.process.kill()
        self.thread.join()
        self.process.communicate()


def _send(process: subprocess.Popen[str], message: dict[str, object]) -> None:
    assert process.stdin is not None
    # A process that has ended is found out by its answer.
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write(json.dumps(message) + "\n")
        process.stdin.flush()


def _keep_busy(process: subprocess.Popen[str], waiting: deque[Wanted]) -> None:
    assert process.stdout is not None
    while True:
        try:
            wanted = waiting.pop()
        except IndexError:
            return
        _send(process, dataclasses.asdict(wanted))
        if process.stdout.readline().strip() != _BUILT:
            return


def main() -> int:
    """Build what standard input asks for until it ends; return 0."""
    # Drivers print to standard output too: answers have one of their own.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    head = json.loads(sys.stdin.readline())
    names = {f"{d.platform.name}: {d.name}".strip(): d for d in list_devices()}
    device = Device(cl.Context([names[head["device"]]]), DeviceTraits(**head["traits"]))
    for line in sys.stdin:
        wanted = Wanted(**json.loads(line))
        try:
            _build(device, wanted)
        except DeviceError:
            # Who asked builds it too, and says what is wrong.
            print(_FAILED, file=answers, flush=True)
            continue
        print(_BUILT, file=answers, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
