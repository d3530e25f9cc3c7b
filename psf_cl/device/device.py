"""Device: one OpenCL device with its queue and memory; all copies and waits of a render."""

from __future__ import annotations

import contextlib
import os
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl as cl

from psf_cl.device.index_checks import HEADER_WORDS, header_of, violation_in
from psf_cl.device.selftest import SelfTest, run_self_test
from psf_cl.errors import DeviceError, InputError, NoRoomError
from psf_cl.measure.timing import TRANSFER, Interval, Spent
from psf_cl.settings import DEVICE_VARIABLE
from psf_cl.traits import DeviceTraits

if TYPE_CHECKING:
    from psf_cl.device.program import Program


#: Environment variable: 1 puts bytes behind every buffer that no kernel may change, and has kernels
#: check the indices of what they access.
GUARD_VARIABLE = "PSF_CL_GUARDS"
_GUARD_BYTES = 4096
# As a float it is not a number: reading behind an end shows in the image.
_GUARD = 0xFF


@dataclass(frozen=True)
class Buffer:
    """Device memory with the type of its items.

    Attributes:
        dtype: NumPy type of one item; a structured type for records.
        count: items, at least 1 (OpenCL has no empty buffers).
    """

    name: str
    dtype: np.dtype[Any]
    count: int
    memory: cl.Buffer

    @property
    def bytes(self) -> int:
        return self.count * self.dtype.itemsize

    def release(self) -> None:
        self.memory.release()


