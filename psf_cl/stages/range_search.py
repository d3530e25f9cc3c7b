"""Range search: path space filtering by balls around vertices, the baseline of the cells."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from psf_cl.device import layout
from psf_cl.stages.cells import sample_buffers
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec

if TYPE_CHECKING:
    from collections.abc import Mapping

    from psf_cl.device.device import Buffer, Device
    from psf_cl.device.primitives import Primitives
    from psf_cl.device.program import Program

#: Words of a vertex in the order of the grid, as planes.
PLANES = 8

#: Vertices whose balls one launch averages: short enough for devices that stop long ones.
BATCH = 1 << 14

#: Pixels that work items of the kernels of a pixel each take in a group.
GROUP = 64


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if paths are not filtered this way."""
    if not (context.on("CELLS") and context.range_search):
        return None
    pixels, uint32, uint64 = context.pixel_count, np.dtype(np.uint32), np.dtype(np.uint64)
    planes = PLANES * pixels + context.traits.lanes
    sample_bytes = layout.BEYOND.dtype.itemsize + layout.CELL_VERTEX.dtype.itemsize
    buffers = (
        *sample_buffers(context),
        BufferSpec("places", uint64, pixels, "cells of the grid that vertices are in", True),
        BufferSpec("spare_places", uint64, pixels, "for sorting", True),
        BufferSpec("order", uint32, pixels, "pixels in the order of the grid", True),
        BufferSpec("spare_order", uint32, pixels, "for sorting", True),
        BufferSpec("close", np.dtype(np.float32), planes, "vertices in that order", True),
    )
    kernels = (
        KernelSpec("find_radii", record_bytes=sample_bytes + 8, per_sample=True),
        KernelSpec("find_places", record_bytes=12 + 12, per_sample=True, lanes=False),
        KernelSpec("lay_out_close", record_bytes=sample_bytes + 4 + 4 * PLANES, per_sample=True),
        KernelSpec("average_close", record_bytes=4 * PLANES + 36, per_sample=True, lanes=False),
        KernelSpec("add_unfiltered", lanes=False),
    )
    return StageSpec(
        "range_search",
        "light is shared by the paths whose vertices are close to one another",
        "range_search.cl",
        flags=("BASE", "CELLS"),
        kernels=kernels,
        buffers=buffers,
        per_pass=True,
    )


class RangeSearch:
    """Filters complete passes, one after the other; the host looks which these are."""

    def __init__(
        self,
        device: Device,
        program: Program,
        buffers: Mapping[str, Buffer],
        primitives: Primitives,
        pixels: int,
        ring: int,
    ) -> None:
        """Bind the kernels; ``primitives`` become this object's own."""
        self.device, self.buffers, self.primitives = device, buffers, primitives
        self.pixels, self.ring, self.lanes = pixels, ring, device.traits.lanes
        self.find_radii = program.bind_planned("find_radii", buffers, **{"pass": 0})
        names = {"pass": 0, "inverse": 1.0}
        self.find_places = program.bind_planned("find_places", buffers, **names)
        self.lay_out = program.bind_planned("lay_out_close", buffers, **{"pass": 0, "count": 0})
        more = {"first": 0, "count": 0, "total": 0}
        self.average_close = program.bind_planned("average_close", buffers, **names, **more)
        # What sorts is built now, not in the first pass.
        self._sort(1)

    def release(self) -> None:
        self.primitives.release()

    def filter_passes(self, counters: np.ndarray) -> None:
        """Add the averages to the samples of every pass that is complete."""
        index, ring = layout.COUNTER_INDEX, self.ring
        first, limit = int(counters[index["film_pass"]]), int(counters[index["pass_limit"]])
        for number in range(first, min(first + ring, limit)):
            finished = counters[index["finished"] + (number & (ring - 1))]
            if finished != self.pixels:
                break
            count, inverse = self.prepare(number)
            for start in range(0, count, BATCH):
                self.average(number, count, inverse, start)

    def prepare(self, number: int) -> tuple[int, float]:
        """Sort the vertices of pass ``number``; return how many, and cells of the grid per m."""
        pixels, buffers = self.pixels, self.buffers
        blocks = -(-pixels // self.lanes)
        self.find_radii.set(**{"pass": number})(blocks, GROUP)
        count = int(self.device.read(self.primitives.sum(buffers["order"], pixels))[0])
        if count == 0:
            return 0, 1.0
        exponents = int(self.device.read(self.primitives.sum(buffers["spare_order"], pixels))[0])
        # As wide as the balls of most, by the mean of their exponents.
        inverse = float(2.0 ** (126 - min(max(exponents // count, 1), 253)))
        self.find_places.set(**{"pass": number}, inverse=inverse)(pixels, GROUP)
        places, order = self._sort(pixels)
        self.lay_out.set(**{"pass": number}, order=order, count=count)(
            -(-count // self.lanes), GROUP
        )
        self.average_close.set(places=places, order=order)
        return count, inverse

    def average(self, number: int, total: int, inverse: float, first: int) -> None:
        """Enqueue the averages of a batch of the ``total`` vertices that are prepared."""
        count = min(BATCH, total - first)
        values = {"pass": number, "inverse": inverse, "first": first, "count": count}
        self.average_close.set(**values, total=total)(count, GROUP)

    def _sort(self, count: int) -> tuple[Buffer, Buffer]:
        names = ("places", "order", "spare_places", "spare_order")
        return self.primitives.sort(*(self.buffers[name] for name in names), count)
