"""Fireflies: pixels that too few samples speak for are dimmed before the picture is handed out."""

from __future__ import annotations

import numpy as np

from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if pixels stay as they are."""
    if not context.on("FIREFLIES"):
        return None
    names = ("weigh_film",)
    if context.on("BASE") or context.on("TEMPORAL"):
        names = ("weigh_light", "hold_light")
    return StageSpec(
        "fireflies",
        "pixels that few samples speak for are dimmed before the picture is handed out",
        "fireflies.cl",
        kernels=tuple(KernelSpec(name, lanes=False) for name in names),
        buffers=(
            BufferSpec(
                "kept",
                np.dtype(np.float32),
                context.pixel_count,
                "part of their light that pixels keep",
                True,
            ),
        ),
        per_pass=True,
    )
