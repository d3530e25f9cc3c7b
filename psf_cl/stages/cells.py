"""Cells: path space filtering, the average per cell in place of what each path gathered there."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from psf_cl.device import layout
from psf_cl.device.hash_map import SUM_BITS, buckets_of, fixed_point, slots_for, smaller
from psf_cl.scene.model import LUMINANCE, Scene
from psf_cl.settings import Settings
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec

#: A sample may be so many times as bright as the brightest light before it is not shared.
HEADROOM = 1024.0

#: Brighter than so many times its mean the sky has a sun, or a lamp, whose shadows are sharp.
EVEN_SKY = 10.0

#: Cells of pass n have the edge n^(-1/6) of those of pass 1: bias falls as n^(-1/3), and so
#: does the noise, n^(-2/3) in variance.
#: Knaus, Zwicker: Progressive Photon Mapping: A Probabilistic Approach, 2011 (alpha = 2/3).
SHRINK_EXPONENT = -1.0 / 6.0

#: Images of cells, and where ``layout.CELL_VIEW`` has them.
VIEWS = {
    "cells": "color",
    "occupancy": "occupancy",
    "cell_count": "count",
    "cell_variance": "variance",
    "filter_weight": "weight",
}

#: Least GGX alpha of coats that share what they reflect, in angles of a cell as the camera sees it.
#: A cell blurs directions by 0.58 of its angle (root mean square), a reflection by about 1.1 alpha:
#: it becomes an eighth wider, by the mean square.
WIDE = 1.5

#: Features that the rays that look for walls depend on.
TRACING = ("WALLS", "FEW", "INSTANCES", "ALPHA", "VERTEX_COLORS")


def slots_of(pixel_count: int, halvings: int = 0) -> int:
    """Return the slots of the table of a pass.

    As many as there are samples: only where nearly all of them are alone can it overflow, and there
    is nothing to share.
    """
    return smaller(slots_for(pixel_count), halvings)


def buckets(pixel_count: int, halvings: int = 0) -> int:
    """Return the buckets of the table of a pass."""
    return buckets_of(slots_of(pixel_count, halvings))


def parameters(
    scene: Scene, settings: Settings, pixel_count: int, halvings: int = 0
) -> dict[str, Any]:
    """Return what the kernels need to know, by the names of ``layout.PARAMS``."""
    steps = fixed_point(HEADROOM * brightest(scene), pixel_count)
    width = settings.cell_size * pixel_per_meter(scene)
    return {
        "cell_min_count": settings.cell_min_count,
        "cell_slots": slots_of(pixel_count, halvings),
        "cell_flags": layout.CONSTANT["CELL_JITTER"] * settings.cell_jitter
        + layout.CONSTANT["CELL_NEAR"] * settings.cell_near,
        "cell_directions": settings.cell_directions,
        "cell_width": width,
        "cell_alpha": WIDE * width,
        "cell_shrink": SHRINK_EXPONENT if settings.cell_shrink else 0.0,
        "cell_steps": steps,
        "cell_limit": 2.0**SUM_BITS / steps / slots_for(pixel_count),
        "filter_vertex": _vertex(settings),
        "filter_direct": int(settings.filter_direct),
    }


def sky_limit(settings: Settings, mean: np.ndarray) -> float:
    """Return the luminance up to which direct light of the sky is shared, -1 for none.

    Args:
        mean: radiance of the sky over all directions, ``(3,)``.
    """
    return EVEN_SKY * float(mean @ LUMINANCE) if settings.filter_sky else -1.0


def pixel_per_meter(scene: Scene) -> float:
    """Return how wide a pixel is for each meter of the way from the camera.

    Parallel rays see pixels of one width: it is right in the middle of the scene.
    """
    camera = scene.cameras[scene.camera]
    if camera.height == 0.0:
        return 2.0 * math.tan(camera.fov_y / 2.0) / scene.height
    places = [
        shape.transform[:3, :3] @ shape.mesh.positions[0] + shape.transform[:3, 3]
        for shape in scene.shapes
    ]
    away = np.asarray(places).reshape(-1, 3) - camera.transform[:3, 3]
    distances = -away @ camera.transform[:3, 2]
    known = distances[np.isfinite(distances) & (distances > 0.0)]
    return camera.height / scene.height / (float(known.mean()) if len(known) else camera.height)


def _vertex(settings: Settings) -> int:
    if settings.path_filter == "off":
        return layout.CONSTANT["FILTER_NONE"]
    if settings.filter_vertex == "auto":
        return layout.CONSTANT["FILTER_AUTO"]
    return int(settings.filter_vertex)


def brightest(scene: Scene) -> float:
    """Return the largest radiance that anything emits; of lights without extent at 1 m."""
    emitted = [max(material.emission) for material in scene.materials]
    emitted += [max(light.intensity) for light in scene.lights]
    curves = [material.emission_curve for material in scene.materials]
    curves += [light.intensity_curve for light in scene.lights]
    emitted += [float(curve.peak().max()) for curve in curves if curve is not None]
    image = scene.environment.image
    sky = np.max(scene.environment.radiance) * (1.0 if image is None else float(np.max(image)))
    largest = max([*emitted, float(sky)])
    return min(max(largest, 2.0**-40), 2.0**90) if math.isfinite(largest) else 2.0**90


def sample_buffers(context: Context) -> tuple[BufferSpec, ...]:
    """Return what the samples in flight hand in to be shared."""
    samples = context.ring * context.pixel_count
    in_flight = f"of {context.ring} passes in flight"
    return (
        BufferSpec(
            "beyond", layout.BEYOND.dtype, samples, f"light behind the vertices {in_flight}", True
        ),
        BufferSpec("vertices", layout.CELL_VERTEX.dtype, samples, f"vertices {in_flight}", True),
    )


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if paths are not filtered."""
    if not context.on("CELLS") or context.range_search:
        return None
    walls = context.on("WALLS")
    slots = slots_of(context.pixel_count, context.table_halvings)
    cell, uint32 = layout.CELL.dtype, np.dtype(np.uint32)
    buffers = (
        *sample_buffers(context),
        BufferSpec("cell_keys", uint32, context.ring * slots, "fingerprints of cells", True),
        BufferSpec("cells", cell, context.ring * slots, "sums of cells", True),
        BufferSpec(
            "full_buckets",
            uint32,
            context.ring * buckets_of(slots),
            "parts of tables that are full",
            passing=True,
        ),
    )
    if context.on("AOV_CELLS"):
        squares, view = layout.CELL_SQUARES.dtype, layout.CELL_VIEW.dtype
        buffers += (
            BufferSpec("cell_squares", squares, context.ring * slots, "second moments", True),
            BufferSpec("film_cells", view, context.pixel_count, "what pixels saw of cells"),
        )
    if context.on("SPARSE"):
        what = "samples that cells would have"
        buffers += (BufferSpec("crowds", uint32, context.ring * slots, what, True),)
    if walls:
        what = "cells with light from near"
        buffers += (BufferSpec("near_cells", uint32, context.ring * slots, what, True),)
    sample_bytes = layout.BEYOND.dtype.itemsize + layout.CELL_VERTEX.dtype.itemsize
    crowds = (KernelSpec("count_crowds", record_bytes=sample_bytes, per_sample=True, runs=True),)
    marks = (KernelSpec("mark_near_cells", record_bytes=sample_bytes, per_sample=True, runs=True),)
    kernels = (
        *(crowds if context.on("SPARSE") else ()),
        *(marks if walls else ()),
        KernelSpec(
            "store_cells",
            record_bytes=sample_bytes + 4 + 2 * cell.itemsize,
            per_sample=True,
            runs=True,
            hash_accesses=1,
        ),
        KernelSpec("resolve_cells", record_bytes=4, per_sample=True, lanes=False),
        KernelSpec(
            "look_up_cells",
            record_bytes=sample_bytes + 4 + cell.itemsize + 2 * 16,
            per_sample=True,
            runs=True,
            hash_accesses=1,
        ),
        KernelSpec("clear_cells", record_bytes=4, per_sample=True, lanes=False),
        KernelSpec("add_unfiltered", lanes=False),
    )
    return StageSpec(
        "cells",
        "light is shared by the paths that meet in a cell",
        "cells.cl",
        flags=(
            "AOV_CELLS",
            "BASE",
            "CELLS",
            "CELL_HISTORY",
            "CELL_LAYERS",
            "RESTORE",
            "SPARSE",
            *TRACING,
        ),
        kernels=kernels,
        buffers=buffers,
        traces=True,
        per_pass=True,
    )
