"""Connect: the shadow rays of next event estimation."""

from __future__ import annotations

from psf_cl.stages.shade import RAY_BYTES
from psf_cl.stages.spec import POOL_FLAGS, Context, KernelSpec, StageSpec


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if no light is sampled."""
    if not context.on("CONNECT"):
        return None
    direct = ("direct", "status") if context.on("AOV_DIRECT") else ()
    shared = ("beyond",) if context.on("CELLS") else ()
    moved = ("vertex", "status") if context.on("CELLS") else ()
    if context.features["CELLS"].value == 2:
        moved = (*moved, "light_share")
    base: tuple[str, ...] = ("base",) if context.on("BASE") else ()
    kept = (*base, "status") if base else ()
    if context.features["BASE"].value == 2:
        kept = (*kept, "base_light")
    # What blends by chance has random numbers of its path.
    numbers = ("seed", "sample", "status") if context.features["ALPHA"].value == 2 else ()
    learned = ("guide_from", "guide_light") if context.on("GUIDE") else ()
    if context.on("CACHE"):
        learned += ("cache", "cache_light")
    if learned:
        numbers = ("seed", "sample", "status")
    reads = (
        "light",
        "shadow",
        "toward",
        "radiance",
        *direct,
        *kept,
        *shared,
        *moved,
        *learned,
        *numbers,
    )
    kernel = KernelSpec(
        "connect_lights",
        reads=tuple(dict.fromkeys(reads)),
        writes=("light", "radiance", *direct[:1], *base, *shared),
        record_bytes=RAY_BYTES * max(context.features["SHADOW_RAYS"].value - 1, 0),
        rays=("shadow",),
        runs=True,
    )
    return StageSpec(
        "connect",
        "sampled lights need to be seen",
        "connect.cl",
        flags=(
            "FEW",
            "INSTANCES",
            "ALPHA",
            "VERTEX_COLORS",
            "AOV_DIRECT",
            "VIRTUAL_LIGHTS",
            *POOL_FLAGS,
        ),
        kernels=(kernel,),
        traces=True,
    )
