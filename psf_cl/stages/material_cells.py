"""Parameter cloud: what textures give to materials is fetched once a cell by later vertices."""

from __future__ import annotations

from typing import Any

import numpy as np

from psf_cl.device import layout
from psf_cl.device.hash_map import buckets_of, slots_for, smaller
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings
from psf_cl.stages.cells import pixel_per_meter
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec

#: Slots of the table: one for each pixel, within these bounds (a slot takes 80 bytes).
LEAST_SLOTS, MOST_SLOTS = 1 << 16, 1 << 20

BUFFERS = ("material_keys", "material_full", "material_sums", "material_cells")


def slots_of(pixel_count: int, halvings: int = 0) -> int:
    """Return the slots of the table."""
    return smaller(min(max(slots_for(pixel_count), LEAST_SLOTS), MOST_SLOTS), halvings)


def parameters(
    scene: Scene, settings: Settings, pixel_count: int, halvings: int = 0
) -> dict[str, Any]:
    """Return what the kernels need to know, by the names of ``layout.PARAMS``."""
    return {
        "material_slots": slots_of(pixel_count, halvings),
        "material_width": settings.material_cell_size * pixel_per_meter(scene),
    }


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if every vertex looks its textures up."""
    if not context.on("MATERIAL_CELLS"):
        return None
    slots = slots_of(context.pixel_count, context.table_halvings)
    uint32 = np.dtype(np.uint32)
    sums, cells = layout.MATERIAL_SUM.dtype, layout.MATERIAL_CELL.dtype
    buffers = (
        BufferSpec("material_keys", uint32, slots, "fingerprints of the cells of materials"),
        BufferSpec("material_full", uint32, buckets_of(slots), "parts of the table that are full"),
        BufferSpec("material_sums", sums, slots, "what textures gave in cells"),
        BufferSpec("material_cells", cells, slots, "what is known of them"),
    )
    record_bytes = 4 + sums.itemsize + cells.itemsize
    return StageSpec(
        "material_cells",
        "later vertices fetch what textures give once a cell",
        "material_cells.cl",
        flags=("MATERIAL_CELLS",),
        kernels=(KernelSpec("freeze_materials", record_bytes=record_bytes, lanes=False),),
        buffers=buffers,
        per_pass=True,
        between_passes=True,
    )
