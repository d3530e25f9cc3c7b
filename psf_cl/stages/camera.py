"""Camera: hand in finished paths and start new ones in their slots."""

from __future__ import annotations

import numpy as np

from psf_cl.device import layout
from psf_cl.stages.spec import POOL_FLAGS, BufferSpec, Context, KernelSpec, StageSpec


def pool_buffers(context: Context) -> list[BufferSpec]:
    """Return what holds the paths, wherever they start, and what they bring."""
    slots = context.traits.slots
    samples = context.ring * context.pixel_count * 4
    float32, uint32 = np.dtype(np.float32), np.dtype(np.uint32)
    return [
        BufferSpec(
            "pool", float32, slots * context.path_field_count, f"state of {slots} paths", True
        ),
        BufferSpec(
            "counters", uint32, layout.COUNTER_INDEX["finished"] + context.ring, "queue and rays"
        ),
        BufferSpec(
            "samples", float32, samples, f"radiance of {context.ring} passes in flight", True
        ),
    ]


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if paths start from those before them."""
    if context.on("METROPOLIS"):
        return None
    samples = context.ring * context.pixel_count * 4
    buffers = pool_buffers(context)
    direct: tuple[str, ...] = ()
    if context.on("AOV_DIRECT"):
        direct = ("direct",)
        buffers.append(
            BufferSpec("direct", np.dtype(np.float32), samples, "direct light of the same", True)
        )
    if context.on("AOV_BOUNCES"):
        what = "bounces of the same"
        buffers.append(BufferSpec("bounces", np.dtype(np.float32), samples, what, True))
    base: tuple[str, ...] = ()
    if context.on("BASE"):
        base = ("base",)
        what = "what first surfaces reflect of the same"
        buffers.append(BufferSpec("base", np.dtype(np.float32), samples, what, True))
    shared = ("beyond", "vertex") if context.on("CELLS") else ()
    started = ("origin", "direction", "beta", "radiance", *direct, *base, "seed", "status")
    named = ("sample", "pixel")
    kernel = KernelSpec(
        "regenerate_paths",
        reads=(*started, *named, *shared),
        writes=(*started, *named),
        # A weighted sample a plane.
        record_bytes=16
        * (1 + len(direct) + len(base) + context.on("CELLS") + context.on("AOV_BOUNCES")),
        runs=True,
    )
    return StageSpec(
        "camera",
        "paths start at the camera",
        "camera.cl",
        flags=("LENS", "AOV_BOUNCES", "AOV_DIRECT", *POOL_FLAGS),
        kernels=(kernel,),
        buffers=tuple(buffers),
    )
