"""Sources to programs to launches: includes expanded here, arguments bound by name and checked."""

from __future__ import annotations

import re
import time
import warnings
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl

from psf_cl.device.device import Buffer, Device
from psf_cl.device.index_checks import checked_source
from psf_cl.device.layout import RECORDS
from psf_cl.device.sources import kernel_folder
from psf_cl.errors import DeviceError

_INCLUDE = re.compile(r'^\s*#\s*include\s+"([^"]+)"\s*$')
_SCALARS: dict[str, type[np.generic]] = {
    "float": np.float32,
    "int": np.int32,
    "uint": np.uint32,
    "ulong": np.uint64,
    "uchar": np.uint8,
    "ushort": np.uint16,
}
#: Room for a record of every kind.
_WARM_UP_BYTES = 4096
# No warnings: they would stand between the renderer's own lines, and compilers for CPUs whose
# registers hold less than 16 floats warn of every function that takes vectors of 16.
_BUILD_OPTIONS = ("-cl-std=CL1.2", "-cl-kernel-arg-info", "-w")
# Some compilers say something even so, as Intel's that it has begun.
warnings.filterwarnings("ignore", category=cl.CompilerWarning)


def assemble(file: str, folder: Path | None = None) -> str:
    """Return the text of ``file`` with every ``#include "x"`` expanded once.

    An include inside an ``#if`` is refused: the one place where it is expanded might be cut away.
    Drivers cache by source text, so the text has to hold all that it depends on; ``#line`` at each
    seam makes build errors name the real file and line.
    """
    folder = (folder or kernel_folder()).resolve()
    seen: set[Path] = set()

    def expand(path: Path) -> list[str]:
        seen.add(path)
        inside = path.is_relative_to(folder)
        shown = f"cl/{path.relative_to(folder).as_posix()}" if inside else path.name
        lines = [f'#line 1 "{shown}"']
        conditions = 0
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if "#" not in line:
                lines.append(line if line.strip() else "")
                continue
            conditions += bool(re.match(r"\s*#\s*if", line)) - bool(re.match(r"\s*#\s*endif", line))
            match = _INCLUDE.match(line)
            if match and conditions:
                raise DeviceError(f"{shown}:{number}: an include inside a condition")
            if match is None:
                # Includes are expanded once anyway; compilers warn of the pragma in a main file.
                lines.append("" if line.strip() == "#pragma once" else line)
                continue
            target = (path.parent / match.group(1)).resolve()
            if not target.is_file():
                raise DeviceError(f"{shown}:{number}: no file {match.group(1)}")
            if target in seen:
                lines.append("")
                continue
            lines += expand(target)
            lines.append(f'#line {number + 1} "{shown}"')
        return lines

    return "\n".join(expand((folder / file).resolve())) + "\n"


class Program:
    """One built source file.

    Attributes:
        file: the ``.cl`` file.
        defines: every macro that it was built with.
        is_warm: whether it was warmed up.
        seconds: that building took, down to machine code where it was warmed up.
        idle: kernels by name whose launches are gone, for the next ones.
    """

    def __init__(
        self, device: Device, file: str, defines: dict[str, int], folder: Path | None
    ) -> None:
        self.device = device
        self.file = file
        self.defines = defines
        options = [
            *_BUILD_OPTIONS,
            *(f"-D{name}={value}" for name, value in sorted(defines.items())),
        ]
        source = assemble(file, folder)
        if device.guard_bytes:
            source, files = checked_source(source)
            device.site_files |= files
        start = time.perf_counter()
        try:
            self.program = cl.Program(device.context, source).build(options=options)
        except cl.RuntimeError as error:
            raise DeviceError(f"{file} does not build on {device.name}: {error}") from error
        self.seconds = time.perf_counter() - start
        self.is_warm = False
        self.idle: dict[str, list[cl.Kernel]] = {}
        self._parameters: dict[str, list[tuple[str, str, bool]]] = {}

    def kernel(self, name: str) -> cl.Kernel:
        """Return a kernel that nobody else uses; its arguments have to be set, all of them.

        One of a launch that is gone, if there is any: each that pyopencl makes costs a millisecond
        and some memory that it never gives back, for it writes Python code for it.
        """
        try:
            return self.idle[name].pop()
        except (KeyError, IndexError):
            return cl.Kernel(self.program, name)

    def parameters(self, name: str) -> list[tuple[str, str, bool]]:
        """Return name, type and whether it is a pointer of each of a kernel's parameters."""
        if name not in self._parameters:
            kernel = self.kernel(name)
            self._parameters[name] = parameters_of(kernel)
            self.give_back(name, kernel)
        return self._parameters[name]

    def give_back(self, name: str, kernel: cl.Kernel) -> None:
        """Keep a kernel that is not used any more."""
        self.idle.setdefault(name, []).append(kernel)

    def warm_up(self, *kernels: str) -> None:
        """Launch ``kernels`` once on zeros, for PoCL generates code at the first launch.

        Only for kernels that do nothing where all their parameters are 0.  Uses a queue of its own
        and waits for it, so that another thread can go on with the device's.
        """
        device = self.device
        start = time.perf_counter()
        with device.failures(f"warming up {self.file}"):
            queue = cl.CommandQueue(device.context)
            zeros = device.memory(_WARM_UP_BYTES)
            cl.enqueue_fill_buffer(queue, zeros, np.uint8(0), 0, _WARM_UP_BYTES)
            for name in kernels:
                kernel = self.kernel(name)
                for index, (_, spelled, pointer) in enumerate(self.parameters(name)):
                    kernel.set_arg(index, zeros if pointer else _SCALARS[spelled](0))
                group = device.traits.group
                cl.enqueue_nd_range_kernel(queue, kernel, (group,), (group,))
                self.give_back(name, kernel)
            queue.finish()
        self.is_warm = True
        self.seconds += time.perf_counter() - start

    def bind(self, kernel: str, **arguments: Buffer | int | float | np.generic) -> Launch:
        """Return a launch of ``kernel`` with its arguments set by name.

        Raises:
            TypeError: an argument is missing, unknown, or of another type than the kernel's.
        """
        return Launch(self, kernel, arguments)

    def bind_planned(
        self, kernel: str, buffers: Mapping[str, Buffer], **scalars: int | float
    ) -> Launch:
        """Return a launch of ``kernel`` whose arguments are the ``buffers`` of the same names.

        Raises:
            TypeError: the kernel wants something that is not among them.
        """
        names = [name for name, _, _ in self.parameters(kernel)]
        given = {name: buffers[name] for name in names if name in buffers}
        return self.bind(kernel, **given, **scalars)


