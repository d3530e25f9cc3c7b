"""Shade: emission, next event estimation, the next direction."""

from __future__ import annotations

import numpy as np

from psf_cl.device import layout
from psf_cl.stages.spec import POOL_FLAGS, BufferSpec, Context, KernelSpec, StageSpec

#: Of each shadow ray after the first that is written here and read by the connecting stage.
RAY_BYTES = 36


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
                passing=True,
            )
        )
    if context.on("AOV_LIGHTS"):
        count = context.ring * context.pixel_count * 4
        what = "how lights were chosen, of passes in flight"
        buffers.append(BufferSpec("choices", np.dtype(np.float32), count, what, passing=True))
    return StageSpec(
        "shade",
        "every hit and miss is shaded",
        "shade.cl",
        flags=(
            "INSTANCES",
            "TEXTURES",
            "TEXTURE_LEVELS",
            "MATERIAL_CELLS",
            "SMOOTH",
            "GLOSSY",
            "TRANSMISSION",
            "VERTEX_COLORS",
            "TANGENTS",
            "LAYERS",
            "AREA_LIGHTS",
            "RECTANGLES",
            "SPHERES",
            "PUNCTUAL_LIGHTS",
            "ENVIRONMENT",
            "ALPHA",
            "CONNECT",
            "AOV_DIRECT",
            "AOV_FEATURES",
            "AOV_LIGHTS",
            "MOTION",
            "SEEN",
            "VIRTUAL_LIGHTS",
            *POOL_FLAGS,
            "CELL_LAYERS",
            "METROPOLIS",
        ),
        kernels=(_kernel(context),),
        buffers=tuple(buffers),
    )


def _kernel(context: Context) -> KernelSpec:
    """Return the kernel with what it reads and writes under the features that are on."""
    direct = ("direct",) if context.on("AOV_DIRECT") else ()
    cells = context.features["CELLS"].value
    shared = ("vertex", "length", "beyond") if cells else ()
    shared += ("share",) if cells == 2 else ()
    base: tuple[str, ...] = ("base",) if context.on("BASE") else ()
    if context.features["BASE"].value == 2:
        base += ("base_share",)
    shadow = ("shadow", "toward", "light") if context.on("CONNECT") else ()
    if cells == 2 and shadow:
        shadow += ("light_share",)
    if context.features["BASE"].value == 2 and shadow:
        shadow += ("base_light",)
    seen_from = any(context.on(name) for name in ("LIGHT_SAMPLING", "RECTANGLES", "SPHERES"))
    chosen: tuple[str, ...] = ("light_normal",) if context.on("LIGHT_SAMPLING") else ()
    if context.features["LIGHT_SAMPLING"].value >= 2:
        chosen += ("particle_row",)
    cached = ("cache", "cache_gate") if context.on("CACHE") else ()
    if cached and shadow:
        shadow += ("cache_light",)
    guided = ("guide", "expected") if context.on("GUIDE") else ()
    if guided and shadow:
        shadow += ("guide_from", "guide_light")
    walk = ("status", "direction", "beta", "radiance", "pdf")
    walk += (*direct, *base, *shared, *chosen, *cached, *guided)
    walk += ("denser",) if context.on("TRANSMISSION") else ()
    records = [layout.SURFACE, layout.MATERIAL]
    if context.on("INSTANCES"):
        records.append(layout.INSTANCE)
    if context.on("SMOOTH"):
        records.append(layout.NORMALS)
    if context.on("TEXTURES"):
        records += [layout.UVS, layout.TEXTURE]
    if context.on("VERTEX_COLORS"):
        records.append(layout.VERTEX_COLORS)
    if context.on("TANGENTS"):
        records.append(layout.TANGENTS)
    if context.on("CONNECT"):
        records.append(layout.LIGHT)
        if context.on("AREA_LIGHTS"):
            records += [layout.SURFACE, layout.MATERIAL]
    if context.features["ENVIRONMENT"].value == 2:
        records.append(layout.ENVIRONMENT_CELL)
    if context.on("CELLS"):
        records.append(layout.CELL_VERTEX)
    if context.on("SEEN"):
        records.append(layout.SEEN)
    # Of the guide, its key, the words that a drawing looks at, and a sum and a count.
    guide_bytes = 4 * (1 + 2 + 4 + 8 + 2 + 3) if context.on("GUIDE") else 0
    if context.on("CACHE"):
        records += [layout.CACHE_CELL, layout.CACHE_SUM]
    if context.on("MATERIAL_CELLS"):
        records += [layout.MATERIAL_CELL, layout.MATERIAL_SUM]
    feature_bytes = 3 * 16 if context.on("AOV_FEATURES") else 0
    feature_bytes += RAY_BYTES * max(context.features["SHADOW_RAYS"].value - 1, 0)
    feature_bytes += 16 if context.on("AOV_LIGHTS") else 0
    return KernelSpec(
        "shade_paths",
        reads=(*walk, *(("origin",) if seen_from else ()), "hit", "sample", "pixel", "seed"),
        writes=(*walk, "origin", *shadow),
        record_bytes=sum(record.dtype.itemsize for record in records) + feature_bytes + guide_bytes,
        hash_accesses=sum(map(context.on, ("GUIDE", "CACHE", "MATERIAL_CELLS"))),
    )
