"""Intersect: the closest hit of every ray."""

from __future__ import annotations

from psf_cl.stages.spec import Context, StageSpec


def plan(context: Context) -> StageSpec:
    """Return the stage; every render has it."""
    return StageSpec(
        "intersect",
        "every ray needs its closest hit",
        "intersect.cl",
        flags=("FEW", "ALPHA",),
        kernels=("intersect_closest",),
        traces=True,
    )
