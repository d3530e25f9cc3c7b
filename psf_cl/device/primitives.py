"""Parallel primitives on buffers: scan, compaction, reduction and a stable radix sort."""

from __future__ import annotations

from typing import Any

import numpy as np

from psf_cl.device.device import Buffer, Device
from psf_cl.device.program import Launch, load_program

DIGIT_BITS = 8
_DIGITS = 1 << DIGIT_BITS

# Chunks are serial: a CPU wants some for each core, a GPU (not measured) some for each lane.
_CHUNK_LIMIT = {"cpu": 64, "gpu": 1024}
_CHUNK_GROUP = {"cpu": 1, "gpu": 64}
_SMALLEST_CHUNK = 256


class Primitives:
    """The primitives of one device, with the few KiB of scratch that they share.

    Everything is only enqueued.  Totals and bounds stay on the device, in buffers of this object
    that the next call overwrites.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.chunk_limit = _CHUNK_LIMIT[device.traits.kind]
        self.group = _CHUNK_GROUP[device.traits.kind]
        self.total = device.allocate("total", np.uint32, 1)
        self.bounds_found = device.allocate("bounds", np.float32, 6)
        self.sums = device.allocate("chunk sums", np.uint32, self.chunk_limit)
        self.partial = device.allocate("chunk bounds", np.float32, 6 * self.chunk_limit)
        self.table = device.allocate("digit counts", np.uint32, _DIGITS * self.chunk_limit)
        self.launches: dict[tuple[str, int], Launch] = {}

    def release(self) -> None:
        self.device.release(self.total, self.bounds_found, self.sums, self.partial, self.table)

    def scan(self, source: Buffer, target: Buffer, count: int) -> Buffer:
        """Write the exclusive prefix sums of ``count`` uint32 items; return their total (1 item).

        Sums are modulo 2^32.  ``target`` may be ``source``.
        """
        self.sum(source, count)
        items, chunks = self._chunks(count)
        self._launch(
            "scan_chunks",
            chunks,
            values=source,
            target=target,
            sums=self.sums,
            count=count,
            chunk_items=items,
            chunk_count=chunks,
        )
        return self.total

    def compact(self, flags: Buffer, ranks: Buffer, indices: Buffer, count: int) -> Buffer:
        """Write the indices of the set flags in order; return how many there are (1 item).

        Args:
            flags: uint32, each 0 or 1.
            ranks: uint32, ``count`` items, receives the exclusive prefix sums of the flags.
            indices: uint32, with room for every set flag.
        """
        self.scan(flags, ranks, count)
        launch = self._bound("scatter_set", flags=flags, ranks=ranks, indices=indices, count=count)
        launch(count, group=64)
        return self.total

    def sum(self, values: Buffer, count: int) -> Buffer:
        """Return the sum of ``count`` uint32 items, modulo 2^32 (1 item)."""
        items, chunks = self._chunks(count)
        self._launch(
            "sum_chunks",
            chunks,
            values=values,
            sums=self.sums,
            count=count,
            chunk_items=items,
            chunk_count=chunks,
        )
        self._launch("scan_sums", 1, sums=self.sums, total=self.total, chunk_count=chunks)
        return self.total

    def bounds(self, points: Buffer, count: int) -> Buffer:
        """Return low x, y, z and high x, y, z of ``count`` points (6 float32 items).

        NaN components are left out; bounds of nothing are +inf to -inf.

        Args:
            points: float32, three items a point.
        """
        items, chunks = self._chunks(count)
        self._launch(
            "bound_chunks",
            chunks,
            points=points,
            partial=self.partial,
            count=count,
            chunk_items=items,
            chunk_count=chunks,
        )
        self._launch(
            "join_bounds", 6, partial=self.partial, bounds=self.bounds_found, chunk_count=chunks
        )
        return self.bounds_found

    def sort(
        self,
        keys: Buffer,
        values: Buffer,
        spare_keys: Buffer,
        spare_values: Buffer,
        count: int,
        key_bits: int | None = None,
    ) -> tuple[Buffer, Buffer]:
        """Sort by key, stably; return the buffers that hold sorted keys and their values.

        These are the first two or the spare two; the contents of the others are lost.

        Args:
            keys: uint32 or uint64.
            values: uint32, carried along.
            key_bits: how many low bits of the keys count, at least 1; all of them if None.  They
                are rounded up to whole digits, so higher bits of the keys must be 0.
        """
        width = 8 * keys.dtype.itemsize
        items, chunks = self._chunks(count)
        chunking: dict[str, Any] = {
            "count": count,
            "chunk_items": items,
            "chunk_count": chunks,
            "table": self.table,
        }
        for shift in range(0, min(key_bits or width, width), DIGIT_BITS):
            self._launch("count_digits", chunks, width, keys=keys, shift=shift, **chunking)
            self.scan(self.table, self.table, _DIGITS * chunks)
            self._launch(
                "scatter_digits",
                chunks,
                width,
                keys=keys,
                values=values,
                sorted_keys=spare_keys,
                sorted_values=spare_values,
                shift=shift,
                **chunking,
            )
            keys, values, spare_keys, spare_values = spare_keys, spare_values, keys, values
        return keys, values

    def _chunks(self, count: int) -> tuple[int, int]:
        """Return items of a chunk and the number of chunks, 0 for no items."""
        items = max(-(-count // self.chunk_limit), _SMALLEST_CHUNK)
        return items, -(-count // items)

    def _launch(self, kernel: str, items: int, key_bits: int = 0, **arguments: Any) -> None:
        self._bound(kernel, key_bits, **arguments)(items, group=self.group)

    def _bound(self, kernel: str, key_bits: int = 0, **arguments: Any) -> Launch:
        """Return the kernel's one launch with these arguments; an enqueued one keeps its own."""
        launch = self.launches.get((kernel, key_bits))
        if launch is not None:
            return launch.set(**arguments)
        if key_bits:
            program = load_program(self.device, "sort.cl", {"KEY_BITS": key_bits})
        else:
            program = load_program(self.device, "primitives.cl")
        launch = self.launches[kernel, key_bits] = program.bind(kernel, **arguments)
        return launch
