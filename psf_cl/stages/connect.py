"""Connect: the shadow rays of next event estimation."""

from __future__ import annotations

from psf_cl.stages.spec import Context, StageSpec


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if no light is sampled."""
    if not context.on("CONNECT"):
        return None
    return StageSpec(
        "connect",
        "sampled lights need to be seen",
        "connect.cl",
        flags=("FEW", "ALPHA", "AOV_DIRECT"),
        kernels=("connect_lights",),
        traces=True,
    )
