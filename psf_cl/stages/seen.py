"""Seen: the first surface of every sample, and its means per pixel."""

from __future__ import annotations

import numpy as np

from psf_cl.device import layout
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if nothing asks what pixels see."""
    if not context.on("SEEN"):
        return None
    one, mean = layout.SEEN.dtype, layout.SEEN_MEAN.dtype
    samples = context.ring * context.pixel_count
    what = f"first surfaces of {context.ring} passes in flight"
    pixels = context.pixel_count
    kernels = [
        KernelSpec("add_seen", record_bytes=one.itemsize + 2 * mean.itemsize, per_sample=True)
    ]
    buffers = [
        BufferSpec("seen", one, samples, what, True),
        BufferSpec("surfaces_seen", mean, pixels, "first surfaces of the pixels"),
    ]
    if context.features["SEEN"].value == 2:
        kernels.append(KernelSpec("find_motion"))
        buffers.append(BufferSpec("motion", np.dtype(np.float32), 2 * pixels, "of these", True))
    if context.on("BASE") or context.on("TEMPORAL"):
        what = "light of the pixels, with that of the frames before"
        buffers.append(BufferSpec("light", layout.PIXEL_LIGHT.dtype, pixels, what, True))
    return StageSpec(
        "seen",
        "what a pixel sees decides with which it shares light",
        "seen.cl",
        flags=("SEEN", "LENS"),
        kernels=tuple(kernels),
        buffers=tuple(buffers),
        per_pass=True,
    )
