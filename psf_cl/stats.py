"""What a render says of itself: the numbers of ``--stats``."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from psf_cl.device import layout
from psf_cl.stages import cells, guide

if TYPE_CHECKING:
    from psf_cl.renderer import Renderer


def statistics_of(renderer: Renderer) -> dict[str, Any]:
    """Return what ``--stats`` writes, without errors against a reference."""
    counters = renderer.device.read(renderer.buffers["counters"], layout.COUNTER_INDEX["finished"])
    passes = int(counters[layout.COUNTER_INDEX["film_pass"]]) - renderer.scheduler.first
    rays = {kind: layout.rays_so_far(counters, kind) for kind in layout.RAY_KINDS}
    stages = [{"name": name} | asdict(spent) for name, spent in renderer.device.totals.items()]
    return {
        "scene": renderer.scene.path,
        "spp": passes,
        "passes": passes,
        "render_seconds": renderer.scheduler.clock.now(),
        "build_seconds": renderer.build_seconds,
        "compile_seconds": renderer.compile_seconds,
        "load_seconds": renderer.load_seconds,
        "rays": rays,
        "device": renderer.device.name,
        "driver": renderer.device.driver,
        "peak_device_bytes": renderer.device.peak_bytes,
        "table_halvings": renderer.plan.table_halvings,
        "stages": stages,
        "occupancy": _occupancy(renderer),
        "counters": {
            "rejected_samples": int(counters[layout.COUNTER_INDEX["rejected_samples"]]),
            "dropped_triangles": renderer.dropped_triangles,
        },
        "paths": _path_statistics(renderer, counters, rays),
        "guide": _guide_statistics(renderer, counters),
        "cache": _cache_statistics(renderer, counters, rays),
        "cells": _cell_statistics(renderer, counters),
        "fireflies": _firefly_statistics(renderer),
        "materials": _material_statistics(renderer, counters),
        "metropolis": renderer.chains.statistics() if renderer.chains else None,
        "photons": renderer.photon_map.counts() if renderer.photon_map else None,
        "bvh": None
        if renderer.bvh is None
        else {
            "nodes": renderer.bvh.node_count,
            "blocks": renderer.bvh.block_count,
            "depth": renderer.bvh.depth,
            "rebuilds": renderer.rebuilds,
            "rebuilds_without_room": renderer.unbuilt,
        },
        "settings": asdict(renderer.settings),
        "seed": renderer.settings.seed,
    }


def _guide_statistics(renderer: Renderer, counters: np.ndarray) -> dict[str, int | float] | None:
    if "guide_keys" not in renderer.buffers:
        return None
    keys = renderer.device.read(renderer.buffers["guide_keys"])
    cells = renderer.device.read(renderer.buffers["guide_cells"])
    return {
        "left_out": renderer.guide_out is not None,
        "noise_left": guide.noise_left(cells, renderer.settings.guide_share),
        "cells": int(np.count_nonzero(keys)),
        "load": float(np.count_nonzero(keys)) / len(keys),
        "taught_cells": int(np.count_nonzero(cells["visits"] >= layout.CONSTANT["GUIDE_BINS"])),
        "failed_inserts": int(counters[layout.COUNTER_INDEX["guide_failed"]]),
        "rejected": int(counters[layout.COUNTER_INDEX["guide_rejected"]]),
    }


def _cache_statistics(
    renderer: Renderer, counters: np.ndarray, rays: dict[str, int]
) -> dict[str, int | float] | None:
    if renderer.freeze_cache is None:
        return None
    keys = renderer.device.read(renderer.buffers["cache_keys"])
    cells = renderer.device.read(renderer.buffers["cache_cells"])
    return {
        "cells": int(np.count_nonzero(keys)),
        "load": float(np.count_nonzero(keys)) / len(keys),
        "known_cells": int(np.count_nonzero(cells["visits"])),
        "ended_paths": layout.whole(counters, "cache_ends") / max(rays["camera"], 1),
        "failed_inserts": int(counters[layout.COUNTER_INDEX["cache_failed"]]),
        "rejected": int(counters[layout.COUNTER_INDEX["cache_rejected"]]),
    }


def _firefly_statistics(renderer: Renderer) -> dict[str, float] | None:
    """Return which parts of the pixels, and of their light, the last picture holds back."""
    if "kept" not in renderer.buffers:
        return None
    held = 1.0 - renderer.device.read(renderer.buffers["kept"]).astype(np.float64)
    if held.min() == 1.0:
        # No picture was made: of one, pixels that are as black as all around keep what they have.
        held[:] = 0.0
    film = renderer.device.read(renderer.buffers["film"])
    light = np.maximum(film["mean"].astype(np.float64), 0.0)
    whole = light.sum()
    return {
        "pixels": float(np.count_nonzero(held)) / len(held),
        "light": float(held @ light / whole) if whole > 0.0 else 0.0,
    }


def _material_statistics(renderer: Renderer, counters: np.ndarray) -> dict[str, int | float] | None:
    if renderer.freeze_materials is None:
        return None
    keys = renderer.device.read(renderer.buffers["material_keys"])
    known = renderer.device.read(renderer.buffers["material_cells"])
    return {
        "cells": int(np.count_nonzero(keys)),
        "load": float(np.count_nonzero(keys)) / len(keys),
        "known_cells": int(np.count_nonzero(known["visits"])),
        "failed_inserts": int(counters[layout.COUNTER_INDEX["material_failed"]]),
    }


def _path_statistics(
    renderer: Renderer, counters: np.ndarray, rays: dict[str, int]
) -> dict[str, float | None]:
    """Return how long paths are, and which part of them brings no light at all."""
    # Chains have no samples that could be dark.
    pending = renderer.scheduler.passes == 0 or renderer.chains is not None
    paths = max(rays["camera"], 1)
    dark = layout.whole(counters, "dark_samples")
    return {
        "mean_rays": (rays["camera"] + rays["bounce"]) / paths,
        "zero_contribution": None if pending else dark / paths,
    }


def _cell_statistics(renderer: Renderer, counters: np.ndarray) -> dict[str, int | float] | None:
    if renderer.cells is None:
        return None

    names = ("failed_inserts", "rejected_cells", "unfiltered_samples")
    used, passes = layout.whole(counters, "cells_used"), max(renderer.scheduler.passes, 1)
    slots = cells.slots_of(renderer.plan.pixel_count, renderer.plan.table_halvings)
    kept = {}
    if "kept_keys" in renderer.buffers:
        keys = renderer.device.read(renderer.buffers["kept_keys"])
        kept["kept"] = int(np.count_nonzero(keys))
        kept["failed_histories"] = layout.whole(counters, "failed_histories")
    return (
        {name: layout.whole(counters, name) for name in names}
        | kept
        | {
            "cells_per_pass": used / passes,
            "load": used / passes / slots,
            "mean_probes": layout.whole(counters, "cell_probes") / max(used, 1),
        }
    )


def _occupancy(renderer: Renderer) -> list[float] | None:
    """Return the mean share of the slots whose path lives, by its bounces so far."""
    if not renderer.statistics:
        return None
    shares = renderer.depth_counts / (max(renderer.censuses, 1) * renderer.plan.traits.slots)
    return [float(share) for share in shares]
