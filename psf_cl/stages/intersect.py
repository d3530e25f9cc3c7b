"""Intersect: the closest hit of every ray."""

from __future__ import annotations

from psf_cl.stages.spec import POOL_FLAGS, Context, KernelSpec, StageSpec


def plan(context: Context) -> StageSpec:
    """Return the stage; every render has it."""
    # What blends by chance has random numbers of its path.
    numbers = ("seed", "sample") if context.features["ALPHA"].value == 2 else ()
    kernel = KernelSpec(
        "intersect_closest",
        reads=("status", "origin", "direction", *numbers),
        writes=("hit",),
        rays=("camera", "bounce"),
        runs=True,
    )
    return StageSpec(
        "intersect",
        "every ray needs its closest hit",
        "intersect.cl",
        flags=("FEW", "INSTANCES", "ALPHA", "BACK_FACES", "VERTEX_COLORS", *POOL_FLAGS),
        kernels=(kernel,),
        traces=True,
    )
