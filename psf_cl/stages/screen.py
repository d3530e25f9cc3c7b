"""Screen: a filter of the picture, over pixels that see the same surface."""

from __future__ import annotations

from typing import Any

import numpy as np

from psf_cl.settings import Settings
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec


def parameters(settings: Settings) -> dict[str, Any]:
    """Return what the kernels need to know, by the names of ``layout.PARAMS``."""
    on = settings.screen_filter != "off"
    return {
        "screen_radius": settings.screen_radius,
        "screen_neighbours": settings.screen_neighbours if on else 0,
    }


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if the picture is not filtered."""
    if not context.on("BASE"):
        return None
    count = 4 * context.pixel_count
    return StageSpec(
        "screen",
        "the picture is filtered before it is handed out",
        "screen.cl",
        flags=("LENS",),
        kernels=(
            KernelSpec("resolve_light", lanes=False),
            KernelSpec("find_arriving"),
            KernelSpec("filter_screen"),
        ),
        buffers=(
            BufferSpec(
                "arriving",
                np.dtype(np.float32),
                2 * context.pixel_count,
                "light that falls on what pixels see, and its variance",
                True,
            ),
            BufferSpec("filtered", np.dtype(np.float32), count, "filtered picture", True),
        ),
        per_pass=True,
    )