class Device:
    """An in-order queue on the one device of a context.

    Nothing here is global: several of them live side by side.

    Attributes:
        traits: what the kernels are specialised to.
        builders: processes that may build programs beside this one.
        profiling: whether every command keeps its event until it is collected.
        totals: what was spent on each kernel so far, by its name (profiling only).
        on_intervals: called with the commands that are done, each time that they are collected.
    """

    def __init__(self, context: cl.Context, traits: DeviceTraits, profiling: bool = False) -> None:
        self.context = context
        self.cl_device = context.devices[0]
        self.traits = traits
        self.builders = 0
        self.profiling = profiling
        flags = cl.command_queue_properties.PROFILING_ENABLE if profiling else 0
        self.queue = cl.CommandQueue(self.context, properties=flags)
        # 0: no guards, and sources as they are.
        self.guard_bytes = _GUARD_BYTES if os.environ.get(GUARD_VARIABLE) == "1" else 0
        # Of checked sources, by number.
        self.site_files: dict[int, str] = {}
        self.checked: weakref.WeakSet[Buffer] = weakref.WeakSet()
        self.allocated_bytes = 0
        self.peak_bytes = 0
        self.programs: dict[tuple[Any, ...], Program] = {}
        self.events: list[tuple[str, str, int, cl.Event]] = []
        self.totals: dict[str, Spent] = {}
        self.on_intervals: Callable[[list[Interval]], None] | None = None

    @property
    def name(self) -> str:
        return f"{self.cl_device.platform.name}: {self.cl_device.name}".strip()

    @property
    def memory_bytes(self) -> int:
        return self.cl_device.global_mem_size

    @property
    def largest_buffer(self) -> int:
        """Return the bytes that the device allows in one buffer."""
        return self.cl_device.max_mem_alloc_size

    @property
    def driver(self) -> str:
        return f"{self.cl_device.platform.version} / {self.cl_device.driver_version}".strip()

    def allocate(self, name: str, dtype: Any, count: int) -> Buffer:
        """Return a zero-filled buffer of ``count`` (at least 1) items.

        Raises:
            NoRoomError: the device has no room for it.
        """
        dtype = np.dtype(dtype)
        count = max(int(count), 1)
        size = count * dtype.itemsize
        limit = self.largest_buffer
        if size > limit:
            raise NoRoomError(
                f"{name} needs {size / 2**20:.0f} MiB; "
                f"{self.name} allows {limit / 2**20:.0f} MiB in one buffer"
            )
        try:
            with self.failures(f"allocating {size / 2**20:.0f} MiB for {name}"):
                memory = self.memory(size)
                # A pattern of one byte divides every size.
                event = cl.enqueue_fill_buffer(self.queue, memory, np.uint8(0), 0, size)
                if self.guard_bytes:
                    cl.enqueue_fill_buffer(
                        self.queue, memory, np.uint8(_GUARD), size, self.guard_bytes
                    )
        except DeviceError as error:
            raise NoRoomError(str(error)) from error
        self.note_event(TRANSFER, f"clear {name}", size, event)
        self.allocated_bytes += size
        self.peak_bytes = max(self.peak_bytes, self.allocated_bytes)
        buffer = Buffer(name, dtype, count, memory)
        if self.guard_bytes:
            self.checked.add(buffer)
        return buffer

    def memory(self, size: int) -> cl.Buffer:
        """Return memory of ``size`` bytes; guarded, it has a header before it and more behind it.

        Raises:
            cl.Error: the driver has none.
        """
        flags = cl.mem_flags.READ_WRITE
        # PoCL allocates on first use, where failing ends the process; but this at once.
        at_once = flags | cl.mem_flags.ALLOC_HOST_PTR if self.traits.kind == "cpu" else flags
        if not self.guard_bytes:
            return cl.Buffer(self.context, at_once, size)
        origin = self._header_bytes
        whole = cl.Buffer(self.context, at_once, origin + size + self.guard_bytes)
        header = header_of(size)
        cl.enqueue_copy(self.queue, whole, header, dst_offset=origin - header.nbytes)
        return whole.get_sub_region(origin, size + self.guard_bytes, flags)

    @property
    def _header_bytes(self) -> int:
        return max(self.cl_device.mem_base_addr_align // 8, 4 * HEADER_WORDS)

    def upload(self, name: str, array: np.ndarray) -> Buffer:
        """Return a buffer that holds a copy of ``array`` (flattened)."""
        array = np.ascontiguousarray(array)
        buffer = self.allocate(name, array.dtype, array.size)
        self.write(buffer, array)
        return buffer

    def write(self, buffer: Buffer, array: np.ndarray, offset: int = 0) -> None:
        """Copy ``array`` into ``buffer`` from item ``offset`` on; returns when it is copied."""
        array = np.ascontiguousarray(array)
        if array.dtype != buffer.dtype or offset + array.size > buffer.count:
            raise ValueError(
                f"{buffer.name}: {array.size} items of {array.dtype} at {offset} do not fit "
                f"{buffer.count} of {buffer.dtype}"
            )
        if array.size:
            with self.failures(f"writing {buffer.name}"):
                event = cl.enqueue_copy(
                    self.queue, buffer.memory, array, dst_offset=offset * buffer.dtype.itemsize
                )
            self.note_event(TRANSFER, f"write {buffer.name}", array.nbytes, event)

    def read(self, buffer: Buffer, count: int | None = None, offset: int = 0) -> np.ndarray:
        """Return items of ``buffer`` after all queued work is done."""
        count = buffer.count - offset if count is None else count
        if offset + count > buffer.count:
            raise ValueError(f"{buffer.name}: {count} items at {offset} of {buffer.count}")
        array = np.empty(count, buffer.dtype)
        if count:
            with self.failures(f"reading {buffer.name}"):
                event = cl.enqueue_copy(
                    self.queue, array, buffer.memory, src_offset=offset * buffer.dtype.itemsize
                )
            self.note_event(TRANSFER, f"read {buffer.name}", array.nbytes, event)
        self.check_indices(*self.checked)
        return array

    def fill(self, buffer: Buffer, byte: int = 0) -> None:
        """Enqueue setting every byte of ``buffer``."""
        with self.failures(f"filling {buffer.name}"):
            event = cl.enqueue_fill_buffer(
                self.queue, buffer.memory, np.uint8(byte), 0, buffer.bytes
            )
        self.note_event(TRANSFER, f"fill {buffer.name}", buffer.bytes, event)

    def release(self, *buffers: Buffer) -> None:
        """Give buffers back; using one afterwards is an error.

        Raises:
            DeviceError: guards are on, and what lies behind a buffer was changed, or a kernel
                wanted an item that it does not have.
        """
        broken = [buffer.name for buffer in buffers if not self._guard_is_whole(buffer)]
        try:
            self.check_indices(*buffers)
        finally:
            for buffer in buffers:
                self.allocated_bytes -= buffer.bytes
                self.checked.discard(buffer)
                buffer.release()
        if broken:
            raise DeviceError(f"a kernel wrote behind the end of {', '.join(broken)}")

    def check_indices(self, *buffers: Buffer) -> None:
        """Look for indices that were too large, as kernels noted them if guards are on.

        Raises:
            DeviceError: there was one.
        """
        if not self.guard_bytes:
            return
        for buffer in buffers:
            header = np.empty(HEADER_WORDS, np.uint32)
            start = self._header_bytes - header.nbytes
            with self.failures(f"reading the header of {buffer.name}"):
                whole = buffer.memory.associated_memobject
                cl.enqueue_copy(self.queue, header, whole, src_offset=start)
            found = violation_in(header)
            if found is not None:
                file, line = self.site_files.get(found.site >> 16), found.site & 0xFFFF
                raise DeviceError(
                    f"a kernel wanted item {found.index} of {found.size} bytes of {buffer.name}, "
                    f"which has {buffer.bytes} bytes, at {file}:{line}; {found.count} such accesses"
                )

    def _guard_is_whole(self, buffer: Buffer) -> bool:
        if not self.guard_bytes:
            return True
        guard = np.empty(self.guard_bytes, np.uint8)
        with self.failures(f"reading behind {buffer.name}"):
            cl.enqueue_copy(self.queue, guard, buffer.memory, src_offset=buffer.bytes)
        return bool((guard == _GUARD).all())

    def wait(self) -> None:
        """Wait for everything queued.

        Raises:
            DeviceError: the device failed while it worked.
        """
        with self.failures("waiting"):
            self.queue.finish()

    @contextlib.contextmanager
    def failures(self, what: str) -> Iterator[None]:
        """Turn the driver's errors into a DeviceError that says ``what`` was being done.

        Drivers may report what went wrong at any later call: all calls are made in here.
        """
        try:
            yield
        except cl.Error as error:
            raise DeviceError(f"{self.name} failed at {what}: {error}") from error

    def note_event(self, stage: str, name: str, items: int, event: cl.Event) -> None:
        """Keep the event of a command (profiling only); the arguments are those of ``Interval``."""
        if not self.profiling:
            return
        if isinstance(event, cl.NannyEvent):
            # It holds on to the host's array, which a second handle of the event does not.
            event = cl.Event.from_int_ptr(event.int_ptr)
        self.events.append((stage, name, items, event))

    def collect_events(self) -> None:
        """Add the commands so far to ``totals`` and report them; call after everything is done."""
        info = cl.profiling_info
        intervals = [
            Interval(
                stage,
                name,
                items,
                event.get_profiling_info(info.QUEUED),
                event.get_profiling_info(info.START),
                event.get_profiling_info(info.END),
            )
            for stage, name, items, event in self.events
        ]
        self.events.clear()
        for interval in intervals:
            if interval.stage != TRANSFER:
                self.totals.setdefault(interval.name, Spent()).add(interval)
        if self.on_intervals is not None:
            self.on_intervals(intervals)

    def copy_bandwidth(self, size: int = 1 << 28, repetitions: int = 5) -> float:
        """Return the bytes a second, read and written, at which the device copies ``size`` bytes.

        The median of some copies from one buffer to another; for a device that profiles.
        """
        size = min(size, self.memory_bytes // 8, self.cl_device.max_mem_alloc_size)
        source = self.allocate("copied", np.uint8, size)
        target = self.allocate("copy", np.uint8, size)
        seconds = []
        try:
            with self.failures("measuring copies"):
                for _ in range(repetitions):
                    event = cl.enqueue_copy(self.queue, target.memory, source.memory)
                    event.wait()
                    seconds.append((event.profile.end - event.profile.start) * 1e-9)
        finally:
            self.release(source, target)
        return 2 * size / float(np.median(seconds))


def list_devices() -> list[cl.Device]:
    """Return every OpenCL device, in the loader's order.

    Raises:
        DeviceError: there is no OpenCL platform.
    """
    try:
        platforms = cl.get_platforms()
    except cl.LogicError as error:
        raise DeviceError("no OpenCL platform found; psf-cl doctor says how to get one") from error
    devices = []
    for platform in platforms:
        try:
            devices += platform.get_devices()
        except cl.Error:  # A platform without a device reports an error; others may have one.
            continue
    return devices


def _rank(device: cl.Device) -> int:
    # Types are bits: a device may also be the platform's default.
    if device.type & cl.device_type.GPU:
        return 0
    return 1 if device.type & cl.device_type.ACCELERATOR else 2


def open_device(
    text: str | None = None, traits: DeviceTraits | None = None, profiling: bool = False
) -> Device:
    """Open the device that ``text`` names, else ``$PSF_CL_DEVICE``, else the best that works.

    A device is taken only after the self-test kernel gave the right answer on it.  Without a name,
    GPUs come first, then accelerators, then CPUs, each in the loader's order.

    Args:
        text: part of "platform: device", case-insensitive.
        traits: overrides what is known of the kind of device (tests of lane widths).

    Raises:
        InputError: no device has that name.
        DeviceError: none works.
    """
    source = "--device"
    if text is None:
        text, source = os.environ.get(DEVICE_VARIABLE) or None, DEVICE_VARIABLE
    devices = list_devices()
    names = [f"{device.platform.name}: {device.name}".strip() for device in devices]
    if text is not None:
        chosen = [d for d, name in zip(devices, names, strict=True) if text.lower() in name.lower()]
        if not chosen:
            raise InputError(
                f"{source}: no device matches {text!r}; there are: {'; '.join(names) or 'none'}"
            )
        devices = chosen
    devices.sort(key=_rank)
    failures = []
    for device in devices:
        try:
            context = cl.Context([device])
            found = run_self_test(device, context)
        except cl.Error as error:
            found = SelfTest(str(error))
        if found.reason is None:
            kind = "cpu" if device.type & cl.device_type.CPU else "gpu"
            # Drivers say a width too, but PoCL's may be that of the machine it was built on.
            floats = found.register_floats or device.native_vector_width_float
            traits = traits or DeviceTraits.of_kind(kind, floats)
            return Device(context, traits, profiling)
        failures.append(f"{device.platform.name}: {found.reason}")
    raise DeviceError(
        "no OpenCL device passes the self-test"
        + (f" ({'; '.join(failures)})" if failures else "")
        + "; psf-cl doctor says what to do"
    )
