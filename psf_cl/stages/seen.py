"""Seen: the first surface of every sample, and its means per pixel."""

from __future__ import annotations

from psf_cl.device import layout
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if nothing asks what pixels see."""
    if not context.on("SEEN"):
        return None
    one, mean = layout.SEEN.dtype, layout.SEEN_MEAN.dtype
    samples = context.ring * context.pixel_count
    what = f"first surfaces of {context.ring} passes in flight"
    return StageSpec(
        "seen",
        "what a pixel sees decides with which it shares light",
        "seen.cl",
        kernels=(
            KernelSpec("add_seen", record_bytes=one.itemsize + 2 * mean.itemsize, per_sample=True),
        ),
        buffers=(
            BufferSpec("seen", one, samples, what, True),
            BufferSpec("surfaces_seen", mean, context.pixel_count, "first surfaces of the pixels"),
        ),
        per_pass=True,
    )