def parameters_of(kernel: cl.Kernel) -> list[tuple[str, str, bool]]:
    """Return name, type and whether it is a pointer of each of a kernel's parameters."""
    info = cl.kernel_arg_info
    return [
        (
            kernel.get_arg_info(index, info.NAME),
            kernel.get_arg_info(index, info.TYPE_NAME).replace(" ", ""),
            kernel.get_arg_info(index, info.ADDRESS_QUALIFIER)
            != cl.kernel_arg_address_qualifier.PRIVATE,
        )
        for index in range(kernel.num_args)
    ]


def load_program(
    device: Device, file: str, defines: dict[str, int] | None = None, folder: Path | None = None
) -> Program:
    """Return ``file`` built with ``defines``; a device builds each combination once.

    The lane width and the block of the pool are defined for every program.
    """
    traits = device.traits
    values = {"W": traits.lanes, "BLOCK": traits.block, "RUN": traits.run} | {
        name: int(value) for name, value in (defines or {}).items()
    }
    key = (file, folder, tuple(sorted(values.items())))
    if key not in device.programs:
        device.programs[key] = Program(device, file, values, folder)
    return device.programs[key]


class Launch:
    """A kernel with its arguments; calling it only enqueues.

    ``launch(items)`` runs ``items`` work items, rounded up to whole groups: kernels bound-check.
    """

    def __init__(
        self, program: Program, name: str, arguments: dict[str, Buffer | int | float | np.generic]
    ) -> None:
        self.device = program.device
        self.name = name
        self.stage = Path(program.file).stem
        self.label = f"{program.file}: {name}"
        try:
            # A kernel object holds its arguments, so each binding has its own.
            self.kernel = program.kernel(name)
        except cl.LogicError as error:
            raise TypeError(f"{self.label}: no such kernel") from error
        self.parameters = {
            name: (index, spelled, pointer)
            for index, (name, spelled, pointer) in enumerate(program.parameters(name))
        }
        # What still runs has arguments of its own.
        weakref.finalize(self, program.give_back, name, self.kernel).atexit = False
        missing = self.parameters.keys() - arguments.keys()
        if missing:
            raise TypeError(f"{self.label}: missing {', '.join(sorted(missing))}")
        # The queue does not keep what a kernel points to: the launch does.
        self.held: dict[str, Any] = {}
        self.set(**arguments)

    def set(self, **arguments: Buffer | int | float | np.generic) -> Launch:
        """Change arguments; returns the launch."""
        for name, value in arguments.items():
            if name not in self.parameters:
                raise TypeError(
                    f"{self.label}: no argument {name}; has {', '.join(self.parameters)}"
                )
            index, spelled, pointer = self.parameters[name]
            self.kernel.set_arg(index, self._converted(name, value, spelled, pointer))
            self.held[name] = value
        return self

    def _converted(self, name: str, value: Any, spelled: str, pointer: bool) -> Any:
        if pointer:
            if not isinstance(value, Buffer):
                raise TypeError(f"{self.label}: {name} is {spelled}, got {type(value).__name__}")
            wanted = _type_name(value.dtype)
            base = spelled.rstrip("*")
            # float16* and the like are views of floats.
            if (
                wanted != base
                and wanted != re.sub(r"\d+$", "", base)
                and base not in ("void", "uchar")
            ):
                raise TypeError(f"{self.label}: {name} is {spelled}, got a buffer of {wanted}")
            return value.memory
        if spelled not in _SCALARS:
            raise TypeError(f"{self.label}: {name} has the unsupported type {spelled}")
        scalar = _SCALARS[spelled]
        if isinstance(value, int | np.integer):
            if spelled != "float" and not np.iinfo(scalar).min <= value <= np.iinfo(scalar).max:
                raise TypeError(f"{self.label}: {name} is {spelled}, got {value}")
        elif spelled != "float" or not isinstance(value, float | np.floating):
            raise TypeError(f"{self.label}: {name} is {spelled}, got {type(value).__name__}")
        return scalar(value)

    def __call__(self, items: int, group: int | None = None) -> None:
        """Enqueue ``items`` work items (0 does nothing)."""
        if items <= 0:
            return
        group = group or self.device.traits.group
        padded = -(-items // group) * group
        with self.device.failures(self.label):
            event = cl.enqueue_nd_range_kernel(self.device.queue, self.kernel, (padded,), (group,))
        self.device.note_event(self.stage, self.name, items, event)


def _type_name(dtype: np.dtype[Any]) -> str:
    for record in RECORDS:
        if dtype == record.dtype:
            return record.name
    names = {np.dtype(scalar): name for name, scalar in _SCALARS.items()}
    return names.get(dtype, str(dtype))
