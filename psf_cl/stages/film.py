"""Film: sums of whole passes, per pixel and plane."""

from __future__ import annotations

import numpy as np

from psf_cl.device import layout
from psf_cl.stages.spec import BufferSpec, Context, StageSpec

#: Ring buffer of samples, the film's buffer that it is added to, and planes in it.
PLANES = (("samples", "film", 1), ("direct", "film_direct", 1), ("features", "film_features", 3))

#: Depths that the occupancy statistics tell apart; the last takes all beyond.
CENSUS_BINS = 32

#: Film launches visit every pixel: large groups make the empty ones cheap.
GROUP = 64


def plan(context: Context) -> StageSpec:
    """Return the stage; every render has it."""
    dtype = layout.FILM_SUM.dtype
    buffers = [BufferSpec("film", dtype, context.pixel_count, "sums of the image")]
    if context.on("AOV_DIRECT"):
        buffers.append(
            BufferSpec("film_direct", dtype, context.pixel_count, "sums of the direct light")
        )
    if context.on("AOV_FEATURES"):
        count = 3 * context.pixel_count
        buffers.append(
            BufferSpec("film_features", dtype, count, "sums of albedo, normal and depth")
        )
    kernels = ["add_samples", "advance_film"]
    if context.statistics:
        kernels.append("count_depths")
        buffers.append(BufferSpec("census", np.dtype(np.uint32), CENSUS_BINS, "paths by depth"))
    return StageSpec(
        "film",
        "samples are summed pass by pass",
        "film.cl",
        kernels=tuple(kernels),
        buffers=tuple(buffers),
    )
