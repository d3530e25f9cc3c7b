"""Splats: what the chains brought to a pixel in a pass is its sample."""

from __future__ import annotations

from psf_cl.device import layout
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if every path stays in its pixel."""
    if not context.on("METROPOLIS"):
        return None
    record = layout.SPLAT_SUM.dtype
    count = context.ring * context.pixel_count
    what = f"sums of {context.ring} passes in flight"
    kernel = KernelSpec("collect_splats", record_bytes=2 * record.itemsize + 16, per_sample=True)
    return StageSpec(
        "splats",
        "paths of chains end up in any pixel",
        "splats.cl",
        kernels=(kernel,),
        buffers=(BufferSpec("splats", record, count, what, passing=True),),
        per_pass=True,
    )
