"""Film: sums of whole passes, per pixel and plane."""

from __future__ import annotations

import numpy as np

from psf_cl.device import layout
from psf_cl.stages.spec import POOL_FLAGS, BufferSpec, Context, KernelSpec, StageSpec

#: Ring buffer of samples, the film's buffer that it is added to, and planes in it.
PLANES = (
    ("samples", "film", 1),
    ("direct", "film_direct", 1),
    ("bounces", "film_bounces", 1),
    ("base", "film_base", 1),
    ("features", "film_features", 3),
    ("choices", "film_choices", 1),
)

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
    if context.on("AOV_BOUNCES"):
        buffers.append(BufferSpec("film_bounces", dtype, context.pixel_count, "sums of bounces"))
    if context.on("BASE"):
        what = "sums of what first surfaces reflect"
        buffers.append(BufferSpec("film_base", dtype, context.pixel_count, what))
    if context.on("AOV_FEATURES"):
        count = 3 * context.pixel_count
        buffers.append(
            BufferSpec("film_features", dtype, count, "sums of albedo, normal and depth")
        )
    if context.on("AOV_LIGHTS"):
        what = "sums of how lights were chosen"
        buffers.append(BufferSpec("film_choices", dtype, context.pixel_count, what))
    planes = 1 + context.on("AOV_DIRECT") + context.on("BASE") + 3 * context.on("AOV_FEATURES")
    planes += context.on("AOV_BOUNCES")
    planes += context.on("AOV_LIGHTS")
    # A weighted value; the sums are read and written.
    sample_bytes = planes * (16 + 2 * dtype.itemsize)
    kernels = [
        KernelSpec("add_samples", record_bytes=sample_bytes, per_sample=True),
        KernelSpec("advance_film", lanes=False),
    ]
    if context.halves:
        half_bytes = 16 + dtype.itemsize  # Half of the samples are added.
        kernels.append(KernelSpec("add_half", record_bytes=half_bytes, per_sample=True))
        what = "sums of half of the passes, to estimate the error"
        buffers.append(BufferSpec("film_half", dtype, context.pixel_count, what))
    if context.statistics:
        kernels.append(KernelSpec("count_depths", reads=("status",), record_bytes=8, lanes=False))
        buffers.append(
            BufferSpec("census", np.dtype(np.uint32), CENSUS_BINS, "paths by depth", True)
        )
    return StageSpec(
        "film",
        "samples are summed pass by pass",
        "film.cl",
        flags=POOL_FLAGS,
        kernels=tuple(kernels),
        buffers=tuple(buffers),
        per_pass=True,
    )
