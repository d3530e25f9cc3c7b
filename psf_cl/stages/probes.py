"""Probes: where light changes from frame to frame."""

from __future__ import annotations

import numpy as np

from psf_cl.device import layout
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec


def count(width: int, height: int) -> int:
    """Return the probes of a picture of that size, pixels."""
    tile = layout.CONSTANT["PROBE_TILE"]
    return -(-width // tile) * -(-height // tile)


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if nobody asks where light changes."""
    if context.features["TEMPORAL"].value != 2:
        return None
    probes = count(*context.crop_size)
    what = "change of light around them, and how far frames scatter"
    spreads = (KernelSpec("spread_changes"),) if context.on("CELL_HISTORY") else ()
    return StageSpec(
        "probes",
        "a share of the paths is traced again to find where light changes",
        "probes.cl",
        flags=(
            "FEW",
            "INSTANCES",
            "TEXTURES",
            "SMOOTH",
            "VERTEX_COLORS",
            "AREA_LIGHTS",
            "RECTANGLES",
            "SPHERES",
            "PUNCTUAL_LIGHTS",
            "ENVIRONMENT",
            "ALPHA",
            "BACK_FACES",
            "LENS",
            "LIGHT_SAMPLING",
            "CELL_HISTORY",
        ),
        kernels=(
            KernelSpec("place_probes"),
            KernelSpec("measure_probes"),
            KernelSpec("pool_probes", lanes=False),
            *spreads,
        ),
        buffers=(
            BufferSpec("probes", layout.PROBE.dtype, probes, "paths that are traced again"),
            BufferSpec("changes", np.dtype(np.float32), 2 * probes, what),
        ),
        traces=True,
        per_pass=True,
    )
