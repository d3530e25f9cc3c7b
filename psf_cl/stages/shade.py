"""Shade: emission, next event estimation, the next direction."""

from __future__ import annotations

import numpy as np

from psf_cl.stages.spec import BufferSpec, Context, StageSpec


def plan(context: Context) -> StageSpec:
    """Return the stage; every render has it."""
    buffers = []
    if context.on("AOV_FEATURES"):
        count = 3 * context.ring * context.pixel_count * 4
        buffers.append(
            BufferSpec(
                "features",
                np.dtype(np.float32),
                count,
                "albedo, normal and depth of passes in flight",
            )
        )
    return StageSpec(
        "shade",
        "every hit and miss is shaded",
        "shade.cl",
        flags=(
            "TEXTURES",
            "SMOOTH",
            "GLOSSY",
            "TRANSMISSION",
            "AREA_LIGHTS",
            "PUNCTUAL_LIGHTS",
            "ENVIRONMENT",
            "ALPHA",
            "CONNECT",
            "AOV_DIRECT",
            "AOV_FEATURES",
        ),
        kernels=("shade_paths",),
        buffers=tuple(buffers),
    )
