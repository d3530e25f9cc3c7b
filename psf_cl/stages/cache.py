"""Radiance cache: paths end at a surface where it is known what that reflects."""

from __future__ import annotations

from typing import Any

import numpy as np

from psf_cl.device import layout
from psf_cl.device.hash_map import SUM_BITS, buckets_of, fixed_point, slots_for, smaller
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings
from psf_cl.stages.cells import HEADROOM, brightest, pixel_per_meter
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec

#: Slots of the table: so many for a pixel, within these bounds (a slot takes 84 bytes).
SLOTS_PER_PIXEL = 2
LEAST_SLOTS, MOST_SLOTS = 1 << 16, 1 << 21

#: What it has gathered.
BUFFERS = ("cache_keys", "cache_full", "cache_sums", "cache_cells")

#: Visits that the sums of a cell have room for.
MOST_VISITS = 1 << 28


def slots_of(pixel_count: int, halvings: int = 0) -> int:
    """Return the slots of the table."""
    slots = min(max(slots_for(SLOTS_PER_PIXEL * pixel_count), LEAST_SLOTS), MOST_SLOTS)
    return smaller(slots, halvings)


def parameters(
    scene: Scene, settings: Settings, pixel_count: int, halvings: int = 0
) -> dict[str, Any]:
    """Return what the kernels need to know, by the names of ``layout.PARAMS``."""
    steps = fixed_point(HEADROOM * brightest(scene), MOST_VISITS)
    return {
        "cache_slots": slots_of(pixel_count, halvings),
        "cache_width": settings.cache_cell_size * pixel_per_meter(scene),
        "cache_steps": steps,
        "cache_limit": 2.0**SUM_BITS / steps / MOST_VISITS,
        "cache_trace": settings.cache_trace,
    }


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if paths do not end by it."""
    if not context.on("CACHE"):
        return None
    slots = slots_of(context.pixel_count, context.table_halvings)
    uint32 = np.dtype(np.uint32)
    sums, cells = layout.CACHE_SUM.dtype, layout.CACHE_CELL.dtype
    buffers = (
        BufferSpec("cache_keys", uint32, slots, "fingerprints of the cells of the radiance cache"),
        BufferSpec("cache_full", uint32, buckets_of(slots), "parts of the table that are full"),
        BufferSpec("cache_sums", sums, slots, "what the radiance cache gathers"),
        BufferSpec("cache_cells", cells, slots, "what the radiance cache knows"),
    )
    kernels = (
        KernelSpec("renew_cache", record_bytes=4, lanes=False),
        KernelSpec("freeze_cache", record_bytes=4 + sums.itemsize + cells.itemsize, lanes=False),
    )
    return StageSpec(
        "cache",
        "paths end where it is known what a surface reflects",
        "cache.cl",
        flags=("CACHE",),
        kernels=kernels,
        buffers=buffers,
        per_pass=True,
        between_passes=True,
    )
