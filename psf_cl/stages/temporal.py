"""Temporal: pixels go on with the light of the frames before."""

from __future__ import annotations

from typing import Any

from psf_cl.device import layout
from psf_cl.settings import Settings
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec


def parameters(settings: Settings) -> dict[str, Any]:
    """Return what the kernels need to know, by the names of ``layout.PARAMS``."""
    return {
        "temporal_rule": layout.CONSTANT[f"RULE_{settings.temporal.upper()}"],
        "temporal_alpha": settings.temporal_alpha,
    }


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if frames know nothing of one another."""
    if not context.on("TEMPORAL"):
        return None
    history = layout.HISTORY.dtype
    what = "light of the frame before, and what it sees"
    return StageSpec(
        "temporal",
        "frames go on with the light of those before them",
        "temporal.cl",
        flags=("TEMPORAL", "CELL_HISTORY", "BASE", "LENS"),
        kernels=(KernelSpec("blend_history"), KernelSpec("keep_history", lanes=False)),
        buffers=(BufferSpec("history", history, context.pixel_count, what),),
        per_pass=True,
    )
