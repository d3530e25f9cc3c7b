"""Cell history: cells keep what they know from frame to frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from psf_cl.device import layout
from psf_cl.device.hash_map import buckets_of
from psf_cl.settings import Settings
from psf_cl.stages.cells import slots_of
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec


def parameters(settings: Settings, time: float) -> dict[str, Any]:
    """Return what the kernels need to know, by the names of ``layout.PARAMS``; ``time`` in s."""
    return {"cell_history": settings.cell_history, "frame_time": time}


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if cells begin anew with each frame."""
    if not context.on("CELL_HISTORY"):
        return None
    slots, uint32 = slots_of(context.pixel_count, context.table_halvings), np.dtype(np.uint32)
    pixels = context.pixel_count
    cell, record = layout.CELL.dtype, layout.CELL_HISTORY.dtype
    buffers = (
        BufferSpec("kept_keys", uint32, slots, "fingerprints of the cells of all frames"),
        BufferSpec("kept_full", uint32, buckets_of(slots), "parts of their table that are full"),
        BufferSpec("kept_cells", record, slots, "what cells know from the frames before"),
        BufferSpec("shared_light", layout.SHARED_LIGHT.dtype, pixels, "what pixels took of cells"),
        BufferSpec("shared_pixels", layout.SHARED_PIXEL.dtype, pixels, "its part in the picture"),
        BufferSpec("shared_history", np.dtype(np.float32), 8 * pixels, "that of the frame before"),
    )
    if context.features["CELL_HISTORY"].value == 2:
        what = "change of light in cells, and the largest"
        buffers += (BufferSpec("cell_changes", uint32, slots + 1, what),)
    return StageSpec(
        "cell_history",
        "cells go on with what they knew in the frames before",
        "cell_history.cl",
        flags=("CELL_HISTORY",),
        kernels=(
            KernelSpec("gather_cells", record_bytes=4 + cell.itemsize + 40, lanes=False),
            KernelSpec("keep_cells", record_bytes=4 + 2 * record.itemsize, lanes=False),
        ),
        buffers=buffers,
        per_pass=True,
    )
