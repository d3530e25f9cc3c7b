"""Screen: a filter of the picture, over pixels that see the same surface."""

from __future__ import annotations

from typing import Any

import numpy as np

from psf_cl.device import layout
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
    pixels, light = context.pixel_count, layout.PIXEL_LIGHT.dtype
    return StageSpec(
        "screen",
        "the picture is filtered before it is handed out",
        "screen.cl",
        kernels=(
            KernelSpec("resolve_light", lanes=False),
            KernelSpec("filter_screen"),
        ),
        buffers=(
            BufferSpec("light", light, pixels, "light of the pixels before the filter", True),
            BufferSpec("filtered", np.dtype(np.float32), 4 * pixels, "and after it", True),
        ),
        per_pass=True,
    )
